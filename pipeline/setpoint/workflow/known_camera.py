"""The camera that the classifier was made for, by the look of its frames: of rendered segments, or of a
user's folder."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from joblib import delayed
from tqdm import tqdm

from pipeline.setpoint.frames import familiar, nozzle_scene
from pipeline.setpoint.frames.familiar import Camera
from pipeline.setpoint.workflow.camera_files import FALSE_ALARMS, FILE, restore_camera
from pipeline.setpoint.workflow.frame_folder import NozzleFrames
from pipeline.setpoint.workflow.settings import RenderFrames
from pipeline.store.execution import run_all
from pipeline.store.params import Execution

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
