"""Klipper's log, written by a simulated printer, and what becomes of it."""

import re

import numpy as np
import pytest

from pipeline.recordings.formats import file_format
from pipeline.recordings.klipper_logs import load_klippy, printer_heaters
from pipeline.recordings.recordings import Source, inspect, read
from pipeline.recordings.resampling import resample
from tests.recordings.klipper_machine import BED, EXTRUDER, print_log, stats_line

TARGETS = [(0, 0, 60), (20, 200, 60), (120, 215, 65), (180, 200, 60), (260, 0, 0)]


def write(tmp_path, text: str, name: str = "klippy.log"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.fixture
def log() -> str:
    return print_log(TARGETS, longest_s=300)


def graphstats(line: str) -> dict[str, str]:
    """A Stats line by the rules of Klipper's scripts/graphstats.py: words from the third on; one without "="
    is the prefix of the target, temp and pwm that follow."""
    prefix, keys = "", {}
    for word in line.split()[2:]:
        name, mark, value = word.partition("=")
        if not mark:
            prefix = "" if word == "mcu:" else word
        else:
            keys[prefix + name if name in ("target", "temp", "pwm") else name] = value
    return keys


def test_the_log_reads_as_klippers_own_script_reads_it(tmp_path, log):
    table = load_klippy(write(tmp_path, log))
    lines = [graphstats(line) for line in log.splitlines() if line.startswith("Stats")]
    assert all("print_time" in keys for keys in lines)
    for heater in ("extruder", "heater_bed"):
        for key, scale in (("temp", 1), ("target", 1), ("pwm", 100)):
            expected = [float(keys[f"{heater}:{key}"]) * scale for keys in lines]
            np.testing.assert_array_equal(table.values[f"{heater}.{key}"], expected)
    assert table.units["extruder.pwm"] == "percent" and table.units["heater_bed.temp"] == "degC"


def test_times_stand_on_the_calendar_by_the_start_of_the_printer(tmp_path, log):
    table = load_klippy(write(tmp_path, log))
    assert table.time[0] == 1_752_314_400 * 10**9
    assert set(np.diff(table.time)) == {10**9}


def test_several_prints_and_a_reboot_are_segments_in_the_order_of_time(tmp_path, log):
    # the computer was started anew: its count of seconds falls, the calendar runs on
    second = print_log(TARGETS, longest_s=100, start_s=1_752_400_000.0, count_s=30.0, seed=1)
    raw = read(
        write(tmp_path, log + second),
        [Source("y", "extruder.temp", "degC"), Source("u", "extruder.pwm", "percent")],
    )
    table = resample(raw, sample_time_s=1.0, inputs=["u"], outputs=["y"], max_gap_s=5.0)
    assert set(table.segment) == {0, 1}
    assert any("the log holds 2 runs of Klipper" in note.message for note in raw.notes)


def test_a_rollover_that_was_pasted_behind_counts_once_and_says_so(tmp_path, log):
    once = load_klippy(write(tmp_path, log))
    lines = log.splitlines(keepends=True)
    rolled = "=============== Log rollover at Sat Jul 12 10:05:00 2025 ===============\n"
    both = load_klippy(write(tmp_path, log + rolled + "".join(lines[-50:])))
    np.testing.assert_array_equal(both.time, once.time)
    assert any("50 Stats lines stand twice and were used once" in note.message for note in both.notes)


def test_a_rolled_over_log_without_a_start_counts_from_its_own_clock(tmp_path, log):
    rolled = [line for line in log.splitlines() if not line.startswith("Start")]
    table = load_klippy(write(tmp_path, "\n".join(rolled) + "\n", "klippy.log.2025-07-12"))
    assert table.time.dtype == float and table.time[0] == 100.0
    assert file_format(tmp_path / "klippy.log.2025-07-12") == "klippy.log"


def test_the_printers_own_pid_and_limits_are_those_of_its_configuration(tmp_path, log):
    path = write(tmp_path, log)
    heaters = {heater.heater: heater for heater in printer_heaters(path)}
    for model in (EXTRUDER, BED):
        heater = heaters[model.name]
        gains = np.array(model.pid) * 100 / 255  # Klipper's pid_Kp are of a duty of 0 to 255
        np.testing.assert_allclose(heater.pid[1:4], gains, rtol=1e-12)  # one multiplication apart
        assert (heater.low_degC, heater.high_degC, heater.most_percent) == (0, model.max_temp, 100)
    assert load_klippy(path).limits["extruder.temp"] == (0.0, 260.0)
    assert "the printer holds extruder by its own PID (pid_Kp 22.2, pid_Ki 1.08, pid_Kd 114)" in inspect(path)


def test_a_heater_that_switches_on_and_off_has_no_pid(tmp_path, log):
    path = write(tmp_path, log.replace("control = pid", "control = watermark"))
    assert [(heater.control, heater.pid) for heater in printer_heaters(path)] == [("watermark", None)] * 2


def test_inspect_proposes_heaters_temperatures_limits_and_set_points(tmp_path, log):
    text = inspect(write(tmp_path, log))
    assert "{name: heater_extruder, unit: percent, low: 0, high: 100, heats: true}" in text
    assert "{name: temperature_extruder, unit: degC, reference: 200.0, low: 0, high: 245}" in text
    assert "high is 15 °C below the firmware's cut-off (max_temp)" in text  # 260 °C
    for heater in ("heater_bed", "extruder"):
        assert f'{{source: "{heater}.temp", set_point: "{heater}.target", unit: degC' in text


def test_a_line_that_breaks_off_or_is_garbled_is_counted_and_left_out(tmp_path, log):
    lines = log.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("Stats"))
    lines[first + 3] = lines[first + 3].replace("temp=", "temp=x")
    lines[first + 5] = lines[first + 5][:40]
    table = load_klippy(write(tmp_path, "\n".join(lines)[:-30]))
    notes = {note.kind: note for note in table.notes}
    assert notes["damage"].count == 1
    assert f"the first is line {first + 4}" in notes["damage"].message
    assert notes["truncated"].count == 1  # the last line has no end
    assert notes["idle"].count == 1  # a line cut before its print_time
    whole = load_klippy(write(tmp_path, log))
    assert len(table.time) == len(whole.time) - 3
    assert set(table.values["extruder.temp"]) <= set(whole.values["extruder.temp"])


def test_a_time_that_no_calendar_has_is_told_and_not_used(tmp_path, log):
    lines = log.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("Start printer"))
    counted = next(i for i, line in enumerate(lines) if line.startswith("Stats")) + 4
    late = list(lines)
    late[counted] = re.sub(r"Stats ([0-9.]+):", r"Stats 9\1e17:", lines[counted])
    table = load_klippy(write(tmp_path, "\n".join(late) + "\n"))
    whole = load_klippy(write(tmp_path, log))
    assert (
        sorted(set(whole.time) - set(table.time)) == [whole.time[4]]
        and len(table.time) == len(whole.time) - 1
    )
    assert f"the first is line {counted + 1}" in next(one.message for one in table.notes)
    undated = list(lines)
    undated[start] = re.sub(r"\(([0-9.]+) ", r"(9\g<1>0000000000 ", lines[start])
    assert undated[start] != lines[start]
    table = load_klippy(write(tmp_path, "\n".join(undated) + "\n"))
    assert table.time.dtype == float and table.time[-1] < 1e6  # by the computer's own count
    message = next(one.message for one in table.notes if one.kind == "damage")
    assert message.startswith(f"the start in line {start + 1} gives no time of day that can be")


def test_a_line_without_an_end_takes_no_memory_of_its_size(tmp_path, log):
    path = write(tmp_path, log + "Stats 900.0: " + "x" * (1 << 22))
    assert len(load_klippy(path).time) == len(load_klippy(write(tmp_path, log, "whole.log")).time)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "Starting Klippy...\nArgs: []\n",
            "should hold Klipper's Stats lines with heaters, but the log has no",
        ),
        (
            "Starting Klippy...\nStats 1.0: gcodein=0 print_time=1.0 sysload=1\n",
            "1 whole Stats lines of a printer at work, none of a heater",
        ),
        (
            "Starting Klippy...\nStats 1.0: gcodein=0 heater_bed: target=60 temp=5 pwm=0.1\n",
            "none of a heater, and 1 that are idle, garbled or cut",
        ),
        (print_log(TARGETS, longest_s=30, off=True), "but the log has no Stats line"),
    ],
    ids=["no stats", "no heater", "idle", "cold"],
)
def test_a_log_without_heaters_is_refused_in_one_sentence(tmp_path, text, sentence):
    path = write(tmp_path, text)
    with pytest.raises(ValueError, match="log while the heaters are on") as refused:
        read(path, [Source("y", "extruder.temp", "degC")])
    assert sentence in str(refused.value)


def test_bytes_flipped_anywhere_are_read_or_refused(tmp_path, log):
    rng = np.random.default_rng(0)
    content = bytearray(log.encode())
    for _ in range(60):
        changed = content.copy()
        for place in rng.integers(0, len(changed), 30):
            changed[place] = rng.integers(0, 256)
        path = tmp_path / "flipped.log"
        path.write_bytes(bytes(changed))
        try:
            read(path, [Source("y", "extruder.temp", "degC")])
        except ValueError as refused:
            assert str(refused).startswith(str(path))


def test_a_device_beside_the_heaters_is_no_output(tmp_path):
    lines = [
        stats_line(
            k,
            f"heater_bed: target=60 temp={60 + k % 3} pwm=0.{k % 7}",
            f"extruder: target=200 temp={199 + k % 3} pwm=0.{k % 5}",
        ).replace("raspberry_pi: temp=44.0", f"raspberry_pi: temp={40 + k % 5}")
        for k in range(60)
    ]
    text = inspect(write(tmp_path, "Starting Klippy...\n" + "\n".join(lines) + "\n"))
    assert "# temperatures that nothing heats, left out: raspberry_pi.temp" in text


def test_a_log_of_more_numbers_than_fit_into_memory_is_refused(tmp_path, monkeypatch):
    from pipeline.recordings import formats, klipper_logs

    monkeypatch.setattr(klipper_logs, "LINES_A_CHECK", 10)
    monkeypatch.setattr(formats, "MOST_VALUES", 1000)
    wide = " ".join(f"d{i}: temp=1 pwm=0" for i in range(50))
    lines = [f"Stats 1.0: gcodein=0 {wide} print_time=1"]
    lines += [f"Stats {k}.0: gcodein=0 print_time={k}" for k in range(2, 200)]
    with pytest.raises(ValueError, match="are more than the 1000 numbers that are read; split the recording"):
        load_klippy(write(tmp_path, "\n".join(lines) + "\n"))


def test_a_line_behind_zero_bytes_is_counted_and_left_out(tmp_path, log):
    lines = log.splitlines(keepends=True)
    place = [i for i, line in enumerate(lines) if "Stats " in line and "print_time" in line][5]
    path = write(tmp_path, "".join([*lines[:place], "\0" * 4000, *lines[place:]]))
    notes = [note.message for note in load_klippy(path).notes]
    counted = [note for note in notes if "hold text or zero bytes" in note]
    assert len(counted) == 1
    assert counted[0].startswith("1 Stats lines ")
    assert counted[0].endswith(f"the first is line {place + 1}")
