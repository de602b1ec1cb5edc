"""Landers that replan from where they are arrive, whatever disturbs them within reason."""

from __future__ import annotations

import pytest
import torch

from ponn_torch.guidance.descent import Disturbances, Replanning, dispersed, land
from ponn_torch.guidance.replanning import Fleet
from ponn_torch.problems.earth_mars import earth_mars
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver

DATA = {
    "initial_position": (-900.0, 100.0, 1500.0),
    "initial_velocity": (30.0, -10.0, -70.0),
    "mass_flow_per_thrust": 5.0863e-4,
    "free_final_time": True,
    "final_time": 45.0,
}
CALM = Disturbances(thrust_error=0.0, position=0.0, velocity=0.0, position_noise=0.0, velocity_noise=0.0)


@pytest.fixture(scope="module")
def planned() -> Solution:
    result = Solver().solve(mars_landing(**DATA, maximum_thrust=0.95 * 13258.18), 0)
    assert result.certified
    return result.solution


def test_undisturbed_the_plan_is_flown_to_its_switch_and_lands(planned):
    problem = mars_landing(**DATA)
    states, factors = dispersed(problem, CALM, 1)
    assert torch.equal(factors, torch.ones(1, dtype=torch.float64))
    flown = land(problem, planned, states, factors, noise=CALM)
    assert float((flown.arrival - planned.final_time).abs().max()) < 1e-6
    assert float(flown.miss.max()) < 0.05
    assert float(flown.impact.max()) < 0.05
    # the last arc's acceleration is linear in time, not the plan's: nearly the same fuel
    assert float((flown.fuel / planned.cost - 1).abs().max()) < 5e-3
    assert flown.n_kept.sum() == flown.n_repaired.sum() == 0
    assert flown.n_plans.tolist() == [7]


def test_disturbed_landers_land(planned):
    problem = mars_landing(**DATA)
    states, factors = dispersed(problem, Disturbances(), 8, seed=3)
    assert float(states[:, :3].std(0).min()) > 5
    flown = land(problem, planned, states, factors)
    assert float(flown.miss.max()) < 1.0
    assert float(flown.impact.max()) < 0.1


def test_without_plans_from_the_flown_state_they_do_not(planned):
    """The dispersion is one that replanning has to deal with: the nominal plan alone misses by far."""
    problem = mars_landing(**DATA)
    states, _ = dispersed(problem, Disturbances(), 4, seed=3)
    fleet = Fleet(planned, states)
    t = torch.full((4, 1), 3.0, dtype=torch.float64)
    before = fleet.thrust(t)
    fleet.plan([0, 1, 2, 3], states, 0.0)
    assert int(fleet.n_plans.sum() + fleet.n_repaired.sum()) == 4
    assert float((fleet.thrust(t) - before).norm(dim=-1).min()) > 10.0
    assert float((fleet.arrival - planned.final_time).abs().min()) > 1e-3


def test_bad_input_is_named(planned):
    with pytest.raises(ValueError, match="gain = 0; allowed: above 0, at most 1"):
        Replanning(gain=0)
    with pytest.raises(ValueError, match=r"cycle = -1 s; allowed: above 0"):
        Replanning(cycle=-1)
    transfer = Solver(refinement=None).solve(earth_mars(), 2).solution
    with pytest.raises(ValueError, match=r"earth_mars.*allowed: r \(3\), v \(3\), m \(1\) with a free final time"):
        Fleet(transfer, torch.ones(1, 7, dtype=torch.float64))
