"""What the frames of a trial say before any flow is worked out: the bead's width in every frame, and how late
the camera is. A recording is read once: its readings are kept under a hash of its bytes, of the camera's
settings and of the code that reads.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import joblib
import numpy as np

from pipeline.deposition.camera import bead, latency, line
from pipeline.deposition.camera.latency import Gantry, Latency
from pipeline.deposition.workflow import trial_files
from pipeline.deposition.workflow.settings import Camera
from pipeline.reading import image_messages
from pipeline.reading.image_topics import Frames, Walk, image_topic
from pipeline.reading.mcap_columns import topics
from pipeline.reading.signals import Source
from pipeline.store import artifacts
from pipeline.store.tables import BYTES, FLOAT, NONE, TEXT, Column, Schema

MEMO = Path("datasets/memo/train_ilc")
# the code that decides what an entry of the memo holds
HERE = Path(__file__).resolve().parents[2]
CODE = (
    "deposition/workflow/trial_readings.py", "deposition/workflow/trial_files.py",
    "deposition/bead.py", "deposition/edges.py", "deposition/line.py", "deposition/latency.py",
    "store/mcap_frames.py", "reading/image_messages.py", "reading/image_topics.py",
)  # fmt: skip
READINGS = Schema(
    "trial_readings",
    1,
    (
        Column("time_s", FLOAT, "s", "of the frame, as stamped"),
        Column("reason", TEXT, NONE, "why the frame has no usable bead; empty where it has"),
        Column("columns", BYTES, "px", "measured columns, 64-bit floats"),
        Column("widths", BYTES, "px", "widths there, 64-bit floats; 0 bare, NaN unread"),
        Column("latency_s", FLOAT, "s", "how late the frames are against the gantry, of the whole recording"),
        Column("latency_deviation_s", FLOAT, "s", "its standard deviation; missing: not told", nullable=True),
    ),
)
# frames measured together
TOGETHER = 16
# readings along the line and bands across it, from which the pictures' motion is told: px of one reading
STEP_PX, BANDS = 4, 16
# of frames without and with a bead so many tell where the line lies
SAMPLE = 12
# a line that lies so near to the rows is measured as it lies
LEVEL_DEG = 4.0


class Readings(NamedTuple):
    """Of F frames: time_s (F,) as stamped, columns (m,), widths (F, m) in px of the picture as it is
    measured, reasons (F,), and the camera's latency as this recording tells it."""

    time_s: np.ndarray
    columns: np.ndarray
    widths: np.ndarray
    reasons: list[str]
    latency: Latency


def opened(path: str | Path, camera: Camera) -> trial_files.Trial:
    """A recording through the topics of section `camera`. Raises ValueError as read_trial does."""
    return trial_files.read_trial(
        path,
        sources=sources(camera),
        image=camera.topics.image,
        time=camera.topics.time,
        unreadable_share=camera.unreadable_share,
    )


def sources(camera: Camera) -> tuple[Source, ...]:
    """Where a recording has our signals. Raises ValueError for a signal that is none of ours, and for another
    unit."""
    ours = {source.signal: source for source in trial_files.SOURCES}
    for name, place in camera.topics.mapping.items():
        if name not in ours:
            raise ValueError(
                f"params.yaml: camera.topics.mapping.{name} is no signal of a trial; "
                f"map {', '.join(list(ours)[:-1])}"
            )
        if place.unit != ours[name].unit:
            raise ValueError(
                f"params.yaml: camera.topics.mapping.{name}.unit is {place.unit} but {name} is in "
                f"{ours[name].unit}; convert with scale and offset, and write unit: {ours[name].unit}"
            )
        ours[name] = Source(name, place.source, place.unit, place.scale, place.offset)
    return tuple(ours.values())


def read(recording: trial_files.Trial, camera: Camera, *, memo: Path | None) -> Readings:
    """The readings of a recording, out of the memo where it holds them."""
    entry = None
    if memo is not None:
        entry = _entry(memo, artifacts.sha256(recording.path), _looks(camera))
        known = _remembered(entry)
        if known is not None:
            return known
    pose = pose_of(recording, camera)
    time_s, beads, signals = [], [], []
    first, last = camera.columns
    bands = (max((last - first) // STEP_PX, 1), BANDS)
    frames = iter(recording.frames)
    while batch := list(itertools.islice(frames, TOGETHER)):
        times, pictures = zip(*batch, strict=True)
        pictures = [picture if pose is None else line.turned(picture, pose) for picture in pictures]
        with artifacts.about(recording.path):
            beads += _measured(pictures, camera)
        time_s += times
        part = [picture[:, first : min(last, picture.shape[1])] for picture in pictures]
        signals += [cv2.resize(one, bands, interpolation=cv2.INTER_AREA).astype(np.float32) for one in part]
    done = Readings(
        np.array(time_s),
        beads[0].columns if beads else np.zeros(0),
        np.array([one.widths for one in beads]),
        [one.reason for one in beads],
        _latency(recording, np.array(time_s), signals, camera),
    )
    if entry is not None and beads:
        _remember(entry, done)
    return done


def beads(recording: trial_files.Trial, camera: Camera) -> Iterator[tuple[float, np.ndarray, bead.Bead]]:
    """(time, picture as it is measured, bead) of each frame, a few at a time: memory stays flat, and what a
    frame costs beyond its decoding is shared."""
    pose, frames = pose_of(recording, camera), iter(recording.frames)
    while batch := list(itertools.islice(frames, TOGETHER)):
        times, pictures = zip(*batch, strict=True)
        pictures = [picture if pose is None else line.turned(picture, pose) for picture in pictures]
        with artifacts.about(recording.path):
            measured = _measured(pictures, camera)
        yield from zip(times, pictures, measured, strict=True)


def frames_of(path: Path, camera: Camera) -> Frames:
    """The frames of a recording's image topic, whatever else it holds. Raises ValueError."""
    walk = Walk(path, topic := image_topic(path, topics(path), camera.topics.image), set(), "log_time")
    return Frames(walk, topic, "log_time", start_ns=0, unreadable_share=camera.unreadable_share)


def _measured(pictures: list[np.ndarray], camera: Camera) -> list[bead.Bead]:
    return bead.measure_all(
        pictures,
        columns=(camera.columns[0], min(camera.columns[1], pictures[0].shape[1])),
        longest_blur_px=camera.longest_blur_px,
        sign=sign_of(camera),
    )


def sign_of(camera: Camera) -> int:
    """1 for a bead brighter than its ground, -1 for a darker one, 0 where nobody said."""
    return {"light": 1, "dark": -1, "": 0}[camera.bead]


def _latency(recording: trial_files.Trial, time_s: np.ndarray, signals: list, camera: Camera) -> Latency:
    clock, position = recording.signals["position_mm"]
    known = np.isfinite(position)
    if known.sum() < 3 or not signals:
        return latency.UNTOLD
    return latency.estimate(
        time_s,
        np.array(signals),
        Gantry(clock[known], position[known]),
        step_mm=camera.mm_per_px * (camera.columns[1] - camera.columns[0]) / signals[0].shape[1],
    )


# ---- where the line lies


def pose_of(recording: trial_files.Trial, camera: Camera) -> line.Pose | None:
    """How the frames of a recording are turned: as section `camera` says, and where it does not say, as the
    frames with a bead, less those without, show it. None where they are measured as they lie."""
    if camera.rotation_deg is not None and not camera.rotation_deg and camera.tip_px is None:
        return None
    shape, picture = _bead_alone(recording)
    if picture is None:
        return None
    if camera.rotation_deg is not None:
        return placed(camera, shape, camera.rotation_deg, None)
    found = line.find(
        picture,
        tip=None if camera.tip_px is None else (camera.tip_px[0], camera.tip_px[1]),
        hidden_px=camera.nozzle_radius_px,
        mask=mask_of(camera, shape),
        sign=sign_of(camera),
    )
    if found is None:
        return placed(camera, shape, 0.0, None) if camera.tip_px is not None else None
    return posed(camera, shape, found)


def posed(camera: Camera, shape: tuple[int, int], found: line.Line) -> line.Pose | None:
    """The pose that a line found in pictures of this shape (rows, columns) asks for."""
    if camera.tip_px is not None:
        # the line comes out of the tip and trails to the side that mm_per_px says
        return placed(camera, shape, found.angle_deg + (180 if camera.mm_per_px > 0 else 0), found)
    angle = (found.angle_deg + 90) % 180 - 90
    return None if abs(angle) < LEVEL_DEG else placed(camera, shape, angle, found)


def placed(camera: Camera, shape: tuple[int, int], angle_deg: float, found: line.Line | None) -> line.Pose:
    """The tip comes to lie at the nozzle's column, without a tip the picture's middle stays where it is; the
    line in the middle row. As many rows as the frame has on both sides of the line over the measured
    columns."""
    h, w = shape
    column = (w - 1) / 2
    x, y = (w - 1) / 2, (h - 1) / 2
    if camera.tip_px is not None:
        (x, y), column = camera.tip_px, camera.nozzle_column
    elif found is not None:
        x, y = line.foot(found, x, y)
    pose = line.Pose(angle_deg % 360, x, y, column, 0.0, h, camera.columns[1])
    return line.with_room(pose, shape, (camera.columns[0], camera.columns[1]))


def mask_of(camera: Camera, shape: tuple[int, int]) -> np.ndarray | None:
    """(h, w) bool: the polygon of the picture that the nozzle hides; None where there is none."""
    if len(camera.mask_px) < 3:
        return None
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [np.rint(np.array(camera.mask_px)).astype(np.int32)], 1)
    return mask.astype(bool)


def _bead_alone(recording: trial_files.Trial) -> tuple[tuple[int, int], np.ndarray | None]:
    """Shape of the frames, and the mean of some of them in which the gantry moves along, less that of some
    before it moved, about the middle level: nozzle, light and what else rides with the camera are gone."""
    clock, position = recording.signals["position_mm"]
    x = np.interp(recording.frames.time_s, clock, position)
    travelled = np.abs(x - x[0]) / max(float(np.ptp(x)), 1e-9)
    before, along = np.flatnonzero(travelled < 1e-3), np.flatnonzero((travelled > 0.2) & (travelled < 0.95))
    wanted = {}
    for kind, numbers in (("before", before), ("along", along)):
        chosen = numbers[np.linspace(0, len(numbers) - 1, min(SAMPLE, len(numbers))).astype(int)]
        wanted |= dict.fromkeys(chosen.tolist(), kind)
    sums: dict[str, list[np.ndarray]] = {"before": [], "along": []}
    shape, level = (0, 0), 255
    for k, (_, picture) in enumerate(recording.frames.pictures()):
        if k in wanted:
            try:
                frame = image_messages.gray(picture)
            except image_messages.UnreadableMessage:
                continue
            shape, level = frame.shape, np.iinfo(frame.dtype).max
            sums[wanted[k]].append(frame.astype(np.float32) * (255 / level))
    if not sums["along"]:
        return (int(shape[0]), int(shape[1])), None
    mean = np.mean(sums["along"], axis=0)
    if sums["before"]:
        mean = 128 + (mean - np.mean(sums["before"], axis=0)) / 2
    return (int(shape[0]), int(shape[1])), np.clip(np.rint(mean), 0, 255).astype(np.uint8)


# ---- memo


def _looks(camera: Camera) -> dict[str, Any]:
    """The settings that decide what is read."""
    names = (
        "mm_per_px", "nozzle_column", "columns", "rotation_deg", "tip_px", "mask_px", "bead", "topics",
        "longest_blur_px", "unreadable_share",
    )  # fmt: skip
    return {name: camera.model_dump()[name] for name in names}


def _entry(memo: Path, *what: Any) -> Path:
    """The file of an entry: named by the hash of what it is made of, and of the code that makes it."""
    return memo / f"{joblib.hash((what, [artifacts.sha256(HERE / name) for name in CODE]))}.parquet"


def _remember(entry: Path, done: Readings) -> None:
    count = len(done.time_s)
    told = done.latency.deviation_s if np.isfinite(done.latency.deviation_s) else np.nan
    table = {
        "time_s": done.time_s,
        "reason": np.array(done.reasons, object),
        "columns": [done.columns.astype("<f8").tobytes()] * count,
        "widths": [row.astype("<f8").tobytes() for row in done.widths],
        "latency_s": np.full(count, done.latency.latency_s),
        "latency_deviation_s": np.full(count, told),
    }
    artifacts.write_table(entry, READINGS, table)


def _remembered(entry: Path) -> Readings | None:
    """An entry that is whole, which the checksums of its pages tell."""
    try:
        table = artifacts.read_table(entry, READINGS)
    except ValueError:
        return None
    if not len(table["time_s"]):
        return None
    deviation = float(table["latency_deviation_s"][0])
    return Readings(
        np.asarray(table["time_s"], float),
        np.frombuffer(table["columns"][0], "<f8"),
        np.stack([np.frombuffer(row, "<f8") for row in table["widths"]]),
        [str(reason) for reason in table["reason"]],
        Latency(float(table["latency_s"][0]), deviation if np.isfinite(deviation) else np.inf),
    )
