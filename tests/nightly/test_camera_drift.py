"""What a camera's pictures tell of themselves: moved, other light, other ink,
out of focus; and nothing where nothing changed."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from pipeline.deposition.camera import rendering
from pipeline.nightly import camera_drift, pictures, screening
from pipeline.nightly.records import NightDrift
from pipeline.nightly.settings import Nightly
from pipeline.recordings import nozzle_frames
from pipeline.setpoint.recordings import read_frames
from pipeline.setpoint.settings import TrainClassifier
from pipeline.setpoint.vision import own_pictures
from pipeline.setpoint.vision.files import restore_network, store_classifier
from pipeline.store import params
from stages.train_classifier import SHIPPED
from tests.foreign import nozzle_pictures

LIMITS = {"moved_px": 2.0, "contrast_percent": 15.0}


def night(seed: int, **changes) -> camera_drift.Stats:
    """25 frames of a bead between 100 and 116 px wide, as the ink lies that night."""
    rng = np.random.default_rng(seed)
    camera = rendering.SimulatedCamera(rendering.NOMINAL._replace(**changes), rng)
    return camera_drift.figures(
        [camera.frame(float(rng.uniform(100, 116)), stage_px=int(rng.integers(10_000))) for _ in range(25)]
    )


@pytest.fixture(scope="module")
def good() -> list[camera_drift.Stats]:
    return [night(k) for k in range(4)]


def test_pictures_of_the_same_scene_raise_nothing_in_six_nights(good):
    for k in range(6):
        shift, causes = camera_drift.changes(night(20 + k), good, **LIMITS)
        assert causes == []
        assert (
            np.abs(shift.sigmas).max() < 5
        )  # 36 figures; the night's alarm needs the change to matter as well


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"offset_px": rendering.NOMINAL.offset_px + 4}, "camera"),
        ({"tilt_deg": rendering.NOMINAL.tilt_deg + 0.5}, "camera"),
        ({"contrast": 0.7 * rendering.NOMINAL.contrast, "specular": 0.7 * rendering.NOMINAL.specular}, "ink"),
        ({"background": 75.0, "contrast": 112.0, "specular": 112.0}, "light"),
        ({"blur_px": 4.0}, "focus"),
    ],
)
def test_a_change_is_named_and_found_in_two_nights(good, changes, key):
    for seed in (50, 51):
        _, causes = camera_drift.changes(night(seed, **changes), good, **LIMITS)
        assert [cause.key for cause in causes] == [key], causes
        assert (
            abs(causes[0].sigmas) > 3
        )  # watched the first night, an alarm the second: four nights know little of how nights scatter


def test_the_line_s_place_is_read_to_a_tenth_of_a_pixel(good):
    moved = night(60, offset_px=rendering.NOMINAL.offset_px + 4)
    assert moved[0][0] - np.mean([median[0] for median, _ in good]) == pytest.approx(
        4, abs=0.3
    )  # the bead's own wander is 0.2 px


def test_frames_without_a_bead_are_refused():
    camera = rendering.SimulatedCamera(rendering.NOMINAL, np.random.default_rng(0))
    with pytest.raises(ValueError, match="expected a bead in at least 5 frames, found one in 0 of 6"):
        camera_drift.figures([camera.empty(stage_px=k) for k in range(6)])


def test_the_balance_of_classes_moves_when_it_moves():
    rng = np.random.default_rng(3)
    before = rng.multinomial(400, [0.2, 0.6, 0.2], size=6)
    same = camera_drift.class_balance(rng.multinomial(400, [0.2, 0.6, 0.2]), before, together=1)
    other = camera_drift.class_balance(rng.multinomial(400, [0.4, 0.45, 0.15]), before, together=1)
    assert np.abs(same.sigmas).max() < 4 < np.abs(other.sigmas).max()
    # by hand: 30 of 60 where 10 of 60 is usual
    balance = camera_drift.class_balance(np.array([30, 20, 10]), np.array([[10, 40, 10]] * 3), together=1)
    np.testing.assert_allclose(balance.value - balance.reference, [100 / 3, -100 / 3, 0], atol=1e-9)


def prints(seed: int, shares: list[float], level: float) -> tuple[np.ndarray, camera_drift.Stats]:
    """Of a print of 600 frames in 30 segments of 20 that are alike:
    frames by kind, and the line's contrast."""
    rng = np.random.default_rng(seed)
    counts = 20 * rng.multinomial(30, shares)
    return counts, camera_drift.line_contrast(
        np.repeat(rng.normal(level, 3.0, 30), 20) + rng.normal(0, 1.0, 600), together=20
    )


def test_a_print_like_the_others_raises_nothing_and_another_balance_is_named():
    usual = [prints(k, [0.25, 0.45, 0.27, 0.03], 40.0) for k in range(6)]
    before = np.array([counts for counts, _ in usual])
    for k in range(10):
        counts, _ = prints(50 + k, [0.25, 0.45, 0.27, 0.03], 40.0)
        causes = camera_drift.balance_changes(counts, before, together=20, points=20.0)
        assert all(abs(cause.sigmas) < 3 for cause in causes), causes
    lost = camera_drift.balance_changes(
        prints(70, [0.1, 0.2, 0.1, 0.6], 40.0)[0], before, together=20, points=20.0
    )
    assert (
        lost[0].key == "balance" and "show no line that can be read" in lost[0].words and lost[0].sigmas > 4
    )
    thin = camera_drift.balance_changes(
        prints(71, [0.8, 0.15, 0.04, 0.01], 40.0)[0], before, together=20, points=20.0
    )
    assert (
        "are under-extruded" in thin[0].words and thin[0].sigmas > 3
    )  # watched the first night, an alarm the second


def test_a_line_that_stands_out_less_is_named():
    before = [prints(k, [0.25, 0.45, 0.27, 0.03], 40.0)[1] for k in range(6)]
    assert camera_drift.contrast_changes(prints(80, [1, 0, 0, 0], 40.0)[1], before, percent=15.0) == []
    causes = camera_drift.contrast_changes(prints(81, [1, 0, 0, 0], 25.0)[1], before, percent=15.0)
    assert [cause.key for cause in causes] == ["contrast"] and causes[0].sigmas < -5


# ---- prints of a nozzle's camera

PRINTS = Path("datasets/raw/setpoint")


@pytest.fixture(scope="module")
def camera(root, tmp_path_factory):
    """A project with six prints of a foreign camera, the classifier that learned from them, and what they say
    of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("camera"))
        for name in ("params.yaml", "params.expert.yaml"):
            shutil.copy(root / name, name)
        parameters = yaml.safe_load(Path("params.yaml").read_text())
        parameters["train_classifier"]["source"] = "recordings"
        Path("params.yaml").write_text(yaml.safe_dump(parameters))
        rng = np.random.default_rng(5)
        nozzle_pictures.write_prints(PRINTS, 6, (60.0, 80.0, 95.0, 105.0, 125.0, 150.0), 24, rng)
        settings = params.load(TrainClassifier, "train_classifier")
        _, frames, _ = read_frames(PRINTS, settings, params.load(params.Execution, "execution"))
        network, size = restore_network(str(root / SHIPPED))
        own = own_pictures.learn(network, frames, window=settings.window, false_alarms=settings.false_alarms)
        folder = Path("champion/setpoint")
        store_classifier(folder / "train_classifier", size, own.model)
        loop = params.load(Nightly, "nightly").loops["setpoint"]
        reference = screening.reference(loop, folder)
        assert reference is not None
        yield Path.cwd(), reference["camera"]


def write_changed(change) -> None:
    """The last print once more under another name, its pictures changed."""
    log = (PRINTS / "log.csv").read_text().splitlines()
    lines = [line.replace("print5/", "new/") for line in log if "print5/" in line]
    named = [",".join([*line.split(",")[:-2], "new", line.split(",")[-1]]) for line in lines]
    (PRINTS / "new.csv").write_text("\n".join([log[0], *named]) + "\n")
    (PRINTS / "new").mkdir()
    rng = np.random.default_rng(9)
    for path in sorted((PRINTS / "print5").glob("*.jpg")):
        grain = rng.normal(0, 3, (nozzle_pictures.HEIGHT, nozzle_pictures.WIDTH, 3))
        picture = np.clip(change(cv2.imread(str(path))) + grain, 0, 255).astype(np.uint8)
        cv2.imwrite(str(PRINTS / "new" / path.name), picture)
        shutil.copystat(path, PRINTS / "new" / path.name)


def zoomed(picture: np.ndarray, by: float) -> np.ndarray:
    """About the nozzle's tip."""
    tip = np.array(nozzle_pictures.draw_camera(np.random.default_rng(5)).tip)
    return cv2.warpAffine(picture, np.column_stack([by * np.eye(2), (1 - by) * tip]), picture.shape[1::-1])


@pytest.mark.parametrize(
    ("zoom", "told", "foreign"),
    [
        (1.0, [], (0, 5)),
        (0.6, ["the line stands out by"], (15, 100)),
        (2.0, ["100 % of the frames show no line"], (0, 0)),
    ],
)
def test_a_print_as_the_champion_s_classifier_sees_it(camera, monkeypatch, zoom, told, foreign):
    folder, reference = camera
    monkeypatch.chdir(folder)
    write_changed(lambda picture: zoomed(picture, zoom))
    drift, settings, champion = NightDrift(), params.load(Nightly, "nightly"), Path("champion/setpoint")
    new = [str(PRINTS / "new.csv")]
    try:
        pictures.find_prints_drift(
            drift, settings.drift, "setpoint", str(PRINTS), new, champion, reference, []
        )
        (one,) = pictures.of_prints(PRINTS, champion, 9, ["new"])
    finally:
        (PRINTS / "new.csv").unlink()
        shutil.rmtree(PRINTS / "new")
    said = [alarm.cause for alarm in (*drift.alarms, *drift.watched)]
    assert len(said) == len(told) and all(map(str.startswith, said, told)), said
    assert drift.quarantined == {} and drift.notes == []
    share = 100 * one.familiar[1] / max(sum(one.familiar), 1)
    assert foreign[0] <= share <= foreign[1]
    assert sum(one.counts) == 144 and sum(one.familiar) == sum(one.counts[:3])


def test_frames_of_no_known_flow_are_left_out_and_a_print_of_such_frames_alone_too(camera, monkeypatch):
    monkeypatch.chdir(camera[0])
    read = nozzle_frames.read_folder

    def without_flow(*arguments):
        frames = read(*arguments)
        unknown = frames.print_number == frames.prints.index("0")
        unknown[np.flatnonzero(frames.print_number == frames.prints.index("5"))[:1]] = True
        return frames._replace(label=np.where(unknown, -1, frames.label))

    monkeypatch.setattr(nozzle_frames, "read_folder", without_flow)
    rows = pictures.of_prints(PRINTS, Path("champion/setpoint"), 9)
    assert [one.name for one in rows] == ["1", "2", "3", "4", "5"]
    assert [sum(one.counts) for one in rows] == [144, 144, 144, 144, 143]


def test_frames_that_the_classifier_never_saw_the_like_of_are_named_without_a_label():
    before = np.array([[590, 10], [600, 0], [580, 20]])
    assert camera_drift.foreign_changes(np.array([540, 60]), before, together=20, points=20.0) == []
    (cause,) = camera_drift.foreign_changes(np.array([150, 450]), before, together=20, points=20.0)
    assert cause.words.startswith(
        "75 % of the frames look like none that the classifier learned from, where 2 %"
    )
    assert cause.sigmas > 4
