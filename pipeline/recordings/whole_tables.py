"""A recording that is small enough to be read whole: logs of printers, spreadsheets, MATLAB files."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.recordings.formats import (
    INDEX_NAMES,
    FileColumn,
    FileColumns,
    check_no_day_fractions,
    column_places,
    every,
    forward,
    is_time_name,
    seconds,
    time_column,
)
from pipeline.recordings.signals import Note

# what is unpacked of one spreadsheet or MATLAB file, in bytes; a print log of a day has 100 MB
LARGEST_UNPACKED = 1 << 29
MOST_COLUMNS = 2000
# numbers of one table: 0.8 GB
MOST_VALUES = 100_000_000


class WholeTable(NamedTuple):
    """Numbers of n rows by name, with the unit that the file gives ("" for none).

    `time` is the file's own clock, time_s (n,) or time_ns (n,) on a calendar, None where a column holds it.
    `limits` are the lowest and highest value that the machine's own settings allow, by column.
    `others` are the columns that are no numbers, with what they hold.
    """

    values: dict[str, np.ndarray]
    units: dict[str, str]
    time: np.ndarray | None
    zone: str
    place: Callable[[int], str]
    notes: list[Note]
    limits: dict[str, tuple[float, float]]
    others: dict[str, str]
    stamps: dict[str, np.ndarray]

    def columns(self) -> list[FileColumn]:
        """The columns as `inspect` lists them."""
        return [
            *(FileColumn(name, "number", self.units.get(name, "")) for name in self.values),
            *(FileColumn(name, "time", "") for name in self.stamps),
            *(FileColumn(name, kind, "") for name, kind in self.others.items()),
        ]


def select(path: Path, table: WholeTable, wanted: Sequence[str], time: str) -> tuple[FileColumns, list[Note]]:
    """The wanted columns on the clock that `time` names: "" for the table's own, a column, or "every 1 s".

    Raises ValueError for a column that is missing or holds no numbers, and for a table without rows.
    """
    names = [column.name for column in table.columns()]
    column_places(path, names, wanted)
    for name in wanted:
        if name not in table.values:
            raise ValueError(
                f"{path}: column {name} should hold numbers but holds {table.others.get(name, 'times')}; "
                "write numbers, or map another column"
            )
    count = len(next(iter(table.values.values()), ()))
    if not count:
        raise ValueError(f"{path}: the table should have rows but has none; record it again or remove it")
    interval, notes = every(time), list(table.notes)
    if interval:
        clock, zone = np.arange(count) * interval, ""
    elif table.time is not None and not time:
        clock, zone = table.time, table.zone
    else:
        clock, zone, remark = _clock(path, table, names, time)
        notes += [Note("clock", "", 1, remark)] if remark else []
    values = {name: table.values[name] for name in wanted}
    columns, turned = forward(FileColumns("rows", clock, values, table.place, zone, table.units))
    return columns, notes + turned


def _clock(path: Path, table: WholeTable, names: Sequence[str], time: str) -> tuple[np.ndarray, str, str]:
    """(time, zone, remark) of the column that `time` names, or of the first with the name of a time."""
    if not time and table.stamps:
        called = [name for name in (*table.stamps, *table.values) if _is_clock_name(name)]
        time = time_column(path, called, "") if called else next(iter(table.stamps))
    name = time_column(path, names, time)
    if name in table.stamps:
        return table.stamps[name], "", ""
    if name not in table.values:
        raise ValueError(
            f"{path}: time {name} should be seconds or a date but holds {table.others[name]}; convert it, "
            "or name another column"
        )
    clock, remark = seconds(name, table.values[name], table.units.get(name, ""))
    check_no_day_fractions(path, name, clock, table.units.get(name, ""))
    return clock, "UTC", remark


def _is_clock_name(name: str) -> bool:
    """Whether a column beside dates is called like a time, and neither like a temperature nor a counter."""
    return is_time_name(name) and name not in ("T", *INDEX_NAMES)


def check_values(path: Path, rows: int, columns: int) -> None:
    """Raises ValueError for a table of more numbers than fit into memory."""
    if rows * columns > MOST_VALUES:
        raise ValueError(
            f"{path}: {rows} rows of {columns} columns are more than the {MOST_VALUES} numbers "
            "that are read; split the recording"
        )


def check_width(path: Path, count: int) -> None:
    """Raises ValueError for a table of more columns than a machine has signals."""
    if count > MOST_COLUMNS:
        raise ValueError(
            f"{path}: {count} columns are more than the {MOST_COLUMNS} that are read; "
            "save the machine's signals alone"
        )
