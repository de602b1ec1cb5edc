"""What a controller's decisions are worth: the true error of the control at the start of a horizon.

A square system is solved to round-off by any basis, so that its loss tells nothing. Here decisions of a flight are made
again by an oracle, from the same measured states: matrix exponential for linear plants about a fixed point, a fine
Riccati sweep where a horizon is expanded around the reference once, solve_bvp of the nonlinear system otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ponn_torch.guidance.closed_loop import Flight
from ponn_torch.guidance.controllers import Timetable
from ponn_torch.guidance.expansion import expand
from ponn_torch.guidance.oracles import exponential_gain, nonlinear_control, riccati_sweep
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.tracking import Setpoint, TrackingProblem
from ponn_torch.guidance.verdict import FlightCertificate, spread_evenly

Oracle = Callable[[Planner, list[float], list[float], Tensor], Tensor]  # starts, durations, x (S, n) -> u (S, m)
STEPS = 600  # of the sweep: its error is then below 1e-9 of the gain for horizons with fast modes at rate 30/horizon


def by_exponential(planner: Planner, starts: list[float], durations: list[float], x: Tensor) -> Tensor:
    """Constant coefficients: one gain per length of horizon."""
    problem, zero = planner.problem, x.new_zeros(1)
    made = expand(problem, zero, *problem.reference(zero))
    terminal, offset = _terminal(problem, zero[0])
    gains = {
        length: exponential_gain(made.matrix[0], made.drift[0], length, terminal, offset) for length in set(durations)
    }
    costates = torch.stack(
        [gains[length][0] @ state + gains[length][1] for length, state in zip(durations, x, strict=True)]
    )
    return made.control(torch.cat([x, costates], -1))


def by_sweep(planner: Planner, starts: list[float], durations: list[float], x: Tensor) -> Tensor:
    """All horizons swept at once; the expansions are tabulated first, at every half step."""
    problem = planner.problem
    begin, length = x.new_tensor(starts), x.new_tensor(durations)
    fractions = torch.linspace(0.0, 1.0, 2 * STEPS + 1, dtype=x.dtype)
    t = begin + fractions.unsqueeze(-1) * length  # (2 STEPS + 1, S)
    made = expand(problem, t, *problem.reference(t))
    scale = length[:, None, None]  # in units of each horizon

    def system(fraction: Tensor) -> tuple[Tensor, Tensor]:
        at = round(float(fraction) * 2 * STEPS)
        return made.matrix[at] * scale, made.drift[at] * scale[..., 0]

    terminal, offset = _terminal(problem, t[-1])
    terminal = terminal.expand(len(x), -1, -1)
    gain, rest = riccati_sweep(system, fractions[::2], terminal, offset.expand(len(x), -1))
    y = torch.cat([x, (gain @ x.unsqueeze(-1)).squeeze(-1) + rest], -1)
    return (made.control_gain[0] @ y.unsqueeze(-1)).squeeze(-1) + made.control_offset[0]


def by_boundary_value_solver(planner: Planner, starts: list[float], durations: list[float], x: Tensor) -> Tensor:
    """One after the other."""
    return torch.stack(
        [
            nonlinear_control(planner.problem, planner.plan(start, state, length), state)
            for start, length, state in zip(starts, durations, x, strict=True)
        ]
    )


def _terminal(problem: TrackingProblem, end: Tensor) -> tuple[Tensor, Tensor]:
    weight = problem.terminal_weight
    n = len(problem.initial)
    if weight is None:
        return problem.initial.new_zeros(n, n), problem.initial.new_zeros(n)
    offset = problem.terminal_offset(end)
    assert offset is not None
    return weight, offset


ORACLES: dict[str, Oracle] = {
    "matrix exponential": by_exponential,
    "Riccati sweep": by_sweep,
    "solve_bvp": by_boundary_value_solver,
}


def oracle_of(planner: Planner) -> str:
    """The name in ORACLES of what answers the question that the planner asks."""
    if planner.problem.plant.linear and isinstance(planner.problem.reference, Setpoint):
        return "matrix exponential"
    return "Riccati sweep" if planner.affine else "solve_bvp"


# -- certificate -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Allowed:
    """Relative errors of a control that are allowed, apart for what makes them.

    oracle: against the exact answer; what is left there is the horizon's discretisation, a matter of plant and nodes.
    iteration: against the same nodes' equations solved to the end; what is left there is a matter of the passes.

    Raises ValueError for a number that is not positive.
    """

    oracle: float = 1e-2
    iteration: float = 1e-8

    def __post_init__(self) -> None:
        for name, key in (("oracle", "control_error"), ("iteration", "iteration_error")):
            if not getattr(self, name) > 0:
                raise ValueError(f"{key} = {getattr(self, name)}; allowed: above 0")


@dataclass(frozen=True)
class GuidanceCertificate(FlightCertificate):
    """What was found when a flight's decisions were made again; lists are per checked cycle.

    iteration_errors: as control_errors, but against Newton's method on the same nodes, from the reference to the end;
    where one pass is all that is asked for, against that pass made again. off_node_residuals, losses: of the same
    horizons. final_errors: |state − reference| at the end, in the units that people read. peaks: largest value of each
    of the plant's limits.
    """

    oracle: str
    cycles: list[int]
    control_errors: list[float]
    iteration_errors: list[float]
    off_node_residuals: list[float]
    losses: list[float]
    n_cycles: int
    n_late: int
    saturated: float
    final_errors: Mapping[str, float]
    peaks: Mapping[str, float] = field(default_factory=dict)
    allowed: Allowed = Allowed()
    completed: bool = True

    told = (*FlightCertificate.told, "largest_iteration_error")

    @property
    def largest_iteration_error(self) -> float:
        return max(self.iteration_errors, default=math.nan)

    @property
    def claim(self) -> str:
        return f"every checked control is within {self.allowed.oracle:g} of the {self.oracle}'s"

    @property
    def checks(self) -> list[tuple[bool, str]]:
        limit = self.allowed

        def control(found: float, allowed: float, whose: str) -> tuple[bool, str]:
            return found <= allowed, f"a control is {found:.2g} off {whose}; allowed: {allowed:g}"

        return [
            (self.completed, "the flight was interrupted"),
            (bool(self.control_errors), "no decision was checked"),
            control(self.largest_error, limit.oracle, f"the {self.oracle}'s"),
            control(self.largest_iteration_error, limit.iteration, "the limit of its passes"),
        ]

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        return [
            ("control at the start against the oracle, median", f"{self.median_error:.2e}", ""),
            ("largest", f"{self.largest_error:.2e}", f"{self.allowed.oracle:.1e}"),
            (
                "against the same horizon solved to the end, largest",
                f"{self.largest_iteration_error:.2e}",
                f"{self.allowed.iteration:.1e}",
            ),
            ("residual between the nodes, largest", f"{max(self.off_node_residuals, default=math.nan):.2e}", ""),
            ("loss at the nodes, largest", f"{max(self.losses, default=math.nan):.2e}", ""),
            ("decisions replaced (late or not finite)", f"{self.n_late} of {self.n_cycles}", ""),
            ("cycles with a saturated control", f"{100 * self.saturated:.1f} %", ""),
            *((f"largest {name}, over its limit", f"{peak:.5f}", "") for name, peak in self.peaks.items()),
        ]


def certify(
    flight: Flight, planner: Planner, table: Timetable, *, n_samples: int = 25, allowed: Allowed | None = None
) -> GuidanceCertificate:
    """Check decisions evenly spread over the flight of one vehicle, those replaced by a fallback left out."""
    plant = flight.problem.plant
    candidates = [k for k in range(flight.n_cycles) if not bool(flight.late[k])]
    cycles = spread_evenly(candidates, n_samples)
    allowed, converged = allowed or Allowed(), _to_the_end(planner)
    errors: list[float] = []
    iteration: list[float] = []
    residuals: list[float] = []
    losses: list[float] = []
    name = oracle_of(planner)
    if cycles:
        measured = flight.measured[cycles]
        starts, durations = [table.starts[k] for k in cycles], [table.durations[k] for k in cycles]
        truth = ORACLES[name](planner, starts, durations, measured)
        errors = _relative(flight.commands[cycles], truth)
        limits = []
        for start, length, state in zip(starts, durations, measured, strict=True):
            plan = converged.plan(start, state, length)
            limits.append(plan.control)
            residuals.append(float(plan.solution.off_node_residual()))
            losses.append(float(plan.solution.loss))
        iteration = _relative(flight.commands[cycles], torch.stack(limits))
    last = flight.errors[-1].abs().tolist()
    return GuidanceCertificate(
        name,
        cycles,
        errors,
        iteration,
        residuals,
        losses,
        flight.n_cycles,
        flight.n_late,
        float(flight.saturated) if flight.n_cycles else 0.0,
        {key: value / unit.size for (key, unit), value in zip(plant.states.items(), last, strict=True)},
        {key: float(values.max()) for key, values in flight.limits().items()} if flight.n_cycles else {},
        allowed,
        flight.completed,
    )


def _to_the_end(planner: Planner) -> Planner:
    """What a planner's passes go towards: Newton's method to 1e-11 of the states' size; one pass is its own end."""
    if planner.affine:
        return planner
    size = float(planner.problem.initial.norm().clamp_min(1.0))
    return replace(planner, passes=Passes(40, 1e-11 * size, second_order=True), traced=False)


def _relative(found: Tensor, truth: Tensor) -> list[float]:
    """‖found − truth‖/‖truth‖ of (S, m), infinite where it is not a number."""
    difference = torch.linalg.vector_norm(found - truth, dim=-1) / torch.linalg.vector_norm(truth, dim=-1)
    return [value if value == value else float("inf") for value in difference.tolist()]
