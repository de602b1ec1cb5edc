"""Several controls at once, each from a set of its own kind: a thrust and a turning rate, say.

The Hamiltonian has to be a sum of what it says of each, so that each is minimised alone, whatever the others are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from ponn_torch.optimal_control.control_set import (
    ControlSet,
    Hamiltonian,
    Level,
    Minimiser,
    Regime,
    is_control_set,
    side_by_side,
)

N_ELSEWHERE = 5  # other controls of a set, at which its part in H is held against those of the others
ROUNDING = 1e-9  # of H


@dataclass(frozen=True)
class Product(ControlSet):
    """The Cartesian product of control sets; dynamics read the controls of all by their names.

    Raises:
        ValueError: no set, or two that have a control of the same name.
    """

    sets: Sequence[ControlSet]

    def __post_init__(self) -> None:
        given = self.sets
        if not (isinstance(given, Sequence) and given and all(map(is_control_set, given))):
            raise ValueError(f"sets = {self.sets!r}; allowed: a sequence of control sets, at least one")
        object.__setattr__(self, "sets", tuple(factor for one in given for factor in one.factors))
        twice = [
            name for name, count in Counter(name for part in self.sets for name in part.names).items() if count > 1
        ]
        if twice:
            raise ValueError(f"sets: several controls are called {twice[0]!r}; allowed: a name for each")

    @property
    def factors(self) -> Sequence[ControlSet]:
        return self.sets

    @property
    def names(self) -> dict[str, int]:
        return {name: size for part in self.sets for name, size in part.names.items()}

    @property
    def levels(self) -> tuple[Level, ...]:
        return tuple(
            level._replace(component=level.component + components.start)
            for part, components in zip(self.sets, self._components, strict=True)
            for level in part.levels
        )

    @property
    def _components(self) -> list[slice]:
        """Where the components of each part stand among those of all."""
        return side_by_side([part.n_bounded for part in self.sets])

    @property
    def _functions(self) -> list[slice]:
        """Where the switching functions of each part stand."""
        return side_by_side([part.n_switching for part in self.sets])

    def probe(self, one: Tensor) -> dict[str, Tensor]:
        return {name: value for part in self.sets for name, value in part.probe(one).items()}

    @torch.no_grad()
    def adapted(self, h: Hamiltonian, cost: Hamiltonian, p: Any, one: Tensor, unit: float) -> Product:
        probe = self.probe(one)
        for first, second in combinations(self.sets, 2):
            for moved, other in zip(*(_elsewhere(part, probe, p) for part in (first, second)), strict=True):
                corners = [h(**probe), h(**probe | moved), h(**probe | other), h(**probe | moved | other)]
                mixed = corners[0] - corners[1] - corners[2] + corners[3]
                # where H is not finite it says nothing
                if bool((mixed.abs() > ROUNDING * sum(x.abs() for x in corners)).any()):
                    names = [next(iter(part.names)) for part in (first, second)]
                    raise ValueError(
                        f"controls {names[0]!r} and {names[1]!r}: the Hamiltonian is no sum of what it says of each; "
                        "make one of them a state and its rate the control, or one set of both, as a ThrustBall is of "
                        "a thrust and its direction"
                    )
        sets = [part.adapted(_alone(h, part, probe), _alone(cost, part, probe), p, one, unit) for part in self.sets]
        return replace(self, sets=tuple(sets))

    def minimise(self, h: Hamiltonian, p: Any, like: Tensor, regime: Regime) -> Minimiser:
        probe = self.probe(torch.ones_like(like))
        found = [
            part.minimise(_alone(h, part, probe), p, like, _of(regime, components))
            for part, components in zip(self.sets, self._components, strict=True)
        ]
        control = {name: value for one in found for name, value in one.control.items()}
        switching, fraction = (
            torch.cat([getattr(one, name) for one in found], -1) for name in ("switching", "fraction")
        )
        return Minimiser(control, switching, fraction)

    def penalty(self, minimiser: Minimiser, p: Any, smoothing: Tensor) -> Tensor:
        paid = [part.penalty(one, p, smoothing) for part, one in zip(self.sets, self._each(minimiser), strict=True)]
        return torch.stack(paid).sum(0)

    def samples(self, minimiser: Minimiser, p: Any) -> Minimiser:
        """Those of each part, the others as they are."""
        controls, fractions = list[dict[str, Tensor]](), list[Tensor]()
        for part, one, components in zip(self.sets, self._each(minimiser), self._components, strict=True):
            own = part.samples(one, p)
            count = len(next(iter(own.control.values())))
            controls.append({k: v.expand(count, *v.shape) for k, v in minimiser.control.items()} | own.control)
            fraction = minimiser.fraction.repeat(count, *[1] * minimiser.fraction.dim())
            fraction[..., components] = own.fraction
            fractions.append(fraction)
        control = {name: torch.cat([each[name] for each in controls]) for name in minimiser.control}
        return Minimiser(control, minimiser.switching, torch.cat(fractions))

    def _each(self, minimiser: Minimiser) -> list[Minimiser]:
        """What a minimiser says of each part."""
        control, switching, fraction = minimiser
        return [
            Minimiser(
                {name: control[name] for name in part.names}, switching[..., functions], fraction[..., components]
            )
            for part, functions, components in zip(self.sets, self._functions, self._components, strict=True)
        ]


def _elsewhere(part: ControlSet, probe: dict[str, Tensor], p: Any) -> list[dict[str, Tensor]]:
    """Other controls of one set, every component moved on its own."""
    control = {name: probe[name] for name in part.names}
    like = next(iter(control.values()))
    half = like.new_full((*like.shape[:-1], part.n_bounded), 0.5)
    samples = part.samples(Minimiser(control, half, half), p).control
    count = len(next(iter(samples.values())))
    return [{name: value[i] for name, value in samples.items()} for i in range(0, count, -(-count // N_ELSEWHERE))]


def _alone(h: Hamiltonian, part: ControlSet, others: dict[str, Tensor]) -> Hamiltonian:
    """H as a function of one part's controls."""
    fixed = {name: value for name, value in others.items() if name not in part.names}
    return lambda **u: h(**fixed, **u)


def _of(regime: Regime, components: slice) -> Regime:
    """The regime of some components."""
    arcs, interior = (None if x is None else x[..., components] for x in (regime.arcs, regime.interior))
    return Regime(regime.smoothing, arcs, interior)
