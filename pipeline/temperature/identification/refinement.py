"""Prediction-error refinement of an identified plant: Gauss-Newton on one-step or simulation errors over
whole records (Ljung, System Identification, ch. 7 and 10).

Both criteria are the same output-error problem:

    x(t+1) = F x + G v,  ŷ = C x + H v
    prediction  v = [u; 1; y],  F = A - K C,  G = [B - K D, b - K d, K],  H = [D, d, 0]
    simulation  v = [u; 1],     F = A,        G = [B, b],                 H = [D, d]

So one routine serves both. It needs no filter per parameter, because in block-modal coordinates every
sensitivity is a first-order filter of one signal.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg
import scipy.signal

from pipeline.temperature.plant import Plant

Criterion = Literal["prediction", "simulation"]


class FitSettings(NamedTuple):
    """What a fit may change, and when it stops. `feedthrough`: D is free, or the marked rows of it; `offset`:
    b and d are free; every pole stays within `max_radius` if given; a step must lower the cost by the share
    `tolerance`."""

    feedthrough: bool | tuple[bool, ...] = False
    offset: bool = True
    max_radius: float | None = None
    max_iterations: int = 20
    tolerance: float = 1e-5


DEFAULTS = FitSettings()


class Predictor(NamedTuple):
    """x(t+1) = F x + G v
    ŷ = C x + H v

    with one initial state per segment: F (n, n), G (n, r), C (p, n), H (p, r), x0 list of (n,).
    """

    F: np.ndarray
    G: np.ndarray
    C: np.ndarray
    H: np.ndarray
    x0: list[np.ndarray]


def linear_recurrence(F: np.ndarray, g: np.ndarray, x0: np.ndarray) -> np.ndarray:
    """Returns x (T+1, n) of x(t+1) = F x(t) + g(t) from x0, by doubling: pass k adds F^(2^k) times the values
    2^k samples before (Hillis and Steele 1986)."""
    x, power, lag = np.vstack([x0[None], g]), F, 1
    while lag < len(x) and np.abs(power).max() > 1e-20:
        x[lag:] += x[:-lag] @ power.T
        power, lag = power @ power, 2 * lag
    return x


def respond(model: Predictor, v: np.ndarray, x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns states x (T, n) and outputs ŷ (T, p) of the predictor under v (T, r)."""
    x = linear_recurrence(model.F, v @ model.G.T, x0)[:-1]
    return x, x @ model.C.T + v @ model.H.T


def free_response(model: Predictor, T: int) -> np.ndarray:
    """Returns [C; CF; ...; CF^(T-1)] (T, p, n), the outputs' response to each initial state. Its length
    doubles with each pass."""
    gamma, power = model.C[None], model.F
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # an unstable model may overflow far ahead; `fitted_state` leaves those rows out
        while len(gamma) < T:
            gamma, power = np.concatenate([gamma, gamma @ power]), power @ power
    return _without_underflow(gamma[:T])


def _without_underflow(response: np.ndarray) -> np.ndarray:
    """Returns the response with values below 1e-100 set to zero. Products of such numbers underflow, which
    takes processors ten times as long (Z'Z of 6,000 samples: 40 ms instead of 4 ms)."""
    return np.where(np.abs(response) < 1e-100, 0.0, response)


def estimate_state(model: Predictor, v: np.ndarray, y: np.ndarray, *, free_mean: bool = False) -> np.ndarray:
    """Returns x(0) (n,) that fits y (T, p) best in least squares under v; NaN in y is left out. A direction
    of x(0) that y does not show is zero.

    With `free_mean` a constant for each output is fitted too and then dropped, for scores that remove the
    mean of the error.
    """
    n = len(model.F)
    return fitted_state(
        free_response(model, len(v)), y - respond(model, v, np.zeros(n))[1], free_mean=free_mean
    )[:n]


def fitted_state(gamma: np.ndarray, error: np.ndarray, *, free_mean: bool) -> np.ndarray:
    """Returns x(0), and with `free_mean` a constant for each output after it, that explain error (T, p) best
    in least squares. Values that are not finite are left out."""
    T, p, _ = gamma.shape
    regressors = (
        gamma if not free_mean else np.concatenate([gamma, np.broadcast_to(np.eye(p), (T, p, p))], axis=2)
    )
    usable = np.isfinite(error) & (np.abs(gamma).max(axis=2, initial=0.0) < 1e100)
    return np.linalg.lstsq(regressors[usable], error[usable], rcond=1e-10)[0]


def _block_modal(model: Predictor) -> tuple[Predictor, list[tuple[int, complex]], np.ndarray]:
    """Returns the predictor with F block diagonal (1 x 1 real, 2 x 2 [[a, b], [-b, a]] for a + ib), (first
    row, eigenvalue) of each block, and the basis."""
    eigenvalues, vectors = np.linalg.eig(model.F)
    columns, blocks = [], []
    for eigenvalue, vector in zip(eigenvalues, vectors.T, strict=True):
        if eigenvalue.imag < 0:
            continue
        blocks.append((len(columns), complex(eigenvalue)))
        columns += [vector.real, vector.imag] if eigenvalue.imag > 0 else [vector.real]
    T = np.array(columns).T
    inverse = np.linalg.inv(T)
    return (
        Predictor(
            inverse @ model.F @ T, inverse @ model.G, model.C @ T, model.H, [inverse @ x for x in model.x0]
        ),
        blocks,
        T,
    )


def _filtered(blocks: list[tuple[int, complex]], s: np.ndarray, numerator: list[float]) -> np.ndarray:
    """Returns f (T, n, k): signal s_j (T, k) through the first-order filter of each mode. A complex pair has
    its real and imaginary part in its two rows. numerator: [0, 1] for an input, [1] for x0.

    The response of ŷ_o to s_j entering at state i is a mixture of f that depends on C alone (`_mixed`), so
    one set of filtered signals serves every output.
    """
    f = np.empty((len(s), sum(1 + (eigenvalue.imag > 0) for _, eigenvalue in blocks), s.shape[1]))
    for k, eigenvalue in blocks:
        if eigenvalue.imag > 0:
            z = scipy.signal.lfilter(numerator, [1.0, -eigenvalue], s, axis=0)
            f[:, k], f[:, k + 1] = z.real, z.imag
        else:
            f[:, k] = scipy.signal.lfilter(numerator, [1.0, -eigenvalue.real], s, axis=0)
    return f


def _mixing(c: np.ndarray, blocks: list[tuple[int, complex]]) -> np.ndarray:
    """Returns M (n, n) with sensitivity = M f for the output whose row of C is c: [c_k] for a real mode,
    [[c_k, -c_k+1], [c_k+1, c_k]] for a pair."""
    M = np.zeros((len(c), len(c)))
    for k, eigenvalue in blocks:
        M[k, k] = c[k]
        if eigenvalue.imag > 0:
            M[k, k + 1], M[k + 1, k], M[k + 1, k + 1] = -c[k + 1], c[k + 1], c[k]
    return M


def _mixed(c: np.ndarray, blocks: list[tuple[int, complex]], f: np.ndarray) -> np.ndarray:
    """Returns the sensitivities (T, n k) of the output whose row of C is c."""
    return np.einsum("il,tlj->tij", _mixing(c, blocks), f, optimize=True).reshape(len(f), -1)


def _normal_equations(
    model: Predictor, blocks, free: np.ndarray, v_all, y_all
) -> tuple[np.ndarray, np.ndarray]:
    """Returns J'J and J'e over every segment. The parameters are [F G] row by row; then, for each output, C
    and the columns of H that are free (p, r) in some row; then x0 of each segment. Entries that are not free
    are zero.

    With J_o = Z M_o the products over the samples, Z'Z and Z'e, are the same for every output measured at the
    same samples, so they are computed once.
    """
    n, r = model.G.shape
    columns = np.flatnonzero(free.any(axis=0))
    p, h = len(model.C), len(columns)
    state, output = n * (n + r), n + h
    size = state + p * output + n * len(v_all)
    JJ, Je = np.zeros((size, size)), np.zeros(size)
    mixing = [_mixing(c, blocks) for c in model.C]

    def mixed(M, rows):  # block_diag(kron(M, I), I, M) @ rows, without the zeros
        first, last = (M @ part.reshape(n, -1) for part in (rows[:state], rows[-n:]))
        return np.concatenate(
            [first.reshape(state, *rows.shape[1:]), rows[state:-n], last.reshape(n, *rows.shape[1:])]
        )

    for segment, (v, y) in enumerate(zip(v_all, y_all, strict=True)):
        x, predicted = respond(model, v, model.x0[segment])
        pulse = np.zeros((len(v), 1))
        pulse[0] = 1.0
        Z = np.hstack(
            [
                _filtered(blocks, np.hstack([x, v]), [0.0, 1.0]).reshape(len(v), state),
                x,
                v[:, columns],
                _without_underflow(_filtered(blocks, pulse, [1.0])[:, :, 0]),
            ]
        )
        e, mask, ZZ, Ze = y - predicted, None, None, np.empty((0, p))
        first = size - n * (len(v_all) - segment)
        for o in range(p):
            if mask is None or not np.array_equal(mask, np.isfinite(y[:, o])):
                mask = np.isfinite(y[:, o])
                Z_measured = Z if mask.all() else Z[mask]
                ZZ, Ze = Z_measured.T @ Z_measured, Z_measured.T @ e[mask]
            M = mixing[o]
            at = np.r_[0:state, state + o * output : state + (o + 1) * output, first : first + n]
            JJ[np.ix_(at, at)] += mixed(M, mixed(M, ZZ).T)
            Je[at] += mixed(M, Ze[:, o])
    for o in range(p):
        fixed = state + o * output + n + np.flatnonzero(~free[o, columns])
        JJ[fixed], JJ[:, fixed], Je[fixed] = 0.0, 0.0, 0.0
    return JJ, Je


def _stepped(model: Predictor, step: np.ndarray, free: np.ndarray) -> Predictor:
    n, r = model.G.shape
    p, state = len(model.C), n * (n + r)
    FG = step[:state].reshape(n, n + r)
    columns = np.flatnonzero(free.any(axis=0))
    CH = step[state : state + p * (n + len(columns))].reshape(p, n + len(columns))
    H = model.H.copy()
    H[:, columns] += CH[:, n:]
    x0 = step[state + CH.size :].reshape(-1, n)
    return Predictor(
        model.F + FG[:, :n],
        model.G + FG[:, n:],
        model.C + CH[:, :n],
        H,
        [a + b for a, b in zip(model.x0, x0, strict=True)],
    )


def _cost(model: Predictor, v_all, y_all) -> float:
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # a trial step may diverge; its cost is then infinite and the step is rejected
        cost = sum(
            np.nansum((y - respond(model, v, x0)[1]) ** 2)
            for v, y, x0 in zip(v_all, y_all, model.x0, strict=True)
        )
        finite = all(
            np.isfinite(respond(model, v[-1:], x0)[1]).all() for v, x0 in zip(v_all, model.x0, strict=True)
        )
    return float(cost) if finite and np.isfinite(cost) else np.inf


def gauss_newton(
    model: Predictor, v_all, y_all, *, free: np.ndarray, admissible, max_iterations: int, tolerance: float
) -> tuple[Predictor, list[float]]:
    """Runs Levenberg-Marquardt on sum |y - ŷ|² over F, G, C, the `free` (p, r) entries of H and every x0; NaN
    in y is left out. Returns the model, and its cost at the start and after each step.

    The parameters are redundant (any change of state basis); among equal steps the damping selects the one of
    least norm. `admissible(F, G, C)` rejects steps, which keeps the model stable by construction. Stops when
    a step lowers the cost by less than the share `tolerance`. Returns a start whose errors are not finite
    unchanged.
    """
    costs, damping = [_cost(model, v_all, y_all)], 1e-4
    for _ in range(max_iterations if np.isfinite(costs[0]) else 0):
        model, blocks, _ = _block_modal(model)
        JJ, Je = _normal_equations(model, blocks, free, v_all, y_all)
        scale = np.sqrt(np.diag(JJ))
        scale[scale == 0] = 1.0
        JJ = JJ / np.outer(scale, scale)
        while damping < 1e8:
            step = np.linalg.solve(JJ + damping * np.eye(len(JJ)), Je / scale) / scale
            trial = _stepped(model, step, free)
            cost = (
                _cost(trial, v_all, y_all)
                if np.isfinite(step).all() and admissible(trial.F, trial.G, trial.C)
                else np.inf
            )
            if cost < costs[-1]:
                break
            damping *= 10
        else:
            break
        model, damping = trial, max(damping / 10, 1e-10)
        costs.append(cost)
        if costs[-2] - cost <= tolerance * costs[-2]:
            break
    return model, costs


def fit_inputs(A, C, u, y, *, feedthrough: bool | tuple[bool, ...], offset: bool) -> Predictor:
    """Fits B, b, D, d and every x0 so that the simulation matches y best, for given A (n, n), C (p, n): a
    linear least-squares problem (Verhaegen 1994; SLICOT IB01CD).

    Returns the simulator in its block-modal basis, v = [u; 1]. b and d are zero if `offset` is False; rows of
    D that `feedthrough` does not mark are zero.
    """
    n, m, p, segments = len(A), u[0].shape[1], len(C), len(u)
    allowed = free_entries(p, m, feedthrough, offset=offset)
    model, blocks, _ = _block_modal(
        Predictor(A, np.zeros((n, m + 1)), C, np.zeros((p, m + 1)), [np.zeros(n)] * segments)
    )
    inputs = np.arange(m + 1) if offset else np.arange(m)
    direct = np.flatnonzero(allowed.any(axis=0))
    size = n * len(inputs) + p * len(direct)
    rows, target = [], []
    for segment, (a, b) in enumerate(zip(u, y, strict=True)):
        v, T = drives("simulation", a, b), len(a)
        pulse = np.zeros((T, 1))
        pulse[0] = 1.0
        f, f0 = (
            _filtered(blocks, v[:, inputs], [0.0, 1.0]),
            _without_underflow(_filtered(blocks, pulse, [1.0])),
        )
        for o in range(p):
            J = np.zeros((T, size + n * segments))
            J[:, : n * len(inputs)] = _mixed(model.C[o], blocks, f)
            J[:, n * len(inputs) + o * len(direct) : n * len(inputs) + (o + 1) * len(direct)] = (
                v[:, direct] * allowed[o, direct]
            )
            J[:, size + segment * n : size + (segment + 1) * n] = _mixed(model.C[o], blocks, f0)
            mask = np.isfinite(b[:, o])
            rows.append(J[mask])
            target.append(b[mask, o])
    J = np.vstack(rows)
    scale = np.linalg.norm(J, axis=0)
    scale[scale == 0] = 1.0
    theta = np.linalg.lstsq(J / scale, np.concatenate(target), rcond=1e-12)[0] / scale
    G, H = np.zeros((n, m + 1)), np.zeros((p, m + 1))
    G[:, inputs] = theta[: n * len(inputs)].reshape(n, -1)
    H[:, direct] = theta[n * len(inputs) : size].reshape(p, -1) * allowed[:, direct]
    return model._replace(G=G, H=H, x0=list(theta[size:].reshape(segments, n)))


def free_entries(p: int, m: int, feedthrough: bool | tuple[bool, ...], *, offset: bool) -> np.ndarray:
    """Returns which entries of [D, d] (p, m + 1) a fit may change."""
    rows = np.broadcast_to(np.asarray(feedthrough, bool), (p,))
    return np.column_stack([np.repeat(rows[:, None], m, axis=1), np.full(p, offset)])


def prediction_form(plant: Plant, x0: Sequence[np.ndarray]) -> Predictor:
    """Returns the one-step predictor of a plant:

    v = [u; 1; y]
    F = A - K C
    G = [B - K D, b - K d, K]
    H = [D, d, 0]
    """
    A, B, C, D, b, d, K, _ = plant
    G = np.hstack([B - K @ D, (b - K @ d)[:, None], K])
    return Predictor(A - K @ C, G, C, np.hstack([D, d[:, None], np.zeros((plant.p, plant.p))]), list(x0))


def simulation_form(plant: Plant, x0: Sequence[np.ndarray]) -> Predictor:
    """Returns the simulator of a plant: v = [u; 1], F = A, G = [B, b], H = [D, d]."""
    return Predictor(
        plant.A,
        np.hstack([plant.B, plant.b[:, None]]),
        plant.C,
        np.hstack([plant.D, plant.d[:, None]]),
        list(x0),
    )


def drives(criterion: str, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns v (T, r) of the criterion's predictor."""
    one = np.ones((len(u), 1))
    return np.hstack([u, one, y]) if criterion == "prediction" else np.hstack([u, one])


def filled(plant: Plant, u: np.ndarray, y: np.ndarray, x0: np.ndarray) -> np.ndarray:
    """Returns y (T, p) with each masked entry replaced by its one-step prediction, as a Kalman filter without
    that measurement does."""
    if np.isfinite(y).all():
        return y
    y, x = y.copy(), x0
    for t in range(len(y)):
        predicted = plant.C @ x + plant.D @ u[t] + plant.d
        y[t] = np.where(np.isfinite(y[t]), y[t], predicted)
        x = plant.A @ x + plant.B @ u[t] + plant.b + plant.K @ (y[t] - predicted)
    return y


def simulated(plant: Plant, u: np.ndarray, y: np.ndarray, *, means_removed: bool = False) -> np.ndarray:
    """Returns ŷ (T, p) of the plant under u (T, m) alone, from the initial state that fits all of y (T, p)
    best (the rule of SLICOT's IB01CD and of MATLAB's compare).

    With `means_removed` the initial state is fitted to the error without its mean, for a score that removes
    the mean.
    """
    model, v = simulation_form(plant, []), drives("simulation", u, y)
    return respond(model, v, estimate_state(model, v, y, free_mean=means_removed))[1]


def one_step_errors(plant: Plant, u: Sequence[np.ndarray], y: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Returns e(t) = y(t) - ŷ(t | t-1) (T, p) of each segment, with the initial state fitted to the segment;
    NaN if y is masked."""
    model, out = prediction_form(plant, []), []
    for a, b in zip(u, y, strict=True):
        v = drives("prediction", a, filled(plant, a, b, np.zeros(plant.n)))
        out.append(b - respond(model, v, estimate_state(model, v, b))[1])
    return out


def refine(
    plant: Plant,
    u: Sequence[np.ndarray],
    y: Sequence[np.ndarray],
    criterion: Criterion = "prediction",
    settings: FitSettings = DEFAULTS,
) -> tuple[Plant, list[float]]:
    """Returns the plant with the least sum of weighted squared errors, one step ahead or in free simulation,
    over every segment u (T, m), y (T, p); and that sum at the start and after each step.

    Errors are weighted by the error covariance of the starting model (the full one for predictions, its
    diagonal for simulation or if only some rows of D are free). The predictor stays stable, and A stays
    within `max_radius` if given (it must do so at the start). With "simulation" K is zero, and `kalman_gain`
    fits it. NaN in y is a masked sample; u has none.
    """
    m, ahead = plant.m, criterion == "prediction"
    rows = np.broadcast_to(np.asarray(settings.feedthrough, bool), (plant.p,))
    # a full weight would mix the rows of D that are free with those that are zero
    diagonal = not ahead or bool(rows.any() and not rows.all())
    start, v, y, weights = _weighted(plant, u, y, criterion, diagonal=diagonal)
    free = np.zeros(start.H.shape, bool)
    free[:, : m + 1] = free_entries(plant.p, m, settings.feedthrough, offset=settings.offset)

    def admissible(F, G, C):
        if ahead and np.abs(np.linalg.eigvals(F)).max() >= 1:
            return False
        if settings.max_radius is None:
            return True
        A = F + G[:, m + 1 :] @ C if ahead else F
        return np.abs(np.linalg.eigvals(A)).max() <= settings.max_radius

    best, costs = gauss_newton(
        start,
        v,
        y,
        free=free,
        admissible=admissible,
        max_iterations=settings.max_iterations,
        tolerance=settings.tolerance,
    )
    refined = _plant_of(best, weights, plant, ahead=ahead)
    return refined._replace(D=np.where(rows[:, None], refined.D, plant.D)), costs


def _weighted(
    plant: Plant, u, y, criterion: Criterion, *, diagonal: bool
) -> tuple[Predictor, list[np.ndarray], list[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Returns the problem for Gauss-Newton: the starting predictor, its drives and the outputs, in units in
    which the starting errors have covariance I; and the weight (p, p) to those units, and back."""
    m, ahead = plant.m, criterion == "prediction"
    start = prediction_form(plant, []) if ahead else simulation_form(plant, [])
    y_full = y
    if ahead:
        y_full = [
            b if np.isfinite(b).all() else filled(plant, a, b, _first_state(start, criterion, a, b))
            for a, b in zip(u, y, strict=True)
        ]
    v = [drives(criterion, a, b) for a, b in zip(u, y_full, strict=True)]
    x0 = [estimate_state(start, a, b) for a, b in zip(v, y, strict=True)]
    errors = np.vstack([b - respond(start, a, x)[1] for a, b, x in zip(v, y, x0, strict=True)])
    weight, unweight = _weights(errors, diagonal=diagonal)
    if ahead:
        start = start._replace(G=np.hstack([start.G[:, : m + 1], start.G[:, m + 1 :] @ unweight]))
        v = [np.hstack([a[:, : m + 1], a[:, m + 1 :] @ weight.T]) for a in v]
    start = start._replace(C=weight @ start.C, H=weight @ start.H, x0=x0)
    return start, v, [b @ weight.T for b in y], (weight, unweight)


def _plant_of(best: Predictor, weights: tuple[np.ndarray, np.ndarray], plant: Plant, *, ahead: bool) -> Plant:
    """Returns the plant whose weighted predictor or simulator is `best`, in the units of `plant`."""
    m, (weight, unweight) = plant.m, weights
    C, H = unweight @ best.C, unweight @ best.H
    K = best.G[:, m + 1 :] @ weight if ahead else np.zeros((plant.n, plant.p))
    D, d = H[:, :m], H[:, m]
    A, B, b = best.F + K @ C, best.G[:, :m] + K @ D, best.G[:, m] + K @ d
    return Plant(A, B, C, D, b, d, K, plant.sample_time_s)


def stabilising_gain(plant: Plant) -> np.ndarray:
    """Returns K (n, p) with A - K C stable: zero if A is stable, otherwise the Kalman gain for process noise
    that enters mainly as the inputs do, and slightly into every state."""
    if np.abs(np.linalg.eigvals(plant.A)).max() < 1:
        return np.zeros((plant.n, plant.p))
    A, C = plant.A, plant.C
    size = max(np.trace(plant.B @ plant.B.T), np.finfo(float).tiny)
    Q = plant.B @ plant.B.T / size + 1e-3 * np.eye(plant.n)
    R = np.eye(plant.p) * max(np.trace(C @ Q @ C.T) / plant.p, np.finfo(float).tiny)
    P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    return A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + R)


def kalman_gain(
    plant: Plant, u: Sequence[np.ndarray], y: Sequence[np.ndarray], *, max_iterations: int = 20
) -> Plant:
    """Returns the plant with the gain K of the smallest one-step errors, with all else unchanged.
    Gauss-Newton starts from a stabilising gain; dŷ/dK_ij is the response to e_j entering at state i.

    Errors are weighted by their variance at the start. If the plant has an unstable mode that no output
    shows, there is no such gain, and the plant is returned unchanged.
    """
    try:
        K = stabilising_gain(plant)
    except np.linalg.LinAlgError:
        return plant
    n, p, plant = plant.n, plant.p, plant._replace(K=K)
    v = [drives("prediction", a, filled(plant, a, b, np.zeros(n))) for a, b in zip(u, y, strict=True)]

    def errors(K):
        model = prediction_form(plant._replace(K=K), [])
        x0 = [estimate_state(model, a, b) for a, b in zip(v, y, strict=True)]
        return model, [np.nan_to_num(b - respond(model, a, x)[1]) for a, b, x in zip(v, y, x0, strict=True)]

    model, e = errors(K)
    weight = 1.0 / np.sqrt(np.maximum(np.mean(np.vstack(e) ** 2, axis=0), np.finfo(float).tiny))
    cost, damping = sum(np.sum((a * weight) ** 2) for a in e), 1e-4
    for _ in range(max_iterations):
        modal, blocks, basis = _block_modal(model._replace(x0=[]))
        f = [_filtered(blocks, a, [0.0, 1.0]) for a in e]
        J = np.vstack(
            [np.stack([_mixed(c, blocks, a) for c in modal.C], axis=1).reshape(-1, n * p) for a in f]
        )
        w = np.tile(weight, len(J) // p)
        JJ, Je = (J * w[:, None]).T @ (J * w[:, None]), (J * w[:, None]).T @ (np.vstack(e).ravel() * w)
        scale = np.sqrt(np.maximum(np.diag(JJ), np.finfo(float).tiny))
        while damping < 1e6:
            step = np.linalg.solve(JJ / np.outer(scale, scale) + damping * np.eye(n * p), Je / scale) / scale
            trial = K + basis @ step.reshape(n, p)
            if np.isfinite(trial).all() and np.abs(np.linalg.eigvals(plant.A - trial @ plant.C)).max() < 1:
                model_t, e_t = errors(trial)
                cost_t = sum(np.sum((a * weight) ** 2) for a in e_t)
                if cost_t < cost:
                    break
            damping *= 10
        else:
            break
        gained, K, model, e, cost, damping = cost - cost_t, trial, model_t, e_t, cost_t, damping / 10
        if gained < 1e-6 * cost:
            break
    return plant._replace(K=K)


def _first_state(start, criterion, u, y):
    rows = np.isfinite(y).all(1)
    stop = len(rows) if rows.all() else max(int(np.argmin(rows)), 1)
    return estimate_state(start, drives(criterion, u[:stop], np.nan_to_num(y[:stop])), y[:stop])


def _weights(errors: np.ndarray, *, diagonal: bool) -> tuple[np.ndarray, np.ndarray]:
    """Returns W with W'W = S^-1 and its inverse. S (p, p) is the covariance of the errors; the variance of
    noise-free channels is set to rounding."""
    rows = errors[np.isfinite(errors).all(1)]
    S = rows.T @ rows / max(len(rows), 1)
    S = np.diag(np.diag(S)) if diagonal else S
    S = S + np.eye(len(S)) * max(1e-12 * np.trace(S), 1e-300)
    L = np.linalg.cholesky(S)
    return np.linalg.inv(L), L
