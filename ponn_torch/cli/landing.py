"""A powered descent flown in closed loop, its plans made anew every cycle, and a fleet of dispersed landers besides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from matplotlib.figure import Figure

from ponn_torch.cli.job import NOT_CERTIFIED, Outcome
from ponn_torch.cli.mission import Mission, Settings
from ponn_torch.guidance.descent import Landing, PoweredDescent, Replanning, dispersed, land, n_cycles
from ponn_torch.guidance.touchdown import LandingCertificate, Limits, certify_landing
from ponn_torch.reporting.flight_report import landing_sections
from ponn_torch.reporting.flights import FlightRecorder
from ponn_torch.reporting.landing_figures import landing_figures
from ponn_torch.settings import call
from ponn_torch.solving.solver import Solver


@dataclass
class Descent(Mission[PoweredDescent, Landing, LandingCertificate]):
    """Landers whose plans start from where they have been flown to."""

    groups: ClassVar[Sequence[str]] = ("problem", "replanning", "record")

    how: Replanning
    allowed: Limits

    @classmethod
    def build(cls, values: Mapping[str, Any]) -> Descent:
        """Build all objects of a flight.

        Raises:
            ConfigError: a misspelt, missing or impossible setting.
        """
        settings = Settings(values)
        common, plant = settings.common(), settings.plant(PoweredDescent)
        how = call(Replanning, settings.group("replanning"), "replanning")
        n_vehicles, n_samples = settings.value("n_vehicles", int, 0), settings.value("n_samples", int, 1)
        allowed = call(Limits, settings.group("allowed"), "allowed")
        settings.nothing_left()
        return cls(common, *plant, n_vehicles, n_samples, how, allowed)

    @property
    def n_cycles(self) -> int:
        return n_cycles(self.problem, self.how)

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
        for flight in (self.flight, self.fleet):
            if flight is not None and not flight.completed:
                return self.interrupted(flight, recorder)
        certificate = certify_landing(self.flight, fuels, self.fleet, n_samples=self.n_samples, allowed=self.allowed)
        outcome = self.judged(certificate, recorder)
        if self.fleet is not None:
            recorder.monte_carlo(_summary(self.fleet, certificate))
        return outcome

    def result(self, flight: Landing) -> tuple[float, float]:
        return float(flight.fuel[0]), float(flight.arrival[0])

    def sections(self, flight: Landing) -> list[str]:
        return landing_sections(flight, self.fleet)

    def figures(self, flight: Landing) -> Mapping[str, Figure]:
        return landing_figures(flight, self.fleet, self.allowed, self.how.deadline)

    def lines(self, flight: Landing) -> list[str]:
        lines = [f"{'end':12}{float(flight.miss[0]):.3g} m, {float(flight.impact[0]):.3g} m/s"]
        timing = flight.seconds_per_plan * 1e3
        if len(timing):
            lines.append(f"{'plans':12}median {timing.median():.1f} ms, largest {timing.max():.1f} ms")
        return [*lines, f"{'fuel':12}{float(flight.fuel[0]):.10g} kg"]


def _summary(fleet: Landing, certificate: LandingCertificate) -> dict[str, Any]:
    """Of a Monte Carlo, plain numbers."""
    return {
        "n_vehicles": len(fleet),
        "n_landed": certificate.n_landed,
        "final_errors": {"distance": certificate.largest_miss, "speed": certificate.largest_impact},
        "fuel": {"median": float(fleet.fuel.median()), "most": float(fleet.fuel.max())},
        "plans": {name: int(getattr(fleet, name).sum()) for name in ("n_plans", "n_repaired", "n_kept")},
    }
