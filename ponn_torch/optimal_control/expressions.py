"""The constrained expressions y = g + Ω(κ − C[g]) of all chains of a segment: what depends on how g is written.

A residual asks four things of them: derivatives at the nodes, derivatives anywhere, its own Jacobian with respect to
the weights from that with respect to y, and a fit. Linear free functions answer from tables.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Protocol, TypeVar, cast

import torch
from torch import Tensor

from ponn_torch.ansatz.basis import FreeFunction, LinearBasis
from ponn_torch.ansatz.constraints import hermite
from ponn_torch.ansatz.expression import ConstrainedExpression
from ponn_torch.numerics.nodes import NodeSet
from ponn_torch.optimal_control.meaning import Keyed, meaning

if TYPE_CHECKING:
    from ponn_torch.optimal_control.discretisation import Discretisation, Group

Free = TypeVar("Free", bound=FreeFunction)

# [equations' group, chains' group][e]: ∂(equation d at node n)/∂y_d'^(e) as (..., K, d, n, d'), times √weight where
# rows are points; the equations' own highest derivatives, of which each sees its own with factor 1, are left out
Cotangents = Mapping[tuple[int, int], Mapping[int, Tensor]]


class Expressions(Protocol):
    """All chains of a segment, group by group; weights (..., K, n_own), targets κ per group (..., K, d, 2q)."""

    @property
    def n_own(self) -> int:
        """Weights per segment."""
        ...

    @property
    def output_layer(self) -> Tensor:
        """Ascending positions of the weights that enter y linearly."""
        ...

    def jets(self, weights: Tensor, kappas: Sequence[Tensor]) -> list[Tensor]:
        """Per group the derivatives in z at the nodes (..., K, d, q+1, n)."""
        ...

    def jets_at(self, z: Tensor, weights: Tensor, kappas: Sequence[Tensor]) -> list[Tensor]:
        """Per group the derivatives (..., d, q+1, m) at z (m,) of a segment: weights (..., n_own), κ (..., d, 2q)."""
        ...

    def jets_along(self, z: Tensor, segment: Tensor, weights: Tensor, kappas: Sequence[Tensor]) -> list[Tensor]:
        """As ``jets_at`` for points z (m,) of one segment (m,) each: weights (K, n_own), κ (K, d, 2q)."""
        ...

    def pull_back(self, weights: Tensor, cotangents: Cotangents) -> Tensor:
        """∂(rows of a segment)/∂(its weights), (..., K, n_rows, n_own), at fixed κ."""
        ...

    def fit(self, values: Sequence[Tensor], kappas: Sequence[Tensor]) -> Tensor:
        """Weights (..., K, n_own) whose y is nearest, at the nodes, to values per group (..., K, n, d)."""
        ...


@dataclass(frozen=True, eq=False)
class _AtNodes:
    """A constrained expression with what it is at the nodes: B (q+1, n, L), and its least-squares fit to values."""

    expression: ConstrainedExpression
    nodes: NodeSet
    order: int

    @cached_property
    def B(self) -> Tensor:
        return self.expression.tables(self.nodes.points, self.order)[0]

    @cached_property
    def fit(self) -> Callable[[Tensor, Tensor], Tensor]:
        return self.expression.fitter(self.nodes.points, weights=self.nodes.weights, ridge=1e-18)


@dataclass(frozen=True, eq=False)
class _Tables:
    """What the chains of a group share: B (q+1, n, L), [B | Ω] as (L + 2q, (q+1) n), and where their β stand."""

    made: _AtNodes
    B: Tensor
    both: Tensor
    own: slice

    @property
    def expression(self) -> ConstrainedExpression:
        return self.made.expression

    @property
    def size(self) -> int:
        return self.B.shape[-1]


GRIDS = 4  # grids between the nodes whose tables are kept


class LinearExpressions:
    """β of every chain; one product with a table gives all derivatives at all nodes."""

    def __init__(self, discretisation: Discretisation, basis: LinearBasis) -> None:
        self.groups, self.nodes = discretisation.groups, discretisation.nodes
        tables: list[_Tables] = []
        for group in self.groups:
            how = self.nodes, group.order, discretisation.conditioning
            given = discretisation.combinations.get(group.order)
            made = _made_once(shared(basis), *how) if given is None and says_all(basis) else _made(basis, *how, given)
            B = _free(group, made.B)
            both = torch.cat([B, group.Omega], -1).movedim(-1, 0).flatten(1)
            start = tables[-1].own.stop if tables else 0
            tables.append(_Tables(made, B, both, slice(start, start + group.n_chains * B.shape[-1])))
        self.tables = tuple(tables)
        self._kept: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}
        self.output_layer = torch.arange(self.n_own, device=self.nodes.points.device)

    @property
    def n_own(self) -> int:
        return self.tables[-1].own.stop

    @property
    def combinations(self) -> dict[int, Tensor]:
        """The combinations of the basis that β belongs to, by chain order."""
        return {group.order: t.expression.combinations for group, t in zip(self.groups, self.tables, strict=True)}

    def beta(self, group: int, weights: Tensor) -> Tensor:
        """β (..., d, L) of a group's chains, a view of weights (..., n_own)."""
        return weights[..., self.tables[group].own].unflatten(-1, (self.groups[group].n_chains, -1))

    def jets(self, weights: Tensor, kappas: Sequence[Tensor]) -> list[Tensor]:
        out = []
        for i, kappa in enumerate(kappas):
            jet = torch.cat([self.beta(i, weights), kappa], -1) @ self.tables[i].both
            out.append(jet.unflatten(-1, (self.groups[i].order + 1, -1)))
        return out

    def jets_at(self, z: Tensor, weights: Tensor, kappas: Sequence[Tensor]) -> list[Tensor]:
        out = []
        for i, kappa in enumerate(kappas):
            both = torch.cat([self.beta(i, weights), kappa], -1)
            out.append(torch.einsum("omk,...dk->...dom", self._table_once(i, z), both))
        return out

    def _table_once(self, i: int, z: Tensor) -> Tensor:
        """The table at z, kept for the next time that the same grid comes: residuals between the nodes are many."""
        if (i, id(z)) not in self._kept:
            if len(self._kept) >= GRIDS * len(self.groups):
                self._kept.clear()
            self._kept[i, id(z)] = z, self._table_at(i, z)  # that z is kept too makes its id its own
        return self._kept[i, id(z)][1]

    def jets_along(self, z: Tensor, segment: Tensor, weights: Tensor, kappas: Sequence[Tensor]) -> list[Tensor]:
        out = []
        for i, kappa in enumerate(kappas):
            both = torch.cat([self.beta(i, weights), kappa], -1)[segment]
            out.append(torch.einsum("omk,mdk->dom", self._table_at(i, z), both))
        return out

    def _table_at(self, i: int, z: Tensor) -> Tensor:
        """[B | Ω] (q+1, m, L + 2q) at z (m,); a trivial chain is its Hermite interpolant."""
        group = self.groups[i]
        if group.trivial:
            return group.switching(z, group.order)[:, :, 0]
        return torch.cat(self.tables[i].expression.tables(z, group.order), -1)

    def pull_back(self, weights: Tensor, cotangents: Cotangents) -> Tensor:
        n_rows = self.groups[-1].rows.stop
        local = weights.new_zeros(*weights.shape[:-1], n_rows, self.n_own)
        for (i, j), by_order in cotangents.items():
            columns = local[..., self.tables[j].own].unflatten(-1, (self.groups[j].n_chains, -1))
            accumulate(columns, self.groups[i], by_order, self.tables[j].B, own=i == j)
        return local

    def fit(self, values: Sequence[Tensor], kappas: Sequence[Tensor]) -> Tensor:
        weights = values[0].new_zeros(*values[0].shape[:-2], self.n_own)
        for i, group in enumerate(self.groups):
            if not group.trivial:
                self.beta(i, weights).copy_(self.tables[i].made.fit(values[i], kappas[i].mT).mT)
        return weights


def accumulate(columns: Tensor, group: Group, by_order: Mapping[int, Tensor], table: Tensor, own: bool) -> Tensor:
    """Add a group's equations' derivatives to columns (..., rows of a segment, d', L), by the table (q+1, n, L) of y.

    own: the columns are the group's own, so that its highest derivative counts too. What was written to is returned.
    """
    block = columns[..., group.rows, :, :].unflatten(-3, (group.n_chains, -1))
    for e, c in by_order.items():
        if group.pointwise is not None:
            block.addcmul_(c.unsqueeze(-1), table[e].unsqueeze(-2))
        else:
            product = group.test @ (c.unsqueeze(-1) * table[e].unsqueeze(-2)).flatten(-2)
            block.add_(product.unflatten(-1, block.shape[-2:]))
    if own:
        block.diagonal(dim1=-4, dim2=-2).add_((group.test @ table[-1]).unsqueeze(-1))
    return block


def _made(
    basis: LinearBasis, nodes: NodeSet, order: int, conditioning: str, combinations: Tensor | None = None
) -> _AtNodes:
    """Around the functions that a chain's Hermite constraints do not span."""
    points = nodes.points
    expression = ConstrainedExpression(
        basis.beyond(2 * order),
        hermite(order),
        nodes=nodes,
        order=order,
        conditioning=conditioning,
        combinations=combinations,
        dtype=points.dtype,
        device=points.device,
    )
    return _AtNodes(expression, nodes, order)


@lru_cache(maxsize=64)
def _made_once(basis: LinearBasis, nodes: NodeSet, order: int, conditioning: str) -> _AtNodes:
    """The same for all problems."""
    return _made(basis, nodes, order, conditioning)


def says_all(basis: FreeFunction) -> bool:
    """Whether the arguments of a basis say all of it: nothing is drawn or trained."""
    return isinstance(basis, LinearBasis) and not [*basis.parameters(), *basis.buffers()]


def shared(basis: Free) -> Free:
    """One basis for all that are of a class and called alike, where that says all; any other as it is."""
    if not says_all(basis):
        return basis
    return cast(Free, _made_alike(Keyed((type(basis), meaning([type(basis), basis.arguments], basis)), basis)))


@lru_cache(maxsize=64)
def _made_alike(stated: Keyed[FreeFunction]) -> FreeFunction:
    """Made anew, so that it stays what it is whatever becomes of the caller's."""
    return type(stated.value)(**deepcopy(stated.value.arguments))


def _free(group: Group, table: Tensor) -> Tensor:
    """A trivial chain is its Hermite interpolant: no free function."""
    return table[..., :0] if group.trivial else table
