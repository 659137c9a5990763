"""CSV and its relatives from other people's programs: rows of numbers
out of text, and every refusal names the line."""

import itertools
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pipeline.recordings.csv_arrow import iso_zone, read_plain
from pipeline.recordings.csv_layout import csv_layout
from pipeline.recordings.csv_rows import (
    LONGEST_TAIL,
    MISSING,
    SWITCH,
    ColumnStyle,
    CsvLayout,
    broken_line,
    column_style,
    decimal_mark,
    floats,
    is_ambiguous,
    is_number,
    rows,
    sound_rows,
)
from pipeline.recordings.formats import (
    FileColumn,
    FileColumns,
    Growing,
    check_no_counter,
    check_no_day_fractions,
    column_place,
    column_places,
    date_column,
    every,
    forward,
    seconds,
    time_column,
    writes_day_first,
)
from pipeline.recordings.instants import (
    hyphen_fraction,
    instants,
    is_compact,
    is_date,
    month_first,
    over_midnight,
    steady_order,
)
from pipeline.recordings.long_tables import (
    check_one_signal,
    joined,
    long_columns,
    naming_columns,
    read_long,
    read_scope,
    scope_samples,
)
from pipeline.recordings.signals import Note

FIELDS_AT_ONCE = 20_000
# the clock of a table whose signals have each their own
_OWN_CLOCKS = "own clocks"
# rows that tell what a column holds; fewer of a wide table
MOST_SHOWN, FEWEST_SHOWN = 200, 20


def csv_columns(path: Path) -> list[FileColumn]:
    """The columns of a text file. A column is of type "number" by its first rows."""
    layout = csv_layout(path)
    if names := [*long_columns(path, layout), *(name for name, _ in scope_samples(path, layout))]:
        return [FileColumn(_OWN_CLOCKS, "time", ""), *(FileColumn(name, "number", "") for name in names)]
    most = min(MOST_SHOWN, max(FEWEST_SHOWN, FIELDS_AT_ONCE // len(layout.names)))
    shown = list(itertools.islice(rows(path, layout), most))
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
            FileColumn(
                name, "number" if numeric else f"text such as {words[0][:20]!r}" if words else "empty", unit
            )
        )
    return columns


def read_groups(
    path: Path, wanted: Sequence[str], time: str, decimal: str = ""
) -> tuple[list[FileColumns], list[Note]]:
    """The wanted columns of a text file as groups on one clock each. Raises ValueError as `read_csv` does."""
    layout = csv_layout(path, decimal)
    names, samples_ms = long_columns(path, layout), scope_samples(path, layout)
    if not (names or samples_ms) or set(wanted) <= set(layout.names):
        columns, notes = _read_one_clock(path, layout, wanted, time)
        return [columns], notes
    column_places(path, names or [name for name, _ in samples_ms], wanted)
    if time:
        raise ValueError(
            f"{path}: each signal of this table has a time of its own, so time: {time} is not needed; "
            "remove it"
        )
    layout = _decided(path, layout, layout.names)
    groups, notes = read_long(path, layout, wanted) if names else read_scope(path, layout, samples_ms, wanted)
    return groups, [*layout.notes, *notes]


def read_csv(
    path: Path, wanted: Sequence[str], time: str, decimal: str = ""
) -> tuple[FileColumns, list[Note]]:
    """The wanted columns of a text file on one clock, NaN where a signal has no value. `decimal` is the
    declared decimal mark, "" to find it.

    Raises ValueError with the line for text, a row of another length, a missing column, and numbers that may
    be thousands.
    """
    groups, notes = read_groups(path, wanted, time, decimal)
    return groups[0] if len(groups) == 1 else joined(groups), notes


def _read_one_clock(
    path: Path, layout: CsvLayout, wanted: Sequence[str], time: str
) -> tuple[FileColumns, list[Note]]:
    """The wanted columns, NaN where a field is empty."""
    interval = every(time)
    clock = None if interval else time_column(path, layout.names, time)
    places = column_places(path, layout.names, wanted)
    for name in naming_columns(layout.names, [*wanted, clock or ""]):
        place = column_place(path, layout.names, name)
        owners = ((f"line {line}", row[place]) for line, row in rows(path, layout) if len(row) > place)
        check_one_signal(path, name, ((at, owner) for at, owner in owners if owner.strip() != name))
    layout = _decided(path, layout, [*wanted, *([] if clock is None else [clock])])
    notes = list(layout.notes)
    clocks = None if clock is None else _CsvClock(path, layout, clock)
    units = {name: layout.units[place] for name, place in zip(wanted, places, strict=True)}
    plain = None
    if clocks is None:
        plain = read_plain(path, layout, places, None, None)
    elif clocks.is_plain:
        plain = read_plain(path, layout, places, clocks.place, clocks.zone)
    if plain is not None:
        values, place = dict(zip(wanted, plain.values, strict=True)), _line_of(path, layout)
        count = len(plain.values[0])
        if plain.broken:
            notes.append(broken_line(*plain.broken, len(layout.names)))
        if clocks and plain.time is not None:
            clocks.take(plain.time, plain.zoned)
    else:
        values, lines, cell_units = _rows_one_by_one(path, layout, places, wanted, clocks, notes)
        units |= cell_units
        count, place = len(lines), lambda i: f"line {lines[i]}"
    if not count:
        raise ValueError(
            f"{path}: no row behind line {layout.skip} has a time and the {len(layout.names)} fields of the "
            "header; mend the rows, or record it again"
        )
    times, zone = clocks.finished(notes) if clocks else (np.arange(count) * interval, "")
    if clocks and clocks.numeric:
        check_no_day_fractions(path, clocks.name, times, layout.units[clocks.place])
        if not time:
            check_no_counter(path, clocks.name, times)
    columns_forward, turned = forward(FileColumns("rows", times, values, place, zone, units))
    return columns_forward, notes + turned


def _rows_one_by_one(
    path: Path,
    layout: CsvLayout,
    places: Sequence[int],
    wanted: Sequence[str],
    clocks: "_CsvClock | None",
    notes: list[Note],
) -> tuple[dict[str, np.ndarray], np.ndarray, dict[str, str]]:
    """{column: values (n,)}, the line (n,) of each row and {column: unit} of numbers with their unit: the
    slow way, which knows every word and names the line of a fault."""
    columns = Growing([float] * len(wanted))
    lines = Growing([np.int32])
    switches: dict[str, set[str]] = {}
    styles: dict[str, ColumnStyle] = {}

    def style(name: str) -> ColumnStyle:
        if name not in styles:
            styles[name] = column_style(path, layout, layout.names.index(name))
        return styles[name]

    rows = sound_rows(path, layout, clocks, notes)
    while block := list(itertools.islice(rows, max(1, FIELDS_AT_ONCE // len(layout.names)))):
        numbers = [line for line, _ in block]
        fields = [[row[place] for _, row in block] for place in places]
        lines.append(np.array(numbers))
        columns.append(
            *(
                floats(path, name, texts, layout.decimal, numbers, switches, style)
                for name, texts in zip(wanted, fields, strict=True)
            )
        )
        if clocks:
            clocks.append([row for _, row in block], numbers)
    for name, words in switches.items():
        message = f"{name} is written as {' and '.join(sorted(words))}, which were read as 1 and 0"
        notes.append(Note("words", "", 1, message))
    units = {name: styles[name].unit for name in wanted if name in styles and styles[name].unit}
    for name, unit in units.items():
        message = f"{name} is written with its unit {unit}, which was left out"
        notes.append(Note("words", "", 1, message))
    return dict(zip(wanted, columns.finished(), strict=True)), lines.finished()[0], units


def _decided(path: Path, layout: CsvLayout, names: Sequence[str]) -> CsvLayout:
    """The layout with the decimal mark that some field of the file gives away.

    Raises ValueError with both readings where 1,000 or 1.000 is all that there is.
    """
    if layout.decided:
        return layout
    places = dict(zip(column_places(path, layout.names, names), names, strict=True))
    doubtful: tuple[int, str, str] | None = None
    for line, row in rows(path, layout):
        for i, field in enumerate(row):
            if mark := decimal_mark(field):
                return layout._replace(decimal=mark, decided=True)
            if doubtful is None and i in places and is_ambiguous(field):
                doubtful = line, places[i], field.strip()
    if doubtful is None:
        return layout._replace(decided=True)
    line, name, field = doubtful
    mark = "," if "," in field else "."
    one, thousand = field.replace(",", "."), re.sub("[.,]", "", field)
    raise ValueError(
        f"{path}: line {line}, column {name}: {field} may be {one} or {thousand}, as every fraction in the "
        f'file has three digits; declare ingest.decimal: "{mark}" for {one}, '
        f'or "{"." if mark == "," else ","}" for {thousand}'
    )


def _line_of(path: Path, layout: CsvLayout) -> Callable[[int], str]:
    """The place of a row in a file that was read without counting its lines: it is looked up where somebody
    asks."""

    def place(i: int) -> str:
        return f"line {next(itertools.islice(sound_rows(path, layout, None, []), i, None))[0]}"

    return place


# ---- the clock


class _CsvClock:
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
        if first and self.date is not None and not is_date(first[self.date]):
            self.date = None if layout.names[self.date].strip().casefold() == "data" else self.date
        dates, sample = set(), self.text(first) if first else ""
        if not self.numeric and re.match(r"\s*\d{1,2}[/-]\d{1,2}[/-]\d", sample):
            dates = {
                self.text(row).split()[0]
                for _, row in rows(path, layout)
                if len(row) > self.place and self.text(row).strip()
            }
        self.month_first, self.by_steps = month_first(dates, sample), False
        if dates and self.month_first is None:
            stamps = (self.text(row) for _, row in rows(path, layout) if len(row) > self.place)
            self.month_first = steady_order(stamp for stamp in stamps if stamp.strip())
            self.by_steps = self.month_first is not None
        self.by_language = bool(dates) and self.month_first is None and writes_day_first([name, date or ""])
        if self.by_language:
            self.month_first = False
        written = (row[self.place] for _, row in rows(path, layout) if len(row) > self.place)
        self.hyphen_fraction = not self.numeric and hyphen_fraction(
            field for field in written if ":" in field
        )
        self.latest: int | None = None
        # the zone of ISO times; Arrow reads them, and numbers
        self.zone = None if self.numeric or self.date is not None else iso_zone(sample.strip())
        self.is_plain = self.numeric or (self.zone is not None and not self.hyphen_fraction)
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
            after=self.latest,
        )
        self.times.append(dates.ns)
        self.latest = int(dates.ns[-1])
        self.zoned, self.dated = self.zoned and dates.zoned, dates.dated

    def take(self, times: np.ndarray, zoned: bool) -> None:
        """The times that Arrow read."""
        self.times.append(times)
        self.zoned = zoned

    def finished(self, notes: list[Note]) -> tuple[np.ndarray, str]:
        """time_s or time_ns (n,) and its zone."""
        times = self.times.finished()[0]
        if self.numeric:
            times, remark = seconds(self.name, times, self.layout.units[self.place])
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
        if self.by_steps:
            first, other = ("month", "day") if self.month_first else ("day", "month")
            message = (
                f"the dates of {self.name} were read with the {first} first, in which they run on in equal "
                f"steps; with the {other} first they do not"
            )
            notes.append(Note("clock", "", 1, message))
        if self.by_language:
            message = f"the dates of {self.name} were read with the day first, as its language writes them"
            notes.append(Note("clock", "", 1, message))
        return times, "UTC" if self.zoned else ""
