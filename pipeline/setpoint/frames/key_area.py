"""Cuts the 48 x 16 key area along the freshly extruded line out of a nozzle frame, or gives the reason why
there is none. This is the paper's sweep, made robust for real frames.

Angles are in degrees as seen in the picture: 0 right, 90 down (towards the camera), 270 up (the nozzle). Rows
of a key area run across the line, columns along it, from the tip outward. The paper is Li and Pattinson 2025,
section 2.2.1.
"""

import functools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

# the paper's geometry in px: crop around the tip, rectangle along and
# across the line; key area (rows, columns)
SIDE, LENGTH, HEIGHT, SHAPE = 350, 87, 20, (16, 48)
SMALLEST = 64
# ridges are sought in profiles across rays: radii every STRIDE px from START on (nearer, the rim of the
# nozzle is seen), offsets every STEP px up to REACH
START, STRIDE, STEP, REACH = 12, 3, 2, 28
# (half-width of the strip, distance of its flanks, both in steps; weight): an ordinary bead, and a broad
# bead, which is more easily confused with the shading of a part
SCALES = ((1, 5, 1.0), (3, 8, 0.6))
# the line may pass beside the calibrated tip by this many steps
MISS = 4
MISSES = STEP * np.arange(-MISS, MISS + 1)
# the nozzle hides the rays within 60 degrees of 270; the search takes
# every COARSE of the others, then every degree
COARSE = 4
OPEN = np.arange(-30, 211, COARSE)
# a direction from G-code is trusted to this many degrees: the line
# bends, and the camera's turn is known to a few
LEEWAY_DEG = 6
# if another line leaves the tip at least APART_DEG away and is at least this fraction as strong, the fresh
# line cannot be identified
APART_DEG, RIVAL = 24, 0.35
# a nozzle this close to its calibrated place counts as at home
HOME_PX = 2
# scores within this fraction of the best belong to the same line
NEARLY = 0.1


class KeyArea(NamedTuple):
    """The key area of one frame. `image` (16, 48) uint8 is equalised, and zero if `reason` is not empty.

    `angle_deg`: the line's direction from the tip; `miss_px`: how far the line passes beside the tip,
    positive to the right if one looks along the line; `score`: height of its ridge in gray levels of 8 bits;
    `padded_share`: fraction of the crop outside the frame.
    """

    image: np.ndarray
    angle_deg: float
    miss_px: float
    score: float
    padded_share: float
    reason: str


class KeyAreas(NamedTuple):
    """The key areas of n frames: `images` (n, 16, 48) uint8; `angle_deg`, `miss_px`, `score`, `padded_share`
    (n,); n `reasons`; `valid` (n,) bool."""

    images: np.ndarray
    angle_deg: np.ndarray
    miss_px: np.ndarray
    score: np.ndarray
    padded_share: np.ndarray
    reasons: tuple[str, ...]
    valid: np.ndarray


class Crop(NamedTuple):
    """Gray crop (350, 350) uint8 with the tip at (175, 175); `levels` (256,) uint8, its equalisation table;
    `padded_share`, the fraction of the crop outside the frame."""

    gray: np.ndarray
    levels: np.ndarray
    padded_share: float
    inside: tuple[int, int, int, int]


def crop(frame: np.ndarray, tip: tuple[float, float]) -> Crop:
    """Returns the gray square of 350 px around the tip (x, y). Outside the frame its border pixels are
    repeated; these are left out of the equalisation.

    `frame`: gray (h, w) or BGR(A) (h, w, 3 or 4), uint8 or uint16 (its upper 8 bits are used). Raises
    ValueError for other frames, or if the tip lies outside.
    """
    _check(frame, tip)
    h, w = frame.shape[:2]
    x, y = (round(float(v)) - SIDE // 2 for v in tip)
    left, right, top, bottom = max(x, 0), min(x + SIDE, w), max(y, 0), min(y + SIDE, h)
    inside = _gray(frame[top:bottom, left:right])
    levels = _equalisation(inside)
    edges = (top - y, y + SIDE - bottom, left - x, x + SIDE - right)
    gray = cv2.copyMakeBorder(inside, *edges, cv2.BORDER_REPLICATE) if any(edges) else inside
    return Crop(gray, levels, 1 - inside.size / SIDE**2, (left - x, top - y, right - x, bottom - y))


def find(
    frame: np.ndarray,
    tip: tuple[float, float],
    *,
    least_score: float,
    direction_deg: float | None = None,
    leeway_deg: int = LEEWAY_DEG,
) -> KeyArea:
    """Returns the key area of a frame with its tip at (x, y): `find_in` of its crop. Raises ValueError as
    `crop`."""
    return find_in(
        crop(frame, tip), least_score=least_score, direction_deg=direction_deg, leeway_deg=leeway_deg
    )


def find_in(
    c: Crop, *, least_score: float, direction_deg: float | None = None, leeway_deg: int = LEEWAY_DEG
) -> KeyArea:
    """Returns the key area along a ridge, with score = strip - brighter flank. It is rejected if the score is
    below `least_score` gray levels.

    `direction_deg` is known from G-code or from the motion of the ground. If it is given, only rays within
    `leeway_deg` of it are searched, also those over the nozzle. Only lines that pass the tip within MISS
    steps count, so lines further away are ignored. If it is not given, the strongest ridge not hidden by the
    nozzle is taken. If another line is nearly as strong, the frame is rejected, because one picture cannot
    tell which line was laid last.
    """
    ridge = _ridge(c.gray, direction_deg, leeway_deg)
    angle, miss, score = ridge.angle_deg, ridge.miss_px, ridge.score
    outside = _outside(c, angle, miss)
    reason = ""
    if score < least_score:
        reason = (
            f"no fresh line: the best ridge at {angle:.0f} degrees stands {score:.1f} gray levels above its "
            f"brighter flank, below {least_score:g}"
        )
    elif outside > 0.5:
        reason = f"cut by the frame: {outside:.0%} of the rectangle at {angle:.0f} degrees lie outside"
    elif ridge.rival_score >= RIVAL * score:
        reason = (
            f"several lines: those at {angle:.0f} and {ridge.rival_deg:.0f} degrees stand {score:.1f} and "
            f"{ridge.rival_score:.1f} gray levels out, and no direction of travel is known"
        )
    image = np.zeros(SHAPE, np.uint8) if reason else _rectangle(c, angle, miss)
    return KeyArea(image, angle, miss, score, c.padded_share, reason)


def find_all(
    frames: Iterable[np.ndarray],
    tips: np.ndarray,
    *,
    least_score: float,
    directions_deg: np.ndarray | float | None = None,
) -> KeyAreas:
    """Returns the key areas of n frames. `tips`: (n, 2), or (2,) for all; `directions_deg`: (n,), or one for
    all; NaN if unknown."""
    frames = list(frames)
    tips = np.broadcast_to(np.asarray(tips, float), (len(frames), 2))
    directions = np.broadcast_to(np.nan if directions_deg is None else directions_deg, len(frames))
    areas = [
        find(
            frame,
            tip,
            least_score=least_score,
            direction_deg=None if np.isnan(direction) else float(direction),
        )
        for frame, tip, direction in zip(frames, tips, directions, strict=True)
    ]
    images = np.array([k.image for k in areas], np.uint8).reshape(-1, *SHAPE)
    columns = (
        np.array([getattr(k, name) for k in areas])
        for name in ("angle_deg", "miss_px", "score", "padded_share")
    )
    reasons = tuple(k.reason for k in areas)
    return KeyAreas(images, *columns, reasons, np.array([not r for r in reasons], bool))


class NozzleDrift(NamedTuple):
    """Where the nozzle is seen: `offset_px` (x, y) from the calibrated tip; `correlation` with the template
    there, -1..1; `advantage`, by how much that correlation exceeds the one at the calibrated place."""

    offset_px: tuple[int, int]
    correlation: float
    advantage: float


def nozzle_template(frame: np.ndarray, tip: tuple[float, float], *, size_px: int) -> np.ndarray:
    """Returns the gray patch (7/8 size, size) uint8 of the nozzle above the calibrated tip, cut from the
    frame on which it was calibrated. It is a square with the tip in the middle of its lower edge, without its
    lowest eighth: beads are laid there and look different on each segment.

    Raises ValueError if the patch does not lie inside the frame.
    """
    _check(frame, tip)
    left, top = _corner(tip, size_px)
    if left < 0 or top < 0 or left + size_px > frame.shape[1]:
        raise ValueError(
            f"nozzle template: expected {size_px} px above and {size_px // 2} px beside the tip ({tip[0]:g}, "
            f"{tip[1]:g}) inside the frame "
            f"of {frame.shape[1]} x {frame.shape[0]} px; take a smaller template"
        )
    return _gray(frame[top : top + size_px - size_px // 8, left : left + size_px]).copy()


def drift(
    frames: Sequence[np.ndarray], template: np.ndarray, tip: tuple[float, float], *, reach_px: int
) -> NozzleDrift:
    """Finds the nozzle within `reach_px` of the calibrated tip by the normalised cross-correlation, averaged
    over the frames. This is an alarm that the camera moved, never a new calibration. The nozzle counts as at
    home within HOME_PX of the calibrated tip.

    Raises ValueError without frames, for frames that `crop` refuses, or if the template does not fit into the
    frame.
    """
    if not len(frames):
        raise ValueError("nozzle drift: expected frames to look at, found none; give at least one")
    for frame in frames:
        _check(frame, tip)
    frame, (tall, size) = frames[0], template.shape
    left, top = _corner(tip, size)
    rows, columns = (
        np.clip([v - reach_px, v + extent + reach_px], 0, end)
        for v, extent, end in ((top, tall, frame.shape[0]), (left, size, frame.shape[1]))
    )
    if left < 0 or top < 0 or left + size > frame.shape[1] or top + tall > frame.shape[0]:
        raise ValueError(
            f"nozzle drift: expected room for the template of {size} px around the tip ({tip[0]:g}, "
            f"{tip[1]:g}) but the frame is "
            f"{frame.shape[1]} x {frame.shape[0]} px; calibrate on frames of this camera"
        )
    match = np.mean(
        [
            cv2.matchTemplate(
                _gray(one[rows[0] : rows[1], columns[0] : columns[1]]), template, cv2.TM_CCOEFF_NORMED
            )
            for one in frames
        ],
        axis=0,
    )
    row, column = np.unravel_index(int(match.argmax()), match.shape)
    y, x = int(top - rows[0]), int(left - columns[0])
    home = match[max(y - HOME_PX, 0) : y + HOME_PX + 1, max(x - HOME_PX, 0) : x + HOME_PX + 1].max()
    return NozzleDrift(
        (int(columns[0] + column - left), int(rows[0] + row - top)),
        float(match[row, column]),
        float(match[row, column] - home),
    )


def drawn(frame: np.ndarray, tip: tuple[float, float], area: KeyArea) -> np.ndarray:
    """Draws the crop for a report, (350, 350, 3) uint8 RGB, with the tip and the rectangle: green if the key
    area was accepted, red with the reason if not."""
    picture = cv2.cvtColor(crop(frame, tip).gray, cv2.COLOR_GRAY2RGB)
    colour = (220, 40, 40) if area.reason else (40, 200, 80)
    at = np.rint(corners(area.angle_deg, area.miss_px) + SIDE // 2).astype(np.int32)
    cv2.polylines(picture, [at], True, colour, 1, cv2.LINE_AA)
    cv2.drawMarker(picture, (SIDE // 2, SIDE // 2), colour, cv2.MARKER_CROSS, 9, 1)
    words = area.reason.partition(":")[0] or "accepted"
    cv2.putText(
        picture,
        f"{words}, {area.score:.1f} gray levels",
        (8, SIDE - 10),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.45,
        colour,
        1,
        cv2.LINE_AA,
    )
    return picture


def _corner(tip: tuple[float, float], size: int) -> tuple[int, int]:
    """Returns left and top of the template, if the tip is in the middle of its lower edge."""
    return round(float(tip[0])) - size // 2, round(float(tip[1])) - size + 1


class _Ridge(NamedTuple):
    """A ridge, and the strongest other one that leaves the tip in another direction; its score is 0 if the
    direction is known."""

    angle_deg: float
    miss_px: float
    score: float
    rival_deg: float = np.nan
    rival_score: float = 0.0


def _ridge(gray: np.ndarray, direction_deg: float | None, leeway_deg: int) -> _Ridge:
    """Returns the ridge of the fresh line. Without a known direction, searches every COARSE degrees, then
    every degree around the best."""
    small = cv2.resize(gray, None, fx=1 / STEP, fy=1 / STEP, interpolation=cv2.INTER_AREA).ravel()
    rival = ()
    if direction_deg is None:
        open_scores = _scores(small, _open_profiles()).max(axis=1)
        coarse = OPEN[open_scores.argmax()]
        angles = np.arange(coarse - COARSE, coarse + COARSE + 1)
        away = np.abs((OPEN - coarse + 180) % 360 - 180) >= APART_DEG
        place = np.where(away, open_scores, -np.inf).argmax()
        rival = (float(OPEN[place] % 360), float(open_scores[place]))
    else:
        angles = round(direction_deg) + np.arange(-leeway_deg, leeway_deg + 1)
    score = _scores(small, _profiles()[:, angles % 360])
    best, at = float(score.max()), int(score.argmax()) % score.shape[1]
    # average over scores that are nearly as strong, so that a broad line
    # is taken in its middle; never over another line beside it
    beside = slice(max(at - 2, 0), at + 3)
    weight = np.maximum(score[:, beside] - (best - NEARLY * abs(best) - 1e-6), 0)
    weight /= weight.sum()
    angle, miss = weight.sum(axis=1) @ angles, weight.sum(axis=0) @ MISSES[beside]
    return _Ridge(float(angle) % 360, float(miss), best, *rival)


def _scores(small: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Returns the ridge heights (rays, misses) of profiles at `places` (radii, rays, offsets): strip minus
    its brighter flank. The weaker of the near and the far half of the ray counts, because a line stands out
    along its whole length; then the largest over the scales."""
    radii, rays, offsets = places.shape
    samples = small.take(places.reshape(radii, -1), mode="clip")
    half = radii // 2
    mean = np.empty((2, rays * offsets), np.float32)
    for k, part in enumerate((samples[:half], samples[half:])):
        np.divide(part.sum(axis=0, dtype=np.uint16), np.float32(len(part)), out=mean[k])
    near, far = (mean.reshape(-1, offsets) @ _ridge_filters(offsets)).reshape(2, rays, -1)
    weaker = np.minimum(near, far).reshape(rays, len(SCALES), 2, -1)
    return np.minimum(weaker[:, :, 0], weaker[:, :, 1]).max(axis=1)


@functools.cache
def _ridge_filters(offsets: int) -> np.ndarray:
    """Returns (offsets, scales x 2 x misses): strip minus left flank, and strip minus right flank, for every
    miss, times the scale's weight."""
    place = np.arange(offsets) - offsets // 2
    columns = []
    for half, away, weight in SCALES:
        for side in (-away, away):
            for miss in range(-MISS, MISS + 1):
                strip, flank = np.abs(place - miss) <= half, np.abs(place - miss - side) <= 1
                columns.append(weight * (strip / strip.sum() - flank / flank.sum()))
    return np.array(columns, np.float32).T.copy()


@functools.cache
def _profiles() -> np.ndarray:
    """Returns the look-up table of the ridges (radii, 360, offsets): pixel indices in the crop reduced by
    STEP, at every radius along and every offset across each ray."""
    angle = np.deg2rad(np.arange(360))[:, None]
    along, across = np.arange(START, LENGTH, STRIDE)[:, None, None], np.arange(-REACH, REACH + 1, STEP)
    x, y = along * np.cos(angle) - across * np.sin(angle), along * np.sin(angle) + across * np.cos(angle)
    column, row = (np.rint((SIDE // 2 + v + 0.5) / STEP - 0.5).astype(np.intp) for v in (x, y))
    return row * (SIDE // STEP) + column


@functools.cache
def _open_profiles() -> np.ndarray:
    """Returns the rows of OPEN at every second radius, which is enough for a first direction."""
    return np.ascontiguousarray(_profiles()[::2, OPEN % 360])


def _rectangle(c: Crop, angle_deg: float, miss_px: float) -> np.ndarray:
    """Returns the equalised levels (16, 48) of the rectangle (1)-(3) with 87 x 20 px, resized. Its vertices
    are

        s -+ g h    and    e -+ g h,    g = (s_y - e_y, e_x - s_x) / |.|

    with the line's start s and end e, and half the rectangle's height h.
    """
    rows, columns = SHAPE
    fine = 2 * columns  # 0.9 px along: one sample a column would skip pixels
    a = np.deg2rad(angle_deg)
    along, across = (
        LENGTH / fine * np.array([np.cos(a), np.sin(a)]),
        HEIGHT / rows * np.array([-np.sin(a), np.cos(a)]),
    )
    origin = SIDE // 2 + 0.5 * along + (miss_px / HEIGHT * rows - (rows - 1) / 2) * across
    matrix = np.column_stack([along, across, origin])
    patch = cv2.warpAffine(
        c.gray,
        matrix,
        (fine, rows),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return cv2.LUT(cv2.resize(patch, (columns, rows), interpolation=cv2.INTER_AREA), c.levels)


def corners(angle_deg: float, miss_px: float) -> np.ndarray:
    """Returns the vertices v1 v2 v4 v3 (4, 2) of the rectangle (2)-(3), in px relative to the tip, in drawing
    order."""
    a = np.deg2rad(angle_deg)
    ray, g = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
    low, high = (miss_px - HEIGHT / 2) * g, (miss_px + HEIGHT / 2) * g
    return np.array([low, high, high + LENGTH * ray, low + LENGTH * ray])


def _equalisation(gray: np.ndarray) -> np.ndarray:
    """Returns the table of cv2.equalizeHist for this picture, (256,) uint8."""
    counts = cv2.calcHist([gray], [0], None, [256], [0, 256]).ravel()
    first = int((counts > 0).argmax())
    if counts[first] == gray.size:
        return np.full(256, first, np.uint8)
    total = np.cumsum(counts) - counts[first]
    scale = np.float32(255.0 / (gray.size - counts[first]))
    return np.clip(np.rint(total * scale), 0, 255).astype(np.uint8)


def _gray(part: np.ndarray) -> np.ndarray:
    if part.dtype == np.uint16:
        part = (part >> 8).astype(np.uint8)
    if part.ndim == 3:
        return cv2.cvtColor(part, cv2.COLOR_BGR2GRAY if part.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)
    return np.ascontiguousarray(part)


def _check(frame: np.ndarray, tip: tuple[float, float]) -> None:
    if frame.dtype not in (np.uint8, np.uint16) or not (
        frame.ndim == 2 or (frame.ndim == 3 and frame.shape[2] in (3, 4))
    ):
        raise ValueError(
            f"frame: expected gray (h, w) or BGR(A) (h, w, 3 or 4) of 8 or 16 bits but found {frame.shape} "
            f"of {frame.dtype}; convert it"
        )
    h, w = frame.shape[:2]
    if min(h, w) < SMALLEST:
        raise ValueError(
            f"frame: expected at least {SMALLEST} x {SMALLEST} px but found {w} x {h}; "
            "use the camera's full frame"
        )
    x, y = tip
    if not (0 <= x < w and 0 <= y < h):
        raise ValueError(
            f"nozzle tip: expected x, y inside the frame of {w} x {h} px but found ({x:g}, {y:g}); "
            "calibrate it by a click on a frame of this camera"
        )


def _outside(c: Crop, angle_deg: float, miss_px: float) -> float:
    """Returns the fraction of the rectangle outside the frame, on a grid of 40 x 40 points."""
    if not c.padded_share:
        return 0.0
    left, top, right, bottom = c.inside
    vertices = corners(angle_deg, miss_px) + SIDE // 2
    if (vertices >= (left, top)).all() and (vertices < (right, bottom)).all():
        return 0.0
    low, high, high_end, _ = vertices
    share = (np.arange(40) + 0.5) / 40
    x, y = (low + share[:, None, None] * (high - low) + share[:, None] * (high_end - high)).reshape(-1, 2).T
    return 1.0 - float(np.mean((x >= left) & (x < right) & (y >= top) & (y < bottom)))
