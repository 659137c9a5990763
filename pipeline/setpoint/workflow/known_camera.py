"""The camera that the classifier was made for, by the look of its frames: of rendered segments, or of a
user's folder; to a file and back."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from joblib import delayed
from tqdm import tqdm

from pipeline.setpoint import familiar, nozzle_scene
from pipeline.setpoint.familiar import Camera
from pipeline.setpoint.workflow import frame_folder
from pipeline.setpoint.workflow.frame_folder import NozzleFrames
from pipeline.setpoint.workflow.settings import TrainClassifier
from pipeline.store import artifacts
from pipeline.store.execution import run_all
from pipeline.store.params import Execution

KNOWN_CAMERA = ("known_camera", 1)
# of windows of the known camera, the share that may be called foreign; pictures of other machines lie so far
# off that it may be small
FALSE_ALARMS = 0.01
# rendered segments, each seen in one window at one flow
SEGMENTS = 400
# its place among the seeds of the stage
STREAM = 20
MEMO = Path("datasets/memo/train_classifier")


def known(settings: TrainClassifier, folder: str, execution: Execution) -> Camera | None:
    """The camera of the frames that the classifier learns from; None where a folder has too few windows to
    know it by: then every frame is foreign."""
    if settings.source == "simulated":
        return rendered(settings, execution)
    options = frame_folder.read_options(settings)
    frames = frame_folder.read_folder(Path(folder), options, execution, memo=MEMO)
    try:
        return recorded(frames, length=settings.window)
    except ValueError:
        return None


def rendered(settings: TrainClassifier, execution: Execution) -> Camera:
    """Of SEGMENTS rendered segments at flows over the whole range."""
    calls = [delayed(_window)((settings.seed, STREAM, i), settings.least_score) for i in range(SEGMENTS)]
    running = run_all(calls, execution)
    rows = np.array(list(tqdm(running, total=SEGMENTS, desc="train_classifier: known camera", mininterval=2)))
    return familiar.fit_camera(rows, np.arange(SEGMENTS), false_alarms=FALSE_ALARMS)


def _window(seed: Sequence[int], least_score: float) -> np.ndarray:
    """(measures,) of a few frames of one new segment."""
    rng = np.random.default_rng(seed)
    flow = np.full(familiar.FRAMES + 1, np.exp(rng.uniform(*np.log(nozzle_scene.FLOWS))))
    segment, degrees = nozzle_scene.draw_segment(rng), rng.choice(nozzle_scene.TEMPERATURES)
    scene = nozzle_scene.render(segment, flow, degrees, rng)
    areas = nozzle_scene.key_areas(scene, least_score=least_score)
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


def store_camera(path: Path, camera: Camera) -> None:
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


def restore_camera(path: str | Path) -> Camera:
    """What `store_camera` wrote. Raises ValueError for a file of other measures."""
    arrays = artifacts.read_arrays(str(path), *KNOWN_CAMERA)
    if arrays["mean"].shape != (len(familiar.NAMES),):
        raise ValueError(
            f"{path}: expected {len(familiar.NAMES)} measures, found {arrays['mean'].shape}; "
            f"{artifacts.remedy(str(path))}"
        )
    return Camera(*(arrays[name] for name in Camera._fields))
