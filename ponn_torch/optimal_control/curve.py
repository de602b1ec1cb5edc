"""The curve w(t) that a vector of unknowns stands for: evaluable anywhere, with its defect ẇ − F off the nodes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.layout import Unknowns


@dataclass(frozen=True, eq=False)
class Curve:
    """Scaled states and costates of one solved residual; ξ (N,), no batch axis.

    At an interior knot the curve belongs to the segment on its right, the last knot to the last segment.
    """

    collocation: Collocation
    xi: Tensor

    @cached_property
    def unknowns(self) -> Unknowns:
        return self.collocation.unpack(self.xi)

    @property
    def times(self) -> Tensor:
        """Scaled knot times (K+1,)."""
        return self.unknowns.times

    @property
    def smoothing(self) -> float:
        """ρ, 0 where the control is not smoothed."""
        return self.collocation.smoothing

    @property
    def knots(self) -> Tensor:
        """Scaled w at the knots (K+1, 2n)."""
        return self.unknowns.knots

    @property
    def residual_norm(self) -> float:
        """‖r‖."""
        return float(self.collocation.residual(self.xi).norm())

    def segment_of(self, t: Tensor) -> Tensor:
        """Index of the segment that contains each scaled time."""
        interior = self.times[1:-1].contiguous()
        return torch.searchsorted(interior, t.contiguous(), right=True)

    def on_segment(self, z: Tensor, segment: int) -> tuple[Tensor, Tensor, Tensor]:
        """(t (m,), w (m, 2n), ẇ (m, 2n)) at z ∈ [−1, 1] of one segment; chained entries of ẇ are exact derivatives."""
        t, w, rate = self.collocation.on_each(self.unknowns, z)
        return t[segment], w[segment], rate[segment]

    def on_segments(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As ``on_segment`` at the same z (m,) of every segment, one after the other (K·m, ·); and each one's index."""
        t, w, rate = self.collocation.on_each(self.unknowns, z)
        index = torch.arange(len(t), device=t.device).repeat_interleave(len(z))
        return t.flatten(), w.flatten(0, 1), rate.flatten(0, 1), index

    def __call__(self, t: Tensor) -> Tensor:
        """w (m, 2n) at scaled times (m,)."""
        return self.at(t, self.segment_of(t))

    def at(self, t: Tensor, segment: Tensor) -> Tensor:
        """w (m, 2n) at scaled times (m,), each on a given segment."""
        return self.collocation.along(self.unknowns, t, segment)

    def setting(self, segment: Tensor) -> Setting:
        """The regime and parameters at points of the given segments (m,)."""
        setting = self.collocation.setting
        one = self.xi.new_ones(len(segment), 1)
        smoothing, arcs = setting.regime.smoothing, setting.regime.arcs
        regime = Regime(
            None if smoothing is None else smoothing * one,
            None if arcs is None else arcs[segment],
        )
        return Setting(regime, {k: v * one for k, v in setting.parameters.items()})

    def defect(self, n_points: int = 200) -> tuple[Tensor, Tensor]:
        """ẇ − F at scaled times off the nodes, about n_points a segment: (t (K·n,), (K·n, 2n))."""
        made = self.collocation

        def values() -> tuple[Tensor, Tensor]:
            t, w, rate = made.on_each(made.unpack(self.xi), made.discretisation.nodes.between(n_points))
            index = torch.arange(len(t), device=t.device).repeat_interleave(t.shape[-1])
            t, w, rate = t.flatten(), w.flatten(0, 1), rate.flatten(0, 1)
            return t, rate - made.bvp.rates(t[:, None], w, self.setting(index))

        t, defect = made.replayed(f"defect at {n_points}", values, self.xi)
        return t, defect

    def off_node_residuals(self, n_points: int = 50) -> Tensor:
        """Largest |ẇ − F| off the nodes of every segment (K,), in scaled units."""
        return self.defect(n_points)[1].abs().amax(-1).view(self.collocation.n_segments, -1).amax(-1)

    @property
    def largest_rate(self) -> float:
        """Largest |ẇ| at the nodes, in scaled units: what an off-node residual is held against."""
        return float(self.on_segments(self.collocation.discretisation.nodes.points)[2].abs().max())

    def off_node_residual(self, n_points: int = 200) -> float:
        """Largest |ẇ − F| off the nodes, in scaled units."""
        return float(self.defect(n_points)[1].abs().max())

    def mean_residual(self, n_points: int = 200) -> float:
        """Time average of the segments' largest |ẇ − F| off the nodes: what the curve misses its equations by.

        A pointwise bound would not be fair to very short arcs: where a chain of length q is resolved to round-off ε,
        its last derivative is known to ε/h^q only, 1e-8 on a ten-thousandth of the whole, but over so short a time that
        moves w by next to nothing. On one segment this is the largest |ẇ − F|.
        """
        share = self.times.diff() / (self.times[-1] - self.times[0])
        return float((share * self.off_node_residuals(n_points)).sum())
