"""The certificate of a powered descent: where landers came down, and what their plans were worth.

Plans that were made warm, from the last one, are made again cold: smoothed from a random start, split and certified,
from the same measured state. The two share the state only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch

from ponn_torch.guidance.descent import Landing, PoweredDescent
from ponn_torch.guidance.verdict import FlightCertificate, spread_evenly
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem
from ponn_torch.solving.solver import Solver

ORACLE = "cold split"


@dataclass(frozen=True)
class Limits:
    """What is called landed, how many have to, and how far a checked command may be off.

    miss in m, impact in m/s, landed as a share of a fleet, control_error relative.
    """

    miss: float = 1.0
    impact: float = 0.1
    landed: float = 0.99
    control_error: float = 1e-8


@dataclass(frozen=True)
class LandingCertificate(FlightCertificate):
    """What a landing was measured to be; lists are per checked cycle.

    miss, impact: of the nominal lander. n_landed of n_landers: of the fleet, with its largest_miss, largest_impact; 0
    of 0 without one. planned_fuel, optimal_fuel: kg of the undisturbed plan, and of the optimum with the engines' whole
    thrust. peak_thrust: largest command over the engines' maximum.
    """

    miss: float
    impact: float
    n_landed: int
    n_landers: int
    largest_miss: float
    largest_impact: float
    cycles: list[int]
    control_errors: list[float]
    planned_fuel: float
    optimal_fuel: float
    peak_thrust: float
    n_plans: int
    n_kept: int
    n_repaired: int
    n_late: int
    allowed: Limits
    completed: bool = True

    decisions = "plans"
    told = (*FlightCertificate.told, "share")

    @property
    def share(self) -> float:
        """Of the fleet that landed; 1 without one."""
        return self.n_landed / self.n_landers if self.n_landers else 1.0

    @property
    def claim(self) -> str:
        fleet = f", {self.n_landed} of {self.n_landers} dispersed ones" if self.n_landers else ""
        return f"the lander{fleet} within {self.allowed.miss:g} m and {self.allowed.impact:g} m/s"

    @property
    def checks(self) -> list[tuple[bool, str]]:
        limit = self.allowed
        return [
            (self.completed, "the flight was interrupted"),
            (self.miss <= limit.miss, f"{self.miss:.2g} m off the target; allowed: {limit.miss:g}"),
            (self.impact <= limit.impact, f"{self.impact:.2g} m/s at the target; allowed: {limit.impact:g}"),
            (
                self.share >= limit.landed,
                f"{self.n_landed} of {self.n_landers} landers landed; allowed: a share of {limit.landed:g}",
            ),
            (bool(self.control_errors), "no plan was checked"),
            (
                self.largest_error <= limit.control_error,
                f"a command is {self.largest_error:.2g} off the {ORACLE}'s; allowed: {limit.control_error:g}",
            ),
            (self.peak_thrust <= 1 + 1e-9, f"the thrust is {self.peak_thrust:.6f} of the engines' maximum"),
        ]

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        limit = self.allowed
        rows = [
            ("distance from the target, m", f"{self.miss:.2e}", f"{limit.miss:.1e}"),
            ("speed at the target, m/s", f"{self.impact:.2e}", f"{limit.impact:.1e}"),
            (
                "command against a cold split from the same state",
                f"{self.largest_error:.2e}",
                f"{limit.control_error:.1e}",
            ),
            ("largest thrust, over the engines' maximum", f"{self.peak_thrust:.5f}", "1"),
            ("fuel of the plan, kg", f"{self.planned_fuel:.3f}", ""),
            ("of that for the margin, kg", f"{self.planned_fuel - self.optimal_fuel:.3f}", ""),
            ("plans", f"{self.n_plans}", ""),
            ("with other arcs, kept, late", f"{self.n_repaired}, {self.n_kept}, {self.n_late}", ""),
        ]
        if self.n_landers:
            rows += [
                ("landers of the fleet that landed", f"{self.n_landed}/{self.n_landers}", f"{limit.landed:g}"),
                ("largest distance of the fleet, m", f"{self.largest_miss:.2e}", ""),
                ("largest speed of the fleet, m/s", f"{self.largest_impact:.2e}", ""),
            ]
        return rows


def landed(flight: Landing, limits: Limits) -> torch.Tensor:
    """Who is within the limits at the end (B,)."""
    return (flight.miss <= limits.miss) & (flight.impact <= limits.impact)


def certify_landing(
    flight: Landing,
    fuels: Mapping[str, float],
    fleet: Landing | None = None,
    *,
    n_samples: int = 3,
    allowed: Limits | None = None,
    solver: Solver | None = None,
) -> LandingCertificate:
    """Check one lander's plans, evenly spread over the cycles that had one, and where the fleet came down.

    fuels: ``planned`` and ``optimal``, kg, of the undisturbed problems.
    """
    allowed = allowed or Limits()
    candidates = flight.planned[:, 0].nonzero()[:, 0].tolist()
    cycles = spread_evenly(candidates, n_samples)
    errors = [_off(flight, k, solver or Solver()) for k in cycles]
    high = flight.problem.thrust_bounds[1]
    down = flight.states.new_zeros(0) if fleet is None else fleet.miss
    return LandingCertificate(
        float(flight.miss[0]),
        float(flight.impact[0]),
        0 if fleet is None else int(landed(fleet, allowed).sum()),
        len(down),
        float(down.max()) if fleet is not None else 0.0,
        float(fleet.impact.max()) if fleet is not None else 0.0,
        cycles,
        errors,
        fuels["planned"],
        fuels["optimal"],
        max(float(one.thrust.nan_to_num(nan=0.0).max()) / high for one in (flight, fleet) if one is not None),
        int(flight.n_plans[0] + flight.n_repaired[0]),
        int(flight.n_kept[0]),
        int(flight.n_repaired[0]),
        int(flight.n_late[0]),
        allowed,
        flight.completed,
    )


def _off(flight: Landing, cycle: int, solver: Solver) -> float:
    """How far a cycle's first command is off that of a plan made cold; infinite where there is none certified."""
    step = int(flight.starts[cycle])
    result = solver.solve(
        _from(flight.problem, flight.estimates[cycle, 0], float(flight.arrival[0] - flight.times[step]))
    )
    if not result.certified or result.solution is None:
        return math.inf
    command = flight.commands[step, 0]
    truth = result.solution(0.0).control["thrust"][0]
    return float((command - truth).norm() / truth.norm())


def _from(descent: PoweredDescent, state: torch.Tensor, left: float) -> OptimalControlProblem:
    """The planned problem from another state, with about so much time left."""
    problem = descent.planned
    initial = {name: state[where].tolist() for name, where in problem.slices.items()}
    return problem.with_boundary(initial=initial, final_time=FreeTime(left), known_cost=None)
