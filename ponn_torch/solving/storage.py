"""A curve in open formats: solution.json says what it is made of, weights.npz holds its numbers."""

from __future__ import annotations

import importlib
import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ponn_torch import __version__
from ponn_torch.ansatz.basis import FreeFunction
from ponn_torch.numerics.nodes import NodeSet
from ponn_torch.optimal_control.boundary_value_problem import Chain, Setting
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation, Form, Strong, Weak
from ponn_torch.optimal_control.expressions import LinearExpressions
from ponn_torch.optimal_control.pontryagin import pontryagin, with_singular_arcs
from ponn_torch.optimal_control.problem import OptimalControlProblem, nearest
from ponn_torch.optimal_control.references import load_problem, relative_reference, resolved_reference
from ponn_torch.optimal_control.singular import singular_components

SOLUTION, WEIGHTS = "solution.json", "weights.npz"
FORMAT = 1
FORMS: dict[str, type[Form]] = {"Strong": Strong, "Weak": Weak}


def save_curve(curve: Curve, folder: Path) -> None:
    """Write solution.json and weights.npz into an existing folder."""
    collocation = curve.collocation
    disc, bvp, setting = collocation.discretisation, collocation.bvp, collocation.setting
    origin = bvp.problem.origin
    arrays: dict[str, Tensor | None] = {
        "xi": curve.xi,
        "known_knots": collocation.known_knots,
        "known_times": collocation.known_times,
        "node_points": disc.nodes.points,
        "node_weights": disc.nodes.weights,
        "node_edges": disc.nodes.edges,
        "arcs": setting.regime.arcs,
        "smoothing": setting.regime.smoothing,
        **{f"check/{name}": value for name, value in _fingerprint(curve).items()},
        **{f"parameter/{name}": value for name, value in setting.parameters.items()},
        **{f"basis/{name}": value for name, value in disc.basis.state_dict().items()},
        **{f"combinations/{order}": value for order, value in _combinations(disc).items()},
    }
    description = {
        "format": FORMAT,
        "version": __version__,
        "problem": {
            "name": bvp.problem.name,
            "reference": None if origin is None else relative_reference(origin.reference, folder),
            "arguments": None if origin is None else dict(origin.arguments),
            "stated": _stated(bvp.problem),
        },
        "mass_variable": bvp.mass_variable,
        "chains": [asdict(chain) for chain in bvp.chains],
        "basis": _describe_basis(disc.basis),
        "nodes": {"kind": disc.nodes.kind, "n_nodes": len(disc.nodes)},
        "form": {"class": type(disc.form).__name__, "arguments": asdict(disc.form)},
        "conditioning": disc.conditioning,
        "knot_times": (curve.times * bvp.time_unit).tolist(),
        "events": list(collocation.events),
        "arcs": None if setting.regime.arcs is None else setting.regime.arcs.tolist(),
        "smoothing": curve.smoothing or None,
        "dtype": str(curve.xi.dtype).removeprefix("torch."),
    }
    given = {name: value.detach().cpu().numpy() for name, value in arrays.items() if value is not None}
    with (folder / WEIGHTS).open("wb") as stream:
        np.savez(stream, **given)  # type: ignore[arg-type]
    (folder / SOLUTION).write_text(json.dumps(description, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def load_curve(folder: Path, problem: OptimalControlProblem | None = None) -> Curve:
    """Rebuild the curve on the CPU and check that it passes through the saved points.

    Raises:
        FileNotFoundError: a missing file.
        ValueError: another format, no problem to make it with, or another curve.
    """
    for name in (SOLUTION, WEIGHTS):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"no solution in {str(folder)!r}: {str(folder / name)!r} does not exist")
    description = json.loads((folder / SOLUTION).read_text(encoding="utf-8"))
    if description.get("format") != FORMAT:
        raise ValueError(f"{folder / SOLUTION}: format = {description.get('format')!r}; allowed: {FORMAT}")
    with np.load(folder / WEIGHTS, allow_pickle=False) as stream:
        arrays = {name: torch.from_numpy(stream[name]) for name in stream.files}

    problem = problem or _make_problem(description["problem"], folder)
    if problem.name != description["problem"]["name"]:
        raise ValueError(
            f"{folder / SOLUTION}: problem = {problem.name!r}; allowed: {description['problem']['name']!r}, "
            "which was solved"
        )
    _check_stated(problem, description["problem"].get("stated", {}), folder)
    chains = tuple(Chain(tuple(c["columns"]), tuple(c["factors"]), bool(c["trivial"])) for c in description["chains"])
    xi = arrays["xi"]
    bvp = pontryagin(problem, mass_variable=description["mass_variable"], chains=False, dtype=xi.dtype)
    form = description["form"]
    if form["class"] not in FORMS:
        raise ValueError(f"{folder / SOLUTION}: form = {form['class']!r}; {nearest(form['class'], FORMS)}")
    discretisation = Discretisation(
        bvp=with_singular_arcs(replace(bvp, chains=chains), singular_components(bvp.law, arrays.get("arcs"))),
        basis=_make_basis(description["basis"], _under("basis", arrays), xi.dtype),
        nodes=NodeSet(
            description["nodes"]["kind"], arrays["node_points"], arrays["node_weights"], arrays.get("node_edges")
        ),
        form=FORMS[form["class"]](**form["arguments"]),
        conditioning=description["conditioning"],
        combinations={int(order): value for order, value in _under("combinations", arrays).items()},
    )
    collocation = Collocation(
        discretisation=discretisation,
        known_knots=arrays["known_knots"],
        known_times=arrays["known_times"],
        setting=Setting(Regime(arrays.get("smoothing"), arrays.get("arcs")), _under("parameter", arrays)),
        events=tuple(event if event is None else tuple(event) for event in description["events"]),
    )
    curve = Curve(collocation, xi)
    _check(curve, _under("check", arrays), folder)
    return curve


# -- pieces --------------------------------------------------------------------------------------------------


def _under(group: str, arrays: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(f"{group}/"): value for name, value in arrays.items() if name.startswith(f"{group}/")}


def _make_problem(saved: dict[str, Any], folder: Path) -> OptimalControlProblem:
    if saved["reference"] is None:
        raise ValueError(
            f"{folder / SOLUTION}: problem {saved['name']!r} was not made by load_problem and cannot be "
            "made again; pass it: Solution.load(folder, problem=...)"
        )
    return load_problem(resolved_reference(saved["reference"], folder), **saved["arguments"])


def _stated(problem: OptimalControlProblem) -> dict[str, float | str]:
    """Ends, final time and parameters, each by its name, SI."""
    out: dict[str, float | str] = {}
    for end in ("initial", "final"):
        values = zip(problem.component_names, problem.boundary(end), strict=True)
        out |= {f"{end} {name}": "free" if value is None else value for name, value in values}
    out["final_time"] = "free" if problem.free_final_time else problem.time_guess
    return out | {f"parameters[{name!r}]": float(value) for name, value in problem.parameters.items()}


def _check_stated(problem: OptimalControlProblem, saved: dict[str, float | str], folder: Path) -> None:
    """Say by name in what the problem differs; what was saved before these were has none."""
    found = _stated(problem) if saved else {}
    others = []
    for name in {**found, **saved}:
        now, then = found.get(name, "absent"), saved.get(name, "absent")
        same = math.isclose(now, then) if isinstance(now, float) and isinstance(then, float) else now == then
        if not same:
            others.append(f"{name} = {now} (saved: {then})")
    if others:
        raise ValueError(f"{folder / SOLUTION}: another problem than was solved: {', '.join(others)}")


def _combinations(disc: Discretisation) -> dict[int, Tensor]:
    """What conditioning made of a linear basis: made anew on another machine, its singular vectors may differ."""
    return disc.expressions.combinations if isinstance(disc.expressions, LinearExpressions) else {}


def _describe_basis(basis: FreeFunction) -> dict[str, Any]:
    """Class path and arguments, a basis inside a basis likewise."""
    arguments = {k: _describe_basis(v) if isinstance(v, FreeFunction) else v for k, v in basis.arguments.items()}
    return {"class": f"{type(basis).__module__}:{type(basis).__qualname__}", "arguments": arguments}


def _make_basis(saved: dict[str, Any], buffers: dict[str, Tensor], dtype: torch.dtype) -> FreeFunction:
    basis = _empty_basis(saved).to(dtype)
    basis.load_state_dict(buffers)
    return basis


def _empty_basis(saved: dict[str, Any]) -> FreeFunction:
    """A basis up to its buffers."""
    module, _, name = saved["class"].partition(":")
    cls = getattr(importlib.import_module(module), name, None)
    if not (isinstance(cls, type) and issubclass(cls, FreeFunction)):
        raise ValueError(f"basis class = {saved['class']!r}; allowed: subclasses of FreeFunction")
    arguments = saved["arguments"]
    inner = {k: _empty_basis(v) for k, v in arguments.items() if isinstance(v, dict) and "class" in v}
    return cls(**arguments | inner)


def _fingerprint(curve: Curve) -> dict[str, Tensor]:
    """What tells one curve of one problem from another: values and rates at some points, boundary data."""
    bvp = curve.collocation.bvp
    z = torch.linspace(-0.9, 0.8, 5, dtype=curve.xi.dtype, device=curve.xi.device)
    t, w, _, segment = curve.on_segments(z)
    states, costates = bvp.to_physical(w)
    time = curve.times[-1:] if bvp.problem.free_final_time else curve.times.new_tensor([bvp.final_time])
    return {
        "curve": w,
        "states": states,
        "costates": costates,
        "rates": bvp.rates(t[:, None], w, curve.setting(segment)),
        "boundary": torch.cat([bvp.known_initial, bvp.known_final, time])[None],
    }


def _check(curve: Curve, saved: dict[str, Tensor], folder: Path) -> None:
    """Basis and problem are made anew: make sure that the weights still mean the same."""
    found = _fingerprint(curve)
    for name, expected in saved.items():
        scale = torch.nan_to_num(expected.abs()).amax(0)
        limit = 1e6 * torch.finfo(expected.dtype).eps
        same = found[name].shape == expected.shape and bool(
            torch.isclose(found[name], expected, rtol=limit, atol=0.0, equal_nan=True)
            .logical_or((found[name] - expected).abs() <= limit * scale)
            .all()
        )
        if not same:
            raise ValueError(
                f"{folder / WEIGHTS}: the rebuilt {name} is not the saved one; problem or basis differ from "
                "what was solved"
            )
