"""One solve: start after start, each through its smoothed stages, the refinement and the certificate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import torch
from torch import Tensor

from ponn_torch.optim.base import OptimizeResult, Status
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.solving import refinement as refinements
from ponn_torch.solving.certificate import Certificate, certify
from ponn_torch.solving.guess import STREAMS, project
from ponn_torch.solving.refinement import Refinement
from ponn_torch.solving.restart import Restart
from ponn_torch.solving.result import SolveResult
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.stages import Interrupted, Stages
from ponn_torch.solving.walk import Walk

SAME = "the same smoothed solution as before"
OVERFLOW = (
    "the equations are finite along no guess, which has states of the order of their units: measure states from where "
    "they begin (altitudes, not radii), or guess a path"
)
NOT_THROUGH = "not through the first stages"
ELSEWHERE = (
    "no start came through its first stages: guess a path (a straight line, say), or set costate_units to the sizes "
    "that costates have"
)
MOST_REPEATS = 3  # starts that lead there, after which others are taken to lead there too


class Run:
    """One solve: start after start until enough are certified."""

    def __init__(self, stages: Stages) -> None:
        self.stages, self.solver, self.clock = stages, stages.solver, stages.clock
        self.refused: list[Tensor] = []  # where smoothed solutions began whose refinement failed
        self.causes: list[str] = []  # why starts failed, in short
        self.guesses: dict[int, tuple[Collocation, Tensor]] = {}  # of starts
        self.tried: set[int] = set()  # starts, without those that are one from before

    # -- the line ------------------------------------------------------------------------------------------------------

    def result(self) -> SolveResult:
        best: tuple[Solution, Certificate] | None = None
        message, verdict, interrupted, n_certified = "", "", False, 0
        try:
            for start in range(self.solver.n_starts):
                if self.causes.count(SAME) >= MOST_REPEATS:
                    break
                with self.clock:
                    candidate, note = self._one_start(start)
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
        except (Interrupted, KeyboardInterrupt):
            interrupted, message = True, "interrupted; the best stage so far is kept"
        if best is not None and best[1].certified and not interrupted:
            message = verdict if n_certified == 1 else f"{verdict}; the cheapest of {n_certified} certified starts"
        spent = self.clock.spent and n_certified < self.solver.n_certified
        if not n_certified and not interrupted:
            message = self._of_all(message)
        solution = best[0] if best else self.stages.best()
        if solution is not None:
            self.stages.observer.solution(solution)
        if best is not None:
            self.stages.observer.certificate(best[1])
        else:
            self.stages.observer.failed(message)
        certificate = best[1] if best else None
        seconds = self.clock.seconds
        n_starts = max(1, len(self.tried))
        return SolveResult(solution, certificate, self.stages.done, n_starts, message, seconds, interrupted, spent)

    def _of_all(self, message: str) -> str:
        """The message of a failure, with what there is to say of all starts."""
        said = [message]
        if len(self.causes) > 1:
            tally = ", ".join(f"{count} × {cause}" for cause, count in Counter(self.causes).most_common())
            said.append(f"of {len(self.tried)} starts: {tally}")
        if self.stages.done and all(stage.status is Status.NON_FINITE for stage in self.stages.done):
            said.append(OVERFLOW)
        elif len(self.causes) >= MOST_REPEATS and set(self.causes) == {NOT_THROUGH}:
            said.append(ELSEWHERE)
        said.append(self.stages.bvp.problem.scaling_hint())
        text = "; ".join(part for part in said if part)
        return text if not self.clock.spent or Status.BUDGET.value in text else f"{Status.BUDGET.value}: {text}"

    def _one_start(self, start: int) -> tuple[Solution | None, str]:
        """Everything between a first guess and a trajectory to be judged; None and why where that fails."""
        self.stages.start = start
        restarted, note = self._restarted()
        if restarted is not None or (note and self.clock.spent):
            self.tried.add(start)
            return restarted, note
        found, cause = None, ""
        for walk in self._walks(start):
            self.tried.add(start)
            self.solver.continuation.run(walk)
            walk.arrive()
            if not walk.kept:
                cause, note = NOT_THROUGH, walk.message
            elif self._led_here_before(walk):
                self.causes.append(SAME)
                return None, ""
            else:
                found, note = self._refined(walk)
                if not note:
                    return found, ""
                cause = note
                if not walk.coarse:
                    self.refused.append(_beginning(walk))
            if self.clock.spent:
                break
        if cause:
            self.causes.append(cause)
        return found, note

    def _led_here_before(self, walk: Walk) -> bool:
        here = _beginning(walk)
        return any(float((here - other).abs().max()) < 1e-5 * float(here.abs().max()) for other in self.refused)

    def _walks(self, start: int) -> Iterator[Walk]:
        """How a start is tried: the first one with few neurons and nodes before all; none if it is one from before."""
        if start == 0 and self.solver.coarsens(self.solver.form):
            yield Walk(self.stages, *self._guessed(start, coarse=True))
        for one in range(start + 1):  # where few were enough, all are asked for now
            if one not in self.guesses:
                self.guesses[one] = self._guessed(one)
        collocation, xi = self.guesses[start]
        if not any(torch.equal(xi, self.guesses[one][1]) for one in range(start)):
            yield Walk(self.stages, collocation, xi)

    def _guessed(self, start: int, *, coarse: bool = False) -> tuple[Collocation, Tensor]:
        """The collocation of the first stage, and a start's guess projected on it."""
        bvp, stream = self.stages.bvp, STREAMS * self.stages.seed + start
        share = torch.linspace(0.0, 1.0, self.solver.n_segments_of(start) + 1, dtype=torch.float64).to(bvp.unit)
        collocation = Collocation.on_segments(self.stages.discretisation(None, coarse=coarse), share * bvp.final_time)
        if bvp.law.jumps:
            collocation = collocation.with_setting(smoothing=1.0)
        return collocation, project(collocation, self.solver.guess.curve(bvp, stream))

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

    def _restarted(self) -> tuple[Solution | None, str]:
        """The arcs of a solution that the first start begins with, refined; None where there are none, or it fails."""
        guess, refinement = self.solver.guess, self.solver.refinement
        if self.stages.start or not isinstance(guess, Restart) or refinement is None or not refinement.reads_arcs:
            return None, ""
        curve = guess.on_its_arcs(self.stages.bvp)
        if curve is None:
            return None, ""
        try:
            refined, note = self._refine(refinement, Solution(curve), None)
        except Interrupted:
            self._keep_unsolved(curve, Status.INTERRUPTED)
            raise
        if note and self.clock.spent:
            self._keep_unsolved(curve, Status.BUDGET)
        return (None, note) if note else (refined, "")

    def _keep_unsolved(self, curve: Curve, status: Status) -> None:
        """What a restart began with, where nothing better was found in time."""
        norm = curve.collocation.residual(curve.xi).norm()
        self.stages.record("restart", curve, OptimizeResult(curve.xi, norm, status))

    # -- refinement ---------------------------------------------------------------------------------------------------

    def _refined(self, walk: Walk) -> tuple[Solution, str]:
        """The refined solution where the refinement succeeds or improves, else the smoothed one and why.

        It starts from the sharpest stage, and if that fails from the sharpest that had met its tolerance: a stage that
        had not may show other arcs. With few neurons and nodes it seldom has, and there will be a walk with all.
        """
        refinement, stages = self.solver.refinement, walk.kept
        if refinement is None:
            return stages[-1], ""
        blunter = self.stages.blunter(stages)
        refined, note = self._refine(refinement.brief() if walk.coarse else refinement, stages[-1], blunter)
        if not note or not refinement.reads_arcs or walk.coarse or self.clock.spent:
            return refined, note
        solved = [i for i, stage in enumerate(stages) if stage.curve.residual_norm < self.solver.stage_tolerance]
        if solved and solved[-1] < len(stages) - 1:
            stages = stages[: solved[-1] + 1]
            again, other = self._refine(refinement, stages[-1], self.stages.blunter(stages))
            return (refined, note) if other else (again, "")
        return refined, note

    def _refine(self, refinement: Refinement, smoothed: Solution, blunter: Curve | None) -> tuple[Solution, str]:
        """What one refinement makes of a curve, or the curve and why not."""
        name = type(refinement).__name__.lower()
        self.stages.observer.stage_started(name, None, len(self.stages.done))
        refined = refinement.run(smoothed.curve, self.stages.callback, blunter)
        improved = refined.curve is not smoothed.curve
        for result in refined.rounds:
            if not improved or result is not refined.result:
                self.stages.note(name, result)
        solution = self.stages.record(name, refined.curve, refined.result) if improved else smoothed
        if refined.outcome is refinements.Outcome.INTERRUPTED and not self.clock.spent:
            raise Interrupted
        if refined.outcome is refinements.Outcome.SOLVED or (improved and not refinement.exact):
            return solution, ""
        return smoothed, f"{name}: {refined.message}"


def _beginning(walk: Walk) -> Tensor:
    """w (2n,) where the sharpest stage begins."""
    return walk.kept[-1].curve.knots[0]


def _better(one: Certificate, other: Certificate) -> bool:
    """Certified before not, then cheaper; of two that are not, the one found first stays."""
    if one.certified != other.certified:
        return one.certified
    return one.certified and one.cost < other.cost
