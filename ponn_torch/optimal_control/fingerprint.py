"""What a value means, as a digest that is the same in another process: functions by code, classes by name."""

from __future__ import annotations

from enum import Enum
from hashlib import sha256
from types import CodeType
from typing import Any

from ponn_torch.optimal_control.meaning import Itself, meaning

DIGITS = 16


def fingerprint(value: Any) -> str:
    """Equal for values of the same ``meaning``; of what cannot be looked into it says nothing."""
    return sha256(_text(meaning(value, None)).encode()).hexdigest()[:DIGITS]


def _text(found: Any) -> str:
    """A meaning without the addresses of objects."""
    if isinstance(found, Itself):
        return _name(found.value)
    if isinstance(found, type):
        return _name(found)
    if isinstance(found, CodeType):
        names = (found.co_names, found.co_varnames, found.co_freevars, found.co_cellvars)
        return _text((found.co_name, found.co_code, found.co_consts, names))
    if isinstance(found, tuple):
        return f"({','.join(map(_text, found))})"
    if isinstance(found, frozenset):
        return f"{{{','.join(sorted(map(_text, found)))}}}"
    return repr(found)


def _name(value: Any) -> str:
    if isinstance(value, Enum):
        return f"{_name(type(value))}.{value.name}"
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None) or type(value).__qualname__
    return f"<{getattr(value, '__module__', '')}.{name}>"
