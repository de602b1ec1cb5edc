"""A box with bounds per component is a box with equal bounds in other units, from the solve to the figures."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.oscillator import oscillator
from ponn_torch.reporting.figures import _bounds, all_figures
from ponn_torch.solving.feasibility import check_control, check_final_time, least_control_twin
from ponn_torch.solving.solver import Solver

LOW, HIGH = (-0.8, -1.5), (1.0, 1.5)


def pushed(
    *, rescaled: bool, energy: bool = False, bounds=(LOW, HIGH), final_time: float = 3.5
) -> OptimalControlProblem:
    """The oscillator with a strong and a weak input, brought to rest in least time, or with least energy."""
    made = oscillator()
    low, high = (torch.tensor(bound, dtype=torch.float64) for bound in bounds)

    def force(u):
        return (low + high) / 2 + (high - low) / 2 * u.force if rescaled else u.force

    def dynamics(t, x, u, p):
        first, second = x.z.split(1, -1)
        return {"z": torch.cat([second, -first], -1) + force(u)}

    made = replace(
        made,
        control=Box("force", 1.0, -1.0, 2) if rescaled else Box("force", bounds[1], bounds[0], 2),
        dynamics=dynamics,
        known_cost=None,
    )
    if not energy:
        return made
    cost = lambda t, x, u, p: 0.5 * (force(u) ** 2).sum(-1, keepdim=True)  # noqa: E731
    return replace(made, running_cost=cost, final_time=final_time)


def solved(made: OptimalControlProblem):
    result = Solver().solve(made, seed=0)
    assert result.certified, result.message
    return result.solution


@pytest.mark.parametrize("energy", [False, True], ids=["time", "energy"])
def test_it_is_solved_as_in_other_units(energy):
    found, expected = (solved(pushed(rescaled=rescaled, energy=energy)) for rescaled in (False, True))
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    assert found.arcs == expected.arcs
    assert found.switch_times == pytest.approx(expected.switch_times, rel=1e-7)
    force = found(torch.linspace(0.0, found.final_time, 41, dtype=torch.float64)).control["force"]
    low, high = (torch.tensor(bound, dtype=torch.float64) for bound in (LOW, HIGH))
    assert bool(((low - 1e-9 <= force) & (force <= high + 1e-9)).all())
    assert float(force[:, 0].min()) == pytest.approx(-0.8, abs=1e-9)
    assert _bounds(found, "force") == (-0.8, -1.5, 1.0, 1.5)
    assert "control" in all_figures(found)


def test_its_twins_multiply_every_bound():
    hurried = [
        pushed(rescaled=rescaled, energy=True, bounds=((-0.8, -1.5), (0.8, 1.5)), final_time=2.0)
        for rescaled in (False, True)
    ]
    found, expected = (check_final_time(made, Solver()) for made in hurried)
    assert found.infeasible
    assert found.minimum_time == pytest.approx(expected.minimum_time, rel=1e-9)
    found, expected = (check_control(made, Solver()) for made in hurried)
    assert found.infeasible
    assert found.allowed == 1.5
    assert found.needed / 1.5 == pytest.approx(expected.needed, rel=1e-9)
    one_sided = replace(hurried[0], control=Box("force", (0.8, 1.5), (-0.8, 0.1), 2))
    assert check_control(one_sided, Solver()) is None
    with pytest.raises(ValueError, match=r"force from -0.8, 0.1 to 0.8, 1.5; allowed: bounds that include zero"):
        least_control_twin(one_sided)


def test_direct_collocation_keeps_to_every_bound():
    pytest.importorskip("casadi")
    from ponn_torch.baselines.direct import TwoStage

    found, expected = (TwoStage().solve(pushed(rescaled=rescaled)) for rescaled in (False, True))
    assert found.solved, found.status
    assert found.cost == pytest.approx(expected.cost, rel=1e-11)
    assert found.arcs == ["min,min", "min,max", "max,max"]
