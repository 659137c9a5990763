"""Reads recordings of other people's machines as signals on their own clocks: MCAP and bags, Parquet, CSV,
logs of printers, spreadsheets, MATLAB files. Damaged, missing and left-out samples are counted.

`read` is the entry point. `resample` and `flag` make a table of its result; `inspect` describes a file in
words.
"""

import itertools
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.recordings.clocks import repair_topics
from pipeline.recordings.csv_files import read_groups
from pipeline.recordings.formats import (
    CALENDAR_S,
    NAMES,
    SUFFIXES,
    FileColumns,
    Flag,
    Jitter,
    Note,
    Raw,
    Source,
    Table,
    WholeTable,
    file_format,
    nearest_names,
    select,
)
from pipeline.recordings.inspection import inspect
from pipeline.recordings.mcap_files import check_magic, mcap_columns, read_bag
from pipeline.recordings.other_formats import LOADERS
from pipeline.recordings.parquet_files import read_parquet
from pipeline.recordings.printed_gcode import NOT_RECORDED, UNITS
from pipeline.recordings.quality import CELSIUS, flag
from pipeline.recordings.resampling import resample

__all__ = [
    "Flag",
    "Jitter",
    "Note",
    "Raw",
    "Source",
    "Table",
    "flag",
    "inspect",
    "nearest_names",
    "read",
    "resample",
]


FAHRENHEIT = {"degf", "°f", "° f", "℉", "f", "fahrenheit"}
# at the end of a column's name; an F without brackets could also be the sixth zone
_NAMES_FAHRENHEIT = re.compile(r"(?:[\[(]F[\])]|(?:[\[(_ ](?:deg[Ff]|[Ff]ahrenheit)|°\s?F|℉)[\])]?)$")


def read(path: str | Path, sources: Sequence[Source], *, time: str = "", decimal: str = "") -> Raw:
    """Returns the signals of a recording, each on its own clock, in our units.

    `time` names the clock. In a table it is a column (by default one with a name of a time) or, if there is
    none, "every 0.5 s". In MCAP it is log_time (the default), publish_time, or a field of every topic such as
    header.stamp. If the clock is a calendar's, time counts from the first whole second of the record. Missing
    numbers are NaN, and counted in a note. `decimal` is the decimal mark of a text file, "" to find it.

    A clock that does not run forward is repaired if no guess is needed. Repairs are counted in notes: see
    `clocks.repair`.

    Raises ValueError, one sentence with file, place, expected, found and remedy, if a source does not exist,
    a number is text, a signal has no number at all, a time is missing, repeated or runs backwards, or a file
    cannot be read.
    """
    path = Path(path)
    _check_sources(path, sources)
    kind = file_format(path)
    named = SUFFIXES.get(path.suffix.lower(), kind)
    names = list(dict.fromkeys(source.source for source in sources))
    try:
        columns, places, messages, notes = _file_columns(path, kind, names, time, decimal)
    except OSError as error:
        raise ValueError(
            f"{path} cannot be read ({error.strerror or error}); check the disk, or copy the recording again"
        ) from None
    if kind != named:
        message = (
            f"the file is named {path.suffix.lower()} but begins as {NAMES.get(kind, kind)} does, "
            "and was read as that"
        )
        notes = [Note("format", "", 1, message), *notes]
    repaired = repair_topics(path, columns, one_clock=time in ("", "log_time"))
    columns, restarts, remarks = zip(*repaired, strict=True)
    notes += itertools.chain(*remarks)
    clocks = _clocks(columns, notes)
    # if several topics start over, they do so together
    breaks = [
        min(float(clocks[group.name][i]) for group, i in zip(columns, rows, strict=True))
        for rows in zip(*restarts, strict=True)
    ]
    signals = {}
    for source in sources:
        topic, field = places[source.source]
        group = next(group for group in columns if group.name == topic)
        signals[source.signal] = _signal(path, source, clocks[topic], group, group.values[field], notes)
    return Raw(str(path), signals, messages, notes, tuple(breaks))


def _file_columns(
    path: Path, kind: str, names: Sequence[str], time: str, decimal: str
) -> tuple[list[FileColumns], dict[str, tuple[str, str]], dict[str, int], list[Note]]:
    """Returns columns on their clocks, {source: (name of its columns, name in them)}, {name: number of
    messages or rows} and notes of a file of that kind."""
    if kind == "mcap":
        with path.open("rb") as stream:
            check_magic(path, stream.read(16))
        return mcap_columns(path, names, time)
    if kind == "bag":
        return read_bag(path, names, time)
    if kind == "csv":
        columns, notes = read_groups(path, names, time, decimal)
    elif kind in LOADERS:
        whole = LOADERS[kind](path)
        _check_printed(path, whole, names)
        table, notes = select(path, whole, names, time)
        columns = [table]
    else:
        table, notes = read_parquet(path, names, time)
        columns = [table]
    places = {name: (table.name, name) for table in columns for name in table.values}
    return columns, places, {table.name: len(table.time) for table in columns}, notes


def _check_printed(path: Path, table: WholeTable, names: Sequence[str]) -> None:
    """Raises ValueError with the missing file if the fan or the feed is wanted but cannot be computed without
    it."""
    reason = next((note.message for note in table.notes if note.kind == NOT_RECORDED), "")
    if reason and any(name in UNITS and name not in table.values for name in names):
        raise ValueError(f"{path}: {reason}")


def _check_sources(path: Path, sources: Sequence[Source]) -> None:
    if not sources:
        raise ValueError(
            f"{path}: the mapping names no signal; map each input and output to a column or topic (beadline "
            "inspect proposes a mapping)"
        )
    signals = [source.signal for source in sources]
    twice = sorted({signal for signal in signals if signals.count(signal) > 1})
    if twice:
        raise ValueError(f"{path}: the mapping gives {twice[0]} more than one source; give it one")
    for source in sources:
        if not (np.isfinite(source.scale) and np.isfinite(source.offset) and source.scale != 0):
            raise ValueError(
                f"{path}: the mapping of {source.signal} has scale {source.scale:g} and offset "
                f"{source.offset:g}; both must be finite, scale not 0"
            )


def _clocks(columns: Sequence[FileColumns], notes: list[Note]) -> dict[str, np.ndarray]:
    """Returns {topic: time_s (n,)}, all counted from one instant."""
    first = min(group.time[0] for group in columns)
    on_calendar = columns[0].time.dtype == np.int64
    unit = 10**9 if on_calendar else 1.0
    start = first // unit * unit if first > CALENDAR_S * unit else 0
    if start:
        zero = np.datetime64(int(start // unit), "s")
        zones = ", ".join(sorted({group.zone or "of no zone" for group in columns}))
        message = f"time is counted from {zero} ({zones}, as the recording's clock says)"
        notes.append(Note("clock", "", 1, message))
    return {group.name: (group.time - start if start else group.time) / unit for group in columns}


def _signal(
    path: Path, source: Source, time: np.ndarray, group: FileColumns, recorded: np.ndarray, notes: list[Note]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns time and values in the signal's unit. A signal with a value in less than half of the rows,
    spread among them, has its own clock: those rows. Raises ValueError if a column has no number at all, or
    if its unit or name says °F but the mapping uses it as °C."""
    written = group.units.get(source.source, "").strip(" ()[]").casefold()
    is_fahrenheit = written in FAHRENHEIT if written else bool(_NAMES_FAHRENHEIT.search(source.source))
    is_converted = abs(source.scale * 9 / 5 - 1) < 0.01
    if is_fahrenheit and source.unit.casefold() in CELSIUS and not is_converted:
        raise ValueError(
            f"{path}: {source.source} is in °F but the mapping takes it as {source.unit} with scale "
            f"{source.scale:g}; set scale: 0.555556 and offset: -17.7778"
        )
    present = np.isfinite(recorded)
    if not present.any():
        raise ValueError(
            f"{path}: {source.source} should hold numbers for {source.signal} but all of its "
            f"{len(recorded)} values are missing; map another source"
        )
    values = (
        recorded if (source.scale, source.offset) == (1.0, 0.0) else recorded * source.scale + source.offset
    )
    if present.all():
        return time, values
    where = np.flatnonzero(present)
    missing = len(recorded) - len(where)
    if where.size < len(recorded) / 2 and where.size > 1 and np.median(np.diff(where)) > 1:
        message = (
            f"{source.source} has a value in {where.size} of {len(recorded)} rows; those are its samples"
        )
        notes.append(Note("sparse", source.signal, missing, message))
        return time[where], values[where]
    infinite = int(np.isinf(recorded).sum())
    kinds = f" ({infinite} of them infinite)" if infinite else ""
    message = (
        f"{missing} of {len(recorded)} values of {source.source} are missing{kinds}, "
        f"the first in {group.place(int(np.argmin(present)))}; they are masked"
    )
    notes.append(Note("missing", source.signal, missing, message))
    return time, np.where(present, values, np.nan)
