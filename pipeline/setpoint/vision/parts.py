"""Splits frames into parts for learning, early stopping, calibration and testing. Parts share no segment, or
no print."""

import collections
from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.setpoint.frames.rendered import LabelledFrames
from pipeline.setpoint.vision import calibration
from pipeline.setpoint.vision.classifier import CLASS_NAMES, Labelled, split_by_segment

# folds of the reference method fitted beside the networks, yardsticks.fit_profile_machine
FOLDS = 3


def counted(by_part: dict[str, LabelledFrames]) -> dict[str, Any]:
    """Returns the number of frames, of valid ones, the reasons of the others, the number of segments, and of
    valid frames in each class."""
    valid = np.concatenate([frames.valid for frames in by_part.values()])
    label = np.concatenate([frames.label for frames in by_part.values()])
    reasons = [reason.split(":")[0] for frames in by_part.values() for reason in frames.reasons if reason]
    return {
        "frames": len(valid), "valid": int(valid.sum()), "valid_share": float(valid.mean()),
        "rejected": dict(sorted(collections.Counter(reasons).items())),
        "segments": sum(len(np.unique(frames.segment)) for frames in by_part.values()),
        "of_class": [int((valid & (label == c)).sum()) for c in range(3)],
    }  # fmt: skip


def deal_prints(
    frames: LabelledFrames, shares: Mapping[str, float], rng: np.random.Generator
) -> dict[str, LabelledFrames]:
    """Returns the frames by part, each with its share of the prints."""
    rows = split_by_segment(_by_print(frames.take(frames.valid)), shares=tuple(shares.values()), rng=rng)
    prints = frames.print_number[frames.valid]
    return {
        part: frames.take(np.isin(frames.print_number, prints[some]))
        for part, some in zip(shares, rows, strict=True)
    }


def _by_print(frames: LabelledFrames) -> Labelled:
    return Labelled(frames.images, frames.temperature, frames.label, frames.flow, frames.print_number)


def check_parts(by_part: Mapping[str, LabelledFrames], *, recorded: bool, window: int) -> None:
    """Raises ValueError if a class is learned from too few stretches for the reference method's folds, or if
    a part has no window."""
    of = "prints" if recorded else "segments"
    learned = Labelled(*by_part["learned"].labelled())
    for c, name in enumerate(CLASS_NAMES):
        stretches = len(np.unique(learned.segment[learned.label == c]))
        if stretches < FOLDS:
            raise ValueError(
                f"expected at least {FOLDS} stretches of constant settings of class {c}, {name}, "
                f"to learn from, found {stretches}; "
                "record more prints, "
                f"or raise train_classifier.{of}.learned"
            )
    for part in ("judged", "calibration"):
        data = all_frames(by_part[part], recorded=recorded)
        if not len(calibration.windows(data.segment, length=window)):
            raise ValueError(
                f"expected {window} frames in a row in the frames for {part}, found none in "
                f"{len(data.label)}; record longer stretches, or lower train_classifier.window"
            )


def all_frames(frames: LabelledFrames, *, recorded: bool) -> Labelled:
    """Returns all frames, also rejected ones. The unit of common errors is a print in a folder of recordings,
    else a segment."""
    together = frames.print_number if recorded else frames.segment
    return Labelled(frames.images, frames.temperature, frames.label, frames.flow, together)
