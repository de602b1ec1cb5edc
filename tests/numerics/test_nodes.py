"""Nodes: exact quadrature to the documented degree, end points, interpolation, differentiation, moments."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from ponn_torch.numerics.nodes import (
    NODE_KINDS,
    NodeSet,
    barycentric_weights,
    differentiation_matrix,
    graded_edges,
    interpolation_matrix,
    legendre_moments,
    make_nodes,
    make_panels,
)

EXACT_DEGREE = {
    "uniform": lambda n: 1,
    "chebyshev_gauss": lambda n: n - 1,
    "chebyshev_lobatto": lambda n: n - 1,
    "legendre_gauss": lambda n: 2 * n - 1,
    "legendre_lobatto": lambda n: 2 * n - 3,
    "legendre_radau": lambda n: 2 * n - 2,
}
FAMILY_OF_ENDS = {  # is -1, is +1 a node
    "uniform": (True, True),
    "chebyshev_gauss": (False, False),
    "chebyshev_lobatto": (True, True),
    "legendre_gauss": (False, False),
    "legendre_lobatto": (True, True),
    "legendre_radau": (True, False),
}
SPECTRAL = [kind for kind in NODE_KINDS if kind != "uniform"]


@pytest.mark.parametrize("kind", NODE_KINDS)
@pytest.mark.parametrize("n_nodes", [2, 3, 8, 31, 120])
def test_quadrature_is_exact_to_the_documented_degree(kind, n_nodes):
    nodes = make_nodes(kind, n_nodes)
    degree = EXACT_DEGREE[kind](n_nodes)
    integrals = nodes.weights.numpy() @ np.polynomial.legendre.legvander(nodes.points.numpy(), degree)
    np.testing.assert_allclose(integrals, [2.0, *[0.0] * degree], atol=1e-14)
    assert (nodes.weights > 0).all()


@pytest.mark.parametrize("kind", NODE_KINDS)
@pytest.mark.parametrize("n_nodes", [4, 7])
def test_quadrature_is_not_exact_beyond_it(kind, n_nodes):
    nodes = make_nodes(kind, n_nodes)
    even = EXACT_DEGREE[kind](n_nodes) + 1
    even += even % 2  # odd degrees are exact by symmetry
    error = torch.dot(nodes.weights, nodes.points**even) - 2 / (even + 1)
    assert abs(error) > 1e-5


@pytest.mark.parametrize("kind", NODE_KINDS)
@pytest.mark.parametrize("n_nodes", [2, 9, 64])
def test_points_ascend_and_ends_are_exact(kind, n_nodes):
    points = make_nodes(kind, n_nodes).points
    assert (points.diff() > 0).all()
    assert (points[0].item() == -1.0, points[-1].item() == 1.0) == FAMILY_OF_ENDS[kind]
    assert points.abs().max() <= 1.0


def test_known_rules():
    root = math.sqrt(3 / 5)
    expected = {
        "legendre_gauss": ([-root, 0, root], [5 / 9, 8 / 9, 5 / 9]),
        "legendre_lobatto": ([-1, 0, 1], [1 / 3, 4 / 3, 1 / 3]),
        "legendre_radau": (
            [-1, (1 - math.sqrt(6)) / 5, (1 + math.sqrt(6)) / 5],
            [2 / 9, (16 + math.sqrt(6)) / 18, (16 - math.sqrt(6)) / 18],
        ),
        "chebyshev_lobatto": ([-1, 0, 1], [1 / 3, 4 / 3, 1 / 3]),
        "chebyshev_gauss": ([-math.sqrt(3) / 2, 0, math.sqrt(3) / 2], [4 / 9, 10 / 9, 4 / 9]),
        "uniform": ([-1, 0, 1], [1 / 2, 1, 1 / 2]),
    }
    for kind, (points, weights) in expected.items():
        nodes = make_nodes(kind, 3)
        np.testing.assert_allclose(nodes.points, points, atol=1e-15, err_msg=kind)
        np.testing.assert_allclose(nodes.weights, weights, atol=1e-15, err_msg=kind)


@pytest.mark.parametrize("n_nodes", [1, 5, 50, 200])
def test_gauss_agrees_with_numpy(n_nodes):
    points, weights = np.polynomial.legendre.leggauss(n_nodes)
    nodes = make_nodes("legendre_gauss", n_nodes)
    np.testing.assert_allclose(nodes.points, points, atol=1e-14)
    np.testing.assert_allclose(nodes.weights, weights, atol=1e-14)


def test_dtype_is_an_argument():
    nodes = make_nodes("legendre_radau", 5, dtype=torch.float32)
    assert nodes.points.dtype == nodes.weights.dtype == torch.float32
    assert make_nodes("uniform", 5).points.dtype == torch.float64


@pytest.mark.parametrize(
    ("kind", "n_nodes", "message"),
    [
        ("gauss", 5, r"kind = 'gauss'.*legendre_gauss"),
        ("chebyshev_lobatto", 1, r"n_nodes = 1 .*at least 2"),
        ("legendre_gauss", 0, r"n_nodes = 0 .*at least 1"),
    ],
)
def test_errors_name_field_value_and_what_is_allowed(kind, n_nodes, message):
    with pytest.raises(ValueError, match=message):
        make_nodes(kind, n_nodes)


@pytest.mark.parametrize("kind", SPECTRAL)
@pytest.mark.parametrize("n_nodes", [6, 40])
def test_interpolation_and_differentiation(kind, n_nodes):
    points = make_nodes(kind, n_nodes).points
    targets = torch.cat([torch.linspace(-1, 1, 77, dtype=points.dtype), points[:3]])
    # the polynomial of highest degree that is exact
    coefficients = np.cos(np.arange(n_nodes))
    polynomial = np.polynomial.Chebyshev(coefficients)
    values = torch.from_numpy(polynomial(points.numpy()))
    interpolated = interpolation_matrix(points, targets) @ values
    np.testing.assert_allclose(interpolated, polynomial(targets.numpy()), atol=1e-12)
    slopes = polynomial.deriv()(points.numpy())
    np.testing.assert_allclose(differentiation_matrix(points) @ values, slopes, atol=1e-11 * np.abs(slopes).max())


def test_interpolation_at_a_node_is_its_value():
    points = make_nodes("legendre_gauss", 7).points
    assert torch.equal(interpolation_matrix(points, points), torch.eye(7, dtype=points.dtype))


def test_barycentric_weights_of_many_points_stay_finite_and_alternate():
    weights = barycentric_weights(make_nodes("chebyshev_lobatto", 800).points)
    assert torch.isfinite(weights).all()
    assert (weights[1:] * weights[:-1] < 0).all()
    # for these nodes they are known: (-1)^j, halved at the ends
    np.testing.assert_allclose(weights.abs(), [0.5, *[1.0] * 798, 0.5], rtol=1e-11)


def test_a_point_given_twice_is_an_error():
    with pytest.raises(ValueError, match="holds a point twice"):
        barycentric_weights(torch.tensor([-1.0, 0.5, 0.5]))


@pytest.mark.parametrize("kind", ["legendre_gauss", "legendre_radau"])
def test_moments_of_orthonormal_legendre_polynomials(kind):
    nodes = make_nodes(kind, 20)
    degrees = np.arange(12)
    values = np.polynomial.legendre.legvander(nodes.points.numpy(), 11) * np.sqrt(degrees + 0.5)
    moments = legendre_moments(nodes, 12)
    assert moments.shape == (12, 20)
    np.testing.assert_allclose(moments.numpy() @ values, np.eye(12), atol=1e-14)
    with pytest.raises(ValueError, match="n_moments = 0"):
        legendre_moments(nodes, 0)


def test_panels_integrate_by_parts():
    edges = torch.tensor([-1.0, -0.2, -0.19, 1.0], dtype=torch.float64)
    nodes = make_panels("legendre_gauss", edges, [3, 5, 4])
    assert len(nodes) == 12
    assert bool((nodes.points.diff() > 0).all())
    for degree in range(6):
        exact = (1 - (-1) ** (degree + 1)) / (degree + 1)
        assert float(nodes.weights @ nodes.points**degree) == pytest.approx(exact, abs=1e-15)


def test_points_between_are_even_in_every_panel():
    plain = make_nodes("legendre_gauss", 7).between(4)
    assert plain.tolist() == pytest.approx([-0.75, -0.25, 0.25, 0.75])
    edges = torch.tensor([-1.0, 0.0, 0.01, 1.0], dtype=torch.float64)
    between = make_panels("legendre_gauss", edges, [4, 8, 4]).between(16)
    counts = [int(((between > low) & (between < high)).sum()) for low, high in pairwise(edges.tolist())]
    assert counts == [4, 8, 4]
    assert bool((between.diff() > 0).all())


@pytest.mark.parametrize(
    ("edges", "counts", "message"),
    [
        ([-1.0, 0.5], 4, "ascending from -1 to 1"),
        ([-1.0, 0.5, 0.5, 1.0], 4, "ascending from -1 to 1"),
        ([-1.0, 0.0, 1.0], [4], "counts has 1 entries for 2 panels"),
    ],
)
def test_wrong_panels_are_errors(edges, counts, message):
    with pytest.raises(ValueError, match=message):
        make_panels("legendre_gauss", torch.tensor(edges, dtype=torch.float64), counts)


def test_graded_panels_resolve_layers_and_widen_away_from_them():
    centres, widths = torch.tensor([-0.3, 0.61, 1.0]), torch.tensor([1e-6, 1e-3, 0.1])
    edges = graded_edges(centres, widths, coarsest=0.5)
    for low, high in pairwise(edges.tolist()):
        for centre, width in zip(centres.tolist(), widths.tolist(), strict=True):
            distance = max(low - centre, centre - high, 0.0)
            assert high - low <= 1.0001 * max(width, distance)
    assert edges.diff().max() <= 0.5
    assert len(edges) < 120  # by halving: about two panels for every power of two
    assert len(graded_edges(centres[:0], widths[:0])) == 5
    with pytest.raises(ValueError, match="widths"):
        graded_edges(centres, -widths)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_layers_below_the_spacing_of_numbers_end_at_it(dtype):
    edges = graded_edges(torch.tensor([0.3], dtype=dtype), torch.tensor([1e-30], dtype=dtype))
    assert bool((edges.diff() > 0).all())
    assert edges.diff().min() < 4 * torch.finfo(dtype).eps


def test_a_node_set_is_frozen():
    nodes = make_nodes("uniform", 4)
    assert isinstance(nodes, NodeSet)
    assert len(nodes) == 4
    with pytest.raises(AttributeError):
        nodes.kind = "other"
