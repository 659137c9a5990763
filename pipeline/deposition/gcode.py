"""G-code as it is found -> moves: the words of every dialect, and the state (units, modes, offsets, tools)
resolved over whole columns instead of line by line.

Three steps: bytes -> words (line, letter, value), words -> commands, commands -> moves.
Lines made of letters with numbers are read together, eight digits in three multiplications;
the few others (macros, free text, checksums) one by one.
"""

import enum
import functools
import operator
import re
from typing import NamedTuple

import numpy as np

# EXTRUDE travels with E > 0, WIPE with E < 0; RETRACT, UNRETRACT and PRIME (more than was retracted before)
# move E alone; TOOL changes the tool
Kind = enum.IntEnum("Kind", "TRAVEL EXTRUDE WIPE RETRACT UNRETRACT PRIME DWELL TOOL HOME", start=0)


class Moves(NamedTuple):
    """N moves in their order; start and end (N, 3) in mm are one chain from 0 0 0,
    unbroken by G92, which renames places and moves nothing.

    line: number from 1. length: mm along the path, arcs and helices by their true length. e: mm of filament
    or plunger; mm of path where a switch drives extrusion. feed: mm/s, NaN before the first F. tool: in
    use, for TOOL the new one. centre (N, 2) in mm and angle in rad (+ counter-clockwise, whole turns
    included): of arcs, NaN and 0 for lines. dwell_s: of DWELL. acceleration: mm/s^2 by M204 or
    SET_VELOCITY_LIMIT, NaN where the program gave none.
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


class Refusal(NamedTuple):
    """A command that was left out: it could not be read, or asks for what is not supported."""

    line: int
    why: str


class Program(NamedTuple):
    """The moves; words without meaning for them, in their order (other_line (M,), other_word (M,)); refusals;
    what drives the extrusion (E, U, A, M42, ..., or nothing: "") and how many lines there are."""

    moves: Moves
    other_line: np.ndarray
    other_word: np.ndarray
    refusals: list[Refusal]
    extruder: str
    lines: int


CHUNK = 1 << 18  # bytes read at once: what stays in the processor's cache
LETTER, POINT, SPACE, NEWLINE, DIGIT, SIGN = range(1, 7)
SETS = (bytes(c for c in range(128) if chr(c).isalpha()), b".", b" \t\v\f", b"\n", b"0123456789", b"+-")
CLASSES = bytes(next((k for k, of in enumerate(SETS, 1) if c in of), 0) for c in range(256))
POWERS = 10.0 ** np.arange(17)
TAIL = re.compile(rb";[^\n]*")
COMMENT = re.compile(rb";[^\n]*|\((?:[^()\n]|\((?:[^()\n]|\([^()\n]*\))*\))*\)")
WORD = re.compile(r"\s*([A-Za-z])\s*([+-]?(?:\d+\.?\d*|\.\d+))?")
EXPONENT = re.compile(r"[eE][+-]\d+(?![\d.])")
MACRO = re.compile(r"[A-Za-z_][A-Za-z_]{2,}[\w.]*(?=[\s=]|$)|if\b")
ACCELERATION = re.compile(r"SET_VELOCITY_LIMIT\b.*\bACCEL\s*=\s*(\d+\.?\d*)", re.IGNORECASE)
ACTIVATE = re.compile(r"ACTIVATE_EXTRUDER\b.*\bEXTRUDER\s*=\s*extruder(\d*)", re.IGNORECASE)
NOT_WORDS = "{}[]%$#!~/:<>'\"&="

M, T, MODAL, REFUSED = 1_000_000, 100_000_000, -1, -2
MOTION = (0, 10, 20, 30)
READ = (0, 1, 2, 3, 4, 5, 92)  # G words whose line must be read whole
# M words that others may follow on the line; the rest of the line belongs to any other
CHAINED = (*range(3, 12), 42, *range(62, 66), 82, 83, 101, 103, 106, 107, 126, 127, *range(760, 764))
# G words that leave X Y Z on their line to the motion in force
SETTINGS = (*range(170, 220, 10), 400, 490, *range(530, 600, 10), 640, 900, 910, 940)
MEANT = (*MOTION, 40, 170, 180, 190, 200, 210, 280, 900, 901, 910, 911, 920, M + 820, M + 830, M + 2040)
UNSUPPORTED = {
    50: "G5 is not supported; export arcs or lines",
    921: "G92.1 is not supported; write G92 and the coordinates",
}
LETTERS = "XYZEABCUIJRFPSTL"
AXIS = np.isin(np.arange(256), np.frombuffer(b"XYZEABCUIJRF", np.uint8))
# the M words that switch extrusion on and off, the most specific first; an on word with S0 is off
SWITCHES = {
    "M760": ((760, 762), (761, 763)), "M126": ((126,), (127,)), "M101": ((101,), (103,)), "M42": ((42,), ()),
    "M64": ((62, 64), (63, 65)),
    "M7": ((7, 8), (9,)), "M3": ((3, 4), (5,)), "M10": ((10,), (11,)), "M106": ((106,), (107,)),
}  # fmt: skip
TOOLS = 64  # T255, T1000, ... are words of one maker's machine, not tools
TINY, LARGEST = 1e-9, 1e9  # mm: below every resolution and above rounding; larger than every machine


def parse(text: str | bytes) -> Program:
    """The moves of a program, with all that was not understood beside them.

    Raises ValueError, in one sentence, for what is no G-code text at all:
    binary, empty, or without a single G, M or T word.
    """
    data = _lines(text)
    lines = data.count(b"\n")
    words, others, refusals = _words(data)
    if not np.isin(words[1], np.frombuffer(b"GMT", np.uint8)).any():
        raise ValueError(
            "the program holds no G-code: expected lines such as 'G1 X10 F600', "
            f"found {lines} lines without a G, M or T word"
        )
    line, key, word = _commands(*words, refusals)
    moves, extruder, meant = _moves(line, key, word, refusals)
    left = np.flatnonzero(~meant & (key != REFUSED))
    others += zip(line[left].tolist(), map(functools.cache(_name), key[left].tolist()), strict=True)
    others.sort(key=operator.itemgetter(0))
    other_line, other_word = zip(*others, strict=True) if others else ((), ())
    return Program(
        moves, np.array(other_line, int), np.array(other_word, str), sorted(set(refusals)), extruder, lines
    )


def _lines(text: str | bytes) -> bytes:
    """The bytes with every line ended by one newline; what is not
    ASCII can only stand in comments and free text."""
    if isinstance(text, bytes) and text[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = text.decode("utf-16", "replace")
    data = (
        text.removeprefix("\ufeff").encode("latin-1", "replace")
        if isinstance(text, str)
        else text.removeprefix(b"\xef\xbb\xbf")
    )
    head = data[:65536]
    if len(head) - len(head.translate(None, bytes([*range(9), *range(14, 32), 127]))) > 8 + len(head) / 100:
        raise ValueError(
            f"the program is binary, beginning {data[:4]!r}: expected G-code as text; "
            "export it as plain .gcode, unpacked"
        )
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data if data.endswith(b"\n") or not data else data + b"\n"


def _words(data: bytes) -> tuple[list[np.ndarray], list[tuple[int, str]], list[Refusal]]:
    """Line, letter and value of all words in their order; the words of odd lines that
    mean nothing; the lines that could not be read."""
    parts, extra, others, refusals, at, first = [], [], [], [], 0, 1
    while at < len(data):
        end = data.find(b"\n", min(at + CHUNK, len(data) - 1)) + 1
        body = data[at:end]
        body = (COMMENT if b"(" in body else TAIL).sub(b" ", body)
        words, odd, count = _regular(body, first)
        parts.append(words)
        texts = body.decode("latin-1").split("\n") if len(odd) else []
        for k in odd.tolist():
            pairs, unknown, why = _odd(texts[k])
            extra += [(first + k, ord(letter), value) for letter, value in pairs]
            others += [(first + k, unknown)] if unknown else []
            refusals += [Refusal(first + k, why)] if why else []
        at, first = end, first + count
    line, letter, value = zip(*extra, strict=True) if extra else ((), (), ())
    parts.append([np.array(line, int), np.array(letter, np.uint8), np.array(value, float)])
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.argsort(columns[0], kind="stable") if extra else slice(None)
    return [column[order] for column in columns], others, refusals


def _regular(body: bytes, first: int) -> tuple[list[np.ndarray], np.ndarray, int]:
    """Line, letter and value of the words of all lines that hold only letters, each with a number right
    behind it; the indices of the other lines; the number of lines."""
    kinds = np.frombuffer(body.translate(CLASSES), np.uint8)
    events = np.flatnonzero(
        kinds - np.uint8(1) < 4
    )  # letters, points, spaces, newlines: they bound the digits
    what = kinds[events]
    newlines = np.cumsum(what == NEWLINE)
    k = np.flatnonzero(what == LETTER)
    letter, pointed = events[k], what[k + 1] == POINT
    whole_end, end = events[k + 1], events[np.minimum(k + 1 + pointed, len(events) - 1)]
    signed = kinds[letter + 1] == SIGN
    start = letter + 1 + signed
    whole, part = whole_end - start, end - whole_end - pointed
    padded = body + bytes(8)
    raw = np.frombuffer(padded, np.uint8)
    eight = np.ndarray(len(body), "<u8", padded, strides=(1,))
    scale = POWERS[np.clip(part, 0, 16)]
    value = (
        _digits(eight[start], whole) * scale + _digits(eight[np.minimum(whole_end + 1, len(body) - 1)], part)
    ) / scale
    value[signed & (raw[start - 1] == ord("-"))] *= -1
    capital = raw[letter] & 0xDF

    bad = (whole + part == 0) | (whole > 8) | (part > 8) | (whole + part > 15)
    # an e between a number and a signed number: an exponent, or the next word? the odd path decides
    bad |= (capital == ord("E")) & signed & ((kinds[letter - 1] == DIGIT) | (kinds[letter - 1] == POINT))
    odd = np.zeros(newlines[-1], bool)
    line = newlines[k]
    odd[line[bad]] = True
    before = np.roll(kinds, 1)
    stray = (
        (kinds == DIGIT) & (before - np.uint8(SPACE) < 2)
        | (kinds == SIGN) & (before != LETTER)
        | (kinds == 0)
    )
    stray[events[(what == POINT) & (np.roll(what, 1) != LETTER)]] = True
    odd[np.searchsorted(events[what == NEWLINE], np.flatnonzero(stray))] = True
    if odd.any():
        keep = ~odd[line]
        line, capital, value = line[keep], capital[keep], value[keep]
    return [line + first, capital, value], np.flatnonzero(odd), len(odd)


def _digits(eight: np.ndarray, count: np.ndarray) -> np.ndarray:
    """The number written by the first `count` (0 to 8) of eight digits in a little-endian word: pairs, then
    fours, then all eight (Lemire 2018)."""
    w = (eight << (64 - 8 * np.clip(count, 0, 8)).astype(np.uint64)) & 0x0F0F0F0F0F0F0F0F
    w = (w * 10 + (w >> 8)) & 0x00FF00FF00FF00FF
    w = (w * 100 + (w >> 16)) & 0x0000FFFF0000FFFF
    return ((w * 10000 + (w >> 32)) & 0xFFFFFFFF).astype(float)


def _odd(text: str) -> tuple[list[tuple[str, float]], str, str]:
    """Words of a line that holds more than letters with numbers; its leading word where that means nothing to
    moves; why it could not be read."""
    text, why = _checked(text.strip())
    text, host = map(str.strip, text.partition("@")[::2])
    host = "@" + host.split()[0][:40] if host else ""
    if why or not text:
        return [], host, why
    if match := ACCELERATION.match(text):
        return [("M", 204.0), ("S", float(match[1]))], "", ""
    if match := ACTIVATE.match(text):
        return [("T", float(match[1] or 0))], "", ""
    if MACRO.match(text) or text[0] in NOT_WORDS or re.match("[MTmt][^0-9]", text):
        return [], re.split(r"[\s=]", text, maxsplit=1)[0][:40] or text[0], ""
    words, at, owner, strict = [], 0, ("", 0.0), True
    while at < len(text):
        match = WORD.match(text, at)
        letter, number, end = (match[1].upper(), match[2], match.end()) if match else ("", None, at)
        if number and words and match.start(1) > at and (exponent := EXPONENT.match(text, end)):
            number, end = (
                number + exponent[0],
                exponent.end(),
            )  # words stand apart here: an e right behind a number is its exponent
        if number and (letter in "GM" or not words):
            owner = (letter, float(number))
            strict = letter != "M" and (letter != "G" or owner[1] in READ)
        if number is None and strict:
            return [], "", f"expected letters with a number each, found {text[at : at + 24].strip()!r}"
        if not match:
            break
        words.append((letter, float(number or 0)))
        if strict and not abs(words[-1][1]) < LARGEST:
            return [], "", f"expected numbers below {LARGEST:g}, found {letter}{number:.24}"
        at = end
        if letter == "M" and owner[1] not in CHAINED and owner[1] not in (135, 204):
            break  # the rest of the line is its own, free text often
    return words, host, ""


def _checked(text: str) -> tuple[str, str]:
    """The line without its number and its checksum, the exclusive or of all bytes before the asterisk; why it
    fails. Five digits are a CRC, which is not checked."""
    body, star, digits = text.rpartition("*")
    if star and digits.strip().isdecimal() and text[0] in "NGTngt":
        checksum = functools.reduce(operator.xor, body.encode("latin-1"), 0)
        if int(digits) < 256 and int(digits) != checksum:
            return (
                "",
                f"expected the checksum {digits.strip()} of the line, found {checksum}; "
                "the line was damaged on its way",
            )
        text = body
    return re.sub(r"^[Nn]\s*\d+\s*", "", text), ""


def _commands(line, letter, value, refusals) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Line and key (G1 is 10, G92.1 is 921, M and T from their offsets on) of each command, and its words by
    letter in mm, NaN where absent. G and M begin a command, but behind an M word that takes the whole line,
    and so does the word that leads a line."""
    if np.any(letter == ord("N")):
        line, letter, value = (column[letter != ord("N")] for column in (line, letter, value))
    leads = np.append(True, line[1:] != line[:-1])
    m = letter == ord("M")
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
    key = np.where(key == MODAL, _held(key, np.isin(key, MOTION), 10), key)
    line, unit, word = line[first], _held(np.where(key == 200, 25.4, 1.0), np.isin(key, (200, 210)), 1.0), {}
    twice, absent = np.zeros(len(first), bool), np.full(len(first), np.nan)
    for name in LETTERS:
        at = np.flatnonzero(letter == ord(name))
        word[name] = absent.copy() if len(at) else absent
        word[name][block[at]] = value[at]
        if np.count_nonzero(np.isfinite(word[name])) < len(at):
            twice |= (np.bincount(block[at], minlength=len(first)) > 1) & np.isin(key, (*MOTION, 920))
        word[name] *= unit if AXIS[ord(name)] else 1.0
    _refuse(refusals, line, twice, "expected each letter once in a command, found one twice; write two lines")
    for code, why in UNSUPPORTED.items():
        _refuse(refusals, line, key == code, why)
    key[twice | np.isin(key, tuple(UNSUPPORTED))] = REFUSED
    return line, key, word


def _name(key: int) -> str:
    letter, base = ("T", T) if key >= T else ("M", M) if key >= M else ("G", 0)
    return chr(-key) if key < 0 else f"{letter}{(key - base) / 10:g}"


def _refuse(refusals: list[Refusal], line: np.ndarray, where: np.ndarray, why: str) -> None:
    refusals += [Refusal(at, why) for at in line[where].tolist()]


def _last(mask: np.ndarray) -> np.ndarray:
    """Index of the last True up to each place, -1 before the first."""
    return np.maximum.accumulate(np.where(mask, np.arange(len(mask)), -1))


def _held(values: np.ndarray, mask: np.ndarray, start) -> np.ndarray:
    """The value at the last True of the mask, `start` before the first: what a modal word leaves in force."""
    return np.append(values, start)[_last(mask)]


def _moves(
    line: np.ndarray, key: np.ndarray, word: dict[str, np.ndarray], refusals: list[Refusal]
) -> tuple[Moves, str, np.ndarray]:
    """The moves, what drives the extrusion, and which commands meant something."""
    motion, home, dwell = np.isin(key, MOTION), key == 280, key == 40
    relative = _held(key == 910, np.isin(key, (900, 910)), False)
    selects = (key >= T) & (key < T + 10 * TOOLS) | np.isin(key, (M + 60, M + 1350)) & np.isfinite(word["T"])
    tool = _held(np.where(key >= T, (key - T) // 10, np.nan_to_num(word["T"]).astype(int)), selects, 0)
    changes = selects & (tool != np.append(0, tool[:-1]))
    alone = _none(word, "XYZ")
    all_named = (key == 920) & alone & np.isnan(word["E"])
    places = [
        _place(word[c], key, motion, relative, home & (alone | ~np.isnan(word[c])), all_named) for c in "XYZ"
    ]
    start, end = (np.column_stack(side) for side in zip(*places, strict=True))
    arc = np.isin(key, (20, 30)) & ~_none(word, "XYIJR")
    centre, angle, length = _arcs(line, key, word, start, end, arc, refusals)
    e, extruder, meant = _extrusion(key, word, motion, relative, tool, length)

    travel = np.abs(end - start) > TINY
    planar, vertical, out, back = travel[:, :2].any(axis=1) | arc, travel[:, 2], e > TINY, e < -TINY
    # retracted so far: -sum E, but never below nothing, so that printing empties it
    depth = np.cumsum(-e)
    deep = np.append(0.0, (depth - np.minimum.accumulate(np.minimum(depth, 0.0)))[:-1]) > 1e-6
    firmware = np.isin(key, (100, 110)) & _none(
        word, "PLXYZ"
    )  # G10, G11; with P or L they set temperatures and offsets
    cases = {
        Kind.HOME: home, Kind.DWELL: dwell, Kind.TOOL: changes,
        Kind.EXTRUDE: out & (planar | vertical & ~deep), Kind.UNRETRACT: out & deep | firmware & (key == 110),
        Kind.PRIME: out, Kind.WIPE: back & (planar | vertical), Kind.RETRACT: back | firmware,
    }  # fmt: skip
    kind = np.select(list(cases.values()), [int(code) for code in cases], int(Kind.TRAVEL))
    feed = _held(word["F"] / 60, motion & (word["F"] > 0), np.nan)
    asked = np.where(np.isfinite(word["P"]), word["P"], word["S"])
    acceleration = _held(asked, (key == M + 2040) & (asked > 0), np.nan)
    pause = np.where(
        dwell,
        np.maximum(np.where(np.isfinite(word["S"]), word["S"], np.nan_to_num(word["P"]) / 1000), 0.0),
        0.0,
    )
    rows = motion & np.isfinite(length) & (planar | vertical | out | back) | firmware | dwell | changes | home
    columns = (line, kind, start, end, length, e, feed, tool, centre, angle, pause, acceleration)
    return (
        Moves(*(column[rows] for column in columns)),
        extruder,
        meant | np.isin(key, MEANT) | selects | firmware,
    )


def _none(word: dict[str, np.ndarray], letters: str) -> np.ndarray:
    return functools.reduce(operator.and_, (np.isnan(word[c]) for c in letters))


def _place(value, key, motion, relative, homes, all_named) -> tuple[np.ndarray, np.ndarray]:
    """Place on one axis before and after each command: the last value set plus all that was added since, and
    all that G92 shifted since the last G28."""
    given = np.isfinite(value)
    names, adds = (key == 920) & given | all_named, motion & given & relative
    value, sets = np.where(given & ~homes, value, 0.0), names | homes | motion & given & ~relative
    run = np.cumsum(np.where(adds, value, 0.0))
    after = _held(value, sets, 0.0) + (run - _held(run, sets, 0.0))
    if names.any():
        shift = np.cumsum(np.where(names, np.append(0.0, after[:-1]) - after, 0.0))
        after = after + shift - _held(shift, homes, 0.0)
    return np.append(0.0, after[:-1]), after


def _extrusion(key, word, motion, relative, tool, length) -> tuple[np.ndarray, str, np.ndarray]:
    """E of each command in mm, what drives it, and the commands that switch it. E counts for each tool apart;
    G91 makes it relative too, until an M82."""
    e, none = np.zeros(len(key)), np.zeros(len(key), bool)
    absolute = _last(key == M + 820)
    relative = (_last(key == M + 830) > absolute) | relative & (absolute < _last(np.isin(key, (900, 910))))
    driven = [c for c in "EUABC" if np.any(motion & np.isfinite(word[c]) & (word[c] != 0))]
    driven = driven[:1] if "E" in driven else driven
    for c in driven:
        all_named, given = (key == 920) & _none(word, "XYZ" + c), motion & np.isfinite(word[c])
        for at in (np.flatnonzero(tool == k) for k in np.unique(tool)):
            before, after = _place(word[c][at], key[at], motion[at], relative[at], none[at], all_named[at])
            e[at] += np.where(given[at], np.where(relative[at], word[c][at], after - before), 0.0)
    if driven:
        return e, "".join(driven), none
    for name, (on, off) in SWITCHES.items():
        opens = np.isin(key, M + 10 * np.array(on)) & (word["S"] != 0)
        if opens.any():
            switch = np.isin(key, M + 10 * np.array(on + off))
            return np.where(motion & _held(opens, switch, False), np.nan_to_num(length), 0.0), name, switch
    return e, "", none


def _arcs(line, key, word, start, end, arc, refusals) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre (N, 2), signed angle, length (N,) of all commands; the length of a refused arc is
    NaN. I J point to the centre from the start; R is the radius, < 0 the long way round; P counts
    turns, 1 being no more than one (LinuxCNC and Bambu)."""
    step = end - start
    centre, angle, length = np.full((len(step), 2), np.nan), np.zeros(len(step)), np.linalg.norm(step, axis=1)
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
    plane = _held(key, np.isin(key, (170, 180, 190)), 170)[at] != 170
    absolute = _held(key == 901, np.isin(key, (901, 911)), False)[at]
    off = ~(np.abs(radii[0] - radii[1]) <= np.maximum(0.5, 0.05 * radii[0])) | (radii.min(axis=0) <= TINY)
    _refuse(
        refusals, line[at], plane, "expected arcs in the plane of X and Y (G17), found one under G18 or G19"
    )
    _refuse(refusals, line[at], absolute, "expected I and J from the start of the arc (G91.1), found G90.1")
    _refuse(
        refusals,
        line[at],
        off & ~plane & ~absolute,
        "expected an arc with both ends on its circle, found none; check I, J or R",
    )
    centre[at], angle[at] = c, way * sweep
    length[at] = np.where(off | plane | absolute, np.nan, np.hypot(radii.mean(axis=0) * sweep, step[at, 2]))
    return centre, angle, length
