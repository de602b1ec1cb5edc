"""Every law is the minimiser that it claims to be, by comparison with many other admissible controls."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers import random
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ponn_torch.optimal_control.control_laws import Box, ThrustBall, Unconstrained
from ponn_torch.optimal_control.control_set import INTERIOR, LOWER, UPPER, ControlSet, Minimiser, Regime
from ponn_torch.optimal_control.regularisers import REGULARISERS, Entropy, make_regulariser

NONE = SimpleNamespace()
ONE = torch.ones(4, 1, dtype=torch.float64)


@pytest.fixture(autouse=True, scope="module")
def constants():
    """Laws asked directly have no problem around them that knows whether someone differentiates."""
    with torch.no_grad():
        yield


def tensor(value: float | list[float]) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def column(value: float) -> Tensor:
    return tensor([[value]])


# -- regularisers --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", REGULARISERS)
@given(switching=st.floats(-5, 5), exponent=st.floats(-3, 1))
def test_the_law_minimises_its_own_penalty(name, switching, exponent):
    """η(S, ρ) minimises −S η + ρ e(η): no point of a fine grid on [0, 1] is better."""
    regulariser, smoothing = make_regulariser(name), 10.0**exponent
    eta = regulariser.fraction(tensor(switching), tensor(smoothing))
    assert 0 <= float(eta) <= 1
    grid = torch.linspace(0, 1, 20001, dtype=torch.float64)
    if name == "logarithmic":
        grid = grid[1:-1]
        assert 0 < float(eta) < 1

    def objective(fraction: Tensor) -> Tensor:
        return -switching * fraction + smoothing * regulariser.penalty(fraction)

    best = objective(grid)
    assert float(objective(eta)) <= float(best.min()) + 1e-14 * (abs(switching) + smoothing)
    assert abs(float(grid[best.argmin()] - eta)) < 1e-4


@pytest.mark.parametrize("name", REGULARISERS)
def test_laws_are_symmetric_and_end_in_bang_bang(name):
    regulariser = make_regulariser(name)
    switching = torch.arange(-30, 31, dtype=torch.float64) / 10
    for smoothing in (1.0, 1e-3):
        eta = regulariser.fraction(switching, tensor(smoothing))
        torch.testing.assert_close(eta + eta.flip(0), torch.ones_like(eta), rtol=1e-14, atol=1e-14)
        assert bool((eta.diff() >= 0).all())
        assert float(eta[30]) == pytest.approx(0.5)
    sharp = regulariser.fraction(switching, tensor(1e-9))
    clear = switching.abs() > 0.05
    assert float((sharp - (switching > 0).double())[clear].abs().max()) < 1e-7


def test_the_entropy_law_is_the_tanh_law_of_the_papers():
    switching = torch.linspace(-2, 2, 9, dtype=torch.float64)
    expected = 0.5 + 0.5 * torch.tanh(switching / 0.3)
    torch.testing.assert_close(Entropy().fraction(switching, tensor(0.3)), expected, rtol=0, atol=0)


def test_the_entropy_vanishes_in_the_middle_and_is_a_number_at_the_bounds():
    assert Entropy().penalty(tensor([0.0, 0.5, 1.0])).tolist() == pytest.approx(
        [0.5 * math.log(2), 0.0, 0.5 * math.log(2)]
    )


@pytest.mark.parametrize("name", REGULARISERS)
@pytest.mark.parametrize("smoothing", [1.0, 0.3, 0.01])
def test_part_throttle_is_never_paid_for(name, smoothing):
    """η + ρ e(η) ≥ 0, the smoothed cost of a second of thrust: else a longer flight would be a cheaper one."""
    fraction = torch.linspace(0, 1, 1001, dtype=torch.float64)
    cost = fraction + smoothing * make_regulariser(name).penalty(fraction)
    assert float(cost.min()) > -1e-15
    assert float(cost[1:].min()) > 0


def test_the_logarithmic_law_keeps_its_digits_far_from_the_switch():
    smoothing, eta = tensor(1e-6), make_regulariser("logarithmic").fraction(tensor([-1.0, 1.0]), tensor(1e-6))
    # η ≈ ρ/|S| off, 1 − ρ/S on: the leading terms of the quadratic's root
    assert float(eta[0]) == pytest.approx(float(smoothing), rel=1e-5)
    assert float(1 - eta[1]) == pytest.approx(float(smoothing), rel=1e-5)


def test_an_unknown_regulariser_gets_the_nearest_name():
    with pytest.raises(ValueError, match=r"regulariser = 'entropi'.*did you mean 'entropy'"):
        make_regulariser("entropi")


# -- thrust balls --------------------------------------------------------------------------------------------

ALPHA, MASS = 0.7, 1.6


def thrust_hamiltonian(primer: Tensor, mass_costate: float = 0.4):
    """A Hamiltonian of a spacecraft: α|T|(1 − λm) + primerᵀT."""

    def h(thrust: Tensor, thrust_magnitude: Tensor) -> Tensor:
        return ALPHA * (1 - mass_costate) * thrust_magnitude + (primer * thrust).sum(-1, keepdim=True)

    return h


def adapted(law: ControlSet, h, cost_rate: float | None = ALPHA) -> ControlSet:
    def cost(**u: Tensor) -> Tensor:
        values = [value for name, value in u.items() if name.endswith("_magnitude")]
        return cost_rate * values[0] if cost_rate else 0.0 * next(iter(u.values())).sum(-1, keepdim=True)

    return law.adapted(h, cost, NONE, ONE, 1.0)


def regularised(law: ControlSet, h, smoothing: Tensor, minimiser: Minimiser) -> float:
    return float(h(**minimiser.control) + law.penalty(minimiser, NONE, smoothing))


@pytest.mark.parametrize("regulariser", REGULARISERS)
@pytest.mark.parametrize("level", [0.0, 0.3])
@given(
    primer=st.lists(st.floats(-2, 2), min_size=3, max_size=3).filter(lambda p: sum(x * x for x in p) > 1e-6),
    minimum=st.sampled_from([0.0, 0.4]),
    smoothing=st.sampled_from([1e-2, 0.1, 1.0]),
    seed=st.integers(0, 1000),
)
def test_thrust_minimises_the_regularised_hamiltonian_over_the_ball(
    regulariser, level, primer, minimum, smoothing, seed
):
    h = thrust_hamiltonian(tensor([primer]))
    smoothed = {"regulariser": make_regulariser(regulariser), "switching_level": level}
    law = adapted(ThrustBall("thrust", 1.5, minimum, **smoothed), h)
    rho = column(smoothing)
    best = law.minimise(h, NONE, column(1.0), Regime(smoothing=rho))
    magnitude = best.control["thrust_magnitude"]
    assert minimum - 1e-15 <= float(magnitude) <= 1.5 + 1e-15
    assert float(best.control["thrust"].norm()) == pytest.approx(float(magnitude), rel=1e-13)
    assert float(magnitude) == pytest.approx(minimum + (1.5 - minimum) * float(best.fraction), rel=1e-13)
    # no other thrust in the ball is better, wherever it points and however large
    fractions = 1e-9 + (1 - 2e-9) * random(400, 1, seed=seed)
    directions = random(400, 3, seed=seed + 1, low=-1.0)
    size = minimum + (1.5 - minimum) * fractions
    other = {"thrust": size * directions / directions.norm(dim=-1, keepdim=True), "thrust_magnitude": size}
    values = h(**other) + law.penalty(Minimiser(other, fractions, fractions), NONE, rho)
    assert regularised(law, h, rho, best) <= float(values.min()) + 1e-12


def test_the_switching_function_of_a_thrust_ball_is_that_of_the_paper():
    primer, mass_costate = tensor([[0.3, -0.4, 1.2]]) / MASS, 0.4
    law = adapted(ThrustBall("thrust", 2.0), thrust_hamiltonian(primer, mass_costate))
    assert law.cost_rate == pytest.approx(ALPHA)
    best = law.minimise(thrust_hamiltonian(primer, mass_costate), NONE, column(1.0), Regime())
    # S = |λv|/(α m) + λm − 1
    assert float(best.switching) == pytest.approx(1.3 / (ALPHA * MASS) + mass_costate - 1, rel=1e-14)
    assert best.control["thrust"][0].tolist() == pytest.approx([-2 * 0.3 / 1.3, 2 * 0.4 / 1.3, -2 * 1.2 / 1.3])


def test_a_switching_level_shifts_the_smoothed_law_only():
    h = thrust_hamiltonian(tensor([[0.3, 0.4, 0.0]]))
    plain, shifted = (adapted(ThrustBall("thrust", 1.0, switching_level=level), h) for level in (0.0, 0.25))
    regime = Regime(smoothing=column(0.2))
    switching = float(plain.minimise(h, NONE, column(1.0), regime).switching)
    assert float(shifted.minimise(h, NONE, column(1.0), regime).switching) == switching
    assert float(shifted.minimise(h, NONE, column(1.0), regime).fraction) == pytest.approx(
        float(Entropy().fraction(tensor(switching - 0.25), tensor(0.2)))
    )
    for law in (plain, shifted):
        assert float(law.minimise(h, NONE, column(1.0), Regime()).fraction) == float(switching > 0)


def test_arcs_pin_the_thrust_to_its_bounds():
    primer = tensor([[0.0, 0.0, 2.0], [0.0, 1.0, 0.0]])
    h = thrust_hamiltonian(primer)
    law = adapted(ThrustBall("thrust", 3.0, 0.5), thrust_hamiltonian(tensor([[0.0, 0.0, 2.0]])))
    arcs = torch.tensor([[LOWER], [UPPER]])
    best = law.minimise(h, NONE, torch.ones(2, 1, dtype=torch.float64), Regime(arcs=arcs))
    assert best.control["thrust_magnitude"].flatten().tolist() == [0.5, 3.0]
    assert best.control["thrust"].tolist() == [[0.0, 0.0, -0.5], [0.0, -3.0, 0.0]]
    assert law.arc_codes(tensor([[-0.1], [0.0], [0.1]])).flatten().tolist() == [LOWER, LOWER, UPPER]


def throttle_energy(primer: Tensor, curvature: float = 0.5):
    def h(thrust: Tensor, thrust_magnitude: Tensor) -> Tensor:
        return 0.5 * curvature * thrust_magnitude**2 + (primer * thrust).sum(-1, keepdim=True)

    return h


@given(size=st.floats(0.01, 3.0), minimum=st.sampled_from([0.0, 0.7]))
def test_a_convex_hamiltonian_is_minimised_by_clipping(size, minimum):
    h = throttle_energy(tensor([[0.0, size, 0.0]]))
    law = adapted(ThrustBall("thrust", 2.0, minimum), h, cost_rate=None)
    assert law.convex == (0,)
    assert law.n_switching == 2
    best = law.minimise(h, NONE, column(1.0), Regime())
    assert float(best.control["thrust_magnitude"]) == pytest.approx(min(max(size / 0.5, minimum), 2.0), rel=1e-12)
    code = int(law.arc_codes(best.switching))
    # on the arc that the two switching functions name, the control is the same
    pinned = law.minimise(h, NONE, column(1.0), Regime(arcs=torch.tensor([[code]])))
    torch.testing.assert_close(pinned.control["thrust"], best.control["thrust"], rtol=1e-12, atol=1e-12)
    assert float(law.penalty(best, NONE, column(0.3))) == 0.0  # nothing to smooth


def test_bounds_may_be_parameters():
    p = SimpleNamespace(most=2.0 * ONE[:2], least=0.25 * ONE[:2])
    h = thrust_hamiltonian(tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 0.01]]))
    law = ThrustBall("thrust", "most", "least")
    law = law.adapted(h, lambda thrust, thrust_magnitude: ALPHA * thrust_magnitude, p, ONE[:2], 1.0)
    best = law.minimise(h, p, ONE[:2], Regime())
    assert best.control["thrust_magnitude"].flatten().tolist() == [2.0, 0.25]


@pytest.mark.parametrize("law", [Box, ThrustBall])
@pytest.mark.parametrize("bound", [[], (0.0, 1.0, 2.0, 3.0), [math.nan], None, math.nan, math.inf], ids=repr)
def test_a_bound_is_a_number_or_a_name(law, bound):
    for label in ("minimum", "maximum"):
        given = re.escape(repr(tuple(bound) if law is Box and isinstance(bound, list) else bound))
        with pytest.raises(ValueError, match=rf"push: {label} = {given}; allowed: a finite number"):
            law(**{"name": "push", "maximum": 1.0, label: bound})


def test_a_ball_has_one_pair_of_bounds():
    with pytest.raises(ValueError, match=r"push: maximum = \(1.0, 2.0\); allowed: a finite number, or the name"):
        ThrustBall("push", (1.0, 2.0), size=2)


@pytest.mark.parametrize("law", [Box, ThrustBall])
@pytest.mark.parametrize("size", [0, -1, 1.5, Entropy()], ids=repr)
def test_a_size_is_a_whole_number(law, size):
    with pytest.raises(ValueError, match=re.escape(f"push: size = {size!r}; allowed: a whole number from 1")):
        law("push", 1.0, 0.0, size)


@pytest.mark.parametrize("law", [Box, ThrustBall])
@pytest.mark.parametrize("regulariser", ["entropy", Entropy, None, 1.0], ids=repr)
def test_a_regulariser_is_an_object_with_its_methods(law, regulariser):
    given = re.escape(repr(regulariser))
    with pytest.raises(ValueError, match=rf"push: regulariser = {given}; allowed: Entropy\(\), Quadratic\(\)"):
        law("push", 1.0, regulariser=regulariser)


def test_names_bounds_and_sizes_go_by_position_and_the_rest_by_keyword():
    assert Box("push", 2.0, -1.0, 3) == Box(name="push", maximum=2.0, minimum=-1.0, size=3)
    assert ThrustBall("push", 2.0, 1.0, 2).names == {"push": 2, "push_magnitude": 1}
    with pytest.raises(TypeError, match="positional"):
        Box("push", 1.0, 0.0, 1, Entropy())


@pytest.mark.parametrize(("minimum", "maximum"), [(-0.1, 1.0), (1.0, 1.0), (2.0, 1.0)])
def test_impossible_thrust_bounds_are_named(minimum, maximum):
    with pytest.raises(ValueError, match=rf"thrust: minimum = {minimum}, maximum = {maximum}; 0 ≤ minimum <"):
        ThrustBall("thrust", maximum, minimum)


def test_bounds_that_are_parameters_are_compared_when_their_values_are_known():
    p = SimpleNamespace(most=1.0 * ONE, least=2.0 * ONE)
    h = thrust_hamiltonian(tensor([[1.0, 0.0, 0.0]]))
    with pytest.raises(ValueError, match=r"thrust: minimum = least, maximum = most; 0 ≤ minimum < maximum"):
        ThrustBall("thrust", "most", "least").adapted(h, lambda thrust, thrust_magnitude: ONE, p, ONE, 1.0)


@pytest.mark.parametrize(
    "cost",
    [
        lambda thrust, magnitude: (thrust**2).sum(-1, keepdim=True),
        lambda thrust, magnitude: thrust.norm(dim=-1, keepdim=True),
        lambda thrust, magnitude: magnitude * thrust[..., :1],
    ],
    ids=["square", "norm", "product"],
)
def test_a_ball_needs_a_hamiltonian_linear_in_the_vector(cost):
    def h(thrust: Tensor, thrust_magnitude: Tensor) -> Tensor:
        return thrust_hamiltonian(tensor([[1.0, 0.5, 0.0]]))(thrust, thrust_magnitude) + cost(thrust, thrust_magnitude)

    with pytest.raises(ValueError, match=r"not linear in the vector u.thrust; .* u.thrust_magnitude"):
        adapted(ThrustBall("thrust", 2.0), h)


def test_a_magnitude_enters_up_to_its_square():
    with pytest.raises(ValueError, match="thrust: the Hamiltonian is neither affine nor quadratic in its magnitude"):
        adapted(ThrustBall("thrust", 2.0), lambda thrust, thrust_magnitude: thrust_magnitude**3, None)


# -- boxes ---------------------------------------------------------------------------------------------------


def affine(slopes: Tensor):
    return lambda u: (slopes * u).sum(-1, keepdim=True)


def separable(slopes: Tensor, curvatures: Tensor):
    return lambda u: (slopes * u + 0.5 * curvatures * u * u).sum(-1, keepdim=True)


@pytest.mark.parametrize("regulariser", REGULARISERS)
@given(slopes=st.lists(st.floats(-3, 3), min_size=3, max_size=3), seed=st.integers(0, 1000))
def test_every_component_of_a_box_minimises_its_part(regulariser, slopes, seed):
    h, rho = affine(tensor([slopes])), column(0.3)
    law = Box("u", 2.0, -1.0, 3, regulariser=make_regulariser(regulariser))
    law = adapted(law, affine(tensor([1.0, 2.0, 3.0])), None)
    best = law.minimise(h, NONE, column(1.0), Regime(smoothing=rho))
    assert law.convex == ()
    assert law.cost_rate == pytest.approx(1 / 3)  # the scale of H over the range
    torch.testing.assert_close(best.switching, -tensor([slopes]) / law.cost_rate, rtol=1e-14, atol=1e-14)
    fractions = 1e-9 + (1 - 2e-9) * random(400, 3, seed=seed)
    other = Minimiser({"u": -1 + 3 * fractions}, fractions, fractions)
    values = h(**other.control) + law.penalty(other, NONE, rho)
    assert regularised(law, h, rho, best) <= float(values.min()) + 1e-12


@given(slopes=st.lists(st.floats(-5, 5), min_size=2, max_size=2))
def test_a_convex_box_is_clipped_component_by_component(slopes):
    curvatures = tensor([1.0, 4.0])
    h = separable(tensor([slopes]), curvatures)
    law = adapted(Box("u", 1.0, -0.5, size=2), separable(ONE * tensor([1.0, 1.0]), curvatures), None)
    assert law.convex == (0, 1)
    assert law.n_switching == 4
    best = law.minimise(h, NONE, column(1.0), Regime())
    expected = (-tensor([slopes]) / curvatures).clamp(-0.5, 1.0)
    torch.testing.assert_close(best.control["u"], expected, rtol=1e-12, atol=1e-12)
    codes = law.arc_codes(best.switching)
    pinned = law.minimise(h, NONE, column(1.0), Regime(arcs=codes))
    torch.testing.assert_close(pinned.control["u"], expected, rtol=1e-12, atol=1e-12)
    for code, value in zip(codes[0].tolist(), expected[0].tolist(), strict=True):
        # S = 0 exactly at a bound belongs to either arc
        assert (code == INTERIOR) == (-0.5 < value < 1.0) or 0.0 in best.switching


def test_a_concave_hamiltonian_is_refused():
    with pytest.raises(ValueError, match="u: the Hamiltonian is concave in component 1; allowed: affine or convex"):
        adapted(Box("u", 1.0, -0.5, size=2), separable(ONE * tensor([1.0, 1.0]), tensor([1.0, -4.0])), None)
    with pytest.raises(ValueError, match="thrust: the Hamiltonian is concave in its magnitude; allowed: affine or"):
        adapted(ThrustBall("thrust", 2.0), throttle_energy(tensor([[0.0, 1.0, 0.0]]), -0.5), None)


def test_a_vanishing_primer_takes_no_direction_and_stays_finite():
    law = adapted(ThrustBall("thrust", 2.0, 0.5), thrust_hamiltonian(tensor([[0.0, 0.0, 1.0]])))
    primer = tensor([[0.0, 0.0, 0.0], [0.0, 0.3, -0.4]]).requires_grad_()
    with torch.enable_grad():
        best = law.minimise(thrust_hamiltonian(primer), NONE, ONE[:2], Regime(smoothing=ONE[:2]))
        total = sum(x.sum() for x in (*best.control.values(), best.switching))
        (slopes,) = torch.autograd.grad(total, primer)
    assert best.control["thrust"][0].tolist() == [0.0, 0.0, 0.0]
    # S = (0 − α (1 − λm))/α
    assert float(best.switching[0]) == pytest.approx(-0.6)
    assert bool(slopes.isfinite().all())
    assert float(best.switching[1]) == pytest.approx(0.5 / ALPHA - 0.6)


def test_a_box_with_a_coupled_hamiltonian_is_refused():
    with pytest.raises(ValueError, match="u: the Hamiltonian couples its components"):
        adapted(Box("u", 1.0, -1.0, size=2), lambda u: (u[..., :1] * u[..., 1:]) + u.sum(-1, keepdim=True), None)


def test_a_product_of_three_components_is_coupled():
    """All its mixed slopes vanish at the corner of the box."""
    with pytest.raises(ValueError, match="u: the Hamiltonian couples its components"):
        adapted(Box("u", 1.0, 0.0, 3), lambda u: u.prod(-1, keepdim=True) + u.sum(-1, keepdim=True), None)


@pytest.mark.parametrize("part", [lambda u: u**4, torch.exp, torch.abs], ids=["quartic", "exponential", "kink"])
def test_a_box_needs_a_hamiltonian_up_to_squares(part):
    def h(u: Tensor) -> Tensor:
        return 0.1 * u[..., :1] ** 2 + part(u[..., 1:]) + u.sum(-1, keepdim=True)

    cures = "Stationary over the same range, a kink as in .u. a ThrustBall or two non-negative parts of u"
    with pytest.raises(ValueError, match=f"u: .* neither affine nor quadratic in component 1; .*{cures}"):
        adapted(Box("u", 4.0, -4.0, 2), h, None)


@pytest.mark.parametrize("regulariser", REGULARISERS)
@given(slopes=st.lists(st.floats(-3, 3), min_size=3, max_size=3), seed=st.integers(0, 1000))
def test_a_box_may_be_affine_in_one_component_and_convex_in_another(regulariser, slopes, seed):
    curvatures = tensor([0.0, 2.0, 0.0])
    h, rho = separable(tensor([slopes]), curvatures), column(0.3)
    law = Box("u", (1.0, 2.0, 3.0), -1.0, 3, regulariser=make_regulariser(regulariser))
    law = adapted(law, separable(ONE * tensor([1.0, 2.0, 3.0]), curvatures), None)
    assert law.convex == (1,)
    assert [tuple(level) for level in law.levels] == [
        (0, LOWER, UPPER),
        (1, LOWER, INTERIOR),
        (2, LOWER, UPPER),
        (1, INTERIOR, UPPER),
    ]
    best = law.minimise(h, NONE, column(1.0), Regime(smoothing=rho))
    fractions = 1e-9 + (1 - 2e-9) * random(400, 3, seed=seed)
    other = Minimiser({"u": -1 + tensor([2.0, 3.0, 4.0]) * fractions}, fractions, fractions)
    values = h(**other.control) + law.penalty(other, NONE, rho)
    assert regularised(law, h, rho, best) <= float(values.min()) + 1e-12
    # without smoothing the codes say where it is
    sharp = law.minimise(h, NONE, column(1.0), Regime())
    pinned = law.minimise(h, NONE, column(1.0), Regime(arcs=law.arc_codes(sharp.switching)))
    torch.testing.assert_close(pinned.control["u"], sharp.control["u"], rtol=1e-12, atol=1e-12)
    assert float(sharp.control["u"][0, 1]) == pytest.approx(min(max(-slopes[1] / 2.0, -1.0), 2.0), abs=1e-12)


def test_curvature_that_turns_with_the_costate_is_concave_somewhere():
    costates = tensor([[0.4], [1.0], [-0.4], [-1.0]])  # two and their opposites
    with pytest.raises(ValueError, match=r"u: the Hamiltonian is concave in component 0; .*Stationary"):
        adapted(Box("u", 1.0, -1.0), lambda u: costates * (u + 0.25 * u**2), None)
    # a running cost that outweighs a small costate decides
    assert adapted(Box("u", 1.0, -1.0), lambda u: costates * (u + 0.25 * u**2) + 0.2 * u**2, None).convex


def test_curvature_that_turns_with_the_state_is_left_to_the_certificate():
    masses = tensor([[1.0], [-1.0], [1.0], [-1.0]])
    assert adapted(Box("u", 1.0, -1.0), lambda u: masses * u**2 + u, None).convex


def test_impossible_box_bounds_are_named():
    with pytest.raises(ValueError, match=r"u: minimum = 1.0, maximum = -1.0; minimum < maximum"):
        Box("u", -1.0, 1.0)
    with pytest.raises(ValueError, match=r"u: minimum = 1.0, maximum = \(2.0, 1.0\); minimum < maximum"):
        Box("u", (2.0, 1.0), 1.0, 2)


@pytest.mark.parametrize("quadratic", [0.0, 1.0])
@pytest.mark.parametrize("name", REGULARISERS)
def test_bounds_per_component_are_equal_bounds_of_other_units(name, quadratic):
    """u = b v: the same H, switching functions, penalty and arcs."""
    low, high, slopes = tensor([-1.0, -6.0]), tensor([0.5, 2.0]), random(40, 2, seed=1, low=-3.0, high=3.0)
    one, rho, middle, half = slopes[:, :1] ** 0, tensor([[0.4]]), (low + high) / 2, (high - low) / 2

    def h(u: Tensor) -> Tensor:
        return (slopes * u + quadratic * u**2).sum(-1, keepdim=True)

    def rescaled(u: Tensor) -> Tensor:
        return h(middle + half * u)

    cost = lambda u: 0.0 * u[..., :1]  # noqa: E731
    laws = Box("u", high.tolist(), low.tolist(), 2), Box("u", 1.0, -1.0, 2)
    laws = [replace(law, regulariser=make_regulariser(name)) for law in laws]
    laws = [law.adapted(f, cost, NONE, one, 1.0) for law, f in zip(laws, (h, rescaled), strict=True)]
    for regime in (Regime(smoothing=rho), Regime(), Regime(arcs=torch.full((40, 2), UPPER))):
        found, expected = (law.minimise(f, NONE, one, regime) for law, f in zip(laws, (h, rescaled), strict=True))
        close = {"rtol": 1e-13, "atol": 1e-13}
        torch.testing.assert_close(found.control["u"], middle + half * expected.control["u"], **close)
        torch.testing.assert_close(found.switching, expected.switching, **close)
        if regime.smoothing is not None:
            penalties = [law.penalty(best, NONE, rho) for law, best in zip(laws, (found, expected), strict=True)]
            torch.testing.assert_close(*penalties, **close)
    assert bool((laws[0].probe(one)["u"] > low).all() & (laws[0].probe(one)["u"] < high).all())


# -- no bounds -----------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 1000))
def test_a_quadratic_hamiltonian_has_one_step_to_its_minimum(seed):
    root, slope = random(3, 3, seed=seed, low=-1.0), random(1, 3, seed=seed + 1, low=-1.0)
    hessian = root @ root.mT + 0.1 * torch.eye(3, dtype=torch.float64)

    def h(u: Tensor) -> Tensor:
        return (slope * u).sum(-1, keepdim=True) + 0.5 * (u @ hessian * u).sum(-1, keepdim=True)

    law = adapted(Unconstrained("u", 3), h, None)
    best = law.minimise(h, NONE, column(1.0), Regime()).control["u"]
    torch.testing.assert_close(best, -torch.linalg.solve(hessian, slope.mT).mT, rtol=1e-10, atol=1e-12)
    nearby = best + 1e-2 * random(50, 3, seed=seed + 2, low=-1.0)
    assert float(h(best)) < float(h(nearby).min())


def test_a_hamiltonian_that_is_not_quadratic_has_no_closed_form():
    with pytest.raises(ValueError, match=r"control 'u': the Hamiltonian is not quadratic"):
        adapted(Unconstrained("u", 1), lambda u: u**4, None)


def test_cubes_that_cancel_on_the_diagonal_are_seen():
    with pytest.raises(ValueError, match=r"control 'u': the Hamiltonian is not quadratic"):
        adapted(
            Unconstrained("u", 2),
            lambda u: (u**2).sum(-1, keepdim=True) + 0.05 * (u[..., :1] ** 3 - u[..., 1:] ** 3),
            None,
        )


@pytest.mark.parametrize("signs", [[-1.0, -1.0], [1.0, -1.0]])
def test_a_stationary_point_that_is_no_minimum_is_refused(signs):
    with pytest.raises(ValueError, match="control 'u': H_uu is positive definite at none of the probes"):
        adapted(Unconstrained("u", 2), lambda u: (ONE * tensor(signs) * u**2 + u).sum(-1, keepdim=True), None)


def test_a_hamiltonian_convex_at_some_probes_is_left_to_the_certificate():
    signs = tensor([[1.0], [0.0], [-1.0], [-1.0]])
    law = Unconstrained("u", 1)
    assert adapted(law, lambda u: signs * u**2 + u, None) is law


def test_where_h_does_not_depend_on_the_control_there_is_no_minimiser_and_no_error():
    weight = torch.tensor([[1.0], [0.0]], dtype=torch.float64)
    best = Unconstrained("u", 1).minimise(lambda u: weight * u**2 + u, None, weight, Regime())
    assert best.control["u"][0] == pytest.approx(-0.5)
    assert not bool(best.control["u"][1].isfinite())
