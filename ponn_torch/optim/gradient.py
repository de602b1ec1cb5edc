"""Adam on the loss ½‖r‖² of the residual that least squares see; its gradient is Jᵀr."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ponn_torch.optim.base import Stopping
from ponn_torch.optim.checkpoint import Arrays
from ponn_torch.optim.driver import Counted, Driven, Move, restored
from ponn_torch.optim.weighted import BALANCES


class GradientMethod(Driven):
    """Gradient methods solve one problem at a time."""

    def check(self, xi: Tensor) -> None:
        if xi.dim() != 1:
            raise ValueError(
                f"xi has shape {tuple(xi.shape)}; gradient methods solve one problem, shape (N,), at a time"
            )


# -- schedules: factor of the learning rate at a share of all iterations, ``last`` at its end -------------------------


def constant(share: float, last: float) -> float:
    return 1.0


def cosine(share: float, last: float) -> float:
    return last + (1.0 - last) * 0.5 * (1.0 + math.cos(math.pi * share))


def exponential(share: float, last: float) -> float:
    return last**share


SCHEDULES: dict[str, Callable[[float, float], float]] = {
    "constant": constant,
    "cosine": cosine,
    "exponential": exponential,
}


# -- Adam ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AdamState:
    """Where Adam stands: ξ, r, JᵀW²r, W, both moments and their age, and what is left of the learning rate."""

    xi: Tensor
    r: Tensor
    gradient: Tensor
    weights: Tensor
    mean: Tensor
    square: Tensor
    age: int
    iteration: int
    caution: float


@dataclass(frozen=True)
class Adam(GradientMethod):
    """Adam (Kingma & Ba 2015) with a schedule over the iteration limit.

    A step that is not finite is taken back: the moments start anew and the learning rate is halved for good.

    Attributes:
        rate: learning rate at the start. schedule: one of SCHEDULES, from ``rate`` to ``rate·last``.
        memory, square_memory: decay of the first and second moment.
        balance: one of BALANCES, which weighs the equations anew every ``balance_every`` iterations.
    """

    stopping: Stopping = field(default_factory=lambda: Stopping(decrease=0.0, max_iterations=5000))
    rate: float = 1e-2
    schedule: str = "cosine"
    last: float = 1e-2
    memory: float = 0.9
    square_memory: float = 0.999
    epsilon: float = 1e-8
    balance: str = "none"
    balance_every: int = 100

    def __post_init__(self) -> None:
        if self.schedule not in SCHEDULES:
            raise ValueError(f"schedule = {self.schedule!r}; allowed: {', '.join(SCHEDULES)}")
        if self.balance not in BALANCES:
            raise ValueError(f"balance = {self.balance!r}; allowed: {', '.join(BALANCES)}")
        if self.balance_every < 1:
            raise ValueError(f"balance_every = {self.balance_every}; allowed: at least 1")
        for name in ("rate", "last", "epsilon"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)}; allowed: a positive number")
        for name in ("memory", "square_memory"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} = {getattr(self, name)}; allowed: from 0 to below 1")

    def begin(self, residual: Counted, xi: Tensor) -> AdamState:
        r, gradient = residual.gradient(xi)
        zero = torch.zeros_like(xi)
        return AdamState(xi, r, gradient, torch.ones_like(r), zero, zero, age=0, iteration=0, caution=1.0)

    def step(self, residual: Counted, state: AdamState, running: Tensor) -> tuple[AdamState, Move]:
        if self.balance != "none" and state.iteration % self.balance_every == 0:
            weights = BALANCES[self.balance](residual, state.xi, state.r)
            state = replace(state, weights=weights, gradient=residual.gradient(state.xi, weights)[1])
        age, iteration = state.age + 1, state.iteration + 1
        share = min(state.iteration / max(self.stopping.max_iterations - 1, 1), 1.0)
        rate = self.rate * state.caution * SCHEDULES[self.schedule](share, self.last)
        mean = self.memory * state.mean + (1 - self.memory) * state.gradient
        square = self.square_memory * state.square + (1 - self.square_memory) * state.gradient.square()
        spread = (square / (1 - self.square_memory**age)).sqrt() + self.epsilon
        step = -rate / (1 - self.memory**age) * mean / spread
        xi = state.xi + step
        r, gradient = residual.gradient(xi, state.weights)
        before, after = state.r.square().sum(), r.square().sum()
        if bool(torch.isfinite(after) & torch.isfinite(gradient).all()):
            following = AdamState(xi, r, gradient, state.weights, mean, square, age, iteration, state.caution)
        else:
            zero = torch.zeros_like(xi)
            following = replace(state, mean=zero, square=zero, age=0, iteration=iteration, caution=0.5 * state.caution)
        # a noisy descent is no sign of an end: only what falls counts as a decrease, and nothing as a small one
        move = Move(
            decrease=((before - after) / before).nan_to_num(0.0).clamp_min(0.0),
            step=step.norm() / state.xi.norm().clamp_min(torch.finfo(xi.dtype).tiny),
            damping=xi.new_tensor(1.0 / rate),
        )
        return following, move

    def restore(self, residual: Counted, arrays: Arrays, like: Tensor) -> AdamState:
        return restored(AdamState, arrays, like)
