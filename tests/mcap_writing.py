"""MCAP recordings for tests, written with the mcap package: an encoder that is not ours."""

import io
import json
import struct
from collections.abc import Sequence

from mcap.writer import CompressionType, Writer

NO, ZSTD, LZ4 = CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4


class Written:
    """A recording in the making: `topic` declares a channel, `message` adds one, `bytes` ends it."""

    def __init__(self, compression=ZSTD, **options):
        self.stream = io.BytesIO()
        self.writer = Writer(self.stream, compression=compression, **options)
        self.writer.start("", "test")

    def topic(
        self,
        name: str,
        encoding: str,
        schema_name: str = "",
        schema_encoding: str = "",
        schema: bytes = b"",
        **metadata: str,
    ) -> int:
        number = self.writer.register_schema(schema_name, schema_encoding, schema) if schema_name else 0
        return self.writer.register_channel(name, encoding, number, metadata)

    def message(
        self, channel: int, time_s: float, data: bytes | dict, published_s: float | None = None
    ) -> None:
        data = json.dumps(data).encode() if isinstance(data, dict) else data
        self.writer.add_message(
            channel, round(time_s * 1e9), data, round((time_s if published_s is None else published_s) * 1e9)
        )

    def bytes(self) -> bytes:
        self.writer.finish()
        return self.stream.getvalue()


def json_recording(samples: int, compression=ZSTD, **options) -> bytes:
    """{"heater_1": k, "temperature_1": 20 + k / 8} on /machine at k seconds."""
    made = Written(compression, **options)
    channel = made.topic("/machine", "json")
    for k in range(samples):
        made.message(channel, float(k), {"heater_1": float(k), "temperature_1": 20 + k / 8})
    return made.bytes()


def chunks(content: bytes) -> list[tuple[int, int, int]]:
    """(offset, start of its data, end) of every chunk, read off the lengths of the records."""
    found, pos = [], 8
    while content[pos] != 0x0F:
        length = struct.unpack_from("<Q", content, pos + 1)[0]
        if content[pos] == 6:
            method = struct.unpack_from("<I", content, pos + 37)[0]
            found.append((pos, pos + 41 + method + 8, pos + 9 + length))
        pos += 9 + length
    return found


def flipped(content: bytes, place: int, bit: int) -> bytes:
    changed = bytearray(content)
    changed[place] ^= 1 << bit
    return bytes(changed)


def cdr(*parts: tuple[str, Sequence]) -> bytes:
    """Little-endian CDR of (format, values) parts, each number aligned to
    its size: written as the standard says, by hand."""
    body = b""
    for code, values in parts:
        for value in values if code != "s" else [values]:
            size = 4 if code == "s" else struct.calcsize(code)
            body += bytes(-len(body) % size)
            if code == "s":
                body += struct.pack("<I", len(value) + 1) + value.encode() + b"\0"
            else:
                body += struct.pack("<" + code, value)
    return b"\x00\x01\x00\x00" + body
