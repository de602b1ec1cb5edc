"""A start from what is solved already: the same problem with other ends, times, bounds or parameters."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Strong, discretise
from ponn_torch.optimal_control.pontryagin import with_singular_arcs
from ponn_torch.solving.guess import STREAMS, Guess, RandomGuess, ScaledCurve, project
from ponn_torch.solving.solution import SOLUTION, Solution


@dataclass(frozen=True)
class Restart:
    """The first start is a solution, stretched to the new final time; further ones come from another guess.

    Where the solution has arcs these are refined as they are, before anything is smoothed; what they do not solve is
    solved from the solution's states and costates as from any other guess.

    Attributes:
        solution: a solution, or the folder of a run; what ``Solution.save`` wrote of a problem that is not made by a
            reference is loaded with its problem first.
        otherwise: the guess of all starts but the first.
    """

    solution: Solution | str | Path
    otherwise: Guess = field(default_factory=RandomGuess)

    def __post_init__(self) -> None:
        given: object = self.solution
        if not isinstance(given, Solution | str | Path):
            raise ValueError(f"guess.solution = {type(given).__name__}; allowed: a Solution, or the folder of a run")

    @cached_property
    def _solved(self) -> Solution:
        if isinstance(self.solution, Solution):
            return self.solution
        folder = Path(self.solution)
        inner = folder / SOLUTION
        try:
            return Solution.load(inner if inner.is_dir() else folder)
        except FileNotFoundError as error:
            allowed = "the folder of a run or a solution"
            raise ValueError(f"guess.solution = {str(self.solution)!r}; allowed: {allowed}") from error

    def curve(self, bvp: BoundaryValueProblem, seed: int) -> ScaledCurve:
        return self.otherwise.curve(bvp, seed) if seed % STREAMS else self._stretched(bvp, bvp.final_time)

    def _stretched(self, bvp: BoundaryValueProblem, final_time: float) -> ScaledCurve:
        """States and costates of the solution in the problem's scaling, over [0, final_time].

        Raises:
            ValueError: a solution of other states.
        """
        solved = self._solved
        found, allowed = dict(solved.problem.states), dict(bvp.problem.states)
        if found != allowed:
            raise ValueError(f"guess.solution: states = {found}; allowed: {allowed}, those of {bvp.problem.name}")
        stretch = float(solved.curve.times[-1]) / final_time

        def curve(t: Tensor) -> Tensor:
            w = solved.curve((stretch * t).to(solved.curve.xi).flatten()).view(*t.shape, -1)
            return bvp.to_scaled(*(value.to(bvp.unit) for value in solved.bvp.to_physical(w)))

        return curve

    def on_its_arcs(self, bvp: BoundaryValueProblem) -> Curve | None:
        """The solution on the same segments of the new problem, not solved yet; None if it has no arcs.

        A free final time starts where it was found.
        """
        made = self._solved.curve.collocation
        arcs, disc = made.setting.regime.arcs, made.discretisation
        if arcs is None or made.bvp.law.levels != bvp.law.levels:
            return None
        times = self._solved.curve.times.to(bvp.unit) * (made.bvp.time_unit / bvp.time_unit)
        if not bvp.problem.free_final_time:
            end = times.new_tensor([bvp.final_time])  # to the last digit, as it is stated
            times = torch.cat([times[:-1] * (bvp.final_time / float(times[-1])), end])
        bvp = with_singular_arcs(bvp, made.bvp.singular)
        nodes = make_nodes("legendre_gauss", len(disc.nodes), dtype=bvp.unit.dtype, device=bvp.unit.device)
        collocation = Collocation.on_segments(
            discretise(bvp, disc.basis, nodes, Strong(), disc.conditioning),
            times,
            events=made.events,
            setting=Setting(Regime(arcs=arcs.to(bvp.unit.device))),
        )
        return Curve(collocation, project(collocation, self._stretched(bvp, float(times[-1]))))
