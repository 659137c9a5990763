"""Reads a folder of nozzle frames: key areas with class, temperature, print and segment for the classifier.
The folder holds CSV files with images (columns of CAXTON: Brion and Pattinson 2022), or MCAP recordings with
the setpoints at which the frames were printed.

No frame is dropped. Every listed frame has its row. If it cannot be used for learning, its row states the
reason, and the notes count the reasons.
"""

import collections
import contextlib
import hashlib
import itertools
import os
import posixpath
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np
from tqdm import tqdm

from pipeline.recordings.csv_files import MISSING as NOTHING_WRITTEN
from pipeline.recordings.csv_files import CsvLayout, floats, list_layout, sound_rows
from pipeline.recordings.excluded import readable
from pipeline.recordings.formats import Note, Source, column_place, nearest_names
from pipeline.recordings.images import (
    MISSING,
    UNREADABLE,
    Frames,
    check_overlap,
    damage,
    gray,
    image_topic,
    open_images,
    open_topics,
    read_frames,
    read_image,
    span_of,
)
from pipeline.recordings.instants import instants, month_first
from pipeline.recordings.mcap_files import McapFile, TopicColumns
from pipeline.recordings.messages import UnreadableMessage
from pipeline.store.artifacts import sha256
from pipeline.store.execution import run_all
from pipeline.store.params import Execution

CLASSES = ("under (flow below 90 %)", "good (90 to 110 %)", "over (above 110 %)")
# number of frames that one worker crops at a time, and that the memo keeps together
TOGETHER = 256
# about this many lines are used to find where a file's images are
LOOKED_AT = 2000
# endings of texts about recordings, and the longest path that is shown
TEXTS, LONGEST = {".md", ".txt", ".html", ".yaml", ".yml", ".dvc", ""}, 200
REPEATED, COPY = "an earlier line lists the image", "the frame is a copy of another"
NO_FLOW, NO_TEMPERATURE, NO_PRINT, NO_NAME = (
    "no flow is known",
    "no temperature is known",
    "no print is named",
    "no image is named",
)
REMEDIES = {
    MISSING: "copy the images below that folder, with the paths that the file gives",
    UNREADABLE: "copy the images again",
    NO_FLOW: "fill it in, in percent of nominal, or remove those lines",
    NO_TEMPERATURE: "fill it in, or remove those lines; without a column target_hotend "
    "the measured hotend is taken",
    NO_PRINT: "fill in print_id, or remove that column if the file is one print",
    NO_NAME: "fill in img_path, or remove those lines",
    REPEATED: "remove the lines that repeat others",
    COPY: "record again with a camera that runs, or remove the copies",
}
LOOK = "look at a few with ./run beadline calibrate tip IMAGE --tip X,Y"
ROWS_AT_ONCE = 10_000
# the range of a printer's settings; a value beyond it is another column, or in another unit
FLOW_PERCENT, TEMPERATURE_DEGC = (0.0, 1000.0), (0.0, 600.0)
LABELS = "flow_rate_class"
DIRECTION = "travel_direction_deg"
# optional columns, and what replaces them
OPTIONAL = {
    "print_id": "the file is one print",
    "nozzle_tip_x": "the tip is that of the settings",
    "timestamp": "the order of the rows is not checked",
    DIRECTION: "the travel direction is that of the ground, if it is seen to move, or of the only line",
}
# columns that, like flow and target temperature, are constant within a segment if the file has them
SETTINGS = ("feed_rate", "z_offset")
COLUMNS = {"img_path", "flow_rate", "target_hotend", "hotend", "nozzle_tip_y", LABELS, *OPTIONAL, *SETTINGS}
# texts for an empty field, with that of pandas for a time
NOTHING = {*NOTHING_WRITTEN, "nat"}
# the section of params.yaml with our signals' places in a recording
PLACE = "params.yaml: train_classifier.topics"
# our signals and their units; a signal that is not mapped comes from the only field of that name
UNITS = {
    "flow_percent": "percent",
    "temperature_degC": "degC",
    "print_id": "1",
    "tip_x_px": "px",
    "tip_y_px": "px",
    "travel_direction_deg": "deg",
}
NEEDED = ("flow_percent", "temperature_degC")
# a temperature is no setpoint if it changes more often than this, and in more than one of this many frames
MEASURED = 20
# frames of a recording in memory at a time
AT_ONCE = 64
DIGEST_BYTES = 16


class Topics(NamedTuple):
    """Where a recording holds the data: the image topic (empty: the only one), the clock (log_time,
    publish_time or the field of a time stamp), and the mapping {our signal: (source, unit, scale,
    offset)}."""

    image: str
    time: str
    mapping: Mapping[str, tuple[str, str, float, float]]

    def sources(self) -> dict[str, Source]:
        """Returns {signal: source}. Raises ValueError if a mapped signal is unknown or its unit is not
        ours."""
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


class ReadOptions(NamedTuple):
    tip_px: tuple[float, float] | None  # (x, y) in px in every frame, or None if the data have it
    front_end: Any  # find(frames, tips, directions), remember(what, count, find), remedies
    topics: Topics  # of recordings
    material: Any  # label(flow), published_flow(flow), published_temperature(degC) of what is printed
    hotend: float = np.nan  # degC of CSV files that have no temperature, NaN where none is stated


class NozzleFrames(NamedTuple):
    """n frames, file by file and, in a CSV, print by print.

    `images` (n, 16, 48) uint8, zeros if not valid; `label` (n,): 0 under, 1 good, 2 over, -1 unknown; `flow`
    (n,): percent of nominal; `temperature` (n,): degC; both converted to the published material
    (material.py); `print_number` (n,): index into `prints`; `segment` (n,): number of the stretch of constant
    settings; `valid` (n,); `reasons` (n): empty if valid; `angle_deg`, `miss_px`, `score` and `padded_share`
    (n,), `tip` (n, 2) and `surroundings` (n, measures): from the front end; `source` (n): where each frame
    comes from; `picture` (n): path of its image and -1, or path of its recording and the frame's number in
    it; `notes`: what was found while reading.
    """

    images: np.ndarray
    label: np.ndarray
    flow: np.ndarray
    temperature: np.ndarray
    print_number: np.ndarray
    segment: np.ndarray
    valid: np.ndarray
    reasons: list[str]
    angle_deg: np.ndarray
    miss_px: np.ndarray
    score: np.ndarray
    padded_share: np.ndarray
    tip: np.ndarray
    surroundings: np.ndarray
    source: list[str]
    picture: list[tuple[Path, int]]
    prints: tuple[str, ...]
    notes: list[Note]


class FrameLog(NamedTuple):
    """The n rows of one CSV: flow in percent of nominal, temperature in degC, tip (n, 2) in px, direction in
    degrees, label 0, 1 or 2. A missing value is NaN or an empty text. `image` is the path as written, with
    forward slashes; `setting` numbers the stretches of constant settings from 0, over all prints."""

    path: Path
    line: np.ndarray
    image: list[str]
    flow: np.ndarray
    temperature: np.ndarray
    print_id: list[str]
    setting: np.ndarray
    tip: np.ndarray
    direction: np.ndarray
    label: np.ndarray
    notes: list[Note]


class FrameFile(NamedTuple):
    """The n frames of one file with flow in percent, temperature in degC and print of each: NaN and empty if
    not known. The file's own reasons for leaving out a frame take precedence over those of the front end."""

    path: Path
    areas: Any  # what the front end made of them
    flow: np.ndarray
    temperature: np.ndarray
    prints: list[str]
    stretch: np.ndarray  # the number of the stretch of constant settings that a frame is in, from 0
    places: list[str]
    pictures: list[tuple[Path, int]]
    notes: list[Note]


def read_folder(folder: Path, options: ReadOptions, execution: Execution) -> NozzleFrames:
    """Returns every frame that the CSV files and recordings below `folder` list, in the order of the files'
    names (CSV files first). As many workers as `execution` says crop them.

    Images are looked for in the folder of their CSV and from `folder` on, with the path as written or without
    its first folders. Raises ValueError, one sentence, if read_log or read_recording raises one, if two lines
    about an image contradict each other, and if no frame at all is valid.
    """
    names = _images(folder)
    files = {
        ending: readable(sorted(folder / name for name in names if name.lower().endswith(ending)), folder)
        for ending in (".csv", ".mcap")
    }
    for path in (*files[".csv"], *files[".mcap"]):
        if not path.is_file():
            raise ValueError(
                f"{path} is a link to what is not there; copy the file itself, or remove the link"
            )
    logs = [read_log(path, options.hotend) for path in files[".csv"]]
    recordings, copies = _different(files[".mcap"])
    if not (logs or recordings):
        raise ValueError(
            f"{folder}: expected a CSV with its images, or MCAP recordings, found neither; copy them there, "
            "or set the source to simulated"
        )
    listed = [_image_paths(log, folder, names) for log in logs]
    reasons = _line_problems(logs, [images for images, _ in listed])
    calls = [
        _crops(log, folder, images, problems, options)
        for log, (images, _), problems in zip(logs, listed, reasons, strict=True)
    ]
    films = [
        joblib.delayed(read_recording)(
            path.resolve(), path, options.topics, options.tip_px, front_end=options.front_end
        )
        for path in recordings
    ]
    every = [*itertools.chain.from_iterable(calls), *films]
    running = run_all(every, execution, remains=": what was read is kept")
    results = iter(list(tqdm(running, total=len(every), desc=f"{folder}: frames", mininterval=2)))
    parts = [
        _of_log(
            log,
            [next(results) for _ in pieces],
            problems,
            [folder / image for image in images],
            options.material,
            notes,
        )
        for log, (images, notes), problems, pieces in zip(logs, listed, reasons, calls, strict=True)
    ]
    parts += results
    read = {name for name in names if name.lower().endswith(tuple(files))}
    unread = names.difference(read, *(images for images, _ in listed))
    return _join(folder, parts, options, copies + _unread(folder, unread))


def _crops(log: FrameLog, folder: Path, images: list[str], problems: list[str], options: ReadOptions) -> list:
    """Returns the calls that crop the key areas of a log's images, piece by piece. A line with a reason has
    no path."""
    tips = log.tip
    if options.tip_px is not None:
        tips = np.broadcast_to(np.array(options.tip_px, float), log.tip.shape)
    paths = [
        "" if reason else str(folder.resolve() / image)
        for image, reason in zip(images, problems, strict=True)
    ]
    return [
        joblib.delayed(key_areas_of_files)(paths[at], tips[at], log.direction[at], options.front_end)
        for at in _pieces(log)
    ]


def check(folder: Path, frames: NozzleFrames) -> None:
    """Raises ValueError if the valid frames are not enough to learn from or to test with: fewer than two
    prints, or a class without a frame."""
    prints = np.unique(frames.print_number[frames.valid])
    if len(prints) < 2:
        raise ValueError(
            f"{folder}: no honest split: expected valid frames of at least 2 prints, "
            "one to learn from and one to judge by, "
            f"found {len(prints)} "
            f"({', '.join(frames.prints[i] for i in prints)}); add another print, "
            "or name the prints apart in print_id"
        )
    for c, name in enumerate(CLASSES):
        if not (frames.valid & (frames.label == c)).any():
            flow = frames.flow[frames.valid]
            raise ValueError(
                f"{folder}: expected valid frames of every class, found none of class {c}, {name}, "
                f"in {frames.valid.sum()} with flow_rate {flow.min():g} to {flow.max():g} "
                "percent of nominal; add prints at such a flow, or write flow_rate in percent"
            )


def figures(frames: NozzleFrames) -> dict[str, Any]:
    """Returns the counts of what was read, for the metrics."""
    reasons = collections.Counter(_kind(reason) for reason in frames.reasons if reason)
    valid = frames.valid
    return {
        "frames": len(valid), "valid": int(valid.sum()), "valid_share": float(valid.mean()),
        "rejected": dict(sorted(reasons.items())),
        "prints": len(frames.prints), "segments": len(np.unique(frames.segment)),
        "of_class": [int((valid & (frames.label == c)).sum()) for c in range(3)],
        "temperatures_degC": sorted({round(t, 3) for t in frames.temperature[valid].tolist()}),
        "notes": [note.message for note in frames.notes],
    }  # fmt: skip


def pictures(places: Sequence[tuple[Path, int]], topics: Topics) -> list[np.ndarray]:
    """Returns the gray pictures. A place is (image, -1), or (recording, number among its frames). Raises
    ValueError if one can no longer be read."""
    films = {
        path: frames_at(path, topics, [k for recording, k in places if recording == path])
        for path in {path: None for path, k in places if k >= 0}
    }
    return [films[path][k] if k >= 0 else read_image(path) for path, k in places]


# ---- which images


def _different(paths: Sequence[Path]) -> tuple[list[Path], list[Note]]:
    """Returns the files without exact copies of others, and a note on the copies. A copy would count twice in
    learning, and could be tested with data that was learned from."""
    first: dict[str, Path] = {}
    different = [path for path in paths if first.setdefault(sha256(path), path) == path]
    twice = [path for path in paths if path not in different]
    return different, [
        Note(
            "copies",
            "",
            len(twice),
            f"{twice[0]} is another recording once more, byte for byte, and was left out",
        )
    ] if twice else []


def _unread(folder: Path, names: Iterable[str]) -> list[Note]:
    """Returns a note on files that are neither recordings, nor named by a CSV, nor texts about the
    recordings."""
    names = [name for name in names if posixpath.splitext(name)[1].lower() not in TEXTS]
    sentence = (
        f"{folder}: {len(names)} files are named by no CSV and were not read, "
        f"the first {min(names, default='')}; "
        "list them in a CSV, or move them out"
    )
    return [Note("unread", "", len(names), sentence)] if names else []


def _images(folder: Path) -> set[str]:
    """Returns the paths of all files that are not hidden, relative to `folder`, with forward slashes. A
    folder that links lead to again is read once."""
    files, walked = set(), set()
    for place, folders, names in os.walk(folder, followlinks=True):
        # a link may lead back to where it lies
        walked.add(os.path.realpath(place))
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".") and os.path.realpath(f"{place}/{name}") not in walked
        )
        inside = Path(place).relative_to(folder).as_posix()
        files.update(
            name if inside == "." else f"{inside}/{name}" for name in names if not name.startswith(".")
        )
    return files


def _image_paths(log: FrameLog, folder: Path, files: set[str]) -> tuple[list[str], list[Note]]:
    """Returns each image's path relative to `folder`, empty if it is missing, and notes. All images of a CSV
    are expected in one place: the place in which most of them exist."""
    parts = [[part for part in image.split("/") if part not in ("", ".")] for image in log.image]
    own = log.path.parent.relative_to(folder).as_posix()

    def below(base: str, first: int, some: Sequence[list[str]]) -> list[str]:
        named = [
            posixpath.normpath("/".join([base, *names[first:]])) if len(names) > first else ""
            for names in some
        ]
        return [name if name in files else "" for name in named]

    few = parts[:: max(1, len(parts) // LOOKED_AT)]
    places = [
        (base, first)
        for first in range(max(map(len, parts), default=1))
        for base in dict.fromkeys([own, "."])
    ]
    if not any(any(below(*place, few)) for place in places):
        # whatever folder has files of these names
        wanted = {names[-1] for names in few if names}
        places += [
            (base, -1)
            for base in sorted(
                {posixpath.dirname(path) for path in files if posixpath.basename(path) in wanted}
            )
        ]
    best = max(places, key=lambda place: sum(map(bool, below(*place, few))), default=(own, 0))
    notes = []
    if best[1] and any(below(*best, few)):
        lost = "/".join(parts[0][: best[1]]) or "."
        notes.append(
            Note(
                "images",
                "",
                1,
                f"{log.path}: its images are found in {folder / best[0]} without the first folders of "
                f"their paths, {lost}/",
            )
        )
    return below(*best, parts), notes


def _line_problems(logs: Sequence[FrameLog], images: Sequence[list[str]]) -> list[list[str]]:
    """Returns for each line the reason why it cannot be used for learning, before any image is opened. Raises
    ValueError if two lines contradict each other."""
    first: dict[str, tuple[int, int]] = {}
    reasons = []
    for k, (log, paths) in enumerate(zip(logs, images, strict=True)):
        unknown = (
            (NO_FLOW, ~np.isfinite(log.flow)),
            (NO_TEMPERATURE, ~np.isfinite(log.temperature)),
            (NO_PRINT, np.array([not name for name in log.print_id], bool)),
        )
        problems = [MISSING if not image else "" for image in paths]
        problems = [
            NO_NAME if not named else reason for named, reason in zip(log.image, problems, strict=True)
        ]
        for reason, rows in unknown:
            for i in np.flatnonzero(rows):
                problems[i] = reason
        for i, image in enumerate(paths):
            if problems[i] == "" and first.setdefault(image, (k, i)) != (k, i):
                _check_alike(logs[first[image][0]], first[image][1], log, i)
                problems[i] = REPEATED
        reasons.append(problems)
    return reasons


def _check_alike(earlier: FrameLog, i: int, log: FrameLog, j: int) -> None:
    settings_before, settings_after = (
        (listing.flow[row], listing.temperature[row], listing.print_id[row])
        for listing, row in ((earlier, i), (log, j))
    )
    if settings_before != settings_after:
        settings = [
            f"{flow:g} percent and {temperature:g} degC in print {name!r}"
            for flow, temperature, name in (settings_after, settings_before)
        ]
        raise ValueError(
            f"{log.path}: line {log.line[j]}: expected {log.image[j]} once, "
            f"found it here with {settings[0]} and in line {earlier.line[i]} "
            f"of {earlier.path.name} "
            f"with {settings[1]}; remove the line that is wrong"
        )


def _pieces(log: FrameLog) -> Iterator[slice]:
    """Yields slices of at most TOGETHER lines of one print each. If files are added to a folder, the slices
    of the old ones do not change."""
    ends = [i for i in range(1, len(log.print_id)) if log.print_id[i] != log.print_id[i - 1]]
    for start, stop in zip([0, *ends], [*ends, len(log.print_id)], strict=True):
        yield from (slice(k, min(k + TOGETHER, stop)) for k in range(start, stop, TOGETHER))


# ---- the CSV of a folder, line by line


def read_log(path: Path, hotend: float = np.nan) -> FrameLog:
    """Returns the frames that a CSV lists, print by print. Raises ValueError, one sentence with the line, if
    a needed column is missing, a number is text, a flow or temperature is impossible for a printer, a label
    is not a class, or time runs backwards within a print.

    `hotend`: temperature in degC of all frames if the file has no temperature column. If it is NaN, the file
    must have one.
    """
    layout = list_layout(path, lambda row: "img_path" in map(_column, row))
    layout = layout._replace(names=[_column(name) for name in layout.names])
    row_notes, notes = list(layout.notes), []
    columns = _columns(path, layout, notes, hotend)
    texts, numbers, lines = _rows(path, layout, columns, row_notes)
    notes = [note._replace(message=f"{path}: {note.message}") for note in row_notes] + notes
    count, missing = len(lines), np.full(len(lines), np.nan)
    _check_numbers(path, lines, numbers)
    temperature = numbers.get("target_hotend", numbers.get("hotend", np.full(count, hotend)))
    # a table program may write 0 as 0.0
    prints = [re.sub(r"^(\d+)\.0+$", r"\1", name) for name in texts.get("print_id", [path.stem] * count)]
    # prints one behind the other, each in the order of its rows
    numbered = {name: i for i, name in enumerate(dict.fromkeys(prints))}
    which = np.array([numbered[name] for name in prints], int)
    if "timestamp" in texts:
        # a line that is there twice is met again, and counted, where images are looked for
        first: dict[str, int] = {}
        stamps = [
            stamp if name and first.setdefault(image, i) == i else ""
            for i, (image, stamp, name) in enumerate(
                zip(texts["img_path"], texts["timestamp"], prints, strict=True)
            )
        ]
        _check_time(path, lines, stamps, which, prints)
    order = np.argsort(which, kind="stable")
    settings = [
        which,
        *(numbers[name] for name in ("flow_rate", "target_hotend", *SETTINGS) if name in numbers),
    ]
    tip = np.column_stack([numbers.get(name, missing) for name in ("nozzle_tip_x", "nozzle_tip_y")])
    return FrameLog(
        path, lines[order], [texts["img_path"][i].replace("\\", "/") for i in order],
        numbers["flow_rate"][order], temperature[order], [prints[i] for i in order],
        stretches(np.column_stack(settings)[order]), tip[order], numbers.get(DIRECTION, missing)[order],
        numbers.get(LABELS, missing)[order], notes,
    )  # fmt: skip


def stretches(settings: np.ndarray) -> np.ndarray:
    """Returns the numbers (n,), from 0, of the stretches in which settings (n, k) are constant. NaN counts as
    a value."""
    settings = np.nan_to_num(settings, nan=np.inf)
    changes = (settings[1:] != settings[:-1]).any(axis=1)
    return np.concatenate([[0], np.cumsum(changes)]).astype(int)


def _column(name: str) -> str:
    """Returns img_path for `Img Path` or `IMG-PATH`. A column that is not ours keeps its name."""
    plain = re.sub(r"[\s-]+", "_", name.strip()).casefold()
    return plain if plain in COLUMNS else name


def _columns(path: Path, layout: CsvLayout, notes: list[Note], hotend: float) -> tuple[str, ...]:
    """Returns the columns to read: the image first, then the temperature if the file has one. Raises
    ValueError if a needed column is missing. Adds notes on missing optional columns."""
    names = layout.names
    temperature = "target_hotend" if "target_hotend" in names or "hotend" not in names else "hotend"
    stated = bool(np.isfinite(hotend)) and temperature not in names
    needed = ("img_path", "flow_rate") if stated else ("img_path", temperature, "flow_rate")
    name = next((name for name in needed if name not in names), "")
    if name:
        either = "target_hotend or hotend" if name == temperature else name
        raise ValueError(
            f"{path}: expected a column {either}, found none; {nearest_names(name, names)}; rename it, "
            "or move the file out of the folder"
        )
    if ("nozzle_tip_x" in names) != ("nozzle_tip_y" in names):
        raise ValueError(
            f"{path}: expected both nozzle_tip_x and nozzle_tip_y, found one; add the other, "
            "or remove it and set the tip in params.yaml"
        )
    without = [f"{name} ({how})" for name, how in OPTIONAL.items() if name not in names]
    remarks = (
        ("temperature", stated, f"it has no temperature, so the stated {hotend:g} degC is its frames'"),
        ("temperature", temperature == "hotend",
         "it has no target_hotend, so the measured hotend is the temperature"),
        ("", len(without), f"it is read without {', '.join(without)}"),
    )  # fmt: skip
    notes += [Note("columns", name, int(n), f"{path}: {remark}") for name, n, remark in remarks if n]
    optional = [name for name in (*OPTIONAL, "nozzle_tip_y", *SETTINGS, LABELS) if name in names]
    return (*needed, *optional)


def _rows(
    path: Path, layout: CsvLayout, names: Sequence[str], notes: list[Note]
) -> tuple[dict[str, list[str]], dict[str, np.ndarray], np.ndarray]:
    """Returns ({column: texts}, {column: numbers}, lines). An empty field is NaN or an empty text."""
    places = {name: column_place(path, layout.names, name) for name in names}
    texts: dict[str, list[str]] = {
        name: [] for name in ("img_path", "print_id", "timestamp") if name in places
    }
    parts: dict[str, list[np.ndarray]] = {name: [] for name in places if name not in texts}
    lines: list[int] = []
    rows = sound_rows(path, layout, None, notes)
    while block := list(itertools.islice(rows, ROWS_AT_ONCE)):
        numbers = [line for line, _ in block]
        lines += numbers
        for name, place in places.items():
            fields = [row[place].strip() for _, row in block]
            if name in texts:
                texts[name] += ["" if field.casefold() in NOTHING else field for field in fields]
            else:
                parts[name].append(floats(path, name, fields, layout.decimal, numbers, {}))
    return texts, {name: np.concatenate(blocks) for name, blocks in parts.items()}, np.array(lines)


def _check_numbers(path: Path, lines: np.ndarray, numbers: dict[str, np.ndarray]) -> None:
    bounds = {
        "flow_rate": (*FLOW_PERCENT, "percent of nominal"), "target_hotend": (*TEMPERATURE_DEGC, "degC"),
        "hotend": (*TEMPERATURE_DEGC, "degC"),
        LABELS: (0.0, 2.0, "0 under, 1 good, 2 over"),
    }  # fmt: skip
    for name, (low, high, unit) in bounds.items():
        values = numbers.get(name, np.zeros(0))
        wrong = (
            (values < low)
            | (values > high)
            | ((name == LABELS) & (values != np.rint(values)) & np.isfinite(values))
        )
        if wrong.any():
            i = int(np.flatnonzero(wrong)[0])
            suffix = f", the first of {wrong.sum()}" if wrong.sum() > 1 else ""
            remedy = (
                "mend it, or remove that column" if name == LABELS else "mend it, or write it in that unit"
            )
            raise ValueError(
                f"{path}: line {lines[i]}: expected {name} within {low:g} and {high:g} ({unit}), "
                f"found {values[i]:g}{suffix}; {remedy}"
            )


def _check_time(
    path: Path, lines: np.ndarray, stamps: Sequence[str], which: np.ndarray, prints: Sequence[str]
) -> None:
    """Raises ValueError if time runs backwards within a print. Equal times are allowed. Rows in sequence must
    have been recorded in sequence."""
    present = np.array([bool(stamp) for stamp in stamps])
    plain = [stamp for stamp in stamps if stamp]
    try:
        times = np.array(plain, float)
    except ValueError:
        first = month_first({stamp.split()[0] for stamp in plain}, plain[0])
        try:
            # CAXTON writes a fraction of a second behind a hyphen, 13:12:50-34
            clock = instants(
                path, "timestamp", plain, lines[present].tolist(), month_first=first, hyphen_fraction=True
            )
            times = clock.ns.astype(float) / 1e9
        except ValueError as error:
            raise ValueError(str(error).replace("name another column", "remove that column")) from None
    which, lines, names = which[present], lines[present], list(itertools.compress(prints, present))
    order = np.argsort(which, kind="stable")
    back = np.flatnonzero((np.diff(times[order]) < 0) & (np.diff(which[order]) == 0))
    if len(back):
        i, previous = order[back[0] + 1], order[back[0]]
        suffix = f", the first of {len(back)} such lines" if len(back) > 1 else ""
        raise ValueError(
            f"{path}: line {lines[i]}: expected time to run forward within print {names[i]!r}, "
            f"found it {times[previous] - times[i]:.6g} s before line {lines[previous]}{suffix}; "
            "sort the rows of each print by timestamp, or give what comes after a clock was set back "
            "a print_id of its own"
        )


# ---- recordings


def read_recording(
    path: Path, label: Path, where: Topics, tip_px: tuple[float, float] | None, *, front_end: Any
) -> FrameFile:
    """Returns the key areas of a recording, with the setpoints that applied when each frame was taken. Only a
    few frames are in memory at a time. `label`: the path to use in messages.

    The tip is `tip_px` or, if that is None, the recording's. The print is the recording's print_id, or else
    its file name. Raises ValueError, one sentence, if the file cannot be read, has no such topic, or has
    frames and setpoints that do not overlap in time. Damaged parts are left out and noted.
    """
    try:
        return _read_recording(path, label, where, tip_px, front_end)
    except ValueError as error:
        raise ValueError(str(error).replace(str(path), str(label))) from None
    except OSError as error:
        # what cannot be written is said already
        if not error.strerror:
            raise
        raise ValueError(
            f"{label} cannot be read ({error.strerror}); check the disk, or copy the recording again"
        ) from None


def open_film(
    path: Path, where: Topics
) -> tuple[Frames, dict[str, tuple[np.ndarray, np.ndarray]], list[Note]]:
    """Returns the frames in the order of time, {signal: (time_s (n,), values (n,))} of the signals that the
    recording has, on the same clock, and notes on damage."""
    frames, signals, _, notes = read_frames(
        path,
        where.sources().values(),
        what="nozzle frames",
        image=where.image,
        clock=where.time or "log_time",
        unreadable_share=1.0,
        # what was mapped on purpose must be there
        optional=set(UNITS) - set(NEEDED) - set(where.mapping),
        section=PLACE,
    )
    return frames, signals, notes


def frames_at(path: Path, where: Topics, places: Sequence[int]) -> dict[int, np.ndarray]:
    """Returns {place: gray frame} of a recording. Places count, from 0 in the order of time, the frames that
    can be decoded. Other frames are not kept in memory."""
    frames, _, _ = open_film(path, where)
    first = enumerate(itertools.islice(frames, max(places, default=-1) + 1))
    return {k: np.array(frame) for k, (_, frame) in first if k in places}


def middle_frame(path: Path, image: str) -> np.ndarray:
    """Returns the frame (height, width) in the middle of a recording's image topic `image`, or of its only
    image topic if `image` is empty. Raises ValueError if no picture can be decoded."""
    camera = image_topic(path, open_topics(path, "a film"), image, f"{PLACE}.image")
    frames = Frames(TopicColumns(McapFile(path), "log_time"), camera, 1.0)
    for _, picture in itertools.islice(frames.pictures(), len(frames) // 2, None):
        with contextlib.suppress(UnreadableMessage):
            return gray(picture)
    raise ValueError(
        f"{path}: expected a picture on {camera.name}, found none that can be decoded ({damage(path)}); "
        "copy the recording again"
    )


def _read_recording(
    path: Path, label: Path, where: Topics, tip_px: tuple[float, float] | None, front_end: Any
) -> FrameFile:
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
        _hold(signals, name, time_s) for name in ("flow_percent", "temperature_degC", "print_id")
    )
    prints = (
        [f"{value:g}" if np.isfinite(value) else "" for value in number]
        if "print_id" in signals
        else [label.stem] * len(time_s)
    )
    settings, degrees = [flow, number], np.nan_to_num(temperature, nan=-1.0)
    if np.count_nonzero(degrees[1:] != degrees[:-1]) <= max(MEASURED, len(time_s) / MEASURED):
        settings.append(degrees)
    else:
        sentence = (
            "its temperature changes all the time, so it is measured and ends no segment; "
            "map the setpoint if there is one"
        )
        notes.append(Note("temperature", "temperature_degC", 1, sentence))
    reasons = areas.reasons
    for reason, values in ((NO_TEMPERATURE, temperature), (NO_FLOW, flow)):
        present_rows = np.isfinite(values)
        reasons = [front if present else reason for front, present in zip(reasons, present_rows, strict=True)]
    return FrameFile(
        label,
        areas._replace(reasons=reasons),
        flow,
        temperature,
        prints,
        stretches(np.column_stack(settings)),
        [f"{time:.3f} s" for time in time_s],
        [(label, i) for i in range(len(time_s))],
        [note._replace(message=f"{label}: {note.message}") for note in [*notes, *frames.notes()]],
    )


def _find_all(
    path: Path, frames: Frames, signals: Mapping, tip_px: tuple[float, float] | None, front_end: Any
) -> tuple[np.ndarray, Any]:
    """Returns (time_s (n,), the front end's results), for the frames that can be decoded."""
    times, pieces, walking = [], [], iter(frames)
    while batch := list(itertools.islice(walking, AT_ONCE)):
        time_s = np.array([time for time, _ in batch])
        tips = np.column_stack([_hold(signals, name, time_s) for name in ("tip_x_px", "tip_y_px")])
        tips = tips if tip_px is None else np.broadcast_to(np.array(tip_px, float), tips.shape)
        directions = _hold(signals, "travel_direction_deg", time_s)
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


def _hold(signals: Mapping[str, tuple[np.ndarray, np.ndarray]], name: str, time_s: np.ndarray) -> np.ndarray:
    """Returns the signal's value at each time (n,). A setpoint holds until the next one. NaN before the first
    one, and if there is no such signal."""
    if name not in signals:
        return np.full(len(time_s), np.nan)
    at, values = signals[name]
    last = np.searchsorted(at, time_s, side="right") - 1
    return np.where(last < 0, np.nan, values[np.maximum(last, 0)])


# ---- parts -> one


def _of_log(
    log: FrameLog,
    pieces: Sequence[Any],
    problems: list[str],
    images: list[Path],
    material: Any,
    notes: list[Note],
) -> FrameFile:
    areas = concatenate(pieces)
    areas = areas._replace(reasons=[own or front for own, front in zip(problems, areas.reasons, strict=True)])
    label, labelled = material.label(log.flow), np.isfinite(log.label) & np.isfinite(log.flow)
    wrong = np.flatnonzero(labelled & (log.label != label))
    notes = [*log.notes, *notes]
    if len(wrong):
        i = wrong[0]
        notes.append(
            Note(
                "labels", "", len(wrong),
                f"{log.path}: flow_rate_class contradicts flow_rate in {len(wrong)} of {labelled.sum()} "
                f"lines, the first line {log.line[i]}: "
                f"class {log.label[i]:g} at "
                f"{log.flow[i]:g} percent, which is class {label[i]}; flow_rate was taken",
            )
        )  # fmt: skip
    places = [
        f"line {line}, {' '.join(image.split())[-LONGEST:] or 'no image'}"
        for line, image in zip(log.line, log.image, strict=True)
    ]
    pictures = [(image, -1) for image in images]
    return FrameFile(
        log.path, areas, log.flow, log.temperature, log.print_id, log.setting, places, pictures, notes
    )


def _join(folder: Path, parts: Sequence[FrameFile], options: ReadOptions, notes: list[Note]) -> NozzleFrames:
    """Returns all parts as one, without copies of frames. Counts every rejection by file and reason. Flows
    and temperatures are converted to the published material."""
    digests: set[str] = set()
    notes, reasons, starts = list(notes), [], [0]
    for part in parts:
        problems = list(part.areas.reasons)
        for i, digest in enumerate(part.areas.digests):
            if digest and not problems[i]:
                problems[i] = COPY if digest in digests else ""
                digests.add(digest)
        notes += [*part.notes, *_rejections(folder, part, problems, REMEDIES | options.front_end.remedies)]
        reasons += problems
        starts.append(starts[-1] + int(part.stretch.max(initial=-1)) + 1)
    names = [name for part in parts for name in part.prints]
    prints = tuple(dict.fromkeys(name for name in names if name))
    number = {name: i for i, name in enumerate(prints)}
    areas = concatenate([part.areas for part in parts])
    flow, temperature = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("flow", "temperature")
    )
    valid = np.array([not reason for reason in reasons], bool)
    if not valid.any():
        worst = max(notes, key=lambda note: note.count if note.kind == "frames" else -1, default=None)
        raise ValueError(
            f"{folder}: none of {len(valid)} frames can be learned from: "
            f"{worst.message if worst else 'none is listed'}"
        )
    images = np.where(valid[:, None, None], areas.images, 0).astype(np.uint8)
    label = np.where(np.isfinite(flow), options.material.label(np.nan_to_num(flow)), -1)
    segment = np.concatenate([part.stretch + start for part, start in zip(parts, starts, strict=False)])
    source = [f"{part.path}: {place}" for part in parts for place in part.places]
    which = np.array([number.get(name, -1) for name in names], int)
    return NozzleFrames(
        images,
        label,
        options.material.published_flow(flow),
        options.material.published_temperature(temperature),
        which,
        segment,
        valid,
        reasons,
        areas.angle_deg,
        areas.miss_px,
        areas.score,
        areas.padded_share,
        areas.tip,
        areas.surroundings,
        source,
        [picture for part in parts for picture in part.pictures],
        prints,
        notes,
    )


def _rejections(
    folder: Path, part: FrameFile, reasons: Sequence[str], remedies: Mapping[str, str]
) -> list[Note]:
    """Returns one note for each kind of reason, with the first frame and the remedy."""
    by_kind: dict[str, list[int]] = {}
    for i, reason in enumerate(reasons):
        if reason:
            by_kind.setdefault(_kind(reason), []).append(i)
    notes = []
    for kind, rows in by_kind.items():
        first = rows[0]
        detail = reasons[first].partition(": ")[2]
        where = f" (looked for below {folder})" if kind == MISSING else f" ({detail})" if detail else ""
        message = (
            f"{part.path}: {len(rows)} of {len(reasons)} frames were left out: {kind}, "
            f"the first {part.places[first]}{where}; "
            f"{remedies.get(kind, LOOK)}"
        )
        notes.append(Note("frames", "", len(rows), message))
    return notes


def _kind(reason: str) -> str:
    return reason.partition(":")[0]


def key_areas_of_files(
    paths: Sequence[str], tips: np.ndarray, directions_deg: np.ndarray, front_end: Any
) -> Any:
    """Returns the front end's results for image files with tips (n, 2) in px and travel directions (n,) in
    degrees, NaN if not known. Only one file's pixels are in memory at a time. An empty path is a frame that
    is skipped."""
    digests = [_digest(path) for path in paths]

    def find() -> Any:
        with contextlib.closing(open_images(paths)) as pictures:
            return front_end.find(pictures, tips, directions_deg)

    areas = front_end.remember((digests, tips.tolist(), directions_deg.tolist()), len(paths), find)
    return areas._replace(digests=digests)


def concatenate(parts: Sequence[Any]) -> Any:
    """Returns the frames of all parts, one part after the other. Each part is a tuple of columns."""
    columns = zip(*parts, strict=True)
    return type(parts[0])(
        *(
            np.concatenate(some)
            if isinstance(some[0], np.ndarray)
            else [item for part in some for item in part]
            for some in columns
        )
    )


def _digest(path: str) -> str:
    """Returns the digest of the file's bytes, empty if it cannot be opened."""
    try:
        return sha256(path)[: 2 * DIGEST_BYTES] if path else ""
    except OSError:
        return ""
