"""Switch detection: the zeros of the switching functions along a curve, and the arcs between them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from ponn_torch.optimal_control.control_laws import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import Setting


@dataclass(frozen=True)
class Structure:
    """Arcs of a bounded control: codes (K, m), scaled times of the K−1 switches, and what switches there."""

    arcs: Tensor
    times: Tensor
    events: tuple[int, ...]

    def __len__(self) -> int:
        return self.arcs.shape[0]

    def same_arcs(self, other: Structure) -> bool:
        return self.arcs.shape == other.arcs.shape and bool((self.arcs == other.arcs).all())


def switching_along(curve: Curve, t: Tensor, w: Tensor | None = None) -> Tensor:
    """Switching functions (m, n_switching) at scaled times (m,)."""
    setting = curve.setting(torch.zeros_like(t, dtype=torch.long))
    w = curve(t) if w is None else w
    return curve.collocation.bvp.switching(t[:, None], w, Setting(Regime(), setting.parameters))


def grid(curve: Curve, n_points: int = 400) -> tuple[Tensor, Tensor]:
    """Scaled times and w on an even grid with both ends in every segment, (K·n,) and (K·n, 2n)."""
    z = torch.linspace(-1.0, 1.0, n_points, dtype=curve.xi.dtype, device=curve.xi.device)
    return curve.on_segments(z)[:2]


def find_structure(curve: Curve, n_points: int = 1000, polish: int = 4) -> Structure:
    """Zeros of S on a fine grid, polished by false position, and the arcs that S asks for."""
    t, w = grid(curve, max(100, n_points // curve.collocation.n_segments))
    s = switching_along(curve, t, w)
    law = curve.collocation.bvp.law
    # S > 0 decides the arc, so a zero is where that changes; shared knots appear twice and change nothing
    row, event = ((s[1:] > 0) != (s[:-1] > 0)).nonzero(as_tuple=True)
    low, high, s_low, s_high = t[row], t[row + 1], s[row, event], s[row + 1, event]
    root, side = low, torch.zeros_like(event)
    for _ in range(polish if len(row) else 0):
        root = (low * s_high - high * s_low) / (s_high - s_low)
        s_root = switching_along(curve, root).gather(1, event[:, None])[:, 0]
        left = (s_root > 0) == (s_low > 0)
        # Illinois: S is halved at an end that stays twice, so that both ends move
        before, side = side, torch.where(left, 1, -1)
        stale = torch.where(side == before, 0.5, 1.0)
        s_low, s_high = torch.where(left, s_root, stale * s_low), torch.where(left, stale * s_high, s_root)
        low, high = torch.where(left, root, low), torch.where(left, high, root)
    order = torch.argsort(root)
    root, event = root[order], event[order]
    ends = torch.cat([curve.times[:1], root, curve.times[-1:]])
    middle = 0.5 * (ends[1:] + ends[:-1])
    arcs = law.arc_codes(switching_along(curve, middle))
    keep = (arcs[1:] != arcs[:-1]).any(-1)
    arcs = torch.cat([arcs[:1], arcs[1:][keep]])
    structure = Structure(arcs, root[keep], tuple(event[keep].tolist()))
    # S = 0 at an end of the time, up to round-off of either sign, would open an arc without duration
    return without_short_arcs(structure, torch.cat([ends[:1], root[keep], ends[-1:]]), 1e-12)


def without_short_arcs(structure: Structure, knot_times: Tensor, fraction: float) -> Structure:
    """Merge away arcs shorter than ``fraction`` of the whole; neighbours that then agree become one arc."""
    durations = knot_times[1:] - knot_times[:-1]
    keep = (durations > fraction * (knot_times[-1] - knot_times[0])).nonzero()[:, 0].tolist()
    if not keep:
        keep = [int(durations.argmax())]
    arcs, times, events = [structure.arcs[keep[0]]], [], []
    for before, after in pairwise(keep):
        if bool((structure.arcs[after] == arcs[-1]).all()):
            continue
        # the arcs between the two are gone: one switch in the middle of where they were
        times.append(0.5 * (knot_times[before + 1] + knot_times[after]))
        events.append(structure.events[after - 1])
        arcs.append(structure.arcs[after])
    merged = torch.stack(times) if times else structure.times[:0]
    return Structure(torch.stack(arcs), merged, tuple(events))
