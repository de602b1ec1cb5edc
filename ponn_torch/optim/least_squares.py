"""Least squares: linear, Gauss–Newton and Levenberg–Marquardt.

Levenberg–Marquardt carries the batch axis: every member has its own damping, acceptance and status, and members that
have ended are frozen. A trial step costs one residual; the Jacobian is formed at accepted points only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ponn_torch.numerics.linalg import LINEAR_SOLVERS, Jacobian
from ponn_torch.optim.base import Callback, OptimizeResult, Residual, Ruled, Status, Stopping
from ponn_torch.optim.checkpoint import Arrays, Checkpoint
from ponn_torch.optim.driver import Counted, Driven, Move, restored


def _check_solver(linear_solver: str) -> None:
    if linear_solver not in LINEAR_SOLVERS:
        raise ValueError(f"linear_solver = {linear_solver!r}; allowed: {', '.join(LINEAR_SOLVERS)}")


# -- scalings D of the damping ‖√μ D p‖ ------------------------------------------------------------------------------


def marquardt(norms: Tensor, previous: Tensor | None) -> Tensor:
    """Column norms of the current Jacobian: the method does not see the units of the unknowns."""
    return norms


def more(norms: Tensor, previous: Tensor | None) -> Tensor:
    """Largest column norms met so far (Moré), as in MINPACK."""
    return norms if previous is None else torch.maximum(norms, previous)


def identity(norms: Tensor, previous: Tensor | None) -> Tensor:
    """One for all unknowns (Levenberg), in units of the first Jacobian's largest column."""
    return norms.amax(-1, keepdim=True).expand_as(norms) if previous is None else previous


SCALINGS = {"marquardt": marquardt, "more": more, "identity": identity}


def floored(scale: Tensor) -> Tensor:
    """D (..., N) without entries below a millionth of the largest: what no equation sees is to be damped too."""
    return torch.maximum(scale, 1e-6 * scale.amax(-1, keepdim=True))


AHEAD = 0.1  # of a step, where the curvature along it is read off
HELPS = 0.5  # of ‖r‖, which a step with an old Jacobian has to leave at most, or it is taken back for a new one

# -- Levenberg–Marquardt ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DampedState:
    """Where Levenberg–Marquardt stands: ξ, r there, D, μ and its growth, and the next step's Jacobian if there is one.

    formed_at: where that Jacobian was formed. contraction: ‖r‖ after over before, of the last step taken.
    """

    xi: Tensor
    r: Tensor
    scale: Tensor
    damping: Tensor
    growth: Tensor
    contraction: Tensor
    formed_at: Tensor | None = None
    jacobian: Jacobian | None = None


@dataclass(frozen=True)
class LevenbergMarquardt(Driven):
    """Damped Gauss–Newton: ``scaling`` chooses D, Nielsen's rule moves μ, a step is taken only if ‖r‖ falls.

    Attributes:
        damping: first μ, relative to D² (1e-3 from a random start, 1e-8 near a solution).
        scaling: one of SCALINGS. linear_solver: ``cholesky`` (fast) or ``qr`` (digits).
        update: ``nielsen`` (gain ratio), or a number > 1: the constant factor of the classical rule.
        geodesic: add half the acceleration along the step where that is short (Transtrum and Sethna 2012): one more
            residual and solve a step, for residuals that curve in their unknowns, as a deep network's do.
        ahead: form the Jacobian with the residual of a trial step (of one problem, not a batch). It pays where the two
            cost little more than the residual alone and most steps are taken.
        reuse: take the next step with the same Jacobian too while steps make ‖r‖ fall to this share or below; there the
            method is the simplified Newton method, whose steps cost a residual and two triangular solves.
    """

    stopping: Stopping = field(default_factory=Stopping)
    damping: float = 1e-3
    scaling: str = "marquardt"
    linear_solver: str = "cholesky"
    update: str | float = "nielsen"
    smallest_damping: float = 1e-15
    largest_damping: float = 1e12
    geodesic: bool = False
    ahead: bool = False
    reuse: float = 0.0

    def __post_init__(self) -> None:
        _check_solver(self.linear_solver)
        if self.scaling not in SCALINGS:
            raise ValueError(f"scaling = {self.scaling!r}; allowed: {', '.join(SCALINGS)}")
        if self.update != "nielsen" and not (isinstance(self.update, int | float) and self.update > 1):
            raise ValueError(f"update = {self.update!r}; allowed: 'nielsen' or a factor above 1")
        if not self.damping >= 0:
            raise ValueError(f"damping = {self.damping}; allowed: a number ≥ 0")
        if not 0 <= self.reuse < 1:
            raise ValueError(f"reuse = {self.reuse}; allowed: from 0 to below 1")

    def warm(self, damping: float) -> LevenbergMarquardt:
        return replace(self, damping=damping) if self.damping > damping else self

    def begin(self, residual: Counted, xi: Tensor) -> DampedState:
        r, jacobian = residual.linearise(xi)
        cost = r.square().sum(-1)
        return DampedState(
            xi=xi,
            r=r,
            scale=self._scale(jacobian, None),
            damping=torch.full_like(cost, self.damping),
            growth=torch.full_like(cost, 2.0),
            contraction=torch.ones_like(cost),
            formed_at=xi,
            jacobian=jacobian,
        )

    def restore(self, residual: Counted, arrays: Arrays, like: Tensor) -> DampedState:
        state: DampedState = restored(DampedState, arrays, like)
        return state if state.formed_at is None else replace(state, jacobian=residual.linearise(state.formed_at)[1])

    def step(self, residual: Counted, state: DampedState, running: Tensor) -> tuple[DampedState, Move]:
        xi, r, scale = state.xi, state.r, state.scale
        formed_at, jacobian = state.formed_at, state.jacobian
        if jacobian is None:
            jacobian, formed_at = residual.linearise(xi)[1], xi
            scale = self._scale(jacobian, scale)
        cost, tiny = r.square().sum(-1), torch.finfo(xi.dtype).tiny
        step = jacobian.solve_damped(r, state.damping, scale, self.linear_solver)
        trial = xi + step
        fresh = formed_at is not None and torch.equal(formed_at, xi)
        if self.geodesic and fresh:
            ahead = residual.residual(xi + AHEAD * step)
            # J a = −r_vv, the second derivative of r along the step v
            curvature = (2 / AHEAD) * ((ahead - r) / AHEAD - jacobian.apply(step))
            half = jacobian.solve_damped(0.5 * curvature, state.damping, scale, self.linear_solver)
            short = 2 * (scale * half).norm(dim=-1) <= 0.75 * (scale * step).norm(dim=-1)  # NaN is not short
            trial = trial + torch.where(short.unsqueeze(-1), half, 0.0)
        # close to a solution Newton's contraction is squared from step to step, that of an old Jacobian stays
        promised = state.contraction**2 if fresh else state.contraction
        if self.ahead and cost.numel() == 1 and not bool(promised <= self.reuse):
            trial_r, following = residual.linearise_ahead(trial)
        else:
            trial_r, following = residual.residual(trial), None
        trial_cost = trial_r.square().sum(-1)
        accepted = running & (trial_cost < cost)  # NaN compares false: a non-finite step is rejected
        contraction = torch.where(accepted, (trial_cost / cost).sqrt(), 1.0)
        if not fresh and bool((contraction > HELPS)[running].any()):
            return self.step(residual, replace(state, formed_at=None, jacobian=None), running)
        # ‖r‖² − ‖r + J p‖² for the exact solution of the damped system
        predicted = (step * (state.damping.unsqueeze(-1) * scale.square() * step - jacobian.gradient(r))).sum(-1)
        gain = (cost - trial_cost) / predicted.clamp_min(tiny)
        damping, growth = self._update(state.damping, state.growth, gain, accepted, running)
        move = Move(
            # a rejected step that promised next to nothing is as good as a small decrease: round-off is near
            decrease=torch.where(accepted, cost - trial_cost, predicted) / cost,
            step=(scale * step).norm(dim=-1) / (scale * xi).norm(dim=-1).clamp_min(tiny),
            damping=damping,
            ended={
                Status.NON_FINITE: ~torch.isfinite(scale).all(-1),
                Status.DAMPING: ~accepted & (damping >= self.largest_damping),
            },
        )
        kept: tuple[Tensor | None, Jacobian | None] = formed_at, jacobian
        if not bool(accepted.any()):
            pass  # tried again, shorter
        elif following is not None:
            xi, r, kept, scale = trial, trial_r, (trial, following), self._scale(following, scale)
        else:
            where = accepted.unsqueeze(-1)
            xi, r = torch.where(where, trial, xi), torch.where(where, trial_r, r)
            if not bool((contraction <= self.reuse)[running].all()):
                kept = None, None
        return DampedState(xi, r, scale, damping, growth, contraction, *kept), move

    def _scale(self, jacobian: Jacobian, previous: Tensor | None) -> Tensor:
        return floored(SCALINGS[self.scaling](jacobian.column_norms(), previous))

    def _update(
        self, damping: Tensor, growth: Tensor, gain: Tensor, accepted: Tensor, running: Tensor
    ) -> tuple[Tensor, Tensor]:
        """μ and its growth factor ν after a trial (Nielsen 1999), or by a constant factor."""
        if self.update == "nielsen":
            smaller = damping * (1.0 - (2.0 * gain - 1.0) ** 3).clamp_min(1.0 / 3.0)
            larger, growth_after = damping * growth, 2.0 * growth
            growth = torch.where(accepted, torch.full_like(growth, 2.0), growth_after)
        else:
            factor = float(self.update)
            smaller, larger = damping / factor, damping * factor
        # from μ = 0 there is no larger multiple: leave zero by the smallest damping
        larger = larger.clamp_min(10 * self.smallest_damping)
        moved = torch.where(accepted, smaller, larger).clamp_min(self.smallest_damping)
        return torch.where(running, moved, damping), growth


@dataclass(frozen=True)
class GaussNewton(Ruled):
    """Undamped steps J p = −r by QR; ends when the norm rises. For problems that are linear, or nearly so."""

    stopping: Stopping = field(default_factory=lambda: Stopping(max_iterations=20))
    linear_solver: str = "qr"

    def __post_init__(self) -> None:
        _check_solver(self.linear_solver)

    def run(
        self,
        residual: Residual,
        xi: Tensor,
        on_iteration: Callback | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> OptimizeResult:
        inner = LevenbergMarquardt(
            self.stopping, 0.0, linear_solver=self.linear_solver, smallest_damping=0.0, largest_damping=0.0
        )
        return inner.run(residual, xi, on_iteration, checkpoint)
