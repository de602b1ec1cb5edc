"""A step is exact to fourth order, in time as well as in the state."""

from __future__ import annotations

import math

import pytest
import torch

from ponn_torch.numerics.runge_kutta import runge_kutta


def test_cubics_in_time_are_exact_and_an_exponential_is_to_its_fifth_power():
    x, h = torch.zeros(1, dtype=torch.float64), 0.5
    assert float(runge_kutta(lambda share, x: 4 * (share * h) ** 3 + 0 * x, x, h)) == pytest.approx(h**4, rel=1e-15)
    error = float(runge_kutta(lambda share, x: x, x + 1, h)) - math.exp(h)
    assert error == pytest.approx(-(h**5) / 120, rel=0.1)
