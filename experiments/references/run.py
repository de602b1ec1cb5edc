"""The trajectories that the guidance tracks, computed anew by direct collocation and held against the stored ones."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from experiments.references.problems import (
    quadrotor_controls,
    quadrotor_manoeuvre,
    shuttle_controls,
    shuttle_entry,
    shuttle_limits,
)
from experiments.tables import Report, markdown, run_study
from ponn_torch.baselines.answer import DirectSolution
from ponn_torch.baselines.direct import Unstructured
from ponn_torch.guidance.plants import quadrotor, shuttle
from ponn_torch.guidance.tracking import PiecewiseReference
from ponn_torch.optimal_control.problem import FreeTime, Named

FOLDER = Path(__file__).parent


def _largest(found: Tensor, stored: Tensor) -> float:
    return float((found - stored).abs().max())


def _control(answer: DirectSolution, controls: Callable[[Named], Tensor]) -> Tensor:
    return controls(Named(**answer.control))


def _save(folder: Path | None, name: str, answer: DirectSolution, states: Tensor, controls: Tensor) -> None:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        arrays = {"t": answer.times, "x": states.T, "u": controls.T}
        np.savez(folder / f"{name}.npz", **{key: value.numpy() for key, value in arrays.items()})


def quadrotor_reference(folder: Path | None) -> Report:
    """5.9 s, as stored, and the time that is best."""
    fixed = Unstructured(40, 4).solve(quadrotor_manoeuvre())
    free = Unstructured(40, 4).solve(quadrotor_manoeuvre(FreeTime(5.9)))
    stored = PiecewiseReference.load(quadrotor.REFERENCE)
    states = torch.cat(list(fixed.states.values()), -1)
    controls = _control(fixed, quadrotor_controls)
    _save(folder, "quadrotor", fixed, states, controls)
    measured = {
        "quadrotor/J at 5.9 s, error": abs(fixed.cost - 353.488864),
        "quadrotor/J at the best time, error": abs(free.cost - 352.928106),
        "quadrotor/best time, error, s": abs(free.final_time - 5.733977),
        "quadrotor/stored states, largest difference": _largest(states, stored.states),
        "quadrotor/stored controls, largest difference": _largest(controls, stored.controls),
    }
    rows = [
        {"final time": "fixed", "s": f"{fixed.final_time:.6f}", "J": f"{fixed.cost:.6f}", "CPU s": fixed.cpu_seconds},
        {"final time": "free", "s": f"{free.final_time:.6f}", "J": f"{free.cost:.6f}", "CPU s": free.cpu_seconds},
    ]
    return Report({"quadrotor": rows}, _summary(rows, measured), measured)


def shuttle_reference(folder: Path | None) -> Report:
    """The largest crossrange, without and with limits on heat rate, dynamic pressure and load."""
    answers = {
        label: Unstructured(100, 3, path_constraints=limits).solve(shuttle_entry())
        for label, limits in (("none", None), ("heat rate, pressure, load", shuttle_limits))
    }
    limited = answers["heat rate, pressure, load"]
    stored = PiecewiseReference.load(shuttle.REFERENCE)
    states = torch.cat([limited.states[name] for name in ("r", "V", "gamma")], -1)
    controls = _control(limited, shuttle_controls)
    _save(folder, "shuttle", limited, states, controls)
    latitudes = {label: math.degrees(-answer.cost) for label, answer in answers.items()}
    radius, speed, angle = (states - stored.states).abs().amax(0).tolist()
    measured = {
        "shuttle/latitude, error, deg": abs(latitudes["heat rate, pressure, load"] - 29.9790),
        "shuttle/latitude without limits, error, deg": abs(latitudes["none"] - 34.1220),
        "shuttle/final time, error, s": abs(limited.final_time - 2282.82),
        "shuttle/stored radius, largest difference, m": radius,
        "shuttle/stored speed, largest difference, m per s": speed,
        "shuttle/stored flight-path angle, largest difference, rad": angle,
        "shuttle/stored controls, largest difference, rad": _largest(controls, stored.controls),
    }
    rows = [
        {
            "path limits": label,
            "final latitude, °": f"{latitudes[label]:.5f}",
            "final time, s": f"{answer.final_time:.4f}",
            "CPU s": answer.cpu_seconds,
        }
        for label, answer in answers.items()
    ]
    return Report({"shuttle": rows}, _summary(rows, measured), measured)


def _summary(rows: list[dict[str, object]], measured: dict[str, float]) -> str:
    shown = [{key: f"{v:.2f}" if isinstance(v, float) else v for key, v in row.items()} for row in rows]
    checks = [{"check": key.partition("/")[2], "value": f"{value:.1e}"} for key, value in measured.items()]
    return f"{markdown(shown)}\n\n{markdown(checks)}"


PARTS = {"quadrotor": quadrotor_reference, "shuttle": shuttle_reference}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--save", type=Path, help="write t, x, u at the Radau points into this folder")
    parser.add_argument("--check-only", action="store_true", help="do not write results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    parts = {name: lambda run=PARTS[name]: run(arguments.save) for name in arguments.parts}
    return run_study(FOLDER, parts, check_only=arguments.check_only)


if __name__ == "__main__":
    sys.exit(main())
