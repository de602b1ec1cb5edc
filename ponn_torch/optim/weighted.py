"""Weights of equations in the loss ½‖W r‖²: fixed ones for any optimiser, adaptive ones for gradient methods.

Least squares by Levenberg–Marquardt need none: a residual that vanishes does so whatever its weights. A gradient method
goes where the largest equation pulls, and profits from equations that pull alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from ponn_torch.numerics.linalg import Jacobian
from ponn_torch.optim.base import Around, Callback, Optimizer, OptimizeResult, Residual
from ponn_torch.optim.checkpoint import Checkpoint
from ponn_torch.optim.driver import Counted
from ponn_torch.optim.restricted import Wrapping

LARGEST = 1e3  # of an adaptive weight, and its inverse the smallest


def rows_of(blocks: Callable[[Tensor], Mapping[str, Tensor]], r: Tensor) -> dict[str, Tensor]:
    """Rows (R,), booleans, of every named equation: those that its norm depends on."""
    ones = torch.ones_like(r).requires_grad_()
    with torch.enable_grad():
        norms = blocks(ones)
    slopes = {name: torch.autograd.grad(norm, ones, retain_graph=True)[0] for name, norm in norms.items()}
    return {name: slope != 0 for name, slope in slopes.items()}


def _check_positive(weights: Mapping[str, float]) -> None:
    for name, weight in weights.items():
        if not 0 < weight < float("inf"):
            raise ValueError(f"weights.{name} = {weight}; allowed: a positive number")


def check_equations(weights: Mapping[str, float], equations: Iterable[str]) -> None:
    """ValueError for a weight of no equation."""
    names = list(equations)
    for name in weights:
        if name not in names:
            raise ValueError(f"weights.{name}: no such equation; allowed: {', '.join(names)}")


@dataclass(frozen=True, eq=False)
class Weighted(Wrapping):
    """W r with one weight per equation, 1 where none is given; ``blocks`` are those of W r.

    Raises:
        ValueError: a weight that is not positive, or of no equation (when first evaluated).
    """

    inner: Residual
    weights: Mapping[str, float]

    def __post_init__(self) -> None:
        _check_positive(self.weights)

    @cached_property
    def _rows(self) -> dict[int, Tensor]:
        return {}

    def _factors(self, r: Tensor) -> Tensor:
        """(R,) for residuals of this length."""
        size = r.shape[-1]
        if size not in self._rows:
            flat = r.detach().reshape(-1, size)[0]
            rows = rows_of(self.inner.blocks, flat)
            check_equations(self.weights, rows)
            factors = torch.ones_like(flat)
            for name, weight in self.weights.items():
                factors = torch.where(rows[name], weight, factors)
            self._rows[size] = factors
        return self._rows[size]

    def residual(self, xi: Tensor) -> Tensor:
        r = self.inner.residual(xi)
        return self._factors(r) * r

    def linearise(self, xi: Tensor) -> tuple[Tensor, Jacobian]:
        r, jacobian = self.inner.linearise(xi)
        factors = self._factors(r)
        return factors * r, jacobian.scaled_rows(factors)


@dataclass(frozen=True)
class WeightedEquations(Around):
    """Run an optimiser on W r; its records and rules are those of W r, the norm of the result is that of r.

    Raises:
        ValueError: a weight that is not positive, or (in ``run``) of no equation.
    """

    optimizer: Optimizer
    weights: Mapping[str, float]

    def __post_init__(self) -> None:
        _check_positive(self.weights)

    def run(
        self,
        residual: Residual,
        xi: Tensor,
        on_iteration: Callback | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> OptimizeResult:
        """Minimise ½‖W r(ξ)‖² from ξ."""
        result = self.optimizer.run(Weighted(residual, self.weights), xi, on_iteration, checkpoint)
        return replace(result, norm=residual.residual(result.xi).norm(dim=-1))


# -- adaptive weights (R,) of the equations at a point ---------------------------------------------------------------


def unbalanced(residual: Counted, xi: Tensor, r: Tensor) -> Tensor:
    """All one."""
    return torch.ones_like(r)


def gradient_norm(residual: Counted, xi: Tensor, r: Tensor) -> Tensor:
    """Equations pull alike: w² is inverse to the norm of the equation's gradient (Wang, Teng & Perdikaris 2021)."""
    rows = rows_of(residual.blocks, r)
    pulls = {name: residual.gradient(xi, mask.to(r))[1].norm() for name, mask in rows.items()}
    return _inverse_to(pulls, rows, r)


def ntk_trace(residual: Counted, xi: Tensor, r: Tensor) -> Tensor:
    """Equations converge alike: w² is inverse to the trace of the equation's J Jᵀ (Wang, Yu & Perdikaris 2022)."""
    rows = rows_of(residual.blocks, r)
    squares = residual.linearise(xi)[1].dense().square().sum(-1)
    return _inverse_to({name: squares[mask].mean() for name, mask in rows.items()}, rows, r)


def _inverse_to(pulls: Mapping[str, Tensor], rows: Mapping[str, Tensor], r: Tensor) -> Tensor:
    """√(mean pull / pull) on every equation's rows, within bounds."""
    mean = torch.stack(list(pulls.values())).mean()
    weights = torch.ones_like(r)
    for name, pull in pulls.items():
        weight = (mean / pull).sqrt().nan_to_num(1.0).clamp(1.0 / LARGEST, LARGEST)
        weights = torch.where(rows[name], weight, weights)
    return weights


BALANCES: dict[str, Callable[[Counted, Tensor, Tensor], Tensor]] = {
    "none": unbalanced,
    "gradient_norm": gradient_norm,
    "ntk_trace": ntk_trace,
}
