"""Camera frame -> sub-pixel bead width along the line, or the reason why there is none; pixels -> millimetres
on known widths; width -> cross-section."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from pipeline.deposition.camera import edges
from pipeline.deposition.camera.edges import BLOCK, FEWEST_BLOCKS


class Bead(NamedTuple):
    """The bead in one frame. columns (n,) are the centres of blocks of 8 columns; widths (n,), top (n,) and
    bottom (n,) in px across the line, pixel centres at whole rows.

    widths is 0 where the block shows background only and NaN where it cannot be read. `width` is the line
    fitted robustly through the widths, at the middle of the blocks that it uses, and `deviation` its standard
    deviation; both NaN where `reason` is not empty: "no bead", "saturated", "cut by the frame", "blurred".
    `angle_deg` is the line's direction against the rows, `blur_px` the standard deviation of the edge,
    `contrast` bead less background in levels.
    """

    columns: np.ndarray
    widths: np.ndarray
    top: np.ndarray
    bottom: np.ndarray
    width: float
    deviation: float
    angle_deg: float
    blur_px: float
    contrast: float
    reason: str


def area(width: np.ndarray | float, contact_angle_deg: float) -> np.ndarray | float:
    """Cross-section in mm^2 of a bead w mm wide, the circular segment that meets the substrate at theta:

        A = c w^2,   c = (theta - sin theta cos theta) / (4 sin^2 theta)

    At 90 degrees c = pi/8. Raises ValueError if theta is not between 0 and 180 degrees.
    """
    if not 0 < contact_angle_deg < 180:
        raise ValueError(
            f"bead: expected a contact angle between 0 and 180 degrees but found {contact_angle_deg:g}; "
            "measure it on a cut bead"
        )
    theta = math.radians(contact_angle_deg)
    return (theta - math.sin(theta) * math.cos(theta)) / (4 * math.sin(theta) ** 2) * width**2


class WidthCalibration(NamedTuple):
    """Width in mm = gain px + offset. deviation is the r.m.s. of the residuals (mm, two parameters taken
    off), residuals (n,) known less fitted in mm."""

    gain: float
    offset: float
    deviation: float
    residuals: np.ndarray


def calibrate(widths_px: np.ndarray, known_mm: np.ndarray) -> WidthCalibration:
    """Gain (mm/px) and offset (mm) by least squares from measured widths (n,)
    in px of beads or gauges of known widths (n,) in mm.

    Raises ValueError for fewer than three different widths, a measurement that
    failed, or widths that do not grow with the known ones.
    """
    px, mm = np.asarray(widths_px, float), np.asarray(known_mm, float)
    if px.shape != mm.shape or px.ndim != 1 or len(np.unique(mm)) < 3:
        raise ValueError(
            "calibration: expected at least three different known widths, one measurement each or more, "
            f"but found {px.shape} measured for "
            f"{len(np.unique(mm))} different; add frames of other widths"
        )
    if not np.isfinite(px).all():
        raise ValueError(
            f"calibration: expected a width in every frame but {np.count_nonzero(~np.isfinite(px))} of "
            f"{len(px)} have none; look at their reasons"
        )
    J = np.column_stack([px, np.ones(len(px))])
    gain, offset = np.linalg.lstsq(J, mm, rcond=None)[0]
    residuals = mm - gain * px - offset
    if gain <= 0:
        raise ValueError(
            "calibration: expected widths in px that grow with the known widths but found a gain of "
            f"{gain:.3g} mm/px; check which frame shows which width"
        )
    return WidthCalibration(
        float(gain), float(offset), float(np.sqrt(residuals @ residuals / (len(px) - 2))), residuals
    )


def drawn(frame: np.ndarray, bead: Bead) -> np.ndarray:
    """The frame as (h, w, 3) uint8 RGB with the measured edges as green lines, for a report; blocks without a
    width stay bare, a rejected frame gets a red border."""
    scale = 1 if frame.dtype == np.uint8 else 1 / 257
    picture = cv2.cvtColor((gray(frame) * scale).astype(np.uint8), cv2.COLOR_GRAY2RGB)
    if bead.reason:
        cv2.rectangle(picture, (0, 0), (picture.shape[1] - 1, picture.shape[0] - 1), (220, 40, 40), 5)
    for edge in (bead.top, bead.bottom):
        # eighths of a pixel, so that the line lies where the edge was measured
        points = np.rint(8 * np.column_stack([bead.columns, edge])[np.isfinite(edge)]).astype(np.int32)
        cv2.polylines(picture, [points.reshape(-1, 1, 2)], False, (60, 220, 60), 1, cv2.LINE_AA, 3)
    return picture


def gray(frame: np.ndarray) -> np.ndarray:
    """frame as (h, w) uint8 or uint16: gray as it is, colour (h, w, 3 or 4) in OpenCV's order BGR(A) by 0.114
    B + 0.587 G + 0.299 R. Raises ValueError for all else."""
    kind = "frame: expected (height, width) or (height, width, 3 or 4) of uint8 or uint16"
    if frame.dtype not in (np.uint8, np.uint16) or frame.ndim not in (2, 3):
        raise ValueError(
            f"{kind} but found {frame.shape} of {frame.dtype}; convert it without scaling it per frame"
        )
    if frame.ndim == 3 and frame.shape[2] in (3, 4):
        return cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY if frame.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)
    if frame.ndim == 3 and frame.shape[2] != 1:
        raise ValueError(f"{kind} but found {frame.shape} of {frame.dtype}; convert it to gray")
    return frame.reshape(frame.shape[:2])


def measure(frame: np.ndarray, *, columns: tuple[int, int], longest_blur_px: float, sign: int = 0) -> Bead:
    """The bead's width in every block of 8 columns of frame[:, first:last] (`columns`: the part that the
    nozzle does not hide), the line along the image's x.

    Profile of each block less the background between its ends; outermost significant run; half level of the
    plateau beside the edge, clipped at the bead's median so that the specular line cannot lift it, and
    extrapolated to the edge against shading. Bright and dark beads alike, or those of one `sign` (1 bright,
    -1 dark) where the colour is known and shadows lie about. A frame without a usable bead comes
    back with its reason; one that is no image, or too small, raises ValueError.
    """
    return measure_all([frame], columns=columns, longest_blur_px=longest_blur_px, sign=sign)[0]


def measure_all(
    frames: Sequence[np.ndarray], *, columns: tuple[int, int], longest_blur_px: float, sign: int = 0
) -> list[Bead]:
    """`measure` of each frame, all of one size and kind: the same numbers, each in
    a third of the time where sixteen come together."""
    frames = [gray(frame) for frame in frames]
    kinds = {(frame.shape, frame.dtype.name) for frame in frames}
    if len(kinds) > 1:
        raise ValueError(
            f"frames: expected frames of one size and kind but found {sorted(kinds)}; measure them in groups"
        )
    if not frames:
        return []
    g = edges.profiles(frames, columns)
    n = g.shape[1]
    where = columns[0] + BLOCK * np.arange(n) + (BLOCK - 1) / 2
    coarse = edges.coarse(g, np.iinfo(frames[0].dtype).max / 255, sign)
    # most frames of a trial are bare
    (top, bottom), blur = (
        edges.fine(g, coarse) if coarse.solid.any() else (coarse.rows, np.full(len(frames), math.nan))
    )
    good = coarse.solid & (bottom > top)
    widths = np.where(coarse.solid | coarse.unclear | coarse.cut, math.nan, 0.0)
    cut, few = coarse.cut.sum(axis=1) > n / 2, good.sum(axis=1) < FEWEST_BLOCKS
    out = []
    for i in range(len(frames)):
        reasons = {
            "cut by the frame": cut[i],
            "saturated": coarse.saturated[i],
            "no bead": few[i],
            "blurred": blur[i] > longest_blur_px,
        }
        reason = next((name for name, holds in reasons.items() if holds), "")
        if reason:
            # in a frame without a bead what is bare substrate stays 0, in a spoilt one nothing is measured
            nothing = np.full(n, math.nan)
            measured = widths[i] if reason == "no bead" else nothing
            out.append(
                Bead(where, measured, nothing, nothing, *[math.nan] * 3, float(blur[i]), math.nan, reason)
            )
        else:
            out.append(
                _bead(
                    where,
                    widths[i],
                    good[i],
                    top[i],
                    bottom[i],
                    float(blur[i]),
                    float(coarse.sign[i] * coarse.plateau[i]),
                )
            )
    return out


def _bead(
    where: np.ndarray,
    widths: np.ndarray,
    good: np.ndarray,
    top: np.ndarray,
    bottom: np.ndarray,
    blur: float,
    contrast: float,
) -> Bead:
    """The line through the edges: vertical distances are turned to widths across it."""
    x, lower, upper = where[good], top[good], bottom[good]
    x = x - x.sum() / len(x)
    slope = float(x @ (lower + upper) / (2 * x @ x))
    widths[good] = across = (upper - lower) / math.hypot(1.0, slope)
    top[~good] = bottom[~good] = math.nan
    return Bead(
        where, widths, top, bottom, *_line(x, across), math.degrees(math.atan(slope)), blur, contrast, ""
    )


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Value at x = 0 of the line through y and its standard deviation; points beyond three robust deviations
    of the first fit are left out of the second."""
    a, b = x, y
    for _ in range(2):
        middle, mean = a.sum() / len(a), b.sum() / len(b)
        a = a - middle
        slope = a @ b / max(a @ a, 1e-9)
        miss = np.abs(y - (mean - slope * middle) - slope * x)
        spread = 1.4826 * float(np.partition(miss, len(miss) // 2)[len(miss) // 2])
        keep, count = miss <= 3 * max(spread, 1e-9), len(a)
        a, b = x[keep], y[keep]
    return float(mean - slope * middle), spread / math.sqrt(count)
