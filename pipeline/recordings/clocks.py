"""Repairs clocks that do not run forward if no guess is needed, and counts the repairs; `check_clock` refuses
the rest."""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pipeline.recordings.formats import FileColumns, Note

HOUR_S = 3600
# if a clock falls back after every few samples (this many on average, or fewer), it is not a single clock
OTHER_DEVICE_RUN = 8
# most rows that came late or repeat a time: if there are more, they are from another device, or it is no
# clock
FEW_SHARE, FEW_ROWS_OF = 0.02, 10
# a late row is at most this many rows behind
LATEST_ROWS = 8
# stretches between restarts are of one clock if they begin and end within this many intervals
AGREE_INTERVALS = 3
# fewest stamps, share of seconds with equally many rows (one more or less), share of rows that alternate
LEAST_STAMPS, ALIKE_SHARE, TURNS_SHARE = 4, 0.9, 0.8


# columns with time running forward, the indices of the rows at which the clock had started over, and notes
Repaired = tuple[FileColumns, np.ndarray, list[Note]]


def repair(path: Path, group: FileColumns, *, may_restart: bool) -> Repaired:
    """Returns the columns on a clock that runs forward, the rows at which it had started over, and notes.

    The hour that the end of summer time repeats on a clock without zone is counted on. A clock that starts
    over continues after the last time before, and its first row is a restart. Stamps of whole seconds with
    several rows each are spread evenly. A few late rows are sorted back. Keeps the first row of each
    timestamp and drops the others: exact repeats, and at most a few that differ.

    Raises ValueError with the place if that is not enough.
    """
    time = group.time
    if len(time) < 2 or (time[1:] > time[:-1]).all() or not np.isfinite(time).all():
        check_clock(path, group)
        return group, np.empty(0, int), []
    notes: list[Note] = []
    group = group._replace(time=_summer_time(group, notes))
    restarts = _restarts(group.time) if may_restart else np.empty(0, int)
    if len(restarts):
        notes.append(_restart_note(group, restarts))
        group = group._replace(time=_going_on([group.time], [restarts])[0])
    return _forward(path, group, restarts, notes)


def repair_topics(path: Path, groups: Sequence[FileColumns], *, one_clock: bool) -> list[Repaired]:
    """Returns the results of `repair` for the groups of a recording, which start over together.

    Every group must have started over equally often. If they do not share `one_clock`, the recorder's, the
    stretches between restarts must also agree in start and end. They would not if only one device had set
    back its clock.
    """
    if len(groups) == 1:
        return [repair(path, groups[0], may_restart=True)]
    rows = [_restarts(group.time) for group in groups]
    count = max(map(len, rows))
    if one_clock:
        # commands that come as events are too few to tell a restart from a second device
        rows = [
            own if len(own) == count else _falls(group.time) for own, group in zip(rows, groups, strict=True)
        ]
    if not count or any(len(own) != count for own in rows) or not (one_clock or _agree(groups, rows)):
        return [repair(path, group, may_restart=False) for group in groups]
    times = _going_on([group.time for group in groups], rows)
    return [
        _forward(path, group._replace(time=time), own, [_restart_note(group, own)])
        for group, time, own in zip(groups, times, rows, strict=True)
    ]


def _forward(path: Path, group: FileColumns, restarts: np.ndarray, notes: list[Note]) -> Repaired:
    """Spreads stamps that share a second, sorts late rows back, drops repeats, and checks the clock."""
    group = group._replace(time=_distribute_stamps(group, restarts, notes))
    order = _forward_rows(group, notes)
    columns = _rows(group, order)
    check_clock(path, columns)
    return columns, np.searchsorted(order, restarts), notes


def _rows(group: FileColumns, order: np.ndarray) -> FileColumns:
    values = {name: column[order] for name, column in group.values.items()}
    place = group.place
    return group._replace(time=group.time[order], values=values, place=lambda i: place(int(order[i])))


def _note(kind: str, rows: np.ndarray, place: Callable[[int], str], message: str) -> Note:
    return Note(kind, "", len(rows), f"{message}, the first in {place(int(rows[0]))}")


def _interval(time: np.ndarray) -> float:
    """Returns the median of the intervals that run forward."""
    steps = np.diff(time)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _few(rows: int, total: int) -> bool:
    return rows <= max(1 if total >= FEW_ROWS_OF else 0, FEW_SHARE * total)


def _summer_time(group: FileColumns, notes: list[Note]) -> np.ndarray:
    """Returns the times, with an hour added after each fall by an hour, if the calendar has no zone."""
    time = group.time
    if time.dtype != np.int64 or group.zone:
        return time
    steps = np.diff(time)
    falls = np.flatnonzero(np.abs(steps + HOUR_S * 10**9) <= 3 * _interval(time))
    if not 0 < len(falls) <= 2:
        return time
    message = "an hour is repeated, as where summer time ends, and was counted on"
    notes.append(_note("clock", falls + 1, group.place, message))
    added = np.zeros(len(time), np.int64)
    added[falls + 1] = HOUR_S * 10**9
    return time + np.cumsum(added)


def _restarts(time: np.ndarray) -> np.ndarray:
    """Returns the indices of the rows at which a clock starts over."""
    starts, restarts = _falls(time), []
    if not len(starts) or not np.isfinite(time).all():
        return np.empty(0, int)
    ends, first, latest = np.r_[starts[1:], len(time)], time[0], time[starts[0] - 1]
    for start, end in zip(starts, ends, strict=True):
        run = time[start:end]
        # late rows are few, and the row that was due soon follows
        if run[0] <= first or np.searchsorted(run, latest) > LATEST_ROWS:
            restarts.append(int(start))
            first, latest = run[0], run[-1]
        else:
            latest = max(latest, run[-1])
    is_one_clock = len(time) > OTHER_DEVICE_RUN * (len(restarts) + 1)
    return np.array(restarts if is_one_clock else [], int)


def _falls(time: np.ndarray) -> np.ndarray:
    return np.flatnonzero(np.diff(time) < 0) + 1


def _restart_note(group: FileColumns, rows: np.ndarray) -> Note:
    message = f"the clock starts over {len(rows)} times: segments begin there"
    return _note("restart", rows, group.place, message)


def _going_on(times: Sequence[np.ndarray], restarts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Returns the times of each group. Each stretch begins one interval after the end of the previous one.
    All groups are shifted equally."""
    shifted = [time.copy() for time in times]
    interval = np.asarray(max(_interval(time) for time in times)).astype(times[0].dtype)
    views = [np.split(time, rows) for time, rows in zip(shifted, restarts, strict=True)]
    for earlier, later in itertools.pairwise(zip(*views, strict=True)):
        end, start = max(part.max() for part in earlier), min(part.min() for part in later)
        for part in later:
            part += end + interval - start
    return shifted


def _agree(groups: Sequence[FileColumns], restarts: Sequence[np.ndarray]) -> bool:
    """Returns whether the stretches of all groups begin and end within a few intervals of each other."""
    tolerance = AGREE_INTERVALS * max(_interval(group.time) for group in groups)
    ends = np.array(
        [
            [(stretch[0], stretch[-1]) for stretch in np.split(group.time, rows)]
            for group, rows in zip(groups, restarts, strict=True)
        ]
    )
    return bool((np.ptp(ends, axis=0) <= tolerance).all())


def _distribute_stamps(group: FileColumns, restarts: np.ndarray, notes: list[Note]) -> np.ndarray:
    """Returns the times, with rows that share a stamp of whole seconds spread evenly over it.

    This is done only if nearly every second has equally many rows. The rows must not be exact repeats or
    alternate between two courses, as those of two devices do.
    """
    time = group.time
    begins = np.r_[True, np.diff(time) != 0]
    begins[restarts] = True
    starts = np.flatnonzero(begins)
    counts = np.diff(np.r_[starts, len(time)])
    inner = counts[1:-1] if len(counts) > 2 else counts
    rows = int(np.median(inner))
    second = group.second
    regular = np.mean(np.abs(inner - rows) <= 1) >= ALIKE_SHARE
    if rows < 2 or len(counts) < LEAST_STAMPS or not regular or (time % second).any():
        return time
    stamp = np.repeat(np.arange(len(starts)), counts)
    place = np.arange(len(time)) - starts[stamp]
    if _repeats(group)[~begins[1:]].all() or _take_turns(group, place, rows):
        return time
    width = np.diff(time[starts], append=time[starts[-1]] + np.median(np.diff(time[starts])))
    width = np.minimum(np.where(width > 0, width, second), np.median(width))
    # the first second may have begun before the recording did
    place[stamp == 0] += max(0, rows - counts[0])
    shares = np.maximum(counts, np.where(np.arange(len(counts)) == 0, rows, 0))
    message = f"{rows} rows share each time stamp of whole seconds: they were spread evenly over it"
    notes.append(Note("spread", "", len(time), message))
    return time + (place * width[stamp] / shares[stamp]).astype(time.dtype)


def _repeats(group: FileColumns) -> np.ndarray:
    """Returns a mask (n - 1,) of the rows that repeat the previous row."""
    repeats = group.time[1:] == group.time[:-1]
    for column in group.values.values():
        repeats &= (column[1:] == column[:-1]) | (np.isnan(column[1:]) & np.isnan(column[:-1]))
    return repeats


def _take_turns(group: FileColumns, place: np.ndarray, rows: int) -> bool:
    """Returns whether some column goes up at one place of each stamp and down at another."""
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
    """Returns the indices of the rows in the order of time, one for each time. Returns all rows if too many
    would have to be moved or dropped."""
    time = group.time
    order = rows = np.arange(len(time))
    lateness = np.maximum.accumulate(time) - time
    late = np.flatnonzero(lateness > 0)
    is_short = lateness.max() <= 2 * LATEST_ROWS * _interval(time)
    if len(late) and is_short and _few(len(late), len(time)):
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
    clashes = np.flatnonzero(np.diff(sorted_rows.time) == 0) + 1
    if len(clashes) and _few(len(clashes), len(time)):
        message = (
            f"{len(clashes)} rows have the time of the row before and other values: the first of each stays"
        )
        notes.append(_note("repeated", clashes, sorted_rows.place, message))
        order = np.delete(order, clashes)
    return order


# ---- clocks that are refused


def check_clock(path: Path, group: FileColumns) -> None:
    """Raises ValueError with the place if a time is missing, repeated or earlier than the previous one."""
    time = group.time
    missing = np.flatnonzero(~np.isfinite(time))
    if len(missing):
        raise ValueError(
            f"{path}: {group.place(int(missing[0]))} should have a time but has none, the first of "
            f"{len(missing)}; fill it in or remove the row"
        )
    back = np.flatnonzero(time[1:] <= time[:-1])  # a step over half of all int64 would seem to run forward
    if not len(back):
        return
    steps, unit, i, count = np.diff(time), group.second, int(back[0]), len(back)
    start = time[0].item() if time.dtype == np.int64 else 0
    at, earlier = ((time[j].item() - start) / unit for j in (i + 1, i))
    since = " after the first" if start else ""
    problem = (
        f"has the same time as the sample before it, {at:.9g} s{since}"
        if steps[i] == 0
        else f"is at {at:.9g} s{since}, which is before the sample ahead of it at {earlier:.9g} s"
    )
    times = f", the first of {count}" if count > 1 else ""
    raise ValueError(
        f"{path}: {group.place(i + 1)} {problem}{times}, but time should only run forward; "
        f"{_remedy(group, steps / unit, back)}"
    )


def _remedy(group: FileColumns, steps_s: np.ndarray, back: np.ndarray) -> str:
    """Returns the remedy for a clock that stands still or runs backwards, by the way it does so."""
    step = steps_s[back[0]]
    remedies = (
        (step == 0, "name a finer clock, or give each device or tag that writes here a column of its own"),
        (len(back) > 0.9 * len(steps_s), "sort the rows by time, from the oldest on"),
        (
            len(back) >= 3 and len(steps_s) <= OTHER_DEVICE_RUN * (len(back) + 1),
            "two devices with clocks of their own seem to write under one name: "
            "record each under a name of its own",
        ),
        (
            len(back) == 1 and abs(step + 3600) <= 3 * np.median(np.abs(steps_s)),
            "an hour is what the end of summer time takes away: write the times with their zone or in UTC, "
            "or split the recording there",
        ),
        (group.name == "rows", "split the recording where its clock was set back"),
        (True, "sort it with: mcap sort, or split it where its clock was set back"),
    )
    return next(remedy for holds, remedy in remedies if holds)
