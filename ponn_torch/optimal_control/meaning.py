"""When two functions compute the same, as far as can be said without running them: code, and what it reads.

A problem that is stated again from other data (another start state, say) has new functions with the old meaning, and so
all that was derived from the old ones holds for it.
"""

from __future__ import annotations

import dis
import os
import sys
from collections import OrderedDict
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from functools import cached_property, lru_cache, partial
from pathlib import Path
from sysconfig import get_path
from types import (
    BuiltinFunctionType,
    CodeType,
    FunctionType,
    GetSetDescriptorType,
    MappingProxyType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
    SimpleNamespace,
)
from typing import Any, Generic, TypeVar

import numpy as np
import torch

T = TypeVar("T")

LARGE = 65536  # bytes of an array that is not looked into
MOST = 2000  # values that are looked at
UNCHANGING = tuple(f"{folder}{os.sep}" for folder in (get_path("stdlib"), Path(__file__).parents[1]))
LOOK_UPS = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS")  # operations that find a global
_PLAIN = (type(None), bool, int, float, complex, str, bytes, range, slice, torch.device, torch.dtype)
_COLLECTIONS = (tuple, list, set, frozenset, torch.Size)
_MAPPINGS = (dict, OrderedDict, MappingProxyType)
_ABOUT = {  # entries of a class that nothing is computed with
    *("__doc__", "__module__", "__annotations__", "__annotate_func__", "__annotations_cache__"),
    *("__dataclass_fields__", "__dataclass_params__", "__orig_bases__", "__parameters__"),
    *("__abstractmethods__", "_abc_impl"),
}


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


# what is the same as long as it is the same object
_FIXED = (BuiltinFunctionType, np.ufunc, Enum, MemberDescriptorType, GetSetDescriptorType)


def meaning(value: Any, owner: object) -> Hashable:
    """Equal for two values only if functions that read one or the other compute the same.

    Numbers, text, collections and arrays count by content, functions by code and by the values of all that it reads
    (globals, defaults, captured ones, what it takes from modules), frozen dataclasses by their fields and methods;
    what is installed counts as itself, and so does a class, together with what it holds. What else there is may change
    in ways that cannot be seen: it stands for its ``owner``, the one statement that it is part of. So does a function
    that imports, and what it would take too long to look through.
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
        if kind in _COLLECTIONS:
            return list(value)
        if isinstance(value, tuple) and hasattr(kind, "_fields"):
            return [kind, *value]
        if isinstance(value, type):
            return [Itself(value), *_held(value)]
        if kind in _MAPPINGS:
            return [*value.keys(), *value.values()]
        if kind is SimpleNamespace:
            return [vars(value)]
        if kind is partial and not vars(value):
            return [value.func, value.args, value.keywords]
        if kind is MethodType:
            return [value.__func__, value.__self__]
        if kind in (staticmethod, classmethod):
            return [value.__func__]
        if kind is property:
            return [value.fget, value.fset, value.fdel]
        if kind is cached_property:
            return [value.func]
        if kind is FunctionType and not _imports(value.__code__):
            return [value.__code__, vars(value), value.__defaults__, value.__kwdefaults__, *_read(value)]
        if _holds_fields_only(value):
            return [kind, *(getattr(value, f.name, self._unknown) for f in fields(value))]
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


def _read(function: FunctionType) -> Iterator[Any]:
    """The globals that a function may read, with their names, and what it captured."""
    code, known, modules = function.__code__, function.__globals__, set[ModuleType]()
    for name in sorted(_globals(code) & known.keys()):
        yield name
        yield from _seen(known[name], code, modules)
    for cell in function.__closure__ or ():
        try:
            yield from _seen(cell.cell_contents, code, modules)
        except ValueError:  # a name that has no value yet
            yield Itself(cell)


def _seen(value: Any, code: CodeType, before: set[ModuleType]) -> Iterator[Any]:
    """A value that code reads; of a user's module, and of those in it, all that the code may take from it."""
    if not isinstance(value, ModuleType) or _installed(value):
        yield value
        return
    yield Itself(value)
    if value not in before:
        before.add(value)
        for name in sorted(_names(code) & vars(value).keys()):
            yield name
            yield from _seen(vars(value)[name], code, before)


def _held(kind: type) -> Iterator[Any]:
    """What a user's class is made of: its bases, and its methods and values with their names."""
    yield from kind.__bases__
    for name in sorted(vars(kind).keys() - _ABOUT):
        yield name
        yield vars(kind)[name]


def _within(code: CodeType) -> Iterator[CodeType]:
    """The code of a function, and of the functions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _within(constant)


def _steps(code: CodeType) -> Iterator[dis.Instruction]:
    return (step for part in _within(code) for step in dis.get_instructions(part))


@lru_cache(maxsize=1024)
def _globals(code: CodeType) -> frozenset[str]:
    """Names that are looked up among the globals; attributes of the same name are not."""
    return frozenset(step.argval for step in _steps(code) if step.opname in LOOK_UPS)


def _names(code: CodeType) -> set[str]:
    """Names of globals and attributes."""
    return {name for part in _within(code) for name in part.co_names}


@lru_cache(maxsize=1024)
def _imports(code: CodeType) -> bool:
    return any(step.opname == "IMPORT_NAME" for step in _steps(code))


def _installed(value: Any) -> bool:
    """Whether a module, class or function of a module is Python's or a package's, this one's too: it does not change.

    A function made by another one is not: it is made anew.
    """
    if isinstance(value, FunctionType) and not value.__closure__ and "<locals>" not in value.__qualname__:
        path = value.__code__.co_filename
    elif isinstance(value, ModuleType | type):
        module = value if isinstance(value, ModuleType) else sys.modules.get(value.__module__)
        if getattr(module, "__name__", "") in sys.builtin_module_names:
            return True
        path = getattr(module, "__file__", None) or ""
    else:
        return False
    return path.startswith(UNCHANGING) or not {"site-packages", "dist-packages"}.isdisjoint(Path(path).parts)


def _holds_fields_only(value: Any) -> bool:
    """Whether a frozen dataclass is its fields, and what is computed from them."""
    kind = type(value)
    if not is_dataclass(value) or not kind.__dataclass_params__.frozen:
        return False
    computed = {name for base in kind.__mro__ for name, x in vars(base).items() if isinstance(x, cached_property)}
    return getattr(value, "__dict__", {}).keys() <= {f.name for f in fields(value)} | computed
