"""A walk through an MCAP file, chunk by chunk, with its CRCs.

Whole chunks are read; damaged ones are left out, counted and named by their offset. (The mcap package's
reader takes 7 us a message and stops at the first damage; this one takes 3 us and goes on at the next chunk.)
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from pipeline.recordings.formats import Note
from pipeline.recordings.mcap_messages import Channel, UnreadableMessage, decompress
from pipeline.recordings.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    FOOTER,
    FOOTER_RECORD,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    RECORD_HEAD,
    SCHEMA,
    STATISTICS,
    check_magic,
    next_chunk,
    pairs,
    prefixed,
    records,
    string,
)

# packed or not; recorders close a chunk at 1 to 64 MB
LARGEST_CHUNK = 1 << 29
# messages outside chunks are handed on in groups of that many bytes
GROUP_BYTES = 1 << 20


class Messages(NamedTuple):
    """Messages of one channel in the order of the file: times in ns, and the bytes of each (none for a
    channel that is not wanted)."""

    log_time: list[int]
    publish_time: list[int]
    data: list[bytes]


class _Damage(NamedTuple):
    offset: int
    reason: str
    lost: list[int]  # one number: messages that the index behind the chunk counts


class McapFile:
    """Walks a file once and remembers schemas, channels, counts and damage. Raises ValueError for a file that
    is no MCAP."""

    def __init__(self, path: Path):
        self.path = path
        self.schemas: dict[int, tuple[str, str, bytes]] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] = {}
        self.chunks = self.unchecked = self.unchunked = self.undeclared = 0  # chunks: the whole ones
        self.damage: list[_Damage] = []
        self._losing: _Damage | None = None  # the damaged chunk whose message indexes may follow
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
        self.has_footer = tail.endswith(MAGIC) and opcode == FOOTER and length == 20
        if self.has_footer:
            stream.seek(max((start or end) - 13, 0))
            self.summed = not stream.read(13).startswith(RECORD_HEAD.pack(DATA_END, 4) + bytes(4))
        if not self.has_footer or not 8 <= start <= end:
            return
        stream.seek(start)
        summary = stream.read(end - start)
        actual = zlib.crc32(summary + tail[: FOOTER_RECORD.size - 4])
        if crc and actual != crc:
            self._remark(
                "damage",
                1,
                f"the summary at byte {start} has CRC 0x{actual:08x} instead of 0x{crc:08x} and was not used",
            )
            return
        try:
            for opcode, record in records(summary):
                self._define(opcode, record)
                if opcode == STATISTICS:
                    size = struct.unpack_from("<I", record, 42)[0]
                    self.promised = dict(struct.iter_unpack("<HQ", record[46 : 46 + size]))
                    if not self.promised and struct.unpack_from("<Q", record)[0]:
                        self.promised = None
        except (struct.error, UnicodeDecodeError, UnreadableMessage):
            self._remark("damage", 1, f"the summary at byte {start} cannot be read and was not used")

    def _remark(self, kind: str, count: int, message: str) -> None:
        self.remarks.append(Note(kind, "", count, message))

    def _define(self, opcode: int, record: bytes) -> None:
        if opcode == SCHEMA:
            number = struct.unpack_from("<H", record)[0]
            name, pos = string(record, 2)
            encoding, pos = string(record, pos)
            data, _ = prefixed(record, pos)
            self.schemas[number] = (name, encoding, data)
        elif opcode == CHANNEL:
            number, schema = struct.unpack_from("<HH", record)
            topic, pos = string(record, 4)
            encoding, pos = string(record, pos)
            metadata, _ = prefixed(record, pos)
            self.channels[number] = Channel(
                number, topic, encoding, pairs(metadata), *self.schemas.get(schema, ("", "", b""))
            )

    # ---- the data

    def batches(self, wanted: Callable[[Channel], bool]) -> Iterator[dict[int, Messages]]:
        """{channel: Messages} of each chunk, or of a megabyte of messages outside chunks. Only wanted
        channels come with data."""
        with self.path.open("rb", buffering=1 << 16) as stream:
            stream.seek(8)
            crc, group, grouped = zlib.crc32(MAGIC), {}, 0
            for opcode, offset, head, record in self._framed(stream):
                if opcode == DATA_END:
                    self._check_data_crc(struct.unpack_from("<I", record)[0] if len(record) >= 4 else 0, crc)
                    break
                if self.summed:
                    crc = zlib.crc32(record, zlib.crc32(head, crc))
                if opcode == CHUNK:
                    batch = self._chunk(offset, record, wanted)
                    if batch is not None:
                        yield self._counted(batch)
                elif opcode == MESSAGE:
                    self.unchunked += 1
                    self._split(head + record, 0, wanted, group)
                    grouped += len(record)
                elif opcode == MESSAGE_INDEX and self._losing:
                    self._losing.lost[0] += (len(record) - 6) // 16
                if grouped > GROUP_BYTES:
                    yield self._counted(group)
                    group, grouped = {}, 0
            if group:
                yield self._counted(group)

    def _framed(self, stream: BinaryIO) -> Iterator[tuple[int, int, bytes, bytes]]:
        """(opcode, offset, head, body) of the records. Behind damage it goes on at the next chunk."""
        offset = 8
        while offset < self.size:
            head = stream.read(9)
            reason, record = "the file ends in it", b""
            if len(head) == 9:
                opcode, length = RECORD_HEAD.unpack(head)
                reason = self._unsound(opcode, length, offset)
                if not reason:
                    record = stream.read(length)
                    reason = self._unsound_body(opcode, record)
                if not reason:
                    yield opcode, offset, head, record
                    if opcode == FOOTER:
                        return
                    offset += 9 + length
                    continue
            resumed = next_chunk(stream, offset + 1)
            if resumed is None:
                self._cut_off(offset, reason)
                return
            self.damage.append(_Damage(offset, reason, [0]))
            offset = resumed
            stream.seek(offset)

    def _unsound(self, opcode: int, length: int, offset: int) -> str:
        if opcode == 0 or 0x0F < opcode < 0x80:
            return f"a record of kind 0x{opcode:02x} begins there, which there is none of"
        if {FOOTER: 20, DATA_END: 4}.get(opcode, length) != length:
            return f"its length {length} is not that of its kind"
        if offset + 9 + length > self.size:
            return f"its length {length} is more than the file has left"
        if length > LARGEST_CHUNK:
            return f"its length {length} is more than the {LARGEST_CHUNK} bytes that are read at once"
        return ""

    def _unsound_body(self, opcode: int, record: bytes) -> str:
        """The reason why the lengths inside do not agree with the record's own, "" if they do. If they do
        not, the next record is not where it seems."""
        try:
            if opcode == CHUNK:
                start = CHUNK_HEAD.size + CHUNK_HEAD.unpack_from(record)[4]
                sound = len(record) == start + 8 + struct.unpack_from("<Q", record, start)[0]
            elif opcode == MESSAGE_INDEX:
                sound = len(record) == 6 + struct.unpack_from("<I", record, 2)[0]
            elif opcode == MESSAGE:
                sound = len(record) >= 22
            else:
                self._define(opcode, record)
                sound = True
        except (struct.error, UnicodeDecodeError, UnreadableMessage):
            sound = False
        return "" if sound else "the lengths in it do not agree"

    def _cut_off(self, offset: int, reason: str) -> None:
        left = self.size - offset
        if self.has_footer:
            self._remark(
                "damage",
                1,
                f"from byte {offset} on, where {reason}, the last {left} bytes hold no whole "
                "chunk and were left out",
            )
        else:
            self._remark(
                "truncated",
                1,
                f"the file breaks off: from byte {offset} on, its last {left} bytes hold no whole "
                "chunk and were left out",
            )

    def _chunk(
        self, offset: int, record: bytes, wanted: Callable[[Channel], bool]
    ) -> dict[int, Messages] | None:
        first, last, size, crc, length = CHUNK_HEAD.unpack_from(record)
        start = CHUNK_HEAD.size + length
        try:
            method, begin = record[CHUNK_HEAD.size : start].decode(), start + 8
            if size > LARGEST_CHUNK:
                raise UnreadableMessage(f"it says that it unpacks to {size} bytes")
            # what is not compressed stays where it is: copying a chunk takes as long as its CRC
            content, begin = (decompress(method, record[begin:], size), 0) if method else (record, begin)
            if len(content) - begin != size:
                raise UnreadableMessage(f"it should hold {size} bytes but holds {len(content) - begin}")
            actual = zlib.crc32(memoryview(content)[begin:]) if crc else 0
            if actual != crc:
                raise UnreadableMessage(
                    f"the CRC of its contents should be 0x{crc:08x} but is 0x{actual:08x}"
                )
            batch: dict[int, Messages] = {}
            self._split(content, begin, wanted, batch)
        except (UnreadableMessage, struct.error, UnicodeDecodeError) as error:
            self._losing = _Damage(offset, str(error), [0])
            self.damage.append(self._losing)
            return None
        self._losing = None
        self.chunks += 1
        self.unchecked += not crc
        times = [
            time for messages in batch.values() for time in (min(messages.log_time), max(messages.log_time))
        ]
        if times and (min(times), max(times)) != (first, last):
            checked = "agree with their CRC and" if crc else "have no CRC and"
            message = (
                f"the chunk at byte {offset} says {first} to {last} ns but has messages from {min(times)} to "
                f"{max(times)} ns; its contents {checked} were kept"
            )
            self._remark("damage", 1, message)
        return batch

    def _split(
        self, data: bytes, begin: int, wanted: Callable[[Channel], bool], batch: dict[int, Messages]
    ) -> None:
        """Sorts the records in data[begin:] by channel into `batch`. Raises UnreadableMessage for a record
        that runs over the end."""
        pos, end, unpack = begin, len(data), MESSAGE_HEAD.unpack_from
        current, messages, has_data = -1, None, False
        while pos < end:
            if data[pos] != MESSAGE:
                opcode, length = RECORD_HEAD.unpack_from(data, pos)
                following = pos + 9 + length
                self._define(opcode, data[pos + 9 : following])
            else:
                _, length, number, _, log_time, publish_time = unpack(data, pos)
                following = pos + 9 + length
                if number != current:
                    current, channel = number, self.channels.get(number)
                    messages = batch.setdefault(number, Messages([], [], []))
                    has_data = channel is not None and wanted(channel)
                messages.log_time.append(log_time)
                if has_data:
                    messages.publish_time.append(publish_time)
                    messages.data.append(data[pos + 31 : following])
            if following > end or (data[pos] == MESSAGE and length < 22):
                raise UnreadableMessage(
                    f"a record at byte {pos - begin} of its contents has length {length} and does not fit"
                )
            pos = following

    def _counted(self, batch: dict[int, Messages]) -> dict[int, Messages]:
        for number, messages in batch.items():
            self.counts[number] = self.counts.get(number, 0) + len(messages.log_time)
            self.undeclared += len(messages.log_time) * (number not in self.channels)
        return batch

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
        self._remark(
            "damage",
            1,
            f"the data section's CRC is 0x{actual:08x} instead of 0x{expected:08x}; all chunks are whole, "
            "so it is beside them",
        )

    # ---- notes

    def notes(self) -> list[Note]:
        """Damage and its extent. It is complete when the batches have been walked."""
        notes = []
        for damage in self.damage:
            lost = f"{damage.lost[0]} messages" if damage.lost[0] else "messages, how many is not known,"
            notes.append(
                Note(
                    "damage",
                    "",
                    1,
                    f"the chunk or record at byte {damage.offset} was left out with its {lost} "
                    f"because {damage.reason}",
                )
            )
        notes += self.remarks
        if self.undeclared:
            notes.append(
                Note(
                    "damage",
                    "",
                    self.undeclared,
                    f"{self.undeclared} messages are of channels that are declared nowhere and were left out",
                )
            )
        total, lost = sum(self.counts.values()), sum(damage.lost[0] for damage in self.damage)
        promised = total + lost if self.promised is None else sum(self.promised.values())
        if promised != total + lost:
            message = f"the summary counts {promised} messages but {total} were found"
            notes.append(
                Note(
                    "damage",
                    "",
                    abs(promised - total - lost),
                    f"{message}{f' and {lost} are lost with damaged chunks' if lost else ''}",
                )
            )
        if not self.has_footer:
            message = f"the file has no footer: it was cut off or never closed; {self.chunks} whole chunks"
            notes.append(Note("truncated", "", total, f"{message} and {total} messages were recovered"))
        if (self.unchecked or self.unchunked) and not self.verified:
            count = self.unchecked or self.unchunked
            what = ("chunk" if self.unchecked else "message") + ("s" if count > 1 else "")
            where, have = "" if self.unchecked else " outside chunks", "have" if count > 1 else "has"
            notes.append(
                Note(
                    "unchecked",
                    "",
                    count,
                    f"{count} {what}{where} {have} no CRC, so damage there would not be seen",
                )
            )
        return notes
