"""What a camera's pictures tell of themselves: moved, other light, other ink,
out of focus; and nothing where nothing changed."""

import numpy as np
import pytest

from pipeline.deposition.camera import rendering
from pipeline.nightly import camera_drift

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
