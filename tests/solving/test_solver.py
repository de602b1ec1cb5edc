"""From a random start to the known answers, certified; failures are recognised and say why."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass, field, replace
from functools import cache

import pytest
import torch
from helpers import PROBLEMS, PROBLEMS_WITH_ANSWERS, bvp_of, collocation, mass_variables, problem

from ponn_torch.ansatz.basis import Chebyshev, Legendre, RandomFeatures
from ponn_torch.optim.base import Status, Stopping
from ponn_torch.optim.chain import Chain, OutputLayer
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.weighted import WeightedEquations
from ponn_torch.optimal_control.control_laws import Box, Unconstrained
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem
from ponn_torch.problems.boundary_layer import boundary_layer, exact_cost
from ponn_torch.problems.earth_mars import EARTH_VENUS
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving import split
from ponn_torch.solving.certificate import certify
from ponn_torch.solving.continuation import Adaptive, Ladder, Phases, Single
from ponn_torch.solving.guess import RandomGuess, project
from ponn_torch.solving.observer import Observer
from ponn_torch.solving.paths import PolarTransfer
from ponn_torch.solving.refinement import MORE_NEURONS, Subdivide
from ponn_torch.solving.result import SolveResult
from ponn_torch.solving.run import MOST_REPEATS, SAME
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.split import Split

DAY = 86400.0
AU, SUN_GM = 149.59787e9, 1.32712440018e20
CANONICAL = math.sqrt(AU**3 / SUN_GM)  # μ = 1
YEARLY = 58.132 * DAY  # the PoNN paper's unit


@dataclass(frozen=True)
class Answer:
    """Published numbers: cost and its tolerance, arcs, switch times (s), first costates in given units, H."""

    cost: float
    tolerance: float
    arcs: tuple[str, ...] = ()
    switches: tuple[float, ...] = ()
    switch_tolerance: float = 1e-6
    final_time: float | None = None
    costates: dict[str, tuple[float, ...]] = field(default_factory=dict)
    costate_units: dict[str, float] = field(default_factory=dict)
    costate_tolerance: float = 1e-7
    hamiltonian: float | None = None


PAPER_UNITS = {"r": 1000 / AU, "v": 1000 / (AU / YEARLY), "m": 1.0}
ENERGY_UNITS = {"r": AU / CANONICAL**3, "v": AU / CANONICAL**2}
ANSWERS = {
    "boundary_layer": Answer(exact_cost(0.02, 1.0, 0.0, 1.0), 1e-12),
    "minimum_energy": Answer(6.0, 1e-12),
    "minimum_time": Answer(2.0, 1e-12, ("max", "min"), (1.0,), 1e-12, 2.0),
    "minimum_fuel": Answer(
        3 - math.sqrt(5), 1e-12, ("max", "min", "max"), (1.5 - math.sqrt(1.25), 1.5 + math.sqrt(1.25)), 1e-12
    ),
    "brachistochrone": Answer(1.80160312245308, 1e-12, final_time=1.80160312245308, hamiltonian=0.0),
    "energy_landing": Answer(966.6594929655195, 1e-9, final_time=48.15952987, hamiltonian=0.0),
    "oscillator": Answer(
        2.8613463025446273,
        1e-12,
        ("min,min", "min,max", "max,max"),
        (0.5936556554962977, 2.1644519822911943),
        1e-11,
        2.8613463025446273,
        hamiltonian=0.0,
    ),
    "orbit_raising": Answer(
        -1.525064001468, 1e-11, costates={"r": (-1.87712491,), "vr": (-0.92898546,), "vt": (-2.02464937,)}
    ),
    "goddard": Answer(
        -0.0128369183175,
        1e-12,
        ("max", "singular", "min"),
        (0.0235096840415, 0.0726707434415),
        1e-11,
        0.198856262105,
        hamiltonian=0.0,
    ),
    "free_flying_robot": Answer(
        7.910143838106,
        1e-10,
        (
            "min,max,max,min",
            "min,min,max,min",
            "min,min,singular,min",
            "min,min,min,min",
            "max,min,min,min",
            "min,min,min,min",
            "min,max,min,min",
            "min,min,min,min",
            "min,min,min,singular",
            "min,min,min,max",
            "max,min,min,max",
        ),
        (
            *(0.61027357687, 1.03886867086, 1.12467242450, 2.54088770583, 4.83434645491),
            *(7.16565354509, 9.45911229417, 10.87532757550, 10.96113132914, 11.38972642313),
        ),
        1e-9,
    ),
    "planar_car": Answer(
        3.801260863077, 1e-11, ("max", "min"), (1.7176930388739,), 1e-10, 3.4353860777478, hamiltonian=0.0
    ),
    "zermelo": Answer(5.457865263560512, 1e-12, final_time=5.457865263560512, hamiltonian=0.0),
    "earth_mars": Answer(
        396.05984393,
        1e-7,
        ("max", "min", "max", "min", "max"),
        tuple(DAY * t for t in (46.580845161, 68.023322597, 142.717340729, 290.254110121)),
        1e-7 * DAY,
        costates={
            "r": (-0.8716461495216, -1.1497810369671, -0.0875851962203),
            "v": (-0.5400403260906, -1.4059900229013, 0.3312112393472),
            "m": (0.4790838018822,),
        },
        costate_units=PAPER_UNITS,
        costate_tolerance=1e-9,
        hamiltonian=-0.25311643234 * 1000 / YEARLY,
    ),
    "energy_transfer": Answer(
        0.0142251748586 * AU**2 / CANONICAL**3,
        1e-10,
        costates={
            "r": (-0.06696892, -0.09422631, -0.00129002),
            "v": (-0.04797956, -0.1074862, 0.01120623),
        },
        costate_units=ENERGY_UNITS,
    ),
    "energy_transfer_limited": Answer(2.2655025004 * YEARLY, 1e-3),
    "mars_landing": Answer(268.0146563274, 1e-7, ("max", "min", "max"), (31.0920056478, 39.2202817443)),
    "small_body_landing": Answer(3.9087445862, 1e-8, ("max", "min", "max"), (102.9543890733, 671.7228754865)),
    "tfc_test_1": Answer(
        179.4476468458,
        1e-7,
        ("min", "max"),
        (7.4430057683,),
        final_time=31.2623123369,
        costates={
            "r": (-3.472511189e-2, -5.364233455e-3, 2.330559168e-2),
            "v": (-0.3995834211, -0.1434829029, -0.6586013667),
            "m": (0.1220243734,),
        },
        hamiltonian=0.0,
    ),
    "tfc_test_2": Answer(
        275.2062387119,
        1e-7,
        ("max", "min", "max"),
        (32.4177195331, 38.8374666748),
        final_time=44.8228903294,
        costates={
            "r": (5.991001255e-2, 4.163238549e-2, -2.552218465e-2),
            "v": (1.939142394, 1.309112918, -1.653061741),
            "m": (0.2630713167,),
        },
        hamiltonian=0.0,
    ),
}


def test_every_published_answer_is_asked_for():
    assert set(ANSWERS) == set(PROBLEMS_WITH_ANSWERS)


@cache
def solved(name: str, seed: int = 0) -> SolveResult:
    guess = PolarTransfer() if name.startswith("energy_transfer") else RandomGuess()
    return Solver(guess=guess).solve(problem(name), seed)


# the same solve is held against single shooting in tests/problems/test_steering.py
ALSO_SHOT = ("orbit_raising",)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in ALSO_SHOT else []) for name in ANSWERS]
)
def test_published_problems_are_solved_to_their_answers(name):
    result, answer = solved(name), ANSWERS[name]
    assert result.certified, result.message
    solution = result.solution
    assert solution.cost == pytest.approx(answer.cost, abs=answer.tolerance)
    assert solution.problem.known_cost == pytest.approx(answer.cost, abs=answer.tolerance)
    if answer.arcs:
        assert tuple(solution.arcs) == answer.arcs
        assert solution.switch_times == pytest.approx(answer.switches, rel=0, abs=answer.switch_tolerance)
    if answer.final_time is not None:
        assert solution.final_time == pytest.approx(answer.final_time, abs=1e-7)
    start = solution(0.0)
    for state, expected in answer.costates.items():
        found = start.costates[state].flatten() / answer.costate_units.get(state, 1.0)
        largest = max(abs(x) for x in expected)
        assert found.tolist() == pytest.approx(expected, rel=0, abs=answer.costate_tolerance * max(1.0, largest))
        assert found.tolist() == pytest.approx(expected, rel=0, abs=1e-6 * largest)
    if answer.hamiltonian is not None:
        times = torch.linspace(0, solution.final_time, 9, dtype=torch.float64)
        scale = float(solution.bvp.cost_unit / solution.bvp.time_unit)
        h = solution(times).hamiltonian.flatten().tolist()
        assert h == pytest.approx([answer.hamiltonian] * 9, rel=0, abs=1e-9 * scale)


def test_the_limited_energy_transfer_burns_its_known_fuel():
    solution = solved("energy_transfer_limited").solution
    end = solution(solution.final_time)
    assert 1000.0 - float(end.states["m"]) == pytest.approx(443.4740587668, abs=1e-6)
    # δ = 1 for 4.2 % of the time
    throttle = solution(torch.linspace(0, solution.final_time, 2001)).control["thrust_magnitude"] / 0.5
    assert float((throttle > 1 - 1e-9).double().mean()) == pytest.approx(0.042, abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["earth_mars", "mars_landing"])
@pytest.mark.parametrize("seed", range(20))
def test_every_random_start_ends_in_the_optimum(name, seed):
    result = solved(name, seed)
    assert result.certified, result.message
    assert result.solution.cost == pytest.approx(ANSWERS[name].cost, abs=1e-6)
    assert result.solution.switch_times == pytest.approx(ANSWERS[name].switches, abs=1e-4 * DAY)


@pytest.mark.slow
@pytest.mark.parametrize("mass_variable", ["mass", "delta_v"])
@pytest.mark.parametrize("name", [name for name in ANSWERS if problem(name).mass is not None])
def test_every_mass_variable_finds_the_optimum(name, mass_variable):
    guess = PolarTransfer() if name.startswith("energy_transfer") else RandomGuess()
    result = Solver(guess=guess, mass_variable=mass_variable).solve(problem(name))
    assert result.certified, result.message
    assert result.solution.cost == pytest.approx(ANSWERS[name].cost, abs=10 * ANSWERS[name].tolerance)


@pytest.mark.slow
def test_a_transfer_of_many_revolutions_with_eleven_switches_is_certified():
    solver = Solver(
        basis=Legendre(14),
        conditioning="orthonormal",
        n_nodes=20,
        n_segments=12,
        guess=PolarTransfer(revolutions=3),
        n_starts=1,
    )
    result = solver.solve(PROBLEMS["earth_mars"](**EARTH_VENUS))
    assert result.certified, result.message
    assert result.solution.cost == pytest.approx(209.42204516, abs=1e-7)
    assert result.solution.arcs == ["min", "max"] * 6


@pytest.mark.slow
def test_standard_gravity_tells_the_papers_two_numbers_apart():
    made = PROBLEMS["mars_landing"](standard_gravity=9.81)
    assert made.known_cost == 267.9318584923
    solution = Solver().solve(made).solution
    assert solution.cost == pytest.approx(267.9318584923, abs=1e-7)
    assert solution.switch_times == pytest.approx((31.0938504661, 39.2200555407), abs=1e-6)


# -- smoothed problems are problems of their own -------------------------------------------------------------

SMOOTHED = {
    ("earth_mars", 1.0): 449.2546446704,
    ("earth_mars", 0.1): 399.6389415258,
    ("mars_landing", 0.1): 268.7946271902,
    ("mars_landing", 0.01): 268.0307003834,
}


@cache
def coarse(name: str) -> dict[float, Curve]:
    """One polynomial per chain down the ladder, from a random start."""
    made = collocation(bvp_of(name), n_neurons=30, n_nodes=60, smoothing=1.0)
    xi, curves = project(made, RandomGuess().curve(made.bvp, 0)), {}
    for rho in (1.0, 0.3, 0.1, 0.03, 0.01):
        made = made.with_setting(smoothing=rho)
        xi = LevenbergMarquardt(Stopping(tolerance=1e-9, decrease=1e-3)).run(made, xi).xi
        curves[rho] = Curve(made, xi)
    return curves


@cache
def smoothed(name: str, smoothing: float, mass_variable: str) -> Solution:
    """The coarse curve, written in a mass variable, then on segments until it holds between the nodes."""
    start, bvp = coarse(name)[smoothing], bvp_of(name, mass_variable)
    made = collocation(bvp, n_neurons=30, n_nodes=60, smoothing=smoothing)
    xi = project(made, lambda t: bvp.to_scaled(*start.collocation.bvp.to_physical(start(t))))
    refined = Subdivide().run(Curve(made, xi))
    assert refined.outcome.name == "SOLVED"
    return Solution(refined.curve)


CASES = [(name, rho, v) for name, rho in SMOOTHED for v in mass_variables(name)]


@pytest.mark.parametrize(("name", "smoothing", "mass_variable"), CASES)
def test_smoothed_fuels_do_not_depend_on_the_mass_variable(name, smoothing, mass_variable):
    solution = smoothed(name, smoothing, mass_variable)
    assert solution.cost == pytest.approx(SMOOTHED[name, smoothing], abs=1e-7)


@pytest.mark.parametrize("name", ["earth_mars", "mars_landing"])
def test_costates_of_a_smoothed_problem_do_not_depend_on_the_mass_variable(name):
    t = torch.linspace(0, problem(name).time_guess, 50, dtype=torch.float64)
    reference, *others = (smoothed(name, 0.1, v)(t) for v in mass_variables(name))
    for other in others:
        for state, expected in reference.costates.items():
            size = float(expected.abs().max())
            assert float((other.costates[state] - expected).abs().max()) < 1e-8 * size


@pytest.mark.parametrize(("name", "smoothing"), [("earth_mars", 0.1), ("mars_landing", 0.01)])
def test_the_regularised_hamiltonian_is_constant_along_the_flown_extremal(name, smoothing):
    certificate = certify(smoothed(name, smoothing, "log_mass"))
    assert certificate.certified, certificate.to_text()
    assert certificate.hamiltonian_drift < 1e-9
    assert certificate.flown_cost == pytest.approx(SMOOTHED[name, smoothing], abs=1e-5)


def test_a_few_fixed_segments_do_it_too():
    ladder = Ladder((1.0, 0.3, 0.1))
    solver = Solver(n_segments=6, basis=Chebyshev(30), n_nodes=45, continuation=ladder, refinement=None)
    stages = {stage.smoothing: stage for stage in solver.solve(problem("earth_mars")).stages}
    for smoothing in (1.0, 0.1):
        fuel = SMOOTHED["earth_mars", smoothing]
        assert stages[smoothing].solution.cost == pytest.approx(fuel, abs=1e-5)
        assert stages[smoothing].cost == pytest.approx(fuel, abs=1e-3)  # by the nodes' own quadrature


# -- what cannot be trusted ----------------------------------------------------------------------------------


def test_even_nodes_with_twice_as_many_as_neurons_fail_between_the_nodes():
    """The residual at the nodes looks solved; only between them does the polynomial show what it is."""
    optimizer = LevenbergMarquardt(Stopping(tolerance=1e-9, decrease=1e-3, max_iterations=25))
    results = {
        kind: Solver(
            basis=Chebyshev(60),
            n_nodes=120,
            node_kind=kind,
            refinement=None,
            n_starts=1,
            continuation=Single(1.0),
            optimizer=optimizer,
        ).solve(problem("mars_landing"))
        for kind in ("uniform", "legendre_gauss")
    }
    even, good = results["uniform"], results["legendre_gauss"]
    assert even.stages[-1].norm < 1e-3
    assert even.stages[-1].off_node_residual > 1.0
    assert not even.certified
    assert "off node residual" in even.message
    assert "no stage solves its own problem between the nodes" in even.message or "NOT certified" in even.message
    assert good.stages[-1].off_node_residual < 1e-7
    assert good.solution.cost == pytest.approx(272.1667469489, abs=1e-5)


def test_the_sharpest_trusted_stage_is_kept():
    solver = Solver(refinement=None, n_starts=1, continuation=Ladder((1.0, 0.3, 0.1, 0.01, 1e-3, 1e-4)))
    result = solver.solve(problem("mars_landing"))
    by_smoothing = {stage.smoothing: stage.off_node_residual for stage in result.stages}
    assert by_smoothing[1e-4] > 0.1 > by_smoothing[0.1]
    assert result.solution.smoothing > 1e-3
    assert not result.certified  # one polynomial is not enough for the defaults


def test_an_adaptive_schedule_halves_its_step_where_a_stage_is_not_trusted():
    solver = Solver(refinement=None, n_starts=1, continuation=Adaptive(1.0, 1e-3, 0.1, max_halvings=2))
    result = solver.solve(problem("mars_landing"))
    tried = [stage.smoothing for stage in result.stages]
    untrusted = tried.index(pytest.approx(1e-2))
    assert tried[:untrusted] == pytest.approx([1.0, 0.1])
    assert tried[untrusted + 1] == pytest.approx(10**-1.5)  # half a step from the last good one
    assert result.solution.smoothing < 0.1


def test_an_infeasible_transfer_is_recognised_early_with_a_message():
    result = Solver(n_starts=2).solve(PROBLEMS["earth_mars"](maximum_thrust=0.2), seed=3)
    assert result.certificate is None
    assert not result.certified
    assert result.n_starts == 2
    assert result.message.startswith("start 2 of seed 3 failed: ‖r‖ = 0.")
    assert "after the second stage" in result.message
    walked = [(start, smoothing) for start in (0, 1) for smoothing in (1.0, 0.3)]
    # the first start with few neurons before all
    assert [(stage.start, stage.smoothing) for stage in result.stages] == [(0, 1.0), *walked]
    assert all(stage.n_iterations <= 60 and stage.norm > 0.1 for stage in result.stages)
    assert result.solution is not None  # what there is can be looked at


def test_a_start_outside_the_domain_of_the_dynamics_names_the_equation():
    made = OptimalControlProblem(
        name="logarithmic_drag",
        states={"x": 1, "v": 1},
        control=Unconstrained("u", 1),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u - torch.log(x.x)},
        running_cost=lambda t, x, u, p: 0.5 * u.u**2,
        initial={"x": 1.0, "v": -8.0},
        final={"x": 1.0, "v": 8.0},
        final_time=2.0,
    )
    result = Solver(n_starts=2, basis=Chebyshev(8), n_nodes=16).solve(made)
    assert result.solution is None
    assert "not finite at the starting point, in the equations of: v" in result.message


# -- several extremals, several starts -----------------------------------------------------------------------


@pytest.mark.slow
def test_the_cheapest_of_several_certified_extremals_is_kept():
    result = Solver(n_certified=3).solve(problem("energy_transfer"))
    assert result.certified
    unit = AU**2 / CANONICAL**3
    costs = [stage.cost / unit for stage in result.stages if stage.name == "split" and stage.cost > 0]
    assert max(costs) == pytest.approx(1.388, abs=1e-3)  # another extremal, just as well solved
    assert result.solution.cost / unit == pytest.approx(0.0142251748586, abs=1e-12)


@dataclass(frozen=True)
class Scripted:
    """A guess whose starts are good or not a number."""

    good: tuple[bool, ...]

    def curve(self, bvp, seed):
        good = self.good[seed % len(self.good)]
        return RandomGuess().curve(bvp, seed) if good else lambda t: t.new_full((*t.shape, 2 * bvp.n_states), math.nan)


@pytest.mark.parametrize(("good", "count"), [((True, False), 1), ((True, True, False), 2), ((False, True, True), 2)])
def test_the_message_is_that_of_the_start_which_is_kept(good, count):
    result = Solver(guess=Scripted(good), n_starts=len(good), n_certified=5).solve(problem("minimum_energy"))
    assert result.certified
    assert result.n_starts == len(good)
    several = "; the cheapest of 2 certified starts" if count == 2 else ""
    assert result.message == f"{result.certificate.verdict}{several}"


@pytest.mark.parametrize(("revolutions", "allowed", "tried"), [(0, 9, 1), ((0, 1), 9, 2), ((0, 1, 2), 2, 2)])
def test_a_guess_with_nothing_random_in_it_has_as_many_starts_as_it_has_curves(revolutions, allowed, tried):
    one = Solver(guess=PolarTransfer(revolutions), n_segments=1, n_starts=allowed)
    hopeless = replace(one, start_limit=1e-300, continuation=Single())
    result = hopeless.solve(problem("earth_mars"))
    assert result.n_starts == tried
    assert {stage.start for stage in result.stages} == set(range(tried))


@pytest.mark.slow
def test_of_several_numbers_of_revolutions_the_cheapest_is_kept():
    solver = Solver(
        basis=Legendre(14),
        conditioning="orthonormal",
        n_nodes=20,
        n_segments=12,
        guess=PolarTransfer(revolutions=(2, 3, 5)),
        n_certified=5,
    )
    result = solver.solve(PROBLEMS["earth_mars"](**EARTH_VENUS))
    assert result.n_starts == 3
    assert result.message.endswith("the cheapest of 3 certified starts")
    assert result.solution.cost == pytest.approx(209.42204516, abs=1e-7)
    costs = [stage.cost for stage in result.stages if stage.name == "split" and stage.cost > 0]
    assert costs == pytest.approx([463.66754213, 209.42204516, 493.44313853], abs=1e-6)


def test_a_solve_does_not_depend_on_those_before_it():
    """Tables and tapes are kept from solve to solve, but not those of weights that were changed since."""
    basis, fresh = RandomFeatures(30, "tanh"), RandomFeatures(30, "tanh", seed=7)
    blunt = Solver(basis=basis, refinement=None, continuation=Ladder((1.0,)), n_starts=1)
    for _ in range(3):
        blunt.solve(problem("mars_landing"))
    basis.load_state_dict(fresh.state_dict())
    changed, alone = blunt.solve(problem("mars_landing")), replace(blunt, basis=fresh).solve(PROBLEMS["mars_landing"]())
    assert torch.equal(changed.solution.curve.xi, alone.solution.curve.xi)
    assert changed.stages[-1].norm == alone.stages[-1].norm


def test_a_problem_that_was_changed_in_place_has_other_ends():
    made = PROBLEMS["energy_landing"]()
    before = pontryagin(made)
    made.initial["v"] = [0.5 * value for value in made.initial["v"]]
    after = pontryagin(made)
    assert after.equations == before.equations
    assert not torch.equal(after.known_initial, before.known_initial)


def test_tables_and_tapes_serve_a_problem_from_another_start():
    """Stated anew, with functions of its own: the very numbers that it has alone."""
    there = {"initial_position": (-900.0, 100.0, 1500.0), "initial_velocity": (30.0, -10.0, -70.0)}
    blunt = Solver(refinement=None, continuation=Ladder((1.0,)), n_starts=1, node_kind="legendre_radau")
    alone = blunt.solve(PROBLEMS["mars_landing"](**there))
    replays = alone.solution.curve.collocation.discretisation.replays
    for _ in range(3):
        blunt.solve(PROBLEMS["mars_landing"](initial_velocity=(20.0, -50.0, -60.0)))
    again = blunt.solve(PROBLEMS["mars_landing"](**there))
    assert again.solution.curve.collocation.discretisation.replays is replays
    assert any(replay.recorded for replay in replays.values())
    assert torch.equal(again.solution.curve.xi, alone.solution.curve.xi)
    assert again.solution.bvp.problem.initial["r"] == list(there["initial_position"])


def test_a_ladder_in_another_parameter_than_the_smoothing_leads_to_the_optimum():
    ladder = Ladder((60.0, 50.0, 44.823), parameter="final_time")
    result = Solver(continuation=ladder, n_starts=1).solve(problem("mars_landing"))
    assert result.certified
    assert result.solution.cost == pytest.approx(268.0146563274, abs=1e-7)


def test_a_ladder_that_ends_elsewhere_is_finished_at_the_stated_value():
    schedule = Phases([Ladder((1.0, 0.3)), Ladder((45.5, 46.0), parameter="final_time")])
    result = Solver(continuation=schedule, n_starts=1).solve(problem("mars_landing"))
    assert result.certified
    assert result.solution.final_time == 44.823
    assert result.solution.cost == pytest.approx(268.0146563274, abs=1e-7)
    times = [stage.solution.final_time for stage in result.stages if stage.name == "smooth"]
    assert times == pytest.approx([44.823, 44.823, 45.5, 46.0, 44.823])


def test_a_stated_value_that_is_not_reached_is_said():
    """Nobody lands in 10 s; a certificate of 46 s is none of this problem."""
    hasty = problem("mars_landing").with_boundary(final_time=10.0)
    result = Solver(continuation=Ladder((46.0,), parameter="final_time"), n_starts=1).solve(hasty)
    assert result.certificate is None
    assert result.message == "the continuation does not reach the problem as stated from final_time = 46, stated 10"


def test_a_seed_is_reproduced_bit_by_bit():
    again = Solver().solve(problem("minimum_fuel"), 0)
    assert torch.equal(again.solution.curve.xi, solved("minimum_fuel").solution.curve.xi)
    assert [s.norm for s in again.stages] == [s.norm for s in solved("minimum_fuel").stages]
    other = Solver().solve(problem("minimum_fuel"), 1)
    assert other.stages[0].records[0]["norm"] != again.stages[0].records[0]["norm"]
    assert other.solution.cost == pytest.approx(again.solution.cost, abs=1e-12)


class Interrupting(Observer):
    """Presses Ctrl-C in the second iteration of a stage."""

    def __init__(self, *stage) -> None:
        self.stage, self.now, self.reported = stage, (), None

    def stage_started(self, name, smoothing, index):
        self.now = (name, smoothing)

    def iteration(self, record, look):
        if self.now == self.stage and record["iteration"] == 2:
            raise KeyboardInterrupt

    def solution(self, solution):
        self.reported = solution


@pytest.mark.parametrize("stage", [("smooth", 1.0), ("smooth", 0.1), ("split", None)])
def test_an_interrupted_solve_keeps_what_it_had(stage):
    observer = Interrupting(*stage)
    result = Solver(continuation=Ladder((1.0, 0.3, 0.1))).solve(problem("mars_landing"), 0, observer)
    assert result.interrupted
    assert "interrupted" in result.message
    assert (result.stages[-1].name, result.stages[-1].smoothing) == stage
    assert result.stages[-1].status is Status.INTERRUPTED
    assert result.stages[-1].n_iterations == 2
    assert result.solution is observer.reported is not None


def test_an_interrupted_solve_keeps_its_best_stage():
    """Not the one that was cut, as long as that is worse than the one before."""
    solver = Solver(continuation=Ladder((1.0, 0.1)))
    result = solver.solve(problem("earth_mars"), 0, Interrupting("smooth", 0.1))
    first, cut = result.stages
    assert cut.status is Status.INTERRUPTED
    assert cut.norm > first.norm
    assert result.solution is first.solution


def test_an_interrupt_between_the_rounds_of_a_refinement_keeps_them(monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(split, "needles", interrupt)
    result = Solver().solve(problem("mars_landing"))
    assert result.interrupted
    assert result.stages[-1].name == "split"
    assert result.stages[-1].norm < Split().residual_tolerance
    assert result.solution is result.stages[-1].solution
    assert result.solution.kind == "split"


@pytest.mark.parametrize("refinement", [Split(), Subdivide()])
def test_a_residual_that_is_not_finite_between_the_nodes_fails_the_refinement(refinement):
    def dynamics(t, x, u, p):  # of no real number within a millisecond of t = 1 s
        return {"r": x.v, "v": u.a + 1e-3 * x.r * torch.sqrt((t - 1.0) ** 2 - 1e-6)}

    made = OptimalControlProblem(
        name="gap",
        states={"r": 1, "v": 1},
        control=Unconstrained("a", 1),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: u.a**2,
        initial={"r": 0.0, "v": 0.0},
        final={"r": 1.0, "v": 0.0},
        final_time=2.0,
    )
    result = Solver(n_starts=1, refinement=refinement).solve(made)
    assert not result.certified
    assert "the residual did not fall below its tolerance" in result.message
    assert Status.NON_FINITE in [stage.status for stage in result.stages]
    assert result.solution is not None


@pytest.mark.parametrize(("reads", "stages"), [(1, 1), (80, 4)])
def test_a_budget_ends_a_solve_that_keeps_what_it_had(monkeypatch, reads, stages):
    """By a clock that counts how often it is read, so that every machine spends it at the same place."""
    ticks = itertools.count()
    monkeypatch.setattr(time, "process_time", lambda: float(next(ticks)))
    result = Solver(cpu_seconds=float(reads)).solve(problem("earth_mars"))
    assert not result.certified
    assert not result.interrupted
    assert result.stages[-1].status is Status.BUDGET
    assert Status.BUDGET.value in result.message
    assert result.solution is not None
    assert reads < result.cpu_seconds < reads + 20  # the iteration under way is ended
    assert len(result.stages) == stages
    assert (result.stages[0].n_iterations == 1) == (stages == 1)


def test_a_layer_that_no_single_polynomial_follows_is_left_to_the_segments():
    """The first stage settles at half of the norm it began with; every start would."""
    result = Solver().solve(boundary_layer(epsilon=0.002))
    assert result.certified
    assert result.n_starts == 1
    smooth = result.stages[0]
    assert smooth.norm > Solver().start_limit
    assert smooth.status.stationary
    assert result.solution.cost == pytest.approx(exact_cost(0.002, 1.0, 0.0, 1.0), rel=1e-12)


def test_no_bounds_means_no_smoothing_and_one_stage():
    result = solved("minimum_energy")
    assert [stage.name for stage in result.stages] == ["smooth", "split"]
    assert result.stages[0].smoothing is None


@pytest.mark.parametrize("field", ["n_nodes", "n_segments", "n_starts", "n_certified"])
def test_errors_name_field_value_and_what_is_allowed(field):
    with pytest.raises(ValueError, match=f"{field} = 0; allowed: at least 1"):
        Solver(**{field: 0})


def test_a_solution_is_no_guess_by_itself():
    with pytest.raises(ValueError, match=r"guess = Solution; allowed: .*Restart\(solution\) begins with a solution"):
        Solver(guess=solved("minimum_energy").solution)


def test_guesses_that_overflow_are_told_from_those_that_do_not_converge():
    """Goddard's rocket in radii instead of altitudes: a guess of the order of a unit lies far below ground."""

    def dynamics(t, x, u, p):
        drag = 310.0 * x.v**2 * torch.exp(-500.0 * (x.h - 1.0))
        return {"h": x.v, "v": (u.thrust - drag) / x.m - 1.0 / x.h**2, "m": -2.0 * u.thrust}

    deep = replace(problem("goddard"), dynamics=dynamics, initial={"h": 1.0, "v": 0.0, "m": 1.0})
    result = Solver(n_starts=2).solve(deep, 0)
    assert not result.certified
    assert "the equations are finite along no guess" in result.message
    assert "altitudes, not radii" in result.message


def test_a_problem_of_ones_own_takes_a_few_lines():
    """A pendulum swung up with the least torque: no costate equation is written."""
    swing = OptimalControlProblem(
        name="pendulum",
        states={"angle": 1, "rate": 1},
        control=Unconstrained("torque", 1),
        dynamics=lambda t, x, u, p: {"angle": x.rate, "rate": u.torque - p.gravity * torch.sin(x.angle)},
        running_cost=lambda t, x, u, p: 0.5 * u.torque**2,
        parameters={"gravity": 1.0},
        initial={"angle": 0.0, "rate": 0.0},
        final={"angle": math.pi, "rate": 0.0},
        final_time=3.0,
    )
    result = Solver(guess=RandomGuess(scale=0.1)).solve(swing)
    assert result.certified, result.message
    assert len(pontryagin(swing).chains) == 2  # angle and rate, and their costates


def test_single_precision_is_for_what_is_not_certified():
    for refinement in (Split(), Subdivide()):
        name = type(refinement).__name__
        with pytest.raises(ValueError, match=f"dtype = float32 with refinement = {name}; allowed: float64, or float32"):
            Solver(refinement=refinement, dtype=torch.float32)
    result = Solver(refinement=None, dtype=torch.float32, n_starts=1).solve(problem("minimum_energy"))
    assert result.solution.curve.xi.dtype is torch.float32


def test_where_nothing_aims_at_a_certificate_one_start_is_enough():
    solver = Solver(continuation=Single(1.0), refinement=None, n_certified=3)
    assert solver.solve(problem("mars_landing")).n_starts == 1


OPTIMIZER = Solver().optimizer


@pytest.mark.parametrize(
    "optimizer",
    [OPTIMIZER, WeightedEquations(OPTIMIZER, {"v_1": 2.0}), Chain([OPTIMIZER, OutputLayer()])],
    ids=["alone", "weighted", "in a chain"],
)
def test_stages_that_lead_to_a_split_end_early_and_others_do_not(optimizer):
    fuel = problem("mars_landing")
    split = Solver(continuation=Single(1.0), optimizer=optimizer, coarse=1.0).solve(fuel, 0)
    alone = Solver(continuation=Single(1.0), optimizer=optimizer, refinement=None).solve(fuel, 0)
    assert split.certified
    assert 1e-6 < split.stages[0].norm < 1e-4
    assert alone.stages[0].norm < 1e-6


def test_components_that_switch_together_share_a_knot():
    """Two carts, each to be moved by one in minimum time: thrust, and brake from 1 s on."""
    twins = OptimalControlProblem(
        name="twins",
        states={"r": 2, "v": 2},
        control=Box("a", 1.0, -1.0, size=2),
        dynamics=lambda t, x, u, p: {"r": x.v, "v": u.a},
        running_cost=lambda t, x, u, p: torch.ones_like(u.a[..., :1]),
        initial={"r": -1.0, "v": 0.0},
        final={"r": 0.0, "v": 0.0},
        final_time=FreeTime(2.5),
    )
    result = Solver().solve(twins)
    assert result.certified, result.message
    assert result.solution.arcs == ["max,max", "min,min"]
    assert result.solution.curve.collocation.events.count((0, 1)) == 1
    assert result.solution.switch_times == pytest.approx([1.0], abs=1e-10)
    assert result.solution.cost == pytest.approx(2.0, abs=1e-10)


def test_what_misses_its_certificate_is_solved_once_more_with_more_neurons():
    coarse = Split(n_neurons=5, n_nodes=9, off_node_tolerance=1e-2)
    result = Solver(refinement=coarse).solve(problem("mars_landing"))
    assert result.certified, result.message
    first, second = (stage for stage in result.stages if stage.name == "split")
    assert not certify(first.solution).certified
    sizes = [stage.solution.curve.collocation.discretisation.basis.size for stage in (first, second)]
    assert sizes == [5, 5 + MORE_NEURONS]


def test_a_stage_that_missed_its_tolerance_is_not_the_only_one_that_arcs_are_read_from():
    """A landing in 1.1 % more than its least time: at ρ = 0.3 no single polynomial is near, and S shows one arc."""
    made = mars_landing(
        initial_position=(-815.4000008650653, 854.3338708031822, 2219.934314659),
        initial_velocity=(-57.32648663769094, 28.57869400586945, -79.18515824347733),
        mass_flow_per_thrust=5.0863e-4,
        final_time=44.615322354471594,
    )
    result = Solver(n_starts=1).solve(made)
    assert result.certified, result.message
    assert result.solution.cost == pytest.approx(296.588115, abs=1e-5)  # as direct collocation has it
    assert result.solution.arcs == ["max", "min", "max"]


def test_where_no_start_comes_through_it_is_said_what_may_help():
    solver = Solver(n_starts=3, start_limit=1e-300, continuation=Single())
    result = solver.solve(problem("mars_landing"))
    assert not result.certified
    assert "of 3 starts: 3 × not through the first stages" in result.message
    assert "guess a path (a straight line, say), or set costate_units" in result.message


def test_starts_take_their_number_of_segments_in_turn():
    solver = Solver(n_segments=(1, 3), n_starts=2, start_limit=1e-300, continuation=Single(), coarse=1.0)
    result = solver.solve(problem("earth_mars"))
    assert [stage.solution.curve.collocation.n_segments for stage in result.stages] == [1, 3]
    assert "of 2 starts: 2 × not through the first stages" in result.message
    with pytest.raises(ValueError, match="n_segments = \\(1, 0\\); allowed: at least 1, or a list of such numbers"):
        Solver(n_segments=(1, 0))


def test_starts_that_lead_where_others_led_before_end_the_search():
    hopeless = Split(max_rounds=1, max_sharpenings=0)
    blunt = Ladder((1.0,))  # at which Earth–Mars shows three arcs of five
    result = Solver(refinement=hopeless, continuation=blunt, guess=RandomGuess(), n_segments=1).solve(
        problem("earth_mars")
    )
    assert not result.certified
    assert result.n_starts < Solver().n_starts
    assert f"{MOST_REPEATS} × {SAME}" in result.message
