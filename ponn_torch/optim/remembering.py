"""A residual that keeps its last linearisation, for whoever asks where another has just stood."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor

from ponn_torch.numerics.linalg import Jacobian
from ponn_torch.optim.base import Residual
from ponn_torch.optim.restricted import Layered


class Remembering:
    """The residual ``inner``; r and J at the last ξ are not formed again where they are asked for once more."""

    def __init__(self, inner: Residual) -> None:
        self.inner = inner
        self._last: tuple[Tensor, tuple[Tensor, Jacobian]] | None = None

    @property
    def n_unknowns(self) -> int:
        return self.inner.n_unknowns

    @property
    def linear_unknowns(self) -> Tensor:
        """Those of a residual that knows its output layer."""
        return cast(Layered, self.inner).linear_unknowns

    def residual(self, xi: Tensor) -> Tensor:
        return self.inner.residual(xi)

    def linearise(self, xi: Tensor) -> tuple[Tensor, Jacobian]:
        if self._last is None or not torch.equal(self._last[0], xi):
            self._last = xi, self.inner.linearise(xi)
        return self._last[1]

    def blocks(self, residual: Tensor) -> Mapping[str, Tensor]:
        return self.inner.blocks(residual)
