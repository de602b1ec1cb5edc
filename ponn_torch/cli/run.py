"""One solve in its folder: everything computed is kept there, whatever ends the run."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from ponn_torch.build import Plan, build, resolved
from ponn_torch.cli.explain import explanation
from ponn_torch.cli.job import BAD_INPUT, CHECKPOINTS, DONE, INTERRUPTED, NOT_CERTIFIED, Outcome, run_job
from ponn_torch.cli.overrides import PONN
from ponn_torch.cli.session import Tool, sweep_member
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.reporting.members import BESIDES
from ponn_torch.reporting.recorder import Recorder
from ponn_torch.reporting.records import RECORDS, RunRecorder, recorded
from ponn_torch.reporting.reference import Reference
from ponn_torch.reporting.report import end_error_rows, verdict_table, write_report
from ponn_torch.reporting.style import columns, number, unit
from ponn_torch.settings import ConfigError, one_line, users_line
from ponn_torch.solving.certificate import Certificate
from ponn_torch.solving.journal import ForeignJournal, Journal
from ponn_torch.solving.result import StageResult
from ponn_torch.solving.solution import SOLUTION, Solution, in_a_row

CHOICES = "choices.yaml"


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
    guess = OmegaConf.select(config, "guess.solution")
    if guess is not None and Path(guess).resolve() in (folder.resolve(), (folder / SOLUTION).resolve()):
        # which would be gone before it is read again, as when the run is resumed
        message = f"guess.solution = {str(guess)!r}; allowed: another folder than the run's own, which is cleared"
        print(f"ponn: {message}", file=sys.stderr)
        return Outcome(BAD_INPUT, message)
    return run_job(SolveJob(config, folder, overrides, plan, choices or {}), folder, overrides, slip=users_line)


def resume(config: DictConfig, folder: Path, overrides: Sequence[str]) -> Outcome:
    """Go on with the run in a folder from its checkpoints; it ends as the uninterrupted run would have."""
    job = SolveJob(config, folder, overrides, None, _choices_before(folder), resume=True)
    return run_job(job, folder, overrides, resume=True, slip=users_line)


def _keep_choices(folder: Path, choices: Mapping[str, Any]) -> None:
    """Leave the names of the groups' configs with the checkpoints, for a run that goes on with its config alone."""
    (folder / CHECKPOINTS).mkdir(exist_ok=True)
    OmegaConf.save(OmegaConf.create(dict(choices)), folder / CHECKPOINTS / CHOICES)


def _choices_before(folder: Path) -> dict[str, Any]:
    path = folder / CHECKPOINTS / CHOICES
    return {str(group): name for group, name in OmegaConf.load(path).items()} if path.is_file() else {}


def _told_apart(plan: Plan, overrides: Sequence[str], choices: Mapping[str, Any]) -> dict[str, Any]:
    """The few settings that tell runs apart: what was chosen and what was changed, for TensorBoard's HPARAMS."""
    given = (text.partition("=") for text in overrides)
    changed = {key.lstrip("+~"): value.strip("'\"") for key, _, value in given}
    chosen = {group: choices[group] for group in ("ansatz", "optimizer") if group in choices}
    told = chosen | {"problem": plan.problem.name, "seed": plan.seed}
    return told | {key: value for key, value in changed.items() if key not in told and key.split(".")[0] not in BESIDES}


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


def member(config: DictConfig) -> float:
    """One member of a sweep."""
    return sweep_member(TOOL, config)


class SolveJob:
    """Solves an optimal control problem."""

    def __init__(
        self,
        config: DictConfig,
        folder: Path,
        overrides: Sequence[str],
        plan: Plan | None,
        choices: Mapping[str, Any],
        *,
        resume: bool = False,
    ) -> None:
        self._config, self._folder, self._plan = config, folder, plan
        self._overrides, self._choices = overrides, choices
        self._keeper, self._resume, self._cut = _Keeper(), resume, False
        # before the folder is cleared
        self._replay = recorded(folder / RECORDS) if resume else {}

    def prepare(self) -> Mapping[str, Any]:
        if self._plan is None or resolved(self._config) != self._plan.settings:
            self._plan = None
            self._plan = build(self._config)
        return self._plan.settings

    def work(self) -> Outcome:
        plan = self._plan
        assert plan is not None
        recording = plan.recording
        for note in plan.notes:
            print(f"note: {note}", flush=True)
        torch.set_num_threads(plan.threads)
        recorder = RunRecorder(
            self._folder,
            settings=_told_apart(plan, self._overrides, self._choices),
            cost_name=plan.problem.cost_name,
            tensorboard=recording.tensorboard,
            progress=recording.progress,
            cost_every=recording.cost_every,
            figures=recording.stage_figures,
            reference=_reference(plan),
            replay=self._replay,
            extra=(self._keeper,),
        )
        _keep_choices(self._folder, self._choices)
        journal = Journal(self._folder / CHECKPOINTS, resume=self._resume)
        try:
            with recorder:
                result = plan.solver.solve(plan.problem, plan.seed, recorder, journal)
        except ForeignJournal as error:  # a user's problem file that was changed meanwhile, say
            raise ConfigError(str(error)) from error
        code = DONE if result.certified else NOT_CERTIFIED
        if not plan.solver.exact and result.solution is not None and result.certificate is not None:
            code = DONE  # a smoothed solution was asked for; what it is worth stands in its certificate
        if result.interrupted:
            code = INTERRUPTED
        message = result.message
        self._cut = result.interrupted or result.spent
        if code == NOT_CERTIFIED and plan.explain and not self._cut:
            print("not certified; looking for a reason …", flush=True)
            message = "; ".join([message, *explanation(plan.problem, plan.solver, plan.seed, result.solution)])
        return Outcome(code, message)

    def completed(self, outcome: Outcome) -> Outcome:
        """The outcome with what the solver told."""
        keeper, best = self._keeper, self._keeper.best
        outcome = replace(outcome, n_starts=max((stage.start + 1 for stage in keeper.stages), default=0))
        if keeper.judged is not None:
            outcome = replace(outcome, certified=keeper.judged.certified)
        if best is None:
            return outcome
        return replace(
            outcome,
            cost=best.cost,
            known_cost=best.problem.known_cost,
            final_time=best.final_time,
            switch_times=best.switch_times,
            arcs=best.arcs,
        )

    def keep(self, outcome: Outcome) -> None:
        """Save the best solution and write the report; the figures last, for they are most likely to fail."""
        plan, best = self._plan, self._keeper.best
        if outcome.exit_code in (DONE, NOT_CERTIFIED) and not self._cut:
            shutil.rmtree(self._folder / CHECKPOINTS, ignore_errors=True)  # nothing is left to go on with
        if best is not None:
            best.save(self._folder / SOLUTION)
        figures = plan is not None and plan.recording.figures and best is not None
        if figures:
            print("drawing the figures …", flush=True)
        for with_figures in (False, True) if figures else (False,):
            write_report(
                self._folder,
                solution=best,
                certificate=self._keeper.judged,
                stages=self._keeper.stages,
                settings=plan.settings if plan is not None else None,
                message=outcome.message,
                notes=plan.notes if plan is not None else (),
                figures=with_figures,
            )

    def screen(self, outcome: Outcome, seconds: float) -> str:
        return _screen(outcome, self._folder, self._plan, self._keeper, seconds)


def _screen(outcome: Outcome, folder: Path, plan: Plan | None, keeper: _Keeper, seconds: float) -> str:
    """What a person wants to see at the end."""
    lines, certificate = [""], keeper.judged
    if certificate is not None:
        # the progress has shown the verdict, which opens the table
        first = 2 if plan is not None and plan.recording.progress else 0
        lines += [*verdict_table(certificate)[first:], ""]
    rows: list[tuple[str, str]] = []
    if plan is not None and outcome.cost is not None:
        rows += _found(outcome, plan.problem, smoothed=keeper.best is not None and keeper.best.smoothing is not None)
        rows += _of_several(outcome, plan)
    if plan is not None and certificate is not None:
        rows += end_error_rows(certificate, plan.problem)
    solving = sum(stage.cpu_seconds for stage in keeper.stages)
    rows += [("CPU time", f"{solving:.1f} s solving, {seconds:.1f} s in all"), ("folder", str(folder))]
    if outcome.exit_code != DONE and (certificate is None or outcome.message != certificate.verdict):
        rows.append(("ended", outcome.message))
    return "\n".join([*lines, *columns(rows)])


def _found(outcome: Outcome, problem: OptimalControlProblem, *, smoothed: bool) -> list[tuple[str, str]]:
    """Cost, final time and switches, in the units that people read."""
    cost, clock, known = unit(problem, "cost"), unit(problem, "time"), ""
    assert outcome.cost is not None
    if outcome.known_cost is not None:
        excess = (outcome.cost - outcome.known_cost) / cost.size
        what = "optimum without smoothing" if smoothed else "known optimum"
        known = f"; {what} {outcome.known_cost / cost.size:.10g}, difference {excess:+.1e}"
    doubt = "" if outcome.certified else ", NOT certified"
    rows = [(problem.cost_name, f"{number(outcome.cost, cost, '.10g')}{doubt}{known}")]
    if outcome.final_time is not None:
        rows.append(("final time", number(outcome.final_time, clock, ".10g")))
    if outcome.switch_times:
        *before, last = outcome.switch_times
        times = [f"{time / clock.size:.9g}" for time in before] + [number(last, clock, ".9g")]
        rows.append(("switches", f"{', '.join(times)} ({in_a_row(outcome.arcs)})"))
    return rows


def _of_several(outcome: Outcome, plan: Plan) -> list[tuple[str, str]]:
    """How to look for a better extremal, where no known optimum tells what the first certified one is worth."""
    solver = plan.solver
    first = solver.exact and solver.n_certified == 1 and solver.n_starts > 1
    if not (first and outcome.certified and outcome.known_cost is None):
        return []
    return [("extremal", "the first one certified, perhaps not the best; n_certified=5 keeps the cheapest of five")]


TOOL = Tool(PONN, build, run, member, resume)
