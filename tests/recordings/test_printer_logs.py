import json

import numpy as np
import pytest

from pipeline.recordings.formats import file_format
from pipeline.recordings.recordings import Source, inspect, read

STORE = {
    "extruder": {
        "temperatures": [20.0, 21.5, 23.0],
        "targets": [0.0, 200.0, 200.0],
        "powers": [0.0, 1.0, 0.5],
    },
    "temperature_sensor chamber": {"temperatures": [30.0, 31.0]},
}
SERIAL = (
    "2024-02-11 00:35:36,096 - Connecting to: /dev/ttyUSB0\n"
    "2024-02-11 00:35:37,000 - Send: M105\n"
    "2024-02-11 00:35:37,100 - Recv: ok T:210.21 /210.00 B:64.84 /65.00 @:127 B@:64\n"
    "2024-02-11 00:35:38,100 - Recv:  T:-5.5 /0.00 B:64.10 /0.00 @:0 B@:0 W:?\n"
    "2024-02-11 00:35:39,100 - Recv: echo:busy: processing\n"
    "2024-02-11 00:35:40,100 - Recv:  T:208.0 /210.00 B:63.00 /65.00ok\n"
)


@pytest.mark.parametrize("document", [STORE, {"result": STORE}, {"jsonrpc": "2.0", "result": STORE, "id": 1}])
def test_a_temperature_store_is_read_at_one_second_in_our_units(tmp_path, document):
    path = tmp_path / "store.json"
    path.write_text(json.dumps(document))
    assert file_format(path) == "Moonraker JSON"
    sources = ["extruder.temp", "extruder.target", "extruder.pwm", "temperature_sensor chamber.temp"]
    raw = read(path, [Source(f"s{i}", name, "") for i, name in enumerate(sources)])
    np.testing.assert_array_equal(raw.signals["s0"][0], [0, 1, 2])
    np.testing.assert_array_equal(raw.signals["s2"][1], [0, 100, 50])
    # the newest entries are of one instant: a shorter list began later
    np.testing.assert_array_equal(raw.signals["s3"][1], [np.nan, 30, 31])
    assert any("has no times: its entries were taken as 1 s apart" in note.message for note in raw.notes)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('{"result": {"extruder": {"temperatures": [20.0, 21', "the JSON breaks there"),
        ('{"temperatures": 3}', "expected Moonraker's temperature store, a device with temperatures"),
        ('{"a": {"temperatures": []}}', "the table should have rows but has none"),
        ('{"a": 1}', "is JSON but should be MCAP, Parquet or CSV"),
    ],
    ids=["truncated", "no device", "empty", "other"],
)
def test_json_that_is_no_store_is_refused_in_one_sentence(tmp_path, text, sentence):
    path = tmp_path / "store.json"
    path.write_text(text)
    with pytest.raises(ValueError) as refused:
        read(path, [Source("y", "a.temp", "degC")])
    assert str(refused.value).startswith(str(path)) and sentence in str(refused.value)


def test_a_serial_log_gives_what_the_firmware_reported(tmp_path):
    path = tmp_path / "serial.log"
    path.write_text(SERIAL)
    assert file_format(path) == "serial.log"
    names = ["tool.temp", "tool.target", "tool.pwm", "bed.temp", "bed.pwm"]
    raw = read(path, [Source(name.replace(".", "_"), name, "") for name in names])
    np.testing.assert_allclose(raw.signals["tool_temp"][0], [0.1, 1.1, 3.1], atol=1e-9)  # ns in floats
    np.testing.assert_array_equal(raw.signals["tool_temp"][1], [210.21, -5.5, 208.0])
    np.testing.assert_array_equal(raw.signals["tool_pwm"][1][:2], [100, 0])
    np.testing.assert_allclose(raw.signals["bed_pwm"][1][0], 6400 / 127, rtol=1e-15)
    assert np.isnan(raw.signals["bed_pwm"][1][2])


def test_a_duty_that_counts_beyond_127_counts_to_255(tmp_path):
    path = tmp_path / "serial.log"
    path.write_text(SERIAL.replace("@:127", "@:255"))
    raw = read(path, [Source("u", "tool.pwm", "percent"), Source("v", "bed.pwm", "percent")])
    assert raw.signals["u"][1][0] == 100


def test_the_tool_at_work_is_no_tool_of_its_own(tmp_path):
    path = tmp_path / "serial.log"
    lines = [
        f"2022-09-24 17:11:{k:02d},661 - Recv: T:{20 + k}.2 /0.0 B:{20 + k}.1 /0.0 T0:{20 + k}.2 /0.0 "
        f"T1:{25 + k}.0 /0.0 @:{k} B@:{k} @0:{k} @1:0\n"
        for k in range(30)
    ]
    path.write_text("".join(lines))
    text = inspect(path)
    assert "tool0.temp" in text and "tool1.temp" in text and " tool.temp" not in text
    assert "{name: heater_0, unit: percent" in text


def test_a_report_at_the_time_of_another_is_left_out_and_counted(tmp_path):
    path = tmp_path / "serial.log"
    path.write_text(SERIAL + SERIAL.splitlines()[-1])
    raw = read(path, [Source("y", "tool.temp", "degC")])
    assert len(raw.signals["y"][0]) == 3
    assert any("1 reports came at the time of another" in note.message for note in raw.notes)


def test_a_log_without_times_is_refused(tmp_path):
    path = tmp_path / "terminal.txt"
    path.write_text("Recv: ok T:210.21 /210.00 B:64.84 /65.00 @:127 B@:64\n" * 5)
    with pytest.raises(ValueError, match="found 5 reports without a time; write the log with times"):
        read(path, [Source("y", "tool.temp", "degC")])
