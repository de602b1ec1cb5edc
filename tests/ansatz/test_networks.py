"""Deep free functions: exact jets, exact gradients of every output, weights that are only an argument."""

from __future__ import annotations

import pytest
import torch
from helpers import random, relative
from torch import Tensor
from torch.func import jacrev, jvp, vmap

from ponn_torch.ansatz.basis import ACTIVATIONS
from ponn_torch.ansatz.networks import MLP, FrozenMLP, Network, compose

Z = torch.tensor([-1.0, -0.63, -0.1, 0.0, 0.4, 0.99, 1.0], dtype=torch.float64)
NETWORKS = {
    **{activation: lambda a=activation: MLP((5, 6), a, seed=1) for activation in ACTIVATIONS},
    "one hidden layer": lambda: MLP((7,)),
    "residual": lambda: MLP((4, 4, 4), residual=True),
    "harmonics": lambda: MLP((5, 6), n_frequencies=3),
    "adaptive slope": lambda: MLP((5, 6), "silu", adaptive_slope=True),
    "one per head": lambda: MLP((4, 3), shared=False),
    "all at once": lambda: MLP((4, 4), "sin", residual=True, n_frequencies=2, adaptive_slope=True, shared=False),
}
HEADS = 3


def weights_of(network: MLP, *batch: int) -> Tensor:
    initial = network.initial(HEADS)
    return initial + 0.1 * random(*batch, len(initial), seed=5, low=-1.0)


@pytest.mark.parametrize("name", NETWORKS)
def test_jets_are_those_of_nested_forward_differentiation(name):
    network = NETWORKS[name]()
    weights = weights_of(network)

    def value(z: Tensor) -> Tensor:
        return network.jet(weights, z[None], 0)[0, 0]

    jet, function = network.jet(weights, Z, 4), value
    assert jet.shape == (5, len(Z), HEADS)
    for order in range(5):
        assert relative(jet[order], vmap(function)(Z)) < 1e-12, order
        function = lambda z, f=function: jvp(f, (z,), (torch.ones_like(z),))[1]  # noqa: E731


@pytest.mark.parametrize("name", NETWORKS)
def test_gradients_of_single_outputs_are_those_of_autograd(name):
    network = NETWORKS[name]()
    weights = weights_of(network, 2)
    cotangents = random(2, 4, len(Z), 3, HEADS, seed=2, low=-1.0)
    jacobian = torch.stack([jacrev(lambda w: network.jet(w, Z, 2))(member) for member in weights])
    expected = torch.einsum("brneh,benhp->brnp", cotangents, jacobian)
    assert relative(network.gradients(weights, Z, cotangents), expected) < 1e-12


@pytest.mark.parametrize("name", NETWORKS)
def test_leading_axes_are_independent_networks(name):
    network = NETWORKS[name]()
    weights = weights_of(network, 2, 3)
    together = network.jet(weights, Z, 2)
    assert together.shape == (2, 3, 3, len(Z), HEADS)
    torch.testing.assert_close(together[1, 2], network.jet(weights[1, 2], Z, 2), rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", NETWORKS)
def test_the_output_layer_combines_the_features_linearly_and_nothing_else_does(name):
    network = NETWORKS[name]()
    weights, chosen = weights_of(network), network.output_layer(HEADS)
    assert len(chosen) == network.hidden[-1] * HEADS
    features = network.hidden_jet(weights, Z, 2)
    assert features.shape == (1 if network.shared else HEADS, 3, len(Z), network.hidden[-1])
    output = weights[chosen].view(len(features), network.hidden[-1], -1)
    expected = torch.cat(list(features @ output[:, None]), -1)
    assert relative(network.jet(weights, Z, 2), expected) < 1e-13
    zero = weights.index_fill(0, chosen, 0.0)
    assert not network.jet(zero, Z, 2).any()


def test_composition_is_the_series_of_the_composed_function():
    # exp(sin z) about z = 0.3: coefficients by differentiating six times
    z, order = torch.tensor(0.3, dtype=torch.float64), 6
    factorials = torch.cumprod(torch.tensor([1.0, *range(1, order + 1)], dtype=torch.float64), 0)
    inner = ACTIVATIONS["sin"](z, order) / factorials
    value, slope = compose(torch.exp(inner[0]).expand(order + 2), inner)
    function = lambda z: torch.exp(torch.sin(z))  # noqa: E731
    for e in range(order + 1):
        assert float(value[e]) == pytest.approx(float(function(z) / factorials[e]), rel=1e-11, abs=1e-11)
        function = lambda z, f=function: jvp(f, (z,), (torch.ones_like(z),))[1]  # noqa: E731
    assert torch.equal(value, slope)


def test_the_seed_decides_and_nothing_global_does():
    first, again, other = (MLP((8, 9), seed=seed).initial(2) for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    state = torch.get_rng_state()
    MLP((8, 9)).initial(2)
    assert torch.equal(torch.get_rng_state(), state)


def test_first_units_are_spread_over_the_interval():
    network = MLP((40, 5), first_scale=4.0)
    layer, bias = network.initial(1)[:40], network.initial(1)[40:80]
    assert float(layer.abs().max()) <= 4.0
    assert float(layer.abs().min()) >= 1.0
    torch.testing.assert_close(-bias / layer, torch.linspace(-1.05, 1.05, 40, dtype=torch.float64))


def test_a_network_comes_back_from_its_state_bit_for_bit(tmp_path):
    architecture = MLP((5, 6), adaptive_slope=True)
    network = Network(architecture, weights_of(architecture))
    torch.save(network.state_dict(), tmp_path / "network.pt")
    other = Network(architecture, architecture.initial(HEADS))
    assert not torch.equal(other(Z), network(Z))
    other.load_state_dict(torch.load(tmp_path / "network.pt", weights_only=True))
    assert torch.equal(other.weights, network.weights)
    assert torch.equal(other(Z), network(Z))


def test_a_network_trains_by_torch_optim():
    network = Network(MLP((6, 8)), MLP((6, 8)).initial(1))
    target, optimizer = torch.sin(3 * Z)[:, None], torch.optim.Adam(network.parameters(), lr=1e-2)
    losses = []
    for _ in range(200):
        optimizer.zero_grad()
        loss = (network(Z) - target).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 1e-2 * losses[0]


def test_a_frozen_network_is_its_last_hidden_layer():
    network, frozen = MLP((5, 6), n_frequencies=2, seed=9), FrozenMLP((5, 6), n_frequencies=2, seed=9)
    assert frozen.size == 6
    assert torch.equal(frozen.features(Z, 2), network.hidden_jet(network.initial(3), Z, 2)[0])
    again = FrozenMLP(**frozen.arguments)
    assert torch.equal(again.features(Z, 2), frozen.features(Z, 2))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"activation": "tan"}, "activation = 'tan' is unknown; allowed: tanh"),
        ({"hidden": []}, r"hidden = \[\]; allowed"),
        ({"hidden": [3, 0]}, r"hidden = \[3, 0\]; allowed"),
        ({"hidden": [3, 4], "residual": True}, "equal widths"),
        ({"n_frequencies": -1}, "n_frequencies = -1; allowed"),
    ],
)
def test_what_is_no_network_is_told(arguments, message):
    with pytest.raises(ValueError, match=message):
        MLP(**arguments)
