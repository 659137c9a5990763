"""The best that any command within a drive could reach on a foreign extruder, found from the true plant.

Linear plants: y = A^-1 B u with the poles of the plant and B from its impulse response, and the nearest
response is a convex problem. Monotone flow of a linear pressure: Gauss-Newton on it. Up and down apart: the
pressure's pole changes with its direction, which is iterated. Sticky: the plant without the seal bounds the
error from below.
"""

import math
from collections.abc import Sequence

import numpy as np
import scipy.signal
import scipy.sparse
import scipy.sparse.linalg

from pipeline.deposition.drive import Drive, obeyed
from pipeline.deposition.learning.ilc import rms
from tests.foreign.extruders import STEP_S, ForeignExtruder, flow

# sum_k taps[k](t) z(t-k) from rest: each tap one number, or (N,) where it changes with time
Taps = Sequence[float | np.ndarray]
# Gauss-Newton steps of a plant that is not linear; Newton's at one barrier: 12 were too few for a limit of
# twice the steady command, and left 25 % more error than there need be
STEPS, MOST_STEPS = 12, 50


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
    z = nearest_response(
        target,
        r <= 0,
        output=output,
        command=command,
        bound=drive.amplitude_mm,
        step=drive.speed_mm_per_s * Ts,
        weight=np.where(r > 0, slope**2, 1.0),
    )
    return obeyed(_matrix(command, len(z)) @ z, drive, sample_time_s=Ts)


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


def nearest_response(
    target: np.ndarray,
    free: np.ndarray,
    *,
    output: Taps,
    command: Taps,
    bound: float,
    step: float = math.inf,
    weight: np.ndarray | float = 1.0,
    rest: np.ndarray | None = None,
) -> np.ndarray:
    """z (N,) from rest whose output y = B z is nearest to `target` (N,) among all whose command v = A z keeps
    |v(t)| <= bound and |v(t) - v(t-1)| <= step; A and B are the taps `command` and `output`.

    At least one limit is finite. y = A^-1 B v is any linear extruder of finite order, without the inverse: A
    and B are sparse, and so is the Hessian of Newton's method on a log barrier (Boyd and Vandenberghe 2004,
    ch. 11), which SciPy factorises. Where `free` (N,) is True only what lies above the target costs, and
    below it a trace of weight draws y to `rest`, or to the target; `weight` (N,) of the squares.
    """
    N = len(target)
    A, B = _matrix(command, N), _matrix(output, N)
    # the unit of z: of the size that the nearer limit leaves it
    still = abs(float(np.mean(sum(command))))
    c = min(bound / float(np.mean(command[0])), step / max(still, 1e-300))
    limits = [(A, bound), (_matrix((1.0, -1.0), N) @ A, step)]
    # |M z| <= 1, one below the other
    M = scipy.sparse.vstack([matrix * (c / most) for matrix, most in limits if math.isfinite(most)]).tocsr()
    s, z, barrier = target / c, np.zeros(N), 1.0
    below = s if rest is None else rest / c
    while barrier > 1e-7:
        for _ in range(MOST_STEPS):
            # a trace of weight below the target keeps z determined there
            y, v = B @ z, M @ z
            counts = ~free | (y > s)
            w, slack = weight * np.where(counts, 1.0, 1e-3), 1 - v * v
            gradient = B.T @ (w * (y - np.where(counts, s, below))) + M.T @ (2 * barrier * v / slack)
            curvature = scipy.sparse.diags(2 * barrier * (1 + v * v) / slack**2)
            H = B.T @ scipy.sparse.diags(np.broadcast_to(w, N)) @ B + M.T @ curvature @ M
            dz = -scipy.sparse.linalg.spsolve(H.tocsc(), gradient)
            # every bound holds: at most 0.95 of the way to the nearest
            dv = M @ dz
            reach = float(np.max(np.maximum(dv / (1 - v), -dv / (1 + v))))
            length = min(1.0, 0.95 / max(reach, 1e-300))
            z = z + length * dz
            if length == 1.0 and gradient @ -dz < 1e-3 * N * barrier:
                break
        barrier *= 0.1
    return c * z


def _matrix(taps: Taps, N: int) -> scipy.sparse.csr_matrix:
    """(N, N) with which z (N,) becomes sum_k taps[k](t) z(t-k), from rest."""
    bands = [np.broadcast_to(np.asarray(tap, float), N)[k:] for k, tap in enumerate(taps)]
    return scipy.sparse.diags(bands, [-k for k in range(len(taps))], format="csr")
