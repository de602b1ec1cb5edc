"""A stage begins along the tangent: exact where solutions are straight, of second order else, left if it misleads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import pytest
import torch
from analytic import minimum_energy, solve
from torch import Tensor

from ponn_torch.ansatz.networks import MLP
from ponn_torch.numerics.linalg import DenseJacobian
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.small_body_landing import small_body_landing
from ponn_torch.solving import walk
from ponn_torch.solving.continuation import Ladder
from ponn_torch.solving.predictor import along_tangent
from ponn_torch.solving.solver import Solver


def pushed(*, push: float = 1.0) -> OptimalControlProblem:
    """Rest to rest against a constant push, by least energy: the control is the one without it, minus the push."""
    return replace(
        minimum_energy(),
        dynamics=lambda t, x, u, p: {"x": x.v, "v": u.u + p.push},
        parameters={"push": push},
        known_cost=None,
    )


@dataclass
class Root:
    """r(ξ) = ξ² − s, of N independent unknowns."""

    value: float

    n_unknowns = 1

    def residual(self, xi: Tensor) -> Tensor:
        return xi.square() - self.value

    def linearise(self, xi: Tensor) -> tuple[Tensor, DenseJacobian]:
        return self.residual(xi), DenseJacobian(torch.diag(2 * xi))

    def blocks(self, residual: Tensor) -> Mapping[str, Tensor]:
        return {"r": residual.norm()}


def column(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)


def test_the_step_is_that_of_euler():
    assert float(along_tangent(Root, column(2.0), 0.0, 4.0, 5.0, 0.0)) == pytest.approx(2.25, abs=1e-7)
    assert float(along_tangent(Root, column(2.0), 0.0, 4.0, 3.0, 0.0)) == pytest.approx(1.75, abs=1e-7)


@pytest.mark.parametrize(
    ("start", "here"),
    [
        (1e-3, 1e-6),  # the step leads to 500
        (0.0, 0.0),  # at a fold there is no tangent
        (0.9, 0.9),  # no solution
    ],
)
def test_a_step_that_does_not_lead_from_a_solution_nearer_to_another_is_not_taken(start, here):
    xi = column(start)
    assert along_tangent(Root, xi, abs(start**2 - here), here, 1.0, 0.0) is xi


def test_damping_keeps_what_no_equation_sees_where_it_is():
    xi = torch.tensor([2.0, 0.0], dtype=torch.float64)
    moved = along_tangent(Half, xi, 0.0, 4.0, 5.0, 1e-8)
    assert moved.tolist() == pytest.approx([2.25, 0.0], abs=1e-6)


class Half(Root):
    """The same of the first unknown; the second is in no equation."""

    def residual(self, xi: Tensor) -> Tensor:
        return xi[:1].square() - self.value

    def linearise(self, xi: Tensor) -> tuple[Tensor, DenseJacobian]:
        return self.residual(xi), DenseJacobian(torch.stack([2 * xi[0], 0 * xi[1]])[None])


def test_solutions_that_are_straight_in_a_parameter_are_met_exactly():
    curve = solve(pushed(), [[0.0, 0, 0, 0], [1.0, 0, 0, 0]]).curve

    def at(value: float):
        return curve.collocation.with_setting(push=value)

    moved = along_tangent(at, curve.xi, curve.residual_norm, 1.0, 3.0, 0.0)
    assert float(at(3.0).residual(curve.xi).norm()) > 0.1
    assert float(at(3.0).residual(moved).norm()) < 1e-6


def test_along_the_smoothing_the_error_is_of_second_order(smoothed_landing):
    curve = smoothed_landing.curve

    def at(value: float):
        return curve.collocation.with_setting(smoothing=value)

    def missed(there: float) -> float:
        solved = LevenbergMarquardt(Stopping(tolerance=1e-13, decrease=1e-5), damping=1e-10).run(at(there), curve.xi)
        return float((along_tangent(at, curve.xi, curve.residual_norm, 0.1, there, 1e-12) - solved.xi).norm())

    coarse, fine = missed(0.08), missed(0.09)
    assert coarse / fine == pytest.approx(4.0, rel=0.5)


def test_it_saves_most_iterations_of_the_stages_that_follow_the_first():
    """The costates of this landing move by their own size from one stage to the next."""

    def following(predictor: str) -> int:
        result = Solver(predictor=predictor, refinement=None).solve(small_body_landing(), seed=1)
        return sum(stage.n_iterations for stage in result.stages[1:])

    assert 3 * following("tangent") < following("none")


@pytest.mark.parametrize(
    ("settings", "taken"), [({}, True), ({"predictor": "none"}, False), ({"basis": "deep"}, False)]
)
def test_it_is_for_weights_that_are_linear_and_can_be_turned_off(monkeypatch, settings, taken):
    steps = []
    monkeypatch.setattr(walk, "along_tangent", lambda residual, xi, *rest: steps.append(rest) or xi)
    if settings.get("basis") == "deep":
        settings = {"basis": MLP((4,))}
    optimizer = LevenbergMarquardt(Stopping(max_iterations=2))
    ladder = Ladder((1.5, 1.0), parameter="push")
    solver = Solver(**settings, optimizer=optimizer, continuation=ladder, start_limit=1e3, refinement=None)
    assert len(solver.solve(pushed()).stages) > 1
    assert [rest[1:3] for rest in steps] == ([(1.5, 1.0)] if taken else [])


def test_an_unknown_predictor_is_told_what_there_is():
    with pytest.raises(ValueError, match="predictor = 'secant'; allowed: tangent, none"):
        Solver(predictor="secant")
