"""A tracking problem flown in closed loop: decisions held against an oracle, and a Monte Carlo besides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from matplotlib.figure import Figure

from ponn_torch.cli.job import Outcome
from ponn_torch.cli.mission import Mission, Settings, told
from ponn_torch.guidance.accuracy import Allowed, GuidanceCertificate, certify
from ponn_torch.guidance.closed_loop import Flight, Loop, fly
from ponn_torch.guidance.controllers import Controller, HorizonController, Timetable, gain_schedule, timetable
from ponn_torch.guidance.methods import Method, TunedGaussians
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.reporting.flight_figures import flight_figures
from ponn_torch.reporting.flight_report import tracking_sections
from ponn_torch.reporting.flights import FlightRecorder
from ponn_torch.settings import ConfigError, call, value_of

WORTH_TRACING = 50  # cycles; the trace of derivatives takes about as long as it saves in so many


@dataclass
class Tracking(Mission[TrackingProblem, Flight, GuidanceCertificate]):
    """A reference that is followed; each control is the start of a horizon's."""

    groups: ClassVar[Sequence[str]] = ("problem", "method", "passes", "loop", "record")

    table: Timetable
    method: Method
    passes: Passes
    loop: Loop
    schedule: bool
    allowed: Allowed
    summary: dict[str, Any] = field(default_factory=dict, init=False)

    @classmethod
    def build(cls, values: Mapping[str, Any]) -> Tracking:
        """Build all objects of a flight; what does not go together is told here.

        Raises:
            ConfigError: a misspelt, missing or impossible setting.
        """
        settings = Settings(values)
        common = settings.common()
        schedule, ending = settings.value("schedule", bool), settings.value("ending", str)
        n_vehicles, n_samples = settings.value("n_vehicles", int, 0), settings.value("n_samples", int, 1)
        errors = settings.value("control_error", float), settings.value("iteration_error", float)
        problem, reference, arguments = settings.plant(TrackingProblem, ("ending", "control_error"))
        passes = call(Passes, settings.group("passes", ("control_error",)), "passes")
        loop = _in_plant_units(call(Loop, settings.group("loop"), "loop"), problem)
        method_node = settings.group("method")
        method = value_of(method_node, Method, "method")
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
            n_vehicles,
            n_samples,
            told("", lambda: timetable(problem, ending)),
            method,
            passes,
            loop,
            schedule,
            told("", lambda: Allowed(*errors)),
        )

    @property
    def n_cycles(self) -> int:
        return len(self.table.starts)

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
            return self.interrupted(self.flight, recorder)
        checker = Planner(problem, solver, self.passes)
        certificate = certify(self.flight, checker, self.table, n_samples=self.n_samples, allowed=self.allowed)
        outcome = self.judged(certificate, recorder)
        if self.n_vehicles:
            self.fleet = self._dispersed(planner)
            if not self.fleet.completed:
                return self.interrupted(self.fleet, recorder)
            self.summary = _summary(self.fleet)
            recorder.monte_carlo(self.summary)
        return outcome

    def _dispersed(self, planner: Planner) -> Flight:
        """Fly all vehicles at once, by a schedule where one is exact."""
        problem = self.problem
        controller: Controller = HorizonController(planner, self.table)
        if planner.affine:
            controller = gain_schedule(planner, self.table, with_loss=False)
        starts = problem.disperse(self.n_vehicles, self.common.generator(1))
        loop = replace(self.loop, deadline=None)  # one decision for all of them
        return fly(problem, controller, self.table, starts, loop, generator=self.common.generator(2))

    def result(self, flight: Flight) -> tuple[float, float]:
        return float(flight.cost), float(flight.times[-1]) / self.problem.plant.time.size

    def sections(self, flight: Flight) -> list[str]:
        return tracking_sections(flight, self.summary)

    def figures(self, flight: Flight) -> Mapping[str, Figure]:
        return flight_figures(flight, self.certificate, self.fleet, self.loop.deadline)

    def lines(self, flight: Flight) -> list[str]:
        last, states, timing = flight.errors[-1].tolist(), self.problem.plant.states.items(), flight.seconds * 1e3
        errors = (f"{name} {e / unit.size:+.3g} {unit.label}" for (name, unit), e in zip(states, last, strict=True))
        lines = [
            f"{'end':12}{', '.join(errors)}",
            f"{'decisions':12}median {timing.median():.3f} ms, largest {timing.max():.3f} ms",
            f"{'cost':12}{float(flight.cost):.10g}",
        ]
        if self.summary:
            worst = ", ".join(f"|{name}| ≤ {value:.3g}" for name, value in self.summary["final_errors"].items())
            lines.append(f"{'Monte Carlo':12}{self.summary['n_vehicles']} vehicles, at the end {worst}")
        return lines


def _summary(fleet: Flight) -> dict[str, Any]:
    """Of a Monte Carlo, plain numbers."""
    last, states = fleet.errors[-1].abs().amax(0).tolist(), fleet.problem.plant.states.items()
    return {
        "n_vehicles": fleet.states.shape[1],
        "final_errors": {name: value / unit.size for (name, unit), value in zip(states, last, strict=True)},
        "peaks": {name: float(values.max()) for name, values in fleet.limits().items()},
    }


def _in_plant_units(loop: Loop, problem: TrackingProblem) -> Loop:
    """The noise is given in the units that people read."""
    sizes = [unit.size for unit in problem.plant.states.values()]
    if len(loop.noise) not in (0, len(sizes)):
        raise ConfigError(f"loop.noise = {list(loop.noise)}; allowed: one per state, {', '.join(problem.plant.states)}")
    return replace(loop, noise=[value * size for value, size in zip(loop.noise, sizes, strict=bool(loop.noise))])
