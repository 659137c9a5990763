"""Of a user's folder: which prints the classifier learns from, and whose windows stand for the camera."""

import numpy as np
import pytest

from pipeline.setpoint.frames import familiar, nozzle_scene
from pipeline.setpoint.frames.rendered import LabelledFrames
from pipeline.setpoint.tables import FRAME_PARTS, WINDOW_PARTS
from pipeline.setpoint.vision import parts

WINDOW = 4


def split_windows(given: dict[str, LabelledFrames]):
    return parts.split_windows(given, WINDOW_PARTS, window=WINDOW, rng=np.random.default_rng([0, 1]))


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


def folder(learned: int, frames: int = WINDOW) -> dict[str, LabelledFrames]:
    counts = dict(zip(FRAME_PARTS, (learned, 4, 8, 8), strict=True))
    begins = np.cumsum([0, *counts.values()])
    return {
        part: prints(int(at), count, frames)
        for at, (part, count) in zip(begins, counts.items(), strict=False)
    }


def numbers(frames: LabelledFrames) -> set[int]:
    return set(frames.print_number.tolist())


def test_where_prints_suffice_windows_are_of_none_that_the_classifier_has():
    given = folder(60)
    by_part, windows, apart = split_windows(given)
    assert apart and tuple(by_part) == FRAME_PARTS and tuple(windows) == WINDOW_PARTS
    several = [numbers(frames) for frames in (*by_part.values(), *windows.values())]
    assert sum(map(len, several)) == len(set.union(*several)) == 80
    # two thirds stay, the others are shared alike
    assert [len(one) for one in (several[0], *several[4:])] == pytest.approx([40, 7, 7, 7], abs=1)
    for part in ("held_out", "calibration", "judged"):
        assert by_part[part] is given[part]
    for frames in windows.values():
        assert set(frames.label) == {0, 1, 2} and len(frames.label) == 3 * WINDOW * len(numbers(frames))


@pytest.mark.parametrize("given", [folder(20), folder(2), folder(60, frames=WINDOW - 1)])
def test_where_they_do_not_the_classifier_keeps_all_and_it_is_said(given):
    given |= {part: prints(100 + 20 * k, 4) for k, part in enumerate(FRAME_PARTS[1:])}
    by_part, windows, apart = split_windows(given)
    assert not apart and by_part is given
    assert [windows[part] is given[of] for part, of in zip(
        WINDOW_PARTS, ("calibration", "held_out", "judged"), strict=True)] == [True] * 3  # fmt: skip


@pytest.mark.parametrize("part", FRAME_PARTS[1:])
def test_a_part_without_a_window_is_refused_in_one_sentence(part):
    given = folder(4)
    given[part] = prints(200, 4, frames=WINDOW - 1)
    with pytest.raises(
        ValueError, match=f"expected 4 frames in a row at one class .* for {part}, found none"
    ):
        split_windows(given)
    given[part] = prints(200, 4)._replace(valid=np.zeros(12 * WINDOW, bool))
    with pytest.raises(ValueError, match=f"for {part}, found none in 48; record longer stretches"):
        split_windows(given)
