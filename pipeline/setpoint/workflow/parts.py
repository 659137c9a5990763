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
from pipeline.setpoint.workflow.render_frames import Seen, joined, rendered, swept
from pipeline.setpoint.workflow.settings import TrainClassifier
from pipeline.store import artifacts
from pipeline.store.execution import run_all
from pipeline.store.params import Execution

PARTS = ("learned", "held_out", "calibration", "judged")


def parts(p: TrainClassifier, folder: str, execution: Execution) -> tuple[dict[str, Seen], dict[str, Any]]:
    """The four parts of PARTS, no segment in two of them, and what was read, counted; the
    frames of `folder` where the source is recordings."""
    if p.source == "recordings":
        folder = Path(folder)
        frames = frame_folder.read_folder(
            folder, frame_folder.reading(p), execution, memo=Path("datasets/memo/train_classifier")
        )
        frame_folder.check(folder, frames)
        with artifacts.about(folder):
            return _by_print(p, frames), frame_folder.figures(frames)
    counts = p.segments.model_dump()
    frames = p.frames.model_dump()
    calls = [
        delayed(rendered)((p.seed, k, i), frames[part], p.least_score)
        for k, part in enumerate(PARTS)
        for i in range(counts[part])
    ]
    done = iter(
        tqdm(run_all(calls, execution), total=len(calls), desc="train_classifier: frames", mininterval=2)
    )
    everything = joined([*done])
    owner = np.repeat(PARTS, [15 * frames[part] * counts[part] for part in PARTS])
    found = {part: everything.take(owner == part) for part in PARTS}
    return found, {
        "frames": len(everything.valid), "valid": int(everything.valid.sum()),
        "valid_share": float(everything.valid.mean()),
        "rejected": dict(sorted(collections.Counter(_kind(reason) for reason in everything.reasons if reason).items())),
        "segments": len(np.unique(everything.segment)),
        "of_class": [int((everything.valid & (everything.label == c)).sum()) for c in range(3)],
    }  # fmt: skip


def _kind(reason: str) -> str:
    return reason.split(":")[0]


def _by_print(p: TrainClassifier, frames: NozzleFrames) -> dict[str, Seen]:
    """The frames of a folder, its prints dealt out to the parts in proportion to `prints`; frames
    without a known class or temperature are left out."""
    known = (frames.label >= 0) & np.isfinite(frames.temperature)
    seen = Seen(
        frames.images, frames.label, frames.flow, frames.temperature, frames.print_number, frames.segment,
        frames.valid,
        np.array(frames.reasons, object)
    ).take(known)  # fmt: skip
    valid = seen.take(seen.valid)
    shares = tuple(float(n) for n in p.prints.model_dump().values())
    chosen = split_by_segment(
        Labelled(valid.images, valid.temperature, valid.label, valid.print_number),
        shares=shares,
        rng=np.random.default_rng(p.seed),
    )
    return {
        part: seen.take(np.isin(seen.print_number, valid.print_number[rows]))
        for part, rows in zip(PARTS, chosen, strict=True)
    }


# ---- windows for the simulator


def to_record(p: TrainClassifier, found: dict[str, Seen], execution: Execution) -> dict[str, Seen]:
    """Frames whose windows controllers are trained on ("learn") and judged on ("judge"): rendered over the
    whole range of flows, or what a folder has for calibration and judging."""
    if p.source == "recordings":
        return {"learn": found["calibration"], "judge": found["judged"]}
    counts, windows = (
        {"learn": p.recorded.learn, "judge": p.recorded.judge},
        (p.recorded.learn_windows, p.recorded.judge_windows),
    )
    calls = [
        delayed(swept)((p.seed, len(PARTS) + k, i), windows[k], p.window, p.least_score)
        for k, part in enumerate(counts)
        for i in range(counts[part])
    ]
    done = iter(
        tqdm(
            run_all(calls, execution),
            total=len(calls),
            desc="train_classifier: windows at every flow",
            mininterval=2,
        )
    )
    return {part: joined([next(done) for _ in range(count)]) for part, count in counts.items()}
