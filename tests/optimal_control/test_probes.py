"""What is found by probing F and H must hold at every parameter, smoothing and arc, or be refused."""

import pytest
import torch

from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_laws import Box, Unconstrained
from ponn_torch.optimal_control.discretisation import Discretisation
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import FreeTime, OptimalControlProblem
from ponn_torch.optimal_control.regularisers import Entropy, Quadratic


def cart(**changes):
    given = {
        "name": "cart",
        "states": {"x": 1, "v": 1},
        "control": Unconstrained("u", 1),
        "dynamics": lambda t, x, u, p: {"x": x.v, "v": u.u},
        "running_cost": lambda t, x, u, p: 0.5 * u.u**2,
        "initial": {"x": 0.0, "v": 0.0},
        "final": {"x": 1.0, "v": 0.0},
        "final_time": 1.0,
    }
    return OptimalControlProblem(**{**given, **changes})


@pytest.mark.parametrize("gear", [1.0, 0.0])
def test_a_rate_proportional_by_a_parameter_is_no_chain(gear):
    dynamics = lambda t, x, u, p: {"x": x.v + p.gear * x.v, "v": u.u}  # noqa: E731
    chains = pontryagin(cart(dynamics=dynamics, parameters={"gear": gear})).chains
    assert not any(chain.columns[:2] == (0, 1) for chain in chains)


@pytest.mark.parametrize("regulariser", [Entropy(), Quadratic()])
def test_a_control_saturated_at_all_probes_is_still_seen(regulariser):
    cost = lambda t, x, u, p: u.u  # noqa: E731
    bvp = pontryagin(cart(control=Box("u", 100.0, 0.0, regulariser), running_cost=cost))
    assert {c.columns: c.trivial for c in bvp.chains} == {(0, 1): False, (3, 2): True}
    assert bvp.couplings[1].tolist() == [False, False, False, True]


def test_a_box_refuses_a_hamiltonian_affine_in_one_component_and_convex_in_another():
    cost = lambda t, x, u, p: u.u[..., :1] ** 2 + u.u[..., 1:]  # noqa: E731
    dynamics = lambda t, x, u, p: {"x": u.u[..., :1], "v": u.u[..., 1:]}  # noqa: E731
    with pytest.raises(ValueError, match="affine in component 1 and curved in component 0"):
        pontryagin(cart(control=Box("u", 1.0, -1.0, size=2), dynamics=dynamics, running_cost=cost))


def test_a_hamiltonian_linear_in_a_free_control_is_refused():
    with pytest.raises(ValueError, match="H_uu is singular"):
        pontryagin(cart(running_cost=lambda t, x, u, p: x.x**2))


def test_a_free_final_time_is_no_cost():
    with pytest.raises(ValueError, match="nothing to minimise"):
        cart(final_time=FreeTime(1.0), running_cost=None)


def test_a_rate_given_as_a_number_is_told_its_shape():
    with pytest.raises(ValueError, match=r"dynamics\['x'\] has shape \(\)"):
        cart(dynamics=lambda t, x, u, p: {"x": 1.0, "v": u.u})


def test_a_manifold_sees_parameters_in_the_dtype_of_the_problem():
    seen = []

    def manifold(t, x, p):
        seen.append(p.radius.dtype)
        return x.x - p.radius

    pontryagin(cart(final={}, terminal_manifold=manifold, parameters={"radius": 1.0}))
    assert set(seen) == {torch.float64}


def test_events_of_a_collocation_are_one_per_interior_knot():
    times = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"2 entries for 2 segments; allowed: one per interior knot \(1\)"):
        Collocation.on_segments(Discretisation(pontryagin(cart()), None, None), times, events=[None, None])
