"""From a tracking problem to the linear boundary value problem around a guess (x̄, ū, λ̄).

H = ½(x − xr)ᵀQ(x − xr) + ½(u − ur)ᵀR(u − ur) + λᵀf. With A = ∂f/∂x, B = ∂f/∂u and C = ∂²(λ̄ᵀf)/∂(x, u)²,

    ẋ = A x + B u + w,    λ̇ = −Q (x − xr) − Aᵀ λ − Cxx (x − x̄) − Cxu (u − ū),
    (R + Cuu) u = R ur + Cuu ū − Bᵀ λ − Cux (x − x̄).

C = 0 is quasi-linearisation, which leaves out what bends the Hamiltonian and so converges linearly; with C it is
Newton's method on states, costates and controls at once. Around the reference, C = 0 and one pass: LQ tracking.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jvp, vjp

from ponn_torch.guidance.tracking import Dynamics, TrackingProblem


@dataclass(frozen=True, eq=False)
class Expansion:
    """y' = matrix y + drift for y = (x, λ), and the control u = control_gain y + control_offset that belongs to it.

    table: (..., 2n + m, 2n + 1), the rows of y' and of u, the constants in the last column.
    """

    table: Tensor

    @property
    def _size(self) -> int:
        return self.table.shape[-1] - 1

    @property
    def matrix(self) -> Tensor:
        return self.table[..., : self._size, :-1]

    @property
    def drift(self) -> Tensor:
        return self.table[..., : self._size, -1]

    @property
    def control_gain(self) -> Tensor:
        return self.table[..., self._size :, :-1]

    @property
    def control_offset(self) -> Tensor:
        return self.table[..., self._size :, -1]

    def control(self, y: Tensor) -> Tensor:
        """u (..., m) for y (..., 2n) at the points of the expansion."""
        return (self.control_gain @ y.unsqueeze(-1)).squeeze(-1) + self.control_offset


def expand(problem: TrackingProblem, t: Tensor, x: Tensor, u: Tensor, costates: Tensor | None = None) -> Expansion:
    """Around the guess at times t (...,); costates for Newton's method, None for quasi-linearisation."""
    return Expansion(table(problem, t, x, u, costates))


def table(problem: TrackingProblem, t: Tensor, x: Tensor, u: Tensor, costates: Tensor | None = None) -> Tensor:
    """The table of an Expansion: a pure function of tensors, fit to be traced."""
    n = x.shape[-1]
    states, controls = problem.reference(t)
    weight, price = problem.state_weight, problem.control_weight(t)  # Q (n, n), diagonal of R (..., m)
    states, target = states.expand_as(x), (price * controls).expand_as(u)
    rate, jacobian, curvature = derivatives(problem.plant.dynamics, t, x, u, costates)
    a, b = jacobian[..., :n], jacobian[..., n:]
    right = torch.cat([torch.zeros_like(b.mT), -b.mT, target.unsqueeze(-1)], -1)
    bend = torch.cat([-weight.expand_as(a), (states @ weight).unsqueeze(-1)], -1)  # of λ' in x and 1; Q is symmetric
    if curvature is None:
        control, costate_push = right / price.unsqueeze(-1), torch.zeros_like(b)
    else:
        xx, xu, uu = curvature[..., :n, :n], curvature[..., :n, n:], curvature[..., n:, n:]
        about = (xu.mT @ x.unsqueeze(-1)) + (uu @ u.unsqueeze(-1))
        right = right + torch.cat([-xu.mT, torch.zeros_like(b.mT), about], -1)
        control = torch.linalg.solve_ex(torch.diag_embed(price) + uu, right).result
        bend = bend + torch.cat([-xx, xx @ x.unsqueeze(-1) + xu @ u.unsqueeze(-1)], -1)
        costate_push = -xu
    rest = rate.unsqueeze(-1) - a @ x.unsqueeze(-1) - b @ u.unsqueeze(-1)
    top = torch.cat([a, torch.zeros_like(a), rest], -1)
    bottom = torch.cat([bend[..., :-1], -a.mT, bend[..., -1:]], -1)
    free = torch.cat([top, bottom], -2) + torch.cat([b, costate_push], -2) @ control
    return torch.cat([free, control], -2)


def derivatives(
    dynamics: Dynamics, t: Tensor, x: Tensor, u: Tensor, costates: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """f (..., n), its Jacobian (..., n, n + m) in (x, u), and with costates C (..., n + m, n + m), else None."""
    n = x.shape[-1]

    def function(v: Tensor) -> Tensor:
        return dynamics(t, v[..., :n], v[..., n:])

    def with_gradient(v: Tensor) -> Tensor:
        value, pull_back, *_ = vjp(function, v)
        return torch.cat([value, *pull_back(costates.expand_as(value))], -1) if costates is not None else value

    value, jacobian = pointwise_jacobian(function if costates is None else with_gradient, torch.cat([x, u], -1))
    curvature = None if costates is None else jacobian[..., n:, :]
    return value[..., :n], jacobian[..., :n, :], curvature


def pointwise_jacobian(function: Callable[[Tensor], Tensor], v: Tensor) -> tuple[Tensor, Tensor]:
    """Values (..., p) and Jacobian (..., p, k) of a pointwise function of v (..., k), by forward mode.

    One evaluation serves all k directions and all points: they are put side by side.
    """
    k = v.shape[-1]
    directions = torch.eye(k, dtype=v.dtype, device=v.device).view(k, *[1] * (v.dim() - 1), k)
    shape = (k, *v.shape)
    value, tangents, *_ = jvp(function, (v.expand(shape).contiguous(),), (directions.expand(shape).contiguous(),))
    return value[0], tangents.movedim(0, -1)
