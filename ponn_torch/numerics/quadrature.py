"""Adaptive Gauss quadrature of a vectorised function: panels are halved where two rules differ."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ponn_torch.numerics.nodes import make_nodes


def integrate(
    function: Callable[[Tensor], Tensor],
    edges: Tensor,
    *,
    n_nodes: int = 10,
    tolerance: float = 1e-14,
    n_levels: int = 40,
    most_panels: int = 4096,
) -> float:
    """∫ f dt over the panels between ``edges`` (P+1,), for f (m,) → (m,) called once per level of halving.

    A panel is accepted when Gauss–Legendre on it and on its halves agree to ``tolerance`` of ∫|f|; layers and
    jumps are thereby resolved down to 2^-n_levels of a panel. At ``most_panels`` the rest is accepted.
    """
    rule = make_nodes("legendre_gauss", n_nodes, dtype=edges.dtype, device=edges.device)

    def panels(left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        half = (right - left) / 2
        values = function((left[:, None] + half[:, None] * (rule.points + 1)).flatten()).view(-1, n_nodes)
        return half * (values @ rule.weights), half * (values.abs() @ rule.weights)

    left, right = edges[:-1], edges[1:]
    coarse, size = panels(left, right)
    total, whole, n_panels = 0.0, float(size.sum()), len(left)
    for level in range(n_levels):
        middle = (left + right) / 2
        first, second = panels(torch.cat([left, middle]), torch.cat([middle, right]))[0].chunk(2)
        rough = (first + second - coarse).abs() > tolerance * whole
        n_panels += int(rough.sum())
        if level == n_levels - 1 or n_panels > most_panels:
            rough = torch.zeros_like(rough)
        total += float((first + second)[~rough].sum())
        if not bool(rough.any()):
            break
        left, right = torch.cat([left[rough], middle[rough]]), torch.cat([middle[rough], right[rough]])
        coarse = torch.cat([first[rough], second[rough]])
    return total
