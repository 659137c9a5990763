"""Turns the frames of one film into key areas: the crop around the tip, the direction of the line if it is
known or visible in the motion of the ground, and the reason if a frame has no key area."""

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.setpoint.frames import familiar, key_area, travel

# successive frames that are searched together for the ground's motion
IN_A_ROW = 20
# cameras of 10 and 12 bits may leave the upper bits of 16 empty; a picture as dark as that
# has fewer than 16 of 256 gray levels in any case
FILLED_BITS = 12
NO_TIP, UNUSABLE, SEVERAL = "no tip is known", "the frame cannot be used", "several lines"
REMEDIES = {
    NO_TIP: "find it with ./run beadline calibrate tip IMAGE, and set tip_px in params.yaml",
    UNUSABLE: "find the tip of these pictures with ./run beadline calibrate tip IMAGE, and set tip_px in "
    "params.yaml",
    SEVERAL: "write travel_direction_deg, the way the line leaves the tip in the picture, beside the frames, "
    "or take frames at 10 a second and more, in which the motion can be seen",
}


class FrameKeyAreas(NamedTuple):
    """The front end's results for n frames: `images` (n, 16, 48) uint8, zeros if rejected; `angle_deg`,
    `miss_px`, `score`, `padded_share` (n,), NaN if the frame was not searched; `tip` (n, 2) in px;
    `surroundings` (n, measures) float32 of the first accepted of every familiar.MEASURED frames, NaN for the
    others; n `reasons`, empty if there is a key area; n `digests` of the frames' content."""

    images: np.ndarray
    angle_deg: np.ndarray
    miss_px: np.ndarray
    score: np.ndarray
    padded_share: np.ndarray
    tip: np.ndarray
    surroundings: np.ndarray
    reasons: list[str]
    digests: list[str]


def find_key_areas(
    frames: Iterable[np.ndarray | str], tips: np.ndarray, directions_deg: np.ndarray, *, least_score: float
) -> FrameKeyAreas:
    """Finds the key areas of n frames of one film. A frame may also be a text, the reason why there is no
    picture; digests are left empty. An unknown direction (NaN) is estimated from the motion of the ground in
    successive frames; IN_A_ROW of them are in memory at a time."""
    areas: list[key_area.KeyArea] = []
    surroundings = np.full((len(tips), len(familiar.NAMES)), np.nan, np.float32)
    walking, measured = zip(frames, tips, directions_deg, strict=True), -1
    while some := list(itertools.islice(((_cropped(f, tip), d) for f, tip, d in walking), IN_A_ROW)):
        first = len(areas)
        areas += _found([one for one, _ in some], [float(d) for _, d in some], least_score)
        for i in range(first, len(areas)):
            cropped, area = some[i - first][0], areas[i]
            if i // familiar.MEASURED > measured and not area.reason and not isinstance(cropped, str):
                surroundings[i] = familiar.surroundings(cropped.gray, area.angle_deg, area.miss_px)
                measured = i // familiar.MEASURED
    images = np.array([area.image for area in areas], np.uint8).reshape(-1, *key_area.SHAPE)
    figures = (
        np.array([getattr(area, name) for area in areas], float)
        for name in ("angle_deg", "miss_px", "score", "padded_share")
    )
    reasons = [area.reason for area in areas]
    tip = np.where(np.isfinite(tips), tips, np.nan).reshape(-1, 2)
    return FrameKeyAreas(images, *figures, tip, surroundings, reasons, [""] * len(areas))


def _found(
    crops: Sequence[key_area.Crop | str], directions_deg: Sequence[float], least_score: float
) -> list[key_area.KeyArea]:
    """Returns the key areas of successive crops: along the given direction, else along the motion of the
    ground if it is visible, else along the only line there is."""
    moving = _motion(crops, directions_deg)
    areas = []
    for i, (one, told) in enumerate(zip(crops, directions_deg, strict=True)):
        if isinstance(one, str):
            empty = np.zeros(key_area.SHAPE, np.uint8)
            areas.append(key_area.KeyArea(empty, np.nan, np.nan, np.nan, np.nan, one))
        elif np.isfinite(told):
            areas.append(key_area.find_in(one, least_score=least_score, direction_deg=told))
        elif np.isfinite(moving[i][0]):
            areas.append(
                key_area.find_in(
                    one, least_score=least_score, direction_deg=moving[i][0], leeway_deg=travel.LEEWAY_DEG
                )
            )
        else:
            area = key_area.find_in(one, least_score=least_score)
            several = area.reason.startswith(SEVERAL)
            areas.append(area._replace(reason=f"{area.reason} ({moving[i][1]})") if several else area)
    return areas


def _motion(
    crops: Sequence[key_area.Crop | str], directions_deg: Sequence[float]
) -> dict[int, tuple[float, str]]:
    """Returns {place: (direction or NaN, why not)} for the frames without a given direction, from the frames
    that follow one another."""
    unknown = [
        i
        for i, (one, told) in enumerate(zip(crops, directions_deg, strict=True))
        if not isinstance(one, str) and not np.isfinite(told)
    ]
    out: dict[int, tuple[float, str]] = {}
    for run in np.split(np.array(unknown, int), np.flatnonzero(np.diff(unknown) > 1) + 1):
        motion = travel.travel([crops[i].gray for i in run])
        out |= dict(
            zip(run.tolist(), zip(motion.direction_deg.tolist(), motion.reasons, strict=True), strict=True)
        )
    return out


def _cropped(frame: np.ndarray | str, tip: np.ndarray) -> key_area.Crop | str:
    """Returns the crop around the tip (x, y), or the reason why there is none."""
    reason = frame if isinstance(frame, str) else _shallow(frame)
    if reason or isinstance(frame, str) or not np.isfinite(tip).all():
        return reason or NO_TIP
    try:
        return key_area.crop(frame, (float(tip[0]), float(tip[1])))
    except ValueError as error:
        return f"{UNUSABLE}: {error}"


def _shallow(frame: np.ndarray) -> str:
    """Returns why a 16-bit frame is rejected if the camera filled only its lower bits, since the front end
    would see black; else ""."""
    if frame.dtype != np.uint16 or frame.max() >= 1 << FILLED_BITS:
        return ""
    return (
        f"{UNUSABLE}: its 16 bits hold {frame.max()} at most, as of a camera of fewer bits; "
        "write its gray levels over all of 0 to 65535"
    )
