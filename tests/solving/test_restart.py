"""A solution is where the same problem with other data begins: its arcs are refined as they are, if they can be."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers import problem

from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.optimal_control.references import load_problem
from ponn_torch.problems.energy_landing import energy_landing
from ponn_torch.problems.goddard import goddard
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.guess import RandomGuess
from ponn_torch.solving.observer import SilentObserver
from ponn_torch.solving.refinement import Outcome, Refined
from ponn_torch.solving.restart import Restart
from ponn_torch.solving.result import SolveResult
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.split import Split


@cache
def solved(name: str) -> Solution:
    return Solver().solve(problem(name), 0).solution


def restarted(name: str, changed: OptimalControlProblem, **choices) -> SolveResult:
    return Solver(guess=Restart(solved(name)), **choices).solve(changed, 0)


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("mars_landing", {"final_time": 46.0}),
        ("mars_landing", {"initial_mass": 1880.0, "maximum_thrust": 13500.0}),
        ("tfc_test_2", {}),
        ("goddard", {"maximum_thrust": 4.0}),
        ("goddard", {"drag": 250.0}),
    ],
)
def test_it_gives_what_a_cold_start_gives_without_a_smoothed_stage(name, changed):
    make = {"mars_landing": mars_landing, "goddard": goddard}.get(name)
    stated = make(**changed) if make else problem(name)
    warm, cold = restarted(name, stated), Solver().solve(stated, 0)
    assert warm.certified
    assert warm.n_starts == 1
    assert {stage.name for stage in warm.stages} == {"split"}
    assert warm.solution.arcs == cold.solution.arcs
    assert warm.solution.cost == pytest.approx(cold.solution.cost, rel=1e-9)
    assert warm.solution.switch_times == pytest.approx(cold.solution.switch_times, rel=1e-6)


def test_other_arcs_are_found_from_there():
    """The landing of test 1 has two arcs, that of test 2 begins with a third."""
    result = restarted("tfc_test_1", problem("tfc_test_2"))
    assert result.certified
    assert result.solution.arcs == ["max", "min", "max"]
    assert result.solution.cost == pytest.approx(275.2062387119, abs=1e-7)


def test_a_free_final_time_begins_where_it_was_found():
    curve = Restart(solved("tfc_test_1")).on_its_arcs(solved("tfc_test_1").bvp)
    assert curve.collocation.residual(curve.xi).norm() < 1e-9
    assert float(curve.times[-1]) == pytest.approx(float(solved("tfc_test_1").curve.times[-1]), rel=1e-14)


def test_controls_without_arcs_begin_with_the_curve():
    changed = energy_landing(initial_velocity=(72.0, 0.0, -78.0))
    warm, cold = restarted("energy_landing", changed), Solver().solve(changed, 0)
    assert warm.certified
    assert warm.solution.cost == pytest.approx(cold.solution.cost, rel=1e-9)
    assert warm.stages[0].n_iterations < cold.stages[0].n_iterations


class Unlucky(Split):
    """A split that fails where it begins with arcs."""

    def run(self, start, callback=None, blunter=None):
        if start.collocation.setting.regime.arcs is None:
            return super().run(start, callback, blunter)
        return Refined(start, Outcome.RESIDUAL, [])


def test_where_the_arcs_do_not_serve_the_curve_does():
    result = restarted("mars_landing", mars_landing(final_time=46.0), refinement=Unlucky())
    assert result.certified
    assert result.n_starts == 1
    assert result.stages[0].name == "smooth"


class Impatient(SilentObserver):
    """Ctrl-C in the first iteration."""

    def iteration(self, record, iterate):
        raise KeyboardInterrupt


def test_what_a_restart_began_with_is_kept_where_it_is_ended_from_outside():
    changed = mars_landing(final_time=46.0)
    solver = Solver(guess=Restart(solved("mars_landing")))
    interrupted = solver.solve(changed, 0, observer=Impatient())
    assert interrupted.interrupted
    assert interrupted.solution.arcs == ["max", "min", "max"]
    spent = replace(solver, cpu_seconds=1e-9).solve(changed, 0)
    assert spent.spent
    assert "smooth" not in {stage.name for stage in spent.stages}
    assert spent.solution.final_time == 46.0


def test_a_fixed_final_time_is_what_is_stated_to_the_last_digit():
    for final_time in (46.0, 47.3, 45.1):
        bvp = pontryagin(mars_landing(final_time=final_time))
        assert float(Restart(solved("mars_landing")).on_its_arcs(bvp).times[-1]) == bvp.final_time


def test_further_starts_come_from_another_guess():
    guess, bvp = Restart(solved("mars_landing"), RandomGuess("normal")), solved("mars_landing").bvp
    t = torch.linspace(0.0, bvp.final_time, 5, dtype=torch.float64)
    own = guess.curve(bvp, 3000)(t)
    torch.testing.assert_close(own[1:-1], solved("mars_landing").curve(t)[1:-1], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(guess.curve(bvp, 3001)(t), RandomGuess("normal").curve(bvp, 3001)(t))


def test_a_saved_solution_serves_by_the_name_of_its_folder(tmp_path):
    made = Solver().solve(load_problem("ponn_torch.problems.mars_landing:mars_landing"), 0).solution
    made.save(tmp_path / "run" / "solution")
    for folder in (tmp_path / "run", tmp_path / "run" / "solution"):
        assert Solver(guess=Restart(str(folder))).solve(mars_landing(final_time=46.0), 0).stages[0].name == "split"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("nowhere", "guess.solution = 'nowhere'; allowed: the folder of a run or a solution"),
        ("minimum_time", r"guess.solution: states = \{'x': 1, 'v': 1\}; allowed: \{'r': 3, 'v': 3, 'm': 1\}"),
    ],
)
def test_what_cannot_serve_is_refused(given, message):
    with pytest.raises(ValueError, match=r"guess.solution = int; allowed: a Solution, or the folder of a run"):
        Restart(3)
    guess = Restart(given if given == "nowhere" else solved(given))
    with pytest.raises(ValueError, match=message):
        guess.curve(solved("mars_landing").bvp, 0)
