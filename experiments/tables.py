"""What the studies share: spreads, tables, results written and pasted, checks against expected.json."""

from __future__ import annotations

import argparse
import csv
import json
import math
import re
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ponn_torch.reporting.report import environment

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Report:
    """What a part of a study leaves: rows of runs by table name, a summary in Markdown, numbers to check."""

    tables: Mapping[str, Sequence[Row]]
    summary: str
    measured: Mapping[str, float] = field(default_factory=dict)


# -- text ----------------------------------------------------------------------------------------------------


def spread(values: Iterable[float], form: str = ".2g") -> str:
    """``median [min, max]`` of what is finite, and how many are not."""
    given = list(values)
    finite = [v for v in given if math.isfinite(v)]
    if not finite:
        return "–"
    low, middle, high = (format(v, form) for v in (min(finite), statistics.median(finite), max(finite)))
    missing = f" ({len(given) - len(finite)} missing)" if len(finite) < len(given) else ""
    return f"{middle} [{low}, {high}]{missing}"


def share(flags: Iterable[bool]) -> str:
    """``18/20``."""
    given = list(flags)
    return f"{sum(given)}/{len(given)}"


def worst(values: Iterable[float]) -> float:
    """Largest |value|; NaN as soon as one is."""
    sizes = [abs(v) for v in values]
    return math.nan if any(math.isnan(v) for v in sizes) else max(sizes)


def markdown(rows: Sequence[Row]) -> str:
    """A table whose columns are the keys of the rows."""
    header = list(rows[0])
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(str(row.get(key, "")) for key in header) + " |" for row in rows]
    return "\n".join(lines)


def environment_line() -> str:
    """Versions, platform and threads that a table was made with."""
    e = environment()
    return (
        f"ponn-torch {e['ponn_torch']} at {e['commit']}, Python {e['python']}, torch {e['torch']}, "
        f"SciPy {e['scipy']}, {e['platform']}, {e['torch_threads']} thread(s); times are CPU seconds"
    )


# -- files ---------------------------------------------------------------------------------------------------


def write(folder: Path, name: str, report: Report) -> None:
    """results/<table>.csv for every table, results/<name>.md, and the summary pasted into the README."""
    results = folder / "results"
    results.mkdir(exist_ok=True)
    for table, rows in report.tables.items():
        with (results / f"{table}.csv").open("w", newline="", encoding="utf-8") as stream:
            header = list(dict.fromkeys(key for row in rows for key in row))
            writer = csv.DictWriter(stream, header, lineterminator="\n")
            writer.writeheader()
            writer.writerows({k: _cell(v) for k, v in row.items()} for row in rows)
    text = f"{report.summary}\n\n*{environment_line()}*\n"
    (results / f"{name}.md").write_text(text, encoding="utf-8")
    _paste(folder / "README.md", name, text)


def _cell(value: Any) -> Any:
    return format(value, ".13g") if isinstance(value, float) else value


def _paste(readme: Path, name: str, text: str) -> None:
    """Replace what stands between ``<!-- name -->`` and ``<!-- /name -->``."""
    old = readme.read_text(encoding="utf-8")
    pattern = re.compile(f"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    if not pattern.search(old):
        raise ValueError(f"{readme.name} has no place for {name!r}: <!-- {name} --> … <!-- /{name} -->")
    readme.write_text(pattern.sub(lambda found: f"{found[1]}{text}{found[2]}", old), encoding="utf-8")


def run_study(folder: Path, parts: Mapping[str, Callable[[], Report]], *, check_only: bool) -> int:
    """Run the parts in turn, print and write what they find, hold it against expected.json; the exit code."""
    measured: dict[str, float] = {}
    for name, part in parts.items():
        report = part()
        print(f"\n{report.summary}\n", flush=True)
        measured |= report.measured
        if not check_only:
            write(folder, name, report)
    return 0 if check(folder, list(parts), measured) else 1


def run_seeded(
    folder: Path, parts: Mapping[str, Callable[[range], Report]], description: str | None, seeds: int
) -> int:
    """A study's command line: which parts, how many seeds, whether results are written; the exit code."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts), help="default: all of them")
    parser.add_argument("--seeds", type=int, default=seeds, help=f"seeds 0 … SEEDS − 1 (default {seeds})")
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    given = parser.parse_args()
    if given.seeds < 1:
        parser.error(f"--seeds {given.seeds}; allowed: at least 1")
    torch.set_num_threads(1)
    chosen = {name: partial(parts[name], range(given.seeds)) for name in given.parts}
    return run_study(folder, chosen, check_only=given.check_only)


# -- checks --------------------------------------------------------------------------------------------------

RULES = {
    "at_most": lambda value, limit: value <= limit,
    "at_least": lambda value, limit: value >= limit,
}


def check(folder: Path, parts: Sequence[str], measured: Mapping[str, float]) -> bool:
    """Print PASS or FAIL for every line of expected.json that belongs to the parts; True if all passed.

    A line is ``"part/what": {"at_most" or "at_least": limit}``; what was not measured, or is NaN, fails.
    """
    passed = True
    for key, rule in json.loads((folder / "expected.json").read_text(encoding="utf-8")).items():
        if key.split("/")[0] not in parts:
            continue
        value = measured.get(key, math.nan)
        ((name, limit),) = rule.items()
        good = RULES[name](value, limit)
        passed = passed and good
        print(f"{'PASS' if good else 'FAIL'}  {key} = {value:.4g} ({name.replace('_', ' ')} {limit:g})")
    return passed
