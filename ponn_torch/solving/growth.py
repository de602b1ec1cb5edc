"""Where a flight has to restart: along some extremals an error grows faster than float64 has digits.

Costates run backwards what states run forwards, so a boundary layer of width ε makes an initial value problem whose
errors grow by exp(T/ε), while the boundary value problem is as well posed as any. Such an extremal is flown in legs.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ponn_torch.solving.solution import Solution

MOST_GROWTH = 1e3  # of an error over a leg: far above what known transfers and landings show (20 to 200)
N_POINTS = 400


def restarts(solution: Solution, most_growth: float = MOST_GROWTH) -> list[tuple[float, NDArray[np.floating]]]:
    """Scaled times, and w there, at which an error grown by ``most_growth`` since the last one is dropped."""
    curve = solution.curve
    times = curve.times.detach()
    t = torch.linspace(float(times[0]), float(times[-1]), N_POINTS + 1).to(times)
    segment = curve.segment_of(t)
    w, _ = solution.at(t, segment)
    slopes = _slopes(solution, t, w.detach(), segment)
    steps = torch.matrix_exp(0.5 * (slopes[1:] + slopes[:-1]) * t.diff()[:, None, None]).double().cpu()
    found = []
    growth = torch.eye(w.shape[-1], dtype=torch.float64)
    for i, step in enumerate(steps[:-1], start=1):
        growth = step @ growth
        if not float(torch.linalg.matrix_norm(growth)) < most_growth:
            found.append((float(t[i]), w[i].detach().double().cpu().numpy()))
            growth = torch.eye(w.shape[-1], dtype=torch.float64)
    return found


def _slopes(solution: Solution, t: Tensor, w: Tensor, segment: Tensor) -> Tensor:
    """∂F/∂w (m, 2n, 2n) along the curve."""
    by_w = solution.bvp.linearised_rates(t[:, None], w, solution.curve.setting(segment), range(w.shape[-1]))[2]
    return torch.nan_to_num(by_w)
