"""Rows of text and numbers from a stranger's CSV file: what the readers of records and of lists of images
share."""

import collections
import csv
import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from pipeline.recordings.formats import CONTROL
from pipeline.recordings.signals import Note

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
# one and a fraction, or a thousand: nothing in the field tells
_AMBIGUOUS = re.compile(r"\s*[+-]?[1-9]\d{0,2}[.,]\d{3}\s*$")
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


class Clock(Protocol):
    """The column of the time, for a reader with a clock."""

    name: str

    def text(self, row: list[str]) -> str: ...

    def is_time(self, row: list[str]) -> bool: ...


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


class Opening(NamedTuple):
    """The first lines of a text file as fields. `remark` says which lines are remarks; their marks are taken
    off."""

    encoding: str
    delimiter: str
    decimal: str
    rows: list[list[str]]
    remark: list[bool]
    notes: list[Note]


def opening(path: Path, decimal: str = "") -> Opening:
    """Encoding, delimiter, decimal mark (`decimal`, or the likely one) and first lines of a text file.

    Raises ValueError for a binary file, and for a first line without end.
    """
    with path.open("rb") as stream:
        # zeros behind the text are what a file system leaves after a power failure
        start = stream.read(OPENING_BYTES)
        # the names of a wide table alone are as long as that
        while len(start.splitlines()) <= FEWEST_LINES and len(start) < WIDEST_BYTES:
            if not (more := stream.read(len(start))):
                break
            start += more
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
    return Opening(encoding, delimiter, decimal, rows, remark, notes)


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
    start = opening(path)
    written = [i for i, row in enumerate(start.rows) if any(row) and not start.remark[i]]
    heads = [i for i, row in enumerate(start.rows) if is_header(row)] or written
    if not heads or not any(i > heads[0] for i in written):
        content = "a header" if heads else "only blank or comment lines"
        raise ValueError(
            f"{path}: line 2 on should hold rows of numbers, but the file has {content} and no data; "
            "record it again or remove it"
        )
    names = [field.strip() for field in start.rows[heads[0]]]
    return CsvLayout(
        start.encoding, start.delimiter, start.decimal, names, [""] * len(names), heads[0] + 1, start.notes
    )


def is_number(field: str, decimal: str) -> bool:
    """Whether a field is a number with that decimal mark, "." or ","."""
    return bool(_NUMBER[decimal].match(field))


def is_quantity(field: str, decimal: str) -> bool:
    return is_number(field, decimal) or bool(_QUANTITY.match(field) or _GROUPED[decimal].match(field))


def is_ambiguous(field: str) -> bool:
    """Whether a field is 1,000 or 1.000 and the like: one with three decimals, or a thousand."""
    return bool(_AMBIGUOUS.match(field))


def decimal_mark(field: str) -> str:
    """The decimal mark that a field gives away, "" for none: 1,5 and 0,500 and 1.234,5 do, 1,500 and 7 do
    not."""
    if is_ambiguous(field):
        return ""
    for decimal in (".", ","):
        if decimal in field and (is_number(field, decimal) or _proves_groups(field, decimal)):
            return decimal
    if (grouped := re.match(r"\s*[+-]?\d{1,3}(?:([.,])\d{3}){2,}\s*$", field)) is not None:
        return "," if grouped[1] == "." else "."
    return ""


def _proves_groups(field: str, decimal: str) -> bool:
    """Whether a field can only be read as digits in groups: 1,234.5, 1,234,567 or 1'234, but not 1,234."""
    return bool(_GROUPED[decimal].match(field)) and not is_ambiguous(field)


class ColumnStyle(NamedTuple):
    """How a whole column writes its numbers: its mark between thousands and its unit, "" for none."""

    groups: str
    unit: str


def column_style(path: Path, layout: CsvLayout, place: int) -> ColumnStyle:
    """The style of a column, without a mark or unit that not all of its numbers have, and without a mark that
    nothing proves."""
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
    return ColumnStyle(
        marks.pop() if proven and len(marks) == 1 else "", units.pop() if len(units) == 1 else ""
    )


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
    whole = start if len(start) < OPENING_BYTES else start[: start.rfind(b"\n") + 1]
    try:
        whole.decode("utf-8")
    except UnicodeDecodeError as error:
        encoding = next((page for page in _PAGES if _is_of_page(whole, page)), "cp1252")
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
        if delimiter == " ":  # in words before the table there are numbers too
            width = collections.Counter(map(len, split)).most_common(1)[0][0] if split else 0
            split = [row for row in split if len(row) == width]
        fields = [field for row in split for field in row]
        quantities = sum(is_quantity(field, decimal) for field in fields)
        # a comma before decimals splits the rows, and not the header
        widths = collections.Counter(map(len, split)).most_common(1)
        alike = widths[0][1] / len(split) if widths else 0.0
        score = (quantities, alike, quantities / max(len(fields), 1))
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
            if "unexpected end" in str(error):
                raise ValueError(
                    f"{path}: line {line + 1}: a quotation mark is opened there and never closed; "
                    "remove or close it"
                ) from None
            raise ValueError(
                f"{path}: line {line + 1} cannot be split into columns ({error}), as after a quotation mark "
                "that is never closed; mend that line, or save the file again as plain CSV"
            ) from None


def sound_rows(
    path: Path, layout: CsvLayout, clock: "Clock | None", notes: list[Note]
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
        notes.append(
            Note(
                "header",
                "",
                len(repeated),
                f"the header is repeated {len(repeated)} times, first in line {repeated[0]}",
            )
        )
    if len(tail) == 1 and len(tail[0][1]) < width:
        notes.append(broken_line(tail[0][0], len(tail[0][1]), width))
    elif tail:
        shown = layout.delimiter.join(tail[0][1])[:60]
        message = (
            f"{len(tail)} lines behind the data were left out, from line {tail[0][0]} on, which is {shown!r}"
        )
        notes.append(Note("trailing", "", len(tail), message))


def broken_line(line: int, fields: int, width: int) -> Note:
    """The note on a last line that has fewer fields than the table."""
    message = f"line {line}, the last, breaks off after {fields} of {width} fields and was left out"
    return Note("truncated", "", 1, message)


def _unsound(line: int, row: list[str], layout: CsvLayout, clock: "Clock | None") -> str:
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
    style: Callable[[str], ColumnStyle] | None = None,
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
    style: Callable[[str], ColumnStyle] | None,
) -> float:
    plain = field.strip()
    # 1.5D+02, as Fortran writes
    scientific = re.sub(r"(?<=[\d.,])[dD](?=[+-]?\d+$)", "e", plain)
    if is_number(scientific, decimal):
        return float(scientific.replace(",", "."))
    grouped = _GROUPED[decimal].match(plain)
    if grouped and style is not None and style(name).groups == grouped["mark"]:
        return float(plain.replace(grouped["mark"], "").replace(",", "."))
    quantity = _WITH_UNIT.match(plain)
    if quantity and style is not None and style(name).unit and is_number(quantity["number"], decimal):
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
        if is_ambiguous(plain):
            one, thousand = plain.replace(",", "."), re.sub("[.,]", "", plain)
            remedy = f"it may be {one} or {thousand}: declare ingest.decimal, or {remedy}"
    raise ValueError(f"{path}: line {line}, column {name} should be a number but is {plain[:40]!r}; {remedy}")
