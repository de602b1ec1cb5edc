"""Gradients of pointwise functions: torch.func inside its own transforms, plain autograd everywhere else.

Both give the same numbers. On a few dozen points nearly all of the time is overhead per operation, and there plain
autograd is twice as fast; under vmap, vjp or grad only torch.func composes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.func import grad, vjp, vmap


def inside_transform() -> bool:
    """Whether a transform of torch.func is at work."""
    return torch._C._functorch.peek_interpreter_stack() is not None


def differentiable(*inputs: Tensor | None) -> AbstractContextManager[Any]:
    """Build graphs inside only if one of the inputs asks for it; what is computed from constants stays constant."""
    if inside_transform():
        return nullcontext()
    asked = any(x is not None and x.requires_grad for x in inputs)
    return torch.set_grad_enabled(torch.is_grad_enabled() and asked)


def gradients(function: Callable[..., Tensor], *arguments: Tensor) -> tuple[Tensor, ...]:
    """Gradients of the sum of ``function`` with respect to all its tensor arguments.

    They can be differentiated once more where gradients are enabled (see ``differentiable``).
    """
    return gradients_and_values(lambda *x: (function(*x), ()), *arguments)[0]


def gradients_and_values(
    function: Callable[..., tuple[Tensor, tuple[Tensor, ...]]], *arguments: Tensor
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """As ``gradients``, for a function that returns other tensors besides: (gradients, those)."""
    if inside_transform():

        def total(*x: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
            value, others = function(*x)
            return value.sum(), others

        return grad(total, argnums=tuple(range(len(arguments))), has_aux=True)(*arguments)
    if torch.is_inference_mode_enabled():
        raise RuntimeError("inside torch.inference_mode every gradient would be zero; use torch.no_grad")
    keep = torch.is_grad_enabled()
    with torch.enable_grad():
        # a view is another node of the graph: what else was computed from the argument is not differentiated
        inputs = [x.view_as(x) if keep and x.requires_grad else x.detach().requires_grad_() for x in arguments]
        value, others = function(*inputs)
        if not value.requires_grad:
            return tuple(torch.zeros_like(x) for x in arguments), others
        found = torch.autograd.grad(value.sum(), inputs, create_graph=keep, materialize_grads=True)
    return found, others if keep else tuple(x.detach() for x in others)


def pointwise_jacobian(
    function: Callable[..., Tensor], rows: Sequence[int], *arguments: Tensor, constants: Sequence[Tensor | None] = ()
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """F (n, d) of a pointwise function and its chosen rows' derivatives (n, len(rows), d_i) by the arguments (n, d_i).

    ``function(*arguments, *constants)`` treats every point apart, so the points are repeated once per row and a
    single backward pass gives all rows.
    """
    n, count = len(arguments[0]), len(rows)
    if inside_transform():
        value, pull, *_ = vjp(lambda *x: function(*x, *constants), *arguments)
        seeds = torch.eye(value.shape[-1], dtype=value.dtype, device=value.device)[list(rows)]
        pulled = vmap(lambda seed: pull(seed.expand_as(value)))(seeds)
        return value, tuple(x.movedim(0, -2) for x in pulled)
    if not count:
        return function(*arguments, *constants), tuple(x.new_zeros(n, 0, x.shape[-1]) for x in arguments)
    fixed = [None if x is None else _repeated(x, count) for x in constants]
    with torch.enable_grad():
        inputs = [_repeated(x.detach(), count).requires_grad_() for x in arguments]
        value = function(*inputs, *fixed)
        if not value.requires_grad:  # F does not depend on its arguments at all
            return value[:n], tuple(x.new_zeros(n, count, x.shape[-1]) for x in arguments)
        seeds = torch.eye(value.shape[-1], dtype=value.dtype, device=value.device)[list(rows)]
        pulled = torch.autograd.grad(value, inputs, seeds.repeat_interleave(n, 0), materialize_grads=True)
    return value.detach()[:n], tuple(x.view(count, n, -1).movedim(0, 1) for x in pulled)


def _repeated(x: Tensor, count: int) -> Tensor:
    """x (n, ...) over and over (count · n, ...)."""
    return x.expand(count, *x.shape).flatten(0, 1)


def row_gradients(function: Callable[..., Tensor], *arguments: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Values (..., E) of a function of few rows, and their gradients (E, *shape of each argument).

    Leading axes are independent problems.
    """
    with torch.enable_grad():
        inputs = [x.detach().requires_grad_() for x in arguments]
        value = function(*inputs)
        if not value.requires_grad:
            return value, tuple(x.new_zeros(value.shape[-1], *x.shape) for x in arguments)
        rows = [
            torch.autograd.grad(row.sum(), inputs, retain_graph=True, materialize_grads=True)
            for row in value.unbind(-1)
        ]
    return value.detach(), tuple(torch.stack(x) for x in zip(*rows, strict=True))
