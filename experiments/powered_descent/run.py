"""Landers that replan the fuel-optimal descent every second: who lands, and what the thrust margin costs."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from experiments.tables import Report, markdown, run_study, share, spread
from ponn_torch.guidance.descent import Landing, Replanning, dispersed, land
from ponn_torch.guidance.plants.powered_descent import powered_descent
from ponn_torch.guidance.touchdown import Limits
from ponn_torch.guidance.touchdown import landed as within
from ponn_torch.solving.solver import Solver

FOLDER = Path(__file__).parent
STARTS: dict[str, dict[str, Any]] = {
    "min-max (TFC test 1)": {},
    "max-min-max (TFC test 2)": {
        "initial_position": (-200.0, 100.0, 1500.0),
        "initial_velocity": (85.0, 50.0, -65.0),
    },
}
MARGINS = (1.0, 0.98, 0.95)


def _flown(start: str, margin: float, count: int) -> tuple[Landing, float, float]:
    """(flights, fuel of the undisturbed optimum with full thrust, and with the margin)."""
    descent, how = powered_descent(**STARTS[start], planned_share=margin), Replanning()
    best, planned = (Solver().solve(problem, 0) for problem in (descent.lander, descent.planned))
    assert best.certified
    assert planned.certified
    states, factors = dispersed(descent, how, count, torch.Generator().manual_seed(0))
    noise = torch.Generator().manual_seed(1)
    flown = land(descent, planned.solution, states, factors, how=how, generator=noise, clock=time.process_time)
    return flown, best.solution.cost, planned.solution.cost


def descents(count: int, margins: Sequence[float]) -> Report:
    rows, lines, measured = [], [], {}
    for start in STARTS:
        for margin in margins:
            flown, best, planned = _flown(start, margin, count)
            landed = within(flown, Limits())
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
                    "CPU ms per plan": f"{1e3 * float(flown.seconds.sum()) / n_plans:.1f}",
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
