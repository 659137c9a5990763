"""The way the ground moves: on grounds that are shifted by hand, on frames of no film, and on a real film
in which the picture turns."""

import cv2
import numpy as np
import pytest

from pipeline.setpoint.frames import key_area, nozzle_scene, travel
from pipeline.setpoint.frames.front_end import find_key_areas

N = 12


def moved(direction_deg, shift_px, *, seed=0, streak=0, noise=3.0, lines=()):
    """(N, 350, 350) crops of a textured ground that moves by shift_px a frame, streaks of so many px along
    it; a nozzle above and lines (direction, level, miss) stand still."""
    rng, a = np.random.default_rng(seed), np.deg2rad(direction_deg)
    texture = cv2.GaussianBlur(rng.standard_normal((1200, 1200), dtype=np.float32), (0, 0), 2.0)
    if streak:
        kernel = np.zeros((2 * streak + 1, 2 * streak + 1), np.float32)
        ends = [(round(streak * (1 + s * np.cos(a))), round(streak * (1 + s * np.sin(a)))) for s in (-1, 1)]
        cv2.line(kernel, *ends, 1.0)
        texture = cv2.filter2D(texture, -1, kernel / kernel.sum())
    texture *= 8 / texture.std()
    y, x = np.mgrid[:350, :350] - 175.0
    still = np.full((350, 350), 70.0)
    for angle, level, miss in lines:
        b = np.deg2rad(angle)
        along, across = x * np.cos(b) + y * np.sin(b), y * np.cos(b) - x * np.sin(b) - miss
        still[(along > 0) & (np.abs(across) <= 4)] = level
    frames = []
    for k in range(N):
        at = (600 - k * shift_px * np.cos(a), 600 - k * shift_px * np.sin(a))
        frame = still + cv2.getRectSubPix(texture, (350, 350), at) + noise * rng.standard_normal((350, 350))
        frame[(y < 0) & (np.abs(x) < 8 - y)] = 40
        frames.append(np.clip(frame, 0, 255).astype(np.uint8))
    return frames


def off(found, direction):
    return np.abs((found.direction_deg - direction + 180) % 360 - 180)


@pytest.mark.parametrize("direction", [0, 37, 90, 143, 180, 215, 330])
@pytest.mark.parametrize("shift", [6.0, 15.0, 30.0])
def test_the_direction_is_that_of_the_ground_with_its_sense(direction, shift):
    found = travel.travel(moved(direction, shift, lines=[(direction, 140, 0)]))
    assert np.isfinite(found.direction_deg).mean() >= 0.9
    # places are whole pixels of the picture reduced by two
    assert np.nanmax(off(found, direction)) <= np.rad2deg(np.arctan(2 / shift)) + 1
    assert np.nanmedian(found.shift_px) == pytest.approx(shift, abs=2)


def test_blurred_along_its_motion_the_ground_still_tells():
    found = travel.travel(moved(120, 12.0, streak=10, lines=[(120, 140, 0)]))
    assert np.isfinite(found.direction_deg).mean() >= 0.6
    assert np.nanmax(off(found, 120)) <= 15


@pytest.mark.parametrize("still", [0.0, 1.0])
def test_a_ground_that_stands_still_gives_no_direction(still):
    found = travel.travel(moved(60, still, lines=[(60, 140, 0)]))
    assert np.isnan(found.direction_deg).all()
    assert set(found.reasons) <= {
        "motion: the ground stands still", "motion: no shift of the ground stands out"
    }  # fmt: skip


def test_frames_that_are_no_film_give_no_direction():
    frames = [moved(d, 10.0, seed=d)[0] for d in range(0, 100, 10)]
    found = travel.travel(frames)
    assert np.isnan(found.direction_deg).all()
    assert travel.travel(frames[:3]).reasons == (
        "motion: 3 frames in a row are too few to see the ground move",
    ) * 3  # fmt: skip
    # scenes of one segment lie at places drawn anew
    rng = np.random.default_rng(4)
    segment = nozzle_scene.draw_segment(rng)
    scene = nozzle_scene.render(segment, np.full(20, 100.0), 210.0, rng)
    drawn = travel.travel([key_area.crop(frame, scene.tip).gray for frame in scene.frames])
    assert np.isfinite(drawn.direction_deg).mean() <= 0.15


def test_the_front_end_takes_the_line_along_the_motion_where_an_older_one_is_brighter():
    frames = moved(130, 12.0, lines=[(40, 180, 0), (130, 130, 0)])
    unknown = np.full(N, np.nan)
    found = find_key_areas(frames, np.full((N, 2), 175.0), unknown, least_score=10)
    assert found.reasons == [""] * N
    assert (np.abs(found.angle_deg - 130) <= 4).all()
    # the same frames in an order that is no film's: none is guessed
    shuffled = [frames[i] for i in (5, 0, 9, 3, 11, 1, 8, 4, 10, 2, 7, 6)]
    guessed = find_key_areas(shuffled, np.full((N, 2), 175.0), unknown, least_score=10)
    assert all(reason.startswith("several lines: ") and "(motion: " in reason for reason in guessed.reasons)


def test_a_told_direction_goes_before_the_motion():
    frames = moved(130, 12.0, lines=[(40, 180, 0), (130, 130, 0)])
    told = find_key_areas(frames, np.full((N, 2), 175.0), np.full(N, 40.0), least_score=10)
    assert (np.abs(told.angle_deg - 40) <= 4).all()


def test_a_real_film_whose_picture_turns_gives_no_direction(shared):
    """Its nozzle goes round a circle, and its blur into streaks turns by some degrees a frame: the shift that
    correlates best is that of the turn, up to 90 degrees from the travel."""
    video, crops = cv2.VideoCapture(str(shared("data/fast_caxton_frames/nozzle_video.gif"))), []
    while (read := video.read())[0]:
        crops.append(key_area.crop(read[1], (301, 190)).gray)
    found = travel.travel(crops)
    assert np.isnan(found.direction_deg).all()
    assert any("the picture turns by" in reason for reason in found.reasons)
