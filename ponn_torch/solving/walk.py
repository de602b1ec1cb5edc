"""One start on its way down the schedule: what it has solved, and which stages can be trusted."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from torch import Tensor

from ponn_torch.optim.base import NonFiniteResidual, OptimizeResult, Residual, loosened, warm
from ponn_torch.optim.remembering import Remembering
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Form
from ponn_torch.solving.continuation import Outcome
from ponn_torch.solving.predictor import along_tangent
from ponn_torch.solving.sharpening import legible
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.stages import Stages

ENOUGH = 5e-3  # ‖r‖ at which a coarse stage ends
SPARE = 0.25  # of what a coarse stage may miss between its nodes, above which a sharper one would miss too much


@dataclass
class Walk:
    """One start on its way down the schedule: where it stands, and the stages so far that can be trusted.

    norm: ‖r‖ where it stands. equations: what was solved there. n_failed: first stages that failed; until one has not,
    the walk has not begun. form: of the last stage tried.
    """

    stages: Stages
    collocation: Collocation
    xi: Tensor
    kept: list[Solution] = field(default_factory=list)
    message: str = ""
    begun: bool = False
    norm: float = math.inf
    equations: Residual | None = None
    n_failed: int = 0
    form: Form | None = None

    def __call__(self, value: float, parameter: str, form: Form | None, *, hold: bool = False) -> Outcome:
        """Solve one stage from where the walk stands; ``hold``: stay there if it cannot be trusted."""
        stages, smoothed = self.stages, self.stages.bvp.law.jumps or parameter != "smoothing"
        if self.begun and (stages.clock.spent or not smoothed):  # nothing to smooth: one stage is all there is
            return Outcome.ABORT
        self.form = form
        if self.coarse and not stages.solver.coarsens(form or stages.solver.form):
            return Outcome.ABORT
        trial = replace(self.collocation, discretisation=stages.discretisation(form, coarse=self.coarse))
        if smoothed:
            trial = trial.with_setting(**{parameter: value})
        optimizer, xi, equations = stages.optimizer, self.xi, stages.residual(trial)
        if stages.solver.predictor != "none" and len(trial.linear_unknowns) == trial.n_unknowns:
            equations = Remembering(equations)  # of a network that is trained no tangent is known: J leaves many
        if self.coarse:
            optimizer = loosened(optimizer, ENOUGH)
        if self.begun:
            optimizer = warm(optimizer, stages.solver.warm_damping)
            if isinstance(equations, Remembering):
                xi = self._predicted(trial, equations, parameter, value)
        try:
            result = stages.optimise("smooth", trial, equations, xi, optimizer)
        except NonFiniteResidual as error:
            self.message = str(error)
            return Outcome.FAILED if self.begun else Outcome.ABORT
        solution = stages.record("smooth", Curve(trial, result.xi), result)
        # measurements need not fit: what counts are the equations
        norm = float(result.norm if stages.measurements is None else trial.residual(result.xi).norm())
        if norm < stages.solver.start_limit:
            return self._advanced(solution, equations, float(result.norm), hold)
        if self.begun:  # what a coarse stage settles above, a sharper one does too
            return Outcome.ABORT if self.coarse and result.status.stationary else Outcome.FAILED
        return self._not_begun(solution, result, norm, parameter)

    def _predicted(self, trial: Collocation, equations: Residual, parameter: str, value: float) -> Tensor:
        """Where the stage begins: along the tangent from where the walk stands."""
        here = self.collocation.value_of(parameter)
        known = {value: equations}
        if self.equations is not None and self.collocation.discretisation is trial.discretisation:
            known[here] = self.equations

        def residual(at: float) -> Residual:
            return known[at] if at in known else self.stages.residual(trial.with_setting(**{parameter: at}))

        return along_tangent(residual, self.xi, self.norm, here, value, self.stages.solver.warm_damping)

    @property
    def coarse(self) -> bool:
        """Whether it goes with few neurons and nodes, and may end where these do not do."""
        here = self.collocation.discretisation
        return here is not self.stages.discretisation(here.form)

    def arrive(self) -> None:
        """End at the problem as stated: a last stage where the schedule ended at another value of a parameter.

        Stages on the way there solve other problems and are no candidates.
        """
        away = self.collocation.departures()
        for name, (_, stated) in away.items():
            self.kept = self._as_stated()
            self(stated, name, self.form)
        self.kept = self._as_stated()
        if away and not self.kept:
            where = "; ".join(f"{name} = {value:.10g}, stated {stated:.10g}" for name, (value, stated) in away.items())
            self.message = f"the continuation does not reach the problem as stated from {where}"

    def _as_stated(self) -> list[Solution]:
        return [solution for solution in self.kept if not solution.curve.collocation.departures()]

    def _advanced(self, solution: Solution, equations: Residual, norm: float, hold: bool) -> Outcome:
        """A stage that is solved: the walk goes there, and keeps it if it can be trusted."""
        stages, self.begun = self.stages, True
        trusted = stages.trusted(solution)
        if hold and not trusted:
            return Outcome.UNTRUSTED
        xi = solution.curve.xi
        change = float((xi - self.xi).abs().max())
        self.collocation, self.xi, self.norm, self.equations = solution.curve.collocation, xi, norm, equations
        if trusted or not self.kept:
            self.kept.append(solution)
        if not trusted and len(self.kept) == 1:
            self.message = "no stage solves its own problem between the nodes; the first one is kept"
        if change < 1e-6 * float(xi.abs().max()):
            return Outcome.UNCHANGED
        if trusted and stages.reads_arcs and (blunter := stages.blunter(self.kept)):
            if legible(solution.curve, blunter):
                return Outcome.LEGIBLE
            if self.coarse and not stages.trusted(solution, SPARE):
                return Outcome.SHARPEST
            return Outcome.SOLVED
        return Outcome.SOLVED if trusted else Outcome.UNTRUSTED

    def _not_begun(self, solution: Solution, result: OptimizeResult, norm: float, parameter: str) -> Outcome:
        """A first stage that failed; at the next smoothing it is tried once more."""
        stages = self.stages
        if stages.coarse(result):
            self.collocation, self.xi = solution.curve.collocation, result.xi
            self.kept.append(solution)  # what a refinement on segments starts from, if not a solution
            return Outcome.ABORT
        self.message = (
            f"start {stages.start + 1} of seed {stages.seed} failed: ‖r‖ = {norm:.2g} "
            f"after the {('first', 'second')[self.n_failed]} stage ({result.status.value})"
        )
        self.n_failed += 1
        # smoothed less, the problem may have a solution, or one that is nearer to this guess
        again = self.n_failed == 1 and stages.bvp.law.jumps and parameter == "smoothing" and not stages.clock.spent
        again = again and not self.coarse  # with all neurons and nodes, it may have one at once
        return Outcome.FAILED if again else Outcome.ABORT
