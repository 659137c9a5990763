"""Has the camera moved, the light or the ink changed, the focus gone? Figures of a line's frames, held
against those of nights that are known to be good; and of a nozzle's camera the balance of classes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.nightly.drift import Shift, shift

FIGURES = ("row_px", "tilt_px", "background", "contrast", "sharpness_per_px", "width_px")
SEEN = 12.0  # gray levels by which a bead must stand out of its background to be looked at
ALIKE = 0.5  # background and contrast that change by shares within this ratio of each other changed together: the light, not the ink


class Seen(NamedTuple):
    """Of one night: median (6,) of FIGURES over the frames with a bead, its standard deviation (6,) (a figure
    counts a frame as new only every fifth: beads are long), frames with one."""

    mean: np.ndarray
    deviation: np.ndarray
    frames: int


def figures(frames: Sequence[np.ndarray]) -> Seen:
    """Of grey frames (h, w) with a line along the columns: row of its middle, how much lower it lies
    at the right end than at the left, background level, contrast of the bead (below 0: dark on
    light), steepest edge as a share of the contrast per px, width at half contrast in px. Raises
    ValueError where fewer than five frames show a bead.
    """
    rows = np.array([found for frame in frames if (found := _frame(np.asarray(frame, float))) is not None])
    if len(rows) < 5:
        raise ValueError(
            f"camera: expected a bead in at least 5 frames, found one in {len(rows)} of {len(frames)}; "
            "look at the picture: lens, light, ink"
        )
    # medians: a frame at the end of a line is no picture of it
    middle = np.median(rows, axis=0)
    deviation = 1.4826 * 1.2533 * np.median(np.abs(rows - middle), axis=0) * np.sqrt(5.0 / len(rows))
    return Seen(middle, deviation, len(rows))


def _frame(g: np.ndarray) -> np.ndarray | None:
    profile = np.median(g, axis=1)
    background = float(
        np.median(np.concatenate([profile[: len(profile) // 5], profile[-len(profile) // 5 :]]))
    )
    away = profile - background
    # the plateau, not the specular line on it, which any blur or tilt flattens
    contrast = float(np.median(away[np.abs(away) >= 0.35 * np.abs(away).max()]))
    if abs(contrast) < SEEN:
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


class Change(NamedTuple):
    """What has changed, in words, its key for the night after, and by how many sigmas."""

    key: str
    words: str
    sigmas: float


def changes(
    now: Seen, before: Sequence[Seen], *, moved_px: float, contrast_percent: float
) -> tuple[Shift, list[Change]]:
    """What the camera's figures say, the cause named: moved, other light, other ink, out of focus; the bead's
    width is the process's own affair. Changes that do not matter are left out, however sure."""
    known = np.stack([one.mean for one in before])
    found = shift(now.mean, now.deviation, known, np.stack([one.deviation for one in before]))
    by = dict(zip(FIGURES, found.value - found.reference, strict=True))
    sure = dict(zip(FIGURES, found.sigmas, strict=True))
    share = {
        name: 100 * by[name] / abs(ref) if ref else 0.0
        for name, ref in zip(FIGURES, found.reference, strict=True)
    }
    causes = []
    if max(abs(by["row_px"]), abs(by["tilt_px"])) >= moved_px:
        causes.append(
            Change("camera",
            f"the camera has moved: the line lies {by['row_px']:+.1f} px lower and tilts by "
            f"{by['tilt_px']:+.1f} px across the picture; calibrate it again",
                   max(sure["row_px"], sure["tilt_px"], key=abs))
        )  # fmt: skip
    light, ink = abs(share["background"]) >= contrast_percent, abs(share["contrast"]) >= contrast_percent
    together = (
        min(abs(share["background"]), abs(share["contrast"]))
        >= ALIKE * max(abs(share["background"]), abs(share["contrast"]))
        and share["background"] * share["contrast"] > 0
    )
    if (light or ink) and together:
        causes.append(
            Change(
                "light",
                f"the light has changed: background {share['background']:+.0f} % and contrast "
                f"{share['contrast']:+.0f} % together",
                sure["contrast"],
            )
        )
    elif ink:
        causes.append(
            Change(
                "ink",
                f"the ink looks different: contrast {share['contrast']:+.0f} %, "
                f"background {share['background']:+.0f} %: another ink, or another surface under it",
                sure["contrast"],
            )
        )
    elif light:
        causes.append(
            Change(
                "background",
                f"the background has changed by {share['background']:+.0f} %: "
                "another surface, or stray light",
                sure["background"],
            )
        )
    if abs(share["sharpness_per_px"]) >= 2 * contrast_percent and not causes:
        causes.append(
            Change(
                "focus",
                f"the edges are {share['sharpness_per_px']:+.0f} % as steep: the focus has changed",
                sure["sharpness_per_px"],
            )
        )
    return found, causes


# ---- the camera that looks at the nozzle: what of a print's frames is
# which class, and how the line stands out

KINDS = ("are under-extruded", "are well extruded", "are over-extruded", "show no line that can be read")


class Contrast(NamedTuple):
    """Median contrast (1,) of the line in a print's frames, in gray
    levels, and its standard deviation (1,)."""

    mean: np.ndarray
    deviation: np.ndarray


def line_contrast(scores: np.ndarray, *, together: float) -> Contrast:
    """Of the frames' ridge scores; frames come in segments of
    `together` that look alike, and a segment counts once."""
    middle = float(np.median(scores))
    spread = 1.4826 * 1.2533 * float(np.median(np.abs(scores - middle)))
    return Contrast(np.array([middle]), np.array([max(spread * np.sqrt(together / len(scores)), 1e-6)]))


def contrast_changes(now: Contrast, before: Sequence[Contrast], *, percent: float) -> list[Change]:
    """The line stands out less, or more, than in the prints before, by at least `percent`."""
    found = shift(
        now.mean,
        now.deviation,
        np.stack([one.mean for one in before]),
        np.stack([one.deviation for one in before]),
    )
    by = 100 * float(found.value[0] / max(found.reference[0], 1e-9) - 1)
    words = f"the line stands out by {found.value[0]:.0f} gray levels where {found.reference[0]:.0f} were usual ({by:+.0f} %): light, focus or material"
    return [Change("contrast", words, float(found.sigmas[0]))] if abs(by) >= percent else []


def balance_changes(now: np.ndarray, before: np.ndarray, *, together: float, points: float) -> list[Change]:
    """Of counts (4,) of KINDS against those of the prints before (prints, 4): the kind that has moved most
    surely by at least `points`; frames without a line go before classes."""
    found = class_balance(now, before, together=together)
    by = found.value - found.reference
    moved = [k for k in range(len(KINDS)) if abs(by[k]) >= points]
    if not moved:
        return []
    k = 3 if 3 in moved else max(moved, key=lambda k: abs(found.sigmas[k]))
    why = (
        "the nozzle's tip in the picture, light or focus"
        if k == 3
        else "flow, or the picture that its class is read from"
    )
    words = (
        f"{found.value[k]:.0f} % of the frames {KINDS[k]} where {found.reference[k]:.0f} % were usual: {why}"
    )
    return [Change("balance", words, float(found.sigmas[k]))]


def class_balance(now: np.ndarray, before: np.ndarray, *, together: float) -> Shift:
    """Shares of classes in counts now (classes,) against those of good nights (nights, classes), in points;
    frames come in runs of `together` that say the same."""
    shares, known = (
        100 * now / max(now.sum(), 1),
        100 * before / np.maximum(before.sum(axis=1, keepdims=True), 1),
    )

    def deviation(percent: np.ndarray, count: np.ndarray) -> np.ndarray:
        # half a run added to each class, so that a class that was never seen is not certain
        p = (percent / 100 * count / together + 0.5) / (count / together + 0.5 * percent.shape[-1])
        return 100 * np.sqrt(p * (1 - p) / np.maximum(count / together, 1))

    return shift(
        shares, deviation(shares, now.sum()), known, deviation(known, before.sum(axis=1, keepdims=True))
    )
