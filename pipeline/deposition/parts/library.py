"""The basis-signal library (Hoelzle 2009): learned commands are cut into tasks, with limits found on the
smoothed signal. Also finds the nearest signal for a task, and gives the four assumptions in figures."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.signal

from pipeline.deposition.extruder import Routine
from pipeline.deposition.learning.ilc import repeating_error

# in the order of the hierarchy (fig. 7): the first that is active rules
TASKS = ("Stop", "Start", "Corner", "Steady-State", "No-Flow")
STOP, START, CORNER, STEADY, NO_FLOW = TASKS
# a signal has settled if it is within the threshold for this long: longer than it takes to cross a level
HOLD_S = 0.1


class TooFewTrials(ValueError):
    """Raised if more trials must be printed before a library can be cut."""


class Training(NamedTuple):
    """All trials of one routine on one material and nozzle: commands u (J, T) in mm and measured flows y (J,
    T) in mm^3/s, NaN where not observable."""

    material: str
    nozzle_mm: float
    routine: Routine
    u: np.ndarray
    y: np.ndarray

    @property
    def r(self) -> np.ndarray:
        return self.routine.r

    @property
    def speed(self) -> float:
        return round(float(np.max(self.routine.speed)), 9)

    @property
    def pause_s(self) -> float:
        return round(self.routine.pause_s[1] - self.routine.pause_s[0], 9)


class Basis(NamedTuple):
    """One column of (3): `signal` (K,) in mm, which begins `lead` samples before its event. speed in mm/s;
    pause_s is 0 except for a Corner."""

    task: str
    material: str
    nozzle_mm: float
    speed: float
    pause_s: float
    lead: int
    signal: np.ndarray


class Library(NamedTuple):
    """`columns`: the basis signals in the order of (3); `sample_time_s`: their sample time; `marks`: the
    limits of each task in s before and after its event."""

    columns: tuple[Basis, ...]
    sample_time_s: float
    marks: dict[str, tuple[float, float]]


class Check(NamedTuple):
    """One of the paper's four assumptions as a figure."""

    assumption: int
    claim: str
    material: str
    nozzle_mm: float
    percent: float


def learned(training: Training) -> tuple[np.ndarray, np.ndarray]:
    """Returns the command (T,) of the best trial, by its repeating error (`ilc.repeating_error`), and the
    final measured flow (T,): the mean over the trials whose error is within a tenth of the lowest."""
    error = np.array([repeating_error(training.r, y) for y in training.y])
    best = error <= 1.1 * error.min()
    observable = np.isfinite(training.y[best])
    y = np.where(observable, training.y[best], 0.0).sum(axis=0) / np.maximum(observable.sum(axis=0), 1)
    return training.u[error.argmin()], np.where(observable.any(axis=0), y, np.nan)


def smoothed(u: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Returns u after the paper's Q filter: 2nd-order Butterworth low-pass, 3 Hz, forward and backward."""
    return scipy.signal.sosfiltfilt(scipy.signal.butter(2, 3.0, fs=1 / sample_time_s, output="sos"), u)


def _events(training: Training) -> dict[str, tuple[float, float]]:
    routine = training.routine
    return {
        START: (routine.start_s, routine.start_s),
        CORNER: routine.pause_s,
        STOP: (routine.stop_s, routine.stop_s),
    }


def plateaus(training: Training, sample_time_s: float) -> tuple[slice, slice]:
    """Returns the middle halves of the two plateaus."""
    routine = training.routine
    ends = ((routine.start_s, routine.pause_s[0]), (routine.pause_s[1], routine.stop_s))
    return tuple(
        slice(round((0.75 * a + 0.25 * b) / sample_time_s), round((0.25 * a + 0.75 * b) / sample_time_s))
        for a, b in ends
    )


def _walk(active: np.ndarray, hold: int) -> int:
    """Returns the samples from the event until `active` is False for `hold` samples. active (T,) begins at
    the event and ends in the middle of the next plateau."""
    quiet = np.convolve(~active, np.ones(hold))[hold - 1 : len(active)] == hold
    return int(np.argmax(quiet)) if quiet.any() else len(active)


def demarcate(trainings: Sequence[Training], *, sample_time_s: float) -> dict[str, tuple[float, float]]:
    """Returns the seconds by which each finite task's signal begins before its event and ends after it. They
    are the same for all materials, speeds and pauses: the widest found.

    A task lasts while the smoothed command differs from the level of the plateau beside it by more than max(2
    % of its peak, 3 sigma of the plateau). Raises ValueError if the plateaus are not flat: if 3 sigma is
    above 30 % of the peak, or a task lasts to the middle of its plateau.
    """
    marks = dict.fromkeys((START, CORNER, STOP), (0.0, 0.0))
    hold = max(1, round(HOLD_S / sample_time_s))
    for training in trainings:
        u = smoothed(learned(training)[0], sample_time_s)
        flat = plateaus(training, sample_time_s)
        steady = float(np.mean([u[part].mean() for part in flat]))
        sigma = max(u[part].std() for part in flat)
        peak, settled = np.abs(u).max(), True
        threshold = max(0.02 * peak, 3 * sigma)
        middles = [0, *(round((part.start + part.stop) / 2) for part in flat), len(u)]
        levels = [0.0, steady, steady, 0.0]
        for k, (task, event) in enumerate(_events(training).items()):
            begin, end = (round(t / sample_time_s) for t in event)
            sides = (u[middles[k] : begin + 1][::-1] - levels[k], u[end : middles[k + 1]] - levels[k + 1])
            spans = [_walk(np.abs(side) > threshold, hold) for side in sides]
            settled &= all(span < len(side) for span, side in zip(spans, sides, strict=True))
            marks[task] = tuple(
                max(mark, span * sample_time_s) for mark, span in zip(marks[task], spans, strict=True)
            )
        if 3 * sigma > 0.3 * peak or not settled:
            raise ValueError(
                f"segment: the command of {training.material} at {training.speed:g} mm/s with a pause of "
                f"{training.pause_s:g} s does not settle on its plateaus "
                f"(3 sigma is {3 * sigma:.3g} mm, its peak {peak:.3g} mm); "
                "lengthen the plateaus to 3 time constants, or learn on"
            )
    return marks


def segment(
    training: Training, marks: dict[str, tuple[float, float]], *, sample_time_s: float
) -> list[Basis]:
    """Returns the five basis signals of one routine, cut from its learned command at the marks. Steady-State
    is the mean of the plateaus, No-Flow is zero."""
    u = learned(training)[0]
    columns = []
    for task, event in _events(training).items():
        begin, end = (round(t / sample_time_s) for t in event)
        lead, tail = (round(t / sample_time_s) for t in marks[task])
        pause = training.pause_s if task == CORNER else 0.0
        columns.append((task, pause, lead, u[begin - lead : end + tail]))
    flat = np.concatenate([u[part] for part in plateaus(training, sample_time_s)])
    columns += [(STEADY, 0.0, 0, np.array([flat.mean()])), (NO_FLOW, 0.0, 0, np.zeros(1))]
    return [
        Basis(task, training.material, training.nozzle_mm, training.speed, pause, lead, signal)
        for task, pause, lead, signal in columns
    ]


def build(trainings: Sequence[Training], *, sample_time_s: float) -> Library:
    """Returns the library of all routines. If several routines taught a task (Start at one speed with two
    pauses), its signal is their mean: one task, one signal (assumption 3). Raises ValueError if there is no
    routine."""
    if not trainings:
        raise ValueError("library: expected at least one learned routine but found none; run train_ilc first")
    marks = demarcate(trainings, sample_time_s=sample_time_s)
    by_task: dict[tuple, list[Basis]] = {}
    for training in trainings:
        for basis in segment(training, marks, sample_time_s=sample_time_s):
            by_task.setdefault((*basis[1:4], TASKS.index(basis.task), basis.pause_s), []).append(basis)
    columns = tuple(
        same[0]._replace(signal=np.mean([basis.signal for basis in same], axis=0))
        for _, same in sorted(by_task.items())
    )
    return Library(columns, sample_time_s, marks)


def _laid(basis: Basis, factor: float, level: float, lead: int, length: int) -> np.ndarray:
    """Returns the signal as deviation from the command without the task, from `lead` samples before its event
    to `length` after: without it, the command is at the level before a Corner or a Stop, and after a Start or
    a Corner."""
    out, at = np.zeros(lead + length), lead - basis.lead
    out[at : at + len(basis.signal)] = factor * (basis.signal - background(basis, level))
    return out


def background(basis: Basis, level: float) -> np.ndarray:
    """Returns the command (K,) without the task: Steady-State at `level` after a Start, before a Stop, and on
    both sides of a Corner; else 0."""
    after = np.arange(len(basis.signal)) >= basis.lead
    return level * np.select([basis.task == START, basis.task == STOP], [after, ~after], 1.0)


def _unlike(a: Basis, b: Basis, per_speed: float) -> float:
    """Returns how different a, scaled to b's speed, is from b: r.m.s. of the difference divided by the larger
    of the two, both as deviations from the steady command."""
    if a.task in (STEADY, NO_FLOW):
        return abs(float(a.signal[0]) * b.speed / a.speed - float(b.signal[0])) / max(
            per_speed * b.speed, 1e-12
        )
    lead, length = max(a.lead, b.lead), max(len(a.signal) - a.lead, len(b.signal) - b.lead)
    one, other = (_laid(c, b.speed / c.speed, per_speed * c.speed, lead, length) for c in (a, b))
    return float(np.linalg.norm(one - other) / max(np.linalg.norm(one), np.linalg.norm(other), 1e-12))


def _slopes(columns: Sequence[Basis], per_speed: float) -> tuple[float, float]:
    """Returns the largest difference (`_unlike`) per unit of |ln speed| and per second of pause among the
    columns of one task; NaN if there is only one speed or one pause."""
    by_speed, by_pause = [math.nan], [math.nan]
    for a in columns:
        for b in columns:
            if a.speed != b.speed and a.pause_s == b.pause_s:
                by_speed.append(_unlike(a, b, per_speed) / abs(math.log(a.speed / b.speed)))
            if a.pause_s != b.pause_s and a.speed == b.speed:
                by_pause.append(_unlike(a, b, per_speed) / abs(a.pause_s - b.pause_s))
    return float(np.fmax.reduce(by_speed)), float(np.fmax.reduce(by_pause))


def of_task(library: Library, task: str, material: str, nozzle_mm: float) -> list[Basis]:
    """Returns the columns of one task. A Corner without a pause is no event and need not be trained: its
    column is the Steady-State."""
    mine = [basis for basis in library.columns if (basis.material, basis.nozzle_mm) == (material, nozzle_mm)]
    still = [basis._replace(task=CORNER) for basis in mine if basis.task == STEADY] if task == CORNER else []
    return still + [basis for basis in mine if basis.task == task]


def nearest(
    library: Library, task: str, material: str, nozzle_mm: float, speed: np.ndarray, pause_s: np.ndarray
) -> tuple[list[Basis], np.ndarray, np.ndarray, np.ndarray]:
    """Returns, for M tasks of `speed` (M,) in mm/s and `pause_s` (M,): the columns of the task; the index
    (M,) of the nearest one; the factor on its signal (M,); its predicted error in percent (M,). Nearest is
    judged by pause first, because scaling cannot correct a wrong pause."""
    columns = of_task(library, task, material, nozzle_mm)
    still = of_task(library, STEADY, material, nozzle_mm)
    per_speed = float(np.mean([basis.signal[0] / basis.speed for basis in still]))
    pause_s = np.where(task == CORNER, pause_s, 0.0)
    off_speed = np.abs(
        np.log(np.maximum(speed, 1e-9)[:, None] / np.array([basis.speed for basis in columns]))
    )
    off_pause = np.abs(pause_s[:, None] - np.array([basis.pause_s for basis in columns]))
    column = np.argmin(np.round(off_pause, 6) * 1e3 + off_speed, axis=1)
    rows = np.arange(len(column))
    error = np.zeros(len(column))
    for slope, off in zip(
        _slopes(columns, per_speed), (off_speed[rows, column], off_pause[rows, column]), strict=True
    ):
        error += np.where(off < 1e-6, 0.0, 100 * slope * off)
    factor = speed / np.array([basis.speed for basis in columns])[column]
    return columns, column, factor, np.zeros(len(column)) if task == NO_FLOW else error


def check(trainings: Sequence[Training], library: Library) -> list[Check]:
    """Returns the figures of assumptions 1-4 for each material and nozzle, in percent. No assumption is taken
    as true; all are reported."""
    out, Ts = [], library.sample_time_s
    for key in sorted({(t.material, t.nozzle_mm) for t in trainings}):
        mine = [t for t in trainings if (t.material, t.nozzle_mm) == key]
        columns = [b for b in library.columns if (b.material, b.nozzle_mm) == key]
        per_speed = float(np.mean([b.signal[0] / b.speed for b in columns if b.task == STEADY]))
        cut = [
            [b for t in mine for b in segment(t, library.marks, sample_time_s=Ts) if b.task == task]
            for task in TASKS
        ]
        pairs = [(a, b) for same in cut for a in same for b in same if a is not b and a.speed == b.speed]
        scatter = [np.sqrt(np.nanmean((t.y[-1] - t.y[-2]) ** 2) / 2) / t.r.max() for t in mine]
        drift = [
            np.ptp([learned(t)[0][part].mean() for part in plateaus(t, Ts)]) / (per_speed * t.speed)
            for t in mine
        ]
        alike = [_unlike(a, b, per_speed) for a, b in pairs if a.task not in (NO_FLOW, CORNER)]
        corners = [_unlike(a, b, per_speed) for a, b in pairs if a.task == CORNER and a.pause_s != b.pause_s]
        edges = [
            (b.signal - background(b, per_speed * b.speed))[[0, -1]] / (per_speed * b.speed)
            for b in columns
            if len(b.signal) > 1
        ]
        for assumption, claim, values in (
            (1, "repetition: scatter of the measured flow between the last two trials", scatter),
            (2, "time invariance: change of the steady command from the first plateau to the second", drift),
            (
                3,
                "one signal a task: difference of Start, Stop and Steady-State between routines of one speed",
                alike,
            ),
            (3, "one signal a task: difference of Corner between pauses", corners),
            (
                4,
                "continuity: largest jump of the command at a transition, in % of the steady command",
                np.abs(edges),
            ),
        ):
            out.append(
                Check(assumption, claim, *key, 100 * float(np.max(values)) if len(values) else math.nan)
            )
    return out
