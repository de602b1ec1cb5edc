"""Plants that are not their models, and integral action: where loops come to rest, and what their plans promise."""

from __future__ import annotations

import pytest
import torch
from helpers import relative
from test_expansion import solver

from ponn_torch.guidance.accuracy import Allowed, certify
from ponn_torch.guidance.closed_loop import Flight, fly
from ponn_torch.guidance.controllers import GainSchedule, gain_schedule, timetable
from ponn_torch.guidance.expansion import derivatives
from ponn_torch.guidance.integral import with_integral
from ponn_torch.guidance.plants.clohessy_wiltshire import clohessy_wiltshire
from ponn_torch.guidance.plants.quadrotor import quadrotor
from ponn_torch.guidance.plants.shuttle import shuttle
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.tracking import TrackingProblem

PUSH = [1e-3, -1e-3, 5e-4]  # m/s²


def station_keeping(integral_weight: float) -> TrackingProblem:
    return clohessy_wiltshire(
        final_time=4000.0,
        initial_position=(100.0, 50.0, 50.0),
        initial_velocity=(0.0, 0.0, 0.0),
        integral_weight=integral_weight,
        flown={"disturbance": PUSH},
    )


def flown(problem: TrackingProblem) -> tuple[Flight, GainSchedule]:
    table = timetable(problem, "extend")
    schedule = gain_schedule(Planner(problem, solver(), Passes(1)), table)
    return fly(problem, schedule, table, problem.initial), schedule


def distance(flight: Flight) -> torch.Tensor:
    """From the target, m."""
    return flight.errors[..., :3].norm(dim=-1) / flight.problem.plant.states["r1"].size


def test_plain_tracking_comes_to_rest_where_its_gain_balances_the_push() -> None:
    problem = station_keeping(0.0)
    flight, schedule = flown(problem)
    zero = torch.zeros(1, dtype=torch.float64)
    _, jacobian, _ = derivatives(problem.plant.dynamics, zero, torch.zeros(1, 6).double(), torch.zeros(1, 3).double())
    a, b = jacobian[0, :, :6], jacobian[0, :, 6:]
    push = torch.tensor([0.0] * 3 + PUSH, dtype=torch.float64) * problem.plant.controls["a1"].size
    rest = torch.linalg.solve(a + b @ schedule.gain[0], -push)
    assert relative(flight.states[-1], rest) < 1e-6
    assert float(distance(flight)[-1]) == pytest.approx(25.26, abs=0.01)


@pytest.mark.parametrize("weight", [1e6, 1e7])
def test_integral_action_leaves_no_error_at_rest(weight: float) -> None:
    problem = station_keeping(weight)
    flight, _ = flown(problem)
    assert float(distance(flight)[-1]) < 1e-9  # m, of 25
    table = timetable(problem, "extend")
    found = certify(flight, Planner(problem, solver(), Passes(1)), table, n_samples=4, allowed=Allowed(1e-9))
    assert found.certified, found.verdict
    assert found.oracle == "matrix exponential"


def test_plans_approach_the_integral_constraint_as_one_over_the_weight() -> None:
    owed = torch.tensor([3e-6, -1e-6, 2e-6], dtype=torch.float64)
    errors = []
    for weight in (1e-3, 1e9, 1e11):
        problem = station_keeping(weight)
        plan = Planner(problem, solver(), Passes(1)).plan(0.0, torch.cat([problem.initial[:6], owed]))
        weights = plan.solution.solver.nodes.weights * plan.duration / 2
        errors.append(relative(weights @ plan.states[:, :3], -owed))
    assert errors[0] > 0.5  # nothing is asked for
    assert errors[1] < 2e-3
    assert errors[1] / errors[2] == pytest.approx(100.0, rel=0.01)


def test_integral_along_a_reference_that_moves() -> None:
    base = quadrotor(flown={"thrust": 0.95})
    problem = with_integral(base, ["z"], 100.0)
    assert list(problem.plant.states) == [*base.plant.states, "int_z"]
    assert problem.plant.states["int_z"].label == "m s"
    t = torch.tensor([0.3, 2.0], dtype=torch.float64)
    x, u = problem.reference(t)
    assert bool((x[:, 6] == 0).all())
    ahead = x + torch.tensor([0.0, 0.25, 0, 0, 0, 0, 0], dtype=torch.float64)
    assert problem.plant.dynamics(t, ahead, u)[:, 6].tolist() == pytest.approx([0.25, 0.25], abs=1e-12)
    assert problem.flown is not None
    weaker = base.plant.dynamics(t, x[:, :6], u * u.new_tensor([0.95, 1.0]))
    assert relative(problem.flown.dynamics(t, x, u)[:, :6], weaker) < 1e-14
    assert not problem.plant.linear


def test_flown_plants_differ_as_they_are_told() -> None:
    t = torch.zeros(2, dtype=torch.float64)
    problem = quadrotor(flown={"thrust": 0.9, "drag": 0.1, "disturbance": [0.0, -0.5]})
    x, u = torch.rand(2, 6).double(), torch.rand(2, 2).double() + 5
    expected = problem.plant.dynamics(t, x, u * u.new_tensor([0.9, 1.0]))
    expected[:, 3] -= 0.1 * x[:, 3]
    expected[:, 4] += -0.5 - 0.1 * x[:, 4]
    assert relative(problem.flying.dynamics(t, x, u), expected) < 1e-14
    entry = shuttle(flown={"density": 1.2})
    x, u = entry.reference(torch.full((2,), 0.5, dtype=torch.float64))
    model, true = (plant.limits["heat rate"](x, u) for plant in (entry.plant, entry.flying))
    assert relative(true, model * 1.2**0.5) < 1e-14
    lifted = shuttle(flown={"lift": 1.1, "drag": 1.1})
    thicker = shuttle(flown={"density": 1.1})
    assert relative(lifted.flying.dynamics(t, x, u), thicker.flying.dynamics(t, x, u)) < 1e-14
    assert shuttle(flown={"density": 1.0}).flown is None
    assert clohessy_wiltshire(flown={"thrust": 0.9}).flying.limits == {}


def test_wrong_settings_are_named() -> None:
    with pytest.raises(ValueError, match=r"'drga' is none of the plant's, allowed: density, lift, drag .did you mean"):
        shuttle(flown={"drga": 1.2})
    with pytest.raises(ValueError, match="disturbance is a list of 3 numbers"):
        clohessy_wiltshire(flown={"disturbance": [1.0]})
    with pytest.raises(ValueError, match="drag is a number"):
        shuttle(flown={"drag": "x"})
    with pytest.raises(ValueError, match=r"integral of 'r'; allowed: r1"):
        with_integral(clohessy_wiltshire(), ["r"], 1.0)
    with pytest.raises(ValueError, match=r"weight -1.0; allowed: some states, a weight above 0"):
        clohessy_wiltshire(integral_weight=-1.0)
