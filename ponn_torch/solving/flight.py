"""A solution flown by DOP853, which knows nothing of its basis; begun anew exactly at the switches."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.integrate import DOP853
from torch import Tensor

from ponn_torch.numerics.autodiff import gradients
from ponn_torch.numerics.piecewise import PiecewiseChebyshev, approximate
from ponn_torch.numerics.tape import taped
from ponn_torch.optimal_control.boundary_value_problem import Setting
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.problem import Named
from ponn_torch.solving.growth import restarts
from ponn_torch.solving.solution import Solution

Array = NDArray[np.floating]
Rates = Callable[[float, Array, int], Array]  # (t, y, arc)

RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-13, 1e-15


@dataclass(frozen=True)
class Flight:
    """Accepted steps of a flight, with both sides of every restart.

    Attributes:
        t (m,), y (m, ·): scaled times and integrated values. arc (m,): index of the arc that each belongs to.
        arrived: the end was reached; ``message`` says why not.
        jumps: largest step from what was flown onto the given values, per restart.
    """

    t: Array
    y: Array
    arc: NDArray[np.integer]
    n_evaluations: int
    arrived: bool
    message: str = ""
    jumps: tuple[float, ...] = ()


def fly(
    rates: Rates,
    knots: list[float],
    start: Array,
    resolution: list[PiecewiseChebyshev],
    *,
    restarts: Sequence[tuple[float, Array]] = (),
    most_steps: int = 20000,
) -> Flight:
    """Integrate over the arcs between ``knots``, entering a panel of ``resolution`` by its length.

    The panels resolve the control, so that no thin layer of a smoothed switch lies between two stages unseen.
    ``restarts`` are times at which the first entries of y are put back to given values.
    """
    times, values, arcs, jumps, y = [], [], [], [], start
    n_evaluations, message, singular = 0, "", ""
    for arc, begin, end, given in _legs(knots, restarts):
        if given is not None:
            jumps.append(float(np.abs(y[: len(given)] - given).max()))
            y = np.concatenate([given, y[len(given) :]])
        edges = np.asarray(resolution[arc].edges)
        lengths = np.diff(edges)

        def reach(t: float, edges: Array = edges, lengths: Array = lengths) -> float:
            ahead = edges[1:] > t
            return float((np.maximum(edges[:-1] - t, 0.0) + lengths)[ahead].min()) if ahead.any() else np.inf

        def function(t: float, y: Array, arc: int = arc) -> Array:
            nonlocal singular
            try:
                return rates(t, y, arc)
            except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
                singular = str(error)
                return np.full_like(y, np.nan)  # a step too far: it is tried again, shorter

        times.append(begin)
        values.append(y)
        arcs.append(arc)
        with np.errstate(all="ignore"):
            solver = DOP853(
                function,
                begin,
                y,
                end,
                max_step=reach(begin),
                rtol=RELATIVE_TOLERANCE,
                atol=ABSOLUTE_TOLERANCE,
            )
            while solver.status == "running":
                if np.isnan(solver.h_abs):  # which SciPy would try to shrink for ever
                    message = "the rates are not finite"
                    break
                solver.max_step = reach(solver.t)
                message = solver.step() or ""
                if solver.status == "failed" or not np.isfinite(solver.y).all() or len(times) > most_steps:
                    break
                singular = ""
                times.append(solver.t)
                values.append(solver.y)
                arcs.append(arc)
        n_evaluations += solver.nfev
        if solver.status != "finished":
            reason = singular or message or "the states are not finite, or too many steps"
            message = f"the flight ended at {solver.t / knots[-1]:.3f} of the final time: {reason}"
            break
        y = solver.y
    return Flight(
        np.array(times),
        np.stack(values),
        np.array(arcs),
        n_evaluations,
        solver.status == "finished",
        message,
        tuple(jumps),
    )


def _legs(
    knots: list[float], restarts: Sequence[tuple[float, Array]]
) -> Iterator[tuple[int, float, float, Array | None]]:
    """(arc, begin, end, values to begin with or None) of every uninterrupted stretch."""
    for arc, (begin, end) in enumerate(pairwise(knots)):
        inside = [(t, w) for t, w in restarts if begin < t < end]
        starts: list[tuple[float, Array | None]] = [(begin, None), *inside]
        for (t, given), (after, _) in pairwise([*starts, (end, None)]):
            yield arc, t, after, given


# -- what is flown -------------------------------------------------------------------------------------------


def arc_knots(solution: Solution) -> list[float]:
    """Scaled times at which arcs begin, and the end."""
    times = solution.curve.times
    return times[[*(segments.start for segments in solution.arc_segments), -1]].tolist()


def control_history(solution: Solution) -> list[PiecewiseChebyshev]:
    """The solution's control over scaled time, per arc; all names side by side, in the user's units."""
    curve, knots = solution.curve, arc_knots(solution)

    def control(times: Tensor, segment: Tensor) -> Array:
        w, setting = solution.at(times, segment)
        best = solution.bvp.minimiser(times[:, None], w, setting)
        return torch.cat(list(best.control.values()), -1).double().cpu().numpy()

    def on(segments: range) -> Callable[[Array], Array]:
        def along(t: Array) -> Array:
            times = torch.as_tensor(t).to(curve.xi)
            return control(times, curve.segment_of(times).clamp(segments.start, segments.stop - 1))

        return along

    # sizes are of the whole: where a control is zero on an arc, its round-off is not to be resolved to the last digit
    middles = curve.xi.new_tensor([0.5 * (start + end) for start, end in pairwise(knots)])
    sizes = np.abs(control(middles, curve.segment_of(middles))).max(0)
    arcs = zip(solution.arc_segments, pairwise(knots), strict=True)
    return [approximate(on(segments), start, end, sizes=sizes) for segments, (start, end) in arcs]


def _point_setting(solution: Solution, smoothing: Tensor | None, arcs: Tensor | None) -> Setting:
    given = solution.curve.collocation.setting
    return Setting(
        Regime(None if given.regime.smoothing is None else smoothing, arcs if solution.kind == "split" else None),
        {name: value.double().cpu().reshape(1) for name, value in given.parameters.items()},
    )


def fly_extremal(solution: Solution, history: list[PiecewiseChebyshev], *, explicit_time: bool) -> Flight:
    """States and costates from the found start under the regime's law; y = (w, ∫L dt, ∫∂H/∂t dt).

    Where an error would grow beyond what float64 holds, the flight is put back onto the curve, and the jumps count.
    """
    bvp, given = solution.reference, solution.curve.collocation.setting.regime
    smoothing = torch.zeros(1, dtype=torch.float64) if given.smoothing is None else given.smoothing.double().cpu()
    codes = torch.zeros(1, 1, dtype=torch.long)
    if given.arcs is not None:
        codes = given.arcs[[segments.start for segments in solution.arc_segments]].cpu()

    def right_hand_side(t: Tensor, y: Tensor, arcs: Tensor) -> Tensor:
        setting = _point_setting(solution, smoothing.reshape(1), arcs)
        w = y[: bvp.dimension]
        pieces = [bvp.rates(t, w, setting), bvp.running_cost(t, w, setting)]
        if explicit_time:
            pieces.append(gradients(lambda time: bvp.hamiltonian(time, w, setting), t)[0])
        return torch.cat(pieces)

    start = solution.curve.knots[0].detach().double().cpu()
    y0 = torch.cat([start, start.new_zeros(1 + int(explicit_time))])
    t0 = y0.new_full((1,), 0.37 * float(solution.curve.times[-1]))
    flown = taped(right_hand_side, t0, y0, codes[0])

    def rates(t: float, y: Array, arc: int) -> Array:
        with torch.no_grad():  # a function that cannot be traced takes its slopes by autograd
            return flown(t0.new_tensor([t]), torch.from_numpy(y), codes[arc]).numpy()

    return fly(rates, arc_knots(solution), y0.numpy(), history, restarts=restarts(solution))


def fly_control(solution: Solution, history: list[PiecewiseChebyshev]) -> Flight:
    """States alone from the given start under the control as a function of time; y = (x/unit, ∫L dt)."""
    bvp, problem = solution.reference, solution.problem
    x0, _ = bvp.to_physical(solution.curve.knots[0].detach().double().cpu())
    known = problem.boundary("initial")
    x0 = torch.tensor([x if k is None else k for x, k in zip(x0.tolist(), known, strict=True)], dtype=torch.float64)
    sizes = list(bvp.law.names.values())
    p = Named(**_point_setting(solution, None, None).parameters)

    def right_hand_side(t: Tensor, y: Tensor, controls: Tensor) -> Tensor:
        state, time = problem.named(bvp.unit * y[: bvp.n_states]), t * bvp.time_unit
        u = Named(**dict(zip(bvp.law.names, controls.split(sizes, -1), strict=True)))
        rates = problem.stack(problem.dynamics(time, state, u, p), y[: bvp.n_states]) * (bvp.time_unit / bvp.unit)
        if problem.running_cost is None:
            return torch.cat([rates, torch.zeros_like(t)])
        return torch.cat([rates, problem.running_cost(time, state, u, p) * (bvp.time_unit / bvp.cost_unit)])

    y0 = torch.cat([x0 / bvp.unit, x0.new_zeros(1)])
    t0 = y0.new_full((1,), 0.37 * float(solution.curve.times[-1]))
    flown = taped(right_hand_side, t0, y0, torch.from_numpy(history[0](float(t0))))

    def rates(t: float, y: Array, arc: int) -> Array:
        with torch.inference_mode():
            return flown(t0.new_tensor([t]), torch.from_numpy(y), torch.from_numpy(history[arc](t))).numpy()

    return fly(rates, arc_knots(solution), y0.numpy(), history)
