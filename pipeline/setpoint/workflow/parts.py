"""What train_classifier learns from: key areas of rendered frames, or of a user's folder, in four parts that
share no segment; and the windows that controllers are trained, chosen and judged on."""

import collections
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.setpoint.classifier import Labelled, split_by_segment
from pipeline.setpoint.workflow import frame_folder
from pipeline.setpoint.workflow.frame_folder import NozzleFrames
from pipeline.setpoint.workflow.render_frames import PARTS, LabelledFrames, restore_frames, standing_out
from pipeline.setpoint.workflow.settings import TrainClassifier
from pipeline.setpoint.workflow.tables import WINDOW_PARTS
from pipeline.store import artifacts
from pipeline.store.params import Execution


class Parts(NamedTuple):
    """Frames by part of PARTS; frames whose windows stand for the camera, by part of WINDOW_PARTS; and what
    was read for the first, counted."""

    frames: dict[str, LabelledFrames]
    windows: dict[str, LabelledFrames]
    read: dict[str, Any]


def parts(settings: TrainClassifier, rendered: str, folder: str, execution: Execution) -> Parts:
    """The frames of `rendered`, what render_frames wrote; or those of `folder` where the source is
    recordings.

    No segment is in two parts of PARTS, and none in two of WINDOW_PARTS. Of a folder the windows of learn,
    choose and judge are those of the prints for calibration, held_out and judged; rendered ones have
    segments of their own.
    """
    if settings.source == "recordings":
        frames = frame_folder.read_folder(
            Path(folder),
            frame_folder.read_options(settings),
            execution,
            memo=Path("datasets/memo/train_classifier"),
        )
        frame_folder.check(Path(folder), frames)
        with artifacts.about(folder):
            by_part = _by_print(settings, frames)
        windows = dict(
            zip(WINDOW_PARTS, (by_part[k] for k in ("calibration", "held_out", "judged")), strict=True)
        )
        return Parts(by_part, windows, frame_folder.figures(frames))
    found = restore_frames(Path(rendered))
    found = {part: standing_out(frames, settings.least_score) for part, frames in found.items()}
    by_part = {part: found[part] for part in PARTS}
    return Parts(by_part, {part: found[part] for part in WINDOW_PARTS}, _counted(by_part))


def _counted(by_part: dict[str, LabelledFrames]) -> dict[str, Any]:
    """Frames, how many are valid, why others are not, segments, and valid ones of each class."""
    valid = np.concatenate([frames.valid for frames in by_part.values()])
    label = np.concatenate([frames.label for frames in by_part.values()])
    reasons = [reason.split(":")[0] for frames in by_part.values() for reason in frames.reasons if reason]
    return {
        "frames": len(valid), "valid": int(valid.sum()), "valid_share": float(valid.mean()),
        "rejected": dict(sorted(collections.Counter(reasons).items())),
        "segments": sum(len(np.unique(frames.segment)) for frames in by_part.values()),
        "of_class": [int((valid & (label == c)).sum()) for c in range(3)],
    }  # fmt: skip


def _by_print(settings: TrainClassifier, frames: NozzleFrames) -> dict[str, LabelledFrames]:
    """The frames of a folder, its prints dealt out to the parts in proportion to `prints`; frames
    without a known class or temperature are left out."""
    usable = (frames.label >= 0) & np.isfinite(frames.temperature)
    truth = frames.label, frames.flow, frames.temperature, frames.print_number, frames.segment
    reasons = np.array(frames.reasons, object)
    labelled = LabelledFrames(frames.images, *truth, frames.valid, reasons, frames.score).take(usable)
    valid = labelled.take(labelled.valid)
    shares = tuple(float(n) for n in settings.prints.model_dump().values())
    chosen = split_by_segment(
        Labelled(valid.images, valid.temperature, valid.label, valid.flow, valid.print_number),
        shares=shares,
        rng=np.random.default_rng(settings.seed),
    )
    return {
        part: labelled.take(np.isin(labelled.print_number, valid.print_number[rows]))
        for part, rows in zip(PARTS, chosen, strict=True)
    }
