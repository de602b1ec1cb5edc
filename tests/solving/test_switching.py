"""Arcs are found where S changes its sign, to round-off, and only there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers import bvp_of, collocation, random
from torch import Tensor

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.control_set import INTERIOR, LOWER, UPPER, Level, Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.solving.guess import project
from ponn_torch.solving.switching import (
    Structure,
    claimed_structure,
    find_structure,
    grid,
    needles,
    sampled,
    switching_along,
    without_short_arcs,
    wrong_side,
)

PUSH = 1.5 - math.sqrt(1.25)  # of the minimum-fuel double integrator over 3 s
SLOPE = 2 / (3 - 2 * PUSH)


def with_costate(costate: Callable[[Tensor], Tensor]) -> Curve:
    """A curve of the minimum-fuel problem, S = |λv| − 1, with a given λv; the rest does not matter."""
    bvp = pontryagin(bvp_of("minimum_fuel").problem, chains=False)
    made = collocation(bvp, n_neurons=40, n_nodes=60)

    def w(t: Tensor) -> Tensor:
        zero = torch.zeros_like(t)
        return torch.stack([zero, zero, zero, costate(t)], -1)

    return Curve(made, project(made, w))


def test_zeros_are_found_to_round_off():
    structure = find_structure(with_costate(lambda t: SLOPE * (t - 1.5)))
    assert structure.arcs.flatten().tolist() == [UPPER, LOWER, UPPER]
    assert structure.events == ((0,), (0,))
    assert structure.times.tolist() == pytest.approx([PUSH, 3 - PUSH], abs=1e-13)


def test_samples_stay_those_of_their_curve_when_a_tape_gives_them():
    """Also of curves that know more of themselves when they are asked."""
    first = with_costate(lambda t: SLOPE * (t - 1.5))
    for i in range(30):
        curve = replace(first, xi=(1 + 0.01 * i) * first.xi)
        if i % 2:
            assert float(curve.times[-1]) > 0
        t, switching = sampled(curve, 50)
        expected, w = grid(curve, 50)
        assert torch.equal(t, expected)
        torch.testing.assert_close(switching, switching_along(curve, t, w), rtol=1e-13, atol=1e-13)


def test_arcs_that_no_smoothed_curve_shows_are_extrapolated():
    """S = |λv| − 1 touches zero from one side at both smoothings, and crosses it where they lead to."""

    def smoothed(smoothing: float) -> Curve:
        curve = with_costate(lambda t: 1.0 - 0.02 + smoothing * 0.1 + 0.1 * (t - 1.5) ** 2)
        return Curve(curve.collocation.with_setting(smoothing=smoothing), curve.xi)

    sharp, blunt = smoothed(0.3), smoothed(1.0)
    assert len(find_structure(sharp)) == len(find_structure(blunt)) == 1
    structure = find_structure(sharp, blunt)
    assert structure.arcs.flatten().tolist() == [UPPER, LOWER, UPPER]
    assert structure.times.tolist() == pytest.approx([1.5 - 0.2**0.5, 1.5 + 0.2**0.5], abs=1e-5)  # h² of the grid


def test_curved_switching_functions_are_polished():
    structure = find_structure(with_costate(lambda t: 1.0 + torch.sin(4 * t) * torch.exp(-t)))
    assert structure.times.tolist() == pytest.approx([math.pi / 4, math.pi / 2, 3 * math.pi / 4], abs=1e-9)
    assert structure.arcs.flatten().tolist() == [UPPER, LOWER, UPPER, LOWER]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_zero_at_an_end_opens_no_arc(sign):
    """S = 0 at t = 0 up to round-off, of either sign: an arc without duration could not be solved on."""
    for zero in (0.0, 3.0):
        for shift in (0.0, 1e-16, -1e-16, 1e-15, -1e-15):
            structure = find_structure(with_costate(lambda t: 1.0 + sign * (0.2 * (t - zero) + shift)))  # noqa: B023
            inside = sign * (1.5 - zero) > 0
            assert structure.arcs.flatten().tolist() == [UPPER if inside else LOWER]


@pytest.mark.parametrize("sign", [1, -1])
def test_touching_zero_is_no_switch(sign):
    # S = ±(t − 1.2)² touches zero at 1.2 and stays on its side
    structure = find_structure(with_costate(lambda t: 1.0 + sign * 0.2 * (t - 1.2) ** 2))
    assert len(structure) == 1
    assert structure.arcs.flatten().tolist() == [UPPER if sign > 0 else LOWER]
    assert structure.times.numel() == 0
    # a little lower or higher there are two
    crossing = find_structure(with_costate(lambda t: 1.0 + sign * (0.2 * (t - 1.2) ** 2 - 1e-6)))
    assert len(crossing) == 3
    root = math.sqrt(5e-6)
    assert crossing.times.tolist() == pytest.approx([1.2 - root, 1.2 + root], abs=1e-5)


def exact_split() -> tuple[Collocation, Tensor]:
    """The three arcs of the minimum-fuel problem with S = 0 at both interior knots."""
    bvp = bvp_of("minimum_fuel")
    disc = Discretisation(bvp, Chebyshev(6), make_nodes("legendre_gauss", 9, dtype=torch.float64))
    times = torch.tensor([0.0, PUSH, 3 - PUSH, 3.0], dtype=torch.float64)
    made = Collocation.on_segments(disc, times, events=[(0,), (0,)])
    made = replace(made, setting=replace(made.setting, regime=Regime(arcs=torch.tensor([[2], [0], [2]]))))

    def exact(t: Tensor) -> Tensor:
        v = torch.minimum(torch.minimum(t, torch.full_like(t, PUSH)), 3 - t)
        coast = PUSH**2 / 2 + PUSH * (t - PUSH)
        x = torch.where(t < PUSH, t**2 / 2, torch.where(t > 3 - PUSH, 1 - (3 - t) ** 2 / 2, coast))
        return torch.stack([x, v, torch.full_like(t, -SLOPE), SLOPE * (t - 1.5)], -1)

    return made, project(made, exact)


@pytest.mark.parametrize("size", [0.0, 1e-16, 1e-15, 1e-12])
def test_round_off_at_the_knots_makes_no_arcs(size):
    """S is zero at the knots of a split up to round-off, whose sign means nothing."""
    made, xi = exact_split()
    for seed in range(20):
        noise = size * random(len(xi), seed=seed, low=-1.0)
        structure = find_structure(Curve(made, xi + noise))
        assert structure.arcs.flatten().tolist() == [UPPER, LOWER, UPPER]
        assert structure.times.tolist() == pytest.approx([PUSH, 3 - PUSH], abs=1e-10)


def test_a_curve_on_the_wrong_arcs_asks_for_others():
    """λv that dips below one in the middle of a push: the minimum principle wants a coast there."""
    made, xi = exact_split()
    parts = made.unpack(xi)
    knots = parts.knots.clone()
    knots[:, 2:] *= -1.0  # the costate with the other sign still has |λv| = 1 at the switches
    same = find_structure(Curve(made, made.pack(replace(parts, knots=knots))))
    assert same.arcs.flatten().tolist() == [UPPER, LOWER, UPPER]
    asked = find_structure(with_costate(lambda t: 1.2 + 0.5 * torch.cos(2 * math.pi * t)))
    assert asked.arcs.flatten().tolist() == [UPPER, LOWER] * 3 + [UPPER]
    assert not asked.same_arcs(same)


def test_switching_along_does_not_see_the_arcs_it_is_flown_on():
    made, xi = exact_split()
    t = torch.linspace(0, 3, 31, dtype=torch.float64)
    expected = (SLOPE * (t - 1.5)).abs() - 1
    torch.testing.assert_close(switching_along(Curve(made, xi), t)[:, 0], expected, rtol=1e-12, atol=1e-12)


def test_components_of_a_convex_box_switch_one_by_one():
    made = OptimalControlProblem(
        name="pair",
        states={"x": 2},
        control=Box("u", 1.0, -1.0, size=2),
        dynamics=lambda t, x, u, p: {"x": u.u},
        running_cost=lambda t, x, u, p: 0.5 * (u.u**2).sum(-1, keepdim=True),
        initial={"x": 0.0},
        final={"x": 0.0},
        final_time=2.0,
    )
    bvp = pontryagin(made, chains=False)
    # u = −λ clipped: the first is inside from 0.5 to 1.5 s, the second always
    path = collocation(bvp, n_neurons=6, n_nodes=12)
    curve = Curve(path, project(path, lambda t: torch.stack([0 * t, 0 * t, 2 - 2 * t, 0.3 + 0 * t], -1)))
    structure = find_structure(curve)
    assert structure.arcs.tolist() == [[LOWER, INTERIOR], [INTERIOR, INTERIOR], [UPPER, INTERIOR]]
    assert structure.times.tolist() == pytest.approx([0.5, 1.5], abs=1e-12)
    assert structure.events == ((0,), (2,))  # the lower bound's function of component 0, then its upper one


# -- short arcs ----------------------------------------------------------------------------------------------


LEVELS = (Level(0, LOWER, UPPER),) * 3  # of one component, told apart by their number


def structure_of(codes: list[int], switches: list[float]) -> Structure:
    times = torch.tensor(switches, dtype=torch.float64)
    return Structure(torch.tensor(codes)[:, None], times, tuple((i,) for i in range(len(switches))))


SHORT = [
    # codes, knots, codes left, switches left, events left
    ([2, 0, 2], [0.0, 0.4, 0.7, 1.0], [2, 0, 2], [0.4, 0.7], (0, 1)),  # nothing is short
    ([2, 0, 2], [0.0, 0.4, 0.401, 1.0], [2], [], ()),  # a pair of switches vanishes
    ([2, 0, 2, 0], [0.0, 0.4, 0.402, 0.6, 1.0], [2, 0], [0.6], (2,)),  # and what is left merges
    ([2, 0, 2], [0.0, 0.002, 0.5, 1.0], [0, 2], [0.5], (1,)),  # at the start
    ([2, 0, 2], [0.0, 0.5, 0.999, 1.0], [2, 0], [0.5], (0,)),  # at the end
    ([2, 1, 0], [0.0, 0.5, 0.504, 1.0], [2, 0], [0.502], (1,)),  # one switch where the arc was
    ([2, 0, 2], [0.0, 0.6, 0.5, 1.0], [2], [], ()),  # switches that crossed
]


@pytest.mark.parametrize(("codes", "knots", "left", "switches", "events"), SHORT)
def test_short_arcs_are_merged_away(codes, knots, left, switches, events):
    times = torch.tensor(knots, dtype=torch.float64)
    merged = without_short_arcs(structure_of(codes, knots[1:-1]), times, 0.01, LEVELS)
    assert merged.arcs.flatten().tolist() == left
    assert merged.times.tolist() == pytest.approx(switches)
    assert merged.events == tuple((event,) for event in events)


def test_components_whose_arcs_vanish_between_them_switch_together():
    codes, times = [[2, 2, 0], [0, 2, 0], [0, 0, 0]], torch.tensor([0.5, 0.501], dtype=torch.float64)
    merged = without_short_arcs(
        Structure(torch.tensor(codes), times, ((0,), (1,))),
        torch.tensor([0.0, *times, 1.0]),
        0.01,
        Box("u", 1.0, size=3).levels,
    )
    assert merged.arcs.tolist() == [[2, 2, 0], [0, 0, 0]]
    assert merged.times.tolist() == pytest.approx([0.5005])
    assert merged.events == ((0, 1),)


def test_when_all_are_short_the_longest_stays():
    times = torch.tensor([0.0, 0.2, 0.5, 0.7, 1.0], dtype=torch.float64)
    merged = without_short_arcs(structure_of([2, 0, 2, 0], [0.2, 0.5, 0.7]), times, 0.9, LEVELS)
    assert len(merged) == 1


# -- needles -------------------------------------------------------------------------------------------------


def claiming(code: int, costate: Callable[[Tensor], Tensor]) -> Curve:
    """``with_costate`` said to be one arc."""
    curve = with_costate(costate)
    made = replace(
        curve.collocation, setting=replace(curve.collocation.setting, regime=Regime(arcs=torch.tensor([[code]])))
    )
    return Curve(made, curve.xi)


def test_an_extremal_asks_for_no_needle():
    curve = Curve(*exact_split())
    assert claimed_structure(curve).times.tolist() == pytest.approx([PUSH, 3 - PUSH])
    assert claimed_structure(curve).arcs.flatten().tolist() == [UPPER, LOWER, UPPER]
    assert needles(curve, 0.01, 1e-10) == []


def test_a_needle_at_an_end_is_one_new_switch():
    # S = SLOPE |t − 1.5| − 1 on a coast: positive at both ends, a little more at the last
    asked = needles(claiming(LOWER, lambda t: (SLOPE + 0.01) * (t - 1.5) + 1e-3), 0.01, 1e-10)
    assert [structure.arcs.flatten().tolist() for structure in asked] == [[LOWER, UPPER], [UPPER, LOWER]]
    assert asked[0].times.tolist() == pytest.approx([2.97])
    assert asked[1].times.tolist() == pytest.approx([0.03])
    assert asked[0].events == ((0,),)


def test_a_needle_inside_sits_where_s_is_deepest_and_the_deepest_comes_first():
    def costate(t: Tensor) -> Tensor:
        return 1.5 - 0.7 * torch.exp(-20 * (t - 0.8) ** 2) - 0.8 * torch.exp(-20 * (t - 2.0) ** 2)

    asked = needles(claiming(UPPER, costate), 0.02, 1e-10)
    assert [structure.arcs.flatten().tolist() for structure in asked] == [[UPPER, LOWER, UPPER]] * 2
    assert asked[0].times.tolist() == pytest.approx([1.97, 2.03], abs=2e-3)
    assert asked[1].times.tolist() == pytest.approx([0.77, 0.83], abs=2e-3)
    assert asked[0].events == ((0,), (0,))


@pytest.mark.parametrize(("depth", "count"), [(-1e-6, 0), (0.0, 0), (1e-6, 1)])
def test_a_tangency_asks_for_a_needle_only_when_it_crosses(depth, count):
    # a push whose S touches zero at 1.2, or falls short of it, or crosses
    asked = needles(claiming(UPPER, lambda t: 1.0 + 0.2 * (t - 1.2) ** 2 - depth), 0.01, 1e-10)
    assert len(asked) == count


def test_the_wrong_side_of_a_convex_component_is_told_at_both_bounds():
    # S at the lower and at the upper bound: below both, between, above both
    switching = torch.tensor([[-1.0, -3.0], [1.0, -1.0], [3.0, 1.0]])
    for row, code in enumerate((LOWER, INTERIOR, UPPER)):
        depths = [
            wrong_side(switching, torch.full((3, 1), c), Box("u", 1.0, convex=(0,)).levels)
            for c in (LOWER, INTERIOR, UPPER)
        ]
        worst = [float(depth.amax(-1)[row]) for depth in depths]
        assert [value <= 0 for value in worst] == [c == code for c in (LOWER, INTERIOR, UPPER)]
