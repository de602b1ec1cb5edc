"""Runs side by side: one table over configurations, one over members, figures that lay them over each other."""

from __future__ import annotations

import csv
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ponn_torch.reporting.members import Member, extremals, read_members
from ponn_torch.reporting.reference import Reference
from ponn_torch.reporting.report import table
from ponn_torch.reporting.style import unit
from ponn_torch.solving.solution import Solution

COMPARISON, TABLE, MEMBERS = "comparison.md", "comparison.csv", "members.csv"
Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Members that solve one problem, grouped by their settings.

    Attributes:
        groups: label → members that differ by their seed only.
        shared: settings that all members have. reference: None where none was given.
    """

    problem: str
    groups: Mapping[str, Sequence[Member]]
    shared: Mapping[str, str]
    reference: Reference | None = None

    @property
    def members(self) -> list[Member]:
        return [member for group in self.groups.values() for member in group]

    @cached_property
    def extremals(self) -> dict[Path, str]:
        return extremals(self.members)

    @cached_property
    def smoothed(self) -> bool:
        """Some member ended at a smoothing, so that it solved another problem than the one stated."""
        return any(member.smoothing > 0 for member in self.members)

    @cached_property
    def errors(self) -> dict[Path, dict[str, float]]:
        """Errors of states and costates of every solution, in the problem's units."""
        if self.reference is None:
            return {}
        pairs = ((member.folder, member.solution) for member in self.members)
        return {folder: self.reference.errors(solution.curve) for folder, solution in pairs if solution is not None}

    @cached_property
    def a_solution(self) -> Solution | None:
        solutions = (member.solution for member in self.members)
        return next((solution for solution in solutions if solution is not None), None)

    @property
    def cost_unit(self) -> tuple[str, float]:
        """Name of the cost with its unit, and the unit's size."""
        if self.a_solution is None:
            return "cost", 1.0
        shown = unit(self.a_solution.problem, "cost")
        name = self.a_solution.problem.cost_name
        return (f"{name} [{shown.label}]" if shown.label else name), shown.size

    def member_row(self, label: str, member: Member) -> Row:
        """What one run found."""
        name, size = self.cost_unit
        known = member.outcome.get("known_cost")
        row: Row = {
            "problem": self.problem,
            "settings": label,
            "seed": member.seed,
            "member": member.folder.name,
            "certified": member.certified,
            "extremal": self.extremals.get(member.folder, "–"),
        }
        if self.smoothed:
            row["smoothing ρ"] = member.smoothing
        row |= {
            name: member.cost / size,
            "cost − known": math.nan if known is None else (member.cost - known) / size,
            "‖r‖": member.norm,
            "off nodes": member.off_node_residual,
            "flown end error": member.end_error,
        }
        if self.reference is not None:
            errors = self.errors.get(member.folder, {})
            row |= {f"error of {part}": errors.get(part, math.nan) for part in ("states", "costates")}
        row |= {
            "unknowns": math.nan if member.solution is None else member.solution.curve.xi.numel(),
            "iterations": member.total("n_iterations"),
            "residuals": member.total("n_residuals"),
            "derivatives": member.total("n_linearisations"),
            "CPU s": member.total("cpu_seconds"),
            "result": member.outcome["message"],
        }
        return row

    def member_rows(self) -> list[Row]:
        return [self.member_row(label, member) for label, group in self.groups.items() for member in group]

    def rows(self) -> list[Row]:
        """One row per configuration: median [min, max] over its runs."""
        return [self._row(label, group) for label, group in self.groups.items()]

    def _row(self, label: str, group: Sequence[Member]) -> Row:
        runs = [self.member_row(label, member) for member in group]
        found = Counter(run["extremal"] for run in runs)
        ran = sum(member.ran for member in group)
        failed = f" ({len(group) - ran} failed)" if ran < len(group) else ""
        row: Row = {
            "settings": label,
            "certified": f"{sum(run['certified'] for run in runs)}/{ran}{failed}",
            "extremals": " ".join(f"{letter}:{count}" for letter, count in sorted(found.items())),
        }
        whole = ("unknowns", "iterations", "residuals", "derivatives")
        forms = {self.cost_unit[0]: ".8g", "smoothing ρ": ".3g"}
        left_out = {"problem", "settings", "seed", "member", "certified", "extremal", "result"}
        for name in (name for name in runs[0] if name not in left_out):
            digits = ".0f" if name in whole else forms.get(name, ".2g")
            row[name] = spread((run[name] for run in runs), digits)
        return row

    def failures(self) -> list[str]:
        """A line per run that ended in an error or without a solution."""
        return [
            f"{label}, seed {member.seed}: {member.outcome['message']}"
            for label, group in self.groups.items()
            for member in group
            if not member.ran or not member.stages
        ]


def spread(values: Iterable[float], form: str = ".2g") -> str:
    """``median [min, max]`` of what is finite, one number where they agree, and how many are not finite."""
    given = list(values)
    finite = [value for value in given if math.isfinite(value)]
    if not finite:
        return "–"
    low, middle, high = (format(v, form) for v in (min(finite), statistics.median(finite), max(finite)))
    missing = f" ({len(given) - len(finite)} missing)" if len(finite) < len(given) else ""
    return (middle if low == high else f"{middle} [{low}, {high}]") + missing


# -- grouping ------------------------------------------------------------------------------------------------


def compare(folder: Path, reference: Solution | None = None) -> list[Comparison]:
    """Read every run under a folder and group them by problem and settings.

    Raises:
        FileNotFoundError: no run is there.
    """
    members = read_members(folder)
    keys = list(dict.fromkeys(key for member in members for key in member.settings if key != "seed"))
    first = members[0].settings
    shared = {key: first[key] for key in keys if all(m.settings.get(key) == first.get(key) for m in members)}
    varied = [key for key in keys if key not in shared and key != "problem"]
    problems: dict[str, dict[str, list[Member]]] = {}
    for member in members:
        label = " ".join(f"{_short(key)}={member.settings[key]}" for key in varied if key in member.settings)
        groups = problems.setdefault(_problem(member), {})
        groups.setdefault(label or "defaults", []).append(member)
    return [Comparison(problem, groups, shared, _matching(reference, groups)) for problem, groups in problems.items()]


def _problem(member: Member) -> str:
    chosen = member.settings.get("problem") or member.settings.get("experiment") or "earth_mars"
    return chosen.rpartition(":")[2]


def _short(key: str) -> str:
    """The last words of a dotted key say enough."""
    return key.rpartition(".")[2]


def _matching(reference: Solution | None, groups: Mapping[str, Sequence[Member]]) -> Reference | None:
    """The reference, for members that solve its problem."""
    if reference is None:
        return None
    solutions = (member.solution for group in groups.values() for member in group)
    states = next((solution.problem.states for solution in solutions if solution is not None), None)
    return Reference(reference) if states == reference.problem.states else None


# -- files ---------------------------------------------------------------------------------------------------


def write_comparison(comparisons: Sequence[Comparison], folder: Path, figures: Mapping[str, Path]) -> str:
    """Write the tables into an existing folder; the text of comparison.md. ``figures``: caption → file."""
    lines: list[str] = ["# Comparison"]
    for comparison in comparisons:
        lines.append(f"## {comparison.problem}")
        if comparison.shared:
            lines.append("All: `" + " ".join(f"{key}={value}" for key, value in comparison.shared.items()) + "`")
        rows = comparison.rows()
        lines.append(table(list(rows[0]), [[str(value) for value in row.values()] for row in rows]))
        failures = comparison.failures()
        lines += ["\n".join(f"- {line}" for line in failures)] if failures else []
    lines.append(
        "Median [min, max] over the seeds. Extremals: the same letter for the same cost and initial costates, A the "
        "cheapest, – where no residual was solved. Failed: bad input, an error or an interruption. ‖r‖, off nodes "
        "and errors are scaled; CPU s without certificates."
    )
    if any(comparison.smoothed for comparison in comparisons):
        lines.append(
            "Smoothing ρ: that of the solution which is kept, 0 without. Every ρ makes a problem of its own: where "
            "runs differ in it, letters begin anew at each, and their costs say nothing of which run is better."
        )
    lines += [f"![{caption}]({path.name})" for caption, path in figures.items()]
    text = "\n\n".join(lines) + "\n"
    (folder / COMPARISON).write_text(text, encoding="utf-8")
    _write_csv(folder / TABLE, [{"problem": c.problem} | row for c in comparisons for row in c.rows()])
    _write_csv(folder / MEMBERS, [row for c in comparisons for row in c.member_rows()])
    return text


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        header = list(dict.fromkeys(key for row in rows for key in row))
        writer = csv.DictWriter(stream, header, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
