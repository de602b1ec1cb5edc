"""The least thrust for a number of revolutions, by direct collocation in cylindrical coordinates.

There the angle is a state, and the number of revolutions a boundary value: no other can be found by mistake. It shares
nothing with the package but the data of the problem.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ponn_torch.baselines.symbolic import load_casadi
from ponn_torch.problems.constants import ASTRONOMICAL_UNIT, DAY, STANDARD_GRAVITY, SUN_GM
from ponn_torch.problems.earth_mars import EARTH_VENUS, TIME_UNIT

N_INTERVALS, DEGREE = 120, 3
OPTIONS = {"print_level": 0, "sb": "yes", "max_iter": 500, "tol": 1e-9}


def _cylindrical(end: str) -> np.ndarray[Any, Any]:
    """(ρ, θ, z, ρ̇, θ̇, ż) at one end, scaled."""
    r = np.array(EARTH_VENUS[f"{end}_position_km"]) * 1e3 / ASTRONOMICAL_UNIT
    v = np.array(EARTH_VENUS[f"{end}_velocity_km_s"]) * 1e3 * TIME_UNIT / ASTRONOMICAL_UNIT
    rho = math.hypot(r[0], r[1])
    rates = (r[0] * v[0] + r[1] * v[1]) / rho, (r[0] * v[1] - r[1] * v[0]) / rho**2, v[2]
    return np.array([rho, math.atan2(r[1], r[0]), r[2], *rates])


def least_thrust(extra: int, seed: int = 0) -> float | None:
    """The least maximum thrust in N that is found from a random path; None where the iteration fails."""
    ca = load_casadi()
    generator = np.random.default_rng(seed)
    mass, mu = EARTH_VENUS["initial_mass"], SUN_GM * TIME_UNIT**2 / ASTRONOMICAL_UNIT**3
    newton = TIME_UNIT**2 / (mass * ASTRONOMICAL_UNIT)
    exhaust = EARTH_VENUS["specific_impulse"] * STANDARD_GRAVITY * TIME_UNIT / ASTRONOMICAL_UNIT
    duration = EARTH_VENUS["final_time_days"] * DAY / TIME_UNIT
    start, end = _cylindrical("initial"), _cylindrical("final")
    end[1] = start[1] + (end[1] - start[1]) % (2 * math.pi) + 2 * math.pi * extra

    program, count = ca.Opti(), N_INTERVALS * DEGREE
    knots, inside = program.variable(7, N_INTERVALS + 1), program.variable(7, count)
    thrust, most = program.variable(3, count), program.variable()  # in N, along the cylindrical axes; its largest norm
    rho, _, z, radial, angular, axial, m = ca.vertsplit(inside)
    gravity = mu / (rho**2 + z**2) ** 1.5
    push = newton * thrust / ca.repmat(m, 3, 1)
    rates = ca.vertcat(
        radial,
        angular,
        axial,
        rho * angular**2 - gravity * rho + push[0, :],
        (push[1, :] - 2 * radial * angular) / rho,
        push[2, :] - gravity * z,
        -newton / exhaust * most * ca.DM.ones(1, count),
    )
    points = ca.collocation_points(DEGREE, "legendre")
    slopes, ends, _ = ca.collocation_coeff(points)
    step = duration / N_INTERVALS
    for k in range(N_INTERVALS):
        here = slice(k * DEGREE, (k + 1) * DEGREE)
        polynomial = ca.horzcat(knots[:, k], inside[:, here])
        program.subject_to(polynomial @ slopes == step * rates[:, here])
        program.subject_to(polynomial @ ends == knots[:, k + 1])
    program.subject_to(ca.sum1(thrust**2) <= most**2)
    program.subject_to(most >= 0)
    program.subject_to(ca.vec(ca.vertcat(rho - 0.05, m - 0.02)) >= 0)
    program.subject_to(knots[:, 0] == np.append(start, 1.0))
    program.subject_to(knots[:6, -1] == end)

    # radii with a random bulge, angles that are swept at the rate of a circular orbit
    bulge, skew = generator.uniform(-0.5, 2.5), generator.uniform(-0.8, 0.8)
    share = np.linspace(0, 1, 4001)
    radius = start[0] + (end[0] - start[0]) * share
    radius = np.maximum(radius + bulge * np.sin(math.pi * share) * (1 + skew * np.cos(math.pi * share)), 0.2)
    swept = np.cumsum(radius**-1.5)
    angle = start[1] + (end[1] - start[1]) * (swept - swept[0]) / (swept[-1] - swept[0])
    path = np.stack([radius, angle, start[2] + (end[2] - start[2]) * share])
    states = np.vstack([path, np.gradient(path, share * duration, axis=1), 1 - 0.6 * share])
    fine = (np.arange(N_INTERVALS)[:, None] + np.array(points)).ravel() / N_INTERVALS
    for variable, at in ((knots, np.linspace(0, 1, N_INTERVALS + 1)), (inside, fine)):
        program.set_initial(variable, np.stack([np.interp(at, share, row) for row in states]))
    program.set_initial(thrust, 0.1 * generator.normal(size=(3, count)))
    program.set_initial(most, generator.uniform(0.3, 1.0))
    program.minimize(most)
    program.solver("ipopt", {"print_time": False}, OPTIONS)
    try:
        return float(program.solve().value(most))
    except RuntimeError:  # CasADi's word for an iteration that failed
        return None
