"""What a solve leaves: every stage, and the trajectory with its certificate where there is one."""

from __future__ import annotations

from dataclasses import dataclass, field

from ponn_torch.optim.base import Record, Status
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


@dataclass(frozen=True)
class SolveResult:
    """What a solve leaves: the solution and its certificate where there are, every stage, and a sentence."""

    solution: Solution | None
    certificate: Certificate | None
    stages: list[StageResult]
    n_starts: int
    message: str
    cpu_seconds: float
    interrupted: bool = False
    spent: bool = False

    @property
    def certified(self) -> bool:
        return self.certificate is not None and self.certificate.certified
