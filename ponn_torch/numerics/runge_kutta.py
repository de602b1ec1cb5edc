"""The classical Runge–Kutta step."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor


def runge_kutta(rate: Callable[[float, Tensor], Tensor], x: Tensor, h: float | Tensor) -> Tensor:
    """x one step h later, of fourth order; ``rate(share, x)`` is ẋ at the share 0, ½ or 1 of the step."""
    k1 = rate(0.0, x)
    k2 = rate(0.5, x + h / 2 * k1)
    k3 = rate(0.5, x + h / 2 * k2)
    k4 = rate(1.0, x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
