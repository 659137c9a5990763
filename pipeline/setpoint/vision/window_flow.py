"""The flow that a window of frames shows, with its spread, and the class probabilities that follow from it.

Each frame gives a log flow with its own standard deviation. These are fitted to true flows on segments that
the network never saw. Noise, ground and focus shift the flow that a whole segment shows. This shift is
predicted from the looks of a window (frames/familiar.py) and subtracted first.
"""

from typing import NamedTuple

import numpy as np
import scipy.special

from pipeline.setpoint.frames import familiar
from pipeline.setpoint.frames.nozzle_scene import BORDERS

CLASSES = 3
# knots, in percent, of the map from what frames show to the flow; it is linear between them
KNOTS_PERCENT = (
    10.0,
    20.0,
    35.0,
    50.0,
    65.0,
    80.0,
    90.0,
    100.0,
    110.0,
    120.0,
    140.0,
    170.0,
    220.0,
    310.0,
    620.0,
)
# weight of the penalty on changes of slope, in windows, and the smallest slope that is accepted
STRAIGHT, LEAST_SLOPE = 3.0, 0.1


# range of flows in percent whose windows are used to fit the look correction, its ridge penalty, and the
# number of deviations at which a look is clipped
LOOKED_PERCENT, LOOK_PENALTY, FURTHEST_LOOK = (50.0, 200.0), 3.0, 3.0


class LookCorrection(NamedTuple):
    """By how much the looks of a window shift the log flow that its frames show: c = weight' z, with z the
    looks minus `mean` in units of `deviation`, (measures,) each. `explained`: standard deviation of c, in the
    log flow that is seen."""

    mean: np.ndarray
    deviation: np.ndarray
    weight: np.ndarray
    explained: float


NO_CORRECTION = LookCorrection(*(np.full(len(familiar.NAMES), x) for x in (0.0, 1.0, 0.0)), 0.0)


class FlowCalibration(NamedTuple):
    """Turns the log flows of frames into that of a window. `shown` (k,): what frames show on average at the
    flows KNOTS_PERCENT, rising; `scale` (k,): multiplies their standard deviation there; `correlation`:
    between the errors of frames of one segment; `looks`: correction for what lies around the bead.

    An unsure network gives a flow nearer to those that it learned than the true one. The map undoes that, so
    that on average a window shows its true flow.
    """

    shown: np.ndarray
    scale: np.ndarray
    correlation: float
    looks: LookCorrection = NO_CORRECTION


class WindowFlow(NamedTuple):
    """For w windows: `flow_seen` (w,) in percent of nominal; `spread` (w,), its relative standard deviation;
    `prob` (w, 3), probabilities of under, good, over. Without a valid frame: NaN, NaN and 1/3 each."""

    flow_seen: np.ndarray
    spread: np.ndarray
    prob: np.ndarray


def window_flow(
    log_flow: np.ndarray, deviation: np.ndarray, valid: np.ndarray, looks: np.ndarray, fitted: FlowCalibration
) -> WindowFlow:
    """Returns the flow of w windows. `log_flow` and `deviation` (w, length): log(flow / 100 %) of the frames
    and its standard deviation; `valid` (w, length); `looks` (w, measures).

    The m valid frames are averaged with weights v_i = deviation_i^-2, and the effect of the looks is
    subtracted. flow_seen is the flow at which frames show this value on average. Frames of one segment repeat
    each other, so (design effect; Kish 1965)

        spread^2 = scale^2 (1 + (m - 1) correlation) / sum_i v_i,

    and it is larger if the looks are unknown (NaN).
    """
    shown, unscaled = _shown(log_flow, deviation, valid, fitted.correlation)
    moved = correction(fitted.looks, looks)
    seen = np.interp(shown - np.nan_to_num(moved), fitted.shown, _knots())
    some = np.isfinite(seen)
    spread = unscaled * np.interp(seen, _knots(), fitted.scale)
    spread = np.hypot(spread, np.where(np.isnan(moved), fitted.looks.explained, 0.0))
    prob = np.full((len(seen), CLASSES), 1 / CLASSES)
    prob[some] = class_probabilities(seen[some], spread[some])
    return WindowFlow(100 * np.exp(seen), spread, prob)


def correction(of: LookCorrection, looks: np.ndarray) -> np.ndarray:
    """Returns the log flow (w,) to subtract for looks (w, measures); NaN if they are unknown."""
    z = (looks - of.mean) / of.deviation
    return np.clip(z, -FURTHEST_LOOK, FURTHEST_LOOK) @ of.weight


def fit_correction(looks: np.ndarray, residual: np.ndarray) -> LookCorrection:
    """Fits by ridge regression by how much windows show too much log flow, residual (w,), from their looks
    (w, measures). Returns no correction for fewer than three windows for each measure, because it would fit
    noise."""
    some = np.isfinite(looks).all(axis=1) & np.isfinite(residual)
    looks, residual = looks[some], residual[some]
    if len(looks) < 3 * looks.shape[1]:
        return NO_CORRECTION
    mean, deviation = looks.mean(axis=0), looks.std(axis=0) + 1e-6
    Z = np.clip((looks - mean) / deviation, -FURTHEST_LOOK, FURTHEST_LOOK)
    gram = Z.T @ Z + LOOK_PENALTY * np.eye(Z.shape[1])
    weight = np.linalg.solve(gram, Z.T @ (residual - residual.mean()))
    return LookCorrection(mean, deviation, weight, 0.0)


def _shown(
    log_flow: np.ndarray, deviation: np.ndarray, valid: np.ndarray, correlation: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the weighted mean of each window's frames and its unscaled standard deviation (w,); NaN without
    a valid frame."""
    m = valid.sum(axis=1)
    weight = np.where(valid, deviation, np.inf) ** -2.0
    total = np.where(m > 0, weight.sum(axis=1), np.nan)
    mean = (weight * np.where(valid, log_flow, 0.0)).sum(axis=1) / total
    return mean, np.sqrt((1 + np.maximum(m - 1, 0) * correlation) / total)


def _knots() -> np.ndarray:
    return np.log(np.array(KNOTS_PERCENT) / 100)


def _hats(log_flow: np.ndarray) -> np.ndarray:
    """Returns the weights (n, k) of the knots in linear interpolation at log_flow (n,)."""
    return np.stack([np.interp(log_flow, _knots(), one) for one in np.eye(len(KNOTS_PERCENT))], axis=1)


def _straight() -> np.ndarray:
    """Returns the changes of slope (k - 2, k) at the inner knots, per unit of log flow."""
    slopes = np.diff(np.eye(len(KNOTS_PERCENT)), axis=0) / np.diff(_knots())[:, None]
    return np.diff(slopes, axis=0)


def fit_flow(
    log_flow: np.ndarray, deviation: np.ndarray, valid: np.ndarray, looks: np.ndarray, flow: np.ndarray
) -> FlowCalibration:
    """Fits map, scale, correlation and look correction to windows (w, length) with looks (w, measures), at
    flows (w,) in percent. Their segments must not have been used for training.

    The map is a least-squares fit; each change of slope is penalised as much as STRAIGHT windows weigh. It is
    fitted twice, before and after the correction for looks is fitted to its residuals. The correlation is
    that of the standardised residuals of two frames of a window (analysis of variance). The scale matches the
    windows' squared errors and is smoothed in the same way.
    """
    some = valid.any(axis=1)
    log_flow, deviation, valid, looks = (a[some] for a in (log_flow, deviation, valid, looks))
    truth, flow = np.log(flow[some] / 100), flow[some]
    hats, straight, knots = _hats(truth), STRAIGHT * _straight().T @ _straight(), _knots()
    shown, _ = _shown(log_flow, deviation, valid, 0.0)
    near = (flow >= LOOKED_PERCENT[0]) & (flow <= LOOKED_PERCENT[1])
    of_looks = fit_correction(looks[near], (shown - hats @ _fit_map(hats, shown))[near])
    moved = np.nan_to_num(correction(of_looks, looks))
    log_flow = log_flow - moved[:, None]
    fitted = _fit_map(hats, shown - moved)
    correlation = _correlation((log_flow - (hats @ fitted)[:, None]) / deviation, valid)
    shown, unscaled = _shown(log_flow, deviation, valid, correlation)
    seen = np.interp(shown, fitted, knots)
    squared = ((seen - truth) / unscaled) ** 2
    hats = _hats(seen)
    level = squared.mean()
    scale2 = np.linalg.solve(hats.T @ hats + straight + 1e-6 * np.eye(len(knots)), hats.T @ squared)
    scale = np.sqrt(np.clip(scale2, 0.25 * level, 16 * level))
    explained = float((np.interp(shown + moved, fitted, knots) - seen)[near].std()) if near.any() else 0.0
    return FlowCalibration(fitted, scale, correlation, of_looks._replace(explained=explained))


def _fit_map(hats: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Returns what frames show at the knots (k,), rising. `hats` (w, k): weights of the windows; `shown`
    (w,): what they show on average."""
    straight, knots = STRAIGHT * _straight().T @ _straight(), _knots()
    slopes = np.eye(len(KNOTS_PERCENT))[[0, -1]] * 1e-6  # keeps ends without data finite
    fitted = np.linalg.solve(
        hats.T @ hats + straight + slopes.T @ slopes, hats.T @ shown + slopes.T @ slopes @ knots
    )
    steps = np.maximum(np.diff(fitted), LEAST_SLOPE * np.diff(knots))
    middle = KNOTS_PERCENT.index(100.0)
    rising = np.concatenate([[0.0], np.cumsum(steps)])
    return rising + fitted[middle] - rising[middle]


def _correlation(residual: np.ndarray, valid: np.ndarray) -> float:
    """Returns the mean product of the residuals of two valid frames of a window over the mean square, within
    0 .. 1."""
    r = np.where(valid, residual, 0.0)
    m = valid.sum(axis=1)
    pairs = (m * (m - 1)).sum()
    if pairs == 0:
        return 1.0  # windows of one frame: it is unknown if more frames would give more information
    products = (r.sum(axis=1) ** 2 - (r**2).sum(axis=1)).sum() / pairs
    return float(np.clip(products / ((r**2).sum() / m.sum()), 0.0, 1.0))


def class_probabilities(log_flow: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Returns P(flow below 90 %, 90 to 110 %, above) (n, 3) if log(flow / 100 %) ~ Normal(log_flow,
    spread)."""
    low, high = (np.log(border / 100) for border in BORDERS)
    under = scipy.special.ndtr((low - log_flow) / spread)
    over = scipy.special.ndtr((log_flow - high) / spread)
    # as the difference of the nearer tails: 1 - under - over loses its digits far from 100 %
    good = np.where(
        log_flow > 0,
        scipy.special.ndtr((high - log_flow) / spread) - under,
        scipy.special.ndtr((log_flow - low) / spread) - over,
    )
    return np.stack([under, np.maximum(good, 0.0), over], axis=1)
