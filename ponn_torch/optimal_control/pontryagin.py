"""Pontryagin's principle by autodiff: an optimal control problem becomes a two-point boundary value problem.

What the equations do not say by themselves is found by probing them at random points: which of them depend on which
unknowns, which are chains of derivatives, whether the Hamiltonian is affine or convex in a bounded control.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import gradients_and_values
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Chain, Setting
from ponn_torch.optimal_control.control_set import INTERIOR, LOWER, UPPER, ControlSet, Regime
from ponn_torch.optimal_control.meaning import Keyed, meaning
from ponn_torch.optimal_control.problem import Named, OptimalControlProblem, nearest

LONGEST = 3  # of a chain: on a segment of length h its last rate is known to ε/h^q only
MASS_VARIABLES = ("auto", "mass", "log_mass", "delta_v")


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


def with_singular_arcs(bvp: BoundaryValueProblem, components: tuple[int, ...]) -> BoundaryValueProblem:
    """The same equations, the control of these components being what keeps S at zero on interior arcs."""
    if components == bvp.singular:
        return bvp
    with torch.no_grad():
        bvp = replace(bvp, singular=components)
        return replace(bvp, couplings=_couplings(bvp))


def _statement(problem: OptimalControlProblem) -> Hashable:
    """All that the equations depend on but the values of parameters; of the ends and the final time, what is known."""
    known = [[value is not None for value in problem.boundary(end)] for end in ("initial", "final")]
    functions = (problem.dynamics, problem.running_cost, problem.terminal_cost, problem.terminal_manifold)
    rest = (problem.states, problem.control, problem.mass, problem.free_final_time)
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
    """Random (t, w) for structural probes, where the equations are finite: at most ``count``, away from zeros.

    Costates have either sign. States have either sign and varied size at every second point; at the others they are
    positive and of order one, as radii and densities are everywhere. A mass is always positive.

    Raises:
        ValueError: the equations are finite at none of them.
    """
    generator = torch.Generator().manual_seed(seed)
    share, coin = torch.rand(2, count, 1 + bvp.dimension, generator=generator, dtype=torch.float64).to(bvp.unit)
    varied = torch.arange(count, device=coin.device)[:, None] % 2 == 1
    size = torch.where(varied, 2.0 ** (5.0 * share - 3.0), 0.5 + share)
    may_turn = torch.ones_like(coin, dtype=torch.bool)
    may_turn[:, : 1 + bvp.n_states] = varied
    may_turn[:, 0] = False  # time
    if bvp.problem.mass is not None and bvp.mass_variable == "mass":
        may_turn[:, 1 + bvp.problem.slices[bvp.problem.mass].start] = False
    values = torch.where(may_turn & (coin < 0.5), -size, size)
    t, w = values[:, :1], values[:, 1:]
    finite = _finite(bvp, t, w)
    if not bool(finite.any()):
        raise ValueError(
            f"{bvp.problem.name}: the equations are finite at none of the points where they were probed, times and "
            "states of the order of their units; set units to the sizes that they have"
        )
    return t[finite], w[finite]


def _finite(bvp: BoundaryValueProblem, t: Tensor, w: Tensor) -> Tensor:
    """Where H, its rates and its slopes are finite (count,), at a control of the set."""
    x, costates = bvp.to_physical(w)
    u, p = Named(**bvp.law.probe(torch.ones_like(t))), Named(**_parameters(bvp, t))

    def h(x: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        value, rates = bvp._hamiltonian(t * bvp.time_unit, x, costates, u, p)
        return value, (value, rates)

    (slopes,), values = gradients_and_values(h, x)
    return torch.cat([slopes, *values], -1).isfinite().all(-1)


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
        one = torch.ones(*t.shape[:-1], bvp.law.n_bounded, dtype=torch.long, device=t.device)
        regimes += [Regime(arcs=code * one) for code in (LOWER, INTERIOR, UPPER)]
        for component in bvp.singular:
            only = LOWER * one
            only[..., component] = INTERIOR
            regimes.append(Regime(arcs=only))
    return [Setting(regime, parameters) for regime in regimes]


def _adapted_law(bvp: BoundaryValueProblem) -> ControlSet:
    """The law, told about H at probes and at these again with the opposite costates."""
    t, w = probe_points(bvp, 32)
    t, (x, costates) = t.repeat(2, 1), bvp.to_physical(w.repeat(2, 1))
    costates = torch.cat([costates[: len(w)], -costates[len(w) :]])
    p = Named(**_parameters(bvp, t))

    def cost(**u: Tensor) -> Tensor:
        return bvp._hamiltonian(t * bvp.time_unit, x, torch.zeros_like(costates), Named(**u), p)[0]

    def h(**u: Tensor) -> Tensor:
        return bvp._hamiltonian(t * bvp.time_unit, x, costates, Named(**u), p)[0]

    return bvp.law.adapted(h, cost, p, torch.ones_like(t), bvp.cost_unit / bvp.time_unit)


def _couplings(bvp: BoundaryValueProblem) -> Tensor:
    """Boolean (2n, 2n): F_i depends on w_j, found at random points."""
    t, w = probe_points(bvp, 32, seed=1)
    rows = range(bvp.dimension)
    slopes = [bvp.linearised_rates(t, w, setting, rows)[2] for setting in probe_settings(bvp, t)]
    return (torch.stack(slopes) != 0).any(0).any(0)  # NaN counts: nothing says that it does not depend


def _single_chains(bvp: BoundaryValueProblem) -> tuple[Chain, ...]:
    return tuple(Chain((i,), (1.0,)) for i in range(bvp.dimension))


def find_chains(bvp: BoundaryValueProblem, n_probes: int = 64) -> tuple[Chain, ...]:
    """Find F_i ≡ k w_j by evaluating F at random points, join them, and mark chains whose last rate is zero.

    A chain has to hold in every setting: for all values of the parameters, and on every arc. Where there are arcs, and
    with them short segments, long ones are cut.
    """
    longest = LONGEST if bvp.law.n_switching else bvp.dimension
    t, w = probe_points(bvp, n_probes)
    settings = probe_settings(bvp, t)
    rates = torch.cat([bvp.rates(t, w, setting) for setting in settings])
    w = w.repeat(len(settings), 1)
    follows: dict[int, tuple[int, float]] = {}
    for i in range(bvp.dimension):
        for j in range(bvp.dimension):
            ratio = rates[:, i] / w[:, j]
            k = float(f"{ratio.mean():.15g}")  # the digits that do not depend on the probes
            if i != j and abs(k) > 1e-12 and bool(((ratio - k).abs() < 1e-12 * abs(k)).all()):
                follows[i] = (j, k)
    taken = {j for j, _ in follows.values()}
    zero = (rates.abs() < 1e-14 * rates.abs().amax(-1, keepdim=True).clamp_min(1.0)).all(0)
    out, used = [], set()
    # a chain starts where nothing leads to it; what remains after that can only be a cycle (ẋ = λ, λ̇ = x), cut anywhere
    for i in [*(i for i in range(bvp.dimension) if i not in taken), *range(bvp.dimension)]:
        if i in used:
            continue
        columns, factors = [i], [1.0]
        used.add(i)
        while columns[-1] in follows and follows[columns[-1]][0] not in used:
            j, k = follows[columns[-1]]
            used.add(j)
            if len(columns) == longest:
                out.append(Chain(tuple(columns), tuple(factors)))
                columns, factors = [j], [1.0]
            else:
                columns.append(j)
                factors.append(factors[-1] * k)
        out.append(Chain(tuple(columns), tuple(factors), bool(zero[columns[-1]])))
    return tuple(sorted(out, key=lambda chain: chain.columns))
