"""The CSV beside a folder of nozzle images (the columns of CAXTON: Brion and Pattinson 2022): image, flow,
temperature, print and tip of each frame, line by line."""

import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.recordings.csv_files import MISSING, CsvLayout, floats, list_layout, sound_rows
from pipeline.recordings.formats import Note, column_place, nearest_names
from pipeline.recordings.instants import instants, month_first

ROWS_AT_ONCE = 10_000
# what a printer can be told; beyond it the column is another one, or in another unit
FLOW_PERCENT, TEMPERATURE_DEGC = (0.0, 1000.0), (0.0, 600.0)
LABELS = "flow_rate_class"
DIRECTION = "travel_direction_deg"
# what is lived without, and how
OPTIONAL = {
    "print_id": "the file is one print",
    "nozzle_tip_x": "the tip is that of the settings",
    "timestamp": "the order of the rows is not checked",
    DIRECTION: "the travel direction is that of the ground, where it is seen to move, or of the only line",
}
# beside flow and target temperature, what is constant within a segment where the file has it
SETTINGS = ("feed_rate", "z_offset")
COLUMNS = {"img_path", "flow_rate", "target_hotend", "hotend", "nozzle_tip_y", LABELS, *OPTIONAL, *SETTINGS}
# beside what others write where they have nothing: a time of pandas
NOTHING = {*MISSING, "nat"}


class FrameLog(NamedTuple):
    """The n rows of one CSV: flow in percent of nominal, temperature in degC, tip (n, 2) in px, direction in
    degrees, label 0, 1 or 2; NaN, or empty text, where a row has none. `image` is as it was written, with
    forward slashes; `setting` counts the stretches of constant settings from 0, over all prints."""

    path: Path
    line: np.ndarray
    image: list[str]
    flow: np.ndarray
    temperature: np.ndarray
    print_id: list[str]
    setting: np.ndarray
    tip: np.ndarray
    direction: np.ndarray
    label: np.ndarray
    notes: list[Note]


def read_log(path: Path, hotend: float = np.nan) -> FrameLog:
    """The frames that a CSV lists, those of a print one behind the other. Raises ValueError, one sentence
    with the line, for a needed column that is not there, text in place of a number, a flow or temperature
    that no printer has, a label that is no class, and time that runs backwards within a print.

    hotend is the temperature of all frames in degC where the file has no column with it; NaN: it must.
    """
    layout = list_layout(path, lambda row: "img_path" in map(_column, row))
    layout = layout._replace(names=[_column(name) for name in layout.names])
    row_notes, notes = list(layout.notes), []
    columns = _columns(path, layout, notes, hotend)
    texts, numbers, lines = _rows(path, layout, columns, row_notes)
    notes = [note._replace(message=f"{path}: {note.message}") for note in row_notes] + notes
    count, missing = len(lines), np.full(len(lines), np.nan)
    _check_numbers(path, lines, numbers)
    temperature = numbers.get("target_hotend", numbers.get("hotend", np.full(count, hotend)))
    # a table program may write 0 as 0.0
    prints = [re.sub(r"^(\d+)\.0+$", r"\1", name) for name in texts.get("print_id", [path.stem] * count)]
    # prints one behind the other, each in the order of its rows
    numbered = {name: i for i, name in enumerate(dict.fromkeys(prints))}
    which = np.array([numbered[name] for name in prints], int)
    if "timestamp" in texts:
        # a line that is there twice is met again, and counted, where images are looked for
        first: dict[str, int] = {}
        stamps = [
            stamp if name and first.setdefault(image, i) == i else ""
            for i, (image, stamp, name) in enumerate(
                zip(texts["img_path"], texts["timestamp"], prints, strict=True)
            )
        ]
        _check_time(path, lines, stamps, which, prints)
    order = np.argsort(which, kind="stable")
    settings = [
        which,
        *(numbers[name] for name in ("flow_rate", "target_hotend", *SETTINGS) if name in numbers),
    ]
    tip = np.column_stack([numbers.get(name, missing) for name in ("nozzle_tip_x", "nozzle_tip_y")])
    return FrameLog(
        path, lines[order], [texts["img_path"][i].replace("\\", "/") for i in order],
        numbers["flow_rate"][order], temperature[order], [prints[i] for i in order],
        stretches(np.column_stack(settings)[order]), tip[order], numbers.get(DIRECTION, missing)[order],
        numbers.get(LABELS, missing)[order], notes,
    )  # fmt: skip


def stretches(settings: np.ndarray) -> np.ndarray:
    """(n,) numbers from 0 of the stretches in which settings (n, k)
    are constant; NaN is a value of its own."""
    settings = np.nan_to_num(settings, nan=np.inf)
    changes = (settings[1:] != settings[:-1]).any(axis=1)
    return np.concatenate([[0], np.cumsum(changes)]).astype(int)


def _column(name: str) -> str:
    """`Img Path` or `IMG-PATH` is img_path; a column that is none of ours keeps its name."""
    plain = re.sub(r"[\s-]+", "_", name.strip()).casefold()
    return plain if plain in COLUMNS else name


def _columns(path: Path, layout: CsvLayout, notes: list[Note], hotend: float) -> tuple[str, ...]:
    """The columns to read, the image first and the temperature second; raises ValueError where one that is
    needed is not there, and notes those that are lived without."""
    there = layout.names
    temperature = "target_hotend" if "target_hotend" in there or "hotend" not in there else "hotend"
    stated = np.isfinite(hotend) and temperature not in there
    if stated:
        notes.append(
            Note(
                "columns",
                "temperature",
                1,
                f"{path}: it has no temperature, so the stated {hotend:g} degC is its frames'",
            )
        )
    needed = ("img_path", "flow_rate") if stated else ("img_path", temperature, "flow_rate")
    for name in needed:
        if name not in there:
            either = "target_hotend or hotend" if name == temperature else name
            raise ValueError(
                f"{path}: expected a column {either}, found none; {nearest_names(name, there)}; rename it, "
                "or move the file out of the folder"
            )
    if ("nozzle_tip_x" in there) != ("nozzle_tip_y" in there):
        raise ValueError(
            f"{path}: expected both nozzle_tip_x and nozzle_tip_y, found one; add the other, "
            "or remove it and set the tip in params.yaml"
        )
    if temperature == "hotend":
        notes.append(
            Note(
                "columns",
                "temperature",
                1,
                f"{path}: it has no target_hotend, so the measured hotend is the temperature",
            )
        )
    without = [f"{name} ({how})" for name, how in OPTIONAL.items() if name not in there]
    if without:
        notes.append(Note("columns", "", len(without), f"{path}: it is read without {', '.join(without)}"))
    optional = [name for name in (*OPTIONAL, "nozzle_tip_y", *SETTINGS, LABELS) if name in there]
    return (*needed, *optional)


def _rows(
    path: Path, layout: CsvLayout, names: Sequence[str], notes: list[Note]
) -> tuple[dict[str, list[str]], dict[str, np.ndarray], np.ndarray]:
    """({column: texts}, {column: numbers}, lines), NaN and empty text where nothing is written."""
    places = {name: column_place(path, layout.names, name) for name in names}
    texts: dict[str, list[str]] = {
        name: [] for name in ("img_path", "print_id", "timestamp") if name in places
    }
    parts: dict[str, list[np.ndarray]] = {name: [] for name in places if name not in texts}
    lines: list[int] = []
    rows = sound_rows(path, layout, None, notes)
    while block := list(itertools.islice(rows, ROWS_AT_ONCE)):
        here = [line for line, _ in block]
        lines += here
        for name, place in places.items():
            fields = [row[place].strip() for _, row in block]
            if name in texts:
                texts[name] += ["" if field.casefold() in NOTHING else field for field in fields]
            else:
                parts[name].append(floats(path, name, fields, layout.decimal, here, {}))
    return texts, {name: np.concatenate(blocks) for name, blocks in parts.items()}, np.array(lines)


def _check_numbers(path: Path, lines: np.ndarray, numbers: dict[str, np.ndarray]) -> None:
    bounds = {
        "flow_rate": (*FLOW_PERCENT, "percent of nominal"), "target_hotend": (*TEMPERATURE_DEGC, "degC"),
        "hotend": (*TEMPERATURE_DEGC, "degC"),
        LABELS: (0.0, 2.0, "0 under, 1 good, 2 over"),
    }  # fmt: skip
    for name, (low, high, unit) in bounds.items():
        values = numbers.get(name, np.zeros(0))
        wrong = (
            (values < low)
            | (values > high)
            | ((name == LABELS) & (values != np.rint(values)) & np.isfinite(values))
        )
        if wrong.any():
            i = int(np.flatnonzero(wrong)[0])
            more = f", the first of {wrong.sum()}" if wrong.sum() > 1 else ""
            remedy = (
                "mend it, or remove that column" if name == LABELS else "mend it, or write it in that unit"
            )
            raise ValueError(
                f"{path}: line {lines[i]}: expected {name} within {low:g} and {high:g} ({unit}), "
                f"found {values[i]:g}{more}; {remedy}"
            )


def _check_time(
    path: Path, lines: np.ndarray, stamps: Sequence[str], which: np.ndarray, prints: Sequence[str]
) -> None:
    """Within a print time runs forward or stands still: what follows
    one another was seen one after the other."""
    present = np.array([bool(stamp) for stamp in stamps])
    plain = [stamp for stamp in stamps if stamp]
    try:
        times = np.array(plain, float)
    except ValueError:
        first = month_first({stamp.split()[0] for stamp in plain}, plain[0])
        try:
            # CAXTON writes a fraction of a second behind a hyphen, 13:12:50-34
            clock = instants(
                path, "timestamp", plain, lines[present].tolist(), month_first=first, hyphen_fraction=True
            )
            times = clock.ns.astype(float) / 1e9
        except ValueError as error:
            raise ValueError(str(error).replace("name another column", "remove that column")) from None
    which, lines, names = which[present], lines[present], list(itertools.compress(prints, present))
    order = np.argsort(which, kind="stable")
    back = np.flatnonzero((np.diff(times[order]) < 0) & (np.diff(which[order]) == 0))
    if len(back):
        i, before = order[back[0] + 1], order[back[0]]
        more = f", the first of {len(back)} such lines" if len(back) > 1 else ""
        raise ValueError(
            f"{path}: line {lines[i]}: expected time to run forward within print {names[i]!r}, "
            f"found it {times[before] - times[i]:.6g} s before line {lines[before]}{more}; "
            "sort the rows of each print by timestamp, or give what comes after a clock was set back "
            "a print_id of its own"
        )
