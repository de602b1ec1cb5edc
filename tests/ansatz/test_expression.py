"""Constrained expressions: constraints hold for any weights, fits converge, tables are conditioned."""

import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ponn_torch.ansatz.basis import Chebyshev, GaussianRBF, Legendre, RandomFeatures
from ponn_torch.ansatz.constraints import derivative, hermite, integral, value
from ponn_torch.ansatz.expression import CONDITIONINGS, ConstrainedExpression
from ponn_torch.ansatz.switch_neurons import SwitchNeuronBasis
from ponn_torch.numerics.nodes import make_nodes, make_panels

NODES = make_nodes("legendre_gauss", 60)
FINE = torch.linspace(-1, 1, 301, dtype=torch.float64)
BASES = {
    "chebyshev": lambda n: Chebyshev(20, lowest_degree=n),
    "legendre": lambda n: Legendre(20, lowest_degree=n),
    "tanh": lambda n: RandomFeatures(30, "tanh", seed=1),
    "sin": lambda n: RandomFeatures(30, "sin", seed=1),
    "rbf": lambda n: GaussianRBF(12, 3.0),
}


def randn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def what_cancels(expression: ConstrainedExpression) -> float:
    """The size of C[g] in the original functions: rounding is relative to it."""
    raw = ConstrainedExpression(expression.basis, expression.constraints, expression.n_variables)
    return max(1.0, float(raw.functionals.abs().max() * expression.combinations.abs().max()))


def oscillation(z: torch.Tensor, order: int) -> torch.Tensor:
    """exp(z/2) sin(3z) and exp(z/2) cos(3z) with derivatives: powers of 1/2 + 3i."""
    values = torch.stack([(0.5 + 3j) ** e * torch.exp((0.5 + 3j) * z) for e in range(order + 1)])
    return torch.stack([values.imag, values.real], dim=-1)


def ends_of_oscillation(order: int) -> torch.Tensor:
    ends = oscillation(torch.tensor([-1.0, 1.0], dtype=torch.float64), order - 1)
    return ends.transpose(0, 1).reshape(2 * order, 2)


@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("conditioning", CONDITIONINGS)
def test_end_values_hold_for_random_weights(name, order, conditioning):
    expression = ConstrainedExpression(
        BASES[name](2 * order), hermite(order), nodes=NODES, order=order, conditioning=conditioning
    )
    weights, kappa = randn(5, expression.size, 3), randn(5, 2 * order, 3, seed=1)
    ends = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    reached = expression.jet(weights, kappa, ends, order - 1).transpose(1, 2).reshape(5, 2 * order, 3)
    scale = what_cancels(expression)
    torch.testing.assert_close(reached, kappa, rtol=0, atol=1e-13 * scale)
    assert expression.check(weights, kappa).shape == kappa.shape
    torch.testing.assert_close(expression.check(weights, kappa), reached - kappa, rtol=0, atol=1e-13 * scale)


SETS_OVER_SEVERAL_VARIABLES = {
    "costate relative to state": (value(0, -1), value(1, 1) - 2 * value(0, 1)),
    "periodic": (
        value(0, 1) - value(0, -1),
        derivative(0, 1) - derivative(0, -1),
        value(1, -1) + value(0, 0),
    ),
    "integrals": (
        integral(0, NODES),
        integral(1, NODES, weight=NODES.points) - value(0, 1),
        derivative(1, 0.5),
    ),
    "sum of values": (value(0, -1) + value(1, -1), value(0, 1), derivative(1, 1)),
    "second variable free": (value(0, -1), derivative(0, -1)),
}


@pytest.mark.parametrize("name", SETS_OVER_SEVERAL_VARIABLES)
@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("conditioning", CONDITIONINGS)
def test_constraints_over_several_variables_hold_for_random_weights(name, basis, conditioning):
    constraints = SETS_OVER_SEVERAL_VARIABLES[name]
    expression = ConstrainedExpression(
        BASES[basis](0), constraints, n_variables=2, nodes=NODES, order=1, conditioning=conditioning
    )
    weights, kappa = randn(4, expression.size, 2), randn(4, len(constraints), seed=1)
    assert expression.jet(weights, kappa, FINE, 2).shape == (4, 3, len(FINE), 2)
    scale = what_cancels(expression)
    assert expression.check(weights, kappa).shape == kappa.shape
    torch.testing.assert_close(expression.check(weights, kappa), torch.zeros_like(kappa), rtol=0, atol=1e-13 * scale)


def test_the_relative_constraint_of_a_horizon_by_hand():
    # lambda(1) - S x(1) = kappa with x(-1) given: x = x0 + g - g(-1), lambda = kappa + S x(1) + h - h(1)
    gain, basis = 2.5, Chebyshev(8)
    expression = ConstrainedExpression(basis, (value(0, -1), value(1, 1) - gain * value(0, 1)), n_variables=2)
    weights, kappa = randn(8, 2), torch.tensor([0.3, -0.7], dtype=torch.float64)
    g, h = (basis.features(FINE, 0)[0] @ weights).T
    state = kappa[0] + g - g[0]
    costate = kappa[1] + gain * state[-1] + h - h[-1]
    expected = torch.stack([state, costate], dim=-1)
    torch.testing.assert_close(expression.jet(weights, kappa, FINE, 0)[0], expected)


CONSTRAINTS = st.builds(
    lambda variable, at, order, factor, other, at_other: (
        derivative(variable, at, order) + factor * value(other, at_other)
    ),
    st.integers(0, 1),
    st.sampled_from([-1.0, -0.3, 0.5, 1.0]),
    st.integers(0, 2),
    st.sampled_from([0.0, 1.0, -2.0]),
    st.integers(0, 1),
    st.sampled_from([-1.0, 0.2, 1.0]),
)


@given(st.lists(CONSTRAINTS, min_size=1, max_size=5), st.integers(0, 1000))
@settings(deadline=None, max_examples=40)
def test_random_relative_constraints_hold_for_random_weights(constraints, seed):
    try:
        expression = ConstrainedExpression(RandomFeatures(12, "sin", weight_range=(-2, 2)), constraints, 2)
    except ValueError:
        assume(False)
    assume(expression.switching.coefficients.abs().max() < 30)
    weights, kappa = randn(12, 2, seed=seed), randn(len(constraints), seed=seed + 1)
    assert expression.check(weights, kappa).abs().max() < 1e-12


def test_check_sees_a_broken_expression():
    expression = ConstrainedExpression(Chebyshev(5), hermite(2))
    expression.switching.coefficients += 0.01
    assert expression.check(randn(5, 1), randn(4, 1)).abs().max() > 1e-3


@pytest.mark.parametrize("conditioning", CONDITIONINGS)
@pytest.mark.parametrize("order", [1, 2, 3])
def test_fits_converge_spectrally_off_the_nodes(order, conditioning):
    kappa, errors = ends_of_oscillation(order), []
    for size in (5, 9, 18):
        expression = ConstrainedExpression(
            Chebyshev(size, lowest_degree=2 * order),
            hermite(order),
            nodes=NODES,
            order=order,
            conditioning=conditioning,
        )
        weights = expression.fit(NODES.points, oscillation(NODES.points, 0)[0], kappa, weights=NODES.weights)
        error = expression.jet(weights, kappa, FINE, order) - oscillation(FINE, order)
        errors.append(float(error[0].abs().max()))
        assert expression.check(weights, kappa).abs().max() < 1e-12
    assert errors[0] > 1e-5
    assert errors[1] < 1e-2 * errors[0]
    assert errors[2] < 2e-13
    assert error[order].abs().max() < 1e-8  # and the derivatives follow


@pytest.mark.parametrize("name", ["tanh", "sigmoid", "gaussian", "sin"])
def test_random_features_with_default_slopes_reach_many_digits(name):
    kappa = ends_of_oscillation(2)
    expression = ConstrainedExpression(
        RandomFeatures(50, name),
        hermite(2),
        nodes=make_nodes("legendre_gauss", 100),
        order=2,
        conditioning="orthonormal",
    )
    weights = expression.fit(FINE, oscillation(FINE, 0)[0], kappa)
    error = expression.jet(weights, kappa, torch.linspace(-1, 1, 507).double(), 0)
    assert (error[0] - oscillation(torch.linspace(-1, 1, 507).double(), 0)[0]).abs().max() < 1e-9


def test_a_fit_of_a_function_of_the_expression_returns_its_weights():
    expression = ConstrainedExpression(
        Chebyshev(12, lowest_degree=2), hermite(1), nodes=NODES, order=1, conditioning="orthonormal"
    )
    weights, kappa = randn(3, 12, 2), randn(3, 2, 2, seed=1)
    values = expression.jet(weights, kappa, NODES.points, 0)[:, 0]
    torch.testing.assert_close(expression.fit(NODES.points, values, kappa), weights, rtol=1e-11, atol=1e-11)


def test_a_fit_over_several_variables_returns_the_weights():
    constraints = SETS_OVER_SEVERAL_VARIABLES["costate relative to state"]
    expression = ConstrainedExpression(Chebyshev(9, lowest_degree=1), constraints, n_variables=2)
    weights, kappa = randn(3, 9, 2), randn(3, 2, seed=1)
    values = expression.jet(weights, kappa, NODES.points, 0)[:, 0]
    fitted = expression.fit(NODES.points, values, kappa, weights=NODES.weights)
    torch.testing.assert_close(fitted, weights, rtol=1e-11, atol=1e-11)


def test_ridge_is_the_penalised_least_squares_solution():
    expression = ConstrainedExpression(Chebyshev(6, lowest_degree=2), hermite(1))
    z, y, kappa, ridge = FINE[::10], randn(31, 2), randn(2, 2, seed=1), 0.3
    free, omega = (table[0] for table in expression.tables(z, 0))
    normal = free.T @ free + ridge * torch.eye(6, dtype=torch.float64)
    expected = torch.linalg.solve(normal, free.T @ (y - omega @ kappa))
    torch.testing.assert_close(expression.fit(z, y, kappa, ridge=ridge), expected)


def test_a_fit_to_fewer_points_than_weights_passes_through_them_with_the_shortest_weights():
    expression = ConstrainedExpression(Chebyshev(20, lowest_degree=2), hermite(1))
    z, kappa = torch.tensor([-0.5, 0.1, 0.6], dtype=torch.float64), randn(2, 1)
    weights = expression.fit(z, randn(3, 1, seed=2), kappa)
    torch.testing.assert_close(expression.jet(weights, kappa, z, 0)[0], randn(3, 1, seed=2))
    free = expression.tables(z, 0)[0][0]
    in_row_space = free.T @ torch.linalg.solve(free @ free.T, free @ weights)
    torch.testing.assert_close(weights, in_row_space)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("basis", [Chebyshev, Legendre])
@pytest.mark.parametrize("kind", ["chebyshev_lobatto", "legendre_gauss"])
def test_orthonormal_polynomials_are_as_many_as_asked_for_and_orthonormal(order, basis, kind):
    nodes = make_nodes(kind, 140)
    expression = ConstrainedExpression(
        basis(70, lowest_degree=2 * order),
        hermite(order),
        nodes=nodes,
        order=order,
        conditioning="orthonormal",
    )
    table = expression.tables(nodes.points, order)[0][order]
    assert table.shape == (140, 70)
    gram = table.T @ (nodes.weights[:, None] / 2 * table)
    torch.testing.assert_close(gram, torch.eye(70).double(), rtol=0, atol=1e-11)


def test_columns_have_unit_rms_of_the_highest_derivative():
    expression = ConstrainedExpression(
        Chebyshev(30, lowest_degree=4), hermite(2), nodes=NODES, order=2, conditioning="columns"
    )
    table = expression.tables(NODES.points, 2)[0][2]
    torch.testing.assert_close(NODES.weights / 2 @ table**2, torch.ones(30).double())
    # a diagonal map: every column is still one polynomial, with the sign it had
    raw = ConstrainedExpression(Chebyshev(30, lowest_degree=4), hermite(2)).tables(FINE, 2)[0]
    scaled = expression.tables(FINE, 2)[0]
    torch.testing.assert_close(scaled / scaled[2, -1], raw / raw[2, -1], rtol=1e-9, atol=1e-9)
    assert (scaled[2, -1] * raw[2, -1] > 0).all()


@pytest.mark.parametrize("conditioning", ["columns", "orthonormal", "ordered"])
def test_functions_that_the_supports_span_are_dropped(conditioning):
    expression = ConstrainedExpression(Chebyshev(10), hermite(2), nodes=NODES, order=2, conditioning=conditioning)
    assert expression.size == 6
    exact = ConstrainedExpression(
        Chebyshev(6, lowest_degree=4), hermite(2), nodes=NODES, order=2, conditioning=conditioning
    )
    torch.testing.assert_close(expression.tables(FINE, 2)[0], exact.tables(FINE, 2)[0], rtol=0, atol=1e-11)


def test_dependent_random_features_are_dropped_and_the_rest_is_orthonormal():
    nodes = make_nodes("legendre_gauss", 200)
    expression = ConstrainedExpression(
        RandomFeatures(90, "tanh", seed=4), hermite(2), nodes=nodes, order=2, conditioning="orthonormal"
    )
    assert 40 < expression.size < 80
    table = expression.tables(nodes.points, 2)[0][2]
    gram = table.T @ (nodes.weights[:, None] / 2 * table)
    torch.testing.assert_close(gram, torch.eye(expression.size).double(), rtol=0, atol=1e-3)
    coarser = ConstrainedExpression(
        RandomFeatures(90, "tanh", seed=4),
        hermite(2),
        nodes=nodes,
        order=2,
        conditioning="orthonormal",
        truncation=1e-6,
    )
    assert coarser.size < expression.size


@pytest.mark.parametrize("conditioning", ["columns", "orthonormal"])
@pytest.mark.parametrize(
    "constraints", [(), (value(0, -1),), (derivative(0, -1), derivative(0, 1))], ids=["none", "one", "slopes"]
)
def test_functions_without_a_highest_derivative_are_kept(constraints, conditioning):
    # order 2, but straight lines (or a constant) are free: they must stay representable and bounded
    lowest = {0: 0, 1: 1}.get(len(constraints), 0)
    expression = ConstrainedExpression(
        Chebyshev(8, lowest_degree=lowest), constraints, nodes=NODES, order=2, conditioning=conditioning
    )
    assert torch.isfinite(expression.combinations).all()
    assert expression.combinations.abs().max() < 10
    kappa = torch.zeros(len(constraints), 1, dtype=torch.float64)
    target = {0: 3 - 2 * FINE, 1: 1 + FINE}.get(len(constraints), 1 + 0 * FINE)[:, None]
    weights = expression.fit(FINE, target, kappa)
    torch.testing.assert_close(expression.jet(weights, kappa, FINE, 0)[0], target)


def test_a_fit_on_other_nodes_than_the_conditioning_agrees():
    kappa, values = ends_of_oscillation(2), oscillation(FINE, 0)[0]
    curves = []
    for nodes in (NODES, make_nodes("chebyshev_lobatto", 45)):
        expression = ConstrainedExpression(
            Chebyshev(22, lowest_degree=4), hermite(2), nodes=nodes, order=2, conditioning="orthonormal"
        )
        weights = expression.fit(FINE, values, kappa)
        curves.append(expression.jet(weights, kappa, torch.tensor([-0.777, 0.123], dtype=torch.float64), 2))
    torch.testing.assert_close(curves[0], curves[1], rtol=1e-9, atol=1e-9)


def test_in_order_a_narrow_function_is_kept_behind_wide_ones():
    """Two layers of unlike width differ by less than 1e-6 of the largest polynomial; two of the same are one."""
    nodes = make_panels("legendre_gauss", torch.linspace(-1, 1, 41, dtype=torch.float64), 8)
    basis = SwitchNeuronBasis(Chebyshev(40, lowest_degree=4), [0.2] * 3, [1e3, 1.5e3, 1.5e3], [0, 0, 0])
    made = {
        conditioning: ConstrainedExpression(
            basis, hermite(2), nodes=nodes, order=2, conditioning=conditioning, truncation=1e-6
        )
        for conditioning in ("orthonormal", "ordered")
    }
    assert made["orthonormal"].size < made["ordered"].size == basis.size - 1
    table = (nodes.weights / 2).sqrt()[:, None] * made["ordered"].tables(nodes.points, 2)[0][2]
    torch.testing.assert_close(table.T @ table, torch.eye(table.shape[1], dtype=table.dtype), rtol=0, atol=1e-9)


def test_given_combinations_are_used_as_they_are():
    basis = RandomFeatures(40, "tanh", seed=4)
    first = ConstrainedExpression(basis, hermite(2), nodes=NODES, order=2, conditioning="orthonormal")
    flipped = first.combinations * torch.linspace(-1, 1, first.size, dtype=torch.float64).sign()
    second = ConstrainedExpression(
        basis, hermite(2), nodes=NODES, order=2, conditioning="orthonormal", combinations=flipped
    )
    for one, other in zip(first.tables(NODES.points, 2), second.tables(NODES.points, 2), strict=True):
        torch.testing.assert_close(one.abs(), other.abs(), rtol=0, atol=1e-8 * float(one.abs().max()))
    assert torch.equal(second.combinations, flipped)


def test_a_state_dict_restores_the_expression_in_full():
    def make(seed: int) -> ConstrainedExpression:
        basis = RandomFeatures(10, "tanh", seed=seed, weight_range=(-9.0, 9.0))
        return ConstrainedExpression(basis, hermite(1), nodes=NODES, order=1, conditioning="columns")

    first, other = make(0), make(1)
    assert not torch.equal(first.tables(FINE, 1)[0], other.tables(FINE, 1)[0])
    other.load_state_dict(first.state_dict())
    assert torch.equal(first.tables(FINE, 1)[0], other.tables(FINE, 1)[0])
    assert not list(first.parameters())


def test_no_constraints_leave_the_free_function():
    basis = Chebyshev(6)
    expression = ConstrainedExpression(basis, ())
    weights, kappa = randn(6, 2), torch.zeros(0, 2, dtype=torch.float64)
    torch.testing.assert_close(expression.jet(weights, kappa, FINE, 2), basis.jet(weights, FINE, 2))
    assert expression.check(weights, kappa).shape == (0, 2)
    assert math.prod(expression.tables(FINE, 1)[1].shape) == 0


def test_single_precision():
    expression = ConstrainedExpression(
        RandomFeatures(20, dtype=torch.float32),
        hermite(1),
        nodes=make_nodes("legendre_gauss", 40, dtype=torch.float32),
        order=1,
        conditioning="columns",
        truncation=1e-4,
        dtype=torch.float32,
    )
    weights, kappa = randn(expression.size, 2).float(), randn(2, 2).float()
    assert expression.jet(weights, kappa, FINE.float(), 1).dtype == torch.float32
    assert expression.check(weights, kappa).abs().max() < 1e-4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"conditioning": "row"}, "conditioning = 'row'.*orthonormal"),
        ({"conditioning": "columns"}, "nodes = None.*'columns'"),
        (
            {"basis": Chebyshev(4), "nodes": NODES, "order": 2, "conditioning": "columns"},
            "basis of size 4",
        ),
        ({"constraints": (value(0, 1), value(0, 1))}, r"\[y0\(1\), y0\(1\)\] clash"),
    ],
)
def test_errors_name_field_value_and_what_is_allowed(arguments, message):
    with pytest.raises(ValueError, match=message):
        ConstrainedExpression(**{"basis": Chebyshev(8), "constraints": hermite(2), **arguments})
