"""Predictive control in gamma form: its Hankel rows and factors by hand, equal to the optimum of its horizon
on data without noise, the least-squares predictor of many steps under noise; and what it refuses."""

import tracemalloc

import numpy as np
import pytest

from pipeline.temperature.controllers import predictive
from pipeline.temperature.plant import plant, simulate

SMALL = plant(
    [[0.8, 0.2, 0.0], [-0.1, 0.7, 0.3], [0.0, 0.1, 0.9]],
    [[0.5, -1.0], [1.0, 0.3], [0.2, 0.7]],
    [[1.0, 0.5, -0.3], [0.2, -1.0, 0.8]],
)._replace(b=np.array([0.3, -0.2, 0.5]), d=np.array([1.0, -2.0]))
Q, R, GAMMA = np.array([[2.0, 0.3], [0.3, 1.0]]), np.diag([0.5, 1.5]), 0.95
N, T = 3, 8


def record(samples=900, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    u = 3 * rng.normal(size=(samples, 2))
    x, y = simulate(SMALL, u, np.ones(3))
    return x, u, y + noise * rng.normal(size=y.shape)


def window_at(u, y, t, N=N):
    past = -np.arange(1, N + 1)
    return np.r_[u[t + past].ravel(), y[t + past].ravel()]


def rows_of(u, y, N=N, T=T, **options):
    return np.vstack(list(predictive.hankel_rows([u], [y], N, T, **options)))


# ---- the Hankel matrix


def test_a_hankel_matrix_by_hand():
    u, y = np.array([[1.0], [2.0], [3.0], [4.0], [5.0]]), 10 * np.array([[1.0], [2.0], [3.0], [4.0], [5.0]])
    # two samples of past newest first, two inputs from now on, the two outputs after them
    rows = [[2, 1, 20, 10, 3, 4, 40, 50]]
    np.testing.assert_array_equal(rows_of(u, y, 2, 2), rows)


def test_no_row_reaches_across_a_gap_or_holds_a_masked_sample():
    u, y = np.arange(12.0)[:, None], np.arange(12.0)[:, None]
    whole = rows_of(u, y, 2, 2)
    y[6] = np.nan
    masked = rows_of(u, y, 2, 2)
    assert (
        len(whole) == 8 and len(masked) == 4
    )  # of t = 2 ... 9 those are left out that hold y(6): 4, 5, 7, 8
    pieces = list(predictive.hankel_rows([u[:6], u[6:]], [u[:6], u[6:]], 2, 2))
    assert [len(piece) for piece in pieces] == [2, 2]


def test_factors_of_one_input_by_hand():
    # y(t+1) = y(t) / 2 + u(t) = y(t-1) / 4 + u(t-1) / 2 + u(t): past [u(t-1); y(t-1)], horizon 2
    u = np.random.default_rng(1).normal(size=(200, 1))
    y = np.zeros((200, 1))
    for t in range(199):
        y[t + 1] = y[t] / 2 + u[t]
    learned = predictive.learn([u], [y], 1, 2)
    per_input = learned.L32 @ np.linalg.inv(learned.L22)
    np.testing.assert_allclose(per_input, [[1.0, 0.0], [0.5, 1.0]], atol=1e-12)
    free = (learned.L31 - per_input @ learned.L21) @ learned.past
    np.testing.assert_allclose(free, [[0.5, 0.25, 0.0], [0.25, 0.125, 0.0]], atol=1e-12)


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_blocks_of_rows_give_the_factors_of_all_rows_at_once(monkeypatch, noise):
    _, u, y = record(noise=noise)
    at_once = predictive.law(predictive.learn([u], [y], N, T), Q, R, GAMMA)
    rows = predictive.hankel_rows
    monkeypatch.setattr(predictive, "hankel_rows", lambda *of: rows(*of, block=37))
    in_blocks = predictive.law(predictive.learn([u], [y], N, T), Q, R, GAMMA)
    np.testing.assert_allclose(in_blocks.K, at_once.K, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(in_blocks.K_r, at_once.K_r, rtol=1e-8)


def test_memory_does_not_grow_with_the_record():
    peaks = []
    for samples in (10_000, 30_000):
        _, u, y = record(samples)
        tracemalloc.start()
        predictive.learn([u], [y], N, T)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # less than a fifth of what the Hankel matrix of 30,000 samples would take
    assert peaks[1] - peaks[0] < 8 * 30_000 * (N + T) * 4 / 5


# ---- the law


def optimum(x, r):
    """The inputs (m,) of least cost over the horizon from state x, by the matrices of the true plant."""
    A, B, C, m, p = SMALL.A, SMALL.B, SMALL.C, SMALL.m, SMALL.p
    free, forced = [], np.zeros((T * p, T * m))
    for k in range(T):
        x = A @ x + SMALL.b
        free.append(C @ x + SMALL.d)
        for j in range(k + 1):
            response = C @ np.linalg.matrix_power(A, k - j) @ B
            forced[k * p : (k + 1) * p, j * m : (j + 1) * m] = response
    of_y = np.kron(np.diag(GAMMA ** np.arange(1, T + 1)), Q)
    of_u = np.kron(np.diag(GAMMA ** np.arange(T)), R)
    right = forced.T @ of_y @ (np.tile(r, T) - np.concatenate(free))
    return np.linalg.solve(forced.T @ of_y @ forced + of_u, right)[:m]


@pytest.mark.parametrize("r", [np.array([2.0, -1.0]), np.array([-30.0, 12.0])])
@pytest.mark.parametrize("window", [3, 5])  # the plant needs 2; a longer one has directions of rounding
def test_without_noise_the_law_is_the_optimum_of_its_horizon(r, window):
    x, u, y = record()
    law = predictive.law(predictive.learn([u], [y], window, T), Q, R, GAMMA)
    for t in (100, 500, 850):
        w = window_at(u, y, t, window)
        np.testing.assert_allclose(-law.K @ w - law.K_r @ r - law.k, optimum(x[t], r), rtol=1e-6)


def test_with_gamma_3_zero_it_is_the_least_squares_predictor_of_each_step():
    _, u, y = record(noise=0.5)
    learned, rows = predictive.learn([u], [y], N, T), rows_of(u, y)
    past, coming_u, coming_y = np.split(rows, [4 * N, 4 * N + 2 * T], axis=1)
    z = np.hstack([past, np.ones((len(past), 1))])
    per_input = learned.L32 @ np.linalg.inv(learned.L22)
    ours = z @ ((learned.L31 - per_input @ learned.L21) @ learned.past).T + coming_u @ per_input.T
    for k in (0, 3, T - 1):
        regressors = np.hstack([z, coming_u[:, : 2 * (k + 1)]])
        theirs = regressors @ np.linalg.lstsq(regressors, coming_y[:, 2 * k : 2 * k + 2], rcond=None)[0]
        np.testing.assert_allclose(ours[:, 2 * k : 2 * k + 2], theirs, atol=1e-9)


def test_a_spread_of_gains_is_the_mean_over_records_with_other_gains():
    _, u, y = record(4000, noise=0.1)
    spread = predictive.law(predictive.learn([u], [y], N, T, gain_spread=0.3), Q, R, GAMMA)
    both = [1 + 0.3 * np.array(sign) for sign in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    scaled = predictive.learn([u * one for one in both], [y] * 4, N, T)
    np.testing.assert_allclose(spread.K, predictive.law(scaled, Q, R, GAMMA).K, rtol=0.02, atol=0.01)


def test_stored_factors_come_back_as_they_were():
    _, u, y = record(noise=0.1)
    learned = predictive.learn([u], [y], N, T)
    back = predictive.restored({name: array for name, (array, *_) in learned.stored().items()})
    assert all(np.array_equal(a, b) for a, b in zip(back, learned, strict=True))
    assert (back.N, back.samples) == (N, 900 - N - T)


# ---- refusals


def test_a_record_with_too_few_stretches_is_refused_with_how_many_it_needs():
    _, u, y = record(60)
    with pytest.raises(ValueError, match="at least 58 stretches of 12 samples .*found 49; record longer"):
        predictive.learn([u], [y], N, T)


def test_an_input_that_only_feeds_back_is_refused_by_its_number():
    _, u, y = record()
    u[1:, 1] = 0.5 * y[:-1, 0]
    with pytest.raises(ValueError, match="input 2 of 2 follows from the past"):
        predictive.learn([u], [y], N, T)


def test_the_horizon_is_what_half_of_the_record_carries():
    assert predictive.horizon(6000, 1, 24, 7, 5, longest=40) == 40
    # half of 1,600 windows, less the window that the cut costs, for twice 1 + 24 x 12 + T x 7 unknowns and T
    assert predictive.horizon(1600, 1, 24, 7, 5, longest=40) == (800 - 24 - 2 * 289) // 15
    message = "at least 1354 complete windows of 24 samples for a horizon of 5, found 1200; record 154 more"
    with pytest.raises(ValueError, match=message):
        predictive.horizon(1200, 1, 24, 7, 5, longest=40)


@pytest.mark.parametrize("samples", [140, 180, 300])
def test_half_of_every_segment_determines_the_horizon(samples):
    _, u, y = record(samples)
    pieces = [np.split(signal, 2) for signal in (u, y)]
    windows = samples - 2 * N
    T = predictive.horizon(windows, 2, N, 2, 2, longest=40)
    halves = [[piece[: len(piece) // 2] for piece in signal] for signal in pieces]
    assert predictive.learn(*halves, N, T).samples >= predictive.ROWS * (1 + 4 * N + 2 * T)
