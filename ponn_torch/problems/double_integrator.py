"""The double integrator from rest to rest, with answers in closed form: minimum energy, time and fuel."""

from __future__ import annotations

import math

import torch

from ponn_torch.optimal_control.control_laws import Box, ThrustBall, Unconstrained
from ponn_torch.optimal_control.problem import FreeTime, Named, OptimalControlProblem

INITIAL = {"x": 0.0, "v": 0.0}
FINAL = {"x": 1.0, "v": 0.0}


def _dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
    return {"x": x.v, "v": u.force}


def minimum_energy(*, name: str = "double_integrator_energy") -> OptimalControlProblem:
    """Minimise ½∫u² dt over one second: u = 6 − 12 t, cost 6."""
    return OptimalControlProblem(
        name=name,
        states={"x": 1, "v": 1},
        control=Unconstrained("force", 1),
        dynamics=_dynamics,
        running_cost=lambda t, x, u, p: 0.5 * u.force * u.force,
        final_time=1.0,
        known_cost=6.0,
        initial=INITIAL,
        final=FINAL,
    )


def minimum_time(*, name: str = "double_integrator_time") -> OptimalControlProblem:
    """Minimise the time with |u| ≤ 1: full force, then full brake, 2 s with the switch at 1 s."""
    return OptimalControlProblem(
        name=name,
        states={"x": 1, "v": 1},
        control=Box("force", maximum=1.0, minimum=-1.0, size=1),
        dynamics=_dynamics,
        running_cost=lambda t, x, u, p: torch.ones_like(u.force),
        final_time=FreeTime(3.0),
        known_cost=2.0,
        initial=INITIAL,
        final=FINAL,
    )


def minimum_fuel(*, final_time: float = 3.0, name: str = "double_integrator_fuel") -> OptimalControlProblem:
    """Minimise ∫|u| dt in fixed time with |u| ≤ 1: push, coast, brake, each push of T/2 − √(T²/4 − 1) s."""
    if not final_time > 2.0:
        raise ValueError(f"final_time = {final_time} s; more than the minimum time of 2 s is needed")

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        return {"x": x.v, "v": u.force}

    return OptimalControlProblem(
        name=name,
        states={"x": 1, "v": 1},
        control=ThrustBall("force", maximum=1.0, size=1),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: u.force_magnitude,
        final_time=final_time,
        known_cost=final_time - math.sqrt(final_time**2 - 4.0),
        initial=INITIAL,
        final=FINAL,
    )
