"""Node sets on [-1, 1] with quadrature weights, and what polynomial interpolation on them needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class NodeSet:
    """Points on [-1, 1] and the weights that integrate over it.

    points: (n,), ascending. weights: (n,), positive, summing to 2, exact up to the degree that `make_nodes`
    states. edges: (P+1,), between which the rule is repeated; None for one panel.
    """

    kind: str
    points: Tensor
    weights: Tensor
    edges: Tensor | None = None

    def __len__(self) -> int:
        return self.points.shape[0]

    @lru_cache(maxsize=64)  # noqa: B019  the rules themselves are kept for good as well
    def between(self, n_points: int) -> Tensor:
        """About n_points off the nodes, ascending: even in every panel, as many as its share of the nodes asks for."""
        edges = self.points.new_tensor([-1.0, 1.0]) if self.edges is None else self.edges
        panels = torch.bucketize(self.points, edges[1:-1].contiguous())
        counts = torch.bincount(panels, minlength=len(edges) - 1)
        parts = []
        for start, end, count in zip(edges[:-1].tolist(), edges[1:].tolist(), counts.tolist(), strict=True):
            n = n_points if self.edges is None else max(2, math.ceil(n_points * count / len(self)))
            step = (end - start) / n
            grid = torch.linspace(start + step / 2, end - step / 2, n, dtype=edges.dtype, device=edges.device)
            parts.append(grid)
        return torch.cat(parts)


def _trapezoid(n: int) -> tuple[Array, Array]:
    weights = np.full(n, 2.0 / (n - 1))
    weights[[0, -1]] /= 2
    return np.linspace(-1.0, 1.0, n), weights


def _interpolatory(points: Array) -> tuple[Array, Array]:
    """Weights that integrate every polynomial of degree < n: the Legendre moments 2, 0, 0, ..."""
    moments = np.zeros(len(points))
    moments[0] = 2.0
    return points, np.linalg.solve(legvander(points, len(points) - 1).T, moments)


def _chebyshev_gauss(n: int) -> tuple[Array, Array]:
    # sines of antisymmetric arguments instead of cosines: the points are symmetric to the last bit
    return _interpolatory(np.sin(np.pi * np.arange(1 - n, n, 2) / (2 * n)))


def _chebyshev_lobatto(n: int) -> tuple[Array, Array]:
    return _interpolatory(np.sin(np.pi * np.arange(1 - n, n, 2) / (2 * (n - 1))))


def _golub_welsch(diagonal: Array, off_diagonal: Array) -> tuple[Array, Array]:
    """Gauss-type rule of a Jacobi matrix: eigenvalues, and Christoffel numbers 1 / sum p_k(z)^2."""
    jacobi = np.diag(diagonal) + np.diag(off_diagonal, 1) + np.diag(off_diagonal, -1)
    points = np.linalg.eigvalsh(jacobi)
    ends = np.abs(np.abs(points) - 1.0) < 1e-14  # the prescribed end points are exact
    points = np.where(ends, np.sign(points), points)
    previous, current = np.zeros_like(points), np.full_like(points, np.sqrt(0.5))
    total = current**2
    for k, off in enumerate(off_diagonal):
        below = off_diagonal[k - 1] if k else 0.0
        previous, current = current, ((points - diagonal[k]) * current - below * previous) / off
        total += current**2
    return points, 1.0 / total


def _legendre_coefficients(n: int) -> tuple[Array, Array]:
    k = np.arange(1, n)
    return np.zeros(n), k / np.sqrt(4.0 * k**2 - 1.0)


def _symmetric(rule: tuple[Array, Array]) -> tuple[Array, Array]:
    points, weights = rule
    return (points - points[::-1]) / 2, (weights + weights[::-1]) / 2


def _legendre_gauss(n: int) -> tuple[Array, Array]:
    return _symmetric(_golub_welsch(*_legendre_coefficients(n)))


def _legendre_lobatto(n: int) -> tuple[Array, Array]:
    diagonal, off_diagonal = _legendre_coefficients(n)
    off_diagonal[-1] = np.sqrt((n - 1) / (2 * n - 3))  # puts eigenvalues at -1 and 1 (Golub 1973)
    return _symmetric(_golub_welsch(diagonal, off_diagonal))


def _legendre_radau(n: int) -> tuple[Array, Array]:
    diagonal, off_diagonal = _legendre_coefficients(n)
    diagonal[-1] = -n / (2 * n - 1)  # puts an eigenvalue at -1 (Golub 1973)
    return _golub_welsch(diagonal, off_diagonal)


_RULES: dict[str, tuple[Callable[[int], tuple[Array, Array]], int]] = {  # rule, fewest nodes
    "uniform": (_trapezoid, 2),
    "chebyshev_gauss": (_chebyshev_gauss, 1),
    "chebyshev_lobatto": (_chebyshev_lobatto, 2),
    "legendre_gauss": (_legendre_gauss, 1),
    "legendre_lobatto": (_legendre_lobatto, 2),
    "legendre_radau": (_legendre_radau, 1),
}
NODE_KINDS = tuple(_RULES)


@lru_cache(maxsize=128)
def make_nodes(
    kind: str, n_nodes: int, *, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
) -> NodeSet:
    """Nodes of a named kind; the weights are exact for polynomials up to a degree d.

    uniform            both ends, trapezoid, d = 1
    chebyshev_gauss    open, Fejér, d = n - 1
    chebyshev_lobatto  both ends, Clenshaw-Curtis, d = n - 1
    legendre_gauss     open, d = 2n - 1
    legendre_lobatto   both ends, d = 2n - 3
    legendre_radau     -1 is a node, +1 is not, d = 2n - 2

    Raises ValueError for an unknown kind or too few nodes.
    """
    if kind not in _RULES:
        raise ValueError(f"kind = {kind!r} is not a kind of nodes; allowed: {', '.join(NODE_KINDS)}")
    rule, fewest = _RULES[kind]
    if n_nodes < fewest:
        raise ValueError(f"n_nodes = {n_nodes} is too few for {kind} nodes; allowed: at least {fewest}")
    points, weights = (torch.as_tensor(a, dtype=dtype, device=device) for a in rule(n_nodes))
    return NodeSet(kind, points, weights)


def make_panels(kind: str, edges: Tensor, counts: int | Sequence[int]) -> NodeSet:
    """A rule of a named kind on every panel between ``edges`` (P+1,), which ascend from −1 to 1.

    Raises ValueError for other edges, and as `make_nodes` does; panels of a kind with both ends share theirs twice.
    """
    lengths = edges.diff()
    if not (float(edges[0]) == -1.0 and float(edges[-1]) == 1.0 and bool((lengths > 0).all())):
        raise ValueError(f"edges = {edges.tolist()}; allowed: ascending from -1 to 1")
    counts = [counts] * len(lengths) if isinstance(counts, int) else counts
    if len(counts) != len(lengths):
        raise ValueError(f"counts has {len(counts)} entries for {len(lengths)} panels; allowed: one per panel")
    rules = {n: make_nodes(kind, n, dtype=edges.dtype, device=edges.device) for n in set(counts)}
    points, weights = [], []
    for start, length, count in zip(edges[:-1], lengths, counts, strict=True):
        points.append(start + length * (rules[count].points + 1) / 2)
        weights.append(rules[count].weights * length / 2)
    return NodeSet(kind, torch.cat(points), torch.cat(weights), edges)


def graded_edges(centres: Tensor, widths: Tensor, coarsest: float = 0.5) -> Tensor:
    """Edges (P+1,) on [−1, 1] of panels that resolve layers of the given widths (M,) at the centres (M,).

    By halving: next to a layer no panel is longer than its width, elsewhere none than its distance from it. Panels
    between neighbouring numbers stay as they are.

    Raises ValueError for a width that is not positive.
    """
    if not bool((widths > 0).all()):
        raise ValueError(f"widths = {widths.tolist()}; allowed: positive numbers")
    edges = torch.linspace(-1.0, 1.0, math.ceil(2 / coarsest) + 1, dtype=centres.dtype, device=centres.device)
    while True:
        start, end = edges[:-1, None], edges[1:, None]
        distance = torch.maximum(start - centres, centres - end).clamp_min(0.0)
        middles = (edges[:-1] + edges[1:]) / 2
        long = (end - start > torch.maximum(widths, distance)).any(-1) & (edges[:-1] < middles) & (middles < edges[1:])
        if not bool(long.any()):
            return edges
        edges = torch.cat([edges, middles[long]]).sort().values


def barycentric_weights(points: Tensor) -> Tensor:
    """Weights 1 / prod(z_j - z_k) of barycentric interpolation, (n,), scaled to a largest magnitude of 1.

    Raises ValueError when two points coincide.
    """
    difference = points[:, None] - points[None, :]
    if bool((difference.fill_diagonal_(1.0) == 0).any()):
        raise ValueError(f"points = {points.tolist()} holds a point twice; allowed: distinct points")
    # differences in units of a quarter of the interval (its capacity) keep the product in range
    unit = (points.max() - points.min()).clamp_min(torch.finfo(points.dtype).tiny) / 4
    weights = 1 / (difference / unit).fill_diagonal_(1.0).prod(dim=1)
    return weights / weights.abs().max()


def interpolation_matrix(points: Tensor, targets: Tensor) -> Tensor:
    """(m, n) matrix from values at the points (n,) to the interpolating polynomial at the targets (m,)."""
    difference = targets[:, None] - points[None, :]
    hit = difference == 0
    terms = barycentric_weights(points) / difference.masked_fill(hit, 1.0)
    on_point = hit.any(dim=1, keepdim=True)
    return torch.where(on_point, hit.to(terms.dtype), terms / terms.sum(dim=1, keepdim=True))


def differentiation_matrix(points: Tensor) -> Tensor:
    """(n, n) matrix from values at the points to the derivative of the interpolating polynomial there."""
    weights = barycentric_weights(points)
    difference = (points[:, None] - points[None, :]).fill_diagonal_(1.0)
    matrix = (weights[None, :] / weights[:, None] / difference).fill_diagonal_(0.0)
    return matrix - torch.diag(matrix.sum(dim=1))  # rows sum to 0: constants have derivative 0


def legendre_moments(nodes: NodeSet, n_moments: int) -> Tensor:
    """(M, n) matrix from node values R to ⟨R, P_k⟩, k < M, by the quadrature; P_k is orthonormal Legendre."""
    if n_moments < 1:
        raise ValueError(f"n_moments = {n_moments} is not a number of moments; allowed: at least 1")
    polynomials = legvander(nodes.points.detach().cpu().numpy(), n_moments - 1)
    orthonormal = (polynomials * np.sqrt(np.arange(n_moments) + 0.5)).T
    return torch.as_tensor(orthonormal, dtype=nodes.points.dtype, device=nodes.points.device) * nodes.weights
