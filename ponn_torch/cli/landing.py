"""A powered descent flown in closed loop, its plans made anew every cycle, and a fleet of dispersed landers besides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch

from ponn_torch.cli.job import DONE, INTERRUPTED, NOT_CERTIFIED, Outcome
from ponn_torch.cli.mission import FLEET, FLIGHT, Common, Settings
from ponn_torch.guidance.descent import Landing, PoweredDescent, Replanning, dispersed, land, n_cycles
from ponn_torch.guidance.storage import save_flight
from ponn_torch.guidance.touchdown import LandingCertificate, Limits, certify_landing
from ponn_torch.reporting.flight_report import landing_sections, write_flight_report
from ponn_torch.reporting.flights import FlightRecorder
from ponn_torch.reporting.landing_figures import landing_figures
from ponn_torch.settings import call
from ponn_torch.solving.solver import Solver


@dataclass
class Descent:
    """A nominal landing, its certificate, and a Monte Carlo where one is asked for.

    reference, arguments: what makes the problem again.
    """

    groups: ClassVar[Sequence[str]] = ("problem", "replanning", "record")

    common: Common
    problem: PoweredDescent
    reference: str
    arguments: Mapping[str, Any]
    how: Replanning
    n_vehicles: int
    n_samples: int
    allowed: Limits
    flight: Landing | None = field(default=None, init=False)
    fleet: Landing | None = field(default=None, init=False)
    certificate: LandingCertificate | None = field(default=None, init=False)

    @classmethod
    def build(cls, values: Mapping[str, Any]) -> Descent:
        """Build all objects of a flight.

        Raises:
            ConfigError: a misspelt, missing or impossible setting.
        """
        settings = Settings.of(values)
        settings.value("kind", str)
        common = settings.common(dict(values))
        problem, reference, arguments = settings.plant(PoweredDescent)
        made = cls(
            common,
            problem,
            reference,
            arguments,
            call(Replanning, settings.group("replanning"), "replanning"),
            settings.value("n_vehicles", int, 0),
            settings.value("n_samples", int, 1),
            call(Limits, settings.group("allowed"), "allowed"),
        )
        settings.node.pop("name", None)
        settings.nothing_left()
        return made

    @property
    def n_cycles(self) -> int:
        return n_cycles(self.problem, self.how)

    @property
    def time_label(self) -> str:
        return "s"

    def fly(self, recorder: FlightRecorder) -> Outcome:
        problem, seed = self.problem, self.common.seed
        planned = Solver().solve(problem.planned, seed)
        best = Solver().solve(problem.lander, seed) if problem.margin else planned
        if not planned.certified or planned.solution is None:
            return Outcome(NOT_CERTIFIED, f"there is no plan to begin with: {planned.message}")
        optimum = best.solution.cost if best.solution is not None and best.certified else float("nan")
        fuels = {"planned": planned.solution.cost, "optimal": optimum}
        self.flight = land(
            problem,
            planned.solution,
            problem.initial[None],
            torch.ones(1, dtype=torch.float64),
            how=self.how,
            generator=self.common.generator(0),
            on_cycle=recorder.cycle,
        )
        if self.flight.completed and self.n_vehicles:
            states, factors = dispersed(problem, self.how, self.n_vehicles, self.common.generator(1))
            how = replace(self.how, deadline=None)  # their plans are made together
            self.fleet = land(problem, planned.solution, states, factors, how=how, generator=self.common.generator(2))
        if not self.flight.completed or (self.fleet is not None and not self.fleet.completed):
            recorder.failed("interrupted")
            return Outcome(INTERRUPTED, f"interrupted after {self.flight.n_cycles} cycles; what was flown is kept")
        self.certificate = certify_landing(
            self.flight, fuels, self.fleet, n_samples=self.n_samples, allowed=self.allowed
        )
        recorder.certificate(self.certificate)
        if self.fleet is not None:
            recorder.monte_carlo(_summary(self.fleet, self.certificate))
        return Outcome(DONE if self.certificate.certified else NOT_CERTIFIED, self.certificate.verdict)

    def completed(self, outcome: Outcome) -> Outcome:
        flight = self.flight
        if flight is None or not flight.n_cycles:
            return outcome
        return replace(
            outcome,
            certified=self.certificate is not None and self.certificate.certified,
            cost=float(flight.fuel[0]),
            final_time=float(flight.arrival[0]),
        )

    def keep(self, folder: Path, outcome: Outcome) -> None:
        for name, flown in ((FLIGHT, self.flight), (FLEET, self.fleet)):
            if flown is not None:
                save_flight(flown, folder / name, reference=self.reference, arguments=self.arguments)
        flight = self.flight if self.flight is not None and self.flight.n_cycles else None
        draw = partial(landing_figures, flight, self.fleet, self.allowed, self.how.deadline) if flight else None
        write_flight_report(
            folder,
            title=f"{self.problem.name}: {self.problem.description}",
            certificate=self.certificate,
            sections=landing_sections(flight, self.fleet) if flight else (),
            draw=draw if self.common.recording.figures else None,
            settings=self.common.settings,
            message=outcome.message,
        )

    def screen(self, outcome: Outcome) -> list[str]:
        lines = [self.certificate.to_text(), ""] if self.certificate is not None else []
        flight = self.flight
        if flight is not None and flight.n_cycles:
            lines.append(f"{'end':12}{float(flight.miss[0]):.3g} m, {float(flight.impact[0]):.3g} m/s")
            timing = flight.seconds_per_plan * 1e3
            if len(timing):
                lines.append(f"{'plans':12}median {timing.median():.1f} ms, largest {timing.max():.1f} ms")
            lines.append(f"{'fuel':12}{float(flight.fuel[0]):.10g} kg")
        return lines


def _summary(fleet: Landing, certificate: LandingCertificate) -> dict[str, Any]:
    """Of a Monte Carlo, plain numbers."""
    return {
        "n_vehicles": len(fleet),
        "n_landed": certificate.n_landed,
        "final_errors": {"distance": certificate.largest_miss, "speed": certificate.largest_impact},
        "fuel": {"median": float(fleet.fuel.median()), "most": float(fleet.fuel.max())},
        "plans": {name: int(getattr(fleet, name).sum()) for name in ("n_plans", "n_repaired", "n_kept")},
    }
