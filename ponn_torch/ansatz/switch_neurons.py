"""Switch neurons: frozen units that carry the layer of a smoothed switch, beside a smooth basis.

Where a control switches by ½(1 + tanh(S/ρ)), the highest derivative of a chain has a layer of width ρ/|S'|, which a
polynomial can follow only with as many degrees as the layer fits into the domain. A unit whose derivative of just that
order is tanh(κ(z − c)) leaves the polynomial the smooth rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

from ponn_torch.ansatz.basis import ACTIVATIONS, LinearBasis


@cache
def _alternating_weights(n_terms: int = 24) -> tuple[float, ...]:
    """w_k with Σ w_k a_k ≈ Σ (−1)^k a_k to 5.8^−n of the sum, for moments a_k of a positive measure.

    Cohen, Rodriguez Villegas and Zagier (2000), algorithm 1.
    """
    d = math.cosh(n_terms * math.acosh(3.0))
    weights, b, c = [], -1.0, -d
    for k in range(n_terms):
        c = b - c
        weights.append(c / d)
        b *= (k + n_terms) * (k - n_terms) / ((k + 0.5) * (k + 1))
    return tuple(weights)


def _negative_polylogarithm(order: int, x: Tensor) -> Tensor:
    """Li_order(−x) = Σ_{m ≥ 1} (−x)^m / m^order for 0 ≤ x ≤ 1, order ≥ 1."""
    value = torch.zeros_like(x)
    for k, weight in reversed([*enumerate(_alternating_weights())]):
        value = value * x + weight / (k + 1) ** order
    return -x * value


def tanh_integral(u: Tensor, times: int) -> Tensor:
    """tanh integrated ``times`` times from zero; its error is ε in units of max(1, |u|^times).

    With x = exp(−2u), tanh u = 1 + 2 Li_0(−x) for u ≥ 0 and d Li_q(−x)/du = −2 Li_{q−1}(−x), so that the integral is
    u^q/q! + 2 (−½)^q Li_q(−x), less its Taylor polynomial at zero; once log cosh u, twice with the dilogarithm. For
    u < 0 it follows from the parity.
    """
    if times == 0:
        return torch.tanh(u)
    size = u.abs()

    def term(order: int, x: Tensor) -> Tensor:
        return 2 * (-0.5) ** order * _negative_polylogarithm(order, x)

    one = torch.ones((), dtype=u.dtype, device=u.device)
    value = size**times / math.factorial(times) + term(times, torch.exp(-2 * size))
    for degree in range(times):
        value = value - size**degree / math.factorial(degree) * term(times - degree, one)
    return value if times % 2 else value * u.sign()


class SwitchNeuronBasis(LinearBasis):
    """The functions of a smooth basis, then one unit per centre whose derivative of a certain order is tanh(κ(z − c)).

    That order is ``order`` (of the chain that the basis serves: its highest derivative sees the control) plus the
    unit's lift: lift 0 carries a jump of that derivative, lift 1 a kink, lift 2 a jump of its curvature, which follow
    one another as thrust, its direction and mass change across the switch. `beyond` sets the order.

    centres, slopes, lifts: (M,) each.

    Raises ValueError for slopes that are not positive, or arrays that do not match.
    """

    centres: Tensor
    slopes: Tensor

    def __init__(
        self,
        smooth: LinearBasis,
        centres: Sequence[float] | Tensor,
        slopes: Sequence[float] | Tensor,
        lifts: Sequence[int],
        order: int = 2,
        *,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        if not len(centres) == len(slopes) == len(lifts):
            raise ValueError(
                f"centres, slopes and lifts have {len(centres)}, {len(slopes)} and {len(lifts)} entries; "
                "allowed: one each per unit"
            )
        super().__init__(smooth.size + len(lifts))
        self.smooth, self.order = smooth, order
        self.lifts = tuple(int(lift) for lift in lifts)
        self.register_buffer("centres", torch.as_tensor(centres, dtype=dtype, device=device))
        self.register_buffer("slopes", torch.as_tensor(slopes, dtype=dtype, device=device))
        if not bool((self.slopes > 0).all()):
            raise ValueError(f"slopes = {self.slopes.tolist()}; allowed: positive numbers")

    @classmethod
    def at(
        cls,
        smooth: LinearBasis,
        centres: Tensor,
        slopes: Tensor,
        factors: Sequence[float] = (1.0,),
        n_lifts: int = 1,
    ) -> SwitchNeuronBasis:
        """At every centre a unit of each lift < n_lifts with each of ``factors`` times the slope there."""
        scales = slopes.new_tensor(list(factors))
        n_units = len(factors) * n_lifts
        return cls(
            smooth,
            centres.repeat_interleave(n_units),
            (slopes[:, None, None] * scales[:, None]).expand(-1, -1, n_lifts).flatten(),
            list(range(n_lifts)) * (len(factors) * len(centres)),
            dtype=centres.dtype,
            device=centres.device,
        )

    @property
    def arguments(self) -> dict[str, Any]:
        return {
            "smooth": self.smooth,
            "centres": self.centres.tolist(),
            "slopes": self.slopes.tolist(),
            "lifts": list(self.lifts),
            "order": self.order,
        }

    def beyond(self, n_supports: int) -> LinearBasis:
        """For a chain of n_supports / 2 unknowns, which has a support for each of them at both ends."""
        return type(self)(
            self.smooth.beyond(n_supports),
            self.centres,
            self.slopes,
            self.lifts,
            n_supports // 2,
            dtype=self.centres.dtype,
            device=self.centres.device,
        )

    def features(self, z: Tensor, order: int) -> Tensor:
        u = self.slopes * (z[:, None] - self.centres)
        out = u.new_empty(order + 1, *u.shape)
        for lift in set(self.lifts):
            mine = [i for i, other in enumerate(self.lifts) if other == lift]
            top, here, slopes = self.order + lift, u[:, mine], self.slopes[mine]
            beyond = ACTIVATIONS["tanh"](here, max(0, order - top))
            for e in range(order + 1):
                value = beyond[e - top] if e >= top else tanh_integral(here, top - e)
                out[e][:, mine] = slopes ** float(e - top) * value
        return torch.cat([self.smooth.features(z, order), out], -1)
