"""Enrichment: more nodes where the control switches, and more neurons, on the single domain (PoNN paper, section 4)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ponn_torch.ansatz.basis import Chebyshev, LinearBasis
from ponn_torch.numerics.nodes import NodeSet, make_panels
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.solving.single_domain import Layers, SingleDomain


@dataclass(frozen=True)
class Enrichment(SingleDomain):
    """``n_extra`` nodes more in every interval over which the control switches, then the problem solved again.

    The paper adds 100 nodes to each, and goes from 70 to 80 neurons in the transfer, from 30 to 30 in the landing.

    Attributes:
        n_neurons: of the enriched free function. n_nodes: on the whole domain, apart from the extra ones.
        n_extra: per switch interval. half_width: of an interval, in widths of tanh(S/ρ).
        least_half_width: of an interval, on z ∈ [−1, 1]: what is known of a switch from nodes that do not resolve it.
        basis: the free function (Chebyshev by default).
    """

    n_neurons: int = 80
    n_nodes: int = 200
    n_extra: int = 100
    half_width: float = 5.0
    least_half_width: float = 0.01
    basis: Callable[[int], LinearBasis] = Chebyshev

    def discretisation(self, curve: Curve, layers: Layers) -> Discretisation:
        intervals = switch_intervals(layers, self.half_width, self.least_half_width)
        nodes = enriched_nodes(intervals, self.n_nodes, self.n_extra, curve.xi)
        disc = curve.collocation.discretisation
        return Discretisation(curve.collocation.bvp, self.basis(self.n_neurons), nodes, disc.form, disc.conditioning)


def switch_intervals(layers: Layers, half_width: float, least_half_width: float) -> list[tuple[Tensor, Tensor, int]]:
    """(start, end, number of switches) on [−1, 1] of every interval around a layer; those that meet become one."""
    half = (half_width * layers.widths).clamp_min(least_half_width)
    starts, ends = (layers.centres - half).clamp_min(-1.0), (layers.centres + half).clamp_max(1.0)
    merged: list[tuple[Tensor, Tensor, int]] = []
    for start, end in zip(starts, ends, strict=True):
        if merged and bool(start <= merged[-1][1]):
            first, last, count = merged.pop()
            merged.append((first, torch.maximum(last, end), count + 1))
        else:
            merged.append((start, end, 1))
    return merged


def enriched_nodes(intervals: list[tuple[Tensor, Tensor, int]], n_nodes: int, n_extra: int, like: Tensor) -> NodeSet:
    """Gauss panels on the intervals and between them: of n_nodes those that a Gauss rule has there, and the extra ones.

    So that every panel follows polynomials as the whole rule would, the nodes go by the measure dz/√(1 − z²).
    """
    ends = like.new_tensor([-1.0, 1.0])
    edges = torch.cat([ends, *(torch.stack(interval[:2]) for interval in intervals)]).unique()
    extra = {float(start): n_extra * count for start, _, count in intervals}
    share = edges.asin().diff() / math.pi
    counts = [
        extra.get(float(start), 0) + max(4, math.ceil(n_nodes * float(part)))
        for start, part in zip(edges[:-1], share, strict=True)
    ]
    return make_panels("legendre_gauss", edges, counts)
