"""The collocation residual: its Jacobian, batch axes and ends, and exact solutions that make it vanish."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from examples import ferry, interception, linear_quadratic, saturated_pair
from helpers import ANSATZES, PROBLEMS, VARIANTS, bvp_of, collocation, mass_variables, random, relative
from torch import Tensor
from torch.func import jacfwd

from ponn_torch.ansatz.basis import Chebyshev
from ponn_torch.numerics.nodes import differentiation_matrix, make_nodes
from ponn_torch.numerics.tape import RECORDING_PAYS
from ponn_torch.optim.base import Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optimal_control.boundary_value_problem import BoundaryValueProblem, Setting
from ponn_torch.optimal_control.collocation import Collocation, component_names
from ponn_torch.optimal_control.control_set import Regime
from ponn_torch.optimal_control.curve import Curve
from ponn_torch.optimal_control.discretisation import Discretisation, Strong, Weak
from ponn_torch.optimal_control.pontryagin import pontryagin
from ponn_torch.optimal_control.problem import OptimalControlProblem
from ponn_torch.solving.guess import project

FORMS = {"strong": Strong(), "weak": Weak(2.0, 5)}


def unknowns(made: Collocation, batch: tuple[int, ...] = (), seed: int = 0) -> Tensor:
    """Random ξ with knot times in order, disturbed where they are free."""
    parts = made.unpack(random(*batch, made.n_unknowns, seed=seed, low=0.2, high=1.2))
    times = made.known_times.expand(*batch, -1).clone()
    step = 0.05 * float(made.known_times.diff(dim=-1).min())
    times[..., made.free_times] += step * random(*batch, len(made.free_times), seed=seed + 1)
    return made.pack(replace(parts, times=times))


def with_arcs(made: Collocation, codes: list[list[int]]) -> Collocation:
    return replace(made, setting=replace(made.setting, regime=Regime(arcs=torch.tensor(codes))))


def on_times(
    bvp: BoundaryValueProblem, fractions: list[float], events: list[tuple[int, ...] | None], codes, form=FORMS["strong"]
) -> Collocation:
    """Segments between fractions of the final time, on arcs."""
    disc = Discretisation(bvp, Chebyshev(4), make_nodes("legendre_gauss", 6, dtype=torch.float64), form, "columns")
    times = torch.tensor(fractions, dtype=torch.float64) * bvp.final_time
    return with_arcs(Collocation.on_segments(disc, times, events=events), codes)


def jacobian_error(made: Collocation, xi: Tensor) -> float:
    """Linearisation against forward-mode autodiff of the residual, relative to each row's largest entry."""
    r, jacobian = made.linearise(xi)
    torch.testing.assert_close(r, made.residual(xi), rtol=1e-13, atol=1e-13)
    expected = jacfwd(made.residual)(xi)
    assert jacobian.dense().shape == expected.shape
    size = expected.abs().amax(-1, keepdim=True).clamp_min(1e-3 * float(expected.abs().max()))
    return float(((jacobian.dense() - expected).abs() / size).max())


# -- tapes -------------------------------------------------------------------------------------------------


def as_it_is(made: Collocation, xi: Tensor) -> tuple[Tensor, Tensor]:
    """(r, J) of a collocation that has recorded nothing."""
    disc = made.discretisation
    fresh = Discretisation(disc.bvp, disc.basis, disc.nodes, disc.form, disc.conditioning)
    r, jacobian = replace(made, discretisation=fresh).linearise(xi)
    return r, jacobian.dense()


def check_tapes(made: Collocation, other: Collocation) -> None:
    """Asked often enough, residuals and Jacobians come from tapes: the same bits, for other data as well."""
    xi = unknowns(made)
    for _ in range(RECORDING_PAYS + 1):
        made.residual(xi)
        made.linearise(xi)
    assert all(replay.recorded for replay in made.discretisation.replays.values())
    count = len(made.discretisation.replays)
    for one, seed in ((made, 3), (other, 4)):
        point = unknowns(one, seed=seed)
        r, jacobian = one.linearise(point)
        expected, matrix = as_it_is(one, point)
        assert torch.equal(r, expected)
        assert torch.equal(jacobian.dense(), matrix)
        assert torch.equal(one.residual(point), replace(one, discretisation=made.discretisation)._residual(point))
    assert len(made.discretisation.replays) == count  # the other one plays the same tapes


@pytest.mark.parametrize("name", ["earth_mars", "mars_landing", "small_body_landing", "tfc_test_2", "energy_transfer"])
def test_a_residual_that_is_asked_for_often_is_played_from_a_tape(name):
    made = collocation(bvp_of(name), n_neurons=4, n_nodes=6, smoothing=0.4)
    other = replace(made, known_knots=1.01 * made.known_knots, known_times=1.1 * made.known_times)
    check_tapes(made, other.with_setting(smoothing=0.2) if made.setting.regime.smoothing is not None else other)


def test_arcs_with_subdivisions_are_played_for_other_times_arcs_and_fractions():
    bvp = bvp_of("tfc_test_1")
    events = [None, (0,), None]
    made = on_times(bvp, [0.0, 0.2, 0.5, 0.7, 1.0], events, [[0], [0], [2], [2]])
    other = on_times(bvp, [0.0, 0.3, 0.4, 0.5, 1.0], events, [[2], [2], [0], [0]])
    check_tapes(made, replace(other, discretisation=made.discretisation))


def test_what_is_differentiated_is_not_played():
    made = collocation(bvp_of("mars_landing"), n_neurons=4, n_nodes=6, smoothing=0.4)
    xi = unknowns(made)
    for _ in range(RECORDING_PAYS + 1):
        made.residual(xi)
    point = xi.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(made.residual(point).square().sum(), point)
    r, jacobian = made.linearise(xi)
    assert relative(gradient, 2 * jacobian.gradient(r)) < 1e-11


# -- Jacobian ------------------------------------------------------------------------------------------------

ALL = [*PROBLEMS, *VARIANTS]
WITH_MASS_VARIABLES = [(name, variable) for name in ALL for variable in mass_variables(name)]


@pytest.mark.parametrize(("name", "mass_variable"), WITH_MASS_VARIABLES)
def test_the_linearisation_of_every_problem_is_its_jacobian(name, mass_variable):
    made = collocation(bvp_of(name, mass_variable), n_neurons=4, n_nodes=6, smoothing=0.4)
    assert jacobian_error(made, unknowns(made)) < 1e-11


EXAMPLES = {
    "ferry": ferry,
    "ferry_free_time": lambda: ferry(free_final_time=True, minimum=0.5),
    "interception": interception,
    "saturated_pair": saturated_pair,
    "linear_quadratic": linear_quadratic,
}


def two_arcs(example: OptimalControlProblem) -> list[list[int]]:
    size = example.control.n_switching
    return [[2] * size, [0] * size, [2] * size] if size else [[], [], []]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("n_segments", [1, 3])
@pytest.mark.parametrize("name", EXAMPLES)
def test_smoothed_segments_with_parameters_explicit_time_and_terminal_data(name, n_segments, form):
    bvp = pontryagin(EXAMPLES[name]())
    made = collocation(bvp, n_neurons=4, n_nodes=6, n_segments=n_segments, smoothing=0.4, form=FORMS[form])
    assert jacobian_error(made, unknowns(made)) < 1e-11


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("free_final_time", [False, True])
@pytest.mark.parametrize("mass_variable", ["mass", "log_mass", "delta_v"])
def test_arcs_with_unknown_switches_and_subdivisions(mass_variable, free_final_time, form):
    bvp = pontryagin(ferry(free_final_time=free_final_time), mass_variable=mass_variable)
    made = on_times(bvp, [0, 0.2, 0.5, 0.6, 0.8, 1.0], [None, (0,), None, (0,)], [[2], [2], [0], [0], [2]], FORMS[form])
    assert len(made.free_times) == 2 + free_final_time
    assert jacobian_error(made, unknowns(made)) < 1e-11


@pytest.mark.parametrize("name", ["mars_landing", "tfc_test_1", "earth_mars", "minimum_time", "minimum_fuel"])
def test_arcs_of_published_problems(name):
    made = on_times(bvp_of(name), [0, 0.3, 0.7, 1.0], [(0,), (0,)], [[2], [0], [2]])
    assert jacobian_error(made, unknowns(made)) < 1e-11


def test_arcs_of_a_box_that_saturates_by_component():
    bvp = pontryagin(saturated_pair())
    # functions 0 and 1 are S at the lower bound, 2 and 3 at the upper one
    made = on_times(bvp, [0, 0.3, 0.5, 1.0], [(2,), (1,)], [[2, 1], [1, 1], [1, 0]])
    assert jacobian_error(made, unknowns(made)) < 1e-11


@pytest.mark.parametrize("name", ANSATZES)
def test_every_free_function(name):
    made = collocation(
        pontryagin(ferry()),
        n_neurons=8,
        n_nodes=12,
        smoothing=0.4,
        basis=ANSATZES[name],
        conditioning="orthonormal",
    )
    assert jacobian_error(made, unknowns(made)) < 1e-11


# -- batches -------------------------------------------------------------------------------------------------


def batched(members: list[Collocation], **changes) -> Collocation:
    """One collocation for all members, from what differs between them."""
    return replace(members[0], **changes)


def check_members(together: Collocation, members: list[Collocation], xi: Tensor) -> None:
    """Residual, Jacobian and blocks of the batch are those of its members."""
    flat = xi.reshape(-1, xi.shape[-1])
    residual, jacobian = together.linearise(xi)
    assert residual.shape == (*xi.shape[:-1], members[0].residual(flat[0]).shape[-1])
    torch.testing.assert_close(together.residual(xi), residual, rtol=1e-13, atol=1e-13)
    dense = jacobian.dense().reshape(len(flat), residual.shape[-1], -1)
    for i, member in enumerate(members):
        alone, alone_jacobian = member.linearise(flat[i])
        torch.testing.assert_close(residual.reshape(len(flat), -1)[i], alone, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(dense[i], alone_jacobian.dense(), rtol=1e-12, atol=1e-12)
        for name, norm in member.blocks(alone).items():
            assert float(together.blocks(residual)[name].flatten()[i]) == pytest.approx(float(norm), rel=1e-11)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("batch", [(3,), (2, 2)])
@pytest.mark.parametrize("name", ["earth_mars", "mars_landing", "tfc_test_2", "energy_transfer"])
def test_a_batch_of_unknowns(name, batch, form):
    made = collocation(bvp_of(name), n_neurons=4, n_nodes=6, n_segments=2, smoothing=0.4, form=FORMS[form])
    check_members(made, [made] * math.prod(batch), unknowns(made, batch))


@pytest.mark.parametrize("free_final_time", [False, True])
def test_a_batch_of_smoothings_and_parameters(free_final_time):
    made = collocation(pontryagin(ferry(free_final_time=free_final_time)), n_neurons=4, n_nodes=6, n_segments=2)
    values = {
        "smoothing": torch.tensor([1.0, 0.3, 0.05], dtype=torch.float64),
        "thrust": torch.tensor([4.0, 5.0, 3.0], dtype=torch.float64),
    }
    members = [made.with_setting(**{k: float(v[i]) for k, v in values.items()}) for i in range(3)]
    check_members(made.with_setting(**values), members, unknowns(made, (3,)))
    # the values have a say
    xi = unknowns(made)
    assert float((members[0].residual(xi) - members[2].residual(xi)).abs().max()) > 1e-3


@pytest.mark.parametrize("arcs", [False, True])
def test_a_batch_of_ends_and_durations(arcs):
    bvp = pontryagin(ferry())
    if arcs:
        made = on_times(bvp, [0, 0.25, 0.5, 1.0], [None, (0,)], [[2], [2], [0]])
    else:
        made = collocation(bvp, n_neurons=4, n_nodes=6, n_segments=2, smoothing=0.3)
    ends = 0.1 * random(3, *made.known_knots.shape, seed=5)
    durations = torch.tensor([0.8, 1.0, 1.3], dtype=torch.float64)[:, None]
    knots, times = made.known_knots + ends, made.known_times * durations
    members = [replace(made, known_knots=a, known_times=b) for a, b in zip(knots, times, strict=True)]
    together = replace(made, known_knots=knots, known_times=times)
    xi = torch.stack([unknowns(member, seed=i) for i, member in enumerate(members)])
    check_members(together, members, xi)
    assert torch.equal(together.pack(together.unpack(xi)), xi)


def test_a_batch_of_parameters_on_arcs_with_switching_rows():
    made = on_times(pontryagin(ferry(free_final_time=True)), [0, 0.4, 1.0], [(0,)], [[2], [0]])
    thrust = torch.tensor([[4.0, 5.0], [3.0, 2.0]], dtype=torch.float64)
    members = [made.with_setting(thrust=float(value)) for value in thrust.flatten()]
    check_members(made.with_setting(thrust=thrust), members, unknowns(made, (2, 2)))


def test_a_batch_of_arc_codes():
    made = on_times(pontryagin(ferry()), [0, 0.4, 1.0], [(0,)], [[2], [0]])
    codes = torch.tensor([[[2], [0]], [[0], [2]]])
    members = [with_arcs(made, codes[i].tolist()) for i in range(2)]
    check_members(with_arcs(made, codes.tolist()), members, unknowns(made, (2,)))


def test_a_batch_of_smoothings_is_solved_at_once():
    made = collocation(bvp_of("minimum_fuel"), n_neurons=16, n_nodes=24)
    smoothing = torch.tensor([1.0, 0.6, 0.4], dtype=torch.float64)
    line = torch.tensor([[0.0, 0.0, -1.0, -1.0], [1.0, 0.0, -1.0, 1.0]], dtype=torch.float64)
    start = project(made, lambda t: line[0] + (line[1] - line[0]) * (t / 3.0)[:, None])
    optimizer = LevenbergMarquardt(Stopping(tolerance=1e-11, decrease=1e-4))
    together = optimizer.run(made.with_setting(smoothing=smoothing), start.expand(3, -1))
    for i in range(3):
        alone = optimizer.run(made.with_setting(smoothing=float(smoothing[i])), start)
        assert relative(together.xi[i], alone.xi) < 1e-9
        assert together.member_status[i] is alone.status
    assert relative(together.xi[0], together.xi[2]) > 1e-3


# -- layout --------------------------------------------------------------------------------------------------


def test_chains_save_unknowns():
    chained = collocation(bvp_of("earth_mars"), n_neurons=10, n_nodes=20)
    plain = collocation(pontryagin(PROBLEMS["earth_mars"](), chains=False), n_neurons=10, n_nodes=20)
    # λ at the start, λ of the known end states and the final mass
    assert chained.n_unknowns == 8 * 10 + 14
    assert plain.n_unknowns == 14 * 10 + 14
    landing = collocation(bvp_of("mars_landing"), n_neurons=10, n_nodes=20)
    assert landing.n_unknowns == 5 * 10 + 14  # three positions, mass and its costate


@pytest.mark.parametrize("name", ["earth_mars", "tfc_test_1"])
def test_blocks_part_the_residual(name):
    made = on_times(bvp_of(name), [0, 0.3, 0.7, 1.0], [(0,), (0,)], [[2], [0], [2]])
    r = made.residual(unknowns(made, (2,)))
    blocks = made.blocks(r)
    assert set(blocks) <= {*component_names(made.bvp), "switching", "terminal"}
    assert ("terminal" in blocks) == (name == "tfc_test_1")
    assert len(blocks) == 8 + 1 + (name == "tfc_test_1")
    total = torch.stack(list(blocks.values())).square().sum(0).sqrt()
    torch.testing.assert_close(total, r.norm(dim=-1), rtol=1e-13, atol=0)


def test_subdivisions_stay_at_their_fraction_between_switches():
    made = on_times(pontryagin(ferry(free_final_time=True)), [0, 0.2, 0.5, 0.8, 1.0], [None, (0,), None], [[2]] * 4)
    xi = unknowns(made)
    parts = made.unpack(xi)
    switch, end = 1.1 * float(parts.times[2]), 1.3 * float(parts.times[4])
    times = parts.times.clone()
    times[2], times[4] = switch, end
    moved = made.unpack(made.pack(replace(parts, times=times))).times
    expected = [0, 0.4 * switch, switch, switch + 0.6 * (end - switch), end]
    assert moved.tolist() == pytest.approx(expected, rel=1e-14)


def test_an_unknown_parameter_is_named():
    made = collocation(pontryagin(ferry()))
    with pytest.raises(ValueError, match="no parameter 'thurst'; allowed: smoothing, final_time, thrust, tide"):
        made.with_setting(thurst=1.0)


# -- constrained expressions ---------------------------------------------------------------------------------


@pytest.mark.parametrize("n_segments", [1, 3])
@pytest.mark.parametrize(("name", "mass_variable"), WITH_MASS_VARIABLES)
def test_ends_and_knots_are_met_by_random_weights(name, mass_variable, n_segments):
    bvp = bvp_of(name, mass_variable)
    made = collocation(bvp, n_neurons=12, n_nodes=20, n_segments=n_segments)
    xi = random(made.n_unknowns, seed=3, low=-1.0)
    xi = made.pack(replace(made.unpack(xi), times=made.known_times))
    curve = Curve(made, xi)
    ends = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    inner = make_nodes("chebyshev_lobatto", 40, dtype=torch.float64).points
    size = max(float(curve.on_segment(inner, k)[1].abs().max()) for k in range(n_segments))
    parts = [curve.on_segment(ends, k) for k in range(n_segments)]
    for known, reached in ((bvp.known_initial, parts[0][1][0]), (bvp.known_final, parts[-1][1][1])):
        given = ~torch.isnan(known)
        assert given.any() or bvp.n_terminal_rows  # an end of which rows alone speak
        assert bool(((reached - known)[given].abs() < 1e-12 * size).all())
    for k in range(n_segments):  # every knot from both sides, value and, along chains, derivatives
        torch.testing.assert_close(parts[k][0], curve.times[[k, k + 1]], rtol=1e-14, atol=1e-14)
        assert float((parts[k][1] - curve.knots[[k, k + 1]]).abs().max()) < 1e-12 * size
    # the entries of a chain are derivatives of its first one
    derivative = differentiation_matrix(inner)
    for k in range(n_segments):
        _, w, rate = curve.on_segment(inner, k)
        numerical = derivative @ w * (2 / (curve.times[k + 1] - curve.times[k]))
        assert float((numerical - rate).abs().max()) < 1e-9 * float(rate.abs().max())
        for chain in bvp.chains:
            for e, (column, after) in enumerate(zip(chain.columns[:-1], chain.columns[1:], strict=True)):
                slope = chain.factors[e + 1] / chain.factors[e]
                assert float((rate[:, column] - slope * w[:, after]).abs().max()) < 1e-12 * float(rate.abs().max())


# -- exact solutions -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("chains", [True, False])
@pytest.mark.parametrize("n_segments", [1, 2])
def test_the_linear_quadratic_regulator_is_a_hyperbolic_cosine(n_segments, chains):
    bvp = pontryagin(linear_quadratic(), chains=chains)
    # ẋ = −λ, λ̇ = −x is a cycle: one chain, cut anywhere
    assert len(bvp.chains) == (1 if chains else 2)
    made = collocation(bvp, n_neurons=14, n_nodes=20, n_segments=n_segments)
    result = LevenbergMarquardt(Stopping(tolerance=1e-13), linear_solver="qr").run(
        made, torch.zeros(made.n_unknowns, dtype=torch.float64)
    )
    curve, t = Curve(made, result.xi), torch.linspace(0, 1, 33, dtype=torch.float64)
    exact = torch.stack([torch.cosh(1 - t), torch.sinh(1 - t)], -1) / math.cosh(1.0)
    assert relative(curve(t), exact) < 1e-12
    assert curve.off_node_residual() < 1e-10


def test_an_exact_extremal_makes_every_row_vanish_and_no_other_curve_does():
    """minimum fuel over 3 s: push, coast, brake with λv = 1 at the switches, split where S = 0."""
    made = on_times(bvp_of("minimum_fuel"), [0, 0.2, 0.7, 1.0], [(0,), (0,)], [[2], [0], [2]])
    push = 1.5 - math.sqrt(1.25)
    slope = 2 / (3 - 2 * push)  # of λv, from −1 to 1 over the coast

    def exact(t: Tensor) -> Tensor:
        phase = [t, torch.full_like(t, push), 3 - t]
        v = torch.minimum(torch.minimum(phase[0], phase[1]), phase[2])
        first, brake = t**2 / 2, 1 - (3 - t) ** 2 / 2
        x = torch.where(t < push, first, torch.where(t > 3 - push, brake, push**2 / 2 + push * (t - push)))
        return torch.stack([x, v, torch.full_like(t, -slope), slope * (t - 1.5)], -1)

    times = torch.tensor([0.0, push, 3 - push, 3.0], dtype=torch.float64)
    xi = project(made, exact, times)
    assert float(made.residual(xi).abs().max()) < 1e-12
    late = project(made, exact, times + torch.tensor([0.0, 0.01, 0.0, 0.0], dtype=torch.float64))
    assert float(made.blocks(made.residual(late))["switching"]) > 1e-3


@pytest.mark.parametrize("kind", ["legendre_gauss", "chebyshev_lobatto"])
def test_strong_rows_are_the_integral_of_the_squared_defect(kind):
    """Twice the nodes, the same norm."""
    bvp = pontryagin(linear_quadratic(), chains=False)
    coarse, fine = (collocation(bvp, n_neurons=5, n_nodes=n, kind=kind) for n in (20, 40))
    xi = unknowns(coarse)
    assert float(fine.residual(xi).norm()) == pytest.approx(float(coarse.residual(xi).norm()), rel=1e-12)
    # and the norm is that of the defect between the nodes, up to the factor h of d/dz
    defect = Curve(coarse, xi).defect(20000)[1]
    integral = defect.square().sum() / 10000 * float(coarse.known_times[-1] / 2) ** 2
    assert float(coarse.residual(xi).norm()) == pytest.approx(float(integral.sqrt()), rel=1e-6)


def test_moments_of_the_weak_form_are_those_of_the_pointwise_defect():
    bvp = bvp_of("energy_transfer")
    strong, weak = (collocation(bvp, n_neurons=5, n_nodes=9, form=form) for form in (Strong(), Weak(0.0)))
    xi = unknowns(strong)
    # all moments without decay: an orthogonal change of rows
    assert float(weak.residual(xi).norm()) == pytest.approx(float(strong.residual(xi).norm()), rel=1e-12)
    decayed = collocation(bvp, n_neurons=5, n_nodes=9, form=Weak(2.0, 4)).residual(xi).unflatten(-1, (-1, 4))
    whole = weak.residual(xi).unflatten(-1, (-1, 9))[..., :4]
    torch.testing.assert_close(decayed, whole / torch.arange(1, 5) ** 2, rtol=1e-12, atol=1e-12)


def test_a_setting_of_parameters_is_made_from_the_problem():
    made = collocation(pontryagin(ferry()))
    assert {name: float(value) for name, value in made.setting.parameters.items()} == {
        "thrust": 4.0,
        "tide": 0.5,
    }
    assert isinstance(made.setting, Setting)


# -- segments that vanish ------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [1e-2, 1e-5, 1e-8])
def test_a_vanishing_segment_does_not_hide_a_jump(length):
    """A velocity of 0.5 that a last push ends in no time: a free impulse, were it not for h₀/h."""
    bvp = bvp_of("minimum_fuel")
    disc = Discretisation(bvp, Chebyshev(6), make_nodes("legendre_gauss", 9, dtype=torch.float64))
    guess = torch.tensor([0.0, 2.0, 3.0], dtype=torch.float64)
    setting = Setting(Regime(arcs=torch.tensor([[0], [2]])))
    made = Collocation.on_segments(disc, guess, events=[(0,)], setting=setting)
    unknowns = made.unpack(torch.zeros(made.n_unknowns, dtype=torch.float64))
    unknowns.knots[1, :2] = torch.tensor([1.0, 0.5])
    assert unknowns.knots[2, :2].tolist() == [1.0, 0.0]
    times = torch.tensor([0.0, 3.0 - length, 3.0], dtype=torch.float64)
    residual = made.residual(made.pack(replace(unknowns, times=times)))
    last = residual[: 2 * disc.n_rows].view(2, -1)[1]
    # ∫(y″)² dz ≥ (h Δv)²/2 over z ∈ [−1, 1], times h₀/h with h₀ = 0.5, less what the push does in this time
    assert float(last.norm()) > 0.5 * 0.5 / math.sqrt(2) - length
