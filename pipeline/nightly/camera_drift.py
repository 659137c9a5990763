"""Has the camera moved, has the light or the ink changed, is it out of focus? Compares figures of a line's
frames with those of nights that are known to be good; for a nozzle camera, the balance of classes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.nightly.drift import Shift, shift

FIGURES = ("row_px", "tilt_px", "background", "contrast", "sharpness_per_px", "width_px")
VISIBLE = 12.0  # gray levels by which a bead must stand out of its background to be measured
# if the relative changes of background and contrast are within this ratio of each other, the light has
# changed, not the ink
ALIKE = 0.5


Stats = tuple[np.ndarray, np.ndarray]  # median and its standard deviation of a night's figures


def figures(frames: Sequence[np.ndarray]) -> Stats:
    """Returns the median (6,) of FIGURES over grey frames (h, w) with a line along the columns, and its
    standard deviation (6,). The figures are: row of the line's middle; how much lower it lies at the right
    end than at the left; background level; contrast of the bead (below 0: dark on light); steepest edge as a
    fraction of the contrast per px; width at half contrast in px. Only every fifth frame counts as
    independent, because beads are long. Raises ValueError if fewer than five frames show a bead."""
    rows = np.array([row for frame in frames if (row := _frame(np.asarray(frame, float))) is not None])
    if len(rows) < 5:
        raise ValueError(
            f"camera: expected a bead in at least 5 frames, found one in {len(rows)} of {len(frames)}; "
            "look at the picture: lens, light, ink"
        )
    # medians: a frame at the end of a line is no picture of it
    middle = np.median(rows, axis=0)
    return middle, 1.4826 * 1.2533 * np.median(np.abs(rows - middle), axis=0) * np.sqrt(5.0 / len(rows))


def _frame(g: np.ndarray) -> np.ndarray | None:
    profile = np.median(g, axis=1)
    background = float(
        np.median(np.concatenate([profile[: len(profile) // 5], profile[-len(profile) // 5 :]]))
    )
    away = profile - background
    # the plateau, not the specular line on it, which any blur or tilt flattens
    contrast = float(np.median(away[np.abs(away) >= 0.35 * np.abs(away).max()]))
    if abs(contrast) < VISIBLE:
        return None
    sides = [np.median(part, axis=1) - background for part in np.array_split(g, 2, axis=1)]
    if min(np.abs(side).max() for side in sides) < 0.5 * np.abs(away).max():
        return None  # the line ends within the picture
    halves = [_middle(side, contrast) for side in sides]
    inside = away / contrast > 0.5
    # the two halves' middles are half a width apart: the tilt over the whole of it is twice their difference
    return np.array(
        [
            np.mean(halves),
            2 * (halves[1] - halves[0]),
            background,
            contrast,
            np.abs(np.diff(profile)).max() / abs(contrast),
            float(inside.sum()),
        ]
    )


def _middle(away: np.ndarray, contrast: float) -> float:
    weight = np.clip(away / contrast - 0.25, 0.0, 0.75)
    return float((weight * np.arange(len(weight))).sum() / max(weight.sum(), 1e-9))


class CameraChange(NamedTuple):
    """A change in words, its key for the next run, and its size in sigmas."""

    key: str
    words: str
    sigmas: float


def shift_of(now: Stats, before: Sequence[Stats]) -> Shift:
    """Compares the figures of a night with those of the nights before."""
    usual, deviations = (np.stack(each) for each in zip(*before, strict=True))
    return shift(*now, usual, deviations)


def changes(
    now: Stats, before: Sequence[Stats], *, moved_px: float, contrast_percent: float
) -> tuple[Shift, list[CameraChange]]:
    """Returns the shift of the camera's figures, and the causes: moved, other light, other ink, or out of
    focus. The bead's width is left out, because it depends on the process. So are changes too small to
    matter, however certain."""
    moved = shift_of(now, before)
    by = moved.value - moved.reference
    percent = 100 * np.divide(by, abs(moved.reference), out=np.zeros_like(by), where=moved.reference != 0)
    row, tilt, background, contrast, sharpness, _ = range(len(FIGURES))
    causes = []
    if max(abs(by[row]), abs(by[tilt])) >= moved_px:
        words = (
            f"the camera has moved: the line lies {by[row]:+.1f} px lower and tilts by {by[tilt]:+.1f} px "
            "across the picture; calibrate it again"
        )
        causes.append(CameraChange("camera", words, max(moved.sigmas[row], moved.sigmas[tilt], key=abs)))
    if told := _light_or_ink(percent[background], percent[contrast], contrast_percent):
        at = background if told[0] == "background" else contrast
        causes.append(CameraChange(*told, moved.sigmas[at]))
    if abs(percent[sharpness]) >= 2 * contrast_percent and not causes:
        words = f"the edges are {percent[sharpness]:+.0f} % as steep: the focus has changed"
        causes.append(CameraChange("focus", words, moved.sigmas[sharpness]))
    return moved, causes


def _light_or_ink(background: float, contrast: float, limit: float) -> tuple[str, str] | None:
    """Returns the cause of changes in percent. If background and contrast change alike, it is the light; if
    the contrast changes alone, it is the ink."""
    light, ink = abs(background) >= limit, abs(contrast) >= limit
    alike = min(abs(background), abs(contrast)) >= ALIKE * max(abs(background), abs(contrast))
    if (light or ink) and alike and background * contrast > 0:
        return "light", (
            f"the light has changed: background {background:+.0f} % and contrast {contrast:+.0f} % together"
        )
    if ink:
        return "ink", (
            f"the ink looks different: contrast {contrast:+.0f} %, background {background:+.0f} %: another "
            "ink, or another surface under it"
        )
    words = f"the background has changed by {background:+.0f} %: another surface, or stray light"
    return ("background", words) if light else None


# ---- the camera that looks at the nozzle: what of a print's frames is
# which class, and how the line stands out

KINDS = ("are under-extruded", "are well extruded", "are over-extruded", "show no line that can be read")


def line_contrast(scores: np.ndarray, *, together: float) -> Stats:
    """Returns the median contrast (1,) of the line in gray levels, from the frames' ridge scores, and its
    standard deviation (1,). Frames come in segments of `together` similar frames, and each segment counts
    once."""
    middle = float(np.median(scores))
    spread = 1.4826 * 1.2533 * float(np.median(np.abs(scores - middle)))
    return np.array([middle]), np.array([max(spread * np.sqrt(together / len(scores)), 1e-6)])


def contrast_changes(now: Stats, before: Sequence[Stats], *, percent: float) -> list[CameraChange]:
    """Returns a change if the line's contrast differs from that of the prints before by at least
    `percent`."""
    moved = shift_of(now, before)
    by = 100 * float(moved.value[0] / max(moved.reference[0], 1e-9) - 1)
    words = (
        f"the line stands out by {moved.value[0]:.0f} gray levels where {moved.reference[0]:.0f} were usual "
        f"({by:+.0f} %): light, focus or material"
    )
    return [CameraChange("contrast", words, float(moved.sigmas[0]))] if abs(by) >= percent else []


def balance_changes(
    now: np.ndarray, before: np.ndarray, *, together: float, points: float
) -> list[CameraChange]:
    """Compares counts (4,) of KINDS with those of the prints before (prints, 4). Returns the kind that
    changed most certainly, if by at least `points`; frames without a line come before classes."""
    balance = class_balance(now, before, together=together)
    by = balance.value - balance.reference
    moved = [k for k in range(len(KINDS)) if abs(by[k]) >= points]
    if not moved:
        return []
    k = 3 if 3 in moved else max(moved, key=lambda k: abs(balance.sigmas[k]))
    why = (
        "the nozzle's tip in the picture, light or focus"
        if k == 3
        else "flow, or the picture that its class is read from"
    )
    words = (
        f"{balance.value[k]:.0f} % of the frames {KINDS[k]} where {balance.reference[k]:.0f} % were usual: "
        f"{why}"
    )
    return [CameraChange("balance", words, float(balance.sigmas[k]))]


def foreign_changes(
    now: np.ndarray, before: np.ndarray, *, together: float, points: float
) -> list[CameraChange]:
    """Compares counts (2,) of frames that look like what the classifier learned from, and of frames that do
    not, with the prints before (prints, 2). Returns a change if the share of the latter grew by at least
    `points`. No labels are needed. The classifier's own confidence is no help: on frames out of focus it is
    more confident, and wrong."""
    share = class_balance(now, before, together=together)
    if share.value[1] - share.reference[1] < points:
        return []
    words = (
        f"{share.value[1]:.0f} % of the frames look like none that the classifier learned from, where "
        f"{share.reference[1]:.0f} % were usual: focus, the nozzle's tip in the picture, or another camera"
    )
    return [CameraChange("foreign frames", words, float(share.sigmas[1]))]


def class_balance(now: np.ndarray, before: np.ndarray, *, together: float) -> Shift:
    """Compares shares of classes in the counts now (classes,) with those of good nights (nights, classes), in
    percentage points. Frames come in runs of `together` equal frames."""
    shares = 100 * now / max(now.sum(), 1)
    usual = 100 * before / np.maximum(before.sum(axis=1, keepdims=True), 1)

    def deviation(percent: np.ndarray, count: np.ndarray) -> np.ndarray:
        # half a run is added to each class, so that a class that was never seen has no zero deviation
        p = (percent / 100 * count / together + 0.5) / (count / together + 0.5 * percent.shape[-1])
        return 100 * np.sqrt(p * (1 - p) / np.maximum(count / together, 1))

    return shift(
        shares, deviation(shares, now.sum()), usual, deviation(usual, before.sum(axis=1, keepdims=True))
    )
