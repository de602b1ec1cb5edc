"""Direct collocation: the same problems as a nonlinear program (CasADi, IPOPT), no minimum principle put in.

``Unstructured`` finds a control on an even mesh. ``TwoStage`` reads the arcs off such an answer, gives each a phase
with the control pinned and an unknown duration, and so finds the switch times to the precision of the collocation;
S from the multipliers is then held against the arcs, and the phases are repaired where it disagrees. Both share with
the indirect solver the statement of the problem only, which makes them independent witnesses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ponn_torch.baselines.answer import DirectSolution
from ponn_torch.baselines.transcription import Answer, Array, PathConstraints, Phase, Point, Program
from ponn_torch.optim.base import Stopwatch
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.control_set import INTERIOR, LOWER, UPPER, ControlSet, Regime
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.solving.guess import Guess

Codes = tuple[int, ...]


# -- first guesses -----------------------------------------------------------------------------------------------------


def straight(program: Program) -> Point:
    """States on a line between what is known of both ends; controls in the middle of their ranges."""
    problem, units = program.problem, program.state_unit
    ends = [problem.boundary("initial"), problem.boundary("final")]
    start, end = (
        np.array(
            [a if a is not None else b if b is not None else unit for a, b, unit in zip(*pair, units, strict=True)]
        )
        for pair in (ends, ends[::-1])
    )
    return _along(program, lambda share: (start + share[:, None] * (end - start)) / units)


def guessed(program: Program, guess: Guess, seed: int = 0) -> Point:
    """States along a guess of the indirect solver; controls in the middle of their ranges."""
    problem = program.problem
    bvp = pontryagin(problem, mass_variable="mass", chains=False)
    curve = guess.curve(bvp, seed)

    def states(share: Array) -> Array:
        x = bvp.to_physical(curve(torch.from_numpy(share) * bvp.final_time))[0].numpy() / program.state_unit
        if problem.mass is not None:
            mass = problem.slices[problem.mass].start
            x[:, mass] = np.maximum(x[:, mass], 0.1)
        return x

    return _along(program, states)


def _along(program: Program, states: Callable[[Array], Array]) -> Point:
    segments = np.array([phase.n_segments for phase in program.phases])
    durations = program.problem.time_guess / program.problem.unit("time") * segments / segments.sum()
    times = program.node_times(durations)
    controls = np.tile(program.variables.start, (program.n_nodes, 1))
    return Point(durations, states(times / times[-1]), controls)


# -- the two methods ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Unstructured:
    """One phase, an even mesh, the control free at every node.

    Attributes:
        guess: a guess of the indirect solver for the states; a straight line where it is None.
        softening: see ``control_variables``; the answer's cost is too good by about this fraction of its thrust.
        path_constraints: see ``Program``.
    """

    n_segments: int = 40
    degree: int = 2
    guess: Guess | None = None
    softening: float = 1e-4
    path_constraints: PathConstraints | None = None
    options: dict[str, Any] = field(default_factory=dict)

    def solve(self, problem: OptimalControlProblem) -> DirectSolution:
        """An answer, whose ``solved`` says whether it is one.

        Raises:
            ImportError: no CasADi. TypeError, ValueError: a problem that it cannot be told of.
        """
        phases = (Phase(self.n_segments),)
        program = Program(
            problem,
            phases,
            self.degree,
            self.softening,
            path_constraints=self.path_constraints,
            options=self.options,
        )
        build = program.build()
        watch = Stopwatch()
        answer = program.solve(straight(program) if self.guess is None else guessed(program, self.guess))
        return _solution(program, answer, answer.n_iterations, watch.seconds, build)


@dataclass(frozen=True)
class TwoStage:
    """Arcs from an unstructured answer, then a pinned phase of unknown duration for each.

    A component that H is convex in is left free between its bounds on every phase: where it reaches one inside a phase,
    the answer is as exact as the mesh. Where nothing jumps there are no arcs to pin, and the first stage answers.

    Attributes:
        first: the unstructured stage. n_segments, degree: of the second, all phases together.
        max_rounds: how often the phases may be repaired.
        new_arc: duration of an arc that S asks for, as a fraction of the time. The zeros of S belong to the wrong arcs,
            so they say where one is missing, not how long it is; short ones grow.
        sign_tolerance: of S, below which its sign is not held against an arc.
    """

    first: Unstructured = field(default_factory=Unstructured)
    n_segments: int = 8
    degree: int = 9
    max_rounds: int = 6
    new_arc: float = 5e-3
    sign_tolerance: float = 1e-7
    options: dict[str, Any] = field(
        default_factory=lambda: {"mu_init": 1e-6, "bound_push": 1e-6, "bound_frac": 1e-6, "tol": 1e-12}
    )

    def solve(self, problem: OptimalControlProblem) -> DirectSolution:
        """The last round's answer; ``solved`` says whether IPOPT was content and S agrees with every arc."""
        best = self.first.solve(problem)
        bvp = pontryagin(problem, mass_variable="mass", chains=False)
        if not best.solved or not bvp.law.jumps:
            return best
        iterations, seconds, build = best.n_iterations, best.cpu_seconds, best.build_seconds
        codes, durations = _arcs_by_fraction(best, bvp.law)
        for _ in range(self.max_rounds):
            program = self._program(problem, codes, durations)
            build += program.build()
            watch = Stopwatch()
            answer = program.solve(_transferred(best, program, durations))
            best = _solution(program, answer, iterations + answer.n_iterations, seconds + watch.seconds, build)
            if not answer.solved:
                return best
            asked, new = self._repaired(best)
            iterations, seconds = best.n_iterations, seconds + watch.seconds
            if asked == codes:
                return best
            codes, durations = asked, new
        return replace(best, solved=False, status="S and the arcs still disagreed after the last round")

    def _program(self, problem: OptimalControlProblem, codes: list[Codes], durations: Array) -> Program:
        counts = np.maximum(1, np.round(self.n_segments * durations / durations.sum())).astype(int)
        phases = [Phase(int(count), code) for count, code in zip(counts, codes, strict=True)]
        return Program(problem, tuple(phases), self.degree, options=self.options)

    def _repaired(self, found: DirectSolution) -> tuple[list[Codes], Array]:
        """Phases without those that shrank to nothing or, if none did, with short ones where S has the other sign."""
        program, durations = found.program, found.answer.point.durations
        codes = [phase.codes for phase in program.phases if phase.codes is not None]
        alive = durations > 2 * program.shortest * durations.sum()
        if not alive.all():
            return _merged([c for c, live in zip(codes, alive, strict=True) if live], durations[alive])
        t, s, asked = _switching(found)
        ends = torch.from_numpy(np.cumsum(durations))
        phase = torch.searchsorted(ends[:-1].contiguous(), t.contiguous(), right=True)
        wrong = (asked != torch.tensor(codes)[phase]) & (s.abs() > self.sign_tolerance)
        if not bool(wrong.any()):
            return codes, durations
        row, component = divmod(int((s.abs() * wrong).argmax()), s.shape[-1])
        k, length = int(phase[row]), self.new_arc * float(durations.sum())
        code = list(codes[k])
        code[component] = int(asked[row, component])
        start = float(ends[k]) - float(durations[k])
        middle = min(max(float(t[row]) - 0.5 * length, start), float(ends[k]) - length)
        pieces = [(codes[k], middle - start), (tuple(code), length), (codes[k], float(ends[k]) - middle - length)]
        pieces = [piece for piece in pieces if piece[1] > 1e-3 * length]
        new = [
            *zip(codes[:k], durations[:k], strict=True),
            *pieces,
            *zip(codes[k + 1 :], durations[k + 1 :], strict=True),
        ]
        return _merged([c for c, _ in new], np.array([d for _, d in new]))


def _merged(codes: list[Codes], durations: Array) -> tuple[list[Codes], Array]:
    """Neighbours of one kind as one phase."""
    starts = [i for i, code in enumerate(codes) if i == 0 or code != codes[i - 1]]
    return [codes[i] for i in starts], np.add.reduceat(durations, starts)


def _solution(program: Program, answer: Answer, iterations: int, seconds: float, build: float) -> DirectSolution:
    return DirectSolution(program, answer, answer.solved, answer.status, iterations, seconds, build)


# -- from one program to the next ------------------------------------------------------------------------------------


def _arcs_by_fraction(solution: DirectSolution, law: ControlSet) -> tuple[list[Codes], Array]:
    """Arc codes and scaled durations from the mean of the control over every segment of an unstructured answer.

    Components that do not jump are left to the program on every phase, as in the interior.
    """
    program, limits = solution.program, solution.program.variables.free
    bounded = list(program.variables.bounded)
    lower, upper = np.array(limits.lower)[bounded], np.array(limits.upper)[bounded]
    fraction = (solution.answer.point.controls[:, bounded] - lower) / (upper - lower)
    mean = np.einsum("j,kjm->km", program.rule.weights, fraction.reshape(program.n_segments, program.degree, -1))
    arcs = np.where(mean > 0.5, UPPER, LOWER)
    arcs[:, [i for i in range(len(bounded)) if i not in law.jumping]] = INTERIOR
    codes = [tuple(row) for row in arcs.tolist()]
    return _merged(codes, np.full(len(codes), solution.answer.point.durations.sum() / len(codes)))


def _switching(solution: DirectSolution, n_points: int = 4000) -> tuple[Tensor, Tensor, Tensor]:
    """Scaled times (m,), S (m, c) of every component from the multipliers, and the arc codes (m, c) that it asks for.

    Of a component that does not jump S is zero, and its code that of the interior.
    """
    bvp = pontryagin(solution.problem, mass_variable="mass", chains=False)
    t = torch.linspace(0.0, solution.final_time / bvp.time_unit, n_points, dtype=torch.float64)
    p = {name: torch.full_like(t[:, None], value) for name, value in solution.problem.parameters.items()}
    switching = bvp.switching(t[:, None], solution.curve(bvp)(t), Setting(Regime(), p))
    asked, s = bvp.law.arc_codes(switching), switching.new_zeros(len(t), bvp.law.n_bounded)
    codes = torch.full_like(asked, INTERIOR)
    for component, function in bvp.law.jumping.items():
        codes[:, component], s[:, component] = asked[:, component], switching[:, function]
    return t, s, codes


def _transferred(solution: DirectSolution, program: Program, durations: Array) -> Point:
    """States of one answer at the nodes of another program, and controls that minimise H there on the pinned arcs."""
    bvp = pontryagin(solution.problem, mass_variable="mass", chains=False)
    t = torch.from_numpy(program.node_times(durations))
    w = solution.curve(bvp)(t)
    p = {name: torch.full_like(t[1:, None], value) for name, value in solution.problem.parameters.items()}
    arcs = torch.tensor([p.codes for p in program.phases for _ in range(p.n_segments * program.degree)])
    control = bvp.minimiser(t[1:, None], w[1:], Setting(Regime(arcs=arcs), p)).control
    states = bvp.to_physical(w)[0].numpy() / program.state_unit
    return Point(durations, states, program.variables.inverse(control).numpy())
