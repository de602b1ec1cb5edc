"""What a linearisation, a damped step and a whole solve cost, in CPU seconds on one thread and in ratios."""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch.func import jacfwd, jacrev

from experiments.benchmark.methods import methods
from experiments.benchmark.profile import iterations, neighbours
from experiments.benchmark.timing import WARM_UP, columns, cpu_times
from experiments.solves import PROBLEMS, row
from experiments.tables import Report, markdown, share, spread, write
from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.linearisation import linearise
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.solving.guess import project
from ponn_torch.solving.solver import Solver

FOLDER = Path(__file__).parent
SIZES = {"earth_mars": (70, 140), "mars_landing": (30, 120)}  # L, n of the PoNN paper, one segment
GOAL = 10.0  # jacrev over linearise


def linearisation(repeats: int) -> Report:
    """The same Jacobian at the same random start by three routes, then a damped step by two."""
    rows, lines = [], []
    for name in SIZES:
        times, line = _linearisation_of(name, repeats)
        rows += [
            {"problem": name, "what": key, "repeat": i, "cpu_s": value}
            for key, values in times.items()
            for i, value in enumerate(values)
        ]
        lines.append(line)
    text = f"{repeats} calls of each in turn; median [min, max].\n\n{markdown(columns(lines))}"
    return Report({"linearisation": rows}, text)


def _linearisation_of(name: str, repeats: int) -> tuple[dict[str, list[float]], dict[str, str]]:
    n_neurons, n_nodes = SIZES[name]
    solver = Solver(basis=Chebyshev(n_neurons), n_nodes=n_nodes)
    bvp = pontryagin(PROBLEMS[name]())
    ends = torch.tensor([0.0, bvp.final_time], dtype=torch.float64)
    residual = Collocation.on_segments(solver.discretisation(bvp), ends).with_setting(smoothing=1.0)
    xi = project(residual, solver.guess.curve(bvp, 0))
    r, jacobian = residual.linearise(xi)
    reference = jacrev(residual.residual)(xi)
    difference = float((jacobian.dense() - reference).abs().max() / reference.abs().max())
    scale, damping = jacobian.column_norms(), torch.tensor(1e-3, dtype=torch.float64)

    def step(method: str) -> torch.Tensor:
        # a copy each time: a Jacobian keeps its normal equations once they are formed
        return replace(jacobian).solve_damped(r, damping, scale, method)

    times = cpu_times(
        {
            "residual": lambda: residual.residual(xi),
            "linearise": lambda: linearise(residual, xi),
            "jacrev": lambda: jacrev(residual.residual)(xi),
            "jacfwd": lambda: jacfwd(residual.residual)(xi),
            "Cholesky step": lambda: step("cholesky"),
            "QR step": lambda: step("qr"),
        },
        repeats,
    )
    middle = {key: statistics.median(values) for key, values in times.items()}
    ratio = middle["jacrev"] / middle["linearise"]
    verdict = "met" if ratio >= GOAL else "MISSED"
    print(f"{name}: linearise is {ratio:.1f}× cheaper than jacrev (goal {GOAL:g}×: {verdict})", flush=True)
    line = {
        "one segment": name,
        "L / n": f"{n_neurons} / {n_nodes}",
        "Jacobian": "×".join(map(str, reference.shape)),
        **{f"{key}, ms": spread((1e3 * v for v in values), ".1f") for key, values in times.items()},
        "jacrev / linearise": f"{ratio:.1f}",
        "jacfwd / linearise": f"{middle['jacfwd'] / middle['linearise']:.1f}",
        "QR / Cholesky": f"{middle['QR step'] / middle['Cholesky step']:.1f}",
        "largest difference of the Jacobians, relative": f"{difference:.0e}",
    }
    return times, line


def solves(n_seeds: int) -> Report:
    """Random start → solution by the default solver, of a problem that was solved before; the certificate apart."""
    rows, lines = [], []
    for name, make in PROBLEMS.items():
        problem = make()
        for seed in range(WARM_UP):
            Solver().solve(problem, seed)
        mine = []
        for seed in range(n_seeds):
            found = row(problem, seed, Solver().solve(problem, seed))
            mine.append(found)
            times = f"{found['cpu_s']:.2f} s, certificate {found['certificate_s']:.2f} s"
            print(f"{name} seed {seed}: {times}", flush=True)
        rows += mine
        lines.append(
            {
                "problem": name,
                "certified": share(r["certified"] for r in mine),
                "starts": spread((r["starts"] for r in mine), ".0f"),
                "iterations": spread((r["iterations"] for r in mine), ".0f"),
                "residual evaluations": spread((r["residual_evaluations"] for r in mine), ".0f"),
                "linearisations": spread((r["linearisations"] for r in mine), ".0f"),
                "random start → solution, CPU s": spread((r["cpu_s"] for r in mine), ".2f"),
                "certificate, CPU s": spread((r["certificate_s"] for r in mine), ".2f"),
                "certificate / solution": spread((r["certificate_s"] / r["cpu_s"] for r in mine), ".1f"),
                "ms an iteration": spread((1e3 * r["cpu_s"] / r["iterations"] for r in mine), ".0f"),
                "off-node residual": spread((r["off_node_residual"] for r in mine), ".0e"),
                "fuel − known optimum, kg": spread((r["fuel_kg"] - problem.known_cost for r in mine), "+.0e"),
            }
        )
    text = f"Seeds 0–{n_seeds - 1}; median [min, max].\n\n{markdown(columns(lines))}"
    return Report({"solves": rows}, text)


PARTS: dict[str, tuple[Callable[[int], Report], str]] = {
    "linearisation": (linearisation, "repeats"),
    "iterations": (iterations, "repeats"),
    "solves": (solves, "seeds"),
    "neighbours": (neighbours, "repeats"),
    "methods": (methods, "seeds"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=15, help="calls of each routine (default 15)")
    parser.add_argument("--seeds", type=int, default=10, help="seeds 0 … SEEDS − 1 of the solves (default 10)")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    arguments = parser.parse_args()
    for name in ("repeats", "seeds"):
        if getattr(arguments, name) < 1:
            parser.error(f"--{name} {getattr(arguments, name)}; allowed: at least 1")
    torch.set_num_threads(1)
    for name in arguments.parts:
        run, counted = PARTS[name]
        report = run(getattr(arguments, counted))
        print(f"\n{report.summary}\n", flush=True)
        write(FOLDER, name, report)


if __name__ == "__main__":
    main()
