"""A lunar descent in free time by an engine that can be shut off, and its answer where it is vertical."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from scipy.optimize import brentq

from ponn_torch.optimal_control.control_laws import ThrustBall
from ponn_torch.optimal_control.problem import FreeTime, Named, OptimalControlProblem
from ponn_torch.optimal_control.regularisers import Entropy, Regulariser
from ponn_torch.problems.constants import LANDING_DISPLAY, STANDARD_GRAVITY

GRAVITY, EXHAUST, MASS = 1.62, 311.0 * STANDARD_GRAVITY, 4000.0  # m/s², m/s, kg


def descent(
    position: Sequence[float] = (0.0, 0.0, 1500.0),
    velocity: Sequence[float] = (0.0, 0.0, -30.0),
    weights: float = 5.0,
    guess: float = 70.0,
    regulariser: Regulariser | None = None,
) -> OptimalControlProblem:
    """Down to rest at the origin with a thrust from nothing to so many ``weights``; altitude is not constrained."""
    length = math.hypot(*position)

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        down = x.v.new_tensor((0.0, 0.0, -GRAVITY))
        return {"r": x.v, "v": down + u.thrust / x.m, "m": -u.thrust_magnitude / EXHAUST}

    return OptimalControlProblem(
        name="lunar_descent",
        states={"r": 3, "v": 3, "m": 1},
        control=ThrustBall("thrust", weights * MASS * GRAVITY, 0.0, regulariser=regulariser or Entropy()),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: u.thrust_magnitude / EXHAUST,
        initial={"r": list(position), "v": list(velocity), "m": MASS},
        final={"r": [0.0] * 3, "v": [0.0] * 3},
        final_time=FreeTime(guess),
        units={"r": length, "v": length / guess, "m": MASS, "time": guess, "cost": MASS},
        costate_units={"r": MASS / EXHAUST / guess, "v": MASS / EXHAUST, "m": 1.0},
        mass="m",
        cost_name="fuel",
        display=LANDING_DISPLAY,
    )


def vertical_fuel(height: float, speed: float, weights: float) -> float:
    """Fuel of a free fall and a burn at full thrust, by the rocket equation; ``speed`` is upwards."""
    flow = weights * MASS * GRAVITY / EXHAUST

    def burn(fall: float) -> float:
        """How long the engine takes to stop what has fallen so long."""
        v = speed - GRAVITY * fall
        if v >= 0:
            return 0.0
        # the speed at the end grows with the burn as long as the thrust exceeds the weight
        return brentq(
            lambda s: v - GRAVITY * s - EXHAUST * math.log1p(-flow * s / MASS), 0.0, 0.999 * MASS / flow, xtol=1e-14
        )

    def height_left(fall: float) -> float:
        s, v = burn(fall), speed - GRAVITY * fall
        climb = EXHAUST * s + EXHAUST * (MASS / flow - s) * math.log1p(-flow * s / MASS)  # ∫ of the gain of speed
        return height + speed * fall - 0.5 * GRAVITY * fall**2 + v * s - 0.5 * GRAVITY * s**2 + climb

    apex = max(0.0, speed / GRAVITY)
    ground = (speed + math.sqrt(speed**2 + 2 * GRAVITY * height)) / GRAVITY
    return flow * burn(brentq(height_left, apex, ground, xtol=1e-13))
