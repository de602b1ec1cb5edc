"""The first start is tried with few neurons and nodes; where that does not do, all is as if it had not been."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import problem

from ponn_torch.ansatz.basis import Chebyshev, Legendre, RandomFeatures
from ponn_torch.ansatz.networks import MLP
from ponn_torch.optimal_control.discretisation import Weak
from ponn_torch.solving.continuation import Ladder, Phases
from ponn_torch.solving.guess import RandomGuess
from ponn_torch.solving.paths import StraightLine
from ponn_torch.solving.result import SolveResult
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.split import Split


def sizes(result: SolveResult) -> list[int]:
    """Unknowns of the smoothed stages, without repetition."""
    found = [s.solution.curve.collocation.n_unknowns for s in result.stages if s.name == "smooth" and s.solution]
    return [n for i, n in enumerate(found) if not i or n != found[i - 1]]


def test_a_landing_needs_no_more_than_few():
    few, all_ = (Solver(coarse=share).solve(problem("mars_landing")) for share in (0.6, 1.0))
    assert few.certified
    assert few.n_starts == 1
    assert len(sizes(few)) == 1
    assert sizes(few)[0] < 0.7 * sizes(all_)[0]
    assert few.solution.cost == pytest.approx(all_.solution.cost, abs=1e-9)


def test_where_few_do_not_do_the_same_start_follows_with_all():
    """Six neurons: no stage comes near; what follows is what comes without them, to the bit."""
    result = Solver(coarse=0.2).solve(problem("earth_mars"))
    without = Solver(coarse=1.0).solve(problem("earth_mars"))
    assert result.certified
    assert result.n_starts == 1
    assert len(sizes(result)) == 2
    assert torch.equal(result.solution.curve.xi, without.solution.curve.xi)


def test_a_refinement_that_fails_on_few_is_begun_again_with_all(monkeypatch):
    given, run = [], Split.run

    def failing_first(self, start, *rest):
        given.append(start.collocation.n_unknowns)
        return run(self, start, *rest) if len(given) > 1 else run(Split(max_rounds=1, residual_tolerance=0.0), start)

    monkeypatch.setattr(Split, "run", failing_first)
    result = Solver().solve(problem("mars_landing"))
    assert result.certified
    assert result.n_starts == 1
    assert given[0] < given[1]


@pytest.mark.parametrize(
    ("settings", "few"),
    [
        ({}, True),
        ({"basis": Legendre(20)}, True),
        ({"coarse": 1.0}, False),
        ({"refinement": None}, False),
        ({"form": Weak(20)}, False),
        ({"basis": RandomFeatures(30)}, False),
        ({"basis": MLP((4,))}, False),
        ({"basis": Chebyshev(1)}, False),
    ],
)
def test_it_is_for_polynomials_that_only_lead_to_a_refinement(settings: dict[str, Any], few: bool):
    solver = Solver(**settings)
    assert solver.coarsens(solver.form) is few


def test_rungs_of_another_form_are_not_walked_with_few():
    schedule = Phases((Ladder((1.0, 0.3)), Ladder((0.1,), form=Weak(20))))
    solver = Solver(continuation=schedule, refinement=Split(max_rounds=1, residual_tolerance=0.0), n_starts=1)
    result = solver.solve(problem("mars_landing"))
    few = min(sizes(result))
    stages = [(s.smoothing, s.solution.curve.collocation.n_unknowns == few) for s in result.stages if s.solution]
    assert stages[:2] == [(1.0, True), (0.3, True)]
    assert all(is_few is False for _, is_few in stages[2:])


def test_a_guess_that_comes_again_is_one_start_all_the_same():
    solver = Solver(guess=StraightLine(), n_segments=1, n_starts=4, n_certified=2)
    assert solver.solve(problem("mars_landing")).n_starts == 1


def test_failures_are_counted_by_starts():
    solver = Solver(n_starts=3, start_limit=1e-300, guess=RandomGuess(), n_segments=1)
    assert "of 3 starts: 3 × not through" in solver.solve(problem("mars_landing")).message


@pytest.mark.parametrize("share", [0.0, -1.0, 1.5])
def test_a_share_is_checked(share: float):
    with pytest.raises(ValueError, match=f"coarse = {share}; allowed: above 0, to 1"):
        Solver(coarse=share)
