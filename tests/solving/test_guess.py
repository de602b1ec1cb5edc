"""First guesses meet the ends, repeat with their seed, and survive the projection on any ansatz."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import ANSATZES, PROBLEMS, bvp_of, collocation, problem, random, relative
from torch import Tensor

from ponn_torch.numerics.nodes import differentiation_matrix, make_nodes
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem
from ponn_torch.optimal_control.collocation import Collocation
from ponn_torch.optimal_control.control_laws import Unconstrained
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.solving.guess import DISTRIBUTIONS, STREAMS, Alternating, RandomGuess, project
from ponn_torch.solving.paths import PolarTransfer, PoweredDescent, StraightLine

# -- projection ----------------------------------------------------------------------------------------------


def waves(t: Tensor) -> Tensor:
    """A smooth w(t) of the double integrator: x, v = ẋ, and costates."""
    return torch.stack([torch.sin(2 * t), 2 * torch.cos(2 * t), torch.cos(3 * t), torch.exp(-t)], -1)


def free_double_integrator() -> BoundaryValueProblem:
    """Ends as the waves have them; costates are free anyway."""
    made = problem("minimum_fuel")
    x, v = waves(torch.tensor([0.0, 3.0], dtype=torch.float64))[:, :2].T.tolist()
    ends = {"initial": {"x": x[0], "v": v[0]}, "final": {"x": x[1], "v": v[1]}}
    # without chains the costates need not obey their equations
    return pontryagin(made.with_boundary(**ends), chains=False)


def projection_error(n_neurons: int, n_segments: int = 1, **options) -> float:
    made = collocation(
        free_double_integrator(),
        n_neurons=n_neurons,
        n_nodes=2 * n_neurons + 6,
        n_segments=n_segments,
        **options,
    )
    curve = Curve(made, project(made, waves))
    t = torch.linspace(0, 3, 101, dtype=torch.float64)
    return relative(curve(t), waves(t))


@pytest.mark.parametrize("conditioning", ["columns", "orthonormal"])
@pytest.mark.parametrize("n_segments", [1, 2])
def test_projections_of_smooth_curves_converge_spectrally(n_segments, conditioning):
    errors = [projection_error(n, n_segments, conditioning=conditioning) for n in (3, 6, 9, 20)]
    assert errors[0] > 30 * errors[1] > 900 * errors[2]
    assert errors[3] < 1e-12


@pytest.mark.parametrize("name", ANSATZES)
def test_every_ansatz_carries_a_smooth_curve(name):
    assert projection_error(40, basis=ANSATZES[name], conditioning="orthonormal") < 1e-4


def test_a_projected_curve_on_more_neurons_and_other_segments_is_the_same_curve():
    bvp = bvp_of("earth_mars")
    coarse = collocation(bvp, n_neurons=12, n_nodes=24)
    curve = Curve(coarse, random(coarse.n_unknowns, seed=1, low=-1.0))
    wide = collocation(bvp, n_neurons=20, n_nodes=40, n_segments=3)
    t = torch.linspace(0.0, 1.0, 57, dtype=torch.float64) * bvp.final_time
    assert relative(Curve(wide, project(wide, curve))(t), curve(t)) < 1e-11
    back = project(coarse, Curve(wide, project(wide, curve)))
    assert relative(back, curve.xi) < 1e-7


def test_projection_uses_the_times_it_is_given():
    bvp = bvp_of("minimum_time")
    made = collocation(bvp, n_neurons=8, n_nodes=12, n_segments=1)
    times = torch.tensor([0.0, 2.5], dtype=torch.float64)
    assert made.unpack(project(made, waves, times)).times.tolist() == [0.0, 2.5]
    assert made.unpack(project(made, waves)).times.tolist() == made.known_times.tolist()


# -- random functions ----------------------------------------------------------------------------------------


def draw(seed: int, name: str = "earth_mars", **options) -> tuple[Collocation, Tensor]:
    made = collocation(bvp_of(name), n_neurons=30, n_nodes=60)
    return made, project(made, RandomGuess(**options).curve(made.bvp, seed))


def test_a_seed_is_a_start():
    assert torch.equal(draw(7)[1], draw(7)[1])
    assert relative(draw(8)[1], draw(7)[1]) > 0.1


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_weights_have_their_distribution(distribution, name):
    options = {"distribution": distribution, "hold_mass": False}
    curves = [RandomGuess(**options).curve(bvp_of(name), seed) for seed in range(4)]
    weights = torch.cat([curve.xi for curve in curves])
    low, high, mean = {
        "uniform": (0.0, 1.0, 0.5),
        "symmetric": (-1.0, 1.0, 0.0),
        "normal": (-math.inf, math.inf, 0.0),
    }[distribution]
    free = curves[0].collocation.free_times
    if len(free):  # the time is no weight
        weights = torch.cat([curve.xi[:-1] for curve in curves])
    assert low <= float(weights.min()) < float(weights.max()) <= high
    deviation = float(weights.std()) / len(weights) ** 0.5
    assert abs(float(weights.mean()) - mean) < 5 * deviation
    assert relative(RandomGuess(scale=3.0, **options).curve(bvp_of(name), 0).xi[:4], 3 * weights[:4]) < 1e-15


def test_the_draw_does_not_depend_on_the_ansatz_that_it_is_projected_on():
    bvp, t = bvp_of("earth_mars"), torch.linspace(0.1, 5.9, 40, dtype=torch.float64)
    guess = RandomGuess(n_neurons=12).curve(bvp, 3)
    for size in (20, 30):
        made = collocation(bvp, n_neurons=size, n_nodes=2 * size)
        assert relative(Curve(made, project(made, guess))(t), guess(t)) < 1e-10


@pytest.mark.parametrize("mass_variable", ["mass", "log_mass", "delta_v"])
def test_the_mass_is_held_at_its_initial_value_as_in_the_paper(mass_variable):
    bvp = bvp_of("earth_mars", mass_variable)
    t = torch.linspace(0, bvp.final_time, 30, dtype=torch.float64)
    x, costates = bvp.to_physical(RandomGuess().curve(bvp, 0)(t))
    torch.testing.assert_close(x[:, 6], torch.full_like(t, 1000.0), rtol=1e-12, atol=0)
    assert float(costates[-1, 6]) == pytest.approx(0.0, abs=1e-12)  # the end is known
    assert float(costates[0, 6]) != 0.0
    loose = bvp.to_physical(RandomGuess(hold_mass=False).curve(bvp, 0)(t))[0][:, 6]
    assert float((loose - 1000.0).abs().max()) > 1.0


@pytest.mark.parametrize("name", PROBLEMS)
def test_random_starts_meet_the_known_ends(name):
    bvp = bvp_of(name)
    ends = RandomGuess().curve(bvp, 5)(torch.tensor([0.0, bvp.final_time], dtype=torch.float64))
    for known, reached in zip((bvp.known_initial, bvp.known_final), ends, strict=True):
        given = ~torch.isnan(known)
        torch.testing.assert_close(reached[given], known[given], rtol=1e-11, atol=1e-11)


# -- paths ---------------------------------------------------------------------------------------------------


def sampled(guess, name: str, count: int = 60) -> tuple[BoundaryValueProblem, Tensor, Tensor, Tensor]:
    """(bvp, t in SI, states, costates) at Chebyshev points."""
    bvp = bvp_of(name)
    z = make_nodes("chebyshev_lobatto", count, dtype=torch.float64).points
    t = (z + 1) / 2 * bvp.final_time
    x, costates = bvp.to_physical(guess.curve(bvp, 0)(t))
    return bvp, t * bvp.time_unit, x, costates


PATHS = [
    (StraightLine(), "earth_mars"),
    (StraightLine(), "tfc_test_1"),
    (PoweredDescent(), "mars_landing"),
    (PoweredDescent(), "small_body_landing"),
    (PolarTransfer(), "earth_mars"),
    (PolarTransfer(), "energy_transfer"),
    (PolarTransfer(1), "energy_transfer_limited"),
]


@pytest.mark.parametrize(("guess", "name"), PATHS)
def test_paths_start_and_end_where_they_must_and_costates_follow(guess, name):
    _, t, x, costates = sampled(guess, name)
    r0, rf = (torch.tensor(problem(name).boundary(end)[:3], dtype=torch.float64) for end in ("initial", "final"))
    size = float((rf - r0).norm())
    assert float((x[0, :3] - r0).norm()) < 1e-11 * size
    assert float((x[-1, :3] - rf).norm()) < 1e-11 * size
    derivative = differentiation_matrix(t)
    assert relative(derivative @ x[:, :3], x[:, 3:6]) < 1e-8
    # λ̇v = −λr, as in free space
    along = derivative @ costates[:, 3:6]
    size = max(float(along.abs().max()), float(costates[:, 3:6].abs().max()) / float(t[-1]))
    assert float((along + costates[:, :3]).abs().max()) < 1e-7 * size
    assert float(costates[:, 3:6].norm(dim=-1).min()) > 0


def test_a_straight_line_is_straight_and_its_costate_constant():
    bvp, t, x, costates = sampled(StraightLine(), "mars_landing")
    r0 = torch.tensor([-200.0, 100.0, 1500.0], dtype=torch.float64)
    torch.testing.assert_close(x[:, :3], r0 * (1 - t / 44.823)[:, None], rtol=0, atol=1e-9)
    change = -torch.tensor([85.0, -50.0, -65.0], dtype=torch.float64)
    expected = -change / change.norm() * bvp.problem.costate_unit("v")
    torch.testing.assert_close(costates[:, 3:6], expected.expand(len(t), 3), rtol=1e-9, atol=1e-9)


def test_the_powered_descent_guess_is_that_of_the_tfc_paper():
    bvp, t, _, costates = sampled(PoweredDescent(), "mars_landing")
    v0, r0 = (torch.tensor(x, dtype=torch.float64) for x in ([85.0, -50.0, -65.0], [-200.0, 100.0, 1500.0]))
    s = (t / 44.823)[:, None]
    expected = ((1 - s) * v0 / v0.norm() - s * r0 / r0.norm()) * bvp.problem.costate_unit("v")
    torch.testing.assert_close(costates[:, 3:6], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("revolutions", [0, 1, 2])
def test_polar_transfers_turn_as_often_as_they_are_told(revolutions):
    _, _, x, costates = sampled(PolarTransfer(revolutions), "energy_transfer", 400)
    angle = torch.atan2(x[:, 1], x[:, 0])
    steps = torch.remainder(angle.diff() + math.pi, 2 * math.pi) - math.pi
    ends = math.atan2(176959469.0, -172682023.0) - math.atan2(-51614428.0, -140699693.0)
    assert float(steps.sum()) == pytest.approx(ends % (2 * math.pi) + 2 * math.pi * revolutions, rel=1e-9)
    # velocities at both ends are met too, and the radius stays sensible
    for end, row in (("initial", 0), ("final", -1)):
        expected = torch.tensor(problem("energy_transfer").boundary(end)[3:], dtype=torch.float64)
        torch.testing.assert_close(x[row, 3:], expected, rtol=1e-8, atol=1e-3)
    assert 1.3e11 < float(x[:, :2].norm(dim=-1).min()) < float(x[:, :2].norm(dim=-1).max()) < 2.6e11
    unit = problem("energy_transfer").costate_unit("v")
    assert 0.5 < float((costates[:, 3:6].norm(dim=-1) / unit).mean()) < 2.0


def test_of_several_revolutions_every_start_takes_the_next():
    bvp = bvp_of("energy_transfer")
    t = torch.linspace(0, 1, 7, dtype=torch.float64) * bvp.final_time
    several = [PolarTransfer([3, 1]).curve(bvp, start)(t) for start in range(3)]
    for curve, revolutions in zip(several, [3, 1, 3], strict=True):
        assert torch.equal(curve, PolarTransfer(revolutions).curve(bvp, 0)(t))


def test_a_backward_orbit_turns_backward():
    made = problem("energy_transfer").with_boundary(
        initial={"r": [1.5e11, 0.0, 0.0], "v": [0.0, -3e4, 0.0]},
        final={"r": [0.0, 2.0e11, 0.0], "v": [2.5e4, 0.0, 0.0]},
    )
    bvp = pontryagin(made)
    t = torch.linspace(0, 1, 200, dtype=torch.float64) * bvp.final_time
    x, _ = bvp.to_physical(PolarTransfer(0).curve(bvp, 0)(t))
    angle = torch.atan2(x[:, 1], x[:, 0])
    steps = torch.remainder(angle.diff() + math.pi, 2 * math.pi) - math.pi
    assert float(steps.sum()) == pytest.approx(-1.5 * math.pi, rel=1e-9)


def test_a_transfer_in_a_plane_is_the_one_in_space_without_height():
    def orbit(size: int) -> BoundaryValueProblem:
        def ends(x: float, y: float) -> list[float]:
            return [x, y, 0.0][:size]

        made = OptimalControlProblem(
            name="orbit",
            states={"r": size, "v": size},
            control=Unconstrained("a", size),
            dynamics=lambda t, x, u, p: {"r": x.v, "v": u.a - x.r / (x.r**2).sum(-1, keepdim=True) ** 1.5},
            running_cost=lambda t, x, u, p: (u.a**2).sum(-1, keepdim=True),
            initial={"r": ends(1.0, 0.0), "v": ends(0.0, 1.0)},
            final={"r": ends(0.0, 1.5), "v": ends(-0.8, 0.0)},
            final_time=3.0,
        )
        return pontryagin(made)

    t = torch.linspace(0, 3, 9, dtype=torch.float64)
    plane, space = (PolarTransfer(1).curve(orbit(size), 0)(t) for size in (2, 3))
    # third derivatives of the path lose digits
    torch.testing.assert_close(plane, space[:, [0, 1, 3, 4, 6, 7, 9, 10]], rtol=1e-10, atol=1e-10)


def test_starts_alternate_between_guesses_and_pass_over_one_that_does_not_fit():
    guess = Alternating((RandomGuess(), PolarTransfer()))
    for name, second in (("earth_mars", PolarTransfer()), ("mars_landing", RandomGuess())):  # which ends on the axis
        bvp = bvp_of(name)
        t = torch.linspace(0, 1, 5, dtype=torch.float64) * bvp.final_time
        for start, expected in ((0, RandomGuess()), (1, second), (2, RandomGuess())):
            stream = 7 * STREAMS + start
            assert torch.equal(guess.curve(bvp, stream)(t), expected.curve(bvp, stream)(t))


def test_where_no_guess_fits_the_last_reason_is_told():
    with pytest.raises(ValueError, match="guess needs a state 'r'"):
        Alternating((PolarTransfer(), StraightLine())).curve(bvp_of("minimum_energy"), 0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RandomGuess("gaussian"), "distribution = 'gaussian'; allowed: uniform, symmetric, normal"),
        (lambda: Alternating(()), "guesses: none given; allowed: at least one"),
        (lambda: PolarTransfer().curve(bvp_of("mars_landing"), 0), "a polar transfer needs ends off the z axis"),
        (lambda: PolarTransfer(-1), "revolutions = -1; allowed: 0, 1, 2"),
        (lambda: PolarTransfer([2, -1]), r"revolutions = \[2, -1\]; allowed: 0, 1, 2"),
        (lambda: PolarTransfer([]), r"revolutions = \[\]; allowed: 0, 1, 2"),
        (
            lambda: StraightLine().curve(bvp_of("minimum_energy"), 0),
            "guess needs a state 'r' in problem 'double_integrator_energy'; allowed: x, v",
        ),
        (
            lambda: PolarTransfer(velocity="w").curve(bvp_of("earth_mars"), 0),
            "guess needs a state 'w' in problem 'earth_mars'; allowed: r, v, m",
        ),
    ],
)
def test_errors_name_field_value_and_what_is_allowed(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_random_guess_of_a_free_initial_mass_is_finite():
    landing = problem("mars_landing")
    free = landing.with_boundary(initial={k: v for k, v in landing.initial.items() if k != landing.mass})
    times = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)
    assert bool(torch.isfinite(RandomGuess().curve(pontryagin(free), 0)(times)).all())
