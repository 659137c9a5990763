"""The setpoint loop's exported readers against the networks and the filter that they stand for."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

from pipeline.commands import export
from pipeline.deploy import flow_filter as filter_reader
from pipeline.deploy import flow_reader, to_setpoint
from pipeline.setpoint.agents import flow_filter
from pipeline.setpoint.frames.familiar import NAMES
from pipeline.setpoint.published import FLOW_MOVES
from pipeline.setpoint.simulation.simulator import TEMPERATURE_LIMITS
from pipeline.setpoint.vision import classifier, window_flow
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier
from pipeline.setpoint.vision.calibration import ClassifierCalibration, Familiar
from pipeline.setpoint.vision.proof import CameraProof
from pipeline.setpoint.vision.vision_transformer import SMALL, vision_transformer
from pipeline.setpoint.vision.window_flow import KNOTS_PERCENT, FlowCalibration
from pipeline.store import artifacts
from tests.setpoint.test_flow_filter import fitted, plain, seen, sure

PROVEN = CameraProof(0.9, 0.8, 0.6, 400, 40, 400, False)
WINDOWS, FRAMES = 1000, 2
FEATURES = 114  # of the last layer
# float32 through two layers: the sums are taken in another order
SINGLE = 1e-5


@pytest.fixture(scope="module")
def model() -> CalibratedClassifier:
    knots = np.log(np.array(KNOTS_PERCENT) / 100)
    measures = np.linspace(1.0, 2.0, len(NAMES))
    looks = window_flow.LookCorrection(measures, measures / 10, 0.02 * np.sin(10 * measures), 0.05)
    flow = FlowCalibration(0.8 * knots + 0.02, np.linspace(0.8, 1.4, len(knots)), 0.3, looks)
    familiar = Familiar(np.zeros((3, FEATURES)), np.eye(FEATURES))
    network = vision_transformer(SMALL, np.random.default_rng(1))
    return CalibratedClassifier(network, ClassifierCalibration(1.3, familiar, 9.0, flow, PROVEN))


def written(model: CalibratedClassifier, folder: Path) -> tuple[dict, dict]:
    """Both files, read by the exported reader."""
    to_setpoint.write(folder, to_setpoint.weights(model, fitted()))
    files = ("classifier.safetensors", "filter.safetensors")
    first, second = (flow_reader.read_safetensors(folder / name) for name in files)
    return first, second


def test_of_a_camera_that_cannot_be_judged_nothing_is_exported_and_it_is_said_why(model, tmp_path):
    unproven = model.calibration._replace(proof=PROVEN._replace(low=0.5))
    said = to_setpoint.write_checked(tmp_path, "Bayes", model._replace(calibration=unproven), fitted(), 1)
    assert not said["measured"] and said["why"].startswith(
        "The classifier cannot judge this camera: right in 90 %"
    )
    assert not list(tmp_path.iterdir())
    assert to_setpoint.write_checked(tmp_path, "Bayes", model, fitted(), 1)["measured"]


def test_a_thousand_windows_read_as_by_the_network(model, tmp_path):
    rng, n = np.random.default_rng(2), WINDOWS * FRAMES
    profile = 60 * np.exp(-(((np.arange(16) - 8) / rng.uniform(1, 6, n)[:, None]) ** 2))
    areas = np.clip(rng.normal(100, 20, (n, 16, 48)) + profile[:, :, None], 0, 255).astype(np.uint8)
    temperature = rng.uniform(180, 240, n)
    weights = written(model, tmp_path)[0]
    theirs = classifier.predict(model.network, areas, temperature)
    logits, log_flow, deviation = flow_reader.outputs(weights, areas, temperature)
    for one, other in ((logits, theirs.logits), (log_flow, theirs.log_flow), (deviation, theirs.deviation)):
        assert np.abs(one - other).max() < SINGLE
    frames = (theirs.log_flow.astype(float), theirs.deviation.astype(float))
    log_flow, deviation = (part.reshape(WINDOWS, FRAMES) for part in frames)
    looks = rng.normal(1.5, 0.5, (WINDOWS, len(NAMES)))
    looks[::3] = np.nan
    valid = np.ones_like(log_flow, bool)
    seen = window_flow.window_flow(log_flow, deviation, valid, looks, model.calibration.flow)
    for i in range(WINDOWS):
        known = None if i % 6 == 0 else looks[i]
        flow, spread, prob = flow_reader.window(weights, log_flow[i], deviation[i], known)
        # doubles: the same formulas, with erfc in place of ndtr
        assert np.allclose((flow, spread), (seen.flow_seen[i], seen.spread[i]), rtol=1e-12)
        assert np.allclose(prob, seen.prob[i], atol=1e-12)


def test_the_filter_believes_and_moves_as_the_filter(model, tmp_path):
    """200 windows after one another, every third a class only, of which the moves are carried out."""
    tables, of = written(model, tmp_path)[1], fitted()
    step, losses = jax.jit(flow_filter.update), jax.jit(flow_filter.expected_loss)
    belief = flow_filter.flow_filter(len(of.gains), len(of.bias)).start()
    rng, mine, move = np.random.default_rng(3), filter_reader.start(tables), 0.0
    for t in range(200):
        named, flow = int(rng.integers(3)), float(rng.uniform(40, 180)) if t % 3 else np.nan
        belief = step(of, belief, seen(named, flow=flow, move=move))
        mine = filter_reader.update(tables, mine, named, flow, move)
        assert np.abs(np.asarray(belief) - mine).max() < SINGLE
        loss = np.asarray(losses(of, belief, move))
        mine_now = filter_reader.move(tables, mine, move)
        move = float(FLOW_MOVES[int(loss.argmin())])
        # where two moves cost the same in single precision either is best
        assert mine_now == move or np.diff(np.sort(loss)[:2]) < 1e-3


def test_a_correction_that_goes_on_has_paid_its_fixed_cost():
    """Two steps of a correction cost move_fixed_cost once: with a belief between, only what goes on moves."""
    of, belief = plain(move_fixed_cost=8.0), sure(95.0)
    tables = to_setpoint.filter_arrays(of)
    for last, expected in ((0.0, 0.0), (-5.0, 0.0), (5.0, 5.0)):
        loss = flow_filter.expected_loss(of, belief, last)
        mine = filter_reader.move(tables, np.asarray(belief), last)
        assert FLOW_MOVES[int(loss.argmin())] == mine == expected


def test_the_readers_need_numpy_and_the_language_only():
    for _, reader in to_setpoint.FILES.values():
        text = Path(str(reader.__file__)).read_text(encoding="utf-8")
        assert set(re.findall(r"^(?:import|from) (\w+)", text, re.M)) <= {"json", "math", "numpy"}


def test_from_key_areas_on_the_filter_decides_as_exported(model, tmp_path):
    """2,000 windows of two frames each, one after the other: the networks and the filter here; the exported
    files there, with readers that know numpy alone. Only what was sent is shared."""
    w, f = written(model, tmp_path)
    rng, n, of = np.random.default_rng(6), 2000, fitted()
    profile = 60 * np.exp(-(((np.arange(16) - 8) / rng.uniform(1, 6, n * FRAMES)[:, None]) ** 2))
    areas = np.clip(rng.normal(100, 20, (n * FRAMES, 16, 48)) + profile[:, :, None], 0, 255).astype(np.uint8)
    temperature = rng.uniform(*TEMPERATURE_LIMITS, n * FRAMES)
    theirs = classifier.predict(model.network, areas, temperature)
    frames = [part.reshape(n, FRAMES).astype(float) for part in (theirs.log_flow, theirs.deviation)]
    # an untrained network calls every window alike: what it says is spread over all flows
    spread = 15.0
    frames[0] = spread * (frames[0] - theirs.log_flow.mean())
    valid, unknown = np.ones((n, FRAMES), bool), np.full((n, len(NAMES)), np.nan)
    shown = window_flow.window_flow(*frames, valid, unknown, model.calibration.flow)
    _, log_flow, deviation = flow_reader.outputs(w, areas, temperature)
    log_flow = spread * (log_flow - theirs.log_flow.mean())
    step, losses = jax.jit(flow_filter.update), jax.jit(flow_filter.expected_loss)
    belief = flow_filter.flow_filter(len(of.gains), len(of.bias)).start()
    mine, last, other, moved = filter_reader.start(f), 0.0, 0, 0
    for i in range(n):
        rows = slice(FRAMES * i, FRAMES * (i + 1))
        flow, _, prob = flow_reader.window(w, log_flow[rows], deviation[rows])
        mine = filter_reader.update(f, mine, int(prob.argmax()), flow, last)
        belief = step(of, belief, seen(int(shown.prob[i].argmax()), flow=shown.flow_seen[i], move=last))
        move = FLOW_MOVES[int(np.asarray(losses(of, belief, last)).argmin())]
        other += filter_reader.move(f, mine, last) != move
        moved += move != 0
        last = move
    assert moved > n / 20
    assert other <= n / 200  # where two moves cost the same in single precision


def test_the_stage_exports_a_filter_and_nothing_else(model, tmp_path):
    made = {
        name: to_setpoint.write_checked(tmp_path / name, name, model, parameters, 1)
        for name, parameters in (("Bayes filter", fitted()), ("do nothing", ()))
    }
    assert made["Bayes filter"]["largest_difference"]["log_flow"] < SINGLE
    assert {path.name for path in (tmp_path / "Bayes filter").iterdir()} == FILES
    assert not (tmp_path / "do nothing").exists() and "has no filter" in made["do nothing"]["why"]


FILES = {"classifier.safetensors", "flow_reader.py", "filter.safetensors", "flow_filter.py"}


def test_the_command_exports_the_folder_of_the_stage(model, tmp_path):
    to_setpoint.write(tmp_path / "made", to_setpoint.weights(model, fitted()))
    told = export.export(tmp_path / "made", "python", tmp_path / "out")
    assert told.startswith("classifier, filter. It has no certificate")
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    for name in FILES:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "made" / name).read_bytes()
    with pytest.raises(ValueError, match="run in Python alone, found --to c; write --to python"):
        export.export(tmp_path / "made", "c", None)
    artifacts.write_text(tmp_path / "made" / "filter.safetensors", "broken")
    with pytest.raises(ValueError, match=r"filter.safetensors holds no whole weights"):
        export.export(tmp_path / "made", "python", None)
