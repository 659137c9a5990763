import struct

import numpy as np
import pytest
from mcap.reader import make_reader

from pipeline.recordings.messages import UnreadableMessage
from pipeline.recordings.messages import ros_decoder as decoder
from pipeline.recordings.messages import ros_fields as fields
from pipeline.recordings.messages import ros_layout as layout
from tests.mcap_writing import cdr

SEPARATOR = "=" * 80 + "\n"
TEMPERATURE = (
    "# one sensor\nstd_msgs/Header header\nfloat64 temperature  # in degC\nfloat64 variance\nuint8 KIND=3\n"
    + SEPARATOR
    + "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + SEPARATOR
    + "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)


def numbers(definition: str, message: bytes, names: list[str], version: int = 2) -> list[float]:
    return decoder(layout(definition, "machine/msg/State", version=version), names, version=version)(
        [message]
    )[0].tolist()


def test_fields_of_a_message_are_its_numbers_without_text_and_constants():
    assert fields(layout(TEMPERATURE, "sensor_msgs/msg/Temperature", version=2), None, version=2) == [
        "header.stamp.sec",
        "header.stamp.nanosec",
        "temperature",
        "variance",
    ]


@pytest.mark.parametrize("frame", ["", "a", "ab", "abcdefg", "barrel_zone_4"])
def test_numbers_behind_text_of_any_length_are_found_at_their_alignment(frame):
    message = cdr(("i", [7]), ("I", [500]), ("s", frame), ("d", [181.25, 0.5]))
    assert numbers(TEMPERATURE, message, ["temperature", "header.stamp.nanosec", "variance"]) == [
        181.25,
        500.0,
        0.5,
    ]


def test_numbers_of_every_size_are_aligned_to_their_size():
    definition = "bool a\nint16 b\nuint8 c\nfloat64 d\nint8 e\nfloat32 f\nuint8 g\nuint64 h\n"
    message = cdr(
        ("?", [True]),
        ("h", [-2]),
        ("B", [3]),
        ("d", [4.5]),
        ("b", [-5]),
        ("f", [6.5]),
        ("B", [7]),
        ("Q", [8]),
    )
    assert numbers(definition, message, list("abcdefgh")) == [1, -2, 3, 4.5, -5, 6.5, 7, 8]


def test_big_endian_and_xcdr2_are_read_by_their_header():
    definition = "uint8 a\nfloat64 b\n"
    assert numbers(definition, b"\x00\x00\x00\x00" + struct.pack(">B7xd", 3, 1.5), ["a", "b"]) == [3, 1.5]
    # XCDR2 aligns to four bytes at most
    assert numbers(definition, b"\x00\x07\x00\x00" + struct.pack("<B3xd", 3, 1.5), ["a", "b"]) == [3, 1.5]


def test_elements_of_lists_are_read_by_index_and_missing_ones_are_nan():
    definition = "float64[] position\nstring[] names\nint16[3] fixed\nuint8 last\n"
    message = cdr(
        ("I", [2]), ("d", [1.5, 2.5]), ("I", [2]), ("s", "one"), ("s", "three"), ("h", [4, 5, 6]), ("B", [9])
    )
    names = ["last", "position[1]", "position[0]", "position[2]", "fixed[2]"]
    np.testing.assert_array_equal(numbers(definition, message, names), [9, 2.5, 1.5, np.nan, 6])
    assert fields(layout(definition, "m", version=2), message, version=2) == [
        "fixed[0]",
        "fixed[1]",
        "fixed[2]",
        "last",
        "position[0]",
        "position[1]",
    ]


def test_an_empty_list_of_wide_numbers_takes_no_alignment():
    message = cdr(("I", [0]), ("i", [-3]))
    assert numbers("float64[] empty\nint32 after\n", message, ["after"]) == [-3]


def test_lists_of_messages_are_read_by_index():
    definition = (
        "machine/Zone[] zones\nint32 after\n"
        + SEPARATOR
        + "MSG: machine/Zone\nstring name\nfloat64 degC\nfloat32[2] limits\n"
    )
    zone = [("s", "feed"), ("d", [180.5]), ("f", [1, 2]), ("s", "nozzle"), ("d", [200.25]), ("f", [3, 4])]
    message = cdr(("I", [2]), *zone, ("i", [42]))
    names = ["zones[1].degC", "after", "zones[1].limits[0]", "zones[5].degC"]
    np.testing.assert_array_equal(numbers(definition, message, names), [200.25, 42, 3, np.nan])


def test_ros1_has_no_alignment_and_its_own_time():
    definition = (
        "Header header\nuint8 a\nfloat64 b\nduration d\n"
        + SEPARATOR
        + "MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    )
    message = struct.pack("<IIII4sBdii", 5, 11, 22, 4, b"base", 3, 1.25, -1, 7)
    names = ["header.stamp.secs", "header.stamp.nsecs", "a", "b", "d.secs", "d.nsecs"]
    assert numbers(definition, message, names, version=1) == [11, 22, 3, 1.25, -1, 7]


def test_messages_that_do_not_fit_their_schema_are_unreadable():
    for message in (cdr(("i", [7])), cdr(("d", [1.0] * 9)), b"\x00\x01\x00\x00" + b"\xff" * 60):
        with pytest.raises(UnreadableMessage):
            numbers(TEMPERATURE, message, ["temperature"])
    with pytest.raises(UnreadableMessage, match="representation 0x0003 is not read"):
        numbers("float64 a\n", b"\x00\x03\x00\x00" + bytes(8), ["a"])
    with pytest.raises(UnreadableMessage, match="a message of 16 bytes where 8 are expected"):
        numbers("float64 a\n", cdr(("d", [1.0, 2.0])), ["a"])


@pytest.mark.parametrize(
    ("definition", "reason"),
    [
        ("float64 a\n---\nfloat64 b\n", "is a service's"),
        ("Zone zone\n", "uses Zone but does not define it"),
        ("float64\n", "the line 'float64', which is no field"),
        ("machine/Loop loop\n" + SEPARATOR + "MSG: machine/Loop\nmachine/Loop loop\n", "contains itself"),
        (
            "machine/Big[9000] big\n" + SEPARATOR + "MSG: machine/Big\nfloat64 a\nfloat64 b\nfloat64 c\n",
            "more than 20000 parts",
        ),
    ],
)
def test_a_schema_that_cannot_be_read_says_why(definition, reason):
    with pytest.raises(ValueError, match=reason):
        layout(definition, "machine/msg/State", version=2)


def test_wide_text_ends_what_is_read_and_all_before_it_stays_readable():
    definition = "float64 a\nwstring name\nfloat64 b\n"
    items = layout(definition, "m", version=2)
    assert fields(items, None, version=2) == ["a"]
    assert numbers(definition, cdr(("d", [2.5])) + b"anything", ["a"]) == [2.5]


def test_messages_recorded_by_ros_2_are_read_to_their_last_field(shared):
    """Every message is used up to its end: `_decode` refuses one that is longer than what its schema says."""
    with shared("data/mcap_ros2/cdr_test_0.mcap").open("rb") as stream:
        messages = [(schema, message.data) for schema, _, message in make_reader(stream).iter_messages()]
    assert len(messages) == 7
    arrays = [(schema, data) for schema, data in messages if schema.name == "test_msgs/msg/Arrays"]
    for schema, data in arrays:
        definition = schema.data.decode()
        names = [
            "int32_values_default[1]",
            "uint64_values_default[2]",
            "defaults_values[2].float64_value",
            "alignment_check",
        ]
        # defaults of rosbag2's test_msgs/Arrays, as its message definition prints them
        assert numbers(definition, data, names) == [2**31 - 1, 2.0**64, 1.125, 0]


@pytest.mark.parametrize("definition", ["float32 a\n", "string name\nfloat32 a\n"])
def test_a_message_with_a_number_behind_what_its_schema_says_is_refused(definition):
    head = [("s", "rig")] if "name" in definition else []
    assert numbers(definition, cdr(*head, ("f", [2.5])) + bytes(4), ["a"]) == [2.5]  # padded to eight
    assert numbers(definition, cdr(*head, ("f", [2.5])) + b"abc", ["a"]) == [2.5]
    with pytest.raises(UnreadableMessage, match=r"a message of \d+ bytes where \d+ are expected"):
        numbers(definition, cdr(*head, ("I", [7]), ("f", [200.5])), ["a"])
