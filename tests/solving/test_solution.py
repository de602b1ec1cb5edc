"""Solutions are what they were solved to be, and come back from disk bit by bit in another process."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import minimum_energy, minimum_time, soft_end, solve, solve_minimum_time, solve_saturated
from helpers import random

from ponn_torch.ansatz.basis import Chebyshev, GaussianRBF, Legendre, RandomFeatures
from ponn_torch.ansatz.networks import MLP, FrozenMLP
from ponn_torch.ansatz.switch_neurons import SwitchNeuronBasis
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.problem import FreeTime, ProblemOrigin
from ponn_torch.optimal_control.references import load_problem
from ponn_torch.optimal_control.regularisers import REGULARISERS, make_regulariser
from ponn_torch.solving.guess import project
from ponn_torch.solving.solution import Samples, Solution, in_a_row

ANALYTIC = Path(__file__).with_name("analytic.py")
REST = [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]

LOAD = """
import sys, numpy as np
from ponn_torch.solving.solution import Solution
for folder in sys.argv[1:]:
    s = Solution.load(folder).sample(50)
    np.savez(f"{folder}.npz", t=s.t, S=s.switching, H=s.hamiltonian,
             **{f"{g}/{n}": v for g in ("states", "costates", "control") for n, v in getattr(s, g).items()})
"""


def flat(samples: Samples) -> dict[str, torch.Tensor]:
    groups = {"states": samples.states, "costates": samples.costates, "control": samples.control}
    values = {f"{group}/{name}": value for group, items in groups.items() for name, value in items.items()}
    return {"t": samples.t, "S": samples.switching, "H": samples.hamiltonian, **values}


# -- samples --------------------------------------------------------------------------------------------


def test_samples_of_the_minimum_energy_transfer_are_its_polynomials():
    solution = solve(minimum_energy(), REST)
    t = torch.linspace(0, 1, 23, dtype=torch.float64)
    samples = solution(t)
    column = t[:, None]
    for found, exact in (
        (samples.states["x"], 3 * column**2 - 2 * column**3),
        (samples.states["v"], 6 * column - 6 * column**2),
        (samples.control["u"], 6 - 12 * column),
        (samples.costates["x"], torch.full_like(column, -12.0)),
        (samples.costates["v"], 12 * column - 6),
    ):
        torch.testing.assert_close(found, exact, atol=1e-12, rtol=0)
    # H = ½u² + λx v + λv u = −½(6−12t)² − 12·6(t − t²) = −18
    torch.testing.assert_close(samples.hamiltonian, torch.full_like(t, -18.0), atol=1e-11, rtol=0)
    assert samples.switching.shape == samples.fraction.shape == (23, 0)
    assert (solution.kind, solution.smoothing, solution.arcs, solution.switch_times) == (
        "smooth",
        None,
        [],
        [],
    )
    assert solution.cost == pytest.approx(6.0, abs=1e-12)
    assert solution.off_node_residual < 1e-11


@pytest.mark.parametrize("t", [0.25, [0.25], np.array([0.25]), torch.tensor([0.25])], ids=lambda t: type(t).__name__)
def test_times_may_be_numbers_lists_arrays_or_tensors(t):
    assert float(solve(minimum_energy(), REST)(t).states["x"]) == pytest.approx(3 / 16 - 1 / 32, abs=1e-13)


@pytest.mark.parametrize("t", [-1e-3, 1.001, float("nan")])
def test_a_time_outside_the_trajectory_is_an_error(t):
    with pytest.raises(ValueError, match="from 0 to final_time = 1 s"):
        solve(minimum_energy(), REST)([0.5, t])


def test_a_terminal_cost_counts():
    assert solve(soft_end(), [[1.0, 0.0], [1.0, 0.0]]).cost == pytest.approx(0.375, abs=1e-13)


def test_the_minimum_time_solution_has_two_labelled_arcs_and_a_switch():
    solution = solve_minimum_time()
    assert solution.kind == "split"
    assert solution.arcs == ["max", "min"]
    assert solution.switch_times == pytest.approx([1.0], abs=1e-12)
    assert solution.final_time == pytest.approx(2.0, abs=1e-12)
    assert solution.cost == pytest.approx(2.0, abs=1e-12)


def test_samples_contain_every_switch_from_both_sides():
    solution = solve_minimum_time()
    for n in (3, 40):  # with an odd n the middle sample falls on the switch
        samples = solution.sample(n)
        at = (samples.t == solution.switch_times[0]).nonzero()[:, 0]
        assert at.tolist() == [at[0], at[0] + 1]
        assert samples.control["u"][at, 0].tolist() == [1.0, -1.0]
        assert samples.segment[at].tolist() == [0, 1]
        assert bool((samples.t.diff() >= 0).all())
        assert (float(samples.t[0]), float(samples.t[-1])) == (0.0, solution.final_time)


def test_a_saturated_control_has_interior_arcs():
    solution = solve_saturated()
    first = (1 - 0.6**0.5) / 2
    assert solution.arcs == ["max", "interior", "min"]
    assert solution.switch_times == pytest.approx([first, 1 - first], abs=1e-11)
    assert solution.cost == pytest.approx(solution.problem.known_cost, abs=1e-11)


def test_the_smoothed_landing_costs_its_known_fuel(smoothed_landing):
    assert smoothed_landing.kind == "smoothed"
    assert smoothed_landing.smoothing == 0.1
    assert smoothed_landing.arcs == []
    assert smoothed_landing.cost == pytest.approx(268.7946271902, abs=2e-9)
    samples = smoothed_landing.sample()
    burnt = 1905.0 - float(samples.states["m"][-1])
    assert smoothed_landing.cost == pytest.approx(burnt, abs=1e-9)
    assert float(samples.hamiltonian.max() - samples.hamiltonian.min()) < 1e-9
    fraction = (samples.control["thrust_magnitude"] - 4971.81) / (13258.18 - 4971.81)
    torch.testing.assert_close(fraction, samples.fraction, atol=1e-12, rtol=0)
    torch.testing.assert_close(fraction, 0.5 * (1 + torch.tanh(samples.switching / 0.1)), atol=1e-12, rtol=0)


def test_the_split_landing_costs_its_known_fuel(split_landing):
    assert split_landing.arcs == ["max", "min", "max"]
    assert split_landing.switch_times == pytest.approx([31.0920056478, 39.2202817443], abs=1e-8)
    assert split_landing.cost == pytest.approx(268.0146563274, abs=1e-8)


def test_a_jumping_control_without_smoothing_or_arcs_is_refused(smoothed_landing):
    collocation = smoothed_landing.curve.collocation
    bare = replace(collocation, setting=replace(collocation.setting, regime=Regime()))
    with pytest.raises(ValueError, match="needs a smoothing or arcs"):
        Solution(Curve(bare, smoothed_landing.curve.xi))


def test_a_batch_is_refused(smoothed_landing):
    xi = smoothed_landing.curve.xi
    with pytest.raises(ValueError, match=r"one curve, shape \(N,\)"):
        Solution(Curve(smoothed_landing.curve.collocation, torch.stack([xi, xi])))


# -- files ----------------------------------------------------------------------------------------------


def test_a_loaded_solution_gives_the_same_bits_in_a_fresh_process(smoothed_landing, split_landing, tmp_path):
    solutions = {"smoothed": smoothed_landing, "split": split_landing}
    networks = [MLP((6, 9), "silu", adaptive_slope=True, seed=4), MLP((7, 7), residual=True, shared=False)]
    for network in networks:
        disc = replace(smoothed_landing.curve.collocation.discretisation, basis=network)
        collocation = replace(smoothed_landing.curve.collocation, discretisation=disc)
        xi = project(collocation, smoothed_landing.curve)
        solutions[f"deep_{network.shared}"] = Solution(Curve(collocation, xi + 1e-3 * random(len(xi))))
    for name, solution in solutions.items():
        solution.save(tmp_path / name)
    command = [sys.executable, "-c", LOAD, *solutions]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name, solution in solutions.items():
        expected = flat(solution.sample(50))
        with np.load(tmp_path / f"{name}.npz") as found:
            assert sorted(found.files) == sorted(expected)
            for key, value in expected.items():
                assert np.array_equal(found[key], value.numpy()), key


BASES = {
    "chebyshev": (Chebyshev(9), "columns"),
    "legendre": (Legendre(8), "orthonormal"),
    "random_tanh": (RandomFeatures(12, "tanh", seed=3), "orthonormal"),
    "random_sin": (RandomFeatures(12, "sin", weight_range=(-9, 9), bias_range=(-1, 1)), "columns"),
    "rbf": (GaussianRBF(9, 1.7), "none"),
    "mlp": (MLP((6, 9)), "none"),
    "frozen_mlp": (FrozenMLP((6, 9), seed=5), "orthonormal"),
    "switch_neurons": (SwitchNeuronBasis(RandomFeatures(12, "tanh"), [0.3], [40.0], [1]), "ordered"),
}


@pytest.mark.parametrize("name", BASES)
def test_every_basis_is_made_again(name, tmp_path):
    basis, conditioning = BASES[name]
    origin = {"distance": 2.5}
    problem = load_problem(f"{ANALYTIC}:minimum_energy", **origin)
    solution = solve(problem, REST, basis=basis, conditioning=conditioning)
    assert solution.cost == pytest.approx(37.5, rel=1e-6)
    solution.save(tmp_path)
    again = Solution.load(tmp_path)
    assert again.problem.origin == ProblemOrigin(f"{ANALYTIC.resolve()}:minimum_energy", origin)
    for key, value in flat(solution.sample(20)).items():
        assert torch.equal(flat(again.sample(20))[key], value), key
    assert again.cost == solution.cost


def test_arcs_events_and_free_times_come_back(tmp_path):
    solution = solve_saturated()
    solution.save(tmp_path)
    again = Solution.load(tmp_path, problem=solution.problem)
    assert (again.kind, again.arcs, again.switch_times) == ("split", solution.arcs, solution.switch_times)
    assert again.curve.collocation.events == ((1,), (0,))
    residual = solution.curve.collocation.residual(solution.curve.xi)
    assert torch.equal(again.curve.collocation.residual(again.curve.xi), residual)


def test_float32_stays_float32(tmp_path):
    guess = [[0.0, 0, -1, -1], [1.0, 0, -1, 1]]
    solution = solve(minimum_time(), guess, switches=[0.9], arcs=[2, 0], dtype=torch.float32, tolerance=1e-5)
    solution.save(tmp_path)
    again = Solution.load(tmp_path, problem=minimum_time())
    assert again.sample(5).states["x"].dtype is torch.float32
    assert torch.equal(again.sample(5).states["x"], solution.sample(5).states["x"])


def test_a_problem_without_origin_has_to_be_passed(tmp_path):
    solution = solve(minimum_energy(), REST)
    solution.save(tmp_path)
    with pytest.raises(ValueError, match=r"not made by load_problem.*pass it: Solution.load\(folder, problem="):
        Solution.load(tmp_path)
    assert Solution.load(tmp_path, minimum_energy()).cost == solution.cost


OTHERS = {
    "states": {"units": {"x": 2.0, "v": 1.0}},
    "rates": {"dynamics": lambda t, x, u, p: {"x": x.v, "v": u.u - 1e-6 * x.x}},
}


@pytest.mark.parametrize("what", OTHERS)
def test_another_problem_of_the_same_name_is_noticed(what, tmp_path):
    solve(minimum_energy(), REST).save(tmp_path)
    with pytest.raises(ValueError, match=f"the rebuilt {what} is not the saved one"):
        Solution.load(tmp_path, replace(minimum_energy(), **OTHERS[what]))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"final": {"x": 1.0, "v": 1e-6}}, "final v = 1e-06 (saved: 0.0)"),
        ({"final": {"x": 1.0}}, "final v = free (saved: 0.0)"),
        ({"final_time": 2.0}, "final_time = 2.0 (saved: 1.0)"),
        ({"final_time": FreeTime(1.0)}, "final_time = free (saved: 1.0)"),
        ({"parameters": {"mass": 2.0}}, "parameters['mass'] = 2.0 (saved: 1.0)"),
        ({"parameters": {}}, "parameters['mass'] = absent (saved: 1.0)"),
        ({"initial": {"x": 1, "v": 0}, "final_time": 2}, "initial x = 1.0 (saved: 0.0), final_time = 2.0 (saved: 1.0)"),
    ],
)
def test_what_is_stated_otherwise_is_named(changes, told, tmp_path):
    problem = replace(minimum_energy(), parameters={"mass": 1.0})
    solve(problem, REST).save(tmp_path)
    assert Solution.load(tmp_path, problem).problem is problem
    with pytest.raises(ValueError, match=re.escape(f"another problem than was solved: {told}") + "$"):
        Solution.load(tmp_path, replace(problem, **changes))


def test_other_ends_are_noticed_where_what_was_stated_is_not_saved(tmp_path):
    solve(minimum_energy(), REST).save(tmp_path)
    path = tmp_path / "solution.json"
    description = json.loads(path.read_text(encoding="utf-8"))
    del description["problem"]["stated"]
    path.write_text(json.dumps(description), encoding="utf-8")
    assert Solution.load(tmp_path, minimum_energy()).problem.name == "minimum_energy"
    with pytest.raises(ValueError, match="the rebuilt boundary is not the saved one"):
        Solution.load(tmp_path, replace(minimum_energy(), final={"x": 1.0, "v": 1e-6}))


def test_a_problem_of_another_name_is_noticed(tmp_path):
    solve(minimum_energy(), REST).save(tmp_path)
    with pytest.raises(ValueError, match=r"'minimum_time'; allowed: 'minimum_energy'"):
        Solution.load(tmp_path, minimum_time())


def test_changed_weights_are_noticed(tmp_path):
    solve(minimum_energy(), REST).save(tmp_path)
    with np.load(tmp_path / "weights.npz") as stream:
        arrays = dict(stream)
    arrays["xi"][3] += 1e-3
    np.savez(tmp_path / "weights.npz", **arrays)
    with pytest.raises(ValueError, match="the rebuilt curve is not the saved one"):
        Solution.load(tmp_path, minimum_energy())


@pytest.mark.parametrize("missing", ["solution.json", "weights.npz"])
def test_a_folder_without_a_solution_names_the_missing_file(missing, tmp_path):
    solve(minimum_energy(), REST).save(tmp_path)
    (tmp_path / missing).unlink()
    with pytest.raises(FileNotFoundError, match=missing):
        Solution.load(tmp_path)


def test_another_format_is_refused(tmp_path):
    solve(minimum_energy(), REST).save(tmp_path)
    description = json.loads((tmp_path / "solution.json").read_text())
    (tmp_path / "solution.json").write_text(json.dumps({**description, "format": 99}))
    with pytest.raises(ValueError, match="format = 99; allowed: 1"):
        Solution.load(tmp_path, minimum_energy())


def test_the_trajectory_is_written_with_units(split_landing, tmp_path):
    split_landing.save(tmp_path)
    with (tmp_path / "trajectory.csv").open(newline="") as stream:
        header, *rows = list(csv.reader(stream))
    assert header[:3] == ["t [s]", "r_1 [m]", "r_2 [m]"]
    assert {"m [kg]", "lambda_v_1 [kg/(m/s)]", "thrust_magnitude [N]", "S", "H [kg/s]"} <= set(header)
    table = np.array(rows, dtype=float)
    assert table[0, header.index("m [kg]")] == 1905.0
    assert table[-1, header.index("m [kg]")] == pytest.approx(1905.0 - split_landing.cost, abs=1e-9)
    assert len(rows) == len(split_landing.sample())


# -- problems by reference ------------------------------------------------------------------------------


def test_arguments_are_kept_as_json_gives_them_back():
    problem = load_problem("ponn_torch.problems.mars_landing:mars_landing", initial_position=(-100.0, 50.0, 1200.0))
    assert problem.origin.arguments == {"initial_position": [-100.0, 50.0, 1200.0]}
    json.dumps(dict(problem.origin.arguments))


def test_a_problem_in_a_file_is_saved_by_the_way_to_it(tmp_path):
    """A folder that is moved together with the file still finds it."""
    here = tmp_path / "here"
    (here / "runs" / "one").mkdir(parents=True)
    source = Path(__file__).with_name("analytic.py").read_text(encoding="utf-8")
    (here / "mine.py").write_text(source, encoding="utf-8")
    problem = load_problem(f"{here / 'mine.py'}:minimum_energy", distance=2.0)
    solve(problem, REST).save(here / "runs" / "one")
    saved = (here / "runs" / "one" / "solution.json").read_text(encoding="utf-8")
    assert json.loads(saved)["problem"]["reference"] == "../../mine.py:minimum_energy"
    assert str(tmp_path) not in saved
    here.rename(tmp_path / "there")
    assert Solution.load(tmp_path / "there" / "runs" / "one").problem.known_cost == 24.0


def test_a_changed_copy_loses_its_origin():
    problem = load_problem("ponn_torch.problems.mars_landing:mars_landing")
    assert problem.origin is not None
    assert problem.with_boundary(final_time=50.0).origin is None


@pytest.mark.parametrize(
    ("reference", "arguments", "message"),
    [
        ("no_colon", {}, "allowed: 'package.module:function'"),
        ("ponn_torch.problems.mars_landin:x", {}, "did you mean 'ponn_torch.problems.mars_landing'"),
        ("no_such_package.module:x", {}, "no module named 'no_such_package'"),
        ("ponn_torch.problems.mars_landing:mars_landin", {}, "did you mean 'mars_landing'"),
        ("ponn_torch.problems.mars_landing:mars_landing", {"gravitty": 1}, "did you mean 'gravity'"),
        (f"{ANALYTIC.with_name('analitic.py')}:x", {}, "did you mean 'analytic.py'"),
        (f"{ANALYTIC}:minimum_enery", {}, "did you mean 'minimum_energy'"),
    ],
)
def test_wrong_references_name_the_nearest(reference, arguments, message):
    with pytest.raises(ValueError, match=message):
        load_problem(reference, **arguments)


def test_what_json_cannot_hold_and_what_is_no_problem_are_type_errors():
    with pytest.raises(TypeError, match="'distance' = tensor"):
        load_problem(f"{ANALYTIC}:minimum_energy", distance=torch.ones(1))
    with pytest.raises(TypeError, match="returns Solution"):
        load_problem(f"{ANALYTIC}:solve_minimum_time")


def test_regularisers_have_names():
    for name in REGULARISERS:
        assert type(make_regulariser(name)) is REGULARISERS[name]
        problem = load_problem("ponn_torch.problems.mars_landing:mars_landing", regulariser=name)
        assert type(problem.control.regulariser) is REGULARISERS[name]
    with pytest.raises(ValueError, match="did you mean 'entropy'"):
        make_regulariser("entropi")


def test_arcs_of_several_components_are_told_apart_from_each_other():
    assert in_a_row(["max", "min", "max"]) == "max-min-max"
    assert in_a_row(["max,min", "min,min"]) == "max,min / min,min"
    assert in_a_row([]) == ""
