"""Networks that grow: one hidden unit at a time, chosen where the residual is large, and trained in between.

Neither where layers are nor how thin is told to them: centres are drawn from the squared residual so far, slopes evenly
over three decades, and that one of many candidates is taken whose output weights lower the residual most. Nodes follow
the units: panels are halved towards each of them until they resolve it, so that no unit hides its slope between two.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ponn_torch.ansatz.networks import MLP
from ponn_torch.numerics.nodes import NodeSet, graded_edges, make_panels
from ponn_torch.optim.base import Optimizer, OptimizeResult, Stopping, Stopwatch
from ponn_torch.optim.chain import Chain, OutputLayer
from ponn_torch.optim.least_squares import GaussNewton, LevenbergMarquardt
from ponn_torch.optim.variable_projection import VariableProjection
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.discretisation import Discretisation

STEEPEST = 1e3  # of a candidate, in z; on FINE nodes it is resolved
FINE = make_panels("legendre_gauss", torch.linspace(-1.0, 1.0, 321, dtype=torch.float64), 4)
ROUNDS, ITERATIONS = (
    6,
    (10, 30),
)  # of training with all units, each on nodes anew; iterations after a unit, and of a round
RIDGE = 1e-7

_STOPPING = Stopping(tolerance=1e-12, decrease=1e-2, patience=6)
PROJECTED = VariableProjection(LevenbergMarquardt(_STOPPING, damping=0.1, linear_solver="qr"), RIDGE)
ALL_WEIGHTS = LevenbergMarquardt(_STOPPING, damping=0.1, linear_solver="qr", geodesic=True)


def _limited(optimizer: Optimizer, n_iterations: int) -> Optimizer:
    """At most so many iterations; the output layer is brought to its best, whatever trains the hidden one."""
    if isinstance(optimizer, VariableProjection):
        return replace(optimizer, optimizer=_limited_alone(optimizer.optimizer, n_iterations))
    settled = OutputLayer(GaussNewton())
    return Chain([settled, _limited_alone(optimizer, n_iterations), settled])


def _limited_alone(optimizer: Optimizer, n_iterations: int) -> Optimizer:
    assert isinstance(optimizer, LevenbergMarquardt)
    return replace(optimizer, stopping=replace(optimizer.stopping, max_iterations=n_iterations))


@dataclass(frozen=True)
class Growth:
    """How a network of one hidden layer comes by its units.

    Attributes:
        train: Levenberg–Marquardt on all weights, or variable projection; None: units stay as they are drawn.
        n_candidates: of which the best is taken; 1: drawn, not chosen, and its centre from an even density.
        n_starts: networks grown, of which that of the smallest residual is kept.
    """

    train: Optimizer | None = PROJECTED
    n_candidates: int = 200
    n_starts: int = 1

    def run(self, bvp: BoundaryValueProblem, n_units: int, seed: int) -> tuple[Collocation, OptimizeResult]:
        """The residual and the best point; iterations, counts and CPU seconds are those of all starts."""
        grown = [self._grown(bvp, n_units, seed + 1000 * start) for start in range(self.n_starts)]
        residual, best = min(grown, key=lambda pair: float(pair[1].norm))
        results = [result for _, result in grown]
        return residual, replace(
            best,
            n_residuals=sum(result.n_residuals for result in results),
            records=[entry for result in results for entry in result.records],
            cpu_seconds=sum(result.cpu_seconds for result in results),
        )

    def _grown(self, bvp: BoundaryValueProblem, n_units: int, seed: int) -> tuple[Collocation, OptimizeResult]:
        generator, watch = torch.Generator().manual_seed(seed), Stopwatch()
        slopes = offsets = FINE.points[:0]
        density, results = FINE.weights, []
        for _ in range(n_units):
            steep, centres = self._drawn(generator, density)
            best = _best(bvp, (slopes, offsets), (steep, -steep * centres)) if self.n_candidates > 1 else 0
            slopes = torch.cat([slopes, steep[best : best + 1]])
            offsets = torch.cat([offsets, -(steep * centres)[best : best + 1]])
            if self.n_candidates == 1:
                continue
            residual, result = self._trained(bvp, slopes, offsets, ITERATIONS[0])
            results.append(result)
            slopes, offsets = result.xi[: len(slopes)], result.xi[len(slopes) : 2 * len(slopes)]
            density = _squared(bvp, result.xi, len(slopes))
        for _ in range(1 if self.train is None else ROUNDS):
            residual, result = self._trained(bvp, slopes, offsets, ITERATIONS[1])
            results.append(result)
            slopes, offsets = result.xi[:n_units], result.xi[n_units : 2 * n_units]
            if result.n_iterations < 8:
                break
        counted = replace(
            result,
            n_residuals=sum(part.n_residuals for part in results),
            records=[entry for part in results for entry in part.records],
            cpu_seconds=watch.seconds,
        )
        return residual, counted

    def _drawn(self, generator: torch.Generator, density: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes and centres of candidates: evenly in log(slope), and within two widths of a point of the density."""
        share, apart = torch.rand(2, self.n_candidates, generator=generator, dtype=torch.float64)
        slopes = STEEPEST**share
        points = FINE.points[torch.multinomial(density, self.n_candidates, replacement=True, generator=generator)]
        return slopes, points + (2 * apart - 1) * 2 / slopes

    def _trained(
        self, bvp: BoundaryValueProblem, slopes: Tensor, offsets: Tensor, n_iterations: int
    ) -> tuple[Collocation, OptimizeResult]:
        residual, xi = _network(bvp, slopes, offsets, _following(slopes, offsets))
        if self.train is None:
            return residual, OutputLayer(GaussNewton()).run(residual, xi)
        return residual, _limited(self.train, n_iterations).run(residual, xi)


def _network(bvp: BoundaryValueProblem, slopes: Tensor, offsets: Tensor, nodes: NodeSet) -> tuple[Collocation, Tensor]:
    """The residual of one hidden layer, and ξ: slopes, offsets, then an output layer and knots that are zero."""
    disc = Discretisation(bvp, MLP((len(slopes),)), nodes, conditioning="columns")
    residual = Collocation.on_segments(disc, bvp.unit.new_tensor([0.0, bvp.final_time]))
    rest = slopes.new_zeros(residual.n_unknowns - 2 * len(slopes))
    return residual, torch.cat([slopes, offsets, rest])


def _following(slopes: Tensor, offsets: Tensor) -> NodeSet:
    """Panels of six nodes, halved towards every unit down to its width."""
    centres, widths = (-offsets / slopes).clamp(-1.0, 1.0), (2 / slopes.abs()).clamp_max(1.0)
    return make_panels("legendre_gauss", graded_edges(centres, widths, 0.25), 6)


def _squared(bvp: BoundaryValueProblem, xi: Tensor, n_units: int) -> Tensor:
    """The squared residual on the fine nodes, summed over the equations, times the nodes' weights."""
    residual, _ = _network(bvp, xi[:n_units], xi[n_units : 2 * n_units], FINE)
    return residual.residual(xi).view(-1, len(FINE)).square().sum(0)


def _best(bvp: BoundaryValueProblem, units: tuple[Tensor, Tensor], candidates: tuple[Tensor, Tensor]) -> int:
    """The candidate that lowers the squared residual most when the output layer follows."""
    slopes, offsets = (torch.cat(pair) for pair in zip(units, candidates, strict=True))
    residual, xi = _network(bvp, slopes, offsets, FINE)
    r, jacobian = residual.linearise(xi)
    table = jacobian.columns(residual.linear_unknowns).dense()
    n_heads, n_new = residual.discretisation.expressions.n_heads, len(candidates[0])
    first = n_heads * len(units[0])
    new = table[:, first : first + n_heads * n_new]
    own = torch.cat([table[:, :first], table[:, first + n_heads * n_new :]], -1)
    ridge = RIDGE * torch.eye(own.shape[-1], dtype=own.dtype)
    basis = torch.linalg.qr(torch.cat([own, ridge])).Q
    r, beyond = (torch.cat([rows, rows.new_zeros(len(ridge), *rows.shape[1:])]) for rows in (r, new))
    r, beyond = r - basis @ (basis.mT @ r), beyond - basis @ (basis.mT @ beyond)
    heads = beyond.unflatten(-1, (n_new, n_heads)).movedim(1, 0)
    size = torch.diag_embed(new.square().sum(0).view(n_new, n_heads))
    pull = heads.mT @ r[:, None]
    gain = (pull * torch.linalg.solve(heads.mT @ heads + 1e-10 * size, pull)).sum((-1, -2))
    return int(gain.argmax())
