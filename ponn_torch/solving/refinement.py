"""Refinement: what refinements share, and the plainest one.

They work on small segments, halved where the residual between the nodes is too large. ``Subdivide`` keeps the regime of
the curve it is given, so that a smoothed problem is solved to the end as one of its own; ``Split`` (split.py) leaves
the smoothing behind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import ClassVar, Protocol, Self

import torch
from torch import Tensor

from ponn_torch.ansatz.basis import FreeFunction, Legendre
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Callback, NonFiniteResidual, Optimizer, OptimizeResult, Status, Stopping
from ponn_torch.optim.chain import Chain, OutputLayer
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation, Strong, discretise
from ponn_torch.solving.guess import project

WORST = 0.01  # of the largest residual between the nodes: segments that are halved first

MORE_NEURONS, MORE_NODES = 6, 8  # per segment, where what is solved is not exact enough to be certified

MakeCallback = Callable[[Collocation], Callback]


class Outcome(Enum):
    """How a refinement ended; the value is the message."""

    SOLVED = "solved on every segment, between the nodes too, and every arc is the one that S asks for"
    RESIDUAL = "the residual did not fall below its tolerance"
    STRUCTURE = "the arcs and the sign of S still disagreed after the last round"
    COARSE = "the residual between the nodes stayed above its tolerance"
    TOO_MANY_ARCS = "S asks for more arcs than allowed: a singular arc, or a curve that is no solution"
    TOO_MANY_SEGMENTS = "more segments were needed than allowed"
    SINGULAR = "a switching function vanishes over an interval, so that the optimum has a singular arc there"
    INTERRUPTED = "interrupted, from the keyboard or by the budget"


@dataclass(frozen=True)
class Refined:
    """The curve, how it ended, every round's optimiser result, what more there is to say, and what made the curve."""

    curve: Curve
    outcome: Outcome
    rounds: list[OptimizeResult]
    note: str = ""
    made_by: OptimizeResult | None = None  # None: the last round

    @property
    def message(self) -> str:
        return self.outcome.value + self.note

    @property
    def result(self) -> OptimizeResult:
        return self.made_by or self.rounds[-1]


@dataclass
class Rounds:
    """The rounds of a refinement so far: every result, and the last curve that is solved.

    Attributes:
        curve: the one that is given, as long as no round is solved.
        made_by: the result of the curve, where it is that of a round.
    """

    curve: Curve
    callback: MakeCallback | None = None
    results: list[OptimizeResult] = field(default_factory=list)
    made_by: OptimizeResult | None = None

    def interrupted(self) -> Refined:
        """What there is when the refinement is ended from outside."""
        return Refined(self.curve, Outcome.INTERRUPTED, self.results, made_by=self.made_by)


class Refinement(Protocol):
    """What makes a solved curve a better one; inherit from it."""

    reads_arcs: ClassVar[bool] = True  # whether the arcs of the curve it starts from matter
    exact: ClassVar[bool] = True  # whether what it solves is meant to be certified, or only sharper than before

    def run(self, start: Curve, callback: MakeCallback | None = None, blunter: Curve | None = None) -> Refined:
        """Refine a curve; never raises for want of convergence or for Ctrl-C, the outcome says how it ended.

        ``blunter`` is the solution of a larger smoothing, where there is one: the two tell where S goes without any.
        """
        ...

    def brief(self) -> Self:
        """The same without what takes long, for a first try after which there is another one."""
        return self

    def finer(self) -> Self | None:
        """The same at a higher resolution, for what is solved but not exactly enough; None if there is none."""
        return None


@dataclass(frozen=True)
class Segmentation:
    """What refinements on segments share: their size, and the solver of a round.

    Small blocks are what makes it fast: the arrow elimination costs n_segments × n_neurons³.

    Attributes:
        n_neurons, n_nodes: size of a segment. n_segments: how many the first round has, about.
        basis: the free function of a segment, a network with its own size, or what makes one of n_neurons.
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
            tolerance=1e-14, decrease=1e-2, patience=2, max_iterations=80, hopeless=1e-3, hopeless_after=30
        )
    )
    damping: float = 1e-8
    linear_solver: str = "cholesky"
    basis: FreeFunction | Callable[[int], FreeFunction] = Legendre

    def discretisation(self, bvp: BoundaryValueProblem) -> Discretisation:
        nodes = make_nodes("legendre_gauss", self.n_nodes, dtype=bvp.unit.dtype, device=bvp.unit.device)
        basis = self.basis if isinstance(self.basis, FreeFunction) else self.basis(self.n_neurons)
        return discretise(bvp, basis, nodes, Strong(), "orthonormal")

    def solve(self, collocation: Collocation, start: Curve, rounds: Rounds) -> tuple[Curve, OptimizeResult]:
        """One round, from the projection of ``start``; of networks the output layers are solved for last.

        A round that starts where the residual is not finite has failed: a finer grid may meet a singularity that a
        coarser one steps over.
        """
        deep = len(collocation.linear_unknowns) < collocation.n_unknowns
        optimizer: Optimizer = LevenbergMarquardt(
            self.stopping, damping=self.damping, linear_solver=self.linear_solver, ahead=not deep
        )
        if deep:
            optimizer = Chain([optimizer, OutputLayer()])
        on_iteration = rounds.callback(collocation) if rounds.callback else None
        xi = project(collocation, start)
        try:
            result = optimizer.run(collocation, xi, on_iteration)
        except NonFiniteResidual:
            result = OptimizeResult(xi, xi.new_tensor(torch.inf), Status.NON_FINITE)
        curve = Curve(collocation, result.xi)
        rounds.results.append(result)
        if self.solved(result):
            rounds.curve, rounds.made_by = curve, result
        return curve, result

    def finer(self) -> Self | None:
        """The same with polynomials of higher degree on every segment; None for networks, which have their own size."""
        if isinstance(self.basis, FreeFunction):
            return None
        return replace(self, n_neurons=self.n_neurons + MORE_NEURONS, n_nodes=self.n_nodes + MORE_NODES)

    def solved(self, result: OptimizeResult) -> bool:
        return float(result.norm) < self.residual_tolerance

    def coarse(self, curve: Curve, solved: bool = True) -> Tensor:
        """Segments (K,) whose equations do not hold between the nodes; of a curve that is not solved, the worst ones.

        A segment's residual counts by its share of the time, as it does in what is flown: on an arc of a thousandth of
        the whole, round-off alone in its second derivatives is above any tight tolerance.
        """
        share = (curve.times[1:] - curve.times[:-1]) / (curve.times[-1] - curve.times[0])
        missed = curve.off_node_residuals() * share * self.n_segments
        fine = missed <= (self.off_node_tolerance if solved else WORST * missed.max())
        return ~fine  # NaN is not fine


@dataclass(frozen=True)
class Segments:
    """Knot times (K+1,), the events of every interior knot or None where it only subdivides, arc codes (K, m)."""

    times: Tensor
    events: tuple[tuple[int, ...] | None, ...]
    arcs: Tensor

    def halved(self, which: Tensor) -> Segments:
        """Cut the chosen segments, booleans (K,), in two."""
        k, chosen = len(self.arcs), which.tolist()
        times, codes = [self.times[0]], []
        events: list[tuple[int, ...] | None] = []
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


def shared_out(lengths: Sequence[float], n_segments: int) -> list[int]:
    """Segments for every arc, so that the longest is as short as can be: n_segments, and one more for two switches.

    Their total depends on the number of arcs alone, so that splits with as many arcs share their tapes.
    """
    counts = [1] * len(lengths)
    for _ in range(n_segments + (len(lengths) - 1) // 2 - len(lengths)):
        longest = max(range(len(lengths)), key=lambda i: lengths[i] / counts[i])
        counts[longest] += 1
    return counts


@dataclass(frozen=True)
class Subdivide(Segmentation, Refinement):
    """Solve the curve's own regime on fixed segments, halved until the equations hold between the nodes.

    A round that fails is tried again from the last curve that is solved, on more segments.
    """

    reads_arcs: ClassVar[bool] = False

    def run(self, start: Curve, callback: MakeCallback | None = None, blunter: Curve | None = None) -> Refined:
        rounds = Rounds(start, callback)
        try:
            return self._halved(start, rounds)
        except KeyboardInterrupt:
            return rounds.interrupted()

    def _halved(self, start: Curve, rounds: Rounds) -> Refined:
        bvp, setting, results = start.collocation.bvp, start.collocation.setting, rounds.results
        disc = self.discretisation(bvp)
        share = torch.linspace(0, 1, self.n_segments + 1, dtype=start.xi.dtype, device=start.xi.device)
        times = share * start.times[-1]
        curve, outcome = start, Outcome.COARSE
        for _ in range(self.max_rounds):
            if len(times) - 1 > self.max_segments:
                return Refined(curve, Outcome.TOO_MANY_SEGMENTS, results)
            solution, result = self.solve(Collocation.on_segments(disc, times, setting=setting), curve, rounds)
            if result.status.cut:
                return rounds.interrupted()
            if result.status is Status.NON_FINITE:
                return Refined(curve, Outcome.RESIDUAL, results, f": {result.status.value}")
            if self.solved(result):
                curve, outcome = solution, Outcome.COARSE
                coarse = self.coarse(curve)
                if not bool(coarse.any()):
                    return Refined(curve, Outcome.SOLVED, results)
            else:
                outcome, coarse = Outcome.RESIDUAL, self.coarse(solution)
                coarse = coarse if bool(coarse.any()) else ~coarse  # the same round again would fail again
            middles = 0.5 * (solution.times[:-1] + solution.times[1:])
            times = torch.cat([solution.times, middles[coarse]]).sort().values
        return Refined(curve, outcome, results)
