"""Optimisers on one residual: the smoothed landing at ρ = 1, polynomials and a network, random starts, equal time."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from experiments.plots import histories
from experiments.tables import Report, markdown, run_study, share, spread
from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.ansatz.networks import MLP
from ponn_torch.optim.base import Optimizer, Stopping
from ponn_torch.optim.chain import Chain, OutputLayer
from ponn_torch.optim.gradient import Adam
from ponn_torch.optim.least_squares import GaussNewton, LevenbergMarquardt
from ponn_torch.optim.quasi_newton import LBFGS, SSBroyden
from ponn_torch.optim.scipy_least_squares import ScipyLeastSquares
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.reporting.reference import Reference
from ponn_torch.solving.guess import RandomGuess, project
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver

FOLDER = Path(__file__).parent
FUEL_KG = 272.1667469489  # at ρ = 1
SAME_KG = 0.05  # a stage this near is the known extremal
RULE = Stopping(tolerance=1e-10, decrease=1e-7, patience=5, max_iterations=10**6)


def _optimizers(seconds: float) -> dict[str, Optimizer]:
    rule, noisy = replace(RULE, cpu_seconds=seconds), replace(RULE, decrease=0.0, cpu_seconds=seconds)
    short = replace(noisy, cpu_seconds=seconds / 4, max_iterations=400)
    adam = replace(noisy, max_iterations=int(seconds / 4e-3))  # the schedule's length: about what the time allows
    return {
        "LM": LevenbergMarquardt(rule),
        "LM, output layer": Chain(
            [LevenbergMarquardt(rule), OutputLayer(GaussNewton(replace(rule, max_iterations=20)))]
        ),
        "SciPy trf": ScipyLeastSquares("trf", rule),
        "Adam": Adam(adam),
        "L-BFGS": LBFGS(rule),
        "SSBroyden": SSBroyden(rule),
        "Adam, L-BFGS": Chain([Adam(short), LBFGS(rule)]),
        "Adam, LM": Chain([Adam(short), LevenbergMarquardt(rule)]),
    }


def _collocation(basis: Any, n_nodes: int) -> Collocation:
    solver = Solver(basis=basis, n_nodes=n_nodes)
    bvp = pontryagin(mars_landing(), mass_variable="log_mass")
    ends = torch.tensor([0.0, bvp.final_time], dtype=torch.float64)
    return Collocation.on_segments(solver.discretisation(bvp), ends).with_setting(smoothing=1.0)


def _reference() -> Reference:
    made = _collocation(Chebyshev(60), 90)
    start = project(made, RandomGuess().curve(made.bvp, 0))
    result = LevenbergMarquardt(replace(RULE, tolerance=1e-12)).run(made, start)
    return Reference(Solution(Curve(made, result.xi)))


def run(name: str, ansatz: Callable[[int], Any], seconds: float, seeds: Sequence[int], write: bool) -> Report:
    reference = _reference()
    rows: list[dict[str, Any]] = []
    groups: dict[str, list[tuple[list[float], list[float]]]] = {}
    for label, optimizer in _optimizers(seconds).items():
        for seed in seeds:
            made = _collocation(ansatz(seed), 40)
            start = project(made, RandomGuess().curve(made.bvp, 1000 * seed))
            result = optimizer.run(made, start)
            curve = Curve(made, result.xi)
            errors, fuel = reference.errors(curve), float(made.cost(result.xi))
            rows.append(
                {
                    "optimizer": label,
                    "seed": seed,
                    "unknowns": made.n_unknowns,
                    "norm": float(result.norm),
                    "off_node_residual": curve.off_node_residual(),
                    "error_states": errors["states"],
                    "error_costates": errors["costates"],
                    "fuel_kg": fuel,
                    "known_extremal": abs(fuel - FUEL_KG) < SAME_KG and errors["states"] < 0.1,
                    "iterations": result.n_iterations,
                    "residuals": result.n_residuals,
                    "derivatives": result.n_linearisations,
                    "cpu_s": result.cpu_seconds,
                    "status": result.status.name,
                }
            )
            told = result.records
            groups.setdefault(label, []).append(([r["seconds"] for r in told], [r["norm"] for r in told]))
        print(f"{name}: {label} done", flush=True)
    if write:
        histories(groups, FOLDER / "results" / f"{name}.png", "CPU time (s)", r"residual $\|r\|$, best so far")
    return Report({name: rows}, _summary(name, rows, seconds), _measured(name, rows))


def _summary(name: str, rows: Sequence[Mapping[str, Any]], seconds: float) -> str:
    lines = []
    for label in dict.fromkeys(row["optimizer"] for row in rows):
        mine = [row for row in rows if row["optimizer"] == label]
        lines.append(
            {
                "optimiser": label,
                "known extremal": share(row["known_extremal"] for row in mine),
                "‖r‖": spread((row["norm"] for row in mine), ".1e"),
                "error of states": spread((row["error_states"] for row in mine), ".1e"),
                "of costates": spread((row["error_costates"] for row in mine), ".1e"),
                "iterations": spread((row["iterations"] for row in mine), ".0f"),
                "residuals": spread((row["residuals"] for row in mine), ".0f"),
                "Jacobians or gradients": spread((row["derivatives"] for row in mine), ".0f"),
                "CPU s": spread((row["cpu_s"] for row in mine), ".2f"),
            }
        )
    told = f"{len({row['seed'] for row in rows})} random starts, {rows[0]['unknowns']} unknowns, {seconds:g} CPU s each"
    return f"{told}; median [min, max].\n\n{markdown(lines)}\n\n![{name}](results/{name}.png)"


def _measured(name: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    def middle(label: str, key: str) -> float:
        values = sorted(float(row[key]) for row in rows if row["optimizer"] == label)
        return values[len(values) // 2] if values else math.nan

    return {
        f"{name}/LM norm": middle("LM", "norm"),
        f"{name}/LM known extremal share": sum(r["known_extremal"] for r in rows if r["optimizer"] == "LM")
        / max(1, sum(r["optimizer"] == "LM" for r in rows)),
        f"{name}/SSBroyden over L-BFGS": middle("SSBroyden", "norm") / middle("L-BFGS", "norm"),
        f"{name}/Adam over LM": middle("Adam", "norm") / middle("LM", "norm"),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=("linear", "deep"), default=["linear", "deep"])
    parser.add_argument("--seeds", type=int, default=5, help="seeds 0 … SEEDS − 1 (default 5)")
    parser.add_argument("--seconds", type=float, default=4.0, help="CPU seconds a run (default 4)")
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    given = parser.parse_args()
    torch.set_num_threads(1)
    ansatzes: dict[str, Callable[[int], Any]] = {
        "linear": lambda seed: Chebyshev(20),
        "deep": lambda seed: MLP([10, 20], seed=seed),
    }
    parts = {
        name: partial(run, name, ansatzes[name], given.seconds, range(given.seeds), not given.check_only)
        for name in given.parts
    }
    return run_study(FOLDER, parts, check_only=given.check_only)


if __name__ == "__main__":
    sys.exit(main())
