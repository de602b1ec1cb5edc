"""Figures that tell whether to believe a solution: drift of H, residual between the nodes, convergence."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from ponn_torch.optimal_control.curve import Curve
from ponn_torch.reporting.style import (
    BLACK,
    BLUE,
    COMPONENTS,
    GREY,
    VERMILLION,
    heading,
    house_style,
    in_time_unit,
    legend_right,
    symbol,
    time_axes,
)
from ponn_torch.solving.result import StageResult
from ponn_torch.solving.solution import Solution

SMOOTH = "smooth"  # name of the stages before a refinement


def _logarithmic(values: Tensor) -> Tensor:
    """Values for a logarithmic axis: exact zeros are left out."""
    values = values.abs().cpu()
    return torch.where(values > 0, values, torch.nan)


@house_style
def hamiltonian_figure(solution: Solution) -> Figure:
    """|H(t) − H(0)| relative to the larger of |H| and J/tf; round-off where time does not enter."""
    samples = solution.sample(800)
    h = samples.hamiltonian.cpu()
    scale = max(float(h.abs().max()), abs(solution.cost) / solution.final_time)
    figure, (ax,) = time_axes(solution, 1, height=2.4)
    drift = (h - h[0]) / (scale or 1.0)
    ax.semilogy(in_time_unit(solution, samples.t), _logarithmic(drift), color=BLACK, lw=1.0)
    ax.set_ylabel(r"drift of $H$ (relative)")
    heading(solution, ax)
    return figure


# -- residual -----------------------------------------------------------------------------------------------


def _at_nodes(curve: Curve) -> tuple[Tensor, Tensor]:
    """(scaled t (K·n,), |ẇ − F| (K·n, 2n)) at the collocation nodes."""
    collocation = curve.collocation
    t, w, rate, segment = curve.on_segments(collocation.discretisation.nodes.points)
    return t, (rate - collocation.bvp.rates(t[:, None], w, curve.setting(segment))).abs()


def _equations(curve: Curve) -> dict[str, list[int]]:
    """Columns of w whose equation the solver had to satisfy, by label; chained ones hold exactly."""
    bvp = curve.collocation.bvp
    solved = {chain.columns[-1] for chain in bvp.chains}
    out: dict[str, list[int]] = {}
    for shift, wrap in ((0, r"\dot {}"), (bvp.n_states, r"\dot \lambda_{{{}}}")):
        for name, where in bvp.problem.slices.items():
            columns = [i + shift for i in range(where.start, where.stop) if i + shift in solved]
            if columns:
                out[f"${wrap.format(symbol(name))}$"] = columns
    return out


@house_style
def residual_figure(solution: Solution) -> Figure:
    """|ẇ − F| in scaled units, the largest component per equation: dots at the nodes, lines between."""
    curve, time_unit = solution.curve, solution.bvp.time_unit
    n_segments = curve.collocation.n_segments
    t, defect = curve.defect(max(60, 800 // n_segments))
    t_node, at_node = _at_nodes(curve)
    figure, (ax,) = time_axes(solution, 1, height=3.0)
    for i, (label, columns) in enumerate(_equations(curve).items()):
        colour = COMPONENTS[i % len(COMPONENTS)]
        off = _logarithmic(defect[:, columns].abs().amax(-1))
        on = _logarithmic(at_node[:, columns].amax(-1))
        ax.semilogy(in_time_unit(solution, t * time_unit), off, color=colour, lw=0.9, alpha=0.85, label=label)
        ax.semilogy(in_time_unit(solution, t_node * time_unit), on, ".", color=colour, ms=3.0)
    ax.set_ylabel(r"$|\dot w - F|$ (scaled)")
    ax.plot([], [], ".", color=BLACK, ms=4, label="at nodes")
    legend_right(ax)
    heading(solution, ax)
    return figure


# -- convergence --------------------------------------------------------------------------------------------


def stage_label(stage: StageResult) -> str:
    return stage.name if stage.smoothing is None else rf"$\rho$ = {stage.smoothing:.3g}"


def _band(ax: Axes, stage: StageResult, first: int, last: int, total: int, shaded: bool) -> None:
    if shaded:
        ax.axvspan(first - 0.5, last + 0.5, color=GREY, alpha=0.09, lw=0)
    share = (last - first + 1) / total
    if share < 0.012:  # no room for words
        return
    narrow = share < 0.09
    ax.text(
        (first + last) / 2, 1.02, stage_label(stage), transform=ax.get_xaxis_transform(), fontsize=7,
        ha="left" if narrow else "center", va="bottom", rotation=60 if narrow else 0, rotation_mode="anchor",
    )  # fmt: skip


def _refines(stage: StageResult) -> bool:
    """Whether it is one of a refinement: without ρ, but not the only stage of a problem that needs none."""
    return stage.smoothing is None and stage.name != SMOOTH


@house_style
def convergence_figure(stages: Sequence[StageResult]) -> Figure:
    """‖r‖ per iteration, stage after stage; the smoothing on top, stages of a refinement coloured.

    Raises:
        ValueError: no stage has records.
    """
    shown = [stage for stage in stages if stage.records]
    if not shown:
        raise ValueError("stages = no stage with records; at least one iteration is needed")
    total = sum(len(stage.records) for stage in shown)
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    ax = figure.add_subplot()
    first, several_starts = 1, len({stage.start for stage in shown}) > 1
    kept = shown[-1].start
    for i, stage in enumerate(shown):
        at = list(range(first, first + len(stage.records)))
        norms = [float(record["norm"]) for record in stage.records]
        norm = _logarithmic(torch.tensor(norms, dtype=torch.float64))
        colour = VERMILLION if _refines(stage) else BLUE
        colour = colour if stage.start == kept else GREY
        ax.semilogy(at, norm, color=colour, lw=1.5, marker="." if len(at) == 1 else None)
        rejected = [k for k, record in enumerate(stage.records) if not record.get("accepted", True)]
        ax.semilogy([at[k] for k in rejected], [norm[k] for k in rejected], "|", color=colour, ms=6, mew=0.8)
        _band(ax, stage, first, at[-1], total, i % 2 == 1)
        first += len(at)
    handles = []
    ours = [stage for stage in shown if stage.start == kept]
    if any(not _refines(stage) for stage in ours):
        smoothed = any(stage.smoothing is not None for stage in ours)
        handles.append(Line2D([], [], color=BLUE, label="smoothed" if smoothed else SMOOTH))
    if any(_refines(stage) for stage in ours):
        name = next(stage.name for stage in reversed(ours) if _refines(stage))
        handles.append(Line2D([], [], color=VERMILLION, label=name))
    if several_starts:
        handles.append(Line2D([], [], color=GREY, label="other starts"))
    handles.append(Line2D([], [], color=BLACK, marker="|", ls="", label="rejected step"))
    ax.legend(handles=handles, loc="best")
    ax.set_xlim(0.5, total + 0.5)
    ax.set_xlabel("iteration")
    ax.set_ylabel(r"residual norm $\|r\|$")
    return figure
