"""From the frames of a window to a setpoint that may be sent: combines the frames, and gives the reason for
each decision. `actuation` decides when nothing may be sent, and sets limits and waits."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from pipeline.setpoint.frames import familiar
from pipeline.setpoint.frames.familiar import FALSE_ALARMS, KnownCamera
from pipeline.setpoint.simulation.actuation import (
    ACTS,
    FEW,
    FOREIGN,
    REASONS,
    TIP,
    UNPROVEN,
    SetpointLimits,
    still,
)
from pipeline.setpoint.simulation.simulator import FLOW_LIMITS, TEMPERATURE_LIMITS
from pipeline.setpoint.vision.proof import CameraProof, may_judge
from pipeline.setpoint.vision.window_flow import WindowFlow

CLASSES = ("under", "good", "over")


class JudgedWindow(NamedTuple):
    """Combined results of E windows of frames. `reason` (E,) indexes REASONS: with 0 the loop acts, otherwise
    it sends nothing.

    `p` (E, 3): shares of the classes; `label` (E,): the most probable class; `score` (E,): median
    out-of-distribution score; `valid` (E,): number of valid frames; `used` (E,): number of frames that count;
    `flow_seen` (E,): in percent of nominal; `spread` (E,): standard deviation of its logarithm. If no frame
    counts, p is 1/3 each and flow and spread are NaN; without a sound frame the score is NaN, too.
    """

    p: np.ndarray
    label: np.ndarray
    score: np.ndarray
    valid: np.ndarray
    used: np.ndarray
    reason: np.ndarray
    flow_seen: np.ndarray
    spread: np.ndarray


def deployed_limits(per_action: Sequence[float], per_minute: Sequence[float]) -> SetpointLimits:
    """Returns the published range of setpoints with the largest change of one action and of one minute, (2,)
    each: flow in percent and target in °C."""
    ends = (np.array(pair) for pair in zip(FLOW_LIMITS, TEMPERATURE_LIMITS, strict=True))
    return SetpointLimits(*ends, np.array(per_action), np.array(per_minute))


def judge_window(
    probabilities: np.ndarray,
    valid: np.ndarray,
    scores: np.ndarray,
    tip_moved: np.ndarray,
    *,
    flows: Callable[[np.ndarray], WindowFlow],
    least_frames: int,
    foreign_above: float,
) -> JudgedWindow:
    """Combines the frames of E windows of W frames each. `probabilities` (E, W, 3) of the classes; `valid`
    (E, W); `scores` (E, W), out-of-distribution; `tip_moved` (E,).

    A frame counts if its key area is valid, its probabilities are a distribution and its score is at most
    `foreign_above`. From the frames that count follows

        flow_seen, spread, p = flows(frames that count (E, W))      window_flow.window_flow

    The loop must not act if fewer than `least_frames` count (the reason is the commoner cause), or if the tip
    has moved. The controller weighs how certain the flow is. Raises ValueError for other shapes, or if
    `least_frames` is below 1.
    """
    P, valid, scores = np.asarray(probabilities, float), np.asarray(valid, bool), np.asarray(scores, float)
    if (
        P.ndim != 3
        or P.shape[2] != 3
        or valid.shape != P.shape[:2]
        or scores.shape != P.shape[:2]
        or np.shape(tip_moved) != P.shape[:1]
    ):
        raise ValueError(
            "judge_window: expected probabilities (E, W, 3), valid and scores (E, W), tip_moved (E,), found "
            f"{P.shape}, {valid.shape}, {scores.shape}, {np.shape(tip_moved)}; give one row a window"
        )
    if least_frames < 1:
        raise ValueError(
            f"judge_window: expected least_frames of at least 1, found {least_frames}; "
            "an empty window says nothing"
        )
    P = np.where(np.isfinite(P) & (np.abs(P) <= 2), P, -1.0)
    sound = valid & (P >= 0).all(axis=2) & (np.abs(P.sum(axis=2) - 1) < 1e-3)
    familiar = sound & (scores <= foreign_above)
    m = familiar.sum(axis=1)
    flow_seen, spread, p = flows(familiar)
    few = np.where(sound.sum(axis=1) >= least_frames, FOREIGN, FEW)
    reason = np.where(tip_moved, TIP, np.where(m < least_frames, few, ACTS))
    return JudgedWindow(
        p, p.argmax(axis=1), _median(scores, sound), valid.sum(axis=1), m, reason, flow_seen, spread
    )


def _median(scores: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Returns the median (the upper of two) of each row over the frames in `mask`; NaN if there is none. A
    missing score counts as infinite, because nothing shows that the frame is familiar."""
    ordered = np.sort(np.where(mask & ~np.isnan(scores), scores, np.inf), axis=1)
    n = mask.sum(axis=1)
    ordered = np.concatenate([ordered, np.full((len(n), 1), np.nan)], axis=1)
    return ordered[np.arange(len(n)), np.where(n > 0, n // 2, -1)]


def camera_guard(camera: KnownCamera | None, proof: CameraProof) -> Callable[[np.ndarray], np.ndarray] | None:
    """Returns foreign(looks) for `camera_seen`; None if the camera cannot be judged, and then nothing is
    sent."""
    if camera is None or not may_judge(proof):
        return None
    return partial(familiar.foreign, camera, false_alarms=FALSE_ALARMS)


def camera_seen(
    window: JudgedWindow,
    last_seen: np.ndarray,
    looks: np.ndarray,
    foreign: Callable[[np.ndarray], np.ndarray] | None,
) -> JudgedWindow:
    """Returns the windows, with a reason not to act also if the picture stands still or the camera is
    unknown.

    `last_seen` (E,): flow of the window before, NaN if there was none; `looks` (E, measures): how the windows
    look (`familiar`), NaN if no frame was measured; `foreign(looks)`: (E,) bool, None if the camera cannot be
    judged (`proof`), and then no window is acted on.
    """
    reason = np.where(window.reason == ACTS, still(window.flow_seen, last_seen), window.reason)
    if foreign is None:
        reason = np.full_like(reason, UNPROVEN)
    else:
        reason = np.where((reason == ACTS) & foreign(looks), FOREIGN, reason)
    return window._replace(reason=reason)


def why(time_s: float, window: JudgedWindow, i: int, change: np.ndarray) -> str:
    """Returns the line of the "why it acted" log for window i: time, what was seen, and what was sent or why
    nothing was sent."""
    frames = f"{time_s:6.1f} s: {window.valid[i]} frames valid, {window.used[i]} count"
    if window.reason[i] == ACTS:
        moves = (
            ", ".join(
                f"{name} {c:+g} {unit}"
                for name, c, unit in zip(("flow", "temperature"), change, ("%", "°C"), strict=True)
                if c
            )
            or "no change"
        )
        named = f"{CLASSES[window.label[i]]} {window.p[i, window.label[i]]:.2f}"
        return f"{frames}, flow {window.flow_seen[i]:.0f} %, {named}; {moves}"
    shares = " ".join(f"{name} {p:.2f}" for name, p in zip(CLASSES, window.p[i], strict=True))
    return f"{frames}, {shares}, score {window.score[i]:.3g}; held: {REASONS[window.reason[i]]}"
