"""Integral action: errors of some states, summed up since the start, are to be zero at the end of every horizon.

Under a constant disturbance that the model does not know, tracking comes to rest beside its reference. Let η' = e for
some components of e = x − xr, and price ½ w |η(T)|² in every horizon: plans then make up for what has been summed up,
and rest is possible only at e = 0, whatever the weight. For w → ∞ it is the integral constraint ∫e = −η(t) over the
horizon, with λη as its multiplier. η is a state like any other: plans, schedules and oracles need not know of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ponn_torch.guidance.tracking import Plant, Reference, Setpoint, TrackingProblem
from ponn_torch.optimal_control.problem import DisplayUnit, nearest


@dataclass(frozen=True, eq=False)
class _ZeroIntegrals:
    """A reference with k more states, which are to be zero."""

    reference: Reference
    k: int

    def __call__(self, t: Tensor) -> tuple[Tensor, Tensor]:
        states, controls = self.reference(t)
        return torch.cat([states, states.new_zeros(*states.shape[:-1], self.k)], -1), controls


def with_integral(problem: TrackingProblem, names: Sequence[str], weight: float) -> TrackingProblem:
    """The problem with the integrals of some states' errors as further states, priced ½ weight η² at a horizon's end.

    Raises ValueError for an unknown state, none at all, and a weight that is not positive.
    """
    states = list(problem.plant.states)
    for name in names:
        if name not in states:
            raise ValueError(f"integral of {name!r}; {nearest(name, states)}")
    if not names or not weight > 0:
        raise ValueError(f"integral of {list(names)} with weight {weight}; allowed: some states, a weight above 0")
    at, k = torch.tensor([states.index(name) for name in names]), len(names)
    n, constant = len(states), isinstance(problem.reference, Setpoint)
    clock = problem.plant.time

    def extended(plant: Plant) -> Plant:
        def dynamics(t: Tensor, x: Tensor, u: Tensor) -> Tensor:
            error = x[..., at] - problem.reference(t)[0][..., at]
            return torch.cat([plant.dynamics(t, x[..., :n], u), error], -1)

        units = (plant.states[name] for name in names)
        further = {
            f"int_{name}": DisplayUnit(f"{unit.label} {clock.label}", unit.size * clock.size)
            for name, unit in zip(names, units, strict=True)
        }
        limits = {name: lambda x, u, of=of: of(x[..., :n], u) for name, of in plant.limits.items()}
        return replace(
            plant,
            dynamics=dynamics,
            states=dict(plant.states) | further,
            limits=limits,
            linear=plant.linear and constant,
        )

    def widened(values: Tensor | None) -> Tensor | None:
        return None if values is None else torch.cat([values, values.new_zeros(k)])

    def bordered(matrix: Tensor | None, corner: float) -> Tensor:
        inner = problem.initial.new_zeros(n, n) if matrix is None else matrix
        return torch.block_diag(inner, corner * torch.eye(k, dtype=inner.dtype))

    reference = problem.reference
    if isinstance(reference, Setpoint):
        reference = Setpoint(torch.cat([reference.state, reference.state.new_zeros(k)]), reference.control)
    else:
        reference = _ZeroIntegrals(reference, k)
    return replace(
        problem,
        plant=extended(problem.plant),
        flown=None if problem.flown is None else extended(problem.flown),
        reference=reference,
        state_weight=bordered(problem.state_weight, 0.0),
        terminal_weight=bordered(problem.terminal_weight, weight),
        initial=torch.cat([problem.initial, problem.initial.new_zeros(k)]),
        dispersion=widened(problem.dispersion),
    )
