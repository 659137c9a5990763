"""The cameras' part of a night: pictures of new recordings held against those that the champion was made of;
and what of all that has changed is an alarm."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.nightly import camera_drift
from pipeline.nightly.inputs import quarantine
from pipeline.nightly.records import Alarm, LoopDrift
from pipeline.nightly.settings import DriftLimits
from pipeline.recordings import trial_files
from pipeline.recordings.excluded import readable
from pipeline.store import params

if TYPE_CHECKING:
    from pipeline.deposition.settings import Camera
    from pipeline.setpoint.settings import TrainClassifier

FRAMES = 40  # pictures of a recording that are looked at


# ---- deposition: the camera that rides with the nozzle


def of_trials(folder: Path, most: int, only: Sequence[str] = ()) -> list[list[Any]]:
    """[median, deviation, frames] of each of the last `most` trials below `folder`
    whose pictures show a bead; `only` those named."""
    rows, camera = [], _camera()
    trials = readable(sorted(folder.rglob("*.mcap")), folder)
    paths = [path for path in trials if not only or path.as_posix() in only]
    for path in paths[-most:]:
        try:
            stats = _frame_stats(trial_files.open_trial(path, **camera.recording))
        except ValueError:
            continue
        rows.append([stats.mean.tolist(), stats.deviation.tolist(), stats.frames])
    return rows


def _camera() -> "Camera":
    """Section `camera`, through whose topics a trial is read, however many of its frames can be."""
    from pipeline.deposition.settings import Camera

    return params.load(Camera, "camera").model_copy(update={"unreadable_share": 1.0})


def _frame_stats(trial: trial_files.TrialRecording) -> camera_drift.FrameStats:
    frames = trial.frames
    every = max(len(frames.time_s) // FRAMES, 1)
    return camera_drift.figures(
        [picture for k, (_, picture) in enumerate(frames) if k % every == 0 and picture is not None]
    )


def trials_drift(
    limits: DriftLimits, loop: str, paths: Sequence[str], reference: Mapping[str, Any], pending: set[str]
) -> LoopDrift:
    """Of new trials: those that cannot be read are set aside, the others' pictures held against those of
    `reference`."""
    drifted, camera = LoopDrift.none(loop), _camera()
    before = [
        camera_drift.FrameStats(np.array(mean), np.array(deviation), frames)
        for mean, deviation, frames in reference.get("camera", [])
    ]
    for path in (path for path in paths if path.lower().endswith(".mcap")):
        try:
            trial = trial_files.open_trial(path, **camera.recording)
        except ValueError as error:
            drifted.quarantined[path] = quarantine(path, loop, str(error))
            continue
        if not before:
            drifted.notes.append(
                f"{path}: the champion has no pictures of its own: the camera was not judged"
            )
            continue
        try:
            _, causes = camera_drift.changes(
                _frame_stats(trial), before, moved_px=limits.camera_px,
                contrast_percent=limits.contrast_percent,
            )  # fmt: skip
        except ValueError as error:
            drifted.notes.append(f"{path}: {error}")
            continue
        drifted = with_alarms(drifted, limits, path, causes, pending)
    return drifted


# ---- setpoint: the camera that looks at the nozzle


class PrintFigures(NamedTuple):
    """Of one print: frames by class and without a line (4,), frames of a segment, and the line's contrast."""

    name: str
    counts: np.ndarray
    segment_frames: float
    contrast: camera_drift.Contrast

    def to_json(self) -> list[Any]:
        """As the champion's reference.json keeps it."""
        contrast = [self.contrast.mean.tolist(), self.contrast.deviation.tolist()]
        return [self.name, self.counts.tolist(), self.segment_frames, *contrast]


def of_prints(folder: Path, most: int, only: Sequence[str] = ()) -> list[list[Any]]:
    """What reference.json keeps of the last `most` prints below `folder`; `only` those named."""
    return [figures.to_json() for figures in _print_figures(folder, most, only)]


def _print_figures(folder: Path, most: int, only: Sequence[str] = ()) -> list[PrintFigures]:
    from pipeline.recordings import nozzle_frames
    from pipeline.setpoint.recordings import read_options
    from pipeline.setpoint.settings import SetpointMaterial, TrainClassifier

    settings = params.load(TrainClassifier, "train_classifier")
    if settings.source != "recordings":
        return []
    material = params.load(SetpointMaterial, "setpoint_material").material()
    frames = nozzle_frames.read_folder(
        folder, read_options(settings, material), params.load(params.Execution, "execution")
    )
    prints = []
    numbered = [(number, name) for number, name in enumerate(frames.prints) if not only or name in only]
    for number, name in numbered[-most:]:
        here = frames.print_number == number
        good = here & frames.valid & (frames.label >= 0)
        if good.any():
            classes = np.bincount(frames.label[good], minlength=3).tolist()
            counts = np.array([*classes, int((here & ~frames.valid).sum())])
            together = float(here.sum() / len(np.unique(frames.segment[here])))
            contrast = camera_drift.line_contrast(frames.score[good], together=together)
            prints.append(PrintFigures(name, counts, together, contrast))
    return prints


def prints_drift(
    limits: DriftLimits,
    loop: str,
    folder: str,
    paths: Sequence[str],
    reference: Sequence[Sequence[Any]],
    pending: set[str],
) -> LoopDrift:
    """Drift of the new prints `paths` in the loop's folder of recordings. A file that cannot be read is set
    aside. Classes, frames without a line, and the line's contrast are compared with the prints that the
    champion's reference.json has under "camera"."""
    from pipeline.setpoint.settings import TrainClassifier

    drifted = LoopDrift.none(loop)
    settings = params.load(TrainClassifier, "train_classifier")
    if settings.source != "recordings":
        return drifted
    for path in paths:
        if reason := _unreadable(path, settings):
            drifted.quarantined[path] = quarantine(path, loop, reason)
    before = [
        PrintFigures(name, np.array(counts), together, camera_drift.Contrast(np.array(mean), np.array(std)))
        for name, counts, together, mean, std in reference
    ]
    if not before:
        return drifted
    names = {figures.name for figures in before}
    try:
        prints = [figures for figures in _print_figures(Path(folder), 10**6) if figures.name not in names]
    except ValueError as error:  # what the stage will refuse as well, and say so
        drifted.notes.append(str(error))
        return drifted
    usual, contrasts = np.array([figures.counts for figures in before]), [p.contrast for p in before]
    for figures in prints:
        causes = camera_drift.balance_changes(
            figures.counts, usual, together=figures.segment_frames, points=limits.balance_points
        )
        causes += camera_drift.contrast_changes(figures.contrast, contrasts, percent=limits.contrast_percent)
        drifted = with_alarms(drifted, limits, figures.name, causes, pending)
    return drifted


def _unreadable(path: str, settings: "TrainClassifier") -> str:
    """Why a print's file cannot be read; empty where it can."""
    from pipeline.recordings import nozzle_frames
    from pipeline.setpoint.recordings import read_options

    try:
        if path.lower().endswith(".csv"):
            nozzle_frames.read_log(Path(path))
        elif path.lower().endswith(".mcap"):
            nozzle_frames.open_film(Path(path), read_options(settings).topics)
    except ValueError as error:
        return str(error)
    return ""


# ---- what is an alarm


def with_alarms(
    drifted: LoopDrift,
    limits: DriftLimits,
    path: str,
    causes: Sequence[camera_drift.CameraChange],
    pending: set[str],
    consequences: Sequence[str] = (),
) -> LoopDrift:
    """The loop's drift with the causes that a recording shows. A cause is an alarm where it is sure at once,
    or has been watched the night before (`pending`); it is watched where it is nearly sure."""
    alarms, watched = list(drifted.alarms), list(drifted.watched)
    for key, words, sigmas in causes:
        key = f"{drifted.loop}: {key}"
        alarm = Alarm(drifted.loop, key, path, words, round(float(sigmas), 1), tuple(consequences))
        nearly_sure = abs(sigmas) >= limits.watch_sigmas
        if abs(sigmas) >= limits.alarm_sigmas or (nearly_sure and key in pending):
            alarms.append(alarm)
        elif nearly_sure:
            watched.append(alarm)
    return drifted._replace(alarms=alarms, watched=watched)
