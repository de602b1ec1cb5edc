"""Methods that make solvers, oracles against each other, certificates, flights saved and loaded elsewhere."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import relative
from test_expansion import solver

from ponn_torch.ansatz.basis import GaussianRBF
from ponn_torch.guidance.accuracy import ORACLES, Allowed, GuidanceCertificate, certify, oracle_of
from ponn_torch.guidance.closed_loop import Flight, fly
from ponn_torch.guidance.controllers import HorizonController, Timetable, gain_schedule, timetable
from ponn_torch.guidance.methods import Pseudospectral, RandomGaussians, TunedGaussians, first_horizon
from ponn_torch.guidance.plants.clohessy_wiltshire import clohessy_wiltshire
from ponn_torch.guidance.plants.quadrotor import quadrotor
from ponn_torch.guidance.plants.shuttle import shuttle
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.storage import load_flight, make_problem, save_flight
from ponn_torch.numerics.particle_swarm import ParticleSwarm

CW = "ponn_torch.guidance.plants.clohessy_wiltshire:clohessy_wiltshire"


def test_each_question_has_its_oracle() -> None:
    many = Passes(10)
    assert oracle_of(Planner(clohessy_wiltshire(), solver(), many)) == "matrix exponential"
    assert oracle_of(Planner(shuttle(), solver(), Passes(1))) == "Riccati sweep"
    assert oracle_of(Planner(quadrotor(), solver(), many)) == "solve_bvp"


def test_oracles_agree_with_each_other_and_with_many_nodes() -> None:
    problem = clohessy_wiltshire(horizon=300.0)
    planner = Planner(problem, solver(), Passes(1))
    lengths = [problem.horizon, problem.horizon / 2]
    states = torch.stack([problem.initial, 0.5 * problem.initial])
    exact, swept = (ORACLES[name](planner, [0.0, 0.1], lengths, states) for name in list(ORACLES)[:2])
    assert relative(swept, exact) < 1e-10
    problem = quadrotor()
    planner = Planner(problem, solver(24), Passes(1))
    swept = ORACLES["Riccati sweep"](planner, [0.0], [problem.horizon], problem.initial[None])[0]
    assert relative(planner.plan(0.0, problem.initial).control, swept) < 5e-6  # of 24 nodes


def test_certificate_tells_a_true_error_from_a_loss() -> None:
    problem = quadrotor()
    table = Timetable(timetable(problem, "stop").starts[:20], [problem.horizon] * 20)
    errors, losses = [], []
    for n_nodes in (6, 10, 16):
        planner = Planner(problem, solver(n_nodes), Passes(1))
        flight = fly(problem, gain_schedule(planner, table), table, problem.initial)
        found = certify(flight, planner, table, n_samples=3, allowed=Allowed(oracle=2e-3))
        assert found.cycles == [0, 10, 19]
        errors.append(found.largest_error)
        losses.append(max(found.losses))
        assert found.certified is (n_nodes > 6)
        assert ("not certified" in found.verdict) is (n_nodes == 6)
    assert errors[0] > 10 * errors[1] > 100 * errors[2]
    assert max(losses) < 4e-10  # whatever the basis is worth
    text = found.to_text()
    assert "Riccati sweep" in text
    assert json.loads(json.dumps(found.to_dict()))["median_error"] == found.median_error
    unfinished = certify(replace(flight, completed=False), planner, table, n_samples=1)
    assert unfinished.verdict == "not certified: the flight was interrupted"
    late = certify(replace(flight, late=torch.ones(20, dtype=torch.bool)), planner, table)
    assert late.verdict == "not certified: no decision was checked"


def test_what_nodes_leave_is_told_from_what_passes_leave() -> None:
    problem = quadrotor()
    table = Timetable(timetable(problem, "stop").starts[:4], [problem.horizon] * 4)

    def found(passes: Passes, allowed: Allowed) -> GuidanceCertificate:
        planner = Planner(problem, solver(), passes)
        flight = fly(problem, HorizonController(planner, table), table, problem.initial)
        return certify(flight, planner, table, n_samples=2, allowed=allowed)

    newton = found(Passes(10, 1e-6, second_order=True, warm_start=True), Allowed(oracle=2e-3, iteration=1e-10))
    assert newton.certified, newton.verdict
    assert newton.largest_error > 1e5 * newton.largest_iteration_error  # ten nodes, and Newton's method to the end
    few = found(Passes(4), Allowed(oracle=1.0, iteration=1e-5))
    assert few.verdict.startswith("not certified: a control is ")
    assert few.verdict.endswith("off the limit of its passes; allowed: 1e-05")
    assert 1e-4 < few.largest_iteration_error < 0.1
    with pytest.raises(ValueError, match=r"iteration_error = 0.0; allowed: above 0"):
        Allowed(iteration=0.0)


# -- methods -----------------------------------------------------------------------------------------


def test_swarm_that_minimises_round_off_finds_noise_and_an_honest_one_does_not() -> None:
    problem = clohessy_wiltshire(horizon=100.0)
    results = {}
    for objective in ("loss", "off_node_residual"):
        swarm = ParticleSwarm(n_particles=30, n_iterations=30)
        tuned = TunedGaussians(objective=objective, swarm=swarm).solver(problem, 0)
        assert isinstance(tuned.basis, GaussianRBF)
        planner = Planner(problem, tuned, Passes(1))
        plan = planner.plan(0.0, problem.initial)
        truth = ORACLES["matrix exponential"](planner, [0.0], [problem.horizon], problem.initial[None])[0]
        results[objective] = float(plan.solution.loss), relative(plan.control, truth)
    assert results["loss"][0] < 1e-13
    assert results["off_node_residual"][0] < 1e-12
    assert results["loss"][1] > 5 * results["off_node_residual"][1]
    with pytest.raises(ValueError, match=r"objective = 'los'; allowed: loss, off_node_residual"):
        TunedGaussians(objective="los")


def test_singular_shapes_cost_infinity() -> None:
    problem = clohessy_wiltshire()
    swarm = ParticleSwarm(n_particles=4, n_iterations=2, lower=0.0, upper=1e-200)  # φ = 1 everywhere
    for objective in ("loss", "off_node_residual"):
        tuned = TunedGaussians(objective=objective, swarm=swarm).solver(problem, 0)
        assert tuned.solve(first_horizon(problem, tuned.nodes)).loss.isinf()


def test_random_and_pseudospectral_methods() -> None:
    problem = clohessy_wiltshire()
    drawn = [RandomGaussians().solver(problem, seed).basis for seed in (0, 0, 1)]
    assert torch.equal(drawn[0].centres, drawn[1].centres)
    assert not torch.equal(drawn[0].shape, drawn[2].shape)
    radau = Pseudospectral("legendre_radau").solver(problem, 0)
    planner = Planner(problem, radau, Passes(1))
    truth = ORACLES["matrix exponential"](planner, [0.0], [problem.horizon], problem.initial[None])[0]
    assert relative(planner.plan(0.0, problem.initial).control, truth) < 1e-11


# -- storage -----------------------------------------------------------------------------------------


def flown() -> Flight:
    problem = clohessy_wiltshire(horizon=120.0)
    table = timetable(problem, "stop")
    table = Timetable(table.starts[:4], table.durations[:4])
    return fly(problem, HorizonController(Planner(problem, solver()), table), table, problem.initial)


def test_flights_are_loaded_in_a_fresh_process(tmp_path: Path) -> None:
    flight = flown()
    save_flight(flight, tmp_path / "flight", reference=CW, arguments={"horizon": 120.0})
    code = (
        "from ponn_torch.guidance.storage import load_flight; f = load_flight('flight');"
        "print(f.n_cycles, float(f.errors[-1].norm()), f.problem.plant.name, f.completed)"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    count, norm, name, completed = run.stdout.split()
    assert (int(count), float(norm)) == (4, float(flight.errors[-1].norm()))
    assert (name, completed) == ("clohessy_wiltshire", "True")
    lines = (tmp_path / "flight" / "flight.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("t (s),r1 (m),")
    assert len(lines) == 5
    assert [float(value) for value in lines[1].split(",")[:3]] == pytest.approx([0.0, 7047.0, 5136.0])


def test_what_cannot_be_loaded_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no flight in"):
        load_flight(tmp_path)
    save_flight(flown(), tmp_path, reference=CW, arguments={"semi_major_axis": 8e6})
    with pytest.raises(ValueError, match=r"units = .*; allowed: .* of clohessy_wiltshire"):
        load_flight(tmp_path)
    with pytest.raises(ValueError, match=r"problem = 'os:system'; allowed: functions of ponn_torch.guidance.plants"):
        make_problem("os:system", {"command": "true"})
    text = (tmp_path / "flight.json").read_text(encoding="utf-8")
    (tmp_path / "flight.json").write_text(text.replace('"format": 1', '"format": 9'), encoding="utf-8")
    with pytest.raises(ValueError, match="format = 9; allowed: 1"):
        load_flight(tmp_path)
