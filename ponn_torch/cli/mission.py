"""What every kind of flight of ``ponn-rhc`` has in common: a mission, and how its settings are read."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import torch
from matplotlib.figure import Figure

from ponn_torch.cli.job import DONE, INTERRUPTED, NOT_CERTIFIED, Outcome
from ponn_torch.guidance.storage import Flown, Problem, make_problem, save_flight
from ponn_torch.guidance.verdict import FlightCertificate
from ponn_torch.reporting.flight_report import write_flight_report
from ponn_torch.reporting.flights import FlightRecorder
from ponn_torch.settings import ConfigError, arguments_of, call, fit, located, reject_unknown, target

FLIGHT, FLEET = "flight", "monte_carlo"  # folders of what is flown once, and dispersed
PLANTS = ("ponn_torch.guidance.plants",)
P = TypeVar("P", bound=Problem)
F = TypeVar("F", bound=Flown)
C = TypeVar("C", bound=FlightCertificate)


@dataclass(frozen=True)
class FlightRecording:
    """What a run leaves besides its records, flight and certificate."""

    progress: bool = True
    tensorboard: bool = True
    figures: bool = True


@dataclass(frozen=True)
class Common:
    """Of every flight: its settings, resolved; the seed of all that is random; torch's threads; what is recorded."""

    settings: dict[str, Any]
    seed: int
    threads: int
    recording: FlightRecording

    def generator(self, stream: int) -> torch.Generator:
        """Of random numbers that are drawn apart from those of other streams."""
        return torch.Generator().manual_seed(1000 * self.seed + stream)


@dataclass
class Mission(ABC, Generic[P, F, C]):
    """A kind of flight, built of a config: flown, checked, kept. It is flown once.

    reference, arguments: what makes the problem again. flight: the nominal one; fleet: a Monte Carlo of n_vehicles,
    where there are any. n_samples: cycles that are checked.
    """

    groups: ClassVar[Sequence[str]]  # of configs, which tell runs apart

    common: Common
    problem: P
    reference: str
    arguments: Mapping[str, Any]
    n_vehicles: int
    n_samples: int
    flight: F | None = field(default=None, init=False)
    fleet: F | None = field(default=None, init=False)
    certificate: C | None = field(default=None, init=False)

    # -- what a kind is ----------------------------------------------------------------------------

    @property
    @abstractmethod
    def n_cycles(self) -> int:
        """About how many there will be."""

    @abstractmethod
    def fly(self, recorder: FlightRecorder) -> Outcome:
        """Fly and check; what is found stays, also where this ends early."""

    @abstractmethod
    def result(self, flight: F) -> tuple[float, float]:
        """Cost and final time, in the units that people read."""

    @abstractmethod
    def sections(self, flight: F) -> list[str]:
        """Of the report."""

    @abstractmethod
    def figures(self, flight: F) -> Mapping[str, Figure]:
        """Of the report, by name."""

    @abstractmethod
    def lines(self, flight: F) -> list[str]:
        """What a person wants to see at the end, below the certificate."""

    # -- what they share ---------------------------------------------------------------------------

    @property
    def time_label(self) -> str:
        return self.problem.displayed["t"].label

    @property
    def flown(self) -> F | None:
        """The nominal flight; None where it has no cycle."""
        return self.flight if self.flight is not None and self.flight.n_cycles else None

    def interrupted(self, flight: F, recorder: FlightRecorder) -> Outcome:
        """What an interruption of the nominal flight, or of the fleet, leaves."""
        recorder.failed("interrupted")
        of = " of the Monte Carlo" if flight is self.fleet else ""
        return Outcome(INTERRUPTED, f"interrupted after {flight.n_cycles} cycles{of}; what was flown is kept")

    def judged(self, certificate: C, recorder: FlightRecorder) -> Outcome:
        """What the flight is worth, noted."""
        self.certificate = certificate
        recorder.certificate(certificate)
        return Outcome(DONE if certificate.certified else NOT_CERTIFIED, certificate.verdict)

    def completed(self, outcome: Outcome) -> Outcome:
        """The outcome with what was found, also after a failure."""
        if self.flown is None:
            return outcome
        cost, final_time = self.result(self.flown)
        certified = self.certificate is not None and self.certificate.certified
        return replace(outcome, certified=certified, cost=cost, final_time=final_time)

    def keep(self, folder: Path, outcome: Outcome) -> None:
        """Save what was flown and write the report."""
        for name, flight in ((FLIGHT, self.flight), (FLEET, self.fleet)):
            if flight is not None:
                save_flight(flight, folder / name, reference=self.reference, arguments=self.arguments)
        flown = self.flown
        write_flight_report(
            folder,
            title=f"{self.problem.name}: {self.problem.description}",
            certificate=self.certificate,
            sections=self.sections(flown) if flown is not None else (),
            draw=partial(self.figures, flown) if flown is not None and self.common.recording.figures else None,
            settings=self.common.settings,
            message=outcome.message,
        )

    def screen(self) -> list[str]:
        """Lines that a person wants to see at the end."""
        judged = [self.certificate.to_text(), ""] if self.certificate is not None else []
        return judged + (self.lines(self.flown) if self.flown is not None else [])


# -- settings ----------------------------------------------------------------------------------------


@dataclass
class Settings:
    """A config as plain values, taken out one by one; what is left at the end is an error.

    Raises ConfigError for a setting that is missing, or is not what its place asks for.
    """

    given: Mapping[str, Any]
    node: dict[str, Any] = field(init=False)
    used: list[str] = field(init=False)

    def __post_init__(self) -> None:
        # the folder's name is Hydra's; the kind has been looked at
        self.node = {key: value for key, value in self.given.items() if key not in ("name", "kind")}
        self.used = ["kind"]

    def value(self, key: str, kind: Any, least: int | None = None) -> Any:
        if key not in self.node:
            raise ConfigError(f"{key}: missing; allowed: a value, as in the config of the flight")
        self.used.append(key)
        value = fit(self.node.pop(key), kind, key)
        if least is not None and value < least:
            raise ConfigError(f"{key} = {value}; allowed: an integer from {least}")
        return value

    def group(self, key: str, without: Sequence[str] = ()) -> dict[str, Any]:
        """A group's config ``without`` what is there for the flight to refer to."""
        value = self.node.pop(key, None)
        self.used.append(key)
        if not isinstance(value, dict):
            raise ConfigError(f"{key} = {value!r}; allowed: a config of the group {key}")
        return {name: entry for name, entry in value.items() if name not in without}

    def common(self) -> Common:
        recording = call(FlightRecording, self.group("record"), "record")
        return Common(dict(self.given), self.value("seed", int, 0), self.value("threads", int, 1), recording)

    def plant(self, kind: type[P], without: Sequence[str] = ()) -> tuple[P, str, dict[str, Any]]:
        """The problem, and the reference and arguments that make it again."""
        node = self.group("problem", ("name", *without))
        function = target(node.pop("_target_", None), "problem._target_", PLANTS)
        arguments = arguments_of(function, node, "problem")
        reference = f"{function.__module__}:{function.__name__}"
        problem: Problem = told("problem", lambda: make_problem(reference, arguments), list(arguments))
        if not isinstance(problem, kind):
            raise ConfigError(f"problem = {problem.name!r}; allowed: a {kind.__name__} for this kind of flight")
        return problem, reference, arguments

    def nothing_left(self) -> None:
        reject_unknown(self.node, self.used, "")


def told(path: str, make: Callable[[], Any], parameters: Sequence[str] = ()) -> Any:
    """What is made, or a ConfigError that says what is wrong."""
    try:
        return make()
    except ValueError as error:
        raise ConfigError(located(error, path, parameters)) from error
