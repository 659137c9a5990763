"""A camera beside the nozzle that shares no code with pipeline/deposition/camera/rendering.py: a printed
stage, drawn once, of which each frame is one affine view, turned, mirrored and late as the camera is.

Beads are dark or light, with a specular line and a shadow at one edge that makes them look wider; the ground
is plain, striped, grained, or lit from one side.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

GROUNDS = ("plain", "striped", "noisy", "gradient")
# radius of what the nozzle hides, mm, and of its bore
OUTER_MM, BORE_MM = 0.6, 0.4


class Eye(NamedTuple):
    """angle_deg: in which direction of the picture the line trails from the tip (0 right, 90 down); tip in px
    of the picture; jpeg: quality of the frames, 0 for none; edge_bias_px: by how much a bead looks wider than
    it is, `widening` more for each mm that it is wider than 0.9; a frame stamped t shows the machine at
    t - latency_s. All stands out from the ground by `contrast` of what it would; another line lies beside_mm
    beside this one all along, 0 for none; the right of the picture is larger than the left by the share
    2 askew, as a camera sees it that is not square to the stage."""

    angle_deg: float = 0.0
    mirrored: bool = False
    dark: bool = False
    ground: str = "plain"
    edge_bias_px: float = 0.0
    widening: float = 0.0
    latency_s: float = 0.0
    height: int = 480
    width: int = 640
    mm_per_px: float = 0.008
    tip: tuple[float, float] | None = None
    blur_px: float = 1.3
    noise: float = 3.0
    specular: float = 60.0
    jpeg: int = 0
    contrast: float = 1.0
    beside_mm: float = 0.0
    askew: float = 0.0


def tip_of(eye: Eye) -> tuple[float, float]:
    """The tip in px: as given, or 0.4 of the picture away from its middle, against the line's direction."""
    if eye.tip is not None:
        return eye.tip
    a = math.radians(eye.angle_deg)
    reach = 0.4 * min(eye.width / max(abs(math.cos(a)), 1e-9), eye.height / max(abs(math.sin(a)), 1e-9))
    return (eye.width / 2 - reach * math.cos(a), eye.height / 2 - reach * math.sin(a))


class Stage:
    """A printed line on its ground, `width_mm` (n,) at places one pixel apart from `first_mm` on."""

    def __init__(self, eye: Eye, width_mm: np.ndarray, first_mm: float, rng: np.random.Generator):
        self.eye, self.first, self.rng = eye, first_mm, rng
        self.spare = math.ceil(math.hypot(eye.height, eye.width)) + 8
        rows, n = 2 * self.spare, len(width_mm)
        self.bare = _ground(eye, rows, n + 2 * self.spare, rng)
        if eye.beside_mm:
            beside = _bead(eye, self.bare, np.full(self.bare.shape[1], 0.88 / eye.mm_per_px), rng)
            self.bare = np.roll(beside, round(eye.beside_mm / eye.mm_per_px), axis=0)
        wide = np.pad(width_mm, self.spare, mode="edge") / eye.mm_per_px
        self.printed = _bead(eye, self.bare, wide, rng)
        sizes = [cv2.GaussianBlur(part, (0, 0), eye.blur_px) for part in (self.bare, self.printed)]
        sizes = [_levels(eye)[0] + eye.contrast * (part - _levels(eye)[0]) for part in sizes]
        self.bare, self.printed = (np.clip(np.rint(part), 0, 255).astype(np.uint8) for part in sizes)
        self.bank = np.rint(rng.normal(0, eye.noise, 4 * eye.height * eye.width)).astype(np.int16)
        self.light = _light(eye)
        self.laid, self.shown = 0, self.bare.copy()

    def frame(self, x_mm: float, *, all_printed: bool = False) -> np.ndarray:
        """(h, w) uint8 with the nozzle at x_mm; what lies ahead of it is bare, unless all is printed."""
        eye = self.eye
        column = (x_mm - self.first) / eye.mm_per_px + self.spare
        until = self.shown.shape[1] if all_printed else min(max(int(column), 0), self.shown.shape[1])
        if until > self.laid:
            self.shown[:, self.laid : until] = self.printed[:, self.laid : until]
            self.laid = until
        a, (tx, ty) = math.radians(eye.angle_deg), tip_of(eye)
        along, across = np.array([math.cos(a), math.sin(a)]), np.array([-math.sin(a), math.cos(a)])
        across = -across if eye.mirrored else across
        # picture (x, y) -> stage (column - along . p, middle + across . p), p from the tip
        M = np.array([
            [-along[0], -along[1], column + along @ (tx, ty)],
            [across[0], across[1], self.spare - across @ (tx, ty)],
        ])  # fmt: skip
        picture = cv2.warpAffine(
            self.shown, M, (eye.width, eye.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        at = int(self.rng.integers(0, 3 * eye.height * eye.width))
        picture = cv2.add(picture, self.light, dtype=cv2.CV_16S)
        picture = cv2.add(picture, self.bank[at : at + picture.size].reshape(picture.shape), dtype=cv2.CV_8U)
        cv2.circle(picture, (round(tx), round(ty)), round(OUTER_MM / eye.mm_per_px), 35, -1, cv2.LINE_AA)
        if eye.askew:
            h, w, up = eye.height, eye.width, eye.height * eye.askew / 2
            corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
            apart = corners + np.array([[0, up], [0, -up], [0, up], [0, -up]], np.float32)
            M = cv2.getPerspectiveTransform(corners, apart)
            picture = cv2.warpPerspective(picture, M, (w, h), borderMode=cv2.BORDER_REPLICATE)
        if not eye.jpeg:
            return picture
        ok, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, eye.jpeg])
        assert ok
        return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


def trial(
    eye: Eye, time_s: np.ndarray, flow: np.ndarray, x_mm: np.ndarray, rng: np.random.Generator, *, hz: float,
    contact_angle_deg: float,
) -> Iterator[tuple[float, np.ndarray]]:  # fmt: skip
    """(time, frame) of a trial: flow (T,) mm^3/s laid at gantry positions x_mm (T,)."""
    first, width = printed(eye, time_s, flow, x_mm, contact_angle_deg)
    stage = Stage(eye, width, first, rng)
    for t in np.arange(int((time_s[-1] - time_s[0]) * hz) + 1) / hz:
        yield float(time_s[0] + t), stage.frame(float(np.interp(time_s[0] + t - eye.latency_s, time_s, x_mm)))


def printed(
    eye: Eye, time_s: np.ndarray, flow: np.ndarray, x_mm: np.ndarray, contact_angle_deg: float
) -> tuple[float, np.ndarray]:
    """The first place, mm, and the width in mm of the line from there on, one place a pixel."""
    px, fine = eye.mm_per_px, 20
    t = np.linspace(time_s[0], time_s[-1], fine * (len(time_s) - 1) + 1)
    volume = np.interp(t, time_s, np.maximum(flow, 0.0)) * (t[1] - t[0])
    first = float(x_mm.min()) - 2.0
    cells = int((x_mm.max() + 2.0 - first) / px) + 1
    where = (np.interp(t, time_s, x_mm) - first) / px
    low = np.floor(where).astype(int)
    laid = np.bincount(low, volume * (1 - (where - low)), cells + 1)
    laid += np.bincount(low + 1, volume * (where - low), cells + 2)[: cells + 1]
    z = np.arange(-round(BORE_MM / px), round(BORE_MM / px) + 1) * px / BORE_MM
    chord = np.sqrt(np.maximum(1 - z * z, 0))
    area = np.convolve(laid, chord / chord.sum(), "same") / px
    theta = math.radians(contact_angle_deg)
    round_share = (theta - math.sin(theta) * math.cos(theta)) / (4 * math.sin(theta) ** 2)
    return first, np.sqrt(area / round_share)


def _levels(eye: Eye) -> tuple[float, float]:
    return (165.0, 75.0) if eye.dark else (70.0, 165.0)


def _ground(eye: Eye, rows: int, columns: int, rng: np.random.Generator) -> np.ndarray:
    ground = np.full((rows, columns), _levels(eye)[0], np.float32)
    if eye.ground == "striped":
        v, u = np.mgrid[:rows, :columns].astype(np.float32)
        ground += 16 * np.sin((u * math.cos(0.6) + v * math.sin(0.6)) * 2 * math.pi / 27)
    if eye.ground == "noisy":
        grain = cv2.GaussianBlur(rng.standard_normal((rows, columns), dtype=np.float32), (0, 0), 1.6)
        ground += 12 * grain / grain.std()
    if eye.ground != "striped":  # no stage is without any speck
        speck = cv2.GaussianBlur(rng.standard_normal((rows, columns), dtype=np.float32), (0, 0), 2.5)
        ground += 1.5 * speck / speck.std()
    return ground


def _bead(eye: Eye, bare: np.ndarray, wide: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The ground with the bead upon it: `wide` (columns,) in px, 0 where there is none."""
    level = _levels(eye)[1]
    bias = eye.edge_bias_px + eye.widening * (wide * eye.mm_per_px - 0.9)
    rough = cv2.GaussianBlur(rng.standard_normal((2, len(wide))), (0, 0), sigmaX=9, sigmaY=1e-6)
    rough *= 0.25 / rough.std()
    v = np.arange(bare.shape[0])[:, None] - bare.shape[0] / 2
    half = wide / 2
    up, down = v + half + rough[0], half + rough[1] - v
    # the shadow widens one edge
    inside = np.clip(np.minimum(up, down + bias) + 0.5, 0, 1) * (wide > 2)
    rho = v / np.maximum(half, 1)
    body = level * (0.86 + 0.14 * np.sqrt(np.maximum(1 - rho**2, 0)))
    gloss = eye.specular * np.exp(-0.5 * ((rho - 0.35) * half / 2.4) ** 2)
    return (bare * (1 - inside) + (body + gloss) * inside).astype(np.float32)


def _light(eye: Eye) -> np.ndarray:
    y, x = np.mgrid[: eye.height, : eye.width]
    if eye.ground != "gradient":
        return np.zeros((eye.height, eye.width), np.int16)
    fall = 0.7 * (x / eye.width - 0.5) + 0.7 * (y / eye.height - 0.5)
    middle = np.hypot(x / eye.width - 0.5, y / eye.height - 0.5)
    return np.rint(55 * fall - 25 * middle**2).astype(np.int16)
