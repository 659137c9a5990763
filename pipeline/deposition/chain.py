"""The whole chain of the extruder identified from every learning trial: delay, lag, play, time constant,
yield, creep; and its error on routines left out."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.signal

from pipeline.deposition.extruder import Extruder, lagged
from pipeline.deposition.library import Training

# the order of the unknowns: ln K, ln tau, delay, ln lag, play, yield, creep share, ln creep time; play and
# yield in shares of the steady command and flow
LOW = np.array([math.log(1e-3), math.log(0.05), 0.0, math.log(1.0), 0.0, 0.0, 0.0, math.log(5.0)])
HIGH = np.array([math.log(1e3), math.log(100.0), 1.0, math.log(20.0), 0.3, 0.5, 0.5, math.log(200.0)])
# steps of the central part of the Jacobian, small against what a trial can tell and large against rounding
STEP = np.array([1e-3, 1e-3, 1e-3, 1e-2, 1e-3, 1e-3, 2e-3, 1e-2])
AVERAGE_S = 0.2
# a measured flow wanders from trial to trial: changes slower than this
# are trusted less than white noise would be
DRIFT_S = 4.0
LINEAR, CREEP = np.arange(6), np.arange(8)


class Chain(NamedTuple):
    """The identified extruder, and how far to trust it.

    `residual_percent` is the r.m.s. of measured minus simulated flow over all trials, `held_out_percent` the
    r.m.s. error on learned trials of routines that the fit did not see, both in % of the steady flow; the
    latter of means over AVERAGE_S. `creeps`: the slow mode lowered it. `trials` were used, in `rows` means.
    """

    extruder: Extruder
    residual_percent: float
    held_out_percent: float
    creeps: bool
    trials: int
    rows: int


class Records(NamedTuple):
    """Rows (N, T) of commands u and measured flows y of `routine` (N,), weight (N, T) = root of the trials
    behind a row, 0 where y is unknown or beyond the end."""

    u: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    routine: np.ndarray


def records(trainings: Sequence[Training], *, early: int = 3) -> Records:
    """All trials as rows: the first `early` of each routine alone, for there u still changes, the mean of the
    later ones, whose commands hardly differ."""
    rows = []
    for index, training in enumerate(trainings):
        u, y = np.asarray(training.u, float), np.asarray(training.y, float)
        alone = min(early, len(u) - 1)
        for part in (*(slice(j, j + 1) for j in range(alone)), slice(alone, len(u))):
            observable = np.isfinite(y[part])
            count = observable.sum(axis=0)
            mean = np.where(observable, y[part], 0.0).sum(axis=0) / np.maximum(count, 1)
            rows.append((u[part].mean(axis=0), mean, np.sqrt(count), index))
    longest = max(len(row[0]) for row in rows)
    padded = [np.stack([np.pad(row[k], (0, longest - len(row[k]))) for row in rows]) for k in range(3)]
    return Records(*padded, np.array([row[3] for row in rows]))


def backlash(x: np.ndarray, play: np.ndarray) -> np.ndarray:
    """Play of full width `play` (...,) along the last axis of x (..., T), y(t) = min(max(y(t-1), x(t) -
    play/2), x(t) + play/2) from y(-1) = 0.

    Each step clips y to [x - play/2, x + play/2], and clips compose to clips: blocks of
    the time axis are walked side by side, then joined.
    """
    rows, length = math.prod(x.shape[:-1]), x.shape[-1]
    block = max(1, math.isqrt(length // 4) if rows < 64 else length)
    blocks = -(-length // block)
    padded = np.pad(x.reshape(rows, length), ((0, 0), (0, blocks * block - length)), mode="edge")
    half = np.repeat(np.broadcast_to(play, x.shape[:-1]).ravel() / 2, blocks)
    steps = np.ascontiguousarray(padded.reshape(rows * blocks, block).T)
    low, high = np.full(rows * blocks, -np.inf), np.full(rows * blocks, np.inf)
    if blocks > 1:
        for step in steps:
            low, high = np.clip(low, step - half, step + half), np.clip(high, step - half, step + half)
    start, y = np.zeros((rows, blocks)), np.zeros(rows)
    for k, (a, b) in enumerate(zip(low.reshape(rows, blocks).T, high.reshape(rows, blocks).T, strict=True)):
        start[:, k] = y
        y = np.minimum(np.maximum(y, a), b)
    y, out = start.ravel(), np.empty_like(steps)
    for step, row in zip(steps, out, strict=True):
        y = np.minimum(np.maximum(y, step - half), step + half, out=row)
    return out.T.reshape(rows, blocks * block)[:, :length].reshape(x.shape)


def first_order(x: np.ndarray, time_constant_s: float, sample_time_s: float) -> np.ndarray:
    """1 / (tau s + 1) along the last axis, x held between samples."""
    a = math.exp(-sample_time_s / time_constant_s)
    return scipy.signal.lfilter([0.0, 1 - a], [1.0, -a], x)


def simulate(extruders: Sequence[Extruder], u: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """Flow (P, N, T) of each of P extruders under the rows u (N, T),
    each from rest: extruder.flow for many at once."""
    quiet = math.ceil(
        2.0 / sample_time_s
    )  # the slowest lag and the longest delay have died out before the next row
    flat = np.pad(u, ((0, 0), (0, quiet))).ravel()
    x = np.stack(
        [
            lagged(flat, e.delay_s, e.lag_hz, sample_time_s).reshape(len(u), -1)[:, : u.shape[1]]
            for e in extruders
        ]
    )
    x = backlash(x, np.array([e.play for e in extruders])[:, None])
    flows = []
    for v, e in zip(x, extruders, strict=True):
        pressed = (1 - e.creep_share) * first_order(v, e.time_constant_s, sample_time_s)
        if e.creep_share > 0:
            pressed += e.creep_share * first_order(v, e.creep_time_s, sample_time_s)
        flows.append(np.maximum(e.gain * pressed - e.yield_, 0.0))
    return np.stack(flows)


def forecast(extruder: Extruder, u: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """Predicted flow (T,) of one command (T,) from rest."""
    return simulate([extruder], u[None], sample_time_s=sample_time_s)[0, 0]


def _extruder(z: np.ndarray, steady_flow: float) -> Extruder:
    gain = math.exp(z[0])
    play, yield_ = z[4] * steady_flow / gain, z[5] * steady_flow
    return Extruder(
        gain,
        math.exp(z[1]),
        float(z[2]),
        math.exp(z[3]),
        float(play),
        float(yield_),
        float(z[6]),
        math.exp(z[7]),
    )


def innovations(error: np.ndarray, weight: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Weighted errors (P, N, T) without what white noise upon a random walk lets one foresee: (1 - q^-1) / (1
    - theta q^-1), theta = exp(-Ts / DRIFT_S).

    That is the whitening filter of such a measurement (Muth 1960). Where nothing
    was seen (weight (N, T) 0) the last error seen stays.
    """
    last = np.maximum.accumulate(np.where(weight > 0, np.arange(weight.shape[1]), 0), axis=1)
    held = np.take_along_axis(error * weight, np.broadcast_to(last, error.shape), axis=-1)
    return scipy.signal.lfilter([1.0, -1.0], [1.0, -math.exp(-sample_time_s / DRIFT_S)], held)[
        ..., weight > 0
    ]


def fit(
    rows: Records,
    z: np.ndarray,
    free: np.ndarray,
    steady_flow: float,
    sample_time_s: float,
    *,
    evaluations: int,
) -> tuple[np.ndarray, float]:
    """The unknowns z with those in `free` moved to the least sum of squared innovations of simulated -
    measured flow (output error, Gauss-Newton within bounds); and that sum."""

    def moved(part):
        full = z.copy()
        full[free] = part
        return full

    def weighted(difference):
        return innovations(difference, rows.weight, sample_time_s) / steady_flow

    def errors(part):
        return weighted(
            simulate([_extruder(moved(part), steady_flow)], rows.u, sample_time_s=sample_time_s)[0] - rows.y
        )

    def jacobian(part):
        at = moved(part)
        sides = np.where(at + STEP < HIGH, STEP, -STEP)
        shifted = [at] + [at + np.where(np.arange(len(at)) == i, sides, 0.0) for i in free]
        flows = simulate([_extruder(p, steady_flow) for p in shifted], rows.u, sample_time_s=sample_time_s)
        return weighted(flows[1:] - flows[0]).T / sides[free]

    start = np.clip(z[free], LOW[free], HIGH[free])
    solution = scipy.optimize.least_squares(
        errors,
        start,
        jacobian,
        bounds=(LOW[free], HIGH[free]),
        x_scale=100 * STEP[free],
        ftol=1e-6,
        xtol=1e-6,
        max_nfev=evaluations,
    )
    return moved(solution.x), 2 * float(solution.cost)


def _start(rows: Records, steady_flow: float, sample_time_s: float) -> np.ndarray:
    """K from the volume out by the displacement in, tau, delay by the best of a coarse grid of short fits."""
    displaced = np.sum(rows.u * (rows.weight > 0))
    if displaced <= 0:
        raise ValueError(
            "identify: expected commands that press but found a sum of u <= 0; "
            "check the sign of the command (mm, positive pushes material out)"
        )
    gain = max(float(np.sum(rows.y * (rows.weight > 0))), 1e-3 * steady_flow) / displaced
    grid = [
        np.array([math.log(gain), math.log(tau), delay, math.log(4.5), 0.02, 0.05, 0.0, math.log(20.0)])
        for tau in (0.7, 1.5, 3.0, 6.0)
        for delay in (0.05, 0.2)
    ]
    flows = simulate([_extruder(z, steady_flow) for z in grid], rows.u, sample_time_s=sample_time_s)
    return grid[int(np.argmin([np.sum(((f - rows.y) * rows.weight) ** 2) for f in flows]))]


def _held_out(
    rows: Records,
    folds: np.ndarray,
    z: np.ndarray,
    free: np.ndarray,
    steady_flow: float,
    sample_time_s: float,
) -> float:
    """R.m.s. error on the last row of each fold by a fit to the other folds, in shares of the steady flow."""
    squares = []
    for fold in np.unique(folds):
        out = folds == fold
        rest = Records(*(part[~out] for part in rows))
        left = _extruder(fit(rest, z, free, steady_flow, sample_time_s, evaluations=8)[0], steady_flow)
        last = np.flatnonzero(out)[-1:]
        error = simulate([left], rows.u[last], sample_time_s=sample_time_s)[0] - rows.y[last]
        squares.append(averaged(error[0], rows.weight[last[0]] > 0, sample_time_s) ** 2)
    return math.sqrt(np.mean(squares)) / steady_flow


def averaged(error: np.ndarray, observable: np.ndarray, sample_time_s: float) -> float:
    """R.m.s. of the means of an error over AVERAGE_S, where it was seen: what is left of white noise is a
    fraction, what is left of an error of flow all of it."""
    box = np.ones(round(AVERAGE_S / sample_time_s))
    count = np.convolve(observable, box, "same")
    return float(
        np.sqrt(
            np.mean(
                (np.convolve(np.where(observable, error, 0.0), box, "same")[count > 0] / count[count > 0])
                ** 2
            )
        )
    )


def identify(trainings: Sequence[Training], *, sample_time_s: float) -> Chain:
    """The chain of one material and nozzle from all its trials: with the slow mode
    only where that predicts routines left out better.

    One routine alone cannot be left out: then its rows are. Two speeds part gain from
    yield, which one speed cannot (they are collinear on one plateau). Raises ValueError
    without trials, or where the commands do not press.
    """
    if not trainings or any(len(training.u) < 2 for training in trainings):
        raise ValueError(
            "identify: expected routines of at least two trials each but found "
            f"{[len(t.u) for t in trainings]}; run more trials"
        )
    steady_flow = max(float(np.max(training.r)) for training in trainings)
    rows = records(trainings)
    folds = rows.routine if len(trainings) > 1 else np.arange(len(rows.routine))
    z, cost = fit(
        rows, _start(rows, steady_flow, sample_time_s), LINEAR, steady_flow, sample_time_s, evaluations=40
    )
    slow, slow_cost = fit(
        rows, np.where(np.arange(8) == 6, 0.05, z), CREEP, steady_flow, sample_time_s, evaluations=40
    )
    error, creeps = _held_out(rows, folds, z, LINEAR, steady_flow, sample_time_s), False
    # less than this is noise that a slow mode happens to fit
    if slow_cost < 0.996 * cost:
        slow_error = _held_out(rows, folds, slow, CREEP, steady_flow, sample_time_s)
        creeps = slow_error < error
    best, error = (slow, slow_error) if creeps else (z, error)
    left = simulate([_extruder(best, steady_flow)], rows.u, sample_time_s=sample_time_s)[0] - rows.y
    residual = math.sqrt(np.sum((left * rows.weight) ** 2) / np.sum(rows.weight**2)) / steady_flow
    return Chain(
        _extruder(best, steady_flow),
        100 * residual,
        100 * error,
        creeps,
        sum(len(t.u) for t in trainings),
        len(rows.routine),
    )
