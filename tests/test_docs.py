"""The README and docs/ say what works: their Python is run, their commands are composed, their files exist."""

import re
import shlex
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from ponn_torch.build import build
from ponn_torch.cli.flight import build as build_flight
from ponn_torch.cli.overrides import PONN as PONN_APPLICATION
from ponn_torch.cli.overrides import RHC, Application, groups, read
from ponn_torch.optimal_control.problem import SIGNATURES, OptimalControlProblem

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
PYTHON = re.findall(r"^```python\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
SHELL = re.findall(r"^```sh\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
COMMANDS = [words for block in SHELL for line in block.splitlines() if (words := shlex.split(line, comments=True))]
UNIQUE = sorted({tuple(words) for words in COMMANDS})
PONN = [list(words[1:]) for words in UNIQUE if words[0] == "ponn"]
GUIDE = [list(words[1:]) for words in UNIQUE if words[0] == "ponn-rhc"]
LINKED = [
    (page, link or image)
    for page in [*PAGES, *sorted((ROOT / "experiments").glob("**/README.md"))]
    for link, image in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)|src=\"([^\"]+)\"", page.read_text(encoding="utf-8"))
]


def test_python_runs_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    first, problem, solve = PYTHON
    exec(first, names)
    assert names["result"].certified
    assert names["again"].cost == pytest.approx(268.0146563274, abs=1e-6)
    assert [stage.name for stage in names["later"].stages] == ["split"]
    assert names["later"].certified
    exec(problem, names)
    exec(solve, names)
    own = names["result"]
    assert own.certified
    assert own.solution.arcs == ["max", "min", "max"]
    (stated,) = re.findall(r"max-min-max, ([\d.]+) kg", solve)
    assert own.solution.cost == pytest.approx(float(stated), abs=5e-4)


def test_a_sweep_and_a_single_run_are_shown() -> None:
    assert any("-m" in arguments for arguments in PONN)
    assert any("-m" not in arguments for arguments in PONN)


@pytest.mark.parametrize("arguments", PONN, ids=" ".join)
def test_commands_are_understood(arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lander.py").write_text(PYTHON[1], encoding="utf-8")
    command = read(arguments)
    assert command.multirun == ("-m" in arguments)
    if command.config is not None:
        build(command.config)


@pytest.mark.parametrize("arguments", GUIDE, ids=" ".join)
def test_guidance_commands_are_understood(arguments: list[str]) -> None:
    command = read(arguments, RHC)
    assert command.multirun == ("-m" in arguments)
    if command.config is not None:
        build_flight(command.config)


@pytest.mark.parametrize(("application", "header"), [(PONN_APPLICATION, "| group |"), (RHC, "| `ponn-rhc` |")])
def test_table_of_groups_is_complete(application: Application, header: str) -> None:
    table = TEXT.partition(header)[2].partition("\n\n")[0]
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*)\|$", table, re.MULTILINE))
    for name, options in groups(application).items():
        if name == "hydra":
            continue
        for option in set(options) - {"custom"}:  # which a reference stands for
            assert f"`{option}`" in rows[name], f"{name}={option} is missing from the table of docs/"


def test_table_of_fields_is_complete() -> None:
    table = TEXT.partition("| field |")[2].partition("\n\n")[0]
    named = re.findall(r"`([^`]+)`", " ".join(re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)))
    signatures = {name: f"{name}({', '.join(arguments)})" for name, arguments in SIGNATURES.items()}
    stated = [signatures.get(field.name, field.name) for field in fields(OptimalControlProblem) if field.init]
    assert sorted(named) == sorted(stated)


def test_sections_that_are_linked_exist() -> None:
    titles = re.findall(r"^#+ (.*)$", TEXT, re.MULTILINE)
    known = {re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles}
    assert set(re.findall(r"\]\([^)#:]*#([^)]*)\)", TEXT)) <= known


@pytest.mark.parametrize(("page", "link"), sorted(set(LINKED)), ids=lambda x: str(getattr(x, "name", x)))
def test_linked_files_exist(page: Path, link: str) -> None:
    assert (page.parent / link).is_file()


def test_every_study_is_listed() -> None:
    index = (ROOT / "experiments" / "README.md").read_text(encoding="utf-8")
    for study in (ROOT / "experiments").glob("*/README.md"):
        assert f"]({study.parent.name}/README.md)" in index


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"(?:^|`)make ([a-z]+)\b", TEXT, re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"no make {target}"
