"""The certificate accepts what is right to round-off and names what is wrong with the rest."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

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
from ponn_torch.optimal_control.control_laws import Unconstrained
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem
from ponn_torch.optimal_control.regularisers import Entropy, Quadratic
from ponn_torch.solving.certificate import Certificate, Tolerances, certify
from ponn_torch.solving.checks import end_errors
from ponn_torch.solving.flight import control_history, fly, fly_extremal
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


def posed_as(solution: Solution, problem: OptimalControlProblem) -> Solution:
    """The same curve, claimed to solve another problem with the same dynamics."""
    made, unknowns = solution.curve.collocation, solution.curve.unknowns
    other = replace(made, discretisation=replace(made.discretisation, bvp=pontryagin(problem)))
    return Solution(Curve(other, other.pack(unknowns)))


def with_weights_moved(solution: Solution, size: float) -> Solution:
    """Another curve between the same knots."""
    made = solution.curve.collocation
    xi = solution.curve.xi.clone()
    xi[: made.n_weights] += size
    return Solution(Curve(made, xi))


def with_start_moved(solution: Solution, component: int, size: float) -> Solution:
    """Another curve, which begins elsewhere and ends where it did."""
    made, knots = solution.curve.collocation, solution.curve.unknowns.knots.clone()
    knots[0, component] += size
    known = torch.where(made.known_knots.isnan(), torch.nan, knots)
    made = replace(made, known_knots=known)
    return Solution(Curve(made, made.pack(replace(solution.curve.unknowns, knots=knots))))


def fault_names(certificate: Certificate) -> set[str]:
    """What a verdict objects to, without the numbers."""
    faults = [] if certificate.certified else certificate.verdict.removeprefix("NOT certified: ").split("; ")
    return {re.split(r" \S+ exceeds | = ", fault)[0] for fault in faults}


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
    # H = 1 − λᵀf = 2 in place of 1 + λᵀf = 0
    assert certificate.free_time == pytest.approx(1.0)
    assert not certificate.certified


def test_a_saturated_arc_claimed_to_be_interior_is_refused():
    certificate = certify(with_codes(solve_saturated(), [1, 1, 0]))
    assert not certificate.certified
    assert certificate.sign_violation > 0.01


def test_a_singular_arc_is_certified_as_one_and_never_as_bang_bang():
    # x = 1 − t, then x = 0 with S = 0
    solution = solve(regulator(), [[1.0, -1.0], [0.0, 0.0]], switches=[0.9], arcs=[0, 1], tolerance=1e-14)
    assert solution.arcs == ["min", "singular"]
    assert certify(solution).certified
    certificate = certify(with_codes(solution, [0, 2]))
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


# -- one check at a time --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Overdone(Unconstrained):
    """A law that takes a multiple of the minimiser."""

    factor: float = 1.1

    def minimise(self, h, p, like, regime):
        best = super().minimise(h, p, like, regime)
        return best._replace(control={self.name: self.factor * best.control[self.name]})


@dataclass(frozen=True)
class Stationed(Unconstrained):
    """A law that takes ∂H/∂u = 0 for the minimum, whatever H_uu is."""

    def adapted(self, h, cost, p, one, unit):
        return self


def fixed_end(value: float = 0.0) -> OptimalControlProblem:
    return replace(growing_cost(), final={"x": value}, known_cost=None)


def of_radius(square: float) -> OptimalControlProblem:
    circle = onto_circle()
    return replace(circle, terminal_manifold=lambda t, x, p: (x.x**2).sum(-1, keepdim=True) - square)


def energy(**changes) -> Solution:
    return solve(replace(minimum_energy(), **changes), [[0.0, 0, 0, 0], [1.0, 0, 0, 0]])


def repelled() -> Solution:
    return SOLVED["unstable"]()


def growing(problem: OptimalControlProblem | None = None) -> Solution:
    return solve(problem or growing_cost(), [[0.0, 0], [0.0, 0]])


def soft(stiffness: float) -> Solution:
    return solve(soft_end(stiffness=stiffness), [[1.0, 0], [1.0, 0]])


def circular() -> Solution:
    return SOLVED["onto_circle"]()


def concave(sign: float) -> OptimalControlProblem:
    """H = ± ½u² + λv stationary where u = ∓ λ; the curve of the other sign has the other costates."""
    cost = replace(minimum_energy(), known_cost=None, running_cost=lambda t, x, u, p: 0.5 * sign * u.u**2)
    return replace(cost, control=Stationed("u", 1))


def weighted(weight: float) -> OptimalControlProblem:
    changes = {"running_cost": lambda t, x, u, p: p.weight * u.u**2, "parameters": {"weight": weight}}
    return replace(minimum_energy(), known_cost=None, **changes)


def energetic(weight: float) -> Solution:
    return solve(weighted(weight), [[0.0, 0, 0, 0], [1.0, 0, 0, 0]])


def endless(t, x, p):
    return torch.where(x.x > -1e9, torch.inf, x.x)


WIDE = Tolerances(off_node_residual=math.inf, minimality=math.inf)
LOOSE = Tolerances(*[math.inf] * 3, transversality=math.inf, minimality=math.inf)  # but for the sign of S
# what is wrong → (right, wrong, all that the verdict has to object to, tolerances)
WRONG: dict[str, tuple[Callable[[], Solution], Callable[[], Solution], set[str], Tolerances]] = {
    "another start": (growing, lambda: with_start_moved(growing(), 0, 1e-3), {"end error scaled"}, WIDE),
    "another end": (
        energy,
        lambda: posed_as(energy(final={"x": 1.001, "v": 0.0}), minimum_energy()),
        {"end error scaled", "control end error scaled"},
        Tolerances(),
    ),
    "an end off the manifold": (
        circular,
        lambda: posed_as(circular(), of_radius(1.01)),
        {"end error scaled"},
        Tolerances(),
    ),
    "a perturbed control": (
        repelled,
        lambda: with_weights_moved(repelled(), 1e-3),
        {"control end error scaled"},
        WIDE,
    ),
    "another curve between the nodes": (
        growing,
        lambda: with_weights_moved(growing(), 1e-3),
        {"off node residual"},
        Tolerances(),
    ),
    "a free state with a costate": (
        lambda: growing(fixed_end()),
        lambda: posed_as(growing(fixed_end()), growing_cost()),
        {"transversality"},
        Tolerances(),
    ),
    "a costate of another terminal cost": (
        lambda: soft(2.0),
        lambda: posed_as(soft(2.0), soft_end(stiffness=3.0)),
        {"transversality"},
        Tolerances(),
    ),
    "a duration that is not the best": (
        energy,
        lambda: posed_as(energy(), replace(minimum_energy(), final_time=FreeTime(1.0))),
        {"free time"},
        Tolerances(),
    ),
    "too much control": (
        lambda: energy(control=Overdone("u", 1, 1.0)),
        lambda: energy(control=Overdone("u", 1)),
        {"hamiltonian drift"},
        WIDE,
    ),
    "the largest H": (
        lambda: solve(concave(1.0), [[0.0, 0, 0, 0], [1.0, 0, 0, 0]]),
        lambda: solve(concave(-1.0), [[0.0, 0, 0, 0], [1.0, 0, 0, 0]]),
        {"minimality"},
        Tolerances(),
    ),
    "an arc of the other control": (
        solve_minimum_time,
        lambda: with_codes(solve_minimum_time(), [2, 2]),
        {"sign violation"},
        LOOSE,
    ),
    "another duration than stated": (
        lambda: energy(final_time=1.1, known_cost=None),
        lambda: posed_as(energy(final_time=1.1), minimum_energy()),
        {"final_time"},
        Tolerances(),
    ),
    "another parameter than stated": (
        lambda: energetic(0.6),
        lambda: posed_as(energetic(0.6), weighted(0.5)),
        {"weight"},
        Tolerances(),
    ),
    "an endless cost": (
        energy,
        lambda: posed_as(energy(), replace(minimum_energy(), terminal_cost=endless)),
        {"the cost is not finite"},
        Tolerances(),
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_every_check_tells_what_is_wrong_in_its_way_alone(name):
    right, wrong, expected, tolerances = WRONG[name]
    assert certify(right()).certified
    certificate = certify(wrong(), tolerances)
    assert fault_names(certificate) == expected, certificate.to_text()


def test_jumps_at_restarts_count_as_end_errors():
    solution = energy()
    flight = fly_extremal(solution, control_history(solution), explicit_time=False)
    assert end_errors(solution, flight)[0] < 1e-12
    assert end_errors(solution, replace(flight, jumps=(1e-16, 1e-3)))[0] == 1e-3


def test_a_flight_that_does_not_arrive_says_so():
    """ẋ = x³ + u leaves every bound before the end once it starts beyond it."""
    cubic = replace(growing_cost(), dynamics=lambda t, x, u, p: {"x": x.x**3 + u.u}, known_cost=None)
    right = growing(cubic)
    certificate = certify(with_start_moved(right, 0, 10.0), Tolerances(*[math.inf] * 6))
    assert not certificate.certified
    assert "the flight ended at 0.0" in certificate.verdict


@pytest.mark.parametrize("size", [1e-10, 1e-5, 1e5])
def test_the_size_of_the_cost_does_not_matter(size):
    """A cost of 1e-10 leaves costates of 1e-10, and what is wrong with them is as wrong."""

    def costing(problem: OptimalControlProblem, size: float) -> OptimalControlProblem:
        cost = problem.running_cost
        return replace(problem, running_cost=lambda t, x, u, p: size * cost(t, x, u, p), known_cost=None)

    def measured(size: float) -> list[float]:
        free = replace(minimum_energy(), final_time=FreeTime(1.0))
        fixed = solve(costing(minimum_energy(), size), [[0.0, 0, 0, 0], [1.0, 0, 0, 0]])
        ended = growing(costing(fixed_end(), size))
        timed = certify(posed_as(fixed, costing(free, size)))
        loose = certify(posed_as(ended, costing(growing_cost(), size)))
        assert "free time" in fault_names(timed)
        assert "transversality" in fault_names(loose)
        return [timed.free_time, loose.transversality]

    assert measured(size) == pytest.approx(measured(1.0))


@dataclass(frozen=True)
class Mixed:
    """The law of one regulariser and the penalty of another."""

    fraction = staticmethod(Entropy().fraction)
    penalty = staticmethod(Quadratic().penalty)


def test_a_smoothed_law_minimises_h_with_its_own_penalty(smoothed_landing):
    assert certify(smoothed_landing).minimality < 1e-14
    made = smoothed_landing.curve.collocation
    bvp = replace(made.bvp, law=replace(made.bvp.law, regulariser=Mixed()))
    other = replace(made, discretisation=replace(made.discretisation, bvp=bvp))
    assert "minimality" in fault_names(certify(Solution(Curve(other, smoothed_landing.curve.xi))))


def test_values_that_are_rounded_to_single_precision_are_as_stated():
    made = solve(weighted(0.1), [[0.0, 0, 0, 0], [1.0, 0, 0, 0]], dtype=torch.float32, tolerance=1e-4)
    assert made.curve.collocation.departures() == {}
    changed = made.curve.collocation.with_setting(weight=0.2, final_time=2.0)
    assert changed.departures() == {"weight": (pytest.approx(0.2), 0.1), "final_time": (2.0, 1.0)}


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
