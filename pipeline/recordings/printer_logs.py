"""Reads a printer's temperatures from print servers: Moonraker's temperature store (JSON), and OctoPrint's
serial.log with the firmware's own reports."""

import json
import re
from array import array
from pathlib import Path

import numpy as np
import orjson

from pipeline.recordings.formats import Note, WholeTable, check_values, check_width
from pipeline.recordings.instants import instants, over_midnight

# a temperature store holds twenty minutes, some 100 kB
LARGEST_JSON = 1 << 25
LONGEST_LINE = 1 << 14
# the size of the table is checked after every this many reports
LINES_A_CHECK = 10_000
# Moonraker's lists -> name, unit, factor; one entry a second
_LISTS = {
    "temperatures": ("temp", "degC", 1.0),
    "targets": ("target", "degC", 1.0),
    "powers": ("pwm", "percent", 100.0),
    "speeds": ("fan_speed", "percent", 100.0),
}
_REPORT = re.compile(rb"(?:^|[\s:])T\d?:\s*-?\d")
_STAMP = re.compile(
    rb"^\s*(\d{4}-\d\d-\d\d[ T]\d+:\d\d:\d\d(?:[.,]\d+)?)|Recv:\s*(\d+:\d\d:\d\d(?:[.,]\d+)?):"
)
_HEAT = re.compile(rb"(?<![\w@])([TBC]\d{0,2}):\s*(-?\d+(?:\.\d+)?)(?:\s*/\s*(-?\d+(?:\.\d+)?))?(?=\s|$|ok)")
_DUTY = re.compile(rb"(?<![\w@])([TBC]?)@(\d{0,2}):\s*(\d+)(?=\s|$|ok)")
_DEVICES = {"T": "tool", "B": "bed", "C": "chamber"}


# ---- Moonraker


def load_moonraker(path: Path) -> WholeTable:
    """Returns the lists of server.temperature_store, one entry a second up to the newest. Shorter lists begin
    later.

    Raises ValueError if the file is not such a store.
    """
    if path.stat().st_size > LARGEST_JSON:
        raise ValueError(
            f"{path}: a temperature store should have at most {LARGEST_JSON >> 20} MB but has "
            f"{path.stat().st_size >> 20}; save the answer of /server/temperature_store alone"
        )
    try:
        document = orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError as error:
        raise ValueError(
            f"{path}: line {error.lineno}, column {error.colno}: the JSON breaks there ({error.msg}); "
            "save the answer of /server/temperature_store again"
        ) from None
    store = document.get("result", document) if isinstance(document, dict) else None
    lists = dict(_lists(store)) if isinstance(store, dict) else {}
    if not lists:
        shown = json.dumps(document)[:60]
        raise ValueError(
            f"{path}: expected Moonraker's temperature store, a device with temperatures, but found {shown}; "
            "save the answer of /server/temperature_store"
        )
    check_width(path, len(lists))
    count = max(len(entries) for entries in lists.values())
    values, units, missing = {}, {}, 0
    for (device, key), entries in lists.items():
        name, unit, scale = _LISTS[key]
        numbers = [e if isinstance(e, int | float) and not isinstance(e, bool) else np.nan for e in entries]
        missing += sum(np.isnan(number) for number in numbers)
        column = np.full(count, np.nan)
        column[count - len(numbers) :] = np.array(numbers, float) * scale
        values[f"{device}.{name}"], units[f"{device}.{name}"] = column, unit
    notes = [Note("clock", "", 1, "a temperature store has no times: its entries were taken as 1 s apart")]
    if missing:
        notes.append(Note("missing", "", missing, f"{missing} entries of the store are no numbers"))
    return WholeTable(
        values, units, np.arange(count, dtype=float), "", lambda i: f"entry {i + 1}", notes, {}, {}, {}
    )


def _lists(store: dict):
    """Yields ((device, key), entries) of each list of numbers."""
    for device, lists in store.items():
        if isinstance(lists, dict) and isinstance(lists.get("temperatures"), list):
            yield from (((device, key), lists[key]) for key in _LISTS if isinstance(lists.get(key), list))


# ---- OctoPrint


def load_serial_log(path: Path) -> WholeTable:
    """Returns temperatures, targets and duties that the firmware reported: T, B and C in °C, @ in percent.

    The full duty is 127, or 255 if it ever exceeds 127. Raises ValueError if the log has no report with a
    time.
    """
    rows = _Reports()
    with path.open("rb") as stream:
        number = 0
        while text := stream.readline(LONGEST_LINE):
            number += 1
            if b"Recv:" in text and _REPORT.search(text):
                rows.add(number, text)
                if len(rows.lines) % LINES_A_CHECK == 0:
                    check_values(path, len(rows.lines), len(rows.columns))
    if not rows.stamps:
        raise ValueError(
            f"{path}: expected lines such as 2025-11-21 13:00:00,500 - Recv: ok T:200.1 /200.0 B:60.0 /60.0, "
            f"found {rows.untimed} reports without a time; write the log with times (OctoPrint's serial.log)"
        )
    lines = np.frombuffer(rows.lines, np.int64)
    times = instants(path, "of the log", rows.stamps, lines.tolist(), month_first=None)
    ns, midnights = (times.ns, 0) if times.dated else over_midnight(times.ns)
    values = {name: np.frombuffer(column) for name, column in rows.columns.items()}
    return _serial_table(rows, values, lines, ns, midnights)


def _serial_table(rows: "_Reports", values: dict, lines: np.ndarray, ns: np.ndarray, midnights: int):
    notes, factors = [], {}
    keep = np.r_[True, np.diff(ns) > 0]
    if not keep.all():
        count = int((~keep).sum())
        notes.append(Note("repeated", "", count, f"{count} reports came at the time of another; left out"))
    if rows.untimed:
        notes.append(Note("idle", "", rows.untimed, f"{rows.untimed} reports have no time and were left out"))
    if midnights:
        notes.append(Note("clock", "", midnights, f"the time of day runs over midnight {midnights} times"))
    if "tool0.temp" in values:  # T repeats the tool at work
        values = {name: column for name, column in values.items() if not name.startswith("tool.")}
    for name, column in values.items():
        full = 255 if np.nanmax(column, initial=0) > 127 else 127
        factors[name] = 100 / full if name.endswith(".pwm") else 1.0
    units = {name: "percent" if name.endswith(".pwm") else "degC" for name in values}
    where = np.flatnonzero(keep)
    return WholeTable(
        {name: (column * factors[name])[where] for name, column in values.items()},
        units,
        ns[where],
        "",
        lambda i: f"line {lines[where[i]]}",
        notes,
        {},
        {},
        {},
    )


class _Reports:
    """The reports while they are read. A column that begins late is NaN before."""

    def __init__(self) -> None:
        self.stamps: list[str] = []
        self.lines, self.columns, self.untimed = array("q"), {}, 0

    def add(self, line: int, text: bytes) -> None:
        stamp = _STAMP.search(text)
        row = {}
        for device, actual, target in _HEAT.findall(text):
            name = _DEVICES[chr(device[0])] + device[1:].decode()
            row[f"{name}.temp"] = float(actual)
            if target:
                row[f"{name}.target"] = float(target)
        for device, index, duty in _DUTY.findall(text):
            row[f"{_DEVICES[device.decode() or 'T']}{index.decode()}.pwm"] = float(duty)
        if "tool0.temp" in row and "tool.pwm" in row:
            row.setdefault("tool0.pwm", row["tool.pwm"])
        if not stamp or not row:
            self.untimed += 1
            return
        for name in row:
            self.columns.setdefault(name, array("d", [np.nan]) * len(self.lines))
        for name, column in self.columns.items():
            column.append(row.get(name, np.nan))
        self.stamps.append((stamp[1] or stamp[2]).decode())
        self.lines.append(line)
