"""Twenty random starts each on the published problems: certified optima, and how exact everything about them is."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from experiments.solves import fuel_by_mass, row
from experiments.tables import Report, markdown, run_seeded, share, spread, worst
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.earth_mars import earth_mars
from ponn_torch.problems.energy_transfer import energy_transfer_limited
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.problems.small_body_landing import small_body_landing
from ponn_torch.solving.solver import Solver

FOLDER = Path(__file__).parent
TFC: dict[str, Any] = {"free_final_time": True, "final_time": 40.0, "mass_flow_per_thrust": 5.0863e-4}


@dataclass(frozen=True)
class Known:
    """What event-exact shooting found (kg, display units of time), and the largest errors allowed."""

    problem: Callable[[], OptimalControlProblem]
    fuel: float
    switches: tuple[float, ...] = ()
    final_time: float | None = None
    fuel_limit: float = 1e-6
    time_limit: float = 1e-6
    end_limits: tuple[float, float] = (3e-9, 3e-10)


KNOWN = {
    "tfc_test_1": Known(
        partial(
            mars_landing,
            initial_position=(-900.0, 100.0, 1500.0),
            initial_velocity=(30.0, -10.0, -70.0),
            name="tfc_test_1",
            **TFC,
        ),
        179.4476468458,
        (7.4430057683,),
        31.2623123369,
    ),
    "tfc_test_2": Known(
        partial(mars_landing, initial_velocity=(85.0, 50.0, -65.0), name="tfc_test_2", **TFC),
        275.2062387119,
        (32.4177195331, 38.8374666748),
        44.8228903294,
    ),
    "mars_landing": Known(mars_landing, 268.0146563274, (31.0920056478, 39.2202817443)),
    "mars_landing_g981": Known(
        partial(mars_landing, standard_gravity=9.81, name="mars_landing_g981"),
        267.9318584923,
        (31.0938504661, 39.2200555407),
    ),
    "small_body_landing": Known(small_body_landing, 3.9087445862, (102.9543890733, 671.7228754865)),
    "earth_mars": Known(
        earth_mars,
        396.05984393,
        (46.580845161, 68.023322597, 142.717340729, 290.254110121),
        time_limit=1e-5,
        end_limits=(1e-4, math.inf),
    ),
    # 1e-8 of J and of the fuel
    "energy_transfer_limited": Known(
        energy_transfer_limited, 443.4740587668, fuel_limit=4.4e-6, end_limits=(1e-4, math.inf)
    ),
}


def solve(name: str, seeds: Sequence[int]) -> Report:
    known, rows = KNOWN[name], []
    problem = known.problem()
    time, lengths = problem.display["time"], [problem.display[key].label for key in ("r", "v")]
    for seed in seeds:
        result = Solver().solve(problem, seed)
        found = row(problem, seed, result)
        solution = result.solution
        found["fuel_error_kg"] = found["switch_error"] = found["final_time_error"] = found["cost_error"] = math.nan
        if solution is not None:
            found["fuel_error_kg"] = fuel_by_mass(solution) - known.fuel
            found["cost_error"] = solution.cost / problem.known_cost - 1 if problem.known_cost else math.nan
            if known.final_time is not None:
                found["final_time_error"] = solution.final_time / time.size - known.final_time
            if len(solution.switch_times) == len(known.switches):
                pairs = zip(solution.switch_times, known.switches, strict=True)
                found["switch_error"] = max([abs(t / time.size - true) for t, true in pairs], default=math.nan)
        found["residual"] = result.stages[-1].norm
        rows.append(found)
        print(
            f"{name} seed {seed}: {found['fuel_error_kg']:+.1e} kg, {found['cpu_s']:.2f} s, {result.message}",
            flush=True,
        )

    def over(key: str, form: str) -> str:
        return spread((found[key] for found in rows), form)

    at_optimum = [found["certified"] and abs(found["fuel_error_kg"]) < known.fuel_limit for found in rows]
    line = {
        "problem": name,
        "certified": share(found["certified"] for found in rows),
        "at the known optimum": share(at_optimum),
        "known fuel, kg": f"{known.fuel:.12g}",
        "fuel − known, kg": over("fuel_error_kg", "+.1e"),
        "cost − known, relative": over("cost_error", "+.1e"),
        f"switch times, {time.label}": over("switch_error", ".1e"),
        f"final time, {time.label}": over("final_time_error", "+.1e") if known.final_time else "fixed",
        f"end, {lengths[0]}": over(f"end_error_r [{lengths[0]}]", ".1e"),
        f"end, {lengths[1]}": over(f"end_error_v [{lengths[1]}]", ".1e"),
        "‖r‖": over("residual", ".1e"),
        "off-node residual": over("off_node_residual", ".1e"),
        "H drift": over("hamiltonian_drift", ".1e"),
        "starts": over("starts", ".0f"),
        "CPU s": over("cpu_s", ".2f"),
    }
    measured = {
        f"{name}/at the known optimum": sum(at_optimum) / len(rows),
        f"{name}/fuel error over its limit": worst(found["fuel_error_kg"] for found in rows) / known.fuel_limit,
        f"{name}/H drift": worst(found["hamiltonian_drift"] for found in rows),
        f"{name}/residual": worst(found["residual"] for found in rows),
    }
    if known.switches:
        measured[f"{name}/switch error over its limit"] = worst(f["switch_error"] for f in rows) / known.time_limit
    if known.final_time is not None:
        error = worst(found["final_time_error"] for found in rows)
        measured[f"{name}/final time error over its limit"] = error / known.time_limit
    for label, limit in zip(("r", "v"), known.end_limits, strict=True):
        unit = problem.display[label].label
        measured[f"{name}/end error of {label} over its limit"] = (
            worst(found[f"end_error_{label} [{unit}]"] for found in rows) / limit
        )
    summary = markdown([{"": key, "value": value} for key, value in line.items()])
    return Report({name: rows}, summary, measured)


def main() -> int:
    return run_seeded(FOLDER, {name: partial(solve, name) for name in KNOWN}, __doc__, seeds=20)


if __name__ == "__main__":
    sys.exit(main())
