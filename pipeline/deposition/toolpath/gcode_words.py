"""Reads the bytes of a part program into words (line, letter, value), chunk by chunk, for every dialect and
in spite of damage.

Lines made of letters with numbers are read together, eight digits in three multiplications. The few others
(macros, free text, checksums) are read one by one.
"""

import functools
import operator
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np


class LineRefusal(NamedTuple):
    """Commands that were left out for one reason, because they could not be read or are not supported: the
    first line, the reason found there, and the number of lines."""

    line: int
    why: str
    count: int = 1


NUMBERS = dict.fromkeys(map(ord, "0123456789."))  # what tells two reasons of one kind apart


class Refusals:
    """The refusals so far: for each kind of reason its first line and sentence; and the numbers of all
    refused lines."""

    def __init__(self) -> None:
        self.kinds: dict[str, LineRefusal] = {}
        self.lines: list[int] = []

    def add(self, lines: Sequence[int], why: str) -> None:
        if not len(lines):
            return
        kind = why.partition(", found")[0].translate(NUMBERS)
        held = self.kinds.get(kind, LineRefusal(lines[0], why, 0))
        first = (lines[0], why) if lines[0] < held.line else held[:2]
        self.kinds[kind] = LineRefusal(*first, held.count + len(lines))
        self.lines += lines

    def grouped(self) -> list[LineRefusal]:
        """Returns one refusal per kind, ordered by first line. The sentence gives the number of further lines
        like it."""
        more = [
            one._replace(why=f"{one.why} (and {one.count - 1:,} more such)") if one.count > 1 else one
            for one in self.kinds.values()
        ]
        return sorted(more)


class ProgramWords(NamedTuple):
    """The words of some lines, all (W,): line from 1, letter as its capital's code, value. `others`: words
    without meaning for moves, as (line, word); `filled`: the number of lines that hold more than comments."""

    line: np.ndarray
    letter: np.ndarray
    value: np.ndarray
    others: list[tuple[int, str]]
    filled: int


CHUNK = 1 << 18  # bytes read at once: what stays in the processor's cache
LONGEST = (
    1 << 16
)  # characters of one line: thumbnails and settings keep to hundreds, a slicer's notes to thousands
LETTER, POINT, SPACE, NEWLINE, DIGIT, SIGN = range(1, 7)
SETS = (bytes(c for c in range(128) if chr(c).isalpha()), b".", b" \t\v\f", b"\n", b"0123456789", b"+-")
CLASSES = bytes(next((k for k, of in enumerate(SETS, 1) if c in of), 0) for c in range(256))
CONTROL = bytes([*range(9), *range(14, 32), 127])
BINARY = re.compile(b"[" + re.escape(CONTROL) + b"]")
POWERS = 10.0 ** np.arange(17)
TAIL = re.compile(rb";[^\n]*")
COMMENT = re.compile(rb";[^\n]*|\((?:[^()\n]|\((?:[^()\n]|\([^()\n]*\))*\))*\)")
WORD = re.compile(r"\s*([A-Za-z])\s*([+-]?(?:\d+\.?\d*|\.\d+))?")
EXPONENT = re.compile(r"[eE][+-]\d+(?![\d.])")
# a number with an exponent that has no sign: its e is read as a word
UNSIGNED = re.compile(r"(?=([A-Za-z]\s*([+-]?(?:\d+\.?\d*|\.\d+)[eE]\d+)(?![\d.])))")
# how a line of G-code begins, behind its number: G, M or T with a number
BEGUN = re.compile(rb"^[ \t]*(?:[Nn][ \t]*\d+[ \t]*)?[GMTgmt][ \t]*\d", re.MULTILINE)
MACRO = re.compile(r"[A-Za-z_][A-Za-z_]{2,}[\w.]*(?=[\s=]|$)|if\b")
ACCELERATION = re.compile(r"SET_VELOCITY_LIMIT\b.*\bACCEL\s*=\s*(\d+\.?\d*)", re.IGNORECASE)
ACTIVATE = re.compile(r"ACTIVATE_EXTRUDER\b.*\bEXTRUDER\s*=\s*extruder(\d*)", re.IGNORECASE)
NOT_WORDS = "{}[]%$#!~/:<>'\"&="

READ = (0, 1, 2, 3, 4, 5, 92)  # G words whose line must be read whole
# M words that others may follow on the line; the rest of the line belongs to any other
CHAINED = (*range(3, 12), 42, *range(62, 66), 82, 83, 101, 103, 106, 107, 126, 127, *range(760, 764))
# M words that take the rest of their line and whose letters count: tool, acceleration, volume, speed, flow
TAKEN = (135, 200, 204, 220, 221)
LARGEST = 1e9  # mm: larger than every machine
ENOUGH = 20_000  # lines without one word, behind which no G-code is expected any more


def text_bytes(text: str | bytes) -> bytes:
    """Returns the bytes with every line ended by one newline. Characters beyond ASCII can only occur in
    comments and free text. Raises ValueError if the text is binary."""
    if isinstance(text, bytes) and text[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = text.decode("utf-16", "replace")
    data = (
        text.removeprefix("\ufeff").encode("latin-1", "replace")
        if isinstance(text, str)
        else text.removeprefix(b"\xef\xbb\xbf")
    )
    for at in range(0, len(data), CHUNK):
        some = data[at : at + CHUNK]
        if len(some) - len(some.translate(None, CONTROL)) > 8 + len(some) / 100:
            first = at + next(found.start() for found in BINARY.finditer(some))
            where = f"at its byte {first:,}" if first > 64 else f"beginning {data[:4]!r}"
            raise ValueError(
                f"the program is binary, {where}: expected G-code as text; "
                "export it as plain .gcode, unpacked"
            )
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data if data.endswith(b"\n") or not data else data + b"\n"


def chunks(data: bytes, refusals: Refusals) -> Iterator[ProgramWords]:
    """Yields the words of the program, about CHUNK bytes of whole lines at a time. Raises ValueError if the
    first ENOUGH lines that hold anything have no G, M or T word that can be read."""
    at, first, found, filled = 0, 1, False, 0
    while at < len(data):
        end = data.find(b"\n", min(at + CHUNK, len(data) - 1)) + 1
        body = data[at:end]
        if len(body) > CHUNK + LONGEST:  # its last line is that long; a comment in it is none of its length
            begin = data.rfind(b"\n", at, at + CHUNK) + 1 or at
            comment = data.find(b";", begin, begin + LONGEST)
            body = data[at : comment if comment >= 0 else begin + LONGEST + 1] + b"\n"
        body, long = _shorter((COMMENT if b"(" in body else TAIL).sub(b" ", body), first, refusals)
        words, count = _chunk(body, first, refusals)
        words = words._replace(filled=words.filled + long)
        found = found or bool(np.isin(words.letter, np.frombuffer(b"GMT", np.uint8)).any())
        filled += words.filled
        if filled > ENOUGH and not found:
            raise no_program(data, first + count - 1, refusals, "the first ")
        yield words
        at, first = end, first + count


def no_program(data: bytes, lines: int, refusals: Refusals, which: str = "") -> ValueError:
    """Returns the error that the first `lines` lines of a program hold no G, M or T word. It gives the
    refusal of the first line that begins with such a word, or says that no line does."""
    begun = BEGUN.search(data)
    line = data.count(b"\n", 0, begun.start()) + 1 if begun else lines + 1
    if begun and line <= lines and line in refusals.lines:
        alone, text = Refusals(), data[begun.start() : begun.start() + LONGEST + 1].partition(b"\n")[0]
        _chunk(_shorter(COMMENT.sub(b" ", text) + b"\n", line, alone)[0], line, alone)
        others = len(set(refusals.lines)) - 1
        more = f" (and {others:,} more {'lines' if others > 1 else 'line'})" if others else ""
        return ValueError(
            f"the program holds no G-code that can be read: line {line:,}: {alone.grouped()[0].why}{more}; "
            "export it again"
        )
    return ValueError(
        "the program holds no G-code: expected lines such as 'G1 X10 F600', "
        f"found {which}{lines} lines without a G, M or T word"
    )


def _shorter(body: bytes, first: int, refusals: Refusals) -> tuple[bytes, int]:
    """Returns the lines, with those that are too long refused and emptied, and the number of these."""
    lines = body.split(b"\n")
    long = [k for k, line in enumerate(lines) if len(line) > LONGEST]
    for k in long:
        lines[k] = b""
    refusals.add([first + k for k in long], f"expected at most {LONGEST:,} characters in a line, found more")
    return b"\n".join(lines) if long else body, len(long)


def _chunk(body: bytes, first: int, refusals: Refusals) -> tuple[ProgramWords, int]:
    """Returns the words of a chunk of whole lines, and the number of its lines."""
    columns, odd, count = _regular(body, first)
    line, extra, others = columns[0], [], []
    filled = len(odd) + (int(np.count_nonzero(np.diff(line))) + 1 if len(line) else 0)
    same: dict[str, str] = {}  # one object a word: a word may stand there a million times
    texts = body.decode("latin-1").split("\n") if len(odd) else []
    for k in odd.tolist():
        pairs, unknown, why = _odd(texts[k])
        extra += [(first + k, ord(letter), value) for letter, value in pairs]
        others += [(first + k, same.setdefault(unknown, unknown))] if unknown else []
        if why:
            refusals.add([first + k], why)
    if extra:
        more = zip(*extra, strict=True)
        columns = [np.append(a, np.array(b, a.dtype)) for a, b in zip(columns, more, strict=True)]
        order = np.argsort(columns[0], kind="stable")
        columns = [column[order] for column in columns]
    return ProgramWords(*columns, others, filled), count


def _regular(body: bytes, first: int) -> tuple[list[np.ndarray], np.ndarray, int]:
    """Returns line, letter and value of the words of all lines that hold only letters directly followed by a
    number; the indices of the other lines; the number of lines."""
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
    e, line = capital == ord("E"), newlines[k]
    behind = e & ((kinds[letter - 1] == DIGIT) | (kinds[letter - 1] == POINT))
    # without a sign it is a word, as in X1E2; if the line has another E, the odd path decides which of them
    # it is
    bad |= behind & (signed | (np.bincount(line[e], minlength=newlines[-1])[line] > 1))
    odd = np.zeros(newlines[-1], bool)
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
    """Returns the number written by the first `count` (0 to 8) of eight digits in a little-endian word:
    pairs, then fours, then all eight (Lemire 2018)."""
    w = (eight << (64 - 8 * np.clip(count, 0, 8)).astype(np.uint64)) & 0x0F0F0F0F0F0F0F0F
    w = (w * 10 + (w >> 8)) & 0x00FF00FF00FF00FF
    w = (w * 100 + (w >> 16)) & 0x0000FFFF0000FFFF
    return ((w * 10000 + (w >> 32)) & 0xFFFFFFFF).astype(float)


def _odd(text: str) -> tuple[list[tuple[str, float]], str, str]:
    """Returns the words of a line that holds more than letters with numbers; its leading word if that means
    nothing to moves, else ""; why it could not be read, else ""."""
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
        if match and number and words and match.start(1) > at and (exponent := EXPONENT.match(text, end)):
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
        if letter == "M" and owner[1] not in CHAINED and owner[1] not in TAKEN:
            break  # the rest of the line is its own, free text often
    if strict and (why := _exponent(text, words)):
        return [], "", why
    return words, host, ""


def _exponent(text: str, words: Sequence[tuple[str, float]]) -> str:
    """Returns why a command with two words E cannot be read, if one of them is an exponent without a sign;
    else ""."""
    found = list(UNSIGNED.finditer(text)) if sum(letter == "E" for letter, _ in words) > 1 else []
    if not found:
        return ""
    largest = max(found, key=lambda match: abs(float(match[2])))
    if not abs(float(largest[2])) < LARGEST:
        return f"expected numbers below {LARGEST:g}, found {largest[1]:.24}"
    return f"expected numbers without an exponent, found {largest[1]:.24}; write the number out"


def _checked(text: str) -> tuple[str, str]:
    """Returns the line without its number and its checksum, and why the checksum fails, "" if it does not.
    The checksum is the exclusive or of all bytes before the asterisk. Five digits are a CRC, which is not
    checked."""
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
