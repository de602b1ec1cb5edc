"""Piecewise interpolants meet smooth functions to round-off and enclose what is not smooth."""

from __future__ import annotations

import numpy as np
import pytest

from ponn_torch.numerics.piecewise import approximate

TOLERANCES = {"layer": 3e-10, "kink": 1e-7}  # round-off of 1e-16/1e-6; the panel of the kink is 1e-6 long

FUNCTIONS = {
    "polynomial": lambda t: np.stack([t**3 - t, 0 * t + 2.5], -1),
    "oscillation": lambda t: np.sin(80 * t)[:, None],
    "layer": lambda t: np.tanh((t - 0.437) / 1e-6)[:, None],
    "kink": lambda t: np.abs(t - 0.437)[:, None],
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_are_met_everywhere(name):
    function = FUNCTIONS[name]
    history = approximate(function, -1.0, 2.0)
    t = np.concatenate([np.linspace(-1, 2, 301), 0.437 + np.linspace(-1e-5, 1e-5, 41)])
    found = np.stack([history(float(x)) for x in t])
    np.testing.assert_allclose(found, function(t), rtol=0, atol=TOLERANCES.get(name, 2e-11))


def test_panels_shrink_where_the_function_is_fast():
    history = approximate(FUNCTIONS["layer"], 0.0, 1.0)
    edges = np.array(history.edges)
    widths = np.diff(edges)
    fast = np.abs(edges[:-1] - 0.437) < 1e-6
    assert widths.max() == pytest.approx(1 / 16)
    assert widths[fast].max() < 1e-5
    assert (edges[0], edges[-1]) == (0.0, 1.0)
    assert (widths > 0).all()


def test_a_jump_is_enclosed():
    history = approximate(lambda t: (t < 0.437)[:, None].astype(float), 0.0, 1.0)
    assert [float(history(x)[0]) for x in (0.43699999, 0.43700001)] == pytest.approx([1.0, 0.0], abs=1e-12)
    assert len(history.edges) < 100


def test_noise_costs_few_panels():
    generator = np.random.default_rng(0)
    history = approximate(lambda t: (np.exp(t) + 1e-9 * generator.standard_normal(t.shape))[:, None], 0.0, 1.0)
    assert len(history.edges) < 70
    assert float(history(0.5)[0]) == pytest.approx(np.exp(0.5), abs=1e-8)


def test_noise_about_zero_costs_few_panels_where_the_size_is_known():
    """A control that is zero along an arc, to round-off, is not resolved to the digits of that."""

    def noise(t):
        return 1e-17 * np.sin(1e9 * t)[:, None]

    assert len(approximate(noise, 0.0, 1.0, sizes=np.array([0.5])).edges) == 17
    assert len(approximate(noise, 0.0, 1.0).edges) > 500
