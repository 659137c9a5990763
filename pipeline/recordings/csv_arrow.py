"""Rows of plain numbers out of a text file by Arrow's converter: the fast way of `csv_files`.

Arrow reads only what the slow way reads in the same manner. At the first row that is anything else the file
is left to the slow way, which knows the line and the words.
"""

import codecs
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv

from pipeline.recordings.arrow_arrays import numbers
from pipeline.recordings.csv_rows import COMMENT, MISSING, CsvLayout, rows
from pipeline.recordings.formats import Growing

BLOCK_BYTES = 1 << 20
# a first block of short rows may promise what is not there
MOST_EXPECTED = 1 << 22
_LINE_END = re.compile(rb"\r\n|\r|\n")
# Arrow knows zones up to 24 h; ours end at 14, and some programs write a fraction behind a hyphen
_FAR_ZONE = re.compile(rb":\d\d(?:\.\d+)?[+-](?:1[5-9]|2\d|14:?(?!00)\d)")
_ISO = re.compile(r"\d{4}-\d\d-\d\d(?:[T ]\d\d:\d\d(?::\d\d(?:\.\d{1,9})?)?)?(Z|[+-]\d\d(?::?\d\d)?)?$")
_REMARK = rf"^\s*({'|'.join(map(re.escape, COMMENT))})"
_LAST_REMARK = re.compile(_REMARK.encode())
_NULLS = sorted({spelt for word in MISSING for spelt in (word, word.upper(), word.title())} | {"NaN"})


class PlainTable(NamedTuple):
    """Values (n,) of the wanted columns. `time` is numbers, or ns since 1970, `zoned` if all name a zone.

    `broken` is the last line and its count of fields, where it breaks off and is left out.
    """

    time: np.ndarray | None
    zoned: bool
    values: list[np.ndarray]
    broken: tuple[int, int] | None


class _NotPlain(Exception):
    """Something that only the slow way reads."""


def iso_zone(sample: str) -> str | None:
    """ "UTC" for an ISO 8601 time with a zone, "" for one without, None for any other text."""
    match = _ISO.match(sample)
    return None if match is None else "UTC" if match[1] else ""


def read_plain(
    path: Path, layout: CsvLayout, places: Sequence[int], clock: int | None, zone: str | None
) -> PlainTable | None:
    """The columns at `places` and the time at `clock`, None for a file that is not plain.

    `zone` is that of `iso_zone` for a clock of ISO times, None for a clock of numbers.
    """
    if layout.delimiter == " ":
        return None
    extra = _extra_columns(path, layout)
    if extra is None:
        return None
    first_row = 0 not in places and clock != 0
    read = list(dict.fromkeys([*places, *([] if clock is None else [clock])]))
    types: dict[int, pa.DataType] = dict.fromkeys(places, pa.float64())
    if clock is not None:
        types[clock] = pa.float64() if zone is None else pa.timestamp("ns", zone or None)
        if clock in places and zone is not None:
            return None
    types |= {len(layout.names) + i: pa.null() for i in range(extra)}
    parts = Growing([np.int64 if pa.types.is_timestamp(types[place]) else float for place in read])
    try:
        text = _ArrowText(path, layout, bool(zone))
        for batch in _batches(text, layout, types, extra, first_row):
            columns = [
                _plain_numbers(batch.column(f"{place}"), types[place], place == clock) for place in read
            ]
            if clock is None and np.isnan(columns).all(axis=0).any():
                return None  # a blank row is no sample
            if not parts.count:
                _expect(parts, path, len(batch))
            parts.append(*columns)
    except (_NotPlain, pa.ArrowInvalid):
        return None
    if not parts.count:
        return None
    finished = dict(zip(read, parts.finished(), strict=True))
    time = None if clock is None else finished[clock]
    broken = (text.lines + 1, text.broken_after) if text.broken_after else None
    return PlainTable(time, bool(zone), [finished[place] for place in places], broken)


def _expect(parts: Growing, path: Path, in_block: int) -> None:
    """Room for as many rows as the first block lets expect."""
    expected = int(in_block * max(1.0, 1.02 * path.stat().st_size / BLOCK_BYTES)) + 1
    parts.expect(min(expected, MOST_EXPECTED))


def _extra_columns(path: Path, layout: CsvLayout) -> int | None:
    """How many delimiters without a column end each row, by the first row."""
    for _, row in rows(path, layout):
        extra = row[len(layout.names) :]
        return None if len(row) < len(layout.names) or any(field.strip() for field in extra) else len(extra)
    return None


def _batches(
    text: "_ArrowText", layout: CsvLayout, types: dict[int, pa.DataType], extra: int, first_row: bool
) -> Iterator[pa.RecordBatch]:
    """Batches with columns called by their places. Raises _NotPlain and ArrowInvalid."""
    shown = [*types, *([0] if first_row else [])]
    reader = pa.csv.open_csv(
        pa.PythonFile(text, mode="r"),
        read_options=pa.csv.ReadOptions(
            use_threads=False,
            block_size=BLOCK_BYTES,
            column_names=[f"{i}" for i in range(len(layout.names) + extra)],
        ),
        parse_options=pa.csv.ParseOptions(delimiter=layout.delimiter),
        convert_options=pa.csv.ConvertOptions(
            column_types={f"{place}": kind for place, kind in ({0: pa.string()} | types).items()},
            include_columns=[f"{place}" for place in shown],
            null_values=_NULLS,
            decimal_point=layout.decimal,
            timestamp_parsers=[pa.csv.ISO8601],
        ),
    )
    for batch in reader:
        if first_row and _has_comment(batch.column("0")):
            raise _NotPlain
        if text.strange:
            raise _NotPlain
        if len(batch):
            yield batch
    if text.strange:
        raise _NotPlain


def _has_comment(column: pa.Array) -> bool:
    remarks = pc.call_function("match_substring_regex", [column], pc.MatchSubstringOptions(_REMARK))
    return bool(pc.call_function("any", [remarks]).as_py())


def _plain_numbers(column: pa.Array, kind: pa.DataType, is_clock: bool) -> np.ndarray:
    """The numbers of a column. Raises _NotPlain for a missing time, and for a word that Arrow takes for NaN
    or infinite."""
    if is_clock and column.null_count:
        raise _NotPlain
    if pa.types.is_timestamp(kind):
        return numbers(column, np.int64)
    values = numbers(column, np.float64)
    odd = len(values) - int(np.isfinite(values).sum())
    if odd != column.null_count:
        raise _NotPlain
    return values


class _ArrowText:
    """The rows of data as UTF-8, a block at a time. `strange` turns true at zeros, and at bytes of another
    encoding; the text ends there."""

    closed = False

    def __init__(self, path: Path, layout: CsvLayout, zoned: bool):
        self._stream = path.open("rb")
        self._decoder = codecs.getincrementaldecoder(layout.encoding)()
        self._utf8 = layout.encoding.startswith("utf-8")
        self._zoned, self.strange, self._before = zoned, False, b""
        self._delimiter, self._columns = layout.delimiter.encode(), len(layout.names)
        self.lines, self.broken_after, self._ended = 0, 0, False
        self._size = path.stat().st_size
        self._rest = self._behind(layout.skip)

    def _behind(self, skip: int) -> bytes:
        """What the first blocks hold behind the lines of the header."""
        start = b""
        while len(start) < 4 * BLOCK_BYTES:
            block = self._block()
            start += block if start else block.removeprefix(codecs.BOM_UTF8)
            ends = [match.end() for _, match in zip(range(skip), _LINE_END.finditer(start), strict=False)]
            if len(ends) == skip and (not ends or ends[-1] < len(start)):
                begin = ends[-1] if ends else 0
                if start[:begin].count(b'"') % 2:
                    self.strange = True
                return start[begin:]
            if not block:
                break
        self.strange = True
        return b""

    def _block(self) -> bytes:
        raw = self._stream.read(BLOCK_BYTES)
        try:
            if self._utf8 and raw.isascii() and not self._decoder.getstate()[0]:
                block = raw
            elif self._utf8:
                self._decoder.decode(raw, final=not raw)
                block = raw
            else:
                block = self._decoder.decode(raw, final=not raw).encode()
        except UnicodeError:
            self.strange = True
            return b""
        if b"\0" in block or (self._zoned and _FAR_ZONE.search(self._before + block)):
            self.strange = True
            return b""
        self.lines += block.count(b"\n")
        if b"\r" in block or self._before.endswith(b"\r"):
            self.lines += block.count(b"\r") - block.count(b"\r\n")
            self.lines -= self._before.endswith(b"\r") and block.startswith(b"\n")
        self._before = block[-64:]
        return block

    def _next(self) -> bytes:
        """The next block. The last ones come together, without a last line that breaks off."""
        block, self._rest = self._rest or self._block(), b""
        if self._ended or self._stream.tell() < self._size - BLOCK_BYTES:
            return block
        self._ended = True
        parts = [block]
        while part := self._block():
            parts.append(part)
        text = b"".join(parts)
        cut = max(text.rfind(b"\n"), text.rfind(b"\r")) + 1
        last = text[cut:]
        fields = last.count(self._delimiter) + 1
        if last.strip() and fields < self._columns and b'"' not in last and not _LAST_REMARK.match(last):
            self.broken_after = fields
            return text[:cut]
        return text

    def read(self, size: int = -1) -> bytes:
        if self.strange:
            return b""
        block = self._next()
        if size < 0 or len(block) <= size:
            self._rest = b""
            return block
        self._rest = block[size:]
        return block[:size]

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return False

    def writable(self) -> bool:
        return False

    def close(self) -> None:
        self._stream.close()
        self.closed = True
