"""Image files -> gray pictures, and what a front end makes of them."""

import contextlib
import os
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.recordings.image_messages import check_size
from pipeline.store import artifacts

DIGEST_BYTES = 16
MISSING, UNREADABLE = "the image is missing", "the image cannot be read"
# the error stream is the process's: threads of a cluster's worker take turns
_LISTENING = threading.Lock()


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


def key_areas_of_files(
    paths: Sequence[str], tips: np.ndarray, directions_deg: np.ndarray, front_end: Any
) -> Any:
    """What a front end makes of image files with tips (n, 2) in px and travel directions (n,) in degrees, NaN
    if they are not known; one file's pixels in memory at a time. An empty path is a frame that is not looked
    at."""
    digests = [_digest(path) for path in paths]

    def find() -> Any:
        with _decoder_complaints() as complaint_of:
            return front_end.find((_opened(path, complaint_of) for path in paths), tips, directions_deg)

    areas = front_end.remember((digests, tips.tolist(), directions_deg.tolist()), len(paths), find)
    return areas._replace(digests=digests)


def concatenate(parts: Sequence[Any]) -> Any:
    """The frames of all parts, each a tuple of columns, one part behind the other."""
    columns = zip(*parts, strict=True)
    return type(parts[0])(
        *(
            np.concatenate(some)
            if isinstance(some[0], np.ndarray)
            else [one for part in some for one in part]
            for some in columns
        )
    )


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
