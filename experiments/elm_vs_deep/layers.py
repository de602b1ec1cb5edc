"""Boundary layers of width ε at both ends, which the exact solution resolves."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from experiments.elm_vs_deep import single
from experiments.elm_vs_deep.methods import CHEBYSHEV, ELM, FROZEN, MLP_LM, Method
from experiments.tables import Report, Row, markdown, worst
from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.optimal_control.pontryagin import BoundaryValueProblem, pontryagin
from ponn_torch.problems.boundary_layer import boundary_layer, exact_solution
from ponn_torch.solving.guess import ScaledCurve

EPSILONS = (0.02, 0.002)
N_NODES = 120
FINE = replace(CHEBYSHEV, name="Chebyshev, L = 110", free_function=lambda seed: Chebyshev(110))
WHITENED = [replace(method, conditioning="orthonormal") for method in (ELM, FROZEN)]
METHODS: list[Method] = [CHEBYSHEV, FINE, *WHITENED, MLP_LM]


def exact(bvp: BoundaryValueProblem, epsilon: float) -> ScaledCurve:
    def curve(t: Tensor) -> Tensor:
        w = exact_solution(epsilon, 1.0, 0.0, 1.0, t * bvp.time_unit)
        return bvp.to_scaled(w[:, :2], w[:, 2:])

    return curve


def run(seeds: range) -> Report:
    rows: list[Row] = []
    parts = []
    for epsilon in EPSILONS:
        bvp = pontryagin(boundary_layer(epsilon=epsilon))
        mine: list[Row] = []
        for method in METHODS:
            for seed in method.seeds(seeds):
                row = single.run(bvp, method, seed, N_NODES, single.zero(bvp), exact(bvp, epsilon))
                mine.append({"epsilon": epsilon, **row})
                print(f"layers {epsilon} {method.name} seed {seed}: {row['state_error']:.1e}", flush=True)
        rows += mine
        parts.append(f"**ε = {epsilon:g}**\n\n{markdown(single.lines(mine))}")
    found = {(row["method"], row["epsilon"]): row for row in rows if row["seed"] == seeds[0]}
    measured = {
        f"layers/{name} costates at {epsilon:g}": worst([found[name, epsilon]["costate_error"]])
        for name in (FINE.name, MLP_LM.name)
        for epsilon in EPSILONS
    }
    text = f"Seeds {seeds[0]}–{seeds[-1]}; median [min, max]; {N_NODES} nodes.\n\n" + "\n\n".join(parts)
    return Report({"layers": rows}, text, measured)
