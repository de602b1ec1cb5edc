"""The two manoeuvres whose optimal trajectories the guidance tracks, stated as optimal control problems."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ponn_torch.guidance.plants import quadrotor, shuttle
from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.problem import FreeTime, Named, OptimalControlProblem

THRUST = 6.0, 19.2  # m/s², the paper's margins
TORQUE = -66.7, 66.7  # rad/s²
ATTACK = 0.0, math.radians(40.0)
BANK = math.radians(-1.0), math.radians(90.0)


def _between(limits: tuple[float, float], share: Tensor) -> Tensor:
    return limits[0] + (limits[1] - limits[0]) * share


def quadrotor_controls(u: Named) -> Tensor:
    """Thrust over mass and torque over inertia (..., 2) from shares of their ranges."""
    return torch.cat([_between(THRUST, u.share[..., :1]), _between(TORQUE, u.share[..., 1:])], -1)


def quadrotor_manoeuvre(final_time: float | FreeTime = 5.9) -> OptimalControlProblem:
    """From rest to rest, (0, 0) → (20, 40) m, minimising ½∫uᵀu."""

    def dynamics(t: Tensor, x: Named, u: Named, p: Named) -> dict[str, Tensor]:
        thrust, torque = quadrotor_controls(u).split(1, -1)
        force = torch.cat([thrust * torch.sin(x.angle), thrust * torch.cos(x.angle) - quadrotor.GRAVITY], -1)
        return {"position": x.velocity, "angle": x.spin, "velocity": force, "spin": torque}

    def running_cost(t: Tensor, x: Named, u: Named, p: Named) -> Tensor:
        controls = quadrotor_controls(u)
        return 0.5 * (controls * controls).sum(-1, keepdim=True)

    at_rest = {"angle": 0.0, "velocity": [0.0, 0.0], "spin": 0.0}
    return OptimalControlProblem(
        name="quadrotor_manoeuvre",
        states={"position": 2, "angle": 1, "velocity": 2, "spin": 1},
        control=Box("share", 1.0, 0.0, size=2),
        dynamics=dynamics,
        running_cost=running_cost,
        initial={"position": [0.0, 0.0], **at_rest},
        final={"position": [20.0, 40.0], **at_rest},
        final_time=final_time,
        units={"position": 40.0, "velocity": 10.0, "time": 5.9, "cost": 350.0},
    )


def shuttle_controls(u: Named) -> Tensor:
    """Bank angle and angle of attack (..., 2) in rad from shares of their ranges."""
    return torch.cat([_between(BANK, u.share[..., :1]), _between(ATTACK, u.share[..., 1:])], -1)


def _density(x: Named) -> Tensor:
    return shuttle.DENSITY * torch.exp((shuttle.EARTH_RADIUS - x.r) / shuttle.SCALE_HEIGHT)


def _lift_and_drag(x: Named, attack: Tensor) -> tuple[Tensor, Tensor]:
    """Accelerations in m/s²."""
    pressure = _density(x) * x.V**2 * (shuttle.AREA / (2 * shuttle.MASS))
    lift, drag = shuttle.LIFT, shuttle.DRAG
    return pressure * (lift[0] + lift[1] * attack), pressure * (drag[0] + drag[1] * attack + drag[2] * attack**2)


def shuttle_entry() -> OptimalControlProblem:
    """Entry of the space shuttle with the largest final latitude; heading is measured from east."""

    def dynamics(t: Tensor, x: Named, u: Named, p: Named) -> dict[str, Tensor]:
        bank, attack = shuttle_controls(u).split(1, -1)
        lift, drag = _lift_and_drag(x, attack)
        gravity = shuttle.EARTH_GRAVITY / x.r**2
        ground = x.V * torch.cos(x.gamma) / x.r
        return {
            "r": x.V * torch.sin(x.gamma),
            "longitude": ground * torch.cos(x.psi) / torch.cos(x.latitude),
            "latitude": ground * torch.sin(x.psi),
            "V": -drag - gravity * torch.sin(x.gamma),
            "gamma": lift * torch.cos(bank) / x.V + (x.V / x.r - gravity / x.V) * torch.cos(x.gamma),
            "psi": lift * torch.sin(bank) / (x.V * torch.cos(x.gamma))
            - ground * torch.cos(x.psi) * torch.tan(x.latitude),
        }

    radius = shuttle.EARTH_RADIUS
    return OptimalControlProblem(
        name="shuttle_entry",
        states={"r": 1, "longitude": 1, "latitude": 1, "V": 1, "gamma": 1, "psi": 1},
        control=Box("share", 1.0, 0.0, size=2),
        dynamics=dynamics,
        terminal_cost=lambda t, x, p: -x.latitude,
        initial={
            "r": radius + 79250.0,
            "longitude": 0.0,
            "latitude": 0.0,
            "V": 7800.0,
            "gamma": math.radians(-1.0),
            "psi": 0.0,
        },
        final={"r": radius + 24384.0, "V": 762.0, "gamma": math.radians(-5.0)},
        final_time=FreeTime(2000.0),
        # the height matters, not the radius: 1e5 m is the scale of what changes
        units={"r": 1e5, "V": 7800.0, "gamma": 0.1, "time": 1000.0},
    )


def shuttle_limits(t: Tensor, x: Named, u: Named, p: Named) -> Tensor:
    """Heat rate, dynamic pressure and load (..., 3), each over its limit less one."""
    attack = shuttle_controls(u)[..., 1:]
    heat = shuttle.HEATING * torch.sqrt(_density(x)) * x.V**3.15 / shuttle.MOST_HEAT
    pressure = 0.5 * _density(x) * x.V**2 / shuttle.MOST_PRESSURE
    lift, drag = _lift_and_drag(x, attack)
    load = torch.sqrt(lift * lift + drag * drag) / (shuttle.STANDARD_GRAVITY * shuttle.MOST_LOAD)
    return torch.cat([heat, pressure, load], -1) - 1.0
