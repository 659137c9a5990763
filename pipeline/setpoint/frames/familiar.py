"""Tests if a camera's pictures resemble those that the classifier learned from. Measures the whole crop and
the ground beside the bead, for each window, and gives a p-value: how rarely a familiar window looks so
unusual.

A network trained for the width of a bead learns to ignore much else, and its input, equalised and cut to the
bead, has lost the rest. So pictures of an unfamiliar printer look ordinary to it. Printers differ around the
bead: in light, focus, noise, texture, and in how far the bead's profile is that of a line.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import scipy.linalg

from pipeline.setpoint.frames import key_area
from pipeline.setpoint.frames.key_area import LENGTH, SIDE, KeyAreas

LEVELS = (1, 5, 25, 50, 75, 95, 99)  # percentiles of gray levels of the crop
OCTAVES = 5
# the strip beside the bead, in px across the line; the bead and its edges lie within REACH
NEAR, REACH, START = 14, 28, 12
# a frame's measures vary with its bead, so a window's are the medians of a few frames: of FRAMES spread over
# it, or of the first accepted frame of every MEASURED
FRAMES, MEASURED = 4, 5
# fraction of the known camera's windows that may be called foreign; it can be small, because pictures of
# other machines differ so much
FALSE_ALARMS = 0.01
NAMES = (
    *(f"gray level, {p} %" for p in LEVELS),
    *(f"structure of {2**k} px" for k in range(OCTAVES)),
    *(f"structure of {2**k} px beside the bead" for k in range(OCTAVES - 1)),
    "noise",
    "level beside the bead, one side",
    "level beside the bead, other side",
    "fall along the bead",
    "grain across the travel",
    "grain along the travel",
    "contrast of the bead",
    "sharpness of its edges",
    "profile left unexplained",
    "unlike halves",
    "level above the nozzle's tip",
    "structure above the nozzle's tip",
)


def surroundings(gray: np.ndarray, angle_deg: float, miss_px: float) -> np.ndarray:
    """Returns the measures of NAMES (measures,) of a crop (350, 350) uint8 with the tip in its middle. The
    line leaves the tip at `angle_deg` and passes beside it by `miss_px`.

    Structure is the standard deviation of each octave of a Laplacian pyramid (Burt and Adelson 1983); noise
    is after Immerkaer (1996). Both, and grain and contrast, are log(1 + .) of gray levels of 8 bits.
    """
    counts = np.cumsum(cv2.calcHist([gray], [0], None, [256], [0, 256]).ravel())
    levels = np.searchsorted(counts, np.array(LEVELS) / 100 * counts[-1]).astype(float)
    beside, bead = _strips(gray, angle_deg, miss_px)
    noise = np.abs(cv2.filter2D(gray, cv2.CV_16S, _IMMERKAER)).mean() * np.sqrt(np.pi / 2) / 6
    above = gray[SIDE // 2 - 90 : SIDE // 2 - 30, SIDE // 2 - 25 : SIDE // 2 + 25]
    return np.concatenate(
        [
            levels,
            np.log1p(_octaves(gray, OCTAVES)),
            np.log1p(_octaves(beside, OCTAVES - 1)),
            [np.log1p(noise)],
            _ground(beside),
            _bead(bead),
            [above.mean(), np.log1p(above.std())],
        ]
    )


_IMMERKAER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


def _octaves(gray: np.ndarray, count: int) -> np.ndarray:
    """Returns the standard deviations (count,) of the levels of a Laplacian pyramid."""
    stds = np.empty(count)
    for k in range(count):
        lower = cv2.pyrDown(gray)
        upper = cv2.pyrUp(lower, dstsize=gray.shape[::-1])
        stds[k] = cv2.subtract(gray, upper, dtype=cv2.CV_16S).std()
        gray = lower
    return stds


def _strips(gray: np.ndarray, angle_deg: float, miss_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ground on both sides of the line, stacked (2 (REACH - NEAR), LENGTH - START), and
    everything within REACH (2 REACH + 1, LENGTH - START). Rows run across the line, columns from the tip
    outward."""
    a = np.deg2rad(angle_deg)
    along, across = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
    origin = SIDE // 2 + START * along + (miss_px - REACH) * across
    turned = cv2.warpAffine(
        gray,
        np.column_stack([along, across, origin]),
        (LENGTH - START, 2 * REACH + 1),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    side = REACH - NEAR
    return np.vstack([turned[:side], turned[-side:]]), turned


def _ground(beside: np.ndarray) -> list[float]:
    """Returns the level of the darker and of the brighter side; asinh(fall / 5), with the fall from the tip
    outward in gray levels; and the grain across and along."""
    half = len(beside) // 2
    sides = sorted((float(beside[:half].mean()), float(beside[half:].mean())))
    x = beside.astype(np.float32)
    third = x.shape[1] // 3
    fall = float(x[:, :third].mean() - x[:, -third:].mean())
    across, along = np.abs(np.diff(x, axis=0)).mean(), np.abs(np.diff(x, axis=1)).mean()
    return [*sides, float(np.arcsinh(fall / 5)), float(np.log1p(across)), float(np.log1p(along))]


def _bead(turned: np.ndarray) -> list[float]:
    """Returns, for the mean profile across the line: its contrast; its steepest edge; the log of the residual
    left by the best line of one width and height; and the log of the difference between its near and far
    halves. The last three are relative to the contrast."""
    profile = turned.astype(np.float32).mean(axis=1)
    ground = np.median(np.r_[profile[: REACH - NEAR], profile[-(REACH - NEAR) :]])
    height = profile - ground
    contrast = max(float(np.abs(height[REACH - 3 : REACH + 4].mean())), 1.0)
    steepest = float(np.abs(np.diff(profile)).max()) / contrast
    basis = _lines()
    share = basis @ height
    left = float(np.sqrt(np.maximum((height @ height - share**2).min(), 0) / len(height))) / contrast
    middle = turned.shape[1] // 2
    near, far = (part.astype(np.float32).mean(axis=1) for part in (turned[:, :middle], turned[:, middle:]))
    unlike = float(np.sqrt(np.mean((near - far) ** 2))) / contrast
    return [float(np.log1p(contrast)), steepest, np.log(left + 0.01), np.log(unlike + 0.01)]


@functools.cache
def _lines() -> np.ndarray:
    """Returns profiles of unit norm (shapes, 2 REACH + 1) of soft-edged lines: widths of 3 to 40 px, places
    within 8 px of the middle, edges of 1 and 2.5 px."""
    t = np.arange(2 * REACH + 1) - REACH
    shapes = [
        1 / (1 + np.exp(np.clip((np.abs(t - place) - width / 2) / soft, -50, 50)))
        for width in (3, 4.5, 6, 8, 10, 13, 17, 22, 30, 40)
        for place in range(-8, 9, 2)
        for soft in (0.6, 1.5)
    ]
    table = np.array(shapes, np.float32)
    return table / np.linalg.norm(table, axis=1, keepdims=True)


# ---- a window


def of_window(
    frames: Sequence[np.ndarray] | np.ndarray, tips: np.ndarray, areas: KeyAreas, *, count: int = FRAMES
) -> np.ndarray:
    """Returns the medians (measures,) over `count` valid frames spread over a window. `tips`: (n, 2), or (2,)
    for all. NaN if no frame is valid, because without a line there is no place to measure beside it."""
    valid = np.flatnonzero(areas.valid)
    if not len(valid):
        return np.full(len(NAMES), np.nan)
    tips = np.broadcast_to(np.asarray(tips, float), (len(frames), 2))
    rows = valid[np.linspace(0, len(valid) - 1, min(count, len(valid))).round().astype(int)]
    return median(
        np.array(
            [
                surroundings(
                    key_area.crop(frames[i], (tips[i, 0], tips[i, 1])).gray,
                    areas.angle_deg[i],
                    areas.miss_px[i],
                )
                for i in rows
            ]
        )
    )


def of_frames(
    frames: np.ndarray, tip: tuple[float, float], areas: KeyAreas, *, least_score: float
) -> np.ndarray:
    """Returns measures (n, measures) float32. Of every MEASURED frames (n, height, width) with a valid key
    area and a line of at least `least_score` gray levels, the first is measured; the other rows are NaN."""
    looks = np.full((len(frames), len(NAMES)), np.nan, np.float32)
    clear = np.flatnonzero(areas.valid & (areas.score >= least_score))
    for i in clear[np.unique(clear // MEASURED, return_index=True)[1]]:
        gray = key_area.crop(frames[i], (float(tip[0]), float(tip[1]))).gray
        looks[i] = surroundings(gray, areas.angle_deg[i], areas.miss_px[i])
    return looks


def windows(segment: np.ndarray, *, length: int) -> np.ndarray:
    """Returns rows (w, length): every `length` successive frames of one segment or print, none used twice. If
    the flow changes within a window, its true flow is that of the middle frame."""
    segment = np.asarray(segment)
    order = np.argsort(segment, kind="stable")
    rows = [
        run[i : i + length]
        for run in np.split(order, np.flatnonzero(np.diff(segment[order])) + 1)
        for i in range(0, len(run) - length + 1, length)
    ]
    return np.array(rows, int).reshape(-1, length)


def medians(measures: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Returns medians (w, measures) of the windows with the frames `rows` (w, length) of `measures` (n,
    measures); NaN if no frame of a window was measured."""
    looks = [median(measures[some].astype(float)) for some in rows]
    return np.array(looks).reshape(len(rows), measures.shape[1])


def median(rows: np.ndarray) -> np.ndarray:
    """Returns the median (measures,) of a window's frames (n, measures). Frames without measures (NaN) are
    left out."""
    rows = rows[np.isfinite(rows).all(axis=1)]
    return np.median(rows, axis=0) if len(rows) else np.full(rows.shape[1], np.nan)


class KnownCamera(NamedTuple):
    """How windows of a known camera look: `mean` and `deviation` (f,); `whitening` (f, f), which gives the
    scaled measures unit covariance; `scores` (n,), ascending, of windows of other segments."""

    mean: np.ndarray
    deviation: np.ndarray
    whitening: np.ndarray
    scores: np.ndarray


def needed_windows(false_alarms: float) -> int:
    """Returns the number of windows needed to know a camera, so that half of them give p-values down to
    `false_alarms`."""
    return 2 * int(np.ceil(1 / false_alarms - 1e-9))


def fit_camera(windows: np.ndarray, segment: np.ndarray, *, false_alarms: float) -> KnownCamera:
    """Fits the camera to windows (n, f) of segments (n,). Every other segment gives mean and covariance
    (shrunk: Ledoit and Wolf 2004). Each remaining segment gives one score, the largest of its windows.

    Raises ValueError if there are too few segments for a p-value of `false_alarms`.
    """
    windows, segment = np.asarray(windows, float), np.asarray(segment)
    sound = np.isfinite(windows).all(axis=1)
    windows, segment = windows[sound], segment[sound]
    names, needed = np.unique(segment), needed_windows(false_alarms)
    if len(names) < needed:
        raise ValueError(
            f"a camera is known from at least {needed} segments with a fresh line where {false_alarms:.0%} "
            f"of its windows may be called foreign, found {len(names)}; record more, "
            "or allow more false alarms"
        )
    learned = windows[np.isin(segment, names[::2])]
    mean, deviation = learned.mean(axis=0), learned.std(axis=0) + 1e-6
    # imported here, because only this function needs it, and it takes longer to import than everything else
    from sklearn.covariance import LedoitWolf

    covariance = LedoitWolf().fit((learned - mean) / deviation).covariance_
    L = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(covariance)))
    whitening = scipy.linalg.solve_triangular(L, np.eye(len(L)), lower=True)
    camera = KnownCamera(mean, deviation, whitening, np.zeros(0))
    scores = score(camera, windows)
    return camera._replace(scores=np.sort([scores[segment == name].max() for name in names[1::2]]))


def score(camera: KnownCamera, windows: np.ndarray) -> np.ndarray:
    """Returns the distance (n,) of windows (n, f) from those of the camera: z' C^-1 z + mean of z^4, with z
    in standard deviations. The first term is large if measures do not fit together, the second if a single
    one is far off."""
    z = (np.asarray(windows, float) - camera.mean) / camera.deviation
    return ((z @ camera.whitening.T) ** 2).sum(axis=1) + (z**4).mean(axis=1)


def p_value(camera: KnownCamera, windows: np.ndarray) -> np.ndarray:
    """Returns the conformal p-value (n,) of windows (n, f) (Vovk, Gammerman and Shafer 2005):

        p = (1 + number of scores at least as large) / (1 + n scores)

    At most a fraction p of new segments has p or less. NaN for a window without a valid frame.
    """
    far = score(camera, windows)
    beyond = len(camera.scores) - np.searchsorted(camera.scores, far, side="left")
    return np.where(np.isfinite(far), (1 + beyond) / (1 + len(camera.scores)), np.nan)


def foreign(camera: KnownCamera, windows: np.ndarray, *, false_alarms: float) -> np.ndarray:
    """Returns whether windows (n, f) come from an unknown camera (n,) bool; false if a window has no
    measures."""
    return p_value(camera, windows) <= false_alarms


def unlike(camera: KnownCamera, window: np.ndarray) -> str:
    """Returns, in words, the measure that differs most from the camera's windows."""
    z = (np.asarray(window, float) - camera.mean) / camera.deviation
    k = int(np.abs(z).argmax())
    return f"{NAMES[k]}: {abs(z[k]):.0f} deviations {'above' if z[k] > 0 else 'below'} the known camera's"


def fit_recorded_camera(
    surroundings: np.ndarray, segment: np.ndarray, *, length: int
) -> tuple[KnownCamera | None, int]:
    """Returns the camera of recorded frames, and the number of windows. `surroundings` (n, measures);
    `segment` (n,): stretch of constant settings; windows have `length` successive frames of one stretch.

    Windows of one stretch err together, so stretches are the independent units. If there are too few of them,
    single windows are; if these are too few as well, there is no camera (None).
    """
    windows, stretch = window_medians(surroundings, segment, length=length)
    for together in (stretch, np.arange(len(windows))):
        try:
            return fit_camera(windows, together, false_alarms=FALSE_ALARMS), len(windows)
        except ValueError:
            continue
    return None, len(windows)


def window_medians(
    surroundings: np.ndarray, segment: np.ndarray, *, length: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the measures of the windows (w, f) and the stretch of each (w,), for windows with a measured
    frame."""
    segment = np.asarray(segment)
    rows = windows(segment, length=length)
    looks = medians(surroundings, rows)
    sound = np.isfinite(looks).all(axis=1)
    return looks[sound], segment[rows[sound, 0]]
