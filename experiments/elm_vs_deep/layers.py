"""Boundary layers of width ε at both ends, which the exact solution resolves."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from experiments.elm_vs_deep import single
from experiments.elm_vs_deep.growth import ALL_WEIGHTS, PROJECTED, Growth
from experiments.elm_vs_deep.methods import CHEBYSHEV, ELM, FROZEN, MLP_LM, Method
from experiments.tables import Report, Row, markdown, worst
from ponn_torch.ansatz.basis import Chebyshev, RandomFeatures
from ponn_torch.ansatz.networks import MLP
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.pontryagin import pontryagin
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


# -- few unknowns ------------------------------------------------------------------------------------------------------

SIZES = (
    10,
    20,
)  # hidden units; a network has six unknowns for each of them, a linear function four for each of its own
GROWTHS = {
    "units drawn, hidden layer untrained": Growth(None, 1),
    "units chosen, hidden layer untrained": Growth(None),
    "units chosen, LM on all weights": Growth(ALL_WEIGHTS),
    "units chosen, variable projection": Growth(PROJECTED),
    "the same, smallest residual of three": Growth(PROJECTED, n_starts=3),
}
TRAINED = "units chosen, variable projection"


def _like(n_units: int) -> list[Method]:
    """Linear functions with as many unknowns as a network of so many units, and that network from the seed's slopes."""
    size = 3 * n_units // 2
    return [
        replace(CHEBYSHEV, name=f"Chebyshev, L = {size}", free_function=lambda seed: Chebyshev(size)),
        replace(ELM, name=f"ELM tanh, L = {size}", free_function=lambda seed: RandomFeatures(size, "tanh", seed=seed)),
        replace(MLP_LM, name="LM → output layer", free_function=lambda seed: MLP((n_units,), seed=seed)),
    ]


def run_few(seeds: range) -> Report:
    rows: list[Row] = []
    parts = []
    for epsilon in EPSILONS:
        bvp = pontryagin(boundary_layer(epsilon=epsilon))
        truth = exact(bvp, epsilon)
        for n_units in SIZES:
            mine: list[Row] = []
            for method in _like(n_units):
                for seed in method.seeds(seeds):
                    mine.append(single.run(bvp, method, seed, N_NODES, single.zero(bvp), truth))
            for name, growth in GROWTHS.items():
                for seed in seeds if growth.n_starts == 1 or n_units == SIZES[0] else ():
                    mine.append(single.measured(name, seed, *growth.run(bvp, n_units, seed), truth))
                    print(f"few {epsilon} {n_units} {name} {seed}: {mine[-1]['state_error']:.1e}", flush=True)
            rows += [{"epsilon": epsilon, "units": n_units, **row} for row in mine]
            parts.append(f"**ε = {epsilon:g}, {n_units} hidden units**\n\n{markdown(single.lines(mine))}")

    def errors(name: str, epsilon: float, n_units: int) -> list[float]:
        chosen = {"method": name, "epsilon": epsilon, "units": n_units}
        return [row["state_error"] for row in rows if chosen.items() <= row.items()]

    measured = {}
    for epsilon in EPSILONS:
        for n_units in SIZES:
            known = {row["method"] for row in rows if row["units"] == n_units} - {TRAINED}
            largest = worst(errors(TRAINED, epsilon, n_units))
            at = f"at {epsilon:g}, {n_units} units"
            measured[f"few/trained states {at}"] = largest
            for name in sorted(known):
                measured[f"few/{name} over trained {at}"] = min(errors(name, epsilon, n_units)) / largest
    best_of_three = errors(list(GROWTHS)[-1], EPSILONS[-1], SIZES[0])
    measured[f"few/best of three states at {EPSILONS[-1]:g}, {SIZES[0]} units"] = worst(best_of_three)
    text = f"Seeds {seeds[0]}–{seeds[-1]}; median [min, max].\n\n" + "\n\n".join(parts)
    return Report({"few": rows}, text, measured)


# -- many ------------------------------------------------------------------------------------------------------------


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
