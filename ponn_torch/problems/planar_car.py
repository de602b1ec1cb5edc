"""A car in the plane, from rest to rest: as fast as possible, and gently round the bends."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ponn_torch.optimal_control.control_laws import Box, Unconstrained
from ponn_torch.optimal_control.control_set import ControlSet
from ponn_torch.optimal_control.problem import FreeTime, Named, OptimalControlProblem
from ponn_torch.optimal_control.product import Product
from ponn_torch.optimal_control.regularisers import make_regulariser
from ponn_torch.problems.arguments import check_positive, check_vectors
from ponn_torch.problems.known import known_optimum

OPTIMA: list[tuple[dict[str, object], float]] = [({}, 3.801260863077)]


def planar_car(
    *,
    initial_position: Sequence[float] = (0.0, 0.0),
    initial_heading: float = 0.0,
    final_position: Sequence[float] = (2.0, 2.0),
    final_heading: float = math.pi / 2,
    maximum_acceleration: float = 1.0,
    maximum_turn: float | None = None,
    turning_price: float = 1.0,
    guess: float = 4.0,
    regulariser: str = "entropy",
    known_cost: float | None = None,
    name: str = "planar_car",
) -> OptimalControlProblem:
    """Minimise ∫ 1 + ½ k ω² dt with ṙ = s (cos h, sin h), ḣ = ω, ṡ = a, |a| ≤ ``maximum_acceleration``.

    Two controls of different kinds: H is affine in a, which jumps, and quadratic in ω, with or without a bound.
    ``guess`` is of the time. Straight ahead over d the answer is bang-bang and takes 2 √(d/a). The known optimum is
    a certified extremal's, which direct collocation meets.
    """
    check_vectors(2, initial_position=initial_position, final_position=final_position)
    check_positive(maximum_acceleration=maximum_acceleration, turning_price=turning_price, guess=guess)
    turn: ControlSet = Unconstrained("turn", 1)
    if maximum_turn is not None:
        check_positive(maximum_turn=maximum_turn)
        turn = Box("turn", maximum_turn, -maximum_turn)
    if known_cost is None:
        known_cost = known_optimum(planar_car, locals(), OPTIMA, ["guess"])
    throttle = Box(
        "acceleration", maximum_acceleration, -maximum_acceleration, regulariser=make_regulariser(regulariser)
    )

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        ahead = torch.cat([torch.cos(x.heading), torch.sin(x.heading)], -1)
        return {"r": x.speed * ahead, "heading": u.turn, "speed": u.acceleration}

    length = max(math.dist(initial_position, final_position), 1e-3)
    return OptimalControlProblem(
        name=name,
        description="Car in the plane, minimum time and gentle turns",
        states={"r": 2, "heading": 1, "speed": 1},
        control=Product((throttle, turn)),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: 1.0 + 0.5 * turning_price * u.turn**2,
        initial={"r": list(initial_position), "heading": initial_heading, "speed": 0.0},
        final={"r": list(final_position), "heading": final_heading, "speed": 0.0},
        final_time=FreeTime(guess),
        units={"r": length, "heading": 1.0, "speed": length / guess, "time": guess, "cost": guess},
        cost_name="cost",
        known_cost=known_cost,
    )
