"""The drive of the plunger: how far and how fast a command may go, and what the drive does with one that
asks for more."""

import math
from typing import Literal, NamedTuple

import numpy as np

# of a limit: a command this near to it counts as at it, one this far beyond it as beyond
NEAR, BEYOND = 0.999, 1 + 1e-9


# what a machine answers to: a pressure, given as a place whose standing still presses on; the speed of what
# it pushes; or the place of it. The last two conserve volume
CommandKind = Literal["pressure", "speed", "place"]


class Drive(NamedTuple):
    """The largest |command| in mm, the largest |speed| of it in mm/s, and the backlash between drive and
    plunger in mm, its full width."""

    amplitude_mm: float
    speed_mm_per_s: float
    backlash_mm: float


UNLIMITED = Drive(math.inf, math.inf, 0.0)


def place(v: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """The place (T,) in mm, from 0 and linear between samples, of the speed v (T,) in mm/s held between
    them."""
    return np.append(0.0, np.cumsum(v[:-1])) * sample_time_s


def speed(place_mm: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """The speed (T,) in mm/s whose `place` is place_mm (T,), whatever it begins at; the last one is 0."""
    return np.diff(place_mm, append=place_mm[-1]) / sample_time_s


def sent(u: np.ndarray, kind: CommandKind, *, sample_time_s: float) -> np.ndarray:
    """What is sent to a machine of `kind` for the command u (T,) of laws and composers, which is a speed in
    mm/s where volume is conserved: its place in mm, or u itself."""
    return place(u, sample_time_s=sample_time_s) if kind == "place" else u


def command(recorded: np.ndarray, kind: CommandKind, *, sample_time_s: float) -> np.ndarray:
    """The command u (T,) of laws and composers of what was sent; `sent` undone."""
    return speed(recorded, sample_time_s=sample_time_s) if kind == "place" else recorded


def demand(u: np.ndarray, *, sample_time_s: float) -> tuple[float, float]:
    """What a command u (..., T) in mm, held between samples, needs of a drive: its largest |u| in mm and its
    largest |du/dt| in mm/s, from rest at 0."""
    if u.size == 0:
        return 0.0, 0.0
    return float(np.abs(u).max()), float(np.abs(_moves(u)).max()) / sample_time_s


def follows(u: np.ndarray, drive: Drive, *, sample_time_s: float) -> bool:
    """Whether the drive can do the command u (..., T) in mm as it stands; rounding is not beyond it."""
    command_mm, speed = demand(u, sample_time_s=sample_time_s)
    return command_mm <= BEYOND * drive.amplitude_mm and speed <= BEYOND * drive.speed_mm_per_s


def obeyed(u: np.ndarray, drive: Drive, *, sample_time_s: float) -> np.ndarray:
    """What the drive does with the command u (..., T) in mm: cut at +-amplitude, and after it from rest at 0
    as fast as it goes. The backlash lies behind it."""
    cut, step = np.clip(u, -drive.amplitude_mm, drive.amplitude_mm), drive.speed_mm_per_s * sample_time_s
    if cut.size == 0 or np.abs(_moves(cut)).max() <= BEYOND * step:
        return cut
    return np.stack([_slewed(row, step) for row in cut.reshape(-1, cut.shape[-1])]).reshape(cut.shape)


def at_limit(u: np.ndarray, drive: Drive, *, sample_time_s: float) -> np.ndarray:
    """Whether each sample of the command u (..., T) in mm is at the amplitude or at the speed of the
    drive."""
    step = drive.speed_mm_per_s * sample_time_s
    return (np.abs(u) >= NEAR * drive.amplitude_mm) | (np.abs(_moves(u)) >= NEAR * step)


def _moves(u: np.ndarray) -> np.ndarray:
    """u(t) - u(t-1) (..., T), from rest at 0."""
    return np.diff(u, axis=-1, prepend=0.0)


def _slewed(u: np.ndarray, step: float) -> np.ndarray:
    """u (T,) followed from 0 by at most `step` a sample."""
    at, out = 0.0, []
    for value in u.tolist():
        at = value if abs(value - at) <= step else at + math.copysign(step, value - at)
        out.append(at)
    return np.array(out)
