"""A harmonic oscillator brought to rest in minimum time by two bounded inputs: a box control of two components."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ponn_torch.optimal_control.control_laws import Box
from ponn_torch.optimal_control.problem import FreeTime, Named, OptimalControlProblem
from ponn_torch.optimal_control.regularisers import make_regulariser
from ponn_torch.problems.arguments import check_positive, check_vectors
from ponn_torch.problems.known import known_optimum

OPTIMA: list[tuple[dict[str, object], float]] = [({}, 2.8613463025446273)]


def oscillator(
    *,
    initial_state: Sequence[float] = (3.0, 2.0),
    bound: float = 1.0,
    regulariser: str = "entropy",
    guess: float = 5.0,
    known_cost: float | None = None,
    name: str = "oscillator",
) -> OptimalControlProblem:
    """ẋ = y + u₁, ẏ = −x + u₂ with |u₁|, |u₂| ≤ bound, to the origin in least time; ``guess`` is of the time.

    The costates turn with the oscillator, so u₁ and u₂ switch in turns, a quarter of a period apart.
    """
    check_vectors(2, initial_state=initial_state)
    check_positive(bound=bound, guess=guess)
    if known_cost is None:
        known_cost = known_optimum(oscillator, locals(), OPTIMA, ["guess"])

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        first, second = x.z.split(1, -1)
        return {"z": torch.cat([second, -first], -1) + u.force}

    size = max(*map(abs, initial_state), bound)
    return OptimalControlProblem(
        name=name,
        description="Harmonic oscillator with two bounded inputs, minimum time",
        states={"z": 2},
        control=Box("force", bound, -bound, regulariser=make_regulariser(regulariser), size=2),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: torch.ones_like(x.z[..., :1]),
        initial={"z": list(initial_state)},
        final={"z": [0.0, 0.0]},
        final_time=FreeTime(guess),
        units={"z": size},
        costate_units={"z": 1.0 / bound},
        cost_name="time",
        known_cost=known_cost,
    )
