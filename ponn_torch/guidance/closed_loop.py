"""A plant flown under a controller: measured, planned for, held within its actuators' reach, integrated.

The plant that flies need not be the one that the controller plans with, and what the controller sees may be noisy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ponn_torch.guidance.controllers import Controller, Decision, Timetable
from ponn_torch.guidance.producers import Plan
from ponn_torch.guidance.tracking import Plant, TrackingProblem

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Loop:
    """How a loop is closed.

    n_substeps: Runge–Kutta steps a cycle, with the control held. noise: standard deviations of what is measured, one
    per state, in the plant's units, or () for none. deadline: seconds a decision may take; one that comes later, or is
    not finite, is replaced by the last plan's control for that time, or by the reference's where there is no plan.
    saturate: whether the actuators' reach is applied.

    Raises ValueError for fewer than one substep, a deadline that is not positive, a negative deviation.
    """

    n_substeps: int = 2
    noise: Sequence[float] = ()
    deadline: float | None = None
    saturate: bool = True

    def __post_init__(self) -> None:
        if self.n_substeps < 1:
            raise ValueError(f"n_substeps = {self.n_substeps}; allowed: at least 1")
        if self.deadline is not None and not self.deadline > 0:
            raise ValueError(f"deadline = {self.deadline}; allowed: above 0 s, or null for none")
        if any(deviation < 0 for deviation in self.noise):
            raise ValueError(f"noise = {list(self.noise)}; allowed: at least 0 each")


@dataclass(frozen=True, eq=False)
class Flight:
    """What was flown, over C cycles and any batch of vehicles "...", in the plant's units.

    times (C + 1,). states (C + 1, ..., n): true ones. measured (C, ..., n). commands (C, ..., m): as decided; controls
    (C, ..., m): as applied. loss (C, ...). passes (C,). seconds (C,): wall time of each decision. late (C,): whether
    the fallback flew. completed: False where the loop was interrupted, with the cycles flown until then.
    """

    problem: TrackingProblem
    times: Tensor
    states: Tensor
    measured: Tensor
    commands: Tensor
    controls: Tensor
    loss: Tensor
    passes: Tensor
    seconds: Tensor
    late: Tensor
    completed: bool = True

    @property
    def n_cycles(self) -> int:
        return len(self.commands)

    @property
    def alone(self) -> bool:
        """Whether there is one vehicle."""
        return self.states.dim() == 2

    @property
    def rows(self) -> Tensor:
        """Time, state and control of one vehicle at every cycle, (C, 1 + n + m): columns as in ``displayed``."""
        return torch.cat([self.times[:-1, None], self.states[:-1], self.controls], -1)

    @property
    def n_late(self) -> int:
        return int(self.late.sum())

    @property
    def _times(self) -> Tensor:
        """(C + 1, ...) that broadcast to the vehicles."""
        return self.times.view(-1, *[1] * (self.states.dim() - 2))

    @property
    def errors(self) -> Tensor:
        """States less reference, (C + 1, ..., n)."""
        states, _ = self.problem.reference(self._times)
        return self.states - states

    @property
    def cost(self) -> Tensor:
        """(...,): the running cost summed over the cycles by the rectangle rule, as the papers do."""
        running = self.problem.running_cost(self._times[:-1], self.states[:-1], self.controls)
        return running.sum(0) * self.problem.cycle

    @property
    def saturated(self) -> Tensor:
        """Share of cycles in which a control was cut, (...,)."""
        return (self.commands != self.controls).any(-1).to(self.times.dtype).mean(0)

    def limits(self) -> dict[str, Tensor]:
        """The plant's limit functions at the start of each cycle, (C, ...): at most 1 where they are kept."""
        return {name: of(self.states[:-1], self.controls) for name, of in self.problem.flying.limits.items()}


def fly(
    problem: TrackingProblem,
    controller: Controller,
    table: Timetable,
    initial: Tensor,
    loop: Loop | None = None,
    *,
    plant: Plant | None = None,
    generator: torch.Generator | None = None,
    on_cycle: Callable[[Record], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Flight:
    """Fly from states (..., n) through all cycles of a timetable.

    plant: what flies, by default the problem's own. generator: of the measurement noise. on_cycle: called
    after each cycle, outside the time that a deadline limits. An interrupt (Ctrl-C) ends the loop; what was flown is
    returned.

    Raises ValueError for noise that is not one number per state.
    """
    loop, plant = loop or Loop(), plant or problem.flying
    deviations = initial.new_tensor(list(loop.noise))
    if len(deviations) not in (0, problem.plant.n_states):
        raise ValueError(f"noise = {list(loop.noise)}; allowed: one per state, {', '.join(problem.plant.states)}")
    x, last = initial, None
    rows: list[tuple[Tensor, ...]] = []
    passes: list[int] = []
    seconds: list[float] = []
    late: list[bool] = []
    completed = True
    try:
        for cycle, start in enumerate(table.starts):
            seen = x
            if len(deviations):
                seen = x + deviations * torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x)
            began = clock()
            decision = controller.decide(cycle, seen)
            took = clock() - began
            too_late = loop.deadline is not None and took > loop.deadline
            missed = too_late or not bool(decision.control.isfinite().all())
            command = _fallback(problem, decision, last, start, too_late) if missed else decision.control
            if not missed:
                last = decision.plan
            control = plant.saturate(command) if loop.saturate else command
            flown = plant.fly(start, x, control, problem.cycle, loop.n_substeps)
            rows.append((flown, seen, command, control, decision.loss))
            passes.append(decision.passes)
            seconds.append(took)
            late.append(missed)
            if on_cycle is not None:
                on_cycle(_record(problem, cycle, start, x, control, decision, took, missed))
            x = flown
    except KeyboardInterrupt:
        completed = False
    count = len(rows)
    states, measured, commands, controls, loss = (
        [torch.stack(column) for column in zip(*rows, strict=True)] if rows else [initial.new_zeros(0)] * 5
    )
    return Flight(
        problem,
        initial.new_tensor([*table.starts[:count], table.starts[count - 1] + problem.cycle if count else 0.0]),
        torch.cat([initial.unsqueeze(0), states]) if count else initial.unsqueeze(0),
        measured,
        commands,
        controls,
        loss,
        torch.tensor(passes),
        torch.tensor(seconds, dtype=torch.float64),
        torch.tensor(late, dtype=torch.bool),
        completed,
    )


def _fallback(problem: TrackingProblem, decision: Decision, last: Plan | None, start: float, late: bool) -> Tensor:
    """What the last plan in time foresaw for now; a plan that comes too late is not looked at."""
    t = problem.initial.new_tensor([start])
    if last is not None:
        return last.at(t)[2][..., 0, :]
    _, controls = problem.reference(t)
    return controls[0].expand_as(decision.control)


def _record(
    problem: TrackingProblem,
    cycle: int,
    start: float,
    x: Tensor,
    control: Tensor,
    decision: Decision,
    seconds: float,
    late: bool,
) -> Record:
    """Plain numbers of a cycle, the largest over the batch, in the units that people read."""
    states, _ = problem.reference(x.new_tensor(start))
    errors = (x - states).abs().reshape(-1, x.shape[-1]).amax(0).tolist()
    controls = control.reshape(-1, control.shape[-1])[0].tolist()
    plant = problem.plant
    return {
        "cycle": cycle,
        "time": start / plant.time.size,
        "error": {name: e / unit.size for (name, unit), e in zip(plant.states.items(), errors, strict=True)},
        "control": {name: u / unit.size for (name, unit), u in zip(plant.controls.items(), controls, strict=True)},
        "loss": float(decision.loss.max()),
        "passes": decision.passes,
        "seconds": seconds,
        "late": late,
    }
