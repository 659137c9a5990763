"""Verification prints: the hardest events of a part on a straight track, what was measured of them, and the
next command."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.deposition.drive import UNLIMITED, Drive, follows
from pipeline.deposition.extruder import flow
from pipeline.deposition.parts import basis, forecast
from pipeline.deposition.parts.composition import learn
from pipeline.deposition.parts.forecast import NAMES
from pipeline.deposition.toolpath import gcode
from pipeline.deposition.toolpath.motion import plan
from pipeline.deposition.toolpath.tasks import printed_lines
from pipeline.recordings import part_files
from tests.deposition.test_composition import MACHINE, composed, of_part
from tests.deposition.trained import AREA, NOMINAL, PLANT, TS, learned, percent_of_on_off
from tests.foreign import parts as foreign_parts
from tests.foreign.extruders import seen
from tests.mcap_writing import Written

LONG = "G21\nG90\nM83\nT0\nG0 X0 Y0 F480\n" + "".join(
    f"G1 X{x} E1\nG0 X{x + 40}\n" for x in range(200, 2000, 240)
)


def hardest(made):
    stream, material = made.streams[0], learned(PLANT).materials[0]
    flows = forecast.flows(material.chain, material.missed, stream.u, stream.r, sample_time_s=TS)
    return forecast.windows(flows, stream.r, made.lines, stream.tool, sample_time_s=TS)


def lines_of(text):
    read = gcode.parse(text)
    return printed_lines(read.moves, plan(read.moves, **MACHINE), corner_deg=30.0, longest_pause_s=1.0)


def test_the_print_is_shorter_than_a_long_part_and_holds_its_hardest_events():
    made = composed(LONG)
    windows = hardest(made)
    assert {window.event for window in windows} <= set(NAMES) and 1 <= len(windows) <= 2
    text, duration_s = forecast.verification_program("long", windows, made.lines, 0, bead_area_mm2=AREA)
    assert duration_s < 0.2 * len(made.streams[0].r) * TS
    # the ends of a long line remain, at the speed of the part
    lines = lines_of(text)
    np.testing.assert_allclose(lines.speed, 8.0)
    np.testing.assert_allclose(lines.length, 2 * forecast.PLATEAU_S * 8.0)


def test_runs_and_gaps_of_the_print_are_those_of_the_part():
    made = of_part("dashes")
    windows = hardest(made)
    lines = lines_of(forecast.verification_program("dashes", windows, made.lines, 0, bead_area_mm2=AREA)[0])
    mine = np.concatenate([window.lines for window in windows])
    np.testing.assert_allclose(lines.length, made.lines.length[mine], atol=1e-3)
    gaps = lines.begin_s[1:] - lines.end_s[:-1]
    expected = made.lines.begin_s[mine[1:]] - made.lines.end_s[mine[:-1]]
    together = np.diff(mine) == 1
    np.testing.assert_allclose(gaps[together], expected[together], atol=0.02)  # a sample


def test_the_window_is_where_what_may_come_out_differs_most():
    made = composed(LONG)
    stream = made.streams[0]
    flows = np.tile(stream.r, (8, 1))
    third = np.flatnonzero(made.lines.tool == 0)[2]
    at = round(made.lines.begin_s[third] / TS)
    flows[:, at : at + 20] += np.linspace(-1, 1, 8)[:, None]
    windows = forecast.windows(flows, stream.r, made.lines, 0, sample_time_s=TS)
    sure = max(windows, key=lambda window: window.deviation)
    assert sure.event == "start" and third in sure.lines


def test_a_tool_that_prints_nothing_is_refused():
    made = of_part("dashes")
    with pytest.raises(ValueError, match="verification: expected lines of T7 but it prints none"):
        forecast.windows(np.zeros((2, 5)), np.zeros(5), made.lines, 7, sample_time_s=TS)


def test_a_part_is_learned_on_from_its_composed_start():
    """Thixotropic ink, which the chain cannot follow: two prints halve the error of the composed command."""
    rng = np.random.default_rng([19, 12, 0, 0])
    plant = foreign_parts.plant_of("thixotropic", rng, "A")
    material = learn(foreign_parts.train(plant, "A", rng), sample_time_s=TS).materials[0]
    r = of_part("dashes").streams[0].r
    u = basis.compose(material.chain.extruder, r, sample_time_s=TS)
    errors = []
    for trial in range(4):
        y = plant(u, trial)
        errors.append(float(np.linalg.norm(y - r)))
        measured = seen(y, rng, steady_flow=float(r.max()))
        u = forecast.next_command(material.chain.extruder, u, measured, r, drive=UNLIMITED, sample_time_s=TS)
    assert errors[2] < 0.6 * errors[0] and errors[3] < errors[0]


def test_the_next_command_obeys_the_drive_and_learns_nothing_where_nothing_was_seen():
    r = of_part("dashes").streams[0].r
    u, blind = r / NOMINAL.gain, np.full(len(r), np.nan)
    extruder = learned(PLANT).materials[0].chain.extruder
    again = forecast.next_command(extruder, u, blind, r, drive=UNLIMITED, sample_time_s=TS)
    np.testing.assert_allclose(again, u, atol=1e-9)
    drive = Drive(4.0, 50.0, 0.0)
    bound = forecast.next_command(extruder, u, 0 * r, r, drive=drive, sample_time_s=TS)
    assert follows(bound, drive, sample_time_s=TS)


def test_what_was_measured_is_in_percent_of_on_off_and_of_what_was_seen():
    stream = of_part("dashes").streams[0]
    first = flow(PLANT, stream.r / NOMINAL.gain, sample_time_s=TS)
    y = flow(PLANT, stream.u, sample_time_s=TS)
    expected = percent_of_on_off(PLANT, stream.u, stream.r)
    assert forecast.measured_percent(y, first, stream.r) == pytest.approx(expected)
    holed = np.where(np.arange(len(y)) < len(y) // 2, np.nan, y)
    assert np.isfinite(forecast.measured_percent(holed, first, stream.r))
    with pytest.raises(ValueError, match="every sample is missing; record it again"):
        forecast.measured_percent(np.full(len(y), np.nan), first, stream.r)


# ---- files


def written(tmp_path, text):
    path = tmp_path / "dashes_A_measured.csv"
    path.write_text(text)
    return path


def test_a_measured_print_is_read_at_the_clock_of_the_command(tmp_path):
    path = written(tmp_path, "time_s,flow_mm3_per_s\n0.02,1\n0.04,2\n0.06,3\n")
    y, u = part_files.read_measured(path, 5, 0.02)
    np.testing.assert_allclose(y, [np.nan, 1.0, 2.0, 3.0, np.nan])
    assert u is None
    path = written(tmp_path, "time_s,flow_mm3_per_s,command_mm\n0,1,5\n0.03,2,8\n0.06,3,8\n")
    np.testing.assert_allclose(part_files.read_measured(path, 3, 0.02)[1], [5.0, 7.0, 8.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected the columns time_s,flow_mm3_per_s but found an empty file"),
        ("t,q\n0,1\n", "expected the columns time_s,flow_mm3_per_s but found t,q"),
        ("time_s,flow_mm3_per_s\n0,1\n0.1,\n", "row 3: expected 2 numbers but found 0.1,"),
        ("time_s,flow_mm3_per_s\n0,1\n0,1\n", "expected at least two rows whose time_s rises"),
    ],
)
def test_a_measured_print_that_cannot_be_read_is_refused_with_its_row(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        part_files.read_measured(written(tmp_path, text), 5, 0.02)


TODAY_S = 1_790_000_000.25


def recorded(path, *, command=True, start_s=TODAY_S, flow="flow_mm3_per_s"):
    """A print as a machine records it, topics with rates of their own, the camera's first 0.5 s before the
    plunger's; the flow is 10 t, the command 5 + 2 t after the plunger's first message."""
    made = Written()
    meter, plunger = made.topic("/flow_meter", "json"), made.topic("/plunger", "json")
    for k in range(60):
        made.message(meter, start_s + k / 37, {flow: 10 * (k / 37 - 0.5), "valve": 1.0})
    for k in range(25 if command else 0):
        made.message(plunger, start_s + 0.5 + k / 25, {"displacement_mm": 5 + 2 * k / 25})
    path.write_bytes(made.bytes())
    return path


def test_a_recorded_print_is_read_from_the_plungers_first_message_on(tmp_path):
    y, u = part_files.read_measured(recorded(tmp_path / "dashes_A_measured.mcap"), 100, 0.02)
    clock = 0.02 * np.arange(100)
    seen = clock < 59 / 37 - 0.5
    np.testing.assert_allclose(y[seen], 10 * clock[seen], atol=1e-5)
    assert np.isnan(y[~seen]).all() and seen.sum() == 55
    np.testing.assert_allclose(u, np.minimum(5 + 2 * clock, 5 + 2 * 24 / 25), atol=1e-5)
    # without the plunger nothing tells when a clock of the calendar was 0; one that begins there does
    with pytest.raises(ValueError, match=r"expected the command, /plunger:displacement_mm, for its first"):
        part_files.read_measured(recorded(tmp_path / "a.mcap", command=False), 100, 0.02)
    y, u = part_files.read_measured(recorded(tmp_path / "b.mcap", command=False, start_s=0.0), 100, 0.02)
    assert u is None and y[50] == pytest.approx(10 * (1.0 - 0.5), abs=1e-5)


def test_a_measured_print_may_be_a_parquet_table(tmp_path):
    path, time_s = tmp_path / "dashes_A_measured.parquet", np.array([0.0, 0.03, 0.06])
    columns = {"flow_mm3_per_s": [1.0, 2, 3], "time_s": time_s, "command_mm": [5.0, 8, 8], "note": ["a"] * 3}
    pq.write_table(pa.table(columns), path)
    y, u = part_files.read_measured(path, 5, 0.02)
    np.testing.assert_allclose(y[:4], [1, 1 + 2 / 3, 2 + 1 / 3, 3], atol=1e-12)
    assert np.isnan(y[4])
    np.testing.assert_allclose(u, [5, 7, 8, 8, 8])
    pq.write_table(pa.table({name: columns[name] for name in ("time_s", "flow_mm3_per_s")}), path)
    assert part_files.read_measured(path, 4, 0.02)[1] is None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: recorded(path, flow="q"), "flow_mm3_per_s"),
        (lambda path: path.write_bytes(b"time_s,flow_mm3_per_s\n0,1\n"), "begin no mcap file"),
        (lambda path: path.write_bytes(recorded(path).read_bytes()[:200]), "copy the recording again"),
        (
            lambda path: pq.write_table(pa.table({"time_s": [0.0], "flow_mm3_per_s": [1.0]}), path),
            "two samples",
        ),
        (
            lambda path: pq.write_table(
                pa.table(
                    {"time_s": [0.0, 1, 2], "flow_mm3_per_s": [1.0, 1, 1], "command_mm": [1, None, 2.0]}
                ),
                path,
            ),
            "expected a number in each row of command_mm",
        ),
    ],
)
def test_a_recorded_print_that_cannot_be_read_is_refused_in_one_sentence(tmp_path, make, message):
    path = tmp_path / "dashes_A_measured.mcap"
    make(path)
    with pytest.raises(ValueError, match=message) as refused:
        part_files.read_measured(path, 5, 0.02)
    assert str(path) in str(refused.value) and "\n" not in str(refused.value)


def test_of_two_measured_prints_none_is_guessed(tmp_path):
    assert part_files.print_path(tmp_path, "dashes", "A") is None
    path = recorded(tmp_path / "dashes_A_measured.mcap")
    assert part_files.print_path(tmp_path, "dashes", "A") == path
    written(tmp_path, "time_s,flow_mm3_per_s\n0,1\n")
    with pytest.raises(ValueError, match=r"found dashes_A_measured.csv and dashes_A_measured.mcap; keep one"):
        part_files.print_path(tmp_path, "dashes", "A")
