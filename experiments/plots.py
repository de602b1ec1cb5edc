"""Figures that studies share: histories of many runs, one colour a configuration, the median run drawn strong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from ponn_torch.reporting.style import COMPONENTS, house_style, save

STYLES = ("-", "--", ":")
Curve = tuple[Sequence[float], Sequence[float]]


@house_style
def histories(groups: Mapping[str, Sequence[Curve]], path: Path, across: str, up: str) -> None:
    """Lines of every group on logarithmic axes; the run that ends in the middle of its group is drawn strong."""
    figure = Figure(figsize=(7.2, 3.8), layout="constrained")
    ax = figure.add_subplot()
    for i, (label, curves) in enumerate(groups.items()):
        look = {"color": COMPONENTS[i % len(COMPONENTS)], "ls": STYLES[i // len(COMPONENTS) % len(STYLES)]}
        ordered = sorted(curves, key=lambda curve: curve[1][-1])
        for curve in ordered:
            middle = curve is ordered[len(ordered) // 2]
            ax.plot(
                *curve, lw=1.6 if middle else 0.6, alpha=1.0 if middle else 0.4, label=label if middle else None, **look
            )
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(across)
    ax.set_ylabel(up)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    with matplotlib.rc_context({"svg.hashsalt": "study"}):
        save(figure, path, dpi=110)


@house_style
def points(groups: Mapping[str, Curve], path: Path, across: str, up: str) -> None:
    """Points of every group over its median line, logarithmic upwards."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    ax = figure.add_subplot()
    for i, (label, (x, y)) in enumerate(groups.items()):
        colour = COMPONENTS[i % len(COMPONENTS)]
        ax.plot(x, y, "o", ms=3.5, color=colour, alpha=0.6)
        values = sorted(set(x))
        middle = [sorted(b for a, b in zip(x, y, strict=True) if a == value) for value in values]
        ax.plot(values, [m[len(m) // 2] for m in middle], "-", color=colour, label=label)
    ax.set_yscale("log")
    ax.set_xlabel(across)
    ax.set_ylabel(up)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path, dpi=110)
