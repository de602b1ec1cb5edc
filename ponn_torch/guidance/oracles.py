"""Answers to hold a horizon's solution against, found by other means.

Matrix exponential and Riccati sweep return the affine relation λ(0) = P x(0) + p that the end condition
λ(T) = S x(T) + s has at the start; SciPy's solve_bvp solves the nonlinear state–costate system.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from torch import Tensor
from torch.func import vjp

from ponn_torch.guidance.expansion import derivatives, expand
from ponn_torch.guidance.producers import Plan
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.numerics.runge_kutta import runge_kutta

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
            relation = runge_kutta(lambda share, x, t=t, h=h: rate(t + share * h, x), relation, h)  # type: ignore[misc]
    return relation[..., :n], relation[..., n]


def minimising_control(problem: TrackingProblem, t: Tensor, x: Tensor, costates: Tensor) -> Tensor:
    """u (..., m) with R (u − ur) + Bᵀ λ = 0, by Newton's method from ur: one step where f is affine in u."""
    n = x.shape[-1]
    _, target = problem.reference(t)
    price, u = problem.control_weight(t), target
    for _ in range(20):
        _, jacobian, curvature = derivatives(problem.plant.dynamics, t, x, u, costates)
        assert curvature is not None
        slope = price * (u - target) + (jacobian[..., n:].mT @ costates.unsqueeze(-1)).squeeze(-1)
        hessian = torch.diag_embed(price) + curvature[..., n:, n:]
        step = torch.linalg.solve(hessian, slope.unsqueeze(-1)).squeeze(-1)
        u = u - step
        if bool((step.abs() <= 1e-13 * (1.0 + u.abs())).all()):
            break
    return u


def nonlinear_control(problem: TrackingProblem, plan: Plan, initial: Tensor, *, tolerance: float = 1e-4) -> Tensor:
    """u (m,) at the start of a plan's horizon by solve_bvp, which the plan only helps to start.

    The default tolerance is that of a residual; the control at the start comes out to about 1e-7 of itself.
    Smaller ones are not reached where a reference is made of pieces. NaN where SciPy does not converge.
    """
    n, terminal = len(initial), problem.terminal_weight

    def rates(t: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.floating]:
        times, both = torch.from_numpy(t), torch.from_numpy(y.T.copy())
        x, costates = both[:, :n], both[:, n:]
        u = minimising_control(problem, times, x, costates)
        rate, pull_back, *_ = vjp(lambda states: problem.plant.dynamics(times, states, u), x)
        states, _ = problem.reference(times)
        costate_rate = -(x - states) @ problem.state_weight - pull_back(costates)[0]
        return torch.cat([rate, costate_rate], -1).numpy().T

    def jacobian(t: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.floating]:
        times, both = torch.from_numpy(t), torch.from_numpy(y.T.copy())
        x, costates = both[:, :n], both[:, n:]
        u = minimising_control(problem, times, x, costates)
        return expand(problem, times, x, u, costates).matrix.movedim(0, -1).numpy()

    end, _ = problem.reference(torch.tensor(plan.end, dtype=torch.float64))
    start = initial.numpy()

    def conditions(first: NDArray[np.floating], last: NDArray[np.floating]) -> NDArray[np.floating]:
        wanted = np.zeros(n) if terminal is None else terminal.numpy() @ (last[:n] - end.numpy())
        return np.concatenate([first[:n] - start, last[n:] - wanted])

    times = torch.linspace(plan.start, plan.end, 40, dtype=torch.float64)
    states, costates, _ = plan.at(times)
    guess = torch.cat([states, costates], -1).numpy().T
    found = solve_bvp(rates, conditions, times.numpy(), guess, fun_jac=jacobian, tol=tolerance, max_nodes=20000)
    if found.status != 0:
        return torch.full((problem.plant.n_controls,), torch.nan, dtype=torch.float64)
    first = torch.from_numpy(found.y[:, 0])
    return minimising_control(problem, times[0], first[:n], first[n:])
