"""Columns out of an MCAP file: which topics have which numbers, and those that are wanted, a chunk at a time."""

import itertools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.reading.formats import Columns
from pipeline.reading.mcap_files import McapFile, Messages
from pipeline.reading.mcap_messages import Channel, Decode, UnreadableMessage, compressed, decoder, fields, plain
from pipeline.reading.signals import Note, nearest_names

SAMPLES = 20
# a summary may promise what is not there
MOST_EXPECTED = 1 << 26
# (seconds, nanoseconds) as the fields of a time stamp are called in ROS 2, Foxglove JSON, ROS 1 and protobuf
_STAMPS = (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs"), ("seconds", "nanos"))


class Topic(NamedTuple):
    """A topic with its channels, the numbers in its messages, or why they cannot be read, and how many messages were seen."""

    name: str
    channels: list[Channel]
    fields: list[str]
    unreadable: str
    count: int


class _Wanted(NamedTuple):
    """What is wanted of one topic: its fields, then those of its clock."""

    topic: str
    fields: list[str]
    clock: list[str]


class _Growing:
    """Times (n,) in ns and n numbers of each field, that grow in place: joining parts at the end would need twice the memory."""

    def __init__(self, fields: int, expected: int):
        self.count = 0
        self._time = np.empty(max(expected, 1), np.int64)
        self._values = [np.empty(max(expected, 1)) for _ in range(fields)]

    def append(self, time: np.ndarray, values: np.ndarray) -> None:
        end = self.count + len(time)
        if end > len(self._time):
            self._resize(end + end // 4)
        self._time[self.count : end] = time
        for column, found in zip(self._values, values.T, strict=True):
            column[self.count : end] = found
        self.count = end

    def _resize(self, size: int) -> None:
        for column in (self._time, *self._values):
            column.resize(size, refcheck=False)

    def finished(self) -> tuple[np.ndarray, list[np.ndarray]]:
        self._resize(self.count)
        return self._time, self._values


# ---- what there is


def topics(path: Path, samples: int | None = SAMPLES) -> dict[str, Topic]:
    """The topics of a file, after its summary and the first `samples` messages of each channel (None: all).

    Raises ValueError where it is no MCAP.
    """
    file = McapFile(path)
    seen: dict[int, list[bytes]] = {}
    room = samples or np.inf
    for batch in file.batches(lambda channel: len(seen.get(channel.id, ())) < room):
        for number, messages in batch.items():
            have = seen.setdefault(number, [])
            have += messages.data[: None if samples is None else samples - len(have)]
        if samples and file.promised and all(len(seen.get(number, ())) >= min(samples, count) for number, count in file.promised.items()):
            break
    counts = file.counts if samples is None or file.promised is None else file.promised
    found: dict[str, Topic] = {}
    for number, channel in sorted(file.channels.items()):
        before = found.get(channel.topic, Topic(channel.topic, [], [], "", 0))
        try:
            names, unreadable = fields(channel, seen.get(number, [])), before.unreadable
        except (ValueError, RecursionError) as error:
            names, unreadable = [], str(error)
        together = list(dict.fromkeys([*before.fields, *names]))
        found[channel.topic] = Topic(channel.topic, [*before.channels, channel], together, unreadable, before.count + counts.get(number, 0))
    return found


def resolve(path: Path, source: str, found: dict[str, Topic]) -> tuple[str, str]:
    """(topic, field) of "/topic:field", or of a field's bare name that only one topic has. Raises ValueError with the nearest names."""
    for topic in found.values():
        if source.startswith(f"{topic.name}:"):
            field = source[len(topic.name) + 1 :]
            if field in topic.fields or _element(field, topic.fields):
                return topic.name, field
            if topic.unreadable:
                raise ValueError(f"{path}: topic {topic.name} cannot be read because {topic.unreadable}")
    having = [topic.name for topic in found.values() if source in topic.fields]
    if len(having) == 1:
        return having[0], source
    if having:
        raise ValueError(
            f"{path}: {len(having)} topics have a field {source!r} ({', '.join(having)}); write which, as in {having[0]}:{source}"
        )
    names = [f"{topic.name}:{field}" for topic in found.values() for field in topic.fields]
    raise ValueError(f"{path}: no message has a number {source!r}; {nearest_names(source, names)}")


def _element(field: str, known: Sequence[str]) -> bool:
    """Whether `field` is an element of a list whose first is known: a longer one than the sample's."""
    return re.sub(r"\[\d+\]", "[0]", field) in known


# ---- reading


def mcap_columns(
    path: Path, sources: Sequence[str], time: str
) -> tuple[list[Columns], dict[str, tuple[str, str]], dict[str, int], list[Note]]:
    """The columns of each topic that `sources` need, {source: (topic, field)}, messages of each topic, and notes.

    The clock is log_time, or publish_time, or a field of each topic such as header.stamp. Raises ValueError for what is not there and for
    what has no whole chunk.
    """
    places = _places(path, sources)
    found = topics(path)
    wanted = {}
    for topic in dict.fromkeys(topic for topic, _ in places.values()):
        names = list(dict.fromkeys(field for at, field in places.values() if at == topic))
        wanted[topic] = _Wanted(topic, names, _clock(path, found[topic], time))
    file = McapFile(path)
    parts: dict[int, _Growing] = {}
    decoders: dict[int, Decode] = {}
    bad: dict[str, int] = {}
    for batch in file.batches(lambda channel: channel.topic in wanted):
        for number, messages in batch.items():
            channel = file.channels.get(number)
            if channel is None or channel.topic not in wanted or not messages.data:
                continue
            need = wanted[channel.topic]
            if number not in decoders:
                decoders[number] = _decoder(path, channel, [*need.fields, *need.clock])
                parts[number] = _Growing(len(need.fields), min((file.promised or {}).get(number, 0), MOST_EXPECTED))
            times, values, dropped = _numbers(path, channel, decoders[number], messages, need, time)
            bad[channel.topic] = bad.get(channel.topic, 0) + dropped
            parts[number].append(times, values)
    counts: dict[str, int] = {}
    for number, count in file.counts.items():
        topic = file.channels[number].topic if number in file.channels else f"channel {number}"
        counts[topic] = counts.get(topic, 0) + count
    notes = file.notes()
    for topic, count in bad.items():
        if count:
            notes.append(Note("unreadable", "", count, f"{count} messages of {topic} are not what its schema says and were left out"))
    columns = [_join(path, need, file, parts, notes, bad) for need in wanted.values()]
    return columns, places, counts, notes


def _places(path: Path, sources: Sequence[str]) -> dict[str, tuple[str, str]]:
    found = topics(path)
    if not any(topic.fields for topic in found.values()):
        reasons = [f"{topic.name}: {topic.unreadable}" for topic in found.values() if topic.unreadable]
        file = McapFile(path)
        for _ in file.batches(lambda channel: False):
            pass
        notes = [note.message for note in file.notes() if note.kind in ("damage", "truncated")]
        why = "; ".join([*reasons, *notes][:3]) or "its messages hold text or nothing"
        raise ValueError(f"{path}: no topic with numbers could be read ({why}); record numeric topics, or copy the recording again")
    try:
        return {source: resolve(path, source, found) for source in sources}
    except ValueError:
        # a key that JSON messages get later than the first ones
        found = topics(path, None)
        return {source: resolve(path, source, found) for source in sources}


def _clock(path: Path, topic: Topic, time: str) -> list[str]:
    """Fields that make the clock: none for log_time and publish_time, one of seconds, or two of a stamp."""
    if time in ("", "log_time", "publish_time"):
        return []
    if time in topic.fields:
        return [time]
    for parts in _STAMPS:
        names = [f"{time}.{part}" for part in parts]
        if all(name in topic.fields for name in names):
            return names
    known = [name.rpartition(".")[0] for name in topic.fields if name.endswith(tuple(f".{part}" for part, _ in _STAMPS))]
    raise ValueError(f"{path}: topic {topic.name} has no time {time!r}; {nearest_names(time, ['log_time', 'publish_time', *known])}")


def _decoder(path: Path, channel: Channel, names: Sequence[str]) -> Decode:
    try:
        return decoder(channel, names)
    except ValueError as error:
        raise ValueError(f"{path}: topic {channel.topic} cannot be read because {error}; map another topic") from None


def _numbers(
    path: Path, channel: Channel, decode: Decode, messages: Messages, need: _Wanted, time: str
) -> tuple[np.ndarray, np.ndarray, int]:
    """Times (n,), values (n, fields), and how many messages were no messages."""
    data, kept = messages.data, None
    try:
        data = [plain(message) for message in data] if any(map(compressed, data)) else data
        values = decode(data)
    except UnreadableMessage:
        values, kept = _one_by_one(decode, messages.data, len(need.fields) + len(need.clock))
    except ValueError as error:
        place = f"one of its messages from {min(messages.log_time)} to {max(messages.log_time)} ns"
        raise ValueError(f"{path}: topic {channel.topic}, {place}: {error}") from None
    if need.clock:
        stamp = values[:, len(need.fields) :]
        # both parts are whole numbers below 2^53, so that floats hold them and the nanoseconds are exact
        times = (
            np.rint(stamp[:, 0] * 1e9).astype(np.int64)
            if stamp.shape[1] == 1
            else stamp[:, 0].astype(np.int64) * 10**9 + stamp[:, 1].astype(np.int64)
        )
    else:
        times = np.array(messages.publish_time if time == "publish_time" else messages.log_time, np.uint64).astype(np.int64)
        times = times if kept is None else times[kept]
    return times, values[:, : len(need.fields)], 0 if kept is None else len(messages.data) - len(kept)


def _one_by_one(decode: Decode, data: Sequence[bytes], width: int) -> tuple[np.ndarray, list[int]]:
    rows, kept = [np.empty((0, width))], []
    for i, message in enumerate(data):
        try:
            rows.append(decode([plain(message)]))
            kept.append(i)
        except UnreadableMessage:
            continue
    return np.concatenate(rows), kept


def _join(path: Path, need: _Wanted, file: McapFile, parts: dict[int, _Growing], notes: list[Note], bad: dict[str, int]) -> Columns:
    """The topic's channels one behind the other; two that run at the same time are two devices under one name."""
    pieces = []
    for number in [number for number in parts if file.channels[number].topic == need.topic]:
        pieces.append((number, *parts.pop(number).finished()))
    pieces = sorted((piece for piece in pieces if len(piece[1])), key=lambda piece: piece[1].min())
    if not pieces:
        why = f"all of its {bad[need.topic]} messages are not what its schema says" if bad.get(need.topic) else "it has no whole message"
        said = "; ".join(note.message for note in notes[:2])
        raise ValueError(
            f"{path}: nothing of topic {need.topic} could be read because {why}{f' ({said})' if said else ''}; copy the recording again"
        )
    for before, after in itertools.pairwise(pieces):
        if after[1].min() <= before[1].max():
            raise ValueError(
                f"{path}: topic {need.topic} comes from channels {before[0]} and {after[0]} at the same time, as if two"
                f" devices had one name; record each"
                " under a topic of its own"
            )
    if len(pieces) > 1:
        notes.append(
            Note(
                "channels",
                "",
                len(pieces),
                f"topic {need.topic} was recorded by {len(pieces)} channels one after the other, which were joined",
            )
        )
        time = np.concatenate([piece[1] for piece in pieces])
        values = [np.concatenate(found) for found in zip(*(piece[2] for piece in pieces), strict=True)]
    else:
        _, time, values = pieces[0]
    return Columns(need.topic, time, dict(zip(need.fields, values, strict=True)), _place(need.topic))


def _place(topic: str) -> Callable[[int], str]:
    return lambda i: f"message {i + 1} of {topic}"
