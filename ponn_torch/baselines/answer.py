"""What a direct method found, in the user's units, and its way into the indirect solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ponn_torch.baselines.transcription import Answer, Program
from ponn_torch.numerics.nodes import interpolation_matrix
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_set import INTERIOR, Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.solving.guess import ScaledCurve, project
from ponn_torch.solving.refinement import Refined
from ponn_torch.solving.solution import ARC_LABELS
from ponn_torch.solving.split import Split


@dataclass(frozen=True, eq=False)
class DirectSolution:
    """An answer of a nonlinear program.

    Attributes:
        solved: whether IPOPT met its tolerances and, with arcs, S agrees with them; ``status`` in words.
        n_iterations, cpu_seconds: of IPOPT, all stages and rounds. build_seconds: of making the programs.
    """

    program: Program
    answer: Answer
    solved: bool
    status: str
    n_iterations: int
    cpu_seconds: float
    build_seconds: float

    @property
    def problem(self) -> OptimalControlProblem:
        return self.program.problem

    @property
    def cost(self) -> float:
        return self.answer.cost * self.problem.unit("cost")

    @property
    def _node_times(self) -> Tensor:
        return torch.from_numpy(self.program.node_times(self.answer.point.durations))

    @property
    def times(self) -> Tensor:
        """(N + 1,) s: the start and the Radau points."""
        return self._node_times * self.problem.unit("time")

    @property
    def final_time(self) -> float:
        return float(self.times[-1])

    @property
    def switch_times(self) -> list[float]:
        """s: where one phase gives way to the next."""
        return (np.cumsum(self.answer.point.durations)[:-1] * self.problem.unit("time")).tolist()

    @property
    def arcs(self) -> list[str]:
        """Labels of the pinned phases, ``free`` of what is left to the program there; [] of an unstructured answer."""
        labels = {**ARC_LABELS, INTERIOR: "free"}
        codes = [phase.codes for phase in self.program.phases if phase.codes is not None]
        return [",".join(labels[code] for code in row) for row in codes]

    @property
    def _states(self) -> Tensor:
        return torch.from_numpy(self.answer.point.states * self.program.state_unit)

    @property
    def _costates(self) -> Tensor:
        return torch.from_numpy(self.answer.costates * self.problem.unit("cost") / self.program.state_unit)

    @property
    def states(self) -> dict[str, Tensor]:
        """name → (N + 1, size)."""
        return {name: self._states[:, s] for name, s in self.problem.slices.items()}

    @property
    def costates(self) -> dict[str, Tensor]:
        """name → (N, size), from the multipliers at the Radau points ``times[1:]``."""
        return {name: self._costates[:, s] for name, s in self.problem.slices.items()}

    @property
    def control(self) -> dict[str, Tensor]:
        """name → (N, size) at the Radau points."""
        return self.program.variables.controls(torch.from_numpy(self.answer.point.controls))

    def curve(self, bvp: BoundaryValueProblem) -> ScaledCurve:
        """w at any scaled times: the polynomials of the collocation, those of the costates through d points."""
        d, times, x, costates = self.program.degree, self._node_times, self._states, self._costates
        points = torch.from_numpy(np.concatenate([[0.0], self.program.rule.points]))
        knots = times[::d].contiguous()

        def curve(t: Tensor) -> Tensor:
            index = torch.searchsorted(knots[1:-1].contiguous(), t.contiguous(), right=True)
            w = t.new_zeros(len(t), bvp.dimension)
            for k in index.unique().tolist():
                here = index == k
                share = (t[here] - knots[k]) / (knots[k + 1] - knots[k])
                state = interpolation_matrix(points, share) @ x[k * d : k * d + d + 1]
                costate = interpolation_matrix(points[1:], share) @ costates[k * d : (k + 1) * d]
                w[here] = bvp.to_scaled(state, costate)
            return w

        return curve

    def refined(self, split: Split | None = None) -> Refined:
        """The indirect split from here: its curve makes a ``Solution``, to be flown and certified."""
        split, bvp = split or Split(), pontryagin(self.problem)
        times = self._node_times[:: self.program.degree].contiguous()
        parameters = {name: times.new_tensor(value) for name, value in self.problem.parameters.items()}
        codes = [p.codes for p in self.program.phases for _ in range(p.n_segments)]
        # where phases do not say all of them the arcs are read off S
        told = len(bvp.law.jumping) == bvp.law.n_bounded > 0 and None not in codes
        setting = Setting(Regime(arcs=torch.tensor(codes) if told else None), parameters)
        collocation = Collocation.on_segments(split.discretisation(bvp), times, setting=setting)
        return split.run(Curve(collocation, project(collocation, self.curve(bvp))))
