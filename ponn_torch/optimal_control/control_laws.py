"""Minimisers of the Hamiltonian over a control set, smoothed by a regulariser or pinned to an arc.

A bounded scalar control is written lower + (upper − lower) η with η ∈ [0, 1], and S = −(∂H/∂η)/s with s a
constant in cost per time. Three regimes:

- smoothed, H affine in η: ``s ρ e(η)`` is added to the running cost, so the minimum principle stays exact at every ρ;
- H a convex parabola in η (``convex``): the minimiser is S/curvature clipped to [0, 1] and needs no smoothing;
- on an arc: the control is at the bound, or in the interior, that the arc's code names. Where H is affine such an
  arc is singular, S = 0 all along it, and η comes from outside (singular.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import gradients
from ponn_torch.optimal_control import sampling
from ponn_torch.optimal_control.control_set import (
    INTERIOR,
    LOWER,
    UPPER,
    ControlSet,
    Hamiltonian,
    Level,
    Minimiser,
    Regime,
    Unbounded,
    finite,
)
from ponn_torch.optimal_control.regularisers import Entropy, Regulariser


def _fraction(at_lower: Tensor, at_upper: Tensor, law: Bounded, regime: Regime) -> Tensor:
    """η (..., m) from S at both bounds: ``at_lower`` = S(η=0), ``at_upper`` = S(η=1), equal where H is affine."""

    def vertex() -> Tensor:
        curvature = at_lower - at_upper
        return at_lower / torch.where(curvature > 0, curvature, torch.ones_like(curvature))

    if regime.arcs is None:
        return law.by_kind(at_lower, lambda: _jump(at_lower, law, regime.smoothing), lambda: vertex().clamp(0.0, 1.0))

    def singular() -> Tensor:
        return 0.5 * torch.ones_like(at_lower) if regime.interior is None else regime.interior

    free = law.by_kind(at_lower, singular, vertex)
    zero, one = torch.zeros_like(at_lower), torch.ones_like(at_lower)
    return torch.where(regime.arcs == LOWER, zero, torch.where(regime.arcs == UPPER, one, free))


def _jump(switching: Tensor, law: Bounded, smoothing: Tensor | None) -> Tensor:
    """η from one bound to the other where S changes its sign, at once or smoothed."""
    if smoothing is None:
        return (switching > 0).to(switching.dtype)
    return law.regulariser.fraction(switching - law.switching_level, smoothing)


# -- probes of H -----------------------------------------------------------------------------------------------------

SHARE = 0.37  # of a range; no symmetry favours it
ROUNDING = 1e-9  # of a slope


def _random(like: Tensor, size: int, seed: int = 0) -> Tensor:
    """The same numbers (..., size) in (−1, 1) every time; ``like`` is (..., 1)."""
    generator = torch.Generator().manual_seed(seed)
    return (2.0 * torch.rand(*like.shape[:-1], size, generator=generator, dtype=torch.float64) - 1.0).to(like)


def _negligible(difference: Tensor, *slopes: Tensor) -> bool:
    """Whether a difference of slopes is rounding at all probes; NaN is not."""
    return bool((difference.abs() <= ROUNDING * sum(x.abs() for x in slopes)).all())


def _nowhere_convex(bend: Tensor, *slopes: Tensor) -> bool:
    """Whether at every state H bends down, by ``bend`` (2k, 1), for a costate or for its opposite.

    Where the state decides, as in m u², which is concave at negative masses only, the certificate will tell.
    """
    down = bend < -ROUNDING * sum(x.abs() for x in slopes)
    return bool(down.view(2, -1).any(0).all())


# -- control sets ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Unconstrained(Unbounded):
    """Control in ℝᵐ with H quadratic in it: u = −H_uu⁻¹ H_u(0), exact in one step."""

    name: str
    size: int

    @property
    def names(self) -> dict[str, int]:
        return {self.name: self.size}

    def probe(self, one: Tensor) -> dict[str, Tensor]:
        return {self.name: one.expand(*one.shape[:-1], self.size)}

    @torch.no_grad()
    def adapted(self, h: Hamiltonian, cost: Hamiltonian, p: Any, one: Tensor, unit: float) -> Unconstrained:
        u = _random(one, self.size)
        back, ahead, far = (self._slope(h, k * u) for k in (-1.0, 1.0, 2.0))
        if not _negligible(far - 1.5 * ahead + 0.5 * back, back, ahead, far):
            raise ValueError(
                f"control {self.name!r}: the Hamiltonian is not quadratic in it, so ∂H/∂u = 0 has no closed form; "
                "Stationary solves it over a range"
            )
        at_zero, hessian = self._parabola(h, one)
        curvature = torch.linalg.eigvalsh(hessian)
        rounding = torch.maximum(ROUNDING * curvature[..., -1].abs(), 1e-13 * at_zero.abs().amax(-1))
        if not bool((curvature[..., 0] > rounding).any()):
            if bool((curvature[..., 0] < -rounding).any()):
                raise ValueError(
                    f"control {self.name!r}: H_uu is positive definite at none of the probes, so ∂H/∂u = 0 does not "
                    "minimise H"
                )
            raise ValueError(
                f"control {self.name!r}: H_uu is singular, so ∂H/∂u = 0 does not determine it; "
                "where H is linear in a control, it needs bounds (Box, ThrustBall)"
            )
        return self

    def minimise(self, h: Hamiltonian, p: Any, like: Tensor, regime: Regime) -> Minimiser:
        at_zero, hessian = self._parabola(h, like)
        # where H_uu is singular u is not finite, and an iteration that comes there steps back
        u = -torch.linalg.solve_ex(hessian, at_zero.unsqueeze(-1)).result.squeeze(-1)
        none = like[..., :0]
        return Minimiser({self.name: u}, none, none)

    def _slope(self, h: Hamiltonian, u: Tensor) -> Tensor:
        return gradients(lambda u: h(**{self.name: u}), u)[0]

    def _parabola(self, h: Hamiltonian, like: Tensor) -> tuple[Tensor, Tensor]:
        """H_u (..., m) where u = 0, and H_uu (..., m, m)."""
        zero = torch.zeros_like(like).expand(*like.shape[:-1], self.size).contiguous()
        at_zero = self._slope(h, zero)
        units = torch.eye(self.size, dtype=like.dtype, device=like.device)
        # H is quadratic, so a unit step in the gradient is a column of H_uu
        return at_zero, torch.stack([self._slope(h, zero + unit) - at_zero for unit in units], -1)

    def samples(self, minimiser: Minimiser, p: Any) -> Minimiser:
        u = minimiser.control[self.name]
        size = u.abs().flatten(0, -2).amax(0)
        size = torch.where(size > 0, size, 1.0)
        return minimiser._replace(control={self.name: u + size * sampling.steps(u)})


Bound = float | str | Sequence[float]


@dataclass(frozen=True)
class Bounded(ControlSet):
    """What thrust balls and boxes share: bounds (numbers, or names of parameters), a regulariser, a scale.

    ``cost_rate`` is s per unit of control, in cost per time and control; found by a probe of H where it is None.
    ``switching_level`` is S_c of the PoNN paper's eq. 45. ``convex`` are the components that H is a convex parabola in,
    ascending, and no affine function; ``adapted`` finds them.
    """

    name: str
    maximum: Bound
    minimum: Bound = 0.0
    size: int = 1
    _: KW_ONLY
    regulariser: Regulariser = field(default_factory=Entropy)
    switching_level: float = 0.0
    cost_rate: float | tuple[float, ...] | None = None
    convex: tuple[int, ...] = ()

    least: ClassVar[float] = -math.inf
    allowed: ClassVar[str] = "a finite number, or the name of a parameter"
    room: ClassVar[str] = "minimum < maximum"

    def __post_init__(self) -> None:
        if not (isinstance(self.size, int) and self.size > 0):
            raise ValueError(f"{self.name}: size = {self.size!r}; allowed: a whole number from 1")
        if isinstance(self.regulariser, type) or not isinstance(self.regulariser, Regulariser):
            allowed = "Entropy(), Quadratic(), Logarithmic(), or what has their methods"
            raise ValueError(f"{self.name}: regulariser = {self.regulariser!r}; allowed: {allowed}")
        for label in ("minimum", "maximum"):
            bound = getattr(self, label)
            if not (isinstance(bound, str) or finite(bound) or self._per_component(bound)):
                raise ValueError(f"{self.name}: {label} = {bound!r}; allowed: {self.allowed}")
        if not (isinstance(self.minimum, str) or isinstance(self.maximum, str)):
            self._check_room(*self.bounds(None, torch.zeros((), dtype=torch.float64)))

    def _per_component(self, bound: Any) -> bool:
        """Whether a bound is a sequence of numbers, one per component, and sequences are allowed."""
        return False

    def _check_room(self, low: Any, high: Any) -> None:
        low, high = torch.as_tensor(low), torch.as_tensor(high)
        if not bool(((low >= self.least) & (low < high)).all()):
            raise ValueError(f"{self.name}: minimum = {self.minimum}, maximum = {self.maximum}; {self.room}")

    def bounds(self, p: Any, like: Tensor) -> tuple[Any, Any]:
        """Minimum and maximum: numbers, parameters of ``p``, or (size,) as ``like`` is where components differ."""

        def value(bound: Bound) -> Any:
            if isinstance(bound, str):
                return getattr(p, bound)
            return like.new_tensor(bound) if isinstance(bound, Sequence) else bound

        return value(self.minimum), value(self.maximum)

    def _inside(self, one: Tensor) -> Tensor:
        """A value between bounds that are numbers; one where they are parameters."""
        if isinstance(self.minimum, str) or isinstance(self.maximum, str):
            return one
        low, high = self.bounds(None, one)
        return one * (low + SHARE * (high - low))

    @property
    def n_bounded(self) -> int:
        return self.size

    @property
    def levels(self) -> tuple[Level, ...]:
        first = [Level(i, LOWER, INTERIOR if i in self.convex else UPPER) for i in range(self.n_bounded)]
        return (*first, *(Level(i, INTERIOR, UPPER) for i in self.convex))

    def by_kind(self, like: Tensor, affine: Callable[[], Tensor], convex: Callable[[], Tensor]) -> Tensor:
        """Values (..., m), each component's by its kind; what no component needs is not computed."""
        if len(self.convex) in (0, self.n_bounded):
            return convex() if self.convex else affine()
        which = torch.tensor([i in self.convex for i in range(self.n_bounded)], device=like.device)
        return torch.where(which, convex(), affine())

    def penalty(self, minimiser: Minimiser, p: Any, smoothing: Tensor) -> Tensor:
        low, high = self.bounds(p, smoothing)
        eta = minimiser.fraction

        def reward() -> Tensor:
            weight = smoothing * self.regulariser.penalty(eta) + self.switching_level * eta
            return self._rate(smoothing) * (high - low) * weight

        return self.by_kind(eta, reward, lambda: torch.zeros_like(eta)).sum(-1, keepdim=True)

    def _rate(self, like: Tensor) -> Any:
        if self.cost_rate is None:
            raise ValueError(f"{self.name}: cost_rate = None; allowed: a number (`adapted` finds one)")
        return like.new_tensor(self.cost_rate) if isinstance(self.cost_rate, tuple) else self.cost_rate

    def _scaled(self, gain: Tensor) -> Tensor:
        """S from a decrease of H per unit of control."""
        return gain / self._rate(gain)

    def _switching(self, at_lower: Tensor, at_upper: Tensor) -> Tensor:
        if not self.convex:
            return at_lower
        every = len(self.convex) == self.n_bounded
        return torch.cat([at_lower, at_upper if every else at_upper[..., list(self.convex)]], -1)


@dataclass(frozen=True)
class ThrustBall(Bounded):
    """A vector with minimum ≤ |T| ≤ maximum; dynamics read ``u.<name>`` (..., size) and ``u.<name>_magnitude`` (...,
    1).

    The two enter the Hamiltonian as independent arguments, H linear in the vector, so that no norm is differentiated:
    the direction is −primer/|primer| with primer = ∂H/∂vector, and S = (|primer| − ∂H/∂magnitude)/cost_rate
    (PoNN paper eq. 36–38). With size=1 it is a force of either sign whose magnitude is paid for; one that cannot turn
    round is a Box.
    """

    size: int = 3

    least: ClassVar[float] = 0.0
    room: ClassVar[str] = "0 ≤ minimum < maximum"

    @property
    def names(self) -> dict[str, int]:
        return {self.name: self.size, f"{self.name}_magnitude": 1}

    @property
    def n_bounded(self) -> int:
        return 1

    def _controls(self, vector: Tensor, magnitude: Tensor) -> dict[str, Tensor]:
        return {self.name: vector, f"{self.name}_magnitude": magnitude}

    def probe(self, one: Tensor) -> dict[str, Tensor]:
        magnitude = self._inside(one)
        return self._controls(magnitude.expand(*one.shape[:-1], self.size) / self.size**0.5, magnitude)

    def _slopes(self, h: Hamiltonian, vector: Tensor, magnitude: Tensor) -> tuple[Tensor, ...]:
        """The primer ∂H/∂vector (..., size) and ∂H/∂magnitude (..., 1)."""
        return gradients(lambda vector, magnitude: h(**self._controls(vector, magnitude)), vector, magnitude)

    @torch.no_grad()
    def adapted(self, h: Hamiltonian, cost: Hamiltonian, p: Any, one: Tensor, unit: float) -> ThrustBall:
        low, high = (torch.as_tensor(b, dtype=one.dtype) for b in self.bounds(p, one))
        self._check_room(low, high)
        zero = torch.zeros_like(one)
        vector = zero.expand(*one.shape[:-1], self.size)
        probes = [
            self._slopes(h, high * _random(one, self.size, seed), zero + low + share * (high - low))
            for seed, share in enumerate((0.0, SHARE, 1.0))
        ]
        if not all(_negligible(primer - probes[0][0], primer) for primer, _ in probes):
            raise ValueError(
                f"{self.name}: the Hamiltonian is not linear in the vector u.{self.name}; "
                f"write its norm as u.{self.name}_magnitude, and multiply no vector with a magnitude"
            )
        first, third, last = (slope for _, slope in probes)
        bend = last - first
        if not _negligible(third - first - SHARE * bend, first, third, last):
            raise ValueError(f"{self.name}: the Hamiltonian is neither affine nor quadratic in its magnitude")
        if _nowhere_convex(bend, first, last):
            raise ValueError(f"{self.name}: the Hamiltonian is concave in its magnitude; allowed: affine or convex")
        convex = () if _negligible(bend, first, last) else (0,)
        slope = ((cost(**self._controls(vector, zero + high)) - cost(**self._controls(vector, zero))) / high).flatten()
        constant = float(slope.min()) > 0 and float(slope.max() - slope.min()) <= 1e-9 * float(slope.max())
        rate = self.cost_rate or (float(slope[0]) if constant else unit / float(high.max()))
        return replace(self, convex=convex, cost_rate=rate)

    def minimise(self, h: Hamiltonian, p: Any, like: Tensor, regime: Regime) -> Minimiser:
        low, high = self.bounds(p, like)
        zero = torch.zeros_like(like)
        vector = zero.expand(*like.shape[:-1], self.size)
        primer, slope = self._slopes(h, vector, zero + low)
        square = (primer * primer).sum(-1, keepdim=True)
        some = square > 0  # where the primer vanishes no direction is better than another, and none is taken
        inverse = torch.rsqrt(torch.where(some, square, 1.0))
        norm = square * inverse
        at_lower = self._scaled(norm - slope)
        at_upper = self._scaled(norm - self._slopes(h, vector, zero + high)[1]) if self.convex else at_lower
        fraction = _fraction(at_lower, at_upper, self, regime)
        magnitude = low + (high - low) * fraction
        control = self._controls(-(magnitude * inverse) * primer, magnitude)
        return Minimiser(control, self._switching(at_lower, at_upper), fraction)

    def samples(self, minimiser: Minimiser, p: Any) -> Minimiser:
        low, high = self.bounds(p, minimiser.fraction)
        vector, eta = minimiser.control[self.name], minimiser.fraction
        some = vector.abs().amax(-1, keepdim=True) > 0
        own = sampling.unit(torch.where(some, vector, torch.eye(self.size).to(vector)[0]))
        along, turned, any_way = sampling.fractions(eta), sampling.unit(own + sampling.steps(own)), sampling.ways(own)
        direction = torch.cat([own.expand(len(along), *own.shape), turned, any_way])
        fraction = torch.cat([along, eta.expand(len(turned), *eta.shape), along[: len(any_way)]])
        magnitude = low + (high - low) * fraction
        return minimiser._replace(control=self._controls(magnitude * direction, magnitude), fraction=fraction)


@dataclass(frozen=True)
class Box(Bounded):
    """Components with minimum ≤ u_i ≤ maximum, each entering H apart from the others, affine or convex.

    A bound may also be a sequence of numbers, one per component. Convex means quadratic; where H is anything else, or
    convex for some costates and concave for others, ``Stationary`` finds minima inside the range.
    """

    allowed: ClassVar[str] = "a finite number, one for every component, or the name of a parameter"

    def __post_init__(self) -> None:
        for label in ("minimum", "maximum"):
            bound = getattr(self, label)
            if isinstance(bound, Sequence) and not isinstance(bound, str):
                object.__setattr__(self, label, tuple(bound))
        super().__post_init__()

    def _per_component(self, bound: Any) -> bool:
        return isinstance(bound, tuple) and len(bound) == self.size and all(map(finite, bound))

    @property
    def names(self) -> dict[str, int]:
        return {self.name: self.size}

    def probe(self, one: Tensor) -> dict[str, Tensor]:
        return {self.name: self._inside(one).expand(*one.shape[:-1], self.size)}

    def _slope(self, h: Hamiltonian, u: Tensor) -> Tensor:
        return gradients(lambda u: h(**{self.name: u}), u)[0]

    @torch.no_grad()
    def adapted(self, h: Hamiltonian, cost: Hamiltonian, p: Any, one: Tensor, unit: float) -> Box:
        low, high = (torch.as_tensor(b, dtype=one.dtype) for b in self.bounds(p, one))
        self._check_room(low, high)
        span = (high - low).expand(*one.shape[:-1], self.size)
        start, convex = 0.5 + 0.5 * _random(one, self.size), []
        for i in range(self.size):
            slopes = []
            for share in (0.0, SHARE, 1.0):
                eta = start.clone()
                eta[..., i] = share
                slopes.append(span * self._slope(h, low + span * eta))
            others = [k for k in range(self.size) if k != i]
            if not _negligible((slopes[2] - slopes[0])[..., others], *(slope[..., others] for slope in slopes)):
                raise ValueError(f"{self.name}: the Hamiltonian couples its components; a box needs a separable H")
            first, third, last = (slope[..., [i]] for slope in slopes)
            bend = last - first
            if not _negligible(third - first - SHARE * bend, first, third, last):
                raise ValueError(
                    f"{self.name}: the Hamiltonian is neither affine nor quadratic in component {i}; a smooth one "
                    "needs Stationary over the same range, a kink as in |u| a ThrustBall or two non-negative parts of u"
                )
            if _nowhere_convex(bend, first, last):
                raise ValueError(
                    f"{self.name}: the Hamiltonian is concave in component {i}; allowed: affine or convex, whatever "
                    "the signs of the costates; Stationary over the same range takes the lowest H, wherever it is"
                )
            if not _negligible(bend, first, last):
                convex.append(i)
        rates = tuple(unit / width for width in span.amax(0).tolist())
        rate = self.cost_rate or (rates[0] if len(set(rates)) == 1 else rates)
        return replace(self, convex=tuple(convex), cost_rate=rate)

    def minimise(self, h: Hamiltonian, p: Any, like: Tensor, regime: Regime) -> Minimiser:
        low, high = self.bounds(p, like)
        zero = torch.zeros_like(like).expand(*like.shape[:-1], self.size)
        at_lower = self._scaled(-self._slope(h, zero + low))
        at_upper = self._scaled(-self._slope(h, zero + high)) if self.convex else at_lower
        fraction = _fraction(at_lower, at_upper, self, regime)
        return Minimiser({self.name: low + (high - low) * fraction}, self._switching(at_lower, at_upper), fraction)

    def samples(self, minimiser: Minimiser, p: Any) -> Minimiser:
        low, high = self.bounds(p, minimiser.fraction)
        fraction = sampling.fractions(minimiser.fraction)
        return minimiser._replace(control={self.name: low + (high - low) * fraction}, fraction=fraction)
