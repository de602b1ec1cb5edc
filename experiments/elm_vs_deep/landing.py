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
from ponn_torch.solving.switch_neurons import SwitchNeurons

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
    Way("Chebyshev, L = 60 and switch neurons", lambda seed: Chebyshev(60), refinement=SwitchNeurons()),
    Way(
        "Chebyshev, L = 30, then halved segments",
        lambda seed: Chebyshev(30),
        conditioning="columns",
        refinement=Subdivide(),
    ),
]
NETWORKS = [
    Way("MLP 20-40", _mlp, DEEP),
    Way("the same, hidden layers untrained", _frozen),
    Way("MLP 20-40, weak", _mlp, DEEP, Weak(1.0)),
    Way("the same, hidden layers untrained, weak", _frozen, form=Weak(1.0)),
]


def _schedule(method: Way) -> Schedule:
    """A refinement goes down by itself: one that reads switches off a curve needs one that has them, no more."""
    if method.refinement is None:
        return _ladder(method.form)
    return Ladder(SMOOTHINGS[:3] if method.refinement.reads_arcs else (*SMOOTHINGS[:5], FINAL))


def solve(method: Way, seed: int) -> Row:
    problem = mars_landing()
    solver = Solver(
        basis=method.free_function(seed),
        n_nodes=N_NODES,
        conditioning=method.conditioning,
        optimizer=method.optimizer,
        continuation=_schedule(method),
        refinement=method.refinement,
        n_starts=5,
        trust=math.inf,
    )
    result = solver.solve(problem, seed)
    solution = result.solution
    missing = solution is None or solution.smoothing is None
    fuel = math.nan if missing else fuel_by_mass(solution)
    certificate = result.certificate
    flown = {name: math.nan if certificate is None else certificate.end_errors[name] for name in ("r", "v")}
    return {
        "method": method.name,
        "seed": seed,
        "certified": result.certified,
        "smoothing": math.nan if missing else solution.smoothing,
        "unknowns": math.nan if missing else solution.curve.collocation.n_unknowns,
        "fuel_error_kg": fuel - KNOWN_FUEL,
        "off_node_residual": math.nan if missing else solution.off_node_residual,
        "flown_end_r_m": flown["r"],
        "flown_end_v_m_per_s": flown["v"],
        "certificate_s": math.nan if certificate is None else certificate.seconds,
        "iterations": sum(stage.n_iterations for stage in result.stages),
        "residual_evaluations": sum(stage.n_residuals for stage in result.stages),
        "cpu_s": result.cpu_seconds,
        "message": result.message,
    }


def _report(name: str, methods: list[Way], seeds: range) -> Report:
    rows: list[Row] = []
    for method in methods:
        for seed in seeds:
            row = solve(method, seed)
            rows.append(row)
            print(f"landing {method.name} seed {seed}: {row['fuel_error_kg']:+.2e} kg {row['cpu_s']:.1f} s", flush=True)
    table: list[Row] = []
    for method in methods:
        mine = [row for row in rows if row["method"] == method.name]
        table.append(
            {
                "method": method.name,
                "unknowns": spread((row["unknowns"] for row in mine), ".0f"),
                "sharpest ρ kept": spread((row["smoothing"] for row in mine), "g"),
                "certified at it": share(row["certified"] for row in mine),
                "fuel by mass − that of ρ = 1e-3, kg": spread((row["fuel_error_kg"] for row in mine), "+.1e"),
                "residual between nodes": spread(row["off_node_residual"] for row in mine),
                "end of r flown, m": spread(row["flown_end_r_m"] for row in mine),
                "end of v flown, m/s": spread(row["flown_end_v_m_per_s"] for row in mine),
                "residual evaluations": spread((row["residual_evaluations"] for row in mine), ".0f"),
                "CPU s": spread((row["cpu_s"] for row in mine), ".1f"),
            }
        )
    measured = {
        f"{name}/{row['method']} fuel error kg": worst(r["fuel_error_kg"] for r in rows if r["method"] == row["method"])
        for row in table
    }
    text = f"Seeds {seeds[0]}–{seeds[-1]}; median [min, max]; {N_NODES} nodes.\n\n{markdown(table)}"
    return Report({name: rows}, text, measured)


def run(seeds: range) -> Report:
    return _report("landing", METHODS, seeds)


def run_networks(seeds: range) -> Report:
    return _report("landing_networks", NETWORKS, seeds)
