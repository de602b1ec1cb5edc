"""Problems that are stated again share what was derived; those that say something else do not."""

from __future__ import annotations

import math
import sys
from collections import defaultdict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType, ModuleType

import numpy as np
import pytest
import torch
from helpers import PROBLEMS

from ponn_torch.ansatz.basis import LinearBasis, RandomFeatures
from ponn_torch.numerics.tape import RECORDING_PAYS
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_laws import ThrustBall
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.discretisation import discretise
from ponn_torch.optimal_control.meaning import LARGE, MOST, Keyed, meaning
from ponn_torch.optimal_control.pontryagin import pontryagin, probe_points
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


OWNER, ANOTHER = object(), object()


def key(value: object, owner: object = OWNER) -> Hashable:
    found = meaning(value, owner)
    assert hash(found) == hash(meaning(value, owner))
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


class Mutable:
    value = 1.0

    def at(self, x: float) -> float:
        return self.value * x


class Tagged(ThrustBall):
    """A frozen dataclass, and something besides."""


def tagged() -> Tagged:
    made = Tagged("thrust", 1.0)
    object.__setattr__(made, "tag", 1)
    return made


class Float(float):
    pass


OPAQUE = {
    "instance": Mutable(),
    "method of an instance": Mutable().at,
    "module": torch.nn.Linear(1, 1),
    "parameter": torch.nn.Parameter(torch.zeros(2)),
    "followed by autograd": torch.zeros(2, requires_grad=True),
    "large array": np.zeros(LARGE // 8 + 1),
    "large tensor": torch.zeros(LARGE // 8 + 1, dtype=torch.float64),
    "bfloat16": torch.zeros(2, dtype=torch.bfloat16),
    "sparse": torch.eye(2).to_sparse(),
    "masked": np.ma.array([1.0, 2.0], mask=[False, True]),
    "objects": np.array([object()]),
    "more than its fields": tagged(),
    "subclass of a number": Float(1.0),
    "default": defaultdict(list),
    "iterator": iter([1, 2]),
}


@pytest.mark.parametrize("name", OPAQUE)
def test_what_cannot_be_looked_into_stands_for_its_owner(name):
    """The same problem shares with itself, another one shares nothing, whatever became of the object."""
    for way in WAYS.values():
        assert key(way(OPAQUE[name])) == key(way(OPAQUE[name]))
        assert key(way(OPAQUE[name])) != key(way(OPAQUE[name]), ANOTHER)


def test_what_would_take_too_long_to_look_through_stands_for_its_owner():
    assert key(captures(list(range(MOST + 1)))) != key(captures(list(range(MOST + 1))), ANOTHER)


def test_other_views_of_numbers_are_told_by_their_content():
    base = torch.tensor([[1.0 + 1.0j, 2.0 - 1.0j], [3.0 + 0.5j, 4.0 - 2.0j]])
    assert key(captures(base.mT)) == key(captures(base.mT.contiguous()))
    assert key(captures(base.conj())) == key(captures(base.conj().resolve_conj()))
    assert key(captures(base.conj())) != key(captures(base))


def test_what_holds_itself_is_looked_through_once():
    one: list[object] = [1]
    one.append(one)
    other: list[object] = [1]
    other.append(other)
    assert key(captures(one)) == key(captures(other))


SOURCE = """
import math
import torch
from other_module import scale

GRAVITY = 9.8
def helper(x): return GRAVITY * x
def function(x): return torch.sqrt(helper(x)) * math.pi * scale(x)
def unrelated(x): return x
"""


def module(name: str, source: str) -> ModuleType:
    made = ModuleType(name)
    made.__file__ = f"{name}.py"
    exec(compile(source, made.__file__, "exec", dont_inherit=True), vars(made))
    return made


@pytest.fixture
def modules(monkeypatch):
    """A user's file that is run twice, with a module that it imports from."""

    def twice(source: str = SOURCE, factor: float = 1.0) -> ModuleType:
        monkeypatch.setitem(sys.modules, "other_module", module("other_module", f"def scale(x): return {factor} * x"))
        return module("stated", source)

    return twice


def test_a_file_that_is_run_again_says_the_same(modules):
    one, other = modules(), modules()
    assert one.function is not other.function
    assert key(one.function) == key(other.function, ANOTHER)


def test_a_global_that_changed_is_seen_where_it_is_read(modules):
    one = modules()
    before, apart = key(one.function), key(one.unrelated)
    one.GRAVITY = 1.6
    assert key(one.function) != before
    assert key(one.unrelated) == apart
    assert key(modules(SOURCE.replace("9.8", "1.6")).function) == key(one.function)


def test_a_function_of_another_module_is_looked_into(modules):
    assert key(modules().function) != key(modules(factor=2.0).function)


def test_what_is_read_from_a_module_counts():
    constants = module("constants", "G = 1.0")
    source = "import constants\ndef function(x): return constants.G * x"
    sys.modules["constants"] = constants
    try:
        stated = module("stated", source)
        before = key(stated.function)
        assert key(module("stated", source).function) == before
        constants.G = 2.0  # type: ignore[attr-defined]
        assert key(stated.function) != before
    finally:
        del sys.modules["constants"]


def test_an_attribute_is_no_global_of_the_same_name(modules):
    stated = modules("r = 1.0\ndef function(x): return x.r")
    before = key(stated.function)
    stated.r = object()
    assert key(stated.function, ANOTHER) == before


CHANGES = {
    "method of an instance": """
from dataclasses import dataclass
G = 1.0
@dataclass(frozen=True)
class Planet:
    name: str = "Mars"
    def gravity(self): return G
planet = Planet()
def function(x): return planet.gravity() * x
def change(): globals().update(G=2.0)
""",
    "inherited property": """
class Base:
    G = 1.0
    @property
    def gravity(self): return self.G
class Planet(Base):
    pass
def function(x): return Planet().gravity * x
def change(): Base.G = 2.0
""",
    "default of a dataclass": """
from dataclasses import dataclass
@dataclass(frozen=True)
class Vehicle:
    drag: float = 0.1
    @staticmethod
    def lift(): return Vehicle.factor
    factor = 1.0
def function(x): return Vehicle().lift() * x
def change(): Vehicle.factor = 2.0
""",
    "submodule": """
import package
def function(x): return package.inner.G * x
def change(): package.inner.G = 2.0
""",
    "captured module": """
import package
def make(module):
    def function(x): return module.inner.G * x
    return function
function = make(package)
def change(): package.inner.G = 2.0
""",
}


@pytest.mark.parametrize("where", CHANGES)
def test_a_change_is_seen_wherever_it_is_read(where, modules, monkeypatch):
    package = module("package", "")
    package.inner = module("package.inner", "G = 1.0")
    package.inner.package = package  # modules may hold each other
    monkeypatch.setitem(sys.modules, "package", package)
    stated = modules(CHANGES[where])
    monkeypatch.setitem(sys.modules, "stated", stated)
    before = key(stated.function)
    assert key(stated.function, ANOTHER) == before
    stated.change()
    assert key(stated.function) != before


def test_a_function_that_imports_stands_for_its_owner(modules):
    stated = modules("def function(x):\n    from other_module import scale\n    return scale(x)")
    assert key(stated.function) != key(stated.function, ANOTHER)


def test_a_class_is_itself():
    """The second solve of a session meets the classes and solutions that the first one left among the globals."""

    @dataclass(frozen=True)
    class Vehicle:
        drag: float = 0.1

    assert key(captures(Vehicle)) == key(captures(Vehicle), ANOTHER)
    assert key(captures(Vehicle)) != key(captures(Gravity))
    assert key(captures(Mutable)) == key(captures(Mutable), ANOTHER)


def test_a_list_that_was_changed_means_something_else():
    values = [1.0]
    before = key(captures(values))
    values.append(2.0)
    assert key(captures(values)) != before


def test_a_name_without_a_value_yet_is_told_apart():
    def make() -> Callable[[], float]:
        def function() -> float:
            return later

        before = meaning(function, OWNER)
        later = 1.0
        assert meaning(function, OWNER) != before
        return function

    assert key(make()) == key(make())


def test_keys_stand_for_values():
    assert Keyed((1, "a"), "one") == Keyed((1, "a"), "other")
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


def test_a_problem_whose_global_changed_is_another_one(modules):
    """The certificate would refuse what is solved with the equations from before."""
    source = """
GRAVITY = 9.8
def cart(problem):
    from dataclasses import replace
    def dynamics(t, x, u, p):
        return {"x": x.v, "v": u.force - GRAVITY * x.x}
    return replace(problem, dynamics=dynamics)
"""
    made = PROBLEMS["minimum_time"]()
    stated = modules(source)
    before = pontryagin(stated.cart(made))
    assert pontryagin(stated.cart(made)).equations == before.equations
    stated.GRAVITY = 1.6
    after = pontryagin(stated.cart(made))
    assert after.equations != before.equations
    t, w = probe_points(after, 3)
    setting = Setting(Regime(0.3 + t))
    assert torch.equal(Solver().discretisation(after).bvp.rates(t, w, setting), after.rates(t, w, setting))


def test_parameters_that_a_setting_leaves_out_are_the_problems():
    """They are data of a tape, not constants in it."""
    made = []
    for thrust in (13e3, 20e3):
        bvp = pontryagin(PROBLEMS["mars_landing"](maximum_thrust=thrust))
        disc, times = Solver().discretisation(bvp), torch.tensor([0.0, bvp.final_time], dtype=torch.float64)
        setting = Setting(Regime(torch.tensor(3.0, dtype=torch.float64)))
        made.append(Collocation.on_segments(disc, times, setting=setting))
    xi = 0.1 * torch.ones(made[0].n_unknowns, dtype=torch.float64)
    for _ in range(RECORDING_PAYS + 1):
        made[0].residual(xi)
    assert made[1].discretisation.replays is made[0].discretisation.replays
    assert torch.equal(made[1].residual(xi), made[1]._residual(xi))
    assert not torch.equal(made[1].residual(xi), made[0].residual(xi))


def test_dependences_found_by_probes_are_part_of_the_equations():
    """They may differ with the values of parameters: here F depends on r only where k is above 10."""

    def stated(k: float):
        made = PROBLEMS["minimum_time"]()

        def dynamics(t, x, u, p):
            return {"x": x.v, "v": u.force - torch.relu(p.k - 10.0) * torch.sin(x.x)}

        return pontryagin(replace(made, dynamics=dynamics, parameters={**made.parameters, "k": k}))

    assert stated(1.0).equations == stated(2.0).equations
    assert stated(1.0).equations != stated(20.0).equations


def test_a_discretisation_serves_no_other_equations():
    one, other = (pontryagin(PROBLEMS["mars_landing"](gravity=g)) for g in (3.7, 1.6))
    with pytest.raises(ValueError, match="its equations are not those of"):
        Solver().discretisation(one).serving(other)


def test_a_discretisation_serves_no_other_options():
    bvp = pontryagin(PROBLEMS["mars_landing"]())
    plain, single = bvp, pontryagin(PROBLEMS["mars_landing"](), chains=False)
    mass = pontryagin(PROBLEMS["mars_landing"](), mass_variable="mass")
    assert len({made.equations for made in (plain, single, mass)}) == 3
    disc = Solver().discretisation(bvp)
    assert discretise(bvp, disc.basis, disc.nodes, disc.form, "orthonormal").replays is not disc.replays


class Fourier(LinearBasis):
    """Sines of given frequencies, a basis of a user's own: it draws nothing, and is called with a list."""

    def __init__(self, frequencies: list[float]) -> None:
        super().__init__(len(frequencies))
        self.frequencies = frequencies

    @property
    def arguments(self) -> dict[str, list[float]]:
        return {"frequencies": self.frequencies}

    def features(self, z: torch.Tensor, order: int) -> torch.Tensor:
        k = z.new_tensor(self.frequencies)
        return torch.stack([k**e * torch.sin(k * (z[:, None] + 1) + 0.5 * math.pi * e) for e in range(order + 1)])


def test_a_basis_counts_by_what_it_is_called_with():
    bvp = pontryagin(PROBLEMS["mars_landing"]())
    one, same, other = Fourier([0.5, 1.0]), Fourier([0.5, 1.0]), Fourier([0.5, 1.5])
    first, second, third = (Solver(basis).discretisation(bvp) for basis in (one, same, other))
    assert first is second
    assert first.expressions.n_own > 0
    assert third is not first
    one.frequencies[1] = 1.5
    assert Solver(one).discretisation(bvp) is third
    assert first.basis.frequencies == [0.5, 1.0]


def test_the_callers_basis_stays_as_it_is():
    basis = RandomFeatures(8)
    before, bvp = basis.weight.clone(), pontryagin(PROBLEMS["mars_landing"](), dtype=torch.float32)
    disc = Solver(basis).discretisation(bvp)
    assert disc.basis.weight.dtype is torch.float32
    assert Solver(basis).discretisation(bvp) is disc
    assert torch.equal(basis.weight, before)
    assert basis.weight.dtype is torch.float64
    assert Solver(basis).discretisation(pontryagin(PROBLEMS["mars_landing"]())).basis is basis
