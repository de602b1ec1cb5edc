"""What every entry of ξ is: weights of the segments, free knot values, free times, multipliers.

Knots lie between *anchors*, the ends and the switches. One that only subdivides a stretch between two of them stays at
its fraction of the way between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting
from ponn_torch.optimal_control.discretisation import Discretisation


@dataclass(frozen=True)
class Unknowns:
    """ξ taken apart: weights (..., K, n_own), knots (..., K+1, 2n), times (..., K+1), multipliers (..., M)."""

    weights: Tensor
    knots: Tensor
    times: Tensor
    multipliers: Tensor


@dataclass(frozen=True, eq=False)
class Layout:
    """The unknowns of a discretisation on given knots; K segments, any leading batch axes on what varies.

    Attributes:
        known_knots: (..., K+1, 2n) scaled values; NaN marks an unknown entry, the same in the whole batch.
        known_times: (..., K+1) scaled, ascending; first guesses of those that are unknown.
        events: per interior knot, the indices of the switching functions that vanish there, its time unknown; or
            None: the knot only subdivides, at the same fraction of the way between its neighbouring switches or ends.
        setting: the regime (smoothing (...,), or arc codes (..., K, m)) and parameters (...,) by name.
    """

    discretisation: Discretisation
    known_knots: Tensor
    known_times: Tensor
    setting: Setting
    events: tuple[tuple[int, ...] | None, ...] = ()

    def __post_init__(self) -> None:
        if len(self.events) != self.n_segments - 1:
            raise ValueError(
                f"events = {self.events}: {len(self.events)} entries for {self.n_segments} segments; "
                f"allowed: one per interior knot ({self.n_segments - 1})"
            )

    @property
    def bvp(self) -> BoundaryValueProblem:
        return self.discretisation.bvp

    @property
    def smoothing(self) -> float:
        """ρ of the regime, 0 where the control is not smoothed."""
        value = self.setting.regime.smoothing
        return 0.0 if value is None else float(value)

    @property
    def n_segments(self) -> int:
        return self.known_times.shape[-1] - 1

    @cached_property
    def free_knots(self) -> Tensor:
        """Positions of unknown entries in the flattened knot table."""
        unknown = torch.isnan(self.known_knots).flatten(-2)
        return unknown.reshape(-1, unknown.shape[-1])[0].nonzero()[:, 0]

    @cached_property
    def free_times(self) -> Tensor:
        """Knots whose times are unknowns: the switches, and the end where the final time is free."""
        free = [False, *(event is not None for event in self.events), self.bvp.problem.free_final_time]
        return torch.tensor(free, device=self.known_times.device).nonzero()[:, 0]

    @cached_property
    def _anchors(self) -> Tensor:
        """(2, K+1): the switches or ends that every knot lies between; an anchor lies on itself."""
        anchors = [0, *self.switch_knots, self.n_segments]
        before = [max(a for a in anchors if a <= i) for i in range(self.n_segments + 1)]
        after = [min(a for a in anchors if a >= i) for i in range(self.n_segments + 1)]
        return torch.tensor([before, after], device=self.known_times.device)

    @cached_property
    def _fractions(self) -> Tensor:
        """(K+1,): how far a knot lies between its anchors; a batch takes those of its first member."""
        known = self.known_times.reshape(-1, self.n_segments + 1)[0]
        start, end = known[self._anchors]
        return torch.where(end > start, (known - start) / (end - start), torch.zeros_like(known))

    @property
    def n_weights(self) -> int:
        return self.n_segments * self.discretisation.n_own

    @property
    def n_unknowns(self) -> int:
        return self.n_weights + self.n_shared

    @property
    def n_shared(self) -> int:
        return len(self.free_knots) + len(self.free_times) + self.bvp.n_multipliers

    @property
    def linear_unknowns(self) -> Tensor:
        """All unknowns but hidden weights: the output layers and what the segments share."""
        output, own = self.discretisation.expressions.output_layer, self.discretisation.n_own
        segments = torch.arange(self.n_segments, device=output.device)
        shared = torch.arange(self.n_weights, self.n_unknowns, device=output.device)
        return torch.cat([(own * segments[:, None] + output).flatten(), shared])

    def unpack(self, xi: Tensor) -> Unknowns:
        """Read ξ (..., N); fixed knots and times are filled in."""
        batch, k = xi.shape[:-1], self.n_segments
        weights = xi[..., : self.n_weights].unflatten(-1, (k, self.discretisation.n_own))
        knot_end = self.n_weights + len(self.free_knots)
        time_end = knot_end + len(self.free_times)
        knots = self.known_knots.flatten(-2).expand(*batch, -1)
        knots = knots.index_copy(-1, self.free_knots, xi[..., self.n_weights : knot_end])
        anchors = self.known_times.expand(*batch, -1)
        if len(self.free_times):
            anchors = anchors.index_copy(-1, self.free_times, xi[..., knot_end:time_end])
        start, end = anchors.index_select(-1, self._anchors.flatten()).chunk(2, -1)
        times = start + self._fractions * (end - start)
        return Unknowns(weights, knots.unflatten(-1, (k + 1, self.bvp.dimension)), times, xi[..., time_end:])

    def pack(self, unknowns: Unknowns) -> Tensor:
        """Inverse of ``unpack``: what is known is left out."""
        return torch.cat(
            [
                unknowns.weights.flatten(-2),
                unknowns.knots.flatten(-2)[..., self.free_knots],
                unknowns.times[..., self.free_times],
                unknowns.multipliers,
            ],
            -1,
        )

    # -- where the columns and rows that segments share stand ---------------------------------------------------------

    @cached_property
    def shared_index(self) -> Tensor:
        """(K, S): where a segment's [knots on both sides, group by group; anchors around it] stand among the shared."""
        k, width, device = self.n_segments, self.bvp.dimension, self.known_times.device
        n_knots, n_times = len(self.free_knots), len(self.free_times)
        knots = torch.full(((k + 1) * width,), self.n_shared, device=device)
        knots[self.free_knots] = torch.arange(n_knots, device=device)
        knots = knots.view(k + 1, width)
        times = torch.full((k + 1,), self.n_shared, device=device)
        times[self.free_times] = n_knots + torch.arange(n_times, device=device)
        start, end = self._segment_anchors
        sides = [torch.cat([knots[:-1, g.columns], knots[1:, g.columns]], -1) for g in self.discretisation.groups]
        return torch.cat([*(side.flatten(1) for side in sides), times[start, None], times[end, None]], -1)

    @property
    def _segment_anchors(self) -> tuple[Tensor, Tensor]:
        """Anchors (K,) before and after every segment."""
        return self._anchors[0, :-1], self._anchors[1, 1:]

    @property
    def end_fractions(self) -> tuple[Tensor, Tensor]:
        """How far the two ends of every segment (K,) lie between its anchors."""
        fractions = self._fractions
        # the end of a segment that is an anchor is the anchor after it, not the one before the next
        return fractions[:-1], torch.where(
            self._anchors[1, 1:] == self._anchors[0, 1:], torch.ones_like(fractions[1:]), fractions[1:]
        )

    @property
    def switch_knots(self) -> list[int]:
        """Interior knots at which the control switches."""
        return [i + 1 for i, event in enumerate(self.events) if event is not None]

    @cached_property
    def _switches(self) -> Tensor:
        return torch.tensor(self.switch_knots, dtype=torch.long, device=self.known_times.device)

    @cached_property
    def _vanishing(self) -> list[tuple[int, int]]:
        """Per switching row its switch and its switching function: components may switch together."""
        switches = [event for event in self.events if event is not None]
        return [(i, function) for i, event in enumerate(switches) for function in event]

    @property
    def n_extra(self) -> int:
        return len(self._vanishing) + self.bvp.n_terminal_rows
