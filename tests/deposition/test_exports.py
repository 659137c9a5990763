"""What a part program asks for and what becomes of it: volumes by E, flags, words, commands as files."""

import json
import math
import os
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline.commands import compose
from pipeline.deposition.parts import extrusion, leads, part_report
from pipeline.deposition.parts.forecast import ForecastJudgement
from pipeline.deposition.parts.part import slowed_to
from pipeline.deposition.settings import ComposeParts, Printer
from pipeline.deposition.toolpath import gcode, motion
from pipeline.deposition.toolpath.gcode import Kind
from pipeline.deposition.toolpath.gcode_words import LineRefusal
from pipeline.recordings import part_files
from pipeline.store import params
from stages.compose_parts import compose_part
from tests.deposition.trained import NOZZLE, PLANT, TS, learned

ROOT = Path(__file__).parents[2]
AREA_175 = math.pi * 1.75**2 / 4


@pytest.fixture
def machine():
    """The shipped machine with the nozzle of the trials, and the composer's settings."""
    printer = params.load(Printer, "printer", ROOT / "params.yaml").model_copy(update={"nozzle_mm": NOZZLE})
    return printer, params.load(ComposeParts, "compose_parts", ROOT / "params.yaml")


def part(tmp_path, machine, text, **asked):
    path = tmp_path / "job.gcode"
    path.write_text(text)
    return compose_part(path, learned(PLANT), *machine, **asked)


def line(area_mm2: float, length: float = 40, head: str = "; filament_diameter = 1.75\n") -> str:
    """A program of one line of so many mm^2 by its E."""
    e = area_mm2 * length / AREA_175
    return f"{head}G21\nG90\nM83\nG0 X5 F480\nG1 X{5 + length} E{e:.6f} F480\nG0 X0\nG4 P2000\n"


# ---- E counts


@pytest.mark.parametrize("share", [0.6, 1.0, 1.3])
def test_the_command_presses_out_what_e_asks_for(tmp_path, machine, share):
    bead = machine[0].bead_area_mm2
    done = part(tmp_path, machine, line(share * bead))
    lines = done.conformance.lines
    assert lines.planned_mm3[0] == pytest.approx(share * bead * 40, rel=1e-6)  # six digits of E
    assert lines.length_mm.tolist() == [40]
    # the bar of the page for a line's volume; the declared bead would be off by 1 / share
    assert lines.predicted_mm3[0] == pytest.approx(lines.planned_mm3[0], rel=0.05)


def test_the_difference_to_the_declared_bead_is_told(tmp_path, machine):
    bead = machine[0].bead_area_mm2
    done = part(tmp_path, machine, line(bead / 3.2))
    text = part_report.summary_lines(done)
    assert (
        "volumes by E, diameter 1.75 mm, as the program says" in text
        and "0.31 of the declared bead's" in text
    )
    told = part_report.report(done)["program"]["e_beside_declared_bead"][0]
    assert told["by_e_mm3"] / told["declared_mm3"] == pytest.approx(1 / 3.2, rel=1e-5)
    assert told["area_mm2"] == pytest.approx([bead / 3.2] * 3, rel=1e-5)


def test_the_diameter_is_what_was_asked_for_else_the_program_s_else_the_machine_s(tmp_path, machine):
    printer, settings = machine
    declared = (printer.model_copy(update={"filament_mm": 2.0}), settings)
    for head, machine_, asked, mm, words in [
        ("; filament_diameter = 1.75,2.85\n", declared, {"filament_mm": 3.0}, 3.0, "as asked"),
        ("; filament_diameter = 1.75,2.85\n", declared, {}, 1.75, "as the program says"),
        (";   filamentDiameters,1.75|1.75\n", declared, {}, 1.75, "as the program says"),
        ("; fiber_dia_mm = 1.75\n", declared, {}, 1.75, "as the program says"),
        (";Filament Diameter #1: 1.75\n", declared, {}, 1.75, "as the program says"),
        ("M200 S0 D1.5\n", declared, {}, 1.5, "as the program says"),
        ("M117 filament_diameter = 9\n", declared, {}, 2.0, "as declared"),
        ("", declared, {}, 2.0, "as declared"),
    ]:
        done = part(tmp_path, machine_, line(0.3, head=head), **asked)
        assert done.extruded.source[0] == f"diameter {mm:g} mm, {words}"
        assert done.conformance.lines.planned_mm3[0] == pytest.approx(12 * (mm / 1.75) ** 2, rel=1e-6)


@pytest.mark.parametrize(
    ("head", "asked", "why"),
    [
        ("", {}, "the diameter of what E pushes is not known"),
        ("; filament_diameter = 1.75\n", {"declared_bead": True}, "the declared bead was asked for"),
        ("; filament_diameter = 0\n", {}, "the diameter of what E pushes is not known"),
    ],
)
def test_without_a_diameter_lines_are_declared_beads_and_why_is_told(tmp_path, machine, head, asked, why):
    done = part(tmp_path, machine, line(0.1, head=head), **asked)
    assert done.conformance.lines.planned_mm3[0] == pytest.approx(40 * machine[0].bead_area_mm2)
    assert f"T0: declared bead: {why}" in part_report.summary_lines(done)


def test_flow_percent_and_cubic_millimetres_count():
    text = (
        "; filament_diameter = 1.75\nM83\nG1 X1 E1\nM221 S50\nG1 X2 E1\nM200 D3\nG1 X3 E1\nM200 D0\n"
        "G1 X4 E1\nM221 S100\nG20\nM83\nG1 X5 E1\n"
    )
    program = gcode.parse(text)
    volume = extrusion.volumes(program, program.diameter_mm)
    area = math.pi * 9 / 4  # M200's diameter is the filament's from then on, and said at the end
    assert volume.tolist() == pytest.approx([area, area / 2, 0.5, area / 2, 25.4 * area])


def test_feeds_are_those_of_the_program_times_its_own_factor(tmp_path, machine):
    plain, slower = part(tmp_path, machine, line(0.2)), part(tmp_path, machine, "M220 S50\n" + line(0.2))
    a, b = plain.conformance.lines, slower.conformance.lines
    assert b.planned_mm3[0] == pytest.approx(a.planned_mm3[0])
    assert b.duration_s[0] == pytest.approx(2 * a.duration_s[0], rel=0.01)  # the gantry's ramps


# ---- in words


def test_dots_are_not_told_in_percent(tmp_path, machine):
    text = "G21\nG90\nM83\nG0 X5 F480\nG1 X45 E40 F480\nG0 X60\nG1 X60.02 E.02\nG0 X80\nG1 X120 E40\nG0 X0\n"
    lines = part(tmp_path, machine, text).conformance.lines
    assert np.isnan(lines.error_percent).tolist() == [False, True, False]
    done = part(tmp_path, machine, text)
    assert "volume of" not in part_report.summary_lines(done)  # a dot was not trained: nothing is judged
    (stream,) = done.composed.streams
    judged = stream._replace(judged=ForecastJudgement(True, "", ""))
    text = part_report.summary_lines(done._replace(composed=done.composed._replace(streams=(judged,))))
    assert "of all lines the worst is line 7" not in text and re.search(r"worst is line [59]:", text)


def test_the_summary_is_short_whatever_the_program_holds(tmp_path, machine):
    words = "".join(f"WORD_{chr(65 + k % 26)}{chr(65 + k // 26)}A A=1\n" for k in range(200))
    text = line(0.3) + words * 3 + "G1 X Y\n" * 500 + "".join(f"N{k} G1 X1 *1\n" for k in range(300))
    done = part(tmp_path, machine, text)
    told = part_report.summary_lines(done).splitlines()
    assert len(told) < 30 and max(map(len, told)) < 300
    assert "and 188 more words that are no moves" in told
    assert any("(and 499 more such)" in one for one in told)
    report = part_report.report(done)
    assert len(report["program"]["words"]) == 200 and report["program"]["words"][0]["count"] == 3
    assert sum(report["program"]["lines"].values()) == report["lines_of_the_program"]
    assert report["program"]["lines"]["refused"] == 800 and len(report["refused"]) == 2


# ---- as files


TWO = (
    "G21\nG90\nM83\nT0\nG0 X5 Y5 F600\nG1 X30 Y5 E25 F480\nG1 X30 Y20 E15\nG2 X40 Y30 I10 J0 E15\nG0 X60\n"
    "T1\nG4 P2000\nG0 X5 Y40 F600\nG1 X30 Y40 E25 F480\nG0 X0 Y0\nG4 P2000\n"
)


def test_commands_are_the_same_in_every_format(tmp_path, machine):
    from mcap.reader import make_reader

    done = part(tmp_path, machine, TWO)
    files = compose.write(done, tmp_path / "out", compose.FORMATS)
    assert sorted(file.name for file in files) == [
        "job.conformance.json", "job.leads.gcode", "job.lines.parquet", "job.signal.csv", "job.signal.mcap",
        "job.signal.parquet", "job.tasks.parquet",
    ]  # fmt: skip
    streams = done.composed.streams
    read = np.genfromtxt(tmp_path / "out/job.signal.csv", delimiter=",", names=True)
    table = pq.read_table(tmp_path / "out/job.signal.parquet")
    with open(tmp_path / "out/job.signal.mcap", "rb") as stream:
        found = list(make_reader(stream).iter_messages())
    for stream, name in zip(streams, ("T0_A_mm", "T1_B_mm"), strict=True):
        np.testing.assert_array_equal(read[name], stream.u)
        np.testing.assert_array_equal(table[name].to_numpy(), stream.u)
        mine = [(m.log_time, m.data) for _, c, m in found if c.topic == f"/plunger/T{stream.tool}"]
        # a float64 at the end of the message's bytes
        np.testing.assert_array_equal([np.frombuffer(data[-8:], "<f8")[0] for _, data in mine], stream.u)
        assert mine[50][0] == round(1e9 * 50 * TS)
    report = json.loads((tmp_path / "out/job.conformance.json").read_text())
    assert "lines" not in report and report["printed_lines"] == 4
    assert pq.read_table(tmp_path / "out/job.lines.parquet").num_rows == 4


def test_gcode_with_leads_moves_gantry_and_plunger_as_the_signal_does(tmp_path, machine):
    done = part(tmp_path, machine, TWO)
    text = "\n".join(compose.with_leads(done))
    program, Ts = gcode.parse(text), done.composed.sample_time_s
    m = program.moves
    assert program.refusals == [] and program.extruder == "E"
    way = np.where(m.length > 0, m.length, np.abs(m.e))
    # a change of tool takes the machine's own time, which the plan has as printer.tool_change_s
    seconds = np.where(
        m.kind == Kind.TOOL, machine[0].tool_change_s, np.where(way > 0, way / m.feed, 0) + m.dwell_s
    )
    end = np.cumsum(seconds)
    peak = max(np.abs(stream.u).max() for stream in done.composed.streams)
    clock = np.arange(len(done.composed.streams[0].u)) * Ts
    signal = motion.sampled(done.planned, done.program.moves, sample_time_s=Ts)
    ahead = round(done.composed.lead_in_s / Ts)
    for stream in done.composed.streams:
        mine = (m.tool == stream.tool) & (m.kind != Kind.TOOL)
        place = np.cumsum(np.where(mine, m.e, 0))[mine]
        # what with_leads allows, and six digits of the feed over a minute
        np.testing.assert_allclose(place, np.interp(end[mine], clock, stream.u), atol=0.006 * peak)
    for c in range(3):
        wanted = np.interp(end, np.arange(len(signal.time_s)) * Ts + ahead * Ts, signal.position[:, c])
        # a corner between two samples is cut by the interpolation of this test, not by the legs
        np.testing.assert_allclose(m.end[:, c], wanted, atol=0.2)
    corners = done.program.moves.end[done.program.moves.kind == Kind.EXTRUDE]
    for corner in corners:
        assert np.abs(m.end - corner).sum(axis=1).min() < 2e-3, "lines end where they end"


def test_leads_prime_ahead_of_a_line_and_let_back_ahead_of_its_end(tmp_path, machine):
    done = part(tmp_path, machine, line(machine[0].bead_area_mm2, length=60))
    m = gcode.parse("\n".join(compose.with_leads(done))).moves
    first = int(np.argmax((m.start[:, 0] < 5.001) & (m.end[:, 0] > 5.001)))
    speed = m.e / np.where(m.length > 0, m.length, np.maximum(np.abs(m.e), 1e-9)) * m.feed
    peak = speed[: first + 1].max()
    steady = np.interp(40, m.end[first:, 0], speed[first:])
    assert peak > 0.5 * steady, "filament is pressed before the line begins"
    before_end = speed[(m.end[:, 0] > 60) & (m.end[:, 0] <= 64.9)]
    assert before_end.min() < 0.5 * steady, "and let back before it ends"


@pytest.mark.parametrize("ends", [1.0, 0.6])
def test_e_ends_at_the_volume_of_the_part_over_the_area_of_its_filament(tmp_path, machine, ends):
    bead = ends * machine[0].bead_area_mm2
    done = part(tmp_path, machine, line(bead, length=60))
    net = gcode.parse("\n".join(compose.with_leads(done))).moves.e.sum()
    assert net * AREA_175 == pytest.approx(60 * bead, rel=0.01)


def test_e_of_two_filaments_goes_on_from_tool_to_tool(tmp_path, machine):
    done = part(
        tmp_path, machine, "; filament_diameter = 1.75,1.75\n" + TWO.replace("E25", "E3").replace("E15", "E2")
    )
    m = gcode.parse("\n".join(compose.with_leads(done))).moves
    for tool, volume in ((0, 7 * AREA_175), (1, 3 * AREA_175)):
        assert m.e[m.tool == tool].sum() * AREA_175 == pytest.approx(volume, rel=0.01)


@pytest.mark.parametrize("kind", ["speed", "place"])
def test_a_machine_that_conserves_volume_is_sent_the_volume_over_its_flow_ratio(tmp_path, machine, kind):
    printer = machine[0].model_copy(update={"command": kind, "drive": None})
    done = part(tmp_path, (printer, machine[1]), line(printer.bead_area_mm2, length=60))
    mm = 60 * printer.bead_area_mm2 / learned(PLANT).materials[0].volume_per_mm
    compose.write(done, tmp_path / "out", ("csv", "gcode"))
    signal = np.genfromtxt(tmp_path / "out/job.signal.csv", delimiter=",", names=True)
    pushed = {"speed": lambda: signal["T0_A_mm_per_s"].sum() * TS, "place": lambda: signal["T0_A_mm"][-1]}
    assert pushed[kind]() == pytest.approx(mm, rel=0.01)
    net = gcode.parse((tmp_path / "out/job.leads.gcode").read_text()).moves.e.sum()
    assert net == pytest.approx(mm, rel=0.01)


def test_a_lengthened_ramp_is_several_legs_of_rising_feed(tmp_path, machine):
    """A drive of 10 mm and 20 mm/s makes the gantry speed up over a second: at each end of a leg, and between
    them, it is where it is planned at that time."""
    done = part(tmp_path, machine, line(machine[0].bead_area_mm2, length=60))
    moves, planned, n = done.program.moves, done.planned, len(done.composed.streams[0].u)
    assert slowed_to(planned, moves) is not None
    found = leads.legs(
        moves,
        planned,
        {0: np.zeros(n)},
        lead_in_s=done.composed.lead_in_s,
        sample_time_s=TS,
        tolerance_mm=1.0,
    )
    ends = np.cumsum(found.duration_s)
    signal = motion.sampled(planned, moves, sample_time_s=TS)
    x = np.interp(
        signal.time_s + done.composed.lead_in_s, np.append(0, ends), np.append(0, found.position[:, 0])
    )
    assert np.abs(x - signal.position[:, 0]).max() <= leads.WAY_MM + 1e-6
    feeds = [float(word[1:]) for row in leads.program(found) for word in row.split() if word[0] == "F"]
    begin = int(np.argmin(feeds))  # the travel to it is faster
    assert len(feeds) > begin + 4 and np.all(np.diff(feeds[begin : begin + 5]) > 50)


def test_bends_keep_straight_lines_within_the_tolerance():
    rng = np.random.default_rng(2)
    u = np.repeat(np.cumsum(rng.normal(size=400)), rng.integers(1, 6, 400))
    for tolerance in (0.0, 0.1, 2.0):
        at = leads.bends(u, tolerance)
        between = np.interp(np.arange(len(u)), at, u[at])
        # a cone bounds every sample by its own tolerance, up to rounding
        assert np.abs(between - u).max() <= tolerance + 1e-9
    assert len(leads.bends(u, 2.0)) < len(leads.bends(u, 0.1)) < len(u)
    assert leads.bends(np.zeros(1000), 0.1).tolist() == [0, 999]


# ---- flags and files that cannot be


@pytest.mark.parametrize(
    ("flags", "why"),
    [
        ({"filament_mm": 0.0}, "--filament-mm: expected a number above 0"),
        ({"filament_mm": math.nan}, "--filament-mm: expected"),
        ({"filament_mm": math.inf}, "--filament-mm: expected"),
    ],
)
def test_flags_out_of_range_are_refused_by_name(flags, why):
    given = {"filament_mm": None, "extruder": "", "bead": "e"} | flags
    with pytest.raises(ValueError, match=why):
        compose.request(**given)
    with pytest.raises(ValueError, match=r"--as: expected some of csv, parquet, mcap, gcode, found xls"):
        compose.formats("csv,xls")


def test_pipes_and_large_files_are_refused_without_being_read(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.gcode")
    with pytest.raises(ValueError, match=r"pipe\.gcode"):
        part_files.read_part_program(tmp_path / "pipe.gcode")
    with (tmp_path / "large.gcode").open("wb") as file:
        file.truncate(2_000_000_000)
    with pytest.raises(
        ValueError, match=r"large\.gcode: expected at most 1,000 MB of G-code, found 2,000 MB"
    ):
        part_files.read_part_program(tmp_path / "large.gcode")
    with pytest.raises(ValueError, match="name a part program"):
        part_files.read_part_program(tmp_path / "none.gcode")


def test_what_the_library_lacks_is_told_once_a_task_with_the_number_of_its_lines(tmp_path, machine):
    done = part(tmp_path, machine, TWO)
    many = [LineRefusal(k, f"the library lacks Corner at {k} mm/s; an error of {k} %") for k in range(40, 90)]
    many += [LineRefusal(7, "the library lacks Stop at 8 mm/s")]
    program = gcode.parse("G1 X1\n" + "G1 X Y\n" * 3)
    kinds = part_report.grouped(done.conformance._replace(refused=many), program.refusals)
    assert [(one.line, one.count) for one in kinds] == [(2, 3), (7, 1), (40, 50)]
    assert kinds[2].why == "the library lacks Corner at 40 mm/s; an error of 40 % (and 49 more such)"


def test_a_print_of_days_is_a_slip_named_with_its_line(tmp_path, machine):
    with pytest.raises(
        ValueError, match=r"job\.gcode: expected a print of at most 72 h, .* of which line 5 "
    ):
        part(tmp_path, machine, "G21\nG90\nM83\nG1 X9 E9 F480\nG1 X100 E91 F0.001\n")
