"""A residual that keeps its last linearisation, for whoever asks where another has just stood."""

from __future__ import annotations

import torch
from torch import Tensor

from ponn_torch.numerics.linalg import Jacobian
from ponn_torch.optim.base import Residual
from ponn_torch.optim.restricted import Wrapping


class Remembering(Wrapping):
    """The residual ``inner``; r and J at the last ξ are not formed again where they are asked for once more."""

    def __init__(self, inner: Residual) -> None:
        self.inner = inner
        self._last: tuple[Tensor, tuple[Tensor, Jacobian]] | None = None

    def residual(self, xi: Tensor) -> Tensor:
        return self.inner.residual(xi)

    def linearise(self, xi: Tensor) -> tuple[Tensor, Jacobian]:
        if self._last is None or not torch.equal(self._last[0], xi):
            self._last = xi, self.inner.linearise(xi)
        return self._last[1]
