"""``ponn-rhc``: a tracking problem flown in closed loop, checked against an oracle, kept in a run folder."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from ponn_torch.build import resolved
from ponn_torch.cli.job import DONE, INTERRUPTED, NOT_CERTIFIED, Outcome, run_job
from ponn_torch.cli.overrides import RHC
from ponn_torch.cli.session import Tool, sweep_member
from ponn_torch.guidance.accuracy import GuidanceCertificate, certify
from ponn_torch.guidance.closed_loop import Flight, Loop, fly
from ponn_torch.guidance.controllers import Controller, HorizonController, Timetable, gain_schedule, timetable
from ponn_torch.guidance.methods import Method, TunedGaussians
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.storage import make_problem, save_flight
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.reporting.flight_report import write_flight_report
from ponn_torch.reporting.flights import FlightRecorder
from ponn_torch.settings import ConfigError, arguments_of, call, fit, located, reject_unknown, target, value_of

FLIGHT, DISPERSED = "flight", "monte_carlo"
WORTH_TRACING = 50  # cycles; the trace of derivatives takes about as long as it saves in so many
GROUPS = ("problem", "method", "passes", "loop", "record")
PLANTS = ("ponn_torch.guidance.plants",)


@dataclass(frozen=True)
class FlightRecording:
    """What a run leaves besides its records, flight and certificate."""

    progress: bool = True
    tensorboard: bool = True
    figures: bool = True


@dataclass(frozen=True)
class FlightPlan:
    """All that a config (``settings``, resolved) asks for; reference and arguments make the problem again."""

    problem: TrackingProblem
    reference: str
    arguments: Mapping[str, Any]
    table: Timetable
    method: Method
    passes: Passes
    loop: Loop
    recording: FlightRecording
    settings: dict[str, Any]
    seed: int = 0
    schedule: bool = False
    n_vehicles: int = 0
    n_samples: int = 25
    control_error: float = 1e-2
    threads: int = 1

    def generator(self, stream: int) -> torch.Generator:
        """Of random numbers that are drawn apart from those of other streams."""
        return torch.Generator().manual_seed(1000 * self.seed + stream)


# -- config → objects --------------------------------------------------------------------------------


def build(config: DictConfig) -> FlightPlan:
    """Build all objects of a flight; what does not go together is told here.

    Raises:
        ConfigError: a misspelt, missing or impossible setting.
    """
    settings = resolved(config)
    node = dict(settings)
    least = {"seed": 0, "n_vehicles": 0, "n_samples": 1, "threads": 1}
    kinds: dict[str, Any] = dict.fromkeys(least, int) | {"schedule": bool, "control_error": float, "ending": str}
    top: dict[str, Any] = {}
    for key, kind in kinds.items():
        if key not in node:
            raise ConfigError(f"{key}: missing; allowed: a value, as in track.yaml")
        top[key] = fit(node.pop(key), kind, key)
        if key in least and top[key] < least[key]:
            raise ConfigError(f"{key} = {top[key]}; allowed: an integer from {least[key]}")
    node.pop("name", None)
    groups = {key: _group(node, key) for key in GROUPS}
    reject_unknown(node, [*kinds, *groups], "")
    problem, reference, arguments = _problem(groups["problem"])
    ending = top.pop("ending")
    passes = call(Passes, groups["passes"], "passes")
    loop = call(Loop, groups["loop"], "loop")
    sizes = [unit.size for unit in problem.plant.states.values()]
    if len(loop.noise) not in (0, len(sizes)):
        raise ConfigError(f"loop.noise = {list(loop.noise)}; allowed: one per state, {', '.join(problem.plant.states)}")
    loop = replace(loop, noise=[value * size for value, size in zip(loop.noise, sizes, strict=bool(loop.noise))])
    plan = FlightPlan(
        problem,
        reference,
        arguments,
        _told("", lambda: timetable(problem, ending)),
        value_of(groups["method"], Method, "method"),
        passes,
        loop,
        call(FlightRecording, groups["record"], "record"),
        settings,
        **top,
    )
    if plan.schedule and passes.most > 1 and not problem.plant.linear:
        raise ConfigError(f"schedule = true with passes.most = {passes.most}; allowed: 1 pass, or a linear plant")
    if plan.n_vehicles and problem.dispersion is None:
        raise ConfigError(f"n_vehicles = {plan.n_vehicles}; allowed: 0, for {problem.plant.name} has no dispersion")
    if not isinstance(plan.method, TunedGaussians):  # a search takes seconds: it waits until it is needed
        _told("method", lambda: plan.method.solver(problem, plan.seed), list(groups["method"]))
    return plan


def _group(node: dict[str, Any], key: str) -> dict[str, Any]:
    value = node.pop(key, None)
    if not isinstance(value, dict):
        raise ConfigError(f"{key} = {value!r}; allowed: a config of the group {key}")
    return dict(value)


def _problem(node: dict[str, Any]) -> tuple[TrackingProblem, str, dict[str, Any]]:
    for key in ("name", "ending"):
        node.pop(key, None)
    function = target(node.pop("_target_", None), "problem._target_", PLANTS)
    arguments = arguments_of(function, node, "problem")
    reference = f"{function.__module__}:{function.__name__}"
    return _told("problem", lambda: make_problem(reference, arguments), list(arguments)), reference, arguments


def _told(path: str, make: Callable[[], Any], parameters: Sequence[str] = ()) -> Any:
    """What is made, or a ConfigError that says what is wrong."""
    try:
        return make()
    except ValueError as error:
        raise ConfigError(located(error, path, parameters)) from error


# -- a run -------------------------------------------------------------------------------------------


def run(
    config: DictConfig,
    folder: Path,
    overrides: Sequence[str],
    plan: FlightPlan | None = None,
    choices: Mapping[str, Any] | None = None,
) -> Outcome:
    """Fly what the config asks for and leave a complete folder; raises for nothing that happens in between.

    ``choices`` name the config of each group, for TensorBoard's HPARAMS.
    """
    return run_job(FlightJob(config, folder, plan, dict(choices or {})), folder, overrides)


def member(config: DictConfig) -> float:
    """One member of a sweep."""
    return sweep_member(TOOL, config)


@dataclass
class FlightJob:
    """Flies a tracking problem once, checks it, and flies a Monte Carlo where one is asked for."""

    config: DictConfig
    folder: Path
    plan: FlightPlan | None = None
    choices: dict[str, Any] = field(default_factory=dict)
    flight: Flight | None = None
    dispersed: Flight | None = None
    certificate: GuidanceCertificate | None = None
    summary: dict[str, Any] = field(default_factory=dict)

    def prepare(self) -> Mapping[str, Any]:
        if self.plan is None or resolved(self.config) != self.plan.settings:
            self.plan = build(self.config)
        return self.plan.settings

    def work(self) -> Outcome:
        plan = self.plan
        assert plan is not None
        torch.set_num_threads(plan.threads)
        recorder = FlightRecorder(
            self.folder,
            n_cycles=len(plan.table.starts),
            time_label=plan.problem.plant.time.label,
            settings={name: self.choices[name] for name in GROUPS if name in self.choices} | {"seed": plan.seed},
            tensorboard=plan.recording.tensorboard,
            progress=plan.recording.progress,
        )
        with recorder:
            return self._work(plan, recorder)

    def _work(self, plan: FlightPlan, recorder: FlightRecorder) -> Outcome:
        problem, solver = plan.problem, plan.method.solver(plan.problem, plan.seed)
        planner = Planner(problem, solver, plan.passes, traced=len(plan.table.starts) >= WORTH_TRACING)
        controller: Controller = HorizonController(planner, plan.table)
        if plan.schedule:
            controller = gain_schedule(planner, plan.table)
        elif planner.traced:  # now: no decision should wait for that
            planner.plan(plan.table.starts[0], problem.initial, plan.table.durations[0])
        self.flight = fly(
            problem,
            controller,
            plan.table,
            problem.initial,
            plan.loop,
            generator=plan.generator(0),
            on_cycle=recorder.cycle,
        )
        if not self.flight.completed:
            recorder.failed("interrupted")
            return Outcome(INTERRUPTED, f"interrupted after {self.flight.n_cycles} cycles; what was flown is kept")
        checker = Planner(problem, solver, plan.passes)
        self.certificate = certify(
            self.flight, checker, plan.table, n_samples=plan.n_samples, allowed=plan.control_error
        )
        recorder.certificate(self.certificate)
        if plan.n_vehicles:
            self._disperse(plan, planner)
            recorder.monte_carlo(self.summary)
        return Outcome(DONE if self.certificate.certified else NOT_CERTIFIED, self.certificate.verdict)

    def _disperse(self, plan: FlightPlan, planner: Planner) -> None:
        """Fly all vehicles at once, by a schedule where one is exact."""
        problem = plan.problem
        affine = plan.passes.most == 1 or problem.plant.linear
        controller = (
            gain_schedule(planner, plan.table, with_loss=False) if affine else HorizonController(planner, plan.table)
        )
        starts = problem.disperse(plan.n_vehicles, plan.generator(1))
        loop = replace(plan.loop, deadline=None)  # one decision for all of them
        self.dispersed = fly(problem, controller, plan.table, starts, loop, generator=plan.generator(2))
        last = self.dispersed.errors[-1].abs().amax(0).tolist()
        states = problem.plant.states.items()
        self.summary = {
            "n_vehicles": plan.n_vehicles,
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

    def keep(self, outcome: Outcome) -> None:
        plan, flight = self.plan, self.flight
        if plan is not None and flight is not None:
            for name, flown in ((FLIGHT, flight), (DISPERSED, self.dispersed)):
                if flown is not None:
                    save_flight(flown, self.folder / name, reference=plan.reference, arguments=plan.arguments)
        write_flight_report(
            self.folder,
            flight=flight,
            certificate=self.certificate,
            dispersed=self.dispersed,
            summary=self.summary,
            settings=plan.settings if plan is not None else None,
            message=outcome.message,
            deadline=plan.loop.deadline if plan is not None else None,
            figures=plan is not None and plan.recording.figures,
        )

    def screen(self, outcome: Outcome, seconds: float) -> str:
        lines = [""]
        if self.certificate is not None:
            lines += [self.certificate.to_text(), ""]
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
        lines += [f"{'CPU time':12}{seconds:.1f} s in all", f"{'folder':12}{self.folder}"]
        if outcome.exit_code != DONE and (self.certificate is None or outcome.message != self.certificate.verdict):
            lines.append(f"{'ended':12}{outcome.message}")
        return "\n".join(lines)


TOOL = Tool(RHC, build, run, member)
