"""Random landings and transfers through one solver with one setting: how many are certified, and what the rest are."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments.robustness.asteroids import draw
from experiments.solves import row
from experiments.tables import Report, markdown, run_study, share, spread
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.constants import DAY
from ponn_torch.problems.earth_mars import earth_mars, earth_mars_minimum_time
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.feasibility import check_control, check_final_time
from ponn_torch.solving.paths import PolarTransfer
from ponn_torch.solving.result import SolveResult
from ponn_torch.solving.solver import Solver

FOLDER = Path(__file__).parent
SOLVER = Solver(n_starts=4)


def _row(problem: OptimalControlProblem, index: int, result: SolveResult, data: dict[str, float]) -> dict[str, Any]:
    found = {"case": index, **data, **row(problem, 0, result)}
    solution, time = result.solution, problem.display["time"]
    found["final_time"] = solution.final_time / time.size if solution is not None else float("nan")
    found["switch_times"] = " ".join(f"{t / time.size:.6f}" for t in solution.switch_times) if solution else ""
    print(f"{problem.name} {index}: {found['fuel_kg']:.4f} kg, {found['cpu_s']:.2f} s, {result.message}", flush=True)
    return found


def landings(count: int, seed: int = 0) -> Report:
    """States in ±2 km × ±1 km × 1.2–2.5 km, ±90, ±60, −90…−30 m/s; free final time, guessed as 45 s."""
    generator, rows = np.random.default_rng(seed), []
    r = generator.uniform((-2000, -1000, 1200), (2000, 1000, 2500), (count, 3))
    v = generator.uniform((-90, -60, -90), (90, 60, -30), (count, 3))
    for i in range(count):
        problem = mars_landing(
            initial_position=r[i].tolist(),
            initial_velocity=v[i].tolist(),
            free_final_time=True,
            final_time=45.0,
            mass_flow_per_thrust=5.0863e-4,
        )
        data = dict(zip(("x", "y", "z", "vx", "vy", "vz"), (*r[i], *v[i]), strict=True))
        result = SOLVER.solve(problem, 0)
        found = _row(problem, i, result, data)
        heights = result.solution.sample(400).states["r"][:, 2] if result.solution else torch.tensor([float("nan")])
        found["lowest_m"] = float(heights.min())
        rows.append(found)
    below = sum(found["lowest_m"] < -1e-3 for found in rows)
    return _report("landings", rows, {"dip below ground": str(below)})


def transfers(count: int, seed: int = 0) -> Report:
    """Thirds: tf 308–450 d at 0.5 N; Tmax 0.33–0.7 N at 348.795 d; both at random. Infeasible ones by minimum time."""
    generator, rows = np.random.default_rng(seed), []
    days, newtons = generator.uniform(308, 450, count), generator.uniform(0.33, 0.7, count)
    days[count // 3 : 2 * count // 3], newtons[: count // 3] = 348.795, 0.5
    for i in range(count):
        data = {"final_time_days": float(days[i]), "maximum_thrust": float(newtons[i])}
        problem = earth_mars(**data)
        found = _row(problem, i, SOLVER.solve(problem, 0), data)
        if not found["certified"]:
            fastest = Solver(guess=PolarTransfer()).solve(
                earth_mars_minimum_time(maximum_thrust=data["maximum_thrust"]), 0
            )
            least = fastest.solution.final_time / DAY if fastest.certified and fastest.solution else float("nan")
            found["minimum_time_days"] = least
            if least > data["final_time_days"]:
                found["message"] = f"infeasible: the certified minimum time is {least:.4f} d"
        rows.append(found)
    infeasible = sum("infeasible" in found["message"] for found in rows)
    return _report("transfers", rows, {"infeasible": str(infeasible)})


def asteroids(count: int, seed: int = 0, *, n_certified: int = 1, name: str = "asteroids") -> Report:
    """Rendezvous with random near-Earth orbits by the default solver; infeasible ones by their twins."""
    generator, rows, solver = np.random.default_rng(seed), [], Solver(n_certified=n_certified)
    for i in range(count):
        data, problem = draw(generator)
        found = _row(problem, i, solver.solve(problem, 0), data)
        if not found["certified"]:
            twins = Solver(guess=PolarTransfer((0, 1)), n_starts=4)
            answers = (check(problem, twins) for check in (check_final_time, check_control))
            found["message"] = next((a.message for a in answers if a is not None and a.infeasible), found["message"])
        rows.append(found)
    infeasible = sum("infeasible" in found["message"] for found in rows)
    return _report(name, rows, {"infeasible": str(infeasible)})


cheapest_of_three = partial(asteroids, n_certified=3, name="cheapest_of_three")


def _report(name: str, rows: Sequence[dict[str, Any]], extra: dict[str, str]) -> Report:
    possible = [found for found in rows if "infeasible" not in found["message"]]
    good = [found for found in possible if found["certified"]]
    arcs = Counter(found["arcs"] for found in good)
    line = {
        "cases": str(len(rows)),
        **extra,
        "certified": share(found["certified"] for found in possible),
        "starts": spread((found["starts"] for found in good), ".0f"),
        "fuel, kg": spread((found["fuel_kg"] for found in good), ".2f"),
        "final time": spread((found["final_time"] for found in good), ".2f"),
        "off-node residual": spread((found["off_node_residual"] for found in good), ".1e"),
        "CPU s to the solution": spread((found["cpu_s"] for found in possible), ".2f"),
        "arcs": ", ".join(f"{label} {n}" for label, n in arcs.most_common()),
    }
    rest = [f"- case {f['case']}: {f['message']}" for f in rows if not f["certified"]]
    summary = "\n".join([markdown([{"": key, "value": value} for key, value in line.items()]), "", *rest])
    return Report({name: rows}, summary, {f"{name}/certified share": len(good) / len(possible)})


PARTS = {
    "landings": (landings, 300),
    "transfers": (transfers, 100),
    "asteroids": (asteroids, 30),
    "cheapest_of_three": (cheapest_of_three, 30),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument(
        "--count", type=int, help="cases of every part (default: 300 landings, 100 transfers, 30 rendezvous)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the generator of the cases (default: 0, the tables')")
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    chosen = {name: PARTS[name] for name in arguments.parts}
    parts = {name: partial(run, arguments.count or count, arguments.seed) for name, (run, count) in chosen.items()}
    return run_study(FOLDER, parts, check_only=arguments.check_only)


if __name__ == "__main__":
    sys.exit(main())
