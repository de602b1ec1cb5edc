"""Checks of a problem's arguments; every error names the argument, its value and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence

NUMERALS = {2: "two", 3: "three"}


def check_positive(**values: float) -> None:
    """Raise a ValueError for the first value that is not a positive, finite number."""
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} = {value}; allowed: a positive number")


def check_vectors(size: int = 3, /, **values: Sequence[float]) -> None:
    """Raise a ValueError for the first value that is not ``size`` finite numbers."""
    for name, value in values.items():
        if len(value) != size or not all(math.isfinite(entry) for entry in value):
            raise ValueError(f"{name} = {list(value)}; allowed: {NUMERALS[size]} numbers")


def check_thrust(minimum_thrust: float, maximum_thrust: float) -> None:
    """Raise a ValueError unless 0 ≤ minimum < maximum."""
    check_positive(maximum_thrust=maximum_thrust)
    if not 0 <= minimum_thrust < maximum_thrust:
        raise ValueError(
            f"minimum_thrust = {minimum_thrust}; allowed: from 0 to below maximum_thrust = {maximum_thrust}"
        )
