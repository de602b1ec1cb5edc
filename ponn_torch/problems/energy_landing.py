"""Energy-optimal powered descent in constant gravity, time free at a price: the guidance law of D'Souza (1997)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ponn_torch.optimal_control.control_laws import Unconstrained
from ponn_torch.optimal_control.problem import DisplayUnit, FreeTime, Named, OptimalControlProblem
from ponn_torch.problems.arguments import check_positive, check_vectors


def energy_landing(
    *,
    initial_position: Sequence[float] = (-200.0, 100.0, 1500.0),
    initial_velocity: Sequence[float] = (85.0, -50.0, -65.0),
    final_time: float = 40.0,
    free_final_time: bool = True,
    time_price: float = 0.0,
    gravity: float = 3.7114,
    known_cost: float | None = None,
    name: str = "energy_landing",
) -> OptimalControlProblem:
    """Minimise price · tf + ½∫|a|² dt from a state to rest at the origin, SI; a is the thrust acceleration, unbounded.

    ``time_price`` in m²/s³. ``final_time`` is the first guess where it is free. ``known_cost`` None takes the exact
    optimum, whatever the arguments.
    """
    check_vectors(initial_position=initial_position, initial_velocity=initial_velocity)
    check_positive(final_time=final_time)
    if not (time_price >= 0 and gravity >= 0 and time_price + gravity > 0):
        raise ValueError(f"time_price = {time_price}, gravity = {gravity}; allowed: from 0, not both 0")
    if known_cost is None:
        time = best_time(initial_position, initial_velocity, gravity, time_price) if free_final_time else final_time
        known_cost = time_price * time + descent_energy(initial_position, initial_velocity, gravity, time)
    length = max(math.hypot(*initial_position), 1.0)
    speed = length / final_time
    acceleration = max(gravity, 6 * speed / final_time)  # of a flight from rest to rest, at its ends

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        return {"r": x.v, "v": u.acceleration + x.v.new_tensor((0.0, 0.0, -gravity))}

    return OptimalControlProblem(
        name=name,
        description="Powered descent, minimum acceleration energy",
        states={"r": 3, "v": 3},
        control=Unconstrained("acceleration", 3),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: time_price + 0.5 * (u.acceleration**2).sum(-1, keepdim=True),
        initial={"r": list(initial_position), "v": list(initial_velocity)},
        final={"r": [0.0, 0.0, 0.0], "v": [0.0, 0.0, 0.0]},
        final_time=FreeTime(final_time) if free_final_time else final_time,
        units={
            "r": length,
            "v": speed,
            "time": final_time,
            "cost": 5 * acceleration**2 * final_time,
        },  # H(tf) = 0 must not outweigh the ends
        costate_units={"r": acceleration / final_time, "v": acceleration},
        cost_name="energy",
        known_cost=known_cost,
        display={
            "time": DisplayUnit("s"),
            "r": DisplayUnit("m"),
            "v": DisplayUnit("m/s"),
            "cost": DisplayUnit("m²/s³"),
            "acceleration": DisplayUnit("m/s²"),
        },
    )


def descent_energy(position: Sequence[float], velocity: Sequence[float], gravity: float, time: float) -> float:
    """½∫|a|² dt of the cubic that meets the ends in the given time: r̈ = p + q t."""
    total = 0.0
    for r, v, g in zip(position, velocity, (0.0, 0.0, -gravity), strict=True):
        p, q = -4 * v / time - 6 * r / time**2 - g, 6 * v / time**2 + 12 * r / time**3
        total += 0.5 * (p * p * time + p * q * time**2 + q * q * time**3 / 3)
    return total


def best_time(position: Sequence[float], velocity: Sequence[float], gravity: float, time_price: float) -> float:
    """The cheapest root of (price + g²/2) t⁴ − 2 |v|² t² − 12 rᵀv t − 18 |r|² = 0 (D'Souza, eq. 29).

    Raises:
        ValueError: at rest on the target already.
    """
    r, v = torch.tensor([position, velocity], dtype=torch.float64)
    leading = time_price + gravity**2 / 2
    tail = [0.0, -2 * float(v @ v) / leading, -12 * float(r @ v) / leading, -18 * float(r @ r) / leading]
    companion = torch.zeros(4, 4, dtype=torch.float64)
    companion[0] = -torch.tensor(tail, dtype=torch.float64)
    companion[1:, :3] = torch.eye(3, dtype=torch.float64)
    roots = torch.linalg.eigvals(companion)
    times = [float(z.real) for z in roots if abs(float(z.imag)) < 1e-9 * abs(z) and float(z.real) > 0]
    if not times:
        raise ValueError(f"initial_position = {list(position)}: at rest on the target, nothing is left to fly")
    return min(times, key=lambda t: time_price * t + descent_energy(position, velocity, gravity, t))
