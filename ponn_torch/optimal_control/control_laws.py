"""Minimisers of the Hamiltonian over a control set, smoothed by a regulariser or pinned to an arc.

A control set sees the Hamiltonian only as a function of its control, ``h(**control) -> (..., 1)``, at a fixed time,
state and costate. It answers with the minimiser and with its *switching functions*: the scalars whose zeros separate
the arcs. A bounded scalar control is written lower + (upper − lower) η with η ∈ [0, 1], and S = −(∂H/∂η)/s with s a
constant in cost per time. Three regimes:

- smoothed, H affine in η: ``s ρ e(η)`` is added to the running cost, so the minimum principle stays exact at every ρ;
- H convex in η (``curved``): the minimiser is S/curvature clipped to [0, 1] and needs no smoothing;
- on an arc: the control is at the bound, or in the interior, that the arc's code names.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, SupportsFloat

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import gradients
from ponn_torch.optimal_control import sampling
from ponn_torch.optimal_control.regularisers import Entropy, Regulariser

Hamiltonian = Callable[..., Tensor]

LOWER, INTERIOR, UPPER = 0, 1, 2  # codes of an arc


class Minimiser(NamedTuple):
    """What a control set answers: the control by name, S (..., m) and the fraction η (..., m) of its range."""

    control: dict[str, Tensor]
    switching: Tensor
    fraction: Tensor


# -- one bounded scalar ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Regime:
    """How a bounded control is chosen: smoothed by ρ (..., 1), or pinned to arc codes (..., m)."""

    smoothing: Tensor | None = None
    arcs: Tensor | None = None


def _fraction(at_lower: Tensor, at_upper: Tensor, curved: bool, law: Bounded, regime: Regime) -> Tensor:
    """η (..., m) from S at both bounds: ``at_lower`` = S(η=0), ``at_upper`` = S(η=1), equal where H is affine."""
    if curved:
        curvature = at_lower - at_upper
        free = at_lower / torch.where(curvature > 0, curvature, torch.ones_like(curvature))
        smooth = free.clamp(0.0, 1.0)
    elif regime.arcs is None:
        if regime.smoothing is None:
            return (at_lower > 0).to(at_lower.dtype)
        return law.regulariser.fraction(at_lower - law.switching_level, regime.smoothing)
    else:
        free = smooth = 0.5 * torch.ones_like(at_lower)
    if regime.arcs is None:
        return smooth
    zero, one = torch.zeros_like(at_lower), torch.ones_like(at_lower)
    return torch.where(regime.arcs == LOWER, zero, torch.where(regime.arcs == UPPER, one, free))


# -- control sets ----------------------------------------------------------------------------------------------------


class ControlSet(Protocol):
    """The admissible controls and the minimiser of the Hamiltonian over them."""

    @property
    def names(self) -> dict[str, int]:
        """Names and sizes of the controls that the dynamics read."""
        ...

    @property
    def n_switching(self) -> int:
        """Number of switching functions; 0 where the control has no bound."""
        ...

    @property
    def curved(self) -> bool:
        """Whether H is convex in the bounded control: every component then has two switching functions."""
        ...

    def probe(self, one: Tensor) -> dict[str, Tensor]:
        """An admissible control with the batch shape of ``one`` (..., 1)."""
        ...

    def adapted(self, h: Hamiltonian, cost: Hamiltonian, p: Any, one: Tensor, unit: float) -> ControlSet:
        """A copy that knows, from probes of H and of the running cost, whether H is curved and what s is.

        ``unit`` is the scale of H, in cost per time, where the running cost does not tell s.
        """
        ...

    def minimise(self, h: Hamiltonian, p: Any, like: Tensor, regime: Regime) -> Minimiser:
        """Minimise h; ``like`` is any (..., 1) tensor of the right shape, ``p`` the problem's parameters."""
        ...

    def penalty(self, minimiser: Minimiser, p: Any, smoothing: Tensor) -> Tensor:
        """What the regulariser adds to the running cost, (..., 1)."""
        ...

    def arc_codes(self, switching: Tensor) -> Tensor:
        """Arc codes (..., m) that the minimum principle asks for, from the switching functions."""
        ...

    def samples(self, minimiser: Minimiser, p: Any) -> Minimiser:
        """Other admissible controls, and their η, on a new first axis: far from the given one and near it."""
        ...


@dataclass(frozen=True)
class Unconstrained:
    """Control in ℝᵐ with H quadratic in it: u = −H_uu⁻¹ H_u(0), exact in one step."""

    name: str
    size: int

    @property
    def names(self) -> dict[str, int]:
        return {self.name: self.size}

    @property
    def n_switching(self) -> int:
        return 0

    @property
    def curved(self) -> bool:
        return False

    def probe(self, one: Tensor) -> dict[str, Tensor]:
        return {self.name: one.expand(*one.shape[:-1], self.size)}

    @torch.no_grad()
    def adapted(self, h: Hamiltonian, cost: Hamiltonian, p: Any, one: Tensor, unit: float) -> Unconstrained:
        # third difference along a generic ray: zero where H is quadratic in u
        ray = [h(**{self.name: k * self.probe(one)[self.name]}) for k in (0.0, 1.0, 2.0, 3.0)]
        third = ray[3] - 3 * ray[2] + 3 * ray[1] - ray[0]
        if bool((third.abs() > 1e-9 * sum(r.abs() for r in ray)).any()):
            raise ValueError(
                f"control {self.name!r}: the Hamiltonian is not quadratic in it, so ∂H/∂u = 0 has no closed form"
            )
        try:
            self.minimise(h, p, one, Regime())
        except torch.linalg.LinAlgError:  # type: ignore[attr-defined]
            raise ValueError(
                f"control {self.name!r}: H_uu is singular, so ∂H/∂u = 0 does not determine it; "
                "where H is linear in a control, it needs bounds (Box, ThrustBall)"
            ) from None
        return self

    def minimise(self, h: Hamiltonian, p: Any, like: Tensor, regime: Regime) -> Minimiser:
        def gradient(u: Tensor) -> Tensor:
            return gradients(lambda u: h(**{self.name: u}), u)[0]

        zero = torch.zeros_like(like).expand(*like.shape[:-1], self.size).contiguous()
        at_zero = gradient(zero)
        units = torch.eye(self.size, dtype=like.dtype, device=like.device)
        # H is quadratic, so a unit step in the gradient is a column of H_uu
        hessian = torch.stack([gradient(zero + unit) - at_zero for unit in units], -1)
        u = -torch.linalg.solve(hessian, at_zero.unsqueeze(-1)).squeeze(-1)
        none = like[..., :0]
        return Minimiser({self.name: u}, none, none)

    def penalty(self, minimiser: Minimiser, p: Any, smoothing: Tensor) -> Tensor:
        return torch.zeros_like(smoothing)

    def arc_codes(self, switching: Tensor) -> Tensor:
        return torch.zeros_like(switching, dtype=torch.long)

    def samples(self, minimiser: Minimiser, p: Any) -> Minimiser:
        u = minimiser.control[self.name]
        size = u.abs().flatten(0, -2).amax(0)
        size = torch.where(size > 0, size, 1.0)
        return minimiser._replace(control={self.name: u + size * sampling.steps(u)})


@dataclass(frozen=True)
class Bounded:
    """What thrust balls and boxes share: bounds (numbers, or names of parameters), a regulariser, a scale.

    ``cost_rate`` is s per unit of control, in cost per time and control; found by a probe of H where it is None.
    ``switching_level`` is S_c of the PoNN paper's eq. 45. ``curved`` is set by ``adapted``.
    """

    name: str
    maximum: float | str
    minimum: float | str = 0.0
    regulariser: Regulariser = field(default_factory=Entropy)
    switching_level: float = 0.0
    cost_rate: float | None = None
    curved: bool = False

    def __post_init__(self) -> None:
        for label in ("minimum", "maximum"):
            bound = getattr(self, label)
            if not (isinstance(bound, str) or (isinstance(bound, SupportsFloat) and math.isfinite(bound))):
                allowed = "a finite number, the same for all components, or the name of a parameter"
                raise ValueError(f"{self.name}: {label} = {bound!r}; allowed: {allowed}")

    def bounds(self, p: Any) -> tuple[Any, Any]:
        low, high = (getattr(p, b) if isinstance(b, str) else b for b in (self.minimum, self.maximum))
        return low, high

    def arc_codes(self, switching: Tensor) -> Tensor:
        if not self.curved:
            return torch.where(switching > 0, UPPER, LOWER)
        at_lower, at_upper = switching.chunk(2, -1)
        return (at_lower > 0).long() + (at_upper > 0).long()

    def penalty(self, minimiser: Minimiser, p: Any, smoothing: Tensor) -> Tensor:
        if self.curved:
            return torch.zeros_like(smoothing)
        low, high = self.bounds(p)
        eta = minimiser.fraction
        reward = smoothing * self.regulariser.penalty(eta) + self.switching_level * eta
        return (self.cost_rate * (high - low) * reward).sum(-1, keepdim=True)

    def _scaled(self, gain: Tensor) -> Tensor:
        """S from a decrease of H per unit of control."""
        if self.cost_rate is None:
            raise ValueError(f"{self.name}: cost_rate = None; allowed: a number (`adapted` finds one)")
        return gain / self.cost_rate

    def _switching(self, at_lower: Tensor, at_upper: Tensor) -> Tensor:
        return torch.cat([at_lower, at_upper], -1) if self.curved else at_lower


@dataclass(frozen=True)
class ThrustBall(Bounded):
    """A vector with minimum ≤ |T| ≤ maximum; dynamics read ``u.<name>`` (..., size) and ``u.<name>_magnitude`` (...,
    1).

    The two enter the Hamiltonian as independent arguments, H linear in the vector, so that no norm is differentiated:
    the direction is −primer/|primer| with primer = ∂H/∂vector, and S = (|primer| − ∂H/∂magnitude)/cost_rate
    (PoNN paper eq. 36–38).
    """

    size: int = 3

    @property
    def names(self) -> dict[str, int]:
        return {self.name: self.size, f"{self.name}_magnitude": 1}

    @property
    def n_switching(self) -> int:
        return 2 if self.curved else 1

    def _controls(self, vector: Tensor, magnitude: Tensor) -> dict[str, Tensor]:
        return {self.name: vector, f"{self.name}_magnitude": magnitude}

    def probe(self, one: Tensor) -> dict[str, Tensor]:
        return self._controls(one.expand(*one.shape[:-1], self.size) / self.size**0.5, one)

    @torch.no_grad()
    def adapted(self, h: Hamiltonian, cost: Hamiltonian, p: Any, one: Tensor, unit: float) -> ThrustBall:
        low, high = (torch.as_tensor(b, dtype=one.dtype) for b in self.bounds(p))
        if not bool(((low >= 0) & (low < high)).all()):
            raise ValueError(f"{self.name}: minimum = {self.minimum}, maximum = {self.maximum}; 0 ≤ minimum < maximum")
        zero = torch.zeros_like(one)
        vector = zero.expand(*one.shape[:-1], self.size)
        at = [h(**self._controls(vector, zero + k * high)) for k in (0.0, 0.5, 1.0)]
        size = (at[2] - at[0]).abs() + 1e-4 * sum(a.abs() for a in at)
        bend = at[2] - 2 * at[1] + at[0]
        curved = bool((bend.abs() > 1e-9 * size).any())
        if bool((bend < -1e-9 * size).any()):
            raise ValueError(f"{self.name}: the Hamiltonian is concave in its magnitude; allowed: affine or convex")
        slope = ((cost(**self._controls(vector, zero + high)) - cost(**self._controls(vector, zero))) / high).flatten()
        constant = float(slope.min()) > 0 and float(slope.max() - slope.min()) <= 1e-9 * float(slope.max())
        rate = self.cost_rate or (float(slope[0]) if constant else unit / float(high.max()))
        return replace(self, curved=curved, cost_rate=rate)

    def minimise(self, h: Hamiltonian, p: Any, like: Tensor, regime: Regime) -> Minimiser:
        low, high = self.bounds(p)

        def slopes(vector: Tensor, magnitude: Tensor) -> tuple[Tensor, ...]:
            return gradients(lambda vector, magnitude: h(**self._controls(vector, magnitude)), vector, magnitude)

        zero = torch.zeros_like(like)
        vector = zero.expand(*like.shape[:-1], self.size)
        primer, slope = slopes(vector, zero + low)
        square = (primer * primer).sum(-1, keepdim=True)
        some = square > 0  # where the primer vanishes no direction is better than another, and none is taken
        inverse = torch.rsqrt(torch.where(some, square, 1.0))
        norm = square * inverse
        at_lower = self._scaled(norm - slope)
        at_upper = self._scaled(norm - slopes(vector, zero + high)[1]) if self.curved else at_lower
        fraction = _fraction(at_lower, at_upper, self.curved, self, regime)
        magnitude = low + (high - low) * fraction
        control = self._controls(-(magnitude * inverse) * primer, magnitude)
        return Minimiser(control, self._switching(at_lower, at_upper), fraction)

    def samples(self, minimiser: Minimiser, p: Any) -> Minimiser:
        low, high = self.bounds(p)
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
    """Components with minimum ≤ u_i ≤ maximum, each entering H apart from the others, all affine or all convex."""

    size: int = 1

    @property
    def names(self) -> dict[str, int]:
        return {self.name: self.size}

    @property
    def n_switching(self) -> int:
        return (2 if self.curved else 1) * self.size

    def probe(self, one: Tensor) -> dict[str, Tensor]:
        return {self.name: one.expand(*one.shape[:-1], self.size)}

    @torch.no_grad()
    def adapted(self, h: Hamiltonian, cost: Hamiltonian, p: Any, one: Tensor, unit: float) -> Box:
        low, high = (torch.as_tensor(b, dtype=one.dtype) for b in self.bounds(p))
        if not bool((low < high).all()):
            raise ValueError(f"{self.name}: minimum = {self.minimum}, maximum = {self.maximum}; minimum < maximum")

        def gradient(u: Tensor) -> Tensor:
            return gradients(lambda u: h(**{self.name: u}), u)[0]

        zero = torch.zeros_like(one).expand(*one.shape[:-1], self.size).contiguous()
        base, changes, scale = gradient(zero + low), [], 0.0
        for i in range(self.size):
            step = zero.clone()
            step[..., i] = (high - low).flatten()[0]
            difference = gradient(zero + low + step) - base
            scale = max(scale, float(difference.abs().max()), 1e-12 * float(base.abs().max()))
            changes.append(float(difference[..., i].abs().max()))
            if float(difference[..., i].min()) < -1e-9 * float(base.abs().max()):
                raise ValueError(f"{self.name}: the Hamiltonian is concave in component {i}; allowed: affine or convex")
            difference[..., i] = 0.0
            if float(difference.abs().max()) > 1e-9 * scale:
                raise ValueError(f"{self.name}: the Hamiltonian couples its components; a box needs a separable H")
        convex = [change > 1e-9 * float(base.abs().max()) for change in changes]
        curved = any(convex)
        if curved and not all(convex):
            raise ValueError(
                f"{self.name}: the Hamiltonian is affine in component {convex.index(False)} and curved in component "
                f"{convex.index(True)}; a box needs all of one kind"
            )
        rate = self.cost_rate or unit / float((high - low).max())
        return replace(self, curved=curved, cost_rate=rate)

    def minimise(self, h: Hamiltonian, p: Any, like: Tensor, regime: Regime) -> Minimiser:
        low, high = self.bounds(p)

        def gradient(u: Tensor) -> Tensor:
            return gradients(lambda u: h(**{self.name: u}), u)[0]

        zero = torch.zeros_like(like).expand(*like.shape[:-1], self.size)
        at_lower = self._scaled(-gradient(zero + low))
        at_upper = self._scaled(-gradient(zero + high)) if self.curved else at_lower
        fraction = _fraction(at_lower, at_upper, self.curved, self, regime)
        return Minimiser({self.name: low + (high - low) * fraction}, self._switching(at_lower, at_upper), fraction)

    def samples(self, minimiser: Minimiser, p: Any) -> Minimiser:
        low, high = self.bounds(p)
        fraction = sampling.fractions(minimiser.fraction)
        return minimiser._replace(control={self.name: low + (high - low) * fraction}, fraction=fraction)
