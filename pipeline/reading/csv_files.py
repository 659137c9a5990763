"""CSV and its relatives from other people's programs: rows of numbers
out of text, and every refusal names the line."""

import itertools
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.reading.csv_layout import csv_layout
from pipeline.reading.formats import (
    Column,
    Columns,
    Growing,
    column_place,
    date_column,
    every,
    forward,
    seconds,
    time_column,
)
from pipeline.reading.instants import hyphen_fraction, instants, is_compact, month_first, over_midnight
from pipeline.reading.signals import Note
from pipeline.store.csv_rows import (
    LONGEST_TAIL,
    MISSING,
    SWITCH,
    CsvLayout,
    floats,
    is_number,
    rows,
    sound_rows,
)

FIELDS_AT_ONCE = 20_000


def csv_columns(path: Path) -> list[Column]:
    """The columns of a text file. A column is of type "number" by its first rows."""
    layout = csv_layout(path)
    shown = list(itertools.islice(rows(path, layout), 200))
    columns = []
    for i, (name, unit) in enumerate(zip(layout.names, layout.units, strict=True)):
        fields = [
            row[i].strip() for _, row in shown if i < len(row) and row[i].strip().casefold() not in MISSING
        ]
        words = [
            field
            for field in fields
            if not (is_number(field, layout.decimal) or field.casefold() in {"inf", "-inf", *SWITCH})
        ]
        # totals may stand behind a short table
        numeric = fields and len(words) <= min(LONGEST_TAIL, len(fields) // 10)
        columns.append(
            Column(
                name, "number" if numeric else f"text such as {words[0][:20]!r}" if words else "empty", unit
            )
        )
    return columns


def read_csv(path: Path, wanted: Sequence[str], time: str) -> tuple[Columns, list[Note]]:
    """The wanted columns, NaN where a field is empty.

    Raises ValueError with the line for text, a row of another length, or a missing column.
    """
    layout = csv_layout(path)
    notes = list(layout.notes)
    interval = every(time)
    clock = "" if interval else time_column(path, layout.names, time)
    places = [column_place(path, layout.names, name) for name in wanted]
    columns = Growing([float] * len(wanted))
    lines, switches, clocks = Growing([np.int32]), {}, _Clock(path, layout, clock) if clock else None
    rows = sound_rows(path, layout, clocks, notes)
    while block := list(itertools.islice(rows, max(1, FIELDS_AT_ONCE // len(layout.names)))):
        numbers = [line for line, _ in block]
        fields = [[row[place] for _, row in block] for place in places]
        lines.append(np.array(numbers))
        columns.append(
            *(
                floats(path, name, texts, layout.decimal, numbers, switches)
                for name, texts in zip(wanted, fields, strict=True)
            )
        )
        if clocks:
            clocks.append([row for _, row in block], numbers)
    line = lines.finished()[0]
    for name, words in switches.items():
        notes.append(
            Note(
                "words",
                "",
                1,
                f"{name} is written as {' and '.join(sorted(words))}, which were read as 1 and 0",
            )
        )
    times, zone = clocks.finished(notes) if clocks else (np.arange(len(line)) * interval, "")
    values = dict(zip(wanted, columns.finished(), strict=True))
    columns_forward, turned = forward(Columns("rows", times, values, lambda i: f"line {line[i]}", zone))
    return columns_forward, notes + turned


# ---- the clock


class _Clock:
    """The column of the time, read a part of the file at a time: numbers, or text that names instants. The
    date may stand in another column."""

    def __init__(self, path: Path, layout: CsvLayout, name: str):
        self.path, self.layout, self.name, self.place = (
            path,
            layout,
            name,
            column_place(path, layout.names, name),
        )
        first = next(
            (row for _, row in rows(path, layout) if len(row) > self.place and row[self.place].strip()), None
        )
        sample = first[self.place].strip() if first else "0"
        self.numeric = is_number(sample, layout.decimal) and not is_compact(sample)
        date = None if self.numeric else date_column(layout.names, name)
        # a date beside the time of day; some programs write both into one column and the date again beside it
        self.date = column_place(path, layout.names, date) if date and re.match(r"\d+:", sample) else None
        dates, sample = set(), self.text(first) if first else ""
        if not self.numeric and re.match(r"\s*\d{1,2}[/-]\d{1,2}[/-]\d", sample):
            dates = {
                self.text(row).split()[0]
                for _, row in rows(path, layout)
                if len(row) > self.place and self.text(row).strip()
            }
        self.month_first = month_first(dates, sample)
        written = (row[self.place] for _, row in rows(path, layout) if len(row) > self.place)
        self.hyphen_fraction = not self.numeric and hyphen_fraction(
            field for field in written if ":" in field
        )
        self.times, self.zoned, self.dated = Growing([float if self.numeric else np.int64]), True, True

    def text(self, row: list[str]) -> str:
        return row[self.place] if self.date is None else f"{row[self.date]} {row[self.place]}"

    def is_time(self, row: list[str]) -> bool:
        """Whether the field looks like a time and not like a word. `append` reads it exactly."""
        field = row[self.place].strip()
        return (
            field[:1].isdigit()
            or (self.numeric and is_number(field, self.layout.decimal))
            or (not self.numeric and ":" in field)
        )

    def append(self, rows: list[list[str]], lines: list[int]) -> None:
        fields = [self.text(row) for row in rows]
        if self.numeric:
            self.times.append(floats(self.path, self.name, fields, self.layout.decimal, lines, {}))
            return
        dates = instants(
            self.path,
            self.name,
            fields,
            lines,
            month_first=self.month_first,
            hyphen_fraction=self.hyphen_fraction,
        )
        self.times.append(dates.ns)
        self.zoned, self.dated = self.zoned and dates.zoned, dates.dated

    def finished(self, notes: list[Note]) -> tuple[np.ndarray, str]:
        """time_s or time_ns (n,) and its zone."""
        times = self.times.finished()[0]
        if self.numeric:
            times, remark = seconds(self.name, times)
            if remark:
                notes.append(Note("clock", "", 1, remark))
            return times, "UTC"
        if not self.dated:
            times, midnights = over_midnight(times)
            if midnights:
                notes.append(
                    Note(
                        "clock",
                        "",
                        midnights,
                        f"the time of day runs over midnight {midnights} times: a day was added each time",
                    )
                )
        return times, "UTC" if self.zoned else ""
