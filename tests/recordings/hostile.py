"""Hostile and damaged recordings, made: each should be refused in one sentence, or read, within bounds of
time and memory. `FILES` is {name: what makes its bytes}; those of a great size are sparse or compress well.
"""

import gzip
import io
import json
import struct
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zstandard

from pipeline.recordings.mcap_files import MAGIC
from tests.mcap_writing import NO, Written, cdr, json_recording

HEADER_ROWS = b"time_s,heater,zone\n"
ESC, OSC, RLO, C1 = "\x1b[31m", "\x1b]0;owned\x07", "\u202e", "\x9b2J"


def good_csv(samples: int = 120, start: float = 20.0) -> bytes:
    rows = (f"{k},{20 + 20 * (k // 15 % 2)},{start + 5 * np.sin(k / 9):.3f}\n" for k in range(samples))
    return HEADER_ROWS + "".join(rows).encode()


def good_mcap(samples: int = 120, **options) -> bytes:
    """heater and zone as JSON on /machine, every chunk with its CRC."""
    made = Written(chunk_size=1024, **options)
    channel = made.topic("/machine", "json")
    for k in range(samples):
        heater = 20.0 + 20 * (k // 15 % 2)
        made.message(channel, float(k), {"heater": heater, "zone": 20 + 5 * float(np.sin(k / 9))})
    return made.bytes()


def good_parquet(samples: int = 120) -> bytes:
    """With the checksum of each page, as our own tables have it."""
    k = np.arange(samples)
    return parquet(
        {"time_s": k * 1.0, "heater": 20.0 + 20 * (k // 15 % 2), "zone": 20 + 5 * np.sin(k / 9)},
        write_page_checksum=True,
    )


def parquet(columns: dict, **options) -> bytes:
    out = io.BytesIO()
    pq.write_table(pa.table(columns), out, **options)
    return out.getvalue()


# ---- MCAP, record by record


def record(opcode: int, body: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if length is None else length) + body


def text(value: str | bytes) -> bytes:
    value = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(value)) + value


def mcap(*records: bytes) -> bytes:
    return MAGIC + record(1, text("") + text("")) + b"".join(records) + record(2, bytes(20)) + MAGIC


def chunk(method: str, content: bytes, size: int) -> bytes:
    head = struct.pack("<QQQI", 0, 0, size, 0) + text(method)
    return record(6, head + struct.pack("<Q", len(content)) + content)


def schema(number: int, name: str, encoding: str, data: bytes) -> bytes:
    return record(3, struct.pack("<H", number) + text(name) + text(encoding) + text(data))


def channel(number: int, of: int, topic: str, encoding: str) -> bytes:
    return record(4, struct.pack("<HH", number, of) + text(topic) + text(encoding) + text(b""))


def one_topic(
    encoding: str, name: str, kind: str, definition: bytes, message: bytes, count: int = 3
) -> bytes:
    made = Written(NO)
    topic = made.topic("/machine", encoding, name, kind, definition)
    for k in range(count):
        made.message(topic, float(k), message)
    return made.bytes()


def ros(definition: str, message: bytes = cdr(("d", [1.0, 2.0]))) -> bytes:
    return one_topic("cdr", "rig/State", "ros2msg", definition.encode(), message)


# ---- protobuf descriptors, by hand


def field(number: int, value: bytes | int) -> bytes:
    def varint(n: int) -> bytes:
        out = b""
        while n > 0x7F:
            out, n = out + bytes([n & 0x7F | 0x80]), n >> 7
        return out + bytes([n])

    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def descriptor(*messages: bytes) -> bytes:
    return field(1, field(2, b"rig") + b"".join(field(4, one) for one in messages) + field(12, b"proto3"))


def message_type(name: str, fields: list[tuple[str, int, int, str]]) -> bytes:
    """(name, label, type, of); label 3 is repeated, type 11 a message, 1 a double."""
    body = field(1, name.encode())
    for number, (called, label, kind, of) in enumerate(fields, 1):
        inner = field(1, called.encode()) + field(3, number) + field(4, label) + field(5, kind)
        body += field(2, inner + (field(6, f".rig.{of}".encode()) if of else b""))
    return body


def nested_descriptor(depth: int) -> bytes:
    body = field(1, b"S")
    for _ in range(depth):
        body = field(1, b"S") + field(3, body)
    return descriptor(body)


def protobuf(definition: bytes, message: bytes = field(1, b"")) -> bytes:
    return one_topic("protobuf", "rig.State", "protobuf", definition, message)


def wide_descriptor() -> bytes:
    """Six levels of ten fields each: a million numbers by their paths."""
    levels = [message_type("State", [(f"f{i}", 1, 11, "L1") for i in range(10)])]
    for level in range(1, 6):
        kind, of = (1, "") if level == 5 else (11, f"L{level + 1}")
        levels.append(message_type(f"L{level}", [(f"f{i}", 1, kind, of) for i in range(10)]))
    return descriptor(*levels)


# ---- pictures


def png_header(width: int, height: int) -> bytes:
    import zlib

    def part(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = part(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + part(b"IDAT", zlib.compress(bytes(1000))) + part(b"IEND", b"")


def jpeg_header(width: int, height: int) -> bytes:
    frame = struct.pack(">BHHB", 8, height, width, 1) + b"\x01\x11\x00"
    return b"\xff\xd8\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xd9"


def compressed_picture(data: bytes, kind: str = "png") -> bytes:
    """Messages of sensor_msgs/CompressedImage that hold a picture's bytes."""
    body = cdr(("i", [0]), ("I", [0]), ("s", ""), ("s", kind), ("I", [len(data)])) + data
    return one_topic("cdr", "sensor_msgs/msg/CompressedImage", "ros2msg", b"uint8[] data\n", body)


def raw_picture(width: int, height: int) -> bytes:
    body = cdr(("i", [0]), ("I", [0]), ("s", ""), ("I", [height, width]), ("s", "mono8"))
    return one_topic("cdr", "sensor_msgs/msg/Image", "ros2msg", b"uint8[] data\n", body + bytes(32))


# ---- what unpacks to much


def zstd_bomb(size: int) -> bytes:
    return zstandard.ZstdCompressor(level=1).compress(bytes(size))


def zstd_bomb_of_unknown_size(size: int) -> bytes:
    packer = zstandard.ZstdCompressor(level=1).compressobj()
    return b"".join(packer.compress(bytes(1 << 24)) for _ in range(size >> 24)) + packer.flush()


def lz4_bomb(size: int) -> bytes:
    return lz4.frame.compress(bytes(size), store_size=False)


def many_messages_chunk() -> bytes:
    """A chunk of a few kB that unpacks to 500 MB of empty messages."""
    empty = record(5, struct.pack("<HIQQ", 1, 0, 0, 0)) * 10_000
    size = 500_000_000 // len(empty) * len(empty)
    packer = zstandard.ZstdCompressor(level=1).compressobj()
    content = b"".join(packer.compress(empty) for _ in range(size // len(empty))) + packer.flush()
    return mcap(channel(1, 0, "/machine", "json"), chunk("zstd", content, size))


def deep_json(depth: int) -> bytes:
    return one_topic("json", "rig", "jsonschema", b"{}", b'{"a":' * depth + b"1" + b"}" * depth)


def self_referencing_json_schema() -> bytes:
    definition = {"type": "object", "properties": {"a": {"$ref": "#"}, "b": {"type": "number"}}}
    return one_topic("json", "rig", "jsonschema", json.dumps(definition).encode(), b'{"b": 1}')


def many_channels(count: int) -> bytes:
    parts = [
        schema(1 + k % 65535, "rig/State", "ros2msg", b"float64 u\n")
        + channel(k % 65536, 1 + k % 65535, f"/t{k}", "cdr")
        for k in range(count)
    ]
    return mcap(*parts)


def channels_of_one_topic() -> bytes:
    return mcap(*[channel(k, 0, "/machine", "json") for k in range(65536)])


def million_fields_json() -> bytes:
    return one_topic(
        "json", "rig", "jsonschema", b"{}", json.dumps({f"f{k}": k for k in range(300_000)}).encode()
    )


def named(name: str) -> bytes:
    """A topic and a field with control characters in their names."""
    made = Written(NO)
    topic = made.topic(f"/machine{name}", "json")
    for k in range(120):
        made.message(topic, float(k), {f"heater{name}": k % 7, f"zone{name}": 20 + k % 5})
    return made.bytes()


def lying_footer(length: int) -> bytes:
    return good_parquet()[:-8] + struct.pack("<I", length) + b"PAR1"


def run_lengths(rows: int) -> bytes:
    """Rows of one value each, run-length-encoded: some kB a column."""
    group = 1 << 24
    values = pa.DictionaryArray.from_arrays(pa.array(np.zeros(group, np.int8)), pa.array([1.0]))
    table = pa.table({"time_s": values, "heater": values, "zone": values})
    out = io.BytesIO()
    with pq.ParquetWriter(out, table.schema, compression="zstd") as writer:
        for _ in range(rows // group + 1):
            writer.write_table(table, row_group_size=group)
    return out.getvalue()


def nested_parquet(depth: int) -> bytes:
    values: pa.Array = pa.array([1.0, 2.0])
    for _ in range(depth):
        values = pa.StructArray.from_arrays([values], ["a"])
    return parquet({"time_s": [0.0, 1.0], "heater": values})


# a sparse file: what is behind the bytes costs no disk
SPARSE: dict[str, tuple[Callable[[], bytes], int]] = {
    "record_of_3_GiB.mcap": (lambda: MAGIC + struct.pack("<BQ", 8, 3 << 30), 4 << 30),
    "chunk_of_3_GiB.mcap": (
        lambda: MAGIC + struct.pack("<BQQQQIIQ", 6, (3 << 30) + 40, 0, 0, 3 << 30, 0, 0, 3 << 30),
        4 << 30,
    ),
    "zeros_of_8_GiB.csv": (good_csv, 8 << 30),
}

FILES: dict[str, Callable[[], bytes]] = {
    "ros_1e9.mcap": lambda: ros("float64[1000000000] a\nfloat64 heater\n"),
    "ros_1e30.mcap": lambda: ros(f"float64[{'9' * 30}] a\n"),
    "ros_1e5000.mcap": lambda: ros(f"float64[{'9' * 5000}] a\n"),
    "ros_text_1e9.mcap": lambda: ros("string[1000000000] a\nfloat64 heater\n"),
    "ros_nested_1e9.mcap": lambda: ros(f"A[1000000000] a\n{'=' * 80}\nMSG: rig/A\nfloat64 b\n"),
    "ros_nothing_1e9.mcap": lambda: ros(f"A[1000000000] a\n{'=' * 80}\nMSG: rig/A\nfloat64 X=1\n"),
    "ros_self.mcap": lambda: ros("State inner\nfloat64 heater\n"),
    "ros_self_sequence.mcap": lambda: ros("State[] inner\nState[] other\nfloat64 heater\n"),
    "ros_self_array.mcap": lambda: ros("State[100] inner\n"),
    "ros_doubling.mcap": lambda: ros(
        "A0 a\nA0 b\n"
        + "".join(f"{'=' * 80}\nMSG: rig/A{k}\nA{k + 1} a\nA{k + 1} b\n" for k in range(40))
        + f"{'=' * 80}\nMSG: rig/A40\nfloat64 c\n"
    ),
    "ros_many_fields.mcap": lambda: ros("".join(f"float64 f{k}\n" for k in range(300_000))),
    "ros_many_types.mcap": lambda: ros(
        "float64 a\n" + "".join(f"{'=' * 80}\nMSG: rig/A{k}\nfloat64 c\n" for k in range(100_000))
    ),
    "ros_long_line.mcap": lambda: ros("float64 " + "a" * 10_000_000),
    "ros_sequence_length.mcap": lambda: ros(
        "float64[] a\n", b"\x00\x01\x00\x00" + struct.pack("<I", 0xFFFFFFFF) + bytes(16)
    ),
    "ros_no_text.mcap": lambda: one_topic("cdr", "rig/State", "ros2msg", b"\xff\xfe\x00" * 9, bytes(20)),
    "protobuf_self.mcap": lambda: protobuf(
        descriptor(message_type("State", [("a", 1, 11, "State"), ("b", 3, 11, "State"), ("u", 1, 1, "")]))
    ),
    "protobuf_wide.mcap": lambda: protobuf(wide_descriptor()),
    "protobuf_nested.mcap": lambda: protobuf(nested_descriptor(3000)),
    "protobuf_garbage.mcap": lambda: protobuf(b"\xff" * 1000),
    "protobuf_deep_message.mcap": lambda: protobuf(
        descriptor(message_type("State", [("a", 1, 11, "State"), ("u", 1, 1, "")])), b"\x0a\x7f" * 500
    ),
    "json_deep.mcap": lambda: deep_json(100_000),
    "json_schema_self.mcap": self_referencing_json_schema,
    "json_schema_deep.mcap": lambda: one_topic(
        "json", "rig", "jsonschema", b'{"properties":{"a":' * 5000 + b"1" + b"}}" * 5000, b'{"b": 1}'
    ),
    "json_fields_3e5.mcap": million_fields_json,
    "json_number.mcap": lambda: one_topic("json", "", "", b"", b'{"heater": ' + b"9" * 100_000 + b"}"),
    "json_list.mcap": lambda: one_topic("json", "", "", b"", b'{"heater": [' + b"1," * 3_000_000 + b"1]}"),
    "message_zstd_bomb.mcap": lambda: one_topic("json", "", "", b"", zstd_bomb(900 << 20)),
    "message_zstd_unknown.mcap": lambda: one_topic("json", "", "", b"", zstd_bomb_of_unknown_size(2 << 30)),
    "message_lz4_bomb.mcap": lambda: one_topic("json", "", "", b"", lz4_bomb(1 << 30)),
    "chunk_zstd_bomb.mcap": lambda: mcap(chunk("zstd", zstd_bomb(1 << 30), 1 << 30)),
    "chunk_zstd_lies.mcap": lambda: mcap(chunk("zstd", zstd_bomb(1 << 30), 1000)),
    "chunk_lz4_bomb.mcap": lambda: mcap(chunk("lz4", lz4_bomb(1 << 30), 1 << 30)),
    "chunk_2_GiB.mcap": lambda: mcap(chunk("zstd", zstd_bomb(1000), 2 << 30)),
    "chunk_1e18.mcap": lambda: mcap(chunk("", b"", 10**18)),
    "chunk_of_messages.mcap": many_messages_chunk,
    "record_1e18.mcap": lambda: MAGIC + record(5, bytes(22), 10**18),
    "record_of_nothing.mcap": lambda: mcap(record(5, b"", 0)),
    "channels_1e6.mcap": lambda: many_channels(1_000_000),
    "channels_of_one_topic.mcap": channels_of_one_topic,
    "metadata_of_channel.mcap": lambda: mcap(
        record(4, struct.pack("<HH", 1, 0) + text("/t") + text("json") + struct.pack("<I", 0xFFFFFFFF))
    ),
    "many_chunk_starts.mcap": lambda: MAGIC + b"\x06" + b"\x06\x00" * 2_000_000,
    "png_1e5.mcap": lambda: compressed_picture(png_header(100_000, 100_000)),
    "png_3e4.mcap": lambda: compressed_picture(png_header(30_000, 30_000)),
    "jpeg_65535.mcap": lambda: compressed_picture(jpeg_header(65_535, 65_535), "jpeg"),
    "raw_1e5.mcap": lambda: raw_picture(100_000, 100_000),
    "csv_line_200_MB.csv": lambda: HEADER_ROWS + b"0," + b"1" * 200_000_000,
    "csv_commas_50_MB.csv": lambda: HEADER_ROWS + b"," * 50_000_000,
    "csv_columns_1e6.csv": lambda: (
        ",".join(f"c{k}" for k in range(1_000_000)) + "\n" + "1," * 1_000_000 + "1\n"
    ).encode(),
    "csv_quote.csv": lambda: HEADER_ROWS + b'0,1,"' + b"2\n" * 5_000_000,
    "csv_lines_alone.csv": lambda: b"\n" * 20_000_000,
    "csv_number.csv": lambda: good_csv() + b"200," + b"9" * 100_000 + b",20\n",
    "csv_far_time.csv": lambda: good_csv() + b"1e15,1,20\n",
    "csv_short_and_long.csv": lambda: HEADER_ROWS + b"0,1,20\n1e-9,1,20\n1e9,1,20\n",
    "csv_brackets.csv": lambda: b"(" * 1_000_000 + b"\n",
    "csv_digits.csv": lambda: b"1" * 60_000 + b"\n" + b"1" * 60_000 + b"\n",
    "gzip_bomb.csv.gz": lambda: gzip.compress(bytes(100 << 20)),
    "footer_2_GiB.parquet": lambda: lying_footer((2 << 30) - 1),
    "footer_of_nothing.parquet": lambda: lying_footer(0),
    "footer_longer.parquet": lambda: lying_footer(len(good_parquet()) * 2),
    "rows_1e9.parquet": lambda: run_lengths(1_000_000_000),
    "columns_2e4.parquet": lambda: parquet({f"c{k}": [1.0] for k in range(20_000)}),
    "nested.parquet": lambda: nested_parquet(400),
    "magic_alone.parquet": lambda: b"PAR1PAR1",
    "escape.mcap": lambda: named(ESC),
    "title_and_override.mcap": lambda: named(OSC + RLO + C1),
    "escape.csv": lambda: f"time_s,heater{ESC},zone{RLO}\n".encode() + good_csv().split(b"\n", 1)[1],
    "cut_in_half.mcap": lambda: json_recording(500)[: len(json_recording(500)) // 2],
}


def write(folder: Path, name: str) -> Path:
    path = folder / name
    folder.mkdir(parents=True, exist_ok=True)
    if name in SPARSE:
        content, size = SPARSE[name]
        with path.open("wb") as stream:
            stream.write(content())
            stream.truncate(size)
    else:
        path.write_bytes(FILES[name]())
    return path


def trial_frames(path: Path) -> int:
    """The count of frames that the deposition loop's reader has of a recording."""
    from pipeline.recordings.trial_files import read_trial

    return len(read_trial(path, unreadable_share=0.1).frames.time_s)
