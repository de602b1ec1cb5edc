"""The command line as people meet it: slips, run folders, interruptions, own problems, sweeps."""

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import plugin_data_pb2

from ponn_torch.cli import main
from ponn_torch.cli.overrides import read
from ponn_torch.optimal_control.references import load_problem
from ponn_torch.solving.solution import Solution

OWN_PROBLEM = """
from ponn_torch.optimal_control.control_laws import Box, Unconstrained
from ponn_torch.optimal_control.problem import OptimalControlProblem


def shift(distance: float = 1.0, time: float = 1.0) -> OptimalControlProblem:
    if time < 0.1:
        raise ValueError(f"time = {time}; allowed: at least 0.1")
    return OptimalControlProblem(
        name="shift",
        states={"x": 1, "v": 1},
        control=Unconstrained("force", 1),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.force},
        running_cost=lambda t, x, u, p: 0.5 * (u.force * u.force).sum(-1, keepdim=True),
        initial={"x": 0.0, "v": 0.0},
        final={"x": distance, "v": 0.0},
        final_time=time,
    )


def broken() -> OptimalControlProblem:
    return undefined_name


def pushed(bound="1", speed="v") -> OptimalControlProblem:
    return OptimalControlProblem(
        name="pushed",
        states={"x": 1, "v": 1},
        control=Box("force", maximum=bound),
        dynamics=lambda t, x, u, p: {"x": getattr(x, speed), "v": u.force},
        running_cost=lambda t, x, u, p: u.force,
        initial={"x": 0.0, "v": 0.0},
        final={"x": 1.0},
        final_time=1.0,
    )
"""
LANDING = ["problem=mars_landing", "record=minimal"]
HOPELESS = [*LANDING, "explain=false", "n_starts=1", "ansatz.size=4", "optimizer.stopping.max_iterations=1"]


@pytest.fixture
def own_problem(tmp_path: Path) -> Path:
    path = tmp_path / "my problem.py"
    path.write_text(OWN_PROBLEM, encoding="utf-8")
    return path


def outcome_in(folder: Path) -> dict[str, object]:
    return json.loads((folder / "outcome.json").read_text(encoding="utf-8"))


def events_in(folder: Path) -> list[str]:
    lines = (folder / "records.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line)["event"] for line in lines]


# -- bad input -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argument", "told"),
    [
        ("problm=mars_landing", ["problm", "'problem'"]),
        ("sed=3", ["sed", "'seed'"]),
        ("resum=runs/x", ["resum", "'resume'"]),
        ("hydra.run.dir=/dev/null/run", ["hydra.run.dir = '/dev/null/run'", "a folder that can be made"]),
        ("problem=mars_landng", ["problem = 'mars_landng'", "earth_mars", "'mars_landing'"]),
        ("problem=null", ["problem = None", "earth_mars"]),
        ("ansatz=elm_tan", ["ansatz = 'elm_tan'", "chebyshev", "'elm_tanh'"]),
        ("experiment=ponn_landing_papr", ["experiment = 'ponn_landing_papr'", "'ponn_landing_paper'"]),
        ("problem.final_time_day=3", ["problem.final_time_day", "'final_time_days'"]),
        ("optimizer.stoping.tolerance=1", ["optimizer.stoping", "'stopping'"]),
        ("+optimizer.stopping.tolerence=1", ["optimizer.stopping.tolerence", "'tolerance'"]),
        ("hydra.run.dirr=x", ["hydra.run.dirr", "'dir'"]),
        ("problem.regulariser=entrpy", ["problem.regulariser = 'entrpy'", "quadratic", "'entropy'"]),
        ("nodes.kind=legendre_gaus", ["nodes.kind = 'legendre_gaus'", "uniform", "'legendre_gauss'"]),
        ("ansatz.conditioning=colums", ["ansatz.conditioning = 'colums'", "'columns'"]),
        ("mass_variable=logmass", ["mass_variable = 'logmass'", "delta_v", "'log_mass'"]),
        ("optimizer.linear_solver=chol", ["optimizer.linear_solver = 'chol'", "qr", "'cholesky'"]),
        ("dtype=float32", ["dtype = float32 with refinement = Split", "float64"]),
        ("dtype=float16", ["dtype = 'float16'", "'float64'"]),
        ("budget.cpu_seconds=0", ["budget.cpu_seconds = 0", "positive"]),
        ("budget.seconds=3", ["budget.seconds", "cpu_seconds"]),
        ("finish=output_layr", ["finish = 'output_layr'", "'output_layer'"]),
        ("optimizer=adam_lbgs", ["optimizer = 'adam_lbgs'", "'adam_lbfgs'"]),
        ("weights.equations.r=3", ["weights.r: no such equation", "v_1", "lambda_m"]),
        ("weights.equations.v_1=0", ["weights.v_1 = 0", "a positive number"]),
        ("device=gpu", ["device = 'gpu'", "cpu"]),
        ("problem.final_time_days=long", ["problem.final_time_days = 'long'", "a number"]),
        ("problem.final_time_days=-3", ["problem.final_time_days = -3", "positive"]),
        ("problem.initial_mass=null", ["problem.initial_mass = None", "a number"]),
        ("problem.initial_position_km=[1,2]", ["problem.initial_position_km = [1", "three numbers"]),
        ("problem.minimum_thrust=2", ["problem.minimum_thrust = 2", "maximum_thrust = 0.5"]),
        ("n_starts=0", ["n_starts = 0", "at least 1"]),
        ("nodes.n_nodes=2.5", ["nodes.n_nodes = 2.5", "an integer"]),
        ("seed=-1", ["seed = -1", "from 0"]),
        ("tolerances.end_error=0", ["tolerances.end_error = 0", "positive"]),
        ("continuation.values=[1,-1]", ["continuation", "-1", "positive"]),
        ("continuation.values=3", ["continuation.values = 3", "a list"]),
        ("optimizer._target_=os.system", ["optimizer._target_ = 'os.system'", "ponn_torch.optim"]),
        ("problem._target_=ponn_torch.solving.solver.Solver", ["problem._target_", "ponn_torch.problems"]),
        ("form._target_=ponn_torch.ansatz.basis.Legendre", ["form.size", "missing"]),
        ("guess._target_=ponn_torch.solving.paths.Straightline", ["guess._target_", "'StraightLine'"]),
        ("problem=no_such_module:f", ["problem module = 'no_such_module'"]),
        ("problem=nothing.py:f", ["problem file = 'nothing.py'", "does not exist"]),
        ("problem=[", ["'problem=['", "key=value"]),
        ("seed=1,2", ["seed=1,2", "--multirun"]),
        ("--sed=3", ["--sed", "no such option"]),
    ],
)
def test_bad_input_is_one_line(
    argument: str,
    told: list[str],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([argument]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    for part in told:
        assert part in line
    assert list(tmp_path.iterdir()) == []  # no run folder for what was never run


def test_own_problem_with_a_wrong_name_or_argument(
    own_problem: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for arguments, told in (
        ([f"problem={own_problem}:shft"], ["'shft'", "'shift'"]),
        ([f"problem={own_problem}:shift", "problem.arguments.tme=1"], ["'tme'", "'time'"]),
        ([f"problem={own_problem}:shift", "problem.arguments.time=0.01"], ["problem.arguments.time = 0.01"]),
    ):
        assert main([*arguments, f"hydra.run.dir='{tmp_path}/run'"]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert all(part in line for part in told)


# -- runs ------------------------------------------------------------------------------------------


def test_run_leaves_a_complete_folder_and_may_be_run_again(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    arguments = ["problem=mars_landing", "seed=1", "record.stage_figures=false", f"hydra.run.dir='{folder}'"]
    assert main([*arguments, "continuation.values=[1.0,0.1,0.01]"]) == 0
    printed = capsys.readouterr().out
    for part in ("certified extremal", "268.01465", "31.0920056", "39.2202817", "max-min-max", str(folder)):
        assert part in printed.replace("\n", " ")
    names = {path.name for path in folder.iterdir()}
    expected = {"config.yaml", "overrides.yaml", "records.jsonl", "solution", "certificate.json", "figures"}
    assert expected | {"report.md", "environment.json", "outcome.json"} <= names
    assert not any(name.startswith("failure") for name in names)
    assert [name for name in names if name.startswith("events.out.tfevents")]
    assert {path.suffix for path in (folder / "figures").iterdir()} == {".png"}
    assert json.loads((folder / "certificate.json").read_text(encoding="utf-8"))["certified"] is True
    outcome = outcome_in(folder)
    assert outcome["exit_code"] == 0
    assert outcome["cost"] == pytest.approx(268.0146563274, abs=1e-6)
    assert outcome["switch_times"] == pytest.approx([31.0920056478, 39.2202817443], abs=1e-4)
    assert Solution.load(folder / "solution").cost == pytest.approx(outcome["cost"], abs=1e-9)
    first = events_in(folder)
    assert first.count("certificate") == 1

    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    assert main([*HOPELESS, f"hydra.run.dir='{folder}'"]) == 2
    assert len(events_in(folder)) < len(first)
    left = {path.name for path in folder.iterdir()}
    assert "notes.txt" in left
    assert {"failure.txt", "outcome.json"} <= left
    assert not {"certificate.json", "figures"} & left
    assert not [name for name in left if name.startswith("events")]


def test_failed_run_says_why(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main([*HOPELESS, f"hydra.run.dir='{tmp_path}'"]) == 2
    reason = outcome_in(tmp_path)["message"]
    assert isinstance(reason, str)
    assert "start 1 of seed 0 failed" in reason
    assert reason in capsys.readouterr().out
    assert (tmp_path / "failure.txt").read_text(encoding="utf-8").startswith(reason)
    assert "iteration" in events_in(tmp_path)


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("continuation.values=[0.03,1.0]", "continuation.values = [0.03, 1.0] rise"),
        ("nodes.n_nodes=1", "nodes.n_nodes = 1: 5 equations for 7 coefficients"),
    ],
)
def test_settings_that_are_seldom_meant_are_noted(
    setting: str, told: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    main([*HOPELESS, setting, f"hydra.run.dir='{tmp_path}'"])
    assert f"note: {told}" in capsys.readouterr().out
    assert f"- Note: {told}" in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_own_problem_from_a_file(own_problem: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    arguments = [f"problem={own_problem}:shift", "problem.arguments.distance=2", "record=minimal"]
    assert main([*arguments, f"hydra.run.dir='{folder}'"]) == 0
    # ½∫u² for a rest-to-rest shift by d in time T is 6 d²/T³
    assert outcome_in(folder)["cost"] == pytest.approx(24.0, abs=1e-9)
    assert Solution.load(folder / "solution").problem.name == "shift"


def test_a_file_may_import_its_neighbour(own_problem: Path, tmp_path: Path) -> None:
    (own_problem.parent / "neighbour_of_mine.py").write_text("SPEED = 0.0\n", encoding="utf-8")
    text = own_problem.read_text(encoding="utf-8")
    own_problem.write_text(f"import neighbour_of_mine\n{text}", encoding="utf-8")
    path = list(sys.path)
    assert main([f"problem={own_problem}:shift", "record=minimal", f"hydra.run.dir='{tmp_path / 'run'}'"]) == 0
    assert sys.path == path


def test_columns_are_as_wide_as_the_longest_name_needs(
    own_problem: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    own_problem.write_text(OWN_PROBLEM.replace('"x"', '"longitude"'), encoding="utf-8")
    assert main([f"problem={own_problem}:shift", "record=minimal", f"hydra.run.dir='{tmp_path / 'run'}'"]) == 0
    report = (tmp_path / "run" / "report.md").read_text(encoding="utf-8")
    for text in (capsys.readouterr().out, report):
        (line,) = (line for line in text.splitlines() if line.startswith("end of longitude"))
        (below,) = (line for line in text.splitlines() if line.startswith("CPU time"))
        assert line[16:18] == below[16:18] == "  "
        assert " " not in line[18] + below[18]


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ([], True),
        (["n_certified=2"], False),  # compared
        (["n_starts=1"], False),  # there is no other
        (["refinement=none"], False),  # the first one through is the result, whatever n_certified says
    ],
)
def test_the_first_extremal_is_not_said_to_be_the_best(
    settings: list[str], told: bool, own_problem: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    arguments = [f"problem={own_problem}:shift", "record=minimal", *settings]
    assert main([*arguments, f"hydra.run.dir='{tmp_path / 'run'}'"]) == 0
    assert outcome_in(tmp_path / "run")["certified"]
    row = "\nextremal    the first one certified, perhaps not the best; n_certified=5"
    assert (row in capsys.readouterr().out) is told


def test_a_known_optimum_tells_what_an_extremal_is_worth(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["problem=double_integrator_time", "record=minimal", f"hydra.run.dir='{tmp_path}'"]) == 0
    printed = capsys.readouterr().out
    assert "; known optimum 2, difference" in printed
    assert "\nextremal " not in printed


@pytest.mark.parametrize(
    ("source", "settings", "told"),
    [
        ("", ["broken"], "my problem.py:22: NameError: name 'undefined_name' is not defined"),
        ("", ["pushed", "bound=1", "speed=w"], "my problem.py:30: AttributeError: no entry named 'w'; allowed: x, v"),
        ("", ["shift", "time=long"], "my problem.py:7: TypeError: '<' not supported between"),
        ("from nowhere import anything", ["shift"], "my problem.py:36: ModuleNotFoundError: No module named 'nowhere'"),
        ("def :", ["shift"], "my problem.py:36: SyntaxError: invalid syntax"),
    ],
)
def test_a_slip_in_an_own_problem_is_told_with_its_line(
    source: str, settings: list[str], told: str, own_problem: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    own_problem.write_text(OWN_PROBLEM + source, encoding="utf-8")
    folder, (function, *arguments) = tmp_path / "run", settings
    given = [f"problem.arguments.{text}" for text in arguments]
    assert main([f"problem={own_problem}:{function}", *given, f"hydra.run.dir='{folder}'"]) == 1
    printed = capsys.readouterr()
    assert f"ended       {told}" in printed.out
    assert "Traceback" not in printed.out + printed.err
    kept = (folder / "failure.txt").read_text(encoding="utf-8")
    assert kept.startswith(told)
    assert "raised as" in kept
    assert outcome_in(folder)["exit_code"] == 1


def test_what_an_own_problem_states_wrongly_is_told_with_its_line(
    own_problem: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for bound, told in (
        (
            "[1.0,2.0]",
            "my problem.py:29: force: maximum = (1.0, 2.0); allowed: a finite number, one for every component",
        ),
        ("'1'", "my problem.py:26: maximum of the control 'force' = '1'; allowed: a number"),
    ):
        assert main([f"problem={own_problem}:pushed", f"problem.arguments.bound={bound}"]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"ponn: {told}")
    assert list(tmp_path.iterdir()) == [own_problem]  # no run folder for what was never run


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_keeps_records_and_a_solution(number: signal.Signals, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    # a ladder long enough to be interrupted in the middle
    slow = ["continuation=tanh_ladder", "continuation.count=2000", "ansatz.size=40", "nodes.n_nodes=80"]
    command = [sys.executable, "-m", "ponn_torch.cli", *LANDING, *slow, f"hydra.run.dir='{folder}'"]
    with (
        interruptible(),
        subprocess.Popen(
            command, cwd=tmp_path, env=os.environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process,
    ):
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and process.poll() is None:
            records = folder / "records.jsonl"
            if records.exists() and events_in_progress(records) >= 2:
                break
            time.sleep(0.05)
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130, out + err
    assert "Traceback" not in out + err
    assert "interrupted" in out
    assert "interrupted" in (folder / "failure.txt").read_text(encoding="utf-8")
    assert events_in(folder).count("stage") >= 2
    assert Solution.load(folder / "solution").smoothing is not None
    assert outcome_in(folder)["exit_code"] == 130


@contextmanager
def interruptible() -> Iterator[None]:
    """Processes started here take interrupts, which those of a shell's background job inherit as ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def events_in_progress(records: Path) -> int:
    """Stages that a running process has ended."""
    return records.read_text(encoding="utf-8").count('"event": "stage"')


@pytest.mark.parametrize("optimizer", ["lm", "lbfgs"])
def test_a_resumed_run_ends_as_the_uninterrupted_one(
    optimizer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # every look at the clock costs a second, so that the budget cuts at the same iteration on any machine
    monkeypatch.setattr("ponn_torch.optim.base.time.process_time", map(float, itertools.count()).__next__)
    sizes = ["ansatz.size=12", "nodes.n_nodes=20", "optimizer.stopping.max_iterations=25", "start_limit=100"]
    common = [*LANDING, *sizes, f"optimizer={optimizer}", "refinement=none", "continuation.values=[1.0,0.5]"]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert main([*common, f"hydra.run.dir='{whole}'"]) == 0
    assert main([*common, "budget.cpu_seconds=20", f"hydra.run.dir='{cut}'"]) in (0, 2)
    assert list((cut / "checkpoints").glob("*.npz"))
    assert not (whole / "checkpoints").exists()
    short = iterations_in(cut)
    assert main([f"resume={cut}", "budget.cpu_seconds=.inf"]) == 0
    assert not (cut / "checkpoints").exists()
    assert iterations_in(cut) == iterations_in(whole)
    assert iterations_in(cut)[: len(short)] == short
    assert 0 < len(short) < len(iterations_in(whole))
    found, expected = (Solution.load(folder / "solution").curve.xi.tolist() for folder in (cut, whole))
    assert found == expected  # bit for bit


def test_a_resumed_run_tells_tensorboard_what_was_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ponn_torch.optim.base.time.process_time", map(float, itertools.count()).__next__)
    sizes = ["ansatz=legendre", "ansatz.size=12", "nodes.n_nodes=20", "optimizer=lbfgs", "start_limit=100"]
    tiny = ["optimizer.stopping.max_iterations=9", "continuation=single", "refinement=none", "record.tensorboard=true"]
    main([*LANDING, *sizes, *tiny, "budget.cpu_seconds=8", f"hydra.run.dir='{tmp_path}'"])
    before = hyperparameters_in(tmp_path)
    assert {"ansatz": "legendre", "optimizer": "lbfgs", "continuation": "single"}.items() <= before.items()
    assert main([f"resume={tmp_path}", "budget.cpu_seconds=.inf"]) == 0
    assert hyperparameters_in(tmp_path) == before | {"budget.cpu_seconds": ".inf"}


def hyperparameters_in(folder: Path) -> dict[str, object]:
    accumulator = EventAccumulator(str(folder))
    accumulator.Reload()
    started = accumulator.PluginTagToContent("hparams")["_hparams_/session_start_info"]
    values = plugin_data_pb2.HParamsPluginData.FromString(started).session_start_info.hparams
    return {name: value.string_value or value.number_value for name, value in values.items()}


def iterations_in(folder: Path) -> list[dict[str, object]]:
    lines = (folder / "records.jsonl").read_text(encoding="utf-8").splitlines()
    records = [json.loads(line) for line in lines]
    return [{k: v for k, v in record.items() if k != "seconds"} for record in records if record["event"] == "iteration"]


def test_a_resume_changes_the_budget_and_the_records_only(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ponn_torch.optim.base.time.process_time", map(float, itertools.count()).__next__)
    file = tmp_path / "own.py"
    file.write_text(OWN_PROBLEM, encoding="utf-8")
    sizes = ["ansatz.size=12", "nodes.n_nodes=20", "refinement=none", "record=minimal"]
    folder = tmp_path / "run"
    main([f"problem={file}:shift", *sizes, "budget.cpu_seconds=3", f"hydra.run.dir='{folder}'"])
    capsys.readouterr()
    for override in ("seed=5", "ansatz.size=13", "optimizer=lbfgs", "device=cpu"):
        assert main([f"resume={folder}", override]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"ponn: {override.partition('=')[0]}: ")
        assert "allowed: budget.*, record.*" in line
    file.write_text(OWN_PROBLEM.replace("0.5 *", "0.7 *"), encoding="utf-8")
    assert main([f"resume={folder}", "budget.cpu_seconds=.inf"]) == 1
    assert "other values of problem;" in outcome_in(folder)["message"]
    file.write_text(OWN_PROBLEM, encoding="utf-8")
    assert main([f"resume={folder}", "budget.cpu_seconds=.inf", "record.figures=false"]) == 0


def test_a_resume_that_finds_nothing_is_an_error(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for arguments, told in (
        ([f"resume={tmp_path}"], "nothing to resume"),
        (["-m", f"resume={tmp_path}"], "allowed: alone"),
    ):
        assert main(arguments) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert told in line


# -- sweeps and texts ------------------------------------------------------------------------------


def test_sweep_counts_and_explains_members_that_fail(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = tmp_path / "a sweep"
    masses = "problem.initial_mass=1905,-1,1900"
    assert main(["-m", *LANDING, masses, f"hydra.sweep.dir='{folder}'"]) == 1
    printed = capsys.readouterr().out
    assert "2 of 3 certified, 1 failed" in printed
    assert "problem.initial_mass = -1" in printed.splitlines()[-4]
    header, *rows = printed.splitlines()[-6:-2]
    column = header.index("settings: result")
    assert all(row[column:].startswith("problem.initial_mass=") for row in rows)
    folders = [folder / f"{i}_problem.initial_mass={mass}" for i, mass in enumerate((1905, -1, 1900))]
    outcomes = [outcome_in(member) for member in folders]
    assert [outcome["exit_code"] for outcome in outcomes] == [0, 1, 0]
    assert outcomes[0]["known_cost"] == pytest.approx(268.0146563274)
    assert outcomes[2]["known_cost"] is None
    assert "problem.initial_mass = -1" in (folders[1] / "failure.txt").read_text(encoding="utf-8")


@pytest.mark.slow
def test_sweep_in_parallel_runs_every_member(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    parallel = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    members = ["seed=range(2)", "problem.initial_mass=1905,-1"]
    assert main(["-m", *LANDING, *members, *parallel, f"hydra.sweep.dir='{folder}'"]) == 1
    assert "2 of 4 certified, 2 failed" in capsys.readouterr().out
    found = list(folder.glob("*/environment.json"))
    assert len(found) == 4
    for path in found:
        environment = json.loads(path.read_text(encoding="utf-8"))
        assert environment["torch_threads"] == 1


def test_sweep_over_a_misspelt_config_does_not_begin(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    assert main(["-m", "ansatz=chebyshev,elm_tnh", f"hydra.sweep.dir='{folder}'"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "'elm_tanh'" in line
    assert not folder.exists()


def test_help_names_every_group_and_config(capsys: pytest.CaptureFixture[str]) -> None:
    configs = Path(__file__).resolve().parents[1] / "configs"
    texts = []
    for option in ("--help", "--config-groups"):
        assert main([option]) == 0
        texts.append(" ".join(capsys.readouterr().out.split()))
    for path in configs.glob("*/*.yaml"):
        if path.parent.name not in ("hydra", "rhc"):
            assert all(path.parent.name in text and path.stem in text for text in texts)
    assert "ponn resume=" in texts[0]


def test_settings_can_be_listed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["--cfg", "job", "problem=tfc_test_1"]) == 0
    assert "mass_flow_per_thrust: 0.00050863" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


def test_sweep_over_an_own_problem_is_understood(own_problem: Path) -> None:
    command = read(["-m", f"problem={own_problem}:shift", "problem.arguments.time=1,2"])
    assert command.multirun


def test_a_run_does_not_clear_the_solution_that_it_restarts_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    assert main([*LANDING, "record=minimal", f"hydra.run.dir='{folder}'"]) == 0
    for guess in (folder, folder / "solution"):
        again = [*LANDING, "guess=solution", f"guess.solution='{guess}'", f"hydra.run.dir='{folder}'"]
        assert main(again) == 1
        assert "allowed: another folder than the run's own" in capsys.readouterr().err
    assert (folder / "solution" / "solution.json").is_file()


def test_an_own_problem_is_read_afresh_however_soon_it_is_edited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python would keep compiled code beside the file, and take it for current by size and second."""
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    file = tmp_path / "own.py"
    for final_time in (1.0, 2.0):
        file.write_text(OWN_PROBLEM.replace("time: float = 1.0", f"time: float = {final_time}"), encoding="utf-8")
        os.utime(file, (1e9, 1e9))
        assert load_problem(f"{file}:shift").time_guess == final_time
    assert list(tmp_path.iterdir()) == [file]
