"""Which way down in ρ: schedules from the same random starts to the split, what they cost and how often they fail."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from experiments.plots import histories
from experiments.solves import PROBLEMS
from experiments.tables import Report, markdown, run_study, share, spread
from ponn_torch.solving.continuation import Adaptive, Ladder, Schedule, Single, log_ladder
from ponn_torch.solving.solver import Solver

FOLDER = Path(__file__).parent
SCHEDULES: dict[str, Schedule] = {
    "1, 0.3, 0.1, 0.03": Ladder((1.0, 0.3, 0.1, 0.03)),
    "1, 0.1": Ladder((1.0, 0.1)),
    "1": Single(1.0),
    "0.1": Single(0.1),
    "adaptive to 0.01": Adaptive(1.0, 1e-2),
    "ten, to 0.01": log_ladder(1.0, 1e-2, 10),
    "twenty, to 1e-10": log_ladder(),
}


def run(name: str, seeds: Sequence[int], seconds: float, write: bool) -> Report:
    problem = PROBLEMS[name]()
    rows: list[dict[str, Any]] = []
    groups: dict[str, list[tuple[list[float], list[float]]]] = {}
    for label, schedule in SCHEDULES.items():
        for seed in seeds:
            result = Solver(continuation=schedule, cpu_seconds=seconds).solve(problem, seed)
            smoothed = [stage for stage in result.stages if stage.name == "smooth"]
            rows.append(
                {
                    "schedule": label,
                    "seed": seed,
                    "certified": result.certified,
                    "fuel_error_kg": result.solution.cost - problem.known_cost if result.certified else float("nan"),
                    "starts": result.n_starts,
                    "smoothed_stages": len(smoothed),
                    "smoothed_iterations": sum(stage.n_iterations for stage in smoothed),
                    "rounds": len(result.stages) - len(smoothed),
                    "residuals": sum(stage.n_residuals for stage in result.stages),
                    "cpu_s": result.cpu_seconds,
                    "message": result.message,
                }
            )
            if smoothed:
                steps, total = [], 0.0
                for stage in smoothed:
                    total += stage.cpu_seconds
                    steps.append((total, stage.off_node_residual))
                groups.setdefault(label, []).append(([t for t, _ in steps], [r for _, r in steps]))
        print(f"{name}: {label} done", flush=True)
    if write:
        across, up = "CPU time (s)", "residual between the nodes at stage ends"
        histories(groups, FOLDER / "results" / f"{name}.png", across, up)
    return Report({name: rows}, _summary(name, rows, seconds), _measured(name, rows))


def _summary(name: str, rows: Sequence[Mapping[str, Any]], seconds: float) -> str:
    lines = []
    for label in SCHEDULES:
        mine = [row for row in rows if row["schedule"] == label]
        lines.append(
            {
                "values of ρ": label,
                "certified": share(row["certified"] for row in mine),
                "fuel − optimum, kg": spread((row["fuel_error_kg"] for row in mine), "+.1e"),
                "starts": spread((row["starts"] for row in mine), ".0f"),
                "smoothed iterations": spread((row["smoothed_iterations"] for row in mine), ".0f"),
                "rounds of the split": spread((row["rounds"] for row in mine), ".0f"),
                "residuals": spread((row["residuals"] for row in mine), ".0f"),
                "CPU s": spread((row["cpu_s"] for row in mine), ".2f"),
            }
        )
    told = f"{len({row['seed'] for row in rows})} seeds, at most {seconds:g} CPU s each; median [min, max]."
    return f"{told}\n\n{markdown(lines)}\n\n![{name}](results/{name}.png)"


def _measured(name: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    def certified(label: str) -> float:
        mine = [row["certified"] for row in rows if row["schedule"] == label]
        return sum(mine) / max(1, len(mine))

    default = "1, 0.3, 0.1, 0.03"
    errors = [abs(row["fuel_error_kg"]) for row in rows if row["schedule"] == default and row["certified"]]
    return {
        f"{name}/default certified share": certified(default),
        f"{name}/default fuel error kg": max(errors, default=9.9),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PROBLEMS, default=list(PROBLEMS), help="default: all of them")
    parser.add_argument("--seeds", type=int, default=5, help="seeds 0 … SEEDS − 1 (default 5)")
    parser.add_argument("--seconds", type=float, default=10.0, help="CPU seconds a solve at most (default 10)")
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    given = parser.parse_args()
    torch.set_num_threads(1)
    parts = {name: partial(run, name, range(given.seeds), given.seconds, not given.check_only) for name in given.parts}
    return run_study(FOLDER, parts, check_only=given.check_only)


if __name__ == "__main__":
    sys.exit(main())
