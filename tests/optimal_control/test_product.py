"""Several controls at once are minimised as each would be alone, and solved to exact answers."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ponn_torch.optimal_control.control_laws import Box, ThrustBall, Unconstrained
from ponn_torch.optimal_control.control_set import INTERIOR, LOWER, UPPER, ControlSet, Regime
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem
from ponn_torch.optimal_control.product import Product
from ponn_torch.solving.certificate import certify
from ponn_torch.solving.family import Family
from ponn_torch.solving.restart import Restart
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver

NONE = SimpleNamespace()
RHO = torch.full((1, 1), 0.3, dtype=torch.float64)
ONE = torch.ones(1, 1, dtype=torch.float64)

# H of each control alone, with slopes c (..., 3)
PARTS: dict[str, tuple[ControlSet, object]] = {
    "thrust": (ThrustBall("thrust", 2.0, 0.5), lambda u, c: (c * u["thrust"]).sum(-1, True) + u["thrust_magnitude"]),
    "turn": (Box("turn", 1.0, -1.0), lambda u, c: c[..., :1] * u["turn"] + 0.7 * u["turn"] ** 2),
    "valve": (Box("valve", 3.0), lambda u, c: c[..., 1:2] * u["valve"]),
    "free": (Unconstrained("free", 1), lambda u, c: c[..., 2:] * u["free"] + u["free"] ** 2),
}  # fmt: skip
ALL = list(PARTS)


def hamiltonian(names: list[str], slopes: Tensor):
    return lambda **u: sum(PARTS[name][1](u, slopes) for name in names)


def adapted(law: ControlSet, names: list[str]) -> ControlSet:
    """At two slopes and their opposites."""
    one = torch.ones(4, 1, dtype=torch.float64)
    slopes = torch.tensor([[1.0, -2.0, 0.5], [-0.3, 1.0, 2.0]], dtype=torch.float64)
    cost = hamiltonian(names, torch.zeros(4, 3, dtype=torch.float64))
    with torch.no_grad():
        return law.adapted(hamiltonian(names, torch.cat([slopes, -slopes])), cost, NONE, one, 1.0)


@given(
    slopes=st.lists(st.floats(-3, 3).filter(lambda x: abs(x) > 1e-3), min_size=3, max_size=3),
    order=st.permutations(ALL),
    smoothed=st.booleans(),
)
def test_each_is_minimised_as_it_would_be_alone(slopes, order, smoothed):
    c = torch.tensor([slopes], dtype=torch.float64)
    law = adapted(Product([PARTS[name][0] for name in order]), order)
    regime = Regime(smoothing=RHO if smoothed else None)
    with torch.no_grad():
        best = law.minimise(hamiltonian(order, c), NONE, ONE, regime)
        alone = [adapted(PARTS[name][0], [name]) for name in order]
        each = [one.minimise(hamiltonian([name], c), NONE, ONE, regime) for one, name in zip(alone, order, strict=True)]
    for one in each:
        for name, value in one.control.items():
            torch.testing.assert_close(best.control[name], value, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(best.switching, torch.cat([one.switching for one in each], -1), rtol=1e-12, atol=1e-12)
    penalties = [part.penalty(one, NONE, RHO) for part, one in zip(alone, each, strict=True)]
    torch.testing.assert_close(law.penalty(best, NONE, RHO), sum(penalties))
    codes = torch.cat([part.arc_codes(one.switching) for part, one in zip(alone, each, strict=True)], -1)
    assert torch.equal(law.arc_codes(best.switching), codes)
    # the arcs that S asks for give the control back
    with torch.no_grad():
        sharp = law.minimise(hamiltonian(order, c), NONE, ONE, Regime())
        pinned = law.minimise(hamiltonian(order, c), NONE, ONE, Regime(arcs=law.arc_codes(sharp.switching)))
    for name, value in sharp.control.items():
        torch.testing.assert_close(pinned.control[name], value, rtol=1e-12, atol=1e-12)
    # and none of the others is better
    others = law.samples(sharp, NONE)
    values = hamiltonian(order, c)(**others.control)
    assert float(hamiltonian(order, c)(**sharp.control)) <= float(values.min()) + 1e-12
    assert others.fraction.shape == (len(values), 1, law.n_bounded)
    assert all(len(value.unique(dim=0)) > 1 for value in others.control.values())


def test_levels_count_components_through():
    law = adapted(
        Product([PARTS[name][0] for name in ("free", "turn", "thrust", "valve")]), ["free", "turn", "thrust", "valve"]
    )
    assert [tuple(level) for level in law.levels] == [
        (0, LOWER, INTERIOR),
        (0, INTERIOR, UPPER),
        (1, LOWER, UPPER),
        (2, LOWER, UPPER),
    ]
    assert (law.n_bounded, law.n_switching, law.jumps) == (3, 4, True)


COUPLED = {
    "scalars": ((Box("a", 2.0), Box("b", 1.0, -1.0)), lambda a, b: a * b),
    "a difference": ((Box("a", 1.0, -1.0, size=2), Box("b", 1.0, -1.0)), lambda a, b: (a[..., :1] - a[..., 1:]) * b),
    "a probe at zero": ((Box("a", 0.63, -0.37), Box("b", 1.0, -1.0)), lambda a, b: a * b),
    "without bounds": ((Unconstrained("a", 1), Box("b", 1.0, -1.0)), lambda a, b: a**2 + a * b),
}  # fmt: skip


@pytest.mark.parametrize("kind", COUPLED)
def test_controls_that_h_couples_are_refused(kind):
    sets, h = COUPLED[kind]
    one = torch.ones(2, 1, dtype=torch.float64)
    with torch.no_grad(), pytest.raises(ValueError, match="controls 'a' and 'b': the Hamiltonian is no sum"):
        Product(sets).adapted(h, h, NONE, one, 1.0)


def test_a_thrust_whose_components_something_else_weighs_is_refused():
    def h(T, T_magnitude, b):
        return (T[..., :1] - T[..., 1:]) * b + T_magnitude

    one = torch.ones(2, 1, dtype=torch.float64)
    with torch.no_grad(), pytest.raises(ValueError, match="controls 'T' and 'b'"):
        Product((ThrustBall("T", 3.0, size=2), Box("b", 1.0, -1.0))).adapted(h, h, NONE, one, 1.0)


def test_where_h_is_not_finite_it_says_nothing_of_couplings():
    def h(a, b):
        return a + torch.where(b.abs() > 2, torch.nan, b**2 + b)

    one = torch.ones(2, 1, dtype=torch.float64)
    with torch.no_grad():
        law = Product((Box("a", 1.0), Unconstrained("b", 1))).adapted(h, h, NONE, one, 1.0)
    assert law.n_bounded == 1


def test_a_name_stands_for_one_control():
    with pytest.raises(ValueError, match="several controls are called 'u'"):
        Product((Box("u", 2.0), Unconstrained("u", 1)))


@pytest.mark.parametrize("sets", [(), Box("u", 1.0), (Box,), [None]])
def test_what_is_no_list_of_sets_is_told(sets):
    with pytest.raises(ValueError, match=r"sets = .*allowed: a sequence of control sets"):
        Product(sets)


def test_several_controls_without_a_product_are_told_of_it():
    with pytest.raises(ValueError, match=r"control = .*allowed: .*a Product of several"):
        replace(carts(), control=(Box("a", 1.0), Box("b", 1.0)))


def test_products_of_products_are_flat():
    inner = Product((Box("a", 1.0), Box("b", 1.0)))
    assert [part.name for part in Product((inner, Box("c", 1.0))).factors] == ["a", "b", "c"]


def pushed_and_turned(*, first: ControlSet, second: ControlSet) -> OptimalControlProblem:
    """Two carts, rest to rest over a metre in a second: one pays for |a|, the other for ½ b²."""
    return OptimalControlProblem(
        name="two_carts",
        states={"x": 2, "v": 2},
        control=Product((first, second)),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": torch.cat([u.a, u.b], -1)},
        running_cost=lambda t, x, u, p: u.a_magnitude + 0.5 * u.b**2,
        initial={"x": [0.0, 0.0], "v": [0.0, 0.0]},
        final={"x": [1.0, 1.0], "v": [0.0, 0.0]},
        final_time=1.0,
    )


PUSH = (1 - 0.2**0.5) / 2  # with |a| ≤ 5
CLIP = (1 - 0.6**0.5) / 2  # with |b| ≤ 5
CARTS = {
    "jumping and saturated": (Box("b", 5.0, -5.0), 25 * CLIP + 25 * 0.6**0.5 / 6, [CLIP, PUSH, 1 - PUSH, 1 - CLIP]),
    "jumping and free": (Unconstrained("b", 1), 6.0, [PUSH, 1 - PUSH]),
}


@pytest.mark.parametrize("kind", CARTS)
def test_two_carts_are_solved_as_each_would_be_alone(kind):
    second, energy, switches = CARTS[kind]
    result = Solver().solve(pushed_and_turned(first=ThrustBall("a", 5.0, size=1), second=second))
    assert result.certified, result.message
    assert result.solution.cost == pytest.approx(10 * PUSH + energy, abs=1e-10)
    assert result.solution.switch_times == pytest.approx(switches, abs=1e-9)
    if kind == "jumping and saturated":
        assert result.solution.arcs == ["max,max", "max,interior", "min,interior", "max,interior", "max,min"]
    else:
        assert result.solution.arcs == ["max", "min", "max"]


def test_the_equations_know_all_controls():
    made = pushed_and_turned(first=ThrustBall("a", 5.0, size=1), second=Box("b", 5.0, -5.0))
    bvp = pontryagin(made)
    assert [chain.columns for chain in bvp.chains] == [(0, 2), (1, 3), (6, 4), (7, 5)]
    assert made.control.factors[0].name == "a"
    assert bvp.law.factors[1].convex == (0,)


def carts(**sets: ControlSet) -> OptimalControlProblem:
    return pushed_and_turned(**{"first": ThrustBall("a", 5.0, size=1), "second": Box("b", 5.0, -5.0), **sets})


@pytest.fixture(scope="module")
def solved() -> Solution:
    return Solver().solve(carts()).solution


def test_it_is_saved_and_loaded(solved, tmp_path):
    solved.save(tmp_path)
    again = Solution.load(tmp_path, carts())
    assert again.arcs == solved.arcs
    assert again.cost == solved.cost
    assert certify(again).certified


def test_it_starts_others(solved):
    """By its arcs where the switching functions mean the same, by its curve where they do not."""
    farther = replace(carts(), final={"x": [1.0, 0.95], "v": [0.0, 0.0]})
    result = Solver(guess=Restart(solved)).solve(farther)
    assert result.certified
    assert [stage.name for stage in result.stages] == ["split"]
    swapped = replace(carts(), control=Product((Box("b", 5.0, -5.0), ThrustBall("a", 5.0, size=1))))
    result = Solver(guess=Restart(solved)).solve(swapped)
    assert result.certified
    assert result.solution.cost == pytest.approx(solved.cost, abs=1e-10)
    assert result.stages[0].name == "smooth"


def test_neighbours_restart_together(solved):
    starts = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.01, 0.0, -0.01, 0.02]], dtype=torch.float64)
    family, solved_too = Family.of(solved.curve).restart(starts)
    assert bool(solved_too.all())
    assert float(family.collocation.residual(family.xi).norm(dim=-1).max()) < 1e-9


def switched(*, beside: ControlSet) -> OptimalControlProblem:
    """½∫x² + ½ b² with ẋ = a, ẏ = b, |a| ≤ 1: full speed to x = 0, then the singular arc a = 0; y at constant speed."""
    return OptimalControlProblem(
        name="switched",
        states={"x": 1, "y": 1},
        control=Product((beside, Box("a", 1.0, -1.0))),
        dynamics=lambda t, x, u, p: {"x": u.a, "y": u.b},
        running_cost=lambda t, x, u, p: 0.5 * x.x**2 + 0.5 * u.b**2,
        initial={"x": 1.0, "y": 0.0},
        final={"x": 0.0, "y": 1.0},
        final_time=2.0,
    )


@pytest.mark.parametrize(("beside", "arcs"), [
    (Unconstrained("b", 1), ["min", "singular"]),
    (Box("b", 3.0, -3.0), ["interior,min", "interior,singular"]),
])  # fmt: skip
def test_a_singular_arc_beside_another_control(beside, arcs):
    result = Solver().solve(switched(beside=beside))
    assert result.certified, result.message
    assert result.solution.arcs == arcs
    assert result.solution.cost == pytest.approx(1 / 6 + 1 / 4, abs=1e-11)
    assert result.solution.switch_times == pytest.approx([1.0], abs=1e-9)


def test_a_control_with_nothing_to_decide_is_said_to_be_so():
    """Two carts in least time, of which one arrives early whatever it does in between."""
    made = OptimalControlProblem(
        name="slack",
        states={"x": 1, "v": 1, "y": 1, "w": 1},
        control=Product((Box("a", 1.0, -1.0), Box("b", 1.0, -1.0))),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.a, "y": x.w, "w": u.b},
        running_cost=lambda t, x, u, p: torch.ones_like(t),
        initial={"x": 1.0, "v": 0.0, "y": 0.5, "w": 0.0},
        final={"x": 0.0, "v": 0.0, "y": 0.0, "w": 0.0},
        final_time=FreeTime(3.0),
    )
    result = Solver(n_starts=1).solve(made)
    assert not result.certified
    assert "all the time, so that this control has nothing to decide" in result.message
