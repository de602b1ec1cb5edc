"""A residual restricted to some unknowns is the residual, its Jacobian some columns, the others are held."""

from __future__ import annotations

import pytest
import torch
from helpers import bvp_of, collocation, random

from ponn_torch.numerics.linalg import ArrowJacobian, DenseJacobian
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import GaussNewton, LevenbergMarquardt
from ponn_torch.optim.restricted import Restricted, output_layer
from ponn_torch.solving.guess import RandomGuess, project


def smooth(n_segments: int = 3, batch: tuple[int, ...] = ()):
    residual = collocation(bvp_of("earth_mars"), n_segments=n_segments, smoothing=1.0)
    xi = project(residual, RandomGuess().curve(residual.bvp, 0))
    return residual, xi + 1e-2 * random(*batch, len(xi), seed=1)


@pytest.mark.parametrize("batch", [(), (2,)])
def test_some_of_every_segment_stay_an_arrow(batch):
    residual, xi = smooth(batch=batch)
    own = residual.discretisation.n_own
    kept = torch.cat([k * own + torch.arange(3, own, 2) for k in range(3)])
    shared = torch.arange(residual.n_weights, residual.n_unknowns)
    index = torch.cat([kept, shared[1:]])
    restricted = Restricted(residual, index, xi)
    r, jacobian = restricted.linearise(restricted.start)
    whole_r, whole = residual.linearise(xi)
    assert isinstance(jacobian, ArrowJacobian)
    assert torch.equal(r, whole_r)
    assert torch.equal(jacobian.dense(), whole.dense()[..., index])
    assert restricted.n_unknowns == len(index)


def test_an_uneven_choice_is_dense():
    residual, xi = smooth()
    index = torch.tensor([0, 5, residual.n_unknowns - 1])
    restricted = Restricted(residual, index, xi)
    jacobian = restricted.linearise(restricted.start)[1]
    assert isinstance(jacobian, DenseJacobian)
    assert torch.equal(jacobian.dense(), residual.linearise(xi)[1].dense()[..., index])


def test_an_optimiser_moves_only_what_it_is_given():
    residual, xi = smooth(n_segments=1)
    index = torch.arange(0, residual.n_unknowns, 3)
    restricted = Restricted(residual, index, xi)
    result = LevenbergMarquardt(Stopping(tolerance=0.0, decrease=1e-12)).run(restricted, restricted.start)
    found = restricted.full(result.xi)
    held = torch.ones_like(xi, dtype=torch.bool)
    held[index] = False
    assert torch.equal(found[held], xi[held])
    assert float(residual.residual(found).norm()) == float(result.norm) < 0.9 * float(residual.residual(xi).norm())
    slopes = [jacobian.gradient(r)[index].norm() for r, jacobian in map(residual.linearise, (xi, found))]
    assert slopes[1] < 1e-2 * slopes[0]


def test_the_output_layer_of_linear_free_functions_is_everything():
    residual, xi = smooth()
    restricted = output_layer(residual, xi)
    assert torch.equal(restricted.full(restricted.start), xi)
    assert restricted.n_unknowns == residual.n_unknowns
    problem = collocation(bvp_of("energy_transfer"), n_neurons=20, n_nodes=30)
    start = project(problem, RandomGuess().curve(problem.bvp, 0))
    linear = output_layer(problem, start)
    whole = GaussNewton(Stopping(tolerance=1e-12, past_tolerance=True)).run(problem, start)
    part = GaussNewton(Stopping(tolerance=1e-12, past_tolerance=True)).run(linear, linear.start)
    assert torch.equal(whole.xi, part.xi)
    assert part.status is whole.status


@pytest.mark.parametrize("index", [[1, 0], [0, 0], [-1, 2], [0, 10**6]])
def test_positions_are_checked(index):
    residual, xi = smooth()
    with pytest.raises(ValueError, match="index = "):
        Restricted(residual, torch.tensor(index), xi)
