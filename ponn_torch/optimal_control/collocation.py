"""The collocation residual of a boundary value problem over K segments, and its arrow-shaped linearisation.

Segment k spans [t_k, t_{k+1}] with half length h and z ∈ [−1, 1]. A chain of q unknowns is one constrained
expression y whose value and derivatives below q at both ends come from a knot table of w (K+1, 2n), so that
y^(e) = h^−e (g + Ω(κ − C[g]))^(e) in time, where neither the free function g nor Ω depends on times or targets (PoNN
paper, eq. 20 and 54–65; K = 1 is its single domain). Per chain one equation is left: y^(q) = h^q F. Unknowns, in the
order of the vector ξ: the weights of every segment's free functions, the free knot entries, the free knot times, the
multipliers of a terminal manifold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import row_gradients
from ponn_torch.numerics.linalg import ArrowJacobian, DenseJacobian, Jacobian
from ponn_torch.numerics.tape import recordable
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.layout import Layout, Unknowns
from ponn_torch.optimal_control.linearisation import linearise
from ponn_torch.optimal_control.problem import nearest


@dataclass(frozen=True, eq=False)
class Collocation(Layout):
    """Residual r(ξ) of a discretisation on given knots; K segments, any leading batch axes on what varies."""

    @classmethod
    def on_segments(
        cls,
        discretisation: Discretisation,
        times: Tensor,
        *,
        setting: Setting | None = None,
        events: Sequence[Sequence[int] | None] | None = None,
    ) -> Collocation:
        """Segments between scaled ``times`` (K+1,), interior knot values unknown."""
        bvp = discretisation.bvp
        n_segments = times.shape[-1] - 1
        what = (None,) * (n_segments - 1) if events is None else (e if e is None else tuple(e) for e in events)
        knots = torch.full((n_segments + 1, bvp.dimension), torch.nan, dtype=times.dtype, device=times.device)
        knots[0], knots[-1] = bvp.known_initial, bvp.known_final
        setting = setting or Setting()
        missing = {k: times.new_tensor(v) for k, v in bvp.problem.parameters.items() if k not in setting.parameters}
        setting = replace(setting, parameters={**missing, **setting.parameters})
        return cls(discretisation, knots, times, setting, tuple(what))

    def with_setting(self, *, smoothing: float | Tensor | None = None, **parameters: float | Tensor) -> Collocation:
        """The same residual at another smoothing, fixed final time (s), or other values of named parameters.

        Raises:
            ValueError: a name that is no parameter, or the final time of a problem where it is unknown.
        """
        like, out = self.known_times, self
        regime, values = self.setting.regime, dict(self.setting.parameters)
        if smoothing is not None:
            regime = replace(regime, smoothing=torch.as_tensor(smoothing, dtype=like.dtype, device=like.device))
        for name, given in parameters.items():
            value = torch.as_tensor(given, dtype=like.dtype, device=like.device)
            if name in values:
                values[name] = value
            elif name == "final_time" and not self.bvp.problem.free_final_time:
                if not bool((value > 0).all()):
                    raise ValueError(f"final_time = {given} s; allowed: a positive number")
                stretch = value / self.bvp.time_unit / like[..., -1]
                out = replace(out, known_times=like * stretch.unsqueeze(-1))
            else:
                raise ValueError(f"no parameter {name!r}; {nearest(name, ['smoothing', 'final_time', *values])}")
        return replace(out, setting=Setting(regime, values))

    def value_of(self, parameter: str) -> float:
        """What ``with_setting`` sets: the smoothing, the final time (s), or a named parameter."""
        if parameter == "smoothing":
            return self.smoothing
        if parameter == "final_time":
            return float(self.known_times[-1]) * self.bvp.time_unit
        return float(self.setting.parameters.get(parameter, self.bvp.problem.parameters[parameter]))

    def departures(self) -> dict[str, tuple[float, float]]:
        """Parameters, and a fixed final time in s, that are not as the problem states them: name → (here, stated)."""
        problem = self.bvp.problem
        stated = dict(problem.parameters)
        if not problem.free_final_time:
            stated["final_time"] = problem.time_guess
        found = {name: (self.value_of(name), value) for name, value in stated.items()}
        round_off = 64 * torch.finfo(self.known_times.dtype).eps
        return {name: (a, b) for name, (a, b) in found.items() if abs(a - b) > round_off * abs(b)}

    # -- evaluation at the nodes -------------------------------------------------------------------------------------

    def kappas(self, unknowns: Unknowns, h: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Per group targets κ (..., K, d, 2q) in units of z, and the factors that made them from knot values."""
        kappas, factors = [], []
        knots = self.discretisation.ordered(unknowns.knots)
        for group in self.discretisation.groups:
            powers = torch.arange(group.order, dtype=h.dtype, device=h.device)
            factor = group.factors * h[..., None, None] ** powers
            factors.append(torch.cat([factor, factor], -1))
            values = group.of(knots).mT
            kappas.append(torch.cat([values[..., :-1, :, :], values[..., 1:, :, :]], -1) * factors[-1])
        return kappas, factors

    def jets(self, unknowns: Unknowns, h: Tensor) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Per group the derivatives in z (..., K, d, q+1, n), κ, and the factors of κ."""
        kappas, factors = self.kappas(unknowns, h)
        return self.discretisation.expressions.jets(unknowns.weights, kappas), kappas, factors

    def points(
        self, jets: Sequence[Tensor], times: Tensor, h: Tensor, z: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """(t (..., K, m, 1), w (..., K, m, 2n)) from the jets at z (m,) of every segment, by default the nodes."""
        pieces = []
        for group, jet in zip(self.discretisation.groups, jets, strict=True):
            pieces.append(jet[..., 0, :])
            for e in range(1, group.order):
                pieces.append(jet[..., e, :] / (h[..., None] ** e * group.factors[:, e])[..., None])
        t = times[..., :-1, None] + h[..., None] * ((self.discretisation.nodes.points if z is None else z) + 1.0)
        return t.unsqueeze(-1), self.discretisation.assemble(pieces)

    def on_each(self, unknowns: Unknowns, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """t (..., K, m), w and ẇ (..., K, m, 2n) at the same z (m,) of every segment."""
        disc, times = self.discretisation, unknowns.times
        h = (times[..., 1:] - times[..., :-1]) / 2
        jets = disc.expressions.jets_at(z, unknowns.weights, self.kappas(unknowns, h)[0])
        t, w = self.points(jets, times, h, z)
        per_length = 1.0 / h[..., None, None]
        rate = self.points([jet[..., 1:, :] * per_length[..., None] for jet in jets], times, h, z)[1]
        return t.squeeze(-1), w, rate

    def along(self, unknowns: Unknowns, t: Tensor, segment: Tensor) -> Tensor:
        """w (..., m, 2n) at scaled times (..., m), each on a given segment (..., m)."""
        batch, k = t.shape[:-1], self.n_segments
        h = (unknowns.times[..., 1:] - unknowns.times[..., :-1]) / 2
        kappas = [kappa.flatten(0, -3) for kappa in self.kappas(unknowns, h)[0]]
        start, half = unknowns.times[..., :-1].gather(-1, segment), h.gather(-1, segment)
        member = torch.arange(batch.numel(), device=t.device).view(*batch, 1)
        which, half = (segment + k * member).flatten(), half.flatten()
        z = (t.flatten() - start.flatten()) / half - 1.0
        jets = self.discretisation.expressions.jets_along(z, which, unknowns.weights.flatten(0, -2), kappas)
        pieces = []
        for group, jet in zip(self.discretisation.groups, jets, strict=True):
            pieces += [jet[:, e] / (half**e * group.factors[:, e, None]) for e in range(group.order)]
        return self.discretisation.assemble(pieces).view(*t.shape, -1)

    def point_setting(self, shape: Sequence[int]) -> Setting:
        """The setting spread over points of batch × segments × nodes shape, flattened."""
        regime = self.setting.regime

        def spread(value: Tensor) -> Tensor:
            return value[..., None, None].expand(shape).reshape(-1, 1)

        smoothing = None if regime.smoothing is None else spread(regime.smoothing)
        arcs = None
        if regime.arcs is not None:
            arcs = regime.arcs.unsqueeze(-2).expand(*shape, regime.arcs.shape[-1]).reshape(-1, regime.arcs.shape[-1])
        return Setting(Regime(smoothing, arcs), {k: spread(v) for k, v in self.setting.parameters.items()})

    def stretch(self, h: Tensor) -> Tensor:
        """Half lengths (..., K) relative to those of the first guess."""
        return 2 * h / (self.known_times[..., 1:] - self.known_times[..., :-1])

    def equations(self, jets: Sequence[Tensor], h: Tensor, rates: Tensor) -> Tensor:
        """Rows (..., K, n_rows): test functions applied to (y^(q) − h^q F) (h₀/h)^(q−1), h₀ the first guess of h.

        Without the last factor a segment that shrinks to nothing would let y^(q−1) jump at no residual, as if by a free
        impulse.
        """
        rows, rates = [], self.discretisation.ordered(rates)
        for group, jet in zip(self.discretisation.groups, jets, strict=True):
            pointwise = jet[..., -1, :]
            if not group.trivial:
                scale = h[..., None] ** group.order * group.factors[:, -1]
                pointwise = pointwise - scale[..., None] * group.of(rates)[..., -1, :].mT
            if group.order > 1 and len(self.free_times):
                pointwise = pointwise / self.stretch(h)[..., None, None] ** (group.order - 1)
            tested = pointwise @ group.test.mT if group.pointwise is None else pointwise * group.pointwise
            rows.append(tested.flatten(-2))
        return torch.cat(rows, -1)

    # -- the protocol of the optimisers --------------------------------------------------------------------------------

    def residual(self, xi: Tensor) -> Tensor:
        """r (..., R): the segments' equations, then switching rows S(t_k) = 0, then terminal rows."""
        return self.replayed("residual", lambda: (self._residual(xi),), xi)[0]

    def _residual(self, xi: Tensor) -> Tensor:
        unknowns = self.unpack(xi)
        h = (unknowns.times[..., 1:] - unknowns.times[..., :-1]) / 2
        jets, _, _ = self.jets(unknowns, h)
        t, w = self.points(jets, unknowns.times, h)
        rates = self.bvp.rates(t.reshape(-1, 1), w.reshape(-1, w.shape[-1]), self.point_setting(t.shape[:-1]))
        equations = self.equations(jets, h, rates.view(w.shape))
        return self.rows(equations, self._extra_rows(unknowns.knots, unknowns.times, unknowns.multipliers), h)

    def rows(self, equations: Tensor, extra: Tensor, h: Tensor) -> Tensor:
        """r (..., R) from the segments' equations (..., K, n_rows) and the extra rows (..., E)."""
        rows = torch.cat([equations.flatten(-2), extra], -1)
        # segments must keep their order: a step that turns one around is to be rejected
        return torch.where((h > 0).all(-1, keepdim=True), rows, torch.nan) if len(self.free_times) else rows

    def cost(self, xi: Tensor) -> Tensor:
        """Running cost (...,) by the nodes' quadrature plus terminal cost, in the user's units: quick, for progress."""
        return self.replayed("cost", lambda: (self._cost(xi),), xi)[0]

    def _cost(self, xi: Tensor) -> Tensor:
        bvp, unknowns = self.bvp, self.unpack(xi)
        h = (unknowns.times[..., 1:] - unknowns.times[..., :-1]) / 2
        t, w = self.points(self.jets(unknowns, h)[0], unknowns.times, h)
        setting = self.point_setting(t.shape[:-1])
        rate = bvp.running_cost(t.reshape(-1, 1), w.reshape(-1, w.shape[-1]), setting).view(t.shape[:-1])
        total = bvp.cost_unit * (h * (rate @ self.discretisation.nodes.weights)).sum(-1)
        end = Setting(parameters={k: v[..., None] for k, v in self.setting.parameters.items()})
        x = bvp.to_physical(unknowns.knots[..., -1, :])[0]
        return total + bvp.terminal_cost(unknowns.times[..., -1:], x, end)[..., 0]

    def linearise(self, xi: Tensor) -> tuple[Tensor, Jacobian]:
        """(r, J), exact; see linearisation.py. One segment has nothing to be eliminated: its J is one matrix."""

        def parts() -> tuple[Tensor, ...]:
            residual, arrow = linearise(self, xi)
            if self.n_segments == 1:
                return residual, arrow.dense()
            return residual, arrow.local, arrow.shared, arrow.extra

        residual, *blocks = self.replayed("linearise", parts, xi)
        if self.n_segments == 1:
            return residual, DenseJacobian(*blocks)
        local, shared, extra = blocks
        return residual, ArrowJacobian(local, shared, extra, self.shared_index)

    # -- playing it back ---------------------------------------------------------------------------------------------

    @cached_property
    def _varied(self) -> tuple[Tensor, ...]:
        """All data but ξ: collocations that differ in nothing else share their tapes."""
        regime = self.setting.regime
        data = (self.known_knots, self.known_times, self._fractions, regime.smoothing, regime.arcs)
        places = (self._anchors, self.free_times, self._switches) if len(self.free_times) else ()
        return tuple(x for x in (*data, *places, *self.setting.parameters.values()) if x is not None)

    @cached_property
    def _structure(self) -> tuple[object, ...]:
        """What a tape is good for."""
        events = tuple(event for event in self.events if event is not None)
        known = tuple(self.free_knots.tolist()), len(self.free_times), events
        regime = self.setting.regime.smoothing is None, self.setting.regime.arcs is None
        return (*known, *regime, *self.setting.parameters, *(tuple(x.shape) for x in self._varied))

    def replayed(self, name: str, function: Callable[[], tuple[Tensor, ...]], xi: Tensor) -> tuple[Tensor, ...]:
        """What the function of ξ and this collocation gives, from a tape where it has been asked for often."""
        if not recordable(xi, *self._varied):
            return function()
        replay = self.discretisation.replays[name, *self._structure, tuple(xi.shape)]
        return replay(function, xi, *self._varied)

    # -- rows that see knots, times and multipliers only -------------------------------------------------------------

    def _extra_rows(self, knots: Tensor, times: Tensor, multipliers: Tensor) -> Tensor:
        rows, switches = [], self._switches
        regime = self.setting.regime
        if len(switches):
            t, w = times.index_select(-1, switches).unsqueeze(-1), knots.index_select(-2, switches)
            parameters = {k: v[..., None, None].expand(t.shape) for k, v in self.setting.parameters.items()}
            switching = self.bvp.switching(t, w, Setting(Regime(), parameters))
            which, functions = zip(*self._vanishing, strict=True)
            rows.append(switching[..., which, functions])
        if self.bvp.n_terminal_rows:
            t, w = times[..., -1:], knots[..., -1, :]
            smoothing = None if regime.smoothing is None else regime.smoothing[..., None].expand(t.shape)
            arcs = None if regime.arcs is None else regime.arcs[..., -1, :].expand(*t.shape[:-1], -1)
            parameters = {k: v[..., None].expand(t.shape) for k, v in self.setting.parameters.items()}
            rows.append(self.bvp.terminal_rows(t, w, multipliers, Setting(Regime(smoothing, arcs), parameters)))
        return torch.cat(rows, -1) if rows else times[..., :0]

    def extra_linearised(self, unknowns: Unknowns) -> tuple[Tensor, Tensor]:
        """Extra rows (..., E) and their derivative with respect to the shared unknowns (..., E, G)."""
        knots, times, multipliers = unknowns.knots, unknowns.times, unknowns.multipliers
        batch = times.shape[:-1]
        if not self.n_extra:
            return times[..., :0], times.new_zeros(*batch, 0, self.n_shared)
        value, (by_knots, by_times, by_multipliers) = row_gradients(self._extra_rows, knots, times, multipliers)
        by_free = [
            by_knots.flatten(-2).index_select(-1, self.free_knots),
            by_times.index_select(-1, self.free_times),
            by_multipliers,
        ]
        return value, torch.cat(by_free, -1).movedim(0, -2).contiguous()

    def blocks(self, residual: Tensor) -> Mapping[str, Tensor]:
        """Norm of each equation (...,) by name, from r (..., R): the chains' last entries, switching, terminal."""
        disc, names = self.discretisation, component_names(self.bvp)
        k, rows = self.n_segments, disc.n_rows
        segments, extra = residual[..., : k * rows].unflatten(-1, (k, rows)), residual[..., k * rows :]
        out = {}
        for group in disc.groups:
            chains = segments[..., group.rows].unflatten(-1, (group.n_chains, -1))
            norms = chains.square().sum((-1, -3)).sqrt()
            for i, column in enumerate(group.columns[:, -1].tolist()):
                out[names[column]] = norms[..., i]
        n_switching = len(self._vanishing)
        if n_switching:
            out["switching"] = extra[..., :n_switching].norm(dim=-1)
        if self.bvp.n_terminal_rows:
            out["terminal"] = extra[..., n_switching:].norm(dim=-1)
        return out


def component_names(bvp: BoundaryValueProblem) -> list[str]:
    """Names of the columns of w: states, then costates with the prefix lambda_."""
    states = bvp.problem.component_names
    return [*states, *(f"lambda_{name}" for name in states)]


def equation_names(disc: Discretisation) -> list[str]:
    """Names of the equations of a single domain, as its ``blocks`` have them."""
    names, columns = component_names(disc.bvp), torch.cat([group.columns[:, -1] for group in disc.groups])
    return [*(names[column] for column in columns.tolist()), *(["terminal"] if disc.bvp.n_terminal_rows else [])]
