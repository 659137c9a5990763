"""CSV and its relatives from other people's programs: encoding, delimiter, decimal mark and header are found, and every refusal names the
line."""

import csv
import datetime
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.reading.formats import Column, Columns, column_place, every, seconds, time_column
from pipeline.reading.signals import Note

MISSING = {"", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "?"}
ROWS_AT_ONCE = 50_000
_NUMBER = {decimal: re.compile(rf"\s*[+-]?(\d+({decimal}\d*)?|{decimal}\d+)([eE][+-]?\d+)?\s*$") for decimal in (r"\.", ",")}
_COMMENT = ("#", "%", "//")


class CsvLayout(NamedTuple):
    """How a text file is laid out: `skip` lines before the data, in which names and units stand."""

    encoding: str
    delimiter: str
    decimal: str
    names: list[str]
    units: list[str]
    skip: int
    notes: list[Note]


def csv_layout(path: Path) -> CsvLayout:
    """Encoding, delimiter, decimal mark and header of a text file. Raises ValueError where it has no rows of numbers."""
    with path.open("rb") as stream:
        # zeros behind the text are what a file system leaves after a power failure
        start = stream.read(1 << 16).rstrip(b"\0")
    encoding, notes = _encoding(path, start)
    lines = start.decode(encoding, errors="replace").splitlines()[: 400 if len(start) < 1 << 16 else -1]
    delimiter, decimal = _delimiter([line for line in lines if line.strip() and not line.lstrip().startswith(_COMMENT)])
    rows = [_split(line.lstrip("#% ") if line.lstrip().startswith(_COMMENT) else line, delimiter) for line in lines]
    comment = [line.lstrip().startswith(_COMMENT) for line in lines]
    data = [i for i, row in enumerate(rows) if not comment[i] and any(_is_number(field, decimal) for field in row)]
    if not data:
        found = "a header" if any(row and not c for row, c in zip(rows, comment, strict=True)) else "only blank or comment lines"
        raise ValueError(
            f"{path}: line 2 on should hold rows of numbers, but the file has {found} and no data; record it again or remove it"
        )
    first, width = data[0], len(rows[data[0]])
    heads = [i for i in range(first) if len(rows[i]) >= width and any(rows[i]) and not any(_is_number(field, decimal) for field in rows[i])]
    if not heads:
        notes.append(Note("header", "", 1, f"line {first + 1} is data already: the {width} columns were named column_1 to column_{width}"))
        return CsvLayout(encoding, delimiter, decimal, [f"column_{i + 1}" for i in range(width)], [""] * width, first, notes)
    names, units = [field.strip() for field in rows[heads[-1]]], [""] * width
    if len(heads) > 1 and heads[-2] == heads[-1] - 1 and heads[-1] == first - 1:
        names, units = [field.strip() for field in rows[heads[-2]]], [field.strip(" ()[]") for field in rows[heads[-1]]]
    return CsvLayout(encoding, delimiter, decimal, names, units + [""] * (len(names) - len(units)), first, notes)


def _encoding(path: Path, start: bytes) -> tuple[str, list[Note]]:
    for mark, encoding in ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16")):
        if start.startswith(mark):
            return encoding, []
    if start[1::2].count(0) > len(start) // 4 and not start[0::2].count(0):
        return "utf-16-le", [Note("encoding", "", 1, "the text is UTF-16 without a byte order mark")]
    if start.count(0) > len(start) // 100:
        raise ValueError(
            f"{path}: the bytes at offset 0 ({start[:8].hex(' ')}) are neither text nor Parquet nor MCAP; convert the"
            f" recording to one of them"
        )
    try:
        # a letter of several bytes may be cut at the end of the part that was read
        start.decode("utf-8") if len(start) < 1 << 16 else start[: start.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError as error:
        return "cp1252", [Note("encoding", "", 1, f"byte {error.start} is not UTF-8, so the text was read as Windows-1252")]
    return "utf-8", []


def _delimiter(lines: Sequence[str]) -> tuple[str, str]:
    """The delimiter and decimal mark with which most fields of a line are numbers; the blank is tried last."""
    best, choice = 0.0, (",", ".")
    for delimiter, decimal in itertools.product((",", ";", "\t", "|", " "), (".", ",")):
        if (delimiter, decimal) == (",", ","):
            continue
        sample = [_split(line, delimiter) for line in lines[:50]]
        score = sum(_is_number(field, decimal) for row in sample for field in row)
        if score > best:
            best, choice = score, (delimiter, decimal)
    return choice


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    row = next(csv.reader([line], delimiter=delimiter), [])
    return row[:-1] if len(row) > 1 and not row[-1].strip() and line.rstrip("\r\n ").endswith(delimiter) else row


def _is_number(field: str, decimal: str) -> bool:
    return bool(_NUMBER[r"\." if decimal == "." else ","].match(field))


def csv_columns(path: Path) -> list[Column]:
    """The columns of a text file; "number" is what the first rows show."""
    layout = csv_layout(path)
    shown = list(itertools.islice(_rows(path, layout), 200))
    columns = []
    for i, (name, unit) in enumerate(zip(layout.names, layout.units, strict=True)):
        fields = [row[i].strip() for _, row in shown if i < len(row) and row[i].strip().casefold() not in MISSING]
        numeric = bool(fields) and all(_is_number(field, layout.decimal) or field.casefold() in ("inf", "-inf") for field in fields)
        columns.append(Column(name, "number" if numeric else "text" if fields else "empty", unit))
    return columns


def read_csv(path: Path, wanted: Sequence[str], time: str) -> tuple[Columns, list[Note]]:
    """The wanted columns, NaN where a field is empty.

    Raises ValueError with the line for text, a row of another length, or a missing column.
    """
    layout = csv_layout(path)
    notes = list(layout.notes)
    interval = every(time)
    clock = "" if interval else time_column(path, layout.names, time)
    names = list(dict.fromkeys([*wanted, *([clock] if clock else [])]))
    places = [column_place(path, layout.names, name) for name in names]
    parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
    lines: list[np.ndarray] = []
    rows = _whole_rows(path, layout, notes)
    calendar: list[bool] = []
    while block := list(itertools.islice(rows, ROWS_AT_ONCE)):
        block_lines = [line for line, _ in block]
        lines.append(np.array(block_lines))
        for name, place in zip(names, places, strict=True):
            fields = [row[place] for _, row in block]
            if name == clock:
                calendar = calendar or [not _is_number(fields[0], layout.decimal)]
            if name == clock and calendar[0]:
                parts[name].append(_instants(path, name, fields, block_lines))
            else:
                parts[name].append(_floats(path, name, fields, layout.decimal, block_lines))
    line = np.concatenate(lines)
    values = {name: np.concatenate(part) for name, part in parts.items()}
    if interval:
        clock_values, said = np.arange(len(line)) * interval, ""
    else:
        clock_values, said = (values[clock], "") if calendar[0] else seconds(clock, values[clock])
    if said:
        notes.append(Note("clock", "", 1, said))
    return Columns("rows", clock_values, {name: values[name] for name in wanted}, lambda i: f"line {line[i]}"), notes


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
                if line > layout.skip and row and not row[0].lstrip().startswith(_COMMENT) and any(field.strip() for field in row):
                    yield line, row
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: byte 0x{error.object[error.start]:02x} is not {layout.encoding}; save the file as UTF-8") from None
        except csv.Error as error:
            raise ValueError(f"{path}: a line cannot be split into columns ({error}); save the file again as plain CSV") from None


def _whole_rows(path: Path, layout: CsvLayout, notes: list[Note]) -> Iterator[tuple[int, list[str]]]:
    """The rows with one field a column; a last row that breaks off is left out and noted, as loggers that lose their power leave it."""
    width = len(layout.names)
    broken = None
    for line, row in _rows(path, layout):
        if broken:
            raise ValueError(
                f"{path}: line {broken[0]} has {broken[1]} fields but the header has {width} columns; mend or remove that line"
            )
        if len(row) == width or (len(row) > width and not any(field.strip() for field in row[width:])):
            yield line, row
        else:
            broken = (line, len(row))
    if broken:
        message = f"line {broken[0]}, the last, breaks off after {broken[1]} of {width} fields and was left out"
        notes.append(Note("truncated", "", 1, message))


def _floats(path: Path, name: str, fields: list[str], decimal: str, lines: list[int]) -> np.ndarray:
    if decimal == ",":
        fields = [field.replace(",", ".") for field in fields]
    try:
        return np.array(list(map(float, fields)))
    except ValueError:
        return np.array([_float(path, name, field, line) for field, line in zip(fields, lines, strict=True)])


def _float(path: Path, name: str, field: str, line: int) -> float:
    if field.strip().casefold() in MISSING:
        return np.nan
    try:
        return float(field)
    except ValueError:
        raise ValueError(
            f"{path}: line {line}, column {name} should be a number but is {field.strip()[:40]!r}; mend that line, or leave the field empty"
        ) from None


_EPOCH = datetime.datetime(1970, 1, 1)


def _instants(path: Path, name: str, fields: list[str], lines: list[int]) -> np.ndarray:
    """ISO 8601 date and time to ns since 1970; without a zone it is taken as it is."""
    instants = []
    for field, line in zip(fields, lines, strict=True):
        try:
            instant = datetime.datetime.fromisoformat(field.strip())
        except ValueError:
            expected = "seconds or ISO 8601 such as 2025-11-21T13:00:00.5"
            raise ValueError(
                f"{path}: line {line}, time {name} should be {expected} but is {field.strip()[:40]!r}; convert it, or name another column"
            ) from None
        if instant.tzinfo is not None:
            instant = instant.astimezone(datetime.UTC).replace(tzinfo=None)
        instants.append((instant - _EPOCH) // datetime.timedelta(microseconds=1) * 1000)
    return np.array(instants, np.int64)
