"""What train_classifier learns from: key areas of rendered frames, or of a user's folder, in four parts that
share no segment; and the windows that controllers are trained on."""

import collections
from pathlib import Path
from typing import Any

import numpy as np
from joblib import delayed
from tqdm import tqdm

from pipeline.setpoint.classifier import Labelled, split_by_segment
from pipeline.setpoint.workflow import frame_folder
from pipeline.setpoint.workflow.frame_folder import NozzleFrames
from pipeline.setpoint.workflow.render_frames import LabelledFrames, joined, rendered, swept
from pipeline.setpoint.workflow.settings import TrainClassifier
from pipeline.store import artifacts
from pipeline.store.execution import run_all
from pipeline.store.params import Execution

PARTS = ("learned", "held_out", "calibration", "judged")


def parts(
    settings: TrainClassifier, folder: str, execution: Execution
) -> tuple[dict[str, LabelledFrames], dict[str, Any]]:
    """The four parts of PARTS, no segment in two of them, and what was read, counted; the
    frames of `folder` where the source is recordings."""
    if settings.source == "recordings":
        folder = Path(folder)
        frames = frame_folder.read_folder(
            folder,
            frame_folder.read_options(settings),
            execution,
            memo=Path("datasets/memo/train_classifier"),
        )
        frame_folder.check(folder, frames)
        with artifacts.about(folder):
            return _by_print(settings, frames), frame_folder.figures(frames)
    counts = settings.segments.model_dump()
    frames = settings.frames.model_dump()
    calls = [
        delayed(rendered)((settings.seed, k, i), frames[part], settings.least_score)
        for k, part in enumerate(PARTS)
        for i in range(counts[part])
    ]
    results = iter(
        tqdm(run_all(calls, execution), total=len(calls), desc="train_classifier: frames", mininterval=2)
    )
    labelled = joined([*results])
    owner = np.repeat(PARTS, [15 * frames[part] * counts[part] for part in PARTS])
    by_part = {part: labelled.take(owner == part) for part in PARTS}
    return by_part, {
        "frames": len(labelled.valid), "valid": int(labelled.valid.sum()),
        "valid_share": float(labelled.valid.mean()),
        "rejected": dict(
            sorted(collections.Counter(_kind(reason) for reason in labelled.reasons if reason).items())
        ),
        "segments": len(np.unique(labelled.segment)),
        "of_class": [int((labelled.valid & (labelled.label == c)).sum()) for c in range(3)],
    }  # fmt: skip


def _kind(reason: str) -> str:
    return reason.split(":")[0]


def _by_print(settings: TrainClassifier, frames: NozzleFrames) -> dict[str, LabelledFrames]:
    """The frames of a folder, its prints dealt out to the parts in proportion to `prints`; frames
    without a known class or temperature are left out."""
    usable = (frames.label >= 0) & np.isfinite(frames.temperature)
    labelled = LabelledFrames(
        frames.images, frames.label, frames.flow, frames.temperature, frames.print_number, frames.segment,
        frames.valid,
        np.array(frames.reasons, object)
    ).take(usable)  # fmt: skip
    valid = labelled.take(labelled.valid)
    shares = tuple(float(n) for n in settings.prints.model_dump().values())
    chosen = split_by_segment(
        Labelled(valid.images, valid.temperature, valid.label, valid.print_number),
        shares=shares,
        rng=np.random.default_rng(settings.seed),
    )
    return {
        part: labelled.take(np.isin(labelled.print_number, valid.print_number[rows]))
        for part, rows in zip(PARTS, chosen, strict=True)
    }


# ---- windows for the simulator


def to_record(
    settings: TrainClassifier, by_part: dict[str, LabelledFrames], execution: Execution
) -> dict[str, LabelledFrames]:
    """Frames whose windows controllers are trained on ("learn") and judged on ("judge"): rendered over the
    whole range of flows, or what a folder has for calibration and judging."""
    if settings.source == "recordings":
        return {"learn": by_part["calibration"], "judge": by_part["judged"]}
    counts, windows = (
        {"learn": settings.recorded.learn, "judge": settings.recorded.judge},
        (settings.recorded.learn_windows, settings.recorded.judge_windows),
    )
    calls = [
        delayed(swept)((settings.seed, len(PARTS) + k, i), windows[k], settings.window, settings.least_score)
        for k, part in enumerate(counts)
        for i in range(counts[part])
    ]
    results = iter(
        tqdm(
            run_all(calls, execution),
            total=len(calls),
            desc="train_classifier: windows at every flow",
            mininterval=2,
        )
    )
    return {part: joined([next(results) for _ in range(count)]) for part, count in counts.items()}
