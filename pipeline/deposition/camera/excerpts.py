"""A few frames of a trial for the page, with the measured edges drawn in."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from pipeline.deposition.camera import bead
from pipeline.deposition.camera.bead import Bead
from pipeline.deposition.camera.line import Mounting
from pipeline.deposition.camera.readings import TrialFrames, consistent, measure_beads


def excerpts(
    frames: TrialFrames,
    signals: Mapping[str, tuple[np.ndarray, np.ndarray]],
    mounting: Mounting,
    *,
    scale: tuple[float, float],
) -> Iterator[tuple[int, np.ndarray, dict[str, Any]]]:
    """Yields (number, picture (h, w, 3) in RGB, figures) of the frames to show. signals {name: (time_s (n,),
    values (n,))} have the gantry's place and speed; scale is (px_per_mm, offset_px) of the widths."""
    gantry, (px_per_mm, offset_px) = signals["position_mm"], scale
    times, beads = [], []
    for time, _, one in measure_beads(frames, gantry, mounting):
        times.append(time)
        beads.append(one)
    if not beads:
        return
    beads = list(zip(times, consistent(beads), strict=True))
    travel_mm = (np.mean(mounting.columns) - mounting.nozzle_column) * abs(mounting.mm_per_px)
    places = places_to_show(beads, *signals["speed_mm_per_s"], travel_mm=float(travel_mm))
    for number, (time, picture, _) in enumerate(measure_beads(frames, gantry, mounting)):
        if number in places:
            one = beads[number][1]
            width_mm = float(mounting.true_px(np.array(one.width)) - offset_px) / px_per_mm
            figures = {"blur_px": one.blur_px, "width_mm": width_mm, "deviation_px": one.deviation}
            figures = {name: value if np.isfinite(value) else None for name, value in figures.items()}
            row = {"place": places[number], "time_s": round(time, 6), "reason": one.reason} | figures
            yield number, cut(bead.drawn(picture, one), one), row


def places_to_show(
    beads: Sequence[tuple[float, Bead]], time_s: np.ndarray, speed: np.ndarray, *, travel_mm: float
) -> dict[int, str]:
    """Returns numbers of the frames to show, and what they show: start, steady line, corner, and the first
    frame rejected for each reason. beads are (time, bead) of all frames; speed (n,) at time_s (n,) is the
    gantry's. After the pause the corner travels travel_mm to the middle of the measured columns."""
    full = np.median([one.width for _, one in beads if not one.reason] or [0.0])
    good = [k for k, (_, one) in enumerate(beads) if not one.reason and one.width > 0.7 * full]
    rejected = {one.reason: k for k, (_, one) in reversed(list(enumerate(beads))) if one.reason}
    places = dict.fromkeys(rejected.values(), "rejected")
    if not good:
        return places
    begin = beads[good[0]][0]
    still = time_s[(speed < 0.05 * speed.max()) & (time_s > begin)]
    pause = float(still[0]) if len(still) else beads[good[-1]][0]
    # the gantry stands at the end too, so the pause ends with its first stretch
    ends = np.flatnonzero(np.diff(still) > 1.5 * np.median(np.diff(time_s))) if len(still) else []
    resumed = float(still[ends[0]]) if len(ends) else float(still[-1]) if len(still) else pause
    corner = resumed + travel_mm / max(float(speed.max()), 1e-9)
    for place, at in (("start", begin), ("steady line", (begin + pause) / 2), ("corner", corner)):
        places.setdefault(min(good, key=lambda k: abs(beads[k][0] - at)), place)
    return places


def cut(picture: np.ndarray, measured: Bead) -> np.ndarray:
    """Returns the picture (h, w, 3) cut to its middle half around the bead, at three quarters of its size."""
    h = picture.shape[0]
    edges = np.concatenate([measured.top, measured.bottom])
    middle = float(np.nanmean(edges)) if np.isfinite(edges).any() and not measured.reason else h / 2
    first = int(np.clip(middle - h / 4, 0, h - h // 2))
    return cv2.resize(picture[first : first + h // 2], None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
