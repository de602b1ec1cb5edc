"""One method on one smooth residual: what it found, held against a known solution."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from experiments.elm_vs_deep.methods import Method
from experiments.tables import Row, spread
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import OptimizeResult
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.solving.guess import ScaledCurve, project

N_TEST = 2001


def run(
    bvp: BoundaryValueProblem, method: Method, seed: int, n_nodes: int, guess: ScaledCurve, truth: ScaledCurve
) -> dict[str, Any]:
    """A row; errors are relative, in the root mean square over even times, of scaled states and costates."""
    nodes = make_nodes("legendre_gauss", method.n_nodes or n_nodes, dtype=bvp.unit.dtype)
    disc = Discretisation(bvp, method.free_function(seed), nodes, conditioning=method.conditioning)
    residual = Collocation.on_segments(disc, bvp.unit.new_tensor([0.0, bvp.final_time]))
    result = method.optimizer.run(residual, project(residual, guess))
    return measured(method.name, seed, residual, result, truth)


def measured(name: str, seed: int, residual: Collocation, result: OptimizeResult, truth: ScaledCurve) -> dict[str, Any]:
    """A result as a row."""
    bvp = residual.bvp
    curve = Curve(residual, result.xi)
    t = torch.linspace(0.0, bvp.final_time, N_TEST, dtype=bvp.unit.dtype)
    found, expected, n = curve(t), truth(t), bvp.n_states

    def error(part: slice) -> float:
        return float((found[:, part] - expected[:, part]).norm() / expected[:, part].norm())

    return {
        "method": name,
        "seed": seed,
        "unknowns": residual.n_unknowns,
        "status": result.status.name,
        "iterations": result.n_iterations,
        "residual_evaluations": result.n_residuals,
        "cpu_s": result.cpu_seconds,
        "norm": float(result.norm),
        "off_node_residual": curve.off_node_residual(),
        "cost": float(residual.cost(result.xi)),
        "state_error": error(slice(0, n)),
        "costate_error": error(slice(n, 2 * n)),
    }


def lines(rows: list[Row], extra: Callable[[list[Row]], dict[str, str]] | None = None) -> list[Row]:
    """A line per method: median [min, max] over its seeds."""
    out: list[Row] = []
    for name in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == name]
        out.append(
            {
                "method": name,
                "unknowns": spread((row["unknowns"] for row in mine), ".0f"),
                **(extra(mine) if extra else {}),
                "error of states": spread(row["state_error"] for row in mine),
                "error of costates": spread(row["costate_error"] for row in mine),
                "residual between nodes": spread(row["off_node_residual"] for row in mine),
                "iterations": spread((row["iterations"] for row in mine), ".0f"),
                "residual evaluations": spread((row["residual_evaluations"] for row in mine), ".0f"),
                "CPU s": spread((row["cpu_s"] for row in mine), ".2f"),
            }
        )
    return out


def zero(bvp: BoundaryValueProblem) -> ScaledCurve:
    """The guess that knows nothing."""

    def curve(t: Tensor) -> Tensor:
        return torch.zeros(len(t), bvp.dimension, dtype=t.dtype)

    return curve
