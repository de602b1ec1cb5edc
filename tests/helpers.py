"""Lists for tests that cross everything with everything: optimisers, free functions, problems."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

import ponn_torch.problems
from ponn_torch.ansatz.basis import Chebyshev, FreeFunction, GaussianRBF, Legendre, LinearBasis, RandomFeatures
from ponn_torch.ansatz.networks import MLP, FrozenMLP
from ponn_torch.ansatz.switch_neurons import SwitchNeuronBasis
from ponn_torch.numerics.nodes import make_nodes
from ponn_torch.optim.base import Optimizer, Stopping
from ponn_torch.optim.chain import Chain
from ponn_torch.optim.gradient import Adam
from ponn_torch.optim.least_squares import GaussNewton, LevenbergMarquardt
from ponn_torch.optim.quasi_newton import LBFGS, SSBroyden
from ponn_torch.optim.scipy_least_squares import ScipyLeastSquares
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.discretisation import Discretisation, Form, Strong
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem

# -- optimisers ----------------------------------------------------------------------------------------------

OPTIMIZERS: dict[str, Callable[[Stopping], Optimizer]] = {
    "levenberg_marquardt": LevenbergMarquardt,
    "levenberg_marquardt_qr": lambda stopping: LevenbergMarquardt(stopping, linear_solver="qr"),
    "levenberg_marquardt_more": lambda stopping: LevenbergMarquardt(stopping, scaling="more"),
    "levenberg_marquardt_factor": lambda stopping: LevenbergMarquardt(stopping, update=4.0),
    "levenberg_marquardt_geodesic": lambda stopping: LevenbergMarquardt(stopping, geodesic=True),
    "gauss_newton": GaussNewton,
    "scipy_trf": lambda stopping: ScipyLeastSquares("trf", stopping),
    "scipy_lm": lambda stopping: ScipyLeastSquares("lm", stopping),
    "lbfgs": LBFGS,
    "ssbroyden": SSBroyden,
    "adam_lm": lambda stopping: Chain([Adam(replace(stopping, max_iterations=20)), LevenbergMarquardt(stopping)]),
}

# -- free functions ------------------------------------------------------------------------------------------

ANSATZES: dict[str, Callable[[int], LinearBasis]] = {
    "chebyshev": Chebyshev,
    "legendre": Legendre,
    "elm_tanh": lambda size: RandomFeatures(size, "tanh"),
    "elm_sin": lambda size: RandomFeatures(size, "sin"),
    "elm_sigmoid": lambda size: RandomFeatures(size, "sigmoid"),
    "elm_gaussian": lambda size: RandomFeatures(size, "gaussian"),
    "gaussian_rbf": lambda size: GaussianRBF(size, 0.25 * size),
    "frozen_mlp": lambda size: FrozenMLP((12, size)),
    "switch_neurons": lambda size: SwitchNeuronBasis(Chebyshev(size - 2), [-0.3, 0.4], [8.0, 20.0], [0, 1]),
}
NETWORKS: dict[str, Callable[[int], MLP]] = {
    "mlp": lambda size: MLP((8, size)),
    "mlp_sine": lambda size: MLP((8, size), "sin", adaptive_slope=True),
    "residual_mlp": lambda size: MLP((size, size), "gelu", residual=True),
    "fourier_mlp": lambda size: MLP((8, size), n_frequencies=2),
    "mlp_per_variable": lambda size: MLP((4, size), shared=False),
}

# -- problems ------------------------------------------------------------------------------------------------


def _problem_factories() -> dict[str, Callable[..., OptimalControlProblem]]:
    """Every function of ponn_torch.problems that makes a problem without arguments, by its name."""
    found: dict[str, Callable[..., OptimalControlProblem]] = {}
    for module_info in pkgutil.iter_modules(ponn_torch.problems.__path__):
        module = importlib.import_module(f"ponn_torch.problems.{module_info.name}")
        for name, function in inspect.getmembers(module, inspect.isfunction):
            if function.__module__ != module.__name__ or name.startswith("_"):
                continue
            returned = inspect.signature(function).return_annotation
            if returned in ("OptimalControlProblem", OptimalControlProblem):
                assert name not in found, f"two problems are called {name}"
                found[name] = function
    return found


PROBLEMS = _problem_factories()

TFC = {"free_final_time": True, "mass_flow_per_thrust": 5.0863e-4, "final_time": 40.0}
VARIANTS: dict[str, Callable[[], OptimalControlProblem]] = {
    "tfc_test_1": lambda: PROBLEMS["mars_landing"](
        initial_position=(-900.0, 100.0, 1500.0), initial_velocity=(30.0, -10.0, -70.0), **TFC
    ),
    "tfc_test_2": lambda: PROBLEMS["mars_landing"](initial_velocity=(85.0, 50.0, -65.0), **TFC),
    "small_body_point_mass": lambda: PROBLEMS["small_body_landing"](gravity_model="point_mass"),
}


@cache
def problem(name: str) -> OptimalControlProblem:
    """A problem of PROBLEMS or VARIANTS, made once."""
    return (PROBLEMS | VARIANTS)[name]()


PROBLEMS_WITH_ANSWERS = [name for name in [*PROBLEMS, *VARIANTS] if problem(name).known_cost is not None]


def mass_variables(name: str) -> list[str]:
    """The choices of mass variable that a problem allows."""
    return ["mass", "log_mass", "delta_v"] if problem(name).mass is not None else ["mass"]


@cache
def bvp_of(name: str, mass_variable: str = "auto") -> BoundaryValueProblem:
    return pontryagin(problem(name), mass_variable=mass_variable)


# -- small things --------------------------------------------------------------------------------------------


def random(*shape: int, seed: int = 0, low: float = 0.0, high: float = 1.0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def relative(found: Tensor, expected: Tensor) -> float:
    """Largest error over the largest expected entry."""
    return float((found - expected).abs().max() / expected.abs().max())


def collocation(
    bvp: BoundaryValueProblem,
    *,
    n_neurons: int = 6,
    n_nodes: int = 9,
    n_segments: int = 1,
    smoothing: float | None = None,
    form: Form | None = None,
    basis: Callable[[int], FreeFunction] = Chebyshev,
    kind: str = "legendre_gauss",
    conditioning: str = "columns",
) -> Collocation:
    """The residual of a problem on equal segments, at a smoothing where the law knows one."""
    nodes = make_nodes(kind, n_nodes, dtype=torch.float64)
    disc = Discretisation(bvp, basis(n_neurons), nodes, form or Strong(), conditioning)
    times = torch.linspace(0.0, 1.0, n_segments + 1, dtype=torch.float64) * bvp.final_time
    made = Collocation.on_segments(disc, times)
    if smoothing is not None and bvp.law.jumps:
        made = made.with_setting(smoothing=smoothing)
    return made
