"""Columns of an MCAP file: the topics with their numbers, and the wanted numbers a chunk at a time."""

import itertools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.recordings.formats import FileColumns, Growing, Note, nearest_names, seconds
from pipeline.recordings.mcap_files import McapFile, Messages
from pipeline.recordings.mcap_messages import (
    Channel,
    Decode,
    UnreadableMessage,
    compressed,
    decoder,
    fields,
    plain,
)

SAMPLES = 20
# a summary may promise what is not there
MOST_EXPECTED = 1 << 26
# a network brings messages out of order now and then; two publishers with clocks of their own do all the time
OUT_OF_ORDER = 0.05
# (seconds, nanoseconds) as the fields of a time stamp are called in ROS 2, Foxglove JSON, ROS 1 and protobuf
_STAMPS = (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs"), ("seconds", "nanos"))


class Topic(NamedTuple):
    """A topic: its channels, the fields with numbers, the reason if it cannot be read, and the count of its
    messages."""

    name: str
    channels: list[Channel]
    fields: list[str]
    unreadable: str
    count: int


class _Wanted(NamedTuple):
    """The fields that are wanted of one topic, and the fields of its clock."""

    topic: str
    fields: list[str]
    clock: list[str]


# ---- topics


def topics(path: Path, samples: int | None = SAMPLES) -> dict[str, Topic]:
    """The topics of a file, by its summary and the first `samples` messages of each channel (None: all).

    Raises ValueError for a file that is no MCAP.
    """
    file = McapFile(path)
    sampled: dict[int, int] = {}
    names: dict[int, dict[str, None]] = {}
    unreadable: dict[int, str] = {}
    for batch in file.batches(lambda channel: samples is None or sampled.get(channel.id, 0) < samples):
        for number, messages in batch.items():
            data = messages.data[: None if samples is None else samples - sampled.get(number, 0)]
            sampled[number] = sampled.get(number, 0) + len(data)
            if number in file.channels and data:
                _add_fields(file.channels[number], data, names, unreadable)
        if (
            samples
            and file.promised
            and all(sampled.get(number, 0) >= min(samples, count) for number, count in file.promised.items())
        ):
            break
    counts = file.counts if samples is None or file.promised is None else file.promised
    by_topic: dict[str, list[Channel]] = {}
    for number, channel in sorted(file.channels.items()):
        if number not in sampled:
            _add_fields(channel, [], names, unreadable)
        by_topic.setdefault(channel.topic, []).append(channel)
    return {
        topic: Topic(
            topic,
            channels,
            list(dict.fromkeys(field for channel in channels for field in names.get(channel.id, ()))),
            ["", *(unreadable[channel.id] for channel in channels if channel.id in unreadable)][-1],
            sum(counts.get(channel.id, 0) for channel in channels),
        )
        for topic, channels in by_topic.items()
    }


def _add_fields(
    channel: Channel, data: Sequence[bytes], names: dict[int, dict[str, None]], unreadable: dict[int, str]
) -> None:
    """Adds the fields of the messages `data` to the names of the channel, or the reason why they cannot be
    read."""
    try:
        names.setdefault(channel.id, {}).update(dict.fromkeys(fields(channel, data)))
    except (ValueError, RecursionError) as error:
        unreadable.setdefault(channel.id, str(error))


def resolve(path: Path, source: str, topics: dict[str, Topic]) -> tuple[str, str]:
    """(topic, field) of "/topic:field", or of a field's bare name that only one topic has. Raises ValueError
    with the nearest names."""
    for topic in topics.values():
        if source.startswith(f"{topic.name}:"):
            field = source[len(topic.name) + 1 :]
            if field in topic.fields or _element(field, topic.fields):
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


def _element(field: str, fields: Sequence[str]) -> bool:
    """Whether `field` is an element of a list whose first element is among the fields; the list may be longer
    than in the sample."""
    return re.sub(r"\[\d+\]", "[0]", field) in fields


# ---- reading


def mcap_columns(
    path: Path, sources: Sequence[str], time: str
) -> tuple[list[FileColumns], dict[str, tuple[str, str]], dict[str, int], list[Note]]:
    """The columns of each topic that `sources` need, {source: (topic, field)}, {topic: count of its
    messages}, and notes.

    The clock is log_time, or publish_time, or a field of each topic such as header.stamp. Raises ValueError
    for a source that is not there, and for a topic without a whole chunk.
    """
    places, by_name = _places(path, sources)
    wanted = {}
    for topic in dict.fromkeys(topic for topic, _ in places.values()):
        names = list(dict.fromkeys(field for at, field in places.values() if at == topic))
        wanted[topic] = _Wanted(topic, names, _clock(path, by_name[topic], time))
    file = McapFile(path)
    parts: dict[int, Growing] = {}
    decoders: dict[int, Decode] = {}
    bad: dict[str, int] = {}
    backwards: dict[str, int] = {}
    for batch in file.batches(lambda channel: channel.topic in wanted):
        for number, messages in batch.items():
            channel = file.channels.get(number)
            if channel is None or channel.topic not in wanted or not messages.data:
                continue
            need = wanted[channel.topic]
            if number not in decoders:
                decoders[number] = _decoder(path, channel, [*need.fields, *need.clock])
                parts[number] = Growing(
                    [np.int64, *[float] * len(need.fields)],
                    min((file.promised or {}).get(number, 0), MOST_EXPECTED),
                )
            times, values, dropped = _numbers(path, channel, decoders[number], messages, need, time)
            bad[channel.topic] = bad.get(channel.topic, 0) + dropped
            parts[number].append(times, *values.T)
            back = np.count_nonzero(np.diff(np.array(messages.publish_time, np.uint64).astype(np.int64)) < 0)
            backwards[channel.topic] = backwards.get(channel.topic, 0) + int(back)
    counts: dict[str, int] = {}
    for number, count in file.counts.items():
        topic = file.channels[number].topic if number in file.channels else f"channel {number}"
        counts[topic] = counts.get(topic, 0) + count
    notes = file.notes() + _unreadable_notes(bad) + _order_notes(backwards, counts)
    columns = [_join(path, need, file, parts, notes, bad) for need in wanted.values()]
    return columns, places, counts, notes


def _unreadable_notes(bad: dict[str, int]) -> list[Note]:
    return [
        Note(
            "unreadable",
            "",
            count,
            f"{count} messages of {topic} are not what its schema says and were left out",
        )
        for topic, count in bad.items()
        if count
    ]


def _order_notes(backwards: dict[str, int], counts: dict[str, int]) -> list[Note]:
    """A note for each topic whose publish times run back too often to be a network's doing."""
    notes = []
    for topic, count in backwards.items():
        if count > OUT_OF_ORDER * counts[topic]:
            message = (
                f"the publish times of {topic} run back {count} times in {counts[topic]} messages: "
                "two devices with clocks of their own seem to publish it; "
                "record each under a topic of its own"
            )
            notes.append(Note("mixed", "", count, message))
    return notes


def _places(path: Path, sources: Sequence[str]) -> tuple[dict[str, tuple[str, str]], dict[str, Topic]]:
    """{source: (topic, field)}, and {name: topic}."""
    by_name = topics(path)
    if not any(topic.fields for topic in by_name.values()):
        reasons = [f"{topic.name}: {topic.unreadable}" for topic in by_name.values() if topic.unreadable]
        file = McapFile(path)
        for _ in file.batches(lambda channel: False):
            pass
        notes = [note.message for note in file.notes() if note.kind in ("damage", "truncated")]
        why = "; ".join([*reasons, *notes][:3]) or "its messages hold text or nothing"
        raise ValueError(
            f"{path}: no topic with numbers could be read ({why}); record numeric topics, "
            "or copy the recording again"
        )
    try:
        return {source: resolve(path, source, by_name) for source in sources}, by_name
    except ValueError:
        # a key that JSON messages get later than the first ones
        by_name = topics(path, None)
        return {source: resolve(path, source, by_name) for source in sources}, by_name


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
    stamps = [
        name.rpartition(".")[0]
        for name in topic.fields
        if name.endswith(tuple(f".{part}" for part, _ in _STAMPS))
    ]
    raise ValueError(
        f"{path}: topic {topic.name} has no time {time!r}; "
        f"{nearest_names(time, ['log_time', 'publish_time', *stamps])}"
    )


def _decoder(path: Path, channel: Channel, names: Sequence[str]) -> Decode:
    try:
        return decoder(channel, names)
    except ValueError as error:
        raise ValueError(
            f"{path}: topic {channel.topic} cannot be read because {error}; map another topic"
        ) from None


def _numbers(
    path: Path, channel: Channel, decode: Decode, messages: Messages, need: _Wanted, time: str
) -> tuple[np.ndarray, np.ndarray, int]:
    """Times (n,), values (n, fields), and the count of messages that do not fit their schema."""
    data, sound = messages.data, None
    try:
        data = [plain(message) for message in data] if any(map(compressed, data)) else data
        values = decode(data)
    except UnreadableMessage:
        values, sound = _one_by_one(decode, messages.data, len(need.fields) + len(need.clock))
    except ValueError as error:
        place = f"one of its messages from {min(messages.log_time)} to {max(messages.log_time)} ns"
        raise ValueError(f"{path}: topic {channel.topic}, {place}: {error}") from None
    if need.clock:
        stamp = values[:, len(need.fields) :]
        # both parts are whole numbers below 2^53, so that floats hold them and the nanoseconds are exact
        times = (
            np.rint(seconds(need.clock[0].rpartition(".")[2], stamp[:, 0])[0] * 1e9).astype(np.int64)
            if stamp.shape[1] == 1
            else stamp[:, 0].astype(np.int64) * 10**9 + stamp[:, 1].astype(np.int64)
        )
    else:
        times = np.array(
            messages.publish_time if time == "publish_time" else messages.log_time, np.uint64
        ).astype(np.int64)
        times = times if sound is None else times[sound]
    return times, values[:, : len(need.fields)], 0 if sound is None else len(messages.data) - len(sound)


def _one_by_one(decode: Decode, data: Sequence[bytes], width: int) -> tuple[np.ndarray, list[int]]:
    rows, sound = [np.empty((0, width))], []
    for i, message in enumerate(data):
        try:
            rows.append(decode([plain(message)]))
            sound.append(i)
        except UnreadableMessage:
            continue
    return np.concatenate(rows), sound


def _join(
    path: Path,
    need: _Wanted,
    file: McapFile,
    parts: dict[int, Growing],
    notes: list[Note],
    bad: dict[str, int],
) -> FileColumns:
    """The topic's channels one behind the other. Two channels at the same time are two devices under one
    name, and refused."""
    pieces = []
    for number in [number for number in parts if file.channels[number].topic == need.topic]:
        time, *values = parts.pop(number).finished()
        pieces.append((number, time, values))
    pieces = sorted((piece for piece in pieces if len(piece[1])), key=lambda piece: piece[1].min())
    if not pieces:
        why = (
            f"all of its {bad[need.topic]} messages are not what its schema says"
            if bad.get(need.topic)
            else "it has no whole message"
        )
        damage = "; ".join(note.message for note in notes[:2])
        raise ValueError(
            f"{path}: nothing of topic {need.topic} could be read because "
            f"{why}{f' ({damage})' if damage else ''}; copy the recording again"
        )
    for before, after in itertools.pairwise(pieces):
        if after[1].min() <= before[1].max():
            raise ValueError(
                f"{path}: topic {need.topic} comes from channels {before[0]} and {after[0]} at the "
                "same time, as if two devices had one name; record each under a topic of its own"
            )
    if len(pieces) > 1:
        notes.append(
            Note(
                "channels",
                "",
                len(pieces),
                f"topic {need.topic} was recorded by {len(pieces)} channels one after the "
                "other, which were joined",
            )
        )
        time = np.concatenate([piece[1] for piece in pieces])
        values = [np.concatenate(arrays) for arrays in zip(*(piece[2] for piece in pieces), strict=True)]
    else:
        _, time, values = pieces[0]
    return FileColumns(need.topic, time, dict(zip(need.fields, values, strict=True)), _place(need.topic))


def _place(topic: str) -> Callable[[int], str]:
    return lambda i: f"message {i + 1} of {topic}"


# ---- everything at once


class Survey(NamedTuple):
    """Every topic of a file, the columns of those with numbers, and notes on damage and on what is unread."""

    topics: dict[str, Topic]
    columns: list[FileColumns]
    notes: list[Note]


class _Surveyed:
    """A channel while the file is walked: its first messages until there are SAMPLES, then its columns."""

    def __init__(self) -> None:
        self.waiting = Messages([], [], [])
        self.need: _Wanted | None = None
        self.decode: Decode | None = None
        self.parts: Growing | None = None


def survey(path: Path, most_fields: int) -> Survey:
    """The topics of a file with the first `most_fields` numbers of each on log_time, in one walk.

    Raises ValueError for a file that is no MCAP.
    """
    file = McapFile(path)
    channels: dict[int, _Surveyed] = {}
    names: dict[int, dict[str, None]] = {}
    unreadable: dict[int, str] = {}
    bad: dict[str, int] = {}
    for batch in file.batches(lambda channel: channel.id not in unreadable):
        for number, messages in batch.items():
            if number not in file.channels or not messages.data:
                continue
            state = channels.setdefault(number, _Surveyed())
            if state.decode is None:
                state.waiting.log_time.extend(messages.log_time)
                state.waiting.publish_time.extend(messages.publish_time)
                state.waiting.data.extend(messages.data)
                if len(state.waiting.data) < SAMPLES:
                    continue
                messages = _begin(path, file, number, channels, names, unreadable, most_fields)
            _survey_batch(path, file.channels[number], state, messages, unreadable, bad)
    for number, state in channels.items():
        if state.decode is None and number not in unreadable:
            messages = _begin(path, file, number, channels, names, unreadable, most_fields)
            _survey_batch(path, file.channels[number], state, messages, unreadable, bad)
    for number, channel in file.channels.items():
        if number not in channels:
            _add_fields(channel, [], names, unreadable)
    return _surveyed(path, file, channels, names, unreadable, bad)


def _begin(path, file: McapFile, number: int, channels, names, unreadable, most_fields: int) -> Messages:
    """The messages that waited, after their fields have been looked up."""
    channel, state = file.channels[number], channels[number]
    messages, state.waiting = state.waiting, Messages([], [], [])
    _add_fields(channel, messages.data[:SAMPLES], names, unreadable)
    shown = list(names.get(number, ()))[:most_fields]
    others = [
        other.need
        for id, other in channels.items()
        if other.need and file.channels[id].topic == channel.topic
    ]
    if number in unreadable or not shown:
        unreadable.setdefault(number, "")
        return Messages([], [], [])
    state.need = others[0] if others else _Wanted(channel.topic, shown, [])
    try:
        state.decode = decoder(channel, state.need.fields)
    except ValueError as error:
        unreadable[number] = str(error)
        return Messages([], [], [])
    expected = min((file.promised or {}).get(number, 0), MOST_EXPECTED)
    state.parts = Growing([np.int64, *[float] * len(state.need.fields)], expected)
    return messages


def _survey_batch(
    path: Path, channel: Channel, state: _Surveyed, messages: Messages, unreadable, bad: dict[str, int]
) -> None:
    if state.decode is None or state.need is None or state.parts is None or not messages.data:
        return
    try:
        times, values, dropped = _numbers(path, channel, state.decode, messages, state.need, "")
    except ValueError as error:
        unreadable[channel.id] = str(error)
        return
    bad[channel.topic] = bad.get(channel.topic, 0) + dropped
    state.parts.append(times, *values.T)


def _surveyed(
    path: Path, file: McapFile, channels: dict[int, _Surveyed], names, unreadable, bad: dict[str, int]
) -> Survey:
    by_name: dict[str, Topic] = {}
    for number, channel in sorted(file.channels.items()):
        before = by_name.get(channel.topic, Topic(channel.topic, [], [], "", 0))
        by_name[channel.topic] = Topic(
            channel.topic,
            [*before.channels, channel],
            list(dict.fromkeys([*before.fields, *names.get(number, ())])),
            unreadable.get(number, "") or before.unreadable,
            before.count + file.counts.get(number, 0),
        )
    notes = file.notes() + _unreadable_notes(bad)
    parts = {
        number: state.parts
        for number, state in channels.items()
        if state.parts is not None and number not in unreadable
    }
    needs = {
        state.need.topic: state.need for number, state in channels.items() if number in parts and state.need
    }
    columns = []
    for need in needs.values():
        try:
            columns.append(_join(path, need, file, parts, notes, bad))
        except ValueError as error:
            notes.append(Note("unreadable", "", by_name[need.topic].count, str(error)))
    return Survey(by_name, columns, notes)
