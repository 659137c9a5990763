"""Reads the frames of a trial before any flow is computed: the bead's width in every frame, its possible
error, and the camera's latency against the gantry.

The latency is found from the motion of the pictures alone, without a model of the extruder. Many frames show
the same point of the stage at many columns. With the right latency L all readings of a place

    s = x(t - L) + (column - nozzle_column) mm_per_px

agree. With a wrong one they differ wherever the gantry's speed changes. At constant speed a latency is only a
shift of the stage and cannot be detected.
"""

import itertools
import math
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from pipeline.deposition.camera import bead, line
from pipeline.deposition.camera.bead import Bead
from pipeline.deposition.camera.line import Gantry, Mounting, pose

# frames measured together
TOGETHER = 16
# size in px of a reading along the line, and number of bands across it, from which the pictures' motion is
# found
STEP_PX, BANDS = 4, 16
# a bead this many times as blurred as in most frames, or with less than this share of their contrast, is none
BLURRED, FAINT = 2.5, 0.4
UNLIKE = "unlike the other frames"

# latencies that are tried, s, and the step of the first search
EARLIEST_S, LATEST_S, STEP_S = -0.06, 0.26, 0.01
# frames count if they are this near to a change of speed, s
NEAR_S = 0.6
# a change of speed, as share of the highest
CHANGE = 0.05
# neighbouring readings err alike: the formal deviation is too small by about this factor
INFLATION = 8.0
# no latency more than this many steps away may be this near to the best, in scatters of the sum
APART, DISTINCT = 3, 2.0
# a travel of more readings than this is in another unit
LONGEST_CELLS = 1e6


class TrialFrames(Protocol):
    """(time_s, picture) of each frame, in the order of time. It can be iterated as often as needed."""

    time_s: np.ndarray

    def __iter__(self) -> Iterator[tuple[float, np.ndarray]]: ...

    def pick(self, numbers: Collection[int]) -> Iterator[tuple[int, np.ndarray]]:
        """Yields (number, picture) of the frames with these numbers."""
        ...


class Latency(NamedTuple):
    """latency_s: by how much the frames are later than their stamps; deviation_s: its standard deviation,
    infinite if the pictures do not show it."""

    latency_s: float
    deviation_s: float


UNTOLD = Latency(0.0, math.inf)
# a latency known to this is taken off; one that is less known counts as unknown, s
KNOWN_S = 0.005


class Readings(NamedTuple):
    """The readings of F frames. `time_s` (F,) as stamped; `columns` (m,); `widths` (F, m) in px of the
    picture as it is measured (0 bare, NaN unread); `reasons` (F,): why a frame has no usable bead; `latency`:
    the camera's latency from this recording; `edge_px`: by how much all widths may be off because of blur and
    contrast (NaN without a bead)."""

    time_s: np.ndarray
    columns: np.ndarray
    widths: np.ndarray
    reasons: list[str]
    latency: Latency
    edge_px: float

    @classmethod
    def from_values(cls, values: tuple) -> "Readings":
        """Makes readings from six plain values, the latency as (latency_s, deviation_s)."""
        *rest, late, edge_px = values
        return cls(*rest, Latency(*late), edge_px)


def measure_beads(
    frames: TrialFrames, gantry: Gantry, mounting: Mounting
) -> Iterator[tuple[float, np.ndarray, Bead]]:
    """Yields (time, picture as it is measured, bead) of each frame. A few frames are measured at a time, so
    that memory is bounded and the cost beyond decoding is shared."""
    turn, rows = pose(mounting, frames.time_s, gantry, frames.pick)
    rest = iter(frames)
    while batch := list(itertools.islice(rest, TOGETHER)):
        times, pictures = zip(*batch, strict=True)
        pictures = [picture if turn is None else line.turned(picture, turn) for picture in pictures]
        beads = bead.measure_all(
            [picture[rows] for picture in pictures],
            columns=(mounting.columns[0], min(mounting.columns[1], pictures[0].shape[1])),
            longest_blur_px=mounting.longest_blur_px,
            sign=mounting.sign,
        )
        beads = [one._replace(top=one.top + rows.start, bottom=one.bottom + rows.start) for one in beads]
        yield from zip(times, pictures, beads, strict=True)


def consistent(beads: Sequence[Bead]) -> list[Bead]:
    """Returns the beads of one recording. Beads far more blurred or fainter than most, or of the other
    colour, get a reason, because grain of an empty bed is sometimes mistaken for a bead."""
    blur, contrast = _typical(beads)
    return [
        one
        if one.reason or (one.blur_px <= BLURRED * blur and one.contrast / contrast >= FAINT)
        else one._replace(widths=one.widths * np.nan, width=np.nan, deviation=np.nan, reason=UNLIKE)
        for one in beads
    ]


def _typical(beads: Sequence[Bead]) -> tuple[float, float]:
    """Returns median blur in px and contrast of the usable beads; NaN without one."""
    usable = [(one.blur_px, one.contrast) for one in beads if not one.reason]
    blur, contrast = np.median(usable, axis=0) if usable else (np.nan, np.nan)
    return float(blur), float(contrast)


def read(frames: TrialFrames, gantry: Gantry, mounting: Mounting) -> Readings:
    """Returns the readings of a trial's frames. `gantry` is its place as recorded."""
    first, last = mounting.columns
    bands = (max((last - first) // STEP_PX, 1), BANDS)
    times, beads, signals = [], [], []
    for time, picture, measured in measure_beads(frames, gantry, mounting):
        times.append(time)
        beads.append(measured)
        strip = picture[:, first : min(last, picture.shape[1])]
        signals.append(cv2.resize(strip, bands, interpolation=cv2.INTER_AREA).astype(np.float32))
    time_s, beads = np.array(times), consistent(beads)
    blur, contrast = _typical(beads)
    level = 257 if signals and picture.dtype == np.uint16 else 1
    return Readings(
        time_s,
        beads[0].columns if beads else np.zeros(0),
        np.array([one.widths for one in beads]),
        [one.reason for one in beads],
        _latency(time_s, signals, mounting, gantry),
        bead.edge_deviation(blur, contrast / level),
    )


def _latency(
    time_s: np.ndarray, signals: Sequence[np.ndarray], mounting: Mounting, gantry: Gantry
) -> Latency:
    known = np.isfinite(gantry[1])
    if known.sum() < 3 or not signals:
        return UNTOLD
    step_mm = mounting.mm_per_px * (mounting.columns[1] - mounting.columns[0]) / signals[0].shape[1]
    known_gantry = (gantry[0][known], gantry[1][known])
    return estimate_latency(time_s, np.array(signals), known_gantry, step_mm=step_mm)


def near_changes(time_s: np.ndarray, gantry: Gantry) -> np.ndarray:
    """Returns (F,) bool: whether the gantry's speed changes near a frame."""
    clock, position = gantry
    speed = np.abs(np.gradient(position, clock))
    top = float(speed.max())
    if not top > 0:
        return np.zeros(len(time_s), bool)
    first = np.searchsorted(clock, time_s - NEAR_S - LATEST_S)
    last = np.maximum(np.searchsorted(clock, time_s + NEAR_S - EARLIEST_S), first + 1)
    last = np.minimum(last, len(speed))
    first = np.minimum(first, last - 1)
    return np.array([np.ptp(speed[a:b]) > CHANGE * top for a, b in zip(first, last, strict=True)])


def estimate_latency(time_s: np.ndarray, signals: np.ndarray, gantry: Gantry, *, step_mm: float) -> Latency:
    """Estimates the latency of F frames taken at time_s (F,). signals (F, bands, n) are gray levels in bands
    along the line; each of the n readings lies `step_mm` further along the stage than the one before
    (negative if the line trails to higher columns). Returns UNTOLD if the frames do not show the latency."""
    used = near_changes(time_s, gantry)
    values = np.asarray(signals, np.float64)[used]
    if len(values) < 8:
        return UNTOLD
    # things that move with the camera show nothing of the motion
    values = values - values.mean(axis=0)
    times, cells = time_s[used], float(abs(step_mm))
    if np.ptp(gantry[1]) > LONGEST_CELLS * cells:
        return UNTOLD
    along = step_mm * np.arange(values.shape[2])

    def miss(L: float) -> float:
        x = np.interp(times - L, *gantry)
        return _disagreement((x[:, None] + along) / cells, values)

    grid = np.arange(EARLIEST_S, LATEST_S + STEP_S / 2, STEP_S)
    misses = np.array([miss(L) for L in grid])
    k = int(np.argmin(misses))
    # for noise alone the sum of squares scatters by this much from one latency to another
    scatter = misses[k] * math.sqrt(2 / values.size)
    others = misses[np.abs(np.arange(len(grid)) - k) > APART]
    if k in (0, len(grid) - 1) or others.min() < misses[k] + DISTINCT * scatter:
        return UNTOLD
    near = grid[k] + np.array([-0.8, -0.4, 0.0, 0.4, 0.8]) * STEP_S
    curve = np.polyfit(near - grid[k], [miss(L) for L in near], 2)
    if curve[0] <= 0:
        return UNTOLD
    best = float(np.clip(-curve[1] / (2 * curve[0]), -STEP_S, STEP_S))
    least = max(float(np.polyval(curve, best)), 1e-9)
    x = np.interp(times - grid[k], *gantry)
    places = len(np.unique(np.floor((x[:, None] + along) / cells)))
    free = values.size - values.shape[1] * places
    variance = least / max(free, 1.0)
    deviation = INFLATION * math.sqrt(variance / curve[0])
    return Latency(float(grid[k]) + best, deviation)


def _disagreement(place: np.ndarray, values: np.ndarray) -> float:
    """Returns the sum of squares of values (F, bands, n) about the mean of their places (F, n), in cells."""
    low = np.floor(place).astype(int)
    share = (place - low).ravel()
    low = (low - low.min()).ravel()
    size = int(low.max()) + 2
    weight = np.bincount(low, 1 - share, size) + np.bincount(low + 1, share, size)
    total = 0.0
    for band in np.moveaxis(values, 1, 0):
        v = band.ravel()
        sums = np.bincount(low, (1 - share) * v, size) + np.bincount(low + 1, share * v, size)
        mean = sums / np.maximum(weight, 1e-9)
        total += float(np.sum(np.square(v - (1 - share) * mean[low] - share * mean[low + 1])))
    return total


def pool_latencies(estimates: Sequence[Latency]) -> Latency:
    """Returns the latency of one camera from those of several recordings, each weighted by its certainty. The
    deviation is the scatter of these latencies if that is larger than their own deviations explain."""
    told = [one for one in estimates if math.isfinite(one.deviation_s)]
    if not told:
        return UNTOLD
    weight = np.array([1 / max(one.deviation_s, 1e-6) ** 2 for one in told])
    values = np.array([one.latency_s for one in told])
    mean = float(weight @ values / weight.sum())
    scatter = float(weight @ np.square(values - mean) / weight.sum()) / max(len(told) - 1, 1)
    return Latency(mean, max(1 / math.sqrt(weight.sum()), math.sqrt(scatter)))


def latency_of_camera(latency_s: float | None, estimates: Sequence[Latency]) -> Latency:
    """Returns the latency used for the correction: `latency_s` if given, else the pooled one of the
    recordings if it is known to KNOWN_S, else UNTOLD."""
    if latency_s is not None:
        return Latency(latency_s, 0.0)
    together = pool_latencies(estimates)
    return together if together.deviation_s <= KNOWN_S else UNTOLD
