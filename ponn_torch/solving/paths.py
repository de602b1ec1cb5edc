"""First guesses from a path: a straight line, the powered-descent guess of the TFC paper, polar interpolation.

A path gives positions; velocities and accelerations follow by differentiation, costates from what the thrust would
have to do. The problem must name a position and a velocity of the same size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ponn_torch.numerics.nodes import differentiation_matrix, interpolation_matrix, make_nodes
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.problem import Named, nearest
from ponn_torch.solving.guess import ScaledCurve

N_SAMPLES = 48


@dataclass(frozen=True)
class _Ends:
    """Boundary data of a kinematic problem in the user's units; free components keep the other end's value."""

    position: tuple[Tensor, Tensor]
    velocity: tuple[Tensor, Tensor]


def _ends(bvp: BoundaryValueProblem, position: str, velocity: str) -> _Ends:
    problem = bvp.problem
    for name in (position, velocity):
        if name not in problem.states:
            raise ValueError(
                f"guess needs a state {name!r} in problem {problem.name!r}; {nearest(name, problem.states)}"
            )
    if problem.states[position] != problem.states[velocity]:
        raise ValueError(
            f"guess: state {position!r} has {problem.states[position]} components and {velocity!r} "
            f"{problem.states[velocity]} in problem {problem.name!r}; allowed: the same number"
        )
    first, last = problem.boundary("initial"), problem.boundary("final")
    filled = [
        [a if a is not None else b if b is not None else 0.0 for a, b in zip(one, other, strict=True)]
        for one, other in ((first, last), (last, first))
    ]
    start, end = (bvp.unit.new_tensor(values) for values in filled)
    r, v = problem.slices[position], problem.slices[velocity]
    return _Ends((start[r], end[r]), (start[v], end[v]))


def _unit(vector: Tensor, guess: str, name: str) -> Tensor:
    if not float(vector.norm()):
        raise ValueError(f"the {guess} guess needs a direction, but {name} is zero; take a random guess")
    return vector / vector.norm()


def _interpolated(bvp: BoundaryValueProblem, z: Tensor, w: Tensor) -> ScaledCurve:
    """The polynomial through samples w (n, 2n) at z (n,), as a function of scaled time."""
    return lambda t: interpolation_matrix(z, (2 * t / bvp.final_time - 1).clamp(-1.0, 1.0)) @ w


def _curve_from_path(
    bvp: BoundaryValueProblem,
    path: Callable[[Tensor], Tensor],
    position: str,
    velocity: str,
    velocity_costates: Callable[[Tensor, Tensor], Tensor],
) -> ScaledCurve:
    """Sample a path s ∈ [0, 1] → r, differentiate it, and add scaled costates λv(s, thrust acceleration), λr = −λ̇v."""
    problem, like = bvp.problem, bvp.unit
    z = make_nodes("chebyshev_lobatto", N_SAMPLES, dtype=like.dtype, device=like.device).points
    s = (z + 1) / 2
    derivative = differentiation_matrix(z) * (2 / problem.time_guess)
    r = path(s)
    first = torch.stack([like.new_tensor(1.0 if a is None else a) for a in problem.boundary("initial")])
    x = first.repeat(len(z), 1)
    x[:, problem.slices[position]] = r
    x[:, problem.slices[velocity]] = derivative @ r
    off = Named(**{name: like.new_zeros(len(z), size) for name, size in problem.control.names.items()})
    p = Named(**{k: like.new_full((len(z), 1), value) for k, value in problem.parameters.items()})
    t = (s * problem.time_guess)[:, None]
    coasting = problem.dynamics(t, problem.named(x), off, p)[velocity]
    needed = derivative @ derivative @ r - coasting
    costates = like.new_zeros(len(z), bvp.n_states)
    lambda_v = problem.costate_unit(velocity) * velocity_costates(s, needed)
    costates[:, problem.slices[velocity]] = lambda_v
    costates[:, problem.slices[position]] = -(derivative @ lambda_v)
    if problem.mass is not None:
        costates[:, problem.slices[problem.mass]] = problem.costate_unit(problem.mass) * (1 - s)[:, None]
    return _interpolated(bvp, z, bvp.to_scaled(x, costates))


@dataclass(frozen=True)
class StraightLine:
    """The straight line between the ends at constant speed, λv a unit vector against the change of velocity."""

    position: str = "r"
    velocity: str = "v"

    def curve(self, bvp: BoundaryValueProblem, seed: int) -> ScaledCurve:
        ends = _ends(bvp, self.position, self.velocity)
        (r0, rf), change = ends.position, ends.velocity[1] - ends.velocity[0]
        # from rest to rest there is no change of velocity: thrust first towards the end
        change = change if float(change.norm()) else rf - r0
        direction = -_unit(change, "straight line", self.position)
        return _curve_from_path(
            bvp,
            lambda s: r0 + s[:, None] * (rf - r0),
            self.position,
            self.velocity,
            lambda s, needed: direction.expand_as(needed),
        )


@dataclass(frozen=True)
class PoweredDescent:
    """The TFC paper's guess: a straight line, and λv linear from v0/|v0| to −r0/|r0| (end of its section IV)."""

    position: str = "r"
    velocity: str = "v"

    def curve(self, bvp: BoundaryValueProblem, seed: int) -> ScaledCurve:
        ends = _ends(bvp, self.position, self.velocity)
        r0, rf = ends.position
        start = _unit(ends.velocity[0], "powered descent", f"initial {self.velocity}")
        end = -_unit(r0, "powered descent", f"initial {self.position}")
        return _curve_from_path(
            bvp,
            lambda s: r0 + s[:, None] * (rf - r0),
            self.position,
            self.velocity,
            lambda s, needed: start + s[:, None] * (end - start),
        )


@dataclass(frozen=True)
class PolarTransfer:
    """Polar interpolation of a transfer about the z axis, ``revolutions`` extra turns, λv against the thrust it needs.

    The angle follows a cubic that meets the angular rates at both ends, the radius and height likewise; λv is scaled
    to a mean of one. Of several numbers of revolutions every start takes the next.
    """

    revolutions: int | Sequence[int] = 0
    position: str = "r"
    velocity: str = "v"

    def __post_init__(self) -> None:
        if not self._several or min(self._several) < 0:
            raise ValueError(f"revolutions = {self.revolutions}; allowed: 0, 1, 2, …, or a list of these")

    @property
    def _several(self) -> Sequence[int]:
        return [self.revolutions] if isinstance(self.revolutions, int) else self.revolutions

    def curve(self, bvp: BoundaryValueProblem, seed: int) -> ScaledCurve:
        ends = _ends(bvp, self.position, self.velocity)
        size = len(ends.position[0])
        if size not in (2, 3):
            raise ValueError(
                f"guess: state {self.position!r} has {size} components in problem {bvp.problem.name!r}; "
                "a polar transfer needs 2 or 3"
            )
        revolutions = self._several[seed % len(self._several)]
        polar = [_polar(r, v) for r, v in zip(ends.position, ends.velocity, strict=True)]
        (values0, rates0), (values1, rates1) = polar
        turn = (
            (values1[1] - values0[1]) % (2 * math.pi)
            if rates0[1] >= 0
            else -((values0[1] - values1[1]) % (2 * math.pi))
        )
        values1 = values1.clone()
        values1[1] = values0[1] + turn + 2 * math.pi * revolutions * (1 if rates0[1] >= 0 else -1)
        time = bvp.problem.time_guess

        def path(s: Tensor) -> Tensor:
            s = s[:, None]
            blend = 3 * s**2 - 2 * s**3
            start, end = s * (1 - s) ** 2 * time, -(s**2) * (1 - s) * time
            rho, angle, height = (values0 + blend * (values1 - values0) + start * rates0 + end * rates1).unbind(-1)
            return torch.stack([rho * torch.cos(angle), rho * torch.sin(angle), height], -1)[:, :size]

        def costates(s: Tensor, needed: Tensor) -> Tensor:
            return -needed / needed.norm(dim=-1).mean()

        return _curve_from_path(bvp, path, self.position, self.velocity, costates)


def _polar(r: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """(radius, angle, height) about the z axis and their rates; in a plane the height is zero."""
    rho, (height, climb) = torch.hypot(r[0], r[1]), (r[2], v[2]) if len(r) == 3 else (0 * r[0], 0 * v[0])
    if not float(rho):
        raise ValueError("a polar transfer needs ends off the z axis; take a random guess")
    values = torch.stack([rho, torch.atan2(r[1], r[0]), height])
    rates = torch.stack([(r[0] * v[0] + r[1] * v[1]) / rho, (r[0] * v[1] - r[1] * v[0]) / rho**2, climb])
    return values, rates
