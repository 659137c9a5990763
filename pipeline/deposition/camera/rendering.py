"""Synthetic frames of a trial: flow and gantry position -> deposited cross-section -> the picture of a camera
beside the nozzle, with everything that misleads an edge detector."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from pipeline.deposition.camera import bead
from pipeline.deposition.camera.bead import area
from pipeline.deposition.camera.flow import View, deposit_share
from pipeline.deposition.camera.line import Mounting
from pipeline.deposition.drive import Drive, obeyed
from pipeline.deposition.extruder import Extruder, Routine, disturb, flow

# frames of each known width, spread over the stage
CALIBRATION_FRAMES = 12
# table of profiles: steps of width and of vertical shift in px; stochastic rounding keeps the mean exact
WIDTH_STEP, SHIFTS = 0.25, 4
# instants a frame at which material leaves the nozzle
INSTANTS = 20


class Scene(NamedTuple):
    """What the camera shows. Levels are gray levels of 0..255, px are pixels, shares are of the bead's
    half-width. A `contrast` below 0 is a dark bead.

    Shading: the bead's level falls as 1 - shading rho^2, rho = 2 y / w across the bead. The specular line
    lies at `specular_at` = rho, `specular_px` wide (one standard deviation), `specular` levels above the
    bead. `blur_px` is the standard deviation of the point spread. Glare is a bump of `glare` levels. The
    texture (standard deviation, grain in px) lies on the stage, moves with it and is covered by the bead;
    noise is new in every frame. The bead's edges deviate by `roughness_px` from their true place, in the same
    way in every frame. `tilt_deg` turns the line, `offset_px` shifts it from the middle.
    """

    height: int
    width: int
    background: float
    contrast: float
    shading: float
    specular: float
    specular_at: float
    specular_px: float
    blur_px: float
    glare: float
    texture: float
    grain_px: float
    noise: float
    roughness_px: float
    tilt_deg: float
    offset_px: float


# the two levels at which figures are stated
NOMINAL = Scene(480, 640, 60.0, 90.0, 0.20, 90.0, -0.30, 2.0, 1.2, 10.0, 2.0, 3.0, 3.0, 0.2, 0.6, 8.0)
HARD = Scene(480, 640, 70.0, 50.0, 0.35, 120.0, 0.55, 2.2, 2.8, 25.0, 5.0, 3.0, 8.0, 0.5, 1.5, 25.0)

SCENES = {"nominal": NOMINAL, "hard": HARD}


class SimulatedCamera:
    """Renders frames of one scene. It keeps its tables and its banks of noise and texture. A frame takes
    about 0.3 ms."""

    def __init__(self, scene: Scene, rng: np.random.Generator):
        self.scene, self.rng = scene, rng
        h, w = scene.height, scene.width
        self.spare = (
            int(
                abs(scene.offset_px)
                + w / 2 * abs(math.tan(math.radians(scene.tilt_deg)))
                + 4 * scene.roughness_px
            )
            + 4
        )
        tables = _tables(scene, h + 2 * self.spare)
        self.bead, self.bare = (
            np.lib.stride_tricks.sliding_window_view(table, h, axis=2) for table in tables
        )
        self.light = _light(scene, rng)
        self.noise = _bank(rng, 4 * h * w, scene.noise)
        self.texture = _texture(rng, 4 * w, h, scene)
        # wander of the middle and of the width, along the stage
        self.wander = scene.roughness_px * np.stack(
            [_grained(rng, 4 * w, 40.0), math.sqrt(2.0) * _grained(rng, 4 * w, 4.0)]
        )
        self.line = (
            h / 2
            - 0.5
            + scene.offset_px
            + math.tan(math.radians(scene.tilt_deg)) * (np.arange(w) - (w - 1) / 2)
        )

    def frame(self, width_px: np.ndarray | float, *, stage_px: int) -> np.ndarray:
        """Returns (h, w) uint8 with a bead width_px (w,) wide, 0 for no bead. The stage, with everything on
        it, has moved by stage_px columns.

        Beads wider than the frame is high are drawn as wide as the frame.
        """
        scene, rng = self.scene, self.rng
        h, w = scene.height, scene.width
        first = stage_px % (3 * w)
        middle, rough = self.wander[:, first : first + w]
        across = np.broadcast_to(width_px, w)
        across = np.where(across > 0, np.maximum(across + rough, 0.0), 0.0) / math.cos(
            math.radians(scene.tilt_deg)
        )
        dither = rng.random((2, w))
        k = np.minimum((across / WIDTH_STEP + dither[0]).astype(int), len(self.bead) - 1)
        start = ((self.spare + (h - 1) / 2 - self.line - middle) * SHIFTS + dither[1]).astype(int)
        picture = self.bare[k, start % SHIFTS, start // SHIFTS]
        picture *= self.texture[first : first + w]
        picture >>= 6
        picture += self.bead[k, start % SHIFTS, start // SHIFTS]
        picture += self.light
        at = int(rng.integers(0, 3 * h * w))
        noisy = cv2.add(picture, self.noise[at : at + h * w].reshape(w, h), dtype=cv2.CV_8U)
        return cv2.transpose(noisy)

    def empty(self, *, stage_px: int) -> np.ndarray:
        """Returns a frame without a bead."""
        return self.frame(0.0, stage_px=stage_px)

    def trial(
        self,
        time_s: np.ndarray,
        flow: np.ndarray,
        position: np.ndarray,
        *,
        view: View,
        frame_rate_hz: float,
        nozzle_mm: tuple[float, float],
        contact_angle_deg: float,
    ) -> Iterator[tuple[float, np.ndarray]]:
        """Yields (time, frame) of a trial, one by one. flow (T,) in mm^3/s and position (T,) in mm are linear
        between samples; nozzle_mm are its inner and outer radius.

        The bead under the nozzle grows from frame to frame: each instant adds Q dt times the footprint to the
        section A(s), and the width is sqrt(A / c).
        """
        c = area(1.0, contact_angle_deg)
        px = abs(view.mm_per_px)
        inner, outer = nozzle_mm
        ends = position[0] + (np.array([0, self.scene.width]) - view.nozzle_column) * view.mm_per_px
        low = min(ends.min(), position.min() - inner) - 4 * px
        high = max(position.max() + inner, ends.max() + np.ptp(position)) + 4 * px
        s = low + px * np.arange(int((high - low) / px))
        A = np.zeros(len(s))
        nozzle = self._nozzle(view, outer / px)
        columns = (np.arange(self.scene.width) - view.nozzle_column) * view.mm_per_px
        # every trial lies on a fresh part of the stage
        fresh, previous = int(self.rng.integers(0, 3 * self.scene.width)), time_s[0]
        for t in time_s[0] + np.arange(int((time_s[-1] - time_s[0]) * frame_rate_hz) + 1) / frame_rate_hz:
            if t > previous:
                _lay(A, s[0], px, *_instants(previous, t, time_s, flow, position), inner)
            x = float(np.interp(t, time_s, position))
            width_px = np.sqrt(np.interp(x + columns, s, A) / c) / px
            frame = self.frame(width_px, stage_px=fresh + round((x - position[0]) / view.mm_per_px))
            frame[nozzle] = 25
            previous = t
            yield float(t), frame

    def _nozzle(self, view: View, radius_px: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns rows and columns that the nozzle's tip hides."""
        y, x = np.ogrid[: self.scene.height, : self.scene.width]
        middle = self.scene.height / 2 - 0.5 + self.scene.offset_px
        return np.nonzero((y - middle) ** 2 + (x - view.nozzle_column) ** 2 < radius_px**2)


def calibrate(
    camera: SimulatedCamera, known_widths_mm: Sequence[float], rng: np.random.Generator, mounting: Mounting
) -> bead.WidthCalibration:
    """Calibrates pixels to mm on pictures of beads of known widths. Raises ValueError if one cannot be
    measured."""
    widths_mm = np.repeat(known_widths_mm, CALIBRATION_FRAMES)
    px, columns, blur_px = abs(mounting.mm_per_px), mounting.columns, mounting.longest_blur_px
    frames = [camera.frame(width / px, stage_px=int(rng.integers(0, 10_000))) for width in widths_mm]
    beads = [bead.measure(frame, columns=columns, longest_blur_px=blur_px) for frame in frames]
    bad = [f"{width:g} mm: {one.reason}" for width, one in zip(widths_mm, beads, strict=True) if one.reason]
    if bad:
        reasons = ", ".join(
            f"{bad.count(what)} of {CALIBRATION_FRAMES} of {what}" for what in dict.fromkeys(bad)
        )
        raise ValueError(
            f"camera: known widths should be seen in every picture but are not ({reasons}); "
            f"fit camera.known_widths_mm to what is seen at {px:g} mm per px, "
            "or raise camera.longest_blur_px"
        )
    return bead.calibrate(np.array([one.width for one in beads]), widths_mm)


def _instants(begin, end, time_s, flow, position) -> tuple[np.ndarray, np.ndarray]:
    """Returns volumes (mm^3) and places (mm) of the instants between two frames."""
    dt = (end - begin) / INSTANTS
    at = begin + dt * (np.arange(INSTANTS) + 0.5)
    return np.interp(at, time_s, flow) * dt, np.interp(at, time_s, position)


def _lay(
    A: np.ndarray, origin: float, px: float, volumes: np.ndarray, places: np.ndarray, inner: float
) -> None:
    """Adds to A the sum of volumes times the footprint at their places, as means over the cells of the
    stage."""
    first = int((places.min() - inner - origin) / px)
    last = int((places.max() + inner - origin) / px) + 2
    faces = origin + px * (np.arange(first, last + 1) - 0.5)
    A[first:last] += volumes @ np.diff(deposit_share(faces - places[:, None], inner), axis=1) / px


def _tables(scene: Scene, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns two tables (widths, shifts, rows) int16 for widths of 0 to the frame's height: the bead's
    profile less background, and 64 times the share of substrate that is still visible.

    The bead's middle is at row (rows - 1) / 2 + shift / SHIFTS. It is drawn on SHIFTS samples per row,
    blurred, then averaged over each pixel.
    """
    widths = np.arange(0.0, scene.height, WIDTH_STEP, dtype=np.float32)
    fine = SHIFTS * (rows + 1)
    y = ((np.arange(fine) + 0.5) / SHIFTS - 0.5 - (rows - 1) / 2).astype(np.float32)
    tables = np.empty((2, len(widths), SHIFTS, rows), np.int16)
    size = 2 * int(4 * scene.blur_px * SHIFTS) + 1
    for i, w in enumerate(widths):
        covered = np.clip((w / 2 - np.abs(y)) * SHIFTS + 0.5, 0.0, 1.0)
        rho = 2 * y / max(w, 1e-3)
        body = scene.contrast * (1 - scene.shading * np.minimum(rho * rho, 1.0))
        line = (
            scene.specular
            * min(1.0, w / 40.0)
            * np.exp(-0.5 * ((y - scene.specular_at * w / 2) / scene.specular_px) ** 2)
        )
        sharp = np.stack([(body + line) * covered, 64 * (1 - covered)])
        soft = cv2.GaussianBlur(sharp, (size, 1), scene.blur_px * SHIFTS, borderType=cv2.BORDER_REPLICATE)
        total = np.cumsum(np.pad(soft, ((0, 0), (1, 0))), axis=1, dtype=float) / SHIFTS
        for shift in range(SHIFTS):
            tables[:, i, shift] = np.rint(np.diff(total[:, shift::SHIFTS], axis=1)[:, :rows])
    return tables[0], tables[1]


def _light(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    """Returns (w, h) int16: background with a glare bump at a random place."""
    h, w = scene.height, scene.width
    x, y = np.ogrid[:w, :h]
    at_x, at_y, spread = rng.uniform(0, w), rng.uniform(0, h), 0.3 * w
    return np.rint(
        scene.background + scene.glare * np.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / (2 * spread**2))
    ).astype(np.int16)


def _bank(rng: np.random.Generator, size: int, deviation: float) -> np.ndarray:
    return np.rint(deviation * rng.standard_normal(size, dtype=np.float32)).astype(np.int16)


def _texture(rng: np.random.Generator, length: int, h: int, scene: Scene) -> np.ndarray:
    """Returns a texture (length, h) int16 of the given grain and deviation."""
    t = cv2.GaussianBlur(rng.standard_normal((length, h), dtype=np.float32), (0, 0), scene.grain_px)
    return np.rint(scene.texture / t.std() * t).astype(np.int16)


def _grained(rng: np.random.Generator, length: int, grain_px: float) -> np.ndarray:
    t = cv2.GaussianBlur(rng.standard_normal((1, length)), (0, 0), grain_px)[0]
    return (t - t.mean()) / t.std()


def simulate_trial(
    plant: Extruder,
    camera: SimulatedCamera,
    routine: Routine,
    u: np.ndarray,
    rng: np.random.Generator,
    *,
    noise: Mapping[str, float],
    drive: Drive,
    sample_time_s: float,
    view: View,
    frame_rate_hz: float,
    nozzle_mm: tuple[float, float],
    contact_angle_deg: float,
) -> tuple[Iterator[tuple[float, np.ndarray]], np.ndarray, np.ndarray]:
    """Runs the command u (T,) in mm. Returns (time, picture) of each frame, the command (T,) as the drive
    applied it, and the true flow (T,) in mm^3/s.

    The camera sees that flow with the disturbances that do not repeat from trial to trial, `noise` by
    `extruder.disturb`; a law is judged by the true flow alone. nozzle_mm are the inner and the outer radius.
    """
    truth = flow(plant, u, sample_time_s=sample_time_s, drive=drive)
    laid = np.maximum(disturb(truth, rng, steady_flow=routine.r.max(), **noise), 0.0)
    pictures = camera.trial(
        routine.time_s, laid, routine.position, view=view, frame_rate_hz=frame_rate_hz,
        nozzle_mm=nozzle_mm, contact_angle_deg=contact_angle_deg,
    )  # fmt: skip
    return pictures, obeyed(u, drive, sample_time_s=sample_time_s), truth
