"""The cameras' part of a night: pictures of new recordings held against those that the champion was made of;
and what of all that has changed is an alarm."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.deposition.workflow import trial_files
from pipeline.nightly import camera_drift
from pipeline.nightly.inputs import aside
from pipeline.nightly.settings import Drift
from pipeline.store import params

FRAMES = 40  # pictures of a recording that are looked at


# ---- deposition: the camera that rides with the nozzle


def of_trials(folder: Path, most: int, only: Sequence[str] = ()) -> list[list[Any]]:
    """[median, deviation, frames] of each of the last `most` trials below `folder`
    whose pictures show a bead; `only` those named."""
    found = []
    for path in [path for path in sorted(folder.rglob("*.mcap")) if not only or path.as_posix() in only][
        -most:
    ]:
        try:
            seen = _seen(trial_files.read_trial(path, unreadable_share=1.0))
        except ValueError:
            continue
        found.append([seen.mean.tolist(), seen.deviation.tolist(), seen.frames])
    return found


def _seen(trial: trial_files.Trial) -> camera_drift.Seen:
    frames = trial.frames
    every = max(len(frames.time_s) // FRAMES, 1)
    return camera_drift.figures(
        [picture for k, (_, picture) in enumerate(frames) if k % every == 0 and picture is not None]
    )


def trials_of(
    limits: Drift,
    loop: str,
    folder: str,
    paths: Sequence[str],
    kept: Mapping[str, Any],
    pending: set[str],
    found: dict[str, Any],
) -> None:
    """Of new trials: those that cannot be read are set aside, the
    others' pictures held against the champion's."""
    before = [
        camera_drift.Seen(np.array(mean), np.array(deviation), frames)
        for mean, deviation, frames in kept.get("camera", [])
    ]
    for path in (path for path in paths if path.lower().endswith(".mcap")):
        try:
            trial = trial_files.read_trial(path, unreadable_share=1.0)
        except ValueError as error:
            found["quarantined"][path] = aside(path, loop, str(error))
            continue
        if not before:
            found["notes"].append(
                f"{path}: the champion has no pictures of its own: the camera was not judged"
            )
            continue
        try:
            _, causes = camera_drift.changes(
                _seen(trial), before, moved_px=limits.camera_px, contrast_percent=limits.contrast_percent
            )
        except ValueError as error:
            found["notes"].append(f"{path}: {error}")
            continue
        raised(limits, loop, path, causes, [], pending, found)


# ---- setpoint: the camera that looks at the nozzle


def of_prints(folder: Path, most: int, only: Sequence[str] = ()) -> list[list[Any]]:
    """[print, frames by class and without a line (4,), frames of a segment, median contrast of the line and
    its deviation] of the last `most` prints below `folder`; `only` those named."""
    from pipeline.setpoint.workflow import frame_folder
    from pipeline.setpoint.workflow.settings import TrainClassifier

    p = params.load(TrainClassifier, "train_classifier")
    if p.source != "recordings":
        return []
    how = frame_folder.reading(p)
    frames = frame_folder.read_folder(
        folder, how, params.load(params.Execution, "execution"), memo=Path("datasets/memo/train_classifier")
    )
    found = []
    for number, name in [one for one in enumerate(frames.prints) if not only or one[1] in only][-most:]:
        here = frames.print_number == number
        good = here & frames.valid & (frames.label >= 0)
        if good.any():
            counts = [
                *np.bincount(frames.label[good], minlength=3).tolist(),
                int((here & ~frames.valid).sum()),
            ]
            together = float(here.sum() / len(np.unique(frames.segment[here])))
            seen = camera_drift.line_contrast(frames.score[good], together=together)
            found.append([name, counts, together, seen.mean.tolist(), seen.deviation.tolist()])
    return found


def nozzle_of(
    limits: Drift,
    loop: str,
    folder: str,
    paths: Sequence[str],
    kept: Mapping[str, Any],
    pending: set[str],
    found: dict[str, Any],
) -> None:
    """Of new prints: files that cannot be read are set aside; classes, frames without a line, and the line's
    contrast are held against the champion's prints."""
    from pipeline.setpoint.workflow import frame_csv, frame_folder, frame_mcap
    from pipeline.setpoint.workflow.settings import TrainClassifier

    p = params.load(TrainClassifier, "train_classifier")
    if p.source != "recordings":
        return
    for path in paths:
        try:
            if path.lower().endswith(".csv"):
                frame_csv.read_log(Path(path))
            elif path.lower().endswith(".mcap"):
                frame_mcap.open_film(Path(path), frame_folder.reading(p).topics)
        except ValueError as error:
            found["quarantined"][path] = aside(path, loop, str(error))
    before = kept.get("camera", [])
    if not before:
        return
    names = {one[0] for one in before}
    try:
        new = [one for one in of_prints(Path(folder), 10**6) if one[0] not in names]
    except ValueError as error:  # what the stage will refuse as well, and say so
        found["notes"].append(str(error))
        return
    known = np.array([one[1] for one in before])
    for name, counts, together, mean, deviation in new:
        causes = camera_drift.balance_changes(
            np.array(counts), known, together=together, points=limits.balance_points
        )
        contrasts = [camera_drift.Contrast(np.array(one[3]), np.array(one[4])) for one in before]
        causes += camera_drift.contrast_changes(
            camera_drift.Contrast(np.array(mean), np.array(deviation)),
            contrasts,
            percent=limits.contrast_percent,
        )
        raised(limits, loop, name, causes, [], pending, found)


# ---- what is an alarm


def raised(
    limits: Drift,
    loop: str,
    path: str,
    causes: Sequence[camera_drift.Change],
    consequences: Sequence[str],
    pending: set[str],
    found: dict[str, Any],
) -> None:
    """Alarms where a cause is sure at once, or has been watched the
    night before; watched where it is nearly sure."""
    for key, words, sigmas in causes:
        one = {
            "loop": loop,
            "key": f"{loop}: {key}",
            "recording": path,
            "cause": words,
            "sigmas": round(float(sigmas), 1),
            "consequences": list(consequences),
        }
        if abs(sigmas) >= limits.alarm_sigmas or (
            abs(sigmas) >= limits.watch_sigmas and one["key"] in pending
        ):
            found["alarms"].append(one)
        elif abs(sigmas) >= limits.watch_sigmas:
            found["watched"].append(one)
