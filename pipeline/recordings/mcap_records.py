"""The records of an MCAP file: their marks, heads and texts. Layout: mcap.dev/spec."""

import mmap
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from pipeline.recordings.mcap_messages import UnreadableMessage

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, STATISTICS, DATA_END = (
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    0x0B,
    0x0F,
)
RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
CHUNK_HEAD = struct.Struct("<QQQII")
FOOTER_RECORD = struct.Struct("<BQQQI")
_WINDOW = 1 << 26
_CHUNK_START = re.compile(
    rb"\x06(.{8}).{28}(\x00\x00\x00\x00|\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd)(.{8})", re.DOTALL
)


def check_magic(path: Path, start: bytes) -> None:
    """Raises ValueError if the first 8 bytes are not MCAP's. The message names a conversion by text-mode
    copying."""
    if start[:8] == MAGIC:
        return
    converted = {
        b"\x89MCAP0\n": "CR LF to LF",
        b"\x89MCAP0\r\r\n": "LF to CR LF",
        b"\x89MCAP0\r\x0b": "CR LF",
        b"\x89MCAP0\r": "CR LF to CR",
    }
    for damaged, how in converted.items():
        if start.startswith(damaged):
            raise ValueError(
                f"{path}: the bytes at offset 0 should be {MAGIC.hex(' ')} but are "
                f"{start[:8].hex(' ')}: line ends were converted ({how}), which destroys the whole file; "
                "copy it again as binary (*.mcap binary in .gitattributes)"
            )
    raise ValueError(
        f"{path}: the bytes at offset 0 should be MCAP's {MAGIC.hex(' ')} but are {start[:8].hex(' ')}; "
        "copy the recording again as binary"
    )


def next_chunk(stream: BinaryIO, offset: int) -> int | None:
    """Offset of the next chunk from `offset` on whose lengths agree, None if there is none."""
    size = stream.seek(0, 2)
    if offset >= size:
        return None
    with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        pos = offset
        while pos < size:
            end = min(pos // _WINDOW * _WINDOW + _WINDOW, size)
            start = _CHUNK_START.search(content, pos, min(end + 64, size))
            if start is None:
                # what was looked through need not stay in memory
                if hasattr(content, "madvise"):
                    content.madvise(
                        mmap.MADV_DONTNEED, pos // _WINDOW * _WINDOW, end - pos // _WINDOW * _WINDOW
                    )
                pos = end
                continue
            length, method, held = (
                struct.unpack("<Q", start[1])[0],
                len(start[2]),
                struct.unpack("<Q", start[3])[0],
            )
            if length == 28 + method + 8 + held and start.start() + 9 + length <= size:
                return start.start()
            pos = start.start() + 1
    return None


def records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(opcode, body) of records one behind the other. Raises UnreadableMessage for a record that runs over
    the end."""
    pos = 0
    while pos < len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, pos)
        if pos + 9 + length > len(data):
            raise UnreadableMessage("a record that does not fit")
        yield opcode, data[pos + 9 : pos + 9 + length]
        pos += 9 + length


def prefixed(data: bytes, pos: int) -> tuple[bytes, int]:
    """The bytes at `pos` behind their length (uint32), and the position of their end."""
    length = struct.unpack_from("<I", data, pos)[0]
    if pos + 4 + length > len(data):
        raise UnreadableMessage("text that does not fit")
    return data[pos + 4 : pos + 4 + length], pos + 4 + length


def string(data: bytes, pos: int) -> tuple[str, int]:
    """The text at `pos` behind its length, and the position of its end."""
    text, pos = prefixed(data, pos)
    return text.decode(), pos


def pairs(data: bytes) -> dict[str, str]:
    """A map of texts."""
    pairs, pos = {}, 0
    while pos < len(data):
        key, pos = string(data, pos)
        pairs[key], pos = string(data, pos)
    return pairs
