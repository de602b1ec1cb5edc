"""Deep free functions: multilayer perceptrons with several outputs, and their exact derivatives in z.

Not values but truncated Taylor series in z run through the layers, so that all derivatives come from one forward pass.
The weights are an argument, a flat vector with any leading axes (segments, samples). The reverse pass is written by
hand: the gradient of one output at one node is an outer product per layer, which gives the rows of a Jacobian for the
price of the forward pass's matrix products.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from ponn_torch.ansatz.basis import ACTIVATIONS, FreeFunction, LinearBasis

# -- Taylor arithmetic -----------------------------------------------------------------------------------------------


def compose(derivatives: Tensor, inner: Tensor) -> tuple[Tensor, Tensor]:
    """Taylor coefficients (q+1, ...) of σ(a(z)) and of σ'(a(z)) from those of a.

    derivatives (q+2, ...) are those of σ at a₀. As c = σ⁽ᵐ⁾(a) has the derivative σ⁽ᵐ⁺¹⁾(a) a', the coefficients obey
    k c_k = Σ_j j a_j c'_{k−j}: Faà di Bruno's formula without its partitions.
    """
    order = len(inner) - 1
    slope = series = [derivatives[order + 1]]
    for m in range(order, -1, -1):
        slope, series = series, [derivatives[m]]
        for k in range(1, min(order, order + 1 - m) + 1):
            series.append(torch.stack([j * inner[j] * slope[k - j] for j in range(1, k + 1)]).sum(0) / k)
    return torch.stack(series), torch.stack(slope)


def _factorials(order: int, like: Tensor) -> Tensor:
    return like.new_tensor([math.factorial(e) for e in range(order + 1)])


def _correlate(outer: Tensor, slope: Tensor) -> Tensor:
    """Σ_{k≥j} outer_k slope_{k−j}: the transpose of multiplying a series by ``slope``."""
    order = len(outer) - 1
    return torch.stack([(outer[j:] * slope[: order + 1 - j]).sum(0) for j in range(order + 1)])


# -- the architecture ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Trace:
    """What the reverse pass needs of a forward pass: per hidden layer its input, its argument, its slope; the last
    hidden layer's output. Taylor coefficients (q+1, ..., n, units)."""

    inputs: list[Tensor]
    arguments: list[Tensor]
    slopes: list[Tensor]
    last: Tensor


class MLP(FreeFunction):
    """Hidden layers σ(h W + b) under a linear output layer, one output per head; the architecture only.

    The first layer's units change over about 1/first_scale, at even centres, so that they resolve the interval before
    training. There is no output bias: constraints take the constant away.

    Attributes:
        hidden: widths; the last one is the number of features that the output layer combines.
        residual: hidden layers after the first add to their input (equal widths).
        n_frequencies: sines and cosines of k π z/2, k = 1.. , beside z as inputs.
        adaptive_slope: one trainable factor of the arguments per hidden layer.
        shared: one trunk with several heads, or else one network per head.

    Raises:
        ValueError: an unknown activation, no hidden layer, or a residual layer that changes the width.
    """

    def __init__(
        self,
        hidden: Sequence[int] = (20, 40),
        activation: str = "tanh",
        *,
        residual: bool = False,
        n_frequencies: int = 0,
        adaptive_slope: bool = False,
        shared: bool = True,
        first_scale: float = 4.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if activation not in ACTIVATIONS:
            raise ValueError(f"activation = {activation!r} is unknown; allowed: {', '.join(ACTIVATIONS)}")
        if not hidden or min(hidden) < 1:
            raise ValueError(f"hidden = {list(hidden)}; allowed: at least one width, each at least 1")
        if residual and len(set(hidden)) > 1:
            raise ValueError(f"hidden = {list(hidden)} with residual = True; allowed: equal widths")
        if n_frequencies < 0:
            raise ValueError(f"n_frequencies = {n_frequencies}; allowed: at least 0")
        self.hidden, self.activation, self.residual = tuple(hidden), activation, residual
        self.n_frequencies, self.adaptive_slope, self.shared = n_frequencies, adaptive_slope, shared
        self.first_scale, self.seed = first_scale, seed

    @property
    def arguments(self) -> dict[str, Any]:
        names = ("activation", "residual", "n_frequencies", "adaptive_slope", "shared", "first_scale", "seed")
        return {"hidden": list(self.hidden), **{name: getattr(self, name) for name in names}}

    # -- layout of the weights ---------------------------------------------------------------------------------------

    @property
    def _widths(self) -> list[int]:
        return [1 + 2 * self.n_frequencies, *self.hidden]

    @property
    def n_hidden(self) -> int:
        """Hidden weights of one network."""
        slopes = len(self.hidden) if self.adaptive_slope else 0
        return sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(self._widths)) + slopes

    def n_weights(self, n_heads: int) -> int:
        return self.n_hidden * (1 if self.shared else n_heads) + self.hidden[-1] * n_heads

    def _nets(self, weights: Tensor) -> Tensor:
        """Weights (..., P) by network (..., B, P/B)."""
        size = weights.shape[-1] if self.shared else self.n_hidden + self.hidden[-1]
        return weights.unflatten(-1, (-1, size))

    def _layers(self, nets: Tensor) -> tuple[list[tuple[Tensor, Tensor, Tensor | None]], Tensor]:
        """(W (..., in, out), b (..., 1, out), slope (..., 1, 1) or None) of hidden layers, W of the output layer."""
        layers, start = [], 0
        for fan_in, fan_out in pairwise(self._widths):
            weight = nets[..., start : start + fan_in * fan_out].unflatten(-1, (fan_in, fan_out))
            start += fan_in * fan_out
            bias = nets[..., None, start : start + fan_out]
            start += fan_out
            slope = nets[..., None, start : start + 1] if self.adaptive_slope else None
            start += int(self.adaptive_slope)
            layers.append((weight, bias, slope))
        return layers, nets[..., start:].unflatten(-1, (self.hidden[-1], -1))

    def output_layer(self, n_heads: int) -> Tensor:
        """Ascending positions of the weights that enter linearly."""
        last = torch.zeros(self.n_weights(n_heads), dtype=torch.bool)
        self._nets(last)[..., self.n_hidden :] = True
        return last.nonzero()[:, 0]

    def initial(
        self, n_heads: int, *, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
    ) -> Tensor:
        """The weights (P,) that the seed gives."""
        generator = torch.Generator().manual_seed(self.seed)

        def symmetric(*shape: int) -> Tensor:
            return 2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1

        out = torch.ones(self.n_weights(n_heads), dtype=torch.float64)  # ones are left where slopes are
        for net in self._nets(out):
            layers, output = self._layers(net)
            for i, (weight, bias, _) in enumerate(layers):
                fan_in, fan_out = weight.shape
                if i == 0 and not self.n_frequencies:
                    share = symmetric(1, fan_out)
                    weight.copy_(self.first_scale * share.sign() * (0.25 + 0.75 * share.abs()))
                    bias.copy_(-weight * torch.linspace(-1.05, 1.05, fan_out, dtype=torch.float64))
                else:
                    weight.copy_(math.sqrt(6 / (fan_in + fan_out)) * symmetric(fan_in, fan_out))
                    bias.copy_(0.35 * symmetric(1, fan_out))
            output.copy_(math.sqrt(6 / sum(output.shape)) * symmetric(*output.shape))
        return out.to(dtype=dtype, device=device)

    # -- passes --------------------------------------------------------------------------------------------------------

    def _inputs(self, z: Tensor, order: int) -> Tensor:
        """Taylor coefficients (q+1, n, inputs) of z and its harmonics."""
        line = torch.stack([z, torch.ones_like(z), *[torch.zeros_like(z)] * (order - 1)])[: order + 1, :, None]
        k = torch.arange(1, self.n_frequencies + 1, dtype=z.dtype, device=z.device) * (math.pi / 2)
        angles = torch.cat([z[:, None] * k, z[:, None] * k + math.pi / 2], -1)
        powers = torch.stack([torch.cat([k, k]) ** e for e in range(order + 1)])
        waves = ACTIVATIONS["sin"](angles, order) * (powers / _factorials(order, z)[:, None])[:, None, :]
        return torch.cat([line, waves], -1)

    def trace(self, weights: Tensor, z: Tensor, order: int) -> Trace:
        """The forward pass through the hidden layers, weights (..., P) at z (n,)."""
        nets = self._nets(weights)
        h = self._inputs(z, order).view(order + 1, *[1] * (nets.dim() - 1), len(z), -1)
        inputs, arguments, slopes = [], [], []
        for i, (weight, bias, factor) in enumerate(self._layers(nets)[0]):
            a = h @ weight
            a = torch.cat([a[:1] + bias, a[1:]])
            scaled = a if factor is None else a * factor
            value, slope = compose(ACTIVATIONS[self.activation](scaled[0], order + 1), scaled)
            inputs.append(h)
            arguments.append(a)
            slopes.append(slope)
            h = h + value if self.residual and i else value
        return Trace(inputs, arguments, slopes, h)

    def jet(self, weights: Tensor, z: Tensor, order: int) -> Tensor:
        """g and its derivatives 0..order for weights (..., P) at z (n,): (..., order+1, n, n_heads)."""
        series = self.trace(weights, z, order).last @ self._layers(self._nets(weights))[1]
        jet = series * _factorials(order, z).view(-1, *[1] * (series.dim() - 1))
        return jet.movedim(-3, -1).flatten(-2).movedim(0, -3)

    def hidden_jet(self, weights: Tensor, z: Tensor, order: int) -> Tensor:
        """The features that the output layer combines, per network: (..., B, order+1, n, hidden[-1])."""
        last = self.trace(weights, z, order).last
        return (last * _factorials(order, z).view(-1, *[1] * (last.dim() - 1))).movedim(0, -3)

    def gradients(self, weights: Tensor, z: Tensor, cotangents: Tensor) -> Tensor:
        """Σ_{e, head} cotangents (..., r, n, q+1, heads) · ∂(jet)/∂weights, for every row and node: (..., r, n, P)."""
        order = cotangents.shape[-2] - 1
        trace, nets = self.trace(weights, z, order), self._nets(weights)
        layers, output = self._layers(nets)
        c = (cotangents * _factorials(order, z)[:, None]).movedim(-2, 0)  # (q+1, ..., r, n, heads)
        c = c.unsqueeze(-4) if self.shared else c.movedim(-1, -3).unsqueeze(-1)  # (q+1, ..., B, r, n, heads of one)
        out = c.new_empty(*c.shape[1:-1], nets.shape[-1])

        def fill(end: int, piece: Tensor) -> int:
            start = end - piece.shape[-1]
            out[..., start:end] = piece
            return start

        def outer(inner: Tensor, bar: Tensor) -> Tensor:
            return torch.einsum("k...ni,k...rno->...rnio", inner, bar).flatten(-2)

        end = fill(nets.shape[-1], outer(trace.last, c))
        bar = c @ output.mT.unsqueeze(-3)
        for i in range(len(layers) - 1, -1, -1):
            weight, _, factor = layers[i]
            arguments, slope = trace.arguments[i].unsqueeze(-3), trace.slopes[i].unsqueeze(-3)
            by_argument = _correlate(bar, slope)
            if factor is not None:
                end = fill(end, (by_argument * arguments).sum(0).sum(-1, keepdim=True))
                by_argument = by_argument * factor.unsqueeze(-3)
            end = fill(end, by_argument[0])
            end = fill(end, outer(trace.inputs[i], by_argument))
            if i:
                below = by_argument @ weight.mT.unsqueeze(-3)
                bar = bar + below if self.residual else below
        return out.movedim(-4, -2).flatten(-2)


# -- networks outside a residual -------------------------------------------------------------------------------------


class Network(nn.Module):
    """An architecture with weights of its own: g(z) (n, heads) of z (n,), for ``state_dict`` and for torch.optim."""

    def __init__(self, architecture: MLP, weights: Tensor) -> None:
        super().__init__()
        self.architecture = architecture
        self.weights = nn.Parameter(weights.detach().clone())

    def forward(self, z: Tensor) -> Tensor:
        return self.architecture.jet(self.weights, z, 0)[0]


class FrozenMLP(LinearBasis):
    """The last hidden layer of an untrained MLP as a basis: what training the hidden layers is to be compared with."""

    hidden_weights: Tensor

    def __init__(
        self,
        hidden: Sequence[int] = (20, 40),
        activation: str = "tanh",
        *,
        residual: bool = False,
        n_frequencies: int = 0,
        first_scale: float = 4.0,
        seed: int = 0,
    ) -> None:
        super().__init__(hidden[-1])
        self.network = MLP(
            hidden,
            activation,
            residual=residual,
            n_frequencies=n_frequencies,
            first_scale=first_scale,
            seed=seed,
        )
        self.register_buffer("hidden_weights", self.network.initial(0))

    @property
    def arguments(self) -> dict[str, Any]:
        saved = self.network.arguments
        return {name: saved[name] for name in saved if name not in ("adaptive_slope", "shared")}

    def features(self, z: Tensor, order: int) -> Tensor:
        return self.network.hidden_jet(self.hidden_weights, z, order)[0]
