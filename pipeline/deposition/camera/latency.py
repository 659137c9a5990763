"""How late a camera's pictures are against the gantry, from the pictures' own motion: nothing of the
extruder enters.

What lies on the stage is seen by many frames at many columns. With the right latency L all readings of a
place s = x(t - L) + (column - nozzle_column) mm_per_px agree; with a wrong one they part wherever the
gantry's speed changes. At an even speed a latency is a shift of the stage and is not seen.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

# latencies that are tried, s, and the step of the first search
EARLIEST_S, LATEST_S, STEP_S = -0.06, 0.26, 0.01
# frames count that lie so near to a change of speed, s
NEAR_S = 0.6
# a change of speed, as share of the highest
CHANGE = 0.05
# neighbouring readings err alike: the formal deviation is too small by about this factor
INFLATION = 8.0
# no latency that is more than so many steps away may come so near to the best, in scatters of the sum
APART, DISTINCT = 3, 2.0
# a travel of more readings than this is in another unit
LONGEST_CELLS = 1e6


class Latency(NamedTuple):
    """latency_s: the frames are so much later than their stamps say; deviation_s its standard deviation,
    infinite where the pictures do not tell."""

    latency_s: float
    deviation_s: float


UNTOLD = Latency(0.0, math.inf)
# a latency known to this is taken off; one that is less known counts as unknown, s
KNOWN_S = 0.005


# the gantry as recorded: time_s (T,), and its place (T,) in mm along the line
Gantry = tuple[np.ndarray, np.ndarray]


def near_changes(time_s: np.ndarray, gantry: Gantry) -> np.ndarray:
    """(F,) bool: whether the gantry's speed changes near a frame."""
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


def estimate(time_s: np.ndarray, signals: np.ndarray, gantry: Gantry, *, step_mm: float) -> Latency:
    """The latency of F frames taken at time_s (F,), of which signals (F, bands, n) are gray levels in bands
    along the line, each of the n readings `step_mm` further along the stage than the one before (negative
    where the line trails to higher columns)."""
    used = near_changes(time_s, gantry)
    values = np.asarray(signals, np.float64)[used]
    if len(values) < 8:
        return UNTOLD
    # what rides with the camera says nothing of the motion
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
    # of noise alone the sum of squares scatters by this much from one latency to another
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
    """Sum of squares of values (F, bands, n) about the mean of their places (F, n), in cells."""
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


def pooled(estimates: Sequence[Latency]) -> Latency:
    """The latency of one camera from that of several recordings, each weighted by its certainty; the
    deviation is what they scatter where that is more than they say."""
    told = [one for one in estimates if math.isfinite(one.deviation_s)]
    if not told:
        return UNTOLD
    weight = np.array([1 / max(one.deviation_s, 1e-6) ** 2 for one in told])
    values = np.array([one.latency_s for one in told])
    mean = float(weight @ values / weight.sum())
    scatter = float(weight @ np.square(values - mean) / weight.sum()) / max(len(told) - 1, 1)
    return Latency(mean, max(1 / math.sqrt(weight.sum()), math.sqrt(scatter)))


def of_camera(latency_s: float | None, estimates: Sequence[Latency]) -> Latency:
    """The latency that is taken off: as given, or as the recordings together tell it to KNOWN_S."""
    if latency_s is not None:
        return Latency(latency_s, 0.0)
    together = pooled(estimates)
    return together if together.deviation_s <= KNOWN_S else UNTOLD
