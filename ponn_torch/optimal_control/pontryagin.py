"""Pontryagin's principle by autodiff: an optimal control problem becomes a two-point boundary value problem.

With H = L + λᵀf (minimised), the state–costate equations are ẋ = f and λ̇ = −∂H/∂x at the minimising control. All
unknowns are scaled: w = (y, μ) with state x = ψ(y) elementwise and costate λ = c μ / ψ'(y), c the constant
costate unit × state unit. ψ is x = unit · y, or the exponential of a mass variable; either way (y, μ) is canonical up
to the constants c, so the costs, S and the control law stay those of the user's own variables.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import differentiable, gradients_and_values, pointwise_jacobian
from ponn_torch.optimal_control.control_laws import INTERIOR, LOWER, UPPER, ControlSet, Minimiser, Regime
from ponn_torch.optimal_control.meaning import Keyed, meaning
from ponn_torch.optimal_control.problem import Named, OptimalControlProblem, nearest

MASS_VARIABLES = ("auto", "mass", "log_mass", "delta_v")


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

    @cached_property
    def equations(self) -> tuple[Hashable, ...]:
        """Equal for boundary value problems that differ in nothing but values at the ends and of parameters.

        What was found by probes, at the values that the parameters had, has to be the same too.
        """
        tensors = (self.unit, self.exponent, self.conjugate, self.couplings)
        found = meaning([self.law, self.chains, *tensors], self.problem)
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

        with differentiable(t, w, *setting.parameters.values()):
            return self.law.minimise(h, p, w[..., :1], setting.regime)

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
        x, costates = self.to_physical(w)
        p, best = self._parameters(setting), self.minimiser(t, w, setting)
        # at the minimiser H is stationary in the control, so its derivative is that at fixed control; through a
        # saturated η it would be 0 · ∞
        best = Minimiser({k: v.detach() for k, v in best.control.items()}, best.switching, best.fraction.detach())
        h = self._hamiltonian(t * self.time_unit, x, costates, Named(**best.control), p)[0]
        if setting.regime.smoothing is not None and setting.regime.arcs is None:
            h = h + self.law.penalty(best, p, setting.regime.smoothing)
        return h * (self.time_unit / self.cost_unit)

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


# -- building --------------------------------------------------------------------------------------------------------


def pontryagin(
    problem: OptimalControlProblem,
    *,
    mass_variable: str = "auto",
    chains: bool = True,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> BoundaryValueProblem:
    """Derive the boundary value problem; ``mass_variable`` is one of MASS_VARIABLES, ``chains`` merges ṙ = v.

    What is derived for a problem serves all that say the same but for their ends (``equations``), whose functions then
    must compute what they did: an object that they read is not to be changed in place.

    ``auto`` takes the logarithm of a mass where the problem names one: it keeps the mass positive, which decides
    whether a random start converges (Earth–Mars: 16 of 16 against 9 of 16 with the mass itself).

    Raises:
        ValueError: unknown mass variable, or one asked of a problem that names no mass.
    """
    stated = Keyed((_statement(problem), meaning(problem.parameters, problem)), problem)
    with torch.no_grad():
        bvp = replace(_derive(stated, mass_variable, chains), problem=problem)
        bvp = replace(bvp, **_boundary(bvp))
        tensors = ("unit", "exponent", "conjugate", "known_initial", "known_final")
        return replace(bvp, **{name: getattr(bvp, name).to(dtype=dtype, device=device) for name in tensors})


def _statement(problem: OptimalControlProblem) -> Hashable:
    """All that the equations depend on but the values of parameters; of the ends and the final time, what is known."""
    known = [[value is not None for value in problem.boundary(end)] for end in ("initial", "final")]
    functions = (problem.dynamics, problem.running_cost, problem.terminal_cost, problem.terminal_manifold)
    rest = (problem.states, problem.control, problem.mass, problem.exhaust_velocity, problem.free_final_time)
    units = (problem.units, problem.costate_units, list(problem.parameters))
    return meaning([*functions, *rest, *units, known], problem)


@lru_cache(maxsize=16)
def _derive(
    stated: Keyed[OptimalControlProblem],
    mass_variable: str,
    chains: bool,
) -> BoundaryValueProblem:
    """All but the ends, in float64, which probes need whatever the solver's precision."""
    problem = stated.value
    if mass_variable not in MASS_VARIABLES:
        raise ValueError(f"mass_variable = {mass_variable!r}; {nearest(mass_variable, MASS_VARIABLES)}")
    if mass_variable == "auto":
        mass_variable = "mass" if problem.mass is None else "log_mass"
    if mass_variable != "mass" and problem.mass is None:
        raise ValueError(f"mass_variable = {mass_variable!r}, but problem {problem.name!r} names no mass")

    def tensor(values: list[float]) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)

    sizes = problem.states.items()
    unit = [problem.unit(name) for name, size in sizes for _ in range(size)]
    conjugate = [problem.costate_unit(name) * problem.unit(name) for name, size in sizes for _ in range(size)]
    exponent = [0.0] * problem.n_states
    if problem.mass is not None and mass_variable != "mass":
        exponent[problem.slices[problem.mass].start] = {"log_mass": 1.0, "delta_v": -1.0}[mass_variable]

    bvp = BoundaryValueProblem(
        problem=problem,
        law=problem.control,
        mass_variable=mass_variable,
        unit=tensor(unit),
        exponent=tensor(exponent),
        conjugate=tensor(conjugate),
        time_unit=float(problem.units.get("time", 1.0)),
        cost_unit=float(problem.units.get("cost", 1.0)),
        known_initial=tensor([]),
        known_final=tensor([]),
        couplings=tensor([]),
        statement=stated.key[0],
    )
    bvp = replace(bvp, law=_adapted_law(bvp), n_multipliers=_n_multipliers(bvp))
    return replace(bvp, chains=find_chains(bvp) if chains else _single_chains(bvp), couplings=_couplings(bvp))


def _boundary(bvp: BoundaryValueProblem) -> dict[str, Any]:
    """Known ends of w, scaled: given states; zero costates where a state is free and nothing is paid for it."""
    problem = bvp.problem
    out: dict[str, Any] = {}
    fixed_by_rows = set(bvp.terminal_components)
    for end in ("initial", "final"):
        values = problem.boundary(end)
        like = torch.tensor([1.0 if v is None else v for v in values], dtype=bvp.unit.dtype, device=bvp.unit.device)
        if bool(((bvp.exponent != 0) & (like <= 0)).any()):
            raise ValueError(f"{problem.name}: {end} mass must be positive for mass_variable={bvp.mass_variable!r}")
        w = bvp.to_scaled(like, torch.zeros_like(like))
        for i, known in enumerate(values):
            if known is None:
                w[i] = torch.nan
                if end == "final" and i in fixed_by_rows:
                    w[bvp.n_states + i] = torch.nan
            else:
                w[bvp.n_states + i] = torch.nan
        out[f"known_{end}"] = w
    return out


def _n_multipliers(bvp: BoundaryValueProblem) -> int:
    """Components of the terminal manifold."""
    if bvp.problem.terminal_manifold is None:
        return 0
    one = torch.ones_like(bvp.unit[:1]).expand(2, 1)
    end = bvp.problem.named(bvp.unit.expand(2, -1))
    return int(bvp.problem.terminal_manifold(one, end, Named(**_parameters(bvp, one))).shape[-1])


def probe_points(bvp: BoundaryValueProblem, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Random (t, w) of order one for structural probes, away from zeros."""
    generator = torch.Generator().manual_seed(seed)
    values = 0.5 + torch.rand(count, 1 + bvp.dimension, generator=generator, dtype=torch.float64)
    values = values.to(bvp.unit)
    return values[:, :1], values[:, 1:]


def _parameters(bvp: BoundaryValueProblem, like: Tensor) -> dict[str, Tensor]:
    return {name: torch.full_like(like, value) for name, value in bvp.problem.parameters.items()}


def probe_settings(bvp: BoundaryValueProblem, t: Tensor) -> list[Setting]:
    """Settings under which the structure of F shows: smoothed, and on every arc; parameters vary from point to point.

    What holds at one value of a parameter need not hold at the next. A saturated law hides how the control depends on
    w: hence a smoothing that no S saturates, and the interior of a convex law.
    """
    generator = torch.Generator().manual_seed(2)
    parameters = {}
    for name, value in bvp.problem.parameters.items():
        share = torch.rand(t.shape, generator=generator, dtype=torch.float64).to(t)
        parameters[name] = value * (0.95 + 0.1 * share) if value else 1e-3 * share
    regimes = [Regime(smoothing=0.3 + t), Regime(smoothing=1e6 * (0.3 + t))]
    if bvp.law.n_switching:
        n_bounded = bvp.law.n_switching // 2 if bvp.law.curved else bvp.law.n_switching
        one = torch.ones(*t.shape[:-1], n_bounded, dtype=torch.long, device=t.device)
        regimes += [Regime(arcs=code * one) for code in (LOWER, INTERIOR, UPPER)]
    return [Setting(regime, parameters) for regime in regimes]


def _adapted_law(bvp: BoundaryValueProblem) -> ControlSet:
    t, w = probe_points(bvp, 8)
    x, costates = bvp.to_physical(w)
    p = Named(**_parameters(bvp, t))

    def cost(**u: Tensor) -> Tensor:
        return bvp._hamiltonian(t * bvp.time_unit, x, torch.zeros_like(costates), Named(**u), p)[0]

    def h(**u: Tensor) -> Tensor:
        return bvp._hamiltonian(t * bvp.time_unit, x, costates, Named(**u), p)[0]

    return bvp.law.adapted(h, cost, p, t, bvp.cost_unit / bvp.time_unit)


def _couplings(bvp: BoundaryValueProblem) -> Tensor:
    """Boolean (2n, 2n): F_i depends on w_j, found at random points."""
    t, w = probe_points(bvp, 16, seed=1)
    rows = range(bvp.dimension)
    slopes = [bvp.linearised_rates(t, w, setting, rows)[2] for setting in probe_settings(bvp, t)]
    return (torch.stack(slopes) != 0).any(0).any(0)  # NaN counts: nothing says that it does not depend


def _single_chains(bvp: BoundaryValueProblem) -> tuple[Chain, ...]:
    return tuple(Chain((i,), (1.0,)) for i in range(bvp.dimension))


def find_chains(bvp: BoundaryValueProblem, n_probes: int = 32) -> tuple[Chain, ...]:
    """Find F_i ≡ k w_j by evaluating F at random points, join them, and mark chains whose last rate is zero.

    A chain has to hold in every setting: for all values of the parameters, and on every arc.
    """
    t, w = probe_points(bvp, n_probes)
    settings = probe_settings(bvp, t)
    rates = torch.cat([bvp.rates(t, w, setting) for setting in settings])
    w = w.repeat(len(settings), 1)
    scale = rates.abs().amax().clamp_min(1.0)
    follows: dict[int, tuple[int, float]] = {}
    for i in range(bvp.dimension):
        for j in range(bvp.dimension):
            ratio = rates[:, i] / w[:, j]
            k = float(ratio.mean())
            if i != j and abs(k) > 1e-12 and float((rates[:, i] - k * w[:, j]).abs().max()) < 1e-12 * abs(k):
                follows[i] = (j, k)
    taken = {j for j, _ in follows.values()}
    zero = rates.abs().amax(0) < 1e-14 * scale
    out, used = [], set()
    # a chain starts where nothing leads to it; what remains after that can only be a cycle (ẋ = λ, λ̇ = x), cut anywhere
    for i in [*(i for i in range(bvp.dimension) if i not in taken), *range(bvp.dimension)]:
        if i in used:
            continue
        columns, factors = [i], [1.0]
        used.add(i)
        while columns[-1] in follows and follows[columns[-1]][0] not in used:
            j, k = follows[columns[-1]]
            columns.append(j)
            factors.append(factors[-1] * k)
            used.add(j)
        out.append(Chain(tuple(columns), tuple(factors), bool(zero[columns[-1]])))
    return tuple(sorted(out, key=lambda chain: chain.columns))
