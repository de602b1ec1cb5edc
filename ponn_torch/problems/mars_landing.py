"""Fuel-optimal powered descent to Mars with canted engines (PoNN paper, section 4.2; TFC paper, tests 1 and 2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ponn_torch.optimal_control.control_laws import ThrustBall
from ponn_torch.optimal_control.problem import FreeTime, Named, OptimalControlProblem
from ponn_torch.optimal_control.regularisers import make_regulariser
from ponn_torch.problems.arguments import check_positive, check_thrust, check_vectors
from ponn_torch.problems.constants import LANDING_DISPLAY, STANDARD_GRAVITY
from ponn_torch.problems.known import known_optimum

_TFC: dict[str, object] = {"mass_flow_per_thrust": 5.0863e-4, "free_final_time": True}
OPTIMA_KG: list[tuple[dict[str, object], float]] = [
    ({}, 268.0146563274),
    ({"standard_gravity": 9.81}, 267.9318584923),
    (
        {"initial_position": (-900.0, 100.0, 1500.0), "initial_velocity": (30.0, -10.0, -70.0), **_TFC},
        179.4476468458,
    ),
    ({"initial_velocity": (85.0, 50.0, -65.0), **_TFC}, 275.2062387119),
]


def mars_landing(
    *,
    initial_position: Sequence[float] = (-200.0, 100.0, 1500.0),
    initial_velocity: Sequence[float] = (85.0, -50.0, -65.0),
    final_position: Sequence[float] = (0.0, 0.0, 0.0),
    final_velocity: Sequence[float] = (0.0, 0.0, 0.0),
    initial_mass: float = 1905.0,
    final_time: float = 44.823,
    free_final_time: bool = False,
    minimum_thrust: float = 4971.81,
    maximum_thrust: float = 13258.18,
    specific_impulse: float = 225.0,
    standard_gravity: float = STANDARD_GRAVITY,
    cant_angle_degrees: float = 27.0,
    mass_flow_per_thrust: float | None = None,
    gravity: float = 3.7114,
    regulariser: str = "entropy",
    switching_level: float = 0.0,
    known_cost: float | None = None,
    name: str = "mars_landing",
) -> OptimalControlProblem:
    """Pinpoint landing in constant gravity, SI; altitude is not constrained.

    The engines are canted, so the mass flow is α|T| with α = 1/(Isp g0 cos φ); ``mass_flow_per_thrust`` (kg per N s)
    overrides it, as in the TFC paper's rounded 5.0863e-4. ``known_cost`` None takes the known optimum where the
    data are published ones.
    """
    check_vectors(initial_position=initial_position, initial_velocity=initial_velocity)
    check_vectors(final_position=final_position, final_velocity=final_velocity)
    check_positive(initial_mass=initial_mass, final_time=final_time, specific_impulse=specific_impulse)
    check_positive(standard_gravity=standard_gravity)
    check_thrust(minimum_thrust, maximum_thrust)
    if not 0 <= cant_angle_degrees < 90:
        raise ValueError(f"cant_angle_degrees = {cant_angle_degrees}; allowed: from 0 to below 90")
    if mass_flow_per_thrust is not None:
        check_positive(mass_flow_per_thrust=mass_flow_per_thrust)
    if known_cost is None:
        unused = ["final_time"] if free_final_time else []
        unused += ["specific_impulse", "standard_gravity", "cant_angle_degrees"] if mass_flow_per_thrust else []
        known_cost = known_optimum(mars_landing, locals(), OPTIMA_KG, unused)
    cosine = math.cos(math.radians(cant_angle_degrees))
    alpha = mass_flow_per_thrust or 1.0 / (specific_impulse * standard_gravity * cosine)
    # a power of two: landings from about as high up then have the same scaled equations, which are derived once
    length = math.ldexp(1.0, math.frexp(max(math.hypot(*initial_position), 1.0))[1])
    speed = length / final_time

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        down = x.v.new_tensor((0.0, 0.0, -gravity))
        return {"r": x.v, "v": down + u.thrust / x.m, "m": -alpha * u.thrust_magnitude}

    return OptimalControlProblem(
        name=name,
        description="Mars powered descent, minimum fuel",
        states={"r": 3, "v": 3, "m": 1},
        control=ThrustBall(
            "thrust",
            "maximum_thrust",
            "minimum_thrust",
            size=3,
            regulariser=make_regulariser(regulariser),
            switching_level=switching_level,
        ),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: alpha * u.thrust_magnitude,
        initial={"r": list(initial_position), "v": list(initial_velocity), "m": initial_mass},
        final={"r": list(final_position), "v": list(final_velocity)},
        final_time=FreeTime(final_time) if free_final_time else final_time,
        units={"r": length, "v": speed, "m": initial_mass, "time": final_time, "cost": initial_mass},
        # S = |λv|/(α m) + λm − 1 is O(1), so |λv| is of the order of α m, a sixtieth of cost/speed here
        costate_units={"r": alpha * initial_mass / final_time, "v": alpha * initial_mass, "m": 1.0},
        parameters={"maximum_thrust": maximum_thrust, "minimum_thrust": minimum_thrust},
        mass="m",
        cost_name="fuel",
        known_cost=known_cost,
        display=LANDING_DISPLAY,
    )
