"""One horizon solved: passes of a linear solver until state and control agree with what they were expanded around."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial

import torch
from torch import Tensor

from ponn_torch.guidance.expansion import Expansion, expand, table
from ponn_torch.guidance.horizon import HorizonSolution, HorizonSolver, LinearTPBVP
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.numerics.nodes import interpolation_matrix
from ponn_torch.numerics.tape import taped


@dataclass(frozen=True)
class Passes:
    """How a nonlinear horizon is iterated: at most ``most``, until ‖x − x̄‖ at the nodes is below ``tolerance``.

    second_order: Newton's method on the state–costate system instead of quasi-linearisation. most = 1 is LQ tracking
    around the guess. warm_start: begin with the last plan, shifted by a cycle, instead of the reference.

    Raises ValueError for most < 1 or a tolerance that is not positive.
    """

    most: int = 10
    tolerance: float = 1e-6
    second_order: bool = False
    warm_start: bool = False

    def __post_init__(self) -> None:
        if self.most < 1:
            raise ValueError(f"most = {self.most}; allowed: at least 1")
        if not self.tolerance > 0:
            raise ValueError(f"tolerance = {self.tolerance}; allowed: above 0")


@dataclass(frozen=True, eq=False)
class Plan:
    """States, costates and controls over a horizon, and how they were found.

    start, duration: of the horizon, in the plant's time. points: (k,) on [−1, 1], the first is −1; states, costates
    (..., k, n), controls (..., k, m) there. passes: how many were made. changes: ‖x − x̄‖ of each pass, (...,).
    """

    start: float
    duration: float
    points: Tensor
    states: Tensor
    costates: Tensor
    controls: Tensor
    solution: HorizonSolution
    changes: list[Tensor] = field(default_factory=list)

    @property
    def passes(self) -> int:
        return len(self.changes)

    @property
    def control(self) -> Tensor:
        """u (..., m) at the start."""
        return self.controls[..., 0, :]

    @property
    def finite(self) -> bool:
        return bool(self.controls.isfinite().all())

    @property
    def end(self) -> float:
        return self.start + self.duration

    def at(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """States, costates and controls (..., k, ·) at times (k,), held after the end."""
        z = (2 * (t - self.start) / self.duration - 1).clamp(-1.0, 1.0)
        between = interpolation_matrix(self.points, z)
        return between @ self.states, between @ self.costates, between @ self.controls


@dataclass(frozen=True, eq=False)
class Planner:
    """Plans horizons of a tracking problem on one solver.

    traced: whether derivatives are traced at the first use of a shape (a second), which then saves half of a pass.
    """

    problem: TrackingProblem
    solver: HorizonSolver
    passes: Passes = Passes()
    traced: bool = False
    _tables: dict[tuple[torch.Size, bool], Callable[..., Tensor]] = field(default_factory=dict, init=False, repr=False)

    @property
    def affine(self) -> bool:
        """Whether plans are affine in the state that they start from: one pass, or a linear plant."""
        return self.passes.most == 1 or self.problem.plant.linear

    def expand(self, t: Tensor, x: Tensor, u: Tensor, costates: Tensor) -> Expansion:
        """Around a guess; by a trace of the derivatives where that was asked for."""
        second = self.passes.second_order
        arguments = (t, x, u, costates) if second else (t, x, u)
        if not self.traced:
            return expand(self.problem, *arguments)
        key = (x.shape, second)
        if key not in self._tables:
            self._tables[key] = taped(partial(table, self.problem), *arguments)
        return Expansion(self._tables[key](*arguments))

    @cached_property
    def points(self) -> Tensor:
        """The nodes, after −1 where that is not one of them."""
        nodes = self.solver.nodes.points
        return nodes if nodes[0] == -1.0 else torch.cat([nodes.new_tensor([-1.0]), nodes])

    def times(self, start: Tensor, duration: Tensor) -> Tensor:
        """Of the points, (..., k), for starts and durations (...)."""
        return start.unsqueeze(-1) + (self.points + 1) * (duration / 2).unsqueeze(-1)

    def linear(self, expansion: Expansion, start: Tensor, duration: Tensor, initial: Tensor) -> LinearTPBVP:
        """The boundary value problem of an expansion at the points."""
        n_nodes, problem = len(self.solver.nodes), self.problem
        return LinearTPBVP(
            expansion.matrix[..., -n_nodes:, :, :],
            expansion.drift[..., -n_nodes:, :],
            duration,
            initial,
            problem.terminal_weight,
            problem.terminal_offset(start + duration),
        )

    def plan(self, start: float, initial: Tensor, duration: float | None = None, last: Plan | None = None) -> Plan:
        """From x0 (..., n) at a time; ``last`` is where a warm start begins."""
        problem, passes, points = self.problem, self.passes, self.points
        duration = problem.horizon if duration is None else duration
        begin, length = (points.new_tensor(value) for value in (start, duration))
        t = self.times(begin, length)
        if last is not None and passes.warm_start and last.finite:
            x, costates, u = last.at(t)
        else:
            x, u = problem.reference(t)
            costates = torch.zeros_like(x)
        changes: list[Tensor] = []
        for _ in range(passes.most):
            expansion = self.expand(t, x, u, costates)
            solution = self.solver.solve(self.linear(expansion, begin, length, initial))
            y = solution.at_nodes if len(points) == len(self.solver.nodes) else solution.values(points)
            before = x
            x, costates = y.chunk(2, dim=-1)
            u = expansion.control(y)
            changes.append(torch.linalg.vector_norm(x - before, dim=(-2, -1)))
            if not bool((changes[-1] > passes.tolerance).any()) or not bool(changes[-1].isfinite().all()):
                break
        return Plan(start, duration, points, x, costates, u, solution, changes)

    def cost(self, plan: Plan) -> Tensor:
        """The horizon's cost (...,) by the quadrature of the nodes, without the terminal term."""
        n_nodes = len(self.solver.nodes)
        start, duration = (self.points.new_tensor(value) for value in (plan.start, plan.duration))
        t = self.times(start, duration)[-n_nodes:]
        running = self.problem.running_cost(t, plan.states[..., -n_nodes:, :], plan.controls[..., -n_nodes:, :])
        return plan.duration / 2 * (running @ self.solver.nodes.weights)
