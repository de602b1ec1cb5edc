"""Progress on the terminal: a live line for the iteration, a plain line for every stage."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from ponn_torch.optim.base import Record
from ponn_torch.reporting.recorder import Recorder
from ponn_torch.solving.certificate import Certificate
from ponn_torch.solving.observer import Look
from ponn_torch.solving.result import StageResult
from ponn_torch.solving.solution import Solution

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Bar

REFRESH_SECONDS = 0.2  # drawing a line takes a few ms, an iteration too


def _smoothing(value: float | None) -> str:
    return "" if value is None else f"ρ {value:<8.3g}"


class Progress(Recorder):
    """Prints a line per stage; on a terminal also a live line with iteration, residual and cost."""

    def __init__(self, console: Console | None = None) -> None:
        # rich draws from Python's random generator when it is imported, and importing this package must not
        from rich.console import Console
        from rich.progress import Progress as Bar
        from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

        self._console = console or Console()
        self._unit, self._shown = "", 0.0
        self._cost = math.nan
        self._bar: Bar | None = None
        if self._console.is_terminal:
            self._bar = Bar(
                SpinnerColumn(),
                TextColumn("{task.description}", markup=False),
                TimeElapsedColumn(),
                console=self._console,
                auto_refresh=False,
                transient=True,
            )
            self._task = self._bar.add_task("starting", total=None)
            self._bar.start()

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def _live(self, text: str) -> None:
        now = time.monotonic()
        if self._bar is not None and now - self._shown > REFRESH_SECONDS:
            self._shown = now
            self._bar.update(self._task, description=text, refresh=True)

    def stage_started(self, name: str, smoothing: float | None, index: int) -> None:
        self._live(f"{name:7} {_smoothing(smoothing)}")

    def iteration(self, record: Record, look: Look) -> None:
        if self._bar is None:
            return
        value = look.cost()
        self._cost = value if math.isfinite(value) else self._cost
        known = f"  cost {self._cost:.7g}" if math.isfinite(self._cost) else ""
        smoothing = record.get("smoothing")
        stage = f"{record.get('stage', '')!s:7} {_smoothing(None if smoothing is None else float(smoothing))}"
        self._live(f"{stage} iteration {int(record['iteration']):4d}  ‖r‖ {record['norm']:.2e}{known}")

    def stage_ended(self, stage: StageResult) -> None:
        self._cost = stage.cost
        cost = f"  cost {stage.cost:.9g}" if math.isfinite(stage.cost) else ""
        off = f"  off nodes {stage.off_node_residual:.1e}" if math.isfinite(stage.off_node_residual) else ""
        self._print(
            f"start {stage.start + 1}  {stage.name:7} {_smoothing(stage.smoothing):10}"
            f" {stage.n_iterations:4d} iterations  ‖r‖ {stage.norm:.2e}{off}{cost}"
            f"  {stage.cpu_seconds:.2f} s  {stage.status.name.lower()}"
        )

    def solution(self, solution: Solution) -> None:
        self._live("flying the control …")

    def certificate(self, certificate: Certificate) -> None:
        self._print(certificate.verdict)

    def failed(self, reason: str) -> None:
        self._print(f"failed: {reason}")

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
