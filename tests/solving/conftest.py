"""Solved landings shared by the tests of this folder."""

from __future__ import annotations

import pytest
import torch

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.references import load_problem
from ponn_torch.solving.guess import RandomGuess, project
from ponn_torch.solving.solution import Solution

LANDING = "ponn_torch.problems.mars_landing:mars_landing"


@pytest.fixture(scope="session")
def smoothed_landing() -> Solution:
    """The PoNN paper's landing at smoothing 0.1 on one domain, from a random start."""
    bvp = pontryagin(load_problem(LANDING))
    disc = Discretisation(bvp, Chebyshev(120), make_nodes("legendre_gauss", 160), conditioning="columns")
    collocation = Collocation.on_segments(disc, torch.tensor([0.0, bvp.final_time], dtype=torch.float64))
    xi = project(collocation, RandomGuess().curve(bvp, 0))
    for smoothing in (1.0, 0.3, 0.1):
        collocation = collocation.with_setting(smoothing=smoothing)
        stopping = Stopping(tolerance=1e-13 if smoothing == 0.1 else 1e-9, decrease=1e-5)
        xi = LevenbergMarquardt(stopping).run(collocation, xi).xi
    return Solution(Curve(collocation, xi))


@pytest.fixture(scope="session")
def split_landing(smoothed_landing: Solution) -> Solution:
    """The landing on its three arcs, from switches rounded to a second."""
    bvp = smoothed_landing.bvp
    disc = Discretisation(bvp, Chebyshev(20), make_nodes("legendre_gauss", 30), conditioning="columns")
    times = torch.tensor([0.0, 31.0, 39.0, bvp.final_time * bvp.time_unit], dtype=torch.float64) / bvp.time_unit
    setting = Setting(Regime(arcs=torch.tensor([[2], [0], [2]])))
    collocation = Collocation.on_segments(disc, times, events=[(0,), (0,)], setting=setting)
    xi = project(collocation, smoothed_landing.curve)
    result = LevenbergMarquardt(Stopping(tolerance=1e-13, decrease=1e-5), damping=1e-8).run(collocation, xi)
    return Solution(Curve(collocation, result.xi))
