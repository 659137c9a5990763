"""Subspace identification: PBSID with a Kalman gain (Chiuso 2007), over several segments.

Records are segments u (T, m), y (T, p). A NaN is a masked sample; every row whose window contains one is
dropped and counted. One triangular factor of the lagged record holds everything that PBSID needs, so neither
the order nor the horizon costs another pass over the samples.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from pipeline.temperature.plant import Plant
from pipeline.temperature.plant import plant as make_plant

ROUNDING = 1e-13  # relative ridge on second moments, as large as their own rounding
RANK = 1e-11  # directions of the record below this share of the largest are rounding
Segments = Sequence[np.ndarray]


class Lagged(NamedTuple):
    """Triangular factor R of the lagged record, w = [u; y] shifted and scaled, with the columns [u(t) if
    feed-through, w(t-1), ..., w(t-past), u(t) if not, y(t)].

    R'R is the second moment of those columns about their mean (with an offset) or about zero (without); means
    (past+1, m+p) holds the mean of w(t-lag) over the rows.
    """

    R: np.ndarray
    m: int
    p: int
    past: int
    feedthrough: bool
    means: np.ndarray
    rows: int
    dropped_rows: int
    exact: bool

    @property
    def now_u(self) -> np.ndarray:
        start = 0 if self.feedthrough else self.past * (self.m + self.p)
        return np.arange(start, start + self.m)

    @property
    def now_y(self) -> np.ndarray:
        return np.arange(self.R.shape[1] - self.p, self.R.shape[1])

    def lags(self, first: int, last: int) -> np.ndarray:
        """Returns the columns of w(t-first) ... w(t-last); lag 0 is w(t) itself."""
        q, start = self.m + self.p, self.m if self.feedthrough else 0
        past = [start + (lag - 1) * q + np.arange(q) for lag in range(max(first, 1), last + 1)]
        return np.concatenate([np.r_[self.now_u, self.now_y], *past] if first == 0 else past)


def complete_runs(u: Segments, y: Segments) -> list[np.ndarray]:
    """Returns the stretches w = [u, y] (L, m+p) of the segments in which nothing is masked."""
    runs = []
    for a, b in zip(u, y, strict=True):
        w = np.hstack([a, b])
        edges = np.flatnonzero(np.diff(np.r_[0, np.isfinite(w).all(axis=1), 0]))
        runs += [w[start:stop] for start, stop in zip(edges[::2], edges[1::2], strict=True)]
    return runs


def gapless(u: Segments, y: Segments) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Returns the segments cut where an input is masked, because no plant can be simulated with an unknown
    input. Pieces of one sample, or without a single y, are dropped."""
    us, ys = [], []
    for a, b in zip(u, y, strict=True):
        edges = np.flatnonzero(np.diff(np.r_[0, np.isfinite(a).all(axis=1), 0]))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            if stop - start > 1 and np.isfinite(b[start:stop]).any():
                us.append(a[start:stop])
                ys.append(b[start:stop])
    return us, ys


def lagged_moments(w: np.ndarray, past: int) -> np.ndarray:
    """Returns the sum over t = past..L-1 of z z', z = [w(t); w(t-1); ...; w(t-past)], for w (L, q).

    Only the first block row is a product over the samples; the rest follows from the shift

    S(i+1, j+1) = S(i, j) + w(past-1-i) w(past-1-j)' - w(L-1-i) w(L-1-j)'
    """
    L, q = w.shape
    S = np.empty((past + 1, q, past + 1, q))
    for j in range(past + 1):
        S[0, :, j] = w[past:].T @ w[past - j : L - j]
        S[j, :, 0] = S[0, :, j].T
    entering, leaving = w[:past][::-1], w[L - past :][::-1]  # w(past-1-j) and w(L-1-j) at j = 0..past-1
    for i in range(past):
        row = (
            S[i, :, i:past]
            + entering[i][:, None, None] * entering[i:]
            - leaving[i][:, None, None] * leaving[i:]
        )
        S[i + 1, :, i + 1 :] = row
        S[i + 1 :, :, i + 1] = row.transpose(1, 2, 0)
    return S.reshape((past + 1) * q, -1)


def _columns(m: int, p: int, past: int, feedthrough: bool) -> np.ndarray:
    """Returns the order of the columns of `Lagged`, as indices into z = [w(t); w(t-1); ...]."""
    q = m + p
    lags, now_u, now_y = np.arange(q, q * (past + 1)), np.arange(m), np.arange(m, q)
    return np.concatenate([now_u, lags, now_y] if feedthrough else [lags, now_u, now_y])


def lagged(
    u: Segments,
    y: Segments,
    past: int,
    *,
    feedthrough: bool = False,
    offset: bool = True,
    exact: bool = False,
) -> Lagged:
    """Returns the triangular factor of a record. An offset is estimated with every regression (Frisch-Waugh:
    the moments are taken about the mean of the same rows).

    `exact` uses the QR of the rows themselves, for records whose noise is below the root of rounding;
    otherwise Cholesky of the moments is used. Raises ValueError if there are too few windows of past + 1
    complete samples for the unknowns.
    """
    m, p = u[0].shape[1], y[0].shape[1]
    runs = [w for w in complete_runs(u, y) if len(w) > past]
    rows, unknowns = sum(len(w) - past for w in runs), past * (m + p) + m * feedthrough + offset
    if rows < unknowns + m + p:
        raise ValueError(
            f"the record is too short for a window of {past} samples: "
            f"expected at least {unknowns + m + p} complete windows, found {rows};"
            f" record {unknowns + m + p - rows} samples more, or shorten the window"
        )
    shift = sum(w.sum(axis=0) for w in runs) / sum(len(w) for w in runs) if offset else np.zeros(m + p)
    runs = [w - shift for w in runs]
    sums = sum(np.array([w[past - lag : len(w) - lag].sum(axis=0) for lag in range(past + 1)]) for w in runs)
    R = (_exact_factor if exact else _moment_factor)(
        runs, past, _columns(m, p, past, feedthrough), sums.ravel() / rows * offset, rows
    )
    possible = sum(max(len(a) - past, 0) for a in u)
    return Lagged(R, m, p, past, feedthrough, (shift + sums / rows) * offset, rows, possible - rows, exact)


def _moment_factor(runs, past, columns, mean, rows) -> np.ndarray:
    S = sum(lagged_moments(w, past) for w in runs) - rows * np.outer(mean, mean)
    S = S[np.ix_(columns, columns)]
    scale = np.sqrt(np.maximum(np.diag(S), np.finfo(float).tiny))
    try:
        return np.linalg.cholesky(S / np.outer(scale, scale) + ROUNDING * np.eye(len(S))).T * scale
    except np.linalg.LinAlgError:
        # a channel moves less than its mean rounds, so the rows themselves are used, with the same ridge
        return np.linalg.qr(
            np.vstack([_exact_factor(runs, past, columns, mean, rows), np.sqrt(ROUNDING) * np.diag(scale)]),
            mode="r",
        )


def _exact_factor(runs, past, columns, mean, rows) -> np.ndarray:
    z = np.vstack([np.hstack([w[past - lag : len(w) - lag] for lag in range(past + 1)]) for w in runs]) - mean
    return np.linalg.qr(z[:, columns], mode="r")


def one_step(data: Lagged, past: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the coefficients (features, p) of the one-step predictor with the first `past` lags (and u(t)
    with feed-through), and its errors as rows of the factor."""
    features = np.concatenate([data.now_u if data.feedthrough else [], data.lags(1, past)]).astype(int)
    k = len(features)  # the features are the first columns, so the factor already belongs to them
    if data.exact:
        coefficients = np.linalg.lstsq(data.R[:, features], data.R[:, data.now_y], rcond=RANK)[0]
    else:
        coefficients = scipy.linalg.solve_triangular(data.R[:k, :k], data.R[:k, data.now_y])
    return coefficients, data.R[:, data.now_y] - data.R[:, features] @ coefficients


def subspace(data: Lagged, future: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the basis of PBSID-opt (Chiuso 2007), with states = basis[:n] z for order n, and all singular
    values in units of noise. Both come from the singular value decomposition of the predictor's coefficients,
    shifted into Gamma_f K and weighted by the noise, times the past.

    Row block i holds the coefficients of lags i+1, i+2, ... : the effect that the past still has i steps
    ahead. The error of the coefficients adds about as much to the singular values as a (future p) x (past
    (m+p)) matrix of unit noise does, at most sqrt(future p) + sqrt(past (m+p)).
    """
    q, p, past = data.m + data.p, data.p, data.past
    coefficients, errors = one_step(data, past)
    first = data.m if data.feedthrough else 0
    S = errors.T @ errors / data.rows
    whiten = np.linalg.inv(
        np.linalg.cholesky(S + ROUNDING * np.diag(np.diag(S)) + np.eye(p) * np.finfo(float).tiny)
    )
    phi = whiten @ coefficients[first:].T
    extended = np.zeros((future, p, past * q))
    for i in range(future):
        extended[i, :, : (past - i) * q] = phi[:, i * q :]
    extended = extended.reshape(future * p, past * q)
    U, singular_values, _ = np.linalg.svd(extended @ data.R[:, data.lags(1, past)].T, full_matrices=False)
    basis = (U.T @ extended) / np.sqrt(np.maximum(singular_values, np.finfo(float).tiny))[:, None]
    return basis, singular_values


def _least_squares(regressors: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns Theta with target = regressors Theta'. Columns are scaled first, so that the rank test does not
    depend on units."""
    scale = np.linalg.norm(regressors, axis=0)
    scale[scale == 0] = 1.0
    return (np.linalg.lstsq(regressors / scale, target, rcond=RANK)[0] / scale[:, None]).T


def realise(
    data: Lagged, basis: np.ndarray, sample_time_s: float, direct: Sequence[bool] | None = None
) -> Plant:
    """Returns the plant whose states are basis (n, past (m+p)) times the past: C, D from y, then A, B, K from
    the states one step later, all by least squares.

    `direct` (p,) marks the outputs with a row of D in a record factored with feed-through; None marks all.
    """
    n, m = len(basis), data.m
    x, x_next = data.R[:, data.lags(1, data.past)] @ basis.T, data.R[:, data.lags(0, data.past - 1)] @ basis.T
    u, y = data.R[:, data.now_u], data.R[:, data.now_y]
    CD = _least_squares(np.hstack([x, u]) if data.feedthrough else x, y)
    C, D = CD[:, :n], CD[:, n:] if data.feedthrough else np.zeros((data.p, m))
    if data.feedthrough and direct is not None and not all(direct):
        proper = ~np.asarray(direct, bool)
        C[proper], D[proper] = _least_squares(x, y[:, proper]), 0.0
    if data.exact:
        # errors are rounding and do not determine K; the window's own predictor has the gain of y(t-1)
        AB = _least_squares(np.hstack([x, u]), x_next)
        A, B, K = AB[:, :n], AB[:, n:], basis[:, m : m + data.p]
    else:
        ABK = _least_squares(np.hstack([x, u, y - x @ C.T - u @ D.T]), x_next)
        A, B, K = ABK[:, :n], ABK[:, n : n + m], ABK[:, n + m :]
    u_mean, y_mean = data.means[0, :m], data.means[0, m:]
    drift = basis @ (data.means[:-1] - data.means[1:]).ravel()
    return make_plant(A, B, C, D, drift - B @ u_mean, y_mean - D @ u_mean, K, sample_time_s)
