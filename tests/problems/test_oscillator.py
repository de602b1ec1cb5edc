"""Two bounded inputs against the closed form of bang-bang motion about the four equilibria."""

from __future__ import annotations

import cmath
import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ponn_torch.problems.oscillator import oscillator
from ponn_torch.solving.solver import Solver

QUARTER = math.pi / 2


def extremal(first: float, time: float, force: complex) -> tuple[complex, list[float]]:
    """Where an extremal begins, and its switch times, by its first switch, its duration and its first force.

    With z = x + iy, ż = −i z + w, so z(0) = −∫ exp(iτ) w(τ) dτ; λ turns with the oscillator, and w by a quarter at
    each switch.
    """
    switches = []
    while first < time:
        switches.append(first)
        first += QUARTER
    ends, start = [0.0, *switches, time], 0j
    for begin, end in itertools.pairwise(ends):
        start -= force * (cmath.exp(1j * end) - cmath.exp(1j * begin)) / 1j
        force *= -1j
    return start, switches


def test_the_default_start_is_that_of_its_known_extremal():
    start, switches = extremal(0.5936556554962977, 2.8613463025446273, -1 - 1j)
    assert (start.real, start.imag) == pytest.approx((3.0, 2.0), abs=1e-13)
    assert len(switches) == 2


@settings(deadline=None, max_examples=4, derandomize=True)
@given(
    first=st.floats(0.2, 1.3),
    after=st.floats(0.3, 1.3),
    turns=st.integers(1, 4),
    force=st.sampled_from([1 + 1j, -1 + 1j]),
)
def test_extremals_are_found_from_where_they_begin(first, after, turns, force):
    time = first + (turns - 1) * QUARTER + after
    start, switches = extremal(first, time, force)
    problem = oscillator(initial_state=(start.real, start.imag), guess=max(1.5, time))
    result = Solver().solve(problem)
    assert result.certified, result.message
    assert result.solution.final_time == pytest.approx(time, abs=1e-9)
    assert result.solution.switch_times == pytest.approx(switches, abs=1e-9)
    assert problem.known_cost is None


def test_a_start_at_half_the_force_takes_the_time_of_half_the_state():
    result = Solver().solve(oscillator(initial_state=(1.5, 1.0), bound=0.5))
    assert result.certified, result.message
    assert result.solution.final_time == pytest.approx(2.8613463025446273, abs=1e-10)
