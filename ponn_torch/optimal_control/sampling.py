"""Samples of an admissible set, which a minimum of the Hamiltonian is held against: always the same ones."""

from __future__ import annotations

import torch
from torch import Tensor

N_SPREAD = 32
SIZES = (20.0, 2.0, 0.3, 0.03, 3e-3, 3e-4)  # of steps; none is 1, which could take a unit vector to zero


def steps(like: Tensor) -> Tensor:
    """Steps (k, ..., m) from points ``like`` (..., m): of several sizes, to both sides, along the axes and across."""
    ways = torch.cat([torch.eye(like.shape[-1]).to(like), 2 * _spread(like, 4) - 1])
    return _at_each(torch.cat([size * torch.cat([ways, -ways]) for size in SIZES]), like)


def fractions(eta: Tensor) -> Tensor:
    """Points (k, ..., m) of the unit cube: first spread over it, then at its corners, then about η (..., m)."""
    inside = _spread(eta, N_SPREAD)
    return torch.cat([_at_each(torch.cat([inside, inside.round()]), eta), (eta + steps(eta)).clamp(0.0, 1.0)])


def ways(like: Tensor) -> Tensor:
    """Unit vectors (2 N_SPREAD, ..., m) spread over the sphere."""
    return unit(_at_each(2 * _spread(like, 2 * N_SPREAD) - 1, like))


def unit(vector: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vector, dim=-1)


def _spread(like: Tensor, n: int) -> Tensor:
    """Points (n, m) spread over the unit cube."""
    return torch.quasirandom.SobolEngine(like.shape[-1], scramble=True, seed=0).draw(n, dtype=like.dtype).to(like)


def _at_each(rows: Tensor, like: Tensor) -> Tensor:
    """Rows (k, m) at every point of ``like`` (..., m)."""
    return rows.view(-1, *(1,) * (like.dim() - 1), rows.shape[-1]).expand(-1, *like.shape)
