"""The brachistochrone: the curve of quickest descent under gravity, a cycloid."""

from __future__ import annotations

import math

import torch

from ponn_torch.optimal_control.problem import FreeTime, Named, OptimalControlProblem
from ponn_torch.optimal_control.stationary import Stationary
from ponn_torch.problems.arguments import check_positive
from ponn_torch.problems.constants import STANDARD_GRAVITY


def brachistochrone(
    *,
    distance: float = 10.0,
    depth: float = 5.0,
    gravity: float = STANDARD_GRAVITY,
    guess: float = 2.5,
    known_cost: float | None = None,
    name: str = "brachistochrone",
) -> OptimalControlProblem:
    """From rest to a point ``distance`` away and ``depth`` below in least time; y points down, speed at the end free.

    ``guess`` (s) is of the time. ``known_cost`` None takes the time of the cycloid through the point.
    """
    check_positive(distance=distance, depth=depth, gravity=gravity, guess=guess)
    if known_cost is None:
        known_cost = cycloid_time(distance, depth, gravity)
    length = math.hypot(distance, depth)

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        along, down = torch.cos(u.slope), torch.sin(u.slope)
        return {"x": x.v * along, "y": x.v * down, "v": gravity * down}

    return OptimalControlProblem(
        name=name,
        description="Quickest descent under gravity",
        states={"x": 1, "y": 1, "v": 1},
        control=Stationary("slope"),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: torch.ones_like(x.v),
        initial={"x": 0.0, "y": 0.0, "v": 0.0},
        final={"x": distance, "y": depth},
        final_time=FreeTime(guess),
        units={
            "x": length,
            "y": length,
            "v": math.sqrt(gravity * length),
            "time": math.sqrt(length / gravity),
            "cost": math.sqrt(length / gravity),
        },
        cost_name="time",
        known_cost=known_cost,
    )


def cycloid_angle(distance: float, depth: float) -> float:
    """φ of x = R(φ − sin φ), y = R(1 − cos φ) at the end point, by bisection; x/y grows with φ."""
    low, high = 0.0, 2 * math.pi
    while low < (middle := 0.5 * (low + high)) < high:
        beyond = (middle - math.sin(middle)) * depth > (1 - math.cos(middle)) * distance
        low, high = (low, middle) if beyond else (middle, high)
    return middle


def cycloid_time(distance: float, depth: float, gravity: float) -> float:
    """φ √(R/g), s."""
    angle = cycloid_angle(distance, depth)
    return angle * math.sqrt(depth / (1 - math.cos(angle)) / gravity)
