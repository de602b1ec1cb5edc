"""Config → objects; what is wrong with a config is one line: the field, its value and what is allowed.

A node with ``_target_`` is a call of a class or function of this package, a node without one is the dataclass
that its place asks for. Nothing outside the package is called, except the problem that a user names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from ponn_torch.ansatz.basis import FreeFunction, LinearBasis
from ponn_torch.optim.base import Optimizer
from ponn_torch.optim.chain import Chain
from ponn_torch.optim.weighted import WeightedEquations, check_equations
from ponn_torch.optimal_control.collocation import equation_names
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem, nearest
from ponn_torch.optimal_control.references import load_problem
from ponn_torch.settings import (
    KINDS,
    ROOMS,
    ConfigError,
    arguments_of,
    call,
    fit,
    located,
    one_line,
    raised_here,
    reject_unknown,
    short,
    target,
    types_of,
    users_line,
    value_of,
)
from ponn_torch.solving.continuation import Ladder
from ponn_torch.solving.guess import STREAMS
from ponn_torch.solving.solver import Solver

DTYPES = {"float64": torch.float64, "float32": torch.float32}


@dataclass(frozen=True)
class Recording:
    """What a run leaves besides its records, solution and certificate.

    Attributes:
        progress: print while solving. tensorboard: event files, with small ``stage_figures`` of every stage.
        cost_every: iterations between evaluations of the cost, 0 for stage ends only.
        figures: PNG figures at the end.
        reference: folder of a saved solution; errors of states and costates against it are taken with the cost.
    """

    progress: bool = True
    tensorboard: bool = True
    stage_figures: bool = True
    cost_every: int = 10
    figures: bool = True
    reference: str | None = None

    def __post_init__(self) -> None:
        if self.cost_every < 0:
            raise ValueError(f"cost_every = {self.cost_every}; allowed: 0 (stage ends only) or more")


@dataclass(frozen=True)
class Plan:
    """All that a config (``settings``, resolved) asks for: solve ``problem`` by ``solver`` from ``seed``.

    notes: sentences on what is allowed and seldom meant.
    """

    name: str
    problem: OptimalControlProblem
    solver: Solver
    seed: int
    recording: Recording
    threads: int
    explain: bool
    settings: dict[str, Any]
    notes: Sequence[str] = ()


def build(config: DictConfig) -> Plan:
    """Build all objects of a solve, and the tables of its first stage, so that what clashes is told here.

    Raises:
        ConfigError: a misspelt, missing or impossible setting.
    """
    settings = resolved(config)
    node = dict(settings)
    top = _scalars(node)
    problem = build_problem(_section(node, "problem"))
    solver = _solver(node, top)
    recording = call(Recording, _section(node, "record"), "record")
    reject_unknown(node, [key for key in settings if key not in node], "")
    plan = Plan(top["name"], problem, solver, top["seed"], recording, top["threads"], top["explain"], settings)
    return replace(plan, notes=_notes(solver, _rehearse(plan)))


def resolved(config: DictConfig) -> dict[str, Any]:
    """The config as plain values, interpolations read out."""
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        missing = isinstance(error, MissingMandatoryValue)
        reason = "missing; a value is needed" if missing else one_line(str(error).partition("full_key")[0])
        raise ConfigError(f"{error.full_key}: {reason}") from error
    return {str(key): value for key, value in plain.items()} if isinstance(plain, dict) else {}


def build_problem(node: Mapping[str, Any]) -> OptimalControlProblem:
    """A problem of the package (``_target_``, arguments) or the user's (``reference``, ``arguments``)."""
    path, node = "problem", dict(node)
    if "reference" in node:
        reference, arguments = node.pop("reference"), node.pop("arguments", None) or {}
        label = node.pop("name", None)
        reject_unknown(node, ["arguments"], path)
        if not isinstance(reference, str):
            raise ConfigError(f"{path}.reference = {reference!r}; allowed: 'module:function' or 'file.py:function'")
        parameters: Sequence[str] = list(arguments)
        path = "problem.arguments"
    else:
        if "_target_" not in node:
            raise ConfigError(f"{path} = {short(node)}; allowed: a config of the group problem, or module:function")
        function = target(node.pop("_target_"), f"{path}._target_", ROOMS[:1])
        arguments, label = arguments_of(function, node, path), node.get("name")
        reference, parameters = f"{function.__module__}:{function.__name__}", list(arguments)
    try:
        return load_problem(reference, **arguments)
    except (ValueError, TypeError) as error:
        told, place = located(error, path, parameters, label=label), users_line(error)
        if place is not None and not told.startswith(f"{path}."):  # about the user's code, not an argument of it
            told = f"{place}: {told.removeprefix(f'{path}: ')}"
            if not raised_here(error):
                raise  # a slip that this package has no words for: the run keeps its traceback
        raise ConfigError(told) from error


# -- the parts of a solve --------------------------------------------------------------------------


def _scalars(node: dict[str, Any]) -> dict[str, Any]:
    kinds: dict[str, Any] = {"name": str, "seed": int, "threads": int, "explain": bool, "device": str, "dtype": str}
    top = {}
    for key, kind in kinds.items():
        if key not in node:
            raise ConfigError(f"{key}: missing; allowed: {KINDS[kind]}")
        top[key] = fit(node.pop(key), kind, key)
    for key, least in (("seed", 0), ("threads", 1)):
        if top[key] < least:
            raise ConfigError(f"{key} = {top[key]}; allowed: an integer from {least}")
    if top["dtype"] not in DTYPES:
        raise ConfigError(f"dtype = {top['dtype']!r}; {nearest(top['dtype'], DTYPES)}")
    top["device"] = _device(top["device"])
    return top


def _device(name: str) -> str:
    available = ["cpu"]
    if torch.cuda.is_available():
        available += ["cuda", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if name not in available:
        raise ConfigError(f"device = {name!r}; {nearest(name, available)} on this machine")
    return name


def _section(node: dict[str, Any], key: str) -> dict[str, Any]:
    if key not in node:
        raise ConfigError(f"{key}: missing; allowed: a config of the group {key}")
    value = node.pop(key)
    if value is not None and not isinstance(value, dict):
        raise ConfigError(f"{key} = {value!r}; allowed: a config of the group {key}")
    return dict(value or {})


def _solver(node: dict[str, Any], top: Mapping[str, Any]) -> Solver:
    hints = types_of(Solver)
    ansatz, nodes = _section(node, "ansatz"), _section(node, "nodes")
    fields: dict[str, Any] = {"conditioning": ansatz.pop("conditioning", "columns")}
    fields["basis"] = value_of(ansatz, FreeFunction, "ansatz")
    for key, name in (("kind", "node_kind"), ("n_nodes", "n_nodes")):
        if key not in nodes:
            raise ConfigError(f"nodes.{key}: missing; allowed: {KINDS[hints[name]]}")
        fields[name] = nodes.pop(key)
    reject_unknown(nodes, ["kind", "n_nodes"], "nodes")
    for key in ("form", "optimizer", "continuation", "guess"):
        fields[key] = value_of(_section(node, key), hints[key], key)
    weights = _section(node, "weights")
    if weights:
        arguments = {"optimizer": fields["optimizer"], "weights": weights.pop("equations", {})}
        reject_unknown(weights, ["equations"], "weights")
        fields["optimizer"] = call(WeightedEquations, arguments, "weights")
    finish = _section(node, "finish")
    if finish:
        parts = [fields["optimizer"], value_of(finish, Optimizer, "finish")]
        fields["optimizer"] = call(Chain, {"parts": parts}, "optimizer")
    budget = _section(node, "budget")
    fields["cpu_seconds"] = budget.pop("cpu_seconds", math.inf)
    reject_unknown(budget, ["cpu_seconds"], "budget")
    data = _section(node, "data")
    fields["data"] = value_of(data, hints["data"], "data") if data else None
    refinement = _section(node, "refinement")
    fields["refinement"] = value_of(refinement, hints["refinement"], "refinement") if refinement else None
    for key in (
        "n_starts",
        "n_certified",
        "coarse",
        "n_segments",
        "mass_variable",
        "start_limit",
        "predictor",
        "warm_damping",
        "stage_tolerance",
        "trust",
        "tolerances",
    ):
        if key in node:
            fields[key] = node.pop(key)
    return call(Solver, fields | {"dtype": DTYPES[top["dtype"]], "device": top["device"]}, "")


def _rehearse(plan: Plan) -> Discretisation:
    """Derive the boundary value problem, tabulate the first stage, guess: names what does not go together."""
    solver = plan.solver
    try:
        bvp = pontryagin(plan.problem, mass_variable=solver.mass_variable, dtype=solver.dtype, device=solver.device)
    except ValueError as error:
        raise ConfigError(located(error, "", ["mass_variable"], label="problem")) from error
    try:
        disc = solver.discretisation(bvp)
        _ = disc.expressions
        data = ["data"] if solver.data is not None else []
        check_equations((plan.settings.get("weights") or {}).get("equations", {}), [*equation_names(disc), *data])
        solver.guess.curve(bvp, STREAMS * plan.seed)
        if solver.data is not None:
            solver.data.of(plan.problem)
    except ValueError as error:
        raise ConfigError(located(error, "", [*types_of(Solver), "kind"])) from error
    return disc


def _notes(solver: Solver, disc: Discretisation) -> list[str]:
    """Settings that a solve may survive, and that say little about their method if it does."""
    notes, schedule = [], solver.continuation
    if isinstance(schedule, Ladder) and schedule.parameter == "smoothing":
        values = list(schedule.values)
        if any(after > before for before, after in pairwise(values)):
            notes.append(f"continuation.values = {short(values)} rise; a ladder goes from much smoothing to little")
    n_equations = sum(group.rows.stop - group.rows.start for group in disc.groups if not group.trivial)
    if isinstance(solver.basis, LinearBasis) and n_equations < disc.n_own:
        notes.append(
            f"nodes.n_nodes = {solver.n_nodes}: {n_equations} equations for {disc.n_own} coefficients, which they do "
            "not determine; more nodes or a smaller ansatz.size do"
        )
    return notes
