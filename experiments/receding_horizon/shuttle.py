"""Shuttle entry: Monte Carlo of 500 runs by a gain schedule, its losses by one LU a cycle; the backward sweep."""

from __future__ import annotations

import time
from itertools import product

import torch
from torch import Tensor

from experiments.receding_horizon.common import RESULTS, chebyshev, in_units
from experiments.tables import Report, markdown
from ponn_torch.guidance.accuracy import by_sweep
from ponn_torch.guidance.closed_loop import fly
from ponn_torch.guidance.controllers import HorizonController, Timetable, gain_schedule, timetable
from ponn_torch.guidance.expansion import expand
from ponn_torch.guidance.oracles import riccati_sweep
from ponn_torch.guidance.plants.shuttle import shuttle
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.reporting.flight_figures import limits_figure, tracking_figure
from ponn_torch.reporting.style import save

N_RUNS = 500
FIRST = 200  # cycles, in which the heat rate peaks
EVERY = 25  # cycles between those of which the loss is taken


def _peaks(problem: TrackingProblem, planner: Planner, table: Timetable, starts: Tensor) -> float:
    """The largest heat rate in the first minutes, in which it peaks, over its limit."""
    first = Timetable(table.starts[:FIRST], table.durations[:FIRST])
    flight = fly(problem, gain_schedule(planner, first, with_loss=False), first, starts)
    return float(flight.limits()["heat rate"].max())


def run_monte_carlo() -> Report:
    problem = shuttle()
    table = timetable(problem, "stop")
    planner = Planner(problem, chebyshev(), Passes(1), traced=True)
    starts = problem.disperse(N_RUNS, torch.Generator().manual_seed(0))
    wall, began = time.perf_counter(), time.process_time()
    flight = fly(problem, gain_schedule(planner, table, with_loss=False), table, starts)
    seconds, wall = time.process_time() - began, time.perf_counter() - wall
    # the loss of horizons solved from where the vehicles were, one factorisation a cycle
    cycles = range(0, len(table.starts), EVERY)
    checked = Timetable([table.starts[k] for k in cycles], [table.durations[k] for k in cycles])
    controller = HorizonController(planner, checked)
    losses, differences = [], []
    for i, k in enumerate(cycles):
        decision = controller.decide(i, flight.states[k])
        losses.append(float(decision.loss.max()))
        differences.append(float((decision.control - flight.controls[k]).abs().max()))
    last = in_units(flight.errors[-1], problem).abs().amax(0).tolist()
    peaks = {name: float(values.max()) for name, values in flight.limits().items()}
    draws = [problem.disperse(N_RUNS, torch.Generator().manual_seed(seed)) for seed in range(8)]
    heat = torch.tensor([_peaks(problem, planner, table, drawn) for drawn in draws])
    start = problem.reference(torch.zeros((), dtype=torch.float64))[0]
    corners = torch.tensor(list(product((-1.0, 1.0), repeat=3)), dtype=torch.float64)
    nominal = fly(problem, gain_schedule(planner, table, with_loss=False), table, problem.initial)
    save(tracking_figure(nominal, flight), RESULTS / "shuttle_tracking.png", dpi=90)
    limits = limits_figure(nominal, flight)
    if limits is not None:
        save(limits, RESULTS / "shuttle_limits.png", dpi=90)
    measured = {
        "monte_carlo/runs": float(flight.states.shape[1]),
        "monte_carlo/final radius m": last[0],
        "monte_carlo/final speed m/s": last[1],
        "monte_carlo/heat rate": peaks["heat rate"],
        "monte_carlo/heat rate, median of eight draws": float(heat.median()),
        "monte_carlo/heat rate, smallest of eight draws": float(heat.min()),
        "monte_carlo/heat rate, largest errors": _peaks(problem, planner, table, start + corners * problem.dispersion),
        "monte_carlo/heat rate, no errors": _peaks(problem, planner, table, start[None]),
        "monte_carlo/loss": max(losses),
        "monte_carlo/schedule against horizons": max(differences),
        "monte_carlo/CPU seconds": seconds,
    }
    rows = [{"quantity": key.partition("/")[2], "value": f"{value:.6g}"} for key, value in measured.items()]
    rows.append({"quantity": "wall seconds", "value": f"{wall:.3g}"})
    return Report({"monte_carlo": rows}, markdown(rows), measured)


def _sweep(problem: TrackingProblem, n_nodes: int, starts: Tensor, x: Tensor) -> Tensor:
    """u0 (S, m) by one Runge–Kutta step between neighbouring Lobatto nodes, as the paper's backward sweep."""
    nodes = (make_nodes("legendre_lobatto", n_nodes).points + 1) / 2
    halves = torch.cat([nodes, (nodes[1:] + nodes[:-1]) / 2]).sort().values
    made = expand(problem, t := starts + halves[:, None] * problem.horizon, *problem.reference(t))

    def system(fraction: Tensor) -> tuple[Tensor, Tensor]:
        at = int((halves - fraction).abs().argmin())
        return made.matrix[at] * problem.horizon, made.drift[at] * problem.horizon

    zero = x.new_zeros(len(x), 3, 3)
    gain, rest = riccati_sweep(system, nodes, zero, zero[..., 0])
    y = torch.cat([x, (gain @ x.unsqueeze(-1)).squeeze(-1) + rest], -1)
    return (made.control_gain[0] @ y.unsqueeze(-1)).squeeze(-1) + made.control_offset[0]


def run_sweep() -> Report:
    """Every 20th horizon of the mission, from the reference's state plus the largest errors."""
    problem = shuttle()
    table = timetable(problem, "stop")
    picked = table.starts[::20]
    starts = torch.tensor(picked, dtype=torch.float64)
    x = problem.reference(starts)[0] + problem.dispersion
    truth = by_sweep(Planner(problem, chebyshev(), Passes(1)), picked, [problem.horizon] * len(picked), x)
    rows, measured = [], {}

    def report(name: str, found: Tensor) -> None:
        errors = ((found - truth).norm(dim=-1) / truth.norm(dim=-1)).nan_to_num(nan=torch.inf)
        failed = int((errors > 0.5).sum())
        rows.append(
            {
                "u0 by": name,
                "horizons that fail": f"{failed}/{len(picked)}",
                "u0 error, median": f"{float(errors.median()):.1e}",
                "largest": f"{float(errors.max()):.1e}",
            }
        )
        measured[f"sweep/{name} failed"] = float(failed)

    for n_nodes in (10, 31, 41):
        report(f"backward sweep, {n_nodes} nodes", _sweep(problem, n_nodes, starts, x))
    for n_nodes in (10, 31):
        planner = Planner(problem, chebyshev(n_nodes), Passes(1))
        plans = [planner.plan(start, state).control for start, state in zip(picked, x, strict=True)]
        report(f"Chebyshev, {n_nodes} nodes", torch.stack(plans))
    return Report({"sweep": rows}, markdown(rows), measured)
