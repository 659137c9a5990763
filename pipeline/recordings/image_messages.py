"""The messages of an image topic -> pictures -> gray frames.

The types read are sensor_msgs Image and CompressedImage in ROS 2 CDR and ROS 1, and Foxglove's RawImage and
CompressedImage in protobuf, JSON (base64), CDR and ROS 1. Their layouts are fixed (ros2/common_interfaces,
foxglove/foxglove-sdk), so that those of ROS need no schema text. A picture shares the memory of its message,
and a mono8 frame that of its picture. Gray is luma, 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601), as in JPEG.
16 bits stay 16 bits.
"""

import base64
import binascii
import functools
import struct
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import orjson
from google.protobuf.message import Message

from pipeline.recordings.mcap_messages import Channel, plain
from pipeline.recordings.protobuf_messages import message_reader, message_types
from pipeline.recordings.ros_messages import UnreadableMessage

# the fields of each message in the order of the wire: b bytes, s text, I and B whole numbers
_ROS = {
    "sensor_msgs/Image": "header, frame_id:s, height:I, width:I, encoding:s, is_bigendian:B, step:I, data:b",
    "sensor_msgs/CompressedImage": "header, frame_id:s, format:s, data:b",
    "foxglove_msgs/RawImage": "stamp, frame_id:s, width:I, height:I, encoding:s, step:I, data:b",
    "foxglove_msgs/CompressedImage": "stamp, frame_id:s, data:b, format:s",
}
# a picture of that many is 256 MB of 16 bits; the largest of cameras have some 1.5e8
MOST_PIXELS = 1 << 27
_FOXGLOVE = ("foxglove/RawImage", "foxglove/CompressedImage")
READABLE = (
    "sensor_msgs Image and CompressedImage (ROS 2, ROS 1), "
    "foxglove RawImage and CompressedImage (protobuf, JSON, ROS)"
)
# CDR representation -> byte order; no field is longer than four bytes, so that both alignments agree
_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<", b"\x00\x06": ">", b"\x00\x07": "<"}

_MONO = {"mono8", "8uc1"}
_MONO_16 = {"mono16", "16uc1"}
# bytes a pixel, conversion
_COLOUR = {
    "rgb8": (3, cv2.COLOR_RGB2GRAY), "bgr8": (3, cv2.COLOR_BGR2GRAY), "8uc3": (3, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY), "bgra8": (4, cv2.COLOR_BGRA2GRAY), "8uc4": (4, cv2.COLOR_BGRA2GRAY),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2GRAY), "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2GRAY), "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2GRAY),
}  # fmt: skip
# of two bytes a pixel, the one with the luma
_LUMA = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
ENCODINGS = (
    "mono8, mono16, rgb8, bgr8, rgba8, bgra8, 8UC1, 8UC3, 8UC4, 16UC1, bayer_*8, yuv422 and yuv422_yuy2"
)


class ImageMessage(NamedTuple):
    """A message's picture: `encoding` and the layout of its rows. With height 0 it is compressed, and
    `encoding` is its format ("jpeg", "png")."""

    stamp_ns: int
    encoding: str
    height: int
    width: int
    step: int
    big_endian: bool
    data: memoryview


Read = Callable[[bytes | memoryview], ImageMessage]


def is_image(channel: Channel) -> bool:
    """Whether the channel's messages are pictures that `reader` reads."""
    kind = _kind(channel)
    return (channel.encoding in ("cdr", "ros1") and kind in _ROS) or (
        channel.encoding in ("protobuf", "json") and kind in _FOXGLOVE
    )


def reader(channel: Channel) -> Read:
    """A function from one message of the channel to its ImageMessage, without a copy and without decoding.

    The function raises UnreadableMessage for a message that does not fit its type. Raises ValueError for a
    channel without images.
    """
    if not is_image(channel):
        raise ValueError(
            f"messages of type {channel.schema_name!r} in {channel.encoding!r} are no images that are "
            f"read; {READABLE} are"
        )
    if channel.encoding == "json":
        parse = _json
    elif channel.encoding == "protobuf":
        read_message = message_reader(message_types(channel.schema), channel.schema_name)
        parse = functools.partial(_protobuf, read=read_message)
    else:
        fields = [tuple(field.split(":")) for field in _ROS[_kind(channel)].split(", ")]
        parse = functools.partial(_ros, fields=fields, aligned=channel.encoding == "cdr")

    def read(message: bytes | memoryview) -> ImageMessage:
        try:
            return parse(memoryview(plain(message)))
        except (struct.error, UnicodeDecodeError, IndexError) as error:
            raise UnreadableMessage(f"a message that is too short or no image ({error})") from None

    return read


def _kind(channel: Channel) -> str:
    """ "sensor_msgs/Image" of sensor_msgs/msg/Image, sensor_msgs::msg::dds_::Image_ and the like."""
    parts = channel.schema_name.replace("::", "/").replace(".", "/").split("/")
    return f"{parts[0]}/{parts[-1].rstrip('_')}"


# ---- messages -> pictures


def _ros(message: memoryview, fields: list[tuple[str, ...]], aligned: bool) -> ImageMessage:
    """The picture of a ROS message. ROS 2 is `aligned`; ROS 1 is not, and has a counter ahead of a header's
    stamp."""
    order, pos = "<", 0
    if aligned:
        order = _ORDERS.get(bytes(message[:2]), "")
        if not order:
            raise UnreadableMessage(f"CDR representation 0x{message[:2].hex()} is not read")
        message = message[4:]
    word = struct.Struct(order + "I").unpack_from
    values: dict = {"stamp": 0}
    for name, *kind in fields:
        if kind == ["B"]:
            values[name] = message[pos]
            pos += 1
            continue
        pos += -pos % 4 if aligned else 0
        if not kind:
            pos += 4 if name == "header" and not aligned else 0
            values["stamp"] = word(message, pos)[0] * 10**9 + word(message, pos + 4)[0]
            pos += 8
            continue
        value = word(message, pos)[0]
        pos += 4
        if kind != ["I"]:
            end = pos + value
            if end > len(message):
                raise UnreadableMessage(f"{name} of {value} bytes in a message of {len(message)}")
            value = message[pos:end]
            pos = end
        values[name] = _word(value) if kind == ["s"] else value
    return _picture(values, values["stamp"])


def _protobuf(message: memoryview, read: Callable[[memoryview], Message]) -> ImageMessage:
    values = {field.name: value for field, value in read(message).ListFields()}
    numbers = {name: values.get(name, 0) for name in ("width", "height", "step")}
    texts = {name: values.get(name, "") for name in ("encoding", "format")}
    stamp, data = values.get("timestamp"), values.get("data", b"")
    since = [0 if stamp is None else getattr(stamp, name, "") for name in ("seconds", "nanos")]
    if not all(isinstance(whole, int) for whole in (*numbers.values(), *since)):
        raise UnreadableMessage("something else where an image has a whole number")
    if not isinstance(data, bytes) or not all(isinstance(text, str) for text in texts.values()):
        raise UnreadableMessage("something else where an image has its bytes or its format")
    picture = numbers | texts | {"data": memoryview(data), "is_bigendian": values.get("is_bigendian", 0)}
    return _picture(picture, int(since[0]) * 10**9 + int(since[1]))


def _json(message: memoryview) -> ImageMessage:
    try:
        values = orjson.loads(message)
        stamp = values["timestamp"]
        values["data"] = memoryview(base64.b64decode(values["data"], validate=True))
        return _picture(values, int(stamp["sec"]) * 10**9 + int(stamp["nsec"]))
    except (orjson.JSONDecodeError, KeyError, TypeError, ValueError, binascii.Error) as error:
        raise UnreadableMessage(f"a message that is no image in JSON ({error})") from None


def _word(text: bytes | memoryview) -> str:
    return bytes(text).rstrip(b"\0").decode()


def _picture(values: dict, stamp_ns: int) -> ImageMessage:
    data = values.get("data", memoryview(b""))
    if not isinstance(data, memoryview):
        raise UnreadableMessage("a number where its type says bytes")
    if "width" not in values or not values.get("encoding", ""):
        return ImageMessage(stamp_ns, values.get("format", ""), 0, 0, 0, False, data)
    return ImageMessage(
        stamp_ns,
        values["encoding"],
        values["height"],
        values["width"],
        values["step"],
        bool(values.get("is_bigendian", 0)),
        data,
    )


# ---- pictures -> frames


def gray(picture: ImageMessage) -> np.ndarray:
    """The gray frame (height, width), uint8 or uint16; of mono8 a view of the message. Raises
    UnreadableMessage."""
    if not picture.height:
        return _decoded(picture)
    encoding = picture.encoding.casefold()
    colour = _COLOUR.get(encoding)
    if encoding in _MONO:
        return _rows(picture, 1)
    if encoding in _MONO_16:
        # a copy in any case: the bytes in a message need not be aligned
        return _rows(picture, 2).view(">u2" if picture.big_endian else "<u2").astype(np.uint16)
    if encoding in _LUMA:
        return np.ascontiguousarray(_rows(picture, 2)[:, _LUMA[encoding] :: 2])
    if colour is None:
        raise UnreadableMessage(f"the encoding {picture.encoding!r} is not read; {ENCODINGS} are")
    size, conversion = colour
    rows = _rows(picture, size)
    return cv2.cvtColor(rows.reshape(len(rows), picture.width, size) if size > 1 else rows, conversion)


def _rows(picture: ImageMessage, size: int) -> np.ndarray:
    """(height, width size) bytes, without the padding at the end of each row."""
    row = picture.width * size
    step = picture.step or row
    if picture.height < 1 or not 0 < row <= step or len(picture.data) < step * picture.height:
        what = f"{picture.width} x {picture.height} px {picture.encoding} in rows of {step} bytes"
        raise UnreadableMessage(f"{what} do not go with {len(picture.data)} bytes of data")
    return np.frombuffer(picture.data, np.uint8, step * picture.height).reshape(picture.height, step)[:, :row]


def check_size(data: bytes | memoryview) -> None:
    """Raises UnreadableMessage if the header of a PNG or JPEG promises more pixels than are decoded: they
    would take the memory before the first of them is read."""
    height, width = _size(bytes(data[: 1 << 16]))
    if height * width > MOST_PIXELS:
        raise UnreadableMessage(
            f"its header says {width} x {height} px; pictures of up to {MOST_PIXELS} px are read"
        )


def _size(data: bytes) -> tuple[int, int]:
    """Height and width by the header of a PNG or JPEG; (0, 0) if they do not stand in `data`."""
    if data.startswith(b"\x89PNG") and len(data) >= 24:
        width, height = struct.unpack_from(">II", data, 16)
        return height, width
    pos = 2
    while data.startswith(b"\xff\xd8") and pos + 9 <= len(data) and data[pos] == 0xFF:
        if data[pos + 1] == 0xFF:  # a filling byte
            pos += 1
            continue
        # SOF0 to SOF15 without DHT, JPG and DAC, which stand among them
        if 0xC0 <= data[pos + 1] <= 0xCF and data[pos + 1] not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, pos + 5)
            return height, width
        pos += 2 + struct.unpack_from(">H", data, pos + 2)[0]
    return 0, 0


def _decoded(picture: ImageMessage) -> np.ndarray:
    check_size(picture.data)
    # without ANYDEPTH 16 bits would be cut down to 8
    try:
        frame = cv2.imdecode(
            np.frombuffer(picture.data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
        )
    except cv2.error:
        frame = None
    if frame is None:
        raise UnreadableMessage(
            f"its {len(picture.data)} bytes of format {picture.encoding!r} are no whole picture"
        )
    return frame


# ---- frames -> messages, ROS 2 CDR

HEADER = "std_msgs/Header header\n"
HEADER_TYPES = f"""{"=" * 80}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
IMAGE = (
    f"{HEADER}uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
    f"{HEADER_TYPES}"
)
COMPRESSED_IMAGE = f"{HEADER}string format\nuint8[] data\n{HEADER_TYPES}"
_CDR = b"\x00\x01\x00\x00"


def header(stamp_ns: int, frame_id: str) -> bytes:
    """The beginning of a message with a std_msgs/Header: little-endian CDR."""
    return _CDR + struct.pack("<iI", *divmod(stamp_ns, 10**9)) + _text(frame_id)


def image(head: bytes, frame: np.ndarray) -> bytes:
    """sensor_msgs/msg/Image of a frame (height, width), uint8 (mono8) or uint16 (mono16)."""
    height, width = frame.shape
    body = (
        _padded(head)
        + struct.pack("<II", height, width)
        + _text("mono8" if frame.itemsize == 1 else "mono16")
        + b"\0"
    )
    data = np.ascontiguousarray(frame, "<u2" if frame.itemsize == 2 else np.uint8)
    return b"".join(
        [_padded(body), struct.pack("<II", width * frame.itemsize, data.nbytes), memoryview(data).cast("B")]
    )


def compressed_image(head: bytes, format: str, data: np.ndarray) -> bytes:
    """sensor_msgs/msg/CompressedImage of encoded bytes (n,)."""
    return b"".join(
        [_padded(_padded(head) + _text(format)), struct.pack("<I", data.size), memoryview(data).cast("B")]
    )


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text) + 1) + text.encode() + b"\0"


def _padded(body: bytes) -> bytes:
    return body + bytes(-len(body) % 4)
