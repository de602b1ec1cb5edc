"""Solved problems of every kind, each solved once for all tests of the reports."""

import matplotlib
import pytest
import torch

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_laws import Box, Unconstrained
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import DisplayUnit, OptimalControlProblem
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.continuation import Ladder, Single
from ponn_torch.solving.guess import RandomGuess, project
from ponn_torch.solving.result import SolveResult, StageResult
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver


@pytest.fixture(autouse=True)
def _matplotlib_is_left_as_it_was():
    before = dict(matplotlib.rcParams)
    yield
    changed = [name for name in before if matplotlib.rcParams[name] != before[name]]
    assert changed == []


def rest_to_rest(size, control, cost):
    """Move by one unit and stop, in one unit of time; position r, velocity v, no display units."""
    return OptimalControlProblem(
        name=f"rest_to_rest_{size}",
        states={"r": size, "v": size},
        control=control,
        dynamics=lambda t, x, u, p: {"r": x.v, "v": u.acceleration},
        running_cost=cost,
        initial={"r": [0.0] * size, "v": [0.0] * size},
        final={"r": [1.0] * size, "v": [0.0] * size},
        final_time=1.0,
    )


def energy(t, x, u, p):
    return 0.5 * u.acceleration.square().sum(-1, keepdim=True)


def harvest():
    """Scalar state of a Greek name with a box control that H is affine in: wait, then work."""
    return OptimalControlProblem(
        name="harvest",
        states={"theta": 1},
        control=Box("rate", 1.0, 0.0),
        dynamics=lambda t, x, u, p: {"theta": u.rate},
        running_cost=lambda t, x, u, p: x.theta + 0.0 * u.rate,
        initial={"theta": 0.0},
        final={"theta": 0.5},
        final_time=1.0,
        display={"time": DisplayUnit("h", 3600.0), "theta": DisplayUnit("deg", 3.14159 / 180)},
    )


def small(**choices):
    """A conductor for one coarse stage."""
    plain = {"continuation": Single(1.0), "refinement": None}
    return Solver(basis=Chebyshev(16), n_nodes=24, n_starts=1, **(plain | choices))


def one_stage(problem, smoothing=None):
    """What a solve without certificate leaves: a solution and its stage."""
    bvp = pontryagin(problem)
    disc = small().discretisation(bvp)
    collocation = Collocation.on_segments(disc, torch.tensor([0.0, bvp.final_time], dtype=torch.float64))
    if smoothing is not None:
        collocation = collocation.with_setting(smoothing=smoothing)
    start = project(collocation, RandomGuess().curve(bvp, 0))
    result = LevenbergMarquardt(Stopping(tolerance=1e-9, decrease=1e-3)).run(collocation, start)
    solution = Solution(Curve(collocation, result.xi))
    counts = (result.n_iterations, result.n_residuals, result.n_linearisations, result.cpu_seconds)
    stage = StageResult(
        "smooth",
        smoothing,
        result.status,
        float(result.norm),
        *counts,
        solution.off_node_residual,
        solution.cost,
        result.records,
        solution=solution,
    )
    return SolveResult(solution, None, [stage], 1, "", result.cpu_seconds)


SOLVES = {
    "split": lambda: Solver(continuation=Ladder((1.0, 0.3, 0.1))).solve(mars_landing()),
    "smoothed": lambda: one_stage(mars_landing(), 1.0),
    "smooth, three axes": lambda: one_stage(rest_to_rest(3, Unconstrained("acceleration", 3), energy)),
    "smooth, plane": lambda: one_stage(rest_to_rest(2, Unconstrained("acceleration", 2), energy)),
    "saturated box": lambda: one_stage(rest_to_rest(2, Box("acceleration", 5.0, -5.0, size=2), energy)),
    "box, no position": lambda: one_stage(harvest(), 0.3),
}


@pytest.fixture(scope="session")
def solved():
    """kind → SolveResult, solved when first asked for."""
    kept = {}

    def get(kind):
        if kind not in kept:
            kept[kind] = SOLVES[kind]()
            assert kept[kind].stages[-1].norm < 0.1
        return kept[kind]

    return get
