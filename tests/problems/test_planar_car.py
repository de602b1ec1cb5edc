"""Two controls of different kinds: straight ahead the answer is known, and both ways to state them agree."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.problems.planar_car import planar_car
from ponn_torch.solving.solver import Solver


@pytest.mark.parametrize(("heading", "distance", "acceleration"), [(0.0, 4.0, 1.0), (0.7, 3.0, 2.0)])
def test_straight_ahead_it_is_bang_bang(heading, distance, acceleration):
    ahead = (distance * math.cos(heading), distance * math.sin(heading))
    made = planar_car(
        final_position=ahead, initial_heading=heading, final_heading=heading, maximum_acceleration=acceleration
    )
    result = Solver().solve(made)
    assert result.certified, result.message
    time = 2 * math.sqrt(distance / acceleration)
    assert result.solution.cost == pytest.approx(time, abs=1e-11)
    assert result.solution.switch_times == pytest.approx([time / 2], abs=1e-10)
    assert made.known_cost is None


@pytest.mark.parametrize(("bound", "arcs"), [(2.0, ["max,interior", "min,interior"]), (0.5, None)])
def test_one_box_says_what_two_controls_say(bound, arcs):
    """A bound that binds makes more arcs, and costs more than none."""
    two = planar_car(maximum_turn=bound)

    def dynamics(t, x, u, p):
        acceleration, turn = u.u.split(1, -1)
        ahead = torch.cat([torch.cos(x.heading), torch.sin(x.heading)], -1)
        return {"r": x.speed * ahead, "heading": turn, "speed": acceleration}

    one = replace(
        two,
        control=Box("u", (1.0, bound), (-1.0, -bound), size=2),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: 1.0 + 0.5 * u.u[..., 1:] ** 2,
    )
    results = [Solver().solve(problem) for problem in (one, two)]
    assert all(result.certified for result in results), [result.message for result in results]
    first, second = (result.solution for result in results)
    assert first.cost == pytest.approx(second.cost, abs=1e-11)
    assert first.switch_times == pytest.approx(second.switch_times, abs=1e-9)
    assert first.arcs == second.arcs
    if arcs is None:
        assert first.cost > 3.801260863077 + 5e-4
        assert len(first.arcs) > 2
    else:
        assert first.arcs == arcs
        assert first.cost == pytest.approx(3.801260863077, abs=1e-11)
