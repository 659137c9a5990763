"""The drive of the plunger: how far and how fast a command may go, and what the drive does with a command
beyond these limits."""

import math
from typing import Literal, NamedTuple

import numpy as np

# a command above the first share of a limit counts as at it, above the second as beyond it
NEAR, BEYOND = 0.999, 1 + 1e-9


# the quantity that a machine responds to: a pressure, given as a place that presses on even when it stands
# still; the speed of what the machine pushes; or its place. The last two conserve volume
CommandKind = Literal["pressure", "speed", "place"]


class Drive(NamedTuple):
    """The largest |command| in mm, the largest |speed| of it in mm/s, and the full width of the backlash
    between drive and plunger in mm."""

    amplitude_mm: float
    speed_mm_per_s: float
    backlash_mm: float


UNLIMITED = Drive(math.inf, math.inf, 0.0)


def place(v: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """Returns the place (T,) in mm, from 0 and linear between samples, for the speed v (T,) in mm/s, constant
    between samples."""
    return np.append(0.0, np.cumsum(v[:-1])) * sample_time_s


def speed(place_mm: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """Returns the speed (T,) in mm/s whose `place` is place_mm (T,), for any start value; the last one is
    0."""
    return np.diff(place_mm, append=place_mm[-1]) / sample_time_s


def sent(u: np.ndarray, kind: CommandKind, *, sample_time_s: float) -> np.ndarray:
    """Returns the signal sent to a machine of `kind` for the command u (T,) of laws and composers: the place
    in mm if `kind` is "place", else u itself. u is a speed in mm/s if the machine conserves volume."""
    return place(u, sample_time_s=sample_time_s) if kind == "place" else u


def command(recorded: np.ndarray, kind: CommandKind, *, sample_time_s: float) -> np.ndarray:
    """Returns the command u (T,) of laws and composers from the signal that was sent: the inverse of
    `sent`."""
    return speed(recorded, sample_time_s=sample_time_s) if kind == "place" else recorded


def demand(u: np.ndarray, *, sample_time_s: float) -> tuple[float, float]:
    """Returns what a command u (..., T) in mm, constant between samples, demands of a drive: its largest |u|
    in mm and its largest |du/dt| in mm/s, from rest at 0."""
    if u.size == 0:
        return 0.0, 0.0
    return float(np.abs(u).max()), float(np.abs(_moves(u)).max()) / sample_time_s


def follows(u: np.ndarray, drive: Drive, *, sample_time_s: float) -> bool:
    """Returns whether the drive can follow the command u (..., T) in mm unchanged; rounding does not count as
    beyond its limits."""
    command_mm, speed = demand(u, sample_time_s=sample_time_s)
    return command_mm <= BEYOND * drive.amplitude_mm and speed <= BEYOND * drive.speed_mm_per_s


def obeyed(u: np.ndarray, drive: Drive, *, sample_time_s: float) -> np.ndarray:
    """Returns what the drive does with the command u (..., T) in mm: it is cut at +-amplitude and then
    followed from rest at 0 as fast as the drive goes. The backlash comes after it."""
    cut, step = np.clip(u, -drive.amplitude_mm, drive.amplitude_mm), drive.speed_mm_per_s * sample_time_s
    if cut.size == 0 or np.abs(_moves(cut)).max() <= BEYOND * step:
        return cut
    return np.stack([_slewed(row, step) for row in cut.reshape(-1, cut.shape[-1])]).reshape(cut.shape)


def at_limit(u: np.ndarray, drive: Drive, *, sample_time_s: float) -> np.ndarray:
    """Returns whether each sample of the command u (..., T) in mm is at the amplitude or at the speed of the
    drive."""
    step = drive.speed_mm_per_s * sample_time_s
    return (np.abs(u) >= NEAR * drive.amplitude_mm) | (np.abs(_moves(u)) >= NEAR * step)


def _moves(u: np.ndarray) -> np.ndarray:
    """Returns u(t) - u(t-1) (..., T), from rest at 0."""
    return np.diff(u, axis=-1, prepend=0.0)


def _slewed(u: np.ndarray, step: float) -> np.ndarray:
    """Returns u (T,) followed from 0 by at most `step` per sample."""
    at, out = 0.0, []
    for value in u.tolist():
        at = value if abs(value - at) <= step else at + math.copysign(step, value - at)
        out.append(at)
    return np.array(out)
