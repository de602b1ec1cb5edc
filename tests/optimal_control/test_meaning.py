"""Problems that are stated again share what was derived; those that say something else do not."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
import pytest
import torch
from helpers import PROBLEMS

from ponn_torch.optimal_control.control_laws import ThrustBall
from ponn_torch.optimal_control.discretisation import discretise
from ponn_torch.optimal_control.meaning import LARGE, Keyed, meaning
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.solving.solver import Solver


def captures(value: object) -> Callable[[float], object]:
    return lambda x: (x, value)


def by_default(value: object) -> Callable[..., object]:
    def function(x: float, y: object = value, *, z: object = 1) -> object:
        return x, y, z

    return function


def by_keyword(value: object) -> Callable[..., object]:
    def function(x: float, *, z: object = value) -> object:
        return x, z

    return function


def calls(value: object) -> Callable[..., object]:
    inner = captures(value)
    return lambda x: inner(2 * x)


def recursive(value: object) -> Callable[[int], object]:
    def function(n: int) -> object:
        return function(n - 1) if n else value

    return function


@dataclass(frozen=True)
class Gravity:
    value: object

    def at(self, x: float) -> object:
        return self.value


WAYS = {
    "captured": captures,
    "default": by_default,
    "keyword": by_keyword,
    "by another function": calls,
    "by itself": recursive,
    "partial": lambda value: partial(captures, value),
    "method": lambda value: Gravity(value).at,
    "dataclass": Gravity,
    "in a list": lambda value: captures([1, {"a": value}]),
    "proxy": lambda value: captures(MappingProxyType({"a": value})),
}
PAIRS = [
    (1.5, 1.5, 1.6),
    (1, 1, 1.0),
    (1, 1, True),
    (math.nan, math.nan, 0.0),
    ("a", "a", "b"),
    ((1, 2), (1, 2), [1, 2]),
    (np.array([1.0, 2.0]), np.array([1.0, 2.0]), np.array([1.0, 2.5])),
    (np.float64(2.0), np.float64(2.0), np.float32(2.0)),
    (torch.tensor([1.0, 2.0]), torch.tensor([1.0, 2.0]), torch.tensor([[1.0, 2.0]])),
    (ThrustBall("thrust", 1.0), ThrustBall("thrust", 1.0), ThrustBall("thrust", 2.0)),
]


def key(value: object) -> Hashable:
    found = meaning(value)
    assert hash(found) == hash(meaning(value))
    return found


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("values", PAIRS, ids=[str(one) for one, _, _ in PAIRS])
def test_a_function_means_its_code_and_what_it_captured(way, values):
    one, same, other = (key(WAYS[way](value)) for value in values)
    assert one == same
    assert one != other


def test_functions_of_other_code_mean_something_else():
    assert key(lambda x: x + 1) != key(lambda x: x + 2)
    assert key(captures(1)) != key(by_default(1))


def test_what_cannot_be_looked_into_is_itself_alone():
    class Mutable:
        pass

    one, other = Mutable(), Mutable()
    large = np.zeros(LARGE // 8 + 1)
    weights = torch.nn.Parameter(torch.zeros(2))
    for value, copy in ((one, other), (large, large.copy()), (weights, torch.nn.Parameter(torch.zeros(2)))):
        assert key(captures(value)) == key(captures(value))
        assert key(captures(value)) != key(captures(copy))


def test_a_list_that_was_changed_means_something_else():
    values = [1.0]
    before = key(captures(values))
    values.append(2.0)
    assert key(captures(values)) != before


def test_a_name_without_a_value_yet_is_told_apart():
    def make() -> Callable[[], float]:
        def function() -> float:
            return later

        before = meaning(function)
        later = 1.0
        assert meaning(function) != before
        return function

    assert key(make()) == key(make())


def test_keys_stand_for_values():
    assert Keyed((1, "a"), object()) == Keyed((1, "a"), object())
    assert Keyed((1, "a"), 1) != Keyed((1, "b"), 1)


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_problem_stated_again_shares_its_discretisation(name):
    one, other = pontryagin(PROBLEMS[name]()), pontryagin(PROBLEMS[name]())
    assert one is not other
    first, second = (Solver().discretisation(bvp) for bvp in (one, other))
    assert first.replays is second.replays
    assert first.expressions is second.expressions
    assert (first.bvp, second.bvp) == (one, other)


@pytest.mark.parametrize(
    "changes",
    [
        {"gravity": 1.62},
        {"specific_impulse": 300.0},
        {"switching_level": 0.1},
        {"regulariser": "quadratic"},
        {"initial_mass": 2000.0},
        {"free_final_time": True},
        {"final_time": 50.0},
    ],
)
def test_other_equations_share_nothing(changes):
    one, other = pontryagin(PROBLEMS["mars_landing"]()), pontryagin(PROBLEMS["mars_landing"](**changes))
    assert one.equations != other.equations


@pytest.mark.parametrize(
    "changes",
    [{"initial_position": (300.0, 0.0, 1600.0)}, {"maximum_thrust": 12e3}, {"known_cost": 1.0}, {"name": "x"}],
)
def test_other_ends_and_parameters_are_the_same_equations(changes):
    one, other = pontryagin(PROBLEMS["mars_landing"]()), pontryagin(PROBLEMS["mars_landing"](**changes))
    assert one.equations == other.equations
    assert other.problem.known_cost != one.problem.known_cost or "known_cost" not in changes


def test_a_free_end_is_another_problem_than_a_known_one():
    made = PROBLEMS["mars_landing"]()
    freed = replace(made, final={"r": made.final["r"]})
    assert pontryagin(freed).equations != pontryagin(made).equations


def test_a_discretisation_serves_no_other_options():
    bvp = pontryagin(PROBLEMS["mars_landing"]())
    plain, single = bvp, pontryagin(PROBLEMS["mars_landing"](), chains=False)
    mass = pontryagin(PROBLEMS["mars_landing"](), mass_variable="mass")
    assert len({made.equations for made in (plain, single, mass)}) == 3
    disc = Solver().discretisation(bvp)
    assert discretise(bvp, disc.basis, disc.nodes, disc.form, "orthonormal").replays is not disc.replays
