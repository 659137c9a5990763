"""Two devices that write under one name: samples jump to and fro between two courses, and intervals
alternate."""

import numpy as np

from pipeline.recordings.quality import quantisation_step

# windows of so many samples, half overlapping: short ones for devices that write in turn, long ones for
# devices that write in batches
WINDOWS = (32, 128)
LEAST_SHARE, LEAST_CROSSINGS, LEAST_WINDOWS = 1 / 8, 4, 3
# between the two courses lies nothing: a gap three times any other, and three steps of a coarse sensor, of
# which none is coarser than 2
GAP, COARSEST_STEP = 3.0, 2.0
WINDOWS_AT_ONCE = 1000


def mixed(values: np.ndarray) -> list[tuple[int, int, float]]:
    """(first, last, distance) of the stretches of values (n,) whose samples belong to two courses at once,
    `distance` apart.

    In each window the best parabola is taken off and the rest sorted. Two courses make two groups with a gap
    between, and the samples change group again and again. (A step changes it once, a spike twice.)
    """
    finite = np.flatnonzero(np.isfinite(values))
    y, step = values[finite], 0.0
    suspect, distance = np.zeros(len(y), bool), np.zeros(len(y), np.float32)
    for size in WINDOWS:
        if len(y) < size:
            continue
        starts = np.unique(np.r_[np.arange(0, len(y) - size, size // 2), len(y) - size])
        gap = np.concatenate(
            [_gaps(y, part, size) for part in np.array_split(starts, -(-len(starts) // WINDOWS_AT_ONCE))]
        )
        hit = _in_a_row(gap > 0, min(LEAST_WINDOWS, len(gap)))
        if not hit.any():
            continue
        # most records are through by now: the step costs more than the gaps
        step = step or _coarse_step(y)
        hit = _in_a_row(gap > GAP * step, min(LEAST_WINDOWS, len(gap)))
        for start, width in zip(starts[hit], gap[hit], strict=True):
            suspect[start : start + size] = True
            distance[start : start + size] = width
    edges = np.flatnonzero(np.diff(np.r_[False, suspect, False].astype(np.int8)))
    return [
        (int(finite[a]), int(finite[b - 1]), float(np.median(distance[a:b])))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _coarse_step(y: np.ndarray) -> float:
    """The step that a coarse sensor may explain, more than 0."""
    # over one sample and over more: with two devices in turn every change from sample to sample is a jump
    step = min(COARSEST_STEP, *(_least_change(y, lag) for lag in (1, 2, 3)))
    # a converter may be coarser: its levels tell, where there are more than the two of two devices at rest
    return max(step, quantisation_step(y)) if len(np.unique(y)) > 2 else step


def _least_change(y: np.ndarray, lag: int) -> float:
    """The first percentile of the changes: one step of a coarse sensor, next to nothing of a fine one."""
    changes = np.abs(y[lag:] - y[:-lag])
    changes = changes[changes > 0]
    return float(np.percentile(changes, 1)) if len(changes) else np.inf


def _gaps(y: np.ndarray, starts: np.ndarray, size: int) -> np.ndarray:
    """The gap between the two courses in each window, 0 for a window without two, whatever the sensor's
    step."""
    windows = np.lib.stride_tricks.sliding_window_view(y, size)[starts]
    parabola = np.linalg.qr(np.vander(np.linspace(-1, 1, size), 3))[0]
    rest = windows - windows @ parabola @ parabola.T
    ordered = np.sort(rest, axis=1)
    between = np.diff(ordered, axis=1)
    least, rows = round(LEAST_SHARE * size), np.arange(len(starts))
    at = least - 1 + np.argmax(between[:, least - 1 : size - least], axis=1)
    gap, middle = between[rows, at], (ordered[rows, at] + ordered[rows, at + 1]) / 2
    between[rows, at] = 0
    apart = np.flatnonzero(gap > GAP * between.max(1))
    crossings = np.count_nonzero(np.diff(rest[apart] > middle[apart, None], axis=1), axis=1)
    two = apart[crossings >= LEAST_CROSSINGS]
    gaps = np.zeros(len(starts))
    gaps[two] = gap[two]
    return gaps


def _in_a_row(hit: np.ndarray, least: int) -> np.ndarray:
    """Mask (n,) of the hits that stand in a row of at least `least`."""
    edges = np.flatnonzero(np.diff(np.r_[False, hit, False].astype(int)))
    long_enough = np.zeros(len(hit), bool)
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        long_enough[a:b] = b - a >= least
    return long_enough


def alternate(intervals_s: np.ndarray) -> bool:
    """Whether a long interval follows each short one, as with two clocks of one rate, one behind the
    other."""
    if len(intervals_s) < 20:
        return False
    deviation = intervals_s - intervals_s.mean()
    power = float(deviation @ deviation)
    return power > 0 and float(deviation[1:] @ deviation[:-1]) < -0.8 * power
