"""What the parts share: the paper's solver, sums along a flight, figures."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.guidance.closed_loop import Flight, fly
from ponn_torch.guidance.controllers import HorizonController, timetable
from ponn_torch.guidance.horizon import HorizonSolver
from ponn_torch.guidance.producers import Passes, Plan, Planner
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.numerics.nodes import make_nodes

RESULTS = Path(__file__).parent / "results"


def chebyshev(n_nodes: int = 10, route: str = "lu") -> HorizonSolver:
    return HorizonSolver(Chebyshev(n_nodes, 1), make_nodes("legendre_lobatto", n_nodes), route=route)


def in_units(values: Tensor, problem: TrackingProblem, what: str = "states") -> Tensor:
    """Values (..., components) in the units that people read."""
    return values / values.new_tensor([unit.size for unit in getattr(problem.plant, what).values()])


class Watched(HorizonController):
    """Keeps the plans."""

    def __init__(self, planner: Planner, problem: TrackingProblem, ending: str) -> None:
        super().__init__(planner, timetable(problem, ending))
        self.plans: list[Plan] = []

    def decide(self, cycle: int, x: Tensor):  # type: ignore[no-untyped-def]
        decision = super().decide(cycle, x)
        self.plans.append(decision.plan)
        return decision


def flown(
    problem: TrackingProblem, solver: HorizonSolver, passes: Passes, ending: str
) -> tuple[Flight, Watched, float]:
    """A flight, its plans, CPU seconds without the trace of derivatives."""
    planner = Planner(problem, solver, passes, traced=True)
    planner.plan(0.0, problem.initial)
    controller = Watched(planner, problem, ending)
    began = time.process_time()
    flight = fly(problem, controller, controller.table, problem.initial)
    return flight, controller, time.process_time() - began


def seconds_of(call: Callable[[], object], count: int = 300) -> tuple[float, float]:
    """CPU time of a call: median and first decile of many, after a few to warm up.

    On a shared machine other processes take the caches too, which the decile feels less.
    """
    for _ in range(10):
        call()
    spent = []
    for _ in range(count):
        began = time.process_time()
        call()
        spent.append(time.process_time() - began)
    spent.sort()
    return spent[count // 2], spent[count // 10]
