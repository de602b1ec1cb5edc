"""Measured states and costates as further rows of a residual: √w (x_i(t_j) − y_ij), in scaled units.

The PoNN paper states this extension. Rows belong to the segment that their time lies in, and keep the arrow shape.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ponn_torch.numerics.linalg import ArrowJacobian
from ponn_torch.optimal_control.collocation import Collocation, component_names
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.linearisation import linearise
from ponn_torch.optimal_control.problem import DisplayUnit, OptimalControlProblem, nearest


@dataclass(frozen=True)
class Measurements:
    """Values of components at times.

    Attributes:
        times: (M,) s.
        values: component name (``r_1``, ``m``, ``lambda_v_2``) → (M,) in SI; NaN where it was not measured.
        weights: component name → w (default 1), on squares of scaled deviations.

    Raises:
        ValueError: lengths that do not match, or a weight that is negative.
    """

    times: Tensor
    values: Mapping[str, Tensor]
    weights: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, values in self.values.items():
            if values.shape != self.times.shape:
                raise ValueError(f"values.{name} has shape {tuple(values.shape)}; allowed: {tuple(self.times.shape)}")
        for name, weight in self.weights.items():
            if name not in self.values:
                raise ValueError(f"weights.{name}: not measured; {nearest(name, list(self.values))}")
            if not weight >= 0:
                raise ValueError(f"weights.{name} = {weight}; allowed: a number ≥ 0")

    def of(self, problem: OptimalControlProblem) -> Measurements:
        """These measurements, whatever the problem."""
        return self


@dataclass(frozen=True)
class MeasurementFile:
    """A CSV or NPZ file: ``t`` and one column per component, SI, or units in brackets as in trajectory.csv.

    Attributes:
        variables: names of states and costates to take (``r``, ``lambda_v``); None: the states that are there.
        weight: w of all components. every: take each n-th line.
    """

    path: str
    variables: list[str] | None = None
    weight: float = 1.0
    every: int = 1

    def __post_init__(self) -> None:
        if not self.weight >= 0:
            raise ValueError(f"weight = {self.weight}; allowed: a number ≥ 0")
        if self.every < 1:
            raise ValueError(f"every = {self.every}; allowed: at least 1")

    def of(self, problem: OptimalControlProblem) -> Measurements:
        """Read the file for a problem.

        Raises:
            ValueError: no file, no times, an unknown unit, or nothing that the problem has.
        """
        columns = _read(Path(self.path))
        clock = problem.display.get("time", DisplayUnit("s"))
        found = {name.partition(" [")[0]: (name.partition(" [")[2].rstrip("]"), v) for name, v in columns.items()}
        if "t" not in found:
            raise ValueError(f"path = {self.path!r}: no column 't'; found: {', '.join(found)}")
        times = self._in_si("t", *found["t"], clock)
        values = {}
        for name, (variable, shown) in _components(problem).items():
            wanted = variable in problem.states if self.variables is None else variable in self.variables
            if name in found and wanted:
                values[name] = self._in_si(name, *found[name], shown)
        if not values:
            allowed = ", ".join(_components(problem))
            raise ValueError(f"path = {self.path!r}: nothing to take; found: {', '.join(found)}; allowed: {allowed}")
        return Measurements(times, values, dict.fromkeys(values, self.weight))

    def _in_si(self, name: str, label: str, values: np.ndarray, shown: DisplayUnit) -> Tensor:
        if label not in ("", shown.label):
            raise ValueError(f"path = {self.path!r}: {name} in {label!r}; allowed: SI, or {shown.label!r}")
        return torch.as_tensor(values[:: self.every].copy()) * (shown.size if label else 1.0)


def _read(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise ValueError(f"path = {str(path)!r}; there is no such file")
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as stream:
            return {name: np.asarray(stream[name], dtype=float) for name in stream.files}
    with path.open(newline="", encoding="utf-8") as stream:
        header, *lines = csv.reader(stream)
    rows = np.array([[float(cell) if cell.strip() else np.nan for cell in line] for line in lines])
    return {name.strip(): rows[:, i] for i, name in enumerate(header)}


def _components(problem: OptimalControlProblem) -> dict[str, tuple[str, DisplayUnit]]:
    """Every component of states and costates: the variable that it belongs to, and the unit that it is shown in."""
    cost = problem.display.get("cost", DisplayUnit(""))
    out, costates = {}, {}
    for state, size in problem.states.items():
        shown = problem.display.get(state, DisplayUnit(""))
        label = "" if shown.label in ("", cost.label) else f"{cost.label or '1'}/({shown.label})"
        for name in [state] if size == 1 else [f"{state}_{i + 1}" for i in range(size)]:
            out[name] = (state, shown)
            costates[f"lambda_{name}"] = (f"lambda_{state}", DisplayUnit(label, cost.size / shown.size))
    return out | costates


# -- the residual ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Measured:
    """A collocation residual with the rows of measurements; ξ (N,), one problem.

    Every segment has a further row for every measurement, zero where that lies in another one.

    Raises:
        ValueError: a name that is no component of states or costates, or no time from the start on.
    """

    collocation: Collocation
    measurements: Measurements

    def __post_init__(self) -> None:
        names = component_names(self.collocation.bvp)
        for name in self.measurements.values:
            if name not in names:
                raise ValueError(f"measured {name!r}: no such component; {nearest(name, names)}")
        times = self.measurements.times
        if not bool(((times >= 0) & torch.isfinite(times)).any()):
            raise ValueError(f"measured times = {times.tolist()}; allowed: within the flight")

    @cached_property
    def _rows(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Per row: time (scaled), component, value and √w, both scaled."""
        bvp, like = self.collocation.bvp, self.collocation.known_times
        names, parts = component_names(bvp), []
        for name, values in self.measurements.values.items():
            index, weight = names.index(name), self.measurements.weights.get(name, 1.0)
            there = torch.isfinite(values)
            t, y = self.measurements.times[there] / bvp.time_unit, values[there] / float(self._sizes[index])
            parts.append((t, torch.full_like(t, index), y, torch.full_like(t, weight**0.5)))
        t, column, y, root = (torch.cat(items).to(like) for items in zip(*parts, strict=True))
        return t, column.long(), y, root

    @cached_property
    def _sizes(self) -> Tensor:
        problem, like = self.collocation.bvp.problem, self.collocation.known_times
        columns = [name for name, size in problem.states.items() for _ in range(size)]
        return like.new_tensor([unit(name) for unit in (problem.unit, problem.costate_unit) for name in columns])

    @property
    def n_unknowns(self) -> int:
        return self.collocation.n_unknowns

    @property
    def linear_unknowns(self) -> Tensor:
        return self.collocation.linear_unknowns

    def _segments(self, xi: Tensor) -> Tensor:
        """The segment (M,) of every row; times after the end count at the end."""
        times = self.collocation.unpack(xi.detach()).times
        return torch.searchsorted(times[1:-1].contiguous(), self._rows[0], right=True)

    def _deviations(self, xi: Tensor, segment: Tensor) -> Tensor:
        """√w (x − y) (M,), scaled."""
        curve, (t, column, y, root) = Curve(self.collocation, xi), self._rows
        start, end = curve.times[segment], curve.times[segment + 1]
        # not by minimum and maximum, which would halve the slope where a time is that of a knot
        inside = torch.where(t < start, start, torch.where(t > end, end, t))
        physical = torch.cat(self.collocation.bvp.to_physical(curve.at(inside, segment)), -1) / self._sizes
        return root * (physical.gather(-1, column[:, None])[:, 0] - y)

    def residual(self, xi: Tensor) -> Tensor:
        """r of the equations, every segment's followed by its measurements', then the rows that segments share."""
        segment = self._segments(xi)
        return self._merge(self.collocation.residual(xi), self._deviations(xi, segment), segment)

    def linearise(self, xi: Tensor) -> tuple[Tensor, ArrowJacobian]:
        """(r, J); rows of measurements by reverse mode through the expression at their times."""
        segment = self._segments(xi)
        r, jacobian = linearise(self.collocation, xi)
        point = xi.detach().requires_grad_()
        with torch.enable_grad():
            deviations = self._deviations(point, segment)
        count, n_weights = len(deviations), self.collocation.n_weights
        seeds = torch.eye(count, dtype=xi.dtype, device=xi.device)
        (slopes,) = torch.autograd.grad(deviations, point, seeds, is_grads_batched=True)
        row = torch.arange(count, device=xi.device)
        local = slopes.new_zeros(self.collocation.n_segments, count, self.collocation.discretisation.n_own)
        local[segment, row] = slopes[:, :n_weights].view(count, *local[:, 0].shape)[row, segment]
        shared = slopes.new_zeros(self.collocation.n_segments, count, jacobian.shared.shape[-1])
        spare = torch.cat([slopes[:, n_weights:], slopes.new_zeros(count, 1)], -1)
        shared[segment, row] = spare.gather(-1, jacobian.index[segment])
        merged = replace(
            jacobian,
            local=torch.cat([jacobian.local, local], -2),
            shared=torch.cat([jacobian.shared, shared], -2),
        )
        return self._merge(r, deviations.detach(), segment), merged

    def _merge(self, r: Tensor, deviations: Tensor, segment: Tensor) -> Tensor:
        k, n_rows, count = self.collocation.n_segments, self.collocation.discretisation.n_rows, len(deviations)
        where = segment, torch.arange(count, device=r.device)
        padded = deviations.new_zeros(k, count).index_put(where, deviations)
        segments = torch.cat([r[: k * n_rows].view(k, n_rows), padded], -1)
        return torch.cat([segments.flatten(), r[k * n_rows :]])

    def blocks(self, residual: Tensor) -> Mapping[str, Tensor]:
        """Those of the equations, and ``data``."""
        k, n_rows = self.collocation.n_segments, self.collocation.discretisation.n_rows
        width = len(self._rows[0])
        segments = residual[: k * (n_rows + width)].view(k, n_rows + width)
        equations = torch.cat([segments[:, :n_rows].flatten(), residual[k * (n_rows + width) :]])
        return {**self.collocation.blocks(equations), "data": segments[:, n_rows:].norm()}
