"""Filters the part of the trials that repeats and that the model does not explain: a disturbance, and a gain
that may change. The speed at which each is followed is the one that would have predicted the trials best."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from pipeline.deposition.extruder import pressed
from pipeline.deposition.learning.trial_model import TrialModel

# ooze is separated from noise by the mean flow over this time, which has a fraction of the noise
OOZE_S = 0.5
# the command changes much after these trials, so they count in full for the disturbance, and no gain is
# estimated from them
FIRST = 2
# least weights of a new trial that compete with the law's own
WEIGHTS = (0.3, 0.6)
# followers of the gain that compete with its mean: weight of a new trial on the level, and on the slope
FOLLOWERS = ((0.5, 0.0), (0.3, 0.05), (0.5, 0.1))
# a forecast counts this share of the one after it: about seven trials decide
MEMORY = 0.85
# the slow one is replaced if another's squared forecast error is below this share of its own; noise alone
# hardly ever causes that
WEIGHT_MARGIN, GAIN_MARGIN = 0.8, 0.5
# a gain beyond these bounds, as a factor from trial to trial, is a picture that went wrong
GAIN_BOUNDS = (0.2, 5.0)


class Repeating(NamedTuple):
    """y = max(gain (G u + disturbance) - yield, 0). `disturbance` (T,) in mm^3/s; `gain`: forecast for the
    next trial, relative to the model's gain; `weight`: the chosen least weight of a new trial; `follower`:
    the method that follows the gain (0 its mean, k the k-th of FOLLOWERS)."""

    disturbance: np.ndarray
    gain: float
    weight: float
    follower: int


def repeating(
    u: np.ndarray,
    y: np.ndarray,
    r: np.ndarray,
    model: TrialModel,
    *,
    floor: float,
    smooth: Callable[[np.ndarray], np.ndarray],
    sample_time_s: float,
) -> Repeating:
    """Returns the repeating part of the commands u (J, T) in mm and flows y (J, T) in mm^3/s of all trials, y
    NaN where not observable, for the wanted flow r (T,). `smooth` is Q: (..., T) -> (..., T).

    A Kalman filter over trials, with g_j the gain of trial j by least squares of its flow. The first trials
    count in full and with g = 1:

        k_j = max(1/j, least)
        d <- d + k_j ((y + yield) / g_j - (G u_j + d))

    For a machine that does not change 1/j is best. On a machine that changes a larger weight predicts the
    next trial better. The errors of these predictions choose the weights: for the disturbance the Q-filtered
    innovation, for the gain that of ln g_j (exponential smoothing and its trend: Holt 1957; chosen by
    one-step errors: Gardner 2006).

    Nothing is learned where the flow was not observable, nor where no flow is wanted, predicted or measured.
    Below the yield y does not show x, and noise would be summed up trial after trial.
    """
    e, trials, least = model.extruder, len(u), np.maximum((floor, *WEIGHTS), floor)
    observable, flow = np.isfinite(y), np.nan_to_num(y)
    linear = pressed(e, u, sample_time_s=sample_time_s)
    oozing = scipy.ndimage.uniform_filter1d(flow, max(round(OOZE_S / sample_time_s), 1)) > model.noise
    d = np.zeros((len(least), len(r)))
    log_gain, innovation = np.zeros((len(least), trials)), np.zeros((len(least), trials))
    for j in range(trials):
        x, pressing = linear[j] + d, flow[j] + e.yield_
        told = observable[j] & ((r > 0) | (x > e.yield_) | oozing[j])
        if j >= FIRST:
            log_gain[:, j] = _log_gain(x, pressing, told)
        v = np.where(told, pressing * np.exp(-log_gain[:, j])[:, None] - x, 0.0)
        innovation[:, j] = np.sum(smooth(v) ** 2, axis=-1) if j >= FIRST else 0.0
        d = d + np.maximum(1 / max(j, 1), least)[:, None] * v
    chosen = _foretold_best(innovation[:, FIRST:], WEIGHT_MARGIN)
    forecasts = gain_forecasts(log_gain[chosen])
    errors = (forecasts[:, FIRST:trials] - log_gain[chosen, FIRST:]) ** 2
    follower = _foretold_best(errors, GAIN_MARGIN)
    return Repeating(d[chosen], float(np.exp(forecasts[follower, trials])), float(least[chosen]), follower)


def gain_forecasts(log_gain: np.ndarray) -> np.ndarray:
    """Returns forecasts (1 + followers, J + 1) of ln g_j from those before j, of a series (J,): by its mean,
    and by the level and slope of each of FOLLOWERS."""
    count = np.arange(1, len(log_gain) + 1)
    mean = np.concatenate([[0.0], np.cumsum(log_gain) / count])
    return np.array([mean, *(_followed(log_gain, *weights) for weights in FOLLOWERS)])


def _followed(series: np.ndarray, level_weight: float, slope_weight: float) -> np.ndarray:
    """Returns Holt's forecasts (J + 1,) of a series (J,)."""
    level = slope = 0.0
    forecasts = [0.0]
    for j, value in enumerate(series.tolist()):
        error = value - level - slope
        level = level + slope + max(level_weight, 1 / (j + 1)) * error
        slope += slope_weight * error if j >= FIRST else 0.0
        forecasts.append(level + slope)
    return np.array(forecasts)


def _log_gain(x: np.ndarray, pressing: np.ndarray, told: np.ndarray) -> np.ndarray:
    """Returns ln g (F,) of least |pressing - g x|^2 over the samples in `told`; x (F, T), pressing (T,), told
    (F, T)."""
    weighted = np.where(told, x, 0.0)
    power = np.maximum(np.sum(weighted * x, axis=-1), np.finfo(float).tiny)
    return np.log(np.clip(np.sum(weighted * pressing, axis=-1) / power, *GAIN_BOUNDS))


def _foretold_best(squares: np.ndarray, margin: float) -> int:
    """Returns the index of the candidate with the least squared forecast errors (candidates, J), with more
    weight on recent ones. The first candidate, which is the slowest, is kept unless the best is below
    `margin` of it."""
    sums = squares @ MEMORY ** np.arange(squares.shape[1])[::-1]
    best = int(np.argmin(sums))
    return best if sums[best] < margin * sums[0] else 0
