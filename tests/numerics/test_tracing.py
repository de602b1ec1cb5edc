"""A traced function gives the same values, and what cannot be traced comes back as it is."""

from __future__ import annotations

import pytest
import torch
from torch.func import grad, vmap

from ponn_torch.numerics.tracing import trace


def pendulum(t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    gradient = grad(lambda y: (torch.cos(y[0]) + 0.5 * y[1] ** 2 * torch.exp(-t[0])).sum())(x)
    return torch.cat([gradient, torch.where(x > 0, x, torch.zeros_like(x)) + x.new_tensor((1.0, 2.0))])


def clamped(t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    return torch.linalg.solve(torch.diag(x.abs() + 1), x.clamp(-0.5, 0.5)) * t


def constant(t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    return torch.ones_like(x) * 3.0


def batched(t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    return vmap(lambda a: a * a + t[0])(x)


def branching(t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    return x if float(x[0]) > 0 else -2 * x


def counting(t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    total = torch.zeros_like(x)
    total += x
    return total


def points(count: int = 20) -> list[tuple[torch.Tensor, torch.Tensor]]:
    generator = torch.Generator().manual_seed(0)
    draw = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return [(row[:1], row[1:]) for row in draw]


@pytest.mark.parametrize("function", [pendulum, clamped, constant, batched])
def test_the_graph_gives_the_same_values_at_other_points(function):
    traced = trace(function, *points()[0])
    assert isinstance(traced, torch.fx.GraphModule)
    for point in points():
        torch.testing.assert_close(traced(*point), function(*point), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("function", [branching, counting])
def test_what_cannot_be_traced_comes_back(function):
    assert trace(function, *points()[0]) is function


def test_the_graph_is_shorter_than_what_was_recorded():
    def twice(t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        return torch.cat([torch.exp(x * torch.ones_like(x)), torch.exp(x * torch.ones_like(x))])

    traced = trace(twice, *points()[0])
    assert sum("exp" in node.name for node in traced.graph.nodes) == 1
