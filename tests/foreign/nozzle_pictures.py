"""Pictures of a nozzle camera that shares no code with pipeline/setpoint/frames/nozzle_scene.py: a colour
camera looks at a metal nozzle, its fresh bead drawn as shaded pieces that wobble, and a ground of older
lines.

A folder of them with its CSV is what an owner has, in the columns of the public CAXTON data.
"""

import csv
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

HEIGHT, WIDTH = 360, 480
# of a bead at 100 % of flow
HALF_WIDTH_PX = 11.0


class Camera(NamedTuple):
    """One printer with its camera: the tip in px, where the bead trails to, colours as BGR, light from one
    side, blur in px, noise in gray levels."""

    tip: tuple[float, float]
    angle_deg: float
    bead: tuple[float, float, float]
    ground: tuple[float, float, float]
    light: float
    blur_px: float
    noise: float


def draw_camera(rng: np.random.Generator) -> Camera:
    shade = rng.uniform(0.75, 1.0)
    return Camera(
        (float(rng.uniform(190, 230)), float(rng.uniform(150, 180))), float(rng.uniform(-25, 25)),
        (60 * shade, 170 * shade, 235 * shade), (70.0, 78.0, 84.0),
        float(rng.uniform(-0.4, 0.4)), float(rng.uniform(0.8, 1.4)), float(rng.uniform(3, 6)),
    )  # fmt: skip


def film(camera: Camera, flow_percent: float, frames: int, rng: np.random.Generator) -> list[np.ndarray]:
    """(HEIGHT, WIDTH, 3) uint8 pictures while the bead is laid at one flow; its width follows the flow by the
    power 0.8, and wobbles along the bead."""
    half = HALF_WIDTH_PX * (flow_percent / 100) ** 0.8
    phase, spread = rng.uniform(0, 2 * math.pi, 3), 0.03 * half
    axes = _axes(camera)
    ground = _ground(camera, *axes, rng)
    return [_frame(camera, half, ground, axes, phase, spread, k, rng) for k in range(frames)]


def _axes(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Of every pixel, how far it lies along the bead behind the tip, and across it, px."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    a = math.radians(camera.angle_deg)
    dx, dy = x - camera.tip[0], y - camera.tip[1]
    return dx * math.cos(a) + dy * math.sin(a), dy * math.cos(a) - dx * math.sin(a)


def _ground(camera: Camera, along: np.ndarray, across: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Older lines side by side, each of a gray of its own, with grain."""
    lines = rng.normal(0, 9, 64)
    number = np.floor(across / 26 + 32).astype(int).clip(0, 63)
    gloss = 10 * np.cos(2 * math.pi * across / 26)
    grain = cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH)).astype(np.float32), (0, 0), 1.5)
    lit = 14 * camera.light * along / WIDTH
    return np.array(camera.ground, np.float32) + (lines[number] + gloss + 12 * grain + lit)[..., None]


def _frame(
    camera: Camera, half: float, ground: np.ndarray,
    axes: tuple[np.ndarray, np.ndarray], phase: np.ndarray, spread: float, k: int,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    along, across = axes
    # what is laid moves away from the tip, frame by frame
    place = along + 23.0 * k
    wobble = sum(np.sin(place / length + p) for length, p in zip((19.0, 41.0, 87.0), phase, strict=True))
    edge = half + spread * wobble
    picture = np.roll(ground, (0, 7 * k % WIDTH), (0, 1)).copy()
    body = np.sqrt(np.clip(1 - (across / edge) ** 2, 0, 1))
    bead = (
        np.array(camera.bead, np.float32)
        * (0.55 + 0.45 * body + 0.2 * camera.light * across / edge)[..., None]
    )
    inside = (np.clip(edge - np.abs(across), 0, 1) * np.clip(along, 0, 1))[..., None]
    picture = picture * (1 - inside) + bead * inside
    tip = np.array(camera.tip)
    cone = np.array([tip + (-14, 2), tip + (14, 2), tip + (62, -150), tip + (-62, -150)])
    cv2.fillConvexPoly(picture, np.rint(cone).astype(np.int32), (150, 160, 165), cv2.LINE_AA)
    flank = np.array([tip + (2, 0), tip + (12, 0), tip + (52, -150), tip + (20, -150)])
    cv2.fillConvexPoly(picture, np.rint(flank).astype(np.int32), (205, 212, 215), cv2.LINE_AA)
    picture = cv2.GaussianBlur(picture, (0, 0), camera.blur_px)
    picture += camera.noise * rng.standard_normal(picture.shape).astype(np.float32)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def write_frames(
    folder: Path, pictures: Sequence[np.ndarray], *, first: int = 0, period_s: float = 0.05
) -> None:
    """JPEG files, each of the time at which it was taken."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, picture in enumerate(pictures, first):
        path = folder / f"image-{k}.jpg"
        cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 92])
        os.utime(path, ns=(int(1.7e18 + k * period_s * 1e9),) * 2)


def write_prints(
    folder: Path, prints: int, flows_percent: Sequence[float], frames: int, rng: np.random.Generator
) -> Path:
    """A folder of prints of one printer, `frames` pictures at each flow, and the CSV beside them; each print
    has its own light and colour."""
    camera, rows = draw_camera(rng), []
    for print_id in range(prints):
        lit = draw_camera(rng)._replace(tip=camera.tip, angle_deg=camera.angle_deg)
        for step, flow in enumerate(flows_percent):
            write_frames(folder / f"print{print_id}", film(lit, flow, frames, rng), first=step * frames)
            for shot in range(frames):
                number = step * frames + shot
                seconds, milliseconds = divmod(50 * number, 1000)
                rows.append({
                    "img_path": f"print{print_id}/image-{number}.jpg",
                    "timestamp": f"2021-03-05T10:{seconds // 60:02d}:{seconds % 60:02d}-{milliseconds:03d}",
                    "flow_rate": f"{flow:g}", "feed_rate": "100", "z_offset": "0.0",
                    "target_hotend": "210.0", "hotend": "210.0", "bed": "60.0",
                    "nozzle_tip_x": f"{camera.tip[0]:.1f}", "nozzle_tip_y": f"{camera.tip[1]:.1f}",
                    "print_id": str(print_id), "img_num": str(number),
                })  # fmt: skip
    with (folder / "log.csv").open("w", newline="") as stream:
        table = csv.DictWriter(stream, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return folder
