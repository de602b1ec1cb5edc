"""Routes to the solution of the horizon's linear system: LU, block elimination, QR.

A route factors matrices (..., R, C) once and answers with a function that solves for right-hand sides (..., R, k).
A singular matrix gives coefficients that are not finite, not an exception, so that one member of a batch (the
particle of a search) may fail alone. Rows and columns are ordered node by node, function by function, (x, λ) inside.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Solve = Callable[[Tensor], Tensor]  # right-hand sides (..., R, k) -> coefficients (..., C, k)
Route = Callable[[Tensor, int], Solve]  # (matrix (..., R, C), n states) -> Solve


def _square(matrix: Tensor, route: str) -> None:
    rows, columns = matrix.shape[-2:]
    if rows != columns:
        raise ValueError(f"route = {route!r} with {rows} equations for {columns} coefficients; allowed: 'qr'")


def lu(matrix: Tensor, n_states: int) -> Solve:
    """Gaussian elimination with row exchanges of the whole matrix; the factors serve any number of right sides."""
    _square(matrix, "lu")
    factors, pivots, failed = torch.linalg.lu_factor_ex(matrix)

    def solve(right: Tensor) -> Tensor:
        solution = torch.linalg.lu_solve(factors, pivots, right)
        # a zero pivot may leave a finite answer where its row is not reached
        return torch.where((failed != 0)[..., None, None], torch.inf, solution) if failed.any() else solution

    return solve


def block(matrix: Tensor, n_states: int) -> Solve:
    """The paper's matrix partitioning: the states' coefficients are eliminated by the states' equations.

    [A B; C D] [a; b] = [f; g] becomes (D − C A⁻¹ B) b = g − C A⁻¹ f, a = A⁻¹ (f − B b). No row is exchanged
    between the blocks, so the route loses digits where A alone is ill conditioned.
    """
    _square(matrix, "block")
    size, pair = matrix.shape[-1], 2 * n_states
    view = matrix.unflatten(-1, (size // pair, pair)).unflatten(-3, (size // pair, pair))

    def part(rows: slice, columns: slice) -> Tensor:
        return view[..., :, rows, :, columns].flatten(-4, -3).flatten(-2, -1)

    states, costates = slice(None, n_states), slice(n_states, None)
    first = lu(part(states, states), n_states)
    coupling, below = first(part(states, costates)), part(costates, states)
    second = lu(part(costates, costates) - below @ coupling, n_states)

    def solve(right: Tensor) -> Tensor:
        rows = right.unflatten(-2, (size // pair, pair))
        f = first(rows[..., states, :].flatten(-3, -2))
        b = second(rows[..., costates, :].flatten(-3, -2) - below @ f)
        pairs = [half.unflatten(-2, (size // pair, n_states)) for half in (f - coupling @ b, b)]
        return torch.cat(pairs, dim=-2).flatten(-3, -2)

    return solve


def qr(matrix: Tensor, n_states: int) -> Solve:
    """Orthogonal triangularisation: least squares where there are more equations than coefficients."""
    rows, columns = matrix.shape[-2:]
    if rows < columns:
        raise ValueError(f"route = 'qr' with {rows} equations for {columns} coefficients; allowed: at least as many")
    orthogonal, triangle = torch.linalg.qr(matrix)

    def solve(right: Tensor) -> Tensor:
        return torch.linalg.solve_triangular(triangle, orthogonal.mT @ right, upper=True)

    return solve


ROUTES: dict[str, Route] = {"lu": lu, "block": block, "qr": qr}
