"""Gradient methods on the residual's loss: oracles of torch and SciPy, line searches, steps that are not finite."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import bvp_of, collocation, random, relative
from hypothesis import given
from hypothesis import strategies as st
from test_least_squares import Pointwise, landing, start_of

from ponn_torch.optim.base import Status, Stop, Stopping
from ponn_torch.optim.chain import Chain, OutputLayer
from ponn_torch.optim.checkpoint import CheckpointFile
from ponn_torch.optim.driver import Counted
from ponn_torch.optim.gradient import SCHEDULES, Adam
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.line_search import Trial, strong_wolfe
from ponn_torch.optim.quasi_newton import LBFGS, SSBroyden, _self_scaled, _two_loops

FOREVER = Stopping(tolerance=0.0, decrease=0.0, max_iterations=60)
GRADIENT = {"adam": Adam, "lbfgs": LBFGS, "ssbroyden": SSBroyden}


@pytest.mark.parametrize(
    ("problem", "n_segments", "smoothing"),
    [("mars_landing", 1, 0.3), ("energy_transfer", 3, None), ("minimum_time", 1, 1.0)],
)
def test_the_gradient_is_that_of_the_jacobian(problem, n_segments, smoothing):
    made = collocation(bvp_of(problem), n_segments=n_segments, smoothing=smoothing)
    xi = random(made.n_unknowns, seed=1)
    r, jacobian = made.linearise(xi)
    value, gradient = Counted(made).gradient(xi)
    assert relative(value, r) < 1e-13
    assert relative(gradient, jacobian.gradient(r)) < 1e-12
    weights = random(len(r), seed=2)
    assert relative(Counted(made).gradient(xi, weights)[1], jacobian.gradient(weights**2 * r)) < 1e-12


# -- oracles ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_adam_takes_the_steps_of_torch(schedule):
    residual, start = start_of("rosenbrock")
    adam = Adam(FOREVER, rate=0.02, schedule=schedule, last=0.1)
    ours: list[torch.Tensor] = []
    state = adam.begin(Counted(residual), start)
    for _ in range(60):
        state, _ = adam.step(Counted(residual), state, torch.tensor(True))
        ours.append(state.xi)
    parameter = torch.nn.Parameter(start.clone())
    oracle = torch.optim.Adam([parameter], lr=1.0)
    for k in range(60):
        oracle.param_groups[0]["lr"] = 0.02 * SCHEDULES[schedule](k / 59, 0.1)
        oracle.zero_grad()
        (0.5 * residual.function(parameter).square().sum()).backward()
        oracle.step()
        torch.testing.assert_close(ours[k], parameter.detach(), rtol=1e-12, atol=1e-14)


def test_schedules_begin_at_one_and_end_at_their_last():
    for name, schedule in SCHEDULES.items():
        assert schedule(0.0, 0.01) == pytest.approx(1.0)
        assert schedule(1.0, 0.01) == pytest.approx(1.0 if name == "constant" else 0.01)
        shares = [schedule(k / 10, 0.01) for k in range(11)]
        assert shares == sorted(shares, reverse=True)


def quadratic(n: int = 6) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A Hessian, and pairs of steps (k, n) and changes of its gradient."""
    root = random(n, n, seed=5, low=-1.0) + 2 * torch.eye(n, dtype=torch.float64)
    hessian = root.T @ root
    steps = random(4, n, seed=6, low=-1.0)
    return hessian, steps, steps @ hessian


def test_two_loops_are_the_bfgs_updates_one_after_the_other():
    _, steps, changes = quadratic()
    n = steps.shape[1]
    inverse = torch.eye(n, dtype=torch.float64) * (steps[-1] @ changes[-1]) / changes[-1].square().sum()
    for s, y in zip(steps, changes, strict=True):
        left = torch.eye(n, dtype=torch.float64) - torch.outer(s, y) / (s @ y)
        inverse = left @ inverse @ left.T + torch.outer(s, s) / (s @ y)
    vector = random(n, seed=7)
    torch.testing.assert_close(_two_loops(vector, steps, changes), inverse @ vector, rtol=1e-12, atol=1e-13)


def test_a_self_scaled_update_meets_the_secant_equation_and_stays_positive_definite():
    _, steps, changes = quadratic()
    inverse = torch.eye(steps.shape[1], dtype=torch.float64)
    for s, y in zip(steps, changes, strict=True):
        inverse = _self_scaled(inverse, s, y, s @ torch.linalg.solve(inverse, s))
        torch.testing.assert_close(inverse @ y, s, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(inverse, inverse.T, rtol=1e-12, atol=1e-13)
        assert float(torch.linalg.eigvalsh(inverse).min()) > 0


def test_quasi_newton_methods_beat_adam_on_the_smoothed_landing():
    residual, start = landing()
    reference = float(LevenbergMarquardt(Stopping(tolerance=1e-13, decrease=1e-8)).run(residual, start).norm)
    stopping = Stopping(tolerance=1e-13, decrease=1e-7, patience=5, max_iterations=110)
    norms = {name: float(make(stopping).run(residual, start).norm) for name, make in GRADIENT.items()}
    assert norms["lbfgs"] == pytest.approx(reference, rel=1e-3)
    assert norms["ssbroyden"] == pytest.approx(reference, rel=1e-3)
    assert norms["adam"] > 10 * reference


# -- line search -----------------------------------------------------------------------------------------------------


def along(function, edge: float = math.inf):
    """Trials of a function of one number, not finite from ``edge`` on."""

    def evaluate(length: float) -> Trial:
        x = torch.tensor(float(length), dtype=torch.float64, requires_grad=True)
        value = function(x)
        (slope,) = torch.autograd.grad(value, x)
        bad, value = math.nan if length >= edge else 1.0, value.detach()
        return Trial(length, bad * float(value), bad * float(slope), x.detach(), x.detach(), slope)

    return evaluate


LINES = {
    "quadratic": lambda x: (x - 1.7) ** 2,
    "steep": lambda x: -x / (x**2 + 2),
    "kinked": lambda x: torch.cos(3 * x) + 0.1 * (x - 4) ** 2 - 2 * x / (1 + x),
    "far": lambda x: torch.exp(-x / 50) + 1e-4 * x,
}


@given(name=st.sampled_from(sorted(LINES)), exponent=st.floats(-4, 4))
def test_the_step_length_meets_the_strong_wolfe_conditions(name, exponent):
    evaluate = along(LINES[name])
    start = evaluate(0.0)
    found = strong_wolfe(evaluate, start, 10**exponent, max_trials=60)
    assert found is not None
    assert found.value <= start.value + 1e-4 * found.length * start.slope
    assert abs(found.slope) <= 0.9 * abs(start.slope)


def test_a_search_stays_where_the_function_is_finite():
    evaluate = along(lambda x: (x - 0.01) ** 2 - 0.5 * x, edge=0.1)
    found = strong_wolfe(evaluate, evaluate(0.0), 8.0)
    assert found is not None
    assert 0 < found.length < 0.1


def test_nothing_lower_is_no_step():
    up = along(lambda x: x**2 + x)
    start = up(0.0)
    lie = Trial(0.0, start.value, -1.0, start.xi, start.r, start.gradient)
    assert strong_wolfe(up, lie, 1.0) is None


# -- ends and rejections ---------------------------------------------------------------------------------------------


def test_a_line_search_that_finds_nothing_ends_the_run():
    class Uphill(Pointwise):
        def residual(self, xi):  # the value of one function, the slope of its opposite
            value = super().residual(xi)
            return 2 * value.detach() - value

    start = torch.zeros(2, dtype=torch.float64)
    for make in (LBFGS, SSBroyden):
        uphill = Uphill(lambda x: torch.stack([x[0] + 2.0, x[1] - 1.0]))
        result = make(Stopping(tolerance=0.0)).run(uphill, start)
        assert result.status is Status.LINE_SEARCH
        assert result.status.stationary
        assert torch.equal(result.xi, start)
        assert not any(record["accepted"] for record in result.records)


def test_an_adam_step_that_is_not_finite_is_taken_back_and_the_rate_halved():
    residual = Pointwise(lambda x: torch.stack([torch.sqrt(x[0]) - 0.1, x[1] - 1.0]))
    start = torch.tensor([0.5, 0.0], dtype=torch.float64)
    result = Adam(Stopping(decrease=0.0, max_iterations=400), rate=1.0, last=1e-3).run(residual, start)
    first = result.records[0]
    assert not first["accepted"]
    assert result.records[1]["damping"] == pytest.approx(2 * first["damping"], rel=1e-3)
    assert bool(torch.isfinite(result.xi).all())
    assert float(result.norm) < 0.02


def test_quasi_newton_searches_do_not_leave_the_domain():
    residual = Pointwise(lambda x: torch.stack([torch.sqrt(x[0]) - 0.1, x[1] - 1.0]))
    start = torch.tensor([4.0, 0.0], dtype=torch.float64)
    for make in (LBFGS, SSBroyden):
        result = make(Stopping(tolerance=1e-9, decrease=0.0, max_iterations=100)).run(residual, start)
        torch.testing.assert_close(result.xi, torch.tensor([0.01, 1.0], dtype=torch.float64), rtol=1e-6, atol=0)


def test_a_callback_may_end_a_run_and_its_chain():
    residual, start = start_of("rosenbrock")

    def enough(record, xi, r):
        if record["iteration"] == 5:
            raise Stop(Status.BUDGET)

    chain = Chain([Adam(Stopping(max_iterations=3)), LevenbergMarquardt()])
    for optimizer in (*(make(FOREVER) for make in GRADIENT.values()), chain):
        result = optimizer.run(residual, start, enough)
        assert (result.status, result.n_iterations) == (Status.BUDGET, 5)


def test_a_chain_counts_on_and_hands_the_best_point_over():
    residual, start = start_of("rosenbrock")
    alone = Adam(Stopping(decrease=0.0, max_iterations=30)).run(residual, start)
    chain = Chain([Adam(Stopping(decrease=0.0, max_iterations=30)), LevenbergMarquardt(Stopping(tolerance=1e-12))])
    result = chain.run(residual, start)
    then = LevenbergMarquardt(Stopping(tolerance=1e-12)).run(residual, alone.xi)
    assert torch.equal(result.xi, then.xi)
    assert result.status is Status.RESIDUAL
    assert [record["iteration"] for record in result.records] == list(range(1, 31 + then.n_iterations))
    assert result.n_residuals == alone.n_residuals + then.n_residuals
    assert result.records[-1]["residuals"] == result.n_residuals
    assert result.records[-1]["linearisations"] == alone.n_linearisations + then.records[-1]["linearisations"]


def test_a_chain_ends_where_its_tolerance_is_met():
    residual, start = start_of("rosenbrock")
    result = Chain([LevenbergMarquardt(Stopping(tolerance=1e-6)), Adam()]).run(residual, start)
    assert result.status is Status.RESIDUAL
    assert result.n_iterations < 50


class Layers(Pointwise):
    """exp(−ξ0 t) ξ1 fitted to data: ξ0 is a hidden weight, ξ1 the output layer."""

    linear_unknowns = torch.tensor([1])


def test_the_output_layer_is_solved_with_hidden_weights_held(tmp_path):
    t = torch.linspace(0, 1, 7, dtype=torch.float64)
    residual = Layers(lambda x: x[1] * torch.exp(-x[0] * t) - torch.exp(-2 * t))
    start = torch.tensor([1.5, 0.0], dtype=torch.float64)
    seen = []
    result = OutputLayer().run(residual, start, lambda record, xi, r: seen.append(xi))
    feature = torch.exp(-1.5 * t)
    best = float(feature @ torch.exp(-2 * t) / (feature @ feature))
    assert result.xi.tolist() == pytest.approx([1.5, best], rel=1e-12)
    assert torch.equal(seen[-1], result.xi)

    def stop(record, xi, r):
        raise KeyboardInterrupt

    OutputLayer().run(residual, start, stop, CheckpointFile(tmp_path / "x.npz"))
    resumed = OutputLayer().run(residual, 0 * start, None, CheckpointFile(tmp_path / "x.npz", resume=True))
    assert torch.equal(resumed.xi, result.xi)
    with pytest.raises(TypeError, match="Pointwise has no linear_unknowns"):
        OutputLayer().run(start_of("linear")[0], start)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Adam(schedule="step"), "schedule = 'step'; allowed: constant, cosine, exponential"),
        (lambda: Adam(rate=0.0), "rate = 0.0; allowed: a positive number"),
        (lambda: Adam(memory=1.0), "memory = 1.0; allowed: from 0 to below 1"),
        (lambda: LBFGS(memory=0), "memory = 0; allowed: at least 1"),
        (lambda: Chain([]), "parts = \\[\\]; allowed: at least one"),
        (lambda: SSBroyden(max_unknowns=1).run(*start_of("linear")), "max_unknowns = 1, and there are 2"),
    ],
)
def test_errors_name_field_value_and_what_is_allowed(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("make", GRADIENT.values(), ids=GRADIENT)
def test_gradient_methods_take_one_problem_at_a_time(make):
    residual, start = start_of("rosenbrock")
    with pytest.raises(ValueError, match=r"xi has shape \(2, 2\); gradient methods solve one problem"):
        make().run(residual, start.expand(2, 2))
