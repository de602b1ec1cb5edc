"""A solution flown by DOP853, which knows nothing of its basis; restarted exactly at the switches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.integrate import DOP853
from torch import Tensor
from torch.func import grad

from ponn_torch.numerics.piecewise import PiecewiseChebyshev, approximate
from ponn_torch.numerics.tracing import trace
from ponn_torch.optimal_control.control_laws import Regime
from ponn_torch.optimal_control.pontryagin import Setting
from ponn_torch.optimal_control.problem import Named
from ponn_torch.solving.solution import Solution

Array = NDArray[np.floating]
Rates = Callable[[float, Array, int], Array]  # (t, y, segment)

RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-13, 1e-15


@dataclass(frozen=True)
class Flight:
    """Accepted steps of a flight, with both sides of every restart.

    Attributes:
        t (m,), y (m, ·): scaled times and integrated values. segment (m,): where each belongs.
        arrived: the end was reached; ``message`` says why not.
    """

    t: Array
    y: Array
    segment: NDArray[np.integer]
    n_evaluations: int
    arrived: bool
    message: str = ""


def fly(
    rates: Rates,
    knots: list[float],
    start: Array,
    resolution: list[PiecewiseChebyshev],
    *,
    most_steps: int = 20000,
) -> Flight:
    """Integrate over the segments between ``knots``, entering a panel of ``resolution`` by its length.

    The panels resolve the control, so that no thin layer of a smoothed switch lies between two stages unseen.
    """
    times, values, segments, y = [], [], [], start
    n_evaluations, message = 0, ""
    for segment, (begin, end) in enumerate(pairwise(knots)):
        edges = np.asarray(resolution[segment].edges)
        lengths = np.diff(edges)

        def reach(t: float, edges: Array = edges, lengths: Array = lengths) -> float:
            ahead = edges[1:] > t
            return float((np.maximum(edges[:-1] - t, 0.0) + lengths)[ahead].min()) if ahead.any() else np.inf

        def function(t: float, y: Array, segment: int = segment) -> Array:
            return rates(t, y, segment)

        times.append(begin)
        values.append(y)
        segments.append(segment)
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
                solver.max_step = reach(solver.t)
                message = solver.step() or ""
                if solver.status == "failed" or not np.isfinite(solver.y).all() or len(times) > most_steps:
                    break
                times.append(solver.t)
                values.append(solver.y)
                segments.append(segment)
        n_evaluations += solver.nfev
        if solver.status != "finished":
            reason = message or "the states are not finite, or too many steps"
            message = f"the flight ended at {solver.t / knots[-1]:.3f} of the final time: {reason}"
            break
        y = solver.y
    return Flight(
        np.array(times),
        np.stack(values),
        np.array(segments),
        n_evaluations,
        solver.status == "finished",
        message,
    )


# -- what is flown -------------------------------------------------------------------------------------------


def control_history(solution: Solution) -> list[PiecewiseChebyshev]:
    """The solution's control over scaled time, per segment; all names side by side, in the user's units."""
    curve = solution.curve
    knots = curve.times.tolist()

    def on(segment: int) -> Callable[[Array], Array]:
        def control(t: Array) -> Array:
            times = torch.as_tensor(t).to(curve.xi)
            w, setting = solution.at(times, torch.full(times.shape, segment, device=times.device))
            best = solution.bvp.minimiser(times[:, None], w, setting)
            return torch.cat(list(best.control.values()), -1).double().cpu().numpy()

        return control

    if solution.kind == "split":
        return [approximate(on(k), knots[k], knots[k + 1]) for k in range(len(knots) - 1)]

    # fixed knots are no restarts: one history over all segments
    def control(t: Array) -> Array:
        index = curve.segment_of(torch.as_tensor(t).to(curve.xi)).cpu().numpy()
        first = on(0)(t[:1])
        out = np.empty((len(t), first.shape[-1]))
        for k in np.unique(index):
            out[index == k] = on(int(k))(t[index == k])
        return out

    return [approximate(control, knots[0], knots[-1], n_panels=16 * (len(knots) - 1))]


def _knots(solution: Solution) -> list[float]:
    knots = solution.curve.times.tolist()
    return knots if solution.kind == "split" else [knots[0], knots[-1]]


def _point_setting(solution: Solution, smoothing: Tensor | None, arcs: Tensor | None) -> Setting:
    given = solution.curve.collocation.setting
    return Setting(
        Regime(
            None if given.regime.smoothing is None else smoothing, arcs if solution.kind == "split" else None
        ),
        {name: value.double().cpu().reshape(1) for name, value in given.parameters.items()},
    )


def fly_extremal(solution: Solution, history: list[PiecewiseChebyshev], *, explicit_time: bool) -> Flight:
    """States and costates from the found start under the regime's law; y = (w, ∫L dt, ∫∂H/∂t dt)."""
    bvp, given = solution.reference, solution.curve.collocation.setting.regime
    smoothing = (
        torch.zeros(1, dtype=torch.float64) if given.smoothing is None else given.smoothing.double().cpu()
    )
    codes = torch.zeros(1, 1, dtype=torch.long) if given.arcs is None else given.arcs.cpu()

    def right_hand_side(t: Tensor, y: Tensor, arcs: Tensor) -> Tensor:
        setting = _point_setting(solution, smoothing.reshape(1), arcs)
        w = y[: bvp.dimension]
        pieces = [bvp.rates(t, w, setting), bvp.running_cost(t, w, setting)]
        if explicit_time:
            pieces.append(grad(lambda time: bvp.hamiltonian(time, w, setting).sum())(t))
        return torch.cat(pieces)

    start = solution.curve.knots[0].detach().double().cpu()
    y0 = torch.cat([start, start.new_zeros(1 + int(explicit_time))])
    t0 = y0.new_full((1,), 0.37 * float(solution.curve.times[-1]))
    graph = trace(right_hand_side, t0, y0, codes[0])

    def rates(t: float, y: Array, segment: int) -> Array:
        with torch.inference_mode():
            return graph(t0.new_tensor([t]), torch.from_numpy(y), codes[segment]).numpy()

    return fly(rates, _knots(solution), y0.numpy(), history)


def fly_control(solution: Solution, history: list[PiecewiseChebyshev]) -> Flight:
    """States alone from the given start under the control as a function of time; y = (x/unit, ∫L dt)."""
    bvp, problem = solution.reference, solution.problem
    x0, _ = bvp.to_physical(solution.curve.knots[0].detach().double().cpu())
    known = problem.boundary("initial")
    x0 = torch.tensor(
        [x if k is None else k for x, k in zip(x0.tolist(), known, strict=True)], dtype=torch.float64
    )
    sizes = list(bvp.law.names.values())
    p = Named(**_point_setting(solution, None, None).parameters)

    def right_hand_side(t: Tensor, y: Tensor, controls: Tensor) -> Tensor:
        state, time = problem.named(bvp.unit * y[: bvp.n_states]), t * bvp.time_unit
        u = Named(**dict(zip(bvp.law.names, controls.split(sizes, -1), strict=True)))
        rates = problem.stack(problem.dynamics(time, state, u, p), y[: bvp.n_states]) * (
            bvp.time_unit / bvp.unit
        )
        if problem.running_cost is None:
            return torch.cat([rates, torch.zeros_like(t)])
        return torch.cat([rates, problem.running_cost(time, state, u, p) * (bvp.time_unit / bvp.cost_unit)])

    y0 = torch.cat([x0 / bvp.unit, x0.new_zeros(1)])
    t0 = y0.new_full((1,), 0.37 * float(solution.curve.times[-1]))
    graph = trace(right_hand_side, t0, y0, torch.from_numpy(history[0](float(t0))))

    def rates(t: float, y: Array, segment: int) -> Array:
        with torch.inference_mode():
            return graph(
                t0.new_tensor([t]), torch.from_numpy(y), torch.from_numpy(history[segment](t))
            ).numpy()

    return fly(rates, _knots(solution), y0.numpy(), history)
