"""`beadline experiment setpoint`: the program is read back by the project's own reader of G-code, and by
nothing that wrote it."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline import cli
from pipeline.deposition.toolpath import gcode
from pipeline.deposition.toolpath.gcode import Kind
from pipeline.recordings.nozzle_frames import read_log
from pipeline.store import params

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def printed(tmp_path, monkeypatch, capsys):
    """printed("--flows", "50,100"): status, what was printed, and what was said of errors."""
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["beadline", "experiment", "setpoint", "a.gcode", *arguments])
        status = 0
        try:
            cli.main()
        except SystemExit as ended:
            status = ended.code
        return status, *capsys.readouterr()

    return command


def settings(before: str, after: str) -> None:
    """The shipped parameters in this folder, with one value changed."""
    text = (ROOT / params.FILE).read_text()
    assert text.count(before) == 1
    Path(params.FILE).write_text(text.replace(before, after))
    Path(params.EXPERT).write_text((ROOT / params.EXPERT).read_text())


def table() -> list[dict[str, str]]:
    return list(csv.DictReader(Path("a.settings.csv").read_text().splitlines()))


FEW = ("--flows", "50,100,160", "--temperatures", "200,220")


def test_the_reader_of_gcode_finds_each_setting_where_the_table_says(printed):
    assert printed(*FEW)[0] == 0
    text = Path("a.gcode").read_text()
    program = gcode.parse(text)
    moves, lines = program.moves, text.splitlines()
    assert (program.refusals, program.extruder, program.diameter_mm) == ([], "E", {0: 1.75})
    assert program.accounted.refused == 0
    laid = moves.kind == Kind.EXTRUDE
    first = min(int(row["line_from"]) for row in table())
    for row in table():
        here = laid & (moves.line >= int(row["line_from"])) & (moves.line <= int(row["line_to"]))
        assert here.sum() > 20
        assert np.unique(program.flow[here]).tolist() == [float(row["flow_rate"]) / 100]
        waits = [line for line in lines[: int(row["line_from"])] if line.startswith("M109 ")]
        assert float(waits[-1][6:]) == float(row["target_hotend"])
        laid &= ~here
    assert (moves.line[laid] < first).all(), "only the line along the front is laid outside of the table"


def test_each_collected_layer_lies_on_one_at_100_percent_and_the_best_temperature(printed):
    settings("best_temperature_degC: 210", "best_temperature_degC: 215")
    printed(*FEW)
    rows = table()
    collected = [
        (float(row["flow_rate"]), float(row["target_hotend"])) for row in rows if row["collect"] == "1"
    ]
    assert sorted(collected) == sorted((f, t) for t in (200.0, 220.0) for f in (50.0, 100.0, 160.0))
    for before, row in zip(rows, rows[1:], strict=False):
        if row["collect"] == "1":
            assert (before["flow_rate"], before["target_hotend"], before["collect"]) == ("100", "215", "0")


def test_the_volume_is_that_of_the_cuboid_times_the_flow(printed):
    printed(*FEW)
    program = gcode.parse(Path("a.gcode").read_text())
    moves, area = program.moves, np.pi / 4 * 1.75**2
    for row in table():
        here = (moves.line >= int(row["line_from"])) & (moves.line <= int(row["line_to"]))
        here &= moves.kind == Kind.EXTRUDE
        volume = float((moves.e * program.flow)[here].sum() * area)
        # one turn less than lines: half a millimetre of 2300
        assert volume == pytest.approx(50 * 20 * 0.2 * float(row["flow_rate"]) / 100, rel=2e-3)
        assert moves.length[here].sum() / 20 == pytest.approx(float(row["seconds"]), abs=0.01)


def test_nothing_leaves_a_small_bed_nor_drags_through_what_was_laid(printed):
    printed(*FEW, "--bed", "80,56,30")
    moves = gcode.parse(Path("a.gcode").read_text()).moves
    after_home = moves.line > 12
    for axis, room in enumerate((80.0, 56.0, 30.0)):
        assert moves.end[after_home, axis].min() >= 0
        assert moves.end[after_home, axis].max() < room
    laid, across = np.flatnonzero(moves.kind == Kind.EXTRUDE), np.hypot(*np.diff(moves.end[:, :2], axis=0).T)
    for i in np.flatnonzero((moves.kind[1:] == Kind.TRAVEL) & (across > 1e-6)) + 1:
        if (before := laid[laid < i]).size:
            assert moves.end[i, 2] > moves.end[before, 2].max() + 1


def test_what_is_drawn_back_comes_forward(printed):
    printed(*FEW)
    program = gcode.parse(Path("a.gcode").read_text())
    alone = np.isin(program.moves.kind, (Kind.RETRACT, Kind.UNRETRACT, Kind.PRIME))
    back = np.cumsum((program.moves.e * program.flow)[alone])
    assert not (program.moves.kind == Kind.PRIME).any()
    assert back.max() <= 1e-9 and back.min() >= -1 - 1e-9


def test_a_layer_after_too_much_lies_higher(printed):
    printed("--flows", "100,300", "--temperatures", "210")
    moves, rows = gcode.parse(Path("a.gcode").read_text()).moves, table()
    tops = [moves.end[moves.line == int(row["line_to"]) - 2, 2][0] for row in rows]
    rise = dict(zip([row["flow_rate"] for row in rows], np.diff([*tops, np.nan]), strict=True))
    assert rise["300"] == pytest.approx(0.6)


def test_lines_are_as_fast_as_the_hot_end_melts_at_the_largest_flow(printed):
    speeds = {}
    for melt in ("12", "2"):
        printed(*FEW, "--melt", melt)
        moves = gcode.parse(Path("a.gcode").read_text()).moves
        speeds[melt] = np.unique(moves.feed[moves.kind == Kind.EXTRUDE]).tolist()
    line = (1.2 * 0.4 - 0.2 * (1 - np.pi / 4)) * 0.2
    assert speeds == {"12": [20.0], "2": [pytest.approx(2 / (1.6 * line), abs=1e-3)]}


def test_the_table_becomes_a_log_that_the_folder_reads(printed):
    settings(
        "tip_px: null                # [x, y] of the nozzle's tip in every frame", "tip_px: [571, 511]  #"
    )
    printed(*FEW)
    rows = table()
    for k, row in enumerate(rows):
        row["img_path"] = f"{k}.png"
    Path("log.csv").write_text(
        "\n".join([",".join(rows[0]), *(",".join(row.values()) for row in rows)]) + "\n"
    )
    log = read_log(Path("log.csv"))
    assert log.flow.tolist() == [float(row["flow_rate"]) for row in rows]
    assert log.temperature.tolist() == [float(row["target_hotend"]) for row in rows]
    assert (log.tip == (571, 511)).all()


def test_the_same_flags_give_the_same_bytes(printed):
    printed(*FEW)
    first = Path("a.gcode").read_bytes(), Path("a.settings.csv").read_bytes()
    printed(*FEW)
    assert (Path("a.gcode").read_bytes(), Path("a.settings.csv").read_bytes()) == first


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--flows", "10,100"], "--flows: expected numbers from 20 to 310 percent, with commas between"),
        (["--flows", "a"], "found 'a'"), (["--flows", ""], "found ''"), (["--flows", "nan"], "found 'nan'"),
        (["--flows", "50,50"], "found one twice"), (["--temperatures", "20"], "150 to 320 degC"),
        (["--bed", "220"], "--bed: expected 3 numbers"),
        (["--bed", "50,220,250"], "--bed: expected at least 54 mm along x"),
        (["--bed", "220,220,20"], "ends at 26.4 mm but --bed leaves 20"),
        (["--filament", "0.5"], "--filament: expected one number from 1 to 3.5 mm"),
    ],
)  # fmt: skip
def test_bad_flags_are_one_sentence_and_nothing_is_written(printed, arguments, said):
    status, out, wrong = printed(*arguments)
    assert (status, out, len(wrong.splitlines())) == (1, "", 1)
    assert said in wrong and "; " in wrong
    assert list(Path().iterdir()) == []


def test_a_table_without_temperature_is_read_with_the_stated_one(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("img_path,flow_rate\na.png,80\nb.png,120\n")
    with pytest.raises(ValueError, match="expected a column target_hotend or hotend, found none"):
        read_log(path)
    log = read_log(path, 210.0)
    assert log.temperature.tolist() == [210.0, 210.0]
    assert any("so the stated 210 degC is" in note.message for note in log.notes)
    path.write_text("img_path,flow_rate,hotend\na.png,80,190\nb.png,120,\n")
    assert read_log(path, 210.0).temperature == pytest.approx([190.0, np.nan], nan_ok=True)
