"""Reads MCAP files, and ROS 2 bags made of them: the records, the topics, and the topics' numbers as columns.

Layout: mcap.dev/spec. Only whole chunks are read. Damaged ones are left out, counted and reported with their
offset. The mcap package parses the definitions. The loop over the records is our own for three reasons. The
package's readers stop at the first damage (in a file with one bad chunk in the middle they read 758 of 1500
messages, this one 1446). Its reader that uses the index reads nothing from a file that was cut off. And both
need 4 to 11 us for a message, this one 0.5 us.
"""

import contextlib
import io
import itertools
import mmap
import os
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import yaml
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode

from pipeline.recordings.csv_files import Growing
from pipeline.recordings.formats import METADATA, FileColumns, Note, nearest_names, seconds
from pipeline.recordings.messages import (
    Channel,
    Decode,
    UnreadableMessage,
    decoder,
    decompress,
    fields,
    plain,
)
from pipeline.recordings.resampling import cut_flags

MAGIC = b"\x89MCAP0\r\n"
CHUNK, MESSAGE = int(Opcode.CHUNK), int(Opcode.MESSAGE)
RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
CHUNK_HEAD = struct.Struct("<QQQII")
FOOTER_RECORD = struct.Struct("<BQQQI")
# (in a lookahead, so that a false start does not hide a true one in the bytes after it)
_CHUNK_START = re.compile(
    rb"\x06(?=(.{8}).{28}(\x00\x00\x00\x00|\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd)(.{8}))", re.DOTALL
)
# bytes, compressed or not; recorders close a chunk at 1 to 64 MB
LARGEST_CHUNK = 1 << 29
# messages outside chunks are yielded in groups of this many bytes
GROUP_BYTES = 1 << 20
# number of first messages of a channel from which its fields are found
SAMPLES = 20
# a summary may declare more messages than exist
MOST_EXPECTED = 1 << 26
# a network brings a few messages out of order; two publishers with different clocks do so all the time
OUT_OF_ORDER = 0.05
# a lost chunk's duration is ignored if it is this many times longer than that of all others together
LONGEST_CHUNK = 10
# names of the fields (seconds, nanoseconds) of a time stamp in ROS 2, Foxglove JSON, ROS 1 and protobuf
_STAMPS = (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs"), ("seconds", "nanos"))
LARGEST_METADATA = 1 << 20
# longest pause between the parts of one bag
LONGEST_PAUSE_S = 60.0
# how text-mode copying changes the magic
_CONVERSIONS = {
    b"\x89MCAP0\n": "CR LF to LF",
    b"\x89MCAP0\r\r\n": "LF to CR LF",
    b"\x89MCAP0\r\x0b": "CR LF",
    b"\x89MCAP0\r": "CR LF to CR",
}
# lengths of records that always have the same length
_LENGTHS = {Opcode.FOOTER: 20, Opcode.DATA_END: 4}
ENDS = "the file ends in it"
# kind of the note and its sentence
_REMARKS = {
    "chunk": ("damage", "the chunk or record at byte {offset} was left out with its {lost} because {reason}"),
    "summary": ("damage", "the summary at byte {start} {reason} and was not used"),
    "end": ("damage", "from byte {offset} on, where {reason}, the last {size} bytes hold no whole chunk and "
            "were left out"),
    "cut off": ("truncated", "the file breaks off: from byte {offset} on, its last {size} bytes hold no "
                "whole chunk and were left out"),
    "range": ("damage", "the chunk at byte {offset} says {first} to {last} ns but has messages from {begin} "
              "to {end} ns; its contents {checked} were kept"),
    "data": ("damage", "the data section's CRC is 0x{actual:08x} instead of 0x{expected:08x}; all chunks are "
             "whole, so it is beside them"),
    "undeclared": ("damage", "{count} messages are of channels that are declared nowhere and were left out"),
    "promised": ("damage", "the summary counts {promised} messages but {total} were found{also}"),
    "no footer": ("truncated", "the file has no footer: it was cut off or never closed; {chunks} whole "
                  "chunks and {count} messages were recovered"),
    "unchecked": ("unchecked", "{count} {what} no CRC, so damage there would not be seen"),
}  # fmt: skip


def _note(name: str, count: int = 1, **values: Any) -> Note:
    kind, sentence = _REMARKS[name]
    return Note(kind, "", count, sentence.format(count=count, **values))


class Messages(NamedTuple):
    """Messages of one channel in the order of the file. `log_time`: ns; `publish_time` (ns) and `data`: both
    lists are empty if the channel is not wanted; `offsets`: of the chunks, or of the single messages, that
    hold them."""

    log_time: list[int]
    publish_time: list[int]
    data: list[bytes]
    offsets: list[int]


# ---- records


def check_magic(path: Path, start: bytes) -> None:
    """Raises ValueError if the first 8 bytes are not MCAP's. The message names a conversion by text-mode
    copying."""
    if start[:8] == MAGIC:
        return
    expected, actual = MAGIC.hex(" "), start[:8].hex(" ")
    how = next((how for damaged, how in _CONVERSIONS.items() if start.startswith(damaged)), "")
    if how:
        raise ValueError(
            f"{path}: the bytes at offset 0 should be {expected} but are {actual}: "
            f"line ends were converted ({how}), which destroys the whole file; "
            "copy it again as binary (*.mcap binary in .gitattributes)"
        )
    raise ValueError(
        f"{path}: the bytes at offset 0 should be MCAP's {expected} but are {actual}; "
        "copy the recording again as binary"
    )


class _Whole(ReadDataStream):
    """A stream that raises EndOfFile at the end of the bytes. The package's stream returns fewer bytes than
    requested."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def _parse(kind: Any, body: bytes) -> Any:
    """Returns the package's record of a body. Raises UnreadableMessage if its lengths do not agree."""
    try:
        return kind.read(_Whole(io.BytesIO(body)))
    except (EndOfFile, UnicodeDecodeError):
        raise UnreadableMessage("the lengths in it do not agree") from None


def _split_records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yields (opcode, body) of consecutive records. Raises UnreadableMessage if a record runs over the
    end."""
    pos = 0
    while pos < len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, pos)
        if pos + 9 + length > len(data):
            raise UnreadableMessage("a record that does not fit")
        yield opcode, data[pos + 9 : pos + 9 + length]
        pos += 9 + length


def unpack_chunk(body: bytes, *, check: bool = True) -> tuple[bytes, int]:
    """Returns the bytes that hold a chunk's records, and the position in them at which the records begin. (A
    chunk that is not compressed is not copied: that would take as long as its CRC.) Raises UnreadableMessage
    if the size differs from the declared one or, with `check`, if the CRC differs."""
    _, _, size, crc, length = CHUNK_HEAD.unpack_from(body)
    start = CHUNK_HEAD.size + length + 8
    method = body[CHUNK_HEAD.size : start - 8].decode()
    if size > LARGEST_CHUNK:
        raise UnreadableMessage(f"it says that it unpacks to {size} bytes")
    content, begin = (decompress(method, body[start:], size), 0) if method else (body, start)
    if len(content) - begin != size:
        raise UnreadableMessage(f"it should hold {size} bytes but holds {len(content) - begin}")
    actual = zlib.crc32(memoryview(content)[begin:]) if crc and check else crc
    if actual != crc:
        raise UnreadableMessage(f"the CRC of its contents should be 0x{crc:08x} but is 0x{actual:08x}")
    return content, begin


def _next_chunk(stream: BinaryIO, offset: int) -> int | None:
    """Returns the offset of the next chunk from `offset` on with lengths that agree, None if there is
    none."""
    size = stream.seek(0, 2)
    if offset >= size:
        return None
    with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        for start in _CHUNK_START.finditer(content, offset):
            length, packed = (struct.unpack("<Q", start[group])[0] for group in (1, 3))
            if length == 36 + len(start[2]) + packed and start.start() + 9 + length <= size:
                return start.start()
    return None


class _Walk:
    """Reads the records of a file in order. Keeps the schemas and channels read so far, and the metadata
    records {name: {key: value}}. `offset`: offset of the first byte not yet read. If the file ends inside a
    record, a walk that `waits` stops before that record and any other walk leaves it out."""

    waits = False

    def __init__(self, path: Path) -> None:
        self.path, self.offset, self.size = path, len(MAGIC), 0
        self.schemas: dict[int, tuple[str, str, bytes]] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    def leave_out(self, offset: int, reason: str, chunk: bytes, resumed: int | None) -> None:
        """Records damage at `offset`. `reason`: why; `chunk`: the bytes of a chunk's record there that can be
        read; `resumed`: offset of the next chunk, None if there is none."""
        raise NotImplementedError

    def define(self, opcode: int, body: bytes) -> None:
        """Keeps a schema, channel or metadata record and ignores other records. Raises UnreadableMessage if a
        schema or a channel cannot be read."""
        if opcode == Opcode.SCHEMA:
            schema = _parse(records.Schema, body)
            self.schemas[schema.id] = (schema.name, schema.encoding, schema.data)
        elif opcode == Opcode.CHANNEL:
            channel = _parse(records.Channel, body)
            about = channel.id, channel.topic, channel.message_encoding, channel.metadata
            self.channels[channel.id] = Channel(*about, *self.schemas.get(channel.schema_id, ("", "", b"")))
        elif opcode == Opcode.METADATA:
            with contextlib.suppress(UnreadableMessage):  # no message is lost with it
                metadata = _parse(records.Metadata, body)
                self.metadata[metadata.name] = metadata.metadata

    def records(self, stream: BinaryIO) -> Iterator[tuple[int, int, bytes, bytes]]:
        """Yields (opcode, offset, head, body) of the records. After damage it continues at the next chunk."""
        stream.seek(self.offset)
        while self.offset < self.size:
            offset, head, body = self.offset, stream.read(9), b""
            reason = self._unsound_head(head)
            if not reason:
                opcode, length = RECORD_HEAD.unpack(head)
                body = stream.read(length)
                reason = self._unsound_body(opcode, body)
            if not reason:
                self.offset += 9 + length
                yield opcode, offset, head, body
                if opcode == Opcode.FOOTER:
                    return
                continue
            # 0: space that the recorder has reserved but not filled
            if self.waits and (reason == ENDS or head[0] == 0):
                return
            chunk = body or stream.read(CHUNK_HEAD.size) if head[0] == CHUNK else b""
            resumed = _next_chunk(stream, offset + 1)
            self.leave_out(offset, reason, chunk, resumed)
            if resumed is None:
                return
            self.offset = stream.seek(resumed)

    def _unsound_head(self, head: bytes) -> str:
        """Returns the reason why no whole record begins with this head, "" if one does."""
        if len(head) < RECORD_HEAD.size:
            return ENDS
        opcode, length = RECORD_HEAD.unpack(head)
        if opcode == 0 or 0x0F < opcode < 0x80:
            return f"a record of kind 0x{opcode:02x} begins there, which there is none of"
        if _LENGTHS.get(opcode, length) != length:
            return f"its length {length} is not that of its kind"
        if length > LARGEST_CHUNK:
            return f"its length {length} is more than the {LARGEST_CHUNK} bytes that are read at once"
        return ENDS if self.offset + 9 + length > self.size else ""

    def _unsound_body(self, opcode: int, body: bytes) -> str:
        """Returns the reason why the lengths inside a record do not agree with the record's own length, "" if
        they do. If they do not agree, the next record may begin elsewhere."""
        sound = True
        try:
            if opcode == CHUNK:
                start = CHUNK_HEAD.size + CHUNK_HEAD.unpack_from(body)[4]
                sound = len(body) == start + 8 + struct.unpack_from("<Q", body, start)[0]
            elif opcode == Opcode.MESSAGE_INDEX:
                sound = len(body) == 6 + struct.unpack_from("<I", body, 2)[0]
            elif opcode == MESSAGE:
                sound = len(body) >= 22
            else:
                self.define(opcode, body)
        except (struct.error, UnreadableMessage):
            sound = False
        return "" if sound else "the lengths in it do not agree"


class McapFile(_Walk):
    """Reads a file once and keeps its schemas, channels, counts and damage. Raises ValueError if the file is
    not MCAP."""

    def __init__(self, path: Path):
        super().__init__(path)
        self.counts: dict[int, int] = {}
        self.chunks = self.unchecked = self.unchunked = self.undeclared = 0  # chunks: the whole ones
        self.damage: dict[int, str] = {}  # {offset: reason}
        self.lost: dict[
            int, int
        ] = {}  # {offset of a damaged chunk: messages that the index behind it counts}
        self.lost_ns: list[tuple[int, int]] = []  # first and last time of the chunks that were left out
        self.span_ns: tuple[int, int] | None = None  # of the messages that were read
        self._losing: int | None = None  # the damaged chunk whose message indexes may follow
        self.remarks: list[Note] = []
        self.promised: dict[int, int] | None = None  # messages of each channel, as the summary counts them
        self.has_footer = self.verified = False  # verified: by the CRC of the whole data section
        self.summed = True  # whether the data section may have a CRC, as its last record says
        self.size = path.stat().st_size
        with path.open("rb") as stream:
            check_magic(path, stream.read(16))
            self._read_summary(stream)

    # ---- the summary: channels and schemas even of a chunk that is lost

    def _read_summary(self, stream: BinaryIO) -> None:
        end = self.size - 8 - FOOTER_RECORD.size
        if end < 8:
            return
        stream.seek(end)
        tail = stream.read()
        opcode, length, start, _, crc = FOOTER_RECORD.unpack_from(tail)
        self.has_footer = tail.endswith(MAGIC) and (opcode, length) == (Opcode.FOOTER, 20)
        if not self.has_footer:
            return
        stream.seek(max((start or end) - 13, 0))
        self.summed = not stream.read(13).startswith(RECORD_HEAD.pack(Opcode.DATA_END, 4) + bytes(4))
        if not 8 <= start <= end:
            return
        stream.seek(start)
        summary = stream.read(end - start)
        actual = zlib.crc32(summary + tail[: FOOTER_RECORD.size - 4])
        reason = f"has CRC 0x{actual:08x} instead of 0x{crc:08x}" if crc and actual != crc else ""
        try:
            for opcode, body in () if reason else _split_records(summary):
                self.define(opcode, body)
                if opcode == Opcode.STATISTICS:
                    statistics = _parse(records.Statistics, body)
                    # a writer may leave out the counts of the channels
                    if statistics.channel_message_counts or not statistics.message_count:
                        self.promised = statistics.channel_message_counts
        except (struct.error, UnreadableMessage):
            reason = "cannot be read"
        if reason:
            self.remarks.append(_note("summary", start=start, reason=reason))

    # ---- the data

    def batches(self, wanted: Callable[[Channel], bool]) -> Iterator[dict[int, Messages]]:
        """Yields {channel: Messages} for each chunk, and for each megabyte of messages outside chunks. Only
        wanted channels come with data."""
        with self.path.open("rb", buffering=1 << 16) as stream:
            crc, group, grouped = zlib.crc32(MAGIC), {}, 0
            for opcode, offset, head, record in self.records(stream):
                if opcode == Opcode.DATA_END:
                    self._check_data_crc(struct.unpack_from("<I", record)[0], crc)
                    break
                if self.summed:
                    crc = zlib.crc32(record, zlib.crc32(head, crc))
                if opcode == CHUNK:
                    batch = self._chunk(offset, record, wanted)
                    if batch is not None:
                        yield batch
                elif opcode == MESSAGE:
                    self.unchunked += 1
                    self._split(head + record, 0, offset, wanted, group)
                    grouped += len(record)
                elif opcode == Opcode.MESSAGE_INDEX and self._losing is not None:
                    self.lost[self._losing] += (len(record) - 6) // 16
                if grouped > GROUP_BYTES:
                    self._count(group)
                    yield group
                    group, grouped = {}, 0
            if group:
                self._count(group)
                yield group

    def walk(self) -> list[Note]:
        """Reads the whole file without returning messages and returns its `notes`."""
        for _ in self.batches(lambda channel: False):
            pass
        return self.notes()

    def leave_out(self, offset: int, reason: str, chunk: bytes, resumed: int | None) -> None:
        if len(chunk) >= CHUNK_HEAD.size:
            self.lost_ns.append(CHUNK_HEAD.unpack_from(chunk)[:2])
        if resumed is not None:
            self.damage[offset] = reason
        else:
            name = "end" if self.has_footer else "cut off"
            self.remarks.append(_note(name, offset=offset, reason=reason, size=self.size - offset))

    def _chunk(
        self, offset: int, record: bytes, wanted: Callable[[Channel], bool]
    ) -> dict[int, Messages] | None:
        """Returns the messages of a chunk, None if it is damaged."""
        first, last, _, crc, _ = CHUNK_HEAD.unpack_from(record)
        batch: dict[int, Messages] = {}
        try:
            content, begin = unpack_chunk(record)
            self._split(content, begin, offset, wanted, batch)
        except (UnreadableMessage, struct.error, UnicodeDecodeError) as error:
            self.leave_out(offset, str(error), record, self.offset)
            self._losing = offset
            self.lost[offset] = 0
            return None
        self._losing = None
        self.chunks += 1
        self.unchecked += not crc
        span_ns = self._count(batch) or (first, last)
        if span_ns != (first, last):
            checked = "agree with their CRC and" if crc else "have no CRC and"
            values = {"first": first, "last": last, "begin": span_ns[0], "end": span_ns[1]}
            self.remarks.append(_note("range", offset=offset, checked=checked, **values))
        return batch

    def _split(
        self,
        data: bytes,
        begin: int,
        offset: int,
        wanted: Callable[[Channel], bool],
        batch: dict[int, Messages],
    ) -> None:
        """Adds the records in data[begin:] to `batch`, by channel. They belong to the chunk or message at
        `offset`. Raises UnreadableMessage if a record runs over the end."""
        pos, end, unpack = begin, len(data), MESSAGE_HEAD.unpack_from
        current, messages, has_data = -1, Messages([], [], [], []), False
        while pos < end:
            if data[pos] != MESSAGE:
                opcode, length = RECORD_HEAD.unpack_from(data, pos)
                following = pos + 9 + length
                self.define(opcode, data[pos + 9 : following])
            else:
                _, length, number, _, log_time, publish_time = unpack(data, pos)
                following = pos + 9 + length
                if number != current:
                    current, channel = number, self.channels.get(number)
                    messages = batch.setdefault(number, Messages([], [], [], []))
                    has_data = channel is not None and wanted(channel)
                    if messages.offsets[-1:] != [offset]:
                        messages.offsets.append(offset)
                messages.log_time.append(log_time)
                if has_data:
                    messages.publish_time.append(publish_time)
                    messages.data.append(data[pos + 31 : following])
            if following > end or (data[pos] == MESSAGE and length < 22):
                raise UnreadableMessage(
                    f"a record at byte {pos - begin} of its contents has length {length} and does not fit"
                )
            pos = following

    def _count(self, batch: dict[int, Messages]) -> tuple[int, int] | None:
        """Counts the messages. Returns their first and last time, None if there are no messages."""
        times = []
        for number, messages in batch.items():
            self.counts[number] = self.counts.get(number, 0) + len(messages.log_time)
            self.undeclared += len(messages.log_time) * (number not in self.channels)
            times += [min(messages.log_time), max(messages.log_time)]
        if not times:
            return None
        self.span_ns = min(times + list(self.span_ns or ())), max(times + list(self.span_ns or ()))
        return min(times), max(times)

    def _check_data_crc(self, expected: int, actual: int) -> None:
        self.verified = bool(expected) and expected == actual
        if not expected or expected == actual or self.damage:
            return
        if self.unchunked or self.unchecked:
            raise ValueError(
                f"{self.path}: the data section's CRC should be 0x{expected:08x} but is "
                f"0x{actual:08x}, and its messages have no CRC of their own that would tell which are "
                "damaged; copy the recording again from the machine"
            )
        self.remarks.append(_note("data", actual=actual, expected=expected))

    def notes(self) -> list[Note]:
        """Returns notes on damage and how much is lost. They are complete only after all batches were
        read."""
        notes = []
        for offset, reason in self.damage.items():
            count = self.lost.get(offset)
            lost = f"{count} messages" if count else "messages, how many is not known,"
            notes.append(_note("chunk", offset=offset, lost=lost, reason=reason))
        notes += self.remarks
        if self.undeclared:
            notes.append(_note("undeclared", self.undeclared))
        total, lost = sum(self.counts.values()), sum(self.lost.values())
        promised = total + lost if self.promised is None else sum(self.promised.values())
        if promised != total + lost:
            also = f" and {lost} are lost with damaged chunks" if lost else ""
            missing = abs(promised - total - lost)
            notes.append(_note("promised", missing, promised=promised, total=total, also=also))
        if not self.has_footer:
            notes.append(_note("no footer", total, chunks=self.chunks))
        count = self.unchecked or self.unchunked
        if count and not self.verified:
            what = ("chunk" if self.unchecked else "message") + ("s" if count > 1 else "")
            where = "" if self.unchecked else " outside chunks"
            have = "have" if count > 1 else "has"
            notes.append(_note("unchecked", count, what=f"{what}{where} {have}"))
        return notes + self._cut(total, max(lost, promised - total))

    def _cut(self, total: int, lost: int) -> list[Note]:
        """Returns a note with the share of the recording that is lost: the share of its messages if the file
        counts them, otherwise the share of its time, from the heads of the lost chunks."""
        what = "messages are lost"
        if not lost and self.span_ns:
            begin_ns, end_ns = self.span_ns
            longest = LONGEST_CHUNK * (end_ns - begin_ns)
            lost_ns = [last - first for first, last in self.lost_ns if begin_ns <= first <= last]
            lost = sum(duration for duration in lost_ns if duration <= longest) // 10**6
            total, what = (end_ns - begin_ns) // 10**6, "ms are those of lost chunks"
        flags = cut_flags(lost, total + lost, what, np.nan, np.nan) if lost else []
        return [Note("cut", "", flag.count, flag.message) for flag in flags]


# ---- a file that is still being written


class Message(NamedTuple):
    """A message of a channel, with its times in ns."""

    channel: Channel
    log_time: int
    publish_time: int
    data: bytes


class GrowingMcap(_Walk):
    """Reads a file that is still being written: its whole records so far, then those that are added. A
    recorder closes a chunk about every second and writes the footer last. A record that is not yet complete
    is left for the next call. If the file was started anew, it is read from its start.

    `ended`: whether the footer was read; `damage`: sentences.
    """

    waits = True

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.damage: list[str] = []
        self.inode, self.ended = 0, False

    def leave_out(self, offset: int, reason: str, chunk: bytes, resumed: int | None) -> None:
        if resumed is not None:
            self.damage.append(f"{self.path}: the chunk or record at byte {offset} was left out ({reason})")

    def messages(self, wanted: Callable[[Channel], bool]) -> Iterator[Message]:
        """Yields the messages of wanted channels that were added since the last call. Raises
        FileNotFoundError if the file does not exist, and ValueError if it is not MCAP."""
        with self.path.open("rb", buffering=1 << 16) as stream:
            status = os.fstat(stream.fileno())
            if (self.inode and self.inode != status.st_ino) or status.st_size < min(self.offset, self.size):
                self.damage.append(f"{self.path} was begun anew after {self.offset} bytes")
                self.offset, self.ended = len(MAGIC), False
                self.schemas.clear()
                self.channels.clear()
            self.inode, self.size = status.st_ino, status.st_size
            start = stream.read(len(MAGIC))
            if MAGIC.startswith(start) and start != MAGIC:
                return
            check_magic(self.path, start)
            for opcode, offset, head, body in () if self.ended else self.records(stream):
                self.ended = opcode == Opcode.FOOTER
                try:
                    if opcode == CHUNK:
                        content, begin = unpack_chunk(body)
                        yield from self._messages(content[begin:], wanted)
                    elif opcode == MESSAGE:
                        yield from self._messages(head + body, wanted)
                except (UnreadableMessage, struct.error, UnicodeDecodeError) as error:
                    self.leave_out(offset, str(error), body, self.offset)

    def _messages(self, content: bytes, wanted: Callable[[Channel], bool]) -> Iterator[Message]:
        for opcode, body in _split_records(content):
            if opcode != MESSAGE:
                self.define(opcode, body)
                continue
            number, _, log_time, publish_time = struct.unpack_from("<HIQQ", body)
            channel = self.channels.get(number)
            if channel is not None and wanted(channel):
                yield Message(channel, log_time, publish_time, body[22:])


# ---- topics


class Topic(NamedTuple):
    """A topic: its channels, the fields that hold numbers, the reason if it cannot be read, and the number of
    its messages."""

    name: str
    channels: list[Channel]
    fields: list[str]
    unreadable: str
    count: int


def merge_topics(parts: Iterable[dict[str, Topic]]) -> dict[str, Topic]:
    """Returns the topics of all parts; a topic of several parts is merged into one."""
    union: dict[str, Topic] = {}
    for topic in itertools.chain.from_iterable(part.values() for part in parts):
        earlier = union.get(topic.name, Topic(topic.name, [], [], "", 0))
        union[topic.name] = Topic(
            topic.name,
            earlier.channels + topic.channels,
            list(dict.fromkeys([*earlier.fields, *topic.fields])),
            topic.unreadable or earlier.unreadable,
            earlier.count + topic.count,
        )
    return union


def topics(path: Path, samples: int = SAMPLES) -> dict[str, Topic]:
    """Returns the topics of a file, from its summary and the first `samples` messages of each channel.

    Raises ValueError if the file is not MCAP.
    """
    file, names, unreadable, counts = McapFile(path), {}, {}, {}

    def look(number: int, data: Sequence[bytes]) -> None:
        counts[number] = counts.get(number, 0) + len(data)
        try:
            paths = dict.fromkeys(fields(file.channels[number], data))
            names[number] = names.get(number, {}) | paths
        except (ValueError, RecursionError) as error:
            unreadable.setdefault(number, str(error))

    for batch in file.batches(lambda channel: counts.get(channel.id, 0) < samples):
        for number, messages in batch.items():
            if messages.data:
                look(number, messages.data[: samples - counts.get(number, 0)])
        promised = (file.promised or {}).items()
        if promised and all(counts.get(number, 0) >= min(samples, count) for number, count in promised):
            break
    for number in set(file.channels) - set(counts):
        look(number, [])
    # the counts are complete if every message was read; otherwise the summary's counts are used
    totals = file.counts if samples > SAMPLES else file.promised or file.counts
    return merge_topics(
        {
            channel.topic: Topic(
                channel.topic,
                [channel],
                list(names.get(number, ())),
                unreadable.get(number, ""),
                totals.get(number, 0),
            )
        }
        for number, channel in sorted(file.channels.items())
    )


def resolve(path: Path, source: str, topics: dict[str, Topic]) -> tuple[str, str]:
    """Returns (topic, field) of "/topic:field", or of a field's name alone if only one topic has it. Raises
    ValueError with the nearest names."""
    for topic in topics.values():
        if source.startswith(f"{topic.name}:"):
            field = source[len(topic.name) + 1 :]
            # a list may be longer than in the sample
            if field in topic.fields or re.sub(r"\[\d+\]", "[0]", field) in topic.fields:
                return topic.name, field
            if topic.unreadable:
                raise ValueError(f"{path}: topic {topic.name} cannot be read because {topic.unreadable}")
    having = [topic.name for topic in topics.values() if source in topic.fields]
    if len(having) == 1:
        return having[0], source
    if having:
        raise ValueError(
            f"{path}: {len(having)} topics have a field {source!r} ({', '.join(having)}); write which, "
            f"as in {having[0]}:{source}"
        )
    names = [f"{topic.name}:{field}" for topic in topics.values() for field in topic.fields]
    raise ValueError(f"{path}: no message has a number {source!r}; {nearest_names(source, names)}")


# ---- numbers


class TopicColumns:
    """The wanted numbers of topics. They grow batch by batch while their file is read.

    The clock is log_time, or publish_time, or a field of each topic such as header.stamp.
    """

    def __init__(self, file: McapFile, time: str):
        self.file, self.time = file, time
        self.fields: dict[str, list[str]] = {}
        self.clocks: dict[str, list[str]] = {}
        self.decoders: dict[int, Decode] = {}
        self.parts: dict[int, Growing] = {}
        self.bad: dict[str, int] = {}  # messages that do not fit their schema
        self.backwards: dict[str, int] = {}

    def want(self, topic: Topic, names: Sequence[str]) -> None:
        """Adds the fields `names` of a topic, and the fields of its clock: none for log_time and
        publish_time, otherwise one field in seconds or the two fields of a time stamp. Raises ValueError if
        the topic has no such clock."""
        self.fields[topic.name] = list(dict.fromkeys(names))
        candidates = [[]] if self.time in ("", "log_time", "publish_time") else [[self.time]]
        candidates += [[f"{self.time}.{part}" for part in parts] for parts in _STAMPS]
        clock = next((clock for clock in candidates if set(clock) <= set(topic.fields)), None)
        if clock is None:
            ends = tuple(f".{part}" for part, _ in _STAMPS)
            stamps = [name.rpartition(".")[0] for name in topic.fields if name.endswith(ends)]
            raise ValueError(
                f"{self.file.path}: topic {topic.name} has no time {self.time!r}; "
                f"{nearest_names(self.time, ['log_time', 'publish_time', *stamps])}"
            )
        self.clocks[topic.name] = clock

    def add(self, number: int, messages: Messages) -> None:
        """Decodes messages of a channel. Raises ValueError if the channel lacks a field, or has text instead
        of a number."""
        channel = self.file.channels.get(number)
        if channel is None or channel.topic not in self.fields or not messages.data:
            return
        topic, names, clock = channel.topic, self.fields[channel.topic], self.clocks[channel.topic]
        if number not in self.decoders:
            try:
                self.decoders[number] = decoder(channel, [*names, *clock])
            except ValueError as error:
                raise ValueError(
                    f"{self.file.path}: topic {topic} cannot be read because {error}; map another topic"
                ) from None
            expected = min((self.file.promised or {}).get(number, 0), MOST_EXPECTED)
            self.parts[number] = Growing([np.int64, *[float] * len(names)], expected)
        try:
            values, sound = _decode(self.decoders[number], messages.data, len(names) + len(clock))
        except ValueError as error:
            place = f"one of its messages from {min(messages.log_time)} to {max(messages.log_time)} ns"
            raise ValueError(f"{self.file.path}: topic {topic}, {place}: {error}") from None
        published = np.array(messages.publish_time, np.uint64).astype(np.int64)
        if clock:
            times = _stamps(clock, values[:, len(names) :])
        elif self.time == "publish_time":
            times = published[sound]
        else:
            times = np.array(messages.log_time, np.uint64).astype(np.int64)[sound]
        self.parts[number].append(times, *values[:, : len(names)].T)
        self.bad[topic] = self.bad.get(topic, 0) + len(messages.data) - len(times)
        back = int(np.count_nonzero(np.diff(published) < 0))
        self.backwards[topic] = self.backwards.get(topic, 0) + back

    def join(self, topic: str, notes: list[Note]) -> FileColumns:
        """Returns the columns of a topic, with its channels one after the other. Raises ValueError if two
        channels overlap in time, because they are two devices under one name, and if no message could be
        read."""
        path, pieces = self.file.path, []
        for number in [number for number in self.parts if self.file.channels[number].topic == topic]:
            time, *values = self.parts.pop(number).finished()
            if len(time):
                columns = dict(zip(self.fields[topic], values, strict=True))
                pieces.append(FileColumns(str(number), time, columns, str))
        if not pieces:
            bad = self.bad.get(topic)
            reason = (
                f"all of its {bad} messages are not what its schema says"
                if bad
                else "it has no whole message"
            )
            damage = "; ".join(note.message for note in notes[:2])
            raise ValueError(
                f"{path}: nothing of topic {topic} could be read because "
                f"{reason}{f' ({damage})' if damage else ''}; copy the recording again"
            )
        overlap = (
            f"topic {topic} comes from channels {{first}} and {{second}} at the same time, as if two devices "
            "had one name; record each under a topic of its own"
        )
        columns = join_parts(path, pieces, overlap)
        if len(pieces) > 1:
            message = f"topic {topic} was recorded by {len(pieces)} channels one after the other"
            notes.append(Note("channels", "", len(pieces), f"{message}, which were joined"))
        return columns._replace(name=topic, place=lambda i: f"message {i + 1} of {topic}")

    def notes(self) -> list[Note]:
        """Returns notes on the messages that do not fit their schema."""
        sentence = "{} messages of {} are not what its schema says and were left out"
        return [
            Note("unreadable", "", count, sentence.format(count, topic))
            for topic, count in self.bad.items()
            if count
        ]


def join_parts(
    path: Path,
    groups: Sequence[FileColumns],
    overlap: str = "two parts of the bag hold {first} at the same time; "
    "name the part in metadata.yaml that is to be read",
) -> FileColumns:
    """Returns one topic's columns from several parts or channels. Raises ValueError if they overlap in
    time."""
    groups = sorted(groups, key=lambda group: group.time.min())
    for first, second in itertools.pairwise(groups):
        if second.time.min() <= first.time.max():
            raise ValueError(f"{path}: {overlap.format(first=first.name, second=second.name)}")
    if len(groups) == 1:
        return groups[0]
    values = {name: np.concatenate([group.values[name] for group in groups]) for name in groups[0].values}
    return groups[0]._replace(time=np.concatenate([group.time for group in groups]), values=values)


def _stamps(clock: Sequence[str], stamps: np.ndarray) -> np.ndarray:
    """Returns the times in ns (n,) from the values of the clock's fields (n, 1 or 2)."""
    if len(clock) == 1:
        return np.rint(seconds(clock[0].rpartition(".")[2], stamps[:, 0])[0] * 1e9).astype(np.int64)
    # both parts are whole numbers below 2^53, so floats hold them and the nanoseconds are exact
    parts = stamps.astype(np.int64)
    return parts[:, 0] * 10**9 + parts[:, 1]


def _decode(decode: Decode, data: list[bytes], width: int) -> tuple[np.ndarray, slice | list[int]]:
    """Returns the numbers (n, width) of the messages that fit their schema, and the indices of these
    messages."""
    with contextlib.suppress(UnreadableMessage):
        return decode([plain(message) for message in data]), slice(None)
    rows, sound = [np.empty((0, width))], []
    for i, message in enumerate(data):
        with contextlib.suppress(UnreadableMessage):
            rows.append(decode([plain(message)]))
            sound.append(i)
    return np.concatenate(rows), sound


def _topic_counts(file: McapFile) -> dict[str, int]:
    """Returns {topic: number of messages read}."""
    counts: dict[str, int] = {}
    for number, count in file.counts.items():
        topic = file.channels[number].topic if number in file.channels else f"channel {number}"
        counts[topic] = counts.get(topic, 0) + count
    return counts


def mcap_columns(
    path: Path, sources: Sequence[str], time: str
) -> tuple[list[FileColumns], dict[str, tuple[str, str]], dict[str, int], list[Note]]:
    """Returns the columns of each topic that `sources` need, {source: (topic, field)}, {topic: number of its
    messages}, and notes.

    The clock is log_time, or publish_time, or a field of each topic such as header.stamp. Raises ValueError
    if a source does not exist, or if no message of a topic can be read.
    """
    places, by_name = _places(path, sources)
    file = McapFile(path)
    columns = TopicColumns(file, time)
    for topic in dict.fromkeys(topic for topic, _ in places.values()):
        columns.want(by_name[topic], [field for at, field in places.values() if at == topic])
    for batch in file.batches(lambda channel: channel.topic in columns.fields):
        for number, messages in batch.items():
            columns.add(number, messages)
    counts, notes = _topic_counts(file), file.notes() + columns.notes()
    for topic, count in columns.backwards.items():
        if count > OUT_OF_ORDER * counts[topic]:
            message = (
                f"the publish times of {topic} run back {count} times in {counts[topic]} messages: "
                "two devices with clocks of their own seem to publish it; "
                "record each under a topic of its own"
            )
            notes.append(Note("mixed", "", count, message))
    return [columns.join(topic, notes) for topic in columns.fields], places, counts, notes


def _places(path: Path, sources: Sequence[str]) -> tuple[dict[str, tuple[str, str]], dict[str, Topic]]:
    """Returns {source: (topic, field)} and {name: topic}."""
    by_name = topics(path)
    if not any(topic.fields for topic in by_name.values()):
        reasons = [f"{topic.name}: {topic.unreadable}" for topic in by_name.values() if topic.unreadable]
        notes = [note.message for note in McapFile(path).walk() if note.kind in ("damage", "truncated")]
        reason = "; ".join([*reasons, *notes][:3]) or "its messages hold text or nothing"
        raise ValueError(
            f"{path}: no topic with numbers could be read ({reason}); record numeric topics, "
            "or copy the recording again"
        )
    try:
        return {source: resolve(path, source, by_name) for source in sources}, by_name
    except ValueError:
        # perhaps a key that does not occur in the first JSON messages
        by_name = topics(path, MOST_EXPECTED)
        return {source: resolve(path, source, by_name) for source in sources}, by_name


class Survey(NamedTuple):
    """All topics of a file, the columns of the topics with numbers, and notes on damage and on unread
    topics."""

    topics: dict[str, Topic]
    columns: list[FileColumns]
    notes: list[Note]


def survey(path: Path, most_fields: int) -> Survey:
    """Returns the topics of a file with the first `most_fields` numbers of each, on log_time. It reads the
    first messages once and then the whole file once.

    Raises ValueError if the file is not MCAP.
    """
    by_name, file, failures = topics(path), McapFile(path), {}
    columns = TopicColumns(file, "")
    for topic in by_name.values():
        if topic.fields:
            columns.want(topic, topic.fields[:most_fields])
    for batch in file.batches(lambda channel: channel.topic in columns.fields and channel.id not in failures):
        for number, messages in batch.items():
            try:
                columns.add(number, messages)
            except ValueError as error:
                failures[number] = str(error)
                columns.parts.pop(number, None)
    counts, notes, groups = _topic_counts(file), file.notes() + columns.notes(), []
    for number, error in failures.items():
        name = file.channels[number].topic
        by_name[name] = by_name[name]._replace(unreadable=by_name[name].unreadable or error)
    by_name = {name: topic._replace(count=counts.get(name, 0)) for name, topic in by_name.items()}
    for topic in dict.fromkeys(file.channels[number].topic for number in columns.parts):
        try:
            groups.append(columns.join(topic, notes))
        except ValueError as error:
            notes.append(Note("unreadable", "", by_name[topic].count, str(error)))
    return Survey(by_name, groups, notes)


# ---- bags: a folder with metadata.yaml and one or several MCAP files, read as one recording


def bag_parts(path: Path) -> list[Path]:
    """Returns the MCAP files of a bag, in the order of its metadata.

    Raises ValueError if the metadata cannot be read, if the storage is not MCAP, or if a part is missing.
    """
    file = path / METADATA
    if file.stat().st_size > LARGEST_METADATA:
        raise ValueError(
            f"{file} has {file.stat().st_size} bytes, more than metadata has; copy the bag again"
        )
    try:
        bag = yaml.safe_load(file.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        storage, *names = [_text(text) for text in (bag["storage_identifier"], *bag["relative_file_paths"])]
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(
            f"{file}: expected rosbag2_bagfile_information with storage_identifier and relative_file_paths, "
            f"found none ({type(error).__name__}); run: ros2 bag reindex {path.name}"
        ) from None
    if storage != "mcap":
        raise ValueError(
            f"{path} is a bag in {storage} but should be in mcap; convert it with: ros2 bag convert -i "
            f"{path.name} -o out.yaml, storage_id: mcap there"
        )
    parts = [path / Path(name).name for name in names]
    for part in parts:
        if part.suffix == ".zstd":
            raise ValueError(f"{part} is packed as a whole; unpack it with: zstd -d {part.name}")
        if not part.is_file():
            raise ValueError(
                f"{part} is named in {METADATA} but missing; copy the whole folder of the bag again"
            )
    if not parts:
        raise ValueError(f"{file} names no file; run: ros2 bag reindex {path.name}")
    return parts


def _text(value: object) -> str:
    """Returns a text of the metadata. Raises TypeError for anything else, which may be of any size."""
    if not isinstance(value, str):
        raise TypeError("no text")
    return value


def read_bag(
    path: Path, sources: Sequence[str], time: str
) -> tuple[list[FileColumns], dict[str, tuple[str, str]], dict[str, int], list[Note]]:
    """Returns the same as `mcap_columns`, for all parts of a bag one after the other."""
    parts = bag_parts(path)
    by_part = [topics(part) for part in parts]
    union = merge_topics(by_part)
    places = {source: resolve(path, source, union) for source in sources}
    pieces: dict[str, list[FileColumns]] = {}
    counts: dict[str, int] = {}
    notes: list[Note] = []
    for part, names in zip(parts, by_part, strict=True):
        wanted = [
            f"{topic}:{field}" for topic, field in places.values() if topic in names and names[topic].count
        ]
        if not wanted:
            continue
        columns, _, messages, part_notes = mcap_columns(part, wanted, time)
        notes += [note._replace(message=f"{part.name}: {note.message}") for note in part_notes]
        for topic, count in messages.items():
            counts[topic] = counts.get(topic, 0) + count
        for group in columns:
            pieces.setdefault(group.name, []).append(group)
    missing = sorted({topic for topic, _ in places.values()} - set(pieces))
    if missing:
        raise ValueError(f"{path}: no part of the bag holds a message of {missing[0]}; map another topic")
    columns = [join_parts(path, groups) for groups in pieces.values()]
    return columns, places, counts, notes + _pauses(pieces)


def _pauses(pieces: dict[str, list[FileColumns]]) -> list[Note]:
    """Returns a note if two parts of a bag are farther apart in time than the two of them last. A recorder
    continues at once in the next part."""
    for topic, groups in pieces.items():
        spans = sorted((group.time[0].item(), group.time[-1].item()) for group in groups)
        for (first, end), (begin, last) in itertools.pairwise(spans):
            gap_s, lasting_s = (begin - end) / 1e9, (end - first + last - begin) / 1e9
            if gap_s > max(LONGEST_PAUSE_S, lasting_s):
                message = (
                    f"two parts hold {topic} {gap_s:.0f} s apart, longer than they last: "
                    "one of them may be of another recording"
                )
                return [Note("clock", "", len(spans), message)]
    return []
