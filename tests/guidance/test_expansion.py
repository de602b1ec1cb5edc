"""Derivatives against hand-written ones; passes: quasi-linearisation, Newton's method, warm starts, traces."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers import relative
from horizons import random
from torch import Tensor

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.guidance.expansion import derivatives, expand
from ponn_torch.guidance.horizon import HorizonSolver
from ponn_torch.guidance.oracles import exponential_gain, minimising_control, nonlinear_control
from ponn_torch.guidance.plants.clohessy_wiltshire import clohessy_wiltshire
from ponn_torch.guidance.plants.quadrotor import quadrotor
from ponn_torch.guidance.plants.shuttle import shuttle
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.numerics.nodes import make_nodes

PROBLEMS: dict[str, Callable[[], TrackingProblem]] = {
    "clohessy_wiltshire": clohessy_wiltshire,
    "quadrotor": quadrotor,
    "shuttle": shuttle,
}


def solver(n_nodes: int = 10, kind: str = "legendre_lobatto") -> HorizonSolver:
    return HorizonSolver(Chebyshev(n_nodes, 1), make_nodes(kind, n_nodes))


def quadrotor_by_hand(x: Tensor, u: Tensor, costates: Tensor) -> tuple[Tensor, Tensor]:
    """∂f/∂(x, u) and the Hessian of λᵀf."""
    sine, cosine, thrust = x[..., 2].sin(), x[..., 2].cos(), u[..., 0]
    jacobian, hessian = x.new_zeros(*x.shape[:-1], 6, 8), x.new_zeros(*x.shape[:-1], 8, 8)
    jacobian[..., [0, 1, 2], [3, 4, 5]] = 1.0
    jacobian[..., 3, 2], jacobian[..., 4, 2] = thrust * cosine, -thrust * sine
    jacobian[..., 3, 6], jacobian[..., 4, 6], jacobian[..., 5, 7] = sine, cosine, 1.0
    lx, lz = costates[..., 3], costates[..., 4]
    hessian[..., 2, 2] = -thrust * (lx * sine + lz * cosine)
    hessian[..., 2, 6] = hessian[..., 6, 2] = lx * cosine - lz * sine
    return jacobian, hessian


def shuttle_by_hand(x: Tensor, u: Tensor) -> Tensor:
    """∂f/∂(x, u) in units of the Earth's radius and √(μ/R); constants typed in again."""
    r, v, path, bank, attack = (*x.unbind(-1), *u.unbind(-1))
    beta = 6371004.0 / 7254.2
    q = 1.225 * 249.9092 / (2 * 92709.0) * 6371004.0 * torch.exp(-(r - 1) * beta) * v**2
    lift, drag = -0.2070 + 1.6756 * attack, 0.0785 - 0.3529 * attack + 2.04 * attack**2
    sine, cosine, g, c = path.sin(), path.cos(), 1 / r**2, bank.cos()
    zero = torch.zeros_like(r)
    rows = [
        [zero, sine, v * cosine, zero, zero],
        [beta * q * drag + 2 * g * sine / r, -2 * q * drag / v, -g * cosine, zero, -q * (-0.3529 + 4.08 * attack)],
        [
            -beta * q * lift * c / v + 2 * g * cosine / (v * r) - v * cosine / r**2,
            q * lift * c / v**2 + g * cosine / v**2 + cosine / r,
            g * sine / v - v * sine / r,
            -q * lift * bank.sin() / v,
            q * 1.6756 * c / v,
        ],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def test_derivatives_are_those_by_hand() -> None:
    t = torch.zeros(2, 5, dtype=torch.float64)
    x, u, costates = (random(2, 5, k, seed=k) for k in (6, 2, 7))
    found = derivatives(quadrotor().plant.dynamics, t, x, u, costates[..., :6])
    jacobian, hessian = quadrotor_by_hand(x, u, costates[..., :6])
    assert found[2] is not None
    assert relative(found[1], jacobian) < 1e-15
    assert relative(found[2], hessian) < 1e-15
    problem = shuttle()
    x, u = problem.reference(torch.linspace(0.0, 2.0, 7, dtype=torch.float64))
    found = derivatives(problem.plant.dynamics, x[..., 0], x, u)
    assert found[2] is None
    assert relative(found[1], shuttle_by_hand(x, u)) < 1e-14


@pytest.mark.parametrize("name", PROBLEMS)
def test_expansion_is_the_first_order_of_the_state_costate_system(name: str) -> None:
    problem = PROBLEMS[name]()
    t = torch.tensor([0.3, 0.7], dtype=torch.float64)
    x, u = problem.reference(t)
    costates = 0.1 * random(*x.shape, seed=1)
    u = minimising_control(problem, t, x, costates)  # or the expansion has a term of order zero
    made = expand(problem, t, x, u, costates)

    def rates(y: Tensor) -> Tensor:
        x, costates = y.chunk(2, -1)
        u = minimising_control(problem, t, x, costates)
        states, _ = problem.reference(t)
        f, jacobian, _ = derivatives(problem.plant.dynamics, t, x, u)
        pull = (jacobian[..., : x.shape[-1]].mT @ costates.unsqueeze(-1)).squeeze(-1)
        return torch.cat([f, -(x - states) @ problem.state_weight - pull], -1)

    y, step = torch.cat([x, costates], -1), 1e-6
    at = (made.matrix @ y.unsqueeze(-1)).squeeze(-1) + made.drift
    assert relative(at, rates(y)) < 1e-9
    for column in range(y.shape[-1]):
        move = torch.zeros_like(y)
        move[..., column] = step
        slope = (rates(y + move) - rates(y - move)) / (2 * step)
        assert relative(made.matrix[..., column], slope) < 1e-7


def test_clohessy_wiltshire_gain_is_that_of_the_matrix_exponential() -> None:
    for horizon in (70.0, 150.0, 300.0):
        problem = clohessy_wiltshire(horizon=horizon)
        plan = Planner(problem, solver(), Passes(1)).plan(0.0, problem.initial)
        start = torch.zeros(1, dtype=torch.float64)
        made = expand(problem, start, *problem.reference(start))
        assert problem.terminal_weight is not None
        end = (problem.terminal_weight, torch.zeros(6, dtype=torch.float64))
        gain, _ = exponential_gain(made.matrix[0], made.drift[0], problem.horizon, *end)
        expected = made.control_gain[0, :, 6:] @ gain @ problem.initial
        assert relative(plan.control, expected) < 1e-11


# -- passes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("displacement", "first", "tenth"), [
    (-10.0, (18.07153, 16.68872), (18.37720, 16.42311)),
    (10.0, (17.08160, -7.13546), (17.62162, -7.08850)),
])  # fmt: skip
def test_quadrotor_controls_after_one_and_ten_passes(
    displacement: float, first: tuple[float, float], tenth: tuple[float, float]
) -> None:
    problem = quadrotor(displacement=(displacement, 0, 0, 0, 0, 0))
    for most, expected in ((1, first), (10, tenth)):
        plan = Planner(problem, solver(), Passes(most)).plan(0.0, problem.initial)
        assert plan.passes == most
        assert plan.control.tolist() == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize("displacement", [-10.0, 10.0])
def test_newton_needs_six_passes_where_quasi_linearisation_needs_twenty(displacement: float) -> None:
    problem = quadrotor(displacement=(displacement, 0, 0, 0, 0, 0))
    newton, quasi = (
        Planner(problem, solver(), Passes(40, 1e-10, second)).plan(0.0, problem.initial) for second in (True, False)
    )
    assert newton.passes <= 6
    assert 18 <= quasi.passes <= 22
    assert relative(newton.control, quasi.control) < 1e-11
    ratios = [float(b / a) for a, b in zip(quasi.changes[3:-2], quasi.changes[4:-1], strict=True)]
    assert all(0.15 < ratio < 0.45 for ratio in ratios)  # linear, as a fixed-point iteration is


def test_newton_reaches_the_nonlinear_oracle() -> None:
    problem = quadrotor()
    plan = Planner(problem, solver(24), Passes(20, 1e-9, True)).plan(0.0, problem.initial)
    truth = nonlinear_control(problem, plan, problem.initial)
    assert truth.tolist() == pytest.approx((18.378603, 16.427465), abs=5e-6)
    assert relative(plan.control, truth) < 5e-6
    coarse = Planner(problem, solver(), Passes(20, 1e-9, True)).plan(0.0, problem.initial)
    assert 1e-5 < relative(coarse.control, truth) < 1e-3  # what ten nodes are worth, whatever their loss
    assert coarse.solution.loss < 2e-10


@pytest.mark.parametrize("kind", ["legendre_gauss", "legendre_radau"])
def test_a_start_that_is_no_node_gets_its_own_control(kind: str) -> None:
    problem = quadrotor()
    planner = Planner(problem, solver(24, kind), Passes(20, 1e-9, True))
    plan = planner.plan(0.0, problem.initial)
    assert plan.points[0] == -1.0
    assert plan.control.tolist() == pytest.approx((18.378603, 16.427465), abs=4e-5)  # solve_bvp; what 24 nodes leave
    assert plan.states[0].tolist() == pytest.approx(problem.initial.tolist(), abs=1e-9)


@pytest.mark.parametrize("second_order", [False, True])
def test_traces_are_what_was_traced_and_warm_starts_save_passes(second_order: bool) -> None:
    problem, passes = quadrotor(), Passes(30, 1e-6, second_order, warm_start=True)
    plain, traced = (Planner(problem, solver(), passes, on) for on in (False, True))
    first, same = (planner.plan(0.0, problem.initial) for planner in (plain, traced))
    (made,) = traced._tables.values()
    assert not isinstance(made, partial)  # the function itself, had it not been recorded
    assert relative(same.control, first.control) < 1e-12
    moved = problem.plant.fly(0.0, problem.initial, first.control, problem.cycle, 2)
    cold, warm = plain.plan(problem.cycle, moved), plain.plan(problem.cycle, moved, last=first)
    assert warm.passes < cold.passes
    assert relative(warm.control, cold.control) < 1e-7


def test_batch_of_vehicles_is_planned_as_one_by_one() -> None:
    problem = quadrotor()
    starts = problem.initial + random(3, 6, seed=2)
    planner = Planner(problem, solver(), Passes(30, 1e-9, True))
    together = planner.plan(0.0, starts)
    assert together.solution.loss.shape == (3,)
    for i, start in enumerate(starts):
        assert relative(together.control[i], planner.plan(0.0, start).control) < 1e-11


def test_a_plan_that_diverges_ends_and_says_so() -> None:
    problem = replace(quadrotor(), initial=torch.full((6,), torch.nan, dtype=torch.float64))
    plan = Planner(problem, solver(), Passes(30)).plan(0.0, problem.initial)
    assert plan.passes == 1
    assert not plan.finite
    for wrong in ({"most": 0}, {"tolerance": 0.0}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} = 0"):
            Passes(**wrong)
