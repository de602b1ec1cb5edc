"""A vector function of time as Chebyshev interpolants, on panels halved until round-off is met."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class PiecewiseChebyshev:
    """Interpolants on the panels between ``edges`` (P+1,); coefficients (P, degree+1, k)."""

    edges: list[float]
    coefficients: Array

    def __call__(self, t: float) -> Array:
        """Values (k,) at one time, extrapolated from the end panels."""
        panel = min(max(bisect_right(self.edges, t) - 1, 0), len(self.edges) - 2)
        start, end = self.edges[panel], self.edges[panel + 1]
        z = min(max((2.0 * t - start - end) / (end - start), -1.0), 1.0)
        table = self.coefficients[panel]
        return np.cos(np.arange(len(table)) * np.arccos(z)) @ table


def approximate(
    function: Callable[[Array], Array],
    start: float,
    end: float,
    *,
    degree: int = 16,
    n_panels: int = 16,
    tolerance: float = 1e-12,
    sizes: Array | float = 0.0,
    n_levels: int = 30,
    most_panels: int = 1024,
) -> PiecewiseChebyshev:
    """Interpolate f (m,) → (m, k), called once per level of halving.

    ``tolerance`` is relative to the largest |f_k| of each component, or to its ``sizes`` (k,) elsewhere. A jump is
    enclosed by panels 2^-n_levels as long as the first.
    """
    angles = np.pi * np.arange(2 * degree + 1) / (2 * degree)
    z = -np.cos(angles)  # every other point is a node, those between are tests
    to_coefficients = np.linalg.inv(np.cos(np.outer(np.arccos(z[::2]), np.arange(degree + 1))))
    at_tests = np.cos(np.outer(np.arccos(z[1::2]), np.arange(degree + 1)))
    edges = np.linspace(start, end, n_panels + 1)
    left, right = edges[:-1], edges[1:]
    scale = sizes
    before = np.full((n_panels, 2), np.inf)  # largest relative errors of the panels that these came from
    done: list[tuple[float, float, Array]] = []
    for level in range(n_levels):
        values = function((left[:, None] + (right - left)[:, None] * (z + 1.0) / 2).ravel())
        values = values.reshape(len(left), len(z), -1)
        scale = np.maximum(scale, np.abs(values).max((0, 1)))
        table = to_coefficients @ values[:, ::2]
        difference = np.abs(at_tests @ table - values[:, 1::2]).max(1)
        error = np.divide(difference, scale, where=scale > 0, out=difference).max(-1)
        # where two halvings gain next to nothing, round-off of f is left; a kink gains a factor of four
        noise = (error < 1e-6) & (error > 0.5 * before[:, 1])
        rough = ~((error <= tolerance) | noise)
        if level == n_levels - 1 or len(done) + len(left) > most_panels:
            rough[:] = False
        done += [(a, b, c) for a, b, c in zip(left[~rough], right[~rough], table[~rough], strict=True)]
        if not rough.any():
            break
        middle = (left + right) / 2
        before = np.tile(np.stack([error, before[:, 0]], -1)[rough], (2, 1))
        left, right = (
            np.concatenate([left[rough], middle[rough]]),
            np.concatenate([middle[rough], right[rough]]),
        )
    done.sort(key=lambda panel: panel[0])
    return PiecewiseChebyshev([float(a) for a, _, _ in done] + [float(end)], np.stack([c for _, _, c in done]))
