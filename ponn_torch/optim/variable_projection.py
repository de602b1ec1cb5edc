"""Variable projection: an optimiser on the hidden weights, all other unknowns eliminated by least squares.

For given hidden weights θ the best output layer η(θ) follows from a linear least squares, so that r(θ, η(θ)) is a
function of the hidden weights alone (Golub & Pereyra 1973). Its Jacobian is (1 − Q Qᵀ) ∂r/∂θ, where Q spans the columns
of ∂r/∂η (Kaufman 1975): what an output layer can mend is not asked of the hidden layers, which conditions the problem
far better than steps on all weights at once. It is meant for residuals that are linear in η, as those of
linear-quadratic problems are; others are better started near their solution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

import torch
from torch import Tensor

from ponn_torch.numerics.linalg import DenseJacobian
from ponn_torch.optim.base import Around, Callback, Optimizer, OptimizeResult, Record, Residual
from ponn_torch.optim.checkpoint import Checkpoint, Nested, under
from ponn_torch.optim.least_squares import GaussNewton, LevenbergMarquardt
from ponn_torch.optim.restricted import Layered

EXACT = 1e-6  # a linear model this close to the residual, relatively, need not be made anew


@dataclass(frozen=True, eq=False)
class Projected:
    """[r; ridge η] as a function of the hidden weights θ (H,), with η (M,) eliminated; r (R,) is that of ``inner``.

    Attributes:
        xi: (N,) its η is where every elimination starts, which does not matter where r is linear in η.
        ridge: keeps units that are nearly dependent from cancelling each other with huge output weights.
        max_eliminations: Gauss–Newton steps for a residual that is not linear in η.
    """

    inner: Layered
    xi: Tensor
    ridge: float = 1e-7
    max_eliminations: int = 3

    @cached_property
    def eliminated(self) -> Tensor:
        """Positions (M,) of η in ξ."""
        return self.inner.linear_unknowns

    @cached_property
    def hidden(self) -> Tensor:
        """Positions (H,) of θ in ξ."""
        kept = torch.ones(self.xi.shape[-1], dtype=torch.bool, device=self.xi.device)
        kept[self.eliminated] = False
        return kept.nonzero()[:, 0]

    @property
    def n_unknowns(self) -> int:
        return len(self.hidden)

    @property
    def start(self) -> Tensor:
        """θ of ``xi``."""
        return self.xi[self.hidden]

    @cached_property
    def _last(self) -> dict[str, Tensor]:
        """The last θ that was asked for, and ξ there: a trial that is accepted is linearised next."""
        return {}

    def full(self, theta: Tensor) -> Tensor:
        """ξ (N,) with the best η for θ."""
        if "theta" not in self._last or not torch.equal(self._last["theta"], theta):
            self._last.update(theta=theta.clone(), xi=self._fitted(self.xi.index_copy(0, self.hidden, theta)))
        return self._last["xi"]

    def residual(self, xi: Tensor) -> Tensor:
        return self._augmented(self.full(xi))

    def linearise(self, xi: Tensor) -> tuple[Tensor, DenseJacobian]:
        point = self.full(xi)
        r, by_hidden, basis, _ = self._parts(point)
        return r, DenseJacobian(by_hidden - basis @ (basis.mT @ by_hidden))

    def blocks(self, residual: Tensor) -> Mapping[str, Tensor]:
        return self.inner.blocks(self.plain(residual))

    def plain(self, residual: Tensor) -> Tensor:
        """r without the rows of the ridge."""
        return residual[: len(residual) - len(self.eliminated)]

    def _augmented(self, xi: Tensor) -> Tensor:
        return torch.cat([self.inner.residual(xi), self.ridge * xi[self.eliminated]])

    def _parts(self, xi: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """[r; ridge η] at ξ, its derivative by θ, and Q, R of that by η."""
        r, jacobian = self.inner.linearise(xi)
        by_hidden, by_rest = (jacobian.columns(index).dense() for index in (self.hidden, self.eliminated))
        size = len(self.eliminated)
        basis, triangle = torch.linalg.qr(torch.cat([by_rest, self.ridge * torch.eye(size).to(by_rest)]))
        below = by_hidden.new_zeros(size, by_hidden.shape[-1])
        return torch.cat([r, self.ridge * xi[self.eliminated]]), torch.cat([by_hidden, below]), basis, triangle

    def _fitted(self, xi: Tensor) -> Tensor:
        """ξ with η of least [r; ridge η]; a step that is not one down ends it."""
        for _ in range(self.max_eliminations):
            r, _, basis, triangle = self._parts(xi)
            fitted, found = xi, r
            for _ in range(2):  # once more by the same factors: that mends the round-off of the first
                seen = (basis.mT @ found).unsqueeze(-1)
                step = -torch.linalg.solve_triangular(triangle, seen, upper=True).squeeze(-1)
                fitted = fitted.index_add(0, self.eliminated, step)
                found = self._augmented(fitted)
            if not float(found.norm()) < float(r.norm()):
                return xi
            xi = fitted
            model = r - basis @ (basis.mT @ r)
            if float((found - model).norm()) <= EXACT * float(r.norm()):
                break
        return xi


@dataclass(frozen=True)
class VariableProjection(Around):
    """Run an optimiser on the hidden weights with all other unknowns eliminated; see `Projected`.

    Its records and rules are those of [r; ridge η], the norm of the result is that of r. Where nothing is hidden, as in
    a linear free function, elimination is all there is: Gauss–Newton.
    """

    optimizer: Optimizer = field(default_factory=lambda: LevenbergMarquardt(damping=0.1, linear_solver="qr"))
    ridge: float = 1e-7
    max_eliminations: int = 3

    def __post_init__(self) -> None:
        if not 0 < self.ridge < float("inf"):
            raise ValueError(f"ridge = {self.ridge}; allowed: a positive number")
        if self.max_eliminations < 1:
            raise ValueError(f"max_eliminations = {self.max_eliminations}; allowed: at least 1")

    def run(
        self,
        residual: Residual,
        xi: Tensor,
        on_iteration: Callback | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> OptimizeResult:
        """Minimise ½‖r(ξ)‖² from ξ (N,).

        Raises:
            TypeError: a residual without ``linear_unknowns``.
            ValueError: more problems than one.
            NonFiniteResidual: r is not finite at the start.
        """
        if not hasattr(residual, "linear_unknowns"):
            raise TypeError(f"{type(residual).__name__} has no linear_unknowns, so its hidden weights are not known")
        if xi.dim() != 1:
            raise ValueError(f"xi has shape {tuple(xi.shape)}; variable projection solves one problem, shape (N,)")
        inner, saved = None, checkpoint.saved if checkpoint is not None else None
        if saved is not None:
            xi, saved = saved["xi"].to(xi.device), under("part", saved)
        projected = Projected(cast(Layered, residual), xi, self.ridge, self.max_eliminations)
        if not projected.n_unknowns:
            return GaussNewton().run(residual, xi, on_iteration, checkpoint)
        if checkpoint is not None:
            inner = Nested(checkpoint, {"xi": xi}, saved)

        def told(entry: Record, theta: Tensor, r: Tensor) -> None:
            if on_iteration is not None:
                on_iteration(entry, projected.full(theta), projected.plain(r))

        result = self.optimizer.run(projected, projected.start, told, inner)
        found = projected.full(result.xi)
        return replace(result, xi=found, norm=residual.residual(found).norm())
