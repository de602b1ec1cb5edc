"""Problems with exact answers, loadable by file reference, and a short way to solve them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from ponn_torch.ansatz.basis import Chebyshev, FreeFunction
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_laws import Box, Unconstrained
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import pontryagin, with_singular_arcs
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem
from ponn_torch.optimal_control.singular import singular_components
from ponn_torch.solving.guess import project
from ponn_torch.solving.solution import Solution


def minimum_energy(*, distance: float = 1.0) -> OptimalControlProblem:
    """Rest to rest over ``distance`` in one second: u = d (6 − 12 t), cost 6 d²."""
    return OptimalControlProblem(
        name="minimum_energy",
        states={"x": 1, "v": 1},
        control=Unconstrained("u", 1),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u},
        running_cost=lambda t, x, u, p: 0.5 * u.u**2,
        initial={"x": 0.0, "v": 0.0},
        final={"x": distance, "v": 0.0},
        final_time=1.0,
        known_cost=6.0 * distance**2,
    )


def saturated_energy() -> OptimalControlProblem:
    """The same with |u| ≤ 5: saturated up to t = (1 − √0.6)/2 and again in the end."""
    return OptimalControlProblem(
        name="saturated_energy",
        states={"x": 1, "v": 1},
        control=Box("u", 5.0, -5.0, size=1),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u},
        running_cost=lambda t, x, u, p: 0.5 * u.u**2,
        initial={"x": 0.0, "v": 0.0},
        final={"x": 1.0, "v": 0.0},
        final_time=1.0,
        known_cost=25.0 * (1 - 0.6**0.5) / 2 + 25.0 * 0.6**0.5 / 6,
    )


def minimum_time() -> OptimalControlProblem:
    """Rest to rest over one metre with |u| ≤ 1 m/s²: full thrust, then full brake, 2 s."""
    return OptimalControlProblem(
        name="minimum_time",
        states={"x": 1, "v": 1},
        control=Box("u", 1.0, -1.0, size=1),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u},
        running_cost=lambda t, x, u, p: torch.ones_like(t),
        initial={"x": 0.0, "v": 0.0},
        final={"x": 1.0, "v": 0.0},
        final_time=FreeTime(1.9),
        cost_name="time",
        known_cost=2.0,
    )


def growing_cost() -> OptimalControlProblem:
    """∫ ½u² + t x with ẋ = u, x(1) free: x = −t/2 + t³/6, cost −1/15; H depends on time."""
    return OptimalControlProblem(
        name="growing_cost",
        states={"x": 1},
        control=Unconstrained("u", 1),
        dynamics=lambda t, x, u, p: {"x": u.u},
        running_cost=lambda t, x, u, p: 0.5 * u.u**2 + t * x.x,
        initial={"x": 0.0},
        final={},
        final_time=1.0,
        known_cost=-1 / 15,
    )


def soft_end(*, stiffness: float = 3.0) -> OptimalControlProblem:
    """∫ ½u² + ½k x(1)² from x = 1: cost ½ k/(1 + k)."""
    return OptimalControlProblem(
        name="soft_end",
        states={"x": 1},
        control=Unconstrained("u", 1),
        dynamics=lambda t, x, u, p: {"x": u.u},
        running_cost=lambda t, x, u, p: 0.5 * u.u**2,
        terminal_cost=lambda t, x, p: 0.5 * stiffness * x.x**2,
        initial={"x": 1.0},
        final={},
        final_time=1.0,
        known_cost=0.5 * stiffness / (1 + stiffness),
    )


def onto_circle() -> OptimalControlProblem:
    """∫ ½|u|² from (2, 1) to the unit circle in one second: cost ½(√5 − 1)²."""
    return OptimalControlProblem(
        name="onto_circle",
        states={"x": 2},
        control=Unconstrained("u", 2),
        dynamics=lambda t, x, u, p: {"x": u.u},
        running_cost=lambda t, x, u, p: 0.5 * (u.u**2).sum(-1, keepdim=True),
        terminal_manifold=lambda t, x, p: (x.x**2).sum(-1, keepdim=True) - 1.0,
        initial={"x": [2.0, 1.0]},
        final={},
        final_time=1.0,
        known_cost=0.5 * (5**0.5 - 1) ** 2,
    )


def unstable() -> OptimalControlProblem:
    """∫ ½u² with ẋ = x + u from 1 to 0 in one second: cost e²/(e² − 1)."""
    return OptimalControlProblem(
        name="unstable",
        states={"x": 1},
        control=Unconstrained("u", 1),
        dynamics=lambda t, x, u, p: {"x": x.x + u.u},
        running_cost=lambda t, x, u, p: 0.5 * u.u**2,
        initial={"x": 1.0},
        final={"x": 0.0},
        final_time=1.0,
        known_cost=1 / (1 - math.exp(-2)),
    )


def regulator() -> OptimalControlProblem:
    """∫ x² with ẋ = u, |u| ≤ 1 from x = 1: down to zero, then the singular arc x = 0."""
    return OptimalControlProblem(
        name="regulator",
        states={"x": 1},
        control=Box("u", 1.0, -1.0, size=1),
        dynamics=lambda t, x, u, p: {"x": u.u},
        running_cost=lambda t, x, u, p: x.x**2,
        initial={"x": 1.0},
        final={"x": 0.0},
        final_time=2.0,
        known_cost=1 / 3,
    )


def solve(
    problem: OptimalControlProblem,
    guess: Sequence[Sequence[float]],
    *,
    basis: FreeFunction | None = None,
    n_nodes: int = 20,
    switches: Sequence[float] = (),
    arcs: Sequence[int] | None = None,
    events: Sequence[Sequence[int] | None] | None = None,
    smoothing: float | None = None,
    conditioning: str = "columns",
    mass_variable: str = "auto",
    dtype: torch.dtype = torch.float64,
    tolerance: float = 1e-13,
) -> Solution:
    """Solve from a straight line between ``guess`` values of w at both ends, on arcs between ``switches``."""
    bvp = pontryagin(problem, mass_variable=mass_variable, dtype=dtype)
    codes = None if arcs is None else torch.tensor(arcs)[:, None]
    bvp = with_singular_arcs(bvp, singular_components(bvp.law, codes))
    nodes = make_nodes("legendre_gauss", n_nodes, dtype=dtype)
    disc = Discretisation(bvp, basis or Chebyshev(10), nodes, conditioning=conditioning)
    regime = Regime(
        smoothing=None if smoothing is None else torch.tensor(smoothing, dtype=dtype),
        arcs=codes,
    )
    times = torch.tensor([0.0, *switches, bvp.final_time], dtype=dtype)
    events = events if events is not None else [(0,)] * len(switches)
    collocation = Collocation.on_segments(disc, times, events=events, setting=Setting(regime))
    start, end = (torch.tensor(values, dtype=dtype) for values in guess)
    xi = project(collocation, lambda t: start + (end - start) * (t / times[-1])[:, None])
    optimizer = LevenbergMarquardt(Stopping(tolerance=tolerance, decrease=1e-5), damping=1e-6)
    return Solution(Curve(collocation, optimizer.run(collocation, xi).xi))


def solve_saturated(codes: Sequence[int] = (2, 1, 0)) -> Solution:
    """The saturated problem on its three arcs, found from switches 0.1 and 0.9."""
    return solve(
        saturated_energy(),
        [[0.0, 0, -6, -6], [1.0, 0, -6, 6]],
        switches=[0.1, 0.9],
        arcs=codes,
        events=[(1,), (0,)],
    )


def solve_minimum_time() -> Solution:
    """Two arcs from a switch at 0.9 of 1.9 s."""
    return solve(minimum_time(), [[0.0, 0, -1, -1], [1.0, 0, -1, 1]], switches=[0.9], arcs=[2, 0])


def with_codes(solution: Solution, codes: list[int]) -> Solution:
    """The same curve, claimed to lie on other arcs."""
    collocation = solution.curve.collocation
    regime = Regime(arcs=torch.tensor(codes)[:, None])
    setting = replace(collocation.setting, regime=regime)
    return Solution(Curve(replace(collocation, setting=setting), solution.curve.xi))
