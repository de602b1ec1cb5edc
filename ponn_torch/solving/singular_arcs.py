"""Singular arcs among the others: where S asks for one, and whether one that is found is admissible.

Two signs tell of one. |S| of a smoothed curve stays below ρ over an interval, however small ρ is; or S of a solved
split passes a switch the other way, so that it is on the wrong side before and after: what a needle opens S closes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting
from ponn_torch.optimal_control.control_set import INTERIOR, LOWER, UPPER, Level, Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.singular import clebsch, singular_components, singular_fractions
from ponn_torch.solving.switching import (
    Structure,
    along_arcs,
    claimed_structure,
    depth_along,
    find_structure,
    sampled,
)

ROUNDING = 1e-9  # of the terms of S̈, below which it does not depend on the control
NEARLY = 0.05  # of a control's range, by which it may leave that between two points


class Stretch(NamedTuple):
    """Scaled times between which a switching function cannot be told from zero."""

    function: int
    start: float
    end: float

    @property
    def length(self) -> float:
        return self.end - self.start


def undecided(curve: Curve, smoothing: float) -> Stretch:
    """The longest stretch over which some |S| ≤ ρ; one without length if there is none."""
    t, s = sampled(curve, max(50, 2000 // curve.collocation.n_segments))
    longest = Stretch(0, 0.0, 0.0)
    for function in curve.collocation.bvp.law.jumping.values():
        for first, last in _runs(s[:, function].abs() <= smoothing):
            longest = max(longest, Stretch(function, float(t[first]), float(t[last])), key=lambda one: one.length)
    return longest


def vanishing(rungs: Sequence[tuple[float, Stretch]]) -> Stretch | None:
    """Where S vanishes in the limit, from pairs of ρ, descending, and the stretch over which |S| ≤ ρ; None if nowhere.

    About a switch that stretch shrinks as ρ, where S touches zero as √ρ; on a singular arc it stays.
    """
    if not rungs:
        return None
    smoothing, last = rungs[-1]
    before = [stretch for value, stretch in rungs if value >= 8 * smoothing]
    if not before or last.function != before[-1].function or last.length < 0.6 * before[-1].length:
        return None
    return last if last.length > 0 else None


def _runs(inside: Tensor) -> list[tuple[int, int]]:
    """First and last index of every run of true entries."""
    edges = torch.cat([inside.new_zeros(1), inside, inside.new_zeros(1)]).long().diff()
    firsts, afters = (edges == 1).nonzero()[:, 0], (edges == -1).nonzero()[:, 0]
    return list(zip(firsts.tolist(), (afters - 1).tolist(), strict=True))


# -- structures ----------------------------------------------------------------------------------------------------


def with_arc(structure: Structure, ends: Tensor, stretch: Stretch, code: int, levels: Sequence[Level]) -> Structure:
    """The same arcs, but that of one component is another on a stretch, and its S vanishes where that begins and ends.

    ``ends`` are the scaled times at which the whole begins and ends.
    """
    function, start, end = stretch
    component = levels[function].component
    inside = (structure.times >= start) & (structure.times <= end)
    switches = [
        (time, tuple(e for e in events if not (gone and e == function)))
        for time, events, gone in zip(structure.times.tolist(), structure.events, inside.tolist(), strict=True)
    ]
    switches += [(time, (function,)) for time in (start, end) if float(ends[0]) < time < float(ends[-1])]
    switches = sorted((time, events) for time, events in switches if events)
    times = ends.new_tensor([time for time, _ in switches])
    knots = torch.cat([ends[:1], times, ends[-1:]])
    middle = 0.5 * (knots[1:] + knots[:-1])
    arcs = structure.arcs[torch.searchsorted(structure.times, middle)]
    arcs[:, component] = torch.where((middle > start) & (middle < end), code, arcs[:, component])
    return Structure(arcs, times, tuple(events for _, events in switches))


def on_stretch(curve: Curve, stretch: Stretch) -> Structure:
    """The arcs that S of a smoothed curve asks for, with a singular one where S is zero."""
    return with_arc(find_structure(curve), curve.times, stretch, INTERIOR, curve.collocation.bvp.law.levels)


def at_turned_switches(curve: Curve, tolerance: float) -> Structure | None:
    """The arcs of a split ``curve`` with singular ones where S passes a switch the other way; None if nowhere.

    Nor where such an arc would not be admissible: wrong arcs turn S round in many ways.
    """
    if not curve.collocation.bvp.law.jumps:
        return None
    claimed = claimed_structure(curve)
    levels = curve.collocation.bvp.law.levels
    t, _, _, depth = depth_along(curve, claimed)
    found = claimed
    for time, events in zip(claimed.times.tolist(), claimed.events, strict=True):
        before, after = int((t < time).sum()), int((t <= time).sum())
        for event in (e for e in events if levels[e].jumps):
            wrong = (depth[:, event] > tolerance).long()
            left, right = int(wrong[:before].flip(0).cumprod(0).sum()), int(wrong[after:].cumprod(0).sum())
            if left and right:
                turned = Stretch(event, float(t[before - left]), float(t[after + right - 1]))
                found = with_arc(found, curve.times, turned, INTERIOR, levels)
    return found if found is not claimed and _plausible(curve, found) else None


def _plausible(curve: Curve, structure: Structure) -> bool:
    """Whether in the middle of every singular arc the control would be inside its bounds, with Legendre and Clebsch."""
    knots = torch.cat([curve.times[:1], structure.times, curve.times[-1:]])
    middle = 0.5 * (knots[1:] + knots[:-1])
    there = middle, curve(middle), structure.arcs
    return _convex(curve, *there) and bool((_past(curve, *there) <= 0).all())


def at_bounds(curve: Curve, tolerance: float) -> Structure | None:
    """The arcs of a split ``curve``, at a bound where the control of a singular arc would leave it; None if nowhere."""
    found = claimed = claimed_structure(curve)
    if not curve.collocation.bvp.singular:
        return None
    t, w, arc = along_arcs(curve)
    codes, law = claimed.arcs[arc], curve.collocation.bvp.law
    fractions = _fractions(curve, t, w, codes)
    for component in curve.collocation.bvp.singular:
        eta, on = fractions[:, component], codes[:, component] == INTERIOR
        for code, past in ((LOWER, -eta), (UPPER, eta - 1.0)):
            for first, last in _runs(on & (past > tolerance)):
                if last > first:
                    stretch = Stretch(law.jumping[component], float(t[first]), float(t[last]))
                    found = with_arc(found, curve.times, stretch, code, law.levels)
    return None if found is claimed else found


# -- admissible arcs -------------------------------------------------------------------------------------------------


def violation(curve: Curve, n_points: int = 201) -> float | None:
    """How far the control leaves its range on singular arcs, in ranges; infinite without Legendre and Clebsch.

    None where no arc is singular. Looked at more closely where it comes near a bound between the points, as its peak
    may lie there.
    """
    arcs = curve.collocation.setting.regime.arcs
    if not singular_components(curve.collocation.bvp.law, arcs):
        return None
    assert arcs is not None
    z = torch.linspace(-1.0, 1.0, n_points, dtype=curve.xi.dtype, device=curve.xi.device)
    t, w, _, segment = curve.on_segments(z)
    fine, worst = torch.linspace(0.0, 1.0, 21, dtype=t.dtype, device=t.device), 0.0
    for _ in range(3):
        if not _convex(curve, t, w, arcs[segment]):
            return math.inf
        past = _past(curve, t, w, arcs[segment]).amax(-1)
        worst = max(worst, float(past.nan_to_num(math.inf).max()))
        same = segment[2:] == segment[:-2]
        peak = same & (past[1:-1] >= past[:-2]) & (past[1:-1] >= past[2:]) & (past[1:-1] > -NEARLY)
        at = peak.nonzero()[:, 0] + 1
        if not len(at):
            break
        left, right = t[at - 1], t[at + 1]
        t, segment = (
            (left[:, None] + (right - left)[:, None] * fine).flatten(),
            segment[at].repeat_interleave(len(fine)),
        )
        w = curve.at(t, segment)
    return max(worst, 0.0)


def _past(curve: Curve, t: Tensor, w: Tensor, arcs: Tensor) -> Tensor:
    """How far η (m, k) is past its range, negative inside it; −1 where no arc is singular."""
    eta = _fractions(curve, t, w, arcs)
    return torch.where(arcs == INTERIOR, torch.maximum(-eta, eta - 1.0), -1.0)


def _fractions(curve: Curve, t: Tensor, w: Tensor, arcs: Tensor) -> Tensor:
    """η (m, k) at scaled times (m,) for arc codes (m, k)."""
    with torch.no_grad():
        return singular_fractions(*_at(curve, t, w, arcs))


def _convex(curve: Curve, t: Tensor, w: Tensor, arcs: Tensor) -> bool:
    """Whether Legendre and Clebsch's condition holds there."""
    with torch.no_grad():
        return bool((clebsch(*_at(curve, t, w, arcs)) > ROUNDING).all())


def _at(curve: Curve, t: Tensor, w: Tensor, arcs: Tensor) -> tuple[BoundaryValueProblem, Tensor, Tensor, Setting]:
    """The equations with what is singular on these arcs, and the points in the form that they take."""
    bvp = curve.collocation.bvp
    setting = curve.setting(torch.zeros_like(t, dtype=torch.long))
    # nothing is solved here, so that couplings do not matter
    bvp = replace(bvp, singular=singular_components(bvp.law, arcs))
    return bvp, t[:, None], w, replace(setting, regime=Regime(arcs=arcs))
