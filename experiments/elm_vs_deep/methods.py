"""The rows of the study: free functions of comparable size, and what solves for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from ponn_torch.ansatz.basis import Chebyshev, FreeFunction, RandomFeatures
from ponn_torch.ansatz.networks import MLP, FrozenMLP
from ponn_torch.optim.base import Optimizer, Stopping
from ponn_torch.optim.chain import Chain, OutputLayer
from ponn_torch.optim.gradient import Adam
from ponn_torch.optim.least_squares import GaussNewton, LevenbergMarquardt
from ponn_torch.optim.quasi_newton import LBFGS, SSBroyden

BUDGET = 8.0  # CPU seconds of an iteration over all weights; none was chosen by looking at an error

# undamped steps last for the linear ones too: what damping holds back is not to be credited to training
LINEAR = Chain(
    [
        LevenbergMarquardt(Stopping(tolerance=1e-13, decrease=1e-2, patience=3), linear_solver="qr"),
        GaussNewton(),
    ]
)
LM_OUTPUT = Chain(
    [
        LevenbergMarquardt(
            Stopping(tolerance=1e-10, decrease=1e-2, patience=8, max_iterations=100, cpu_seconds=BUDGET),
            geodesic=True,
        ),
        OutputLayer(GaussNewton()),
    ]
)


# Adam's schedule needs its number of steps beforehand: about as many as fit into the budget
_STOPPING = Stopping(tolerance=1e-10, decrease=0.0, max_iterations=10**6, cpu_seconds=BUDGET)
FIRST_ORDER: dict[str, Optimizer] = {
    "Adam": Adam(stopping=replace(_STOPPING, max_iterations=300)),
    "L-BFGS": LBFGS(stopping=_STOPPING),
    "SSBroyden": SSBroyden(stopping=_STOPPING),
}


@dataclass(frozen=True)
class Method:
    """One row: a free function for a seed, how its table is conditioned, and its optimiser."""

    name: str
    free_function: Callable[[int], FreeFunction]
    optimizer: Optimizer
    conditioning: str = "columns"
    seeded: bool = True
    n_nodes: int | None = None  # where not those of the part

    def seeds(self, seeds: range) -> range:
        """One run of what no seed changes."""
        return seeds if self.seeded else seeds[:1]


HIDDEN = (20, 40)
CHEBYSHEV = Method("Chebyshev, L = 60", lambda seed: Chebyshev(60), LINEAR, seeded=False)
MANY_CHEBYSHEV = replace(CHEBYSHEV, name="Chebyshev, L = 186", free_function=lambda seed: Chebyshev(186), n_nodes=240)
ELM = Method("ELM tanh, L = 60", lambda seed: RandomFeatures(60, "tanh", seed=seed), LINEAR)
MLP_LM = Method("MLP 20-40, LM → output layer", lambda seed: MLP(HIDDEN, seed=seed), LM_OUTPUT)
FROZEN = Method("MLP 20-40, hidden layers untrained", lambda seed: FrozenMLP(HIDDEN, seed=seed), LINEAR)
MANY_ELM = replace(
    ELM, name="ELM tanh, L = 186", free_function=lambda s: RandomFeatures(186, "tanh", seed=s), n_nodes=240
)
FEW = (10, 20)  # the unknowns of an ELM of 60 units
FEW_LM = replace(MLP_LM, name="MLP 10-20, LM → output layer", free_function=lambda seed: MLP(FEW, seed=seed))
FEW_FROZEN = replace(FROZEN, name="MLP 10-20, hidden layers untrained", free_function=lambda s: FrozenMLP(FEW, seed=s))
