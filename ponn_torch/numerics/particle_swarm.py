"""Particle swarm optimisation with a constriction factor (Clerc and Kennedy), all particles evaluated at once.

Algorithm 1 of [3]: velocities are K (v + ζ1 r1 (own best − position) + ζ2 r2 (swarm's best − position)) within a speed
limit, positions stay in a box, and K = 2/|2 − s − √(s² − 4s)|, s = ζ1 + ζ2, shrinks by a factor every iteration.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class SwarmResult:
    """The best position (d,), its cost, and the best cost after every iteration, from the start on."""

    best: Tensor
    cost: float
    history: list[float]


@dataclass(frozen=True)
class ParticleSwarm:
    """Minimises a cost over the box [lower, upper]^d; defaults are Table 1 of [3].

    own_pull, swarm_pull: ζ1, ζ2, together above 4. shrinkage: of K per iteration. speed: largest step per coordinate.

    Raises ValueError for an empty box, no particles, pulls that sum to 4 or less.
    """

    n_particles: int = 100
    n_iterations: int = 500
    own_pull: float = 2.1
    swarm_pull: float = 2.1
    shrinkage: float = 0.996
    lower: float = 0.0
    upper: float = 5.0
    speed: float = 0.1

    def __post_init__(self) -> None:
        if self.n_particles < 1 or self.n_iterations < 0:
            raise ValueError(
                f"n_particles = {self.n_particles}, n_iterations = {self.n_iterations}; allowed: at least 1 and 0"
            )
        if not self.lower < self.upper:
            raise ValueError(f"lower = {self.lower}; allowed: below upper = {self.upper}")
        if not self.own_pull + self.swarm_pull > 4:
            raise ValueError(f"own_pull = {self.own_pull}; allowed: above 4 − swarm_pull = {4 - self.swarm_pull:g}")

    @property
    def constriction(self) -> float:
        """K at the start."""
        s = self.own_pull + self.swarm_pull
        return 2.0 / abs(2.0 - s - math.sqrt(s * s - 4.0 * s))

    def minimise(
        self,
        cost: Callable[[Tensor], Tensor],
        dimension: int,
        generator: torch.Generator,
        *,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> SwarmResult:
        """cost: (P, d) → (P,); a particle whose cost is not a number costs infinity. Draws are made on the CPU."""

        def draw(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, dtype=torch.float64).to(device=device, dtype=dtype)

        def evaluate(positions: Tensor) -> Tensor:
            return torch.nan_to_num(cost(positions), nan=math.inf, posinf=math.inf)

        count, factor = self.n_particles, self.constriction
        position = self.lower + (self.upper - self.lower) * draw(count, dimension)
        velocity = self.speed * (2.0 * draw(count, dimension) - 1.0)
        own, own_cost = position, evaluate(position)
        leader = own_cost.argmin()
        best, best_cost = own[leader], own_cost[leader]
        history = [float(best_cost)]
        for _ in range(self.n_iterations):
            factor *= self.shrinkage
            to_own, to_best = self.own_pull * draw(count, 1), self.swarm_pull * draw(count, 1)
            velocity = factor * (velocity + to_own * (own - position) + to_best * (best - position))
            velocity = velocity.clamp(-self.speed, self.speed)
            position = (position + velocity).clamp(self.lower, self.upper)
            found = evaluate(position)
            better = found < own_cost
            own = torch.where(better.unsqueeze(-1), position, own)
            own_cost = torch.where(better, found, own_cost)
            leader = own_cost.argmin()
            best, best_cost = own[leader], own_cost[leader]
            history.append(float(best_cost))
        return SwarmResult(best, float(best_cost), history)
