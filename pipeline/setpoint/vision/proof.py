"""Decides whether a camera may be used for control. Windows of prints that were not learned from must be
classified correctly, and the camera must be distinguished from others. The loop, the exports, `shadow` and
the page use this one result."""

from typing import NamedTuple

from pipeline.setpoint.frames.familiar import FALSE_ALARMS, needed_windows

# one-sided, for the fraction of windows classified correctly
CONFIDENCE = 0.9


class CameraProof(NamedTuple):
    """Test on `windows` windows of `prints` prints (rendered segments if `rendered`) that were not learned
    from. `right`: fraction classified correctly, each class counted alike; `low`: its lower bound with
    CONFIDENCE; `least`: required. A window is correct if its class is the true one at its middle.
    `known_from`: number of windows by which the camera is distinguished from others."""

    right: float
    low: float
    least: float
    windows: int
    prints: int
    known_from: int
    rendered: bool


UNPROVEN = CameraProof(0.0, 0.0, 1.0, 0, 0, 0, False)


def may_judge(proof: CameraProof) -> bool:
    return proof.low >= proof.least and proof.known_from >= needed_windows(FALSE_ALARMS)


def verdict(proof: CameraProof) -> str:
    """Returns one sentence with accuracy and verdict."""
    of = "rendered segments" if proof.rendered else "prints"
    right = (
        f"right in {100 * proof.right:.0f} % of {proof.windows:,} windows of {proof.prints:,} {of} "
        "never learned from"
    )
    if may_judge(proof):
        return f"{right}: may judge"
    if proof.low < proof.least:
        why = (
            f"{right}, {100 * proof.low:.0f} % at least by its 90 % bound, {100 * proof.least:.0f} % required"
        )
    else:
        needed = needed_windows(FALSE_ALARMS)
        why = f"{right}, but {proof.known_from} windows do not tell it from other cameras, {needed} do"
    return f"cannot judge this camera: {why}; everything is held"
