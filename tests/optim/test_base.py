"""What a conductor asks of an optimiser reaches it through whatever it is wrapped in."""

from __future__ import annotations

import pytest
from helpers import OPTIMIZERS

from ponn_torch.optim.base import Stopping, loosened, warm
from ponn_torch.optim.chain import Chain, OutputLayer
from ponn_torch.optim.gradient import Adam
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.variable_projection import VariableProjection
from ponn_torch.optim.weighted import WeightedEquations

WRAPPERS = {
    "nothing": (lambda inner: inner, lambda outer: outer),
    "chain": (lambda inner: Chain([Adam(), inner]), lambda outer: outer.parts[1]),
    "output_layer": (OutputLayer, lambda outer: outer.optimizer),
    "variable_projection": (VariableProjection, lambda outer: outer.optimizer),
    "weights": (lambda inner: WeightedEquations(inner, {"v": 2.0}), lambda outer: outer.optimizer),
    "weights in a chain": (
        lambda inner: Chain([WeightedEquations(inner, {}), OutputLayer()]),
        lambda outer: outer.parts[0].optimizer,
    ),
}


@pytest.mark.parametrize("name", WRAPPERS)
def test_an_optimiser_is_adjusted_inside_its_wrapper(name):
    wrap, inside = WRAPPERS[name]
    outer = wrap(LevenbergMarquardt(Stopping(tolerance=1e-9), damping=1e-3))
    assert inside(loosened(outer, 1e-4)).stopping.tolerance == 1e-4
    assert inside(loosened(outer, 1e-12)).stopping.tolerance == 1e-9
    assert inside(warm(outer, 1e-6)).damping == 1e-6
    assert inside(warm(outer, 1.0)).damping == 1e-3
    assert inside(outer).stopping.tolerance == 1e-9  # what the caller holds stays


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_every_optimiser_can_be_loosened(name):
    made = OPTIMIZERS[name](Stopping(tolerance=1e-9))
    assert "tolerance=0.001" in repr(loosened(made, 1e-3))
    assert "tolerance=1e-09" in repr(warm(made, 1e-6))


def test_one_that_cannot_be_adjusted_comes_back_as_it_is():
    class Plain:
        def run(self, residual, xi, on_iteration=None, checkpoint=None): ...

    made = Plain()
    assert loosened(made, 1e-3) is warm(made, 1e-3) is made
