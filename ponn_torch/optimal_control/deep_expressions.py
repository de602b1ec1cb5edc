"""Constrained expressions around a network: y = g(z; θ) + Ω(κ − C[g(·; θ)]), one head per chain.

The network is evaluated at the nodes and at both ends, where the constraints C read it. A row of the Jacobian is the
gradient of the network at one node, minus Ω times the gradients at the ends, which all rows share.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ponn_torch.ansatz.networks import MLP, Network
from ponn_torch.numerics.linalg import least_squares
from ponn_torch.optimal_control.expressions import Cotangents

if TYPE_CHECKING:
    from ponn_torch.optimal_control.discretisation import Discretisation, Group

# relative to the largest singular value of the features: what is below it would need large output weights, from which
# training does not recover
_RIDGE = 1e-7


class DeepExpressions:
    """Weights of one network per segment; trivial chains have no head."""

    def __init__(self, discretisation: Discretisation, network: MLP) -> None:
        self.groups, self.nodes, self.network = discretisation.groups, discretisation.nodes, network
        self.rows = [slice(0, 0) if group.trivial else group.active for group in self.groups]  # a head per equation
        self.n_heads = max(rows.stop for rows in self.rows)
        self.order = max((group.order for group in self.groups if not group.trivial), default=0)
        points = self.nodes.points
        self.ends = points.new_tensor([-1.0, 1.0])
        used = network.n_weights(self.n_heads) if self.n_heads else 0
        self.initial = network.initial(self.n_heads, dtype=points.dtype, device=points.device)[:used]
        self.output_layer = network.output_layer(self.n_heads).to(points.device)

    @property
    def _with_heads(self) -> Iterator[tuple[Group, slice]]:
        return ((group, heads) for group, heads in zip(self.groups, self.rows, strict=True) if not group.trivial)

    @property
    def n_own(self) -> int:
        return len(self.initial)

    def network_of(self, weights: Tensor) -> Network:
        """A module with the weights (n_own,) of a segment; its outputs are the free functions g, chain by chain."""
        return Network(self.network, weights)

    def jets(self, weights: Tensor, kappas: Sequence[Tensor]) -> list[Tensor]:
        return self._jets(self.nodes.points, [group.Omega for group in self.groups], weights, kappas)

    def jets_at(self, z: Tensor, weights: Tensor, kappas: Sequence[Tensor]) -> list[Tensor]:
        return self._jets(z, [g.switching(z, g.order)[:, :, 0] for g in self.groups], weights, kappas)

    def jets_along(self, z: Tensor, segment: Tensor, weights: Tensor, kappas: Sequence[Tensor]) -> list[Tensor]:
        out = [z.new_zeros(group.n_chains, group.order + 1, len(z)) for group in self.groups]
        for k in segment.unique().tolist():
            here = segment == k
            for whole, part in zip(out, self.jets_at(z[here], weights[k], [kappa[k] for kappa in kappas]), strict=True):
                whole[..., here] = part
        return out

    def _jets(self, z: Tensor, omegas: Sequence[Tensor], weights: Tensor, kappas: Sequence[Tensor]) -> list[Tensor]:
        jet = self.network.jet(weights, torch.cat([z, self.ends]), self.order) if self.n_heads else weights
        out = []
        for group, heads, omega, kappa in zip(self.groups, self.rows, omegas, kappas, strict=True):
            if group.trivial:
                out.append(torch.einsum("enk,...dk->...den", omega, kappa))
                continue
            own = jet[..., : group.order + 1, :, heads].movedim(-1, -3)  # (..., d, q+1, n + 2)
            rest = kappa - own[..., :-1, -2:].mT.flatten(-2)
            out.append(own[..., :-2] + torch.einsum("enk,...dk->...den", omega, rest))
        return out

    def pull_back(self, weights: Tensor, cotangents: Cotangents) -> Tensor:
        batch, n, n_rows = weights.shape[:-1], len(self.nodes), self.groups[-1].rows.stop
        local = weights.new_zeros(*batch, n_rows, self.n_own)
        if not self.n_heads:
            return local
        by_jet = weights.new_zeros(*batch, self.n_heads, n, self.order + 1, self.n_heads)
        by_ends = weights.new_zeros(*batch, self.n_heads, n, 2, self.order, self.n_heads)
        for (i, j), by_order in cotangents.items():
            for e, c in by_order.items() if not self.groups[j].trivial else ():
                by_jet[..., self.rows[i], :, e, self.rows[j]] = c
        for group, heads in self._with_heads:
            own = by_jet[..., heads, :, group.order, heads].diagonal(dim1=-3, dim2=-1)  # the equations' own highest
            own.copy_((own.new_ones(n) if group.pointwise is None else group.pointwise)[:, None].expand_as(own))
        for group, heads in self._with_heads:
            seen = torch.einsum("...rned,enk->...rnkd", by_jet[..., : group.order + 1, heads], group.Omega)
            by_ends[..., : group.order, heads] = -seen.unflatten(-2, (2, group.order))
        pointwise = self.network.gradients(weights, self.nodes.points, by_jet)
        pointwise += (by_ends.flatten(-3).flatten(-3, -2) @ self._end_gradients(weights)).unflatten(-2, (-1, n))
        for group, heads in self._with_heads:
            block = pointwise[..., heads, :, :]
            block = group.test @ block if group.pointwise is None else block
            local[..., group.rows, :] = block.flatten(-3, -2)
        return local

    def _end_gradients(self, weights: Tensor) -> Tensor:
        """∂(derivatives below the order, of every head, at both ends)/∂weights, (..., 2 · order · heads, P)."""
        size = self.order * self.n_heads
        pick = torch.eye(size, dtype=weights.dtype, device=weights.device).view(size, 1, self.order, self.n_heads)
        pick = torch.cat([pick, torch.zeros_like(pick[:, :, :1])], -2).expand(*weights.shape[:-1], -1, 2, -1, -1)
        return self.network.gradients(weights, self.ends, pick).transpose(-3, -2).flatten(-3, -2)

    def fit(self, values: Sequence[Tensor], kappas: Sequence[Tensor]) -> Tensor:
        """Hidden weights of the seed under output weights of the least-squares fit."""
        batch, root = values[0].shape[:-2], self.nodes.weights.sqrt()
        weights = self.initial.repeat(*batch, 1)
        if not self.n_heads:
            return weights
        features = self.network.hidden_jet(self.initial, torch.cat([self.nodes.points, self.ends]), self.order)
        output = weights.new_zeros(*batch, features.shape[-1], self.n_heads)
        for group, heads, value, kappa in zip(self.groups, self.rows, values, kappas, strict=True):
            if group.trivial:
                continue
            ends = features[:, : group.order, -2:].transpose(-3, -2).flatten(-3, -2)  # C of the features, (B, 2q, L)
            table = root[:, None] * (features[:, 0, :-2] - group.Omega[0] @ ends)
            rest = root[:, None] * (value - (kappa @ group.Omega[0].mT).mT)
            for d, head in enumerate(range(heads.start, heads.stop)):
                net = table[0 if self.network.shared else head]
                ridge = (_RIDGE * float(torch.linalg.matrix_norm(net, 2))) ** 2
                output[..., head] = least_squares(net, ridge)(rest[..., d].mT).mT
        in_nets = output if self.network.shared else output.mT
        weights[..., self.output_layer] = in_nets.flatten(-2)
        return weights
