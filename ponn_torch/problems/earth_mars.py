"""Fuel-optimal low-thrust rendezvous from Earth to Mars in fixed time (PoNN paper, section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from ponn_torch.optimal_control.control_laws import ThrustBall
from ponn_torch.optimal_control.problem import DisplayUnit, FreeTime, Named, OptimalControlProblem
from ponn_torch.optimal_control.regularisers import make_regulariser
from ponn_torch.problems.arguments import check_positive, check_thrust, check_vectors
from ponn_torch.problems.constants import ASTRONOMICAL_UNIT, DAY, KILOMETRE, STANDARD_GRAVITY, SUN_GM
from ponn_torch.problems.known import known_optimum

TIME_UNIT = 58.132 * DAY
INITIAL_STATE_KM = (-140699693.0, -51614428.0, 980.0, 9.774596, -28.07828, 4.337725e-4)  # km, km/s
FINAL_STATE_KM = (-172682023.0, 176959469.0, 7948912.0, -16.427384, -14.860506, 9.21486e-2)
EARTH_VENUS: dict[str, Any] = {
    "initial_position_km": (145234429.92699653, 35542120.35153708, -249.98626982258847),
    "initial_velocity_km_s": (-7.576177230584825, 28.831342259450356, 4.476600708027599e-4),
    "final_position_km": (-49025885.07048845, 95580652.67360602, 4137770.8890738026),
    "final_velocity_km_s": (-31.278624357660835, -16.178908080518262, 1.5837447252559491),
    "initial_mass": 1500.0,
    "final_time_days": 1000.0,
    "maximum_thrust": 0.33,
    "specific_impulse": 3800.0,
}
OPTIMA_KG: list[tuple[dict[str, Any], float]] = [({}, 396.05984393), (EARTH_VENUS, 209.42204516)]


def earth_mars(
    *,
    initial_position_km: Sequence[float] = INITIAL_STATE_KM[:3],
    initial_velocity_km_s: Sequence[float] = INITIAL_STATE_KM[3:],
    final_position_km: Sequence[float] = FINAL_STATE_KM[:3],
    final_velocity_km_s: Sequence[float] = FINAL_STATE_KM[3:],
    initial_mass: float = 1000.0,
    final_time_days: float = 348.795,
    maximum_thrust: float = 0.5,
    minimum_thrust: float = 0.0,
    specific_impulse: float = 2000.0,
    regulariser: str = "entropy",
    switching_level: float = 0.0,
    known_cost: float | None = None,
    name: str = "earth_mars",
) -> OptimalControlProblem:
    """Heliocentric two-body transfer minimising fuel; thrust in N, Isp in s, mass in kg.

    ``known_cost`` None takes the known optimum where the data are the published ones.
    """
    check_vectors(initial_position_km=initial_position_km, initial_velocity_km_s=initial_velocity_km_s)
    check_vectors(final_position_km=final_position_km, final_velocity_km_s=final_velocity_km_s)
    check_positive(initial_mass=initial_mass, final_time_days=final_time_days, specific_impulse=specific_impulse)
    check_thrust(minimum_thrust, maximum_thrust)
    if known_cost is None:
        known_cost = known_optimum(earth_mars, locals(), OPTIMA_KG)
    alpha = 1.0 / (specific_impulse * STANDARD_GRAVITY)  # kg per N s
    speed_unit = ASTRONOMICAL_UNIT / TIME_UNIT

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        distance = torch.sqrt((x.r * x.r).sum(-1, keepdim=True))
        return {
            "r": x.v,
            "v": -SUN_GM * x.r / distance**3 + u.thrust / x.m,
            "m": -alpha * u.thrust_magnitude,
        }

    return OptimalControlProblem(
        name=name,
        description="Earth–Mars rendezvous, fixed time, minimum fuel",
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
        initial={
            "r": [KILOMETRE * c for c in initial_position_km],
            "v": [KILOMETRE * c for c in initial_velocity_km_s],
            "m": initial_mass,
        },
        final={
            "r": [KILOMETRE * c for c in final_position_km],
            "v": [KILOMETRE * c for c in final_velocity_km_s],
        },
        final_time=final_time_days * DAY,
        units={
            "r": ASTRONOMICAL_UNIT,
            "v": speed_unit,
            "m": initial_mass,
            "time": TIME_UNIT,
            "cost": initial_mass,
        },
        parameters={"maximum_thrust": maximum_thrust, "minimum_thrust": minimum_thrust},
        mass="m",
        cost_name="fuel",
        known_cost=known_cost,
        display={
            "time": DisplayUnit("d", DAY),
            "r": DisplayUnit("km", KILOMETRE),
            "v": DisplayUnit("km/s", KILOMETRE),
            "m": DisplayUnit("kg"),
            "cost": DisplayUnit("kg"),
            "thrust": DisplayUnit("N"),
            "origin": DisplayUnit("Sun"),
        },
    )


def earth_mars_minimum_time(
    *,
    initial_mass: float = 1000.0,
    maximum_thrust: float = 0.5,
    specific_impulse: float = 2000.0,
    guess_days: float = 330.0,
    known_cost: float | None = None,
    name: str = "earth_mars_minimum_time",
) -> OptimalControlProblem:
    """The same rendezvous as fast as possible: no fixed time below this optimum is feasible (307.58 d at 0.5 N)."""
    check_positive(
        initial_mass=initial_mass,
        maximum_thrust=maximum_thrust,
        specific_impulse=specific_impulse,
        guess_days=guess_days,
    )
    fuel_optimal = earth_mars(
        initial_mass=initial_mass,
        maximum_thrust=maximum_thrust,
        specific_impulse=specific_impulse,
        final_time_days=guess_days,
    )
    acceleration = maximum_thrust / initial_mass
    return replace(
        fuel_optimal,
        name=name,
        description="Earth–Mars rendezvous in minimum time",
        running_cost=lambda t, x, u, p: torch.ones_like(x.m),
        final_time=FreeTime(guess_days * DAY),
        units={**fuel_optimal.units, "cost": TIME_UNIT},
        # H = 1 − |λv| T/m + … vanishes, so |λv| is of the order of m/T
        costate_units={"r": 1.0 / acceleration / TIME_UNIT, "v": 1.0 / acceleration, "m": TIME_UNIT / initial_mass},
        cost_name="time",
        known_cost=known_cost,
        display={**fuel_optimal.display, "cost": DisplayUnit("d", DAY)},
    )
