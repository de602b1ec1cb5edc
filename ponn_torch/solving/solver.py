"""The conductor: from a problem to a certified solution in one call.

start → continuation in the smoothing on a single domain (or fixed segments) → split at the switches → certificate. A
start that fails is recognised early and the next one is tried; whatever was computed is kept and reported.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ponn_torch.ansatz.basis import Chebyshev, FreeFunction
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import (
    Callback,
    NonFiniteResidual,
    Optimizer,
    OptimizeResult,
    Record,
    Residual,
    Status,
    Stop,
    Stopping,
    Stopwatch,
    loosened,
    warm,
)
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation, Form, Strong, discretise
from ponn_torch.optimal_control.measurements import Measured, MeasurementFile, Measurements
from ponn_torch.optimal_control.pontryagin import BoundaryValueProblem, pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.solving import refinement as refinements
from ponn_torch.solving.certificate import Certificate, Tolerances, certify
from ponn_torch.solving.continuation import Ladder, Outcome, Schedule
from ponn_torch.solving.guess import Guess, RandomGuess, project
from ponn_torch.solving.journal import Journal
from ponn_torch.solving.observer import Observer, SilentObserver, StageResult
from ponn_torch.solving.refinement import Refinement
from ponn_torch.solving.sharpening import legible
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.split import Split


def _default_optimizer() -> Optimizer:
    return LevenbergMarquardt(
        Stopping(tolerance=1e-9, decrease=1e-2, patience=2, max_iterations=150, hopeless=0.1, hopeless_after=60),
        ahead=True,
    )


@dataclass(frozen=True)
class SolveResult:
    """What a solve leaves: the solution and its certificate where there are, every stage, and a sentence."""

    solution: Solution | None
    certificate: Certificate | None
    stages: list[StageResult]
    n_starts: int
    message: str
    cpu_seconds: float
    interrupted: bool = False
    spent: bool = False

    @property
    def certified(self) -> bool:
        return self.certificate is not None and self.certificate.certified


@dataclass(frozen=True)
class Solver:
    """All choices of a solve; every part can be exchanged.

    Attributes:
        basis: free function of the smoothed stages: a basis (its size is the number of neurons per chain) or a network.
        node_kind, n_nodes: collocation points per segment. form: strong or weak residual. n_segments: fixed segments.
        optimizer, continuation, guess: of the smoothed stages. refinement: None to stop at the smoothed solution.
        n_starts: starts to try at most; start i of seed s uses the random stream 1000 s + i. They end early where
            one begins as the first did: a guess with nothing random in it has one start.
        n_certified: stop at this many certified extremals and keep the cheapest; several extremals are real.
        start_limit: ‖r‖ above which a first stage has failed, and at the next smoothing the start; where nothing is
            smoothed and the iteration has settled, it is the ansatz that is too coarse, and the refinement goes on
            from there.
        warm_damping: first damping of a stage that starts from the one before, if the optimiser asks for more.
        stage_tolerance: ‖r‖ at which a stage ends that only leads to a refinement, if the optimiser asks for less.
        trust: a stage is kept while its off-node residual is below this fraction of the largest rate; below the
            resolution of the nodes the residual between them gives a broken stage away.
        data: measurements that join the smoothed stages' residual; a refinement solves the problem as stated.
        cpu_seconds: budget of the whole solve, certificates apart; what there is when it is spent is kept.
    """

    basis: FreeFunction = field(default_factory=lambda: Chebyshev(30))
    node_kind: str = "legendre_gauss"
    n_nodes: int = 60
    form: Form = field(default_factory=Strong)
    conditioning: str = "columns"
    n_segments: int = 1
    optimizer: Optimizer = field(default_factory=_default_optimizer)
    continuation: Schedule = field(default_factory=lambda: Ladder((1.0, 0.3, 0.1, 0.03)))
    refinement: Refinement | None = field(default_factory=Split)
    guess: Guess = field(default_factory=RandomGuess)
    n_starts: int = 10
    n_certified: int = 1
    start_limit: float = 0.1
    warm_damping: float = 1e-5
    stage_tolerance: float = 1e-3
    trust: float = 0.02
    mass_variable: str = "auto"
    data: Measurements | MeasurementFile | None = None
    cpu_seconds: float = math.inf
    tolerances: Tolerances = field(default_factory=Tolerances)
    dtype: torch.dtype = torch.float64
    device: str = "cpu"

    def __post_init__(self) -> None:
        for name in ("n_nodes", "n_segments", "n_starts", "n_certified"):
            value = getattr(self, name)
            if value < 1:
                raise ValueError(f"{name} = {value}; allowed: at least 1")
        if not self.warm_damping >= 0:
            raise ValueError(f"warm_damping = {self.warm_damping}; allowed: a number ≥ 0")
        if not self.cpu_seconds > 0:
            raise ValueError(f"cpu_seconds = {self.cpu_seconds}; allowed: a positive number")

    @property
    def exact(self) -> bool:
        """Whether the result is meant to be certified; a smoothed one shows in its certificate what it is worth."""
        return self.refinement is not None and self.refinement.exact

    def solve(
        self,
        problem: OptimalControlProblem,
        seed: int = 0,
        observer: Observer | None = None,
        journal: Journal | None = None,
    ) -> SolveResult:
        """Solve from random starts of ``seed``; the result's message says what happened, it does not raise.

        A ``journal`` keeps what the smoothed stages computed, or gives it back.
        """
        return _Run(self, problem, seed, observer or SilentObserver(), journal).result()

    def discretisation(self, bvp: BoundaryValueProblem, form: Form | None = None) -> Discretisation:
        like = bvp.unit
        nodes = make_nodes(self.node_kind, self.n_nodes, dtype=like.dtype, device=like.device)
        basis = self.basis.to(dtype=like.dtype, device=like.device)
        return discretise(bvp, basis, nodes, form or self.form, self.conditioning)


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


class Budget:
    """CPU seconds spent inside its ``with`` blocks, and whether they are more than allowed."""

    def __init__(self, allowed: float) -> None:
        self._allowed, self._before, self._watch = allowed, 0.0, Stopwatch()
        self._running = False

    def __enter__(self) -> None:
        self._watch, self._running = Stopwatch(), True

    def __exit__(self, *_: object) -> None:
        self._before, self._running = self.seconds, False

    def add(self, seconds: float) -> None:
        """Count seconds that were spent before."""
        self._before += seconds

    @property
    def seconds(self) -> float:
        return self._before + (self._watch.seconds if self._running else 0.0)

    @property
    def spent(self) -> bool:
        return self.seconds > self._allowed


class _Run:
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
        self.note = ""
        self.clock, self.journal = Budget(solver.cpu_seconds), journal
        self.measurements = None if solver.data is None else solver.data.of(problem)

    # -- the line ------------------------------------------------------------------------------------------------------

    def result(self) -> SolveResult:
        best: tuple[Solution, Certificate] | None = None
        guess: Tensor | None = None
        message, verdict, interrupted, n_certified = "", "", False, 0
        try:
            for start in range(self.solver.n_starts):
                with self.clock:
                    first_stage, xi = self._guessed(start)
                    if guess is not None and torch.equal(xi, guess):
                        break
                    guess = xi if guess is None else guess
                    self.start = start
                    candidate, note = self._one_start(first_stage, xi)
                message = note or message
                if candidate is None:
                    if self.clock.spent:
                        break
                    continue
                judged = certify(candidate, self.solver.tolerances)
                n_certified += judged.certified
                if best is None or _better(judged, best[1]):
                    best, message = (candidate, judged), note or judged.verdict
                    verdict = message
                # a start that came through its stages is the answer where nothing aims at a certificate
                enough = n_certified if self.solver.exact else 1
                if enough >= self.solver.n_certified or self.clock.spent:
                    break
        except (_Interrupted, KeyboardInterrupt):
            interrupted, message = True, "interrupted; the best stage so far is kept"
        if best is not None and best[1].certified and not interrupted:
            message = verdict if n_certified == 1 else f"{verdict}; the cheapest of {n_certified} certified starts"
        spent = self.clock.spent and n_certified < self.solver.n_certified
        if spent and not (best and best[1].certified) and Status.BUDGET.value not in message:
            message = f"{Status.BUDGET.value}: {message}"
        solution = best[0] if best else self._last_stage()
        if solution is not None:
            self.observer.solution(solution)
        if best is not None:
            self.observer.certificate(best[1])
        else:
            self.observer.failed(message)
        certificate = best[1] if best else None
        seconds = self.clock.seconds
        return SolveResult(solution, certificate, self.stages, self.start + 1, message, seconds, interrupted, spent)

    def _guessed(self, start: int) -> tuple[Collocation, Tensor]:
        """The collocation of the first stage, and a start's guess projected on it."""
        like = self.bvp.unit
        share = torch.linspace(0.0, 1.0, self.solver.n_segments + 1, dtype=like.dtype, device=like.device)
        collocation = Collocation.on_segments(self.discretisation(None), share * self.bvp.final_time)
        if self.smoothable:
            collocation = collocation.with_setting(smoothing=1.0)
        return collocation, project(collocation, self.solver.guess.curve(self.bvp, 1000 * self.seed + start))

    def _one_start(self, collocation: Collocation, xi: Tensor) -> tuple[Solution | None, str]:
        """Everything between a first guess and a trajectory to be judged; None and why where that fails."""
        stages, message = self._continuation(collocation, xi)
        if not stages:
            return None, message
        smoothed = stages[-1]
        start = smoothed.curve.knots[0]
        if any(float((start - other).abs().max()) < 1e-5 * float(start.abs().max()) for other in self.refused):
            return None, f"start {self.start + 1} led to the same smoothed solution as one before: {self.note}"
        refined, self.note = self._refined(stages)
        if self.note:
            self.refused.append(start)
        return refined, self.note

    def _last_stage(self) -> Solution | None:
        solutions = [s.solution for s in self.stages if s.solution is not None]
        return solutions[-1] if solutions else None

    # -- smoothed stages ---------------------------------------------------------------------------------------------

    def discretisation(self, form: Form | None) -> Discretisation:
        key = form or self.solver.form
        if key not in self.discretisations:
            self.discretisations[key] = self.solver.discretisation(self.bvp, key)
        return self.discretisations[key]

    @property
    def smoothable(self) -> bool:
        return self.bvp.law.n_switching > 0 and not self.bvp.law.curved

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
        walk = _Walk(self, collocation, xi)
        self.solver.continuation.run(walk)
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
        """The refined solution where the refinement succeeds or improves, else the smoothed one and why."""
        refinement, smoothed = self.solver.refinement, stages[-1]
        if refinement is None:
            return smoothed, ""
        name = type(refinement).__name__.lower()
        self.observer.stage_started(name, None, len(self.stages))
        refined = refinement.run(smoothed.curve, self._callback, self.blunter(stages))
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


@dataclass
class _Walk:
    """One start on its way down the schedule: where it stands, and the stages so far that can be trusted.

    n_failed: first stages that failed; until one has not, the walk has not begun.
    """

    run: _Run
    collocation: Collocation
    xi: Tensor
    kept: list[Solution] = field(default_factory=list)
    message: str = ""
    begun: bool = False
    n_failed: int = 0

    def __call__(self, value: float, parameter: str, form: Form | None, *, hold: bool = False) -> Outcome:
        """Solve one stage from where the walk stands; ``hold``: stay there if it cannot be trusted."""
        run, smoothed = self.run, self.run.smoothable or parameter != "smoothing"
        if self.begun and (run.clock.spent or not smoothed):  # nothing to smooth: one stage is all there is
            return Outcome.ABORT
        trial = replace(self.collocation, discretisation=run.discretisation(form))
        if smoothed:
            trial = trial.with_setting(**{parameter: value})
        optimizer = run.stage_optimizer
        if self.begun:
            optimizer = warm(optimizer, run.solver.warm_damping)
        try:
            result = run.optimise("smooth", trial, self.xi, optimizer)
        except NonFiniteResidual as error:
            self.message = str(error)
            return Outcome.FAILED if self.begun else Outcome.ABORT
        solution = run.record("smooth", Curve(trial, result.xi), result)
        # measurements need not fit: what counts are the equations
        norm = float(result.norm if run.measurements is None else trial.residual(result.xi).norm())
        if norm < run.solver.start_limit:
            return self._advanced(trial, result.xi, solution, hold)
        return Outcome.FAILED if self.begun else self._not_begun(solution, result, norm, parameter)

    def _advanced(self, trial: Collocation, xi: Tensor, solution: Solution, hold: bool) -> Outcome:
        """A stage that is solved: the walk goes there, and keeps it if it can be trusted."""
        run, self.begun = self.run, True
        trusted = run.trusted(solution)
        if hold and not trusted:
            return Outcome.UNTRUSTED
        change = float((xi - self.xi).abs().max())
        self.collocation, self.xi = trial, xi
        if trusted or not self.kept:
            self.kept.append(solution)
        if not trusted and len(self.kept) == 1:
            self.message = "no stage solves its own problem between the nodes; the first one is kept"
        if change < 1e-6 * float(xi.abs().max()):
            return Outcome.UNCHANGED
        if trusted and run.reads_arcs and (blunter := run.blunter(self.kept)):
            return Outcome.LEGIBLE if legible(solution.curve, blunter) else Outcome.SOLVED
        return Outcome.SOLVED if trusted else Outcome.UNTRUSTED

    def _not_begun(self, solution: Solution, result: OptimizeResult, norm: float, parameter: str) -> Outcome:
        """A first stage that failed; at the next smoothing it is tried once more."""
        run = self.run
        if run.coarse(result):
            self.kept.append(solution)  # what a refinement on segments starts from, if not a solution
            return Outcome.ABORT
        self.message = (
            f"start {run.start + 1} of seed {run.seed} failed: ‖r‖ = {norm:.2g} "
            f"after the {('first', 'second')[self.n_failed]} stage ({result.status.value})"
        )
        self.n_failed += 1
        # smoothed less, the problem may have a solution, or one that is nearer to this guess
        again = self.n_failed == 1 and run.smoothable and parameter == "smoothing" and not run.clock.spent
        return Outcome.FAILED if again else Outcome.ABORT


def _better(one: Certificate, other: Certificate) -> bool:
    """Certified before not, then cheaper; of two that are not, the one found first stays."""
    if one.certified != other.certified:
        return one.certified
    return one.certified and one.cost < other.cost
