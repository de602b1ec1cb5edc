"""Powered descents in closed loop: planned with less thrust than there is, disturbed, flown.

On its last arc an optimal plan uses its whole bound, so a bound below what the engines give leaves the authority that
errors need; what uses it there is a law of last_arc.py. In the last seconds nothing is measured any more: noise,
divided by T², would use up the reserve.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ponn_torch.guidance.last_arc import LAST_ARCS, Engines
from ponn_torch.guidance.replanning import Fleet
from ponn_torch.numerics.runge_kutta import runge_kutta
from ponn_torch.optimal_control.problem import DisplayUnit, Named, OptimalControlProblem, nearest
from ponn_torch.solving.family import Restart
from ponn_torch.solving.solution import Solution


@dataclass(frozen=True, eq=False)
class PoweredDescent:
    """A lander with its engines' bounds, the problem that plans are solutions of, and where a fleet of it starts.

    lander, planned: the same fuel-optimal problem, planned with a lower bound of the thrust. dispersion: half-widths
    (7,) of uniform errors of the initial state.

    Raises ValueError for other states than r, v, m and a fixed final time.
    """

    lander: OptimalControlProblem
    planned: OptimalControlProblem
    dispersion: Tensor

    def __post_init__(self) -> None:
        for problem in (self.lander, self.planned):
            if problem.states != {"r": 3, "v": 3, "m": 1} or not problem.free_final_time:
                raise ValueError(
                    f"problem {problem.name!r} has states {dict(problem.states)}; allowed: r (3), v (3), m (1) with a "
                    "free final time"
                )

    @property
    def name(self) -> str:
        return self.lander.name

    @property
    def description(self) -> str:
        return self.lander.description

    @property
    def displayed(self) -> dict[str, DisplayUnit]:
        """Component → unit of a flight's table: time, states, thrust."""
        labels = {"t": "s"} | {f"r{i}": "m" for i in (1, 2, 3)} | {f"v{i}": "m/s" for i in (1, 2, 3)} | {"m": "kg"}
        labels |= {f"thrust{i}": "N" for i in (1, 2, 3)}
        return {name: DisplayUnit(label) for name, label in labels.items()}

    @property
    def thrust_bounds(self) -> tuple[float, float]:
        """Of the engines, N."""
        low, high = (float(self.lander.parameters[name]) for name in ("minimum_thrust", "maximum_thrust"))
        return low, high

    @property
    def margin(self) -> float:
        """Share of the maximum thrust that plans leave alone."""
        return 1.0 - float(self.planned.parameters["maximum_thrust"]) / self.thrust_bounds[1]

    @property
    def initial(self) -> Tensor:
        """(7,)."""
        return torch.tensor(self.lander.boundary("initial"), dtype=torch.float64)


@dataclass(frozen=True)
class Replanning:
    """How a descent is flown, and what it meets.

    cycle: s between plans. step: s between measurements, and of the integration. blind: s at the end without one.
    gain: share of a measurement that the estimate of position and velocity takes over; the rest is dead reckoning.
    last_arc: one of LAST_ARCS. deadline: s that the plan of one lander may take; a later one is dropped.
    position_noise, velocity_noise: standard deviations of a measurement. thrust_error: half-width of what the engines
    give more or less than commanded, constant over a flight; the mass flow errs with it.

    Raises ValueError for a setting that is out of its range.
    """

    cycle: float = 1.0
    step: float = 0.1
    blind: float = 2.0
    gain: float = 0.2
    last_arc: str = "linear_acceleration"
    deadline: float | None = None
    position_noise: float = 0.1
    velocity_noise: float = 0.02
    thrust_error: float = 0.02

    def __post_init__(self) -> None:
        for name in ("cycle", "step"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} = {getattr(self, name)} s; allowed: above 0")
        if not 0 < self.gain <= 1:
            raise ValueError(f"gain = {self.gain}; allowed: above 0, at most 1")
        if self.last_arc not in LAST_ARCS:
            raise ValueError(f"last_arc = {self.last_arc!r}; {nearest(self.last_arc, LAST_ARCS)}")
        if self.deadline is not None and not self.deadline > 0:
            raise ValueError(f"deadline = {self.deadline} s; allowed: above 0, or null for none")
        for name in ("blind", "position_noise", "velocity_noise", "thrust_error"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} = {getattr(self, name)}; allowed: at least 0")


@dataclass(frozen=True, eq=False)
class Landing:
    """What B landers flew, SI.

    times (S + 1,), states (S + 1, B, 7): at every step. commands (S, B, 3): thrust at the steps' starts; engines give
    factors (B,) of it. starts (C,): steps at which cycles begin. estimates (C, B, 7): what plans were made from.
    planned (C, B): who was planned for. seconds (C,): wall time of a cycle's plans. arrival (B,): s. n_plans, n_kept,
    n_repaired, n_late (B,): cycles with a new plan, with the last one kept because none was found, with arcs found
    anew, with one that came too late. completed: False where the loop was interrupted, with what was flown until then.
    """

    problem: PoweredDescent
    times: Tensor
    states: Tensor
    commands: Tensor
    factors: Tensor
    starts: Tensor
    estimates: Tensor
    planned: Tensor
    seconds: Tensor
    arrival: Tensor
    n_plans: Tensor
    n_kept: Tensor
    n_repaired: Tensor
    n_late: Tensor
    completed: bool = True

    def __len__(self) -> int:
        """Landers."""
        return len(self.factors)

    @property
    def alone(self) -> bool:
        """Whether there is one lander."""
        return len(self) == 1

    @property
    def n_cycles(self) -> int:
        return len(self.starts)

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

    @cached_property
    def thrust(self) -> Tensor:
        """Commanded, N (S, B); not a number after arrival."""
        flying = self.times[:-1, None] < self.arrival - 1e-9
        return torch.where(flying, self.commands.norm(dim=-1), torch.nan)

    @property
    def seconds_per_plan(self) -> Tensor:
        """Wall time of a plan in its batch, one entry per plan."""
        count = self.planned.sum(-1)
        return (self.seconds / count.clamp_min(1)).repeat_interleave(count)

    @property
    def rows(self) -> Tensor:
        """Time, state and command of one lander at every step, (S, 11): columns as in ``displayed``."""
        return torch.cat([self.times[:-1, None], self.states[:-1, 0], self.commands[:, 0]], -1)


def dispersed(
    descent: PoweredDescent, how: Replanning, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Starting states (B, 7) and thrust factors (B,) of a fleet."""
    unit = 2 * torch.rand(count, 8, generator=generator, dtype=torch.float64) - 1
    return descent.initial + descent.dispersion * unit[:, :7], 1.0 + how.thrust_error * unit[:, 7]


class _Lander:
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
    descent: PoweredDescent,
    planned: Solution,
    states: Tensor,
    factors: Tensor,
    *,
    how: Replanning | None = None,
    restart: Restart | None = None,
    generator: torch.Generator | None = None,
    on_cycle: Callable[[Mapping[str, Any]], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Landing:
    """Fly landers from ``states`` (B, 7) with engines that give ``factors`` (B,) of what is commanded.

    planned: the solution of ``descent.planned``. generator: of the measurement noise. on_cycle: called after each
    cycle. An interrupt (Ctrl-C) ends the loop; what was flown is returned.
    """
    how = how or Replanning()
    lander, fleet = _Lander(descent.lander), Fleet(planned, states, restart)
    law = LAST_ARCS[how.last_arc](len(states), Engines(lander.gravity, *descent.thrust_bounds))
    deviations = torch.tensor([how.position_noise] * 3 + [how.velocity_noise] * 3 + [0.0], dtype=torch.float64)
    gain = torch.tensor([how.gain] * 6 + [1.0], dtype=torch.float64)
    fractions = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)

    def measure(x: Tensor) -> Tensor:
        return x + deviations * torch.randn(x.shape, generator=generator, dtype=torch.float64)

    x, t, estimate = states, 0.0, measure(states)
    times, flown = [t], [x]
    commands: list[Tensor] = []
    cycles: list[tuple[int, Tensor, Tensor, float]] = []  # first step, estimate, who is planned for, seconds
    n_late = torch.zeros(len(states), dtype=torch.long)
    completed = True
    try:
        while bool((fleet.arrival > t + 1e-9).any()):
            ahead = fleet.switches_ahead(t) > 0
            members, before, began = ahead.nonzero()[:, 0].tolist(), list(fleet.plans), clock()
            if members:
                fleet.plan(members, estimate[members], t)
            took = clock() - began
            late = bool(members) and how.deadline is not None and took > how.deadline * len(members)
            if late:
                fleet.return_to(before, members)
                n_late[members] += 1
            cycles.append((len(commands), estimate, ahead, took))
            for _ in range(round(how.cycle / how.step)):
                left = fleet.arrival - t
                h = left.clamp(0.0, how.step)[:, None]
                law.measured(estimate, t, left, (left > how.blind) | (t == 0.0))
                at, planning = t + h * fractions, (fleet.switches_ahead(t) > 0)[:, None, None]
                thrust = law.thrust(fleet, at, estimate[:, 6:])
                if bool(planning.any()):
                    thrust = torch.where(planning, fleet.thrust(at), thrust)
                law.flown(h, thrust, estimate[:, 6:])
                x = lander.fly(x, thrust, h, factors[:, None])
                expected = lander.fly(estimate, thrust, h, law.factor)
                estimate = expected + gain * (measure(x) - expected)
                t += how.step
                times.append(t)
                flown.append(x)
                commands.append(thrust[:, 0])
            if on_cycle is not None:
                on_cycle(_record(len(cycles) - 1, t, x, commands[cycles[-1][0]], fleet, took, late))
    except KeyboardInterrupt:
        completed = False
    starts, estimates, who, seconds = zip(*cycles, strict=True) if cycles else ((), (), (), ())
    return Landing(
        descent,
        torch.tensor(times[: len(commands) + 1], dtype=torch.float64),
        torch.stack(flown[: len(commands) + 1]),
        torch.stack(commands) if commands else states.new_zeros(0, len(states), 3),
        factors,
        torch.tensor(starts, dtype=torch.long),
        torch.stack(estimates) if estimates else states.new_zeros(0, *states.shape),
        torch.stack(who) if who else torch.zeros(0, len(states), dtype=torch.bool),
        torch.tensor(seconds, dtype=torch.float64),
        fleet.arrival,
        fleet.n_plans,
        fleet.n_kept,
        fleet.n_repaired,
        n_late,
        completed,
    )


def _record(
    cycle: int, t: float, x: Tensor, command: Tensor, fleet: Fleet, seconds: float, late: bool
) -> dict[str, Any]:
    """Plain numbers at the end of a cycle, distances and speeds the largest of the fleet."""
    return {
        "cycle": cycle,
        "time": t,
        "error": {"distance": float(x[:, :3].norm(dim=-1).max()), "speed": float(x[:, 3:6].norm(dim=-1).max())},
        "control": {"thrust": float(command[0].norm())},
        "arrival": float(fleet.arrival[0]),
        "plans": {"new": int(fleet.n_plans.sum()), "repaired": int(fleet.n_repaired.sum())},
        "kept": int(fleet.n_kept.sum()),
        "seconds": seconds,
        "late": late,
    }


def n_cycles(descent: PoweredDescent, how: Replanning) -> int:
    """About how many there will be: the final time is free."""
    return math.ceil(descent.planned.time_guess / how.cycle)
