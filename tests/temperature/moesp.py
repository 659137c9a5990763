"""The yardsticks of identification: past-output MOESP as SLICOT has it (Verhaegen 1994), and the
least-squares one-step predictor VARX."""

from typing import NamedTuple

import numpy as np

from pipeline.temperature.identification.refinement import fit_inputs
from pipeline.temperature.identification.subspace import Segments, complete_runs, lagged, one_step
from pipeline.temperature.plant import Plant, clip_spectral_radius
from pipeline.temperature.plant import plant as make_plant

GROWTH = (
    1e6  # a mode that grows more than this over a segment has lost the digits by which it could be fitted
)


class Varx(NamedTuple):
    """y(t) = sum_k B_k u(t-k) + A_k y(t-k) + constant + e(t), k = 1..past: B (past, p, m), A (past, p, p),
    constant (p,), covariance of e (p, p)."""

    B: np.ndarray
    A: np.ndarray
    constant: np.ndarray
    covariance: np.ndarray
    rows: int
    dropped_rows: int


def varx(u: Segments, y: Segments, past: int, *, offset: bool = True) -> Varx:
    """Least-squares one-step predictor of `past` samples (Chiuso 2007). Raises ValueError where the record
    has fewer complete windows than unknowns."""
    data = lagged(u, y, past, offset=offset)
    coefficients, errors = one_step(data, past)
    by_lag = coefficients.reshape(past, data.m + data.p, data.p).transpose(0, 2, 1)
    constant = data.means[0, data.m :] - np.einsum("kij,kj->i", by_lag, data.means[1:])
    freedom = data.rows - len(coefficients) - offset
    return Varx(
        by_lag[:, :, : data.m],
        by_lag[:, :, data.m :],
        constant,
        errors.T @ errors / freedom,
        data.rows,
        data.dropped_rows,
    )


def _future_past_factor(u: Segments, y: Segments, block_rows: int, offset: bool) -> np.ndarray:
    """R of [1, U_f, U_p, Y_p, Y_f] with block_rows samples of each, as SLICOT's IB01MD orders them; every run
    of complete samples adds its rows."""
    s, m, blocks = block_rows, u[0].shape[1], []
    for w in complete_runs(u, y):
        N = len(w) - 2 * s + 1
        if N > 0:
            hankel = [
                np.hstack([part[start + i : start + i + N] for i in range(s)])
                for part, start in ((w[:, :m], s), (w[:, :m], 0), (w[:, m:], 0), (w[:, m:], s))
            ]
            blocks.append(np.hstack([np.ones((N, int(offset))), *hankel]))
    rows, columns = sum(len(b) for b in blocks), 2 * s * (m + y[0].shape[1]) + offset
    if rows < columns:
        raise ValueError(
            f"the record is too short for {s} block rows: expected at least {columns} complete windows of "
            f"{2 * s} samples, found {rows}; record {columns - rows} samples more, or take fewer block rows"
        )
    return np.linalg.qr(np.vstack(blocks), mode="r")


def _moesp_svd(u: Segments, y: Segments, block_rows: int, offset: bool) -> tuple[np.ndarray, np.ndarray]:
    m, p, s = u[0].shape[1], y[0].shape[1], block_rows
    R = _future_past_factor(u, y, s, offset)
    first, last = s * m + offset, s * (2 * m + p) + offset
    U, singular_values, _ = np.linalg.svd(R[first:last, last:].T)
    return U, singular_values


def moesp_singular_values(u: Segments, y: Segments, block_rows: int, *, offset: bool = False) -> np.ndarray:
    """Singular values of the future outputs on the past, future inputs projected out (past-output MOESP);
    SLICOT's IB01AD prints the same (METH = 'M')."""
    return _moesp_svd(u, y, block_rows, offset)[1]


def moesp(
    u: Segments,
    y: Segments,
    block_rows: int,
    order: int,
    *,
    feedthrough: bool = True,
    offset: bool = False,
    sample_time_s: float = 1.0,
) -> tuple[Plant, list[np.ndarray]]:
    """Past-output MOESP: A, C from the shift of the extended observability matrix, then B, D, x0 by least
    squares on the simulation error (SLICOT's slmoesm).

    Returns the plant, without Kalman gain, and the initial state of each segment.
    """
    p = y[0].shape[1]
    if not 1 <= order <= (block_rows - 1) * p:
        raise ValueError(
            f"moesp: {block_rows} block rows of {p} outputs allow orders 1 to {(block_rows - 1) * p} but "
            f"{order} was asked for; take more block rows"
        )
    gamma = _moesp_svd(u, y, block_rows, offset)[0][:, :order]
    A = clip_spectral_radius(
        np.linalg.lstsq(gamma[:-p], gamma[p:], rcond=None)[0], GROWTH ** (1.0 / max(map(len, u)))
    )
    model = fit_inputs(A, gamma[:p], u, y, feedthrough=feedthrough, offset=offset)
    m = u[0].shape[1]
    return make_plant(
        model.F, model.G[:, :m], model.C, model.H[:, :m], model.G[:, m], model.H[:, m], None, sample_time_s
    ), model.x0
