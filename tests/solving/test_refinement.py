"""Refinements end in a solution with the right arcs, or say that they do not."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import pytest
import torch
from helpers import bvp_of, collocation

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.ansatz.networks import MLP
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Status, Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.solving.guess import RandomGuess, project
from ponn_torch.solving.refinement import Outcome, Refined, Rounds, Subdivide, shared_out
from ponn_torch.solving.sharpening import legible
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.split import MOVED, Split, _Search
from ponn_torch.solving.switching import find_structure

OPTIMA = {"earth_mars": 396.05984393, "mars_landing": 268.0146563274}


@cache
def smoothed(name: str, smoothing: float) -> Curve:
    """Down the ladder on one polynomial per chain."""
    made = collocation(bvp_of(name), n_neurons=30, n_nodes=60, smoothing=1.0)
    xi = project(made, RandomGuess().curve(made.bvp, 0))
    for rho in (1.0, 0.3, 0.1, 0.03):
        if rho < smoothing:
            break
        made = made.with_setting(smoothing=rho)
        xi = LevenbergMarquardt(Stopping(tolerance=1e-9, decrease=1e-3)).run(made, xi).xi
    return Curve(made, xi)


@cache
def blunt_split() -> tuple[Collocation, Curve]:
    """Earth–Mars split at the two switches that ρ = 1 shows."""
    start = smoothed("earth_mars", 1.0)
    structure = find_structure(start)
    assert structure.arcs.flatten().tolist() == [2, 0, 2]
    nodes = make_nodes("legendre_gauss", 44, dtype=torch.float64)
    disc = Discretisation(start.collocation.bvp, Chebyshev(30), nodes, conditioning="orthonormal")
    times = torch.cat([start.times[:1], structure.times, start.times[-1:]])
    made = Collocation.on_segments(disc, times, events=[(0,), (0,)], setting=Setting(Regime(arcs=structure.arcs)))
    stopping = Stopping(tolerance=1e-12, decrease=1e-2, max_iterations=60)
    result = LevenbergMarquardt(stopping, damping=1e-8).run(made, project(made, start))
    assert float(result.norm) < 1e-7
    return made, Curve(made, result.xi)


def test_an_extremal_with_too_few_arcs_is_seen_by_the_sign_of_s():
    """Three arcs solve all their equations, at 400.011 kg; S asks for five."""
    _, curve = blunt_split()
    assert Solution(curve).cost == pytest.approx(400.011, abs=1e-3)
    assert curve.off_node_residual() < 1e-6
    assert find_structure(curve).arcs.flatten().tolist() == [2, 0, 2, 0, 2]


def test_two_blunt_curves_tell_the_arcs_that_neither_shows():
    sharp, blunt = smoothed("earth_mars", 0.3), smoothed("earth_mars", 1.0)
    assert len(find_structure(sharp)) == len(find_structure(blunt)) == 3
    assert find_structure(sharp, blunt).arcs.flatten().tolist() == [2, 0, 2, 0, 2]
    assert not legible(sharp, blunt)


def test_arcs_are_legible_once_both_the_curve_and_what_it_leads_to_stay_off_zero():
    landing = [smoothed("mars_landing", rho) for rho in (1.0, 0.3, 0.1)]
    assert [legible(sharp, blunt) for blunt, sharp in pairwise(landing)] == [False, True]


@pytest.mark.parametrize("name", OPTIMA)
def test_a_split_from_a_blunt_curve_finds_the_arcs_that_it_does_not_show(name):
    """At ρ = 1 Earth–Mars shows three arcs, at 400.011 kg; needles lead to the five of the optimum."""
    refined = Split().run(smoothed(name, 1.0))
    assert refined.outcome is Outcome.SOLVED
    assert Solution(refined.curve).cost == pytest.approx(OPTIMA[name], abs=1e-6)


def test_rounds_that_run_out_are_said():
    refined = Split(max_rounds=1, max_sharpenings=0).run(smoothed("earth_mars", 1.0))
    assert refined.outcome is Outcome.STRUCTURE
    assert len(refined.rounds) == 1


def test_what_s_was_not_content_with_is_not_taken_up_again_from_a_sharper_curve():
    """Repairs follow from the solved curve alone, wherever it was reached from."""
    start = smoothed("earth_mars", 1.0)
    structure = find_structure(start)  # three arcs of five
    search = _Search(Split(), start.collocation.bvp, Rounds(start))
    assert Split(max_rounds=1)._split(search, start, structure, 8).outcome is Outcome.STRUCTURE
    assert Split()._split(search, start, structure, 8).outcome is Outcome.STRUCTURE
    assert len(search.rounds.results) == 2
    assert Split()._split(search, start, structure, 9).outcome is Outcome.SOLVED  # other segments are another chance


class Unlucky(Split):
    """A split that notes what it is asked to try, and solves none of it."""

    def __init__(self, **settings):
        super().__init__(**settings)
        object.__setattr__(self, "tried", [])

    def _split(self, search, curve, structure, n_segments):
        self.tried.append((structure, n_segments))
        return Refined(curve, Outcome.RESIDUAL, search.rounds.results)


def test_arcs_that_were_not_solved_are_tried_again_once_a_sharper_curve_has_moved_their_switches():
    """What failed may have been the start: from ρ = 1 to 0.5 the switches of Earth–Mars move by eight to ten days."""
    split, start = Unlucky(max_sharpenings=3), smoothed("earth_mars", 1.0)
    assert split.run(start).outcome is Outcome.RESIDUAL
    tried = [structure for structure, _ in split.tried]
    pairs = [(one, other) for i, one in enumerate(tried) for other in tried[:i] if one.same_arcs(other)]
    assert pairs
    assert not any(one.near(other, MOVED * float(start.times[-1])) for one, other in pairs)


@pytest.mark.parametrize(("n_segments", "first"), [(3, 8), (12, 12), (100, 64)])
def test_a_split_begins_with_the_segments_of_its_start(n_segments, first):
    blunt = smoothed("earth_mars", 1.0)
    times = torch.linspace(0, 1, n_segments + 1, dtype=torch.float64) * blunt.times[-1]
    fine = Collocation.on_segments(blunt.collocation.discretisation, times, setting=blunt.collocation.setting)
    split = Unlucky(max_sharpenings=0)
    split.run(Curve(fine, project(fine, blunt)))
    assert [n for _, n in split.tried] == [first]


@pytest.mark.parametrize(("name", "smoothing"), [("earth_mars", 0.03), ("mars_landing", 0.1)])
def test_a_split_solves_between_the_nodes_too(name, smoothing):
    split = Split()
    refined = split.run(smoothed(name, smoothing))
    assert refined.outcome is Outcome.SOLVED
    assert Solution(refined.curve).cost == pytest.approx(OPTIMA[name], abs=1e-6)
    assert refined.curve.off_node_residual() < 2 * split.off_node_tolerance
    assert float(refined.rounds[-1].norm) < split.residual_tolerance
    # the arcs are the ones that S asks for, and S vanishes at the switches
    solution, found = Solution(refined.curve), find_structure(refined.curve)
    arcs = [{"min": 0, "max": 2}[arc] for arc in solution.arcs]
    assert found.arcs.flatten().tolist() == arcs
    switching = solution(solution.switch_times).switching.flatten()
    assert float(switching.abs().max()) < 1e-10


def test_every_round_of_a_split_calls_back_with_its_own_residual():
    seen = []

    def callback(made: Collocation):
        seen.append([made, 0])

        def on_iteration(record, xi, residual):
            seen[-1][1] += 1
            assert made.blocks(residual)["switching"] >= 0
            assert xi.shape == (made.n_unknowns,)

        return on_iteration

    refined = Split().run(smoothed("mars_landing", 0.1), callback)
    assert [count for _, count in seen] == [result.n_iterations for result in refined.rounds]


def test_a_split_with_a_network_on_every_segment_finds_the_optimum():
    refined = Split(basis=MLP((24,), first_scale=2.0), n_nodes=30).run(smoothed("mars_landing", 0.1))
    assert refined.outcome is Outcome.SOLVED
    solution = Solution(refined.curve)
    assert solution.arcs == ["max", "min", "max"]
    assert solution.cost == pytest.approx(268.0146563274, abs=1e-7)
    assert solution.curve.collocation.linear_unknowns.shape[0] < solution.curve.collocation.n_unknowns


def test_more_arcs_than_allowed_are_not_tried():
    refined = Split(max_arcs=2, max_sharpenings=0).run(smoothed("mars_landing", 0.1))
    assert refined.outcome is Outcome.TOO_MANY_ARCS


def test_subdivision_keeps_the_regime_and_meets_its_tolerance():
    start = smoothed("mars_landing", 0.1)
    refined = Subdivide(off_node_tolerance=1e-8).run(start)
    assert refined.outcome is Outcome.SOLVED
    assert Solution(refined.curve).smoothing == pytest.approx(0.1)
    assert refined.curve.off_node_residual() < 2e-8
    assert Solution(refined.curve).cost == pytest.approx(268.7946271902, abs=1e-6)
    counts = [result.xi.shape[-1] for result in refined.rounds]
    assert counts == sorted(counts)


def test_subdivision_says_when_segments_or_rounds_run_out():
    start = smoothed("mars_landing", 0.03)
    few = Subdivide(max_segments=8, n_neurons=6, n_nodes=9).run(start)
    assert few.outcome is Outcome.TOO_MANY_SEGMENTS
    once = Subdivide(max_rounds=1, n_neurons=6, n_nodes=9).run(start)
    assert once.outcome in (Outcome.COARSE, Outcome.RESIDUAL)
    assert len(once.rounds) == 1


@pytest.mark.parametrize("make", [Split, Subdivide])
def test_an_interrupted_refinement_keeps_its_curve(make):
    def callback(made: Collocation):
        def on_iteration(record, xi, residual):
            raise KeyboardInterrupt

        return on_iteration

    refined = make().run(smoothed("mars_landing", 0.1), callback)
    assert refined.outcome is Outcome.INTERRUPTED
    assert refined.rounds[-1].status is Status.INTERRUPTED
    assert torch.isfinite(refined.curve.xi).all()


@pytest.mark.parametrize("n_segments", [1, 4, 8, 13])
@pytest.mark.parametrize("lengths", [[1.0], [0.2, 0.8], [1e-6, 0.5, 0.5], [0.05, 0.3, 0.05, 0.2, 0.4], [0.1] * 10])
def test_segments_are_shared_out_so_that_the_longest_is_short(lengths, n_segments):
    counts = shared_out(lengths, n_segments)
    assert min(counts) >= 1
    assert sum(counts) == max(len(lengths), n_segments + (len(lengths) - 1) // 2)
    longest = max(length / count for length, count in zip(lengths, counts, strict=True))
    for i, count in enumerate(counts):  # a segment taken from anywhere leaves one that is as long
        if count > 1:
            assert lengths[i] / (count - 1) >= longest
