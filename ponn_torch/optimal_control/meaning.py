"""When two functions compute the same, as far as can be said without running them: code, and what it captured.

A problem that is stated again from other data (another start state, say) has new functions with the old meaning, and so
all that was derived from the old ones holds for it.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import partial
from types import FunctionType, MethodType
from typing import Any, Generic, TypeVar

import numpy as np
import torch

T = TypeVar("T")

LARGE = 65536  # bytes of an array that is not looked into


@dataclass(frozen=True)
class Keyed(Generic[T]):
    """A value that any other with an equal key may stand for."""

    key: Hashable
    value: T = field(compare=False)


@dataclass(frozen=True, eq=False)
class _Itself:
    """Equal to the same object only, which is kept, so that its id stays its own."""

    value: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def meaning(value: Any, inside: tuple[int, ...] = ()) -> Hashable:
    """Equal for two values only if functions that captured one or the other compute the same.

    Numbers, text and collections count by content, functions by code, globals, defaults and captured values, frozen
    dataclasses by their fields; everything else is equal to itself alone. Changes inside such objects, and of global
    variables, are not seen. ``inside``: ids of the functions that this value was captured by.
    """
    kind = type(value)
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | np.generic):
        return kind, repr(value)
    if kind is torch.Tensor and not value.requires_grad and value.device.type == "cpu":
        value = value.numpy()
    if isinstance(value, np.ndarray) and not value.dtype.hasobject and value.nbytes <= LARGE:
        return kind, value.dtype, value.shape, value.tobytes()
    if kind in (tuple, list):
        return kind, *(meaning(x, inside) for x in value)
    if isinstance(value, Mapping) and kind.__module__ in ("builtins", "collections", "types"):
        return kind, *((meaning(k, inside), meaning(v, inside)) for k, v in value.items())
    if isinstance(value, partial):
        return kind, *(meaning(x, inside) for x in (value.func, value.args, value.keywords))
    if isinstance(value, MethodType):
        return kind, meaning(value.__func__, inside), meaning(value.__self__, inside)
    if isinstance(value, FunctionType):
        return _of_function(value, inside)
    if is_dataclass(value) and not isinstance(value, type) and kind.__dataclass_params__.frozen:
        return kind, *(meaning(getattr(value, f.name), inside) for f in fields(value))
    return _Itself(value)


def _of_function(function: FunctionType, inside: tuple[int, ...]) -> Hashable:
    if id(function) in inside:  # it captured itself
        return "itself", len(inside) - inside.index(id(function))
    inside = (*inside, id(function))
    captured = []
    for cell in function.__closure__ or ():
        try:
            captured.append(meaning(cell.cell_contents, inside))
        except ValueError:  # a name that has no value yet
            captured.append(_Itself(cell))
    given = meaning(function.__defaults__, inside), meaning(function.__kwdefaults__, inside)
    return function.__code__, _Itself(function.__globals__), *given, *captured
