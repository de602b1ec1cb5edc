"""Least squares on classic problems and a collocation residual, against SciPy; every stop names its rule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from helpers import OPTIMIZERS, bvp_of, collocation, random, relative
from scipy.optimize import least_squares
from torch import Tensor
from torch.func import jacfwd, vmap

from ponn_torch.numerics.linalg import DenseJacobian
from ponn_torch.optim.base import NonFiniteResidual, Residual, Status, Stopping
from ponn_torch.optim.least_squares import SCALINGS, GaussNewton, LevenbergMarquardt
from ponn_torch.optim.scipy_least_squares import ScipyLeastSquares
from ponn_torch.solving.guess import RandomGuess, project

MATRIX = random(5, 2, seed=4)
CLASSICS: dict[str, tuple[Callable[[Tensor], Tensor], list[float]]] = {}


def classic(*start: float) -> Callable:
    def register(function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
        CLASSICS[function.__name__] = (function, list(start))
        return function

    return register


@classic(-1.2, 1.0)
def rosenbrock(x: Tensor) -> Tensor:
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


@classic(3.0, -1.0, 0.0, 1.0)
def powell_singular(x: Tensor) -> Tensor:
    a, b, c, d = x
    return torch.stack([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2])


@classic(1.0, 1.0, 0.0)
def exponential_fit(x: Tensor) -> Tensor:
    """a e^(−b t) + c through noisy points: the smallest residual is not zero."""
    t = torch.linspace(0, 3, 12, dtype=torch.float64)
    noise = 0.05 * torch.sin(37.0 * t)
    return x[0] * torch.exp(-x[1] * t) + x[2] - (2.0 * torch.exp(-1.3 * t) + 0.5 + noise)


@classic(0.5, 0.5)
def linear(x: Tensor) -> Tensor:
    return MATRIX @ (x - torch.tensor([3.0, -2.0], dtype=torch.float64))


@dataclass
class Pointwise:
    """A residual of one problem, batched by vmap; ``before`` may raise or change what is returned."""

    function: Callable[[Tensor], Tensor]
    n_unknowns: int = 2
    before: Callable[[int, Tensor], None] = field(default=lambda count, xi: None)
    count: int = 0

    def residual(self, xi: Tensor) -> Tensor:
        self.count += 1
        self.before(self.count, xi)
        flat = vmap(self.function)(xi.reshape(-1, xi.shape[-1]))
        return flat.reshape(*xi.shape[:-1], -1)

    def linearise(self, xi: Tensor) -> tuple[Tensor, DenseJacobian]:
        flat = xi.reshape(-1, xi.shape[-1])
        matrix = vmap(jacfwd(self.function))(flat)
        value = vmap(self.function)(flat)
        batch = xi.shape[:-1]
        return value.reshape(*batch, -1), DenseJacobian(matrix.reshape(*batch, *matrix.shape[1:]))

    def blocks(self, residual: Tensor) -> Mapping[str, Tensor]:
        return {"first": residual[..., 0].abs(), "rest": residual[..., 1:].norm(dim=-1)}


def start_of(name: str) -> tuple[Pointwise, Tensor]:
    function, start = CLASSICS[name]
    return Pointwise(function, len(start)), torch.tensor(start, dtype=torch.float64)


def landing() -> tuple[Residual, Tensor]:
    made = collocation(bvp_of("mars_landing"), n_neurons=10, n_nodes=16, smoothing=1.0)
    return made, project(made, RandomGuess(n_neurons=10).curve(made.bvp, 0))


# -- oracles -------------------------------------------------------------------------------------------------

EXACT = Stopping(tolerance=1e-14, decrease=1e-14, max_iterations=300)


# an undamped step raises the norm of two of them, and Gauss–Newton ends there
PAIRS = [
    (optimizer, name)
    for optimizer in OPTIMIZERS
    for name in CLASSICS
    if optimizer != "gauss_newton" or name in ("powell_singular", "linear")
]


@pytest.mark.parametrize(("optimizer", "name"), PAIRS)
def test_classic_problems_end_where_scipy_ends(optimizer, name):
    residual, start = start_of(name)
    oracle = least_squares(
        lambda x: residual.function(torch.as_tensor(x)).numpy(),
        start.numpy(),
        jac=lambda x: jacfwd(residual.function)(torch.as_tensor(x)).numpy(),
        method="lm",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    result = OPTIMIZERS[optimizer](EXACT).run(residual, start)
    assert result.status.stationary or name == "powell_singular"
    # the Jacobian is singular at Powell's solution, so steps shrink by half only
    tolerance = 1e-3 if name == "powell_singular" else 1e-7
    torch.testing.assert_close(result.xi, torch.as_tensor(oracle.x), rtol=tolerance, atol=tolerance)
    assert float(result.norm) == pytest.approx((2 * oracle.cost) ** 0.5, abs=1e-7)
    assert float(result.norm) == pytest.approx(float(residual.function(result.xi).norm()), rel=1e-12)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_every_optimiser_solves_the_smoothed_landing(optimizer):
    residual, start = landing()
    if optimizer == "gauss_newton":  # it has no damping: let it polish
        start = LevenbergMarquardt(Stopping(tolerance=1e-3)).run(residual, start).xi
    result = OPTIMIZERS[optimizer](Stopping(tolerance=1e-13, decrease=1e-8)).run(residual, start)
    # more rows than unknowns: the smallest norm is that of the truncation, the same for everybody
    reference = least_squares(
        lambda x: residual.residual(torch.as_tensor(x)).numpy(),
        result.xi.numpy(),
        jac=lambda x: residual.linearise(torch.as_tensor(x))[1].dense().numpy(),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        method="lm",
    )
    assert float(result.norm) < 1e-2
    assert float(result.norm) == pytest.approx((2 * reference.cost) ** 0.5, rel=1e-5)


@pytest.mark.parametrize("scaling", SCALINGS)
def test_scalings_agree_on_the_solution(scaling):
    residual, start = start_of("exponential_fit")
    result = LevenbergMarquardt(EXACT, scaling=scaling).run(residual, start)
    reference = LevenbergMarquardt(EXACT).run(residual, start)
    torch.testing.assert_close(result.xi, reference.xi, rtol=1e-6, atol=1e-6)


def norms(residual: Residual, start: Tensor, **options) -> list[float]:
    stopping = Stopping(tolerance=1e-12, max_iterations=8)
    result = LevenbergMarquardt(stopping, linear_solver="qr", **options).run(residual, start)
    return [float(record["norm"]) for record in result.records]


@pytest.mark.parametrize("scaling", ["marquardt", "more"])
def test_scaled_damping_does_not_see_the_units_of_the_unknowns(scaling):
    function, start = CLASSICS["rosenbrock"]
    units = torch.tensor([1e3, 1e-2], dtype=torch.float64)
    first = torch.tensor(start, dtype=torch.float64)
    plain = norms(Pointwise(function), first, scaling=scaling)
    scaled = norms(Pointwise(lambda x: function(units * x)), first / units, scaling=scaling)
    assert scaled == pytest.approx(plain, rel=1e-9)


def test_identity_damping_sees_the_units_of_the_unknowns():
    function, start = CLASSICS["rosenbrock"]
    units = torch.tensor([1e3, 1e-2], dtype=torch.float64)
    first = torch.tensor(start, dtype=torch.float64)
    plain = norms(Pointwise(function), first, scaling="identity")
    scaled = norms(Pointwise(lambda x: function(units * x)), first / units, scaling="identity")
    assert scaled != pytest.approx(plain, rel=1e-3)


def test_gauss_newton_solves_a_linear_problem_in_one_step():
    residual, start = start_of("linear")
    result = GaussNewton(Stopping(tolerance=1e-13)).run(residual, start)
    assert result.status is Status.RESIDUAL
    assert result.n_iterations == 1
    torch.testing.assert_close(result.xi, torch.tensor([3.0, -2.0], dtype=torch.float64), rtol=1e-13, atol=0)


# -- every rule to stop --------------------------------------------------------------------------------------


def test_tolerance():
    residual, start = start_of("rosenbrock")
    result = LevenbergMarquardt(Stopping(tolerance=1e-3)).run(residual, start)
    assert result.status is Status.RESIDUAL
    assert float(result.norm) < 1e-3
    assert float(result.records[-2]["norm"]) >= 1e-3


def test_a_start_below_the_tolerance_takes_no_step():
    residual, _ = start_of("rosenbrock")
    solution = torch.ones(2, dtype=torch.float64)
    result = LevenbergMarquardt().run(residual, solution)
    assert result.status is Status.RESIDUAL
    assert result.records == []
    assert torch.equal(result.xi, solution)


@pytest.mark.parametrize("patience", [1, 4])
def test_small_decrease_waits_for_its_patience(patience):
    residual, start = start_of("exponential_fit")
    stopping = Stopping(tolerance=0.0, decrease=1e-6, patience=patience)
    result = LevenbergMarquardt(stopping).run(residual, start)
    assert result.status is Status.SMALL_DECREASE
    before = float(result.records[-patience - 1]["norm"])
    assert (before / float(result.norm)) ** 2 - 1 < 1e-6 * patience
    longer = LevenbergMarquardt(Stopping(tolerance=0.0, decrease=1e-6, patience=patience + 1)).run(residual, start)
    assert longer.n_iterations > result.n_iterations


def test_small_step():
    residual, start = start_of("exponential_fit")
    result = LevenbergMarquardt(Stopping(tolerance=0.0, decrease=0.0, step=1e-4)).run(residual, start)
    assert result.status is Status.SMALL_STEP
    assert float(result.records[-1]["step"]) < 1e-4
    assert all(float(r["step"]) >= 1e-4 for r in result.records[:-1] if r["accepted"])


@pytest.mark.parametrize("name", ["rosenbrock", "exponential_fit"])
def test_a_jacobian_formed_ahead_changes_no_step(name):
    """Only the number of linearisations: one a trial, which is a residual as well."""
    residual, start = start_of(name)
    plain, ahead = (LevenbergMarquardt(Stopping(tolerance=1e-10), ahead=a).run(residual, start) for a in (False, True))
    assert [r["norm"] for r in ahead.records] == [r["norm"] for r in plain.records]
    assert torch.equal(ahead.xi, plain.xi)
    assert all(r["accepted"] for r in plain.records) is (name == "exponential_fit")  # with rejected steps and without
    assert ahead.n_linearisations == ahead.n_iterations + 1
    assert ahead.n_residuals == plain.n_residuals
    together = torch.stack([start, 1.01 * start])
    batches = [LevenbergMarquardt(Stopping(tolerance=1e-10), ahead=a).run(residual, together) for a in (False, True)]
    assert torch.equal(batches[0].xi, batches[1].xi)


@pytest.mark.parametrize("ahead", [False, True])
def test_a_jacobian_is_used_again_where_steps_contract(ahead):
    """The same solution, with fewer Jacobians; every step still falls."""
    residual, start = Pointwise(lambda x: x + 0.4 * torch.sin(MATRIX[:2] @ x) - 1.0), torch.ones(2, dtype=torch.float64)
    newton, simplified = (
        LevenbergMarquardt(Stopping(tolerance=1e-12), damping=1e-10, ahead=ahead, reuse=reuse).run(residual, start)
        for reuse in (0.0, 0.2)
    )
    assert newton.status is simplified.status is Status.RESIDUAL
    assert (simplified.xi - newton.xi).abs().max() < 1e-11
    assert simplified.n_linearisations < newton.n_linearisations
    norms = [record["norm"] for record in simplified.records]
    assert norms == sorted(norms, reverse=True)


@pytest.mark.parametrize("start", [[0.3], [1.2], [0.1, -1.3, 0.7]])
def test_an_old_jacobian_that_does_not_help_is_formed_anew(start):
    """Where Newton's step nearly overshoots the next one with the same slope would go back and forth."""
    xi = torch.tensor(start, dtype=torch.float64)[:, None]
    result = LevenbergMarquardt(Stopping(tolerance=1e-12), damping=1e-12, reuse=0.9).run(_ArcTangent(), xi)
    assert result.status is Status.RESIDUAL
    assert bool((result.xi.abs() < 1e-12).all())


def test_a_poor_step_with_an_old_jacobian_counts_for_nothing():
    """It is taken back for one with a new Jacobian: neither a slow step nor a rejected one, in no member of a batch."""
    xi = torch.tensor([[0.1], [-1.3], [0.7]], dtype=torch.float64)
    stopping = Stopping(tolerance=1e-12, decrease=0.1, patience=1)
    result = LevenbergMarquardt(stopping, damping=1e-12, reuse=0.9).run(_ArcTangent(), xi)
    assert result.status is Status.RESIDUAL
    norms = [record["norm"] for record in result.records]
    assert norms == sorted(norms, reverse=True)
    assert all(record["damping"] <= 1e-12 for record in result.records)


def test_iteration_limit():
    residual, start = start_of("rosenbrock")
    result = LevenbergMarquardt(Stopping(max_iterations=3)).run(residual, start)
    assert result.status is Status.MAX_ITERATIONS
    assert not result.status.stationary
    assert result.n_iterations == 3


def test_hopeless_looks_after_its_iteration_only():
    residual, start = start_of("exponential_fit")  # its smallest norm is about 0.1
    stopping = Stopping(tolerance=0.0, decrease=0.0, hopeless=1e-3, hopeless_after=4)
    result = LevenbergMarquardt(stopping).run(residual, start)
    assert result.status is Status.HOPELESS
    assert not result.status.stationary
    assert result.n_iterations == 4
    hopeful = LevenbergMarquardt(Stopping(hopeless=1.0, hopeless_after=4)).run(residual, start)
    assert hopeful.status is not Status.HOPELESS


def test_no_step_helps_up_to_the_largest_damping():
    # the Jacobian points uphill, so that every trial is worse
    residual = Pointwise(lambda x: torch.stack([x[0] + 2.0, x[1] - 1.0]))
    forward = residual.linearise
    residual.linearise = lambda xi: (forward(xi)[0], DenseJacobian(-forward(xi)[1].matrix))
    start = torch.zeros(2, dtype=torch.float64)
    stopping = Stopping(decrease=0.0)
    result = LevenbergMarquardt(stopping, largest_damping=1e6).run(residual, start)
    assert result.status is Status.DAMPING
    assert torch.equal(result.xi, start)
    assert not any(record["accepted"] for record in result.records)


def test_past_the_tolerance_it_goes_on_until_the_norm_rises():
    residual, start = start_of("rosenbrock")
    met = LevenbergMarquardt(Stopping(tolerance=1e-2)).run(residual, start)
    past = LevenbergMarquardt(Stopping(tolerance=1e-2, past_tolerance=True, decrease=0.0)).run(residual, start)
    # the last trial did not improve on the norm that is reported
    assert met.status is Status.RESIDUAL
    assert past.status is Status.ROUND_OFF
    assert float(past.norm) < 1e-12 < float(met.norm)
    assert not past.records[-1]["accepted"]


def test_cpu_limit():
    residual, start = landing()
    stopping = Stopping(tolerance=0.0, decrease=0.0, cpu_seconds=1e-9)
    result = LevenbergMarquardt(stopping).run(residual, start)
    assert result.status is Status.TIME_LIMIT
    assert result.n_iterations == 1
    assert ScipyLeastSquares("trf", stopping).run(residual, start).status is Status.TIME_LIMIT


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_start_that_is_not_finite_names_its_equations(optimizer):
    residual = Pointwise(lambda x: torch.stack([x[0] - 1, torch.log(x[1])]))
    start = torch.tensor([0.0, -1.0], dtype=torch.float64)
    with pytest.raises(NonFiniteResidual, match=r"equations of: rest;"):
        OPTIMIZERS[optimizer](Stopping()).run(residual, start)


@pytest.mark.parametrize("linear_solver", ["cholesky", "qr"])
def test_a_member_whose_start_is_not_finite_fails_alone(linear_solver):
    residual = Pointwise(lambda x: torch.stack([10 * (x[1] - x[0] ** 2), torch.sqrt(1.5 - x[0]) - 0.5**0.5]))
    starts = torch.tensor([[-1.2, 1.0], [2.0, 1.0], [0.3, -1.0]], dtype=torch.float64)
    optimizer = LevenbergMarquardt(EXACT, linear_solver=linear_solver)
    result = optimizer.run(residual, starts)
    alone = [optimizer.run(residual, start) for start in starts[[0, 2]]]
    assert [status is Status.NON_FINITE for status in result.member_status] == [False, True, False]
    assert torch.equal(result.xi[1], starts[1])
    assert bool(result.norm[1].isnan())
    for member, reference in zip((0, 2), alone, strict=True):
        torch.testing.assert_close(result.xi[member], reference.xi, rtol=1e-12, atol=1e-12)
        assert result.member_status[member].stationary
    assert all(np.isfinite(record["norm"]) for record in result.records)


def test_a_collocation_residual_names_equations_by_state():
    residual, start = landing()
    bad = start.clone()
    bad[residual.discretisation.expressions.tables[-1].own.start] = torch.nan
    with pytest.raises(NonFiniteResidual, match="not finite at the starting point") as caught:
        LevenbergMarquardt().run(residual, bad)
    named = str(caught.value).split("equations of: ")[1].split(";")[0].split(", ")
    assert set(named) <= {*residual.blocks(residual.residual(start))}


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_ctrl_c_keeps_the_best_point(optimizer):
    def stop(count: int, xi: Tensor) -> None:
        if count == 6:
            raise KeyboardInterrupt

    residual, start = start_of("rosenbrock" if optimizer != "gauss_newton" else "powell_singular")
    residual.before = stop
    seen: list[tuple[float, Tensor]] = []
    result = OPTIMIZERS[optimizer](Stopping(tolerance=0.0, decrease=0.0)).run(
        residual, start, lambda record, xi, r: seen.append((float(record["norm"]), xi))
    )
    assert result.status is Status.INTERRUPTED
    best, point = min(seen, key=lambda pair: pair[0])
    assert float(result.norm) == best
    assert torch.equal(result.xi, point)
    assert best < float(residual.function(start).norm())
    assert float(residual.function(result.xi).norm()) == pytest.approx(best, rel=1e-13)


# -- steps ---------------------------------------------------------------------------------------------------


def test_a_step_that_is_not_finite_is_a_rejected_step():
    # √ is NaN left of zero, where the first, undamped step leads
    residual = Pointwise(lambda x: torch.stack([torch.sqrt(x[0]) - 0.1, x[1] - 1.0]))
    start = torch.tensor([4.0, 0.0], dtype=torch.float64)
    result = LevenbergMarquardt(damping=1e-6).run(residual, start)
    assert not result.records[0]["accepted"]
    assert result.records[1]["damping"] > result.records[0]["damping"] > 1e-6
    torch.testing.assert_close(result.xi, torch.tensor([0.01, 1.0], dtype=torch.float64), rtol=1e-8, atol=0)


def test_segments_that_turn_around_are_a_rejected_step():
    made = collocation(bvp_of("minimum_time"), n_segments=1, smoothing=1.0)
    xi = random(made.n_unknowns, seed=1)
    unknowns = made.unpack(xi)
    assert torch.isfinite(made.residual(made.pack(unknowns))).all()
    unknowns.times[-1] = -1.0
    assert torch.isnan(made.residual(made.pack(unknowns))).all()


@pytest.mark.parametrize("optimizer", ["levenberg_marquardt", "levenberg_marquardt_qr"])
def test_members_of_a_batch_go_the_way_they_go_alone(optimizer):
    residual, start = start_of("rosenbrock")
    starts = start + random(4, 2, seed=2, low=-1.0)
    starts[3] = 1.0  # there already
    run = OPTIMIZERS[optimizer](Stopping(tolerance=1e-10, max_iterations=15)).run
    together = run(residual, starts)
    alone = [run(residual, member) for member in starts]
    for i, single in enumerate(alone):
        torch.testing.assert_close(together.xi[i], single.xi, rtol=1e-12, atol=1e-12)
        assert together.member_status[i] is single.status
    assert len({single.n_iterations for single in alone}) > 1
    assert together.n_iterations == max(single.n_iterations for single in alone)


def test_landings_of_a_batch_go_the_way_they_go_alone():
    residual, _ = landing()
    guess = RandomGuess(n_neurons=10)
    starts = torch.stack([project(residual, guess.curve(residual.bvp, seed)) for seed in range(3)])
    run = LevenbergMarquardt(Stopping(tolerance=1e-9, decrease=1e-3)).run
    together = run(residual, starts)
    for i in range(3):
        single = run(residual, starts[i])
        assert relative(together.xi[i], single.xi) < 1e-7
        assert together.member_status[i] is single.status


def test_the_status_of_a_batch_is_its_least_favourable():
    residual, start = start_of("rosenbrock")
    starts = torch.stack([torch.ones(2, dtype=torch.float64), start])
    result = LevenbergMarquardt(Stopping(max_iterations=2)).run(residual, starts)
    assert result.member_status == (Status.RESIDUAL, Status.MAX_ITERATIONS)
    assert result.status is Status.MAX_ITERATIONS


@pytest.mark.parametrize("update", [2.0, 10.0])
def test_the_classical_rule_moves_the_damping_by_its_factor(update):
    residual, start = start_of("rosenbrock")
    result = LevenbergMarquardt(Stopping(max_iterations=12), update=update, damping=1e-2).run(residual, start)
    previous = 1e-2
    for record in result.records:
        factor = 1 / update if record["accepted"] else update
        assert record["damping"] == pytest.approx(previous * factor)
        previous = record["damping"]
    assert {record["accepted"] for record in result.records} == {True, False}


# -- what is left behind -------------------------------------------------------------------------------------

KEYS = {
    "iteration",
    "norm",
    "damping",
    "step",
    "accepted",
    "running",
    "residuals",
    "linearisations",
    "seconds",
}


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_record_per_iteration_with_the_same_entries(optimizer):
    residual, start = start_of("powell_singular")
    calls: list[tuple[int, int]] = []

    def on_iteration(record, xi, r):
        calls.append((record["iteration"], len(r)))
        if record["accepted"]:
            assert float(residual.function(xi).norm()) == pytest.approx(record["norm"], rel=1e-12)

    result = OPTIMIZERS[optimizer](Stopping(tolerance=1e-8, max_iterations=40)).run(residual, start, on_iteration)
    assert calls == [(i + 1, 4) for i in range(len(result.records))]
    assert len(calls) > 3
    for record in result.records:
        assert set(record) == KEYS
        assert all(type(value) in (int, float, bool) for value in record.values())
    run = [record["norm"] for record in result.records]
    assert run == sorted(run, reverse=True)
    assert result.n_residuals >= result.n_linearisations > 0
    assert result.cpu_seconds >= result.records[-1]["seconds"] >= 0


def test_a_trial_costs_one_residual_and_only_accepted_points_are_linearised():
    residual, start = start_of("rosenbrock")
    result = LevenbergMarquardt(Stopping(tolerance=1e-10)).run(residual, start)
    accepted = sum(bool(record["accepted"]) for record in result.records)
    assert result.n_residuals == result.n_iterations == residual.count
    assert result.n_linearisations == accepted  # the start and every accepted point but the last
    assert accepted < result.n_iterations


def test_scipy_stops_at_the_tolerance_and_at_the_limit():
    residual, start = start_of("rosenbrock")
    for method in ("trf", "lm", "dogbox"):
        met = ScipyLeastSquares(method, Stopping(tolerance=1e-6)).run(residual, start)
        assert met.status is Status.RESIDUAL
        assert float(met.norm) < 1e-6
        limited = ScipyLeastSquares(method, Stopping(max_iterations=4)).run(residual, start)
        assert limited.status is Status.MAX_ITERATIONS
        assert limited.n_residuals <= 5


@pytest.mark.parametrize("method", ["trf", "lm", "dogbox"])
def test_scipy_obeys_the_rules_of_stopping(method):
    def run(name: str, **rules: float) -> tuple[Status, list[float]]:
        residual, start = start_of(name)
        given = {"tolerance": 0.0, "decrease": 0.0, "max_iterations": 500} | rules
        seen: list[float] = []
        stopping = Stopping(**given)
        result = ScipyLeastSquares(method, stopping).run(residual, start, lambda _, xi, r: seen.append(float(r.norm())))
        return result.status, seen

    status, seen = run("rosenbrock", hopeless=1e-3, hopeless_after=5)
    assert status is Status.HOPELESS
    assert len(seen) == 5
    # the smallest norm is not zero: the last decreases are small, one after the other
    few, many = (run("exponential_fit", decrease=1e-2, patience=patience) for patience in (1, 3))
    assert few[0] is many[0] is Status.SMALL_DECREASE
    assert len(many[1]) >= len(few[1]) + 2
    status, seen = run("powell_singular", tolerance=1e-3, past_tolerance=True)
    assert len(seen) > len(run("powell_singular", tolerance=1e-3)[1])
    if status is Status.ROUND_OFF:
        assert seen[-1] == min(seen)  # what is told is the best point


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_callback_is_told_r_at_the_best_point(optimizer):
    residual, start = start_of("rosenbrock")
    told = []
    OPTIMIZERS[optimizer](Stopping(max_iterations=15)).run(residual, start, lambda *seen: told.append(seen))
    for record, xi, r in told:
        assert torch.equal(r, residual.residual(xi))
        assert float(r.norm()) == pytest.approx(record["norm"], rel=1e-14)


def test_scipy_takes_one_problem_at_a_time():
    residual, start = start_of("rosenbrock")
    with pytest.raises(ValueError, match=r"xi has shape \(2, 2\); scipy solves one problem"):
        ScipyLeastSquares().run(residual, start.expand(2, 2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: LevenbergMarquardt(scaling="units"),
            "scaling = 'units'; allowed: marquardt, more, identity",
        ),
        (lambda: LevenbergMarquardt(linear_solver="lu"), "linear_solver = 'lu'; allowed: cholesky, qr"),
        (lambda: LevenbergMarquardt(update=1.0), "update = 1.0; allowed: 'nielsen' or a factor above 1"),
        (lambda: LevenbergMarquardt(update="fast"), "update = 'fast'; allowed"),
        (lambda: LevenbergMarquardt(damping=-1.0), "damping = -1.0; allowed: a number ≥ 0"),
        (lambda: LevenbergMarquardt(damping=float("nan")), "damping = nan"),
        (lambda: LevenbergMarquardt(reuse=1.0), "reuse = 1.0; allowed: from 0 to below 1"),
        (lambda: GaussNewton(linear_solver="svd"), "linear_solver = 'svd'"),
        (lambda: ScipyLeastSquares("bfgs"), "method = 'bfgs'; allowed: trf, lm, dogbox"),
    ],
)
def test_errors_name_field_value_and_what_is_allowed(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_records_survive_single_precision():
    _, start = start_of("linear")
    single = Pointwise(lambda x: MATRIX.float() @ (x - torch.tensor([3.0, -2.0])))
    result = LevenbergMarquardt(Stopping(tolerance=1e-5)).run(single, start.float())
    assert result.xi.dtype is torch.float32
    assert result.status is Status.RESIDUAL
    assert np.allclose(result.xi.numpy(), [3.0, -2.0], atol=1e-4)


class _ArcTangent:
    """r = atan ξ: the full Gauss–Newton step overshoots from |ξ| > 1.39."""

    n_unknowns = 1

    def residual(self, xi):
        return torch.atan(xi)

    def linearise(self, xi):
        return self.residual(xi), DenseJacobian((1 / (1 + xi**2)).unsqueeze(-1))

    def blocks(self, residual):
        return {"only": residual.norm(dim=-1)}


def test_gauss_newton_ends_at_the_first_step_that_raises_the_norm():
    result = GaussNewton().run(_ArcTangent(), torch.tensor([3.0], dtype=torch.float64))
    assert (result.status, result.n_iterations) == (Status.DAMPING, 1)


def test_past_tolerance_holds_for_a_start_below_the_tolerance_too():
    start = torch.tensor([1e-4], dtype=torch.float64)
    stopping = Stopping(tolerance=1e-3, past_tolerance=True)
    assert float(LevenbergMarquardt(stopping).run(_ArcTangent(), start).norm) < 1e-8
    assert LevenbergMarquardt(Stopping(tolerance=1e-3)).run(_ArcTangent(), start).n_iterations == 0


# -- geodesic acceleration -------------------------------------------------------------------------------------------


def test_an_accelerated_step_has_half_the_second_derivative_along_it():
    function = CLASSICS["exponential_fit"][0]
    start, damping = torch.tensor([1.8, 1.2, 0.4], dtype=torch.float64), 1e-2
    stopping = Stopping(tolerance=0.0, max_iterations=1)
    result = LevenbergMarquardt(stopping, damping, geodesic=True).run(Pointwise(function), start)
    r, matrix = function(start), jacfwd(function)(start)
    normal = matrix.T @ matrix
    damped = normal + damping * torch.diag(normal.diagonal())
    step = -torch.linalg.solve(damped, matrix.T @ r)
    second = jacfwd(jacfwd(lambda s: function(start + s * step)))(torch.tensor(0.0, dtype=torch.float64))
    acceleration = -torch.linalg.solve(damped, matrix.T @ second)
    assert 0.01 < float(acceleration.norm() / step.norm()) < 0.5
    # the second derivative is read off at a tenth of the step
    assert relative(result.xi - start, step + 0.5 * acceleration) < 0.05 * float(acceleration.norm() / step.norm())
