"""Enrichment and switch neurons: layers where S is zero, sharper than what they began with, kept only if trusted."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from analytic import minimum_energy
from helpers import bvp_of, collocation
from test_solution import LOAD, flat

from ponn_torch.ansatz import expression
from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.optim.base import Status
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.continuation import Ladder
from ponn_torch.solving.enrichment import Enrichment, enriched_nodes, switch_intervals
from ponn_torch.solving.refinement import Outcome, Refinement
from ponn_torch.solving.single_domain import Layers, find_layers
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.switch_neurons import SwitchNeurons

KNOWN = {0.1: 268.7946271902, 0.01: 268.0307003834}  # fuel of the smoothed landing, kg: event-exact shooting
REFINEMENTS: dict[str, Refinement] = {
    "enrichment": Enrichment(n_neurons=40, n_nodes=80, n_extra=40, last=0.05, factor=0.5),
    "switch_neurons": SwitchNeurons(n_neurons=30, last=0.01, factor=0.1),
}


def layers(centres: list[float], widths: list[float]) -> Layers:
    return Layers(torch.tensor(centres, dtype=torch.float64), torch.tensor(widths, dtype=torch.float64))


@pytest.fixture(scope="module")
def refined(smoothed_landing):
    return {name: refinement.run(smoothed_landing.curve) for name, refinement in REFINEMENTS.items()}


# -- where ---------------------------------------------------------------------------------------------------


def test_layers_are_the_zeros_of_s_and_as_wide_as_its_slope_says(smoothed_landing):
    found = find_layers(smoothed_landing.curve, torch.tensor(0.1, dtype=torch.float64))
    assert len(found.centres) == 2
    t = (found.centres + 1) / 2 * smoothed_landing.final_time
    for centre, width in zip(t.tolist(), found.widths.tolist(), strict=True):
        half = width * smoothed_landing.final_time / 2
        before, at, after = smoothed_landing([centre - 0.01 * half, centre, centre + 0.01 * half]).switching[:, 0]
        assert abs(float(at)) < 1e-9
        assert abs(float(after - before)) == pytest.approx(0.02 * 0.1, rel=1e-3)
    assert len(find_layers(smoothed_landing.curve, None).centres) == 0


def test_a_curve_that_does_not_switch_has_no_layers():
    made = collocation(bvp_of("minimum_fuel"), n_neurons=6, n_nodes=12, smoothing=1.0)
    curve = Curve(made, torch.zeros(made.n_unknowns, dtype=torch.float64))  # λv = 0: S = −1
    assert len(find_layers(curve, torch.tensor(1.0, dtype=torch.float64)).centres) == 0


def test_intervals_that_meet_become_one():
    found = switch_intervals(layers([-0.5, 0.3, 0.325, 0.99], [0.01, 0.01, 0.002, 0.02]), 2.0, 0.01)
    spans = [(float(start), float(end), count) for start, end, count in found]
    expected = [(-0.52, -0.48, 1), (0.28, 0.335, 2), (0.95, 1.0, 1)]
    assert spans == [pytest.approx(span) for span in expected]


def test_every_switch_brings_its_nodes_and_the_others_are_spread_as_in_a_gauss_rule():
    intervals = switch_intervals(layers([-0.5, 0.3, 0.325], [0.01, 0.01, 0.002]), 2.0, 0.01)
    nodes = enriched_nodes(intervals, 60, 25, torch.zeros(1, dtype=torch.float64))
    z = nodes.points
    inside = [int(((z > start) & (z < end)).sum()) for start, end, _ in intervals]
    assert inside == [25 + 4, 50 + 4]
    assert 60 + 75 <= len(nodes) <= 60 + 75 + 5 * 4
    assert int((z < -0.52).sum()) == math.ceil(60 * (0.5 + math.asin(-0.52) / math.pi))
    assert float(nodes.weights.sum()) == pytest.approx(2.0)
    assert len(enriched_nodes([], 60, 25, z)) == 60


# -- what comes out ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", REFINEMENTS)
def test_a_refinement_ends_sharper_and_holds_between_its_nodes(name, refined, smoothed_landing):
    found, refinement = refined[name], REFINEMENTS[name]
    assert found.outcome in (Outcome.COARSE, Outcome.SOLVED)
    regime = found.curve.collocation.setting.regime
    assert regime.arcs is None
    assert float(regime.smoothing) < 0.1
    assert found.curve.off_node_residual() <= refinement.trust * found.curve.largest_rate
    assert any(found.result is result for result in found.rounds)
    assert float(found.result.norm) == pytest.approx(
        float(found.curve.collocation.residual(found.curve.xi).norm()), rel=1e-6
    )


def test_switch_neurons_solve_what_polynomials_of_the_same_number_do_not(refined, smoothed_landing):
    """The landing at ρ = 0.01 on one domain, against its own truth."""
    curve = refined["switch_neurons"].curve
    assert float(curve.collocation.setting.regime.smoothing) == pytest.approx(0.01)
    assert Solution(curve).cost == pytest.approx(KNOWN[0.01], abs=2e-5)
    assert curve.off_node_residual() < 1e-4
    plain = SwitchNeurons(n_neurons=60, n_lifts=0, last=0.01, factor=0.1, max_halvings=0, trust=math.inf)
    rival = plain.run(smoothed_landing.curve).curve
    assert rival.collocation.n_unknowns > curve.collocation.n_unknowns
    assert rival.off_node_residual() > 100 * curve.off_node_residual()
    assert abs(Solution(rival).cost - KNOWN[0.01]) > 100 * abs(Solution(curve).cost - KNOWN[0.01])


def test_an_untrusted_rung_is_not_kept(smoothed_landing):
    enrichment = Enrichment(n_neurons=40, n_nodes=80, n_extra=40, last=1e-4, factor=1e-3, max_halvings=1)
    found = enrichment.run(smoothed_landing.curve)
    assert found.outcome is Outcome.COARSE
    assert float(found.curve.collocation.setting.regime.smoothing) == pytest.approx(0.1)
    assert len(found.rounds) >= 3  # 0.1, then two that failed


def test_a_coarse_free_function_keeps_the_curve_that_it_was_given(smoothed_landing):
    found = Enrichment(n_neurons=6, n_nodes=20, n_extra=10, last=0.05).run(smoothed_landing.curve)
    assert found.outcome is not Outcome.SOLVED
    assert found.curve is smoothed_landing.curve


def test_a_problem_without_switches_is_solved_once_more_without_layers():
    result = Solver(refinement=SwitchNeurons(n_neurons=12), basis=Chebyshev(12), n_nodes=24).solve(minimum_energy())
    assert result.certified
    assert [stage.name for stage in result.stages] == ["smooth", "switchneurons"]
    assert result.solution.cost == pytest.approx(6.0)


def test_ctrl_c_keeps_what_was_solved(smoothed_landing):
    seen = []

    def callback(collocation):
        def on_iteration(record, xi, residual):
            seen.append(collocation)
            if len({id(c) for c in seen}) == 2:
                raise KeyboardInterrupt

        return on_iteration

    found = SwitchNeurons(n_neurons=30, last=0.01).run(smoothed_landing.curve, callback)
    assert found.outcome is Outcome.INTERRUPTED
    assert found.rounds[-1].status is Status.INTERRUPTED
    assert float(found.curve.collocation.setting.regime.smoothing) == pytest.approx(0.1)
    assert found.curve.collocation is seen[0]


# -- the solver and files ------------------------------------------------------------------------------------


def test_a_solver_takes_the_first_start_that_is_sharpened():
    refinement = SwitchNeurons(n_neurons=30, last=0.03, factor=0.3)
    solver = Solver(refinement=refinement, continuation=Ladder((1.0, 0.3, 0.1)))
    assert not solver.exact
    result = solver.solve(mars_landing(), seed=0)
    assert result.n_starts == 1
    assert result.solution.smoothing == pytest.approx(0.03)
    assert result.solution.cost == pytest.approx(268.1607897871, abs=1e-4)
    assert result.message.startswith("NOT certified")
    assert result.certificate.cost_error == pytest.approx(result.solution.cost - 268.0146563274, abs=1e-3)
    kept = [stage for stage in result.stages if stage.name == "switchneurons"][-1]
    assert kept.smoothing == pytest.approx(0.03)
    assert kept.off_node_residual == result.solution.off_node_residual


def test_a_saved_refinement_gives_the_same_bits_in_a_fresh_process(refined, tmp_path):
    for name, found in refined.items():
        Solution(found.curve).save(tmp_path / name)
    done = subprocess.run(
        [sys.executable, "-c", LOAD, *refined], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for name, found in refined.items():
        expected = flat(Solution(found.curve).sample(50))
        with np.load(tmp_path / f"{name}.npz") as loaded:
            for key, value in expected.items():
                assert np.array_equal(loaded[key], value.numpy()), key
        again = Solution.load(tmp_path / name)
        assert again.off_node_residual == found.curve.off_node_residual()  # on the same panels


def test_loading_does_not_condition_anew(refined, tmp_path, monkeypatch):
    """Elsewhere a decomposition may give other singular vectors; what is loaded must not ask for them."""
    Solution(refined["switch_neurons"].curve).save(tmp_path)

    def refuse(*arguments):
        raise AssertionError("conditioned again")

    monkeypatch.setattr(expression, "CONDITIONINGS", dict.fromkeys(expression.CONDITIONINGS, refuse))
    assert Solution.load(tmp_path).cost == Solution(refined["switch_neurons"].curve).cost
