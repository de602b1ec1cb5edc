"""Which units a layer needs: switch neurons against polynomials of the same number, and what each choice brings."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from experiments.refinements.compare import LADDER, name_of, seeds_line
from experiments.refinements.truths import FUELS
from experiments.solves import PROBLEMS
from experiments.tables import Report, markdown, spread, worst
from ponn_torch.ansatz.basis import LinearBasis
from ponn_torch.ansatz.switch_neurons import SwitchNeuronBasis
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.solving.continuation import Ladder
from ponn_torch.solving.single_domain import Layers
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.switch_neurons import SwitchNeurons

SMOOTHINGS = (0.1, 0.01, 1e-3)
N_SWITCHES = {"earth_mars": 4, "mars_landing": 2}
FACTORS = (1.0, 0.75, 1.35)
CHOSEN = SwitchNeurons(trust=math.inf, max_halvings=0)


class _SecondDerivative(SwitchNeuronBasis):
    """Units whose second derivative is tanh whatever the chain."""

    def beyond(self, n_supports: int) -> LinearBasis:
        made = super().beyond(n_supports)
        made.order = 2
        return made


@dataclass(frozen=True)
class _OneOrder(SwitchNeurons):
    def discretisation(self, curve: Curve, layers: Layers) -> Discretisation:
        disc = super().discretisation(curve, layers)
        basis = disc.basis
        wrong = _SecondDerivative(basis.smooth, basis.centres, basis.slopes, basis.lifts)
        return replace(disc, basis=wrong)


def variants(name: str) -> dict[str, SwitchNeurons]:
    n_units = N_SWITCHES[name] * len(CHOSEN.factors) * CHOSEN.n_lifts
    plain = replace(CHOSEN, n_neurons=CHOSEN.n_neurons + n_units, n_lifts=0)
    return {
        "polynomials of the same number": plain,
        "1 slope, jumps": replace(CHOSEN, factors=(1.0,), n_lifts=1),
        "3 slopes, jumps": replace(CHOSEN, factors=FACTORS, n_lifts=1),
        "3 slopes, jumps and kinks": replace(CHOSEN, factors=FACTORS, n_lifts=2),
        "3 slopes, to jumps of curvature": replace(CHOSEN, factors=FACTORS),
        "5 slopes, to jumps of curvature (chosen)": CHOSEN,
        "the same, second derivatives in every chain": _OneOrder(trust=math.inf, max_halvings=0),
    }


def run(name: str, seeds: Sequence[int]) -> Report:
    problem, rows = PROBLEMS[name](), []
    for seed in seeds:
        start = Solver(refinement=None, continuation=Ladder(LADDER)).solve(problem, seed).solution
        for variant, refinement in variants(name).items():
            curve = start.curve
            for smoothing in SMOOTHINGS:
                began = time.process_time()
                refined = replace(refinement, last=smoothing, factor=0.1).run(curve)
                seconds = time.process_time() - began
                curve = refined.curve
                reached = math.isclose(float(curve.collocation.setting.regime.smoothing), smoothing, rel_tol=1e-9)
                found: dict[str, Any] = {
                    "variant": variant,
                    "seed": seed,
                    "smoothing": smoothing,
                    "unknowns": curve.collocation.n_unknowns,
                    "own_error_kg": Solution(curve).cost - FUELS[name][smoothing] if reached else math.nan,
                    "off_node_residual": curve.off_node_residual() if reached else math.nan,
                    "cpu_s": seconds,
                }
                rows.append(found)
            print(f"{name} seed {seed}, {variant}: {found['own_error_kg']:+.1e} kg", flush=True)
    case = f"{name_of(name)}_units"
    lines, measured = [], {}
    for variant in variants(name):
        line: dict[str, Any] = {"units": variant}
        for smoothing in SMOOTHINGS:
            here = [r for r in rows if (r["variant"], r["smoothing"]) == (variant, smoothing)]
            line[f"ρ = {smoothing:g}: fuel − truth, kg"] = spread((r["own_error_kg"] for r in here), "+.1e")
            line["off-node residual at the last"] = spread((r["off_node_residual"] for r in here), ".1e")
            line["unknowns at the last"] = spread((r["unknowns"] for r in here), ".0f")
            measured[f"{case}/{variant} {smoothing:g} kg"] = worst(r["own_error_kg"] for r in here)
        lines.append(line)
    return Report({case: rows}, f"{seeds_line(seeds)}\n\n{markdown(lines)}", measured)
