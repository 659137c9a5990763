"""Finds how the ground moves under a camera that moves with the nozzle; the fresh line lies along this
direction.

Deposited material stays on the plate. So from one frame to the next, plate, older beads and the end of the
fresh line move away from the tip together. The shift of the ground below the tip is found by phase
correlation (Kuglin and Hines 1975), summed over a short run of frames. The direction is unknown if the
picture turns, if motion blur shows streaks in another direction, or if no shift stands out.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from pipeline.setpoint.frames.key_area import SIDE

# ground below the tip, reduced by STEP; rows nearer than BELOW px show the nozzle's rim
STEP, BELOW = 2, 8
SHAPE = ((SIDE // 2 - BELOW) // STEP, SIDE // STEP)
# a run is a frame with RUN frames on either side (at an end of the film, the first or last 2 RUN + 1); fewer
# pairs than LEAST are not enough
RUN, LEAST = 3, 5
# a shift must stand out by this many deviations of the correlation, by this factor over any other, and be
# this long
DEVIATIONS, FACTOR, SHORTEST_PX = 8.0, 1.3, 3.0
# and, within STEP px, it must be the likeliest shift in this fraction of the run's pairs; if the frames are
# not from a film, or the stage moves to and fro, each pair has another shift
AGREE = 0.8
# streaks of at least this coherence give the motion's axis; it turns by at most TURN_DEG in a run, and the
# shift lies within ALONG_DEG of it
COHERENT, TURN_DEG, ALONG_DEG = 0.15, 8.0, 20.0
# perspective bends the axis between the ground and the line at the tip
LEEWAY_DEG = 20


class Travel(NamedTuple):
    """For n frames: `direction_deg` (n,), in which the fresh line leaves the tip, NaN if unknown; `shift_px`
    (n,), from one frame to the next; `reasons` (n), empty if the direction is known."""

    direction_deg: np.ndarray
    shift_px: np.ndarray
    reasons: tuple[str, ...]


def travel(crops: Sequence[np.ndarray]) -> Travel:
    """Returns the travel of successive frames of one film. Each is a crop (350, 350) uint8 with the tip in
    its middle (key_area.crop); 0 degrees is right, 90 down."""
    n = len(crops)
    if n < LEAST + 1:
        why = f"motion: {n} frames in a row are too few to see the ground move"
        return Travel(np.full(n, np.nan), np.full(n, np.nan), (why,) * n)
    ground = np.stack([_ground(crop) for crop in crops])
    axis, coherence = np.array([_streaks(one) for one in ground]).T
    surfaces = _correlations(ground)
    found = [_of_run(k, axis, coherence, surfaces) for k in range(n)]
    direction, shift, reasons = zip(*found, strict=True)
    return Travel(np.array(direction), np.array(shift), tuple(reasons))


def _ground(crop: np.ndarray) -> np.ndarray:
    """Returns the ground below the tip at half size (83, 175) float32."""
    below = crop[SIDE // 2 + BELOW : SIDE // 2 + BELOW + STEP * SHAPE[0], : STEP * SHAPE[1]]
    return cv2.resize(below, SHAPE[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)


_WINDOW = np.outer(np.hanning(SHAPE[0]), np.hanning(SHAPE[1])).astype(np.float32)


def _streaks(ground: np.ndarray) -> tuple[float, float]:
    """Returns (axis in 0 .. 180 degrees, coherence 0 .. 1) of the structure tensor. A few strong edges, such
    as those of one bead, weigh no more than many weak ones."""
    smooth = cv2.GaussianBlur(ground, (0, 0), 1.0)
    x, y = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    steepness = np.hypot(x, y)
    weight = _WINDOW * np.minimum(1, np.quantile(steepness, 0.7) / (steepness + 1e-6)) ** 2
    xx, xy, yy = (float((weight * a * b).sum()) for a, b in ((x, x), (x, y), (y, y)))
    axis = np.rad2deg(0.5 * np.arctan2(2 * xy, xx - yy)) + 90.0
    return axis % 180, float(np.hypot(xx - yy, 2 * xy) / (xx + yy + 1e-6))


def _correlations(ground: np.ndarray) -> np.ndarray:
    """Returns the phase correlations (n - 1, h, w) of neighbouring frames, with zero shift in the middle. The
    mean of the frames around is subtracted first, which removes what stands still."""
    n = len(ground)
    spectra = [
        np.fft.rfft2((ground[k] - ground[max(0, k - RUN) : k + RUN + 1].mean(axis=0)) * _WINDOW)
        for k in range(n)
    ]
    surfaces = np.empty((n - 1, *SHAPE), np.float32)
    for k, (before, after) in enumerate(itertools.pairwise(spectra)):
        crossed = after * np.conj(before)
        size = np.abs(crossed)
        whitened = crossed / (size + 1e-3 * size.max() + 1e-12)
        surfaces[k] = cv2.GaussianBlur(np.fft.fftshift(np.fft.irfft2(whitened, s=SHAPE)), (0, 0), 1.0)
    return surfaces


def _of_run(
    k: int, axis: np.ndarray, coherence: np.ndarray, surfaces: np.ndarray
) -> tuple[float, float, str]:
    """Returns (direction, shift in px, reason) of the run around frame k."""
    start = min(max(0, k - RUN), max(0, len(axis) - 2 * RUN - 1))
    run, pairs = slice(start, start + 2 * RUN + 1), surfaces[start : start + 2 * RUN]
    turned = np.abs((axis[run] - axis[k] + 90) % 180 - 90).max()
    streaky = coherence[run].min() >= COHERENT
    if streaky and turned > TURN_DEG:
        return np.nan, np.nan, f"motion: the picture turns by {turned:.0f} degrees within a few frames"
    surface = pairs.sum(axis=0)
    row, column = (int(v) for v in np.unravel_index(int(surface.argmax()), surface.shape))
    peak, spread = float(surface[row, column]), max(float(surface.std()), 1e-12)
    own = np.unravel_index(pairs.reshape(len(pairs), -1).argmax(axis=1), SHAPE)
    alike = (np.abs(own[0] - row) <= 1) & (np.abs(own[1] - column) <= 1)
    surface[max(row - 4, 0) : row + 5, max(column - 4, 0) : column + 5] = 0
    if peak < DEVIATIONS * spread or peak < FACTOR * surface.max() or alike.mean() < AGREE:
        return np.nan, np.nan, "motion: no shift of the ground stands out"
    y, x = row - SHAPE[0] // 2, column - SHAPE[1] // 2
    shift, direction = STEP * float(np.hypot(x, y)), float(np.rad2deg(np.arctan2(y, x))) % 360
    if shift < SHORTEST_PX:
        return np.nan, shift, "motion: the ground stands still"
    if streaky and abs((direction - axis[k] + 90) % 180 - 90) > ALONG_DEG:
        return np.nan, shift, "motion: the ground's streaks lie across its shift"
    return direction, shift, ""
