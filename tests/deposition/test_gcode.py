"""G-code as it is found: columns against a machine that reads one line at a time,
each dialect's traps by hand, and what is refused."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.deposition.toolpath import gcode, gcode_words
from pipeline.deposition.toolpath.gcode import Kind, parse

PARTS = Path(__file__).parents[2] / "datasets" / "parts"


def moves(text):
    return parse(text).moves


def kinds(text):
    return [Kind(k).name for k in moves(text).kind]


# ---- against a machine that reads one line at a time


class Machine:
    """The plain reading of a program without traps of text: one
    command a line, state kept from line to line."""

    def __init__(self):
        self.named, self.shift, self.feed, self.tool, self.rows = (
            dict.fromkeys("XYZ", 0.0),
            dict.fromkeys("XYZ", 0.0),
            np.nan,
            0,
            [],
        )
        self.e, self.relative, self.e_relative, self.unit, self.last = {}, False, False, 1.0, "G1"

    def at(self):
        return [self.named[c] + self.shift[c] for c in "XYZ"]

    def do(self, number, command, words):
        if command[0] == "T":
            if self.tool != int(command[1:]):
                self.tool = int(command[1:])
                self.row(number, self.at(), 0.0)
        elif command in ("G20", "G21"):
            self.unit = 25.4 if command == "G20" else 1.0
        elif command in ("G90", "G91"):
            self.relative = command == "G91"
            self.e_relative = self.relative or self.m83
        elif command in ("M82", "M83"):
            self.m83 = command == "M83"
            self.e_relative = self.m83
        elif command == "G92":
            for axis in "XYZ":
                if axis in words or not words:
                    value = words.get(axis, 0.0) * self.unit
                    self.shift[axis] += self.named[axis] - value
                    self.named[axis] = value
            if "E" in words or not words:
                self.e[self.tool] = words.get("E", 0.0) * self.unit
        elif command == "G28":
            before = self.at()
            for axis in "XYZ":
                if axis in words or not words:
                    self.named[axis] = self.shift[axis] = 0.0
            self.row(number, before, 0.0)
        elif command == "G4":
            self.row(number, self.at(), 0.0)
        else:
            self.move(number, words)

    m83 = False

    def move(self, number, words):
        before, e = self.at(), 0.0
        for axis in "XYZ":
            if axis in words:
                self.named[axis] = words[axis] * self.unit + (self.named[axis] if self.relative else 0.0)
        if "E" in words:
            value, old = words["E"] * self.unit, self.e.get(self.tool, 0.0)
            e = value if self.e_relative else value - old
            self.e[self.tool] = old + e
        if words.get("F", 0) > 0:
            self.feed = words["F"] * self.unit / 60
        if np.abs(np.subtract(self.at(), before)).max() > 1e-9 or abs(e) > 1e-9:
            self.row(number, before, e)

    def row(self, number, before, e):
        self.rows.append((number, *before, *self.at(), e, self.feed, self.tool))


NUMBER = st.builds(
    "{}{}{}".format,
    st.sampled_from(["", "-", "+"]),
    st.sampled_from(["0", "7", "12", "007", "103"]),
    st.sampled_from(["", ".", ".5", ".25", ".0625"]),
)
NUMBER |= st.sampled_from([".5", "-.5", "+.125", "1.123456789012", "123456789.5", "-0"])
AXES = st.dictionaries(st.sampled_from("XYZEF"), NUMBER, min_size=1, max_size=5)
COMMANDS = st.one_of(
    st.tuples(st.sampled_from(["G0", "G1", "G00", "G01", "G1", "G1", ""]), AXES),
    st.tuples(
        st.sampled_from(["G90", "G91", "M82", "M83", "G20", "G21", "T0", "T1", "T2", "G4"]), st.just({})
    ),
    st.tuples(st.just("G92"), st.dictionaries(st.sampled_from("XYZE"), NUMBER, max_size=2)),
    st.tuples(
        st.just("G28"), st.dictionaries(st.sampled_from("XYZ"), st.sampled_from(["", "0"]), max_size=2)
    ),
)


@st.composite
def programs(draw):
    """Text as slicers, people and hosts write it, and the commands that it stands for."""
    lines, meant = [], []
    for command, words in draw(st.lists(COMMANDS, min_size=1, max_size=40)):
        gap = draw(st.sampled_from([" ", " ", " ", "", "  ", "\t", " (a (nested; G1 X9) one) "]))
        line = (
            gap.join([command, *(letter + value for letter, value in words.items())])
            if command
            else gap.join(letter + value for letter, value in words.items())
        )
        line = draw(st.sampled_from(["", "", "", " ", "N12 "])) + line
        line = line.lower() if draw(st.integers(0, 4)) == 0 else line
        if line[0] in "Nn" and draw(st.booleans()):
            text = re.sub(r"[(].*?one[)]", " ", line).encode()
            line += f"*{np.bitwise_xor.reduce(np.frombuffer(text, np.uint8))}"
        line += draw(st.sampled_from(["", "", " ", ";", " ; X5 (Y7", "; done é", " (speed)"]))
        lines.append(
            line + draw(st.sampled_from(["", "", "", "\n", "\n;G1 X1", "\nM117 G1 X9 Y9", "\nM104 S200"]))
        )
        meant.append(
            (
                1 + sum(text.count("\n") + 1 for text in lines[:-1]),
                command,
                {k: float(v or 0) for k, v in words.items()},
            )
        )
    return draw(st.sampled_from(["\n", "\r\n"])).join(lines), meant


@settings(max_examples=200, deadline=None)
@given(programs())
def test_columns_agree_with_a_machine_that_reads_one_line_at_a_time(program):
    text, meant = program
    machine = Machine()
    for number, command, words in meant:
        command = re.sub(r"^([GMT])0+(?=\d)", r"\1", command)
        machine.do(number, command or "G1", words)
    try:
        found = parse(text)
    except ValueError as error:
        assert "no G-code" in str(error) and not re.search("[GMTgmt]\\d", re.sub("[;(].*", "", text))
        return
    assert found.refusals == []
    m = found.moves
    np.testing.assert_array_equal(m.line, [row[0] for row in machine.rows])
    got = np.column_stack([m.start, m.end, m.e, m.feed, m.tool])
    # G92 and relative moves are summed in another order: rounding of coordinates up to 1e9
    np.testing.assert_allclose(
        got, np.array([row[1:] for row in machine.rows]).reshape(-1, 9), rtol=1e-12, atol=1e-6
    )
    # one chain: nothing jumps, whatever is renamed
    np.testing.assert_allclose(m.start[1:], m.end[:-1], atol=1e-6)


# ---- words, by hand


@pytest.mark.parametrize(
    ("line", "end", "e"),
    [
        ("G1X10Y5E.3", (10, 5, 0), 0.3),
        ("g1 x10 y5 e.3", (10, 5, 0), 0.3),
        ("G01 X+3. Y-.5 E-.5", (3, -0.5, 0), -0.5),
        ("G1 X 10 Y 5 E 0.3", (10, 5, 0), 0.3),
        ("G1 X10\tY5\tE0.3", (10, 5, 0), 0.3),
        ("G1 (to X9) X10 (a (b) c) Y5 E0.3 ; and (X7", (10, 5, 0), 0.3),
        ("N7 G1 X10 Y5 E0.3", (10, 5, 0), 0.3),
        ("X10 Y5 E0.3", (10, 5, 0), 0.3),
        ("G1 X10 Y5 @pause E9", (10, 5, 0), 0.0),
        ("G0 G90 G54 X10 Y5", (10, 5, 0), 0.0),
        ("G1 X1e+1 Y5 E3e-1", (10, 5, 0), 0.3),  # an exponent, for words stand apart
        ("G1 X10 Y5 E1E-05", (10, 5, 0), 1e-5),
        ("G1X10E-5", (10, 0, 0), -5.0),  # a word, for words stand together
        ("G1 X10 Y5E-.5", (10, 5, 0), -0.5),
        ("G1 X10.000000000000001 Y5 E0.3000000000000000", (10, 5, 0), 0.3),
        ("G1 X0010 Y5 E000.3", (10, 5, 0), 0.3),
    ],
)
def test_a_move_is_read_however_it_is_written(line, end, e):
    program = parse(f"M83\n{line}\n")
    assert program.refusals == []
    assert program.moves.line.tolist() == [2]
    np.testing.assert_allclose(program.moves.end[0], end, atol=1e-14)  # as the literal: both are rounded once
    assert program.moves.e[0] == e


@pytest.mark.parametrize(
    "wrapped",
    [
        b"\xef\xbb\xbfG1 X1\r\nG1 X2 ; caf\xe9\r\n",
        "\ufeffG1 X1\nG1 X2 ; ☃\n",
        "G1 X1\rG1 X2",
        "G1 X1\nG1 X2\n".encode("utf-16"),
        b"G1 X1\n\nG1 X2",
    ],
)
def test_line_ends_byte_order_marks_and_foreign_letters_do_not_matter(wrapped):
    assert moves(wrapped).end[:, 0].tolist() == [1, 2]


def test_free_text_is_never_a_move():
    text = (
        'M117 G1 X50 E5\nM117 X10 Y10\nM118 E1 P0 X5\nM486 AG1 X99\nM23 G1.gco\nM98 P"X5"\nM28 X5.g\n'
        "M1002 gcode_claim_action : 2\nM204 P800\nG1 X1\n@info G1 X3\n%\n"
    )
    program = parse(text)
    assert program.moves.line.tolist() == [10] and program.refusals == []
    assert list(zip(program.other_line.tolist(), program.other_word.tolist(), strict=True)) == [
        (1, "M117"), (2, "M117"), (3, "M118"), (4, "M486"), (5, "M23"), (6, "M98"), (7, "M28"), (8, "M1002"),
        (11, "@info"), (12, "%"),
    ]  # fmt: skip


def test_several_commands_in_every_line_are_all_moves():
    many = "".join(f"G1 X{k} G1 X{k}.25 G1 X{k}.5 G1 X{k}.75 E1\n" for k in range(1, 30_000))
    found = parse(f"G21\nG90\nM83\nG1 F600\n{many}").moves  # more than one chunk
    assert len(found.line) == 4 * 29_999
    np.testing.assert_allclose(found.end[:, 0], 1 + 0.25 * np.arange(len(found.line)))


def test_numbers_of_lines_may_stand_before_some_lines_only():
    plain = "G21\nG90\nM83\nG1 X10 E1 F600\nG1 Y5 E1\nG1 X0 E1\n"
    some = "G21\nN7 G90\nM83\nN9 G1 X10 E1 F600\nG1 Y5 E1\nN10 G1 X0 E1\n"
    for one, other in zip(parse(plain).moves, parse(some).moves, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("radius", "off", "read"), [(20, 0.9, True), (20, 1.1, False), (2, 0.45, True), (2, 0.55, False)]
)
def test_an_arc_may_miss_its_circle_by_half_a_millimetre_or_a_twentieth(radius, off, read):
    """From the right of the circle to its left, the end so far outside."""
    program = parse(f"G21\nG90\nM83\nG0 X{radius} Y0 F600\nG3 X{-radius - off} Y0 I{-radius} J0 E1\n")
    assert (len(program.refusals) == 0) == read
    assert np.any(program.moves.angle > 0) == read


def test_more_pins_than_a_board_has_are_refused_by_line():
    text = "G21\nG90\nG1 F600\n" + "".join(f"M42 P{k} S255\nG1 X{k + 1}\nM42 P{k} S0\n" for k in range(70))
    program = parse(text, extruder="M42 P3")
    (refusal,) = program.refusals
    assert "expected at most 64 pins of M42, found more" in refusal.why
    assert refusal.line == 4 + 3 * 64
    assert np.flatnonzero(program.moves.kind == Kind.EXTRUDE).tolist() == [3]


@pytest.mark.parametrize("word", ["M200 D1.75", "M204 S500", "M220 S90", "M221 S90"])
def test_an_e_beside_a_setting_is_refused(word):
    program = parse(f"G21\nG90\nM83\nG1 X10 E1 F600\n{word} E2\nG1 X20 E1\n")
    assert [one.line for one in program.refusals] == [5]
    assert "expected no E beside M200, M204, M220 or M221" in program.refusals[0].why
    assert not parse(f"G21\nG90\nM83\nG1 X10 E1 F600\n{word}\nG1 X20 E1\n").refusals


def test_macros_and_template_rests_are_kept_with_their_lines():
    text = (
        "START_PRINT BED=60 X=5\nEXCLUDE_OBJECT_START NAME=cube_id_0\n{if layer_z > 5}\n_HEAT\nG1 X1\n"
        "T[next_extruder]\nTx\nif {state.x} = 1\nset global.y = 2\n$DO6.0=1\n"
    )
    program = parse(text)
    assert program.moves.line.tolist() == [5] and program.refusals == []
    assert program.other_line.tolist() == [1, 2, 3, 4, 6, 7, 8, 9, 10]
    assert program.other_word.tolist()[:2] == ["START_PRINT", "EXCLUDE_OBJECT_START"]


def test_accelerations_of_both_firmwares_are_kept_with_the_moves():
    m = moves(
        "G1 X1\nM204 P800 T1500\nG1 X2\nSET_VELOCITY_LIMIT ACCEL=3000 ACCEL_TO_DECEL=1500\nG1 "
        "X3\nM204 S500\nG1 X4\n"
    )
    np.testing.assert_array_equal(m.acceleration, [np.nan, 800, 3000, 500])


def test_checksums_are_checked():
    good, bad = "N3 T0*57", "N4 G1 X5*12"
    program = parse(f"{good}\n{bad}\nN5 G1 X7 *92\nG1 X8\n")
    assert program.refused_line.tolist() == [2, 3]
    assert [(r.line, r.count) for r in program.refusals] == [(2, 2)], "one kind, told once"
    assert "expected the checksum 12 of the line, found" in program.refusals[0].why
    assert program.moves.end[:, 0].tolist() == [8]


# ---- state, by hand


def test_kinds_of_moves():
    text = (
        "M83\nG1 F1800\nG0 X1\nG1 X2 E1\nG1 E-2\nG1 X3 E-.5\nG0 Z1\nG0 X9 Z1\nG0 Z0\nG1 E2.5\nG1 E3\nG1 "
        "X10 E1\nG10\nG11\nG4 P250\nT1\nG28 X\nG10 P0 S200\nG1 X0 F0\nG1 X0\n"
    )
    names = [
        "TRAVEL",
        "EXTRUDE",
        "RETRACT",
        "WIPE",
        "TRAVEL",
        "TRAVEL",
        "TRAVEL",
        "UNRETRACT",
        "PRIME",
        "EXTRUDE",
        "RETRACT",
        "UNRETRACT",
        "DWELL",
        "TOOL",
        "HOME",
    ]
    program = parse(text)
    assert [Kind(k).name for k in program.moves.kind] == names
    assert program.other_word.tolist() == ["G10"]  # with P it sets temperatures
    assert program.moves.dwell_s[12] == 0.25 and program.moves.tool[13] == 1
    assert set(program.moves.feed) == {30.0}  # F alone counts, F0 does not


def test_a_prime_while_lifting_back_is_no_printing():
    assert kinds("M83\nG1 X1 E1\nG1 E-1\nG1 Z1\nG1 Z0 E1\nG1 X2 E1\nG1 Z3 E1\n") == [
        "EXTRUDE",
        "RETRACT",
        "TRAVEL",
        "UNRETRACT",
        "EXTRUDE",
        "EXTRUDE",
    ]


def test_extrusion_counts_for_each_tool_apart():
    m = moves("M82\nT0\nG1 X1 E10\nT1\nG1 X2 E1\nT0\nG1 X3 E11\nG92 E0\nG1 X4 E1\nT1\nG1 X5 E3\n")
    assert m.e[m.kind == Kind.EXTRUDE].tolist() == [10, 1, 1, 1, 2]
    assert m.tool[m.kind == Kind.EXTRUDE].tolist() == [0, 1, 0, 0, 1]


@pytest.mark.parametrize(
    ("mode", "e"),
    [
        ("M82", 5.0),
        ("M83", 5.0),
        ("M83\nG90", 5.0),
        ("M83\nG91\nG90", 5.0),
        ("G91", 5.0),
        ("M82\nG92 E3", 2.0),
        ("G92 E3\nG91\nM82", 2.0),
        ("G92 X3\nG92 E0", 5.0),
        ("G92", 5.0),
    ],
)
def test_the_mode_of_e(mode, e):
    assert moves(f"M82\nG92 E0\n{mode}\nG1 X1 E5\n").e.tolist() == [e]


def test_inches_and_places_renamed():
    m = moves("G20\nG1 X1 F60\nG92 X0\nG21\nG1 X10\nG28 X\nG1 X3\n")
    assert m.end[:, 0].tolist() == [25.4, 35.4, 0.0, 3.0]
    assert m.feed[0] == 25.4


@pytest.mark.parametrize(
    ("text", "tools"),
    [
        ("T1", [1]),
        ("T0", []),
        ("M6 T1", [1]),
        ("T1 M6", [1]),
        ("M135 T1", [1]),
        ("ACTIVATE_EXTRUDER EXTRUDER=extruder1", [1]),
        ("M104 S200 T1", []),
        ("T255", []),
        ("T-1", []),
        ("T1000", []),
    ],
)
def test_words_that_change_the_tool(text, tools):
    m = moves(f"G1 X1\n{text}\nG1 X2\n")
    assert m.tool[m.kind == Kind.TOOL].tolist() == tools


@pytest.mark.parametrize(
    ("on", "off", "name"),
    [
        ("M42 P4 S255", "M42 P4 S0", "M42 P4"),
        ("M42 S255", "M42 S0", "M42"),
        ("M42 P4 M1 S255", "M42 P4 M1 S0", "M42 P4"),
        ("M760", "M761", "M760"),
        ("M7", "M9", "M7"),
        ("M8", "M9", "M7"),
        ("M3 S1000", "M5", "M3"),
        ("M106 S255", "M107", "M106"),
        ("M106", "M106 S0", "M106"),
    ]
    + [
        ("M126", "M127", "M126"),
        ("M101", "M103", "M101"),
        ("M64 P0", "M65 P0", "M64"),
        ("M62 P0", "M63 P0", "M64"),
        ("M10", "M11", "M10"),
    ],
)
def test_paste_printers_that_switch_extrusion(on, off, name):
    program = parse(f"G0 X1\n{on}\nG1 X4 Y4\nG2 X4 Y4 I1\n{off}\nG0 X0\n")
    assert program.extruder == name and program.other_word.tolist() == []
    assert [Kind(k).name for k in program.moves.kind] == ["TRAVEL", "EXTRUDE", "EXTRUDE", "TRAVEL"]
    np.testing.assert_allclose(program.moves.e, [0, 5, 2 * np.pi, 0], rtol=1e-15)  # mm of path; rounding


def test_a_pin_s_mode_beside_it_is_no_foreign_word():
    assert parse("M42 P4 M1 S255\nG1 X4\nM42 P4 M1 S0\nG1 X9\n").refusals == []


def test_settings_at_their_least_are_taken():
    text = "M82\nM221 S0.5\nM204 P0.5\nG1 X1 E2\nM200 D1.75\nG1 X2 E3\nM200 D0\nG1 X3 E4\n"
    program = parse(text)
    assert program.refusals == [] and program.other_word.tolist() == []
    assert program.flow.tolist() == [0.005] * 3 and program.moves.acceleration.tolist() == [0.5] * 3
    # a diameter alone makes E count mm^3, none makes it count mm again, and the diameter stays known
    assert program.volumetric.tolist() == [False, True, False] and program.diameter_mm == {0: 1.75}


def test_what_is_pressed_before_anything_was_retracted_primes():
    assert kinds("M83\nG1 E5 F100\nG1 X10 E1\nG1 E-2\nG1 E2\n") == [
        "PRIME",
        "EXTRUDE",
        "RETRACT",
        "UNRETRACT",
    ]


def test_e_is_renamed_by_a_piece_of_the_text_in_which_nothing_presses(monkeypatch):
    text = "G1 X1 E5\n;\nG92 E0\n;\nG1 X2 E1\n"
    whole = moves(text).e.tolist()
    monkeypatch.setattr(gcode_words, "CHUNK", 4)  # every line by itself
    assert moves(text).e.tolist() == whole == [5, 1]


def test_a_fan_is_no_switch_where_e_is_driven():
    program = parse("M106 S255\nG1 X1 E1\nG0 X2\nM107\n")
    assert program.extruder == "E" and program.moves.e.tolist() == [1, 0]


@pytest.mark.parametrize("letter", ["U", "A", "B", "C"])
def test_paste_printers_that_drive_another_letter(letter):
    program = parse(f"G92 {letter}0\nG1 X1 {letter}2\nG1 X2 {letter}2.5\nG0 X3\n")
    assert program.extruder == letter and program.moves.e.tolist() == [2, 0.5, 0]


# ---- arcs


@pytest.mark.parametrize(
    ("arc", "centre", "angle", "length"),
    [
        ("G3 X0 Y10 I-10 J0", (0, 0), np.pi / 2, 5 * np.pi),
        ("G2 X0 Y10 I-10 J0", (0, 0), -3 * np.pi / 2, 15 * np.pi),
        ("G3 X0 Y10 R10", (0, 0), np.pi / 2, 5 * np.pi),
        ("G3 X0 Y10 R-10", (10, 10), 3 * np.pi / 2, 15 * np.pi),
        ("G2 X0 Y10 R10", (10, 10), -np.pi / 2, 5 * np.pi),
        ("G2 X-10 Y0 R10", (0, 0), -np.pi, 10 * np.pi),
        ("G2 X-10 Y0 R9.9951", (0, 0), -np.pi, 10 * np.pi),  # a half circle whose radius was rounded
        ("G3 I-10", (0, 0), 2 * np.pi, 20 * np.pi),
        ("G2 X10 Y0 I-10 J0", (0, 0), -2 * np.pi, 20 * np.pi),
        ("G3 Z15 I-10 P1", (0, 0), 2 * np.pi, np.hypot(20 * np.pi, 15)),
        ("G3 X0 Y10 Z15 I-10 P3", (0, 0), 4.5 * np.pi, np.hypot(45 * np.pi, 15)),
        ("G91\nG3 X-10 Y10 I-10", (0, 0), np.pi / 2, 5 * np.pi),
        ("G18\nG17\nG3 X0 Y10 I-10", (0, 0), np.pi / 2, 5 * np.pi),
        ("G92 X0\nG3 X-10 Y10 I-10", (0, 0), np.pi / 2, 5 * np.pi),
    ],
)
def test_arcs_have_their_true_centre_sweep_and_length(arc, centre, angle, length):
    program = parse(f"G0 X10\n{arc}\n")
    assert program.refusals == []
    np.testing.assert_allclose(program.moves.centre[1], centre, atol=1e-9)  # rounding
    assert program.moves.angle[1] == pytest.approx(
        angle, rel=1e-3 if "9.99" in arc else 1e-12
    )  # the rounded radius moves the centre
    assert program.moves.length[1] == pytest.approx(length, rel=1e-3 if "9.99" in arc else 1e-12)


@settings(max_examples=60, deadline=None)
@given(st.floats(0.1, 100), st.floats(-3, 3), st.floats(0.05, 3.1), st.sampled_from([2, 3]))
def test_both_forms_of_an_arc_are_the_same_arc(radius, heading, sweep, code):
    way = 1 if code == 3 else -1
    a, b = (radius * np.array([np.cos(h), np.sin(h)]) for h in (heading, heading + way * sweep))
    by_centre, by_radius = (
        moves(f"G0 X{a[0]:.9f} Y{a[1]:.9f}\nG{code} X{b[0]:.9f} Y{b[1]:.9f} {c}")
        for c in (f"I{-a[0]:.9f} J{-a[1]:.9f}", f"R{radius:.9f}")
    )
    # nine decimals of the text; near a half circle the centre of the R form turns by the root of that
    assert by_centre.angle[1] == pytest.approx(way * sweep, abs=1e-6)
    assert by_radius.angle[1] == pytest.approx(by_centre.angle[1], abs=1e-4)


# ---- refusals


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("G1 X Y5", "expected letters with a number each, found 'X Y5'"),
        ("G1 X1.2.3", "found '.3'"),
        ("G1 X{first} Y3", "found 'X{first} Y3'"),
        ("G1 X--5", "found 'X--5'"),
        ("G1 X5 hello", "found 'hello'"),
        ("G1 X5 (to the left", "found '(to the left'"),
        ("17 4", "found '17 4'"),
        ("GG1 X4", "found 'GG1 X4'"),
        ("G1 X5 X6", "each letter once"),
        ("G92 E0 E1", "each letter once"),
        ("G18\nG2 X5 I2", "plane of X and Y"),
        ("G90.1\nG2 X5 I2", "G90.1"),
        ("G2 X20 R5", "on its circle"),
        ("G2 X20 Y3 I1 J0", "on its circle"),
        ("G3 X1 Y1 R5", "on its circle"),
        ("G5 I1 J1 P0 Q0 X3 Y3", "G5"),
        ("G92.1", "G92.1"),
        ("\x81\x00\x82", "found"),
    ],
)
def test_a_line_that_cannot_be_read_is_refused_with_its_number(line, why):
    program = parse(f"G1 X1 Y1\n{line}\nG1 X2 Y2\n")
    assert [r.line for r in program.refusals] == [2 + line.count("\n")]
    assert why in program.refusals[0].why
    assert program.moves.line.tolist() == [1, 3 + line.count("\n")]


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "found 0 lines without"),
        ("; only\n(comments)\n", "found 2 lines without"),
        ("x,y\n1,2\n", "no G-code"),
        (b"GCDE\x01\x00\x00\x00\x01\x00" + bytes(range(256)) * 9, "binary, beginning b'GCDE'"),
        (b"PK\x03\x04\x14\x00\x08\x00" * 40, "binary, beginning b'PK"),
    ],
)
def test_what_is_no_program_is_refused_in_one_sentence(data, why):
    with pytest.raises(ValueError, match=re.escape(why)) as refused:
        parse(data)
    assert "\n" not in str(refused.value)


@settings(max_examples=120, deadline=None)
@given(
    st.lists(
        st.text(st.sampled_from("GMTXYZEFIJRNS0123456789.-+;()*@ {}\t\r\x00\xff_e\n"), max_size=12),
        min_size=1,
        max_size=30,
    ),
    st.randoms(use_true_random=False),
)
def test_damaged_text_never_raises_and_never_jumps(damage, random):
    lines = ["G1 X1 Y2 E3", "G28", "T1", "G92 E0", "G2 X5 Y5 I2 J2"] * 3 + damage
    random.shuffle(lines)
    program = parse("G1 X0\n" * 200 + "\n".join(lines))
    assert (
        np.isfinite(program.moves.end).all()
        and np.isfinite(program.moves.length).all()
        and np.isfinite(program.moves.e).all()
    )
    assert (np.diff(program.moves.line) >= 0).all() and (program.moves.length >= 0).all()


def test_refusals_of_one_kind_are_told_once_with_their_number():
    program = parse("G1 X1\n" + "G1 X Y5\nG5 X1\n" * 400 + "G1 X2\n")
    assert [(r.line, r.count) for r in program.refusals] == [(2, 400), (3, 400)]
    assert program.refusals[0].why.endswith("found 'X Y5' (and 399 more such)")
    assert program.accounted.refused == len(program.refused_line) == 800


@pytest.mark.parametrize("beside", ["X5", "Y2 Z1"])
def test_axes_beside_a_switch_are_refused_and_the_switch_is_not_lost(beside):
    program = parse(f"G0 X1\nM42 P4 S255 {beside}\nG1 X9\nM42 P4 S0\nG0 X0\n")
    assert "no X, Y or Z beside an M word" in program.refusals[0].why and program.refusals[0].line == 2
    assert program.moves.e.tolist() == [0, 8, 0]


def test_foreign_words_beside_a_pin_are_refused():
    program = parse("G0 X1\nM42 P4 C1 S255\nG1 X9\n")
    assert "P and S beside M42" in program.refusals[0].why and program.extruder == "M42 P4"


# ---- what slicers set beside moves


@pytest.mark.parametrize("axis", ["U", "E", "A", "V", "W"])
def test_g92_of_an_axis_touches_that_axis_alone(axis):
    m = moves(f"G92 X5\nG1 X15 Y3 Z1 U2\nG92 {axis}0\nG1 X16 Y3 Z1\nG92\nG1 X1\n")
    assert m.end.tolist() == [[10, 3, 1], [11, 3, 1], [12, 3, 1]]  # G92 alone names all of them


def test_g92_of_e_leaves_a_plunger_where_it_is():
    assert moves("G1 X1 U2\nG92 E0\nG1 X2 U3\nG92 U0\nG1 X3 U3\n").e.tolist() == [2, 1, 3]


def test_a_tool_cap_is_no_extruder_and_hides_no_valve():
    program = parse("C1 S0\nT1\nC1 S255\nG0 X1\nM42 P16 S255\nG1 X4 Y4\nM42 P16 S0\nG0 X0\n")
    assert program.extruder == "M42 P16" and program.moves.e.tolist() == [0, 0, 5, 0]
    assert program.other_word.tolist() == ["C1", "C1"] and program.other_line.tolist() == [1, 3]


def test_a_lamp_that_stays_on_is_no_valve_and_a_pin_may_be_asked_for():
    text = "M42 P17 S255\nG0 X1\nM42 P16 S255\nG1 X4\nM42 P16 S0\nG0 X9\n"
    program = parse(text)
    assert program.extruder == "M42 P16" and program.moves.e.tolist() == [0, 3, 0]
    assert [(t.word, t.count) for t in program.told] == [("M42", 1)]
    assert parse(text, extruder="M42 P17").moves.e.tolist() == [1, 3, 5]
    with pytest.raises(ValueError, match=r"driven by U; found M42 P16, M42 P17"):
        parse(text, extruder="U")


def test_speed_and_flow_percent_apply_from_their_line_on():
    text = (
        "M83\nG1 X1 E1 F600\nM220 S50\nM221 S90\nG1 X2 E1\nM220 B\nM220 S200\nG1 X3 E1\nM220 R\n"
        "M221 T1 S80\nG1 X4 E1\nT1\nG1 X5 E1\n"
    )
    program = parse(text)
    assert program.moves.feed.tolist() == [10, 5, 20, 5, 5, 5]
    assert program.flow.tolist() == [1, 0.9, 0.9, 0.9, 0.8, 0.8]
    assert {(t.word, t.count, t.line) for t in program.told} == {("M220", 4, 3), ("M221", 2, 4)}


def test_words_that_are_no_moves_are_told_once_each():
    text = "M486 S0\nEXCLUDE_OBJECT_START NAME=a\nFOO A=1\nG1 X1 E1\n" * 300 + "EXCLUDE_OBJECT NAME=a\n"
    told = {one.word: one for one in parse(text).told}
    assert {word: (one.count, one.line) for word, one in told.items()} == {
        "M486": (300, 1), "EXCLUDE_OBJECT_START": (300, 2), "FOO": (300, 3), "EXCLUDE_OBJECT": (1, 1201),
    }  # fmt: skip
    assert told["FOO"].what == "" and "here it is composed" in told["EXCLUDE_OBJECT"].what


def test_a_rotary_letter_beside_moves_is_told():
    program = parse("G1 X1 E1 C5\nG1 X2 E2 C6\n")
    assert program.extruder == "E" and program.moves.e.tolist() == [1, 1]
    assert [(t.word, t.count, t.line) for t in program.told] == [("C", 2, 1)]


# ---- hostile and damaged files: one sentence, in bounded time and memory


GOOD = "G21\nM83\n" + "G1 X1 Y1 E.1\nG1 X2 Y2 E.1\n" * 9


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"G1 X1\n" * 40_000 + bytes(400_000), "binary, at its byte 240,000"),
        (bytes(30_000_000), "binary, beginning"),
        (b"some words of a log\n" * 60_000, "without a G, M or T word"),
        (b"1.5,2.5\n" * 60_000, "without a G, M or T word"),
        (b"A" * 100_000_000, "without a G, M or T word"),
        ("M83\nG1 X1 E1\n".encode("utf-16-le") * 9, "binary"),
    ],
)
@pytest.mark.usefixtures("must_end")
def test_what_cannot_be_a_program_is_refused_in_bounded_time(data, why):
    """A second a hundred MB on the slowest machine seen; what is quadratic takes hours."""
    with pytest.raises(ValueError, match=why) as refused:
        parse(data)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "long", ["G1 X1 " * 20_000_000, "(" * 100_000_000, "G1 " + "X1.5" * 25_000_000, "\0" * 5]
)
def test_a_damaged_line_costs_itself_alone(long):
    program = parse(GOOD + long + "\n" + GOOD)
    assert program.refused_line.tolist() == [21] and len(program.moves.line) == 36
    assert program.accounted.refused == 1 and sum(program.accounted) == program.lines == 41


def test_a_long_comment_is_none_of_a_line_s_length():
    program = parse(GOOD + "G1 X7 E1 ; " + "x" * 1_000_000 + "\n; " + "y" * 1_000_000 + "\n")
    assert program.refusals == [] and program.moves.line[-1] == 21 and sum(program.accounted) == program.lines


@pytest.mark.parametrize("number", ["1e+308", "9" * 400, "nan", "inf", "-1e+999", "1e+9", "0x10", "1,5"])
def test_numbers_that_no_machine_has_are_refused(number):
    program = parse(f"G1 X1 Y1\nG1 X{number}\nG1 X2 Y2\n")
    assert program.refused_line.tolist() == [2] and np.isfinite(program.moves.end).all()


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("G1 X10 E1e400", "expected numbers below 1e+09, found E1e400"),
        ("G1X10E1e400", "expected numbers below 1e+09, found E1e400"),
        ("G1 X1e999 E1", "expected numbers below 1e+09, found X1e999"),
        ("G92 E1e400", "expected numbers below 1e+09, found E1e400"),
        ("G1 X10 E1e3", "expected numbers without an exponent, found E1e3; write the number out"),
        ("G1 X10 F-inf", "expected letters with a number each, found 'F-inf'"),
        ("G1 X10 E1 E2", "expected each letter once in a command, found one twice; write two lines"),
        (
            "M204 P1e400",
            "expected no E beside M200, M204, M220 or M221, found one; write numbers without an exponent",
        ),
    ],
)
def test_a_number_that_cannot_be_read_is_refused_for_its_own_reason(line, why):
    program = parse(f"M83\nG1 X1 E1 F600\n{line}\nG1 X20 E1\n")
    assert [(one.line, one.why) for one in program.refusals] == [(3, why)]
    assert program.moves.end[:, 0].tolist() == [1, 20] and program.moves.feed.tolist() == [10, 10]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("G1 X1 E1e400\n", r"line 1: expected numbers below 1e\+09, found E1e400; export it again"),
        ("1,5\n; a note\n\nN7 g1 Xnan ; no\n", "line 4: expected letters .* found 'Xnan' .and 1 more line."),
        ("G1 X Y5\n" * 30_000, "line 1: expected letters with a number each, .*29,999 more lines"),
        ("G1 X1 " * 20_000, "line 1: expected at most 65,536 characters in a line, found more"),
        ("N1 G1 X1*7\n", "line 1: expected the checksum 7 of the line"),
        ("Gladly\nMonday\n1,5\n5 G1\n", "4 lines without a G, M or T word"),
        ("hello\n" * 60_000 + "G1 X1e999\n", "the first 4.* lines without a G, M or T word"),
    ],
)
def test_a_program_all_of_whose_commands_are_refused_says_which_and_why(text, why):
    with pytest.raises(ValueError, match=why) as refused:
        parse(text)
    assert "\n" not in str(refused.value)


def test_an_e_right_behind_a_number_is_a_word_of_a_compact_line():
    program = parse("M83\nG1X10E1F600\nG1X2E3\nG1 X5E2\ng1x6e4\n")
    assert program.refusals == [] and program.moves.e.tolist() == [1, 3, 2, 4]


@pytest.mark.parametrize(
    "word",
    ["M220 S0", "M220 S1e+300", "M221 S-5", "M221 S1e+99", "M200 D1e+300", "M204 P1e+999", "G1 X5 F1e-30"],
)
def test_settings_that_no_machine_takes_are_refused(word):
    program = parse(f"G1 X1 E1 F600\n{word}\nG1 X2 E2\n")
    assert program.refused_line.tolist() == [2] and program.moves.feed.tolist() == [10, 10]
    assert program.flow.tolist() == [1, 1] and not program.volumetric.any()


def test_a_million_damaged_lines_are_one_refusal():
    program = parse("G1 X1\n" + "G1 X Y5\n" * 100_000)
    assert len(program.refusals) == 1 and program.accounted.refused == 100_000


# ---- the parts, and other people's programs


def test_the_parts_are_read_whole():
    lines = {"fig9": 3, "tic_tac_toe": 9, "dashes": 12}
    for name, printed in lines.items():
        program = parse((PARTS / f"{name}.gcode").read_bytes())
        m = program.moves
        assert program.refusals == [] and program.other_word.tolist() == []
        assert np.count_nonzero(m.kind == Kind.EXTRUDE) == printed
        # E is written as travelled length, to two decimals
        np.testing.assert_allclose(m.e[m.kind == Kind.EXTRUDE], m.length[m.kind == Kind.EXTRUDE], atol=0.006)
    assert gcode.Kind.TOOL not in m.kind


CURA = """;FLAVOR:Marlin
;Filament used: 0.00004m
M140 S60
M82 ;absolute extrusion mode
G28 ;Home
G92 E0
G1 F2700 E-5
;LAYER:0
G0 F7200 X10 Y10 Z0.3
G1 F2700 E0
G1 F1200 X30 Y10 E2
G1 X30 Y30 E4
G1 F2700 E-1
G91 ;Relative positioning
G1 E-2 F2700 ;Retract a bit
G1 E-2 Z0.2 F2400 ;Retract and raise Z
G1 X5 Y5 F3000 ;Wipe out
G90 ;Absolute positioning
M84 X Y E ;Disable all steppers but Z
M82
"""
PRUSA = """; thumbnail begin 16x16 96
; iVBORw0KGgoG1X1E9
M201 X1000 Y1000 Z200 E5000 ; sets maximum accelerations, mm/sec^2
M862.3 P "MK3S" ; printer model check
G90
M83
G28 W ; home all without mesh bed level
G1 Y-3.0 F1000.0 ; go outside print area
G1 X60.0 E9.0 F1000.0 ; intro line
M221 S95
;LAYER_CHANGE
G1 E-.8 F2100
G1 Z.6 F10800
G1 X10 Y10
G1 Z.2
G1 E.8 F2100
M204 P800
;TYPE:External perimeter
G1 F1200
G1 X30 E.5
G1 X30 Y30 E.5
M204 P1000
G1 X29 E-.31 F8640
G1 E-.49 F2100
M73 P100 R0
"""
BAMBU = """M73 P0 R12
M204 P20000 R5000 T20000
M1002 gcode_claim_action : 2
M622 J1
    G29 A X102.9 Y102.9 I50 J50
M623
M620 S0A
T1000
M621 S0A
M83
G1 X10 Y0 F18000
; CHANGE_LAYER
M991 S0 P0 ;notify layer change
G17
G3 Z.6 I1.217 J0 P1  F60000
G1 Z.2
G1 E.8 F1800
G1 X20 Y0 E.5
G2 X30 Y0 I5 J0 E.7
G1 E-.8 F1800
M1006 A0 B10 L100 C37 D10 M60 E37 F10 N60
"""
SIMPLIFY = (
    "G90\nM82\nG28 ; home all axes\nG92 E0\nG1 E0.0 F540\nT0\n; layer 1, Z = 0.200\nG1 Z0.200 F1000\nG1 X1 "
    "Y0 F4800\nG1 E2 F540\nG92 E0\nG1 X11 Y0 E1.5 F1200\nT1\nG92 E0\nG1 X21 E1.5\n"
)
VALVE = "G21\nG90\nM751 P1\nG92 X0 Y0 Z0\nG0 X10 F900\nM760\nG1 X20\nG4 P50\nG1 Y10\nM761\nG0 Z50\n"


@pytest.mark.parametrize(
    ("text", "names", "extruded"),
    [
        (CURA, "HOME RETRACT TRAVEL UNRETRACT EXTRUDE EXTRUDE RETRACT RETRACT WIPE TRAVEL", 4.0),
        (
            PRUSA,
            "HOME TRAVEL EXTRUDE RETRACT TRAVEL TRAVEL TRAVEL UNRETRACT EXTRUDE EXTRUDE WIPE RETRACT",
            10.0,
        ),
        (BAMBU, "TRAVEL TRAVEL TRAVEL PRIME EXTRUDE EXTRUDE RETRACT", 1.2),
        (SIMPLIFY, "HOME TRAVEL TRAVEL PRIME EXTRUDE TOOL EXTRUDE", 3.0),
        (VALVE, "TRAVEL EXTRUDE DWELL EXTRUDE TRAVEL", 20.0),
    ],
)
def test_programs_as_slicers_write_them(text, names, extruded):
    program = parse(text)
    assert program.refusals == []
    assert [Kind(k).name for k in program.moves.kind] == names.split()
    assert program.moves.e[program.moves.kind == Kind.EXTRUDE].sum() == pytest.approx(extruded, rel=1e-12)
