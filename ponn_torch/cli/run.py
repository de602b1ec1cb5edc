"""One run in its folder: everything computed is kept there, whatever ends the run."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from ponn_torch.build import Plan, build, resolved
from ponn_torch.optimal_control.problem import DisplayUnit
from ponn_torch.reporting.members import BESIDES, OUTCOME, SOLUTION
from ponn_torch.reporting.recorder import Recorder, finite_or_none
from ponn_torch.reporting.records import RECORDS, RunRecorder
from ponn_torch.reporting.reference import Reference
from ponn_torch.reporting.report import (
    CERTIFICATE,
    ENVIRONMENT,
    FAILURE,
    FAILURE_TEXT,
    FIGURES,
    REPORT,
    write_failure,
    write_report,
)
from ponn_torch.settings import ConfigError, one_line
from ponn_torch.solving.certificate import Certificate
from ponn_torch.solving.observer import StageResult
from ponn_torch.solving.solution import Solution

DONE, BAD_INPUT, NOT_CERTIFIED, BUG, INTERRUPTED = 0, 1, 2, 3, 130
CONFIG, OVERRIDES = "config.yaml", "overrides.yaml"
FILES = (CONFIG, OVERRIDES, OUTCOME, RECORDS, REPORT, ENVIRONMENT, CERTIFICATE, FAILURE, FAILURE_TEXT)


@dataclass(frozen=True)
class Outcome:
    """How a run ended, as outcome.json says it; cost in the user's units, times in s."""

    exit_code: int
    message: str
    certified: bool = False
    cost: float | None = None
    known_cost: float | None = None
    final_time: float | None = None
    switch_times: list[float] = field(default_factory=list)
    arcs: list[str] = field(default_factory=list)
    n_starts: int = 0
    cpu_seconds: float = 0.0
    overrides: list[str] = field(default_factory=list)

    @property
    def score(self) -> float:
        """What a sweep optimises: the cost of a certified solution, else infinity."""
        return self.cost if self.certified and self.cost is not None else math.inf


class _Keeper(Recorder):
    """Holds what the solver has told so far."""

    def __init__(self) -> None:
        self.stages: list[StageResult] = []
        self.final: Solution | None = None
        self.judged: Certificate | None = None

    def stage_ended(self, stage: StageResult) -> None:
        self.stages.append(stage)

    def solution(self, solution: Solution) -> None:
        self.final = solution

    def certificate(self, certificate: Certificate) -> None:
        self.judged = certificate

    @property
    def best(self) -> Solution | None:
        """The final solution, or that of the last stage that kept one."""
        kept = [stage.solution for stage in self.stages if stage.solution is not None]
        return self.final or (kept[-1] if kept else None)


def run(
    config: DictConfig,
    folder: Path,
    overrides: Sequence[str],
    plan: Plan | None = None,
    choices: Mapping[str, Any] | None = None,
) -> Outcome:
    """Solve what the config asks for and leave a complete folder; raises for nothing that happens in between.

    ``plan`` is used if it was built from the same config. ``choices`` name the config of each group.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _clear(folder)
    keeper, began = _Keeper(), time.process_time()
    error: BaseException | None = None
    try:
        _write_text(folder / OVERRIDES, OmegaConf.to_yaml(OmegaConf.create(list(overrides))))
        if plan is None or resolved(config) != plan.settings:
            plan = build(config)
        _write_text(folder / CONFIG, OmegaConf.to_yaml(OmegaConf.create(plan.settings)))
        outcome = _solve(plan, folder, keeper, _told_apart(plan, overrides, choices or {}))
    except ConfigError as wrong:
        outcome = Outcome(BAD_INPUT, str(wrong))
    except KeyboardInterrupt:
        outcome = Outcome(INTERRUPTED, "interrupted; what was computed so far is kept")
    except Exception as bug:
        error, outcome = bug, Outcome(BUG, f"{type(bug).__name__}: {one_line(bug)}")
    outcome = _completed(outcome, keeper, overrides, time.process_time() - began)
    if outcome.exit_code != DONE:
        write_failure(folder, outcome.message, error)
    try:
        _kept(outcome, plan, folder, keeper)
    except Exception as bug:
        outcome = _replaced(outcome, BUG, f"{type(bug).__name__}: {one_line(bug)}")
        write_failure(folder, outcome.message, bug)
    except KeyboardInterrupt:
        outcome = _replaced(outcome, INTERRUPTED, "interrupted while the report was written")
        write_failure(folder, outcome.message)
    _write_text(folder / OUTCOME, json.dumps(finite_or_none(asdict(outcome)), indent=2, ensure_ascii=False) + "\n")
    print(_screen(outcome, folder, plan, keeper, time.process_time() - began), flush=True)
    return outcome


def _told_apart(plan: Plan, overrides: Sequence[str], choices: Mapping[str, Any]) -> dict[str, Any]:
    """The few settings that tell runs apart: what was chosen and what was changed, for TensorBoard's HPARAMS."""
    given = (text.partition("=") for text in overrides)
    changed = {key.lstrip("+~"): value.strip("'\"") for key, _, value in given}
    chosen = {group: choices[group] for group in ("ansatz", "optimizer") if group in choices}
    told = chosen | {"problem": plan.problem.name, "seed": plan.seed}
    return told | {key: value for key, value in changed.items() if key not in told and key.split(".")[0] not in BESIDES}


def _solve(plan: Plan, folder: Path, keeper: _Keeper, told: Mapping[str, Any]) -> Outcome:
    recording = plan.recording
    torch.set_num_threads(plan.threads)
    recorder = RunRecorder(
        folder,
        settings=told,
        cost_name=plan.problem.cost_name,
        tensorboard=recording.tensorboard,
        progress=recording.progress,
        cost_every=recording.cost_every,
        figures=recording.stage_figures,
        reference=_reference(plan),
        extra=(keeper,),
    )
    with recorder:
        result = plan.solver.solve(plan.problem, plan.seed, recorder)
    code = DONE if result.certified else NOT_CERTIFIED
    if plan.solver.refinement is None and result.solution is not None and result.certificate is not None:
        code = DONE  # a smoothed solution was asked for; what it is worth stands in its certificate
    if result.interrupted:
        code = INTERRUPTED
    return Outcome(code, result.message)


def _reference(plan: Plan) -> Reference | None:
    """The solution that the run is measured against.

    Raises:
        ConfigError: none is there, or it is one of another problem.
    """
    if plan.recording.reference is None:
        return None
    try:
        solution = Solution.load(plan.recording.reference)
        if solution.problem.states != plan.problem.states:
            raise ValueError(f"it solves {solution.problem.name!r}, which has other states")
        return Reference(solution)
    except (OSError, ValueError) as error:
        raise ConfigError(f"record.reference = {plan.recording.reference!r}: {one_line(error)}") from error


def _completed(outcome: Outcome, keeper: _Keeper, overrides: Sequence[str], seconds: float) -> Outcome:
    """The outcome with what the solver told."""
    values: dict[str, Any] = {"overrides": list(overrides), "cpu_seconds": seconds}
    values["n_starts"] = max((stage.start + 1 for stage in keeper.stages), default=0)
    if keeper.judged is not None:
        values |= {"certified": keeper.judged.certified}
    best = keeper.best
    if best is not None:
        values |= {"cost": best.cost, "known_cost": best.problem.known_cost, "final_time": best.final_time}
        values |= {"switch_times": best.switch_times, "arcs": best.arcs}
    return Outcome(**asdict(outcome) | values)


def _replaced(outcome: Outcome, code: int, message: str) -> Outcome:
    return Outcome(**asdict(outcome) | {"exit_code": code, "message": message})


def _kept(outcome: Outcome, plan: Plan | None, folder: Path, keeper: _Keeper) -> None:
    """Save the best solution and write the report; the figures last, for they are most likely to fail."""
    best = keeper.best
    if best is not None:
        best.save(folder / SOLUTION)
    figures = plan is not None and plan.recording.figures and best is not None
    if figures:
        print("drawing the figures …", flush=True)
    for with_figures in (False, True) if figures else (False,):
        write_report(
            folder,
            solution=best,
            certificate=keeper.judged,
            stages=keeper.stages,
            settings=plan.settings if plan is not None else None,
            message=outcome.message,
            figures=with_figures,
        )


# -- files and words -------------------------------------------------------------------------------


def _clear(folder: Path) -> None:
    """Remove what an earlier run left here, and nothing else."""
    if not (folder / OUTCOME).exists() and not (folder / RECORDS).exists():
        return
    for name in FILES:
        (folder / name).unlink(missing_ok=True)
    for events in folder.glob("events.out.tfevents.*"):
        events.unlink()
    for name in (SOLUTION, FIGURES):
        shutil.rmtree(folder / name, ignore_errors=True)


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _screen(outcome: Outcome, folder: Path, plan: Plan | None, keeper: _Keeper, seconds: float) -> str:
    """What a person wants to see at the end."""
    lines, certificate = [""], keeper.judged
    if certificate is not None:
        text = certificate.to_text().splitlines()
        # its lines on end errors, cost and time come below, with units
        starts = ("end error of ", f"{certificate.cost_name}: ")
        last = next((i for i, line in enumerate(text) if line.startswith(starts)), None)
        # the progress has shown the verdict, which opens the table
        first = 2 if plan is not None and plan.recording.progress else 0
        lines += ["\n".join(text[first:last]).rstrip(), ""]
    if plan is not None and outcome.cost is not None:
        display, name = plan.problem.display, plan.problem.cost_name
        cost, clock = display.get("cost", DisplayUnit("")), display.get("time", DisplayUnit("s"))
        known = ""
        if outcome.known_cost is not None:
            excess = (outcome.cost - outcome.known_cost) / cost.size
            smoothed = keeper.best is not None and keeper.best.smoothing is not None
            what = "optimum without smoothing" if smoothed else "known optimum"
            known = f"; {what} {outcome.known_cost / cost.size:.10g}, difference {excess:+.1e}"
        doubt = "" if outcome.certified else ", NOT certified"
        lines.append(f"{name:12}{outcome.cost / cost.size:.10g} {cost.label}{doubt}{known}")
        if outcome.final_time is not None:
            lines.append(f"{'final time':12}{outcome.final_time / clock.size:.10g} {clock.label}")
        if outcome.switch_times:
            times = ", ".join(f"{time / clock.size:.9g}" for time in outcome.switch_times)
            lines.append(f"{'switches':12}{times} {clock.label} ({'-'.join(outcome.arcs)})")
    if plan is not None and certificate is not None:
        for name, flown in certificate.end_errors.items():
            shown, alone = plan.problem.display.get(name, DisplayUnit("")), certificate.control_end_errors[name]
            errors = (f"{value / shown.size:.1e} {shown.label}".rstrip() for value in (flown, alone))
            lines.append("{:12}{} flown, {} by the control alone".format(f"end of {name}", *errors))
    solving = sum(stage.cpu_seconds for stage in keeper.stages)
    lines.append(f"{'CPU time':12}{solving:.1f} s solving, {seconds:.1f} s in all")
    lines.append(f"{'folder':12}{folder}")
    if outcome.exit_code != DONE and (certificate is None or outcome.message != certificate.verdict):
        lines.append(f"{'ended':12}{outcome.message}")
    return "\n".join(lines)
