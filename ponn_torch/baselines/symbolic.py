"""A problem's torch functions as CasADi expressions, exactly: the traced graph is run on arrays of symbols.

A tensor of the graph becomes a NumPy array whose entries are CasADi scalars, so that NumPy answers for shapes,
broadcasting and matrix products, and only the elementary functions need names in CasADi. What no symbol enters stays a
tensor, of which torch computes whatever it can.
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
MEANINGLESS = ("dtype", "layout", "device", "pin_memory", "memory_format", "non_blocking")  # for symbols


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
    return np.asarray(_as_array(_OnSymbols(graph).run(*arguments)), dtype=object)


class _OnSymbols(fx.Interpreter):
    """Runs a graph of ATen operations on arrays of symbols."""

    def __init__(self, graph: fx.GraphModule) -> None:
        super().__init__(graph)
        self.extra_traceback = False  # else torch appends the graph's line to the message of an error

    def call_function(self, target: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if not _has_symbols((args, kwargs)):
            return super().call_function(target, args, kwargs)
        name = target.__name__.split(".")[0]
        operation = _operations().get(name)
        if operation is None:
            raise ValueError(
                f"no CasADi counterpart of torch operation {name!r}; allowed: elementary functions, sums, extremes and "
                "norms, constant indices, products of matrices and small linear systems, nothing in place"
            )
        meant = {key: value for key, value in kwargs.items() if key not in MEANINGLESS}
        try:
            found = operation(*fx.node.map_aggregate(args, _as_array), **fx.node.map_aggregate(meant, _as_array))
        except Exception as error:
            raise ValueError(f"no CasADi counterpart of torch operation {name!r} as it is used: {error}") from error
        if isinstance(found, np.ndarray | list):
            return found
        # NumPy unpacks what has no dimension, and CasADi would then take over the next product with an array
        single = np.empty(1, dtype=object)
        single[0] = found
        return single.reshape(())


def _has_symbols(value: Any) -> bool:
    if isinstance(value, dict):
        return _has_symbols(list(value.values()))
    return any(map(_has_symbols, value)) if isinstance(value, list | tuple) else isinstance(value, np.ndarray)


def _as_array(value: Any) -> Any:
    """A tensor as an array; indices and masks keep their type, for NumPy indexes by nothing else."""
    if not isinstance(value, Tensor):
        return value
    array = value.detach().numpy()
    return array.astype(object) if value.is_floating_point() else array


def _axes(x: Any, dim: Any) -> tuple[int, ...]:
    """Dimensions as torch names them: none stands for all."""
    if dim is None or dim == []:
        return tuple(range(np.ndim(x)))
    return tuple(dim) if isinstance(dim, list | tuple) else (dim,)


@cache
def _operations() -> dict[str, Callable[..., Any]]:
    """ATen operation → the same on arrays of symbols; dtypes and devices have no meaning here."""
    ca = load_casadi()

    def elementwise(function: Callable[..., Any], n_arguments: int = 1) -> Any:
        return np.frompyfunc(function, n_arguments, 1)

    def same(x: Any, *ignored: Any, **also: Any) -> Any:
        return x

    def filled(value: float) -> Callable[..., Any]:
        return lambda x, *rest, **also: np.full(np.shape(x), value, dtype=object)

    def clamp(x: Any, min: Any = None, max: Any = None) -> Any:
        x = x if min is None else elementwise(ca.fmax, 2)(x, min)
        return x if max is None else elementwise(ca.fmin, 2)(x, max)

    def total(x: Any, dim: Any = None, keepdim: bool = False) -> Any:
        axes = _axes(x, dim)
        kept = np.sum(x, axis=axes, keepdims=True)
        return kept if keepdim else np.squeeze(kept, axis=axes)

    def extreme(pick: Callable[..., Any]) -> Callable[..., Any]:
        def of(x: Any, dim: Any = None, keepdim: bool = False) -> Any:
            axes = _axes(x, dim)
            for axis in axes:
                x = elementwise(pick, 2).reduce(x, axis=axis, keepdims=True)
            return x if keepdim else np.squeeze(x, axis=axes)

        return of

    def with_places(extreme_of: Callable[..., Any]) -> Callable[..., Any]:
        """With a dimension torch answers by values and indices, of which the latter are no expressions."""
        return lambda x, dim=None, keepdim=False: extreme_of(x) if dim is None else [extreme_of(x, dim, keepdim), None]

    largest, smallest = extreme(ca.fmax), extreme(ca.fmin)

    def norm(x: Any, p: Any = 2, dim: Any = None, keepdim: bool = False) -> Any:
        if p in (2, None):
            return elementwise(ca.sqrt)(total(x * x, dim, keepdim))
        if p not in (1, np.inf):
            raise ValueError(f"order {p}; allowed: 1, 2, inf")
        size = elementwise(ca.fabs)(x)
        return total(size, dim, keepdim) if p == 1 else largest(size, dim, keepdim)

    def logsumexp(x: Any, dim: Any, keepdim: bool = False) -> Any:
        top = largest(x, dim, True)  # so that nothing overflows
        kept = elementwise(ca.log)(total(elementwise(ca.exp)(x - top), dim, True)) + top
        return kept if keepdim else np.squeeze(kept, axis=_axes(x, dim))

    def softplus(x: Any, beta: float = 1.0, threshold: float = 20.0) -> Any:
        # the other branch is evaluated as well, and must not overflow there
        bent = elementwise(ca.log1p)(elementwise(ca.exp)(elementwise(ca.fmin, 2)(beta * x, threshold)))
        return elementwise(ca.if_else, 3)(elementwise(ca.gt, 2)(beta * x, threshold), x, bent / beta)

    def index(x: Any, indices: Any) -> Any:
        return x[tuple(slice(None) if i is None else i for i in indices)]

    def gather(x: Any, dim: int, index: Any, **also: Any) -> Any:
        """Along the other dimensions the first entries, as many as the index has."""
        first = [slice(n) for n in index.shape]
        first[dim] = slice(None)
        return np.take_along_axis(x[tuple(first)], index, dim)

    def product(x: Any, dim: Any = None, keepdim: bool = False) -> Any:
        return np.prod(x, axis=dim, keepdims=keepdim)

    def plus_product(c: Any, x: Any, y: Any, beta: float = 1, alpha: float = 1) -> Any:
        return beta * c + alpha * np.matmul(x, y)

    def slice_(x: Any, dim: int = 0, start: Any = None, end: Any = None, step: int = 1) -> Any:
        index = [slice(None)] * np.ndim(x)
        index[dim] = slice(start, end, step)
        return x[tuple(index)]

    def expand(x: Any, size: Any, **also: Any) -> Any:
        x = np.reshape(x, (1,) * (len(size) - np.ndim(x)) + np.shape(x))
        return np.broadcast_to(x, [own if wanted == -1 else wanted for own, wanted in zip(x.shape, size, strict=True)])

    def squeeze(x: Any, dim: Any = None) -> Any:
        return np.squeeze(x, axis=tuple(axis for axis in _axes(x, dim) if np.shape(x)[axis] == 1))

    def transpose(x: Any, a: int = 0, b: int = 1) -> Any:
        return np.swapaxes(x, a, b) if np.ndim(x) > 1 else x

    def by_matrix(function: Callable[..., Any]) -> Callable[..., Symbols]:
        """A function of CasADi matrices on the last two axes."""

        def of(*arrays: Any) -> Symbols:
            batch = np.broadcast_shapes(*(np.shape(a)[:-2] for a in arrays))
            found = []
            for place in np.ndindex(batch):
                ones = (np.broadcast_to(a, batch + np.shape(a)[-2:])[place] for a in arrays)
                found.append(function(*(ca.vertcat(*(ca.horzcat(*row) for row in one)) for one in ones)))
            rows, columns = found[0].shape
            entries = [matrix[i, j] for matrix in found for i in range(rows) for j in range(columns)]
            return np.array(entries, dtype=object).reshape(*batch, rows, columns)

        return of

    def solve(a: Any, b: Any, **also: Any) -> Any:
        vector = np.shape(b) == np.shape(a)[:-1]
        x = by_matrix(ca.solve)(a, np.expand_dims(b, -1) if vector else b)
        return [x[..., 0] if vector else x, None, None, None]  # torch gives the factors as well

    one, two = elementwise, lambda function: elementwise(function, 2)
    unary = "sqrt exp log log1p expm1 sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh erf sign floor ceil"
    return {
        **{name: one(getattr(ca, name)) for name in unary.split()},
        "abs": one(ca.fabs),
        "neg": lambda x: -x,
        "reciprocal": lambda x: 1.0 / x,
        "rsqrt": lambda x: 1.0 / one(ca.sqrt)(x),
        "square": lambda x: x * x,
        "exp2": lambda x: 2.0**x,
        "log10": one(ca.log10),
        "log2": lambda x: one(ca.log)(x) / np.log(2.0),
        "deg2rad": lambda x: x * (np.pi / 180),
        "rad2deg": lambda x: x * (180 / np.pi),
        "sigmoid": lambda x: 1.0 / (1.0 + one(ca.exp)(-x)),
        "silu": lambda x: x / (1.0 + one(ca.exp)(-x)),
        "relu": lambda x: clamp(x, 0.0),
        "softplus": softplus,
        "add": lambda x, y, alpha=1: x + (y if alpha == 1 else alpha * y),
        "sub": lambda x, y, alpha=1: x - (y if alpha == 1 else alpha * y),
        "rsub": lambda x, y, alpha=1: y - (x if alpha == 1 else alpha * x),
        "mul": lambda x, y: x * y,
        "div": lambda x, y: x / y,
        "pow": lambda x, y: x**y,
        "atan2": two(ca.atan2),
        "hypot": two(ca.hypot),
        "remainder": lambda x, y: x - y * one(ca.floor)(x / y),
        "fmod": two(ca.fmod),
        **dict.fromkeys(("maximum", "fmax"), two(ca.fmax)),
        **dict.fromkeys(("minimum", "fmin"), two(ca.fmin)),
        "clamp": clamp,
        "clamp_min": lambda x, min: clamp(x, min),
        "clamp_max": lambda x, max: clamp(x, None, max),
        **{name: two(getattr(ca, name)) for name in ("lt", "le", "gt", "ge", "eq", "ne")},
        **dict.fromkeys(("logical_and", "bitwise_and"), two(ca.logic_and)),
        **dict.fromkeys(("logical_or", "bitwise_or"), two(ca.logic_or)),
        **dict.fromkeys(("logical_not", "bitwise_not"), one(ca.logic_not)),
        "where": elementwise(ca.if_else, 3),
        "masked_fill": lambda x, mask, value: elementwise(ca.if_else, 3)(mask, value, x),
        "sum": total,
        "prod": product,
        "cumsum": np.cumsum,
        "cumprod": np.cumprod,
        "amax": largest,
        "amin": smallest,
        "max": with_places(largest),
        "min": with_places(smallest),
        "logsumexp": logsumexp,
        "logaddexp": lambda x, y: logsumexp(np.stack(np.broadcast_arrays(x, y)), 0),
        "_softmax": lambda x, dim, half: one(ca.exp)(x - logsumexp(x, dim, True)),
        "_log_softmax": lambda x, dim, half: x - logsumexp(x, dim, True),
        "mean": lambda x, *a, **k: total(x, *a, **k) * (np.size(total(x, *a, **k)) / np.size(x)),
        "linalg_vector_norm": norm,
        **dict.fromkeys(("mm", "bmm", "mv", "dot", "vdot"), np.matmul),
        **dict.fromkeys(("addmm", "addmv", "baddbmm"), plus_product),
        "linalg_cross": lambda x, y, dim=-1: np.cross(x, y, axis=dim),
        "diagonal": np.diagonal,
        "diag_embed": lambda x: np.expand_dims(x, -1) * np.eye(np.shape(x)[-1]),
        "trace": np.trace,
        "linalg_inv_ex": lambda x, **also: [by_matrix(ca.inv)(x), None],
        "_linalg_det": lambda x: [by_matrix(ca.det)(x)[..., 0, 0], None, None],
        "_linalg_solve_ex": solve,
        "_linalg_check_errors": lambda *ignored, **also: None,
        "cat": lambda arrays, dim=0: np.concatenate(arrays, axis=dim),
        "stack": lambda arrays, dim=0: np.stack(arrays, axis=dim),
        "split": lambda x, size, dim=0: np.split(x, range(size, x.shape[dim], size), axis=dim),
        "split_with_sizes": lambda x, sizes, dim=0: np.split(x, np.cumsum(sizes)[:-1], axis=dim),
        "unbind": lambda x, dim=0: [np.take(x, i, axis=dim) for i in range(x.shape[dim])],
        "getitem": lambda x, index: x[index],
        "index": index,
        "index_select": lambda x, dim, index: np.take(x, index, axis=dim),
        "gather": gather,
        "roll": lambda x, shifts, dims=None: np.roll(x, shifts, axis=tuple(dims) if dims else None),
        "flip": lambda x, dims: np.flip(x, axis=tuple(dims)),
        "repeat": np.tile,
        "select": lambda x, dim, index: np.take(x, index, axis=dim),
        "slice": slice_,
        "expand": expand,
        "unsqueeze": lambda x, dim: np.expand_dims(x, dim),
        "squeeze": squeeze,
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
    }
