"""Neighbours solved warm are the solutions that they claim to be."""

from __future__ import annotations

import pytest
import torch

from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.certificate import certify
from ponn_torch.solving.family import Family, Restart
from ponn_torch.solving.refinement import Segmentation
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver

START = {"initial_position": (-900.0, 100.0, 1500.0), "initial_velocity": (30.0, -10.0, -70.0)}


def landing(**changes: object):
    data = {**START, "mass_flow_per_thrust": 5.0863e-4, "free_final_time": True, "final_time": 45.0, **changes}
    return mars_landing(**data)


def states(problem) -> torch.Tensor:
    return torch.tensor([problem.boundary("initial")], dtype=torch.float64)


@pytest.fixture(scope="module")
def solution() -> Solution:
    result = Solver().solve(landing(), 0)
    assert result.certified
    return result.solution


def test_a_neighbour_is_the_solution_of_its_own_problem(solution):
    problem = landing(initial_position=(-880.0, 110.0, 1480.0), initial_velocity=(32.0, -8.0, -69.0))
    found, solved = Family.of(solution.curve).restart(
        torch.cat([states(landing()), states(problem)]), how=Restart(Segmentation(n_segments=8))
    )
    assert solved.all()
    torch.testing.assert_close(found.arc_times[:1], Family.of(solution.curve).arc_times, rtol=1e-9, atol=0)
    cold = Solver().solve(problem, 0)
    assert cold.certified
    times = found.arc_times[1] * found.collocation.bvp.time_unit
    assert float(times[-1]) == pytest.approx(cold.solution.final_time, abs=1e-7)
    assert float(times[1]) == pytest.approx(cold.solution.switch_times[0], abs=1e-6)


def test_on_the_same_segments_a_restart_needs_no_fit(solution, monkeypatch):
    problem = landing(initial_position=(-880.0, 110.0, 1480.0))
    family, solved = Family.of(solution.curve).restart(states(landing()))
    assert solved.all()
    fitted = family.restart(states(problem), at=1e-9)[0]  # another start of the time, so that it has to be fitted
    monkeypatch.setattr("ponn_torch.solving.family.project", None)
    found, solved = family.restart(states(problem))
    assert solved.all()
    torch.testing.assert_close(found.arc_times[:, 1:], fitted.arc_times[:, 1:], rtol=0, atol=1e-8)


def test_the_rest_of_an_optimal_trajectory_is_optimal(solution):
    family, unit = Family.of(solution.curve), solution.bvp.time_unit
    for seconds, passed in ((4.0, 0), (15.0, 1)):
        at = torch.tensor([seconds / unit], dtype=torch.float64)
        there = solution.bvp.to_physical(family(at[:, None])[:, 0])[0]
        rest, solved = family.restart(there, at, passed=passed)
        assert solved.all()
        assert rest.n_arcs == 2 - passed
        torch.testing.assert_close(rest.arc_times[:, 1:], family.arc_times[:, passed + 1 :], rtol=1e-9, atol=0)
        later = torch.tensor([[20.0 / unit]], dtype=torch.float64)
        for name, value in rest.control(later).items():
            torch.testing.assert_close(value, family.control(later)[name], rtol=1e-7, atol=0)


def test_arcs_that_do_not_fit_are_noticed(solution):
    # the same two arcs solve the residual from here, but S asks for a burn at the beginning
    problem = landing(initial_position=(-700.0, 100.0, 1500.0), initial_velocity=(80.0, -10.0, -70.0))
    found, solved = Family.of(solution.curve).restart(states(problem))
    assert not solved.any()
    assert not certify(Solver().solve(problem, 0).solution).verdict.startswith("certified extremal with arcs min-max:")
    assert float(found.disagreement()) > 1e-4 or not bool(torch.isfinite(found.xi).all())


def test_members_can_be_chosen_and_taken_out(solution):
    family = Family.of(solution.curve)
    three = family[torch.tensor([0, 0, 0])]
    assert len(three) == 3
    found, _ = three.restart(states(landing()).repeat(3, 1) + torch.tensor([[0.0], [5.0], [-5.0]], dtype=torch.float64))
    alone = found.curve(1)
    at = torch.tensor([0.1, 0.5], dtype=torch.float64)
    assert torch.equal(alone(at), found(at.expand(3, 2))[1])


def test_bad_input_is_named(solution):
    family = Family.of(solution.curve)
    with pytest.raises(ValueError, match=r"states have shape \(1, 6\); allowed: \(1, 7\)"):
        family.restart(torch.ones(1, 6, dtype=torch.float64))
    with pytest.raises(ValueError, match="passed = 2; allowed: 0 to 1"):
        family.restart(states(landing()), passed=2)
    smoothed = Solver(refinement=None).solve(landing(), 0).solution
    with pytest.raises(ValueError, match=r"smoothing = 0\.03; allowed: a split"):
        Family.of(smoothed.curve)
