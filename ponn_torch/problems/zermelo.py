"""Zermelo's navigation problem: cross a current that varies with position in minimum time, by the heading alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ponn_torch.optimal_control.problem import FreeTime, Named, OptimalControlProblem
from ponn_torch.optimal_control.stationary import Stationary
from ponn_torch.problems.arguments import check_positive, check_vectors
from ponn_torch.problems.known import known_optimum

OPTIMA: list[tuple[dict[str, object], float]] = [({}, 5.457865263560512)]


def zermelo(
    *,
    initial_position: Sequence[float] = (3.66, -1.86),
    final_position: Sequence[float] = (0.0, 0.0),
    speed: float = 1.0,
    current_gradient: float = 1.0,
    guess: float = 4.0,
    known_cost: float | None = None,
    name: str = "zermelo",
) -> OptimalControlProblem:
    """Least time at ``speed`` through the water, in the current (−gradient · y, 0); after Bryson and Ho, section 2.7.

    Along an extremal the tangent of the heading grows linearly, d(tan θ)/dt = gradient. ``guess`` is of the time.
    """
    check_vectors(2, initial_position=initial_position, final_position=final_position)
    check_positive(speed=speed, guess=guess)
    length = math.dist(initial_position, final_position)
    if not length:
        raise ValueError(f"final_position = {list(final_position)}; allowed: another one than initial_position")
    if known_cost is None:
        known_cost = known_optimum(zermelo, locals(), OPTIMA, ["guess"])

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        east, north = torch.cos(u.heading), torch.sin(u.heading)
        return {"x": speed * east - current_gradient * x.y, "y": speed * north}

    ahead = math.atan2(final_position[1] - initial_position[1], final_position[0] - initial_position[0])
    return OptimalControlProblem(
        name=name,
        description="Zermelo's navigation problem, linear current, minimum time",
        states={"x": 1, "y": 1},
        control=Stationary("heading", minimum=ahead - math.pi, maximum=ahead + math.pi),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: torch.ones_like(x.x),
        initial={"x": initial_position[0], "y": initial_position[1]},
        final={"x": final_position[0], "y": final_position[1]},
        final_time=FreeTime(guess),
        units={"x": length, "y": length, "time": length / speed, "cost": length / speed},
        cost_name="time",
        known_cost=known_cost,
    )
