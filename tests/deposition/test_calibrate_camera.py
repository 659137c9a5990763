"""`beadline calibrate camera`: lines of known widths into params.yaml, whose other lines stay, and a page."""

import functools
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.deposition.settings import Camera
from pipeline.recordings import trial_files
from pipeline.store import params
from tests.foreign.camera import Eye, Stage, tip_of

ROOT = Path(__file__).resolve().parents[2]
WIDTHS = (0.5, 0.9, 1.2)
EYE = Eye(
    angle_deg=68.0, dark=True, ground="striped", edge_bias_px=1.2, height=360, width=480, mm_per_px=0.0105
)


@pytest.fixture
def calibrate(beadline, tmp_path):
    """calibrate("a.png", ...): status, what was printed, and what was said of errors."""
    for name in (params.FILE, params.EXPERT):
        shutil.copy(ROOT / name, tmp_path)
    return functools.partial(beadline, "calibrate", "camera")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> list[str]:
    """One picture of each line, as a camera sees it that hangs askew."""
    folder, out = tmp_path_factory.mktemp("ladder"), []
    for k, width in enumerate(WIDTHS):
        stage = Stage(EYE, np.full(1800, width), -10.0, np.random.default_rng(k))
        out.append(str(folder / f"line_{k}.png"))
        cv2.imwrite(out[-1], stage.frame(0.0))
    return out


def test_what_is_measured_stands_in_params_and_every_other_line_stays(calibrate, pictures):
    before = Path(params.FILE).read_text().splitlines()
    x, y = tip_of(EYE)
    status, said, wrong = calibrate(
        *pictures, "--widths", "0.5,0.9,1.2", "--tip", f"{x:.0f},{y:.0f}", "--write"
    )
    assert (status, wrong) == (0, "")
    camera = params.load(Camera, "camera")
    assert camera.mm_per_px == pytest.approx(
        -0.0105, rel=0.02
    )  # a narrow dark line errs by half a pixel more
    assert camera.rotation_deg == pytest.approx(68.0, abs=0.3)
    assert (camera.bead, camera.known_widths_mm) == ("dark", list(WIDTHS))
    assert camera.columns[1] - camera.columns[0] > 100
    # a bead's edges err by what the picture adds and by what the method does of itself
    assert np.ptp(camera.edge_bias_px) < 1 and min(camera.edge_bias_px) > 0.5
    after = Path(params.FILE).read_text().splitlines()
    changed = [new for old, new in zip(before, after, strict=True) if old != new]
    assert len(changed) == 7 and all("#" in line for line in changed if "known_widths" not in line)
    assert "dark" in said and "line_0.camera.html" in said
    page = Path("line_0.camera.html").read_text()
    assert page.count("<figure>") == 3 and "looks wider by" in page


def test_without_write_params_stay_and_the_lines_to_paste_are_printed(calibrate, pictures):
    before = Path(params.FILE).read_bytes()
    status, said, _ = calibrate(*pictures, "--widths", "0.5,0.9,1.2")
    assert status == 0 and Path(params.FILE).read_bytes() == before
    assert "camera:\n  mm_per_px: -0.0" in said and "without --tip X,Y" in said


def test_one_picture_of_all_lines_gives_the_scale_by_their_pitch(calibrate):
    frame = np.full((600, 400), 60, np.uint8)
    for middle, width in ((110, 51), (300, 91), (490, 121)):  # each looks a pixel wider than 0.5, 0.9, 1.2 mm
        frame[middle - width // 2 : middle + width // 2 + 1] = 170
    cv2.imwrite("ladder.png", frame)
    status, said, wrong = calibrate("ladder.png", "--widths", "0.5,0.9,1.2", "--pitch", "1.9")
    assert (status, wrong) == (0, "")
    values = dict(
        line.strip().split(": ", 1) for line in said.splitlines() if line.startswith("  ") and ": [" in line
    )
    assert np.array(eval(values["edge_bias_px"])) == pytest.approx([1, 1, 1], abs=0.4)
    assert "0.01 mm per px, from the pitch of the ladder" in said.replace("0.0100", "0.01")


def test_recordings_of_the_lines_do_in_place_of_pictures(calibrate, pictures):
    """All frames of a recording count, and their scatter is told."""
    names = []
    for k, picture in enumerate(pictures):
        frame = cv2.imread(picture, cv2.IMREAD_GRAYSCALE)
        time = np.arange(10) * 0.1
        noisy = ((t, frame + np.uint8(i % 3)) for i, t in enumerate(time[:5]))
        names.append(f"line_{k}.mcap")
        signals = trial_files.TrialSignals(time, 8 * time, np.full(10, 8.0), np.zeros(10))
        conditions = trial_files.TrialConditions(
            "A", "0.6", 0, "", 0, 8.0, 4.0, 6.0, 0.6, 8.0, 0.3, 95.0, 0.0, 90.0, -0.0105, 30.0
        )
        trial_files.write_trial(names[-1], conditions, noisy, signals, encoding="png")
    status, said, wrong = calibrate(*names, "--widths", "0.5,0.9,1.2")
    assert (status, wrong) == (0, "")
    assert "15 lines measured, repeated to 0.0" in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--widths", "0.5,0.9"), "one for each of 2 widths, but found 3"),
        (
            ("--widths", "0.5,wide,1.2"),
            "--widths: expected numbers such as 0.5,0.9,1.3, found '0.5,wide,1.2'",
        ),
        (("--widths", "1.2,0.9,0.5"), "grow with the known widths"),
        (("--widths", "0.5,0.9,1.2", "--tip", "5"), "--tip: expected two numbers of pixels"),
        (("--widths", "0.5,0.9,1.2", "--pitch", "2"), "--pitch needs one picture that shows all lines"),
    ],
)
def test_what_cannot_be_calibrated_is_refused_in_a_sentence(calibrate, pictures, arguments, words):
    before = Path(params.FILE).read_bytes()
    status, _, wrong = calibrate(*pictures, *arguments, "--write")
    assert status == 1 and words in wrong and "Traceback" not in wrong
    assert Path(params.FILE).read_bytes() == before


def test_a_picture_without_a_line_or_of_no_picture_is_refused_by_name(calibrate, pictures):
    cv2.imwrite("bare.png", np.full((240, 320), 90, np.uint8))
    Path("text.png").write_text("no picture")
    for name, words in (
        ("bare.png", "expected 1 line (0.9 mm) but found 0"),
        ("text.png", "expected a picture"),
    ):
        status, _, wrong = calibrate(pictures[0], name, pictures[2], "--widths", "0.5,0.9,1.2")
        assert status == 1 and name in wrong and words in wrong
