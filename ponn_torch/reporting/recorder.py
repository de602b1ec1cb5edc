"""What recorders share: an observer that must be closed, and events as plain numbers and words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ponn_torch.solving.observer import Observer
from ponn_torch.solving.result import StageResult


class Recorder(Observer):
    """An observer that holds something open: a file, a display."""

    def close(self) -> None:
        """Write what is left and let go; called once, also after a failure."""


def finite_or_none(value: Any) -> Any:
    """Make values fit for JSON, which knows no NaN; mappings and lists are walked, objects become text."""
    if isinstance(value, Mapping):
        return {str(key): finite_or_none(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_none(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | bool | int) else str(value)


def stage_entry(stage: StageResult) -> dict[str, Any]:
    """A stage as plain numbers and words, without its records and trajectory."""
    names = ("name", "smoothing", "start", "norm", "n_iterations", "n_residuals", "n_linearisations")
    more = ("cpu_seconds", "off_node_residual", "cost")
    plain = {name: getattr(stage, name) for name in (*names, *more)}
    return plain | {"status": stage.status.name, "reason": stage.status.value}
