"""A solved trajectory in the user's units: sampled anywhere, costed, saved and loaded."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ponn_torch.numerics.quadrature import integrate
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting
from ponn_torch.optimal_control.control_set import INTERIOR, LOWER, UPPER
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Weak
from ponn_torch.optimal_control.pontryagin import pontryagin, with_singular_arcs
from ponn_torch.optimal_control.problem import DisplayUnit, OptimalControlProblem
from ponn_torch.solving.storage import load_curve, save_curve

SOLUTION = "solution"  # where the folder of a run has its own
ARC_LABELS = {LOWER: "min", INTERIOR: "interior", UPPER: "max"}
SINGULAR_LABELS = {**ARC_LABELS, INTERIOR: "singular"}  # where H is affine in the control
TRAJECTORY = "trajectory.csv"


@dataclass(frozen=True)
class Samples:
    """A trajectory at m times, in the user's units.

    Attributes:
        t: (m,) s.
        states, costates: name → (m, size).
        control: name → (m, size).
        switching: S (m, n_switching), positive where more control is better; (m, 0) without bounds.
        fraction: η ∈ [0, 1] of the admissible range, (m, k).
        hamiltonian: (m,), the H that the solution's regime minimises, cost per s.
        segment: (m,) index of the segment that each sample belongs to; a switch time belongs to two.
    """

    t: Tensor
    states: dict[str, Tensor]
    costates: dict[str, Tensor]
    control: dict[str, Tensor]
    switching: Tensor
    fraction: Tensor
    hamiltonian: Tensor
    segment: Tensor

    def __len__(self) -> int:
        return len(self.t)


def in_a_row(arcs: Sequence[str]) -> str:
    """Arcs in one line: max-min-max, or max,min / min,min where each names several components."""
    return (" / " if any("," in arc for arc in arcs) else "-").join(arcs)


@dataclass(frozen=True, eq=False)
class Solution:
    """One curve, with everything that follows from it; without a batch axis.

    Raises:
        ValueError: a batch of curves, or a control that jumps where neither a smoothing nor arcs choose it.
    """

    curve: Curve

    def __post_init__(self) -> None:
        if self.curve.xi.dim() != 1:
            raise ValueError(f"xi has shape {tuple(self.curve.xi.shape)}; a Solution holds one curve, shape (N,)")
        regime = self.curve.collocation.setting.regime
        if self.bvp.law.jumps and regime.arcs is None and not self.curve.smoothing:
            raise ValueError(
                f"{self.problem.name}: its optimal control jumps, so the setting needs a smoothing or arcs"
            )

    # -- what it is ------------------------------------------------------------------------------------------

    @property
    def bvp(self) -> BoundaryValueProblem:
        return self.curve.collocation.bvp

    @property
    def reference(self) -> BoundaryValueProblem:
        """The same equations in float64 on the CPU, whatever the curve was computed in."""
        bvp = self.bvp
        if bvp.unit.dtype == torch.float64 and bvp.unit.device.type == "cpu":
            return bvp
        reference = pontryagin(bvp.problem, mass_variable=bvp.mass_variable, chains=False)
        return with_singular_arcs(reference, bvp.singular)

    @property
    def problem(self) -> OptimalControlProblem:
        return self.bvp.problem

    @property
    def kind(self) -> str:
        """``split`` into arcs, ``smoothed`` by a regulariser, or ``smooth`` by itself."""
        if self.curve.collocation.setting.regime.arcs is not None:
            return "split"
        return "smoothed" if self.bvp.law.jumps else "smooth"

    @property
    def smoothing(self) -> float | None:
        """ρ of a smoothed solution; None where no regulariser is in force."""
        return self.curve.smoothing if self.kind == "smoothed" else None

    @property
    def arcs(self) -> list[str]:
        """One label per arc ("max", "min", "interior", "singular"), components joined by ","; [] if not split."""
        codes = self.curve.collocation.setting.regime.arcs
        if codes is None:
            return []
        rows = codes[[segments.start for segments in self.arc_segments]].tolist()
        labels = [SINGULAR_LABELS if i in self.bvp.law.jumping else ARC_LABELS for i in range(codes.shape[-1])]
        return [",".join(names[code] for names, code in zip(labels, row, strict=True)) for row in rows]

    @property
    def arc_segments(self) -> list[range]:
        """The segments of each arc; one range over all where the solution is not split."""
        collocation = self.curve.collocation
        codes, n_segments = collocation.setting.regime.arcs, collocation.n_segments
        if codes is None:
            return [range(n_segments)]
        changes = (codes[1:] != codes[:-1]).any(-1).nonzero()[:, 0] + 1
        starts = sorted({0, *collocation.switch_knots, *changes.tolist()})
        return [range(start, end) for start, end in pairwise([*starts, n_segments])]

    @property
    def final_time(self) -> float:
        """s."""
        return float(self.curve.times[-1]) * self.bvp.time_unit

    @property
    def switch_times(self) -> list[float]:
        """Times in s at which an arc ends; fixed knots do not count."""
        return [float(self.curve.times[k]) * self.bvp.time_unit for k in self.curve.collocation.switch_knots]

    @cached_property
    def off_node_residual(self) -> float:
        """Largest |ẇ − F| between the nodes, scaled."""
        return self.curve.off_node_residual()

    @property
    def cost(self) -> float:
        """∫ running cost dt + terminal cost, in the user's units and without the regulariser.

        A weak solution claims its moments, which the nodes' quadrature makes; between the nodes its control may jump to
        and fro. Its cost is therefore that quadrature, and the certificate tells what flying it costs.
        """
        collocation = self.curve.collocation
        if isinstance(collocation.discretisation.form, Weak):
            return float(collocation.cost(self.curve.xi))
        bvp, times, total = self.bvp, self.curve.times, 0.0
        if self.problem.running_cost is not None:

            def rate(t: Tensor) -> Tensor:
                w, setting = self.at(t, self.curve.segment_of(t))
                return bvp.running_cost(t[:, None], w, setting)[:, 0]

            # no panel reaches over a knot, and there are sixteen at least
            fractions = torch.arange(max(1, 16 // (len(times) - 1)), dtype=times.dtype, device=times.device)
            inner = times[:-1, None] + times.diff()[:, None] * fractions / len(fractions)
            total = integrate(rate, torch.cat([inner.flatten(), times[-1:]]))
        return bvp.cost_unit * total + self._terminal_cost

    @property
    def _terminal_cost(self) -> float:
        x, _ = self.bvp.to_physical(self.curve.knots[-1:])
        last = torch.tensor([self.curve.collocation.n_segments - 1], device=x.device)
        return float(self.bvp.terminal_cost(self.curve.times[-1:, None], x, self.curve.setting(last)))

    # -- sampling --------------------------------------------------------------------------------------------

    def at(self, t: Tensor, segment: Tensor) -> tuple[Tensor, Setting]:
        """Scaled w (m, 2n) and the setting at scaled times, each on a given segment."""
        times = self.curve.times
        inside = torch.minimum(torch.maximum(t, times[segment]), times[segment + 1])
        return self.curve.at(inside, segment), self.curve.setting(segment)

    def _samples(self, t: Tensor, segment: Tensor) -> Samples:
        bvp, problem = self.bvp, self.problem
        w, setting = self.at(t, segment)
        x, costates = bvp.to_physical(w)
        best = bvp.minimiser(t[:, None], w, setting)
        h = bvp.hamiltonian(t[:, None], w, setting)[:, 0] * (bvp.cost_unit / bvp.time_unit)
        return Samples(
            t=t * bvp.time_unit,
            states={name: x[:, s] for name, s in problem.slices.items()},
            costates={name: costates[:, s] for name, s in problem.slices.items()},
            control=best.control,
            switching=best.switching,
            fraction=best.fraction,
            hamiltonian=h,
            segment=segment,
        )

    def __call__(self, t: float | Sequence[float] | NDArray[np.floating] | Tensor) -> Samples:
        """Samples at times in s; at a switch those of the arc that begins there.

        Raises:
            ValueError: a time outside [0, final_time].
        """
        like = self.curve.xi
        seconds = torch.as_tensor(t, dtype=like.dtype, device=like.device).reshape(-1)
        slack = 1e-12 * self.final_time
        outside = (seconds < -slack) | (seconds > self.final_time + slack) | torch.isnan(seconds)
        if bool(outside.any()):
            raise ValueError(f"t = {seconds[outside][0]:g} s; allowed: from 0 to final_time = {self.final_time:g} s")
        scaled = (seconds / self.bvp.time_unit).clamp(self.curve.times[0], self.curve.times[-1])
        return self._samples(scaled, self.curve.segment_of(scaled))

    def sample(self, n: int = 400) -> Samples:
        """n evenly spaced samples and every switch from both of its sides, in ascending time."""
        times = self.curve.times
        even = torch.linspace(0.0, 1.0, n, dtype=times.dtype, device=times.device)
        even = times[0] + (times[-1] - times[0]) * even
        even[-1] = times[-1]
        switches = [segments.start for segments in self.arc_segments[1:]]
        near = (even[:, None] - times[switches]).abs() < 1e-12 * (times[-1] - times[0])
        even = even[~near.any(-1)]
        t = torch.cat([even, times[switches], times[switches]])
        before = torch.tensor(switches, dtype=torch.long, device=times.device)
        segment = torch.cat([self.curve.segment_of(even), before - 1, before])
        order = torch.argsort(t)
        order = order[torch.argsort(segment[order], stable=True)]
        return self._samples(t[order], segment[order])

    # -- files -----------------------------------------------------------------------------------------------

    def save(self, folder: Path | str) -> None:
        """Write solution.json, weights.npz and trajectory.csv (for other programs) into a folder."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        save_curve(self.curve, folder)
        header, rows = self.table(self.sample())
        with (folder / TRAJECTORY).open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(header)
            writer.writerows(rows.tolist())

    @classmethod
    def load(cls, folder: Path | str, problem: OptimalControlProblem | None = None) -> Solution:
        """Read what ``save`` wrote; ``problem`` is needed only if the saved one has no origin.

        Raises:
            FileNotFoundError: no solution in the folder.
            ValueError: a problem that cannot be made again, or is not the saved one.
        """
        return cls(load_curve(Path(folder), problem))

    def table(self, samples: Samples) -> tuple[list[str], Tensor]:
        """Column names with units, and the samples (m, columns) in the problem's display units."""
        problem, columns = self.problem, []
        time = problem.display.get("time", DisplayUnit("s"))
        cost = problem.display.get("cost", DisplayUnit(""))

        def add(name: str, values: Tensor, label: str, size: float) -> None:
            numbered = [name] if values.shape[-1] == 1 else [f"{name}_{i + 1}" for i in range(values.shape[-1])]
            for i, entry in enumerate(numbered):
                columns.append((f"{entry} [{label}]" if label else entry, values[:, i] / size))

        add("t", samples.t[:, None], time.label, time.size)
        for name, values in samples.states.items():
            unit = problem.display.get(name, DisplayUnit(""))
            add(name, values, unit.label, unit.size)
        for name, values in samples.costates.items():
            unit = problem.display.get(name, DisplayUnit(""))
            label = "" if unit.label in ("", cost.label) else f"{cost.label or '1'}/({unit.label})"
            add(f"lambda_{name}", values, label, cost.size / unit.size)
        for name, values in samples.control.items():
            unit = problem.display.get(name, problem.display.get(name.removesuffix("_magnitude"), DisplayUnit("")))
            add(name, values, unit.label, unit.size)
        add("S", samples.switching, "", 1.0)
        add("H", samples.hamiltonian[:, None], f"{cost.label or '1'}/{time.label}", cost.size / time.size)
        return [name for name, _ in columns], torch.stack([values for _, values in columns], -1)
