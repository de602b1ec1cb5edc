"""A smooth problem: the energy-optimal transfer, every method from the same polar guess."""

from __future__ import annotations

from collections.abc import Callable

import torch

from experiments.elm_vs_deep import single
from experiments.elm_vs_deep.methods import (
    CHEBYSHEV,
    ELM,
    FEW_FROZEN,
    FEW_LM,
    FIRST_ORDER,
    FROZEN,
    HIDDEN,
    LINEAR,
    LM_OUTPUT,
    MANY_CHEBYSHEV,
    MANY_ELM,
    MLP_LM,
    Method,
)
from experiments.tables import Report, Row, markdown, share, worst
from ponn_torch.ansatz.basis import Legendre
from ponn_torch.ansatz.networks import MLP
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.chain import OutputLayer
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.problems.energy_transfer import energy_transfer
from ponn_torch.solving.guess import ScaledCurve, project
from ponn_torch.solving.paths import PolarTransfer

_NETWORKS: dict[str, Callable[[int], MLP]] = {
    "MLP 20-40 of sines": lambda seed: MLP(HIDDEN, "sin", seed=seed),
    "residual MLP 32-32": lambda seed: MLP((32, 32), residual=True, seed=seed),
    "an MLP 8-16 per unknown": lambda seed: MLP((8, 16), shared=False, seed=seed),
}
OTHERS = [
    Method(f"{name}, {how}", network, optimizer)
    for name, network in _NETWORKS.items()
    for how, optimizer in (("LM → output layer", LM_OUTPUT), ("hidden layers untrained", OutputLayer(LINEAR)))
]
TRAINED = [
    Method(f"MLP 20-40, {name}", lambda seed: MLP(HIDDEN, seed=seed), optimizer)
    for name, optimizer in FIRST_ORDER.items()
]
# first at the sizes one would take, then with as many unknowns as the network, or a network with as many as the ELM
METHODS = [CHEBYSHEV, ELM, FROZEN, MLP_LM, MANY_CHEBYSHEV, MANY_ELM, FEW_FROZEN, FEW_LM]


def truth(bvp: BoundaryValueProblem, guess: ScaledCurve) -> Curve:
    """Legendre polynomials on eight segments, residual at round-off."""
    disc = Discretisation(bvp, Legendre(22), make_nodes("legendre_gauss", 30, dtype=bvp.unit.dtype))
    times = torch.linspace(0.0, bvp.final_time, 9, dtype=bvp.unit.dtype)
    residual = Collocation.on_segments(disc, times)
    stopping = Stopping(tolerance=1e-14, decrease=1e-3, max_iterations=100)
    curve = Curve(residual, LevenbergMarquardt(stopping).run(residual, project(residual, guess)).xi)
    if not curve.off_node_residual() < 1e-11:
        raise RuntimeError("the reference solution of energy_transfer was not found")
    return curve


def _rows(methods: list[Method], seeds: range) -> list[Row]:
    bvp = pontryagin(energy_transfer())
    guess = PolarTransfer().curve(bvp, 0)
    reference = truth(bvp, guess)
    known = bvp.problem.known_cost or float("nan")
    rows: list[Row] = []
    for method in methods:
        for seed in method.seeds(seeds):
            row = single.run(bvp, method, seed, 60 if method is not CHEBYSHEV else 90, guess, reference)
            row["known_extremal"] = abs(row["cost"] / known - 1) < 1e-3
            rows.append(row)
            print(f"transfer {method.name} seed {seed}: {row['state_error']:.1e} {row['cpu_s']:.1f} s", flush=True)
    return rows


def _summary(rows: list[Row], seeds: range) -> str:
    table = single.lines(rows, lambda mine: {"known extremal": share(row["known_extremal"] for row in mine)})
    return f"Seeds {seeds[0]}–{seeds[-1]}; median [min, max].\n\n{markdown(table)}"


def run_others(seeds: range) -> Report:
    rows = _rows([*OTHERS, *TRAINED], seeds)
    return Report({"networks": rows}, _summary(rows, seeds))


def run(seeds: range) -> Report:
    rows = _rows(METHODS, seeds)
    deep = [row for row in rows if row["method"] == MLP_LM.name]
    linear = [row for row in rows if row["method"] == CHEBYSHEV.name]
    measured = {
        "transfer/deep states": worst(row["state_error"] for row in deep),
        "transfer/deep costates": worst(row["costate_error"] for row in deep),
        "transfer/deep CPU s": worst(row["cpu_s"] for row in deep),
        "transfer/Chebyshev states": worst(row["state_error"] for row in linear),
        "transfer/Chebyshev costates": worst(row["costate_error"] for row in linear),
        "transfer/Chebyshev CPU s": worst(row["cpu_s"] for row in linear),
    }
    return Report({"transfer": rows}, _summary(rows, seeds), measured)
