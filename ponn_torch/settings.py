"""Nodes of a config → calls, with every value checked against the type that its place asks for."""

from __future__ import annotations

import importlib
import inspect
import math
import os
import re
import sysconfig
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from difflib import get_close_matches
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from ponn_torch.optimal_control.problem import nearest

# Rooms whose classes and functions a config may call.
ROOMS = (
    "ponn_torch.problems",
    "ponn_torch.ansatz.basis",
    "ponn_torch.ansatz.networks",
    "ponn_torch.optimal_control.discretisation",
    "ponn_torch.optimal_control.measurements",
    "ponn_torch.optim",
    "ponn_torch.solving",
    "ponn_torch.guidance",
)
# Fields of a Solver whose place in the config has another name.
PLACES = {
    "basis": "ansatz",
    "conditioning": "ansatz.conditioning",
    "node_kind": "nodes.kind",
    "kind": "nodes.kind",
    "n_nodes": "nodes.n_nodes",
    "cpu_seconds": "budget.cpu_seconds",
    "path": "data.path",
}
KINDS = {float: "a number", int: "an integer", bool: "true or false", str: "text", NoneType: "null"}


# Folders of code that is no user's: this package and Python's library.
INSTALLED = (f"{Path(__file__).parent}{os.sep}", f"{sysconfig.get_path('stdlib')}{os.sep}")


class ConfigError(ValueError):
    """Something wrong with a config, in one line."""


def reject_unknown(node: Iterable[str], allowed: Sequence[str], path: str) -> None:
    """Raise a ConfigError for the first key of a node that has not been used."""
    for key in node:
        raise ConfigError(f"{_place(path, key)}: no such setting; {nearest(key, allowed)}")


def value_of(node: Any, hint: Any, path: str) -> Any:
    """The object that a node describes, checked against the type that its place asks for."""
    if isinstance(node, dict):
        options = get_args(hint) or (hint,)
        dataclasses = [o for o in options if isinstance(o, type) and is_dataclass(o)]
        if "_target_" in node:
            function = target(node["_target_"], f"{path}._target_", ROOMS)
            node = call(function, {k: v for k, v in node.items() if k != "_target_"}, path)
        elif len(dataclasses) == 1:
            node = call(dataclasses[0], node, path)
    return fit(node, hint, path)


def call(function: Callable[..., Any], node: Mapping[str, Any], path: str) -> Any:
    arguments = arguments_of(function, node, path)
    try:
        return function(**arguments)
    except (ValueError, TypeError) as error:
        raise ConfigError(located(error, path, list(arguments))) from error


def arguments_of(function: Callable[..., Any], node: Mapping[str, Any], path: str) -> dict[str, Any]:
    parameters, hints = inspect.signature(function).parameters, types_of(function)
    for key in node:
        if key not in parameters:
            raise ConfigError(f"{_place(path, key)}: no such setting; {nearest(key, parameters)}")
    for key, parameter in parameters.items():
        if parameter.default is inspect.Parameter.empty and key not in node:
            raise ConfigError(f"{_place(path, key)}: missing; allowed: {_described(hints.get(key, Any))}")
    return {key: value_of(value, hints.get(key, Any), _place(path, key)) for key, value in node.items()}


def types_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Types of a call's arguments."""
    written_init = isinstance(function, type) and not is_dataclass(function)
    return get_type_hints(inspect.getattr_static(function, "__init__") if written_init else function)


def target(name: Any, path: str, rooms: Sequence[str]) -> Callable[..., Any]:
    """The public class or function that a dotted name means, in one of the allowed rooms."""
    module_name, _, attribute = str(name).rpartition(".")
    if not any(module_name == room or module_name.startswith(f"{room}.") for room in rooms):
        raise ConfigError(f"{path} = {name!r}; allowed: classes and functions of {', '.join(rooms)}")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise ConfigError(f"{path} = {name!r}: no module named {module_name!r}") from error
    public = {
        key: value
        for key, value in vars(module).items()
        if not key.startswith("_") and callable(value) and getattr(value, "__module__", None) == module_name
    }
    if attribute not in public:
        raise ConfigError(f"{path} = {name!r}; {nearest(attribute, public)}")
    return public[attribute]


def _has(value: Any, name: str, member: Any) -> bool:
    """Whether a value has what a protocol calls ``name``, a method where that is one."""
    return callable(getattr(value, name, None)) if callable(member) else hasattr(value, name)


def fit(value: Any, hint: Any, path: str) -> Any:
    """The value as the type asks for it (an int becomes a float where one is needed)."""
    origin, options = get_origin(hint), get_args(hint)
    if hint is Any or hint is inspect.Parameter.empty:
        return value
    if origin in (Union, UnionType):
        for option in options:
            try:
                return fit(value, option, path)
            except ConfigError:
                continue
    elif hint is float:
        if isinstance(value, float | int) and not isinstance(value, bool) and not math.isnan(value):
            return float(value)
    elif hint in KINDS:
        if isinstance(value, hint) and (hint is bool or not isinstance(value, bool)):
            return value
    elif origin is not None and issubclass(origin, Sequence):
        if isinstance(value, list | tuple):
            kind = options[0] if options else Any
            return tuple(value_of(entry, kind, f"{path}[{i}]") for i, entry in enumerate(value))
    elif origin is type:
        if isinstance(value, str):
            value = target(value, path, ROOMS)
        if isinstance(value, type) and issubclass(value, options[0]):
            return value
    elif origin is not None:
        return value
    elif getattr(hint, "_is_protocol", False):
        if all(_has(value, name, kind) for name, kind in vars(hint).items() if not name.startswith("_")):
            return value
    elif isinstance(value, hint):
        return value
    raise ConfigError(f"{path} = {short(value)}; allowed: {_described(hint)}")


# -- words -----------------------------------------------------------------------------------------


def _described(hint: Any) -> str:
    origin, options = get_origin(hint), get_args(hint)
    if hint in KINDS:
        return KINDS[hint]
    if origin in (Union, UnionType):
        return " or ".join(_described(option) for option in options)
    if origin is not None and isinstance(origin, type) and issubclass(origin, Sequence):
        return f"a list, each entry {_described(options[0])}" if options else "a list"
    if origin is type:
        return f"the name of a {options[0].__name__}"
    return f"a {hint.__name__}" if isinstance(hint, type) else "a value"


def short(value: Any) -> str:
    text = one_line(value if isinstance(value, type) or not hasattr(value, "__dict__") else type(value).__name__)
    text = repr(value) if isinstance(value, str) else text
    return text if len(text) <= 60 else f"{text[:57]}..."


def one_line(text: Any) -> str:
    return " ".join(str(text).split())


def _place(path: str, key: str) -> str:
    return f"{path}.{key}" if path else PLACES.get(key, key)


def raised_here(error: BaseException) -> bool:
    """Whether the package itself raised it."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and str(trace.tb_frame.f_globals.get("__name__", "")).startswith("ponn_torch.")


def users_line(error: BaseException) -> str | None:
    """``file.py:line`` of the innermost code in an error's traceback that is neither this package's nor installed."""
    frames = [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    if isinstance(error, SyntaxError) and error.filename is not None:  # the code that cannot be read has no frame
        frames.append((error.filename, error.lineno or 0))
    own = [(Path(name), line) for name, line in frames if not name.startswith((*INSTALLED, "<"))]
    own = [(path, line) for path, line in own if "site-packages" not in path.parts]
    return f"{own[-1][0].name}:{own[-1][1]}" if own else None


def located(error: Exception, path: str, parameters: Sequence[str], label: str | None = None) -> str:
    """The error in one line that begins with the config path of the field it names."""
    text = one_line(error)
    if label:
        text = text.removeprefix(f"{label}: ")
    field = re.match(r"\w+", text)
    if field and field[0] in parameters:
        text = _place(path, field[0]) + text[field.end() :]
    elif path and not text.startswith((path, "problem")):
        text = f"{path}: {text}"
    given = re.search(r"= '(.*?)'.*allowed: (.*)", text)
    if given and "did you mean" not in text:
        close = get_close_matches(given[1], given[2].split(", "), n=1)
        text += f" (did you mean {close[0]!r}?)" if close else ""
    return text
