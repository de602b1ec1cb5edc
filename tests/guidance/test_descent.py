"""Landers that replan from where they are arrive, whatever disturbs them within reason."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from ponn_torch.guidance.descent import PoweredDescent, Replanning, dispersed, land
from ponn_torch.guidance.plants.powered_descent import powered_descent
from ponn_torch.guidance.replanning import Fleet
from ponn_torch.guidance.storage import load_flight, save_flight
from ponn_torch.guidance.touchdown import Limits, certify_landing
from ponn_torch.problems.earth_mars import earth_mars
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver

CALM = Replanning(position_noise=0.0, velocity_noise=0.0, thrust_error=0.0)
DESCENT = powered_descent()
REFERENCE = "ponn_torch.guidance.plants.powered_descent:powered_descent"


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def planned() -> Solution:
    result = Solver().solve(DESCENT.planned, 0)
    assert result.certified
    assert result.solution is not None
    return result.solution


def test_undisturbed_the_plan_is_flown_to_its_switch_and_lands(planned: Solution, tmp_path: Path) -> None:
    one = torch.ones(1, dtype=torch.float64)
    records: list[Mapping[str, Any]] = []
    flown = land(DESCENT, planned, DESCENT.initial[None], one, how=CALM, on_cycle=records.append)
    assert float((flown.arrival - planned.final_time).abs().max()) < 1e-9
    assert float(flown.miss.max()) < 5e-3
    assert float(flown.impact.max()) < 2e-3
    # the last arc's acceleration is linear in time, not the plan's: nearly the same fuel
    assert float((flown.fuel / planned.cost - 1).abs().max()) < 1e-3
    assert flown.n_kept.sum() == flown.n_repaired.sum() == flown.n_late.sum() == 0
    assert flown.n_plans.tolist() == [7]
    assert len(flown.seconds_per_plan) == 7
    assert [record["cycle"] for record in records] == list(range(flown.n_cycles))
    # plans made warm are those made cold, and their bound is the margin's
    before = flown.times[:-1] < planned.switch_times[-1] - 0.1
    assert float(flown.thrust[before].max()) <= 0.95 * DESCENT.thrust_bounds[1] + 1e-6
    found = certify_landing(flown, {"planned": planned.cost, "optimal": planned.cost - 3.0}, n_samples=1)
    assert found.certified, found.verdict
    assert found.largest_error < 1e-8
    assert "of that for the margin, kg                                 3.000" in found.to_text()
    strict = certify_landing(flown, {"planned": 0.0, "optimal": 0.0}, n_samples=0, allowed=Limits(miss=1e-9))
    assert strict.verdict.startswith("not certified: ")
    assert strict.verdict.endswith("m off the target; allowed: 1e-09")
    save_flight(flown, tmp_path, reference=REFERENCE, arguments={})
    again = load_flight(tmp_path)
    assert torch.equal(again.states, flown.states)
    assert again.problem.margin == pytest.approx(0.05)
    header = (tmp_path / "flight.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header.startswith("t (s),r1 (m),")


def test_disturbed_landers_land_by_the_law_of_the_last_arc(planned: Solution) -> None:
    states, factors = dispersed(DESCENT, Replanning(), 5, seeded(3))
    assert float(states[:, :3].std(0).min()) > 5
    flown = land(DESCENT, planned, states, factors, how=Replanning(step=0.2), generator=seeded(1))
    assert float(flown.miss.max()) < 1.0
    assert float(flown.impact.max()) < 0.1
    found = certify_landing(flown, {"planned": 0.0, "optimal": 0.0}, flown, n_samples=0)
    assert (found.n_landed, found.n_landers, found.share) == (5, 5, 1.0)
    assert found.peak_thrust <= 1.0 + 1e-12
    # planned less often, the last plan followed to its end: what the law is for
    how = Replanning(cycle=4.0, step=0.25, last_arc="plan")
    by_plan = land(DESCENT, planned, states, factors, how=how, generator=seeded(1))
    assert float(by_plan.miss.min()) > 1.0


def test_a_plan_that_comes_too_late_is_dropped(planned: Solution) -> None:
    ticks = iter(range(1000))
    one = torch.ones(1, dtype=torch.float64)
    states = DESCENT.initial[None] + torch.tensor([20.0, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
    how = Replanning(cycle=3.0, step=0.5, deadline=0.5)
    flown = land(DESCENT, planned, states, one, how=how, generator=seeded(1), clock=lambda: float(next(ticks)))
    assert flown.n_late.tolist() == [int(flown.planned.sum())]
    assert float(flown.arrival[0]) == pytest.approx(planned.final_time, rel=1e-12)


def test_an_interrupted_descent_returns_what_was_flown(planned: Solution) -> None:
    def interrupt(record: Mapping[str, Any]) -> None:
        if record["cycle"] == 1:
            raise KeyboardInterrupt

    one = torch.ones(1, dtype=torch.float64)
    flown = land(DESCENT, planned, DESCENT.initial[None], one, how=Replanning(step=0.5), on_cycle=interrupt)
    assert not flown.completed
    assert (flown.n_cycles, flown.times.tolist()) == (2, [0.0, 0.5, 1.0, 1.5, 2.0])
    assert len(flown.states) == len(flown.commands) + 1 == 5


def test_the_dispersion_is_one_that_plans_have_to_deal_with(planned: Solution):
    states, _ = dispersed(DESCENT, Replanning(), 4, seeded(3))
    fleet = Fleet(planned, states)
    t = torch.full((4, 1), 3.0, dtype=torch.float64)
    before = fleet.thrust(t)
    fleet.plan([0, 1, 2, 3], states, 0.0)
    assert int(fleet.n_plans.sum() + fleet.n_repaired.sum()) == 4
    assert float((fleet.thrust(t) - before).norm(dim=-1).min()) > 10.0
    assert float((fleet.arrival - planned.final_time).abs().min()) > 1e-3


def test_bad_input_is_named() -> None:
    for wrong, text in (
        ({"gain": 0}, "gain = 0; allowed: above 0, at most 1"),
        ({"cycle": -1}, "cycle = -1 s; allowed: above 0"),
        ({"deadline": 0.0}, "deadline = 0.0 s; allowed: above 0, or null"),
        ({"thrust_error": -0.1}, "thrust_error = -0.1; allowed: at least 0"),
        ({"last_arc": "plann"}, "last_arc = 'plann'; allowed: linear_acceleration, plan .did you mean 'plan'"),
    ):
        with pytest.raises(ValueError, match=text):
            Replanning(**wrong)
    with pytest.raises(ValueError, match=r"earth_mars.*allowed: r \(3\), v \(3\), m \(1\) with a free final time"):
        PoweredDescent(earth_mars(), earth_mars(), torch.zeros(7, dtype=torch.float64))
    with pytest.raises(
        ValueError, match=r"planned_share = 0.3; allowed: above minimum_thrust / maximum_thrust = 0.375"
    ):
        powered_descent(planned_share=0.3)
