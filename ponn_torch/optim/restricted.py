"""A residual as a function of some of its unknowns, the others held: Gauss–Newton on the output layer is one call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, cast

from torch import Tensor

from ponn_torch.numerics.linalg import Jacobian
from ponn_torch.optim.base import Residual


class Layered(Residual, Protocol):
    """A residual that knows its output layer."""

    @property
    def linear_unknowns(self) -> Tensor:
        """Ascending positions in ξ of all unknowns but hidden weights."""
        ...


class Wrapping:
    """What a residual around another one, ``inner``, passes on where the unknowns and the equations are the same."""

    inner: Residual

    @property
    def n_unknowns(self) -> int:
        return self.inner.n_unknowns

    @property
    def linear_unknowns(self) -> Tensor:
        """Those of a residual that knows its output layer."""
        return cast(Layered, self.inner).linear_unknowns

    def blocks(self, residual: Tensor) -> Mapping[str, Tensor]:
        return self.inner.blocks(residual)


@dataclass(frozen=True, eq=False)
class Restricted:
    """r as a function of ξ[index] (..., M); the other entries keep their values in ``xi`` (..., N).

    Attributes:
        index: ascending positions (M,).

    Raises:
        ValueError: positions that are not ascending, or outside ξ.
    """

    inner: Residual
    index: Tensor
    xi: Tensor

    def __post_init__(self) -> None:
        inside = bool(((self.index >= 0) & (self.index < self.xi.shape[-1])).all())
        if not inside or not bool((self.index.diff() > 0).all()):
            raise ValueError(f"index = {self.index.tolist()}; allowed: ascending, from 0 to {self.xi.shape[-1] - 1}")

    @property
    def n_unknowns(self) -> int:
        return len(self.index)

    @property
    def start(self) -> Tensor:
        """The restricted unknowns (..., M) of ``xi``."""
        return self.xi[..., self.index]

    def full(self, some: Tensor) -> Tensor:
        """ξ (..., N) with the restricted unknowns put in."""
        return self.xi.expand(*some.shape[:-1], -1).index_copy(-1, self.index, some)

    def residual(self, xi: Tensor) -> Tensor:
        return self.inner.residual(self.full(xi))

    def linearise(self, xi: Tensor) -> tuple[Tensor, Jacobian]:
        residual, jacobian = self.inner.linearise(self.full(xi))
        return residual, jacobian.columns(self.index)

    def blocks(self, residual: Tensor) -> Mapping[str, Tensor]:
        return self.inner.blocks(residual)


def output_layer(residual: Layered, xi: Tensor) -> Restricted:
    """The residual with its hidden weights held at ξ."""
    return Restricted(residual, residual.linear_unknowns, xi)
