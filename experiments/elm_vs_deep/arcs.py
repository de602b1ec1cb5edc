"""The split with polynomials, untrained and trained networks on every segment, against the known optima."""

from __future__ import annotations

import math

from experiments.solves import PROBLEMS
from experiments.tables import Report, Row, markdown, share, spread, worst
from ponn_torch.ansatz.networks import MLP, FrozenMLP
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.split import Split


def splits(seed: int) -> dict[str, Split]:
    """Networks are scaled for smooth arcs: a first layer of slopes up to 2."""
    return {
        "Legendre, L = 14": Split(),
        "MLP 24, LM → output layer": Split(basis=MLP((24,), first_scale=2.0, seed=seed), n_nodes=30),
        "the same, hidden layer untrained": Split(basis=FrozenMLP((24,), first_scale=2.0, seed=seed), n_nodes=30),
    }


def run(seeds: range) -> Report:
    rows: list[Row] = []
    for problem in PROBLEMS:
        for seed in seeds:
            for name, split in splits(seed).items():
                made = PROBLEMS[problem]()
                result = Solver(refinement=split, n_starts=3).solve(made, seed)
                refined = [stage for stage in result.stages if stage.name == "split"]
                solution = result.solution if result.certified else None
                own = math.nan if solution is None else solution.curve.collocation.discretisation.n_own
                rows.append(
                    {
                        "problem": problem,
                        "method": name,
                        "seed": seed,
                        "certified": result.certified,
                        "weights_per_segment": own,
                        "segments": math.nan if solution is None else solution.curve.collocation.n_segments,
                        "fuel_error_kg": math.nan if solution is None else solution.cost - made.known_cost,
                        "off_node_residual": math.nan if solution is None else solution.off_node_residual,
                        "rounds": len(refined),
                        "iterations": sum(stage.n_iterations for stage in refined),
                        "cpu_s": result.cpu_seconds,
                        "message": result.message,
                    }
                )
                print(f"arcs {problem} {name} seed {seed}: {result.certified} {result.cpu_seconds:.1f} s", flush=True)
    table: list[Row] = []
    for problem in PROBLEMS:
        for name in splits(0):
            mine = [row for row in rows if (row["problem"], row["method"]) == (problem, name)]
            table.append(
                {
                    "problem": problem,
                    "free function of a segment": name,
                    "certified": share(row["certified"] for row in mine),
                    "weights per segment": spread((row["weights_per_segment"] for row in mine), ".0f"),
                    "segments": spread((row["segments"] for row in mine), ".0f"),
                    "fuel − optimum, kg": spread((row["fuel_error_kg"] for row in mine), "+.1e"),
                    "residual between nodes": spread(row["off_node_residual"] for row in mine),
                    "iterations of the split": spread((row["iterations"] for row in mine), ".0f"),
                    "CPU s, smoothed stages included": spread((row["cpu_s"] for row in mine), ".1f"),
                }
            )
    trained = [row for row in rows if row["method"].startswith("MLP")]
    measured = {
        "arcs/trained certified share": sum(row["certified"] for row in trained) / len(trained),
        "arcs/trained fuel error kg": worst(row["fuel_error_kg"] for row in trained if row["certified"]),
    }
    text = f"Seeds {seeds[0]}–{seeds[-1]}, three starts each at most; median [min, max].\n\n{markdown(table)}"
    return Report({"arcs": rows}, text, measured)
