"""Refinement at the switches: the domain is split there and everything is solved in one least squares.

Coefficients, knot values, switch times and a free final time are unknowns of the same residual, the control sits at its
bound inside every arc (no smoothing is left), and rows S(t_k) = 0 fix the switch times; both papers name this as
future work. The sign of S is then checked on a fine grid, and where the minimum principle asks for other arcs these
are tried: a solved residual with the wrong arcs is an extremal of nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import torch

from ponn_torch.ansatz.basis import Legendre, LinearBasis
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Callback, OptimizeResult, Status, Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.collocation import Collocation, Discretisation
from ponn_torch.optimal_control.control_laws import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import BoundaryValueProblem, Setting
from ponn_torch.solving.guess import project
from ponn_torch.solving.switching import Structure, find_structure, without_short_arcs


class SplitStatus(Enum):
    """How a split ended; the value is the message."""

    CONSISTENT = "the residual is solved and every arc is the one that the sign of S asks for"
    RESIDUAL = "the residual of the split problem did not fall below its tolerance"
    STRUCTURE = "the arcs and the sign of S still disagreed after the last round"
    TOO_MANY_ARCS = "the sign of S asks for more arcs than allowed: a singular arc, or a curve that is no solution"


@dataclass(frozen=True)
class SplitResult:
    """Best curve found, its arcs, how it ended, and every round's optimiser result with the arcs it was given."""

    curve: Curve
    structure: Structure
    status: SplitStatus
    rounds: list[tuple[Structure, OptimizeResult]]


@dataclass(frozen=True)
class Split:
    """Solve between switches until arcs and S agree, then add neurons until the off-node residual is met.

    Attributes:
        n_neurons, nodes_per_neuron: size per arc; neurons grow by ``growth`` up to ``max_neurons``.
        basis: free function per arc, a LinearBasis made for a size (Legendre by default).
        residual_tolerance: ‖r‖ above which a round has failed.
        off_node_tolerance: largest |ẇ − F| off the nodes, scaled.
        short_arc: arcs shorter than this fraction of the final time in a failed round are merged away.
    """

    n_neurons: int = 20
    nodes_per_neuron: float = 1.3
    growth: float = 1.4
    max_neurons: int = 80
    max_rounds: int = 6
    max_arcs: int = 40
    residual_tolerance: float = 1e-7
    off_node_tolerance: float = 1e-9
    short_arc: float = 1e-3
    stopping: Stopping = field(default_factory=lambda: Stopping(tolerance=1e-13, decrease=1e-2, patience=2, max_iterations=40))
    damping: float = 1e-8
    linear_solver: str = "cholesky"
    basis: type[LinearBasis] = Legendre

    def run(self, start: Curve, callback: Callable[[Collocation], Callback] | None = None) -> SplitResult:
        """Refine a smoothed curve; never raises for want of convergence, the status says how it ended.

        ``callback`` makes an iteration callback for the residual of a round.
        """
        bvp, size, rounds = start.collocation.bvp, self.n_neurons, []
        structure = find_structure(start)
        curve, best, status = start, None, SplitStatus.STRUCTURE
        disc = self._discretisation(bvp, size)
        for _ in range(self.max_rounds):
            if len(structure) > self.max_arcs:
                status = SplitStatus.TOO_MANY_ARCS
                break
            curve, result = self._solve(disc, curve, structure, callback)
            rounds.append((structure, result))
            if result.status is Status.INTERRUPTED:
                break
            if not float(result.norm) < self.residual_tolerance:
                status = SplitStatus.RESIDUAL
                repaired = without_short_arcs(structure, curve.times, self.short_arc)
                if repaired.same_arcs(structure):
                    break
                structure = repaired
                continue
            found = find_structure(curve)
            if found.same_arcs(structure):
                status, best = SplitStatus.CONSISTENT, structure
                if curve.off_node_residual() <= self.off_node_tolerance or size >= self.max_neurons:
                    break
                size = min(self.max_neurons, int(size * self.growth) + 1)
                disc, structure = self._discretisation(bvp, size), found
            else:
                status, structure = SplitStatus.STRUCTURE, found
        return SplitResult(curve, best or structure, status, rounds)

    def _discretisation(self, bvp: BoundaryValueProblem, size: int) -> Discretisation:
        n_nodes = int(self.nodes_per_neuron * size) + 4
        nodes = make_nodes("legendre_gauss", n_nodes, dtype=bvp.unit.dtype, device=bvp.unit.device)
        return Discretisation(bvp, self.basis(size), nodes, conditioning="orthonormal")

    def _solve(
        self, disc: Discretisation, curve: Curve, structure: Structure, callback: Callable[[Collocation], Callback] | None
    ) -> tuple[Curve, OptimizeResult]:
        times = torch.cat([curve.times[:1], structure.times, curve.times[-1:]])
        setting = Setting(Regime(arcs=structure.arcs), curve.collocation.setting.parameters)
        collocation = Collocation.on_segments(disc, times, events=structure.events, setting=setting)
        optimizer = LevenbergMarquardt(self.stopping, damping=self.damping, linear_solver=self.linear_solver)
        on_iteration = callback(collocation) if callback else None
        result = optimizer.run(collocation, project(collocation, curve), on_iteration)
        return Curve(collocation, result.xi), result
