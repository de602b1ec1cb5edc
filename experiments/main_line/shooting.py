"""An independent answer: the smoothed problems by single shooting, equations and data written by hand.

Nothing of the package is used: numpy, DOP853 and the tables of the papers. H = αT + λᵀf is minimised,
δ = δl + (1 − δl)(1 + tanh(S/ρ))/2 with S = |λv|/(α m) + λm − 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import root

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shooting:
    """A thrust-limited transfer in its own units; ``units`` are (length in m, time in s, mass in kg)."""

    units: tuple[float, float, float]
    start: Array
    target: Array
    final_time: float
    alpha: float
    thrust: tuple[float, float]
    gravity: Callable[[Array], Array]
    tide: Callable[[Array, Array], Array]  # −(∂g/∂r)ᵀ λv

    def rates(self, t: float, w: Array, rho: float) -> Array:
        r, v, m, lr, lv, lm = w[:3], w[3:6], w[6], w[7:10], w[10:13], w[13]
        size = math.sqrt(lv @ lv)
        switching = size / (self.alpha * m) + lm - 1.0
        low, high = self.thrust
        thrust = low + (high - low) * 0.5 * (1.0 + math.tanh(switching / rho))
        return np.concatenate(
            [
                v,
                self.gravity(r) - thrust / m * lv / size,
                [-self.alpha * thrust],
                self.tide(r, lv),
                -lr,
                [-thrust * size / m**2],
            ]
        )

    def fly(self, costates: Array, rho: float) -> Array:
        """w(tf) from initial costates, in own units."""
        start = np.concatenate([self.start, costates])
        span = (0.0, self.final_time)
        flown = solve_ivp(self.rates, span, start, "DOP853", args=(rho,), rtol=1e-13, atol=1e-15)
        return flown.y[:, -1]

    def costate_units(self) -> Array:
        """kg of fuel per SI unit of r, v, m, per own unit."""
        length, time, mass = self.units
        return np.array([mass / length] * 3 + [mass * time / length] * 3 + [1.0])

    def solve(self, near: Array, rho: float) -> tuple[Array, float]:
        """(costates at t = 0 in SI, fuel in kg) from a start that is 1 in 1000 off ``near`` (SI)."""
        unit = self.costate_units()
        first = near / unit * (1.0 + 1e-3 * np.cos(np.arange(7)))

        def miss(costates: Array) -> Array:
            end = self.fly(costates, rho)
            return np.append(end[:6] - self.target, end[13])

        found = root(miss, first, method="hybr", options={"xtol": 1e-13})
        if np.abs(found.fun).max() > 1e-9:
            raise RuntimeError(f"shooting did not converge: it misses by {np.abs(found.fun).max():.1e}")
        fuel = (self.start[6] - self.fly(found.x, rho)[6]) * self.units[2]
        return found.x * unit, fuel


def earth_mars() -> Shooting:
    """PoNN paper, Table 1."""
    length, time, mass = 149.59787e9, 58.132 * 86400.0, 1000.0
    mu = 1.32712440018e20 * time**2 / length**3
    position = [-140699693e3, -51614428e3, 980e3], [-172682023e3, 176959469e3, 7948912e3]
    velocity = [9774.596, -28078.28, 0.4337725], [-16427.384, -14860.506, 92.1486]
    start, target = (
        np.concatenate([np.array(r) / length, np.array(v) * time / length])
        for r, v in zip(position, velocity, strict=True)
    )

    def tide(r: Array, lv: Array) -> Array:
        d = math.sqrt(r @ r)
        return mu * (lv / d**3 - 3.0 * (r @ lv) * r / d**5)

    return Shooting(
        units=(length, time, mass),
        start=np.append(start, 1.0),
        target=target,
        final_time=348.795 * 86400.0 / time,
        alpha=length / time / (2000.0 * 9.80665),
        thrust=(0.0, 0.5 * time**2 / (mass * length)),
        gravity=lambda r: -mu * r / math.sqrt(r @ r) ** 3,
        tide=tide,
    )


def mars_landing() -> Shooting:
    """PoNN paper, section 4.2, with the cosine of the cant angle in the mass flow."""
    length, time, mass = 1000.0, 10.0, 1905.0
    force = mass * length / time**2
    down = np.array([0.0, 0.0, -3.7114]) * time**2 / length
    start = np.array([-0.2, 0.1, 1.5, 85.0 * 0.01, -50.0 * 0.01, -65.0 * 0.01, 1.0])
    return Shooting(
        units=(length, time, mass),
        start=start,
        target=np.zeros(6),
        final_time=4.4823,
        alpha=length / time / (225.0 * 9.80665 * math.cos(math.radians(27.0))),
        thrust=(4971.81 / force, 13258.18 / force),
        gravity=lambda r: down,
        tide=lambda r, lv: np.zeros(3),
    )


SHOOTING: dict[str, Callable[[], Shooting]] = {"earth_mars": earth_mars, "mars_landing": mars_landing}
