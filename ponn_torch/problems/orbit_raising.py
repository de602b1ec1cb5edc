"""The largest circular orbit that constant thrust reaches in given time (Bryson and Ho, section 2.5)."""

from __future__ import annotations

import math

import torch

from ponn_torch.optimal_control.problem import Named, OptimalControlProblem
from ponn_torch.optimal_control.stationary import Stationary
from ponn_torch.problems.arguments import check_positive
from ponn_torch.problems.known import known_optimum

OPTIMA: list[tuple[dict[str, object], float]] = [({}, -1.525064001468)]


def orbit_raising(
    *,
    thrust: float = 0.1405,
    mass_flow: float = 0.0749,
    final_time: float = 3.3194,
    known_cost: float | None = None,
    name: str = "orbit_raising",
) -> OptimalControlProblem:
    """Maximise the radius at the end, on a circular orbit there; the control is the angle of thrust above the horizon.

    Canonical units: the first orbit has radius, speed and gravitational parameter 1, the first mass is 1. The end is a
    manifold, vr = 0 and vt = √(1/r), with two multipliers.
    """
    check_positive(thrust=thrust, final_time=final_time)
    if not 0 <= mass_flow * final_time < 1:
        raise ValueError(f"mass_flow = {mass_flow}; allowed: from 0 to below 1/final_time = {1 / final_time:.6g}")
    if known_cost is None:
        known_cost = known_optimum(orbit_raising, locals(), OPTIMA)

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        acceleration = thrust / (1.0 - mass_flow * t)
        return {
            "r": x.vr,
            "vr": x.vt * x.vt / x.r - 1.0 / (x.r * x.r) + acceleration * torch.sin(u.angle),
            "vt": -x.vr * x.vt / x.r + acceleration * torch.cos(u.angle),
        }

    def circular(t: torch.Tensor, x: Named, p: Named) -> torch.Tensor:
        return torch.cat([x.vr, x.vt - torch.sqrt(1.0 / x.r)], -1)

    return OptimalControlProblem(
        name=name,
        description="Orbit of largest radius in given time, constant thrust",
        states={"r": 1, "vr": 1, "vt": 1},
        # thrust turns from ahead over up and behind to down; it never points straight ahead again
        control=Stationary("angle", minimum=0.0, maximum=2 * math.pi),
        dynamics=dynamics,
        terminal_cost=lambda t, x, p: -x.r,
        terminal_manifold=circular,
        initial={"r": 1.0, "vr": 0.0, "vt": 1.0},
        final={},
        final_time=final_time,
        cost_name="-radius",
        known_cost=known_cost,
    )
