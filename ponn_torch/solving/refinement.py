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
from torch import Tensor

from ponn_torch.ansatz.basis import Legendre, LinearBasis
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Callback, OptimizeResult, Status, Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.collocation import Collocation, Discretisation
from ponn_torch.optimal_control.control_laws import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import Setting
from ponn_torch.solving.guess import project
from ponn_torch.solving.switching import Structure, find_structure, without_short_arcs


class SplitStatus(Enum):
    """How a split ended; the value is the message."""

    CONSISTENT = "the residual is solved and every arc is the one that the sign of S asks for"
    RESIDUAL = "the residual of the split problem did not fall below its tolerance"
    STRUCTURE = "the arcs and the sign of S still disagreed after the last round"
    COARSE = "the arcs are right, but the residual between the nodes is above its tolerance"
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
    """Solve between switches until arcs and S agree and the equations hold between the nodes.

    Every arc is one or more segments with the same few neurons; a segment whose off-node residual is too large is halved.
    Small blocks are what makes it fast: the arrow elimination costs n_segments × n_neurons³.

    Attributes:
        n_neurons, n_nodes: size of a segment.
        n_segments: number of segments that the first round spreads over the arcs, by their duration.
        basis: the free function of a segment (Legendre by default).
        residual_tolerance: ‖r‖ above which a round has failed.
        off_node_tolerance: largest |ẇ − F| off the nodes, scaled.
        short_arc: arcs shorter than this fraction of the final time in a failed round are merged away.
    """

    n_neurons: int = 14
    n_nodes: int = 20
    n_segments: int = 8
    max_segments: int = 128
    max_rounds: int = 8
    max_arcs: int = 40
    residual_tolerance: float = 1e-6
    off_node_tolerance: float = 1e-9
    short_arc: float = 1e-3
    stopping: Stopping = field(
        default_factory=lambda: Stopping(tolerance=1e-13, decrease=1e-2, patience=2, max_iterations=40)
    )
    damping: float = 1e-8
    linear_solver: str = "cholesky"
    basis: Callable[[int], LinearBasis] = Legendre

    def run(self, start: Curve, callback: Callable[[Collocation], Callback] | None = None) -> SplitResult:
        """Refine a smoothed curve; never raises for want of convergence, the status says how it ended.

        ``callback`` makes an iteration callback for the residual of a round.
        """
        bvp, rounds = start.collocation.bvp, []
        nodes = make_nodes("legendre_gauss", self.n_nodes, dtype=bvp.unit.dtype, device=bvp.unit.device)
        disc = Discretisation(bvp, self.basis(self.n_neurons), nodes, conditioning="orthonormal")
        curve, status = start, SplitStatus.STRUCTURE
        structure = find_structure(start)
        knots, events, arcs = _spread_segments(structure, start.times, self.n_segments)
        for _ in range(self.max_rounds):
            if len(structure) > self.max_arcs or len(knots) > self.max_segments:
                return SplitResult(curve, structure, SplitStatus.TOO_MANY_ARCS, rounds)
            regime = Regime(arcs=arcs if bvp.law.n_switching else None)
            setting = Setting(regime, start.collocation.setting.parameters)
            collocation = Collocation.on_segments(disc, knots, events=events, setting=setting)
            optimizer = LevenbergMarquardt(self.stopping, damping=self.damping, linear_solver=self.linear_solver)
            on_iteration = callback(collocation) if callback else None
            result = optimizer.run(collocation, project(collocation, curve), on_iteration)
            rounds.append((structure, result))
            solved = Curve(collocation, result.xi)
            if result.status is Status.INTERRUPTED:
                return SplitResult(solved, structure, SplitStatus.RESIDUAL, rounds)
            if not float(result.norm) < self.residual_tolerance:
                status = SplitStatus.RESIDUAL
                repaired = without_short_arcs(structure, solved.times[[0, *collocation.switch_knots, -1]], self.short_arc)
                if repaired.same_arcs(structure):
                    # too few neurons look the same as a wrong structure: twice the segments, from the same start
                    knots, events, arcs = _halved(knots, events, arcs)
                else:
                    curve, structure = solved, repaired
                    knots, events, arcs = _spread_segments(structure, solved.times, self.n_segments)
                continue
            curve, found = solved, find_structure(solved)
            if not found.same_arcs(structure):
                status, structure = SplitStatus.STRUCTURE, found
                knots, events, arcs = _spread_segments(found, solved.times, self.n_segments)
                continue
            coarse = solved.off_node_residuals() > self.off_node_tolerance
            if not bool(coarse.any()):
                return SplitResult(curve, structure, SplitStatus.CONSISTENT, rounds)
            status = SplitStatus.COARSE
            knots, events, arcs = _halved(solved.times, events, arcs, coarse)
        return SplitResult(curve, structure, status, rounds)


Segments = tuple[Tensor, tuple[int | None, ...], Tensor]  # knot times (K+1,), events (K−1), arc codes (K, m)


def _spread_segments(structure: Structure, times: Tensor, n_segments: int) -> Segments:
    """Cut every arc into equal segments, about n_segments in all, more where an arc is longer."""
    ends = torch.cat([times[:1], structure.times, times[-1:]])
    share = (ends[1:] - ends[:-1]) / (ends[-1] - ends[0]) * n_segments
    counts = share.round().clamp_min(1).long().tolist()
    knots, events, codes = [ends[:1]], [], []
    for i, count in enumerate(counts):
        steps = torch.arange(1, count + 1, dtype=ends.dtype, device=ends.device) / count
        knots.append(ends[i] + steps * (ends[i + 1] - ends[i]))
        events += [None] * (count - 1) + ([structure.events[i]] if i + 1 < len(counts) else [])
        codes += [structure.arcs[i]] * count
    return torch.cat(knots), tuple(events), torch.stack(codes)


def _halved(
    times: Tensor, events: tuple[int | None, ...], arcs: Tensor, which: Tensor | None = None
) -> Segments:
    """Cut the chosen segments (K,) in two; all of them if None."""
    k = len(arcs)
    chosen = [True] * k if which is None else which.tolist()
    knots, between, codes = [times[0]], [], []
    for i in range(k):
        if chosen[i]:
            knots.append(0.5 * (times[i] + times[i + 1]))
            between.append(None)
            codes.append(arcs[i])
        knots.append(times[i + 1])
        codes.append(arcs[i])
        if i + 1 < k:
            between.append(events[i])
    return torch.stack(knots), tuple(between), torch.stack(codes)
