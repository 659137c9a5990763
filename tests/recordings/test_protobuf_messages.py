import numpy as np
import pytest
from google.protobuf import descriptor_pb2

from pipeline.recordings.messages import UnreadableMessage, message_types
from pipeline.recordings.messages import protobuf_decoder as decoder
from pipeline.recordings.messages import protobuf_fields as fields

# protoc --descriptor_set_out of: syntax = "proto3"; package machine;
# message Zone { float celsius = 1; sint32 trim = 2; optional double limit = 3; }
# message State { int64 stamp_ns = 1; double duty = 2; repeated Zone zones = 3; repeated
# int32 counts = 4; Zone nozzle = 5; fixed32 steps =
# 6; string name = 7; }
DESCRIPTOR = bytes.fromhex(
    "0abc020a07732e70726f746f12076d616368696e6522590a045a6f6e6512180a0763656c7369757318012001280252076365"
    "6c7369757312120a047472696d1802200128"
    "1152047472696d12190a056c696d6974180320012801480052056c696d697488010142080a065f6c696d697422c4010a0553"
    "7461746512190a087374616d705f6e731801"
    "2001280352077374616d704e7312120a046475747918022001280152046475747912230a057a6f6e657318032003280b320d"
    "2e6d616368696e652e5a6f6e6552057a6f6e"
    "657312160a06636f756e74731804200328055206636f756e747312250a066e6f7a7a6c6518052001280b320d2e6d61636869"
    "6e652e5a6f6e6552066e6f7a7a6c6512140a"
    "0573746570731806200128075205737465707312120a046e616d6518072001280952046e616d65620670726f746f33"
)
# google.protobuf 7.36: State(stamp_ns=-5, duty=37.5, counts=[3, -1,
# 70000], steps=4000000000, name="extruder",
#   zones=[Zone(celsius=180.5, trim=-3, limit=0.0), Zone(trim=2)], nozzle=Zone())
MESSAGE = bytes.fromhex(
    "08fbffffffffffffffff01110000000000c042401a100d0080344310051900000000000000001a021004220e03ffffffff"
    "ffffffffff01f0a2042a003500286bee3a08"
    "6578747275646572"
)
TYPES = message_types(DESCRIPTOR)


def numbers(message: bytes, *names: str) -> np.ndarray:
    return decoder(TYPES, "machine.State", names)([message])[0]


def test_numbers_of_every_kind_are_what_protobuf_wrote():
    values = numbers(
        MESSAGE,
        "steps",
        "duty",
        "stamp_ns",
        "zones[0].celsius",
        "zones[0].trim",
        "zones[1].trim",
        "counts[1]",
        "counts[2]",
    )
    assert values.tolist() == [4e9, 37.5, -5, 180.5, -3, 2, -1, 70000]


def test_what_is_not_on_the_wire_is_zero_only_where_proto3_says_so():
    """A plain number that is 0 is not written; an optional one, an
    element or a message that is absent has no value."""
    values = numbers(
        MESSAGE,
        "zones[1].celsius",
        "nozzle.celsius",
        "zones[0].limit",
        "zones[1].limit",
        "zones[2].celsius",
        "counts[3]",
    )
    np.testing.assert_array_equal(values, [0, 0, 0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(numbers(b"", "duty", "nozzle.celsius"), [0, np.nan])


def test_fields_are_named_from_the_descriptor_and_lists_from_a_message():
    single = ["stamp_ns", "duty", "nozzle.celsius", "nozzle.trim", "nozzle.limit", "steps"]
    zones = [f"zones[{i}].{part}" for i in (0, 1) for part in ("celsius", "trim", "limit")]
    assert fields(TYPES, "machine.State", None) == single
    assert fields(TYPES, "machine.State", MESSAGE) == [*single, *zones, "counts[0]", "counts[1]", "counts[2]"]


def test_a_message_cut_anywhere_is_unreadable_or_shorter_but_never_a_crash():
    whole = numbers(MESSAGE, "steps", "duty")
    for end in range(len(MESSAGE)):
        try:
            values = numbers(MESSAGE[:end], "steps", "duty")
        except UnreadableMessage:
            continue
        assert all(one in (0.0, other) for one, other in zip(values, whole, strict=True))


def test_a_schema_or_field_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="no FileDescriptorSet"):
        message_types(b"\xff\xff\xff")
    with pytest.raises(
        ValueError,
        match="does not define its own message machine.Stat; it defines machine.State, machine.Zone",
    ):
        decoder(TYPES, "machine.Stat", ["duty"])
    for field in ("name", "zones", "zones[0]", "duty[0]", "zones[0].speed", "nozzle"):
        with pytest.raises(ValueError, match="no numeric field"):
            numbers(MESSAGE, field)


def described(*files: descriptor_pb2.FileDescriptorProto) -> bytes:
    return descriptor_pb2.FileDescriptorSet(file=files).SerializeToString()


def holding_itself(width: int) -> descriptor_pb2.FileDescriptorProto:
    """A message with `width` fields of its own type and one number."""
    message = descriptor_pb2.DescriptorProto(name="Tree")
    message.field.add(name="leaf", number=1, type=1, label=1)
    for i in range(width):
        message.field.add(name=f"branch_{i}", number=i + 2, type=11, label=1, type_name=".Tree")
    return descriptor_pb2.FileDescriptorProto(name="tree.proto", syntax="proto3", message_type=[message])


def test_a_message_that_holds_itself_is_followed_a_few_levels_and_no_further():
    types = message_types(described(holding_itself(1)))
    assert len(fields(types, "Tree", b"")) == 6
    with pytest.raises(ValueError, match="Tree has more than 20000 fields; name the wanted ones"):
        fields(message_types(described(holding_itself(40))), "Tree", b"")


def test_files_in_any_order_and_without_the_well_known_ones_are_read_and_others_are_missed():
    used = descriptor_pb2.FileDescriptorProto(name="b.proto", syntax="proto3")
    used.message_type.add(name="B").field.add(name="x", number=1, type=1, label=1)
    user = descriptor_pb2.FileDescriptorProto(
        name="a.proto", syntax="proto3", dependency=["b.proto", "google/protobuf/timestamp.proto"]
    )
    message = user.message_type.add(name="A")
    message.field.add(name="b", number=1, type=11, label=1, type_name=".B")
    message.field.add(name="at", number=2, type=11, label=1, type_name=".google.protobuf.Timestamp")
    assert fields(message_types(described(user, used)), "A", None) == ["b.x", "at.seconds", "at.nanos"]
    with pytest.raises(ValueError, match="the schema imports b.proto and does not hold it"):
        message_types(described(user))
    used.dependency.append("a.proto")
    with pytest.raises(ValueError, match="no FileDescriptorSet"):
        message_types(described(user, used))


def test_a_schema_flipped_anywhere_is_read_or_refused_but_never_a_crash():
    for place in range(len(DESCRIPTOR)):
        changed = bytearray(DESCRIPTOR)
        changed[place] ^= 1 << place % 8
        try:
            names = fields(message_types(bytes(changed)), "machine.State", MESSAGE)
            decoder(message_types(bytes(changed)), "machine.State", names)([MESSAGE])
        except (ValueError, UnreadableMessage):
            continue
