"""Pure functions Solution → Figure: states, costates, control with its switching function, mass.

Each makes its own ``Figure`` (no pyplot, nothing global) in the problem's display units. Figures that do not
apply to a problem are None and left out of ``all_figures``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from ponn_torch.optimal_control.control_laws import Bounded
from ponn_torch.optimal_control.control_set import LOWER
from ponn_torch.optimal_control.problem import DisplayUnit, Named
from ponn_torch.reporting.diagnostics import convergence_figure, hamiltonian_figure, residual_figure
from ponn_torch.reporting.style import (
    ARCS,
    BLACK,
    COMPONENTS,
    GREY,
    PURPLE,
    arc_intervals,
    axis_label,
    component_symbols,
    costate_unit,
    heading,
    house_style,
    in_time_unit,
    legend_right,
    number,
    symbol,
    time_axes,
    unit,
)
from ponn_torch.reporting.trajectories import plane_figure, trajectory_figure
from ponn_torch.solving.result import StageResult
from ponn_torch.solving.solution import Samples, Solution


def _block(ax: Axes, t: Tensor, values: Tensor, shown: DisplayUnit, labels: Sequence[str], label: str) -> None:
    """The components (m, size) of one named quantity on one axis; a legend only where there are several."""
    for i, name in enumerate(labels):
        ax.plot(t, values[:, i].cpu() / shown.size, color=COMPONENTS[i % len(COMPONENTS)], label=name)
    ax.set_ylabel(axis_label(label, shown))
    if len(labels) > 1:
        legend_right(ax)


@house_style
def states_figure(solution: Solution) -> Figure:
    """One axis per state, components in one colour each."""
    samples, problem = solution.sample(), solution.problem
    figure, axes = time_axes(solution, len(problem.states))
    t = in_time_unit(solution, samples.t)
    for ax, (name, size) in zip(axes, problem.states.items(), strict=True):
        labels = component_symbols(name, size)
        _block(ax, t, samples.states[name], unit(problem, name), labels, symbol(name))
    heading(solution, axes[0])
    return figure


@house_style
def costates_figure(solution: Solution) -> Figure:
    """One axis per costate λ, in cost per state unit."""
    samples, problem = solution.sample(), solution.problem
    figure, axes = time_axes(solution, len(problem.states))
    t = in_time_unit(solution, samples.t)
    for ax, (name, size) in zip(axes, problem.states.items(), strict=True):
        labels = component_symbols(name, size, r"\lambda_{{{}}}")
        shown, tex = costate_unit(problem, name), rf"\lambda_{{{symbol(name)}}}"
        _block(ax, t, samples.costates[name], shown, labels, tex)
    heading(solution, axes[0])
    return figure


# -- control ------------------------------------------------------------------------------------------------


def _bounds(solution: Solution, name: str) -> tuple[float, ...]:
    """Numerical bounds of a control, in SI; () where it has none."""
    law = next(part for part in solution.problem.control.factors if name in part.names)
    double = torch.zeros((), dtype=torch.float64)
    if not isinstance(law, Bounded):
        return tuple(float(getattr(law, side)) for side in ("minimum", "maximum") if hasattr(law, side))
    found = law.bounds(Named(**solution.problem.parameters), double)
    return tuple(dict.fromkeys(value for bound in found for value in (double + bound).flatten().tolist()))


def _arcs(solution: Solution, ax: Axes, *, labels: bool) -> None:
    """Shade the arcs; label those that are wide enough for a word."""
    time = unit(solution.problem, "time").size
    for start, end, arc in arc_intervals(solution):
        start, end = start / time, end / time
        ax.axvspan(start, end, color=ARCS.get(arc, GREY), alpha=0.09, lw=0)
        if labels and end - start > 0.06 * solution.final_time / time:
            where: dict[str, Any] = {"transform": ax.get_xaxis_transform(), "ha": "center", "va": "bottom"}
            ax.text((start + end) / 2, 1.0, arc, color=BLACK, alpha=0.75, fontsize=7, **where)


def _control_axis(solution: Solution, ax: Axes, t: Tensor, name: str, samples: Samples) -> None:
    """The magnitude of a bounded vector, or the components of a control."""
    shown, magnitude = unit(solution.problem, name), samples.control.get(f"{name}_magnitude")
    tex = symbol(name)
    if magnitude is not None:
        ax.plot(t, magnitude[:, 0].cpu() / shown.size, color=BLACK)
        tex = rf"|{tex}|"
        ax.set_ylabel(axis_label(tex, shown))
    else:
        values = samples.control[name]
        _block(ax, t, values, shown, component_symbols(name, values.shape[-1]), tex)
    for bound in _bounds(solution, name):
        ax.axhline(bound / shown.size, color=GREY, lw=0.8, ls=":")


def switching_labels(solution: Solution) -> list[str]:
    """S, or one label per function: S at both bounds where H is convex, and the number of one of several components."""
    law, labels = solution.bvp.law, []
    for level in law.levels:
        side = "" if level.jumps else r"\min" if level.below == LOWER else r"\max"
        index = ",".join(part for part in (side, str(level.component + 1) if law.n_bounded > 1 else "") if part)
        labels.append(f"$S_{{{index}}}$" if index else "$S$")
    return labels


def _switching_axis(solution: Solution, ax: Axes, t: Tensor, samples: Samples, *, legend: bool) -> None:
    n_switching = samples.switching.shape[-1]
    labels = switching_labels(solution)
    colours = [PURPLE] if n_switching == 1 else [COMPONENTS[i % len(COMPONENTS)] for i in range(n_switching)]
    if solution.smoothing is not None:
        # inside the band |S| < ρ the smoothed control is in transition
        rho = solution.smoothing
        ax.axhspan(-rho, rho, color=GREY, alpha=0.15, lw=0, label=r"$|S| < \rho$")
    ax.axhline(0.0, color=BLACK, lw=0.7)
    for i, label in enumerate(labels):
        ax.plot(t, samples.switching[:, i].cpu(), color=colours[i], label=label)
    top = float(samples.switching.abs().max()) * 1.15
    low, high = float(samples.switching.min()), float(samples.switching.max())
    ax.set_ylim(min(low, 0.0) - 0.08 * top, max(high, 0.0) + 0.08 * top)
    ax.set_ylabel("switching\nfunction" if n_switching > 1 else "$S$")
    if legend and (n_switching > 1 or solution.smoothing is not None):
        legend_right(ax)


def _direction_axis(solution: Solution, ax: Axes, t: Tensor, name: str, samples: Samples) -> None:
    """Unit vector of a control that has a magnitude; blank where the magnitude vanishes."""
    vector, magnitude = samples.control[name], samples.control[f"{name}_magnitude"]
    defined = magnitude > 1e-9 * magnitude.max()
    direction = torch.where(defined, vector / magnitude, torch.nan)
    for i, label in enumerate(component_symbols(name, vector.shape[-1], r"\hat {}")):
        ax.plot(t, direction[:, i].cpu(), color=COMPONENTS[i % len(COMPONENTS)], label=label)
    ax.set_ylim(-1.08, 1.08)
    ax.set_ylabel("direction")
    legend_right(ax)


def _vectors(samples: Samples) -> list[str]:
    """Names of the controls proper, without the magnitudes that belong to them."""
    magnitudes = {f"{name}_magnitude" for name in samples.control}
    return [name for name in samples.control if name not in magnitudes]


def _draw_control(solution: Solution, samples: Samples, *, small: bool) -> Figure:
    names, has_switching = _vectors(samples), samples.switching.shape[-1] > 0
    directed = [name for name in names if not small and f"{name}_magnitude" in samples.control]
    size: dict[str, Any] = {"width": 5.0, "height": 1.4, "measured": False} if small else {}
    figure, axes = time_axes(solution, len(names) + has_switching + len(directed), **size)
    t = in_time_unit(solution, samples.t)
    for ax in axes:
        _arcs(solution, ax, labels=ax is axes[0])
    rows = iter(axes)
    for name in names:
        _control_axis(solution, next(rows), t, name, samples)
    if has_switching:
        _switching_axis(solution, next(rows), t, samples, legend=not small)
    for name in directed:
        _direction_axis(solution, next(rows), t, name, samples)
    return figure


@house_style
def control_figure(solution: Solution) -> Figure:
    """Magnitude or components of the control, the switching function, and the direction; arcs shaded."""
    figure = _draw_control(solution, solution.sample(), small=False)
    heading(solution, figure.axes[0], pad=16.0 if solution.arcs else 8.0)
    return figure


@house_style
def stage_figure(solution: Solution) -> Figure:
    """The small figure that a stage leaves behind: control and switching function."""
    return _draw_control(solution, solution.sample(200), small=True)


# -- mass ---------------------------------------------------------------------------------------------------


@house_style
def mass_figure(solution: Solution) -> Figure | None:
    """Mass over time and how much of it is used; None where the problem names no mass."""
    name = solution.problem.mass
    if name is None:
        return None
    samples, shown = solution.sample(), unit(solution.problem, name)
    figure, (ax,) = time_axes(solution, 1, height=2.4)
    mass = samples.states[name][:, 0].cpu()
    _arcs(solution, ax, labels=False)
    ax.plot(in_time_unit(solution, samples.t), mass / shown.size, color=BLACK)
    ax.set_ylabel(axis_label(symbol(name), shown))
    used = number(float(mass[0] - mass[-1]), shown)
    ax.annotate(f"used {used}", (0.02, 0.07), xycoords="axes fraction")
    heading(solution, ax)
    return figure


# -- all ----------------------------------------------------------------------------------------------------

FIGURES = {
    "states": states_figure,
    "costates": costates_figure,
    "control": control_figure,
    "trajectory": trajectory_figure,
    "plane": plane_figure,
    "mass": mass_figure,
    "hamiltonian": hamiltonian_figure,
    "residual": residual_figure,
}


def all_figures(solution: Solution, stages: Sequence[StageResult] = ()) -> Mapping[str, Figure]:
    """Every figure that applies, by name; ``convergence`` needs the stages."""
    drawn = {name: draw(solution) for name, draw in FIGURES.items()}
    if any(stage.records for stage in stages):
        drawn["convergence"] = convergence_figure(stages)
    return {name: figure for name, figure in drawn.items() if figure is not None}
