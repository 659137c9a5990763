"""Learns the kernel of the value function from recorded inputs and outputs alone: Algorithm 2 of seed 1, and
the same problem whitened, for any reference.

State: s = [u(t-1); ...; u(t-N); y(t-1); ...; y(t-N)], action u, v = [s; u], value v'H v (31). The published
form uses (84 x 84) Kronecker products for each sample. Here half-vectors on the range of the data do the
same: one Gram matrix, one operator G, and value iteration that does not need the samples again.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.linalg.blas
import scipy.linalg.lapack

from pipeline.temperature.tracking import Law

ROOT2 = np.sqrt(2.0)


def svec(S: np.ndarray) -> np.ndarray:
    """Returns the half-vector of a symmetric S (d, d): the upper triangle by rows, with off-diagonal entries
    times sqrt 2, so that svec(S) . svec(T) = trace(S T)."""
    i, j = np.triu_indices(len(S))
    return S[i, j] * np.where(i == j, 1.0, ROOT2)


def smat(h: np.ndarray, d: int) -> np.ndarray:
    """Returns the symmetric (d, d) matrix with half-vector h."""
    i, j = np.triu_indices(d)
    S = np.empty((d, d))
    S[i, j] = S[j, i] = h / np.where(i == j, 1.0, ROOT2)
    return S


def skron(X: np.ndarray) -> np.ndarray:
    """Returns skron(X) (a (a+1)/2, d (d+1)/2) with svec((X z)(X z)') = skron(X) svec(z z'), for X (a, d)."""
    (p, q), (k, j) = np.triu_indices(X.shape[0]), np.triu_indices(X.shape[1])
    product = X[p][:, k] * X[q][:, j]
    off = k != j
    product[:, off] = (product[:, off] + X[p][:, j[off]] * X[q][:, k[off]]) / ROOT2
    return product * np.where(p == q, 1.0, ROOT2)[:, None]


def quadratic_gram(Z: np.ndarray, *, block: int = 1024) -> np.ndarray:
    """Returns the sum over samples of svec(z z') svec(z z')' for Z (d, samples), accumulated in blocks, so
    that memory does not grow with the number of samples."""
    d, samples = Z.shape
    i, j = np.triu_indices(d)
    gram, features = np.zeros((len(i), len(i)), order="F"), np.empty((len(i), block))
    starts = np.concatenate([[0], np.cumsum(np.arange(d, 0, -1))])
    for first in range(0, samples, block):
        z = np.ascontiguousarray(Z[:, first : first + block])
        phi = features[:, : z.shape[1]]
        for row in range(d):
            np.multiply(z[row], z[row:], out=phi[starts[row] : starts[row + 1]])
        gram = scipy.linalg.blas.dsyrk(1.0, phi.T, beta=1.0, c=gram, trans=1, lower=1, overwrite_c=1)
    weight = np.where(i == j, 1.0, ROOT2)
    gram += np.tril(gram, -1).T
    return gram * weight * weight[:, None]


# ---- data -> regression


class Tuples(NamedTuple):
    """One row per sample: state s (samples, k), input u (samples, m), error e (samples, p), successor s_next
    (samples, k).

    s = features [w; 1]: `features` (k, N (m+p) + 1) maps the raw window w and a constant, so that a gain on s
    is a gain on w. e = y - base: the noise of the regression is 2 e'Q times the sensors' noise, so a base
    (p,) close to the recorded outputs makes it small.
    """

    s: np.ndarray
    u: np.ndarray
    e: np.ndarray
    s_next: np.ndarray
    features: np.ndarray
    N: int
    base: np.ndarray


def window_shift(m: int, p: int, N: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns A, B_u, B_y with w(t+1) = A w + B_u u + B_y y for the window w = [u(t-1); ...; u(t-N); y(t-1);
    ...; y(t-N)]."""
    A = scipy.linalg.block_diag(np.eye(N * m, k=-m), np.eye(N * p, k=-p))
    B_u, B_y = np.zeros((N * (m + p), m)), np.zeros((N * (m + p), p))
    B_u[:m], B_y[N * m : N * m + p] = np.eye(m), np.eye(p)
    return A, B_u, B_y


def windows(
    u: Sequence[np.ndarray], y: Sequence[np.ndarray], N: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns windows (samples, N (m+p)), u and y of every row whose window is complete within its segment
    and free of NaN (masked samples). Raises ValueError if no segment is longer than N."""
    rows = []
    for us, ys in zip(u, y, strict=True):
        if len(us) > N:
            past = [signal[N - lag : len(us) - lag] for signal in (us, ys) for lag in range(1, N + 1)]
            rows.append(np.hstack([*past, us[N:], ys[N:]]))
    if not rows:
        raise ValueError(
            f"no segment is longer than the window of {N} samples; lower the window, "
            "or record a longer stretch without gaps"
        )
    m, p = u[0].shape[1], y[0].shape[1]
    table = np.vstack(rows)
    table = table[np.isfinite(table).all(axis=1)]
    return table[:, : N * (m + p)], table[:, N * (m + p) : N * (m + p) + m], table[:, N * (m + p) + m :]


def tuples(u: Sequence[np.ndarray], y: Sequence[np.ndarray], N: int, *, offset: bool = False) -> Tuples:
    """Returns the tuples of segments u (T, m), y (T, p). s holds no reference, so they serve for any.
    `offset` puts a constant 1 into s (ambient, operating point); e is then counted from the mean of y."""
    w, u_now, y_now = windows(u, y, N)
    A, B_u, B_y = window_shift(u_now.shape[1], y_now.shape[1], N)
    one = np.ones((len(w), int(offset)))
    w_next = w @ A.T + u_now @ B_u.T + y_now @ B_y.T
    features = np.eye(w.shape[1] + offset, w.shape[1] + 1)
    base = y_now.mean(axis=0) * offset
    return Tuples(np.hstack([w, one]), u_now, y_now - base, np.hstack([w_next, one]), features, N, base)


class Regression(NamedTuple):
    """What the data say, for any weights, in the coordinates v = [W s; u / u_scale] with q = len(W) whitened
    states:

    E[svec(s s')(t+1) | v] = svec(v v')' (skron(step)' + G)
    E[svec(e e') | v] = svec(v v')' G_e
    E[svec(u u') | v] = svec(v v')' G_u
    E[s(t+1) | v] = step v
    E[e | v] = output v

    W maps the raw window and a constant, [w; 1], to the whitened state. `unknowns` half-vector entries are
    identifiable and need at least as many samples; the published form has `entries`. `condition` is the
    condition number of the Gram matrix.
    """

    G: np.ndarray
    G_e: np.ndarray
    G_u: np.ndarray
    step: np.ndarray
    output: np.ndarray
    W: np.ndarray
    u_scale: np.ndarray
    base: np.ndarray
    N: int
    singular_values: np.ndarray
    rank: int
    unknowns: int
    entries: int
    samples: int
    condition: float

    def stored(self) -> dict[str, tuple[np.ndarray, str, str]]:
        """Returns the regression as named arrays with unit and meaning, for an artifact; `restored` reads
        them back."""
        return {name: (np.asarray(getattr(self, name), float), *_STORED[name]) for name in self._fields}


_STORED = {
    "G": (
        "1",
        "half-vector of the whitened state's second moment a step later, beyond skron(step), on that of v; "
        "empty where nothing is beyond",
    ),
    "G_e": ("degC^2", "half-vector of e e' on that of v"),
    "G_u": ("percent^2", "half-vector of u u' on that of v"),
    "step": ("1", "whitened state a step later, on v"),
    "output": ("degC", "e on v"),
    "W": ("1 per degC | 1 per percent", "whitened state on the raw window and a constant"),
    "u_scale": ("percent", "scale of u in v"),
    "base": ("degC", "what e is counted from"),
    "N": ("steps", "length of the raw window"),
    "singular_values": ("degC | percent", "of the state over the record, r.m.s."),
    "rank": ("1", "length of v"),
    "unknowns": ("1", "identifiable entries of the kernel"),
    "entries": ("1", "entries of the kernel in the published form"),
    "samples": ("1", "complete windows"),
    "condition": ("1", "of the scaled Gram matrix"),
}


def restored(arrays: dict[str, np.ndarray]) -> Regression:
    """Returns the Regression from its `stored` arrays."""
    whole = ("N", "rank", "unknowns", "entries", "samples")
    return Regression(
        **{
            name: int(value) if name in whole else float(value) if name == "condition" else value
            for name, value in arrays.items()
        }
    )


def whitening(s: np.ndarray, s_next: np.ndarray, *, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns W (q, k), which maps s to its range and makes its second moment the identity, computed from s
    and its successor together; and all singular values (r.m.s.)."""
    triangle = np.linalg.qr(np.vstack([s, s_next]), mode="r") / np.sqrt(2 * len(s))
    _, sv, Vt = np.linalg.svd(triangle)
    q = int((sv > tolerance * sv[0]).sum())
    return Vt[:q] / sv[:q, None], sv


def regress(data: Tuples, *, mu: float = 0.0, tolerance: float = 1e-9, limit: float = 1e13) -> Regression:
    """Solves the least squares of Algorithm 2, steps 2-8, on the range of the data, once for all weights,
    references and iterations.

    `mu`: the published ridge on vec(H) in the coordinates of s and u, carried through the whitening.
    Directions of s below `tolerance` of the largest are rounding. Raises ValueError if the data do not
    determine the kernel, or the condition number exceeds `limit`; the message says what is missing.
    """
    (samples, k), m, p = data.s.shape, data.u.shape[1], data.e.shape[1]
    W, sv = whitening(data.s, data.s_next, tolerance=tolerance)
    q = len(W)
    u_scale = np.sqrt((data.u**2).mean(axis=0))
    unknowns = (q + m) * (q + m + 1) // 2
    _refuse(data, W, u_scale, unknowns, samples, mu, tolerance)
    v = np.hstack([data.s @ W.T, data.u / u_scale])
    targets = np.hstack([data.s_next @ W.T, data.e])
    linear = np.linalg.lstsq(v, targets, rcond=None)[0]
    innovation, share = _innovation(targets - v @ linear, np.sqrt((targets**2).mean(axis=0)), tolerance)
    # regressor j = [v; innovation] of one sample: s(t+1), e and u are linear in it, so that one Gram matrix
    # of its half-vectors serves for every right-hand side
    of_j = np.hstack([linear.T, share])
    action = np.hstack([np.zeros((m, q)), np.diag(u_scale), np.zeros((m, innovation.shape[1]))])
    gram = quadratic_gram(np.hstack([v, innovation]).T)
    row, column = np.triu_indices(of_j.shape[1])
    of_v = (row < q + m) & (column < q + m)
    inside, outside = np.flatnonzero(of_v), np.flatnonzero(~of_v)
    wanted = np.vstack([skron(of_j[:q]), skron(of_j[q:]), skron(action)])
    normal = gram[np.ix_(inside, inside)]
    # the part that is linear in v regresses on itself, so only the shares of the innovation and of the ridge
    # must be solved for
    rest = gram[np.ix_(inside, outside)] @ wanted[:, outside].T
    if mu:
        ridge = _ridge(mu, W, u_scale, row[inside], column[inside])
        normal[np.diag_indices_from(normal)] += ridge
        rest -= ridge[:, None] * wanted[:, inside].T
    solution, condition = _solve(
        normal, rest if mu or len(outside) else rest[:, :0], limit, samples, unknowns
    )
    squares = q * (q + 1) // 2
    G = solution[:, :squares]
    own = wanted[squares:, inside].T + (solution[:, squares:] if solution.size else 0.0)
    G_e, G_u = np.split(own, [p * (p + 1) // 2], axis=1)
    return Regression(
        G,
        G_e,
        G_u,
        linear.T[:q],
        linear.T[q:],
        W @ data.features,
        u_scale,
        data.base,
        data.N,
        sv,
        q + m,
        unknowns,
        (k + m) * (k + m + 1) // 2,
        samples,
        condition,
    )


def _ridge(mu: float, W: np.ndarray, u_scale: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Returns the ridge mu on the entries (row, column) of the kernel of [s; u], in the whitened
    coordinates."""
    size = np.concatenate([1 / np.linalg.norm(W, axis=1), u_scale])
    return mu / (size[row] * size[column]) ** 2


def _innovation(residual: np.ndarray, size: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the part of successor and error that v does not explain, as uncorrelated columns of unit
    variance, and the share of each in the targets: residual = innovation share'."""
    _, sv, Vt = np.linalg.svd(np.linalg.qr(residual, mode="r") / np.sqrt(len(residual)))
    rank = int((sv > tolerance * size.max()).sum())
    return residual @ Vt[:rank].T / sv[:rank], Vt[:rank].T * sv[:rank]


def _solve(
    normal: np.ndarray, right: np.ndarray, limit: float, samples: int, unknowns: int
) -> tuple[np.ndarray, float]:
    """Solves the normal equations by Cholesky after Jacobi scaling. Returns the solution and the condition
    number of the scaled matrix: LAPACK's estimate to six digits, because the last of sixteen depends on where
    in memory the factor lies. Raises ValueError if it exceeds `limit`."""
    size = np.diag(normal)
    scale = 1 / np.sqrt(np.where(size > 0, size, 1.0))
    scaled = normal * scale * scale[:, None]
    factor, failed = scipy.linalg.lapack.dpotrf(scaled, lower=1)
    reciprocal = (
        0.0 if failed else scipy.linalg.lapack.dpocon(factor, np.abs(scaled).sum(axis=0).max(), uplo="L")[0]
    )
    if reciprocal * limit < 1:
        raise ValueError(
            "the record does not determine the kernel: expected a Gram matrix of condition below "
            f"{limit:.0e} for {unknowns} unknowns, "
            f"found {'a singular one' if failed else f'{1 / reciprocal:.0e}'} from {samples} samples; "
            "probe with more levels or frequencies, or record longer"
        )
    solution, _ = scipy.linalg.lapack.dpotrs(factor, np.asfortranarray(scale[:, None] * right), lower=1)
    return scale[:, None] * solution, float(f"{1 / reciprocal:.5e}")


def _refuse(
    data: Tuples, W: np.ndarray, u_scale: np.ndarray, unknowns: int, samples: int, mu: float, tolerance: float
) -> None:
    """Raises ValueError that names what is missing: an input is constant, an input follows from the window,
    or there are too few samples."""
    silent = np.flatnonzero((u_scale == 0) | (np.ptp(data.u, axis=0) == 0))
    if silent.size:
        raise ValueError(
            f"the kernel cannot be learned: input {silent[0] + 1} of {len(u_scale)} is constant in the "
            "record; move every input while recording"
        )
    if samples < unknowns and mu == 0:
        raise ValueError(
            f"the kernel cannot be learned: expected at least {unknowns} samples for its {unknowns} "
            f"unknowns, found {samples}; "
            f"record {unknowns - samples} more, or lower the window below {data.N}"
        )
    if mu:
        return  # the ridge determines what the record does not
    v = np.hstack([data.s @ W.T, data.u / u_scale])
    _, sv, Vt = np.linalg.svd(np.linalg.qr(v, mode="r"))
    if sv[-1] < tolerance * sv[0]:
        worst = int(np.abs(Vt[-1, len(W) :]).argmax())
        raise ValueError(
            f"the kernel cannot be learned: input {worst + 1} of {len(u_scale)} follows from the past of "
            f"inputs and outputs (rank {int((sv > tolerance * sv[0]).sum())} of "
            f"{len(sv)}), so its effect cannot be told from theirs; add probing that no feedback "
            "produces to that input"
        )


# ---- regression -> kernel and gains


class Kernel(NamedTuple):
    """The learned kernel in whitened coordinates: H (q+m, q+m) for v, gains of u = -K w - K_r r - k on the
    raw window w, the number of iterations and the last relative change of the gain."""

    H: np.ndarray
    K: np.ndarray
    K_r: np.ndarray
    k: np.ndarray
    iterations: int
    change: float


def _greedy(H: np.ndarray, q: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns K = H_uu^-1 H_us of (32), and P = H_ss - H_su K, the value after the greedy input. Raises
    ValueError if H_uu is not positive definite."""
    factor, failed = scipy.linalg.lapack.dpotrf(H[q:, q:], lower=1)
    if failed:
        raise ValueError(
            "the learned kernel has no minimum in u (H_uu is not positive definite): "
            "the record is too noisy or too short for this window; lower the window or record longer"
        )
    K = scipy.linalg.lapack.dpotrs(factor, H[q:, :q], lower=1)[0]
    return K, H[:q, :q] - H[:q, q:] @ K


def value_iteration(
    data: Regression,
    Q: np.ndarray,
    R: np.ndarray,
    gamma: float,
    *,
    tolerance: float = 1e-6,
    max_iterations: int = 2000,
) -> Kernel:
    """Returns the kernel of Algorithm 2, steps 5-9: h <- h_0 + gamma G svec(P(H)) until the relative change
    of the gain is below `tolerance`. The gains are in the machine's units. A constant reference enters the
    value as 2 v'H_vr r, exact for every r:

    H_vr = -output'Q + gamma step'P_sr
    P_sr = [I -K'] H_vr

    Q (p, p), R (m, m): weights; `gamma`: discount. The gain decides when to stop, because H itself converges
    only as slowly as gamma^k. Raises ValueError if the value grows without bound, so that the iteration does
    not converge: the data describe no plant that these weights can hold.
    """
    q, m = len(data.W), len(data.u_scale)
    h_0 = data.G_e @ svec(Q) + data.G_u @ svec(R)
    row, column = np.triu_indices(q)
    weight = np.where(row == column, 1.0, ROOT2)
    # svec and smat once for all iterations: the index in h of each entry of H, and its weight
    row_v, column_v = np.triu_indices(q + m)
    weight_v = np.where(row_v == column_v, 1.0, ROOT2)
    place, unweighted = smat(np.arange(len(h_0), dtype=float), q + m), smat(np.ones(len(h_0)), q + m)
    place = np.rint(place / unweighted).astype(int)
    H = smat(h_0, q + m)
    K, P = _greedy(H, q)
    for iteration in range(1, max_iterations + 1):  # noqa: B007 (reported after the loop)
        h = h_0 + gamma * ((data.step.T @ P @ data.step)[row_v, column_v] * weight_v)
        if data.G.size:
            h += gamma * (data.G @ (P[row, column] * weight))
        H = h[place] * unweighted
        previous, (K, P) = K, _greedy(H, q)
        change = float(np.abs(K - previous).max() / np.abs(K).max())
        if change < tolerance:
            break
        if not change < 1e12:
            break
    if not (np.isfinite(K).all() and change < (tolerance or 1e-2)):
        raise ValueError(
            f"value iteration did not settle in {iteration} iterations (last relative change of the gain "
            f"{change:.1g}); record longer, or lower the window"
        )
    closed = np.hstack([np.eye(q), -K.T])
    P_sr = np.linalg.solve(np.eye(q) - gamma * closed @ data.step.T, -closed @ data.output.T @ Q)
    H_ur = (-data.output.T @ Q + gamma * data.step.T @ P_sr)[q:]
    u = data.u_scale[:, None]
    K_r, K_w = u * np.linalg.solve(H[q:, q:], H_ur), u * (K @ data.W)
    # e = y - base: the base is a reference too
    return Kernel(H, K_w[:, :-1], K_r, K_w[:, -1] - K_r @ data.base, iteration, change)


def window_law(K: np.ndarray, K_r: np.ndarray, k: np.ndarray, N: int, *, integral: float = 0.0) -> Law:
    """Returns u = -K w - K_r r - k on the window w of N past inputs and outputs. It takes over as if the hold
    had lasted: every slot of w is filled with u0 and y0."""
    m, p = K_r.shape
    A, B_u, B_y = window_shift(m, p, N)
    start_u = np.vstack([np.tile(np.eye(m), (N, 1)), np.zeros((N * p, m))])
    start_y = np.vstack([np.zeros((N * m, p)), np.tile(np.eye(p), (N, 1))])
    zero = np.zeros(len(A))
    return Law(
        A,
        B_u,
        B_y,
        np.zeros((len(A), p)),
        zero,
        K,
        np.zeros((m, p)),
        K_r,
        k,
        start_u,
        start_y,
        zero,
        integral,
    )


def law(learned: Regression, Q: np.ndarray, R: np.ndarray, gamma: float, *, integral: float = 0.0) -> Law:
    """Returns the law of Algorithm 2 on the window of past inputs and outputs."""
    solution = value_iteration(learned, Q, R, gamma)
    return window_law(solution.K, solution.K_r, solution.k, learned.N, integral=integral)
