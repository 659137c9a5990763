"""Moves -> tasks: the paper's two parts exactly, runs and corners, the rules of fig. 8 on random programs,
and what is refused with its line number."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.deposition.toolpath import gcode
from pipeline.deposition.toolpath.motion import plan
from pipeline.deposition.toolpath.tasks import DWELL, halting, printed_lines, refuse, sequence
from pipeline.papers.deposition import ALLOWED, forbidden

PARTS = Path(__file__).parents[2] / "datasets" / "parts"
MACHINE = {
    "acceleration": 1000.0,
    "junction_deviation_mm": 0.05,
    "speed_limit": 100.0,
    "unset_feed": 8.0,
    "tool_change_s": 0.0,
}
RULES = {"corner_deg": 30.0, "longest_pause_s": 1.0}
SWITCH_S = 1.0


def read(text):
    program = gcode.parse(text)
    motion = plan(program.moves, **MACHINE)
    return program, motion, printed_lines(program.moves, motion, **RULES)


def tasks_of(text, *, switch_s=SWITCH_S):
    program, motion, lines = read(text)
    refuse(lines, program.moves, halts=halting(program.other_line, program.other_word), switch_s=switch_s)
    return sequence(lines, end_s=float(motion.begin_s[-1] + motion.duration_s[-1]) + 2.0)


def random_program(rng):
    """Lines, travels, turns, halts and changes of tool in any order;
    tool changes sometimes leave no time to stop."""
    text, x = ["G21", "G90", "M83", "T0"], np.zeros(2)
    for _ in range(rng.integers(3, 15)):
        x = x + rng.uniform(-8, 8, 2)
        where = f"X{x[0]:.2f} Y{x[1]:.2f}"
        text += {
            0: [f"G1 {where} E1 F480"],
            1: [f"G1 {where} E1 F480"],
            2: [f"G0 {where} F900"],
            3: [f"G4 P{rng.integers(0, 2500)}"],
            4: [f"T{rng.integers(0, 2)}"],
            5: ["G1 E-1 F1200", f"G0 {where}", "G1 E1"],
            6: ["M600"],
        }[int(rng.choice(7, p=[0.3, 0.2, 0.2, 0.08, 0.1, 0.1, 0.02]))]
    return "\n".join([*text, f"G1 X{x[0] + 5:.2f} Y0 E1 F480"])


def random_tasks(rng):
    """The tasks of a random program; None where it was refused."""
    try:
        return tasks_of(random_program(rng))
    except ValueError as refusal:
        assert str(refusal).startswith("line "), refusal
        return None


# ---- rules


def test_no_random_program_has_a_forbidden_transition():
    rng, refused = np.random.default_rng(0), 0
    for _ in range(200):
        tasks = random_tasks(rng)
        refused += tasks is None
        if tasks is not None:
            assert len(forbidden(tasks.task, tasks.tool)) == 0
            assert np.all(np.diff(tasks.begin_s) >= 0)
            np.testing.assert_array_equal(tasks.end_s[:-1], tasks.begin_s[1:])
    assert 20 < refused < 120  # the programs do ask for what must be refused


def test_every_run_starts_and_stops_once():
    rng = np.random.default_rng(1)
    for _ in range(100):
        text = random_program(rng)
        lines = read(text)[2]
        tasks = sequence(lines, end_s=1e4)
        runs = lines.run[-1] + 1
        assert (
            np.sum(tasks.task == "Start")
            == np.sum(tasks.task == "Stop")
            == runs
            == lines.first.sum()
            == lines.last.sum()
        )
        assert np.sum(tasks.task == "Corner") == lines.corner.sum()


def test_the_rules_are_those_of_figure_8():
    assert list(forbidden(["Steady-State", "No-Flow"], [0, 0])) == [1]
    assert list(forbidden(["Stop", "Start"], [0, 1])) == [1]  # a change of material without a dwell
    assert list(forbidden(["Stop", DWELL, "Start"], [0, 0, 1])) == []
    assert list(forbidden(["No-Flow", "Steady-State"], [0, 0])) == [1]
    assert "No-Flow" not in ALLOWED["Steady-State"]


# ---- the paper's parts


def test_figure_9_is_the_papers_sequence():
    tasks = tasks_of((PARTS / "fig9.gcode").read_text())
    assert tasks.task.tolist() == [
        "No-Flow",
        "Start",
        "Steady-State",
        "Corner",
        "Steady-State",
        "Corner",
        "Steady-State",
        "Stop",
        "No-Flow",
    ]
    assert tasks.line[1] == 9  # the first printed line of the file


def test_tic_tac_toe_is_eight_runs_with_one_change_of_material_between_a_stop_and_a_start():
    tasks = tasks_of((PARTS / "tic_tac_toe.gcode").read_text())
    assert np.sum(tasks.task == "Start") == 8
    k = int(np.flatnonzero(tasks.task == DWELL)[0])
    assert tasks.task[k - 1 : k + 2].tolist() == ["Stop", DWELL, "Start"]
    assert tasks.tool[k - 1 : k + 2].tolist() == [0, 0, 1]
    assert np.sum(tasks.task == "Corner") == 0  # the two halves of the circle join smoothly


def test_dashes_are_twelve_runs_of_0_4_s():
    lines = read((PARTS / "dashes.gcode").read_text())[2]
    assert len(lines.line) == lines.run[-1] + 1 == 12
    np.testing.assert_allclose(
        lines.end_s - lines.begin_s, 0.4, atol=0.01
    )  # 3.2 mm at 8 mm/s; the first also speeds up


# ---- runs and corners by hand

HEAD = "G21\nG90\nM83\nT0\nG0 X10 Y0 F480\n"


def test_a_turn_is_a_corner_from_the_angle_on():
    shallow = tasks_of(HEAD + "G1 X20 Y0 E1\nG1 X30 Y4 E1\nG0 X0 Y0")  # 21.8 degrees
    sharp = tasks_of(HEAD + "G1 X20 Y0 E1\nG1 X30 Y7 E1\nG0 X0 Y0")  # 35 degrees
    assert "Corner" not in shallow.task and "Corner" in sharp.task


def test_a_halt_in_place_is_a_corner_with_its_pause_and_a_long_one_ends_the_run():
    short, long = (tasks_of(HEAD + f"G1 X20 Y0 E1\nG4 P{ms}\nG1 X30 Y0 E1\nG0 X0 Y0") for ms in (300, 1500))
    assert short.task.tolist() == [
        "No-Flow",
        "Start",
        "Steady-State",
        "Corner",
        "Steady-State",
        "Stop",
        "No-Flow",
    ]
    assert short.pause_s[3] == pytest.approx(
        0.3 + 2 * 8 / 1000 / 2
    )  # the dwell, and half of each ramp from and to 8 mm/s at 1000 mm/s^2
    assert np.sum(long.task == "Start") == 2


def test_a_retract_in_place_is_no_stop_and_a_travel_is():
    inside = tasks_of(HEAD + "G1 X20 Y0 E1\nG1 E-1 F2400\nG1 E1\nG1 X30 Y0 E1 F480\nG0 X0 Y0")
    away = tasks_of(HEAD + "G1 X20 Y0 E1\nG1 E-1 F2400\nG0 X25 Y0\nG1 E1\nG1 X30 Y0 E1 F480\nG0 X0 Y0")
    assert np.sum(inside.task == "Start") == 1 and np.sum(away.task == "Start") == 2


# ---- refusals


def test_a_change_of_material_without_time_to_stop_is_refused_with_its_line():
    text = HEAD + "G1 X20 Y0 E1\nT1\nG1 X30 Y0 E1\nG0 X0 Y0"
    expected = (
        r"line 7: T1 comes 0\.00 s after line 6 still printed with T0, so Steady-State would go to No-Flow "
        r"without a Stop; .* write G4 P1000 at the change"
    )
    with pytest.raises(ValueError, match=expected):
        tasks_of(text)
    with pytest.raises(
        ValueError, match=r"line 8: T1 comes 0\.\d+ s after line 6"
    ):  # a travel between does not hide the change
        tasks_of(text.replace("T1\n", "G0 X22\nT1\n"))
    assert DWELL in tasks_of(text.replace("T1\n", "T1\nG4 P1000\n")).task  # and what it says will do does


def test_a_halt_of_the_machine_in_the_middle_of_a_run_is_refused_with_its_line():
    with pytest.raises(
        ValueError,
        match=(
            r"line 7: the machine halts here while line 6 still prints, .* end the line with a travel "
            r"before the halt"
        ),
    ):
        tasks_of(HEAD + "G1 X20 Y0 E1\nM600\nG1 X30 Y0 E1\nG0 X0 Y0")
    tasks_of(HEAD + "G1 X20 Y0 E1\nG0 X25 Y0\nM600\nG1 X30 Y0 E1\nG0 X0 Y0")


def test_a_program_that_prints_nothing_is_refused():
    with pytest.raises(ValueError, match="tasks: expected lines that print but found none among 1 moves"):
        read("G21\nG90\nG0 X10 Y0 F480")


def test_where_the_gantry_starts_slowly_a_line_begins_and_ends_in_the_middle_of_its_ramps():
    text = "G21\nG90\nM83\nT0\nG0 X10 F480\nG1 X40 E1\nG0 X80\nG4 P3000"
    program, quick, lines = read(text)
    slow = plan(program.moves, **MACHINE, printing_acceleration=4.0)  # 8 mm/s in 2 s
    later = printed_lines(program.moves, slow, **RULES)
    assert lines.early_s.tolist() == lines.late_s.tolist() == [0.0]
    assert later.early_s == pytest.approx([1.0]) and later.late_s == pytest.approx([1.0])
    assert later.begin_s - slow.begin_s[lines.move] == pytest.approx([1.0])
    # between the middles of its ramps the line is as long as without them
    assert later.end_s - later.begin_s == pytest.approx(30.0 / 8.0)
    assert lines.begin_s == pytest.approx(quick.begin_s[lines.move])
