"""Optimisers made of others: one after the other, or on the output layer only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import torch
from torch import Tensor

from ponn_torch.optim.base import (
    Around,
    Callback,
    Optimizer,
    OptimizeResult,
    Record,
    Residual,
    Status,
    Stop,
    loosened,
    replayed,
    warm,
)
from ponn_torch.optim.checkpoint import Arrays, Checkpoint, Nested, pack_records, under, unpack_records, within
from ponn_torch.optim.least_squares import GaussNewton
from ponn_torch.optim.restricted import Layered, output_layer

ENOUGH = (Status.RESIDUAL, Status.ROUND_OFF)  # what a part may end with that leaves nothing for the next


@dataclass(frozen=True)
class Chain:
    """Run every part in turn; records, counts and times go on from one to the next.

    A part that meets its tolerance ends the chain; one that ends by any other rule hands over.
    """

    parts: Sequence[Optimizer]

    def __post_init__(self) -> None:
        if not self.parts:
            raise ValueError("parts = []; allowed: at least one optimiser")

    def loosened(self, tolerance: float) -> Chain:
        return Chain([loosened(part, tolerance) for part in self.parts])

    def warm(self, damping: float) -> Chain:
        return Chain([warm(part, damping) for part in self.parts])

    def run(
        self,
        residual: Residual,
        xi: Tensor,
        on_iteration: Callback | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> OptimizeResult:
        """Minimise ½‖r(ξ)‖² from ξ."""
        first, done, saved = 0, OptimizeResult(xi, xi.new_tensor(torch.inf), Status.INTERRUPTED), None
        if checkpoint is not None and checkpoint.saved is not None:
            first, done, saved = _restore(checkpoint.saved, xi)
            if on_iteration is not None:
                on_iteration = _told_of(done, residual.residual(done.xi), on_iteration)
        for index in range(first, len(self.parts)):
            nested = None if checkpoint is None else Nested(checkpoint, _pack(index, done), saved)
            told = None if on_iteration is None else _continued(done, on_iteration)
            result = self.parts[index].run(residual, done.xi, told, nested)
            done, saved = _joined(done, result), None
            if result.status in ENOUGH or result.status.cut:
                break
        return done


@dataclass(frozen=True)
class OutputLayer(Around):
    """Run an optimiser on all unknowns but the hidden weights, which stay as they are."""

    optimizer: Optimizer = field(default_factory=GaussNewton)

    def run(
        self,
        residual: Residual,
        xi: Tensor,
        on_iteration: Callback | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> OptimizeResult:
        """Minimise ½‖r(ξ)‖² over the output layer.

        Raises:
            TypeError: a residual without ``linear_unknowns``.
        """
        if not hasattr(residual, "linear_unknowns"):
            raise TypeError(f"{type(residual).__name__} has no linear_unknowns, so its output layer is not known")
        inner, saved = None, checkpoint.saved if checkpoint is not None else None
        if saved is not None:
            xi, saved = saved["xi"].to(xi.device), under("part", saved)
        layer = output_layer(cast(Layered, residual), xi)
        if checkpoint is not None:
            inner = Nested(checkpoint, {"xi": xi}, saved)

        def told(entry: Record, some: Tensor, r: Tensor) -> None:
            if on_iteration is not None:
                on_iteration(entry, layer.full(some), r)

        result = self.optimizer.run(layer, layer.start, told, inner)
        return replace(result, xi=layer.full(result.xi))


def _told_of(done: OptimizeResult, r: Tensor, on_iteration: Callback) -> Callback:
    """The callback, told of what was done before; where that ends the run, one that ends the next part at once."""
    cut = replayed(done.records, lambda entry: on_iteration(entry, done.xi, r))

    def end(entry: Record, xi: Tensor, r: Tensor) -> None:
        assert cut is not None
        raise Stop(cut)  # the part's own checkpoint may hold a better point than what was done before it

    return on_iteration if cut is None else end


def _shifted(done: OptimizeResult, entry: Record) -> Record:
    """A part's record, counted on from what was done before."""
    before = {
        "iteration": done.n_iterations,
        "residuals": done.n_residuals,
        "linearisations": done.n_linearisations,
        "seconds": done.cpu_seconds,
    }
    return {**entry, **{key: entry[key] + value for key, value in before.items()}}


def _continued(done: OptimizeResult, on_iteration: Callback) -> Callback:
    return lambda entry, xi, r: on_iteration(_shifted(done, entry), xi, r)


def _joined(done: OptimizeResult, result: OptimizeResult) -> OptimizeResult:
    return replace(
        result,
        records=[*done.records, *(_shifted(done, entry) for entry in result.records)],
        n_residuals=done.n_residuals + result.n_residuals,
        n_linearisations=done.n_linearisations + result.n_linearisations,
        cpu_seconds=done.cpu_seconds + result.cpu_seconds,
    )


def _pack(index: int, done: OptimizeResult) -> Arrays:
    counts = {"index": index, "n_residuals": done.n_residuals, "n_linearisations": done.n_linearisations}
    numbers = {name: torch.tensor(value) for name, value in counts.items()}
    numbers["cpu_seconds"] = torch.tensor(done.cpu_seconds, dtype=torch.float64)
    return numbers | {"xi": done.xi, "norm": done.norm} | within("records", pack_records(done.records))


def _restore(saved: Arrays, like: Tensor) -> tuple[int, OptimizeResult, Arrays | None]:
    """The part to go on with, what was done before it, and its own checkpoint."""
    done = OptimizeResult(
        xi=saved["xi"].to(like.device),
        norm=saved["norm"].to(like.device),
        status=Status.INTERRUPTED,
        records=unpack_records(under("records", saved)),
        n_residuals=int(saved["n_residuals"]),
        n_linearisations=int(saved["n_linearisations"]),
        cpu_seconds=float(saved["cpu_seconds"]),
    )
    return int(saved["index"]), done, under("part", saved) or None
