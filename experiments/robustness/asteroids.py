"""Rendezvous with random near-Earth orbits: other ends, thrusts and times than the published transfer's."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.earth_mars import earth_mars

SUN_KM3_S2, AU_KM = 1.32712440018e11, 149.59787e6


def state(
    a: float, e: float, inclination: float, node: float, periapsis: float, anomaly: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Position, km, and velocity, km/s, from Keplerian elements: a in AU, angles in rad, the true anomaly."""
    p = a * AU_KM * (1 - e**2)
    radius, speed = p / (1 + e * math.cos(anomaly)), math.sqrt(SUN_KM3_S2 / p)
    r = radius * np.array([math.cos(anomaly), math.sin(anomaly), 0.0])
    v = speed * np.array([-math.sin(anomaly), e + math.cos(anomaly), 0.0])
    rotation = _about_z(node) @ _about_x(inclination) @ _about_z(periapsis)
    return rotation @ r, rotation @ v


def _about_z(angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _about_x(angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def draw(generator: np.random.Generator) -> tuple[dict[str, float], OptimalControlProblem]:
    """Elements and engine of one case, and the problem: from the Earth's orbit, 1000 kg, 3000 s."""
    turn = 2 * math.pi
    data = {
        "longitude": generator.uniform(0, turn),
        "a_au": generator.uniform(0.85, 1.5),
        "e": generator.uniform(0, 0.3),
        "inclination": generator.uniform(0, math.radians(8)),
        "node": generator.uniform(0, turn),
        "periapsis": generator.uniform(0, turn),
        "anomaly": generator.uniform(0, turn),
        "maximum_thrust": generator.uniform(0.3, 0.8),
        "final_time_days": generator.uniform(400, 800),
    }
    r0, v0 = state(1.0, 0.0167, 0.0, 0.0, math.radians(103), data["longitude"])
    elements = (data[name] for name in ("a_au", "e", "inclination", "node", "periapsis", "anomaly"))
    rf, vf = state(*elements)
    problem = earth_mars(
        initial_position_km=r0.tolist(),
        initial_velocity_km_s=v0.tolist(),
        final_position_km=rf.tolist(),
        final_velocity_km_s=vf.tolist(),
        maximum_thrust=data["maximum_thrust"],
        specific_impulse=3000.0,
        final_time_days=data["final_time_days"],
    )
    return data, problem
