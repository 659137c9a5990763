"""Numbers of protobuf messages. The FileDescriptorSet of the schema gives the fields, and the wire is walked
for the wanted ones.

Wire format: protobuf.dev/programming-guides/encoding. Numbers of the descriptor's fields:
google/protobuf/descriptor.proto.
"""

import re
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.reading.ros_messages import LARGEST_LAYOUT, LONGEST_LISTED, UnreadableMessage

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
# FieldDescriptorProto.Type -> wire type and struct format, or how a varint is read
_NUMBERS = {
    1: (FIXED64, "<d"), 2: (FIXED32, "<f"), 3: (VARINT, "signed"), 4: (VARINT, "unsigned"),
    5: (VARINT, "signed"), 6: (FIXED64, "<Q"),
    7: (FIXED32, "<I"), 8: (VARINT, "unsigned"), 13: (VARINT, "unsigned"), 14: (VARINT, "signed"),
    15: (FIXED32, "<i"), 16: (FIXED64, "<q"),
    17: (VARINT, "zigzag"), 18: (VARINT, "zigzag"),
}  # fmt: skip
_MESSAGE = 11
_DEEPEST = 6


class Field(NamedTuple):
    """A field of a message type. A field that is not on the wire has no value with `presence`, and is 0
    without (proto3's plain numbers)."""

    name: str
    type: int
    of: str
    repeated: bool
    presence: bool


class _Node(NamedTuple):
    """The wanted part of one field: places of its numbers and plans of its messages by index. `length` is the
    place of the count."""

    field: Field
    places: dict[int, int]
    plans: dict[int, dict]
    length: int | None


def message_types(descriptor_set: bytes) -> dict[str, dict[int, Field]]:
    """{full name of the message: {field number: Field}} of a serialised FileDescriptorSet. Raises ValueError
    for other bytes."""
    types: dict[str, dict[int, Field]] = {}
    try:
        for file in _parts(descriptor_set).get(1, []):
            parts = _parts(file)
            for message in parts.get(4, []):
                _add_type(message, _text(parts, 2), _text(parts, 12) == "proto3", types)
    except (
        UnreadableMessage,
        UnicodeDecodeError,
        TypeError,
        AttributeError,
        KeyError,
        RecursionError,
    ) as error:
        raise ValueError(f"the schema is no FileDescriptorSet ({error})") from None
    return types


def _add_type(message: bytes, scope: str, proto3: bool, types: dict[str, dict[int, Field]]) -> None:
    parts = _parts(message)
    name = f"{scope}.{_text(parts, 1)}".lstrip(".")
    types[name] = {}
    for field in parts.get(2, []):
        inner = _parts(field)
        kind, repeated = inner.get(5, [0])[0], inner.get(4, [1])[0] == 3
        presence = not proto3 or 9 in inner or 17 in inner  # oneof_index, proto3_optional
        types[name][inner[3][0]] = Field(
            _text(inner, 1), kind, _text(inner, 6).lstrip("."), repeated, presence
        )
    for nested in parts.get(3, []):
        _add_type(nested, name, proto3, types)


def _parts(data: bytes) -> dict[int, list]:
    parts: dict[int, list] = {}
    for number, _, value in _wire(data):
        parts.setdefault(number, []).append(value)
    return parts


def _text(parts: dict[int, list], number: int) -> str:
    return parts[number][0].decode() if number in parts else ""


# ---- the wire


def _varint(data: bytes, pos: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if pos >= len(data) or shift > 63:
            raise UnreadableMessage("a number that does not end")
        byte = data[pos]
        pos += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, pos
        shift += 7


def _wire(data: bytes):
    """(field number, wire type, value) in the order of the wire. The value is an int for a varint, else the
    bytes."""
    pos, end = 0, len(data)
    while pos < end:
        key, pos = _varint(data, pos)
        kind = key & 7
        if kind == VARINT:
            value, pos = _varint(data, pos)
        else:
            if kind == BYTES:
                length, pos = _varint(data, pos)
            else:
                length = {FIXED64: 8, FIXED32: 4}.get(kind, -1)
            if length < 0 or pos + length > end:
                raise UnreadableMessage(f"a field of wire type {kind} that does not fit into {end} bytes")
            value = data[pos : pos + length]
            pos += length
        yield key >> 3, kind, value


def _number(kind: int, value: int | bytes) -> float:
    wire, how = _NUMBERS[kind]
    if wire != VARINT:
        if not isinstance(value, bytes) or len(value) != struct.calcsize(how):
            raise UnreadableMessage("a number of another size than its schema says")
        return float(struct.unpack(how, value)[0])
    if not isinstance(value, int):
        raise UnreadableMessage("bytes where the schema says a number")
    if how == "signed":
        return float(value - (1 << 64) if value >> 63 else value)
    return float((value >> 1) ^ -(value & 1) if how == "zigzag" else value)


def _packed(kind: int, data: bytes) -> list[float]:
    wire, how = _NUMBERS[kind]
    if wire != VARINT:
        if len(data) % struct.calcsize(how):
            raise UnreadableMessage("a packed list of another size than its schema says")
        return [float(value) for (value,) in struct.iter_unpack(how, data)]
    values, pos = [], 0
    while pos < len(data):
        value, pos = _varint(data, pos)
        values.append(_number(kind, value))
    return values


# ---- which numbers a message has


def fields(types: dict[str, dict[int, Field]], name: str, sample: bytes | None) -> list[str]:
    """Paths of the numbers. Of a repeated field they are those of the message `sample`, up to
    LONGEST_LISTED."""
    names, repeated = _plain_fields(types, _defined(types, name), "", 0, [LARGEST_LAYOUT])
    if sample is not None and repeated:
        try:
            lengths = decoder(types, name, [f"{path}[#]" for path, _ in repeated])([sample])[0]
        except UnreadableMessage:
            return names
        for (path, inner), length in zip(repeated, lengths, strict=True):
            names += [
                f"{path}[{i}]{part}"
                for i in range(min(int(np.nan_to_num(length)), LONGEST_LISTED))
                for part in inner
            ]
    return names


def _defined(types: dict, name: str) -> str:
    if name not in types:
        raise ValueError(
            f"the schema does not define its own message {name}; it defines {', '.join(sorted(types)[:5])}"
        )
    return name


def _plain_fields(
    types: dict, name: str, prefix: str, depth: int, room: list[int]
) -> tuple[list[str], list[tuple[str, list[str]]]]:
    names, repeated = [], []
    for field in types.get(name, {}).values() if depth < _DEEPEST else []:
        path = f"{prefix}{field.name}"
        room[0] -= 1
        if room[0] < 0:
            raise ValueError(f"the schema of {name} has more than {LARGEST_LAYOUT} parts")
        if field.type in _NUMBERS:
            if field.repeated:
                repeated.append((path, [""]))
            else:
                names.append(path)
        elif field.type == _MESSAGE:
            below = "" if field.repeated else f"{path}."
            inner, deeper = _plain_fields(types, field.of, below, depth + 1, room)
            if field.repeated:
                repeated.append((path, [f".{part}" for part in inner]))
            else:
                names += inner
                repeated += deeper
    return names, repeated


# ---- decoding


def decoder(
    types: dict[str, dict[int, Field]], name: str, names: Sequence[str]
) -> Callable[[list[bytes]], np.ndarray]:
    """A function from n messages to their numbers (n, len(names)), NaN for an absent field with presence.

    It raises UnreadableMessage.
    """
    plan = _plan(types, _defined(types, name), {path: place for place, path in enumerate(names)})
    count = len(names)

    def decode(messages: list[bytes]) -> np.ndarray:
        rows = []
        for message in messages:
            row = [np.nan] * count
            _walk(message, plan, row)
            rows.append(row)
        return np.array(rows, float).reshape(len(messages), count)

    return decode


def _plan(types: dict, name: str, wanted: dict[str, int]) -> dict[int, _Node]:
    """{field number: _Node} for the wanted paths {path below this message: place}."""
    numbers = {field.name: number for number, field in types.get(name, {}).items()}
    plan: dict[int, _Node] = {}
    below: dict[tuple[int, int], dict[str, int]] = {}
    for path, place in wanted.items():
        match = re.match(r"(\w+)(?:\[(\d+|#)\])?(?:\.(.+))?$", path)
        if not match or match[1] not in numbers:
            raise ValueError(f"no numeric field {path}")
        number = numbers[match[1]]
        field = types[name][number]
        if (match[2] is not None) != field.repeated:
            raise ValueError(f"no numeric field {path}")
        node = plan.setdefault(number, _Node(field, {}, {}, None))
        if match[2] == "#":
            plan[number] = node._replace(length=place)
        elif match[3] and field.type == _MESSAGE:
            below.setdefault((number, int(match[2] or 0)), {})[match[3]] = place
        elif not match[3] and field.type in _NUMBERS:
            node.places[int(match[2] or 0)] = place
        else:
            raise ValueError(f"no numeric field {path}")
    for (number, index), inner in below.items():
        plan[number].plans[index] = _plan(types, plan[number].field.of, inner)
    return plan


def _walk(data: bytes, plan: dict[int, _Node], row: list[float]) -> None:
    """Fills the places of `row` for which the message `data` has values. The last value of a single field
    counts, as the format says."""
    for node in plan.values():
        if not node.field.presence and not node.field.repeated:
            for place in node.places.values():
                row[place] = 0.0
        if node.length is not None:
            row[node.length] = 0.0
    counts = dict.fromkeys(plan, 0)
    for number, wire, value in _wire(data):
        node = plan.get(number)
        if node is None:
            continue
        numbers = _values(wire, value, node, counts[number], row)
        for i, value_i in enumerate(numbers, counts[number]):
            if i in node.places:
                row[node.places[i]] = value_i
        if node.field.repeated:
            counts[number] += len(numbers)
        if node.length is not None:
            row[node.length] = counts[number]


def _values(wire: int, value: int | bytes, node: _Node, index: int, row: list[float]) -> Sequence[float]:
    """The numbers of one field on the wire. A message is walked and counts as one."""
    if node.field.type == _MESSAGE:
        if wire != BYTES:
            raise UnreadableMessage("a number where the schema says a message")
        if index in node.plans:
            _walk(value, node.plans[index], row)
        return [0.0]
    if node.field.type not in _NUMBERS:
        return [0.0]
    if wire == BYTES and node.field.repeated:
        return _packed(node.field.type, value)
    return [_number(node.field.type, value)]
