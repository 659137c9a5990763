"""Whether a camera's pictures are of the kind that the classifier learned: measures of the whole crop and of
the ground beside the bead, a window at a time, and how rarely a familiar window looks so.

A network that is trained for the width of a bead is made blind to much else, and its input, equalised and
cut to the bead, has lost the rest: a printer that it never saw looks ordinary to it. What tells printers
apart lies around the bead: light, focus, noise, texture, and how far the bead's own profile is that of a
line.
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
# a frame's measures vary with its bead; a window's are the medians of a few: of so many that are spread over
# it, or of the first accepted of every so many
FRAMES, MEASURED = 4, 5
# of windows of the known camera, the share that may be called foreign; pictures of other machines lie so far
# off that it may be small
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
    """(measures,) of NAMES of a crop (350, 350) uint8 with the tip in its middle, and of the line that leaves
    it at angle_deg and passes beside it by miss_px.

    Structure is the standard deviation of the octaves of a Laplacian pyramid (Burt and Adelson 1983), noise
    that of Immerkaer (1996), both as log(1 + .) of gray levels of 8 bits, as are grain and contrast.
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
    """(count,) standard deviations of the levels of a Laplacian pyramid."""
    stds = np.empty(count)
    for k in range(count):
        lower = cv2.pyrDown(gray)
        upper = cv2.pyrUp(lower, dstsize=gray.shape[::-1])
        stds[k] = cv2.subtract(gray, upper, dtype=cv2.CV_16S).std()
        gray = lower
    return stds


def _strips(gray: np.ndarray, angle_deg: float, miss_px: float) -> tuple[np.ndarray, np.ndarray]:
    """The ground on both sides of the line, one below the other (2 (REACH - NEAR), LENGTH - START), and all
    that lies within REACH (2 REACH, LENGTH - START): rows across the line, columns from the tip outward."""
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
    """Level of the darker and the brighter side, asinh of the fall from the tip outward over 5 gray levels,
    grain across and along."""
    half = len(beside) // 2
    sides = sorted((float(beside[:half].mean()), float(beside[half:].mean())))
    x = beside.astype(np.float32)
    third = x.shape[1] // 3
    fall = float(x[:, :third].mean() - x[:, -third:].mean())
    across, along = np.abs(np.diff(x, axis=0)).mean(), np.abs(np.diff(x, axis=1)).mean()
    return [*sides, float(np.arcsinh(fall / 5)), float(np.log1p(across)), float(np.log1p(along))]


def _bead(turned: np.ndarray) -> list[float]:
    """Contrast of the mean profile across the line, its steepest edge over its contrast, what a line of one
    width and height leaves of it, and how unlike its near and its far half are; the last three are shares
    of the contrast."""
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
    """(shapes, 2 REACH + 1) profiles of unit norm of soft-edged lines: widths of 3 to 40 px, places within 8
    px of the middle, edges of 1 and 2.5 px."""
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
    """(measures,) medians over `count` valid frames spread over a window, with the tips (n, 2), or one for
    all (2,); NaN where none is valid: there is no line beside which to look."""
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
    """(n, measures) float32 of the first of every MEASURED frames (n, height, width) that has a line of
    least_score gray levels; NaN of the others."""
    looks = np.full((len(frames), len(NAMES)), np.nan, np.float32)
    clear = np.flatnonzero(areas.valid & (areas.score >= least_score))
    for i in clear[np.unique(clear // MEASURED, return_index=True)[1]]:
        gray = key_area.crop(frames[i], (float(tip[0]), float(tip[1]))).gray
        looks[i] = surroundings(gray, areas.angle_deg[i], areas.miss_px[i])
    return looks


def windows(segment: np.ndarray, *, length: int) -> np.ndarray:
    """Rows (w, length): every `length` frames of one segment or print in the order in which they come, none
    used twice. A window may straddle a change of flow: its truth is that of its middle frame."""
    segment = np.asarray(segment)
    order = np.argsort(segment, kind="stable")
    rows = [
        run[i : i + length]
        for run in np.split(order, np.flatnonzero(np.diff(segment[order])) + 1)
        for i in range(0, len(run) - length + 1, length)
    ]
    return np.array(rows, int).reshape(-1, length)


def medians(measures: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(w, measures) of windows with the frames `rows` (w, length) of `measures` (n, measures); NaN where none
    of a window's was measured."""
    looks = [median(measures[some].astype(float)) for some in rows]
    return np.array(looks).reshape(len(rows), measures.shape[1])


def median(rows: np.ndarray) -> np.ndarray:
    """(measures,) of a window's frames (n, measures), those without measures (NaN) left out."""
    rows = rows[np.isfinite(rows).all(axis=1)]
    return np.median(rows, axis=0) if len(rows) else np.full(rows.shape[1], np.nan)


class KnownCamera(NamedTuple):
    """How windows of a known camera look: mean and deviation (f,), whitening (f, f) with which the measures
    in deviations have unit covariance, and the scores (n,), rising, of windows of other segments."""

    mean: np.ndarray
    deviation: np.ndarray
    whitening: np.ndarray
    scores: np.ndarray


def needed_windows(false_alarms: float) -> int:
    """Windows by which a camera is known: half of them give p-values down to false_alarms."""
    return 2 * int(np.ceil(1 / false_alarms - 1e-9))


def fit_camera(windows: np.ndarray, segment: np.ndarray, *, false_alarms: float) -> KnownCamera:
    """The camera of windows (n, f) of segments (n,): every other segment gives mean and covariance (shrunk:
    Ledoit and Wolf 2004), the others the scores, one each, the largest of its windows'.

    Raises ValueError where the others are too few for a p-value of false_alarms.
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
    # here, as whoever renders, watches or controls fits none, and it takes longer to import than all else
    from sklearn.covariance import LedoitWolf

    covariance = LedoitWolf().fit((learned - mean) / deviation).covariance_
    L = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(covariance)))
    whitening = scipy.linalg.solve_triangular(L, np.eye(len(L)), lower=True)
    camera = KnownCamera(mean, deviation, whitening, np.zeros(0))
    scores = score(camera, windows)
    return camera._replace(scores=np.sort([scores[segment == name].max() for name in names[1::2]]))


def score(camera: KnownCamera, windows: np.ndarray) -> np.ndarray:
    """(n,) how far windows (n, f) are from the camera's: z' C^-1 z + mean of z^4, z in deviations. The first
    is large where measures do not go together, the second where one alone is far outside."""
    z = (np.asarray(windows, float) - camera.mean) / camera.deviation
    return ((z @ camera.whitening.T) ** 2).sum(axis=1) + (z**4).mean(axis=1)


def p_value(camera: KnownCamera, windows: np.ndarray) -> np.ndarray:
    """(n,) how rarely a window of this camera is as unlike the others: (1 + those at least as far) / (1 + n),
    conformal (Vovk, Gammerman and Shafer 2005); at most a share p of new segments has p or less. NaN for a
    window without a valid frame."""
    far = score(camera, windows)
    beyond = len(camera.scores) - np.searchsorted(camera.scores, far, side="left")
    return np.where(np.isfinite(far), (1 + beyond) / (1 + len(camera.scores)), np.nan)


def foreign(camera: KnownCamera, windows: np.ndarray, *, false_alarms: float) -> np.ndarray:
    """(n,) whether windows (n, f) are of no camera that is known; not where there is none to be judged."""
    return p_value(camera, windows) <= false_alarms


def unlike(camera: KnownCamera, window: np.ndarray) -> str:
    """In words what is furthest from what the camera's windows have."""
    z = (np.asarray(window, float) - camera.mean) / camera.deviation
    k = int(np.abs(z).argmax())
    return f"{NAMES[k]}: {abs(z[k]):.0f} deviations {'above' if z[k] > 0 else 'below'} the known camera's"


def fit_recorded_camera(
    surroundings: np.ndarray, segment: np.ndarray, *, length: int
) -> tuple[KnownCamera | None, int]:
    """The camera of frames with `surroundings` (n, measures), by windows of `length` of them in a row in one
    stretch `segment` (n,) of constant settings; and the number of windows. What errs together is such a
    stretch; if these are too few, a window; no camera if those are too few as well."""
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
    """(measures of the windows (w, f), stretch of each (w,)), of those with a measured frame."""
    segment = np.asarray(segment)
    rows = windows(segment, length=length)
    looks = medians(surroundings, rows)
    sound = np.isfinite(looks).all(axis=1)
    return looks[sound], segment[rows[sound, 0]]
