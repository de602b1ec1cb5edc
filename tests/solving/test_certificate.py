"""The certificate accepts what is right to round-off and names what is wrong with the rest."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import (
    growing_cost,
    minimum_energy,
    onto_circle,
    regulator,
    soft_end,
    solve,
    solve_minimum_time,
    solve_saturated,
    unstable,
    with_codes,
)

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.numerics.piecewise import approximate
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.solving.certificate import Certificate, Tolerances, certify
from ponn_torch.solving.flight import fly
from ponn_torch.solving.solution import Solution

SOLVED = {
    "minimum_energy": lambda: solve(minimum_energy(), [[0.0, 0, 0, 0], [1.0, 0, 0, 0]]),
    "growing_cost": lambda: solve(growing_cost(), [[0.0, 0], [0.0, 0]]),
    "soft_end": lambda: solve(soft_end(), [[1.0, 0], [1.0, 0]]),
    "onto_circle": lambda: solve(onto_circle(), [[2.0, 1, 1, 1], [1.0, 0.5, 1, 1]]),
    "unstable": lambda: solve(unstable(), [[1.0, 0], [0.0, 0]]),
    "saturated_energy": solve_saturated,
    "minimum_time": solve_minimum_time,
}


def disturbed(solution: Solution, size: float, seed: int = 0) -> Solution:
    generator = torch.Generator().manual_seed(seed)
    xi = solution.curve.xi
    noise = torch.randn(xi.shape, generator=generator, dtype=xi.dtype)
    return Solution(Curve(solution.curve.collocation, xi + size * noise))


# -- what is right --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SOLVED)
def test_exact_solutions_are_certified_at_their_known_cost(name):
    solution = SOLVED[name]()
    certificate = certify(solution)
    assert certificate.certified, certificate.to_text()
    assert certificate.end_error_scaled < 1e-12
    assert certificate.control_end_error_scaled < 1e-12
    assert certificate.hamiltonian_drift < 1e-13
    assert certificate.flown_cost == pytest.approx(solution.problem.known_cost, abs=1e-12)
    assert certificate.cost == pytest.approx(certificate.flown_cost, abs=1e-12)
    assert certificate.cost_error == certificate.flown_cost - solution.problem.known_cost
    assert certificate.explicit_time is (name == "growing_cost")
    assert (certificate.free_time is not None) is (name == "minimum_time")
    assert (certificate.sign_violation is not None) is (solution.kind == "split")


def test_the_smoothed_landing_is_an_extremal_of_its_own_problem(smoothed_landing):
    certificate = certify(smoothed_landing)
    assert certificate.certified, certificate.to_text()
    assert "certified extremal of the regularised problem at smoothing 0.1" in certificate.verdict
    assert certificate.hamiltonian_drift < 1e-13
    assert certificate.flown_cost == pytest.approx(268.7946271902, abs=2e-9)
    assert certificate.cost_error == pytest.approx(268.7946271902 - 268.0146563274, abs=1e-8)
    assert set(certificate.end_errors) == set(certificate.control_end_errors) == {"r", "v"}
    assert certificate.end_errors["r"] < 1e-8
    assert certificate.seconds < 5.0


def test_the_split_landing_is_certified_with_its_arcs(split_landing):
    certificate = certify(split_landing)
    assert certificate.certified, certificate.to_text()
    assert "arcs max-min-max" in certificate.verdict
    assert certificate.sign_violation < 1e-12
    assert certificate.singular_share == 0.0
    assert abs(certificate.cost_error) < 1e-8


def test_an_extremal_above_the_known_cost_is_called_another_one():
    cheaper = replace(minimum_energy(), known_cost=5.5)
    certificate = certify(solve(cheaper, [[0.0, 0, 0, 0], [1.0, 0, 0, 0]]))
    assert certificate.certified
    assert certificate.verdict.endswith("not the known optimum: it costs 0.5 more")
    assert "not the known optimum" not in certify(SOLVED["minimum_energy"]()).verdict


# -- what is wrong --------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e-7, 1e-3])
def test_disturbed_weights_are_refused(smoothed_landing, size):
    certificate = certify(disturbed(smoothed_landing, size))
    assert not certificate.certified
    assert certificate.verdict.startswith("NOT certified: ")
    assert "end error scaled" in certificate.verdict
    assert certificate.off_node_residual > certificate.tolerances.off_node_residual
    assert certificate.end_error_scaled > certificate.tolerances.end_error
    # from any start the flown extremal keeps its own H
    assert certificate.hamiltonian_drift < 1e-12


@pytest.mark.parametrize(("n_neurons", "expected"), [(3, False), (10, True)])
def test_an_ansatz_that_is_too_coarse_converges_but_is_refused(n_neurons, expected):
    certificate = certify(solve(unstable(), [[1.0, 0], [0.0, 0]], basis=Chebyshev(n_neurons)))
    assert certificate.certified is expected
    if not expected:
        assert "off node residual" in certificate.verdict
        # states and controls of a wrong solution do not even fit each other
        assert certificate.control_end_error_scaled > 1e-9


def test_arcs_on_the_wrong_side_of_the_switching_function_are_refused(split_landing):
    certificate = certify(with_codes(split_landing, [0, 2, 0]))
    largest = float(split_landing.sample().switching.abs().max())
    assert not certificate.certified
    assert certificate.sign_violation == pytest.approx(largest, rel=1e-6)
    assert "sign violation" in certificate.verdict


def test_one_wrong_arc_is_refused_by_its_depth():
    solution = solve_minimum_time()
    # S = −∂H/∂η over its rate is linear in time, largest at the start
    depth = float(solution(0.0).switching)
    certificate = certify(with_codes(solution, [0, 0]))
    assert depth > 0
    assert certificate.sign_violation == pytest.approx(depth)


def test_the_trajectory_with_costates_of_the_other_sign_is_refused():
    # −λ solves the same costate equations and leads to the same end; only S and H tell the worst control
    right = solve_minimum_time()
    collocation, unknowns = right.curve.collocation, right.curve.unknowns
    knots = unknowns.knots.clone()
    knots[:, 2:] *= -1
    xi = collocation.pack(replace(unknowns, knots=knots))
    certificate = certify(Solution(Curve(collocation, xi)))
    assert certificate.end_error_scaled < 1e-12
    assert certificate.off_node_residual < 1e-12
    assert certificate.sign_violation == pytest.approx(float(right(0.0).switching))
    assert certificate.free_time == pytest.approx(2.0)  # H = 1 − λᵀf in place of 1 + λᵀf = 0
    assert not certificate.certified


def test_a_saturated_arc_claimed_to_be_interior_is_refused():
    certificate = certify(with_codes(solve_saturated(), [1, 1, 0]))
    assert not certificate.certified
    assert certificate.sign_violation > 0.01


def test_a_singular_arc_is_never_certified_as_bang_bang():
    # x = 1 − t, then x = 0 with S = 0: all equations hold, but S does not give the control of the second arc
    solution = solve(
        regulator(), [[1.0, -1.0], [0.0, 0.0]], switches=[1.0], arcs=[0, 1], events=[None], tolerance=1e-14
    )
    assert solution.arcs == ["min", "interior"]
    certificate = certify(solution)
    assert certificate.end_error_scaled < 1e-12
    assert certificate.off_node_residual < 1e-11
    assert not certificate.certified
    assert certificate.singular_share == 1.0
    assert "may be singular" in certificate.verdict


def test_segments_without_duration_and_weights_that_are_no_numbers_are_refused():
    solution = solve_minimum_time()
    collocation, unknowns = solution.curve.collocation, solution.curve.unknowns
    backwards = unknowns.times.clone()
    backwards[1] = 3.0
    xi = collocation.pack(replace(unknowns, times=backwards))
    certificate = certify(Solution(Curve(collocation, xi)))
    assert certificate.verdict == "NOT certified: segment 2 has no duration"
    certificate = certify(Solution(Curve(collocation, solution.curve.xi * math.nan)))
    assert not certificate.certified
    assert certificate.end_errors == {"x": math.inf, "v": math.inf}


def test_tolerances_decide_and_are_checked(smoothed_landing):
    certificate = certify(disturbed(smoothed_landing, 1e-7), Tolerances(1.0, 1.0, 1.0, 1.0, 1.0))
    assert certificate.certified
    certificate = certify(smoothed_landing, Tolerances(end_error=1e-17))
    assert "end error scaled" in certificate.verdict
    assert "1e-17" in certificate.verdict
    with pytest.raises(ValueError, match="end_error = 0"):
        Tolerances(end_error=0.0)


# -- the record -----------------------------------------------------------------------------------------


def test_the_record_survives_json_and_tells_people_everything(split_landing):
    good = certify(split_landing)
    bad = certify(Solution(Curve(split_landing.curve.collocation, split_landing.curve.xi * math.nan)))
    for certificate in (good, bad):
        text = json.dumps(certificate.to_dict(), allow_nan=False)
        assert Certificate.from_dict(json.loads(text)) == certificate
    assert "max-min-max" in good.to_text()
    assert "FAILS" not in good.to_text()
    assert "268.01465" in good.to_text()
    assert bad.to_text().count("FAILS") >= 5


# -- the flight -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [1e-2, 1e-5, 1e-8])
def test_no_layer_is_flown_over(width):
    def step(t: np.ndarray) -> np.ndarray:
        return np.tanh((t - 0.437) / width)

    history = approximate(lambda t: step(t)[:, None], 0.0, 1.0)
    flight = fly(lambda t, y, k: step(np.array([t])), [0.0, 1.0], np.zeros(1), [history])
    # ∫ tanh((t − c)/w) = w [ln cosh], and ln cosh x = |x| − ln 2 for large x
    exact = width * (np.logaddexp(0.563 / width, -0.563 / width) - np.logaddexp(0.437 / width, -0.437 / width))
    assert flight.arrived
    assert flight.y[-1, 0] == pytest.approx(exact, abs=1e-11)


def test_a_flight_whose_rates_are_not_finite_ends_where_it_begins():
    """From a first step of NaN SciPy would shrink it for ever."""
    history = approximate(lambda t: np.zeros((len(t), 1)), 0.0, 1.0)
    flight = fly(lambda t, y, k: np.full(1, np.nan), [0.0, 1.0], np.ones(1), [history])
    assert not flight.arrived
    assert flight.message == "the flight ended at 0.000 of the final time: the rates are not finite"


def test_a_flight_into_a_singular_matrix_ends_with_the_reason():
    def rates(t: float, y: np.ndarray, k: int) -> np.ndarray:
        matrix = torch.tensor([[float(t < 0.5)]], dtype=torch.float64)
        return torch.linalg.solve(matrix, torch.ones(1, dtype=torch.float64)).numpy()

    history = approximate(lambda t: np.zeros((len(t), 1)), 0.0, 1.0)
    flight = fly(rates, [0.0, 1.0], np.ones(1), [history])
    assert not flight.arrived
    assert flight.t[-1] <= 0.5
    assert "singular" in flight.message


def test_a_flight_into_a_singularity_ends_with_a_message():
    history = approximate(lambda t: np.zeros((len(t), 1)), 0.0, 2.0)
    flight = fly(lambda t, y, k: y * y, [0.0, 2.0], np.ones(1), [history], most_steps=300)
    assert not flight.arrived
    assert "of the final time" in flight.message
    assert flight.t[-1] <= 1.0 + 1e-9
