"""Steering problems against what Bryson and Ho derive by hand, and against shooting with costates by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import root

from ponn_torch.problems.brachistochrone import brachistochrone, cycloid_angle, cycloid_time
from ponn_torch.problems.orbit_raising import orbit_raising
from ponn_torch.problems.zermelo import zermelo
from ponn_torch.solving.solver import Solver


def zermelo_start(first: float, last: float) -> tuple[float, float]:
    """Where one is when the heading is ``first``, of an extremal that ends at the origin with ``last`` (eq. 2.7.30)."""
    secant, tangent = (lambda a: 1 / math.cos(a)), math.tan
    x = secant(last) * (tangent(last) - tangent(first)) - tangent(first) * (secant(last) - secant(first))
    x += math.log((tangent(last) + secant(last)) / (tangent(first) + secant(first)))
    return -0.5 * x, secant(first) - secant(last)


def test_the_tangent_of_the_heading_grows_linearly():
    result = Solver().solve(zermelo())
    assert result.certified, result.message
    times = torch.linspace(0, result.solution.final_time, 21, dtype=torch.float64)
    heading = result.solution(times).control["heading"].flatten()
    # 105° and 240° to the rounding of the book
    assert torch.rad2deg(heading[[0, -1]]).tolist() == pytest.approx([105.0, 240.0], abs=0.1)
    tangents = torch.tan(heading)
    torch.testing.assert_close(tangents, tangents[0] + times, rtol=0, atol=1e-9 * float(tangents.abs().max()))
    assert zermelo_start(float(heading[0]), float(heading[-1])) == pytest.approx((3.66, -1.86), abs=1e-11)


def test_without_a_current_the_way_is_straight():
    result = Solver().solve(zermelo(current_gradient=0.0, speed=2.0, guess=3.0))
    assert result.certified, result.message
    assert result.solution.final_time == pytest.approx(math.hypot(3.66, 1.86) / 2.0, rel=1e-12)
    assert result.solution.problem.known_cost is None


@pytest.mark.parametrize(("distance", "depth"), [(10.0, 5.0), (1.0, 3.0), (8.0, 1.0)])
def test_the_cycloid_passes_through_the_end(distance, depth):
    angle = cycloid_angle(distance, depth)
    radius = depth / (1 - math.cos(angle))
    assert radius * (angle - math.sin(angle)) == pytest.approx(distance, rel=1e-13)
    # ∫ ds/v along it, in the midpoint rule
    phi = (np.arange(200000) + 0.5) * angle / 200000
    length = radius * np.hypot(1 - np.cos(phi), np.sin(phi)) * angle / 200000
    time = (length / np.sqrt(2 * 9.81 * radius * (1 - np.cos(phi)))).sum()
    assert cycloid_time(distance, depth, 9.81) == pytest.approx(time, rel=1e-9)


def test_the_quickest_descent_is_a_cycloid():
    result = Solver().solve(brachistochrone(distance=8.0, depth=2.0), 1)  # its first start serves
    assert result.certified, result.message
    angle = cycloid_angle(8.0, 2.0)
    assert angle > math.pi  # below the end point, and up again
    radius, end = 2.0 / (1 - math.cos(angle)), result.solution.final_time
    states = result.solution(torch.linspace(0, end, 21, dtype=torch.float64)).states
    phi = torch.linspace(0, angle, 21, dtype=torch.float64)
    torch.testing.assert_close(states["x"].flatten(), radius * (phi - torch.sin(phi)), rtol=0, atol=1e-9)
    torch.testing.assert_close(states["y"].flatten(), radius * (1 - torch.cos(phi)), rtol=0, atol=1e-9)


def largest_orbit(thrust: float, mass_flow: float, final_time: float) -> tuple[float, np.ndarray]:
    """(radius, first costates) by single shooting; λ̇ and transversality by hand (Bryson and Ho, section 2.5)."""

    def rates(t, y):
        r, u, v, lr, lu, lv = y
        a, size = thrust / (1 - mass_flow * t), math.hypot(lu, lv)
        return [
            u,
            v * v / r - 1 / r**2 - a * lu / size,
            -u * v / r - a * lv / size,
            lu * (v * v / r**2 - 2 / r**3) - lv * u * v / r**2,
            -lr + lv * v / r,
            -2 * lu * v / r + lv * u / r,
        ]

    def end(costates):
        flown = solve_ivp(rates, (0, final_time), [1, 0, 1, *costates], method="DOP853", rtol=1e-13, atol=1e-14)
        return flown.y[:, -1]

    def misses(costates):
        r, u, v, lr, _, lv = end(costates)
        return [u, v - r**-0.5, lr + 1 - 0.5 * lv * r**-1.5]

    found = root(misses, [-1.9, -0.9, -2.0], tol=1e-13)
    assert found.success
    return float(end(found.x)[0]), found.x


@pytest.mark.parametrize("final_time", [3.3194, pytest.param(2.8, marks=pytest.mark.slow)])
def test_the_largest_orbit_is_that_of_shooting(final_time):
    result = Solver().solve(orbit_raising(final_time=final_time))
    assert result.certified, result.message
    radius, costates = largest_orbit(0.1405, 0.0749, final_time)
    assert -result.solution.cost == pytest.approx(radius, abs=1e-11)
    if final_time == 3.3194:
        assert radius == pytest.approx(1.525, abs=1e-3)  # the book
    start = result.solution(0.0)
    found = [float(start.costates[name]) for name in ("r", "vr", "vt")]
    assert found == pytest.approx(costates.tolist(), abs=1e-9)


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (zermelo, {"initial_position": (1.0, 2.0, 3.0)}, "initial_position = .*; allowed: two numbers"),
        (zermelo, {"initial_position": (0.0, 0.0)}, "final_position = .*; allowed: another one than"),
        (orbit_raising, {"mass_flow": 0.5}, r"mass_flow = 0.5; allowed: from 0 to below 1/final_time = 0.301259"),
        (brachistochrone, {"depth": 0.0}, "depth = 0.0; allowed: a positive number"),
    ],
)
def test_slips_are_named(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)
