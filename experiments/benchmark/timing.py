"""Fair timing of routines, and tables with a column for each thing that was timed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def cpu_times(calls: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, list[float]]:
    """CPU seconds per call after a warm-up; one of each in turn, so that a busy machine slows all of them."""
    out: dict[str, list[float]] = {name: [] for name in calls}
    for repeat in range(repeats + 1):
        for name, call in calls.items():
            began = time.process_time()
            call()
            if repeat:
                out[name].append(time.process_time() - began)
    return out


WARM_UP = 6  # solves of a problem, by which what it evaluates is recorded (see ponn_torch/numerics/tape.py)


def columns(lines: Sequence[Mapping[str, str]]) -> list[dict[str, str]]:
    """Rows ↔ columns."""
    first, *others = lines[0]
    return [{first: key, **{line[first]: line[key] for line in lines}} for key in others]
