"""Singular arcs: S = 0 over an interval, so that H does not say what the control is there; its derivatives do.

With H affine in the control Ṡ does not depend on the component that S belongs to, and S̈ = a + b η does, affinely. An
arc of first order has S = Ṡ = 0 where it begins and η = −a/b along it; b > 0 is the generalised Legendre–Clebsch
condition. With S̈ = 0 on an arc S vanishes everywhere if it does at both ends: no other rows are needed than those of
any switch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import differentiable, gradients
from ponn_torch.optimal_control.control_set import INTERIOR, ControlSet, Regime

if TYPE_CHECKING:
    from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting

Along = Callable[[Tensor, Tensor], Tensor]  # (t, w) → (...,)


def singular_components(law: ControlSet, arcs: Tensor | None) -> tuple[int, ...]:
    """Components with an interior arc among codes (K, m), of a control that H is affine in."""
    if arcs is None or not law.jumps:
        return ()
    return tuple((arcs == INTERIOR).any(0).nonzero()[:, 0].tolist())


class SingularControl(NamedTuple):
    """η (..., m) that keeps S̈ = 0, one half where no arc is singular; and b = ∂S̈/∂η (..., m), zero there."""

    fraction: Tensor
    bend: Tensor


def singular_control(bvp: BoundaryValueProblem, t: Tensor, w: Tensor, setting: Setting) -> SingularControl:
    """η on the singular arcs of the setting, one component of the control at a time; t (..., 1), w (..., 2n)."""
    arcs = setting.regime.arcs
    assert arcs is not None
    half, none = torch.full_like(w[..., 0], 0.5), torch.zeros_like(w[..., 0])
    fractions, bends = [half] * arcs.shape[-1], [none] * arcs.shape[-1]
    with differentiable(t, w, *setting.parameters.values()):
        for i in bvp.singular:
            at_lower, at_upper = (_second_rate(bvp, t, w, setting, i, share) for share in (0.0, 1.0))
            bend = at_upper - at_lower
            inside = (arcs[..., i] == INTERIOR) & (bend != 0)
            fractions[i] = torch.where(inside, -at_lower / torch.where(inside, bend, 1.0), half)
            bends[i] = torch.where(inside, bend, none)
    return SingularControl(torch.stack(fractions, -1), torch.stack(bends, -1))


def _second_rate(
    bvp: BoundaryValueProblem, t: Tensor, w: Tensor, setting: Setting, component: int, share: float
) -> Tensor:
    """S̈ (...,) of a component along the flow, its η held at ``share``."""
    arcs = setting.regime.arcs
    assert arcs is not None
    held = replace(setting, regime=Regime(arcs=arcs, interior=torch.full(arcs.shape, share).to(w)))
    free = replace(setting, regime=Regime())

    def switching(t: Tensor, w: Tensor) -> Tensor:
        return bvp.switching(t, w, free)[..., component]

    def rate(function: Along) -> Along:
        def along(t: Tensor, w: Tensor) -> Tensor:
            by_t, by_w = gradients(function, t, w)
            return by_t[..., 0] + (by_w * bvp.rates(t, w, held)).sum(-1)

        return along

    return rate(rate(switching))(t, w)
