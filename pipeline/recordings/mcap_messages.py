"""Numbers of the messages of an MCAP channel in ROS 2 CDR, ROS 1, protobuf or JSON. A message may be
compressed by itself."""

import json
import operator
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import lz4.frame
import numpy as np
import orjson
import zstandard

from pipeline.recordings import protobuf_messages, ros_messages
from pipeline.recordings.ros_messages import LARGEST_LAYOUT, LONGEST_LISTED, UnreadableMessage

LARGEST_MESSAGE = 1 << 28
# the longest in use have some 100 kB
LARGEST_SCHEMA = 4 << 20
ENCODINGS = "cdr with ros2msg, ros1 with ros1msg, protobuf, and json"
_ZSTD, _LZ4 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"
_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")

Decode = Callable[[list[bytes]], np.ndarray]


class Channel(NamedTuple):
    """A channel of the file with its schema and the writer's metadata."""

    id: int
    topic: str
    encoding: str
    metadata: dict[str, str]
    schema_name: str
    schema_encoding: str
    schema: bytes


def fields(channel: Channel, samples: Sequence[bytes]) -> list[str]:
    """Paths of the numbers in the channel's messages, by its schema and a few of its messages.

    Raises ValueError with the reason for messages that cannot be read.
    """
    kind = _kind(channel)
    samples = [plain(sample) for sample in samples]
    if kind == "json":
        names = dict.fromkeys(_schema_fields(channel))
        for sample in samples:
            names |= dict.fromkeys(_numbers(_document(sample)))
            if len(names) > LARGEST_LAYOUT:
                raise ValueError(f"its messages have {len(names)} numbers where {LARGEST_LAYOUT} are read")
        return list(names)
    first = samples[0] if samples else None
    if kind == "protobuf":
        return protobuf_messages.fields(
            protobuf_messages.message_types(channel.schema), channel.schema_name, first
        )
    version = 2 if kind == "cdr" else 1
    return ros_messages.fields(_layout(channel, version), first, version=version)


def decoder(channel: Channel, names: Sequence[str]) -> Decode:
    """A function from n messages to their numbers (n, len(names)), NaN for a number that a message lacks.

    It raises UnreadableMessage for a message that does not fit its channel, and ValueError for text in place
    of a wanted number.
    """
    kind = _kind(channel)
    if kind == "json":
        return _json_decoder(names)
    if kind == "protobuf":
        return protobuf_messages.decoder(
            protobuf_messages.message_types(channel.schema), channel.schema_name, names
        )
    version = 2 if kind == "cdr" else 1
    return ros_messages.decoder(_layout(channel, version), names, version=version)


def _kind(channel: Channel) -> str:
    pairs = {("cdr", "ros2msg"): "cdr", ("ros1", "ros1msg"): "ros1", ("protobuf", "protobuf"): "protobuf"}
    if channel.encoding == "json" and len(channel.schema) <= LARGEST_SCHEMA:
        return "json"
    kind = pairs.get((channel.encoding, channel.schema_encoding))
    if len(channel.schema) > LARGEST_SCHEMA:
        raise ValueError(
            f"its schema {channel.schema_name[:60]} has {len(channel.schema)} bytes "
            f"where {LARGEST_SCHEMA} are read"
        )
    if kind is None:
        schema = f"schema encoding {channel.schema_encoding!r}" if channel.schema_encoding else "no schema"
        raise ValueError(f"message encoding {channel.encoding!r} with {schema} is not read; {ENCODINGS} are")
    return kind


def _layout(channel: Channel, version: int) -> list[ros_messages.Item]:
    try:
        return ros_messages.layout(channel.schema.decode(), channel.schema_name, version=version)
    except UnicodeDecodeError:
        raise ValueError(f"the schema {channel.schema_name} is no text") from None


# ---- compression of single messages


def compressed(message: bytes) -> bool:
    """Whether the message is a zstd or lz4 frame, as rosbag2 writes with compression mode `message`."""
    return message[:4] in (_ZSTD, _LZ4)


def plain(message: bytes) -> bytes:
    """The message, decompressed if it is compressed."""
    if not compressed(message):
        return message
    return decompress("zstd" if message[:4] == _ZSTD else "lz4", message, None)


def decompress(method: str, data: bytes, size: int | None) -> bytes:
    """The bytes of a zstd or lz4 frame; `size` is their count, or None. Raises UnreadableMessage for a
    damaged frame.

    The size that the frame declares is checked first: after one flipped bit it may ask for terabytes.
    """
    room = LARGEST_MESSAGE if size is None else size
    try:
        if method == "zstd":
            declared = zstandard.frame_content_size(data)
            _check_size(declared if declared >= 0 else None, size)
            unpacker = zstandard.ZstdDecompressor()
            unpacked = unpacker.decompress(data, max_output_size=0 if declared >= 0 else room)
        elif method == "lz4":
            declared = lz4.frame.get_frame_info(data)["content_size"]
            _check_size(declared or None, size)
            unpacked = lz4.frame.LZ4FrameDecompressor().decompress(data, room + 1)
        else:
            raise UnreadableMessage(f"the compression {method!r} is not known; zstd and lz4 are")
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError, OverflowError) as error:
        raise UnreadableMessage(
            f"{method} data that cannot be unpacked "
            f"({str(error).splitlines()[0] if str(error) else 'too large'})"
        ) from None
    if size is not None and len(unpacked) != size:
        raise UnreadableMessage(f"{method} data that unpack to {len(unpacked)} bytes, not {size}")
    return unpacked


def _check_size(declared: int | None, size: int | None) -> None:
    if declared is not None and (declared > LARGEST_MESSAGE if size is None else declared != size):
        raise UnreadableMessage(
            f"data that say they unpack to {declared} bytes{'' if size is None else f', not {size}'}"
        )


# ---- JSON


def _document(message: bytes):
    """The message's value. orjson is four times as fast as json, which also knows NaN and Infinity."""
    try:
        return orjson.loads(message)
    except orjson.JSONDecodeError:
        try:
            return json.loads(message)
        except (ValueError, RecursionError) as error:
            raise UnreadableMessage(f"a message that is no JSON ({error})") from None


def _schema_fields(channel: Channel) -> list[str]:
    """Paths of the numbers that a JSON schema promises."""
    if channel.schema_encoding != "jsonschema" or not channel.schema:
        return []
    try:
        return _promised(_document(channel.schema), "", 0)
    except UnreadableMessage:
        return []  # the messages tell


def _promised(schema, prefix: str, depth: int) -> list[str]:
    properties = schema.get("properties") if isinstance(schema, dict) else None
    if not isinstance(properties, dict) or depth > 6:
        return []
    names = []
    for name, inner in properties.items():
        kind = inner.get("type") if isinstance(inner, dict) else None
        if kind in ("number", "integer", "boolean") or (
            isinstance(kind, list) and {"number", "integer"} & set(map(str, kind))
        ):
            names.append(prefix + name)
        elif kind == "object":
            names += _promised(inner, f"{prefix}{name}.", depth + 1)
    return names


def _numbers(value, prefix: str = "", depth: int = 0) -> list[str]:
    """Paths of the numbers in a value. Null counts, as another message may have a number there."""
    if isinstance(value, int | float) or (value is None and prefix):
        return [prefix]
    names = []
    if isinstance(value, dict) and depth < 8:
        for name, inner in value.items():
            names += _numbers(inner, f"{prefix}.{name}" if prefix else name, depth + 1)
    elif isinstance(value, list) and depth < 8:
        for i, inner in enumerate(value[:LONGEST_LISTED]):
            names += _numbers(inner, f"{prefix}[{i}]", depth + 1)
    return names


def _json_decoder(names: Sequence[str]) -> Decode:
    steps = [tuple(int(index) if index else key for key, index in _STEP.findall(name)) for name in names]

    at_top = operator.itemgetter(*names)

    def decode(messages: list[bytes]) -> np.ndarray:
        documents = [_document(message) for message in messages]
        try:
            numbers = np.array([at_top(document) for document in documents]).reshape(
                len(messages), len(names)
            )
        except (KeyError, TypeError, IndexError, ValueError):
            numbers = None
        # other kinds are text, null, or a mixture; they are read one by one
        if numbers is None or numbers.dtype.kind not in "fiub":
            numbers = np.array(
                [
                    [_value(document, name, path) for name, path in zip(names, steps, strict=True)]
                    for document in documents
                ],
                float,
            )
        return numbers.astype(float, copy=False)

    return decode


def _value(document, name: str, steps: tuple) -> float:
    value = document
    try:
        for step in steps:
            value = value[step]
    except (KeyError, TypeError, IndexError):
        value = _by_prefix(document, name)
    if value is None:
        return np.nan
    if isinstance(value, int | float):
        try:
            return float(value)
        except OverflowError:
            return np.inf
    raise ValueError(
        f"{name} should be a number but is {json.dumps(value)[:60]}; map another field, or write numbers"
    )


def _by_prefix(document, name: str):
    """The value of a path whose keys hold dots themselves, such as {"heater.1": 30}; None if there is
    none."""
    if not isinstance(document, dict):
        return None
    if name in document:
        return document[name]
    for i, letter in enumerate(name):
        if letter == "." and name[:i] in document:
            value = _by_prefix(document[name[:i]], name[i + 1 :])
            if value is not None:
                return value
    return None
