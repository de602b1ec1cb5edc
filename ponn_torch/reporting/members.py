"""The runs under a folder, read back: how each was set, what it recorded, what it found."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from ponn_torch.reporting.records import RECORDS
from ponn_torch.reporting.report import CERTIFICATE
from ponn_torch.solving.certificate import Certificate
from ponn_torch.solving.solution import SOLUTION, Solution

OUTCOME = "outcome.json"
BESIDES = ("record", "hydra", "threads")  # settings that change nothing of what is computed
SOLVED = 0.1  # ‖r‖ of the last stage above which a run has not found an extremal


@dataclass(frozen=True, eq=False)
class Member:
    """One run folder.

    Attributes:
        settings: the overrides of its command line, but those of recording. outcome: as outcome.json says it.
        iterations: records of all stages in turn; ``seconds``, ``residuals`` and ``linearisations`` count on.
        stages: records of the stages.
    """

    folder: Path
    settings: dict[str, str]
    outcome: Mapping[str, Any]
    iterations: list[dict[str, Any]] = field(repr=False)
    stages: list[dict[str, Any]] = field(repr=False)
    certificate: Certificate | None = field(repr=False)

    @property
    def seed(self) -> str:
        return self.settings.get("seed", "0")

    @cached_property
    def solution(self) -> Solution | None:
        """None where there is none, or where its problem cannot be made again."""
        try:
            return Solution.load(self.folder / SOLUTION)
        except (OSError, ValueError):
            return None

    @property
    def smoothing(self) -> float:
        """ρ of the solution that is kept, 0 where none is in force, NaN without a solution."""
        if self.solution is None:
            return math.nan
        return self.solution.smoothing or 0.0

    @property
    def ran(self) -> bool:
        """It ended by itself, certified or not: no bad input, no error, no interruption."""
        return self.outcome["exit_code"] in (0, 2)

    @property
    def certified(self) -> bool:
        return bool(self.outcome["certified"])

    @property
    def norm(self) -> float:
        """‖r‖ of the solution that is kept: that of the last stage, of the last start."""
        return _number(self.stages[-1]["norm"]) if self.stages else math.nan

    @property
    def solved(self) -> bool:
        """The last stage ended near a zero of its residual."""
        return self.certified or self.norm < SOLVED

    @property
    def cost(self) -> float:
        return _number(self.outcome["cost"])

    @property
    def off_node_residual(self) -> float:
        found = [_number(stage["off_node_residual"]) for stage in self.stages]
        if self.certificate is not None:
            return self.certificate.off_node_residual
        return found[-1] if found else math.nan

    @property
    def end_error(self) -> float:
        """The worse of both flights, scaled."""
        if self.certificate is None:
            return math.nan
        return max(self.certificate.end_error_scaled, self.certificate.control_end_error_scaled)

    def total(self, name: str) -> float:
        """A count or time over all stages."""
        return sum(_number(stage[name]) for stage in self.stages)


def read_members(folder: Path) -> list[Member]:
    """Every run under a folder, in the order of their names.

    Raises:
        FileNotFoundError: none is there.
    """
    found = sorted(folder.rglob(OUTCOME), key=lambda path: natural(str(path.parent)))
    if not found:
        raise FileNotFoundError(f"no run under {str(folder)!r}: no {OUTCOME} in it")
    return [_read(path.parent) for path in found]


def natural(name: str) -> list[tuple[int, str]]:
    """A key to sort by in which 10 comes after 9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _read(folder: Path) -> Member:
    outcome = json.loads((folder / OUTCOME).read_text(encoding="utf-8"))
    pairs = (text.partition("=") for text in outcome["overrides"])
    given = {key.lstrip("+~"): value.strip("'\"") for key, _, value in pairs}
    settings = {key: value for key, value in given.items() if key.split(".")[0] not in BESIDES}
    events = list(_events(folder / RECORDS))
    iterations = [event for event in events if event["event"] == "iteration"]
    stages = [event for event in events if event["event"] == "stage"]
    path = folder / CERTIFICATE
    judged = None
    if path.is_file():
        judged = Certificate.from_dict(json.loads(path.read_text(encoding="utf-8")))
    return Member(folder, settings, outcome, _counted_on(iterations), stages, judged)


def _events(path: Path) -> Iterator[dict[str, Any]]:
    """Lines of records.jsonl; a last one that was cut off is left out."""
    if not path.is_file():
        return
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            return


def _counted_on(iterations: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Stages count from zero; here the counts go on from one to the next."""
    names = ("seconds", "residuals", "linearisations")
    before: dict[str, float] = dict.fromkeys(names, 0.0)
    out: list[dict[str, Any]] = []
    for record in iterations:
        if record["iteration"] == 1 and out:
            before = {name: float(out[-1][name]) for name in names}
        out.append(record | {name: before[name] + _number(record[name]) for name in names})
    return out


def _number(value: Any) -> float:
    """JSON knows no NaN: records say null."""
    return math.nan if value is None else float(value)


# -- extremals -----------------------------------------------------------------------------------------------


def extremals(members: Sequence[Member], cost: float = 1e-3, costates: float = 1e-2) -> dict[Path, str]:
    """A letter for every member that found an extremal, the same for the same one, A for the cheapest.

    Two are the same if costs agree to ``cost``, relative, and initial costates to ``costates`` of the largest one.
    Every ρ makes a problem of its own: where members differ in it, letters begin anew at each, and say at which.
    """
    found = [member for member in members if member.solved and math.isfinite(member.cost)]
    alike: dict[str, list[Member]] = {}
    for member in sorted(found, key=lambda member: member.cost):
        alike.setdefault(_at(member.smoothing), []).append(member)
    return {
        folder: letter + (at if len(alike) > 1 else "")
        for at, group in alike.items()
        for folder, letter in _letters(group, cost, costates).items()
    }


def _at(smoothing: float) -> str:
    """What tells the extremals of one ρ from those of another."""
    if math.isnan(smoothing):
        return " (ρ unknown)"
    return f" (ρ {smoothing:.3g})" if smoothing else ""


def _letters(members: Sequence[Member], cost: float, costates: float) -> dict[Path, str]:
    """Letters of members of one ρ, the cheapest first."""
    leaders: list[tuple[float, torch.Tensor | None]] = []
    out = {}
    for member in members:
        start = None
        if member.solution is not None:
            start = member.solution.curve.knots[0][member.solution.bvp.n_states :].double().cpu()
        for index, (known_cost, known_start) in enumerate(leaders):
            near = abs(member.cost - known_cost) <= cost * abs(known_cost)
            if near and start is not None and known_start is not None:
                near = float((start - known_start).abs().max()) <= costates * float(known_start.abs().max())
            if near:
                out[member.folder] = _letter(index)
                break
        else:
            out[member.folder] = _letter(len(leaders))
            leaders.append((member.cost, start))
    return out


def _letter(index: int) -> str:
    return chr(ord("A") + index) if index < 26 else f"#{index + 1}"
