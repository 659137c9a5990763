"""The layout of a text file of numbers: encoding, delimiter, decimal mark, names, units, first line of
data."""

import collections
import re
from collections.abc import Sequence
from pathlib import Path

from pipeline.recordings.csv_rows import MISSING, CsvLayout, decimal_mark, is_quantity, opening
from pipeline.recordings.formats import is_time_name
from pipeline.recordings.signals import Note


def csv_layout(path: Path, decimal: str = "") -> CsvLayout:
    """Encoding, delimiter, decimal mark (`decimal` where it is declared) and header of a text file.

    Raises ValueError for a file without rows of numbers.
    """
    layout, rows = _layout(path, decimal)
    marks = collections.Counter(mark for row in rows for field in row if (mark := decimal_mark(field)))
    # what writes commas between fields writes points before decimals
    decided = bool(decimal) or layout.decimal in marks or (layout.delimiter, layout.decimal) == (",", ".")
    return layout._replace(decided=decided, declared=bool(decimal))


def _layout(path: Path, declared: str) -> tuple[CsvLayout, list[list[str]]]:
    """The layout, and the rows of data that the file begins with."""
    encoding, delimiter, decimal, rows, comment, notes = opening(path, declared)
    numbers = [
        0 if remark else sum(is_quantity(field, decimal) for field in row)
        for row, remark in zip(rows, comment, strict=True)
    ]
    first, width = _first_row(path, rows, numbers, comment, delimiter)
    data = [row for row, remark in zip(rows[first:], comment[first:], strict=True) if not remark]
    heads = [
        i
        for i in range(first)
        if len(rows[i]) >= width and any(rows[i]) and (not numbers[i] or _names_time(rows[i]))
    ]
    if not heads:
        notes.append(
            Note(
                "header",
                "",
                1,
                f"line {first + 1} is data already: the {width} columns were named "
                f"column_1 to column_{width}",
            )
        )
        names = [f"column_{i + 1}" for i in range(width)]
        return CsvLayout(encoding, delimiter, decimal, names, [""] * width, first, notes), data
    names, units = [field.strip() for field in rows[heads[-1]]], [""] * width
    written = [sum(bool(field.strip()) for field in rows[i]) for i in heads]
    if (
        len(heads) > 1
        and heads[-2] == heads[-1] - 1
        and not any(any(row) for row in rows[heads[-1] + 1 : first])
        and written[-2] >= written[-1]
    ):
        names, units = (
            [field.strip() for field in rows[heads[-2]]],
            [field.strip(" ()[]") for field in rows[heads[-1]]],
        )
    if len(names) == width + 1 and names[-1].casefold() == "comment":
        names.pop()  # of LabVIEW, which writes it only where there is one
    units += [""] * (len(names) - len(units))
    return CsvLayout(encoding, delimiter, decimal, names, units, first, notes), data


def _names_time(row: Sequence[str]) -> bool:
    return len(row) > 1 and any(is_time_name(field) for field in row)


def _is_heading(row: Sequence[str], table: Sequence[Sequence[str]]) -> bool:
    """Whether a row with numbers begins with a word where the rows of the table begin with numbers, as the
    lines before LabVIEW's do."""
    first = row[0].strip().casefold()
    if first in MISSING or _begins_a_number(first):
        return False
    return sum(_begins_a_number(other[0].strip()) for other in table) > 0.8 * len(table)


def _begins_a_number(field: str) -> bool:
    """Whether a field begins as a number or a time does."""
    return bool(re.match(r"[+-]?[.,]?\d", field))


def _first_row(
    path: Path, rows: Sequence[list[str]], numbers: Sequence[int], comment: Sequence[bool], delimiter: str
) -> tuple[int, int]:
    """(index, width) of the first row of the table. It stands behind the first line that names a time, if
    there is one, and has the width of most rows with numbers."""
    header = next((i for i, row in enumerate(rows) if _names_time(row) and any(numbers[i + 1 :])), -1)
    data = [i for i in range(header + 1, len(rows)) if numbers[i]]
    if not data:
        text = sum(bool(row) and not remark for row, remark in zip(rows, comment, strict=True))
        content = (
            f"{text} lines of text" if text > 1 else "a header" if text else "only blank or comment lines"
        )
        raise ValueError(
            f"{path}: line 2 on should hold rows of numbers, but the file has {content} and no data; "
            "record it again or remove it"
        )
    widths = collections.Counter(len(rows[i]) for i in data)
    width = max(widths, key=lambda count: (widths[count], count))
    table = [i for i in data if len(rows[i]) == width]
    written = [i for i in range(table[0], len(rows)) if any(rows[i]) and not comment[i]]
    # a language has words and lines of all lengths, with a number here and there
    words = delimiter == " " and sum(numbers[i] for i in table) < width * len(table) / 2
    if len(table) < len(written) / 2 or words or (len(table) == 1 and header < 0):
        lines = "lines of words or of different widths" if len(written) > 1 else "a single line"
        raise ValueError(
            f"{path} is text but no table: expected rows of numbers of one width but found {lines}; "
            "name a recording, or save it as CSV with one row a sample"
        )
    begin = next((i for i in table if not _is_heading(rows[i], [rows[k] for k in table])), table[0])
    # most rows may end with an empty field, and the first ones not
    while begin - 1 in data and len(rows[begin - 1]) == width + 1:
        begin -= 1
    return begin, len(rows[begin])
