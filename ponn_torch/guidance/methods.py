"""Ways to make the solver of a tracking problem's horizons: collocation, pseudospectral, swarm-tuned Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from ponn_torch.ansatz.basis import GaussianRBF, LinearBasis
from ponn_torch.guidance.expansion import expand
from ponn_torch.guidance.horizon import HorizonSolver, LinearTPBVP, pseudospectral
from ponn_torch.guidance.producers import Planner
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.numerics.nodes import NodeSet, make_nodes
from ponn_torch.numerics.particle_swarm import ParticleSwarm
from ponn_torch.optimal_control.problem import nearest


class Method(Protocol):
    """Makes a solver; what is tuned is tuned on the problem's first horizon."""

    def solver(self, problem: TrackingProblem, seed: int) -> HorizonSolver: ...


@dataclass(frozen=True)
class Collocation:
    """A basis in the constrained expression: TFC with polynomials, X-TFC with Gaussians or random features.

    basis: leave out the constant of polynomials (lowest_degree 1). kind, n_nodes: of the nodes.
    """

    basis: LinearBasis
    kind: str = "legendre_lobatto"
    n_nodes: int = 10
    route: str = "lu"

    def solver(self, problem: TrackingProblem, seed: int) -> HorizonSolver:
        return HorizonSolver(self.basis, make_nodes(self.kind, self.n_nodes), route=self.route)


@dataclass(frozen=True)
class Pseudospectral:
    """Indirect pseudospectral method: legendre_lobatto (ILPM), legendre_radau (IRPM) or legendre_gauss (IGPM)."""

    kind: str = "legendre_gauss"
    n_nodes: int = 10

    def solver(self, problem: TrackingProblem, seed: int) -> HorizonSolver:
        return pseudospectral(self.kind, self.n_nodes)


@dataclass(frozen=True)
class RandomGaussians:
    """X-TFC with nothing tuned: centres uniform in [−1, 1], shapes uniform in a range, [3, Fig. 1a]."""

    kind: str = "legendre_lobatto"
    n_nodes: int = 10
    shapes: Sequence[float] = (1.0, 10.0)

    def solver(self, problem: TrackingProblem, seed: int) -> HorizonSolver:
        generator = torch.Generator().manual_seed(seed)
        draws = torch.rand(2, self.n_nodes, generator=generator, dtype=torch.float64)
        low, high = self.shapes
        basis = GaussianRBF(2 * draws[0] - 1, low + (high - low) * draws[1])
        return HorizonSolver(basis, make_nodes(self.kind, self.n_nodes))


# -- swarm-tuned Gaussians ---------------------------------------------------------------------------


def loss_objective(solver: HorizonSolver, problem: LinearTPBVP, largest_condition: float) -> Tensor:
    """‖equations β − right side‖ of every particle: what [3] minimises, which is round-off (see HorizonSolution)."""
    return solver.solve(problem).loss


def off_node_objective(solver: HorizonSolver, problem: LinearTPBVP, largest_condition: float) -> Tensor:
    """The residual between the nodes, infinite where the basis is so ill conditioned that it means nothing."""
    found = solver.solve(problem).off_node_residual()
    slopes = solver.tables(solver.nodes.points).slopes
    finite = slopes.isfinite().all(-1).all(-1)
    values = torch.linalg.svdvals(torch.where(finite[..., None, None], slopes, torch.zeros_like(slopes)))
    usable = finite & (values[..., 0] <= largest_condition * values[..., -1])
    return torch.where(usable, found, torch.inf)


OBJECTIVES: dict[str, Callable[[HorizonSolver, LinearTPBVP, float], Tensor]] = {
    "loss": loss_objective,
    "off_node_residual": off_node_objective,
}


@dataclass(frozen=True)
class TunedGaussians:
    """X-TFC of [3]: Gaussians on the nodes, shapes found by a particle swarm on the first horizon.

    objective: one of OBJECTIVES; largest_condition: of the table of slopes, for the off-node residual.

    Raises ValueError for an unknown objective.
    """

    kind: str = "legendre_lobatto"
    n_nodes: int = 10
    objective: str = "loss"
    largest_condition: float = 1e10
    swarm: ParticleSwarm = field(default_factory=ParticleSwarm)
    route: str = "lu"

    def __post_init__(self) -> None:
        if self.objective not in OBJECTIVES:
            raise ValueError(f"objective = {self.objective!r}; {nearest(self.objective, OBJECTIVES)}")

    def solver(self, problem: TrackingProblem, seed: int) -> HorizonSolver:
        nodes = make_nodes(self.kind, self.n_nodes)
        given, objective = first_horizon(problem, nodes), OBJECTIVES[self.objective]

        def cost(shapes: Tensor) -> Tensor:
            solver = HorizonSolver(GaussianRBF(nodes.points, shapes), nodes, route=self.route)
            return objective(solver, given, self.largest_condition)

        generator = torch.Generator().manual_seed(seed)
        found = self.swarm.minimise(cost, self.n_nodes, generator)
        return HorizonSolver(GaussianRBF(nodes.points, found.best), nodes, route=self.route)


def first_horizon(problem: TrackingProblem, nodes: NodeSet) -> LinearTPBVP:
    """The linear problem of the first cycle, expanded around the reference."""
    # the basis has no part in it
    planner = Planner(problem, HorizonSolver(GaussianRBF(nodes.points, 1.0), nodes))
    start, duration = problem.initial.new_zeros(()), problem.initial.new_tensor(problem.horizon)
    t = planner.times(start, duration)
    return planner.linear(expand(problem, t, *problem.reference(t)), start, duration, problem.initial)
