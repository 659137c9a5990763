"""How the pictures of a trial are turned before they are measured: as the camera's calibration says, or as
the line in the pictures themselves shows."""

from collections.abc import Callable, Collection, Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from pipeline.deposition.camera import line
from pipeline.deposition.camera.latency import Gantry

# the line's place is found in so many frames without and with a bead
SAMPLE = 12
# a line this near to the rows is measured as it lies
LEVEL_DEG = 4.0


class Mounting(NamedTuple):
    """How a camera hangs: the size of a pixel in mm, negative if the line trails to higher columns; the
    nozzle's column and the columns that are measured; `sign` 1 for a bead brighter than its ground, -1 for a
    darker one, 0 if nobody said; the direction of the line and the tip (x, y) in px, None if unknown; the
    polygon that the nozzle hides; and pairs in px: a width, and by how much wider it looks."""

    mm_per_px: float
    nozzle_column: float
    columns: tuple[int, int]
    longest_blur_px: float
    sign: int
    rotation_deg: float | None
    tip_px: tuple[float, float] | None
    mask_px: Sequence[Sequence[float]]
    edge_bias: Sequence[tuple[float, float]]

    def true_px(self, measured_px: np.ndarray) -> np.ndarray:
        """Widths in px without the edge bias, straight between the known widths; as measured if calibration
        found none."""
        if not self.edge_bias:
            return measured_px
        known_px, bias_px = np.array(self.edge_bias).T
        return measured_px - np.interp(measured_px, known_px + bias_px, bias_px)

    @property
    def hidden_px(self) -> float:
        """So much of the line from the tip on is hidden, px: measured columns begin there."""
        return max(abs(self.columns[0] - self.nozzle_column), 0.0)


def pose(
    mounting: Mounting,
    time_s: np.ndarray,
    gantry: Gantry,
    frames: Callable[[Collection[int]], Iterable[tuple[int, np.ndarray]]],
) -> line.Pose | None:
    """How pictures taken at time_s (F,) are turned: as the mounting says, else as the frames with a bead,
    less those without, show it. `frames` gives (number, picture) for some numbers. None: they are measured as
    they lie."""
    if mounting.rotation_deg is not None and not mounting.rotation_deg and mounting.tip_px is None:
        return None
    shape, picture = bead_alone(time_s, gantry, frames)
    if picture is None:
        return None
    if mounting.rotation_deg is not None:
        return placed(mounting, shape, mounting.rotation_deg, None)
    found = line.find(
        picture, tip=mounting.tip_px, hidden_px=mounting.hidden_px, mask=mask(mounting, shape),
        sign=mounting.sign,
    )  # fmt: skip
    if found is not None:
        return pose_of_line(mounting, shape, found)
    return None if mounting.tip_px is None else placed(mounting, shape, 0.0, None)


def pose_of_line(mounting: Mounting, shape: tuple[int, int], found: line.ImageLine) -> line.Pose | None:
    """The pose for a line found in pictures of this shape (rows, columns)."""
    if mounting.tip_px is not None:
        # the line comes out of the tip and trails to the side that mm_per_px says
        return placed(mounting, shape, found.angle_deg + (180 if mounting.mm_per_px > 0 else 0), found)
    angle = (found.angle_deg + 90) % 180 - 90
    return None if abs(angle) < LEVEL_DEG else placed(mounting, shape, angle, found)


def placed(
    mounting: Mounting, shape: tuple[int, int], angle_deg: float, found: line.ImageLine | None
) -> line.Pose:
    """The tip comes to lie at the nozzle's column, without a tip the picture's middle stays where it is; the
    line in the middle row. As many rows as the frame has on both sides of the line over the measured
    columns."""
    h, w = shape
    column = (w - 1) / 2
    x, y = (w - 1) / 2, (h - 1) / 2
    if mounting.tip_px is not None:
        (x, y), column = mounting.tip_px, mounting.nozzle_column
    elif found is not None:
        x, y = line.foot(found, x, y)
    start = line.Pose(angle_deg % 360, x, y, column, 0.0, h, mounting.columns[1])
    return line.with_room(start, shape, mounting.columns)


def mask(mounting: Mounting, shape: tuple[int, int]) -> np.ndarray | None:
    """(h, w) bool: the polygon of the picture that the nozzle hides; None if there is none."""
    if len(mounting.mask_px) < 3:
        return None
    hidden = np.zeros(shape, np.uint8)
    cv2.fillPoly(hidden, [np.rint(np.array(mounting.mask_px)).astype(np.int32)], 1)
    return hidden.astype(bool)


def bead_alone(
    time_s: np.ndarray, gantry: Gantry, frames: Callable[[Collection[int]], Iterable[tuple[int, np.ndarray]]]
) -> tuple[tuple[int, int], np.ndarray | None]:
    """Shape of the frames, and the mean of some of them in which the gantry moves along, less that of some
    before it moved, about the middle level: nozzle, light and what else rides with the camera are gone."""
    x = np.interp(time_s, *gantry)
    travelled = np.abs(x - x[0]) / max(float(np.ptp(x)), 1e-9)
    before, along = np.flatnonzero(travelled < 1e-3), np.flatnonzero((travelled > 0.2) & (travelled < 0.95))
    kinds = {}
    for kind, numbers in (("before", before), ("along", along)):
        sample = numbers[np.linspace(0, len(numbers) - 1, min(SAMPLE, len(numbers))).astype(int)]
        kinds |= dict.fromkeys(sample.tolist(), kind)
    pictures: dict[str, list[np.ndarray]] = {"before": [], "along": []}
    shape = (0, 0)
    for number, frame in frames(kinds):
        shape = (int(frame.shape[0]), int(frame.shape[1]))
        pictures[kinds[number]].append(frame.astype(np.float32) * (255 / np.iinfo(frame.dtype).max))
    if not pictures["along"]:
        return shape, None
    mean = np.mean(pictures["along"], axis=0)
    if pictures["before"]:
        mean = 128 + (mean - np.mean(pictures["before"], axis=0)) / 2
    return shape, np.clip(np.rint(mean), 0, 255).astype(np.uint8)
