"""The energy-optimal descent against its polynomial solution."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

from ponn_torch.problems.energy_landing import best_time, descent_energy, energy_landing
from ponn_torch.solving.solver import Solver

START = (-200.0, 100.0, 1500.0), (85.0, -50.0, -65.0)


def energy_by_quadrature(time: float) -> float:
    """½∫|r̈ − g|² of the cubic Hermite interpolant."""
    (r, v), t = (np.array(x)[:, None] for x in START), (np.arange(20000) + 0.5) * time / 20000
    acceleration = -4 * v / time - 6 * r / time**2 + (6 * v / time**2 + 12 * r / time**3) * t
    acceleration[2] += 3.7114
    return 0.5 * float((acceleration**2).sum()) * time / 20000


@pytest.mark.parametrize("price", [0.0, 5.0])
def test_the_best_time_is_the_cheapest(price):
    found = minimize_scalar(
        lambda t: price * t + energy_by_quadrature(t), bounds=(20.0, 80.0), method="bounded", options={"xatol": 1e-9}
    )
    time = best_time(*START, 3.7114, price)
    assert time == pytest.approx(found.x, abs=1e-5)
    assert price * time + descent_energy(*START, 3.7114, time) == pytest.approx(found.fun, rel=1e-8)


@pytest.mark.parametrize("arguments", [{"time_price": 5.0}, {"free_final_time": False, "final_time": 60.0}])
def test_descents_are_solved_to_the_polynomial(arguments):
    problem = energy_landing(**arguments)
    result = Solver().solve(problem)
    assert result.certified, result.message
    assert result.solution.cost == pytest.approx(problem.known_cost, rel=1e-10)
    time = result.solution.final_time
    assert time == pytest.approx(arguments.get("final_time") or best_time(*START, 3.7114, 5.0), abs=1e-6)
    # r̈ is linear in time: at the start −4v/T − 6r/T² less gravity
    acceleration = result.solution(0.0).control["acceleration"].flatten()
    r, v = (torch.tensor(x, dtype=torch.float64) for x in START)
    expected = -4 * v / time - 6 * r / time**2 + torch.tensor([0.0, 0.0, 3.7114], dtype=torch.float64)
    torch.testing.assert_close(acceleration, expected, rtol=1e-6, atol=1e-6)


def test_slips_are_named():
    with pytest.raises(ValueError, match=r"time_price = 0.0, gravity = 0.0; allowed: from 0, not both 0"):
        energy_landing(gravity=0.0)
    with pytest.raises(ValueError, match="at rest on the target"):
        energy_landing(initial_position=(0.0, 0.0, 0.0), initial_velocity=(0.0, 0.0, 0.0))
