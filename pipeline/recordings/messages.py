"""Decodes the numbers in the messages of an MCAP channel: ROS 2 CDR, ROS 1, protobuf or JSON. A single
message may be compressed.

A ROS message definition is converted once to a short program of struct formats, which is run for each
message. It takes a sixth of the time of the mcap-ros2-support package. ROS 2 writes CDR (OMG DDSI-RTPS 10.2,
"classic CDR", and XCDR2 for final types): a header of four bytes, then numbers aligned to their size. ROS 1
has no header and no alignment. Sequences and text begin with their length (uint32). Text is skipped. Fields
after a wide text cannot be read. Protobuf is decoded by the official package, with types made from the
schema's FileDescriptorSet.
"""

import contextlib
import graphlib
import itertools
import json
import operator
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import orjson
import zstandard
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

LARGEST_MESSAGE = 1 << 28
# the longest schemas in use have about 100 kB
LARGEST_SCHEMA = 4 << 20
ENCODINGS = "cdr with ros2msg, ros1 with ros1msg, protobuf, and json"
_ZSTD, _LZ4 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"
_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")

LARGEST_LAYOUT = 20_000
LONGEST_LISTED = 64

Decode = Callable[[list[bytes]], np.ndarray]


class UnreadableMessage(ValueError):
    """A message that does not fit its schema."""


class Channel(NamedTuple):
    """A channel of the file, with its schema and the writer's metadata."""

    id: int
    topic: str
    encoding: str
    metadata: dict[str, str]
    schema_name: str
    schema_encoding: str
    schema: bytes


def fields(channel: Channel, samples: Sequence[bytes]) -> list[str]:
    """Returns the paths of the numbers in the channel's messages, from its schema and a few of its messages.

    Raises ValueError with the reason if the messages cannot be read.
    """
    kind = _kind(channel)
    samples = [plain(sample) for sample in samples]
    if kind == "json":
        return _json_fields(channel, samples)
    first = samples[0] if samples else None
    if kind == "protobuf":
        return protobuf_fields(message_types(channel.schema), channel.schema_name, first)
    version = 2 if kind == "cdr" else 1
    return ros_fields(_layout(channel, version), first, version=version)


def decoder(channel: Channel, names: Sequence[str]) -> Decode:
    """Returns a function from n messages to their numbers (n, len(names)), NaN if a message lacks a number.

    The function raises UnreadableMessage if a message does not fit its channel, and ValueError if a wanted
    number is text.
    """
    kind = _kind(channel)
    if kind == "json":
        return _json_decoder(names)
    if kind == "protobuf":
        return protobuf_decoder(message_types(channel.schema), channel.schema_name, names)
    version = 2 if kind == "cdr" else 1
    return ros_decoder(_layout(channel, version), names, version=version)


def _kind(channel: Channel) -> str:
    pairs = {("cdr", "ros2msg"): "cdr", ("ros1", "ros1msg"): "ros1", ("protobuf", "protobuf"): "protobuf"}
    kind = pairs.get((channel.encoding, channel.schema_encoding))
    if len(channel.schema) > LARGEST_SCHEMA:
        raise ValueError(
            f"its schema {channel.schema_name[:60]} has {len(channel.schema)} bytes "
            f"where {LARGEST_SCHEMA} are read"
        )
    if channel.encoding == "json":
        return "json"
    if kind is None:
        schema = f"schema encoding {channel.schema_encoding!r}" if channel.schema_encoding else "no schema"
        raise ValueError(f"message encoding {channel.encoding!r} with {schema} is not read; {ENCODINGS} are")
    return kind


# ---- compression of single messages


def plain(message: bytes) -> bytes:
    """Returns the message, decompressed if it is a zstd or lz4 frame (rosbag2 writes these in compression
    mode `message`)."""
    if message[:4] not in (_ZSTD, _LZ4):
        return message
    return decompress("zstd" if message[:4] == _ZSTD else "lz4", message, None)


def decompress(method: str, data: bytes, size: int | None) -> bytes:
    """Returns the bytes of a zstd or lz4 frame; `size` is their count, or None if not known. Raises
    UnreadableMessage if the frame is damaged.

    The size that a zstd frame declares is checked first, because after one flipped bit it may declare
    terabytes.
    """
    room = LARGEST_MESSAGE if size is None else size
    try:
        if method == "zstd":
            declared = zstandard.frame_content_size(data)
            if declared > room:
                raise UnreadableMessage(f"data that say they unpack to {declared} bytes, more than {room}")
            limit = 0 if declared >= 0 else room
            unpacked = zstandard.ZstdDecompressor().decompress(data, max_output_size=limit)
        elif method == "lz4":
            unpacked = lz4.frame.LZ4FrameDecompressor().decompress(data, room + 1)
        else:
            raise UnreadableMessage(f"the compression {method!r} is not known; zstd and lz4 are")
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError, OverflowError) as error:
        reason = (str(error) or "too large").splitlines()[0]
        raise UnreadableMessage(f"{method} data that cannot be unpacked ({reason})") from None
    if len(unpacked) > room or size not in (None, len(unpacked)):
        raise UnreadableMessage(f"{method} data that unpack to {len(unpacked)} bytes, not {size}")
    return unpacked


# ---- JSON


def _document(message: bytes):
    """Returns the message's value. orjson is four times as fast as json, but only json reads NaN and
    Infinity. Raises UnreadableMessage if the message is not JSON."""
    try:
        return orjson.loads(message)
    except orjson.JSONDecodeError:
        try:
            return json.loads(message)
        except (ValueError, RecursionError) as error:
            raise UnreadableMessage(f"a message that is no JSON ({error})") from None


def _json_fields(channel: Channel, samples: Sequence[bytes]) -> list[str]:
    """Returns the paths of the numbers that a JSON schema declares, and of the numbers in the messages."""
    names: dict[str, None] = {}
    if channel.schema_encoding == "jsonschema" and channel.schema:
        with contextlib.suppress(UnreadableMessage):  # the messages tell
            names |= dict.fromkeys(_schema_paths(_document(channel.schema), "", 0))
    for sample in samples:
        names |= dict.fromkeys(_paths(_document(sample)))
        if len(names) > LARGEST_LAYOUT:
            raise ValueError(f"its messages have {len(names)} numbers where {LARGEST_LAYOUT} are read")
    return list(names)


def _schema_paths(schema, prefix: str, depth: int) -> Iterator[str]:
    properties = schema.get("properties") if isinstance(schema, dict) else None
    if not isinstance(properties, dict) or depth > 6:
        return
    for name, inner in properties.items():
        kind = inner.get("type") if isinstance(inner, dict) else None
        if kind == "object":
            yield from _schema_paths(inner, f"{prefix}{name}.", depth + 1)
        elif kind == "boolean" or {"number", "integer"} & set(
            map(str, kind if isinstance(kind, list) else [kind])
        ):
            yield prefix + name


def _paths(value, prefix: str = "", depth: int = 0) -> Iterator[str]:
    """Yields the paths of the numbers in a value. Null counts too, because another message may have a number
    there."""
    if isinstance(value, int | float) or (value is None and prefix):
        yield prefix
    elif isinstance(value, dict) and depth < 8:
        for name, inner in value.items():
            yield from _paths(inner, f"{prefix}.{name}" if prefix else name, depth + 1)
    elif isinstance(value, list) and depth < 8:
        for i, inner in enumerate(value[:LONGEST_LISTED]):
            yield from _paths(inner, f"{prefix}[{i}]", depth + 1)


def _json_decoder(names: Sequence[str]) -> Decode:
    steps = [tuple(int(index) if index else key for key, index in _STEP.findall(name)) for name in names]
    at_top = operator.itemgetter(*names)

    def decode(messages: list[bytes]) -> np.ndarray:
        documents = [_document(message) for message in messages]
        shape = len(messages), len(names)
        with contextlib.suppress(KeyError, TypeError, IndexError, ValueError):
            numbers = np.array([at_top(document) for document in documents]).reshape(shape)
            if numbers.dtype.kind in "fiub":
                return numbers.astype(float, copy=False)
        # other kinds are text, null, or a mixture; they are read one by one
        paths = list(zip(names, steps, strict=True))
        return np.array([[_value(document, *path) for path in paths] for document in documents], float)

    return decode


def _value(document, name: str, steps: tuple) -> float:
    value = document
    try:
        for step in steps:
            value = value[step]
    except (KeyError, TypeError, IndexError):
        value = _by_prefix(document, name)
    if value is not None and not isinstance(value, int | float):
        raise ValueError(
            f"{name} should be a number but is {json.dumps(value)[:60]}; map another field, or write numbers"
        )
    try:
        return np.nan if value is None else float(value)
    except OverflowError:
        return np.inf


def _by_prefix(document, name: str):
    """Returns the value of a path if keys themselves contain dots, such as {"heater.1": 30}; None if it does
    not exist."""
    if not isinstance(document, dict):
        return None
    if name in document:
        return document[name]
    inner = (
        _by_prefix(document[name[:i]], name[i + 1 :])
        for i, letter in enumerate(name)
        if letter == "." and name[:i] in document
    )
    return next((value for value in inner if value is not None), None)


# ---- ROS

ROS2_NUMBERS = {
    "bool": "?", "byte": "B", "char": "B", "octet": "B", "int8": "b", "uint8": "B", "int16": "h",
    "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
ROS1_NUMBERS = {**ROS2_NUMBERS, "byte": "b"}
ROS1_NUMBERS.pop("octet")
# types that many schema texts leave out, because every reader knows them
KNOWN = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "ros1/time": "uint32 secs\nuint32 nsecs",
    "ros1/duration": "int32 secs\nint32 nsecs",
}
# most numbers of one array; no message is that long
LARGEST_ARRAY = 1 << 30
_FIELD = re.compile(r"^([A-Za-z]\w*(?:/\w+)*)(?:<=\d+)?\s*(\[(?:<=)?(\d*)\])?\s+([A-Za-z]\w*)\s*(=?)")
# representation -> byte order, largest alignment; ROS does not write lists of parameters (0x0002, 0x0003 and
# others)
_REPRESENTATIONS = {
    b"\x00\x00": (">", 8),
    b"\x00\x01": ("<", 8),
    b"\x00\x06": (">", 4),
    b"\x00\x07": ("<", 4),
}
# from this many messages on, a common format is worth making
FEWEST_ALIKE = 4
_LENGTH = {order: struct.Struct(order + "I") for order in "<>"}


class Item(NamedTuple):
    """A part of the layout: `count` numbers of one `format`, text, or a sequence of `items` (a sequence of
    numbers has one item of count 1). The paths of a sequence's items contain [] for the index."""

    kind: str
    path: str
    format: str = ""
    count: int = 1
    array: bool = False
    items: tuple = ()


def _layout(channel: Channel, version: int) -> list[Item]:
    try:
        return ros_layout(channel.schema.decode(), channel.schema_name, version=version)
    except UnicodeDecodeError:
        raise ValueError(f"the schema {channel.schema_name} is no text") from None


def ros_layout(definition: str, name: str, *, version: int) -> list[Item]:
    """Returns the message's numbers, texts and sequences in the order in which they are transmitted.
    `version`: 1 or 2.

    Raises ValueError if the definition cannot be read.
    """
    if re.search(r"^---", definition, re.MULTILINE):
        raise ValueError(f"the schema of {name} is a service's (---), not a message's")
    return list(_expand(_plain(name), "", _types(definition, name), version, [LARGEST_LAYOUT]))


def _types(definition: str, name: str) -> dict[str, list[tuple[str, str, str | None]]]:
    """Returns {type: [(field, its type, length)]}. The length is None for a single value and "" for a
    sequence without a fixed length."""
    parts = re.split(r"^={3,}\s*$", definition, flags=re.MULTILINE)
    texts = dict(KNOWN) | {_plain(name): parts[0]}
    for part in parts[1:]:
        head, _, body = part.strip().partition("\n")
        if not head.startswith("MSG:"):
            raise ValueError(f"the schema of {name} should have MSG: behind ==== but has {head[:40]!r}")
        texts[_plain(head[4:].strip())] = body
    return {kind: _fields(text, kind) for kind, text in texts.items()}


def _plain(name: str) -> str:
    return name.replace("/msg/", "/")


def _fields(text: str, kind: str) -> list[tuple[str, str, str | None]]:
    fields = []
    for line in text.splitlines():
        line = line.split("#")[0].strip()
        if not line:
            continue
        match = _FIELD.match(line)
        if not match:
            raise ValueError(f"the schema of {kind} has the line {line[:60]!r}, which is no field")
        if not match[5]:  # NAME=value is a constant and not on the wire
            fields.append((match[4], match[1], match[3] if match[2] else None))
    return fields


def _resolve(kind: str, parent: str, types: dict) -> str:
    candidates = [_plain(kind), f"{parent.rpartition('/')[0]}/{kind}", f"std_msgs/{kind}", f"ros1/{kind}"]
    candidates += [name for name in types if name.endswith(f"/{kind}")]
    for candidate in candidates:
        if candidate in types:
            return candidate
    raise ValueError(f"the schema of {parent} uses {kind} but does not define it")


def _expand(kind: str, prefix: str, types: dict, version: int, room: list[int]) -> list[Item]:
    """Returns the items of a type, in the order in which they are transmitted. `room`: how many more items
    are allowed."""
    items: list[Item] = []
    numbers = ROS2_NUMBERS if version == 2 else ROS1_NUMBERS
    for field, part_kind, length in types[kind]:
        path = f"{prefix}.{field}" if prefix else field
        if length and (len(length) > 12 or int(length) > LARGEST_ARRAY):
            raise ValueError(
                f"the schema of {kind} has {length[:20]} elements in {field}, more than any message can hold"
            )
        count = int(length or 1)
        if length == "":
            elements = _element(part_kind, f"{path}[]", kind, types, version, room)
            items.append(Item("sequence", path, items=tuple(elements)))
        elif part_kind in numbers:
            items.append(Item("numbers", path, numbers[part_kind], count, length is not None))
        else:
            for i in range(count):
                _take_room(kind, room)
                items += _element(part_kind, f"{path}[{i}]" if length else path, kind, types, version, room)
        _take_room(kind, room)
    if not items and version == 2:
        items.append(Item("numbers", prefix + "._", "B"))  # ROS 2 gives a message without fields one byte
    return items


def _take_room(kind: str, room: list[int]) -> None:
    room[0] -= 1
    if room[0] < 0:
        raise ValueError(f"the schema of {kind} has more than {LARGEST_LAYOUT} parts")


def _element(element: str, path: str, parent: str, types: dict, version: int, room: list[int]) -> list[Item]:
    numbers = ROS2_NUMBERS if version == 2 else ROS1_NUMBERS
    if element in numbers:
        return [Item("numbers", path, numbers[element])]
    if element in ("string", "wstring"):
        return [Item(element, path)]
    if path.count(".") > 30:
        raise ValueError(f"the schema of {parent} contains itself in {path}")
    return _expand(_resolve(element, parent, types), path, types, version, room)


# ---- which numbers a message has


def ros_fields(items: Sequence[Item], sample: bytes | None, *, version: int) -> list[str]:
    """Returns the paths of the numbers. For a sequence they are those in the message `sample`, up to
    LONGEST_LISTED."""
    names: list[str] = []
    lists: dict[str, list[str]] = {}
    for item in _readable(items):
        if item.kind == "sequence" and all(part.kind == "numbers" for part in item.items):
            start = len(item.path) + len("[]")
            lists[item.path] = [part.path[start:] for part in item.items if not part.array]
        elif item.kind == "numbers" and item.array:
            names += [f"{item.path}[{i}]" for i in range(min(item.count, LONGEST_LISTED))]
        elif item.kind == "numbers" and not item.path.endswith("._"):
            names.append(item.path)
    return names + _elements(lists, sample, lambda paths: ros_decoder(items, paths, version=version))


def _elements(
    lists: dict[str, list[str]], sample: bytes | None, make_decoder: Callable[[list[str]], Decode]
) -> list[str]:
    """Returns the paths of the numbers in a message's lists, up to LONGEST_LISTED elements each. `lists`:
    {path of the list: [path below each element]}."""
    if sample is None or not lists:
        return []
    try:
        lengths = make_decoder([f"{path}[#]" for path in lists])([sample])[0]
    except UnreadableMessage:
        return []
    return [
        f"{path}[{i}]{part}"
        for (path, parts), length in zip(lists.items(), np.nan_to_num(lengths), strict=True)
        for i in range(min(int(length), LONGEST_LISTED))
        for part in parts
    ]


def _readable(items: Sequence[Item]) -> list[Item]:
    """Returns the items up to the first wide text, because writers do not agree on the length of its
    characters."""
    for i, item in enumerate(items):
        if item.kind == "wstring" or (
            item.kind == "sequence" and len(_readable(item.items)) < len(item.items)
        ):
            return list(items[:i])
    return list(items)


# ---- programs


# the names of the numbers that a step reads, and a function (message, position, numbers so far) -> position
# after the step
Step = tuple[list[str], Callable[[bytes, int, list[float]], int]]


def _row(items: Sequence[Item], wanted: set[str], order: str, alignment: int) -> Step:
    """Returns the step that reads consecutive numbers of fixed size. `layouts[phase]` unpacks the wanted
    numbers of a row that begins at this phase of the alignment."""
    layouts = [struct.Struct(order + _row_format(items, wanted, phase, alignment)) for phase in range(8)]

    def read(data: bytes, pos: int, values: list[float]) -> int:
        layout = layouts[pos & 7]
        values += layout.unpack_from(data, pos)
        return pos + layout.size

    return [name for item in items for name in _names(item, wanted)], read


def _names(item: Item, wanted: set[str]) -> list[str]:
    """Returns the paths of an item's wanted numbers in the order in which they are transmitted. The other
    elements of a long array are not listed."""
    if not item.array:
        return [item.path] if item.path in wanted else []
    return [f"{item.path}[{i}]" for i in _indices(item, wanted)]


def _indices(item: Item, wanted: set[str]) -> list[int]:
    if item.count <= LONGEST_LISTED:
        return [i for i in range(item.count) if f"{item.path}[{i}]" in wanted]
    place = re.compile(re.escape(item.path) + r"\[(\d{1,12})\]")
    return sorted(i for name in wanted if (at := place.fullmatch(name)) and (i := int(at[1])) < item.count)


def _row_format(items: Sequence[Item], wanted: set[str], phase: int, alignment: int) -> str:
    parts, pos = [], phase
    for item in items:
        size = struct.calcsize("=" + item.format)
        pad = -pos % min(size, alignment) if item.count else 0
        parts.append(f"{pad}x")
        if not item.array:
            parts.append(item.format if item.path in wanted else f"{size}x")
        else:
            following = 0
            for i in _indices(item, wanted):
                parts += [f"{size * (i - following)}x", item.format]
                following = i + 1
            parts.append(f"{size * (item.count - following)}x")
        pos += pad + size * item.count
    return "".join(part for part in parts if part != "0x")


def _text(order: str, alignment: int) -> Step:
    unpack, alignment = _LENGTH[order].unpack_from, min(4, alignment)

    def read(data: bytes, pos: int, values: list[float]) -> int:
        pos += -pos % alignment
        return pos + 4 + unpack(data, pos)[0]

    return [], read


def _sequence(item: Item, wanted: set[str], order: str, alignment: int) -> Step:
    """Returns the step that reads a length and that many elements. Elements that are wanted by index are read
    (NaN if there are fewer), the others are skipped. "[#]" is the length itself."""
    unpack, begin = _LENGTH[order].unpack_from, min(4, alignment)
    place = re.compile(re.escape(item.path) + r"\[(\d+)\]")
    indices = sorted({int(match[1]) for name in wanted if (match := place.match(name))})
    skip = _program(item.items, set(), order, alignment)
    elements = {i: _program(_at(item.items, i), wanted, order, alignment) for i in indices}
    widths = {i: sum(len(names) for names, _ in steps) for i, steps in elements.items()}
    has_length = f"{item.path}[#]" in wanted
    names = [f"{item.path}[#]"] * has_length + [
        name for steps in elements.values() for step_names, _ in steps for name in step_names
    ]
    alone = len(item.items) == 1 and item.items[0].kind == "numbers" and not item.items[0].array
    number = struct.Struct(order + item.items[0].format) if alone else None

    def read(data: bytes, pos: int, values: list[float]) -> int:
        pos += -pos % begin
        length = unpack(data, pos)[0]
        pos += 4
        if length > len(data):
            raise UnreadableMessage(f"a sequence of {length} elements in {len(data)} bytes")
        if has_length:
            values.append(length)
        if number:
            size = number.size
            pos += -pos % min(size, alignment) if length else 0
            values += [
                number.unpack_from(data, pos + i * size)[0] if i < length else np.nan for i in elements
            ]
            return pos + length * size
        for i in range(length):
            for _, read_step in elements.get(i, skip):
                pos = read_step(data, pos, values)
        for i, width in widths.items():
            if i >= length:
                values += [np.nan] * width
        return pos

    return names, read


def _at(items: Sequence[Item], i: int) -> list[Item]:
    """Returns the items of a sequence with index i in their paths."""
    return [
        part._replace(path=part.path.replace("[]", f"[{i}]", 1), items=tuple(_at(part.items, i)))
        for part in items
    ]


def _program(items: Sequence[Item], wanted: set[str], order: str, alignment: int) -> list[Step]:
    steps = []
    for is_row, run in itertools.groupby(items, key=lambda item: item.kind == "numbers"):
        if is_row:
            steps.append(_row(list(run), wanted, order, alignment))
        else:
            steps += [
                _text(order, alignment)
                if item.kind == "string"
                else _sequence(item, wanted, order, alignment)
                for item in run
            ]
    return steps


def ros_decoder(
    items: Sequence[Item], names: Sequence[str], *, version: int
) -> Callable[[list[bytes]], np.ndarray]:
    """Returns a function from n messages to their numbers (n, len(names)). The function raises
    UnreadableMessage if a message does not fit the layout."""
    readable, wanted = _readable(items), set(names)
    exact = len(readable) == len(items)
    has_sequence = any(item.kind == "sequence" for item in readable)
    representations = _REPRESENTATIONS if version == 2 else {b"": ("<", 1)}
    # alignment counts from the end of the header of four bytes, and up to `padding` bytes may follow
    header, padding = (4, 7) if version == 2 else (0, 0)
    programs = {code: _program(readable, wanted, *how) for code, how in representations.items()}
    columns = _order(next(iter(programs.values())), names)

    def decode(messages: list[bytes]) -> np.ndarray:
        codes = {message[: header // 2] for message in messages}
        if len(codes) > 1:
            return np.concatenate([decode([message]) for message in messages])
        code = codes.pop()
        if code not in programs:
            raise UnreadableMessage(
                f"CDR representation 0x{code.hex()} is not read; 0x0000, 0x0001, 0x0006 and 0x0007 are"
            )
        bodies = [message[header:] for message in messages] if header else messages
        values = None
        if len(bodies) >= FEWEST_ALIKE and not has_sequence:
            values = _unpack_alike(bodies, readable, wanted, *representations[code], padding)
        if values is None:
            try:
                rows = [_run(data, programs[code], exact, padding) for data in bodies]
            except struct.error as error:
                raise UnreadableMessage(f"a message that is too short ({error})") from None
            values = np.array(rows, float).reshape(len(messages), -1)
        return values[:, columns]

    return decode


def _order(steps: list[Step], names: Sequence[str]) -> list[int]:
    in_order = [name for step_names, _ in steps for name in step_names]
    missing = [name for name in names if name not in in_order]
    if missing:
        raise ValueError(f"no numeric field {missing[0]}")
    return [in_order.index(name) for name in names]


def _ends(data: bytes, size: int, exact: bool, padding: int) -> bool:
    """Returns whether a message ends after its `size` bytes, except for padding. Four or more bytes of
    padding could be a number of another schema, so they must be zeros."""
    surplus = len(data) - size
    return surplus >= 0 and (
        not exact or surplus <= min(3, padding) or (surplus <= padding and not any(data[size:]))
    )


def _unpack_alike(
    messages: list[bytes], items: Sequence[Item], wanted: set[str], order: str, alignment: int, padding: int
) -> np.ndarray | None:
    """Returns the numbers (n, k) of messages with texts as long as those of the first message, by one format
    for all; None if a message differs."""
    parts, pos, is_number = [order], 0, []
    try:
        for is_row, run in itertools.groupby(items, key=lambda item: item.kind == "numbers"):
            row = list(run)
            if is_row:
                parts.append(_row_format(row, wanted, pos & 7, alignment))
                pos += struct.calcsize(order + parts[-1])
                is_number += [True] * sum(len(_names(item, wanted)) for item in row)
            for _ in () if is_row else row:
                pad = -pos % min(4, alignment)
                length = _LENGTH[order].unpack_from(messages[0], pos + pad)[0]
                parts.append(f"{pad}xI{length}x")
                pos += pad + 4 + length
                is_number.append(False)
        layout = struct.Struct("".join(parts))
        if not {len(data) for data in messages} <= set(range(layout.size, layout.size + min(3, padding) + 1)):
            return None
        values = np.array([layout.unpack_from(data) for data in messages], float)
    except struct.error:
        return None
    values, kinds = values.reshape(len(messages), -1), np.array(is_number, bool)
    if kinds.all():
        return values
    lengths = values[:, ~kinds]
    return values[:, kinds] if (lengths == lengths[0]).all() else None


def _run(data: bytes, steps: list[Step], exact: bool, padding: int) -> list[float]:
    """Returns the numbers of a message, read by the steps. Up to `padding` bytes may follow the last step.
    Raises UnreadableMessage if the message ends elsewhere."""
    values: list[float] = []
    pos = 0
    for _, read in steps:
        pos = read(data, pos, values)
    if not _ends(data, pos, exact, padding):
        raise UnreadableMessage(f"a message of {len(data)} bytes where {pos} are expected")
    return values


# ---- protobuf

# files that every protobuf compiler includes, and some recorders leave out
_WELL_KNOWN = {
    module.DESCRIPTOR.name: module.DESCRIPTOR
    for module in (any_pb2, duration_pb2, empty_pb2, struct_pb2, timestamp_pb2, wrappers_pb2)
}
_FILES, _FILE = (
    message_factory.GetMessageClass(descriptor_pb2.DESCRIPTOR.message_types_by_name[name])
    for name in ("FileDescriptorSet", "FileDescriptorProto")
)
# a message that contains itself never ends, and a few levels of many messages nearly never
_DEEPEST, _MOST_FIELDS = 6, 20_000

Types = dict[str, Descriptor]


def message_types(descriptor_set: bytes) -> Types:
    """Returns {full name of the message: its type} of a serialised FileDescriptorSet.

    Raises ValueError if the bytes are something else, or if the set lacks a file that it imports.
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


def _definition(types: Types, name: str) -> Descriptor:
    if name not in types:
        raise ValueError(
            f"the schema does not define its own message {name}; it defines {', '.join(sorted(types)[:5])}"
        )
    return types[name]


def message_reader(types: Types, name: str) -> Callable[[bytes | memoryview], Message]:
    """Returns a function from bytes to the message of that name. The function raises UnreadableMessage if the
    bytes are not such a message."""
    message_class = message_factory.GetMessageClass(_definition(types, name))

    def read(data: bytes | memoryview) -> Message:
        try:
            return message_class.FromString(data)
        except DecodeError as error:
            raise UnreadableMessage(f"a message that is not of its type ({error})") from None

    return read


# ---- which numbers a message has


def _is_number(field: FieldDescriptor) -> bool:
    texts = (FieldDescriptor.CPPTYPE_MESSAGE, FieldDescriptor.CPPTYPE_STRING)
    return field.cpp_type not in texts


def _is_message(field: FieldDescriptor) -> bool:
    """Returns whether a field holds a message. A map does not count, because its entries are found by key and
    not by index."""
    return field.message_type is not None and not field.message_type.GetOptions().map_entry


def protobuf_fields(types: Types, name: str, sample: bytes | None) -> list[str]:
    """Returns the paths of the numbers. For a repeated field they are those in the message `sample`, up to
    LONGEST_LISTED. Raises ValueError if a type has more fields than can be listed."""
    names: list[str] = []
    lists: dict[str, list[str]] = {}
    for visited, (path, field) in enumerate(_leaves(_definition(types, name), "", 0)):
        if visited == _MOST_FIELDS:
            raise ValueError(f"the message {name} has more than {_MOST_FIELDS} fields; name the wanted ones")
        single, is_list, part = path.partition("[]")
        if field is not None and not is_list:
            names.append(path)
        elif field is not None:
            lists.setdefault(single, []).append(part)
    return names + _elements(lists, sample, lambda paths: protobuf_decoder(types, name, paths))


def _leaves(message: Descriptor, prefix: str, depth: int) -> Iterator[tuple[str, FieldDescriptor | None]]:
    """Yields the paths of the numbers with their fields, such as "zones[].celsius" for repeated messages.
    Lists inside lists are left out. A message is a path with None as its field."""
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


def protobuf_decoder(types: Types, name: str, names: Sequence[str]) -> Callable[[list[bytes]], np.ndarray]:
    """Returns a function from n messages to their numbers (n, len(names)). A field with presence that is
    absent gives NaN.

    "zones[#]" is the length of a list. The function raises UnreadableMessage.
    """
    message, read, count = _definition(types, name), message_reader(types, name), len(names)
    if names and all(_is_plain(message.fields_by_name.get(path)) for path in names):
        values = operator.attrgetter(*names)
        return lambda messages: np.array([values(read(data)) for data in messages], float).reshape(-1, count)
    steps = [_steps(message, path) for path in names]

    def decode(messages: list[bytes]) -> np.ndarray:
        rows = [[_number(values, path) for path in steps] for values in map(read, messages)]
        return np.array(rows, float).reshape(len(messages), count)

    return decode


def _is_plain(field: FieldDescriptor | None) -> bool:
    """Returns whether a field is a number that every message has."""
    return field is not None and _is_number(field) and not field.is_repeated and not field.has_presence


# the name of a field, whether it may be absent, and the index in it: None, a place, or -1 for its length
FieldStep = tuple[str, bool, int | None]


def _steps(message: Descriptor, path: str) -> list[FieldStep]:
    """Returns the steps from a message to the number of a path. Raises ValueError if the path leads to no
    number."""
    steps, kind, field = [], message, None
    for part in path.split("."):
        match = re.fullmatch(r"(\w+)(?:\[(\d+|#)\])?", part)
        field = kind.fields_by_name.get(match[1]) if match and kind else None
        if match is None or field is None or (match[2] is not None) != field.is_repeated:
            raise ValueError(f"no numeric field {path}")
        index = -1 if match[2] == "#" else None if match[2] is None else int(match[2])
        steps.append((field.name, field.has_presence, index))
        # nothing follows the length, and a map has no numbered entries
        kind = field.message_type if index != -1 and _is_message(field) else None
    if field is None or (steps[-1][2] != -1 and not _is_number(field)):
        raise ValueError(f"no numeric field {path}")
    return steps


def _number(message: Message, steps: Sequence[FieldStep]) -> Any:
    """Returns the number at the end of the steps, NaN if a message or an element is absent."""
    part: Any = message
    for name, has_presence, index in steps:
        if has_presence and not part.HasField(name):
            return np.nan
        values = getattr(part, name)
        if index is not None and index >= len(values):
            return np.nan
        if index == -1:
            return len(values)
        part = values if index is None else values[index]
    return part
