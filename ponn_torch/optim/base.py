"""What every optimiser shares: the residual it sees, the records it leaves, and the reason it stops."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Protocol, cast, runtime_checkable

import torch
from torch import Tensor

from ponn_torch.numerics.linalg import Jacobian

if TYPE_CHECKING:
    from ponn_torch.optim.checkpoint import Checkpoint


class Status(Enum):
    """Why an optimiser stopped; the value is the message."""

    RESIDUAL = "the residual norm fell below the tolerance"
    ROUND_OFF = "after the tolerance was met, the residual norm rose: round-off is reached"
    SMALL_DECREASE = "the relative decrease stayed below its tolerance for several steps"
    SMALL_STEP = "the relative step fell below its tolerance"
    DAMPING = "no step decreased the residual up to the largest damping"
    LINE_SEARCH = "no step along the search direction decreased the residual"
    MAX_ITERATIONS = "the iteration limit was reached"
    TIME_LIMIT = "the CPU time limit was reached"
    BUDGET = "the CPU time of the whole run was spent"
    HOPELESS = "the residual was still above the limit that tells a failed start"
    NON_FINITE = "the residual or its Jacobian is not finite at the best point"
    INTERRUPTED = "interrupted from the keyboard"

    @property
    def stationary(self) -> bool:
        """The optimiser ended by itself at a point it cannot improve (not: a correct solution)."""
        return self in _STATIONARY

    @property
    def cut(self) -> bool:
        """The run was ended from outside: nothing more is to be computed."""
        return self in (Status.INTERRUPTED, Status.BUDGET)


_STATIONARY = {
    Status.RESIDUAL,
    Status.ROUND_OFF,
    Status.SMALL_DECREASE,
    Status.SMALL_STEP,
    Status.DAMPING,
    Status.LINE_SEARCH,
}


class Residual(Protocol):
    """Vector function r(ξ) (..., R) of a flat vector ξ (..., N); leading axes are independent problems."""

    @property
    def n_unknowns(self) -> int: ...

    def residual(self, xi: Tensor) -> Tensor: ...

    def linearise(self, xi: Tensor) -> tuple[Tensor, Jacobian]: ...

    def blocks(self, residual: Tensor) -> Mapping[str, Tensor]: ...


Record = Mapping[str, float | int | bool]
Callback = Callable[[Record, Tensor, Tensor], None]  # (record, ξ, r) after every iteration


@dataclass(frozen=True)
class Stopping:
    """When to stop; every rule names itself in the Status.

    tolerance: on ‖r‖. decrease: relative decrease of ‖r‖² below which ``patience`` successive accepted steps end the
    run. step: on ‖p‖/‖ξ‖ in scaled unknowns. past_tolerance: the papers' rule — when the tolerance is met, go on until
    the norm rises (PoNN paper, after eq. 27). hopeless: after ``hopeless_after`` iterations a norm above it ends
    the run. cpu_seconds: process CPU time.
    """

    tolerance: float = 1e-12
    decrease: float = 1e-9
    patience: int = 3
    step: float = 0.0
    max_iterations: int = 200
    past_tolerance: bool = False
    hopeless: float = float("inf")
    hopeless_after: int = 10**9
    cpu_seconds: float = float("inf")


@dataclass(frozen=True)
class OptimizeResult:
    """The best point found (..., N), ‖r‖ there (...,), why it ended, a record per iteration, and evaluation counts."""

    xi: Tensor
    norm: Tensor
    status: Status
    records: list[Record] = field(default_factory=list)
    n_residuals: int = 0
    n_linearisations: int = 0
    cpu_seconds: float = 0.0
    member_status: tuple[Status, ...] = ()

    @property
    def n_iterations(self) -> int:
        return len(self.records)


class Optimizer(Protocol):
    def run(
        self,
        residual: Residual,
        xi: Tensor,
        on_iteration: Callback | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> OptimizeResult:
        """Minimise ½‖r(ξ)‖² from ξ, or go on from where the checkpoint stands; never raises for want of convergence."""
        ...


# -- an optimiser whose result is a start for something else --------------------------------------------------------


@runtime_checkable
class Adjustable(Protocol):
    """An optimiser that a conductor may ask for less: its stages begin near their solution, or lead to another one."""

    def loosened(self, tolerance: float) -> Optimizer:
        """The same with no smaller tolerance than this."""
        ...

    def warm(self, damping: float) -> Optimizer:
        """The same with no larger first damping than this."""
        ...


class Ruled:
    """An optimiser with stopping rules of its own; without a damping it is always warm."""

    def loosened(self, tolerance: float) -> Optimizer:
        made: Any = self
        if made.stopping.tolerance >= tolerance:
            return cast(Optimizer, made)
        return cast(Optimizer, replace(made, stopping=replace(made.stopping, tolerance=tolerance)))

    def warm(self, damping: float) -> Optimizer:
        return cast(Optimizer, self)


class Around:
    """An optimiser that runs another one, its field ``optimizer``, which is what is adjusted."""

    def loosened(self, tolerance: float) -> Optimizer:
        made: Any = self
        return cast(Optimizer, replace(made, optimizer=loosened(made.optimizer, tolerance)))

    def warm(self, damping: float) -> Optimizer:
        made: Any = self
        return cast(Optimizer, replace(made, optimizer=warm(made.optimizer, damping)))


def loosened(optimizer: Optimizer, tolerance: float) -> Optimizer:
    """The optimiser with no smaller tolerance than this; one that is not Adjustable comes back as it is."""
    return optimizer.loosened(tolerance) if isinstance(optimizer, Adjustable) else optimizer


def warm(optimizer: Optimizer, damping: float) -> Optimizer:
    """The optimiser with no larger first damping than this; one that is not Adjustable comes back as it is."""
    return optimizer.warm(damping) if isinstance(optimizer, Adjustable) else optimizer


# -- how a run begins and ends ---------------------------------------------------------------------------------------


class NonFiniteResidual(FloatingPointError):
    """The residual is not finite at a starting point; the message names equations."""


def check_start(residual: Residual, value: Tensor) -> Tensor:
    """Members (...,) of a batch whose starting residual (..., R) is finite; the others can only fail, alone.

    Raises:
        NonFiniteResidual: no member's residual is finite; the message names the equations.
    """
    finite = torch.isfinite(value).all(-1)
    if bool(finite.any()):
        return finite
    bad = [name for name, norm in residual.blocks(value).items() if not bool(torch.isfinite(norm).all())]
    raise NonFiniteResidual(
        f"the residual is not finite at the starting point, in the equations of: {', '.join(bad)}; "
        "start from a point where the dynamics are defined (other seed, distribution or guess)"
    )


class Stop(Exception):
    """Raised by a callback to end the run that called it; the best point is kept and the status is this one."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.value)
        self.status = status


def replayed(records: Iterable[Record], tell: Callable[[Record], None]) -> Status | None:
    """Tell of iterations that were done before; a status where that ends the run."""
    try:
        for entry in records:
            tell(entry)
    except KeyboardInterrupt:
        return Status.INTERRUPTED
    except Stop as stop:
        return stop.status
    return None


class Stopwatch:
    """CPU seconds of this process since it was made."""

    def __init__(self) -> None:
        self._start = time.process_time()

    @property
    def seconds(self) -> float:
        return time.process_time() - self._start


def record(**values: Any) -> Record:
    """A record with plain Python numbers (tensors of one element are read out)."""
    return {k: v.item() if isinstance(v, Tensor) else v for k, v in values.items()}
