"""How figures look and quantities are named: one palette, one set of symbols, the units that people read."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from ponn_torch.optimal_control.problem import DisplayUnit, OptimalControlProblem
from ponn_torch.solving.solution import Solution

# Okabe and Ito's palette, which stays distinct for colour-blind readers
BLUE, VERMILLION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK, GREY = "#E69F00", "#56B4E9", "#222222", "#8A8A8A"
COMPONENTS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
ARCS = {"max": VERMILLION, "interior": ORANGE, "singular": ORANGE, "min": SKY}  # colour of an arc by its label

_RC: Any = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "legend.handlelength": 1.4,
    "legend.columnspacing": 1.2,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.formatter.use_mathtext": True,
    "axes.formatter.limits": (-3, 5),
    "lines.linewidth": 1.4,
    "figure.facecolor": "white",
}

P = ParamSpec("P")
T = TypeVar("T")


def house_style(draw: Callable[P, T]) -> Callable[P, T]:
    """Run a drawing function under the house style and leave matplotlib's own settings as they were."""

    @wraps(draw)
    def styled(*args: P.args, **kwargs: P.kwargs) -> T:
        with rc_context(_RC):
            return draw(*args, **kwargs)

    return styled


def save(figure: Figure, path: Path, *, dpi: int = 150) -> None:
    """Write a figure to a file whose suffix names the format; parent folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)


# -- symbols and units --------------------------------------------------------------------------------------

_GREEK = {
    *(
        "alpha",
        "beta",
        "gamma",
        "delta",
        "epsilon",
        "zeta",
        "eta",
        "theta",
        "kappa",
        "lambda",
        "mu",
        "nu",
        "xi",
    ),
    *("rho", "sigma", "tau", "phi", "chi", "psi", "omega"),
}
_CUSTOMARY = {"thrust": "T", "acceleration": "a", "force": "F", "torque": "M", "control": "u"}


def symbol(name: str) -> str:
    """A name as TeX without dollar signs: r, \\theta, T for thrust, otherwise the word upright."""
    name = _CUSTOMARY.get(name, name)
    if name in _GREEK:
        return rf"\{name}"
    return name if len(name) == 1 else rf"\mathrm{{{name.replace('_', chr(92) + ' ')}}}"


def component_symbols(name: str, size: int, wrap: str = "{}") -> list[str]:
    """One label per component: r_x, r_y, r_z up to three, else x_1, …; ``wrap`` may add a λ or a hat."""
    if size == 1:
        return [f"${wrap.format(symbol(name))}$"]
    ends = "xyz"[:size] if size <= 3 else [str(i + 1) for i in range(size)]
    return [f"${wrap.format(f'{symbol(name)}_{{{end}}}')}$" for end in ends]


def unit(problem: OptimalControlProblem, name: str) -> DisplayUnit:
    """The unit in which a state, control, ``time`` or ``cost`` is shown; SI where the problem names none."""
    return problem.display.get(name, DisplayUnit("s" if name == "time" else ""))


def costate_unit(problem: OptimalControlProblem, name: str) -> DisplayUnit:
    """Unit of a costate, cost per state: kg/km; dimensionless where the two agree."""
    cost, state = unit(problem, "cost"), unit(problem, name)
    if cost == state or not (cost.label or state.label):
        return DisplayUnit("", cost.size / state.size)
    below = f"({state.label})" if "/" in state.label else state.label
    label = f"{cost.label or '1'}/{below}" if state.label else cost.label
    return DisplayUnit(label, cost.size / state.size)


def axis_label(tex: str, shown: DisplayUnit) -> str:
    return f"${tex}$ ({shown.label})" if shown.label else f"${tex}$"


def decimal_exponent(largest: float) -> int:
    """The power of ten that labels carry in place of the ticks; 0 for numbers that read well as they are."""
    if not largest > 0.0:
        return 0
    exponent = math.floor(math.log10(largest))
    return exponent if exponent > 4 or exponent < -3 else 0


def number(value: float, shown: DisplayUnit, form: str = ".7g") -> str:
    """A value in SI as text in its display unit."""
    return f"{value / shown.size:{form}} {shown.label}".rstrip()


def columns(rows: Sequence[tuple[str, str]]) -> list[str]:
    """A line for every label and what it stands for, which begins in the same column."""
    width = max([12, *(len(label) + 2 for label, _ in rows)])
    return [f"{label:{width}}{text}" for label, text in rows]


def arc_intervals(solution: Solution) -> list[tuple[float, float, str]]:
    """(start, end, label) of every arc, in s; [] where the solution is not split."""
    if not solution.arcs:
        return []
    ends = [0.0, *solution.switch_times, solution.final_time]
    return list(zip(ends[:-1], ends[1:], solution.arcs, strict=True))


# -- time axes ----------------------------------------------------------------------------------------------


def in_time_unit(solution: Solution, t: Tensor | Sequence[float]) -> Tensor:
    values = t if isinstance(t, Tensor) else solution.curve.xi.new_tensor(list(t))
    return (values / unit(solution.problem, "time").size).detach().cpu()


def time_axes(
    solution: Solution, n_rows: int, *, width: float = 7.0, height: float = 1.9, measured: bool = True
) -> tuple[Figure, list[Axes]]:
    """A column of axes that share time in display units, with a thin dashed line at every switch.

    A ``measured`` layout makes room for all texts, at the price of drawing twice; else the margins are fixed.
    """
    figure = Figure(figsize=(width, 0.6 + height * n_rows), layout="constrained" if measured else None)
    axes = figure.subplots(n_rows, 1, sharex=True, squeeze=False)[:, 0].tolist()
    end = float(in_time_unit(solution, [solution.final_time])[0])
    for ax in axes:
        for t in in_time_unit(solution, solution.switch_times).tolist():
            ax.axvline(t, color=GREY, lw=0.7, ls=(0, (4, 3)), zorder=1.5)
        ax.margins(x=0)
    axes[0].set_xlim(0.0, end)
    axes[-1].set_xlabel(axis_label("t", unit(solution.problem, "time")))
    if not measured:
        tall = figure.get_figheight()  # room for labels below and for a legend on the right
        figure.subplots_adjust(left=0.14, right=0.88, top=1 - 0.24 / tall, bottom=0.48 / tall, hspace=0.15)
    figure.align_ylabels(axes)
    return figure, axes


def heading_texts(solution: Solution) -> tuple[str, str]:
    """What is solved; its cost and regime."""
    problem = solution.problem
    regime = f", $\\rho$ = {solution.smoothing:.3g}" if solution.smoothing is not None else ""
    cost = number(solution.cost, unit(problem, "cost"))
    return problem.description or problem.name, f"{problem.cost_name} {cost}{regime}"


def heading(solution: Solution, first: Axes, last: Axes | None = None, *, pad: float = 8.0) -> None:
    """A title on the left of the first axes and one on the right of the last."""
    left, right = heading_texts(solution)
    first.set_title(left, loc="left", pad=pad)
    (last or first).set_title(right, loc="right", pad=pad)


def legend_right(ax: Axes) -> None:
    """A legend outside the axes, so that it never covers a curve."""
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), borderaxespad=0.4)
