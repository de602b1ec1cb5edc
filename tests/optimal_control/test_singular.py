"""The control of a singular arc: against closed forms, and against S differentiated along a flow by differences."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers import bvp_of, problem, random, relative
from torch import Tensor

from ponn_torch.numerics.runge_kutta import runge_kutta
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting
from ponn_torch.optimal_control.control_laws import Box, ThrustBall
from ponn_torch.optimal_control.control_set import INTERIOR, LOWER, UPPER, Regime
from ponn_torch.optimal_control.pontryagin import pontryagin, with_singular_arcs
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.optimal_control.singular import clebsch, singular_components, singular_fractions


def cheap() -> OptimalControlProblem:
    """½∫x² with ẋ = y + u, ẏ = −u: S ∝ λ_y − λ_x, so S̈ = 0 where u = −(x + y)."""
    return OptimalControlProblem(
        name="cheap",
        states={"x": 1, "y": 1},
        control=Box("u", 5.0, -5.0),
        dynamics=lambda t, x, u, p: {"x": x.y + u.u, "y": -u.u},
        running_cost=lambda t, x, u, p: 0.5 * x.x**2,
        initial={"x": 1.0, "y": 1.0},
        final={"x": 0.0, "y": 0.5},
        final_time=2.0,
    )


def on_arcs(bvp: BoundaryValueProblem, codes: Tensor, interior: Tensor | None = None) -> Setting:
    return Setting(Regime(arcs=codes, interior=interior))


def points(bvp: BoundaryValueProblem, count: int = 20) -> tuple[Tensor, Tensor]:
    w = random(count, bvp.dimension, seed=3, low=0.3, high=1.2)
    return torch.linspace(0.1, 0.9, count, dtype=torch.float64)[:, None], w


def test_components_with_interior_arcs_are_singular_where_h_is_affine():
    codes = torch.tensor([[LOWER, INTERIOR], [UPPER, LOWER]])
    assert singular_components(Box("u", 1.0, size=2), codes) == (1,)
    assert singular_components(Box("u", 1.0, size=2, convex=(0, 1)), codes) == ()
    assert singular_components(Box("u", 1.0, size=2), None) == ()


def test_it_is_the_closed_form_where_there_is_one():
    bvp = with_singular_arcs(pontryagin(cheap()), (0,))
    t, w = points(bvp)
    u = bvp.minimiser(t, w, on_arcs(bvp, torch.full((20, 1), INTERIOR))).control["u"]
    torch.testing.assert_close(u[:, 0], -(w[:, 0] + w[:, 1]), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("code", [LOWER, UPPER])
def test_bounds_stay_bounds(code):
    bvp = with_singular_arcs(pontryagin(cheap()), (0,))
    t, w = points(bvp)
    u = bvp.minimiser(t, w, on_arcs(bvp, torch.full((20, 1), code))).control["u"]
    assert bool((u == {LOWER: -5.0, UPPER: 5.0}[code]).all())


@pytest.mark.parametrize("name", ["goddard", "free_flying_robot"])
def test_s_differentiated_twice_along_its_own_flow_vanishes(name):
    """Central differences over steps of a Runge–Kutta method, with η held where it is at the middle."""
    plain = bvp_of(name)
    component = {"goddard": 0, "free_flying_robot": 2}[name]
    bvp = with_singular_arcs(plain, (component,))
    t, w = points(bvp)
    codes = torch.full((20, plain.law.n_bounded), LOWER)
    codes[:, component] = INTERIOR
    fraction = singular_fractions(bvp, t, w, on_arcs(bvp, codes))
    near = fraction[:, component].abs() < 5.0  # controls far out of their range make flows that steps do not follow
    assert int(near.sum()) > 10
    step = 1e-3 * plain.final_time

    def curvature(held: Tensor) -> Tensor:
        setting = on_arcs(bvp, codes, interior=held)

        def switching(ahead: float) -> Tensor:
            there = runge_kutta(lambda passed, y: plain.rates(t + passed * ahead, y, setting), w, ahead)
            return plain.switching(t + ahead, there, Setting())[:, component]

        def bend_of(h: float) -> Tensor:
            return (switching(h) - 2 * switching(0.0) + switching(-h)) / h**2

        return (4 * bend_of(step) - bend_of(2 * step)) / 3

    at_upper, at_lower = curvature(torch.ones_like(fraction)), curvature(torch.zeros_like(fraction))
    assert float((curvature(fraction) / (at_upper - at_lower))[near].abs().max()) < 1e-5
    sign = clebsch(bvp, t, w, on_arcs(bvp, codes))
    assert bool(((sign > 0) == (at_upper > at_lower))[near].all())


def test_opposed_controls_of_a_pair_do_not_hide_each_others_couplings():
    """T⁺ and T⁻ both inside their bounds have slopes that cancel; what F depends on must be seen all the same."""
    bvp = with_singular_arcs(bvp_of("free_flying_robot"), (0, 1, 2, 3))
    t, w = points(bvp)
    for component in range(4):
        codes = torch.full((20, 4), LOWER)
        codes[:, component] = INTERIOR
        by_w = bvp.linearised_rates(t, w, on_arcs(bvp, codes), range(bvp.dimension))[2]
        assert not bool(((by_w != 0).any(0) & ~bvp.couplings).any())


def test_the_jacobian_sees_how_the_control_depends_on_states_and_costates():
    bvp = with_singular_arcs(bvp_of("goddard"), (0,))
    t, w = points(bvp)
    setting = on_arcs(bvp, torch.full((20, 1), INTERIOR))
    rows = range(bvp.dimension)
    value, _, by_w = bvp.linearised_rates(t, w, setting, rows)
    torch.testing.assert_close(value, bvp.rates(t, w, setting))
    for column in range(bvp.dimension):
        step = torch.zeros_like(w)
        step[:, column] = 1e-6
        difference = (bvp.rates(t, w + step, setting) - bvp.rates(t, w - step, setting)) / 2e-6
        assert float((difference - by_w[..., column]).abs().max()) < 1e-5 * max(1.0, float(by_w.abs().max()))


def test_couplings_are_those_of_the_singular_control():
    """ẋ = y − (x + y) on the arc, whatever y; at bounds ẋ does depend on y."""
    plain = pontryagin(cheap())
    bvp = with_singular_arcs(plain, (0,))
    assert bool(bvp.couplings[1, 0])  # ẏ = x + y
    assert not bool(plain.couplings[1, 0])
    assert with_singular_arcs(bvp, (0,)) is bvp
    assert bvp.equations != plain.equations


def test_a_thrust_ball_has_the_same_throttle_as_a_box():
    """A vertical ascent by a vector, whose direction follows the costates."""
    rocket = problem("goddard")

    def dynamics(t, x, u, p):
        drag = 310.0 * x.v**2 * torch.exp(-x.h / 0.002)
        return {"h": x.v, "v": (u.thrust - drag) / x.m - 1.0 / (1.0 + x.h) ** 2, "m": -u.thrust_magnitude / 0.5}

    vector = replace(rocket, control=ThrustBall("thrust", 3.5, size=1), dynamics=dynamics)
    box, ball = (with_singular_arcs(pontryagin(one), (0,)) for one in (rocket, vector))
    t, w = points(box)
    w[:, 4] = -w[:, 4].abs()  # λv < 0: upwards
    codes = torch.full((20, 1), INTERIOR)
    found = [bvp.minimiser(t, w, on_arcs(bvp, codes)).fraction for bvp in (box, ball)]
    assert relative(found[1], found[0]) < 1e-10
