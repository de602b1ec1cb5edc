"""Checkpoints: the state of an optimiser as named arrays in one file, without pickle."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ponn_torch.optim.base import Record

Arrays = dict[str, Tensor]


class Checkpoint(Protocol):
    """Where an optimiser leaves its state: ``saved`` is what it continues from, None for a new run."""

    @property
    def saved(self) -> Arrays | None: ...

    def due(self) -> bool:
        """Whether it is time to save."""
        ...

    def save(self, arrays: Arrays) -> None: ...


class CheckpointFile:
    """A checkpoint in one NPZ file, replaced as a whole every ``seconds`` of wall time.

    Raises:
        FileNotFoundError: ``resume`` with no file there.
    """

    def __init__(self, path: Path | str, *, resume: bool = False, seconds: float = 20.0) -> None:
        self.path, self._seconds, self._last = Path(path), seconds, time.monotonic()
        if resume and not self.path.is_file():
            raise FileNotFoundError(f"nothing to resume: {str(self.path)!r} does not exist")
        self.saved: Arrays | None = read(self.path) if resume else None

    def due(self) -> bool:
        return time.monotonic() - self._last >= self._seconds

    def save(self, arrays: Arrays) -> None:
        write(self.path, arrays)
        self._last = time.monotonic()


class Nested:
    """The share that one part of a chain has in the chain's checkpoint."""

    def __init__(self, outer: Checkpoint, context: Arrays, saved: Arrays | None) -> None:
        self._outer, self._context, self.saved = outer, context, saved

    def due(self) -> bool:
        return self._outer.due()

    def save(self, arrays: Arrays) -> None:
        self._outer.save(self._context | within("part", arrays))


def write(path: Path, arrays: Arrays) -> None:
    """Write named tensors; whatever ends the process, the file is the old one or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = path.with_name(path.name + ".part")
    with whole.open("wb") as stream:
        np.savez(stream, **{name: value.detach().cpu().numpy() for name, value in arrays.items()})  # type: ignore[arg-type]
    os.replace(whole, path)


def read(path: Path) -> Arrays:
    with np.load(path, allow_pickle=False) as stream:
        return {name: torch.from_numpy(stream[name]) for name in stream.files}


def under(group: str, arrays: Arrays) -> Arrays:
    """The entries of a group, without its name."""
    return {name.removeprefix(f"{group}/"): value for name, value in arrays.items() if name.startswith(f"{group}/")}


def within(group: str, arrays: Arrays) -> Arrays:
    """The same entries under the name of a group; ``under`` takes it off again."""
    return {f"{group}/{name}": value for name, value in arrays.items()}


def pack_records(records: Sequence[Record]) -> Arrays:
    """One column per entry, in the order of the records."""
    return {key: torch.tensor([entry[key] for entry in records], dtype=_kind(records, key)) for key in _keys(records)}


def unpack_records(columns: Arrays) -> list[Record]:
    values = {key: column.tolist() for key, column in columns.items()}
    return [dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True)]


def _keys(records: Sequence[Record]) -> list[str]:
    return list(records[0]) if records else []


def _kind(records: Sequence[Record], key: str) -> torch.dtype:
    kinds = {bool: torch.bool, int: torch.int64, float: torch.float64}
    return kinds[type(records[0][key])]


def pack(state: Any) -> Arrays:
    """The tensors and numbers among a dataclass's fields; whatever else it holds can be made again from them."""
    held = {item.name: getattr(state, item.name) for item in fields(state)}
    kept = {name: value for name, value in held.items() if isinstance(value, Tensor | bool | int | float)}
    return {name: torch.as_tensor(_exact(value)) for name, value in kept.items()}


def unpack(cls: type[Any], arrays: Arrays, device: torch.device) -> Any:
    """The dataclass of ``pack``; a field is a number where its annotation says so."""
    numbers = {item.name for item in fields(cls) if item.type in ("int", "float", "bool")}
    return cls(**{n: v.item() if n in numbers else v.to(device) for n, v in arrays.items()})


def _exact(value: Any) -> Any:
    return torch.tensor(value, dtype=torch.float64) if isinstance(value, float) else value
