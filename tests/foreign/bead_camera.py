"""A camera that rides with the nozzle, drawn with numpy and OpenCV alone.

The line on the stage is drawn once, and each frame is one turned and late view of it."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

GROUND, BEAD, GLOSS, NOZZLE = 70.0, 165.0, 50.0, 30
# samples of the flow a sample of the machine, before they are laid on the stage
FINE = 20


class BeadCamera(NamedTuple):
    """The line leaves the tip (px) at angle_deg in the picture (0 right, 90 down). A frame stamped t shows
    the machine at t - latency_s. bore_mm and outer_mm are the nozzle's radii."""

    angle_deg: float = 94.0
    tip: tuple[float, float] = (112.0, 24.0)
    height: int = 320
    width: int = 224
    mm_per_px: float = 0.0125
    latency_s: float = 0.04
    blur_px: float = 1.2
    noise: float = 3.0
    bore_mm: float = 0.4
    outer_mm: float = 0.6

    def frames(
        self, time_s: np.ndarray, flow: np.ndarray, x_mm: np.ndarray, *, hz: float, rng: np.random.Generator
    ) -> Iterator[tuple[float, np.ndarray]]:
        """(time, (height, width) uint8) of a print: flow (T,) mm^3/s laid at gantry positions x_mm (T,)."""
        first_mm, width_mm = self.line(time_s, flow, x_mm)
        bare, printed = self._stage(width_mm, rng)
        middle = bare.shape[0] / 2
        a = math.radians(self.angle_deg)
        along, across = (math.cos(a), math.sin(a)), (-math.sin(a), math.cos(a))
        tip, size = np.array(self.tip), (self.width, self.height)
        for t in np.arange(time_s[0], time_s[-1], 1 / hz):
            nozzle = (float(np.interp(t - self.latency_s, time_s, x_mm)) - first_mm) / self.mm_per_px
            laid = min(max(int(nozzle), 0), bare.shape[1])
            stage = np.hstack([printed[:, :laid], bare[:, laid:]])
            # picture p -> stage (nozzle - along . (p - tip), middle + across . (p - tip))
            view = np.array([
                [-along[0], -along[1], nozzle + np.dot(along, tip)],
                [across[0], across[1], middle - np.dot(across, tip)],
            ])  # fmt: skip
            picture = cv2.warpAffine(
                stage, view, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )  # fmt: skip
            picture = picture + rng.normal(0, self.noise, picture.shape)
            picture = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
            hidden = round(self.outer_mm / self.mm_per_px)
            cv2.circle(picture, (round(tip[0]), round(tip[1])), hidden, NOZZLE, -1, cv2.LINE_AA)
            yield float(t), picture

    def line(self, time_s: np.ndarray, flow: np.ndarray, x_mm: np.ndarray) -> tuple[float, np.ndarray]:
        """Where the line begins, mm, and its width in mm, one place a pixel: what leaves the round bore is
        laid along its chords, and a bead is half a circle, area = pi width^2 / 8."""
        px = self.mm_per_px
        t = np.linspace(time_s[0], time_s[-1], FINE * (len(time_s) - 1) + 1)
        volume = np.interp(t, time_s, flow) * (t[1] - t[0])
        first = float(x_mm.min()) - 6.0
        places = np.arange(first, float(x_mm.max()) + 6.0, px)
        edges = np.append(places - px / 2, places[-1] + px / 2)
        laid = np.histogram(np.interp(t, time_s, x_mm), edges, weights=volume)[0]
        reach = round(self.bore_mm / px)
        chord = np.sqrt(1 - (np.arange(-reach, reach + 1) / (reach + 0.5)) ** 2)
        area = np.convolve(laid, chord / chord.sum(), "same") / px
        return first, np.sqrt(8 * area / math.pi)

    def _stage(self, width_mm: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The bare stage and the stage with the line, uint8, one column a place of the line."""
        rows = 2 * (self.height + self.width)
        specks = cv2.GaussianBlur(rng.standard_normal((rows, len(width_mm)), dtype=np.float32), (0, 0), 2.5)
        bare = GROUND + 2 * specks / specks.std()
        half = width_mm / self.mm_per_px / 2
        v = np.arange(rows)[:, None] - rows / 2
        inside = np.clip(half - np.abs(v) + 0.5, 0, 1) * (half > 1)
        body = BEAD * (0.86 + 0.14 * np.sqrt(np.maximum(1 - (v / np.maximum(half, 1)) ** 2, 0)))
        gloss = GLOSS * np.exp(-0.5 * ((v - 0.3 * half) / 2.5) ** 2)
        printed = bare * (1 - inside) + (body + gloss) * inside
        views = (cv2.GaussianBlur(view.astype(np.float32), (0, 0), self.blur_px) for view in (bare, printed))
        bare, printed = (np.clip(np.rint(view), 0, 255).astype(np.uint8) for view in views)
        return bare, printed
