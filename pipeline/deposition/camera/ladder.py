"""Calibrates a camera by a printed ladder, which is lines of known widths: the size of a pixel, the direction
of the line, and by how much beads of each width look wider than they are."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from pipeline.deposition.camera import bead, line


class Rung(NamedTuple):
    """One line of the ladder in the picture: where it was found, its width across it in px with its standard
    deviation, and why it could not be measured ("" if it could). `pose`: how it was turned."""

    found: line.ImageLine
    pose: line.Pose
    bead: bead.Bead
    angle_deg: float
    width_px: float
    deviation_px: float
    reason: str


class Ladder(NamedTuple):
    """`mm_per_px` > 0; `rotation_deg` of the lines; `known_mm` (n,) and `measured_px` (n,): their widths,
    growing; `edge_bias_px` (n,): by how much each looks wider than it is; `deviation_px`: the scatter of
    repeated pictures."""

    mm_per_px: float
    rotation_deg: float
    known_mm: np.ndarray
    measured_px: np.ndarray
    edge_bias_px: np.ndarray
    deviation_px: float


def rungs(
    frame: np.ndarray,
    count: int,
    *,
    tip: tuple[float, float] | None,
    hidden_px: float,
    longest_blur_px: float,
) -> list[Rung]:
    """Measures the `count` lines of one picture that stand out most; fewer if it shows fewer. A single line
    is searched at the nozzle's tip if that is given. Several lines are all light or all dark, because the
    stripes between them would be found too, one fewer than the lines."""
    if count == 1:
        return _of_sign(frame, 1, tip=tip, hidden_px=hidden_px, sign=0, longest_blur_px=longest_blur_px)
    both = [
        _of_sign(frame, count, tip=tip, hidden_px=hidden_px, sign=sign, longest_blur_px=longest_blur_px)
        for sign in (1, -1)
    ]
    return max(both, key=lambda found: sum(not rung.reason for rung in found))


def _of_sign(
    frame: np.ndarray,
    count: int,
    *,
    tip: tuple[float, float] | None,
    hidden_px: float,
    sign: int,
    longest_blur_px: float,
) -> list[Rung]:
    """Returns the lines of one colour: 1 light, -1 dark, 0 either."""
    mask = np.zeros(frame.shape[:2], bool)
    if tip is not None and count > 1:
        cv2.circle(hidden := mask.astype(np.uint8), (round(tip[0]), round(tip[1])), round(hidden_px), 1, -1)
        mask = hidden.astype(bool)
    out = []
    for _ in range(count):
        found = line.find(frame, tip=tip if count == 1 else None, hidden_px=hidden_px, mask=mask, sign=sign)
        if found is None:
            break
        behind = math.inf
        if tip is not None and count == 1:
            behind = max(math.dist(tip, (found.x, found.y)) - hidden_px, 0.0)
        out.append(_measured(frame, found, behind, longest_blur_px))
        mask |= _covered(frame.shape[:2], found)
    return out


def _measured(frame: np.ndarray, found: line.ImageLine, behind_px: float, longest_blur_px: float) -> Rung:
    """Measures the line of a picture. It is turned and measured a second time with the direction of the first
    measurement."""
    for _ in range(2):
        pose = line.pose_on(found, (frame.shape[0], frame.shape[1]), behind_px=behind_px)
        one = bead.measure(
            line.turned(frame, pose),
            columns=(0, pose.columns),
            longest_blur_px=longest_blur_px * pose.scale,
            sign=1 if found.contrast > 0 else -1,
        )
        if one.reason:
            break
        middle = float(np.nanmean(one.top + one.bottom) / 2)
        x, y = line.matrix(pose) @ np.array([pose.column, middle, 1.0])
        found = found._replace(
            angle_deg=found.angle_deg + one.angle_deg,
            x=float(x),
            y=float(y),
            width_px=max(one.width / pose.scale, 2.0),
        )
    return Rung(
        found, pose, one, found.angle_deg, one.width / pose.scale, one.deviation / pose.scale, one.reason
    )


def _covered(shape: tuple[int, int], found: line.ImageLine) -> np.ndarray:
    """Returns (h, w) bool: the pixels that a line and its edges cover."""
    a = math.radians(found.angle_deg)
    y, x = np.mgrid[: shape[0], : shape[1]]
    across = (y - found.y) * math.cos(a) - (x - found.x) * math.sin(a)
    return np.abs(across) < 0.6 * found.width_px + 4


def calibrated(
    known_mm: np.ndarray,
    measured_px: np.ndarray,
    angles_deg: np.ndarray,
    *,
    mm_per_px: float | None,
    from_tip: bool,
) -> Ladder:
    """Returns scale, direction and edge bias by width from pictures (N,) of lines of known widths.

    mm_per_px is the size of a pixel if it is known from something without edges, such as the pitch of the
    ladder. If it is None, it is the slope of known over measured widths, so the mean bias is the same at all
    of them. Directions `from_tip` count over the whole circle, others over half of it. Raises ValueError if
    there are fewer than three different widths, if a measurement failed, or if widths do not grow with the
    known ones.
    """
    known, px = np.asarray(known_mm, float), np.asarray(measured_px, float)
    fit = bead.calibrate(px, known)
    scale = fit.gain if mm_per_px is None else abs(mm_per_px)
    widths = np.unique(known)
    means = np.array([px[known == width].mean() for width in widths])
    spread = np.concatenate([px[known == width] - px[known == width].mean() for width in widths])
    free = max(len(px) - len(widths), 1)
    folds = 1 if from_tip else 2
    turn = folds * np.radians(np.asarray(angles_deg, float))
    rotation = math.degrees(math.atan2(np.sin(turn).mean(), np.cos(turn).mean())) / folds
    return Ladder(
        scale, rotation, widths, means, means - widths / scale, float(np.sqrt(spread @ spread / free))
    )


def pitch_px(found: Sequence[line.ImageLine]) -> float:
    """Returns the mean distance in px between the middles of neighbouring parallel lines. No edge affects it.
    Raises ValueError for fewer than two lines."""
    if len(found) < 2:
        raise ValueError(
            f"ladder: expected two lines or more to measure their pitch but found {len(found)}; "
            "take a picture that shows all of them"
        )
    a = math.radians(float(np.median([one.angle_deg for one in found])))
    across = np.sort([one.y * math.cos(a) - one.x * math.sin(a) for one in found])
    return float((across[-1] - across[0]) / (len(found) - 1))
