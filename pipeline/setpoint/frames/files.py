"""Stores the camera that the classifier was made for, and rendered frames with their labels, in files, and
restores them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.setpoint.frames import familiar
from pipeline.setpoint.frames.familiar import KnownCamera
from pipeline.setpoint.frames.rendered import LabelledFrames
from pipeline.store import artifacts

CAMERA_FILE, CAMERA_SCHEMA = "known_camera.parquet", ("known_camera", 1)
FRAMES_SCHEMA = "frames 2"


def store_camera(path: Path, camera: KnownCamera | None) -> None:
    """Writes the camera; empty arrays if there is none."""
    mean, deviation, whitening, scores = camera or KnownCamera(*(np.zeros(0) for _ in KnownCamera._fields))
    units = "1", "as the measures of familiar.NAMES"
    artifacts.write_arrays(
        path,
        *CAMERA_SCHEMA,
        {
            "mean": (mean, *units),
            "deviation": (deviation, *units),
            "whitening": (whitening, "1", "inverse Cholesky factor of the measures in deviations"),
            "scores": (scores, "1", "of windows of other segments, rising"),
        },
    )


def restore_camera(path: str | Path) -> KnownCamera | None:
    """Returns the camera that `store_camera` wrote; None if there was none. Raises ValueError if the file has
    other measures."""
    arrays = artifacts.read_arrays(str(path), *CAMERA_SCHEMA)
    if not arrays["scores"].size:
        return None
    if arrays["mean"].shape != (len(familiar.NAMES),):
        raise ValueError(
            f"{path}: expected {len(familiar.NAMES)} measures, found {arrays['mean'].shape}; "
            f"{artifacts.remedy(str(path))}"
        )
    return KnownCamera(*(arrays[name] for name in KnownCamera._fields))


def store_frames(folder: Path, by_part: dict[str, LabelledFrames]) -> None:
    """Writes <part>.safetensors of each part. The texts of the reasons are not stored, only whether a frame
    is valid."""
    for part, frames in by_part.items():
        arrays = frames._asdict()
        del arrays["reasons"]
        artifacts.write_weights(folder / f"{part}.safetensors", FRAMES_SCHEMA, arrays, {"part": part})


def restore_frames(folder: Path, parts: Sequence[str]) -> dict[str, LabelledFrames]:
    """Returns these parts as `store_frames` wrote them, with one common reason for rejected frames."""
    by_part = {}
    for part in parts:
        arrays, _ = artifacts.read_weights(folder / f"{part}.safetensors", FRAMES_SCHEMA)
        reasons = np.where(arrays["valid"], "", "no fresh line: darker than its flank, or cut by the frame")
        by_part[part] = LabelledFrames(**arrays, reasons=reasons.astype(object))
    return by_part
