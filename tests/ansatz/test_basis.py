"""Linear free functions: exact derivatives, seeds, buffers."""

import numpy as np
import pytest
import torch
from torch.func import jacfwd, vmap

from ponn_torch.ansatz.basis import ACTIVATIONS, Chebyshev, GaussianRBF, Lagrange, Legendre, RandomFeatures
from ponn_torch.ansatz.networks import FrozenMLP

BASES = {
    "chebyshev": lambda: Chebyshev(9),
    "chebyshev, degrees 4 to 9": lambda: Chebyshev(6, lowest_degree=4),
    "legendre": lambda: Legendre(9),
    "legendre, degrees 2 to 7": lambda: Legendre(6, lowest_degree=2),
    **{activation: lambda a=activation: RandomFeatures(6, a, seed=3) for activation in ACTIVATIONS},
    "tanh, independent biases": lambda: RandomFeatures(6, "tanh", weight_range=(-1.0, 1.0), bias_range=(-1.0, 1.0)),
    "rbf": lambda: GaussianRBF(5, 1.5),
    "rbf, own shapes": lambda: GaussianRBF([-0.8, 0.1, 0.9], [0.5, 1.0, 2.0]),
    "frozen network": lambda: FrozenMLP((5, 6), seed=3),
}
Z = torch.tensor([-1.0, -0.63, -0.1, 0.0, 0.4, 0.99, 1.0], dtype=torch.float64)


@pytest.mark.parametrize("name", BASES)
def test_every_derivative_is_the_derivative_of_the_one_below(name):
    basis = BASES[name]()
    stack = basis.features(Z, 5)
    assert stack.shape == (6, len(Z), basis.size)
    differentiated = vmap(jacfwd(lambda z: basis.features(z[None], 4)[:, 0]), out_dims=1)(Z)
    for order in range(1, 6):
        scale = float(stack[order].abs().max())
        torch.testing.assert_close(stack[order] / scale, differentiated[order - 1] / scale, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", BASES)
def test_lower_orders_are_the_head_of_higher_ones_and_jets_combine_them(name):
    basis = BASES[name]()
    stack = basis.features(Z, 3)
    torch.testing.assert_close(basis.features(Z, 0), stack[:1])
    weights = torch.randn(2, 4, basis.size, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    jet = basis.jet(weights, Z, 3)
    assert jet.shape == (2, 4, 4, len(Z), 3)
    torch.testing.assert_close(jet[1, 2], stack @ weights[1, 2])


@pytest.mark.parametrize(
    ("basis", "series"),
    [(Chebyshev, np.polynomial.Chebyshev), (Legendre, np.polynomial.Legendre)],
)
def test_polynomials_are_those_of_numpy(basis, series):
    z = torch.linspace(-1, 1, 101, dtype=torch.float64)
    stack = basis(41).features(z, 3)
    for degree in (0, 1, 2, 7, 40):
        for order in range(4):
            expected = series.basis(degree).deriv(order)(z.numpy())
            scale = max(1.0, np.abs(expected).max())
            np.testing.assert_allclose(stack[order, :, degree], expected, atol=1e-12 * scale)


@pytest.mark.parametrize("degree", [30, 80])
@pytest.mark.parametrize("order", range(6))
def test_derivatives_of_high_chebyshev_polynomials_at_the_ends(degree, order):
    # T_k^(e)(1) = prod_{j<e} (k^2 - j^2) / (2j + 1), and (-1)^(k+e) times it at -1
    expected = np.prod([(degree**2 - j**2) / (2 * j + 1) for j in range(order)])
    ends = Chebyshev(degree + 1).features(torch.tensor([-1.0, 1.0], dtype=torch.float64), order)[order, :, degree]
    np.testing.assert_allclose(ends, [(-1) ** (degree + order) * expected, expected], rtol=1e-14)


def test_the_lowest_degree_shifts_the_columns():
    torch.testing.assert_close(Legendre(5, lowest_degree=3).features(Z, 2), Legendre(8).features(Z, 2)[..., 3:])


def test_random_features_are_reproduced_by_their_seed_only():
    first, again, other = (RandomFeatures(20, seed=seed) for seed in (7, 7, 8))
    torch.manual_seed(1)  # the global generator plays no part
    assert torch.equal(first.features(Z, 2), again.features(Z, 2))
    assert not torch.equal(first.weight, other.weight)
    state = torch.get_rng_state()
    RandomFeatures(20, seed=7)
    assert torch.equal(torch.get_rng_state(), state)


def test_weights_and_biases_are_buffers_and_travel_in_the_state_dict():
    basis, other = RandomFeatures(20, seed=7), RandomFeatures(20, seed=8)
    assert set(basis.state_dict()) == {"weight", "bias"}
    assert not list(basis.parameters())
    other.load_state_dict(basis.state_dict())
    assert torch.equal(basis.features(Z, 2), other.features(Z, 2))
    rbf, wider = GaussianRBF(4, 1.0), GaussianRBF(4, 2.0)
    wider.load_state_dict(rbf.state_dict())
    assert torch.equal(rbf.features(Z, 1), wider.features(Z, 1))


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_centred_units_change_inside_the_interval(activation):
    basis = RandomFeatures(200, activation)
    centres = -basis.bias / basis.weight
    assert centres.abs().max() <= 1
    histogram = torch.histc(centres, bins=4, min=-1, max=1)
    assert histogram.min() > 25


def test_independent_ranges_are_respected():
    basis = RandomFeatures(500, weight_range=(-2.0, 3.0), bias_range=(0.5, 0.6))
    assert -2 <= basis.weight.min() < -1.9
    assert 2.9 < basis.weight.max() <= 3
    assert 0.5 <= basis.bias.min() <= basis.bias.max() <= 0.6


def test_activations_are_what_their_names_say():
    expected = {
        "tanh": torch.tanh,
        "sin": torch.sin,
        "sigmoid": torch.sigmoid,
        "gaussian": lambda u: (-u * u).exp(),
        "gelu": torch.nn.functional.gelu,
        "silu": torch.nn.functional.silu,
    }
    assert set(expected) == set(ACTIVATIONS)
    u = torch.linspace(-30, 30, 61, dtype=torch.float64)
    for name, function in expected.items():
        stack = ACTIVATIONS[name](u, 4)
        torch.testing.assert_close(stack[0], function(u), rtol=1e-14, atol=1e-15)
        assert torch.isfinite(stack).all()


def test_rbf_shapes_with_a_leading_axis_give_a_batch_of_tables():
    shapes = torch.tensor([[0.5, 1.0, 2.0], [3.0, 0.1, 0.0]], dtype=torch.float64)
    batch = GaussianRBF(3, shapes).features(Z, 2)
    assert batch.shape == (3, 2, len(Z), 3)
    for row, shape in enumerate(shapes):
        torch.testing.assert_close(batch[:, row], GaussianRBF(3, shape).features(Z, 2))


def test_dtype_is_an_argument():
    z = Z.float()
    for basis in (
        Chebyshev(4),
        RandomFeatures(4, dtype=torch.float32),
        GaussianRBF(4, 1.0, dtype=torch.float32),
    ):
        assert basis.features(z, 1).dtype == torch.float32


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Chebyshev(0), "size = 0"),
        (lambda: Legendre(3, lowest_degree=-1), "lowest_degree = -1"),
        (lambda: RandomFeatures(3, "relu"), "activation = 'relu'.*tanh"),
        (lambda: RandomFeatures(3, weight_range=(1.0, 1.0)), r"weight_range = \(1.0, 1.0\)"),
        (lambda: RandomFeatures(3, bias_range=(2.0, 1.0)), r"bias_range = \(2.0, 1.0\)"),
        (lambda: GaussianRBF(3, [1.0, 2.0]), "shape has 2 entries.*3"),
    ],
)
def test_errors_name_field_value_and_what_is_allowed(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_lagrange_weights_are_values_at_the_points() -> None:
    basis = Lagrange((-0.9, -0.2, 0.3, 1.0))
    z = torch.linspace(-1.0, 1.0, 6, dtype=torch.float64)
    jet = basis.jet((basis.points**3 - 2.0 * basis.points)[:, None], z, 2)[..., 0]
    expected = torch.stack([z**3 - 2.0 * z, 3.0 * z**2 - 2.0, 6.0 * z])
    assert (jet - expected).abs().max() < 1e-13
    assert basis.arguments == {"points": [-0.9, -0.2, 0.3, 1.0]}
    with pytest.raises(ValueError, match="holds a point twice"):
        Lagrange((0.0, 0.5, 0.5)).features(z, 0)
