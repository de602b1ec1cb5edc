"""report.md of a closed loop, with its figures and certificate."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ponn_torch.guidance.accuracy import GuidanceCertificate
from ponn_torch.guidance.closed_loop import Flight
from ponn_torch.reporting.flight_figures import flight_figures
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
    "timing": "Time of decisions",
    "limits": "Limits",
}


def write_flight_report(
    folder: Path,
    *,
    flight: Flight | None = None,
    certificate: GuidanceCertificate | None = None,
    dispersed: Flight | None = None,
    summary: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    message: str = "",
    deadline: float | None = None,
    figures: bool = True,
) -> Path:
    """Write report.md with all that is known, figures, certificate.json and environment.json; the report's path."""
    found = write_environment(folder)
    flown = flight is not None and flight.n_cycles > 0
    title = "Run without a flight"
    if flight is not None:
        title = f"{flight.problem.plant.name}: {flight.problem.description}"
    verdict = certificate.verdict if certificate is not None else "Not certified."
    parts = [f"# {title}", f"**{verdict}**", message if message != verdict else ""]
    if certificate is not None:
        write_json(folder / CERTIFICATE, certificate.to_dict())
        parts.append(f"## Certificate\n\n```\n{certificate.to_text()}\n```")
    if flight is not None and flown:
        units = flight.problem.plant.states
        rows = [
            (name, *(f"{abs(float(flight.errors[at, i])) / unit.size:.4g}" for at in (0, -1)), unit.label)
            for i, (name, unit) in enumerate(units.items())
        ]
        parts.append("## Tracking errors\n\n" + table(("state", "at the start", "at the end", "unit"), rows))
    if summary:
        worst = [(name, f"{value:.4g}") for name, value in summary["final_errors"].items()]
        peaks = [(f"{name}, over its limit", f"{value:.5f}") for name, value in summary["peaks"].items()]
        heading = f"## Monte Carlo of {summary['n_vehicles']} vehicles\n\n"
        parts.append(heading + table(("largest, at the end or over the flight", "value"), [*worst, *peaks]))
    if flight is not None and flown and figures:
        drawn = flight_figures(flight, certificate, dispersed, deadline)
        for name, figure in drawn.items():
            save(figure, folder / FIGURES / f"{name}.png")
        shown = (f"### {CAPTIONS[name]}\n\n![{name}]({FIGURES}/{name}.png)" for name in drawn)
        parts.append("## Figures\n\n" + "\n\n".join(shown))
    parts += [settings_text(settings or {}), environment_line(found)]
    path = folder / REPORT
    path.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return path
