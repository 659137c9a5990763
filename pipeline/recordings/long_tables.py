"""Tables that hold several signals in one column or several clocks side by side.

Read: long logs of WinCC in TIA Portal (one row for each value of each variable), and exports of TwinCAT Scope
(a time and a value for each signal). Refused: other tables with a column that says whose value stands beside
it, which read as one signal would be a mixture without a word.
"""

import collections
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.recordings.csv_rows import CsvLayout, floats, is_number, opening, rows, sound_rows
from pipeline.recordings.formats import FileColumns, Growing, column_places
from pipeline.recordings.instants import DAY_NS, instants
from pipeline.recordings.signals import Note

# columns that name the signal of a row: Home Assistant, InfluxDB, WinCC, historians
_NAMING = (
    "entity_id",
    "_field",
    "_measurement",
    "varname",
    "tagname",
    "tag_name",
    "tag",
    "tag_id",
    "metric",
    "metric_name",
    "series",
    "variable",
    "signal",
    "signal_name",
    "sensor_id",
    "point_name",
    "device_id",
    "topic",
)

# what WinCC writes; rows of the panel's own events, such as $RT_OFF$, begin with a dollar
_VARIABLE, _TEXT, _VALUE, _VALID, _DAYS = "VarName", "TimeString", "VarValue", "Validity", "Time_ms"
_EVENT = "$"
# 1970-01-01 in days since 1899-12-30; Time_ms counts millionths of a day
_EPOCH_DAY = 25_569
ROWS_AT_ONCE = 20_000
# the time of an export in seconds, by what its interval is of SampleTime[ms]
_SCOPE_UNITS = {1.0: 1e-3, 1e-3: 1.0, 1e3: 1e-6, 1e4: 1e-7, 1e6: 1e-9}
_SCOPE_NAME, _SCOPE_SAMPLE, _SCOPE_TYPE = "Name", "SampleTime[ms]", "Data-Type"


def long_columns(path: Path, layout: CsvLayout) -> list[str]:
    """The variables of a long log of WinCC, in the order of the file; none for any other table."""
    if not {_VARIABLE, _TEXT, _VALUE} <= set(layout.names):
        return []
    place = layout.names.index(_VARIABLE)
    names = dict.fromkeys(row[place].strip() for _, row in rows(path, layout) if len(row) > place)
    return [name for name in names if name and not name.startswith(_EVENT)]


def read_long(path: Path, layout: CsvLayout, wanted: Sequence[str]) -> tuple[list[FileColumns], list[Note]]:
    """The wanted variables of a long log of WinCC, each on its own clock; NaN for a value that is not valid.

    The time is Time_ms, days since 1899-12-30 in millionths, or the text beside it, which has whole seconds.
    Raises ValueError with the line for text in place of a number or a time.
    """
    at, codes = {name: i for i, name in enumerate(layout.names)}, {name: i for i, name in enumerate(wanted)}
    columns, notes = Growing([np.int64, float, np.int32, np.int32]), []
    events: collections.Counter[str] = collections.Counter()
    invalid: collections.Counter[str] = collections.Counter()

    def wanted_rows() -> Iterator[tuple[int, list[str]]]:
        for line, row in sound_rows(path, layout, None, notes):
            owner = row[at[_VARIABLE]] = row[at[_VARIABLE]].strip()
            if owner.startswith(_EVENT):
                events[owner] += 1
            elif owner in codes:
                yield line, row

    pending = wanted_rows()
    while block := list(itertools.islice(pending, ROWS_AT_ONCE)):
        lines, fields = [line for line, _ in block], list(zip(*(row for _, row in block), strict=False))
        owners, texts = fields[at[_VARIABLE]], list(fields[at[_VALUE]])
        values = floats(path, _VALUE, texts, layout.decimal, lines, {})
        if _VALID in at:
            bad = [field.strip() not in ("1", "") for field in fields[at[_VALID]]]
            invalid.update(itertools.compress(owners, bad))
            values[bad] = np.nan
        times = _log_times(path, layout, {name: fields[i] for name, i in at.items()}, lines)
        columns.append(times, values, np.array(lines), np.array([codes[owner] for owner in owners]))
    times, values, lines, owners = columns.finished()
    for name, count in invalid.items():
        message = f"{count} values of {name} are marked as not valid and are missing"
        notes.append(Note("invalid", "", count, message))
    if events:
        message = f"{events.total()} rows are events of the panel ({', '.join(sorted(events))}), no values"
        notes.append(Note("events", "", events.total(), message))
    masks = {name: owners == code for name, code in codes.items()}
    groups = [
        FileColumns(name, times[own], {name: values[own]}, _place(lines[own]), "")
        for name, own in masks.items()
    ]
    return groups, notes


def _place(lines: Sequence[int] | np.ndarray) -> Callable[[int], str]:
    return lambda i: f"line {lines[i]}"


def _log_times(
    path: Path, layout: CsvLayout, fields: Mapping[str, Sequence[str]], lines: list[int]
) -> np.ndarray:
    """ns (n,) since 1970 on the panel's clock."""
    if _DAYS not in fields:
        return instants(path, _TEXT, fields[_TEXT], lines, month_first=None).ns
    days = floats(path, _DAYS, list(fields[_DAYS]), layout.decimal, lines, {})
    # to the microsecond, a double's resolution there
    return np.rint((days - 1e6 * _EPOCH_DAY) * (DAY_NS / 1e9)).astype(np.int64) * 1000


# ---- TwinCAT Scope


def scope_samples(path: Path, layout: CsvLayout) -> list[tuple[str, float]]:
    """(signal, SampleTime in ms) of each signal in an export of TwinCAT Scope; none for any other table."""
    if len(set(layout.names[::2])) != 1:  # the last line of its head too has one key, again and again
        return []
    heads: dict[str, list[str]] = {}
    for row in opening(path).rows:
        if row and len(row) % 2 == 0 and len(set(row[::2])) == 1:
            heads[row[0].strip()] = [value.strip() for value in row[1::2]]
    names, samples = heads.get(_SCOPE_NAME, []), heads.get(_SCOPE_SAMPLE, [])
    if _SCOPE_TYPE not in heads or len(names) != len(samples):
        return []
    if not all(is_number(sample, layout.decimal) for sample in samples):
        return []
    return list(zip(names, [float(sample.replace(",", ".")) for sample in samples], strict=True))


def read_scope(
    path: Path, layout: CsvLayout, samples_ms: Sequence[tuple[str, float]], wanted: Sequence[str]
) -> tuple[list[FileColumns], list[Note]]:
    """The wanted signals, each with its own times. Raises ValueError for times in no unit that agrees with
    the declared SampleTime."""
    groups = []
    for name, at in zip(wanted, column_places(path, [name for name, _ in samples_ms], wanted), strict=True):
        place = 2 * at
        fields = [(line, row[place : place + 2]) for line, row in rows(path, layout) if len(row) > place + 1]
        fields = [(line, pair) for line, pair in fields if pair[0].strip()]
        lines = [line for line, _ in fields]
        times, values = (
            floats(path, name, [pair[i] for _, pair in fields], layout.decimal, lines, {}) for i in (0, 1)
        )
        times = times * _scope_unit_s(path, name, times, samples_ms[at][1])
        groups.append(FileColumns(name, times, {name: values}, _place(lines), ""))
    return groups, []


def _scope_unit_s(path: Path, name: str, times: np.ndarray, sample_ms: float) -> float:
    interval = float(np.median(np.diff(times))) if len(times) > 1 else np.nan
    for ratio, unit_s in _SCOPE_UNITS.items():
        if abs(interval - ratio * sample_ms) < 0.02 * ratio * sample_ms:
            return unit_s
    raise ValueError(
        f"{path}: the times of {name} have a median interval of {interval:g} but its SampleTime[ms] is "
        f"{sample_ms:g}; export them again with times in milliseconds"
    )


def joined(groups: Sequence[FileColumns]) -> FileColumns:
    """Signals with clocks of their own on all of their times, NaN where one has no value."""
    times = np.unique(np.concatenate([group.time for group in groups]))
    values = {}
    for group in groups:
        column = np.full(len(times), np.nan)
        column[np.searchsorted(times, group.time)] = group.values[group.name]
        values[group.name] = column
    return FileColumns("rows", times, values, lambda i: f"time {i + 1}", groups[0].zone)


def naming_columns(names: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """The columns that may say whose value a row holds; not those that are wanted as signals themselves."""
    lower = [name.strip().casefold() for name in names]
    # InfluxDB counts its series in a column of its own
    naming = (*_NAMING, "table") if "_value" in lower else _NAMING
    return [name for name, plain in zip(names, lower, strict=True) if plain in naming and name not in wanted]


def check_one_signal(path: Path, name: str, owners: Iterable[tuple[str, str]]) -> None:
    """Raises ValueError if column `name`, of (place, owner), names more than one owner."""
    first = ""
    for place, owner in owners:
        owner = owner.strip()
        if first and owner and owner != first:
            raise ValueError(
                f"{path}: {place}, column {name} names {owner[:40]!r} but the rows before {first[:40]!r}: "
                "values of several signals stand in one column; write a column for each (a pivot table), "
                "or a file for each"
            )
        first = first or owner
