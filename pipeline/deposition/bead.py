"""Camera frame -> sub-pixel bead width along the line, or the reason why there is none; pixels -> millimetres on known widths; width -> cross-section."""

import functools
import math
from typing import NamedTuple

import cv2
import numpy as np

# columns averaged into one profile (64 um at 125 px/mm, an eighth of a nozzle) and rows averaged to find the run
BLOCK, COARSE = 8, 4
# rows outward and inward of an edge in its window; levels of the background, beside the edge and deeper inside are read where a blurred edge has come to rest
OUT, IN = 12, 20
OUTSIDE, NEAR, FAR = np.arange(-OUT, -5), np.arange(5, 9), np.arange(12, 21)
NEAR_ROW, FAR_ROW, NEAR_VARIANCE, FAR_VARIANCE = float(NEAR.mean()), float(FAR.mean()), float(NEAR.var()), float(FAR.var())
LEVELS = np.zeros((OUT + 1 + IN, 3), np.float32)
LEVELS[OUT + OUTSIDE, 0], LEVELS[OUT + NEAR, 1], LEVELS[OUT + FAR, 2] = 1 / len(OUTSIDE), 1 / len(NEAR), 1 / len(FAR)
# an edge is sought outward from here: past it a dark bead's specular line may dip
INSIDE = OUT + 5
# the top edge lies towards lower rows of its bead, the bottom edge towards higher ones
OUTWARD = np.array([[-1], [1]])
REACH = -OUTWARD[:, :, None] * np.arange(-OUT, IN + 1)
NEAR_ROWS, OUTSIDE_ROWS = NEAR.tolist(), (-OUTSIDE).tolist()
THREE, THREE_VARIANCE = np.full((1, 3), 1 / 3, np.float32), 2 / 3
# where one edge is brighter than the other by this share of the plateau, the specular line lies beside it
UNEVEN = 0.12
# edge, blur and shading settle within so many rounds, two where the edge is sharp
ROUNDS = 12
# a coarse row is bead where it stands so many standard deviations of the background above it, one in 10^9 rows of noise, and this share of the steps
SIGNIFICANT, STEEP = 6.0, 0.2
# fewer blocks are dirt, not a line; less height is no measurable bead
FEWEST_BLOCKS, FEWEST_ROWS, FEWEST_LINES = 4, 2, 48


class Bead(NamedTuple):
    """The bead in one frame. columns (n,) are the centres of blocks of 8 columns; widths (n,), top (n,) and bottom (n,) in px across the line, pixel centres at whole rows.

    widths is 0 where the block shows background only and NaN where it cannot be read. `width` is the line fitted robustly through the widths, at the middle of the
    blocks that it uses, and `deviation` its standard deviation; both NaN where `reason` is not empty: "no bead", "saturated", "cut by the frame", "blurred".
    `angle_deg` is the line's direction against the rows, `blur_px` the standard deviation of the edge, `contrast` bead less background in levels.
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
    """Cross-section A = c w^2 in mm^2 of a bead w mm wide: the circular segment that meets the substrate at theta, c = (theta - sin theta cos theta) / (4 sin^2 theta).

    At 90 degrees c = pi/8. Raises ValueError where theta is not between 0 and 180 degrees.
    """
    if not 0 < contact_angle_deg < 180:
        raise ValueError(
            f"bead: expected a contact angle between 0 and 180 degrees but found {contact_angle_deg:g}; measure it on a cut bead"
        )
    theta = math.radians(contact_angle_deg)
    return (theta - math.sin(theta) * math.cos(theta)) / (4 * math.sin(theta) ** 2) * width**2


class Calibration(NamedTuple):
    """Width in mm = gain px + offset. deviation is the r.m.s. of the residuals (mm, two parameters taken off), residuals (n,) known less fitted in mm."""

    gain: float
    offset: float
    deviation: float
    residuals: np.ndarray


def calibrate(widths_px: np.ndarray, known_mm: np.ndarray) -> Calibration:
    """Gain (mm/px) and offset (mm) by least squares from measured widths (n,) in px of beads or gauges of known widths (n,) in mm.

    Raises ValueError for fewer than three different widths, a measurement that failed, or widths that do not grow with the known ones.
    """
    px, mm = np.asarray(widths_px, float), np.asarray(known_mm, float)
    if px.shape != mm.shape or px.ndim != 1 or len(np.unique(mm)) < 3:
        raise ValueError(
            f"calibration: expected at least three different known widths, one measurement each or more, but found {px.shape} measured for "
            f"{len(np.unique(mm))} different; add frames of other widths"
        )
    if not np.isfinite(px).all():
        raise ValueError(
            f"calibration: expected a width in every frame but {np.count_nonzero(~np.isfinite(px))} of {len(px)} have none; look at their reasons"
        )
    J = np.column_stack([px, np.ones(len(px))])
    gain, offset = np.linalg.lstsq(J, mm, rcond=None)[0]
    residuals = mm - gain * px - offset
    if gain <= 0:
        raise ValueError(
            f"calibration: expected widths in px that grow with the known widths but found a gain of {gain:.3g} mm/px; check which frame shows which width"
        )
    return Calibration(float(gain), float(offset), float(np.sqrt(residuals @ residuals / (len(px) - 2))), residuals)


def millimetres(calibration: Calibration, widths_px: np.ndarray) -> np.ndarray:
    """Widths in mm; 0 (bare substrate) stays 0 and NaN stays NaN."""
    return np.where(widths_px == 0, 0.0, calibration.gain * widths_px + calibration.offset)


class Drift(NamedTuple):
    """Mean of calibrated less known width in mm; `alarm` where it is further from 0 than the allowed number of its standard deviations."""

    miss: float
    deviation: float
    alarm: bool


def drift(calibration: Calibration, widths_px: np.ndarray, known_mm: np.ndarray, *, deviations: float) -> Drift:
    """Whether frames of known widths, taken later, still agree with the calibration: the alarm goes where lens, focus, height or light have moved."""
    miss = millimetres(calibration, np.asarray(widths_px, float)) - np.asarray(known_mm, float)
    if not len(miss) or not np.isfinite(miss).all():
        raise ValueError(
            f"calibration: expected a width in every check frame but {np.count_nonzero(~np.isfinite(miss))} of {len(miss)} have none; look at their reasons"
        )
    deviation = calibration.deviation * math.sqrt(1 / len(miss) + 1 / len(calibration.residuals))
    return Drift(float(miss.mean()), deviation, bool(abs(miss.mean()) > deviations * max(deviation, 1e-9)))


def drawn(frame: np.ndarray, bead: Bead) -> np.ndarray:
    """The frame as (h, w, 3) uint8 RGB with the measured edges as green lines, for a report; blocks without a width stay bare, a rejected frame gets a red border."""
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
    """frame as (h, w) uint8 or uint16: gray as it is, colour (h, w, 3 or 4) in OpenCV's order BGR(A) by 0.114 B + 0.587 G + 0.299 R. Raises ValueError for all else."""
    kind = "frame: expected (height, width) or (height, width, 3 or 4) of uint8 or uint16"
    if frame.dtype not in (np.uint8, np.uint16) or frame.ndim not in (2, 3):
        raise ValueError(f"{kind} but found {frame.shape} of {frame.dtype}; convert it without scaling it per frame")
    if frame.ndim == 3 and frame.shape[2] in (3, 4):
        return cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY if frame.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)
    if frame.ndim == 3 and frame.shape[2] != 1:
        raise ValueError(f"{kind} but found {frame.shape} of {frame.dtype}; convert it to gray")
    return frame.reshape(frame.shape[:2])


def measure(frame: np.ndarray, *, columns: tuple[int, int], longest_blur_px: float) -> Bead:
    """The bead's width in every block of 8 columns of frame[:, first:last] (`columns`: the part that the nozzle does not hide), the line along the image's x.

    Profile of each block less the background between its ends; outermost significant run; half level of the plateau beside the edge, clipped at the bead's
    median so that the specular line cannot lift it, and extrapolated to the edge against shading. Bright and dark beads alike. A frame without a usable bead
    comes back with its reason; one that is no image, or too small, raises ValueError.
    """
    frame = gray(frame)
    g = _profiles(frame, columns)
    n, top_level = len(g), float(np.iinfo(frame.dtype).max)
    where = columns[0] + BLOCK * np.arange(n) + (BLOCK - 1) / 2
    run = _run(g, top_level / 255)
    if run is None:
        return _rejected("no bead", where, np.zeros(n))
    (top, bottom), blur = _edges(g, run)
    good = run.seen & (bottom > top)
    widths = np.where(run.seen | run.unclear | run.cut, math.nan, 0.0)
    if np.count_nonzero(run.cut) > n / 2:
        return _rejected("cut by the frame", where, widths)
    if run.saturated:
        return _rejected("saturated", where, widths)
    if np.count_nonzero(good) < FEWEST_BLOCKS:
        return _rejected("no bead", where, widths)
    if blur > longest_blur_px:
        return _rejected("blurred", where, widths, blur)
    x, lower, upper = where[good], top[good], bottom[good]
    x = x - x.sum() / len(x)
    slope = float(x @ (lower + upper) / (2 * x @ x))
    found = (upper - lower) / math.hypot(1.0, slope)
    widths[good] = found
    lost = np.where(good, 0.0, math.nan)
    return Bead(
        where, widths, top + lost, bottom + lost, *_line(x, found), math.degrees(math.atan(slope)), blur, run.sign * run.plateau, ""
    )


def _rejected(reason: str, columns: np.ndarray, widths: np.ndarray, blur: float = math.nan) -> Bead:
    """No width and no edges; in a frame without a bead what is bare substrate stays 0, in a spoilt one nothing is known."""
    nothing = np.full(len(columns), math.nan)
    return Bead(columns, widths if reason == "no bead" else nothing, nothing, nothing, math.nan, math.nan, math.nan, blur, math.nan, reason)


def _profiles(frame: np.ndarray, columns: tuple[int, int]) -> np.ndarray:
    """(blocks, rows) sums of 8 columns each. The transposed copy makes every later pass run along memory."""
    first, last = columns
    h, w = frame.shape
    n = (last - first) // BLOCK
    if not 0 <= first < last <= w or n < FEWEST_BLOCKS or h < FEWEST_LINES:
        raise ValueError(
            f"frame: expected at least {FEWEST_LINES} rows, and {FEWEST_BLOCKS * BLOCK} columns between {first} and {last}, "
            f"but found {h} rows of {w}; check the camera's region of interest"
        )
    across = cv2.transpose(frame[:, first : first + n * BLOCK]).reshape(n, BLOCK, h)
    return np.add.reduce(across, axis=1, dtype=np.uint16 if frame.dtype == np.uint8 else np.uint32)


class _Run(NamedTuple):
    """Rows (2, n) of the coarse edges; blocks (n,) bool with a solid run, with an unclear one, with one that the frame cuts; plateau (levels above background), sign."""

    rows: np.ndarray
    seen: np.ndarray
    unclear: np.ndarray
    cut: np.ndarray
    plateau: float
    sign: float
    saturated: bool


def _run(g: np.ndarray, level: float) -> _Run | None:
    """The outermost run above half the plateau in each block, on rows averaged by four; None where nothing is significant.

    Background is the straight line between the means of the first and the last sixteenth of the rows; its noise counts as at least half a gray level. What is
    significant has steps over 16 rows; glare swells without any. The plateau is the median of all that reaches STEEP of those steps.
    """
    n, h = g.shape[0], g.shape[1] // COARSE
    m, ends, line = _background(h)
    g = g[:, : h * COARSE]
    c = (g[:, ::4] + g[:, 1::4] + g[:, 2::4] + g[:, 3::4]).astype(np.float32) * np.float32(1 / (BLOCK * COARSE))
    margins = c @ ends
    d = c - margins @ line
    noise = max(math.hypot(cv2.norm(d[:, :m]), cv2.norm(d[:, -m:])) / math.sqrt(2 * m * n), level / 2)
    steps = d[:, 4:] - d[:, :-4]
    steps = np.maximum(steps.max(axis=1), -steps.min(axis=1))
    steps = steps[steps > SIGNIFICANT * math.sqrt(2) * noise]
    if len(steps) < FEWEST_BLOCKS:
        return None
    step = float(np.partition(steps, len(steps) // 2)[len(steps) // 2])
    threshold = max(STEEP * step, SIGNIFICANT * noise)
    up, down = d > threshold, d < -threshold
    sign, significant = (1.0, up) if np.count_nonzero(up) >= np.count_nonzero(down) else (-1.0, down)
    if sign < 0:
        d = -d
    values = d[significant]
    if not len(values):
        return None
    half = float(np.partition(values, len(values) // 2)[len(values) // 2]) / 2
    inside = d > half
    at = np.stack([inside.argmax(axis=1), h - 1 - inside[:, ::-1].argmax(axis=1)])
    rows = np.add.reduce(inside, axis=1, dtype=np.int32)
    block = np.arange(n)
    inner, outer, far = (d[block, np.minimum(np.maximum(at + rows_out * OUTWARD, 0), h - 1)] for rows_out in (0, 1, 2))
    back = (inner - half) / np.maximum(inner - outer, half * 1e-3)
    edges = COARSE * (at + OUTWARD * np.minimum(back, 1)) + (COARSE - 1) / 2
    some = rows >= FEWEST_ROWS
    solid = (rows > 0.6 * (at[1] - at[0] + 1)) & (inner - far > STEEP * half).all(axis=0)
    # a bead in the first or last rows passes for background there
    cut = some & ((at[0] < m) | (at[1] >= h - m) | ~solid & (np.abs(margins[:, 0] - margins[:, 1]) > step / 2))
    saturated = np.count_nonzero(c > 0.98 * 255 * level) > 0.3 * int(rows.sum())
    return _Run(edges, some & solid & ~cut, some & ~solid & ~cut, cut, 2 * half, sign, saturated)


@functools.cache
def _background(h: int) -> tuple[int, np.ndarray, np.ndarray]:
    """Rows in a sixteenth; (h, 2) that takes the mean of the first and of the last; (2, h) that draws the straight line between them."""
    m = max(h // 16, 2)
    ends = np.zeros((h, 2), np.float32)
    ends[:m, 0] = ends[-m:, 1] = 1 / m
    share = ((np.arange(h) - (m - 1) / 2) / (h - m)).astype(np.float32)
    return m, ends, np.stack([1 - share, share])


def _edges(g: np.ndarray, run: _Run) -> tuple[np.ndarray, float]:
    """(2, n) sub-pixel rows of the top and the bottom edge, and the edge's blur (standard deviation, px).

    The half level lies between the local background and the plateau beside the edge, which is extrapolated to the edge against shading. Shading is the same at
    both edges and the specular line is nearer to one of them, so the other gives the plateau.
    """
    n, h = g.shape
    # a speck beside the bead moves one block's coarse edge, not its neighbours'
    coarse = run.rows.astype(np.float32)
    rows = np.rint(np.concatenate([cv2.medianBlur(coarse[:1], 5), cv2.medianBlur(coarse[1:], 5)])).astype(int)
    index = np.minimum(np.maximum(rows[:, :, None] + REACH, 0), h - 1)
    index += h * np.arange(n)[:, None]
    E = g.ravel().take(index.reshape(2 * n, -1)) * np.float32(run.sign / BLOCK)
    outside, near, far = (E @ LEVELS).T.reshape(3, 2, n)
    # a bead narrower than its windows has no plateau of its own
    whole = run.seen & (rows[1] - rows[0] > OUT + IN)
    used = whole if whole.any() else run.seen
    if not used.any():
        return rows.astype(float), math.nan
    share = used / np.float32(np.count_nonzero(used))
    level, fall, clean = np.full((2, n), run.plateau), 0.0, [0, 1]
    if whole.any():
        top, bottom = (far - outside) @ share
        if abs(top - bottom) > UNEVEN * run.plateau:
            clean = [int((bottom < top) if run.sign > 0 else (bottom > top))] * 2
        rise, width = float(((far - near)[clean] @ share).sum()) / 2, float((rows[1] - rows[0]) @ share)
        fall, _ = _shading(rise, width, 0.0)
        along = _along(np.concatenate([outside, near]), used)
        outside, near = along[:2], along[2:]
        level = np.where(whole, np.minimum(np.maximum((near - outside)[clean] - fall, 0.3 * run.plateau), run.plateau), run.plateau)
    half = (outside + level / 2).ravel()
    E = cv2.filter2D(E, -1, THREE, borderType=cv2.BORDER_REPLICATE)
    after = np.maximum(INSIDE - (E[:, INSIDE - 1 :: -1] < half[:, None]).argmax(axis=1), 1)
    row = np.arange(2 * n)
    below = E[row, after - 1]
    step = np.maximum(E[row, after] - below, np.float32(1e-6))
    into = (after - 1 - OUT + np.minimum(np.maximum((half - below) / step, 0), 1)).reshape(2, n)
    read, steep = float((level @ share).sum()) / 2, float((step.reshape(2, n) @ share).sum()) / 2
    inward = into @ share
    at, p0, nearer, q = float(inward[clean].sum()) / 2, read, fall, 0.0
    # A blurred edge has not come to rest where its levels were read: what is missing there looks like shading and hides the blur. And the edge lies `at` from the
    # window's middle, so that the plateau was extrapolated too far or not far enough.
    for _ in range(ROUNDS):
        variance = (p0 / (math.sqrt(2 * math.pi) * steep)) ** 2
        blur = math.sqrt(max(variance - THREE_VARIANCE, 0.01))
        missing, spilt = p0 * _tail(NEAR_ROWS, at, blur), p0 * _tail(OUTSIDE_ROWS, -at, blur)
        if fall:
            nearer, q = _shading(rise - missing, width - float(inward.sum()), at)
        previous, p0 = p0, max(read + missing + spilt + fall - nearer, 0.5 * read)
        if abs(p0 - previous) < 1e-3 * read:
            break
    # blur carries the shading's slope over the edge: (p0 + q x) Phi(x / s) + q s phi(x / s) = p0 / 2 at x = -q s^2 / p0
    shift = (missing - spilt + fall - nearer) / (2 * steep) + q * variance / p0
    # an edge so soft that no level came to rest passes for shading: then the whole plateau tells
    apparent = run.plateau / (math.sqrt(2 * math.pi) * steep)
    return rows - OUTWARD * (into + shift), apparent if blur < 0.6 * apparent else blur


def _tail(rows: list[float], at: float, blur: float) -> float:
    """Mean of Phi((at - row) / blur), what a blurred step at `at` still lacks at the rows inside of it; for rows outside give all with the other sign."""
    scale = 1 / (math.sqrt(2) * blur)
    return sum([math.erfc((row - at) * scale) for row in rows]) / (2 * len(rows))


def _shading(rise: float, width: float, into: float) -> tuple[float, float]:
    """How far the level falls from the near rows to the edge, and its slope there, where it rises by `rise` from the near to the far rows; the edge is `into` from the window's middle.

    The level across the bead is taken as a - b u, u = (1 - 2 x / w)^2, x from the edge: the first term of every shading that is the same on both sides.
    """
    near = (1 - 2 * (NEAR_ROW - into) / width) ** 2 + 4 * NEAR_VARIANCE / width**2
    far = (1 - 2 * (FAR_ROW - into) / width) ** 2 + 4 * FAR_VARIANCE / width**2
    b = rise / (near - far)
    return b * (1 - near), 4 * b / width


def _along(levels: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """levels (k, n) averaged over nine blocks along the bead, blocks without a bead left out."""
    near = _neighbours(levels.shape[1])
    weight = seen.astype(np.float32)
    return (levels * weight) @ near / np.maximum(weight @ near, np.float32(1e-9))


@functools.cache
def _neighbours(n: int) -> np.ndarray:
    return np.array(np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 4, np.float32)


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Value at x = 0 of the line through y and its standard deviation; points beyond three robust deviations of the first fit are left out of the second."""
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
