"""Lunar descents in free time with an engine that can be shut off: no step of the solution may pay for hovering.

A vertical one is a free fall and a burn at full thrust, in closed form. Its primer is parallel to gravity and
may change its sign, where the direction of the smoothed thrust jumps. The run from the command line takes this file.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from scipy.optimize import root

from ponn_torch.cli import main
from ponn_torch.optimal_control.control_laws import Box, ThrustBall
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem
from ponn_torch.optimal_control.regularisers import Quadratic
from ponn_torch.solving.solver import Solver

GRAVITY, EXHAUST, MASS = 1.62, 311.0 * 9.80665, 4000.0


def descent(
    position: Sequence[float] = (0.0, 1500.0),
    velocity: Sequence[float] = (0.0, -30.0),
    thrust: float = 32e3,
    guess: float = 70.0,
) -> OptimalControlProblem:
    size, length = len(position), math.hypot(*position)

    def dynamics(t, x, u, p):
        down = x.v.new_tensor([0.0] * (size - 1) + [-GRAVITY])
        return {"r": x.v, "v": down + u.thrust / x.m, "m": -u.thrust_magnitude / EXHAUST}

    return OptimalControlProblem(
        name="descent",
        states={"r": size, "v": size, "m": 1},
        control=ThrustBall("thrust", maximum=thrust, size=size),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: u.thrust_magnitude / EXHAUST,
        initial={"r": list(position), "v": list(velocity), "m": MASS},
        final={"r": [0.0] * size, "v": [0.0] * size},
        final_time=FreeTime(guess),
        units={"r": length, "v": length / guess, "m": MASS, "time": guess, "cost": MASS},
        costate_units={"r": MASS / EXHAUST / guess, "v": MASS / EXHAUST, "m": 1.0},
        mass="m",
        cost_name="fuel",
    )


def fall_and_burn(height: float, speed: float, thrust: float) -> tuple[float, float]:
    """(switch time, fuel) of a free fall and a burn at full thrust that ends at rest on the ground."""
    flow = thrust / EXHAUST
    ground = (speed + math.sqrt(speed**2 + 2 * GRAVITY * height)) / GRAVITY

    def misses(times):
        fall, burn = times
        v, h = speed - GRAVITY * fall, height + speed * fall - 0.5 * GRAVITY * fall**2
        gain = EXHAUST * math.log(MASS / (MASS - flow * burn))
        climb = EXHAUST * burn - (MASS / flow - burn) * gain  # ∫ of the gain
        return [v - GRAVITY * burn + gain, h + v * burn - 0.5 * GRAVITY * burn**2 + climb]

    found = root(misses, [0.8 * ground, 0.2 * ground], tol=1e-13)
    assert found.success
    assert min(found.x) > 0
    return float(found.x[0]), flow * float(found.x[1])


def test_it_is_certified_from_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(__file__, tmp_path / "moon.py")
    code = main(["problem=moon.py:descent", "record=minimal", "hydra.run.dir=out"])
    outcome = json.loads((tmp_path / "out" / "outcome.json").read_text(encoding="utf-8"))
    assert code == 0, outcome
    switch, fuel = fall_and_burn(1500.0, -30.0, 32e3)
    assert outcome["cost"] == pytest.approx(fuel, abs=1e-7)
    assert outcome["switch_times"] == pytest.approx([switch], abs=1e-6)
    # the run keeps the way to the file, not the place of it
    assert str(tmp_path) not in (tmp_path / "out" / "solution" / "solution.json").read_text(encoding="utf-8")


@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize(
    ("height", "speed", "weights"),
    [(2650.0, -20.0, 20.0), (1200.0, 7.0, 4.6), (1700.0, -32.0, 5.6), (800.0, 1.6, 12.0)],
)
def test_a_vertical_descent_is_a_fall_and_a_burn(height, speed, weights, size):
    thrust = weights * MASS * GRAVITY
    across = [0.0] * (size - 1)
    result = Solver().solve(descent((*across, height), (*across, speed), thrust))
    assert result.certified, result.message
    assert result.n_starts == 1
    switch, fuel = fall_and_burn(height, speed, thrust)
    assert result.solution.switch_times == pytest.approx([switch], abs=1e-7)
    assert result.solution.cost == pytest.approx(fuel, abs=1e-8)


@pytest.mark.parametrize(
    ("position", "velocity", "weights"),
    [((1900.0, 510.0), (43.0, -58.0), 10.7), ((-1950.0, 3500.0), (5.0, -43.0), 5.3)],
)
def test_a_slanted_descent_does_not_depend_on_the_regulariser(position, velocity, weights):
    made = descent(position, velocity, weights * MASS * GRAVITY)
    other = replace(made, control=replace(made.control, regulariser=Quadratic()))
    results = [Solver().solve(problem) for problem in (made, other)]
    assert all(result.certified for result in results), [result.message for result in results]
    assert results[0].n_starts == 1
    assert results[0].solution.cost == pytest.approx(results[1].solution.cost, abs=1e-7)


@pytest.mark.parametrize("weight", [0.02, 0.5])
def test_a_cart_that_pays_little_for_time_coasts(weight):
    """Two thrusters bring it from rest to rest over d: bursts of t₁ = √(w d/(2 + w)) at both ends of t₁ + d/t₁."""
    distance = 2.6
    made = OptimalControlProblem(
        name="cart",
        states={"r": 1, "v": 1},
        control=Box("thrusters", 1.0, size=2),
        dynamics=lambda t, x, u, p: {"r": x.v, "v": u.thrusters[..., :1] - u.thrusters[..., 1:]},
        running_cost=lambda t, x, u, p: u.thrusters.sum(-1, keepdim=True) + weight,
        initial={"r": -distance, "v": 0.0},
        final={"r": 0.0, "v": 0.0},
        final_time=FreeTime(3.0),
    )
    result = Solver().solve(made)
    assert result.certified, result.message
    burst = math.sqrt(weight * distance / (2.0 + weight))
    assert result.solution.final_time == pytest.approx(burst + distance / burst, abs=1e-7)
    assert result.solution.cost == pytest.approx(2.0 * burst + weight * (burst + distance / burst), abs=1e-9)


def test_a_first_stage_that_settles_at_no_solution_is_tried_again_with_less_smoothing():
    """At ρ = 1 the direction of a thrust that is not small jumps where the vertical primer changes its sign."""
    result = Solver(coarse=1.0).solve(descent((0.0, 2650.0), (0.0, -20.0), 20.0 * MASS * GRAVITY))
    first, second = result.stages[:2]
    assert first.status.stationary
    assert first.norm > Solver().start_limit > second.norm
    assert [(stage.start, stage.smoothing) for stage in (first, second)] == [(0, 1.0), (0, 0.3)]
