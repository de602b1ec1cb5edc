"""Least-squares linear algebra for damped steps: dense Jacobians, and arrow-shaped ones of coupled segments.

A damped step minimises ‖J p + r‖² + ‖√μ D p‖². Two routes are offered: ``cholesky`` factors the normal equations
after scaling their columns by D (fast, loses digits as cond(J)²), ``qr`` factors the stacked [J; √μ D] (keeps them).
All arrays may carry leading batch axes; μ then has the batch shape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from ponn_torch.numerics.tape import Replay, recordable

PANEL = 48  # rows of a normal matrix that are formed at once: smaller ones save more and cost more calls


def least_squares(matrix: Tensor, ridge: float = 0.0) -> Callable[[Tensor], Tensor]:
    """target (..., R, d) → the shortest X (..., N, d) of least ‖M X − target‖² + ridge ‖X‖², M factored once.

    Singular values below round-off are dropped.
    """
    # the SVD and not torch's lstsq, whose drivers for deficient rank exist on the CPU only
    left, singular, right = torch.linalg.svd(matrix, full_matrices=False)
    round_off = torch.finfo(matrix.dtype).eps * max(matrix.shape) * singular[0]
    inverse = torch.where(singular > round_off, singular / (singular**2 + ridge), 0.0)
    return lambda target: right.T @ (inverse[:, None] * (left.T @ target))


def _gram(matrix: Tensor) -> Tensor:
    """The lower triangle of MᵀM for M (..., R, N), a panel of rows at a time; only panels' diagonal blocks go above.

    That is little more than half of the multiplications. Cholesky reads no more of it.
    """
    n = matrix.shape[-1]
    out = matrix.new_zeros(*matrix.shape[:-2], n, n)
    for start in range(0, n, PANEL):
        panel = slice(start, start + PANEL)
        out[..., panel, : panel.stop] = matrix[..., panel].mT @ matrix[..., : panel.stop]
    return out


def _cholesky(matrix: Tensor, scale: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """(L, D⁻¹ (..., N, 1)) with D⁻¹ M D⁻¹ + μ = L Lᵀ, D = diag(scale); D⁻¹ is NaN where that is not positive definite.

    Of M the lower triangle is read.
    """
    inverse = (1.0 / scale).unsqueeze(-1)
    scaled = (matrix * inverse).mul_(inverse.mT)
    scaled.diagonal(dim1=-2, dim2=-1).add_(damping)
    factor, failed = torch.linalg.cholesky_ex(scaled)
    return factor, torch.where((failed != 0)[..., None, None], torch.nan, inverse)


def _cholesky_solve(matrix: Tensor, scale: Tensor, damping: Tensor, right: Tensor) -> Tensor:
    """Solve (M + μ diag(scale²)) X = right by Cholesky of the scaled matrix; NaN where it is not positive definite."""
    factor, inverse = _cholesky(matrix, scale, damping)
    return torch.cholesky_solve(right * inverse, factor) * inverse


def _qr_tail(matrix: Tensor, scale: Tensor, damping: Tensor, n_lead: int) -> tuple[Tensor, Tensor]:
    """Triangularise [matrix; √μ diag(scale) 0] and split R after ``n_lead`` columns: (head rows, tail block)."""
    rows = torch.zeros(*matrix.shape[:-2], n_lead, matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    rows.diagonal(dim1=-2, dim2=-1).copy_(damping.sqrt() * scale)
    triangle = torch.linalg.qr(torch.cat([matrix, rows], -2), mode="r").R
    return triangle[..., :n_lead, :], triangle[..., n_lead:, n_lead:]


def _row_factor(matrix: Tensor, damping: Tensor, method: str) -> Tensor:
    """Lower triangular C with C Cᵀ = M Mᵀ + μ 1 for a wide M; NaN where that is not positive definite."""
    one = torch.eye(matrix.shape[-2], dtype=matrix.dtype, device=matrix.device)
    if method == "qr":
        below = (damping.sqrt() * one).expand(*matrix.shape[:-1], matrix.shape[-2])
        return torch.linalg.qr(torch.cat([matrix.mT, below], -2), mode="r").R.mT
    factor, failed = torch.linalg.cholesky_ex(matrix @ matrix.mT + damping * one)
    return torch.where((failed != 0)[..., None, None], torch.nan, factor)


def _shortest(matrix: Tensor, factor: Tensor, right: Tensor) -> Tensor:
    """−Mᵀ C⁻ᵀ right."""
    return -matrix.mT @ torch.linalg.solve_triangular(factor.mT, right, upper=True)


def _back_substitute(head: Tensor, n: int) -> Tensor:
    """Solve R X = −(columns after n) for head = [R | columns]."""
    return -torch.linalg.solve_triangular(head[..., :n], head[..., n:], upper=True)


@dataclass(frozen=True)
class DenseJacobian:
    """A Jacobian as one matrix (..., R, N)."""

    matrix: Tensor

    @cached_property
    def _normal(self) -> Tensor:
        return _gram(self.matrix)

    def scaled_rows(self, factors: Tensor) -> DenseJacobian:
        """diag(factors) J, factors (R,)."""
        return DenseJacobian(factors.unsqueeze(-1) * self.matrix)

    def column_norms(self) -> Tensor:
        """(..., N)."""
        return torch.linalg.vector_norm(self.matrix, dim=-2)

    def gradient(self, residual: Tensor) -> Tensor:
        """Jᵀ r, (..., N)."""
        return (self.matrix.mT @ residual.unsqueeze(-1)).squeeze(-1)

    def apply(self, step: Tensor) -> Tensor:
        """J p, (..., R)."""
        return (self.matrix @ step.unsqueeze(-1)).squeeze(-1)

    def dense(self) -> Tensor:
        return self.matrix

    def columns(self, chosen: Tensor) -> DenseJacobian:
        """The Jacobian with respect to some of the unknowns, ascending positions (M,)."""
        return DenseJacobian(self.matrix[..., chosen])

    def solve_damped(self, residual: Tensor, damping: Tensor, scale: Tensor, method: str = "cholesky") -> Tensor:
        """Step p (..., N); μ (...,), D = diag(scale) with scale (..., N)."""
        if self.matrix.shape[-1] > self.matrix.shape[-2]:
            return self._by_rows(residual, damping[..., None, None], scale, method)
        return _METHODS[method][0](self, residual, damping.unsqueeze(-1), scale)

    def _by_cholesky(self, residual: Tensor, damping: Tensor, scale: Tensor) -> Tensor:
        right = -self.gradient(residual).unsqueeze(-1)
        return _cholesky_solve(self._normal, scale, damping, right).squeeze(-1)

    def _by_qr(self, residual: Tensor, damping: Tensor, scale: Tensor) -> Tensor:
        n = self.matrix.shape[-1]
        head, _ = _qr_tail(torch.cat([self.matrix, residual.unsqueeze(-1)], -1), scale, damping, n)
        return _back_substitute(head, n).squeeze(-1)

    def _by_rows(self, residual: Tensor, damping: Tensor, scale: Tensor, method: str) -> Tensor:
        """For more unknowns than equations: what is factored has the size of the equations."""
        scaled = self.matrix / scale.unsqueeze(-2)
        factor = _row_factor(scaled, damping, method)
        right = torch.linalg.solve_triangular(factor, residual.unsqueeze(-1), upper=False)
        return _shortest(scaled, factor, right).squeeze(-1) / scale


@lru_cache(maxsize=256)
def _replay(*of: object) -> Replay:
    """The tape of a function for arrays of given shapes."""
    return Replay()


@dataclass(frozen=True)
class ArrowJacobian:
    """K segments with unknowns of their own, coupled by a few shared ones.

    Rows: the segments' (K × R), then E extra rows that see shared unknowns only. Columns: the segments' own (K × P),
    then G shared. Segment k's rows see its own columns through ``local`` (..., K, R, P) and the shared columns
    ``index[k]`` (S,) through ``shared`` (..., K, R, S); an index of G means a column that is no unknown.
    ``extra`` is (..., E, G). Steps and gradients are ordered [segments' own, shared].
    """

    local: Tensor
    shared: Tensor
    extra: Tensor
    index: Tensor

    @property
    def n_shared(self) -> int:
        return self.extra.shape[-1]

    @property
    def n_own(self) -> int:
        return self.local.shape[-3] * self.local.shape[-1]

    @cached_property
    def _normal(self) -> tuple[Tensor, Tensor, Tensor]:
        return (
            _gram(self.local),
            self.local.mT @ self.shared,
            self.shared.mT @ self.shared,
        )

    def _split_rows(self, residual: Tensor) -> tuple[Tensor, Tensor]:
        k, rows = self.local.shape[-3:-1]
        return residual[..., : k * rows].unflatten(-1, (k, rows)), residual[..., k * rows :]

    def _gather(self, shared: Tensor) -> Tensor:
        """Shared unknowns (..., G) as the segments see them (..., K, S)."""
        return torch.cat([shared, shared.new_zeros(*shared.shape[:-1], 1)], -1)[..., self.index]

    def _scatter(self, segments: Tensor) -> Tensor:
        """Sum the segments' columns (..., K, S) into (..., G)."""
        out = segments.new_zeros(*segments.shape[:-2], self.n_shared + 1)
        return out.index_add_(-1, self.index.flatten(), segments.flatten(-2))[..., :-1]

    def _scatter_matrix(self, blocks: Tensor) -> Tensor:
        """Sum (..., K, S, S) into (..., G, G)."""
        size = self.n_shared + 1
        place = self.index.unsqueeze(-1) * size + self.index.unsqueeze(-2)
        out = blocks.new_zeros(*blocks.shape[:-3], size * size)
        out.index_add_(-1, place.flatten(), blocks.flatten(-3))
        return out.unflatten(-1, (size, size))[..., :-1, :-1]

    def _spread_columns(self, segments: Tensor) -> Tensor:
        """Columns (..., K, R, S) in the numbering of the shared unknowns, (..., K, R, G)."""
        out = segments.new_zeros(*segments.shape[:-1], self.n_shared + 1)
        index = self.index.unsqueeze(-2).expand(segments.shape)
        return out.scatter_add_(-1, index, segments)[..., :-1]

    def scaled_rows(self, factors: Tensor) -> ArrowJacobian:
        """diag(factors) J, factors (R,) of all rows."""
        segments, extra = self._split_rows(factors)
        column = segments.unsqueeze(-1)
        return ArrowJacobian(column * self.local, column * self.shared, extra.unsqueeze(-1) * self.extra, self.index)

    def column_norms(self) -> Tensor:
        own, _, shared = self._normal
        return self._played(ArrowJacobian._norms, own, shared)[0]

    def _norms(self, own: Tensor, shared: Tensor) -> tuple[Tensor]:
        """Column norms by the blocks of the normal matrix."""
        own = own.diagonal(dim1=-2, dim2=-1).flatten(-2)
        shared = self._scatter_matrix(shared).diagonal(dim1=-2, dim2=-1) + self.extra.square().sum(-2)
        return (torch.cat([own, shared], -1).sqrt(),)

    def gradient(self, residual: Tensor) -> Tensor:
        if id(residual) not in self._gradients:
            self._gradients[id(residual)] = residual, self._gradient(residual)
        return self._gradients[id(residual)][1]

    @cached_property
    def _gradients(self) -> dict[int, tuple[Tensor, Tensor]]:
        """Jᵀ r by the id of r, which is kept so that the id stays its own: a step asks for it, and its prediction."""
        return {}

    def _played(self, function: Callable[..., tuple[Tensor, ...]], *inputs: Tensor) -> tuple[Tensor, ...]:
        """``function(self, *inputs)``, from a tape for all Jacobians of these shapes once that pays."""
        arrays = (self.local, self.shared, self.extra, self.index, *inputs)
        if not recordable(*arrays) or not all(x.is_contiguous() for x in arrays):
            return function(self, *inputs)
        replay = _replay(function, *(x.shape for x in arrays), self.local.dtype, self.local.device)
        # of a copy, which keeps nothing that was computed before
        return replay(lambda: function(ArrowJacobian(*arrays[:4]), *inputs), *arrays)

    def _gradient(self, residual: Tensor) -> Tensor:
        segments, extra = self._split_rows(residual)
        column = segments.unsqueeze(-1)
        own = (self.local.mT @ column).flatten(-3)
        shared = self._scatter((self.shared.mT @ column).squeeze(-1))
        return torch.cat([own, shared + (self.extra.mT @ extra.unsqueeze(-1)).squeeze(-1)], -1)

    def apply(self, step: Tensor) -> Tensor:
        own, shared = self._split_columns(step)
        seen = self._gather(shared)
        segments = self.local @ own.unsqueeze(-1) + self.shared @ seen.unsqueeze(-1)
        return torch.cat([segments.flatten(-3), (self.extra @ shared.unsqueeze(-1)).squeeze(-1)], -1)

    def dense(self) -> Tensor:
        """The whole matrix (..., K·R + E, K·P + G)."""
        k, rows, own = self.local.shape[-3:]
        batch = self.local.shape[:-3]
        if k == 1 and not self.extra.shape[-2]:
            return torch.cat([self.local, self._spread_columns(self.shared)], -1).squeeze(-3)
        out = self.local.new_zeros(*batch, k * rows + self.extra.shape[-2], self.n_own + self.n_shared)
        out[..., : k * rows, self.n_own :] = self._spread_columns(self.shared).flatten(-3, -2)
        for i in range(k):
            out[..., i * rows : (i + 1) * rows, i * own : (i + 1) * own] = self.local[..., i, :, :]
        out[..., k * rows :, self.n_own :] = self.extra
        return out

    def columns(self, chosen: Tensor) -> ArrowJacobian | DenseJacobian:
        """With respect to some of the unknowns, ascending; an arrow where every segment keeps the same of its own."""
        k, width = self.local.shape[-3], self.local.shape[-1]
        own, shared = chosen[chosen < self.n_own], chosen[chosen >= self.n_own] - self.n_own
        kept = own[: len(own) // k]
        first = width * torch.arange(k, device=own.device)
        if not torch.equal(own, (first[:, None] + kept).flatten()):
            return DenseJacobian(self.dense()[..., chosen])
        place = torch.full((self.n_shared + 1,), len(shared), device=own.device)
        place[shared] = torch.arange(len(shared), device=own.device)
        return ArrowJacobian(self.local[..., kept], self.shared, self.extra[..., shared], place[self.index])

    def solve_damped(self, residual: Tensor, damping: Tensor, scale: Tensor, method: str = "cholesky") -> Tensor:
        """Step p (..., N); the segments' own unknowns are eliminated first: K small factorisations, one of size G."""
        if self.local.shape[-1] > self.local.shape[-2]:
            return self._by_rows(residual, damping[..., None, None], scale, method)
        return _METHODS[method][1](self, residual, damping[..., None, None], scale)

    def _split_columns(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        k, own = self.local.shape[-3], self.local.shape[-1]
        return vector[..., : self.n_own].unflatten(-1, (k, own)), vector[..., self.n_own :]

    def _by_cholesky(self, residual: Tensor, damping: Tensor, scale: Tensor) -> Tensor:
        step, gradient = self._played(ArrowJacobian._step, *self._normal, residual, damping, scale)
        self._gradients[id(residual)] = residual, gradient
        return step

    def _step(
        self, own: Tensor, mixed: Tensor, shared: Tensor, residual: Tensor, damping: Tensor, scale: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The damped step by the blocks of the normal matrix, and Jᵀ r."""
        gradient = self._gradient(residual)
        scale_own, scale_shared = self._split_columns(scale)
        gradient_own, gradient_shared = self._split_columns(gradient)
        factor, inverse = _cholesky(own, scale_own, damping)
        # L⁻¹ of both: what remains for the shared unknowns is symmetric to the last digit
        coupled = torch.cat([mixed, gradient_own.unsqueeze(-1)], -1) * inverse
        coupled = torch.linalg.solve_triangular(factor, coupled, upper=False)
        by_shared, by_residual = coupled[..., :-1], coupled[..., -1:]
        schur = self._scatter_matrix(shared - by_shared.mT @ by_shared) + self.extra.mT @ self.extra
        reduced = gradient_shared - self._scatter((by_shared.mT @ by_residual).squeeze(-1))
        step = _cholesky_solve(schur, scale_shared, damping[..., 0], -reduced.unsqueeze(-1)).squeeze(-1)
        known = by_residual + by_shared @ self._gather(step).unsqueeze(-1)
        inner = -(torch.linalg.solve_triangular(factor.mT, known, upper=True) * inverse).squeeze(-1)
        return torch.cat([inner.flatten(-2), step], -1), gradient

    def _by_qr(self, residual: Tensor, damping: Tensor, scale: Tensor) -> Tensor:
        n, g = self.local.shape[-1], self.n_shared
        scale_own, scale_shared = self._split_columns(scale)
        segments, extra = self._split_rows(residual)
        stacked = torch.cat([self.local, self.shared, segments.unsqueeze(-1)], -1)
        head, tail = _qr_tail(stacked, scale_own, damping, n)
        # what each segment leaves over for the shared unknowns, in their numbering
        left_over = torch.cat([self._spread_columns(tail[..., :-1]), tail[..., -1:]], -1).flatten(-3, -2)
        rows = torch.cat([left_over, torch.cat([self.extra, extra.unsqueeze(-1)], -1)], -2)
        step = _back_substitute(_qr_tail(rows, scale_shared, damping[..., 0], g)[0], g).squeeze(-1)
        known = head[..., n:-1] @ self._gather(step).unsqueeze(-1) + head[..., -1:]
        inner = -torch.linalg.solve_triangular(head[..., :n], known, upper=True)
        return torch.cat([inner.flatten(-3), step], -1)

    def _by_rows(self, residual: Tensor, damping: Tensor, scale: Tensor, method: str) -> Tensor:
        """For more unknowns than equations in a segment: what is factored has the size of the equations.

        With the own unknowns eliminated, μ (S s + r)ᵀ (L D⁻² Lᵀ + μ 1)⁻¹ (S s + r) is left for the shared ones s.
        """
        scale_own, scale_shared = self._split_columns(scale)
        segments, extra = self._split_rows(residual)
        scaled = self.local / scale_own.unsqueeze(-2)
        factor = _row_factor(scaled, damping.unsqueeze(-1), method)
        coupled = torch.cat([self.shared, segments.unsqueeze(-1)], -1)
        coupled = torch.linalg.solve_triangular(factor, coupled, upper=False)
        left_over = torch.cat([self._spread_columns(coupled[..., :-1]), coupled[..., -1:]], -1).flatten(-3, -2)
        root = damping.clamp_min(torch.finfo(damping.dtype).tiny).sqrt()
        # the extra rows first: Householder reflections keep the digits of rows in descending size
        rows = torch.cat([torch.cat([self.extra, extra.unsqueeze(-1)], -1) / root, left_over], -2)
        g = self.n_shared
        step = _back_substitute(_qr_tail(rows, scale_shared, torch.ones_like(damping[..., 0]), g)[0], g).squeeze(-1)
        known = coupled[..., :-1] @ self._gather(step).unsqueeze(-1) + coupled[..., -1:]
        inner = _shortest(scaled, factor, known).squeeze(-1) / scale_own
        return torch.cat([inner.flatten(-2), step], -1)


Jacobian = DenseJacobian | ArrowJacobian

_METHODS: dict[str, tuple[Callable[..., Tensor], Callable[..., Tensor]]] = {
    "cholesky": (DenseJacobian._by_cholesky, ArrowJacobian._by_cholesky),
    "qr": (DenseJacobian._by_qr, ArrowJacobian._by_qr),
}
LINEAR_SOLVERS = tuple(_METHODS)
