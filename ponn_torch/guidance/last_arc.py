"""Thrust on the last arc of a descent, where an optimal plan has no freedom left.

An optimal plan uses its whole bound there, so errors are corrected by another law, within what the engines can do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ponn_torch.guidance.replanning import Fleet


@dataclass(frozen=True, eq=False)
class Engines:
    """What the law may rely on: the acceleration (1, 3) without thrust, and the engines' bounds, N."""

    gravity: Tensor
    low: float
    high: float


class LinearAcceleration:
    """The target at the planned time with an acceleration linear in time, divided by what the engines have given.

    a(τ) = −6 r/T² − 4 v/T + τ (12 r/T³ + 6 v/T²) for T to go, for B landers.
    """

    def __init__(self, count: int, engines: Engines) -> None:
        self._engines = engines
        self._constant, self._slope = torch.zeros(2, count, 3, dtype=torch.float64)
        self._since = torch.zeros(count, 1, dtype=torch.float64)
        self._commanded = torch.zeros(count, 3, dtype=torch.float64)  # what the commands should have given, m/s
        self._first: Tensor | None = None
        self.factor = torch.ones(count, 1, dtype=torch.float64)

    def measured(self, x: Tensor, t: float, left: Tensor, heard: Tensor) -> None:
        """States (B, 7) with times ``left`` (B,) to go, for the landers that still listen (B,)."""
        self._first = x[:, 3:6] if self._first is None else self._first
        given, wanted = x[:, 3:6] - self._first - t * self._engines.gravity, self._commanded
        size = wanted.square().sum(-1, keepdim=True)
        # below 20 m/s the noise of two measurements says as little as the engines' tolerance
        factor = torch.where(size > 400.0, (given * wanted).sum(-1, keepdim=True) / size.clamp_min(1.0), 1.0)
        r, v, T = x[:, :3], x[:, 3:6], left[:, None]
        listening = heard[:, None]
        self.factor = torch.where(listening, factor, self.factor)
        self._constant = torch.where(listening, -6 * r / T**2 - 4 * v / T, self._constant)
        self._slope = torch.where(listening, 12 * r / T**3 + 6 * v / T**2, self._slope)
        self._since = torch.where(listening, t, self._since)

    def flown(self, h: Tensor, thrust: Tensor, mass: Tensor) -> None:
        """Take note of a step h (B, 1) under commands (B, 3, 3) at its beginning, middle and end."""
        self._commanded = self._commanded + h / 6 * (thrust[:, 0] + 4 * thrust[:, 1] + thrust[:, 2]) / mass

    def thrust(self, fleet: Fleet, t: Tensor, mass: Tensor) -> Tensor:
        """N (B, m, 3) at times (B, m), within the engines' bounds: the one of their middle for all of them."""
        middle = t.mean(-1, keepdim=True)
        wanted = mass * (self._constant + (middle - self._since) * self._slope - self._engines.gravity) / self.factor
        size = wanted.norm(dim=-1, keepdim=True)
        bounded = wanted * size.clamp(self._engines.low, self._engines.high) / size.clamp_min(1e-9)
        return bounded.unsqueeze(1).expand(-1, t.shape[-1], -1)


class PlannedThrust(LinearAcceleration):
    """The last plan's thrust, to its end: what the last arc is without a law of its own."""

    def thrust(self, fleet: Fleet, t: Tensor, mass: Tensor) -> Tensor:
        return fleet.thrust(t)


LAST_ARCS: dict[str, Callable[[int, Engines], LinearAcceleration]] = {
    "linear_acceleration": LinearAcceleration,
    "plan": PlannedThrust,
}
