"""Reads spreadsheets (.xlsx): the sheet with the most numbers as a table.

The cells are read by python-calamine, which is compiled: a million cells take a second, 20 times less than
with openpyxl. It allocates the whole rectangle up to the last cell, so the size of this rectangle is checked
first.
"""

import datetime
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import python_calamine

from pipeline.recordings.csv_files import MISSING, check_one_signal, naming_columns
from pipeline.recordings.formats import (
    LARGEST_UNPACKED,
    Note,
    WholeTable,
    check_width,
    date_column,
    is_time_name,
)
from pipeline.recordings.instants import DAY_NS, over_midnight

MOST_CELLS = 15_000_000
# of all cells together, in characters
MOST_TEXT = 1 << 28
_CELL = re.compile(rb'<(?:\w+:)?c\s[^>]*?\br\s*=\s*["\']([A-Za-z]{1,3})(\d{1,7})')
# sheets may lie anywhere; the list of formulas names cells too
_SHEET = re.compile(r"(?!xl/calcChain\.xml$).*\.xml$", re.IGNORECASE)
_ROW = re.compile(rb'<(?:\w+:)?row\s[^>]*?\br\s*=\s*["\'](\d{1,7})')
_EPOCH = datetime.datetime(1970, 1, 1)


def load_spreadsheet(path: Path) -> WholeTable:
    """Returns the sheet with the most numbers in a workbook. Its header is the row above the numbers; a row
    of units may be between.

    Dates are times. Raises ValueError with the row if a column of numbers contains text, or if the workbook
    is damaged.
    """
    _check_size(path)
    try:
        workbook = python_calamine.CalamineWorkbook.from_path(str(path))
        names = workbook.sheet_names
        sheets = [(name, workbook.get_sheet_by_name(name).to_python(skip_empty_area=False)) for name in names]
    except (python_calamine.CalamineError, zipfile.BadZipFile, OSError, ValueError) as error:
        raise ValueError(
            f"{path} is a workbook that cannot be read ({str(error).splitlines()[0]}); open it and save it "
            "again as .xlsx, or save the sheet as CSV"
        ) from None
    counts = [sum(_is_number(cell) for row in rows for cell in row) for _, rows in sheets]
    if not any(counts):
        raise ValueError(
            f"{path}: none of its {len(sheets)} sheets holds rows of numbers; save the sheet with the "
            "recording, names in the row above"
        )
    name, rows = sheets[int(np.argmax(counts))]
    notes = []
    if sum(count > 0 for count in counts) > 1:
        notes.append(Note("sheets", "", len(sheets), f"sheet {name!r}, with the most numbers, was read"))
    return _table(path, name, rows, notes)


def _table(path: Path, sheet: str, rows: list[list[Any]], notes: list[Note]) -> WholeTable:
    width = max(map(len, rows))
    check_width(path, width)
    quantities = [sum(_is_number(cell) or _is_time(cell) for cell in row) for row in rows]
    typical = float(np.median([count for count in quantities if count]))
    first = next(i for i, count in enumerate(quantities) if count >= max(1.0, 0.5 * typical))
    heads = [i for i in range(first) if sum(bool(str(cell).strip()) for cell in rows[i]) >= 0.5 * typical]
    units = [""] * width
    if heads:
        two = len(heads) > 1 and heads[-2] == heads[-1] - 1 == first - 2
        names = [str(cell).strip() for cell in rows[heads[-2] if two else heads[-1]]]
        units = [str(cell).strip(" ()[]") for cell in rows[heads[-1]]] if two else units
    else:
        message = f"row {first + 1} is data already: the columns were named column_1, ..."
        notes.append(Note("header", "", 1, message))
        names = [f"column_{j + 1}" for j in range(width)]
    data = [(i + 1, row) for i, row in enumerate(rows) if i >= first and any(cell != "" for cell in row)]
    lines = [line for line, _ in data]
    values, value_units, texts, stamps, of_day = {}, {}, {}, {}, set()
    for j, column in enumerate(names):
        cells = [row[j] if j < len(row) else "" for _, row in data]
        if not column or column in values or column in stamps:
            if any(cell != "" for cell in cells):
                texts[column or "(no name)"] = "numbers under no name of their own"
        elif (numbers := _numbers(path, sheet, column, cells, lines)) is not None:
            values[column], value_units[column] = numbers, units[j]
        elif (ns := _instants(cells)) is not None:
            stamps[column] = ns
            of_day |= {column} if all(isinstance(cell, datetime.time) for cell in cells) else set()
        else:
            texts[column] = f"text such as {next((str(c) for c in cells if c != ''), '')[:20]!r}"
            if naming_columns([column], []):
                check_one_signal(
                    path, column, ((f"row {line}", str(c)) for line, c in zip(lines, cells, strict=True))
                )
    _join_dates(stamps, of_day, texts)
    return WholeTable(
        values, value_units, None, "", lambda i: f"row {lines[i]} of sheet {sheet}", notes, {}, texts, stamps
    )


def _join_dates(stamps: dict[str, np.ndarray], of_day: set[str], texts: dict[str, str]) -> None:
    """Joins the column of the date and the column of the time of day that belongs to it."""
    dates = [name for name, ns in stamps.items() if name not in of_day and not (ns % DAY_NS).any()]
    for name in of_day:
        if is_time_name(name) and (date := date_column(dates, name)) is not None:
            stamps[name] = stamps.pop(date) + stamps[name] % DAY_NS
            texts[date] = f"the date of {name}"
            return


def _is_number(cell: Any) -> bool:
    return isinstance(cell, int | float)


def _is_time(cell: Any) -> bool:
    return isinstance(cell, datetime.datetime | datetime.date | datetime.time | datetime.timedelta)


def _numbers(
    path: Path, sheet: str, name: str, cells: Sequence[Any], lines: Sequence[int]
) -> np.ndarray | None:
    """Returns the numbers of a column, NaN for empty cells; None for a column of words or times. Raises
    ValueError if a column of numbers contains a few words."""
    count = sum(map(_is_number, cells))
    words = [
        i
        for i, cell in enumerate(cells)
        if not _is_number(cell) and str(cell).strip().casefold() not in MISSING
    ]
    if not count or len(words) > max(1, count // 10):
        return None
    if words:
        raise ValueError(
            f"{path}: row {lines[words[0]]} of sheet {sheet}, column {name} should be a number but is "
            f"{str(cells[words[0]])[:40]!r}; format the cells as numbers, or empty that one"
        )
    return np.array([float(cell) if _is_number(cell) else np.nan for cell in cells])


def _instants(cells: Sequence[Any]) -> np.ndarray | None:
    """Returns ns (n,) since 1970, or since midnight for times of day; None if a cell is not a time."""
    if not all(map(_is_time, cells)):
        return None
    ns = np.array([_ns(cell) for cell in cells], np.int64)
    return over_midnight(ns)[0] if isinstance(cells[0], datetime.time) else ns


def _ns(cell: Any) -> int:
    if isinstance(cell, datetime.time):
        cell = datetime.datetime.combine(_EPOCH, cell)
    elif isinstance(cell, datetime.date) and not isinstance(cell, datetime.datetime):
        cell = datetime.datetime.combine(cell, datetime.time())
    since = cell if isinstance(cell, datetime.timedelta) else cell.replace(tzinfo=None) - _EPOCH
    return since // datetime.timedelta(microseconds=1) * 1000


# ---- bounds


def _check_size(path: Path) -> None:
    """Raises ValueError if a workbook unpacks to more than LARGEST_UNPACKED bytes, if its last cells are so
    far out that its sheets would have more than MOST_CELLS, or if it has more text than MOST_TEXT."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            if size > LARGEST_UNPACKED:
                raise ValueError(
                    f"{path}: the workbook unpacks to {size >> 20} MB, more than the "
                    f"{LARGEST_UNPACKED >> 20} MB that are read; save the sheet as CSV or Parquet"
                )
            sheets = [entry for entry in archive.infolist() if _SHEET.match(entry.filename)]
            sizes = [_size(archive, entry) for entry in sheets]
            longest = _longest_text(archive)
    except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise ValueError(
            f"{path} is not a whole workbook ({error}); its index is at its end, so copy the recording again"
        ) from None
    cells = sum(rows * columns for rows, columns, _ in sizes)
    if cells > MOST_CELLS:
        rows, columns, _ = max(sizes, key=lambda size: size[0] * size[1])
        raise ValueError(
            f"{path}: a sheet reaches to row {rows} and column {columns}; {cells} cells are more than the "
            f"{MOST_CELLS} that are read; delete what stands far out, or save it as CSV"
        )
    if sum(texts for _, _, texts in sizes) * longest > MOST_TEXT:
        raise ValueError(
            f"{path}: its cells may hold more than {MOST_TEXT >> 20} MB of text; save the numbers alone"
        )


def _size(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> tuple[int, int, int]:
    """Returns (last row, last column, number of cells with a shared text) of a sheet."""
    rows = columns = texts = 0
    with archive.open(entry) as stream:
        ending = b""
        while piece := stream.read(1 << 20):
            text = ending + piece
            for letters, number in _CELL.findall(text):
                rows, columns = max(rows, int(number)), max(columns, _column(letters))
            rows = max([rows, *map(int, _ROW.findall(text))])
            texts += piece.count(b't="s"')
            ending = text[-200:]
    return rows, columns, texts


def _longest_text(archive: zipfile.ZipFile) -> int:
    """Returns the bytes of the longest text that cells share."""
    longest = length = 0
    if "xl/sharedStrings.xml" not in archive.namelist():
        return 0
    with archive.open(archive.getinfo("xl/sharedStrings.xml")) as stream:
        while piece := stream.read(1 << 20):
            runs = piece.split(b"<")
            longest = max([longest, length + len(runs[0]), *map(len, runs[1:])])
            length = len(runs[-1]) + (length if len(runs) == 1 else 0)
    return longest


def _column(letters: bytes) -> int:
    number = 0
    for letter in letters.upper():
        number = number * 26 + letter - 64
    return number
