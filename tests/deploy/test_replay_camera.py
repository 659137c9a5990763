"""Recorded frames are replayed by the loop that was judged, and by no other: rendered pictures of the nozzle
go through `beadline replay`, with a rule on the bead's width in the place of the network that sees them."""

import functools
import json
import sys

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from pipeline import cli
from pipeline.commands import replay_camera
from pipeline.commands.shadow import deploy
from pipeline.deploy import to_setpoint
from pipeline.recordings.nozzle_frames import Topics
from pipeline.setpoint.agents import baselines
from pipeline.setpoint.frames import nozzle_scene
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier
from pipeline.setpoint.vision.calibration import ClassifierCalibration, Familiar
from pipeline.setpoint.vision.vision_transformer import SMALL, vision_transformer
from pipeline.setpoint.vision.window_flow import KNOTS_PERCENT, FlowCalibration
from pipeline.store import artifacts
from tests.setpoint.test_shadow import FRAMES, PROVEN, deployed

NARROW, WINDOWS = 55.0, 3


@functools.cache
def trained() -> deploy.TrainedClassifier:
    knots = np.log(np.array(KNOTS_PERCENT) / 100)
    flow = FlowCalibration(knots, np.ones(len(knots)), 0.5)
    network = vision_transformer(SMALL, np.random.default_rng(1))
    fitted = ClassifierCalibration(1.3, Familiar(np.zeros((3, 2)), np.eye(2)), 9.0, flow, PROVEN)
    return deploy.TrainedClassifier(CalibratedClassifier(network, fitted), "", None)  # ty: ignore[invalid-argument-type]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A controller's folder as export_controllers writes it, of the loop that was judged."""
    judged = deployed()

    def ready(levels):
        assert levels is None, "levels of a camera were not exported"
        return deploy.Ready(judged, Topics(image="", time="", mapping={}), None)

    monkeypatch.setattr(deploy, "ready", ready)
    monkeypatch.setattr(deploy, "trained", trained)
    to_setpoint.write(tmp_path / "setpoint", to_setpoint.weights(trained().model, judged.parameters))
    return tmp_path / "setpoint"


def frames(path) -> tuple[float, float]:
    """A print of too little flow, from the tip on; the tip as train_classifier.tip_px has it."""
    rng = np.random.default_rng(4)
    n = WINDOWS * FRAMES
    shown = nozzle_scene.render(nozzle_scene.draw_segment(rng), np.full(n, NARROW), np.full(n, 210.0), rng)
    path.mkdir()
    for k, frame in enumerate(shown.frames):
        cv2.imwrite(str(path / f"f{k:03d}.png"), frame)
    return float(shown.tip[0]), float(shown.tip[1])


def test_a_folder_of_frames_is_decided_window_by_window(folder, tmp_path, monkeypatch, capsys):
    tip, ready = frames(tmp_path / "frames"), deploy.ready
    monkeypatch.setattr(deploy, "ready", lambda levels: ready(levels)._replace(tip=tip))
    words = ["replay", folder, tmp_path / "frames", "--out", tmp_path / "out"]
    monkeypatch.setattr(sys, "argv", ["beadline", *map(str, words)])
    cli.main()
    assert f"{WINDOWS} decisions" in capsys.readouterr().out
    with next((tmp_path / "out").glob("decisions-*.mcap")).open("rb") as stream:
        rows = [json.loads(message.data) for _, _, message in make_reader(stream).iter_messages()]
    assert len(rows) == WINDOWS
    assert [len(row["frames"]) for row in rows] == [FRAMES] * WINDOWS
    assert "index.html" in {path.name for path in (tmp_path / "out").iterdir()}


@pytest.mark.parametrize(
    ("file", "array"), [("classifier.safetensors", "flow_scale"), ("filter.safetensors", "jump")]
)
def test_numbers_that_were_not_judged_are_refused_by_name(folder, file, array):
    replay_camera.ready(folder)
    schema = {"classifier.safetensors": "flow classifier 1", "filter.safetensors": "flow filter 2"}[file]
    arrays, about = artifacts.read_weights(folder / file, schema)
    changed = arrays[array].copy()
    changed.flat[0] = np.nextafter(changed.flat[0], 2)
    artifacts.write_weights(folder / file, schema, arrays | {array: changed}, about)
    with pytest.raises(ValueError, match=f"{file}: expected the numbers that .* found others in {array}"):
        replay_camera.ready(folder)
    artifacts.write_weights(folder / file, schema, {k: v for k, v in arrays.items() if k != array}, about)
    with pytest.raises(ValueError, match=f"found others in {array}"):
        replay_camera.ready(folder)


def test_a_default_without_a_filter_is_not_replayed(folder, monkeypatch):
    judged = deploy.Ready(
        deployed(name="do nothing", controller=baselines.nothing(), parameters=()), None, None
    )
    monkeypatch.setattr(deploy, "ready", lambda levels: judged)
    with pytest.raises(ValueError, match="expected a controller with a filter, found 'do nothing'"):
        replay_camera.ready(folder)
