"""The linear boundary value problem: conditions by construction, oracles, routes, batches, the general residual."""

from dataclasses import replace

import pytest
import torch
from helpers import collocation, relative
from horizons import SOLVERS, N, problem_of, random
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ponn_torch.ansatz.basis import Chebyshev, GaussianRBF
from ponn_torch.ansatz.constraints import value
from ponn_torch.ansatz.expression import ConstrainedExpression
from ponn_torch.guidance.elimination import ROUTES
from ponn_torch.guidance.horizon import HorizonSolver, LinearTPBVP, pseudospectral
from ponn_torch.guidance.oracles import exponential_gain, riccati_sweep
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import GaussNewton
from ponn_torch.optimal_control.control_laws import Unconstrained
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem

ENDS = torch.tensor([-1.0, 1.0], dtype=torch.float64)
EMBEDDED = [name for name, solver in SOLVERS.items() if solver.embedded]
# what the paper's bases reach on this horizon with 12 functions; polynomials reach round-off
DIGITS = {"rbf": 2e-8, "elm": 5e-9, "chebyshev_qr": 1e-11}
LOSSES = {"rbf": 5e-7, "chebyshev_qr": 5e-9}  # round-off of ill-conditioned tables; least squares of what is left


def oracle(problem: LinearTPBVP) -> Tensor:
    """λ(0)."""
    assert problem.terminal_matrix is not None
    assert problem.terminal_offset is not None
    end = (problem.terminal_matrix, problem.terminal_offset)
    gain, offset = exponential_gain(problem.matrix[0], problem.drift[0], float(problem.duration), *end)
    return gain @ problem.initial + offset


@pytest.mark.parametrize("name", EMBEDDED)
@given(seed=st.integers(0, 99))
def test_conditions_hold_for_any_coefficients(name: str, seed: int) -> None:
    solver, n = SOLVERS[name], 3
    problem = problem_of(solver, 2.0, seed=seed)
    y = solver.values(random(solver.basis.size, 2 * n, seed=seed), problem, ENDS)
    assert (y[0, :n] - problem.initial).abs().max() < 1e-12
    assert (y[1, n:] - problem.terminal_costate(y[1, :n])).abs().max() < 1e-12
    assert (y[1, :n] - problem.initial).norm() > 0.1  # or the relative condition would not have been tried


@pytest.mark.parametrize("name", EMBEDDED)
def test_tables_are_those_of_the_constrained_expression(name: str) -> None:
    solver, z = SOLVERS[name], torch.linspace(-1, 1, 7, dtype=torch.float64)
    tables = solver.tables(z)
    for at, own in ((-1.0, tables.states), (1.0, tables.costates)):
        free, switching = ConstrainedExpression(solver.basis, (value(0, at),)).tables(z, 1)
        assert relative(own, free[0]) < 1e-14
        assert relative(tables.slopes, free[1]) < 1e-14
        assert bool((switching[0] == 1).all())


@pytest.mark.parametrize("name", SOLVERS)
@given(seed=st.integers(0, 9))
def test_costate_at_the_start_is_the_matrix_exponentials(name: str, seed: int) -> None:
    solver = SOLVERS[name]
    problem = problem_of(solver, seed=seed)
    solution = solver.solve(problem)
    assert relative(solution.values(ENDS)[0, 3:], oracle(problem)) < DIGITS.get(name, 1e-12)
    assert solution.loss < LOSSES.get(name, 1e-11)
    assert solution.off_node_residual() < 1e3 * DIGITS.get(name, 1e-14)
    assert solution.condition > 1


def test_lobatto_pseudospectral_method_is_over_determined() -> None:
    solver = pseudospectral("legendre_lobatto", 5)
    solution = solver.solve(problem_of(solver))
    rows, columns = solution.matrix.shape
    assert rows == columns + 6
    assert solution.loss > 1e-4  # nothing is met exactly
    assert relative(solution.values(ENDS)[0, 3:], oracle(solution.problem)) < 1e-5


@pytest.mark.parametrize("kind", ["legendre_radau", "legendre_gauss"])
def test_pseudospectral_methods_are_the_same_polynomials(kind: str) -> None:
    lagrange = pseudospectral(kind, N)
    embedded = HorizonSolver(Chebyshev(N, 1), make_nodes(kind, N))
    z = torch.linspace(-1, 1, 9, dtype=torch.float64)
    ways = [solver.solve(problem_of(solver)).values(z) for solver in (lagrange, embedded)]
    assert relative(*ways) < 1e-12


def test_low_loss_is_no_accuracy() -> None:
    # a square system is solved to round-off whatever the basis can express
    poor = HorizonSolver(Chebyshev(4, 1), make_nodes("legendre_lobatto", 4))
    solution = poor.solve(problem_of(poor, 6.0))
    assert solution.loss < 1e-12
    assert solution.off_node_residual() > 1e-2
    assert relative(solution.values(ENDS)[0, 3:], oracle(solution.problem)) > 1e-3


# -- routes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("route", ROUTES)
def test_routes_agree_and_serve_many_right_sides(route: str) -> None:
    solver = replace(SOLVERS["chebyshev"], route=route)
    problem = problem_of(solver)
    starts = random(5, 3, seed=3)
    one_by_one = [solver.solve(replace(problem, initial=x)).coefficients for x in starts]
    reference = [SOLVERS["chebyshev"].solve(replace(problem, initial=x)).coefficients for x in starts]
    factored = solver.factor(problem)
    cached = [factored.solve(replace(problem, initial=x)).coefficients for x in starts]
    shared = factored.affine().coefficients(starts)
    for ways in zip(one_by_one, cached, shared, reference, strict=True):
        assert max(relative(way, ways[-1]) for way in ways) < 1e-12


@pytest.mark.parametrize("name", SOLVERS)
def test_batch_is_one_by_one(name: str) -> None:
    solver = SOLVERS[name]
    problems = [problem_of(solver, 1.0 + i / 4, seed=i) for i in range(3)]
    stacked = LinearTPBVP(
        torch.stack([p.matrix for p in problems]),
        torch.stack([p.drift for p in problems]),
        torch.tensor([float(p.duration) for p in problems], dtype=torch.float64),
        torch.stack([p.initial for p in problems]),
        torch.stack([p.terminal_matrix for p in problems if p.terminal_matrix is not None]),
        torch.stack([p.terminal_offset for p in problems if p.terminal_offset is not None]),
    )
    together = solver.solve(stacked)
    assert together.loss.shape == together.condition.shape == together.off_node_residual().shape == (3,)
    for i, problem in enumerate(problems):
        alone = solver.solve(problem)
        # bases whose matrix has few digits give other digits in another order of operations
        assert relative(together.at_nodes[i], alone.at_nodes) < DIGITS.get(name, 1e-12)


def test_affine_relation_gives_values_anywhere() -> None:
    for solver in (SOLVERS["legendre"], SOLVERS["radau"]):
        problem = problem_of(solver)
        about = replace(problem, initial=problem.initial + 0.3)
        matrix, offset = solver.factor(about).affine().values(ENDS)
        expected = solver.solve(problem).values(ENDS)
        assert relative(offset - 0.3 * matrix.sum(-1), expected) < 1e-12


def test_particles_are_solved_at_once_and_fail_alone() -> None:
    shapes = torch.stack([torch.full((N,), s, dtype=torch.float64) for s in (0.7, 0.0, 1.3)])
    nodes = make_nodes("legendre_lobatto", N)
    swarm = HorizonSolver(GaussianRBF(N, shapes), nodes)
    solution = swarm.solve(problem_of(swarm))
    assert solution.loss.isfinite().tolist() == [True, False, True]  # φ = 1 leaves no equation
    assert solution.off_node_residual().isfinite().tolist() == [True, False, True]
    assert solution.condition.isfinite().tolist() == [True, False, True]
    alone = HorizonSolver(GaussianRBF(N, 1.3), nodes)
    assert relative(solution.at_nodes[2], alone.solve(problem_of(alone)).at_nodes) < 1e-10


def test_wrong_settings_are_named() -> None:
    nodes = make_nodes("legendre_lobatto", 5)
    with pytest.raises(ValueError, match=r"route = 'lux'; allowed: lu, block, qr \(did you mean 'lu'\?\)"):
        HorizonSolver(Chebyshev(5, 1), nodes, route="lux")
    with pytest.raises(ValueError, match="basis has 6 functions for 5 nodes; allowed: at most 5"):
        HorizonSolver(Chebyshev(6, 1), nodes)
    with pytest.raises(ValueError, match="kind = 'uniform'; allowed: legendre_lobatto"):
        pseudospectral("uniform", 5)
    over = HorizonSolver(Chebyshev(3, 1), nodes)
    with pytest.raises(ValueError, match="route = 'lu' with 30 equations for 18 coefficients; allowed: 'qr'"):
        over.solve(problem_of(over))


# -- oracles and the general residual ----------------------------------------------------------------


def test_riccati_sweep_converges_to_the_matrix_exponential_with_order_four() -> None:
    problem = problem_of(SOLVERS["chebyshev"])
    errors = []
    for n_steps in (40, 80):
        times = torch.linspace(0.0, 1.0, n_steps + 1, dtype=torch.float64)
        end = (problem.terminal_matrix, problem.terminal_offset)
        gain, offset = riccati_sweep(lambda t: (problem.matrix[0], problem.drift[0]), times, *end)
        errors.append(relative(gain @ problem.initial + offset, oracle(problem)))
    assert errors[0] < 1e-7
    assert 12 < errors[0] / errors[1] < 20


def test_riccati_sweep_reads_the_clock() -> None:
    # ẋ = −λ, λ̇ = −2 (1 + t)⁻² x from λ(1) = x(1)/2: P = 1/(1 + t) solves Ṗ = P² − 2 (1 + t)⁻²
    def system(t: Tensor) -> tuple[Tensor, Tensor]:
        q = -2.0 / (1.0 + t) ** 2
        zero = torch.zeros_like(q)
        return torch.stack([zero, -torch.ones_like(q), q, zero]).view(2, 2), q.new_zeros(2)

    half = torch.full((1, 1), 0.5, dtype=torch.float64)
    times = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)
    gain, _ = riccati_sweep(system, times, half, half[0] * 0)
    assert relative(gain, torch.ones_like(gain)) < 2e-9


def test_one_gauss_newton_step_of_the_general_residual_gives_the_same_curve() -> None:
    # ẋ = x − v/2 + u1, v̇ = x/2 + 2 u2 with price ½|u|² + x² + v²/2 and 3/2 (x(T)² + v(T)²)
    a = torch.tensor([[1.0, -0.5], [0.5, 0.0]], dtype=torch.float64)
    b = torch.diag(torch.tensor([1.0, 2.0], dtype=torch.float64))
    q, s = torch.diag(torch.tensor([2.0, 1.0], dtype=torch.float64)), 3.0 * torch.eye(2, dtype=torch.float64)
    start, duration = torch.tensor([1.0, -2.0], dtype=torch.float64), 1.5
    problem = OptimalControlProblem(
        name="regulator",
        states={"x": 2},
        control=Unconstrained("u", 2),
        dynamics=lambda t, x, u, p: {"x": x.x @ a.T + u.u @ b.T},
        running_cost=lambda t, x, u, p: 0.5 * (u.u**2).sum(-1, True) + 0.5 * (x.x @ q * x.x).sum(-1, True),
        terminal_cost=lambda t, x, p: 1.5 * (x.x**2).sum(-1, True),
        initial={"x": start.tolist()},
        final={},
        final_time=duration,
    )
    residual = collocation(pontryagin(problem, chains=False), n_neurons=9, n_nodes=10)
    step = (
        GaussNewton(Stopping(max_iterations=1)).run(residual, torch.zeros(residual.n_unknowns, dtype=torch.float64)).xi
    )
    solver = HorizonSolver(Chebyshev(10, 1), make_nodes("legendre_gauss", 10))
    hamiltonian = torch.cat([torch.cat([a, -b @ b.T], 1), torch.cat([-q, -a.T], 1)])
    given = LinearTPBVP(hamiltonian.expand(10, -1, -1), start.new_zeros(10, 4), duration, start, s)
    z = solver.nodes.points
    _, scaled, _ = Curve(residual, step).on_segment(z, 0)
    states, costates = residual.bvp.to_physical(scaled)
    assert relative(solver.solve(given).values(z), torch.cat([states, costates], -1)) < 1e-13
