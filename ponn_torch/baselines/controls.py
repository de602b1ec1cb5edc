"""Control sets as variables of a nonlinear program: bounds, one vector per node, and what pins an arc."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ponn_torch.optimal_control.control_laws import Box, ThrustBall, Unconstrained
from ponn_torch.optimal_control.control_set import LOWER, UPPER, ControlSet, side_by_side
from ponn_torch.optimal_control.problem import Named, OptimalControlProblem


@dataclass(frozen=True)
class Limits:
    """Bounds of the variables ν at a node, and of its rows."""

    lower: Sequence[float]
    upper: Sequence[float]
    row_lower: Sequence[float] = ()
    row_upper: Sequence[float] = ()


@dataclass(frozen=True)
class ControlVariables:
    """Variables ν (..., size) of order one that stand for an admissible control.

    Attributes:
        free: limits of ν where nothing is known. pinned: arc codes → limits on such an arc.
        start: a value inside. bounded: places of the bounded scalars that arcs pin, in the order of their codes.
        controls: ν → controls by name, as the dynamics read them. inverse: controls → ν.
        rows: ν → (..., k), rows of the program; None where bounds say everything.
    """

    free: Limits
    pinned: Callable[[Sequence[int]], Limits]
    start: Sequence[float]
    bounded: Sequence[int]
    controls: Callable[[Tensor], dict[str, Tensor]]
    inverse: Callable[[Mapping[str, Tensor]], Tensor]
    rows: Callable[[Tensor], Tensor] | None = None

    @property
    def size(self) -> int:
        return len(self.start)

    @property
    def n_rows(self) -> int:
        return len(self.free.row_upper)


def control_variables(problem: OptimalControlProblem, softening: float) -> ControlVariables:
    """The variables of a problem's control set.

    ``softening``: by which fraction of the maximum a thrust may exceed its magnitude where it is not pinned.

    Raises:
        TypeError: a control set of another kind.
    """
    return _side_by_side([_variables(law, problem, softening) for law in problem.control.factors])


def _variables(law: ControlSet, problem: OptimalControlProblem, softening: float) -> ControlVariables:
    if isinstance(law, ThrustBall):
        return _thrust_ball(law, problem, softening)
    if isinstance(law, Box):
        return _box(law, problem)
    if isinstance(law, Unconstrained):
        return _unconstrained(law, problem)
    raise TypeError(f"control set {type(law).__name__}; allowed: ThrustBall, Box, Unconstrained, and products of these")


def _side_by_side(each: Sequence[ControlVariables]) -> ControlVariables:
    """The variables of several sets, one after the other."""
    if len(each) == 1:
        return each[0]
    sizes = [one.size for one in each]
    places, of_codes = side_by_side(sizes), side_by_side([len(one.bounded) for one in each])
    ruled = [i for i, one in enumerate(each) if one.rows is not None]

    def limits(of: Sequence[Limits]) -> Limits:
        return Limits(*([x for piece in side for x in piece] for side in zip(*map(_sides, of), strict=True)))

    def pinned(codes: Sequence[int]) -> Limits:
        return limits([one.pinned(codes[own]) for one, own in zip(each, of_codes, strict=True)])

    def rows(nu: Tensor) -> Tensor:
        pieces = nu.split(sizes, -1)
        return torch.cat([each[i].rows(pieces[i]) for i in ruled], -1)  # type: ignore[misc]

    def controls(nu: Tensor) -> dict[str, Tensor]:
        pieces = zip(each, nu.split(sizes, -1), strict=True)
        return {name: value for one, piece in pieces for name, value in one.controls(piece).items()}

    return ControlVariables(
        free=limits([one.free for one in each]),
        pinned=pinned,
        start=[x for one in each for x in one.start],
        bounded=[place.start + i for one, place in zip(each, places, strict=True) for i in one.bounded],
        controls=controls,
        inverse=lambda control: torch.cat([one.inverse(control) for one in each], -1),
        rows=rows if ruled else None,
    )


def _sides(limits: Limits) -> tuple[Sequence[float], ...]:
    return limits.lower, limits.upper, limits.row_lower, limits.row_upper


def _thrust_ball(law: ThrustBall, problem: OptimalControlProblem, softening: float) -> ControlVariables:
    """ν = (|T|, T)/maximum, and the row |T|² − magnitude² − 2 ε magnitude with ε the softening.

    The row is at most zero, a cone, so that the set is convex: with a magnitude times a direction, or on the surface,
    every node where the thrust is off is stationary whatever its direction. At an optimum the vector is on the surface
    wherever λv ≠ 0 (lossless convexification), and where an arc pins the magnitude it is put there. At the apex the
    cone has no slope; ε gives it one.
    """
    low, high = map(float, law.bounds(Named(**problem.parameters), problem_units(problem)))
    name, size, least = law.name, law.size, low / high

    def limits(lower: float, upper: float) -> Limits:
        if lower < upper:
            return Limits([lower, *[-2.0] * size], [upper, *[2.0] * size], [-math.inf], [0.0])
        if upper == 0.0:  # nothing is left to say, and no interior to say it in
            return Limits([0.0] * (1 + size), [0.0] * (1 + size), [-math.inf], [math.inf])
        surface = 2.0 * softening * upper
        return Limits([lower, *[-2.0] * size], [upper, *[2.0] * size], [-surface], [-surface])

    arcs = {LOWER: limits(least, least), UPPER: limits(1.0, 1.0)}

    def rows(nu: Tensor) -> Tensor:
        magnitude, vector = nu[..., :1], nu[..., 1:]
        return (vector * vector).sum(-1, keepdim=True) - magnitude * (magnitude + 2.0 * softening)

    return ControlVariables(
        free=limits(least, 1.0),
        pinned=lambda codes: arcs.get(codes[0], limits(least, 1.0)),
        start=[0.5 * (1.0 + least), *[0.25 / size**0.5] * size],
        bounded=(0,),
        controls=lambda nu: {name: high * nu[..., 1:], f"{name}_magnitude": high * nu[..., :1]},
        inverse=lambda control: torch.cat([control[f"{name}_magnitude"], control[name]], -1) / high,
        rows=rows,
    )


def _box(law: Box, problem: OptimalControlProblem) -> ControlVariables:
    low, high = law.bounds(Named(**problem.parameters), problem_units(problem))
    return ControlVariables(
        free=Limits([0.0] * law.size, [1.0] * law.size),
        pinned=lambda codes: Limits([float(c == UPPER) for c in codes], [float(c != LOWER) for c in codes]),
        start=[0.5] * law.size,
        bounded=range(law.size),
        controls=lambda nu: {law.name: low + (high - low) * nu},
        inverse=lambda control: (control[law.name] - low) / (high - low),
    )


def _unconstrained(law: Unconstrained, problem: OptimalControlProblem) -> ControlVariables:
    unit = _natural_unit(law, problem)
    limits = Limits([-math.inf] * law.size, [math.inf] * law.size)
    return ControlVariables(
        free=limits,
        pinned=lambda codes: limits,
        start=[0.0] * law.size,
        bounded=(),
        controls=lambda nu: {law.name: unit * nu},
        inverse=lambda control: control[law.name] / unit,
    )


def _natural_unit(law: ControlSet, problem: OptimalControlProblem) -> float:
    """The control that changes some state by its unit in a unit of time."""
    (name, size), units = next(iter(law.names.items())), problem_units(problem)
    x, t = units[None], units.new_full((1, 1), problem.time_guess)
    p = Named(**{key: torch.full_like(t, value) for key, value in problem.parameters.items()})
    others = problem.control.probe(torch.ones_like(t))

    def rates(control: Tensor) -> Tensor:
        u = Named(**{**others, name: control})
        return problem.stack(problem.dynamics(t, problem.named(x), u, p), x)[0] / units

    slopes = torch.func.jacrev(rates)(units.new_full((1, size), 1e-3))
    return 1.0 / (float(slopes.abs().max()) * problem.unit("time"))


def problem_units(problem: OptimalControlProblem) -> Tensor:
    """Unit of every scalar state (n,)."""
    return torch.tensor([problem.unit(n) for n, size in problem.states.items() for _ in range(size)]).double()
