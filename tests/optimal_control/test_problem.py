"""A slip in the statement of a problem is named where it is made, with the nearest name."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import pytest
import torch
from helpers import PROBLEMS, problem, random

from ponn_torch.optimal_control.control_laws import Box, ThrustBall, Unconstrained
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import DisplayUnit, FreeTime, OptimalControlProblem


def statement(**changes: Any) -> dict[str, Any]:
    """A point in the plane, pushed from rest."""
    return {
        "name": "push",
        "states": {"position": 2, "velocity": 2},
        "control": Unconstrained("force", 2),
        "dynamics": lambda t, x, u, p: {"position": x.velocity, "velocity": u.force},
        "running_cost": lambda t, x, u, p: 0.5 * (u.force**2).sum(-1, keepdim=True),
        "initial": {"position": (0.0, 0.0), "velocity": 0.0},
        "final": {"position": (1.0, None)},
        "final_time": 1.0,
    } | changes


def rates(**changes: Any):
    return {"dynamics": lambda t, x, u, p: {"position": x.velocity, "velocity": u.force} | changes}


def bounded(minimum: str) -> dict[str, Any]:
    return {"control": Box("force", 1.0, minimum, size=2), "parameters": {"strength": -1.0}}


def one_argument(t: torch.Tensor) -> dict[str, torch.Tensor]:
    return {"position": t, "velocity": t}


SLIPS: list[tuple[dict[str, Any], str]] = [
    ({"initial": {"positoin": 0.0}}, "initial names 'positoin'; .*did you mean 'position'"),
    ({"final": {"velocitty": 0.0}}, "final names 'velocitty'; .*did you mean 'velocity'"),
    ({"units": {"tme": 2.0}}, r"units names 'tme'; .*did you mean 'time'"),
    ({"costate_units": {"time": 2.0}}, "costate_units names 'time'; allowed: position, velocity"),
    ({"units": {"velocity": 0.0}}, r"units\['velocity'\] = 0.0; a positive number"),
    ({"units": {"cost": math.inf}}, r"units\['cost'\] = inf; a positive number"),
    ({"costate_units": {"velocity": -1.0}}, r"costate_units\['velocity'\] = -1.0; a positive number"),
    ({"initial": {"position": (0.0, 0.0, 0.0)}}, r"initial\['position'\] has 3 entries; 2 are needed"),
    ({"final": {"position": (0.0, math.nan)}}, r"final\['position'\] = .*finite numbers or None"),
    ({"final_time": -1.0}, "final_time = -1.0 s; a positive number"),
    ({"final_time": 0.0}, "final_time = 0.0 s; a positive number"),
    ({"final_time": FreeTime(math.nan)}, "final_time = nan s; a positive number"),
    ({"final_time": "6"}, "final_time = '6' s; a positive number"),
    ({"units": {"time": "6"}}, r"units\['time'\] = '6'; a positive number"),
    ({"initial": {"position": ("0", 0.0)}}, r"initial\['position'\] = \('0', 0.0\); finite numbers"),
    ({"initial": {"position": torch.zeros(2)}}, r"initial\['position'\] = tensor.*; finite numbers"),
    ({"parameters": {"weight": "1"}}, r"parameters\['weight'\] = '1'; a finite number"),
    ({"display": {"q": 1}}, "display names 'q'; allowed: position, velocity, force, time, cost, origin"),
    ({"display": {"forse": DisplayUnit("N")}}, r"display names 'forse'; .*did you mean 'force'"),
    ({"display": {"position": 1e3}}, r"display\['position'\] = 1000.0; allowed: DisplayUnit\(label, size\)"),
    ({"display": {"time": ("d", 86400.0)}}, r"display\['time'\] = \('d', 86400.0\); allowed: DisplayUnit\(label"),
    (bounded("-1"), "minimum of the control 'force' = '-1'; allowed: a number, strength"),
    (bounded("strenth"), "minimum of the control 'force' = 'strenth'; .*did you mean 'strength'"),
    ({"running_cost": lambda t, x, u, p: 1.0}, r"running_cost returns shape \(\); \(..., 1\)"),
    ({"running_cost": None}, "running_cost and terminal_cost are both missing; nothing to minimise"),
    ({"mass": "velosity"}, "mass = 'velosity'; .*did you mean 'velocity'"),
    (rates(velocty=torch.zeros(5, 2)), "dynamics returns 'velocty'; .*did you mean 'velocity'"),
    ({"dynamics": lambda t, x, u, p: {"position": x.velocity}}, "dynamics returns no rate for 'velocity'"),
    (rates(velocity=torch.zeros(5, 3)), r"dynamics\['velocity'\] has shape \(5, 3\); \(..., 2\) is needed"),
    ({"running_cost": lambda t, x, u, p: u.force**2}, r"running_cost returns shape \(5, 2\); \(..., 1\)"),
    ({"running_cost": lambda t, x, u, p: (u.force**2).sum(-1)}, r"running_cost returns shape \(5,\)"),
    ({"terminal_cost": lambda x, p: x.position}, r"terminal_cost takes \(x, p\); terminal_cost\(t, x, p\) is expected"),
    ({"terminal_manifold": lambda t, x, u, p: x.position}, r"takes \(t, x, u, p\); terminal_manifold\(t, x, p\) is"),
    ({"running_cost": lambda t, x, u, p, *, k: t}, r"takes \(t, x, u, p, \*, k\); running_cost\(t, x, u, p\) is"),
    ({"dynamics": one_argument}, r"dynamics takes \(t\); dynamics\(t, x, u, p\) is expected"),
    ({"dynamics": None}, r"dynamics = None; a function dynamics\(t, x, u, p\) is expected"),
    ({"terminal_cost": 1.0}, r"terminal_cost = 1.0; a function terminal_cost\(t, x, p\) is expected"),
    ({"terminal_cost": lambda t, x, p: x.position}, r"terminal_cost returns shape \(5, 2\); \(..., 1\)"),
]


@pytest.mark.parametrize(("changes", "message"), SLIPS, ids=[message[:35] for _, message in SLIPS])
def test_slips_are_named_when_the_problem_is_stated(changes, message):
    OptimalControlProblem(**statement())
    with pytest.raises(ValueError, match=f"push: .*{message}"):
        OptimalControlProblem(**statement(**changes))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1e3,), "label = 1000.0; a text"),
        (("km", "1e3"), "size = '1e3'; a positive number"),
        (("km", 0.0), "size = 0.0; a positive"),
    ],
)
def test_a_unit_for_people_is_a_text_and_a_size(arguments, message):
    with pytest.raises(ValueError, match=f"DisplayUnit: {message}"):
        DisplayUnit(*arguments)


def test_all_that_people_see_may_have_a_unit():
    names = ("position", "velocity", "force", "force_magnitude", "time", "cost", "origin")
    control = ThrustBall("force", 1.0, size=2)
    display = {name: DisplayUnit("u", 10.0) for name in names}
    made = OptimalControlProblem(
        **statement(control=control, running_cost=lambda t, x, u, p: u.force_magnitude, display=display)
    )
    assert list(made.display) == list(names)


def test_functions_may_be_of_any_kind_that_takes_the_arguments():
    def energy(t, x, u, p, weight=0.5):
        return weight * (u.force**2).sum(-1, keepdim=True)

    class Terminal:
        def __call__(self, *arguments):
            return arguments[1].position[..., :1]

    for changes in (
        {"running_cost": energy},
        {"running_cost": partial(energy, weight=2.0)},
        {"terminal_cost": Terminal()},
    ):
        OptimalControlProblem(**statement(**changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"dynamics": lambda t, x, u, p: {"position": x.velosity, "velocity": u.force}},
            "no entry named 'velosity'; allowed: position, velocity .*'velocity'",
        ),
        (
            {"dynamics": lambda t, x, u, p: {"position": x.velocity, "velocity": u.forse}},
            "no entry named 'forse'; allowed: force .*'force'",
        ),
        (
            {"running_cost": lambda t, x, u, p: p.weigth * t, "parameters": {"weight": 1.0}},
            "no entry named 'weigth'; allowed: weight .*'weight'",
        ),
    ],
)
def test_names_that_functions_read_are_checked(changes, message):
    with pytest.raises(AttributeError, match=message):
        OptimalControlProblem(**statement(**changes))


def test_an_end_of_mass_below_zero_has_no_logarithm():
    falling = {
        "states": {"position": 2, "velocity": 2, "m": 1},
        "dynamics": lambda t, x, u, p: {"position": x.velocity, "velocity": u.force, "m": -0.1 * t},
        "initial": {"position": 0.0, "velocity": 0.0, "m": -1.0},
        "mass": "m",
    }
    made = OptimalControlProblem(**statement(**falling))
    with pytest.raises(ValueError, match="push: initial mass must be positive for mass_variable='log_mass'"):
        pontryagin(made)
    pontryagin(made, mass_variable="mass")


def test_a_law_without_closed_form_is_refused():
    made = OptimalControlProblem(**statement(running_cost=lambda t, x, u, p: (u.force**4).sum(-1, keepdim=True)))
    with pytest.raises(ValueError, match="'force': the Hamiltonian is not quadratic"):
        pontryagin(made)


def test_bounds_must_leave_room():
    made = OptimalControlProblem(
        **statement(
            control=ThrustBall("force", "strength", 2.0, size=2),
            parameters={"strength": 1.0},
            running_cost=lambda t, x, u, p: u.force_magnitude,
        )
    )
    with pytest.raises(ValueError, match=r"force: minimum = 2.0, maximum = strength; 0 ≤ minimum < maximum"):
        pontryagin(made)


def test_what_is_far_above_its_unit_is_named_with_a_unit_for_it():
    def hint(**changes: Any) -> str:
        return OptimalControlProblem(**statement(**changes)).scaling_hint()

    assert hint() == ""
    far = {"initial": {"position": (0.0, -7.3e6), "velocity": 2e3}}
    assert hint(**far) == (
        "initial position is 7.3e+06 of its unit, 1; unknowns should be of order one: set units['position'] to about "
        "7e+06"
    )
    assert hint(**far, units={"position": 1e7, "velocity": 1e3}) == ""
    assert "initial velocity is 2.0e+03 of its unit, 1" in hint(**far, units={"position": 1e7})
    assert "final_time is 8.6e+04 of its unit, 1; " in hint(final_time=FreeTime(86400.0))
    assert hint(final_time=86400.0, units={"time": 86400.0}) == ""


def test_boundary_data_are_filled_by_component():
    made = OptimalControlProblem(**statement())
    assert made.boundary("initial") == [0.0, 0.0, 0.0, 0.0]
    assert made.boundary("final") == [1.0, None, None, None]
    assert made.component_names == ["position_1", "position_2", "velocity_1", "velocity_2"]


@pytest.mark.parametrize("name", PROBLEMS)
def test_names_and_vectors_are_two_views(name):
    made = problem(name)
    x = random(3, made.n_states)
    named = made.named(x)
    assert torch.equal(made.stack(vars(named), x), x)
    assert [getattr(named, key).shape[-1] for key in made.states] == list(made.states.values())


def test_a_copy_with_other_ends_is_checked_again():
    made = OptimalControlProblem(**statement())
    assert made.with_boundary(final={"velocity": 1.0}).boundary("final") == [None, None, 1.0, 1.0]
    with pytest.raises(ValueError, match="final names 'speed'"):
        made.with_boundary(final={"speed": 1.0})
