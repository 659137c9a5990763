import json
import sys

import numpy as np
import pytest
import yaml

from pipeline import cli
from pipeline.reading.recordings import Source, inspect, read
from pipeline.store.artifacts import write_recording
from pipeline.temperature.workflow.settings import Plant
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
        "temperature_1": {"source": "Zone 1 [K]", "unit": "degC", "scale": 1.0, "offset": -273.15},
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
    assert "set-points, which a plant's model has no use for: Set Point 1" in inspect(path)


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
            "is text but no table",
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
