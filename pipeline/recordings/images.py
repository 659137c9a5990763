"""Converts the messages of an image topic, and image files, to gray frames. Reads and writes recordings of
frames with the numbers recorded beside them.

The types read are sensor_msgs Image and CompressedImage in ROS 2 CDR and ROS 1, and Foxglove's RawImage and
CompressedImage in protobuf, JSON (base64), CDR and ROS 1. Their layouts are fixed (ros2/common_interfaces,
foxglove/foxglove-sdk), so the ROS types need no schema text. A picture shares the memory of its message, and
a mono8 frame shares the memory of its picture. Gray is luma, 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601), as
in JPEG. 16 bits stay 16 bits.

A recording is read once to check it, to read the numbers and to remember the offsets of the pictures. Frames
are decoded later, when they are iterated over. Any ROS 2 or Foxglove viewer opens the files written here: CDR
with the ros2msg texts embedded, in the order of time, in chunks with CRCs. Equal input gives equal bytes.
"""

import base64
import binascii
import contextlib
import functools
import heapq
import math
import operator
import os
import struct
import tempfile
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import cv2
import numpy as np
import orjson
from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer

from pipeline.recordings.clocks import check_clock
from pipeline.recordings.formats import CALENDAR_S, FileColumns, Note, Source, file_format
from pipeline.recordings.mcap_files import (
    CHUNK,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD_HEAD,
    McapFile,
    Topic,
    TopicColumns,
    resolve,
    topics,
    unpack_chunk,
)
from pipeline.recordings.messages import Channel, UnreadableMessage, message_reader, message_types, plain
from pipeline.store.artifacts import beside

# the fields of each message in the order of the wire: b bytes, s text, I and B whole numbers
_ROS = {
    "sensor_msgs/Image": "sec:I nsec:I frame_id:s height:I width:I encoding:s is_bigendian:B step:I data:b",
    "sensor_msgs/CompressedImage": "sec:I nsec:I frame_id:s format:s data:b",
    "foxglove_msgs/RawImage": "sec:I nsec:I frame_id:s width:I height:I encoding:s step:I data:b",
    "foxglove_msgs/CompressedImage": "sec:I nsec:I frame_id:s data:b format:s",
}
# a 16-bit picture of this many pixels has 256 MB; the largest cameras have about 1.5e8
MOST_PIXELS = 1 << 27
_FOXGLOVE = ("foxglove/RawImage", "foxglove/CompressedImage")
READABLE = (
    "sensor_msgs Image and CompressedImage (ROS 2, ROS 1), "
    "foxglove RawImage and CompressedImage (protobuf, JSON, ROS)"
)
# CDR representation -> byte order; no field is longer than four bytes, so both alignments agree
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
# which of a pixel's two bytes holds the luma
_LUMA = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
ENCODINGS = (
    "mono8, mono16, rgb8, bgr8, rgba8, bgra8, 8UC1, 8UC3, 8UC4, 16UC1, bayer_*8, yuv422 and yuv422_yuy2"
)


FRAME_ID = "nozzle"
IMAGE_TOPIC = "/nozzle/image"
# encoding -> ending and settings of cv2.imencode. A camera's frame is noise to a compressor. With one filter
# and run lengths only, a PNG of level 1 is smaller than with a filter chosen for each row; it is written in
# half the time and read in two thirds of the time
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
        cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]  # fmt: skip
ENCODERS = {"jpeg": (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 95]), "png": (".png", _PNG), "raw": ("", [])}
MISSING, UNREADABLE = "the image is missing", "the image cannot be read"
# the error stream belongs to the whole process, so threads of a cluster's worker take turns
_LISTENING = threading.Lock()


class ImageMessage(NamedTuple):
    """A message's picture: `encoding` and the layout of its rows. If height is 0, the picture is compressed
    and `encoding` is its format ("jpeg", "png")."""

    stamp_ns: int
    encoding: str
    height: int
    width: int
    step: int
    big_endian: bool
    data: memoryview


Read = Callable[[bytes | memoryview], ImageMessage]


def is_image(channel: Channel) -> bool:
    """Returns whether the channel's messages are pictures that `reader` can read."""
    kind = _kind(channel)
    return (channel.encoding in ("cdr", "ros1") and kind in _ROS) or (
        channel.encoding in ("protobuf", "json") and kind in _FOXGLOVE
    )


def reader(channel: Channel) -> Read:
    """Returns a function from one message of the channel to its ImageMessage. It neither copies nor decodes
    the picture.

    The function raises UnreadableMessage if a message does not fit its type. Raises ValueError if the channel
    has no images.
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
        aligned = channel.encoding == "cdr"
        # a header of ROS 1 begins with a counter
        counted = "" if aligned or not _kind(channel).startswith("sensor_msgs") else "seq:I "
        fields = [tuple(field.split(":")) for field in (counted + _ROS[_kind(channel)]).split()]
        parse = functools.partial(_ros, fields=fields, aligned=aligned)

    def read(message: bytes | memoryview) -> ImageMessage:
        try:
            return parse(memoryview(plain(message)))
        except (struct.error, UnicodeDecodeError, IndexError) as error:
            raise UnreadableMessage(f"a message that is too short or no image ({error})") from None

    return read


def _kind(channel: Channel) -> str:
    """Returns "sensor_msgs/Image" for sensor_msgs/msg/Image, sensor_msgs::msg::dds_::Image_ and similar
    names."""
    parts = channel.schema_name.replace("::", "/").replace(".", "/").split("/")
    return f"{parts[0]}/{parts[-1].rstrip('_')}"


# ---- messages -> pictures


def _ros(message: memoryview, fields: list[tuple[str, ...]], aligned: bool) -> ImageMessage:
    """Returns the picture of a ROS message. ROS 2 is `aligned`; ROS 1 is not."""
    order, pos = "<", 0
    if aligned:
        order = _ORDERS.get(bytes(message[:2]), "")
        if not order:
            raise UnreadableMessage(f"CDR representation 0x{message[:2].hex()} is not read")
        message = message[4:]
    word = struct.Struct(order + "I").unpack_from
    values: dict = {}
    for name, kind in fields:
        if kind == "B":
            values[name] = message[pos]
            pos += 1
            continue
        pos += -pos % 4 if aligned else 0
        value = word(message, pos)[0]
        pos += 4
        if kind != "I":
            if pos + value > len(message):
                raise UnreadableMessage(f"{name} of {value} bytes in a message of {len(message)}")
            content = message[pos : pos + value]
            pos += value
            value = content if kind == "b" else bytes(content).rstrip(b"\0").decode()
        values[name] = value
    return _picture(values, values["sec"] * 10**9 + values["nsec"])


def _protobuf(message: memoryview, read: Callable[[memoryview], Message]) -> ImageMessage:
    values = {field.name: value for field, value in read(message).ListFields()}
    stamp, data = values.get("timestamp"), values.get("data", b"")
    since = [0 if stamp is None else getattr(stamp, name, "") for name in ("seconds", "nanos")]
    if not all(isinstance(number, int) for number in since) or not isinstance(data, bytes):
        raise UnreadableMessage("something else where an image has its bytes or its time")
    return _picture(values | {"data": memoryview(data)}, since[0] * 10**9 + since[1])


def _json(message: memoryview) -> ImageMessage:
    try:
        values = orjson.loads(message)
        stamp = values["timestamp"]
        values["data"] = memoryview(base64.b64decode(values["data"], validate=True))
        return _picture(values, int(stamp["sec"]) * 10**9 + int(stamp["nsec"]))
    except (orjson.JSONDecodeError, KeyError, TypeError, ValueError, binascii.Error) as error:
        raise UnreadableMessage(f"a message that is no image in JSON ({error})") from None


def _picture(values: dict, stamp_ns: int) -> ImageMessage:
    height, width, step = (values.get(name, 0) for name in ("height", "width", "step"))
    encoding, format = (values.get(name, "") for name in ("encoding", "format"))
    if not all(isinstance(number, int) for number in (height, width, step)):
        raise UnreadableMessage("something else where an image has a whole number")
    if not (isinstance(encoding, str) and isinstance(format, str) and isinstance(values["data"], memoryview)):
        raise UnreadableMessage("something else where an image has its bytes or its format")
    if not encoding:
        return ImageMessage(stamp_ns, format, 0, 0, 0, False, values["data"])
    is_big = bool(values.get("is_bigendian", 0))
    return ImageMessage(stamp_ns, encoding, height, width, step, is_big, values["data"])


# ---- pictures -> frames


def gray(picture: ImageMessage) -> np.ndarray:
    """Returns the gray frame (height, width), uint8 or uint16. For mono8 it is a view of the message. Raises
    UnreadableMessage if the picture cannot be decoded."""
    if not picture.height:
        frame = _decode_picture(picture.data, 0)
        if frame is None:
            what = f"its {len(picture.data)} bytes of format {picture.encoding!r}"
            raise UnreadableMessage(f"{what} are no whole picture")
        return frame
    encoding = picture.encoding.casefold()
    colour = _COLOUR.get(encoding)
    if encoding in _MONO:
        return _rows(picture, 1)
    if encoding in _MONO_16:
        # always a copy, because the bytes in a message may be unaligned
        return _rows(picture, 2).view(">u2" if picture.big_endian else "<u2").astype(np.uint16)
    if encoding in _LUMA:
        return np.ascontiguousarray(_rows(picture, 2)[:, _LUMA[encoding] :: 2])
    if colour is None:
        raise UnreadableMessage(f"the encoding {picture.encoding!r} is not read; {ENCODINGS} are")
    size, conversion = colour
    rows = _rows(picture, size)
    return cv2.cvtColor(rows.reshape(len(rows), picture.width, size) if size > 1 else rows, conversion)


def _rows(picture: ImageMessage, size: int) -> np.ndarray:
    """Returns the bytes (height, width size), without the padding at the end of each row."""
    row = picture.width * size
    step = picture.step or row
    if picture.height < 1 or not 0 < row <= step or len(picture.data) < step * picture.height:
        what = f"{picture.width} x {picture.height} px {picture.encoding} in rows of {step} bytes"
        raise UnreadableMessage(f"{what} do not go with {len(picture.data)} bytes of data")
    return np.frombuffer(picture.data, np.uint8, step * picture.height).reshape(picture.height, step)[:, :row]


def _size(data: bytes) -> tuple[int, int]:
    """Returns height and width from the header of a PNG or JPEG, (0, 0) if `data` does not contain them."""
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


def _decode_picture(data: bytes | memoryview, flags: int) -> np.ndarray | None:
    """Returns the gray picture of encoded bytes, None if they cannot be decoded. Raises UnreadableMessage if
    its header declares more than MOST_PIXELS."""
    height, width = _size(bytes(data[: 1 << 16]))
    if height * width > MOST_PIXELS:
        # they would take the memory before the first pixel is read
        raise UnreadableMessage(
            f"its header says {width} x {height} px; pictures of up to {MOST_PIXELS} px are read"
        )
    # without ANYDEPTH 16 bits would be cut down to 8
    flags |= cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    with contextlib.suppress(cv2.error):
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    return None


# ---- image files


def read_image(path: str | Path) -> np.ndarray:
    """Returns the picture (height, width) in gray, uint8 or uint16, as the camera wrote it: a rotation noted
    in the file is not applied. Raises ValueError if it cannot be read."""
    (picture,) = open_images([str(path)])
    if isinstance(picture, str):
        raise ValueError(
            f"{path}: expected a whole picture (JPEG, PNG, TIFF, BMP, WebP), found "
            f"{picture.partition(': ')[2]}; check the name, or copy it again"
        )
    return picture


def open_images(paths: Iterable[str]) -> Iterator[np.ndarray | str]:
    """Yields each file's picture, or the reason why it cannot be read. An empty path is a frame that is
    skipped."""
    with _decoder_complaints() as complaint_of:
        for path in paths:
            frame: np.ndarray | str = MISSING
            try:
                frame = decode(Path(path).read_bytes()) if path else MISSING
            except OSError as error:
                frame = f"{UNREADABLE}: {os.strerror(error.errno or 0).lower()}"
            except ValueError as error:
                frame = f"{UNREADABLE}: {error}"
            complaint = complaint_of()
            yield f"{UNREADABLE}: {complaint}" if complaint and not isinstance(frame, str) else frame


def decode(data: bytes) -> np.ndarray:
    """Returns the picture (height, width) in gray, uint8 or uint16, of an encoded file. Raises ValueError,
    which says what the bytes hold instead."""
    if not data:
        raise ValueError("an empty file")
    # the decoder fills a broken end with gray, so the end mark must follow the last scan
    if data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        raise ValueError(f"a JPEG of {len(data)} bytes without its end")
    frame = _decode_picture(data, cv2.IMREAD_IGNORE_ORIENTATION)
    if frame is None:
        raise ValueError(f"{len(data)} bytes that are no whole picture, beginning with {data[:8].hex(' ')}")
    if frame.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"pixels of {frame.dtype} in place of 8 or 16 bits")
    return frame


@contextlib.contextmanager
def _decoder_complaints() -> Iterator[Callable[[], str]]:
    """Gives a function that returns the JPEG decoder's complaint since its last call, "" if there is none.
    The decoder repairs damaged data and reports this only on the error stream of the process."""
    at = 0

    def complaint_of() -> str:
        nonlocal at
        text = os.pread(stream.fileno(), 1 << 16, at)
        at += len(text)
        # padding between restart markers, as cameras write it, loses nothing
        return next(
            (
                line
                for line in text.decode(errors="replace").splitlines()
                if "JPEG" in line and "extraneous" not in line
            ),
            "",
        )

    with _LISTENING, tempfile.TemporaryFile() as stream:
        own = os.dup(2)
        os.dup2(stream.fileno(), 2)
        try:
            yield complaint_of
        finally:
            os.dup2(own, 2)
            os.close(own)


# ---- the frames of a recording


class Frames:
    """Iterates over (time_s, frame) of each picture in the order of time; frame (height, width), uint8 or
    uint16.

    It can be iterated over any number of times, in the memory of one chunk; time_s (n,) is known before. The
    file of `columns` is read once at the start, also for these columns. A picture that cannot be decoded is
    left out: `unreadable` counts those of the last iteration, `notes` describes them. Raises ValueError if
    they are more than `unreadable_share` of all, or if the size of the frames changes. `start_ns` is the
    instant from which time is counted.
    """

    def __init__(self, columns: TopicColumns, topic: Topic, unreadable_share: float):
        file = columns.file
        self.path, self.topic, self.unreadable = file.path, topic.name, 0
        self._time, self._share, self._first, self.start_ns = columns.time, unreadable_share, "", 0
        readers = {channel.id: reader(channel) for channel in topic.channels}
        times: dict[int, list[int]] = {number: [] for number in readers}
        offsets: dict[int, list[int]] = {number: [] for number in readers}
        stamped = self._time != "log_time"
        for batch in file.batches(lambda c: c.topic in columns.fields or (stamped and c.id in readers)):
            for number, messages in batch.items():
                if number not in readers:
                    columns.add(number, messages)
                    continue
                offsets[number] += messages.offsets
                if self._time in ("log_time", "publish_time"):
                    times[number] += getattr(messages, self._time)
                    continue
                for message in messages.data:
                    # a message that cannot be read is counted later, when frames are decoded
                    with contextlib.suppress(UnreadableMessage):
                        times[number].append(readers[number](message).stamp_ns)
        numbers = sorted((number for number in times if times[number]), key=lambda number: times[number][0])
        self.count = sum(file.counts[number] for number in numbers)
        self._channels = [(number, readers[number], offsets[number]) for number in numbers]
        every = [time for number in numbers for time in times[number]]
        self.time_ns = np.array(every, np.uint64).astype(np.int64)

    @property
    def time_s(self) -> np.ndarray:
        """The times of the pictures (n,), one channel after the other in the order of their first
        pictures."""
        return (self.time_ns - self.start_ns) / 1e9

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[tuple[float, np.ndarray]]:
        kind = None
        for time, picture in self.pictures():
            try:
                frame = gray(picture)
            except UnreadableMessage as error:
                self._leave_out(time, error)
                continue
            size = (frame.shape[1], frame.shape[0], 8 * frame.itemsize)
            kind = kind or size
            if size != kind:
                raise ValueError(
                    f"{self.path}: the frame of {self.topic} at {time:.3f} s is {size[0]} x {size[1]} px "
                    f"of {size[2]} bits but the first is {kind[0]} x {kind[1]} px of {kind[2]}; "
                    "record a trial at one size"
                )
            yield time, frame

    def pictures(self) -> Iterator[tuple[float, ImageMessage]]:
        """Yields (time_s, ImageMessage) as recorded: encoded bytes, or rows."""
        self.unreadable, self._first = 0, ""
        with self.path.open("rb", buffering=0) as stream:
            for number, read, offsets in self._channels:
                for offset in offsets:
                    for log_time, publish_time, message in self._messages(stream, number, offset):
                        try:
                            picture = read(message)
                        except UnreadableMessage as error:
                            self._leave_out((log_time - self.start_ns) / 1e9, error)
                            continue
                        time = {"log_time": log_time, "publish_time": publish_time}.get(
                            self._time, picture.stamp_ns
                        )
                        yield (time - self.start_ns) / 1e9, picture

    def pick(self, numbers: Collection[int]) -> Iterator[tuple[int, np.ndarray]]:
        """Yields (number, frame) of the pictures with these numbers. Only these are decoded. A picture that
        cannot be decoded is left out."""
        for number, (_, picture) in enumerate(self.pictures()):
            if number in numbers:
                try:
                    yield number, gray(picture)
                except UnreadableMessage:
                    continue

    def notes(self) -> list[Note]:
        """Returns a note on the pictures that the last iteration left out."""
        if not self.unreadable:
            return []
        return [
            Note(
                "unreadable",
                "",
                self.unreadable,
                f"{self.unreadable} of {self.count} frames of {self.topic} {self._first}; they were left out",
            )
        ]

    def _leave_out(self, time: float, error: UnreadableMessage) -> None:
        self.unreadable += 1
        self._first = self._first or f"cannot be decoded, the first at {time:.3f} s: {error}"
        if self.unreadable > self._share * self.count:
            raise ValueError(
                f"{self.path}: {self.unreadable} of {self.count} frames of {self.topic} {self._first}; "
                f"that is more than {100 * self._share:g} percent, so record the trial again"
            )

    def _messages(self, stream: BinaryIO, number: int, offset: int) -> Iterator[tuple[int, int, memoryview]]:
        """Yields (log_time, publish_time, message) of the channel from the chunk or message at `offset`. The
        CRC was checked when the file was first read."""
        try:
            stream.seek(offset)
            head = stream.read(9)
            record = stream.read(RECORD_HEAD.unpack(head)[1])
            record_bytes, pos = unpack_chunk(record, check=False) if head[0] == CHUNK else (head + record, 0)
            content = memoryview(record_bytes)
            while pos < len(content):
                length = RECORD_HEAD.unpack_from(content, pos)[1]
                if content[pos] == MESSAGE:
                    _, _, channel, _, log_time, publish_time = MESSAGE_HEAD.unpack_from(content, pos)
                    if channel == number:
                        yield log_time, publish_time, content[pos + 31 : pos + 9 + length]
                pos += 9 + length
        except (struct.error, IndexError, UnicodeDecodeError, UnreadableMessage):
            raise ValueError(
                f"{self.path}: the record at byte {offset} is not what it was a moment ago; "
                "leave the file alone while it is read"
            ) from None


def open_topics(path: Path, what: str) -> dict[str, Topic]:
    """Returns the topics of a recording. Raises ValueError if the file is not MCAP; the message says `what`
    it should be."""
    if file_format(path) != "mcap":
        raise ValueError(
            f"{path} is a table but {what} should be an MCAP recording with frames; name the recording"
        )
    return topics(path)


def image_topic(path: Path, topics: dict[str, Topic], name: str, place: str = "") -> Topic:
    """Returns the topic `name` or, if `name` is empty, the only topic with images. Raises ValueError with the
    existing topics and with the setting `place` that names the image topic."""
    images = [topic for topic in topics.values() if topic.channels and all(map(is_image, topic.channels))]
    chosen = [topic for topic in images if not name or topic.name == name]
    if len(chosen) == 1:
        return chosen[0]
    place = f" ({place})" if place else ""
    if chosen:
        raise ValueError(
            f"{path}: {len(chosen)} topics have images ({', '.join(topic.name for topic in chosen)}); "
            f"name the one of the nozzle's camera{place}"
        )
    available = ", ".join(
        f"{topic.name} ({topic.channels[0].schema_name or 'no type'} in {topic.channels[0].encoding})"
        for topic in topics.values()
    )
    what = f"topic {name} with images" if name else "image topic"
    raise ValueError(
        f"{path}: there is no {what}; it has {available or 'no topic at all'}; "
        f"images are read as {READABLE}{place}"
    )


def read_frames(
    path: Path,
    sources: Iterable[Source],
    *,
    what: str,
    image: str,
    clock: str,
    unreadable_share: float,
    optional: Collection[str] = (),
    section: str = "",
) -> tuple[Frames, dict[str, tuple[np.ndarray, np.ndarray]], dict[str, dict[str, str]], list[Note]]:
    """Returns the frames of the topic `image` (empty: the only one), the signals {name: (time_s (n,), values
    (n,))} of `sources` on the same clock, the metadata {record: {key: value}}, and notes on damage.

    The `optional` signals may have no topic. Raises ValueError if a topic or field does not exist, if no
    picture can be read, or if a clock runs backwards. The message names `what` the recording should be and
    the `section` of params.yaml that maps it.
    """
    in_file = open_topics(path, what)
    if not any(topic.count for topic in in_file.values()):
        raise ValueError(f"{path}: it has no whole message ({damage(path)}); copy the recording again")
    camera = image_topic(path, in_file, image, f"{section}.image" if section else "")
    columns = TopicColumns(McapFile(path), clock)
    places = {}
    for source in sources:
        name = source.signal
        try:
            places[name] = (source, *resolve(path, source.source, in_file))
        except ValueError as error:
            if name not in optional or source.source.partition(":")[0] in in_file:
                remedy = f"it in {section}.mapping.{name}" if section else f"{name} to the topic that has it"
                raise ValueError(f"{error}; map {remedy}") from None
    for topic in dict.fromkeys(topic for _, topic, _ in places.values()):
        columns.want(in_file[topic], [field for _, at, field in places.values() if at == topic])
    frames = Frames(columns, camera, unreadable_share)
    if not len(frames.time_ns):
        raise ValueError(
            f"{path}: no picture of {camera.name} can be read ({damage(path)}); copy the recording again"
        )
    notes = columns.file.notes() + columns.notes()
    groups = {topic: columns.join(topic, notes) for topic in columns.fields}
    pictures = FileColumns(camera.name, frames.time_ns, {}, lambda i: f"frame {i + 1} of {camera.name}")
    start_ns = _start(path, [*groups.values(), pictures], notes)
    frames.start_ns = start_ns
    signals = {
        name: (
            (groups[topic].time - start_ns) / 1e9,
            _values(path, source, groups[topic].values[field], notes),
        )
        for name, (source, topic, field) in places.items()
    }
    return frames, signals, columns.file.metadata, notes


def check_overlap(
    path: str | Path, frames: tuple[float, float], spans: dict[str, tuple[float, float]]
) -> None:
    for name, (first, last) in spans.items():
        if frames[1] < first or last < frames[0]:
            raise ValueError(
                f"{path}: the frames run from {frames[0]:.3f} to {frames[1]:.3f} s but {name} from "
                f"{first:.3f} to {last:.3f} s, so they do not overlap in time; record both on one clock"
            )


def span_of(time_s: np.ndarray) -> tuple[float, float]:
    return float(time_s[0]), float(time_s[-1])


def _values(path: Path, source: Source, recorded: np.ndarray, notes: list[Note]) -> np.ndarray:
    """Returns the recorded values in the signal's unit. Missing values are NaN, and counted in a note. Raises
    ValueError if all values are missing."""
    missing = int(np.count_nonzero(~np.isfinite(recorded)))
    if missing == len(recorded):
        raise ValueError(
            f"{path}: {source.source} should hold numbers for {source.signal} but all of its {missing} "
            "values are missing; map another"
        )
    if missing:
        notes.append(
            Note(
                "missing",
                source.signal,
                missing,
                f"{missing} of {len(recorded)} values of {source.source} are missing",
            )
        )
    return np.where(np.isfinite(recorded), recorded * source.scale + source.offset, np.nan)


def _start(path: Path, groups: Sequence[FileColumns], notes: list[Note]) -> int:
    """Returns the instant in ns from which time is counted: 0, or the first whole second if the clock is a
    calendar's.

    Raises ValueError if a clock does not run forward.
    """
    for group in groups:
        check_clock(path, group)
    first = min(int(group.time[0]) for group in groups)
    if first <= CALENDAR_S * 1e9:
        return 0
    zero = np.datetime64(first // 10**9, "s")
    notes.append(Note("clock", "", 1, f"time is counted from {zero} (UTC, as the recording's clock says)"))
    return first // 10**9 * 10**9


def damage(path: Path) -> str:
    """Returns the damage found by reading the whole file, in words."""
    notes = McapFile(path).walk()
    return "; ".join(note.message for note in notes[:2]) or "it was closed before any message came"


# ---- writing

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
    """Returns the beginning of a message with a std_msgs/Header: little-endian CDR."""
    return _CDR + struct.pack("<iI", *divmod(stamp_ns, 10**9)) + _text(frame_id)


def image(head: bytes, frame: np.ndarray) -> bytes:
    """Returns a sensor_msgs/msg/Image of a frame (height, width), uint8 (mono8) or uint16 (mono16)."""
    height, width = frame.shape
    body = (
        _pad(head)
        + struct.pack("<II", height, width)
        + _text("mono8" if frame.itemsize == 1 else "mono16")
        + b"\0"
    )
    data = np.ascontiguousarray(frame, "<u2" if frame.itemsize == 2 else np.uint8)
    return b"".join(
        [_pad(body), struct.pack("<II", width * frame.itemsize, data.nbytes), memoryview(data).cast("B")]
    )


def image_bytes(head: bytes, format: str, data: np.ndarray) -> bytes:
    """Returns a sensor_msgs/msg/CompressedImage of encoded bytes (n,)."""
    return b"".join(
        [_pad(_pad(head) + _text(format)), struct.pack("<I", data.size), memoryview(data).cast("B")]
    )


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text) + 1) + text.encode() + b"\0"


def _pad(body: bytes) -> bytes:
    return body + bytes(-len(body) % 4)


def tables_of(
    path: str | Path, time_s: np.ndarray, signals: Sequence[tuple[Source, np.ndarray]]
) -> dict[str, dict[str, np.ndarray]]:
    """Returns {topic: {field: values}}. Raises ValueError if a signal does not have one finite value for each
    time, or if time does not run forward from 0 or later."""
    time = np.asarray(time_s, float)
    tables: dict[str, dict[str, np.ndarray]] = {}
    for name, values in [
        ("time_s", time),
        *((source.signal, np.asarray(values, float)) for source, values in signals),
    ]:
        if values.shape != time.shape or time.ndim != 1 or not time.size:
            raise ValueError(
                f"{path}: {name} should have one value for each of {time.size} times but has "
                f"shape {values.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(
                f"{path}: {name} is not finite at sample {np.flatnonzero(~np.isfinite(values))[0]}; "
                "leave that sample out"
            )
    if time[0] < 0 or (np.diff(np.rint(time * 1e9)) <= 0).any():
        raise ValueError(
            f"{path}: time_s should run forward from 0 or later, in steps of a nanosecond or more, "
            "but does not; sort or shift it"
        )
    for source, values in signals:
        topic, _, field = source.source.partition(":")
        tables.setdefault(topic, {})[field] = np.asarray(values, float)
    return tables


def write_frames(
    path: str | Path,
    tables: Mapping[str, Mapping[str, np.ndarray]],
    types: Mapping[str, str],
    time_s: np.ndarray,
    pictures: tuple[str, Iterable[tuple[float, np.ndarray]]] | None,
    metadata: tuple[str, Mapping[str, str]] | None = None,
) -> None:
    """Writes one recording.

    `tables`: {topic: {field: (T,)}} from `tables_of`; `types`: {topic: message type}; `pictures`: (encoding,
    frames (time_s, (height, width))). Frames are taken one by one, so only one chunk is in memory. Raises
    ValueError, and writes no file, if the encoding is unknown or `_frame_messages` refuses the frames.
    """
    if pictures and pictures[0] not in ENCODERS:
        raise ValueError(
            f"{path}: the encoding should be jpeg, png or raw but is {pictures[0]!r}; name one of them"
        )
    with beside(path) as temporary:
        # by its name: only artifacts opens a file to write. Chunks, summary and metadata have a CRC each; one
        # over all of it would be summed twice
        writer = Writer(str(temporary), compression=CompressionType.NONE)
        writer.start(profile="ros2", library="beadline")
        if metadata:
            writer.add_metadata(*metadata)
        channels = {}
        for topic, fields in tables.items():
            text = HEADER + "".join(f"float64 {field}\n" for field in fields) + HEADER_TYPES
            channels[topic] = _channel(writer, topic, types[topic], text)
        streams = [_signal_messages(tables, channels, time_s)]
        if pictures:
            encoding, frames = pictures
            name, text, topic = ("CompressedImage", COMPRESSED_IMAGE, f"{IMAGE_TOPIC}/compressed")
            if encoding == "raw":
                name, text, topic = "Image", IMAGE, IMAGE_TOPIC
            channel = _channel(writer, topic, f"sensor_msgs/msg/{name}", text)
            streams.append(
                _frame_messages(path, channel, encoding, frames, span_of(np.asarray(time_s, float)))
            )
        for sequence, (stamp, channel, message) in enumerate(
            heapq.merge(*streams, key=operator.itemgetter(0))
        ):
            writer.add_message(channel, stamp, message, stamp, sequence)
        writer.finish()


def _channel(writer: Writer, topic: str, name: str, text: str) -> int:
    return writer.register_channel(topic, "cdr", writer.register_schema(name, "ros2msg", text.encode()))


def _signal_messages(
    tables: dict, channels: dict[str, int], time_s: np.ndarray
) -> Iterator[tuple[int, int, bytes]]:
    stamps = np.rint(np.asarray(time_s, float) * 1e9).astype(np.int64).tolist()
    # behind the header of a message and the CDR header of four bytes numbers stand at multiples of 8
    pad = bytes(-(len(header(0, FRAME_ID)) - 4) % 8)
    rows = {topic: np.column_stack(list(columns.values())).astype("<f8") for topic, columns in tables.items()}
    for k, stamp in enumerate(stamps):
        head = header(stamp, FRAME_ID) + pad
        for topic, values in rows.items():
            yield stamp, channels[topic], head + values[k].tobytes()


def _frame_messages(
    path, channel: int, encoding: str, frames: Iterable, span: tuple[float, float]
) -> Iterator[tuple[int, int, bytes]]:
    """Yields the CDR messages of the frames. Checks each frame and, at the end, the overlap with the signals'
    time. Raises ValueError if a check fails."""
    ending, settings = ENCODERS[encoding]
    kind, last, first = None, -1, math.nan
    for k, (time, frame) in enumerate(frames):
        stamp = round(time * 1e9) if math.isfinite(time) else -1
        if stamp <= last:
            raise ValueError(
                f"{path}: frame {k} is at {time:g} s but frames should run forward from 0 s or later; "
                "sort them or shift the time"
            )
        if (
            frame.ndim != 2
            or frame.dtype not in (np.uint8, np.uint16)
            or (encoding == "jpeg" and frame.dtype != np.uint8)
        ):
            wanted = "uint8" if encoding == "jpeg" else "uint8 or uint16"
            raise ValueError(
                f"{path}: frame {k} should be (height, width) of {wanted} but is {frame.shape} of "
                f"{frame.dtype}; make it gray"
            )
        kind = kind or (frame.shape, frame.dtype)
        if (frame.shape, frame.dtype) != kind:
            raise ValueError(
                f"{path}: frame {k} is {frame.shape} of {frame.dtype} but the first is {kind[0]} of "
                f"{kind[1]}; write one size"
            )
        head = header(stamp, FRAME_ID)
        if ending:
            message = image_bytes(head, encoding, cv2.imencode(ending, frame, settings)[1])
        else:
            message = image(head, frame)
        last, first = stamp, time if k == 0 else first
        yield stamp, channel, message
    if last < 0:
        raise ValueError(f"{path}: a trial should have frames but there is none; give at least one")
    check_overlap(path, (first, last / 1e9), {"signals": span})
