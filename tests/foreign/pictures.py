"""Pictures of machines that no classifier here learned from, as windows of four frames: real frames of
caxton_samples (four printers) and fast_caxton_frames (two cameras) in BEADLINE_SHARED, and rendered frames
that are changed."""

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from pipeline.setpoint.frames import familiar, key_area, nozzle_scene

DATA = Path(__file__).parents[2] / os.environ.get("BEADLINE_SHARED", "../shared") / "data"
LEAST = 10.0
TIPS = {
    "0021": (614, 550), "0022": (637, 551), "1011": (571, 511), "1111": (450, 515),
    "1221": (453, 518), "2011": (434, 514), "2120": (581, 497), "2122": (573, 518),
}  # fmt: skip


def windows_of(frames: np.ndarray, tip: tuple[float, float], **direction: float) -> np.ndarray:
    areas = key_area.find_all(frames, np.array(tip), least_score=LEAST, **direction)
    return familiar.of_window(frames, np.array(tip), areas)


def drawn(seed: int, segments: int, change: Callable | None = None) -> np.ndarray:
    """(segments, f) windows of as many new segments, their frames changed."""
    rows = []
    for i in range(segments):
        rng = np.random.default_rng([seed, i])
        flow = np.full(familiar.FRAMES + 1, np.exp(rng.uniform(*np.log(nozzle_scene.FLOWS))))
        scene = nozzle_scene.render(
            nozzle_scene.draw_segment(rng), flow, rng.choice(nozzle_scene.TEMPERATURES), rng
        )
        frames = scene.frames if change is None else np.stack([change(f) for f in scene.frames])
        rows.append(windows_of(frames, scene.tip, directions_deg=scene.direction_deg))
    rows = np.array(rows)
    return rows[np.isfinite(rows).all(axis=1)]


def _scaled(frame: np.ndarray, by: float) -> np.ndarray:
    middle = (frame.shape[1] / 2, frame.shape[0] / 2)
    return cv2.warpAffine(
        frame, cv2.getRotationMatrix2D(middle, 0, by), frame.shape[::-1], borderMode=cv2.BORDER_REFLECT
    )


def _mapped(frame: np.ndarray, colours: int) -> np.ndarray:
    return cv2.cvtColor(cv2.applyColorMap(frame, colours), cv2.COLOR_BGR2GRAY)


def _jpeg(frame: np.ndarray, quality: int) -> np.ndarray:
    return cv2.imdecode(
        cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE
    )


CHANGES: dict[str, Callable] = {
    "twice as large": lambda f: _scaled(f, 2.0),
    "half as large": lambda f: _scaled(f, 0.5),
    "upside down": lambda f: f[::-1, ::-1],
    "inverted": lambda f: 255 - f,
    "gamma 0.5": lambda f: (255 * (f / 255) ** 0.5).astype(np.uint8),
    "gamma 2": lambda f: (255 * (f / 255) ** 2.0).astype(np.uint8),
    "JPEG of quality 30": lambda f: _jpeg(f, 30),
    "JPEG of quality 75": lambda f: _jpeg(f, 75),
    "colours of jet": lambda f: _mapped(f, cv2.COLORMAP_JET),
    "colours of hot": lambda f: _mapped(f, cv2.COLORMAP_HOT),
    "equalised": cv2.equalizeHist,
    "blurred by 2 px": lambda f: cv2.GaussianBlur(f, (0, 0), 2.0),
    "without noise": lambda f: cv2.medianBlur(f, 5),
}


def video() -> np.ndarray:
    """(n, h, w) the frames of the nozzle video, in gray."""
    reader, frames = cv2.VideoCapture(str(DATA / "fast_caxton_frames/nozzle_video.gif")), []
    while (read := reader.read())[0]:
        frames.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY))
    return np.stack(frames)


def machines() -> dict[str, np.ndarray]:
    """{machine: windows (n, f)} of real pictures: four frames each of films, single frames else."""
    films = {
        "nozzle video": (video(), (301, 190)),
        "stills": (
            [cv2.imread(str(p), 0) for p in sorted((DATA / "fast_caxton_frames/imgs").glob("*.jpg"))],
            (134, 120),
        ),
    }
    out = {
        name: np.array([windows_of(frames[i : i + 4], tip) for i in range(0, len(frames) - 3, 4)])
        for name, (frames, tip) in films.items()
    }
    for name, tip in TIPS.items():
        frame = cv2.imread(str(DATA / f"caxton_samples/full/sample{name}.jpg"), 0)
        at = key_area.find(frame, tip, least_score=0.0)
        out[f"caxton {name}"] = familiar.surroundings(
            key_area.crop(frame, tip).gray, at.angle_deg, at.miss_px
        )[None]
    return {name: rows[np.isfinite(rows).all(axis=1)] for name, rows in out.items()}
