"""A run in its folder: settings and outcome are written, failures keep their reason, whatever ends the run."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from omegaconf import OmegaConf

from ponn_torch.reporting.members import OUTCOME
from ponn_torch.reporting.recorder import finite_or_none
from ponn_torch.reporting.records import RECORDS
from ponn_torch.reporting.report import (
    CERTIFICATE,
    ENVIRONMENT,
    FAILURE,
    FAILURE_TEXT,
    FIGURES,
    REPORT,
    write_failure,
)
from ponn_torch.settings import ConfigError, one_line
from ponn_torch.solving.solution import SOLUTION

DONE, BAD_INPUT, NOT_CERTIFIED, BUG, INTERRUPTED = 0, 1, 2, 3, 130
CONFIG, OVERRIDES, CHECKPOINTS = "config.yaml", "overrides.yaml", "checkpoints"
FILES = (CONFIG, OVERRIDES, OUTCOME, RECORDS, REPORT, ENVIRONMENT, CERTIFICATE, FAILURE, FAILURE_TEXT)


@dataclass(frozen=True)
class Outcome:
    """How a run ended, as outcome.json says it; cost in the user's units, times in s."""

    exit_code: int
    message: str
    certified: bool = False
    cost: float | None = None
    known_cost: float | None = None
    final_time: float | None = None
    switch_times: list[float] = field(default_factory=list)
    arcs: list[str] = field(default_factory=list)
    n_starts: int = 0
    cpu_seconds: float = 0.0
    overrides: list[str] = field(default_factory=list)

    @property
    def score(self) -> float:
        """What a sweep optimises: the cost of a certified solution, else infinity."""
        return self.cost if self.certified and self.cost is not None else math.inf


class Job(Protocol):
    """What a run does in its folder, in the order of these calls; only the first two may be left out by a failure."""

    def prepare(self) -> Mapping[str, Any]:
        """Build what the config asks for; the settings, resolved. Raises ConfigError."""

    def work(self) -> Outcome:
        """Compute."""

    def completed(self, outcome: Outcome) -> Outcome:
        """The outcome with what was found, also after a failure."""

    def keep(self, outcome: Outcome) -> None:
        """Save what was found and write the report."""

    def screen(self, outcome: Outcome, seconds: float) -> str:
        """What a person wants to see at the end."""


def run_job(
    job: Job,
    folder: Path,
    overrides: Sequence[str],
    *,
    resume: bool = False,
    slip: Callable[[BaseException], str | None] = lambda error: None,
) -> Outcome:
    """Leave a complete folder; raises for nothing that happens in between. ``resume`` keeps its checkpoints.

    ``slip`` says where in a user's own code an error was made, if it was: that is bad input, any other one a bug.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _clear(folder, (SOLUTION, FIGURES) if resume else (SOLUTION, FIGURES, CHECKPOINTS))
    began = time.process_time()
    error: BaseException | None = None
    try:
        _write_text(folder / OVERRIDES, OmegaConf.to_yaml(OmegaConf.create(list(overrides))))
        _write_text(folder / CONFIG, OmegaConf.to_yaml(OmegaConf.create(dict(job.prepare()))))
        outcome = job.work()
    except ConfigError as wrong:
        outcome = Outcome(BAD_INPUT, str(wrong))
    except KeyboardInterrupt:
        outcome = Outcome(INTERRUPTED, "interrupted; what was computed so far is kept")
    except Exception as bug:
        error, told, place = bug, f"{type(bug).__name__}: {one_line(bug)}", slip(bug)
        outcome = Outcome(BUG, told) if place is None else Outcome(BAD_INPUT, f"{place}: {told}")
    spent = time.process_time() - began
    outcome = replace(job.completed(outcome), overrides=list(overrides), cpu_seconds=spent)
    if outcome.exit_code != DONE:
        write_failure(folder, outcome.message, error)
    outcome = _surviving(folder, outcome, lambda: job.keep(outcome))
    _write_text(folder / OUTCOME, json.dumps(finite_or_none(asdict(outcome)), indent=2, ensure_ascii=False) + "\n")
    print(job.screen(outcome, time.process_time() - began), flush=True)
    return outcome


def _surviving(folder: Path, outcome: Outcome, keep: Callable[[], None]) -> Outcome:
    """The outcome, changed where keeping what was found went wrong."""
    try:
        keep()
    except Exception as bug:
        outcome = replace(outcome, exit_code=BUG, message=f"{type(bug).__name__}: {one_line(bug)}")
        write_failure(folder, outcome.message, bug)
    except KeyboardInterrupt:
        outcome = replace(outcome, exit_code=INTERRUPTED, message="interrupted while the report was written")
        write_failure(folder, outcome.message)
    return outcome


def _clear(folder: Path, below: Sequence[str]) -> None:
    """Remove what an earlier run left here, and nothing else."""
    if not (folder / OUTCOME).exists() and not (folder / RECORDS).exists():
        return
    for name in FILES:
        (folder / name).unlink(missing_ok=True)
    for events in folder.glob("events.out.tfevents.*"):
        events.unlink()
    for name in below:
        shutil.rmtree(folder / name, ignore_errors=True)


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
