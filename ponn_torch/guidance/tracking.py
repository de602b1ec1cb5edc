"""A tracking problem: a plant, a reference, quadratic weights, and how far ahead a horizon looks.

Everything is in the plant's own units, time included; a DisplayUnit says what people read
(value in unit = value / size), so that a plant may be scaled as its numerics like.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ponn_torch.numerics.runge_kutta import runge_kutta
from ponn_torch.optimal_control.problem import DisplayUnit, nearest

Dynamics = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class Plant:
    """ẋ = dynamics(t, x, u), pointwise: t (...), x (..., n), u (..., m), broadcasting.

    states, controls: component → unit, in order. lower, upper: what the actuators reach, (m,) each.
    limits: name → function of (x, u) that should stay at or below 1, for reports. linear: whether the dynamics are
    linear and do not depend on time, so that a matrix exponential is an oracle.

    Raises ValueError where the dynamics return another shape, and for limits that are not one per control.
    """

    name: str
    dynamics: Dynamics
    states: Mapping[str, DisplayUnit]
    controls: Mapping[str, DisplayUnit]
    time: DisplayUnit = DisplayUnit("s")  # noqa: RUF009 - frozen
    lower: Sequence[float] | None = None
    upper: Sequence[float] | None = None
    limits: Mapping[str, Callable[[Tensor, Tensor], Tensor]] = field(default_factory=dict)
    linear: bool = False

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            given = getattr(self, name)
            if given is not None and len(given) != self.n_controls:
                raise ValueError(f"{name} = {tuple(given)}; allowed: one per control, {', '.join(self.controls)}")
        probe = self.dynamics(torch.zeros(2), torch.ones(2, self.n_states), torch.ones(2, self.n_controls))
        if probe.shape != (2, self.n_states):
            raise ValueError(
                f"dynamics of {self.name} return shape {tuple(probe.shape)} for states (2, {self.n_states}); "
                "allowed: the same shape"
            )

    @property
    def n_states(self) -> int:
        return len(self.states)

    @property
    def n_controls(self) -> int:
        return len(self.controls)

    def saturate(self, control: Tensor) -> Tensor:
        """The nearest control within the actuators' reach."""
        lower = None if self.lower is None else control.new_tensor(self.lower)
        upper = None if self.upper is None else control.new_tensor(self.upper)
        return control if lower is None and upper is None else control.clamp(lower, upper)

    def fly(self, t: float, x: Tensor, u: Tensor, duration: float, n_substeps: int) -> Tensor:
        """x (..., n) after a time with the control held, by classical Runge–Kutta."""
        h = duration / n_substeps
        for i in range(n_substeps):
            x = runge_kutta(lambda share, x, i=i: self.dynamics(x.new_tensor(t + (i + share) * h), x, u), x, h)  # type: ignore[misc]
        return x


def deviations(flown: Mapping[str, Any] | None, **as_planned: Any) -> dict[str, Any] | None:
    """Parameters of the plant that flies, those of the model where nothing else is given; None where nothing differs.

    Raises ValueError for a parameter that the plant has not, and what is not a number or as many as are needed.
    """
    given = dict(flown or {})
    for name, value in given.items():
        if name not in as_planned:
            raise ValueError(f"flown = {given}; {name!r} is none of the plant's, {nearest(name, as_planned)}")
        count = len(as_planned[name]) if isinstance(as_planned[name], list) else None
        numbers = [value] if count is None else value if isinstance(value, list | tuple) else []
        if len(numbers) != (count or 1) or not all(isinstance(number, int | float) for number in numbers):
            what = "a number" if count is None else f"a list of {count} numbers"
            raise ValueError(f"flown = {given}; {name} is {what}")
    found = as_planned | given
    return None if found == as_planned else found


# -- references --------------------------------------------------------------------------------------


class Reference(Protocol):
    """What is to be followed, for any times (...): states (..., n) and controls (..., m), held at the ends."""

    def __call__(self, t: Tensor) -> tuple[Tensor, Tensor]: ...


@dataclass(frozen=True, eq=False)
class Setpoint:
    """One state (n,) and control (m,) for all times."""

    state: Tensor
    control: Tensor

    def __call__(self, t: Tensor) -> tuple[Tensor, Tensor]:
        return self.state.expand(*t.shape, -1), self.control.expand(*t.shape, -1)


@dataclass(frozen=True, eq=False)
class PiecewiseReference:
    """Collocation polynomials on equal intervals, states of degree d, controls of degree d − 1.

    times: (K·d + 1,) from 0; interval k holds points k·d … k·d + d. states: (K·d + 1, n). controls: (K·d, m), at
    all points but an interval's first. Raises ValueError for arrays that do not fit together.
    """

    times: Tensor
    states: Tensor
    controls: Tensor
    degree: int

    def __post_init__(self) -> None:
        n_points, d = len(self.times), self.degree
        if d < 1 or (n_points - 1) % d or len(self.states) != n_points or len(self.controls) != n_points - 1:
            raise ValueError(
                f"times, states and controls have {n_points}, {len(self.states)} and {len(self.controls)} points of "
                f"degree {d}; allowed: K·degree + 1, as many, and one less"
            )

    @classmethod
    def load(cls, path: Path) -> PiecewiseReference:
        """From a .npz of t, x (n, K·d + 1), u (m, K·d) and d."""
        with np.load(path, allow_pickle=False) as stored:
            t, x, u = (torch.from_numpy(stored[name]) for name in ("t", "x", "u"))
            return cls(t, x.mT.contiguous(), u.mT.contiguous(), int(stored["d"]))

    @cached_property
    def final_time(self) -> float:
        return float(self.times[-1])

    @cached_property
    def _supports(self) -> tuple[Tensor, Tensor]:
        """Points of an interval on [0, 1]: states', controls'."""
        n_intervals = (len(self.times) - 1) // self.degree
        points = self.times[: self.degree + 1] * (n_intervals / self.final_time)
        return points, points[1:]

    def __call__(self, t: Tensor) -> tuple[Tensor, Tensor]:
        d = self.degree
        n_intervals = (len(self.times) - 1) // d
        place = t.clamp(0.0, self.final_time) * (n_intervals / self.final_time)
        interval = place.long().clamp_max(n_intervals - 1)
        within = place - interval
        for_states, for_controls = self._supports
        first = interval.unsqueeze(-1) * d
        steps = torch.arange(d + 1, device=t.device)
        states = _lagrange(for_states, within).unsqueeze(-2) @ self.states[first + steps]
        controls = _lagrange(for_controls, within).unsqueeze(-2) @ self.controls[first + steps[:-1]]
        return states.squeeze(-2), controls.squeeze(-2)


def _lagrange(points: Tensor, x: Tensor) -> Tensor:
    """Values (..., k) of the Lagrange polynomials of a few points (k,) at x (...)."""
    eye = torch.eye(len(points), dtype=torch.bool, device=points.device)
    across = (points[:, None] - points[None, :]).masked_fill(eye, 1.0)
    factors = (x[..., None, None] - points[None, :]) / across  # (..., polynomial j, root k)
    return factors.masked_fill(eye, 1.0).prod(-1)


# -- the problem -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TrackingProblem:
    """Over each horizon, minimise ½∫ (x − xr)ᵀ Q (x − xr) + (u − ur)ᵀ R (u − ur) dt + ½ eᵀ Sf e, e = x(T) − xr(T).

    state_weight: Q (n, n). control_weight: t (...) → diagonal of R (..., m). terminal_weight: Sf (n, n), None for 0.
    horizon, cycle, final_time: how far a plan looks, how often it is made, when the run ends. initial: x (n,) of the
    nominal run. dispersion: half-widths (n,) of uniform initial errors of a Monte Carlo. flown: the plant that flies,
    where it is not the one that is planned with.

    Raises ValueError for times that are not positive, a horizon shorter than a cycle, a flown plant of other states.
    """

    plant: Plant
    reference: Reference
    state_weight: Tensor
    control_weight: Callable[[Tensor], Tensor]
    initial: Tensor
    horizon: float
    cycle: float
    final_time: float
    terminal_weight: Tensor | None = None
    dispersion: Tensor | None = None
    description: str = ""
    flown: Plant | None = None

    def __post_init__(self) -> None:
        if self.flown is not None and list(self.flown.states) != list(self.plant.states):
            raise ValueError(f"flown has states {list(self.flown.states)}; allowed: {list(self.plant.states)}")
        for name in ("horizon", "cycle", "final_time"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} = {getattr(self, name)}; allowed: above 0")
        if self.horizon < self.cycle:
            raise ValueError(
                f"horizon = {self.horizon / self.plant.time.size:g} {self.plant.time.label}; "
                f"allowed: at least one cycle, {self.cycle / self.plant.time.size:g}"
            )

    @property
    def name(self) -> str:
        return self.plant.name

    @property
    def flying(self) -> Plant:
        """What flies."""
        return self.flown or self.plant

    @property
    def displayed(self) -> dict[str, DisplayUnit]:
        """Component → unit of a flight's table: time, states, controls."""
        return {"t": self.plant.time} | dict(self.plant.states) | dict(self.plant.controls)

    def terminal_offset(self, end: Tensor) -> Tensor | None:
        """s = −Sf xr of the condition λ(T) = Sf x(T) + s for a horizon that ends at the time ()."""
        if self.terminal_weight is None:
            return None
        return -(self.reference(end)[0] @ self.terminal_weight)  # Sf is symmetric

    def running_cost(self, t: Tensor, x: Tensor, u: Tensor) -> Tensor:
        """The integrand (...,) at times (...)."""
        states, controls = self.reference(t)
        dx, du = x - states, u - controls
        return 0.5 * ((dx @ self.state_weight * dx).sum(-1) + (self.control_weight(t) * du * du).sum(-1))

    def disperse(self, n_vehicles: int, generator: torch.Generator) -> Tensor:
        """Initial states (V, n), uniform around the reference's start."""
        if self.dispersion is None:
            raise ValueError(f"dispersion = None of {self.plant.name}; allowed: half-widths, one per state")
        start = self.reference(self.initial.new_zeros(()))[0]
        drawn = torch.rand(n_vehicles, len(start), generator=generator, dtype=torch.float64).to(start)
        return start + (2 * drawn - 1) * self.dispersion
