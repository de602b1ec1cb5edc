"""Refinement: small segments, halved where the residual between the nodes is too large, and switches found exactly.

``Split`` cuts the domain at the switches and solves for everything in one least squares: coefficients, knot values,
switch times and a free final time, with rows S(t_k) = 0 and the control at its bound inside every arc (no smoothing is
left). Both papers name this as future work. The sign of S is then checked on a fine grid, and where the minimum
principle asks for other arcs these are tried: a solved residual with the wrong arcs is an extremal of nothing.
``Subdivide`` keeps the regime of the curve it is given, so that a smoothed problem is solved to the end as one of its
own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from ponn_torch.ansatz.basis import Legendre, LinearBasis
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Callback, OptimizeResult, Status, Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_laws import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import BoundaryValueProblem, Setting
from ponn_torch.solving.guess import project
from ponn_torch.solving.switching import Structure, find_structure, without_short_arcs

MakeCallback = Callable[[Collocation], Callback]


class Outcome(Enum):
    """How a refinement ended; the value is the message."""

    SOLVED = "solved on every segment, between the nodes too, and every arc is the one that S asks for"
    RESIDUAL = "the residual did not fall below its tolerance"
    STRUCTURE = "the arcs and the sign of S still disagreed after the last round"
    COARSE = "the residual between the nodes stayed above its tolerance"
    TOO_MANY_ARCS = "S asks for more arcs than allowed: a singular arc, or a curve that is no solution"
    TOO_MANY_SEGMENTS = "more segments were needed than allowed"
    INTERRUPTED = "interrupted from the keyboard"


@dataclass(frozen=True)
class Refined:
    """The last curve, how the refinement ended, and every round's optimiser result."""

    curve: Curve
    outcome: Outcome
    rounds: list[OptimizeResult]


class Refinement(Protocol):
    reads_arcs: ClassVar[bool]  # whether the arcs of the curve it starts from matter

    def run(self, start: Curve, callback: MakeCallback | None = None) -> Refined:
        """Refine a curve; never raises for want of convergence, the outcome says how it ended."""
        ...


@dataclass(frozen=True)
class Segmentation:
    """What refinements share: small segments of one size, and the solver of a round.

    Small blocks are what makes it fast: the arrow elimination costs n_segments × n_neurons³.

    Attributes:
        n_neurons, n_nodes: size of a segment. n_segments: how many the first round has, about.
        basis: the free function of a segment (Legendre by default).
        residual_tolerance: ‖r‖ above which a round has failed.
        off_node_tolerance: largest |ẇ − F| off the nodes, scaled, weighted by the segment's share of the time.
    """

    n_neurons: int = 14
    n_nodes: int = 20
    n_segments: int = 8
    max_segments: int = 128
    max_rounds: int = 8
    residual_tolerance: float = 1e-6
    off_node_tolerance: float = 1e-9
    stopping: Stopping = field(
        default_factory=lambda: Stopping(
            tolerance=1e-13, decrease=1e-2, patience=2, max_iterations=80, hopeless=1e-3, hopeless_after=30
        )
    )
    damping: float = 1e-8
    linear_solver: str = "cholesky"
    basis: Callable[[int], LinearBasis] = Legendre

    def discretisation(self, bvp: BoundaryValueProblem) -> Discretisation:
        nodes = make_nodes("legendre_gauss", self.n_nodes, dtype=bvp.unit.dtype, device=bvp.unit.device)
        return Discretisation(bvp, self.basis(self.n_neurons), nodes, conditioning="orthonormal")

    def solve(
        self, collocation: Collocation, start: Curve, callback: MakeCallback | None
    ) -> tuple[Curve, OptimizeResult]:
        """One round, from the projection of ``start``."""
        optimizer = LevenbergMarquardt(self.stopping, damping=self.damping, linear_solver=self.linear_solver)
        on_iteration = callback(collocation) if callback else None
        result = optimizer.run(collocation, project(collocation, start), on_iteration)
        return Curve(collocation, result.xi), result

    def solved(self, result: OptimizeResult) -> bool:
        return float(result.norm) < self.residual_tolerance

    def coarse(self, curve: Curve) -> Tensor:
        """Segments (K,) whose equations do not hold between the nodes.

        A segment's residual counts by its share of the time, as it does in what is flown: on an arc of a thousandth of
        the whole, round-off alone in its second derivatives is above any tight tolerance.
        """
        share = (curve.times[1:] - curve.times[:-1]) / (curve.times[-1] - curve.times[0])
        fine = curve.off_node_residuals() * share * self.n_segments <= self.off_node_tolerance
        return ~fine  # NaN is not fine


@dataclass(frozen=True)
class Subdivide(Segmentation):
    """Solve the curve's own regime on fixed segments, halved until the equations hold between the nodes.

    A round that fails is tried again from the last curve that is solved, on more segments.
    """

    reads_arcs: ClassVar[bool] = False

    def run(self, start: Curve, callback: MakeCallback | None = None) -> Refined:
        bvp, setting = start.collocation.bvp, start.collocation.setting
        rounds: list[OptimizeResult] = []
        disc = self.discretisation(bvp)
        share = torch.linspace(0, 1, self.n_segments + 1, dtype=start.xi.dtype, device=start.xi.device)
        times = share * start.times[-1]
        curve, outcome = start, Outcome.COARSE
        for _ in range(self.max_rounds):
            if len(times) - 1 > self.max_segments:
                return Refined(curve, Outcome.TOO_MANY_SEGMENTS, rounds)
            solution, result = self.solve(Collocation.on_segments(disc, times, setting=setting), curve, callback)
            rounds.append(result)
            if result.status is Status.INTERRUPTED:
                return Refined(solution, Outcome.INTERRUPTED, rounds)
            if self.solved(result):
                curve, outcome = solution, Outcome.COARSE
                coarse = self.coarse(curve)
                if not bool(coarse.any()):
                    return Refined(curve, Outcome.SOLVED, rounds)
            else:
                outcome, coarse = Outcome.RESIDUAL, self.coarse(solution)
                coarse = coarse if bool(coarse.any()) else ~coarse  # the same round again would fail again
            middles = 0.5 * (solution.times[:-1] + solution.times[1:])
            times = torch.cat([solution.times, middles[coarse]]).sort().values
        return Refined(curve, outcome, rounds)


@dataclass(frozen=True)
class Split(Segmentation):
    """Solve between switches until arcs and S agree and the equations hold between the nodes.

    Every arc is one or more segments; those that subdivide it sit at fixed fractions between its switches. Arcs are
    added where S asks for them and merged away where a failed round made them collapse. When this does not end, the
    smoothed curve was too blunt to show the structure: it is sharpened, and the split starts anew on more segments.

    Attributes:
        max_arcs: more arcs than this are taken for a sign of a singular arc.
        short_arc: arcs shorter than this fraction of the final time in a failed round are merged away.
        max_sharpenings, sharpening: how often, and by which factor, the smoothing is lowered after a failure.
    """

    reads_arcs: ClassVar[bool] = True
    max_arcs: int = 40
    short_arc: float = 1e-4
    max_sharpenings: int = 4
    sharpening: float = 0.3

    def run(self, start: Curve, callback: MakeCallback | None = None) -> Refined:
        disc, smoothed = self.discretisation(start.collocation.bvp), start
        rounds: list[OptimizeResult] = []
        refined = self._split(disc, smoothed, self.n_segments, rounds, callback)
        for attempt in range(2, self.max_sharpenings + 2):
            if refined.outcome in (Outcome.SOLVED, Outcome.INTERRUPTED):
                break
            smoothing = smoothed.collocation.setting.regime.smoothing
            if smoothing is not None:
                sharper = self.sharpening * smoothing
                smoothed, result = self._sharpened(disc, smoothed, sharper, attempt * self.n_segments, callback)
                rounds.append(result)
                if result.status is Status.INTERRUPTED:
                    return Refined(smoothed, Outcome.INTERRUPTED, rounds)
            refined = self._split(disc, smoothed, attempt * self.n_segments, rounds, callback)
        return refined

    def _split(
        self,
        disc: Discretisation,
        start: Curve,
        n_segments: int,
        rounds: list[OptimizeResult],
        callback: MakeCallback | None,
    ) -> Refined:
        """Rounds of solving, repairing the arcs and halving segments, from one smoothed curve."""
        bvp, parameters = disc.bvp, start.collocation.setting.parameters
        curve, outcome = start, Outcome.STRUCTURE
        structure = find_structure(start)
        segments = _spread(structure, start.times, n_segments)
        tried: list[Structure] = []
        for _ in range(self.max_rounds):
            if len(structure) > self.max_arcs:
                return Refined(curve, Outcome.TOO_MANY_ARCS, rounds)
            if len(segments.arcs) > self.max_segments:
                return Refined(curve, Outcome.TOO_MANY_SEGMENTS, rounds)
            regime = Regime(arcs=segments.arcs if bvp.law.n_switching else None)
            collocation = Collocation.on_segments(
                disc, segments.times, events=segments.events, setting=Setting(regime, parameters)
            )
            solution, result = self.solve(collocation, curve, callback)
            rounds.append(result)
            if result.status is Status.INTERRUPTED:
                return Refined(solution, Outcome.INTERRUPTED, rounds)
            if not self.solved(result):
                ends = solution.times[[0, *collocation.switch_knots, -1]]
                repaired = without_short_arcs(structure, ends, self.short_arc)
                if any(repaired.same_arcs(other) for other in [structure, *tried]):
                    return Refined(solution, Outcome.RESIDUAL, rounds)
                tried.append(structure)
                curve, structure, outcome = solution, repaired, Outcome.RESIDUAL
                segments = _spread(structure, solution.times, n_segments)
                continue
            if _collapsed(solution):
                return Refined(solution, Outcome.STRUCTURE, rounds)
            curve, found = solution, find_structure(solution)
            if not found.same_arcs(structure):
                if any(found.same_arcs(other) for other in tried):
                    return Refined(curve, Outcome.STRUCTURE, rounds)  # going round in circles
                tried.append(structure)
                outcome, structure = Outcome.STRUCTURE, found
                segments = _spread(found, solution.times, n_segments)
                continue
            coarse = self.coarse(solution)
            if not bool(coarse.any()):
                return Refined(curve, Outcome.SOLVED, rounds)
            outcome = Outcome.COARSE
            segments = Segments(solution.times, segments.events, segments.arcs).halved(coarse)
        return Refined(curve, outcome, rounds)

    def _sharpened(
        self, disc: Discretisation, curve: Curve, smoothing: Tensor, n_segments: int, callback: MakeCallback | None
    ) -> tuple[Curve, OptimizeResult]:
        """The smoothed problem at a lower smoothing."""
        share = torch.linspace(0, 1, n_segments + 1, dtype=curve.xi.dtype, device=curve.xi.device)
        collocation = Collocation.on_segments(disc, share * curve.times[-1], setting=curve.collocation.setting)
        return self.solve(collocation.with_setting(smoothing=smoothing), curve, callback)


def _collapsed(curve: Curve, fraction: float = 1e-7) -> bool:
    """Whether some arc was solved away to nothing: the wrong arcs, though the residual vanishes."""
    durations = curve.times[1:] - curve.times[:-1]
    return float(durations.min()) < fraction * float(curve.times[-1] - curve.times[0])


@dataclass(frozen=True)
class Segments:
    """Knot times (K+1,), the event of every interior knot or None where it only subdivides, arc codes (K, m)."""

    times: Tensor
    events: tuple[int | None, ...]
    arcs: Tensor

    def halved(self, which: Tensor) -> Segments:
        """Cut the chosen segments, booleans (K,), in two."""
        k, chosen = len(self.arcs), which.tolist()
        times, codes = [self.times[0]], []
        events: list[int | None] = []
        for i in range(k):
            if chosen[i]:
                times.append(0.5 * (self.times[i] + self.times[i + 1]))
                events.append(None)
                codes.append(self.arcs[i])
            times.append(self.times[i + 1])
            codes.append(self.arcs[i])
            if i + 1 < k:
                events.append(self.events[i])
        return Segments(torch.stack(times), tuple(events), torch.stack(codes))


def _spread(structure: Structure, times: Tensor, n_segments: int) -> Segments:
    """Cut every arc into equal segments, about n_segments in all, more where an arc is longer."""
    ends = torch.cat([times[:1], structure.times, times[-1:]])
    share = (ends[1:] - ends[:-1]) / (ends[-1] - ends[0]) * n_segments
    counts = share.round().clamp_min(1).long().tolist()
    knots, codes = [ends[:1]], []
    events: list[int | None] = []
    for i, count in enumerate(counts):
        steps = torch.arange(1, count + 1, dtype=ends.dtype, device=ends.device) / count
        knots.append(ends[i] + steps * (ends[i + 1] - ends[i]))
        events += [None] * (count - 1) + ([structure.events[i]] if i + 1 < len(counts) else [])
        codes += [structure.arcs[i]] * count
    return Segments(torch.cat(knots), tuple(events), torch.stack(codes))
