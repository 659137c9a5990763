"""Identifies the extruder from measured trials: gain, time constant, total delay and yield by least squares,
each with its uncertainty; a second-order lag in addition to the delay; and the part of the machine that the
model does not describe, as a multiplicative uncertainty of its frequency response."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.optimize

from pipeline.deposition.extruder import DAMPING, Extruder, flow, pressed

# coarse search before the fine one: any material that flows within a minute, any delay that a plunger has
TIME_CONSTANTS_S = np.geomspace(0.2, 30.0, 12)
DELAYS_S = np.array([0.0, 0.08, 0.16, 0.3, 0.5])
LONGEST_DELAY_S = 1.0
# lateness is part delay, part lag. One trial hardly separates them, so the lag is assumed near the first
# value, with this spread of its logarithm. A lower lag, inverted, would push far too hard if the machine has
# none (29 % of trial 0 at trial 1, where this gives 9 %)
USUAL_LAG_HZ, LAG_SPREAD, LAG_HZ = 3.0, 0.4, (0.3, 20.0)
# an extruder of another kind still reaches 60 %; noise alone gives 0
LEAST_FIT_PERCENT = 20.0

# spectra are smoothed over this width: a trial of starts and stops has zeros at single frequencies
SMOOTHED_HZ = 0.5
# the highest frequencies, this share of them, hold white noise alone
NOISE_SHARE = 0.5
# a frequency is excited if the simulated flow has this many times the power of the noise there
EXCITED = 4.0


class TrialModel(NamedTuple):
    """y = max(K / (tau s + 1) e^(-delay s) u - yield, 0). The delay includes everything that is late
    (transport and lag); in the model of `identify_with_lag` the lag is separate.

    `extruder` holds K (mm^3/s per mm), tau, delay (s) and yield (mm^3/s). `noise`: r.m.s. of the residual,
    mm^3/s; `fit_percent`: the NRMSE 100 (1 - |y - ŷ| / |y - mean y|).
    """

    extruder: Extruder
    noise: float
    fit_percent: float


def identify(u: Sequence[np.ndarray], y: Sequence[np.ndarray], *, sample_time_s: float) -> TrialModel:
    """Returns the model that simulates the trials best from rest, however well it fits:

        min over (K, tau, delay, yield) of sum (max(x - yield, 0) - y)^2

    u (T,) in mm and measured flow y (T,) in mm^3/s of each trial; NaN in y is a sample that was not
    observable. Raises ValueError if the command never changes, if hardly any flow was observable, or if the
    flow does not rise with the command.
    """
    u, y = [np.asarray(a, float) for a in u], [np.asarray(b, float) for b in y]
    _check(u, y)
    observable = [np.isfinite(b) for b in y]
    measured = np.concatenate([b[mask] for b, mask in zip(y, observable, strict=True)])

    def predicted(gain, tau, delay, yield_):
        model = Extruder(gain, tau, delay)
        x = np.concatenate(
            [
                pressed(model, a, sample_time_s=sample_time_s)[mask]
                for a, mask in zip(u, observable, strict=True)
            ]
        )
        return np.maximum(x - yield_, 0.0)

    gain, tau, delay = _coarse(predicted, measured)
    # the yield is a share of the flow that was measured; the command's peaks say nothing of it
    span = float(np.quantile(measured, 0.95))

    def four(theta):
        return float(np.exp(theta[0])), float(np.exp(theta[1])), float(theta[2]), float(theta[3] * span)

    low = [np.log(gain) - 3, np.log(tau) - 3, 0.0, 0.0]
    high = [np.log(gain) + 3, np.log(tau) + 3, LONGEST_DELAY_S, 1.0]
    start = [np.log(gain), np.log(tau), max(delay, sample_time_s), 0.02]
    fit = scipy.optimize.least_squares(
        lambda theta: predicted(*four(theta)) - measured, start, bounds=(low, high),
        x_scale=[0.1, 0.1, 0.02, 0.02], diff_step=1e-4, xtol=1e-7, ftol=1e-9
    )  # fmt: skip
    K, tau, delay, fitted_yield = four(fit.x)
    extruder = Extruder(K, tau, delay, yield_=fitted_yield)
    return _model(extruder, fit.fun, measured)


def _model(extruder: Extruder, left: np.ndarray, measured: np.ndarray) -> TrialModel:
    """Returns the model with its residual `left` (samples,) of the measured flow (samples,)."""
    spread = max(np.linalg.norm(measured - measured.mean()), np.finfo(float).tiny)
    fit_percent = float(100 * (1 - np.linalg.norm(left) / spread))
    return TrialModel(extruder, float(np.sqrt(np.mean(left**2))), fit_percent)


def identify_with_lag(
    u: Sequence[np.ndarray], y: Sequence[np.ndarray], *, sample_time_s: float
) -> TrialModel:
    """Returns the model as `identify`, with the lateness as delay and second-order lag (`Extruder.lag_hz`).
    It minimises over (K, tau, delay, lag, yield)

        sum (max(x - yield, 0) - y)^2 + (noise ln(lag / USUAL_LAG_HZ) / LAG_SPREAD)^2

    The last term is a prior, because a first trial hardly separates delay and lag. Without a lag the inverse
    is wrong by half a turn on a machine of third order. Raises ValueError also if the best model fits less
    than LEAST_FIT_PERCENT.
    """
    first = identify(u, y, sample_time_s=sample_time_s)
    u, y = [np.asarray(a, float) for a in u], [np.asarray(b, float) for b in y]
    observable = [np.isfinite(b) for b in y]
    measured = np.concatenate([b[mask] for b, mask in zip(y, observable, strict=True)])
    e, span = first.extruder, float(np.quantile(measured, 0.95))

    def extruder(theta):
        gain, tau, lag = np.exp(theta[[0, 1, 3]]).tolist()
        return Extruder(gain, tau, float(theta[2]), lag, yield_=float(theta[4]) * span)

    def errors(theta):
        one = extruder(theta)
        flows = [flow(one, a, sample_time_s=sample_time_s) for a in u]
        left = [b[mask] for b, mask in zip(flows, observable, strict=True)]
        prior = first.noise * (theta[3] - np.log(USUAL_LAG_HZ)) / LAG_SPREAD
        return np.append(np.concatenate(left) - measured, prior)

    delay = max(e.delay_s - lag_delay_s(USUAL_LAG_HZ), 0.5 * sample_time_s)
    start = [np.log(e.gain), np.log(e.time_constant_s), delay, np.log(USUAL_LAG_HZ), e.yield_ / span]
    start[4] = float(np.clip(start[4], 1e-3, 0.9))
    low = [start[0] - 3, start[1] - 3, 0.0, np.log(LAG_HZ[0]), 0.0]
    high = [start[0] + 3, start[1] + 3, LONGEST_DELAY_S, np.log(LAG_HZ[1]), 1.0]
    fit = scipy.optimize.least_squares(
        errors, start, bounds=(low, high), x_scale=[0.1, 0.1, 0.02, 0.1, 0.02],
        diff_step=1e-4, xtol=1e-7, ftol=1e-9
    )  # fmt: skip
    model = _model(extruder(fit.x), fit.fun[:-1], measured)
    if model.fit_percent < LEAST_FIT_PERCENT:
        raise ValueError(
            "identify: expected a flow that follows the command but the best model fits "
            f"{model.fit_percent:.0f} %; check that command and frames are of the same trial and clock"
        )
    return model


def lag_delay_s(lag_hz: float) -> float:
    """Returns the delay of slow signals by the second-order lag, 2 zeta / w, in s."""
    return DAMPING / (np.pi * lag_hz)


def _coarse(
    predicted: Callable[[float, float, float, float], np.ndarray], measured: np.ndarray
) -> tuple[float, float, float]:
    """Returns gain, time constant and delay of the best first-order model on a grid. Raises ValueError if its
    gain is not above 0."""
    starts = []
    for tau in TIME_CONSTANTS_S:
        for delay in DELAYS_S:
            shape = predicted(1.0, tau, delay, 0.0)
            gain = shape @ measured / max(shape @ shape, np.finfo(float).tiny)
            starts.append((float(np.sum((gain * shape - measured) ** 2)), gain, tau, delay))
    _, gain, tau, delay = min(starts)
    if gain <= 0:
        raise ValueError(
            f"identify: expected a flow that rises with the command but found a best gain of {gain:.3g} "
            "mm^3/s per mm; check the command's sign and its clock against the frames'"
        )
    return gain, tau, delay


def deviations(
    model: TrialModel,
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    *,
    drift: float,
    trial_gain: float,
    sample_time_s: float,
) -> tuple[float, float, float, float]:
    """Returns one standard deviation of K (mm^3/s per mm), tau (s), delay (s) and yield (mm^3/s) of
    `identify` on the trials u, y.

    The estimate changes by J^+ w, with J the change of the predicted flow with the four parameters. w is the
    sum of white noise of the model's own r.m.s., a random walk whose r.m.s. over a trial is `drift` of the
    highest flow, and a share `trial_gain` of the flow itself. The residual of one trial does not show the
    last two.
    """
    e = model.extruder
    theta = np.array([e.gain, e.time_constant_s, e.delay_s, e.yield_])
    steps = np.array(
        [
            1e-4 * e.gain,
            1e-4 * e.time_constant_s,
            1e-2 * sample_time_s,
            1e-4 * e.gain * max(np.abs(a).max() for a in u),
        ]
    )

    def predicted(theta, a):
        K, tau, delay, yield_ = theta
        return flow(Extruder(K, tau, delay, e.lag_hz, yield_=yield_), a, sample_time_s=sample_time_s)

    J, ends = [], [0]
    for a, b in zip(u, y, strict=True):
        columns = [predicted(theta + h, a) - predicted(np.maximum(theta - h, 0.0), a) for h in np.diag(steps)]
        J.append(np.column_stack(columns)[np.isfinite(b)] / (steps + np.minimum(steps, theta)))
        ends.append(ends[-1] + len(J[-1]))
    gain_of = np.linalg.pinv(np.vstack(J))
    variance = model.noise**2 * np.sum(gain_of**2, axis=1)
    for j, (a, b) in enumerate(zip(u, y, strict=True)):
        part, flows = gain_of[:, ends[j] : ends[j + 1]], predicted(theta, a)
        # a walk is the sum of its steps: each step moves every later sample
        walk = drift * flows.max() * np.sqrt(2 / len(a)) * np.cumsum(part[:, ::-1], axis=1)
        variance += np.sum(walk**2, axis=1) + (trial_gain * part @ flows[np.isfinite(b)]) ** 2
    return tuple(float(v) for v in np.sqrt(variance))


def _check(u: list[np.ndarray], y: list[np.ndarray]) -> None:
    for j, flow_ in enumerate(y):
        if np.isfinite(flow_).sum() < 50:
            raise ValueError(
                f"identify: expected at least 50 observable samples of flow but trial {j} has "
                f"{np.isfinite(flow_).sum()}; check the frames of that trial"
            )
    if all(np.ptp(a) == 0 for a in u):
        raise ValueError(
            "identify: the command never moves, so neither gain nor delay is identified; "
            "record a trial with a start and a stop"
        )


def unmodelled(
    model: TrialModel,
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    frequency_hz: np.ndarray,
    *,
    sample_time_s: float,
) -> np.ndarray:
    """Returns |Delta(f)| (F,) of P = P_model (1 + Delta), from the trials that identified the model; 0 at
    frequencies that they do not excite.

        |Delta|^2 = (S_residual - S_noise) / S_flow

    The residual y - y_model is that of the whole model with its dead band. Each spectrum is summed over the
    trials and smoothed over SMOOTHED_HZ; S_noise is the level of the residual at the highest frequencies.
    Slow disturbances that do not repeat count as Delta, because one trial does not separate them from the
    machine. u (T,) in mm and y (T,) in mm^3/s of each trial, NaN where not observable; frequency_hz (F,).
    """
    n = max(len(a) for a in u)
    f = np.fft.rfftfreq(n, sample_time_s)
    residual, simulated = np.zeros(len(f)), np.zeros(len(f))
    for a, b in zip(u, y, strict=True):
        x = flow(model.extruder, np.asarray(a, float), sample_time_s=sample_time_s)
        left = np.where(np.isfinite(b), b - x, 0.0)
        residual += np.abs(np.fft.rfft(left, n)) ** 2
        simulated += np.abs(np.fft.rfft(x, n)) ** 2
    noise = float(np.mean(residual[f >= (1 - NOISE_SHARE) * f[-1]]))
    width = max(round(SMOOTHED_HZ / f[1]), 1)
    residual, simulated = (
        scipy.ndimage.uniform_filter1d(power, width, mode="nearest") for power in (residual, simulated)
    )
    power = np.maximum(residual - noise, 0.0) / np.maximum(simulated, np.finfo(float).tiny)
    delta = np.where(simulated >= EXCITED * noise, np.sqrt(power), 0.0)
    return np.interp(frequency_hz, f, delta)
