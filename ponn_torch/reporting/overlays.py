"""Figures that lay runs over each other: histories of residual and error, and the solutions themselves."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from ponn_torch.reporting.compare import Comparison
from ponn_torch.reporting.members import Member
from ponn_torch.reporting.style import BLACK, COMPONENTS, axis_label, costate_unit, house_style, symbol, unit
from ponn_torch.solving.solution import Solution

STYLES = ("-", "--", ":", "-.")
AGAINST = {"iteration": "iteration", "seconds": "CPU time (s)", "residuals": "residual evaluations"}


def _looks(comparison: Comparison) -> dict[str, dict[str, object]]:
    """Colour and line of each configuration."""
    n = len(COMPONENTS)
    return {
        label: {"color": COMPONENTS[i % n], "ls": STYLES[(i // n) % len(STYLES)]}
        for i, label in enumerate(comparison.groups)
    }


def _history(member: Member, across: str, up: str) -> tuple[list[float], list[float]]:
    """Points of one run where the quantity was recorded."""
    records = member.iterations
    points = [
        (float(k) if across == "iteration" else float(record[across]), record[up])
        for k, record in enumerate(records, start=1)
        if record.get(up) is not None
    ]
    points = [(x, y) for x, y in points if y > 0]
    return [x for x, _ in points], [y for _, y in points]


def _with_cost_errors(comparison: Comparison) -> bool:
    """Note |J − known|/|known| in the records that have a cost; whether any has."""
    found = False
    for member in comparison.members:
        known = member.outcome.get("known_cost")
        for record in member.iterations:
            if known and record.get("cost") is not None:
                record["cost_error"] = abs(record["cost"] - known) / abs(known)
                found = True
    return found


@house_style
def histories_figure(comparison: Comparison) -> Figure | None:
    """Residual, and errors where they were recorded, against iterations, CPU time and residual evaluations.

    One line a run; the last point of each is marked, filled where the run was certified. None without records.
    """
    if not any(member.iterations for member in comparison.members):
        return None
    rows = {"norm": r"residual $\|r\|$ (best so far)"}
    for name in ("states", "costates"):
        if any(f"error_{name}" in record for member in comparison.members for record in member.iterations):
            rows[f"error_{name}"] = f"error of {name}"
    if _with_cost_errors(comparison):
        rows["cost_error"] = r"$|J - J^*|/J^*$"
    figure = Figure(figsize=(10.0, 0.8 + 2.5 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), len(AGAINST), squeeze=False, sharey="row", sharex="col")
    looks = _looks(comparison)
    for row, (up, name) in zip(axes, rows.items(), strict=True):
        for ax, across in zip(row, AGAINST, strict=True):
            for label, group in comparison.groups.items():
                for member in group:
                    _draw_history(ax, *_history(member, across, up), looks[label], member.certified)
            ax.set_xscale("log")
            ax.set_yscale("log")
        row[0].set_ylabel(name)
    for ax, text in zip(axes[-1], AGAINST.values(), strict=True):
        ax.set_xlabel(text)
    _legend(figure, comparison)
    return figure


def _draw_history(ax: Axes, x: list[float], y: list[float], look: Mapping[str, object], certified: bool) -> None:
    if not x:
        return
    ax.plot(x, y, lw=1.0, alpha=0.75, **look)  # type: ignore[arg-type]
    face = look["color"] if certified else "white"
    ax.plot(x[-1], y[-1], "o", ms=4, mfc=face, mec=look["color"], mew=1.0, alpha=0.9)


def _legend(figure: Figure, comparison: Comparison, reference: bool = False) -> None:
    handles = [Line2D([], [], label=label, **look) for label, look in _looks(comparison).items()]  # type: ignore[arg-type]
    if reference:
        handles.append(Line2D([], [], color=BLACK, lw=3, alpha=0.25, label="reference"))
    longest = max(len(str(handle.get_label())) for handle in handles)
    figure.legend(handles=handles, loc="outside lower center", ncols=max(1, min(len(handles), 130 // (longest + 6))))


# -- solutions -----------------------------------------------------------------------------------------------


def _quantities(solution: Solution, t: Tensor) -> dict[str, Tensor]:
    """The size of the first control, of every state and of every costate at times (m,), in display units."""
    samples, problem = solution(t), solution.problem
    name = next(name for name in samples.control if not name.endswith("_magnitude"))

    def size(values: Tensor) -> Tensor:
        return values[:, 0] if values.shape[-1] == 1 else values.norm(dim=-1)

    shown = {rf"{symbol(name)}": (samples.control[name], unit(problem, name))}
    for state in problem.states:
        shown[symbol(state)] = (samples.states[state], unit(problem, state))
    for state in problem.states:
        shown[rf"\lambda_{{{symbol(state)}}}"] = (samples.costates[state], costate_unit(problem, state))
    out = {}
    for tex, (values, shape) in shown.items():
        tex = tex if values.shape[-1] == 1 else rf"\|{tex}\|"
        out[axis_label(tex, shape)] = size(values).double().cpu() / shape.size
    return out


@house_style
def solutions_figure(comparison: Comparison, n_points: int = 301) -> Figure | None:
    """Control, states and costates of the best run of each configuration, over the reference; None without any."""
    best = {label: _best(comparison, label) for label in comparison.groups}
    drawn = {label: solution for label, solution in best.items() if solution is not None}
    if not drawn:
        return None
    known = comparison.reference.solution if comparison.reference is not None else None
    first = next(iter(drawn.values()))
    names = list(_quantities(first, torch.tensor([0.0, first.final_time], dtype=torch.float64)))
    n_states = (len(names) - 1) // 2
    figure = Figure(figsize=(10.0, 1.0 + 1.7 * (n_states + 1)), layout="constrained")
    grid = figure.add_gridspec(n_states + 1, 2)
    axes = [figure.add_subplot(grid[0, :])]
    axes += [figure.add_subplot(grid[1 + i % n_states, i // n_states]) for i in range(2 * n_states)]
    clock = unit(first.problem, "time")
    looks = _looks(comparison)
    curves = [(solution, looks[label]) for label, solution in drawn.items()]
    if known is not None:
        curves.insert(0, (known, {"color": BLACK, "lw": 4.0, "alpha": 0.25}))
    for solution, look in curves:
        t = torch.linspace(0.0, solution.final_time, n_points, dtype=torch.float64)
        for ax, values in zip(axes, _quantities(solution, t).values(), strict=True):
            ax.plot(np.asarray(t / clock.size), np.asarray(values), **look)  # type: ignore[arg-type]
    for ax, name in zip(axes, names, strict=True):
        ax.set_ylabel(name)
        ax.margins(x=0)
    for ax in (axes[n_states], axes[-1]):
        ax.set_xlabel(axis_label("t", clock))
    _legend(figure, comparison, known is not None)
    return figure


def _best(comparison: Comparison, label: str) -> Solution | None:
    """The cheapest certified solution of a configuration, else the one with the smallest residual between nodes."""
    with_solution = [member for member in comparison.groups[label] if member.solution is not None]
    certified = [member for member in with_solution if member.certified]

    def by_cost(member: Member) -> float:
        return member.cost

    def by_residual(member: Member) -> float:
        return member.off_node_residual if math.isfinite(member.off_node_residual) else math.inf

    if certified:
        return min(certified, key=by_cost).solution
    return min(with_solution, key=by_residual).solution if with_solution else None
