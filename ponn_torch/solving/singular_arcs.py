"""Singular arcs among the others: where S asks for one, and whether one that is found is admissible.

Two signs tell of one. |S| of a smoothed curve stays below ρ over an interval, however small ρ is; or S of a solved
split passes a switch the other way, so that it is on the wrong side before and after: what a needle opens S closes.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.control_set import INTERIOR, Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import with_singular_arcs
from ponn_torch.optimal_control.singular import singular_components, singular_control
from ponn_torch.solving.switching import (
    Structure,
    claimed_structure,
    depth_along,
    find_structure,
    grid,
    switching_along,
)


def with_singular_arc(structure: Structure, ends: Tensor, component: int, start: float, end: float) -> Structure:
    """The same arcs, with a component of the control inside its bounds from ``start`` to ``end``, where its S vanishes.

    ``ends`` are the scaled times at which the whole begins and ends.
    """
    inside = (structure.times >= start) & (structure.times <= end)
    switches = [
        (time, tuple(e for e in events if not (gone and e == component)))
        for time, events, gone in zip(structure.times.tolist(), structure.events, inside.tolist(), strict=True)
    ]
    switches += [(time, (component,)) for time in (start, end) if float(ends[0]) < time < float(ends[-1])]
    switches = sorted((time, events) for time, events in switches if events)
    times = ends.new_tensor([time for time, _ in switches])
    knots = torch.cat([ends[:1], times, ends[-1:]])
    middle = 0.5 * (knots[1:] + knots[:-1])
    arcs = structure.arcs[torch.searchsorted(structure.times, middle)]
    singular = (middle > start) & (middle < end)
    arcs[:, component] = torch.where(singular, INTERIOR, arcs[:, component])
    return Structure(arcs, times, tuple(events for _, events in switches))


def on_interval(curve: Curve, interval: tuple[float, float]) -> Structure:
    """The arcs that S of a smoothed curve asks for, with a singular one of the component whose S is zero there."""
    t, w = grid(curve)
    within = (t >= interval[0]) & (t <= interval[1])
    component = int(switching_along(curve, t[within], w[within]).abs().amax(0).argmin())
    return with_singular_arc(find_structure(curve), curve.times, component, *interval)


def at_turned_switches(curve: Curve, tolerance: float) -> Structure | None:
    """The arcs of a split ``curve`` with singular ones where S passes a switch the other way; None if nowhere.

    Nor where such an arc would not be admissible: wrong arcs turn S round in many ways.
    """
    if not curve.collocation.bvp.law.jumps:
        return None
    claimed = claimed_structure(curve)
    t, _, depth = depth_along(curve, claimed)
    found = claimed
    for time, events in zip(claimed.times.tolist(), claimed.events, strict=True):
        before, after = int((t < time).sum()), int((t <= time).sum())
        for event in events:
            wrong = (depth[:, event] > tolerance).long()
            left, right = int(wrong[:before].flip(0).cumprod(0).sum()), int(wrong[after:].cumprod(0).sum())
            if left and right:
                start, end = float(t[before - left]), float(t[after + right - 1])
                found = with_singular_arc(found, curve.times, event, start, end)
    return found if found is not claimed and _plausible(curve, found) else None


def _plausible(curve: Curve, structure: Structure) -> bool:
    """Whether in the middle of every singular arc the control would be inside its bounds, with Legendre and Clebsch."""
    knots = torch.cat([curve.times[:1], structure.times, curve.times[-1:]])
    return _violation(curve, 0.5 * (knots[1:] + knots[:-1]), structure.arcs) == 0.0


def violation(curve: Curve, n_points: int = 201) -> float:
    """How far the control leaves its range on singular arcs, in ranges; infinite where Legendre and Clebsch's b ≤ 0."""
    arcs = curve.collocation.setting.regime.arcs
    if not singular_components(curve.collocation.bvp.law, arcs):
        return 0.0
    assert arcs is not None
    z = torch.linspace(-1.0, 1.0, n_points, dtype=curve.xi.dtype, device=curve.xi.device)
    t, _, _, segment = curve.on_segments(z)
    return _violation(curve, t, arcs[segment])


def _violation(curve: Curve, t: Tensor, arcs: Tensor) -> float:
    """The same at scaled times (m,) for arc codes (m, k)."""
    bvp = curve.collocation.bvp
    components = singular_components(bvp.law, arcs)
    parameters = curve.setting(torch.zeros_like(t, dtype=torch.long)).parameters
    setting = Setting(Regime(arcs=arcs), parameters)
    fraction, bend = singular_control(with_singular_arcs(bvp, components), t[:, None], curve(t), setting)
    on = arcs == INTERIOR
    if not bool((bend[on] > 0).all()):
        return math.inf
    outside = torch.maximum(-fraction, fraction - 1.0)[on]
    return float(outside.clamp_min(0.0).nan_to_num(math.inf).max())
