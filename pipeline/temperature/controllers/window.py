"""Model-based by least squares: a long VARX window fitted to the record is the state of a predictor, and the
Riccati equation gives the gains.

y(t) = Theta [u(t-1); ...; u(t-N); y(t-1); ...; y(t-N)] + theta_0 + e(t)

Nothing is assumed about the order of the plant; noise costs little, because the long window averages it as a
Kalman filter would (Chiuso 2007 on VARX and subspace methods).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg.lapack

from pipeline.temperature.controllers.kernel import Tuples, window_law, window_shift, windows
from pipeline.temperature.plant import Plant, observability_matrix
from pipeline.temperature.plant import plant as make_plant
from pipeline.temperature.tracking import Law, gains


class WindowModel(NamedTuple):
    """Theta (p, N (m+p)), theta_0 (p,), the innovation's covariance (p, p), and the table by which N was
    chosen: (past, parameters, criterion) rows."""

    Theta: np.ndarray
    theta_0: np.ndarray
    covariance: np.ndarray
    N: int
    samples: int
    table: np.ndarray


def learn(
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    *,
    longest: int,
    offset: bool = False,
    gain_spread: float = 0.0,
) -> WindowModel:
    """Least-squares VARX on segments u (T, m), y (T, p), its window N <= `longest` chosen by Akaike's
    criterion on the samples that the longest one leaves.

    One QR factorisation serves every N, because the columns are ordered lag by lag. With `gain_spread` sigma
    the predictor is the best on average over plants whose columns of B differ by a random 1 + sigma: of such
    a plant, (u / (1 + sigma), y) is a record too, so that the expected moments are those of the record plus
    sigma^2 times each input's own. It then leans on measured y where a long memory of u would carry a wrong
    gain along. Raises ValueError where the record is shorter than the shortest window needs.
    """
    w, _, y_now = windows(u, y, longest)
    m, p = u[0].shape[1], y[0].shape[1]
    samples = len(w)
    if samples <= 2 * (m + p + offset):
        raise ValueError(
            f"the window cannot be learned: expected more than {2 * (m + p + offset)} complete windows of "
            f"{longest} samples, found {samples}; record longer"
        )
    lags = [
        np.r_[lag * m : (lag + 1) * m, longest * m + lag * p : longest * m + (lag + 1) * p]
        for lag in range(longest)
    ]
    order = np.concatenate(lags)
    columns = np.hstack([np.ones((samples, int(offset))), w[:, order], y_now])
    triangle = _triangle(columns)
    table = np.array(
        [
            _criterion(triangle, offset, N, m, p, samples)
            for N in range(1, longest + 1)
            if 2 * (offset + N * (m + p)) < samples
        ]
    )
    N = int(table[table[:, 2].argmin(), 0])
    k = offset + N * (m + p)
    robust = (
        np.linalg.qr(
            np.vstack(
                [triangle[:, np.r_[:k, -p:0]], gain_spread * _own_moments(triangle[:, :k], offset, m, p)]
            ),
            mode="r",
        )
        if gain_spread
        else triangle
    )
    solution = np.linalg.lstsq(robust[:k, :k], robust[:k, -p:], rcond=1e-12)[0]
    rest = triangle[:, -p:] - triangle[:, :k] @ solution
    Theta = np.empty((p, N * (m + p)))
    by_lag = solution[offset:].reshape(N, m + p, p)
    Theta[:, : N * m] = by_lag[:, :m].transpose(2, 0, 1).reshape(p, N * m)
    Theta[:, N * m :] = by_lag[:, m:].transpose(2, 0, 1).reshape(p, N * p)
    return WindowModel(
        Theta, solution[0] if offset else np.zeros(p), rest.T @ rest / (samples - k), N, samples, table
    )


def _triangle(columns: np.ndarray) -> np.ndarray:
    """R of the QR factorisation: by Cholesky from the moments where those keep enough digits (a noisy
    record), by Householder reflections otherwise."""
    size = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    size[size == 0] = 1.0
    factor, failed = scipy.linalg.lapack.dpotrf(
        (columns.T @ columns) / size / size[:, None], lower=0, clean=1
    )
    return factor * size if not failed and np.diag(factor).min() > 1e-4 else np.linalg.qr(columns, mode="r")


def _own_moments(triangle: np.ndarray, offset: bool, m: int, p: int) -> np.ndarray:
    """Rows whose squares sum to each input's own second moment over its lags, inputs
    apart from one another; the outputs' columns stay 0."""
    k, rows = triangle.shape[1], []
    for channel in range(m):
        lags = np.arange(offset + channel, k, m + p)
        own = np.zeros((len(lags), k + p))
        own[:, lags] = np.linalg.qr(triangle[:, lags], mode="r")
        rows.append(own)
    return np.vstack(rows)


def _criterion(
    triangle: np.ndarray, offset: bool, N: int, m: int, p: int, samples: int
) -> tuple[int, int, float]:
    """Akaike's criterion of the window N, its residual read off the triangle; a residual below rounding
    counts as rounding, so that the shortest exact N wins."""
    k = offset + N * (m + p)
    rest, whole = triangle[k:, -p:], triangle[:, -p:]
    floor = 1e-20 * np.trace(whole.T @ whole) / samples
    logdet = np.log(np.maximum(np.linalg.eigvalsh(rest.T @ rest / samples), floor)).sum()
    return N, k * p, samples * logdet + 2 * k * p


def predictor(window: WindowModel, sample_time_s: float = 1.0) -> Plant:
    """The window as a plant in innovation form: x = w, A = shift + B_y Theta, B = B_u, C = Theta, K = B_y."""
    p = len(window.Theta)
    A, B_u, B_y = window_shift(window.Theta.shape[1] // window.N - p, p, window.N)
    return make_plant(
        A + B_y @ window.Theta,
        B_u,
        window.Theta,
        b=B_y @ window.theta_0,
        d=window.theta_0,
        K=B_y,
        sample_time_s=sample_time_s,
    )


def observer_form(window: WindowModel, sample_time_s: float = 1.0) -> tuple[Plant, np.ndarray]:
    """The same predictor with N p states instead of N (m+p), and T (N p, N (m+p)) with x = T w.

    x_i(t) = sum_{l >= i} A_l y(t - l + i - 1) + B_l u(t - l + i - 1), y = x_1 + theta_0, so that
    x_i(t+1) = A_i y + B_i u + x_{i+1}: the observer canonical form of a VARX model (Kailath 1980, 2.1).
    """
    N, p = window.N, len(window.Theta)
    m = window.Theta.shape[1] // N - p
    B_l, A_l = (
        part.reshape(p, N, -1).transpose(1, 0, 2)
        for part in (window.Theta[:, : N * m], window.Theta[:, N * m :])
    )
    of_y, B = A_l.reshape(N * p, p), B_l.reshape(N * p, m)
    C = np.eye(p, N * p)
    A = np.eye(N * p, k=p) + of_y @ C
    T = np.zeros((N * p, N * (m + p)))
    for i in range(N):
        for lag in range(N - i):
            rows = slice(i * p, (i + 1) * p)
            T[rows, lag * m : (lag + 1) * m] = B_l[i + lag]
            T[rows, N * m + lag * p : N * m + (lag + 1) * p] = A_l[i + lag]
    b = of_y @ window.theta_0
    return make_plant(A, B, C, b=b, d=window.theta_0, K=of_y, sample_time_s=sample_time_s), T


def law(window: WindowModel, Q: np.ndarray, R: np.ndarray, gamma: float, *, integral: float = 0.0) -> Law:
    """Optimal tracking (3) of the predictor: u = -K w - K_r r - k on
    the window of past inputs and outputs."""
    model, T = observer_form(window)
    K_x, K_r, k, _ = gains(model, Q, R, gamma)
    return window_law(K_x @ T, K_r, k, window.N, integral=integral)


def predicted_tuples(
    window: WindowModel,
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    *,
    horizon: int = 2,
    offset: bool = False,
) -> Tuples:
    """Tuples for Algorithm 2 whose state is not the noisy window but the
    directions of it that predict the next `horizon` outputs.

    x-hat = features [w; 1], from the singular vectors of (observability matrix of the predictor) x (root of
    the window's second moment), as in subspace identification. x-hat is uncorrelated with the noise still to
    come, so that the least squares of Algorithm 2 lose the bias that noise in the regressors causes. Kept are
    directions that move the outputs by more than twice the innovation: the value of a weaker one cannot be
    told from noise, and is not worth more.
    """
    w, u_now, y_now = windows(u, y, window.N)
    model = predictor(window)
    free = observability_matrix(model.A, model.C, horizon)
    centre = w.mean(axis=0) * offset
    power, axes = np.linalg.eigh((w - centre).T @ (w - centre) / len(w))
    left, sv, _ = np.linalg.svd(free @ (axes * np.sqrt(np.maximum(power, 0.0))), full_matrices=False)
    noise = np.sqrt(np.diag(window.covariance).max())
    order = int((sv > np.maximum(2 * noise, 1e-7 * sv[0])).sum())
    if order == 0:
        raise ValueError(
            "the window predicts nothing beyond the noise of the sensors; "
            "probe with a larger amplitude, or record longer"
        )
    T = left[:, :order].T @ free / sv[:order, None]
    A, B_u, B_y = window_shift(u_now.shape[1], y_now.shape[1], window.N)
    x_next = w @ (T @ A).T + u_now @ (T @ B_u).T + y_now @ (T @ B_y).T - T @ centre
    one = np.ones((len(w), int(offset)))
    features = np.zeros((order + offset, w.shape[1] + 1))
    features[:order, :-1], features[:order, -1], features[order:, -1] = T, -T @ centre, 1.0
    base = y_now.mean(axis=0) * offset
    return Tuples(
        np.hstack([(w - centre) @ T.T, one]),
        u_now,
        y_now - base,
        np.hstack([x_next, one]),
        features,
        window.N,
        base,
    )


def stored(window: WindowModel) -> dict[str, tuple[np.ndarray, str, str]]:
    """The window as named arrays with unit and meaning, for an artifact; `restored` reads them back."""
    return {
        "Theta": (
            window.Theta,
            "degC per percent | degC per degC",
            "one-step predictor on [u(t-1); ...; u(t-N); y(t-1); ...; y(t-N)]",
        ),
        "theta_0": (window.theta_0, "degC", "its constant"),
        "covariance": (window.covariance, "degC^2", "covariance of the innovation"),
        "N": (np.array(window.N), "steps", "length of the window"),
        "samples": (np.array(window.samples), "1", "complete windows that it was learned from"),
        "table": (window.table, "1", "per candidate: length, parameters, Akaike's criterion"),
    }


def restored(arrays: dict[str, np.ndarray]) -> WindowModel:
    return WindowModel(**{**arrays, "N": int(arrays["N"]), "samples": int(arrays["samples"])})
