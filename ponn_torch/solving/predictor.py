"""Where the next stage of a continuation begins: along the tangent to the solutions, an Euler step in the parameter.

The solutions ξ(s) of r(ξ; s) = 0 have the slope ξ' = −J⁻¹ ∂r/∂s. In the smoothing they are nearly straight: while ρ is
large it is S/ρ that the ends ask for, so that S, and the costates with it, goes as ρ does; once it is small a switch
feels ρ² alone. From the solution before, a Newton step at the new ρ would take tanh(S/ρ) for its tangent and leave the
control's bounds by far.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ponn_torch.optim.base import Residual
from ponn_torch.optim.least_squares import floored

PREDICTORS = ("tangent", "none")
SOLVED = 0.02  # of ‖r‖ at the new value, that may be left at the old one: what is no solution is on no curve of them


def along_tangent(
    residual: Callable[[float], Residual], xi: Tensor, norm: float, here: float, there: float, damping: float
) -> Tensor:
    """ξ (N,) moved from its solution at the value ``here`` towards that at ``there``; as it is where that is no nearer.

    norm: ‖r‖ here. damping: μ of the one step, relative to J's columns.
    """
    share, target = math.sqrt(torch.finfo(xi.dtype).eps), residual(there)
    before = target.residual(xi).norm()
    if not norm <= SOLVED * float(before):
        return xi
    r, jacobian = residual(here).linearise(xi)
    change = (residual(here + share * (there - here)).residual(xi) - r) / share
    moved = xi + jacobian.solve_damped(change, xi.new_tensor(damping), floored(jacobian.column_norms()))
    return moved if bool(target.linearise(moved)[0].norm() < before) else xi  # NaN is no less
