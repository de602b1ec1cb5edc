"""A free-flying robot with two thrusters that push and pull, brought to rest elsewhere with the least fuel."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.problem import Named, OptimalControlProblem
from ponn_torch.optimal_control.regularisers import make_regulariser
from ponn_torch.problems.arguments import check_positive, check_vectors
from ponn_torch.problems.known import known_optimum

OPTIMA: list[tuple[dict[str, object], float]] = [({}, 7.910143838106)]


def free_flying_robot(
    *,
    initial_position: Sequence[float] = (-10.0, -10.0),
    initial_angle: float = math.pi / 2,
    final_position: Sequence[float] = (0.0, 0.0),
    final_angle: float = 0.0,
    maximum_thrust: float = 1.0,
    arm: float = 0.2,
    final_time: float = 12.0,
    regulariser: str = "entropy",
    known_cost: float | None = None,
    name: str = "free_flying_robot",
) -> OptimalControlProblem:
    """Unit mass, thrusts along the heading on both sides of the centre; after Sakawa (1999), who minimises ∫Σ|T| dt.

    Every thruster is two controls between zero and its maximum, ``thrust`` = (T₁⁺, T₁⁻, T₂⁺, T₂⁻). ``arm`` is over the
    moment of inertia. With the data of the defaults the optimum has two singular arcs of 0.09 s among nine at bounds;
    nine at bounds alone cost 7.910147 and leave S on the wrong side.
    """
    check_vectors(2, initial_position=initial_position, final_position=final_position)
    check_positive(maximum_thrust=maximum_thrust, arm=arm, final_time=final_time)
    if known_cost is None:
        known_cost = known_optimum(free_flying_robot, locals(), OPTIMA)

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        first, first_back, second, second_back = u.thrust.split(1, -1)
        left, right = first - first_back, second - second_back
        return {
            "r": x.v,
            "v": (left + right) * torch.cat([torch.cos(x.theta), torch.sin(x.theta)], -1),
            "theta": x.omega,
            "omega": arm * (left - right),
        }

    length = max(math.dist(initial_position, final_position), 1.0)
    return OptimalControlProblem(
        name=name,
        description="Free-flying robot, minimum fuel",
        states={"r": 2, "v": 2, "theta": 1, "omega": 1},
        control=Box("thrust", maximum_thrust, size=4, regulariser=make_regulariser(regulariser)),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: u.thrust.sum(-1, keepdim=True),
        initial={"r": list(initial_position), "v": [0.0, 0.0], "theta": initial_angle, "omega": 0.0},
        final={"r": list(final_position), "v": [0.0, 0.0], "theta": final_angle, "omega": 0.0},
        final_time=final_time,
        units={
            "r": length,
            "v": length / final_time,
            "theta": 1.0,
            "omega": 4.0 / final_time,
            "time": final_time,
            "cost": maximum_thrust * final_time,
        },
        cost_name="fuel",
        known_cost=known_cost,
    )
