"""Evidence on a failed solve: is the fixed final time shorter than the shortest one, or the control too weak for it?

The minimum-time twin of a problem has its dynamics, ends and controls, a free final time, and that time as the cost.
The least-control twin keeps the time too, and makes the multiple of the control's bounds that it takes the cost: a
transfer of few revolutions in a long time needs more thrust than one in its shortest time. Where the certified extremal
of a twin takes more than the problem allows, the problem is called infeasible unless a quicker, or weaker, one exists:
an extremal satisfies necessary conditions, and there may be several, so this is evidence and not a proof. Where the
least control is within the bounds, the problem is feasible; where a twin is not certified itself, nothing is claimed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ponn_torch.optimal_control.control_laws import Bounded
from ponn_torch.optimal_control.problem import DisplayUnit, FreeTime, Named, OptimalControlProblem
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.split import Split

MULTIPLE = "multiple_of_the_bounds"  # the least-control twin's further state


@dataclass(frozen=True)
class Feasibility:
    """What the minimum-time twin says; times in s.

    Attributes:
        final_time: the fixed one. minimum_time: that of the twin's certified extremal, locally the shortest at best;
            None where it has none.
        cpu_seconds: of the twin, its certificate apart.
        clock: the unit that the message is written in.
    """

    final_time: float
    minimum_time: float | None
    cpu_seconds: float
    clock: DisplayUnit

    @property
    def infeasible(self) -> bool:
        """As far as the extremal found tells."""
        return self.minimum_time is not None and self.minimum_time > self.final_time

    @property
    def message(self) -> str:
        if self.minimum_time is None:
            return "whether it is feasible is not known: its minimum-time problem was not certified either"
        least, given = (
            f"{t / self.clock.size:.8g} {self.clock.label}".rstrip() for t in (self.minimum_time, self.final_time)
        )
        if self.infeasible:
            found = f"the minimum-time extremal found (certified) takes {least}, more than final_time = {given}"
            return f"infeasible unless a quicker one exists: {found}"
        return f"not for want of time: a minimum-time extremal (certified) takes {least}, final_time = {given}"


@dataclass(frozen=True)
class ControlNeeded:
    """What the least-control twin says.

    Attributes:
        name: the control. allowed: its largest bound, SI. needed: that bound in the twin's certified extremal, locally
            the least at best; None where it has none.
        cpu_seconds: of the twin, its certificate apart.
        unit: the unit that the message is written in.
    """

    name: str
    allowed: float
    needed: float | None
    cpu_seconds: float
    unit: DisplayUnit

    @property
    def infeasible(self) -> bool:
        """As far as the extremal found tells."""
        return self.needed is not None and self.needed > self.allowed

    @property
    def message(self) -> str:
        if self.needed is None:
            return f"how much {self.name} it needs is not known: its least-control problem was not certified either"
        least, given = (f"{u / self.unit.size:.8g} {self.unit.label}".rstrip() for u in (self.needed, self.allowed))
        if self.infeasible:
            found = f"the least-control extremal found (certified) needs {self.name} up to {least}, more than {given}"
            return f"infeasible unless another extremal needs less: {found}"
        return f"not for want of {self.name}: an extremal (certified) needs no more than {least} of {given}"


def minimum_time_twin(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same dynamics, ends and controls, as fast as possible.

    Raises:
        ValueError: a control without bounds, with which any time is long enough, or several controls.
    """
    if not isinstance(problem.control, Bounded):
        raise ValueError(
            f"{problem.name}: its control is not one set with bounds, so that there may be no minimum time"
        )
    time = problem.unit("time")
    return replace(
        problem,
        name=f"{problem.name}_minimum_time",
        description=f"{problem.description or problem.name}: as fast as possible",
        running_cost=_one,
        terminal_cost=None,
        final_time=FreeTime(problem.time_guess),
        units={**problem.units, "cost": time},
        costate_units=_costate_units(problem, time, time),  # as H = 1 + λᵀf vanishes
        cost_name="time",
        known_cost=None,
        display={**problem.display, "cost": problem.display.get("time", DisplayUnit("s"))},
    )


def least_control_twin(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same dynamics, ends and time, with the control's bounds multiplied by a constant, the least that will do.

    The multiple is a further state, free at both ends. It is paid once, so the unit of cost is a time unit's share of
    it; otherwise the smoothing, which is paid all the time, would outweigh it. An extremal with a negative multiple,
    where an engine is a source of propellant, answers nothing.

    Raises:
        ValueError: a control without bounds, or whose bounds exclude zero, so that they cannot shrink towards it; or
            several controls.
    """
    law = problem.control
    if not isinstance(law, Bounded):
        raise ValueError(f"{problem.name}: its control is not one set with bounds, which could shrink")
    low, high = _bounds(problem)
    if not _include_zero(low, high):
        least, most = (", ".join(f"{value:g}" for value in bound.flatten().tolist()) for bound in (low, high))
        raise ValueError(f"{problem.name}: {law.name} from {least} to {most}; allowed: bounds that include zero")

    def dynamics(t: Tensor, x: Named, u: Named, p: Named) -> dict[str, Tensor]:
        multiple = getattr(x, MULTIPLE)
        enlarged = Named(**{name: multiple * value for name, value in vars(u).items()})
        return {**problem.dynamics(t, x, enlarged, p), MULTIPLE: torch.zeros_like(t)}

    time = problem.time_guess
    return replace(
        problem,
        name=f"{problem.name}_least_control",
        description=f"{problem.description or problem.name}: with as little control as possible",
        states={**problem.states, MULTIPLE: 1},
        dynamics=dynamics,
        running_cost=None,
        terminal_cost=lambda t, x, p: getattr(x, MULTIPLE),
        units={**problem.units, MULTIPLE: 1.0, "cost": problem.unit("time") / time},
        costate_units={**_costate_units(problem, 1.0, time), MULTIPLE: 1.0},
        cost_name="multiple of the bounds",
        known_cost=None,
        display={**problem.display, "cost": DisplayUnit("")},
    )


def _one(t: Tensor, x: Named, u: Named, p: Named) -> Tensor:
    return torch.ones_like(t)


def _costate_units(problem: OptimalControlProblem, cost: float, time: float) -> dict[str, float]:
    """λ of the order of the cost over what full control changes in a time."""
    strength = _control_strength(problem) * time / problem.unit("time")
    return {name: cost / problem.unit(name) / (1.0 if name == problem.mass else strength) for name in problem.states}


def _bounds(problem: OptimalControlProblem) -> tuple[Tensor, Tensor]:
    """Minimum and maximum (), or (size,) where components differ."""
    assert isinstance(problem.control, Bounded)
    low, high = problem.control.bounds(Named(**problem.parameters), torch.zeros((), dtype=torch.float64))
    return torch.as_tensor(low, dtype=torch.float64), torch.as_tensor(high, dtype=torch.float64)


def _include_zero(low: Tensor, high: Tensor) -> bool:
    return bool(((low <= 0) & (high >= 0)).all())


def _largest(low: Tensor, high: Tensor) -> Tensor:
    return torch.maximum(low.abs(), high.abs())


def _control_strength(problem: OptimalControlProblem) -> float:
    """The largest change of a state but the mass, in its unit, that full control makes in a unit of time."""
    law, time = problem.control, problem.unit("time")
    assert isinstance(law, Bounded)
    start = [problem.unit(n) for n, size in problem.states.items() for _ in range(size)]
    start = [unit if value is None else value for value, unit in zip(problem.boundary("initial"), start, strict=True)]
    x = torch.tensor([start], dtype=torch.float64)
    t = torch.zeros_like(x[:, :1])
    p = Named(**{name: torch.full_like(t, value) for name, value in problem.parameters.items()})
    full_control = _largest(*_bounds(problem))
    least = {name: torch.zeros(1, size, dtype=torch.float64) for name, size in law.names.items()}

    def rates(control: Tensor) -> dict[str, Tensor]:
        u = Named(**{**least, law.name: control})
        return dict(problem.dynamics(t, problem.named(x), u, p))

    off = rates(least[law.name])
    full = rates(least[law.name] + full_control)
    changes = [
        float((full[name] - off[name]).abs().max()) * time / problem.unit(name)
        for name in problem.states
        if name != problem.mass
    ]
    return max(changes) or 1.0


def check_final_time(problem: OptimalControlProblem, solver: Solver, seed: int = 0) -> Feasibility | None:
    """Solve the minimum-time twin with the same solver; None where the question does not arise.

    That is: a final time that is free, or a control that is not one set with bounds.
    """
    if problem.free_final_time or not isinstance(problem.control, Bounded):
        return None
    solution, seconds = _solved(minimum_time_twin(problem), solver, seed)
    return Feasibility(
        final_time=problem.time_guess,
        minimum_time=None if solution is None else solution.final_time,
        cpu_seconds=seconds,
        clock=problem.display.get("time", DisplayUnit("s")),
    )


def check_control(problem: OptimalControlProblem, solver: Solver, seed: int = 0) -> ControlNeeded | None:
    """Solve the least-control twin with the same solver; None where the question does not arise.

    That is: a final time that is free, or a control that is not one set with bounds, or whose bounds exclude zero.
    """
    law = problem.control
    if problem.free_final_time or not isinstance(law, Bounded):
        return None
    low, high = _bounds(problem)
    if not _include_zero(low, high):
        return None
    solution, seconds = _solved(least_control_twin(problem), solver, seed)
    allowed = float(_largest(low, high).max())
    return ControlNeeded(
        name=law.name,
        allowed=allowed,
        needed=None if solution is None or solution.cost <= 0 else solution.cost * allowed,
        cpu_seconds=seconds,
        unit=problem.display.get(law.name, DisplayUnit("")),
    )


def _solved(twin: OptimalControlProblem, solver: Solver, seed: int) -> tuple[Solution | None, float]:
    """The certified extremal of a twin, if there is one, and CPU seconds."""
    given = solver.refinement
    refinement = given if given is not None and given.exact and given.reads_arcs else Split()
    result = replace(solver, refinement=refinement, dtype=torch.float64).solve(twin, seed)
    return result.solution if result.certified else None, result.cpu_seconds
