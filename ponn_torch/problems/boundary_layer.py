"""A linear-quadratic problem with boundary layers at both ends: a slow state driven through a fast actuator."""

from __future__ import annotations

import torch

from ponn_torch.optimal_control.control_laws import Unconstrained
from ponn_torch.optimal_control.problem import Named, OptimalControlProblem
from ponn_torch.problems.arguments import check_positive


def boundary_layer(
    *,
    epsilon: float = 0.02,
    initial_state: float = 1.0,
    final_state: float = 0.0,
    final_time: float = 1.0,
    known_cost: float | None = None,
    name: str = "boundary_layer",
) -> OptimalControlProblem:
    """Minimise ½∫(x² + u²) dt with ẋ = y − x, ε ẏ = u − y and the actuator y at rest at both ends.

    Away from the ends y follows u; within a few ε of them it cannot. ``epsilon`` is a parameter of the problem, so
    that a ladder can walk down to it. ``known_cost`` None takes the exact optimum, whatever the arguments.
    """
    check_positive(epsilon=epsilon, final_time=final_time)
    if known_cost is None:
        known_cost = exact_cost(epsilon, initial_state, final_state, final_time)
    size = max(abs(initial_state), abs(final_state)) or 1.0

    def dynamics(t: torch.Tensor, x: Named, u: Named, p: Named) -> dict[str, torch.Tensor]:
        return {"x": x.y - x.x, "y": (u.command - x.y) / p.epsilon}

    return OptimalControlProblem(
        name=name,
        description="Slow state, fast actuator: boundary layers of width ε at both ends",
        states={"x": 1, "y": 1},
        control=Unconstrained("command", 1),
        dynamics=dynamics,
        running_cost=lambda t, x, u, p: 0.5 * (x.x * x.x + u.command * u.command),
        initial={"x": initial_state, "y": 0.0},
        final={"x": final_state, "y": 0.0},
        final_time=final_time,
        units={"x": size, "y": size / final_time, "time": final_time, "cost": size**2 / final_time},
        # u = −λy/ε is of the order of y
        costate_units={"y": epsilon * size / final_time},
        parameters={"epsilon": epsilon},
        known_cost=known_cost,
    )


def exact_solution(
    epsilon: float, initial_state: float, final_state: float, final_time: float, t: torch.Tensor
) -> torch.Tensor:
    """(x, y, λx, λy) (..., 4) at times t (...,), by the matrix exponential of the state–costate equations.

    Each mode is anchored at the end that it decays from, so that nothing overflows however thin the layers are.
    """
    rates = torch.tensor(
        [
            [-1.0, 1.0, 0.0, 0.0],
            [0.0, -1.0 / epsilon, 0.0, -1.0 / epsilon**2],
            [-1.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, -1.0, 1.0 / epsilon],
        ],
        dtype=torch.float64,
    )
    values, vectors = torch.linalg.eig(rates)
    anchor = torch.where(values.real > 0, final_time, 0.0)

    def modes(time: torch.Tensor) -> torch.Tensor:
        return vectors * torch.exp(values * (time[..., None] - anchor))[..., None, :]

    ends = modes(torch.tensor([0.0, final_time], dtype=torch.float64))[:, :2].flatten(0, 1)
    given = torch.tensor([initial_state, 0.0, final_state, 0.0], dtype=values.dtype)
    return (modes(t) @ torch.linalg.solve(ends, given)).real


def exact_cost(epsilon: float, initial_state: float, final_state: float, final_time: float) -> float:
    """½ (λᵀx at the start − λᵀx at the end), since d(λᵀx)/dt is minus twice the running cost; y is zero at both."""
    ends = torch.tensor([0.0, final_time], dtype=torch.float64)
    x, _, costate, _ = exact_solution(epsilon, initial_state, final_state, final_time, ends).unbind(-1)
    products = (x * costate).tolist()
    return 0.5 * (products[0] - products[1])
