"""Random start to certified bang-bang optimum: the default solver, one row per seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from experiments.main_line.smoothed import initial_costates
from experiments.solves import PROBLEMS, row
from experiments.tables import Report, markdown, share, spread, worst
from ponn_torch.solving.solver import Solver

# fuel in kg, switch times in the problem's unit of time, costates at t = 0 scaled: event-exact shooting
OPTIMA: dict[str, dict[str, Any]] = {
    "earth_mars": {
        "fuel": 396.05984393,
        "switches": (46.580845161, 68.023322597, 142.717340729, 290.254110121),
        "costates": (
            *(-0.8716461495216, -1.1497810369671, -0.0875851962203),
            *(-0.5400403260906, -1.4059900229013, 0.3312112393472),
            0.4790838018822,
        ),
    },
    "mars_landing": {"fuel": 268.0146563274, "switches": (31.0920056478, 39.2202817443)},
}


def run(seeds: Sequence[int]) -> Report:
    rows = []
    for name, known in OPTIMA.items():
        problem = PROBLEMS[name]()
        time, states = problem.display["time"], ("r", "r", "r", "v", "v", "v", "m")
        units = [problem.costate_unit(state) for state in states]
        for seed in seeds:
            result = Solver().solve(problem, seed)
            found = row(problem, seed, result)
            found["fuel_error_kg"] = found["fuel_kg"] - known["fuel"]
            found["switch_error"] = found["costate_error"] = math.nan
            solution = result.solution
            if solution is not None and len(solution.switch_times) == len(known["switches"]):
                pairs = zip(solution.switch_times, known["switches"], strict=True)
                found["switch_error"] = worst(found_t / time.size - t for found_t, t in pairs)
            if solution is not None and "costates" in known:
                triples = zip(initial_costates(solution), known["costates"], units, strict=True)
                found["costate_error"] = worst(float(value / unit - true) for value, true, unit in triples)
            rows.append(found)
            print(
                f"split {name} seed {seed}: {found['fuel_error_kg']:+.1e} kg, {found['cpu_s']:.2f} s, {result.message}",
                flush=True,
            )
    return Report({"split": rows}, _summary(rows), _measured(rows))


def _summary(rows: Sequence[dict[str, Any]]) -> str:
    lines = []
    for name in OPTIMA:
        mine = [r for r in rows if r["problem"] == name]
        display = PROBLEMS[name]().display
        time, length, speed = (display[key].label for key in ("time", "r", "v"))

        def over(key: str, form: str, mine: Sequence[dict[str, Any]] = mine) -> str:
            return spread((r[key] for r in mine), form)

        lines.append(
            {
                "problem": name,
                "certified": share(r["certified"] for r in mine),
                "fuel − optimum, kg": over("fuel_error_kg", "+.1e"),
                "worst switch time error": f"{over('switch_error', '.1e')} {time}",
                "costates at 0, scaled error": over("costate_error", ".1e"),
                "flown end error, position": f"{over(f'end_error_r [{length}]', '.1e')} {length}",
                "velocity": f"{over(f'end_error_v [{speed}]', '.1e')} {speed}",
                "off-node residual": over("off_node_residual", ".1e"),
                "H drift": over("hamiltonian_drift", ".1e"),
                "starts": over("starts", ".0f"),
                "iterations": over("iterations", ".0f"),
                "residual evaluations": over("residual_evaluations", ".0f"),
                "linearisations": over("linearisations", ".0f"),
                "CPU s to the solution": over("cpu_s", ".2f"),
                "certificate, CPU s": over("certificate_s", ".2f"),
            }
        )
    return f"Seeds {rows[0]['seed']}–{rows[-1]['seed']}; median [min, max].\n\n{transposed(lines)}"


def transposed(lines: Sequence[dict[str, Any]]) -> str:
    """A Markdown table with one column per line, for tables of many quantities."""
    first, *others = lines[0]
    return markdown([{"": key, **{line[first]: line[key] for line in lines}} for key in others])


def _measured(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    out = {}
    for name in OPTIMA:
        mine = [r for r in rows if r["problem"] == name]
        length = PROBLEMS[name]().display["r"].label
        out[f"split/{name} certified share"] = sum(r["certified"] for r in mine) / len(mine)
        out[f"split/{name} fuel error kg"] = worst(r["fuel_error_kg"] for r in mine)
        out[f"split/{name} switch time error"] = worst(r["switch_error"] for r in mine)
        out[f"split/{name} end error {length}"] = worst(r[f"end_error_r [{length}]"] for r in mine)
        out[f"split/{name} costate error"] = worst(r["costate_error"] for r in mine)
    return out
