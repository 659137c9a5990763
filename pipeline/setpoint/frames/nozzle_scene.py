"""Synthetic nozzle frames with labels: from the flow to the width of the fresh bead to the picture of an
endoscope beside the nozzle. Conditions are constant within a segment.

The numbers below set the difficulty of the scenes. With them the profile support vector machine
(yardsticks.py) is right on 0.73-0.76 of single images of held-out segments, and a test checks this. They were
changed once after networks had been tested: apart from the width, less now varies from segment to segment,
and more from image to image. Errors that last a whole segment shift a classifier's borders, and no window
averages them out. If one of these numbers changes, every figure of the classifier and of the closed loop
changes.
"""

import functools
from typing import NamedTuple

import cv2
import numpy as np
import scipy.special

from pipeline.setpoint.frames.key_area import SIDE, KeyAreas, find_all

# classes 0 below 90, 1 from 90 to 110, 2 above 110 percent of the nominal flow (paper,
# section 2.2); the flows that a printer is set to
BORDERS, FLOWS = (90.0, 110.0), (20.0, 310.0)
# range in which test flows are uniform, in percent; deviation of log flow of the bump in training flows
JUDGED, BUMP = (70.0, 150.0), 0.25
TEMPERATURES = (190.0, 200.0, 210.0, 220.0, 230.0)
# a bead of nominal flow in px; a stadium of height h has the section (w - h) h + pi h^2 / 4, so that w =
# w_100 (q + FLAT (1 - q)) with FLAT = (1 - pi/4) h / w_100
WIDTH_PX, FLAT = 8.0, 0.1
# deviations of the width: one draw a segment, one an image (at 210 degC;
# hotter material spreads by SPREAD_PER_DEGC more)
SEGMENT_SPREAD, IMAGE_SPREAD, SPREAD_PER_DEGC = 0.05, 0.08, 0.005
# share of frames without a line
EMPTY = 0.06
# ranges of a segment's conditions, uniform: gray levels, px, degrees
PLATE, CONTRAST, GRADIENT = (45.0, 95.0), (70.0, 85.0), (0.0, 30.0)
BLUR_PX, NOISE, TEXTURE, GRAIN_PX = (1.0, 1.3), (2.0, 8.0), (4.0, 6.0), (1.2, 3.0)
SPECULAR, SPECULAR_PX = (20.0, 60.0), 1.2
DIRECTION_DEG, HALF_CONE_DEG = (-25.0, 205.0), (38.0, 50.0)
OLDER_SHARE, OLDER_PITCH, OLDER_LEVEL = 0.5, (11.5, 15.0), (0.15, 0.35)
# deviations: curvature of the line in 1/px, of the calibrated tip in px, and from image to image of
# direction, place, light and focus
CURVATURE, TIP_PX, TURN_DEG, PLACE_PX, FLICKER, FOCUS = 1 / 900, 1.5, 2.5, 1.0, 0.1, 0.4
ROUGHNESS, ROUGH_GRAIN_PX = 0.26, 10.0
# and of each image, uniform: fall of the level to the bead's edge, place of the specular line in half widths
SHADING, SPECULAR_AT = (0.2, 0.4), (-0.6, 0.6)
# the stage carries its texture along the line, up to TRAVEL px
TRAVEL, REACH_PX = 60, 22.0


class PrintedSegment(NamedTuple):
    """Conditions of one printed segment. `direction_deg`: direction in which the line leaves the tip (0
    right, 90 down); `tip`: the calibrated tip (x, y).

    `ground` (350, 350) uint8: the lit plate with older beads; `texture` int16: moves over the ground;
    `nozzle` and its `mask` (350, 350) uint8. `at` (k,): pixels near the line in the flattened frame; `along`
    and `across` (k,): their places in px. `contrast`, `specular` and `noise` are in gray levels, `blur_px` in
    px.
    """

    direction_deg: float
    tip: tuple[float, float]
    width_factor: float
    ground: np.ndarray
    texture: np.ndarray
    nozzle: np.ndarray
    mask: np.ndarray
    at: np.ndarray
    along: np.ndarray
    across: np.ndarray
    contrast: float
    specular: float
    blur_px: float
    noise: float


class RenderedFrames(NamedTuple):
    """`frames` (n, 350, 350) uint8 and their truth: `flow` (n,) in percent; `temperature` (n,) in degC;
    `width_px` (n,), width of the drawn bead; `line` (n,), whether there is a line; `direction_deg` and `tip`
    of the segment."""

    frames: np.ndarray
    flow: np.ndarray
    temperature: np.ndarray
    width_px: np.ndarray
    line: np.ndarray
    direction_deg: float
    tip: tuple[float, float]


def label(flow: np.ndarray) -> np.ndarray:
    """Returns the class of a flow in percent: 0 below 90, 1 from 90 to 110, 2 above. The class of an unknown
    flow (NaN) has no meaning; the caller leaves it out."""
    flow = np.asarray(flow)
    return (flow >= BORDERS[0]).astype(np.int64) + (flow > BORDERS[1])


def draw_segment(rng: np.random.Generator) -> PrintedSegment:
    """Draws the conditions of a new segment at random."""
    direction, miss = rng.uniform(*DIRECTION_DEG), TIP_PX * rng.standard_normal(2)
    middle = SIDE // 2
    x, y = _grid()
    cos, sin = np.cos(np.deg2rad(direction)), np.sin(np.deg2rad(direction))
    along = x * np.float32(cos) + y * np.float32(sin)
    across = (
        y * np.float32(cos)
        - x * np.float32(sin)
        - np.float32(CURVATURE * rng.standard_normal() / 2) * along**2
    )
    contrast = rng.uniform(*CONTRAST)
    ground = rng.uniform(*PLATE) + _slope(rng, x, y)
    if rng.random() < OLDER_SHARE:
        ground += contrast * rng.uniform(*OLDER_LEVEL) * _older(rng, across)
    nozzle, mask = _nozzle(rng, x, y)
    at = np.flatnonzero((np.abs(across) < REACH_PX) & (along > 0) & (mask == 0))
    return PrintedSegment(
        direction_deg=direction % 360, tip=(middle + miss[0], middle + miss[1]),
        width_factor=1 + SEGMENT_SPREAD * rng.standard_normal(),
        ground=np.clip(ground, 0, 255).astype(np.uint8), texture=_texture(rng), nozzle=nozzle, mask=mask,
        at=at,
        along=along.ravel()[at], across=across.ravel()[at], contrast=contrast,
        specular=rng.uniform(*SPECULAR), blur_px=rng.uniform(*BLUR_PX), noise=rng.uniform(*NOISE),
    )  # fmt: skip


def render(
    segment: PrintedSegment, flow: np.ndarray, temperature: np.ndarray, rng: np.random.Generator
) -> RenderedFrames:
    """Renders n frames of one segment, each with its own flow (n,) in percent and temperature (n,) in degC.
    One of them may be a scalar for all frames."""
    flow, temperature = np.broadcast_arrays(
        np.atleast_1d(np.asarray(flow, float)), np.asarray(temperature, float)
    )
    n = len(flow)
    hot = temperature - 210.0
    spread = IMAGE_SPREAD * (1 + SPREAD_PER_DEGC * hot) * rng.standard_normal(n)
    q = flow / 100
    width = np.maximum(WIDTH_PX * (q + FLAT * (1 - q)) * segment.width_factor * (1 + spread), 0.0)
    line = rng.random(n) >= EMPTY
    gloss, focus = np.exp(0.01 * hot), np.exp(FOCUS * np.clip(rng.standard_normal(n), -2.5, 2.5))
    spare = 64 * SIDE
    noise = np.rint(segment.noise * rng.standard_normal(SIDE * SIDE + spare, dtype=np.float32)).astype(
        np.int16
    )
    frames = np.empty((n, SIDE, SIDE), np.uint8)
    place, level = segment.along.astype(np.intp), float(segment.ground.mean())
    for k in range(n):
        picture = _moved(segment, rng)
        if line[k]:
            _lay(picture, segment, width[k], gloss[k], rng, place=place, level=level)
        cv2.copyTo(segment.nozzle, segment.mask, picture)
        soft = cv2.GaussianBlur(picture, (0, 0), segment.blur_px * focus[k])
        first = int(rng.integers(0, spare))
        frames[k] = cv2.add(soft, noise[first : first + SIDE * SIDE].reshape(SIDE, SIDE), dtype=cv2.CV_8U)
    return RenderedFrames(
        frames,
        flow.copy(),
        temperature.copy(),
        np.where(line, width, 0.0),
        line,
        segment.direction_deg,
        segment.tip,
    )


def key_areas(frames: RenderedFrames, *, least_score: float) -> KeyAreas:
    """Returns the key areas of one segment's frames; the direction is known from G-code."""
    return find_all(frames.frames, frames.tip, least_score=least_score, directions_deg=frames.direction_deg)


def draw_flow(rng: np.random.Generator, n: int) -> np.ndarray:
    """Draws flows (n,) in percent for training and calibration, in random order. One half is log-uniform over
    FLOWS; the other is log-normal around 100 % with deviation BUMP, where the classes' borders are.

    The density is continuous everywhere, also across the borders, so a flow of 111 % is as frequent as one of
    109 %. Both halves are drawn in equal strata, so that even a few flows contain all classes.
    """
    wide, near = _strata(rng, n - n // 2), _strata(rng, n // 2)
    low, high = np.log(FLOWS)
    ends = scipy.special.ndtr((np.log(FLOWS) - np.log(100.0)) / BUMP)
    bump = 100 * np.exp(BUMP * scipy.special.ndtri(ends[0] + (ends[1] - ends[0]) * near))
    return rng.permutation(np.concatenate([np.exp(low + (high - low) * wide), bump]))


def draw_judged_flow(rng: np.random.Generator, n: int) -> np.ndarray:
    """Draws flows (n,) in percent for tests, in random order. One half is uniform over JUDGED, where a
    controller works, the other log-uniform over FLOWS; both are drawn in equal strata."""
    low, high = np.log(FLOWS)
    near = JUDGED[0] + (JUDGED[1] - JUDGED[0]) * _strata(rng, n - n // 2)
    return rng.permutation(np.concatenate([near, np.exp(low + (high - low) * _strata(rng, n // 2))]))


def _strata(rng: np.random.Generator, n: int) -> np.ndarray:
    """Returns one uniform number in each of n equal parts of 0..1 (n,)."""
    return (np.arange(n) + rng.random(n)) / max(n, 1)


def draw_class_flow(rng: np.random.Generator, kind: int, n: int) -> np.ndarray:
    """Draws n flows of a class in percent, uniform between its borders within FLOWS. The paper's data are
    distributed in this way, with a step of the density at each border."""
    ends = (FLOWS[0], *BORDERS, FLOWS[1])
    return rng.uniform(ends[kind], ends[kind + 1], n)


def _slope(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns light from one side: a plane that rises by up to GRADIENT gray levels over the frame."""
    way, rise = rng.uniform(0, 2 * np.pi), rng.uniform(*GRADIENT) / SIDE
    return np.float32(rise * np.cos(way)) * x + np.float32(rise * np.sin(way)) * y


def _older(rng: np.random.Generator, across: np.ndarray) -> np.ndarray:
    """Returns, in 0..1 (350, 350), older beads on one side of the fresh one."""
    side, pitch = rng.choice([-1.0, 1.0]), rng.uniform(*OLDER_PITCH)
    place = np.float32(side) * across / np.float32(pitch)
    rho = 2 * (place - np.maximum(np.rint(place), 1)) * np.float32(pitch / WIDTH_PX)
    return np.sqrt(np.maximum(1 - rho * rho, 0))


def _nozzle(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draws a cone above the tip with a flat end, dark steel to bright brass, lit from one side. Returns the
    picture and its mask."""
    slope, flat = np.float32(np.tan(np.deg2rad(rng.uniform(*HALF_CONE_DEG)))), np.float32(rng.uniform(6, 12))
    inside = (y < 0) & (np.abs(x) < flat - slope * y)
    level, side, band = rng.uniform(25, 75), rng.uniform(-0.4, 0.4), rng.uniform(-60, 60)
    rim = np.clip(-y / 8, 0.3, 1).astype(np.float32)
    across = (level * (1 + side * x / SIDE) + 25 * np.exp(-(((x - band) / 15) ** 2))).astype(np.float32)
    return (rim * across).astype(np.uint8), inside.astype(np.uint8)


def _texture(rng: np.random.Generator) -> np.ndarray:
    """Returns plate texture as int16, larger than the frame by TRAVEL px on every side; it is drawn at half
    size and enlarged."""
    side = SIDE // 2 + TRAVEL
    t = cv2.GaussianBlur(
        rng.standard_normal((side, side), dtype=np.float32), (0, 0), rng.uniform(*GRAIN_PX) / 2
    )
    t *= np.float32(rng.uniform(*TEXTURE) / t.std())
    return np.rint(cv2.resize(t, (2 * side, 2 * side))).astype(np.int16)


@functools.cache
def _grid() -> tuple[np.ndarray, np.ndarray]:
    """Returns x (1, 350) and y (350, 1) relative to the tip in px."""
    place = np.arange(SIDE, dtype=np.float32) - SIDE // 2
    return place[None, :], place[:, None]


def _moved(segment: PrintedSegment, rng: np.random.Generator) -> np.ndarray:
    """Returns the ground with its texture at a new random place along the line."""
    travel, a = rng.uniform(-TRAVEL, TRAVEL), np.deg2rad(segment.direction_deg)
    x, y = round(TRAVEL + travel * np.cos(a)), round(TRAVEL + travel * np.sin(a))
    return cv2.add(segment.ground, segment.texture[y : y + SIDE, x : x + SIDE], dtype=cv2.CV_8U)


def _lay(
    picture: np.ndarray,
    segment: PrintedSegment,
    width: float,
    gloss: float,
    rng: np.random.Generator,
    *,
    place: np.ndarray,
    level: float,
) -> None:
    """Draws the fresh bead. Across it the level falls as 1 - shading rho^2 with rho = 2 t / w; it has a
    specular line at specular_at and rough edges. `place`: segment.along in whole px; `level`: mean gray level
    of the ground."""
    turn, beside, light = (
        np.tan(np.deg2rad(TURN_DEG)) * rng.standard_normal(),
        PLACE_PX * rng.standard_normal(),
        1 + FLICKER * rng.standard_normal(),
    )
    shading, specular_at = rng.uniform(*SHADING), rng.uniform(*SPECULAR_AT)
    rough = cv2.GaussianBlur(rng.standard_normal((1, SIDE), dtype=np.float32), (0, 0), ROUGH_GRAIN_PX)[0]
    rough *= ROUGHNESS / rough.std()
    t = segment.across - np.float32(turn) * segment.along - np.float32(beside)
    half = (np.float32(width / 2) * (1 + rough))[place]
    near = np.flatnonzero(np.abs(t) < half + 0.5)
    t, half, at = t[near], half[near], segment.at[near]
    cover = np.clip(half - np.abs(t) + 0.5, 0, 1)
    rho = np.clip(t / np.maximum(half, 0.5), -1, 1)
    line = segment.specular * gloss * np.exp(-0.5 * ((t - specular_at * half) / SPECULAR_PX) ** 2)
    flat = picture.reshape(-1)
    bead = light * (level + segment.contrast * (1 - shading * rho * rho) + line)
    flat[at] = np.clip(flat[at] * (1 - cover) + bead * cover, 0, 255)
