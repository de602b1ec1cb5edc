"""Evidence on a failed solve: is the fixed final time shorter than the shortest one?

The minimum-time twin of a problem has its dynamics, ends and controls, a free final time, and that time as the cost.
Where its certified extremal takes longer than the problem allows, the problem is called infeasible unless a quicker
one exists: an extremal satisfies necessary conditions, and there may be several, so this is evidence and not a proof.
Where it takes less, the problem is feasible; where it is not certified itself, nothing is claimed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ponn_torch.optimal_control.control_laws import Bounded
from ponn_torch.optimal_control.problem import DisplayUnit, FreeTime, Named, OptimalControlProblem
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.split import Split


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


def minimum_time_twin(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same dynamics, ends and controls, as fast as possible.

    Raises:
        ValueError: a control without bounds, with which any time is long enough.
    """
    if not isinstance(problem.control, Bounded):
        raise ValueError(f"{problem.name}: its control has no bounds, so that there is no minimum time")
    time = problem.unit("time")
    # H = 1 + λᵀf vanishes, so λ is of the order of one over what the control changes
    strength = _control_strength(problem)
    costate_units = {
        name: time / problem.unit(name) / (1.0 if name == problem.mass else strength) for name in problem.states
    }
    return replace(
        problem,
        name=f"{problem.name}_minimum_time",
        description=f"{problem.description or problem.name}: as fast as possible",
        running_cost=_one,
        terminal_cost=None,
        final_time=FreeTime(problem.time_guess),
        units={**problem.units, "cost": time},
        costate_units=costate_units,
        cost_name="time",
        known_cost=None,
        display={**problem.display, "cost": problem.display.get("time", DisplayUnit("s"))},
    )


def _one(t: Tensor, x: Named, u: Named, p: Named) -> Tensor:
    return torch.ones_like(t)


def _control_strength(problem: OptimalControlProblem) -> float:
    """The largest change of a state but the mass, in its unit, that full control makes in a unit of time."""
    law, time = problem.control, problem.unit("time")
    assert isinstance(law, Bounded)
    start = [problem.unit(n) for n, size in problem.states.items() for _ in range(size)]
    start = [unit if value is None else value for value, unit in zip(problem.boundary("initial"), start, strict=True)]
    x = torch.tensor([start], dtype=torch.float64)
    t = torch.zeros_like(x[:, :1])
    p = Named(**{name: torch.full_like(t, value) for name, value in problem.parameters.items()})
    low, high = law.bounds(p)
    least = {name: torch.zeros(1, size, dtype=torch.float64) for name, size in law.names.items()}

    def rates(control: Tensor) -> dict[str, Tensor]:
        u = Named(**{**least, law.name: control})
        return dict(problem.dynamics(t, problem.named(x), u, p))

    off = rates(least[law.name])
    full = rates(least[law.name] + torch.maximum(torch.as_tensor(high).abs(), torch.as_tensor(low).abs()))
    changes = [
        float((full[name] - off[name]).abs().max()) * time / problem.unit(name)
        for name in problem.states
        if name != problem.mass
    ]
    return max(changes) or 1.0


def check_final_time(problem: OptimalControlProblem, solver: Solver, seed: int = 0) -> Feasibility | None:
    """Solve the minimum-time twin with the same solver; None where the question does not arise.

    That is: a final time that is free, or a control without bounds.
    """
    if problem.free_final_time or not isinstance(problem.control, Bounded):
        return None
    given = solver.refinement
    refinement = given if given is not None and given.exact and given.reads_arcs else Split()
    twin = replace(solver, refinement=refinement, n_certified=1)
    result = twin.solve(minimum_time_twin(problem), seed)
    certified = result.solution if result.certified else None
    return Feasibility(
        final_time=problem.time_guess,
        minimum_time=None if certified is None else certified.final_time,
        cpu_seconds=result.cpu_seconds,
        clock=problem.display.get("time", DisplayUnit("s")),
    )
