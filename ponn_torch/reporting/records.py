"""A run folder that records itself: progress on the terminal, records.jsonl, TensorBoard.

The conductor calls one observer, ``RunRecorder``; it counts iterations over all stages, evaluates what is
costly at most once, and hands each event on to its recorders. They write the same whatever the optimiser is.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from ponn_torch.optim.base import Record
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.reporting.progress import Progress
from ponn_torch.reporting.recorder import Recorder, finite_or_none, stage_entry
from ponn_torch.reporting.reference import Reference
from ponn_torch.solving.certificate import Certificate
from ponn_torch.solving.observer import Look
from ponn_torch.solving.result import StageResult
from ponn_torch.solving.solution import Solution

if TYPE_CHECKING:
    from typing import Self

    from rich.console import Console

RECORDS = "records.jsonl"


class JsonLines(Recorder):
    """One line an event, written through at once, so that an interrupted run keeps all it had.

    Every line has ``event``: stage_started, iteration, stage, certificate, failure.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = path.open("w", encoding="utf-8", buffering=1)

    def write(self, event: str, **values: Any) -> None:
        line = {"event": event} | values
        try:
            text = json.dumps(line, allow_nan=False)
        except (ValueError, TypeError):
            text = json.dumps(finite_or_none(line), allow_nan=False)
        self._stream.write(text + "\n")

    def stage_started(self, name: str, smoothing: float | None, index: int) -> None:
        self.write("stage_started", name=name, smoothing=smoothing, index=index)

    def iteration(self, record: Record, look: Look) -> None:
        value = look.cost()
        known = {"cost": value} if math.isfinite(value) else {}
        self.write("iteration", **record, residual=dict(look.blocks()), **known)

    def stage_ended(self, stage: StageResult) -> None:
        self.write("stage", **stage_entry(stage))

    def certificate(self, certificate: Certificate) -> None:
        self.write("certificate", **certificate.to_dict())

    def failed(self, reason: str) -> None:
        self.write("failure", reason=reason)

    def close(self) -> None:
        self._stream.close()


def recorded(path: Path) -> dict[int, dict[str, Any]]:
    """Iterations of records.jsonl by their step; a last line that was cut off is left out."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    found = {}
    for line in lines:
        if line.endswith("}") and line.startswith('{"event": "iteration"'):
            record = json.loads(line)
            found[int(record["global_step"])] = record
    return found


class _Once:
    """A look that measures at most once, and what is dear only when due."""

    def __init__(self, look: Look, due: bool) -> None:
        self.blocks = functools.cache(look.blocks)
        self.cost = functools.cache(look.cost if due else lambda: math.nan)
        self.curve = look.curve


class _Told:
    """A look at an iteration of an earlier process, as its line in records.jsonl has it."""

    def __init__(self, line: Mapping[str, Any]) -> None:
        self._line = line

    def blocks(self) -> Mapping[str, float]:
        return self._line["residual"]

    def cost(self) -> float:
        return float(self._line.get("cost", math.nan))

    def curve(self) -> Curve:
        raise NotImplementedError("its unknowns were not kept")


class RunRecorder(Recorder):
    """Records one run in ``folder``; use it as a context manager, or call ``close``.

    Attributes:
        step: iterations so far, over all stages and starts: the global step of every record.
        recorders: to whom events are handed on; ``extra`` ones come last.

    Args:
        settings: what the run was set to, for TensorBoard's HPARAMS; nested mappings are flattened.
        tensorboard, progress: whether to write event files, and whether to print.
        cost_name: the problem's, for the tag cost/<cost_name>.
        cost_every: the cost is an integral, dearer than an iteration, so it is taken at every n-th
            iteration only, and at stage ends (0: only there).
        replay: iterations by their step as an earlier process recorded them, for a run that is taken up again:
            what was costly is not evaluated twice.
        reference: a known solution; errors against it are taken whenever the cost is.
        figures: small figures of every stage in TensorBoard, drawn when the run is closed.
    """

    def __init__(
        self,
        folder: Path | str,
        *,
        settings: Mapping[str, Any] | None = None,
        cost_name: str = "cost",
        tensorboard: bool = True,
        progress: bool = True,
        cost_every: int = 50,
        figures: bool = True,
        reference: Reference | None = None,
        replay: Mapping[int, Mapping[str, Any]] | None = None,
        console: Console | None = None,
        extra: tuple[Recorder, ...] = (),
    ) -> None:
        if cost_every < 0:
            raise ValueError(f"cost_every = {cost_every}; allowed: 0 (at stage ends only) or a number of iterations")
        self.folder, self.step, self._cost_every = Path(folder), 0, cost_every
        self.folder.mkdir(parents=True, exist_ok=True)
        self.recorders: list[Recorder] = [JsonLines(self.folder / RECORDS)]
        if tensorboard:
            # only here: its import takes longer than a small solve
            from ponn_torch.reporting.events import TensorBoard

            self.recorders.append(
                TensorBoard(self.folder, settings=settings or {}, cost_name=cost_name, figures=figures)
            )
        if progress:
            self.recorders.append(Progress(console))
        self.recorders.extend(extra)
        self._stage: dict[str, Any] = {}
        self._reference, self._replay = reference, replay or {}
        self._closed = False

    def stage_started(self, name: str, smoothing: float | None, index: int) -> None:
        self._stage = {"stage": name, "smoothing": smoothing}
        for recorder in self.recorders:
            recorder.stage_started(name, smoothing, index)

    def iteration(self, record: Record, look: Look) -> None:
        self.step += 1
        due = self._cost_every > 0 and self.step % self._cost_every == 0
        numbered = {"global_step": self.step, **self._stage, **record}
        told = self._replay.get(self.step)
        if told is not None and told["norm"] == record["norm"]:
            look, due = _Told(told), True
            numbered |= {name: value for name, value in told.items() if name.startswith("error_")}
        elif due and self._reference is not None:
            numbered |= {f"error_{name}": error for name, error in self._reference.errors(look.curve()).items()}
        once = _Once(look, due)
        for recorder in self.recorders:
            recorder.iteration(numbered, once)

    def stage_ended(self, stage: StageResult) -> None:
        for recorder in self.recorders:
            recorder.stage_ended(stage)

    def solution(self, solution: Solution) -> None:
        for recorder in self.recorders:
            recorder.solution(solution)

    def certificate(self, certificate: Certificate) -> None:
        for recorder in self.recorders:
            recorder.certificate(certificate)

    def failed(self, reason: str) -> None:
        for recorder in self.recorders:
            recorder.failed(reason)

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        for recorder in self.recorders:
            recorder.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
