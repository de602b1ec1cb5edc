"""Every config: it builds, it says what it is, it holds every setting, and it solves with a tiny budget."""

import inspect
import json
import math
from dataclasses import fields
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from ponn_torch.ansatz.basis import LinearBasis
from ponn_torch.build import Plan, build
from ponn_torch.cli.run import run
from ponn_torch.optimal_control.problem import FreeTime
from ponn_torch.optimal_control.references import load_problem
from ponn_torch.settings import ROOMS, target
from ponn_torch.solving import run as run_module
from ponn_torch.solving.certificate import Certificate
from ponn_torch.solving.solver import Solver

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
OTHERS = {"hydra", "rhc"}  # how runs are made; another command, tested in test_guide.py
OPTIONS = sorted((path.parent.name, path.stem) for path in CONFIGS.glob("*/*.yaml") if path.parent.name not in OTHERS)
REFERENCE = "problem.reference='ponn_torch.problems.mars_landing:mars_landing'"


DATA = Path(__file__).parent / "landing.csv"
# What a config cannot do without.
NEEDED = {"custom": [REFERENCE], "file": [f"data.path='{DATA}'", "problem=mars_landing"]}


@pytest.fixture(scope="module", autouse=True)
def solved(tmp_path_factory: pytest.TempPathFactory) -> None:
    """A solution to restart from."""
    folder = tmp_path_factory.mktemp("solved")
    solution = Solver().solve(load_problem("ponn_torch.problems.mars_landing:mars_landing")).solution
    assert solution is not None
    solution.save(folder)
    NEEDED["solution"] = [f"guess.solution='{folder}'", "problem=mars_landing"]


def overrides_of(group: str, option: str) -> list[str]:
    return [f"{group}={option}", *NEEDED.get(option, [])]


def composed(overrides: list[str]) -> DictConfig:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return compose("solve", overrides)


def built(*overrides: str) -> Plan:
    return build(composed(list(overrides)))


def test_the_glob_sees_every_group() -> None:
    groups = {group for group, _ in OPTIONS}
    assert groups == {path.name for path in CONFIGS.iterdir() if path.is_dir()} - OTHERS
    assert {"problem", "ansatz", "nodes", "optimizer", "continuation", "record", "experiment"} <= groups


def test_defaults_are_those_of_the_solver() -> None:
    solver, default = built().solver, Solver()
    for item in fields(Solver):
        given, meant = getattr(solver, item.name), getattr(default, item.name)
        if isinstance(meant, LinearBasis):
            assert (type(given), given.arguments) == (type(meant), meant.arguments)
        else:
            assert given == meant, item.name


def calls(node: object) -> list[dict[str, object]]:
    """Every node with a ``_target_``."""
    if isinstance(node, list):
        return [found for entry in node for found in calls(entry)]
    if not isinstance(node, dict):
        return []
    below = [found for entry in node.values() for found in calls(entry)]
    return [node, *below] if "_target_" in node else below


WITHOUT_CONFIG = {"dtype", "device", "form", "basis", "smallest_damping", "largest_damping"}


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_config_builds_opens_with_what_it_is_and_holds_every_setting(group: str, option: str) -> None:
    config = composed(overrides_of(group, option))
    assert not build(config).notes
    lines = (CONFIGS / group / f"{option}.yaml").read_text(encoding="utf-8").splitlines()
    text = next(line for line in lines if not line.startswith("# @package"))
    assert text.startswith("# ")
    assert len(text) < 120
    for node in calls(OmegaConf.to_container(config).get(group)) if group != "continuation" else []:
        parameters = inspect.signature(target(node["_target_"], "_target_", ROOMS)).parameters
        assert set(parameters) - set(node) <= WITHOUT_CONFIG


# The known optimum is looked up by data, so that it vanishes with them.
@pytest.mark.parametrize(
    ("problem", "cost", "free"),
    [
        ("earth_mars", 396.05984393, False),
        ("earth_venus", 209.42204516, False),
        ("mars_landing", 268.0146563274, False),
        ("mars_landing_g981", 267.9318584923, False),
        ("tfc_test_1", 179.4476468458, True),
        ("tfc_test_2", 275.2062387119, True),
    ],
)
def test_known_optimum_belongs_to_the_published_data(problem: str, cost: float, free: bool) -> None:
    found = built(f"problem={problem}").problem
    assert (found.name, found.known_cost) == (problem, cost)
    assert isinstance(found.final_time, FreeTime) is free
    assert built(f"problem={problem}", "problem.regulariser=quadratic").problem.known_cost == cost
    assert built(f"problem={problem}", "problem.initial_mass=1600").problem.known_cost is None
    assert built(f"problem={problem}", "problem.initial_mass=1600", "problem.known_cost=3").problem.known_cost == 3


TINY = [
    "explain=false",  # of runs that are cut short there is nothing to explain
    "n_starts=1",
    "start_limit=1e9",
    "ansatz=legendre",
    "ansatz.size=8",
    "nodes.n_nodes=16",
    "optimizer.stopping.max_iterations=2",
    "problem=mars_landing",
    "continuation=single",
    "refinement=none",
    "record=minimal",
]
MLPS = [option for group, option in OPTIONS if group == "ansatz" and "mlp" in option]
# What stands in the way of a tiny budget, per group or option.
INSTEAD = {
    "ansatz": ["ansatz.size=8"],
    "rbf": ["ansatz.centres=8"],
    **{name: ["ansatz.hidden=[6,6]"] for name in MLPS},
    "optimizer": ["optimizer.stopping.max_iterations=2"],
    "fixed": ["+weights.equations={v_1:3.0,lambda_m:0.1}"],
    "sweep": ["record.tensorboard=false"],
    "quiet": ["record.figures=false", "record.tensorboard=false"],
    "refinement": [],
    "tanh_ladder": ["continuation.count=2"],
    "weak_ladder": ["continuation.phases.1.count=2"],
    "ladder": ["continuation.values=[1.0,0.1]"],
    "polar": ["problem=earth_mars"],
    "split": ["refinement.max_rounds=1", "refinement.stopping.max_iterations=2"],
    "two_loop": ["refinement.max_rounds=1", "refinement.stopping.max_iterations=2"],
    "split_mlp": ["refinement.max_rounds=1", "refinement.max_sharpenings=0", "refinement.stopping.max_iterations=2"],
    "enrichment": ["refinement.last=0.5"],
    "switch_neurons": ["refinement.last=0.5"],
    "subdivide": ["refinement.max_rounds=1", "refinement.stopping.max_iterations=2"],
    "adam_lbfgs": [f"optimizer.parts.{i}.stopping.max_iterations=2" for i in (0, 1)],
    "adam_lm": [f"optimizer.parts.{i}.stopping.max_iterations=2" for i in (0, 1)],
    "variable_projection": ["ansatz=mlp", "ansatz.hidden=[6,6]", "optimizer.optimizer.stopping.max_iterations=2"],
    "lm_output": [
        "optimizer.parts.0.stopping.max_iterations=2",
        "optimizer.parts.1.optimizer.stopping.max_iterations=2",
    ],
}
# Settings of a tiny budget that an option does not have.
ABSENT = (
    {"none": ["refinement.max_rounds"], "variable_projection": ["optimizer.stopping.max_iterations", "ansatz.size"]}
    | {name: ["ansatz.size"] for name in ("rbf", *MLPS)}
    | {name: ["optimizer.stopping.max_iterations"] for name in ("adam_lbfgs", "adam_lm", "lm_output")}
)


def tiny(group: str, option: str) -> list[str]:
    """Overrides for a run of this config that takes a moment."""
    chosen = {text.split("=")[0]: text for text in TINY}
    if group == "experiment":
        # an experiment chooses its own problem, ladder and sizes
        for key in ("problem", "ansatz", "ansatz.size", "nodes.n_nodes", "continuation", "refinement"):
            chosen.pop(key, None)
        chosen |= {"continuation": "continuation=single", "nodes.n_nodes": "nodes.n_nodes=16"}
        chosen["ansatz.size"] = "ansatz.size=8"
        refinement = composed([f"experiment={option}"]).get("refinement") or {}
        for key, value in (("last", 0.5), ("max_rounds", 1), ("n_neurons", 20)):
            if key in refinement:
                chosen[f"refinement.{key}"] = f"refinement.{key}={value}"
        if "stopping" in refinement:
            chosen["refinement.stopping"] = "refinement.stopping.max_iterations=2"
    elif group == "ansatz":
        chosen.pop("ansatz.size")
    for text in [*overrides_of(group, option), *INSTEAD.get(group, []), *INSTEAD.get(option, [])]:
        chosen[text.split("=")[0]] = text
    for key in ABSENT.get(option, []):
        chosen.pop(key, None)
    return list(chosen.values())


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Certificate:
    """Of a tiny run: no config changes how a solution is judged, and flying takes longer than these runs."""
    folder = tmp_path_factory.mktemp("judged")
    run(composed(tiny("problem", "mars_landing")), folder, [])
    return Certificate.from_dict(json.loads((folder / "certificate.json").read_text(encoding="utf-8")))


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_config_solves_with_a_tiny_budget(
    group: str, option: str, certificate: Certificate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_module, "certify", lambda *_: certificate)
    outcome = run(composed(tiny(group, option)), tmp_path, tiny(group, option))
    assert outcome.exit_code in (0, 2), outcome.message
    assert outcome.cost is not None
    assert math.isfinite(outcome.cost)
    assert outcome.cost > 0 or option in ("orbit_raising", "goddard")  # which maximise
    assert not outcome.certified
    assert outcome.score == math.inf
    assert (tmp_path / "solution" / "solution.json").is_file()
    assert (tmp_path / "figures" / "control.png").is_file() is (option == "default")
