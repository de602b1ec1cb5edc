"""Samples of a control set are admissible, reach its bounds, and lie near the given control too."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from ponn_torch.optimal_control.control_laws import Box, ThrustBall, Unconstrained
from ponn_torch.optimal_control.control_set import Minimiser
from ponn_torch.optimal_control.stationary import Stationary

NONE = torch.zeros(5, 0, dtype=torch.float64)
ETA = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)[:, None]
LIMITS = SimpleNamespace(least=2.0, most=6.0)


def nearest(samples: torch.Tensor, to: torch.Tensor) -> float:
    """Largest distance over the points of ``to`` (5, m) to the closest other sample (k, 5, m)."""
    away = (samples - to).norm(dim=-1)
    return float(torch.where(away > 0, away, torch.inf).amin(0).max())


@pytest.mark.parametrize("size", [1, 2, 3])
def test_a_box_is_sampled_up_to_its_bounds_and_about_the_control(size):
    law, eta = Box("u", "most", "least", size=size), ETA.expand(5, size)
    found = law.samples(Minimiser({"u": 2 + 4 * eta}, NONE, eta), LIMITS)
    u = found.control["u"]
    assert u.shape == found.fraction.shape == (len(u), 5, size)
    torch.testing.assert_close(u, 2 + 4 * found.fraction)
    corners = {tuple(row) for row in u[:, 2].tolist() if set(row) <= {2.0, 6.0}}
    assert len(corners) == 2**size
    assert bool(((u >= 2.0) & (u <= 6.0)).all())
    assert nearest(u, 2 + 4 * eta) < 2e-3


@pytest.mark.parametrize("low", [0.0, "least"])
@pytest.mark.parametrize("size", [1, 2, 3])
def test_a_thrust_ball_is_sampled_in_all_directions_with_vectors_as_long_as_they_say(size, low):
    law = ThrustBall("T", "most", low, size=size)
    bound = law.bounds(LIMITS, torch.zeros((), dtype=torch.float64))[0]
    magnitude = bound + (6 - bound) * ETA
    axis = torch.eye(size, dtype=torch.float64)[-1]
    given = {"T": -magnitude * axis, "T_magnitude": magnitude}
    found = law.samples(Minimiser(given, NONE, ETA), LIMITS)
    vector, length = found.control["T"], found.control["T_magnitude"]
    torch.testing.assert_close(vector.norm(dim=-1, keepdim=True), length)
    torch.testing.assert_close(length, bound + (6 - bound) * found.fraction)
    assert float(length.min()) == bound
    assert float(length.max()) == 6.0
    ways = torch.nn.functional.normalize(vector[:, -1], dim=-1)
    assert all(bool((sign * ways[:, i] > 0.5).any()) for sign in (1, -1) for i in range(size))
    assert nearest(length[:, 1:], magnitude[1:]) < 2e-3


def test_a_stationary_control_is_sampled_over_its_range():
    law, u = Stationary("angle", minimum=-1.0, maximum=3.0), 4 * ETA - 1
    found = law.samples(Minimiser({"angle": u}, NONE, NONE), None).control["angle"]
    assert float(found.min()) == -1.0
    assert float(found.max()) == 3.0
    assert float(found[:, 0].sort(dim=0).values.diff(dim=0).max()) < 0.25
    assert nearest(found, u) < 2e-3


def test_steps_from_a_control_without_bounds_are_as_large_as_it_is():
    u = torch.tensor([[1e6, 0.0], [-3e6, 0.0]], dtype=torch.float64)
    found = Unconstrained("u", 2).samples(Minimiser({"u": u}, u[:, :0], u[:, :0]), None).control["u"]
    away = (found - u).abs()
    assert float(away[..., 0].max()) == pytest.approx(6e7)
    assert float(away[..., 1].max()) == pytest.approx(20.0)
    assert 0 < float(away[away > 0].min()) < 1e-3
    assert bool((found > u).any())
    assert bool((found < u).any())
