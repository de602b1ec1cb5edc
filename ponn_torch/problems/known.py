"""Known optima: they belong to their data, so a changed problem has none."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

# what has no say in the optimum of the unregularised problem
WITHOUT_SAY = frozenset({"name", "regulariser", "known_cost"})


def known_optimum(
    function: Callable[..., Any],
    given: Mapping[str, Any],
    optima: Sequence[tuple[Mapping[str, Any], float]],
    ignored: Sequence[str] = (),
) -> float | None:
    """The optimum whose data are the ``given`` arguments of a problem's function, None where there is none.

    ``optima`` lists (arguments that differ from the defaults, optimum); ``ignored`` names further arguments
    without a say.
    """
    parameters = inspect.signature(function).parameters
    names = [name for name in parameters if name not in WITHOUT_SAY and name not in ignored]
    for data, optimum in optima:
        if all(_same(given[name], data.get(name, parameters[name].default)) for name in names):
            return optimum
    return None


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, Sequence) and not isinstance(one, str):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, float | int) and isinstance(other, float | int):
        return math.isclose(one, other, rel_tol=1e-15)
    return bool(one == other)
