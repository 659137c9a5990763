"""Computes part fan in percent and filament feed in mm/s from the positions in a printed G-code file, on the
clock of a klippy.log.

Klipper logs up to which byte it has run the printed file (sd_pos), and how far the planned motion is ahead of
now (buffer_time). The lines before that byte have moved when the planned motion is over:

    E(t + buffer_time(t)) = E of the lines before sd_pos(t)
    feed(t) = (E(t + dt) - E(t)) / dt                            dt: to the next Stats line

A Klipper of 2024 counts characters in sd_pos instead of bytes. It is wrong if a file is not ASCII.

The fan is set by the last M106 or M107 so far, or by a macro whose text in the configuration contains one. It
is 0 when Klipper starts. After a print it stays as the file left it. Between prints and in a pause the feed
is 0.

The printed file is in the log's folder or in its folder gcodes. It is the file with lines that end at the
log's positions. If several fit, it is the one that Moonraker's history or the log names.

Source: Klipper's virtual_sdcard.py, toolhead.py, gcode_move.py and fan.py.
"""

import filecmp
import itertools
import os
import re
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import orjson

from pipeline.recordings.formats import Note

FAN, FEED = "part_fan.speed", "filament.feed"
UNITS = {FAN: "percent", FEED: "mm/s"}
# kinds of notes: a print without its file, and what is left out of a file that was read
NOT_RECORDED, LEFT_OUT = "printed_file", "gcode"
SUFFIXES = (".gcode", ".g", ".gco")
FOLDER = "gcodes"  # beside the log, as Moonraker calls it
# most G-code files that are searched, most bytes read from all of them together, and the largest history in
# bytes
MOST_FILES, MOST_BYTES, LARGEST_HISTORY = 1000, 1 << 29, 1 << 25
BLOCK = 1 << 20  # a longer line is no command
# most positions of a print that are compared with the ends of a file's lines, and the share that must agree
MOST_POSITIONS, AGREEING_SHARE = 2000, 0.99
FEWEST_POSITIONS = 10  # so many positions tell a file without its name
# a job of the history begins within this many s of its print
SAME_START_S = 10.0
FILAMENT_TOLERANCE = 0.05
LONGEST_MOVE_MM = 1e5  # a line that feeds more is damaged
_COMMAND = re.compile(
    rb"^[ \t]*+(?:N\d++[ \t]*+)?(?:G0*[0-3](?![\d.])[^;\n]*?E[ \t]*([-+]?(?:\d+\.?\d*|\.\d+))"
    rb"|(G0*92|G9[01]|M8[23]|M10[67]|M221|G1[01]|T\d{1,3})(?![\w.])([^;\n]*)"
    rb"|([A-Z_]{3}\w{0,60}))",
    re.MULTILINE | re.IGNORECASE,
)
_WORDS = {
    letter: re.compile(letter + rb"[ \t]*([-+]?(?:\d{1,20}\.?\d{0,20}|\.\d{1,20}))", re.IGNORECASE)
    for letter in (b"E", b"P", b"S")
}
MOST_FAN_COMMANDS = 500_000
# commands of Klipper's own that move no filament and no part fan
_NO_MACRO = re.compile(
    r"SET_|TURN_OFF_HEATERS|EXCLUDE_OBJECT|TIMELAPSE|RESPOND|BED_MESH|(SAVE|RESTORE)_GCODE_STATE|TEMPERATURE_WAIT"
)


class Print(NamedTuple):
    """A print in the log: the position at which it starts; the position at which the file ended, -1 if it did
    not end; the file's name and size, "" and -1 if the log does not give them; and the log line at which the
    print begins."""

    start: int
    end: int
    name: str
    size: int
    line: int


class PrintRows(NamedTuple):
    """The Stats lines in the order of time, (n,) each: time and buffer_time in s, the position so far, the
    index of its print (-1 for none), and whether the file is being read."""

    time_s: np.ndarray
    buffer_s: np.ndarray
    position: np.ndarray
    print_index: np.ndarray
    reads: np.ndarray


class PrintedFile(NamedTuple):
    """The content of a printed file."""

    filament_mm: np.ndarray  # (n,) fed by the lines before each position
    unscaled_mm: np.ndarray  # (n,) without M221, as Klipper counts filament_used
    fan_positions: np.ndarray  # (m,) byte at which a command for the fan begins
    fan_percent: np.ndarray  # (m,) and what it requests
    remark: str  # what is left out or assumed, "" for nothing


# ---- a file


class _Reading:
    """The state of Klipper's gcode_move and part fan while the lines are read."""

    def __init__(self, macros: Mapping[str, float]):
        self.macros = macros
        self.filament = self.unscaled = self.origin = 0.0
        self.factor = 1.0
        self.is_absolute_move = self.is_absolute_e = True
        self.is_declared, self.feeds_undeclared = False, False
        self.fan_positions, self.fan_percent = array("q"), array("d")
        self.names: Counter[str] = Counter()
        self.left_out: Counter[str] = Counter()

    def move(self, number: bytes) -> None:
        fed = float(number) * self.factor
        self.feeds_undeclared |= not self.is_declared
        if self.is_absolute_e and self.is_absolute_move:
            fed += self.origin - self.filament
        if abs(fed) > LONGEST_MOVE_MM:
            self.left_out["damaged moves"] += 1
            return
        self.filament += fed
        self.unscaled += fed / self.factor

    def run(self, start: int, command: str, words: bytes) -> None:
        """Runs any command except a move."""
        match command:
            case "G90" | "G91":
                self.is_absolute_move = command == "G90"
            case "M82" | "M83":
                self.is_absolute_e, self.is_declared = command == "M82", True
            case "G92" if not words.strip() or _word(b"E", words) is not None:
                self.origin = self.filament - (_word(b"E", words) or 0.0) * self.factor
            case "M221" if 0 < (percent := _word(b"S", words) or 0.0) <= 1000:
                e = (self.filament - self.origin) / self.factor
                self.factor = percent / 100
                self.origin = self.filament - e * self.factor
            case "M106" | "M107" if _word(b"P", words):
                self.left_out["commands for other fans (M106 P)"] += 1
            case "M106" | "M107":
                self.set_fan(start, fan_percent(words) if command == "M106" else 0.0)
            case "G10" | "G11":
                self.left_out["firmware retractions (G10, G11)"] += 1
            case _ if command[0] == "T":
                self.origin, self.factor = self.filament, 1.0

    def call(self, start: int, name: str) -> None:
        if name in self.macros:
            self.set_fan(start, self.macros[name])
        if not _NO_MACRO.match(name) and len(self.names) < 20:
            self.names[name] += 1

    def set_fan(self, start: int, percent: float) -> None:
        if len(self.fan_percent) >= MOST_FAN_COMMANDS:
            self.left_out[f"commands for the fan beyond the first {MOST_FAN_COMMANDS}"] += 1
        elif not self.fan_percent or percent != self.fan_percent[-1]:
            self.fan_positions.append(start)
            self.fan_percent.append(percent)

    def remark(self) -> str:
        parts = [f"{count} {what}" for what, count in self.left_out.items()]
        if self.names:
            parts.append("filament that macros feed (" + ", ".join(list(self.names)[:6]) + ")")
        remark = "the feed and the fan leave out " + ", ".join(parts) if parts else ""
        absolute = (
            "E was taken as absolute until the file's first M82 or M83" if self.feeds_undeclared else ""
        )
        return "; ".join(filter(None, [remark, absolute]))


def _word(letter: bytes, words: bytes) -> float | None:
    number = _WORDS[letter].search(words)
    return float(number[1]) if number else None


def fan_percent(words: bytes) -> float:
    """Returns the fan speed in percent that M106 requests with these words: S from 0 to 255, full speed
    without an S."""
    speed = _word(b"S", words)
    return min(max(100 * (255.0 if speed is None else speed) / 255, 0.0), 100.0)


def read_file(path: Path, positions: np.ndarray, macros: Mapping[str, float]) -> PrintedFile:
    """Returns the filament at the positions (n,), ascending, and the fan's commands up to the last of them.
    `macros`: those that set the part fan, in percent. G2 and G3 feed like G1. Retractions and tool changes
    are counted as written."""
    state = _Reading(macros)
    filament, unscaled, k = np.zeros(len(positions)), np.zeros(len(positions)), 0
    wanted = [*positions.tolist(), np.inf]
    with path.open("rb") as stream:
        for offset, block in _blocks(stream):
            for line in _COMMAND.finditer(block):
                start = offset + line.start()
                while wanted[k] <= start:
                    filament[k], unscaled[k] = state.filament, state.unscaled
                    k += 1
                if k == len(positions):
                    break
                number, command, words, name = line.groups()
                if number:
                    state.move(number)
                elif command:
                    state.run(start, _plain(command), words)
                else:
                    state.call(start, name.decode().upper())
            if k == len(positions):
                break
    filament[k:], unscaled[k:] = state.filament, state.unscaled
    fan = np.array(state.fan_positions, np.int64), np.array(state.fan_percent, float)
    return PrintedFile(filament, unscaled, *fan, state.remark())


def _plain(command: bytes) -> str:
    """Returns "G92" for "g092"."""
    return command[:1].decode().upper() + str(int(command[1:]))


def _blocks(stream) -> Iterator[tuple[int, bytes]]:
    """Yields (offset, whole lines). If a line does not end within a block, its rest becomes a comment. A last
    line without an end is left out, because Klipper does not run it."""
    rest, offset = b"", 0
    while data := stream.read(BLOCK):
        block = rest + data
        cut = block.rfind(b"\n") + 1
        if cut:
            yield offset, block[:cut]
        rest, offset = block[cut:], offset + cut
        if len(rest) > BLOCK:
            rest, offset = b";", offset + len(rest) - 1


# ---- which file


def companions(log: Path) -> list[Path]:
    """Returns the G-code files and histories in a log's folder and in its folder `gcodes`, in the order of
    names."""
    places = itertools.chain(log.parent.glob("*"), (log.parent / FOLDER).rglob("*"))
    files = (path for path in places if path.suffix.lower() in SUFFIXES or is_history(path))
    try:
        return sorted(itertools.islice((path for path in files if path.is_file()), MOST_FILES))
    except OSError:
        return []


def is_history(path: Path) -> bool:
    """Returns whether a file is Moonraker's answer to /server/history/list, judged by its beginning."""
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    try:
        with path.open("rb") as stream:
            start = stream.read(4096)
    except OSError:
        return False
    return b'"jobs"' in start and b'"temperatures"' not in start


def _jobs(path: Path) -> list[dict]:
    """Returns the jobs of a history that have a file and a start. Raises ValueError if it cannot be read."""
    if path.stat().st_size > LARGEST_HISTORY:
        raise ValueError(f"has more than {LARGEST_HISTORY >> 20} MB")
    document = orjson.loads(path.read_bytes())
    answer = document.get("result", document) if isinstance(document, dict) else {}
    jobs = answer.get("jobs") if isinstance(answer, dict) else None
    return [
        job
        for job in (jobs if isinstance(jobs, list) else [])
        if isinstance(job, dict)
        and isinstance(job.get("filename"), str)
        and _is_number(job.get("start_time"))
    ]


def _note(kind: str, count: int, message: str) -> Note:
    """Returns a note in one line of text, for any bytes in the names of files."""
    return Note(kind, "", count, " ".join(message.encode("utf-8", "backslashreplace").decode().split()))


def _is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _job_of(jobs: Sequence[dict], start_s: float) -> dict:
    """Returns the job that runs at the start of a print, {} if none does."""
    running = [
        job
        for job in jobs
        if job["start_time"] - SAME_START_S <= start_s
        and (not _is_number(job.get("end_time")) or start_s <= job["end_time"] + SAME_START_S)
    ]
    return max(running, key=lambda job: job["start_time"], default={})


def misfit(path: Path, positions: np.ndarray, end: int, size: int = -1) -> str:
    """Returns why a file cannot be the printed one, "" if it may be. In the printed file, Klipper stood at
    these positions and the lines ended at `end`. `end` and `size` are -1 if the log does not give them."""
    own, last = path.stat().st_size, int(positions.max(initial=0))
    if size not in (-1, own) or own < last:
        return f"has {own} bytes"
    few = positions[np.linspace(0, len(positions) - 1, min(len(positions), MOST_POSITIONS)).astype(int)]
    with path.open("rb") as stream:
        file = stream.fileno()
        ends = [position == 0 or os.pread(file, 1, position - 1) == b"\n" for position in few.tolist()]
        if end >= 0 and (own - end > BLOCK or b"\n" in os.pread(file, BLOCK, end)):
            return f"has {own} bytes"
    if np.mean(ends) < AGREEING_SHARE:
        return f"has other lines (none ends at {ends.count(False)} of {len(ends)} positions of the log)"
    return ""


def _choose(
    candidates: Sequence[Path], name: str, positions: np.ndarray, of: Print
) -> tuple[Path | None, str]:
    """Returns (the file of a print, "") or (None, why there is none). `name`: the file's name in the history
    or the log, "" if neither has it."""
    misfits = {path: misfit(path, positions, of.end, of.size) for path in candidates}
    named = [path for path in candidates if path.name == Path(name).name]
    fitting = [path for path in candidates if not misfits[path]]
    if name and (len(positions) < FEWEST_POSITIONS or any(path in fitting for path in named)):
        fitting = [path for path in fitting if path in named]
    # copies of one file count once
    fitting = [p for i, p in enumerate(fitting) if not any(filecmp.cmp(p, q, False) for q in fitting[:i])]
    if len(fitting) == 1:
        return fitting[0], ""
    if fitting:
        names = " and ".join(path.name for path in fitting[:3])
        remedy = (
            "leave the printed one alone there, or add the answer of /server/history/list as history.json"
        )
        return None, f"expected one G-code file beside the log that fits, found {names}; {remedy}"
    size = f"{of.end}" if of.end >= 0 else f"at least {int(positions.max())}"
    counted = f"{len(candidates)} G-code files, none of which fits" if candidates else "no G-code file"
    problems = [f"{path.name} {misfits[path]}" for path in (named or candidates)]
    found = problems[0] if len(problems) == 1 else counted
    return None, (
        f"expected {name or 'the printed G-code file'} of {size} bytes, found {found}; put the file that was "
        f"printed beside the log or into {FOLDER}/"
    )


def _in_bytes(path: Path, positions: np.ndarray) -> np.ndarray:
    """Returns positions (n,), ascending, that count characters, as bytes; unchanged if the file is only
    ASCII. The first one beyond the file's end and all after it are one byte beyond it."""
    found, characters, offset = [], 0, 0
    wanted = positions.astype(np.int64)
    with path.open("rb") as stream:
        while data := stream.read(BLOCK):
            begins = np.flatnonzero((np.frombuffer(data, np.uint8) & 0xC0) != 0x80)
            here = wanted[len(found) :] - characters
            found += (offset + begins[here[here < len(begins)]]).tolist()
            characters, offset = characters + len(begins), offset + len(data)
    found += [offset if position == characters else offset + 1 for position in wanted[len(found) :].tolist()]
    return np.array(found, np.int64)


def _counted_in_characters(
    candidates: Sequence[Path], positions: np.ndarray, where: np.ndarray, prints: list[Print], i: int
) -> Path | None:
    """Returns the only file that fits print i at the rows `where` if its positions count characters, None if
    there is no such file. Positions and print are then converted to bytes."""
    of, own = prints[i], np.unique(np.r_[prints[i].start, positions[where], max(prints[i].end, 0)])
    fitting = []
    for path in candidates:
        moved = dict(zip(own.tolist(), _in_bytes(path, own).tolist(), strict=True))
        at, end = np.array([moved[int(x)] for x in positions[where]]), moved.get(of.end, -1)
        if any(old != new for old, new in moved.items()) and not misfit(path, np.unique(at), end, of.size):
            fitting.append((path, at, of._replace(start=moved[of.start], end=end)))
    if len(fitting) != 1:
        return None
    ((path, positions[where], prints[i]),) = fitting
    return path


# ---- signals


class PrintSignals(NamedTuple):
    """Part fan and feed (n,) by name, none if no print has its file; notes; and the files that they come
    from."""

    values: dict[str, np.ndarray]
    notes: list[Note]
    files: list[Path]


def print_signals(
    log: Path, rows: PrintRows, prints: Sequence[Print], start_s: float, macros: Mapping[str, float]
) -> PrintSignals:
    """Returns part fan and filament feed at the rows of a log; NaN in a print with an unknown file.
    `start_s`: time of day of the first row, NaN if unknown."""
    notes: list[Note] = []
    rows, prints = rows._replace(position=rows.position.copy()), list(prints)
    indices = [int(i) for i in dict.fromkeys(rows.print_index.tolist()) if i >= 0]
    if not indices:
        message = (
            f"{FAN} and {FEED} are not recorded: the log has no sd_pos, the place in a printed file; print "
            "from Klipper's virtual SD card (Mainsail, Fluidd), as a file that OctoPrint streams has none"
        )
        return PrintSignals({}, [_note(NOT_RECORDED, 1, message)], [])
    places = {i: np.flatnonzero(rows.print_index == i) for i in indices}
    files, jobs, histories = _files_of(log, rows, prints, places, start_s, notes)
    contents = _contents(files, rows, prints, places, macros, notes)
    files = {i: path for i, path in files.items() if path in contents}
    if not files:
        return PrintSignals({}, notes, [])
    filament, fan = _on_rows(rows, prints, places, files, contents)
    for i, job in jobs.items():
        if i in files and prints[i].start == 0:
            positions, content = contents[files[i]]
            printed = content.unscaled_mm[np.searchsorted(positions, rows.position[places[i]].max())]
            notes += _filament_note(files[i], float(printed), job.get("filament_used"))
    used = list(dict.fromkeys(files.values()))
    message = f"{FAN} and {FEED} are those of {', '.join(path.name for path in used[:6])} in {len(files)} of "
    notes.append(_note(LEFT_OUT, len(files), message + f"{len(indices)} prints"))
    return PrintSignals({FAN: fan, FEED: filament}, notes, used + histories)


def _files_of(log, rows: PrintRows, prints: list[Print], places, start_s: float, notes: list[Note]):
    """Returns ({print: its file}, {print: its job}, the histories that were read). Adds a note for each
    reason why a print has no file. Positions that count characters are converted to bytes."""
    beside = companions(log)
    jobs, histories = [], []
    for path in (path for path in beside if path.suffix.lower() == ".json"):
        try:
            jobs += _jobs(path)
            histories.append(path)
        except (OSError, ValueError) as error:
            message = f"{path.name} should be Moonraker's history but cannot be read ({error}); save it again"
            notes.append(_note(NOT_RECORDED, 1, message))
    candidates = [path for path in beside if path not in histories and path.suffix.lower() in SUFFIXES]
    files, job_of, reasons = {}, {}, {}
    for i, where in places.items():
        positions = np.unique(rows.position[where])
        job_of[i] = _job_of(jobs, start_s + rows.time_s[where[0]])
        name = job_of[i].get("filename", "") or prints[i].name
        try:
            path, reason = _choose(candidates, name, positions, prints[i])
            path = path or _counted_in_characters(candidates, rows.position, where, prints, i)
        except OSError as error:
            path, reason = None, f"a G-code file cannot be read ({error.strerror}); copy it again"
        if path:
            files[i] = path
        else:
            reasons.setdefault(reason, []).append(prints[i].line)
    for reason, lines in list(reasons.items())[:6]:
        which = f"{len(lines)} of {len(places)} prints, the first from line {lines[0]} on"
        message = f"{FAN} and {FEED} are not recorded in {which}: {reason}"
        notes.append(_note(NOT_RECORDED, len(lines), message))
    return files, job_of, histories


def _contents(files, rows: PrintRows, prints, places, macros, notes: list[Note]):
    """Returns {file: (positions, its content there)}. Each file is read once."""
    contents, budget = {}, MOST_BYTES
    for path in dict.fromkeys(files.values()):
        own = [i for i in files if files[i] == path]
        positions = np.unique(np.concatenate([[prints[i].start, *rows.position[places[i]]] for i in own]))
        budget -= int(positions[-1])
        if budget < 0:
            message = (
                f"{FAN} and {FEED} of {path.name} are not recorded: the printed files have more than "
                f"{MOST_BYTES >> 20} MB; split the log"
            )
            notes.append(_note(NOT_RECORDED, len(own), message))
            continue
        content = read_file(path, positions.astype(np.int64), macros)
        contents[path] = positions, content
        if content.remark:
            notes.append(_note(LEFT_OUT, 1, f"{path.name}: {content.remark}"))
    return contents


def _on_rows(rows: PrintRows, prints, places, files, contents) -> tuple[np.ndarray, np.ndarray]:
    """Returns (feed, fan) at the rows (n,): the mean feed until the next row, the fan halfway to it."""
    count = len(rows.time_s)
    moved_s = np.maximum.accumulate(rows.time_s + rows.buffer_s)
    filament, unknown, total = np.zeros(count), np.zeros(count, bool), 0.0
    events = [_event(-np.inf, 0.0)]  # (time, percent) of the fan, (m, 2)
    starts = [where[0] for where in places.values()] + [count]
    for (i, where), following in zip(places.items(), starts[1:], strict=True):
        first = where[0]
        filament[first:following] = total
        before_s = moved_s[first - 1] if first else -np.inf
        if i not in files:
            unknown[where] = rows.reads[where] | (rows.buffer_s[where] > 0)
            events.append(_event(before_s, np.nan))
            continue
        known, content = contents[files[i]]
        at = np.searchsorted(known, [prints[i].start, *rows.position[where]])
        filament[where] = total + content.filament_mm[at[1:]] - content.filament_mm[at[0]]
        total = filament[where[-1]]
        filament[where[-1] : following] = total
        events.append(_fan_events(content, prints[i].start, rows.position[where], moved_s[where], before_s))
    # a restart of Klipper switches the fan off
    restarts = np.flatnonzero((rows.print_index[1:] < 0) & (rows.print_index[:-1] >= 0)) + 1
    events += [_event(time, 0.0) for time in rows.time_s[restarts].tolist()]
    step_s = np.diff(rows.time_s, append=np.nan)
    step_s[-1] = np.median(step_s[:-1]) if count > 1 else 1.0
    at_row, behind = (np.interp(time, moved_s, filament) for time in (rows.time_s, rows.time_s + step_s))
    times, percent = np.vstack(events)[np.argsort(np.vstack(events)[:, 0], kind="stable")].T
    fan = percent[np.searchsorted(times, rows.time_s + step_s / 2, side="right") - 1]
    return np.where(unknown, np.nan, (behind - at_row) / step_s), fan


def _event(time_s: float, percent: float) -> np.ndarray:
    return np.array([[time_s, percent]])


def _fan_events(content: PrintedFile, start: int, positions, moved_s, before_s: float) -> np.ndarray:
    """Returns (time, percent) (m, 2) of the fan's commands in a print. If the log begins within the print,
    the last command before is included."""
    known = np.maximum.accumulate(np.r_[start, positions])
    at, percent = content.fan_positions, content.fan_percent
    inside = (at >= start) & (at < known[-1])
    times = np.interp(at[inside], known, np.r_[max(before_s, moved_s[0] - 1.0), moved_s])
    before = [_event(before_s, p) for p in percent[at < start][-1:]]
    return np.vstack([*before, np.column_stack([times, percent[inside]])])


def _filament_note(path: Path, printed_mm: float, used_mm) -> list[Note]:
    """Returns a note if the length of filament in the history differs from that of the file's lines."""
    if not _is_number(used_mm) or abs(printed_mm - used_mm) <= FILAMENT_TOLERANCE * max(used_mm, 1.0):
        return []
    message = (
        f"{path.name} feeds {printed_mm:.0f} mm of filament up to its last position, but Moonraker's history "
        f"has {used_mm:.0f} mm; macros feed the difference, or the file was changed: check the feed"
    )
    return [_note(LEFT_OUT, 1, message)]
