"""Energy-optimal relatives of the Earth–Mars transfer: unbounded acceleration, and a spacecraft with limited thrust."""

from __future__ import annotations

import math

import torch

from ponn_torch.optimal_control.control_laws import ThrustBall, Unconstrained
from ponn_torch.optimal_control.problem import DisplayUnit, Named, OptimalControlProblem
from ponn_torch.problems.arguments import check_positive
from ponn_torch.problems.constants import ASTRONOMICAL_UNIT, DAY, KILOMETRE, STANDARD_GRAVITY, SUN_GM
from ponn_torch.problems.earth_mars import FINAL_STATE_KM, INITIAL_STATE_KM, TIME_UNIT
from ponn_torch.problems.known import known_optimum

SPEED_UNIT = ASTRONOMICAL_UNIT / TIME_UNIT
ENERGY_UNIT = SPEED_UNIT**2 / TIME_UNIT  # of ∫|a|² dt
CANONICAL_TIME = math.sqrt(ASTRONOMICAL_UNIT**3 / SUN_GM)  # μ = 1; a little longer than TIME_UNIT
OPTIMA: list[tuple[dict[str, object], float]] = [({}, 0.0142251748586 * ASTRONOMICAL_UNIT**2 / CANONICAL_TIME**3)]
LIMITED_OPTIMA: list[tuple[dict[str, object], float]] = [({}, 2.2655025004 * TIME_UNIT)]

_DISPLAY = {
    "time": DisplayUnit("d", DAY),
    "r": DisplayUnit("km", KILOMETRE),
    "v": DisplayUnit("km/s", KILOMETRE),
    "origin": DisplayUnit("Sun"),
}


def _ends() -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    return tuple(  # type: ignore[return-value]
        {"r": [KILOMETRE * c for c in state[:3]], "v": [KILOMETRE * c for c in state[3:]]}
        for state in (INITIAL_STATE_KM, FINAL_STATE_KM)
    )


def _sun_gravity(r: torch.Tensor) -> torch.Tensor:
    return -SUN_GM * r / torch.sqrt((r * r).sum(-1, keepdim=True)) ** 3


def energy_transfer(
    *, final_time_days: float = 348.795, known_cost: float | None = None, name: str = "energy_transfer"
) -> OptimalControlProblem:
    """Minimise ½∫|a|² dt with free acceleration a and no mass; other extremals of it cost a hundred times more."""
    if known_cost is None:
        known_cost = known_optimum(energy_transfer, locals(), OPTIMA)
    check_positive(final_time_days=final_time_days)
    initial, final = _ends()

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        return {"r": x.v, "v": _sun_gravity(x.r) + u.acceleration}

    return OptimalControlProblem(
        name=name,
        description="Earth–Mars rendezvous, fixed time, minimum energy, unbounded acceleration",
        states={"r": 3, "v": 3},
        control=Unconstrained("acceleration", 3),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: 0.5 * (u.acceleration * u.acceleration).sum(-1, keepdim=True),
        initial=initial,
        final=final,
        final_time=final_time_days * DAY,
        units={"r": ASTRONOMICAL_UNIT, "v": SPEED_UNIT, "time": TIME_UNIT, "cost": ENERGY_UNIT},
        cost_name="energy",
        known_cost=known_cost,
        display={**_DISPLAY, "cost": DisplayUnit("m²/s³"), "acceleration": DisplayUnit("m/s²")},
    )


def energy_transfer_limited(
    *,
    initial_mass: float = 1000.0,
    final_time_days: float = 348.795,
    maximum_thrust: float = 0.5,
    specific_impulse: float = 2000.0,
    known_cost: float | None = None,
    name: str = "energy_transfer_limited",
) -> OptimalControlProblem:
    """Minimise ∫δ² dt with throttle δ = |T|/Tmax ≤ 1: the control saturates for a few days."""
    if known_cost is None:
        known_cost = known_optimum(energy_transfer_limited, locals(), LIMITED_OPTIMA)
    check_positive(
        initial_mass=initial_mass,
        final_time_days=final_time_days,
        maximum_thrust=maximum_thrust,
        specific_impulse=specific_impulse,
    )
    initial, final = _ends()
    alpha = 1.0 / (specific_impulse * STANDARD_GRAVITY)

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        return {"r": x.v, "v": _sun_gravity(x.r) + u.thrust / x.m, "m": -alpha * u.thrust_magnitude}

    return OptimalControlProblem(
        name=name,
        description="Earth–Mars rendezvous, fixed time, minimum ∫δ² dt with limited thrust",
        states={"r": 3, "v": 3, "m": 1},
        control=ThrustBall("thrust", maximum_thrust, size=3),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: (u.thrust_magnitude / maximum_thrust) ** 2,
        initial={**initial, "m": initial_mass},
        final=final,
        final_time=final_time_days * DAY,
        units={
            "r": ASTRONOMICAL_UNIT,
            "v": SPEED_UNIT,
            "m": initial_mass,
            "time": TIME_UNIT,
            "cost": TIME_UNIT,
        },
        # dH/dδ = 2δ − |λv| Tmax/m − …: at δ of order one |λv| Tmax/m is, so costates are cost per (Tmax/m) of speed
        costate_units={
            "r": initial_mass / maximum_thrust / TIME_UNIT,
            "v": initial_mass / maximum_thrust,
            "m": 1.0 / (alpha * maximum_thrust),
        },
        mass="m",
        cost_name="effort",
        known_cost=known_cost,
        display={**_DISPLAY, "m": DisplayUnit("kg"), "cost": DisplayUnit("d", DAY), "thrust": DisplayUnit("N")},
    )
