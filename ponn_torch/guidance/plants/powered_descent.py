"""Fuel-optimal powered descent to Mars in the loop: the lander of the TFC paper, replanned from the flown state."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ponn_torch.guidance.descent import PoweredDescent
from ponn_torch.problems.mars_landing import mars_landing


def powered_descent(
    initial_position: Sequence[float] = (-900.0, 100.0, 1500.0),
    initial_velocity: Sequence[float] = (30.0, -10.0, -70.0),
    initial_mass: float = 1905.0,
    minimum_thrust: float = 4971.81,
    maximum_thrust: float = 13258.18,
    mass_flow_per_thrust: float = 5.0863e-4,
    gravity: float = 3.7114,
    planned_share: float = 0.95,
    final_time: float = 45.0,
    position_error: float = 50.0,
    velocity_error: float = 5.0,
) -> PoweredDescent:
    """To rest at the origin with the least fuel, SI. planned_share: of the maximum thrust, which plans keep to; the
    rest is the margin that errors on the last arc are corrected with. final_time: first guess of the plan's. *_error:
    half-widths of a Monte Carlo's initial errors.

    Raises ValueError for a share that leaves no thrust above the minimum, or is above 1, and for negative errors.
    """
    if not minimum_thrust / maximum_thrust < planned_share <= 1:
        raise ValueError(
            f"planned_share = {planned_share}; allowed: above minimum_thrust / maximum_thrust = "
            f"{minimum_thrust / maximum_thrust:.4g}, at most 1"
        )
    for name, value in (("position_error", position_error), ("velocity_error", velocity_error)):
        if value < 0:
            raise ValueError(f"{name} = {value}; allowed: at least 0")
    lander, planned = (
        mars_landing(
            name="powered_descent",
            initial_position=initial_position,
            initial_velocity=initial_velocity,
            initial_mass=initial_mass,
            minimum_thrust=minimum_thrust,
            maximum_thrust=share * maximum_thrust,
            mass_flow_per_thrust=mass_flow_per_thrust,
            gravity=gravity,
            free_final_time=True,
            final_time=final_time,
        )
        for share in (1.0, planned_share)
    )
    dispersion = torch.tensor([position_error] * 3 + [velocity_error] * 3 + [0.0], dtype=torch.float64)
    return PoweredDescent(lander, planned, dispersion)
