"""The frames of one image topic of an MCAP file and the numbers of the topics beside it.

One walk checks the whole file, reads the numbers and remembers the places of the pictures. Frames are decoded
when they are asked for.
"""

import struct
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pipeline.recordings.formats import FileColumns, Note, nearest_names
from pipeline.recordings.image_messages import READABLE, ImageMessage, gray, is_image, reader
from pipeline.recordings.mcap_columns import Topic
from pipeline.recordings.mcap_files import McapFile, Messages
from pipeline.recordings.mcap_messages import Decode, UnreadableMessage, decoder, decompress, plain
from pipeline.recordings.mcap_records import (
    CHUNK,
    CHUNK_HEAD,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD_HEAD,
    pairs,
    prefixed,
    string,
)

METADATA = 0x0C
# (seconds, nanoseconds) as the fields of a time stamp are called in ROS 2, Foxglove JSON, ROS 1 and protobuf
STAMPS = (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs"), ("seconds", "nanos"))


class Walk(McapFile):
    """A whole file, walked once.

    It has the metadata records, the messages of the topics `wanted`, and of the pictures of `image`, by
    channel, their times in ns on the clock `time` and the offsets of the chunks and single messages that hold
    them.
    """

    def __init__(self, path: Path, image: Topic, wanted: set[str], time: str):
        super().__init__(path)
        self.metadata: dict[str, dict[str, str]] = {}
        self.messages: dict[int, Messages] = {}
        self.offsets: dict[int, list[int]] = {}
        self.picture_ns: dict[int, list[int]] = {}
        self.readers = {channel.id: reader(channel) for channel in image.channels}
        self._at = (0, 0)
        for batch in self.batches(
            lambda channel: channel.topic in wanted or (channel.id in self.readers and time != "log_time")
        ):
            for number, messages in batch.items():
                if number in self.readers:
                    self._remember(number, messages, time)
                elif messages.data:
                    channel_messages = self.messages.setdefault(number, Messages([], [], []))
                    for all_of_it, part in zip(channel_messages, messages, strict=True):
                        all_of_it += part

    def _framed(self, stream: BinaryIO) -> Iterator[tuple[int, int, bytes, bytes]]:
        for opcode, offset, head, record in super()._framed(stream):
            self._at = (opcode, offset)
            if opcode == METADATA:
                name, record_pairs = _metadata(record)
                self.metadata[name] = record_pairs
            elif opcode == MESSAGE:
                number = struct.unpack_from("<H", record)[0]
                if number in self.readers:
                    self.offsets.setdefault(number, []).append(offset)
            yield opcode, offset, head, record

    def _remember(self, number: int, messages: Messages, time: str) -> None:
        # messages outside chunks come in groups, behind the last of them
        if self._at[0] == CHUNK:
            self.offsets.setdefault(number, []).append(self._at[1])
        times = self.picture_ns.setdefault(number, [])
        if time in ("log_time", "publish_time"):
            times += messages.log_time if time == "log_time" else messages.publish_time
            return
        for message in messages.data:
            try:
                times.append(self.readers[number](message).stamp_ns)
            except UnreadableMessage:
                continue  # it is met again, and counted, where frames are decoded

    def picture_order(self) -> list[int]:
        """The channels that have pictures, the earliest first."""
        return sorted(
            (number for number, times in self.picture_ns.items() if times),
            key=lambda number: self.picture_ns[number][0],
        )


def _metadata(record: bytes) -> tuple[str, dict[str, str]]:
    """Name and pairs of a metadata record; an empty name if its lengths do not agree."""
    try:
        name, pos = string(record, 0)
        return name, pairs(prefixed(record, pos)[0])
    except (struct.error, UnicodeDecodeError, UnreadableMessage):
        return "", {}


# ---- numbers


def columns(walk: Walk, topic: Topic, names: Sequence[str], time: str) -> tuple[FileColumns, int]:
    """The numbers `names` of a topic, its channels one behind the other, and the count of messages that do
    not fit their schema.

    Raises ValueError for a clock that the topic does not have, for text in place of a number, and if nothing
    can be read.
    """
    clock = _clock(walk.path, topic, time)
    pieces, dropped = [], 0
    for channel in topic.channels:
        messages = walk.messages.get(channel.id)
        if messages is None:
            continue
        try:
            decode = decoder(channel, [*names, *clock])
            rows, sound = _rows(decode, messages.data, len(names) + len(clock))
        except ValueError as error:
            raise ValueError(
                f"{walk.path}: topic {topic.name} cannot be read because {error}; map another topic"
            ) from None
        dropped += len(messages.data) - len(sound)
        if len(clock) == 1:
            times = np.rint(1e9 * rows[:, -1]).astype(np.int64)
        elif clock:
            # both parts are whole numbers below 2^53, so that the nanoseconds are exact
            times = rows[:, -2].astype(np.int64) * 10**9 + rows[:, -1].astype(np.int64)
        else:
            times = np.array(
                messages.publish_time if time == "publish_time" else messages.log_time, np.uint64
            ).astype(np.int64)[sound]
        if len(times):
            pieces.append((times, rows))
    if not pieces:
        raise ValueError(
            f"{walk.path}: no message of {topic.name} is whole and what its schema says; "
            "copy the recording again"
        )
    pieces.sort(key=lambda piece: piece[0][0])
    values = np.concatenate([rows for _, rows in pieces])
    place = f"of {topic.name}"
    return FileColumns(
        topic.name,
        np.concatenate([times for times, _ in pieces]),
        dict(zip(names, values.T, strict=False)),
        lambda i: f"message {i + 1} {place}",
    ), dropped


def _clock(path: Path, topic: Topic, time: str) -> list[str]:
    """The clock's fields: none for log_time and publish_time, one of seconds, or two of a stamp."""
    if time in ("log_time", "publish_time"):
        return []
    if time in topic.fields:
        return [time]
    for parts in STAMPS:
        if all(f"{time}.{part}" in topic.fields for part in parts):
            return [f"{time}.{part}" for part in parts]
    raise ValueError(
        f"{path}: topic {topic.name} has no time {time!r}; "
        f"{nearest_names(time, ['log_time', 'publish_time', *topic.fields])}"
    )


def _rows(decode: Decode, data: Sequence[bytes], width: int) -> tuple[np.ndarray, list[int]]:
    """Numbers (n, width) of the messages that fit their schema, and the indices of those messages."""
    try:
        return decode([plain(message) for message in data]), list(range(len(data)))
    except UnreadableMessage:
        rows, sound = [np.empty((0, width))], []
    for i, message in enumerate(data):
        try:
            rows.append(decode([plain(message)]))
            sound.append(i)
        except UnreadableMessage:
            continue
    return np.concatenate(rows), sound


# ---- frames


def frame_times(walk: Walk, topic: Topic) -> FileColumns:
    """The pictures' times in ns, the channels one behind the other in the order of their first pictures."""
    times = [time for number in walk.picture_order() for time in walk.picture_ns[number]]
    return FileColumns(
        topic.name,
        np.array(times, np.uint64).astype(np.int64),
        {},
        lambda i: f"frame {i + 1} of {topic.name}",
    )


class Frames:
    """(time_s, frame) of each picture in the order of time, frame (height, width) uint8 or uint16.

    It can be walked again and again, in the memory of a chunk; time_s (n,) is there beforehand. A picture
    that cannot be decoded is left out: `unreadable` counts those of the last walk, `notes` describes them.
    Raises ValueError if they are more than `unreadable_share` of all, and if the size changes.
    """

    def __init__(self, walk: Walk, topic: Topic, time: str, *, start_ns: int, unreadable_share: float):
        self.path, self.topic, self.unreadable = walk.path, topic.name, 0
        numbers = walk.picture_order()
        self.time_s = (frame_times(walk, topic).time - start_ns) / 1e9
        self.count = sum(walk.counts[number] for number in numbers)
        self._channels = [(number, walk.readers[number], walk.offsets[number]) for number in numbers]
        self._time, self._start_ns, self._share, self._first = time, start_ns, unreadable_share, ""

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
        """(time_s, ImageMessage) as they were recorded: encoded bytes, or rows."""
        self.unreadable, self._first = 0, ""
        with self.path.open("rb", buffering=0) as stream:
            for number, read, offsets in self._channels:
                for offset in offsets:
                    for log_time, publish_time, message in self._messages(stream, number, offset):
                        try:
                            picture = read(message)
                        except UnreadableMessage as error:
                            self._leave_out((log_time - self._start_ns) / 1e9, error)
                            continue
                        time = {"log_time": log_time, "publish_time": publish_time}.get(
                            self._time, picture.stamp_ns
                        )
                        yield (time - self._start_ns) / 1e9, picture

    def chosen(self, numbers: Collection[int]) -> Iterator[tuple[int, np.ndarray]]:
        """(number, frame) of the pictures with these numbers; only they are decoded, and one that cannot be
        decoded is left out."""
        for number, (_, picture) in enumerate(self.pictures()):
            if number in numbers:
                try:
                    yield number, gray(picture)
                except UnreadableMessage:
                    continue

    def notes(self) -> list[Note]:
        """What the last walk left out."""
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

    def _messages(self, stream: BinaryIO, number: int, offset: int) -> list[tuple[int, int, memoryview]]:
        """(log_time, publish_time, message) of the channel in the chunk or message at `offset`. The first
        walk has checked its CRC."""
        try:
            stream.seek(offset)
            head = stream.read(9)
            record = stream.read(RECORD_HEAD.unpack(head)[1])
            content = _contents(record) if head[0] == CHUNK else memoryview(head + record)
            return list(_split(content, number))
        except (struct.error, IndexError, UnicodeDecodeError, UnreadableMessage):
            raise ValueError(
                f"{self.path}: the record at byte {offset} is not what it was a moment ago; "
                "leave the file alone while it is read"
            ) from None


def _contents(record: bytes) -> memoryview:
    size, _, length = CHUNK_HEAD.unpack_from(record)[2:]
    start = CHUNK_HEAD.size + length
    method = record[CHUNK_HEAD.size : start].decode()
    return (
        memoryview(decompress(method, record[start + 8 :], size))
        if method
        else memoryview(record)[start + 8 :]
    )


def _split(content: memoryview, number: int) -> Iterator[tuple[int, int, memoryview]]:
    pos = 0
    while pos < len(content):
        length = RECORD_HEAD.unpack_from(content, pos)[1]
        if content[pos] == MESSAGE:
            _, _, channel, _, log_time, publish_time = MESSAGE_HEAD.unpack_from(content, pos)
            if channel == number:
                yield log_time, publish_time, content[pos + 31 : pos + 9 + length]
        pos += 9 + length


def image_topic(path: Path, topics: dict[str, Topic], name: str) -> Topic:
    """The topic `name`, or, if `name` is empty, the only topic with images. Raises ValueError with the topics
    that there are."""
    images = [topic for topic in topics.values() if topic.channels and all(map(is_image, topic.channels))]
    chosen = [topic for topic in images if not name or topic.name == name]
    if len(chosen) == 1:
        return chosen[0]
    if chosen:
        raise ValueError(
            f"{path}: {len(chosen)} topics have images ({', '.join(topic.name for topic in chosen)}); "
            "name the one of the nozzle's camera"
        )
    there = ", ".join(
        f"{topic.name} ({topic.channels[0].schema_name or 'no type'} in {topic.channels[0].encoding})"
        for topic in topics.values()
    )
    what = f"topic {name} with images" if name else "image topic"
    raise ValueError(
        f"{path}: there is no {what}; it has {there or 'no topic at all'}; images are read as {READABLE}"
    )
