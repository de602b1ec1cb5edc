"""The problem with boundary layers against its exact solution, and the flight that it needs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers import bvp_of, problem
from scipy.linalg import expm

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.problems.boundary_layer import boundary_layer, exact_solution
from ponn_torch.solving.certificate import certify
from ponn_torch.solving.growth import restarts
from ponn_torch.solving.refinement import Subdivide
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver


def test_the_exact_solution_is_the_matrix_exponential():
    epsilon, t = 0.2, torch.linspace(0, 1.5, 7, dtype=torch.float64)
    found = exact_solution(epsilon, 0.7, -0.3, 1.5, t)
    assert found[0, :2].tolist() == pytest.approx([0.7, 0.0], abs=1e-13)
    assert found[-1, :2].tolist() == pytest.approx([-0.3, 0.0], abs=1e-13)
    # ẋ = y − x, ε ẏ = −λy/ε − y; λ̇x = λx − x, λ̇y = λy/ε − λx
    rates = [
        [-1, 1, 0, 0],
        [0, -1 / epsilon, 0, -1 / epsilon**2],
        [-1, 0, 1, 0],
        [0, 0, -1, 1 / epsilon],
    ]
    for time, w in zip(t.tolist(), found, strict=True):
        flown = torch.from_numpy(expm(torch.tensor(rates).double().numpy() * time)) @ found[0]
        torch.testing.assert_close(flown, w, rtol=1e-9, atol=1e-9)


def test_the_optimum_is_known_for_any_data():
    made = boundary_layer(epsilon=0.1, initial_state=-2.0, final_state=0.5, final_time=0.8)
    result = Solver().solve(made)
    assert result.certified, result.message
    assert result.solution.cost == pytest.approx(made.known_cost, rel=1e-11)
    assert boundary_layer(known_cost=1.0).known_cost == 1.0


@pytest.mark.parametrize("epsilon", [0.02, 0.002])
def test_layers_are_resolved_to_the_exact_solution(epsilon):
    solver = Solver(basis=Chebyshev(100), n_nodes=150, refinement=Subdivide())
    result = solver.solve(boundary_layer(epsilon=epsilon))
    assert result.certified, result.message
    assert result.solution.cost == pytest.approx(result.solution.problem.known_cost, abs=1e-12)
    t = torch.cat([torch.linspace(0, 5 * epsilon, 50), torch.linspace(0, 1, 101)]).double()
    exact = exact_solution(epsilon, 1.0, 0.0, 1.0, t)
    samples = result.solution(t)
    for i, state in enumerate(("x", "y")):
        assert float((samples.states[state].flatten() - exact[:, i]).abs().max()) < 1e-11
        assert float((samples.costates[state].flatten() - exact[:, 2 + i]).abs().max()) < 1e-11
    # y leaves rest within a few ε and follows the slow solution after that
    assert float(exact[:50, 1].abs().max()) > 9 * float(exact[1, 1].abs())


# -- restarts of a flight ------------------------------------------------------------------------------------


def test_layers_are_flown_in_legs_and_a_wrong_curve_is_refused_all_the_same():
    solution = Solver().solve(problem("boundary_layer")).solution
    certificate = certify(solution)
    assert certificate.certified
    # errors grow by exp(1/0.02), a thousandfold per leg
    assert certificate.n_restarts == pytest.approx(50 / 6.9, abs=1.0)
    assert f"{certificate.n_restarts} restarts" in certificate.to_text()
    unknowns = solution.curve.unknowns
    knots = unknowns.knots.clone()
    knots[3, 1] += 1e-6
    moved = Curve(solution.curve.collocation, solution.curve.collocation.pack(replace(unknowns, knots=knots)))
    refused = certify(Solution(moved))
    assert not refused.certified
    assert "end error scaled" in refused.verdict


def test_no_flight_is_interrupted_where_errors_grow_slowly():
    assert bvp_of("minimum_energy").dimension == 4
    solution = Solver().solve(problem("minimum_energy")).solution
    assert restarts(solution) == []
    assert certify(solution).n_restarts == 0
    # the state-transition matrix of this problem has entries up to T²/2 and T³/6
    assert len(restarts(solution, most_growth=1.5)) >= 1
