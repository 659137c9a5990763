"""Reads Klipper's log (klippy.log): the values of each heater in its Stats lines, on the calendar, and the
printer's own control from the configuration that the log repeats.

A line is read as in Klipper's own scripts/graphstats.py: words after "Stats"; a word without "=" is the
device of the following target, temp and pwm; a line without print_time is left out. Times count from the
computer's start. "Start printer at ... (system time, that count)" puts them on the calendar. Part fan and
filament feed come from the printed G-code beside the log (printed_gcode).
"""

import re
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from pipeline.recordings import printed_gcode
from pipeline.recordings.formats import CALENDAR_S, Note, WholeTable, check_values
from pipeline.recordings.printed_gcode import Print, PrintRows, PrintSignals

# Stats lines have some 1,500 characters; a longer line is no line of Klipper's
LONGEST_LINE = 1 << 16
MOST_DEVICES = 200
# the size of the table is checked after every this many lines
LINES_A_CHECK = 10_000
LONGEST_CONFIG = 20_000
# sessions in unknown order are placed this far apart, in s, so that no gap limit joins them
APART_S = 3600.0
# Klipper divides its PID parameters by this, because they are for a duty of 0 to 255
PID_BASE = 255.0
_STATS = (b"Stats", b"INFO:root:Stats")
LATEST_S = 4e9  # the year 2096: beyond it a system time is none, and no count runs on so long
_START = re.compile(rb"Start printer at .*\((\d+(?:\.\d+)?) (\d+(?:\.\d+)?)\)")
# what virtual_sdcard logs: it reads from a position on, the file is over, it stops at a position
_PRINTING = re.compile(
    rb"(Start|Exit)ing SD card print \(position (\d{1,15})\)|(Finished) SD card print|"
    rb"File opened:(.{1,300}?) Size:(\d{1,15})"
)
LONGEST_BUFFER_S = 3600.0  # motion is not planned further ahead
# key of a Stats line -> unit and factor
_KEYS = {
    b"temp": ("temp", "degC", 1.0),
    b"target": ("target", "degC", 1.0),
    b"pwm": ("pwm", "percent", 100.0),
    b"fan_speed": ("fan_speed", "percent", 100.0),
}


# keys of the motion queue and of the printed file
_QUEUE = (b"print_time", b"buffer_time", b"sd_pos")


class PrinterPid(NamedTuple):
    """The printer's own PID of a heater, u = kp e + ki ∫e dt - kd dy/dt, u in percent of duty and e in °C.

    The derivative is smoothed over `smooth_s`. u is limited to 0 ... `most_percent`.
    """

    heater: str
    kp_percent_per_degC: float
    ki_percent_per_degC_s: float
    kd_percent_s_per_degC: float
    most_percent: float
    smooth_s: float


class HeaterConfig(NamedTuple):
    """A heater in the printer's configuration. `pid` is None if its control is not a PID that can be read,
    such as on-off."""

    heater: str
    control: str
    low_degC: float
    high_degC: float
    most_percent: float
    pid: PrinterPid | None


class _Session(NamedTuple):
    """A run of Klipper: its first row, and the system time at the zero of its count, NaN if the log lacks
    it."""

    first: int
    zero_s: float


def load_klippy(path: Path) -> WholeTable:
    """Returns temperature, target (°C), duty and fan speed (percent) of every device in the Stats lines.

    Columns are "extruder.temp", "extruder.target", "extruder.pwm"; and "part_fan.speed" (percent) and
    "filament.feed" (mm/s) if the printed G-code is beside the log. Raises ValueError if the log has no Stats
    line of a heater.
    """
    log = _read(path)
    if not log.times or not log.columns:
        left_out = log.idle + log.garbled + log.cut
        what = "no Stats line"
        if log.times or left_out:
            what = f"{len(log.times)} whole Stats lines of a printer at work, none of a heater"
            what += f", and {left_out} that are idle, garbled or cut" if left_out else ""
        raise ValueError(
            f"{path}: line 2 on should hold Klipper's Stats lines with heaters, but the log has {what}; "
            "log while the heaters are on, or name another file"
        )
    values = {name: np.frombuffer(column) for name, column in log.columns.items()}
    heaters = heater_configs(log.config)
    time, order, notes = _on_calendar(np.frombuffer(log.times), log.sessions, values)
    lines = np.frombuffer(log.lines, np.int64)[order]
    printed = _print_signals(path, log, time, order)
    limits = {}
    for heater in heaters:
        limits[f"{heater.heater}.temp"] = (heater.low_degC, heater.high_degC)
        limits[f"{heater.heater}.pwm"] = (0.0, heater.most_percent)
    return WholeTable(
        {name: column[order] for name, column in values.items()} | printed.values,
        {name: _KEYS[name.rpartition(".")[2].encode()][1] for name in values} | printed_gcode.UNITS,
        time,
        "UTC" if time.dtype == np.int64 else "",
        lambda i: f"line {lines[i]}",
        [*log.notes(), *notes, *printed.notes, *map(_control_note, heaters)],
        {name: limits[name] for name in values if name in limits},
        {},
        {},
    )


def printed_files(path: Path) -> list[Path]:
    """Returns the G-code files and histories from which a klippy.log's fan and feed are computed."""
    log = _read(path)
    time, order, _ = _on_calendar(np.frombuffer(log.times), log.sessions, {})
    return _print_signals(path, log, time, order).files if log.times else []


def printer_heaters(path: Path) -> list[HeaterConfig]:
    """Returns the heaters of the last configuration in a klippy.log; none if it has no configuration."""
    log = _Log()
    with path.open("rb") as stream:
        for line, text in _lines(stream):
            log.add_config(line, text)
    return heater_configs(log.config)


def _read(path: Path) -> "_Log":
    log = _Log()
    with path.open("rb") as stream:
        for line, text in _lines(stream):
            log.add(line, text)
            if line % LINES_A_CHECK == 0:
                check_values(path, len(log.times), len(log.columns))
    return log


# ---- lines


def _lines(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yields (number, text) of the lines. From a line that is too long or has no end, only the word Stats is
    kept."""
    number = 0
    while text := stream.readline(LONGEST_LINE):
        number += 1
        if not text.endswith(b"\n"):
            text = b"Stats" if _is_stats(text[:64]) else b""
            while (rest := stream.readline(LONGEST_LINE)) and not rest.endswith(b"\n"):
                continue
        yield number, text


def _is_stats(text: bytes) -> bool:
    return any(mark in text for mark in _STATS)


class _Log:
    """The columns that grow while the lines are read."""

    def __init__(self) -> None:
        self.times, self.lines, self.columns = array("d"), array("q"), {}
        self.sessions: list[_Session] = [_Session(0, np.nan)]
        self.config: list[str] = []
        self.in_config = False
        self.idle = self.garbled = self.cut = 0
        self.first_garbled = self.first_undated = 0
        self.prints: list[Print] = []
        self.is_printing, self.is_over, self.position, self.opened = False, False, -1, ("", -1)
        # for each row: buffer_time, position in the printed file, index of the print, whether it is being
        # read
        self.buffers, self.positions = array("d"), array("q")
        self.print_index, self.reads = array("q"), array("b")

    def add(self, line: int, text: bytes) -> None:
        if _is_stats(text):
            self._add_stats(line, text)
        elif start := _START.search(text):
            zero_s = float(start[1]) - float(start[2])
            if not 0 <= zero_s < LATEST_S:
                self.first_undated, zero_s = self.first_undated or line, np.nan
            self.sessions.append(_Session(len(self.times), zero_s))
            self.is_printing, self.position = False, -1
        elif event := _PRINTING.search(text):
            self._add_print_event(line, event)
        else:
            self.add_config(line, text)

    def add_config(self, line: int, text: bytes) -> None:
        """Adds a line of the configuration. Only the last configuration in the log is kept."""
        stripped = text.strip()
        if stripped == b"===== Config file =====":
            self.in_config, self.config = True, []
        elif stripped == b"=======================" or len(self.config) >= LONGEST_CONFIG:
            self.in_config = False
        elif self.in_config:
            self.config.append(text.decode("utf-8", errors="replace"))

    def _add_print_event(self, line: int, event: re.Match[bytes]) -> None:
        what, position, finished, name, size = event.groups()
        if name:
            self.opened = name.decode("utf-8", errors="replace").strip(), int(size)
        elif finished:
            self.is_over = True  # the position follows
        elif what == b"Start":
            # a print that continues after a pause starts at the position where it stopped
            if not (self.is_printing and int(position) == self.position and self.prints[-1].end < 0):
                self._start_print(line, int(position))
            self.position = int(position)
        elif what and self.is_printing:
            self.position = int(position)
            if self.is_over:
                self.prints[-1] = self.prints[-1]._replace(end=self.position)

    def _start_print(self, line: int, position: int) -> None:
        self.prints.append(Print(position, -1, *self.opened, line))
        self.is_printing, self.is_over, self.opened = True, False, ("", -1)

    def _add_position(self, line: int, queue: dict[bytes, float]) -> None:
        """Adds Klipper's position in the printed file. A position that falls, or comes without a start,
        belongs to another print."""
        position, buffer_s = queue.get(b"sd_pos", -1.0), queue.get(b"buffer_time", 0.0)
        reads = 0 <= position < 1e15
        if reads:
            if not self.is_printing or position < self.position:
                self._start_print(line, int(position))
            self.position = int(position)
        self.buffers.append(buffer_s if 0 <= buffer_s < LONGEST_BUFFER_S else 0.0)
        self.positions.append(self.position)
        self.print_index.append(len(self.prints) - 1 if self.is_printing else -1)
        self.reads.append(reads)

    def _add_stats(self, line: int, text: bytes) -> None:
        words = text.split()
        at = next((i for i, word in enumerate(words) if word in _STATS), None)
        if at is None:
            if b"\0" in text:  # what a file system leaves after a power failure
                self._count_garbled(line)
            return
        if len(words) <= at + 2:
            self.cut += 1
            return
        try:
            time = float(words[at + 1][:-1])
            row, queue = self._row(words[at + 2 :])
        except ValueError:
            self._count_garbled(line)
            return
        if not np.isfinite(time) or b"print_time" not in queue:
            self.idle += 1
            return
        if not 0 <= time < LATEST_S:
            self._count_garbled(line)
            return
        # a count that falls without a start is another run, pasted after this one
        if self.times and time < self.times[-1] and self.sessions[-1].first < len(self.times):
            self.sessions.append(_Session(len(self.times), np.nan))
            self.is_printing, self.position = False, -1
        count = len(self.times)
        for name in row:
            if name not in self.columns and len(self.columns) < MOST_DEVICES * len(_KEYS):
                self.columns[name] = array("d", [np.nan]) * count
        for name, column in self.columns.items():
            column.append(row.get(name, np.nan))
        self.times.append(time)
        self.lines.append(line)
        self._add_position(line, queue)

    def _row(self, words: list[bytes]) -> tuple[dict[str, float], dict[bytes, float]]:
        """Returns the numbers of the devices, and those of the motion queue. Raises ValueError if a number is
        text."""
        device, row, queue = b"", {}, {}
        for word in words:
            key, mark, value = word.partition(b"=")
            if not mark:
                device = word
            elif key in _KEYS and device.endswith(b":"):
                name, _, scale = _KEYS[key]
                row[f"{device[:-1].decode('utf-8', errors='replace')}.{name}"] = float(value) * scale
            elif key in _QUEUE:
                queue[key] = float(value)
        return row, queue

    def _count_garbled(self, line: int) -> None:
        self.first_garbled = self.first_garbled or line
        self.garbled += 1

    def notes(self) -> list[Note]:
        notes = []
        if self.garbled:
            message = (
                f"{self.garbled} Stats lines hold text or zero bytes in place of a number, or a count "
                "that no computer reaches, and were left out"
            )
            notes.append(
                Note("damage", "", self.garbled, f"{message}, the first is line {self.first_garbled}")
            )
        if self.first_undated:
            message = (
                f"the start in line {self.first_undated} gives no time of day that can be; it is not used"
            )
            notes.append(Note("damage", "", 1, message))
        if self.cut:
            notes.append(
                Note("truncated", "", self.cut, f"{self.cut} Stats lines break off and were left out")
            )
        if self.idle:
            message = f"{self.idle} Stats lines have no print_time (no printer was ready) and were left out"
            notes.append(Note("idle", "", self.idle, message))
        return notes


# ---- sessions and the calendar


def _on_calendar(
    counts_s: np.ndarray, sessions: list[_Session], values: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, list[Note]]:
    """Returns (time, rows in the order of time, notes): time_ns if a start gives the calendar, otherwise
    time_s."""
    starts = [session.first for session in sessions] + [len(counts_s)]
    pieces = [
        (np.arange(a, b), session.zero_s)
        for session, a, b in zip(sessions, starts[:-1], starts[1:], strict=True)
        if b > a
    ]
    zeros = _zeros(pieces, counts_s, values)
    on_calendar = bool(np.isfinite(zeros).any())
    notes: list[Note] = []
    rows, times = _sorted(pieces, zeros, counts_s, notes)
    rows, times = _without_repeats(rows, times, values, notes)
    if len(pieces) > 1:
        notes.append(
            Note("sessions", "", len(pieces), f"the log holds {len(pieces)} runs of Klipper, each a segment")
        )
    if on_calendar:
        return np.rint(times * 1e9).astype(np.int64), rows, notes
    return times, rows, notes


def _zeros(
    pieces: list[tuple[np.ndarray, float]], counts_s: np.ndarray, values: dict[str, np.ndarray]
) -> np.ndarray:
    """Returns the system time at zero of each run. A run without a start takes the zero of a neighbour if the
    count continues between them (the computer was not restarted), or if it repeats that run."""
    zeros = np.array([zero for _, zero in pieces])
    for i in range(1, len(pieces)):
        before, first = pieces[i - 1][0], pieces[i][0][0]
        runs_on = counts_s[first] > counts_s[before[-1]]
        if np.isnan(zeros[i]) and (runs_on or _repeats(first, before, counts_s, values)):
            zeros[i] = zeros[i - 1]
    for i in range(len(pieces) - 2, -1, -1):
        if np.isnan(zeros[i]) and counts_s[pieces[i][0][-1]] < counts_s[pieces[i + 1][0][0]]:
            zeros[i] = zeros[i + 1]
    return zeros


def _repeats(row: int, before: np.ndarray, counts_s: np.ndarray, values: dict[str, np.ndarray]) -> bool:
    """Returns whether a row also exists among the rows `before`, with the same count and values."""
    at = before[min(np.searchsorted(counts_s[before], counts_s[row] - 0.05), len(before) - 1)]
    same = [np.array_equal(column[at], column[row], equal_nan=True) for column in values.values()]
    return abs(counts_s[at] - counts_s[row]) < 0.05 and all(same)


def _sorted(pieces, zeros: np.ndarray, counts_s: np.ndarray, notes: list[Note]):
    """Returns (rows, times) of all runs in the order of time. A run with unknown time follows the previous
    one in the file, an hour later. If there is no previous one, it is placed before the others."""
    placed, end = [], np.nan
    for (rows, _), zero in zip(pieces, zeros, strict=True):
        times = counts_s[rows] + (0.0 if np.isnan(zero) else zero)
        if np.isnan(zero) and (np.isfinite(end) or np.isfinite(zeros).any()):
            before = end if np.isfinite(end) else np.nanmin(zeros) - (times[-1] - times[0]) - 2 * APART_S
            times = times - times[0] + before + APART_S
            notes.append(
                Note(
                    "clock",
                    "",
                    len(rows),
                    f"{len(rows)} Stats lines of a run have no start with the time of day; "
                    "they are placed an hour from the next run",
                )
            )
        placed.append((rows, times))
        end = times[-1]
    placed.sort(key=lambda piece: piece[1][0])
    rows, times = (np.concatenate(parts) for parts in zip(*placed, strict=True))
    order = np.argsort(times, kind="stable")
    return rows[order], times[order]


def _without_repeats(rows: np.ndarray, times: np.ndarray, values: dict[str, np.ndarray], notes: list[Note]):
    """Returns rows and times with each time once. Lines that exist twice (a log and its rollover in one file)
    are counted in a note, and so are other lines with the time of another."""
    close = np.r_[False, np.diff(times) < 0.05]  # times have one decimal
    same = np.zeros(len(rows), bool)
    for i in np.flatnonzero(close):
        pairs = [(column[rows[i]], column[rows[i - 1]]) for column in values.values()]
        same[i] = all(now == before or (np.isnan(now) and np.isnan(before)) for now, before in pairs)
    if (close & same).any():
        count = int((close & same).sum())
        notes.append(Note("repeated", "", count, f"{count} Stats lines stand twice and were used once"))
    if (close & ~same).any():
        count = int((close & ~same).sum())
        message = f"{count} Stats lines have the time of another with other values and were left out"
        notes.append(Note("repeated", "", count, message))
    return rows[~close], times[~close]


# ---- the print


def _print_signals(path: Path, log: _Log, time: np.ndarray, order: np.ndarray) -> PrintSignals:
    """Returns part fan and feed at the rows in the order of time."""
    on_calendar = time.dtype == np.int64
    start_s = float(time[0] / 1e9 if on_calendar else time[0])
    rows = PrintRows(
        (time - time[0]) / 1e9 if on_calendar else time - time[0],
        np.frombuffer(log.buffers)[order],
        np.frombuffer(log.positions, np.int64)[order],
        np.frombuffer(log.print_index, np.int64)[order],
        np.frombuffer(log.reads, np.int8)[order] != 0,
    )
    start_s = start_s if start_s > CALENDAR_S else np.nan
    return printed_gcode.print_signals(path, rows, log.prints, start_s, fan_macros(log.config))


def fan_macros(lines: list[str]) -> dict[str, float]:
    """Returns {name: percent} of the macros in a configuration that set the part fan to a number; a macro's
    last command for it counts."""
    macros, name = {}, ""
    for line in lines:
        if section := re.match(r"\s*\[(?:gcode_macro\s+(\w+)|[^\]]*)\s*\]", line):
            name = (section[1] or "").upper()
        elif name and (command := re.match(r"\s*(M10[67])(?![\d.])([^;{]*)$", line, re.IGNORECASE)):
            off = command[1].upper() == "M107"
            macros[name] = 0.0 if off else printed_gcode.fan_percent(command[2].encode())
    return macros


# ---- the printer's own control


def heater_configs(lines: list[str]) -> list[HeaterConfig]:
    """Returns the heaters of a configuration, as Klipper writes it into its log. A value that is not a number
    counts as missing."""
    sections: dict[str, dict[str, str]] = {}
    keys: dict[str, str] = {}
    for line in lines:
        text = line.removeprefix("#*#").strip()
        if section := re.fullmatch(r"\[([^\]]+)\]", text):
            keys = sections.setdefault(section[1].strip(), {})
        elif (option := re.match(r"(\w+)\s*[=:]\s*(.*)$", text)) and not line.startswith("#*# <"):
            keys[option[1].casefold()] = option[2].split("#")[0].strip()
    return [
        _heater(name.split()[-1], keys)
        for name, keys in sections.items()
        if "heater_pin" in keys or "control" in keys and "max_temp" in keys
    ]


def _heater(name: str, keys: dict[str, str]) -> HeaterConfig:
    most = 100 * _number(keys, "max_power", 1.0)
    gains = [_number(keys, key, np.nan) * 100 / PID_BASE for key in ("pid_kp", "pid_ki", "pid_kd")]
    control = keys.get("control", "")
    pid = None
    if control.startswith("pid") and np.isfinite(gains).all():
        pid = PrinterPid(name, *gains, most, _number(keys, "smooth_time", 1.0))
    return HeaterConfig(
        name, control, _number(keys, "min_temp", np.nan), _number(keys, "max_temp", np.nan), most, pid
    )


def _number(keys: dict[str, str], key: str, default: float) -> float:
    try:
        return float(keys.get(key, default))
    except ValueError:
        return default


def _control_note(heater: HeaterConfig) -> Note:
    how = f"control {heater.control or 'unknown'}"
    if heater.pid:
        kp, ki, kd = (gain * PID_BASE / 100 for gain in heater.pid[1:4])
        how = f"its own PID (pid_Kp {kp:g}, pid_Ki {ki:g}, pid_Kd {kd:g})"
    message = (
        f"the printer holds {heater.heater} by {how}, within {heater.low_degC:g} to {heater.high_degC:g} °C "
        f"and up to {heater.most_percent:g} % of duty"
    )
    return Note("printer", "", 1, message)
