"""Direct collocation against known optima, its multipliers against known costates, and its way into the split."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from ponn_torch.baselines.controls import control_variables
from ponn_torch.baselines.direct import TwoStage, Unstructured
from ponn_torch.baselines.transcription import Phase, Program, RadauRule
from ponn_torch.optimal_control.control_set import LOWER, UPPER, ControlSet
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.constants import DAY
from ponn_torch.problems.double_integrator import minimum_energy, minimum_fuel, minimum_time
from ponn_torch.problems.earth_mars import earth_mars
from ponn_torch.problems.energy_transfer import energy_transfer, energy_transfer_limited
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.problems.planar_car import planar_car
from ponn_torch.solving.certificate import certify
from ponn_torch.solving.paths import PolarTransfer
from ponn_torch.solving.solution import Solution

pytest.importorskip("casadi")


def tfc_test_1() -> OptimalControlProblem:
    return mars_landing(
        initial_position=(-900.0, 100.0, 1500.0),
        initial_velocity=(30.0, -10.0, -70.0),
        mass_flow_per_thrust=5.0863e-4,
        free_final_time=True,
    )


def tfc_test_2() -> OptimalControlProblem:
    return mars_landing(initial_velocity=(85.0, 50.0, -65.0), mass_flow_per_thrust=5.0863e-4, free_final_time=True)


def bounded_car() -> OptimalControlProblem:
    return planar_car(maximum_turn=2.0, known_cost=3.801260863077)


# problem → arcs, switch times (s) and final time (s)
BANG_BANG: dict[Callable[[], OptimalControlProblem], tuple[list[str], list[float], float]] = {
    minimum_time: (["max", "min"], [1.0], 2.0),
    planar_car: (["max", "min"], [1.7176930388739], 3.4353860777478),
    bounded_car: (["max,free", "min,free"], [1.7176930388739], 3.4353860777478),
    minimum_fuel: (["max", "min", "max"], [1.5 - 1.25**0.5, 1.5 + 1.25**0.5], 3.0),
    mars_landing: (["max", "min", "max"], [31.0920056478, 39.2202817443], 44.823),
    tfc_test_1: (["min", "max"], [7.4430057683], 31.2623123369),
    tfc_test_2: (["max", "min", "max"], [32.4177195331, 38.8374666748], 44.8228903294),
}


@pytest.mark.parametrize("make", BANG_BANG, ids=lambda make: make.__name__)
def test_two_stages_reach_the_known_optimum(make: Callable[[], OptimalControlProblem]) -> None:
    problem, (arcs, switch_times, final_time) = make(), BANG_BANG[make]
    found = TwoStage().solve(problem)
    assert found.solved, found.status
    assert problem.known_cost is not None
    assert found.cost == pytest.approx(problem.known_cost, rel=1e-11)
    assert found.arcs == arcs
    assert found.switch_times == pytest.approx(switch_times, abs=1e-6 * final_time)
    assert found.final_time == pytest.approx(final_time, rel=1e-8)


def test_an_unstructured_answer_is_near_the_optimum_and_has_no_arcs() -> None:
    found = Unstructured().solve(mars_landing())
    assert found.solved
    assert found.arcs == []
    assert found.cost == pytest.approx(268.0146563274, rel=1e-3)
    thrust, magnitude = found.control["thrust"], found.control["thrust_magnitude"]
    assert float((thrust.norm(dim=-1) - magnitude[:, 0]).max()) <= 1.1e-4 * 13258.18
    assert len(found.times) == len(found.states["r"]) == len(found.costates["r"]) + 1
    assert found.states["r"][-1].tolist() == [0.0, 0.0, 0.0]


def test_the_multipliers_are_the_costates() -> None:
    found = TwoStage().solve(tfc_test_1())
    position = found.costates["r"]
    assert position[0].tolist() == pytest.approx([-3.472511189e-2, -5.364233455e-3, 2.330559168e-2], rel=1e-7)
    assert float((position - position[0]).abs().max()) < 1e-9  # constant gravity
    # λv is linear and λm ends at zero
    velocity = found.costates["v"][0] + position[0] * found.times[1]
    assert velocity.tolist() == pytest.approx([-0.3995834211, -0.1434829029, -0.6586013667], rel=1e-7)
    assert abs(float(found.costates["m"][-1])) < 1e-9


@pytest.mark.parametrize("make", [energy_transfer, energy_transfer_limited, minimum_energy], ids=lambda m: m.__name__)
def test_without_arcs_the_first_stage_answers(make: Callable[[], OptimalControlProblem]) -> None:
    problem = make()
    guess = PolarTransfer() if "r" in problem.states else None
    found = TwoStage(Unstructured(n_segments=30, degree=4, guess=guess, softening=0.0)).solve(problem)
    assert found.solved
    assert found.cost == pytest.approx(problem.known_cost, rel=3e-6)


def test_the_split_certifies_a_direct_answer() -> None:
    refined = TwoStage().solve(tfc_test_2()).refined()
    certificate = certify(Solution(refined.curve))
    assert certificate.certified, certificate.verdict
    assert certificate.cost == pytest.approx(275.2062387119, abs=1e-9)


def test_the_split_finds_the_bounds_that_a_direct_answer_leaves_to_its_mesh() -> None:
    refined = TwoStage().solve(planar_car(maximum_turn=0.5)).refined()
    solution = Solution(refined.curve)
    assert certify(solution).certified
    assert solution.arcs == ["max,max", "max,interior", "min,interior", "min,max"]


def test_an_answer_without_bounds_is_refined_and_judged() -> None:
    solution = Solution(Unstructured().solve(minimum_energy()).refined().curve)
    assert solution.arcs == []
    certificate = certify(solution)
    assert "off node residual" in certificate.verdict  # of its many short segments
    assert certificate.cost == pytest.approx(6.0, abs=1e-9)


def test_too_little_time_is_not_called_solved() -> None:
    assert not TwoStage(Unstructured(options={"max_iter": 60})).solve(mars_landing(final_time=15.0)).solved


def test_repair_puts_a_missing_arc_in_short_and_drops_one_that_vanished() -> None:
    right, method = TwoStage().solve(minimum_fuel()), TwoStage()
    answer, (push, coast, brake) = right.answer, right.answer.point.durations

    def repaired(codes: list[int], durations: list[float]) -> tuple[list[tuple[int, ...]], list[float]]:
        """The right trajectory with other claims about its arcs."""
        phases = [Phase(p.n_segments, (code,)) for p, code in zip(right.program.phases, codes, strict=True)]
        claimed = replace(answer, point=replace(answer.point, durations=np.array(durations)))
        arcs, new = method._repaired(replace(right, program=replace(right.program, phases=phases), answer=claimed))
        return arcs, new.tolist()

    assert repaired([UPPER, LOWER, UPPER], [push, coast, brake])[0] == [(UPPER,), (LOWER,), (UPPER,)]
    dropped = repaired([UPPER, LOWER, UPPER], [push, coast + brake - 1e-6, 1e-6])
    assert dropped == ([(UPPER,), (LOWER,)], pytest.approx([push, coast + brake - 1e-6]))
    # S is largest at the end of the missing brake
    added = repaired([UPPER, LOWER, LOWER], [push, coast, brake])
    assert added == ([(UPPER,), (LOWER,), (UPPER,)], pytest.approx([push, coast + brake - 0.015, 0.015]))


@pytest.mark.parametrize("degree", [1, 2, 5, 9])
def test_the_radau_rule_is_exact_for_polynomials(degree: int) -> None:
    rule = RadauRule.of_degree(degree)
    assert rule.points[-1] == 1.0
    for power in range(2 * degree - 1):
        assert rule.weights @ rule.points**power == pytest.approx(1.0 / (power + 1), rel=1e-12)
    support = np.concatenate([[0.0], rule.points])
    expected = degree * rule.points ** (degree - 1)
    np.testing.assert_allclose(rule.derivative @ support**degree, expected, atol=1e-10)


@pytest.mark.parametrize(
    "make", [mars_landing, minimum_time, energy_transfer, planar_car, bounded_car], ids=lambda m: m.__name__
)
def test_control_variables_and_controls_are_inverse(make: Callable[[], OptimalControlProblem]) -> None:
    problem = make()
    variables = control_variables(problem, 0.0)
    nu = torch.rand(7, variables.size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(variables.inverse(variables.controls(nu)), nu, rtol=1e-14, atol=1e-15)


def test_a_control_set_of_another_kind_is_named() -> None:
    problem = replace(minimum_energy(), control=_Strange("force", 1))
    with pytest.raises(TypeError, match="_Strange"):
        Program(problem, (Phase(3),), 2).build()


class _Strange(ControlSet):
    """A control set that only knows what a problem's probe asks."""

    def __init__(self, name: str, size: int) -> None:
        self.name, self.size = name, size

    @property
    def names(self) -> dict[str, int]:
        return {self.name: self.size}

    def probe(self, one: torch.Tensor) -> dict[str, torch.Tensor]:
        return {self.name: one.expand(*one.shape[:-1], self.size)}


@pytest.mark.slow
def test_a_short_arc_at_the_start_is_found() -> None:
    """max-min-max-min-max-min-max with a first arc of 1.57 d: S of the six other arcs says 23 d."""
    problem = earth_mars(final_time_days=384.8874932753994)
    found = TwoStage(Unstructured(150, 2, PolarTransfer()), n_segments=20).solve(problem)
    assert found.solved
    assert found.cost == pytest.approx(278.6043382133, abs=1e-7)
    assert found.switch_times[0] / DAY == pytest.approx(1.566191367, abs=1e-5)
