"""A fuel-optimal plan made anew from the flown state, for a fleet of landers at once.

While a switch lies ahead the split is solved warm from where a lander is (solving/family.py), all landers with the same
arcs ahead in one batch; where S then asks for other arcs the split repairs them; where it finds none the last plan
stays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ponn_torch.solving.family import Family, Restart
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.split import Split


class Fleet:
    """B landers and the plan that each follows."""

    def __init__(self, planned: Solution, states: Tensor, restart: Restart | None = None) -> None:
        self.bvp, self.restart, count = planned.bvp, restart or Restart(), len(states)
        self.plans: list[tuple[Family, int]] = [(Family.of(planned.curve), 0)] * count  # a family, and who in it
        self.n_plans, self.n_kept, self.n_repaired = (torch.zeros(count, dtype=torch.long) for _ in range(3))
        self.arrival = torch.zeros(count, dtype=torch.float64)
        self._note(range(count))

    def _together(self, members: Sequence[int]) -> Iterator[tuple[list[int], Family]]:
        """Members whose plans are rows of one family, side by side in it: (who, the family of them)."""
        groups: dict[int, list[int]] = {}
        for i in members:
            groups.setdefault(id(self.plans[i][0]), []).append(i)
        for who in groups.values():
            yield who, self.plans[who[0]][0][torch.tensor([self.plans[i][1] for i in who])]

    def _note(self, members: range | list[int]) -> None:
        for i in members:
            family, row = self.plans[i]
            self.arrival[i] = float(family.arc_times[row, -1]) * self.bvp.time_unit

    def switches_ahead(self, t: float) -> Tensor:
        """Switches (B,) of each lander's plan that are still to come at time t."""
        return torch.tensor([int((f.arc_times[i, 1:-1] > t / self.bvp.time_unit).sum()) for f, i in self.plans])

    def plan(self, members: list[int], measured: Tensor, t: float) -> None:
        """New plans for some landers from measured states (B', 7); those that have none keep the last."""
        ahead = self.switches_ahead(t)
        states = dict(zip(members, measured, strict=True))
        alike = [[i for i in members if ahead[i] == left] for left in ahead[members].unique()]
        for who, family in [group for some in alike for group in self._together(some)]:
            start, passed = t / self.bvp.time_unit, family.n_arcs - 1 - int(ahead[who[0]])
            here = torch.stack([states[i] for i in who])
            found, solved = family.restart(here, start, passed=passed, how=self.restart)
            for row, i in enumerate(who):
                if bool(solved[row]):
                    self.plans[i] = (found, row)
                    self.n_plans[i] += 1
                else:
                    self._repair(i, found, row)
            self._note(who)

    def return_to(self, plans: Sequence[tuple[Family, int]], members: list[int]) -> None:
        """Follow earlier plans again."""
        self.plans = list(plans)
        self._note(members)

    def _repair(self, i: int, found: Family, row: int) -> None:
        """Let the split look for other arcs; its own clock starts at zero."""
        curve = found.curve(row)
        made, start = curve.collocation, float(curve.times[0])
        states = self.bvp.to_physical(made.known_knots[0])[0].tolist()
        problem = self.bvp.problem
        initial = {name: states[where] for name, where in problem.slices.items()}
        bvp = replace(self.bvp, problem=problem.with_boundary(initial=initial), known_initial=made.known_knots[0])
        moved = replace(made, discretisation=made.discretisation.serving(bvp), known_times=made.known_times - start)
        unknowns = made.unpack(curve.xi)
        xi = moved.pack(replace(unknowns, times=unknowns.times - start))
        refined = Split(n_segments=self.restart.segmentation.n_segments, max_sharpenings=0).run(type(curve)(moved, xi))
        if refined.outcome.name != "SOLVED":
            self.n_kept[i] += 1
            return
        family = Family.of(refined.curve)
        later = replace(family.collocation, known_times=family.collocation.known_times + start)
        there = replace(family.unknowns, times=family.unknowns.times + start)
        self.plans[i] = (Family(later, later.pack(there)), 0)
        self.n_repaired[i] += 1

    def thrust(self, t: Tensor) -> Tensor:
        """Planned thrust (B, m, 3) at times (B, m), N."""
        out = t.new_zeros(*t.shape, 3)
        for who, family in self._together(range(len(self.plans))):
            out[who] = family.control(t[who] / self.bvp.time_unit)[self.bvp.law.name]  # type: ignore[attr-defined]
        return out
