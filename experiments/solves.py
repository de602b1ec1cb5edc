"""One solve as a row of a table."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.earth_mars import earth_mars
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.certificate import Certificate
from ponn_torch.solving.result import SolveResult
from ponn_torch.solving.solution import Solution

PROBLEMS: dict[str, Callable[[], OptimalControlProblem]] = {
    "earth_mars": earth_mars,
    "mars_landing": mars_landing,
}


def row(problem: OptimalControlProblem, seed: int, result: SolveResult) -> dict[str, Any]:
    """What every table reports of a solve, in the problem's units; NaN where there is no solution."""
    out: dict[str, Any] = {
        "problem": problem.name,
        "seed": seed,
        "certified": result.certified,
        "starts": result.n_starts,
        "iterations": sum(stage.n_iterations for stage in result.stages),
        "residual_evaluations": sum(stage.n_residuals for stage in result.stages),
        "linearisations": sum(stage.n_linearisations for stage in result.stages),
        "cpu_s": result.cpu_seconds,
    }
    solution, certificate = result.solution, result.certificate
    missing = solution is None or certificate is None
    out["certificate_s"] = math.nan if missing else certificate.seconds
    out["arcs"] = "" if missing else "-".join(solution.arcs)
    out["off_node_residual"] = math.nan if missing else solution.off_node_residual
    out["hamiltonian_drift"] = math.nan if missing else certificate.hamiltonian_drift
    for name in ("r", "v"):
        unit = problem.display[name]
        out[f"end_error_{name} [{unit.label}]"] = math.nan if missing else _end_error(certificate, name) / unit.size
    out["fuel_kg"] = math.nan if missing else solution.cost
    out["fuel_by_mass_kg"] = math.nan if missing else fuel_by_mass(solution)
    out["message"] = result.message
    return out


def _end_error(certificate: Certificate, name: str) -> float:
    """The worse of the flown extremal and the control flown alone."""
    return max(certificate.end_errors[name], certificate.control_end_errors[name])


def fuel_by_mass(solution: Solution) -> float:
    """m(0) − m(tf), which the papers read off; ∫αT dt is another number where ṁ = −αT does not hold."""
    masses = solution([0.0, solution.final_time]).states["m"]
    return float(masses[0] - masses[1])
