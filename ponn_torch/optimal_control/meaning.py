"""When two functions compute the same, as far as can be said without running them: code, and what it reads.

A problem that is stated again from other data (another start state, say) has new functions with the old meaning, and so
all that was derived from the old ones holds for it.
"""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from functools import cached_property, partial
from pathlib import Path
from sysconfig import get_path
from types import BuiltinFunctionType, CodeType, FunctionType, MappingProxyType, MethodType, ModuleType, SimpleNamespace
from typing import Any, Generic, TypeVar

import numpy as np
import torch

T = TypeVar("T")

LARGE = 65536  # bytes of an array that is not looked into
MOST = 2000  # values that are looked at
STDLIB = get_path("stdlib")
_PLAIN = (type(None), bool, int, float, complex, str, bytes, range, slice, torch.device, torch.dtype)
_COLLECTIONS = (tuple, list, set, frozenset, torch.Size)
_MAPPINGS = (dict, OrderedDict, MappingProxyType)


@dataclass(frozen=True)
class Keyed(Generic[T]):
    """A value that any other with an equal key may stand for."""

    key: tuple[Hashable, ...]
    value: T = field(compare=False)


@dataclass(frozen=True, eq=False)
class Itself:
    """Equal to the same object only, which is kept, so that its id stays its own."""

    value: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Itself) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


_FIXED = (ModuleType, BuiltinFunctionType, np.ufunc, Enum)  # what is the same as long as it is the same object


def meaning(value: Any, owner: object) -> Hashable:
    """Equal for two values only if functions that read one or the other compute the same.

    Numbers, text, collections and arrays count by content, functions by code and by the values of all that it reads
    (globals, defaults, captured ones), frozen dataclasses by their fields; classes, and what is installed, as
    themselves. What else there is may change in ways that cannot be seen: it stands for its ``owner``, the one
    statement that it is part of, and so does what it would take too long to look through.
    """
    return _Reader(owner).of(value)


class _Reader:
    """Looks through values; ``inside`` are the ids of what a value was found in."""

    def __init__(self, owner: object) -> None:
        self._unknown, self._left = Itself(owner), MOST

    def of(self, value: Any, inside: tuple[int, ...] = ()) -> Hashable:
        self._left -= 1
        if self._left < 0:
            return self._unknown
        kind = type(value)
        if kind in _PLAIN:
            return kind, repr(value)
        if kind in (CodeType, Itself):
            return value
        if isinstance(value, _FIXED) or _installed(value):
            return Itself(value)
        array = _array(value)
        if array is not None:
            return kind, str(array.dtype), array.shape, array.tobytes()
        if id(value) in inside:  # it holds itself
            return "itself", len(inside) - inside.index(id(value))
        parts = self._parts(value)
        if parts is None:
            return self._unknown
        within = (*inside, id(value))
        found = [self.of(part, within) for part in parts]
        return kind, frozenset(found) if kind in (set, frozenset) else tuple(found)

    def _parts(self, value: Any) -> Iterable[Any] | None:
        """All that a value consists of; None where that cannot be told."""
        kind = type(value)
        if kind in _COLLECTIONS or (isinstance(value, tuple) and hasattr(kind, "_fields")):
            return list(value)
        if kind in _MAPPINGS:
            return [*value.keys(), *value.values()]
        if kind is SimpleNamespace:
            return [vars(value)]
        if kind is partial and not vars(value):
            return [value.func, value.args, value.keywords]
        if kind is MethodType:
            return [value.__func__, value.__self__]
        if kind is FunctionType:
            return [value.__code__, vars(value), value.__defaults__, value.__kwdefaults__, *_read(value)]
        if _holds_fields_only(value):
            return [getattr(value, f.name, self._unknown) for f in fields(value)]
        return None


def _array(value: Any) -> np.ndarray[Any, Any] | None:
    """A number or array of NumPy, or a tensor, whose content can be told, and soon."""
    if type(value) is torch.Tensor and not value.requires_grad:
        if value.device.type != "cpu" or value.layout != torch.strided or value.dtype == torch.bfloat16:
            return None
        value = value.resolve_conj().resolve_neg().numpy()
    elif isinstance(value, np.generic):
        value = np.asarray(value)
    if type(value) is not np.ndarray or value.dtype.hasobject or value.nbytes > LARGE:
        return None
    return value


def _read(function: FunctionType) -> Iterable[Any]:
    """The globals that a function may read, with their names, and what it captured."""
    names = _names(function.__code__)
    for name in sorted(names & function.__globals__.keys()):
        value = function.__globals__[name]
        yield name
        yield value
        if isinstance(value, ModuleType) and not _installed(value):
            yield from ((part, getattr(value, part)) for part in sorted(names) if hasattr(value, part))
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:  # a name that has no value yet
            yield Itself(cell)


def _names(code: CodeType) -> set[str]:
    """Names of globals and attributes in the code of a function, and of the functions in it."""
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))


def _installed(value: Any) -> bool:
    """Whether a module, class or function without captured values is Python's or a package's: it does not change."""
    path: str | None
    if isinstance(value, FunctionType) and not value.__closure__:
        path = value.__code__.co_filename
    elif isinstance(value, ModuleType | type):
        module = value if isinstance(value, ModuleType) else sys.modules.get(value.__module__)
        path = getattr(module, "__file__", None) if module is not None else ""
    else:
        return False
    return (
        path is None or not {"site-packages", "dist-packages"}.isdisjoint(Path(path).parts) or path.startswith(STDLIB)
    )


def _holds_fields_only(value: Any) -> bool:
    """Whether a frozen dataclass is its fields, and what is computed from them."""
    kind = type(value)
    if not is_dataclass(value) or not kind.__dataclass_params__.frozen:
        return False
    computed = {name for base in kind.__mro__ for name, x in vars(base).items() if isinstance(x, cached_property)}
    return getattr(value, "__dict__", {}).keys() <= {f.name for f in fields(value)} | computed
