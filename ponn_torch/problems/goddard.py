"""Goddard's rocket: the greatest altitude of a vertical ascent through an atmosphere."""

from __future__ import annotations

import torch

from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.problem import FreeTime, Named, OptimalControlProblem
from ponn_torch.optimal_control.regularisers import make_regulariser
from ponn_torch.problems.arguments import check_positive
from ponn_torch.problems.known import known_optimum

OPTIMA: list[tuple[dict[str, object], float]] = [({}, -0.0128369183175)]


def goddard(
    *,
    maximum_thrust: float = 3.5,
    exhaust_velocity: float = 0.5,
    drag: float = 310.0,
    scale_height: float = 0.002,
    final_mass: float = 0.6,
    regulariser: str = "entropy",
    guess: float = 0.2,
    known_cost: float | None = None,
    name: str = "goddard",
) -> OptimalControlProblem:
    """From rest with mass 1 to ``final_mass``; thrust between zero and its maximum, ``guess`` is of the free time.

    Units are the planet's radius, its gravity at the ground and the initial mass; altitude h is above the ground, and
    the drag is ``drag`` v² exp(−h/scale_height). The data of the COPS test set. Full thrust is followed by a singular
    arc along which m g = (1 + v/exhaust_velocity) drag (Bryson and Ho, section 8.4), and by a coast.
    """
    check_positive(
        maximum_thrust=maximum_thrust,
        exhaust_velocity=exhaust_velocity,
        drag=drag,
        scale_height=scale_height,
        final_mass=final_mass,
        guess=guess,
    )
    if final_mass >= 1.0:
        raise ValueError(f"final_mass = {final_mass}; allowed: below 1, the initial mass")
    if known_cost is None:
        known_cost = known_optimum(goddard, locals(), OPTIMA, ["guess"])

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        resistance = drag * x.v**2 * torch.exp(-x.h / scale_height)
        return {
            "h": x.v,
            "v": (u.thrust - resistance) / x.m - 1.0 / (1.0 + x.h) ** 2,
            "m": -u.thrust / exhaust_velocity,
        }

    height = 5.0 * scale_height
    return OptimalControlProblem(
        name=name,
        description="Goddard's rocket, greatest altitude",
        states={"h": 1, "v": 1, "m": 1},
        control=Box("thrust", maximum_thrust, regulariser=make_regulariser(regulariser)),
        dynamics=dynamics,
        terminal_cost=lambda t, x, p: -x.h,
        initial={"h": 0.0, "v": 0.0, "m": 1.0},
        final={"m": final_mass},
        final_time=FreeTime(guess),
        units={"h": height, "v": 2.0 * height / guess, "m": 1.0, "time": guess, "cost": height},
        mass="m",
        cost_name="minus altitude",
        known_cost=known_cost,
    )
