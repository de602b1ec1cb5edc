"""Figures: every kind of problem gets those that apply, with the right units, marks and data."""

import sys

import numpy as np
import pytest
from conftest import SOLVES
from matplotlib.figure import Figure

from ponn_torch.optim.base import Status
from ponn_torch.optimal_control.problem import DisplayUnit
from ponn_torch.reporting.diagnostics import convergence_figure
from ponn_torch.reporting.figures import (
    all_figures,
    control_figure,
    costates_figure,
    residual_figure,
    stage_figure,
    states_figure,
    switching_labels,
)
from ponn_torch.reporting.style import component_symbols, costate_unit, decimal_exponent, save, symbol
from ponn_torch.reporting.trajectories import plane_figure, trajectory_figure
from ponn_torch.solving.result import StageResult

ALWAYS = {"states", "costates", "control", "hamiltonian", "residual", "convergence"}
APPLY = {
    "split": ALWAYS | {"trajectory", "plane", "mass"},
    "smoothed": ALWAYS | {"trajectory", "plane", "mass"},
    "smooth, three axes": ALWAYS | {"trajectory", "plane"},
    "smooth, plane": ALWAYS | {"plane"},
    "saturated box": ALWAYS | {"plane"},
    "box, no position": ALWAYS,
}


def close(left, right):
    return np.allclose(np.asarray(left), np.asarray(right), rtol=1e-12, atol=0)


@pytest.mark.parametrize("kind", SOLVES)
def test_every_kind_of_problem_gets_the_figures_that_apply(solved, kind, tmp_path):
    result = solved(kind)
    figures = all_figures(result.solution, result.stages)
    assert set(figures) == APPLY[kind]
    assert all(isinstance(figure, Figure) for figure in figures.values())
    # drawing is slow: the report's tests draw every figure, here the one that has no layout engine
    save(stage_figure(result.solution), tmp_path / "stage.png", dpi=40)
    assert (tmp_path / "stage.png").stat().st_size > 1000
    assert "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()


def test_without_stages_there_is_no_convergence(solved):
    assert "convergence" not in all_figures(solved("smooth, plane").solution)
    with pytest.raises(ValueError, match="stages"):
        convergence_figure([])


def test_states_are_drawn_in_display_units(solved):
    solution = solved("split").solution
    axes = states_figure(solution).axes
    assert [ax.get_ylabel() for ax in axes] == ["$r$ (m)", "$v$ (m/s)", "$m$ (kg)"]
    assert axes[-1].get_xlabel() == "$t$ (s)"
    mass = axes[2].get_lines()[-1].get_ydata()
    assert close([mass[0], mass[-1]], [1905.0, float(solution.sample().states["m"][-1, 0])])
    assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["$r_{x}$", "$r_{y}$", "$r_{z}$"]


def test_units_scale_the_data(solved):
    solution = solved("box, no position").solution
    (ax,) = states_figure(solution).axes
    line = ax.get_lines()[-1]
    assert close([line.get_xdata()[-1], line.get_ydata()[-1]], [1.0 / 3600.0, 0.5 / (3.14159 / 180)])
    assert (ax.get_ylabel(), ax.get_xlabel()) == (r"$\theta$ (deg)", "$t$ (h)")


def test_switches_are_dashed_lines_in_every_panel(solved):
    solution = solved("split").solution
    for ax in [
        *states_figure(solution).axes,
        *costates_figure(solution).axes,
        *control_figure(solution).axes,
    ]:
        dashed = [line.get_xdata()[0] for line in ax.get_lines() if line.get_linestyle() == "--"]
        assert close(dashed, solution.switch_times)


def test_control_figure_shows_jumps_bounds_and_the_switching_function(solved):
    solution = solved("split").solution
    thrust, switching, direction = control_figure(solution).axes
    curve = max(thrust.get_lines(), key=lambda line: len(line.get_xdata()))
    assert close(sorted(set(np.round(curve.get_ydata(), 6))), [4971.81, 13258.18])  # two values, no ramp
    bounds = [line.get_ydata()[0] for line in thrust.get_lines() if line.get_linestyle() == ":"]
    assert sorted(bounds) == [4971.81, 13258.18]
    assert [text.get_text() for text in thrust.texts] == solution.arcs
    s = max(switching.get_lines(), key=lambda line: len(line.get_xdata())).get_ydata()
    assert close(s, solution.sample().switching[:, 0])
    components = [np.asarray(line.get_ydata()) for line in direction.get_lines() if line.get_label()[0] == "$"]
    assert np.allclose(sum(c**2 for c in components), 1.0)


def test_plane_leaves_out_the_third_axis_of_a_flat_path_only(solved):
    assert len(plane_figure(solved("split").solution).axes) == 2
    assert len(plane_figure(solved("smooth, plane").solution).axes) == 1
    assert all(ax.get_aspect() == 1.0 for ax in plane_figure(solved("split").solution).axes)


def test_path_starts_and_ends_where_the_problem_says(solved):
    figure = trajectory_figure(solved("split").solution)
    marks = {line.get_marker(): line.get_data_3d() for line in figure.axes[0].get_lines() if line.get_marker() in "os"}
    assert np.allclose(np.ravel(marks["o"]), [-200.0, 100.0, 1500.0])
    assert np.allclose(np.ravel(marks["s"]), 0.0, atol=1e-6)


def test_residual_figure_leaves_out_equations_that_hold_exactly(solved):
    labels = [text.get_text() for text in residual_figure(solved("split").solution).axes[0].get_legend().get_texts()]
    assert r"$\dot v$" in labels
    assert r"$\dot r$" not in labels  # chained: ṙ = v by construction


def stage(name, smoothing, norms, start=0, accepted=True):
    records = [{"norm": norm, "accepted": accepted} for norm in norms]
    return StageResult(
        name,
        smoothing,
        Status.RESIDUAL,
        norms[-1],
        len(norms),
        0,
        0,
        0.0,
        0.0,
        1.0,
        records=records,
        start=start,
    )


def test_convergence_lines_up_the_stages():
    stages = [
        stage("smooth", 1.0, [10.0, 1.0], start=0),
        stage("smooth", 1.0, [9.0, 1e-3, 1e-6], start=1),
        stage("split", None, [1e-3, 0.0], start=1, accepted=False),
    ]
    ax = convergence_figure(stages).axes[0]
    lines = [line for line in ax.get_lines() if line.get_linestyle() == "-"]
    assert [list(line.get_xdata()) for line in lines] == [[1, 2], [3, 4, 5], [6, 7]]
    assert np.isnan(lines[2].get_ydata()[1])  # an exact zero has no place on a logarithmic axis
    assert len({line.get_color() for line in lines}) == 3  # failed start, smoothed, split
    assert [text.get_text() for text in ax.texts] == [r"$\rho$ = 1", r"$\rho$ = 1", "split"]
    rejected = [line.get_xdata() for line in ax.get_lines() if line.get_marker() == "|"]
    assert [list(x) for x in rejected] == [[], [], [6, 7]]


def test_without_smoothing_the_stage_before_a_split_is_told_apart_from_it():
    stages = [stage("smooth", None, [10.0, 1.0]), stage("split", None, [1e-3, 1e-9])]
    ax = convergence_figure(stages).axes[0]
    first, second = (line.get_color() for line in ax.get_lines() if line.get_linestyle() == "-")
    handles = ax.get_legend().legend_handles
    assert [(h.get_label(), h.get_color()) for h in handles[:2]] == [("smooth", first), ("split", second)]
    assert first != second


@pytest.mark.parametrize(
    ("kind", "count", "labels"),
    [
        ("split", 1, ["$S$"]),
        ("box, no position", 1, ["$S$"]),
        ("saturated box", 4, [r"$S_{\min,1}$", r"$S_{\min,2}$", r"$S_{\max,1}$", r"$S_{\max,2}$"]),
    ],
)
def test_switching_functions_are_told_apart(solved, kind, count, labels):
    solution = solved(kind).solution
    assert solution.sample(5).switching.shape[-1] == count
    assert switching_labels(solution) == labels


def test_symbols():
    assert [symbol(name) for name in ("r", "theta", "thrust", "bank_angle")] == [
        "r", r"\theta", "T", r"\mathrm{bank\ angle}"
    ]  # fmt: skip
    assert component_symbols("q", 4) == ["$q_{1}$", "$q_{2}$", "$q_{3}$", "$q_{4}$"]
    assert component_symbols("r", 2, r"\lambda_{{{}}}") == [r"$\lambda_{r_{x}}$", r"$\lambda_{r_{y}}$"]


@pytest.mark.parametrize(
    ("largest", "exponent"), [(0.0, 0), (1500.0, 0), (2.2e8, 8), (0.02, 0), (3e-5, -5), (float("nan"), 0)]
)
def test_decimal_exponent(largest, exponent):
    assert decimal_exponent(largest) == exponent


def test_costate_units(solved):
    problem = solved("split").solution.problem
    assert costate_unit(problem, "v") == DisplayUnit("kg/(m/s)", 1.0)
    assert costate_unit(problem, "m").label == ""
    assert costate_unit(solved("box, no position").solution.problem, "theta").label == "1/deg"
