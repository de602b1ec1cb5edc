"""What a run folder says to people: report.md with figures, environment.json, failures with their reason."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
import traceback
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

import ponn_torch
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem
from ponn_torch.reporting.figures import all_figures
from ponn_torch.reporting.recorder import finite_or_none
from ponn_torch.reporting.style import arc_intervals, columns, number, save, unit
from ponn_torch.solving.certificate import Certificate
from ponn_torch.solving.result import StageResult
from ponn_torch.solving.solution import Solution

REPORT, ENVIRONMENT, CERTIFICATE = "report.md", "environment.json", "certificate.json"
FAILURE_TEXT, FAILURE = "failure.txt", "failure.json"
FIGURES = "figures"

# caption of a figure, in the order of the report
CAPTIONS = {
    "control": "Control and switching function",
    "plane": "Path in the plane",
    "trajectory": "Path in space",
    "states": "States",
    "costates": "Costates",
    "mass": "Mass",
    "hamiltonian": "Drift of the Hamiltonian",
    "residual": "Residual at the nodes and between them",
    "convergence": "Convergence",
}


# -- environment --------------------------------------------------------------------------------------------


def _git(folder: Path, *arguments: str) -> str | None:
    """Output of a git command in a folder; None without git or a repository."""
    try:
        run = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=False, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return run.stdout.strip() if run.returncode == 0 else None


def commit() -> str | None:
    """Commit of the checkout that runs, with "+changes" where it was edited; None if installed."""
    root = Path(ponn_torch.__file__).resolve().parents[1]
    top = _git(root, "rev-parse", "--show-toplevel")
    # an installed package may lie inside some other project's repository
    if top is None or Path(top).resolve() != root:
        return None
    found = _git(root, "rev-parse", "--short=12", "HEAD")
    edited = _git(root, "status", "--porcelain", "--untracked-files=no", "--", "ponn_torch")
    return f"{found}+changes" if found and edited else found


def environment() -> dict[str, Any]:
    """Versions, platform and threads: what a figure in a table depends on; no paths, no names of people."""
    return {
        "ponn_torch": ponn_torch.__version__,
        "commit": commit(),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in ("torch", "numpy", "scipy")},
        "platform": f"{platform.system()} {platform.machine()}",
        "cpu_count": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
    }


def write_environment(folder: Path | str) -> dict[str, Any]:
    """Write environment.json."""
    found = environment()
    write_json(Path(folder) / ENVIRONMENT, found)
    return found


# -- failures -----------------------------------------------------------------------------------------------


def _frames(error: BaseException) -> list[str]:
    """Where an exception came from, file names without the folders of this machine."""
    out = []
    for frame in traceback.extract_tb(error.__traceback__):
        parts = Path(frame.filename).parts
        root = next((i for i in reversed(range(len(parts))) if parts[i] in ("ponn_torch", "site-packages")), None)
        shown = "/".join(parts[root:] if root is not None else parts[-1:])
        out.append(f"{shown}:{frame.lineno} in {frame.name}")
    return out


def write_failure(folder: Path | str, reason: str, error: BaseException | None = None) -> None:
    """Write failure.txt for people and failure.json for programs: the reason, where an error came from."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    kind, frames = (type(error).__name__, _frames(error)) if error is not None else (None, [])
    write_json(folder / FAILURE, {"reason": reason, "exception": kind, "frames": frames})
    lines = [reason, *([f"raised as {kind}"] if kind else []), *(f"  {frame}" for frame in frames)]
    (folder / FAILURE_TEXT).write_text("\n".join(lines) + "\n", encoding="utf-8")


# -- the report ---------------------------------------------------------------------------------------------


def write_report(
    folder: Path | str,
    *,
    solution: Solution | None = None,
    certificate: Certificate | None = None,
    stages: Sequence[StageResult] = (),
    settings: Mapping[str, Any] | None = None,
    message: str = "",
    notes: Sequence[str] = (),
    figures: bool = True,
) -> Path:
    """Write report.md with all that is known, its figures, certificate.json and environment.json.

    ``solution`` and ``certificate`` may be missing, as in a failed run; ``message`` is its reason.
    ``notes`` are remarks on its settings. Returns the path of the report.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    found = write_environment(folder)
    drawn: list[str] = []
    if solution is not None and figures:
        for name, figure in all_figures(solution, stages).items():
            save(figure, folder / FIGURES / f"{name}.png")
            drawn.append(name)
    if certificate is not None:
        write_json(folder / CERTIFICATE, certificate.to_dict())
    parts = [
        _title(solution, certificate, message),
        "\n".join(f"- Note: {note}" for note in notes),
        _result(solution) if solution is not None else "",
        _certificate(certificate, solution.problem) if certificate is not None and solution is not None else "",
        _stages(stages, solution),
        _figures(drawn),
        settings_text(settings or {}),
        environment_line(found),
    ]
    path = folder / REPORT
    path.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return path


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(finite_or_none(values), indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _title(solution: Solution | None, certificate: Certificate | None, message: str) -> str:
    name = "Run without a solution"
    if solution is not None:
        problem = solution.problem
        name = f"{problem.name}: {problem.description}" if problem.description else problem.name
    verdict = certificate.verdict if certificate is not None else "Not certified."
    told = message if message and message != verdict else ""
    return "\n\n".join(part for part in (f"# {name}", f"**{verdict}**", told) if part)


def _result(solution: Solution) -> str:
    problem = solution.problem
    time, cost = unit(problem, "time"), unit(problem, "cost")
    free = " (free)" if isinstance(problem.final_time, FreeTime) else " (fixed)"
    rows = [
        (problem.cost_name, number(solution.cost, cost, ".12g")),
        ("final time", number(solution.final_time, time, ".12g") + free),
        (
            "kind",
            solution.kind + (f", ρ = {solution.smoothing:.3g}" if solution.smoothing is not None else ""),
        ),
        ("residual between the nodes", f"{solution.off_node_residual:.1e} (scaled)"),
    ]
    if problem.known_cost is not None:
        rows.insert(1, ("known optimum", number(problem.known_cost, cost, ".12g")))
        rows.insert(2, ("difference", number(solution.cost - problem.known_cost, cost, ".3g")))
    text = "## Result\n\n" + table(("quantity", "value"), rows)
    arcs = arc_intervals(solution)
    if arcs:
        header = ("arc", "control", f"from ({time.label})", f"to ({time.label})", f"duration ({time.label})")
        lines = [
            (str(i + 1), label, *(f"{value / time.size:.9f}" for value in (start, end, end - start)))
            for i, (start, end, label) in enumerate(arcs)
        ]
        text += "\n\n### Arcs\n\n" + table(header, lines)
    return text


def verdict_table(certificate: Certificate) -> list[str]:
    """Lines of the certificate without those that have units: the verdict, then what was measured and allowed."""
    lines = certificate.to_text().splitlines()
    starts = ("end error of ", f"{certificate.cost_name}: ")
    last = next((i for i, line in enumerate(lines) if line.startswith(starts)), len(lines))
    return "\n".join(lines[:last]).rstrip().splitlines()


def end_error_rows(certificate: Certificate, problem: OptimalControlProblem) -> list[tuple[str, str]]:
    """How far both flights end off, in the units that people read."""
    rows: list[tuple[str, str]] = []
    for name, flown in certificate.end_errors.items():
        shown = unit(problem, name)
        errors = (number(value, shown, ".1e") for value in (flown, certificate.control_end_errors[name]))
        rows.append((f"end of {name}", "{} flown, {} by the control alone".format(*errors)))
    return rows


def _certificate(certificate: Certificate, problem: OptimalControlProblem) -> str:
    flown = number(certificate.flown_cost, unit(problem, "cost"), ".10g")
    rows = end_error_rows(certificate, problem)
    rows += [(certificate.cost_name, f"{flown} flown"), ("CPU time", f"{certificate.seconds:.2f} s")]
    return "\n".join(["## Certificate", "", "```", *verdict_table(certificate), "", *columns(rows), "```"])


def _stages(stages: Sequence[StageResult], solution: Solution | None) -> str:
    if not stages:
        return ""
    problem = solution.problem if solution is not None else None
    shown = unit(problem, "cost") if problem is not None else None
    name = problem.cost_name if problem is not None else "cost"
    name += f" ({shown.label})" if shown is not None and shown.label else ""

    def value(number_: float, text: str) -> str:
        return format(number_, text) if number_ == number_ else "–"

    rows = [
        (
            str(stage.start + 1),
            stage.name,
            "–" if stage.smoothing is None else f"{stage.smoothing:.3g}",
            str(stage.n_iterations),
            f"{stage.n_residuals} / {stage.n_linearisations}",
            value(stage.norm, ".2e"),
            value(stage.off_node_residual, ".1e"),
            value(stage.cost / (shown.size if shown is not None else 1.0), ".9g"),
            f"{stage.cpu_seconds:.2f}",
            stage.status.name.lower(),
        )
        for stage in stages
    ]
    header = (
        "start",
        "stage",
        "ρ",
        "iterations",
        "residuals / Jacobians",
        "‖r‖",
        "between nodes",
        name,
        "CPU s",
    )
    return "## Stages\n\n" + table((*header, "ended by"), rows)


def _figures(drawn: Sequence[str]) -> str:
    if not drawn:
        return ""
    ordered = [
        *(name for name in CAPTIONS if name in drawn),
        *(name for name in drawn if name not in CAPTIONS),
    ]
    shown = (f"### {CAPTIONS.get(name, name)}\n\n![{name}]({FIGURES}/{name}.png)" for name in ordered)
    return "## Figures\n\n" + "\n\n".join(shown)


def settings_text(settings: Mapping[str, Any]) -> str:
    if not settings:
        return ""
    text = json.dumps(finite_or_none(settings), indent=2, ensure_ascii=False)
    return f"## Settings\n\n```json\n{text}\n```"


def environment_line(found: Mapping[str, Any]) -> str:
    at = f" at {found['commit']}" if found["commit"] else ""
    versions = ", ".join(f"{name} {found[name]}" for name in ("python", "torch", "numpy", "scipy"))
    return (
        f"ponn_torch {found['ponn_torch']}{at}; {versions}; {found['platform']}, {found['cpu_count']} CPUs, "
        f"{found['torch_threads']} torch threads"
    )
