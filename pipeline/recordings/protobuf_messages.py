"""Numbers of protobuf messages. The FileDescriptorSet of the schema makes the types, the official package
decodes, and the wanted fields are taken out."""

import graphlib
import operator
import re
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from google.protobuf import (
    any_pb2,
    descriptor_pb2,
    descriptor_pool,
    duration_pb2,
    empty_pb2,
    message_factory,
    struct_pb2,
    timestamp_pb2,
    wrappers_pb2,
)
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError, Message

from pipeline.recordings.ros_messages import LONGEST_LISTED, UnreadableMessage

# what every compiler of protobuf brings along, and some recorders leave out
_WELL_KNOWN = {
    module.DESCRIPTOR.name: module.DESCRIPTOR
    for module in (any_pb2, duration_pb2, empty_pb2, struct_pb2, timestamp_pb2, wrappers_pb2)
}
_FILES, _FILE = (
    message_factory.GetMessageClass(descriptor_pb2.DESCRIPTOR.message_types_by_name[name])
    for name in ("FileDescriptorSet", "FileDescriptorProto")
)
# a message that holds itself has no end, and one with a few levels of many messages nearly none
_DEEPEST, _MOST_FIELDS = 6, 20_000

Types = dict[str, Descriptor]
Fill = Callable[[Message, list[float]], None]


def message_types(descriptor_set: bytes) -> Types:
    """{full name of the message: its type} of a serialised FileDescriptorSet.

    Raises ValueError for other bytes, and for a set without a file that it imports.
    """
    try:
        files = {file.name: file for file in _FILES.FromString(bytes(descriptor_set)).file}
        order = graphlib.TopologicalSorter({name: list(file.dependency) for name, file in files.items()})
        pool = descriptor_pool.DescriptorPool()  # ty: ignore[possibly-missing-implicit-call]
        for name in order.static_order():
            file = files.get(name, _FILE())
            if name not in files and name in _WELL_KNOWN:
                _WELL_KNOWN[name].CopyToProto(file)
            elif name not in files:
                raise ValueError(f"the schema imports {name[:80]} and does not hold it")
            pool.Add(file)
    except (DecodeError, TypeError, graphlib.CycleError) as error:
        raise ValueError(f"the schema is no FileDescriptorSet ({error})") from None
    types: Types = {}
    waiting = [
        message for name in files for message in pool.FindFileByName(name).message_types_by_name.values()
    ]
    while waiting:
        message = waiting.pop()
        types[message.full_name] = message
        waiting += message.nested_types
    return types


def _defined(types: Types, name: str) -> Descriptor:
    if name not in types:
        raise ValueError(
            f"the schema does not define its own message {name}; it defines {', '.join(sorted(types)[:5])}"
        )
    return types[name]


def message_reader(types: Types, name: str) -> Callable[[bytes | memoryview], Message]:
    """A function from bytes to the message of that name. It raises UnreadableMessage."""
    made = message_factory.GetMessageClass(_defined(types, name))

    def read(data: bytes | memoryview) -> Message:
        try:
            return made.FromString(data)
        except DecodeError as error:
            raise UnreadableMessage(f"a message that is not of its type ({error})") from None

    return read


# ---- which numbers a message has


def _is_number(field: FieldDescriptor) -> bool:
    texts = (FieldDescriptor.CPPTYPE_MESSAGE, FieldDescriptor.CPPTYPE_STRING)
    return field.cpp_type not in texts


def _is_message(field: FieldDescriptor) -> bool:
    """Whether a field holds a message. A map holds its entries by key and not by place."""
    return field.message_type is not None and not field.message_type.GetOptions().map_entry


def fields(types: Types, name: str, sample: bytes | None) -> list[str]:
    """Paths of the numbers. Of a repeated field they are those of the message `sample`, up to
    LONGEST_LISTED. Raises ValueError for a type with more than can be listed."""
    names: list[str] = []
    lists: dict[str, list[str]] = {}
    for visited, (path, field) in enumerate(_leaves(_defined(types, name), "", 0)):
        if visited == _MOST_FIELDS:
            raise ValueError(f"the message {name} has more than {_MOST_FIELDS} fields; name the wanted ones")
        single, is_list, part = path.partition("[]")
        if field is not None and not is_list:
            names.append(path)
        elif field is not None:
            lists.setdefault(single, []).append(part)
    if sample is None or not lists:
        return names
    try:
        lengths = decoder(types, name, [f"{path}[#]" for path in lists])([sample])[0]
    except UnreadableMessage:
        return names
    for (path, inner), length in zip(lists.items(), lengths, strict=True):
        count = min(int(np.nan_to_num(length)), LONGEST_LISTED)
        names += [f"{path}[{i}]{part}" for i in range(count) for part in inner]
    return names


def _leaves(message: Descriptor, prefix: str, depth: int) -> Iterator[tuple[str, FieldDescriptor | None]]:
    """Paths of the numbers, "zones[].celsius" in repeated messages, without what a list holds in lists. A
    message is a path without a field."""
    for field in message.fields:
        path = f"{prefix}{field.name}{'[]' if field.is_repeated else ''}"
        if field.is_repeated and "[]" in prefix:
            continue
        if _is_number(field):
            yield path, field
        elif _is_message(field) and depth + 1 < _DEEPEST:
            yield path, None
            yield from _leaves(field.message_type, f"{path}.", depth + 1)


# ---- decoding


def decoder(types: Types, name: str, names: Sequence[str]) -> Callable[[list[bytes]], np.ndarray]:
    """A function from n messages to their numbers (n, len(names)), NaN for an absent field with presence.

    "zones[#]" is the length of a list. The function raises UnreadableMessage.
    """
    message = _defined(types, name)
    fill = _filler(message, {path: place for place, path in enumerate(names)})
    read, count = message_reader(types, name), len(names)
    if names and all(_is_plain(message.fields_by_name.get(path)) for path in names):
        values = operator.attrgetter(*names)
        return lambda messages: np.array([values(read(data)) for data in messages], float).reshape(-1, count)

    def decode(messages: list[bytes]) -> np.ndarray:
        rows = []
        for message in messages:
            row = [np.nan] * count
            fill(read(message), row)
            rows.append(row)
        return np.array(rows, float).reshape(len(messages), count)

    return decode


def _is_plain(field: FieldDescriptor | None) -> bool:
    """Whether a field is a number that every message has."""
    return field is not None and _is_number(field) and not field.is_repeated and not field.has_presence


def _filler(message: Descriptor, wanted: dict[str, int]) -> Fill:
    """A function that puts the numbers of the paths {path below this message: place} into their places."""
    plain, parts = [], []
    below: dict[tuple[str, str | None], dict[str, int]] = {}
    for path, place in wanted.items():
        match = re.match(r"(\w+)(?:\[(\d+|#)\])?(?:\.(.+))?$", path)
        field = message.fields_by_name.get(match[1]) if match else None
        if match is None or field is None or (match[2] is not None) != field.is_repeated:
            raise ValueError(f"no numeric field {path}")
        if match[2] == "#":
            parts.append(_length(field.name, place))
        elif match[3] and _is_message(field):
            below.setdefault((field.name, match[2]), {})[match[3]] = place
        elif match[3] or not _is_number(field):
            raise ValueError(f"no numeric field {path}")
        elif field.is_repeated:
            parts.append(_element(field.name, int(match[2]), place))
        elif field.has_presence:
            parts.append(_optional(field.name, place))
        else:
            plain.append((field.name, place))
    for (name, index), inner in below.items():
        deeper = _filler(message.fields_by_name[name].message_type, inner)
        parts.append(_inside(name, deeper) if index is None else _inside_element(name, int(index), deeper))

    def fill(values: Message, row: list[float]) -> None:
        for name, place in plain:
            row[place] = getattr(values, name)
        for part in parts:
            part(values, row)

    return fill


def _length(name: str, place: int) -> Fill:
    def fill(values: Message, row: list[float]) -> None:
        row[place] = len(getattr(values, name))

    return fill


def _element(name: str, index: int, place: int) -> Fill:
    def fill(values: Message, row: list[float]) -> None:
        elements = getattr(values, name)
        if index < len(elements):
            row[place] = elements[index]

    return fill


def _optional(name: str, place: int) -> Fill:
    def fill(values: Message, row: list[float]) -> None:
        if values.HasField(name):
            row[place] = getattr(values, name)

    return fill


def _inside(name: str, deeper: Fill) -> Fill:
    def fill(values: Message, row: list[float]) -> None:
        if values.HasField(name):
            deeper(getattr(values, name), row)

    return fill


def _inside_element(name: str, index: int, deeper: Fill) -> Fill:
    def fill(values: Message, row: list[float]) -> None:
        elements = getattr(values, name)
        if index < len(elements):
            deeper(elements[index], row)

    return fill
