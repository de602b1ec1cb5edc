"""The stages of a solve: every call of an optimiser, told to an observer, timed, kept, and judged fit to go on from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from ponn_torch.optim.base import Callback, Optimizer, OptimizeResult, Record, Residual, Status, Stop, loosened
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation, Form, Strong
from ponn_torch.optimal_control.measurements import Measured
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.solving.budget import Budget
from ponn_torch.solving.journal import Journal
from ponn_torch.solving.observer import Observer
from ponn_torch.solving.result import StageResult
from ponn_torch.solving.solution import Solution

if TYPE_CHECKING:
    from ponn_torch.solving.solver import Solver


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


class Interrupted(Exception):
    """Ctrl-C reached an optimiser, which gave its best point back."""


class Stages:
    """What a solve has computed so far, and how it computes more: nothing is lost whatever ends it.

    Attributes:
        done: every stage, in the order they ended. start: the one that is tried. clock: the CPU time spent.
    """

    def __init__(
        self,
        solver: Solver,
        problem: OptimalControlProblem,
        seed: int,
        observer: Observer,
        journal: Journal | None = None,
    ) -> None:
        self.solver, self.seed, self.observer, self.journal = solver, seed, observer, journal
        self.bvp = pontryagin(problem, mass_variable=solver.mass_variable, dtype=solver.dtype, device=solver.device)
        self.done: list[StageResult] = []
        self.start = 0
        self._discretisations: dict[tuple[Form, bool], Discretisation] = {}
        self.clock = Budget(solver.cpu_seconds)
        if journal is not None:
            journal.belongs_to(solver.determined_by(problem, seed))
        self.measurements = None if solver.data is None else solver.data.of(problem)

    # -- one more ------------------------------------------------------------------------------------------------------

    def discretisation(self, form: Form | None, *, coarse: bool = False) -> Discretisation:
        """That of a form, the solver's where it is None; kept, as to find it among those of other solves takes time."""
        form = form or self.solver.form
        key = form, coarse and self.solver.coarsens(form)
        if key not in self._discretisations:
            self._discretisations[key] = self.solver.discretisation(self.bvp, form, coarse=coarse)
        return self._discretisations[key]

    @property
    def reads_arcs(self) -> bool:
        return self.solver.refinement is not None and self.solver.refinement.reads_arcs

    @property
    def optimizer(self) -> Optimizer:
        """A refinement that reads arcs solves everything anew: digits of the curve it starts from are wasted."""
        solver = self.solver
        return loosened(solver.optimizer, solver.stage_tolerance) if self.reads_arcs else solver.optimizer

    def callback(self, collocation: Collocation, residual: Residual | None = None) -> Callback:
        """Tell the observer of an optimiser's iterations, and end the run when its time is spent."""
        equations = residual or collocation

        def on_iteration(record: Record, xi: Tensor, residual: Tensor) -> None:
            self.observer.iteration(record, _Iterate(collocation, xi, residual, equations))
            if self.clock.spent:
                raise Stop(Status.BUDGET)

        return on_iteration

    def residual(self, collocation: Collocation) -> Residual:
        """What the smoothed stages solve: the equations, and the measurements where there are any."""
        return collocation if self.measurements is None else Measured(collocation, self.measurements)

    def optimise(
        self, name: str, collocation: Collocation, equations: Residual, xi: Tensor, optimizer: Optimizer
    ) -> OptimizeResult:
        """Minimise the residual of ``equations``, which are those of the collocation and may be more."""
        self.observer.stage_started(name, collocation.smoothing or None, len(self.done))
        told = self.callback(collocation, equations)
        if self.journal is None:
            result = optimizer.run(equations, xi, told)
        else:
            result = self.journal.run(optimizer, equations, xi, told, self.clock.add)
        if result.status is Status.INTERRUPTED:
            self.record(name, Curve(collocation, result.xi), result)
            raise Interrupted
        return result

    def record(self, name: str, curve: Curve, result: OptimizeResult) -> Solution:
        """Keep a stage with the curve it ended at."""
        solution = Solution(curve)
        self.note(name, result, solution)
        return solution

    def note(self, name: str, result: OptimizeResult, solution: Solution | None = None) -> None:
        """Keep a stage; without a solution, as one of a refinement's rounds."""
        curve = None if solution is None else solution.curve
        stage = StageResult(
            name=name,
            smoothing=None if curve is None else curve.smoothing or None,
            status=result.status,
            norm=float(result.norm),
            n_iterations=result.n_iterations,
            n_residuals=result.n_residuals,
            n_linearisations=result.n_linearisations,
            cpu_seconds=result.cpu_seconds,
            off_node_residual=math.nan if solution is None else solution.off_node_residual,
            cost=math.nan if curve is None else float(curve.collocation.cost(curve.xi)),
            records=result.records,
            start=self.start,
            solution=solution,
        )
        self.done.append(stage)
        self.observer.stage_ended(stage)

    # -- what they are worth ------------------------------------------------------------------------------------------

    def coarse(self, result: OptimizeResult) -> bool:
        """Whether a stage of large residual is best as it is: nothing is bounded, and the iteration has settled.

        Another start would settle at the same curve; more segments do not.
        """
        return self.solver.exact and self.bvp.law.n_switching == 0 and result.status.stationary

    def trusted(self, solution: Solution, share: float = 1.0) -> bool:
        """Whether the stage's equations hold between the nodes too (a weak form claims its moments only).

        With a ``share`` of what they may miss there.

        A refinement that reads no arcs off the curve may start from any stage: a coarse one needs more segments.
        """
        refinement = self.solver.refinement
        if refinement is not None and not refinement.reads_arcs:
            return True
        if not isinstance(solution.curve.collocation.discretisation.form, Strong):
            return True
        return solution.off_node_residual <= share * self.solver.trust * solution.curve.largest_rate

    def blunter(self, stages: Sequence[Solution]) -> Curve | None:
        """The stage before the last, if it was smoothed more."""
        curves = [stage.curve for stage in stages[-2:]]
        return curves[0] if curves[0].smoothing > curves[-1].smoothing else None

    def best(self) -> Solution | None:
        """The last stage that is solved and can be trusted, if there is one; one that was cut has to be as good."""
        kept = [(stage, stage.solution) for stage in self.done if stage.solution is not None]
        best: tuple[StageResult, Solution] | None = None
        for stage, solution in kept:
            solved = stage.norm < self.solver.start_limit and self.trusted(solution)
            if solved and (best is None or not stage.status.cut or stage.norm <= best[0].norm):
                best = stage, solution
        if best is None and kept:
            best = min(kept, key=lambda pair: pair[0].norm)
        return best[1] if best else None
