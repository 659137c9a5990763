"""Nozzle frames in MCAP, with the setpoints they were printed at: written as any ROS 2 or Foxglove viewer
opens it, and read from that form or from a machine's own topics."""

import contextlib
import hashlib
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.recordings import image_messages
from pipeline.recordings.formats import Note, Source, file_format, nearest_names
from pipeline.recordings.frame_csv import stretches
from pipeline.recordings.frame_images import concatenate
from pipeline.recordings.image_topics import Frames, Walk, image_topic
from pipeline.recordings.mcap_columns import Topic, resolve, topics
from pipeline.recordings.mcap_frames import check_overlap, damage, read_frames, span_of
from pipeline.recordings.mcap_messages import UnreadableMessage
from pipeline.store.artifacts import sha256

# the section of params.yaml with our signals' places in a recording
PLACE = "params.yaml: train_classifier.topics"
# our signals and their units; where the mapping says nothing, the only field of that name
UNITS = {
    "flow_percent": "percent",
    "temperature_degC": "degC",
    "print_id": "1",
    "tip_x_px": "px",
    "tip_y_px": "px",
    "travel_direction_deg": "deg",
}
NEEDED = ("flow_percent", "temperature_degC")
# a temperature that changes more often than this, and than in one of so many frames, is no setpoint
MEASURED = 20
# frames in memory at a time
TOGETHER = 64


class Topics(NamedTuple):
    """Where a recording has what we need: the image topic (empty: the only one), the clock (log_time,
    publish_time or a stamp's field), and the mapping {our signal: (source, unit, scale, offset)}."""

    image: str
    time: str
    mapping: Mapping[str, tuple[str, str, float, float]]

    def sources(self) -> dict[str, Source]:
        """{signal: source}. Raises ValueError for a signal that is none of ours, and for another unit."""
        for name, (_, unit, _, _) in self.mapping.items():
            if name not in UNITS:
                raise ValueError(
                    f"{PLACE}.mapping.{name} is no signal of nozzle frames; {nearest_names(name, UNITS)}"
                )
            if unit != UNITS[name]:
                raise ValueError(
                    f"{PLACE}.mapping.{name}.unit is {unit} but {name} is in {UNITS[name]}; "
                    "convert with scale and offset, "
                    f"and write unit: {UNITS[name]}"
                )
        return {
            name: Source(name, *self.mapping.get(name, (name, unit, 1.0, 0.0)))
            for name, unit in UNITS.items()
        }


class RecordedFrames(NamedTuple):
    """The n frames of a recording that can be decoded, at time_s (n,), as the front end sees them: flow in
    percent, temperature in degC and print that held at that time, NaN and empty before the first; `stretch`
    numbers those of constant settings."""

    time_s: np.ndarray
    areas: Any  # what the front end made of them
    flow: np.ndarray
    temperature: np.ndarray
    prints: list[str]
    stretch: np.ndarray
    notes: list[Note]


# ---- reading


def read_recording(
    path: Path, shown: Path, where: Topics, tip_px: tuple[float, float] | None, *, front_end: Any
) -> RecordedFrames:
    """The key areas of a recording, with the setpoints that held when each frame was taken, a few frames in
    memory at a time; `shown` is the path that is spoken of.

    The tip is `tip_px` or, where that is None, the recording's; the print is the recording's print_id, or its
    file. Raises ValueError, one sentence, where the file cannot be read, has no such topic, or has frames and
    setpoints that do not overlap in time; what is damaged is left out and noted.
    """
    try:
        return _read_recording(path, shown, where, tip_px, front_end)
    except ValueError as error:
        raise ValueError(str(error).replace(str(path), str(shown))) from None
    except OSError as error:
        # what cannot be written is said already
        if not error.strerror:
            raise
        raise ValueError(
            f"{shown} cannot be read ({error.strerror}); check the disk, or copy the recording again"
        ) from None


def open_film(
    path: Path, where: Topics
) -> tuple[Frames, dict[str, tuple[np.ndarray, np.ndarray]], list[Note]]:
    """Frames in the order of time, {signal: (time_s (n,), values (n,))} of those that the recording
    has, on one clock, and notes of what was damaged."""
    clock = where.time or "log_time"
    in_file = _topics(path)
    camera = _camera(path, in_file, where.image)
    places = {}
    for name, source in where.sources().items():
        try:
            places[name] = (source, *resolve(path, source.source, in_file))
        except ValueError as error:
            # what was mapped on purpose must be there
            if name in NEEDED or name in where.mapping:
                raise ValueError(f"{error}; map it in {PLACE}.mapping.{name}") from None
    film = read_frames(path, camera, places, in_file, clock=clock, unreadable_share=1.0)
    return film.frames, film.signals, film.notes


def frames_at(path: Path, where: Topics, places: Sequence[int]) -> dict[int, np.ndarray]:
    """{place: gray frame} of a recording's frames that can be decoded, counted from 0 in the order of time;
    the others are not kept."""
    frames, _, _ = open_film(path, where)
    wanted, found = set(places), {}
    for k, (_, frame) in enumerate(frames):
        if k in wanted:
            found[k] = np.array(frame)
            if len(found) == len(wanted):
                break
    return found


def _topics(path: Path) -> dict[str, Topic]:
    if file_format(path) != "mcap":
        raise ValueError(f"{path} is a table but should be an MCAP recording with frames; name the recording")
    return topics(path)


def _camera(path: Path, in_file: dict[str, Topic], name: str) -> Topic:
    try:
        return image_topic(path, in_file, name)
    except ValueError as error:
        raise ValueError(f"{error} ({PLACE}.image)") from None


def middle_frame(path: Path, image: str) -> np.ndarray:
    """The frame (height, width) in the middle of a recording's image topic `image`, or of its
    only one where that is empty. Raises ValueError."""
    camera = _camera(path, _topics(path), image)
    walk = Walk(path, camera, set(), "log_time")
    frames = Frames(walk, camera, "log_time", start_ns=0, unreadable_share=1.0)
    for _, picture in itertools.islice(frames.pictures(), len(frames) // 2, None):
        with contextlib.suppress(UnreadableMessage):
            return image_messages.gray(picture)
    raise ValueError(
        f"{path}: expected a picture on {camera.name}, found none that can be decoded ({damage(path)}); "
        "copy the recording again"
    )


def _read_recording(
    path: Path, shown: Path, where: Topics, tip_px: tuple[float, float] | None, front_end: Any
) -> RecordedFrames:
    frames, signals, notes = open_film(path, where)
    check_overlap(path, span_of(frames.time_s), {name: (signals[name][0][0], np.inf) for name in NEEDED})
    time_s = frames.time_s

    def find() -> Any:
        nonlocal time_s
        time_s, areas = _find_all(path, frames, signals, tip_px, front_end)
        return areas

    # of a recording with frames that cannot be decoded these are met again, and counted
    areas = front_end.remember((sha256(path), where, tip_px), len(frames), find)
    flow, temperature, number = (
        _held(signals, name, time_s) for name in ("flow_percent", "temperature_degC", "print_id")
    )
    prints = (
        [f"{value:g}" if np.isfinite(value) else "" for value in number]
        if "print_id" in signals
        else [shown.stem] * len(time_s)
    )
    settings, degrees = [flow, number], np.nan_to_num(temperature, nan=-1.0)
    if np.count_nonzero(degrees[1:] != degrees[:-1]) <= max(MEASURED, len(time_s) / MEASURED):
        settings.append(degrees)
    else:
        sentence = (
            "its temperature changes all the time, so it is measured and ends no segment; "
            "map the setpoint where there is one"
        )
        notes.append(Note("temperature", "temperature_degC", 1, sentence))
    notes = [note._replace(message=f"{shown}: {note.message}") for note in [*notes, *frames.notes()]]
    return RecordedFrames(
        time_s, areas, flow, temperature, prints, stretches(np.column_stack(settings)), notes
    )


def _find_all(
    path: Path, frames: Frames, signals: Mapping, tip_px: tuple[float, float] | None, front_end: Any
) -> tuple[np.ndarray, Any]:
    """(time_s (n,), what the front end makes of the frames), of those that can be decoded."""
    times, pieces, walking = [], [], iter(frames)
    while batch := list(itertools.islice(walking, TOGETHER)):
        time_s = np.array([time for time, _ in batch])
        tips = np.column_stack([_held(signals, name, time_s) for name in ("tip_x_px", "tip_y_px")])
        tips = tips if tip_px is None else np.broadcast_to(np.array(tip_px, float), tips.shape)
        directions = _held(signals, "travel_direction_deg", time_s)
        areas = front_end.find((frame for _, frame in batch), tips, directions)
        pieces.append(
            areas._replace(
                digests=[
                    hashlib.blake2b(np.ascontiguousarray(frame), digest_size=16).hexdigest()
                    for _, frame in batch
                ]
            )
        )
        times.append(time_s)
    if not times:
        raise ValueError(f"{path}: expected frames, found none that can be decoded; record again")
    return np.concatenate(times), concatenate(pieces)


def _held(signals: Mapping[str, tuple[np.ndarray, np.ndarray]], name: str, time_s: np.ndarray) -> np.ndarray:
    """The signal's value at each time (n,): a setpoint holds until the next; NaN
    before the first, and where there is no such signal."""
    if name not in signals:
        return np.full(len(time_s), np.nan)
    at, values = signals[name]
    last = np.searchsorted(at, time_s, side="right") - 1
    return np.where(last < 0, np.nan, values[np.maximum(last, 0)])
