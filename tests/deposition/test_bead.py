"""Frame -> width: exact on drawn edges, robust on rendered frames,
refusals with their reason; calibration, cross-section."""

import math

import cv2
import numpy as np
import pytest

from pipeline.deposition.camera.bead import area, calibrate, drawn, edge_deviation, gray, measure, measure_all
from pipeline.deposition.camera.rendering import HARD, NOMINAL, SimulatedCamera

VIEW = {"columns": (0, 600), "longest_blur_px": 6.0}
WIDTHS = (60.0, 85.0, 110.0, 135.0, 160.0)


def strip(
    width: float,
    *,
    h: int = 480,
    w: int = 640,
    middle: float = 239.5,
    background: float = 60.0,
    level: float = 150.0,
) -> np.ndarray:
    """A flat bead with edges sharp to the pixel they cross: its width is exact by the area that it covers."""
    rows = np.arange(h)[:, None]
    covered = np.clip(width / 2 - np.abs(rows - middle) + 0.5, 0, 1)
    return np.rint(np.broadcast_to(background + (level - background) * covered, (h, w))).astype(np.uint8)


def figures(scene, *, seed: int, frames: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Mean error and standard deviation in px at each of WIDTHS; every frame on another part of the stage."""
    rng = np.random.default_rng(seed)
    camera = SimulatedCamera(scene, rng)
    widths = [
        [measure(camera.frame(w, stage_px=int(rng.integers(0, 10**6))), **VIEW).width for _ in range(frames)]
        for w in WIDTHS
    ]
    return np.mean(widths, axis=1) - WIDTHS, np.std(widths, axis=1)


# ---- width


@pytest.mark.parametrize("width", [40.0, 73.25, 110.0, 110.5, 200.75])
def test_the_width_of_a_flat_strip_is_exact(width):
    bead = measure(strip(width), **VIEW)
    assert bead.reason == ""
    assert bead.width == pytest.approx(width, abs=0.02)  # levels are whole numbers
    np.testing.assert_allclose(bead.bottom - bead.top, bead.widths, atol=1e-6)  # the strip lies level
    np.testing.assert_allclose((bead.bottom + bead.top) / 2, 239.5, atol=0.02)


def test_nominal_frames_scatter_less_than_0_12_px_and_err_less_than_0_2_px():
    bias, deviation = figures(NOMINAL, seed=101)
    assert deviation.max() <= 0.12
    assert np.abs(bias).max() <= 0.2


def test_hard_frames_scatter_less_than_0_3_px_and_err_less_than_0_2_px_after_calibration():
    bias, deviation = figures(HARD, seed=102)
    assert deviation.max() <= 0.3
    measured, true_mm = np.array(WIDTHS) + bias, np.array(WIDTHS) / 125
    calibration = calibrate(measured[[0, 2, 4]], true_mm[[0, 2, 4]])
    assert np.abs(calibration.gain * measured + calibration.offset - true_mm).max() * 125 <= 0.2


@pytest.mark.parametrize(
    "changes",
    [
        {"tilt_deg": 2.0, "blur_px": 0.8},
        {"tilt_deg": -2.0, "contrast": 140.0, "background": 30.0},
        {"background": 150.0, "contrast": -80.0},
        {"blur_px": 2.2, "offset_px": -60.0, "contrast": 45.0},
    ],
)
def test_tilted_dark_bright_sharp_and_dim_scenes_err_less_than_0_2_px(changes):
    bias, deviation = figures(NOMINAL._replace(**changes), seed=103, frames=8)
    assert np.abs(bias).max() <= 0.2
    assert deviation.max() <= 0.12


def test_the_strongest_gradient_falls_for_the_specular_line_where_ours_does_not():
    camera, errors = SimulatedCamera(HARD, np.random.default_rng(104)), []
    for i in range(10):
        frame = camera.frame(110.0, stage_px=97 * i)
        steps = np.diff(cv2.blur(frame, (9, 3)).astype(float), axis=0)
        errors.append(np.median(steps.argmin(axis=0) - steps.argmax(axis=0)) - 110.0)
        assert abs(measure(frame, **VIEW).width - 110.0) < 1.5  # five deviations of one hard frame
    assert np.median(errors) < -8  # the notes: -8 to -24 px


def test_the_angle_of_a_tilted_line_comes_out_and_its_width_is_across_it():
    camera = SimulatedCamera(NOMINAL._replace(tilt_deg=2.0), np.random.default_rng(105))
    bead = measure(camera.frame(110.0, stage_px=0), **VIEW)
    assert bead.angle_deg == pytest.approx(2.0, abs=0.1)  # the line wanders by 0.2 px over 600
    vertical = np.nanmedian(bead.bottom - bead.top)
    assert vertical == pytest.approx(110.0 / math.cos(math.radians(2.0)), abs=0.3)


def test_the_blur_of_the_edge_comes_out():
    for blur in (1.2, 2.0, 3.0):
        camera = SimulatedCamera(NOMINAL._replace(blur_px=blur), np.random.default_rng(106))
        measured = np.mean([measure(camera.frame(110.0, stage_px=97 * i), **VIEW).blur_px for i in range(5)])
        assert measured == pytest.approx(blur, rel=0.2)  # the pixel's own width and the wander add to it


def test_a_line_that_begins_in_the_frame_is_read_where_it_is_and_zero_before():
    camera = SimulatedCamera(NOMINAL, np.random.default_rng(107))
    bead = measure(camera.frame(np.where(np.arange(640) < 296, 0.0, 110.0), stage_px=0), **VIEW)
    assert bead.reason == ""
    before, after = bead.columns < 288, bead.columns > 304
    assert (bead.widths[before] == 0).all()
    np.testing.assert_allclose(bead.widths[after], 110.0, atol=1.5)  # five deviations of one block


def test_a_step_of_the_width_stays_a_step():
    camera = SimulatedCamera(NOMINAL, np.random.default_rng(108))
    bead = measure(camera.frame(np.where(np.arange(640) < 296, 90.0, 250.0), stage_px=0), **VIEW)
    np.testing.assert_allclose(bead.widths[bead.columns < 288], 90.0, atol=1.5)
    np.testing.assert_allclose(bead.widths[bead.columns > 304], 250.0, atol=1.5)


# ---- frames without a bead


@pytest.mark.parametrize("scene", [NOMINAL, HARD])
def test_an_empty_frame_gives_no_bead_and_no_width_anywhere(scene):
    rng = np.random.default_rng(109)
    for _ in range(3):
        camera = SimulatedCamera(scene, rng)
        for _ in range(20):
            bead = measure(camera.empty(stage_px=int(rng.integers(0, 10**6))), **VIEW)
            assert bead.reason == "no bead"
            assert (bead.widths == 0).all()
            assert math.isnan(bead.width)


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (np.full((480, 640), 128, np.uint8), "no bead"),
        (np.zeros((480, 640), np.uint8), "no bead"),
        (strip(110.0, level=255.0), "saturated"),
        (strip(150.0, middle=60.0), "cut by the frame"),
        (cv2.GaussianBlur(strip(150.0), (1, 121), 0, sigmaY=9.0), "blurred"),
    ],
)
def test_a_frame_that_cannot_be_measured_says_why_and_gives_no_width(frame, reason):
    bead = measure(frame, **VIEW)
    assert bead.reason == reason
    assert math.isnan(bead.width)
    assert not np.nansum(bead.widths)


# ---- other frames


def test_edges_that_zigzag_are_no_line():
    rng = np.random.default_rng(2)
    rows = np.arange(240)[:, None]
    half = np.repeat(rng.uniform(10, 60, 40), 8)
    for widths, reason in ((half, "ragged"), (np.full(320, 30.0), "")):
        frame = np.where(np.abs(rows - 120) < widths, 160, 70) + rng.normal(0, 2, (240, 320))
        measured = measure(
            cv2.GaussianBlur(frame, (0, 0), 1.0).astype(np.uint8), columns=(0, 320), longest_blur_px=6.0
        )
        assert measured.reason == reason and (not reason or np.isnan(measured.widths).all())


def test_a_width_may_be_off_by_what_blur_and_rounding_move_its_edges():
    # sharp: half a level of 90 over the steepest row; soft: the first rows read are within the edge
    assert edge_deviation(1.2, 90.0) == pytest.approx(math.sqrt(2 * math.pi) * 1.2 / 90, rel=0.01)
    assert edge_deviation(3.0, 1e9) == pytest.approx(3 * 3.0 * 0.0478, rel=0.01)
    # a blur of more than 3.3 px may as well be one of 6
    assert edge_deviation(3.4, 1e9) == edge_deviation(6.0, 1e9) == pytest.approx(3 * 6.0 * 0.2023, rel=0.01)
    assert edge_deviation(1.2, -9.0) == pytest.approx(10 * edge_deviation(1.2, 90.0), rel=0.01)


def test_16_bit_and_colour_frames_give_the_same_width():
    frame = SimulatedCamera(NOMINAL, np.random.default_rng(110)).frame(110.0, stage_px=0)
    width = measure(frame, **VIEW).width
    assert measure(frame.astype(np.uint16) * 257, **VIEW).width == pytest.approx(width, abs=1e-3)  # float32
    for code in (cv2.COLOR_GRAY2BGR, cv2.COLOR_GRAY2BGRA):
        assert measure(cv2.cvtColor(frame, code), **VIEW).width == width
    assert measure(frame[:, :, None], **VIEW).width == width


@pytest.mark.parametrize(("h", "w"), [(240, 320), (241, 323), (720, 1280), (1080, 1920)])
def test_other_sizes_are_measured(h, w):
    bead = measure(strip(100.0, h=h, w=w, middle=h / 2), columns=(0, w), longest_blur_px=6.0)
    assert bead.width == pytest.approx(100.0, abs=0.02)
    assert len(bead.columns) == w // 8


@pytest.mark.parametrize(
    ("frame", "columns", "message"),
    [
        (
            np.zeros((480, 640)),
            (0, 600),
            r"expected \(height, width\) .* of uint8 or uint16 but found \(480, 640\) of float64",
        ),
        (np.zeros((480, 640, 2), np.uint8), (0, 600), r"found \(480, 640, 2\) of uint8; convert it to gray"),
        (
            np.zeros((40, 640), np.uint8),
            (0, 600),
            r"at least 48 rows, and 32 columns between 0 and 600, but found 40 rows of 640",
        ),
        (
            np.zeros((480, 500), np.uint8),
            (0, 600),
            r"between 0 and 600, but found 480 rows of 500; check the camera's region",
        ),
    ],
)
def test_what_is_no_frame_is_refused(frame, columns, message):
    with pytest.raises(ValueError, match=message):
        measure(frame, columns=columns, longest_blur_px=6.0)


def test_colour_becomes_gray_by_the_usual_weights():
    assert gray(np.full((60, 60, 3), (10, 20, 30), np.uint8))[0, 0] == round(
        0.114 * 10 + 0.587 * 20 + 0.299 * 30
    )


@pytest.mark.parametrize("level", [NOMINAL, HARD])
def test_many_frames_at_once_give_the_same_numbers_as_each_alone(level):
    camera = SimulatedCamera(level, np.random.default_rng(112))
    widths = [110.0, 0.0, 25.0, np.where(np.arange(640) < 300, 0.0, 200.0), 70.0]
    frames = [camera.frame(w, stage_px=97 * i) for i, w in enumerate(widths)] + [
        strip(110.0, level=255.0),
        strip(150.0, middle=60.0),
    ]
    together = measure_all(frames, **VIEW)
    assert [bead.reason for bead in together] == ["", "no bead", "", "", "", "saturated", "cut by the frame"]
    for bead, frame in zip(together, frames, strict=True):
        alone = measure(frame, **VIEW)
        assert bead.reason == alone.reason
        np.testing.assert_allclose(bead.widths, alone.widths, atol=1e-3)  # rounds of the blur end together
        np.testing.assert_allclose(bead.width, alone.width, atol=1e-3)
    assert measure_all([], **VIEW) == []


def test_frames_of_two_sizes_are_not_measured_together():
    with pytest.raises(
        ValueError, match=r"frames of one size and kind but found .*\(240, 320\).*\(480, 640\)"
    ):
        measure_all([strip(110.0), strip(110.0, h=240, w=320)], columns=(0, 320), longest_blur_px=6.0)


# ---- calibration


def test_gain_and_offset_come_back_and_the_residuals_are_what_is_left():
    px = np.array([60.0, 90.0, 120.0, 150.0])
    calibration = calibrate(px, 0.008 * px + 0.01)
    assert (calibration.gain, calibration.offset) == pytest.approx((0.008, 0.01), abs=1e-12)  # rounding
    assert calibration.deviation < 1e-12
    # by hand: misses 1, -2, 1 are orthogonal to a line through three
    # even places, so they stay: sqrt(6 / (3 - 2))
    bent = calibrate(np.array([1.0, 2.0, 3.0]), np.array([2.0, 0.0, 4.0]))
    np.testing.assert_allclose(bent.residuals, [1.0, -2.0, 1.0], atol=1e-12)
    assert bent.deviation == pytest.approx(math.sqrt(6.0))


@pytest.mark.parametrize(
    ("px", "mm", "message"),
    [
        (
            [60.0, 60.0, 90.0],
            [0.5, 0.5, 0.7],
            r"at least three different known widths, .* found \(3,\) measured for 2 different",
        ),
        ([60.0, np.nan, 90.0], [0.5, 0.6, 0.7], r"expected a width in every frame but 1 of 3 have none"),
        (
            [90.0, 75.0, 60.0],
            [0.5, 0.6, 0.7],
            r"grow with the known widths but found a gain of -0.00667 mm/px",
        ),
    ],
)
def test_a_calibration_that_determines_nothing_is_refused(px, mm, message):
    with pytest.raises(ValueError, match=message):
        calibrate(np.array(px), np.array(mm))


# ---- cross-section, picture


def test_the_cross_section_of_a_half_round_bead_is_a_half_circle():
    assert area(0.88, 90.0) == pytest.approx(math.pi / 8 * 0.88**2)
    # a flat segment: A = 2/3 w h with h = w theta / 4
    assert area(1.0, 1.0) == pytest.approx(2 / 3 * math.radians(1.0) / 4, rel=1e-4)
    with pytest.raises(ValueError, match=r"contact angle between 0 and 180 degrees but found 180"):
        area(1.0, 180.0)


def test_the_picture_carries_the_edges_where_they_were_measured():
    frame = strip(100.0)
    picture = drawn(frame, measure(frame, **VIEW))
    assert picture.shape == (480, 640, 3)
    green = np.flatnonzero((picture[:, 300, 1] > 150) & (picture[:, 300, 0] < 100))
    assert abs(green.min() - 189.5) <= 1.5
    assert abs(green.max() - 289.5) <= 1.5
    assert (drawn(strip(0.0), measure(strip(0.0), **VIEW))[0, 0] == (220, 40, 40)).all()
