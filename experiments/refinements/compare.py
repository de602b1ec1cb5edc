"""From the same random starts: no refinement, enrichment, switch neurons, subdivision and the split."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from experiments.main_line.split import OPTIMA, transposed
from experiments.refinements.truths import truth
from experiments.solves import PROBLEMS, row
from experiments.tables import Report, share, spread, worst
from ponn_torch.solving.continuation import Ladder
from ponn_torch.solving.enrichment import Enrichment
from ponn_torch.solving.refinement import Subdivide
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.split import Split
from ponn_torch.solving.switch_neurons import SwitchNeurons

LADDER = (1.0, 0.3, 0.1)
SIZES = {"earth_mars": (80, 200), "mars_landing": (30, 120)}  # L, n of the enriched domain; L is the paper's


def solvers(name: str) -> dict[str, Solver]:
    n_neurons, n_nodes = SIZES[name]
    start = Ladder(LADDER)
    return {
        "none": Solver(refinement=None, continuation=Ladder((*LADDER, 0.03, 0.01)), trust=0.005),
        "enrichment": Solver(refinement=Enrichment(n_neurons=n_neurons, n_nodes=n_nodes), continuation=start),
        "switch neurons": Solver(refinement=SwitchNeurons(), continuation=start),
        "switch neurons, ρ = 1e-4": Solver(refinement=SwitchNeurons(last=1e-4), continuation=start),
        "subdivide": Solver(refinement=Subdivide(), continuation=Ladder((*LADDER, 0.03, 0.01))),
        "split": Solver(refinement=Split(), continuation=start),
    }


def run(name: str, seeds: Sequence[int]) -> Report:
    problem, optimum, rows = PROBLEMS[name](), OPTIMA[name]["fuel"], []
    for method, solver in solvers(name).items():
        for seed in seeds:
            result = solver.solve(problem, seed)
            solution = result.solution
            collocation = solution.curve.collocation
            found: dict[str, Any] = {"method": method} | row(problem, seed, result)
            found["smoothing"] = 0.0 if solution.smoothing is None else solution.smoothing
            found["unknowns"] = collocation.n_unknowns
            found["nodes"] = len(collocation.discretisation.nodes) * collocation.n_segments
            found["own_error_kg"] = found["fuel_kg"] - (
                optimum if solution.smoothing is None else truth(name, solution)
            )
            found["fuel_error_kg"] = found["fuel_kg"] - optimum
            rows.append(found)
            print(
                f"{name} {method} seed {seed}: ρ = {found['smoothing']:.2g}, "
                f"{found['own_error_kg']:+.1e} kg of its own truth, {found['cpu_s']:.1f} s",
                flush=True,
            )
    length, case = problem.display["r"].label, name_of(name)
    lines, measured = [], {}
    for method in solvers(name):
        mine = [r for r in rows if r["method"] == method]
        lines.append(
            {
                "refinement": method,
                "ρ reached": spread((r["smoothing"] for r in mine), ".1e"),
                "fuel − truth at that ρ, kg": spread((r["own_error_kg"] for r in mine), "+.1e"),
                "fuel − bang-bang optimum, kg": spread((r["fuel_error_kg"] for r in mine), "+.1e"),
                "off-node residual": spread((r["off_node_residual"] for r in mine), ".1e"),
                "flown end error": f"{spread((r[f'end_error_r [{length}]'] for r in mine), '.1e')} {length}",
                "certified": share(r["certified"] for r in mine),
                "unknowns": spread((r["unknowns"] for r in mine), ".0f"),
                "nodes": spread((r["nodes"] for r in mine), ".0f"),
                "starts": spread((r["starts"] for r in mine), ".0f"),
                "CPU s": spread((r["cpu_s"] for r in mine), ".1f"),
            }
        )
        measured[f"{case}/{method} own error kg"] = worst(r["own_error_kg"] for r in mine)
        measured[f"{case}/{method} fuel error kg"] = worst(r["fuel_error_kg"] for r in mine)
        measured[f"{case}/{method} certified share"] = sum(r["certified"] for r in mine) / len(mine)
    return Report({case: rows}, f"{seeds_line(seeds)}\n\n{transposed(lines)}", measured)


def name_of(problem: str) -> str:
    """What the tables call a problem."""
    return {"earth_mars": "transfer", "mars_landing": "landing"}[problem]


def seeds_line(seeds: Sequence[int]) -> str:
    return f"Seeds {seeds[0]}–{seeds[-1]}; median [min, max]." if len(seeds) > 1 else f"Seed {seeds[0]}."
