"""The indirect route: the window that it chooses, the predictor that it learns, the law that follows, and the
state that it hands to Algorithm 2."""

import numpy as np
import pytest

from pipeline.papers.published import GAMMA
from pipeline.papers.study import data_sets
from pipeline.temperature.controllers import window as window_route
from pipeline.temperature.controllers.kernel import windows
from pipeline.temperature.controllers.window import law, learn, predicted_tuples, predictor
from pipeline.temperature.plant import baam, plant, simulate
from pipeline.temperature.tracking import gains

I5, I7 = np.eye(5), np.eye(7)
SMALL = plant(
    [[0.8, 0.2, 0.0], [-0.1, 0.7, 0.3], [0.0, 0.1, 0.9]],
    [[0.5, -1.0], [1.0, 0.3], [0.2, 0.7]],
    [[1.0, 0.5, -0.3], [0.2, -1.0, 0.8]],
    b=[0.3, -0.2, 0.5],
    d=[1.0, -2.0],
)
Q2, R2 = np.diag([2.0, 1.0]), np.diag([0.5, 1.5])


@pytest.fixture(scope="module")
def record():
    u, y = data_sets(np.random.default_rng(7), 4000, 1)
    return u[:, 0], y[:, 0]


def noisy(y, noise, seed=0):
    return y + noise * np.random.default_rng(seed).standard_normal(y.shape)


def test_without_noise_the_window_is_as_long_as_the_plant_needs(record):
    window = learn([record[0][:600]], [record[1][:600]], longest=6)
    assert window.N == 2  # the observability index of the study's machine
    w, _, y = windows([record[0]], [record[1]], 2)
    np.testing.assert_allclose(w @ window.Theta.T, y, atol=1e-8)  # rounding at 100 °C


def test_under_noise_the_window_is_longer(record):
    assert learn([record[0]], [noisy(record[1], 0.5)], longest=12).N > 4


def test_one_factorisation_gives_the_least_squares_fit_of_its_window(record):
    u, y = record[0][:900], noisy(record[1], 0.5)[:900]
    window = learn([u], [y], longest=8, offset=True)
    # the samples that the longest window leaves
    w, _, y_now = windows([u[8 - window.N :]], [y[8 - window.N :]], window.N)
    columns = np.hstack([w, np.ones((len(w), 1))])
    expected = np.linalg.lstsq(columns, y_now, rcond=None)[0]
    # two roads through a condition of 1e4
    np.testing.assert_allclose(np.vstack([window.Theta.T, window.theta_0]), expected, atol=1e-7)
    rest = y_now - columns @ expected
    np.testing.assert_allclose(window.covariance, rest.T @ rest / (len(w) - columns.shape[1]), rtol=1e-8)


def test_a_spread_of_gains_adds_to_each_input_its_own_moments(record):
    u, y = record[0][:900], noisy(record[1], 0.5)[:900]
    window = learn([u], [y], longest=3, gain_spread=0.2)
    w, _, y_now = windows([u[3 - window.N :]], [y[3 - window.N :]], window.N)
    own = np.zeros((window.N * 12,) * 2)
    # lags of one input with one another, no two inputs
    own[: window.N * 7, : window.N * 7] = np.kron(np.ones((window.N, window.N)), np.eye(7))
    moments = w.T @ w
    # rounding times a condition of 1e5
    np.testing.assert_allclose(
        window.Theta.T, np.linalg.solve(moments + 0.04 * own * moments, w.T @ y_now), atol=1e-8
    )
    assert np.abs(window.Theta - learn([u], [y], longest=3).Theta).max() > 1e-3


def test_the_table_holds_akaike_s_criterion(record):
    u, y = record[0][:900], noisy(record[1], 0.5)[:900]
    window = learn([u], [y], longest=4)
    for N, parameters, criterion in window.table:
        w, _, y_now = windows([u[4 - int(N) :]], [y[4 - int(N) :]], int(N))
        rest = y_now - w @ np.linalg.lstsq(w, y_now, rcond=None)[0]
        assert parameters == 5 * 12 * N
        # rounding
        assert criterion == pytest.approx(
            len(w) * np.linalg.slogdet(rest.T @ rest / len(w))[1] + 2 * parameters, rel=1e-9
        )


def test_segments_and_masked_samples_leave_the_predictor_exact():
    u = np.random.default_rng(0).normal(size=(300, 2))
    y = simulate(SMALL, u, np.ones(3))[1]
    y[40] = np.nan
    window = learn([u[:120], u[120:]], [y[:120], y[120:]], longest=3, offset=True)
    assert window.samples == 300 - 2 * 3 - 4
    w, _, y_now = windows([u[120:]], [y[120:]], window.N)
    # rounding of numbers near 10
    np.testing.assert_allclose(w @ window.Theta.T + window.theta_0, y_now, atol=1e-10)


def test_the_predictor_is_the_plant_from_its_window_on():
    u = np.random.default_rng(0).normal(size=(300, 2))
    y = simulate(SMALL, u, np.ones(3))[1]
    window = learn([u[:200]], [y[:200]], longest=4, offset=True)
    w = windows([u], [y], window.N)[0][200 - window.N]
    model = predictor(window, sample_time_s=2.0)
    # rounding fed back for 100 steps
    np.testing.assert_allclose(simulate(model, u[200:], w)[1], y[200:], atol=1e-9)
    assert model.sample_time_s == 2.0


def test_the_law_of_the_window_is_the_optimal_one_on_a_plant_with_offset():
    u = np.random.default_rng(0).normal(size=(300, 2))
    x, y = simulate(SMALL, u, np.ones(3))
    learned_law = law(learn([u], [y], longest=4, offset=True), Q2, R2, 0.9)
    best = gains(SMALL, Q2, R2, 0.9)
    N = learned_law.K.shape[1] // 4
    w = windows([u], [y], N)[0]
    # rounding of a least-squares fit
    np.testing.assert_allclose(w @ learned_law.K.T + learned_law.k, x[N:-1] @ best.K_x.T + best.k, atol=1e-9)
    np.testing.assert_allclose(learned_law.K_r, best.K_r, atol=1e-9)


@pytest.mark.parametrize(("noise", "orders"), [(0.0, {6}), (0.1, {5, 6}), (0.5, {5, 6})])
def test_the_predicted_state_has_the_order_of_the_plant_and_no_direction_of_noise(record, noise, orders):
    """The null direction of C moves the outputs by little: under noise it may be left out, but of 40 or more
    directions of the window no other comes in."""
    y = noisy(record[1], noise)
    long = learn([record[0]], [y], longest=8)
    assert predicted_tuples(long, [record[0]], [y]).s.shape[1] in orders


def test_the_predicted_state_is_a_map_of_the_window_and_a_constant(record):
    u, y = record[0][:1500], noisy(record[1], 0.1)[:1500]
    long = learn([u], [y], longest=6, offset=True)
    data = predicted_tuples(long, [u], [y], offset=True)
    w = windows([u], [y], long.N)[0]
    whole = np.hstack([w, np.ones((len(w), 1))]) @ data.features.T
    np.testing.assert_allclose(whole, data.s, atol=1e-9)  # rounding of sums of numbers near 100
    np.testing.assert_allclose(whole[1:], data.s_next[:-1], atol=1e-9)
    np.testing.assert_allclose(data.s[:, -1], 1.0)
    np.testing.assert_allclose(data.e.mean(axis=0), 0.0, atol=1e-10)


def test_a_window_that_predicts_nothing_is_refused():
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(400, 1)), rng.normal(size=(400, 1))
    with pytest.raises(
        ValueError,
        match="the window predicts nothing beyond the noise of the sensors; probe with a larger amplitude, "
        "or record longer",
    ):
        predicted_tuples(learn([u], [y], longest=2), [u], [y])


def test_a_record_shorter_than_the_shortest_window_needs_is_refused(record):
    with pytest.raises(
        ValueError, match="expected more than 24 complete windows of 6 samples, found 20; record longer"
    ):
        learn([record[0][:26]], [record[1][:26]], longest=6)


def test_a_stored_window_comes_back_as_it_was(record):
    window = learn([record[0][:900]], [noisy(record[1], 0.1)[:900]], longest=4, offset=True)
    stored = window_route.stored(window)
    assert all(unit and meaning for _, unit, meaning in stored.values())
    back = window_route.restored({name: values for name, (values, _, _) in stored.items()})
    for name, before, after in zip(window._fields, window, back, strict=True):
        np.testing.assert_array_equal(after, before, err_msg=name)
    one, other = (law(w, I5, I7, GAMMA) for w in (window, back))
    np.testing.assert_array_equal(one.K, other.K)
    assert baam().m == back.Theta.shape[1] // back.N - 5
