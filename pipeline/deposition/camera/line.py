"""Finds a printed line in a picture, and turns the picture so that the line lies along the rows.

A line is a band that is brighter or darker than the ground on both of its sides, along its whole length. So
is its specular line, a stripe of the ground or a speck, but these are narrower, fainter or shorter. The
measure is therefore the square of the contrast that persists along the band, times the root of its width.
"""

import functools
import math
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import scipy.ndimage

from pipeline.deposition.camera.bead import gray

# longest side in px at which a line is sought, and the step of its direction in degrees
COARSE_PX, STEP_DEG = 200, 5.0
# a line is followed this far from a tip, and the ground beside it is averaged over this many rows; px of the
# small picture
REACH_PX, SIDE_PX = 64, 3
# parts of the line's length in which its contrast must hold, and how many must be in the picture
PARTS, FEWEST_PARTS = 10, 4
# widths of the bands that are tried, in px of the small picture
BANDS = (3, 4, 5, *range(6, 78, 3))
# a band is a line if its contrast is at least this many levels, and this many deviations of its parts
LEAST_CONTRAST, LEAST_SCORE = 6.0, 4.0
# value of pixels outside the picture
OUTSIDE = -1e6
# widths from which a bead has a plateau of its own, and the least picture that is cut out
WIDE_PX, LEAST_PX = 64, 96
# the line's place is found from this many frames without a bead and as many with one
SAMPLE = 12
# a line this near to the rows is measured as it lies
LEVEL_DEG = 4.0
# share of the difference between the edge biases of two widths by which one between them may be off
BETWEEN = 0.15
# share of the gap to another line that is kept beside the bead
GAP = 0.7

# the gantry as recorded: time_s (T,), and its place (T,) in mm along the line
Gantry = tuple[np.ndarray, np.ndarray]


class ImageLine(NamedTuple):
    """A line in a picture. `angle_deg`: its direction (0 right, 90 down), known only to half a circle if no
    tip shows from where it comes; `x`, `y`: a point in its middle; `width_px`; `contrast`: bead less ground
    in levels; `score`: that contrast divided by its deviation along the line."""

    angle_deg: float
    x: float
    y: float
    width_px: float
    contrast: float
    score: float


class Pose(NamedTuple):
    """How a picture is turned before it is measured: by -angle_deg about (x, y), enlarged by `scale`. The
    point (x, y) moves to (column, row) of the turned picture of shape (rows, columns)."""

    angle_deg: float
    x: float
    y: float
    column: float
    row: float
    rows: int
    columns: int
    scale: float = 1.0


def find(
    frame: np.ndarray,
    *,
    tip: tuple[float, float] | None = None,
    hidden_px: float = 0.0,
    mask: np.ndarray | None = None,
    sign: int = 0,
) -> ImageLine | None:
    """Returns the line with the most energy in the picture (h, w), or, if the nozzle's tip (x, y) in px is
    given, the one that comes out beside it, visible from `hidden_px` on; None if there is none. Pixels marked
    in `mask` (h, w) are ignored. `sign` is 1 for a bead brighter than its ground, -1 for a darker one, 0 for
    either."""
    picture = gray(frame).astype(np.float32)
    h, w = picture.shape
    shrunk = max(h, w) / COARSE_PX
    small = cv2.resize(picture, (round(w / shrunk), round(h / shrunk)), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), 0.8)
    if mask is not None:
        hidden = cv2.resize(mask.astype(np.float32), small.shape[::-1], interpolation=cv2.INTER_AREA) > 0
        small[hidden] = OUTSIDE
    middle = (small.shape[1] / 2 - 0.5, small.shape[0] / 2 - 0.5)
    centre = middle if tip is None else ((tip[0] + 0.5) / shrunk - 0.5, (tip[1] + 0.5) / shrunk - 0.5)
    span = (0.0, hidden_px / shrunk)[tip is not None]
    turns = np.arange(0.0, 180.0 if tip is None else 360.0, STEP_DEG).tolist()
    search = functools.partial(_band, small, centre, hidden=span, from_tip=tip is not None, sign=sign)
    best = max((search(turn) for turn in turns), key=lambda band: band.energy)
    near = (best.turn + STEP_DEG / 5 * np.arange(-4, 5)).tolist()
    best = max((search(turn) for turn in near), key=lambda band: band.energy)
    level = 1 if frame.dtype == np.uint8 else 257
    if best.energy <= 0 or abs(best.contrast) < LEAST_CONTRAST * level or best.score < LEAST_SCORE:
        return None
    a, across = math.radians(best.turn), (best.offset + 0.5) * shrunk - 0.5
    x0, y0 = ((at + 0.5) * shrunk - 0.5 for at in centre)
    along = best.along * shrunk
    x, y = x0 - math.sin(a) * across + math.cos(a) * along, y0 + math.cos(a) * across + math.sin(a) * along
    angle, width_px = best.turn % (180 if tip is None else 360), best.width * shrunk
    return ImageLine(angle, x, y, width_px, best.contrast / level, best.score)


class _Band(NamedTuple):
    energy: float
    turn: float
    offset: float
    along: float
    width: float
    contrast: float
    score: float


def _band(small: np.ndarray, centre, turn: float, *, hidden: float, from_tip: bool, sign: int) -> _Band:
    """Returns the band with the most energy along direction `turn` of a small picture."""
    h, w = small.shape
    reach = math.ceil(math.hypot(h, w) / 2)
    half, first, columns = (REACH_PX, hidden, REACH_PX) if from_tip else (reach, -reach, 2 * reach)
    a = math.radians(turn)
    c, s = math.cos(a), math.sin(a)
    # turned (column, row) -> small picture
    M = np.array([
        [c, -s, centre[0] + c * first + s * half],
        [s, c, centre[1] + s * first - c * half],
    ])  # fmt: skip
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    turned = cv2.warpAffine(small, M, (columns, 2 * half), flags=flags, borderValue=OUTSIDE)
    inside = turned > -1.0
    length = max(columns // PARTS, 4)
    n = columns // length
    value = np.where(inside, turned, 0.0)[:, : n * length].reshape(2 * half, n, length).sum(axis=2)
    count = inside[:, : n * length].reshape(2 * half, n, length).sum(axis=2)
    sums, counts = (np.cumsum(np.pad(part, ((1, 0), (0, 0))), axis=0) for part in (value, count))
    best = _Band(0.0, turn, 0.0, 0.0, 0.0, 0.0, 0.0)
    edges = {inner: _steps(sums, counts, inner, length) for inner in (2, SIDE_PX)}
    for width in BANDS:
        inner = 2 if width < 2 * SIDE_PX else SIDE_PX
        one = _best_of_width(*edges[inner], width, half if from_tip else -1, sign)
        if one is not None and one[0] > best.energy:
            energy, row, along, contrast, score = one
            offset = row + width / 2 - half - 0.5
            best = _Band(energy, turn, offset, first + length * along, width, contrast, score)
    return best


def _steps(sums: np.ndarray, counts: np.ndarray, inner: int, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns two arrays (rows + 1, parts): by how much the rows after a boundary are above those before it,
    and by how much those before are above those after. It averages `inner` rows on the bead's side, and
    SIDE_PX rows on the ground's side after a gap of one row. NaN if they are not all in the picture."""
    size = len(sums) - 1

    def mean(shift: int, rows: int) -> np.ndarray:
        out = np.full(sums.shape, np.nan)
        first = np.arange(max(-shift, 0), min(size - rows - shift, size) + 1)
        low, high = first + shift, first + shift + rows
        some = counts[high] - counts[low]
        whole = some >= 0.9 * rows * length
        out[first] = np.where(whole, (sums[high] - sums[low]) / np.maximum(some, 1), np.nan)
        return out

    before = mean(0, inner) - mean(-1 - SIDE_PX, SIDE_PX)
    after = mean(-inner, inner) - mean(1, SIDE_PX)
    return before, after


def _best_of_width(before, after, width: int, through: int, sign: int):
    """Returns (energy, first row, middle in parts of the length, contrast, score) of the best band of one
    width, None if there is none. The band must contain the row `through` if that is not negative."""
    if width >= len(before):
        return None
    up, down = before[:-width], after[width:]
    both = np.minimum(np.abs(up), np.abs(down))
    contrast = np.where(np.isnan(both), np.nan, np.where(up * down > 0, np.copysign(both, up), 0.0))
    seen = ~np.isnan(contrast)
    parts, filled = seen.sum(axis=1), np.where(seen, contrast, 0.0)
    some = np.maximum(parts, 1)
    average = filled.sum(axis=1) / some
    spread = np.sqrt(np.maximum(np.square(filled).sum(axis=1) / some - average**2, 0.0))
    lasting = np.maximum(np.abs(average) - spread, 0.0)
    energy = np.where(parts >= FEWEST_PARTS, lasting**2 * math.sqrt(width), 0.0)
    if sign:
        energy = np.where(sign * average > 0, energy, 0.0)
    if through >= 0:
        beside = np.abs(np.arange(len(energy)) + width / 2 - through)
        energy = np.where(beside <= np.clip(width / 4, 1.5, 4.0), energy, 0.0)
    k = int(np.argmax(energy))
    if energy[k] <= 0:
        return None
    weight = np.abs(filled[k])
    along = float(weight @ (np.arange(len(weight)) + 0.5) / max(weight.sum(), 1e-9))
    score = abs(average[k]) * math.sqrt(parts[k]) / max(spread[k], 0.5)
    return float(energy[k]), float(k), along, float(average[k]), float(score)


@functools.lru_cache(maxsize=64)
def matrix(pose: Pose) -> np.ndarray:
    """Returns the matrix (2, 3) from (column, row) of the turned picture to (x, y) of the original
    picture."""
    a = math.radians(pose.angle_deg)
    c, s = math.cos(a) / pose.scale, math.sin(a) / pose.scale
    return np.array([
        [c, -s, pose.x - c * pose.column + s * pose.row],
        [s, c, pose.y - s * pose.column - c * pose.row],
    ])  # fmt: skip


def turned(frame: np.ndarray, pose: Pose) -> np.ndarray:
    """Returns the picture (rows, columns) in gray with the line along its rows. Places outside the frame
    repeat its border."""
    return cv2.warpAffine(
        gray(frame),
        matrix(pose),
        (pose.columns, pose.rows),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )


def pose_on(
    line: ImageLine, shape: tuple[int, int], *, ahead_px: float = math.inf, behind_px: float = math.inf
) -> Pose:
    """Returns the pose that keeps only the line and its surroundings: half its width on both sides, and as
    much of its length as lies with them inside the frame (rows, columns), at most ahead_px and behind_px. A
    line narrower than the windows of an edge is enlarged."""
    scale = max(1.0, round(WIDE_PX / line.width_px))
    half = math.ceil(max(line.width_px * scale, LEAST_PX / 2) * 0.9) + 8
    pose = Pose(line.angle_deg, line.x, line.y, 0.0, half - 0.5, 2 * half, LEAST_PX, scale)
    most = [math.floor(min(math.hypot(*shape), limit) * scale) for limit in (ahead_px, behind_px)]
    ahead = span(pose, shape, (0, most[0]), half)[1]
    back = pose._replace(angle_deg=line.angle_deg + 180)
    behind = span(back, shape, (0, most[1]), half)[1]
    return pose._replace(column=float(behind), columns=max(ahead + behind, LEAST_PX))


def span(pose: Pose, shape: tuple[int, int], columns: tuple[int, int], half: float) -> tuple[int, int]:
    """Returns the first and one past the last of the first run of `columns`, counted from the pose's point,
    that lie inside the frame (rows, columns) over `half` rows on both sides. Both are equal if there is no
    such run."""
    M = matrix(pose._replace(column=0.0, row=0.0))
    steps = np.arange(*columns)
    ones = np.ones(len(steps))
    corners = [np.column_stack([steps, r * ones, ones]) @ M.T for r in (-half, half)]
    h, w = shape
    inside = np.all([np.all((at > -1) & (at < (w, h)), axis=1) for at in corners], axis=0)
    first = int(np.argmax(np.append(inside, True)))
    return columns[0] + first, columns[0] + first + int(np.argmin(np.append(inside[first:], False)))


def foot(line: ImageLine, x: float, y: float) -> tuple[float, float]:
    """Returns the point of the line that is nearest to (x, y)."""
    a = math.radians(line.angle_deg)
    along = (x - line.x) * math.cos(a) + (y - line.y) * math.sin(a)
    return line.x + along * math.cos(a), line.y + along * math.sin(a)


def with_room(pose: Pose, shape: tuple[int, int], columns: tuple[int, int]) -> Pose:
    """Returns the pose with its line in the middle of as many rows as lie inside the frame (rows, columns)
    over `columns`, at least LEAST_PX and at most the frame's diagonal."""
    h, w = shape
    M = matrix(pose._replace(row=0.0))
    first, last = columns[0], columns[1] - 1

    def inside(half: float) -> bool:
        corners = np.array([[c, r, 1.0] for c in (first, last) for r in (-half, half)]) @ M.T
        return bool(np.all((corners > -1) & (corners < (w, h))))

    most = math.floor(math.hypot(h, w) / 2)
    half = next((r for r in range(most, LEAST_PX // 2 - 1, -1) if inside(r)), LEAST_PX // 2)
    return pose._replace(row=half - 0.5, rows=2 * half)


# ---- how the pictures of a trial are turned: as the camera's calibration says, or as their line shows


class Mounting(NamedTuple):
    """How a camera is mounted. `mm_per_px`: size of a pixel in mm, negative if the line trails to higher
    columns; `nozzle_column`: the nozzle's column; `columns`: the columns that are measured;
    `longest_blur_px`: the largest blur of a usable bead; `sign`: 1 for a bead brighter than its ground, -1
    for a darker one, 0 if unknown; `rotation_deg`: direction of the line, and `tip_px`: the tip (x, y) in px,
    None if unknown; `mask_px`: the polygon that the nozzle hides; `edge_bias`: pairs in px of a width and by
    how much wider it looks."""

    mm_per_px: float
    nozzle_column: float
    columns: tuple[int, int]
    longest_blur_px: float
    sign: int
    rotation_deg: float | None
    tip_px: tuple[float, float] | None
    mask_px: Sequence[Sequence[float]]
    edge_bias: Sequence[tuple[float, float]]

    def true_px(self, measured_px: np.ndarray) -> np.ndarray:
        """Returns widths in px without the edge bias, interpolated linearly between the known widths. Without
        a calibrated bias they are returned as measured."""
        if not self.edge_bias:
            return measured_px
        known_px, bias_px = np.array(self.edge_bias).T
        return measured_px - np.interp(measured_px, known_px + bias_px, bias_px)

    def bias_deviation_px(self, width_px: float) -> float:
        """Returns by how much the edge bias of a width may be off: BETWEEN of its difference between the two
        neighbouring known widths; 0 if calibration found none."""
        if len(self.edge_bias) < 2:
            return 0.0
        known_px, bias_px = np.array(self.edge_bias).T
        at = int(np.clip(np.searchsorted(known_px, width_px), 1, len(known_px) - 1))
        return BETWEEN * float(abs(bias_px[at] - bias_px[at - 1]))

    @property
    def hidden_px(self) -> float:
        """The hidden length of the line in px, from the tip to the begin of the measured columns."""
        return max(abs(self.columns[0] - self.nozzle_column), 0.0)


def pose(
    mounting: Mounting,
    time_s: np.ndarray,
    gantry: Gantry,
    frames: Callable[[Collection[int]], Iterable[tuple[int, np.ndarray]]],
) -> tuple[Pose | None, slice]:
    """Returns how pictures taken at time_s (F,) are turned (None: not at all), and the rows of the turned
    picture that hold no other line. The pose follows from the mounting, or else from the frames with a bead
    less those without. `frames` gives (number, picture) for some numbers."""
    along, picture = bead_alone(time_s, gantry, frames)
    if along is None or picture is None:
        return None, slice(0, None)
    turn = _turn(mounting, picture)
    if turn is None:
        columns = slice(*mounting.columns)
        changed = np.abs(picture[:, columns].mean(axis=1) - 128.0)
        return None, clear_rows(along[:, columns], int(np.argmax(scipy.ndimage.uniform_filter1d(changed, 5))))
    return turn, clear_rows(turned(along, turn)[:, slice(*mounting.columns)], turn.rows // 2)


def _turn(mounting: Mounting, picture: np.ndarray) -> Pose | None:
    """Returns the pose from the mounting, or else from the line in a picture of the bead alone (rows,
    columns)."""
    shape = (picture.shape[0], picture.shape[1])
    if mounting.rotation_deg is not None:
        level = not mounting.rotation_deg and mounting.tip_px is None
        return None if level else placed(mounting, shape, mounting.rotation_deg, None)
    found = find(
        picture, tip=mounting.tip_px, hidden_px=mounting.hidden_px, mask=mask(mounting, shape),
        sign=mounting.sign,
    )  # fmt: skip
    if found is not None:
        return pose_of_line(mounting, shape, found)
    return None if mounting.tip_px is None else placed(mounting, shape, 0.0, None)


def clear_rows(picture: np.ndarray, row: int) -> slice:
    """Returns the rows around the bead that lies along `row` of a picture (rows, columns), up to most of the
    gap to the next line on either side; all rows if there is none. A line printed beside it would be mistaken
    for background, or for bead."""
    profile = np.median(picture, axis=1).astype(float)
    h, ground = len(profile), float(np.median(profile))
    rise = float(np.median(profile[max(row - 3, 0) : row + 4])) - ground
    if abs(rise) < LEAST_CONTRAST:
        return slice(0, h)
    # a specular line parts no bead
    width = h // 16
    bead = scipy.ndimage.maximum_filter1d((profile - ground) / rise, width) > 0.5
    bead = scipy.ndimage.minimum_filter1d(bead, width, mode="nearest")
    ends = []
    for side in (bead[row::-1], bead[row:]):
        edge = int(np.argmin(np.append(side, False)))
        gap = int(np.argmax(np.append(side[edge:], True)))
        ends.append(edge + round(GAP * gap) if edge + gap < len(side) else len(side))
    return slice(row + 1 - ends[0], row + ends[1])


def pose_of_line(mounting: Mounting, shape: tuple[int, int], found: ImageLine) -> Pose | None:
    """Returns the pose for a line found in pictures of this shape (rows, columns); None if the line is level
    and no tip is known."""
    if mounting.tip_px is not None:
        # the line comes out of the tip and trails to the side that mm_per_px says
        return placed(mounting, shape, found.angle_deg + (180 if mounting.mm_per_px > 0 else 0), found)
    angle = (found.angle_deg + 90) % 180 - 90
    return None if abs(angle) < LEVEL_DEG else placed(mounting, shape, angle, found)


def placed(mounting: Mounting, shape: tuple[int, int], angle_deg: float, found: ImageLine | None) -> Pose:
    """Returns the pose that moves the tip to the nozzle's column and the line to the middle row. Without a
    tip the picture's middle is kept. It has as many rows as the frame has on both sides of the line over the
    measured columns."""
    h, w = shape
    column = (w - 1) / 2
    x, y = (w - 1) / 2, (h - 1) / 2
    if mounting.tip_px is not None:
        (x, y), column = mounting.tip_px, mounting.nozzle_column
    elif found is not None:
        x, y = foot(found, x, y)
    start = Pose(angle_deg % 360, x, y, column, 0.0, h, mounting.columns[1])
    return with_room(start, shape, mounting.columns)


def mask(mounting: Mounting, shape: tuple[int, int]) -> np.ndarray | None:
    """Returns (h, w) bool: the polygon of the picture that the nozzle hides; None if there is none."""
    if len(mounting.mask_px) < 3:
        return None
    hidden = np.zeros(shape, np.uint8)
    cv2.fillPoly(hidden, [np.rint(np.array(mounting.mask_px)).astype(np.int32)], 1)
    return hidden.astype(bool)


def bead_alone(
    time_s: np.ndarray, gantry: Gantry, frames: Callable[[Collection[int]], Iterable[tuple[int, np.ndarray]]]
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Returns the mean (h, w) of some frames in which the gantry moves along, and the same less the mean of
    some frames before it moved, about the middle level. The second shows no nozzle, light or other things
    that move with the camera. Both are None if the gantry never moves."""
    x = np.interp(time_s, *gantry)
    travelled = np.abs(x - x[0]) / max(float(np.ptp(x)), 1e-9)
    before, along = np.flatnonzero(travelled < 1e-3), np.flatnonzero((travelled > 0.2) & (travelled < 0.95))
    kinds = {}
    for kind, numbers in (("before", before), ("along", along)):
        sample = numbers[np.linspace(0, len(numbers) - 1, min(SAMPLE, len(numbers))).astype(int)]
        kinds |= dict.fromkeys(sample.tolist(), kind)
    pictures: dict[str, list[np.ndarray]] = {"before": [], "along": []}
    for number, frame in frames(kinds):
        pictures[kinds[number]].append(frame.astype(np.float32) * (255 / np.iinfo(frame.dtype).max))
    if not pictures["along"]:
        return None, None
    mean = alone = np.mean(pictures["along"], axis=0)
    if pictures["before"]:
        alone = 128 + (mean - np.mean(pictures["before"], axis=0)) / 2
    along, alone = (np.clip(np.rint(one), 0, 255).astype(np.uint8) for one in (mean, alone))
    return along, alone
