"""Controls that enter the Hamiltonian as they like: ∂H/∂u = 0 solved point by point, steering angles above all.

The global minimum is picked from a coarse grid of the control's range, polished by Newton's method, and made
differentiable by one more Newton step: u − H_uu⁻¹ H_u(w) has the derivative −H_uu⁻¹ H_uw of the implicit function,
exactly, because H_u vanishes there. The number of steps is fixed, so that it is one function for every transform.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import gradients, gradients_and_values
from ponn_torch.optimal_control import sampling
from ponn_torch.optimal_control.control_set import Hamiltonian, Minimiser, Regime, Unbounded


@dataclass(frozen=True)
class Stationary(Unbounded):
    """Control in ℝᵐ with minimum ≤ u_i ≤ maximum, at the global minimum of H; an angle by default.

    Where the smallest value of H lies on the edge of the range, the control stays there; H should be smooth inside.
    First derivatives are exact, second ones are not.

    Attributes:
        n_grid: candidates per component. n_newton: steps from the best one.
        periodic: per component, H is the same at both ends of the range; found by ``adapted``. Such a component is
            reported within the range, and may jump from one end to the other: choose the range so that it does not.
    """

    name: str
    size: int = 1
    minimum: float = -math.pi
    maximum: float = math.pi
    n_grid: int = 12
    n_newton: int = 5
    periodic: tuple[bool, ...] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.minimum) and math.isfinite(self.maximum) and self.minimum < self.maximum):
            raise ValueError(f"{self.name}: minimum = {self.minimum}, maximum = {self.maximum}; minimum < maximum")
        for name, least in (("size", 1), ("n_grid", 3), ("n_newton", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{self.name}: {name} = {getattr(self, name)}; allowed: from {least}")

    @property
    def names(self) -> dict[str, int]:
        return {self.name: self.size}

    def probe(self, one: Tensor) -> dict[str, Tensor]:
        inside = self.minimum + 0.37 * (self.maximum - self.minimum)
        return {self.name: inside * one.expand(*one.shape[:-1], self.size)}

    @torch.no_grad()
    def adapted(self, h: Hamiltonian, cost: Hamiltonian, p: Any, one: Tensor, unit: float) -> Stationary:
        middle = self.probe(one)[self.name]
        size = sum(h(**{self.name: middle + shift}).abs() for shift in (0.0, 0.1, -0.1))
        periodic = []
        for i in range(self.size):
            low, high = middle.clone(), middle.clone()
            low[..., i], high[..., i] = self.minimum, self.maximum
            gap = (h(**{self.name: low}) - h(**{self.name: high})).abs()
            periodic.append(bool((gap <= 1e-9 * size).all()))
        law = replace(self, periodic=tuple(periodic))
        u = law._minimiser(h, one)
        gradient, hessian = law._derivatives(h, u)
        inside = (gradient.abs() <= 1e-6 * size).all(-1)
        convex = (torch.linalg.eigvalsh(hessian) > 1e-9 * size).all(-1)
        if not bool(inside.any()):
            raise ValueError(
                f"control {self.name!r}: the Hamiltonian has no stationary point between {self.minimum:g} and "
                f"{self.maximum:g}; a control that always sits at its bounds needs a Box, and H affine in it"
            )
        if not bool((inside & convex).any()):
            raise ValueError(
                f"control {self.name!r}: H_uu is not positive where ∂H/∂u = 0, so that the minimum does not "
                "determine it; where H is linear in a control, it needs bounds (Box, ThrustBall)"
            )
        return law

    def minimise(self, h: Hamiltonian, p: Any, like: Tensor, regime: Regime) -> Minimiser:
        with torch.no_grad():
            u = self._minimiser(h, like)
            slope, hessian = self._derivatives(h, u)
            held = self._at_edge(u, slope)
        # H_uu may be a constant here: its derivative is multiplied by H_u = 0
        step = self._solve(hessian, torch.where(held, torch.zeros_like(u), self._slope(h, u)))
        none = like[..., :0]
        return Minimiser({self.name: u - step}, none, none)

    def samples(self, minimiser: Minimiser, p: Any) -> Minimiser:
        width = self.maximum - self.minimum
        fraction = sampling.fractions((minimiser.control[self.name] - self.minimum) / width)
        return minimiser._replace(control={self.name: self.minimum + width * fraction})

    # -- the minimum at fixed states and costates --------------------------------------------------------------

    @property
    def _spacing(self) -> float:
        return (self.maximum - self.minimum) / self.n_grid

    def _minimiser(self, h: Hamiltonian, like: Tensor) -> Tensor:
        """u (..., m) by grid and Newton, without a derivative."""
        u = self._best_of_grid(h, like)
        for _ in range(self.n_newton):
            slope, hessian = self._derivatives(h, u)
            held = self._at_edge(u, slope)
            step = self._solve(hessian, torch.where(held, torch.zeros_like(u), slope))
            u = self._into_range(u - step.clamp(-self._spacing, self._spacing))
        return u

    def _best_of_grid(self, h: Hamiltonian, like: Tensor) -> Tensor:
        middles = [self.minimum + (i + 0.5) * self._spacing for i in range(self.n_grid)]
        one = torch.ones_like(like)
        candidates = [torch.cat([value * one for value in values], -1) for values in product(middles, repeat=self.size)]
        best, lowest = candidates[0], h(**{self.name: candidates[0]})
        for candidate in candidates[1:]:
            value = h(**{self.name: candidate})
            best = torch.where(value < lowest, candidate, best)
            lowest = torch.minimum(value, lowest)
        return best

    def _slope(self, h: Hamiltonian, u: Tensor) -> Tensor:
        return gradients(lambda u: h(**{self.name: u}), u)[0]

    def _derivatives(self, h: Hamiltonian, u: Tensor) -> tuple[Tensor, Tensor]:
        """H_u (..., m) and H_uu (..., m, m)."""

        def component(i: int) -> Callable[[Tensor], tuple[Tensor, tuple[Tensor]]]:
            def function(u: Tensor) -> tuple[Tensor, tuple[Tensor]]:
                slope = self._slope(h, u)
                return slope[..., i], (slope,)

            return function

        rows = [gradients_and_values(component(i), u) for i in range(self.size)]
        return rows[0][1][0], torch.stack([row for (row,), _ in rows], -2)

    def _solve(self, hessian: Tensor, slope: Tensor) -> Tensor:
        """|H_uu|⁻¹ H_u: downhill also where H is not convex; no step where H does not depend on u."""
        if self.size == 1:
            curvature = hessian[..., 0].abs()
            return torch.where(curvature > 0, slope / torch.where(curvature > 0, curvature, 1.0), 0.0)
        values, vectors = torch.linalg.eigh(hessian)
        size = values.abs()
        inverse = torch.where(size > 0, 1.0 / torch.where(size > 0, size, 1.0), 0.0)
        return (vectors @ (inverse.unsqueeze(-1) * (vectors.mT @ slope.unsqueeze(-1)))).squeeze(-1)

    def _wraps(self, like: Tensor) -> Tensor:
        return torch.tensor(self.periodic or (False,) * self.size, device=like.device)

    def _at_edge(self, u: Tensor, slope: Tensor) -> Tensor:
        """Components whose minimum lies outside the range."""
        low, high = (u <= self.minimum) & (slope > 0), (u >= self.maximum) & (slope < 0)
        return (low | high) & ~self._wraps(u)

    def _into_range(self, u: Tensor) -> Tensor:
        wrapped = self.minimum + torch.remainder(u - self.minimum, self.maximum - self.minimum)
        return torch.where(self._wraps(u), wrapped, u.clamp(self.minimum, self.maximum))
