"""A folder of nozzle frames -> key areas with class, temperature, print and segment for the classifier: CSV
files with images as CAXTON has them, and MCAP recordings.

Nothing is dropped: every frame that is listed has its row, and one that cannot be
learned from has the reason why, counted in the notes.
"""

import collections
import itertools
import os
import posixpath
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np
from tqdm import tqdm

from pipeline.recordings.excluded import readable
from pipeline.recordings.formats import Note
from pipeline.recordings.frame_csv import FrameLog, read_log
from pipeline.recordings.frame_images import MISSING, UNREADABLE, concatenate, key_areas_of_files, read_image
from pipeline.recordings.frame_mcap import RecordedFrames, Topics, frames_at, read_recording
from pipeline.store.artifacts import sha256
from pipeline.store.execution import run_all
from pipeline.store.params import Execution

CLASSES = ("under (flow below 90 %)", "good (90 to 110 %)", "over (above 110 %)")
# frames that one worker cuts at a time, and that the memo keeps together
TOGETHER = 256
# lines that tell where a file's images are
LOOKED_AT = 2000
# endings of what is written about recordings, and the longest path that is shown
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
    NO_PRINT: "fill in print_id, or remove that column where the file is one print",
    NO_NAME: "fill in img_path, or remove those lines",
    REPEATED: "remove the lines that repeat others",
    COPY: "record again with a camera that runs, or remove the copies",
}
LOOK = "look at a few with ./run beadline calibrate-tip IMAGE --tip X,Y"


class ReadOptions(NamedTuple):
    tip_px: tuple[float, float] | None  # (x, y) in px in every frame, or None if the data have it
    front_end: Any  # find(frames, tips, directions), remember(what, count, find), remedies
    topics: Topics  # of recordings
    material: Any  # label(flow), published_flow(flow), published_temperature(degC) of what is printed
    hotend: float = np.nan  # degC of CSV files that have no temperature, NaN where none is stated


class NozzleFrames(NamedTuple):
    """n frames, file by file and in a CSV print by print: images (n, 16, 48) uint8, zeros where not valid;
    label (n,) 0 under, 1 good, 2 over, -1 unknown; flow (n,) in percent of nominal and temperature (n,) in
    degC, as of the published material (material.py);
    print_number (n,) indexes `prints`; segment (n,) counts the stretches of constant settings; valid (n,); n
    reasons, empty where valid; angle_deg, miss_px, score and padded_share (n,), tip (n, 2) and surroundings
    (n, measures) of the front end; `source` says where each frame is from, `picture` (n) is its image's path
    or its recording's with the frame's place in it; notes say what was met."""

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


class _FrameFile(NamedTuple):
    """The frames of one file; reasons that the file itself gives go before those of the front end."""

    path: Path
    areas: Any  # what the front end made of them
    flow: np.ndarray
    temperature: np.ndarray
    prints: list[str]
    stretch: np.ndarray
    places: list[str]
    pictures: list[tuple[Path, int]]
    notes: list[Note]


def read_folder(folder: Path, options: ReadOptions, execution: Execution) -> NozzleFrames:
    """Every frame that the CSV files and recordings below `folder` list, in the order of their
    names, cut by as many workers as `execution` says.

    Images are looked for beside their CSV and from `folder` on, with the path as written or without its first
    folders. Raises ValueError, one sentence, for what read_log and read_recording refuse, for two lines that
    contradict one another about an image, and where no frame at all shows a line.
    """
    there = _images(folder)
    files = {
        ending: readable(sorted(folder / name for name in there if name.lower().endswith(ending)), folder)
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
    listed = [_image_paths(log, folder, there) for log in logs]
    reasons = _listed(logs, [images for images, _ in listed])
    calls = [
        _crops(log, folder, images, why, options)
        for log, (images, _), why in zip(logs, listed, reasons, strict=True)
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
            why,
            [folder / image for image in images],
            options.material,
            notes,
        )
        for log, (images, notes), why, pieces in zip(logs, listed, reasons, calls, strict=True)
    ]
    parts += [_of_recording(path, film) for path, film in zip(recordings, results, strict=True)]
    read = {name for name in there if name.lower().endswith(tuple(files))}
    unread = there.difference(read, *(images for images, _ in listed))
    return _joined(folder, parts, options, copies + _unread(folder, unread))


def _crops(log: FrameLog, folder: Path, images: list[str], why: list[str], options: ReadOptions) -> list:
    """Calls that crop the key areas of a log's images, piece by piece; a line with a reason has no path."""
    tips = log.tip
    if options.tip_px is not None:
        tips = np.broadcast_to(np.array(options.tip_px, float), log.tip.shape)
    paths = [
        "" if reason else str(folder.resolve() / image) for image, reason in zip(images, why, strict=True)
    ]
    return [
        joblib.delayed(key_areas_of_files)(paths[at], tips[at], log.direction[at], options.front_end)
        for at in _pieces(log)
    ]


def check(folder: Path, frames: NozzleFrames) -> None:
    """Raises ValueError where nothing can be learned from the valid frames, or not be
    judged: one print only, or a class without a frame."""
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
    """What was read, counted, for the metrics."""
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
    """The gray pictures of (image, -1) or (recording, place among its frames). Raises ValueError if one
    cannot be read any more."""
    films = {
        path: frames_at(path, topics, [k for one, k in places if one == path])
        for path in {path: None for path, k in places if k >= 0}
    }
    return [films[path][k] if k >= 0 else read_image(path) for path, k in places]


# ---- which images


def _different(paths: Sequence[Path]) -> tuple[list[Path], list[Note]]:
    """The files without those that are another once more: what is learned from twice is
    trusted twice, and judged by what it was learned from."""
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
    """A note of files that are no recording, that no CSV names, and that are no text about the others."""
    names = [name for name in names if posixpath.splitext(name)[1].lower() not in TEXTS]
    sentence = (
        f"{folder}: {len(names)} files are named by no CSV and were not read, "
        f"the first {min(names, default='')}; "
        "list them in a CSV, or move them out"
    )
    return [Note("unread", "", len(names), sentence)] if names else []


def _images(folder: Path) -> set[str]:
    """Paths of all files that are not hidden, from `folder` on, with forward
    slashes; what links lead to once more is walked once."""
    files, walked = set(), set()
    for here, folders, names in os.walk(folder, followlinks=True):
        # a link may lead back to where it lies
        walked.add(os.path.realpath(here))
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".") and os.path.realpath(f"{here}/{name}") not in walked
        )
        inside = Path(here).relative_to(folder).as_posix()
        files.update(
            name if inside == "." else f"{inside}/{name}" for name in names if not name.startswith(".")
        )
    return files


def _image_paths(log: FrameLog, folder: Path, there: set[str]) -> tuple[list[str], list[Note]]:
    """Each image's path from `folder` on, empty where it is not there: all of a
    file's lie in one place, that where most are found."""
    parts = [[part for part in image.split("/") if part not in ("", ".")] for image in log.image]
    own = log.path.parent.relative_to(folder).as_posix()

    def below(base: str, first: int, some: Sequence[list[str]]) -> list[str]:
        named = [
            posixpath.normpath("/".join([base, *names[first:]])) if len(names) > first else ""
            for names in some
        ]
        return [name if name in there else "" for name in named]

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
                {posixpath.dirname(path) for path in there if posixpath.basename(path) in wanted}
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


def _listed(logs: Sequence[FrameLog], images: Sequence[list[str]]) -> list[list[str]]:
    """Why a line cannot be learned from, before any image is opened. Raises
    ValueError where two lines contradict one another."""
    first: dict[str, tuple[int, int]] = {}
    reasons = []
    for k, (log, paths) in enumerate(zip(logs, images, strict=True)):
        unknown = (
            (NO_FLOW, ~np.isfinite(log.flow)),
            (NO_TEMPERATURE, ~np.isfinite(log.temperature)),
            (NO_PRINT, np.array([not name for name in log.print_id], bool)),
        )
        why = [MISSING if not image else "" for image in paths]
        why = [NO_NAME if not named else reason for named, reason in zip(log.image, why, strict=True)]
        for reason, rows in unknown:
            for i in np.flatnonzero(rows):
                why[i] = reason
        for i, image in enumerate(paths):
            if why[i] == "" and first.setdefault(image, (k, i)) != (k, i):
                _check_alike(logs[first[image][0]], first[image][1], log, i)
                why[i] = REPEATED
        reasons.append(why)
    return reasons


def _check_alike(before: FrameLog, i: int, log: FrameLog, j: int) -> None:
    ours, theirs = (
        (one.flow[row], one.temperature[row], one.print_id[row]) for one, row in ((before, i), (log, j))
    )
    if ours != theirs:
        settings = [
            f"{flow:g} percent and {temperature:g} degC in print {name!r}"
            for flow, temperature, name in (theirs, ours)
        ]
        raise ValueError(
            f"{log.path}: line {log.line[j]}: expected {log.image[j]} once, "
            f"found it here with {settings[0]} and in line {before.line[i]} "
            f"of {before.path.name} "
            f"with {settings[1]}; remove the line that is wrong"
        )


def _pieces(log: FrameLog) -> Iterator[slice]:
    """At most TOGETHER lines of one print each: what is added to a folder does not move what was there."""
    ends = [i for i in range(1, len(log.print_id)) if log.print_id[i] != log.print_id[i - 1]]
    for start, stop in zip([0, *ends], [*ends, len(log.print_id)], strict=True):
        yield from (slice(k, min(k + TOGETHER, stop)) for k in range(start, stop, TOGETHER))


# ---- parts -> one


def _of_log(
    log: FrameLog, pieces: Sequence[Any], why: list[str], images: list[Path], material: Any, notes: list[Note]
) -> _FrameFile:
    areas = concatenate(pieces)
    areas = areas._replace(reasons=[mine or front for mine, front in zip(why, areas.reasons, strict=True)])
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
    return _FrameFile(
        log.path, areas, log.flow, log.temperature, log.print_id, log.setting, places, pictures, notes
    )


def _of_recording(path: Path, film: RecordedFrames) -> _FrameFile:
    reasons = film.areas.reasons
    for reason, values in ((NO_TEMPERATURE, film.temperature), (NO_FLOW, film.flow)):
        reasons = [
            front if present else reason for front, present in zip(reasons, np.isfinite(values), strict=True)
        ]
    places = [f"{time:.3f} s" for time in film.time_s]
    return _FrameFile(
        path,
        film.areas._replace(reasons=reasons),
        film.flow,
        film.temperature,
        film.prints,
        film.stretch,
        places,
        [(path, i) for i in range(len(places))],
        film.notes,
    )


def _joined(
    folder: Path, parts: Sequence[_FrameFile], options: ReadOptions, notes: list[Note]
) -> NozzleFrames:
    """All parts, copies of frames left out, every rejection counted by file and reason; flows and
    temperatures carried to the published material."""
    digests: set[str] = set()
    notes, reasons, starts = list(notes), [], [0]
    for part in parts:
        why = list(part.areas.reasons)
        for i, digest in enumerate(part.areas.digests):
            if digest and not why[i]:
                why[i] = COPY if digest in digests else ""
                digests.add(digest)
        notes += [*part.notes, *_rejections(folder, part, why, REMEDIES | options.front_end.remedies)]
        reasons += why
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
    folder: Path, part: _FrameFile, reasons: Sequence[str], remedies: Mapping[str, str]
) -> list[Note]:
    """One note for each kind of reason, with the first frame and what to do."""
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
