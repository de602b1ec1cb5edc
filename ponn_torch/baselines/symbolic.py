"""A problem's torch functions as CasADi expressions, exactly: the traced graph is run on arrays of symbols.

A tensor of the graph becomes a NumPy array whose entries are CasADi scalars, so that NumPy answers for shapes,
broadcasting and matrix products, and only the elementary functions need names in CasADi.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, fx

Symbols = NDArray[np.object_]


def load_casadi() -> Any:
    """The module casadi.

    Raises:
        ImportError: it is not installed; the message names the extra that brings it.
    """
    try:
        return importlib.import_module("casadi")
    except ImportError as error:
        raise ImportError("direct methods need CasADi: pip install ponn-torch[baselines]") from error


def evaluate(function: Callable[..., Tensor], *arguments: Symbols) -> Symbols:
    """``function`` of tensors at arrays of symbols of the same shapes.

    Raises:
        ValueError: an operation that has no counterpart, or a function that cannot be traced.
    """
    from torch.fx.experimental.proxy_tensor import make_fx

    examples = [torch.linspace(0.5, 1.5, a.size, dtype=torch.float64).reshape(a.shape) for a in arguments]
    try:
        graph = make_fx(function)(*examples)
    except Exception as error:
        raise ValueError(f"{function} cannot be traced, so CasADi cannot see it: {error}") from error
    return np.asarray(_OnSymbols(graph).run(*arguments), dtype=object)


class _OnSymbols(fx.Interpreter):
    """Runs a graph of ATen operations on arrays of symbols."""

    def __init__(self, graph: fx.GraphModule) -> None:
        super().__init__(graph)
        self.extra_traceback = False  # else torch appends the graph's line to the message of an error

    def call_function(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        name = target.__name__.split(".")[0]
        operation = _operations().get(name)
        if operation is None:
            raise ValueError(f"no CasADi counterpart of torch operation {name!r}; allowed: {', '.join(_operations())}")
        known = {key: value for key, value in kwargs.items() if key in ("dim", "alpha", "min", "max")}
        found = operation(*args, **known)
        if isinstance(found, np.ndarray | list):
            return found
        # NumPy unpacks what has no dimension, and CasADi would then take over the next product with an array
        single = np.empty(1, dtype=object)
        single[0] = found
        return single.reshape(())

    def get_attr(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        value = super().get_attr(target, args, kwargs)
        return value.numpy().astype(object) if isinstance(value, Tensor) else value


def _axes(dim: Any) -> Any:
    return tuple(dim) if isinstance(dim, list) else dim


@cache
def _operations() -> dict[str, Callable[..., Any]]:
    """ATen operation → the same on arrays of symbols; dtypes and devices have no meaning here."""
    ca = load_casadi()

    def elementwise(function: Callable[..., Any], n_arguments: int = 1) -> Callable[..., Any]:
        return np.frompyfunc(function, n_arguments, 1)

    def same(x: Any, *ignored: Any, **also: Any) -> Any:
        return x

    def filled(value: float) -> Callable[..., Any]:
        return lambda x, *rest, **also: np.full(np.shape(x), value, dtype=object)

    def made(value: float) -> Callable[..., Any]:
        return lambda size, *rest, **also: np.full(size, value, dtype=object)

    def clamp(x: Any, min: Any = None, max: Any = None) -> Any:
        x = x if min is None else elementwise(ca.fmax, 2)(x, min)
        return x if max is None else elementwise(ca.fmin, 2)(x, max)

    def total(x: Any, dim: Any = None, keepdim: bool = False, **also: Any) -> Any:
        return np.sum(x, axis=_axes(dim), keepdims=keepdim)

    def norm(x: Any, p: Any = 2, dim: Any = None, keepdim: bool = False) -> Any:
        if p not in (2, None):
            raise ValueError(f"norm of order {p}; allowed: 2")
        return elementwise(ca.sqrt)(np.sum(x * x, axis=_axes(dim), keepdims=keepdim))

    def slice_(x: Any, dim: int = 0, start: Any = None, end: Any = None, step: int = 1) -> Any:
        index = [slice(None)] * np.ndim(x)
        index[dim] = slice(start, end, step)
        return x[tuple(index)]

    def expand(x: Any, size: Any, **also: Any) -> Any:
        x = np.reshape(x, (1,) * (len(size) - np.ndim(x)) + np.shape(x))
        return np.broadcast_to(x, [own if wanted == -1 else wanted for own, wanted in zip(x.shape, size, strict=True)])

    def transpose(x: Any, a: int = 0, b: int = 1) -> Any:
        return np.swapaxes(x, a, b) if np.ndim(x) > 1 else x

    one, two = elementwise, lambda function: elementwise(function, 2)
    unary = "sqrt exp log log1p expm1 sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh erf sign floor ceil"
    return {
        **{name: one(getattr(ca, name)) for name in unary.split()},
        "abs": one(ca.fabs),
        "neg": lambda x: -x,
        "reciprocal": lambda x: 1.0 / x,
        "rsqrt": lambda x: 1.0 / one(ca.sqrt)(x),
        "square": lambda x: x * x,
        "sigmoid": lambda x: 1.0 / (1.0 + one(ca.exp)(-x)),
        "add": lambda x, y, alpha=1: x + (y if alpha == 1 else alpha * y),
        "sub": lambda x, y, alpha=1: x - (y if alpha == 1 else alpha * y),
        "rsub": lambda x, y, alpha=1: y - (x if alpha == 1 else alpha * x),
        "mul": lambda x, y: x * y,
        "div": lambda x, y: x / y,
        "pow": lambda x, y: x**y,
        "atan2": two(ca.atan2),
        "hypot": two(ca.hypot),
        "maximum": two(ca.fmax),
        "minimum": two(ca.fmin),
        "clamp": clamp,
        "clamp_min": lambda x, min: clamp(x, min),
        "clamp_max": lambda x, max: clamp(x, None, max),
        **{name: two(getattr(ca, name)) for name in ("lt", "le", "gt", "ge", "eq", "ne")},
        "where": elementwise(ca.if_else, 3),
        "sum": total,
        "mean": lambda x, *a, **k: total(x, *a, **k) * (np.size(total(x, *a, **k)) / np.size(x)),
        "linalg_vector_norm": norm,
        "mm": np.matmul,
        "bmm": np.matmul,
        "mv": np.matmul,
        "dot": np.matmul,
        "cat": lambda arrays, dim=0: np.concatenate(arrays, axis=dim),
        "stack": lambda arrays, dim=0: np.stack(arrays, axis=dim),
        "split": lambda x, size, dim=0: np.split(x, range(size, x.shape[dim], size), axis=dim),
        "split_with_sizes": lambda x, sizes, dim=0: np.split(x, np.cumsum(sizes)[:-1], axis=dim),
        "unbind": lambda x, dim=0: [np.take(x, i, axis=dim) for i in range(x.shape[dim])],
        "getitem": lambda x, index: x[index],
        "select": lambda x, dim, index: np.take(x, index, axis=dim),
        "slice": slice_,
        "expand": expand,
        "unsqueeze": lambda x, dim: np.expand_dims(x, dim),
        "squeeze": lambda x, dim=None: np.squeeze(x, axis=_axes(dim)),
        "t": transpose,
        "transpose": transpose,
        "permute": np.transpose,
        **dict.fromkeys(("view", "reshape", "_unsafe_view"), np.reshape),
        **dict.fromkeys(("clone", "lift_fresh_copy", "detach", "alias", "_to_copy", "contiguous"), same),
        "zeros_like": filled(0.0),
        "new_zeros": lambda x, size, **also: np.full(size, 0.0, dtype=object),
        "new_ones": lambda x, size, **also: np.full(size, 1.0, dtype=object),
        "new_full": lambda x, size, value, **also: np.full(size, value, dtype=object),
        "ones_like": filled(1.0),
        "full_like": lambda x, value, **also: np.full(np.shape(x), value, dtype=object),
        "zeros": made(0.0),
        "ones": made(1.0),
        "full": lambda size, value, **also: np.full(size, value, dtype=object),
        "scalar_tensor": lambda value, **also: np.asarray(value, dtype=object),
    }
