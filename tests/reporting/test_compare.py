"""Comparisons: members read back, grouped, told apart by extremal, in tables and figures that say the same."""

import csv
import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import plugin_data_pb2

from ponn_torch.cli import main as ponn
from ponn_torch.cli.compare import main
from ponn_torch.reporting.compare import compare, spread, write_comparison
from ponn_torch.reporting.members import Member, extremals, read_members
from ponn_torch.reporting.overlays import histories_figure, solutions_figure
from ponn_torch.reporting.reference import Reference
from ponn_torch.solving import run as run_module
from ponn_torch.solving.certificate import Certificate
from ponn_torch.solving.solution import Solution

SMALL = ["problem=mars_landing", "continuation=single", "refinement=none", "record=minimal", "nodes.n_nodes=30"]


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Two sizes by two seeds, and a member that cannot run; errors are taken against the larger one."""
    folder = tmp_path_factory.mktemp("sweep")
    first = folder / "first"
    assert ponn([*SMALL, "ansatz.size=16", f"hydra.run.dir='{first}'"]) == 0
    measured = ["record.cost_every=2", f"record.reference='{first}/solution'"]
    judged = Certificate.from_dict(json.loads((first / "certificate.json").read_text(encoding="utf-8")))
    with pytest.MonkeyPatch.context() as patch:  # flying takes longer than all else, and no test is about it
        patch.setattr(run_module, "certify", lambda *_: judged)
        code = ponn(["-m", *SMALL, *measured, "ansatz.size=12,16", "seed=0,1", f"hydra.sweep.dir='{folder}/sweep'"])
    assert code == 0
    bad = [*SMALL, "ansatz.size=12", "problem.initial_mass=-1"]
    assert ponn(["-m", *bad, f"hydra.sweep.dir='{folder}/sweep'", "hydra.sweep.subdir=bad"]) == 1
    return folder / "sweep", first / "solution"


def test_members_hold_what_their_runs_left(sweep):
    members = read_members(sweep[0])
    names = [
        f"{i}_ansatz.size={size},seed={seed}" for i, (size, seed) in enumerate([(12, 0), (12, 1), (16, 0), (16, 1)])
    ]
    assert [member.folder.name for member in members] == [*names, "bad"]
    member = members[0]
    assert (member.settings["ansatz.size"], member.seed) == ("12", "0")
    assert len(member.iterations) == member.total("n_iterations")
    assert member.iterations[-1]["residuals"] == member.total("n_residuals")
    assert member.cost == json.loads((member.folder / "outcome.json").read_text())["cost"]
    assert member.solved
    assert members[-1].solution is None
    assert not members[-1].solved


def test_errors_against_a_reference_are_recorded_and_computed_alike(sweep):
    folder, reference = sweep
    members = read_members(folder)
    known = Reference(Solution.load(reference))
    for member in members[:4]:
        due = [record for record in member.iterations if "error_states" in record]
        assert [record["global_step"] % 2 for record in due] == [0] * len(due)
        errors = known.errors(member.solution.curve)
        if member.iterations[-1] is due[-1]:
            assert errors["states"] == pytest.approx(due[-1]["error_states"], rel=1e-6)
    coarse, same = (known.errors(members[i].solution.curve) for i in (0, 2))
    assert same["states"] < 1e-9  # seed 0 of the reference's own size
    assert coarse["states"] > 1e-6
    assert coarse["costates"] > 1e-6


def test_one_row_a_configuration_and_one_a_member(sweep):
    (comparison,) = compare(sweep[0], Solution.load(sweep[1]))
    assert comparison.problem == "mars_landing"
    rows = comparison.rows()
    # a setting that only the broken member has tells it apart
    assert [row["settings"] for row in rows] == ["size=12", "size=16", "size=12 initial_mass=-1"]
    assert rows[0]["certified"] == "0/2"
    assert rows[0]["extremals"] == "A:2"
    assert rows[2]["extremals"] == "–:1"
    assert rows[2]["certified"] == "0/0 (1 failed)"  # bad input is no try
    costs = [member.cost for member in comparison.groups["size=12"]]
    assert float(rows[0]["fuel [kg]"].split()[0]) == pytest.approx(sum(costs) / 2, abs=1e-4)
    assert comparison.shared["refinement"] == "none"
    assert "seed" not in comparison.shared
    (failure,) = comparison.failures()
    assert "problem.initial_mass = -1" in failure


def test_the_command_writes_tables_and_figures(sweep, tmp_path, capsys):
    folder, reference = sweep
    assert main([str(folder), "--reference", str(reference), "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    written = (tmp_path / "comparison.md").read_text(encoding="utf-8")
    assert written in printed
    names = {path.name for path in tmp_path.iterdir()}
    figures = {"histories_mars_landing.png", "solutions_mars_landing.png"}
    assert names == {"comparison.md", "comparison.csv", "members.csv"} | figures
    assert all(f"]({name})" in written for name in figures)
    with (tmp_path / "members.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["seed"] for row in rows] == ["0", "1", "0", "1", "0"]
    assert float(rows[2]["error of states"]) < 1e-9
    assert math.isnan(float(rows[4]["CPU s"])) or float(rows[4]["CPU s"]) == 0


def test_hyperparameters_are_the_settings_that_tell_members_apart(tmp_path):
    chosen = [*SMALL, "record.tensorboard=true", "ansatz=legendre", "ansatz.size=10", "seed=3", "n_starts=2"]
    ponn([*chosen, f"hydra.run.dir='{tmp_path}'"])
    accumulator = EventAccumulator(str(tmp_path))
    accumulator.Reload()
    started = accumulator.PluginTagToContent("hparams")["_hparams_/session_start_info"]
    values = plugin_data_pb2.HParamsPluginData.FromString(started).session_start_info.hparams
    told = {name: value.string_value or value.number_value for name, value in values.items()}
    assert told == {
        "ansatz": "legendre", "optimizer": "lm", "problem": "mars_landing", "seed": 3.0, "ansatz.size": 10.0,
        "continuation": "single", "refinement": "none", "n_starts": 2.0, "nodes.n_nodes": 30.0,
    }  # fmt: skip


def test_nothing_to_compare_is_said_in_a_line(tmp_path, capsys):
    assert main([str(tmp_path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "no run under" in line
    assert list(tmp_path.iterdir()) == []


def test_histories_lay_every_run_over_the_others(sweep):
    (comparison,) = compare(sweep[0])
    figure = histories_figure(comparison)
    rows = [ax.get_ylabel() for ax in figure.axes if ax.get_ylabel()]
    assert len(rows) == 4  # residual, states, costates, cost
    assert len(figure.axes) == 12
    lines = [line for line in figure.axes[0].get_lines() if line.get_marker() != "o"]
    norms = [[record["norm"] for record in member.iterations] for member in comparison.members[:4]]
    assert [list(line.get_ydata()) for line in lines] == norms
    assert [ax.get_xlabel() for ax in figure.axes[-3:]] == ["iteration", "CPU time (s)", "residual evaluations"]


def test_solutions_lie_over_each_other_and_over_the_reference(sweep):
    (comparison,) = compare(sweep[0], Solution.load(sweep[1]))
    figure = solutions_figure(comparison)
    assert len(figure.axes) == 1 + 2 * 3
    assert all(len(ax.get_lines()) == 3 for ax in figure.axes)
    reference, _, same = figure.axes[1].get_lines()
    assert same.get_ydata() == pytest.approx(reference.get_ydata(), rel=1e-6)


def test_extremals_are_told_apart_by_cost_and_costates(sweep):
    members = read_members(sweep[0])[:4]
    assert set(extremals(members).values()) == {"A"}
    strict = extremals(members, cost=0.0)
    assert len(set(strict.values())) > 1
    cheapest = min(members, key=lambda member: member.cost)
    assert strict[cheapest.folder] == "A"


def member(name, cost, smoothing):
    """As much of one as letters need."""
    return SimpleNamespace(folder=Path(name), solved=True, cost=cost, smoothing=smoothing, solution=None)


def test_extremals_of_different_smoothing_are_those_of_different_problems():
    sharp, other, smooth, exact = members = [
        member("sharp", 268.04, 0.03), member("other", 300.0, 0.03), member("smooth", 272.2, 1.0),
        member("exact", 268.01, 0.0),
    ]  # fmt: skip
    assert extremals(members) == {
        exact.folder: "A", sharp.folder: "A (ρ 0.03)", other.folder: "B (ρ 0.03)", smooth.folder: "A (ρ 1)"
    }  # fmt: skip
    assert extremals([sharp, other]) == {sharp.folder: "A", other.folder: "B"}


def test_smoothing_is_shown_where_there_is_any(sweep, tmp_path, monkeypatch):
    folder, _ = sweep
    smoothed = compare(folder)
    assert [row["smoothing ρ"] for row in smoothed[0].rows()] == ["1", "1", "–"]  # the last one has no solution
    assert [row["smoothing ρ"] for row in smoothed[0].member_rows()][:2] == [1.0, 1.0]
    assert "Every ρ makes a problem of its own" in write_comparison(smoothed, tmp_path, {})
    monkeypatch.setattr(Member, "smoothing", 0.0)
    exact = compare(folder)
    assert "smoothing ρ" not in exact[0].rows()[0]
    assert "ρ" not in write_comparison(exact, tmp_path, {})


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([1.0, 2.0, 4.0], "2 [1, 4]"),
        ([3.0, 3.0], "3"),
        ([1.0, math.nan], "1 (1 missing)"),
        ([math.inf], "–"),
        ([], "–"),
    ],
)
def test_spread(values, text):
    assert spread(values) == text
