"""Loops with known answers, schedules, deadlines, noise, ends, and what is wrong with a setting."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import relative
from test_expansion import PROBLEMS, solver
from torch import Tensor

from ponn_torch.guidance.closed_loop import Loop, fly
from ponn_torch.guidance.controllers import Decision, HorizonController, Timetable, gain_schedule, timetable
from ponn_torch.guidance.plants.clohessy_wiltshire import clohessy_wiltshire
from ponn_torch.guidance.plants.quadrotor import quadrotor
from ponn_torch.guidance.plants.shuttle import shuttle
from ponn_torch.guidance.producers import Passes, Planner
from ponn_torch.guidance.tracking import PiecewiseReference, Plant, Setpoint, TrackingProblem


def short(table: Timetable, count: int) -> Timetable:
    return Timetable(table.starts[:count], table.durations[:count])


@pytest.mark.parametrize(("horizon", "distance", "expected", "first"), [
    (100.0, 4.285, 2.324435e-3, (-0.265847, -0.322854, -0.210815)),
    (150.0, 0.1093, 1.941098e-3, (-0.440433, -0.513854, -0.348020)),
])  # fmt: skip
def test_rendezvous_numbers(horizon: float, distance: float, expected: float, first: tuple[float, ...]) -> None:
    problem = clohessy_wiltshire(horizon=horizon)
    table = timetable(problem, "extend")
    flight = fly(problem, gain_schedule(Planner(problem, solver(), Passes(1)), table), table, problem.initial)
    unit = problem.plant.states["r1"].size, problem.plant.controls["a1"].size
    assert float(flight.states[-1, :3].norm()) / unit[0] == pytest.approx(distance, rel=5e-4)
    assert float(flight.cost) == pytest.approx(expected, rel=1e-6)
    assert (flight.controls[0] / unit[1]).tolist() == pytest.approx(first, abs=1e-6)
    assert flight.loss.max() < 1e-13


def test_quadrotor_costs() -> None:
    problem = quadrotor()
    table = timetable(problem, "stop")
    assert len(table.starts) == 290
    schedule = gain_schedule(Planner(problem, solver(), Passes(1)), table)
    flight = fly(problem, schedule, table, problem.initial)
    assert float(flight.cost) == pytest.approx(32323.233, abs=2e-3)
    assert not flight.late.any()
    assert flight.saturated == 0.0


@pytest.mark.parametrize("name", PROBLEMS)
def test_schedule_is_planning_with_one_pass(name: str) -> None:
    problem = PROBLEMS[name]()
    planner, table = Planner(problem, solver(), Passes(1)), short(timetable(problem, "shrink"), 6)
    ways = [gain_schedule(planner, table), HorizonController(planner, table)]
    planned, scheduled = (fly(problem, way, table, problem.initial) for way in ways)
    assert relative(scheduled.controls, planned.controls) < 1e-11
    assert relative(scheduled.states, planned.states) < 1e-13


def test_vehicles_fly_together_as_alone() -> None:
    problem = shuttle()
    table = short(timetable(problem, "stop"), 30)
    starts = problem.disperse(4, torch.Generator().manual_seed(1))
    planner = Planner(problem, solver(), Passes(1))
    together = fly(problem, gain_schedule(planner, table), table, starts)
    alone = fly(problem, HorizonController(planner, table), table, starts[2])
    assert together.states.shape == (31, 4, 3)
    assert relative(together.states[:, 2], alone.states) < 1e-12
    assert relative(together.cost[2], alone.cost) < 1e-12
    assert together.limits()["heat rate"].shape == (30, 4)
    within = (starts - problem.reference(starts.new_zeros(()))[0]).abs() <= problem.dispersion
    assert bool(within.all())


def test_shuttle_settles_on_its_reference() -> None:
    problem = shuttle()
    table = timetable(problem, "stop")
    assert len(table.starts) == 2082
    table = short(table, 600)
    starts = problem.disperse(8, torch.Generator().manual_seed(0))
    flight = fly(problem, gain_schedule(Planner(problem, solver(), Passes(1)), table), table, starts)
    units = starts.new_tensor([unit.size for unit in problem.plant.states.values()])
    worst = (flight.errors[-1] / units).abs().amax(0)
    assert worst[0] < 1.0  # m, from 300
    assert worst[1] < 0.02  # m/s, from 20
    assert flight.limits()["dynamic pressure"].max() < 1.0


# -- references and plants ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["quadrotor", "shuttle"])
def test_references_obey_the_plants_dynamics(name: str) -> None:
    problem = PROBLEMS[name]()
    reference = problem.reference
    assert isinstance(reference, PiecewiseReference)
    d = reference.degree
    interval = 3
    points = reference.times[interval * d : interval * d + d + 1]
    inner = points[1:-1]  # the polynomials satisfy the equations at their own points
    states, controls = reference(inner)
    assert relative(states, reference.states[interval * d + 1 : interval * d + d]) < 1e-12
    assert relative(controls, reference.controls[interval * d : interval * d + d - 1]) < 1e-12
    step = 1e-4 * float(points[-1] - points[0])
    slope = (reference(inner + step)[0] - reference(inner - step)[0]) / (2 * step)
    assert relative(slope, problem.plant.dynamics(inner, *reference(inner))) < 1e-8
    assert torch.equal(reference(points.new_tensor([1e9]))[0][0], reference.states[-1])


def test_runge_kutta_has_order_four() -> None:
    plant = Plant("clock", lambda t, x, u: x * u + torch.cos(t)[..., None], {"x": _NONE}, {"u": _NONE})
    x, u = torch.ones(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    # ẋ = x + cos t from 1 at t = 0: x = 3/2 eᵗ + (sin t − cos t)/2
    truth = 1.5 * math.e + 0.5 * (math.sin(1.0) - math.cos(1.0))
    errors = [abs(float(plant.fly(0.0, x, u, 1.0, n)) - truth) for n in (10, 20)]
    assert 14 < errors[0] / errors[1] < 18


# -- deadlines, noise, ends --------------------------------------------------------------------------


class Clock:
    """A clock by which the decisions of some cycles take long."""

    def __init__(self, slow: set[int]) -> None:
        self.slow, self.calls, self.now = slow, 0, 0.0

    def __call__(self) -> float:
        cycle, end = divmod(self.calls, 2)
        self.calls += 1
        self.now += (1.0 if cycle in self.slow else 0.001) * end
        return self.now


def test_late_decisions_are_replaced_by_the_last_plan_in_time() -> None:
    problem = quadrotor()
    table = short(timetable(problem, "stop"), 6)
    controller = HorizonController(Planner(problem, solver(), Passes(1)), table)
    flight = fly(problem, controller, table, problem.initial, Loop(deadline=0.01), clock=Clock({0, 3, 4}))
    assert flight.late.tolist() == [True, False, False, True, True, False]
    assert flight.n_late == 3
    reference = problem.reference(torch.zeros(1, dtype=torch.float64))[1][0]
    assert torch.equal(flight.controls[0], reference)  # no plan yet
    plan = Planner(problem, solver(), Passes(1)).plan(table.starts[2], flight.states[2])
    for cycle in (3, 4):
        foreseen = plan.at(torch.tensor([table.starts[cycle]], dtype=torch.float64))[2][0]
        assert relative(flight.controls[cycle], foreseen) < 1e-12
    assert flight.seconds.tolist() == pytest.approx([1.0, 0.001, 0.001, 1.0, 1.0, 0.001])


class Broken:
    """Decides nonsense in one cycle, and is interrupted in another."""

    def __init__(self, nonsense: int, interrupted: int = -1) -> None:
        self.nonsense, self.interrupted = nonsense, interrupted

    def decide(self, cycle: int, x: Tensor) -> Decision:
        if cycle == self.interrupted:
            raise KeyboardInterrupt
        return Decision(x.new_full((2,), torch.nan if cycle == self.nonsense else 10.0), x.new_zeros(()))


def test_nonsense_does_not_reach_the_plant() -> None:
    problem = quadrotor()
    flight = fly(problem, Broken(2), short(timetable(problem, "stop"), 4), problem.initial)
    assert flight.late.tolist() == [False, False, True, False]
    assert flight.states.isfinite().all()


def test_an_interrupted_loop_returns_what_was_flown() -> None:
    problem = quadrotor()
    records: list[dict[str, object]] = []
    table = timetable(problem, "stop")
    flight = fly(problem, Broken(-1, 3), table, problem.initial, on_cycle=lambda r: records.append(dict(r)))
    assert not flight.completed
    assert flight.n_cycles == 3
    assert flight.states.shape == (4, 6)
    assert [record["cycle"] for record in records] == [0, 1, 2]
    nothing = fly(problem, Broken(-1, 0), table, problem.initial)
    assert (nothing.n_cycles, nothing.states.shape) == (0, (1, 6))


def test_actuators_reach_and_noise() -> None:
    problem = quadrotor(lower=(8.0, -5.0), upper=(12.0, 5.0))
    table = short(timetable(problem, "stop"), 5)
    controller = HorizonController(Planner(problem, solver(), Passes(1)), table)
    flight = fly(problem, controller, table, problem.initial)
    assert flight.controls[0].tolist() == [12.0, 5.0]
    assert flight.commands[0, 1] > 16.0
    assert flight.saturated == 1.0
    free = fly(problem, controller, table, problem.initial, Loop(saturate=False))
    assert torch.equal(free.controls, free.commands)
    loop = Loop(noise=(0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    noisy = [
        fly(problem, controller, table, problem.initial, loop, generator=torch.Generator().manual_seed(seed))
        for seed in (1, 1, 2)
    ]
    assert torch.equal(noisy[0].measured, noisy[1].measured)
    assert not torch.equal(noisy[0].measured, noisy[2].measured)
    assert torch.equal(noisy[0].measured[:, 1:], noisy[0].states[:-1, 1:])
    assert 0.0 < (noisy[0].measured - noisy[0].states[:-1])[:, 0].abs().max() < 0.5


def test_what_flies_need_not_be_what_is_planned_with() -> None:
    problem = quadrotor()
    table = short(timetable(problem, "stop"), 5)
    controller = HorizonController(Planner(problem, solver(), Passes(1)), table)
    weak = replace(problem.plant, dynamics=lambda t, x, u: problem.plant.dynamics(t, x, 0.9 * u))
    flight = fly(problem, controller, table, problem.initial, plant=weak)
    expected = problem.plant.fly(0.0, problem.initial, 0.9 * flight.controls[0], problem.cycle, 2)
    assert relative(flight.states[1], expected) < 1e-14


def test_endings() -> None:
    problem = clohessy_wiltshire(horizon=300.0)
    second = problem.plant.time.size
    stop, shrink, extend = (timetable(problem, ending) for ending in ("stop", "shrink", "extend"))
    assert [len(table.starts) for table in (stop, shrink, extend)] == [170, 200, 200]
    assert stop.starts[-1] + stop.durations[-1] == pytest.approx(1990.0 * second)
    assert shrink.durations[-1] == pytest.approx(10.0 * second)
    assert min(extend.durations) == problem.horizon
    with pytest.raises(ValueError, match=r"ending = 'stopp'; allowed: stop, shrink, extend .did you mean 'stop'"):
        timetable(problem, "stopp")
    with pytest.raises(ValueError, match=r"horizon = 2000 s with ending 'stop'; allowed: at most .* 1990"):
        timetable(clohessy_wiltshire(horizon=2000.0), "stop")


_NONE = clohessy_wiltshire().plant.states["r1"]


def test_wrong_settings_are_named() -> None:
    for wrong, text in (
        ({"n_substeps": 0}, "n_substeps = 0; allowed: at least 1"),
        ({"deadline": 0.0}, "deadline = 0.0; allowed: above 0 s"),
        ({"noise": (-1.0,)}, r"noise = \[-1.0\]; allowed: at least 0 each"),
    ):
        with pytest.raises(ValueError, match=text):
            Loop(**wrong)
    problem, table = quadrotor(), Timetable([0.0], [3.0])
    with pytest.raises(ValueError, match=r"noise = \[0.1\]; allowed: one per state, x, z"):
        fly(problem, Broken(-1), table, problem.initial, Loop(noise=(0.1,)))
    with pytest.raises(ValueError, match=r"most = 10 with a gain schedule of quadrotor.*allowed: 1"):
        gain_schedule(Planner(problem, solver()), table)
    with pytest.raises(ValueError, match=r"lower = \(1.0,\); allowed: one per control, thrust, torque"):
        replace(problem.plant, lower=(1.0,))
    with pytest.raises(ValueError, match="dynamics of tank return shape"):
        Plant("tank", lambda t, x, u: x[..., :1], {"a": _NONE, "b": _NONE}, {"u": _NONE})
    with pytest.raises(ValueError, match="horizon = 5 s; allowed: at least one cycle, 10"):
        clohessy_wiltshire(horizon=5.0)
    with pytest.raises(ValueError, match=r"cycle = -10.*; allowed: above 0"):
        replace(problem, cycle=-10.0)
    with pytest.raises(ValueError, match="dispersion = None of quadrotor"):
        replace(problem, dispersion=None).disperse(3, torch.Generator())
    times = torch.zeros(5, dtype=torch.float64)
    with pytest.raises(ValueError, match="have 5, 5 and 5 points of degree 2; allowed"):
        PiecewiseReference(times, times[:, None], times[:, None], 2)


def test_a_setpoint_is_the_same_for_all_times() -> None:
    state, control = torch.ones(3), torch.zeros(2)
    states, controls = Setpoint(state, control)(torch.zeros(4, 5))
    assert (states.shape, controls.shape) == ((4, 5, 3), (4, 5, 2))


def test_problem_types() -> None:
    for name, make in PROBLEMS.items():
        problem = make()
        assert isinstance(problem, TrackingProblem)
        assert problem.plant.name == name
        assert problem.description
