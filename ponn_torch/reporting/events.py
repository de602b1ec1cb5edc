"""TensorBoard event files with one set of tags for every optimiser, hyperparameters in the same run."""

from __future__ import annotations

import io
import math
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[import-untyped]
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from ponn_torch.optim.base import Record
from ponn_torch.reporting.figures import stage_figure
from ponn_torch.reporting.recorder import Recorder
from ponn_torch.solving.certificate import Certificate
from ponn_torch.solving.observer import Look
from ponn_torch.solving.result import StageResult
from ponn_torch.solving.solution import Solution

# Written at every iteration by every optimiser, so that runs share their charts.
OPTIM_TAGS = ("damping", "step", "accepted", "running", "residuals", "linearisations")
# of a certificate, what a person compares; all of it stands in certificate.json
JUDGED = (
    "certified",
    "cost",
    "cost_error",
    "end_error_scaled",
    "control_end_error_scaled",
    "hamiltonian_drift",
    "minimality",
    "off_node_residual",
    "sign_violation",
    "transversality",
)
METRICS = (
    *(f"certificate/{name}" for name in ("certified", "cost", "end_error_scaled", "off_node_residual")),
    "residual/total",
    "time/cpu_seconds",
)
ERRORS = ("states", "costates")  # against a reference, where there is one
MAX_FIGURES = 30  # TensorBoard crawls under hundreds


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one level with dotted names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def _hyperparameters(settings: Mapping[str, Any]) -> dict[str, float | int | str]:
    """Numbers as they are, text that reads as one as a number, everything else as text: what HPARAMS can hold."""
    return {name: _number_or_text(value) for name, value in flatten(settings).items() if value is not None}


def _number_or_text(value: Any) -> float | int | str:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value
    try:
        return float(value) if isinstance(value, str) else str(value)
    except ValueError:
        return str(value)


class TensorBoard(Recorder):
    """residual/total, residual/<equation>, optim/*, stage/*, cost/<cost_name>, error/*, certificate/*, time/seconds.

    All scalars of an iteration are one event, which costs a tenth of a call per scalar. Hyperparameters go
    into the same writer, so that no second run appears beside this one.
    """

    def __init__(
        self, folder: Path, *, settings: Mapping[str, Any], cost_name: str = "cost", figures: bool = True
    ) -> None:
        self._writer = SummaryWriter(str(folder), flush_secs=10)
        self._step, self._stage = 0, -1
        self._start, self._cpu_start = time.perf_counter(), time.process_time()
        self._cost_tag, self._failed = f"cost/{cost_name}", False
        self._judged, self._cost = False, math.nan
        self._figures: deque[tuple[int, Solution]] = deque(maxlen=MAX_FIGURES if figures else 0)
        experiment, begin, self._end = hparams(_hyperparameters(settings), dict.fromkeys(METRICS, 0.0))
        for summary in (experiment, begin):
            self._add(summary, 0)

    def _add(self, summary: Summary, step: int) -> None:
        self._writer._get_file_writer().add_summary(summary, step)

    def _scalars(self, values: Mapping[str, float], step: int) -> None:
        entries = [Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()]
        self._add(Summary(value=entries), step)

    def _times(self) -> dict[str, float]:
        now, cpu = time.perf_counter(), time.process_time()
        return {"time/seconds": now - self._start, "time/cpu_seconds": cpu - self._cpu_start}

    def stage_started(self, name: str, smoothing: float | None, index: int) -> None:
        self._stage = index
        self._writer.add_text("stage/started", f"{name}, ρ = {smoothing}" if smoothing else name, self._step)

    def iteration(self, record: Record, look: Look) -> None:
        self._step = int(record.get("global_step", self._step + 1))
        norm = float(record["norm"])
        values = {"residual/total": norm}
        if norm > 0:  # charts are linear until somebody clicks
            values["residual/log10_total"] = math.log10(norm)
        values |= {f"residual/{name}": float(norm) for name, norm in look.blocks().items()}
        values |= {f"optim/{name}": float(record[name]) for name in OPTIM_TAGS if name in record}
        values["stage/index"] = float(self._stage)
        smoothing = record.get("smoothing")
        if smoothing is not None:
            values["stage/smoothing"] = float(smoothing)
        values |= self._times()
        value = look.cost()
        if math.isfinite(value):
            values[self._cost_tag] = value
        values |= {f"error/{name}": float(record[f"error_{name}"]) for name in ERRORS if f"error_{name}" in record}
        self._scalars(values, self._step)

    def stage_ended(self, stage: StageResult) -> None:
        if stage.solution is not None:
            self._figures.append((self._step, stage.solution))
        values = {
            "stage/norm": stage.norm,
            "stage/off_node_residual": stage.off_node_residual,
            "stage/iterations": float(stage.n_iterations),
            "stage/cpu_seconds": stage.cpu_seconds,
        }
        if math.isfinite(stage.cost):
            values[self._cost_tag] = self._cost = stage.cost
        self._scalars(values, self._step)
        self._writer.flush()

    def solution(self, solution: Solution) -> None:
        self._cost = solution.cost

    def certificate(self, certificate: Certificate) -> None:
        self._judged = True
        judged = ((name, getattr(certificate, name)) for name in JUDGED)
        values = {f"certificate/{name}": float(value) for name, value in judged if value is not None}
        self._scalars(values | self._times(), self._step)
        self._writer.add_text("certificate", f"```\n{certificate.to_text()}\n```", self._step)
        self._writer.flush()

    def failed(self, reason: str) -> None:
        self._failed = True
        self._writer.add_text("failure", reason, self._step)

    def close(self) -> None:
        """Draw the stages' figures, which would have slowed the run down, and end the session.

        A run that was never judged gets a 0 for its certificate and the cost that it reached, so that HPARAMS ranks it.
        """
        if not self._judged:
            cost = {"certificate/cost": self._cost} if math.isfinite(self._cost) else {}
            self._scalars({"certificate/certified": 0.0, **cost}, self._step)
        for step, solution in self._figures:
            image = io.BytesIO()
            figure = stage_figure(solution)
            figure.savefig(image, format="png", dpi=80)
            width, height = figure.canvas.get_width_height()
            picture = Summary.Image(height=height, width=width, colorspace=4, encoded_image_string=image.getvalue())
            self._add(Summary(value=[Summary.Value(tag="stage/control", image=picture)]), step)
        if not self._failed:  # what torch prepares says success; a session without an end reads as unknown
            self._add(self._end, self._step)
        self._writer.close()


def _finite(values: Mapping[str, Any]) -> dict[str, float]:
    """The numbers of nested mappings, as tags."""
    flat = flatten(values).items()
    return {name.replace(".", "/"): float(value) for name, value in flat if isinstance(value, bool | int | float)}


class Scalars:
    """Numbers of nested mappings under their dotted names, with hyperparameters in the same writer."""

    def __init__(self, folder: Path, settings: Mapping[str, Any], metrics: tuple[str, ...]) -> None:
        self._writer = SummaryWriter(str(folder), flush_secs=10)
        experiment, begin, self._end = hparams(_hyperparameters(settings), dict.fromkeys(metrics, 0.0))
        for summary in (experiment, begin):
            self._writer._get_file_writer().add_summary(summary, 0)
        self._step, self._failed = 0, False

    def write(self, values: Mapping[str, Any], step: int) -> None:
        """One event for all numbers of a step."""
        self._step = step
        entries = [Summary.Value(tag=tag, simple_value=value) for tag, value in _finite(values).items()]
        self._writer._get_file_writer().add_summary(Summary(value=entries), step)

    def failed(self, reason: str) -> None:
        self._failed = True
        self._writer.add_text("failure", reason, self._step)

    def close(self) -> None:
        if not self._failed:
            self._writer._get_file_writer().add_summary(self._end, self._step)
        self._writer.close()
