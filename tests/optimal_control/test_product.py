"""Several controls at once are minimised as each would be alone, and solved to exact answers."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ponn_torch.optimal_control.control_laws import Box, ThrustBall, Unconstrained
from ponn_torch.optimal_control.control_set import INTERIOR, LOWER, UPPER, ControlSet, Regime
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.optimal_control.product import Product
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
    assert {name for name in others.control if not torch.equal(*others.control[name][[0, -1]])}


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


def test_controls_that_h_couples_are_refused():
    law = Product((Box("speed", 2.0), Box("turn", 1.0, -1.0)))
    one = torch.ones(2, 1, dtype=torch.float64)
    with torch.no_grad(), pytest.raises(ValueError, match="controls 'speed' and 'turn': the Hamiltonian is no sum"):
        law.adapted(lambda speed, turn: speed * turn, lambda speed, turn: speed, NONE, one, 1.0)


def test_a_name_stands_for_one_control():
    with pytest.raises(ValueError, match="several controls are called 'u'"):
        Product((Box("u", 2.0), Unconstrained("u", 1)))
    with pytest.raises(ValueError, match="none given"):
        Product(())


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
