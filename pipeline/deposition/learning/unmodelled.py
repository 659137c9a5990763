"""What an identified model does not know of the machine, as a multiplicative uncertainty of its frequency
response: the spectrum of the residual over that of the simulated flow."""

from collections.abc import Sequence

import numpy as np
import scipy.ndimage

from pipeline.deposition.extruder import flow
from pipeline.deposition.learning.trial_model import TrialModel

# spectra are smoothed over this width: a trial of starts and stops has zeros at single frequencies
SMOOTHED_HZ = 0.5
# the highest frequencies, this share of them, hold white noise alone
NOISE_SHARE = 0.5
# a frequency is excited where the simulated flow has this many times the power of the noise
EXCITED = 4.0


def unmodelled(
    model: TrialModel,
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    frequency_hz: np.ndarray,
    *,
    sample_time_s: float,
) -> np.ndarray:
    """|Delta(f)| (F,) of P = P_model (1 + Delta), from the trials that identified the model; 0 at frequencies
    that they do not excite.

        |Delta|^2 = (S_residual - S_noise) / S_flow

    The residual y - y_model is that of the whole model with its dead band, each spectrum summed over the
    trials and smoothed over SMOOTHED_HZ; S_noise is the level of the residual at the highest frequencies.
    What does not repeat and is slow counts as Delta: one trial does not tell it from the machine. u (T,) in
    mm and y (T,) in mm^3/s of each trial, NaN where not observable; frequency_hz (F,)."""
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
