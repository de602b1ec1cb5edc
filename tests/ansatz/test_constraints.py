"""Constraints and switching functions: the papers' tables, any regular set, clashes named."""

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ponn_torch.ansatz.basis import Legendre
from ponn_torch.ansatz.constraints import (
    Constraint,
    SwitchingFunctions,
    apply,
    derivative,
    functional_matrix,
    hermite,
    integral,
    value,
)
from ponn_torch.numerics.nodes import make_nodes

NODES = make_nodes("legendre_gauss", 12)

# Tables A1 to A6 of the fuel-optimal paper; A6 is also Table I of the powered descent paper. Constraints are
# at the ends a, b of an interval of length d; one list per derivative, one entry per constraint; s = z - a.
TABLES = {
    "A1, start": (lambda a, b: (value(0, a),), lambda z, s, a, b, d: [[1], [0]]),
    "A1, end": (lambda a, b: (value(0, b),), lambda z, s, a, b, d: [[1], [0]]),
    "A2, start": (lambda a, b: (derivative(0, a),), lambda z, s, a, b, d: [[z], [1]]),
    "A2, end": (lambda a, b: (derivative(0, b),), lambda z, s, a, b, d: [[z], [1]]),
    "A3": (
        lambda a, b: (value(0, a), value(0, b)),
        lambda z, s, a, b, d: [[(b - z) / d, (z - a) / d], [-1 / d, 1 / d], [0, 0]],
    ),
    "A4": (
        lambda a, b: (value(0, a), derivative(0, a)),
        lambda z, s, a, b, d: [[1, z - a], [0, 1], [0, 0]],
    ),
    "A5": (
        lambda a, b: (value(0, a), value(0, b), derivative(0, a)),
        lambda z, s, a, b, d: [
            [(b - z) * (z - 2 * a + b) / d**2, (z - a) ** 2 / d**2, (z - a) * (b - z) / d],
            [-2 * (z - a) / d**2, 2 * (z - a) / d**2, (-2 * z + a + b) / d],
            [-2 / d**2, 2 / d**2, -2 / d],
        ],
    ),
    "A6": (
        lambda a, b: (value(0, a), value(0, b), derivative(0, a), derivative(0, b)),
        lambda z, s, a, b, d: [
            [
                1 + 2 * s**3 / d**3 - 3 * s**2 / d**2,
                -2 * s**3 / d**3 + 3 * s**2 / d**2,
                s + s**3 / d**2 - 2 * s**2 / d,
                s**3 / d**2 - s**2 / d,
            ],
            [
                6 * s**2 / d**3 - 6 * s / d**2,
                -6 * s**2 / d**3 + 6 * s / d**2,
                1 + 3 * s**2 / d**2 - 4 * s / d,
                3 * s**2 / d**2 - 2 * s / d,
            ],
            [
                12 * s / d**3 - 6 / d**2,
                -12 * s / d**3 + 6 / d**2,
                6 * s / d**2 - 4 / d,
                6 * s / d**2 - 2 / d,
            ],
        ],
    ),
}


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize(("start", "end"), [(-1.0, 1.0), (0.0, 1.0), (0.5, 2.25)])
def test_tables_of_the_papers(name, start, end):
    constraints, table = TABLES[name]
    z = torch.linspace(start, end, 23, dtype=torch.float64)
    rows = table(z, z - start, start, end, end - start)
    expected = torch.stack([torch.stack([entry + 0 * z for entry in row], dim=-1) for row in rows])
    omega = SwitchingFunctions(constraints(start, end))(z, len(rows) - 1)
    # equal but for rounding, which the basis of Chebyshev polynomials amplifies outside [-1, 1]
    tolerance = 3e-15 if end <= 1 else 3e-12
    torch.testing.assert_close(omega[:, :, 0], expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_hermite_constraints_come_end_by_end_with_ascending_derivatives(order):
    constraints = hermite(order)
    ends = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    omega = SwitchingFunctions(constraints)(ends, order)[:order, :, 0]
    torch.testing.assert_close(omega.transpose(0, 1).reshape(2 * order, -1), torch.eye(2 * order).double())
    assert [str(c) for c in hermite(2)] == ["y(-1)", "y'(-1)", "y(1)", "y'(1)"]


def test_a_second_derivative_alone_gets_a_parabola():
    omega = SwitchingFunctions((derivative(0, 0.3, order=2),))(NODES.points, 3)
    torch.testing.assert_close(omega[2], torch.ones_like(omega[2]))
    torch.testing.assert_close(omega[3], torch.zeros_like(omega[3]))


def test_switching_functions_need_no_constraints():
    assert SwitchingFunctions((), n_variables=2)(NODES.points, 1).shape == (2, 12, 2, 0)


def test_a_constraint_is_its_functional():
    basis = Legendre(6)  # on P_k: P_k(1) = 1, P_k(-1) = (-1)^k, P_k'(1) = k (k + 1) / 2, zero mean but for k = 0
    k = torch.arange(6, dtype=torch.float64)
    sign = (-1) ** k
    cases = {
        value(0, 1): 1 + 0 * k,
        derivative(0, 1): k * (k + 1) / 2,
        derivative(0, -1, order=2): sign * (k - 1) * k * (k + 1) * (k + 2) / 8,
        3 * value(0, -1) - value(0, 1) * 0.5: 3 * sign - 0.5,
        -derivative(0, 1): -k * (k + 1) / 2,
        integral(0, NODES): 2.0 * (k == 0),
        integral(0, NODES, weight=NODES.points): 2 / 3 * (k == 1),
        integral(0, NODES) - 2 * value(0, 1): 2.0 * (k == 0) - 2,
    }
    for constraint, expected in cases.items():
        row = functional_matrix((constraint,), basis.features, 6, 1)[0, 0]
        torch.testing.assert_close(row, expected.double(), msg=lambda m, c=constraint: f"{c}: {m}")


def test_constraints_print_as_they_are_written():
    lam, x = "lambda", "x"
    assert str(derivative(0, -1, name=x)) == "x'(-1)"
    assert str(value(1, 1, name=lam) - 2 * value(0, 1, name=x)) == "lambda(1) - 2 x(1)"
    assert str(-value(2, 0.25)) == "-y2(0.25)"
    assert str(0.5 * value(0, 1) + derivative(0, 1, order=4)) == "0.5 y0(1) + y0^(4)(1)"
    assert str(integral(0, NODES, name=x)) == "∫ x dz"
    assert str(integral(1, NODES, weight=NODES.points)) == "∫ weight y1 dz"


POINTS = st.sampled_from([-1.0, -0.6, -0.25, 0.0, 0.4, 0.75, 1.0])
FACTORS = st.sampled_from([-3.0, -1.0, 0.5, 1.0, 2.0])


def simple_constraints(n_variables: int) -> st.SearchStrategy[Constraint]:
    variables = st.integers(0, n_variables - 1)
    weights = st.lists(st.floats(-2, 2), min_size=12, max_size=12)
    return st.one_of(
        st.builds(derivative, variables, POINTS, st.integers(0, 2)),
        st.builds(integral, variables, st.just(NODES), st.none() | weights),
    )


@st.composite
def constraint_sets(draw) -> tuple[int, tuple[Constraint, ...]]:
    n_variables = draw(st.integers(1, 3))
    simple = simple_constraints(n_variables)
    relative = st.builds(lambda a, s, b: a + s * b, simple, FACTORS, simple)
    return n_variables, tuple(draw(st.lists(simple | relative, min_size=1, max_size=6)))


def switching_functions_or_discard(constraints, n_variables) -> SwitchingFunctions:
    try:
        switching = SwitchingFunctions(constraints, n_variables)
    except ValueError:
        assume(False)
    assume(switching.coefficients.abs().max() < 100)  # nearly clashing sets lose digits in the data already
    return switching


@given(constraint_sets())
@settings(deadline=None, max_examples=60)
def test_any_regular_set_is_dual_to_its_switching_functions(drawn):
    n_variables, constraints = drawn
    switching = switching_functions_or_discard(constraints, n_variables)

    def each(z, order):  # one switching function after the other along a leading axis
        return switching(z, order).movedim(-1, 0)

    matrix = torch.stack([apply(constraint, each) for constraint in constraints])
    torch.testing.assert_close(matrix, torch.eye(len(constraints), dtype=matrix.dtype), rtol=0, atol=1e-12)


@given(constraint_sets(), st.data())
@settings(deadline=None, max_examples=40)
def test_a_combination_of_regular_constraints_clashes_with_exactly_those_it_combines(drawn, data):
    n_variables, constraints = drawn
    switching_functions_or_discard(constraints, n_variables)
    factors = data.draw(st.lists(FACTORS | st.just(0.0), min_size=len(constraints), max_size=len(constraints)))
    assume(any(factors))
    used = [constraint for constraint, factor in zip(constraints, factors, strict=True) if factor]
    combination = Constraint(())
    for constraint, factor in zip(constraints, factors, strict=True):
        combination += factor * constraint if factor else Constraint(())
    with pytest.raises(ValueError, match="clash") as error:
        SwitchingFunctions((*constraints, combination), n_variables)
    assert f"[{', '.join(map(str, [*used, combination]))}]" in str(error.value)


@pytest.mark.parametrize(
    ("constraints", "culprits"),
    [
        ((value(0, -1), value(0, 1), 2 * value(0, 1)), "y0(1), 2 y0(1)"),
        ((value(0, 0), derivative(0, 1), value(0, 0)), "y0(0), y0(0)"),
        ((value(0, 1) - value(0, 1), value(0, 0)), "y0(1) - y0(1)"),
        (
            (derivative(0, 0), value(0, -1), value(1, 1), value(0, -1) - value(1, 1)),
            "y0(-1), y1(1), y0(-1) - y1(1)",
        ),
        (
            (value(0, 1), value(0, 1), derivative(1, 0), derivative(1, 1), 3 * derivative(1, 1)),
            "y0(1), y0(1), y1'(1), 3 y1'(1)",  # two clashes at once
        ),
    ],
)
def test_clashing_constraints_are_named_and_no_others(constraints, culprits):
    with pytest.raises(ValueError, match="clash") as error:
        SwitchingFunctions(constraints, n_variables=2)
    assert f"[{culprits}]" in str(error.value)


def test_small_and_large_factors_are_no_clash():
    constraints = (1e-9 * value(0, -1), 1e9 * value(0, 1), 1e-7 * derivative(0, 1, order=3))
    switching = SwitchingFunctions(constraints)
    matrix = functional_matrix(constraints, lambda z, order: switching(z, order)[:, :, 0], 3, 1)[:, 0]
    np.testing.assert_allclose(matrix, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: SwitchingFunctions((value(2, 0.0),), n_variables=2),
            r"variable = 2 in y2\(0\).*n_variables = 2",
        ),
        (lambda: value(-1, 0.0), "variable = -1"),
        (lambda: derivative(0, 0.0, order=-1), "order = -1"),
        (lambda: integral(0, NODES, weight=[1.0, 2.0]), r"weight has shape \(2,\).*\(12,\)"),
    ],
)
def test_errors_name_field_value_and_what_is_allowed(make, message):
    with pytest.raises(ValueError, match=message):
        make()
