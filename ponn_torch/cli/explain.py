"""Why a solve ended without a certificate: evidence from other problems and other methods, or none."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from ponn_torch.baselines.direct import TwoStage, Unstructured
from ponn_torch.baselines.symbolic import load_casadi
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.reporting.style import number, unit
from ponn_torch.solving.feasibility import check_control, check_final_time
from ponn_torch.solving.guess import Alternating, Guess, RandomGuess, ScaledCurve
from ponn_torch.solving.solution import Solution, in_a_row
from ponn_torch.solving.solver import Solver

N_STARTS, N_SEGMENTS = 4, 100  # of the problems that ask what is feasible; of the direct mesh


class _FromSolution:
    """A failed solution as a first guess of another method."""

    def __init__(self, solution: Solution) -> None:
        self.solution = solution

    def curve(self, bvp: BoundaryValueProblem, seed: int) -> ScaledCurve:
        own, curve = self.solution.bvp, self.solution.curve
        stretch = float(curve.times[-1]) / bvp.final_time

        def at(t: Tensor) -> Tensor:
            return bvp.to_scaled(*own.to_physical(curve(t * stretch)))

        return at


def explanation(problem: OptimalControlProblem, solver: Solver, seed: int, solution: Solution | None) -> list[str]:
    """Sentences to add to the message of a failed solve; ``solution`` is what it ended with, if anything."""
    sentences = []
    for check in (check_final_time, check_control):
        found = check(problem, replace(solver, n_starts=N_STARTS), seed)
        if found is not None and found.infeasible:
            return [found.message]
        sentences += [] if found is None else [found.message]
    return [*sentences, *_witness(problem, solver, solution)]


def _witness(problem: OptimalControlProblem, solver: Solver, solution: Solution | None) -> list[str]:
    """What direct collocation says."""
    try:
        load_casadi()
    except ImportError:
        return []
    guess: Guess | None = solver.guess
    if isinstance(guess, RandomGuess | Alternating):
        guess = None if solution is None else _FromSolution(solution)
    try:
        answer = TwoStage(Unstructured(N_SEGMENTS, guess=guess), n_segments=20).solve(problem)
    except (TypeError, ValueError) as error:
        return [f"direct collocation cannot be told of this problem: {error}"]
    if not answer.solved:
        return ["direct collocation finds no trajectory either"]
    cost = number(answer.cost, unit(problem, "cost"), ".8g")
    arcs = f" with arcs {in_a_row(answer.arcs)}" if answer.arcs else ""
    return [f"direct collocation finds a trajectory{arcs}, {problem.cost_name} {cost}"]
