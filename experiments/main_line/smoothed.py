"""Smoothed problems, solved to the end as problems of their own, against known fuels and shooting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.main_line.shooting import SHOOTING
from experiments.solves import PROBLEMS, row
from experiments.tables import Report, markdown, share, spread, worst
from ponn_torch.solving.continuation import Ladder
from ponn_torch.solving.refinement import Subdivide
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver

# fuel in kg by smoothing: event-exact shooting, found before this package
TRUTHS = {
    "earth_mars": {1.0: 449.2546446704, 0.1: 399.6389415258},
    "mars_landing": {0.1: 268.7946271902, 0.01: 268.0307003834},
}
RUNGS = (1.0, 0.3, 0.1, 0.03, 0.01)
MASS_VARIABLES = ("mass", "log_mass", "delta_v")
MOST_SEEDS = 3  # per case and mass variable


def initial_costates(solution: Solution) -> np.ndarray:
    """λr, λv, λm at t = 0 in the user's units."""
    costates = solution(0.0).costates
    return np.concatenate([costates[name][0].numpy() for name in ("r", "v", "m")])


def run(seeds: Sequence[int]) -> Report:
    rows = []
    for name, truths in TRUTHS.items():
        for smoothing, fuel in truths.items():
            reference = None
            for mass_variable in MASS_VARIABLES:
                for seed in seeds[:MOST_SEEDS]:
                    problem = PROBLEMS[name]()
                    solver = Solver(
                        continuation=Ladder([rung for rung in RUNGS if rung >= smoothing]),
                        refinement=Subdivide(),
                        mass_variable=mass_variable,
                    )
                    result = solver.solve(problem, seed)
                    found: dict[str, Any] = {"smoothing": smoothing, "mass_variable": mass_variable}
                    found |= row(problem, seed, result)
                    if result.solution is not None:
                        costates = initial_costates(result.solution)
                        if reference is None:
                            reference, found["shooting_fuel_kg"] = SHOOTING[name]().solve(costates, smoothing)
                        unit = [problem.costate_unit(state) for state in ("r", "r", "r", "v", "v", "v", "m")]
                        found["costate_error"] = float(np.abs((costates - reference) / unit).max())
                        found["segments"] = result.solution.curve.collocation.n_segments
                    found["fuel_error_kg"] = found["fuel_kg"] - fuel
                    rows.append(found)
                    print(
                        f"smoothed {name} ρ={smoothing:g} {mass_variable} seed {seed}: "
                        f"{found['fuel_error_kg']:+.1e} kg, {result.message}",
                        flush=True,
                    )
    return Report({"smoothed": rows}, _summary(rows), _measured(rows))


def _summary(rows: Sequence[dict[str, Any]]) -> str:
    lines = []
    for name, truths in TRUTHS.items():
        for smoothing, fuel in truths.items():
            for mass_variable in MASS_VARIABLES:
                wanted = (name, smoothing, mass_variable)
                mine = [r for r in rows if (r["problem"], r["smoothing"], r["mass_variable"]) == wanted]
                lines.append(
                    {
                        "problem": name,
                        "ρ": f"{smoothing:g}",
                        "mass variable": mass_variable,
                        "certified": share(r["certified"] for r in mine),
                        "known fuel, kg": f"{fuel:.10f}",
                        "fuel − known, kg": spread((r["fuel_error_kg"] for r in mine), "+.1e"),
                        "costates at 0 − shooting": spread((r.get("costate_error", np.nan) for r in mine), ".1e"),
                        "H drift": spread((r["hamiltonian_drift"] for r in mine), ".1e"),
                        "off-node residual": spread((r["off_node_residual"] for r in mine), ".1e"),
                        "segments": spread((r.get("segments", np.nan) for r in mine), ".0f"),
                        "starts": spread((r["starts"] for r in mine), ".0f"),
                        "iterations": spread((r["iterations"] for r in mine), ".0f"),
                        "residual evaluations": spread((r["residual_evaluations"] for r in mine), ".0f"),
                        "CPU s": spread((r["cpu_s"] for r in mine), ".2f"),
                    }
                )
    return f"Seeds {rows[0]['seed']}–{rows[-1]['seed']}; median [min, max].\n\n{markdown(lines)}"


def _measured(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    out: dict[str, float] = {"smoothed/certified share": float(np.mean([r["certified"] for r in rows]))}
    for name, truths in TRUTHS.items():
        for smoothing in truths:
            mine = [r for r in rows if (r["problem"], r["smoothing"]) == (name, smoothing)]
            case = f"smoothed/{name} {smoothing:g}"
            out[f"{case} fuel error kg"] = worst(r["fuel_error_kg"] for r in mine)
            out[f"{case} costate error"] = worst(r.get("costate_error", np.nan) for r in mine)
            out[f"{case} hamiltonian drift"] = worst(r["hamiltonian_drift"] for r in mine)
    return out
