"""Free functions: those linear in their weights, g(z) = sum_l w_l phi_l(z), with exact derivatives of any order.

A basis holds the architecture only; its output weights are arguments, so segments and samples can be batched.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ponn_torch.numerics.nodes import differentiation_matrix, interpolation_matrix


class FreeFunction(nn.Module, ABC):
    """A function g of z whose weights are an argument: linear in them (a basis) or not (a network)."""

    @property
    @abstractmethod
    def arguments(self) -> dict[str, Any]:
        """What the class is called with, in JSON's types, to make this function again up to its buffers."""

    def coarser(self, share: float) -> FreeFunction:
        """The same with a share of its functions, if they are the first ones of a sequence that converges."""
        return self


class LinearBasis(FreeFunction):
    """`size` functions phi_l, tabulated with their derivatives by `features`."""

    size: int

    def __init__(self, size: int) -> None:
        super().__init__()
        if size < 1:
            raise ValueError(f"size = {size} is not a number of functions; allowed: at least 1")
        self.size = size

    @property
    def arguments(self) -> dict[str, Any]:
        return {"size": self.size}

    @abstractmethod
    def features(self, z: Tensor, order: int) -> Tensor:
        """Derivatives 0..order of every function at z (n,): (order+1, n, L)."""

    def beyond(self, n_supports: int) -> LinearBasis:
        """The same number of functions, without those that n_supports polynomial supports span already."""
        return self

    def jet(self, weights: Tensor, z: Tensor, order: int) -> Tensor:
        """g and its derivatives for weights (..., L, d) at z (n,): (..., order+1, n, d)."""
        return torch.einsum("onl,...ld->...ond", self.features(z, order), weights)


class _OrthogonalPolynomials(LinearBasis):
    """Degrees lowest_degree .. lowest_degree + size - 1 of p_{k+1} = a_k z p_k - c_k p_{k-1}."""

    def __init__(self, size: int, lowest_degree: int = 0) -> None:
        super().__init__(size)
        if lowest_degree < 0:
            raise ValueError(f"lowest_degree = {lowest_degree} is not a degree; allowed: at least 0")
        self.lowest_degree = lowest_degree

    @property
    def arguments(self) -> dict[str, Any]:
        return {"size": self.size, "lowest_degree": self.lowest_degree}

    def beyond(self, n_supports: int) -> LinearBasis:
        return type(self)(self.size, lowest_degree=self.lowest_degree + n_supports)

    def coarser(self, share: float) -> LinearBasis:
        size = max(1, round(share * self.size))
        return self if size == self.size else type(self)(size, lowest_degree=self.lowest_degree)

    @staticmethod
    @abstractmethod
    def recurrence(degree: int) -> tuple[float, float]:
        """(a_k, c_k)."""

    def features(self, z: Tensor, order: int) -> Tensor:
        # Leibniz: (z p)^(e) = z p^(e) + e p^(e-1)
        lower = torch.diag(torch.arange(1, order + 1, dtype=z.dtype, device=z.device), -1)
        previous = z.new_zeros(order + 1, z.shape[0])
        current = torch.cat([torch.ones_like(previous[:1]), previous[1:]])
        polynomials = [current]
        for degree in range(self.lowest_degree + self.size - 1):
            a, c = self.recurrence(degree)
            rest = torch.addmm(previous, lower, current, beta=-c, alpha=a)
            previous, current = current, torch.addcmul(rest, z, current, value=a)
            polynomials.append(current)
        return torch.stack(polynomials[self.lowest_degree :], dim=-1)


class Chebyshev(_OrthogonalPolynomials):
    """Chebyshev polynomials T_k of the first kind; lowest_degree leaves out those that constraints span."""

    @staticmethod
    def recurrence(degree: int) -> tuple[float, float]:
        return (2.0, 1.0) if degree else (1.0, 0.0)


class Legendre(_OrthogonalPolynomials):
    """Legendre polynomials P_k (P_k(1) = 1); lowest_degree leaves out those that constraints span."""

    @staticmethod
    def recurrence(degree: int) -> tuple[float, float]:
        return (2 * degree + 1) / (degree + 1), degree / (degree + 1)


def _tanh(u: Tensor, order: int) -> Tensor:
    # every derivative is a polynomial in t = tanh u, because t' = 1 - t²
    t, derivatives = torch.tanh(u), []
    polynomial, slope = np.polynomial.Polynomial([0, 1]), np.polynomial.Polynomial([1, 0, -1])
    for _ in range(order + 1):
        value = torch.zeros_like(t)
        for coefficient in reversed(polynomial.coef.tolist()):
            value = value * t + coefficient
        derivatives.append(value)
        polynomial = polynomial.deriv() * slope
    return torch.stack(derivatives)


def _sigmoid(u: Tensor, order: int) -> Tensor:
    halves = torch.tensor([0.5 ** (e + 1) for e in range(order + 1)], dtype=u.dtype, device=u.device)
    stack = _tanh(u / 2, order) * halves.view(-1, *[1] * u.dim())
    return torch.cat([stack[:1] + 0.5, stack[1:]])


def _sin(u: Tensor, order: int) -> Tensor:
    sine, cosine = torch.sin(u), torch.cos(u)
    cycle = (sine, cosine, -sine, -cosine)
    return torch.stack([cycle[e % 4] for e in range(order + 1)])


def _gaussian(u: Tensor, order: int) -> Tensor:
    # exp(-u²) by the recurrence of Hermite polynomials
    derivatives = [torch.exp(-(u**2))]
    for e in range(order):
        before = derivatives[e - 1] if e else torch.zeros_like(u)
        derivatives.append(-2 * (u * derivatives[e] + e * before))
    return torch.stack(derivatives)


def _gated(gate: Callable[[Tensor, int], Tensor]) -> Callable[[Tensor, int], Tensor]:
    """u gate(u); Leibniz: (u g)^(e) = u g^(e) + e g^(e-1)."""

    def activation(u: Tensor, order: int) -> Tensor:
        stack = gate(u, order)
        counts = torch.arange(1, order + 1, dtype=u.dtype, device=u.device).view(-1, *[1] * u.dim())
        return torch.cat([u * stack[:1], u * stack[1:] + counts * stack[:-1]])

    return activation


def _normal(u: Tensor, order: int) -> Tensor:
    # the normal distribution, whose slope is a Gaussian of u/√2
    halves = torch.tensor([2.0 ** (-e / 2) for e in range(order + 1)], dtype=u.dtype, device=u.device)
    density = _gaussian(u / 2**0.5, order) * (halves / (2 * np.pi) ** 0.5).view(-1, *[1] * u.dim())
    return torch.cat([torch.special.ndtr(u)[None], density[:-1]])


ACTIVATIONS: dict[str, Callable[[Tensor, int], Tensor]] = {  # (u, order) -> (order+1, *u.shape)
    "tanh": _tanh,
    "sin": _sin,
    "sigmoid": _sigmoid,
    "gaussian": _gaussian,
    "gelu": _gated(_normal),
    "silu": _gated(_sigmoid),
}

# Slopes up to these resolve smooth functions on [-1, 1] with 30 to 80 units (measured on second derivatives);
# flatter units are nearly dependent, steeper ones leave gaps.
DEFAULT_SLOPES: dict[str, float] = {
    "tanh": 6.0,
    "sin": 24.0,
    "sigmoid": 12.0,
    "gaussian": 9.0,
    "gelu": 9.0,
    "silu": 12.0,
}


def _powers(slopes: Tensor, order: int) -> Tensor:
    return torch.stack([slopes**e for e in range(order + 1)])


class RandomFeatures(LinearBasis):
    """The hidden layer of an extreme learning machine: activation(w_l z + b_l) with random, kept w and b.

    w is uniform in weight_range. With bias_range None, b = -w c with centres c uniform in [-1, 1], so that
    every unit changes inside the interval; with a bias_range, b is uniform in it, independent of w, as in the
    papers. The default weight_range resolves smooth functions with 30 to 80 units.

    Raises ValueError for an unknown activation or a range that is not (low, high) with low < high.
    """

    weight: Tensor
    bias: Tensor

    def __init__(
        self,
        size: int,
        activation: str = "tanh",
        *,
        seed: int = 0,
        weight_range: Sequence[float] | None = None,
        bias_range: Sequence[float] | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(size)
        if activation not in ACTIVATIONS:
            raise ValueError(f"activation = {activation!r} is unknown; allowed: {', '.join(ACTIVATIONS)}")
        self.activation = activation
        generator = torch.Generator().manual_seed(seed)

        def uniform(field: str, limits: Sequence[float]) -> Tensor:
            low, high = limits
            if not low < high:
                raise ValueError(f"{field} = {tuple(limits)} is empty; allowed: (low, high) with low < high")
            return low + (high - low) * torch.rand(size, generator=generator, dtype=torch.float64)

        slope = DEFAULT_SLOPES[activation]
        weight = uniform("weight_range", (-slope, slope) if weight_range is None else weight_range)
        bias = -weight * uniform("centres", (-1.0, 1.0)) if bias_range is None else uniform("bias_range", bias_range)
        self.register_buffer("weight", weight.to(device=device, dtype=dtype))
        self.register_buffer("bias", bias.to(device=device, dtype=dtype))

    @property
    def arguments(self) -> dict[str, Any]:
        return {"size": self.size, "activation": self.activation}

    def features(self, z: Tensor, order: int) -> Tensor:
        stack = ACTIVATIONS[self.activation](z[:, None] * self.weight + self.bias, order)
        return stack * _powers(self.weight, order)[:, None, :]


class GaussianRBF(LinearBasis):
    """Gaussians exp(-(shape (z - centre))^2).

    centres: their positions (L,), or a number of evenly spaced ones. shape: one number, or one per centre
    (..., L); leading axes (the particles of a search) come back in `features` as (order+1, ..., n, L).

    Raises ValueError when there are neither one nor L shapes.
    """

    centres: Tensor
    shape: Tensor

    def __init__(
        self,
        centres: int | Sequence[float] | Tensor,
        shape: float | Sequence[float] | Tensor,
        *,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        positions = torch.linspace(-1.0, 1.0, centres, dtype=dtype) if isinstance(centres, int) else centres
        positions = torch.as_tensor(positions, dtype=dtype, device=device)
        super().__init__(positions.shape[-1])
        shapes = torch.as_tensor(shape, dtype=dtype, device=device)
        if shapes.dim() and shapes.shape[-1] != self.size:
            raise ValueError(f"shape has {shapes.shape[-1]} entries; allowed: 1 or one per centre, {self.size}")
        self.register_buffer("centres", positions)
        self.register_buffer("shape", shapes.repeat(self.size) if shapes.dim() == 0 else shapes)

    @property
    def arguments(self) -> dict[str, Any]:
        return {"centres": self.centres.tolist(), "shape": self.shape.tolist()}

    def features(self, z: Tensor, order: int) -> Tensor:
        slopes = self.shape.unsqueeze(-2)
        return ACTIVATIONS["gaussian"](slopes * (z[:, None] - self.centres), order) * _powers(slopes, order)


class Lagrange(LinearBasis):
    """Polynomials that are 1 at one of the points and 0 at the others: weights are values at the points (L,).

    Raises ValueError when two points coincide.
    """

    points: Tensor

    def __init__(
        self,
        points: Sequence[float] | Tensor,
        *,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        positions = torch.as_tensor(points, dtype=dtype, device=device)
        super().__init__(positions.shape[-1])
        self.register_buffer("points", positions)

    @property
    def arguments(self) -> dict[str, Any]:
        return {"points": self.points.tolist()}

    def features(self, z: Tensor, order: int) -> Tensor:
        stack = [interpolation_matrix(self.points, z)]
        slopes = differentiation_matrix(self.points)
        for _ in range(order):
            stack.append(stack[-1] @ slopes)
        return torch.stack(stack)
