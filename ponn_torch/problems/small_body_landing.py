"""Fuel-optimal landing on a rotating small body (PoNN paper, section 3.2, eq. 46–51)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ponn_torch.optimal_control.control_laws import ThrustBall
from ponn_torch.optimal_control.problem import Named, OptimalControlProblem, nearest
from ponn_torch.optimal_control.regularisers import make_regulariser
from ponn_torch.problems.arguments import check_positive, check_thrust, check_vectors
from ponn_torch.problems.constants import LANDING_DISPLAY, STANDARD_GRAVITY
from ponn_torch.problems.known import known_optimum

OPTIMA_KG: list[tuple[dict[str, object], float]] = [({}, 3.9087445862)]
GRAVITY_MODELS = ("linearised", "point_mass")


def small_body_landing(
    *,
    initial_position: Sequence[float] = (8039.3, 3564.6, 4603.6),
    initial_velocity: Sequence[float] = (-0.36, -2.26, -0.07),
    final_position: Sequence[float] = (6835.9, 2488.1, 4200.0),
    final_velocity: Sequence[float] = (0.0, 0.0, 0.0),
    initial_mass: float = 1400.0,
    final_time: float = 1000.0,
    minimum_thrust: float = 0.0,
    maximum_thrust: float = 20.0,
    specific_impulse: float = 225.0,
    gravitational_parameter: float = 4.46311e5,
    rotation_rate: float = 3.31166e-4,
    gravity_model: str = "linearised",
    regulariser: str = "entropy",
    switching_level: float = 0.0,
    known_cost: float | None = None,
    name: str = "small_body_landing",
) -> OptimalControlProblem:
    """Soft landing in the frame that rotates with the body about +z, SI; an Eros-like body by default.

    ``gravity_model``: ``linearised`` about the initial position, g(r0) + G (r − r0), or the ``point_mass`` itself.
    """
    if known_cost is None:
        known_cost = known_optimum(small_body_landing, locals(), OPTIMA_KG)
    check_vectors(
        initial_position=initial_position,
        initial_velocity=initial_velocity,
        final_position=final_position,
        final_velocity=final_velocity,
    )
    check_positive(
        initial_mass=initial_mass,
        final_time=final_time,
        specific_impulse=specific_impulse,
        gravitational_parameter=gravitational_parameter,
    )
    check_thrust(minimum_thrust, maximum_thrust)
    if gravity_model not in GRAVITY_MODELS:
        raise ValueError(f"gravity_model = {gravity_model!r}; {nearest(gravity_model, GRAVITY_MODELS)}")
    alpha = 1.0 / (specific_impulse * STANDARD_GRAVITY)
    mu, omega = gravitational_parameter, rotation_rate
    radius = math.hypot(*initial_position)
    # G = μ (3 r0 r0ᵀ/R⁵ − I/R³)
    gradient = [
        [mu * (3 * a * b / radius**5 - (i == j) / radius**3) for j, b in enumerate(initial_position)]
        for i, a in enumerate(initial_position)
    ]

    def gravity(r: torch.Tensor) -> torch.Tensor:
        if gravity_model == "point_mass":
            return -mu * r / torch.sqrt((r * r).sum(-1, keepdim=True)) ** 3
        r0 = r.new_tensor(list(initial_position))
        return -mu / radius**3 * r0 + (r - r0) @ r.new_tensor(gradient)  # G is symmetric

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        coriolis = 2 * omega * torch.stack([x.v[..., 1], -x.v[..., 0], torch.zeros_like(x.v[..., 0])], -1)
        centrifugal = omega**2 * torch.stack([x.r[..., 0], x.r[..., 1], torch.zeros_like(x.r[..., 0])], -1)
        return {
            "r": x.v,
            "v": gravity(x.r) + coriolis + centrifugal + u.thrust / x.m,
            "m": -alpha * u.thrust_magnitude,
        }

    length = math.dist(initial_position, final_position)
    return OptimalControlProblem(
        name=name,
        description="Small-body landing in a rotating frame, minimum fuel",
        states={"r": 3, "v": 3, "m": 1},
        control=ThrustBall(
            "thrust",
            maximum_thrust,
            minimum_thrust,
            size=3,
            regulariser=make_regulariser(regulariser),
            switching_level=switching_level,
        ),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: alpha * u.thrust_magnitude,
        initial={"r": list(initial_position), "v": list(initial_velocity), "m": initial_mass},
        final={"r": list(final_position), "v": list(final_velocity)},
        final_time=final_time,
        units={
            "r": length,
            "v": length / final_time,
            "m": initial_mass,
            "time": final_time,
            "cost": initial_mass,
        },
        costate_units={"r": alpha * initial_mass / final_time, "v": alpha * initial_mass, "m": 1.0},
        mass="m",
        cost_name="fuel",
        known_cost=known_cost,
        display=LANDING_DISPLAY,
    )
