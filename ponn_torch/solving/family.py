"""Trajectories with the same arcs from different starts: solved warm, together, in one batch of the split.

A neighbour of a solved problem needs no smoothing and no search: its arcs are known, its switch times nearly. That is
what a controller solves every cycle from the state it has been flown to, and what a dispersion study solves per sample.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from ponn_torch.optim.base import Status, Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_set import Minimiser, Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.layout import Unknowns
from ponn_torch.solving.guess import project
from ponn_torch.solving.refinement import Segmentation, shared_out
from ponn_torch.solving.switching import wrong_side


def _warm() -> LevenbergMarquardt:
    return LevenbergMarquardt(
        Stopping(tolerance=1e-9, decrease=1e-2, patience=2, max_iterations=12), damping=1e-8, ahead=True, reuse=0.01
    )


SOON = 4  # iterations in which nearly all members are solved


@dataclass(frozen=True)
class Restart:
    """How a family is solved anew.

    segmentation: size of the segments, about how many there are, and ‖r‖ above which a member is not solved.
    """

    segmentation: Segmentation = field(default_factory=lambda: Segmentation(n_segments=4))
    optimizer: LevenbergMarquardt = field(default_factory=_warm)


@dataclass(frozen=True, eq=False)
class Family:
    """B trajectories with the same A arcs: one collocation, whose starting knots and times differ, and ξ (B, N)."""

    collocation: Collocation
    xi: Tensor

    @classmethod
    def of(cls, curve: Curve) -> Family:
        """The family of one, from a curve on arcs.

        Raises:
            ValueError: a smoothed curve.
        """
        if curve.smoothing:
            raise ValueError(
                f"smoothing = {curve.smoothing:g}; allowed: a split or an unbounded control, whose arcs are known"
            )
        made = curve.collocation
        batched = replace(made, known_knots=made.known_knots[None], known_times=made.known_times[None])
        return cls(batched, curve.xi[None])

    def __len__(self) -> int:
        return len(self.xi)

    def __getitem__(self, members: Tensor) -> Family:
        """Some of the members (B',), by index or mask; of a family of one, as many copies as asked for."""
        made = self.collocation
        chosen = replace(made, known_knots=made.known_knots[members], known_times=made.known_times[members])
        return Family(chosen, self.xi[members])

    def curve(self, member: int) -> Curve:
        made = self.collocation
        alone = replace(made, known_knots=made.known_knots[member], known_times=made.known_times[member])
        return Curve(alone, self.xi[member])

    @cached_property
    def unknowns(self) -> Unknowns:
        return self.collocation.unpack(self.xi)

    @property
    def arc_knots(self) -> list[int]:
        """Knots at which arcs begin and end, A + 1 of them."""
        return [0, *self.collocation.switch_knots, self.collocation.n_segments]

    @property
    def n_arcs(self) -> int:
        return len(self.arc_knots) - 1

    @cached_property
    def arc_times(self) -> Tensor:
        """Scaled times (B, A + 1) at which arcs begin and end, on the clock of all."""
        return self.unknowns.times[:, self.arc_knots]

    def _at(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """w (B, m, 2n) at scaled times (B, m), and the segments (B, m); both ends are held."""
        unknowns = self.unknowns
        segment = torch.searchsorted(unknowns.times[:, 1:-1].contiguous(), t.contiguous(), right=True)
        inside = torch.minimum(torch.maximum(t, unknowns.times[:, :1]), unknowns.times[:, -1:])
        return self.collocation.along(unknowns, inside, segment), segment

    def __call__(self, t: Tensor) -> Tensor:
        """w (B, m, 2n) at scaled times (B, m)."""
        return self._at(t)[0]

    def control(self, t: Tensor) -> dict[str, Tensor]:
        """Control by name (B, m, ·) at scaled times (B, m), in the user's units."""
        w, segment = self._at(t)
        best = self._minimiser(t, w, self.collocation.setting.regime.arcs, segment)
        return {name: value.unflatten(0, t.shape) for name, value in best.control.items()}

    def _minimiser(self, t: Tensor, w: Tensor, arcs: Tensor | None, segment: Tensor) -> Minimiser:
        one = t.new_ones(t.numel(), 1)
        parameters = {name: value * one for name, value in self.collocation.setting.parameters.items()}
        regime = Regime(arcs=None if arcs is None else arcs[segment.flatten()])
        return self.collocation.bvp.minimiser(t.reshape(-1, 1), w.flatten(0, 1), Setting(regime, parameters))

    def disagreement(self, n_points: int = 15) -> Tensor:
        """How far S is on the wrong side of its arcs (B,), at points within every segment; 0 for a true extremal."""
        made, arcs = self.collocation, self.collocation.setting.regime.arcs
        if arcs is None:
            return self.xi.new_zeros(len(self))

        def depth() -> tuple[Tensor]:
            t, w, _ = made.on_each(made.unpack(self.xi), made.discretisation.nodes.between(n_points))
            segment = torch.arange(made.n_segments, device=t.device).repeat_interleave(t.shape[-1])
            t, w = t.flatten(1), w.flatten(1, 2)
            switching = self._minimiser(t, w, None, segment).switching
            wrong = wrong_side(switching, arcs[segment].repeat(len(self), 1), made.bvp.law.levels)
            return (wrong.clamp_min(0.0).view(len(self), -1).amax(-1),)

        return made.replayed(f"disagreement at {n_points}", depth, self.xi)[0]

    # -- the same arcs from elsewhere ----------------------------------------------------------------------------------

    def restart(
        self, states: Tensor, at: Tensor | float = 0.0, *, passed: int = 0, how: Restart | None = None
    ) -> tuple[Family, Tensor]:
        """The family from states (B, n) in the user's units at scaled times (B,), and who is solved (B,).

        ``passed`` arcs lie behind, the same number for all. A family of one is the neighbour of all. Solved means a
        small residual and S on the right side of every arc.

        Raises:
            ValueError: states whose shape does not fit, or no arc left.
        """
        how, bvp = how or Restart(), self.collocation.bvp
        if states.dim() != 2 or states.shape[-1] != bvp.n_states or len(self) not in (1, len(states)):
            raise ValueError(f"states have shape {tuple(states.shape)}; allowed: ({len(self)}, {bvp.n_states})")
        if not 0 <= passed < self.n_arcs:
            raise ValueError(f"passed = {passed}; allowed: 0 to {self.n_arcs - 1}, one arc has to be left")
        whole = self if len(self) == len(states) else self[torch.zeros(len(states), dtype=torch.long)]
        start = torch.as_tensor(at, dtype=self.xi.dtype, device=self.xi.device).expand(len(states))
        collocation = whole._ahead(states, start, passed, how.segmentation)
        if whole._lies_on(collocation):
            xi = whole.xi
        else:
            guess = collocation.unpack(project(collocation, whole))
            xi = collocation.pack(replace(guess, multipliers=whole.unknowns.multipliers))
        found, norm = Family(collocation, xi)._solved(how.optimizer)
        return found, (norm < how.segmentation.residual_tolerance) & (found.disagreement() < 1e-6)

    def _solved(self, optimizer: LevenbergMarquardt) -> tuple[Family, Tensor]:
        """The family with its equations solved as far as they go, and ‖r‖ (B,)."""
        rule, soon = optimizer.stopping, min(SOON, optimizer.stopping.max_iterations)
        first = replace(optimizer, stopping=replace(rule, max_iterations=soon))
        result = first.run(self.collocation, self.xi)
        xi, norm = result.xi, result.norm
        late = torch.tensor([status is Status.MAX_ITERATIONS for status in result.member_status], device=xi.device)
        if soon < rule.max_iterations and bool(late.any()):  # a few, that are not to keep the others
            again = optimizer.run(self[late].collocation, xi[late])
            xi, norm = xi.index_put((late,), again.xi), norm.index_put((late,), again.norm)
        return Family(self.collocation, xi), norm

    def _lies_on(self, other: Collocation) -> bool:
        """Whether the other collocation has the segments of this family, so that its unknowns mean the same."""
        mine, times = self.collocation, self.unknowns.times
        same = mine.discretisation is other.discretisation and mine.events == other.events
        return same and bool((times - other.known_times).abs().max() <= 1e-12 * times.abs().max())

    def _ahead(self, states: Tensor, start: Tensor, passed: int, segmentation: Segmentation) -> Collocation:
        """The arcs that lie ahead, cut into segments in the same way for all members."""
        made, bvp = self.collocation, self.collocation.bvp
        ends = torch.cat([start[:, None], self.arc_times[:, passed + 1 :]], -1)
        share = (ends.diff(dim=-1) / (ends[:, -1:] - ends[:, :1])).mean(0)
        counts = shared_out(share.tolist(), segmentation.n_segments)
        steps = [torch.arange(1, n + 1, dtype=ends.dtype, device=ends.device) / n for n in counts]
        cuts = [ends[:, i, None] + step * ends.diff(dim=-1)[:, i, None] for i, step in enumerate(steps)]
        times = torch.cat([ends[:, :1], *cuts], -1)
        events: list[tuple[int, ...] | None] = []
        for n, knot in zip(counts, [*self.arc_knots[passed + 1 : -1], None], strict=True):
            events += [None] * (n - 1) + ([made.events[knot - 1]] if knot is not None else [])
        regime, arcs = made.setting.regime, None
        if regime.arcs is not None:
            codes = regime.arcs[self.arc_knots[passed:-1]]
            arcs = torch.cat([codes[i : i + 1].expand(n, -1) for i, n in enumerate(counts)])
        disc = self._discretisation(segmentation)
        shared = Collocation.on_segments(
            disc, times[0], events=events, setting=replace(made.setting, regime=Regime(arcs=arcs))
        )
        knots = shared.known_knots.repeat(len(states), 1, 1)
        known = bvp.to_scaled(states, torch.zeros_like(states))[:, : bvp.n_states]
        given = ~torch.isnan(bvp.known_initial[: bvp.n_states])
        knots[:, 0, : bvp.n_states] = torch.where(given, known, torch.nan)
        return replace(shared, known_knots=knots, known_times=times)

    def _discretisation(self, segmentation: Segmentation) -> Discretisation:
        """The one of the family where it has the segmentation's size already: tables are kept from cycle to cycle."""
        disc = self.collocation.discretisation
        same = len(disc.nodes) == segmentation.n_nodes and disc.basis.size == segmentation.n_neurons
        return disc if same else segmentation.discretisation(disc.bvp)
