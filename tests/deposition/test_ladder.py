"""A printed ladder: scale, direction and edge bias by width come back."""

import numpy as np
import pytest

from pipeline.deposition.camera import ladder
from tests.foreign.camera import Eye, Stage, tip_of

WIDTHS = (0.5, 0.8, 1.1)


def measured(eye: Eye) -> tuple[list[float], list[float]]:
    px, angles = [], []
    for width in WIDTHS:
        stage = Stage(eye, np.full(1500, width), -10.0, np.random.default_rng(4))
        (rung,) = ladder.rungs(stage.frame(0.0), 1, tip=tip_of(eye), hidden_px=70, longest_blur_px=6.0)
        assert rung.reason == ""
        px.append(rung.width_px)
        angles.append(rung.angle_deg)
    return px, angles


@pytest.mark.parametrize("dark", [False, True])
def test_the_bias_of_edges_is_what_more_bias_adds(dark):
    """What the method itself errs by is the same in both, so that calibration takes both off."""
    eye = Eye(angle_deg=213.0, dark=dark, ground="striped", height=360, width=480, mm_per_px=0.0105)
    plain, angles = measured(eye)
    wider, _ = measured(eye._replace(edge_bias_px=1.5))
    one, other = (
        ladder.calibrated(np.array(WIDTHS), np.array(px), np.array(angles), mm_per_px=0.0105, from_tip=True)
        for px in (plain, wider)
    )
    np.testing.assert_allclose(other.edge_bias_px - one.edge_bias_px, 1.5, atol=0.15)
    assert one.rotation_deg % 360 == pytest.approx(213.0, abs=0.2)


def test_without_a_pitch_the_scale_is_the_slope_of_the_widths():
    known = np.array([0.5, 0.9, 1.3, 0.5, 0.9, 1.3])
    one = ladder.calibrated(known, 100 * known + 1.2, np.full(6, 179.0), mm_per_px=None, from_tip=False)
    assert one.mm_per_px == pytest.approx(0.01)
    np.testing.assert_allclose(one.edge_bias_px, 1.2, atol=1e-9)
    assert one.rotation_deg % 180 == pytest.approx(179.0)
    assert one.deviation_px == pytest.approx(0, abs=1e-9)


def test_directions_of_half_a_circle_are_averaged_across_its_end():
    known = np.array([0.5, 0.9, 1.3])
    one = ladder.calibrated(known, 100 * known, np.array([179.0, 1.0, 0.0]), mm_per_px=None, from_tip=False)
    assert abs(one.rotation_deg) < 0.1


def test_lines_side_by_side_are_told_apart_and_their_pitch_is_that_of_their_middles():
    frame = np.full((400, 400), 60, np.uint8)
    for middle, width in ((80, 40), (190, 60), (300, 80)):
        frame[middle - width // 2 : middle + width // 2] = 170
    found = ladder.rungs(frame, 3, tip=None, hidden_px=0.0, longest_blur_px=6.0)
    assert sorted(rung.width_px for rung in found) == pytest.approx([40, 60, 80], abs=0.3)
    assert ladder.pitch_px([rung.found for rung in found]) == pytest.approx(110, abs=0.2)
    assert (
        len(ladder.rungs(np.full((400, 400), 60, np.uint8), 3, tip=None, hidden_px=0.0, longest_blur_px=6))
        == 0
    )
    with pytest.raises(ValueError, match="expected two lines or more to measure their pitch but found 1"):
        ladder.pitch_px([found[0].found])
