"""Reads G-code of every dialect into moves. The state (units, modes, offsets, tools) is resolved over whole
columns instead of line by line.

There are three steps: bytes -> words (gcode_words), words -> commands, commands -> moves. They run on one
chunk of lines at a time and hand the state on to the next chunk. What drives the extrusion is known only when
all chunks are read.
"""

import collections
import enum
import functools
import operator
from typing import NamedTuple

import numpy as np

from pipeline.deposition.toolpath.gcode_words import (
    CHAINED,
    LineRefusal,
    ProgramWords,
    Refusals,
    chunks,
    no_program,
    text_bytes,
)

__all__ = ["Accounted", "Kind", "Moves", "PartProgram", "LineRefusal", "OtherWord", "parse"]

# EXTRUDE travels with E > 0, WIPE with E < 0; RETRACT, UNRETRACT and PRIME (more than was retracted before)
# move E alone; TOOL changes the tool
Kind = enum.IntEnum("Kind", "TRAVEL EXTRUDE WIPE RETRACT UNRETRACT PRIME DWELL TOOL HOME", start=0)


class Moves(NamedTuple):
    """N moves in their order. start and end (N, 3) in mm form one chain from 0 0 0. G92 does not break it,
    because G92 renames places and moves nothing.

    line: number from 1. length: mm along the path, with the true length of arcs and helices. e: mm of
    filament or plunger as programmed (mm^3 if M200 says so); mm of path if a switch drives extrusion. feed:
    mm/s with M220's factor, NaN before the first F. tool: the tool in use; for TOOL the new one. centre (N,
    2) in mm and angle in rad (+ counter-clockwise, whole turns included): of arcs; NaN and 0 for lines.
    dwell_s: of DWELL. acceleration: mm/s^2 by M204 or SET_VELOCITY_LIMIT, NaN if the program gave none.
    """

    line: np.ndarray
    kind: np.ndarray
    start: np.ndarray
    end: np.ndarray
    length: np.ndarray
    e: np.ndarray
    feed: np.ndarray
    tool: np.ndarray
    centre: np.ndarray
    angle: np.ndarray
    dwell_s: np.ndarray
    acceleration: np.ndarray


class OtherWord(NamedTuple):
    """A word that is no move, reported once: how often it occurs, its first line, and how it is treated (""
    if nothing is known of it)."""

    word: str
    count: int
    line: int
    what: str


class Accounted(NamedTuple):
    """Numbers of lines. `blank`: empty or comment; `moved`: move; `read`: only set something; `other`: hold
    words without meaning for moves; `refused`: refused. Together they are all lines of the program."""

    blank: int
    moved: int
    read: int
    other: int
    refused: int


class PartProgram(NamedTuple):
    """The moves; the words without meaning for them, in their order (other_line (M,), other_word (M,)); the
    refusals, one per kind; `extruder`: what drives the extrusion (E, U, A, M42 P4, ..., or "" for nothing);
    the number of lines.

    flow (N,): M221's factor on E. volumetric (N,): whether E counts mm^3 (M200). diameter_mm: diameter of
    what E pushes, by tool, as the program gives it. told: the other words, each once. refused_line (R,):
    every refused line.
    """

    moves: Moves
    other_line: np.ndarray
    other_word: np.ndarray
    refusals: list[LineRefusal]
    extruder: str
    lines: int
    flow: np.ndarray
    volumetric: np.ndarray
    diameter_mm: dict[int, float]
    told: list[OtherWord]
    accounted: Accounted
    refused_line: np.ndarray


M, T, MODAL, REFUSED = 1_000_000, 100_000_000, -1, -2
MOTION = (0, 10, 20, 30)
# G words that leave X Y Z on their line to the motion in force
SETTINGS = (*range(170, 220, 10), 400, 490, *range(530, 600, 10), 640, 900, 910, 940)
APPLIED = {M + 2000: "E counts mm^3", M + 2200: "applied to the feed", M + 2210: "applied to E"}
MEANT = (
    *MOTION, 40, 170, 180, 190, 200, 210, 280, 900, 901, 910, 911, 920, M + 820, M + 830, M + 2040, *APPLIED,
)  # fmt: skip
UNSUPPORTED = {
    50: "G5 is not supported; export arcs or lines",
    921: "G92.1 is not supported; write G92 and the coordinates",
}
# words whose numbers are used as they are: key, letters, least and largest
BOUNDS = (
    (M + 2000, "D", 0.0, 200.0), (M + 2200, "S", 1.0, 10_000.0), (M + 2210, "S", 0.0, 10_000.0),
    (M + 2040, "PS", 0.0, 1e9),
)  # fmt: skip
SLOWEST = 1e-3  # mm/min
LETTERS = "XYZEABCUIJRFPSTLD"
AXIS = np.isin(np.arange(256), np.frombuffer(b"XYZEABCUIJRF", np.uint8))
DRIVERS = "EUABC"
# the M words that switch extrusion on and off, the most specific first; an on word with S0 is off
SWITCHES = {
    "M760": ((760, 762), (761, 763)), "M126": ((126,), (127,)), "M101": ((101,), (103,)), "M42": ((42,), ()),
    "M64": ((62, 64), (63, 65)),
    "M7": ((7, 8), (9,)), "M3": ((3, 4), (5,)), "M10": ((10,), (11,)), "M106": ((106,), (107,)),
}  # fmt: skip
SWITCHING = np.array([M + 10 * k for on, off in SWITCHES.values() for k in on + off])
PINS = 64  # of M42
TOOLS = 64  # T255, T1000, ... are words of one maker's machine, not tools
TINY = 1e-9  # mm: below every resolution and above rounding
# how words that slicers write into every program are treated
KNOWN = {
    "temperatures: none of a move's": "M104 M109 M140 M190 M141 M191 M116 G10",
    "fans and lamps: none of a move's": "M106 M107 M150 M355",
    "words to people and hosts": "M73 M75 M77 M105 M110 M114 M115 M117 M118 M300 M862 M862.3 M862.1 M862.6",
    "limits and tuning of the firmware, which plans with its own": "M201 M203 M205 M566 M593 M900 M92 M301 "
    "M304 M572 SET_PRESSURE_ADVANCE SET_VELOCITY_LIMIT",
    "motors on and off": "M17 M18 M84 M80 M81",
    "names objects; all of them are composed": "M486 EXCLUDE_OBJECT_DEFINE EXCLUDE_OBJECT_START "
    "EXCLUDE_OBJECT_END M624 M625",
    "leaves an object out on the machine; here it is composed": "EXCLUDE_OBJECT",
    "waits": "M400 M0 M1 M25 M226 M600 M601",
}
BECOMES = {word: what for what, words in KNOWN.items() for word in words.split()}
CUBIC = b";FLAVOR:UltiGCode"  # Cura's word for machines whose E counts mm^3
DIAMETERS = (b"filament_diameter", b"filamentDiameters", b"fiber_dia_mm", b"Filament Diameter")


class Place(NamedTuple):
    """The place on one axis: as the program names it, and the shift by G92 since the last G28."""

    named: float = 0.0
    shift: float = 0.0


class ProgramState:
    """The state that the lines so far leave in force for the next lines."""

    def __init__(self) -> None:
        self.unit, self.motion, self.plane, self.tool = 1.0, 10, 170, 0
        self.relative = self.e_relative = self.e_follows = self.absolute_arcs = False
        self.feed, self.acceleration, self.speed, self.kept_speed = np.nan, np.nan, 1.0, 1.0
        self.place = dict.fromkeys("XYZ", Place())
        self.e: dict[tuple[str, int], Place] = {}
        self.switch: dict[str, bool] = {}
        self.flow: dict[int, float] = {}
        self.volumetric: dict[int, bool] = {}
        self.cubic = False  # E counts mm^3 where no M200 says otherwise
        self.diameter: dict[int, float] = {}


class Commands(NamedTuple):
    """C commands: line and key (G1 is 10, G92.1 is 921, M and T start at their offsets), the words by letter
    in mm (NaN if absent), the number of words of each command, and the letter that leads it."""

    line: np.ndarray
    key: np.ndarray
    word: dict[str, np.ndarray]
    words: np.ndarray
    lead: np.ndarray


class Gathered:
    """Everything collected from the chunks: the columns of the moves, E by every letter and every switch that
    may drive the extrusion, the lines of their words, and all other words. The columns have room for one move
    per line, and take memory only once they are written."""

    def __init__(self, lines: int) -> None:
        self.rows, self.room = 0, lines + 1
        self.columns: list[np.ndarray] = []
        self.driven: dict[str, np.ndarray] = {}  # by letter or switch
        self.lines_of: dict[str, list[tuple[int, str]]] = {}  # words of a letter alone or of a switch
        self.beside: dict[str, list[int]] = {}  # letters beside moves: count and first line
        self.others: list[tuple[int, str]] = []
        self.applied: dict[int, list[int]] = {}
        self.filled, self.words = 0, 0

    def add(self, columns: tuple[np.ndarray, ...], driven: dict[str, np.ndarray]) -> None:
        """Appends the moves of a chunk to those before. The column of a letter or switch is 0 in the chunks
        without it."""
        self.columns = self.columns or [np.zeros((self.room, *c.shape[1:]), c.dtype) for c in columns]
        for name in driven.keys() - self.driven.keys():
            self.driven[name] = np.zeros(self.room, driven[name].dtype)
        to = self.rows + len(columns[0])
        if to > self.room:  # several commands in many lines
            self.room = 2 * to
            self.columns = [_longer(column, self.room) for column in self.columns]
            self.driven = {name: _longer(column, self.room) for name, column in self.driven.items()}
        for whole, column in zip(self.columns, columns, strict=True):
            whole[self.rows : to] = column
        for name, column in driven.items():
            self.driven[name][self.rows : to] = column
        self.rows = to


def _longer(column: np.ndarray, room: int) -> np.ndarray:
    longer = np.zeros((room, *column.shape[1:]), column.dtype)
    longer[: len(column)] = column
    return longer


def parse(text: str | bytes, *, extruder: str = "") -> PartProgram:
    """Reads the moves of a program, and lists all that was not understood. `extruder` names what drives the
    extrusion ("U", "M42 P4", ...); if it is "", the program decides.

    Raises ValueError, in one sentence, if the text is no G-code at all: binary, empty, or without a single G,
    M or T word that can be read. Raises ValueError also if the program does not have this extruder.
    """
    data, refusals, state = text_bytes(text), Refusals(), ProgramState()
    lines, state.cubic = data.count(b"\n"), CUBIC in data[:4096]
    out, gmt = Gathered(lines), np.frombuffer(b"GMT", np.uint8)
    for words in chunks(data, refusals):
        out.words += int(np.isin(words.letter, gmt).sum())
        out.filled += words.filled
        out.others += words.others
        if len(words.line) or not out.columns:
            _gather(_commands(words, state, refusals), state, refusals, out)
    if not out.words:
        raise no_program(data, lines, refusals)
    moves, driver, flow, volumetric = _moved(out, extruder)
    others = out.others + [
        pair for name, pairs in out.lines_of.items() if name not in driver for pair in pairs
    ]
    others.sort(key=operator.itemgetter(0))
    other_line = np.fromiter((line for line, _ in others), int, len(others))
    other_word = np.array([word for _, word in others], object)
    refused = np.unique(np.array(refusals.lines, int))
    return PartProgram(
        moves, other_line, other_word, refusals.grouped(), _shown(driver), lines, flow, volumetric,
        _said(data) | {tool: d for tool, d in state.diameter.items() if d > 0},
        _told(others, out, driver), _accounted(lines, out.filled, moves.line, other_line, refused), refused,
    )  # fmt: skip


# ---- words -> commands


def _commands(words: ProgramWords, state: ProgramState, refusals: Refusals) -> Commands:
    """Splits the words into commands. A command begins at the first word of a line, and at each G or M word
    unless an M word before it takes the whole line."""
    line, letter, value = words[:3]
    if np.any(letter == ord("N")):
        line, letter, value = (column[letter != ord("N")] for column in (line, letter, value))
    leads = np.append(True, line[1:] != line[:-1])[: len(line)]
    m = (letter == ord("M")) & ~_pin_modes(letter, value, leads)
    begins = leads | m | (letter == ord("G"))
    if np.count_nonzero(begins) > np.count_nonzero(leads):
        takes = m & ~np.isin(value, CHAINED)
        before = np.cumsum(takes) - takes
        begins &= leads | (before == before[_last(leads)])
    first, block = np.flatnonzero(begins), np.cumsum(begins) - 1
    key = np.where(AXIS[letter[first]], MODAL, -letter[first].astype(int))
    for base, code in ((0, ord("G")), (M, ord("M")), (T, ord("T"))):
        at = np.flatnonzero((letter[first] == code) & (value[first] >= 0) & (value[first] < 50_000))
        key[at] = base + np.rint(10 * value[first[at]]).astype(int)
    apart = np.flatnonzero(np.isin(key, SETTINGS)[block] & AXIS[letter])
    if len(apart):
        # G0 G90 X10: the axes belong to the motion, not to the setting right before them
        apart = apart[np.unique(block[apart], return_index=True)[1]]
        key, begins[apart] = np.insert(key, block[apart] + 1, MODAL), True
        first, block = np.flatnonzero(begins), np.cumsum(begins) - 1
    held = _held(key, np.isin(key, MOTION), state.motion)
    state.motion = int(held[-1]) if len(held) else state.motion
    lead = np.where(key == MODAL, letter[first], 0)
    commands = Commands(line[first], np.where(key == MODAL, held, key), {}, np.bincount(block), lead)
    return _with_words(commands, block, letter, value, state, refusals)


def _pin_modes(letter: np.ndarray, value: np.ndarray, leads: np.ndarray) -> np.ndarray:
    """Returns which words are M0 to M3 after an M42 on the same line: these are the mode of its pin, not
    commands."""
    m = letter == ord("M")
    modes = m & ~leads & np.isin(value, (0, 1, 2, 3))
    if modes.any():
        owner = _last(leads | (m & ~modes) | (letter == ord("G")))
        modes &= m[owner] & (value[owner] == 42)
    return modes


def _with_words(
    commands: Commands, block, letter, value, state: ProgramState, refusals: Refusals
) -> Commands:
    """Returns the commands with their words. Refuses a letter that is given twice, a word beside a command
    that takes none, a number far out of range, and an unsupported command."""
    line, key, word, words, lead = commands
    unit = _held(np.where(key == 200, 25.4, 1.0), np.isin(key, (200, 210)), state.unit)
    state.unit = float(unit[-1]) if len(unit) else state.unit
    twice, absent = np.zeros(len(key), bool), np.full(len(key), np.nan)
    known = np.ones(len(key), int)
    for name in LETTERS:
        at = np.flatnonzero(letter == ord(name))
        if not len(at):
            word[name] = absent
            continue
        word[name] = absent.copy()
        word[name][block[at]] = value[at]
        given = np.bincount(block[at], minlength=len(key))
        twice |= (given > 1) & np.isin(key, (*MOTION, 920))
        word[name] *= unit if AXIS[ord(name)] else 1.0
        known += given * (name in "PSIT")
    _refuse(refusals, line, twice, "expected each letter once in a command, found one twice; write two lines")
    for code, why in UNSUPPORTED.items():
        _refuse(refusals, line, key == code, why)
    wild = np.zeros(len(key), bool)
    for code, letters, low, high in BOUNDS:
        for c in letters:
            outside = np.isfinite(word[c]) & ~((word[c] >= low) & (word[c] <= high))
            wild |= (key == code) & (outside | np.isinf(word[c]))
    wild |= np.isin(key, MOTION) & (word["F"] > 0) & (word["F"] < SLOWEST)
    _refuse(refusals, line, wild, "expected a number that a machine can take, found one far outside")
    settings = ~wild & np.isin(key, (M + 2000, M + 2040, M + 2200, M + 2210)) & np.isfinite(word["E"])
    why = "expected no E beside M200, M204, M220 or M221, found one; write numbers without an exponent"
    _refuse(refusals, line, settings, why)
    chained = (key >= M) & (key < T) & np.isin((key - M) / 10, CHAINED)
    axes = chained & ~_none(word, "XYZ")
    _refuse(refusals, line, axes, "expected no X, Y or Z beside an M word, found some; write two lines")
    if np.any(pins := key == M + 420):
        known += np.bincount(block[letter == ord("M")], minlength=len(key)) - (key >= M) * (key < T)
        why = "expected P and S beside M42, found other words; the pin is switched without them"
        _refuse(refusals, line, pins & (known < words) & ~axes, why)
    key[twice | wild | settings | np.isin(key, tuple(UNSUPPORTED))] = REFUSED
    return commands


def _name(key: int) -> str:
    letter, base = ("T", T) if key >= T else ("M", M) if key >= M else ("G", 0)
    return chr(-key) if key < 0 else f"{letter}{(key - base) / 10:g}"


def _refuse(refusals: Refusals, line: np.ndarray, where: np.ndarray, why: str) -> None:
    refusals.add(line[where].tolist(), why)


def _last(mask: np.ndarray) -> np.ndarray:
    """Returns the index of the last True up to each place, -1 before the first."""
    return np.maximum.accumulate(np.where(mask, np.arange(len(mask)), -1))


def _held(values: np.ndarray, mask: np.ndarray, start) -> np.ndarray:
    """Returns the value at the last True of the mask, `start` before the first: the value that a modal word
    leaves in force."""
    return np.append(values, start)[_last(mask)]


def _none(word: dict[str, np.ndarray], letters: str) -> np.ndarray:
    return functools.reduce(operator.and_, (np.isnan(word[c]) for c in letters))


# ---- commands -> moves


def _gather(commands: Commands, state: ProgramState, refusals: Refusals, out: Gathered) -> None:
    """Appends the moves of a chunk of commands to those before, with every column that may drive E."""
    line, key, word, words, lead = commands
    if not len(key):
        return
    motion, home, dwell = np.isin(key, MOTION), key == 280, key == 40
    relative = _held(key == 910, np.isin(key, (900, 910)), state.relative)
    tool, selects, changes = _tools(key, word, state)
    alone, bare = _none(word, "XYZ"), (key == 920) & (words == 1)
    before, after = np.zeros((len(key), 3)), np.zeros((len(key), 3))
    for k, c in enumerate("XYZ"):
        homes, given = home & (alone | ~np.isnan(word[c])), np.isfinite(word[c])
        names, adds = (key == 920) & given | bare, motion & given & relative
        before[:, k], after[:, k], state.place[c] = _place(
            word[c], adds, names, homes, names | homes | motion & given & ~relative, state.place[c]
        )
    arc = np.isin(key, (20, 30)) & ~_none(word, "XYIJR")
    centre, angle, length = _arcs(commands, before, after, arc, state, refusals)
    firmware = np.isin(key, (100, 110)) & _none(word, "PLXYZ")  # with P or L: temperatures and offsets
    columns = _driven(commands, motion, relative, bare, tool, state) | _switched(
        key, word, state, refusals, line
    )
    feed, acceleration, pause = _pace(key, word, motion, dwell, state)
    flow, volumetric = _flow(key, word, tool, state)
    what = np.select([home, dwell, changes, firmware & (key == 100), firmware],
                     [Kind.HOME, Kind.DWELL, Kind.TOOL, Kind.RETRACT, Kind.UNRETRACT], 0)  # fmt: skip
    some = functools.reduce(
        operator.or_,
        (np.abs(e) > TINY for e in columns.values() if e.dtype == float),
        np.zeros(len(key), bool),
    )
    travel = np.abs(after - before) > TINY
    planar, vertical = travel[:, :2].any(axis=1) | arc, travel[:, 2]
    rows = motion & np.isfinite(length) & (planar | vertical | some) | (what > 0)
    found = (
        line, before, after, length, feed, tool, centre, angle, pause, acceleration, flow, volumetric,
        what.astype(np.int8), planar, vertical,
    )  # fmt: skip
    out.add(tuple(column[rows] for column in found), {name: e[rows] for name, e in columns.items()})
    state.relative = bool(relative[-1])
    _words_left(commands, motion, selects | firmware, out)


def _tools(key, word, state: ProgramState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the tool in use at each command, which commands select a tool, and which of them change it."""
    selects = (key >= T) & (key < T + 10 * TOOLS) | np.isin(key, (M + 60, M + 1350)) & np.isfinite(word["T"])
    asked = np.clip(np.nan_to_num(word["T"]), 0, T).astype(int)
    tool = _held(np.where(key >= T, (key - T) // 10, asked), selects, state.tool)
    changes = selects & (tool != np.append(state.tool, tool[:-1]))
    state.tool = int(tool[-1])
    return tool, selects, changes


def _place(value, adds, names, homes, sets, start: Place) -> tuple[np.ndarray, np.ndarray, Place]:
    """Returns the place on one axis before and after each command, and the state after the last command. A
    place is the last value set, plus everything added since, plus all shifts by G92 since the last G28."""
    value = np.where(np.isfinite(value) & ~homes, value, 0.0)
    run = np.cumsum(np.where(adds, value, 0.0))
    after = _held(value, sets, start.named) + (run - _held(run, sets, 0.0))
    end = Place(float(after[-1]), start.shift)
    if start.shift or names.any():
        shift = start.shift + np.cumsum(np.where(names, np.append(start.named, after[:-1]) - after, 0.0))
        gone = _held(shift, homes, 0.0)
        after, end = after + shift - gone, end._replace(shift=float(shift[-1] - gone[-1]))
    return np.append(start.named + start.shift, after[:-1]), after, end


def _driven(commands: Commands, motion, relative, bare, tool, state: ProgramState) -> dict[str, np.ndarray]:
    """Returns the E of each command for each letter that may drive the extrusion. E is counted for each tool
    separately. G91 makes E relative too, until an M82."""
    _, key, word, _, _ = commands
    modes = np.isin(key, (M + 820, M + 830))
    by_word = _held(key == M + 830, modes, state.e_relative)
    follows = _held(key != M + 820, np.isin(key, (900, 910, M + 820)), state.e_follows)
    state.e_relative, state.e_follows = bool(by_word[-1]), bool(follows[-1])
    relative, columns = by_word | relative & follows, {}
    for c in DRIVERS:
        given, names = motion & np.isfinite(word[c]), (key == 920) & np.isfinite(word[c]) | bare
        if not given.any() and not (names.any() and any(held == c for held, _ in state.e)):
            continue
        e, adds = np.zeros(len(key)), given & relative
        for k in np.unique(tool).tolist():
            at = np.flatnonzero(tool == k)
            columns_of = (word[c], adds, names, np.zeros(len(key), bool), names | given & ~relative)
            before, after, state.e[c, k] = _place(*(a[at] for a in columns_of), state.e.get((c, k), Place()))
            e[at] = np.where(given[at], np.where(relative[at], word[c][at], after - before), 0.0)
            state.e[c, k] = Place(state.e[c, k].named)  # E is counted, not placed: no use for the shift
        columns[c] = e
    return columns


def _switched(key, word, state: ProgramState, refusals: Refusals, line) -> dict[str, np.ndarray]:
    """Returns whether each switch is on at each command, by its name; M42 by its pin."""
    columns = {}
    for name, (on, off) in SWITCHES.items():
        switch = np.isin(key, M + 10 * np.array(on + off))
        opens = np.isin(key, M + 10 * np.array(on)) & (word["S"] != 0)
        pins = {name: switch}
        if name == "M42" and switch.any():
            pin = np.where(np.isfinite(word["P"]), word["P"], -1)
            known = [k for k in state.switch if k.startswith("M42")]
            found = np.unique(pin[switch])
            new = [k for k in found.tolist() if _pin(k) not in known]
            for k in new[max(PINS - len(known), 0) :]:
                why = f"expected at most {PINS} pins of M42, found more"
                _refuse(refusals, line, switch & (pin == k), why)
                found = found[found != k]
            pins = {_pin(k): switch & (pin == k) for k in found.tolist()}
        pins |= {k: np.zeros(len(key), bool) for k in state.switch if k.split()[0] == name and k not in pins}
        for each, at in pins.items():
            if at.any() or each in state.switch:
                columns[each] = _held(opens, at, state.switch.get(each, False))
                state.switch[each] = bool(columns[each][-1])
    return columns


def _pin(number: float) -> str:
    return f"M42 P{number:g}" if number >= 0 else "M42"


def _pace(key, word, motion, dwell, state: ProgramState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the feed in mm/s with M220's factor, the acceleration in mm/s^2, and the duration of each dwell
    in s."""
    plain = _held(word["F"] / 60, motion & (word["F"] > 0), state.feed)
    events, factor = key == M + 2200, np.ones(len(key))
    speed = state.speed
    for k in np.flatnonzero(events).tolist():  # B keeps the factor, R brings the kept one back
        if np.isfinite(word["B"][k]):
            state.kept_speed = speed
        speed = state.kept_speed if np.isfinite(word["R"][k]) else speed
        speed = word["S"][k] / 100 if word["S"][k] > 0 else speed
        factor[k] = speed
    factor = _held(factor, events, state.speed)
    asked = np.where(np.isfinite(word["P"]), word["P"], word["S"])
    acceleration = _held(asked, (key == M + 2040) & (asked > 0), state.acceleration)
    seconds = np.where(np.isfinite(word["S"]), word["S"], np.nan_to_num(word["P"]) / 1000)
    state.feed, state.speed, state.acceleration = float(plain[-1]), speed, float(acceleration[-1])
    return plain * factor, acceleration, np.where(dwell, np.maximum(seconds, 0.0), 0.0)


def _flow(key, word, tool, state: ProgramState) -> tuple[np.ndarray, np.ndarray]:
    """Returns M221's factor on E, and whether E counts mm^3 (M200), for the tool of each command."""
    flow, volumetric = np.ones(len(key)), np.zeros(len(key), bool)
    named = np.where(np.isfinite(word["T"]), word["T"], tool)
    percent = (key == M + 2210) & (word["S"] >= 0)
    named = np.where((key == M + 2210) & np.isfinite(word["D"]), word["D"], named)
    sizes = key == M + 2000
    for k in np.flatnonzero(sizes & (word["D"] > 0) & (named < TOOLS)).tolist():
        state.diameter[int(named[k])] = float(word["D"][k])
    # S0 or D0 is off; a diameter alone, or S1, is on
    counts = np.where(np.isfinite(word["S"]), word["S"] > 0, word["D"] > 0)
    sizes &= np.isfinite(word["S"]) | np.isfinite(word["D"])
    percent, sizes = (events & (named >= 0) & (named < TOOLS) for events in (percent, sizes))
    for k in np.unique(np.append(tool, named[percent | sizes])).tolist():
        k, mine = int(k), tool == k
        share = _held(word["S"] / 100, percent & (named == k), state.flow.get(k, 1.0))
        cubic = _held(counts, sizes & (named == k), state.volumetric.get(k, state.cubic)).astype(bool)
        flow[mine], volumetric[mine] = share[mine], cubic[mine]
        state.flow[k], state.volumetric[k] = float(share[-1]), bool(cubic[-1])
    return flow, volumetric


def _words_left(commands: Commands, motion: np.ndarray, meant: np.ndarray, out: Gathered) -> None:
    """Adds to `out` the words that are no moves, the letters beside moves, and the words that may turn out to
    switch or to drive the extrusion."""
    line, key, word, _, lead = commands
    switching = np.isin(key, SWITCHING)
    left = np.flatnonzero(~(np.isin(key, MEANT) | meant | switching) & (key != REFUSED))
    out.others += zip(line[left].tolist(), map(_cached_name, key[left].tolist()), strict=True)
    for k in np.flatnonzero(switching).tolist():
        name = _cached_name(int(key[k]))
        group = next(g for g, (on, off) in SWITCHES.items() if (key[k] - M) // 10 in on + off)
        if group == "M42":
            group = _pin(word["P"][k] if np.isfinite(word["P"][k]) else -1)
        out.lines_of.setdefault(group, []).append((int(line[k]), name))
    for code in APPLIED:
        at = line[key == code]
        if len(at):
            held = out.applied.setdefault(code, [0, int(at[0])])
            held[0] += len(at)
    for c in DRIVERS[1:]:
        given = motion & np.isfinite(word[c])
        stray = given & (lead == ord(c)) & _none(word, "XYZEIJ")
        for k in np.flatnonzero(stray).tolist():
            out.lines_of.setdefault(c, []).append((int(line[k]), f"{c}{word[c][k]:g}"))
        if (given & ~stray).any():
            held = out.beside.setdefault(c, [0, int(line[given & ~stray][0])])
            held[0] += int((given & ~stray).sum())


_cached_name = functools.cache(_name)


# ---- the whole program


def _moved(out: Gathered, asked: str) -> tuple[Moves, tuple[str, ...], np.ndarray, np.ndarray]:
    """Returns the moves of all chunks, the names that drive their extrusion, and for each move M221's factor
    and M200's mode."""
    line, start, end, length, feed, tool, centre, angle, pause, acceleration, flow, volumetric = (
        column[: out.rows] for column in out.columns[:12]
    )
    what, planar, vertical = (column[: out.rows] for column in out.columns[12:])
    driven = {name: column[: out.rows] for name, column in out.driven.items()}
    driver = _driver(driven, planar & (what == 0), asked)
    e = np.zeros(out.rows)
    for name in driver:
        e += driven[name] if driven[name].dtype == float else 0.0
    switches = [driven[name] for name in driver if driven[name].dtype == bool]
    if switches:
        e = np.where(np.logical_or.reduce(switches) & (what == 0), length, 0.0)
    kind = _kinds(what, planar, vertical, e)
    keep = (what > 0) | planar | vertical | (np.abs(e) > TINY)
    moves = (line, kind, start, end, length, e, feed, tool, centre, angle, pause, acceleration)
    if not keep.all():
        moves, flow, volumetric = tuple(column[keep] for column in moves), flow[keep], volumetric[keep]
    return Moves(*moves), driver, flow, volumetric


def _driver(driven: dict[str, np.ndarray], planar: np.ndarray, asked: str) -> tuple[str, ...]:
    """Returns the names that drive the extrusion: those that match `asked`; if it is "", E if it grows along
    the path; else the other letters that do; else a switch that is on along some of the path; else a letter
    that moves alone. Raises ValueError if nothing matches `asked`."""
    letters = [c for c in DRIVERS if c in driven]
    if asked:
        found = [name for name in driven if name == asked or name.split()[0] == asked]
        if not found:
            raise ValueError(
                f"nothing in the program is driven by {asked}; found {', '.join(sorted(driven)) or 'nothing'}"
            )
        return tuple(found)
    prints = [c for c in letters if np.any(planar & (driven[c] > TINY))]
    if prints:
        return ("E",) if "E" in prints else tuple(prints)
    for name in SWITCHES:
        opens = [one for one in driven if one.split()[0] == name and np.any(driven[one] & planar)]
        closes = [one for one in opens if not np.all(driven[one][planar])]
        if opens:
            return tuple(closes or opens)
    alone = [c for c in letters if np.any(np.abs(driven[c]) > TINY)]
    return ("E",) if "E" in alone else tuple(alone)


def _shown(driver: tuple[str, ...]) -> str:
    return "".join(driver) if all(len(name) == 1 for name in driver) else ", ".join(driver)


def _kinds(what: np.ndarray, planar: np.ndarray, vertical: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Returns the kind (N,) of each move. It follows from where the move goes and what E does, unless the
    command's word gives the kind."""
    out, back = e > TINY, e < -TINY
    # retracted so far: -sum E, but never below 0, so that printing empties it
    depth = np.cumsum(-e)
    deep = np.append(0.0, (depth - np.minimum.accumulate(np.minimum(depth, 0.0)))[:-1])[: len(e)] > 1e-6
    kind = np.full(len(what), int(Kind.TRAVEL))
    kind[back | (what == Kind.RETRACT)] = Kind.RETRACT
    kind[back & (planar | vertical)] = Kind.WIPE
    kind[out] = Kind.PRIME
    kind[out & deep | (what == Kind.UNRETRACT)] = Kind.UNRETRACT
    kind[out & (planar | vertical & ~deep)] = Kind.EXTRUDE
    for word in (Kind.TOOL, Kind.DWELL, Kind.HOME):
        kind[what == word] = word
    return kind


def _told(others: list[tuple[int, str]], out: Gathered, driver: tuple[str, ...]) -> list[OtherWord]:
    """Returns every word that is no move, once, the most frequent first."""
    counts = collections.Counter(word for _, word in others)
    first: dict[str, int] = {}
    for line, word in others:
        first.setdefault(word, line)
    told = [OtherWord(word, count, first[word], BECOMES.get(word, "")) for word, count in counts.items()]
    told += [OtherWord(_name(key), count, line, APPLIED[key]) for key, (count, line) in out.applied.items()]
    told += [
        OtherWord(c, count, line, "beside moves: neither a place nor what drives the extrusion")
        for c, (count, line) in out.beside.items()
        if c not in driver
    ]
    return sorted(told, key=lambda one: (-one.count, one.line, one.word))


def _accounted(lines: int, filled: int, moved, other, refused) -> Accounted:
    """Counts every line once. A line that fits several counts is, in this order, refused, moved, other or
    read."""
    moved = np.setdiff1d(moved, refused)
    other = np.setdiff1d(np.setdiff1d(other, refused), moved)
    held = len(refused) + len(moved) + len(other)
    return Accounted(lines - filled, len(moved), filled - held, len(other), len(refused))


def _said(data: bytes) -> dict[int, float]:
    """Returns the diameter in mm of what E pushes, by tool, from a slicer's comment; empty if there is
    none."""
    for words in DIAMETERS:
        at = data.find(words)
        line = data[data.rfind(b"\n", 0, at) + 1 : data.find(b"\n", at)] if at >= 0 else b""
        if not line.lstrip().startswith(b";") or len(line) > 1000:
            continue
        rest = line.partition(words)[2].decode("latin-1").replace("#1", "").strip(" =:,")
        numbers = [part.strip().removesuffix("mm").strip() for part in rest.replace("|", ",").split(",")]
        values = {}
        for tool, number in enumerate(numbers[:TOOLS]):
            if number.replace(".", "", 1).isdecimal() and 0 < float(number) < 1000:
                values[tool] = float(number)
        if values:
            return values
    return {}


def _arcs(
    commands: Commands,
    start: np.ndarray,
    end: np.ndarray,
    arc: np.ndarray,
    state: ProgramState,
    refusals: Refusals,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns centre (N, 2), signed angle and length (N,) of all commands; the length of a refused arc is
    NaN. I J point from the start to the centre. R is the radius; if R < 0, the arc goes the long way round. P
    counts turns; P1 adds none (LinuxCNC and Bambu)."""
    line, key, word = commands[:3]
    step = end - start
    centre, angle, length = np.full((len(step), 2), np.nan), np.zeros(len(step)), np.linalg.norm(step, axis=1)
    plane = _held(key, np.isin(key, (170, 180, 190)), state.plane)
    absolute = _held(key == 901, np.isin(key, (901, 911)), state.absolute_arcs)
    state.plane, state.absolute_arcs = int(plane[-1]), bool(absolute[-1])
    at = np.flatnonzero(arc)
    if not len(at):
        return centre, angle, length
    i, j, r, turns = (word[c][at] for c in "IJRP")
    a, b, way = start[at, :2], end[at, :2], np.where(key[at] == 20, -1.0, 1.0)
    chord = np.linalg.norm(b - a, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        short = np.abs(r) < chord / 2 * (1 - 1e-3)  # what rounding of the program leaves is a half circle
        apothem = np.where(short, np.nan, way * np.sign(r) * np.sqrt(np.maximum(r**2 - chord**2 / 4, 0.0)))
        left = np.column_stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]]) / chord[:, None]
    spoke = np.where(
        np.isfinite(r)[:, None], (b - a) / 2 + apothem[:, None] * left, np.nan_to_num(np.column_stack([i, j]))
    )
    c = a + spoke
    radii = np.linalg.norm([a - c, b - c], axis=2)
    sweep = (way * (np.arctan2(*(b - c).T[::-1]) - np.arctan2(*(a - c).T[::-1]))) % (2 * np.pi)
    sweep = np.where(chord <= TINY, 2 * np.pi, sweep) + 2 * np.pi * np.maximum(np.nan_to_num(turns) - 1, 0)
    plane, absolute = plane[at] != 170, absolute[at]
    off = ~(np.abs(radii[0] - radii[1]) <= np.maximum(0.5, 0.05 * radii[0])) | (radii.min(axis=0) <= TINY)
    for where, why in (
        (plane, "expected arcs in the plane of X and Y (G17), found one under G18 or G19"),
        (absolute, "expected I and J from the start of the arc (G91.1), found G90.1"),
        (
            off & ~plane & ~absolute,
            "expected an arc with both ends on its circle, found none; check I, J or R",
        ),
    ):
        _refuse(refusals, line[at], where, why)
    centre[at], angle[at] = c, way * sweep
    length[at] = np.where(off | plane | absolute, np.nan, np.hypot(radii.mean(axis=0) * sweep, step[at, 2]))
    return centre, angle, length
