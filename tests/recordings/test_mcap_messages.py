import json
import struct

import lz4.frame
import numpy as np
import pytest
import zstandard

from pipeline.recordings.messages import Channel, UnreadableMessage, decoder, fields, plain
from pipeline.recordings.recordings import Source, read
from tests.mcap_writing import Written, cdr
from tests.recordings.test_protobuf_messages import DESCRIPTOR, MESSAGE

JSON = Channel(1, "/machine", "json", {}, "", "", b"")


def numbers(message: dict | bytes, *names: str) -> list[float]:
    return decoder(JSON, names)([message if isinstance(message, bytes) else json.dumps(message).encode()])[
        0
    ].tolist()


# ---- JSON


def test_json_numbers_are_found_by_path_also_where_keys_hold_dots():
    message = {"a": 1, "b": {"c": [2.5, {"d": 3}]}, "x.y": {"z.w": 4}, "on": True}
    names = ["a", "b.c[0]", "b.c[1].d", "x.y.z.w", "on"]
    assert sorted(fields(JSON, [json.dumps(message).encode()])) == sorted(names)
    assert numbers(message, *names) == [1, 2.5, 3, 4, 1]


def test_json_null_and_absent_keys_are_missing_and_nan_is_read():
    np.testing.assert_array_equal(
        numbers(b'{"a": null, "b": NaN, "c": -Infinity}', "a", "b", "c", "d"),
        [np.nan, np.nan, -np.inf, np.nan],
    )


def test_json_text_is_refused_even_where_it_looks_like_a_number():
    with pytest.raises(ValueError, match='a should be a number but is "30.5"'):
        numbers({"a": "30.5", "b": 1}, "a", "b")
    with pytest.raises(ValueError, match="a should be a number"):
        numbers({"a": {"b": 1}}, "a")


def test_fast_and_slow_path_agree():
    """A batch of plain messages goes through one array; one null among
    them sends the batch through the other path."""
    batch = [json.dumps({"a": k / 7, "b": -k}).encode() for k in range(50)]
    fast = decoder(JSON, ["b", "a"])(batch)
    slow = decoder(JSON, ["b", "a"])([*batch, b'{"a": null, "b": 0}'])[:-1]
    np.testing.assert_array_equal(fast, slow)


def test_what_is_no_json_is_unreadable():
    for message in (b"", b"{", b'{"a": 1} x', b"\xff\xfe", b"[" * 5000):
        with pytest.raises(UnreadableMessage):
            numbers(message, "a")


def test_a_json_schema_names_fields_before_any_message():
    schema = {
        "properties": {
            "a": {"type": "number"},
            "n": {"type": "string"},
            "b": {"type": "object", "properties": {"c": {"type": "integer"}}},
        }
    }
    assert fields(JSON._replace(schema_encoding="jsonschema", schema=json.dumps(schema).encode()), []) == [
        "a",
        "b.c",
    ]


def test_other_encodings_are_refused_with_those_that_are_read():
    for encoding, schema in (("cdr", "ros2idl"), ("flatbuffer", "flatbuffer"), ("cbor", ""), ("cdr", "")):
        with pytest.raises(
            ValueError, match="is not read; cdr with ros2msg, ros1 with ros1msg, protobuf, and json are"
        ):
            fields(Channel(1, "/t", encoding, {}, "s", schema, b""), [])


# ---- messages that are compressed by themselves


def test_a_message_compressed_by_itself_is_unpacked_whether_or_not_it_says_its_size():
    message = cdr(("d", [1.5] * 40))
    stream = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    for packed in (
        zstandard.compress(message),
        stream.compress(message) + stream.flush(),
        lz4.frame.compress(message),
        message,
    ):
        assert plain(packed) == message


def test_a_compressed_message_that_is_damaged_or_asks_for_terabytes_is_unreadable():
    packed = zstandard.compress(bytes(100_000))
    with pytest.raises(UnreadableMessage):
        plain(packed[:8])
    # frame header descriptor with an eight-byte content size
    with pytest.raises(UnreadableMessage, match="say they unpack to 1099511627776 bytes"):
        plain(packed[:4] + b"\xe0" + struct.pack("<Q", 1 << 40) + packed[8:])


# ---- through a file: every encoding, on one clock


def test_every_encoding_on_its_topic_is_read_by_topic_and_field(tmp_path):
    made = Written(chunk_size=2000)
    ros2 = made.topic("/zone", "cdr", "machine/msg/Zone", "ros2msg", b"string name\nfloat64 degC\n")
    ros1 = made.topic("/bed", "ros1", "machine/Bed", "ros1msg", b"uint8 on\nfloat32 degC\n")
    proto = made.topic("/state", "protobuf", "machine.State", "protobuf", DESCRIPTOR)
    text = made.topic("/json", "json")
    for k in range(50):
        made.message(ros2, k, zstandard.compress(cdr(("s", "feed" + "d" * (k % 5)), ("d", [100.0 + k]))))
        made.message(ros1, k + 0.1, struct.pack("<Bf", 1, k / 2))
        made.message(proto, k + 0.2, MESSAGE)
        made.message(text, k + 0.3, {"duty": k / 50, "deep": {"list": [k, -k]}})
    path = tmp_path / "all.mcap"
    path.write_bytes(made.bytes())
    sources = [
        Source("zone", "/zone:degC", "degC"),
        Source("bed", "/bed:degC", "degC", 2.0, 1.0),
        Source("nozzle", "/state:zones[0].celsius", "degC"),
        Source("duty", "/json:duty", "percent", 100.0),
        Source("second", "deep.list[1]", "1"),
    ]
    raw = read(path, sources)
    k = np.arange(50)
    expected = {
        "zone": (k, 100.0 + k),
        "bed": (k + 0.1, k + 1.0),
        "nozzle": (k + 0.2, 0 * k + 180.5),
        "duty": (k + 0.3, 2.0 * k),
        "second": (k + 0.3, -k),
    }
    for name, (time, values) in expected.items():
        # times are whole nanoseconds
        np.testing.assert_allclose(raw.signals[name][0], time, atol=1e-9)
        np.testing.assert_allclose(raw.signals[name][1], values, rtol=1e-15)
    assert raw.messages == {"/zone": 50, "/bed": 50, "/state": 50, "/json": 50}


def test_the_clock_may_be_log_time_publish_time_or_a_stamp(tmp_path):
    made = Written()
    schema = b"builtin_interfaces/Time stamp\nfloat64 degC\n"
    channel = made.topic("/zone", "cdr", "machine/msg/Zone", "ros2msg", schema)
    for k in range(5):
        made.message(channel, k + 0.2, cdr(("i", [k]), ("I", [250_000_000]), ("d", [k])), published_s=k + 0.1)
    path = tmp_path / "clocks.mcap"
    path.write_bytes(made.bytes())
    for time, late in (("", 0.2), ("log_time", 0.2), ("publish_time", 0.1), ("stamp", 0.25)):
        np.testing.assert_allclose(
            read(path, [Source("zone", "degC", "degC")], time=time).signals["zone"][0],
            np.arange(5) + late,
            atol=1e-9,
        )
    with pytest.raises(ValueError, match="topic /zone has no time 'stmp'; the nearest names are stamp"):
        read(path, [Source("zone", "degC", "degC")], time="stmp")


def test_messages_that_are_not_what_the_schema_says_are_left_out_and_counted(tmp_path):
    made = Written()
    channel = made.topic("/zone", "cdr", "machine/msg/Zone", "ros2msg", b"float64 degC\n")
    for k in range(20):
        made.message(channel, k, b"\x00\x01" if k == 7 else cdr(("d", [k])))
    path = tmp_path / "one.mcap"
    path.write_bytes(made.bytes())
    raw = read(path, [Source("zone", "degC", "degC")])
    assert raw.signals["zone"][1].tolist() == [k for k in range(20) if k != 7]
    assert [(note.kind, note.count) for note in raw.notes] == [("unreadable", 1)]


def test_a_bare_name_must_be_in_one_topic_only_and_a_wrong_one_gets_the_nearest(tmp_path):
    made = Written()
    for topic in ("/front", "/back"):
        channel = made.topic(topic, "json")
        for k in range(3):
            made.message(channel, k, {"degC": k, f"{topic[1:]}_duty": k})
    path = tmp_path / "two.mcap"
    path.write_bytes(made.bytes())
    assert read(path, [Source("u", "back_duty", "1")]).signals["u"][1].tolist() == [0, 1, 2]
    with pytest.raises(
        ValueError, match=r"2 topics have a field 'degC' \(/front, /back\); write which, as in /front:degC"
    ):
        read(path, [Source("y", "degC", "degC")])
    with pytest.raises(
        ValueError, match="no message has a number 'back_dutty'; the nearest names are /back:back_duty"
    ):
        read(path, [Source("y", "back_dutty", "degC")])


def test_a_key_that_messages_get_late_is_found(tmp_path):
    made = Written(chunk_size=500)
    channel = made.topic("/machine", "json")
    for k in range(100):
        made.message(channel, k, {"a": k} if k < 60 else {"a": k, "late": -k})
    path = tmp_path / "late.mcap"
    path.write_bytes(made.bytes())
    raw = read(path, [Source("late", "late", "1")])
    assert np.isnan(raw.signals["late"][1]).sum() == 60
    assert [(note.kind, note.signal, note.count) for note in raw.notes] == [("missing", "late", 60)]
