"""Where a line lies: on pictures of a camera that shares no code with the renderer, at any angle, dark or
light, on four grounds, and on a real nozzle's video as it comes."""

import math

import cv2
import numpy as np
import pytest

from pipeline.deposition.camera import bead, line
from tests.foreign.camera import GROUNDS, Eye, Stage, tip_of

EYE = Eye(height=240, width=320, mm_per_px=0.016)


def picture(eye: Eye, width_mm: float = 0.88, seed: int = 1) -> np.ndarray:
    stage = Stage(eye, np.full(1000, width_mm), -8.0, np.random.default_rng(seed))
    return stage.frame(1.0)


def apart(one: float, other: float, whole: float) -> float:
    return abs((one - other + whole / 2) % whole - whole / 2)


@pytest.mark.parametrize("ground", GROUNDS)
@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("angle", [0.0, 37.0, 90.0, 161.0, 200.0, 315.0])
def test_the_line_from_the_tip_is_found_at_any_angle_on_any_ground(ground, dark, angle):
    eye = EYE._replace(angle_deg=angle, dark=dark, ground=ground, mirrored=angle > 100)
    found = line.find(picture(eye), tip=tip_of(eye), hidden_px=42)
    assert found is not None
    assert apart(found.angle_deg, angle, 360) < 2.5  # the search's steps are a degree
    assert (found.contrast < 0) == dark
    assert found.width_px == pytest.approx(55, abs=6)  # bands are tried in steps of three small pixels


@pytest.mark.parametrize("ground", ["plain", "noisy", "gradient"])  # a stripe of the ground is a line
def test_a_picture_of_the_ground_alone_has_no_line(ground):
    stage = Stage(EYE._replace(ground=ground), np.zeros(1000), -8.0, np.random.default_rng(2))
    bare = cv2.resize(stage.bare[50:290, 50:370], (320, 240)).astype(np.int16) + stage.light
    assert line.find(np.clip(bare, 0, 255).astype(np.uint8)) is None


def test_a_colour_that_is_asked_for_leaves_a_stronger_shadow_aside():
    rows = np.arange(240)[:, None] + np.zeros((1, 320))
    frame = np.full((240, 320), 110.0)
    frame[np.abs(rows - 100) < 10] = 180  # the bead
    frame[np.abs(rows - 118) < 8] = 10  # its shadow
    frame = cv2.GaussianBlur(frame, (0, 0), 1.0).astype(np.uint8)
    shadow, light = line.find(frame), line.find(frame, sign=1)
    assert shadow is not None and shadow.contrast < 0
    assert light is not None and light.y == pytest.approx(99.5, abs=2) and light.contrast > 0


def test_what_a_mask_hides_is_not_found():
    frame = picture(EYE)
    found = line.find(frame, mask=np.ones((240, 320), bool))
    assert found is None


def test_a_turned_picture_has_its_point_where_the_pose_says():
    frame = np.zeros((100, 140), np.uint8)
    frame[37, 61] = 255
    pose = line.Pose(123.0, 61.0, 37.0, 20.0, 48.0, 97, 150, 2.0)
    bright = np.unravel_index(line.turned(frame, pose).argmax(), (97, 150))
    assert bright == (48, 20)
    x, y = line.matrix(pose) @ np.array([30.0, 48.0, 1.0])  # ten columns on is five px of the picture
    assert (x, y) == pytest.approx(
        (61 + 5 * math.cos(math.radians(123)), 37 + 5 * math.sin(math.radians(123)))
    )


@pytest.mark.parametrize("dark", [False, True])
def test_the_rows_end_before_another_line_and_nowhere_without_one(dark):
    rows = np.arange(240)
    profile = np.where(np.abs(rows - 120) < 27, 160.0, 70.0)
    profile[np.abs(rows - 130) < 3] = 230.0  # a specular line parts no bead
    profile = 230.0 - profile if dark else profile
    alone = np.tile(profile[:, None], (1, 9)).astype(np.uint8)
    assert line.clear_rows(alone, 120) == slice(0, 240)
    beside = alone.copy()
    beside[186:] = alone[120 - 26]
    clear = line.clear_rows(beside, 120)
    assert clear.start == 0 and 120 + 27 + 20 < clear.stop < 186
    above = line.clear_rows(beside[::-1], 119)
    assert above.stop == 240 and 54 < above.start < 119 - 27 - 20
    assert line.clear_rows(np.full((240, 9), 70, np.uint8), 120) == slice(0, 240)


def test_the_rows_and_columns_of_a_pose_stay_in_the_picture():
    pose = line.with_room(line.Pose(30.0, 160.0, 120.0, 50.0, 0.0, 0, 150), (240, 320), (60, 140))
    corners = [[c, r, 1.0] for c in (60, 139) for r in (0, pose.rows - 1)]
    inside = np.array(corners) @ line.matrix(pose).T
    assert (inside > -1).all() and (inside < (320, 240)).all()
    assert pose.rows > 100
    assert line.span(pose, (240, 320), (0, 400), 40)[0] == 0


def test_of_a_real_video_nearly_every_frame_is_measured_as_it_comes(shared):
    """Given once for all frames: tip, what the nozzle hides, and that the bead is light."""
    video = cv2.VideoCapture(str(shared("data/fast_caxton_frames/nozzle_video.gif")))
    frames = [frame for _ in range(100) for ok, frame in [video.read()] if ok][::2]
    mask = np.zeros(frames[0].shape[:2], np.uint8)
    nozzle = [[195, 0], [395, 0], [392, 115], [312, 190], [300, 196], [285, 190], [205, 110]]
    cv2.fillPoly(mask, [np.array(nozzle)], 1)
    widths = []
    for frame in frames:
        found = line.find(frame, tip=(299, 193), hidden_px=20, mask=mask.astype(bool), sign=1)
        if found is None:
            continue
        near = 1.1 * found.width_px + 15
        pose = line.pose_on(found, frame.shape[:2], ahead_px=near, behind_px=near)
        one = bead.measure(
            line.turned(frame, pose), columns=(0, pose.columns), longest_blur_px=6 * pose.scale, sign=1
        )
        if not one.reason:
            widths.append(one.width / pose.scale)
    assert len(widths) >= 0.97 * len(frames)
    # the line turns slowly under the camera: from one frame that is looked at to the next, a fifth of a
    # second, its width changes little
    assert np.median(np.abs(np.diff(np.log(widths)))) < 0.15
