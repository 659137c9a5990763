"""A reader of G-code that shares no code with the project's: one line at a time, one character at a time, as
the RepRap wiki ("G-code": fields, checking, G0-G4, G10, G11, G20, G21, G28, G90-G92, M82, M83, M200, M220,
M221, T) and Marlin's pages of the same words have it. Slow and plain, to be held against columns.
"""

import cmath
import math
from typing import NamedTuple

SETTING = {
    "G17", "G18", "G19", "G20", "G21", "G90", "G91", "G92", "G91.1", "M82", "M83", "M200", "M204", "M220",
    "M221",
}  # fmt: skip


class Row(NamedTuple):
    """A move: line, end in mm, length in mm, mm^3 by E, feed in mm/s."""

    line: int
    end: tuple[float, float, float]
    length: float
    volume: float
    feed: float


class Read(NamedTuple):
    """The moves, and the class of every line: blank, moved, read, other or refused."""

    rows: list[Row]
    classes: list[str]


def without_comments(line: str) -> str:
    """Up to the semicolon, without what stands in parentheses."""
    kept, depth = [], 0
    for letter in line.partition(";")[0]:
        depth += letter == "("
        if not depth:
            kept.append(letter)
        depth -= letter == ")"
    return "".join(kept).strip()


def fields(text: str) -> list[tuple[str, str]]:
    """Letter and number, character by character."""
    found, letter, number = [], "", ""
    for c in text.upper() + " $":
        if c.isalpha() or c == "$":
            if letter:
                found.append((letter, number))
            letter, number = c, ""
        elif not c.isspace():
            number += c
    return found


class Reader:
    """A machine that executes one line after the other."""

    def __init__(self, diameter: dict[int, float], volumetric: bool = False, pin: str = ""):
        self.machine, self.offset = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]  # place = named + offset
        self.unit, self.relative, self.tool, self.feed = 1.0, False, 0, math.nan
        self.m83 = self.g91_counts = False  # G91 makes E relative too, until an M82
        self.e: dict[int, float] = {}
        self.diameter, self.cubic, self.percent = diameter, {}, {}
        self.default_cubic, self.speed, self.last, self.letter, self.pin = volumetric, 1.0, "G1", "E", pin
        self.open = False
        self.rows: list[Row] = []

    def run(self, text: str) -> Read:
        classes = []
        for number, line in enumerate(text.split("\n")[: text.count("\n")], 1):
            classes.append(self.line(number, line))
        return Read(self.rows, classes)

    def line(self, number: int, line: str) -> str:
        text = without_comments(line)
        if not text:
            return "blank"
        if "*" in text and text[0] in "Nn":
            body, _, told = line.partition(";")[0].rpartition("*")
            checksum = 0
            for byte in body.strip().encode():
                checksum ^= byte
            if int(told) != checksum:
                return "refused"
            text = without_comments(body)
        if text[0] in "Nn":
            text = text[1:].lstrip("0123456789 ")
        head = text.split()[0]
        if head == "SET_VELOCITY_LIMIT" and "ACCEL=" in text:  # Klipper's M204
            return "read"
        if len(head) > 2 and head[:3].replace("_", "a").isalpha() or text[0] in "{[@%":
            return "other"
        before = len(self.rows)
        kind = self.execute(number, fields(text))
        return "moved" if len(self.rows) > before else kind

    def execute(self, number: int, words: list[tuple[str, str]]) -> str:
        letter, value = words[0]
        if letter not in "GMT":
            if letter == "C" and not any(c in "XYZE" for c, _ in words):
                return "other"
            command, rest = self.last, words
        else:
            command, rest = f"{letter}{float(value or 0):g}", words[1:]
        if letter == "G":
            split = next((k for k, (c, _) in enumerate(rest) if c in "GM"), len(rest))
            self.one(number, command, dict(rest[:split]))
            if rest[split:]:
                self.execute(number, rest[split:])
            return "read" if command in ("G0", "G1", "G2", "G3", *SETTING) else "other"
        if letter == "T":
            return self.select(number, int(value))
        if letter == "M" and command == "M42":
            args = dict(rest)
            if f"P{args['P']}" == self.pin:
                self.open = float(args["S"]) != 0
                return "read"
            return "other"
        if letter == "M":
            numeric = all(n.replace(".", "", 1).lstrip("+-").isdigit() for _, n in rest)
            if numeric or command in SETTING:
                self.setting(command, {c: float(n or 0) for c, n in rest})
            return "read" if command in SETTING else "other"
        self.one(number, command, dict(rest))
        return "read"

    def select(self, number: int, tool: int) -> str:
        if tool >= 64:
            return "other"
        if tool != self.tool:
            self.tool = tool
            self.rows.append(Row(number, self.place(), 0.0, 0.0, self.feed * self.speed))
        return "read"

    def place(self) -> tuple[float, float, float]:
        return tuple(a + b for a, b in zip(self.machine, self.offset, strict=True))

    def setting(self, command: str, args: dict[str, float]) -> None:
        tool = int(args.get("T", args.get("D", self.tool) if command == "M221" else self.tool))
        if command in ("M82", "M83"):
            self.m83, self.g91_counts = command == "M83", self.g91_counts and command == "M83"
        elif command == "M200":
            if "D" in args and args["D"] > 0:
                self.diameter = {**self.diameter, tool: args["D"]}
            if "S" in args or "D" in args:
                self.cubic[tool] = args["S"] > 0 if "S" in args else args["D"] > 0
        elif command == "M220" and "S" in args:
            self.speed = args["S"] / 100
        elif command == "M221" and "S" in args:
            self.percent[tool] = args["S"]

    def one(self, number: int, command: str, args: dict[str, str]) -> None:
        if command in ("G0", "G1", "G2", "G3"):
            self.last = command
            self.move(number, command, {c: float(n) for c, n in args.items()})
        elif command in ("G20", "G21"):
            self.unit = 25.4 if command == "G20" else 1.0
        elif command in ("G90", "G91"):
            self.relative, self.g91_counts = command == "G91", True
        elif command == "G4":
            self.rows.append(Row(number, self.place(), 0.0, 0.0, self.feed * self.speed))
        elif command in ("G10", "G11") and not args:
            self.rows.append(Row(number, self.place(), 0.0, 0.0, self.feed * self.speed))
        elif command == "G28":
            named, start = [k for k, c in enumerate("XYZ") if c in args] or [0, 1, 2], self.place()
            for k in named:
                self.machine[k] = self.offset[k] = 0.0
            way = math.dist(start, self.place())
            self.rows.append(Row(number, self.place(), way, 0.0, self.feed * self.speed))
        elif command == "G92":
            for k, c in enumerate("XYZ"):
                if c in args or not args:
                    new = float(args.get(c, 0)) * self.unit
                    self.offset[k] += self.machine[k] - new
                    self.machine[k] = new
            if self.letter in args or not args:
                self.e[self.tool] = float(args.get(self.letter, 0)) * self.unit

    def move(self, number: int, command: str, args: dict[str, float]) -> None:
        start = self.place()
        if args.get("F", 0) > 0:
            self.feed = args["F"] * self.unit / 60
        for k, c in enumerate("XYZ"):
            if c in args:
                self.machine[k] = args[c] * self.unit + (self.machine[k] if self.relative else 0.0)
        end = self.place()
        length = math.dist(start, end)
        if command in ("G2", "G3") and set(args) & set("XYIJR"):
            length = math.hypot(self.arc(command, start, end, args), end[2] - start[2])
        e = 0.0
        if self.letter in args and not self.pin:
            value, old = args[self.letter] * self.unit, self.e.get(self.tool, 0.0)
            e = value if self.m83 or self.relative and self.g91_counts else value - old
            self.e[self.tool] = old + e
        if length > 1e-9 or abs(e) > 1e-9:
            self.rows.append(Row(number, end, length, self.volume(e), self.feed * self.speed))

    def volume(self, e: float) -> float:
        share = self.percent.get(self.tool, 100.0) / 100
        if self.cubic.get(self.tool, self.default_cubic):
            return e * share
        return e * share * math.pi * (self.diameter.get(self.tool, math.nan) / 2) ** 2

    def arc(self, command: str, start, end, args: dict[str, float]) -> float:
        """Length in the plane, on the complex plane: the centre from I J, or from the radius's triangle."""
        a, b, way = complex(*start[:2]), complex(*end[:2]), -1 if command == "G2" else 1
        if "R" in args:
            r, chord = args["R"] * self.unit, b - a
            height = math.sqrt(max(r * r - abs(chord / 2) ** 2, 0.0))
            centre = (a + b) / 2 + 1j * chord / abs(chord) * height * way * math.copysign(1, r)
        else:
            centre = a + complex(args.get("I", 0), args.get("J", 0)) * self.unit
        turn = cmath.phase((b - centre) / (a - centre)) * way if abs(b - a) > 1e-9 else 0.0
        turn += 2 * math.pi if turn <= 0 else 0.0
        turn += 2 * math.pi * max(args.get("P", 1) - 1, 0)
        return turn * (abs(a - centre) + abs(b - centre)) / 2
