"""Landers that replan the fuel-optimal descent every second: who lands, and what the thrust margin costs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from experiments.tables import Report, markdown, run_study, share, spread
from ponn_torch.guidance.descent import Descents, Disturbances, Replanning, dispersed, land
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.solver import Solver

FOLDER = Path(__file__).parent
FULL_THRUST = 13258.18
TFC = {"mass_flow_per_thrust": 5.0863e-4, "free_final_time": True}
STARTS: dict[str, dict[str, Any]] = {
    "min-max (TFC test 1)": {
        "initial_position": (-900.0, 100.0, 1500.0),
        "initial_velocity": (30.0, -10.0, -70.0),
        **TFC,
    },
    "max-min-max (TFC test 2)": {"initial_velocity": (85.0, 50.0, -65.0), **TFC},
}
MARGINS = (1.0, 0.98, 0.95)
MISS, IMPACT = 1.0, 0.1  # m and m/s within which a landing has succeeded


def _flown(start: str, margin: float, count: int) -> tuple[Descents, float, float]:
    """(flights, fuel of the undisturbed optimum with full thrust, and with the margin)."""
    problem = mars_landing(**STARTS[start])
    best = Solver().solve(problem, 0)
    planned = Solver().solve(mars_landing(**STARTS[start], maximum_thrust=margin * FULL_THRUST), 0)
    assert best.certified
    assert planned.certified
    states, factors = dispersed(problem, Disturbances(), count)
    flown = land(problem, planned.solution, states, factors, how=Replanning(), noise=Disturbances())
    return flown, best.solution.cost, planned.solution.cost


def descents(count: int, margins: Sequence[float]) -> Report:
    rows, lines, measured = [], [], {}
    for start in STARTS:
        for margin in margins:
            flown, best, planned = _flown(start, margin, count)
            landed = (flown.miss < MISS) & (flown.impact < IMPACT)
            for i in range(count):
                rows.append(
                    {
                        "start": start,
                        "margin": margin,
                        "lander": i,
                        "landed": bool(landed[i]),
                        "miss_m": float(flown.miss[i]),
                        "impact_m_s": float(flown.impact[i]),
                        "fuel_kg": float(flown.fuel[i]),
                        "arrival_s": float(flown.arrival[i]),
                        "plans": int(flown.n_plans[i]),
                        "kept": int(flown.n_kept[i]),
                        "repaired": int(flown.n_repaired[i]),
                    }
                )
            n_plans = int((flown.n_plans + flown.n_repaired + flown.n_kept).sum())
            lines.append(
                {
                    "arcs": start,
                    "planned thrust": f"{margin:g} of the maximum",
                    "landed": share(landed.tolist()),
                    "miss, m": spread(flown.miss.tolist()),
                    "impact, m/s": spread(flown.impact.tolist()),
                    "fuel, kg": spread(flown.fuel.tolist(), ".2f"),
                    "planned fuel above the optimum, kg": f"{planned - best:.3f}",
                    "plans (repaired, kept)": f"{n_plans} ({int(flown.n_repaired.sum())}, {int(flown.n_kept.sum())})",
                    "CPU ms per plan": f"{1e3 * flown.plan_seconds / n_plans:.1f}",
                }
            )
            print(lines[-1], flush=True)
            measured[f"descents/{start} {margin:g} landed share"] = float(landed.double().mean())
    return Report({"landers": rows}, markdown(lines), measured)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="landers per row")
    parser.add_argument("--margins", type=float, nargs="+", default=MARGINS, help="planned share of the full thrust")
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    parts = {"descents": partial(descents, arguments.count, arguments.margins)}
    return run_study(FOLDER, parts, check_only=arguments.check_only)


if __name__ == "__main__":
    sys.exit(main())
