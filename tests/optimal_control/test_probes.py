"""What is found by probing F and H must hold at every parameter, smoothing and arc, or be refused."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import PROBLEMS

from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_laws import Box, Unconstrained
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import pontryagin, probe_points
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem
from ponn_torch.optimal_control.regularisers import Entropy, Quadratic
from ponn_torch.optimal_control.stationary import Stationary


def cart(**changes):
    given = {
        "name": "cart",
        "states": {"x": 1, "v": 1},
        "control": Unconstrained("u", 1),
        "dynamics": lambda t, x, u, p: {"x": x.v, "v": u.u},
        "running_cost": lambda t, x, u, p: 0.5 * u.u**2,
        "initial": {"x": 0.0, "v": 0.0},
        "final": {"x": 1.0, "v": 0.0},
        "final_time": 1.0,
    }
    return OptimalControlProblem(**{**given, **changes})


@pytest.mark.parametrize("gear", [1.0, 0.0])
def test_a_rate_proportional_by_a_parameter_is_no_chain(gear):
    dynamics = lambda t, x, u, p: {"x": x.v + p.gear * x.v, "v": u.u}  # noqa: E731
    chains = pontryagin(cart(dynamics=dynamics, parameters={"gear": gear})).chains
    assert not any(chain.columns[:2] == (0, 1) for chain in chains)


@pytest.mark.parametrize("regulariser", [Entropy(), Quadratic()])
def test_a_control_saturated_at_all_probes_is_still_seen(regulariser):
    cost = lambda t, x, u, p: u.u  # noqa: E731
    bvp = pontryagin(cart(control=Box("u", 100.0, 0.0, regulariser=regulariser), running_cost=cost))
    assert {c.columns: c.trivial for c in bvp.chains} == {(0, 1): False, (3, 2): True}
    assert bvp.couplings[1].tolist() == [False, False, False, True]


def names_of(bvp):
    """Entries of w by name; L stands for lambda_."""
    states = bvp.problem.component_names
    return [*states, *(f"L{state}" for state in states)]


def chains_of(bvp):
    names = names_of(bvp)
    return {tuple(names[column] for column in chain.columns): chain.trivial for chain in bvp.chains}


def test_a_force_that_acts_on_one_side_only_is_seen():
    """A spring that is slack at positive x."""
    bvp = pontryagin(cart(dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u + 4.0 * torch.relu(-x.x)}))
    assert chains_of(bvp) == {("x", "v"): False, ("Lv", "Lx"): False}
    assert bvp.couplings[1].tolist() == [True, False, False, True]
    assert bvp.couplings[2].tolist() == [False, False, False, True]


def test_a_force_that_overflows_somewhere_hides_nothing():
    """Where the air is dense enough for 10¹⁰⁰ N, all other rates are rounding, but not elsewhere."""
    cost = lambda t, x, u, p: u.u  # noqa: E731
    drag = lambda t, x, u, p: {"x": x.v, "v": u.u / x.m - torch.exp(-500.0 * (x.x - 1.0)), "m": -u.u}  # noqa: E731
    more = {"states": {"x": 1, "v": 1, "m": 1}, "control": Box("u", 1.0), "dynamics": drag, "running_cost": cost}
    bvp = pontryagin(cart(**more))
    assert chains_of(bvp) == {("x", "v"): False, ("m",): False, ("Lv", "Lx"): False, ("Lm",): False}


@pytest.mark.parametrize(
    "root",
    [torch.sqrt, lambda x: torch.where(x > 0, torch.sqrt(x), 0.0 * x)],
    ids=["not a number", "a number without a slope"],
)
def test_equations_of_positive_states_are_probed_at_positive_states(root):
    bvp = pontryagin(cart(dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u - root(x.x)}))
    assert chains_of(bvp) == {("x", "v"): False, ("Lv", "Lx"): False}
    assert bvp.couplings[1].tolist() == [True, False, False, True]
    t, w = probe_points(bvp, 64)
    assert 32 < len(w) < 64
    assert len(t) == len(w)
    assert bool((w[:, 0] > 0).all())


@pytest.mark.parametrize(("variable", "positive"), [("mass", True), ("log_mass", False)])
def test_a_mass_is_positive_at_all_probes(variable, positive):
    bvp = pontryagin(PROBLEMS["mars_landing"](), mass_variable=variable)
    t, w = probe_points(bvp, 64)
    assert len(w) == 64
    assert bool((bvp.to_physical(w)[0][:, 6] > 0).all())
    assert bool((w[:, 6] > 0).all()) == positive
    assert bool((t > 0).all())
    for column in (0, 3, 7, 13):  # states and costates of either sign, of several sizes
        assert float(w[:, column].min()) < -1.0 < 1.0 < float(w[:, column].max())
        assert float(w[:, column].abs().max() / w[:, column].abs().min()) > 5


def test_equations_that_are_finite_nowhere_need_units():
    with pytest.raises(ValueError, match=r"cart: the equations are finite at none of the points .* set units"):
        pontryagin(cart(dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u - torch.sqrt(x.x - 1e3)}))
    pontryagin(cart(dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u - torch.sqrt(x.x - 1e3)}, units={"x": 2e3}))


@pytest.mark.parametrize(("low", "high"), [(-math.pi / 2, math.pi / 2), (0.2, 1.2)])
def test_a_steering_angle_may_have_its_minimum_at_any_sign_of_the_costates(low, high):
    law = Stationary("u", minimum=low, maximum=high)
    steered = cart(
        control=law,
        dynamics=lambda t, x, u, p: {"x": torch.cos(u.u), "v": torch.sin(u.u)},
        running_cost=lambda t, x, u, p: torch.ones_like(t),
    )
    assert pontryagin(steered).law == replace(law, periodic=(False,))


@pytest.mark.parametrize(
    ("dynamics", "end"),
    [
        (lambda t, x, u, p: {"x": x.v, "v": u.u**2}, "concave in component 0"),
        (lambda t, x, u, p: {"x": x.v, "v": u.u + 0.25 * u.u**2}, "concave in component 0"),
        (lambda t, x, u, p: {"x": x.v, "v": u.u + u.u**3}, "neither affine nor quadratic in component 0"),
        (lambda t, x, u, p: {"x": x.v, "v": u.u - 0.3 * torch.abs(u.u)}, "neither affine nor quadratic"),
    ],
)
def test_a_box_refuses_dynamics_that_bend_in_the_control(dynamics, end):
    with pytest.raises(ValueError, match=f"u: the Hamiltonian is {end}.*Stationary"):
        pontryagin(
            cart(control=Box("u", 1.0, -1.0), dynamics=dynamics, running_cost=lambda t, x, u, p: torch.ones_like(t))
        )


def test_a_hamiltonian_linear_in_a_free_control_is_refused():
    with pytest.raises(ValueError, match="H_uu is singular"):
        pontryagin(cart(running_cost=lambda t, x, u, p: x.x**2))


def test_a_free_final_time_is_no_cost():
    with pytest.raises(ValueError, match="nothing to minimise"):
        cart(final_time=FreeTime(1.0), running_cost=None)


def test_a_rate_given_as_a_number_is_told_its_shape():
    with pytest.raises(ValueError, match=r"dynamics\['x'\] has shape \(\)"):
        cart(dynamics=lambda t, x, u, p: {"x": 1.0, "v": u.u})


def test_a_manifold_sees_parameters_in_the_dtype_of_the_problem():
    seen = []

    def manifold(t, x, p):
        seen.append(p.radius.dtype)
        return x.x - p.radius

    pontryagin(cart(final={}, terminal_manifold=manifold, parameters={"radius": 1.0}))
    assert set(seen) == {torch.float64}


def test_events_of_a_collocation_are_one_per_interior_knot():
    times = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"2 entries for 2 segments; allowed: one per interior knot \(1\)"):
        Collocation.on_segments(Discretisation(pontryagin(cart()), None, None), times, events=[None, None])
