"""The split: switches found exactly, in one least squares with everything else.

The domain is cut at the switches, and coefficients, knot values, switch times and a free final time are solved for
together, with rows S(t_k) = 0 and the control at its bound inside every arc, or at what keeps S at zero along a
singular one (no smoothing is left). Both papers name this as future work. The sign of S is then checked on a fine grid,
and where the minimum principle asks for other arcs these are tried: a solved residual with the wrong arcs is an
extremal of nothing.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from torch import Tensor

from ponn_torch.optim.base import Status
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import with_singular_arcs
from ponn_torch.optimal_control.problem import DisplayUnit
from ponn_torch.optimal_control.singular import singular_components
from ponn_torch.solving import singular_arcs
from ponn_torch.solving.refinement import (
    MakeCallback,
    Outcome,
    Refined,
    Refinement,
    Rounds,
    Segmentation,
    Segments,
    shared_out,
)
from ponn_torch.solving.sharpening import graded_times
from ponn_torch.solving.switching import (
    Structure,
    claimed_structure,
    find_structure,
    needles,
    without_short_arcs,
)

COLLAPSED = 1e-7  # fraction of the final time, below which an arc is solved away to nothing
LEGIBLE = 1e-4  # ‖r‖ of a sharpened curve whose arcs are worth reading
MOVED = 1e-3  # fraction of the final time: arcs are split anew where a sharper curve moves a switch by more
SAME_SWITCH = 1e-6  # scaled times that differ by less are those of one switch
MOST_UNSOLVED = 3  # sharpened curves in a row that are no solutions, after which there is none this way
SMALLEST_STEP = 0.9  # factor on the smoothing, above which a curve is not sharpened any more
WHOLE = 0.99  # of the time: where S vanishes for as long, the control has nothing to decide
NOT_UNIQUE = ": all the time, so that this control has nothing to decide; a small price on it makes it unique"
MORE_SEGMENTS = 4  # multiples of n_segments that are tried where there is no smoothing to lower


@dataclass(frozen=True)
class _Search:
    """What the rounds of one refinement share, and what they have left so far.

    tried: solved arcs that S was not content with, by the number of segments; what follows from them is not done twice.
    made: discretisations, by the components with singular arcs.
    """

    split: Split
    bvp: BoundaryValueProblem
    rounds: Rounds
    tried: dict[int, list[Structure]] = field(default_factory=lambda: defaultdict(list))
    made: dict[tuple[int, ...], Discretisation] = field(default_factory=dict)

    def discretisation(self, arcs: Tensor | None = None) -> Discretisation:
        """Of segments with these arc codes, of which interior ones are singular where H is affine in the control."""
        components = singular_components(self.bvp.law, arcs)
        if components not in self.made:
            self.made[components] = self.split.discretisation(with_singular_arcs(self.bvp, components))
        return self.made[components]


@dataclass(frozen=True)
class Split(Segmentation, Refinement):
    """Solve between switches until arcs and S agree and the equations hold between the nodes.

    Every arc is one or more segments; those that subdivide it sit at fixed fractions between its switches. Where S asks
    for other arcs one is added, as a needle that the next round widens; arcs that a failed round made collapse are
    merged away. When this does not end, the smoothed curve was too blunt to show the structure: it is sharpened step by
    step on graded segments, and arcs or switch times that were not read before are split anew.

    Attributes:
        max_arcs: more arcs than this are taken for a sign of a singular arc.
        needle: longest duration of a new arc, as a fraction of the final time.
        short_arc: arcs shorter than this fraction of the final time in a failed round are merged away.
        sign_tolerance: depth of S on the wrong side of zero that is still round-off.
        max_sharpenings, sharpening: how often, and by which factor, the smoothing is lowered after a failure.
    """

    max_arcs: int = 40
    needle: float = 0.01
    short_arc: float = 1e-4
    sign_tolerance: float = 1e-10
    max_sharpenings: int = 10
    sharpening: float = 0.5

    def brief(self) -> Self:
        """From the curve that is given alone: sharper ones are found on segments, at many times the cost."""
        return replace(self, max_sharpenings=0)

    def run(self, start: Curve, callback: MakeCallback | None = None, blunter: Curve | None = None) -> Refined:
        search = _Search(self, start.collocation.bvp, Rounds(start, callback))
        try:
            return self._searched(search, start, blunter)
        except KeyboardInterrupt:
            return search.rounds.interrupted()

    def _searched(self, search: _Search, start: Curve, blunter: Curve | None) -> Refined:
        rounds = search.rounds.results
        read: list[tuple[Structure, int]] = []
        curves: list[Curve] = []
        rungs: list[tuple[float, singular_arcs.Stretch]] = []
        refined, singular = Refined(start, Outcome.STRUCTURE, rounds), None
        for smoothed, n_segments in self._starts(search, start):
            if rounds and rounds[-1].status.cut:
                return search.rounds.interrupted()
            claimed = smoothed.collocation.setting.regime.arcs is not None
            structures = [claimed_structure(smoothed) if claimed else find_structure(smoothed, polish=0)]
            if smoothed.smoothing:
                curves.append(smoothed)
                if len(curves) > 1:  # one alone tells nothing, and most solves need no more
                    late = curves[len(rungs) :]
                    rungs += [(curve.smoothing, singular_arcs.undecided(curve, curve.smoothing)) for curve in late]
                    singular = singular_arcs.vanishing(rungs)
                if blunter is not None:
                    guessed = find_structure(smoothed, blunter)
                    # of the same arcs the curve's own times fit it better
                    structures = structures if guessed.same_arcs(structures[0]) else [guessed, *structures]
                if singular is not None:
                    structures.append(singular_arcs.on_stretch(smoothed, singular))
            blunter = smoothed
            moved = MOVED * float(smoothed.times[-1])
            for structure in structures:
                if any(structure.near(other, moved) and n_segments == n for other, n in read):
                    continue
                read.append((structure, n_segments))
                refined = self._split(search, smoothed, structure, n_segments)
                if refined.outcome in (Outcome.SOLVED, Outcome.INTERRUPTED):
                    return refined
        if singular is None:
            return refined
        unit = start.collocation.bvp.problem.display.get("time", DisplayUnit("s"))
        if singular.length >= WHOLE * float(smoothed.times[-1]):
            return Refined(smoothed, Outcome.SINGULAR, rounds, NOT_UNIQUE)
        ends = [f"{t * start.collocation.bvp.time_unit / unit.size:.4g}" for t in (singular.start, singular.end)]
        return Refined(smoothed, Outcome.SINGULAR, rounds, f": from {ends[0]} to {ends[1]} {unit.label}")

    def _starts(self, search: _Search, start: Curve) -> Iterator[tuple[Curve, int]]:
        """Curves to read the arcs from, and numbers of segments: ever sharper ones, or where none is smoothed, more.

        A split begins with as many segments as the curve that it starts from, if that leaves some to be halved.
        """
        least = max(self.n_segments, min(start.collocation.n_segments, self.max_segments // 2))
        yield start, least
        smoothing, factor, unsolved = start.smoothing, self.sharpening, 0
        for attempt in range(self.max_sharpenings):
            if not smoothing:
                if attempt < MORE_SEGMENTS:
                    yield start, (attempt + 2) * least
                continue
            sharper = factor * smoothing
            times = graded_times(start, sharper, least)
            if len(times) - 1 > self.max_segments:  # as where a component of the control has no effect, and S is noise
                return
            collocation = Collocation.on_segments(search.discretisation(), times, setting=start.collocation.setting)
            curve, result = self.solve(collocation.with_setting(smoothing=sharper), start, search.rounds)
            unsolved = 0 if self.solved(result) else unsolved + 1
            if result.status.cut or float(result.norm) < LEGIBLE:
                start, smoothing = curve, sharper
                yield start, least
            else:
                factor = factor**0.5
            if unsolved == MOST_UNSOLVED or factor > SMALLEST_STEP:
                return

    def _split(self, search: _Search, curve: Curve, structure: Structure, n_segments: int) -> Refined:
        """Rounds from one curve, depth first through the repairs of its arcs; the last curve that is solved is kept."""
        rounds, tried = search.rounds.results, search.tried[n_segments]
        bvp, parameters = search.bvp, curve.collocation.setting.parameters
        pending = [(curve, _spread(structure, curve.times, n_segments), math.inf)]
        outcome = Outcome.STRUCTURE
        for _ in range(self.max_rounds):
            if not pending:
                break
            before, segments, norm = pending.pop()
            if len(segments.events) - segments.events.count(None) >= self.max_arcs:
                return Refined(curve, Outcome.TOO_MANY_ARCS, rounds)
            if len(segments.arcs) > self.max_segments:
                return Refined(curve, Outcome.TOO_MANY_SEGMENTS, rounds)
            regime = Regime(arcs=segments.arcs if bvp.law.n_switching else None)
            disc, setting = search.discretisation(regime.arcs), Setting(regime, parameters)
            collocation = Collocation.on_segments(disc, segments.times, events=segments.events, setting=setting)
            solution, result = self.solve(collocation, before, search.rounds)
            if result.status.cut:
                return search.rounds.interrupted()
            solved, found = self.solved(result), claimed_structure(solution)
            if solved and any(found.near(other, SAME_SWITCH) for other in tried):
                curve, outcome = solution, Outcome.STRUCTURE
                continue
            repairs, coarse = self._repairs(solution, solved), self.coarse(solution, solved or regime.arcs is not None)
            if not solved:
                outcome = Outcome.RESIDUAL
            elif repairs or (singular_arcs.violation(solution) or 0.0) > self.sign_tolerance:
                curve, outcome = solution, Outcome.STRUCTURE
            else:
                curve, outcome = solution, Outcome.COARSE
                if not bool(coarse.any()):
                    return Refined(curve, Outcome.SOLVED, rounds)
            # without arcs there is nothing to be misread
            legible = float(result.norm) < (0.9 * norm if regime.arcs is None else min(LEGIBLE, 0.1 * norm))
            if not repairs and bool(coarse.any()) and (solved or legible):
                # also where nothing but the resolution keeps the residual up, as long as that helps
                same = Segments(solution.times, segments.events, segments.arcs)
                if result.status is Status.MAX_ITERATIONS:  # it was still on its way
                    pending.append((solution, same, math.inf))
                else:
                    pending.append((solution, same.halved(coarse), float(result.norm)))
                continue
            if solved:
                tried.append(found)
            repairs = [other for other in repairs if not any(other.near(one, SAME_SWITCH) for one in tried)]
            pending += [(curve, _spread(other, curve.times, n_segments), math.inf) for other in reversed(repairs)]
        return Refined(curve, outcome, rounds)

    def _repairs(self, curve: Curve, solved: bool) -> list[Structure]:
        """Other structures to try, the best first: without the arcs that are gone, or where S asks, with others.

        These are singular arcs where S turns round at a switch, bounds where their control would leave them, or one
        needle more.
        """
        found = claimed_structure(curve)
        ends = torch.cat([curve.times[:1], found.times, curve.times[-1:]])
        merged = without_short_arcs(
            found, ends, COLLAPSED if solved else self.short_arc, curve.collocation.bvp.law.levels
        )
        if len(merged) < len(found):
            return [merged]
        if not solved:
            return []
        regular = needles(curve, self.needle, self.sign_tolerance)
        repair = singular_arcs.at_turned_switches if regular else singular_arcs.at_bounds
        singular = repair(curve, self.sign_tolerance)
        return regular if singular is None else [singular, *regular]


def _spread(structure: Structure, times: Tensor, n_segments: int) -> Segments:
    """Cut every arc into equal segments."""
    ends = torch.cat([times[:1], structure.times, times[-1:]])
    counts = shared_out(ends.diff().tolist(), n_segments)
    knots, codes = [ends[:1]], []
    events: list[tuple[int, ...] | None] = []
    for i, count in enumerate(counts):
        steps = torch.arange(1, count + 1, dtype=ends.dtype, device=ends.device) / count
        knots.append(ends[i] + steps * (ends[i + 1] - ends[i]))
        events += [None] * (count - 1) + ([structure.events[i]] if i + 1 < len(counts) else [])
        codes += [structure.arcs[i]] * count
    return Segments(torch.cat(knots), tuple(events), torch.stack(codes))
