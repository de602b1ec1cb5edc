"""Record the operations that a function of small tensors runs, and play them back without what surrounds them.

On a few hundred numbers an operation costs a microsecond or two, and what leads to it (Python, autograd, shapes) more.
A tape is what one evaluation ran (transcript.py), played without that, and gives the same bits for finite numbers, but
for the sign of a zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import inside_transform
from ponn_torch.numerics.transcript import Recorder, Unrecordable, Writer, finite

Function = Callable[[], tuple[Tensor, ...]]


@dataclass(frozen=True)
class Tape:
    """What ``record`` made: ``play`` takes tensors of the recorded shapes; ``text`` is its source."""

    play: Callable[..., tuple[Tensor, ...]]
    text: str
    n_operations: int

    @classmethod
    def record(cls, function: Function, inputs: Sequence[Tensor]) -> Tape:
        """Evaluate ``function()`` once and keep what it did with the inputs, which it may read wherever it likes.

        Raises:
            Unrecordable: where a tape could not stand for the function.
        """
        recorder = Recorder()
        with recorder:
            expected = function()
        for bindings in (True, False):
            try:
                play, text, count = Writer.of(recorder.entries, inputs, bindings).written(expected)
                tape = Tape(_plain(play), text, count)
                if same(tape.play(*inputs), expected):
                    return tape
            except (TypeError, RuntimeError):  # a binding that takes other arguments than the operation
                continue
        raise Unrecordable("played back, the operations give something else")


def same(one: Sequence[Tensor], other: Sequence[Tensor]) -> bool:
    """Bit for bit: a run that goes on from a tape is the run that went on without."""
    pairs = list(zip(one, other, strict=True))
    return all(torch.equal(x.isnan(), y.isnan()) and torch.equal(x.nan_to_num(), y.nan_to_num()) for x, y in pairs)


def recordable(*inputs: Tensor) -> bool:
    """Not while something else follows the operations: autograd, or a transform of torch.func."""
    return not inside_transform() and not (torch.is_grad_enabled() and any(x.requires_grad for x in inputs))


def taped(function: Callable[..., Tensor], *examples: Tensor) -> Callable[..., Tensor]:
    """The function as its tape, for arguments of the examples' shapes; or itself, where a tape could not stand for it.

    The tape is held against the function near the examples too.
    """
    plain = [x.clone(memory_format=torch.contiguous_format) for x in examples]
    try:
        tape = Tape.record(lambda: (function(*plain),), plain)
    except Unrecordable:
        return function
    elsewhere = [x * 1.01 if x.is_floating_point() else x for x in examples]
    return (lambda *x: tape.play(*x)[0]) if same(tape.play(*elsewhere), [function(*elsewhere)]) else function


RECORDING_PAYS = 24  # calls: a recording takes about as long as a tape then has saved in as many


class Replay:
    """A function that is evaluated as it is until a recording pays, and played from its tape from then on.

    A tape is held against the call before its recording, both of them at finite numbers; what cannot be recorded is
    evaluated as ever.
    """

    def __init__(self, after: int = RECORDING_PAYS) -> None:
        self._before, self._over, self._tape = after, False, cast(Tape | None, None)
        self._seen = cast(tuple[tuple[Tensor, ...], tuple[Tensor, ...]] | None, None)

    @property
    def recorded(self) -> bool:
        return self._tape is not None

    def __call__(self, function: Function, *inputs: Tensor) -> tuple[Tensor, ...]:
        """``function()``, which reads the inputs and, in every call, the same constants."""
        if self._tape is not None:
            return self._tape.play(*inputs)
        self._before -= 1
        if self._over or self._before > 1:
            return function()
        seen, self._seen = self._seen, None
        if seen is None:
            expected = function()
            self._seen = (inputs, expected) if finite(expected) else None
            return expected
        self._over = True  # whatever comes of it; nor does another thread record it meanwhile
        try:
            tape = Tape.record(function, inputs)
        except Unrecordable:
            return function()
        results = tape.play(*inputs)
        if not finite(results):
            self._over, self._seen = False, seen
        elif same(tape.play(*seen[0]), seen[1]):
            self._tape = tape
        return results


def _plain(function: Callable[..., Sequence[Tensor]]) -> Callable[..., tuple[Tensor, ...]]:
    """Views are taken from the start of an input's storage, so an input has to begin there."""

    def play(*inputs: Tensor) -> tuple[Tensor, ...]:
        with torch.no_grad():
            plain = (
                x if x.is_contiguous() and not x.storage_offset() else x.clone(memory_format=torch.contiguous_format)
                for x in inputs
            )
            return tuple(function(*plain))

    return play
