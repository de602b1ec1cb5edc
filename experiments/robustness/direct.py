"""What an independent method finds where the default solver certified nothing: structure, fuel, switch times.

Cases are read from results/*.csv: those without a certified solution that no minimum time explains, and those named
on the command line. ``TwoStage`` solves them by direct collocation; the split then starts from its answer.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import torch

from experiments.tables import Report, markdown, run_study, share
from ponn_torch.baselines.direct import TwoStage, Unstructured
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.earth_mars import earth_mars
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.certificate import certify
from ponn_torch.solving.paths import PolarTransfer
from ponn_torch.solving.solution import Solution

FOLDER = Path(__file__).parent
OPEN = ("landings:228", "transfers:9", "transfers:17", "transfers:71", "transfers:79", "transfers:87")


def _landing(row: dict[str, str]) -> OptimalControlProblem:
    return mars_landing(
        initial_position=[float(row[name]) for name in ("x", "y", "z")],
        initial_velocity=[float(row[name]) for name in ("vx", "vy", "vz")],
        free_final_time=True,
        final_time=45.0,
        mass_flow_per_thrust=5.0863e-4,
    )


def _transfer(row: dict[str, str]) -> OptimalControlProblem:
    return earth_mars(
        final_time_days=float(row["final_time_days"]),
        maximum_thrust=float(row["maximum_thrust"]),
    )


KINDS: dict[str, tuple[Callable[[dict[str, str]], OptimalControlProblem], TwoStage]] = {
    "landings": (_landing, TwoStage()),
    "transfers": (_transfer, TwoStage(Unstructured(150, guess=PolarTransfer()), n_segments=20)),
}


def _cases(named: Iterable[str]) -> list[tuple[str, dict[str, str]]]:
    found = []
    for kind in KINDS:
        with (FOLDER / "results" / f"{kind}.csv").open(encoding="utf-8") as stream:
            for row in csv.DictReader(stream):
                unexplained = row["certified"] != "True" and "infeasible" not in row["message"]
                if unexplained or f"{kind}:{row['case']}" in named:
                    found.append((kind, row))
    return found


def direct(named: Iterable[str]) -> Report:
    rows: list[dict[str, Any]] = []
    for kind, given in _cases(named):
        make, method = KINDS[kind]
        problem = make(given)
        answer, time = method.solve(problem), problem.display["time"]
        refined = answer.refined() if answer.solved else None
        certificate = certify(Solution(refined.curve)) if refined is not None else None
        row = {
            "case": f"{kind} {given['case']}",
            "solved": answer.solved,
            "arcs": "-".join(answer.arcs),
            "switch times": " ".join(f"{t / time.size:.6f}" for t in answer.switch_times),
            "final time": answer.final_time / time.size,
            "fuel, kg": answer.cost,
            "CPU s": answer.cpu_seconds,
            "build s": answer.build_seconds,
            "split from there": "–" if certificate is None else certificate.verdict.split(":")[0],
            "split's fuel, kg": float("nan") if certificate is None else certificate.cost,
            "fuel of the study, kg": float(given["fuel_kg"]) if given["certified"] == "True" else float("nan"),
        }
        print(row, flush=True)
        rows.append(row)
    shown = [
        {key: format(value, ".7f") if "fuel" in key else value for key, value in row.items() if key in _SHOWN}
        for row in rows
    ]
    certified = [row["split from there"].startswith("certified") for row in rows]
    summary = f"{markdown(shown)}\n\nCertified from there: {share(certified)}"
    return Report({"direct": rows}, summary, {"direct/solved share": sum(row["solved"] for row in rows) / len(rows)})


_SHOWN = ("case", "arcs", "switch times", "fuel, kg", "split's fuel, kg")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="*", default=OPEN, help="besides the open ones, e.g. transfers:9 landings:228")
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    return run_study(FOLDER, {"direct": partial(direct, arguments.cases)}, check_only=arguments.check_only)


if __name__ == "__main__":
    sys.exit(main())
