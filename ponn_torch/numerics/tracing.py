"""Trace a function of small tensors once into a short list of operations, free of the overhead of torch.func.

A pointwise right-hand side with derivatives by torch.func costs a millisecond a call, nearly all of it
Python; an integrator calls it thousands of times at one point.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, fx

Function = Callable[..., Tensor]
_FILLERS = ("zeros", "ones", "full", "new_zeros", "new_ones", "new_full", "scalar_tensor")


def trace(function: Function, *examples: Tensor) -> Function:
    """The same function as a graph, for arguments of the examples' shapes.

    The function itself comes back where tracing fails (control flow that depends on data), where operations
    change tensors in place, and where the graph gives other values near the examples.
    """
    try:
        from torch.fx.experimental.proxy_tensor import make_fx
        from torch.fx.passes.dialect.common.cse_pass import CSEPass

        graph = make_fx(function)(*examples)
        if any(getattr(getattr(node.target, "_schema", None), "is_mutable", False) for node in graph.graph.nodes):
            return function
        graph = _fold(graph, examples)
        shared = CSEPass()(graph)
        graph = graph if shared is None else shared.graph_module
        graph.graph.eliminate_dead_code()
        graph.recompile()
        elsewhere = [x * 1.01 if x.is_floating_point() else x for x in examples]
        same = all(_agree(function(*point), graph(*point)) for point in (examples, elsewhere))
    except Exception:  # tracing is an optimisation, and fails in as many ways as there are user functions
        return function
    return graph if same else function


def _agree(expected: Tensor, found: Tensor) -> bool:
    if expected.shape != found.shape:
        return False
    return torch.allclose(expected, found, rtol=1e-12, atol=1e-13 * float(expected.abs().sum()), equal_nan=True)


class _Recorder(fx.Interpreter):
    """Runs a graph and keeps every value."""

    def __init__(self, module: fx.GraphModule) -> None:
        super().__init__(module)
        self.values: dict[fx.Node, Any] = {}

    def run_node(self, n: fx.Node) -> Any:
        self.values[n] = super().run_node(n)
        return self.values[n]


def _fold(module: fx.GraphModule, examples: tuple[Tensor, ...]) -> fx.GraphModule:
    """Make constants of what does not depend on the arguments, one per value, and drop idle views."""
    recorder = _Recorder(module)
    recorder.run(*examples)
    values, constant = recorder.values, set()
    known: dict[tuple, fx.Node] = {}
    for node in list(module.graph.nodes):
        if node.op == "get_attr":
            constant.add(node)
        elif node.op == "call_function" and isinstance(values[node], Tensor):
            name = node.name.rstrip("_0123456789")
            if node.name.startswith(_FILLERS) or (node.all_input_nodes and constant.issuperset(node.all_input_nodes)):
                constant.add(node)
            elif name in (
                "expand",
                "view",
                "reshape",
                "_unsafe_view",
                "lift_fresh_copy",
                "clone",
                "contiguous",
            ):
                source = node.args[0]
                if isinstance(source, fx.Node) and values[source].shape == values[node].shape:
                    node.replace_all_uses_with(source)
    for node in list(module.graph.nodes):
        if node not in constant:
            continue
        value = values[node].detach().clone()
        key = (value.dtype, tuple(value.shape), tuple(value.flatten().tolist()))
        if key not in known:
            name = f"_folded_{len(known)}"
            module.register_buffer(name, value)
            with module.graph.inserting_before(next(iter(module.graph.nodes))):
                known[key] = module.graph.get_attr(name)
        node.replace_all_uses_with(known[key])
    module.graph.eliminate_dead_code()
    module.recompile()
    return module
