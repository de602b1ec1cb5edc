"""What a certificate measures: a flight, or the curve, against one condition of the principle each."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from ponn_torch.numerics.autodiff import gradients
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.control_set import INTERIOR, Regime
from ponn_torch.solving.flight import Flight, arc_knots
from ponn_torch.solving.solution import Solution
from ponn_torch.solving.switching import wrong_side


def _last(solution: Solution, flight: Flight) -> tuple[Tensor, Tensor, Setting]:
    """(t (1, 1), y (1, ·), setting) at the end of a flight; NaN if it did not arrive."""
    y = torch.from_numpy(flight.y[-1:].copy())
    if not flight.arrived:
        y = torch.full_like(y, torch.nan)
    return torch.tensor([[flight.t[-1]]]), y, _settings(solution, _segments(solution, flight)[-1:])


def _segments(solution: Solution, flight: Flight) -> Tensor:
    """A segment of its arc for every step."""
    first = torch.tensor([segments.start for segments in solution.arc_segments], device=solution.curve.xi.device)
    return first[torch.from_numpy(flight.arc).to(first.device)]


def _settings(solution: Solution, segment: Tensor) -> Setting:
    """The curve's setting at points of the given segments, in float64 on the CPU."""
    setting = solution.curve.setting(segment)
    smoothing, arcs = setting.regime.smoothing, setting.regime.arcs
    return Setting(
        Regime(None if smoothing is None else smoothing.double().cpu(), None if arcs is None else arcs.cpu()),
        {name: value.double().cpu() for name, value in setting.parameters.items()},
    )


def _worst(errors: Tensor) -> float:
    """Largest |error|, infinite where one is not a number; 0 of none."""
    return float(torch.nan_to_num(errors.abs(), nan=math.inf).max()) if errors.numel() else 0.0


def _by_state(solution: Solution, x: Tensor) -> dict[str, float]:
    """Norm of x − final per state with a known end, in user units."""
    errors = {}
    known = solution.problem.boundary("final")
    for name, where in solution.problem.slices.items():
        pairs = [(float(a), b) for a, b in zip(x[where], known[where], strict=True) if b is not None]
        if pairs:
            norm = math.sqrt(sum((a - b) ** 2 for a, b in pairs))
            errors[name] = math.inf if math.isnan(norm) else norm
    return errors


def departures(solution: Solution) -> list[str]:
    """What the curve solves in place of the problem as stated."""
    found = solution.curve.collocation.departures()
    return [f"{name} = {value:.10g} where the problem states {stated:.10g}" for name, (value, stated) in found.items()]


def end_errors(solution: Solution, flight: Flight) -> tuple[float, dict[str, float]]:
    """Boundary conditions of the flown extremal: worst scaled component, jumps among them; final norms per state."""
    bvp, n = solution.reference, solution.bvp.n_states
    w = _last(solution, flight)[1][0, : bvp.dimension]
    start = torch.from_numpy(flight.y[0, : bvp.dimension].copy())
    misses = []
    for value, known in ((start, bvp.known_initial), (w[:n], bvp.known_final[:n])):
        given = ~torch.isnan(known)
        misses.append((value - known)[given])
    misses.append(w.new_tensor(flight.jumps))
    return _worst(torch.cat(misses)), _by_state(solution, bvp.to_physical(w)[0])


def control_end_errors(solution: Solution, flight: Flight) -> tuple[float, dict[str, float]]:
    """Final conditions of the control flown alone: worst scaled component, norms per state."""
    bvp = solution.reference
    x = bvp.unit * _last(solution, flight)[1][0, : bvp.n_states]
    known = x.new_tensor([math.nan if v is None else v for v in solution.problem.boundary("final")])
    given = ~torch.isnan(known)
    return _worst(((x - known) / bvp.unit)[given]), _by_state(solution, x)


def _relative(error: float, size: float) -> float:
    """error / size; 0 where there is no error, infinite where there is no finite quotient."""
    if error == 0.0:
        return 0.0
    return error / size if size > 0 and math.isfinite(error / size) else math.inf


def terminal(solution: Solution, flight: Flight, terms: float) -> tuple[float, float, float | None]:
    """(transversality, manifold, free time) at the end of the flown extremal.

    Relative to the largest scaled |costate|, scaled, and relative to the largest Σ|terms of H|: costs of another size
    ask for the same digits.
    """
    bvp, n = solution.reference, solution.bvp.n_states
    if not flight.arrived:
        return math.inf, math.inf, math.inf if solution.problem.free_final_time else None
    t, y, setting = _last(solution, flight)
    w = y[:, : bvp.dimension]
    known = bvp.known_final[n:]
    costates = (w[0, n:] - known)[~torch.isnan(known)]
    multipliers = solution.curve.unknowns.multipliers.double().cpu()[None]
    rows = bvp.terminal_rows(t, w, multipliers, setting)[0]
    n_costates = len(bvp.terminal_components)
    n_manifold = n_costates + bvp.n_multipliers
    free_time = _relative(_worst(rows[n_manifold:]), terms) if solution.problem.free_final_time else None
    transversality = _relative(_worst(torch.cat([costates, rows[:n_costates]])), _largest_costate(solution, flight))
    return transversality, _worst(rows[n_costates:n_manifold]), free_time


def _largest_costate(solution: Solution, flight: Flight) -> float:
    n = solution.bvp.n_states
    return float(abs(flight.y[:, n : 2 * n]).max())


def flown_cost(solution: Solution, flight: Flight) -> float:
    """Cost of the control flown alone, user units; NaN if it did not arrive."""
    bvp = solution.reference
    t, y, setting = _last(solution, flight)
    return bvp.cost_unit * float(y[0, -1]) + float(bvp.terminal_cost(t, bvp.unit * y[:, : bvp.n_states], setting))


def _time_slope(solution: Solution, t: Tensor, w: Tensor, setting: Setting) -> Tensor:
    return gradients(lambda time: solution.reference.hamiltonian(time, w, setting), t)[0]


def depends_on_time(solution: Solution) -> bool:
    """H depends on time apart from the states: ∂H/∂t is not zero somewhere along the curve."""
    curve = solution.curve
    t = torch.linspace(float(curve.times[0]), float(curve.times[-1]), 33).to(curve.xi)
    segment = curve.segment_of(t)
    w, _ = solution.at(t, segment)
    setting = _settings(solution, segment)
    return bool((_time_slope(solution, t.double().cpu()[:, None], w.double().cpu(), setting) != 0).any())


def _flown(solution: Solution, flight: Flight, steps: Tensor | slice = slice(None)) -> tuple[Tensor, Tensor, Setting]:
    """(t (m, 1), w (m, 2n), setting) at steps of a flown extremal, by default at all of them."""
    t, w = torch.from_numpy(flight.t), torch.from_numpy(flight.y[:, : solution.bvp.dimension].copy())
    return t[steps, None], w[steps], _settings(solution, _segments(solution, flight)[steps])


def hamiltonian(solution: Solution, flight: Flight) -> tuple[Tensor, float]:
    """H (m, 1) along the flown extremal, and the largest Σ|terms of H|, which errors of H are held against."""
    bvp, n = solution.reference, solution.bvp.n_states
    t, w, setting = _flown(solution, flight)
    h = bvp.hamiltonian(t, w, setting)
    power = bvp.conjugate * w[:, n:] * bvp.rates(t, w, setting)[:, :n] / bvp.cost_unit
    cost = bvp.running_cost(t, w, setting)
    penalty = h - power.sum(-1, keepdim=True) - cost
    terms = power.abs().sum(-1, keepdim=True) + cost.abs() + penalty.abs()
    return h, float(terms.max())


def hamiltonian_drift(flight: Flight, h: Tensor, terms: float, explicit_time: bool) -> float:
    """(max − min of H − ∫∂H/∂t) / max Σ|terms of H| along the flown extremal."""
    if explicit_time:
        h = h - torch.from_numpy(flight.y[:, -1:])
    return _relative(float(h.max() - h.min()), terms)


def minimality(solution: Solution, flight: Flight, terms: float, n_points: int = 64) -> float:
    """Largest H(u*) − H(u) / max Σ|terms of H| over samples u of the admissible set, at steps of the flown extremal.

    u* is the control flown. H is the one that its regime minimises, taken from the problem's functions alone.
    """
    steps = torch.linspace(0, len(flight.t) - 1, n_points).round().long().unique()
    excess = float(solution.reference.excess(*_flown(solution, flight, steps)).max())
    return _relative(max(excess, 0.0), terms) if math.isfinite(excess) else math.inf


# -- signs of the switching functions ------------------------------------------------------------------------


def signs(solution: Solution, tolerance: float, n_points: int = 401) -> tuple[float | None, float | None]:
    """(deepest S on the wrong side, largest share of an arc with S = 0), refined at ends and peaks."""
    curve = solution.curve
    arcs = curve.collocation.setting.regime.arcs
    if arcs is None:
        return None, None
    options: dict[str, Any] = {"dtype": curve.xi.dtype, "device": curve.xi.device}
    levels, even = solution.bvp.law.levels, torch.linspace(-1.0, 1.0, n_points, **options)
    near = torch.logspace(-9, -2.3, 40, **options)
    fractions = torch.linspace(0.0, 1.0, 41, **options)
    grid = torch.cat([even, near - 1.0, 1.0 - near]).sort().values
    deepest, share = 0.0, 0.0
    for segments, (start, end) in zip(solution.arc_segments, pairwise(arc_knots(solution)), strict=True):
        codes = arcs[segments.start]

        def switching(z: Tensor, segments: range = segments, start: float = start, end: float = end) -> Tensor:
            t = start + (end - start) * (z + 1.0) / 2
            w, setting = solution.at(t, curve.segment_of(t).clamp(segments.start, segments.stop - 1))
            return solution.bvp.switching(t[:, None], w, setting)

        z = grid
        for _ in range(3):
            depth = wrong_side(switching(z), codes, levels)
            deepest = max(deepest, _worst(depth.clamp_min(0.0)))
            # a local maximum between grid points may reach further: look there again, closer
            rise = (depth[1:-1] >= depth[:-2]) & (depth[1:-1] >= depth[2:])
            peaks = rise.any(-1).nonzero()[:, 0] + 1
            if not len(peaks) or len(peaks) > 50:
                break
            left, right = z[peaks - 1], z[peaks + 1]
            z = (left[:, None] + (right - left)[:, None] * fractions).flatten().unique()
        if solution.bvp.law.jumps:
            zero = (switching(even[1:-1]).abs() <= tolerance).double().mean(0)
            for component, function in solution.bvp.law.jumping.items():
                if codes[component] != INTERIOR:  # S = 0 is singular, and has to be claimed as that
                    share = max(share, float(zero[function]))
    return deepest, share
