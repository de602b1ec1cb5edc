"""``ponn-rhc``: every config of its groups flies, run folders are complete, what is wrong is one line."""

import inspect
import json
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_configs import CONFIGS, calls
from torch import Tensor

from ponn_torch.cli import guide
from ponn_torch.cli.flight import KINDS, build, run
from ponn_torch.cli.mission import Mission
from ponn_torch.cli.overrides import RHC, groups, read
from ponn_torch.cli.tracking import Tracking
from ponn_torch.guidance import closed_loop
from ponn_torch.guidance.storage import load_flight
from ponn_torch.guidance.tracking import Plant
from ponn_torch.settings import ROOMS, target

ROOT = CONFIGS / "rhc"
# flown with another config, or below
FLOWN_ELSEWHERE = {
    ("flight", "tracking"),
    ("flight", "landing"),
    ("replanning", "default"),
    ("problem", "powered_descent"),
}
OPTIONS = sorted((path.parent.name, path.stem) for path in ROOT.glob("*/*.yaml") if path.parent.name != "hydra")
LONG = {("problem", "powered_descent_three_arcs"), ("replanning", "undisturbed")}  # seconds, and one landing is enough
FLOWN = [
    pytest.param(*pair, marks=[pytest.mark.slow] if pair in LONG else [], id="-".join(pair))
    for pair in OPTIONS
    if pair not in FLOWN_ELSEWHERE
]


def composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(ROOT), version_base="1.3"):
        return compose("fly", list(overrides))


def built(*overrides: str) -> Mission:
    return build(composed(*overrides))


def chosen_by(group: str, option: str) -> list[str]:
    """Overrides that choose a config; those of a landing's group need a landing."""
    landing = group == "replanning" or (group, option) == ("flight", "landing")
    return ["problem=powered_descent"] * landing + [f"{group}={option}"]


def tiny(group: str, option: str) -> list[str]:
    """A flight of a few cycles."""
    if composed(*chosen_by(group, option)).kind == "landing":
        few = ["replanning.cycle=5", "replanning.step=0.25", "problem.planned_share=1", "n_samples=1"]
        return [*chosen_by(group, option), *few, "record=minimal"]
    chosen = ["problem=clohessy_wiltshire", "n_samples=2", "record=minimal"]
    chosen = [text for text in chosen if not text.startswith(f"{group}=")] + [f"{group}={option}"]
    if option == "rbf_swarm":
        chosen += ["method.swarm.n_iterations=2", "method.swarm.n_particles=4"]
    if group != "problem":
        chosen += ["problem.final_time=40", "problem.horizon=100"]
    elif option in ("clohessy_wiltshire", "station_keeping"):
        chosen += ["problem.final_time=40"]
    else:
        chosen += ["problem.horizon=5.85" if option == "quadrotor" else "problem.horizon=2270"]
    return chosen


def test_the_glob_sees_every_group() -> None:
    assert {group for group, _ in OPTIONS} == {path.name for path in ROOT.iterdir() if path.is_dir()} - {"hydra"}
    assert set(groups(RHC)) == {group for group, _ in OPTIONS} | {"hydra"}
    assert sorted(path.stem for path in (ROOT / "flight").glob("*.yaml")) == sorted(KINDS)


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_config_builds_opens_with_what_it_is_and_holds_every_setting(group: str, option: str) -> None:
    plan = built(*chosen_by(group, option)).common
    lines = (ROOT / group / f"{option}.yaml").read_text(encoding="utf-8").splitlines()
    text = next(line for line in lines if not line.startswith("# @package"))
    assert text.startswith("# ")
    assert len(text) < 120
    for node in calls(plan.settings.get(group, {})):
        parameters = inspect.signature(target(node["_target_"], "_target_", ROOMS)).parameters
        assert set(parameters) - set(node) <= {"dtype", "device"}


@pytest.mark.parametrize(("group", "option"), FLOWN)
def test_config_flies(group: str, option: str, tmp_path: Path) -> None:
    outcome = run(composed(*tiny(group, option)), tmp_path, tiny(group, option))
    assert outcome.exit_code in (0, 2), outcome.message
    assert outcome.cost is not None
    assert outcome.cost > 0
    assert load_flight(tmp_path / "flight").completed
    assert (tmp_path / "figures" / "tracking.png").is_file() is (option == "default" and group == "record")


def test_a_run_leaves_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    overrides = ["problem.horizon=100", "problem.final_time=50", "n_vehicles=3", "schedule=true"]
    outcome = run(composed(*overrides), tmp_path, overrides)
    assert outcome.exit_code == 0
    assert outcome.certified
    lines = [json.loads(line) for line in (tmp_path / "records.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [line["event"] for line in lines] == ["cycle"] * 5 + ["certificate", "monte_carlo"]
    assert set(lines[0]["error"]) == {"r1", "r2", "r3", "v1", "v2", "v3"}
    certificate = json.loads((tmp_path / "certificate.json").read_text(encoding="utf-8"))
    assert certificate["certified"] is True
    assert certificate["largest_error"] < 1e-10
    assert lines[5]["largest_error"] == certificate["largest_error"]
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert len(events.Scalars("error/r1")) == 5
    assert events.Scalars("certificate/certified")[-1].value == 1.0
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    for name in ("tracking", "control", "accuracy", "timing"):
        assert (tmp_path / "figures" / f"{name}.png").is_file()
        assert f"figures/{name}.png" in report
    assert "Monte Carlo of 3 vehicles" in report
    assert load_flight(tmp_path / "monte_carlo").states.shape == (6, 3, 6)
    assert OmegaConf.load(tmp_path / "config.yaml").problem.final_time == 50
    said = capsys.readouterr().out
    assert "3 vehicles" in said
    assert "matrix exponential" in said
    assert not (tmp_path / "failure.txt").exists()


def test_a_landing_leaves_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    overrides = ["problem=powered_descent", "n_vehicles=2", "n_samples=1", "replanning.cycle=3", "replanning.step=0.2"]
    outcome = run(composed(*overrides), tmp_path, overrides)
    assert outcome.exit_code == 0, outcome.message
    assert outcome.certified
    assert outcome.cost == pytest.approx(182.4, abs=0.5)  # kg
    lines = [json.loads(line) for line in (tmp_path / "records.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [line["event"] for line in lines[-3:]] == ["cycle", "certificate", "monte_carlo"]
    assert set(lines[0]["error"]) == {"distance", "speed"}
    assert (lines[-1]["n_vehicles"], lines[-1]["n_landed"]) == (2, 2)
    certificate = json.loads((tmp_path / "certificate.json").read_text(encoding="utf-8"))
    assert certificate["largest_error"] < 1e-8
    assert certificate["planned_fuel"] - certificate["optimal_fuel"] == pytest.approx(3.01, abs=0.01)
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    for name in ("trajectory", "thrust", "dispersion", "timing"):
        assert (tmp_path / "figures" / f"{name}.png").is_file()
        assert f"figures/{name}.png" in report
    assert "2 landers: least" in report
    assert len(load_flight(tmp_path / "monte_carlo")) == 2
    flight = load_flight(tmp_path / "flight")
    assert flight.completed
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert len(events.Scalars("error/distance")) == flight.n_cycles
    assert events.Scalars("certificate/certified")[-1].value == 1.0
    assert "2 of 2 dispersed ones" in capsys.readouterr().out


def test_a_poor_basis_is_not_certified(tmp_path: Path) -> None:
    overrides = ["method.n_nodes=3", "problem.final_time=40", "problem.horizon=2000", "record=minimal"]
    outcome = run(composed(*overrides), tmp_path, overrides)
    assert outcome.exit_code == 2
    assert not outcome.certified
    assert "off the matrix exponential's" in (tmp_path / "failure.txt").read_text(encoding="utf-8")


def test_an_interrupted_flight_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = closed_loop._record

    def interrupted(*arguments: object) -> object:
        if arguments[1] == 3:
            raise KeyboardInterrupt
        return kept(*arguments)

    monkeypatch.setattr(closed_loop, "_record", interrupted)
    outcome = run(composed("record=minimal"), tmp_path, [])
    assert outcome.exit_code == 130
    assert not load_flight(tmp_path / "flight").completed
    lines = (tmp_path / "records.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["event"] for line in lines] == ["cycle"] * 3 + ["failure"]
    assert "interrupted" in (tmp_path / "failure.txt").read_text(encoding="utf-8")
    assert "Not certified" in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_an_interrupted_monte_carlo_is_told_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown, fleets = Plant.fly, []

    def interrupted(plant: Plant, t: float, x: Tensor, *arguments: object) -> Tensor:
        fleets.extend([x] * (x.dim() == 2))
        if len(fleets) == 3:
            raise KeyboardInterrupt
        return flown(plant, t, x, *arguments)

    monkeypatch.setattr(Plant, "fly", interrupted)
    overrides = ["problem.horizon=100", "problem.final_time=50", "n_vehicles=3", "record=minimal"]
    outcome = run(composed(*overrides), tmp_path, overrides)
    assert outcome.exit_code == 130
    assert load_flight(tmp_path / "flight").completed
    fleet = load_flight(tmp_path / "monte_carlo")
    assert (fleet.completed, fleet.n_cycles) == (False, 2)
    lines = (tmp_path / "records.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["event"] for line in lines] == ["cycle"] * 5 + ["certificate", "failure"]
    assert outcome.message == "interrupted after 2 cycles of the Monte Carlo; what was flown is kept"
    assert "3 vehicles" not in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_an_error_inside_leaves_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object) -> object:
        raise RuntimeError("the bus is down")

    monkeypatch.setattr(closed_loop, "_record", broken)
    outcome = run(composed("record=minimal"), tmp_path, [])
    assert outcome.exit_code == 3
    assert "the bus is down" in (tmp_path / "failure.txt").read_text(encoding="utf-8")
    last = (tmp_path / "records.jsonl").read_text(encoding="utf-8").splitlines()[-1]
    assert json.loads(last) == {"event": "failure", "reason": "the bus is down"}


@pytest.mark.parametrize(
    ("argument", "told"),
    [
        ("problem=quadroter", "problem = 'quadroter'; allowed: clohessy_wiltshire, powered_descent, "),
        ("problem.horizn=3", "problem.horizn: no such setting; allowed: "),
        ("problem.horizon=5", "problem.horizon = 5 s; allowed: at least one cycle, 10"),
        ("problem.horizon=far", "problem.horizon = 'far'; allowed: a number"),
        ("ending=stopp", "ending = 'stopp'; allowed: stop, shrink, extend (did you mean 'stop'?)"),
        ("method.route=lux", "method.route = 'lux'; allowed: lu, block, qr"),
        ("method.basis.size=12", "method.basis has 12 functions for 10 nodes; allowed: at most 10"),
        ("passes.most=0", "passes.most = 0; allowed: at least 1"),
        ("loop.noise=[1.0]", "loop.noise = [1.0]; allowed: one per state, r1"),
        ("loop.deadline=-1", "loop.deadline = -1.0; allowed: above 0 s"),
        ("n_vehicles=-1", "n_vehicles = -1; allowed: an integer from 0"),
        ("flight=landing", "flight = 'landing' with problem = 'clohessy_wiltshire'; allowed: tracking"),
        ("kind=flying", "kind = 'flying'; allowed: tracking, landing"),
        (
            "replanning=default",
            "replanning: no group of what is chosen here; allowed: record, problem, method, passes, loop",
        ),
        ("iteration_error=0", "iteration_error = 0.0; allowed: above 0"),
        ("problem=x.py:f", "problem = 'x.py:f'"),
    ],
)
def test_bad_input_is_one_line(
    argument: str, told: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert guide([argument]) == 1
    said = capsys.readouterr().err
    assert said.startswith("ponn-rhc: ")
    assert told in said
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_schedule_needs_one_pass(capsys: pytest.CaptureFixture[str]) -> None:
    assert guide(["problem=quadrotor", "passes=newton", "schedule=true"]) == 1
    assert "schedule = true with passes.most = 10; allowed: 1 pass, or a linear plant" in capsys.readouterr().err


def test_help_and_sweeps(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for option in ("--help", "--config-groups", "--version"):
        assert guide([option]) == 0
    said = capsys.readouterr().out
    assert "clohessy_wiltshire, powered_descent" in said
    assert "replanning" in said
    assert "Rendezvous on a circular orbit" in said
    monkeypatch.chdir(tmp_path)
    arguments = ["-m", "method=chebyshev,igpm", "problem.final_time=30", "record=minimal", "hydra.sweep.dir=sweep"]
    assert read(arguments, RHC).multirun
    assert guide(arguments) == 0
    assert "2 of 2 certified, 0 failed" in capsys.readouterr().out


def test_noise_is_given_in_the_units_that_figures_show() -> None:
    plan = built("loop.noise=[10,10,10,0.1,0.1,0.1]")
    assert isinstance(plan, Tracking)
    assert plan.loop.noise[0] == pytest.approx(10 / 7.5e6)
