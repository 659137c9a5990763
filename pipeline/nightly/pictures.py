"""The cameras' part of a nightly run: compares pictures of new recordings with those of the champion, and
decides which changes are alarms."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.nightly import camera_drift
from pipeline.nightly.inputs import quarantine
from pipeline.nightly.records import Alarm, NightDrift
from pipeline.nightly.settings import DriftLimits
from pipeline.recordings import nozzle_frames, trial_files
from pipeline.recordings.excluded import readable
from pipeline.store import params

if TYPE_CHECKING:
    from pipeline.deposition.settings import Camera
    from pipeline.setpoint.settings import TrainClassifier

FRAMES = 40  # pictures of a recording that are looked at


# ---- deposition: the camera that rides with the nozzle


def of_trials(folder: Path, most: int, only: Sequence[str] = ()) -> list[list[Any]]:
    """Returns [median, deviation] for each of the last `most` trials below `folder` whose pictures show a
    bead; only of those named in `only`, if any are."""
    rows, camera = [], _camera()
    trials = readable(sorted(folder.rglob("*.mcap")), folder)
    paths = [path for path in trials if not only or path.as_posix() in only]
    for path in paths[-most:]:
        try:
            stats = _frame_stats(trial_files.open_trial(path, **camera.recording))
        except ValueError:
            continue
        rows.append([part.tolist() for part in stats])
    return rows


def _camera() -> "Camera":
    """Returns section `camera`, whose topics a trial is read with; any number of unreadable frames is
    accepted."""
    from pipeline.deposition.settings import Camera

    return params.load(Camera, "camera").model_copy(update={"unreadable_share": 1.0})


def _frame_stats(trial: trial_files.TrialRecording) -> camera_drift.Stats:
    frames = trial.frames
    every = max(len(frames.time_s) // FRAMES, 1)
    return camera_drift.figures(
        [picture for k, (_, picture) in enumerate(frames) if k % every == 0 and picture is not None]
    )


def find_trials_drift(
    drift: NightDrift,
    limits: DriftLimits,
    loop: str,
    paths: Sequence[str],
    reference: Sequence[Sequence[Any]],
    pending: Collection[str],
) -> None:
    """Compares the pictures of new trials with those of `reference`, and adds the results. Trials that cannot
    be read are set aside."""
    camera = _camera()
    before = [(np.array(row[0]), np.array(row[1])) for row in reference]
    for path in (path for path in paths if path.lower().endswith(".mcap")):
        try:
            trial = trial_files.open_trial(path, **camera.recording)
        except ValueError as error:
            drift.quarantined[path] = quarantine(path, loop, str(error))
            continue
        if not before:
            drift.notes.append(f"{path}: the champion has no pictures of its own: the camera was not judged")
            continue
        try:
            _, causes = camera_drift.changes(
                _frame_stats(trial),
                before,
                moved_px=limits.camera_px,
                contrast_percent=limits.contrast_percent,
            )
            add_alarms(drift, limits, loop, path, causes, pending)
        except ValueError as error:
            drift.notes.append(f"{path}: {error}")


# ---- setpoint: the camera that looks at the nozzle


class NightPrint(NamedTuple):
    """A print's frames, as reference.json stores them: `name`; `counts` (4,), frames of each class and
    without a line; `together`, frames of a segment; `contrast` and `deviation`, the line's median contrast
    and its standard deviation, empty if no frame shows a line; `familiar` (2,), frames that look like those
    the champion's classifier learned from, and frames that do not, 0 if unknown."""

    name: str
    counts: list[int]
    together: float
    contrast: list[float]
    deviation: list[float]
    familiar: Sequence[int] = (0, 0)


def of_prints(folder: Path, champion: Path, most: int, only: Sequence[str] = ()) -> list[NightPrint]:
    """Returns the last `most` prints below `folder`, or only those named in `only` if any are, as the
    classifier below `champion` sees them."""
    from pipeline.setpoint.recordings import read_options
    from pipeline.setpoint.settings import SetpointMaterial

    if not (settings := _classifier()):
        return []
    material = params.load(SetpointMaterial, "setpoint_material").material()
    frames = nozzle_frames.read_folder(
        folder, read_options(settings, material), params.load(params.Execution, "execution")
    )
    distance, above = _foreignness(frames, champion)
    rows = []
    numbered = [(number, name) for number, name in enumerate(frames.prints) if not only or name in only]
    for number, name in numbered[-most:]:
        here = frames.print_number == number
        seen = here & frames.valid & (frames.label >= 0)
        if not seen.any() and (here & frames.valid).any():  # the print's flow is unknown
            continue
        classes = np.bincount(frames.label[seen], minlength=3).tolist()
        together = float(here.sum() / len(np.unique(frames.segment[here])))
        contrast: tuple[np.ndarray, np.ndarray] = np.zeros(0), np.zeros(0)
        if seen.any():
            contrast = camera_drift.line_contrast(frames.score[seen], together=together)
        asked = distance[seen & np.isfinite(distance)]
        rows.append(
            NightPrint(
                name,
                [*classes, int((here & ~frames.valid).sum())],
                together,
                *(part.tolist() for part in contrast),
                [int((asked <= above).sum()), int((asked > above).sum())],
            )
        )
    return rows


def _foreignness(frames: nozzle_frames.NozzleFrames, champion: Path) -> tuple[np.ndarray, float]:
    """Returns the distance of each frame (n,) from what the champion's classifier learned from, NaN if
    unknown, and the distance above which a frame is foreign."""
    files = [champion / f"train_classifier/{name}" for name in ("weights.safetensors", "calibration.parquet")]
    if not all(file.exists() for file in files):
        return np.full(len(frames.valid), np.nan), np.inf
    from pipeline.setpoint.vision.files import restore_classifier
    from pipeline.setpoint.vision.gallery import classified_frames

    model = restore_classifier(*map(str, files))
    return classified_frames(model, frames)[1], model.calibration.foreign_above


def _classifier() -> "TrainClassifier | None":
    """Returns section `train_classifier` if it learns from recordings, else None."""
    from pipeline.setpoint.settings import TrainClassifier

    settings = params.load(TrainClassifier, "train_classifier")
    return settings if settings.source == "recordings" else None


def find_prints_drift(
    drift: NightDrift,
    limits: DriftLimits,
    loop: str,
    folder: str,
    paths: Sequence[str],
    champion: Path,
    reference: Sequence[Sequence[Any]],
    pending: Collection[str],
) -> None:
    """Compares the new prints `paths` in the loop's folder of recordings with the prints of `reference`, and
    adds the results: classes, frames without a line, frames foreign to the classifier below `champion`, and
    the line's contrast. A file that cannot be read is set aside."""
    if not (settings := _classifier()):
        return
    for path in paths:
        if reason := _unreadable(path, settings):
            drift.quarantined[path] = quarantine(path, loop, reason)
    if not reference:
        return
    before = [NightPrint(*row) for row in reference]
    names = {one.name for one in before}
    try:
        prints = [one for one in of_prints(Path(folder), champion, 10**6) if one.name not in names]
    except ValueError as error:  # the stage will refuse this as well, and report it
        drift.notes.append(str(error))
        return
    for one in prints:
        add_alarms(drift, limits, loop, one.name, _print_changes(one, before, limits), pending)


def _print_changes(
    one: NightPrint, before: Sequence[NightPrint], limits: DriftLimits
) -> list[camera_drift.CameraChange]:
    """Returns the changes of a print's frames, compared with the prints before."""
    points, usual = limits.balance_points, np.array([other.counts for other in before])
    causes = camera_drift.balance_changes(np.array(one.counts), usual, together=one.together, points=points)
    known = np.array([other.familiar for other in before if sum(other.familiar)])
    if sum(one.familiar) and len(known):
        familiar = np.array(one.familiar)
        causes += camera_drift.foreign_changes(familiar, known, together=one.together, points=points)
    contrasts = [(np.array(other.contrast), np.array(other.deviation)) for other in before if other.contrast]
    if one.contrast and contrasts:
        contrast = np.array(one.contrast), np.array(one.deviation)
        causes += camera_drift.contrast_changes(contrast, contrasts, percent=limits.contrast_percent)
    return causes


def _unreadable(path: str, settings: "TrainClassifier") -> str:
    """Returns why a print's file cannot be read; "" if it can."""
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


def add_alarms(
    drift: NightDrift,
    limits: DriftLimits,
    loop: str,
    path: str,
    causes: Sequence[camera_drift.CameraChange],
    pending: Collection[str],
) -> None:
    """Adds the causes that a recording shows. A cause is an alarm if it is certain at once, or if it is
    nearly certain and was watched in the run before (`pending`). A cause that is only nearly certain is
    watched."""
    for key, words, sigmas in causes:
        alarm = Alarm(loop, f"{loop}: {key}", path, words, round(float(sigmas), 1))
        nearly_sure = abs(sigmas) >= limits.watch_sigmas
        if abs(sigmas) >= limits.alarm_sigmas or (nearly_sure and alarm.key in pending):
            drift.alarms.append(alarm)
        elif nearly_sure:
            drift.watched.append(alarm)
