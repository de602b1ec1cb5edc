"""Notebooks: every page is a pair of script and notebook that say the same, and runs from top to bottom."""

import re
from pathlib import Path

import pytest

jupytext = pytest.importorskip("jupytext")

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
SCRIPTS = sorted(NOTEBOOKS.glob("*.py"))
FAST = ["01_quickstart"]


def test_there_are_notebooks():
    assert {path.stem for path in SCRIPTS} >= {"01_quickstart", "02_elm_vs_deep"}
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == {path.stem for path in SCRIPTS}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_both_of_a_pair_say_the_same(script):
    pair = (jupytext.read(path) for path in (script, script.with_suffix(".ipynb")))
    one, other = ([(cell.cell_type, cell.source.strip()) for cell in page.cells] for page in pair)
    assert one == other


@pytest.mark.parametrize(
    "name", [pytest.param(s.stem, marks=() if s.stem in FAST else pytest.mark.slow) for s in SCRIPTS]
)
def test_it_runs_from_top_to_bottom(name, capsys):
    names: dict[str, object] = {}
    for cell in jupytext.read(NOTEBOOKS / f"{name}.py").cells:
        if cell.cell_type == "code":
            exec(compile(cell.source, f"{name}.py", "exec"), names)
    printed = capsys.readouterr().out
    assert printed
    assert not re.search(r"\bnan\b", printed)
