# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A fixed hidden layer or a trained one?
#
# The same constrained expressions wrap polynomials, an extreme learning machine (random hidden layer, only the output
# layer is solved for) and a network whose layers are all trained. The problem has boundary layers of width ε at both
# ends, where neurons have to be in the right place.

# %%
from IPython import get_ipython

if (shell := get_ipython()) is not None:
    shell.run_line_magic("matplotlib", "inline")  # figures are shown where they are made

# %%
import torch
from matplotlib.figure import Figure

from ponn_torch.ansatz.basis import Chebyshev, RandomFeatures
from ponn_torch.ansatz.networks import MLP, FrozenMLP
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.problems.boundary_layer import boundary_layer, exact_solution
from ponn_torch.solving.guess import RandomGuess, project
from ponn_torch.solving.solver import Solver

EPSILON = 0.02
problem = boundary_layer(epsilon=EPSILON)
bvp = pontryagin(problem)
t = torch.linspace(0.0, 1.0, 401, dtype=torch.float64)
exact = exact_solution(EPSILON, 1.0, 0.0, 1.0, t)

# %% [markdown]
# Every free function gets 20 features per unknown and the same nodes; only the network may move its neurons.

# %%
stopping = Stopping(tolerance=1e-11, decrease=1e-4, patience=8, max_iterations=150)
optimizer = LevenbergMarquardt(stopping, geodesic=True)  # the acceleration matters where all layers are trained
free_functions = {
    "Chebyshev": (Chebyshev(20), "columns"),
    "ELM tanh": (RandomFeatures(20, "tanh", seed=0), "orthonormal"),
    "network, untrained": (FrozenMLP([10, 20], seed=0), "orthonormal"),
    "network, trained": (MLP([10, 20], seed=0), "columns"),
}
found = {}
for name, (free_function, conditioning) in free_functions.items():
    solver = Solver(basis=free_function, n_nodes=120, conditioning=conditioning)
    ends = torch.tensor([0.0, bvp.final_time], dtype=torch.float64)
    residual = Collocation.on_segments(solver.discretisation(bvp), ends)
    result = optimizer.run(residual, project(residual, RandomGuess().curve(bvp, 0)))
    states, costates = bvp.to_physical(Curve(residual, result.xi)(t))
    error = (torch.cat([states, costates], -1) - exact).abs().amax(0)
    found[name] = (states, result)
    print(
        f"{name:20} {residual.n_unknowns:4d} unknowns  ‖r‖ = {float(result.norm):.1e}  "
        f"error of x {float(error[0]):.1e}, of y {float(error[1]):.1e}  {result.cpu_seconds:.2f} s"
    )

# %%
figure = Figure(figsize=(9.0, 3.2), layout="constrained")
left, right = figure.subplots(1, 2)
left.plot(t, exact[:, 1], color="0.8", lw=5, label="exact")
for name, (states, result) in found.items():
    left.plot(t, states[:, 1], label=name)
    right.loglog([r["seconds"] for r in result.records], [r["norm"] for r in result.records], label=name)
left.set(xlabel="t", ylabel="y, the fast state")
right.set(xlabel="CPU time (s)", ylabel="‖r‖")
right.legend()
figure

# %% [markdown]
# With as many features per unknown, training moves them to where they are needed: the network comes nearer than random
# features, at a price in time. Chebyshev polynomials crowd at both ends by themselves, and are nearer still. On other
# problems the answer differs; `experiments/` has them side by side. Where there are layers or jumps, cutting the domain
# into segments beats both: `experiment=boundary_layer` does it.
