"""Controls without a closed form: closed forms where there are some, brute force where there are none."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from helpers import random
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import jacrev, vjp, vmap

from ponn_torch.numerics.autodiff import gradients
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.stationary import Stationary

NONE = SimpleNamespace()


def steering(costates: Tensor):
    """λ · (cos θ, sin θ): the angle that steers against the costates."""

    def h(angle: Tensor) -> Tensor:
        return costates[..., :1] * torch.cos(angle) + costates[..., 1:2] * torch.sin(angle) + 0.3

    return h


def spherical(costates: Tensor):
    """λ · the direction of azimuth a and elevation e."""

    def h(angles: Tensor) -> Tensor:
        a, e = angles.split(1, -1)
        direction = torch.cat([torch.cos(a) * torch.cos(e), torch.sin(a) * torch.cos(e), torch.sin(e)], -1)
        return (costates * direction).sum(-1, keepdim=True)

    return h


def minimise(law: Stationary, h, like: Tensor) -> Tensor:
    return law.minimise(h, NONE, like, Regime()).control[law.name]


def adapted(law: Stationary, h, like: Tensor) -> Stationary:
    return law.adapted(h, h, NONE, like, 1.0)


COSTATES = random(50, 2, seed=3, low=-2.0, high=2.0)
ANGLE = adapted(Stationary("angle"), steering(COSTATES), COSTATES[:, :1])


def test_a_steering_angle_points_against_the_costates():
    assert ANGLE.periodic == (True,)
    found = minimise(ANGLE, steering(COSTATES), COSTATES[:, :1])
    expected = torch.atan2(-COSTATES[:, 1:], -COSTATES[:, :1])
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-14)


def jacobian_by_vjp(function, w: Tensor) -> Tensor:
    value, pull, *_ = vjp(function, w)
    return vmap(lambda seed: pull(seed.expand_as(value))[0])(torch.eye(1, dtype=w.dtype))[0]


def jacobian_by_autograd(function, w: Tensor) -> Tensor:
    w = w.clone().requires_grad_()
    (slopes,) = torch.autograd.grad(function(w).sum(), w, create_graph=True)
    return slopes.detach()


def jacobian_point_by_point(function, w: Tensor) -> Tensor:
    return vmap(jacrev(lambda w: function(w[None])[0, 0]))(w)


@pytest.mark.parametrize("jacobian", [jacobian_by_vjp, jacobian_by_autograd, jacobian_point_by_point])
def test_its_derivative_is_that_of_the_implicit_function(jacobian):
    found = jacobian(lambda w: minimise(ANGLE, steering(w), w[:, :1]), COSTATES)
    x, y = COSTATES.unbind(-1)
    expected = torch.stack([-y, x], -1) / (x * x + y * y)[:, None]  # of atan2(y, x)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_two_angles_point_against_three_costates():
    costates = random(20, 3, seed=4, low=-1.0)
    law = adapted(
        Stationary("angles", 2, -math.pi, math.pi, n_grid=8, n_newton=8), spherical(costates), costates[:, :1]
    )
    a, e = minimise(law, spherical(costates), costates[:, :1]).split(1, -1)
    direction = torch.cat([torch.cos(a) * torch.cos(e), torch.sin(a) * torch.cos(e), torch.sin(e)], -1)
    torch.testing.assert_close(direction, -costates / costates.norm(dim=-1, keepdim=True), rtol=0, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(weights=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda w: max(map(abs, w)) > 0.05))
def test_no_other_angle_is_better_though_there_are_local_minima(weights):
    a, b, c, d = weights

    def h(angle: Tensor) -> Tensor:
        return a * torch.cos(angle) + b * torch.sin(angle) + c * torch.cos(2 * angle) + d * torch.sin(2 * angle)

    one = torch.ones(1, 1, dtype=torch.float64)
    found = minimise(Stationary("angle", n_grid=24, n_newton=8, periodic=(True,)), h, one).detach()
    everywhere = torch.linspace(-math.pi, math.pi, 4001, dtype=torch.float64)[:, None]
    # minima closer than what a cell of the grid hides may be taken for each other: half its width squared, times H_uu
    hidden = 0.5 * (math.pi / 24) ** 2 * (abs(a) + abs(b) + 4 * abs(c) + 4 * abs(d))
    assert float(h(found)) <= float(h(everywhere).min()) + hidden
    assert abs(float(gradients(h, found)[0].detach())) < 1e-10
    assert -math.pi <= float(found) <= math.pi


def test_a_minimum_outside_the_range_stays_on_its_edge_without_a_derivative():
    law = Stationary("angle", 1, -1.0, 1.0, periodic=(False,))
    costates = torch.tensor([[-1.0, 0.2], [1.0, -0.3]], dtype=torch.float64)

    def angle(w: Tensor) -> Tensor:
        return minimise(law, steering(w), w[:, :1])

    found = angle(costates).detach()
    assert float(found[0]) == pytest.approx(math.atan2(-0.2, 1.0))
    assert float(found[1]) == 1.0
    assert not jacobian_by_vjp(angle, costates)[1].any()


def test_where_the_control_has_no_say_it_is_finite():
    nothing = torch.zeros(3, 2, dtype=torch.float64)
    assert bool(minimise(ANGLE, steering(nothing), nothing[:, :1]).isfinite().all())
    assert bool(jacobian_by_vjp(lambda w: minimise(ANGLE, steering(w), w[:, :1]), nothing).isfinite().all())


# -- errors --------------------------------------------------------------------------------------------------


def test_a_hamiltonian_without_a_stationary_point_is_refused():
    slope = 1.0 + random(5, 1)
    with pytest.raises(ValueError, match=r"control 'angle': .*no stationary point between -1 and 1; .*needs a Box"):
        adapted(Stationary("angle", 1, -1.0, 1.0), lambda angle: slope * angle, slope)


def test_a_hamiltonian_without_curvature_is_refused():
    one = torch.ones(5, 1, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"control 'angle': H_uu is not positive where"):
        adapted(Stationary("angle"), lambda angle: 1.0 + 0.0 * angle, one)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"minimum": 1.0, "maximum": 1.0}, "minimum = 1.0, maximum = 1.0; minimum < maximum"),
        ({"n_grid": 2}, "n_grid = 2; allowed: from 3"),
        ({"size": 0}, "size = 0; allowed: from 1"),
    ],
)
def test_slips_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        Stationary("angle", **arguments)
