"""Where the time of an iteration goes, what linear algebra alone would take, and warm starts from a neighbour."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from experiments.benchmark.timing import columns, cpu_times
from experiments.solves import PROBLEMS
from experiments.tables import Report, markdown, share, spread
from ponn_torch.numerics.tape import RECORDING_PAYS
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.linearisation import linearise
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.solving.family import Family
from ponn_torch.solving.guess import project
from ponn_torch.solving.solver import Solver

SPREAD_M, SPREAD_M_S = 50.0, 5.0  # of the neighbours


def iterations(repeats: int) -> Report:
    """One iteration of Levenberg–Marquardt at the default sizes: a smoothed stage, and the split."""
    rows, lines = [], []
    for name, make in PROBLEMS.items():
        solver, problem = Solver(), make()
        bvp = pontryagin(problem)
        ends = torch.tensor([0.0, bvp.final_time], dtype=torch.float64)
        smoothed = Collocation.on_segments(solver.discretisation(bvp), ends).with_setting(smoothing=1.0)
        found = solver.solve(problem, 0).solution
        assert found is not None
        split = found.curve.collocation
        for stage, made, xi in (
            ("smoothed", smoothed, project(smoothed, solver.guess.curve(bvp, 0))),
            ("split", split, found.curve.xi),
        ):
            times = _pieces(made, xi, repeats)
            rows += [{"problem": name, "stage": stage, "what": k, "cpu_s": v} for k, vs in times.items() for v in vs]
            lines.append(_line(name, stage, made, times))
    text = f"{repeats} calls of each in turn; median [min, max], ms.\n\n{markdown(columns(lines))}"
    return Report({"iterations": rows}, text)


def _pieces(made: Collocation, xi: Tensor, repeats: int) -> dict[str, list[float]]:
    for _ in range(RECORDING_PAYS + 1):
        made.linearise(xi)
    r, jacobian = made.linearise(xi)
    k, rows, own = made.n_segments, made.discretisation.n_rows, made.discretisation.n_own
    block = torch.randn(k, rows, own + made.n_shared // k, generator=torch.Generator().manual_seed(0), dtype=xi.dtype)
    damping = torch.tensor(1e-3, dtype=xi.dtype)

    def step() -> Tensor:
        fresh = type(jacobian)(**{name: getattr(jacobian, name) for name in jacobian.__dataclass_fields__})
        return fresh.solve_damped(r, damping, fresh.column_norms())

    def floor() -> Tensor:
        normal = block.mT @ block
        normal.diagonal(dim1=-2, dim2=-1).add_(1.0)
        return torch.linalg.cholesky(normal)

    return cpu_times(
        {
            "residual": lambda: made._residual(xi),
            "linearise": lambda: linearise(made, xi),
            "linearise, from its tape": lambda: made.linearise(xi),
            "damped step": step,
            "normal equations and Cholesky alone": floor,
        },
        repeats,
    )


def _line(name: str, stage: str, made: Collocation, times: Mapping[str, list[float]]) -> dict[str, str]:
    middle = {key: statistics.median(values) for key, values in times.items()}
    first, later = (middle[key] + middle["damped step"] for key in ("linearise", "linearise, from its tape"))
    size = f"{made.n_segments} × {made.discretisation.n_rows}×{made.discretisation.n_own} + {made.n_shared}"
    return {
        "of": f"{name}, {stage}",
        "segments × own rows×unknowns + shared": size,
        **{key: spread((1e3 * v for v in values), ".2f") for key, values in times.items()},
        "an iteration": f"{1e3 * first:.1f}",
        "an iteration, from its tape": f"{1e3 * later:.1f}",
        "of which linear algebra": f"{middle['normal equations and Cholesky alone'] / later:.0%}",
    }


def neighbours(repeats: int) -> Report:
    """A landing solved from the solution of one that starts ±50 m and ±5 m/s from it, alone and together."""
    problem = mars_landing(
        initial_position=(-900.0, 100.0, 1500.0),
        initial_velocity=(30.0, -10.0, -70.0),
        mass_flow_per_thrust=5.0863e-4,
        free_final_time=True,
        final_time=45.0,
    )
    solution = Solver().solve(problem, 0).solution
    assert solution is not None
    start, generator = torch.tensor(problem.boundary("initial"), dtype=torch.float64), torch.Generator().manual_seed(0)
    family, _ = Family.of(solution.curve).restart(start[None])  # on the segments of its neighbours
    sizes = torch.tensor([SPREAD_M] * 3 + [SPREAD_M_S] * 3 + [0.0], dtype=torch.float64)

    def restart(count: int) -> Callable[[], Any]:
        def call() -> None:
            away = 2 * torch.rand(count, len(start), generator=generator, dtype=torch.float64) - 1
            solved[count] += family.restart(start + sizes * away)[1].tolist()

        return call

    counts = (1, 20, 200)
    solved: dict[int, list[bool]] = {count: [] for count in counts}
    for _ in range(RECORDING_PAYS):  # a controller's first cycles
        restart(1)()
    # not in turn: a batch of two hundred takes a controller's tables out of the caches
    times = {str(count): cpu_times({"restart": restart(count)}, repeats)["restart"] for count in counts}
    rows = [{"together": int(count), "cpu_s": value} for count, values in times.items() for value in values]
    lines = [
        {
            "together": str(count),
            "ms each": spread((1e3 * value / count for value in times[str(count)]), ".1f"),
            "solved with the same arcs": share(solved[count]),
        }
        for count in counts
    ]
    text = f"{repeats} restarts of each, other neighbours every time; median [min, max].\n\n{markdown(lines)}"
    return Report({"neighbours": rows}, text)
