"""Switch detection: the zeros of the switching functions along a curve, and the arcs between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise

import torch
from torch import Tensor

from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.control_set import Level, Regime
from ponn_torch.optimal_control.curve import Curve


@dataclass(frozen=True)
class Structure:
    """Arcs of a bounded control: codes (K, m), scaled times of the K−1 switches, and which S vanish there."""

    arcs: Tensor
    times: Tensor
    events: tuple[tuple[int, ...], ...]

    def __len__(self) -> int:
        return self.arcs.shape[0]

    def same_arcs(self, other: Structure) -> bool:
        return self.arcs.shape == other.arcs.shape and bool((self.arcs == other.arcs).all())

    def near(self, other: Structure, tolerance: float) -> bool:
        """The same arcs, and switch times that differ by no more than this."""
        return self.same_arcs(other) and bool(((self.times - other.times).abs() <= tolerance).all())


def claimed_structure(curve: Curve) -> Structure:
    """The arcs that a split curve was solved on, whatever its S says; one arc without a code where it was not split."""
    collocation = curve.collocation
    switches, arcs = collocation.switch_knots, collocation.setting.regime.arcs
    codes = curve.times.new_zeros(1, 0).long() if arcs is None else arcs[[0, *switches]]
    return Structure(codes, curve.times[switches], tuple(e for e in collocation.events if e is not None))


def switching_along(curve: Curve, t: Tensor, w: Tensor | None = None) -> Tensor:
    """Switching functions (m, n_switching) at scaled times (m,)."""
    setting = curve.setting(torch.zeros_like(t, dtype=torch.long))
    w = curve(t) if w is None else w
    return curve.collocation.bvp.switching(t[:, None], w, Setting(Regime(), setting.parameters))


@lru_cache(maxsize=32)
def _even(n_points: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """An even grid on [−1, 1]; always the same tensor, whose tables a discretisation keeps."""
    return torch.linspace(-1.0, 1.0, n_points, dtype=dtype, device=device)


def grid(curve: Curve, n_points: int = 400) -> tuple[Tensor, Tensor]:
    """Scaled times and w on an even grid with both ends in every segment, (K·n,) and (K·n, 2n)."""
    return curve.on_segments(_even(n_points, curve.xi.dtype, curve.xi.device))[:2]


def sampled(curve: Curve, n_points: int = 400) -> tuple[Tensor, Tensor]:
    """Scaled times (K·n,) and switching functions (K·n, n_switching) on that grid."""

    made = curve.collocation

    def values() -> tuple[Tensor, Tensor]:
        # unpacked anew: a tape is not to take what the curve has kept for a constant
        t, w, _ = made.on_each(made.unpack(curve.xi), _even(n_points, curve.xi.dtype, curve.xi.device))
        t, w = t.flatten(), w.flatten(0, 1)
        return t, switching_along(curve, t, w)

    t, switching = made.replayed(f"switching at {n_points}", values, curve.xi)
    return t, switching


def share_of_change(curve: Curve, blunter: Curve) -> float:
    """By how much of its change from a blunter curve a quantity that is linear in ρ changes on the way to ρ = 0."""
    return curve.smoothing / (blunter.smoothing - curve.smoothing)


def extrapolated(curve: Curve, blunter: Curve, n_points: int) -> tuple[Tensor, Tensor]:
    """What ``sampled`` gives, S without smoothing, from a curve and one of other smoothing: Richardson's rule.

    S moves with ρ nearly in proportion, and much: arcs that S(ρ) does not show yet, as it touches zero only at a
    smaller ρ, are there in what it moves towards (Earth–Mars: all five from ρ = 1 and 0.3, of which each shows three).
    """
    t, now = sampled(curve, n_points)
    stretched = blunter.times[-1] / curve.times[-1]
    same_segments = curve.times.shape == blunter.times.shape and torch.allclose(stretched * curve.times, blunter.times)
    before = sampled(blunter, n_points)[1] if same_segments else switching_along(blunter, stretched * t)
    return t, now + share_of_change(curve, blunter) * (now - before)


def find_structure(curve: Curve, blunter: Curve | None = None, *, n_points: int = 1000, polish: int = 4) -> Structure:
    """The arcs that S asks for, and its zeros: on a fine grid, then polished by rounds of false position.

    Without polish S is taken for linear between the points of the grid; so it is where it is extrapolated from a
    ``blunter`` curve.
    """
    n_points = max(100, n_points // curve.collocation.n_segments)
    t, s = sampled(curve, n_points) if blunter is None else extrapolated(curve, blunter, n_points)
    switching = partial(switching_along, curve)
    if blunter is not None or not polish:
        switching, polish = partial(_linear, t, s), 1
    # S > 0 decides the arc, so a zero is where that changes; shared knots appear twice and change nothing
    row, event = ((s[1:] > 0) != (s[:-1] > 0)).nonzero(as_tuple=True)
    low, high, s_low, s_high = t[row], t[row + 1], s[row, event], s[row + 1, event]
    root, side = low, torch.zeros_like(event)
    for _ in range(polish if len(row) else 0):
        root = (low * s_high - high * s_low) / (s_high - s_low)
        s_root = switching(root).gather(1, event[:, None])[:, 0]
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
    law = curve.collocation.bvp.law
    arcs = law.arc_codes(switching(middle))
    # S = 0 at an end of the time, or two S at once, up to round-off of either sign, would open an arc without duration
    return without_short_arcs(Structure(arcs, root, tuple((e,) for e in event.tolist())), ends, 1e-12, law.levels)


def _linear(t: Tensor, values: Tensor, at: Tensor) -> Tensor:
    """Values (m, k) at times (m,), linear between those (n, k) at ascending times (n,), of which some come twice."""
    after = torch.searchsorted(t, at).clamp(1, len(t) - 1)
    share = (at - t[after - 1]) / (t[after] - t[after - 1])
    return torch.lerp(values[after - 1], values[after], share[:, None])


def without_short_arcs(structure: Structure, knot_times: Tensor, fraction: float, levels: Sequence[Level]) -> Structure:
    """Merge away arcs shorter than ``fraction`` of the whole; neighbours that then agree become one arc.

    Where they differ in several components, these switch together.
    """
    first = {level.component: function for function, level in reversed(list(enumerate(levels)))}
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
        # of the functions of a component that vanished there, the last one
        gone = {levels[e].component: e for event in structure.events[before:after] for e in event}
        changed = (structure.arcs[after] != arcs[-1]).nonzero()[:, 0].tolist()
        events.append(tuple(gone.get(i, first[i]) for i in changed))
        arcs.append(structure.arcs[after])
    merged = torch.stack(times) if times else structure.times[:0]
    return Structure(torch.stack(arcs), merged, tuple(events))


# -- repair ------------------------------------------------------------------------------------------------------------


def wrong_side(switching: Tensor, codes: Tensor, levels: Sequence[Level]) -> Tensor:
    """How far every S (..., n_switching) is on the side that its arc's codes (..., k) exclude; negative on the right.

    On a singular arc both sides are wrong: its code is neither above nor below.
    """
    if not levels:
        return switching
    components, below, above = (codes.new_tensor(column) for column in zip(*levels, strict=True))
    claimed = codes.expand(*switching.shape[:-1], -1).index_select(-1, components)
    depth = torch.where(claimed >= above, -switching, switching)
    return torch.where((claimed > below) & (claimed < above), switching.abs(), depth)


def along_arcs(curve: Curve) -> tuple[Tensor, Tensor, Tensor]:
    """Scaled times (m,) and w (m, 2n) on a grid of a split curve, and the claimed arc that each point lies on."""
    collocation = curve.collocation
    n_points = max(100, 1000 // collocation.n_segments)
    t, w = grid(curve, n_points)
    starts = torch.tensor(collocation.switch_knots, dtype=torch.long)
    of_segment = torch.bucketize(torch.arange(collocation.n_segments), starts, right=True)
    return t, w, of_segment.repeat_interleave(n_points).to(t.device)


def depth_along(curve: Curve, claimed: Structure) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Scaled times (m,) on that grid, the arc of each, S (m, k) there, and how far it is on the wrong side (m, k)."""
    t, w, arc = along_arcs(curve)
    switching = switching_along(curve, t, w)
    return t, arc, switching, wrong_side(switching, claimed.arcs[arc], curve.collocation.bvp.law.levels)


def needles(curve: Curve, width: float, tolerance: float) -> list[Structure]:
    """The structures of a split ``curve`` with one short arc more where S is on the wrong side; the deepest first.

    On the wrong arcs S is that of another extremal, and its zeros say little about the right ones. But its sign is the
    first-order effect of a needle variation on the cost, so that a needle leads downhill: two switches about the peak
    of S, or one where S asks to change an end. ``width`` is its longest duration as a fraction of the final time.
    """
    claimed = claimed_structure(curve)
    if curve.collocation.setting.regime.arcs is None:
        return []
    arcs, events, levels = claimed.arcs, claimed.events, curve.collocation.bvp.law.levels
    ends = torch.cat([curve.times[:1], claimed.times, curve.times[-1:]])
    t, arc, switching, depth = depth_along(curve, claimed)
    found: list[tuple[float, Structure]] = []
    for event, column in enumerate(depth.unbind(-1)):
        # runs of points on the wrong side, cut where an arc ends
        run = torch.where(column > tolerance, arc + 1, 0)
        cuts = (run.diff() != 0).nonzero()[:, 0] + 1
        for points in torch.arange(len(run), device=run.device).tensor_split(cuts.cpu()):
            if not int(run[points[0]]):
                continue
            k, peak = int(arc[points[0]]), int(points[column[points].argmax()])
            length = min(width * float(ends[-1] - ends[0]), 0.3 * float(ends[k + 1] - ends[k]))
            middle = float(t[peak].clamp(ends[k] + length, ends[k + 1] - length))
            new = [middle - 0.5 * length, middle + 0.5 * length]
            needle = arcs[k].clone()
            needle[levels[event].component] = levels[event].above if switching[peak, event] > 0 else levels[event].below
            pieces = [arcs[: k + 1], needle[None], arcs[k:]]
            if int(points[-1]) == len(run) - 1:
                new, pieces = [float(ends[-1]) - length], pieces[:2]
            elif int(points[0]) == 0:
                new, pieces = [float(ends[0]) + length], pieces[1:]
            switches = torch.cat([ends[1 : k + 1], ends.new_tensor(new), ends[k + 1 : -1]])
            what = (*events[:k], *[(event,)] * len(new), *events[k:])
            found.append((float(column[peak]), Structure(torch.cat(pieces), switches, what)))
    return [structure for _, structure in sorted(found, key=lambda pair: -pair[0])]
