"""`beadline shadow` and `beadline calibrate levels` as a person types them, on what the stages leave
behind."""

import contextlib
import json
import shutil
import sys
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from mcap.reader import make_reader

from pipeline import cli
from pipeline.commands import shadow
from pipeline.commands.levels_files import LEVELS_FILE, RecordedLevels, store_levels
from pipeline.setpoint.agents.agent import QNetwork
from pipeline.setpoint.agents.files import store_published
from pipeline.setpoint.frames.files import CAMERA_FILE, store_camera
from pipeline.setpoint.levels import Levels, LevelWindows
from pipeline.setpoint.settings import TrainClassifier
from pipeline.setpoint.simulation.recorded import window_rows
from pipeline.setpoint.tables import WINDOW_PARTS, WINDOWS
from pipeline.setpoint.vision import calibration
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier
from pipeline.setpoint.vision.calibration import ClassifierCalibration, Familiar
from pipeline.setpoint.vision.files import restore_classifier, store_classifier
from pipeline.setpoint.vision.vision_transformer import SMALL, vision_transformer
from pipeline.setpoint.vision.window_flow import KNOTS_PERCENT, FlowCalibration
from pipeline.store import artifacts, params
from tests.setpoint.synthetic import synthetic_flow_table
from tests.setpoint.test_shadow import ANY_CAMERA, PROVEN, TIP, picture

ROOT = Path(__file__).resolve().parents[2]
DONE = shadow.Watched(0, 0, 0, 0, Path("index.html"), Path("decisions.mcap"))


@pytest.fixture
def command(tmp_path, monkeypatch, capfd):
    """command("shadow", ...): status, what was printed, and what was said of errors."""
    monkeypatch.chdir(tmp_path)
    for name in (params.FILE, params.EXPERT):
        Path(name).write_text((ROOT / name).read_text())

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["beadline", *arguments])
        status = 0
        try:
            cli.main()
        except SystemExit as ended:
            status = ended.code
        return status, *capfd.readouterr()

    return run


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A classifier that has learned nothing, made-up windows, agents that have learned nothing."""
    place = tmp_path_factory.mktemp("made")
    for name in (params.FILE, params.EXPERT):
        shutil.copy(ROOT / name, place)
    with contextlib.chdir(place):
        make()
    return place / "datasets"


@pytest.fixture
def trained(command, made) -> None:
    """What the stages leave behind, to be spoiled."""
    shutil.copytree(made, "datasets")


def make() -> None:
    folder = Path("datasets/train_classifier")
    network = vision_transformer(SMALL, np.random.default_rng(0))
    bands = calibration.appearance(np.zeros((1, 16, 48), np.uint8)).shape[1]
    features = network.head.classes.W.shape[0] + bands
    knots = np.log(np.array(KNOTS_PERCENT) / 100)
    known = ClassifierCalibration(
        1.0, Familiar(np.zeros((3, features)), np.eye(features)), 1e9,
        FlowCalibration(knots, np.ones(len(knots)), 0.5), PROVEN,
    )  # fmt: skip
    view = params.load(TrainClassifier, "train_classifier")
    store_classifier(folder, view.size, CalibratedClassifier(network, known))
    store_camera(folder / CAMERA_FILE, ANY_CAMERA)
    tables = {
        part: synthetic_flow_table(np.random.default_rng(1), segments=80, windows=3) for part in WINDOW_PARTS
    }
    artifacts.write_table(folder / "windows.parquet", WINDOWS, window_rows(tables))
    networks = tuple(QNetwork(key) for key in jax.random.split(jax.random.key(3), 4))
    store_published(Path("datasets/papers/train_agent/weights.safetensors"), networks)
    artifacts.write_json("datasets/evaluate_setpoint/choice.json", {"name": "Bayes filter"})


def camera(count: int) -> None:
    Path("in").mkdir()
    for k in range(count):
        cv2.imwrite(f"in/f{k}.png", picture(k, 6.0))


def change_settings(before: str, after: str) -> None:
    text = Path(params.FILE).read_text()
    assert text.count(before) == 1
    Path(params.FILE).write_text(text.replace(before, after))


def decisions() -> list[dict]:
    with Path("shadow/decisions-0000.mcap").open("rb") as stream:
        return [json.loads(message.data) for _, _, message in make_reader(stream).iter_messages()]


@pytest.mark.parametrize("count", [3, 45])
def test_pictures_none_of_which_can_be_read_end_the_watch_with_one_sentence(command, trained, count):
    Path("in").mkdir()
    for k in range(count):
        Path(f"in/f{k}.png").write_bytes(b"\x89PNG and no more")
    status, _, wrong = command("shadow", "in", "--once")
    assert status == 1 and wrong.count("\n") == 1
    assert wrong.startswith(f"beadline: in: none of {count} frames can be read: f")
    assert "a picture of 16 bytes without its end" in wrong
    # nothing is left of it, and what was there before stays
    assert not Path("shadow").exists()
    Path("shadow").mkdir()
    Path("shadow/index.html").write_text("of a good watch")
    command("shadow", "in", "--once")
    assert {path.name: path.read_text() for path in Path("shadow").iterdir()} == {
        "index.html": "of a good watch"
    }


def test_the_default_watches_a_folder(command, trained):
    camera(45)
    tip = f"{TIP[0]:g},{TIP[1]:g}"
    status, said, wrong = command("shadow", "in", "--once", "--tip", tip)
    assert (status, wrong) == (0, "")
    assert "in: 45 frames, 2 decisions" in said and "nothing was sent" in said
    assert len(decisions()) == 2 and decisions()[0]["flow_seen_percent"] > 0
    assert "Bayes filter" in Path("shadow/index.html").read_text()


@pytest.mark.parametrize(
    ("proof", "camera_known", "why"),
    [
        (PROVEN._replace(low=0.5), True, "50 % at least by its 90 % bound, 60 % required"),
        (PROVEN._replace(known_from=72), False, "but 72 windows do not tell it from other cameras, 200 do"),
    ],
    ids=["not right enough", "too few windows to know the camera"],
)
def test_a_camera_that_cannot_be_judged_is_held_and_the_first_line_says_why(
    command, trained, proof, camera_known, why
):
    folder = Path("datasets/train_classifier")
    model = restore_classifier(f"{folder}/weights.safetensors", f"{folder}/calibration.parquet")
    store_classifier(folder, "small", model._replace(calibration=model.calibration._replace(proof=proof)))
    store_camera(folder / CAMERA_FILE, ANY_CAMERA if camera_known else None)
    camera(45)
    status, said, wrong = command("shadow", "in", "--once", "--tip", f"{TIP[0]:g},{TIP[1]:g}")
    assert (status, wrong) == (0, "")
    first = said.splitlines()[0]
    assert first.startswith("in: cannot judge this camera: right in 90 % of 400 windows of 40 prints")
    assert why in first and first.endswith("everything is held")
    assert "2 decisions: 0 would have changed a setpoint, 2 held" in said
    assert {row["reason"] for row in decisions()} == {"cannot judge this camera"}
    assert "cannot judge this camera: right in 90 %" in Path("shadow/index.html").read_text()


def test_the_material_of_the_settings_is_what_is_watched(command, trained):
    camera(20)
    change_settings("good_flow_percent: [90, 110]", "good_flow_percent: [85, 120]")
    status, _, wrong = command("shadow", "in", "--once", "--tip", f"{TIP[0]:g},{TIP[1]:g}")
    assert (status, wrong) == (0, "")
    assert "inside 85 to 120 % with" in Path("shadow/index.html").read_text()


def test_a_source_without_a_temperature_prints_at_the_best_one_of_the_settings(command, trained, monkeypatch):
    given = []
    monkeypatch.setattr(shadow, "watch", lambda _source, _loop, asked, *_, **__: given.append(asked) or DONE)
    Path("in").mkdir()
    change_settings("best_temperature_degC: 210", "best_temperature_degC: 225")
    assert command("shadow", "in", "--once")[0] == 0
    assert command("shadow", "in", "--once", "--temperature", "215")[0] == 0
    assert [asked.temperature for asked in given] == [225, 215]


def test_levels_of_this_camera_are_used_and_those_of_another_classifier_are_not(command, trained):
    camera(20)
    knots = np.log(np.array([0.5, 2.0]))
    flow = np.repeat([60.0, 80.0, 100.0, 125.0, 160.0], 6)
    recorded = RecordedLevels(
        Levels(knots, knots + np.log(0.5), 1.0, 0.09, True),
        LevelWindows(2 * flow, flow),
        artifacts.sha256("datasets/train_classifier/weights.safetensors"),
        None,
        1e9,
    )
    tip = f"{TIP[0]:g},{TIP[1]:g}"
    assert command("shadow", "in", "--once", "--tip", tip)[0] == 0
    plain = decisions()[0]["flow_seen_percent"]
    Path("shadow/decisions-0000.mcap").unlink()
    store_levels(LEVELS_FILE, recorded)
    assert command("shadow", "in", "--once", "--tip", tip)[0] == 0
    assert decisions()[0]["flow_seen_percent"] == pytest.approx(plain / 2)
    assert decisions()[0]["spread"] == 0.09
    store_levels(LEVELS_FILE, recorded._replace(weights="cd" * 32))
    status, _, wrong = command("shadow", "in", "--once", "--tip", tip)
    assert status == 1 and "another classifier saw" in wrong and len(wrong.splitlines()) == 1


def test_a_classifier_that_learned_nothing_sees_no_flow(command, trained):
    camera(200)
    status, said, wrong = command(
        "calibrate", "levels", "in", "--tip", f"{TIP[0]:g},{TIP[1]:g}", "--hold", "5"
    )
    assert (status, said, len(wrong.splitlines())) == (1, "", 1)
    assert not Path(LEVELS_FILE).exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["shadow", "in"], "datasets/"), (["calibrate", "levels", "in"], "datasets/"),
    ],
)  # fmt: skip
def test_before_the_stages_have_run_it_says_which_to_run(command, arguments, said):
    status, out, wrong = command(*arguments)
    assert (status, out, len(wrong.splitlines())) == (1, "", 1)
    assert said in wrong and "make it again with ./run dvc repro" in wrong


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["shadow", "in", "--flow", "0"], "--flow: expected 1 to 1000, found 0"),
        (["shadow", "in", "--temperature", "nan"], "--temperature: expected 0 to 600, found nan"),
        (["shadow", "in", "--rate", "0"], "--rate: expected 0.05 to 100"),
        (["shadow", "in", "--tip", "1"], "--tip: expected two numbers"),
        (["shadow", "http://u:secret@/"], "expected the address of a snapshot"),
        (["calibrate", "levels", "none"], "none is missing; name the folder"),
        (["calibrate", "levels", "in", "--hold", "1"], "--hold: expected 5 to 3600"),
        (["calibrate", "levels", "in", "--flows", "a"], "--flows: expected numbers"),
    ],
)  # fmt: skip
def test_bad_flags_are_one_sentence(command, trained, arguments, said):
    status, out, wrong = command(*arguments)
    assert (status, out, len(wrong.splitlines())) == (1, "", 1)
    assert said in wrong and "; " in wrong and "secret" not in wrong
    assert not Path("shadow").exists()
