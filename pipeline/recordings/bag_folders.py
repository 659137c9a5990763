"""A ROS 2 bag: a folder with metadata.yaml and one or several MCAP files, read as one recording."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from pipeline.recordings.formats import METADATA, FileColumns, Note
from pipeline.recordings.mcap_columns import Topic, mcap_columns, resolve, topics

LARGEST_METADATA = 1 << 20
# between the parts of one recording
LONGEST_PAUSE_S = 60.0


def bag_parts(path: Path) -> list[Path]:
    """The MCAP files of a bag, in the order of its metadata.

    Raises ValueError for metadata that cannot be read, another storage, and a part that is missing.
    """
    file = path / METADATA
    if file.stat().st_size > LARGEST_METADATA:
        raise ValueError(
            f"{file} has {file.stat().st_size} bytes, more than metadata has; copy the bag again"
        )
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
        bag = content["rosbag2_bagfile_information"]
        storage, names = (
            _text(bag["storage_identifier"]),
            [_text(name) for name in bag["relative_file_paths"]],
        )
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
    """A text of the metadata. Raises TypeError for anything else, which may be as large as it likes."""
    if not isinstance(value, str):
        raise TypeError("no text")
    return value


def read_bag(
    path: Path, sources: Sequence[str], time: str
) -> tuple[list[FileColumns], dict[str, tuple[str, str]], dict[str, int], list[Note]]:
    """What `mcap_columns` gives, of all parts of a bag one behind the other."""
    parts = bag_parts(path)
    by_part = [topics(part) for part in parts]
    places = {source: resolve(path, source, merged(by_part)) for source in sources}
    pieces: dict[str, list[FileColumns]] = {}
    counts: dict[str, int] = {}
    notes: list[Note] = []
    for part, names in zip(parts, by_part, strict=True):
        wanted = [f"{topic}:{field}" for topic, field in places.values() if names.get(topic, _NONE).count]
        if not wanted:
            continue
        columns, _, messages, more = mcap_columns(part, wanted, time)
        notes += [note._replace(message=f"{part.name}: {note.message}") for note in more]
        for topic, count in messages.items():
            counts[topic] = counts.get(topic, 0) + count
        for group in columns:
            pieces.setdefault(group.name, []).append(group)
    missing = sorted({topic for topic, _ in places.values()} - set(pieces))
    if missing:
        raise ValueError(f"{path}: no part of the bag holds a message of {missing[0]}; map another topic")
    columns = [joined(path, groups) for groups in pieces.values()]
    return columns, places, counts, notes + _apart(pieces)


def _apart(pieces: dict[str, list[FileColumns]]) -> list[Note]:
    """A note where parts of a bag stand farther apart than they last: a recorder goes on at once in the next
    part."""
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


_NONE = Topic("", [], [], "", 0)


def merged(by_part: Sequence[dict[str, Topic]]) -> dict[str, Topic]:
    """The topics of all parts."""
    union: dict[str, Topic] = {}
    for topic in itertools.chain.from_iterable(part.values() for part in by_part):
        before = union.get(topic.name, Topic(topic.name, [], [], "", 0))
        union[topic.name] = Topic(
            topic.name,
            before.channels + topic.channels,
            list(dict.fromkeys([*before.fields, *topic.fields])),
            before.unreadable or topic.unreadable,
            before.count + topic.count,
        )
    return union


def joined(path: Path, groups: Sequence[FileColumns]) -> FileColumns:
    """One topic's columns of several parts. Raises ValueError for parts that overlap in time."""
    groups = sorted(groups, key=lambda group: group.time[0])
    for before, after in itertools.pairwise(groups):
        if after.time[0] <= before.time[-1]:
            raise ValueError(
                f"{path}: two parts of the bag hold {before.name} at the same time; "
                "name the part in metadata.yaml that is to be read"
            )
    values = {name: np.concatenate([g.values[name] for g in groups]) for name in groups[0].values}
    return groups[0]._replace(time=np.concatenate([group.time for group in groups]), values=values)
