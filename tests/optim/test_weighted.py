"""Weights of equations: rows found, Jacobians scaled, balances that make equations pull alike, also when resumed."""

import math

import pytest
import torch
from helpers import bvp_of, collocation, random, relative
from test_checkpoint import interrupt_at
from test_least_squares import Pointwise, landing, start_of

from ponn_torch.ansatz.networks import MLP
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.chain import OutputLayer
from ponn_torch.optim.checkpoint import CheckpointFile
from ponn_torch.optim.driver import Counted
from ponn_torch.optim.gradient import Adam
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.weighted import BALANCES, Weighted, WeightedEquations, gradient_norm, ntk_trace, rows_of


def test_rows_of_equations_part_the_residual():
    made = collocation(bvp_of("minimum_time"), n_segments=2, smoothing=1.0)
    xi = random(made.n_unknowns, seed=1)
    r = made.residual(xi)
    rows = rows_of(made.blocks, r)
    assert torch.equal(torch.stack(list(rows.values())).sum(0), torch.ones(len(r), dtype=torch.long))
    for name, norm in made.blocks(r).items():
        assert float(r[rows[name]].norm()) == pytest.approx(float(norm), rel=1e-12)


@pytest.mark.parametrize("n_segments", [1, 3])
def test_a_weighted_residual_has_the_weighted_jacobian(n_segments):
    made = collocation(bvp_of("minimum_time"), n_segments=n_segments, smoothing=1.0)
    xi = random(made.n_unknowns, seed=1)
    weights = {"v": 3.0, "terminal": 0.5}
    weighted, plain = Weighted(made, weights), made.linearise(xi)[1].dense()
    r, jacobian = weighted.linearise(xi)
    rows = rows_of(made.blocks, r)
    factors = 1.0 + 2.0 * rows["v"] - 0.5 * rows["terminal"]
    assert relative(r, factors * made.residual(xi)) < 1e-13
    assert torch.equal(weighted.residual(xi), factors * made.residual(xi))
    assert relative(jacobian.dense(), factors[:, None] * plain) < 1e-13


def test_weights_do_not_move_a_solution_and_move_a_compromise():
    line = Pointwise(lambda x: torch.stack([x[0] - 1.0, x[0] - 2.0, x[1]]), 2)
    start = torch.zeros(2, dtype=torch.float64)
    heavy = LevenbergMarquardt().run(Weighted(line, {"first": 3.0}), start)
    assert float(heavy.xi[0]) == pytest.approx((9 * 1 + 2) / 10, rel=1e-6)
    residual, start = start_of("rosenbrock")
    found = LevenbergMarquardt(Stopping(tolerance=1e-12)).run(Weighted(residual, {"first": 7.0}), start)
    torch.testing.assert_close(found.xi, torch.ones(2, dtype=torch.float64), rtol=1e-9, atol=0)


def test_an_optimiser_on_weighted_equations_is_judged_by_the_plain_ones():
    line = Pointwise(lambda x: torch.stack([x[0] - 1.0, x[0] - 2.0, x[1]]), 2)
    start = torch.zeros(2, dtype=torch.float64)
    seen = []
    made = WeightedEquations(LevenbergMarquardt(), {"first": 3.0})
    found = made.run(line, start, lambda entry, xi, r: seen.append(entry["norm"]))
    assert torch.equal(found.xi, LevenbergMarquardt().run(Weighted(line, {"first": 3.0}), start).xi)
    assert float(found.norm) == float(line.residual(found.xi).norm())
    assert seen[-1] == pytest.approx(math.sqrt(9 * 0.1**2 + 0.9**2), rel=1e-6)  # at 1.1


def test_output_layers_of_weighted_equations():
    made = collocation(bvp_of("minimum_time"), basis=lambda n: MLP((n, n)), smoothing=1.0)
    xi = random(made.n_unknowns, seed=1)
    layer = OutputLayer(LevenbergMarquardt(Stopping(max_iterations=3)))
    found = WeightedEquations(layer, {"v": 3.0}).run(made, xi)
    hidden = torch.ones(made.n_unknowns, dtype=torch.bool)
    hidden[made.linear_unknowns] = False
    assert torch.equal(found.xi[hidden], xi[hidden])
    assert float(found.norm) < float(made.residual(xi).norm())


def test_balances_make_equations_alike():
    residual, start = landing()
    counted = Counted(residual)
    r = residual.residual(start)
    rows = rows_of(residual.blocks, r)
    by_gradient, by_trace = gradient_norm(counted, start, r), ntk_trace(counted, start, r)
    pulls = [float(counted.gradient(start, mask * by_gradient)[1].norm()) for mask in rows.values()]
    assert max(pulls) == pytest.approx(min(pulls), rel=1e-9)
    dense = residual.linearise(start)[1].dense()
    traces = [float((by_trace[:, None] * dense)[mask].square().sum(-1).mean()) for mask in rows.values()]
    assert max(traces) == pytest.approx(min(traces), rel=1e-9)


@pytest.mark.parametrize("balance", [name for name in BALANCES if name != "none"])
def test_balanced_adam_goes_down_and_resumes_bit_for_bit(balance, tmp_path):
    residual, start = landing()
    adam = Adam(Stopping(decrease=0.0, max_iterations=24), rate=0.05, balance=balance, balance_every=10)
    whole = adam.run(residual, start)
    assert float(whole.norm) < float(residual.residual(start).norm())
    plain = Adam(Stopping(decrease=0.0, max_iterations=24), rate=0.05).run(residual, start)
    assert not torch.equal(whole.xi, plain.xi)
    adam.run(residual, start, interrupt_at(13), CheckpointFile(tmp_path / "x.npz"))
    resumed = adam.run(residual, start, None, CheckpointFile(tmp_path / "x.npz", resume=True))
    assert torch.equal(resumed.xi, whole.xi)


def test_errors_name_field_value_and_what_is_allowed():
    residual, start = start_of("rosenbrock")
    with pytest.raises(ValueError, match=r"weights.first = 0.0; allowed: a positive number"):
        Weighted(residual, {"first": 0.0})
    with pytest.raises(ValueError, match=r"weights.last: no such equation; allowed: first, rest"):
        Weighted(residual, {"last": 1.0}).residual(start)
    with pytest.raises(ValueError, match="balance = 'equal'; allowed: none, gradient_norm, ntk_trace"):
        Adam(balance="equal")
