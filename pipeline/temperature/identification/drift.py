"""Slow drift: unrecorded influences (ambient, operating point) as a random walk beside each output.

y(t) = ŷ(t) + w(t) + e(t)
w(t+1) = w(t) + v(t)

ŷ is the simulation of the plant under its inputs alone. This is the disturbance model of output steps (Cutler
and Ramaker 1980; Muske and Badgwell 2002, section 3.1). The Kalman filter of a random walk in white noise is
exponential smoothing (Muth 1960):

w(t+1) = w(t) + k(t) (y(t) - ŷ(t) - w(t))

k(t) = 1/(t+1) until it reaches the `rate`: the mean over a warm-up of 1/rate samples, then slow tracking. It
is stable for every rate in (0, 1] and every plant.

It serves forecasts and hold-outs at another ambient. Controllers do not get this state: their integrator
removes offsets.
"""

import numpy as np

from pipeline.temperature.identification.order import (
    VALIDATED_STEPS,
    WORTH_REFINING,
    Fit,
    ModelStructure,
    Validation,
    beyond_chance,
    fit,
    folds,
    shifted,
)
from pipeline.temperature.identification.refinement import FitSettings, simulated
from pipeline.temperature.identification.subspace import Segments, lagged, realise, subspace
from pipeline.temperature.plant import Plant

SLOWER = (1, 4, 16)  # tried time constants of a drift, in windows
# a mode this near to an integrator moves the level itself, so a drift beside it is not observable
INTEGRATES = 1e-4


def tracked(error: np.ndarray, rate: float, ahead: int = 1) -> np.ndarray:
    """Returns w(t | errors up to t - ahead) (T, p) of simulation errors (T, p). NaN before an output's first
    error is known; a masked error leaves w unchanged."""
    level, count = np.full(error.shape[1], np.nan), np.zeros(error.shape[1])
    drift = np.full(error.shape, np.nan)
    for t in range(len(error) - ahead):
        seen = np.isfinite(error[t])
        count += seen
        gain = np.maximum(rate, 1.0 / np.maximum(count, 1.0))
        before = np.where(np.isfinite(level), level, 0.0)
        level = np.where(seen, before + gain * (np.where(seen, error[t], 0.0) - before), level)
        drift[t + ahead] = level
    return drift


def chosen_rate(
    u: Segments, y: Segments, structure: ModelStructure, order: int, kind: Fit, validation: Validation
) -> float:
    """Returns the rate of the drift, 0 for none. Of `SLOWER` it takes the one with the least error one window
    ahead on the left-out blocks or recordings, if it lowers the error without drift by more than
    `WORTH_REFINING`, beyond chance.

    Returns 0 for a plant with an integrator, and if blocks are shorter than four windows or leave too little.
    """
    u, y = shifted(u, y, structure.delays)
    direct, settings = (
        any(structure.feedthrough),
        FitSettings(structure.feedthrough, structure.offset, max_iterations=VALIDATED_STEPS),
    )
    errors = []
    for train_u, train_y, test_u, test_y in folds(u, y, validation.blocks, validation.recordings):
        if max(map(len, test_u)) < 4 * structure.past:
            return 0.0
        try:
            data = lagged(train_u, train_y, structure.past, feedthrough=direct, offset=structure.offset)
        except ValueError:  # the rest of the record is too short
            return 0.0
        start = realise(data, subspace(data, structure.past)[0][:order], 1.0, structure.feedthrough)
        plant = fit(kind, start, train_u, train_y, settings, gain=False)
        if np.abs(np.linalg.eigvals(plant.A)).max() > 1 - INTEGRATES:
            return 0.0
        errors.append(_errors_ahead(plant, test_u, test_y, structure.past))
    if not errors:
        return 0.0
    gains = np.log(np.array(errors)[:, :1] / np.array(errors)[:, 1:])
    best = int(gains.mean(axis=0).argmax())
    worth = gains[:, best].mean() > -np.log(1 - WORTH_REFINING) and beyond_chance(gains[:, best])
    return 1.0 / (SLOWER[best] * structure.past) if worth else 0.0


def _errors_ahead(plant: Plant, u: Segments, y: Segments, past: int) -> list[float]:
    """Returns the size of the error one window ahead as a share of the outputs' variation, without drift and
    with each of `SLOWER`, after two windows of warm-up."""
    left, spread = [[] for _ in range(1 + len(SLOWER))], np.nanstd(np.vstack(y), axis=0)
    for a, b in zip(u, y, strict=True):
        if len(a) < 4 * past:
            continue
        error = b - simulated(plant, a, b, means_removed=True)
        left[0].append(error[2 * past :])
        for k, times in enumerate(SLOWER, 1):
            left[k].append((error - tracked(error, 1.0 / (times * past), past))[2 * past :])
    return [
        float(np.sqrt(np.nanmean((np.vstack(part) / np.maximum(spread, np.finfo(float).tiny)) ** 2)))
        for part in left
    ]


def simulated_with_drift(plant: Plant, u: np.ndarray, y: np.ndarray, rate: float, ahead: int) -> np.ndarray:
    """Returns ŷ(t) + w(t | y up to t - ahead) (T, p). NaN over the warm-up of 1/rate samples, or a third of
    the segment if that is shorter, and `ahead` more."""
    # the drift has the mean of the error
    error = y - simulated(plant, u, y, means_removed=True)
    predicted = y - error + tracked(error, rate, ahead)
    predicted[: min(int(np.ceil(1.0 / rate)), len(y) // 3) + ahead] = np.nan
    return predicted
