"""Rendezvous on a circular orbit by the Clohessy–Wiltshire equations, [3, §5.1]."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ponn_torch.guidance.integral import with_integral
from ponn_torch.guidance.tracking import Dynamics, Plant, Setpoint, TrackingProblem, deviations
from ponn_torch.optimal_control.problem import DisplayUnit

EARTH_GRAVITY = 3.986004418e14  # m³/s²


def clohessy_wiltshire(
    semi_major_axis: float = 7500e3,
    initial_position: Sequence[float] = (7047.0, 5136.0, 5013.0),
    initial_velocity: Sequence[float] = (2.4, 13.7, 4.08),
    position_weight: float = 1e4,
    velocity_weight: float = 1e2,
    control_weight: float = 1.0,
    terminal_weight: float = 1.0,
    horizon: float = 150.0,
    cycle: float = 10.0,
    final_time: float = 2000.0,
    position_error: float = 500.0,
    velocity_error: float = 1.0,
    integral_weight: float = 0.0,
    flown: Mapping[str, Any] | None = None,
) -> TrackingProblem:
    """Bring a deputy to its chief and hold it there: positions in m, velocities in m/s, times in s, axes radial,
    along track, cross track. Lengths are scaled by the semi-major axis, times by the mean motion; weights are those
    of the scaled problem. *_error: half-widths of a Monte Carlo's initial errors around the initial state.
    integral_weight: of the summed up position errors, 0 for none. flown: what the true deputy has and the model does
    not, ``thrust`` (a factor of what is commanded) and ``disturbance`` (a constant acceleration, m/s²).
    """
    mean_motion = math.sqrt(EARTH_GRAVITY / semi_major_axis**3)
    speed = semi_major_axis * mean_motion

    def dynamics(t: Tensor, x: Tensor, u: Tensor) -> Tensor:
        radial, _, cross, vr, va, vc = x.unbind(-1)
        ar, aa, ac = u.unbind(-1)
        return torch.stack([vr, va, vc, 3.0 * radial + 2.0 * va + ar, -2.0 * vr + aa, -cross + ac], -1)

    def disturbed(thrust: float, disturbance: Sequence[float]) -> Dynamics:
        push = torch.tensor(disturbance, dtype=torch.float64) / (speed * mean_motion)
        return lambda t, x, u: dynamics(t, x, thrust * u + push)

    length = {name: DisplayUnit("m", 1.0 / semi_major_axis) for name in ("r1", "r2", "r3")}
    rate = {name: DisplayUnit("m/s", 1.0 / speed) for name in ("v1", "v2", "v3")}
    force = {name: DisplayUnit("m/s²", 1.0 / (speed * mean_motion)) for name in ("a1", "a2", "a3")}
    plant = Plant("clohessy_wiltshire", dynamics, length | rate, force, DisplayUnit("s", mean_motion), linear=True)

    def scaled(position: Sequence[float], velocity: Sequence[float]) -> Tensor:
        values = [r / semi_major_axis for r in position] + [v / speed for v in velocity]
        return torch.tensor(values, dtype=torch.float64)

    weights = torch.tensor([position_weight] * 3 + [velocity_weight] * 3, dtype=torch.float64)
    price = torch.full((3,), control_weight, dtype=torch.float64)
    given = deviations(flown, thrust=1.0, disturbance=[0.0, 0.0, 0.0])
    problem = TrackingProblem(
        plant,
        Setpoint(torch.zeros(6, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)),
        torch.diag(weights),
        lambda t: price.expand(*t.shape, -1),
        initial=scaled(initial_position, initial_velocity),
        horizon=horizon * mean_motion,
        cycle=cycle * mean_motion,
        final_time=final_time * mean_motion,
        terminal_weight=terminal_weight * torch.eye(6, dtype=torch.float64),
        dispersion=scaled([position_error] * 3, [velocity_error] * 3),
        description="Rendezvous with a target on a circular orbit",
        flown=None if given is None else replace(plant, dynamics=disturbed(**given)),
    )
    return with_integral(problem, list(length), integral_weight) if integral_weight else problem
