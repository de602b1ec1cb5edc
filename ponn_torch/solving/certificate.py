"""The certificate: a solution flown by an integrator and held against the minimum principle.

*Converged* is what an optimiser says; *certified* is what this page says. The state–costate equations are
flown from the found start, and apart from that the control alone through the dynamics; the Hamiltonian, the
signs of the switching functions, transversality and the residual between nodes are held to tolerances. The law that
made the solution is no judge of itself: H is compared with its values at other admissible controls.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from ponn_torch.solving import checks, singular_arcs
from ponn_torch.solving.flight import control_history, fly_control, fly_extremal
from ponn_torch.solving.solution import Solution, in_a_row

SINGULAR_SHARE = 0.05  # of an arc over which |S| cannot be told from zero
KNOWN_COST_SLACK = 1e-6  # relative, above which an extremal is another than the known one


@dataclass(frozen=True)
class Tolerances:
    """What "certified" demands; scaled units.

    Attributes:
        end_error: boundary conditions, both flights.
        hamiltonian_drift: of H, less the integral of ∂H/∂t, relative to the largest Σ|terms of H|.
        off_node_residual: |ẇ − F| between the nodes, the segments' worst averaged over time.
        sign_violation: depth of S on the wrong side of zero.
        transversality: final costates of free states relative to the largest scaled |costate|, and the row of a free
            final time relative to the largest Σ|terms of H|.
        minimality: H above its value at other admissible controls, relative to the same.
    """

    end_error: float = 1e-9
    hamiltonian_drift: float = 1e-9
    off_node_residual: float = 1e-8
    sign_violation: float = 1e-9
    transversality: float = 1e-9
    minimality: float = 1e-9

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not value > 0:
                raise ValueError(f"tolerances.{item.name} = {value}; allowed: a positive number")


@dataclass(frozen=True)
class Certificate:
    """Measured errors of one solution, and the verdict on them.

    Attributes:
        end_error_scaled: states and costates flown; worst scaled component of the boundary conditions, and of
            the jumps where an error that grows too fast made the flight restart on the curve (``n_restarts``).
        end_errors: norms of the same per state, user units.
        control_end_error_scaled, control_end_errors: the same for the control alone.
        sign_violation: deepest S on the wrong side; None where no arcs are claimed.
        singular_share: largest share of a bang arc over which S is zero to tolerance; None without arcs.
        singular_violation: how far the control leaves its range on a singular arc, in ranges, infinite where the
            generalised Legendre–Clebsch condition fails; None without such arcs.
        transversality: worst |λ − φ_x − ψ_xᵀν| at the end, relative to the largest |λ|, both scaled.
        free_time: |H + ∂φ/∂t| at the end, relative to the largest Σ|terms of H|; None for a fixed final time.
        minimality: largest H(u*) − H(u) over samples u of the admissible set, relative to the same; None in
            certificates of before it was measured.
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
    n_restarts: int = 0
    minimality: float | None = None
    singular_violation: float | None = None
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
        again = f", {self.n_restarts} restarts" if self.n_restarts else ""
        checks = (
            (f"end error, states and costates flown{again}", self.end_error_scaled, t.end_error),
            ("end error, control alone flown", self.control_end_error_scaled, t.end_error),
            ("drift of the Hamiltonian", self.hamiltonian_drift, t.hamiltonian_drift),
            ("H above its minimum over the control", self.minimality, t.minimality),
            ("switching function on the wrong side", self.sign_violation, t.sign_violation),
            ("share of an arc with S = 0", self.singular_share, SINGULAR_SHARE),
            ("control past its bounds on a singular arc", self.singular_violation, t.sign_violation),
            ("residual between the nodes", self.off_node_residual, t.off_node_residual),
            ("transversality", self.transversality, t.transversality),
            ("free final time", self.free_time, t.transversality),
        )
        width = max(40, *(len(name) + 2 for name, _, _ in checks))
        lines = [f"{self.problem}: {self.verdict}", ""]
        lines.append(f"{'check (scaled)':<{width}}{'measured':>12}{'allowed':>12}")
        for name, value, allowed in checks:
            if value is not None:
                lines.append(f"{name:<{width}}{value:>12.2e}{allowed:>12.1e}{'' if value <= allowed else '  FAILS'}")
        lines.append("")
        for name, value in self.end_errors.items():
            alone = self.control_end_errors[name]
            lines.append(f"end error of {name} (user units): {value:.3e} flown, {alone:.3e} control alone")
        known = "" if self.cost_error is None else f", known optimum {self.known_cost:.10g} ({self.cost_error:+.3e})"
        lines.append(f"{self.cost_name}: {self.cost:.10g}, flown {self.flown_cost:.10g}{known}")
        lines.append(f"CPU time: {self.seconds:.2f} s")
        return "\n".join(lines)


def certify(solution: Solution, tolerances: Tolerances | None = None) -> Certificate:
    """Fly and check a solution; never raises for a bad one, whose certificate says what is wrong."""
    tolerances, began = tolerances or Tolerances(), time.process_time()
    durations = solution.curve.times.diff()
    if not bool(solution.curve.xi.isfinite().all() and (durations > 0).all()):
        return _refused(solution, tolerances)
    explicit_time = checks.depends_on_time(solution)
    history = control_history(solution)
    extremal = fly_extremal(solution, history, explicit_time=explicit_time)
    control = fly_control(solution, history)

    end_scaled, ends = checks.end_errors(solution, extremal)
    control_scaled, control_ends = checks.control_end_errors(solution, control)
    h, terms = checks.hamiltonian(solution, extremal)
    transversality, manifold, free_time = checks.terminal(solution, extremal, terms)
    sign, singular = checks.signs(solution, tolerances.sign_violation)
    flown_cost = checks.flown_cost(solution, control)
    known = solution.problem.known_cost
    measured: dict[str, Any] = {
        "end_error_scaled": max(end_scaled, manifold),
        "end_errors": ends,
        "control_end_error_scaled": control_scaled,
        "control_end_errors": control_ends,
        "hamiltonian_drift": checks.hamiltonian_drift(extremal, h, terms, explicit_time),
        "minimality": checks.minimality(solution, extremal, terms),
        "sign_violation": sign,
        "singular_share": singular,
        "singular_violation": singular_arcs.violation(solution.curve),
        "off_node_residual": solution.curve.mean_residual(),
        "transversality": transversality,
        "free_time": free_time,
        "cost": solution.cost,
        "flown_cost": flown_cost,
        "known_cost": known,
        "cost_error": None if known is None else flown_cost - known,
        "explicit_time": explicit_time,
        "n_restarts": len(extremal.jumps),
    }
    faults = checks.departures(solution) + _faults(measured, tolerances)
    faults += [flight.message for flight in (extremal, control) if not flight.arrived]
    return Certificate(
        certified=not faults,
        verdict=_verdict(solution, faults, measured["cost_error"]),
        problem=solution.problem.name,
        cost_name=solution.problem.cost_name,
        **measured,
        tolerances=tolerances,
        seconds=time.process_time() - began,
    )


# -- the verdict ---------------------------------------------------------------------------------------------


def _faults(measured: Mapping[str, Any], t: Tolerances) -> list[str]:
    limits = {
        "end_error_scaled": t.end_error,
        "control_end_error_scaled": t.end_error,
        "hamiltonian_drift": t.hamiltonian_drift,
        "minimality": t.minimality,
        "sign_violation": t.sign_violation,
        "singular_violation": t.sign_violation,
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
    if not math.isfinite(measured["cost"]):
        faults.append("the cost is not finite")
    return faults


def _refused(solution: Solution, tolerances: Tolerances) -> Certificate:
    """The certificate of what cannot be flown."""
    durations = solution.curve.times.diff()
    faults = [f"segment {k + 1} has no duration" for k in (~(durations > 0)).nonzero()[:, 0].tolist()]
    known, free = solution.problem.boundary("final"), solution.problem.free_final_time
    ends = {n: math.inf for n, s in solution.problem.slices.items() if any(v is not None for v in known[s])}
    return Certificate(
        certified=False,
        verdict=_verdict(solution, faults or ["its unknowns are not finite"]),
        problem=solution.problem.name,
        cost_name=solution.problem.cost_name,
        end_error_scaled=math.inf,
        end_errors=ends,
        control_end_error_scaled=math.inf,
        control_end_errors=dict(ends),
        hamiltonian_drift=math.inf,
        minimality=math.inf,
        sign_violation=math.inf if solution.kind == "split" else None,
        singular_share=0.0 if solution.kind == "split" else None,
        off_node_residual=math.inf,
        transversality=math.inf,
        free_time=math.inf if free else None,
        cost=math.inf,
        flown_cost=math.inf,
        known_cost=solution.problem.known_cost,
        cost_error=None if solution.problem.known_cost is None else math.inf,
        explicit_time=False,
        tolerances=tolerances,
    )


def _verdict(solution: Solution, faults: list[str], cost_error: float | None = None) -> str:
    if faults:
        return "NOT certified: " + "; ".join(faults)
    smoothing = "" if solution.smoothing is None else f"{solution.smoothing:g}"
    arcs = in_a_row(solution.arcs)
    other, known = "", None if solution.kind == "smoothed" else solution.problem.known_cost
    if known is not None and cost_error is not None and cost_error > KNOWN_COST_SLACK * abs(known):
        # necessary conditions do not tell extremals apart, the cost does
        other = f"; not the known optimum: it costs {cost_error:.3g} more"
    verdict = {
        "split": f"certified extremal with arcs {arcs}: the minimum principle holds on every arc",
        "smoothed": f"certified extremal of the regularised problem at smoothing {smoothing}",
        "smooth": "certified extremal: the minimum principle holds along the whole trajectory",
    }[solution.kind]
    return verdict + other


def _jsonable(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _jsonable(entry) for name, entry in value.items()}
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _number(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _number(entry) for name, entry in value.items()}
    return float(value) if value in ("inf", "-inf", "nan") else value
