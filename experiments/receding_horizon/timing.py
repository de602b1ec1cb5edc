"""CPU time of one horizon by each route, of cached ones, and of schedules, beside the paper's means."""

from __future__ import annotations

import torch

from experiments.receding_horizon.common import chebyshev, seconds_of
from experiments.tables import Report, markdown
from ponn_torch.guidance.elimination import ROUTES
from ponn_torch.guidance.expansion import expand
from ponn_torch.guidance.plants.clohessy_wiltshire import clohessy_wiltshire
from ponn_torch.guidance.plants.shuttle import shuttle
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.tracking import TrackingProblem

PAPER = {10: 1.209, 12: 1.513, 15: 1.977, 20: 2.829, 50: 13.158}  # ms, means, rendezvous
PAPER_SHUTTLE = {10: 0.662, 31: 2.149}
BATCH = 10_000


def _given(problem: TrackingProblem, planner: Planner):  # type: ignore[no-untyped-def]
    start, duration = torch.zeros((), dtype=torch.float64), torch.tensor(problem.horizon, dtype=torch.float64)
    t = planner.times(start, duration)
    return planner.linear(expand(problem, t, *problem.reference(t)), start, duration, problem.initial)


def run() -> Report:
    rows, measured = [], {}
    for problem, paper in ((clohessy_wiltshire(horizon=100.0), PAPER), (shuttle(), PAPER_SHUTTLE)):
        for n_nodes, theirs in paper.items():
            name, times = f"{problem.plant.name} N = {n_nodes}", {}
            count = 300 if n_nodes <= 20 else 30
            for route in ROUTES:
                solver = chebyshev(n_nodes, route)
                given = _given(problem, Planner(problem, solver))
                times[route] = seconds_of(lambda: solver.solve(given), count)  # noqa: B023
            solver = chebyshev(n_nodes)
            planner = Planner(problem, solver, Passes(1), traced=True)
            given = _given(problem, planner)
            factored = solver.factor(given)
            affine, vehicle = factored.affine(), problem.initial[None]
            times["cached LU"] = seconds_of(lambda: factored.solve(given), count)  # noqa: B023
            times["cached gain, all coefficients"] = seconds_of(lambda: affine.coefficients(vehicle), count)  # noqa: B023
            times["expansion and LU (a cycle)"] = seconds_of(lambda: planner.plan(0.0, problem.initial), count)  # noqa: B023
            row = {"horizon": name}
            row |= {f"{key}, ms": f"{1e3 * middle:.3f} ({1e3 * low:.3f})" for key, (middle, low) in times.items()}
            row |= {"paper, ms": theirs, "paper / LU": f"{theirs / (1e3 * times['lu'][0]):.1f}"}
            rows.append(row)
            measured |= {f"timing/{name} {key} ms": 1e3 * middle for key, (middle, _) in times.items()}
            measured |= {f"timing/{name} {key} ms, first decile": 1e3 * low for key, (_, low) in times.items()}
            if n_nodes == 10 and problem.plant.linear:
                vehicles = problem.initial + 1e-3 * torch.rand(BATCH, 6, dtype=torch.float64)
                seconds, _ = seconds_of(lambda: affine.coefficients(vehicles), 20)  # noqa: B023
                measured["timing/schedule, all coefficients, solves per second"] = BATCH / seconds
                matrix, offset = affine.values(planner.points[:1])
                first, _ = seconds_of(lambda: vehicles @ matrix[0].mT + offset[0], 20)  # noqa: B023
                measured["timing/schedule, first values only, solves per second"] = BATCH / first
    batch = [
        {"batch of 10 000": key.partition(", ")[2], "per second": f"{value:.3g}"}
        for key, value in measured.items()
        if key.endswith("per second")
    ]
    return Report({"timing": rows}, markdown(rows) + "\n\n" + markdown(batch), measured)
