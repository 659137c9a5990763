import lz4.frame
import numpy as np
import pytest
import yaml
import zstandard

from pipeline.recordings.formats import file_format
from pipeline.recordings.recordings import Source, inspect, read
from tests.mcap_writing import NO, Written, cdr

FLOAT64 = b"float64 data"


def bag(folder, parts: int = 2, *, storage: str = "mcap", pack=bytes, samples: int = 40):
    """A bag of std_msgs/Float64 on /heater and /zone, a message a second."""
    folder.mkdir(parents=True)
    names = [f"{folder.name}_{i}.mcap" for i in range(parts)]
    for i, name in enumerate(names):
        made = Written(NO)
        topics = [
            made.topic(topic, "cdr", "std_msgs/msg/Float64", "ros2msg", FLOAT64)
            for topic in ("/heater/duty", "/zone_1/temperature")
        ]
        for k in range(i * samples, (i + 1) * samples):
            made.message(topics[0], k, pack(cdr(("d", [float(k % 5)]))))
            made.message(topics[1], k, pack(cdr(("d", [20.0 + k / 8]))))
        (folder / name).write_bytes(made.bytes())
    information = {"version": 5, "storage_identifier": storage, "relative_file_paths": names}
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    return folder


SOURCES = [Source("u", "/heater/duty:data", "percent"), Source("y", "/zone_1/temperature:data", "degC")]


@pytest.mark.parametrize(
    "pack", [bytes, zstandard.ZstdCompressor().compress, lz4.frame.compress], ids=["plain", "zstd", "lz4"]
)
def test_the_parts_of_a_bag_are_one_recording_also_with_messages_packed_one_by_one(tmp_path, pack):
    path = bag(tmp_path / "run", pack=pack)
    assert file_format(path) == "bag"
    raw = read(path, SOURCES)
    np.testing.assert_array_equal(raw.signals["y"][0], np.arange(80))
    np.testing.assert_array_equal(raw.signals["y"][1], 20 + np.arange(80) / 8)
    assert raw.messages["/heater/duty"] == 80


def test_inspect_names_heaters_and_zones_by_their_topics(tmp_path):
    text = inspect(bag(tmp_path / "run"))
    assert "heater_1: {source: /heater/duty:data, unit: percent" in text
    assert "temperature_1: {source: /zone_1/temperature:data, unit: degC" in text


def test_another_storage_and_a_missing_part_are_refused_with_the_remedy(tmp_path):
    with pytest.raises(
        ValueError, match="is a bag in sqlite3 but should be in mcap; convert it with: ros2 bag"
    ):
        read(bag(tmp_path / "old", storage="sqlite3"), SOURCES)
    path = bag(tmp_path / "part")
    (path / "part_1.mcap").unlink()
    with pytest.raises(ValueError, match=r"part_1.mcap is named in metadata.yaml but missing"):
        read(path, SOURCES)


@pytest.mark.parametrize("text", ["", "a: [", "rosbag2_bagfile_information: 3", "x: 1"])
def test_metadata_that_is_none_is_refused_in_one_sentence(tmp_path, text):
    path = bag(tmp_path / "run")
    (path / "metadata.yaml").write_text(text)
    with pytest.raises(ValueError, match="ros2 bag reindex run") as refused:
        read(path, SOURCES)
    assert "\n" not in str(refused.value)


def test_a_damaged_part_is_counted_and_the_rest_is_read(tmp_path):
    path = bag(tmp_path / "run")
    part = path / "run_1.mcap"
    part.write_bytes(part.read_bytes()[:-200])
    raw = read(path, SOURCES)
    assert len(raw.signals["y"][0]) >= 40
    assert any(note.message.startswith("run_1.mcap: ") for note in raw.notes)


def test_metadata_that_swells_when_it_is_written_out_is_refused_at_once(tmp_path):
    path = bag(tmp_path / "run")
    text = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
    text += "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
    text += "rosbag2_bagfile_information: {storage_identifier: mcap, relative_file_paths: [*a11]}\n"
    (path / "metadata.yaml").write_text(text)
    with pytest.raises(ValueError, match="ros2 bag reindex run"):
        read(path, SOURCES)


def test_a_part_that_stands_far_from_the_others_is_named_as_perhaps_of_another_recording(tmp_path):
    path = bag(tmp_path / "run")
    assert not [note for note in read(path, SOURCES).notes if "another recording" in note.message]
    made = Written(NO)
    for topic in ("/heater/duty", "/zone_1/temperature"):
        number = made.topic(topic, "cdr", "std_msgs/msg/Float64", "ros2msg", FLOAT64)
        for k in range(40):
            made.message(number, 5000 + k, cdr(("d", [1.0])))
    (path / "run_1.mcap").write_bytes(made.bytes())
    notes = [note.message for note in read(path, SOURCES).notes]
    # the first part ends at 39 s
    apart = "two parts hold /heater/duty 4961 s apart, longer than they last: "
    assert f"{apart}one of them may be of another recording" in notes
