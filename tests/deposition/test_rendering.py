"""Rendered frames: the bead that they show is the bead that was asked for, volume is
conserved, and the same seed gives the same bytes."""

import numpy as np
import pytest

from pipeline.deposition.camera.bead import area
from pipeline.deposition.camera.flow import View
from pipeline.deposition.camera.rendering import HARD, NOMINAL, SimulatedCamera

CLEAN = NOMINAL._replace(
    shading=0.0,
    specular=0.0,
    glare=0.0,
    texture=0.0,
    noise=0.0,
    roughness_px=0.0,
    tilt_deg=0.0,
    offset_px=0.0,
)
VIEW = View(mm_per_px=1 / 125, nozzle_column=648.0)
NOZZLE = (0.25, 0.32)
TIME = np.arange(0.0, 2.0, 0.02)


def trial(scene, flow, position, *, seed=0, view=VIEW):
    camera = SimulatedCamera(scene, np.random.default_rng(seed))
    return list(
        camera.trial(
            TIME, flow, position, view=view, frame_rate_hz=30.0, nozzle_mm=NOZZLE, contact_angle_deg=90.0
        )
    )


def summed_width(frame: np.ndarray) -> np.ndarray:
    """Width of each column from the light it adds: exact for a flat bead, whatever the blur."""
    return (frame.astype(float) - CLEAN.background).sum(axis=0) / CLEAN.contrast


@pytest.mark.parametrize("width", [12.0, 60.1, 110.33, 300.0])
def test_the_bead_is_as_wide_as_asked_for_on_average_over_the_columns(width):
    camera = SimulatedCamera(CLEAN, np.random.default_rng(1))
    measured = np.mean([summed_width(camera.frame(width, stage_px=0)) for _ in range(5)])
    assert measured == pytest.approx(
        width, abs=0.03
    )  # dither of a quarter of a pixel over 3,200 columns, levels in whole numbers


def test_a_tilted_bead_is_as_wide_across_its_line():
    camera = SimulatedCamera(CLEAN._replace(tilt_deg=2.0), np.random.default_rng(1))
    measured = summed_width(camera.frame(110.0, stage_px=0)).mean() * np.cos(np.radians(2.0))
    assert measured == pytest.approx(110.0, abs=0.05)


def test_the_volume_on_the_stage_is_the_volume_that_flowed():
    flow = np.where((TIME > 0.3) & (TIME < 0.6), 2.4, 0.0)
    frame = trial(CLEAN, flow, 2.0 * TIME)[-1][1]
    widths = summed_width(frame[:, :600]) / 125
    volume = area(np.maximum(widths, 0), 90.0).sum() / 125
    assert volume == pytest.approx(
        np.trapezoid(flow, TIME), rel=0.01
    )  # widths dithered by a quarter of a pixel


def test_a_pause_lays_its_volume_over_one_footprint():
    position = np.where(TIME < 0.5, 8.0 * TIME, np.where(TIME < 1.0, 4.0, 4.0 + 8.0 * (TIME - 1.0)))
    flow = np.where((TIME >= 0.6) & (TIME < 0.9), 1.0, 0.0)
    frame = trial(CLEAN, flow, position)[45][1]  # 1.5 s: the nozzle is 4 mm past the pause
    widths = np.where(summed_width(frame) > 3, summed_width(frame), 0)[:600]
    there = np.flatnonzero(widths) + 0.0
    assert np.ptp(there) / 125 == pytest.approx(
        2 * NOZZLE[0], abs=0.03
    )  # two samples of the flow's edges and a pixel's blur do not move the nozzle
    assert there.mean() == pytest.approx(648 - 4.0 * 125, abs=2.0)


def test_what_lies_on_the_stage_moves_with_it_and_the_line_does_not():
    still = NOMINAL._replace(noise=0.0, glare=0.0)
    camera = SimulatedCamera(still, np.random.default_rng(2))
    a, b = (camera.frame(0.0, stage_px=k).astype(float) for k in (0, 40))
    np.testing.assert_array_equal(a[:, 40:], b[:, :-40])


def test_a_mirrored_view_shows_the_mirrored_trial():
    flow, position = np.full(len(TIME), 2.4), 4.0 * TIME
    right = trial(CLEAN, flow, position)[40][1]
    left = trial(CLEAN, flow, position, view=View(-1 / 125, 639.0 - 648.0))[40][1]
    np.testing.assert_allclose(
        summed_width(right[:, 20:600]), summed_width(left)[::-1][20:600], atol=0.6
    )  # two dithers


def test_frames_are_bytes_of_the_size_and_rate_asked_for_and_the_nozzle_hides_one_side():
    frames = trial(HARD, np.full(len(TIME), 2.4), 8.0 * TIME)
    assert [t for t, _ in frames] == pytest.approx(np.arange(len(frames)) / 30.0)
    assert len(frames) == 60  # 1.98 s
    assert {(f.shape, f.dtype) for _, f in frames} == {((480, 640), np.dtype(np.uint8))}
    assert (frames[30][1][264, 620:] == 25).all()


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others():
    flow, position = np.full(len(TIME), 2.4), 8.0 * TIME
    first, again, other = (trial(HARD, flow, position, seed=seed) for seed in (5, 5, 6))
    assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(first, again, strict=True))
    assert not np.array_equal(first[30][1], other[30][1])


def test_one_camera_lays_every_trial_on_a_fresh_part_of_the_stage():
    camera = SimulatedCamera(NOMINAL._replace(noise=0.0), np.random.default_rng(7))
    first, second = (
        next(
            camera.trial(
                TIME,
                0 * TIME,
                0 * TIME,
                view=VIEW,
                frame_rate_hz=30.0,
                nozzle_mm=NOZZLE,
                contact_angle_deg=90.0,
            )
        )[1]
        for _ in range(2)
    )
    assert not np.array_equal(first, second)
