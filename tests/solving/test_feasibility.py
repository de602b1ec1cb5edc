"""The twins of minimum time and of least control: answers in closed form, and what is said of what is infeasible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from ponn_torch.ansatz.basis import Legendre
from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.double_integrator import minimum_energy, minimum_time
from ponn_torch.problems.earth_mars import EARTH_VENUS, earth_mars
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.feasibility import check_control, check_final_time, least_control_twin, minimum_time_twin
from ponn_torch.solving.paths import PolarTransfer
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


@pytest.mark.parametrize(("final_time", "infeasible"), [(1.9, True), (2.1, False)])
def test_the_least_control_decides(final_time: float, infeasible: bool) -> None:
    """From rest to rest over one metre: 4/tf², half of the time each way."""
    found = check_control(hurried(final_time), Solver())
    assert found is not None
    assert found.needed == pytest.approx(4 / final_time**2, abs=1e-8)
    assert found.infeasible is infeasible
    least = f"{4 / final_time**2:.8g}"
    if infeasible:
        needs = f"the least-control extremal found (certified) needs force up to {least}, more than 1"
        assert found.message == f"infeasible unless another extremal needs less: {needs}"
    else:
        assert found.message == f"not for want of force: an extremal (certified) needs no more than {least} of 1"


def test_an_extremal_with_a_negative_multiple_answers_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """An engine that makes propellant would: the more the better."""
    solution = Solver().solve(least_control_twin(hurried(2.0))).solution
    assert solution is not None
    assert solution.cost == pytest.approx(1.0)
    monkeypatch.setattr(type(solution), "cost", property(lambda self: -1.0))
    found = check_control(hurried(2.0), Solver())
    assert found is not None
    assert found.needed is None


def test_of_control_too_nothing_is_claimed_without_a_certificate() -> None:
    found = check_control(hurried(1.0), Solver(start_limit=1e-300, n_starts=1))
    assert found is not None
    assert found.needed is None
    assert not found.infeasible
    assert "how much force it needs is not known" in found.message


@pytest.mark.slow
def test_the_least_thrust_of_a_transfer_is_that_at_which_its_time_is_the_shortest() -> None:
    """Two twins, one answer: 0.3297 N is the least for Earth–Mars in 348.795 d, which full thrust all the way takes."""
    found = check_control(earth_mars(maximum_thrust=0.3), Solver())
    assert found is not None
    assert found.infeasible
    assert found.needed is not None
    assert "needs thrust up to 0.32974561 N, more than 0.3 N" in found.message
    quickest = check_final_time(earth_mars(maximum_thrust=found.needed), Solver())
    assert quickest is not None
    assert quickest.minimum_time == pytest.approx(348.795 * 86400, rel=1e-8)


@pytest.mark.slow
def test_one_extra_revolution_to_venus_needs_more_thrust_than_there_is_however_long_it_may_take() -> None:
    """0.473480 N by direct collocation in cylindrical coordinates, where the angle is a boundary value."""
    solver = Solver(
        basis=Legendre(14), conditioning="orthonormal", n_nodes=20, n_segments=12, guess=PolarTransfer(revolutions=1)
    )
    problem = earth_mars(**EARTH_VENUS)
    quickest, weakest = check_final_time(problem, solver), check_control(problem, solver)
    assert quickest is not None
    assert weakest is not None
    assert quickest.minimum_time is not None
    assert not quickest.infeasible
    assert weakest.infeasible
    assert weakest.needed == pytest.approx(0.473480, abs=1e-6)


FREE_OR_UNBOUNDED = {"free time": minimum_time(), "no bounds": minimum_energy()}


@pytest.mark.parametrize("problem", FREE_OR_UNBOUNDED.values(), ids=FREE_OR_UNBOUNDED.keys())
def test_where_the_questions_do_not_arise(problem: OptimalControlProblem) -> None:
    assert check_final_time(problem, Solver()) is None
    assert check_control(problem, Solver()) is None


def test_an_engine_that_cannot_be_shut_off_has_no_least_thrust() -> None:
    assert check_control(mars_landing(), Solver()) is None
    with pytest.raises(ValueError, match=r"thrust from 4971.81 to 13258.2; allowed: bounds that include zero"):
        least_control_twin(mars_landing())


@pytest.mark.parametrize("twin", [minimum_time_twin, least_control_twin])
def test_a_control_without_bounds_has_no_twin(twin: Callable[[OptimalControlProblem], OptimalControlProblem]) -> None:
    with pytest.raises(ValueError, match="not one set with bounds"):
        twin(minimum_energy())


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
