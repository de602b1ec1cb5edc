"""Continuation: in which order the values of a parameter are tried, and when to stop.

A schedule decides values only. The conductor solves: it is called by ``attempt(value, parameter, form)``, keeps the
warm start, and answers with an Outcome; a failed attempt leaves the last good point as the next start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from ponn_torch.optimal_control.discretisation import Form


class Outcome(Enum):
    """What became of an attempt."""

    SOLVED = "solved"
    UNCHANGED = "solved, and the same as before: smaller values change nothing"
    LEGIBLE = "solved, and sharp enough for what comes next: this schedule is done"
    SHARPEST = "solved, and a smaller value is not to be resolved: this schedule is done"
    UNTRUSTED = "solved at the nodes, but not between them"
    FAILED = "not solved"
    ABORT = "give this start up"

    @property
    def final(self) -> bool:
        """Nothing more of a schedule is to be tried."""
        return self in (Outcome.ABORT, Outcome.LEGIBLE, Outcome.SHARPEST)


class Attempt(Protocol):
    def __call__(self, value: float, parameter: str, form: Form | None, *, hold: bool = False) -> Outcome:
        """Solve at a value; with ``hold``, a stage that is not trusted is no start of the next one."""
        ...


class Schedule(Protocol):
    def run(self, attempt: Attempt) -> None: ...


@dataclass(frozen=True)
class Ladder:
    """A fixed list of values, each tried once from the solution of the one before; failures do not stop it.

    In another parameter than the smoothing it need not end at the problem's own value: a last stage returns to it.

    ``form`` replaces the residual's form for this ladder (a weak form below the node spacing, say);
    ``stop_unchanged`` ends it where a step changes nothing.
    """

    values: Sequence[float]
    form: Form | None = None
    parameter: str = "smoothing"
    stop_unchanged: bool = False

    def __post_init__(self) -> None:
        _check_values(self.parameter, self.values)

    def run(self, attempt: Attempt) -> None:
        for value in self.values:
            outcome = attempt(float(value), self.parameter, self.form)
            if outcome.final or (outcome is Outcome.UNCHANGED and self.stop_unchanged):
                return


def log_ladder(
    first: float = 1.0,
    last: float = 1e-10,
    count: int = 20,
    form: Form | None = None,
    stop_unchanged: bool = False,
) -> Ladder:
    """Logarithmically spaced smoothing; the defaults are the PoNN paper's twenty values from 1 to 1e-10."""
    _check_values("smoothing", (first, last))
    if count < 2:
        raise ValueError(f"count = {count}; allowed: at least 2")
    ratio = math.log(last / first) / (count - 1)
    return Ladder([first * math.exp(ratio * i) for i in range(count)], form, "smoothing", stop_unchanged)


@dataclass(frozen=True)
class Adaptive:
    """Multiply the value by ``factor`` until ``last``; halve the step (in the logarithm) where an attempt fails.

    A stage that is not trusted between the nodes has failed too: the next one starts from the last that is.
    """

    first: float = 1.0
    last: float = 1e-2
    factor: float = 0.3
    max_halvings: int = 4
    form: Form | None = None
    parameter: str = "smoothing"

    def __post_init__(self) -> None:
        _check_values(self.parameter, (self.first, self.last), positive=True)
        if not 0 < self.factor < 1:
            raise ValueError(f"factor = {self.factor}; allowed: between 0 and 1")

    def run(self, attempt: Attempt) -> None:
        outcome = attempt(self.first, self.parameter, self.form)
        if outcome.final or outcome is Outcome.FAILED:
            return
        towards = math.copysign(1.0, math.log(self.last / self.first)) if self.last != self.first else 0.0
        value, halvings = self.first, 0
        while towards * (math.log(self.last) - math.log(value)) > 1e-12:
            step = -math.log(self.factor) / 2**halvings
            exponent = min(step, abs(math.log(self.last / value)))
            outcome = attempt(value * math.exp(towards * exponent), self.parameter, self.form, hold=True)
            if outcome.final or outcome is Outcome.UNCHANGED:
                return
            if outcome is Outcome.SOLVED:
                value, halvings = value * math.exp(towards * exponent), max(0, halvings - 1)
            elif halvings == self.max_halvings:
                return
            else:
                halvings += 1


@dataclass(frozen=True)
class Phases:
    """Schedules one after the other: strong rungs first, then weak ones, then a polish; giving up ends them all."""

    phases: Sequence[Schedule]

    def run(self, attempt: Attempt) -> None:
        gone = False

        def watched(value: float, parameter: str, form: Form | None, *, hold: bool = False) -> Outcome:
            nonlocal gone
            outcome = attempt(value, parameter, form, hold=hold)
            gone = gone or outcome is Outcome.ABORT
            return outcome

        for phase in self.phases:
            phase.run(watched)
            if gone:
                return


@dataclass(frozen=True)
class Single:
    """No continuation: one solve, at ``smoothing`` where the control is bounded."""

    smoothing: float = 1.0
    form: Form | None = None

    def run(self, attempt: Attempt) -> None:
        attempt(self.smoothing, "smoothing", self.form)


def _check_values(parameter: str, values: Sequence[float], positive: bool = False) -> None:
    """Finite values; positive ones for what is divided by or taken the logarithm of."""
    positive = positive or parameter in ("smoothing", "final_time")
    if not values:
        raise ValueError(f"continuation values of {parameter!r}: none given; allowed: at least one")
    for value in values:
        if not math.isfinite(value) or (positive and not value > 0):
            allowed = "positive numbers" if positive else "finite numbers"
            raise ValueError(f"continuation values of {parameter!r}: {value}; allowed: {allowed}")
