"""CSV and its relatives from other people's programs: rows of numbers out of text, and every refusal names the line."""

import csv
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pipeline.reading.csv_layout import COMMENT, CsvLayout, csv_layout, is_number
from pipeline.reading.formats import Column, Columns, Growing, column_place, date_column, every, forward, seconds, time_column
from pipeline.reading.instants import instants, is_compact, month_first, over_midnight
from pipeline.reading.signals import Note

# what programs write where they have no number
MISSING = {"", "nan", "na", "n/a", "#n/a", "null", "<null>", "none", "-", "--", "---", "?", "bad", "bad input", "no data", "nodata", "error",
           "fault", "i/o timeout", "unavailable", "unknown", "-nan(ind)", "1.#qnan", "-1.#ind", "#value!", "#ref!", "#div/0!"}  # fmt: skip
SWITCH = {"on": 1.0, "true": 1.0, "off": 0.0, "false": 0.0}
FIELDS_AT_ONCE = 20_000
# totals and remarks behind the data; more than that is no tail
LONGEST_TAIL = 20


def csv_columns(path: Path) -> list[Column]:
    """The columns of a text file; "number" is what the first rows show."""
    layout = csv_layout(path)
    shown = list(itertools.islice(_rows(path, layout), 200))
    columns = []
    for i, (name, unit) in enumerate(zip(layout.names, layout.units, strict=True)):
        fields = [row[i].strip() for _, row in shown if i < len(row) and row[i].strip().casefold() not in MISSING]
        words = [field for field in fields if not (is_number(field, layout.decimal) or field.casefold() in {"inf", "-inf", *SWITCH})]
        # totals may stand behind a short table
        numeric = fields and len(words) <= min(LONGEST_TAIL, len(fields) // 10)
        columns.append(Column(name, "number" if numeric else f"text such as {words[0][:20]!r}" if words else "empty", unit))
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
    rows = _sound_rows(path, layout, clocks, notes)
    while block := list(itertools.islice(rows, max(1, FIELDS_AT_ONCE // len(layout.names)))):
        numbers = [line for line, _ in block]
        fields = [[row[place] for _, row in block] for place in places]
        lines.append(np.array(numbers))
        columns.append(*(_floats(path, name, found, layout.decimal, numbers, switches) for name, found in zip(wanted, fields, strict=True)))
        if clocks:
            clocks.append([row for _, row in block], numbers)
    line = lines.finished()[0]
    for name, words in switches.items():
        notes.append(Note("words", "", 1, f"{name} is written as {' and '.join(sorted(words))}, which were read as 1 and 0"))
    times, zone = clocks.finished(notes) if clocks else (np.arange(len(line)) * interval, "")
    values = dict(zip(wanted, columns.finished(), strict=True))
    found, turned = forward(Columns("rows", times, values, lambda i: f"line {line[i]}", zone))
    return found, notes + turned


# ---- rows


def _rows(path: Path, layout: CsvLayout) -> Iterator[tuple[int, list[str]]]:
    """(line, fields) of the rows of data; blank lines and comments are passed over."""
    with path.open(encoding=layout.encoding, newline="") as stream:
        try:
            if layout.delimiter == " ":
                numbered = ((i, line.split()) for i, line in enumerate(stream, 1))
            else:
                reader = csv.reader(stream, delimiter=layout.delimiter)
                numbered = ((reader.line_num, row) for row in reader)
            for line, row in numbered:
                start = row[0].lstrip() if row else ""
                if line > layout.skip and not start.startswith(COMMENT) and (start or any(field.strip() for field in row)):
                    yield line, row
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: byte 0x{error.object[error.start]:02x} is not {layout.encoding}; save the file as UTF-8") from None
        except csv.Error as error:
            raise ValueError(f"{path}: a line cannot be split into columns ({error}); save the file again as plain CSV") from None


def _sound_rows(path: Path, layout: CsvLayout, clock: "_Clock | None", notes: list[Note]) -> Iterator[tuple[int, list[str]]]:
    """The rows with one field a column and a time.

    A header that is repeated is passed over and counted; what stands behind the data (a row that breaks off as loggers leave it that lose
    their power, totals, remarks) is left out and noted; the same amid the data is refused.
    """
    width, tail, repeated = len(layout.names), [], []
    for line, row in _rows(path, layout):
        whole = len(row) == width or (len(row) > width and not any(field.strip() for field in row[width:]))
        if whole and (clock is None or clock.is_time(row)):
            if tail:
                raise ValueError(f"{path}: {_unsound(*tail[0], layout, clock)}; mend or remove that line")
            yield line, row
        elif [field.strip() for field in row[:width]] in (layout.names, layout.units):
            repeated.append(line)
        elif breaks := sum(field.rstrip("\n").count("\n") for field in row):
            raise ValueError(f"{path}: line {line - breaks}: a quotation mark is opened there and never closed; remove or close it")
        else:
            tail.append((line, row))
            if len(tail) > LONGEST_TAIL:
                raise ValueError(f"{path}: {_unsound(*tail[0], layout, clock)}; mend or remove that line")
    if repeated:
        notes.append(Note("header", "", len(repeated), f"the header is repeated {len(repeated)} times, first in line {repeated[0]}"))
    if len(tail) == 1 and len(tail[0][1]) < width:
        message = f"line {tail[0][0]}, the last, breaks off after {len(tail[0][1])} of {width} fields and was left out"
        notes.append(Note("truncated", "", 1, message))
    elif tail:
        shown = layout.delimiter.join(tail[0][1])[:60]
        message = f"{len(tail)} lines behind the data were left out, from line {tail[0][0]} on, which is {shown!r}"
        notes.append(Note("trailing", "", len(tail), message))


def _unsound(line: int, row: list[str], layout: CsvLayout, clock: "_Clock | None") -> str:
    if clock is None or len(row) != len(layout.names):
        return f"line {line} has {len(row)} fields but the header has {len(layout.names)} columns"
    found = clock.text(row).strip()
    return f"line {line} should have a time in {clock.name} but has {repr(found[:40]) if found else 'none'}"


# ---- the clock


class _Clock:
    """The column of the time, a part of the file at a time: numbers, or text that names instants, with the date in another column or
    without."""

    def __init__(self, path: Path, layout: CsvLayout, name: str):
        self.path, self.layout, self.name, self.place = path, layout, name, column_place(path, layout.names, name)
        first = next((row for _, row in _rows(path, layout) if len(row) > self.place and row[self.place].strip()), None)
        sample = first[self.place].strip() if first else "0"
        self.numeric = is_number(sample, layout.decimal) and not is_compact(sample)
        date = None if self.numeric else date_column(layout.names, name)
        # a date beside the time of day; some programs write both into one column and the date again beside it
        self.date = column_place(path, layout.names, date) if date and re.match(r"\d+:", sample) else None
        dates, sample = set(), self.text(first) if first else ""
        if not self.numeric and re.match(r"\s*\d{1,2}[/-]\d{1,2}[/-]\d", sample):
            dates = {self.text(row).split()[0] for _, row in _rows(path, layout) if len(row) > self.place and self.text(row).strip()}
        self.month_first = month_first(dates, sample)
        self.times, self.zoned, self.dated = Growing([float if self.numeric else np.int64]), True, True

    def text(self, row: list[str]) -> str:
        return row[self.place] if self.date is None else f"{row[self.date]} {row[self.place]}"

    def is_time(self, row: list[str]) -> bool:
        """Whether there is something like a time, not a word or nothing; what it is exactly is looked at later."""
        field = row[self.place].strip()
        return field[:1].isdigit() or (self.numeric and is_number(field, self.layout.decimal)) or (not self.numeric and ":" in field)

    def append(self, rows: list[list[str]], lines: list[int]) -> None:
        fields = [self.text(row) for row in rows]
        if self.numeric:
            self.times.append(_floats(self.path, self.name, fields, self.layout.decimal, lines, {}))
            return
        found = instants(self.path, self.name, fields, lines, month_first=self.month_first)
        self.times.append(found.ns)
        self.zoned, self.dated = self.zoned and found.zoned, found.dated

    def finished(self, notes: list[Note]) -> tuple[np.ndarray, str]:
        """time_s or time_ns (n,) and its zone."""
        times = self.times.finished()[0]
        if self.numeric:
            times, said = seconds(self.name, times)
            if said:
                notes.append(Note("clock", "", 1, said))
            return times, "UTC"
        if not self.dated:
            times, midnights = over_midnight(times)
            if midnights:
                notes.append(
                    Note("clock", "", midnights, f"the time of day runs over midnight {midnights} times: a day was added each time")
                )
        return times, "UTC" if self.zoned else ""


# ---- numbers


def _floats(path: Path, name: str, fields: list[str], decimal: str, lines: list[int], switches: dict[str, set[str]]) -> np.ndarray:
    try:
        if decimal == ".":
            return np.array(list(map(float, fields)))
        if not any("." in field for field in fields):
            return np.array([float(field.replace(",", ".")) for field in fields])
    except ValueError:
        pass  # one by one, which names the line
    return np.array([_float(path, name, field, decimal, line, switches) for field, line in zip(fields, lines, strict=True)])


def _float(path: Path, name: str, field: str, decimal: str, line: int, switches: dict[str, set[str]]) -> float:
    plain = field.strip()
    if is_number(plain, decimal):
        return float(plain.replace(",", "."))
    word = plain.casefold()
    if word in MISSING:
        return np.nan
    if word in SWITCH:
        switches.setdefault(name, set()).add(plain)
        return SWITCH[word]
    if re.fullmatch(r"[+-]?(inf|infinity|nan)", word):
        return float(word)
    remedy = "mend that line, or leave the field empty"
    if re.fullmatch(r"[+-]?[\d.,]+\s*[^\d\s.,]{1,6}", plain):
        remedy = "write the numbers without their unit"
    elif re.fullmatch(r"[+-]?[\d.,\s']+", plain):
        remedy = f"write the numbers without marks between thousands, with {'a point' if decimal == '.' else 'a comma'} before the decimals"
    raise ValueError(f"{path}: line {line}, column {name} should be a number but is {plain[:40]!r}; {remedy}")
