"""Clohessy–Wiltshire: four horizons, the shortest that settles, the exact gain; integral action under a push."""

from __future__ import annotations

import torch

from experiments.receding_horizon.common import RESULTS, chebyshev, in_units
from experiments.tables import Report, markdown
from ponn_torch.guidance.accuracy import Allowed, by_exponential, certify
from ponn_torch.guidance.closed_loop import fly
from ponn_torch.guidance.controllers import gain_schedule, timetable
from ponn_torch.guidance.plants.clohessy_wiltshire import clohessy_wiltshire
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.reporting.flight_figures import accuracy_figure, tracking_figure
from ponn_torch.reporting.style import save

KNOWN = {  # T: distance at the end m, settling s, Δv m/s, J, u0 m/s²
    100.0: (4.285, 1220, 72.587, 2.324435e-3, (-0.265847, -0.322854, -0.210815)),
    125.0: (0.6095, 980, 80.069, 2.057846e-3, (-0.358569, -0.423271, -0.283159)),
    150.0: (0.1093, 840, 85.678, 1.941098e-3, (-0.440433, -0.513854, -0.348020)),
    300.0: (1.253e-3, 530, 97.028, 1.863574e-3, (-0.646216, -0.759947, -0.519050)),
}


def run() -> Report:
    rows, measured = [], {}
    for horizon in (50.0, 60.0, 65.0, 70.0, 80.0, *KNOWN):
        problem = clohessy_wiltshire(horizon=horizon)
        planner, table = Planner(problem, chebyshev(), Passes(1)), timetable(problem, "extend")
        flight = fly(problem, gain_schedule(planner, table), table, problem.initial)
        distance = in_units(flight.states, problem)[:, :3].norm(dim=-1)
        controls = in_units(flight.controls, problem, "controls")
        truth = by_exponential(planner, [0.0], [problem.horizon], problem.initial[None])[0]
        gain_error = float((flight.controls[0] - truth).norm() / truth.norm())
        settling = 10.0 * (int((distance > 0.01 * distance[0]).nonzero().max()) + 1)
        rough = float(distance[-1]) < 100.0
        row = {
            "T s": horizon,
            "distance at 2000 s, m": f"{float(distance[-1]):.4g}",
            "1 % settling, s": f"{settling:.0f}" if settling <= 2000 else "–",
            "within 100 m at the end": "yes" if rough else "no",
            "Δv m/s": f"{float(controls.norm(dim=-1).sum()) * 10:.3f}",
            "J": f"{float(flight.cost):.6e}",
            "u0 m/s²": " ".join(f"{value:.6f}" for value in controls[0].tolist()),
            "u0 against matrix exponential": f"{gain_error:.1e}",
            "largest loss": f"{float(flight.loss.max()):.1e}",
        }
        rows.append(row)
        measured[f"rendezvous/T {horizon:g} settles"] = float(rough)
        if horizon in KNOWN:
            end, when, speed, cost, first = KNOWN[horizon]
            expected = torch.tensor(first, dtype=torch.float64)
            errors = {
                "distance": abs(float(distance[-1]) / end - 1),
                "settling": abs(settling - when),
                "speed": abs(float(controls.norm(dim=-1).sum()) * 10 / speed - 1),
                "cost": abs(float(flight.cost) / cost - 1),
                "u0": float((controls[0] - expected).abs().max()),
                "gain": gain_error,
            }
            measured |= {f"rendezvous/T {horizon:g} {name} error": value for name, value in errors.items()}
        if horizon == 150.0:
            save(tracking_figure(flight), RESULTS / "rendezvous_tracking.png", dpi=90)
            found = certify(flight, planner, table, allowed=Allowed(oracle=1e-10))
            save(accuracy_figure(flight, found), RESULTS / "rendezvous_accuracy.png", dpi=90)
    return Report({"rendezvous": rows}, markdown(rows), measured)


def run_integral() -> Report:
    """Station keeping under a constant push that the model does not know, for a growing weight of the integrals."""
    rows, measured = [], {}
    for weight in (0.0, 1e3, 1e5, 1e7, 1e12):
        problem = clohessy_wiltshire(
            initial_position=(100.0, 50.0, 50.0),
            initial_velocity=(0.0, 0.0, 0.0),
            final_time=4000.0,
            integral_weight=weight,
            flown={"disturbance": [1e-3, -1e-3, 5e-4]},
        )
        planner, table = Planner(problem, chebyshev(), Passes(1)), timetable(problem, "extend")
        flight = fly(problem, gain_schedule(planner, table), table, problem.initial)
        distance = in_units(flight.states, problem)[:, :3].norm(dim=-1)
        last = 10.0 * (int((distance > 1.0).nonzero().max()) + 1)
        found = certify(flight, planner, table, n_samples=10, allowed=Allowed(oracle=1e-9))
        controls = in_units(flight.controls, problem, "controls")
        rows.append(
            {
                "weight": f"{weight:g}",
                "distance at 4000 s, m": f"{float(distance[-1]):.2e}",
                "within 1 m from, s": f"{last:.0f}" if last <= 4000 else "–",
                "Δv m/s": f"{float(controls.norm(dim=-1).sum()) * 10:.2f}",
                "u0 against matrix exponential": f"{found.largest_error:.1e}",
            }
        )
        measured |= {
            f"integral/weight {weight:g} distance": float(distance[-1]),
            f"integral/weight {weight:g} u0": found.largest_error,
        }
    return Report({"integral": rows}, markdown(rows), measured)
