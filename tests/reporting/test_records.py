"""Records: event files and records.jsonl, read back, are alike for every optimiser and outlive a crash."""

import io
import json
import math

import pytest
from conftest import small
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import plugin_data_pb2

from ponn_torch.optim.base import Status, Stopping
from ponn_torch.optim.least_squares import LevenbergMarquardt
from ponn_torch.optim.scipy_least_squares import ScipyLeastSquares
from ponn_torch.problems.mars_landing import mars_landing
from ponn_torch.reporting.records import RECORDS, RunRecorder
from ponn_torch.solving.result import StageResult

STOPPING = Stopping(tolerance=1e-6, decrease=1e-3, max_iterations=60)
OPTIMIZERS = {"lm": LevenbergMarquardt(STOPPING), "scipy": ScipyLeastSquares("trf", STOPPING)}
SETTINGS = {
    "problem": "mars_landing",
    "optimizer": {"damping": 1e-3, "geodesic": False},
    "seed": 0,
    "none": None,
}


def lines(folder):
    return [json.loads(line) for line in (folder / RECORDS).read_text().splitlines()]


def events(folder):
    accumulator = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0, "tensors": 0})
    accumulator.Reload()
    return accumulator


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """optimiser → (folder, SolveResult) of a recorded solve."""
    out = {}
    for name, optimizer in OPTIMIZERS.items():
        folder = tmp_path_factory.mktemp(name)
        with RunRecorder(
            folder, settings=SETTINGS, cost_name="fuel", cost_every=5, console=Console(file=io.StringIO())
        ) as recorder:
            solver = small(optimizer=optimizer)
            out[name] = (folder, solver.solve(mars_landing(), observer=recorder))
        assert out[name][1].certificate is not None, out[name][1].message
    return out


def test_tags_do_not_depend_on_the_optimiser(runs):
    tags = {name: events(folder).Tags() for name, (folder, _) in runs.items()}
    assert tags["lm"]["scalars"]
    for sort in ("scalars", "images", "tensors"):
        assert set(tags["lm"][sort]) == set(tags["scipy"][sort])
    assert {
        "residual/total", "residual/v_1", "residual/m", "residual/lambda_m", "optim/damping", "optim/step",
        "optim/accepted", "stage/smoothing", "cost/fuel", "certificate/certified", "time/seconds",
        "time/cpu_seconds", "residual/log10_total",
    } <= set(tags["lm"]["scalars"])  # fmt: skip


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_scalars_are_the_records(runs, name):
    folder, result = runs[name]
    accumulator, records = events(folder), [r for stage in result.stages for r in stage.records]
    total = accumulator.Scalars("residual/total")
    assert [e.step for e in total] == list(range(1, len(records) + 1))
    assert [e.value for e in total] == pytest.approx([r["norm"] for r in records], rel=1e-6)
    assert {e.value for e in accumulator.Scalars("stage/smoothing")} == {1.0}
    cost = accumulator.Scalars("cost/fuel")
    assert cost[-1].value == pytest.approx(result.solution.cost, rel=1e-6)
    assert [e.step for e in cost if e.step % 5 == 0][:1] == [5]
    assert accumulator.Scalars("certificate/certified")[-1].value == float(result.certificate.certified)


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_one_run_with_its_hyperparameters_and_a_figure(runs, name):
    folder, _ = runs[name]
    assert len(list(folder.rglob("events.out.tfevents.*"))) == 1  # no ghost run for the hyperparameters
    accumulator = events(folder)
    plugin = accumulator.PluginTagToContent("hparams")
    assert set(plugin) == {
        "_hparams_/experiment", "_hparams_/session_start_info", "_hparams_/session_end_info"
    }  # fmt: skip
    started = plugin_data_pb2.HParamsPluginData.FromString(plugin["_hparams_/session_start_info"])
    values = started.session_start_info.hparams
    assert set(values) == {"problem", "optimizer.damping", "optimizer.geodesic", "seed"}
    assert values["optimizer.damping"].number_value == 1e-3
    assert values["optimizer.geodesic"].string_value == "False"
    metrics = plugin_data_pb2.HParamsPluginData.FromString(plugin["_hparams_/experiment"]).experiment.metric_infos
    assert {metric.name.tag for metric in metrics} <= set(accumulator.Tags()["scalars"])
    (image,) = accumulator.Images("stage/control")
    assert image.encoded_image_string.startswith(b"\x89PNG")
    assert (image.width, image.height) > (300, 200)


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_records_hold_every_iteration_and_stage(runs, name):
    folder, result = runs[name]
    written = lines(folder)
    iterations = [line for line in written if line["event"] == "iteration"]
    stages = [line for line in written if line["event"] == "stage"]
    assert [line["global_step"] for line in iterations] == list(range(1, len(iterations) + 1))
    assert len(iterations) == sum(stage.n_iterations for stage in result.stages)
    assert [line["norm"] for line in stages] == [stage.norm for stage in result.stages]
    assert stages[-1]["status"] in Status.__members__
    assert set(iterations[0]["residual"]) >= {"v_1", "m", "lambda_m"}
    assert [line["global_step"] for line in iterations if "cost" in line] == [
        k for k in range(1, len(iterations) + 1) if k % 5 == 0
    ]
    norm = math.sqrt(sum(value**2 for value in iterations[-1]["residual"].values()))
    assert norm == pytest.approx(iterations[-1]["norm"], rel=1e-9) or not iterations[-1]["accepted"]
    certificate = [line for line in written if line["event"] == "certificate"]
    assert [line["certified"] for line in certificate] == [result.certificate.certified]


def test_a_run_without_a_certificate_can_be_ranked(tmp_path):
    with RunRecorder(tmp_path, cost_name="fuel", progress=False) as recorder:
        result = small(start_limit=1e-300).solve(mars_landing(), observer=recorder)
    assert result.certificate is None
    scalars = {tag: events(tmp_path).Scalars(tag)[-1].value for tag in ("certificate/certified", "certificate/cost")}
    reached = result.stages[-1].cost
    assert scalars == {"certificate/certified": 0.0, "certificate/cost": pytest.approx(reached, rel=1e-6)}
    assert math.isfinite(reached)


class Seen:
    """A look whose answers are given, and which notes what it was asked."""

    def __init__(self, blocks, cost, asked=None):
        self._blocks, self._cost, self._asked = blocks, cost, [] if asked is None else asked

    def blocks(self):
        self._asked.append("blocks")
        return self._blocks

    def cost(self):
        self._asked.append("cost")
        return self._cost

    def curve(self):
        raise AssertionError("nobody needs the curve")


def record(norm=1.0, **more):
    return {"iteration": 1, "norm": norm, "accepted": True, **more}


def test_an_interrupted_run_keeps_all_it_had(tmp_path):
    recorder = RunRecorder(tmp_path, tensorboard=False, progress=False)
    recorder.stage_started("smooth", 1.0, 0)
    recorder.iteration(record(), Seen({"r": 2.0}, 3.0))
    # nothing was closed or flushed by hand
    assert [line["event"] for line in lines(tmp_path)] == ["stage_started", "iteration"]
    recorder.close()
    recorder.close()


def test_what_is_costly_is_evaluated_once_and_only_when_due(tmp_path):
    calls = []
    with RunRecorder(tmp_path, progress=False, cost_every=2, figures=False) as recorder:
        for _ in range(4):
            recorder.iteration(record(), Seen({}, 1.0, calls))
    assert (calls.count("blocks"), calls.count("cost")) == (4, 2)
    with pytest.raises(ValueError, match="cost_every = -1"):
        RunRecorder(tmp_path, cost_every=-1)


def test_numbers_that_are_not_finite_stay_valid_json(tmp_path):
    stage = StageResult("split", None, Status.MAX_ITERATIONS, math.inf, 1, 1, 1, 0.0, math.nan, math.nan)
    with RunRecorder(tmp_path, progress=False, figures=False) as recorder:
        recorder.iteration(record(norm=math.nan), Seen({"r": math.inf}, math.nan))
        recorder.stage_ended(stage)
        recorder.failed("no start led to a solution")
    iteration, ended, failure = lines(tmp_path)
    assert (iteration["norm"], iteration["residual"]) == (None, {"r": None})
    assert (ended["norm"], ended["cost"], ended["status"]) == (None, None, "MAX_ITERATIONS")
    assert failure == {"event": "failure", "reason": "no start led to a solution"}
    plugin = events(tmp_path).PluginTagToContent("hparams")
    assert "_hparams_/session_end_info" not in plugin  # a failed run does not claim success


def test_away_from_a_terminal_progress_is_a_line_per_stage(tmp_path, solved):
    stream = io.StringIO()
    result = solved("split")
    with RunRecorder(tmp_path, tensorboard=False, console=Console(file=stream, width=200)) as recorder:
        recorder.stage_started("smooth", 1.0, 0)
        recorder.iteration(record(), Seen({}, 1.0))
        for stage in result.stages:
            recorder.stage_ended(stage)
        recorder.certificate(result.certificate)
    printed = stream.getvalue().splitlines()
    assert len(printed) == len(result.stages) + 1
    assert "ρ 1" in printed[0]
    assert printed[-1] == result.certificate.verdict
    assert "\x1b" not in stream.getvalue()


def test_on_a_terminal_progress_is_live(tmp_path):
    stream = io.StringIO()
    console = Console(file=stream, width=120, force_terminal=True)
    with RunRecorder(tmp_path, tensorboard=False, console=console, cost_every=1) as recorder:
        recorder.iteration(record(norm=0.25), Seen({}, 268.5))
    assert "‖r‖ 2.50e-01" in stream.getvalue()
    assert "268.5" in stream.getvalue()
