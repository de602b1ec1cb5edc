"""Schedules try the values that they promise and stop where they say."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ponn_torch.optimal_control.discretisation import Weak
from ponn_torch.solving.continuation import Adaptive, Ladder, Outcome, Phases, Schedule, Single, log_ladder


def tried(schedule: Schedule, answer: Callable[[float, int], Outcome] = lambda value, count: Outcome.SOLVED):
    """What a schedule asks for: (value, parameter, form) of every attempt."""
    calls: list[tuple[float, str, object]] = []

    def attempt(value, parameter, form, *, hold=False):
        calls.append((value, parameter, form))
        assert len(calls) < 1000
        return answer(value, len(calls))

    schedule.run(attempt)
    return calls


def values(*args, **kwargs) -> list[float]:
    return [value for value, _, _ in tried(*args, **kwargs)]


def scripted(*outcomes: Outcome) -> Callable[[float, int], Outcome]:
    """The outcomes in turn, then SOLVED."""
    return lambda value, count: outcomes[count - 1] if count <= len(outcomes) else Outcome.SOLVED


# -- ladders -------------------------------------------------------------------------------------------------


def test_a_ladder_tries_every_value_once_in_order():
    form = Weak(2.0)
    assert tried(Ladder((1.0, 0.3, 0.1), form, "thrust")) == [(v, "thrust", form) for v in (1.0, 0.3, 0.1)]


def test_failures_do_not_stop_a_ladder_and_giving_up_does():
    ladder = Ladder((1.0, 0.3, 0.1))
    assert values(ladder, scripted(Outcome.SOLVED, Outcome.FAILED)) == [1.0, 0.3, 0.1]
    assert values(ladder, scripted(Outcome.SOLVED, Outcome.ABORT)) == [1.0, 0.3]


@pytest.mark.parametrize(("stop", "expected"), [(False, [1.0, 0.3, 0.1]), (True, [1.0, 0.3])])
def test_a_ladder_may_stop_where_nothing_changes(stop, expected):
    ladder = Ladder((1.0, 0.3, 0.1), stop_unchanged=stop)
    assert values(ladder, scripted(Outcome.SOLVED, Outcome.UNCHANGED)) == expected


def test_the_papers_ladder_is_the_default():
    rungs = values(log_ladder())
    assert len(rungs) == 20
    assert rungs[0] == 1.0
    assert rungs[-1] == pytest.approx(1e-10)
    ratios = [b / a for a, b in pairwise(rungs)]
    assert ratios == pytest.approx([10 ** (-10 / 19)] * 19)


# -- adaptive ------------------------------------------------------------------------------------------------


@given(first=st.floats(0.1, 10), last=st.floats(1e-4, 1e3), factor=st.floats(0.1, 0.9))
def test_without_failures_the_steps_are_even_and_end_at_the_last_value(first, last, factor):
    rungs = values(Adaptive(first, last, factor))
    assert rungs[0] == first
    assert rungs[-1] == pytest.approx(last)
    steps = [abs(math.log(b / a)) for a, b in pairwise(rungs)]
    assert steps[:-1] == pytest.approx([-math.log(factor)] * len(steps[:-1]))
    assert all(step <= -math.log(factor) * (1 + 1e-9) for step in steps)


def test_a_failed_step_is_halved_and_grows_again():
    answer = scripted(Outcome.SOLVED, Outcome.FAILED, Outcome.FAILED)
    found = values(Adaptive(1.0, 1e-2, 0.1), answer)
    # 10⁻¹ fails, 10^−½ fails, 10^−¼ is solved; then half a step, then a whole one, then the rest
    exponents = [0, -1, -0.5, -0.25, -0.75, -1.75, -2]
    assert found == pytest.approx([10.0**e for e in exponents])


def test_halvings_are_limited():
    failing = scripted(Outcome.SOLVED, *[Outcome.FAILED] * 10)
    found = values(Adaptive(1.0, 1e-2, 0.1, max_halvings=3), failing)
    assert found == pytest.approx([1.0, *(10.0 ** -(0.5**i) for i in range(4))])


def test_a_wall_is_approached_from_the_last_good_value():
    """Everything below 0.2 fails: the steps close in on it and no good value is tried twice."""
    found = values(
        Adaptive(1.0, 1e-3, 0.3, max_halvings=6),
        lambda value, count: Outcome.SOLVED if value > 0.2 else Outcome.FAILED,
    )
    good = [value for value in found if value > 0.2]
    assert good == sorted(set(good), reverse=True)
    assert 0.2 < good[-1] < 0.21


def test_an_untrusted_stage_is_a_failed_step_of_an_adaptive_schedule_only():
    found = values(Adaptive(1.0, 1e-2, 0.1), scripted(Outcome.SOLVED, Outcome.UNTRUSTED))
    assert found[:3] == pytest.approx([1.0, 0.1, 10**-0.5])
    assert values(Ladder((1.0, 0.3, 0.1)), scripted(*[Outcome.UNTRUSTED] * 3)) == [1.0, 0.3, 0.1]


@pytest.mark.parametrize("outcome", [Outcome.FAILED, Outcome.ABORT])
def test_a_failed_first_value_ends_it(outcome):
    assert values(Adaptive(), scripted(outcome)) == [1.0]


@pytest.mark.parametrize("outcome", [Outcome.UNCHANGED, Outcome.ABORT])
def test_it_ends_where_nothing_changes_or_the_start_is_given_up(outcome):
    assert len(values(Adaptive(), scripted(Outcome.SOLVED, Outcome.SOLVED, outcome))) == 3


def test_equal_ends_are_one_attempt():
    assert values(Adaptive(0.5, 0.5)) == [0.5]


# -- phases --------------------------------------------------------------------------------------------------


def test_phases_follow_one_another_with_their_forms():
    weak = Weak(1.0)
    phases = Phases((Ladder((1.0, 0.1)), Ladder((0.01,), weak), Single(0.5, weak)))
    assert [(value, form) for value, _, form in tried(phases)] == [
        (1.0, None),
        (0.1, None),
        (0.01, weak),
        (0.5, weak),
    ]


def test_giving_up_ends_all_phases_and_unchanged_only_its_own():
    phases = Phases((Ladder((1.0, 0.1), stop_unchanged=True), Ladder((0.01, 0.001))))
    assert values(phases, scripted(Outcome.ABORT)) == [1.0]
    assert values(phases, scripted(Outcome.UNCHANGED)) == [1.0, 0.01, 0.001]


def test_legible_ends_its_own_phase_only():
    phases = Phases((Ladder((1.0, 0.1, 0.01)), Ladder((45.0, 46.0), parameter="final_time")))
    assert values(phases, scripted(Outcome.SOLVED, Outcome.LEGIBLE)) == [1.0, 0.1, 45.0, 46.0]
    nested = Phases((phases, Ladder((0.5,))))
    assert values(nested, scripted(Outcome.SOLVED, Outcome.ABORT)) == [1.0, 0.1]


# -- errors --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Ladder(()), "continuation values of 'smoothing': none given; allowed: at least one"),
        (lambda: Ladder((1.0, 0.0)), "continuation values of 'smoothing': 0.0; allowed: positive numbers"),
        (lambda: Ladder((1.0, math.nan), parameter="thrust"), "values of 'thrust': nan; allowed: finite"),
        (lambda: Ladder((math.nan,)), "nan; allowed: positive"),
        (lambda: Ladder((-2.0,), parameter="final_time"), "values of 'final_time': -2.0; allowed: positive"),
        (lambda: log_ladder(0.0), "0.0; allowed: positive"),
        (lambda: log_ladder(count=1), "count = 1; allowed: at least 2"),
        (lambda: Adaptive(factor=1.0), "factor = 1.0; allowed: between 0 and 1"),
        (lambda: Adaptive(last=-1.0), "-1.0; allowed: positive"),
    ],
)
def test_errors_name_field_value_and_what_is_allowed(make, message):
    with pytest.raises(ValueError, match=message):
        make()
