"""Switch neurons: the integrals of tanh to round-off, exact derivatives, the right order for every chain."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.special import spence

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.ansatz.constraints import hermite
from ponn_torch.ansatz.expression import ConstrainedExpression
from ponn_torch.ansatz.switch_neurons import SwitchNeuronBasis, tanh_integral
from ponn_torch.numerics.nodes import graded_edges, make_panels

SIZES = np.concatenate([[0.0], np.logspace(-9, 5, 60)])
POINTS = np.concatenate([-SIZES[:0:-1], SIZES])


def error(times: int, exact: np.ndarray) -> np.ndarray:
    """In units of max(1, |u|^times)."""
    found = tanh_integral(torch.as_tensor(POINTS), times).numpy()
    return np.abs(found - exact) / np.maximum(1.0, np.abs(POINTS) ** times)


def test_the_first_integral_is_log_cosh():
    size = np.abs(POINTS)
    assert error(1, size + np.log1p(np.exp(-2 * size)) - math.log(2)).max() < 1e-15


def test_the_second_integral_is_a_dilogarithm():
    size = np.abs(POINTS)
    dilogarithm = spence(1 + np.exp(-2 * size))  # SciPy's spence(z) is Li2(1 − z)
    exact = size**2 / 2 - size * math.log(2) + math.pi**2 / 24 + dilogarithm / 2
    assert error(2, np.sign(POINTS) * exact).max() < 3e-15


@pytest.mark.parametrize("times", [1, 2, 3, 5])
@pytest.mark.parametrize("u", [-3.7, -0.2, 0.9, 12.0])
def test_every_integral_is_cauchys(times, u):
    """(1/(n−1)!) ∫₀ᵘ (u − s)^(n−1) tanh s ds."""
    exact, _ = quad(lambda s: (u - s) ** (times - 1) / math.factorial(times - 1) * math.tanh(s), 0, u, epsabs=1e-14)
    assert float(tanh_integral(torch.tensor(u, dtype=torch.float64), times)) == pytest.approx(exact, rel=1e-13)


def units(order: int = 2) -> SwitchNeuronBasis:
    return SwitchNeuronBasis(Chebyshev(3), [-0.3, 0.2, 0.2], [4.0, 30.0, 1000.0], [0, 1, 2], order)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_derivative_of_a_unit_that_it_stands_for_is_tanh(order):
    basis, z = units(order), torch.linspace(-1, 1, 41, dtype=torch.float64)
    features = basis.features(z, order + 2)
    for i in range(3):
        exact = torch.tanh(basis.slopes[i] * (z - basis.centres[i]))
        torch.testing.assert_close(features[order + i, :, 3 + i], exact, rtol=0, atol=1e-15)
    torch.testing.assert_close(features[..., :3], Chebyshev(3).features(z, order + 2))


def test_every_derivative_is_that_of_the_one_before():
    """By central differences of eighth order, in steps that the steepest unit resolves."""
    basis, step = SwitchNeuronBasis(Chebyshev(2), [0.1, -0.4], [5.0, 8.0], [0, 1]), 1e-2
    weights = torch.tensor([4 / 5, -1 / 5, 4 / 105, -1 / 280], dtype=torch.float64)
    z, order = torch.linspace(-0.9, 0.9, 13, dtype=torch.float64), 5
    exact, slope = basis.features(z, order), 0.0
    for k, weight in enumerate(weights.tolist(), start=1):
        slope = slope + weight * (basis.features(z + k * step, order) - basis.features(z - k * step, order)) / step
    exact, slope = exact[..., 2:], slope[..., 2:]
    scale = exact.abs().amax(1, keepdim=True)
    torch.testing.assert_close(slope[:-1] / scale[1:], exact[1:] / scale[1:], rtol=0, atol=1e-7)


@pytest.mark.parametrize("order", [1, 2])
def test_beyond_serves_a_chain_by_its_supports(order):
    basis = units().beyond(2 * order)
    assert isinstance(basis, SwitchNeuronBasis)
    assert (basis.order, basis.size, basis.smooth.arguments["lowest_degree"]) == (order, 6, 2 * order)


@pytest.mark.parametrize("order", [1, 2])
def test_a_chain_across_a_layer_is_followed_where_polynomials_fail(order):
    """y^(order) = e^z tanh(κ(z − c)) with the ends held: what a chain sees when thrust switches."""
    centre, slope = 0.23, 800.0
    centres, slopes = torch.tensor([centre], dtype=torch.float64), torch.tensor([slope], dtype=torch.float64)
    nodes = make_panels("legendre_gauss", graded_edges(centres, 1 / slopes), 8)
    wanted = torch.exp(nodes.points) * torch.tanh(slope * (nodes.points - centre))
    root, errors = nodes.weights.sqrt(), []
    for basis in (SwitchNeuronBasis.at(Chebyshev(12), centres, slopes, (1.0, 0.8, 1.25), 3), Chebyshev(21)):
        made = ConstrainedExpression(
            basis.beyond(2 * order), hermite(order), nodes=nodes, order=order, conditioning="ordered"
        )
        free, switching = (table[order] for table in made.tables(nodes.points, order))
        table = torch.cat([free, switching], -1) * root[:, None]
        found = table @ torch.linalg.lstsq(table, (root * wanted)[:, None], driver="gelsd").solution
        errors.append(float((found[:, 0] - root * wanted).norm()))
    assert errors[0] < 1e-4 < 0.1 < errors[1]


@pytest.mark.parametrize(
    ("slopes", "lifts", "message"),
    [
        ([1.0], [0, 1], "centres, slopes and lifts have 2, 1 and 2 entries"),
        ([1.0, 0.0], [0, 1], r"slopes = \[1.0, 0.0\]; allowed: positive numbers"),
    ],
)
def test_errors_name_field_value_and_what_is_allowed(slopes, lifts, message):
    with pytest.raises(ValueError, match=message):
        SwitchNeuronBasis(Chebyshev(3), [0.0, 0.1], slopes, lifts)
