"""What decides the control at the start of a cycle: a horizon solved on the spot, or an affine gain schedule."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from ponn_torch.guidance.expansion import expand
from ponn_torch.guidance.horizon import AffineHorizon
from ponn_torch.guidance.producers import Plan, Planner
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.optimal_control.problem import nearest


@dataclass(frozen=True, eq=False)
class Decision:
    """control (..., m), as wanted, before the actuators' reach; loss (...,) and passes of the horizon solved.

    plan: what would be done if the next decision came too late, None where there is only a gain.
    """

    control: Tensor
    loss: Tensor
    passes: int = 1
    plan: Plan | None = None


class Controller(Protocol):
    def decide(self, cycle: int, x: Tensor) -> Decision:
        """At the start of a cycle, from states (..., n)."""
        ...


# -- the last horizons -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Timetable:
    """When cycles start and how long their horizons are, in the plant's time."""

    starts: list[float]
    durations: list[float]


def _stop(problem: TrackingProblem) -> Timetable:
    # the last horizon ends at the final time
    count = math.floor((problem.final_time - problem.horizon) / problem.cycle + 1e-9)
    starts = [k * problem.cycle for k in range(count)]
    return Timetable(starts, [problem.horizon] * count)


def _shrink(problem: TrackingProblem) -> Timetable:
    count = math.floor(problem.final_time / problem.cycle + 1e-9)
    starts = [k * problem.cycle for k in range(count)]
    return Timetable(starts, [min(problem.horizon, problem.final_time - t) for t in starts])


def _extend(problem: TrackingProblem) -> Timetable:
    # a reference that is held at its end may be looked at beyond it
    starts = _shrink(problem).starts
    return Timetable(starts, [problem.horizon] * len(starts))


ENDINGS: dict[str, Callable[[TrackingProblem], Timetable]] = {"stop": _stop, "shrink": _shrink, "extend": _extend}


def timetable(problem: TrackingProblem, ending: str) -> Timetable:
    """``stop`` when a horizon reaches the final time, ``shrink`` horizons from there on, or ``extend`` beyond it.

    Raises ValueError for another ending, and where no cycle is left.
    """
    if ending not in ENDINGS:
        raise ValueError(f"ending = {ending!r}; {nearest(ending, ENDINGS)}")
    table = ENDINGS[ending](problem)
    if not table.starts:
        unit = problem.plant.time
        raise ValueError(
            f"horizon = {problem.horizon / unit.size:g} {unit.label} with ending 'stop'; allowed: at most the final "
            f"time less a cycle, {(problem.final_time - problem.cycle) / unit.size:g}"
        )
    return table


# -- controllers -------------------------------------------------------------------------------------


class HorizonController:
    """Plans a horizon every cycle; the last plan is where a warm start begins."""

    def __init__(self, planner: Planner, table: Timetable) -> None:
        self.planner, self.table = planner, table
        self._last: Plan | None = None

    def decide(self, cycle: int, x: Tensor) -> Decision:
        plan = self.planner.plan(self.table.starts[cycle], x, self.table.durations[cycle], self._last)
        self._last = plan
        return Decision(plan.control, plan.solution.loss, plan.passes, plan)


@dataclass(frozen=True, eq=False)
class GainSchedule:
    """u = offset + gain (x − origin), one per cycle: exactly what planning with one pass around the reference gives.

    gain (C, m, n), offset (C, m), origin (C, n). horizons: the solved horizons behind it, one batch with their
    matrices (C, R, R), from which losses are told if ``with_loss``; that costs more than the control itself.
    """

    gain: Tensor
    offset: Tensor
    origin: Tensor
    horizons: AffineHorizon
    matrices: Tensor
    with_loss: bool = True

    def decide(self, cycle: int, x: Tensor) -> Decision:
        control = (x - self.origin[cycle]) @ self.gain[cycle].mT + self.offset[cycle]
        loss = self.loss(cycle, x) if self.with_loss else torch.full(x.shape[:-1], torch.nan, dtype=x.dtype)
        return Decision(control, loss)

    def loss(self, cycle: int, x: Tensor) -> Tensor:
        """‖equations β − right side‖₂ (...,) of the coefficients that the schedule stands for."""
        all_, problem = self.horizons, self.horizons.problem
        offset = None if problem.terminal_offset is None else problem.terminal_offset[cycle]
        here = replace(
            problem,
            matrix=problem.matrix[cycle],
            drift=problem.drift[cycle],
            duration=1.0,  # not in the right side
            initial=x,
            terminal_offset=offset,
        )
        change = (x - self.origin[cycle]) @ all_.gain[cycle].flatten(0, 1).mT
        difference = (change + all_.about[cycle].flatten()) @ self.matrices[cycle].mT - all_.solver.right_side(here)
        return torch.linalg.vector_norm(difference, dim=-1)


def gain_schedule(planner: Planner, table: Timetable, *, with_loss: bool = True) -> GainSchedule:
    """All cycles' horizons in one batch, expanded around the reference.

    Raises ValueError where planning takes several passes and the plant is not linear: no gain is then exact.
    """
    problem = planner.problem
    if not planner.affine:
        raise ValueError(
            f"most = {planner.passes.most} with a gain schedule of {problem.plant.name}, which is not linear; "
            "allowed: 1"
        )
    starts, durations = (problem.initial.new_tensor(values) for values in (table.starts, table.durations))
    t = planner.times(starts, durations)
    x, u = problem.reference(t)
    expansion = expand(problem, t, x, u)
    factored = planner.solver.factor(planner.linear(expansion, starts, durations, x[:, 0]))
    affine = factored.affine()
    matrix, offset = affine.values(planner.points[:1])
    gain = expansion.control_gain[:, 0]
    control = (gain @ offset[:, 0].unsqueeze(-1)).squeeze(-1) + expansion.control_offset[:, 0]
    return GainSchedule(gain @ matrix[:, 0], control, x[:, 0], affine, factored.matrix, with_loss)
