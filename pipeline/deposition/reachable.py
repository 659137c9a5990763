"""The nearest flow that a drive of limited travel and speed can reach."""

import math

import numpy as np
import scipy.linalg

# v = x(t) - pole x(t-1) is the command, v(t) - v(t-1) its change; both from rest
Difference = tuple[float, ...]
# of Newton's method at one barrier: 12 were too few for a limit of twice the steady command, and left 25 %
# more error than there need be
MOST_STEPS = 50


def nearest(
    target: np.ndarray, free: np.ndarray, *, pole: float, bound: float, step: float = math.inf
) -> np.ndarray:
    """x (N,) from rest that is nearest to `target` (N,) among all with |v(t)| <= bound and |v(t) - v(t-1)| <=
    step, v(t) = x(t) - pole x(t-1): all that a first-order extruder can press.

    Where `free` (N,) is True only what lies above the target costs (no-flow: below the yield all is well).
    Newton's method on a log barrier (Boyd and Vandenberghe 2004, ch. 11); the Hessian has two or, with a
    step, three bands, so an iteration is O(N). x, bound and step in mm^3/s: K (1 - pole) times the
    amplitude, and times the speed and the sample time.
    """
    limits = [((1.0, -pole), bound), ((1.0, -(1 + pole), pole), step)]
    limits = [(difference, most) for difference, most in limits if math.isfinite(most)]
    if not limits:
        return np.array(target, float)
    N, c = len(target), min(bound, step / (1 - pole))
    within = [(difference, most / c) for difference, most in limits]
    s, x, barrier = target / c, np.zeros(N), 1.0
    while barrier > 1e-7:
        for _ in range(MOST_STEPS):
            # a trace of weight below the target keeps x determined there
            w = np.where(~free | (x > s), 1.0, 1e-3)
            gradient, band = w * (x - s), np.zeros((len(within[-1][0]), N))
            band[0] = w
            for difference, most in within:
                v = _of(x, difference) / most
                slack = 1 - v * v
                gradient += _back(2 * barrier * v / slack / most, difference)
                _add_squares(band, 2 * barrier * (1 + v * v) / slack**2 / most**2, difference)
            dx = -scipy.linalg.solveh_banded(band, gradient, lower=True, check_finite=False)
            # every bound holds: at most 0.95 of the way to the nearest
            reach = max(_reach(_of(x, d) / most, _of(dx, d) / most) for d, most in within)
            length = min(1.0, 0.95 / max(reach, 1e-300))
            x = x + length * dx
            if length == 1.0 and gradient @ -dx < 1e-3 * N * barrier:
                break
        barrier *= 0.1
    return c * x


def _of(x: np.ndarray, difference: Difference) -> np.ndarray:
    """sum_k difference[k] x(t-k) (N,), from rest."""
    v = difference[0] * x
    for k, weight in enumerate(difference[1:], 1):
        v[k:] += weight * x[:-k]
    return v


def _back(y: np.ndarray, difference: Difference) -> np.ndarray:
    """The transpose of `_of` on y (N,)."""
    return _of(y[::-1], difference)[::-1]


def _add_squares(band: np.ndarray, h: np.ndarray, difference: Difference) -> None:
    """Adds D' diag(h) D to the lower bands (B, N), D the matrix of `_of`; h (N,)."""
    N = len(h)
    for i, first in enumerate(difference):
        for k in range(i + 1):
            # row t of D holds difference[i] in column t - i and difference[k] in column t - k
            band[i - k, : N - i] += first * difference[k] * h[i:]


def _reach(v: np.ndarray, dv: np.ndarray) -> float:
    """How far a step dv (N,) goes towards the nearer of the bounds +-1 of v (N,), as a share of the way."""
    return float(np.max(np.maximum(dv / (1 - v), -dv / (1 + v))))
