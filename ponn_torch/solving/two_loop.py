"""The papers' two loops: an inner least squares at given switch times, an outer solver for the times.

With wrong times the inner problem has no solution (the direction of the thrust alone cannot meet all end conditions),
so the inner loop leaves a residual and the outer one makes it vanish (TFC paper, section V). Every outer evaluation,
and every column of its finite-difference Jacobian, is a whole inner solve; ``Split`` solves for all of it at once. Here
for comparison: the arcs are those found at first, and are not repaired.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from ponn_torch.optim.base import Callback, OptimizeResult, Record, Status
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.restricted import Restricted
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.solving.guess import project
from ponn_torch.solving.refinement import MakeCallback, Outcome, Refined, Refinement, Segmentation
from ponn_torch.solving.switching import find_structure


@dataclass(frozen=True)
class TwoLoop(Segmentation, Refinement):
    """One constrained expression per arc; SciPy's ``least_squares`` outside, on switch times and a free final time.

    ``n_neurons`` and ``n_nodes`` are per arc, which is never cut. ``max_rounds`` bounds the inner solves.
    """

    n_neurons: int = 30
    n_nodes: int = 44
    max_rounds: int = 200

    def run(self, start: Curve, callback: MakeCallback | None = None, blunter: Curve | None = None) -> Refined:
        structure, parameters = find_structure(start), start.collocation.setting.parameters
        collocation = Collocation.on_segments(
            self.discretisation(start.collocation.bvp),
            torch.cat([start.times[:1], structure.times, start.times[-1:]]),
            events=structure.events,
            setting=Setting(Regime(arcs=structure.arcs if structure.arcs.numel() else None), parameters),
        )
        loops = _Loops(self, collocation, project(collocation, start), callback(collocation) if callback else None)
        try:
            loops.solve()
        except _Ended as ended:
            return Refined(Curve(collocation, loops.xi), ended.outcome, loops.rounds)
        except KeyboardInterrupt:
            return Refined(Curve(collocation, loops.xi), Outcome.INTERRUPTED, loops.rounds)
        curve = Curve(collocation, loops.xi)
        if not find_structure(curve).same_arcs(structure):
            return Refined(curve, Outcome.STRUCTURE, loops.rounds)
        return Refined(curve, Outcome.COARSE if bool(self.coarse(curve).any()) else Outcome.SOLVED, loops.rounds)


class _Ended(Exception):
    """The outer iteration cannot, or need not, go on."""

    def __init__(self, outcome: Outcome) -> None:
        self.outcome = outcome


class _Loops:
    """Both loops of one run; ``xi`` holds the best point so far, from which the next inner solve starts."""

    def __init__(self, method: TwoLoop, collocation: Collocation, xi: Tensor, callback: Callback | None) -> None:
        self.method, self.collocation, self.xi, self.callback = method, collocation, xi, callback
        self.rounds: list[OptimizeResult] = []
        first = collocation.n_weights + len(collocation.free_knots)
        self.times = torch.arange(first, first + len(collocation.free_times), device=xi.device)
        others = torch.ones(len(xi), dtype=torch.bool, device=xi.device)
        others[self.times] = False
        self.others = others.nonzero()[:, 0]

    def solve(self) -> None:
        """Leave in ``xi`` the times, and all else at them, where the residual vanishes.

        Raises:
            _Ended: it does not.
        """
        start = self.xi[self.times].cpu().numpy()
        if len(start):
            found = least_squares(self._residual, start, method="trf", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        else:
            found = start
        self._residual(found)
        if not self.method.solved(self.rounds[-1]):
            raise _Ended(Outcome.RESIDUAL)

    def _residual(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the inner least squares leaves at these times."""
        if len(self.rounds) >= self.method.max_rounds:
            raise _Ended(Outcome.RESIDUAL)
        trial = self.xi.index_copy(0, self.times, self.xi.new_tensor(times))
        residual = self.collocation.residual(trial)
        if not bool(residual.isfinite().all()):
            if not self.rounds:
                raise _Ended(Outcome.RESIDUAL)
            return residual.cpu().numpy()  # arcs out of order: a step that SciPy will shorten
        inner = Restricted(self.collocation, self.others, trial)
        optimizer = LevenbergMarquardt(
            self.method.stopping, damping=self.method.damping, linear_solver=self.method.linear_solver
        )
        result = optimizer.run(inner, inner.start, self._callback(inner))
        self.rounds.append(result)
        if result.status is Status.INTERRUPTED:
            raise _Ended(Outcome.INTERRUPTED)
        self.xi = inner.full(result.xi)
        return self.collocation.residual(self.xi).cpu().numpy()

    def _callback(self, inner: Restricted) -> Callback | None:
        outside = self.callback
        if outside is None:
            return None

        def on_iteration(record: Record, xi: Tensor, residual: Tensor) -> None:
            outside(record, inner.full(xi), residual)

        return on_iteration
