import json
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from pipeline import cli
from pipeline.recordings import csv_files
from pipeline.recordings.recordings import Source, inspect, read
from pipeline.store.artifacts import write_recording
from pipeline.temperature.settings import Plant
from tests.conftest import count_calls
from tests.mcap_writing import NO, Written, chunks, flipped, json_recording


def proposal(text: str) -> dict:
    return yaml.safe_load(text[text.index("# a proposal") :])


def test_the_proposal_is_yaml_that_maps_the_recording(tmp_path):
    """What is pasted must be read by `params` and find its columns."""
    path = tmp_path / "rig.csv"
    path.write_text(
        "Time (sec),Heater 1 (%),duty_2,Zone 1 [K],T2_F,Set Point 1\n"
        + "".join(f"{k},{k % 50},{k % 2},{290 + k},{70 + k},{k}\n" for k in range(60))
    )
    proposed = proposal(inspect(path))
    assert proposed["ingest"]["mapping"] == {
        "heater_1": {"source": "Heater 1 (%)", "unit": "percent", "scale": 1.0, "offset": 0.0},
        "heater_2": {"source": "duty_2", "unit": "percent", "scale": 100.0, "offset": 0.0},
        "temperature_1": {
            "source": "Zone 1 [K]",
            "set_point": "Set Point 1",
            "unit": "degC",
            "scale": 1.0,
            "offset": -273.15,
        },
        "temperature_2": {"source": "T2_F", "unit": "degC", "scale": 0.555556, "offset": -17.7778},
    }
    Plant.model_validate_json(json.dumps(proposed["plant"]))
    sources = [
        Source(name, one["source"], one["unit"], one["scale"], one["offset"])
        for name, one in proposed["ingest"]["mapping"].items()
    ]
    raw = read(path, sources)
    assert raw.signals["temperature_1"][1][0] == pytest.approx(16.85)
    # 70 °F; the factor has six digits
    assert raw.signals["temperature_2"][1][0] == pytest.approx(21.111, abs=1e-3)


def test_rates_jitter_gaps_and_ranges_are_those_of_the_file(tmp_path):
    path = tmp_path / "rig.csv"
    time = [0, 0.5, 1.0, 1.6, 2.0, 9.0, 9.5, 10.0]
    path.write_text(
        "t_s,heater_1,T1_C,note\n"
        + "".join(f"{t},{k % 3},{20 + k if k != 4 else ''},ok\n" for k, t in enumerate(time))
    )
    text = inspect(path)
    assert "rows: 8 samples in 10 s, every 0.5 s (2 per second)" in text
    assert "0.1 s (largest); 1 gaps beyond 1.5 s, the longest 7 s at 2 s" in text
    assert "heater_1                         0 to 2, median 1, 3 levels" in text
    assert "T1_C                             20 to 27, median 23, 7 levels, 1 missing" in text
    assert "not numbers: note (text such as 'ok')" in text


def test_fractions_of_a_second_behind_a_hyphen_are_read_as_such_in_every_part_of_the_file(
    tmp_path, monkeypatch
):
    """As the camera program of CAXTON stamps: the last row alone would be read as two hours west."""
    monkeypatch.setattr(csv_files, "FIELDS_AT_ONCE", 300)
    rows = [
        f"2022-03-09T14:{s // 60:02d}:{s % 60:02d}-{hundredths:02d},{s % 7},{20 + s % 5}\n"
        for s, hundredths in [*((s, 5 + 90 * (s % 2)) for s in range(300)), (300, 2)]
    ]
    path = tmp_path / "rig.csv"
    path.write_text("timestamp,heater_1,T1_C\n" + "".join(rows))
    assert "rows: 301 samples in 299.97 s" in inspect(path)


def test_the_log_of_a_printer_s_camera_is_inspected(shared):
    text = inspect(shared("data/fast_caxton_frames/example_print_log.csv"))
    # the first stamp ends in 33-797, the last in 34-602
    assert "rows: 16 samples in 0.805 s" in text


def test_topics_with_their_encodings_and_what_cannot_be_read_are_listed(tmp_path):
    made = Written()
    good, bad = made.topic("/machine", "json"), made.topic("/camera", "cbor")
    for k in range(20):
        made.message(good, k, {"heater_1": float(k % 3), "temperature_1": 20.5 + k, "state": "on"})
        made.message(bad, k, b"\x01")
    path = tmp_path / "rig.mcap"
    path.write_bytes(made.bytes())
    text = inspect(path)
    assert "/machine: 20 messages, json, no schema, 2 numbers" in text
    assert "/camera: 20 messages, cbor, no schema, cannot be read: message encoding 'cbor'" in text
    assert list(proposal(text)["ingest"]["mapping"]) == ["heater_1", "temperature_1"]


def test_a_field_that_two_topics_have_is_proposed_with_its_topic(tmp_path):
    made = Written()
    for topic in ("/zone_1", "/zone_2"):
        channel = made.topic(topic, "json")
        for k in range(5):
            made.message(channel, k, {"temperature": 20.0 + k})
    path = tmp_path / "rig.mcap"
    path.write_bytes(made.bytes())
    mapping = proposal(inspect(path))["ingest"]["mapping"]
    assert [one["source"] for one in mapping.values()] == ["/zone_1:temperature", "/zone_2:temperature"]
    assert list(mapping) == ["temperature_1", "temperature_2"]


def test_damage_and_a_clock_that_runs_backwards_are_told_and_not_refused(tmp_path):
    content = json_recording(800, NO, chunk_size=4000)
    path = tmp_path / "rig.mcap"
    offset, start, _ = chunks(content)[3]
    path.write_bytes(flipped(content, start + 50, 1))
    assert f"damage: the chunk or record at byte {offset} was left out" in inspect(path)
    path = tmp_path / "rig.csv"
    path.write_text("t,heater_1\n0,1\n2,2\n1,3\n")
    assert "line 4 is at 1 s, which is before the sample ahead of it at 2 s" in inspect(path)


@pytest.mark.parametrize("kind", ["contents", "heads", "lengths"])
def test_an_mcap_whose_every_chunk_is_damaged_has_findings_and_no_proposal(tmp_path, kind):
    content = json_recording(800, NO, chunk_size=4000)
    path = tmp_path / "rig.mcap"
    for offset, start, _ in chunks(content):
        place = {"contents": start + 50, "heads": offset, "lengths": offset + 1}[kind]
        content = flipped(content, place, 4)
    path.write_bytes(content)
    text = inspect(path)
    assert "/machine: 0 messages" in text
    assert text.count("  damage: ") == (15 if kind == "contents" else 2)
    assert "no number could be read, so nothing is proposed" in text


def test_a_clock_that_starts_over_is_among_the_findings_as_it_is_read(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text("t,heater_1,T1\n" + "".join(f"{k},{k % 7},{20 + k}\n" for k in [*range(40)] * 3))
    text = inspect(path)
    assert "restart: the clock starts over 2 times: segments begin there, the first in line 42" in text
    assert "rows: 120 samples in 119 s, every 1 s" in text


def test_a_table_without_names_is_guessed_from_its_values_and_says_so(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "rig.dat"
    np.savetxt(
        path, np.column_stack([np.repeat(rng.choice([3.4, 6.4], 100), 10), np.cumsum(rng.normal(size=1000))])
    )
    text = inspect(path)
    assert "# a proposal from the values alone" in text
    assert [one["source"] for one in proposal(text)["ingest"]["mapping"].values()] == ["column_1", "column_2"]
    assert [len(proposal(text)["plant"][kind]) for kind in ("inputs", "outputs")] == [1, 1]
    assert "write its name, or time: every 1.0 s with the sample time" in text


def test_a_guessed_input_may_not_leave_what_was_recorded(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "rig.dat"
    levels = [np.repeat(rng.choice(pair, 100), 10) for pair in ([3.4, 6.4], [-1.2, 1.1])]
    np.savetxt(path, np.column_stack([*levels, np.cumsum(rng.normal(size=1000))]))
    limits = [(one["low"], one["high"]) for one in proposal(inspect(path))["plant"]["inputs"]]
    assert limits == [(3, 7), (-2, 2)]


@pytest.mark.parametrize("full", [255, 595.346, 514.614, 2999.7, 1e5 / 3])
def test_the_largest_value_of_a_scaled_input_stays_within_its_limit(tmp_path, full):
    path = tmp_path / "rig.csv"
    rows = [f"{t},{full if t % 7 else 0},{20 + t / 9}\n" for t in range(100)]
    path.write_text("time_s,u1,T1_C\n" + "".join(rows))
    proposed = proposal(inspect(path))
    (limit,), scale = proposed["plant"]["inputs"], proposed["ingest"]["mapping"]["heater_1"]["scale"]
    # six digits are written, so that at most a part in 1e5 is given away
    assert limit["high"] * (1 - 1e-5) <= full * scale <= limit["high"]


def test_an_input_that_its_name_calls_a_heater_is_marked_as_one_that_heats(tmp_path):
    names = ["heater_1_pct", "bed_duty", "cooling_pct", "heat_exchanger_pct", "fan_pct", "Q1_pct"]
    rows = [",".join(map(str, [t, *(10 * ((t + k) % 7) for k in range(6)), 20 + t / 9])) for t in range(99)]
    (tmp_path / "rig.csv").write_text("\n".join([",".join(["time_s", *names, "zone_C"]), *rows]))
    proposed = proposal(inspect(tmp_path / "rig.csv"))
    sources = {name: one["source"] for name, one in proposed["ingest"]["mapping"].items()}
    heating = {sources[one["name"]] for one in proposed["plant"]["inputs"] if one.get("heats")}
    assert heating == {"heater_1_pct", "bed_duty"}
    assert {one["name"] for one in proposed["plant"]["inputs"]} < sources.keys()


def test_our_own_recordings_are_proposed_under_their_own_names(tmp_path):
    time = np.arange(100.0)
    signals = {
        "heater_1": (time % 7, "percent", ""),
        "motor": (time % 5, "percent", ""),
        "sensor_1": (150 + time / 10, "degC", ""),
    }
    write_recording(tmp_path / "ours.mcap", time, signals)
    proposed = proposal(inspect(tmp_path / "ours.mcap"))
    assert {name: one["source"] for name, one in proposed["ingest"]["mapping"].items()} == {
        "heater_1": "heater_1",
        "motor": "motor",
        "temperature_1": "sensor_1",
    }
    assert proposed["plant"]["sample_time_s"] == 1.0


def test_the_same_file_gives_the_same_words(shared):
    path = shared("data/tclab_mlid_prbs/prbs.csv")
    text = inspect(path)
    assert text == inspect(path)
    assert "rows: 5100 samples in 5099 s, every 1 s" in text
    assert [one["source"] for one in proposal(text)["ingest"]["mapping"].values()] == [
        "Q1_pct",
        "Q2_pct",
        "T1_C",
        "T2_C",
    ]


@pytest.mark.parametrize(
    "name", ["cdr_test_0", "custom-camera-model", "talker", "topics_and_services", "wbag_0"]
)
def test_mcap_files_of_others_are_inspected(shared, name):
    text = inspect(shared(f"data/mcap_ros2/{name}.mcap"))
    assert "topics" in text
    assert "Findings" in text


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "is empty (0 bytes)"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "is a PNG picture but should be MCAP, Parquet or CSV"),
        (
            bytes(np.random.default_rng(0).integers(1, 256, 4000, np.uint8)),
            "are neither text nor Parquet nor MCAP",
        ),
        (b"name,owner\nrig,bob\nrig,eve\n", "has 3 lines of text and no data"),
        (
            b"import numpy as np\n\ndef f(x, y):\n    return 1 + x, 2\n\n\nclass A:\n    a: int = 3\n",
            "is text but no table: expected rows of numbers of one width but found lines of words",
        ),
        (
            b"t,Q1,T1\n0,20 %,21 C\n1,20 %,21 C\n",
            "none of its 3 columns holds numbers beside the time (Q1 (text such as '20 %')",
        ),
    ],
    ids=["empty", "picture", "bytes", "text", "program", "units"],
)
def test_what_is_no_recording_is_refused_in_one_sentence_of_the_command(
    tmp_path, monkeypatch, capsys, content, sentence
):
    path = tmp_path / "rig.csv"
    path.write_bytes(content)
    monkeypatch.setattr(sys, "argv", ["beadline", "inspect", str(path)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    printed = capsys.readouterr()
    assert ended.value.code == 1
    assert printed.out == ""
    assert printed.err.startswith(f"beadline: {path}")
    assert printed.err.count("\n") == 1
    assert sentence in printed.err


def test_a_table_without_a_time_is_told_what_to_write_and_the_proposal_has_it(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text("Q1,T1\n" + "".join(f"{k % 30},{20 + k / 7}\n" for k in range(100)))
    text = inspect(path)
    assert (
        "no column is called like a time; write its name, or time: every 1.0 s with the sample time" in text
    )
    assert proposal(text)["ingest"]["time"] == "every 1.0 s"


def test_columns_of_one_name_are_named_and_those_of_other_programs_are_recognised(tmp_path):
    path = tmp_path / "rig.csv"
    names = "timestamp,tool0 actual,tool0 target,heater_bed.temperature,extruder.power,x,x"
    path.write_text(
        names
        + "\n"
        + "".join(
            f"2025-11-21 13:00:{k:02d},{20 + k / 7},60,{30 + k / 9},0.{k % 9},{k},{k}\n" for k in range(60)
        )
    )
    text = inspect(path)
    assert "the same name twice, so that none of them can be mapped; give each its own: x (2 times)" in text
    assert {name: one["source"] for name, one in proposal(text)["ingest"]["mapping"].items()} == {
        "temperature_0": "tool0 actual",
        "temperature_bed": "heater_bed.temperature",
        "heater_extruder": "extruder.power",
    }


# ---- what a person meets first


def plc(path) -> None:
    """35 topics of a controller, each with one number `data`: 16 zones with temperature and duty, an
    emergency stop, a status word and a cycle counter."""
    made, rng = Written(), np.random.default_rng(0)
    names = [f"/plc/zone_{i}_temperature" for i in range(1, 17)]
    names += [f"/plc/zone_{i}_duty" for i in range(1, 17)]
    names += ["/plc/emergency_stop", "/plc/status", "/plc/cycle_counter"]
    channels = [made.topic(name, "json") for name in names]
    for k in range(60):
        values = [
            *(200 + rng.normal(0, 1, 16)),
            *(50 + 10 * rng.integers(0, 4, 16)),
            float(k > 40),
            float(k % 3),
            float(k),
        ]
        for channel, value in zip(channels, values, strict=True):
            made.message(channel, float(k), {"data": float(value)})
    path.write_bytes(made.bytes())


def test_a_controller_with_a_topic_a_signal_is_named_by_its_topics(tmp_path):
    plc(tmp_path / "plc.mcap")
    proposed = proposal(inspect(tmp_path / "plc.mcap"))
    mapping = {name: one["source"] for name, one in proposed["ingest"]["mapping"].items()}
    expected = {f"temperature_{i}": f"/plc/zone_{i}_temperature:data" for i in range(1, 17)}
    expected |= {f"heater_{i}": f"/plc/zone_{i}_duty:data" for i in range(1, 17)}
    assert mapping == expected
    Plant.model_validate_json(json.dumps(proposed["plant"]))


def test_a_file_is_looked_at_and_walked_once_whatever_the_number_of_topics(tmp_path, monkeypatch):
    from pipeline.recordings import mcap_files

    walks, batches = [], mcap_files.McapFile.batches

    def counted(self, wanted):
        walks.append(self.path)
        return batches(self, wanted)

    plc(tmp_path / "plc.mcap")
    monkeypatch.setattr(mcap_files.McapFile, "batches", counted)
    inspect(tmp_path / "plc.mcap")
    assert len(walks) == 2


def test_rubbish_behind_the_first_bytes_is_among_the_findings(tmp_path):
    (tmp_path / "rig.mcap").write_bytes(b"\x89MCAP0\r\nabc")
    text = inspect(tmp_path / "rig.mcap")
    assert "Findings: none" not in text
    assert "truncated: the file breaks off: from byte 8 on" in text


def test_a_temperature_called_T_is_none_of_the_times(tmp_path):
    rows = "".join(f"{k},{20 + k % 7},{k % 5 * 20}\n" for k in range(60))
    for head in ("time_s,T,duty", "time,T,duty", "millis,T,duty"):
        (tmp_path / "rig.csv").write_text(f"{head}\n{rows}")
        proposed = proposal(inspect(tmp_path / "rig.csv"))
        sources = [one["source"] for one in proposed["ingest"]["mapping"].values()]
        assert sources == ["T", "duty"]
        assert "time" not in proposed["ingest"]
    # alone it is no time either
    (tmp_path / "rig.csv").write_text("T,duty\n" + "".join(f"{20 + k % 7},{k % 5 * 20}\n" for k in range(60)))
    assert proposal(inspect(tmp_path / "rig.csv"))["ingest"]["time"] == "every 1.0 s"


def test_a_clock_in_milliseconds_is_read_by_its_name_or_remarked_by_its_step(tmp_path):
    rows = "".join(f"{k * 100},{20 + k % 7},{k % 5 * 20}\n" for k in range(60))
    for head in ("time_ms", "millis", "t [ms]"):
        (tmp_path / "rig.csv").write_text(f"{head},zone_C,duty\n{rows}")
        assert "every 0.1 s (10 per second)" in inspect(tmp_path / "rig.csv")
    (tmp_path / "rig.csv").write_text(f"time,zone_C,duty\n{rows}")
    assert "time steps by 100, read as seconds; if it counts ms, name the column time_ms" in inspect(
        tmp_path / "rig.csv"
    )


def test_a_clock_in_hours_is_read_by_its_name_or_remarked_by_its_step(tmp_path):
    def told(head: str, per_hour: float, digits: int = 6) -> str:
        rows = "".join(f"{k / per_hour:.{digits}f},{20 + k % 7},{k % 5 * 20}\n" for k in range(600))
        (tmp_path / "rig.csv").write_text(f"{head},zone_C,duty\n{rows}")
        return inspect(tmp_path / "rig.csv")

    assert "sample_time_s: 1.0\n" in told("time_h", 3600.0) and "if it counts" not in told("time_h", 3600.0)
    for every_s in (1, 2, 5):
        assert "read as seconds; if it counts h, name the column time_h" in told("time", 3600.0 / every_s)
    # rates that machines have
    for rate in (1000.0, 500.0, 100.0, 60.0, 10.0):
        assert "if it counts" not in told("time", rate, 9)


@pytest.mark.parametrize("scale", [("stamp_ms", 1e3), ("stamp_us", 1e6), ("stamp_ns", 1e9)])
def test_a_field_that_is_the_clock_counts_in_the_unit_of_its_name(tmp_path, scale):
    name, per_second = scale
    made = Written()
    channel = made.topic("/rig", "json")
    for k in range(20):
        made.message(channel, 100.0 + k, {"temperature": 20.0 + k, name: k * 0.5 * per_second})
    (tmp_path / "rig.mcap").write_bytes(made.bytes())
    raw = read(tmp_path / "rig.mcap", [Source("y", "temperature", "degC")], time=name)
    np.testing.assert_allclose(raw.signals["y"][0], np.arange(20) * 0.5, atol=1e-9)  # ns
    assert f"source: {name}" not in inspect(tmp_path / "rig.mcap")


@pytest.mark.parametrize("text", ['a,b\n0,1\n1,"2', 'a,b\n0,1\n1,"2\n2,3\n3,4\n'])
def test_a_quotation_mark_that_is_never_closed_is_named_with_its_line(tmp_path, text):
    (tmp_path / "rig.csv").write_text(text)
    with pytest.raises(ValueError, match="line 3: a quotation mark is opened there and never closed"):
        inspect(tmp_path / "rig.csv")


@pytest.mark.parametrize(
    ("name", "inputs", "outputs"),
    [
        ("daisy_a/dryer.dat", 1, 1),
        ("daisy_a/evaporator.dat", 3, 3),
        ("daisy_a/glassfurnace.dat", 3, 6),
        ("tclab_apmonitor/energy_balance_mimo.csv", 2, 2),
        ("tclab_apmonitor/second_order_mimo.csv", 2, 2),
        ("tclab_mlid_prbs/prbs.csv", 2, 2),
        ("paper_reference/probing_log_seed1.parquet", 7, 5),
        # logs of a printer's temperatures without any duty: the sentence says so
        ("caxton_print0_log/caxton_print0_early.csv", 0, 2),
        ("fast_caxton_frames/example_print_log.csv", 0, 2),
    ],
)
def test_the_proposal_of_a_real_record_reads_it_and_is_a_plant(shared, name, inputs, outputs):
    path = shared(f"data/{name}")
    proposed = proposal(inspect(path))
    plant = proposed["plant"]
    assert (len(plant["inputs"]), len(plant["outputs"])) == (inputs, outputs)
    sources = [
        Source(signal, one["source"], one["unit"], one["scale"], one["offset"])
        for signal, one in proposed["ingest"]["mapping"].items()
    ]
    raw = read(path, sources, time=proposed["ingest"].get("time", ""))
    for one in plant["inputs"]:
        values = raw.signals[one["name"]][1]
        assert one["low"] - 1e-3 <= values.min() and values.max() <= one["high"] + 1e-3  # six digits of scale
    if inputs:
        Plant.model_validate_json(json.dumps(plant))
    else:
        assert "a plant cannot be identified without; if the duty is not in the recording" in inspect(path)


@pytest.mark.parametrize(
    "line", ["{:8.2f}    {:8.1f}    {:10.3f}\n", "{:.2f}\t{:.1f}\t{:.3f}\n"], ids=["widths", "tabs"]
)
def test_a_text_with_fixed_widths_or_tabs_is_a_table_with_names_of_several_words(tmp_path, line):
    head = "Time (s)    Heater 1    Zone 1 (C)\n".replace("    ", "\t" if "\t" in line else "    ")
    (tmp_path / "rig.txt").write_text(
        head + "".join(line.format(k / 2, k % 4 * 20, 20 + k / 7) for k in range(60))
    )
    text = inspect(tmp_path / "rig.txt")
    assert "every 0.5 s (2 per second)" in text
    sources = [one["source"] for one in proposal(text)["ingest"]["mapping"].values()]
    assert sources == ["Heater 1", "Zone 1 (C)"]


def test_a_wide_table_is_described_by_what_its_names_tell_in_no_longer_than_it_is_read(tmp_path):
    """The bar is 1.5 times the calls of one plain read of all columns; 1.2 times were counted."""
    rng = np.random.default_rng(0)
    names = [f"tag_{j}" for j in range(3000)]
    names[2500], names[2900] = "heater_1_pct", "zone_1_C"
    path = tmp_path / "plc.parquet"
    values = {name: 50 + rng.normal(size=50) for name in names}
    pq.write_table(pa.table({"time_s": np.arange(50.0), **values}), path)
    plain = count_calls(lambda: read(path, [Source(name, name, "") for name in names]))
    text = inspect(path)
    assert count_calls(lambda: inspect(path)) < 1.5 * plain
    assert "fields: 3000 columns hold numbers; 128 are shown" in text
    mapped = {one["source"] for one in proposal(text)["ingest"]["mapping"].values()}
    assert {"heater_1_pct", "zone_1_C"} <= mapped


# ---- codes for missing values


def logged(path, code: float, share: float, rng: np.random.Generator) -> None:
    """A zone that warms and cools between 22 and 210 °C with a duty; a share of the readings is the code."""
    k = np.arange(1000)
    duty = 60.0 * (k // 250 % 2 == 0)
    zone = 22 + np.convolve(duty, 0.05 * np.exp(-k / 60))[:1000] + rng.normal(0, 0.1, 1000)
    zone[rng.choice(1000, round(share * 1000), replace=False)] = code
    rows = "".join(f"{i},{u:.1f},{y:.2f}\n" for i, u, y in zip(k, duty, zone, strict=True))
    path.write_text("time_s,heater_1_pct,zone_1_C\n" + rows)


@pytest.mark.parametrize("share", [0.004, 0.03, 0.2])
@pytest.mark.parametrize("code", [-9999, -999, 9999, 32767, -32768, 6553.5, 850, 85, -127, 2048, 4095])
def test_a_code_for_a_missing_value_is_named_with_its_share_and_the_remedy(tmp_path, code, share):
    logged(tmp_path / "rig.csv", code, share, np.random.default_rng(7))
    text = inspect(tmp_path / "rig.csv")
    count = round(1000 * share)
    assert (
        f"missing code: zone_1_C is exactly {code:g} in {share * 100:.2g} % of its values ({count} of" in text
    )
    assert "write an empty cell (NaN) in its place" in text
    assert proposal(text)["plant"]["outputs"][0]["reference"] > 20  # the code is left out of the proposal


def test_a_clean_record_has_no_code_even_with_such_numbers_among_its_own(tmp_path):
    rng, k = np.random.default_rng(5), np.arange(2000)
    columns = {
        "setpoint_C": np.repeat([60.0, 85.0, 60.0, 85.0], 500),
        "furnace_setpoint_C": np.repeat([20.0, 850.0], 1000),
        "duty_pct": np.clip(np.round(50 + 60 * np.sin(k / 40) + rng.normal(0, 8, 2000)), 0, 85),
        "adc_duty": np.round(np.clip(2048 + 3000 * np.sin(k / 30), 0, 4095)),
        "zone_1_C": np.round(85 + 3 * np.sin(k / 90) + rng.normal(0, 0.3, 2000), 1),
        "zone_2_C": np.round(np.clip(20 + k / 2, 20, 850), 0),
        "screw_rpm": np.repeat(rng.choice([0.0, 850.0, 999.0, 2000.0], 40), 50),
        "pressure": np.round(rng.normal(1000, 20, 2000)),
    }
    rows = np.column_stack([k, *columns.values()])
    header = ",".join(["time_s", *columns])
    np.savetxt(tmp_path / "rig.csv", rows, delimiter=",", header=header, comments="", fmt="%.2f")
    assert "missing code" not in inspect(tmp_path / "rig.csv")


@pytest.mark.parametrize(
    "name",
    [
        "daisy_a/dryer.dat",
        "daisy_a/evaporator.dat",
        "daisy_a/glassfurnace.dat",
        "tclab_apmonitor/energy_balance_mimo.csv",
        "tclab_apmonitor/second_order_mimo.csv",
        "tclab_mlid_prbs/prbs.csv",
        "paper_reference/probing_log_seed1.parquet",
        "caxton_print0_log/caxton_print0_early.csv",
        "fast_caxton_frames/example_print_log.csv",
        "mcap_ros2/cdr_test_0.mcap",
        "mcap_ros2/wbag_0.mcap",
    ],
)
def test_no_code_is_seen_in_real_records(shared, name):
    assert "missing code" not in inspect(shared(f"data/{name}"))
