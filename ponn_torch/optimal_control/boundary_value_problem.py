"""State–costate equations of an optimal control problem, scaled, with what is known at both ends.

With H = L + λᵀf (minimised), they are ẋ = f and λ̇ = −∂H/∂x at the minimising control. All
unknowns are scaled: w = (y, μ) with state x = ψ(y) elementwise and costate λ = c μ / ψ'(y), c the constant
costate unit × state unit. ψ is x = unit · y, or the exponential of a mass variable; either way (y, μ) is canonical up
to the constants c, so the costs, S and the control law stay those of the user's own variables.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import differentiable, gradients_and_values, pointwise_jacobian
from ponn_torch.optimal_control.control_set import ControlSet, Minimiser, Regime
from ponn_torch.optimal_control.meaning import meaning
from ponn_torch.optimal_control.problem import Named, OptimalControlProblem
from ponn_torch.optimal_control.singular import singular_fractions


@dataclass(frozen=True)
class Setting:
    """What varies at run time: the control regime and the problem's parameters, each (..., 1) on the points."""

    regime: Regime = field(default_factory=Regime)
    parameters: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class Chain:
    """Consecutive derivatives: d/dt w[columns[e]] ≡ k w[columns[e+1]]; factors[e] y with y = w[columns[0]].

    d^e y/dt^e = factors[e] · w[columns[e]]. ``trivial``: the last derivative vanishes identically, so y is a
    polynomial in time (constant gravity: λr constant, λv linear).
    """

    columns: tuple[int, ...]
    factors: tuple[float, ...]
    trivial: bool = False


@dataclass(frozen=True, eq=False)
class BoundaryValueProblem:
    """State–costate equations ẇ = F(t, w) with what is known of w at both ends, scaled to O(1).

    Attributes:
        unit (n,): of every state. cost_unit, time_unit: of H times time, and of time.
        exponent (n,): 0 for x = unit·y; ±1 for x = unit·exp(±y).
        conjugate (n,): c = costate unit × state unit.
        known_initial, known_final: (2n,) scaled values, NaN where unknown.
        couplings: boolean (2n, 2n), F_i depends on w_j.
        singular: components of a control that H is affine in whose interior arcs are singular (``with_singular_arcs``).
        statement: what the problem says but for its ends and values of parameters; see ``meaning``.
    """

    problem: OptimalControlProblem
    law: ControlSet
    mass_variable: str
    unit: Tensor
    exponent: Tensor
    conjugate: Tensor
    time_unit: float
    cost_unit: float
    known_initial: Tensor
    known_final: Tensor
    couplings: Tensor
    statement: Hashable
    n_multipliers: int = 0
    chains: tuple[Chain, ...] = ()
    singular: tuple[int, ...] = ()

    @cached_property
    def equations(self) -> tuple[Hashable, ...]:
        """Equal for boundary value problems that differ in nothing but values at the ends and of parameters.

        What was found by probes, at the values that the parameters had, has to be the same too.
        """
        tensors = (self.unit, self.exponent, self.conjugate, self.couplings)
        found = meaning([self.law, self.chains, self.singular, *tensors], self.problem)
        return self.statement, found, self.unit.device

    # -- scaling -----------------------------------------------------------------------------------------------

    @property
    def n_states(self) -> int:
        return self.problem.n_states

    @property
    def dimension(self) -> int:
        return 2 * self.n_states

    @property
    def final_time(self) -> float:
        """Scaled final time, or its guess."""
        return self.problem.time_guess / self.time_unit

    @cached_property
    def _slope(self) -> Tensor:
        """ψ' where y = 0."""
        return self.unit * torch.where(self.exponent != 0, self.exponent, 1.0)

    @cached_property
    def _costate_unit(self) -> Tensor:
        """λ/μ where y = 0."""
        return self.conjugate / self._slope

    @cached_property
    def _rate_units(self) -> tuple[Tensor, Tensor]:
        """ẏ/ẋ where y = 0, and μ̇/(∂H/∂y)."""
        return self.time_unit / self._slope, -self.time_unit / self.conjugate

    @cached_property
    def _straight(self) -> tuple[Tensor, Tensor]:
        """(a, b): ψ = e^{exponent y} (a + b y)."""
        curved = self.exponent != 0
        return torch.where(curved, self.unit, 0.0), torch.where(curved, 0.0, self.unit)

    def _psi(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """ψ(y) and ψ'(0)/ψ'(y) = e^{−exponent y}: without a division or a mask, whose derivatives cost the most."""
        if self.mass_variable == "mass":
            return self.unit * y, torch.ones_like(y)
        at_zero, growth = self._straight
        return torch.exp(self.exponent * y) * torch.addcmul(at_zero, growth, y), torch.exp(-self.exponent * y)

    def to_physical(self, w: Tensor) -> tuple[Tensor, Tensor]:
        """States and costates in the user's units from w (..., 2n)."""
        y, mu = w.split(self.n_states, -1)
        x, shrink = self._psi(y)
        return x, self._costate_unit * shrink * mu

    def to_scaled(self, x: Tensor, costates: Tensor) -> Tensor:
        """Inverse of ``to_physical``."""
        curved = self.exponent != 0
        ratio = torch.where(curved, x / self.unit, torch.ones_like(x))
        y = torch.where(curved, self.exponent * torch.log(ratio), x / self.unit)
        return torch.cat([y, costates / (self._costate_unit * self._psi(y)[1])], -1)

    def _parameters(self, setting: Setting) -> Named:
        """The problem's parameters, those of the setting where it gives them."""
        return Named(**{**self.problem.parameters, **setting.parameters})

    # -- the Hamiltonian and what follows from it ----------------------------------------------------------------

    def _hamiltonian(self, t: Tensor, x: Tensor, costates: Tensor, u: Any, p: Any) -> tuple[Tensor, Tensor]:
        """(H (..., 1), f (..., n)) in the user's units, unregularised."""
        problem = self.problem
        state = problem.named(x)
        rates = problem.stack(problem.dynamics(t, state, u, p), x)
        h = (costates * rates).sum(-1, keepdim=True)
        if problem.running_cost is not None:
            h = h + problem.running_cost(t, state, u, p)
        return h, rates

    def minimiser(self, t: Tensor, w: Tensor, setting: Setting) -> Minimiser:
        """Control that minimises H at (t, w); t (..., 1) and w (..., 2n) scaled, control in the user's units."""
        x, costates = self.to_physical(w)
        p, time = self._parameters(setting), t * self.time_unit

        def h(**u: Tensor) -> Tensor:
            return self._hamiltonian(time, x, costates, Named(**u), p)[0]

        regime = setting.regime
        with differentiable(t, w, *setting.parameters.values()):
            if self.singular and regime.arcs is not None and regime.interior is None:
                regime = replace(regime, interior=singular_fractions(self, t, w, setting))
            return self.law.minimise(h, p, w[..., :1], regime)

    def rates(self, t: Tensor, w: Tensor, setting: Setting) -> Tensor:
        """F(t, w): scaled rates (..., 2n) of states and costates."""
        u = Named(**self.minimiser(t, w, setting).control)
        p, time = self._parameters(setting), t * self.time_unit

        def h(y: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
            x, shrink = self._psi(y)
            value, rates = self._hamiltonian(time, x, self._costate_unit * shrink * mu, u, p)
            return value, (rates, shrink)

        with differentiable(t, w, *setting.parameters.values()):
            y, mu = w.split(self.n_states, -1)
            (gradient,), (rates, shrink) = gradients_and_values(h, y)
        by_state, by_gradient = self._rate_units
        return torch.cat([by_state * shrink * rates, by_gradient * gradient], -1)

    def linearised_rates(
        self, t: Tensor, w: Tensor, setting: Setting, rows: Sequence[int]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """F (n, 2n) at points t (n, 1), w (n, 2n), and ∂F/∂t (n, len(rows)), ∂F/∂w (n, len(rows), 2n) of its rows."""
        names = list(setting.parameters)

        def rates(t: Tensor, w: Tensor, smoothing: Tensor | None, arcs: Tensor | None, *values: Tensor) -> Tensor:
            return self.rates(t, w, Setting(Regime(smoothing, arcs), dict(zip(names, values, strict=True))))

        varied = (setting.regime.smoothing, setting.regime.arcs, *setting.parameters.values())
        value, (by_t, by_w) = pointwise_jacobian(rates, rows, t, w, constants=varied)
        return value, by_t[..., 0], by_w

    def switching(self, t: Tensor, w: Tensor, setting: Setting) -> Tensor:
        """Switching functions (..., m), positive where more control is better."""
        return self.minimiser(t, w, setting).switching

    def hamiltonian(self, t: Tensor, w: Tensor, setting: Setting) -> Tensor:
        """The Hamiltonian (..., 1) that the setting's law minimises, regulariser included, in cost_unit/time_unit."""
        best = self.minimiser(t, w, setting)
        # at the minimiser H is stationary in the control, so its derivative is that at fixed control; through a
        # saturated η it would be 0 · ∞
        best = Minimiser({k: v.detach() for k, v in best.control.items()}, best.switching, best.fraction.detach())
        return self._hamiltonian_at(best, t, w, setting)

    def _hamiltonian_at(self, chosen: Minimiser, t: Tensor, w: Tensor, setting: Setting) -> Tensor:
        """The same at any control, and η, instead of the minimiser."""
        x, costates = self.to_physical(w)
        p = self._parameters(setting)
        h = self._hamiltonian(t * self.time_unit, x, costates, Named(**chosen.control), p)[0]
        if setting.regime.smoothing is not None and setting.regime.arcs is None:
            h = h + self.law.penalty(chosen, p, setting.regime.smoothing)
        return h * (self.time_unit / self.cost_unit)

    def excess(self, t: Tensor, w: Tensor, setting: Setting) -> Tensor:
        """By how much H at the setting's control exceeds H at admissible samples at most, in cost_unit/time_unit.

        (m, 1) at points t (m, 1), w (m, 2n); not above zero where the control minimises H.
        """
        best = self.minimiser(t, w, setting)
        others = self.law.samples(best, self._parameters(setting))
        count = len(next(iter(others.control.values())))

        def each(value: Tensor) -> Tensor:  # in one list, as all functions of a problem are called
            return value.expand(count, *value.shape).flatten(0, 1)

        smoothing, arcs = (None if v is None else each(v) for v in (setting.regime.smoothing, setting.regime.arcs))
        there = Setting(Regime(smoothing, arcs), {name: each(value) for name, value in setting.parameters.items()})
        control = {name: value.flatten(0, 1) for name, value in others.control.items()}
        listed = Minimiser(control, best.switching, others.fraction.flatten(0, -2))
        h = self._hamiltonian_at(listed, each(t), each(w), there)
        # what H is not defined at is no better control
        h = torch.where(h.isnan(), torch.inf, h).unflatten(0, (count, len(t)))
        return self._hamiltonian_at(best, t, w, setting) - h.amin(0)

    def running_cost(self, t: Tensor, w: Tensor, setting: Setting) -> Tensor:
        """The user's running cost (..., 1), without the regulariser, in cost_unit/time_unit."""
        problem, p = self.problem, self._parameters(setting)
        if problem.running_cost is None:
            return torch.zeros_like(w[..., :1])
        u = Named(**self.minimiser(t, w, setting).control)
        state = problem.named(self.to_physical(w)[0])
        return problem.running_cost(t * self.time_unit, state, u, p) * (self.time_unit / self.cost_unit)

    def terminal_cost(self, t: Tensor, x: Tensor, setting: Setting) -> Tensor:
        """The user's terminal cost (..., 1) at scaled times t (..., 1) and states x (..., n) in the user's units."""
        problem = self.problem
        if problem.terminal_cost is None:
            return torch.zeros_like(t)
        return problem.terminal_cost(t * self.time_unit, problem.named(x), self._parameters(setting))

    # -- the end of the trajectory --------------------------------------------------------------------------------

    @property
    def terminal_components(self) -> list[int]:
        """Free final states whose costate a terminal cost or a manifold determines."""
        problem = self.problem
        if problem.terminal_cost is None and problem.terminal_manifold is None:
            return []
        return [i for i, value in enumerate(problem.boundary("final")) if value is None]

    @property
    def n_terminal_rows(self) -> int:
        return len(self.terminal_components) + self.n_multipliers + int(self.problem.free_final_time)

    def terminal_rows(self, t: Tensor, w: Tensor, multipliers: Tensor, setting: Setting) -> Tensor:
        """Rows (..., n_terminal_rows) that vanish at the end: λ − φ_x − ψ_xᵀν, ψ, and H + φ_t + νᵀψ_t for free tf."""
        problem, p = self.problem, self._parameters(setting)
        x, costates = self.to_physical(w)
        time, rows = t * self.time_unit, []

        def end_function(time: Tensor, x: Tensor) -> tuple[Tensor, tuple[Tensor]]:
            """φ + νᵀψ, which plays the part of the terminal cost, and ψ."""
            total, psi = torch.zeros_like(time[..., 0]), x[..., :0]
            if problem.terminal_cost is not None:
                total = total + problem.terminal_cost(time, problem.named(x), p)[..., 0]
            if problem.terminal_manifold is not None:
                psi = problem.terminal_manifold(time, problem.named(x), p)
                total = total + self.cost_unit * (multipliers * psi).sum(-1)
            return total, (psi,)

        with differentiable(t, w, multipliers, *setting.parameters.values()):
            (phi_t, phi_x), (psi,) = gradients_and_values(end_function, time, x)
        if self.terminal_components:
            index = self.terminal_components
            unit = (self._costate_unit * self._psi(w[..., : self.n_states])[1])[..., index]
            rows.append((costates[..., index] - phi_x[..., index]) / unit)
        if self.n_multipliers:
            rows.append(psi)
        if problem.free_final_time:
            rows.append(self.hamiltonian(t, w, setting) + phi_t * (self.time_unit / self.cost_unit))
        return torch.cat(rows, -1) if rows else w[..., :0]
