"""One MCAP recording a deposition trial: camera frames, gantry, plunger command and, where it is simulated, the true flow; and the next trial's command.

Written as any ROS 2 or Foxglove viewer opens it: CDR with the ros2msg texts embedded, in the order of time, chunks with CRCs. Read from that form or from a machine's own
topics. Equal input gives equal bytes.
"""

import heapq
import math
import operator
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from pipeline.artifacts import beside, write_csv
from pipeline.reading import image_messages
from pipeline.reading.formats import Columns, check_clock, file_format
from pipeline.reading.image_topics import Frames, Walk, columns, frame_times, image_topic
from pipeline.reading.mcap_columns import Topic, resolve, topics
from pipeline.reading.mcap_files import McapFile
from pipeline.reading.signals import Note, Source
from pipeline.recordings import CALENDAR_S

SCHEMA, VERSION = "beadline.trial", "1"
FRAME_ID = "nozzle"
IMAGE_TOPIC = "/nozzle/image"
# what a trial has, where our own recordings have it
POSITION = Source("position_mm", "/gantry:position_mm", "mm")
SPEED = Source("speed_mm_per_s", "/gantry:speed_mm_per_s", "mm/s")
COMMAND = Source("command_mm", "/plunger:displacement_mm", "mm")
FLOW = Source("flow_mm3_per_s", "/true_flow:flow_mm3_per_s", "mm^3/s")
SOURCES = (POSITION, SPEED, COMMAND, FLOW)
_TYPES = {"/gantry": "Gantry", "/plunger": "Plunger", "/true_flow": "TrueFlow"}
# encoding -> ending and settings of cv2.imencode. A camera's frame is noise to a compressor: with one filter and runs only, a PNG of level 1
# is smaller than with a filter chosen for each row, is written in half the time and read in two thirds of it
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
        cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]  # fmt: skip
_ENCODERS = {"jpeg": (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 95]), "png": (".png", _PNG), "raw": ("", [])}


class Conditions(NamedTuple):
    """What a trial was run with, kept in the recording's metadata.

    `trial` counts from 0, `law` names what made the command. A bead w_px wide is (w_px - offset_px) / px_per_mm wide, and its section follows from the contact angle; a
    column of the image lies at gantry position + (column - nozzle_column) mm_per_px, negative where the line trails to higher columns.
    """

    material: str
    nozzle: str
    trial: int
    law: str
    speed_mm_per_s: float
    pause_s: float
    bead_area_mm2: float
    px_per_mm: float
    offset_px: float
    contact_angle_deg: float
    mm_per_px: float
    nozzle_column: float


class Trial(NamedTuple):
    """A recording as it was made: signals {name: (time_s (n,), values (n,))} on their own clocks, frames, and notes of what was damaged or left out.

    conditions is None where the recording says nothing of them.
    """

    path: str
    conditions: Conditions | None
    signals: dict[str, tuple[np.ndarray, np.ndarray]]
    frames: Frames
    notes: list[Note]


# ---- writing


def write_trial(
    path: str | Path,
    conditions: Conditions,
    frames: Iterable[tuple[float, np.ndarray]],
    *,
    time_s: np.ndarray,
    position_mm: np.ndarray,
    speed_mm_per_s: np.ndarray,
    command_mm: np.ndarray,
    flow_mm3_per_s: np.ndarray | None = None,
    encoding: str,
) -> None:
    """One recording of frames (time_s, (height, width) uint8 or uint16) and of signals (T,) at time_s (T,); frames are taken one by one, memory is that of a chunk.

    `encoding` is "jpeg" (quality 95, 8 bits only), "png" (level 1) or "raw". Raises ValueError, nothing written, for lengths that differ, values that are not finite,
    times that do not run forward, frames of changing size or kind, no frame, and frames and signals that do not overlap in time.
    """
    if encoding not in _ENCODERS:
        raise ValueError(f"{path}: the encoding should be jpeg, png or raw but is {encoding!r}; name one of them")
    signals = [(POSITION, position_mm), (SPEED, speed_mm_per_s), (COMMAND, command_mm), (FLOW, flow_mm3_per_s)]
    tables = _tables(path, time_s, [(source, values) for source, values in signals if values is not None])
    _write(path, conditions, tables, time_s, (encoding, frames))


def write_command(path: str | Path, conditions: Conditions, *, time_s: np.ndarray, command_mm: np.ndarray) -> None:
    """The next trial's command u (T,) in mm as path.csv (time_s, displacement_mm) and path.mcap; `path` has no ending. Raises ValueError as write_trial does."""
    tables = _tables(path, time_s, [(COMMAND, command_mm)])
    _write(f"{path}.mcap", conditions, tables, time_s, None)
    write_csv(f"{path}.csv", {"time_s": np.asarray(time_s, float), COMMAND.source.partition(":")[2]: np.asarray(command_mm, float)})


def read_command(path: str | Path) -> np.ndarray:
    """The command u (T,) in mm of the CSV that write_command wrote. Raises ValueError where it is none."""
    try:
        return np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)[:, 1]
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(f"{path}: expected two columns, time_s and the command in mm, found none ({error}); write it again with train_ilc") from None


def _tables(path: str | Path, time_s: np.ndarray, signals: Sequence[tuple[Source, np.ndarray]]) -> dict[str, dict[str, np.ndarray]]:
    """{topic: {field: values}}, checked."""
    time = np.asarray(time_s, float)
    tables: dict[str, dict[str, np.ndarray]] = {}
    for name, values in [("time_s", time), *((source.signal, np.asarray(values, float)) for source, values in signals)]:
        if values.shape != time.shape or time.ndim != 1 or not time.size:
            raise ValueError(f"{path}: {name} should have one value for each of {time.size} times but has shape {values.shape}")
        if not np.isfinite(values).all():
            raise ValueError(f"{path}: {name} is not finite at sample {np.flatnonzero(~np.isfinite(values))[0]}; leave that sample out")
    if time[0] < 0 or (np.diff(np.rint(time * 1e9)) <= 0).any():
        raise ValueError(
            f"{path}: time_s should run forward from 0 or later, in steps of a nanosecond or more, but does not; sort or shift it"
        )
    for source, values in signals:
        topic, _, field = source.source.partition(":")
        tables.setdefault(topic, {})[field] = np.asarray(values, float)
    return tables


def _write(path: str | Path, conditions: Conditions, tables: dict, time_s: np.ndarray, pictures: tuple[str, Iterable] | None) -> None:
    with beside(path) as temporary:
        # by its name: only artifacts opens a file to write. Chunks, summary and conditions have a CRC each; one over all of it would be summed twice
        writer = Writer(str(temporary), compression=CompressionType.NONE)
        writer.start(profile="ros2", library="beadline")
        writer.add_metadata(SCHEMA, _metadata(path, conditions))
        channels = {}
        for topic, columns in tables.items():
            text = image_messages.HEADER + "".join(f"float64 {field}\n" for field in columns) + image_messages.HEADER_TYPES
            channels[topic] = _channel(writer, topic, f"beadline_msgs/msg/{_TYPES[topic]}", text)
        streams = [_signal_messages(tables, channels, time_s)]
        if pictures:
            encoding, frames = pictures
            name, text, topic = "CompressedImage", image_messages.COMPRESSED_IMAGE, f"{IMAGE_TOPIC}/compressed"
            if encoding == "raw":
                name, text, topic = "Image", image_messages.IMAGE, IMAGE_TOPIC
            channel = _channel(writer, topic, f"sensor_msgs/msg/{name}", text)
            streams.append(_frame_messages(path, channel, encoding, frames, _span(time_s)))
        for sequence, (stamp, channel, message) in enumerate(heapq.merge(*streams, key=operator.itemgetter(0))):
            writer.add_message(channel, stamp, message, stamp, sequence)
        writer.finish()


def _channel(writer: Writer, topic: str, name: str, text: str) -> int:
    return writer.register_channel(topic, "cdr", writer.register_schema(name, "ros2msg", text.encode()))


def _signal_messages(tables: dict, channels: dict[str, int], time_s: np.ndarray) -> Iterator[tuple[int, int, bytes]]:
    stamps = np.rint(np.asarray(time_s, float) * 1e9).astype(np.int64).tolist()
    # behind the header of a message and the CDR header of four bytes numbers stand at multiples of 8
    pad = bytes(-(len(image_messages.header(0, FRAME_ID)) - 4) % 8)
    rows = {topic: np.column_stack(list(columns.values())).astype("<f8") for topic, columns in tables.items()}
    for k, stamp in enumerate(stamps):
        head = image_messages.header(stamp, FRAME_ID) + pad
        for topic, values in rows.items():
            yield stamp, channels[topic], head + values[k].tobytes()


def _frame_messages(path, channel: int, encoding: str, frames: Iterable, span: tuple[float, float]) -> Iterator[tuple[int, int, bytes]]:
    """CDR messages of the frames, each checked; at the end, whether they have anything to do with the signals' time."""
    ending, settings = _ENCODERS[encoding]
    kind, before, first = None, -1, math.nan
    for k, (time, frame) in enumerate(frames):
        stamp = round(time * 1e9) if math.isfinite(time) else -1
        if stamp <= before:
            raise ValueError(
                f"{path}: frame {k} is at {time:g} s but frames should run forward from 0 s or later; sort them or shift the time"
            )
        if frame.ndim != 2 or frame.dtype not in (np.uint8, np.uint16) or (encoding == "jpeg" and frame.dtype != np.uint8):
            wanted = "uint8" if encoding == "jpeg" else "uint8 or uint16"
            raise ValueError(f"{path}: frame {k} should be (height, width) of {wanted} but is {frame.shape} of {frame.dtype}; make it gray")
        kind = kind or (frame.shape, frame.dtype)
        if (frame.shape, frame.dtype) != kind:
            raise ValueError(f"{path}: frame {k} is {frame.shape} of {frame.dtype} but the first is {kind[0]} of {kind[1]}; write one size")
        head = image_messages.header(stamp, FRAME_ID)
        if ending:
            message = image_messages.compressed_image(head, encoding, cv2.imencode(ending, frame, settings)[1])
        else:
            message = image_messages.image(head, frame)
        before, first = stamp, time if k == 0 else first
        yield stamp, channel, message
    if before < 0:
        raise ValueError(f"{path}: a trial should have frames but there is none; give at least one")
    _check_overlap(path, (first, before / 1e9), {"signals": span})


def _metadata(path: str | Path, conditions: Conditions) -> dict[str, str]:
    wrong = [name for name, value in conditions._asdict().items() if isinstance(value, float) and not math.isfinite(value)]
    if wrong:
        raise ValueError(f"{path}: the condition {wrong[0]} is not finite; give its value")
    pairs = {"schema_version": VERSION} | {name: str(value) for name, value in conditions._asdict().items()}
    return pairs | {"crc32": _crc(pairs)}


def _crc(pairs: dict[str, str]) -> str:
    """Of all pairs: a metadata record stands outside the chunks and has no CRC of its own."""
    return f"{zlib.crc32(repr(sorted(pairs.items())).encode()):08x}"


def _check_overlap(path: str | Path, frames: tuple[float, float], others: dict[str, tuple[float, float]]) -> None:
    for name, (first, last) in others.items():
        if frames[1] < first or last < frames[0]:
            raise ValueError(
                f"{path}: the frames run from {frames[0]:.3f} to {frames[1]:.3f} s but {name} from {first:.3f} to {last:.3f} s, so they do not overlap in"
                f" time; record both on one clock"
            )


# ---- reading


def read_trial(path: str | Path, *, sources: Sequence[Source] = SOURCES, image: str = "", time: str = "", unreadable_share: float) -> Trial:
    """A trial of `write_trial`, or a machine's own recording through `sources`, which map position_mm, speed_mm_per_s, command_mm and, if there is one, flow_mm3_per_s.

    `image` names the image topic, by default the only one; `time` the clock: log_time (the default), publish_time, or the field of a stamp that every topic has, such
    as header.stamp. A clock of the calendar is counted from the record's first whole second. Raises ValueError, one sentence, where the file cannot be read, for a topic
    that is not there, and for frames and signals that do not overlap in time; what is damaged is left out and noted. At most `unreadable_share` of the frames may
    turn out not to be decodable when they are asked for.
    """
    path = Path(path)
    if not 0 <= unreadable_share <= 1:
        raise ValueError(f"{path}: unreadable_share should be within 0 and 1 but is {unreadable_share:g}; give a share of the frames")
    if file_format(path) != "mcap":
        raise ValueError(f"{path} is a table but a trial should be an MCAP recording with frames; name the recording")
    try:
        return _read(path, sources, image, time or "log_time", unreadable_share)
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror or error}); check the disk, or copy the recording again") from None


def _read(path: Path, sources: Sequence[Source], image: str, time: str, unreadable_share: float) -> Trial:
    found = topics(path)
    if not any(topic.count for topic in found.values()):
        raise ValueError(f"{path}: it has no whole message ({_damage(path)}); copy the recording again")
    camera = image_topic(path, found, image)
    places = _places(path, sources, found)
    wanted = list(dict.fromkeys(topic for topic, _ in places.values()))
    walk = Walk(path, camera, set(wanted), time)
    notes = walk.notes()
    if not walk.picture_order():
        raise ValueError(f"{path}: no picture of {camera.name} can be read ({_damage(path)}); copy the recording again")
    groups = {}
    for topic in wanted:
        fields = list(dict.fromkeys(field for at, field in places.values() if at == topic))
        groups[topic], dropped = columns(walk, found[topic], fields, time)
        if dropped:
            notes.append(Note("unreadable", "", dropped, f"{dropped} messages of {topic} are not what its schema says and were left out"))
    start_ns = _start(path, [*groups.values(), frame_times(walk, camera)], notes)
    signals = {}
    for source in sources:
        if source.source in places:
            topic, field = places[source.source]
            signals[source.signal] = ((groups[topic].time - start_ns) / 1e9, _values(path, source, groups[topic].values[field], notes))
    frames = Frames(walk, camera, time, start_ns=start_ns, unreadable_share=unreadable_share)
    _check_overlap(path, _span(frames.time_s), {name: _span(time_s) for name, (time_s, _) in signals.items()})
    first, last = _span(signals[COMMAND.signal][0])
    outside = int(np.count_nonzero((frames.time_s < first) | (frames.time_s > last)))
    if outside:
        notes.append(Note("outside", "", outside, f"{outside} of {len(frames.time_s)} frames lie before or after the command"))
    return Trial(str(path), _conditions(path, walk.metadata.get(SCHEMA, {}), notes), signals, frames, notes)


def _span(time_s: np.ndarray) -> tuple[float, float]:
    return float(time_s[0]), float(time_s[-1])


def _places(path: Path, sources: Sequence[Source], found: dict[str, Topic]) -> dict[str, tuple[str, str]]:
    """{source: (topic, field)}; only the true flow, which no machine knows, may be absent where its source is ours."""
    for needed in (POSITION, SPEED, COMMAND):
        if [source.signal for source in sources].count(needed.signal) != 1:
            raise ValueError(
                f"{path}: the mapping should give {needed.signal} one source; map the gantry's position and speed, and the command"
            )
    places = {}
    for source in sources:
        if source == FLOW and FLOW.source.partition(":")[0] not in found:
            continue
        try:
            places[source.source] = resolve(path, source.source, found)
        except ValueError as error:
            raise ValueError(f"{error}; map {source.signal} to the topic that has it") from None
    return places


def _values(path: Path, source: Source, found: np.ndarray, notes: list[Note]) -> np.ndarray:
    """In our unit; what is missing is NaN, and counted."""
    missing = int(np.count_nonzero(~np.isfinite(found)))
    if missing == len(found):
        raise ValueError(
            f"{path}: {source.source} should hold numbers for {source.signal} but all of its {missing} values are missing; map another"
        )
    if missing:
        notes.append(Note("missing", source.signal, missing, f"{missing} of {len(found)} values of {source.source} are missing"))
    return np.where(np.isfinite(found), found * source.scale + source.offset, np.nan)


def _start(path: Path, groups: Sequence[Columns], notes: list[Note]) -> int:
    """The instant in ns from which time is counted, every clock checked to run forward: 0, or the first whole second of a calendar."""
    for group in groups:
        check_clock(path, group)
    first = min(int(group.time[0]) for group in groups)
    if first <= CALENDAR_S * 1e9:
        return 0
    zero = np.datetime64(first // 10**9, "s")
    notes.append(Note("clock", "", 1, f"time is counted from {zero} (UTC, as the recording's clock says)"))
    return first // 10**9 * 10**9


def _conditions(path: Path, said: dict[str, str], notes: list[Note]) -> Conditions | None:
    if not said:
        notes.append(Note("conditions", "", 1, f"it does not say what the trial was run with: it has no whole metadata record {SCHEMA}"))
        return None
    pairs = {name: value for name, value in said.items() if name != "crc32"}
    crc = said.get("crc32")
    if crc is not None and crc != _crc(pairs):
        raise ValueError(
            f"{path}: the trial's conditions should have CRC {_crc(pairs)} but say {crc}, so they are damaged; copy the recording again"
        )
    if pairs.get("schema_version") != VERSION:
        raise ValueError(
            f"{path}: the trial's conditions have version {pairs.get('schema_version')} but {VERSION} is read; record it with this version"
        )
    kinds = Conditions.__annotations__
    try:
        return Conditions(**{name: kinds[name](pairs[name]) for name in Conditions._fields})
    except KeyError as error:
        raise ValueError(f"{path}: the trial's conditions lack {error.args[0]}; write it into the metadata record {SCHEMA}") from None
    except ValueError as error:
        raise ValueError(
            f"{path}: the trial's conditions cannot be read ({error}); write numbers into the metadata record {SCHEMA}"
        ) from None


def _damage(path: Path) -> str:
    """What reading the whole file met."""
    file = McapFile(path)
    for _ in file.batches(lambda channel: False):
        pass
    return "; ".join(note.message for note in file.notes()[:2]) or "it was closed before any message came"
