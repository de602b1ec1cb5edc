"""The minimum-time twin: its answers in closed form, and what is said of a final time too short."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.double_integrator import minimum_energy, minimum_time
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.feasibility import check_final_time, minimum_time_twin
from ponn_torch.solving.solver import Solver


def hurried(final_time: float) -> OptimalControlProblem:
    """From rest to rest over one metre with |u| ≤ 1 and least effort: two seconds are needed."""
    return replace(minimum_energy(), control=Box("force", 1.0, -1.0, size=1), final_time=final_time)


@pytest.mark.parametrize(("final_time", "infeasible"), [(1.9, True), (2.1, False)])
def test_the_minimum_time_decides(final_time: float, infeasible: bool) -> None:
    found = check_final_time(hurried(final_time), Solver())
    assert found is not None
    assert found.minimum_time == pytest.approx(2.0, abs=1e-8)
    assert found.infeasible is infeasible
    assert ("infeasible unless a quicker one exists" in found.message) is infeasible
    assert "takes 2 s" in found.message
    assert f"final_time = {final_time:g} s" in found.message


def test_without_a_certificate_nothing_is_claimed() -> None:
    found = check_final_time(hurried(1.0), Solver(start_limit=1e-300, n_starts=1))
    assert found is not None
    assert found.minimum_time is None
    assert not found.infeasible
    assert "not known" in found.message


@pytest.mark.parametrize("problem", [minimum_time(), minimum_energy()], ids=["free time", "no bounds"])
def test_where_the_question_does_not_arise(problem: OptimalControlProblem) -> None:
    assert check_final_time(problem, Solver()) is None


def test_a_control_without_bounds_has_no_twin() -> None:
    with pytest.raises(ValueError, match="no bounds"):
        minimum_time_twin(minimum_energy())


def test_a_landing_in_thirty_seconds_is_infeasible() -> None:
    found = check_final_time(mars_landing(final_time=30.0), Solver())
    assert found is not None
    assert found.infeasible
    assert found.minimum_time == pytest.approx(40.072064198, abs=1e-6)


def test_the_costates_of_the_twin_are_of_order_one() -> None:
    result = Solver().solve(minimum_time_twin(mars_landing()))
    assert result.solution is not None
    knots = result.solution.curve.knots[:, result.solution.bvp.n_states :]
    assert 0.02 < float(knots.abs().max()) < 50.0
