"""The exact Jacobian of a collocation residual, block by block.

F is differentiated at the nodes only: one backward pass gives ∂F_i/∂w for the equations in use, and the expressions
pull these cotangents back to weights and knots. Times enter by the chain rule through the half lengths. Nothing of the
size of the whole Jacobian is differentiated, which is what makes it cheap.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ponn_torch.numerics.linalg import ArrowJacobian
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.expressions import Cotangents, accumulate

if TYPE_CHECKING:
    from ponn_torch.optimal_control.collocation import Collocation


def linearise(collocation: Collocation, xi: Tensor) -> tuple[Tensor, ArrowJacobian]:
    """r (..., R) and J at ξ (..., N)."""
    disc = collocation.discretisation
    unknowns = collocation.unpack(xi)
    h = (unknowns.times[..., 1:] - unknowns.times[..., :-1]) / 2
    jets, kappas, factors = collocation.jets(unknowns, h)
    t, w = collocation.points(jets, unknowns.times, h)
    rates, by_t, by_w = _rates_and_slopes(collocation, t, w)

    slopes = _cotangents(disc, h, by_w)
    local = disc.expressions.pull_back(unknowns.weights, slopes)
    shared = local.new_zeros(*local.shape[:-1], 2 * disc.bvp.dimension + 2)
    _by_knots(disc, slopes, factors, shared)
    if len(collocation.free_times):
        by_h = _by_half_length(collocation, jets, kappas, h, rates, by_t, by_w)
        _by_times(collocation, by_h, h, by_t, shared)

    equations = collocation.equations(jets, h, rates)
    _weigh(collocation, equations, h, local, shared)
    extra_rows, extra = collocation.extra_linearised(unknowns)
    residual = collocation.rows(equations, extra_rows, h)
    return residual, ArrowJacobian(local, shared, extra, collocation.shared_index)


def _weigh(collocation: Collocation, equations: Tensor, h: Tensor, local: Tensor, shared: Tensor) -> None:
    """Give the rows of ``local`` and ``shared`` the factor (h₀/h)^(q−1) of the equations (..., K, n_rows)."""
    f, g = (fraction[:, None, None] for fraction in collocation.end_fractions)
    stretch, length = collocation.stretch(h)[..., None, None], h[..., None, None]
    for group in collocation.discretisation.groups:
        power = group.order - 1
        if power and len(collocation.free_times):
            local[..., group.rows, :].div_(stretch**power)
            shared[..., group.rows, :].div_(stretch**power)
            # 2h is the distance between the anchors times g − f
            by_end = -0.5 * power * (g - f) * equations[..., group.rows, None] / length
            shared[..., group.rows, -2:].add_(torch.cat([-by_end, by_end], -1))


def _rates_and_slopes(collocation: Collocation, t: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """F (..., 2n) at the nodes and, for the equations in use, ∂F/∂t (..., rows) and ∂F/∂w (..., rows, 2n).

    The columns of ∂F/∂w are in the order of the discretisation's.
    """
    shape, disc = w.shape, collocation.discretisation
    rows = disc.last_columns.tolist()
    points = t.reshape(-1, 1), w.reshape(-1, shape[-1])
    rates, by_t, by_w = collocation.bvp.linearised_rates(*points, collocation.point_setting(shape[:-1]), rows)
    by_w = disc.ordered(by_w).view(*shape[:-1], len(rows), shape[-1])
    return rates.view(shape), by_t.view(*shape[:-1], len(rows)), by_w


def _by_half_length(
    collocation: Collocation,
    jets: Sequence[Tensor],
    kappas: Sequence[Tensor],
    h: Tensor,
    rates: Tensor,
    by_t: Tensor,
    by_w: Tensor,
) -> list[Tensor]:
    """Derivative of each group's pointwise equations (..., K, d, n) with respect to h at fixed β and knots."""
    disc, per_length = collocation.discretisation, 1.0 / h[..., None, None]
    moved, tops, rates = [], [], disc.ordered(rates)
    for group, jet, kappa in zip(disc.groups, jets, kappas, strict=True):
        powers = torch.arange(group.order, dtype=h.dtype, device=h.device).repeat(2)
        # κ_e carries h^e
        by_h = torch.einsum("onk,...dk->...don", group.Omega, powers * kappa) * per_length[..., None]
        moved.append(by_h[..., 0, :])
        for e in range(1, group.order):
            change = by_h[..., e, :] - e * per_length * jet[..., e, :]
            moved.append(change / (h[..., None] ** e * group.factors[:, e])[..., None])
        tops.append(by_h[..., -1, :])
    by_points = (by_w @ torch.cat(moved, -2).mT.unsqueeze(-1)).squeeze(-1)
    total = by_points + by_t * (disc.nodes.points + 1.0)[:, None]
    out = []
    for group, top in zip(disc.groups, tops, strict=True):
        if not group.trivial:
            scale = h[..., None] ** group.order * group.factors[:, -1]
            growth = group.order * per_length * group.of(rates)[..., -1, :].mT
            top = top - scale[..., None] * (growth + total[..., group.active].mT)
        out.append(top)
    return out


def _by_times(collocation: Collocation, by_h: Sequence[Tensor], h: Tensor, by_t: Tensor, shared: Tensor) -> None:
    """Fill the columns of the anchors: h = (t₁ − t₀)/2, and t = t₀ + h (z + 1) moves with t₀ apart from h."""
    f, g = (fraction[:, None, None] for fraction in collocation.end_fractions)
    for group, stretch in zip(collocation.discretisation.groups, by_h, strict=True):
        drift = torch.zeros_like(stretch)
        if not group.trivial:
            scale = h[..., None] ** group.order * group.factors[:, -1]
            drift = -scale[..., None] * by_t[..., group.active].mT
        by_start, by_end = drift - 0.5 * stretch, 0.5 * stretch
        anchors = torch.stack([(1 - f) * by_start + (1 - g) * by_end, f * by_start + g * by_end], -1)
        shared[..., group.rows, -2:] = (group.test @ anchors).flatten(-3, -2)


def _cotangents(disc: Discretisation, h: Tensor, by_w: Tensor) -> Cotangents:
    """∂(pointwise equations)/∂(derivatives of the chains); a group's equations are y^(q) − scale F."""
    out: dict[tuple[int, int], dict[int, Tensor]] = {}
    for i, group in enumerate(disc.groups):
        by_group = by_w[..., group.active, :]
        for j, other in enumerate(disc.groups):
            by_order = out[i, j] = {}
            for e in disc.active_orders(group, other):
                factors = -group.factors[:, -1, None] / other.factors[:, e]
                ratio = h[..., None, None, None] ** (group.order - e) * factors
                # (..., K, d, n, d'): equation, node, chain that it depends on
                c = (other.of(by_group)[..., e, :] * ratio).transpose(-3, -2)
                by_order[e] = c if group.pointwise is None else c * group.pointwise[:, None]
    return out


def _by_knots(disc: Discretisation, cotangents: Cotangents, kappa_factors: Sequence[Tensor], shared: Tensor) -> None:
    """Fill the knots' columns of ``shared``: y sees them through Ω κ."""
    for (i, j), by_order in cotangents.items():
        if by_order or i == j:
            other = disc.groups[j]
            columns = shared[..., other.ends].unflatten(-1, (other.n_chains, -1))
            block = accumulate(columns, disc.groups[i], by_order, other.Omega, own=i == j)
            block.mul_(kappa_factors[j][..., None, None, :, :])
