"""An optimal control problem as a nonlinear program by Legendre–Gauss–Radau collocation on phases.

A phase is a stretch of time whose duration may be unknown and whose control may be pinned to an arc. States are
polynomials of degree d on every segment through its left end and d Radau points, the last of which is the right end;
controls live at the Radau points. All variables are scaled by the problem's units, and costates follow from the
multipliers of the defects: λ = −Λ/w (covector mapping, w the quadrature weight).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ponn_torch.baselines.controls import ControlVariables, Limits, control_variables, problem_units
from ponn_torch.baselines.symbolic import Symbols, evaluate, load_casadi
from ponn_torch.numerics.nodes import differentiation_matrix, make_nodes
from ponn_torch.optim.base import Stopwatch
from ponn_torch.optimal_control.problem import Named, OptimalControlProblem

Array = NDArray[np.float64]
PathConstraints = Callable[[Tensor, Named, Named, Named], Tensor]


@dataclass(frozen=True)
class Phase:
    """``n_segments`` equal segments; ``codes`` pins the control to an arc, None leaves it free."""

    n_segments: int
    codes: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Point:
    """What the program is about: durations (P,), states (K·d + 1, n) and control variables (K·d, m), all scaled."""

    durations: Array
    states: Array
    controls: Array


@dataclass(frozen=True)
class Answer:
    """A point with the costates (K·d, n) of its multipliers, the scaled cost, and what the program's solver said."""

    point: Point
    costates: Array
    cost: float
    solved: bool
    status: str
    n_iterations: int
    seconds: float


@dataclass(frozen=True)
class RadauRule:
    """Nodes on [0, 1]: (d,) points with the right end, weights, and the derivative matrix (d, d + 1)."""

    points: Array
    weights: Array
    derivative: Array

    @classmethod
    def of_degree(cls, degree: int) -> RadauRule:
        nodes = make_nodes("legendre_radau", degree)
        points = (1.0 - nodes.points.flip(0)) / 2
        support = torch.cat([points.new_zeros(1), points])
        derivative = differentiation_matrix(support)[1:]
        return cls(points.numpy(), (nodes.weights.flip(0) / 2).numpy(), derivative.numpy())


@dataclass(frozen=True, eq=False)
class Program:
    """The nonlinear program of a problem on given phases; built once, solved from any point.

    With several phases, or a free final time, durations are unknown.

    Attributes:
        softening: of the control set where it is not pinned, see ``control_variables``.
        shortest: least duration of a phase, as a fraction of the (guessed) final time. Where it were zero, a phase
            without duration would be stationary whatever its control.
        path_constraints: (t, x, u, p) → (..., k) of order one, at most zero at every Radau point; the direct method
            can impose what the indirect one cannot.
        options: for IPOPT.
    """

    problem: OptimalControlProblem
    phases: Sequence[Phase] = (Phase(30),)
    degree: int = 4
    softening: float = 0.0
    shortest: float = 1e-4
    path_constraints: PathConstraints | None = None
    options: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def rule(self) -> RadauRule:
        return RadauRule.of_degree(self.degree)

    @cached_property
    def variables(self) -> ControlVariables:
        return control_variables(self.problem, self.softening)

    @cached_property
    def state_unit(self) -> Array:
        return problem_units(self.problem).numpy()

    @property
    def n_segments(self) -> int:
        return sum(phase.n_segments for phase in self.phases)

    @property
    def n_nodes(self) -> int:
        """Radau points; the left end of the first segment is one more time."""
        return self.n_segments * self.degree

    @property
    def _final_time(self) -> float:
        return self.problem.time_guess / self.problem.unit("time")

    def node_times(self, durations: Array) -> Array:
        """Scaled times (K·d + 1,) of the states."""
        lengths = np.concatenate(
            [np.full(p.n_segments, duration / p.n_segments) for p, duration in zip(self.phases, durations, strict=True)]
        )
        starts = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
        return np.concatenate([[0.0], (starts[:, None] + lengths[:, None] * self.rule.points).ravel()])

    # -- the functions of the problem --------------------------------------------------------------------------------

    @cached_property
    def _pointwise(self) -> Any:
        """(t, x, ν) → scaled (rates, running cost, rows of the control and of the path) at one node."""
        ca, problem, variables = load_casadi(), self.problem, self.variables
        unit, time_unit = torch.from_numpy(self.state_unit), problem.unit("time")

        def outputs(t: Tensor, x: Tensor, nu: Tensor) -> Tensor:
            state, seconds = x * unit, t * time_unit
            p = Named(**{name: torch.full_like(t, value) for name, value in problem.parameters.items()})
            u, named = Named(**variables.controls(nu)), problem.named(state)
            rates = problem.stack(problem.dynamics(seconds, named, u, p), state) * (time_unit / unit)
            cost = torch.zeros_like(t)
            if problem.running_cost is not None:
                cost = problem.running_cost(seconds, named, u, p) * (time_unit / problem.unit("cost"))
            rows = [] if variables.rows is None else [variables.rows(nu)]
            if self.path_constraints is not None:
                rows.append(self.path_constraints(seconds, named, u, p))
            return torch.cat([rates, cost, *rows], -1)

        symbols = [ca.SX.sym(name, size) for name, size in (("t", 1), ("x", len(unit)), ("nu", variables.size))]
        values = evaluate(outputs, *map(_row, symbols)).ravel()
        n = len(unit)
        parts = [ca.vertcat(*values[a:b]) for a, b in ((0, n), (n, n + 1), (n + 1, len(values)))]
        return ca.Function("pointwise", symbols, parts)

    @cached_property
    def _terminal(self) -> Any:
        """(t, x) → scaled terminal cost and manifold at the end."""
        ca, problem, unit = load_casadi(), self.problem, torch.from_numpy(self.state_unit)

        def outputs(t: Tensor, x: Tensor) -> Tensor:
            seconds, named = t * problem.unit("time"), problem.named(x * unit)
            p = Named(**{name: torch.full_like(t, value) for name, value in problem.parameters.items()})
            parts = [torch.zeros_like(t)]
            if problem.terminal_cost is not None:
                parts = [problem.terminal_cost(seconds, named, p) / problem.unit("cost")]
            if problem.terminal_manifold is not None:
                parts.append(problem.terminal_manifold(seconds, named, p))
            return torch.cat(parts, -1)

        symbols = [ca.SX.sym("t", 1), ca.SX.sym("x", len(unit))]
        values = evaluate(outputs, *map(_row, symbols)).ravel()
        return ca.Function("terminal", symbols, [values[0], ca.vertcat(*values[1:])])

    # -- the program ---------------------------------------------------------------------------------------------------

    @cached_property
    def _solver(self) -> tuple[Any, dict[str, Any]]:
        ca = load_casadi()
        n, m, n_nodes, d = len(self.state_unit), self.variables.size, self.n_nodes, self.degree
        durations = ca.MX.sym("durations", len(self.phases))
        states, controls = ca.MX.sym("x", n, n_nodes + 1), ca.MX.sym("nu", m, n_nodes)
        counts = [phase.n_segments for phase in self.phases]

        def constant(matrix: Any) -> Any:
            return ca.sparsify(ca.DM(matrix))

        spread = constant(np.repeat(np.eye(len(counts)) / np.array(counts), counts, axis=0))
        lengths = ca.mtimes(spread, durations).T
        starts = ca.mtimes(lengths, constant(np.triu(np.ones((self.n_segments,) * 2), 1)))
        by_node = constant(np.kron(np.eye(self.n_segments), np.ones((1, d))))
        step = ca.mtimes(lengths, by_node)
        times = ca.mtimes(starts, by_node) + step * ca.DM(np.tile(self.rule.points, self.n_segments)).T
        rates, cost, node_rows = self._pointwise.map(n_nodes)(times, states[:, 1:], controls)
        derivative = np.zeros((n_nodes + 1, n_nodes))
        for k in range(self.n_segments):
            derivative[k * d : k * d + d + 1, k * d : (k + 1) * d] = self.rule.derivative.T
        defects = ca.mtimes(states, constant(derivative)) - rates * ca.repmat(step, n, 1)
        end_cost, manifold = self._terminal(ca.sum1(durations), states[:, -1])
        quadrature = ca.DM(np.tile(self.rule.weights, self.n_segments)).T
        objective = ca.sum2(cost * step * quadrature) + end_cost
        rows = [ca.vec(defects), ca.vec(node_rows), manifold, ca.sum1(durations)]
        sizes = [row.numel() for row in rows]
        limits = self._limits
        path = node_rows.shape[0] - self.variables.n_rows  # these come last at every node
        row_lower = [value for limit in limits for value in (*limit.row_lower, *[-np.inf] * path)]
        row_upper = [value for limit in limits for value in (*limit.row_upper, *[0.0] * path)]
        total = [0.0, np.inf] if self.problem.free_final_time else [self._final_time] * 2
        still = np.zeros(sizes[0]), np.zeros(sizes[2])
        rows_lower = np.concatenate([still[0], row_lower, still[1], total[:1]])
        rows_upper = np.concatenate([still[0], row_upper, still[1], total[1:]])
        unknowns = ca.vertcat(durations, ca.vec(states), ca.vec(controls))
        options = {
            "print_time": False,
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "tol": 1e-11,
                "constr_viol_tol": 1e-11,
                "compl_inf_tol": 1e-11,
                "bound_relax_factor": 0.0,
                "max_iter": 500,
                **self.options,
            },
        }
        program = {"x": unknowns, "f": objective, "g": ca.vertcat(*rows)}
        solver = ca.nlpsol("program", "ipopt", program, options)
        return solver, {"lbg": rows_lower, "ubg": rows_upper, **self._bounds()}

    @property
    def _limits(self) -> list[Limits]:
        """Of the control at every Radau point."""
        return [
            self.variables.free if phase.codes is None else self.variables.pinned(phase.codes)
            for phase in self.phases
            for _ in range(phase.n_segments * self.degree)
        ]

    def _bounds(self) -> dict[str, Array]:
        problem, shape = self.problem, (self.n_nodes + 1, len(self.state_unit))
        lower, upper = np.full(shape, -np.inf), np.full(shape, np.inf)
        for row, end in ((0, "initial"), (-1, "final")):
            for i, value in enumerate(problem.boundary(end)):
                if value is not None:
                    lower[row, i] = upper[row, i] = value / self.state_unit[i]
        if problem.mass is not None:
            mass = problem.slices[problem.mass].start
            lower[:, mass] = np.maximum(lower[:, mass], 1e-3)  # no path to an optimum leads through negative masses
        shortest = self.shortest * self._final_time
        longest = np.inf if problem.free_final_time else self._final_time
        limits, n_phases = self._limits, len(self.phases)
        return {
            "lbx": _flat(np.full(n_phases, shortest), lower, np.array([limit.lower for limit in limits])),
            "ubx": _flat(np.full(n_phases, longest), upper, np.array([limit.upper for limit in limits])),
        }

    def build(self) -> float:
        """Make the solver, if it is not made yet; CPU seconds."""
        watch = Stopwatch()
        _ = self._solver
        return watch.seconds

    def solve(self, start: Point) -> Answer:
        """Solve from a point; whether that succeeded is in the answer."""
        solver, bounds = self._solver
        watch = Stopwatch()
        found = solver(x0=_flat(start.durations, start.states, start.controls), **bounds)
        seconds, stats = watch.seconds, solver.stats()
        n, n_nodes, n_phases = len(self.state_unit), self.n_nodes, len(self.phases)
        x = np.asarray(found["x"]).ravel()
        states_end = n_phases + n * (n_nodes + 1)
        multipliers = np.asarray(found["lam_g"]).ravel()[: n * n_nodes].reshape(n_nodes, n)
        costates = -multipliers / np.tile(self.rule.weights, self.n_segments)[:, None]
        return Answer(
            point=Point(
                durations=x[:n_phases],
                states=x[n_phases:states_end].reshape(n_nodes + 1, n),
                controls=x[states_end:].reshape(n_nodes, -1),
            ),
            costates=costates,
            cost=float(found["f"]),
            solved=bool(stats["success"]),
            status=str(stats["return_status"]),
            n_iterations=int(stats["iter_count"]),
            seconds=seconds,
        )


def _flat(durations: Array, states: Array, controls: Array) -> Array:
    return np.concatenate([durations, states.ravel(), controls.ravel()])


def _row(symbol: Any) -> Symbols:
    """A column of CasADi symbols as an array (1, n)."""
    return np.array([[symbol[i] for i in range(symbol.numel())]], dtype=object)
