"""What every kind of flight of ``ponn-rhc`` has in common: a mission, and how its settings are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch

from ponn_torch.cli.job import Outcome
from ponn_torch.guidance.storage import Problem, make_problem
from ponn_torch.reporting.flights import FlightRecorder
from ponn_torch.settings import ConfigError, arguments_of, call, fit, located, reject_unknown, target

FLIGHT, FLEET = "flight", "monte_carlo"  # folders of what is flown once, and dispersed
PLANTS = ("ponn_torch.guidance.plants",)
P = TypeVar("P")


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


class Mission(Protocol):
    """A kind of flight, built of a config: flown, checked, kept. It is flown once."""

    @property
    def common(self) -> Common: ...

    @property
    def groups(self) -> Sequence[str]:
        """Of configs, which tell runs apart."""

    @property
    def n_cycles(self) -> int:
        """About how many there will be."""

    @property
    def time_label(self) -> str: ...

    def fly(self, recorder: FlightRecorder) -> Outcome:
        """Fly and check; what is found stays, also where this ends early."""

    def completed(self, outcome: Outcome) -> Outcome:
        """The outcome with what was found, also after a failure."""

    def keep(self, folder: Path, outcome: Outcome) -> None:
        """Save what was flown and write the report."""

    def screen(self, outcome: Outcome) -> list[str]:
        """Lines that a person wants to see at the end."""


# -- settings ----------------------------------------------------------------------------------------


@dataclass
class Settings:
    """A config as plain values, taken out one by one; what is left at the end is an error.

    Raises ConfigError for a setting that is missing, or is not what its place asks for.
    """

    node: dict[str, Any]
    used: list[str]

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> Settings:
        return cls(dict(settings), [])

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

    def common(self, settings: dict[str, Any]) -> Common:
        recording = call(FlightRecording, self.group("record"), "record")
        return Common(settings, self.value("seed", int, 0), self.value("threads", int, 1), recording)

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
