"""The same problems by other methods on the same core: direct collocation in two forms, and the papers' two loops."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from experiments.benchmark.timing import WARM_UP
from experiments.tables import Report, markdown, share, spread
from ponn_torch.baselines.direct import TwoStage, Unstructured
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.problems.earth_mars import earth_mars
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.problems.small_body_landing import small_body_landing
from ponn_torch.solving.paths import PolarTransfer
from ponn_torch.solving.solver import Solver
from ponn_torch.solving.two_loop import TwoLoop

Run = Callable[[OptimalControlProblem, int], dict[str, Any]]

_TFC: dict[str, Any] = {"mass_flow_per_thrust": 5.0863e-4, "free_final_time": True}
PROBLEMS: dict[str, Callable[[], OptimalControlProblem]] = {
    "earth_mars": earth_mars,
    "mars_landing": mars_landing,
    "tfc_test_1": lambda: mars_landing(
        initial_position=(-900.0, 100.0, 1500.0), initial_velocity=(30.0, -10.0, -70.0), **_TFC
    ),
    "tfc_test_2": lambda: mars_landing(initial_velocity=(85.0, 50.0, -65.0), **_TFC),
    "small_body_landing": small_body_landing,
}
# a straight line from Earth to Mars passes too near to the Sun to be a guess
FIRST: dict[str, Unstructured] = {"earth_mars": Unstructured(80, guess=PolarTransfer())}
STAGES: dict[str, int] = {"earth_mars": 20}  # segments of the second stage


def _unseen(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same, in a function that no solve before can have met."""

    def dynamics(*arguments: Any, new: object = object()) -> Any:
        return problem.dynamics(*arguments)

    return replace(problem, dynamics=dynamics)


def _indirect(solver: Solver, first: bool = False) -> Run:
    """Seeds of one problem; each the ``first`` of its kind, of which nothing is known from a solve before."""

    def run(problem: OptimalControlProblem, seed: int) -> dict[str, Any]:
        result = solver.solve(_unseen(problem) if first else problem, seed)
        refinement = [stage for stage in result.stages if stage.name != "smooth"]
        return {
            "solved": result.certified,
            "cpu_s": result.cpu_seconds,
            "refinement_s": sum(stage.cpu_seconds for stage in refinement),
            "refinement_iterations": sum(stage.n_iterations for stage in refinement),
            "cost": result.solution.cost if result.solution is not None else math.nan,
        }

    return run


def _direct(method: Unstructured | TwoStage) -> Run:
    def run(problem: OptimalControlProblem, seed: int) -> dict[str, Any]:
        answer = method.solve(problem)
        return {
            "solved": answer.solved,
            "cpu_s": answer.cpu_seconds,
            "build_s": answer.build_seconds,
            "cost": answer.cost,
        }

    return run


def _methods(name: str) -> Mapping[str, Run]:
    first = FIRST.get(name, Unstructured())
    return {
        "ponn-torch": _indirect(Solver()),
        "ponn-torch, first solve": _indirect(Solver(), first=True),
        "the same with two loops": _indirect(Solver(refinement=TwoLoop())),
        "CasADi unstructured": _direct(first),
        "CasADi two-stage": _direct(TwoStage(first, n_segments=STAGES.get(name, 8))),
    }


def methods(n_seeds: int) -> Report:
    """Seeds for the indirect methods, repetitions for the direct ones, one of each in turn."""
    rows: list[dict[str, Any]] = []
    lines: list[dict[str, str]] = []
    for name, make in PROBLEMS.items():
        problem, runs = make(), _methods(name)
        assert problem.known_cost is not None
        for label, run in runs.items():  # imports, and what ours records
            for seed in range(WARM_UP if label == "ponn-torch" else 1):
                run(problem, seed)
        for seed in range(n_seeds):
            for label, run in runs.items():
                found = {"problem": name, "method": label, "seed": seed, **run(problem, seed)}
                found["error"] = found["cost"] - problem.known_cost
                print(found, flush=True)
                rows.append(found)
        own = {label: [r for r in rows if r["problem"] == name and r["method"] == label] for label in runs}
        ours = statistics.median(r["cpu_s"] for r in own["ponn-torch"])
        for label, mine in own.items():
            lines.append(
                {
                    "problem": name,
                    "method": label,
                    "solved": share(r["solved"] for r in mine),
                    "CPU s": spread((r["cpu_s"] for r in mine), ".3f"),
                    "of ponn-torch": f"{statistics.median(r['cpu_s'] for r in mine) / ours:.2f}",
                    "refinement, CPU s": spread((r.get("refinement_s", math.nan) for r in mine), ".2f"),
                    "its iterations": spread((r.get("refinement_iterations", math.nan) for r in mine), ".0f"),
                    "building, CPU s": spread((r.get("build_s", math.nan) for r in mine), ".2f"),
                    "fuel − known, kg": spread((r["error"] for r in mine), "+.0e"),
                }
            )
    text = f"Seeds 0–{n_seeds - 1}, or as many repetitions; median [min, max].\n\n{markdown(lines)}"
    return Report({"methods": rows}, text)
