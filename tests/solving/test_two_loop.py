"""The papers' two loops end where the split ends, and say so where they do not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from ponn_torch.optim.base import Record
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.problems.double_integrator import minimum_fuel
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.continuation import Ladder
from ponn_torch.solving.refinement import Outcome
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.two_loop import TwoLoop


@pytest.fixture(scope="module")
def smoothed_landing() -> Solution:
    problem = mars_landing(
        initial_position=(-900.0, 100.0, 1500.0),
        initial_velocity=(30.0, -10.0, -70.0),
        mass_flow_per_thrust=5.0863e-4,
        free_final_time=True,
    )
    solution = Solver(refinement=None, continuation=Ladder((1.0, 0.1))).solve(problem).solution
    assert solution is not None
    return solution


def test_a_free_time_landing_is_solved_to_its_optimum(smoothed_landing: Solution) -> None:
    seen: list[int] = []

    def callback(collocation: Collocation) -> object:
        def on_iteration(record: Record, xi: torch.Tensor, residual: torch.Tensor) -> None:
            assert collocation.cost(xi) > 0  # the whole of ξ
            seen.append(len(residual))

        return on_iteration

    refined = TwoLoop().run(smoothed_landing.curve, callback)  # type: ignore[arg-type]
    solution = Solution(refined.curve)
    assert refined.outcome is Outcome.SOLVED
    assert len(refined.rounds) > 3  # outer evaluations, each an inner solve
    assert len(seen) == sum(result.n_iterations for result in refined.rounds)
    assert solution.cost == pytest.approx(179.4476468458, abs=1e-8)
    assert solution.switch_times == pytest.approx([7.4430057683], abs=1e-8)
    assert solution.final_time == pytest.approx(31.2623123369, abs=1e-8)


def test_too_few_inner_solves_are_a_failure_and_not_an_error(smoothed_landing: Solution) -> None:
    refined = TwoLoop(max_rounds=2).run(smoothed_landing.curve)
    assert refined.outcome is Outcome.RESIDUAL
    assert len(refined.rounds) == 2


def test_arcs_are_not_repaired() -> None:
    """A curve that shows other arcs than the optimum has ends without a solution."""
    problem = minimum_fuel()
    smoothed = Solver(refinement=None).solve(problem).solution
    assert smoothed is not None
    three = TwoLoop().run(smoothed.curve)
    assert three.outcome is Outcome.SOLVED
    assert Solution(three.curve).cost == pytest.approx(problem.known_cost, rel=1e-10)
    flat = replace(smoothed.curve, xi=torch.zeros_like(smoothed.curve.xi))
    assert TwoLoop().run(flat).outcome in (Outcome.RESIDUAL, Outcome.STRUCTURE)
