"""Sharpening: the smoothed problem at smaller smoothing, on segments graded towards its switches.

The structure of the optimum shows in S only where S is well above ρ: what touches zero, or an arc of a day at an end,
is hidden until ρ is small. A single polynomial does not follow the control there; segments do, if they are placed
right.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ponn_torch.optimal_control.curve import Curve
from ponn_torch.solving.switching import sampled, share_of_change

LEGIBLE = 0.5  # of the smoothing, by which S stays off zero where no arc is hidden
RESOLUTION = 2.0  # change of asinh(2S/πρ) along one segment


def graded_times(curve: Curve, smoothing: float, n_segments: int) -> Tensor:
    """Scaled knot times (K+1,) on which S of this curve is resolved at ``smoothing``; K is n_segments and more.

    tanh(S/ρ) has its poles where S = ±iπρ/2. To first order that is at a distance of √(S² + (πρ/2)²)/|S'| from t, and
    polynomials converge on segments that are short against it. The number of segments per time that this asks for is
    the rate of change of asinh(2S/πρ): the knots are spread evenly over its variation and the time together, so that
    halving ρ adds ln 2 / 2 ≈ 0.7 segments for every switch.
    """
    t, s = sampled(curve, max(50, 2000 // curve.collocation.n_segments))
    s = s[:, list(curve.collocation.bvp.law.jumping.values())]  # of those that are smoothed
    variation = torch.asinh(2 * s / (math.pi * smoothing)).diff(dim=0).abs().sum(-1)
    density = variation / RESOLUTION + n_segments * t.diff() / (t[-1] - t[0])
    total = torch.cat([density.new_zeros(1), density.cumsum(0)])
    count = math.ceil(float(total[-1]))
    levels = total[-1] * torch.arange(1, count, dtype=t.dtype, device=t.device) / count
    i = torch.searchsorted(total, levels).clamp(1, len(t) - 1)
    inner = t[i - 1] + (levels - total[i - 1]) / (total[i] - total[i - 1]) * (t[i] - t[i - 1])
    return torch.cat([t[:1], inner, t[-1:]])


def legible(curve: Curve, blunter: Curve) -> bool:
    """Whether S shows the arcs that it has without smoothing: those that it is extrapolated to from a blunter curve.

    It does if both stay off zero, by half the smoothing, wherever they turn round and at both ends: those that are
    smoothed. Both curves lie on the same segments.
    """
    now, before = (sampled(one, 201)[1] for one in (curve, blunter))
    then = now + share_of_change(curve, blunter) * (now - before)
    margin, smoothed = LEGIBLE * curve.smoothing, list(curve.collocation.bvp.law.jumping.values())
    clear = (bool((s[_turns(s)].abs() > margin).all()) for s in (now[:, smoothed], then[:, smoothed]))
    return _signs(now) == _signs(then) and all(clear)


def _signs(switching: Tensor) -> list[list[bool]]:
    """The signs of S in the order they come."""
    signs: list[list[bool]] = torch.unique_consecutive(switching > 0, dim=0).tolist()
    return signs


def _turns(switching: Tensor) -> Tensor:
    """Where S (m, k) has a local extremum or an end."""
    slope, ends = switching.diff(dim=0), switching.new_ones(1, switching.shape[1])
    return torch.cat([ends, -slope[1:] * slope[:-1], ends]) >= 0
