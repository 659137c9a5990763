"""The cameras' part of a night: pictures of new recordings held against those that the champion was made of;
and what of all that has changed is an alarm."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.deposition.workflow import trial_files
from pipeline.nightly import camera_drift
from pipeline.nightly.inputs import quarantine
from pipeline.nightly.settings import Drift
from pipeline.report.shared.night import Alarm, LoopDrift
from pipeline.store import params

FRAMES = 40  # pictures of a recording that are looked at


# ---- deposition: the camera that rides with the nozzle


def of_trials(folder: Path, most: int, only: Sequence[str] = ()) -> list[list[Any]]:
    """[median, deviation, frames] of each of the last `most` trials below `folder`
    whose pictures show a bead; `only` those named."""
    rows = []
    paths = [path for path in sorted(folder.rglob("*.mcap")) if not only or path.as_posix() in only]
    for path in paths[-most:]:
        try:
            stats = _frame_stats(trial_files.read_trial(path, unreadable_share=1.0))
        except ValueError:
            continue
        rows.append([stats.mean.tolist(), stats.deviation.tolist(), stats.frames])
    return rows


def _frame_stats(trial: trial_files.Trial) -> camera_drift.FrameStats:
    frames = trial.frames
    every = max(len(frames.time_s) // FRAMES, 1)
    return camera_drift.figures(
        [picture for k, (_, picture) in enumerate(frames) if k % every == 0 and picture is not None]
    )


def trials_of(
    limits: Drift, paths: Sequence[str], reference: Mapping[str, Any], pending: set[str], drift: LoopDrift
) -> None:
    """Of new trials: those that cannot be read are set aside, the others' pictures held against those of
    `reference`. What is found goes to `drift`."""
    before = [
        camera_drift.FrameStats(np.array(mean), np.array(deviation), frames)
        for mean, deviation, frames in reference.get("camera", [])
    ]
    for path in (path for path in paths if path.lower().endswith(".mcap")):
        try:
            trial = trial_files.read_trial(path, unreadable_share=1.0)
        except ValueError as error:
            drift.quarantined[path] = quarantine(path, drift.loop, str(error))
            continue
        if not before:
            drift.notes.append(f"{path}: the champion has no pictures of its own: the camera was not judged")
            continue
        try:
            _, causes = camera_drift.changes(
                _frame_stats(trial), before, moved_px=limits.camera_px,
                contrast_percent=limits.contrast_percent,
            )  # fmt: skip
        except ValueError as error:
            drift.notes.append(f"{path}: {error}")
            continue
        raise_alarms(limits, path, causes, [], pending, drift)


# ---- setpoint: the camera that looks at the nozzle


class PrintFigures(NamedTuple):
    """Of one print: frames by class and without a line (4,), frames of a segment, and the line's contrast."""

    name: str
    counts: np.ndarray
    segment_frames: float
    contrast: camera_drift.Contrast

    def written(self) -> list[Any]:
        """As the champion's reference.json keeps it."""
        contrast = [self.contrast.mean.tolist(), self.contrast.deviation.tolist()]
        return [self.name, self.counts.tolist(), self.segment_frames, *contrast]


def of_prints(folder: Path, most: int, only: Sequence[str] = ()) -> list[list[Any]]:
    """What reference.json keeps of the last `most` prints below `folder`; `only` those named."""
    return [one.written() for one in _print_figures(folder, most, only)]


def _print_figures(folder: Path, most: int, only: Sequence[str] = ()) -> list[PrintFigures]:
    from pipeline.setpoint.workflow import frame_folder
    from pipeline.setpoint.workflow.settings import TrainClassifier

    settings = params.load(TrainClassifier, "train_classifier")
    if settings.source != "recordings":
        return []
    frames = frame_folder.read_folder(
        folder,
        frame_folder.read_options(settings),
        params.load(params.Execution, "execution"),
        memo=Path("datasets/memo/train_classifier"),
    )
    prints = []
    for number, name in [one for one in enumerate(frames.prints) if not only or one[1] in only][-most:]:
        here = frames.print_number == number
        good = here & frames.valid & (frames.label >= 0)
        if good.any():
            classes = np.bincount(frames.label[good], minlength=3).tolist()
            counts = np.array([*classes, int((here & ~frames.valid).sum())])
            together = float(here.sum() / len(np.unique(frames.segment[here])))
            contrast = camera_drift.line_contrast(frames.score[good], together=together)
            prints.append(PrintFigures(name, counts, together, contrast))
    return prints


def nozzle_of(
    limits: Drift,
    folder: str,
    paths: Sequence[str],
    reference: Mapping[str, Any],
    pending: set[str],
    drift: LoopDrift,
) -> None:
    """Of new prints: files that cannot be read are set aside. Classes, frames without a line, and the line's
    contrast are held against the prints of `reference`. What is found goes to `drift`."""
    from pipeline.setpoint.workflow import frame_csv, frame_folder, frame_mcap
    from pipeline.setpoint.workflow.settings import TrainClassifier

    settings = params.load(TrainClassifier, "train_classifier")
    if settings.source != "recordings":
        return
    for path in paths:
        try:
            if path.lower().endswith(".csv"):
                frame_csv.read_log(Path(path))
            elif path.lower().endswith(".mcap"):
                frame_mcap.open_film(Path(path), frame_folder.read_options(settings).topics)
        except ValueError as error:
            drift.quarantined[path] = quarantine(path, drift.loop, str(error))
    before = [
        PrintFigures(name, np.array(counts), together, camera_drift.Contrast(np.array(mean), np.array(std)))
        for name, counts, together, mean, std in reference.get("camera", [])
    ]
    if not before:
        return
    names = {one.name for one in before}
    try:
        new = [one for one in _print_figures(Path(folder), 10**6) if one.name not in names]
    except ValueError as error:  # what the stage will refuse as well, and say so
        drift.notes.append(str(error))
        return
    usual, contrasts = np.array([one.counts for one in before]), [one.contrast for one in before]
    for one in new:
        causes = camera_drift.balance_changes(
            one.counts, usual, together=one.segment_frames, points=limits.balance_points
        )
        causes += camera_drift.contrast_changes(one.contrast, contrasts, percent=limits.contrast_percent)
        raise_alarms(limits, one.name, causes, [], pending, drift)


# ---- what is an alarm


def raise_alarms(
    limits: Drift,
    path: str,
    causes: Sequence[camera_drift.Change],
    consequences: Sequence[str],
    pending: set[str],
    drift: LoopDrift,
) -> None:
    """An alarm of the loop where a cause is sure at once, or has been watched the night before; watched where
    it is nearly sure."""
    for key, words, sigmas in causes:
        alarm = Alarm(
            drift.loop, f"{drift.loop}: {key}", path, words, round(float(sigmas), 1), tuple(consequences)
        )
        if abs(sigmas) >= limits.alarm_sigmas or (
            abs(sigmas) >= limits.watch_sigmas and alarm.key in pending
        ):
            drift.alarms.append(alarm)
        elif abs(sigmas) >= limits.watch_sigmas:
            drift.watched.append(alarm)
