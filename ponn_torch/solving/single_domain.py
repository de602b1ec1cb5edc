"""One domain: a smoothed solution followed down in ρ, on a discretisation made anew at every rung for its switches.

The switches of the curve before say where the next rung needs nodes or units. Nothing is split: each rung is a solution
of its own regularised problem, kept while its equations hold between the nodes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from ponn_torch.optim.base import NonFiniteResidual, OptimizeResult, Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation, Form
from ponn_torch.solving.continuation import Adaptive
from ponn_torch.solving.continuation import Outcome as Step
from ponn_torch.solving.guess import project
from ponn_torch.solving.refinement import MakeCallback, Outcome, Refined, Refinement
from ponn_torch.solving.switching import find_structure, switching_along


@dataclass(frozen=True)
class Layers:
    """Where a smoothed control switches on z ∈ [−1, 1]: centres (M,), and the widths ρ/|dS/dz| (M,) of tanh(S/ρ)."""

    centres: Tensor
    widths: Tensor

    def close_to(self, other: Layers, share: float) -> bool:
        """Whether the same layers lie within a share of their widths."""
        if len(self.centres) != len(other.centres):
            return False
        return bool(((self.centres - other.centres).abs() <= share * self.widths).all())


def find_layers(curve: Curve, smoothing: Tensor | None) -> Layers:
    """The zeros of S along a curve, as layers of the control at a smoothing; none without one."""
    start, end = curve.times[0], curve.times[-1]
    structure, half = find_structure(curve), (end - start) / 2
    smoothed = set(curve.collocation.bvp.law.jumping.values())
    events = [[function for function in event if function in smoothed] for event in structure.events]
    if smoothing is None or not any(events):
        return Layers(start.new_zeros(0), start.new_zeros(0))
    step, times = 1e-5 * half, structure.times[[bool(event) for event in events]]
    before, after = (switching_along(curve, (times + d).clamp(start, end)) for d in (-step, step))
    pairs = zip(after - before, filter(None, events), strict=True)
    steepest = torch.stack([row[event].abs().amax() for row, event in pairs])
    slopes = steepest / (2 * step) * half
    return Layers((times - start) / half - 1.0, (smoothing / slopes).clamp_max(1.0))


@dataclass(frozen=True)
class SingleDomain(Refinement, ABC):
    """Rungs from the smoothing of the curve that is given down to ``last``, the step halved where one fails.

    Attributes:
        last, factor, max_halvings: of the rungs, as in ``Adaptive``.
        max_rounds: of one rung; the next begins where S then has its zeros, if they moved by ``shift`` of a layer.
        residual_tolerance: ‖r‖ above which a round has failed.
        trust: a rung is kept while its off-node residual is below this fraction of the largest rate.
        off_node_tolerance: of the last rung, below which it is solved.
    """

    exact: ClassVar[bool] = False

    last: float = 1e-3
    factor: float = 0.3
    max_halvings: int = 3
    max_rounds: int = 3
    shift: float = 0.2
    residual_tolerance: float = 0.1
    trust: float = 0.005
    off_node_tolerance: float = 1e-9
    stopping: Stopping = field(
        default_factory=lambda: Stopping(tolerance=1e-12, decrease=1e-2, patience=2, max_iterations=60)
    )
    damping: float = 1e-8
    linear_solver: str = "cholesky"

    @abstractmethod
    def discretisation(self, curve: Curve, layers: Layers) -> Discretisation:
        """Free function and nodes for a problem that has these layers, next to a curve."""

    def run(self, start: Curve, callback: MakeCallback | None = None, blunter: Curve | None = None) -> Refined:
        rounds: list[OptimizeResult] = []
        kept, made_by, outcome = start, None, Outcome.RESIDUAL

        def attempt(value: float | None, parameter: str, form: Form | None, *, hold: bool = False) -> Step:
            nonlocal kept, made_by, outcome
            try:
                curve = self._rung(kept, value, rounds, callback)
            except NonFiniteResidual:
                return Step.FAILED
            if rounds[-1].status.cut:
                outcome = Outcome.INTERRUPTED
                return Step.ABORT
            if not float(rounds[-1].norm) < self.residual_tolerance:
                return Step.FAILED
            off_node = curve.off_node_residual()
            if not off_node <= self.trust * curve.largest_rate:
                outcome = Outcome.COARSE if kept is start else outcome
                return Step.UNTRUSTED
            kept, made_by = curve, rounds[-1]
            outcome = Outcome.SOLVED if off_node <= self.off_node_tolerance else Outcome.COARSE
            return Step.SOLVED

        try:
            if start.smoothing:
                Adaptive(start.smoothing, min(self.last, start.smoothing), self.factor, self.max_halvings).run(attempt)
            else:
                attempt(None, "smoothing", None)
        except KeyboardInterrupt:
            outcome = Outcome.INTERRUPTED
        return Refined(kept, outcome, rounds, made_by=made_by)

    def _rung(
        self, curve: Curve, value: float | None, rounds: list[OptimizeResult], callback: MakeCallback | None
    ) -> Curve:
        """Rounds at one smoothing, until the layers lie where they were taken to be."""
        optimizer = LevenbergMarquardt(self.stopping, damping=self.damping, linear_solver=self.linear_solver)
        setting, ends = curve.collocation.setting, curve.times[[0, -1]]
        smoothing = None if value is None else ends.new_tensor(value)
        layers = find_layers(curve, smoothing)
        for _ in range(self.max_rounds):
            disc = self.discretisation(curve, layers)
            collocation = Collocation.on_segments(disc, ends, setting=setting).with_setting(smoothing=smoothing)
            on_iteration = callback(collocation) if callback else None
            result = optimizer.run(collocation, project(collocation, curve), on_iteration)
            rounds.append(result)
            curve, before = Curve(collocation, result.xi), layers
            if result.status.cut or not float(result.norm) < self.residual_tolerance:
                break
            layers, ends = find_layers(curve, smoothing), curve.times[[0, -1]]
            if layers.close_to(before, self.shift):
                break
        return curve
