"""The nearest flow that a limited command can reach."""

import numpy as np
import scipy.linalg


def nearest(target: np.ndarray, free: np.ndarray, *, pole: float, bound: float) -> np.ndarray:
    """x (N,) from rest that is nearest to `target` (N,) among all with |x(t) - pole x(t-1)| <= bound: all
    that a first-order extruder can press.

    Where `free` (N,) is True only what lies above the target costs (no-flow: below the yield all is well).
    Newton's method on a log barrier (Boyd and Vandenberghe 2004, ch. 11); the Hessian is tridiagonal, so a
    step is O(N). x and bound in mm^3/s, bound = K (1 - pole) limit.
    """
    N, a, c = len(target), pole, bound
    s, x, band = target / c, np.zeros(N), np.zeros((2, N))
    barrier = 1.0
    while barrier > 1e-7:
        for _ in range(12):
            # a trace of weight below the target keeps x determined there
            w = np.where(~free | (x > s), 1.0, 1e-3)
            v = _rate(x, a)
            slack = 1 - v * v
            h = 2 * barrier * (1 + v * v) / slack**2
            gradient = w * (x - s) + _rate((2 * barrier * v / slack)[::-1], a)[::-1]
            band[0] = w + h
            band[0, :-1] += a * a * h[1:]
            band[1, :-1] = -a * h[1:]
            dx = -scipy.linalg.solveh_banded(band, gradient, lower=True, check_finite=False)
            dv = _rate(dx, a)
            # v stays within +-1: at most 0.95 of the way to the nearest bound
            reach = np.max(np.maximum(dv / (1 - v), -dv / (1 + v)))
            length = min(1.0, 0.95 / max(reach, 1e-300))
            x = x + length * dx
            if length == 1.0 and gradient @ -dx < 1e-3 * N * barrier:
                break
        barrier *= 0.1
    return c * x


def _rate(x: np.ndarray, pole: float) -> np.ndarray:
    """x(t) - pole x(t-1) (N,), from rest."""
    v = x.copy()
    v[1:] -= pole * x[:-1]
    return v
