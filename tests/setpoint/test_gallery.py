"""Real frames for the page: which are chosen, with what share and reason, and the picture of each; and the
camera of a folder."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from pipeline.setpoint.frames import familiar
from pipeline.setpoint.frames import files as camera_files
from pipeline.setpoint.material import PLA
from pipeline.setpoint.settings import TrainClassifier
from pipeline.setpoint.vision import calibrated_classifier, gallery
from pipeline.store import artifacts, params
from stages import train_classifier
from tests.nozzle_folders import FLOWS, SHOTS, folder, read, rows, scenes

ROOT = Path(__file__).parents[2]
COUNT = 2 * len(FLOWS) * SHOTS


@pytest.fixture
def model(monkeypatch):
    """Says good, surely, of every frame; the fourth valid one is far from what was learned."""

    def classify(model, key_areas, temperature):
        prob = np.tile([0.1, 0.8, 0.1], (len(key_areas), 1))
        prob[:, 1] += 0.001 * np.arange(len(key_areas))
        return prob, np.where(np.arange(len(key_areas)) == 3, 99.0, 1.0)

    monkeypatch.setattr(calibrated_classifier, "classify", classify)
    return SimpleNamespace(calibration=SimpleNamespace(foreign_above=20.0))


def page_rows(model, frames, prints, folder):
    """The rows of frames.json, and the pictures beside it."""
    settings = params.load(TrainClassifier, "train_classifier", ROOT / params.FILE)
    shown, said = np.isin(frames.print_number, prints), gallery.classified_frames(model, frames)
    pictures = train_classifier.show_recorded(settings, model, frames, said, shown, PLA)
    train_classifier.write_frames(folder, pictures)
    return artifacts.read_json(folder / "frames.json")


def made(tmp_path):
    """Two prints; of the second, the first picture is flat."""
    raw = folder(tmp_path / "raw")
    cv2.imwrite(str(raw / rows()[COUNT // 2]["img_path"]), np.full((350, 350), 60, np.uint8))
    return read(raw)


def test_each_frame_is_in_one_group_and_shares_are_of_the_judged_prints(tmp_path, model):
    frames = made(tmp_path)
    judged = page_rows(model, frames, np.array([1]), tmp_path)
    assert {row["source"].split(": ")[1].split("/")[0][-6:] for row in judged} == {"print1"}
    shown = gallery.group_frames(*gallery.classified_frames(model, frames), 20.0, frames)
    mine = frames.print_number == 1
    shares = {row["group"]: row["share"] for row in judged}
    assert shares == {g: (shown.group[mine] == g).mean() for g in shares}
    assert sum((shown.group[mine] == g).sum() for g in ("accepted", "wrong", "rejected", "foreign")) == 9
    by_group = {g: [row for row in judged if row["group"] == g] for g in shares}
    assert {row["label"] for row in by_group["accepted"]} == {1}
    assert {row["label"] for row in by_group["wrong"]} <= {0, 2}
    # the surest of the wrong ones goes before the others
    sure = [max(row["p"]) for row in by_group["wrong"]]
    assert sure == sorted(sure, reverse=True)
    flat = by_group["rejected"][0]
    assert flat["reason"].startswith("no fresh line") and flat["p"] is None and flat["named"] is None


def test_a_frame_far_from_what_was_learned_is_shown_as_foreign(tmp_path, model):
    frames = made(tmp_path)
    shown = page_rows(model, frames, np.array([0, 1]), tmp_path)
    foreign = [row for row in shown if row["group"] == "foreign"]
    assert len(foreign) == 1
    assert foreign[0]["reason"] == "foreign: further from what was learned than allowed"
    assert foreign[0]["source"] == frames.source[np.flatnonzero(frames.valid)[3]]


def test_the_picture_is_that_of_the_frame_with_its_key_area(tmp_path, model):
    frames = made(tmp_path)
    for row in page_rows(model, frames, np.array([0, 1]), tmp_path):
        picture = cv2.imread(str(tmp_path / row["file"]), cv2.IMREAD_GRAYSCALE)
        k = frames.source.index(row["source"])
        scene = scenes()[k // SHOTS]
        frame = scene.frames[k % SHOTS] if k != COUNT // 2 else np.full((350, 350), 60, np.uint8)
        assert picture.shape == (350, 350)
        # all but the drawn lines, and JPEG: the tip may move the crop by some pixels
        x, y = (round(float(v)) - 175 for v in np.round(scene.tip, 2))
        there = frame[max(y, 0) :, max(x, 0) :]
        here = picture[max(-y, 0) :, max(-x, 0) :][: there.shape[0], : there.shape[1]]
        there = there[: here.shape[0], : here.shape[1]]
        assert np.median(np.abs(here[:300].astype(int) - there[:300])) <= 3


def test_where_all_are_right_there_is_no_wrong_group(tmp_path, model):
    frames = made(tmp_path)
    only_good = frames._replace(label=np.where(frames.label >= 0, 1, frames.label))
    shown = page_rows(model, only_good, np.array([1]), tmp_path)
    assert "wrong" not in {row["group"] for row in shown}


# ---- the camera of a folder


def test_a_folder_s_camera_is_known_from_its_windows_and_another_s_frames_are_foreign(tmp_path):
    frames = made(tmp_path)  # prints of nine frames
    # the first accepted frame of every five of a print
    blocks = ((0, 5), (5, 9), (9, 14), (14, 18))
    first = [np.flatnonzero(frames.valid[i:j])[0] + i for i, j in blocks]
    assert np.flatnonzero(np.isfinite(frames.surroundings).all(axis=1)).tolist() == first
    assert not frames.valid[9]  # or the test shows nothing
    rng = np.random.default_rng(0)
    many = 240
    measured = rng.normal(3.0, 0.1, (5 * many, len(familiar.NAMES))).astype(np.float32)
    segment = np.repeat(np.arange(4), 5 * many // 4)
    # 4 stretches are too few: windows then
    camera, known_from = familiar.fit_recorded_camera(measured, segment, length=5)
    assert known_from == many
    assert len(camera.scores) == many // 2
    windows, _ = familiar.window_medians(measured, segment, length=5)
    assert familiar.foreign(camera, windows, false_alarms=0.01).mean() <= 0.02
    assert familiar.foreign(camera, windows + 1.0, false_alarms=0.01).all()
    assert familiar.fit_recorded_camera(measured[:995], segment[:995], length=5) == (None, 199)


def test_a_camera_comes_back_from_its_file_and_one_of_other_measures_is_refused(tmp_path):
    rng = np.random.default_rng(1)
    camera = familiar.fit_camera(
        rng.standard_normal((220, len(familiar.NAMES))), np.arange(220), false_alarms=0.01
    )
    camera_files.store_camera(tmp_path / "camera.parquet", camera)
    again = camera_files.restore_camera(tmp_path / "camera.parquet")
    for ours, theirs in zip(camera, again, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    camera_files.store_camera(tmp_path / "none.parquet", None)
    assert camera_files.restore_camera(tmp_path / "none.parquet") is None
    few = familiar.fit_camera(rng.standard_normal((220, 5)), np.arange(220), false_alarms=0.01)
    camera_files.store_camera(tmp_path / "few.parquet", few)
    with pytest.raises(ValueError, match=r"expected 28 measures, found \(5,\)"):
        camera_files.restore_camera(tmp_path / "few.parquet")
