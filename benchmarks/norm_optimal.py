"""The yardstick of norm-optimal learning, in O(N) time and memory (Amann,
Owens and Rogers 1996, without the lifted matrix)."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from pipeline.deposition.drive import Drive, obeyed
from pipeline.deposition.extruder import Extruder, lag_filter
from pipeline.deposition.ilc import Law, Trial


class Transfer(NamedTuple):
    """G = A^-1 B S^delay: A (q+1,) with A[0] = 1 and B (p+1,) hold the first columns of banded
    lower-triangular Toeplitz matrices, S is one sample of delay."""

    A: np.ndarray
    B: np.ndarray
    delay: int


class Plan(NamedTuple):
    """What `plan` sets up once for a reference of N samples and `step` uses at each trial; W (N,), R_u (N,),
    factor the banded Cholesky factor."""

    transfer: Transfer
    W: np.ndarray
    R_u: np.ndarray
    factor: np.ndarray


def transfer(extruder: Extruder, *, sample_time_s: float) -> Transfer:
    """The linear part of an extruder without creep as G = A^-1 B
    S^delay, exactly as `extruder.pressed` runs it."""
    delay, B, A = lag_filter(extruder.delay_s, extruder.lag_hz, sample_time_s)
    a = math.exp(-sample_time_s / extruder.time_constant_s)
    return Transfer(np.convolve(A, [1.0, -a]), extruder.gain * (1 - a) * np.trim_zeros(B, "b"), delay + 1)


def _apply(taps: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Toeplitz matrix of `taps` times x."""
    y = taps[0] * x
    for k, tap in enumerate(taps[1:], start=1):
        y[k:] += tap * x[: len(x) - k]
    return y


def _transposed(taps: np.ndarray, x: np.ndarray) -> np.ndarray:
    return _apply(taps, x[::-1])[::-1]


def _gram(taps: np.ndarray, weights: np.ndarray, width: int) -> np.ndarray:
    """T' diag(weights) T of the Toeplitz matrix T of `taps`, in lower banded form (width + 1, N): row m holds
    the m-th diagonal below the main one."""
    N = len(weights)
    ahead = np.concatenate([weights, np.zeros(len(taps))])
    band = np.zeros((width + 1, N))
    for m in range(len(taps)):
        for k in range(m, len(taps)):
            # entry (s + m, s): row t = s + k of T meets column s with
            # taps[k] and column s + m with taps[k - m]
            band[m] += taps[k] * taps[k - m] * ahead[k : k + N]
    return band


def plan(transfer: Transfer, *, W: np.ndarray, R_u: np.ndarray, R_d: np.ndarray) -> Plan:
    """Set-up for min over du of |e - G du|_W^2 + |u + du|_Ru^2 + |du|_Rd^2;
    W, R_u, R_d (N,) are the diagonals of the weights.

    With du = A z, A and B commute, so that G du = B S^d z and (B'WB + A'RA) z = B'W e - A'R_u u, R = R_u +
    R_d: banded, so banded Cholesky. Raises ValueError where R is zero at a sample that the delay keeps from
    acting, so that du is not determined.
    """
    W, R_u, R = np.asarray(W, float), np.asarray(R_u, float), np.asarray(R_u, float) + np.asarray(R_d, float)
    if not (W.shape == R.shape == R_u.shape and W.ndim == 1):
        raise ValueError(
            f"plan: expected weights of one length but found W {W.shape} and R {R.shape}; "
            "give one weight a sample"
        )
    if W.min() < 0 or R_u.min() < 0 or R.min() <= 0:
        raise ValueError(
            f"plan: expected W >= 0 and R_u + R_d > 0 but found least values {W.min():g} and {R.min():g}; "
            "raise R_d: the last samples of u act after the end"
        )
    width = max(len(transfer.A), len(transfer.B)) - 1
    # the delay: sample s of z acts at s + delay, so the weights move ahead and none is left at the end
    late = np.concatenate([W[transfer.delay :], np.zeros(min(transfer.delay, len(W)))])
    band = _gram(transfer.B, late, width) + _gram(transfer.A, R, width)
    return Plan(
        transfer,
        W,
        R_u,
        scipy.linalg.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False),
    )


def step(plan: Plan, u: np.ndarray, e: np.ndarray) -> np.ndarray:
    """du (N,) of the norm-optimal update u + du, from the command u (N,)
    that was applied and the error e (N,) that it left."""
    A, B, d = plan.transfer
    late = np.concatenate([(plan.W * e)[d:], np.zeros(min(d, len(e)))])
    g = _transposed(B, late) - _transposed(A, plan.R_u * u)
    z = scipy.linalg.cho_solve_banded((plan.factor, True), g, overwrite_b=True, check_finite=False)
    return _apply(A, z)


def norm_optimal_law(
    r: np.ndarray, model: Extruder, *, R_u: float, R_d: float, drive: Drive, sample_time_s: float
) -> Law:
    """u_{j+1} = u_j + argmin |e - G du|^2 + |u + du|_Ru^2 + |du|_Rd^2 of the last trial; R_u and R_d as
    shares of the squared steady gain of the model."""
    ones = np.ones(len(r))
    prepared = plan(
        transfer(model, sample_time_s=sample_time_s),
        W=ones,
        R_u=R_u * model.gain**2 * ones,
        R_d=R_d * model.gain**2 * ones,
    )

    def law(trials: Sequence[Trial]) -> np.ndarray:
        u, y, _ = trials[-1]
        following = u + step(prepared, u, np.where(np.isfinite(y), r - y, 0.0))
        return obeyed(following, drive, sample_time_s=sample_time_s)

    return law
