"""A vertical lunar descent, free time, an engine that can be shut off: hovering pays at ρ = 1, and it is solved."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from scipy.optimize import root

from ponn_torch.cli import main

PROBLEM = """
from ponn_torch.optimal_control.control_laws import ThrustBall
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem


def descent(mass: float = 4000.0, guess: float = 70.0) -> OptimalControlProblem:
    flow = 1 / (311.0 * 9.80665)

    def dynamics(t, x, u, p):
        down = x.v.new_tensor([0.0, -1.62])
        return {"r": x.v, "v": down + u.thrust / x.m, "m": -flow * u.thrust_magnitude}

    return OptimalControlProblem(
        name="descent",
        states={"r": 2, "v": 2, "m": 1},
        control=ThrustBall("thrust", maximum=32e3, size=2),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: flow * u.thrust_magnitude,
        initial={"r": [0.0, 1500.0], "v": [0.0, -30.0], "m": mass},
        final={"r": [0.0, 0.0], "v": [0.0, 0.0]},
        final_time=FreeTime(guess),
        units={"r": 1500.0, "v": 1500.0 / guess, "m": mass, "time": guess, "cost": mass},
        costate_units={"r": flow * mass / guess, "v": flow * mass, "m": 1.0},
        mass="m",
        cost_name="fuel",
    )
"""


def fall_and_brake(mass: float, thrust: float = 32e3, gravity: float = 1.62) -> tuple[float, float]:
    """(switch time, fuel) of a free fall and a burn at full thrust that ends at rest on the ground."""
    exhaust = 311.0 * 9.80665
    flow = thrust / exhaust

    def misses(times):
        fall, burn = times
        v, h = -30.0 - gravity * fall, 1500.0 - 30.0 * fall - 0.5 * gravity * fall**2
        gain = exhaust * math.log(mass / (mass - flow * burn))
        climb = exhaust * burn - (mass / flow - burn) * gain  # ∫ of the gain
        return [v - gravity * burn + gain, h + v * burn - 0.5 * gravity * burn**2 + climb]

    found = root(misses, [20.0, 10.0], tol=1e-13)
    assert found.success
    return float(found.x[0]), flow * float(found.x[1])


def test_it_is_certified_from_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "moon.py").write_text(PROBLEM, encoding="utf-8")
    code = main(["problem=moon.py:descent", "record=minimal", "hydra.run.dir=out"])
    outcome = json.loads((tmp_path / "out" / "outcome.json").read_text(encoding="utf-8"))
    assert code == 0, outcome
    switch, fuel = fall_and_brake(4000.0)
    assert outcome["cost"] == pytest.approx(fuel, abs=1e-7)
    assert outcome["switch_times"] == pytest.approx([switch], abs=1e-6)
    # the run keeps the way to the file, not the place of it
    assert str(tmp_path) not in (tmp_path / "out" / "solution" / "solution.json").read_text(encoding="utf-8")
