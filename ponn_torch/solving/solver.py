"""The solver: all choices between a problem and its certified solution, and the one call.

start → continuation in the smoothing on a single domain (or fixed segments) → split at the switches → certificate. A
start that fails is recognised early and the next one is tried; whatever was computed is kept and reported.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import torch

from ponn_torch.ansatz.basis import Chebyshev, FreeFunction
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Optimizer, Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.discretisation import Discretisation, Form, Strong, discretise
from ponn_torch.optimal_control.fingerprint import fingerprint
from ponn_torch.optimal_control.measurements import MeasurementFile, Measurements
from ponn_torch.optimal_control.problem import OptimalControlProblem, nearest
from ponn_torch.solving.certificate import Tolerances
from ponn_torch.solving.continuation import Ladder, Schedule
from ponn_torch.solving.guess import Alternating, Guess, RandomGuess
from ponn_torch.solving.journal import Journal
from ponn_torch.solving.observer import Observer, SilentObserver
from ponn_torch.solving.paths import PolarTransfer
from ponn_torch.solving.predictor import PREDICTORS
from ponn_torch.solving.refinement import Refinement
from ponn_torch.solving.result import SolveResult
from ponn_torch.solving.run import Run
from ponn_torch.solving.split import Split
from ponn_torch.solving.stages import Stages


def _default_optimizer() -> Optimizer:
    return LevenbergMarquardt(
        Stopping(tolerance=1e-9, decrease=1e-2, patience=2, max_iterations=150, hopeless=0.1, hopeless_after=60),
        ahead=True,
    )


def _default_guess() -> Guess:
    """None is right for all: U(0, 1) suits transfers and landings, N(0, 1) costates that change sign."""
    return Alternating((RandomGuess(), RandomGuess("normal"), PolarTransfer((0, 1))))


@dataclass(frozen=True)
class Solver:
    """All choices of a solve; every part can be exchanged.

    Attributes:
        basis: free function of the smoothed stages: a basis (its size is the number of neurons per chain) or a network.
        node_kind, n_nodes: collocation points per segment. form: strong or weak residual.
        coarse: share of the neurons and nodes that the first start is tried with before all, where it only leads to a
            refinement. For polynomials and strong residuals.
        n_segments: fixed segments of the smoothed stages, or of each start's in turn: where one polynomial does not
            follow the solution, pieces may.
        optimizer, continuation, guess: of the smoothed stages. refinement: None to stop at the smoothed solution.
        n_starts: starts to try at most; one that begins as another did is passed over.
        n_certified: stop at this many certified extremals and keep the cheapest; several extremals are real.
        start_limit: ‖r‖ above which a first stage has failed, and at the next smoothing the start; where nothing is
            smoothed and the iteration has settled, it is the ansatz that is too coarse, and the refinement goes on
            from there.
        predictor: where a stage begins that follows another: ``tangent`` to the solutions, of ansätze whose weights are
            linear, or ``none``, where the other ended.
        warm_damping: first damping of a stage that starts from the one before, if the optimiser asks for more.
        stage_tolerance: ‖r‖ at which a stage ends that only leads to a refinement, if the optimiser asks for less.
        trust: a stage is kept while its off-node residual is below this fraction of the largest rate; below the
            resolution of the nodes the residual between them gives a broken stage away.
        data: measurements that join the smoothed stages' residual; a refinement solves the problem as stated.
        dtype: float64, or float32 where no refinement is to be certified.
        cpu_seconds: budget of the whole solve, certificates apart; what there is when it is spent is kept.
    """

    basis: FreeFunction = field(default_factory=lambda: Chebyshev(30))
    node_kind: str = "legendre_gauss"
    n_nodes: int = 60
    form: Form = field(default_factory=Strong)
    conditioning: str = "columns"
    coarse: float = 0.6
    n_segments: int | Sequence[int] = (1, 1, 4, 1, 1, 4, 4, 4, 4)
    optimizer: Optimizer = field(default_factory=_default_optimizer)
    continuation: Schedule = field(default_factory=lambda: Ladder((1.0, 0.3, 0.1, 0.03)))
    refinement: Refinement | None = field(default_factory=Split)
    guess: Guess = field(default_factory=_default_guess)
    n_starts: int = 12
    n_certified: int = 1
    start_limit: float = 0.1
    predictor: str = "tangent"
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
        for name in ("n_nodes", "n_starts", "n_certified"):
            value = getattr(self, name)
            if value < 1:
                raise ValueError(f"{name} = {value}; allowed: at least 1")
        if not callable(getattr(type(self.guess), "curve", None)):
            given = type(self.guess).__name__
            raise ValueError(
                f"guess = {given}; allowed: what has curve(bvp, seed); Restart(solution) begins with a solution"
            )
        if not self._pieces or min(self._pieces) < 1:
            raise ValueError(f"n_segments = {self.n_segments}; allowed: at least 1, or a list of such numbers")
        if self.predictor not in PREDICTORS:
            raise ValueError(f"predictor = {self.predictor!r}; {nearest(self.predictor, PREDICTORS)}")
        if not 0 < self.coarse <= 1:
            raise ValueError(f"coarse = {self.coarse}; allowed: above 0, to 1")
        if not self.warm_damping >= 0:
            raise ValueError(f"warm_damping = {self.warm_damping}; allowed: a number ≥ 0")
        if self.dtype != torch.float64 and self.exact:  # whose rounds end far below the round-off of float32
            name, refinement = str(self.dtype).removeprefix("torch."), type(self.refinement).__name__
            allowed = "float64, or float32 with refinement = None"
            raise ValueError(f"dtype = {name} with refinement = {refinement}; allowed: {allowed}")
        if not self.cpu_seconds > 0:
            raise ValueError(f"cpu_seconds = {self.cpu_seconds}; allowed: a positive number")

    @property
    def _pieces(self) -> Sequence[int]:
        return [self.n_segments] if isinstance(self.n_segments, int) else self.n_segments

    def n_segments_of(self, start: int) -> int:
        """Fixed segments of a start's smoothed stages."""
        return self._pieces[start % len(self._pieces)]

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

        Raises:
            ForeignJournal: a journal of another solve, before anything is computed.
        """
        return Run(Stages(self, problem, seed, observer or SilentObserver(), journal)).result()

    def determined_by(self, problem: OptimalControlProblem, seed: int) -> dict[str, str]:
        """A digest of everything that a solve's result depends on, by name: all but the budget."""
        basis = [type(self.basis), self.basis.arguments, self.basis.state_dict()]
        settings = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "cpu_seconds"}
        values = {"problem": problem, "seed": seed, **settings, "basis": basis}
        return {name: fingerprint(value) for name, value in values.items()}

    def coarsens(self, form: Form) -> bool:
        """Whether the first start is tried with few neurons and nodes."""
        leads_on = self.refinement is not None and self.refinement.reads_arcs
        return leads_on and isinstance(form, Strong) and self.basis.coarser(self.coarse) is not self.basis

    def discretisation(
        self, bvp: BoundaryValueProblem, form: Form | None = None, *, coarse: bool = False
    ) -> Discretisation:
        """That of the smoothed stages; the coarse one may be the same."""
        like, form, basis, n_nodes = bvp.unit, form or self.form, self.basis, self.n_nodes
        if coarse and self.coarsens(form):
            basis, n_nodes = basis.coarser(self.coarse), max(1, round(self.coarse * n_nodes))
        nodes = make_nodes(self.node_kind, n_nodes, dtype=like.dtype, device=like.device)
        return discretise(bvp, basis, nodes, form, self.conditioning)
