"""Measurements as rows: exact Jacobians, exact data reproduced, noisy data pull, files in the units of a trajectory."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers import PROBLEMS, bvp_of, collocation, random, relative
from torch.func import jacrev

from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.quasi_newton import LBFGS
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.collocation import component_names
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.measurements import Measured, MeasurementFile, Measurements
from ponn_torch.solving.guess import RandomGuess, project
from ponn_torch.solving.solution import Solution

STOPPING = Stopping(tolerance=1e-12, decrease=1e-6)


def landing(n_segments=1):
    return collocation(bvp_of("mars_landing"), n_neurons=8, n_nodes=14, smoothing=1.0, n_segments=n_segments)


@cache
def solved(n_segments=1):
    made = landing(n_segments)
    start = project(made, RandomGuess(n_neurons=10).curve(made.bvp, 0))
    return made, LevenbergMarquardt(STOPPING).run(made, start).xi


def sampled(made, xi, names, n=8, noise=0.0):
    """Measurements of a curve, some of them missing."""
    curve = Curve(made, xi)
    t = torch.linspace(0.03, 0.97, n, dtype=torch.float64) * float(curve.times[-1])
    physical = torch.cat(made.bvp.to_physical(curve(t)), -1)
    problem = made.bvp.problem
    values = {}
    for i, name in enumerate(names):
        column = component_names(made.bvp).index(name)
        size = problem.unit(name.split("_")[0]) if not name.startswith("lambda") else 1.0
        values[name] = physical[:, column] + noise * size * torch.sin(7.0 * t + i)
    values[names[0]] = values[names[0]].index_fill(0, torch.tensor([2]), torch.nan)
    return Measurements(t * made.bvp.time_unit, values)


@pytest.mark.parametrize(("problem", "n_segments"), [("mars_landing", 3), ("minimum_time", 2), ("energy_transfer", 1)])
def test_the_jacobian_is_that_of_the_residual(problem, n_segments):
    smoothing = None if problem == "energy_transfer" else 1.0
    made = collocation(bvp_of(problem), smoothing=smoothing, n_segments=n_segments)
    xi = random(made.n_unknowns, seed=3)
    names = [component_names(made.bvp)[i] for i in (0, -1)]
    measured = Measured(made, sampled(made, xi, names, noise=0.1))
    r, jacobian = measured.linearise(xi)
    assert relative(r, measured.residual(xi)) < 1e-12
    step, oracle = 1e-6, torch.zeros_like(jacobian.dense())
    for i in range(len(xi)):
        ahead, behind = xi.clone(), xi.clone()
        ahead[i] += step
        behind[i] -= step
        oracle[:, i] = (measured.residual(ahead) - measured.residual(behind)) / (2 * step)
    assert relative(jacobian.dense(), oracle) < 1e-6


def test_rows_of_measurements_are_exact():
    made, xi = solved(2)
    measured = Measured(made, sampled(made, xi, ["r_1", "m", "lambda_v_2"], noise=0.1))
    dense = measured.linearise(xi)[1].dense()
    assert relative(dense, jacrev(measured.residual)(xi)) < 1e-11


def test_a_measurement_at_a_free_knot_has_the_slope_of_its_segment():
    made = collocation(bvp_of("minimum_time"), n_segments=2)
    made = replace(made, events=((0,),), setting=Setting(Regime(arcs=torch.tensor([[2], [0]]))))
    xi = random(made.n_unknowns, seed=3)
    column, end = made.n_weights + len(made.free_knots), float(made.known_times[-1])
    xi[column : column + 2] = torch.tensor([0.5 * end, end])  # the switch is at the measurement in the middle
    measured, step = Measured(made, sampled(made, xi, ["x"], n=9, noise=0.1)), 1e-6
    assert bool((measured._rows[0] == made.unpack(xi).times[1]).any())
    before = xi.clone()
    before[column] -= step  # the measurement stays in its segment
    here = measured.residual(xi)[: -made.n_extra]
    expected = (here - measured.residual(before)[: -made.n_extra]) / step
    slope = measured.linearise(xi)[1].dense()[: -made.n_extra, column]
    assert relative(slope, expected) < 1e-4


def test_exact_data_change_nothing():
    made, xi = solved()
    measured = Measured(made, sampled(made, xi, ["r_1", "v_2", "m", "lambda_m"]))
    assert float(measured.blocks(measured.residual(xi))["data"]) < 1e-12
    result = LevenbergMarquardt(STOPPING).run(measured, xi)
    assert relative(result.xi, xi) < 1e-6
    plain, with_data = made.blocks(made.residual(xi)), measured.blocks(measured.residual(xi))
    assert {name: float(value) for name, value in plain.items()} == {
        name: float(value) for name, value in with_data.items() if name != "data"
    }


@pytest.mark.parametrize("optimizer", [LevenbergMarquardt, LBFGS])
def test_noisy_data_pull_the_solution_towards_them_the_more_the_heavier(optimizer):
    made, xi = solved()
    data = sampled(made, xi, ["r_3", "v_3"], noise=0.05)
    misfits, equations = [], []
    for weight in (1e-6, 1e-2, 1e4):
        weights = dict.fromkeys(data.values, weight)
        measured = Measured(made, Measurements(data.times, data.values, weights))
        found = optimizer(Stopping(tolerance=1e-12, decrease=1e-5, max_iterations=60)).run(measured, xi).xi
        misfits.append(float(Measured(made, data).blocks(Measured(made, data).residual(found))["data"]))
        equations.append(float(made.residual(found).norm()))
    assert misfits[0] > misfits[1] > misfits[2]
    assert equations[0] < equations[1] < equations[2]
    assert misfits[2] < 0.6 * misfits[0]  # r and v are disturbed by themselves, and cannot both be met


def test_a_saved_trajectory_is_read_in_its_units(tmp_path):
    made, xi = solved()
    solution = Solution(Curve(made, xi))
    solution.save(tmp_path)
    problem = made.bvp.problem
    read = MeasurementFile(str(tmp_path / "trajectory.csv"), every=20).of(problem)
    assert set(read.values) == {"r_1", "r_2", "r_3", "v_1", "v_2", "v_3", "m"}
    expected = solution(read.times)
    torch.testing.assert_close(read.values["v_2"], expected.states["v"][:, 1], rtol=1e-9, atol=1e-9)
    costates = MeasurementFile(str(tmp_path / "trajectory.csv"), variables=["lambda_r"], weight=3.0).of(problem)
    assert set(costates.weights.items()) == {(f"lambda_r_{i}", 3.0) for i in (1, 2, 3)}
    measured = Measured(made, costates)
    assert float(measured.blocks(measured.residual(xi))["data"]) < 1e-7


def test_npz_files_hold_si(tmp_path):
    problem = PROBLEMS["energy_transfer"]()
    np.savez(tmp_path / "x.npz", t=np.array([0.0, 1e5]), r_1=np.array([1.0, np.nan]), other=np.zeros(2))
    read = MeasurementFile(str(tmp_path / "x.npz")).of(problem)
    assert read.times.tolist() == [0.0, 1e5]
    assert list(read.values) == ["r_1"]


@pytest.mark.parametrize(
    ("header", "told"),
    [
        ("time,r_1\n", "no column 't'"),
        ("t,r_9\n0,1\n", "nothing to take"),
        ("t [d],r_1 [mile]\n0,1\n", "r_1 in 'mile'"),
    ],
)
def test_files_that_say_something_else(header, told, tmp_path):
    path = tmp_path / "x.csv"
    path.write_text(header if header.count("\n") > 1 else header + "0,1\n")
    with pytest.raises(ValueError, match=told):
        MeasurementFile(str(path)).of(PROBLEMS["energy_transfer"]())
    with pytest.raises(ValueError, match="no such file"):
        MeasurementFile(str(tmp_path / "y.csv")).of(PROBLEMS["energy_transfer"]())


def test_errors_name_field_value_and_what_is_allowed():
    t = torch.zeros(2, dtype=torch.float64)
    for make, told in (
        (lambda: Measurements(t, {"r_1": t[:1]}), r"values.r_1 has shape \(1,\)"),
        (lambda: Measurements(t, {"r_1": t}, {"r_2": 1.0}), "weights.r_2: not measured"),
        (lambda: Measurements(t, {"r_1": t}, {"r_1": -1.0}), "weights.r_1 = -1.0"),
        (lambda: Measured(landing(), Measurements(t, {"q": t})), "measured 'q': no such component"),
        (lambda: MeasurementFile("x.csv", every=0), "every = 0; allowed: at least 1"),
    ):
        with pytest.raises(ValueError, match=told):
            make()
