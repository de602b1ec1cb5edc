"""The PoNN paper's procedure, word for word, and with only what can be trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from experiments.main_line.split import OPTIMA, transposed
from experiments.main_line.unsplit import PAPER_ERRORS_KG, SIZES
from experiments.refinements.compare import name_of, seeds_line
from experiments.solves import PROBLEMS, row
from experiments.tables import Report, share, spread, worst
from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.optim.base import Optimizer, Stopping
from ponn_torch.optim.scipy_least_squares import ScipyLeastSquares
from ponn_torch.solving.continuation import log_ladder
from ponn_torch.solving.enrichment import Enrichment
from ponn_torch.solving.solver import Solver

LAST = 1e-10
NEURONS = {"earth_mars": 80, "mars_landing": 30}  # after the enrichment
# section 4.2 solves the landing by SciPy's trust-region-reflective method, 4.1 the transfer by Levenberg–Marquardt
OPTIMIZERS: dict[str, Optimizer] = {
    "earth_mars": Solver().optimizer,
    "mars_landing": ScipyLeastSquares("trf", Stopping(tolerance=1e-9, decrease=1e-6, patience=1, max_iterations=300)),
}
TRUSTS = {"the whole ladder, then enriched": math.inf, "only what is trusted": 0.005}


def solver(name: str, trust: float) -> Solver:
    n_neurons, n_nodes = SIZES[name]
    enrichment = Enrichment(
        n_neurons=NEURONS[name],
        n_nodes=n_nodes,
        last=LAST,
        trust=trust,
        residual_tolerance=math.inf if math.isinf(trust) else 0.1,
    )
    return Solver(
        basis=Chebyshev(n_neurons),
        n_nodes=n_nodes,
        continuation=log_ladder(1.0, LAST, 20),
        optimizer=OPTIMIZERS[name],
        refinement=enrichment,
        trust=trust,
        start_limit=1.0 if math.isinf(trust) else 0.1,  # far down the ladder the norm is larger than a start's limit
    )


def run(name: str, seeds: Sequence[int]) -> Report:
    problem, rows = PROBLEMS[name](), []
    for variant, trust in TRUSTS.items():
        made = solver(name, trust)
        for seed in seeds:
            result = made.solve(problem, seed)
            kept = result.solution
            found: dict[str, Any] = {"variant": variant} | row(problem, seed, result)
            found["smoothing"] = kept.smoothing
            found["norm"] = float(kept.curve.collocation.residual(kept.curve.xi).norm())
            for key in ("fuel", "fuel_by_mass"):
                found[f"{key}_error_kg"] = found[f"{key}_kg"] - OPTIMA[name]["fuel"]
            rows.append(found)
            print(
                f"{name} ({variant}) seed {seed}: ρ = {kept.smoothing:.1e}, "
                f"{found['fuel_by_mass_error_kg']:+.3f} kg by mass, {found['fuel_error_kg']:+.3f} kg by ∫αT",
                flush=True,
            )
    length, case = problem.display["r"].label, f"{name_of(name)}_paper"
    lines, measured = [], {}
    for variant in TRUSTS:
        mine = [r for r in rows if r["variant"] == variant]
        lines.append(
            {
                "procedure": variant,
                "L / n, enriched L": "{} / {}, {}".format(*SIZES[name], NEURONS[name]),
                "PoNN paper: fuel − optimum, kg": f"{PAPER_ERRORS_KG[name]:+.2f}",
                "ρ": spread((r["smoothing"] for r in mine), ".1e"),
                "m(0) − m(tf) − optimum, kg": spread((r["fuel_by_mass_error_kg"] for r in mine), "+.2f"),
                "∫αT dt − optimum, kg": spread((r["fuel_error_kg"] for r in mine), "+.2f"),
                "residual norm at the nodes": spread((r["norm"] for r in mine), ".1e"),
                "off-node residual": spread((r["off_node_residual"] for r in mine), ".1e"),
                "flown end error": f"{spread((r[f'end_error_r [{length}]'] for r in mine), '.1e')} {length}",
                "certified": share(r["certified"] for r in mine),
                "starts": spread((r["starts"] for r in mine), ".0f"),
                "CPU s": spread((r["cpu_s"] for r in mine), ".1f"),
            }
        )
        measured[f"{case}/{variant} fuel error kg"] = worst(r["fuel_error_kg"] for r in mine)
        measured[f"{case}/{variant} smoothing"] = worst(r["smoothing"] for r in mine)
    return Report({case: rows}, f"{seeds_line(seeds)}\n\n{transposed(lines)}", measured)
