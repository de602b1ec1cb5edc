"""``ponn-rhc``: a plant flown in closed loop, its decisions checked against an oracle, kept in a run folder.

A kind of flight is a class in a file of its own, named here, and a config of the group ``flight``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from ponn_torch.build import resolved
from ponn_torch.cli.job import DONE, Outcome, run_job
from ponn_torch.cli.landing import Descent
from ponn_torch.cli.mission import PLANTS, Mission
from ponn_torch.cli.overrides import RHC
from ponn_torch.cli.session import Tool, sweep_member
from ponn_torch.cli.tracking import Tracking
from ponn_torch.guidance.descent import PoweredDescent
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.optimal_control.problem import nearest
from ponn_torch.reporting.flights import FlightRecorder
from ponn_torch.settings import ConfigError, target, types_of

Build = Callable[[Mapping[str, Any]], Mission]
KINDS: dict[str, tuple[type, Build]] = {  # what is flown, and how a mission is made of settings
    "tracking": (TrackingProblem, Tracking.build),
    "landing": (PoweredDescent, Descent.build),
}


def build(config: DictConfig) -> Mission:
    """The mission that a config asks for.

    Raises:
        ConfigError: a misspelt, missing or impossible setting.
    """
    kind = OmegaConf.select(config, "kind")
    if kind not in KINDS:
        raise ConfigError(f"kind = {kind!r}; {nearest(str(kind), KINDS)}")
    wanted, make = KINDS[kind]
    # before anything refers to settings that only the right kind of problem has
    made = types_of(target(OmegaConf.select(config, "problem._target_"), "problem._target_", PLANTS)).get("return")
    if made is not wanted:
        allowed = ", ".join(name for name, (other, _) in KINDS.items() if made is other)
        raise ConfigError(
            f"flight = {kind!r} with problem = {OmegaConf.select(config, 'problem.name')!r}; allowed: {allowed}"
        )
    return make(resolved(config))


def run(
    config: DictConfig,
    folder: Path,
    overrides: Sequence[str],
    mission: Mission | None = None,
    choices: Mapping[str, Any] | None = None,
) -> Outcome:
    """Fly what the config asks for and leave a complete folder; raises for nothing that happens in between.

    ``choices`` name the config of each group, for TensorBoard's HPARAMS.
    """
    return run_job(FlightJob(config, folder, mission, dict(choices or {})), folder, overrides)


def member(config: DictConfig) -> float:
    """One member of a sweep."""
    return sweep_member(TOOL, config)


@dataclass
class FlightJob:
    """Carries out a mission in its folder."""

    config: DictConfig
    folder: Path
    mission: Mission | None = None
    choices: dict[str, Any] = field(default_factory=dict)

    def prepare(self) -> Mapping[str, Any]:
        if self.mission is None or resolved(self.config) != self.mission.common.settings:
            self.mission = build(self.config)
        return self.mission.common.settings

    def work(self) -> Outcome:
        mission = self.mission
        assert mission is not None
        common = mission.common
        torch.set_num_threads(common.threads)
        recorder = FlightRecorder(
            self.folder,
            n_cycles=mission.n_cycles,
            time_label=mission.time_label,
            settings={name: self.choices[name] for name in mission.groups if name in self.choices}
            | {"seed": common.seed},
            tensorboard=common.recording.tensorboard,
            progress=common.recording.progress,
        )
        with recorder:
            return mission.fly(recorder)

    def completed(self, outcome: Outcome) -> Outcome:
        return self.mission.completed(outcome) if self.mission is not None else outcome

    def keep(self, outcome: Outcome) -> None:
        if self.mission is not None:
            self.mission.keep(self.folder, outcome)

    def screen(self, outcome: Outcome, seconds: float) -> str:
        lines = ["", *(self.mission.screen() if self.mission is not None else [])]
        lines += [f"{'CPU time':12}{seconds:.1f} s in all", f"{'folder':12}{self.folder}"]
        if outcome.exit_code != DONE and not any(outcome.message in line for line in lines):
            lines.append(f"{'ended':12}{outcome.message}")
        return "\n".join(lines)


TOOL = Tool(RHC, build, run, member)
