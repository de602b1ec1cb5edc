"""A tracking problem flown in closed loop: decisions held against an oracle, and a Monte Carlo besides."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from ponn_torch.cli.job import DONE, INTERRUPTED, NOT_CERTIFIED, Outcome
from ponn_torch.cli.mission import FLEET, FLIGHT, Common, Settings, told
from ponn_torch.guidance.accuracy import Allowed, GuidanceCertificate, certify
from ponn_torch.guidance.closed_loop import Flight, Loop, fly
from ponn_torch.guidance.controllers import Controller, HorizonController, Timetable, gain_schedule, timetable
from ponn_torch.guidance.methods import Method, TunedGaussians
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.storage import save_flight
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.reporting.flight_figures import flight_figures
from ponn_torch.reporting.flight_report import tracking_sections, write_flight_report
from ponn_torch.reporting.flights import FlightRecorder
from ponn_torch.settings import ConfigError, call, value_of

WORTH_TRACING = 50  # cycles; the trace of derivatives takes about as long as it saves in so many


@dataclass
class Tracking:
    """A nominal flight of a tracking problem, its certificate, and a Monte Carlo where one is asked for.

    reference, arguments: what makes the problem again.
    """

    groups: ClassVar[Sequence[str]] = ("problem", "method", "passes", "loop", "record")

    common: Common
    problem: TrackingProblem
    reference: str
    arguments: Mapping[str, Any]
    table: Timetable
    method: Method
    passes: Passes
    loop: Loop
    schedule: bool
    n_vehicles: int
    n_samples: int
    allowed: Allowed
    flight: Flight | None = field(default=None, init=False)
    dispersed: Flight | None = field(default=None, init=False)
    certificate: GuidanceCertificate | None = field(default=None, init=False)
    summary: dict[str, Any] = field(default_factory=dict, init=False)

    @classmethod
    def build(cls, values: Mapping[str, Any]) -> Tracking:
        """Build all objects of a flight; what does not go together is told here.

        Raises:
            ConfigError: a misspelt, missing or impossible setting.
        """
        settings = Settings.of(values)
        settings.value("kind", str)
        common = settings.common(dict(values))
        schedule, ending = settings.value("schedule", bool), settings.value("ending", str)
        n_vehicles, n_samples = settings.value("n_vehicles", int, 0), settings.value("n_samples", int, 1)
        errors = settings.value("control_error", float), settings.value("iteration_error", float)
        problem, reference, arguments = settings.plant(TrackingProblem, ("ending", "control_error"))
        passes = call(Passes, settings.group("passes", ("control_error",)), "passes")
        loop = _in_plant_units(call(Loop, settings.group("loop"), "loop"), problem)
        method_node = settings.group("method")
        method = value_of(method_node, Method, "method")
        settings.node.pop("name", None)
        settings.nothing_left()
        if schedule and passes.most > 1 and not problem.plant.linear:
            raise ConfigError(f"schedule = true with passes.most = {passes.most}; allowed: 1 pass, or a linear plant")
        if n_vehicles and problem.dispersion is None:
            raise ConfigError(f"n_vehicles = {n_vehicles}; allowed: 0, for {problem.name} has no dispersion")
        if not isinstance(method, TunedGaussians):  # a search takes seconds: it waits until it is needed
            told("method", lambda: method.solver(problem, common.seed), list(method_node))
        return cls(
            common,
            problem,
            reference,
            arguments,
            told("", lambda: timetable(problem, ending)),
            method,
            passes,
            loop,
            schedule,
            n_vehicles,
            n_samples,
            told("", lambda: Allowed(*errors)),
        )

    @property
    def n_cycles(self) -> int:
        return len(self.table.starts)

    @property
    def time_label(self) -> str:
        return self.problem.plant.time.label

    def fly(self, recorder: FlightRecorder) -> Outcome:
        problem, solver = self.problem, self.method.solver(self.problem, self.common.seed)
        planner = Planner(problem, solver, self.passes, traced=self.n_cycles >= WORTH_TRACING)
        controller: Controller = HorizonController(planner, self.table)
        if self.schedule:
            controller = gain_schedule(planner, self.table)
        elif planner.traced:  # now: no decision should wait for that
            planner.plan(self.table.starts[0], problem.initial, self.table.durations[0])
        self.flight = fly(
            problem,
            controller,
            self.table,
            problem.initial,
            self.loop,
            generator=self.common.generator(0),
            on_cycle=recorder.cycle,
        )
        if not self.flight.completed:
            recorder.failed("interrupted")
            return Outcome(INTERRUPTED, f"interrupted after {self.flight.n_cycles} cycles; what was flown is kept")
        checker = Planner(problem, solver, self.passes)
        self.certificate = certify(self.flight, checker, self.table, n_samples=self.n_samples, allowed=self.allowed)
        recorder.certificate(self.certificate)
        if self.n_vehicles:
            self._disperse(planner)
            recorder.monte_carlo(self.summary)
        return Outcome(DONE if self.certificate.certified else NOT_CERTIFIED, self.certificate.verdict)

    def _disperse(self, planner: Planner) -> None:
        """Fly all vehicles at once, by a schedule where one is exact."""
        problem = self.problem
        affine = self.passes.most == 1 or problem.plant.linear
        controller = (
            gain_schedule(planner, self.table, with_loss=False) if affine else HorizonController(planner, self.table)
        )
        starts = problem.disperse(self.n_vehicles, self.common.generator(1))
        loop = replace(self.loop, deadline=None)  # one decision for all of them
        self.dispersed = fly(problem, controller, self.table, starts, loop, generator=self.common.generator(2))
        last = self.dispersed.errors[-1].abs().amax(0).tolist()
        states = problem.plant.states.items()
        self.summary = {
            "n_vehicles": self.n_vehicles,
            "final_errors": {name: value / unit.size for (name, unit), value in zip(states, last, strict=True)},
            "peaks": {name: float(values.max()) for name, values in self.dispersed.limits().items()},
        }

    def completed(self, outcome: Outcome) -> Outcome:
        flight = self.flight
        if flight is None or not flight.n_cycles:
            return outcome
        problem = flight.problem
        running = problem.running_cost(flight.times[:-1], flight.states[:-1], flight.controls)
        return replace(
            outcome,
            certified=self.certificate is not None and self.certificate.certified,
            cost=float(running.sum()) * problem.cycle,
            final_time=float(flight.times[-1]) / problem.plant.time.size,
        )

    def keep(self, folder: Path, outcome: Outcome) -> None:
        for name, flown in ((FLIGHT, self.flight), (FLEET, self.dispersed)):
            if flown is not None:
                save_flight(flown, folder / name, reference=self.reference, arguments=self.arguments)
        flight = self.flight if self.flight is not None and self.flight.n_cycles else None
        draw = partial(flight_figures, flight, self.certificate, self.dispersed, self.loop.deadline) if flight else None
        write_flight_report(
            folder,
            title=f"{self.problem.name}: {self.problem.description}",
            certificate=self.certificate,
            sections=tracking_sections(flight, self.summary) if flight else (),
            draw=draw if self.common.recording.figures else None,
            settings=self.common.settings,
            message=outcome.message,
        )

    def screen(self, outcome: Outcome) -> list[str]:
        lines = [self.certificate.to_text(), ""] if self.certificate is not None else []
        if self.flight is not None and self.flight.n_cycles:
            plant, last = self.flight.problem.plant, self.flight.errors[-1].tolist()
            errors = (f"{n} {e / u.size:+.3g} {u.label}" for (n, u), e in zip(plant.states.items(), last, strict=True))
            lines.append(f"{'end':12}{', '.join(errors)}")
            timing = self.flight.seconds * 1e3
            lines.append(f"{'decisions':12}median {timing.median():.3f} ms, largest {timing.max():.3f} ms")
            lines.append(f"{'cost':12}{outcome.cost if outcome.cost is not None else math.nan:.10g}")
        if self.summary:
            worst = ", ".join(f"|{name}| ≤ {value:.3g}" for name, value in self.summary["final_errors"].items())
            lines.append(f"{'Monte Carlo':12}{self.summary['n_vehicles']} vehicles, at the end {worst}")
        return lines


def _in_plant_units(loop: Loop, problem: TrackingProblem) -> Loop:
    """The noise is given in the units that people read."""
    sizes = [unit.size for unit in problem.plant.states.values()]
    if len(loop.noise) not in (0, len(sizes)):
        raise ConfigError(f"loop.noise = {list(loop.noise)}; allowed: one per state, {', '.join(problem.plant.states)}")
    return replace(loop, noise=[value * size for value, size in zip(loop.noise, sizes, strict=bool(loop.noise))])
