"""One solve: start after start, each through its smoothed stages, the refinement and the certificate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ponn_torch.optim.base import Callback, Optimizer, OptimizeResult, Record, Residual, Status, Stop, loosened
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation, Form, Strong
from ponn_torch.optimal_control.measurements import Measured
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.solving import refinement as refinements
from ponn_torch.solving.budget import Budget
from ponn_torch.solving.certificate import Certificate, certify
from ponn_torch.solving.guess import STREAMS, project
from ponn_torch.solving.journal import Journal
from ponn_torch.solving.observer import Observer
from ponn_torch.solving.refinement import Refinement
from ponn_torch.solving.result import SolveResult, StageResult
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.walk import Walk

if TYPE_CHECKING:
    from ponn_torch.solving.solver import Solver

SAME = "the same smoothed solution as before"
MOST_REPEATS = 3  # starts that lead there, after which others are taken to lead there too


@dataclass(frozen=True)
class _Iterate:
    """The best point of an iteration, for observers."""

    collocation: Collocation
    xi: Tensor
    residual: Tensor
    equations: Residual

    def blocks(self) -> Mapping[str, float]:
        return {name: float(value) for name, value in self.equations.blocks(self.residual).items()}

    def cost(self) -> float:
        return float(self.collocation.cost(self.xi))

    def curve(self) -> Curve:
        return Curve(self.collocation, self.xi)


class _Interrupted(Exception):
    """Ctrl-C reached an optimiser, which gave its best point back."""


class Run:
    """One solve: holds the stages so far, so that nothing computed is lost whatever ends it."""

    def __init__(
        self,
        solver: Solver,
        problem: OptimalControlProblem,
        seed: int,
        observer: Observer,
        journal: Journal | None = None,
    ) -> None:
        self.solver, self.problem, self.seed, self.observer = solver, problem, seed, observer
        self.bvp = pontryagin(problem, mass_variable=solver.mass_variable, dtype=solver.dtype, device=solver.device)
        self.discretisations: dict[Form, Discretisation] = {}
        self.stages: list[StageResult] = []
        self.start = 0
        self.refused: list[Tensor] = []  # where smoothed solutions began whose refinement failed
        self.causes: list[str] = []  # why starts failed, in short
        self.clock, self.journal = Budget(solver.cpu_seconds), journal
        if journal is not None:
            journal.belongs_to(solver.determined_by(problem, seed))
        self.measurements = None if solver.data is None else solver.data.of(problem)

    # -- the line ------------------------------------------------------------------------------------------------------

    def result(self) -> SolveResult:
        best: tuple[Solution, Certificate] | None = None
        begun: list[Tensor] = []
        message, verdict, interrupted, n_certified = "", "", False, 0
        try:
            for start in range(self.solver.n_starts):
                if self.causes.count(SAME) >= MOST_REPEATS:
                    break
                with self.clock:
                    first_stage, xi = self._guessed(start)
                    if any(torch.equal(xi, other) for other in begun):
                        continue
                    begun.append(xi)
                    self.start = start
                    candidate, note = self._one_start(first_stage, xi)
                message = note or message
                if candidate is None:
                    if self.clock.spent:
                        break
                    continue
                candidate, judged = self._judged(candidate, solved=not note)
                n_certified += judged.certified
                if best is None or _better(judged, best[1]):
                    best, message = (candidate, judged), note or judged.verdict
                    verdict = message
                # a start that came through its stages is the answer where nothing aims at a certificate
                enough = n_certified >= self.solver.n_certified or not self.solver.exact
                if enough or self.clock.spent:
                    break
        except (_Interrupted, KeyboardInterrupt):
            interrupted, message = True, "interrupted; the best stage so far is kept"
        if best is not None and best[1].certified and not interrupted:
            message = verdict if n_certified == 1 else f"{verdict}; the cheapest of {n_certified} certified starts"
        spent = self.clock.spent and n_certified < self.solver.n_certified
        if not n_certified and not interrupted:
            message = self._of_all(message, len(begun))
        solution = best[0] if best else self._best_stage()
        if solution is not None:
            self.observer.solution(solution)
        if best is not None:
            self.observer.certificate(best[1])
        else:
            self.observer.failed(message)
        certificate = best[1] if best else None
        seconds = self.clock.seconds
        return SolveResult(solution, certificate, self.stages, max(1, len(begun)), message, seconds, interrupted, spent)

    def _of_all(self, message: str, n_starts: int) -> str:
        """The message of a failure, with what there is to say of all starts."""
        said = [message]
        if len(self.causes) > 1:
            tally = ", ".join(f"{count} × {cause}" for cause, count in Counter(self.causes).most_common())
            said.append(f"of {n_starts} starts: {tally}")
        said.append(self.problem.scaling_hint())
        text = "; ".join(part for part in said if part)
        return text if not self.clock.spent or Status.BUDGET.value in text else f"{Status.BUDGET.value}: {text}"

    def _guessed(self, start: int) -> tuple[Collocation, Tensor]:
        """The collocation of the first stage, and a start's guess projected on it."""
        like = self.bvp.unit
        share = torch.linspace(0.0, 1.0, self.solver.n_segments_of(start) + 1, dtype=like.dtype, device=like.device)
        collocation = Collocation.on_segments(self.discretisation(None), share * self.bvp.final_time)
        if self.smoothable:
            collocation = collocation.with_setting(smoothing=1.0)
        return collocation, project(collocation, self.solver.guess.curve(self.bvp, STREAMS * self.seed + start))

    def _one_start(self, collocation: Collocation, xi: Tensor) -> tuple[Solution | None, str]:
        """Everything between a first guess and a trajectory to be judged; None and why where that fails."""
        stages, message = self._continuation(collocation, xi)
        if not stages:
            self.causes.append("not through the first stages")
            return None, message
        start = stages[-1].curve.knots[0]
        if any(float((start - other).abs().max()) < 1e-5 * float(start.abs().max()) for other in self.refused):
            self.causes.append(SAME)
            return None, ""
        refined, note = self._refined(stages)
        if note:
            self.refused.append(start)
            self.causes.append(note)
        return refined, note

    def _judged(self, candidate: Solution, *, solved: bool) -> tuple[Solution, Certificate]:
        """A candidate with its certificate; what is solved, but not exact enough, is solved once more, finer."""
        judged = certify(candidate, self.solver.tolerances)
        finer = self.solver.refinement.finer() if solved and self.solver.exact and self.solver.refinement else None
        if judged.certified or finer is None:
            return candidate, judged
        with self.clock:
            again, note = self._refine(finer, candidate, None)
        if note:
            return candidate, judged
        closer = certify(again, self.solver.tolerances)
        return (again, closer) if closer.certified else (candidate, judged)

    def _best_stage(self) -> Solution | None:
        """The last stage that is solved and can be trusted, if there is one; one that was cut has to be as good."""
        kept = [(stage, stage.solution) for stage in self.stages if stage.solution is not None]
        best: tuple[StageResult, Solution] | None = None
        for stage, solution in kept:
            solved = stage.norm < self.solver.start_limit and self.trusted(solution)
            if solved and (best is None or not stage.status.cut or stage.norm <= best[0].norm):
                best = stage, solution
        if best is None and kept:
            best = min(kept, key=lambda pair: pair[0].norm)
        return best[1] if best else None

    # -- smoothed stages ---------------------------------------------------------------------------------------------

    def discretisation(self, form: Form | None) -> Discretisation:
        key = form or self.solver.form
        if key not in self.discretisations:
            self.discretisations[key] = self.solver.discretisation(self.bvp, key)
        return self.discretisations[key]

    @property
    def smoothable(self) -> bool:
        return self.bvp.law.jumps

    @property
    def reads_arcs(self) -> bool:
        return self.solver.refinement is not None and self.solver.refinement.reads_arcs

    @property
    def stage_optimizer(self) -> Optimizer:
        """A refinement that reads arcs solves everything anew: digits of the curve it starts from are wasted."""
        solver = self.solver
        return loosened(solver.optimizer, solver.stage_tolerance) if self.reads_arcs else solver.optimizer

    def _continuation(self, collocation: Collocation, xi: Tensor) -> tuple[list[Solution], str]:
        """Walk the schedule from one start; the stages that can be trusted, the sharpest last, or none and why."""
        walk = Walk(self, collocation, xi)
        self.solver.continuation.run(walk)
        walk.arrive()
        return walk.kept, walk.message

    def coarse(self, result: OptimizeResult) -> bool:
        """Whether a stage of large residual is best as it is: nothing is bounded, and the iteration has settled.

        Another start would settle at the same curve; more segments do not.
        """
        return self.solver.exact and self.bvp.law.n_switching == 0 and result.status.stationary

    def trusted(self, solution: Solution) -> bool:
        """Whether the stage's equations hold between the nodes too (a weak form claims its moments only).

        A refinement that reads no arcs off the curve may start from any stage: a coarse one needs more segments.
        """
        refinement = self.solver.refinement
        if refinement is not None and not refinement.reads_arcs:
            return True
        if not isinstance(solution.curve.collocation.discretisation.form, Strong):
            return True
        return solution.off_node_residual <= self.solver.trust * solution.curve.largest_rate

    def blunter(self, stages: Sequence[Solution]) -> Curve | None:
        """The stage before the last, if it was smoothed more."""
        curves = [stage.curve for stage in stages[-2:]]
        return curves[0] if curves[0].smoothing > curves[-1].smoothing else None

    # -- refinement ---------------------------------------------------------------------------------------------------

    def _refined(self, stages: Sequence[Solution]) -> tuple[Solution, str]:
        """The refined solution where the refinement succeeds or improves, else the smoothed one and why.

        It starts from the sharpest stage, and if that fails from the sharpest that had met its tolerance: a stage that
        had not may show other arcs.
        """
        refinement = self.solver.refinement
        if refinement is None:
            return stages[-1], ""
        refined, note = self._refine(refinement, stages[-1], self.blunter(stages))
        if not note or not refinement.reads_arcs or self.clock.spent:
            return refined, note
        solved = [i for i, stage in enumerate(stages) if stage.curve.residual_norm < self.solver.stage_tolerance]
        if solved and solved[-1] < len(stages) - 1:
            stages = stages[: solved[-1] + 1]
            again, other = self._refine(refinement, stages[-1], self.blunter(stages))
            return (refined, note) if other else (again, "")
        return refined, note

    def _refine(self, refinement: Refinement, smoothed: Solution, blunter: Curve | None) -> tuple[Solution, str]:
        """What one refinement makes of a curve, or the curve and why not."""
        name = type(refinement).__name__.lower()
        self.observer.stage_started(name, None, len(self.stages))
        refined = refinement.run(smoothed.curve, self._callback, blunter)
        improved = refined.curve is not smoothed.curve
        for result in refined.rounds:
            if not improved or result is not refined.result:
                self._stage(name, None, result, float("nan"), float("nan"), None)
        solution = self.record(name, refined.curve, refined.result) if improved else smoothed
        if refined.outcome is refinements.Outcome.INTERRUPTED and not self.clock.spent:
            raise _Interrupted
        if refined.outcome is refinements.Outcome.SOLVED or (improved and not refinement.exact):
            return solution, ""
        return smoothed, f"{name}: {refined.message}"

    # -- bookkeeping -------------------------------------------------------------------------------------------------

    def _callback(self, collocation: Collocation, residual: Residual | None = None) -> Callback:
        """Tell the observer of an optimiser's iterations, and end the run when its time is spent."""

        equations = residual or collocation

        def on_iteration(record: Record, xi: Tensor, residual: Tensor) -> None:
            self.observer.iteration(record, _Iterate(collocation, xi, residual, equations))
            if self.clock.spent:
                raise Stop(Status.BUDGET)

        return on_iteration

    def optimise(self, name: str, collocation: Collocation, xi: Tensor, optimizer: Optimizer) -> OptimizeResult:
        self.observer.stage_started(name, collocation.smoothing or None, len(self.stages))
        measured = self.measurements
        residual: Residual = collocation if measured is None else Measured(collocation, measured)
        told = self._callback(collocation, residual)
        if self.journal is None:
            result = optimizer.run(residual, xi, told)
        else:
            result = self.journal.run(optimizer, residual, xi, told, self.clock.add)
        if result.status is Status.INTERRUPTED:
            self.record(name, Curve(collocation, result.xi), result)
            raise _Interrupted
        return result

    def record(self, name: str, curve: Curve, result: OptimizeResult) -> Solution:
        solution = Solution(curve)
        self._stage(
            name,
            curve.smoothing or None,
            result,
            solution.off_node_residual,
            float(curve.collocation.cost(curve.xi)),
            solution,
        )
        return solution

    def _stage(
        self,
        name: str,
        smoothing: float | None,
        result: OptimizeResult,
        off_node_residual: float,
        cost: float,
        solution: Solution | None,
    ) -> None:
        stage = StageResult(
            name=name,
            smoothing=smoothing,
            status=result.status,
            norm=float(result.norm),
            n_iterations=result.n_iterations,
            n_residuals=result.n_residuals,
            n_linearisations=result.n_linearisations,
            cpu_seconds=result.cpu_seconds,
            off_node_residual=off_node_residual,
            cost=cost,
            records=result.records,
            start=self.start,
            solution=solution,
        )
        self.stages.append(stage)
        self.observer.stage_ended(stage)


def _better(one: Certificate, other: Certificate) -> bool:
    """Certified before not, then cheaper; of two that are not, the one found first stays."""
    if one.certified != other.certified:
        return one.certified
    return one.certified and one.cost < other.cost
