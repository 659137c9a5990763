"""Part fan and filament feed of a klippy.log from the printed G-code, judged on a simulated printer that
moves as its slicer meant, and on lines worked by hand."""

import json
import os
import shutil

import numpy as np
import pytest

from pipeline.commands import propose_params
from pipeline.recordings import plain_files, recording_folders
from pipeline.recordings.formats import Raw
from pipeline.recordings.inspection import inspect
from pipeline.recordings.klipper_logs import fan_macros, load_klippy, printed_files
from pipeline.recordings.printed_gcode import BLOCK, FAN, FEED, LEFT_OUT, NOT_RECORDED, companions, read_file
from pipeline.recordings.recordings import Source, read
from pipeline.recordings.resampling import resample
from tests.recordings.printing_machine import Machine, gcode, slice_box


def print_two(slicer: str, end: str = "\n", high_s: float = 1.0):
    """A printer that has printed two files one after the other, the first with a pause, and their bytes."""
    rng = np.random.default_rng(1)
    machine = Machine(seed=1, high_s=high_s)
    machine.heat(215, 60)
    machine.wait(machine.now + 30)
    files = {}
    for name, layers, pause in (("a.gcode", 24, 8), ("b.gcode", 8, -1)):
        lines = slice_box(rng, layers=layers, slicer=slicer, pause_layer=pause)
        machine.print_file(name, lines, end=end)
        machine.wait(machine.now + 60)
        files[name] = gcode(lines, end)
    return machine, files


@pytest.fixture(scope="module")
def printed():
    return print_two("PrusaSlicer")


def write(folder, machine, files):
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    log = folder / "klippy.log"
    log.write_text(machine.log() if isinstance(machine, Machine) else machine)
    return log


def messages(table, kind):
    return [note.message for note in table.notes if note.kind == kind]


def refused(table) -> str:
    """The one note on a print without its file."""
    assert FAN not in table.values and FEED not in table.values
    (message,) = messages(table, NOT_RECORDED)
    assert message.startswith(f"{FAN} and {FEED} are not recorded") and "\n" not in message
    return message


# ---- against the truth


@pytest.mark.parametrize(
    ("slicer", "end", "high_s"), [("PrusaSlicer", "\n", 1.0), ("Orca", "\n", 2.0), ("Cura", "\r\n", 1.0)]
)
def test_feed_and_fan_are_those_of_the_motion(tmp_path, slicer, end, high_s):
    machine, files = print_two(slicer, end, high_s)
    table = load_klippy(write(tmp_path, machine, files))
    truth, times = machine.truth(), (table.time - 1_752_314_400 * 10**9) / 1e9 + 100
    feed, expected = table.values[FEED], truth.feed(times, times + 1)
    assert machine.e > 500 and table.units[FEED] == "mm/s" and table.units[FAN] == "percent"
    assert not messages(table, NOT_RECORDED)

    def windows(seconds):
        count = len(feed) // seconds * seconds
        return [values[:count].reshape(-1, seconds).mean(1) for values in (feed, expected)]

    minutes, true_minutes = windows(60)
    printing = true_minutes > 0.2
    assert printing.sum() >= 8
    np.testing.assert_allclose(minutes[printing], true_minutes[printing], rtol=0.02)
    ours, true = windows(5)
    assert np.sqrt(np.mean((ours - true)[true > 0.1] ** 2)) < 0.1 * true[true > 0.1].mean()
    assert feed.sum() == pytest.approx(machine.e, rel=0.005)
    # the fan's commands count to 255
    for time, percent in zip(times, table.values[FAN], strict=True):
        around = truth.fan_at(np.arange(time - 2, time + 2, 0.1))
        assert np.abs(around - percent).min() < 0.01
    assert {0.0, 50.0, 100.0} <= set(table.values[FAN].tolist())


def test_positions_that_count_characters_find_a_file_with_other_letters(tmp_path, printed):
    machine, files = printed
    files = {name: content.replace("ü".encode(), b"ue") for name, content in files.items()}
    plain = load_klippy(write(tmp_path / "plain", machine, files))
    # as many characters in more bytes
    spelt = {name: content.replace(b";LAYER", ";LÁYĚR".encode()) for name, content in files.items()}
    assert all(len(spelt[name]) > len(content) + 10 for name, content in files.items())
    table = load_klippy(write(tmp_path / "spelt", machine, spelt))
    assert not messages(table, NOT_RECORDED)
    for name in (FAN, FEED):
        np.testing.assert_array_equal(table.values[name], plain.values[name])


def test_in_a_pause_and_between_prints_nothing_is_fed(tmp_path, printed):
    machine, files = printed
    table = load_klippy(write(tmp_path, machine, files))
    times = (table.time - table.time[0]) / 1e9 + 100
    before, after = machine.jobs[0]["end_time"], machine.jobs[1]["start_time"]
    between = (times > before - machine.epoch_s + 1) & (times < after - machine.epoch_s)
    assert between.sum() > 50 and not table.values[FEED][between].any()
    still = machine.truth().feed(times, times + 1) == 0
    assert (table.values[FEED][still] == 0).mean() > 0.9
    assert not table.values[FAN][between].any()  # as the file left it: M107


def test_a_print_that_was_cancelled_counts_up_to_its_last_position(tmp_path):
    lines = slice_box(np.random.default_rng(2), layers=10)
    machine = Machine()
    machine.heat(215, 60)
    machine.print_file("a.gcode", lines, stop_at=len(lines) // 2)
    machine.wait(machine.now + 20)
    machine.jobs[0]["filament_used"] *= 0.9
    files = {"a.gcode": gcode(lines), "history.json": json.dumps(machine.history()).encode()}
    table = load_klippy(write(tmp_path, machine, files))
    assert table.values[FEED].sum() == pytest.approx(machine.e, rel=0.01)
    note = next(one for one in messages(table, LEFT_OUT) if "history has" in one)
    assert note.startswith(f"a.gcode feeds {machine.e:.0f} mm") and f"{0.9 * machine.e:.0f} mm" in note


def test_a_log_that_begins_within_a_print_has_its_fan_and_its_feed(tmp_path, printed):
    machine, files = printed
    lines = machine.log().splitlines(keepends=True)
    late = lines[:2] + [line for line in lines if "Stats" in line or "SD card" in line][150:400]
    whole, part = (
        load_klippy(write(tmp_path / name, text, files))
        for name, text in (("whole", machine.log()), ("part", "".join(late)))
    )
    _, at, own = np.intersect1d(whole.time, part.time, return_indices=True)
    np.testing.assert_array_equal(part.values[FAN][own[1:]], whole.values[FAN][at[1:]])
    np.testing.assert_allclose(part.values[FEED][own[2:-4]], whole.values[FEED][at[2:-4]], atol=1e-9)


# ---- which file


def test_files_lie_in_gcodes_and_others_beside_them_are_not_taken(tmp_path, printed):
    machine, files = printed
    others = {f"gcodes/{i}.gcode": gcode(slice_box(np.random.default_rng(i), layers=24)) for i in range(5, 9)}
    here = {f"gcodes/{name}": content for name, content in files.items()}
    log = write(tmp_path, machine, here | others | {"copy.gco": files["a.gcode"]})
    table = load_klippy(log)
    assert not messages(table, NOT_RECORDED)
    assert {path.name for path in printed_files(log)} == {"copy.gco", "b.gcode"}


def test_a_print_without_its_file_is_missing_and_the_other_is_not(tmp_path, printed):
    machine, files = printed
    table = load_klippy(write(tmp_path, machine, {"a.gcode": files["a.gcode"]}))
    (message,) = messages(table, NOT_RECORDED)
    assert "1 of 2 prints" in message and f"of {len(files['b.gcode'])} bytes, found a.gcode has" in message
    feed = table.values[FEED]
    assert np.isnan(feed).any() and np.nansum(feed) == pytest.approx(
        machine.jobs[0]["filament_used"], rel=0.01
    )
    assert np.array_equal(np.isnan(feed), np.isnan(feed) & np.isnan(table.values[FAN]))


def one_print():
    lines = slice_box(np.random.default_rng(3), layers=6)
    machine = Machine()
    machine.heat(215, 60)
    machine.print_file("dir/a.gcode", lines)
    machine.wait(machine.now + 10)
    return machine, gcode(lines)


MACHINE, CONTENT = one_print()
CUT, OTHER = CONTENT[:-900], gcode(slice_box(np.random.default_rng(4), layers=9))[: len(CONTENT) - 1] + b"\n"
JUNK = np.random.default_rng(5).bytes(len(CONTENT))
SIZE = f"expected the printed G-code file of {len(CONTENT)} bytes, found "
HISTORY = json.dumps(MACHINE.history()).encode()


@pytest.mark.parametrize(
    ("files", "sentence"),
    [
        ({}, SIZE + "no G-code file; put the file that was printed beside the log or into gcodes/"),
        ({"history.json": HISTORY}, f"expected dir/a.gcode of {len(CONTENT)} bytes, found no G-code file"),
        ({"a.gcode": OTHER}, SIZE + "a.gcode has other lines (none ends at "),
        ({"a.gcode": CUT}, SIZE + f"a.gcode has {len(CUT)} bytes; put"),
        ({"a.gcode": CONTENT + CONTENT}, SIZE + f"a.gcode has {2 * len(CONTENT)} bytes; put"),
        ({"a.gcode": CONTENT.replace(b"\n", b"\r\n")}, SIZE + "a.gcode has "),
        ({"a.gcode": JUNK}, SIZE + "a.gcode has other lines"),
        ({"a.gcode": b""}, SIZE + "a.gcode has 0 bytes"),
        ({"a.gcode": CUT, "b.g": OTHER}, SIZE + "2 G-code files, none of which fits"),
        ({"a.gcode": CUT, "b.g": OTHER, "h.json": HISTORY}, f"found a.gcode has {len(CUT)} bytes"),
        ({"a.gcode": CONTENT, "b.g": CONTENT.replace(b"M107", b"M106")}, "found a.gcode and b.g; leave the"),
    ],
    ids=["none", "history", "other", "cut", "twice", "crlf", "junk", "empty", "two", "named", "ambiguous"],
)
def test_a_file_that_does_not_fit_gives_no_signal_and_one_sentence(tmp_path, files, sentence):
    assert sentence in refused(load_klippy(write(tmp_path, MACHINE, files)))


def test_the_history_tells_which_of_two_files_that_fit(tmp_path):
    files = {"b.g": CONTENT.replace(b"M107", b"M106"), "a.gcode": CONTENT, "history.json": HISTORY}
    log = write(tmp_path, MACHINE, files)
    assert {path.name for path in printed_files(log)} == {"a.gcode", "history.json"}


def test_a_log_without_positions_and_a_damaged_history_say_so(tmp_path):
    machine = Machine(has_sd=False)
    machine.heat(215, 60)
    machine.print_file("a.gcode", slice_box(np.random.default_rng(3), layers=2))
    text = "".join(line for line in machine.log().splitlines(keepends=True) if "SD card" not in line)
    assert "the log has no sd_pos" in refused(load_klippy(write(tmp_path, text, {"a.gcode": CONTENT})))
    table = load_klippy(write(tmp_path, MACHINE, {"a.gcode": CONTENT, "history.json": HISTORY[:-9]}))
    (message,) = messages(table, NOT_RECORDED)
    assert message.startswith("history.json should be Moonraker's history but cannot be read")
    assert FEED in table.values


def test_bytes_flipped_anywhere_in_file_history_or_log_give_notes_and_no_error(tmp_path):
    rng = np.random.default_rng(0)
    for _ in range(20):
        parts = [bytearray(content) for content in (CONTENT, HISTORY, MACHINE.log().encode())]
        for content in parts:
            for place in rng.integers(0, len(content), 5):
                content[place] = rng.integers(0, 256)
        log = write(tmp_path, "", {"a.gcode": bytes(parts[0]), "history.json": bytes(parts[1])})
        log.write_bytes(bytes(parts[2]))
        table = load_klippy(log)
        assert all(len(column) == len(table.time) for column in table.values.values())


# ---- lines


@pytest.mark.parametrize(
    ("text", "filament", "fan"),
    [
        ("G1 X1 E2\nG1 E3\n", 3, []),  # absolute, as Klipper starts
        ("M83\nG1 X1 E2\nG1E3F1800\ng1 e-.5 ; E9\nG1 X5\n", 4.5, []),
        ("M82\nG92 E0\nG1 E5\nG92 E1\nG1 E3\nG92\nG1 E1\n", 8, []),
        ("G91\nG1 E1\nG1 E1\nG90\nG1 E1\n", 1, []),  # relative moves make E relative too
        ("M83\nG2 X1 I5 E1\nN7 G03 X1 E1\nG10\nG11\nG12 E9\nG1.5 E9\n", 2, []),
        ("M83\nG1 E1\nT1\nG1 E2\nM221 S50\nG1 E2\n", 4, []),
        ("M106\nM107\nM106 S127.5\nM106 P0 S255\nM106 P1 S0\nm107\n", 0, [100, 0, 50, 100, 0]),
        ("SET_FAN_SPEED FAN=aux SPEED=1\nFAN_HALF\nM106 S999\n", 0, [50, 100]),
        ("; G1 E5\n;M106\nM117 E7 M106 S9\nM83\nG1 E1\nG1 E1", 1, []),  # Klipper runs no line without an end
        ("M83\nG1 E1\r\nG1 E1e9\nG1 Enan\nG1 E9999999\nG1 E2\n", 4, []),
    ],
)
def test_lines_do_what_klipper_does_with_them(tmp_path, text, filament, fan):
    path = tmp_path / "a.gcode"
    path.write_bytes(text.encode())
    content = read_file(path, np.array([0, len(text) + 1]), {"FAN_HALF": 50.0})
    assert content.filament_mm.tolist() == [0, filament] and content.fan_percent.tolist() == fan


def test_what_is_left_out_is_counted(tmp_path):
    path = tmp_path / "a.gcode"
    path.write_text("START_PRINT\nSET_VELOCITY_LIMIT ACCEL=1\nG1 E1\nG10\nG10\nM106 P2 S9\n")
    remark = read_file(path, np.array([path.stat().st_size]), {}).remark
    assert remark == (
        "the feed and the fan leave out 2 firmware retractions (G10, G11), 1 commands for other fans "
        "(M106 P), filament that macros feed (START_PRINT); "
        "E was taken as absolute until the file's first M82 or M83"
    )


def test_a_line_without_an_end_is_passed_over_in_bounded_memory(tmp_path):
    path, before = tmp_path / "a.gcode", b"M83\nG1 E1\nG1 X"
    path.write_bytes(before + b"1" * (3 * BLOCK) + b" E50\nG1 E2\n" + b"\0" * (3 * BLOCK) + b"\nG1 E4\n")
    assert read_file(path, np.array([os.path.getsize(path)]), {}).filament_mm.tolist() == [7]


def test_macros_of_the_configuration_that_set_the_part_fan():
    lines = ["[gcode_macro end_print]", "gcode = ", "\tM106 S255", "\tM107", "[fan]", "M106 S1"]
    lines += ["[gcode_macro COOL]", "gcode = ", "\tM106 S{params.S}", "[gcode_macro HALF]", "\tM106 S51"]
    assert fan_macros(lines) == {"END_PRINT": 0.0, "HALF": 20.0}


# ---- init and ingest


def test_init_asks_for_the_printed_file(tmp_path):
    log = write(tmp_path, MACHINE, {})
    assert "put the file that was printed beside the log" in inspect(log)
    open_questions = propose_params.proposed([log]).open_questions
    assert any("put the file that was printed beside the log" in question for question in open_questions)


def test_a_log_without_its_file_beside_one_that_has_it_is_refused_with_the_file(tmp_path, printed):
    log, whole = write(tmp_path / "a", MACHINE, {}), write(tmp_path / "b", *printed)
    with pytest.raises(ValueError, match=r"a/klippy.log: .*put the file that was printed beside the log"):
        read(log, [Source("feed", FEED, "mm/s"), Source("y", "extruder.temp", "degC")])
    assert len(read(log, [Source("y", "extruder.temp", "degC")]).signals) == 1
    with pytest.raises(ValueError, match=rf"{len(CONTENT)} bytes, .*another of the recordings has them"):
        propose_params.proposed([whole, log])


def test_init_proposes_fan_and_feed_as_disturbances_and_ingest_writes_them(
    root, tmp_path, monkeypatch, printed
):
    from pipeline import cli
    from stages import ingest

    machine, files = printed
    source = tmp_path / "owner"
    here = {f"gcodes/{name}": content for name, content in files.items()}
    for name in ("params.yaml", "params.expert.yaml"):
        shutil.copyfile(root / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    # without the files first, and then as page one's next step says
    log = write(source, machine, {})
    monkeypatch.setattr("sys.argv", ["beadline", "init", str(log), "--copy"])
    cli.main()
    assert "part_fan" not in (tmp_path / "params.yaml").read_text()
    write(source, machine, here | {"gcodes/other.gcode": OTHER})
    monkeypatch.setattr("sys.argv", ["beadline", "init", str(log), "--copy", "--force"])
    cli.main()
    raw = tmp_path / "datasets/raw/temperature"
    assert sorted(path.name for path in raw.iterdir()) == ["a.gcode", "b.gcode", "klippy.log"]
    for file in raw.iterdir():
        os.utime(file, (1e9, 1e9))
    text = (tmp_path / "params.yaml").read_text() + (tmp_path / "params.expert.yaml").read_text()
    assert "{name: part_fan_speed, unit: percent}" in text
    assert '{name: filament_feed, unit: "mm/s"}' in text
    monkeypatch.setattr("sys.argv", ["ingest"])
    ingest.main()
    record = _record(tmp_path)
    assert set(record["recording"]) == {"klippy.log"}
    assert record["part_fan_speed"].max() == 100
    # every third line is taken, and all of the filament
    step_s = record["time_s"][1] - record["time_s"][0]
    assert step_s == 1 and record["filament_feed"].sum() * step_s == pytest.approx(machine.e, rel=0.01)
    # another file beside it is another record
    (raw / "a.gcode").write_bytes(files["a.gcode"].replace(b"M107", b"M106"))
    os.utime(raw / "a.gcode", (1e9, 1e9))
    ingest.main()
    assert not np.array_equal(record["part_fan_speed"], _record(tmp_path)["part_fan_speed"])


def _record(folder):
    import pandas as pd

    frame = pd.read_parquet(folder / "datasets/ingest/record.parquet")
    return {name: frame[name].to_numpy() for name in frame}


def test_a_mean_over_a_sample_keeps_the_volume_of_a_flow():
    time, flow = np.arange(7.0), np.array([0.0, 3.0, 0.0, 6.0, np.nan, 0.0, 9.0])
    signals = {"feed": (time, flow), "y": (time, time)}
    table = resample(
        Raw("a", signals, {}, []), sample_time_s=2.0, inputs=["feed"], outputs=["y"], averaged=["feed"]
    )
    np.testing.assert_allclose(table.values["feed"], [1.5, 3.0, np.nan, 9.0])


def test_a_log_whose_printed_file_is_still_being_copied_is_passed_over(tmp_path, monkeypatch):
    log = write(tmp_path, MACHINE, {"a.gcode": CONTENT[:100], "b.csv": b"t,y\n0,1\n"})

    def copy_on(seconds):
        (tmp_path / "a.gcode").write_bytes(CONTENT)

    monkeypatch.setattr(plain_files, "REST_S", 10.0)
    monkeypatch.setattr(plain_files.time, "sleep", copy_on)
    recordings, passed = recording_folders._recordings_below(tmp_path, [], waits=True)
    assert [path.name for path in recordings] == ["b.csv"] and "still being written" in passed[log]


def test_companions_are_files_of_gcode_and_histories_alone(tmp_path):
    store = json.dumps({"result": {"extruder": {"temperatures": [1.0]}}}).encode()
    write(tmp_path, "", {"a.GCODE": b"", "store.json": store, "h.json": HISTORY, "a.csv": b"t,y\n"})
    (tmp_path / "folder.gcode").mkdir()
    os.mkfifo(tmp_path / "pipe.gcode")
    assert [path.name for path in companions(tmp_path / "klippy.log")] == ["a.GCODE", "h.json"]
