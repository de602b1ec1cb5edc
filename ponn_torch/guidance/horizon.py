"""The linear boundary value problem of one horizon, solved by collocation of a constrained expression.

y' = M(t) y + c(t) for states and costates y = (x, λ), with x(0) = x0 and the relative condition
λ(T) = S x(T) + s, which a terminal cost ½(x(T) − xf)ᵀ S (x(T) − xf) turns into s = −S xf. With z ∈ [−1, 1] and
free functions φ,

    x = (φ − φ(−1))ᵀ βx + x0,    λ = (φ − φ(1))ᵀ βλ + S x(T) + s,    x(T) = (φ(1) − φ(−1))ᵀ βx + x0

hold the conditions whatever β is. (The RHC paper [3] writes φ(1)ᵀ βx for x(T), which is wrong unless S = 0.)
x0, S and s are data of the run; the tables depend on neither them nor the duration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from ponn_torch.ansatz.basis import Lagrange, LinearBasis
from ponn_torch.guidance.elimination import ROUTES, Solve
from ponn_torch.numerics.nodes import NodeSet, interpolation_matrix, make_nodes
from ponn_torch.optimal_control.problem import nearest


@dataclass(frozen=True, eq=False)
class LinearTPBVP:
    """y' = M y + c over a duration, given at the solver's nodes; leading axes "..." broadcast to those of M.

    matrix: (..., N, 2n, 2n), per unit of time. drift: (..., N, 2n). initial: x0 (..., n).
    duration: a number, or (...). terminal_matrix: S (..., n, n), None for 0. terminal_offset: s (..., n), None for 0.
    """

    matrix: Tensor
    drift: Tensor
    duration: float | Tensor
    initial: Tensor
    terminal_matrix: Tensor | None = None
    terminal_offset: Tensor | None = None

    @property
    def n_states(self) -> int:
        return self.matrix.shape[-1] // 2

    def terminal_costate(self, final: Tensor) -> Tensor:
        """S x + s for x (..., n)."""
        costate = torch.zeros_like(final)
        if self.terminal_matrix is not None:
            costate = costate + (self.terminal_matrix @ final.unsqueeze(-1)).squeeze(-1)
        return costate if self.terminal_offset is None else costate + self.terminal_offset


@dataclass(frozen=True, eq=False)
class _Tables:
    """Values of the free functions that carry coefficients, each (..., m, L), and slopes dφ/dz."""

    states: Tensor
    costates: Tensor
    slopes: Tensor


@dataclass(frozen=True, eq=False)
class HorizonSolver:
    """Solves any number of linear boundary value problems on one basis and one set of nodes.

    basis: free functions φ; polynomials should leave out the constant, which x0 and λ(T) span: Chebyshev(L, 1).
    Gaussians with shapes (..., L) solve all of them at once. nodes: N collocation points; the system is square
    for N = L. embedded: whether the expression holds the boundary conditions; else y = φᵀ β and they are 2n
    further equations, which is how pseudospectral methods state them. route: one of ROUTES.

    Raises ValueError for an unknown route, and when there are fewer equations than coefficients.
    """

    basis: LinearBasis
    nodes: NodeSet
    embedded: bool = True
    route: str = "lu"
    _wide: dict[int, Tensor] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.route not in ROUTES:
            raise ValueError(f"route = {self.route!r}; {nearest(self.route, ROUTES)}")
        equations = len(self.nodes) + (not self.embedded)
        if equations < self.basis.size:
            raise ValueError(
                f"basis has {self.basis.size} functions for {len(self.nodes)} nodes; allowed: at most {equations}"
            )

    # -- tables ------------------------------------------------------------------------------------

    def tables(self, z: Tensor) -> _Tables:
        """At z (m,)."""
        values, slopes = self.basis.features(z, 1)
        if not self.embedded:
            return _Tables(values, values, slopes)
        start, end = self._ends
        return _Tables(values - start, values - end, slopes)

    @cached_property
    def _ends(self) -> tuple[Tensor, Tensor]:
        """φ(−1) and φ(1), (..., 1, L)."""
        values = self.basis.features(self.nodes.points.new_tensor([-1.0, 1.0]), 0)[0]
        return values[..., :1, :], values[..., 1:, :]

    @cached_property
    def _at_nodes(self) -> _Tables:
        return self.tables(self.nodes.points)

    @cached_property
    def _rise(self) -> Tensor:
        """φ(1) − φ(−1), (..., L): what x(T) is beyond x0."""
        start, end = self._ends
        return (end - start).squeeze(-2)

    # -- equations ---------------------------------------------------------------------------------

    def equations(self, problem: LinearTPBVP) -> Tensor:
        """The matrix (..., R, 2nL): ẏ − M y of every coefficient at every node."""
        n, tables = problem.n_states, self._at_nodes
        # with the tables repeated, one product of arrays with long rows: a quarter of an einsum's time
        blocks = problem.matrix.unsqueeze(-2) * self._repeated(n)  # (..., N, 2n, L, 2n)
        if self.embedded and problem.terminal_matrix is not None:
            relative = problem.matrix[..., n:] @ problem.terminal_matrix.unsqueeze(-3)  # (..., N, 2n, n)
            rise = self._rise[..., None, None, :, None]
            blocks[..., :n].addcmul_(relative.unsqueeze(-2), rise, value=-1.0)
        rate = 2.0 / problem.duration
        if isinstance(rate, Tensor):
            rate = rate[..., None, None]
        blocks.diagonal(dim1=-3, dim2=-1).add_((rate * tables.slopes).unsqueeze(-1))
        matrix = blocks.flatten(-2).flatten(-3, -2)
        return matrix if self.embedded else torch.cat([matrix, self._boundary(problem, matrix)], dim=-2)

    def _repeated(self, n: int) -> Tensor:
        """The negative tables at the nodes, (..., N, 1, L, 2n): n times the states', n times the costates'."""
        if n not in self._wide:
            pair = (self._at_nodes.states, self._at_nodes.costates)
            self._wide[n] = torch.cat([-half.unsqueeze(-1).repeat_interleave(n, -1) for half in pair], -1).unsqueeze(-3)
        return self._wide[n]

    def right_side(self, problem: LinearTPBVP) -> Tensor:
        """(..., R) that belongs to `equations`."""
        if not self.embedded:
            offset = problem.terminal_costate(torch.zeros_like(problem.initial))
            parts = torch.broadcast_tensors(*(p.unsqueeze(-2) for p in (problem.initial, offset)))
            ends = torch.cat(parts, dim=-1)
            shape = torch.broadcast_shapes(problem.drift.shape[:-2], ends.shape[:-2])
            given = (problem.drift.expand(*shape, *problem.drift.shape[-2:]), ends.expand(*shape, *ends.shape[-2:]))
            return torch.cat([part.flatten(-2) for part in given], dim=-1)
        known = self._known(problem)
        if known.dim() == 1:
            return (problem.drift + problem.matrix @ known).flatten(-2)
        return (problem.drift + (problem.matrix @ known[..., None, :, None]).squeeze(-1)).flatten(-2)

    def _known(self, problem: LinearTPBVP) -> Tensor:
        """What y is for coefficients 0, (..., 2n): constant over the horizon."""
        return torch.cat([problem.initial, problem.terminal_costate(problem.initial)], dim=-1)

    def _boundary(self, problem: LinearTPBVP, like: Tensor) -> Tensor:
        """The rows x(0) = x0 and λ(T) − S x(T) = s, (..., 2n, 2nL)."""
        n, (start, end) = problem.n_states, self._ends
        rows = like.new_zeros(*like.shape[:-2], 2 * n, self.basis.size, 2 * n)
        eye = torch.eye(n, dtype=like.dtype, device=like.device)
        rows[..., :n, :, :n] = start.mT * eye.unsqueeze(-2)
        rows[..., n:, :, n:] = end.mT * eye.unsqueeze(-2)
        if problem.terminal_matrix is not None:
            rows[..., n:, :, :n] = -end.mT * problem.terminal_matrix.unsqueeze(-2)
        return rows.flatten(-2)

    # -- solving -----------------------------------------------------------------------------------

    def factor(self, problem: LinearTPBVP) -> FactoredHorizon:
        """Factor once for any number of initial states, terminal offsets and drifts."""
        matrix = self.equations(problem)
        return FactoredHorizon(self, problem, matrix, ROUTES[self.route](matrix, problem.n_states))

    def solve(self, problem: LinearTPBVP) -> HorizonSolution:
        """Assemble, factor, solve."""
        return self.factor(problem).solve(problem)

    def values(self, coefficients: Tensor, problem: LinearTPBVP, z: Tensor) -> Tensor:
        """y (..., m, 2n) at z (m,) for coefficients (..., L, 2n), whether they solve the problem or not."""
        return self._values(coefficients, problem, self.tables(z))

    def _values(self, coefficients: Tensor, problem: LinearTPBVP, tables: _Tables) -> Tensor:
        n = problem.n_states
        states, costates = tables.states @ coefficients[..., :n], tables.costates @ coefficients[..., n:]
        if not self.embedded:
            return torch.cat([states, costates], dim=-1)
        final = (self._rise.unsqueeze(-2) @ coefficients[..., :n]).squeeze(-2) + problem.initial
        costates = costates + problem.terminal_costate(final).unsqueeze(-2)
        return torch.cat([states + problem.initial.unsqueeze(-2), costates], dim=-1)


@dataclass(frozen=True, eq=False)
class FactoredHorizon:
    """The factors of one problem's matrix (batch included): what remains to be solved is linear in x0, s and c."""

    solver: HorizonSolver
    problem: LinearTPBVP
    matrix: Tensor
    eliminate: Solve

    def solve(self, problem: LinearTPBVP) -> HorizonSolution:
        """For a problem that differs from the factored one in initial state, terminal offset and drift only."""
        right = self.solver.right_side(problem)
        if self.matrix.dim() == 2:  # one matrix: a batch is so many right-hand sides
            solution = self.eliminate(right.reshape(-1, right.shape[-1]).mT).mT.reshape(*right.shape[:-1], -1)
        else:
            solution = self.eliminate(right.unsqueeze(-1)).squeeze(-1)
        coefficients = solution.unflatten(-1, (self.solver.basis.size, 2 * problem.n_states))
        return HorizonSolution(self.solver, problem, coefficients, self.matrix, right)

    def affine(self) -> AffineHorizon:
        """The solution as an affine function of x0 about the problem's own, by n + 1 right-hand sides."""
        solver, problem, n = self.solver, self.problem, self.problem.n_states
        linear = replace(problem, drift=torch.zeros_like(problem.drift), terminal_offset=None)
        units = torch.eye(n, dtype=problem.initial.dtype, device=problem.initial.device)
        columns = [solver.right_side(replace(linear, initial=unit.expand_as(problem.initial))) for unit in units]
        solution = self.eliminate(torch.stack([*columns, solver.right_side(problem)], dim=-1))
        size = (solver.basis.size, 2 * n)
        return AffineHorizon(
            solver, problem, solution[..., :-1].unflatten(-2, size), solution[..., -1].unflatten(-1, size)
        )


@dataclass(frozen=True, eq=False)
class AffineHorizon:
    """Coefficients about + gain (x0 − x̄0): one factorisation for any number of vehicles, two products a solve.

    problem: the one solved, with x̄0; near it few digits are lost. gain: (..., L, 2n, n). about: (..., L, 2n).
    """

    solver: HorizonSolver
    problem: LinearTPBVP
    gain: Tensor
    about: Tensor

    def coefficients(self, initial: Tensor) -> Tensor:
        """(..., V, L, 2n) for V vehicles x0 (..., V, n)."""
        change = initial - self.problem.initial.unsqueeze(-2)
        flat = change @ self.gain.flatten(-3, -2).mT + self.about.flatten(-2).unsqueeze(-2)
        return flat.unflatten(-1, self.about.shape[-2:])

    def values(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """y at z (m,) as (matrix (..., m, 2n, n), offset (..., m, 2n)): y = offset + matrix (x0 − x̄0)."""
        problem, solver = self.problem, self.solver
        linear = replace(problem, terminal_offset=None)
        units = torch.eye(problem.n_states, dtype=self.gain.dtype, device=self.gain.device)
        columns = [solver.values(self.gain[..., j], replace(linear, initial=e), z) for j, e in enumerate(units)]
        return torch.stack(columns, dim=-1), solver.values(self.about, problem, z)


@dataclass(frozen=True, eq=False)
class HorizonSolution:
    """Coefficients (..., L, 2n) of a solved horizon, and what tells how well they solve it.

    `loss` is what the papers call accuracy: ‖equations β − right side‖₂. For a square system it is round-off,
    however poor the basis is; what lies between the nodes shows in `off_node_residual`.
    """

    solver: HorizonSolver
    problem: LinearTPBVP
    coefficients: Tensor
    matrix: Tensor
    right: Tensor

    @cached_property
    def loss(self) -> Tensor:
        """(...,); infinite where the coefficients are not finite."""
        product = (self.matrix @ self.coefficients.flatten(-2).unsqueeze(-1)).squeeze(-1)
        loss = torch.linalg.vector_norm(product - self.right, dim=-1)
        return torch.where(loss.isfinite(), loss, torch.inf)

    @cached_property
    def condition(self) -> Tensor:
        """2-norm condition of the matrix (...,); a singular value decomposition, so not for every cycle."""
        finite = self.matrix.isfinite().all(-1).all(-1)
        matrix = torch.where(finite[..., None, None], self.matrix, torch.zeros_like(self.matrix))
        values = torch.linalg.svdvals(matrix)
        return torch.where(finite & (values[..., -1] > 0), values[..., 0] / values[..., -1], torch.inf)

    @cached_property
    def at_nodes(self) -> Tensor:
        """y (..., N, 2n)."""
        return self.solver._values(self.coefficients, self.problem, self.solver._at_nodes)

    def values(self, z: Tensor) -> Tensor:
        """y (..., m, 2n) at z (m,)."""
        return self.solver.values(self.coefficients, self.problem, z)

    def rates(self, z: Tensor) -> Tensor:
        """dy/dt (..., m, 2n) at z (m,)."""
        slopes = self.solver.tables(z).slopes @ self.coefficients
        rate = 2.0 / self.problem.duration
        return slopes * (rate[..., None, None] if isinstance(rate, Tensor) else rate)

    def off_node_residual(
        self, z: Tensor | None = None, system: Callable[[Tensor], tuple[Tensor, Tensor]] | None = None
    ) -> Tensor:
        """Largest |y' − M y − c| between the nodes, over the largest sum of terms of the equation, (...,).

        z: by default the midpoints of neighbouring nodes and ends. system: M (..., m, 2n, 2n) and c (..., m, 2n) at
        z; by default the polynomials through their values at the nodes, exact where M and c are constant.
        """
        points = self.solver.nodes.points
        if z is None:
            ends = torch.cat([points.new_tensor([-1.0]), points, points.new_tensor([1.0])]).unique()
            z = (ends[1:] + ends[:-1]) / 2
        if system is None:
            between = interpolation_matrix(points, z)
            matrix = torch.einsum("mk,...kij->...mij", between, self.problem.matrix)
            drift = between @ self.problem.drift
        else:
            matrix, drift = system(z)
        y = self.values(z).unsqueeze(-1)
        residual = (self.rates(z) - (matrix @ y).squeeze(-1) - drift).abs().amax(-2)
        terms = ((matrix.abs() @ y.abs()).squeeze(-1) + drift.abs()).amax(-2)
        floor = torch.finfo(y.dtype).eps * terms.amax(-1, keepdim=True)  # an equation may say y' = 0
        worst = (residual / torch.maximum(terms, floor).clamp_min(torch.finfo(y.dtype).tiny)).amax(-1)
        return torch.where(worst.isfinite(), worst, torch.inf)


# -- pseudospectral methods ------------------------------------------------------------------------


def pseudospectral(
    kind: str, n_nodes: int, *, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
) -> HorizonSolver:
    """An indirect pseudospectral method: Lagrange polynomials, boundary conditions as equations.

    legendre_radau (IRPM) adds the end +1 to its collocation points, legendre_gauss (IGPM) the end −1, which makes
    2n N + 2n equations for as many coefficients. legendre_lobatto (ILPM) has both ends already: 2n equations too
    many, so it is solved by least squares, and nothing is met exactly.
    """
    nodes = make_nodes(kind, n_nodes, dtype=dtype, device=device)
    start, end = (nodes.points.new_tensor([side]) for side in (-1.0, 1.0))
    supports = {
        "legendre_lobatto": nodes.points,
        "legendre_radau": torch.cat([nodes.points, end]),
        "legendre_gauss": torch.cat([start, nodes.points]),
    }
    if kind not in supports:
        raise ValueError(f"kind = {kind!r}; {nearest(kind, supports)}")
    route = "qr" if kind == "legendre_lobatto" else "lu"
    return HorizonSolver(Lagrange(supports[kind]), nodes, embedded=False, route=route)
