"""The camera's part of a night: pictures of new recordings held against those that the champion was made of; and what of all that has changed is an alarm."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline import camera_drift, trials
from pipeline.nightly.settings import Drift

FRAMES = 40  # pictures of a recording that are looked at


def seen(path: Path) -> camera_drift.Seen | None:
    """The camera's figures of FRAMES pictures over a trial; None where it has none that show a bead, which its stage will say."""
    try:
        frames = trials.read_trial(path, unreadable_share=1.0).frames
        every = max(len(frames.time_s) // FRAMES, 1)
        return camera_drift.figures([picture for k, (_, picture) in enumerate(frames) if k % every == 0 and picture is not None])
    except ValueError:
        return None


def look(limits: Drift, loop: str, paths: Sequence[str], kept: Mapping[str, Any], pending: set[str], found: dict[str, Any]) -> None:
    before = [camera_drift.Seen(np.array(mean), np.array(deviation), frames) for mean, deviation, frames in kept.get("camera", [])]
    for path in paths:
        now = seen(Path(path))
        if now is None or not before:
            found["notes"].append(
                f"{path}: {'no picture shows a bead' if before else 'the champion has no pictures of its own'}: the camera was not judged"
            )
            continue
        _, causes = camera_drift.changes(now, before, moved_px=limits.camera_px, contrast_percent=limits.contrast_percent)
        raised(limits, loop, path, [(cause.key, cause.words, cause.sigmas) for cause in causes], [], pending, found)


def raised(
    limits: Drift,
    loop: str,
    path: str,
    causes: Sequence[tuple[str, str, float]],
    consequences: Sequence[str],
    pending: set[str],
    found: dict[str, Any],
) -> None:
    """Alarms where a cause is sure at once, or has been watched the night before; watched where it is nearly sure."""
    for key, words, sigmas in causes:
        one = {
            "loop": loop,
            "key": f"{loop}: {key}",
            "recording": path,
            "cause": words,
            "sigmas": round(float(sigmas), 1),
            "consequences": list(consequences),
        }
        if abs(sigmas) >= limits.alarm_sigmas or (abs(sigmas) >= limits.watch_sigmas and one["key"] in pending):
            found["alarms"].append(one)
        elif abs(sigmas) >= limits.watch_sigmas:
            found["watched"].append(one)
