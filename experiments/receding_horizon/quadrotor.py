"""Planar quadrotor: costs, passes of quasi-linearisation and Newton's method, the paper's Tables 3 and 4."""

from __future__ import annotations

import torch
from torch import Tensor

from experiments.receding_horizon.common import RESULTS, Watched, chebyshev, flown
from experiments.tables import Report, markdown
from ponn_torch.guidance.closed_loop import Flight
from ponn_torch.guidance.plants.quadrotor import quadrotor
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.tracking import TrackingProblem
from ponn_torch.reporting.flight_figures import control_figure, tracking_figure
from ponn_torch.reporting.style import save

KNOWN = {  # Δx, κ: u0, J
    (-10.0, 1): ((18.07153, 16.68872), 32323.233),
    (-10.0, 10): ((18.37720, 16.42311), 29611.444),
    (10.0, 1): ((17.08160, -7.13546), 31124.343),
    (10.0, 10): ((17.62162, -7.08850), 28930.470),
}
TABLE_3 = {  # ε: e_J, e_x, e_λ, e_u
    1.0: (6.1e2, 1.5, 8.2e2, 5.5),
    1e-2: (1.1, 9.4e-4, 1.4, 5.0e-3),
    1e-4: (6.6e-3, 8.2e-6, 2.1e-2, 7.4e-5),
    1e-6: (5.5e-5, 5.2e-8, 2.4e-4, 5.9e-7),
    1e-8: (3.9e-7, 6.2e-10, 2.3e-6, 7.0e-9),
}
TABLE_4 = {  # κ: e_x, e_λ, e_u
    1: (2.6e2, 1.2e5, 2.6e2),
    5: (3.3e-1, 2.2e2, 6.4e-1),
    10: (3.0e-4, 2.7e-1, 4.7e-4),
    15: (3.4e-7, 3.5e-4, 5.4e-7),
    20: (1.1e-9, 7.6e-7, 1.3e-9),
}


def displaced(x: float) -> TrackingProblem:
    return quadrotor(displacement=(x, 0.0, 0.0, 0.0, 0.0, 0.0))


def run_costs() -> Report:
    rows, measured = [], {}
    ways = {
        "one pass": Passes(1),
        "quasi-linearisation": Passes(10, 1e-6),
        "warm-started": Passes(10, 1e-6, warm_start=True),
        "Newton": Passes(10, 1e-6, second_order=True),
        "Newton, warm-started": Passes(10, 1e-6, second_order=True, warm_start=True),
    }
    for x in (-10.0, 10.0):
        problem = displaced(x)
        for name, passes in ways.items():
            flight, _, seconds = flown(problem, chebyshev(), passes, "stop")
            cost, first = float(flight.cost), flight.controls[0]
            counts = flight.passes.double()
            rows.append(
                {
                    "Δx m": x,
                    "horizons by": name,
                    "u0": " ".join(f"{value:.5f}" for value in first.tolist()),
                    "J": f"{cost:.4f}",
                    "passes a cycle, mean": f"{counts.mean():.2f}",
                    "most": int(counts.max()),
                    "largest loss": f"{float(flight.loss.max()):.1e}",
                    "CPU ms a cycle": f"{1e3 * seconds / flight.n_cycles:.2f}",
                }
            )
            kappa = 1 if name == "one pass" else 10
            expected, known = KNOWN[x, kappa]
            if name in ("one pass", "quasi-linearisation"):
                key = f"costs/{x:g} kappa {kappa}"
                measured[f"{key} J error"] = abs(cost - known)
                measured[f"{key} u0 error"] = float((first - torch.tensor(expected, dtype=torch.float64)).abs().max())
            measured[f"costs/{x:g} {name} mean passes"] = float(counts.mean())
            if x < 0 and name == "Newton, warm-started":
                save(tracking_figure(flight), RESULTS / "quadrotor_tracking.png", dpi=90)
                save(control_figure(flight), RESULTS / "quadrotor_control.png", dpi=90)
        for name, second in (("newton", True), ("quasi-linearisation", False)):
            plan = Planner(problem, chebyshev(), Passes(40, 1e-10, second)).plan(0.0, problem.initial)
            measured[f"costs/{x:g} {name} passes to 1e-10"] = float(plan.passes)
            changes = " ".join(f"{float(change):.0e}" for change in plan.changes)
            rows.append(
                {"Δx m": x, "horizons by": f"{name}, first horizon to 1e-10: {plan.passes} passes", "u0": changes}
            )
    return Report({"costs": rows}, markdown(rows), measured)


def _trajectory(flight: Flight, watched: Watched) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cost of each horizon, states, costates at each start, controls."""
    cost = torch.stack([watched.planner.cost(plan) for plan in watched.plans])
    return cost, flight.states, torch.stack([plan.costates[0] for plan in watched.plans]), flight.controls


def run_tolerance() -> Report:
    """Table 3: norms of differences from the flight with ε = 1e-10."""
    problem = displaced(-10.0)
    flights = {e: _trajectory(*flown(problem, chebyshev(), Passes(60, e), "stop")[:2]) for e in (*TABLE_3, 1e-10)}
    rows, measured = [], {}
    for tolerance, known in TABLE_3.items():
        found = [float((a - b).norm()) for a, b in zip(flights[tolerance], flights[1e-10], strict=True)]
        names = ("J", "x", "λ", "u")
        row = {"ε": f"{tolerance:g}"}
        for name, value, paper in zip(names, found, known, strict=True):
            row |= {f"e_{name}": f"{value:.1e}", f"e_{name}, paper": f"{paper:.1e}"}
            ratio = max(value / paper, paper / value)
            measured[f"tolerance/{tolerance:g} {name} ratio"] = ratio
        rows.append(row)
    return Report({"tolerance": rows}, markdown(rows), measured)


def run_passes() -> Report:
    """Table 4: what the last of κ passes changed, at all nodes of all horizons; the largest norm of a component."""
    problem = displaced(-10.0)
    rows, measured = [], {}
    for kappa, known in TABLE_4.items():
        flight, watched, _ = flown(problem, chebyshev(), Passes(kappa, 1e-10), "stop")
        before = Planner(problem, chebyshev(), Passes(max(kappa - 1, 1), 1e-10), traced=True)
        changes: dict[str, list[Tensor]] = {"x": [], "λ": [], "u": []}
        for plan, state in zip(watched.plans, flight.measured, strict=True):
            if kappa == 1:  # before any pass there is the reference
                times = before.times(plan.points.new_tensor(plan.start), plan.points.new_tensor(plan.duration))
                x, u = problem.reference(times)
                earlier = x, torch.zeros_like(x), u
            else:
                last = before.plan(plan.start, state, plan.duration)
                earlier = last.states, last.costates, last.controls
            for name, now, then in zip(changes, (plan.states, plan.costates, plan.controls), earlier, strict=True):
                changes[name].append(now - then)
        row: dict[str, object] = {"κ": kappa}
        for (name, differences), paper in zip(changes.items(), known, strict=True):
            value = float(torch.cat(differences).norm(dim=0).max())
            row |= {f"e_{name}": f"{value:.1e}", f"e_{name}, paper": f"{paper:.1e}"}
            measured |= {
                f"passes/{kappa} {name}": value,
                f"passes/{kappa} {name} ratio": max(value / paper, paper / value),
            }
        rows.append(row)
    return Report({"passes": rows}, markdown(rows), measured)
