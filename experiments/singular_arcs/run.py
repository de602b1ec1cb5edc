"""Optima with singular arcs: found from random starts, certified, and held against direct collocation."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from experiments.singular_arcs.problems import (
    catalyst_mixing,
    jacobson,
    pair,
    regulator,
    steep_path,
    van_der_pol,
)
from experiments.tables import Report, markdown, run_seeded, share, spread, worst
from ponn_torch.baselines.direct import Unstructured
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.free_flying_robot import free_flying_robot
from ponn_torch.problems.goddard import goddard
from ponn_torch.solving.restart import Restart
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver

FOLDER = Path(__file__).parent
Make = Callable[[], OptimalControlProblem]

PARTS: dict[str, dict[str, Make]] = {
    "exact": {"regulator": regulator, "pair": pair},
    "literature": {
        "goddard": goddard,
        "goddard, thrust 2.5": partial(goddard, maximum_thrust=2.5),
        "catalyst_mixing": catalyst_mixing,
        "catalyst_mixing, length 4": partial(catalyst_mixing, final_time=4.0),
        "van_der_pol": van_der_pol,
        "jacobson": jacobson,
        "steep_path": steep_path,
        "free_flying_robot": free_flying_robot,
    },
}


def collocated(solution: Solution) -> float:
    """Cost by direct collocation on 200 even segments, which knows no arcs; begun on the solution's path."""
    return Unstructured(200, guess=Restart(solution), softening=0.0).solve(solution.problem).cost


def study(part: str, problems: Mapping[str, Make], seeds: range) -> Report:
    rows, table, measured = list[dict[str, Any]](), list[dict[str, str]](), dict[str, float]()
    for name, make in problems.items():
        problem, mine, best = make(), list[dict[str, Any]](), None
        for seed in seeds:
            result = Solver().solve(problem, seed)
            solution, certificate = result.solution, result.certificate
            mine.append(
                {
                    "problem": name,
                    "seed": seed,
                    "certified": result.certified,
                    "starts": result.n_starts,
                    "arcs": "-".join(solution.arcs) if solution else "",
                    "switch_times": " ".join(f"{t:.12g}" for t in solution.switch_times) if solution else "",
                    "cost": solution.cost if solution else math.nan,
                    "end_error": certificate.end_error_scaled if certificate else math.nan,
                    "off_node_residual": solution.off_node_residual if solution else math.nan,
                    "cpu_s": result.cpu_seconds,
                    "message": result.message,
                }
            )
            print(f"{name} {seed}: {mine[-1]['cost']:.12g}, {result.cpu_seconds:.2f} s, {result.message}", flush=True)
            if result.certified and solution and (best is None or solution.cost < best.cost):
                best = solution
        rows += mine
        good = [row for row in mine if row["certified"]]
        direct, cost = (collocated(best), best.cost) if best else (math.nan, math.nan)
        apart = max((row["cost"] for row in good), default=math.nan) - cost
        exact = problem.known_cost if part == "exact" and problem.known_cost is not None else math.nan
        line = {
            "problem": name,
            "certified": share(row["certified"] for row in mine),
            "arcs": f"{len(best.arcs)}, {sum('singular' in arc for arc in best.arcs)} singular" if best else "",
            "cost": f"{cost:.11g}",
            "seeds apart by": f"{apart:.0e}",
            "direct collocation − cost": f"{direct - cost:+.0e}",
            "flown end": f"{worst(row['end_error'] for row in mine):.0e}",
            "starts": spread((row["starts"] for row in mine), ".0f"),
            "CPU s": spread((row["cpu_s"] for row in mine), ".2f"),
        }
        measured |= {
            f"{part}/{name}: certified share": len(good) / len(mine),
            f"{part}/{name}: seeds apart by": apart,
            f"{part}/{name}: direct collocation off by": abs(direct - cost),
        }
        if part == "exact":
            line["cost − exact"] = f"{cost - exact:+.0e}"
            measured[f"{part}/{name}: cost off by"] = abs(cost - exact)
        table.append(line)
    text = f"Seeds {seeds[0]}–{seeds[-1]}; median [min, max].\n\n{markdown(table)}"
    return Report({part: rows}, text, measured)


def main() -> int:
    parts = {name: partial(study, name, problems) for name, problems in PARTS.items()}
    return run_seeded(FOLDER, parts, __doc__, seeds=5)


if __name__ == "__main__":
    sys.exit(main())
