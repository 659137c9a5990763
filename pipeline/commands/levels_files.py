"""The levels of a camera, to a file and back."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.setpoint.frames.familiar import KnownCamera
from pipeline.setpoint.levels import Levels, LevelWindows
from pipeline.store import artifacts

# where they are written, and looked for by all who read windows of this camera
LEVELS_FILE = "datasets/levels/levels.parquet"
SCHEMA = ("levels", 1)


class RecordedLevels(NamedTuple):
    """The correction, the windows that it was fitted on, the digest of the classifier's weights that showed
    them (of another classifier it says nothing); how this camera looks, None if there were too few windows
    to know it by, and the distance above which a frame of it is foreign."""

    levels: Levels
    windows: LevelWindows
    weights: str
    camera: KnownCamera | None
    foreign_above: float


def store_levels(path: str | Path, recorded: RecordedLevels) -> None:
    """Raises OSError, one sentence, if it cannot be written."""
    fitted, windows = recorded.levels, recorded.windows
    digest = np.frombuffer(bytes.fromhex(recorded.weights), np.uint8)
    camera = recorded.camera or KnownCamera(*(np.zeros(0) for _ in KnownCamera._fields))
    artifacts.write_arrays(
        path,
        *SCHEMA,
        {
            "log_seen": (fitted.log_seen, "1", "knots: log of what a window shows over 100 %"),
            "log_flow": (fitted.log_flow, "1", "log of the flow there over 100 %"),
            "slope": (np.array(fitted.slope), "1", "of log flow by log shown, beyond the knots"),
            "spread": (np.array(fitted.spread), "1", "relative deviation of a window's corrected flow"),
            "straight": (np.array(fitted.straight), "1", "1 where the correction is a line"),
            "window_seen": (
                windows.seen,
                "percent",
                "flow of the published material that each window showed",
            ),
            "window_flow": (
                windows.flow,
                "percent",
                "flow that was commanded, carried to the published material",
            ),
            "foreign_above": (
                np.array(recorded.foreign_above),
                "1",
                "distance above which a frame is foreign",
            ),
            **{
                f"camera_{name}": (values, "1", f"how this camera looks: familiar.Camera.{name}")
                for name, values in camera._asdict().items()
            },
            "weights": (digest, "1", "SHA-256 of the classifier's weights, byte by byte"),
        },
    )


def restore_levels(path: str | Path, weights: str) -> RecordedLevels:
    """What `store_levels` wrote. Raises ValueError if it is of another classifier than that with the
    digest `weights`, or is no such file."""
    found = artifacts.read_arrays(path, *SCHEMA)
    digest = found["weights"].astype(np.uint8).tobytes().hex()
    if digest != weights:
        raise ValueError(
            f"{path} holds levels that another classifier saw ({digest[:8]}, the classifier is "
            f"{weights[:8]}); record them again with ./run beadline calibrate levels, or remove the file"
        )
    fitted = Levels(
        found["log_seen"],
        found["log_flow"],
        float(found["slope"]),
        float(found["spread"]),
        bool(found["straight"]),
    )
    looks = KnownCamera(*(found[f"camera_{name}"] for name in KnownCamera._fields))
    windows = LevelWindows(found["window_seen"], found["window_flow"])
    known = looks if looks.scores.size else None
    return RecordedLevels(fitted, windows, digest, known, float(found["foreign_above"]))
