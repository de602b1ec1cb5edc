"""What the conductor tells while it works: stages, iterations, the solution, its certificate, a failure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from ponn_torch.optim.base import Record

if TYPE_CHECKING:
    from ponn_torch.optimal_control.curve import Curve
    from ponn_torch.solving.certificate import Certificate
    from ponn_torch.solving.result import StageResult
    from ponn_torch.solving.solution import Solution


class Look(Protocol):
    """The best point so far, seen when asked."""

    def blocks(self) -> Mapping[str, float]:
        """Norm of the residual per equation."""
        ...

    def cost(self) -> float:
        """By the nodes' quadrature, in the user's units."""
        ...

    def curve(self) -> Curve: ...


class Observer:
    """Called by the conductor; inherit from it to override what matters, the rest does nothing."""

    def stage_started(self, name: str, smoothing: float | None, index: int) -> None:
        """Stage ``index`` (counted over all starts from 0) begins."""

    def iteration(self, record: Record, look: Look) -> None:
        """An iteration ended; what ``look`` is asked for is computed then."""

    def stage_ended(self, stage: StageResult) -> None:
        """The stage that was started last ended."""

    def solution(self, solution: Solution) -> None:
        """The solve found its final trajectory."""

    def certificate(self, certificate: Certificate) -> None:
        """The final trajectory was flown and judged."""

    def failed(self, reason: str) -> None:
        """The solve ends without a solution."""


class SilentObserver(Observer):
    """Sees everything and says nothing."""
