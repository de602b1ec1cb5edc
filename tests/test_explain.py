"""What the command line adds to the message of a failed solve."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from ponn_torch.ansatz.basis import Legendre
from ponn_torch.cli import main
from ponn_torch.cli.explain import explanation
from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.problems.double_integrator import minimum_energy
from ponn_torch.problems.earth_mars import EARTH_VENUS, earth_mars
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.paths import PolarTransfer
from ponn_torch.solving.solver import Solver

HOPELESS = Solver(start_limit=1e-300, n_starts=1)


def test_infeasible_in_the_time_given_and_nothing_else_is_asked() -> None:
    hurried = replace(minimum_energy(), control=Box("force", 1.0, -1.0, size=1), final_time=1.9)
    (sentence,) = explanation(hurried, Solver(), 0, None)
    assert sentence == (
        "infeasible unless a quicker one exists: "
        "the minimum-time extremal found (certified) takes 2 s, more than final_time = 1.9 s"
    )


@pytest.mark.slow
def test_infeasible_with_the_thrust_given_and_nothing_else_is_asked() -> None:
    """One extra revolution on the way to Venus: 340 days would do for it, 1000 are too many."""
    solver = Solver(
        basis=Legendre(14), conditioning="orthonormal", n_nodes=20, n_segments=12, guess=PolarTransfer(revolutions=1)
    )
    (sentence,) = explanation(earth_mars(**EARTH_VENUS), solver, 0, None)
    assert sentence == (
        "infeasible unless another extremal needs less: "
        "the least-control extremal found (certified) needs thrust up to 0.4734805 N, more than 0.33 N"
    )


def test_a_trajectory_by_direct_collocation_is_reported() -> None:
    pytest.importorskip("casadi")
    unknown, witness = explanation(mars_landing(), HOPELESS, 0, None)
    assert "not known" in unknown
    assert witness == "direct collocation finds a trajectory with arcs max-min-max, fuel 268.01466 kg"


@pytest.mark.slow
def test_a_failed_solution_is_where_direct_collocation_starts() -> None:
    pytest.importorskip("casadi")
    solution = Solver(refinement=None).solve(mars_landing(final_time=50.0)).solution
    _, witness = explanation(mars_landing(final_time=50.0), HOPELESS, 0, solution)
    assert "finds a trajectory with arcs max-min-max" in witness


def test_without_casadi_there_is_no_witness(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    sentences = explanation(mars_landing(), HOPELESS, 0, None)
    assert len(sentences) == 1


@pytest.mark.parametrize("explain", [True, False])
def test_the_command_line_writes_it_where_asked(explain: bool, tmp_path: Path) -> None:
    arguments = [
        "problem=mars_landing",
        "problem.final_time=30",
        "record=minimal",
        f"explain={explain}".lower(),
        f"hydra.run.dir={tmp_path}",
        "n_starts=1",
    ]
    assert main(arguments) == 2
    message = json.loads((tmp_path / "outcome.json").read_text(encoding="utf-8"))["message"]
    assert ("infeasible unless a quicker one exists" in message) is explain
    assert ("extremal found (certified) takes 40.072064 s" in message) is explain
