"""A journal gives a solve back what it had computed; with nothing in it, resuming is an error."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import helpers
import pytest
import torch
from helpers import problem

from ponn_torch.ansatz.basis import Chebyshev, RandomFeatures
from ponn_torch.optim.base import Status
from ponn_torch.solving.continuation import Ladder
from ponn_torch.solving.journal import ForeignJournal, Journal
from ponn_torch.solving.observer import Observer
from ponn_torch.solving.solver import Solver

SMALL = Solver(Chebyshev(12), n_nodes=20, continuation=Ladder((1.0, 0.5, 0.2)), refinement=None, start_limit=10.0)


class Watching(Observer):
    """Notes every iteration, and presses Ctrl-C at one of them."""

    def __init__(self, stop: int = 0) -> None:
        self.seen, self.stop = [], stop

    def iteration(self, record, look):
        self.seen.append({key: value for key, value in record.items() if key != "seconds"})
        if len(self.seen) == self.stop:
            raise KeyboardInterrupt


@pytest.mark.parametrize("stop", [2, 11, 15])
def test_a_solve_is_taken_up_where_it_was_interrupted(stop, tmp_path):
    whole, cut, again = Watching(), Watching(stop), Watching()
    expected = SMALL.solve(problem("mars_landing"), 0, whole)
    interrupted = SMALL.solve(problem("mars_landing"), 0, cut, Journal(tmp_path))
    assert interrupted.interrupted
    assert interrupted.stages[-1].status is Status.INTERRUPTED
    assert len(whole.seen) > stop
    journal = Journal(tmp_path, resume=True)
    result = SMALL.solve(problem("mars_landing"), 0, again, journal)
    assert torch.equal(result.solution.curve.xi, expected.solution.curve.xi)
    assert again.seen == whole.seen  # the observer is told everything anew
    assert [stage.status for stage in result.stages] == [stage.status for stage in expected.stages]
    assert [stage.n_residuals for stage in result.stages] == [stage.n_residuals for stage in expected.stages]
    # what an earlier process spent counts
    assert result.cpu_seconds >= sum(stage.cpu_seconds for stage in interrupted.stages[:-1])


def test_what_was_finished_is_not_computed_again(tmp_path):
    SMALL.solve(problem("mars_landing"), 0, None, Journal(tmp_path))
    assert len(list(tmp_path.glob("*.npz"))) == 3

    class Broken:
        def run(self, *_):
            raise AssertionError("an optimiser ran")

    journal = Journal(tmp_path, resume=True)
    for _ in range(3):
        result = journal.run(Broken(), Anything(), torch.zeros(3, dtype=torch.float64))
        assert result.n_iterations > 0


MADE = problem("mars_landing")


@pytest.mark.parametrize(
    ("named", "other"),
    [
        ("seed", (SMALL, MADE, 5)),
        ("problem", (SMALL, helpers.PROBLEMS["mars_landing"](gravity=1.62), 0)),
        ("problem", (SMALL, replace(MADE, dynamics=lambda t, x, u, p: MADE.dynamics(t, x, u, p)), 0)),
        ("basis", (replace(SMALL, basis=Chebyshev(13)), MADE, 0)),
        ("continuation", (replace(SMALL, continuation=Ladder((1.0,))), MADE, 0)),
    ],
)
def test_a_journal_goes_on_with_its_own_solve_only(named, other, tmp_path):
    SMALL.solve(MADE, 0, Watching(14), Journal(tmp_path))
    assert (tmp_path / "000.npz").is_file()
    solver, *stated = other
    with pytest.raises(ForeignJournal, match=f"other values of {named};"):
        solver.solve(*stated, None, Journal(tmp_path, resume=True))
    solver.solve(*stated, Watching(2), Journal(tmp_path))  # begun anew, it belongs to that one
    assert [path.name for path in tmp_path.glob("*.npz")] == ["000_under_way.npz"]
    solver.solve(*stated, Watching(2), Journal(tmp_path, resume=True))


DIGESTS = """
import json, sys
sys.path.insert(0, {tests!r})
from helpers import problem
from ponn_torch.ansatz.basis import RandomFeatures
from ponn_torch.solving.solver import Solver
print(json.dumps(Solver(RandomFeatures(9)).determined_by(problem("earth_mars"), 3)))
"""


def test_what_determines_a_solve_is_the_same_in_a_fresh_process():
    """Other hashes, other addresses, the same digests."""
    run = [sys.executable, "-c", DIGESTS.format(tests=str(Path(helpers.__file__).parent))]
    told = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    assert json.loads(told) == Solver(RandomFeatures(9)).determined_by(problem("earth_mars"), 3)


class Anything:
    def residual(self, xi):
        return xi


def test_a_budget_that_is_spent_by_what_was_finished_ends_the_solve(tmp_path):
    SMALL.solve(problem("mars_landing"), 0, Watching(14), Journal(tmp_path))
    result = replace(SMALL, cpu_seconds=1e-9).solve(problem("mars_landing"), 0, None, Journal(tmp_path, resume=True))
    assert result.spent
    assert [stage.status for stage in result.stages] == [Status.BUDGET]
    assert result.solution is not None
    assert "CPU time" in result.message


def test_a_resume_that_finds_nothing_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing to resume"):
        Journal(tmp_path, resume=True)
