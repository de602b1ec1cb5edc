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
# # Quick start
#
# State an optimal control problem, solve it by Pontryagin's conditions, fly the result, read the certificate.
# One call does it; the cells below take it apart.

# %%
from IPython import get_ipython

if (shell := get_ipython()) is not None:
    shell.run_line_magic("matplotlib", "inline")  # figures are shown where they are made

# %%
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.reporting.diagnostics import convergence_figure
from ponn_torch.reporting.figures import control_figure
from ponn_torch.solving.solver import Solver

result = Solver().solve(mars_landing(), seed=0)
print(result.certificate.to_text())

# %% [markdown]
# The certificate says what was measured and what was allowed: the found extremal was flown by an integrator, and apart
# from that its control alone. The thrust is at one of its bounds everywhere; the switching function S says at which.

# %%
control_figure(result.solution)

# %% [markdown]
# ## What was done
#
# A random start at smoothing ρ = 1, three sharper values of ρ, and the split: arcs between the zeros of S, whose times
# are unknowns. Every iteration left a record.

# %%
for stage in result.stages:
    told = f"{stage.n_iterations:3d} iterations  ‖r‖ = {stage.norm:.1e}  {stage.status.name}"
    print(f"{stage.name:7} ρ = {stage.smoothing}  {told}")
convergence_figure(result.stages)

# %% [markdown]
# ## The solution
#
# A solution is a function of time, in SI, with states, costates, control, S and H.

# %%
solution = result.solution
now = solution([0.0, solution.switch_times[0], solution.final_time])
print("mass, kg:", now.states["m"][:, 0].tolist())
print("switches, s:", solution.switch_times, solution.arcs)
print("fuel, kg:", solution.cost, "known:", solution.problem.known_cost)

# %% [markdown]
# ## Another optimiser on the same residual
#
# Levenberg–Marquardt and the gradient methods minimise the norm of one and the same residual. Here is its first stage.

# %%
import torch

from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.quasi_newton import LBFGS
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.solving.guess import RandomGuess, project

bvp = pontryagin(mars_landing())
times = torch.tensor([0.0, bvp.final_time], dtype=torch.float64)
residual = Collocation.on_segments(Solver(n_nodes=30).discretisation(bvp), times).with_setting(smoothing=1.0)
start = project(residual, RandomGuess().curve(bvp, 0))
for optimizer in (LevenbergMarquardt(Stopping(decrease=1e-3)), LBFGS(Stopping(decrease=1e-3, max_iterations=150))):
    found = optimizer.run(residual, start)
    told = f"‖r‖ = {float(found.norm):.1e} after {found.n_residuals} residuals: {found.status.value}"
    print(f"{type(optimizer).__name__:20} {told}")

# %% [markdown]
# ## A problem of your own
#
# Dynamics and cost are functions of named tensors; costates, transversality and the control law are derived. A double
# integrator moved by one unit in one unit of time with least effort has u = 6 − 12 t and costs 6.

# %%
from ponn_torch.optimal_control.control_laws import Unconstrained
from ponn_torch.optimal_control.problem import OptimalControlProblem

shift = OptimalControlProblem(
    name="shift",
    states={"x": 1, "v": 1},
    control=Unconstrained("force", 1),
    dynamics=lambda t, x, u, p: {"x": x.v, "v": u.force},
    running_cost=lambda t, x, u, p: 0.5 * u.force * u.force,
    initial={"x": 0.0, "v": 0.0},
    final={"x": 1.0, "v": 0.0},
    final_time=1.0,
)
moved = Solver().solve(shift)
print(moved.message, moved.solution.cost, moved.solution([0.0, 0.5, 1.0]).control["force"][:, 0].tolist())
