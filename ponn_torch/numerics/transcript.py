"""What a function of tensors ran, written down as a straight-line Python function of its inputs.

Derivatives are operations like others. Left out are operations that constants alone decide, that change nothing (times
one, plus zero), that are computed twice and whose results nobody reads; views of views become one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from types import BuiltinFunctionType, MethodDescriptorType
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode


class Unrecordable(Exception):
    """The function decides by data, draws random numbers, or changes a tensor that is not its own."""


def finite(tensors: Sequence[Tensor]) -> bool:
    return all(bool(torch.isfinite(x).all()) for x in tensors)


# -- recording -------------------------------------------------------------------------------------------------------


class Recorder(TorchDispatchMode):
    """Keeps every operation with its arguments and result; as they stay alive, their ids are names."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: list[tuple[Any, tuple[Any, ...], dict[str, Any], Any]] = []

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled here; to be told so, torch would import its compiler, for most of a second

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        if not any(x.is_meta for x in _tensors((args, out))):  # shapes alone
            self.entries.append((func, args, kwargs, out))
        return out


def _tensors(tree: Any) -> list[Tensor]:
    if isinstance(tree, Tensor):
        return [tree]
    if isinstance(tree, dict):
        return _tensors(list(tree.values()))
    return [x for item in tree for x in _tensors(item)] if isinstance(tree, (list, tuple)) else []


class _Storages(dict[int, int]):
    """The storage of every tensor, by the tensor's id; looked up once."""

    def of(self, x: Tensor) -> int:
        found = self.get(id(x))
        if found is None:
            # forward derivatives hold zeros that are not stored anywhere
            found = self[id(x)] = -id(x) if x._is_zerotensor() else int(x.untyped_storage()._cdata)
        return found


# -- writing ---------------------------------------------------------------------------------------------------------

# results that depend on the shape of an argument only
_FILLERS = {"zeros_like", "ones_like", "full_like", "new_zeros", "new_ones", "new_full"}
# answers that depend on shapes only
_BY_SHAPE = {"is_same_size", "_has_same_storage_numel"}
# operations without a result, which raise an error where data are not what they should be
_CHECKS = {"_linalg_check_errors"}
# what leaves the other argument as it is, and in which places
_NEUTRAL = {"mul": (1.0, (0, 1)), "div": (1.0, (1,)), "pow": (1.0, (1,)), "add": (0.0, (0, 1)), "sub": (0.0, (1,))}
_BY_DATA = {torch.Tag.dynamic_output_shape, torch.Tag.data_dependent_output}


def _value(x: Tensor) -> Any:
    """What equal constants have in common; a large one is only equal to itself."""
    if x.numel() > 4096 or not x.is_contiguous() or x._is_zerotensor():
        return id(x)
    return x.dtype, x.device, x.shape, x.detach().cpu().numpy().tobytes()


def _decides_by_data(func: Any, name: str, read: Sequence[Tensor]) -> bool:
    if name == "index":  # by a mask only
        return any(x.dtype == torch.bool for x in read[1:])
    return not _BY_DATA.isdisjoint(func.tags)


def _binding(name: str) -> Any:
    """What Python calls for an operation, if that is no detour: it takes half the time of the operation's own entry."""
    found = getattr(torch, name, None) or getattr(Tensor, name, None)
    return found if isinstance(found, BuiltinFunctionType | MethodDescriptorType) else None


@dataclass(frozen=True)
class _Step:
    """One line: what is called, the names it reads, those it makes, the root that it changes; or a check to be kept."""

    text: str
    reads: list[str]
    makes: list[str]
    changes: str | None = None
    checks: bool = False


@dataclass
class Writer:
    """Turns recorded operations into lines.

    names: of tensors and captured objects, by id. made: of every storage, the name and the tensor that came with it.
    root: the name that a name shares its storage with. known: by text, what was computed before. constants: by value.
    """

    storages: _Storages = field(default_factory=_Storages)
    names: dict[int, str] = field(default_factory=dict)
    made: dict[int, tuple[str, Tensor]] = field(default_factory=dict)
    root: dict[str, str] = field(default_factory=dict)
    known: dict[str, list[str]] = field(default_factory=dict)
    constants: dict[Any, str] = field(default_factory=dict)
    captured: dict[str, Any] = field(default_factory=lambda: {"as_strided": torch.as_strided})
    steps: list[_Step] = field(default_factory=list)
    arguments: list[str] = field(default_factory=list)
    n_names: int = 0

    @classmethod
    def of(cls, entries: Sequence[Any], inputs: Sequence[Tensor], bindings: bool) -> Writer:
        writer = cls()
        given = {writer.storages.of(x) for x in inputs}
        if len(given) < len(inputs) or not all(x.is_contiguous() for x in inputs):
            raise Unrecordable("inputs overlap, or are not contiguous")
        for x in inputs:
            writer.arguments.append(writer._name(x, "a"))
        changed = {writer.storages.of(_tensors(args)[0]) for func, args, _, _ in entries if func._schema.is_mutable}
        if not changed.isdisjoint(given):
            raise Unrecordable("an input is changed in place")
        for func, args, kwargs, out in entries:
            writer._operation(func, args, kwargs, _tensors(out), changed, bindings)
        return writer

    def _name(self, x: Tensor, letter: str = "t", root: str | None = None) -> str:
        """A new name for a tensor."""
        self.n_names += 1
        name = f"{letter}{self.n_names}"
        self.names[id(x)] = name
        self.root[name] = root or name
        if root is None:
            self.made[self.storages.of(x)] = name, x
        return name

    def _source(self, tree: Any) -> str:
        """An argument as source text; what is neither a number nor computed on the tape is captured."""
        if isinstance(tree, (list, tuple)):
            return "[" + "".join(self._source(x) + "," for x in tree) + "]"
        if tree is None or isinstance(tree, (bool, int)) or (isinstance(tree, float) and repr(tree)[-1].isdigit()):
            return repr(tree)
        if id(tree) not in self.names:
            # ones and zeros are made time and again: one of equal constants is enough
            value = _value(tree) if isinstance(tree, Tensor) else id(tree)
            if value not in self.constants:
                self.n_names += 1
                self.constants[value] = f"c{self.n_names}"
                self.captured[f"c{self.n_names}"] = tree
            self.names[id(tree)] = self.constants[value]
        return self.names[id(tree)]

    def _operation(
        self, func: Any, args: Any, kwargs: Any, out: list[Tensor], changed: set[int], bindings: bool
    ) -> None:
        """Write an operation down, unless its result is a constant, a view, or known; ``changed`` are storages."""
        name, storage = str(func._schema.name).removeprefix("aten::"), self.storages.of
        read = _tensors((args, kwargs))
        if name in _BY_SHAPE:
            return
        for x in read:
            # forward derivatives hand tensors on in new objects that no operation made
            if id(x) not in self.names and storage(x) in self.made:
                self._view(x)
        varies = any(self.names.get(id(x)) in self.root for x in read)
        if varies and name not in _CHECKS and (not out or _decides_by_data(func, name, read)):
            raise Unrecordable(f"{name} decides by data")
        if torch.Tag.nondeterministic_seeded in func.tags:
            raise Unrecordable(f"{name} is random")
        if func._schema.is_mutable:
            first = func._schema.arguments[0].alias_info
            if first is None or not first.is_write or storage(args[0]) not in self.made:
                raise Unrecordable(f"{name} changes what it did not make")
            onto_itself = name == "copy_" and self.names[id(args[0])] == self.names.get(id(args[1]))
            if onto_itself or not args[0].numel() or any(x is args[0] for x in self._unchanged(name, args, kwargs)):
                return
            text, reads = self._call(func, name, args, kwargs, read, bindings)
            self.steps.append(_Step(text, reads, [], self.root[self.names[id(args[0])]]))
            return
        own = not changed.isdisjoint(map(storage, out))
        if not own and (not varies or name in _FILLERS or self._is_constant(name, args, out)):
            return  # always the same: captured where it is read
        if not own and any(self._goes_by(x, out[0], changed) for x in self._unchanged(name, args, kwargs)):
            return
        sources = {storage(x) for x in read} & self.made.keys()
        if out and sources.issuperset(map(storage, out)):
            for x in out:
                self._view(x)
            return
        text, reads = self._call(func, name, args, kwargs, read, bindings)
        if text in self.known:
            for x, known in zip(out, self.known[text], strict=True):
                self.names[id(x)] = known
                self.made[storage(x)] = known, x
            return
        made = [self._name(x) for x in out]
        self.steps.append(_Step(text, reads, made, checks=name in _CHECKS))
        if not own and changed.isdisjoint(map(storage, read)):
            self.known[text] = made

    def _fixed(self, x: Any, value: float) -> bool:
        """Whether an argument is a constant, and this number everywhere."""
        if isinstance(x, Tensor):
            return self.names.get(id(x)) not in self.root and bool((x == value).all())
        return not isinstance(x, bool) and isinstance(x, int | float) and x == value

    def _is_constant(self, name: str, args: Any, out: list[Tensor]) -> bool:
        """Whether a result is zero, or one, whatever varies: that is taken to stay finite."""
        if name == "mul":
            fixed = self._fixed(args[0], 0.0) or self._fixed(args[1], 0.0)
        elif name == "where":
            fixed = self._fixed(args[1], 0.0) and self._fixed(args[2], 0.0)
        else:
            fixed = name == "pow" and self._fixed(args[1], 0.0)
        return fixed and finite(out)

    def _unchanged(self, name: str, args: Any, kwargs: Any) -> list[Tensor]:
        """Arguments that an operation leaves as they are, but for the sign of a zero: times one, plus zero."""
        neutral, places = _NEUTRAL.get(name.removesuffix("_"), (0.0, ()))
        return [args[1 - i] for i in places if not kwargs and self._fixed(args[i], neutral)]

    def _goes_by(self, x: Any, out: Tensor, changed: set[int]) -> bool:
        """Give a result the name of an argument that it is equal to, if views of one are views of the other."""
        if not isinstance(x, Tensor) or (x.dtype, x.shape, x.stride()) != (out.dtype, out.shape, out.stride()):
            return False
        known = self.names[id(x)]
        if self.root[known] != known or self.storages.of(x) in changed:
            return False
        self.names[id(out)] = known
        self.made[self.storages.of(out)] = known, out
        return True

    def _call(
        self, func: Any, name: str, args: Any, kwargs: Any, read: Sequence[Tensor], bindings: bool
    ) -> tuple[str, list[str]]:
        """The source text of a call, and the names that it reads."""
        gaps = any(x is None for item in args if isinstance(item, list) for x in item)  # bindings take none
        binding = _binding(name) if bindings and not gaps else None
        words = [self._source(x) for x in args] + [f"{k}={self._source(v)}" for k, v in kwargs.items()]
        reads = [self.names[id(x)] for x in read if self.names[id(x)] in self.root]
        return f"{self._source(binding or func)}({','.join(words)})", reads

    def _view(self, x: Tensor) -> None:
        """Name a tensor that shares the storage of one that was made."""
        root, base = self.made[self.storages.of(x)]
        start = x.storage_offset() - base.storage_offset()
        if (x.shape, x.stride(), start) == (base.shape, base.stride(), 0):
            self.names[id(x)] = root
            return
        text = f"as_strided({root},{tuple(x.shape)},{x.stride()},{start})"
        if text in self.known:
            self.names[id(x)] = self.known[text][0]
            return
        self.known[text] = [self._name(x, root=root)]
        self.steps.append(_Step(text, [root], self.known[text]))

    def _returned(self, results: Sequence[Tensor]) -> Iterator[str]:
        """Results as source text; what is an input, a constant or another result is a copy, to be its owner's."""
        given = set(self.arguments)
        for x in results:
            name = self._source(x)
            root = self.root.get(name)
            yield f"{name}.clone()," if root is None or root in given else f"{name},"
            given.update([root] if root else [])

    def written(self, results: Sequence[Tensor]) -> tuple[Callable[..., Sequence[Tensor]], str, int]:
        """A function of the inputs, its source, and how many operations that has: the lines that the results need.

        Each name is forgotten after its last use.
        """
        returned = f"return [{''.join(self._returned(results))}]"
        needed = {self.names[id(x)] for x in results}
        needed |= {self.root[name] for name in needed if name in self.root}
        alive, lines, count = set(needed), [returned], 0
        for step in reversed(self.steps):
            if not (needed.intersection(step.makes) or step.changes in needed or step.checks):
                continue
            count += 1
            dead = {name for name in [*step.reads, *step.makes] if name not in alive and name[0] == "t"}
            if dead:
                lines.append(f"del {','.join(sorted(dead))}")
            lines.append(f"{','.join(step.makes)}={step.text}" if step.makes else step.text)
            needed.update(step.reads)
            needed.update(self.root[name] for name in step.reads)
            alive.update(step.reads)
        body = "\n    ".join(reversed(lines))
        text = f"def play({','.join(self.arguments)}):\n    {body}\n"
        scope = dict(self.captured)
        exec(compile(text, "<tape>", "exec"), scope)
        return scope["play"], text, count
