"""report.md of a closed loop, with its figures and certificate."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ponn_torch.guidance.closed_loop import Flight
from ponn_torch.guidance.descent import Landing
from ponn_torch.guidance.verdict import FlightCertificate
from ponn_torch.reporting.report import (
    CERTIFICATE,
    FIGURES,
    REPORT,
    environment_line,
    settings_text,
    table,
    write_environment,
    write_json,
)
from ponn_torch.reporting.style import save

CAPTIONS = {
    "tracking": "Tracking errors",
    "control": "Controls",
    "accuracy": "What decisions are worth",
    "limits": "Limits",
    "trajectory": "Trajectories",
    "thrust": "Thrust and its limits",
    "dispersion": "Where the landers came down",
    "timing": "Time of decisions",
}


def write_flight_report(
    folder: Path,
    *,
    title: str,
    certificate: FlightCertificate | None = None,
    sections: Sequence[str] = (),
    draw: Callable[[], Mapping[str, Figure]] | None = None,
    settings: Mapping[str, Any] | None = None,
    message: str = "",
) -> Path:
    """Write report.md, the figures that ``draw`` makes, certificate.json and environment.json; the report's path."""
    found = write_environment(folder)
    verdict = certificate.verdict if certificate is not None else "Not certified."
    parts = [f"# {title}", f"**{verdict}**", message if message != verdict else ""]
    if certificate is not None:
        write_json(folder / CERTIFICATE, certificate.to_dict())
        parts.append(f"## Certificate\n\n```\n{certificate.to_text()}\n```")
    parts += sections
    if draw is not None:
        drawn = draw()
        for name, figure in drawn.items():
            save(figure, folder / FIGURES / f"{name}.png")
        shown = (f"### {CAPTIONS[name]}\n\n![{name}]({FIGURES}/{name}.png)" for name in CAPTIONS if name in drawn)
        parts.append("## Figures\n\n" + "\n\n".join(shown))
    parts += [settings_text(settings or {}), environment_line(found)]
    path = folder / REPORT
    path.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return path


def tracking_sections(flight: Flight, summary: Mapping[str, Any]) -> list[str]:
    """Errors at both ends, and what a Monte Carlo came to."""
    rows = [
        (name, *(f"{abs(float(flight.errors[at, i])) / unit.size:.4g}" for at in (0, -1)), unit.label)
        for i, (name, unit) in enumerate(flight.problem.plant.states.items())
    ]
    sections = ["## Tracking errors\n\n" + table(("state", "at the start", "at the end", "unit"), rows)]
    if summary:
        worst = [(name, f"{value:.4g}") for name, value in summary["final_errors"].items()]
        peaks = [(f"{name}, over its limit", f"{value:.5f}") for name, value in summary["peaks"].items()]
        heading = f"## Monte Carlo of {summary['n_vehicles']} vehicles\n\n"
        sections.append(heading + table(("largest, at the end or over the flight", "value"), [*worst, *peaks]))
    return sections


def landing_sections(flight: Landing, fleet: Landing | None) -> list[str]:
    """Where and when landers came down: the nominal one, and the spread of a fleet."""
    names = {"miss": "distance, m", "impact": "speed, m/s", "fuel": "fuel, kg", "arrival": "arrival, s"}
    rows: list[tuple[str, ...]] = []
    for key, name in names.items():
        row: tuple[str, ...] = (name, f"{float(getattr(flight, key)[0]):.5g}")
        if fleet is not None:
            values = getattr(fleet, key)
            row += tuple(f"{float(value):.5g}" for value in (values.min(), values.median(), values.max()))
        rows.append(row)
    header: tuple[str, ...] = ("at the end", "nominal")
    if fleet is not None:
        header += (f"{len(fleet)} landers: least", "median", "most")
    return ["## Landing\n\n" + table(header, rows)]
