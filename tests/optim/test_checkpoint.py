"""Resumed runs equal uninterrupted ones bit for bit; a resume that finds nothing is an error."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers import OPTIMIZERS, random
from test_least_squares import landing, start_of

from ponn_torch.optim import driver
from ponn_torch.optim.base import Status, Stop, Stopping
from ponn_torch.optim.chain import Chain
from ponn_torch.optim.checkpoint import CheckpointFile, read, write
from ponn_torch.optim.gradient import Adam
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.quasi_newton import LBFGS, SSBroyden

STOPPING = Stopping(tolerance=1e-13, decrease=0.0, max_iterations=16)
RESUMABLE = {
    "levenberg_marquardt": LevenbergMarquardt(STOPPING),
    "levenberg_marquardt_more": LevenbergMarquardt(STOPPING, scaling="more"),
    "levenberg_marquardt_identity": LevenbergMarquardt(STOPPING, scaling="identity", update=3.0),
    "levenberg_marquardt_reuse": LevenbergMarquardt(STOPPING, reuse=0.3),
    "adam_cosine": Adam(STOPPING),
    "adam_exponential": Adam(STOPPING, schedule="exponential"),
    "lbfgs": LBFGS(STOPPING, memory=5),
    "ssbroyden": SSBroyden(STOPPING),
    "chain": Chain([Adam(Stopping(decrease=0.0, max_iterations=9)), LBFGS(STOPPING), LevenbergMarquardt(STOPPING)]),
    "nested_chain": Chain([Chain([Adam(Stopping(decrease=0.0, max_iterations=9)), LBFGS(STOPPING)]), LBFGS(STOPPING)]),
}


def interrupt_at(count: int):
    def stop(record, xi, r):
        if record["iteration"] == count:
            raise KeyboardInterrupt

    return stop


def without_times(records):
    return [{key: value for key, value in record.items() if key != "seconds"} for record in records]


@pytest.mark.parametrize("count", [5, 9])
@pytest.mark.parametrize("name", RESUMABLE)
def test_a_resumed_run_equals_the_uninterrupted_one(name, count, tmp_path: Path):
    optimizer, (residual, start) = RESUMABLE[name], landing()
    whole = optimizer.run(residual, start)
    cut = optimizer.run(residual, start, interrupt_at(count), CheckpointFile(tmp_path / "state.npz"))
    assert (cut.status, cut.n_iterations) == (Status.INTERRUPTED, count)
    resumed = optimizer.run(
        residual, torch.zeros_like(start), None, CheckpointFile(tmp_path / "state.npz", resume=True)
    )
    assert torch.equal(resumed.xi, whole.xi)
    assert torch.equal(resumed.norm, whole.norm)
    assert resumed.status is whole.status
    assert without_times(resumed.records) == without_times(whole.records)
    assert (resumed.n_residuals, resumed.n_linearisations) == (whole.n_residuals, whole.n_linearisations)
    assert resumed.cpu_seconds > cut.records[-1]["seconds"]
    seconds = [record["seconds"] for record in resumed.records]
    assert seconds == sorted(seconds)


@pytest.mark.parametrize("stop", [Stop(Status.BUDGET), KeyboardInterrupt()], ids=["budget", "keyboard"])
@pytest.mark.parametrize("name", ["levenberg_marquardt", "chain", "nested_chain"])
def test_a_resumed_run_that_is_ended_at_once_keeps_its_best_point(name, stop, tmp_path: Path):
    optimizer, (residual, start) = RESUMABLE[name], landing()
    whole = optimizer.run(residual, start)
    cut = optimizer.run(residual, start, interrupt_at(12), CheckpointFile(tmp_path / "state.npz"))

    def end(record, xi, r):
        raise stop

    ended = optimizer.run(residual, start, end, CheckpointFile(tmp_path / "state.npz", resume=True))
    assert ended.status is (stop.status if isinstance(stop, Stop) else Status.INTERRUPTED)
    assert torch.equal(ended.xi, cut.xi)
    assert without_times(ended.records) == without_times(cut.records)
    resumed = optimizer.run(residual, start, None, CheckpointFile(tmp_path / "state.npz", resume=True))
    assert torch.equal(resumed.xi, whole.xi)


def test_an_interrupt_leaves_records_and_state_of_the_same_iteration(monkeypatch, tmp_path: Path):
    """Ctrl-C may come anywhere: here when an iteration's record was just made."""
    optimizer, (residual, start) = LevenbergMarquardt(STOPPING), landing()
    whole, make = optimizer.run(residual, start), driver.record

    def interrupted(**values):
        made = make(**values)
        if made["iteration"] == 4:
            raise KeyboardInterrupt
        return made

    with monkeypatch.context() as patched:
        patched.setattr(driver, "record", interrupted)
        cut = optimizer.run(residual, start, None, CheckpointFile(tmp_path / "state.npz"))
    assert (cut.status, cut.n_iterations) == (Status.INTERRUPTED, 3)
    resumed = optimizer.run(residual, start, None, CheckpointFile(tmp_path / "state.npz", resume=True))
    assert resumed.n_iterations == whole.n_iterations
    assert torch.equal(resumed.xi, whole.xi)


def test_a_batch_resumes_with_its_members_at_different_ends(tmp_path: Path):
    residual, start = start_of("rosenbrock")
    starts = start + random(4, 2, seed=2, low=-1.0)
    starts[3] = 1.0  # there already
    optimizer = LevenbergMarquardt(Stopping(tolerance=1e-10, max_iterations=40))
    whole = optimizer.run(residual, starts)
    optimizer.run(residual, starts, interrupt_at(14), CheckpointFile(tmp_path / "state.npz"))
    resumed = optimizer.run(residual, starts, None, CheckpointFile(tmp_path / "state.npz", resume=True))
    assert torch.equal(resumed.xi, whole.xi)
    assert resumed.member_status == whole.member_status


def test_a_run_that_met_its_iteration_limit_may_go_on_to_a_larger_one(tmp_path: Path):
    residual, start = landing()
    path = tmp_path / "state.npz"
    short, long = (LBFGS(Stopping(decrease=0.0, max_iterations=k)) for k in (8, 20))
    short.run(residual, start, interrupt_at(8), CheckpointFile(path))
    resumed = long.run(residual, start, None, CheckpointFile(path, resume=True))
    assert torch.equal(resumed.xi, long.run(residual, start).xi)


SCRIPT = """
import sys, torch
sys.path.insert(0, {tests!r}); sys.path.insert(0, {here!r})
from test_checkpoint import RESUMABLE, CheckpointFile, landing
residual, start = landing()
result = RESUMABLE[{name!r}].run(residual, start, None, CheckpointFile({path!r}, resume=True))
print(" ".join(float(x).hex() for x in result.xi))
"""


def test_a_checkpoint_is_read_in_a_fresh_process(tmp_path: Path):
    optimizer, (residual, start) = RESUMABLE["ssbroyden"], landing()
    path = tmp_path / "state.npz"
    optimizer.run(residual, start, interrupt_at(7), CheckpointFile(path))
    here = Path(__file__).parent
    script = SCRIPT.format(tests=str(here.parent), here=str(here), name="ssbroyden", path=str(path))
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert [float.fromhex(x) for x in run.stdout.split()] == optimizer.run(residual, start).xi.tolist()


def test_a_resume_that_finds_nothing_is_an_error(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"nothing to resume: .*state\.npz' does not exist"):
        CheckpointFile(tmp_path / "state.npz", resume=True)


def test_checkpoints_are_written_when_due_and_need_no_pickle(tmp_path: Path):
    residual, start = landing()
    often, seldom = (
        CheckpointFile(tmp_path / name, seconds=s) for name, s in (("often.npz", 0.0), ("seldom.npz", 1e6))
    )
    LBFGS(STOPPING).run(residual, start, None, often)
    LBFGS(STOPPING).run(residual, start, None, seldom)
    assert not seldom.path.exists()  # nothing was due, and nothing interrupted it
    saved = read(often.path)
    assert len(saved["progress/records/norm"]) == STOPPING.max_iterations
    assert list(tmp_path.iterdir()) == [often.path]


def test_arrays_come_back_as_they_were(tmp_path: Path):
    arrays = {"a": random(3, 2), "b": torch.tensor(True), "c": torch.arange(3), "d/e": torch.tensor(1e-300)}
    write(tmp_path / "deep" / "x.npz", arrays)
    again = read(tmp_path / "deep" / "x.npz")
    assert {name: (v.dtype, v.tolist()) for name, v in again.items()} == {
        name: (v.dtype, v.tolist()) for name, v in arrays.items()
    }


def test_every_optimiser_takes_a_checkpoint(tmp_path: Path):
    residual, start = start_of("powell_singular")
    for name, make in OPTIMIZERS.items():
        result = make(Stopping(max_iterations=5)).run(residual, start, None, CheckpointFile(tmp_path / f"{name}.npz"))
        assert result.n_iterations > 0
