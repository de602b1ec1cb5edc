"""Reports: report.md tells the result, its certificate and its environment, and nothing about the machine."""

import getpass
import json
import re
from pathlib import Path

import pytest

import ponn_torch
from ponn_torch.reporting.report import environment, table, write_failure, write_report
from ponn_torch.solving.certificate import Certificate

SETTINGS = {"problem": {"name": "mars_landing"}, "seed": 0}


@pytest.fixture(scope="module")
def reported(solved, tmp_path_factory):
    result, folder = solved("split"), tmp_path_factory.mktemp("run")
    path = write_report(
        folder,
        solution=result.solution,
        certificate=result.certificate,
        stages=result.stages,
        settings=SETTINGS,
        message=result.message,
    )
    return result, folder, path.read_text()


def test_report_holds_the_certificate(reported):
    result, folder, text = reported
    section = text.split("## Certificate")[1].split("##")[0]
    table = result.certificate.to_text().split("\n\n")
    assert table[0] in section
    assert table[1] in section
    assert "user units" not in text
    alone = result.certificate.control_end_errors["r"]
    assert f"flown, {alone:.1e} m by the control alone" in section
    saved = json.loads((folder / "certificate.json").read_text())
    assert Certificate.from_dict(saved) == result.certificate


def test_report_tells_the_result_in_display_units(reported):
    result, _, text = reported
    assert "| fuel | 268.014656" in text
    assert "| known optimum | 268.014656327 kg |" in text
    assert "| final time | 44.823 s (fixed) |" in text
    for switch in result.solution.switch_times:
        assert f"{switch:.9f}" in text
    assert "31.092005" in text  # the known switch
    assert text.count("| max |") == 2
    assert text.count("| min |") == 1


def test_report_has_a_line_per_stage_and_the_settings(reported):
    result, _, text = reported
    section = text.split("## Stages")[1].split("##")[0]
    assert section.count("\n| 1 |") == len(result.stages)
    assert '"name": "mars_landing"' in text.split("## Settings")[1]


def test_figures_are_embedded_by_relative_paths_that_exist(reported):
    _, folder, text = reported
    links = re.findall(r"!\[\w+\]\(([^)]+)\)", text)
    assert len(links) == 9
    for link in links:
        assert not Path(link).is_absolute()
        assert (folder / link).stat().st_size > 5000


def test_no_word_about_the_machine(reported):
    _, folder, text = reported
    written = text + (folder / "environment.json").read_text()
    for secret in (str(Path.home()), str(Path(ponn_torch.__file__).parents[1]), str(folder)):
        assert secret not in written
    assert f"{getpass.getuser()}@" not in written


def test_environment_names_what_numbers_depend_on():
    found = environment()
    assert set(found) == {
        "ponn_torch", "commit", "python", "torch", "numpy", "scipy", "platform", "cpu_count", "torch_threads"
    }  # fmt: skip
    assert found["commit"] is None or re.fullmatch(r"[0-9a-f]{12}(\+changes)?", found["commit"])
    assert found["torch_threads"] >= 1


def test_report_of_a_run_without_a_solution(tmp_path):
    text = write_report(tmp_path, message="no start led to a solution").read_text()
    assert "Not certified." in text
    assert "no start led to a solution" in text
    assert not (tmp_path / "figures").exists()


def test_failure_says_why_and_where_without_folders(tmp_path):
    try:
        table(("a",), [(1,)])
    except AttributeError as error:
        write_failure(tmp_path, "the table was given a number", error)
    saved = json.loads((tmp_path / "failure.json").read_text())
    assert (saved["reason"], saved["exception"]) == ("the table was given a number", "AttributeError")
    assert saved["frames"][0].startswith("test_report.py:")
    assert saved["frames"][-1].startswith("ponn_torch/reporting/report.py:")
    text = (tmp_path / "failure.txt").read_text()
    assert text.startswith("the table was given a number\nraised as AttributeError\n")
    assert str(Path(__file__).parent) not in text


def test_table_escapes_bars():
    assert table(("a", "b"), [("|x|", "1")]) == "| a | b |\n| --- | --- |\n| \\|x\\| | 1 |"
