"""Where the vehicle goes: the path in space and in a plane, with the thrust along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from ponn_torch.reporting.style import (
    ARCS,
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    arc_intervals,
    component_symbols,
    decimal_exponent,
    heading,
    heading_texts,
    house_style,
    unit,
)
from ponn_torch.solving.solution import Samples, Solution

POSITION = "r"  # the state that these figures draw
N_ARROWS = 28
N_POSTS = 9  # in the figure in space


@dataclass(frozen=True)
class _Path:
    """Position (m, size) as shown, pieces of one colour, and thrust arrows: feet and vectors (k, size)."""

    position: Tensor
    pieces: list[tuple[Tensor, str]]
    feet: Tensor
    arrows: Tensor
    labels: list[str]
    name_of_arrows: str

    @property
    def shows_origin(self) -> bool:
        """The origin lies within the box of the path and is not one of its ends."""
        low, high = self.position.amin(0), self.position.amax(0)
        margin = 0.05 * (high - low).max()
        inside = bool(((low - margin <= 0) & (high + margin >= 0)).all())
        ends = self.position[[0, -1]].norm(dim=-1)
        return inside and float(ends.min()) > 1e-3 * float(self.position.norm(dim=-1).max())

    @property
    def extent(self) -> Tensor:
        return self.position.amax(0) - self.position.amin(0)


def _thrust(samples: Samples) -> tuple[str, Tensor] | None:
    """Name and values of the first control that is a vector like the position."""
    size = samples.states[POSITION].shape[-1]
    return next(((name, u) for name, u in samples.control.items() if u.shape[-1] == size), None)


def _path(solution: Solution) -> _Path:
    samples, problem = solution.sample(600), solution.problem
    shown = unit(problem, POSITION)
    exponent = decimal_exponent(float(samples.states[POSITION].abs().max()) / shown.size)
    size_of_unit = shown.size * 10.0**exponent
    position = samples.states[POSITION].cpu() / size_of_unit
    t, pieces = samples.t.cpu(), []
    for start, end, arc in arc_intervals(solution):
        here = (t >= start * (1 - 1e-12)) & (t <= end * (1 + 1e-12))
        pieces.append((position[here], ARCS.get(arc, BLUE)))
    pieces = pieces or [(position, BLUE)]
    feet = arrows = position[:0]
    thrust, name_of_control = _thrust(samples), ""
    if thrust is not None:
        name_of_control = thrust[0]
        at = torch.linspace(0.0, solution.final_time, N_ARROWS + 2, dtype=samples.t.dtype)[1:-1]
        some = solution(at.to(samples.t.device))
        vector = some.control[name_of_control].cpu()
        size = vector.norm(dim=-1, keepdim=True)
        on = size[:, 0] > 0.02 * size.max()
        feet = some.states[POSITION].cpu()[on] / size_of_unit
        extent = float((position.amax(0) - position.amin(0)).max())
        arrows = vector[on] / size.max() * 0.13 * extent
    label_of_unit = f"$10^{{{exponent}}}$ {shown.label}".rstrip() if exponent else shown.label
    symbols = component_symbols(POSITION, position.shape[-1])
    labels = [f"{label} ({label_of_unit})" if label_of_unit else label for label in symbols]
    return _Path(position, pieces, feet, arrows, labels, name_of_control.replace("_", " "))


def _key(solution: Solution, path: _Path) -> list[Line2D]:
    """Legend entries for what is drawn."""
    marks = [
        Line2D([], [], color=BLACK, marker="o", mfc="white", ls="", label="start"),
        Line2D([], [], color=BLACK, marker="s", ls="", label="end"),
    ]
    if path.shows_origin:
        name = solution.problem.display["origin"].label if "origin" in solution.problem.display else "origin"
        marks.append(Line2D([], [], color=ORANGE, mec=BLACK, mew=0.4, marker="*", ms=11, ls="", label=name))
    present = [arc for arc in ARCS if arc in solution.arcs]
    arcs = [Line2D([], [], color=ARCS[arc], lw=2, label=f"{arc} arc") for arc in present]
    look: Any = {"color": BLACK, "marker": r"$\rightarrow$", "ms": 11, "ls": "", "alpha": 0.7}
    arrow = [Line2D([], [], label=path.name_of_arrows, **look)]
    return [*marks, *arcs, *(arrow if len(path.feet) else [])]


def _draw_plane(path: _Path, ax: Axes, across: int, up: int) -> None:
    pair = [across, up]
    for piece, colour in path.pieces:
        ax.plot(*piece[:, pair].T, color=colour, lw=1.8)
    if len(path.feet):
        true_size: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0}
        look: dict[str, Any] = {
            "color": BLACK,
            "alpha": 0.6,
            "width": 0.004,
            "headwidth": 4,
            "headlength": 5,
            "zorder": 3,
        }
        ax.quiver(*path.feet[:, pair].T, *path.arrows[:, pair].T, **true_size, **look)
        tips = path.feet + path.arrows  # quiver does not widen the limits by itself
        ax.update_datalim(tips[:, pair].numpy())
        ax.autoscale_view()
    if path.shows_origin:
        ax.plot(0, 0, marker="*", color=ORANGE, mec=BLACK, mew=0.4, ms=13, ls="")
    ax.plot(*path.position[0, pair], marker="o", color=BLACK, mfc="white", ls="", zorder=4)
    ax.plot(*path.position[-1, pair], marker="s", color=BLACK, ls="", zorder=4)
    ax.set_xlabel(path.labels[across])
    ax.set_ylabel(path.labels[up])
    ax.margins(0.06)
    ax.set_aspect("equal", adjustable="datalim")


@house_style
def plane_figure(solution: Solution) -> Figure | None:
    """The path in the x–y plane, and in x–z where it leaves that plane; equal axes. None without a plane."""
    size = solution.problem.states.get(POSITION, 0)
    if size not in (2, 3):
        return None
    path = _path(solution)
    planes = [(0, 1)]
    if size == 3 and float(path.extent[2]) > 0.2 * float(path.extent[:2].max()):
        planes = [(0, 2), (0, 1)]
    figure = Figure(figsize=(6.4 if len(planes) == 1 else 9.6, 5.4), layout="constrained")
    axes = figure.subplots(1, len(planes), squeeze=False)[0]
    for ax, (across, up) in zip(axes, planes, strict=True):
        _draw_plane(path, ax, across, up)
    heading(solution, axes[0], axes[-1])
    figure.legend(handles=_key(solution, path), loc="outside lower center", ncols=6)
    return figure


def _draw_shadow(path: _Path, ax: Any, floor: float) -> None:
    """The path's shadow on the floor, and posts of equal spacing along it that tell the height."""
    x, y, z = path.position.T
    ax.plot(x, y, torch.full_like(z, floor), color=GREY, lw=1.2, ls=(0, (4, 2)))
    steps = torch.cat([z.new_zeros(1), path.position.diff(dim=0).norm(dim=-1).cumsum(0)])
    at = torch.searchsorted(steps, torch.linspace(0.0, float(steps[-1]), N_POSTS, dtype=z.dtype))
    for i in at.clamp_max(len(z) - 1).tolist():
        ax.plot([x[i], x[i]], [y[i], y[i]], [floor, z[i]], color=GREY, lw=0.6, alpha=0.7)


@house_style
def trajectory_figure(solution: Solution) -> Figure | None:
    """The path in space, equal axes, with thrust arrows; None where position is not a 3-vector ``r``."""
    if solution.problem.states.get(POSITION) != 3:
        return None
    path = _path(solution)
    low, high = path.position.amin(0), path.position.amax(0)
    if path.shows_origin:
        low, high = low.clamp_max(0.0), high.clamp_min(0.0)
    # equal axes; a nearly flat path still gets a box that can be read, and a tall one a floor to stand on
    extent = (high - low).max() * torch.tensor([0.3, 0.3, 0.15], dtype=low.dtype)
    half = torch.maximum((high - low) / 2, extent) * 1.08
    middle, shape = (high + low) / 2, half / half.max()
    figure = Figure(figsize=(6.4, 4.2 + 1.4 * float(shape[2])))
    # placed by hand: the layout engines do not see the labels of 3-D axes
    ax: Any = figure.add_axes((0.02, 0.1, 0.9, 0.84), projection="3d")
    for piece, colour in path.pieces:
        ax.plot(*piece.T, color=colour, lw=1.8)
    if len(path.feet):
        ax.quiver(*path.feet.T, *path.arrows.T, color=BLACK, alpha=0.5, lw=0.9, arrow_length_ratio=0.25)
    if path.shows_origin:
        ax.plot(0, 0, 0, marker="*", color=ORANGE, mec=BLACK, mew=0.4, ms=13, ls="")
    ax.plot(*path.position[0], marker="o", color=BLACK, mfc="white", ls="")
    ax.plot(*path.position[-1], marker="s", color=BLACK, ls="")
    for axis, m, h in zip("xyz", middle.tolist(), half.tolist(), strict=True):
        getattr(ax, f"set_{axis}lim")(m - h, m + h)
    ax.set_box_aspect(shape.tolist(), zoom=1.3 - 0.35 * float(shape[2]))
    _draw_shadow(path, ax, float(middle[2] - half[2]))
    for axis, label, share in zip((ax.xaxis, ax.yaxis, ax.zaxis), path.labels, shape, strict=True):
        axis.set_label_text(label)
        axis.labelpad = 7
        axis.set_major_locator(MaxNLocator(max(2, round(5 * float(share)))))
    ax.view_init(elev=24, azim=-58)
    left, right = heading_texts(solution)
    figure.text(0.04, 0.96, left)
    figure.text(0.96, 0.96, right, ha="right")
    figure.legend(handles=_key(solution, path), loc="lower center", ncols=6)
    return figure
