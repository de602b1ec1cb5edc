"""First stage only (ρ = 1, the default solver's sizes): which starts come through, and at what price."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from experiments.solves import PROBLEMS
from experiments.tables import Report, markdown, share, spread
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.solving.guess import Guess, RandomGuess, project
from ponn_torch.solving.paths import PolarTransfer, PoweredDescent, StraightLine
from ponn_torch.solving.solver import Solver

SMOOTHED_FUEL_KG = {"earth_mars": 449.2546446704, "mars_landing": 272.1667469489}  # at ρ = 1
SAME_KG = 0.5  # a coarse first stage this near is the known extremal

RANDOM: dict[str, tuple[str, RandomGuess]] = {
    "U(0, 1)": ("log_mass", RandomGuess()),
    "U(0, 1), mass itself": ("mass", RandomGuess()),
    "U(0, 1), Δv": ("delta_v", RandomGuess()),
    "½ U(0, 1)": ("log_mass", RandomGuess(scale=0.5)),
    "2 U(0, 1)": ("log_mass", RandomGuess(scale=2.0)),
    "U(−1, 1)": ("log_mass", RandomGuess("symmetric")),
    "N(0, 1)": ("log_mass", RandomGuess("normal")),
    "3 N(0, 1)": ("log_mass", RandomGuess("normal", scale=3.0)),
    "U(0, 1), m and λm random too": ("log_mass", RandomGuess(hold_mass=False)),
}
PATHS: dict[str, dict[str, Guess]] = {
    "earth_mars": {"straight line": StraightLine(), "polar interpolation": PolarTransfer()},
    "mars_landing": {"straight line": StraightLine(), "TFC paper's guess": PoweredDescent()},
}


def first_stage(name: str, mass_variable: str, guess: Guess, stream: int) -> dict[str, Any]:
    """One start, by the pieces that the solver is made of."""
    solver = Solver(mass_variable=mass_variable, guess=guess)
    bvp = pontryagin(PROBLEMS[name](), mass_variable=mass_variable)
    ends = torch.tensor([0.0, bvp.final_time], dtype=torch.float64)
    collocation = Collocation.on_segments(solver.discretisation(bvp), ends).with_setting(smoothing=1.0)
    result = solver.optimizer.run(collocation, project(collocation, guess.curve(bvp, stream)))
    fuel = float(collocation.cost(result.xi))
    norm = float(result.norm)
    return {
        "norm": norm,
        "success": norm < solver.start_limit,
        "known_extremal": norm < solver.start_limit and abs(fuel - SMOOTHED_FUEL_KG[name]) < SAME_KG,
        "iterations": result.n_iterations,
        "residual_evaluations": result.n_residuals,
        "cpu_s": result.cpu_seconds,
        "status": result.status.name,
    }


def run(seeds: Sequence[int]) -> Report:
    rows = []
    for name in PROBLEMS:
        trials: list[tuple[str, str, Guess, int]] = [
            (label, variable, guess, 1000 * seed) for label, (variable, guess) in RANDOM.items() for seed in seeds
        ]
        trials += [(label, "log_mass", guess, 0) for label, guess in PATHS[name].items()]
        for label, mass_variable, guess, stream in trials:
            found = {"problem": name, "start": label, "mass_variable": mass_variable, "seed": stream // 1000}
            rows.append(found | first_stage(name, mass_variable, guess, stream))
        print(f"starts {name}: {len(trials)} tried", flush=True)
    measured = {}
    for name in PROBLEMS:
        mine = [r for r in rows if (r["problem"], r["start"]) == (name, "U(0, 1)")]
        measured[f"starts/{name} log_mass success share"] = sum(r["success"] for r in mine) / len(mine)
    for name, label in (("earth_mars", "polar interpolation"), ("mars_landing", "TFC paper's guess")):
        (one,) = (r for r in rows if (r["problem"], r["start"]) == (name, label))
        measured[f"starts/{name} {label} iterations"] = one["iterations"] if one["success"] else math.nan
    return Report({"starts": rows}, _summary(rows), measured)


def _summary(rows: Sequence[dict[str, Any]]) -> str:
    lines = []
    for name in PROBLEMS:
        for label in dict.fromkeys(r["start"] for r in rows if r["problem"] == name):
            mine = [r for r in rows if (r["problem"], r["start"]) == (name, label)]
            good, bad = ([r for r in mine if r["success"] is which] for which in (True, False))
            lines.append(
                {
                    "problem": name,
                    "start": label,
                    "mass variable": mine[0]["mass_variable"],
                    "come through": share(r["success"] for r in mine),
                    "at the known extremal": share(r["known_extremal"] for r in mine),
                    "iterations of those": spread((r["iterations"] for r in good), ".0f"),
                    "iterations until a failure is known": spread((r["iterations"] for r in bad), ".0f"),
                    "residual evaluations": spread((r["residual_evaluations"] for r in mine), ".0f"),
                    "CPU s a start": spread((r["cpu_s"] for r in mine), ".2f"),
                }
            )
    return f"First start of each seed (guesses from a path: one); median [min, max].\n\n{markdown(lines)}"
