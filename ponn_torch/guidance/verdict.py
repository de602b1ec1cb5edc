"""What certificates of flights have in common: some decisions made again by an oracle, and checks that say the rest."""

from __future__ import annotations

import math
import statistics
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any


class FlightCertificate(ABC):
    """What a flight was measured to be, as a dataclass; certified where no check fails.

    cycles: whose decisions were made again. control_errors: ‖control − oracle‖/‖oracle‖ of each.
    """

    cycles: list[int]
    control_errors: list[float]
    decisions = "cycles"  # what was made again
    told: Sequence[str] = ("certified", "verdict", "largest_error", "median_error")  # besides the fields

    @property
    @abstractmethod
    def claim(self) -> str:
        """What a certified flight is."""

    @property
    @abstractmethod
    def checks(self) -> Sequence[tuple[bool, str]]:
        """Whether each is passed, and what is wrong where it is not; the first that fails is told."""

    @property
    @abstractmethod
    def rows(self) -> Sequence[tuple[str, str, str]]:
        """What was measured, how much, and what is allowed."""

    @property
    def certified(self) -> bool:
        return all(passed for passed, _ in self.checks)

    @property
    def verdict(self) -> str:
        wrong = next((text for passed, text in self.checks if not passed), None)
        return f"certified: {self.claim}" if wrong is None else f"not certified: {wrong}"

    @property
    def largest_error(self) -> float:
        return max(self.control_errors, default=math.nan)

    @property
    def median_error(self) -> float:
        return statistics.median(self.control_errors) if self.control_errors else math.nan

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {name: getattr(self, name) for name in self.told}  # type: ignore[call-overload]

    def to_text(self) -> str:
        head = (f"check ({len(self.cycles)} {self.decisions})", "measured", "allowed")
        table = (f"{name:52}{measured:>12}{allowed:>12}".rstrip() for name, measured, allowed in (head, *self.rows))
        return "\n".join([self.verdict, "", *table])


def spread_evenly(candidates: Sequence[int], wanted: int) -> list[int]:
    """At most so many of them, both ends among them."""
    count = min(len(candidates), wanted)
    return sorted({candidates[round(i * (len(candidates) - 1) / max(count - 1, 1))] for i in range(count)})
