"""What a control set answers to whom: the minimiser of H over it, switching functions, codes of arcs.

A control set sees the Hamiltonian only as a function of its control, ``h(**control) -> (..., 1)``, at a fixed time,
state and costate. *Switching functions* are the scalars whose zeros separate the arcs of a bounded control.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

Hamiltonian = Callable[..., Tensor]

LOWER, INTERIOR, UPPER = 0, 1, 2  # codes of an arc


class Level(NamedTuple):
    """What one switching function decides: the codes that a component has where it is below and above zero."""

    component: int
    below: int
    above: int

    @property
    def jumps(self) -> bool:
        """Whether H is affine in the component, which then jumps between its bounds unless it is smoothed."""
        return self.above - self.below > 1


class Minimiser(NamedTuple):
    """What a control set answers: the control by name, S (..., m) and the fraction η (..., m) of its range."""

    control: dict[str, Tensor]
    switching: Tensor
    fraction: Tensor


@dataclass(frozen=True)
class Regime:
    """How a bounded control is chosen: smoothed by ρ (..., 1), or pinned to arc codes (..., m).

    ``interior`` is η (..., m) on interior arcs of a control that H is affine in, where H does not say it; one half
    where it is not given.
    """

    smoothing: Tensor | None = None
    arcs: Tensor | None = None
    interior: Tensor | None = None


def finite(value: Any) -> bool:
    """Whether a value is one finite number; text and arrays are none."""
    try:
        return math.isfinite(value)
    except (TypeError, ValueError, RuntimeError):  # what is no number; what is several; torch's word for the same
        return False


def side_by_side(sizes: Sequence[int]) -> list[slice]:
    """Where pieces of these sizes stand, one after the other."""
    return [slice(*ends) for ends in pairwise(accumulate(sizes, initial=0))]


def is_control_set(value: object) -> bool:
    """Whether a value is a control set, and neither several of them nor a class."""
    return hasattr(type(value), "factors")


class ControlSet(Protocol):
    """The admissible controls and the minimiser of the Hamiltonian over them; inherit from it."""

    @property
    def factors(self) -> Sequence[ControlSet]:
        """The sets that this one is a product of: itself alone, for most."""
        return (self,)

    @property
    def names(self) -> dict[str, int]:
        """Names and sizes of the controls that the dynamics read."""
        ...

    @property
    def levels(self) -> tuple[Level, ...]:
        """What every switching function decides; none where the control has no bound.

        A component that H is affine in has one, which separates its bounds; where H is convex in it there are two, that
        at the lower bound first.
        """
        ...

    @property
    def n_switching(self) -> int:
        """Number of switching functions."""
        return len(self.levels)

    @property
    def jumping(self) -> dict[int, int]:
        """Bounded components that H is affine in, each with its switching function."""
        return {level.component: function for function, level in enumerate(self.levels) if level.jumps}

    @property
    def jumps(self) -> bool:
        """Whether there are such components."""
        return bool(self.jumping)

    @property
    def n_bounded(self) -> int:
        """Components that have bounds, each with an arc code."""
        return len({level.component for level in self.levels})

    def probe(self, one: Tensor) -> dict[str, Tensor]:
        """An admissible control with the batch shape of ``one`` (..., 1)."""
        ...

    def adapted(self, h: Hamiltonian, cost: Hamiltonian, p: Any, one: Tensor, unit: float) -> ControlSet:
        """A copy that knows, from probes of H and of the running cost, what H is convex in and what s is.

        ``h`` and ``cost`` take controls with the batch shape of ``one`` (2k, 1): k points, and these again with the
        opposite costates. ``unit`` is the scale of H, in cost per time, where the running cost does not tell s.

        Raises:
            ValueError: H is not of a kind that the set minimises.
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
        codes = torch.full((*switching.shape[:-1], self.n_bounded), LOWER, device=switching.device)
        for level, above in zip(self.levels, (switching > 0).unbind(-1), strict=True):
            codes[..., level.component] += (level.above - level.below) * above
        return codes

    def samples(self, minimiser: Minimiser, p: Any) -> Minimiser:
        """Other admissible controls, and their η, on a new first axis: far from the given one and near it."""
        ...


class Unbounded(ControlSet, Protocol):
    """What sets without bounds share: there are no arcs."""

    @property
    def levels(self) -> tuple[Level, ...]:
        return ()

    def penalty(self, minimiser: Minimiser, p: Any, smoothing: Tensor) -> Tensor:
        return torch.zeros_like(smoothing)
