"""What the conductor tells while it works: stages, iterations, the solution, its certificate, a failure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from ponn_torch.optim.base import Record, Status

if TYPE_CHECKING:
    from ponn_torch.optimal_control.curve import Curve
    from ponn_torch.solving.certificate import Certificate
    from ponn_torch.solving.solution import Solution


@dataclass(frozen=True, eq=False)
class StageResult:
    """One call of an optimiser inside a solve: how it was set, why it ended, what it cost, what it found.

    Attributes:
        name: ``smooth``, ``split``, ``polish`` … as the conductor calls it.
        smoothing: ρ of the stage; None for arcs at their bounds and for problems without bounds.
        norm: ‖r‖ at the best point. off_node_residual: largest |ẇ − F| between the nodes, scaled.
        cost: of the stage's trajectory, in the user's units.
        records: one record per iteration, as the optimiser left them.
        start: number of the (random) start that the stage belongs to.
        solution: the trajectory at the end of the stage, where the conductor keeps it.
    """

    name: str
    smoothing: float | None
    status: Status
    norm: float
    n_iterations: int
    n_residuals: int
    n_linearisations: int
    cpu_seconds: float
    off_node_residual: float
    cost: float
    records: list[Record] = field(default_factory=list, repr=False)
    start: int = 0
    solution: Solution | None = field(default=None, repr=False)


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
