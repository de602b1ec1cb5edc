"""Costate equations, chains and end conditions by autodiff are those written by hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from examples import interception
from helpers import PROBLEMS, VARIANTS, bvp_of, mass_variables, problem, random, relative
from torch import Tensor
from torch.func import grad, jvp

from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Chain, Setting
from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem

RHO = 0.3
Rates = dict[str, Tensor]

# -- state–costate equations by hand, in SI ------------------------------------------------------------------


def dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def norm(a: Tensor) -> Tensor:
    return dot(a, a).sqrt()


def fuel_thrust(x, c, alpha: float, low: float, high: float) -> tuple[Tensor, Tensor]:
    """|T| by the tanh law and T against λv."""
    switching = norm(c.v) / (alpha * x.m) + c.m - 1
    size = low + (high - low) * 0.5 * (1 + torch.tanh(switching / RHO))
    return size, -size * c.v / norm(c.v)


def spacecraft(x, c, size: Tensor, thrust: Tensor, alpha: float, gravity: Tensor, lambda_r: Tensor) -> Rates:
    return {
        "r": x.v,
        "v": gravity + thrust / x.m,
        "m": -alpha * size,
        "lambda_r": lambda_r,
        "lambda_v": -c.r,
        "lambda_m": dot(c.v, thrust) / x.m**2,
    }


def central(mu: float, r: Tensor, lambda_v: Tensor) -> tuple[Tensor, Tensor]:
    """−μ r/r³ and −Gᵀλv with G = μ (3 r rᵀ/r⁵ − I/r³)."""
    return -mu * r / norm(r) ** 3, mu * (lambda_v / norm(r) ** 3 - 3 * r * dot(r, lambda_v) / norm(r) ** 5)


SUN, ISP, G0 = 1.32712440018e20, 2000.0, 9.80665


def earth_mars(x, c) -> Rates:
    alpha = 1 / (ISP * G0)
    return spacecraft(x, c, *fuel_thrust(x, c, alpha, 0.0, 0.5), alpha, *central(SUN, x.r, c.v))


def earth_mars_minimum_time(x, c) -> Rates:
    alpha, most = 1 / (ISP * G0), 0.5
    # S = −(∂H/∂|T|)/s with s the unit of H, here 1, per largest thrust
    switching = most * (norm(c.v) / x.m + alpha * c.m)
    size = most * 0.5 * (1 + torch.tanh(switching / RHO))
    return spacecraft(x, c, size, -size * c.v / norm(c.v), alpha, *central(SUN, x.r, c.v))


def energy_transfer(x, c) -> Rates:
    gravity, lambda_r = central(SUN, x.r, c.v)
    return {"r": x.v, "v": gravity - c.v, "lambda_r": lambda_r, "lambda_v": -c.r}


def energy_transfer_limited(x, c) -> Rates:
    alpha, most = 1 / (ISP * G0), 0.5
    size = (most**2 / 2 * (norm(c.v) / x.m + alpha * c.m)).clamp(0, most)
    return spacecraft(x, c, size, -size * c.v / norm(c.v), alpha, *central(SUN, x.r, c.v))


def landing(alpha: float) -> Callable[..., Rates]:
    def rates(x, c) -> Rates:
        down = x.v.new_tensor([0.0, 0.0, -3.7114])
        thrust = fuel_thrust(x, c, alpha, 4971.81, 13258.18)
        return spacecraft(x, c, *thrust, alpha, down, torch.zeros_like(c.r))

    return rates


def small_body(gravity: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]) -> Callable[..., Rates]:
    """PoNN paper, eq. 46–51: a_g + M v + N r, λ̇r = −(N + G)ᵀλv, λ̇v = −λr − Mᵀλv."""
    alpha, omega = 1 / (225.0 * G0), 3.31166e-4

    def rates(x, c) -> Rates:
        M = 2 * omega * x.v.new_tensor([[0, 1, 0], [-1, 0, 0], [0, 0, 0]])
        N = omega**2 * torch.diag(x.v.new_tensor([1.0, 1.0, 0.0]))
        field, lambda_r = gravity(x.r, c.v)
        out = spacecraft(x, c, *fuel_thrust(x, c, alpha, 0.0, 20.0), alpha, field, lambda_r)
        out["v"] = out["v"] + x.v @ M.T + x.r @ N.T
        out["lambda_r"] = lambda_r - c.v @ N
        out["lambda_v"] = -c.r - c.v @ M
        return out

    return rates


def linearised_gravity(r: Tensor, lambda_v: Tensor) -> tuple[Tensor, Tensor]:
    mu, r0 = 4.46311e5, r.new_tensor([8039.3, 3564.6, 4603.6])
    distance = r0.norm()
    G = mu * (3 * torch.outer(r0, r0) / distance**5 - torch.eye(3, dtype=r.dtype) / distance**3)
    return -mu * r0 / distance**3 + (r - r0) @ G.T, -lambda_v @ G


def double_integrator(force: Callable[[Tensor], Tensor]) -> Callable[..., Rates]:
    return lambda x, c: {"x": x.v, "v": force(c.v), "lambda_x": torch.zeros_like(c.x), "lambda_v": -c.x}


def boundary_layer(x, c) -> Rates:
    epsilon = 0.02
    return {
        "x": x.y - x.x,
        "y": (-c.y / epsilon - x.y) / epsilon,
        "lambda_x": c.x - x.x,
        "lambda_y": c.y / epsilon - c.x,
    }


def zermelo(x, c) -> Rates:
    size = torch.hypot(c.x, c.y)
    return {
        "x": -c.x / size - x.y,
        "y": -c.y / size,
        "lambda_x": torch.zeros_like(c.x),
        "lambda_y": c.x,
    }


def brachistochrone(x, c) -> Rates:
    along, down = c.x * x.v, c.y * x.v + c.v * G0
    size = torch.hypot(along, down)
    return {
        "x": -x.v * along / size,
        "y": -x.v * down / size,
        "v": -G0 * down / size,
        "lambda_x": torch.zeros_like(c.x),
        "lambda_y": torch.zeros_like(c.y),
        "lambda_v": (c.x * along + c.y * down) / size,
    }


def orbit_raising(x, c) -> Rates:
    """At t = 0, with vr = u and vt = v of Bryson and Ho, section 2.5."""
    size = torch.hypot(c.vr, c.vt) / 0.1405
    return {
        "r": x.vr,
        "vr": x.vt**2 / x.r - 1 / x.r**2 - c.vr / size,
        "vt": -x.vr * x.vt / x.r - c.vt / size,
        "lambda_r": c.vr * (x.vt**2 / x.r**2 - 2 / x.r**3) - c.vt * x.vr * x.vt / x.r**2,
        "lambda_vr": -c.r + c.vt * x.vt / x.r,
        "lambda_vt": -2 * c.vr * x.vt / x.r + c.vt * x.vr / x.r,
    }


def energy_landing(x, c) -> Rates:
    down = x.v.new_tensor([0.0, 0.0, -3.7114])
    return {"r": x.v, "v": down - c.v, "lambda_r": torch.zeros_like(c.r), "lambda_v": -c.r}


def oscillator(x, c) -> Rates:
    force = -torch.tanh(2 * c.z / RHO)
    turned = torch.stack([c.z[..., 1], -c.z[..., 0]], -1)
    return {"z": torch.stack([x.z[..., 1], -x.z[..., 0]], -1) + force, "lambda_z": turned}


def goddard(x, c) -> Rates:
    resistance = 310.0 * torch.exp(-x.h / 0.002)
    # s is the unit of H, altitude 0.01 in time 0.2, per largest thrust
    switching = -(c.v / x.m - c.m / 0.5) * 3.5 / (0.01 / 0.2)
    thrust = 3.5 * 0.5 * (1 + torch.tanh(switching / RHO))
    drag = resistance * x.v**2
    return {
        "h": x.v,
        "v": (thrust - drag) / x.m - 1 / (1 + x.h) ** 2,
        "m": -thrust / 0.5,
        "lambda_h": -c.v * (drag / 0.002 / x.m + 2 / (1 + x.h) ** 3),
        "lambda_v": -c.h + 2 * c.v * resistance * x.v / x.m,
        "lambda_m": c.v * (thrust - drag) / x.m**2,
    }


def free_flying_robot(x, c) -> Rates:
    heading = torch.cat([torch.cos(x.theta), torch.sin(x.theta)], -1)
    across = torch.cat([-heading[..., 1:], heading[..., :1]], -1)
    along, turning = dot(c.v, heading), 0.2 * c.omega

    def thruster(slope: Tensor) -> Tensor:
        """Forward less backward thrust, each paid for at the same price."""
        return 0.5 * (torch.tanh(-(1 + slope) / RHO) - torch.tanh(-(1 - slope) / RHO))

    left, right = thruster(along + turning), thruster(along - turning)
    return {
        "r": x.v,
        "v": (left + right) * heading,
        "theta": x.omega,
        "omega": 0.2 * (left - right),
        "lambda_r": torch.zeros_like(c.r),
        "lambda_v": -c.r,
        "lambda_theta": -(left + right) * dot(c.v, across),
        "lambda_omega": -c.theta,
    }


def planar_car(x, c) -> Rates:
    ahead = torch.cat([torch.cos(x.heading), torch.sin(x.heading)], -1)
    across = torch.cat([-ahead[..., 1:], ahead[..., :1]], -1)
    return {
        "r": x.speed * ahead,
        "heading": -c.heading,
        "speed": torch.tanh(-2 * c.speed / RHO),
        "lambda_r": torch.zeros_like(c.r),
        "lambda_heading": -x.speed * dot(c.r, across),
        "lambda_speed": -dot(c.r, ahead),
    }


CANTED = 1 / (225.0 * G0 * math.cos(math.radians(27.0)))
BY_HAND: dict[str, Callable[..., Rates]] = {
    "boundary_layer": boundary_layer,
    "brachistochrone": brachistochrone,
    "minimum_energy": double_integrator(lambda costate: -costate),
    # S = −λv (u_max − u_min) in units of H
    "minimum_time": double_integrator(lambda costate: torch.tanh(-2 * costate / RHO)),
    "minimum_fuel": double_integrator(
        lambda costate: -torch.sign(costate) * 0.5 * (1 + torch.tanh((costate.abs() - 1) / RHO))
    ),
    "earth_mars": earth_mars,
    "earth_mars_minimum_time": earth_mars_minimum_time,
    "energy_landing": energy_landing,
    "energy_transfer": energy_transfer,
    "energy_transfer_limited": energy_transfer_limited,
    "free_flying_robot": free_flying_robot,
    "goddard": goddard,
    "mars_landing": landing(CANTED),
    "orbit_raising": orbit_raising,
    "oscillator": oscillator,
    "planar_car": planar_car,
    "small_body_landing": small_body(linearised_gravity),
    "zermelo": zermelo,
    "tfc_test_1": landing(5.0863e-4),
    "tfc_test_2": landing(5.0863e-4),
    "small_body_point_mass": small_body(lambda r, costate: central(4.46311e5, r, costate)),
}


def physical_points(bvp: BoundaryValueProblem, count: int = 40) -> tuple[Tensor, Tensor]:
    """States and costates of both signs, of the order of their units; masses above zero."""
    n = bvp.n_states
    x, costates = (random(count, n, seed=seed, low=-1.5, high=1.5) for seed in (11, 12))
    if bvp.problem.mass is not None:
        mass = bvp.problem.slices[bvp.problem.mass]
        x[:, mass] = 0.5 + 0.25 * x[:, mass].abs()
    return bvp.unit * x, bvp.conjugate / bvp.unit * costates


def at(bvp: BoundaryValueProblem, smoothing: float | None = RHO, count: int = 40) -> tuple[Tensor, Setting]:
    time = torch.zeros(count, 1, dtype=torch.float64)
    rho = torch.full_like(time, smoothing) if smoothing is not None else None
    parameters = {name: torch.full_like(time, value) for name, value in bvp.problem.parameters.items()}
    return time, Setting(Regime(smoothing=rho), parameters)


def physical_rates(bvp: BoundaryValueProblem, x: Tensor, costates: Tensor) -> tuple[Tensor, Tensor]:
    """ẋ and λ̇ in SI from the scaled rates of any mass variable."""
    time, setting = at(bvp)
    w = bvp.to_scaled(x, costates)
    return jvp(bvp.to_physical, (w,), (bvp.rates(time, w, setting) / bvp.time_unit,))[1]


ALL = [*PROBLEMS, *VARIANTS]
WITH_MASS_VARIABLES = [(name, variable) for name in ALL for variable in mass_variables(name)]


def test_every_problem_has_costate_equations_by_hand():
    assert set(BY_HAND) == set(ALL)


@pytest.mark.parametrize(("name", "mass_variable"), WITH_MASS_VARIABLES)
def test_autodiff_gives_the_equations_written_by_hand(name, mass_variable):
    bvp = bvp_of(name, mass_variable)
    x, costates = physical_points(bvp)
    found = dict(zip(("", "lambda_"), physical_rates(bvp, x, costates), strict=True))
    named = bvp.problem.named
    expected = BY_HAND[name](named(x), named(costates))
    for prefix, rates in found.items():
        for state in bvp.problem.states:
            by_hand = expected[prefix + state]
            assert float(by_hand.abs().max()) > 0 or float(getattr(named(rates), state).abs().max()) == 0
            if float(by_hand.abs().max()) > 0:
                assert relative(getattr(named(rates), state), by_hand) < 1e-12, prefix + state


def same(found: Tensor, expected: Tensor) -> bool:
    if not float(expected.abs().max()):
        return not float(found.abs().max())
    return relative(found, expected) < 1e-12


@pytest.mark.parametrize("name", [name for name in ALL if problem(name).mass is not None])
def test_switching_function_hamiltonian_and_cost_do_not_see_the_mass_variable(name):
    reference, values = bvp_of(name, "mass"), {}
    x, costates = physical_points(reference)
    for variable in mass_variables(name):
        bvp = bvp_of(name, variable)
        time, setting = at(bvp)
        w = bvp.to_scaled(x, costates)
        for point, found in zip((x, costates), bvp.to_physical(w), strict=True):
            torch.testing.assert_close(found, point, rtol=1e-13, atol=0)
        values[variable] = [f(time, w, setting) for f in (bvp.switching, bvp.hamiltonian, bvp.running_cost)]
    for variable in ("log_mass", "delta_v"):
        for found, expected in zip(values[variable], values["mass"], strict=True):
            assert same(found, expected)


@pytest.mark.parametrize("name", ALL)
def test_the_hamiltonian_is_constant_along_its_own_flow(name):
    """dH/dt = ∂H/∂w · ẇ = 0 at every point, regulariser included: λ̇ = −∂H/∂x and the law minimises."""
    bvp = bvp_of(name)
    x, costates = physical_points(bvp)
    time, setting = at(bvp)
    w = bvp.to_scaled(x, costates)
    terms = grad(lambda w: bvp.hamiltonian(time, w, setting).sum())(w) * bvp.rates(time, w, setting)
    size = terms.abs().sum(-1)
    assert float((terms.sum(-1).abs() / size).max()) < 1e-12
    # and not along another one
    other = terms * torch.linspace(1, 2, w.shape[-1], dtype=w.dtype)
    assert float((other.sum(-1).abs() / size).max()) > 1e-2


def test_the_unregularised_law_is_the_limit_of_the_smoothed_one():
    bvp = bvp_of("mars_landing")
    w = bvp.to_scaled(*physical_points(bvp))
    time, sharp = at(bvp, None)
    limit = bvp.rates(time, w, at(bvp, 1e-9)[1])
    assert relative(bvp.rates(time, w, sharp), limit) < 1e-12


# -- chains --------------------------------------------------------------------------------------------------


def chains_of(name: str, **options) -> dict[tuple[str, ...], Chain]:
    """Chains by the names of their entries; L stands for lambda_."""
    bvp = pontryagin(problem(name), **options)
    states = bvp.problem.component_names
    names = [*states, *(f"L{state}" for state in states)]
    return {tuple(names[column] for column in chain.columns): chain for chain in bvp.chains}


KINEMATIC = [(f"r_{i}", f"v_{i}") for i in (1, 2, 3)]
ADJOINT = [(f"Lv_{i}", f"Lr_{i}") for i in (1, 2, 3)]


@pytest.mark.parametrize("mass_variable", ["mass", "log_mass", "delta_v"])
def test_earth_mars_has_eight_chains(mass_variable):
    chains = chains_of("earth_mars", mass_variable=mass_variable)
    assert sorted(chains) == sorted([*KINEMATIC, *ADJOINT, ("m",), ("Lm",)])
    bvp = bvp_of("earth_mars")
    scale = bvp.time_unit * problem("earth_mars").unit("v") / problem("earth_mars").unit("r")
    for name in KINEMATIC:
        assert chains[name].factors == pytest.approx((1.0, scale))
    for name in ADJOINT:
        assert chains[name].factors == pytest.approx((1.0, -scale))
    assert not any(chain.trivial for chain in chains.values())


def test_costates_of_a_landing_in_constant_gravity_are_trivial():
    chains = chains_of("mars_landing")
    assert sorted(chains) == sorted([*KINEMATIC, *ADJOINT, ("m",), ("Lm",)])
    assert {name for name, chain in chains.items() if chain.trivial} == set(ADJOINT)


def test_coriolis_breaks_the_costate_chains_across_the_axis():
    chains = chains_of("small_body_landing")
    across = [(f"{costate}_{i}",) for costate in ("Lr", "Lv") for i in (1, 2)]
    assert sorted(chains) == sorted([*KINEMATIC, *across, ("Lv_3", "Lr_3"), ("m",), ("Lm",)])
    assert not any(chain.trivial for chain in chains.values())


def test_the_energy_optimal_double_integrator_is_one_chain_of_four():
    chains = chains_of("minimum_energy")
    assert list(chains) == [("x", "v", "Lv", "Lx")]
    (chain,) = chains.values()
    assert chain.trivial  # x is the cubic that the ends determine
    assert chain.factors == pytest.approx((1.0, 1.0, -1.0, 1.0))


@pytest.mark.parametrize("order", [4, 5])
def test_long_chains_are_cut_where_there_are_arcs(order):
    """The last rate of one would be known to ε/h^q only on a segment of length h."""
    names = [f"x{i}" for i in range(order)]
    made = OptimalControlProblem(
        name="integrators",
        states=dict.fromkeys(names, 1),
        control=Box("u", 1.0, -1.0),
        dynamics=lambda t, x, u, p: {
            name: getattr(x, after) if after else u.u for name, after in zip(names, [*names[1:], None], strict=True)
        },
        running_cost=lambda t, x, u, p: torch.ones_like(t),
        initial=dict.fromkeys(names, 0.0) | {"x0": 1.0},
        final=dict.fromkeys(names, 0.0),
        final_time=FreeTime(4.0),
    )
    lengths = sorted(len(chain.columns) for chain in pontryagin(made).chains)
    assert lengths == sorted([3, order - 3] * 2)


@pytest.mark.parametrize("name", ["minimum_time", "minimum_fuel"])
def test_a_bounded_force_breaks_the_chain(name):
    chains = chains_of(name)
    assert sorted(chains) == [("Lv", "Lx"), ("x", "v")]
    assert chains["Lv", "Lx"].trivial
    assert not chains["x", "v"].trivial


@pytest.mark.parametrize("name", ALL)
def test_chains_part_the_unknowns_and_hold_in_every_regime(name):
    bvp = bvp_of(name)
    columns = [column for chain in bvp.chains for column in chain.columns]
    assert sorted(columns) == list(range(bvp.dimension))
    w = bvp.to_scaled(*physical_points(bvp))
    regimes = [None, 1.0, 1e-3]
    for smoothing in regimes:
        time, setting = at(bvp, smoothing)
        rates = bvp.rates(time, w, setting)
        for chain in bvp.chains:
            for e, (column, after) in enumerate(zip(chain.columns[:-1], chain.columns[1:], strict=True)):
                slope = chain.factors[e + 1] / chain.factors[e]
                torch.testing.assert_close(rates[:, column], slope * w[:, after], rtol=1e-12, atol=1e-12)
            if chain.trivial:
                assert not rates[:, chain.columns[-1]].any()


def test_chains_may_be_left_out():
    bvp = pontryagin(problem("earth_mars"), chains=False)
    assert [chain.columns for chain in bvp.chains] == [(i,) for i in range(14)]


# -- ends ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "mass_variable"), WITH_MASS_VARIABLES)
def test_known_ends_are_the_data_and_zero_costates_of_free_states(name, mass_variable):
    bvp = bvp_of(name, mass_variable)
    n = bvp.n_states
    for end in ("initial", "final"):
        given = bvp.problem.boundary(end)
        known = getattr(bvp, f"known_{end}")
        w = torch.where(torch.isnan(known), torch.ones_like(known), known)
        x, costates = bvp.to_physical(w)
        for i, value in enumerate(given):
            assert math.isnan(known[i]) == (value is None)
            by_row = end == "final" and i in bvp.terminal_components
            assert math.isnan(known[n + i]) == (value is not None or by_row)
            if value is None and not by_row:
                assert float(costates[i]) == 0.0
            elif value is not None:
                assert float(x[i]) == pytest.approx(value, rel=1e-14)


def test_mass_variables_start_at_zero_where_they_are_logarithms():
    for variable, expected in (("mass", 1.0), ("log_mass", 0.0), ("delta_v", 0.0)):
        assert float(bvp_of("earth_mars", variable).known_initial[6]) == expected
    rates = {}
    for variable in ("log_mass", "delta_v"):
        bvp = bvp_of("earth_mars", variable)
        time, setting = at(bvp)
        rates[variable] = bvp.rates(time, bvp.to_scaled(*physical_points(bvp)), setting)[:, 6]
    assert bool((rates["log_mass"] < 0).all())
    torch.testing.assert_close(rates["delta_v"], -rates["log_mass"], rtol=1e-13, atol=0)


def test_terminal_rows_by_hand():
    bvp = pontryagin(interception())
    x, v, lambda_x, lambda_v, nu = (random(2, seed=seed, low=-1.0) for seed in range(5))
    t, price = 1.7, 0.5
    w = bvp.to_scaled(torch.cat([x, v]), torch.cat([lambda_x, lambda_v]))[None]
    time = torch.tensor([[t / 2.0]], dtype=torch.float64)
    setting = Setting(parameters={"price": torch.full((1, 1), price, dtype=torch.float64)})
    rows = bvp.terminal_rows(time, w, nu[None], setting)[0]
    # multipliers are in the unit of the cost
    h = 0.5 * lambda_v @ lambda_v + lambda_x @ v - lambda_v @ lambda_v
    expected = torch.cat(
        [
            (lambda_x - 5.0 * nu) / (5.0 / 4.0),
            (lambda_v - 6.0 * v) / (5.0 / 3.0),
            torch.stack([x[0] - 1 - 2 * t, x[1]]),
            ((h + 2 * price * t - 2 * 5.0 * nu[0]) * 2.0 / 5.0)[None],
        ]
    )
    torch.testing.assert_close(rows, expected, rtol=1e-13, atol=1e-13)
    assert bvp.n_multipliers == 2
    assert bvp.n_terminal_rows == 7
    assert torch.isnan(bvp.known_final).all()


def test_a_terminal_cost_decides_the_costates_of_free_states_only():
    made = interception().with_boundary(final={"x": (1.0, None), "v": 0.0}, terminal_manifold=None, final_time=1.0)
    bvp = pontryagin(made)
    assert bvp.terminal_components == [1]
    assert bvp.n_terminal_rows == 1


def test_minimum_time_has_the_row_h_equals_zero():
    bvp = bvp_of("minimum_time")
    w = random(6, 4, low=-1.0)
    time, setting = at(bvp, None, 6)
    rows = bvp.terminal_rows(time, w, w[:, :0], setting)
    torch.testing.assert_close(rows[:, 0], 1 + w[:, 2] * w[:, 1] - w[:, 3].abs(), rtol=1e-14, atol=1e-14)


# -- errors --------------------------------------------------------------------------------------------------


def test_mass_variables_are_checked():
    with pytest.raises(ValueError, match=r"mass_variable = 'log_mas'; .*did you mean 'log_mass'"):
        pontryagin(problem("earth_mars"), mass_variable="log_mas")
    with pytest.raises(ValueError, match="mass_variable = 'delta_v', but problem 'energy_transfer' names no mass"):
        pontryagin(problem("energy_transfer"), mass_variable="delta_v")


def test_a_coupled_box_is_refused_when_the_principle_is_applied():
    made = OptimalControlProblem(
        name="coupled",
        states={"x": 1},
        control=Box("u", 1.0, -1.0, size=2),
        dynamics=lambda t, x, u, p: {"x": u.u[..., :1] * u.u[..., 1:]},
        running_cost=lambda t, x, u, p: u.u.sum(-1, keepdim=True),
        initial={"x": 0.0},
        final={"x": 1.0},
        final_time=1.0,
    )
    with pytest.raises(ValueError, match="u: the Hamiltonian couples its components"):
        pontryagin(made)


def test_single_precision_is_kept():
    bvp = pontryagin(problem("earth_mars"), dtype=torch.float32)
    w = random(5, 14, low=0.5).float()
    rates = bvp.rates(w[:, :1], w, Setting(Regime(smoothing=torch.ones(5, 1))))
    assert rates.dtype is torch.float32
    assert bvp.known_initial.dtype is torch.float32
