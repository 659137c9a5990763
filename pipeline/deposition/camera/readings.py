"""What the frames of a trial say before any flow is worked out: the bead's width in every frame, how far off
it may be, and how late the camera is."""

import itertools
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from pipeline.deposition.camera import bead, latency, line
from pipeline.deposition.camera.bead import Bead
from pipeline.deposition.camera.latency import Gantry, Latency
from pipeline.deposition.camera.line import Mounting, pose

# frames measured together
TOGETHER = 16
# readings along the line and bands across it, from which the pictures' motion is told: px of one reading
STEP_PX, BANDS = 4, 16
# what is this many times as blurred as the bead of most frames, or has this share of its contrast, is no bead
BLURRED, FAINT = 2.5, 0.4
UNLIKE = "unlike the other frames"


class TrialFrames(Protocol):
    """(time_s, picture) of each frame, in the order of time; walked as often as needed."""

    time_s: np.ndarray

    def __iter__(self) -> Iterator[tuple[float, np.ndarray]]: ...

    def pick(self, numbers: Collection[int]) -> Iterator[tuple[int, np.ndarray]]:
        """(number, picture) of those with these numbers."""
        ...


class Readings(NamedTuple):
    """The readings of F frames: time_s (F,) as stamped, columns (m,), widths (F, m) in px of the picture as
    it is measured (0 bare, NaN unread), reasons (F,) why a frame has no usable bead, the camera's latency as
    this recording tells it, and by how much all widths may be off for blur and contrast, px (NaN without a
    bead)."""

    time_s: np.ndarray
    columns: np.ndarray
    widths: np.ndarray
    reasons: list[str]
    latency: Latency
    edge_px: float

    @classmethod
    def from_values(cls, values: tuple) -> "Readings":
        """Of six plain values, the latency as (latency_s, deviation_s)."""
        *rest, late, edge_px = values
        return cls(*rest, Latency(*late), edge_px)


def measure_beads(
    frames: TrialFrames, gantry: Gantry, mounting: Mounting
) -> Iterator[tuple[float, np.ndarray, Bead]]:
    """(time, picture as it is measured, bead) of each frame, a few at a time: memory stays flat, and what a
    frame costs beyond its decoding is shared."""
    turn, rows = pose(mounting, frames.time_s, gantry, frames.pick)
    rest = iter(frames)
    while batch := list(itertools.islice(rest, TOGETHER)):
        times, pictures = zip(*batch, strict=True)
        pictures = [picture if turn is None else line.turned(picture, turn) for picture in pictures]
        beads = bead.measure_all(
            [picture[rows] for picture in pictures],
            columns=(mounting.columns[0], min(mounting.columns[1], pictures[0].shape[1])),
            longest_blur_px=mounting.longest_blur_px,
            sign=mounting.sign,
        )
        beads = [one._replace(top=one.top + rows.start, bottom=one.bottom + rows.start) for one in beads]
        yield from zip(times, pictures, beads, strict=True)


def consistent(beads: Sequence[Bead]) -> list[Bead]:
    """The beads of one recording; those far more blurred or fainter than most of them, or of the other
    colour, come back with a reason: grain of an empty bed passes for a bead now and then."""
    blur, contrast = _typical(beads)
    return [
        one
        if one.reason or (one.blur_px <= BLURRED * blur and one.contrast / contrast >= FAINT)
        else one._replace(widths=one.widths * np.nan, width=np.nan, deviation=np.nan, reason=UNLIKE)
        for one in beads
    ]


def _typical(beads: Sequence[Bead]) -> tuple[float, float]:
    """Median blur in px and contrast of the usable beads; NaN without one."""
    usable = [(one.blur_px, one.contrast) for one in beads if not one.reason]
    blur, contrast = np.median(usable, axis=0) if usable else (np.nan, np.nan)
    return float(blur), float(contrast)


def read(frames: TrialFrames, gantry: Gantry, mounting: Mounting) -> Readings:
    """The readings of a trial's frames; `gantry` is its place as recorded."""
    first, last = mounting.columns
    bands = (max((last - first) // STEP_PX, 1), BANDS)
    times, beads, signals = [], [], []
    for time, picture, measured in measure_beads(frames, gantry, mounting):
        times.append(time)
        beads.append(measured)
        strip = picture[:, first : min(last, picture.shape[1])]
        signals.append(cv2.resize(strip, bands, interpolation=cv2.INTER_AREA).astype(np.float32))
    time_s, beads = np.array(times), consistent(beads)
    blur, contrast = _typical(beads)
    level = 257 if signals and picture.dtype == np.uint16 else 1
    return Readings(
        time_s,
        beads[0].columns if beads else np.zeros(0),
        np.array([one.widths for one in beads]),
        [one.reason for one in beads],
        _latency(time_s, signals, mounting, gantry),
        bead.edge_deviation(blur, contrast / level),
    )


def _latency(
    time_s: np.ndarray, signals: Sequence[np.ndarray], mounting: Mounting, gantry: Gantry
) -> Latency:
    known = np.isfinite(gantry[1])
    if known.sum() < 3 or not signals:
        return latency.UNTOLD
    step_mm = mounting.mm_per_px * (mounting.columns[1] - mounting.columns[0]) / signals[0].shape[1]
    known_gantry = (gantry[0][known], gantry[1][known])
    return latency.estimate(time_s, np.array(signals), known_gantry, step_mm=step_mm)
