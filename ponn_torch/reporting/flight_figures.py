"""Pure functions Flight → Figure: tracking errors, controls, what decisions are worth, how long they take."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ponn_torch.guidance.accuracy import GuidanceCertificate
from ponn_torch.guidance.closed_loop import Flight
from ponn_torch.reporting.style import BLUE, GREEN, GREY, ORANGE, SKY, VERMILLION, axis_label, house_style, symbol


def _axes(flight: Flight, n_rows: int, height: float = 1.3) -> tuple[Figure, list[Axes]]:
    """A column of axes that share time, titled."""
    figure = Figure(figsize=(7.0, 0.8 + height * n_rows), layout="constrained")
    axes = figure.subplots(n_rows, 1, sharex=True, squeeze=False)[:, 0].tolist()
    plant = flight.problem.plant
    for ax in axes:
        ax.margins(x=0)
    axes[-1].set_xlabel(axis_label("t", plant.time))
    axes[0].set_title(flight.problem.description or plant.name, loc="left")
    figure.align_ylabels(axes)
    return figure, axes


def _times(flight: Flight) -> torch.Tensor:
    return flight.times / flight.problem.plant.time.size


@house_style
def tracking_figure(flight: Flight, dispersed: Flight | None = None) -> Figure:
    """State minus reference, one axis per state; with the band that a Monte Carlo's vehicles fill."""
    plant = flight.problem.plant
    figure, axes = _axes(flight, plant.n_states)
    for i, (ax, (name, unit)) in enumerate(zip(axes, plant.states.items(), strict=True)):
        if dispersed is not None:
            band = dispersed.errors[..., i].flatten(1) / unit.size
            ax.fill_between(_times(dispersed), band.amin(1), band.amax(1), color=SKY, alpha=0.35, lw=0)
        ax.plot(_times(flight), flight.errors[:, i] / unit.size, color=BLUE)
        ax.set_ylabel(axis_label(rf"\Delta {symbol(name)}", unit))
    if dispersed is not None:
        axes[0].set_title(f"nominal run and {dispersed.states.shape[1]} vehicles", loc="right")
    return figure


@house_style
def control_figure(flight: Flight) -> Figure:
    """Controls as applied, those of the reference, and what the actuators reach."""
    plant = flight.problem.plant
    figure, axes = _axes(flight, plant.n_controls, 1.9)
    t = _times(flight)[:-1]
    _, reference = flight.problem.reference(flight.times[:-1])
    for i, (ax, (name, unit)) in enumerate(zip(axes, plant.controls.items(), strict=True)):
        ax.plot(t, reference[:, i] / unit.size, color=GREY, ls="--", lw=1.0, label="reference")
        ax.step(t, flight.controls[:, i] / unit.size, color=VERMILLION, where="post", label="applied")
        low, high = ax.get_ylim()
        for bounds in (plant.lower, plant.upper):
            # a bound far from what is used would flatten the curve
            if bounds is not None and low - (high - low) <= bounds[i] / unit.size <= high + (high - low):
                ax.axhline(bounds[i] / unit.size, color=GREY, lw=0.8, ls=":")
        ax.set_ylabel(axis_label(symbol(name), unit))
    axes[0].legend(loc="upper right")
    return figure


@house_style
def accuracy_figure(flight: Flight, certificate: GuidanceCertificate) -> Figure:
    """The loss, which is round-off, beside the true error of the control and the residual between the nodes."""
    figure, (ax,) = _axes(flight, 1, 2.9)
    t = _times(flight)
    ax.semilogy(t[:-1], flight.loss.clamp_min(1e-18), color=GREY, lw=1.0, label="loss at the nodes")
    at = t[torch.tensor(certificate.cycles, dtype=torch.long)]
    shown = (
        (certificate.off_node_residuals, ORANGE, "s", "residual between the nodes"),
        (certificate.control_errors, VERMILLION, "o", f"control against {certificate.oracle}"),
        (certificate.iteration_errors, BLUE, "v", "control against the passes' limit"),
    )
    for values, colour, marker, label in shown:
        ax.semilogy(at, torch.tensor(values).clamp_min(1e-18), color=colour, marker=marker, ms=3.5, lw=0.8, label=label)
    ax.axhline(certificate.allowed.oracle, color=GREY, lw=0.8, ls=":")
    ax.set_ylabel("relative error, loss")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


@house_style
def timing_figure(
    seconds: torch.Tensor, deadline: float | None, *, what: str, counted: str, title: str, bins: int
) -> Figure:
    """How long decisions, or plans, took, with the median and the deadline."""
    figure = Figure(figsize=(7.0, 2.8), layout="constrained")
    ax = figure.subplots()
    milliseconds = 1e3 * seconds
    ax.hist(milliseconds.numpy(), bins=bins, color=GREEN, alpha=0.85)
    if len(milliseconds):
        ax.axvline(float(milliseconds.median()), color=VERMILLION, lw=1.2, label="median")
    if deadline is not None:
        ax.axvline(1e3 * deadline, color=GREY, ls="--", label="deadline")
    ax.set_xlabel(f"time of a {what} (ms)")
    ax.set_ylabel(counted)
    ax.set_title(title, loc="right")
    ax.legend(loc="upper right")
    return figure


@house_style
def limits_figure(flight: Flight, dispersed: Flight | None = None) -> Figure | None:
    """The plant's limits as shares of what is allowed; None where it has none."""
    limits = flight.limits()
    if not limits:
        return None
    figure, axes = _axes(flight, len(limits), 1.5)
    bands = dispersed.limits() if dispersed is not None else {}
    for ax, (name, values) in zip(axes, limits.items(), strict=True):
        if dispersed is not None:
            band = bands[name].flatten(1)
            ax.fill_between(_times(dispersed)[:-1], band.amin(1), band.amax(1), color=SKY, alpha=0.35, lw=0)
        ax.plot(_times(flight)[:-1], values, color=BLUE)
        ax.axhline(1.0, color=GREY, lw=0.8, ls=":")
        ax.set_ylabel(name)
    axes[0].set_title("share of the limit", loc="right")
    return figure


def flight_figures(
    flight: Flight,
    certificate: GuidanceCertificate | None = None,
    dispersed: Flight | None = None,
    deadline: float | None = None,
) -> dict[str, Figure]:
    """All that apply, by name."""
    replaced = f"{flight.n_late} of {flight.n_cycles} decisions replaced"
    figures: dict[str, Figure | None] = {
        "tracking": tracking_figure(flight, dispersed),
        "control": control_figure(flight),
        "accuracy": accuracy_figure(flight, certificate) if certificate is not None else None,
        "timing": timing_figure(flight.seconds, deadline, what="decision", counted="cycles", title=replaced, bins=60),
        "limits": limits_figure(flight, dispersed),
    }
    return {name: figure for name, figure in figures.items() if figure is not None}
