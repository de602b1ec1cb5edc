"""Earth to Venus in 1000 days: what each number of revolutions of the guess leads to, and what thrust it needs."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from experiments.earth_venus.direct import least_thrust
from experiments.solves import row
from experiments.tables import Report, markdown, run_study
from ponn_torch.ansatz.basis import Legendre
from ponn_torch.problems.earth_mars import EARTH_VENUS, earth_mars
from ponn_torch.solving.feasibility import check_control
from ponn_torch.solving.paths import PolarTransfer
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver

FOLDER = Path(__file__).parent
KNOWN_KG = {2: 463.66754, 3: 209.42204516, 4: 240.30443}  # by extra revolutions of the guess
DIRECT_STARTS = 3
REVOLUTIONS = (1, 2, 3, 4, 5, 6, 7)


def solver(revolutions: int) -> Solver:
    """What ``experiment=earth_venus`` says; more segments where they would span more than a third of a revolution."""
    return Solver(
        basis=Legendre(14),
        conditioning="orthonormal",
        n_nodes=20,
        n_segments=max(12, 3 * revolutions),
        guess=PolarTransfer(revolutions=revolutions),
    )


def turns(solution: Solution) -> float:
    """Revolutions about the Sun that the solution flies."""
    r = solution.sample(400).states["r"]
    steps = torch.atan2(r[1:, 1], r[1:, 0]) - torch.atan2(r[:-1, 1], r[:-1, 0])
    return float(torch.remainder(steps + math.pi, 2 * math.pi).sub(math.pi).sum()) / (2 * math.pi)


def transfers(revolutions: Sequence[int]) -> Report:
    problem, rows, lines = earth_mars(**EARTH_VENUS, name="earth_venus"), [], []
    for extra in revolutions:
        result = solver(extra).solve(problem)
        found: dict[str, Any] = {"extra_revolutions": extra, **row(problem, 0, result)}
        solution, known = result.solution, KNOWN_KG.get(extra)
        found["revolutions"] = turns(solution) if solution is not None else math.nan
        found["switches"] = len(solution.switch_times) if solution is not None else 0
        control = check_control(problem, solver(extra))
        found["needs_N"] = math.nan if control is None or control.needed is None else control.needed
        found["needs_cpu_s"] = math.nan if control is None else control.cpu_seconds
        direct = [thrust for seed in range(DIRECT_STARTS) if (thrust := least_thrust(extra, seed)) is not None]
        found["needs_directly_N"] = min(direct, default=math.nan)
        rows.append(found)
        print(f"{extra}: {found['fuel_kg']:.8f} kg, {found['cpu_s']:.2f} s, {result.message}", flush=True)
        needs = {
            "extra revolutions": extra,
            "needs, N": "" if math.isnan(found["needs_N"]) else f"{found['needs_N']:.6f}",
            "direct collocation, N": f"{found['needs_directly_N']:.6f} ({len(direct)}/{DIRECT_STARTS})",
        }
        if result.certificate is None or not result.certified:
            verdict = "infeasible" if control is not None and control.infeasible else "no"
            lines.append({**needs, "certified": verdict, "CPU s": f"{found['cpu_s']:.1f}"})
            continue
        lines.append(
            {
                **needs,
                "certified": "yes",
                "revolutions": f"{found['revolutions']:.3f}",
                "switches": found["switches"],
                "first arc": solution.arcs[0] if solution is not None else "",
                "fuel, kg": f"{found['fuel_kg']:.8f}",
                "best known, kg": known or "",
                "end, km": f"{found['end_error_r [km]']:.1e}",
                "H drift": f"{found['hamiltonian_drift']:.1e}",
                "off-node residual": f"{found['off_node_residual']:.1e}",
                "iterations": found["iterations"],
                "CPU s": f"{found['cpu_s']:.1f}",
            }
        )
    measured = {}
    for found in rows:
        key = f"transfers/{found['extra_revolutions']}"
        measured[f"{key} certified"] = float(found["certified"])
        if found["extra_revolutions"] in KNOWN_KG:
            measured[f"{key} fuel − known, kg"] = abs(found["fuel_kg"] - KNOWN_KG[found["extra_revolutions"]])
        measured[f"{key} needs − directly, N"] = abs(found["needs_N"] - found["needs_directly_N"])
    header = max(lines, key=len)
    return Report({"transfers": rows}, markdown([{**dict.fromkeys(header, ""), **line} for line in lines]), measured)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--revolutions", type=int, nargs="+", default=list(REVOLUTIONS))
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    return run_study(FOLDER, {"transfers": partial(transfers, arguments.revolutions)}, check_only=arguments.check_only)


if __name__ == "__main__":
    sys.exit(main())
