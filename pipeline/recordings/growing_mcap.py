"""An MCAP file while it is being written: its whole records so far, and those that come.

A recorder closes a chunk every second or so, and writes the footer last. What is not whole yet is left for
the next look; a file that was begun anew is read from its start.
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from pipeline.recordings.mcap_files import LARGEST_CHUNK
from pipeline.recordings.mcap_messages import Channel, UnreadableMessage, decompress
from pipeline.recordings.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    RECORD_HEAD,
    SCHEMA,
    check_magic,
    next_chunk,
    pairs,
    prefixed,
    records,
    string,
)

_MESSAGE = struct.Struct("<HIQQ")


class Message(NamedTuple):
    """A message of a channel, with its times in ns."""

    channel: Channel
    log_time: int
    publish_time: int
    data: bytes


class GrowingMcap:
    """What has been read of a file: `offset` of the first byte that has not, `ended` where its footer was
    met, `damage` in sentences."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[str] = []
        self._begin(None)

    def _begin(self, inode: int | None) -> None:
        self.inode, self.offset, self.ended = inode, 0, False
        self.schemas: dict[int, tuple[str, str, bytes]] = {}
        self.channels: dict[int, Channel] = {}

    def messages(self, wanted: Callable[[Channel], bool]) -> Iterator[Message]:
        """The messages that came since the last look, of wanted channels.

        Raises FileNotFoundError where there is no such file, and ValueError where it is no MCAP.
        """
        with self.path.open("rb", buffering=1 << 16) as stream:
            inode, size = self.path.stat().st_ino, stream.seek(0, 2)
            if self.inode not in (None, inode) or size < self.offset:
                self.damage.append(f"{self.path} was begun anew after {self.offset} bytes")
                self._begin(inode)
            self.inode = inode
            if self.offset == 0:
                stream.seek(0)
                start = stream.read(len(MAGIC))
                if len(start) < len(MAGIC) and MAGIC.startswith(start):
                    return
                check_magic(self.path, start)
                self.offset = len(MAGIC)
            while not self.ended and (record := self._record(stream, size)) is not None:
                yield from self._of_record(*record, wanted)

    def _record(self, stream: BinaryIO, size: int) -> tuple[int, bytes] | None:
        """The next whole record, None where none has come; behind damage the next chunk's."""
        while self.offset + RECORD_HEAD.size <= size:
            stream.seek(self.offset)
            opcode, length = RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size))
            if opcode == 0:  # room that the recorder has taken but not filled
                return None
            if opcode <= DATA_END or opcode >= 0x80:
                if length <= LARGEST_CHUNK and self.offset + RECORD_HEAD.size + length > size:
                    return None
                if length <= LARGEST_CHUNK:
                    self.offset += RECORD_HEAD.size + length
                    return opcode, stream.read(length)
            resumed = next_chunk(stream, self.offset + 1)
            if resumed is None:
                return None
            self.damage.append(f"{self.path}: bytes {self.offset} to {resumed} are no records")
            self.offset = resumed
        return None

    def _of_record(self, opcode: int, body: bytes, wanted: Callable[[Channel], bool]) -> Iterator[Message]:
        """The messages of a record outside or inside a chunk; a definition is remembered."""
        try:
            if opcode == CHUNK:
                for inner, content in records(_unpacked(body)):
                    if inner != CHUNK:
                        yield from self._of_record(inner, content, wanted)
            elif opcode == MESSAGE:
                number, _, log_time, publish_time = _MESSAGE.unpack_from(body)
                channel = self.channels.get(number)
                if channel is not None and wanted(channel):
                    yield Message(channel, log_time, publish_time, body[_MESSAGE.size :])
            elif opcode in (SCHEMA, CHANNEL):
                self._define(opcode, body)
            elif opcode == FOOTER:
                self.ended = True
        except (UnreadableMessage, struct.error, UnicodeDecodeError) as error:
            self.damage.append(f"{self.path}: a record before byte {self.offset} was left out ({error})")

    def _define(self, opcode: int, body: bytes) -> None:
        number = struct.unpack_from("<H", body)[0]
        if opcode == SCHEMA:
            name, pos = string(body, 2)
            encoding, pos = string(body, pos)
            self.schemas[number] = (name, encoding, prefixed(body, pos)[0])
            return
        schema = struct.unpack_from("<H", body, 2)[0]
        topic, pos = string(body, 4)
        encoding, pos = string(body, pos)
        metadata = pairs(prefixed(body, pos)[0])
        of_schema = self.schemas.get(schema, ("", "", b""))
        self.channels[number] = Channel(number, topic, encoding, metadata, *of_schema)


def _unpacked(body: bytes) -> bytes:
    """The records of a chunk, checked by its size and its CRC."""
    _, _, size, crc, length = CHUNK_HEAD.unpack_from(body)
    start = CHUNK_HEAD.size + length
    method, held = body[CHUNK_HEAD.size : start].decode(), struct.unpack_from("<Q", body, start)[0]
    packed = body[start + 8 :]
    if held != len(packed) or size > LARGEST_CHUNK:
        raise UnreadableMessage("the lengths in a chunk do not agree")
    content = decompress(method, packed, size) if method else packed
    if len(content) != size:
        raise UnreadableMessage(f"a chunk should hold {size} bytes but holds {len(content)}")
    if crc and zlib.crc32(content) != crc:
        raise UnreadableMessage("a chunk has another CRC than it says")
    return content
