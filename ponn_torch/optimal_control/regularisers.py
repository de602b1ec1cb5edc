"""Regularisers: convex penalties on a bounded control that make its minimising law smooth.

With η ∈ [0, 1] the share of the control's range, η(S, ρ) minimises −S η + ρ e(η).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor


@runtime_checkable
class Regulariser(Protocol):
    """A convex penalty e(η) on [0, 1] and the law η(S, ρ) that it induces."""

    def fraction(self, switching: Tensor, smoothing: Tensor) -> Tensor: ...

    def penalty(self, fraction: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Entropy:
    """e = ½[η ln 2η + (1−η) ln 2(1−η)], so η = ½(1 + tanh(S/ρ)): the tanh law (PoNN paper, eq. 44–45).

    The constant ½ ln 2 in it makes e ≥ 0: with a free final time a negative e would pay for every second of part
    throttle, and the cheapest way to land would be to hover.
    """

    def fraction(self, switching: Tensor, smoothing: Tensor) -> Tensor:
        return 0.5 * (1.0 + torch.tanh(switching / smoothing))

    def penalty(self, fraction: Tensor) -> Tensor:
        rest = 1.0 - fraction
        return 0.5 * (torch.xlogy(fraction, 2.0 * fraction) + torch.xlogy(rest, 2.0 * rest))


@dataclass(frozen=True)
class Quadratic:
    """e = η² − η, so η = ½(1 + S/ρ) clipped: the energy → fuel homotopy at ρ = 1 → 0 (Bertrand and Epenoy)."""

    def fraction(self, switching: Tensor, smoothing: Tensor) -> Tensor:
        return (0.5 * (1.0 + switching / smoothing)).clamp(0.0, 1.0)

    def penalty(self, fraction: Tensor) -> Tensor:
        return fraction * (fraction - 1.0)


@dataclass(frozen=True)
class Logarithmic:
    """e = −ln η − ln(1−η): a barrier that keeps the control off both bounds (Bertrand and Epenoy)."""

    def fraction(self, switching: Tensor, smoothing: Tensor) -> Tensor:
        root = torch.sqrt(switching * switching + 4.0 * smoothing * smoothing)
        # two forms of the same root of the quadratic, each free of cancellation on its side
        return torch.where(
            switching > 0,
            1.0 - 2.0 * smoothing / (root + switching + 2.0 * smoothing),
            2.0 * smoothing / (root - switching + 2.0 * smoothing),
        )

    def penalty(self, fraction: Tensor) -> Tensor:
        return -torch.log(fraction) - torch.log1p(-fraction)


REGULARISERS: dict[str, Callable[[], Regulariser]] = {
    "entropy": Entropy,
    "quadratic": Quadratic,
    "logarithmic": Logarithmic,
}


def make_regulariser(name: str) -> Regulariser:
    """A regulariser by its name, one of REGULARISERS.

    Raises:
        ValueError: an unknown name.
    """
    if name not in REGULARISERS:
        close = get_close_matches(str(name), REGULARISERS, n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise ValueError(f"regulariser = {name!r}; allowed: {', '.join(REGULARISERS)}{hint}")
    return REGULARISERS[name]()
