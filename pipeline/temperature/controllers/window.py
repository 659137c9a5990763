"""Model-based by least squares: a long VARX window is fitted to the record and serves as the state of a
predictor. The Riccati equation then gives the gains.

y(t) = Theta [u(t-1); ...; u(t-N); y(t-1); ...; y(t-N)] + theta_0 + e(t)

The order of the plant is not assumed. Noise costs little, because the long window averages it as a Kalman
filter would (Chiuso 2007 on VARX and subspace methods).
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
    """A VARX model: Theta (p, N (m+p)), theta_0 (p,), the covariance (p, p) of the innovation, and the table
    from which N was chosen, with rows (past, parameters, criterion)."""

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
    """Fits a VARX model by least squares to segments u (T, m), y (T, p). Akaike's criterion chooses its
    window N <= `longest`. All windows use the samples that are left for the longest one.

    One QR factorisation serves every N, because the columns are ordered lag by lag. With `gain_spread` sigma
    the predictor is the best on average over plants whose columns of B differ by a random factor 1 + sigma.
    For such a plant (u / (1 + sigma), y) is a record too, so the expected moments are those of the record
    plus sigma^2 times each input's own. The predictor then relies on measured y where a long memory of u
    would carry a wrong gain along. Raises ValueError if the record is shorter than the shortest window needs.
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
    """Returns R of the QR factorisation: by Cholesky from the moments if they keep enough digits (a noisy
    record), otherwise by Householder reflections."""
    size = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    size[size == 0] = 1.0
    factor, failed = scipy.linalg.lapack.dpotrf(
        (columns.T @ columns) / size / size[:, None], lower=0, clean=1
    )
    return factor * size if not failed and np.diag(factor).min() > 1e-4 else np.linalg.qr(columns, mode="r")


def _own_moments(triangle: np.ndarray, offset: bool, m: int, p: int) -> np.ndarray:
    """Returns rows whose squares sum to each input's own second moment over its lags, without products of
    different inputs. The columns of the outputs are 0."""
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
    """Returns (N, parameters, Akaike's criterion) of the window N, with its residual taken from the triangle.
    A residual below rounding counts as rounding, so the shortest exact N wins."""
    k = offset + N * (m + p)
    rest, whole = triangle[k:, -p:], triangle[:, -p:]
    floor = 1e-20 * np.trace(whole.T @ whole) / samples
    logdet = np.log(np.maximum(np.linalg.eigvalsh(rest.T @ rest / samples), floor)).sum()
    return N, k * p, samples * logdet + 2 * k * p


def predictor(window: WindowModel, sample_time_s: float = 1.0) -> Plant:
    """Returns the window as a plant in innovation form. The state is x = w, with A = shift + B_y Theta, B =
    B_u, C = Theta, K = B_y."""
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
    """Returns the same predictor with N p states instead of N (m+p), and T (N p, N (m+p)) with x = T w. This
    is the observer canonical form of a VARX model (Kailath 1980, 2.1):

    x_i(t) = sum_{l >= i} A_l y(t - l + i - 1) + B_l u(t - l + i - 1)
    y = x_1 + theta_0
    x_i(t+1) = A_i y + B_i u + x_{i+1}
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
    """Returns the law of optimal tracking (3) with the predictor: u = -K w - K_r r - k on the window w of
    past inputs and outputs. `Q` (p, p), `R` (m, m): weights; `gamma`: discount."""
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
    """Returns tuples for Algorithm 2. Their state is not the noisy window but the directions of it that
    predict the next `horizon` outputs.

    x-hat = features [w; 1], from the singular vectors of (observability matrix of the predictor) x (root of
    the window's second moment), as in subspace identification. x-hat is uncorrelated with the noise still to
    come, so the least squares of Algorithm 2 lose the bias that noise in the regressors causes. Only
    directions that move the outputs by more than twice the innovation are kept. The value of a weaker
    direction cannot be told from noise, and is not larger than the noise. Raises ValueError if there is no
    such direction.
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
    """Returns the window as named arrays with unit and meaning, for an artifact; `restored` reads them
    back."""
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
