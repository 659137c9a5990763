"""The records that pass between a recording and the learners: a mapping's source, raw signals on their own
clocks, a table on one clock, and flags with place and count."""

import difflib
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np


class Source(NamedTuple):
    """`signal` in `unit` is `scale` value + `offset` of the recording's `source`.

    A source is a column, or "/topic:field.sub[2]" in MCAP. There a bare name is the field of that name in the
    only topic that has it.
    """

    signal: str
    source: str
    unit: str
    scale: float = 1.0
    offset: float = 0.0


class Note(NamedTuple):
    """A remark of the reader on `count` messages, chunks, values or lines. `signal` is empty for the whole
    recording."""

    kind: str
    signal: str
    count: int
    message: str


class Raw(NamedTuple):
    """A recording as it was made: {signal: (time_s (n,), values (n,))} with a clock each. A missing value is
    NaN.

    `messages` has the count of each topic's messages, or of the rows. `breaks` are the times at which the
    clock had started over: nothing is held or interpolated from before to behind one.
    """

    path: str
    signals: dict[str, tuple[np.ndarray, np.ndarray]]
    messages: dict[str, int]
    notes: list[Note]
    breaks: tuple[float, ...] = ()


class Flag(NamedTuple):
    """A finding: what (`kind`), where (start_s to end_s), how many samples, and one sentence. `signal` is
    empty for the whole recording."""

    signal: str
    kind: str
    start_s: float
    end_s: float
    count: int
    message: str


class Jitter(NamedTuple):
    """Intervals of one clock without those across gaps: their median, and the deviation from it (standard and
    largest)."""

    interval_s: float
    std_s: float
    max_s: float


class Table(NamedTuple):
    """A recording on one sample time: T samples in segments without a gap.

    `values` are as measured, never altered. `masked` marks those that are not to be used. `jitter` is that of
    each signal's own clock before resampling.
    """

    recording: str
    segment: np.ndarray
    time_s: np.ndarray
    values: dict[str, np.ndarray]
    masked: dict[str, np.ndarray]
    flags: list[Flag]
    jitter: dict[str, Jitter]


def measured(table: Table, name: str) -> np.ndarray:
    """The values (T,) of a signal, NaN where it is masked; no copy where nothing is."""
    masked = table.masked[name]
    return np.where(masked, np.nan, table.values[name]) if masked.any() else table.values[name]


# comparing names takes 10 us each
MOST_COMPARED = 50_000


def nearest_names(name: str, names: Iterable[str]) -> str:
    """ "the nearest names are a, b": names like `name`, or the first ten that there are."""
    names = sorted(set(names))
    if not names:
        return "it has none that can be read as a number"
    if len(names) > MOST_COMPARED:
        return f"it has {', '.join(names[:10])} and {len(names) - 10} more"
    # "/topic:field" is found by its field alone too
    aliases = [
        (part, full)
        for full in names
        for part in sorted({full.casefold(), full.casefold().rpartition(":")[2]})
    ]
    close = difflib.get_close_matches(name.casefold(), sorted({part for part, _ in aliases}), n=3, cutoff=0.5)
    close += [name.casefold().rpartition(":")[2]]
    close = list(dict.fromkeys(full for wanted in close for part, full in aliases if part == wanted))
    if close:
        return f"the nearest names are {', '.join(close[:5])}"
    return f"it has {', '.join(names[:10])}{' and more' if len(names) > 10 else ''}"


def intervals(time_s: np.ndarray, gap_limit_s: float = np.inf) -> Jitter:
    """Jitter of a clock time_s (n,), n >= 2, from the intervals up to `gap_limit_s`."""
    steps = np.diff(time_s)
    inside, median = steps <= gap_limit_s, np.median(steps)
    if inside.all() or not inside.any():
        deviation = steps - median
    else:
        deviation = steps[inside] - np.median(steps[inside])
    return Jitter(float(median), float(deviation.std()), float(np.abs(deviation).max()))
