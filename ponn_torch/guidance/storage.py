"""A flight in open formats: flight.json says what was flown, flight.npz and flight.csv hold the numbers."""

from __future__ import annotations

import csv
import importlib
import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ponn_torch import __version__
from ponn_torch.guidance.closed_loop import Flight
from ponn_torch.guidance.descent import Landing, PoweredDescent
from ponn_torch.guidance.tracking import TrackingProblem

DESCRIPTION, ARRAYS, TABLE = "flight.json", "flight.npz", "flight.csv"
FORMAT = 1
PLANTS = "ponn_torch.guidance.plants."
Problem = TrackingProblem | PoweredDescent
Flown = Flight | Landing
KINDS: dict[type[Problem], type[Flown]] = {TrackingProblem: Flight, PoweredDescent: Landing}  # what flies what


def make_problem(reference: str, arguments: Mapping[str, Any]) -> Problem:
    """Call "module:function" of the package's plants; a name elsewhere is refused, for a file may hold any."""
    module, _, name = reference.partition(":")
    if not module.startswith(PLANTS):
        raise ValueError(f"problem = {reference!r}; allowed: functions of {PLANTS.rstrip('.')}")
    problem: Problem = getattr(importlib.import_module(module), name)(**arguments)
    if not isinstance(problem, tuple(KINDS)):
        allowed = " or ".join(kind.__name__ for kind in KINDS)
        raise ValueError(f"problem = {reference!r} makes a {type(problem).__name__}; allowed: a {allowed}")
    return problem


def _units(problem: Problem) -> dict[str, float]:
    return {name: unit.size for name, unit in problem.displayed.items()}


def _arrays(kind: type[Flown]) -> list[str]:
    return [item.name for item in fields(kind) if item.name not in ("problem", "completed")]


def save_flight(flight: Flown, folder: Path, *, reference: str, arguments: Mapping[str, Any]) -> None:
    """Write a flight of the problem that ``reference`` ("module:function") makes of JSON arguments."""
    folder.mkdir(parents=True, exist_ok=True)
    description = {
        "format": FORMAT,
        "version": __version__,
        "problem": {"reference": reference, "arguments": dict(arguments)},
        "completed": flight.completed,
        "units": _units(flight.problem),
    }
    (folder / DESCRIPTION).write_text(json.dumps(description, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    with (folder / ARRAYS).open("wb") as stream:
        np.savez(stream, **{name: getattr(flight, name).numpy() for name in _arrays(type(flight))})
    if flight.alone:
        _write_table(flight, folder / TABLE)


def _write_table(flight: Flown, path: Path) -> None:
    """The flight of one vehicle in the units that people read."""
    shown = flight.problem.displayed
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([f"{name} ({unit.label})" for name, unit in shown.items()])
        sizes = np.array([unit.size for unit in shown.values()])
        if flight.n_cycles:
            writer.writerows([[format(value, ".12g") for value in row] for row in flight.rows.numpy() / sizes])


def load_flight(folder: Path | str) -> Flown:
    """The flight again, its problem made anew.

    Raises:
        FileNotFoundError: a missing file.
        ValueError: another format, a problem outside the package, or one that has changed since.
    """
    folder = Path(folder)
    for name in (DESCRIPTION, ARRAYS):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"no flight in {str(folder)!r}: {str(folder / name)!r} does not exist")
    description = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
    if description.get("format") != FORMAT:
        raise ValueError(f"{folder / DESCRIPTION}: format = {description.get('format')!r}; allowed: {FORMAT}")
    problem = make_problem(description["problem"]["reference"], description["problem"]["arguments"])
    kind, units = KINDS[type(problem)], _units(problem)
    if units != description["units"]:
        raise ValueError(f"{folder / DESCRIPTION}: units = {description['units']}; allowed: {units} of {problem.name}")
    with np.load(folder / ARRAYS, allow_pickle=False) as stream:
        arrays = {name: torch.from_numpy(stream[name]) for name in _arrays(kind)}
    return kind(problem, **arrays, completed=bool(description["completed"]))  # type: ignore[arg-type]
