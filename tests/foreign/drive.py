"""The best that any command within a drive could reach on a foreign extruder, found from the true plant.

Linear plants: y = A^-1 B u with the poles of the plant and B from its impulse response, and the nearest
response is a convex problem. Monotone flow of a linear pressure: Gauss-Newton on it. Up and down apart: the
pressure's pole changes with its direction, which is iterated. Sticky: the plant without the seal bounds the
error from below.
"""

import math

import numpy as np
import scipy.signal

from pipeline.deposition import reachable
from pipeline.deposition.drive import Drive, obeyed
from pipeline.deposition.learning.ilc import rms
from tests.foreign.extruders import STEP_S, ForeignExtruder, flow

# Gauss-Newton steps of a plant that is not linear
STEPS = 12


def best(e: ForeignExtruder, r: np.ndarray, drive: Drive, Ts: float, start: np.ndarray) -> np.ndarray:
    """u (N,) in mm within the drive whose flow comes nearest to r (N,), sought from the command `start` (N,)
    on by Gauss-Newton steps, each halved until the true plant's error falls."""
    # without delay, beside the flow that is wanted so much later
    late, at = round(e.delay_s / STEP_S) * STEP_S / Ts, np.arange(len(r))
    e, r = e._replace(stick_mm=0.0, delay_s=0.0), np.interp(at + late, at, r, right=0.0)
    u, least = start, rms(r - flow(e, start, sample_time_s=Ts))
    for _ in range(STEPS):
        towards, length = _step(e, u, r, drive, Ts), 1.0
        error = rms(r - flow(e, towards, sample_time_s=Ts))
        while error > least and length > 0.05:
            length /= 2
            error = rms(r - flow(e, u + length * (towards - u), sample_time_s=Ts))
        gained = least - error
        if gained > 0:
            u, least = u + length * (towards - u), error
        if gained < 1e-4 * least:
            break
    return u


def _step(e: ForeignExtruder, u: np.ndarray, r: np.ndarray, drive: Drive, Ts: float) -> np.ndarray:
    """The best command for the plant linearised along that of u (N,)."""
    output, command, q = _pressure(e, u, Ts)
    ratio = np.maximum(q / e.level, 1e-3)
    x = e.gain * e.level * ratio**e.exponent - e.yield_
    y = np.maximum((x + np.sqrt(x**2 + e.soft**2)) / 2 - (math.hypot(e.yield_, e.soft) - e.yield_) / 2, 0.0)
    slope = e.exponent * ratio ** (e.exponent - 1) * (1 + x / np.sqrt(x**2 + e.soft**2)) / 2
    slope = np.clip(slope, 0.2, 3.0)
    # no flow below this pressure
    still = e.level * (e.yield_ / (e.gain * e.level)) ** (1 / e.exponent)
    target = np.where(r > 0, q + (r - y) / (e.gain * slope), still)
    z = reachable.nearest_response(
        target,
        r <= 0,
        output=output,
        command=command,
        bound=drive.amplitude_mm,
        step=drive.speed_mm_per_s * Ts,
        weight=np.where(r > 0, slope**2, 1.0),
    )
    return obeyed(_of(z, command), drive, sample_time_s=Ts)


def _pressure(e: ForeignExtruder, u: np.ndarray, Ts: float) -> tuple[list, list, np.ndarray]:
    """Taps B and A of the pressure q = B z, u = A z, along the command u (N,), and that q (N,): the mean over
    each sample."""
    if e.lags_s or e.creep:
        poles = [math.exp(-Ts / tau) for tau in (*e.lags_s, e.tau_up_s, *([e.creep_s] if e.creep else []))]
        A, linear = np.poly(poles), e._replace(gain=1.0, soft=1e-12)
        impulse = flow(linear, np.append(1.0, np.zeros(len(poles) + 1)), sample_time_s=Ts)
        B = np.convolve(A, impulse)[: len(poles) + 1]
        return list(B), list(A), scipy.signal.lfilter(B, A, u)
    a = {tau: math.exp(-Ts / tau) for tau in (e.tau_up_s, e.tau_down_s)}
    fine = round(Ts / STEP_S)
    mean = {tau: float(np.mean(a[tau] ** (np.arange(1, fine + 1) / fine))) for tau in a}
    p, pole, share, q = 0.0, np.empty(len(u)), np.empty(len(u)), np.empty(len(u))
    for k, value in enumerate(u.tolist()):
        tau = e.tau_up_s if value > p else e.tau_down_s
        pole[k], share[k] = a[tau], mean[tau]
        q[k] = value + (p - value) * mean[tau]
        p = value + (p - value) * a[tau]
    A = [1 / (1 - pole), -pole / (1 - pole)]
    return [(1 - share) * A[0], share + (1 - share) * A[1]], A, q


def _of(z: np.ndarray, taps: list) -> np.ndarray:
    """sum_k taps[k] z(t-k) (N,), from rest."""
    late = [np.concatenate([np.zeros(k), z[: len(z) - k]]) for k in range(len(taps))]
    return sum(tap * one for tap, one in zip(taps, late, strict=True))
