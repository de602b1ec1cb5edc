"""Six methods on the quadrotor, the swarm over seeds, and two objectives of the swarm: losses beside true errors."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from experiments.receding_horizon.common import chebyshev, flown
from experiments.receding_horizon.quadrotor import displaced
from experiments.tables import Report, markdown, spread
from ponn_torch.ansatz.basis import Chebyshev, GaussianRBF
from ponn_torch.guidance.accuracy import by_boundary_value_solver, by_exponential
from ponn_torch.guidance.controllers import timetable
from ponn_torch.guidance.horizon import HorizonSolver
from ponn_torch.guidance.methods import Collocation, Method, Pseudospectral, RandomGaussians, TunedGaussians
from ponn_torch.guidance.plants.clohessy_wiltshire import clohessy_wiltshire
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.numerics.nodes import make_nodes

NODES = make_nodes("legendre_lobatto", 10).points
SWARM, HONEST = "X-TFC, swarm on the loss (paper)", "X-TFC, swarm on the off-node residual"
METHODS: dict[str, Method] = {
    "X-TFC, random Gaussians": RandomGaussians(),
    "X-TFC, uniform shape 1": Collocation(GaussianRBF(NODES, 1.0)),
    SWARM: TunedGaussians(),
    HONEST: TunedGaussians(objective="off_node_residual"),
    "TFC, Chebyshev": Collocation(Chebyshev(10, 1)),
    "IRPM (Radau)": Pseudospectral("legendre_radau"),
    "IGPM (Gauss)": Pseudospectral("legendre_gauss"),
    "ILPM (Lobatto)": Pseudospectral("legendre_lobatto"),
    "TFC, Chebyshev, 24 nodes": Collocation(Chebyshev(24, 1), n_nodes=24),
}
SEEDS = {SWARM: range(10), HONEST: range(3), "X-TFC, random Gaussians": range(3)}
PASSES = Passes(10, 1e-10)
N_STATES = 20


@dataclass(frozen=True)
class Questions:
    """States of one flight, and the controls that solve_bvp answers them with."""

    times: list[float]
    states: Tensor
    answers: Tensor


@cache
def _questions() -> Questions:
    problem = displaced(-10.0)
    flight, _, _ = flown(problem, chebyshev(24), Passes(10, 1e-10, second_order=True, warm_start=True), "stop")
    starts = timetable(problem, "stop").starts
    cycles = [round(i * (flight.n_cycles - 1) / (N_STATES - 1)) for i in range(N_STATES)]
    times, states = [starts[k] for k in cycles], flight.measured[cycles]
    fine = Planner(problem, chebyshev(24), Passes(12, 1e-9, second_order=True))
    return Questions(times, states, by_boundary_value_solver(fine, times, [problem.horizon] * N_STATES, states))


@dataclass(frozen=True)
class Found:
    """Of a solver: the largest loss and the state at the end of its own flight, errors on the common questions."""

    loss: float
    end: float
    residual: float
    errors: list[float]

    @property
    def median(self) -> float:
        return statistics.median(self.errors)


def _judge(problem: TrackingProblem, solver: HorizonSolver) -> Found:
    """The paper's figure is the loss along a method's own flight; true errors need states that an oracle can answer."""
    flight, _, _ = flown(problem, solver, PASSES, "stop")
    asked = _questions()
    planner = Planner(problem, solver, PASSES, traced=True)
    errors, residuals = [], []
    for start, state, answer in zip(asked.times, asked.states, asked.answers, strict=True):
        plan = planner.plan(start, state)
        error = float((plan.control - answer).norm() / answer.norm())
        errors.append(error if error == error else float("inf"))
        residuals.append(float(plan.solution.off_node_residual()))
    loss = float(flight.loss.nan_to_num(nan=torch.inf).max())
    return Found(loss, float(flight.errors[-1].norm()), statistics.median(residuals), errors)


def run_six() -> Report:
    """Each method flies; all answer the same questions: κ = 10, ε = 1e-10, against solve_bvp."""
    problem = displaced(-10.0)
    rows, single, measured = [], [], {"methods/oracle converged": float(_questions().answers.isfinite().all())}
    for name, method in METHODS.items():
        seeds = SEEDS.get(name, range(1))
        found = [_judge(problem, method.solver(problem, seed)) for seed in seeds]
        stays = [one for one in found if one.median < 1.0]

        def told(values: Iterable[float], form: str = ".1e", many: bool = len(found) > 1) -> str:
            return spread(values, form) if many else format(*values, form)

        rows.append(
            {
                "method": name,
                "seeds": len(found),
                "largest loss of its flight": told((one.loss for one in found), ".1e"),
                "off-node residual, median": told((one.residual for one in found), ".1e"),
                "u0 error, median": told((one.median for one in found), ".1e"),
                "largest": told((max(one.errors) for one in found), ".1e"),
                "‖error‖ at the end": told((one.end for one in found), ".2f"),
            }
        )
        measured |= {
            f"methods/{name} loss": statistics.median([one.loss for one in found]),
            f"methods/{name} u0": statistics.median([one.median for one in found]),
            f"methods/{name} converging share": len(stays) / len(found),
        }
        single += [
            {"method": name, "seed": seed, "loss": one.loss, "u0": one.median, "largest u0": max(one.errors)}
            for seed, one in zip(seeds, found, strict=True)
        ]
        print(rows[-1], flush=True)
    return Report({"methods": rows, "methods_by_seed": single}, markdown(rows), measured)


def run_swarm() -> Report:
    """500 iterations of 100 particles on the rendezvous with T = 100 s."""
    problem = clohessy_wiltshire(horizon=100.0)
    rows, measured = [], {}
    ways: dict[str, Method] = {
        "loss": TunedGaussians(),
        "off_node_residual": TunedGaussians(objective="off_node_residual"),
        "none (Chebyshev)": Collocation(Chebyshev(10, 1)),
    }
    for name, method in ways.items():
        began = time.process_time()
        solver = method.solver(problem, 0)
        seconds = time.process_time() - began
        planner = Planner(problem, solver, Passes(1))
        plan = planner.plan(0.0, problem.initial)
        truth = by_exponential(planner, [0.0], [problem.horizon], problem.initial[None])[0]
        error = float((plan.control - truth).norm() / truth.norm())
        rows.append(
            {
                "objective": name,
                "loss": f"{float(plan.solution.loss):.1e}",
                "off-node residual": f"{float(plan.solution.off_node_residual()):.1e}",
                "u0 error": f"{error:.1e}",
                "CPU s": f"{seconds:.1f}",
            }
        )
        measured |= {f"swarm/{name} seconds": seconds, f"swarm/{name} u0": error}
        measured[f"swarm/{name} loss"] = float(plan.solution.loss)
    return Report({"swarm": rows}, markdown(rows), measured)
