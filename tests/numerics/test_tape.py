"""A tape gives the very bits of the function it stands for; what it cannot stand for comes back as it is."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.func import grad, vmap

from ponn_torch.numerics.tape import Replay, Tape, taped
from ponn_torch.numerics.transcript import Unrecordable


def pendulum(t: Tensor, x: Tensor) -> Tensor:
    gradient = grad(lambda y: (torch.cos(y[0]) + 0.5 * y[1] ** 2 * torch.exp(-t[0])).sum())(x)
    return torch.cat([gradient, torch.where(x > 0, x, torch.zeros_like(x)) + x.new_tensor((1.0, 2.0))])


def clamped(t: Tensor, x: Tensor) -> Tensor:
    return torch.linalg.solve(torch.diag(x.abs() + 1), x.clamp(-0.5, 0.5)) * t


def constant(t: Tensor, x: Tensor) -> Tensor:
    return torch.ones_like(x) * 3.0


def batched(t: Tensor, x: Tensor) -> Tensor:
    return vmap(lambda a: a * a + t[0])(x)


def by_autograd(t: Tensor, x: Tensor) -> Tensor:
    with torch.enable_grad():
        y = x.detach().requires_grad_()
        (slope,) = torch.autograd.grad((torch.tanh(y) * torch.exp(t) * y.sum()).sum(), y)
    return slope


def filled(t: Tensor, x: Tensor) -> Tensor:
    """In place, on what the function made itself: through views, an index and an accumulation."""
    total = x.new_zeros(3, 2)
    total[0] = x
    total[1].add_(x * t).mul_(2.0)
    total[2, [1, 0]] = x
    before = total.sum(0)
    total += 1.0
    return torch.cat([total.flatten(), before])


def infinite(t: Tensor, x: Tensor) -> Tensor:
    return torch.where(x > 10, x, torch.inf) + torch.full_like(t, torch.nan)


FUNCTIONS = [pendulum, clamped, constant, batched, by_autograd, filled, infinite]


def branching(t: Tensor, x: Tensor) -> Tensor:
    return x if float(x[0]) > 0 else -2 * x


def masked(t: Tensor, x: Tensor) -> Tensor:
    return x[x > 0].sum() * t


def random(t: Tensor, x: Tensor) -> Tensor:
    return x + torch.randn_like(x)


def changing(t: Tensor, x: Tensor) -> Tensor:
    return x.add_(1.0)


REMEMBERED = torch.zeros(2, dtype=torch.float64)


def remembering(t: Tensor, x: Tensor) -> Tensor:
    return REMEMBERED.add_(x).clone()


def points(count: int = 20) -> list[tuple[Tensor, Tensor]]:
    generator = torch.Generator().manual_seed(0)
    draw = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return [(row[:1].clone(), row[1:].clone()) for row in draw]


def identical(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and torch.equal(one.nan_to_num(7.0), other.nan_to_num(7.0))


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
def test_a_tape_gives_the_same_bits_at_other_points(function: Callable[..., Tensor]) -> None:
    played = taped(function, *points()[0])
    assert played is not function
    for point in points():
        assert identical(played(*point), function(*point))


@pytest.mark.parametrize("function", [branching, masked, random, changing, remembering], ids=lambda f: f.__name__)
def test_what_a_tape_cannot_stand_for_comes_back(function: Callable[..., Tensor]) -> None:
    assert taped(function, *points()[0]) is function
    t, x = points()[0]
    with pytest.raises(Unrecordable):
        Tape.record(lambda: (function(t, x),), (t, x))


def test_a_tape_takes_views_for_inputs_and_leaves_them_alone() -> None:
    played = taped(filled, *points()[0])
    table = torch.randn(4, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    before = table.clone()
    assert identical(played(table[1, 2:3], table[2, ::3]), filled(table[1, 2:3], table[2, ::3]))
    assert torch.equal(table, before)


def test_a_tape_takes_inputs_of_any_layout() -> None:
    def product(x: Tensor) -> Tensor:
        return x.flatten() * x[1].repeat(3)

    generator = torch.Generator().manual_seed(0)
    x, y = (torch.randn(3, 5, generator=generator, dtype=torch.float64) for _ in range(2))
    played = taped(product, x[:1].expand(3, 5))
    assert played is not product
    assert identical(played(y.mT.contiguous().mT), product(y))


def test_nothing_is_computed_twice_or_for_nobody() -> None:
    def twice(t: Tensor, x: Tensor) -> Tensor:
        unused = torch.sin(x)
        del unused
        return torch.cat([torch.exp(x * torch.full_like(x, 2.0)), torch.exp(x * torch.full_like(x, 2.0))])

    t, x = points()[0]
    tape = Tape.record(lambda: (twice(t, x),), (t, x))
    assert tape.n_operations == 3  # the product, its exponential, the concatenation


def test_what_changes_nothing_or_always_vanishes_is_left_out() -> None:
    def function(t: Tensor, x: Tensor) -> Tensor:
        one, nothing = torch.ones_like(x), torch.zeros_like(x)
        same = (1.0 * x * one + nothing) / one - nothing
        vanishing = torch.where(x > 0.3, nothing * torch.sin(x), nothing) + same**0 - one
        made = torch.sin(same + vanishing * t)
        made.mul_(one)
        made[:0] += t[:0]
        return made

    t, x = points()[0]
    tape = Tape.record(lambda: (function(t, x),), (t, x))
    assert tape.n_operations == 1  # the sine
    for t, x in points():
        assert torch.equal(tape.play(t, x)[0], function(t, x))


def test_a_view_is_not_taken_for_what_it_is_multiplied_to() -> None:
    """The product with ones is laid out anew, so that views of it are others than views of the factor."""

    def function(t: Tensor, x: Tensor) -> Tensor:
        square = torch.outer(x.flatten(), t.flatten())
        turned = square.mT * torch.ones_like(square.mT)
        part = (square[1:] * torch.ones_like(square[1:]))[1:, :2]
        return torch.cat([turned.contiguous().view(-1)[::3], part.reshape(-1)])

    played = taped(function, *points()[0])
    assert played is not function
    for t, x in points():
        assert torch.equal(played(t, x), function(t, x))


def test_nothing_is_recorded_where_numbers_are_not_finite() -> None:
    """There a product with zero is NaN, which must not be taken for a constant."""
    replay = Replay(after=3)
    values = [1.0, 2.0, 1000.0, 1000.0, 0.5, 1000.0, 0.7, 0.9, 1.1]
    for value in values:
        x = torch.full((2,), value, dtype=torch.float64)
        (found,) = replay(lambda x=x: (torch.exp(x) * torch.zeros_like(x) + x,), x)
        assert identical(found, torch.exp(x) * torch.zeros_like(x) + x) or replay.recorded
        assert not replay.recorded or bool(torch.isfinite(found).all())
    assert replay.recorded


def test_results_belong_to_who_asked_for_them() -> None:
    """What is an input, a constant or another result is copied."""
    x = points()[0][1]
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    tape = Tape.record(lambda: (x * one, x * zero, x + zero, torch.sin(x) * one, torch.sin(x)), (x,))
    first, kept = tape.play(x), x.clone()
    for result in first:
        result.add_(5.0)
    assert torch.equal(x, kept)
    expected = (x, zero, x, torch.sin(x), torch.sin(x))
    assert all(torch.equal(found, value) for found, value in zip(tape.play(x), expected, strict=True))
    assert all(torch.equal(found, value + 5.0) for found, value in zip(first, expected, strict=True))


def test_results_are_not_shared_between_plays() -> None:
    played = taped(filled, *points()[0])
    first = played(*points()[0])
    kept = first.clone()
    played(*points()[1])
    assert torch.equal(first, kept)


def test_a_replay_records_when_it_pays_and_never_what_it_must_not() -> None:
    for function, recorded in ((by_autograd, True), (branching, False)):
        calls, replay = 0, Replay(after=3)
        for t, x in points(8):

            def counted(t: Tensor = t, x: Tensor = x, function: Callable[..., Tensor] = function) -> tuple[Tensor]:
                nonlocal calls
                calls += 1
                return (function(t, x),)

            assert identical(replay(counted, t, x)[0], function(t, x))
        assert calls == 3 if recorded else calls >= 8


def test_a_function_that_keeps_a_secret_is_found_out() -> None:
    """Data that reach the result past the inputs differ at the point that the tape is held against."""
    replay, hidden = Replay(after=3), [torch.tensor([float(i)], dtype=torch.float64) for i in range(8)]
    for i, (t, x) in enumerate(points(8)):
        (found,) = replay(lambda i=i, x=x: (x + hidden[i],), t, x)
        if i != 2:  # the call that records plays what it has just seen
            assert torch.equal(found, x + hidden[i])
