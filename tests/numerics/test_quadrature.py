"""Adaptive quadrature is exact on what is smooth, and finds layers, jumps and round-off."""

from __future__ import annotations

import math

import pytest
import torch

from ponn_torch.numerics.quadrature import integrate

EDGES = torch.linspace(0.0, 1.0, 17, dtype=torch.float64)


@pytest.mark.parametrize(
    ("function", "exact"),
    [
        (torch.exp, math.e - 1),
        (lambda t: t**19, 1 / 20),
        (lambda t: (t < 0.437).to(t.dtype), 0.437),
        (lambda t: 1e-9 / ((t - 0.437) ** 2 + 1e-18), math.atan(0.563e9) + math.atan(0.437e9)),
        (torch.sqrt, 2 / 3),
        (torch.zeros_like, 0.0),
    ],
    ids=["exp", "power", "jump", "peak", "root", "zero"],
)
def test_integrals_are_exact(function, exact):
    assert integrate(function, EDGES) == pytest.approx(exact, abs=1e-12)


def test_noise_ends_the_halving():
    calls = []

    def noise(t: torch.Tensor) -> torch.Tensor:
        calls.append(len(t))
        return torch.randn(len(t), dtype=t.dtype, generator=torch.Generator().manual_seed(len(calls)))

    assert abs(integrate(noise, EDGES)) < 1.0
    assert sum(calls) < 300_000


def test_uneven_edges_and_the_dtype_are_those_given():
    edges = torch.tensor([0.0, 0.1, 3.0], dtype=torch.float32)
    seen = []

    def function(t: torch.Tensor) -> torch.Tensor:
        seen.append(t.dtype)
        return torch.cos(t)

    assert integrate(function, edges, tolerance=1e-6) == pytest.approx(math.sin(3.0), abs=1e-6)
    assert set(seen) == {torch.float32}
