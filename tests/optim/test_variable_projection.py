"""Variable projection: its gradient is that of the reduced problem, SciPy ends there too, a resumed run is the same."""

import pytest
import torch
from helpers import bvp_of, collocation, random, relative
from scipy.optimize import least_squares
from test_checkpoint import interrupt_at, without_times
from test_least_squares import Pointwise, start_of

from ponn_torch.ansatz.networks import MLP
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.checkpoint import CheckpointFile
from ponn_torch.optim.least_squares import GaussNewton, LevenbergMarquardt
from ponn_torch.optim.variable_projection import Projected, VariableProjection
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.problems.boundary_layer import boundary_layer
from ponn_torch.solving.guess import RandomGuess, project

TIMES = torch.linspace(0.0, 1.0, 30, dtype=torch.float64)
RATES = torch.tensor([1.0, 5.0], dtype=torch.float64)


class Decays(Pointwise):
    """a e^(−kt) + b e^(−lt) through given values; the rates (k, l) are hidden, (a, b) are linear."""

    linear_unknowns = torch.tensor([2, 3])

    def __init__(self, noise: float = 0.0) -> None:
        data = torch.exp(-TIMES[:, None] * RATES) @ torch.tensor([2.0, -1.0], dtype=torch.float64)
        data = data + noise * torch.sin(40 * TIMES)
        super().__init__(lambda xi: torch.exp(-TIMES[:, None] * xi[:2]) @ xi[2:] - data, 4)


def layers(n_nodes: int = 40):
    """A network on boundary layers; its residual is linear in all but the hidden weights."""
    made = collocation(
        pontryagin(boundary_layer(epsilon=0.1)), n_neurons=5, n_nodes=n_nodes, basis=lambda n: MLP((n, n), seed=2)
    )
    return made, random(made.n_unknowns, seed=3)


def landing():
    """The same for the smoothed landing, which is not linear in the output layer."""
    made = collocation(bvp_of("mars_landing"), n_neurons=8, n_nodes=30, basis=lambda n: MLP((n,)), smoothing=1.0)
    return made, project(made, RandomGuess().curve(made.bvp, 0))


@pytest.mark.parametrize("make", [layers, lambda: (Decays(0.1), torch.tensor([0.5, 7.0, 0.0, 0.0]).double())])
def test_what_is_eliminated_is_at_its_best_and_the_gradient_is_that_of_the_reduced_problem(make):
    residual, xi = make()
    projected = Projected(residual, xi, ridge=1e-5)
    theta = projected.start
    r, jacobian = projected.linearise(theta)
    full = projected.full(theta)
    assert torch.equal(full[projected.hidden], theta)
    rest = residual.linearise(full)[1].dense()[:, projected.eliminated]
    slope = rest.mT @ projected.plain(r) + 1e-10 * full[projected.eliminated]
    assert float(slope.norm()) < 1e-10 * float(rest.norm()) * float(r.norm())
    step = 1e-5
    for i in range(min(len(theta), 8)):
        ends = [theta.index_add(0, torch.tensor([i]), theta.new_tensor([sign * step])) for sign in (1, -1)]
        costs = [0.5 * float(Projected(residual, xi, ridge=1e-5).residual(end).square().sum()) for end in ends]
        expected = (costs[0] - costs[1]) / (2 * step)
        assert float(jacobian.gradient(r)[i]) == pytest.approx(expected, rel=1e-4, abs=1e-7 * float(r.square().sum()))


def test_the_elimination_does_not_depend_on_where_it_starts():
    residual, xi = layers()
    moved = xi.index_add(0, residual.linear_unknowns, random(len(residual.linear_unknowns), seed=9))
    one, other = (Projected(residual, start, ridge=1e-4) for start in (xi, moved))
    assert relative(other.full(other.start), one.full(one.start)) < 1e-7


def test_it_finds_rates_and_amplitudes():
    result = VariableProjection().run(Decays(), torch.tensor([0.2, 9.0, 0.0, 0.0]).double())
    torch.testing.assert_close(result.xi, torch.tensor([1.0, 5.0, 2.0, -1.0]).double(), rtol=1e-5, atol=0)
    assert float(result.norm) < 1e-6


def test_scipy_ends_at_the_same_point_of_the_reduced_problem():
    residual, start = Decays(0.1), torch.tensor([0.5, 7.0, 0.0, 0.0]).double()

    def amplitudes(rates):
        table, values = torch.exp(-TIMES[:, None] * torch.as_tensor(rates)), -residual.residual(0 * start)
        return table, torch.linalg.lstsq(table, values[:, None], driver="gelsd").solution[:, 0]

    def reduced(rates):
        table, best = amplitudes(rates)
        return (table @ best + residual.residual(0 * start)).numpy()

    oracle = least_squares(reduced, start[:2].numpy(), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    stopping = Stopping(tolerance=0.0, decrease=1e-14)
    found = VariableProjection(LevenbergMarquardt(stopping, linear_solver="qr")).run(residual, start)
    assert found.xi[:2].tolist() == pytest.approx(oracle.x.tolist(), rel=1e-5)
    assert found.xi[2:].tolist() == pytest.approx(amplitudes(oracle.x)[1].tolist(), rel=1e-5)


def test_it_gets_below_steps_on_all_weights_in_as_many_iterations():
    residual, xi = layers()
    stopping = Stopping(tolerance=0.0, decrease=0.0, max_iterations=15)
    everything = LevenbergMarquardt(stopping, linear_solver="qr")
    norms = [float(optimizer.run(residual, xi).norm) for optimizer in (VariableProjection(everything), everything)]
    assert norms[0] < 0.5 * norms[1]


def test_records_tell_of_what_is_minimised_and_callbacks_of_all_unknowns():
    residual, xi = layers()
    seen = []
    made = VariableProjection(LevenbergMarquardt(Stopping(max_iterations=4), linear_solver="qr"))
    result = made.run(residual, xi, lambda entry, point, r: seen.append((entry["norm"], point, r)))
    norm, point, r = seen[-1]
    assert len(seen) == result.n_iterations == 4
    assert torch.equal(point, result.xi)
    assert relative(r, residual.residual(point)) < 1e-9
    assert norm == pytest.approx(float(torch.cat([r, 1e-7 * point[residual.linear_unknowns]]).norm()), rel=1e-9)
    assert float(result.norm) == float(residual.residual(result.xi).norm())


@pytest.mark.parametrize("make", [layers, landing])
def test_a_resumed_run_equals_the_uninterrupted_one(make, tmp_path):
    residual, xi = make()
    made = VariableProjection(LevenbergMarquardt(Stopping(tolerance=0.0, decrease=0.0, max_iterations=9)))
    whole = made.run(residual, xi)
    made.run(residual, xi, interrupt_at(4), CheckpointFile(tmp_path / "x.npz"))
    resumed = made.run(residual, 0 * xi, None, CheckpointFile(tmp_path / "x.npz", resume=True))
    assert torch.equal(resumed.xi, whole.xi)
    assert without_times(resumed.records) == without_times(whole.records)


def test_a_linear_free_function_is_all_eliminated():
    made = collocation(pontryagin(boundary_layer(epsilon=0.1)), n_neurons=20, n_nodes=30)
    xi = random(made.n_unknowns, seed=1)
    assert torch.equal(VariableProjection().run(made, xi).xi, GaussNewton().run(made, xi).xi)


def test_errors_name_field_value_and_what_is_allowed():
    residual, start = start_of("rosenbrock")
    with pytest.raises(ValueError, match=r"ridge = 0.0; allowed: a positive number"):
        VariableProjection(ridge=0.0)
    with pytest.raises(ValueError, match=r"max_eliminations = 0; allowed: at least 1"):
        VariableProjection(max_eliminations=0)
    with pytest.raises(TypeError, match=r"Pointwise has no linear_unknowns"):
        VariableProjection().run(residual, start)
    with pytest.raises(ValueError, match=r"xi has shape \(2, 4\)"):
        VariableProjection().run(Decays(), torch.zeros(2, 4, dtype=torch.float64))
