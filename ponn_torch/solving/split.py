"""The split: switches found exactly, in one least squares with everything else.

The domain is cut at the switches, and coefficients, knot values, switch times and a free final time are solved for
together, with rows S(t_k) = 0 and the control at its bound inside every arc (no smoothing is left). Both papers name
this as future work. The sign of S is then checked on a fine grid, and where the minimum principle asks for other arcs
these are tried: a solved residual with the wrong arcs is an extremal of nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from ponn_torch.optim.base import OptimizeResult
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_laws import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import Setting
from ponn_torch.solving.refinement import MakeCallback, Outcome, Refined, Segmentation, Segments
from ponn_torch.solving.switching import Structure, find_structure, without_short_arcs


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
                if result.status.cut:
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
            if result.status.cut:
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
