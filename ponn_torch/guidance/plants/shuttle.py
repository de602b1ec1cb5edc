"""Longitudinal entry of the space shuttle along a reference of maximal crossrange, [3, §5.3]."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ponn_torch.guidance.tracking import PiecewiseReference, Plant, TrackingProblem, deviations
from ponn_torch.optimal_control.problem import DisplayUnit

EARTH_GRAVITY, EARTH_RADIUS = 3.986004418e14, 6371004.0  # m³/s², m
AREA, MASS = 249.9092, 92709.0  # m², kg
DENSITY, SCALE_HEIGHT = 1.225, 7254.2  # kg/m³ at sea level, m
LIFT = (-0.2070, 1.6756)  # coefficients of 1, α
DRAG = (0.0785, -0.3529, 2.04)  # of 1, α, α²
HEATING, MOST_HEAT = 1.65e-4, 2e6  # of √ρ V^3.15, W/m²
MOST_PRESSURE, MOST_LOAD, STANDARD_GRAVITY = 2e4, 2.5, 9.81  # Pa, g, m/s²
REFERENCE = Path(__file__).parents[1] / "data" / "shuttle.npz"
DEGREE = math.pi / 180


def shuttle(
    initial_error: Sequence[float] = (300.0, 20.0, 0.05),
    state_weights: Sequence[float] = (1.2e6, 190.0, 0.0),
    control_weights: Sequence[float] = (0.01, 0.04),
    horizon: float = 200.0,
    cycle: float = 1.0,
    largest_error: Sequence[float] = (300.0, 20.0, 0.05),
    flown: Mapping[str, Any] | None = None,
) -> TrackingProblem:
    """Radius, speed and flight-path angle, steered by bank angle and angle of attack.

    Lengths are scaled by the Earth's radius, speeds by √(μ/R); weights are those of the scaled problem. initial_error:
    of the nominal run, in m, m/s and degrees; largest_error: half-widths of a Monte Carlo's. The reference keeps the
    limits on heat rate, dynamic pressure and load, which are reported and not imposed. flown: factors of what
    the model takes for ``density``, ``lift`` and ``drag``.
    """
    speed = math.sqrt(EARTH_GRAVITY / EARTH_RADIUS)
    second = speed / EARTH_RADIUS
    stored = PiecewiseReference.load(REFERENCE)
    scales = torch.tensor([EARTH_RADIUS, speed, 1.0], dtype=torch.float64)
    reference = PiecewiseReference(stored.times * second, stored.states / scales, stored.controls, stored.degree)
    drag_scale = DENSITY * AREA / (2 * MASS) * EARTH_RADIUS

    def plant(density: float = 1.0, lift: float = 1.0, drag: float = 1.0) -> Plant:
        def forces(x: Tensor, attack: Tensor) -> tuple[Tensor, Tensor]:
            """Lift and drag accelerations in units of μ/R²."""
            r, v, _ = x.unbind(-1)
            pressure = density * drag_scale * torch.exp((1 - r) * (EARTH_RADIUS / SCALE_HEIGHT)) * v**2
            lift_share = lift * (LIFT[0] + LIFT[1] * attack)
            drag_share = drag * (DRAG[0] + DRAG[1] * attack + DRAG[2] * attack**2)
            return pressure * lift_share, pressure * drag_share

        def dynamics(t: Tensor, x: Tensor, u: Tensor) -> Tensor:
            r, v, path = x.unbind(-1)
            bank, attack = u.unbind(-1)
            up, back = forces(x, attack)
            turn = up * torch.cos(bank) / v + (v / r - 1 / (r**2 * v)) * torch.cos(path)
            return torch.stack([v * torch.sin(path), -back - torch.sin(path) / r**2, turn], -1)

        def air(x: Tensor) -> Tensor:
            return density * DENSITY * torch.exp((1 - x[..., 0]) * (EARTH_RADIUS / SCALE_HEIGHT))

        def heat_rate(x: Tensor, u: Tensor) -> Tensor:
            return HEATING * air(x).sqrt() * (x[..., 1] * speed) ** 3.15 / MOST_HEAT

        def dynamic_pressure(x: Tensor, u: Tensor) -> Tensor:
            return 0.5 * air(x) * (x[..., 1] * speed) ** 2 / MOST_PRESSURE

        def load(x: Tensor, u: Tensor) -> Tensor:
            return torch.hypot(*forces(x, u[..., 1])) * (speed * second / STANDARD_GRAVITY / MOST_LOAD)

        return Plant(
            "shuttle",
            dynamics,
            {
                "r": DisplayUnit("m", 1 / EARTH_RADIUS),
                "V": DisplayUnit("m/s", 1 / speed),
                "gamma": DisplayUnit("°", DEGREE),
            },
            {"bank": DisplayUnit("°", DEGREE), "attack": DisplayUnit("°", DEGREE)},
            DisplayUnit("s", second),
            limits={"heat rate": heat_rate, "dynamic pressure": dynamic_pressure, "load": load},
        )

    def scaled(errors: Sequence[float]) -> Tensor:
        return torch.tensor(errors, dtype=torch.float64) / scales * torch.tensor([1.0, 1.0, DEGREE]).double()

    price = torch.tensor(control_weights, dtype=torch.float64)
    given = deviations(flown, density=1.0, lift=1.0, drag=1.0)
    return TrackingProblem(
        plant(),
        reference,
        torch.diag(torch.tensor(state_weights, dtype=torch.float64)),
        lambda t: price.expand(*t.shape, -1),
        initial=reference.states[0] + scaled(initial_error),
        horizon=horizon * second,
        cycle=cycle * second,
        final_time=reference.final_time,
        dispersion=scaled(largest_error),
        description="Longitudinal entry of the space shuttle",
        flown=None if given is None else plant(**given),
    )
