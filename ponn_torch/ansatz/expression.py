"""The constrained expression y(z) = g(z) + Ω(z) (κ - C[g]) meets C[y] = κ whatever the free function g is.

Theory of functional connections (Mortari 2017); with a network as g, X-TFC (Schiassi et al. 2021).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from ponn_torch.ansatz.basis import Chebyshev, LinearBasis
from ponn_torch.ansatz.constraints import Constraint, SwitchingFunctions, apply, functional_matrix
from ponn_torch.numerics.linalg import least_squares
from ponn_torch.numerics.nodes import NodeSet


def _identity(table: Tensor, magnitude: Tensor, truncation: float) -> Tensor:
    return torch.eye(table.shape[1], dtype=table.dtype, device=table.device)


def _columns(table: Tensor, magnitude: Tensor, truncation: float) -> Tensor:
    """Unit columns, without those that constraints reduce to round-off (fewer than half the digits left)."""
    norms = table.norm(dim=0)
    known = norms > torch.finfo(table.dtype).eps ** 0.5 * magnitude
    if not known.any():
        raise ValueError(f"basis of size {len(known)} is spanned by the constraints; allowed: a larger one")
    return torch.diag(1 / norms)[:, known]


def _orthonormal(table: Tensor, magnitude: Tensor, truncation: float) -> Tensor:
    """Orthonormal columns, in Gram-Schmidt order if they are well conditioned, else by a truncated SVD."""
    scale = _columns(table, magnitude, truncation)
    triangle = torch.linalg.qr(table @ scale, mode="r").R
    extremes = torch.linalg.svdvals(triangle)[[0, -1]]
    if triangle.shape[0] == triangle.shape[1] and extremes[1] > 1e-6 * extremes[0]:
        signs = torch.diag(triangle.diagonal().sign())
        return scale @ torch.linalg.solve_triangular(triangle, signs, upper=True)
    # unscaled: functions with little to say weigh little, and weights in the original functions stay small
    _, singular, right = torch.linalg.svd(table, full_matrices=False)
    right = right * right.sum(dim=1, keepdim=True).sign()  # the same on every machine
    keep = singular > truncation * singular[0]
    return right[keep].T / singular[keep]


def _ordered(table: Tensor, magnitude: Tensor, truncation: float) -> Tensor:
    """Orthonormal columns in Gram-Schmidt order, without those that the ones before them span to half the digits."""
    scale, remainder = _columns(table, magnitude, truncation), None
    while remainder is None or bool((remainder <= torch.finfo(table.dtype).eps ** 0.5).any()):
        if remainder is not None:
            scale = scale[:, remainder > torch.finfo(table.dtype).eps ** 0.5]
        triangle = torch.linalg.qr(table @ scale, mode="r").R
        remainder = triangle.diagonal().abs()
    signs = torch.diag(triangle.diagonal().sign())
    return scale @ torch.linalg.solve_triangular(triangle, signs, upper=True)


# (table (n, L), column norms before the constraints (L,), truncation) -> W (L, L') that conditions table @ W
CONDITIONINGS: dict[str, Callable[[Tensor, Tensor, float], Tensor]] = {
    "none": _identity,
    "columns": _columns,
    "orthonormal": _orthonormal,
    "ordered": _ordered,
}


class ConstrainedExpression(nn.Module):
    """y = B β + Ω κ with tables B and Ω that depend on neither the weights β nor the targets κ.

    Shapes: over one variable, β (..., L', d) and κ (..., n_constraints, d) for d components that share the
    tables; over n_variables > 1, β (..., L', n_variables) and κ (..., n_constraints).

    conditioning replaces the free functions by fixed combinations W of them, computed once on `nodes` from their
    derivatives of the given order (the highest one in the residual), in quadrature RMS: "columns" divides each by its
    norm; "orthonormal" makes them orthonormal; "ordered" does that in Gram-Schmidt order, which keeps a narrow function
    behind wide ones. All drop functions that the constraints reduce to round-off; "orthonormal" also combinations with
    singular values below `truncation`, relative, and "ordered" functions that those before them span to half the
    digits; so L' <= L. Where the constraints leave functions whose derivative of that order is zero, the norm contains
    the value too. Over several variables it is the norm of the functions before the constraints. Constraints hold to
    round-off in the weights of the original functions, W β. With `combinations` W is given (it was computed before).

    A polynomial basis should leave out what the supports span: Chebyshev(L, lowest_degree=n_constraints).

    Raises ValueError for an unknown conditioning, one without nodes, and constraints that clash.
    """

    combinations: Tensor  # W (L, L')
    functionals: Tensor  # C of the combined functions, (n_constraints, n_variables, L')

    def __init__(
        self,
        basis: LinearBasis,
        constraints: Sequence[Constraint],
        n_variables: int = 1,
        *,
        nodes: NodeSet | None = None,
        order: int = 0,
        conditioning: str = "none",
        truncation: float = 1e-12,
        combinations: Tensor | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__()
        if conditioning not in CONDITIONINGS:
            raise ValueError(f"conditioning = {conditioning!r}; allowed: {', '.join(CONDITIONINGS)}")
        if nodes is None and conditioning != "none":
            raise ValueError(f"nodes = None with conditioning = {conditioning!r}; allowed: a NodeSet")
        self.basis = basis
        self.constraints = tuple(constraints)
        self.n_variables = n_variables
        self.switching = SwitchingFunctions(self.constraints, n_variables, dtype=dtype, device=device)
        functionals = functional_matrix(
            self.constraints, basis.features, basis.size, n_variables, dtype=dtype, device=device
        )
        self.register_buffer("combinations", torch.eye(basis.size, dtype=dtype, device=device))
        self.register_buffer("functionals", functionals)
        if combinations is None and nodes is not None:
            table, magnitude = self._table_to_condition(nodes, order)
            combinations = CONDITIONINGS[conditioning](table, magnitude, truncation)
        if combinations is not None:
            self.combinations = combinations
            self.functionals = functionals @ combinations

    @property
    def size(self) -> int:
        """L', the number of free coefficients per component."""
        return self.combinations.shape[1]

    @property
    def n_constraints(self) -> int:
        return len(self.constraints)

    def _table_to_condition(self, nodes: NodeSet, order: int) -> tuple[Tensor, Tensor]:
        """A table whose column norms are RMS values of derivative `order`, with the value if that can vanish.

        With it, the norms of the columns before the constraints took their part, which carry the round-off.
        """
        constraints = self.constraints if self.n_variables == 1 else ()
        low = functional_matrix(constraints, Chebyshev(max(order, 1)).features, max(order, 1), 1)[:, 0]
        vanishing = order > 0 and int(torch.linalg.matrix_rank(low)) < order
        table = self.basis.features(nodes.points, order)
        magnitude = table.abs()
        if constraints:
            switching, functionals = self.switching(nodes.points, order)[:, :, 0], self.functionals[:, 0]
            table = table - switching @ functionals
            magnitude = magnitude + switching.abs() @ functionals.abs()
        root = (nodes.weights / 2).sqrt()[:, None]
        orders = (0, order) if vanishing else (order,)
        norms = torch.cat([root * magnitude[e] for e in orders]).norm(dim=0)
        return torch.cat([root * table[e] for e in orders]), norms

    def tables(self, z: Tensor, order: int) -> tuple[Tensor, Tensor]:
        """B and Ω with derivatives 0..order at z (n,).

        Over one variable B (order+1, n, L') and Ω (order+1, n, n_constraints); over several, y_v may respond
        to the weights of every u: B (order+1, n, v, L', u) and Ω (order+1, n, v, n_constraints).
        """
        free = self.basis.features(z, order) @ self.combinations
        switching = self.switching(z, order)
        if self.n_variables == 1:
            switching = switching[:, :, 0]
            return free - switching @ self.functionals[:, 0], switching
        own = torch.eye(self.n_variables, dtype=free.dtype, device=free.device)
        removed = torch.einsum("onvk,kul->onvlu", switching, self.functionals)
        return torch.einsum("onl,vu->onvlu", free, own) - removed, switching

    def jet(self, weights: Tensor, kappa: Tensor, z: Tensor, order: int) -> Tensor:
        """y and its derivatives 0..order at z (n,): (..., order+1, n, d), with d = n_variables if above 1."""
        free, switching = self.tables(z, order)
        if self.n_variables == 1:
            known = torch.einsum("onk,...kd->...ond", switching, kappa)
            return torch.einsum("onl,...ld->...ond", free, weights) + known
        known = torch.einsum("onvk,...k->...onv", switching, kappa)
        return torch.einsum("onvlu,...lu->...onv", free, weights) + known

    def check(self, weights: Tensor, kappa: Tensor) -> Tensor:
        """C[y] - κ of every constraint, in the shape of κ: round-off, if the expression keeps its word."""

        def function(z: Tensor, order: int) -> Tensor:
            jet = self.jet(weights, kappa, z, order)
            return jet.movedim(-1, 0).unsqueeze(-1) if self.n_variables == 1 else jet

        if not self.constraints:
            return torch.zeros_like(kappa)
        values = [apply(c, function, dtype=weights.dtype, device=weights.device) for c in self.constraints]
        achieved = torch.stack(values, dim=-1)
        return (achieved.movedim(0, -1) if self.n_variables == 1 else achieved) - kappa

    def fit(self, z: Tensor, y: Tensor, kappa: Tensor, *, weights: Tensor | None = None, ridge: float = 0.0) -> Tensor:
        """β of the least-squares projection of values y (..., n, d) at z (n,), for given targets κ.

        Minimises Σ_i weights_i |y(z_i) - y_i|² + ridge |β|², weights (n,) by default 1, by the singular value
        decomposition of the table: singular values below round-off are dropped, which gives the shortest β.
        """
        return self.fitter(z, weights=weights, ridge=ridge)(y, kappa)

    def fitter(
        self, z: Tensor, *, weights: Tensor | None = None, ridge: float = 0.0
    ) -> Callable[[Tensor, Tensor], Tensor]:
        """(y, κ) → β as ``fit`` gives it, for many values at the same points: the table is decomposed once."""
        root = torch.ones_like(z) if weights is None else weights.sqrt()
        B, Omega = (table[0] for table in self.tables(z, 0))
        if self.n_variables == 1:
            solve = least_squares(root[:, None] * B, ridge)
            return lambda y, kappa: solve(root[:, None] * (y - Omega @ kappa))
        solve = least_squares((root[:, None, None, None] * B).flatten(2).flatten(0, 1), ridge)  # rows (n, v), (L', u)

        def fit(y: Tensor, kappa: Tensor) -> Tensor:
            rest = root[:, None] * (y - torch.einsum("nvk,...k->...nv", Omega, kappa))
            solution = solve(rest.flatten(-2).unsqueeze(-1))
            return solution.squeeze(-1).unflatten(-1, (self.size, self.n_variables))

        return fit
