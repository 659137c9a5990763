"""Clocks that do not run forward: what can be put right without a guess is, and is counted; the rest is left
for `check_clock` to refuse.
"""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.recordings.formats import OTHER_DEVICE_RUN, FileColumns, Note, check_clock
from pipeline.recordings.quality import least_change, quantisation_step

HOUR_S = 3600
# rows that came late, or had a time that another one has: more than that is another device, or no clock
FEW_SHARE, FEW_ROWS_OF = 0.02, 10
# a row that came late is no more than so many behind
LATEST_ROWS = 8
# stretches between restarts that begin and end within so many intervals are of one clock
AGREE_INTERVALS = 3
# seconds that hold as many rows each, but one; and rows that take turns between two courses
LEAST_STAMPS, ALIKE_SHARE, TURNS_SHARE = 4, 0.9, 0.8


class Mended(NamedTuple):
    """Columns whose time runs forward, and the indices of the rows at which the clock had started over."""

    columns: FileColumns
    restarts: np.ndarray
    notes: list[Note]


def mended(path: Path, group: FileColumns, *, may_restart: bool) -> Mended:
    """The columns on a clock that runs forward.

    An hour that the end of summer time repeats on a clock without zone is counted on. One that starts over
    goes on behind what was before, and its first row is a restart. Stamps of whole seconds with several rows
    each are spread evenly. A few late rows are sorted back. Of rows with one time the first stays: exact
    repeats are dropped, and a few others.

    Raises ValueError with the place where that is not enough.
    """
    time = group.time
    if len(time) < 2 or (time[1:] > time[:-1]).all() or not np.isfinite(time).all():
        check_clock(path, group)
        return Mended(group, np.empty(0, int), [])
    notes: list[Note] = []
    group = group._replace(time=_summer_time(group, notes))
    restarts = _restarts(group.time) if may_restart else np.empty(0, int)
    if len(restarts):
        notes.append(_restart_note(group, restarts))
        group = group._replace(time=_going_on([group.time], [restarts])[0])
    return _forward(path, group, restarts, notes)


def mended_topics(path: Path, groups: Sequence[FileColumns], *, one_clock: bool) -> list[Mended]:
    """`mended` for the groups of a recording, which start over together.

    Each must have started over as often. Where they have not `one_clock`, the recorder's, the stretches
    between must also agree in start and end, as a clock that one device alone set back would not.
    """
    if len(groups) == 1:
        return [mended(path, groups[0], may_restart=True)]
    rows = [_restarts(group.time) for group in groups]
    most = max(map(len, rows))
    if one_clock:
        # commands that come as events are too few to tell a restart from a second device
        rows = [
            own if len(own) == most else _falls(group.time) for own, group in zip(rows, groups, strict=True)
        ]
    if not most or any(len(own) != most for own in rows) or not (one_clock or _agree(groups, rows)):
        return [mended(path, group, may_restart=False) for group in groups]
    times = _going_on([group.time for group in groups], rows)
    return [
        _forward(path, group._replace(time=time), own, [_restart_note(group, own)])
        for group, time, own in zip(groups, times, rows, strict=True)
    ]


def _forward(path: Path, group: FileColumns, restarts: np.ndarray, notes: list[Note]) -> Mended:
    """Stamps that share a second spread, late rows sorted back, repeats dropped; checked."""
    time = _spread(group, restarts, notes)
    order = _forward_rows(group._replace(time=time), notes)
    columns = _rows(group._replace(time=time), order)
    check_clock(path, columns)
    return Mended(columns, np.searchsorted(order, restarts), notes)


def _rows(group: FileColumns, order: np.ndarray) -> FileColumns:
    values = {name: column[order] for name, column in group.values.items()}
    place = group.place
    return group._replace(time=group.time[order], values=values, place=lambda i: place(int(order[i])))


def _second(time: np.ndarray) -> float:
    return 1e9 if time.dtype == np.int64 else 1.0


def _note(kind: str, rows: np.ndarray, place: Callable[[int], str], message: str) -> Note:
    return Note(kind, "", len(rows), f"{message}, the first in {place(int(rows[0]))}")


def _interval(time: np.ndarray) -> float:
    """The median of the intervals that run forward."""
    steps = np.diff(time)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _few(rows: int, of: int) -> bool:
    return rows <= max(1 if of >= FEW_ROWS_OF else 0, FEW_SHARE * of)


def _summer_time(group: FileColumns, notes: list[Note]) -> np.ndarray:
    """The times with an hour added behind each fall by an hour, on a calendar without zone."""
    time = group.time
    if time.dtype != np.int64 or group.zone:
        return time
    steps = np.diff(time)
    falls = np.flatnonzero(np.abs(steps + HOUR_S * _second(time)) <= 3 * _interval(time))
    if not 0 < len(falls) <= 2:
        return time
    notes.append(
        _note(
            "clock",
            falls + 1,
            group.place,
            "an hour is repeated, as where summer time ends, and was counted on",
        )
    )
    added = np.zeros(len(time), np.int64)
    added[falls + 1] = HOUR_S * 10**9
    return time + np.cumsum(added)


def _restarts(time: np.ndarray) -> np.ndarray:
    """The indices of the rows at which a clock starts over."""
    none, starts = np.empty(0, int), _falls(time)
    if not len(starts) or not np.isfinite(time).all():
        return none
    ends, first, latest, restarts = np.r_[starts[1:], len(time)], time[0], time[starts[0] - 1], []
    for start, end in zip(starts, ends, strict=True):
        run = time[start:end]
        # late rows are a few, and soon followed by the one that was due
        if run[0] <= first or np.searchsorted(run, latest) > LATEST_ROWS:
            restarts.append(int(start))
            first, latest = run[0], run[-1]
        else:
            latest = max(latest, run[-1])
    if not restarts or len(time) <= OTHER_DEVICE_RUN * (len(restarts) + 1):
        return none
    return np.array(restarts)


def _falls(time: np.ndarray) -> np.ndarray:
    return np.flatnonzero(np.diff(time) < 0) + 1


def _restart_note(group: FileColumns, rows: np.ndarray) -> Note:
    message = f"the clock starts over {len(rows)} times: segments begin there"
    return _note("restart", rows, group.place, message)


def _going_on(times: Sequence[np.ndarray], restarts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The times of each group, in which a stretch begins one interval behind the one before; all groups by
    the same."""
    shifted = [time.copy() for time in times]
    interval = np.asarray(max(_interval(time) for time in times)).astype(times[0].dtype)
    views = [np.split(time, rows) for time, rows in zip(shifted, restarts, strict=True)]
    for before, now in itertools.pairwise(zip(*views, strict=True)):
        by = max(stretch.max() for stretch in before) + interval - min(stretch.min() for stretch in now)
        for stretch in now:
            stretch += by
    return shifted


def _agree(groups: Sequence[FileColumns], restarts: Sequence[np.ndarray]) -> bool:
    """Whether the stretches of all groups begin and end within a few intervals of each other."""
    near = AGREE_INTERVALS * max(_interval(group.time) for group in groups)
    ends = np.array(
        [
            [(stretch[0], stretch[-1]) for stretch in np.split(group.time, rows)]
            for group, rows in zip(groups, restarts, strict=True)
        ]
    )
    return bool((np.ptp(ends, axis=0) <= near).all())


def _spread(group: FileColumns, restarts: np.ndarray, notes: list[Note]) -> np.ndarray:
    """Times of rows that share a stamp of whole seconds, spread evenly over it.

    Nearly every second must hold as many rows, and the rows must not be exact repeats nor take turns between
    two courses, as those of two devices do.
    """
    time = group.time
    begins = np.r_[True, np.diff(time) != 0]
    begins[restarts] = True
    starts = np.flatnonzero(begins)
    counts = np.diff(np.r_[starts, len(time)])
    inner = counts[1:-1] if len(counts) > 2 else counts
    rows = int(np.median(inner))
    second = _second(time)
    alike = np.mean(np.abs(inner - rows) <= 1) >= ALIKE_SHARE
    if rows < 2 or len(counts) < LEAST_STAMPS or not alike or (time % second).any():
        return time
    stamp = np.repeat(np.arange(len(starts)), counts)
    place = np.arange(len(time)) - starts[stamp]
    same = ~begins[1:]
    if _repeats(group)[same].all() or _take_turns(group, place, rows):
        return time
    width = np.diff(time[starts], append=time[starts[-1]] + np.median(np.diff(time[starts])))
    width = np.minimum(np.where(width > 0, width, second), np.median(width))
    # the first second may have begun before the recording did
    place[stamp == 0] += max(0, rows - counts[0])
    shares = np.maximum(counts, np.where(np.arange(len(counts)) == 0, rows, 0))
    notes.append(
        Note(
            "spread",
            "",
            len(time),
            f"{rows} rows share each time stamp of whole seconds: they were spread evenly over it",
        )
    )
    return time + (place * width[stamp] / shares[stamp]).astype(time.dtype)


def _repeats(group: FileColumns) -> np.ndarray:
    """Mask (n - 1,) of the rows that are the row before once more."""
    same = group.time[1:] == group.time[:-1]
    for column in group.values.values():
        now, before = column[1:], column[:-1]
        same &= (now == before) | (np.isnan(now) & np.isnan(before))
    return same


def _take_turns(group: FileColumns, place: np.ndarray, rows: int) -> bool:
    """Whether some column goes up at one place of each stamp and down at another."""
    for column in group.values.values():
        change = np.diff(column)
        shares = [
            (np.mean(part > 0), np.mean(part < 0))
            for j in range(rows)
            if len(part := change[(place[1:] == j) & np.isfinite(change)])
        ]
        if shares and all(max(share[side] for share in shares) >= TURNS_SHARE for side in (0, 1)):
            return True
    return False


def _forward_rows(group: FileColumns, notes: list[Note]) -> np.ndarray:
    """Indices of the rows in the order of time, without those whose time another one has. All rows where too
    many would move or be left out."""
    time, rows = group.time, np.arange(len(group.time))
    order = rows
    behind = np.maximum.accumulate(time) - time
    late = np.flatnonzero(behind > 0)
    near = behind.max() <= 2 * LATEST_ROWS * _interval(time)
    if len(late) and near and _few(len(late), len(time)):
        order = np.argsort(time, kind="stable")
        notes.append(_note("sorted", late, group.place, f"{len(late)} rows came late and were sorted back"))
    if (time[order][1:] < time[order][:-1]).any():
        return rows
    sorted_rows = _rows(group, order)
    repeats = np.flatnonzero(_repeats(sorted_rows)) + 1
    if len(repeats):
        message = f"{len(repeats)} rows are the row before once more and were dropped"
        notes.append(_note("repeated", repeats, sorted_rows.place, message))
        order = np.delete(order, repeats)
        sorted_rows = _rows(group, order)
    others = np.flatnonzero(np.diff(sorted_rows.time) == 0) + 1
    if len(others) and _few(len(others), len(time)):
        message = (
            f"{len(others)} rows have the time of the row before and other values: the first of each stays"
        )
        notes.append(_note("repeated", others, sorted_rows.place, message))
        order = np.delete(order, others)
    return order


# ---- two devices under one name: samples jump to and fro between two courses, and intervals alternate

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
    step = min(COARSEST_STEP, *(least_change(y, lag) for lag in (1, 2, 3)))
    # a converter may be coarser: its levels tell, where there are more than the two of two devices at rest
    return max(step, quantisation_step(y)) if len(np.unique(y)) > 2 else step


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
