"""Image files -> key areas, a batch at a time; what was cut before, from the
same bytes by the same code, is taken from a memo."""

import contextlib
import itertools
import os
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import joblib
import numpy as np

from pipeline.reading.image_messages import check_size
from pipeline.setpoint.frames import familiar, key_area, travel
from pipeline.store import artifacts
from pipeline.store.tables import FLOAT, NONE, TEXT, Column, Schema, bytes_of

HERE = Path(__file__).parents[2]
# the code that decides what an entry of the memo holds
CODE = (
    "setpoint/workflow/frame_images.py", "setpoint/workflow/frame_mcap.py", "setpoint/key_area.py",
    "setpoint/travel.py", "setpoint/familiar.py",
    "store/mcap_frames.py",
    "reading/image_messages.py", "reading/image_topics.py",
)  # fmt: skip
DIGEST_BYTES = 16
# of so many frames the first accepted one is measured as the known camera's are: four of a window
MEASURED = 5
# frames among which the ground's motion is sought at a time
IN_A_ROW = 20
# cameras of 10 and 12 bits may leave the upper ones of 16 empty; a picture as dark as that
# has fewer than 16 of 256 gray levels in any case
FILLED_BITS = 12
MISSING, UNREADABLE, NO_TIP, UNUSABLE = (
    "the image is missing",
    "the image cannot be read",
    "no tip is known",
    "the frame cannot be used",
)
# the error stream is the process's: threads of a cluster's worker take turns
_LISTENING = threading.Lock()
KEY_AREAS = Schema(
    "key_areas",
    2,
    (
        Column(
            "image", bytes_of(key_area.SHAPE[0] * key_area.SHAPE[1]), NONE, "16 x 48 gray levels, row by row"
        ),
        Column("angle_deg", FLOAT, "deg", "direction of the line, 0 right, 90 down", nullable=True),
        Column("miss_px", FLOAT, "px", "by which the line passes beside the tip", nullable=True),
        Column("score", FLOAT, NONE, "ridge in gray levels", nullable=True),
        Column("padded_share", FLOAT, NONE, "share of the crop outside the frame", nullable=True),
        Column("tip_x_px", FLOAT, "px", "where the tip was taken to be", nullable=True),
        Column("tip_y_px", FLOAT, "px", "where the tip was taken to be", nullable=True),
        Column(
            "surroundings",
            bytes_of(4 * len(familiar.NAMES)),
            NONE,
            "measures of familiar.NAMES, single precision, NaN where not taken",
        ),
        Column("reason", TEXT, NONE, "why there is no key area; empty where there is one"),
        Column("digest", TEXT, NONE, "of the frame: equal frames have equal ones"),
    ),
)


class FrameKeyAreas(NamedTuple):
    """What the front end made of n frames: images (n, 16, 48) uint8, zeros where rejected; angle_deg,
    miss_px, score, padded_share (n,), NaN where nothing was looked at; tip (n, 2) in px; surroundings (n,
    measures) float32 of the first accepted of every MEASURED frames, NaN of the others; n reasons, empty
    where there is a key area; n digests of what the frame held."""

    images: np.ndarray
    angle_deg: np.ndarray
    miss_px: np.ndarray
    score: np.ndarray
    padded_share: np.ndarray
    tip: np.ndarray
    surroundings: np.ndarray
    reasons: list[str]
    digests: list[str]


# those of its fields that are arrays
ARRAYS = ("images", "angle_deg", "miss_px", "score", "padded_share", "tip", "surroundings")


def read_image(path: str | Path) -> np.ndarray:
    """The picture (height, width) in gray, uint8 or uint16, as the camera wrote it: a rotation noted
    beside the pixels is not applied. Raises ValueError."""
    with _decoder_complaints() as complaint_of:
        picture = _opened(str(path), complaint_of)
    reason = picture.partition(": ")[2] if isinstance(picture, str) else ""
    if reason:
        raise ValueError(
            f"{path}: expected a whole picture (JPEG, PNG, TIFF, BMP, WebP), found {reason}; "
            "check the name, or copy it again"
        )
    return picture


def decode(data: bytes) -> np.ndarray:
    """The picture (height, width) in gray, uint8 or uint16, of an encoded file.
    Raises ValueError that says what was found instead."""
    if not data:
        raise ValueError("an empty file")
    # a broken end is filled with gray: the end mark must follow the last scan
    if data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        raise ValueError(f"a JPEG of {len(data)} bytes without its end")
    check_size(data)
    try:
        frame = cv2.imdecode(
            np.frombuffer(data, np.uint8),
            cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION,
        )
    except cv2.error:
        frame = None
    if frame is None:
        raise ValueError(f"{len(data)} bytes that are no whole picture, beginning with {data[:8].hex(' ')}")
    if frame.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"pixels of {frame.dtype} in place of 8 or 16 bits")
    return frame


def crop_key_areas(
    paths: Sequence[str], tips: np.ndarray, directions_deg: np.ndarray, *, least_score: float, memo: Path
) -> FrameKeyAreas:
    """Key areas of image files with tips (n, 2) in px and travel directions (n,) in degrees, NaN where they
    are not known; one file's pixels in memory at a time.

    An empty path is a frame that is not to be looked at. An entry of the memo is
    named by the hash of all that decides what it holds.
    """
    digests = [_digest(path) for path in paths]
    entry = entry_of(memo, digests, tips.tolist(), directions_deg.tolist(), least_score)
    areas = read_memo(entry, len(paths))
    if not areas:
        with _decoder_complaints() as complaint_of:
            areas = find_key_areas(
                (_opened(path, complaint_of) for path in paths), tips, directions_deg, least_score=least_score
            )
        write_memo(entry, areas)
    return areas._replace(digests=digests)


def find_key_areas(
    frames: Iterable[np.ndarray | str], tips: np.ndarray, directions_deg: np.ndarray, *, least_score: float
) -> FrameKeyAreas:
    """What the front end makes of n frames of one film, or of a text that says why there is none; digests are
    left empty. A direction that is not known (NaN) is sought in the motion of the ground, where frames follow
    one another, IN_A_ROW of them in memory at a time."""
    areas: list[key_area.KeyArea] = []
    surroundings = np.full((len(tips), len(familiar.NAMES)), np.nan, np.float32)
    walking, measured = zip(frames, tips, directions_deg, strict=True), -1
    while some := list(itertools.islice(((_cropped(f, tip), d) for f, tip, d in walking), IN_A_ROW)):
        first = len(areas)
        areas += _found([one for one, _ in some], [float(d) for _, d in some], least_score)
        for i in range(first, len(areas)):
            cropped, area = some[i - first][0], areas[i]
            if i // MEASURED > measured and not area.reason and not isinstance(cropped, str):
                surroundings[i] = familiar.surroundings(cropped.gray, area.angle_deg, area.miss_px)
                measured = i // MEASURED
    images = np.array([area.image for area in areas], np.uint8).reshape(-1, *key_area.SHAPE)
    figures = (
        np.array([getattr(area, name) for area in areas], float)
        for name in ("angle_deg", "miss_px", "score", "padded_share")
    )
    reasons = [area.reason for area in areas]
    tip = np.where(np.isfinite(tips), tips, np.nan).reshape(-1, 2)
    return FrameKeyAreas(images, *figures, tip, surroundings, reasons, [""] * len(areas))


def _found(
    crops: Sequence[key_area.Crop | str], directions_deg: Sequence[float], least_score: float
) -> list[key_area.KeyArea]:
    """Key areas of crops that follow one another: along the direction told, or the motion of the ground where
    it can be seen, else of the only line there is."""
    moving = _motion(crops, directions_deg)
    areas = []
    for i, (one, told) in enumerate(zip(crops, directions_deg, strict=True)):
        if isinstance(one, str):
            empty = np.zeros(key_area.SHAPE, np.uint8)
            areas.append(key_area.KeyArea(empty, np.nan, np.nan, np.nan, np.nan, one))
        elif np.isfinite(told):
            areas.append(key_area.find_in(one, least_score=least_score, direction_deg=told))
        elif np.isfinite(moving[i][0]):
            areas.append(
                key_area.find_in(
                    one, least_score=least_score, direction_deg=moving[i][0], leeway_deg=travel.LEEWAY_DEG
                )
            )
        else:
            area = key_area.find_in(one, least_score=least_score)
            several = area.reason.startswith("several lines")
            areas.append(area._replace(reason=f"{area.reason} ({moving[i][1]})") if several else area)
    return areas


def _motion(
    crops: Sequence[key_area.Crop | str], directions_deg: Sequence[float]
) -> dict[int, tuple[float, str]]:
    """{place: (direction or NaN, why not)} of the frames of which nobody told the direction, as far as they
    follow one another."""
    unknown = [
        i
        for i, (one, told) in enumerate(zip(crops, directions_deg, strict=True))
        if not isinstance(one, str) and not np.isfinite(told)
    ]
    out: dict[int, tuple[float, str]] = {}
    for run in np.split(np.array(unknown, int), np.flatnonzero(np.diff(unknown) > 1) + 1):
        motion = travel.travel([crops[i].gray for i in run])
        out |= dict(
            zip(run.tolist(), zip(motion.direction_deg.tolist(), motion.reasons, strict=True), strict=True)
        )
    return out


def _cropped(frame: np.ndarray | str, tip: np.ndarray) -> key_area.Crop | str:
    """The crop round the tip (x, y), or the reason why there is none."""
    reason = frame if isinstance(frame, str) else _shallow(frame)
    if reason or not np.isfinite(tip).all():
        return reason or NO_TIP
    try:
        return key_area.crop(frame, (float(tip[0]), float(tip[1])))
    except ValueError as error:
        return f"{UNUSABLE}: {error}"


def _shallow(frame: np.ndarray) -> str:
    """Why a frame of 16 bits is not used of which a camera filled the
    lower ones alone: the front end would see black."""
    if frame.dtype != np.uint16 or frame.max() >= 1 << FILLED_BITS:
        return ""
    return (
        f"{UNUSABLE}: its 16 bits hold {frame.max()} at most, as of a camera of fewer bits; "
        "write its gray levels over all of 0 to 65535"
    )


def concatenate(parts: Sequence[FrameKeyAreas]) -> FrameKeyAreas:
    """The frames of all parts, one part behind the other."""
    arrays = (np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS)
    texts = (
        list(itertools.chain.from_iterable(getattr(part, name) for part in parts))
        for name in ("reasons", "digests")
    )
    return FrameKeyAreas(*arrays, *texts)


def _opened(path: str, complaint_of: Callable[[], str]) -> np.ndarray | str:
    """The frame, or the reason why there is none."""
    try:
        frame = decode(Path(path).read_bytes()) if path else MISSING
    except OSError as error:
        frame = f"{UNREADABLE}: {os.strerror(error.errno or 0).lower()}"
    except ValueError as error:
        frame = f"{UNREADABLE}: {error}"
    complaint = complaint_of()
    return f"{UNREADABLE}: {complaint}" if complaint and not isinstance(frame, str) else frame


@contextlib.contextmanager
def _decoder_complaints() -> Iterator[Callable[[], str]]:
    """A function that gives what the JPEG decoder has complained of since it was last asked: it mends what is
    damaged, and says so on the process's error stream alone."""
    at = 0

    def complaint_of() -> str:
        nonlocal at
        text = os.pread(stream.fileno(), 1 << 16, at)
        at += len(text)
        # padding between restart markers, as cameras write it, loses nothing
        return next(
            (
                line
                for line in text.decode(errors="replace").splitlines()
                if "JPEG" in line and "extraneous" not in line
            ),
            "",
        )

    with _LISTENING, tempfile.TemporaryFile() as stream:
        own = os.dup(2)
        os.dup2(stream.fileno(), 2)
        try:
            yield complaint_of
        finally:
            os.dup2(own, 2)
            os.close(own)


def _digest(path: str) -> str:
    """Of the file's bytes; empty where it cannot be opened."""
    try:
        return artifacts.sha256(path)[: 2 * DIGEST_BYTES] if path else ""
    except OSError:
        return ""


# ---- memo


def entry_of(memo: Path, *what: Any) -> Path:
    """The file of an entry: named by the hash of what it is made of, and of the code that makes it."""
    return memo / f"{joblib.hash((what, [artifacts.sha256(HERE / name) for name in CODE]))}.parquet"


def write_memo(entry: Path, areas: FrameKeyAreas) -> None:
    columns = {
        "image": [image.tobytes() for image in areas.images],
        **{name: getattr(areas, name) for name in ("angle_deg", "miss_px", "score", "padded_share")},
        "tip_x_px": areas.tip[:, 0],
        "tip_y_px": areas.tip[:, 1],
        "surroundings": [row.astype("<f4").tobytes() for row in areas.surroundings],
        "reason": areas.reasons,
        "digest": areas.digests,
    }
    artifacts.write_table(entry, KEY_AREAS, columns)


def read_memo(entry: Path, count: int) -> FrameKeyAreas | None:
    """An entry of so many frames that is whole, which the checksums of its pages tell."""
    try:
        table = artifacts.read_table(entry, KEY_AREAS)
    except ValueError:
        return None
    if len(table["image"]) != count:
        return None
    images = np.frombuffer(b"".join(table["image"]), np.uint8).reshape(-1, *key_area.SHAPE)
    measures = np.frombuffer(b"".join(table["surroundings"]), "<f4").reshape(-1, len(familiar.NAMES))
    figures = (table[name] for name in ("angle_deg", "miss_px", "score", "padded_share"))
    tip = np.column_stack([table["tip_x_px"], table["tip_y_px"]])
    texts = (table[name].tolist() for name in ("reason", "digest"))
    return FrameKeyAreas(images, *figures, tip, measures, *texts)
