"""One domain, no split, the paper's sizes: moments of the residual with a polish, and the pointwise form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from experiments.main_line.split import OPTIMA, transposed
from experiments.solves import PROBLEMS, fuel_by_mass, row
from experiments.tables import Report, markdown, share, spread, worst
from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.discretisation import Weak
from ponn_torch.solving.continuation import Ladder, Phases, log_ladder
from ponn_torch.solving.result import SolveResult, StageResult
from ponn_torch.solving.solver import Solver

SIZES = {"earth_mars": (70, 140), "mars_landing": (30, 120)}  # L, n of the paper
PAPER_ERRORS_KG = {"earth_mars": 0.79, "mars_landing": 0.37}  # its PoNN against its own optimal reference
MOST_LADDERS = 5  # seeds that walk the whole pointwise ladder

WEAK = Solver(
    continuation=Phases(
        [
            Ladder([1.0]),  # strong: it sends a failed start away
            Ladder(log_ladder(1.0, 1e-4, 9).values[1:], form=Weak(1.0)),
            Ladder([1e-4], form=Weak(2.0)),
        ]
    ),
    optimizer=LevenbergMarquardt(
        Stopping(tolerance=1e-10, decrease=1e-3, max_iterations=100, hopeless=0.1, hopeless_after=60)
    ),
    refinement=None,
)
# stricter than the default, whose stages only have to be good enough to start a split
POINTWISE = Solver(continuation=log_ladder(), refinement=None, trust=0.005)


def solve(solver: Solver, name: str, seed: int) -> tuple[dict[str, Any], SolveResult]:
    """A row with both fuels held against the optimum, and the solve itself."""
    n_neurons, n_nodes = SIZES[name]
    problem = PROBLEMS[name]()
    result = replace(solver, basis=Chebyshev(n_neurons), n_nodes=n_nodes).solve(problem, seed)
    found = row(problem, seed, result)
    for key in ("fuel", "fuel_by_mass"):
        found[f"{key}_error_kg"] = found[f"{key}_kg"] - OPTIMA[name]["fuel"]
    return found, result


def run_weak(seeds: Sequence[int]) -> Report:
    rows = []
    for name in SIZES:
        for seed in seeds:
            found, _ = solve(WEAK, name, seed)
            rows.append(found)
            print(
                f"weak {name} seed {seed}: {found['fuel_by_mass_error_kg']:+.4f} kg by mass, "
                f"{found['fuel_error_kg']:+.3f} kg by ∫αT",
                flush=True,
            )
    measured = {
        f"weak/{name} fuel error kg": worst(r["fuel_by_mass_error_kg"] for r in rows if r["problem"] == name)
        for name in SIZES
    }
    lines = []
    for name in SIZES:
        mine = [r for r in rows if r["problem"] == name]
        lines.append(
            {
                "problem": name,
                "L / n": "{} / {}".format(*SIZES[name]),
                "PoNN paper: fuel − optimum, kg": f"{PAPER_ERRORS_KG[name]:+.2f}",
                **_common(name, mine),
                "within 0.1 kg": share(abs(r["fuel_by_mass_error_kg"]) <= 0.1 for r in mine),
            }
        )
    text = f"Seeds {rows[0]['seed']}–{rows[-1]['seed']}; median [min, max].\n\n{transposed(lines)}"
    return Report({"weak": rows}, text, measured)


def run_pointwise(seeds: Sequence[int]) -> Report:
    rows, rungs = [], []
    for name in SIZES:
        for seed in seeds[:MOST_LADDERS]:
            found, result = solve(POINTWISE, name, seed)
            ladder = [_rung(name, seed, stage) for stage in result.stages if stage.start == result.n_starts - 1]
            kept = result.solution.smoothing if result.solution is not None else math.nan
            dropped = [rung["smoothing"] for rung in ladder if rung["smoothing"] < kept]
            found["kept_smoothing"], found["given_away_at"] = kept, max(dropped, default=math.nan)
            found["ladder_end_kg"] = ladder[-1]["fuel_by_mass_kg"]
            found["ladder_end_off_node_residual"] = ladder[-1]["off_node_residual"]
            lax = [rung for rung in ladder if rung["relative_off_node_residual"] <= Solver().trust]
            found["default_trust_smoothing"] = lax[-1]["smoothing"] if lax else math.nan
            found["default_trust_kg"] = lax[-1]["fuel_by_mass_kg"] if lax else math.nan
            rows.append(found)
            rungs += ladder
            print(
                f"pointwise {name} seed {seed}: the ladder ends at {found['ladder_end_kg']:.2f} kg, "
                f"ρ = {kept:.2g} is kept",
                flush=True,
            )
    lines, measured = [], {}
    for name in SIZES:
        mine, optimum = [r for r in rows if r["problem"] == name], OPTIMA[name]["fuel"]
        end, lax_end = ([r[key] - optimum for r in mine] for key in ("ladder_end_kg", "default_trust_kg"))
        lines.append(
            {
                "problem": name,
                "L / n": "{} / {}".format(*SIZES[name]),
                "end of the ladder, ρ = 1e-10: m(0) − m(tf) − optimum, kg": spread(end, "+.2f"),
                "its off-node residual": spread((r["ladder_end_off_node_residual"] for r in mine), ".1e"),
                "given away by its off-node residual at ρ": spread((r["given_away_at"] for r in mine), ".1e"),
                f"stage kept (trust {POINTWISE.trust:g}): ρ": spread((r["kept_smoothing"] for r in mine), ".1e"),
                **_common(name, mine),
                f"the default trust ({Solver().trust:g}) would keep: ρ": spread(
                    (r["default_trust_smoothing"] for r in mine), ".1e"
                ),
                "its m(0) − m(tf) − optimum, kg": spread(lax_end, "+.2f"),
            }
        )
        # recognised: what is kept is far from the end of the ladder, and its mass agrees with its thrust
        measured[f"pointwise/{name} kept smoothing"] = min(r["kept_smoothing"] for r in mine)
        measured[f"pointwise/{name} kept mass against thrust kg"] = worst(
            r["fuel_by_mass_kg"] - r["fuel_kg"] for r in mine
        )
    text = f"Seeds {rows[0]['seed']}–{rows[-1]['seed']}; median [min, max].\n\n{transposed(lines)}\n\n"
    text += f"Rung by rung, seed {rows[0]['seed']}:\n\n{markdown(_rungs(rungs, rows[0]['seed']))}"
    return Report({"pointwise": rows, "pointwise_rungs": rungs}, text, measured)


def _rung(name: str, seed: int, stage: StageResult) -> dict[str, Any]:
    curve = stage.solution.curve
    _, _, rates = curve.on_segment(curve.collocation.discretisation.nodes.points, 0)
    return {
        "problem": name,
        "seed": seed,
        "smoothing": stage.smoothing,
        "norm": stage.norm,
        "off_node_residual": stage.off_node_residual,
        "relative_off_node_residual": stage.off_node_residual / float(rates.abs().max()),
        "fuel_kg": stage.solution.cost,
        "fuel_by_mass_kg": fuel_by_mass(stage.solution),
        "iterations": stage.n_iterations,
        "status": stage.status.name,
    }


def _rungs(rungs: Sequence[dict[str, Any]], seed: int) -> list[dict[str, Any]]:
    """One line per ρ, both problems side by side."""
    out: dict[float, dict[str, Any]] = {}
    for rung in rungs:
        if rung["seed"] == seed:
            line = out.setdefault(rung["smoothing"], {"ρ": f"{rung['smoothing']:.1e}"})
            name = rung["problem"]
            line[f"{name}: off-node residual"] = f"{rung['off_node_residual']:.1e}"
            line[f"{name}: over the largest rate"] = f"{rung['relative_off_node_residual']:.1e}"
            line[f"{name}: m(0) − m(tf), kg"] = f"{rung['fuel_by_mass_kg']:.2f}"
            line[f"{name}: ∫αT dt, kg"] = f"{rung['fuel_kg']:.2f}"
    return list(out.values())


def _common(name: str, mine: Sequence[dict[str, Any]]) -> dict[str, str]:
    display = PROBLEMS[name]().display
    length = display["r"].label

    def over(key: str, form: str) -> str:
        return spread((r[key] for r in mine), form)

    return {
        "result: m(0) − m(tf) − optimum, kg": over("fuel_by_mass_error_kg", "+.4f"),
        "result: ∫αT dt − optimum, kg": over("fuel_error_kg", "+.3f"),
        "off-node residual": over("off_node_residual", ".1e"),
        "flown end error": f"{over(f'end_error_r [{length}]', '.1e')} {length}",
        "certified": share(r["certified"] for r in mine),
        "starts": over("starts", ".0f"),
        "iterations": over("iterations", ".0f"),
        "residual evaluations": over("residual_evaluations", ".0f"),
        "CPU s": over("cpu_s", ".1f"),
    }
