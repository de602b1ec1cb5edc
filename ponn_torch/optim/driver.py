"""One loop for every iterative optimiser: stopping rules, records, the best point, checkpoints.

A method says where it starts and what one step does; its state is a frozen dataclass of tensors and numbers, never
changed in place. So an iteration that is interrupted leaves the state before it, and a run that is continued from a
saved state takes the very steps that it would have taken.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar, cast

import torch
from torch import Tensor

from ponn_torch.numerics.linalg import Jacobian
from ponn_torch.optim.base import (
    Callback,
    OptimizeResult,
    Record,
    Residual,
    Ruled,
    Status,
    Stop,
    Stopping,
    Stopwatch,
    check_start,
    record,
    replayed,
)
from ponn_torch.optim.checkpoint import (
    Arrays,
    Checkpoint,
    pack,
    pack_records,
    under,
    unpack,
    unpack_records,
    within,
)

RUNNING = -1
_CODES = list(Status)


class State(Protocol):
    """What every state of a method holds: where it stands ξ (..., N), and r (..., R) there."""

    @property
    def xi(self) -> Tensor: ...

    @property
    def r(self) -> Tensor: ...


S = TypeVar("S", bound=State)


@dataclass(frozen=True)
class Move:
    """What one iteration did, a number or a tensor (...,) each.

    Attributes:
        decrease: relative decrease of ‖r‖², or the one that a rejected step promised.
        step: ‖p‖/‖ξ‖ of the step tried. damping: what held it back, μ or the inverse of a step length.
        ended: statuses that the method itself ends with, and where.
    """

    decrease: Tensor
    step: Tensor
    damping: Tensor
    ended: Mapping[Status, Tensor] = field(default_factory=dict)


class Method(Protocol[S]):
    """An optimiser, an iteration at a time."""

    @property
    def stopping(self) -> Stopping: ...

    def begin(self, residual: Counted, xi: Tensor) -> S: ...

    def step(self, residual: Counted, state: S, running: Tensor) -> tuple[S, Move]:
        """The state after one more iteration; members that are not running (...,) stay as they are."""
        ...

    def restore(self, residual: Counted, arrays: Arrays, like: Tensor) -> S:
        """The state that ``pack`` took apart."""
        ...


class Counted:
    """A residual that counts what is asked of it; derivatives are Jacobians and gradients alike."""

    def __init__(self, residual: Residual) -> None:
        self._residual, self.n_residuals, self.n_derivatives = residual, 0, 0
        self.blocks = residual.blocks

    def residual(self, xi: Tensor) -> Tensor:
        self.n_residuals += 1
        return self._residual.residual(xi)

    def linearise(self, xi: Tensor) -> tuple[Tensor, Jacobian]:
        self.n_derivatives += 1
        return self._residual.linearise(xi)

    def linearise_ahead(self, xi: Tensor) -> tuple[Tensor, Jacobian]:
        """As ``linearise``, in place of the residual of a trial point."""
        self.n_residuals += 1
        return self.linearise(xi)

    def gradient(self, xi: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """r (..., R) and Jᵀ W² r (..., N), by reverse mode through the residual.

        That takes twice the time of the residual alone; by way of the Jacobian it takes twice that again for a linear
        free function, and many times that for a deep one.
        """
        self.n_residuals += 1
        self.n_derivatives += 1
        point = xi.detach().requires_grad_()
        with torch.enable_grad():
            r = self._residual.residual(point)
        cotangent = r.detach() if weights is None else weights.square() * r.detach()
        (gradient,) = torch.autograd.grad(r, point, cotangent)
        return r.detach(), gradient


@dataclass
class _Progress:
    """What the loop itself knows: the best point, ‖r‖² there, who has ended and why, records and counts."""

    xi: Tensor
    r: Tensor
    cost: Tensor
    code: Tensor
    slow: Tensor
    records: list[Record]
    seconds: float = 0.0

    @classmethod
    def begin(cls, state: State, finite: Tensor, rule: Stopping) -> _Progress:
        cost = state.r.square().sum(-1)
        code = torch.where(finite, RUNNING, _CODES.index(Status.NON_FINITE))
        if not rule.past_tolerance:
            code = torch.where(cost.sqrt() < rule.tolerance, _CODES.index(Status.RESIDUAL), code)
        return cls(state.xi, state.r, cost, code, torch.zeros_like(code), [])

    def pack(self) -> Arrays:
        tensors = {name: getattr(self, name) for name in ("xi", "r", "cost", "code", "slow")}
        return tensors | within("records", pack_records(self.records))

    @classmethod
    def restore(cls, arrays: Arrays, rule: Stopping, like: Tensor) -> _Progress:
        """The same; members that a limit had ended are running again where the limit is another one now."""
        tensors = {name: arrays[name].to(like.device) for name in ("xi", "r", "cost", "code", "slow")}
        records = unpack_records(under("records", arrays))
        seconds = float(records[-1]["seconds"]) if records else 0.0
        lifted = {
            Status.MAX_ITERATIONS: len(records) < rule.max_iterations,
            Status.TIME_LIMIT: seconds <= rule.cpu_seconds,
        }
        code = tensors["code"]
        for status in (status for status, free in lifted.items() if free):
            code = torch.where(code == _CODES.index(status), RUNNING, code)
        return cls(**{**tensors, "code": code}, records=records, seconds=seconds)


def drive(
    method: Method[S],
    residual: Residual,
    xi: Tensor,
    on_iteration: Callback | None = None,
    checkpoint: Checkpoint | None = None,
) -> OptimizeResult:
    """Run a method from ξ (..., N), or from where its checkpoint stands, until a stopping rule fires.

    A run that goes on tells its callback of the iterations before too, with the best point that it goes on from.

    Raises:
        NonFiniteResidual: r is not finite at the start, in no member of a batch.
    """
    rule, counted = method.stopping, Counted(residual)
    saved = checkpoint.saved if checkpoint is not None else None
    watch = Stopwatch()
    if saved is None:
        state = method.begin(counted, xi)
        progress = _Progress.begin(state, check_start(residual, state.r), rule)
    else:
        progress = _Progress.restore(under("progress", saved), rule, xi)
        state = method.restore(counted, under("state", saved), xi)
        last = progress.records[-1] if progress.records else {"residuals": 0, "linearisations": 0}
        counted.n_residuals, counted.n_derivatives = int(last["residuals"]), int(last["linearisations"])
    before = progress.seconds
    told = on_iteration or _nobody

    def keep() -> None:
        if checkpoint is not None:
            checkpoint.save(within("state", pack(state)) | within("progress", progress.pack()))

    cut = replayed(progress.records, lambda entry: told(entry, progress.xi, progress.r))  # of a run that goes on
    while cut is None and bool((progress.code == RUNNING).any()):
        try:
            running = progress.code == RUNNING
            following, move = method.step(counted, state, running)
            advanced = _advance(progress, following, move, running, rule, counted, before + watch.seconds)
            state, progress = following, advanced
            told(progress.records[-1], progress.xi, progress.r)
            if checkpoint is not None and checkpoint.due():
                keep()
        except KeyboardInterrupt:
            cut = Status.INTERRUPTED
        except Stop as stop:
            cut = stop.status
    if cut is not None or _CODES.index(Status.TIME_LIMIT) in progress.code:
        keep()
    end = cut or Status.INTERRUPTED
    members = tuple(end if code == RUNNING else _CODES[code] for code in progress.code.flatten().tolist())
    return OptimizeResult(
        xi=progress.xi,
        norm=progress.cost.sqrt(),
        status=cut or common(members),
        records=progress.records,
        n_residuals=counted.n_residuals,
        n_linearisations=counted.n_derivatives,
        cpu_seconds=before + watch.seconds,
        member_status=members,
    )


def _nobody(entry: Record, xi: Tensor, r: Tensor) -> None:
    """The callback of a run that nobody watches."""


def _advance(
    progress: _Progress,
    state: State,
    move: Move,
    running: Tensor,
    rule: Stopping,
    counted: Counted,
    seconds: float,
) -> _Progress:
    """The progress after one iteration, with whoever ends by it, and the iteration's record; the one before stays."""
    cost = state.r.square().sum(-1)
    accepted = running & (cost < progress.cost)  # NaN compares false
    iteration = len(progress.records) + 1
    xi, r, best = progress.xi, progress.r, progress.cost
    if bool(accepted.any()):
        xi = torch.where(accepted.unsqueeze(-1), state.xi, xi)
        r = torch.where(accepted.unsqueeze(-1), state.r, r)
        best = torch.where(accepted, cost, best)
    norm = best.sqrt()
    slow = torch.where(move.decrease < rule.decrease, progress.slow + 1, torch.where(accepted, 0, progress.slow))
    ended = torch.full_like(progress.code, RUNNING)
    for status, where in _endings(rule, iteration, seconds, norm, slow, accepted, running, move):
        ended = torch.where((ended == RUNNING) & where, _CODES.index(status), ended)
    code = torch.where(progress.code == RUNNING, ended, progress.code)

    def middle(values: Tensor) -> Tensor:
        return values.nanmedian() if values.dim() else values

    entry = record(
        iteration=iteration,
        norm=middle(norm),
        damping=middle(move.damping),
        step=middle(move.step),
        accepted=accepted.any(),
        running=int(running.sum()),
        residuals=counted.n_residuals,
        linearisations=counted.n_derivatives,
        seconds=seconds,
    )
    return _Progress(xi, r, best, code, slow, [*progress.records, entry], seconds)


def _endings(
    rule: Stopping,
    iteration: int,
    seconds: float,
    norm: Tensor,
    slow: Tensor,
    accepted: Tensor,
    running: Tensor,
    move: Move,
) -> Iterator[tuple[Status, Tensor]]:
    """Who ends and why, the first reason first."""
    if rule.past_tolerance:
        yield Status.ROUND_OFF, ~accepted & (norm < rule.tolerance)
    else:
        yield Status.RESIDUAL, norm < rule.tolerance
    yield Status.SMALL_DECREASE, slow >= rule.patience
    if rule.step:
        yield Status.SMALL_STEP, accepted & (move.step < rule.step)
    yield from move.ended.items()
    if iteration >= rule.hopeless_after:
        yield Status.HOPELESS, norm > rule.hopeless
    if iteration >= rule.max_iterations:
        yield Status.MAX_ITERATIONS, running
    if seconds > rule.cpu_seconds:
        yield Status.TIME_LIMIT, running


def common(members: tuple[Status, ...]) -> Status:
    """One status for a batch: the least favourable."""
    order = [*(s for s in Status if not s.stationary), *(s for s in Status if s.stationary)]
    return min(members, key=order.index)


def restored(cls: type[Any], arrays: Arrays, like: Tensor) -> Any:
    """A state whose fields are all in the arrays."""
    return unpack(cls, arrays, like.device)


class Driven(Ruled):
    """What makes a method an optimiser."""

    def check(self, xi: Tensor) -> None:
        """Raise ValueError for a ξ that the method cannot take."""

    def run(
        self,
        residual: Residual,
        xi: Tensor,
        on_iteration: Callback | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> OptimizeResult:
        """Minimise ½‖r(ξ)‖² from ξ (..., N); one vector (N,) for gradient methods.

        Raises:
            NonFiniteResidual: r is not finite at the start, in no member of the batch; alone, a member has failed.
            ValueError: a ξ that the method cannot take.
        """
        self.check(xi)
        return drive(cast(Method[Any], self), residual, xi, on_iteration, checkpoint)
