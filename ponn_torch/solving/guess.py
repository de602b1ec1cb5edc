"""Where an iteration starts: random functions, trajectories, and the projection of any curve onto an ansatz."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Strong, discretise
from ponn_torch.optimal_control.expressions import LinearExpressions
from ponn_torch.optimal_control.layout import Unknowns

ScaledCurve = Callable[[Tensor], Tensor]  # scaled times (..., m) → w (..., m, 2n)

STREAMS = 1000  # random streams of a seed: start i of seed s takes 1000 s + i


def project(collocation: Collocation, curve: ScaledCurve, times: Tensor | None = None) -> Tensor:
    """ξ (..., N) whose expressions fit ``curve`` at the nodes, in least squares; known knot entries keep their values.

    One call behind first guesses, warm starts, more neurons and other segments. ``times`` (..., K+1) are knot times to
    use in place of the collocation's own.
    """
    disc = collocation.discretisation
    times = collocation.known_times if times is None else times
    known = collocation.known_knots
    h = (times[..., 1:] - times[..., :-1]) / 2
    t = times[..., :-1, None] + h[..., None] * (disc.nodes.points + 1.0)
    at_knots, values = curve(torch.cat([times, t.flatten(-2)], -1)).tensor_split([times.shape[-1]], -2)
    knots = torch.where(torch.isnan(known), at_knots, known)
    values = values.unflatten(-2, t.shape[-2:])
    unknowns = Unknowns(
        weights=values.new_zeros(*times.shape[:-1], collocation.n_segments, disc.n_own),
        knots=knots,
        times=times,
        multipliers=values.new_zeros(*times.shape[:-1], collocation.bvp.n_multipliers),
    )
    kappas, _ = collocation.kappas(unknowns, h)
    weights = disc.expressions.fit([values[..., group.columns[:, 0]] for group in disc.groups], kappas)
    return collocation.pack(replace(unknowns, weights=weights))


class Guess(Protocol):
    """A first curve for a boundary value problem; ``seed`` chooses among random ones."""

    def curve(self, bvp: BoundaryValueProblem, seed: int) -> ScaledCurve: ...


@dataclass(frozen=True)
class Alternating:
    """Another guess for every start, in turn; one that the problem does not allow is passed over."""

    guesses: Sequence[Guess]

    def __post_init__(self) -> None:
        if not self.guesses:
            raise ValueError("guesses: none given; allowed: at least one")

    def curve(self, bvp: BoundaryValueProblem, seed: int) -> ScaledCurve:
        first, count = seed % STREAMS, len(self.guesses)
        for i in range(first, first + count - 1):
            try:
                return self.guesses[i % count].curve(bvp, seed)
            except ValueError:
                continue
        return self.guesses[(first + count - 1) % count].curve(bvp, seed)


# -- random functions ------------------------------------------------------------------------------------------------

DISTRIBUTIONS: dict[str, Callable[[Tensor, torch.Generator], Tensor]] = {
    "uniform": lambda like, g: torch.rand(like.shape, generator=g, dtype=torch.float64).to(like),
    "symmetric": lambda like, g: (2 * torch.rand(like.shape, generator=g, dtype=torch.float64) - 1).to(like),
    "normal": lambda like, g: torch.randn(like.shape, generator=g, dtype=torch.float64).to(like),
}


@dataclass(frozen=True)
class RandomGuess:
    """Random output weights: coefficients of normalised Chebyshev polynomials in every constrained expression.

    ``uniform`` is the PoNN paper's U(0, 1), whose common sign makes a strongly curved first guess; m ≡ m0 and
    λm ≡ 1 as in the paper where ``hold_mass``. The draw does not depend on the ansatz that it is projected on.
    """

    distribution: str = "uniform"
    scale: float = 1.0
    n_neurons: int = 30
    hold_mass: bool = True

    def __post_init__(self) -> None:
        if self.distribution not in DISTRIBUTIONS:
            raise ValueError(f"distribution = {self.distribution!r}; allowed: {', '.join(DISTRIBUTIONS)}")

    def curve(self, bvp: BoundaryValueProblem, seed: int) -> ScaledCurve:
        like = bvp.unit
        nodes = make_nodes("legendre_gauss", 2 * self.n_neurons, dtype=like.dtype, device=like.device)
        disc = discretise(bvp, Chebyshev(self.n_neurons), nodes, Strong(), "columns")
        expressions = disc.expressions
        assert isinstance(expressions, LinearExpressions)  # as Chebyshev polynomials are linear
        collocation = Collocation.on_segments(disc, like.new_tensor([0.0, bvp.final_time]))
        generator = torch.Generator().manual_seed(seed)
        draw = DISTRIBUTIONS[self.distribution]
        weights = self.scale * draw(like.new_empty(1, disc.n_own), generator)
        knots = self.scale * draw(like.new_empty(2, bvp.dimension), generator)
        if self.hold_mass and bvp.problem.mass is not None:
            mass = bvp.problem.slices[bvp.problem.mass].start
            known_mass = bvp.known_initial[mass]
            knots[:, mass] = torch.where(known_mass.isnan(), bvp.to_scaled(like, like)[mass], known_mass)
            knots[:, bvp.n_states + mass] = 1.0
            for i, group in enumerate(disc.groups):
                held = (group.columns[:, 0] == mass) | (group.columns[:, 0] == bvp.n_states + mass)
                expressions.beta(i, weights)[:, held] = 0.0
        known = collocation.known_knots
        unknowns = Unknowns(
            weights,
            torch.where(torch.isnan(known), knots, known),
            collocation.known_times,
            like.new_zeros(bvp.n_multipliers),
        )
        return Curve(collocation, collocation.pack(unknowns))
