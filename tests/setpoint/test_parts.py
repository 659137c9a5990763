"""Which prints of a folder a network learns from, and which stand for the camera."""

import numpy as np
import pytest

from pipeline.setpoint.frames import familiar, nozzle_scene
from pipeline.setpoint.frames.rendered import LabelledFrames
from pipeline.setpoint.tables import WINDOW_PARTS
from pipeline.setpoint.vision import parts

WINDOW = 4


def prints(first: int, count: int, frames: int = WINDOW) -> LabelledFrames:
    """So many prints, each with a stretch of each class."""
    number = np.repeat(np.arange(first, first + count), 3 * frames)
    flow = np.tile(np.repeat([60.0, 100.0, 150.0], frames), count)
    n = len(flow)
    segment = 3 * number + np.digitize(flow, [90, 110])
    return LabelledFrames(
        np.zeros((n, 16, 48), np.uint8), nozzle_scene.label(flow), flow, np.full(n, 210.0), number, segment,
        np.ones(n, bool), np.full(n, "", object), np.full(n, 20.0), np.full((n, len(familiar.NAMES)), np.nan),
    )  # fmt: skip


def test_no_print_is_in_two_parts_and_each_part_has_its_share_of_them():
    shares = {"learned": 6, "held_out": 1, "calibration": 2, "judged": 2} | dict.fromkeys(WINDOW_PARTS, 1)
    dealt = parts.deal_prints(prints(0, 70), shares, np.random.default_rng(0))
    numbers = {part: set(frames.print_number.tolist()) for part, frames in dealt.items()}
    assert sum(map(len, numbers.values())) == len(set.union(*numbers.values())) == 70
    assert [len(numbers[part]) for part in shares] == pytest.approx([5 * n for n in shares.values()], abs=1)
    for frames in dealt.values():
        assert set(frames.label) == {0, 1, 2}
    with pytest.raises(ValueError, match="5 segments do not let each of 7 parts hold every class"):
        parts.deal_prints(prints(0, 5), shares, np.random.default_rng(0))


@pytest.mark.parametrize("part", ["judged", "calibration"])
def test_a_part_without_a_window_is_refused_in_one_sentence(part):
    given = {"learned": prints(0, 4), "judged": prints(10, 4), "calibration": prints(20, 4)}
    parts.check_parts(given, recorded=True, window=3 * WINDOW)
    given[part] = prints(200, 4, frames=WINDOW - 1)
    said = f"expected 12 frames in a row in the frames for {part}, found none in 36; record longer stretches"
    with pytest.raises(ValueError, match=said):
        parts.check_parts(given, recorded=True, window=3 * WINDOW)
