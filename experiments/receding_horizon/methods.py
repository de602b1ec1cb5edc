"""Six methods on the quadrotor, and two objectives of the swarm: the loss beside the true error of the control."""

from __future__ import annotations

import time

import torch

from experiments.receding_horizon.common import chebyshev, flown
from experiments.receding_horizon.quadrotor import displaced
from experiments.tables import Report, markdown
from ponn_torch.ansatz.basis import Chebyshev, GaussianRBF
from ponn_torch.guidance.accuracy import by_boundary_value_solver, by_exponential
from ponn_torch.guidance.controllers import timetable
from ponn_torch.guidance.methods import Collocation, Method, Pseudospectral, RandomGaussians, TunedGaussians
from ponn_torch.guidance.plants.clohessy_wiltshire import clohessy_wiltshire
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.numerics.nodes import make_nodes

NODES = make_nodes("legendre_lobatto", 10).points
METHODS: dict[str, Method] = {
    "X-TFC, random Gaussians": RandomGaussians(),
    "X-TFC, uniform shape 1": Collocation(GaussianRBF(NODES, 1.0)),
    "X-TFC, swarm on the loss (paper)": TunedGaussians(),
    "X-TFC, swarm on the off-node residual": TunedGaussians(objective="off_node_residual"),
    "TFC, Chebyshev": Collocation(Chebyshev(10, 1)),
    "IRPM (Radau)": Pseudospectral("legendre_radau"),
    "IGPM (Gauss)": Pseudospectral("legendre_gauss"),
    "ILPM (Lobatto)": Pseudospectral("legendre_lobatto"),
    "TFC, Chebyshev, 24 nodes": Collocation(Chebyshev(24, 1), n_nodes=24),
}
N_STATES = 20


def run_six() -> Report:
    """All methods answer the same questions: states of one flight, κ = 10, ε = 1e-10, against solve_bvp."""
    problem = displaced(-10.0)
    flight, _, _ = flown(problem, chebyshev(24), Passes(10, 1e-10, second_order=True, warm_start=True), "stop")
    starts = timetable(problem, "stop").starts
    cycles = [round(i * (flight.n_cycles - 1) / (N_STATES - 1)) for i in range(N_STATES)]
    states, lengths = flight.measured[cycles], [problem.horizon] * N_STATES
    times = [starts[k] for k in cycles]
    fine = Planner(problem, chebyshev(24), Passes(12, 1e-9, second_order=True))
    truth = by_boundary_value_solver(fine, times, lengths, states)
    rows, measured = [], {"methods/oracle converged": float(truth.isfinite().all())}
    for name, method in METHODS.items():
        planner = Planner(problem, method.solver(problem, 0), Passes(10, 1e-10), traced=True)
        losses, errors, residuals = [], [], []
        for start, state, answer in zip(times, states, truth, strict=True):
            plan = planner.plan(start, state)
            losses.append(float(plan.solution.loss))
            residuals.append(float(plan.solution.off_node_residual()))
            error = float((plan.control - answer).norm() / answer.norm())
            errors.append(error if error == error else float("inf"))
        middle = float(torch.tensor(errors).median())
        rows.append(
            {
                "method": name,
                "largest loss": f"{max(losses):.1e}",
                "off-node residual, median": f"{float(torch.tensor(residuals).median()):.1e}",
                "u0 error, median": f"{middle:.1e}",
                "largest": f"{max(errors):.1e}",
            }
        )
        measured |= {f"methods/{name} loss": max(losses), f"methods/{name} u0": middle}
    return Report({"methods": rows}, markdown(rows), measured)


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
