"""Gradients of pointwise functions agree with torch.func, inside its transforms and outside."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.func import grad, jacrev, vmap

from ponn_torch.numerics.autodiff import (
    differentiable,
    gradients,
    gradients_and_values,
    pointwise_jacobian,
    row_gradients,
)


def energy(x: Tensor, y: Tensor) -> Tensor:
    return (torch.sin(x) * y + x**3).sum(-1, keepdim=True)


def flow(x: Tensor, y: Tensor, scale: Tensor | None) -> Tensor:
    """A pointwise F built from a gradient, as the costate equations are."""
    with differentiable(x, y):
        (by_x,) = gradients(lambda x: energy(x, y), x)
    return torch.cat([by_x * y, x if scale is None else scale * x], -1)


def sample(seed: int = 0, n: int = 5, size: int = 2) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return tuple(torch.rand(n, size, generator=generator, dtype=torch.float64) for _ in range(2))  # type: ignore[return-value]


def test_gradients_agree_with_torch_func_and_carry_no_graph_that_nobody_asked_for():
    x, y = sample()
    expected = grad(lambda x, y: energy(x, y).sum(), argnums=(0, 1))(x, y)
    with differentiable(x, y):
        found = gradients(energy, x, y)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-15)
        assert not one.requires_grad


def test_values_come_back_beside_the_gradients():
    x, y = sample()
    with differentiable(x):
        (by_x,), (square,) = gradients_and_values(lambda x: (energy(x, y), (x * x,)), x)
    assert torch.equal(square, x * x)
    assert not square.requires_grad
    torch.testing.assert_close(by_x, torch.cos(x) * y + 3 * x**2)


def test_a_function_that_does_not_depend_on_its_argument_has_a_zero_gradient():
    x, y = sample()
    assert torch.equal(gradients(lambda x: y, x)[0], torch.zeros_like(x))


def test_what_was_computed_from_the_argument_before_is_not_differentiated():
    x, _ = sample()
    x.requires_grad_()
    frozen = x * x  # on the outer graph, a constant of the inner gradient
    (found,) = gradients(lambda x: frozen * x, x)
    assert torch.equal(found, frozen)
    (outer,) = torch.autograd.grad(found.sum(), x)
    torch.testing.assert_close(outer, 2 * x.detach())


def test_the_jacobian_of_a_pointwise_function_is_that_of_torch_func_in_and_outside_of_vmap():
    (x, y), scale, rows = sample(), torch.full((5, 1), 1.7, dtype=torch.float64), [3, 0]
    value, (by_x, by_y) = pointwise_jacobian(flow, rows, x, y, constants=[scale])
    assert torch.equal(value, flow(x, y, scale))
    expected = vmap(jacrev(lambda x, y, s: flow(x[None], y[None], s[None])[0], argnums=(0, 1)))(x, y, scale)
    for found, other in zip((by_x, by_y), expected, strict=True):
        assert not found.requires_grad
        torch.testing.assert_close(found, other[:, rows], rtol=0, atol=1e-14)
    again = vmap(lambda x, y, s: pointwise_jacobian(flow, rows, x[None], y[None], constants=[s[None]])[1])(x, y, scale)
    torch.testing.assert_close(again[0][:, 0], by_x)
    none, (empty, _) = pointwise_jacobian(flow, [], x, y, constants=[None])
    assert torch.equal(none, flow(x, y, None))
    assert empty.shape == (5, 0, 2)


def test_a_function_of_nothing_has_zero_slopes():
    x, y = sample()
    value, slopes = pointwise_jacobian(lambda x, y: torch.ones_like(x), [0, 1], x, y)
    assert torch.equal(value, torch.ones_like(x))
    assert all(torch.equal(found, x.new_zeros(5, 2, 2)) for found in slopes)
    row, slopes = row_gradients(lambda x: torch.ones_like(x[..., :1]), x)
    assert torch.equal(row, x.new_ones(5, 1))
    assert torch.equal(slopes[0], x.new_zeros(1, 5, 2))


def test_row_gradients_are_the_rows_of_the_jacobian_for_every_member_of_a_batch():
    x, y = sample(n=3)

    def rows(x: Tensor, y: Tensor) -> Tensor:
        return torch.stack([(x * y).sum(-1), (x**2).sum(-1), y[..., 0]], -1)

    value, (by_x, by_y) = row_gradients(rows, x, y)
    assert torch.equal(value, rows(x, y))
    expected = vmap(jacrev(rows, argnums=(0, 1)))(x, y)
    torch.testing.assert_close(by_x.movedim(0, -2), expected[0])
    torch.testing.assert_close(by_y.movedim(0, -2), expected[1])


def test_inference_mode_which_would_make_gradients_zero_is_refused():
    x, y = sample()
    with torch.inference_mode(), pytest.raises(RuntimeError, match=r"use torch\.no_grad"):
        gradients(energy, x, y)
