"""The camera that the classifier was made for, to a file and back."""

from pathlib import Path

import numpy as np

from pipeline.setpoint.frames import familiar
from pipeline.setpoint.frames.familiar import Camera
from pipeline.store import artifacts

FILE, KNOWN_CAMERA = "known_camera.parquet", ("known_camera", 1)
# of windows of the known camera, the share that may be called foreign; pictures of other machines lie so far
# off that it may be small
FALSE_ALARMS = 0.01


def store_camera(path: Path, camera: Camera | None) -> None:
    """Writes the camera; empty arrays where there is none."""
    mean, deviation, whitening, scores = camera or Camera(*(np.zeros(0) for _ in Camera._fields))
    units = "1", "as the measures of familiar.NAMES"
    artifacts.write_arrays(
        path,
        *KNOWN_CAMERA,
        {
            "mean": (mean, *units),
            "deviation": (deviation, *units),
            "whitening": (whitening, "1", "inverse Cholesky factor of the measures in deviations"),
            "scores": (scores, "1", "of windows of other segments, rising"),
        },
    )


def restore_camera(path: str | Path) -> Camera | None:
    """What `store_camera` wrote, None where there was no camera. Raises ValueError for a file of other
    measures."""
    arrays = artifacts.read_arrays(str(path), *KNOWN_CAMERA)
    if not arrays["scores"].size:
        return None
    if arrays["mean"].shape != (len(familiar.NAMES),):
        raise ValueError(
            f"{path}: expected {len(familiar.NAMES)} measures, found {arrays['mean'].shape}; "
            f"{artifacts.remedy(str(path))}"
        )
    return Camera(*(arrays[name] for name in Camera._fields))
