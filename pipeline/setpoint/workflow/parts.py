"""What train_classifier learns from: key areas of rendered frames, or of a user's folder, in four parts that
share no segment; and the windows that controllers are trained, chosen and judged on."""

import collections
import contextlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.setpoint.material import PLA, Material
from pipeline.setpoint.vision import calibration
from pipeline.setpoint.vision.classifier import CLASS_NAMES, Labelled, split_by_segment
from pipeline.setpoint.workflow import frame_folder
from pipeline.setpoint.workflow.frame_folder import NozzleFrames
from pipeline.setpoint.workflow.render_frames import PARTS, LabelledFrames, restore_frames, standing_out
from pipeline.setpoint.workflow.settings import TrainClassifier
from pipeline.setpoint.workflow.tables import WINDOW_PARTS
from pipeline.store import artifacts
from pipeline.store.params import Execution

# of a folder's prints to learn from: those that stay so, and those of each of WINDOW_PARTS
STAYING, EACH = 6.0, 1.0
# with fewer prints in each of WINDOW_PARTS an interval by print says nothing; what is learned from has each
# class in so many
LEAST_PRINTS, LEAST_OF_CLASS = 5, 3


class Parts(NamedTuple):
    """Frames by part of PARTS; frames whose windows stand for the camera, by part of WINDOW_PARTS; what was
    read, counted (`windows_apart`: whether no print of a folder is in both); and all that was read of it."""

    frames: dict[str, LabelledFrames]
    windows: dict[str, LabelledFrames]
    read: dict[str, Any]
    recorded: NozzleFrames | None = None


def parts(
    settings: TrainClassifier, rendered: str, folder: str, execution: Execution, material: Material = PLA
) -> Parts:
    """The frames of `rendered`, what render_frames wrote; or those of `folder` where the source is
    recordings.

    No segment is in two parts of PARTS, none in two of WINDOW_PARTS, and none of rendered ones in both. Of a
    folder the windows of learn, choose and judge are of prints of their own, taken from those to learn from,
    where these are enough; else not apart: of the prints for calibration, held_out and judged.
    """
    if settings.source == "recordings":
        frames = frame_folder.read_folder(
            Path(folder),
            frame_folder.read_options(settings, material),
            execution,
            memo=Path("datasets/memo/train_classifier"),
        )
        frame_folder.check(Path(folder), frames)
        with artifacts.about(folder):
            by_part, windows, apart = with_windows(settings, _by_print(settings, frames))
        prints = {part: len(np.unique(of.print_number)) for part, of in windows.items()}
        read = frame_folder.figures(frames) | {"windows_apart": apart, "window_prints": prints}
        return Parts(by_part, windows, read, frames)
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


def with_windows(
    settings: TrainClassifier, by_part: dict[str, LabelledFrames]
) -> tuple[dict[str, LabelledFrames], dict[str, LabelledFrames], bool]:
    """The parts of a folder by PARTS and by WINDOW_PARTS, and whether they are apart. Raises ValueError where
    they are not, and one of WINDOW_PARTS has no window."""
    learned = by_part["learned"]
    valid = learned.take(learned.valid)
    with contextlib.suppress(ValueError):  # the prints do not let each part hold every class
        chosen = split_by_segment(
            Labelled(valid.images, valid.temperature, valid.label, valid.flow, valid.print_number),
            shares=(STAYING, *[EACH] * len(WINDOW_PARTS)),
            rng=np.random.default_rng([settings.seed, 1]),
        )
        stays, *others = (
            learned.take(np.isin(learned.print_number, valid.print_number[rows])) for rows in chosen
        )
        windows = dict(zip(WINDOW_PARTS, others, strict=True))
        if _of_class(stays) >= LEAST_OF_CLASS and all(_enough(settings, of) for of in others):
            return by_part | {"learned": stays}, windows, True
    for part in ("judged", "calibration", "held_out"):
        if not len(_windows(settings, by_part[part])):
            raise ValueError(
                f"expected {settings.window} frames in a row at one class in the frames for {part}, found "
                f"none in {len(by_part[part].label)}; record longer stretches, or lower "
                "train_classifier.window"
            )
    taken = (by_part[part] for part in ("calibration", "held_out", "judged"))
    return by_part, dict(zip(WINDOW_PARTS, taken, strict=True)), False


def _enough(settings: TrainClassifier, frames: LabelledFrames) -> bool:
    """Whether there are prints enough, and windows of each class."""
    labels = frames.label[_windows(settings, frames)]
    return len(np.unique(frames.print_number)) >= LEAST_PRINTS and len(np.unique(labels)) == len(CLASS_NAMES)


def _windows(settings: TrainClassifier, frames: LabelledFrames) -> np.ndarray:
    """First frame (w,) of each window in which one is valid."""
    rows = calibration.windows(frames.segment, frames.label, length=settings.window).rows
    return rows[frames.valid[rows].any(axis=1)][:, 0]


def _of_class(frames: LabelledFrames) -> int:
    """Prints with a valid frame of the class that the fewest have."""
    valid = frames.take(frames.valid)
    return min(len(np.unique(valid.print_number[valid.label == c])) for c in range(len(CLASS_NAMES)))


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
