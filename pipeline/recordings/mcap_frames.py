"""Frames and numeric topics of one MCAP recording: what both camera loops write and read.

Any ROS 2 or Foxglove viewer opens the file: CDR with the ros2msg texts embedded, in the order of time, chunks
with CRCs. Equal input gives equal bytes.
"""

import heapq
import math
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from pipeline.recordings import image_messages
from pipeline.recordings.formats import CALENDAR_S, FileColumns, Note, Source, check_clock
from pipeline.recordings.image_topics import Frames, Walk, columns, frame_times
from pipeline.recordings.mcap_columns import Topic
from pipeline.recordings.mcap_files import McapFile
from pipeline.store.artifacts import beside

FRAME_ID = "nozzle"
IMAGE_TOPIC = "/nozzle/image"
# encoding -> ending and settings of cv2.imencode. A camera's frame is noise to a compressor: with one filter
# and runs only, a PNG of level 1 is smaller than with a filter chosen for each row, is written in half the
# time and read in two thirds of it
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
        cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]  # fmt: skip
ENCODERS = {"jpeg": (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 95]), "png": (".png", _PNG), "raw": ("", [])}


class Recording(NamedTuple):
    """Frames in the order of time, signals {name: (time_s (n,), values (n,))} on the same clock, metadata
    {record: {key: value}}, and notes on damage."""

    frames: Frames
    signals: dict[str, tuple[np.ndarray, np.ndarray]]
    metadata: dict[str, dict[str, str]]
    notes: list[Note]


def tables_of(
    path: str | Path, time_s: np.ndarray, signals: Sequence[tuple[Source, np.ndarray]]
) -> dict[str, dict[str, np.ndarray]]:
    """{topic: {field: values}}, checked."""
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

    `tables` {topic: {field: (T,)}} are those of `tables_of`, `types` {topic: message type}, `pictures`
    (encoding, frames (time_s, (height, width))). Frames are taken one by one, so that memory is that of a
    chunk. Raises ValueError, with no file written, for an unknown encoding and for frames that
    `_frame_messages` refuses.
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
            text = (
                image_messages.HEADER
                + "".join(f"float64 {field}\n" for field in fields)
                + image_messages.HEADER_TYPES
            )
            channels[topic] = _channel(writer, topic, types[topic], text)
        streams = [_signal_messages(tables, channels, time_s)]
        if pictures:
            encoding, frames = pictures
            name, text, topic = (
                "CompressedImage",
                image_messages.COMPRESSED_IMAGE,
                f"{IMAGE_TOPIC}/compressed",
            )
            if encoding == "raw":
                name, text, topic = "Image", image_messages.IMAGE, IMAGE_TOPIC
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
    pad = bytes(-(len(image_messages.header(0, FRAME_ID)) - 4) % 8)
    rows = {topic: np.column_stack(list(columns.values())).astype("<f8") for topic, columns in tables.items()}
    for k, stamp in enumerate(stamps):
        head = image_messages.header(stamp, FRAME_ID) + pad
        for topic, values in rows.items():
            yield stamp, channels[topic], head + values[k].tobytes()


def _frame_messages(
    path, channel: int, encoding: str, frames: Iterable, span: tuple[float, float]
) -> Iterator[tuple[int, int, bytes]]:
    """CDR messages of the frames. Each frame is checked, and at the end the overlap with the signals'
    time."""
    ending, settings = ENCODERS[encoding]
    kind, before, first = None, -1, math.nan
    for k, (time, frame) in enumerate(frames):
        stamp = round(time * 1e9) if math.isfinite(time) else -1
        if stamp <= before:
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
        head = image_messages.header(stamp, FRAME_ID)
        if ending:
            message = image_messages.compressed_image(
                head, encoding, cv2.imencode(ending, frame, settings)[1]
            )
        else:
            message = image_messages.image(head, frame)
        before, first = stamp, time if k == 0 else first
        yield stamp, channel, message
    if before < 0:
        raise ValueError(f"{path}: a trial should have frames but there is none; give at least one")
    check_overlap(path, (first, before / 1e9), {"signals": span})


def read_frames(
    path: Path,
    camera: Topic,
    places: Mapping[str, tuple[Source, str, str]],
    topics_of_file: Mapping[str, Topic],
    *,
    clock: str,
    unreadable_share: float,
) -> Recording:
    """Frames of `camera` and the signals of places {signal: (source, topic, field)}.

    Raises ValueError if no picture can be read, or if a clock runs backwards.
    """
    topics = list(dict.fromkeys(topic for _, topic, _ in places.values()))
    walk = Walk(path, camera, set(topics), clock)
    notes = walk.notes()
    if not walk.picture_order():
        raise ValueError(
            f"{path}: no picture of {camera.name} can be read ({damage(path)}); copy the recording again"
        )
    groups: dict[str, FileColumns] = {}
    for topic in topics:
        fields = list(dict.fromkeys(field for _, at, field in places.values() if at == topic))
        groups[topic], dropped = columns(walk, topics_of_file[topic], fields, clock)
        if dropped:
            notes.append(
                Note(
                    "unreadable",
                    "",
                    dropped,
                    f"{dropped} messages of {topic} are not what its schema says and were left out",
                )
            )
    start_ns = _start(path, [*groups.values(), frame_times(walk, camera)], notes)
    signals = {
        name: (
            (groups[topic].time - start_ns) / 1e9,
            _values(path, source, groups[topic].values[field], notes),
        )
        for name, (source, topic, field) in places.items()
    }
    return Recording(
        Frames(walk, camera, clock, start_ns=start_ns, unreadable_share=unreadable_share),
        signals,
        walk.metadata,
        notes,
    )


# ---- what both check


def check_overlap(
    path: str | Path, frames: tuple[float, float], others: dict[str, tuple[float, float]]
) -> None:
    for name, (first, last) in others.items():
        if frames[1] < first or last < frames[0]:
            raise ValueError(
                f"{path}: the frames run from {frames[0]:.3f} to {frames[1]:.3f} s but {name} from "
                f"{first:.3f} to {last:.3f} s, so they do not overlap in time; record both on one clock"
            )


def span_of(time_s: np.ndarray) -> tuple[float, float]:
    return float(time_s[0]), float(time_s[-1])


def _values(path: Path, source: Source, recorded: np.ndarray, notes: list[Note]) -> np.ndarray:
    """The recorded values in the signal's unit. A missing value is NaN, and counted."""
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
    """The instant in ns from which time is counted: 0, or the first whole second of a calendar.

    Every clock is checked to run forward.
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
    """The damage that reading the whole file meets, in words."""
    file = McapFile(path)
    for _ in file.batches(lambda channel: False):
        pass
    return "; ".join(note.message for note in file.notes()[:2]) or "it was closed before any message came"
