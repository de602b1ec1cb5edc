"""Small problems with everything that the published ones lack: parameters, explicit time, terminal data."""

from __future__ import annotations

import math

import torch

from ponn_torch.optimal_control.control_laws import Box, ThrustBall, Unconstrained
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem


def interception() -> OptimalControlProblem:
    """Meet a target at 1 + 2t on the x axis in free time, at a price of the time and of the speed left."""
    return OptimalControlProblem(
        name="interception",
        states={"x": 2, "v": 2},
        control=Unconstrained("a", 2),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.a},
        running_cost=lambda t, x, u, p: 0.5 * (u.a**2).sum(-1, keepdim=True),
        terminal_cost=lambda t, x, p: p.price * t**2 + 3.0 * (x.v**2).sum(-1, keepdim=True),
        terminal_manifold=lambda t, x, p: torch.cat([x.x[..., :1] - 1.0 - 2.0 * t, x.x[..., 1:]], -1),
        parameters={"price": 0.5},
        initial={"x": 0.0, "v": 0.0},
        final={},
        final_time=FreeTime(1.5),
        units={"x": 4.0, "v": 3.0, "time": 2.0, "cost": 5.0},
    )


def ferry(*, free_final_time: bool = False, minimum: float = 0.0) -> OptimalControlProblem:
    """Cross a tide that changes with time against quadratic drag; its largest thrust is a parameter."""

    def dynamics(t, x, u, p):
        speed = torch.sqrt((x.v * x.v).sum(-1, keepdim=True) + 1e-2)
        tide = torch.cat([p.tide * torch.sin(3.0 * t), 0.2 * t**2], -1)
        return {"r": x.v, "v": u.thrust / x.m - 0.3 * speed * x.v + tide, "m": -0.2 * u.thrust_magnitude}

    return OptimalControlProblem(
        name="ferry",
        states={"r": 2, "v": 2, "m": 1},
        control=ThrustBall("thrust", maximum="thrust", minimum=minimum, size=2),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: 0.2 * u.thrust_magnitude,
        parameters={"thrust": 4.0, "tide": 0.5},
        initial={"r": 0.0, "v": 0.0, "m": 2.0},
        final={"r": (1.0, 0.5), "v": (0.0, None)},
        final_time=FreeTime(2.0) if free_final_time else 2.0,
        units={"m": 2.0, "time": 1.7, "cost": 0.9},
        mass="m",
    )


def saturated_pair(*, bound: float = 2.0) -> OptimalControlProblem:
    """Two oscillators with a convex cost and forces inside a box: every component saturates by itself."""
    return OptimalControlProblem(
        name="saturated_pair",
        states={"x": 2, "v": 2},
        control=Box("force", bound, -bound, size=2),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.force - x.x * x.x.new_tensor([1.0, 2.0])},
        running_cost=lambda t, x, u, p: 0.5 * (u.force**2).sum(-1, keepdim=True),
        initial={"x": (1.0, -1.0), "v": 0.0},
        final={"x": 0.0, "v": 0.0},
        final_time=1.5,
    )


def linear_quadratic() -> OptimalControlProblem:
    """∫ ½(u² + x²) with ẋ = u from 1 over one second, x(1) free: x = cosh(1 − t)/cosh 1, cost ½ tanh 1."""
    return OptimalControlProblem(
        name="linear_quadratic",
        states={"x": 1},
        control=Unconstrained("u", 1),
        dynamics=lambda t, x, u, p: {"x": u.u},
        running_cost=lambda t, x, u, p: 0.5 * (u.u**2 + x.x**2),
        initial={"x": 1.0},
        final={},
        final_time=1.0,
        known_cost=0.5 * math.tanh(1.0),
    )
