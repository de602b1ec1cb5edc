"""A control that nearly jumps: the landing smoothed by ρ = 1e-3, reached down a ladder from random starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from experiments.solves import fuel_by_mass
from experiments.tables import Report, Row, markdown, share, spread, worst
from ponn_torch.ansatz.basis import Chebyshev, FreeFunction, RandomFeatures
from ponn_torch.ansatz.networks import MLP, FrozenMLP
from ponn_torch.optim.base import Optimizer, Stopping
from ponn_torch.optim.chain import Chain, OutputLayer
from ponn_torch.optim.least_squares import GaussNewton, LevenbergMarquardt
from ponn_torch.optimal_control.discretisation import Form, Strong, Weak
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.continuation import Ladder, Phases, Schedule
from ponn_torch.solving.refinement import Refinement, Subdivide
from ponn_torch.solving.solver import Solver

STRONG = Strong()
FINAL = 1e-3
KNOWN_FUEL = 268.0148125646  # kg, of the landing smoothed by FINAL
SMOOTHINGS = (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, FINAL)
N_NODES = 120

STOPPING = Stopping(tolerance=1e-9, decrease=1e-2, max_iterations=60, hopeless=0.1, hopeless_after=60, cpu_seconds=2.0)
LINEAR = LevenbergMarquardt(STOPPING)
DEEP = Chain([LevenbergMarquardt(STOPPING, geodesic=True), OutputLayer(GaussNewton())])


def _ladder(form: Form) -> Schedule:
    """Strong where a failed start shows, then down in the given form."""
    return Phases([Ladder(SMOOTHINGS[:1], form=STRONG), Ladder(SMOOTHINGS[1:], form=form)])


@dataclass(frozen=True)
class Way:
    name: str
    free_function: Callable[[int], FreeFunction]
    optimizer: Optimizer = LINEAR
    form: Form = STRONG
    conditioning: str = "orthonormal"
    refinement: Refinement | None = None


def _mlp(seed: int) -> MLP:
    return MLP((20, 40), seed=seed)


def _frozen(seed: int) -> FrozenMLP:
    return FrozenMLP((20, 40), seed=seed)


METHODS = [
    Way("Chebyshev, L = 60", lambda seed: Chebyshev(60), conditioning="columns"),
    Way("Chebyshev, L = 60, weak", lambda seed: Chebyshev(60), form=Weak(1.0), conditioning="columns"),
    Way("ELM tanh, L = 60", lambda seed: RandomFeatures(60, "tanh", seed=seed)),
    Way("ELM tanh, L = 60, weak", lambda seed: RandomFeatures(60, "tanh", seed=seed), form=Weak(1.0)),
    Way("MLP 20-40", _mlp, DEEP),
    Way("the same, hidden layers untrained", _frozen),
    Way("MLP 20-40, weak", _mlp, DEEP, Weak(1.0)),
    Way("the same, hidden layers untrained, weak", _frozen, form=Weak(1.0)),
    Way(
        "Chebyshev, L = 30, then halved segments",
        lambda seed: Chebyshev(30),
        conditioning="columns",
        refinement=Subdivide(),
    ),
]


def solve(method: Way, seed: int) -> Row:
    problem = mars_landing()
    smoothings = SMOOTHINGS if method.refinement is None else (1.0, 0.3, 0.1, 0.03, 0.01, FINAL)
    ladder = _ladder(method.form) if method.refinement is None else Ladder(smoothings)
    solver = Solver(
        basis=method.free_function(seed),
        n_nodes=N_NODES,
        conditioning=method.conditioning,
        optimizer=method.optimizer,
        continuation=ladder,
        refinement=method.refinement,
        n_starts=5,
        trust=math.inf,
    )
    result = solver.solve(problem, seed)
    solution = result.solution
    missing = solution is None or solution.smoothing is None
    fuel = math.nan if missing else fuel_by_mass(solution)
    return {
        "method": method.name,
        "seed": seed,
        "certified": result.certified,
        "smoothing": math.nan if missing else solution.smoothing,
        "unknowns": math.nan if missing else solution.curve.collocation.n_unknowns,
        "fuel_error_kg": fuel - KNOWN_FUEL,
        "off_node_residual": math.nan if missing else solution.off_node_residual,
        "iterations": sum(stage.n_iterations for stage in result.stages),
        "residual_evaluations": sum(stage.n_residuals for stage in result.stages),
        "cpu_s": result.cpu_seconds,
        "message": result.message,
    }


def run(seeds: range) -> Report:
    rows: list[Row] = []
    for method in METHODS:
        for seed in seeds:
            row = solve(method, seed)
            rows.append(row)
            print(f"landing {method.name} seed {seed}: {row['fuel_error_kg']:+.2e} kg {row['cpu_s']:.1f} s", flush=True)
    table: list[Row] = []
    for method in METHODS:
        mine = [row for row in rows if row["method"] == method.name]
        reached = [row for row in mine if row["smoothing"] == FINAL]
        table.append(
            {
                "method": method.name,
                "unknowns": spread((row["unknowns"] for row in mine), ".0f"),
                "reach ρ = 1e-3": share(row["smoothing"] == FINAL for row in mine),
                "certified there": share(row["certified"] and row["smoothing"] == FINAL for row in mine),
                "fuel by mass − that of ρ = 1e-3, kg": spread((row["fuel_error_kg"] for row in reached), "+.1e"),
                "residual between nodes": spread(row["off_node_residual"] for row in reached),
                "residual evaluations": spread((row["residual_evaluations"] for row in mine), ".0f"),
                "CPU s": spread((row["cpu_s"] for row in mine), ".1f"),
            }
        )
    segments = [row for row in rows if row["method"] == METHODS[-1].name]
    measured = {
        "landing/segments fuel error kg": worst(row["fuel_error_kg"] for row in segments),
        "landing/MLP weak fuel error kg": worst(
            row["fuel_error_kg"] for row in rows if row["method"] == "MLP 20-40, weak"
        ),
    }
    text = f"Seeds {seeds[0]}–{seeds[-1]}; median [min, max]; {N_NODES} nodes.\n\n{markdown(table)}"
    return Report({"landing": rows}, text, measured)
