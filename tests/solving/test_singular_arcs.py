"""Singular arcs are found among the others, solved to the exact answer, and certified only where admissible."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import pytest
import torch
from analytic import solve
from helpers import problem
from torch import Tensor

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.control_set import INTERIOR, LOWER, UPPER, Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import pontryagin, with_singular_arcs
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.solving.certificate import certify
from ponn_torch.solving.guess import project
from ponn_torch.solving.result import SolveResult
from ponn_torch.solving.singular_arcs import Stretch, violation, with_arc
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.split import Split
from ponn_torch.solving.switching import Structure, needles, switching_along

TWO = Box("u", 1.0, size=2).levels
BOTH_ENDS = torch.tensor([0.0, 4.0], dtype=torch.float64)


def regulator(sign: float = 1.0, drift: float = 0.0, start: float = 1.0, **final: float) -> OptimalControlProblem:
    """±½∫x² dt with ẋ = u + drift, |u| ≤ 1: full speed to zero, then u = −drift, which is singular."""
    return OptimalControlProblem(
        name="regulator",
        states={"x": 1},
        control=Box("u", 1.0, -1.0),
        dynamics=lambda t, x, u, p: {"x": u.u + drift},
        running_cost=lambda t, x, u, p: 0.5 * sign * (x.x**2).sum(-1, keepdim=True),
        initial={"x": start},
        final=final,
        final_time=3.0,
    )


def fuller() -> OptimalControlProblem:
    """½∫x² dt with ẍ = u: the arc x = 0 is singular of second order, and reached by switches without number."""
    return OptimalControlProblem(
        name="fuller",
        states={"x": 1, "v": 1},
        control=Box("u", 1.0, -1.0),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u},
        running_cost=lambda t, x, u, p: 0.5 * x.x**2,
        initial={"x": 1.0, "v": 0.0},
        final={"x": 0.0, "v": 0.0},
        final_time=5.0,
    )


def structure(codes: list[list[int]], times: list[float], events: list[tuple[int, ...]]) -> Structure:
    return Structure(torch.tensor(codes), BOTH_ENDS.new_tensor(times), tuple(events))


@pytest.mark.parametrize(
    ("stretch", "codes", "times", "events"),
    [
        ((0.5, 1.5), [2, 1, 0], [0.5, 1.5], [(0,), (0,)]),  # about the switch, which is gone
        ((2.0, 3.0), [2, 0, 1, 0], [1.0, 2.0, 3.0], [(0,), (0,), (0,)]),
        ((0.0, 2.0), [1, 0], [2.0], [(0,)]),  # from the beginning
        ((2.0, 4.0), [2, 0, 1], [1.0, 2.0], [(0,), (0,)]),  # to the end
    ],
)
def test_an_arc_is_put_in(stretch, codes, times, events):
    found = with_arc(
        structure([[UPPER], [LOWER]], [1.0], [(0,)]), BOTH_ENDS, Stretch(0, *stretch), INTERIOR, Box("u", 1.0).levels
    )
    assert found.arcs.flatten().tolist() == codes
    assert found.times.tolist() == times
    assert list(found.events) == events


def test_switches_of_other_components_stay():
    given = structure([[UPPER, LOWER], [UPPER, UPPER], [LOWER, UPPER]], [1.0, 2.0], [(1,), (0,)])
    found = with_arc(given, BOTH_ENDS, Stretch(0, 0.5, 2.5), INTERIOR, TWO)
    assert found.arcs.tolist() == [[UPPER, LOWER], [INTERIOR, LOWER], [INTERIOR, UPPER], [LOWER, UPPER]]
    assert found.times.tolist() == [0.5, 1.0, 2.5]
    assert found.events == ((0,), (1,), (0,))
    together = structure([[UPPER, LOWER], [LOWER, UPPER]], [1.0], [(0, 1)])
    assert with_arc(together, BOTH_ENDS, Stretch(0, 0.5, 2.5), INTERIOR, TWO).events == ((0,), (1,), (0,))


@pytest.mark.parametrize(
    ("final", "arcs", "switches", "cost"),
    [
        ({}, ["min", "singular"], [1.0], 1 / 6),
        ({"x": 0.5}, ["min", "singular", "max"], [1.0, 2.5], 1 / 6 + 1 / 48),
    ],
)
def test_a_regulator_is_solved_to_its_exact_answer(final, arcs, switches, cost):
    result = Solver(n_starts=1).solve(regulator(**final), 0)
    assert result.certified, result.message
    assert result.solution.arcs == arcs
    assert result.solution.switch_times == pytest.approx(switches, abs=1e-11)
    assert result.solution.cost == pytest.approx(cost, abs=1e-12)
    assert result.certificate.singular_violation == 0.0
    assert "singular arc" in result.certificate.to_text()


def test_an_arc_of_higher_order_is_said_and_never_certified_as_bang_bang():
    result = Solver(n_starts=1, refinement=Split(max_rounds=2, max_sharpenings=6)).solve(fuller(), 0)
    assert not result.certified
    assert "singular arc there: from 2." in result.message
    assert result.solution.kind == "smoothed"


def test_the_certificate_asks_for_legendre_and_clebsch():
    """−½∫x²: on x = 0 all of H's first derivatives vanish, yet the arc is one of the greatest cost."""
    for sign, measured in ((1.0, 0.0), (-1.0, math.inf)):
        solution = solve(regulator(sign, start=0.0, x=0.0), [[0.0, 0.0], [0.0, 0.0]], arcs=[INTERIOR])
        certificate = certify(solution)
        assert certificate.singular_violation == measured
        assert certificate.certified is (sign > 0)
        assert certificate.end_error_scaled < 1e-12


def test_the_certificate_asks_for_a_control_inside_its_bounds():
    solution = solve(regulator(drift=1.5, start=0.0, x=0.0), [[0.0, 0.0], [0.0, 0.0]], arcs=[INTERIOR])
    certificate = certify(solution)
    assert certificate.singular_violation == pytest.approx(0.25)  # u = −1.5 in −1 … 1
    assert certificate.end_error_scaled < 1e-12
    assert not certificate.certified
    assert "singular violation" in certificate.verdict


def tracking(path: Callable[[Tensor], Tensor], final_time: float, start: float) -> OptimalControlProblem:
    """½∫(x − path)² dt with ẋ = u, |u| ≤ 1: on an arc u is the rate of the path, which depends on time."""
    return OptimalControlProblem(
        name="tracking",
        states={"x": 1},
        control=Box("u", 1.0, -1.0),
        dynamics=lambda t, x, u, p: {"x": u.u},
        running_cost=lambda t, x, u, p: 1.0 + 0.5 * (x.x - path(t)) ** 2,
        initial={"x": start},
        final={},
        final_time=final_time,
    )


def test_a_path_that_is_too_steep_in_places_is_left_there():
    """0.6 sin 2.5t: where its rate is above one the control is at its bound, and singular before and after."""
    problem = tracking(lambda t: 0.6 * torch.sin(2.5 * t), 6.0, 0.3)
    result = Solver(n_starts=2).solve(problem, 0)
    assert result.certified, result.message
    assert result.solution.arcs.count("singular") > 2
    assert set(result.solution.arcs) == {"min", "singular", "max"}


def test_a_bound_that_is_passed_between_two_points_is_seen():
    """The rate of the path has a narrow peak, 1e-6 above one, between the points where the control is looked at."""
    width, middle, excess = 0.1, 0.5025, 1e-6

    def path(t: Tensor) -> Tensor:
        shifted = torch.atan((t - middle) / width) + math.atan(middle / width)
        return 0.5 * t + (0.5 + excess) * width * shifted

    problem = tracking(path, 1.0, 0.0)
    solution = solve(problem, [[0.0, 0.0], [0.7, 0.0]], arcs=[INTERIOR], basis=Chebyshev(150), n_nodes=200)
    assert violation(solution.curve) == pytest.approx(excess / 2, rel=0.05)


def test_two_components_at_once_have_to_be_convex_together():
    """½x² + ½y² + 2xy: each alone satisfies Legendre and Clebsch, and along x = −y the cost falls."""
    for coupling, measured in ((0.5, 0.0), (2.0, math.inf)):
        problem = OptimalControlProblem(
            name="pair",
            states={"x": 1, "y": 1},
            control=Box("u", 1.0, -1.0, size=2),
            dynamics=lambda t, x, u, p: {"x": u.u[..., :1], "y": u.u[..., 1:]},
            running_cost=lambda t, x, u, p, k=coupling: 0.5 * (x.x**2 + x.y**2) + k * x.x * x.y,
            initial={"x": 0.0, "y": 0.0},
            final={"x": 0.0, "y": 0.0},
            final_time=3.0,
        )
        bvp = with_singular_arcs(pontryagin(problem), (0, 1))
        codes = torch.full((1, 2), INTERIOR)
        disc = Discretisation(bvp, Chebyshev(10), make_nodes("legendre_gauss", 20))
        made = Collocation.on_segments(disc, torch.tensor([0.0, 3.0]).double(), setting=Setting(Regime(arcs=codes)))
        curve = Curve(made, project(made, lambda t: torch.zeros(len(t), 4, dtype=torch.float64)))
        assert violation(curve) == measured
        assert certify(Solution(curve)).certified is (measured == 0.0)


def test_a_needle_in_a_singular_arc_points_where_s_does():
    for start, code in ((0.5, LOWER), (-0.5, UPPER)):
        problem = regulator(start=start, x=start)
        solution = solve(problem, [[start, 5 * start], [start, 2 * start]], arcs=[INTERIOR])
        (found, *_) = needles(solution.curve, 0.01, 1e-10)
        switching = switching_along(solution.curve, solution.curve.times.mean()[None])
        assert bool((switching > 0) == (code == UPPER))
        assert code in found.arcs.flatten().tolist()


@cache
def rocket() -> SolveResult:
    return Solver().solve(problem("goddard"), 0)


def test_a_rocket_climbs_as_its_closed_form_says():
    """On the arc m g = (1 + v/c) D (Bryson and Ho, section 8.4), which no part of the solver knows."""
    solution = rocket().solution
    begin, end = solution.switch_times
    x = solution(torch.linspace(begin, end, 101, dtype=torch.float64)).states
    h, v, m = (x[name].flatten() for name in ("h", "v", "m"))
    drag = 310.0 * v**2 * torch.exp(-h / 0.002)
    torch.testing.assert_close((1 + v / 0.5) * drag, m / (1 + h) ** 2, rtol=1e-8, atol=0)


def test_what_is_loaded_has_the_same_singular_control(tmp_path):
    solution = rocket().solution
    solution.save(tmp_path)
    loaded = Solution.load(tmp_path, problem=solution.problem)
    assert loaded.bvp.singular == solution.bvp.singular == (0,)
    times = torch.linspace(0.0, solution.final_time, 50, dtype=torch.float64)
    for name, value in solution(times).control.items():
        torch.testing.assert_close(loaded(times).control[name], value, rtol=1e-12, atol=0)
    assert certify(loaded).certified
    assert violation(loaded.curve) == 0.0
