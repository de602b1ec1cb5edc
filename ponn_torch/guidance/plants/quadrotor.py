"""A planar quadrotor on a point-to-point manoeuvre, [3, §5.2]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ponn_torch.guidance.tracking import Dynamics, PiecewiseReference, Plant, TrackingProblem, deviations
from ponn_torch.optimal_control.problem import DisplayUnit

GRAVITY = 9.81  # m/s²
REFERENCE = Path(__file__).parents[1] / "data" / "quadrotor.npz"


def quadrotor(
    displacement: Sequence[float] = (-10.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    state_weights: Sequence[float] = (500.0, 500.0, 500.0, 10.0, 10.0, 20.0),
    control_weights: Sequence[float] = (700.0, 300.0),
    control_decay: float = 1.5,
    horizon: float = 3.0,
    cycle: float = 0.01,
    lower: Sequence[float] = (2.0, -66.7),
    upper: Sequence[float] = (24.0, 66.7),
    position_error: float = 2.0,
    flown: Mapping[str, Any] | None = None,
) -> TrackingProblem:
    """From rest at the origin to rest at (20, 40) m in 5.9 s, tracked from a displaced start.

    States x, z (m), θ (rad) and rates; controls are thrust over mass (m/s²) and torque over inertia (rad/s²), priced
    by control_weights · exp(−control_decay t), so that they stay near the reference's at first. lower, upper: what the
    rotors reach (Tmin/m … Tmax/m); the reference itself keeps the paper's margins, 6 … 19.2. position_error: half-width
    of a Monte Carlo's initial errors. flown: what the true rotors give of a command, ``thrust`` and ``torque``
    (factors), and what else moves it, ``drag`` (1/s, of the velocity) and ``disturbance`` (a constant acceleration,
    m/s²).
    """
    reference = PiecewiseReference.load(REFERENCE)

    def dynamics(t: Tensor, x: Tensor, u: Tensor) -> Tensor:
        _, _, angle, vx, vz, spin = x.unbind(-1)
        thrust, torque = u.unbind(-1)
        return torch.stack([vx, vz, spin, thrust * angle.sin(), thrust * angle.cos() - GRAVITY, torque], -1)

    def disturbed(thrust: float, torque: float, drag: float, disturbance: Sequence[float]) -> Dynamics:
        factors = torch.tensor([thrust, torque], dtype=torch.float64)
        push = torch.tensor([0.0, 0.0, 0.0, *disturbance, 0.0], dtype=torch.float64)
        slowing = torch.tensor([0.0, 0.0, 0.0, drag, drag, 0.0], dtype=torch.float64)
        return lambda t, x, u: dynamics(t, x, factors * u) + push - slowing * x

    metre, rate = DisplayUnit("m"), DisplayUnit("m/s")
    states = {
        "x": metre,
        "z": metre,
        "theta": DisplayUnit("rad"),
        "vx": rate,
        "vz": rate,
        "omega": DisplayUnit("rad/s"),
    }
    controls = {"thrust": DisplayUnit("m/s²"), "torque": DisplayUnit("rad/s²")}
    plant = Plant("quadrotor", dynamics, states, controls, lower=lower, upper=upper)
    price = torch.tensor(control_weights, dtype=torch.float64)
    start = reference.states[0] + torch.tensor(displacement, dtype=torch.float64)
    given = deviations(flown, thrust=1.0, torque=1.0, drag=0.0, disturbance=[0.0, 0.0])
    return TrackingProblem(
        plant,
        reference,
        torch.diag(torch.tensor(state_weights, dtype=torch.float64)),
        lambda t: price * torch.exp(-control_decay * t).unsqueeze(-1),
        initial=start,
        horizon=horizon,
        cycle=cycle,
        final_time=reference.final_time,
        dispersion=torch.tensor([position_error, position_error, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64),
        description="Point-to-point manoeuvre of a planar quadrotor",
        flown=None if given is None else replace(plant, dynamics=disturbed(**given)),
    )
