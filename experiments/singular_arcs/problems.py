"""Problems of the literature, and others with exact answers, whose optima have singular arcs."""

from __future__ import annotations

import torch
from torch import Tensor

from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.problem import Named, OptimalControlProblem

Rates = dict[str, Tensor]


def regulator() -> OptimalControlProblem:
    """½∫x² dt with ẋ = u from 1 to ½: down at full speed, rest at zero, up at full speed; 1/6 + 1/48."""
    return OptimalControlProblem(
        name="regulator",
        states={"x": 1},
        control=Box("u", 1.0, -1.0),
        dynamics=lambda t, x, u, p: {"x": u.u},
        running_cost=lambda t, x, u, p: 0.5 * x.x**2,
        initial={"x": 1.0},
        final={"x": 0.5},
        final_time=3.0,
        known_cost=1 / 6 + 1 / 48,
    )


def pair() -> OptimalControlProblem:
    """Two regulators side by side, from 1 and ½: each comes to rest in its own time, and then both rest; 1/6 + 1/48."""
    return OptimalControlProblem(
        name="pair",
        states={"x": 1, "y": 1},
        control=Box("u", 1.0, -1.0, size=2),
        dynamics=lambda t, x, u, p: {"x": u.u[..., :1], "y": u.u[..., 1:]},
        running_cost=lambda t, x, u, p: 0.5 * (x.x**2 + x.y**2),
        initial={"x": 1.0, "y": 0.5},
        final={},
        final_time=3.0,
        known_cost=1 / 6 + 1 / 48,
    )


def catalyst_mixing(final_time: float = 1.0) -> OptimalControlProblem:
    """Jackson (1968): the mixture of two catalysts along a reactor that leaves the most of the product (COPS)."""

    def dynamics(t: Tensor, x: Named, u: Named, p: Named) -> Rates:
        change = u.u * (10.0 * x.b - x.a)
        return {"a": change, "b": -change - (1.0 - u.u) * x.b}

    return OptimalControlProblem(
        name="catalyst_mixing",
        states={"a": 1, "b": 1},
        control=Box("u", 1.0, 0.0),
        dynamics=dynamics,
        terminal_cost=lambda t, x, p: x.a + x.b - 1.0,
        initial={"a": 1.0, "b": 0.0},
        final={},
        final_time=final_time,
    )


def van_der_pol() -> OptimalControlProblem:
    """½∫(x² + y²) dt along van der Pol's oscillator with a bounded input, in fixed time."""
    return OptimalControlProblem(
        name="van_der_pol",
        states={"x": 1, "y": 1},
        control=Box("u", 1.0, -1.0),
        dynamics=lambda t, x, u, p: {"x": x.y, "y": -x.x + x.y * (1.0 - x.x**2) + u.u},
        running_cost=lambda t, x, u, p: 0.5 * (x.x**2 + x.y**2),
        initial={"x": 0.0, "y": 1.0},
        final={},
        final_time=4.0,
    )


def jacobson() -> OptimalControlProblem:
    """½∫(x² + v²) dt with ẍ = u: on the arc x + v = 0."""
    return OptimalControlProblem(
        name="jacobson",
        states={"x": 1, "v": 1},
        control=Box("u", 1.0, -1.0),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u},
        running_cost=lambda t, x, u, p: 0.5 * (x.x**2 + x.v**2),
        initial={"x": 0.0, "v": 1.0},
        final={},
        final_time=5.0,
    )


def steep_path() -> OptimalControlProblem:
    """½∫(x − sin t)² dt with |ẋ| ≤ 0.8: on the path where that is not too steep, at a bound where it is."""
    return OptimalControlProblem(
        name="steep_path",
        states={"x": 1},
        control=Box("u", 0.8, -0.8),
        dynamics=lambda t, x, u, p: {"x": u.u},
        running_cost=lambda t, x, u, p: 0.5 * (x.x - torch.sin(t)) ** 2,
        initial={"x": 0.0},
        final={},
        final_time=12.0,
    )
