"""Data-enabled predictive control in gamma form. No model is identified; the controller weights trajectories
of the record so that the coming trajectory costs least.

The columns of a block Hankel matrix are the samples t of the record: the past z = [1; u(t-1); ...; u(t-N);
y(t-1); ...; y(t-N)], coming inputs u_f = [u(t); ...; u(t+T-1)] and outputs y_f = [y(t+1); ...; y(t+T)]. One
LQ factorisation separates them, with uncorrelated entries of unit variance in gamma:

    [z  ]   [L11   0    0 ] [gamma_1]
    [u_f] = [L21  L22   0 ] [gamma_2]
    [y_f]   [L31  L32  L33] [gamma_3]

gamma_1 = L11^-1 z is known, and gamma_2 is chosen. gamma_3 is the part that neither past nor inputs explain,
and is set to zero. Then y_f = L31 gamma_1 + L32 gamma_2 is the least-squares predictor of each coming output.
Blocks of L32 above the diagonal are zero, because they belong to inputs later than the output. The law is

    min over gamma_2   sum over k = 0 ... T-1 of gamma^k (gamma |y(t+k+1) - r|^2_Q + |u(t+k)|^2_R)

in closed form. It is linear in the window, because limits, governor and integrator are outside it.

Breschi, Chiuso, Formentin, "Data-driven predictive control in a stochastic setting: a unified framework",
Automatica (2023), its LQ form; the zeros of L32 are those of Sader et al., "Causality-informed data-driven
predictive control", arXiv 2311.09545 (2023).
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from pipeline.temperature.controllers.kernel import window_law
from pipeline.temperature.tracking import Law

TINY = 1e-12  # avoids a division by 0 for a constant signal, which is refused later for its lack of movement
ROWS = 2  # least number of stretches of the record for each unknown of an output
SHORTEST = 5  # samples: the shortest horizon


class Trajectories(NamedTuple):
    """The factors of a record with m inputs and p outputs, in percent and °C.

    past (q, N (m+p) + 1) gives gamma_1 from the raw window and a constant, [w; 1]. L21 (T m, q) and L22 (T m,
    T m) give coming inputs from gamma_1 and gamma_2; L31 (T p, q) and L32 (T p, T m) give coming outputs.
    """

    past: np.ndarray
    L21: np.ndarray
    L22: np.ndarray
    L31: np.ndarray
    L32: np.ndarray
    N: int
    samples: int

    def stored(self) -> dict[str, tuple[np.ndarray, str, str]]:
        """The factors as named arrays with unit and meaning, for an artifact; `restored` reads them back."""
        return {name: (np.asarray(getattr(self, name)), *_STORED[name]) for name in self._fields}


_STORED = {
    "past": ("1 per percent | 1 per degC", "gamma_1 on the raw window and a constant"),
    "L21": ("percent", "coming inputs on gamma_1"),
    "L22": ("percent", "coming inputs on gamma_2"),
    "L31": ("degC", "coming outputs on gamma_1"),
    "L32": ("degC", "coming outputs on gamma_2"),
    "N": ("steps", "length of the raw window"),
    "samples": ("1", "stretches of the record that it was learned from"),
}


def restored(arrays: dict[str, Any]) -> Trajectories:
    """Returns the Trajectories from their `stored` arrays."""
    return Trajectories(**arrays)._replace(N=int(arrays["N"]), samples=int(arrays["samples"]))


def horizon(windows: int, segments: int, N: int, m: int, p: int, *, longest: int) -> int:
    """Returns the horizon T in samples: `longest`, or the longest one that half of every segment determines,
    so that a half can be compared with the whole. `windows`: complete windows of N samples in the record.
    Raises ValueError if T is less than SHORTEST."""
    least = ROWS * (1 + N * (m + p)) + segments * N
    T = min(longest, (windows // 2 - least) // (ROWS * m + segments))
    if T < SHORTEST:
        needed = 2 * (least + SHORTEST * (ROWS * m + segments))
        raise ValueError(
            f"predictive control cannot be learned: expected at least {needed} complete windows of {N} "
            f"samples for a horizon of {SHORTEST}, found {windows}; record {needed - windows} more samples"
        )
    return T


def hankel_rows(
    u: Sequence[np.ndarray], y: Sequence[np.ndarray], N: int, T: int, *, block: int = 2048
) -> Iterator[np.ndarray]:
    """Yields rows [u(t-1) ... u(t-N), y(t-1) ... y(t-N), u(t) ... u(t+T-1), y(t+1) ... y(t+T)] of the
    transposed Hankel matrix, at most `block` at a time. A row exists for every t for which all of them lie in
    one segment u (samples, m), y (samples, p) without a NaN."""
    past, coming = -np.arange(1, N + 1), np.arange(T)
    for inputs, outputs in zip(u, y, strict=True):
        instants = np.arange(N, len(inputs) - T)[:, None]
        for first in range(0, len(instants), block):
            t = instants[first : first + block]
            parts = inputs[t + past], outputs[t + past], inputs[t + coming], outputs[t + coming + 1]
            rows = np.hstack([part.reshape(len(t), -1) for part in parts])
            yield rows[np.isfinite(rows).all(axis=1)]


def learn(
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    N: int,
    T: int,
    *,
    gain_spread: float = 0.0,
    tolerance: float = 1e-9,
) -> Trajectories:
    """Computes the factors from segments u (samples, m), y (samples, p), in blocks of rows, so that memory
    grows with N and T but not with the record. Directions of z below `tolerance` of the largest are rounding.
    `gain_spread` as in window.learn. Raises ValueError if there are fewer rows than ROWS times the unknowns
    of an output, or if an input follows from the past."""
    m, p = u[0].shape[1], y[0].shape[1]
    k, of_u = 1 + N * (m + p), T * m
    signals = np.hstack([np.vstack(u), np.vstack(y)])
    of_column = np.concatenate(
        [np.tile(names, count) for count in (N, T) for names in (np.arange(m), np.arange(m, m + p))]
    )
    # z is counted from its mean, which separates the constant
    mean = np.where(np.arange(len(of_column)) < k - 1, np.nanmean(signals, axis=0)[of_column], 0.0)
    scale = np.maximum(np.nanstd(signals, axis=0), TINY)[of_column]
    triangle, samples = _triangle(hankel_rows(u, y, N, T), mean, scale)
    if samples < ROWS * (k + of_u):
        raise ValueError(
            f"predictive control cannot be learned: expected at least {ROWS * (k + of_u)} stretches of "
            f"{N + T + 1} samples for {k + of_u} unknowns an output, found {samples}; record longer without "
            "gaps"
        )
    if gain_spread:
        inputs = np.where(of_column < m, of_column, -1)
        own = triangle[:, 1:] + triangle[:, :1] * (mean / scale)
        more = [gain_spread * _alone(own, inputs == channel) for channel in range(m)]
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, *more]), mode="r"))
    triangle /= np.sqrt(samples)
    left, sv, Vt = np.linalg.svd(triangle[:k, :k])
    q = int((sv > tolerance * sv[0]).sum())
    turned = left.T @ triangle[:k, k:]
    lower = np.asarray(np.linalg.qr(np.vstack([turned[q:], triangle[k:, k:]]), mode="r")).T
    own = np.abs(np.diag(lower)[:of_u])
    if own.min() < tolerance:
        raise ValueError(
            f"predictive control cannot be learned: input {own.argmin() % m + 1} of {m} follows from the "
            "past of inputs and outputs, so that its effect cannot be told from theirs; move it while "
            "recording as no feedback does"
        )
    from_past = Vt[:q] / sv[:q, None]
    raw = from_past[:, 1:] / scale[: k - 1]
    past = np.column_stack([raw, from_past[:, 0] - raw @ mean[: k - 1]])
    unit_u, unit_y = np.split(scale[k - 1 :, None], [of_u])
    L21, L31 = np.split(turned[:q].T, [of_u])
    causal = np.kron(np.tri(T), np.ones((p, m)))
    return Trajectories(
        past,
        unit_u * L21,
        unit_u * lower[:of_u, :of_u],
        unit_y * L31,
        unit_y * lower[of_u:, :of_u] * causal,
        N,
        samples,
    )


def _triangle(blocks: Iterable[np.ndarray], mean: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, int]:
    """Returns R of the QR factorisation of [1, (rows - mean) / scale], computed one block of rows after the
    other, and the number of rows."""
    triangle, samples = np.zeros((0, 1 + len(mean))), 0
    for rows in blocks:
        columns = np.hstack([np.ones((len(rows), 1)), (rows - mean) / scale])
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, columns]), mode="r"))
        samples += len(rows)
    return triangle, samples


def _alone(triangle: np.ndarray, mine: np.ndarray) -> np.ndarray:
    """Returns rows whose squares sum to the second moment of the columns `mine` alone, with a constant of
    0."""
    rows = np.linalg.qr(triangle[:, mine], mode="r")
    alone = np.zeros((len(rows), 1 + len(mine)))
    alone[:, 1:][:, mine] = rows
    return alone


def law(learned: Trajectories, Q: np.ndarray, R: np.ndarray, gamma: float, *, integral: float = 0.0) -> Law:
    """Returns the first inputs of the cheapest trajectory as a law of the window, for weights Q (p, p) and R
    (m, m):

    gamma_2 = (L32'Q L32 + L22'R L22)^-1 (L32'Q (r - L31 gamma_1) - L22'R L21 gamma_1)
    u(t) = L21 gamma_1 + L22 gamma_2
    """
    past, L21, L22, L31, L32, N, _ = learned
    m, p, q = len(R), len(Q), len(past)
    discount = gamma ** np.arange(len(L21) // m)
    of_y, of_u = L32.T @ np.kron(np.diag(gamma * discount), Q), L22.T @ np.kron(np.diag(discount), R)
    wanted = np.tile(np.eye(p), (len(discount), 1))
    right = np.hstack([of_y @ L31 + of_u @ L21, -of_y @ wanted])
    choice = scipy.linalg.solve(of_y @ L32 + of_u @ L22, right, assume_a="pos")
    to_past = L22[:m] @ choice[:, :q] - L21[:m]
    K = to_past @ past
    return window_law(K[:, :-1], L22[:m] @ choice[:, q:], K[:, -1], N, integral=integral)
