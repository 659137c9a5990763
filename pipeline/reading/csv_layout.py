"""How a text file of numbers is laid out: encoding, delimiter, decimal mark, where its names and units stand and where its data begin."""

import collections
import csv
import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from pipeline.reading.formats import is_time_name
from pipeline.reading.signals import Note

COMMENT = ("#", "%", "//")
LOOKED_AT = 1 << 16
_NUMBER = {decimal: re.compile(rf"\s*[+-]?(\d+({mark}\d*)?|{mark}\d+)([eE][+-]?\d+)?\s*$") for decimal, mark in ((".", r"\."), (",", ","))}
# a number with its unit, 21.5 °C: it shows where the table is, and is refused with its line when it is read
_QUANTITY = re.compile(r"\s*[+-]?\d[\d.,]*\s*(%|°\s?[CFK]|[a-zA-Z]{1,3}(/[a-zA-Z]{1,3})?)$")
# text has tabs, line ends and form feeds, and at times the end mark of an old system; other control characters are of binary files
_CONTROL = bytes(set(range(32)) - set(b"\t\n\r\f\x1a"))


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
        start = stream.read(LOOKED_AT).rstrip(b"\0")
    encoding, notes = _encoding(path, start)
    lines = start.decode(encoding, errors="replace").splitlines()[: 400 if len(start) < LOOKED_AT else -1]
    comment = [line.lstrip().startswith(COMMENT) for line in lines]
    delimiter, decimal = _delimiter([line for line, remark in zip(lines, comment, strict=True) if line.strip() and not remark])
    rows = [_split(line.lstrip("#% ") if remark else line, delimiter) for line, remark in zip(lines, comment, strict=True)]
    numbers = [0 if remark else sum(_is_quantity(field, decimal) for field in row) for row, remark in zip(rows, comment, strict=True)]
    first, width = _first_row(path, rows, numbers, comment, delimiter)
    heads = [i for i in range(first) if len(rows[i]) >= width and any(rows[i]) and (not numbers[i] or _names_time(rows[i]))]
    if not heads:
        notes.append(Note("header", "", 1, f"line {first + 1} is data already: the {width} columns were named column_1 to column_{width}"))
        return CsvLayout(encoding, delimiter, decimal, [f"column_{i + 1}" for i in range(width)], [""] * width, first, notes)
    names, units = [field.strip() for field in rows[heads[-1]]], [""] * width
    if len(heads) > 1 and heads[-2] == heads[-1] - 1 and heads[-1] == first - 1:
        names, units = [field.strip() for field in rows[heads[-2]]], [field.strip(" ()[]") for field in rows[heads[-1]]]
    return CsvLayout(encoding, delimiter, decimal, names, units + [""] * (len(names) - len(units)), first, notes)


def is_number(field: str, decimal: str) -> bool:
    """Whether a field is a number with that decimal mark, "." or ","."""
    return bool(_NUMBER[decimal].match(field))


def _is_quantity(field: str, decimal: str) -> bool:
    return is_number(field, decimal) or bool(_QUANTITY.match(field))


def _encoding(path: Path, start: bytes) -> tuple[str, list[Note]]:
    for mark, encoding in ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16")):
        if start.startswith(mark):
            return encoding, []
    if start[1::2].count(0) > len(start) // 4 and not start[0::2].count(0):
        return "utf-16-le", [Note("encoding", "", 1, "the text is UTF-16 without a byte order mark")]
    control = len(start) - len(start.translate(None, _CONTROL))
    if control > len(start) // 100:
        raise ValueError(
            f"{path}: the bytes at offset 0 ({start[:8].hex(' ')}) are neither text nor Parquet nor MCAP; convert the"
            f" recording to one of them"
        )
    try:
        # a letter of several bytes may be cut at the end of the part that was read
        start.decode("utf-8") if len(start) < LOOKED_AT else start[: start.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError as error:
        return "cp1252", [Note("encoding", "", 1, f"byte {error.start} is not UTF-8, so the text was read as Windows-1252")]
    return "utf-8", []


def _delimiter(lines: Sequence[str]) -> tuple[str, str]:
    """The delimiter and decimal mark with which most fields are numbers, and then fewest are not; the blank is tried last."""
    best, choice = (0.0, 0.0), (",", ".")
    for delimiter, decimal in itertools.product((",", ";", "\t", "|", " "), (".", ",")):
        fields = [field for line in lines[:50] for field in _split(line, delimiter)]
        found = sum(_is_quantity(field, decimal) for field in fields)
        score = (found, found / max(len(fields), 1))
        if score > best:
            best, choice = score, (delimiter, decimal)
    return choice


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    row = next(csv.reader([line], delimiter=delimiter), [])
    return row[:-1] if len(row) > 1 and not row[-1].strip() and line.rstrip("\r\n ").endswith(delimiter) else row


def _names_time(row: Sequence[str]) -> bool:
    return len(row) > 1 and any(is_time_name(field) for field in row)


def _first_row(path: Path, rows: Sequence[list[str]], numbers: Sequence[int], comment: Sequence[bool], delimiter: str) -> tuple[int, int]:
    """(index, width) of the first row of the table: behind the first line that names a time, where there is one, of the width that most
    rows with numbers have."""
    header = next((i for i, row in enumerate(rows) if _names_time(row) and any(numbers[i + 1 :])), -1)
    data = [i for i in range(header + 1, len(rows)) if numbers[i]]
    if not data:
        text = sum(bool(row) and not remark for row, remark in zip(rows, comment, strict=True))
        found = f"{text} lines of text" if text > 1 else "a header" if text else "only blank or comment lines"
        raise ValueError(
            f"{path}: line 2 on should hold rows of numbers, but the file has {found} and no data; record it again or remove it"
        )
    widths = collections.Counter(len(rows[i]) for i in data)
    width = max(widths, key=lambda count: (widths[count], count))
    table = [i for i in data if len(rows[i]) == width]
    written = [i for i in range(table[0], len(rows)) if any(rows[i]) and not comment[i]]
    # a language has words and lines of all lengths, with a number here and there
    words = delimiter == " " and sum(numbers[i] for i in table) < width * len(table) / 2
    if len(table) < len(written) / 2 or words or (len(table) == 1 and header < 0):
        raise ValueError(
            f"{path} is text but no table: {len(table)} of its first {len(written)} lines have {width} fields with numbers among them;"
            " name a recording, or save it as CSV with one row a sample"
        )
    return table[0], width
