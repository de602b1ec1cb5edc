"""Problems by reference: the call that makes a problem, so that a saved solution can make it again."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import json
import os
import pkgutil
import sys
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from ponn_torch.optimal_control.problem import OptimalControlProblem, ProblemOrigin, nearest


def load_problem(reference: str, **arguments: Any) -> OptimalControlProblem:
    """Call the function that ``reference`` names and stamp the problem with its origin.

    The reference is "package.module:function" or "path/to/file.py:function"; the code there is run. Arguments
    must survive JSON, and the function gets them as JSON gives them back (tuples become lists).

    Raises:
        ValueError: no such module, file, function or argument; the nearest name is given.
        TypeError: an argument that JSON cannot hold, or a function that returns something else.
    """
    place, separator, name = reference.rpartition(":")
    if not (separator and place and name):
        raise ValueError(f"problem reference = {reference!r}; allowed: 'package.module:function' or 'file.py:function'")
    is_file = place.endswith(".py")
    module = _module_from_file(Path(place)) if is_file else _module(place)
    functions = {key: value for key, value in vars(module).items() if inspect.isfunction(value)}
    if name not in functions:
        own = [key for key, f in functions.items() if f.__module__ == module.__name__ and not key.startswith("_")]
        raise ValueError(f"problem reference = {reference!r}: no function {name!r}; {nearest(name, own)}")
    parameters = inspect.signature(functions[name]).parameters
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    for key, value in arguments.items():
        if key not in parameters and not open_ended:
            raise ValueError(f"{reference}: no argument {key!r}; {nearest(key, parameters)}")
        try:
            json.dumps(value)
        except TypeError as error:
            raise TypeError(f"{reference}: argument {key!r} = {value!r} is not JSON; {error}") from None
    arguments = json.loads(json.dumps(arguments))
    problem = functions[name](**arguments)
    if not isinstance(problem, OptimalControlProblem):
        raise TypeError(f"{reference} returns {type(problem).__name__}; an OptimalControlProblem is needed")
    origin = ProblemOrigin(f"{Path(place).resolve()}:{name}" if is_file else reference, arguments)
    object.__setattr__(problem, "origin", origin)  # no constructor argument, so that copies do not inherit it
    return problem


def relative_reference(reference: str, folder: Path) -> str:
    """The reference as a folder can keep it: the way from there to a file, unless only the root is common to both."""
    place, _, name = reference.rpartition(":")
    if not place.endswith(".py"):
        return reference
    common = Path(os.path.commonpath([Path(place).resolve(), folder.resolve()]))
    if common == Path(common.anchor):
        return reference
    return f"{Path(os.path.relpath(Path(place).resolve(), folder.resolve())).as_posix()}:{name}"


def resolved_reference(reference: str, folder: Path) -> str:
    """Inverse of ``relative_reference``."""
    place, _, name = reference.rpartition(":")
    return f"{(folder / place).resolve()}:{name}" if place.endswith(".py") else reference


def _module(name: str) -> ModuleType:
    """Import a module; a missing one is told apart from one whose own imports fail."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not (name == error.name or name.startswith(f"{error.name}.")):
            raise
        parent = error.name.rpartition(".")[0]
        hint = f"no module named {error.name!r}"
        if parent:
            siblings = [f"{parent}.{m.name}" for m in pkgutil.iter_modules(importlib.import_module(parent).__path__)]
            hint += f"; {nearest(error.name, siblings)}"
        raise ValueError(f"problem module = {name!r}: {hint}") from None


class _Afresh(SourceFileLoader):
    """From the source every time: what Python keeps beside a file is stale if it is edited within a second."""

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


def _module_from_file(path: Path) -> ModuleType:
    if not path.is_file():
        siblings = [p.name for p in path.parent.glob("*.py")] if path.parent.is_dir() else []
        raise ValueError(f"problem file = {str(path)!r} does not exist; {nearest(path.name, siblings)}")
    name = f"ponn_problem_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path, loader=_Afresh(name, str(path)))
    if spec is None or spec.loader is None:
        raise ValueError(f"problem file = {str(path)!r} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses in the file look their module up
    beside = str(path.parent.resolve())
    sys.path.insert(0, beside)  # as of a script, whose neighbours can be imported
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(beside)
    return module
