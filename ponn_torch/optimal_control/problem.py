"""The optimal control problem as a user states it: names, dynamics, costs, boundary data, controls, units."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from ponn_torch.optimal_control.control_laws import Bounded
from ponn_torch.optimal_control.control_set import ControlSet, finite, is_control_set, side_by_side

SIGNATURES = {  # what the functions of a problem are called with
    "dynamics": ("t", "x", "u", "p"),
    "running_cost": ("t", "x", "u", "p"),
    "terminal_cost": ("t", "x", "p"),
    "terminal_manifold": ("t", "x", "p"),
}
StateValues = Mapping[str, float | Sequence[float | None] | None]


class Named(SimpleNamespace):
    """Named blocks of a vector: ``x.r`` is the slice of the last axis called ``r``, shape (..., size)."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"no entry named {name!r}; {nearest(name, vars(self))}")


def nearest(name: str, allowed: Mapping[str, Any] | Sequence[str]) -> str:
    """Say what is allowed and, where one is close, which name was probably meant."""
    close = get_close_matches(name, list(allowed), n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    return f"allowed: {', '.join(allowed)}{hint}"


@dataclass(frozen=True)
class FreeTime:
    """A final time to be found; ``guess`` (s) starts the search."""

    guess: float


@dataclass(frozen=True)
class DisplayUnit:
    """A unit that people read: ``value_in_unit = value_in_SI / size``."""

    label: str
    size: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.label, str):
            raise ValueError(f"DisplayUnit: label = {self.label!r}; a text is needed")
        if not (finite(self.size) and self.size > 0):
            raise ValueError(f"DisplayUnit: size = {self.size!r}; a positive number is needed")


@dataclass(frozen=True)
class ProblemOrigin:
    """The call that makes a problem again: "package.module:function" or "file.py:function", and JSON arguments."""

    reference: str
    arguments: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class OptimalControlProblem:
    """Minimise terminal_cost + ∫ running_cost dt subject to ẋ = dynamics(t, x, u, p), u in the control set.

    The functions are pointwise and broadcast: ``x.r`` has shape (..., 3), ``t`` has shape (..., 1), and so has
    a scalar state. ``dynamics`` returns a mapping from state names to rates, ``running_cost`` a tensor
    (..., 1). Everything is in SI (or any consistent) units; ``units`` and ``costate_units`` make the unknowns
    of the solver O(1) and are applied and undone by the package.

    Attributes:
        states: name → size, in order.
        control: the admissible set; it names the control and knows how to minimise the Hamiltonian.
        initial, final: name → value, or a sequence with None for free components; a missing name is free.
        final_time: seconds, or FreeTime(guess).
        units: state name → unit; ``time`` and ``cost`` besides.
        costate_units: state name → unit of its costate (default cost / state unit).
        terminal_cost: φ(t, x, p) → (..., 1), or None.
        terminal_manifold: ψ(t, x, p) → (..., k) that must vanish at the end, or None.
        parameters: named numbers that may be varied at run time (continuation, batches): ``p.name``.
        mass: name of the state that a change of mass variable applies to.
        display: state, control, ``time`` or ``cost`` → unit for people; ``origin`` → name of the body there.
        known_cost: the optimum in SI where it is known, for reports.
        origin: the call that made the problem (``load_problem``). A changed copy has none, so that no saved
            solution ever names a call that makes another problem.
    """

    name: str
    states: Mapping[str, int]
    control: ControlSet
    dynamics: Callable[..., Mapping[str, Tensor]]
    initial: StateValues
    final: StateValues
    final_time: float | FreeTime
    running_cost: Callable[..., Tensor] | None = None
    terminal_cost: Callable[..., Tensor] | None = None
    terminal_manifold: Callable[..., Tensor] | None = None
    units: Mapping[str, float] = field(default_factory=dict)
    costate_units: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    mass: str | None = None
    cost_name: str = "cost"
    known_cost: float | None = None
    display: Mapping[str, DisplayUnit] = field(default_factory=dict)
    description: str = ""
    origin: ProblemOrigin | None = field(default=None, init=False, compare=False)

    def __post_init__(self) -> None:
        for label, mapping, extra in (
            ("initial", self.initial, ()),
            ("final", self.final, ()),
            ("units", self.units, ("time", "cost")),
            ("costate_units", self.costate_units, ()),
        ):
            allowed = [*self.states, *extra]
            for name in mapping:
                if name not in allowed:
                    raise ValueError(f"{self.name}: {label} names {name!r}; {nearest(name, allowed)}")
        for label, mapping in (("units", self.units), ("costate_units", self.costate_units)):
            for name, value in mapping.items():
                if not (finite(value) and value > 0):
                    raise ValueError(f"{self.name}: {label}[{name!r}] = {value!r}; a positive number is needed")
        if not is_control_set(self.control):
            hint = "a control set (Box, ThrustBall, …), or a Product of several"
            raise ValueError(f"{self.name}: control = {self.control!r}; allowed: {hint}")
        guess = self.final_time.guess if isinstance(self.final_time, FreeTime) else self.final_time
        if not (finite(guess) and guess > 0):
            raise ValueError(f"{self.name}: final_time = {guess!r} s; a positive number is needed")
        if self.running_cost is None and self.terminal_cost is None:
            raise ValueError(f"{self.name}: running_cost and terminal_cost are both missing; nothing to minimise")
        if self.mass is not None and self.mass not in self.states:
            raise ValueError(f"{self.name}: mass = {self.mass!r}; {nearest(self.mass, self.states)}")
        for label in ("initial", "final"):
            self.boundary(label)
        for name, value in self.parameters.items():
            if not finite(value):
                raise ValueError(f"{self.name}: parameters[{name!r}] = {value!r}; a finite number is needed")
        for bounded in (part for part in self.control.factors if isinstance(part, Bounded)):
            for label, bound in (("minimum", bounded.minimum), ("maximum", bounded.maximum)):
                if isinstance(bound, str) and bound not in self.parameters:
                    hint = nearest(bound, ["a number", *(self.parameters or ["a parameter, of which there is none"])])
                    raise ValueError(f"{self.name}: {label} of the control {bounded.name!r} = {bound!r}; {hint}")
        self._check_display()
        self._check_signatures()
        self._probe()

    # -- sizes and slices ------------------------------------------------------------------------------------

    @property
    def n_states(self) -> int:
        return sum(self.states.values())

    @property
    def free_final_time(self) -> bool:
        return isinstance(self.final_time, FreeTime)

    @property
    def time_guess(self) -> float:
        """Final time in s, or its first guess where it is free."""
        return self.final_time.guess if isinstance(self.final_time, FreeTime) else float(self.final_time)

    @property
    def slices(self) -> dict[str, slice]:
        return dict(zip(self.states, side_by_side(list(self.states.values())), strict=True))

    @property
    def component_names(self) -> list[str]:
        """One name per scalar state: r_1, r_2, r_3, …, m."""
        return [name if size == 1 else f"{name}_{i + 1}" for name, size in self.states.items() for i in range(size)]

    def named(self, x: Tensor) -> Named:
        """View a state vector (..., n_states) by the names of its blocks."""
        return Named(**dict(zip(self.states, x.split(list(self.states.values()), -1), strict=True)))

    def stack(self, blocks: Mapping[str, Tensor], like: Tensor) -> Tensor:
        """Inverse of ``named`` for rates: blocks broadcast against ``like`` (..., n_states)."""
        return torch.cat(
            [
                torch.as_tensor(blocks[name], dtype=like.dtype, device=like.device).expand(*like.shape[:-1], size)
                for name, size in self.states.items()
            ],
            -1,
        )

    def unit(self, name: str) -> float:
        return float(self.units.get(name, 1.0))

    def costate_unit(self, name: str) -> float:
        return float(self.costate_units.get(name, self.unit("cost") / self.unit(name)))

    def boundary(self, end: str) -> list[float | None]:
        """Known values per scalar state at ``initial`` or ``final``; None where free. SI."""
        given: StateValues = getattr(self, end)
        out: list[float | None] = []
        for name, size in self.states.items():
            value = given.get(name)
            entries = list(value) if isinstance(value, Sequence) else [value] * size
            if len(entries) != size:
                raise ValueError(f"{self.name}: {end}[{name!r}] has {len(entries)} entries; {size} are needed")
            for entry in entries:
                if entry is not None and not finite(entry):
                    raise ValueError(f"{self.name}: {end}[{name!r}] = {value!r}; finite numbers or None are needed")
            out += [None if entry is None else float(entry) for entry in entries]
        return out

    def with_boundary(self, **changes: Any) -> OptimalControlProblem:
        """A copy with other boundary data, final time or known cost (dataclasses.replace)."""
        return replace(self, **changes)

    def scaling_hint(self, largest: float = 1e3) -> str:
        """The known value farthest above its unit, and the unit to set; empty where all are below ``largest`` units."""
        values = [("time", "final_time", self.time_guess)]
        for end in ("initial", "final"):
            names = [name for name, size in self.states.items() for _ in range(size)]
            known = zip(names, self.boundary(end), strict=True)
            values += [(name, f"{end} {name}", abs(value)) for name, value in known if value is not None]
        name, label, value = max(values, key=lambda entry: entry[2] / self.unit(entry[0]))
        if value < largest * self.unit(name):
            return ""
        size = f"{label} is {value / self.unit(name):.1e} of its unit, {self.unit(name):g}"
        return f"{size}; unknowns should be of order one: set units[{name!r}] to about {float(f'{value:.0e}'):g}"

    # -- checks ----------------------------------------------------------------------------------------------

    def _check_display(self) -> None:
        allowed = [*self.states, *self.control.names, "time", "cost", "origin"]
        given: Mapping[str, object] = self.display
        for name, shown in given.items():
            if name not in allowed:
                raise ValueError(f"{self.name}: display names {name!r}; {nearest(name, allowed)}")
            if not isinstance(shown, DisplayUnit):
                hint = "DisplayUnit(label, size), as in DisplayUnit('km', 1e3)"
                raise ValueError(f"{self.name}: display[{name!r}] = {shown!r}; allowed: {hint}")

    def _check_signatures(self) -> None:
        """Python would only count arguments, and name a lambda by nothing."""
        for label, arguments in SIGNATURES.items():
            function, expected = getattr(self, label), f"{label}({', '.join(arguments)})"
            if function is None and label != "dynamics":
                continue
            if not callable(function):
                raise ValueError(f"{self.name}: {label} = {function!r}; a function {expected} is expected")
            try:
                signature = inspect.signature(function)
            except (TypeError, ValueError):  # of what is written in C
                continue
            try:
                signature.bind(*arguments)
            except TypeError:
                plain = [argument.replace(annotation=argument.empty) for argument in signature.parameters.values()]
                taken = signature.replace(parameters=plain, return_annotation=signature.empty)
                raise ValueError(f"{self.name}: {label} takes {taken}; {expected} is expected") from None

    def _probe(self) -> None:
        """Call the user's functions once with shapes (5, ·), so that a slip is named here, not in the solver."""
        generator = torch.Generator().manual_seed(0)
        one = torch.ones(5, 1, dtype=torch.float64)
        unit = torch.tensor([self.unit(n) for n, s in self.states.items() for _ in range(s)], dtype=torch.float64)
        x = unit * (0.5 + torch.rand(5, self.n_states, generator=generator, dtype=torch.float64))
        p = Named(**{k: one * v for k, v in self.parameters.items()})
        u = Named(**self.control.probe(one))
        rates = self.dynamics(one, self.named(x), u, p)
        for name in rates:
            if name not in self.states:
                raise ValueError(f"{self.name}: dynamics returns {name!r}; {nearest(name, self.states)}")
        for name, size in self.states.items():
            if name not in rates:
                raise ValueError(f"{self.name}: dynamics returns no rate for {name!r}")
            shape = tuple(torch.as_tensor(rates[name]).shape)
            if shape[-1:] != (size,):
                raise ValueError(f"{self.name}: dynamics[{name!r}] has shape {shape}; (..., {size}) is needed")
        for label, function, args in (
            ("running_cost", self.running_cost, (one, self.named(x), u, p)),
            ("terminal_cost", self.terminal_cost, (one, self.named(x), p)),
        ):
            shape = (5, 1) if function is None else tuple(torch.as_tensor(function(*args)).shape)
            if shape != (5, 1):
                raise ValueError(f"{self.name}: {label} returns shape {shape}; (..., 1) is needed")
        if self.terminal_manifold is not None:
            shape = tuple(self.terminal_manifold(one, self.named(x), p).shape)
            if len(shape) != 2 or shape[0] != 5 or not 0 < shape[1] <= self.n_states:
                raise ValueError(f"{self.name}: terminal_manifold returns shape {shape}; (..., k) is needed, k ≥ 1")
