"""SciPy's least squares on the same residual, behind the same call and under the same rules."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

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
)
from ponn_torch.optim.checkpoint import Checkpoint

Array = NDArray[np.floating]
ROUND_OFF = 2.3e-16  # SciPy's own tolerances
HUGE = 1e150  # for SciPy, which cannot take a residual that is not finite


@dataclass(frozen=True)
class ScipyLeastSquares(Ruled):
    """scipy.optimize.least_squares: ``trf`` (the PoNN paper's landing), ``lm`` or ``dogbox``.

    The rules of ``stopping`` are applied here, after every residual that SciPy asks for, so that they mean what they
    mean elsewhere; of SciPy's own only ``step`` and round-off are left.
    """

    method: str = "trf"
    stopping: Stopping = field(default_factory=Stopping)

    def __post_init__(self) -> None:
        if self.method not in ("trf", "lm", "dogbox"):
            raise ValueError(f"method = {self.method!r}; allowed: trf, lm, dogbox")

    def run(
        self,
        residual: Residual,
        xi: Tensor,
        on_iteration: Callback | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> OptimizeResult:
        """Minimise ½‖r(ξ)‖² from ξ (N,); SciPy keeps its state to itself, so there are no checkpoints."""
        if xi.dim() != 1:
            raise ValueError(f"xi has shape {tuple(xi.shape)}; scipy solves one problem, shape (N,), at a time")
        run = _Run(residual, xi, self.stopping, on_iteration)
        try:
            out = least_squares(
                run.function,
                xi.cpu().numpy(),
                jac=run.jacobian,
                method=self.method,
                x_scale="jac",
                ftol=ROUND_OFF,
                xtol=max(self.stopping.step, ROUND_OFF),
                gtol=ROUND_OFF,
                max_nfev=self.stopping.max_iterations,
            )
        except Stop as stop:
            return run.result(stop.status)
        except KeyboardInterrupt:
            return run.result(Status.INTERRUPTED)
        ends = {0: Status.MAX_ITERATIONS, 3: Status.SMALL_STEP}
        return run.result(ends.get(out.status, Status.SMALL_DECREASE))


class _Run:
    """The residual as SciPy asks for it, the best point so far, and a record for every question."""

    def __init__(self, residual: Residual, xi: Tensor, rule: Stopping, on_iteration: Callback | None) -> None:
        self.residual, self.rule, self.on_iteration = residual, rule, on_iteration
        self.xi, self.r, self.norm = xi, residual.residual(xi), float("inf")
        check_start(residual, self.r)
        self.records: list[Record] = []
        self.n_linearisations, self.slow, self.watch = 0, 0, Stopwatch()

    def function(self, x: Array) -> Array:
        """r at x, once it is counted.

        Raises:
            Stop: by one of the rules, or the callback's.
        """
        xi, before = self._tensor(x), self.norm
        r = self.residual.residual(xi)
        norm = float(r.norm())
        if not torch.equal(xi, self.xi):  # SciPy asks for some points twice
            # as in Levenberg–Marquardt, a rejected step next to the best norm counts, one far off does not
            near = abs(before**2 - norm**2) < self.rule.decrease * before**2
            self.slow = self.slow + 1 if near else 0 if norm < before else self.slow
        if norm < before:
            self.xi, self.r, self.norm = xi, r, norm
        self._record(accepted=norm < before)
        for status, ended in self._endings(norm, before):
            if ended:
                raise Stop(status)
        return np.nan_to_num(r.detach().cpu().numpy(), nan=HUGE, posinf=HUGE, neginf=-HUGE)

    def jacobian(self, x: Array) -> Array:
        self.n_linearisations += 1
        return self.residual.linearise(self._tensor(x))[1].dense().cpu().numpy()

    def result(self, status: Status) -> OptimizeResult:
        return OptimizeResult(
            xi=self.xi,
            norm=self.xi.new_tensor(self.norm),
            status=status,
            records=self.records,
            n_residuals=len(self.records),
            n_linearisations=self.n_linearisations,
            cpu_seconds=self.watch.seconds,
            member_status=(status,),
        )

    def _tensor(self, x: Array) -> Tensor:
        return torch.as_tensor(x.copy(), dtype=self.xi.dtype, device=self.xi.device)

    def _record(self, *, accepted: bool) -> None:
        self.records.append(
            record(
                iteration=len(self.records) + 1,
                norm=self.norm,
                damping=0.0,
                step=0.0,
                accepted=accepted,
                running=1,
                residuals=len(self.records) + 1,
                linearisations=self.n_linearisations,
                seconds=self.watch.seconds,
            )
        )
        if self.on_iteration is not None:
            self.on_iteration(self.records[-1], self.xi, self.r)

    def _endings(self, norm: float, before: float) -> Iterator[tuple[Status, bool]]:
        """The rules, and whether they end the run after a point of this norm; ``before`` was the best one."""
        rule = self.rule
        yield Status.RESIDUAL, self.norm < rule.tolerance and not rule.past_tolerance
        yield Status.ROUND_OFF, before < rule.tolerance and norm > before and rule.past_tolerance
        yield Status.SMALL_DECREASE, self.slow >= rule.patience
        yield Status.HOPELESS, self.norm > rule.hopeless and len(self.records) >= rule.hopeless_after
        yield Status.TIME_LIMIT, self.watch.seconds > rule.cpu_seconds
