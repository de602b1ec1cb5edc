"""The certificate: a solution flown by an integrator and held against the minimum principle.

*Converged* is what an optimiser says; *certified* is what this page says. The state–costate equations are flown from
the found start, and apart from that the control alone through the dynamics; the Hamiltonian, the signs of the
switching functions, transversality and the residual between the nodes are measured against stated tolerances.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import grad

from ponn_torch.optimal_control.control_laws import INTERIOR, UPPER, Regime
from ponn_torch.optimal_control.pontryagin import Setting
from ponn_torch.optimal_control.problem import Named
from ponn_torch.solving.flight import Flight, control_history, fly_control, fly_extremal
from ponn_torch.solving.solution import Solution

SINGULAR_SHARE = 0.05  # of an arc over which |S| cannot be told from zero


@dataclass(frozen=True)
class Tolerances:
    """What "certified" demands; scaled units.

    Attributes:
        end_error: boundary conditions, both flights.
        hamiltonian_drift: of H, less the integral of ∂H/∂t, relative to the largest Σ|terms of H|.
        off_node_residual: |ẇ − F| between the nodes.
        sign_violation: depth of S on the wrong side of zero.
        transversality: final costates of free states, and the row of a free final time.
    """

    end_error: float = 1e-9
    hamiltonian_drift: float = 1e-9
    off_node_residual: float = 1e-8
    sign_violation: float = 1e-9
    transversality: float = 1e-9

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not value > 0:
                raise ValueError(f"tolerances.{item.name} = {value}; allowed: a positive number")


@dataclass(frozen=True)
class Certificate:
    """Measured errors of one solution, and the verdict on them.

    Attributes:
        end_error_scaled, end_errors: state–costate flight; worst scaled component, and norms per state in user units.
        control_end_error_scaled, control_end_errors: the same for the control alone.
        sign_violation: deepest S on the wrong side; None where no arcs are claimed.
        singular_share: largest share of a bang arc over which S is zero to tolerance; None without arcs.
        free_time: |H + ∂φ/∂t| at the end, scaled; None for a fixed final time.
        cost, flown_cost, known_cost, cost_error: user units; cost_error = flown − known.
        explicit_time: H depends on time by itself; its drift is then measured against ∫ ∂H/∂t dt.
        seconds: CPU time.
    """

    certified: bool
    verdict: str
    problem: str
    cost_name: str
    end_error_scaled: float
    end_errors: dict[str, float]
    control_end_error_scaled: float
    control_end_errors: dict[str, float]
    hamiltonian_drift: float
    sign_violation: float | None
    singular_share: float | None
    off_node_residual: float
    transversality: float
    free_time: float | None
    cost: float
    flown_cost: float
    known_cost: float | None
    cost_error: float | None
    explicit_time: bool
    tolerances: Tolerances = field(default_factory=Tolerances)
    seconds: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """JSON types only; what is not finite becomes the string "inf" or "nan"."""
        return _jsonable(asdict(self))

    @classmethod
    def from_dict(cls, saved: Mapping[str, Any]) -> Certificate:
        """Inverse of ``to_dict``."""
        values = {name: _number(value) for name, value in saved.items() if name != "tolerances"}
        return cls(**values, tolerances=Tolerances(**saved["tolerances"]))

    def to_text(self) -> str:
        """A table of what was measured, what is allowed, and the verdict."""
        t = self.tolerances
        checks = (
            ("end error, states and costates flown", self.end_error_scaled, t.end_error),
            ("end error, control alone flown", self.control_end_error_scaled, t.end_error),
            ("drift of the Hamiltonian", self.hamiltonian_drift, t.hamiltonian_drift),
            ("switching function on the wrong side", self.sign_violation, t.sign_violation),
            ("share of an arc with S = 0", self.singular_share, SINGULAR_SHARE),
            ("residual between the nodes", self.off_node_residual, t.off_node_residual),
            ("transversality", self.transversality, t.transversality),
            ("free final time", self.free_time, t.transversality),
        )
        lines = [f"{self.problem}: {self.verdict}", ""]
        lines.append(f"{'check (scaled)':<40}{'measured':>12}{'allowed':>12}")
        for name, value, allowed in checks:
            if value is not None:
                lines.append(
                    f"{name:<40}{value:>12.2e}{allowed:>12.1e}{'' if value <= allowed else '  FAILS'}"
                )
        lines.append("")
        for name, value in self.end_errors.items():
            line = f"end error of {name} (user units): {value:.3e} flown, {self.control_end_errors[name]:.3e} control alone"
            lines.append(line)
        known = (
            ""
            if self.cost_error is None
            else f", known optimum {self.known_cost:.10g} ({self.cost_error:+.3e})"
        )
        lines.append(f"{self.cost_name}: {self.cost:.10g}, flown {self.flown_cost:.10g}{known}")
        lines.append(f"CPU time: {self.seconds:.2f} s")
        return "\n".join(lines)


def certify(solution: Solution, tolerances: Tolerances | None = None) -> Certificate:
    """Fly and check a solution; never raises for a bad one, whose certificate says what is wrong."""
    tolerances, began = tolerances or Tolerances(), time.process_time()
    explicit_time = _explicit_time(solution)
    history = control_history(solution)
    extremal = fly_extremal(solution, history, explicit_time=explicit_time)
    control = fly_control(solution, history)

    end_scaled, ends = _end_errors(solution, extremal)
    control_scaled, control_ends = _control_end_errors(solution, control)
    transversality, manifold, free_time = _terminal(solution, extremal)
    sign, singular = _signs(solution, tolerances.sign_violation)
    flown_cost = _flown_cost(solution, control)
    known = solution.problem.known_cost
    measured: dict[str, Any] = {
        "end_error_scaled": max(end_scaled, manifold),
        "end_errors": ends,
        "control_end_error_scaled": control_scaled,
        "control_end_errors": control_ends,
        "hamiltonian_drift": _hamiltonian_drift(solution, extremal, explicit_time),
        "sign_violation": sign,
        "singular_share": singular,
        "off_node_residual": solution.off_node_residual,
        "transversality": transversality,
        "free_time": free_time,
        "cost": solution.cost,
        "flown_cost": flown_cost,
        "known_cost": known,
        "cost_error": None if known is None else flown_cost - known,
        "explicit_time": explicit_time,
    }
    faults = _faults(solution, measured, tolerances)
    faults += [flight.message for flight in (extremal, control) if not flight.arrived]
    return Certificate(
        certified=not faults,
        verdict=_verdict(solution, faults),
        problem=solution.problem.name,
        cost_name=solution.problem.cost_name,
        **measured,
        tolerances=tolerances,
        seconds=time.process_time() - began,
    )


# -- the verdict -------------------------------------------------------------------------------------------------------


def _faults(solution: Solution, measured: Mapping[str, Any], t: Tolerances) -> list[str]:
    limits = {
        "end_error_scaled": t.end_error,
        "control_end_error_scaled": t.end_error,
        "hamiltonian_drift": t.hamiltonian_drift,
        "sign_violation": t.sign_violation,
        "off_node_residual": t.off_node_residual,
        "transversality": t.transversality,
        "free_time": t.transversality,
    }
    faults = [
        f"{name.replace('_', ' ')} {measured[name]:.1e} exceeds {limit:.0e}"
        for name, limit in limits.items()
        if measured[name] is not None and not measured[name] <= limit  # NaN fails
    ]
    if measured["singular_share"] is not None and measured["singular_share"] > SINGULAR_SHARE:
        faults.append("S vanishes over a stretch of an arc, which may be singular")
    durations = solution.curve.times.diff()
    faults += [f"arc {k + 1} has no duration" for k in (~(durations > 0)).nonzero()[:, 0].tolist()]
    if not math.isfinite(measured["cost"]):
        faults.append("the cost is not finite")
    return faults


def _verdict(solution: Solution, faults: list[str]) -> str:
    if faults:
        return "NOT certified: " + "; ".join(faults)
    smoothed = "" if solution.smoothing is None else f"{solution.smoothing:g}"
    return {
        "split": f"certified extremal with arcs {'-'.join(solution.arcs)}: the minimum principle holds on every arc",
        "smoothed": f"certified extremal of the regularised problem at smoothing {smoothed}",
        "smooth": "certified extremal: the minimum principle holds along the whole trajectory",
    }[solution.kind]


def _jsonable(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _jsonable(entry) for name, entry in value.items()}
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _number(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _number(entry) for name, entry in value.items()}
    return float(value) if value in ("inf", "-inf", "nan") else value


# -- what is measured --------------------------------------------------------------------------------------------------


def _last(solution: Solution, flight: Flight) -> tuple[Tensor, Tensor, Setting]:
    """(t (1, 1), y (1, ·), setting) at the end of a flight; NaN if it did not arrive."""
    y = torch.from_numpy(flight.y[-1:].copy())
    if not flight.arrived:
        y = torch.full_like(y, torch.nan)
    return torch.tensor([[flight.t[-1]]]), y, _settings(solution, flight.segment[-1:])


def _settings(solution: Solution, segment: np.ndarray) -> Setting:
    """The curve's setting at points of the given segments, in float64 on the CPU."""
    setting = solution.curve.setting(torch.as_tensor(segment, device=solution.curve.xi.device))
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


def _end_errors(solution: Solution, flight: Flight) -> tuple[float, dict[str, float]]:
    bvp, n = solution.reference, solution.bvp.n_states
    w = _last(solution, flight)[1][0, : bvp.dimension]
    start = torch.from_numpy(flight.y[0, : bvp.dimension].copy())
    misses = []
    for value, known in ((start, bvp.known_initial), (w[:n], bvp.known_final[:n])):
        given = ~torch.isnan(known)
        misses.append((value - known)[given])
    return _worst(torch.cat(misses)), _by_state(solution, bvp.to_physical(w)[0])


def _control_end_errors(solution: Solution, flight: Flight) -> tuple[float, dict[str, float]]:
    bvp = solution.reference
    x = bvp.unit * _last(solution, flight)[1][0, : bvp.n_states]
    known = x.new_tensor([math.nan if v is None else v for v in solution.problem.boundary("final")])
    given = ~torch.isnan(known)
    return _worst(((x - known) / bvp.unit)[given]), _by_state(solution, x)


def _terminal(solution: Solution, flight: Flight) -> tuple[float, float, float | None]:
    """(transversality, manifold, free time) at the end of the flown extremal, scaled."""
    bvp, n = solution.reference, solution.bvp.n_states
    t, y, setting = _last(solution, flight)
    w = y[:, : bvp.dimension]
    known = bvp.known_final[n:]
    costates = (w[0, n:] - known)[~torch.isnan(known)]
    multipliers = solution.curve.unknowns.multipliers.double().cpu()[None]
    rows = bvp.terminal_rows(t, w, multipliers, setting)[0]
    n_costates = len(bvp.terminal_components)
    n_manifold = n_costates + bvp.n_multipliers
    free_time = _worst(rows[n_manifold:]) if solution.problem.free_final_time else None
    return _worst(torch.cat([costates, rows[:n_costates]])), _worst(rows[n_costates:n_manifold]), free_time


def _flown_cost(solution: Solution, flight: Flight) -> float:
    bvp, problem = solution.reference, solution.problem
    t, y, setting = _last(solution, flight)
    cost = bvp.cost_unit * float(y[0, -1])
    if problem.terminal_cost is not None:
        state = problem.named(bvp.unit * y[:, : bvp.n_states])
        cost += float(problem.terminal_cost(t * bvp.time_unit, state, Named(**setting.parameters)))
    return cost


def _time_slope(solution: Solution, t: Tensor, w: Tensor, setting: Setting) -> Tensor:
    return grad(lambda time: solution.reference.hamiltonian(time, w, setting).sum())(t)


def _explicit_time(solution: Solution) -> bool:
    """H depends on time apart from the states: ∂H/∂t is not zero somewhere along the curve."""
    curve = solution.curve
    t = torch.linspace(float(curve.times[0]), float(curve.times[-1]), 33).to(curve.xi)
    segment = curve.segment_of(t)
    w, _ = solution.at(t, segment)
    setting = _settings(solution, segment.cpu().numpy())
    return bool((_time_slope(solution, t.double().cpu()[:, None], w.double().cpu(), setting) != 0).any())


def _hamiltonian_drift(solution: Solution, flight: Flight, explicit_time: bool) -> float:
    bvp, n = solution.reference, solution.bvp.n_states
    y = torch.from_numpy(flight.y)
    t, w = torch.from_numpy(flight.t)[:, None], y[:, : bvp.dimension]
    setting = _settings(solution, flight.segment)
    h = bvp.hamiltonian(t, w, setting)
    power = bvp.conjugate * w[:, n:] * bvp.rates(t, w, setting)[:, :n] / bvp.cost_unit
    cost = bvp.running_cost(t, w, setting)
    penalty = h - power.sum(-1, keepdim=True) - cost
    terms = power.abs().sum(-1, keepdim=True) + cost.abs() + penalty.abs()
    if explicit_time:
        h = h - y[:, -1:]
    drift = float((h.max() - h.min()) / terms.max())
    return drift if math.isfinite(drift) else math.inf


# -- signs of the switching functions -----------------------------------------------------------------------------------


def _depth(switching: Tensor, codes: Tensor) -> Tensor:
    """Distance (m, k) of S from the side that the codes claim, negative where it is on it.

    A convex H has one S at each bound: the control is off the lower bound where the first is positive, and at the upper
    where the second is.
    """
    levels = (UPPER,) if switching.shape[-1] == codes.shape[-1] else (INTERIOR, UPPER)
    parts = switching.chunk(len(levels), -1)
    signed = [torch.where(codes >= level, -s, s) for level, s in zip(levels, parts, strict=True)]
    return torch.stack(signed).amax(0)


def _signs(solution: Solution, tolerance: float, n_points: int = 401) -> tuple[float | None, float | None]:
    """(deepest S on the wrong side, largest share of an arc with S = 0), on a grid refined near ends and extrema."""
    curve = solution.curve
    arcs = curve.collocation.setting.regime.arcs
    if arcs is None:
        return None, None
    like = curve.xi
    even = torch.linspace(-1.0, 1.0, n_points).to(like)
    near = torch.logspace(-9, -2.3, 40).to(like)
    grid = torch.cat([even, near - 1.0, 1.0 - near]).sort().values
    deepest, share = 0.0, 0.0
    for k in range(curve.collocation.n_segments):

        def depth(z: Tensor, k: int = k) -> tuple[Tensor, Tensor]:
            t, w, _ = curve.on_segment(z, k)
            setting = curve.setting(torch.full((len(z),), k, device=z.device))
            switching = solution.bvp.switching(t[:, None], w, setting)
            return _depth(switching, setting.regime.arcs), switching

        z = grid
        for _ in range(3):
            here, _ = depth(z)
            deepest = max(deepest, _worst(here.clamp_min(0.0)))
            # a local maximum between grid points may reach further: look there again, closer
            rise = (here[1:-1] >= here[:-2]) & (here[1:-1] >= here[2:])
            peaks = rise.any(-1).nonzero()[:, 0] + 1
            if not len(peaks) or len(peaks) > 50:
                break
            fractions = torch.linspace(0.0, 1.0, 41).to(like)
            left, right = z[peaks - 1], z[peaks + 1]
            z = (left[:, None] + (right - left)[:, None] * fractions).flatten().unique()
        switching = depth(even[1:-1])[1]
        if (
            switching.shape[-1] == arcs.shape[-1]
        ):  # H is affine: an arc with S = 0, or inside the bounds, is singular
            zero = (switching.abs() <= tolerance).double().mean(0)
            zero = torch.where(arcs[k].to(zero.device) == INTERIOR, 1.0, zero)
            share = max(share, float(zero.max()))
    return deepest, share
