"""Quasi-Newton methods with a strong Wolfe line search on ½‖r‖²: L-BFGS, and the self-scaled Broyden family.

An iteration is a search direction and a line search, which takes one or more gradients. Where a search fails, what was
learnt of the curvature is forgotten; where steepest descent fails too, the method ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ponn_torch.optim.base import Status, Stopping
from ponn_torch.optim.checkpoint import Arrays
from ponn_torch.optim.driver import Counted, Move, restored
from ponn_torch.optim.gradient import GradientMethod
from ponn_torch.optim.line_search import Trial, strong_wolfe


def _quasi_newton_stopping() -> Stopping:
    return Stopping(decrease=1e-9, patience=10, max_iterations=2000)


def _searched(
    residual: Counted, state: Any, direction: Tensor, first: float
) -> tuple[Trial | None, Callable[[], Move]]:
    """The trial that the line search along a direction ends with, and a Move that tells of it."""
    tiny = torch.finfo(state.xi.dtype).tiny

    def evaluate(length: float) -> Trial:
        xi = state.xi + length * direction
        r, gradient = residual.gradient(xi)
        return Trial(length, 0.5 * float(r.square().sum()), float(gradient @ direction), xi, r, gradient)

    value, slope = 0.5 * float(state.r.square().sum()), float(state.gradient @ direction)
    start = Trial(0.0, value, slope, state.xi, state.r, state.gradient)
    found = strong_wolfe(evaluate, start, first) if slope < 0 else None

    def move() -> Move:
        length = first if found is None else found.length
        gained = 0.0 if found is None or value == 0 else 1.0 - found.value / value
        return Move(
            decrease=state.xi.new_tensor(gained),
            step=length * direction.norm() / state.xi.norm().clamp_min(tiny),
            damping=state.xi.new_tensor(1.0 / max(length, tiny)),
        )

    return found, move


def _first_length(gradient: Tensor) -> float:
    """A cautious first step along the gradient, whose size says nothing."""
    return min(1.0, 1.0 / float(gradient.norm().clamp_min(torch.finfo(gradient.dtype).tiny)))


def _failed(state: Any, move: Move, fresh: bool) -> tuple[Any, Move]:
    """After a search that failed: the end for steepest descent; a rejected step for anything better."""
    if not fresh:
        return state, Move(torch.full_like(move.decrease, torch.inf), move.step, move.damping)
    return state, Move(
        move.decrease, move.step, move.damping, {Status.LINE_SEARCH: torch.ones_like(move.decrease, dtype=torch.bool)}
    )


# -- limited memory --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LBFGSState:
    """Where L-BFGS stands: ξ, r and Jᵀr there, the last steps (k, N) and changes of the gradient (k, N)."""

    xi: Tensor
    r: Tensor
    gradient: Tensor
    steps: Tensor
    changes: Tensor


@dataclass(frozen=True)
class LBFGS(GradientMethod):
    """Limited-memory BFGS (Nocedal 1980): the last ``memory`` steps and changes of the gradient are its Hessian."""

    stopping: Stopping = field(default_factory=_quasi_newton_stopping)
    memory: int = 50

    def __post_init__(self) -> None:
        if self.memory < 1:
            raise ValueError(f"memory = {self.memory}; allowed: at least 1")

    def begin(self, residual: Counted, xi: Tensor) -> LBFGSState:
        r, gradient = residual.gradient(xi)
        return LBFGSState(xi, r, gradient, xi.new_zeros(0, len(xi)), xi.new_zeros(0, len(xi)))

    def step(self, residual: Counted, state: LBFGSState, running: Tensor) -> tuple[LBFGSState, Move]:
        fresh = len(state.steps) == 0
        direction = -_two_loops(state.gradient, state.steps, state.changes)
        found, move = _searched(residual, state, direction, _first_length(state.gradient) if fresh else 1.0)
        if found is None:
            forgotten = LBFGSState(state.xi, state.r, state.gradient, state.steps[:0], state.changes[:0])
            return _failed(forgotten, move(), fresh)
        step, change = found.xi - state.xi, found.gradient - state.gradient
        steps, changes = state.steps, state.changes
        if float(step @ change) > 1e-12 * float(step.norm() * change.norm()):
            steps = torch.cat([steps, step[None]])[-self.memory :]
            changes = torch.cat([changes, change[None]])[-self.memory :]
        return LBFGSState(found.xi, found.r, found.gradient, steps, changes), move()

    def restore(self, residual: Counted, arrays: Arrays, like: Tensor) -> LBFGSState:
        return restored(LBFGSState, arrays, like)


def _two_loops(gradient: Tensor, steps: Tensor, changes: Tensor) -> Tensor:
    """H g with the inverse Hessian H of the pairs (Nocedal & Wright 2006, alg. 7.4)."""
    if not len(steps):
        return gradient
    inverse = 1.0 / (steps * changes).sum(-1)
    out, shares = gradient, []
    for i in range(len(steps) - 1, -1, -1):
        shares.append(inverse[i] * (steps[i] @ out))
        out = out - shares[-1] * changes[i]
    out = out / (inverse[-1] * changes[-1].square().sum())
    for i in range(len(steps)):
        out = out + steps[i] * (shares.pop() - inverse[i] * (changes[i] @ out))
    return out


# -- self-scaled Broyden ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BroydenState:
    """Where SSBroyden stands: ξ, r and Jᵀr there, the inverse Hessian (N, N), and whether it is still the identity."""

    xi: Tensor
    r: Tensor
    gradient: Tensor
    inverse: Tensor
    fresh: bool


@dataclass(frozen=True)
class SSBroyden(GradientMethod):
    """Self-scaled Broyden: the inverse Hessian is scaled and its update chosen anew in every iteration.

    Urbán, Stefanou & Pons, J. Comput. Phys. 523 (2025) 113656, eq. 13–23. The inverse Hessian is a dense matrix, which
    bounds the number of unknowns.
    """

    stopping: Stopping = field(default_factory=_quasi_newton_stopping)
    max_unknowns: int = 4000

    def check(self, xi: Tensor) -> None:
        """ValueError for a batch of problems, or too many unknowns."""
        super().check(xi)
        if len(xi) > self.max_unknowns:
            raise ValueError(
                f"max_unknowns = {self.max_unknowns}, and there are {len(xi)}; allowed: fewer unknowns, a larger "
                "limit (the inverse Hessian is dense), or L-BFGS"
            )

    def begin(self, residual: Counted, xi: Tensor) -> BroydenState:
        r, gradient = residual.gradient(xi)
        return BroydenState(xi, r, gradient, torch.eye(len(xi), dtype=xi.dtype, device=xi.device), fresh=True)

    def step(self, residual: Counted, state: BroydenState, running: Tensor) -> tuple[BroydenState, Move]:
        direction = -(state.inverse @ state.gradient)
        found, move = _searched(residual, state, direction, _first_length(state.gradient) if state.fresh else 1.0)
        if found is None:
            unit = torch.eye(len(state.xi), dtype=state.xi.dtype, device=state.xi.device)
            return _failed(BroydenState(state.xi, state.r, state.gradient, unit, True), move(), state.fresh)
        step, change = found.xi - state.xi, found.gradient - state.gradient
        inverse, curvature = state.inverse, step @ change
        if float(curvature) > 1e-12 * float(step.norm() * change.norm()):
            if state.fresh:  # the identity knows no units: give it the size that the first step shows
                unit = curvature / change.square().sum()
                inverse, metric = unit * inverse, step.square().sum() / unit
            else:  # s = −αHg
                metric = -found.length * (step @ state.gradient)
            inverse = _self_scaled(inverse, step, change, metric)
        return BroydenState(found.xi, found.r, found.gradient, inverse, False), move()

    def restore(self, residual: Counted, arrays: Arrays, like: Tensor) -> BroydenState:
        return restored(BroydenState, arrays, like)


def _self_scaled(inverse: Tensor, step: Tensor, change: Tensor, metric: Tensor) -> Tensor:
    """H after a step s with change y of the gradient; ``metric`` is sᵀH⁻¹s."""
    curvature, hy = step @ change, inverse @ change
    yhy = change @ hy
    b, h = float(metric / curvature), float(yhy / curvature)
    a = max(h * b - 1.0, 0.0)  # ≥ 0 by Cauchy–Schwarz
    scale, theta = min(1.0, 1.0 / b), 0.0  # θ = 0 is BFGS, θ = 1 is DFP
    if a > 1e-12:
        least = min(1.0, h * (1.0 - (a / (1.0 + a)) ** 0.5))
        theta = max((least - 1.0) / a, min(1.0 / least, (1.0 - b) / b))
        sigma = 1.0 + theta * a
        shrink = sigma ** (-1.0 / (len(step) - 1)) if len(step) > 1 else 1.0
        scale = scale * min(shrink, 1.0 / theta) if theta > 0 else min(scale * shrink, sigma)
    mix = (1.0 - theta) / (1.0 + a * theta)
    between = yhy.sqrt() * (step / curvature - hy / yhy)
    updated = inverse - torch.outer(hy, hy / yhy) + mix * torch.outer(between, between)
    return updated / scale + torch.outer(step, step / curvature)
