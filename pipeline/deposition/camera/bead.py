"""Measures the width of the bead along the line in a camera frame, to fractions of a pixel, or gives the
reason why there is none. Also converts pixels to millimetres by known widths, and width to cross-section.

Both edges lie along the rows of the frame. First the outermost significant run is found, then the half level
of the plateau beside each edge. A specular line on the bead has a stronger gradient than its edges, glare
changes the background, shading bends the plateau, and texture lies beside it, so nothing here looks for the
strongest gradient. The functions for edges take k frames at once, because k small calls cost more than one
large call.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import scipy.special

# columns averaged into one profile (64 um at 125 px/mm, an eighth of a
# nozzle) and rows averaged to find the run
BLOCK, COARSE = 8, 4
# rows outward and inward of an edge in its window; levels of the background, beside the edge and deeper
# inside are read at rows that even a blurred edge does not reach
OUT, IN = 12, 20
OUTSIDE, NEAR, FAR = np.arange(-OUT, -5), np.arange(5, 9), np.arange(12, 21)
NEAR_ROW, FAR_ROW, NEAR_VARIANCE, FAR_VARIANCE = (
    float(NEAR.mean()),
    float(FAR.mean()),
    float(NEAR.var()),
    float(FAR.var()),
)
LEVELS = np.zeros((OUT + 1 + IN, 3), np.float32)
LEVELS[OUT + OUTSIDE, 0], LEVELS[OUT + NEAR, 1], LEVELS[OUT + FAR, 2] = (
    1 / len(OUTSIDE),
    1 / len(NEAR),
    1 / len(FAR),
)
# an edge is sought outward from here: past it a dark bead's specular line may dip
INSIDE = OUT + 5
# the top edge lies towards lower rows of its bead, the bottom edge towards higher ones
OUTWARD = np.array([-1, 1]).reshape(2, 1, 1)
OUTWARDS = OUTWARD * np.arange(3).reshape(3, 1, 1, 1)
REACH = -OUTWARD[..., None] * np.arange(-OUT, IN + 1)
THREE, THREE_VARIANCE = np.full((1, 3), 1 / 3, np.float32), 2 / 3
# if one edge is brighter than the other by this share of the plateau, the specular line lies beside it
UNEVEN = 0.12
# edge, blur and shading settle within this many rounds, within two if the edge is sharp
ROUNDS = 12
# a coarse row is bead if it exceeds the background by this many standard deviations (one in 10^9 rows of
# noise does) and by this share of the steps
SIGNIFICANT, STEEP = 6.0, 0.2
# fewer levels (of 0..255) between bead and ground are what rounding and compression make of light and noise
FAINTEST = 6.0
# a stronger blur, px, is read too low, up to this one
RESOLVED_PX, UNRESOLVED_PX = 3.3, 6.0
# it is grain, not a line, if its width bends by more from block to block, as share of the width plus px
RAGGED, RAGGED_PX = 0.1, 2.0
# a plateau above all levels: no bead
NONE = 1e9
# fewer blocks are dirt, not a line; less height is no measurable bead
FEWEST_BLOCKS, FEWEST_ROWS, FEWEST_LINES = 4, 2, 48


class Bead(NamedTuple):
    """The bead in one frame. columns (n,) are the centres of blocks of 8 columns; widths (n,), top (n,) and
    bottom (n,) in px across the line, pixel centres at whole rows.

    widths is 0 if the block shows background only and NaN if it cannot be read. `width` is the line fitted
    robustly through the widths, at the middle of the blocks that it uses, and `deviation` its standard
    deviation. Both are NaN if `reason` is not empty: "no bead", "saturated", "cut by the frame", "blurred",
    "faint", "ragged". `angle_deg` is the line's direction against the rows, `blur_px` the standard deviation
    of the edge, `contrast` bead less background in levels.
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
    """Returns the cross-section in mm^2 of a bead w mm wide, the circular segment that meets the substrate at
    theta:

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
    """Width in mm = gain px + offset. `deviation`: r.m.s. of the residuals in mm (with two degrees of freedom
    subtracted); `residuals` (n,): known less fitted in mm."""

    gain: float
    offset: float
    deviation: float
    residuals: np.ndarray


def calibrate(widths_px: np.ndarray, known_mm: np.ndarray) -> WidthCalibration:
    """Returns gain (mm/px) and offset (mm) by least squares from measured widths (n,) in px of beads or
    gauges of known widths (n,) in mm.

    Raises ValueError if there are fewer than three different widths, if a measurement failed, or if widths do
    not grow with the known ones.
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


def edge_deviation(blur_px: float, contrast: float) -> float:
    """Returns by how much in px a width may be off at this blur and contrast (in levels of 0..255), in
    addition to noise. A blurred edge has not reached its final level in the rows that are read, and half a
    level of rounding shifts it.

        3 s Phi(-x / s) + sqrt(2 pi) s / contrast,   s = blur_px, x = the first row that is read

    A blur above RESOLVED_PX counts as at least UNRESOLVED_PX.
    """
    blur_px = max(blur_px, UNRESOLVED_PX) if blur_px > RESOLVED_PX else blur_px
    unrest = blur_px * float(scipy.special.ndtr(-NEAR[0] / blur_px))
    return 3 * unrest + math.sqrt(2 * math.pi) * blur_px / abs(contrast)


def drawn(frame: np.ndarray, bead: Bead) -> np.ndarray:
    """Returns the frame as (h, w, 3) uint8 RGB with the measured edges as green lines, for a report. Blocks
    without a width have no line; a rejected frame has a red border."""
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
    """Returns the frame as (h, w) uint8 or uint16. Gray is kept; colour (h, w, 3 or 4) in OpenCV's order
    BGR(A) becomes 0.114 B + 0.587 G + 0.299 R. Raises ValueError for any other shape or type."""
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
    """Measures the bead's width in every block of 8 columns of frame[:, first:last] (`columns`: the part that
    the nozzle does not hide). The line lies along the image's x.

    The profile of each block is taken less the background between its ends. In it the outermost significant
    run is found, and then the half level of the plateau beside each edge. This plateau is clipped at the
    bead's median, so that the specular line cannot raise it, and extrapolated to the edge against shading.
    Bright and dark beads are measured alike; `sign` (1 bright, -1 dark) restricts the search to one kind, if
    the colour is known and there are shadows. A frame without a usable bead is returned with its reason.
    Raises ValueError if a frame is no image or too small.
    """
    return measure_all([frame], columns=columns, longest_blur_px=longest_blur_px, sign=sign)[0]


def measure_all(
    frames: Sequence[np.ndarray], *, columns: tuple[int, int], longest_blur_px: float, sign: int = 0
) -> list[Bead]:
    """Returns `measure` of each frame, all of one size and type, with identical numbers. With sixteen frames
    at once each takes a third of the time. Raises ValueError also if sizes or types differ."""
    frames = [gray(frame) for frame in frames]
    kinds = {(frame.shape, frame.dtype.name) for frame in frames}
    if len(kinds) > 1:
        raise ValueError(
            f"frames: expected frames of one size and kind but found {sorted(kinds)}; measure them in groups"
        )
    if not frames:
        return []
    g = profiles(frames, columns)
    n, white = g.shape[1], np.iinfo(frames[0].dtype).max
    where = columns[0] + BLOCK * np.arange(n) + (BLOCK - 1) / 2
    rough = coarse(g, white / 255, sign)
    # most frames of a trial are bare
    (top, bottom), blur = (
        fine(g, rough) if rough.solid.any() else (rough.rows, np.full(len(frames), math.nan))
    )
    good = rough.solid & (bottom > top)
    widths = np.where(rough.solid | rough.unclear | rough.cut, math.nan, 0.0)
    cut, few = rough.cut.sum(axis=1) > n / 2, good.sum(axis=1) < FEWEST_BLOCKS
    out = []
    for i in range(len(frames)):
        reasons = {
            "cut by the frame": cut[i],
            "saturated": rough.saturated[i],
            "no bead": few[i],
            "blurred": blur[i] > longest_blur_px,
            "faint": rough.plateau[i] < FAINTEST * white / 255,
            "ragged": not few[i] and _is_ragged((bottom - top)[i, good[i]]),
        }
        reason = next((name for name, holds in reasons.items() if holds), "")
        if reason:
            # in a frame without a bead the bare substrate keeps width 0; in a spoilt frame nothing is
            # measured
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
                    float(rough.sign[i] * rough.plateau[i]),
                )
            )
    return out


def _is_ragged(widths: np.ndarray) -> bool:
    """Returns whether the widths (n,) in px of neighbouring blocks zigzag, as grain does but no line."""
    bends = np.abs(np.diff(widths, 2))
    return bool(np.median(bends) > RAGGED * np.median(widths) + RAGGED_PX)


def _bead(
    where: np.ndarray,
    widths: np.ndarray,
    good: np.ndarray,
    top: np.ndarray,
    bottom: np.ndarray,
    blur: float,
    contrast: float,
) -> Bead:
    """Returns the bead with the line through its edges. Vertical distances are converted to widths across the
    line."""
    x, lower, upper = where[good], top[good], bottom[good]
    x = x - x.sum() / len(x)
    slope = float(x @ (lower + upper) / (2 * x @ x))
    widths[good] = across = (upper - lower) / math.hypot(1.0, slope)
    top[~good] = bottom[~good] = math.nan
    return Bead(
        where, widths, top, bottom, *_line(x, across), math.degrees(math.atan(slope)), blur, contrast, ""
    )


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Returns the value at x = 0 of the line through y, and its standard deviation. Points beyond three
    robust deviations of the first fit are left out of the second."""
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


# ---- edges


def profiles(frames: list[np.ndarray], columns: tuple[int, int]) -> np.ndarray:
    """Returns sums (frames, blocks, rows) of 8 columns each. The copy is transposed so that every later pass
    reads memory in order. Raises ValueError if the frame has too few rows or columns."""
    first, last = columns
    h, w = frames[0].shape
    n = (last - first) // BLOCK
    if not 0 <= first < last <= w or n < FEWEST_BLOCKS or h < FEWEST_LINES:
        raise ValueError(
            f"frame: expected at least {FEWEST_LINES} rows, and {FEWEST_BLOCKS * BLOCK} columns between "
            f"{first} and {last}, "
            f"but found {h} rows of {w}; check the camera's region of interest"
        )
    g = np.empty((len(frames), n, h), np.uint16 if frames[0].dtype == np.uint8 else np.uint32)
    for sums, frame in zip(g, frames, strict=True):
        across = cv2.transpose(frame[:, first : first + n * BLOCK]).reshape(n, BLOCK, h)
        np.add.reduce(across, axis=1, dtype=g.dtype, out=sums)
    return g


class CoarseEdges(NamedTuple):
    """The coarse edges of k frames. `rows` (2, k, n); blocks (k, n) bool: `solid` with a solid run, `unclear`
    with an unclear one, `cut` with one that the frame cuts; `plateau` (k,) in levels above background, NONE
    without a bead; `sign` (k,); `saturated` (k,)."""

    rows: np.ndarray
    solid: np.ndarray
    unclear: np.ndarray
    cut: np.ndarray
    plateau: np.ndarray
    sign: np.ndarray
    saturated: np.ndarray


def coarse(g: np.ndarray, level: float, bead_sign: int = 0) -> CoarseEdges:
    """Finds the outermost run above half the plateau in each block, on rows averaged by four.

    Background is the straight line between the means of the first and the last sixteenth of the rows. Its
    noise counts as at least half a gray level. Significant blocks have steps over 16 rows; glare rises
    without such steps. The plateau is the median of all values that reach STEEP of those steps.
    """
    k, n, h = g.shape[0], g.shape[1], g.shape[2] // COARSE
    m, ends, line = _background(h)
    g = g[:, :, : h * COARSE]
    c = (g[..., ::4] + g[..., 1::4] + g[..., 2::4] + g[..., 3::4]).astype(np.float32) * np.float32(
        1 / (BLOCK * COARSE)
    )
    margins = c @ ends
    d = c - margins @ line
    step, plateau, sign = np.empty(k), np.empty(k), np.empty(k)
    for i in range(k):
        step[i], plateau[i], sign[i] = _plateau(d[i], m, level, bead_sign)
        if sign[i] < 0:
            d[i] *= -1
    half = (plateau / 2).astype(np.float32)[:, None, None]
    inside = d > half
    at = np.stack([inside.argmax(axis=2), h - 1 - inside[..., ::-1].argmax(axis=2)])
    rows = np.add.reduce(inside, axis=2, dtype=np.int32)
    # the first row inside, and the first and second outside of it
    beside = np.minimum(np.maximum(at + OUTWARDS, 0), h - 1) + (h * np.arange(k * n)).reshape(k, n)
    inner, outer, far = d.ravel().take(beside)
    back = (inner - half[..., 0]) / np.maximum(inner - outer, 1e-6)
    edges = COARSE * (at + OUTWARD * np.minimum(np.maximum(back, 0), 1)) + (COARSE - 1) / 2
    some = rows >= FEWEST_ROWS
    solid = (rows > 0.6 * (at[1] - at[0] + 1)) & (inner - far > STEEP * half[..., 0]).all(axis=0)
    # a bead in the first or last rows passes for background there
    lopsided = np.abs(margins[..., 0] - margins[..., 1]) > step[:, None] / 2
    cut = some & ((at[0] < m) | (at[1] >= h - m) | ~solid & lopsided)
    white = np.add.reduce((c > 0.98 * 255 * level).reshape(k, -1), axis=1, dtype=np.int32)
    return CoarseEdges(
        edges, some & solid & ~cut, some & ~solid & ~cut, cut, plateau, sign, white > 0.3 * rows.sum(axis=1)
    )


def _plateau(d: np.ndarray, m: int, level: float, bead_sign: int) -> tuple[float, float, float]:
    """Returns for one frame: median of the significant steps, median of the values that reach STEEP of them,
    sign of the bead; NONE, NONE and 1 if nothing is significant."""
    noise = max(math.hypot(cv2.norm(d[:, :m]), cv2.norm(d[:, -m:])) / math.sqrt(2 * m * len(d)), level / 2)
    steps = d[:, 4:] - d[:, :-4]
    steps = np.maximum(steps.max(axis=1), -steps.min(axis=1))
    steps = steps[steps > SIGNIFICANT * math.sqrt(2) * noise]
    if len(steps) < FEWEST_BLOCKS:
        return NONE, NONE, 1.0
    step = float(np.partition(steps, len(steps) // 2)[len(steps) // 2])
    threshold = max(STEEP * step, SIGNIFICANT * noise)
    up, down = d > threshold, d < -threshold
    light = bead_sign > 0 or (bead_sign == 0 and np.count_nonzero(up) >= np.count_nonzero(down))
    sign, rows = (1.0, up) if light else (-1.0, down)
    values = np.abs(d[rows])
    if not len(values):
        return NONE, NONE, 1.0
    return step, float(np.partition(values, len(values) // 2)[len(values) // 2]), sign


@functools.cache
def _background(h: int) -> tuple[int, np.ndarray, np.ndarray]:
    """Returns the rows in a sixteenth; a matrix (h, 2) that gives the means of the first and of the last
    sixteenth; a matrix (2, h) that gives the straight line between them."""
    m = max(h // 16, 2)
    ends = np.zeros((h, 2), np.float32)
    ends[:m, 0] = ends[-m:, 1] = 1 / m
    share = ((np.arange(h) - (m - 1) / 2) / (h - m)).astype(np.float32)
    return m, ends, np.stack([1 - share, share])


def fine(g: np.ndarray, first: CoarseEdges) -> tuple[np.ndarray, np.ndarray]:
    """Returns the sub-pixel rows (2, k, n) of the top and the bottom edge, and each frame's blur (k,):
    standard deviation of its edge in px, NaN without a bead.

    The half level lies between the local background and the plateau beside the edge, which is extrapolated to
    the edge against shading. Shading is the same at both edges. If one edge is brighter than the other, the
    specular line lies beside it, and the other edge gives the plateau of both.
    """
    k, n, h = g.shape
    # a speck beside the bead shifts one block's coarse edge, not its neighbours'
    coarse = first.rows.astype(np.float32).reshape(2 * k, 1, n)
    rows = np.rint([cv2.medianBlur(edge, 5)[0] for edge in coarse]).astype(int).reshape(2, k, n)
    E = g.ravel().take((rows + (h * np.arange(k * n)).reshape(k, n))[..., None] + REACH, mode="clip") * (
        first.sign[:, None, None] / BLOCK
    ).astype(np.float32)
    # a bead narrower than its windows has no plateau of its own
    wide = first.solid & (rows[1] - rows[0] > OUT + IN)
    flat = wide.any(axis=1)
    used = np.where(flat[:, None], wide, first.solid)
    share = used / np.maximum(np.count_nonzero(used, axis=1), 1)[:, None]

    def mean(x):
        return np.einsum("...kn,kn->...k", x, share)

    outside, near, far = np.moveaxis(E @ LEVELS, -1, 0)
    top, bottom = mean(far - outside)
    darker = np.where(first.sign * (bottom - top) < 0, 1, 0)
    clean = np.where(np.abs(top - bottom) > UNEVEN * first.plateau, darker, [[0], [1]]), np.arange(k)
    rise, width = (
        np.where(flat, mean((far - near)[clean]).mean(axis=0), 0.0),
        np.maximum(mean(rows[1] - rows[0]), OUT + IN),
    )
    fall, _ = _shading(rise, width, 0.0)
    along = _along(np.concatenate([outside, near]), used)
    outside, plateau = along[:2], first.plateau[:, None]
    level = np.minimum(np.maximum((along[2:] - outside)[clean] - fall[:, None], 0.3 * plateau), plateau)
    level = np.where(wide, level, plateau)
    into, step = _crossing(E, (outside + level / 2).astype(np.float32))
    shift, blur = _settled(
        mean(level).mean(axis=0), mean(step).mean(axis=0), mean(into), clean, rise, width, fall, first.plateau
    )
    return rows - OUTWARD * (into + shift[:, None]), np.where(used.any(axis=1), blur, math.nan)


def _crossing(E: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rows (2, k, n) inward from the middle of each window to its half level, searched from the
    inside outward, and the rise of the row in which it lies."""
    shape, rows = E.shape, E.shape[-1]
    E = cv2.filter2D(E.reshape(-1, rows), -1, THREE, borderType=cv2.BORDER_REPLICATE)
    half = half.ravel()
    after = np.maximum(INSIDE - (E[:, INSIDE - 1 :: -1] < half[:, None]).argmax(axis=1), 1)
    index = rows * np.arange(len(E)) + after
    below = E.ravel().take(index - 1)
    step = np.maximum(E.ravel().take(index) - below, np.float32(1e-6))
    into = after - 1 - OUT + np.minimum(np.maximum((half - below) / step, 0), 1)
    return into.reshape(shape[:3]), step.reshape(shape[:3])


def _settled(read, steep, inward, clean, rise, width, fall, plateau) -> tuple[np.ndarray, np.ndarray]:
    """Returns the inward shift (k,) of all edges and the blur (k,) that are consistent with each other. All
    arguments are (k,), inward (2, k).

    A blurred edge has not reached its final level in the rows that are read. The missing part looks like
    shading and hides the blur. Also, the edge lies `at` from the window's middle, so the plateau was
    extrapolated too far or not far enough.
    """
    at, across = inward[clean].mean(axis=0), width - inward.sum(axis=0)
    p0, steep = np.maximum(read, 1e-6), np.maximum(steep, 1e-6)
    for _ in range(ROUNDS):
        variance = np.square(p0 / (math.sqrt(2 * math.pi) * steep))
        blur = np.sqrt(np.maximum(variance - THREE_VARIANCE, 0.01))
        missing, spilt = p0 * _tail(NEAR, at, blur), p0 * _tail(-OUTSIDE, -at, blur)
        nearer, q = _shading(np.where(rise == 0, 0.0, rise - missing), across, at)
        previous, p0 = p0, np.maximum(read + missing + spilt + fall - nearer, 0.5 * np.maximum(read, 1e-6))
        if np.all(np.abs(p0 - previous) < 1e-3 * p0):
            break
    # blur carries the shading's slope over the edge: (p0 + q x) Phi(x
    # / s) + q s phi(x / s) = p0 / 2 at x = -q s^2 / p0
    shift = (missing - spilt + fall - nearer) / (2 * steep) + q * variance / p0
    # an edge so soft that no level reached its final value looks like shading, so the whole plateau is used
    apparent = plateau / (math.sqrt(2 * math.pi) * steep)
    return shift, np.where(blur < 0.6 * apparent, apparent, blur)


def _tail(rows: np.ndarray, at: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Returns the mean (k,) of Phi((at - row) / blur) over the rows: the part of a blurred step at `at` that
    is still missing inside it. For rows outside, pass all arguments with the other sign."""
    return scipy.special.ndtr((at[:, None] - rows) / blur[:, None]).mean(axis=1)


def _shading(rise: np.ndarray, width: np.ndarray, into: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Returns how far the level falls from the near rows to the edge, and its slope there, if it rises by
    `rise` from the near to the far rows. The edge is `into` from the window's middle.

    The level across the bead is assumed as a - b u, u = (1 - 2 x / w)^2, with x from the edge: the first term
    of every shading that is the same on both sides.
    """
    near = (1 - 2 * (NEAR_ROW - into) / width) ** 2 + 4 * NEAR_VARIANCE / width**2
    far = (1 - 2 * (FAR_ROW - into) / width) ** 2 + 4 * FAR_VARIANCE / width**2
    b = rise / (near - far)
    return b * (1 - near), 4 * b / width


def _along(levels: np.ndarray, has_bead: np.ndarray) -> np.ndarray:
    """Returns levels (edges, k, n) averaged over nine blocks along the bead, without the blocks that have no
    bead."""
    near = _neighbours(levels.shape[-1])
    weight = has_bead.astype(np.float32)
    return (levels * weight) @ near / np.maximum(weight @ near, np.float32(1e-9))


@functools.cache
def _neighbours(n: int) -> np.ndarray:
    return np.array(np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 4, np.float32)
