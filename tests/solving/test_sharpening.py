"""Sharper curves show the structure, on segments that resolve them; a singular arc is recognised."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers import collocation
from test_singular_arcs import regulator
from torch import Tensor

from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.solving.guess import project
from ponn_torch.solving.sharpening import graded_times
from ponn_torch.solving.singular_arcs import Stretch, undecided, vanishing
from ponn_torch.solving.switching import switching_along


def with_switching(s: Callable[[Tensor], Tensor]) -> Curve:
    """A curve of the regulator whose S is a given function of time."""
    made = collocation(pontryagin(regulator(x=0.0), chains=False), n_neurons=40, n_nodes=60)
    one = torch.ones(1, dtype=torch.float64)
    unit = switching_along(Curve(made, project(made, lambda t: torch.stack([0 * t, 0 * t + 1], -1))), one)
    return Curve(made, project(made, lambda t: torch.stack([0 * t, s(t) / unit[0, 0]], -1)))


def crossing(t: Tensor) -> Tensor:
    return torch.sin(2.0 * t - 1.0)


def test_halving_the_smoothing_adds_few_segments():
    """ln 2 / RESOLUTION of the variation of asinh on both sides of every one of the two switches."""
    curve = with_switching(crossing)
    counts = [len(graded_times(curve, 2.0**-k, 8)) for k in range(4, 14)]
    assert counts == sorted(counts)
    assert (counts[-1] - counts[0]) / 9 == pytest.approx(2 * math.log(2), rel=0.2)


@pytest.mark.parametrize("smoothing", [1e-1, 1e-2, 1e-3])
def test_graded_segments_resolve_the_smoothed_control(smoothing):
    curve = with_switching(crossing)
    times = graded_times(curve, smoothing, 8)
    assert bool((times.diff() > 0).all())
    assert times[[0, -1]].tolist() == curve.times.tolist()

    def error(knots: np.ndarray) -> float:
        worst = 0.0
        for start, end in pairwise(knots):
            grid = np.linspace(start, end, 101)
            fit = np.polynomial.Chebyshev.interpolate(
                lambda t: np.tanh(np.sin(2 * t - 1) / smoothing), 13, (start, end)
            )
            worst = max(worst, np.abs(fit(grid) - np.tanh(np.sin(2 * grid - 1) / smoothing)).max())
        return worst

    graded = error(times.numpy())
    assert graded < 1e-3
    if smoothing <= 1e-2:
        assert graded < 0.05 * error(np.linspace(0.0, 3.0, len(times)))


def test_the_undecided_interval_is_the_longest_with_s_below_the_smoothing():
    component, start, end = undecided(with_switching(lambda t: (t - 1.0) * (t - 2.5) ** 2), 0.1)
    assert component == 0
    inside = [t for t in np.linspace(2.0, 3.0, 100001) if abs((t - 1.0) * (t - 2.5) ** 2) <= 0.1]
    assert (start, end) == pytest.approx((inside[0], inside[-1]), abs=3e-3)
    assert undecided(with_switching(lambda t: 1.0 + t), 0.1).length == 0.0


@pytest.mark.parametrize(("power", "singular"), [(1.0, False), (0.5, False), (0.0, True)])
def test_an_interval_that_does_not_shrink_is_singular(power, singular):
    """Widths fall as ρ about a switch and as √ρ where S touches zero."""
    rungs = [(rho, Stretch(0, 1.0, 1.0 + 0.5 * rho**power)) for rho in (0.1, 0.05, 0.025, 0.0125, 0.00625)]
    found = vanishing(rungs)
    assert (found == rungs[-1][1]) if singular else (found is None)
    assert vanishing(rungs[:2]) is None  # too few to tell
    assert vanishing([]) is None
    assert vanishing([*rungs[:-1], (0.00625, rungs[-1][1]._replace(function=1))]) is None
