"""A step length by the strong Wolfe conditions (Nocedal & Wright, Numerical Optimization, 2006, alg. 3.5 and 3.6).

A trial that is not finite counts as too long, so that a search never leaves the region where the function is defined.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Trial:
    """A point ξ + α p: value and slope along p as numbers, and what was evaluated there."""

    length: float
    value: float
    slope: float
    xi: Tensor
    r: Tensor
    gradient: Tensor

    @property
    def finite(self) -> bool:
        return math.isfinite(self.value) and math.isfinite(self.slope)


def strong_wolfe(
    evaluate: Callable[[float], Trial],
    start: Trial,
    first: float,
    *,
    decrease: float = 1e-4,
    curvature: float = 0.9,
    max_trials: int = 25,
) -> Trial | None:
    """A trial below start.value + decrease·α·slope with |slope| ≤ curvature·|start.slope|; None if nothing is lower.

    ``start`` is α = 0, with a negative slope; ``first`` is the first α. After ``max_trials`` evaluations the lowest
    trial found is taken.
    """

    def sufficient(trial: Trial) -> bool:
        return trial.finite and trial.value <= start.value + decrease * trial.length * start.slope

    def flat(trial: Trial) -> bool:
        return abs(trial.slope) <= -curvature * start.slope

    low, high, length = start, None, first
    for _ in range(max_trials):
        trial = evaluate(length)
        if not sufficient(trial) or (low is not start and trial.value >= low.value):
            high = trial
        elif flat(trial):
            return trial
        else:
            if high is not None:
                if trial.slope * (high.length - low.length) >= 0:
                    high = low
            elif trial.slope >= 0:
                high = low
            low = trial
        if high is None:
            length = 3.0 * low.length
        else:
            length = _between(low, high)
            if abs(high.length - low.length) <= 1e-12 * max(high.length, low.length):
                break
    return low if low.value < start.value else None


def _between(low: Trial, high: Trial) -> float:
    """The minimum of the cubic through two trials, kept away from both; their middle where there is none."""
    width = high.length - low.length
    middle = low.length + 0.5 * width
    if not high.finite:
        return low.length + 0.25 * width
    mixed = low.slope + high.slope - 3 * (low.value - high.value) / (low.length - high.length)
    root = mixed * mixed - low.slope * high.slope
    if root < 0:
        return middle
    distance = math.copysign(math.sqrt(root), width)
    below = high.slope - low.slope + 2 * distance
    if below == 0:
        return middle
    length = high.length - width * (high.slope + distance - mixed) / below
    least, most = sorted((low.length + 0.1 * width, high.length - 0.1 * width))
    return min(max(length, least), most) if math.isfinite(length) else middle
