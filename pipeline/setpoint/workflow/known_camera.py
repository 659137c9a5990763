"""The camera that the classifier was made for, by the look of its frames: of rendered segments, or of a
user's folder; to a file and back."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from joblib import delayed
from tqdm import tqdm

from pipeline.setpoint import familiar, nozzle_scene
from pipeline.setpoint.familiar import Camera
from pipeline.setpoint.workflow.frame_folder import NozzleFrames
from pipeline.setpoint.workflow.settings import RenderFrames
from pipeline.store import artifacts
from pipeline.store.execution import run_all
from pipeline.store.params import Execution

FILE, KNOWN_CAMERA = "known_camera.parquet", ("known_camera", 1)
# of windows of the known camera, the share that may be called foreign; pictures of other machines lie so far
# off that it may be small
FALSE_ALARMS = 0.01
# of rendered segments, the place among the seeds of the stage, and the score below which a frame is not
# measured
STREAM, LEAST_SCORE = 20, 10.0


def known(rendered: Path, frames: NozzleFrames | None, *, length: int) -> Camera | None:
    """The camera of the frames that the classifier learns from: what render_frames left in the folder
    `rendered`, or that of recorded `frames`; None where they have too few windows of `length` to know it by:
    then nothing tells whether a frame is of that camera."""
    if frames is None:
        return restore_camera(rendered / FILE)
    try:
        return recorded(frames, length=length)
    except ValueError:
        return None


def drawn(settings: RenderFrames, execution: Execution) -> Camera:
    """The camera of rendered segments, each seen in one window at one flow, over the whole range."""
    count = settings.camera_segments
    calls = [delayed(_window)((settings.seed, STREAM, i)) for i in range(count)]
    running = run_all(calls, execution)
    rows = np.array(list(tqdm(running, total=count, desc="render_frames: known camera", mininterval=2)))
    return familiar.fit_camera(rows, np.arange(count), false_alarms=FALSE_ALARMS)


def _window(seed: Sequence[int]) -> np.ndarray:
    """(measures,) of a few frames of one new segment."""
    rng = np.random.default_rng(seed)
    flow = np.full(familiar.FRAMES + 1, np.exp(rng.uniform(*np.log(nozzle_scene.FLOWS))))
    segment, degrees = nozzle_scene.draw_segment(rng), rng.choice(nozzle_scene.TEMPERATURES)
    scene = nozzle_scene.render(segment, flow, degrees, rng)
    areas = nozzle_scene.key_areas(scene, least_score=LEAST_SCORE)
    return familiar.of_window(scene.frames, np.array(scene.tip), areas)


def recorded(frames: NozzleFrames, *, length: int) -> Camera:
    """Of a folder's windows of `length` frames in a row at constant settings. What errs together is such a
    stretch; where there are too few of them, a window. Raises ValueError where those are too few as well."""
    windows, stretch = window_medians(frames, length=length)
    try:
        return familiar.fit_camera(windows, stretch, false_alarms=FALSE_ALARMS)
    except ValueError:
        return familiar.fit_camera(windows, np.arange(len(windows)), false_alarms=FALSE_ALARMS)


def window_medians(frames: NozzleFrames, *, length: int) -> tuple[np.ndarray, np.ndarray]:
    """(measures of the windows (w, f), stretch of each (w,)), of those with a measured frame."""
    rows, stretch = [], []
    for number in np.unique(frames.segment):
        mine = frames.surroundings[frames.segment == number]
        for start in range(0, len(mine) - length + 1, length):
            rows.append(familiar.median(mine[start : start + length].astype(float)))
            stretch.append(number)
    windows = np.array(rows, float).reshape(-1, frames.surroundings.shape[1])
    sound = np.isfinite(windows).all(axis=1)
    return windows[sound], np.array(stretch, int)[sound]


def store_camera(path: Path, camera: Camera | None) -> None:
    """Writes the camera; nothing where there is none."""
    if camera is None:
        return
    units = "1", "as the measures of familiar.NAMES"
    artifacts.write_arrays(
        path,
        *KNOWN_CAMERA,
        {
            "mean": (camera.mean, *units),
            "deviation": (camera.deviation, *units),
            "whitening": (camera.whitening, "1", "inverse Cholesky factor of the measures in deviations"),
            "scores": (camera.scores, "1", "of windows of other segments, rising"),
        },
    )


def known_to_classifier() -> Camera | None:
    """The camera of what train_classifier learned from; None where that had too few windows to know it by."""
    path = f"datasets/train_classifier/{FILE}"
    return restore_camera(path) if artifacts.exists(path) else None


def restore_camera(path: str | Path) -> Camera:
    """What `store_camera` wrote. Raises ValueError for a file of other measures."""
    arrays = artifacts.read_arrays(str(path), *KNOWN_CAMERA)
    if arrays["mean"].shape != (len(familiar.NAMES),):
        raise ValueError(
            f"{path}: expected {len(familiar.NAMES)} measures, found {arrays['mean'].shape}; "
            f"{artifacts.remedy(str(path))}"
        )
    return Camera(*(arrays[name] for name in Camera._fields))
