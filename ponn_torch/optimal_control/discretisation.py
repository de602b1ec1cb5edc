"""What a collocation residual is made from: nodes, test functions, and the chains' constrained expressions.

Nothing here depends on unknowns, times or boundary values, so one discretisation serves every residual of a boundary
value problem, whatever its segments.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from ponn_torch.ansatz.basis import FreeFunction, LinearBasis
from ponn_torch.ansatz.constraints import SwitchingFunctions, hermite
from ponn_torch.ansatz.networks import MLP
from ponn_torch.numerics.nodes import NodeSet, legendre_moments
from ponn_torch.numerics.tape import Replay
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Chain
from ponn_torch.optimal_control.deep_expressions import DeepExpressions
from ponn_torch.optimal_control.expressions import Expressions, LinearExpressions, shared
from ponn_torch.optimal_control.meaning import Keyed

# -- test functions: how the pointwise residual becomes rows ---------------------------------------------------------


@dataclass(frozen=True)
class Strong:
    """Pointwise rows √w_i R(z_i), so that their sum of squares is the integral of R²."""

    def matrix(self, nodes: NodeSet) -> Tensor:
        return torch.diag(nodes.weights.sqrt())


@dataclass(frozen=True)
class Weak:
    """Moments ⟨R, P_k⟩/(1+k)^decay with orthonormal Legendre P_k, k < n_moments (all nodes if None).

    A residual with a jump has slowly falling moments; the decay keeps them from governing the fit.
    """

    decay: float = 1.0
    n_moments: int | None = None

    def matrix(self, nodes: NodeSet) -> Tensor:
        moments = legendre_moments(nodes, self.n_moments or len(nodes))
        degree = torch.arange(1, moments.shape[0] + 1, dtype=moments.dtype, device=moments.device)
        return moments / degree.unsqueeze(-1) ** self.decay


Form = Strong | Weak


# -- groups: all that depends on neither unknowns nor free functions ---------------------------------------------------


@dataclass(frozen=True, eq=False)
class Group:
    """Chains of one length; a trivial one has no free function.

    columns (d, q) of w, factors (d, q): y^(e) = factors[e] w[columns[e]]; Omega (q+1, n, 2q) is the table of the
    switching functions at the nodes; test (rows, n) makes equations from pointwise ones, pointwise (n,) is its diagonal
    where it is one; rows locates the equations inside a segment, active among those that use F, place the columns among
    those of all groups.
    """

    order: int
    trivial: bool
    columns: Tensor
    factors: Tensor
    switching: SwitchingFunctions
    Omega: Tensor
    test: Tensor
    rows: slice
    active: slice
    place: slice
    pointwise: Tensor | None

    @property
    def n_chains(self) -> int:
        return self.columns.shape[0]

    def of(self, ordered: Tensor) -> Tensor:
        """This group's entries (..., q, d) of w (..., 2n) in the order of the discretisation's columns: a view."""
        return ordered[..., self.place].unflatten(-1, (self.order, -1))

    @property
    def ends(self) -> slice:
        """Where the values at both ends stand among those of all groups, as [group, chain, end, derivative]."""
        return slice(2 * self.place.start, 2 * self.place.stop)


@lru_cache(maxsize=64)
def _hermite(order: int, nodes: NodeSet) -> tuple[SwitchingFunctions, Tensor]:
    """The switching functions of a chain's constraints, and Ω (q+1, n, 2q) at the nodes."""
    switching = SwitchingFunctions(hermite(order), dtype=nodes.points.dtype, device=nodes.points.device)
    return switching, switching(nodes.points, order)[:, :, 0]


@dataclass(frozen=True, eq=False)
class Discretisation:
    """Basis, nodes and form, tabulated for the chains of a boundary value problem; shared by all its residuals.

    combinations: of the basis by chain order, where the conditioning that made them is not to be done again (on another
    machine its singular vectors may differ).
    """

    bvp: BoundaryValueProblem
    basis: FreeFunction
    nodes: NodeSet
    form: Form = field(default_factory=Strong)
    conditioning: str = "orthonormal"
    combinations: Mapping[int, Tensor] = field(default_factory=dict)

    def serving(self, bvp: BoundaryValueProblem) -> Discretisation:
        """The same tables and tapes for another boundary value problem of the same ``equations``.

        Raises:
            ValueError: its equations are others.
        """
        if bvp is self.bvp:
            return self
        if bvp.equations != self.bvp.equations:
            raise ValueError(f"{bvp.problem.name}: its equations are not those of {self.bvp.problem.name}")
        for name, member in vars(Discretisation).items():
            if isinstance(member, cached_property):  # to be in the copy, it has to be there
                getattr(self, name)
        made = copy(self)
        object.__setattr__(made, "bvp", bvp)
        return made

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        groups: list[Group] = []
        kinds = sorted({(len(c.columns), c.trivial) for c in self.bvp.chains})
        for order, trivial in kinds:
            chains = [c for c in self.bvp.chains if (len(c.columns), c.trivial) == (order, trivial)]
            groups.append(self._group(order, trivial, chains, groups[-1] if groups else None))
        return tuple(groups)

    def _group(self, order: int, trivial: bool, chains: Sequence[Chain], before: Group | None) -> Group:
        nodes, like = self.nodes, self.nodes.points
        switching, Omega = _hermite(order, nodes)
        # a trivial chain is the Hermite interpolant, of degree 2q−1: y^(q) = 0 has q coefficients to be met
        test = legendre_moments(nodes, order) if trivial else self.form.matrix(nodes)
        used = 0 if trivial else len(chains)
        rows, active, place = (before.rows.stop, before.active.stop, before.place.stop) if before else (0, 0, 0)
        return Group(
            order=order,
            trivial=trivial,
            columns=torch.tensor([c.columns for c in chains], device=like.device),
            factors=torch.tensor([c.factors for c in chains], dtype=like.dtype, device=like.device),
            switching=switching,
            Omega=Omega,
            test=test,
            rows=slice(rows, rows + len(chains) * test.shape[0]),
            active=slice(active, active + used),
            place=slice(place, place + order * len(chains)),
            pointwise=test.diagonal() if isinstance(self.form, Strong) and not trivial else None,
        )

    @cached_property
    def expressions(self) -> Expressions:
        """The constrained expressions of all chains, around the free function.

        Raises:
            TypeError: a free function that is neither a LinearBasis nor an MLP.
        """
        if isinstance(self.basis, LinearBasis):
            return LinearExpressions(self, self.basis)
        if isinstance(self.basis, MLP):
            return DeepExpressions(self, self.basis)
        raise TypeError(f"basis = {type(self.basis).__name__}; allowed: a LinearBasis or an MLP")

    @cached_property
    def replays(self) -> defaultdict[tuple[object, ...], Replay]:
        """Tapes of what residuals on this discretisation compute, by their structure."""
        return defaultdict(Replay)

    @property
    def n_own(self) -> int:
        """Weights per segment."""
        return self.expressions.n_own

    @property
    def n_rows(self) -> int:
        """Equations per segment."""
        return self.groups[-1].rows.stop

    @cached_property
    def columns(self) -> Tensor:
        """Columns of w in the order [group, derivative, chain]."""
        return torch.cat([g.columns.mT.flatten() for g in self.groups])

    @cached_property
    def _back(self) -> Tensor:
        return torch.argsort(self.columns)

    def ordered(self, w: Tensor) -> Tensor:
        """w (..., 2n) in the order of ``columns``, in which every group's are a slice."""
        return w.index_select(-1, self.columns)

    def assemble(self, pieces: Sequence[Tensor]) -> Tensor:
        """Rows [group, derivative, chain] (..., ·, n) → w (..., n, 2n)."""
        return torch.cat(list(pieces), -2).index_select(-2, self._back).mT

    @cached_property
    def last_columns(self) -> Tensor:
        """Columns of F that the non-trivial chains' equations use, in the order of the groups."""
        none = torch.zeros(0, dtype=torch.long, device=self.nodes.points.device)
        return torch.cat([none, *(g.columns[:, -1] for g in self.groups if not g.trivial)])

    def active_orders(self, group: Group, other: Group) -> list[int]:
        """Derivatives e of the other group's chains that this group's equations depend on."""
        return self._active_orders[self.groups.index(group), self.groups.index(other)]

    @cached_property
    def _active_orders(self) -> dict[tuple[int, int], list[int]]:
        out = {}
        for i, group in enumerate(self.groups):
            for j, other in enumerate(self.groups):
                depends = self.bvp.couplings[group.columns[:, -1]][:, other.columns].any(0).any(0).tolist()
                out[i, j] = [] if group.trivial else [e for e in range(other.order) if depends[e]]
        return out


def discretise(
    bvp: BoundaryValueProblem, basis: FreeFunction, nodes: NodeSet, form: Form, conditioning: str
) -> Discretisation:
    """Tables and tapes are the same for the same equations and parts: those of one solve serve the next.

    The free function is taken in the nodes' dtype and on their device, as a copy where it is not there; the caller's
    is left as it is. One whose weights were changed in place is another one.
    """
    basis = _placed(shared(basis), _versions(basis), nodes.points.dtype, nodes.points.device)
    return _discretise(Keyed(bvp.equations, bvp), basis, nodes, form, conditioning, _versions(basis)).serving(bvp)


def _tensors(basis: FreeFunction) -> list[Tensor]:
    return [*basis.parameters(), *basis.buffers()]


def _versions(basis: FreeFunction) -> tuple[tuple[int, int], ...]:
    """What tells a free function from the same one with its weights changed in place."""
    return tuple((id(x), x._version) for x in _tensors(basis))


@lru_cache(maxsize=32)
def _placed(
    basis: FreeFunction, versions: tuple[tuple[int, int], ...], dtype: torch.dtype, device: torch.device
) -> FreeFunction:
    """The free function itself where it is in this dtype and on this device, else a copy that is."""
    there = all(x.device == device and (x.dtype == dtype or not x.is_floating_point()) for x in _tensors(basis))
    return basis if there else deepcopy(basis).to(dtype=dtype, device=device)


@lru_cache(maxsize=32)
def _discretise(
    stated: Keyed[BoundaryValueProblem],
    basis: FreeFunction,
    nodes: NodeSet,
    form: Form,
    conditioning: str,
    weights: tuple[tuple[int, int], ...],
) -> Discretisation:
    return Discretisation(stated.value, basis, nodes, form, conditioning)
