"""A linearisation that is asked for twice in a row is formed once, and is that of the point that is asked for."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from helpers import bvp_of, collocation
from torch import Tensor

from ponn_torch.numerics.linalg import DenseJacobian, Jacobian
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.chain import OutputLayer
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.remembering import Remembering
from ponn_torch.solving.guess import RandomGuess, project


class Squares:
    """r(ξ) = ξ², with the points at which it was linearised."""

    n_unknowns = 2

    def __init__(self) -> None:
        self.asked: list[list[float]] = []

    def residual(self, xi: Tensor) -> Tensor:
        return xi.square()

    def linearise(self, xi: Tensor) -> tuple[Tensor, Jacobian]:
        self.asked.append(xi.tolist())
        return self.residual(xi), DenseJacobian(torch.diag(2 * xi))

    def blocks(self, residual: Tensor) -> Mapping[str, Tensor]:
        return {"r": residual.norm()}


def point(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_the_last_point_is_not_linearised_again():
    inner = Squares()
    remembering = Remembering(inner)
    for xi in (point(1, 2), point(1, 2), point(3, 2), point(1, 2)):
        r, jacobian = remembering.linearise(xi)
        assert torch.equal(r, xi.square())
        assert torch.equal(jacobian.dense(), torch.diag(2 * xi))
    assert inner.asked == [[1, 2], [3, 2], [1, 2]]


def test_an_optimiser_leaves_its_last_linearisation_behind():
    inner = Squares()
    remembering = Remembering(inner)
    optimizer = LevenbergMarquardt(Stopping(tolerance=1e-6), ahead=True)
    result = optimizer.run(remembering, point(1, 2))
    count = len(inner.asked)
    remembering.linearise(result.xi)
    assert len(inner.asked) == count


def test_what_an_optimiser_asks_of_a_residual_is_passed_on():
    made = collocation(bvp_of("energy_transfer"), n_neurons=12, n_nodes=20)
    xi = project(made, RandomGuess().curve(made.bvp, 0))
    remembering = Remembering(made)
    assert remembering.n_unknowns == made.n_unknowns
    assert torch.equal(remembering.linear_unknowns, made.linear_unknowns)
    assert torch.equal(remembering.residual(xi), made.residual(xi))
    r = made.residual(xi)
    assert dict(remembering.blocks(r)) == dict(made.blocks(r))
    one, other = (OutputLayer().run(residual, xi) for residual in (made, remembering))
    assert torch.equal(one.xi, other.xi)
