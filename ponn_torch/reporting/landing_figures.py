"""Pure functions Landing → Figure: trajectories, thrust and its limits, where landers came down, time of plans."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure

from ponn_torch.guidance.descent import Landing
from ponn_torch.guidance.touchdown import Limits, landed
from ponn_torch.reporting.flight_figures import timing_figure
from ponn_torch.reporting.style import BLUE, GREEN, GREY, ORANGE, SKY, VERMILLION, house_style

MOST_DRAWN = 50  # landers; more say nothing more


@house_style
def trajectory_figure(flight: Landing, fleet: Landing | None = None) -> Figure:
    """Altitude over both horizontal coordinates: the nominal lander on top of the fleet."""
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for ax, i, name in zip(axes, (0, 1), "xy", strict=True):
        if fleet is not None:
            ax.plot(fleet.states[:, :MOST_DRAWN, i], fleet.states[:, :MOST_DRAWN, 2], color=SKY, lw=0.6, alpha=0.6)
        ax.plot(flight.states[:, 0, i], flight.states[:, 0, 2], color=BLUE)
        begins = flight.starts[flight.planned[:, 0]]
        ax.plot(flight.states[begins, 0, i], flight.states[begins, 0, 2], "o", color=BLUE, ms=3, label="plans made")
        ax.plot(0, 0, "+", color=VERMILLION, ms=9, label="target")
        ax.set_xlabel(f"${name}$ (m)")
    axes[0].set_ylabel("$z$ (m)")
    axes[0].legend(loc="best")
    axes[0].set_title(flight.problem.description, loc="left")
    if fleet is not None:
        axes[1].set_title(f"nominal lander and {min(len(fleet), MOST_DRAWN)} of {len(fleet)}", loc="right")
    return figure


@house_style
def thrust_figure(flight: Landing, fleet: Landing | None = None) -> Figure:
    """Commanded thrust, the engines' bounds, and the bound that plans keep to."""
    figure = Figure(figsize=(7.0, 3.0), layout="constrained")
    ax = figure.subplots()
    if fleet is not None:
        shown = fleet.thrust[:, :MOST_DRAWN] / 1e3
        ax.plot(fleet.times[:-1], shown, color=SKY, lw=0.6, alpha=0.6)
    ax.step(flight.times[:-1], flight.thrust[:, 0] / 1e3, color=VERMILLION, where="post", label="commanded")
    for bound in flight.problem.thrust_bounds:
        ax.axhline(bound / 1e3, color=GREY, lw=0.8, ls=":")
    planned = float(flight.problem.planned.parameters["maximum_thrust"])
    ax.axhline(planned / 1e3, color=ORANGE, lw=1.0, ls="--", label="bound of the plans")
    ax.set_xlabel("$t$ (s)")
    ax.set_ylabel("thrust (kN)")
    ax.legend(loc="best")
    return figure


@house_style
def dispersion_figure(fleet: Landing, limits: Limits) -> Figure:
    """Miss and impact of every lander of a fleet with the limits; not where all failed to come down."""
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    ground, both = figure.subplots(1, 2)
    down = landed(fleet, limits)
    for who, colour in ((down, GREEN), (~down, VERMILLION)):
        ground.plot(fleet.states[-1, who, 0], fleet.states[-1, who, 1], ".", color=colour)
        both.plot(fleet.miss[who].clamp_min(1e-6), fleet.impact[who].clamp_min(1e-6), ".", color=colour)
    angle = torch.linspace(0.0, 2 * torch.pi, 181, dtype=torch.float64)
    ground.plot(limits.miss * angle.cos(), limits.miss * angle.sin(), color=GREY, lw=0.8, ls=":")
    ground.set_aspect("equal", adjustable="datalim")
    ground.set_xlabel("$x$ at the end (m)")
    ground.set_ylabel("$y$ at the end (m)")
    ground.set_title(f"{int(down.sum())} of {len(fleet)} landed", loc="left")
    both.axvline(limits.miss, color=GREY, lw=0.8, ls=":")
    both.axhline(limits.impact, color=GREY, lw=0.8, ls=":")
    both.set(xscale="log", yscale="log", xlabel="distance from the target (m)", ylabel="speed at the target (m/s)")
    return figure


def landing_figures(
    flight: Landing, fleet: Landing | None = None, limits: Limits | None = None, deadline: float | None = None
) -> dict[str, Figure]:
    """All that apply, by name."""
    figures = {"trajectory": trajectory_figure(flight, fleet), "thrust": thrust_figure(flight, fleet)}
    if fleet is not None:
        figures["dispersion"] = dispersion_figure(fleet, limits or Limits())
    seconds, late, kept = flight.seconds_per_plan, int(flight.n_late.sum()), int(flight.n_kept.sum())
    title = f"{len(seconds)} plans: {late} late, {kept} not found"
    return figures | {"timing": timing_figure(seconds, deadline, what="plan", counted="plans", title=title, bins=30)}
