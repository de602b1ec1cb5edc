"""Constrained expressions around networks: their Jacobian, their ends, their fit, their output layer."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from examples import ferry, linear_quadratic
from helpers import NETWORKS, bvp_of, collocation, random, relative
from torch import Tensor
from torch.func import jacrev

from ponn_torch.ansatz.basis import FreeFunction, LinearBasis
from ponn_torch.ansatz.networks import MLP, FrozenMLP
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.restricted import output_layer
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation, Form, Strong, Weak
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.solving.guess import RandomGuess, project

FORMS = {"strong": Strong(), "weak": Weak(2.0, 5)}


def on_arcs(network: FreeFunction, form: Form) -> Collocation:
    """Four segments on three arcs, one of them subdivided; switch times and the final time are unknown."""
    bvp = pontryagin(ferry(free_final_time=True))
    disc = Discretisation(bvp, network, make_nodes("legendre_gauss", 6, dtype=torch.float64), form)
    times = torch.tensor([0, 0.2, 0.5, 0.6, 1.0], dtype=torch.float64) * bvp.final_time
    made = Collocation.on_segments(disc, times, events=[(0,), None, (0,)])
    return replace(made, setting=replace(made.setting, regime=Regime(arcs=torch.tensor([[2], [0], [0], [2]]))))


def disturbed(made: Collocation, *batch: int) -> Tensor:
    """The seed's weights and random knots, all a little moved; times stay in order."""
    start = project(made, lambda t: 0.5 + 0.3 * torch.sin(t[:, None] + torch.arange(made.bvp.dimension)))
    return start + 0.02 * random(*batch, len(start), seed=3, low=-1.0)


def error(made: Collocation, xi: Tensor) -> float:
    r, jacobian = made.linearise(xi)
    torch.testing.assert_close(r, made.residual(xi), rtol=1e-13, atol=1e-13)
    return relative(jacobian.dense(), jacrev(made.residual)(xi))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", NETWORKS)
def test_the_linearisation_is_the_jacobian_on_arcs_with_free_times(name, form):
    made = on_arcs(NETWORKS[name](5), FORMS[form])
    assert len(made.free_times) == 3
    assert error(made, disturbed(made)) < 1e-11


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("problem", ["earth_mars", "mars_landing", "energy_transfer"])
def test_the_linearisation_is_the_jacobian_on_one_smoothed_segment(problem, form):
    made = collocation(bvp_of(problem), n_neurons=5, smoothing=0.4, form=FORMS[form], basis=NETWORKS["mlp"])
    assert error(made, disturbed(made)) < 1e-11


def test_members_of_a_batch_are_problems_of_their_own():
    made = on_arcs(NETWORKS["mlp"](5), Weak())
    xi = disturbed(made, 2)
    r, jacobian = made.linearise(xi)
    for i in range(2):
        single_r, single = made.linearise(xi[i])
        torch.testing.assert_close(r[i], single_r, rtol=1e-12, atol=1e-13)
        assert relative(jacobian.dense()[i], single.dense()) < 1e-12


@pytest.mark.parametrize("name", NETWORKS)
def test_ends_are_met_whatever_the_weights(name):
    made = collocation(bvp_of("mars_landing"), n_neurons=5, n_segments=2, smoothing=0.4, basis=NETWORKS[name])
    curve = Curve(made, 3.0 * random(made.n_unknowns, seed=1, low=-1.0))
    for segment in range(2):
        w = curve.on_segment(torch.tensor([-1.0, 1.0], dtype=torch.float64), segment)[1]
        assert relative(w, curve.knots[segment : segment + 2]) < 1e-12
    given = ~torch.isnan(made.bvp.known_initial)
    assert relative(curve.knots[0][given], made.bvp.known_initial[given]) < 1e-15


def test_chains_without_an_equation_have_no_head():
    made = collocation(bvp_of("mars_landing"), basis=NETWORKS["mlp"])
    trivial = sum(group.n_chains for group in made.discretisation.groups if group.trivial)
    assert trivial > 0
    heads = sum(group.n_chains for group in made.discretisation.groups) - trivial
    assert made.discretisation.n_own == MLP((8, 6)).n_weights(heads)


@pytest.mark.parametrize("name", NETWORKS)
def test_the_curve_is_affine_in_the_linear_unknowns(name):
    made = collocation(bvp_of("earth_mars"), n_neurons=5, n_segments=2, smoothing=0.4, basis=NETWORKS[name])
    xi, index = disturbed(made), made.linear_unknowns
    assert 0 < len(index) < made.n_unknowns
    move = torch.zeros_like(xi).index_fill(0, index, 1.0) * random(len(xi), seed=4, low=-1.0)
    t = torch.linspace(0.0, made.bvp.final_time, 7, dtype=torch.float64)
    low, middle, high = (Curve(made, xi + factor * move)(t) for factor in (-1.0, 0.0, 1.0))
    assert relative(0.5 * (low + high), middle) < 1e-13
    assert relative(low, middle) > 0.1


@pytest.mark.parametrize("name", NETWORKS)
def test_a_projection_is_close_and_closer_onto_its_own_hidden_layers(name):
    made = collocation(bvp_of("earth_mars"), n_neurons=24, n_nodes=40, smoothing=0.4, basis=NETWORKS[name])
    given = RandomGuess(scale=0.3).curve(made.bvp, 0)
    t = torch.linspace(0.0, made.bvp.final_time, 33, dtype=torch.float64)
    near = Curve(made, project(made, given))
    assert relative(near(t), given(t)) < 0.02
    assert relative(Curve(made, project(made, near))(t), near(t)) < 0.004


def test_untrained_hidden_layers_are_the_frozen_basis():
    bvp = pontryagin(linear_quadratic())
    times = torch.tensor([0.0, bvp.final_time], dtype=torch.float64)
    nodes = make_nodes("legendre_gauss", 20, dtype=torch.float64)
    found = []
    for function in (MLP((6, 8), seed=2), FrozenMLP((6, 8), seed=2)):
        made = Collocation.on_segments(Discretisation(bvp, function, nodes), times)
        start = project(made, lambda t: torch.ones(len(t), bvp.dimension, dtype=torch.float64))
        layer = output_layer(made, start)
        assert (layer.n_unknowns == made.n_unknowns) is isinstance(function, LinearBasis)
        optimizer = LevenbergMarquardt(Stopping(tolerance=0.0, decrease=1e-10), linear_solver="qr")
        result = optimizer.run(layer, layer.start)
        found.append((float(result.norm), Curve(made, layer.full(result.xi))(torch.linspace(0, 1, 9).to(times))))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-6)
    assert relative(found[0][1], found[1][1]) < 1e-6


def test_a_trained_network_leaves_as_a_module():
    made = collocation(bvp_of("mars_landing"), n_neurons=5, n_segments=2, smoothing=0.4, basis=NETWORKS["mlp"])
    xi = disturbed(made)
    curve = Curve(made, xi)
    network = made.discretisation.expressions.network_of(curve.unknowns.weights[1])
    z = torch.linspace(-1, 1, 5, dtype=torch.float64)
    assert network(z).shape == (5, made.discretisation.expressions.n_heads)
    other = made.discretisation.expressions.network_of(torch.zeros_like(curve.unknowns.weights[1]))
    other.load_state_dict(network.state_dict())
    assert torch.equal(other(z), network(z))


def test_another_free_function_is_a_type_error():
    class Neither(FreeFunction):
        @property
        def arguments(self):
            return {}

    made = collocation(bvp_of("mars_landing"), basis=lambda _: Neither())
    with pytest.raises(TypeError, match="basis = Neither; allowed: a LinearBasis or an MLP"):
        _ = made.n_unknowns
