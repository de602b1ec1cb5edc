"""How far a curve is from a reference solution: the error that only a known answer shows."""

from __future__ import annotations

import torch
from torch import Tensor

from ponn_torch.optimal_control.curve import Curve
from ponn_torch.solving.solution import Solution


class Reference:
    """A solution to measure others against, at even times of its flight.

    Raises:
        ValueError: a curve of another problem.
    """

    def __init__(self, solution: Solution, n_points: int = 101) -> None:
        self.solution = solution
        self._times = torch.linspace(0.0, solution.final_time, n_points, dtype=torch.float64)
        self._known = _physical(solution.curve, self._times)
        problem = solution.problem
        self._units = [
            torch.tensor([size(name) for name, width in problem.states.items() for _ in range(width)])
            for size in (problem.unit, problem.costate_unit)
        ]

    def errors(self, curve: Curve) -> dict[str, float]:
        """Largest error of states and of costates over all times and components, in the problem's units.

        A curve that ends earlier is held at its end.
        """
        mine, own = curve.collocation.bvp, self.solution.bvp
        if mine.problem.states != own.problem.states:
            raise ValueError(
                f"reference = {own.problem.name!r} with states {dict(own.problem.states)}; "
                f"allowed: a solution of {mine.problem.name!r}"
            )
        found = _physical(curve, self._times)
        return {
            name: float(((values - known) / size).abs().max())
            for name, values, known, size in zip(("states", "costates"), found, self._known, self._units, strict=True)
        }


def _physical(curve: Curve, times: Tensor) -> tuple[Tensor, Tensor]:
    """States and costates (m, n) in SI at times (m,) in s."""
    bvp, like = curve.collocation.bvp, curve.xi
    scaled = (times.to(like) / bvp.time_unit).clamp_max(float(curve.times[-1]))
    states, costates = bvp.to_physical(curve(scaled))
    return states.double().cpu(), costates.double().cpu()
