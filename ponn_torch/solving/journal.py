"""A journal of a solve's optimiser calls, from which the solve is taken up again where it ended.

A solve is deterministic, so it is simply run again: calls that were finished are answered from the journal, the one
under way goes on from its checkpoint, and what lies between them is computed anew, which takes moments.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from ponn_torch.optim.base import Callback, Optimizer, OptimizeResult, Residual, Status, replayed
from ponn_torch.optim.checkpoint import (
    Arrays,
    CheckpointFile,
    pack_records,
    read,
    under,
    unpack_records,
    within,
    write,
)

BELONGS = "belongs_to.json"


class ForeignJournal(ValueError):
    """A journal that was kept for another solve."""


class Journal:
    """One file per finished call in a folder, the checkpoint of the one under way, and what solve they belong to.

    Raises:
        FileNotFoundError: ``resume`` with nothing in the folder.
    """

    def __init__(self, folder: Path, *, resume: bool = False, seconds: float = 20.0) -> None:
        self.folder, self._seconds, self._replaying = folder, seconds, resume
        self._count = 0
        if resume and not any(folder.glob("*.npz")):
            raise FileNotFoundError(f"nothing to resume: no checkpoint in {str(folder)!r}")

    def belongs_to(self, solve: Mapping[str, str]) -> None:
        """Keep the digests of all that a solve is determined by, or hold them against those that were kept.

        Raises:
            ForeignJournal: to go on with another solve; the message names what differs.
        """
        path = self.folder / BELONGS
        if self._replaying:
            before = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
            others = [name for name, digest in solve.items() if before.get(name) != digest]
            if others:
                raise ForeignJournal(
                    f"{str(self.folder)!r} holds a solve with other values of {', '.join(others)}; "
                    "allowed: to go on with the same problem, seed and settings, but for the budget"
                )
        else:
            self.folder.mkdir(parents=True, exist_ok=True)
            for left in self.folder.glob("[0-9][0-9][0-9]*.npz"):  # by an earlier solve
                left.unlink()
            path.write_text(json.dumps(dict(solve), indent=2) + "\n", encoding="utf-8")

    def run(
        self,
        optimizer: Optimizer,
        residual: Residual,
        xi: Tensor,
        on_iteration: Callback | None = None,
        spend: Callable[[float], None] = lambda seconds: None,
    ) -> OptimizeResult:
        """What ``optimizer.run`` gives, or gave; ``spend`` is told of CPU seconds that an earlier process took.

        Where the callback ends the run while it is told of what was done before, the status says so.
        """
        finished, under_way = (self.folder / f"{self._count:03d}{suffix}.npz" for suffix in ("", "_under_way"))
        self._count += 1
        if self._replaying and finished.is_file():
            result = _unpack(read(finished), xi)
            spend(result.cpu_seconds)
            return result if on_iteration is None else _told_of(result, residual, on_iteration)
        checkpoint = CheckpointFile(under_way, resume=self._replaying and under_way.is_file(), seconds=self._seconds)
        self._replaying = False
        if checkpoint.saved is not None:
            columns = (column for name, column in checkpoint.saved.items() if name.endswith("records/seconds"))
            spend(sum(float(column[-1]) for column in columns if len(column)))
        result = optimizer.run(residual, xi, on_iteration, checkpoint)
        if not result.status.cut:
            write(finished, _pack(result))
            under_way.unlink(missing_ok=True)
        return result


def _told_of(result: OptimizeResult, residual: Residual, on_iteration: Callback) -> OptimizeResult:
    """A finished result, once its callback was told of its iterations."""
    r = residual.residual(result.xi)
    cut = replayed(result.records, lambda entry: on_iteration(entry, result.xi, r))
    return result if cut is None else replace(result, status=cut)


def _pack(result: OptimizeResult) -> Arrays:
    codes = [list(Status).index(status) for status in (result.status, *result.member_status)]
    counts = {"n_residuals": result.n_residuals, "n_linearisations": result.n_linearisations}
    return {
        "xi": result.xi,
        "norm": result.norm,
        "codes": torch.tensor(codes),
        "cpu_seconds": torch.tensor(result.cpu_seconds, dtype=torch.float64),
        **{name: torch.tensor(value) for name, value in counts.items()},
        **within("records", pack_records(result.records)),
    }


def _unpack(saved: Arrays, like: Tensor) -> OptimizeResult:
    first, *members = (list(Status)[code] for code in saved["codes"].tolist())
    result = OptimizeResult(saved["xi"].to(like.device), saved["norm"].to(like.device), first)
    return replace(
        result,
        records=unpack_records(under("records", saved)),
        n_residuals=int(saved["n_residuals"]),
        n_linearisations=int(saved["n_linearisations"]),
        cpu_seconds=float(saved["cpu_seconds"]),
        member_status=tuple(members),
    )
