"""Powered descents in closed loop: planned with less thrust than there is, disturbed, flown.

On its last arc an optimal plan uses its whole bound, so a bound below what the engines give leaves the authority that
errors need. On that arc, where the plan has no freedom of its own, the thrust is the one that reaches the target at the
planned time with an acceleration linear in time, a(τ) = −6 r/T² − 4 v/T + τ (12 r/T³ + 6 v/T²) for T to go, divided by
what the engines have been seen to give. In the last two seconds nothing is measured any more: noise, divided by T²,
would use up the reserve.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ponn_torch.guidance.replanning import Fleet
from ponn_torch.numerics.runge_kutta import runge_kutta
from ponn_torch.optim.base import Stopwatch
from ponn_torch.optimal_control.problem import Named, OptimalControlProblem
from ponn_torch.solving.family import Restart
from ponn_torch.solving.solution import Solution


@dataclass(frozen=True)
class Disturbances:
    """What a flight meets: uniform within ± of the first three, normal with the deviations of the last two.

    thrust_error: of the thrust, as a factor, constant over a flight; the mass flow errs with it.
    """

    thrust_error: float = 0.02
    position: float = 50.0
    velocity: float = 5.0
    position_noise: float = 0.1
    velocity_noise: float = 0.02


@dataclass(frozen=True)
class Replanning:
    """cycle: s between plans. step: s between measurements, and of the integration. blind: s at the end without one.

    gain: share of a measurement that the estimate of position and velocity takes over; the rest is dead reckoning.
    """

    cycle: float = 1.0
    step: float = 0.1
    blind: float = 2.0
    gain: float = 0.2

    def __post_init__(self) -> None:
        for name in ("cycle", "step"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} = {getattr(self, name)} s; allowed: above 0")
        if not 0 < self.gain <= 1:
            raise ValueError(f"gain = {self.gain}; allowed: above 0, at most 1")
        if self.blind < 0:
            raise ValueError(f"blind = {self.blind} s; allowed: at least 0")


@dataclass(frozen=True, eq=False)
class Descents:
    """What B landers flew, SI.

    times (C+1,), states (C+1, B, 7): at the cycles' starts and the end. arrival (B,): s. n_plans, n_kept, n_repaired
    (B,): cycles with a new plan, with the last one kept because none was found, and with arcs found anew.
    plan_seconds: CPU time of all plans together.
    """

    times: Tensor
    states: Tensor
    arrival: Tensor
    n_plans: Tensor
    n_kept: Tensor
    n_repaired: Tensor
    plan_seconds: float

    @property
    def miss(self) -> Tensor:
        """Distance (B,) from the target, m."""
        return self.states[-1, :, :3].norm(dim=-1)

    @property
    def impact(self) -> Tensor:
        """Speed (B,) at the end, m/s."""
        return self.states[-1, :, 3:6].norm(dim=-1)

    @property
    def fuel(self) -> Tensor:
        """kg (B,)."""
        return self.states[0, :, 6] - self.states[-1, :, 6]


def dispersed(problem: OptimalControlProblem, what: Disturbances, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Starting states (B, 7) and thrust factors (B,) of a fleet."""
    generator = torch.Generator().manual_seed(seed)
    nominal = torch.tensor(problem.boundary("initial"), dtype=torch.float64)
    spread = torch.tensor([what.position] * 3 + [what.velocity] * 3 + [0.0], dtype=torch.float64)
    unit = 2 * torch.rand(count, 8, generator=generator, dtype=torch.float64) - 1
    return nominal + spread * unit[:, :7], 1.0 + what.thrust_error * unit[:, 7]


class _LastArc:
    """Thrust between a measurement and arrival, for B landers; learns what the engines give."""

    def __init__(self, count: int, gravity: Tensor, low: float, high: float) -> None:
        self.gravity, self.low, self.high = gravity, low, high
        self.constant, self.slope = torch.zeros(2, count, 3, dtype=torch.float64)
        self.since = torch.zeros(count, 1, dtype=torch.float64)
        self.commanded = torch.zeros(count, 3, dtype=torch.float64)  # what the commands so far should have given, m/s
        self.first: Tensor | None = None
        self.factor = torch.ones(count, 1, dtype=torch.float64)

    def measured(self, x: Tensor, t: float, left: Tensor, heard: Tensor) -> None:
        """States (B, 7) with times ``left`` (B,) to go, for the landers that still listen (B,)."""
        self.first = x[:, 3:6] if self.first is None else self.first
        given, wanted = x[:, 3:6] - self.first - t * self.gravity, self.commanded
        size = wanted.square().sum(-1, keepdim=True)
        # below 20 m/s the noise of two measurements says as little as the engines' tolerance
        factor = torch.where(size > 400.0, (given * wanted).sum(-1, keepdim=True) / size.clamp_min(1.0), 1.0)
        r, v, T = x[:, :3], x[:, 3:6], left[:, None]
        listening = heard[:, None]
        self.factor = torch.where(listening, factor, self.factor)
        self.constant = torch.where(listening, -6 * r / T**2 - 4 * v / T, self.constant)
        self.slope = torch.where(listening, 12 * r / T**3 + 6 * v / T**2, self.slope)
        self.since = torch.where(listening, t, self.since)

    def command(self, h: Tensor, thrust: Tensor, mass: Tensor) -> None:
        """Take note of a step h (B, 1) under thrust (B, 3, 3) at its beginning, middle and end."""
        self.commanded = self.commanded + h / 6 * (thrust[:, 0] + 4 * thrust[:, 1] + thrust[:, 2]) / mass

    def thrust(self, mass: Tensor, t: Tensor) -> Tensor:
        """N (B, 3) at times (B, 1), within the engines' bounds."""
        wanted = mass * (self.constant + (t - self.since) * self.slope - self.gravity) / self.factor
        size = wanted.norm(dim=-1, keepdim=True)
        return wanted * size.clamp(self.low, self.high) / size.clamp_min(1e-9)


class _Plant:
    """The lander that flies, batched, with engines that give a factor (B, 1) of what is commanded."""

    def __init__(self, problem: OptimalControlProblem) -> None:
        self.problem, self.parameters = problem, Named(**problem.parameters)

    def _rates(self, x: Tensor, thrust: Tensor) -> Tensor:
        u = Named(thrust=thrust, thrust_magnitude=thrust.norm(dim=-1, keepdim=True))
        rates = self.problem.dynamics(torch.zeros_like(x[:, :1]), self.problem.named(x), u, self.parameters)
        return self.problem.stack(rates, x)

    @property
    def gravity(self) -> Tensor:
        """Acceleration (1, 3) without thrust."""
        x = torch.ones(1, 7, dtype=torch.float64)
        return self._rates(x, torch.zeros(1, 3, dtype=torch.float64))[:, 3:6]

    def fly(self, x: Tensor, thrust: Tensor, h: Tensor, factor: Tensor) -> Tensor:
        """One Runge–Kutta step h (B, 1) under thrust (B, 3, 3) at its beginning, middle and end."""
        return runge_kutta(lambda share, x: self._rates(x, factor * thrust[:, int(2 * share)]), x, h)


def land(
    problem: OptimalControlProblem,
    planned: Solution,
    states: Tensor,
    factors: Tensor,
    *,
    how: Replanning | None = None,
    noise: Disturbances | None = None,
    restart: Restart | None = None,
    seed: int = 1,
) -> Descents:
    """Fly landers from ``states`` (B, 7) with engines that give ``factors`` (B,) of what is commanded.

    ``problem`` states the plant with its true bounds, ``planned`` is the solution of the one that is planned with.
    """
    how, noise = how or Replanning(), noise or Disturbances()
    plant, fleet = _Plant(problem), Fleet(planned, states, restart)
    low, high = (float(problem.parameters[name]) for name in ("minimum_thrust", "maximum_thrust"))
    last_arc = _LastArc(len(states), plant.gravity, low, high)
    generator = torch.Generator().manual_seed(seed)
    deviations = torch.tensor([noise.position_noise] * 3 + [noise.velocity_noise] * 3 + [0.0], dtype=torch.float64)
    gain = torch.tensor([how.gain] * 6 + [1.0], dtype=torch.float64)
    fractions = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)

    def measure(x: Tensor) -> Tensor:
        return x + deviations * torch.randn(x.shape, generator=generator, dtype=torch.float64)

    x, t, plan_seconds = states, 0.0, 0.0
    estimate = measure(x)
    times, history = [t], [x]
    while bool((fleet.arrival > t + 1e-9).any()):
        members = (fleet.switches_ahead(t) > 0).nonzero()[:, 0].tolist()
        if members:
            watch = Stopwatch()
            fleet.plan(members, estimate[members], t)
            plan_seconds += watch.seconds
        for _ in range(round(how.cycle / how.step)):
            left = fleet.arrival - t
            h = left.clamp(0.0, how.step)[:, None]
            last_arc.measured(estimate, t, left, (left > how.blind) | (t == 0.0))
            own = last_arc.thrust(estimate[:, 6:], t + h / 2)[:, None]
            thrust = torch.where((fleet.switches_ahead(t) > 0)[:, None, None], fleet.thrust(t + h * fractions), own)
            last_arc.command(h, thrust, estimate[:, 6:])
            x = plant.fly(x, thrust, h, factors[:, None])
            expected = plant.fly(estimate, thrust, h, last_arc.factor)
            estimate = expected + gain * (measure(x) - expected)
            t += how.step
        times.append(t)
        history.append(x)
    return Descents(
        torch.tensor(times, dtype=torch.float64),
        torch.stack(history),
        fleet.arrival,
        fleet.n_plans,
        fleet.n_kept,
        fleet.n_repaired,
        plan_seconds,
    )
