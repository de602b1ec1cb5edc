"""Singular arcs: S = 0 over an interval, so that H does not say what the control is there; its derivatives do.

With H affine in the control Ṡ does not depend on the component that S belongs to, and S̈ = a + b η does, affinely. An
arc of first order has S = Ṡ = 0 where it begins and η = −a/b along it; b > 0 is the generalised Legendre–Clebsch
condition. With S̈ = 0 on an arc S vanishes everywhere if it does at both ends, so that rows S = 0 at its switches are
all it needs; at an end of the time the conditions there stand in for one.

Components are singular one at a time, or several that have no part in each other's S̈.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import differentiable, gradients
from ponn_torch.optimal_control.control_set import INTERIOR, ControlSet, Regime

if TYPE_CHECKING:
    from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting

Along = Callable[[Tensor, Tensor], Tensor]  # (t, w) → (...,)


def singular_components(law: ControlSet, arcs: Tensor | None) -> tuple[int, ...]:
    """Components with an interior arc among codes (K, m), of those that H is affine in."""
    return () if arcs is None else tuple(i for i in law.jumping if bool((arcs[..., i] == INTERIOR).any()))


def singular_fractions(bvp: BoundaryValueProblem, t: Tensor, w: Tensor, setting: Setting) -> Tensor:
    """η (..., m) that keeps S̈ = 0 on the singular arcs of the setting, elsewhere one half; t (..., 1), w (..., 2n)."""
    arcs = setting.regime.arcs
    assert arcs is not None
    half = torch.full_like(w[..., 0], 0.5)
    fractions = [half] * arcs.shape[-1]
    with differentiable(t, w, *setting.parameters.values()):
        for i in bvp.singular:
            at_lower, at_upper = (_second_rate(bvp, t, w, setting, i, i, share) for share in (0.0, 1.0))
            bend = at_upper - at_lower
            inside = (arcs[..., i] == INTERIOR) & (bend != 0)
            fractions[i] = torch.where(inside, -at_lower / torch.where(inside, bend, 1.0), half)
    return torch.stack(fractions, -1)


def clebsch(bvp: BoundaryValueProblem, t: Tensor, w: Tensor, setting: Setting) -> Tensor:
    """Least eigenvalue (...,) of ∂S̈_i/∂η_j over the components that are singular there, relative to the size of S̈.

    Above zero where Legendre and Clebsch's condition holds; one where nothing is singular.
    """
    arcs, count = setting.regime.arcs, len(bvp.singular)
    assert arcs is not None
    ends = [
        [[_second_rate(bvp, t, w, setting, i, j, share) for share in (0.0, 1.0)] for j in bvp.singular]
        for i in bvp.singular
    ]
    bends = torch.stack([torch.stack([high - low for low, high in row], -1) for row in ends], -2)
    size = torch.stack([ends[k][k][0].abs() + ends[k][k][1].abs() for k in range(count)], -1)
    root = size.clamp_min(torch.finfo(w.dtype).tiny).sqrt()
    inside = arcs[..., list(bvp.singular)] == INTERIOR
    together = inside.unsqueeze(-1) & inside.unsqueeze(-2)
    one = torch.eye(count, dtype=w.dtype, device=w.device)
    relative = torch.where(together, bends / (root.unsqueeze(-1) * root.unsqueeze(-2)), one)
    return torch.linalg.eigvalsh(0.5 * (relative + relative.mT))[..., 0]


def _second_rate(
    bvp: BoundaryValueProblem, t: Tensor, w: Tensor, setting: Setting, component: int, varied: int, share: float
) -> Tensor:
    """S̈ (...,) of a component along the flow, with the η of one component at ``share``, those of others at one half."""
    arcs = setting.regime.arcs
    assert arcs is not None
    interior = torch.full(arcs.shape, 0.5).to(w)
    interior[..., varied] = share
    held = replace(setting, regime=Regime(arcs=arcs, interior=interior))
    free, function = replace(setting, regime=Regime()), bvp.law.jumping[component]

    def switching(t: Tensor, w: Tensor) -> Tensor:
        return bvp.switching(t, w, free)[..., function]

    def rate(function: Along) -> Along:
        def along(t: Tensor, w: Tensor) -> Tensor:
            by_t, by_w = gradients(function, t, w)
            return by_t[..., 0] + (by_w * bvp.rates(t, w, held)).sum(-1)

        return along

    return rate(rate(switching))(t, w)
