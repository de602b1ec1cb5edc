"""Random lunar descents whose thrust can be nothing and whose time is free, with three regularisers."""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.lunar_descents.problem import descent, vertical_fuel
from experiments.solves import row
from experiments.tables import Report, markdown, run_study, share, spread, worst
from ponn_torch.optimal_control.regularisers import Entropy, Quadratic, Regulariser
from ponn_torch.solving.solver import Solver

FOLDER = Path(__file__).parent
SOLVER = Solver(n_starts=4)


@dataclass(frozen=True)
class BareEntropy(Entropy):
    """½[η ln η + (1−η) ln(1−η)] ≤ 0: the same law, but part throttle is paid for."""

    def penalty(self, fraction: Tensor) -> Tensor:
        return super().penalty(fraction) - 0.5 * math.log(2.0)


REGULARISERS: dict[str, Regulariser] = {
    "entropy": Entropy(),
    "entropy, without ½ ln 2": BareEntropy(),
    "quadratic": Quadratic(),
}


@dataclass(frozen=True)
class Case:
    """Where a descent begins, and its thrust over its weight there."""

    position: tuple[float, ...]
    velocity: tuple[float, ...]
    weights: float


def vertical(count: int, generator: np.random.Generator) -> Iterator[Case]:
    """Heights of 0.5–4 km, −40…10 m/s, thrust of 2 to 20 weights (uniform in the logarithm)."""
    for _ in range(count):
        height, speed = generator.uniform((500, -40), (4000, 10))
        yield Case((0.0, 0.0, float(height)), (0.0, 0.0, float(speed)), math.exp(generator.uniform(*np.log((2, 20)))))


def slanted(count: int, generator: np.random.Generator) -> Iterator[Case]:
    """±3 km across and 0.5–4 km up, ±60 m/s across and −60…−5 m/s down, thrust of 2 to 20 weights."""
    for _ in range(count):
        r = generator.uniform((-3000, -3000, 500), (3000, 3000, 4000))
        v = generator.uniform((-60, -60, -60), (60, 60, -5))
        yield Case(tuple(r.tolist()), tuple(v.tolist()), math.exp(generator.uniform(*np.log((2, 20)))))


CASES = {"vertical": vertical, "slanted": slanted}


def descents(name: str, count: int, seed: int) -> Report:
    rows, table, measured = list[dict[str, Any]](), list[dict[str, str]](), dict[str, float]()
    for label, regulariser in REGULARISERS.items():
        found = [
            _solve(index, case, label, regulariser, exact=name == "vertical")
            for index, case in enumerate(CASES[name](count, np.random.default_rng(seed)))
        ]
        rows += found
        good = [one for one in found if one["certified"]]
        print(f"{name}, {label}: {len(good)} of {len(found)} certified", flush=True)
        arcs = Counter(one["arcs"] for one in good)
        line = {
            "regulariser": label,
            "certified": share(one["certified"] for one in found),
            "starts": spread((one["starts"] for one in found), ".0f"),
            "iterations": spread((one["iterations"] for one in found), ".0f"),
            "CPU s to the solution": spread((one["cpu_s"] for one in found), ".2f"),
            "fuel, kg": spread((one["fuel_kg"] for one in good), ".2f"),
            "arcs": ", ".join(f"{kind} {n}" for kind, n in arcs.most_common()),
        }
        if name == "vertical":
            line["fuel − exact, kg"] = format(worst(one["error_kg"] for one in good), ".0e")
        table.append(line)
        if label == "entropy":
            measured[f"{name}/certified share"] = len(good) / len(found)
            if name == "vertical":
                measured["vertical/fuel error, kg"] = worst(one["error_kg"] for one in good)
    return Report({name: rows}, markdown(table), measured)


def _solve(index: int, case: Case, label: str, regulariser: Regulariser, *, exact: bool) -> dict[str, Any]:
    problem = descent(case.position, case.velocity, case.weights, regulariser=regulariser)
    result = SOLVER.solve(problem)
    data = dict(zip(("x", "y", "z", "vx", "vy", "vz"), (*case.position, *case.velocity), strict=True))
    found = {"case": index, "regulariser": label, **data, "weights": case.weights, **row(problem, 0, result)}
    if exact:
        found["error_kg"] = found["fuel_kg"] - vertical_fuel(case.position[2], case.velocity[2], case.weights)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--count", type=int, default=30, help="cases of every part (default: 30)")
    parser.add_argument("--seed", type=int, default=0, help="of the generator of the cases (default: 0, the tables')")
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    parts = {name: partial(descents, name, arguments.count, arguments.seed) for name in arguments.parts}
    return run_study(FOLDER, parts, check_only=arguments.check_only)


if __name__ == "__main__":
    sys.exit(main())
