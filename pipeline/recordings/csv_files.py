"""CSV and its relatives from other people's programs: rows of numbers out of text; every refusal names the
line.

Read too: long logs of WinCC in TIA Portal (a row for each value of each variable), and exports of TwinCAT
Scope (a time and a value for each signal). Other tables with a column that says whose value stands beside it
are refused: read as one signal they would be a mixture without a word.
"""

import collections
import csv
import functools
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv

from pipeline.recordings.formats import (
    CONTROL,
    FileColumn,
    FileColumns,
    Note,
    clock_seconds,
    column_place,
    column_places,
    date_column,
    every,
    forward,
    is_time_name,
    time_column,
    writes_day_first,
)
from pipeline.recordings.instants import (
    DAY_NS,
    hyphen_fraction,
    instants,
    is_compact,
    is_date,
    month_first,
    over_midnight,
    steady_order,
)

COMMENT = ("#", "%", "//")
OPENING_BYTES, LINES_SHOWN = 1 << 16, 400
FEWEST_LINES, WIDEST_BYTES = 4, 1 << 21
_NUMBER = {
    decimal: re.compile(rf"\s*[+-]?(\d+({mark}\d*)?|{mark}\d+)([eE][+-]?\d+)?\s*$")
    for decimal, mark in ((".", r"\."), (",", ","))
}
# digits in groups of three, 1,234.5 and 1 234,5 and 1'234.5, by the mark of the decimals
_GROUPED = {
    decimal: re.compile(
        rf"\s*[+-]?\d{{1,3}}(?P<mark>[ '\u2019\xa0\u202f{other}])\d{{3}}((?P=mark)\d{{3}})*({mark}\d*)?\s*$"
    )
    for decimal, mark, other in ((".", r"\.", ","), (",", ",", "."))
}
# 1,000 or 1.000 and the like: one and a fraction, or a thousand; nothing in the field tells
_AMBIGUOUS = re.compile(r"\s*[+-]?[1-9]\d{0,2}[.,]\d{3}\s*$")
_BEGINS_A_NUMBER = re.compile(r"[+-]?[.,]?\d")  # or a time
_UNGROUPED = re.compile(r"\s*[+-]?\d{4,}")
# a number with its unit, 21.5 °C: it shows where the table is, and is refused with its line when it is read
_QUANTITY = re.compile(r"\s*[+-]?\d[\d.,]*\s*(%|°\s?[CFK]|[℃℉]|[a-zA-Z]{1,3}(/[a-zA-Z]{1,3})?)$")
_WITH_UNIT = re.compile(
    r"(?P<number>[+-]?\d[\d.,]*?)\s*(?P<unit>%|°\s?[CFK]|[℃℉]|[a-zA-Z]{1,3}(/[a-zA-Z]{1,3})?)$"
)
# code pages with letters of two bytes: the language, its usual letters, and those that it hardly uses. Usual
# are kana and the first level of kanji (lead bytes 81 to 97), and the syllables of EUC-KR
_PAGES = {
    "cp932": ("Japanese", re.compile(rb"[\x81-\x97][\x40-\xfc]"), re.compile(rb"[\xe0-\xfc]")),
    "cp949": (
        "Korean",
        re.compile(rb"[\xb0-\xc8][\xa1-\xfe]"),
        re.compile(rb"[\x81-\xa0\xc9-\xfe].|.[\x41-\x7a]"),
    ),
}


class Growing:
    """Columns (n,) that grow in place as parts of a file come in. (Joining the parts at the end would need
    twice the memory.)"""

    def __init__(self, kinds: Sequence[type], expected: int = 0):
        self.count = 0
        self._columns = [np.empty(max(expected, 1), kind) for kind in kinds]

    def append(self, *parts: np.ndarray) -> None:
        end = self.count + len(parts[0])
        if end > len(self._columns[0]):
            self._resize(end + end // 4)
        for column, part in zip(self._columns, parts, strict=True):
            column[self.count : end] = part
        self.count = end

    def _resize(self, size: int) -> None:
        for column in self._columns:
            column.resize(size, refcheck=False)

    def finished(self) -> list[np.ndarray]:
        self._resize(self.count)
        return self._columns


class Clock(NamedTuple):
    """The column of the time: numbers, or text that names instants."""

    name: str
    place: int
    decimal: str  # the mark of numbers, "" for text
    date: int | None  # the column of the date beside a time of day
    zone: str | None  # of ISO times, "" for none; None for any other text
    hyphen_fraction: bool  # whether 13:12:54-05 is five hundredths of a second

    def text(self, row: list[str]) -> str:
        return row[self.place] if self.date is None else f"{row[self.date]} {row[self.place]}"

    def is_time(self, row: list[str]) -> bool:
        """Whether the field looks like a time and not like a word. It is read exactly later."""
        field = row[self.place].strip()
        return field[:1].isdigit() or (is_number(field, self.decimal) if self.decimal else ":" in field)


class CsvLayout(NamedTuple):
    """The layout of a text file. Names and units stand in the `skip` lines before the data."""

    encoding: str
    delimiter: str
    decimal: str
    names: list[str]
    units: list[str]
    skip: int
    notes: list[Note]
    # whether a field tells the decimal mark from a mark between thousands, and whether its owner declared it
    decided: bool = True
    declared: bool = False


def opening(path: Path, decimal: str = "") -> tuple[CsvLayout, list[list[str]], list[bool]]:
    """Encoding, delimiter and decimal mark (`decimal`, or the likely one) of a text file; its first lines as
    fields; and which of them are remarks, whose marks are taken off.

    Raises ValueError for a binary file, and for a first line without end.
    """
    with path.open("rb") as stream:
        # zeros behind the text are what a file system leaves after a power failure
        start = stream.read(OPENING_BYTES)
        # the names of a wide table alone are as long as that
        while len(start.splitlines()) <= FEWEST_LINES and len(start) < WIDEST_BYTES:
            if not (following := stream.read(len(start))):
                break
            start += following
        start = start.rstrip(b"\0")
    encoding, notes = _encoding(path, start)
    # as csv counts lines: form feeds and the like end none
    lines = re.split("\r\n|\r|\n", start.decode(encoding, errors="replace"))
    lines = lines[: -1 if not lines[-1] or len(start) >= OPENING_BYTES else None][:LINES_SHOWN]
    if not lines and len(start) >= WIDEST_BYTES:
        raise ValueError(
            f"{path}: its first line has more than {WIDEST_BYTES} bytes, which no header of a table has; "
            "save it with one row a line"
        )
    remark = [line.lstrip().startswith(COMMENT) for line in lines]
    delimiter, decimal = _delimiter(
        [line for line, is_remark in zip(lines, remark, strict=True) if line.strip() and not is_remark],
        (decimal,) if decimal else (".", ","),
    )
    rows = [
        _split(line.lstrip("#% ") if is_remark else line, delimiter)
        for line, is_remark in zip(lines, remark, strict=True)
    ]
    if delimiter == " ":
        rows = _with_wide_names(rows, lines, decimal)
    return CsvLayout(encoding, delimiter, decimal, [], [], 0, notes), rows, remark


def _with_wide_names(rows: list[list[str]], lines: list[str], decimal: str) -> list[list[str]]:
    """The rows of a table with blanks between its columns; a header whose names have blanks inside ("Zone 1
    (C)   Heater 1") is split where two or a tab stand, if that gives as many names as there are columns."""
    widths = [len(row) for row in rows if row and all(is_number(field, decimal) for field in row)]
    width = max(widths, key=widths.count, default=0)
    wide = [re.split(r"\s{2,}|\t", line.lstrip("#% \t").rstrip()) for line in lines]
    return [
        names if len(row) > width > 1 and len(names) == width else row
        for row, names in zip(rows, wide, strict=True)
    ]


def list_layout(path: Path, is_header: Callable[[list[str]], bool]) -> CsvLayout:
    """The layout of a list whose columns are found by name.

    The header is the first line that `is_header`, or else the first line. Raises ValueError if no row
    follows.
    """
    layout, fields, remark = opening(path)
    written = [i for i, row in enumerate(fields) if any(row) and not remark[i]]
    heads = [i for i, row in enumerate(fields) if is_header(row)] or written
    if not heads or not any(i > heads[0] for i in written):
        content = "a header" if heads else "only blank or comment lines"
        raise ValueError(
            f"{path}: line 2 on should hold rows of numbers, but the file has {content} and no data; "
            "record it again or remove it"
        )
    names = [field.strip() for field in fields[heads[0]]]
    return layout._replace(names=names, units=[""] * len(names), skip=heads[0] + 1)


def is_number(field: str, decimal: str) -> bool:
    """Whether a field is a number with that decimal mark, "." or ","."""
    return bool(_NUMBER[decimal].match(field))


def is_quantity(field: str, decimal: str) -> bool:
    return is_number(field, decimal) or bool(_QUANTITY.match(field) or _GROUPED[decimal].match(field))


def decimal_mark(field: str) -> str:
    """The decimal mark that a field gives away, "" for none: 1,5 and 0,500 and 1.234,5 do, 1,500 and 7 do
    not."""
    if _AMBIGUOUS.match(field):
        return ""
    for decimal in (".", ","):
        if decimal in field and (is_number(field, decimal) or _proves_groups(field, decimal)):
            return decimal
    grouped = re.match(r"\s*[+-]?\d{1,3}(?:([.,])\d{3}){2,}\s*$", field)
    return "" if grouped is None else "," if grouped[1] == "." else "."


def _proves_groups(field: str, decimal: str) -> bool:
    """Whether a field can only be read as digits in groups: 1,234.5, 1,234,567 or 1'234, but not 1,234."""
    return bool(_GROUPED[decimal].match(field)) and not _AMBIGUOUS.match(field)


def column_style(path: Path, layout: CsvLayout, place: int) -> tuple[str, str]:
    """(mark between thousands, unit) of a whole column; "" for one that not all of its numbers have, and
    for a mark that nothing proves."""
    marks, units, proven = set(), set(), layout.declared
    for _, row in rows(path, layout):
        field = row[place].strip() if place < len(row) else ""
        if field.casefold() in MISSING:
            continue
        quantity = _WITH_UNIT.match(field)
        units.add(quantity["unit"] if quantity else "")
        if grouped := _GROUPED[layout.decimal].match(field):
            marks.add(grouped["mark"])
            proven = proven or _proves_groups(field, layout.decimal)
        elif is_number(field, layout.decimal) and _UNGROUPED.match(field):
            marks.add("")
    return (marks.pop() if proven and len(marks) == 1 else "", units.pop() if len(units) == 1 else "")


def _encoding(path: Path, start: bytes) -> tuple[str, list[Note]]:
    for mark, encoding in ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16")):
        if start.startswith(mark):
            return encoding, []
    for order, (high, low) in {"le": (start[1::2], start[0::2]), "be": (start[0::2], start[1::2])}.items():
        if high.count(0) > len(start) // 4 and not low.count(0):
            return f"utf-16-{order}", [
                Note("encoding", "", 1, "the text is UTF-16 without a byte order mark")
            ]
    control = len(start) - len(start.translate(None, CONTROL))
    if control > len(start) // 100:
        raise ValueError(
            f"{path}: the bytes at offset 0 ({start[:8].hex(' ')}) are neither text nor Parquet "
            "nor MCAP; convert the recording to one of them"
        )
    # a letter of several bytes may be cut at the end of the part that was read
    text = start if len(start) < OPENING_BYTES else start[: start.rfind(b"\n") + 1]
    try:
        text.decode("utf-8")
    except UnicodeDecodeError as error:
        encoding = next((page for page in _PAGES if _is_of_page(text, page)), "cp1252")
        name = "Windows-1252" if encoding == "cp1252" else f"{_PAGES[encoding][0]} ({encoding})"
        message = f"byte {error.start} is not UTF-8, so the text was read as {name}"
        return encoding, [Note("encoding", "", 1, message)]
    return "utf-8", []


def _is_of_page(text: bytes, page: str) -> bool:
    """Whether text is of a code page with letters of two bytes: all of it can be decoded, two such letters
    stand side by side, and there is no letter that the language hardly uses. (Two letters of Windows-1252
    side by side, as in créée, give one of those or cannot be decoded.)"""
    _, letters, rare = _PAGES[page]
    try:
        decoded = text.decode(page)
    except UnicodeDecodeError:
        return False
    runs = [[letter.encode(page) for letter in run] for run in re.findall(r"[^\x00-\x7f]+", decoded)]
    pairs = [pair for run in runs for pair in itertools.pairwise(run)]
    has_words = any(letters.match(first) and letters.match(second) for first, second in pairs)
    return has_words and not any(rare.match(letter) for run in runs for letter in run)


def _delimiter(lines: Sequence[str], decimals: Sequence[str]) -> tuple[str, str]:
    """The delimiter and decimal mark that make most fields numbers. Of equal ones, those are taken that give
    most lines one width, and then those that leave the fewest other fields; the blank is tried last."""
    best, choice = (0.0, 0.0, 0.0), (",", decimals[0])
    for delimiter, decimal in itertools.product((",", ";", "\t", "|", " "), decimals):
        split = [_split(line, delimiter) for line in lines[:50]]
        width = collections.Counter(map(len, split)).most_common(1)[0][0] if split else 0
        regular = [row for row in split if len(row) == width]
        if delimiter == " ":  # in words before the table there are numbers too
            split = regular
        fields = [field for row in split for field in row]
        quantities = sum(is_quantity(field, decimal) for field in fields)
        # a comma before decimals splits the rows, and not the header
        score = (quantities, len(regular) / max(len(split), 1), quantities / max(len(fields), 1))
        # blanks inside of names and units make no table where another mark gives as many numbers
        if delimiter == " " and quantities <= best[0]:
            continue
        if score > best:
            best, choice = score, (delimiter, decimal)
    return choice


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        row = next(csv.reader([line], delimiter=delimiter), [])
    except (
        csv.Error
    ):  # a field longer than any is: that delimiter stands nowhere, or a quotation mark is open
        return [line]
    ends_with_delimiter = line.rstrip("\r\n ").endswith(delimiter)
    return row[:-1] if len(row) > 1 and not row[-1].strip() and ends_with_delimiter else row


# what programs write where they have no number
MISSING = {"", "nan", "na", "n/a", "#n/a", "null", "<null>", "none", "-", "--", "---", "?", "bad",
           "bad input", "no data", "nodata", "error", "fault", "i/o timeout", "unavailable", "unknown",
           "-nan(ind)", "1.#qnan", "-1.#ind", "#value!", "#ref!", "#div/0!"}  # fmt: skip
SWITCH = {"on": 1.0, "true": 1.0, "off": 0.0, "false": 0.0}
# totals and remarks behind the data; more than that is no tail
LONGEST_TAIL = 20
_BROKEN_OFF = "line {}, the last, breaks off after {} of {} fields and was left out"


def rows(path: Path, layout: CsvLayout) -> Iterator[tuple[int, list[str]]]:
    """(line, fields) of the rows of data, without blank lines and comments."""
    line = 0
    with path.open(encoding=layout.encoding, newline="") as stream:
        try:
            if layout.delimiter == " ":
                numbered = ((i, line.split()) for i, line in enumerate(stream, 1))
            else:
                reader = csv.reader(stream, delimiter=layout.delimiter, strict=True)
                numbered = ((reader.line_num, row) for row in reader)
            line = 0
            for line, row in numbered:
                start = row[0].lstrip() if row else ""
                if (
                    line > layout.skip
                    and not start.startswith(COMMENT)
                    and (start or any(field.strip() for field in row))
                ):
                    yield line, row
        except UnicodeDecodeError as error:
            raise ValueError(
                f"{path}: byte 0x{error.object[error.start]:02x} is not {layout.encoding}; "
                "save the file as UTF-8"
            ) from None
        except csv.Error as error:
            problem = (
                ": a quotation mark is opened there and never closed; remove or close it"
                if "unexpected end" in str(error)
                else f" cannot be split into columns ({error}), as after a quotation mark "
                "that is never closed; mend that line, or save the file again as plain CSV"
            )
            raise ValueError(f"{path}: line {line + 1}{problem}") from None


def sound_rows(
    path: Path, layout: CsvLayout, clock: Clock | None, notes: list[Note]
) -> Iterator[tuple[int, list[str]]]:
    """The rows with one field a column and a time.

    A repeated header is counted and left out. Lines behind the data are left out and noted: a row that breaks
    off (a logger lost its power), totals, remarks. The same lines amid the data are refused.
    """
    width, tail, repeated = len(layout.names), [], []
    for line, row in rows(path, layout):
        complete = len(row) == width or (len(row) > width and not any(field.strip() for field in row[width:]))
        if complete and (clock is None or clock.is_time(row)):
            if tail:
                raise ValueError(f"{path}: {_unsound(*tail[0], layout, clock)}; mend or remove that line")
            yield line, row
        elif [field.strip() for field in row[:width]] in (layout.names, layout.units):
            repeated.append(line)
        elif breaks := sum(field.rstrip("\n").count("\n") for field in row):
            raise ValueError(
                f"{path}: line {line - breaks}: a quotation mark is opened there and never closed; "
                "remove or close it"
            )
        else:
            tail.append((line, row))
            if len(tail) > LONGEST_TAIL:
                raise ValueError(f"{path}: {_unsound(*tail[0], layout, clock)}; mend or remove that line")
    if repeated:
        message = f"the header is repeated {len(repeated)} times, first in line {repeated[0]}"
        notes.append(Note("header", "", len(repeated), message))
    if len(tail) == 1 and len(tail[0][1]) < width:
        notes.append(Note("truncated", "", 1, _BROKEN_OFF.format(tail[0][0], len(tail[0][1]), width)))
    elif len(tail) == 1 and len(tail[0][1]) > width:
        message = f"{_unsound(*tail[0], layout, clock)}; it is the last and was left out"
        notes.append(Note("trailing", "", 1, message))
    elif tail:
        line, row = tail[0]
        message = f"{len(tail)} lines behind the data were left out, from line {line} on, which is "
        notes.append(Note("trailing", "", len(tail), message + repr(layout.delimiter.join(row)[:60])))


def _unsound(line: int, row: list[str], layout: CsvLayout, clock: Clock | None) -> str:
    if clock is None or len(row) != len(layout.names):
        fields = "1 field" if len(row) == 1 else f"{len(row)} fields"
        return f"line {line} has {fields} but the header has {len(layout.names)} columns"
    time = clock.text(row).strip()
    return f"line {line} should have a time in {clock.name} but has {repr(time[:40]) if time else 'none'}"


def floats(
    path: Path,
    name: str,
    fields: list[str],
    decimal: str,
    lines: list[int],
    switches: dict[str, set[str]],
    style: Callable[[str], tuple[str, str]] | None = None,
) -> np.ndarray:
    """The numbers of a column's fields, NaN for a word that says there is none.

    Words of a switch are counted in `switches`. `style` gives that of a column. Raises ValueError with the
    line of a field that is no number.
    """
    try:
        if decimal == "." and not any("_" in field for field in fields):
            return np.array(list(map(float, fields)))
        if decimal == "," and not any("." in field or "_" in field for field in fields):
            return np.array([float(field.replace(",", ".")) for field in fields])
    except ValueError:
        pass  # one by one, which names the line
    return np.array(
        [
            _float(path, name, field, decimal, line, switches, style)
            for field, line in zip(fields, lines, strict=True)
        ]
    )


def _float(
    path: Path,
    name: str,
    field: str,
    decimal: str,
    line: int,
    switches: dict[str, set[str]],
    style: Callable[[str], tuple[str, str]] | None,
) -> float:
    plain = field.strip()
    # 1.5D+02, as Fortran writes
    scientific = re.sub(r"(?<=[\d.,])[dD](?=[+-]?\d+$)", "e", plain)
    if is_number(scientific, decimal):
        return float(scientific.replace(",", "."))
    grouped = _GROUPED[decimal].match(plain)
    if grouped and style is not None and style(name)[0] == grouped["mark"]:
        return float(plain.replace(grouped["mark"], "").replace(",", "."))
    quantity = _WITH_UNIT.match(plain)
    if quantity and style is not None and style(name)[1] and is_number(quantity["number"], decimal):
        return float(quantity["number"].replace(",", "."))
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
        mark = "a point" if decimal == "." else "a comma"
        remedy = f"write the numbers without marks between thousands, with {mark} before the decimals"
        if _AMBIGUOUS.match(plain):
            fraction, thousand = plain.replace(",", "."), re.sub("[.,]", "", plain)
            remedy = f"it may be {fraction} or {thousand}: declare ingest.decimal, or {remedy}"
    raise ValueError(f"{path}: line {line}, column {name} should be a number but is {plain[:40]!r}; {remedy}")


# ---- the layout


def csv_layout(path: Path, decimal: str = "") -> CsvLayout:
    """Encoding, delimiter, decimal mark (`decimal` where it is declared) and header of a text file.

    Raises ValueError for a file without rows of numbers.
    """
    layout, rows, comment = opening(path, decimal)
    numbers = [
        0 if remark else sum(is_quantity(field, layout.decimal) for field in row)
        for row, remark in zip(rows, comment, strict=True)
    ]
    first, width = _first_row(path, rows, numbers, comment, layout.delimiter)
    data = [row for row, remark in zip(rows[first:], comment[first:], strict=True) if not remark]
    marks = {decimal_mark(field) for row in data for field in row}
    # what writes commas between fields writes points before decimals
    decided = bool(decimal) or layout.decimal in marks or (layout.delimiter, layout.decimal) == (",", ".")
    names, units = _header(rows[:first], numbers, width)
    if not names:
        names = [f"column_{i + 1}" for i in range(width)]
        message = (
            f"line {first + 1} is data already: the {width} columns were named {names[0]} to {names[-1]}"
        )
        layout.notes.append(Note("header", "", 1, message))
    units += [""] * (len(names) - len(units))
    return layout._replace(names=names, units=units, skip=first, decided=decided, declared=bool(decimal))


def _header(rows: Sequence[list[str]], numbers: Sequence[int], width: int) -> tuple[list[str], list[str]]:
    """(names, units) in the lines before the data, each [] for none."""
    wide = [i for i, row in enumerate(rows) if len(row) >= width and any(row)]
    heads = [i for i in wide if not numbers[i] or _names_time(rows[i])]
    if not heads:
        return [], []
    names, units = rows[heads[-1]], []
    if heads[-2:] == [heads[-1] - 1, heads[-1]] and not any(map(any, rows[heads[-1] + 1 :])):
        above = rows[heads[-2]]
        if sum(bool(field.strip()) for field in above) >= sum(bool(field.strip()) for field in names):
            names, units = above, [field.strip(" ()[]") for field in names]
    names = [field.strip() for field in names]
    if len(names) == width + 1 and names[-1].casefold() == "comment":
        names.pop()  # of LabVIEW, which writes it only where there is one
    return names, units


def _names_time(row: Sequence[str]) -> bool:
    return len(row) > 1 and any(is_time_name(field) for field in row)


def _is_heading(row: Sequence[str], table: Sequence[Sequence[str]]) -> bool:
    """Whether a row with numbers begins with a word where the rows of the table begin with numbers, as the
    lines before LabVIEW's do."""
    first = row[0].strip().casefold()
    numbers = sum(bool(_BEGINS_A_NUMBER.match(data[0].strip())) for data in table)
    return not (first in MISSING or _BEGINS_A_NUMBER.match(first)) and numbers > 0.8 * len(table)


def _first_row(
    path: Path, rows: Sequence[list[str]], numbers: Sequence[int], comment: Sequence[bool], delimiter: str
) -> tuple[int, int]:
    """(index, width) of the first row of the table. It stands behind the first line that names a time, if
    there is one, and has the width of most rows with numbers; of equally many, that of the names above."""
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
    named = _named_columns(rows[: data[0]], numbers)
    width = max(widths, key=lambda count: (widths[count], count == named, count))
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
    # most rows may end with an empty field and the first ones not, or the first ones alone
    widths_above = {width + 1} | ({width - 1} if header >= 0 and len(rows[header]) == width else set())
    while begin - 1 in data and len(rows[begin - 1]) in widths_above:
        begin -= 1
    if len(data) == 1 and _names_time(rows[begin - 1]) and named < width:
        width = named
    # a row that is wider than its header takes no names from it: it is refused, or left out, with its line
    return begin, width if width == named else max(width, len(rows[begin]))


def _named_columns(above: Sequence[list[str]], numbers: Sequence[int]) -> int:
    """How many columns the last written line above the data names, 0 for none."""
    written = [i for i, row in enumerate(above) if any(row)]
    return len(above[written[-1]]) if written and not numbers[written[-1]] else 0


# ---- rows of plain numbers by Arrow, which reads only what the slow way reads in the same manner

BLOCK_BYTES = 1 << 20
# a first block of short rows may promise what is not there
MOST_EXPECTED = 1 << 22
# Arrow knows zones up to 24 h; ours end at 14, and some programs write a fraction behind a hyphen
_FAR_ZONE = r":\d\d(\.\d+)?[+-](1[5-9]|2\d|14:?(0[1-9]|[1-9]\d))"
_ISO = re.compile(r"\d{4}-\d\d-\d\d(?:[T ]\d\d:\d\d(?::\d\d(?:\.\d{1,9})?)?)?(Z|[+-]\d\d(?::?\d\d)?)?$")
_REMARK = rf"^\s*({'|'.join(map(re.escape, COMMENT))})"
_NULLS = sorted({spelt for word in MISSING for spelt in (word, word.upper(), word.title())} | {"NaN"})


class _NotPlain(Exception):
    """Something that only the slow way reads."""


def read_plain(
    path: Path, layout: CsvLayout, places: Sequence[int], clock: Clock | None, notes: list[Note]
) -> dict[int, np.ndarray] | None:
    """{place: values (n,)} of the columns at `places`, and of the time as numbers, or ns since 1970. A last
    line that breaks off is left out and noted. None for a file that is not plain."""
    if layout.delimiter == " " or (clock is not None and not clock.decimal and clock.zone is None):
        return None
    dates = clock.place if clock is not None and not clock.decimal else None
    if dates in places:
        return None
    read = list(dict.fromkeys([*places, *([] if clock is None else [clock.place])]))
    parts: Growing | None = None
    broken: list[pa.csv.InvalidRow] = []
    try:
        for batch in _batches(path, layout, read, dates, broken):
            first = batch.column("0")
            if 0 not in read and pa.types.is_string(first.type) and _has_match(first, _REMARK):
                return None
            columns = [
                _iso_times(batch.column(f"{place}"), clock.zone or "")
                if clock is not None and place == dates
                else _plain_numbers(batch.column(f"{place}"), clock is not None and place == clock.place)
                for place in read
            ]
            if clock is None and np.isnan(columns).all(axis=0).any():
                return None  # a blank row is no sample
            if parts is None:
                # as many rows as the first block promises, so that growing moves nothing
                expected = int(len(batch) * max(1.0, 1.02 * path.stat().st_size / BLOCK_BYTES)) + 1
                parts = Growing([column.dtype.type for column in columns], min(expected, MOST_EXPECTED))
            parts.append(*columns)
        if parts is None:
            return None
        if broken:
            notes.append(_last_line_note(path, layout, broken[0]))
    except (_NotPlain, pa.ArrowException, UnicodeError):
        return None
    return dict(zip(read, parts.finished(), strict=True))


def _batches(
    path: Path, layout: CsvLayout, read: Sequence[int], dates: int | None, broken: list[pa.csv.InvalidRow]
) -> Iterator[pa.RecordBatch]:
    """Batches with columns called by their places; a row with too few or too many fields goes to `broken`.
    Raises _NotPlain for a second one."""
    width = len(layout.names) + _extra_fields(path, layout)
    # an extra field holds nothing, and the first column may hold remarks
    kinds = {0: pa.string()} | {place: pa.null() for place in range(len(layout.names), width)}
    kinds |= {place: pa.string() if place == dates else pa.float64() for place in read}

    def leave_out(row: pa.csv.InvalidRow) -> str:
        broken.append(row)
        return "skip" if len(broken) == 1 else "error"

    reader = pa.csv.open_csv(
        path,
        read_options=pa.csv.ReadOptions(
            use_threads=False,
            block_size=BLOCK_BYTES,
            skip_rows=layout.skip,
            column_names=[f"{i}" for i in range(width)],
            encoding="utf8" if layout.encoding.startswith("utf-8") else layout.encoding,
        ),
        parse_options=pa.csv.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=leave_out),
        convert_options=pa.csv.ConvertOptions(
            column_types={f"{place}": kind for place, kind in kinds.items()},
            include_columns=[f"{place}" for place in kinds],
            null_values=_NULLS,
            decimal_point=layout.decimal,
        ),
    )
    yield from (batch for batch in reader if len(batch))


def _extra_fields(path: Path, layout: CsvLayout) -> int:
    """How many delimiters without a column end each row, by the first row and the lines of the header, in
    which no quotation may be open. Raises _NotPlain."""
    with path.open(encoding=layout.encoding, newline="") as stream:
        header = "".join(itertools.islice(stream, layout.skip))
    row = next((row for _, row in rows(path, layout)), [])
    extra = row[len(layout.names) :]
    if header.count('"') % 2 or len(row) < len(layout.names) or any(field.strip() for field in extra):
        raise _NotPlain
    return len(extra)


def _last_line_note(path: Path, layout: CsvLayout, row: pa.csv.InvalidRow) -> Note:
    """The note on a last line that breaks off. Raises _NotPlain if `row` is another, or more than cut off."""
    with path.open(encoding=layout.encoding) as stream:
        line, text = collections.deque(enumerate(stream, 1), maxlen=1)[0]
    is_cut = row.actual_columns < len(layout.names) and row.text == text
    if not is_cut or '"' in text or "\0" in text or re.match(_REMARK, text):
        raise _NotPlain
    return Note("truncated", "", 1, _BROKEN_OFF.format(line, row.actual_columns, len(layout.names)))


def _has_match(column: pa.Array, pattern: str) -> bool:
    matches = pc.call_function("match_substring_regex", [column], pc.MatchSubstringOptions(pattern))
    return bool(pc.call_function("any", [matches]).as_py())


def _iso_times(column: pa.Array, zone: str) -> np.ndarray:
    """ns (n,) since 1970. Raises _NotPlain, or ArrowInvalid, for another text than ISO 8601."""
    if column.null_count or (zone and _has_match(column, _FAR_ZONE)):
        raise _NotPlain
    return column.cast(pa.timestamp("ns", zone or None)).cast(pa.int64()).to_numpy(zero_copy_only=False)


def _plain_numbers(column: pa.Array, is_clock: bool) -> np.ndarray:
    """The numbers of a column. Raises _NotPlain for a missing time, and for a word that Arrow takes for NaN
    or infinite."""
    values = column.to_numpy(zero_copy_only=False)
    odd = len(values) - int(np.isfinite(values).sum())
    if odd != column.null_count or (is_clock and odd):
        raise _NotPlain
    return values


# ---- tables with several signals in one column, or several clocks side by side

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
_EPOCH_DAY, _LAST_DAY = 25_569, 100_000
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
    empty = [name for name, own in masks.items() if not own.any()]
    if empty:
        raise ValueError(
            f"{path}: {empty[0]} should have values but no whole row holds one; map another variable"
        )
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
    usable = (days > 0) & (days < _LAST_DAY * 1e6)
    if not usable.all():
        i = int(np.argmin(usable))
        raise ValueError(
            f"{path}: line {lines[i]}, time {_DAYS} should be millionths of a day since 1899-12-30 but is "
            f"{fields[_DAYS][i][:40]!r}; mend or remove that line"
        )
    # to the microsecond, a double's resolution there
    return np.rint((days - 1e6 * _EPOCH_DAY) * (DAY_NS / 1e9)).astype(np.int64) * 1000


# ---- TwinCAT Scope


def scope_samples(path: Path, layout: CsvLayout) -> list[tuple[str, float]]:
    """(signal, SampleTime in ms) of each signal in an export of TwinCAT Scope; none for any other table."""
    if len(set(layout.names[::2])) != 1:  # the last line of its head too has one key, again and again
        return []
    heads: dict[str, list[str]] = {}
    for row in opening(path)[1]:
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


def join_clocks(groups: Sequence[FileColumns]) -> FileColumns:
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


# ---- the reader

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
    count = min(MOST_SHOWN, max(FEWEST_SHOWN, FIELDS_AT_ONCE // len(layout.names)))
    samples = list(itertools.islice(rows(path, layout), count))
    columns = []
    for i, (name, unit) in enumerate(zip(layout.names, layout.units, strict=True)):
        fields = [
            row[i].strip() for _, row in samples if i < len(row) and row[i].strip().casefold() not in MISSING
        ]
        words = [
            field
            for field in fields
            if not (is_number(field, layout.decimal) or field.casefold() in {"inf", "-inf", *SWITCH})
        ]
        # totals may stand behind a short table
        numeric = fields and len(words) <= min(LONGEST_TAIL, len(fields) // 10)
        kind = "number" if numeric else f"text such as {words[0][:20]!r}" if words else "empty"
        columns.append(FileColumn(name, kind, unit))
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
    layout = _decide_decimal(path, layout, dict(enumerate(layout.names)))
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
    return groups[0] if len(groups) == 1 else join_clocks(groups), notes


def _read_one_clock(
    path: Path, layout: CsvLayout, wanted: Sequence[str], time: str
) -> tuple[FileColumns, list[Note]]:
    """The wanted columns, NaN where a field is empty."""
    interval = every(time)
    clock = None if interval else time_column(path, layout.names, time)
    signals = [*wanted, *([] if clock is None else [clock])]
    places = column_places(path, layout.names, signals)
    for name in naming_columns(layout.names, [*wanted, clock or ""]):
        place = column_place(path, layout.names, name)
        owners = ((f"line {line}", row[place]) for line, row in rows(path, layout) if len(row) > place)
        check_one_signal(path, name, ((at, owner) for at, owner in owners if owner.strip() != name))
    layout = _decide_decimal(path, layout, dict(zip(places, signals, strict=True)))
    notes = list(layout.notes)
    column = None if clock is None else _clock(path, layout, clock, places.pop())
    units = {name: layout.units[place] for name, place in zip(wanted, places, strict=True)}
    plain = read_plain(path, layout, places, column, notes)
    if plain is not None:
        values = {name: plain[place] for name, place in zip(wanted, places, strict=True)}
        written, lines = plain[column.place] if column else np.empty(0), np.empty(0, int)
        place = functools.partial(_look_up_line, path, layout)
    else:
        values, lines, written = _rows_one_by_one(path, layout, places, units, column, notes)
        place = _place(lines)
    count = len(next(iter(values.values())))
    if not count:
        first = next(rows(path, layout), None)
        why = f" ({_unsound(*first, layout, column)})" if first else ""
        raise ValueError(
            f"{path}: no row behind line {layout.skip} has a time and the {len(layout.names)} fields of the "
            f"header{why}; mend the rows, or record it again"
        )
    if column is None:
        times, zone = np.arange(count) * (interval or 0.0), ""
    elif isinstance(written, list):
        times, zone = _calendar_times(path, column, written, lines, layout.names, notes)
    elif column.decimal:
        unit = layout.units[column.place]
        times, zone = clock_seconds(path, column.name, written, unit, notes, is_declared=bool(time)), "UTC"
    else:
        times, zone = written, column.zone or ""
    return forward(FileColumns("rows", times, values, place, zone, units), notes), notes


def _rows_one_by_one(
    path: Path,
    layout: CsvLayout,
    places: Sequence[int],
    units: dict[str, str],
    clock: Clock | None,
    notes: list[Note],
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray | list[str]]:
    """{column: values (n,)}, the line (n,) of each row, and its time as numbers (n,) or texts: the slow way,
    which knows every word and names the line of a fault. A unit beside the numbers goes into `units`, which
    has the names of the columns."""
    is_numeric, texts = clock is not None and bool(clock.decimal), []
    columns = Growing([np.int32, *[float] * (len(units) + is_numeric)])
    switches: dict[str, set[str]] = {}
    styles: dict[str, tuple[str, str]] = {}

    def style(name: str) -> tuple[str, str]:
        if name not in styles:
            styles[name] = column_style(path, layout, layout.names.index(name))
        return styles[name]

    sound = sound_rows(path, layout, clock, notes)
    while block := list(itertools.islice(sound, max(1, FIELDS_AT_ONCE // len(layout.names)))):
        lines = [line for line, _ in block]
        parts = [
            floats(path, name, [row[place] for _, row in block], layout.decimal, lines, switches, style)
            for name, place in zip(units, places, strict=True)
        ]
        times = [clock.text(row) for _, row in block] if clock else []
        if clock and is_numeric:
            parts.append(floats(path, clock.name, times, layout.decimal, lines, {}))
        else:
            texts += times
        columns.append(np.array(lines), *parts)
    for name, words in switches.items():
        message = f"{name} is written as {' and '.join(sorted(words))}, which were read as 1 and 0"
        notes.append(Note("words", "", 1, message))
    for name in units:
        if unit := styles.get(name, ("", ""))[1]:
            units[name] = unit
            message = f"{name} is written with its unit {unit}, which was left out"
            notes.append(Note("words", "", 1, message))
    numbers, *values = columns.finished()
    return dict(zip(units, values, strict=False)), numbers, values[-1] if is_numeric else texts


def _decide_decimal(path: Path, layout: CsvLayout, names: Mapping[int, str]) -> CsvLayout:
    """The layout with the decimal mark that some field of the file gives away. `names` are those of the
    columns that are read, by their places.

    Raises ValueError with both readings if 1,000 or 1.000 is all that there is.
    """
    if layout.decided:
        return layout
    doubtful: tuple[int, str, str] | None = None
    for line, row in rows(path, layout):
        for i, field in enumerate(row):
            if mark := decimal_mark(field):
                return layout._replace(decimal=mark, decided=True)
            if doubtful is None and i in names and _AMBIGUOUS.match(field):
                doubtful = line, names[i], field.strip()
    if doubtful is None:
        return layout._replace(decided=True)
    line, name, field = doubtful
    mark = "," if "," in field else "."
    fraction, thousand = field.replace(",", "."), re.sub("[.,]", "", field)
    raise ValueError(
        f"{path}: line {line}, column {name}: {field} may be {fraction} or {thousand}, as every fraction in "
        f'the file has three digits; declare ingest.decimal: "{mark}" for {fraction}, '
        f'or "{"." if mark == "," else ","}" for {thousand}'
    )


def _look_up_line(path: Path, layout: CsvLayout, i: int) -> str:
    """The place of row i of a file that was read without counting its lines."""
    return f"line {next(itertools.islice(sound_rows(path, layout, None, []), i, None))[0]}"


# ---- the clock


def _clock(path: Path, layout: CsvLayout, name: str, place: int) -> Clock:
    first = next((row for _, row in rows(path, layout) if len(row) > place and row[place].strip()), None)
    sample = first[place].strip() if first else "0"
    if is_number(sample, layout.decimal) and not is_compact(sample):
        return Clock(name, place, layout.decimal, None, None, False)
    # a date beside the time of day; some programs write both into one column and the date again beside it
    date_name = date_column(layout.names, name) if re.match(r"\d+:", sample) else None
    date = column_place(path, layout.names, date_name) if date_name else None
    if first and date is not None and layout.names[date].strip().casefold() == "data":
        date = date if is_date(first[date]) else None
    fields = (row[place] for _, row in rows(path, layout) if len(row) > place)
    is_fraction = hyphen_fraction(field for field in fields if ":" in field)
    iso = None if date is not None or is_fraction else _ISO.match(sample)
    zone = None if iso is None else "UTC" if iso[1] else ""
    return Clock(name, place, "", date, zone, is_fraction)


def _calendar_times(
    path: Path, clock: Clock, texts: list[str], lines: np.ndarray, names: Sequence[str], notes: list[Note]
) -> tuple[np.ndarray, str]:
    """time_ns (n,) of texts, and its zone. The order of day and month is that which some date proves, or
    else the one in which the times run on in equal steps, or else that of the language of the names."""
    has_dates = re.match(r"\s*\d{1,2}[/-]\d{1,2}[/-]\d", texts[0])
    dates = {text.split()[0] for text in texts} if has_dates else set()
    order, reason = month_first(dates, texts[0]), ""
    if dates and order is None and (order := steady_order(texts)) is not None:
        first, second = ("month", "day") if order else ("day", "month")
        reason = f"{first} first, in which they run on in equal steps; with the {second} first they do not"
    own_names = [clock.name] if clock.date is None else [clock.name, names[clock.date]]
    if dates and order is None and writes_day_first(own_names):
        order, reason = False, "day first, as its language writes them"
    times, zoned, dated = instants(
        path, clock.name, texts, lines, month_first=order, hyphen_fraction=clock.hyphen_fraction
    )
    if not dated:
        times, midnights = over_midnight(times)
        if midnights:
            message = f"the time of day runs over midnight {midnights} times: a day was added each time"
            notes.append(Note("clock", "", midnights, message))
    if reason:
        notes.append(Note("clock", "", 1, f"the dates of {clock.name} were read with the {reason}"))
    return times, "UTC" if zoned else ""
