"""Answers to hold a horizon's solution against, found by other means: matrix exponential and Riccati sweep.

Both return the affine relation λ(0) = P x(0) + p that the end condition λ(T) = S x(T) + s has at the start.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

System = Callable[[Tensor], tuple[Tensor, Tensor]]  # t () -> M (..., 2n, 2n), c (..., 2n)


def exponential_gain(
    matrix: Tensor, drift: Tensor, duration: float, terminal_matrix: Tensor, terminal_offset: Tensor
) -> tuple[Tensor, Tensor]:
    """P (n, n) and p (n,) for constant M (2n, 2n) and c (2n,), to round-off.

    The horizon is cut until a piece's ‖M h‖ ≤ 1, and the relation is carried back piece by piece: the exponential
    over the whole horizon would mix growing and decaying modes beyond all digits.
    """
    n = matrix.shape[-1] // 2
    pieces = max(1, math.ceil(float(torch.linalg.matrix_norm(matrix, ord=2)) * duration))
    generator = matrix.new_zeros(2 * n + 1, 2 * n + 1)
    generator[: 2 * n, : 2 * n], generator[: 2 * n, 2 * n] = matrix, drift
    flow = torch.linalg.matrix_exp(generator * (duration / pieces))
    first, second, shift = flow[: 2 * n, :n], flow[: 2 * n, n : 2 * n], flow[: 2 * n, 2 * n]
    gain, offset = terminal_matrix, terminal_offset
    for _ in range(pieces):
        # λ⁺ = P x⁺ + p with x⁺, λ⁺ linear in x, λ at the piece's start
        left = second[n:] - gain @ second[:n]
        right = torch.cat([gain @ first[:n] - first[n:], (gain @ shift[:n] + offset - shift[n:])[:, None]], dim=1)
        relation = torch.linalg.solve(left, right)
        gain, offset = relation[:, :n], relation[:, n]
    return gain, offset


def riccati_sweep(
    system: System, times: Tensor, terminal_matrix: Tensor, terminal_offset: Tensor, *, n_substeps: int = 1
) -> tuple[Tensor, Tensor]:
    """P (..., n, n) and p (..., n) by classical Runge–Kutta backwards over the times (K,), ascending.

    Ṗ = M21 + M22 P − P M11 − P M12 P and ṗ = M22 p + c2 − P (M12 p + c1). With few steps it is the paper's
    backward sweep, which is unstable where they are long; with many an oracle. Not finite where it diverges.
    """
    n = terminal_offset.shape[-1]
    relation = torch.cat([terminal_matrix, terminal_offset.unsqueeze(-1)], dim=-1)

    def rate(t: Tensor, relation: Tensor) -> Tensor:
        matrix, drift = system(t)
        right = matrix[..., :, n:] @ relation  # (..., 2n, n + 1)
        right[..., -1] += drift
        right[..., :n] += matrix[..., :, :n]
        return right[..., n:, :] - relation[..., :n] @ right[..., :n, :]

    for start, end in zip(times[:-1].flip(0), times[1:].flip(0), strict=True):
        h = (start - end) / n_substeps
        for i in range(n_substeps):
            t = end + i * h
            k1 = rate(t, relation)
            k2 = rate(t + h / 2, relation + h / 2 * k1)
            k3 = rate(t + h / 2, relation + h / 2 * k2)
            k4 = rate(t + h, relation + h * k3)
            relation = relation + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return relation[..., :n], relation[..., n]
