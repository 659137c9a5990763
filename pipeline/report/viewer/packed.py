"""Tables as files that a page may load from file://: each column of numbers as float32 in base64, handed to a
function of the page. Nothing is left out of a column; what has no room is left out whole, and named.
"""

import base64
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.report.shared.sources import SourceFile
from pipeline.report.viewer.series import UNITS, ViewerTable, runs
from pipeline.verdict.digits import number
from pipeline.verdict.evidence import Table

# of the folder, in bytes: what a reader will still send to a colleague; of one copied table; of one table's
# events, which stand in the page
LARGEST, MOST_EVENTS = 32_000_000, 2000
# a book of no more bytes is one file; of a larger one each column is loaded when it is asked for
ONE_FILE = 1_500_000


class Packed(NamedTuple):
    """What the page says of a table, and the files of its columns by name."""

    entry: dict[str, Any]
    files: dict[str, str]


def packed(shown: ViewerTable, table: Table, room: int) -> Packed:
    """Every book (what is loaded together) that fits into `room` bytes, and the number of those that do not.

    A column's values are float32, rounded to nearest; x is exact: a start and a step where that gives the
    very same numbers, and float64 elsewhere. Runs whose values are equal to the bit are stored once.
    """
    found = runs(shown, table)
    values = [sorted({key[i] for key, _ in found}, key=_natural) for i in range(len(shown.keys))]
    books, files, out, events, total = {}, {}, 0, [], 0
    for key, rows in found:
        books.setdefault(key[: shown.books], []).append((key, rows))
    entry_books = []
    for number_of_book, mine in enumerate(books.values()):
        name = f"{shown.name}.{number_of_book}"
        made, listed = _book(shown, table, name, mine, values)
        size = sum(map(len, made.values()))
        if size > room:
            out += len(mine)
            continue
        room -= size
        together = size <= ONE_FILE
        files |= {f"{name}.js": "".join(made.values())} if together else made
        entry_books.append({"name": name, "together": together, "runs": listed})
        for key, rows in mine:
            happened = shown.events({name: column[rows] for name, column in table.items()})
            total += len(happened)
            kept = sorted(happened)[: max(MOST_EVENTS - sum(len(e) for _, e in events), 0)]
            events.append((_codes(key, values), [list(event) for event in kept]))
    entry = {
        "name": shown.name,
        "title": shown.title,
        "note": shown.note,
        "x": {"name": shown.x[0], "label": shown.x[1], "unit": shown.x[2]},
        "keys": [
            {
                "name": key.name,
                "label": key.label,
                "one": key.one,
                "values": v,
                "words": list(map(key.words, v)),
            }
            for key, v in zip(shown.keys, values, strict=True)
        ],
        "who": shown.who,
        "marks": _marks(shown, values),
        "lines": [
            line._asdict() | {"unit": UNITS.get(line.unit, line.unit), "raw": line.unit}
            for line in shown.lines
        ],
        "books": entry_books,
        "events": [[codes, happened] for codes, happened in events if happened],
        "events_left_out": total - sum(len(e) for _, e in events),
        "runs_left_out": out,
        "rows": len(table[shown.x[0]]),
    }
    return Packed(entry, files)


def _marks(shown: ViewerTable, values: list[list[str]]) -> dict[str, str]:
    """The mark of each value of the key that has marks."""
    places = [i for i, key in enumerate(shown.keys) if key.name == shown.who]
    return {value: shown.marks(value) for i in places for value in values[i]}


def _natural(text: str) -> tuple:
    """2 before 10."""
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text))


def _codes(key: tuple[str, ...], values: list[list[str]]) -> list[int]:
    return [each.index(value) for value, each in zip(key, values, strict=True)]


def _book(
    shown: ViewerTable, table: Table, name: str, mine: list, values: list[list[str]]
) -> tuple[dict[str, str], list[list]]:
    """The files of one book, and [codes of the keys, rows, start, step] of each of its runs; without start
    and step where x is a column of its own."""
    listed, irregular = [], []
    for key, rows in mine:
        x = np.asarray(table[shown.x[0]][rows], float)
        grid = regular(x)
        listed.append([_codes(key, values), len(rows), *(grid or ())])
        irregular.append(None if grid else x)
    files = {
        f"{name}.{i}.js": column_file(f"{name}.{i}", [_float32(table[line.name][rows]) for _, rows in mine])
        for i, line in enumerate(shown.lines)
    }
    if any(x is not None for x in irregular):
        files[f"{name}.x.js"] = column_file(
            f"{name}.x", [np.zeros(0, "<f8") if x is None else x.astype("<f8") for x in irregular]
        )
    return files, listed


def _float32(values: np.ndarray) -> np.ndarray:
    """Rounded to nearest; what is beyond 3.4e38 becomes infinite."""
    with np.errstate(over="ignore"):
        return np.asarray(values, float).astype("<f4")


def regular(x: np.ndarray) -> tuple[float, float] | None:
    """(start, step) where start + k step is x to the bit, else None."""
    if len(x) < 2 or not np.isfinite(x).all():
        return None
    start, k = float(x[0]), np.arange(len(x))
    for step in (float(x[1]) - start, round((float(x[-1]) - start) / (len(x) - 1), 9)):
        if np.array_equal(start + step * k, x):
            return start, step
    return None


def column_file(name: str, parts: list[np.ndarray]) -> str:
    """One column of all runs of a book, one after the other: where each begins, then their bytes, little
    endian, in base64."""
    seen: dict[bytes, int] = {}
    at, whole, length = [], [], 0
    for part in parts:
        data = part.tobytes()
        if data not in seen:
            seen[data] = length
            whole.append(data)
            length += len(part)
        at.append(seen[data])
    text = base64.b64encode(b"".join(whole)).decode()
    size = parts[0].itemsize if parts else 4
    return f'beadlineSeries({json.dumps(name)},{size},{json.dumps(at, separators=(",", ":"))},"{text}");\n'


def size_of(source: SourceFile) -> str:
    """Size of the file in words."""
    size = Path(source.path).stat().st_size
    return f"{number(size / 1e6, 1)} MB" if size >= 1e5 else f"{number(size / 1e3, 0)} kB"


def script_safe(data: Mapping[str, Any]) -> str:
    """JSON that no script element ends in."""
    text = json.dumps(data, ensure_ascii=True, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
