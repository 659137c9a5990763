"""Reads and writes deposition trials as MCAP recordings: camera frames, gantry, plunger command and, if
simulated, the true flow. Writes the next trial's command.

Any ROS 2 or Foxglove viewer opens the files: CDR with the ros2msg texts embedded, in the order of time,
chunks with CRCs. Reads that form or a machine's own topics. Equal input gives equal bytes.

A recording is read once. The readings of its frames are kept under a hash of its bytes, of the camera's
settings and of the code that reads.
"""

import math
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np

from pipeline.recordings.excluded import readable
from pipeline.recordings.formats import Note, Source
from pipeline.recordings.images import Frames, check_overlap, read_frames, span_of, tables_of, write_frames
from pipeline.store import artifacts
from pipeline.store.params import Mapped
from pipeline.store.tables import BYTES, FLOAT, NONE, TEXT, Column, Schema

SCHEMA, VERSION = "beadline.trial", "1"
# the signals of a trial, and their topics in our own recordings
POSITION = Source("position_mm", "/gantry:position_mm", "mm")
SPEED = Source("speed_mm_per_s", "/gantry:speed_mm_per_s", "mm/s")
COMMAND = Source("command_mm", "/plunger:displacement_mm", "mm")
FLOW = Source("flow_mm3_per_s", "/true_flow:flow_mm3_per_s", "mm^3/s")
SOURCES = (POSITION, SPEED, COMMAND, FLOW)
# endings of recordings that are not read as trials
OTHER_FORMATS = {".avi", ".bag", ".csv", ".db3", ".mkv", ".mov", ".mp4", ".parquet"}
TYPES = {
    "/gantry": "beadline_msgs/msg/Gantry",
    "/plunger": "beadline_msgs/msg/Plunger",
    "/true_flow": "beadline_msgs/msg/TrueFlow",
}

READINGS = Schema(
    "trial_readings",
    2,
    (
        Column("time_s", FLOAT, "s", "of the frame, as stamped"),
        Column("reason", TEXT, NONE, "why the frame has no usable bead; empty if it has"),
        Column("columns", BYTES, "px", "measured columns, 64-bit floats"),
        Column("widths", BYTES, "px", "widths there, 64-bit floats; 0 bare, NaN unread"),
        Column("latency_s", FLOAT, "s", "how late the frames are against the gantry, of the whole recording"),
        Column("latency_deviation_s", FLOAT, "s", "its standard deviation; missing: not told", nullable=True),
        Column("edge_px", FLOAT, "px", "by how much widths may be off; missing: no bead", nullable=True),
    ),
)
# the readings of F frames: time_s (F,), columns (m,), widths (F, m), reasons (F,), latency and its deviation,
# and by how much the widths may be off, px
Values = tuple[np.ndarray, np.ndarray, np.ndarray, list[str], tuple[float, float], float]


class TrialConditions(NamedTuple):
    """The conditions of a trial, kept in the recording's metadata.

    `trial` counts from 0; `law`: name of what made the command; `routine` counts the training routines from
    0. The plan of a routine is off_s, on_s, pause_s of the gantry, on_s again and tail_s, at one speed.

    A bead of w_px pixels is (w_px - offset_px) / px_per_mm wide in mm. Its section follows from the contact
    angle. A column of the image is at gantry position + (column - nozzle_column) mm_per_px. mm_per_px is
    negative if the line trails to higher columns.
    """

    material: str
    nozzle: str
    trial: int
    law: str
    routine: int
    speed_mm_per_s: float
    off_s: float
    on_s: float
    pause_s: float
    tail_s: float
    bead_area_mm2: float
    px_per_mm: float
    offset_px: float
    contact_angle_deg: float
    mm_per_px: float
    nozzle_column: float

    @property
    def scale(self) -> tuple[float, float]:
        """px_per_mm and offset_px."""
        return self.px_per_mm, self.offset_px


class TrialSignals(NamedTuple):
    """The signals of a machine in one trial, on one clock time_s (T,): gantry, plunger command and, if
    simulated, the true flow; all (T,)."""

    time_s: np.ndarray
    position_mm: np.ndarray
    speed_mm_per_s: np.ndarray
    command_mm: np.ndarray
    flow_mm3_per_s: np.ndarray | None = None


class TrialRecording(NamedTuple):
    """A recording as it was made: signals {name: (time_s (n,), values (n,))} on their own clocks, frames, and
    notes on what was damaged or left out.

    `conditions` is None if the recording does not have them.
    """

    path: str
    conditions: TrialConditions | None
    signals: dict[str, tuple[np.ndarray, np.ndarray]]
    frames: Frames
    notes: list[Note]


# ---- writing


def write_trial(
    path: str | Path,
    conditions: TrialConditions,
    frames: Iterable[tuple[float, np.ndarray]],
    signals: TrialSignals,
    *,
    encoding: str,
) -> None:
    """Writes one recording of frames (time_s, (height, width) uint8 or uint16) and of signals. Frames are
    taken one by one, so only one chunk is in memory.

    `encoding` is "jpeg" (quality 95, 8 bits only), "png" (level 1) or "raw". Raises ValueError, and writes no
    file, if lengths differ, values are not finite, times do not run forward, frames change in size or type,
    there is no frame, or frames and signals do not overlap in time.
    """
    time_s = signals.time_s
    columns = [
        (source, values) for source, values in zip(SOURCES, signals[1:], strict=True) if values is not None
    ]
    tables = tables_of(path, time_s, columns)
    write_frames(path, tables, TYPES, time_s, (encoding, frames), (SCHEMA, _metadata(path, conditions)))


def write_command(
    path: str | Path, conditions: TrialConditions, *, time_s: np.ndarray, command_mm: np.ndarray,
    speed: bool = False,
) -> None:  # fmt: skip
    """Writes the next trial's command u (T,) in mm as path.csv (time_s, displacement_mm; speed_mm_per_s if it
    is a speed) and path.mcap; `path` has no ending. Raises ValueError as write_trial does."""
    tables = tables_of(path, time_s, [(COMMAND, command_mm)])
    write_frames(f"{path}.mcap", tables, TYPES, time_s, None, (SCHEMA, _metadata(path, conditions)))
    artifacts.write_csv(
        f"{path}.csv",
        {
            "time_s": np.asarray(time_s, float),
            "speed_mm_per_s" if speed else COMMAND.source.partition(":")[2]: np.asarray(command_mm, float),
        },
    )


def _metadata(path: str | Path, conditions: TrialConditions) -> dict[str, str]:
    wrong = [
        name
        for name, value in conditions._asdict().items()
        if isinstance(value, float) and not math.isfinite(value)
    ]
    if wrong:
        raise ValueError(f"{path}: the condition {wrong[0]} is not finite; give its value")
    pairs = {"schema_version": VERSION} | {name: str(value) for name, value in conditions._asdict().items()}
    return pairs | {"crc32": _crc(pairs)}


def _crc(pairs: dict[str, str]) -> str:
    """Returns the CRC of all pairs. A metadata record is outside the chunks and has no CRC of its own."""
    return f"{zlib.crc32(repr(sorted(pairs.items())).encode()):08x}"


# ---- reading


def open_trial(
    path: str | Path, *, image: str, time: str, mapping: Mapping[str, Mapped], unreadable_share: float
) -> TrialRecording:
    """Returns a recording, read through the topics of section `camera`. Raises ValueError as read_trial
    does."""
    return read_trial(
        path, sources=sources(mapping), image=image, time=time, unreadable_share=unreadable_share
    )


def sources(mapping: Mapping[str, Mapped]) -> tuple[Source, ...]:
    """Returns the sources of our signals in a recording; those in `mapping` replace our own topics. Raises
    ValueError if a mapped signal does not belong to a trial, or has another unit."""
    by_signal = {source.signal: source for source in SOURCES}
    for name, place in mapping.items():
        if name not in by_signal:
            raise ValueError(
                f"params.yaml: camera.topics.mapping.{name} is no signal of a trial; "
                f"map {', '.join(list(by_signal)[:-1])}"
            )
        if place.unit != by_signal[name].unit:
            raise ValueError(
                f"params.yaml: camera.topics.mapping.{name}.unit is {place.unit} but {name} is in "
                f"{by_signal[name].unit}; convert with scale and offset, "
                f"and write unit: {by_signal[name].unit}"
            )
        by_signal[name] = Source(name, place.source, place.unit, place.scale, place.offset)
    return tuple(by_signal.values())


def trial_paths(folder: Path) -> list[Path]:
    """Returns the recordings of trials below a folder, without those that a person excluded. Raises
    ValueError, naming the file, if a recording has another format."""
    other = next((p for p in sorted(folder.rglob("[!.]*")) if p.suffix.lower() in OTHER_FORMATS), None)
    if other:
        raise ValueError(
            f"{other}: expected a trial as MCAP with its frames and signals, found {other.suffix}; record "
            "the trial as .mcap, and move this file out of the folder"
        )
    return readable(sorted(folder.rglob("[!.]*.mcap")), folder)


def group_trials(
    recordings: Iterable[TrialRecording],
    folder: Path,
    *,
    materials: Sequence[str],
    nozzle: str,
    routines: Sequence[Mapping[str, float]],
) -> dict[tuple[str, int], list[TrialRecording]]:
    """Returns the recordings by (material, number of the routine), in the order of their trials. A routine is
    its plan {field of TrialConditions: value}, at the index of its number.

    Raises ValueError, naming the file, if a material, nozzle or routine is unknown, if a routine has another
    plan, or if a trial is missing or exists twice.
    """
    groups: dict[tuple[str, int], dict[int, TrialRecording]] = {}
    for recording in recordings:
        conditions = check_conditions(recording)
        number, material = conditions.trial, conditions.material
        index = conditions.routine
        _check_setup(recording.path, conditions, materials, nozzle, routines)
        trials = groups.setdefault((material, index), {})
        if number in trials:
            raise ValueError(
                f"{recording.path}: trial {number} of material {material}, routine {index}, is in "
                f"{trials[number].path} too; "
                "keep one of the two"
            )
        trials[number] = recording
    for (material, index), trials in groups.items():
        lacking = sorted(set(range(max(trials))) - set(trials))
        if lacking:
            raise ValueError(
                f"{folder}: trial {lacking[0]} of material {material}, routine {index}, "
                f"is missing beside trial {max(trials)}; add it, or renumber the others"
            )
    return {key: [trials[number] for number in sorted(trials)] for key, trials in sorted(groups.items())}


def check_conditions(recording: TrialRecording) -> TrialConditions:
    """Returns the conditions of a trial. Raises ValueError if its recording does not have them, or if they
    are impossible."""
    conditions = recording.conditions
    if conditions is None:
        raise ValueError(
            f"{recording.path}: expected metadata with material, trial and calibration (record {SCHEMA}), "
            "found none; copy it from the command in datasets/train_ilc/next"
        )
    if not conditions.px_per_mm > 0 or conditions.trial < 0:
        raise ValueError(
            f"{recording.path}: expected a scale px_per_mm above 0 and a trial from 0 on, "
            f"found {conditions.px_per_mm:g} and {conditions.trial}; mend the metadata record {SCHEMA}"
        )
    return conditions


def _check_setup(
    path: str,
    conditions: TrialConditions,
    materials: Sequence[str],
    nozzle: str,
    routines: Sequence[Mapping[str, float]],
) -> None:
    if conditions.material not in materials:
        raise ValueError(
            f"{path}: material {conditions.material} is not among printer.materials {', '.join(materials)}; "
            "add it to params.yaml, or take the file away"
        )
    if conditions.nozzle != nozzle:
        raise ValueError(
            f"{path}: expected a nozzle of {nozzle} mm (printer.nozzle_mm), found {conditions.nozzle}; "
            "what one nozzle learned does not hold for another"
        )
    if not 0 <= conditions.routine < len(routines):
        raise ValueError(
            f"{path}: expected one of the {len(routines)} routines from 0 on, found routine "
            f"{conditions.routine}; add it to printer.routines in params.expert.yaml"
        )
    plan = routines[conditions.routine]
    recorded = {name: getattr(conditions, name) for name in plan}
    if any(abs(recorded[name] - plan[name]) > 1e-6 for name in plan):
        expected, found = (
            ", ".join(f"{name} {each[name]:g}" for name in plan if name != "routine")
            for each in (plan, recorded)
        )
        raise ValueError(
            f"{path}: routine {conditions.routine} was printed with {found}, but the routines of "
            f"params.expert.yaml have {expected}; write the printed plan there (printer.reference is routine "
            "0, printer.routines follow), or take the file away"
        )


def first_and_last(recordings: Iterable[TrialRecording]) -> list[Path]:
    """Returns the paths of the first and the last trial of each material, in the order of their names.
    Recordings without conditions are left out."""
    by_material: dict[str, list[tuple[int, Path]]] = {}
    for recording in recordings:
        conditions = recording.conditions
        if conditions:
            by_material.setdefault(conditions.material, []).append((conditions.trial, Path(recording.path)))
    return sorted({path for trials in by_material.values() for _, path in (min(trials), max(trials))})


def read_trial(
    path: str | Path,
    *,
    sources: Sequence[Source] = SOURCES,
    image: str = "",
    time: str = "",
    unreadable_share: float,
) -> TrialRecording:
    """Returns a trial of `write_trial`, or a machine's own recording through `sources`, which map
    position_mm, speed_mm_per_s, command_mm and, if there is one, flow_mm3_per_s.

    `image`: the image topic, by default the only one; `time`: the clock, which is log_time (the default),
    publish_time, or the field of a time stamp that every topic has, such as header.stamp. If the clock is a
    calendar's, time counts from the record's first whole second. Raises ValueError, one sentence, if the file
    cannot be read, if a topic does not exist, or if frames and signals do not overlap in time. Damaged parts
    are left out and noted. At most `unreadable_share` of the frames may turn out not to be decodable when
    they are read later.
    """
    path = Path(path)
    # only the true flow, which no machine knows, may be absent if its source is ours
    optional = {FLOW.signal} if FLOW in sources else ()
    try:
        frames, signals, metadata, notes = read_frames(
            path,
            sources,
            what="a trial",
            image=image,
            clock=time or "log_time",
            unreadable_share=unreadable_share,
            optional=optional,
        )
    except OSError as error:
        raise ValueError(
            f"{path} cannot be read ({error.strerror or error}); check the disk, or copy the recording again"
        ) from None
    spans = {name: span_of(time_s) for name, (time_s, _) in signals.items()}
    check_overlap(path, span_of(frames.time_s), spans)
    first, last = spans[COMMAND.signal]
    outside = int(np.count_nonzero((frames.time_s < first) | (frames.time_s > last)))
    if outside:
        message = f"{outside} of {len(frames.time_s)} frames lie before or after the command"
        notes.append(Note("outside", "", outside, message))
    conditions = _conditions(path, metadata.get(SCHEMA, {}), notes)
    return TrialRecording(str(path), conditions, signals, frames, notes)


def _conditions(path: Path, metadata: dict[str, str], notes: list[Note]) -> TrialConditions | None:
    if not metadata:
        notes.append(
            Note(
                "conditions",
                "",
                1,
                f"it does not say what the trial was run with: it has no whole metadata record {SCHEMA}",
            )
        )
        return None
    pairs = {name: value for name, value in metadata.items() if name != "crc32"}
    crc = metadata.get("crc32")
    if crc is not None and crc != _crc(pairs):
        raise ValueError(
            f"{path}: the trial's conditions should have CRC {_crc(pairs)} but say {crc}, "
            "so they are damaged; copy the recording again"
        )
    if pairs.get("schema_version") != VERSION:
        raise ValueError(
            f"{path}: the trial's conditions have version {pairs.get('schema_version')} but {VERSION} is "
            "read; record it with this version"
        )
    kinds = TrialConditions.__annotations__
    try:
        return TrialConditions(**{name: kinds[name](pairs[name]) for name in TrialConditions._fields})
    except KeyError as error:
        raise ValueError(
            f"{path}: the trial's conditions lack {error.args[0]}; write it into the metadata record {SCHEMA}"
        ) from None
    except ValueError as error:
        raise ValueError(
            f"{path}: the trial's conditions cannot be read ({error}); "
            f"write numbers into the metadata record {SCHEMA}"
        ) from None


# ---- readings that are kept


def recall(
    folder: Path,
    recording: str,
    settings: Mapping[str, Any],
    code: Sequence[Path],
    read: Callable[[], Values],
) -> Values:
    """Returns the readings of a recording from `folder`, or else from `read`; these are then kept if there is
    a frame. An entry is named by the hash of the recording, of the settings, and of the code that reads."""
    what = ((artifacts.sha256(recording), settings), [artifacts.sha256(path) for path in code])
    place = folder / f"{joblib.hash(what)}.parquet"
    entry = _recall_entry(place)
    if entry is not None:
        return entry
    values = read()
    if len(values[0]):
        _remember(place, values)
    return values


def _remember(place: Path, values: Values) -> None:
    time_s, columns, widths, reasons, (latency_s, deviation_s), edge_px = values
    count = len(time_s)
    table = {
        "time_s": time_s,
        "reason": np.array(reasons, object),
        "columns": [columns.astype("<f8").tobytes()] * count,
        "widths": [row.astype("<f8").tobytes() for row in widths],
        "latency_s": np.full(count, latency_s),
        "latency_deviation_s": np.full(count, deviation_s if np.isfinite(deviation_s) else np.nan),
        "edge_px": np.full(count, edge_px),
    }
    artifacts.write_table(place, READINGS, table)


def _recall_entry(place: Path) -> Values | None:
    """Returns the readings of an entry; None if it does not exist, is empty, or is damaged."""
    try:
        table = artifacts.read_table(place, READINGS)
    except ValueError:
        return None
    if not len(table["time_s"]):
        return None
    deviation_s = float(table["latency_deviation_s"][0])
    return (
        np.asarray(table["time_s"], float),
        np.frombuffer(table["columns"][0], "<f8"),
        np.stack([np.frombuffer(row, "<f8") for row in table["widths"]]),
        [str(reason) for reason in table["reason"]],
        (float(table["latency_s"][0]), deviation_s if np.isfinite(deviation_s) else np.inf),
        float(table["edge_px"][0]),
    )
