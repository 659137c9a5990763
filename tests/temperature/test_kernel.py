"""Algorithm 2: equal to the naive form, equal to the exact kernel on noise-free data, for any reference and
offset; and what it refuses to learn from."""

import re

import numpy as np
import pytest

from pipeline.papers.published import GAMMA, REFERENCE, tuples_with_reference
from pipeline.papers.study import data_sets, exact_gains, reconstruction
from pipeline.temperature.controllers import kernel as kernels
from pipeline.temperature.controllers.kernel import (
    quadratic_gram,
    regress,
    skron,
    smat,
    svec,
    tuples,
    value_iteration,
    whitening,
    window_law,
    window_shift,
    windows,
)
from pipeline.temperature.plant import baam, plant, simulate
from pipeline.temperature.tracking import gains
from tests.temperature import naive

I5, I7 = np.eye(5), np.eye(7)
SMALL = plant(
    [[0.8, 0.2, 0.0], [-0.1, 0.7, 0.3], [0.0, 0.1, 0.9]],
    [[0.5, -1.0], [1.0, 0.3], [0.2, 0.7]],
    [[1.0, 0.5, -0.3], [0.2, -1.0, 0.8]],
)
OFFSET = SMALL._replace(b=np.array([0.3, -0.2, 0.5]), d=np.array([1.0, -2.0]))
Q2, R2 = np.array([[2.0, 0.3], [0.3, 1.0]]), np.diag([0.5, 1.5])
TURN = 0.9 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])


@pytest.fixture(scope="module")
def record():
    """The study's probing without noise: u (1700, 7), y (1700, 5)."""
    u, y = data_sets(np.random.default_rng(7), 1700, 1)
    return u[:, 0], y[:, 0]


def small_record(machine, samples=400, noise=0.0):
    rng = np.random.default_rng(0)
    u = 3 * rng.normal(size=(samples, machine.m))
    x, y = simulate(machine, u, np.ones(machine.n))
    return x, u, y + noise * rng.normal(size=y.shape)


# ---- half-vectors


def test_half_vectors_keep_the_inner_product_and_come_back():
    rng = np.random.default_rng(0)
    S, T = (M + M.T for M in rng.normal(size=(2, 5, 5)))
    assert svec(S) @ svec(T) == pytest.approx(np.trace(S @ T), rel=1e-13)  # rounding of 15 terms
    np.testing.assert_allclose(smat(svec(S), 5), S, rtol=1e-15)


def test_a_half_vector_by_hand():
    np.testing.assert_allclose(
        svec(np.array([[1.0, 2.0], [2.0, 3.0]])), [1.0, 2 * np.sqrt(2), 3.0], rtol=1e-15
    )


@pytest.mark.parametrize(("a", "d"), [(3, 4), (5, 2), (1, 3), (4, 4)])
def test_skron_carries_a_congruence(a, d):
    rng = np.random.default_rng(a)
    X, S = rng.normal(size=(a, d)), rng.normal(size=(d, d))
    S = S + S.T
    # rounding of numbers near 10
    np.testing.assert_allclose(skron(X) @ svec(S), svec(X @ S @ X.T), atol=1e-13)


def test_the_gram_matrix_in_blocks_is_that_of_all_samples():
    Z = np.random.default_rng(0).normal(size=(4, 37))
    features = np.stack([svec(np.outer(z, z)) for z in Z.T])
    for block in (5, 37, 1024):
        # rounding of 37 terms
        np.testing.assert_allclose(quadratic_gram(Z, block=block), features.T @ features, rtol=1e-12)


# ---- windows


def test_windows_hold_the_past_newest_first():
    u, y = np.arange(1.0, 6)[:, None], 10 * np.arange(1.0, 6)[:, None]
    w, u_now, y_now = windows([u], [y], 2)
    np.testing.assert_array_equal(w, [[2, 1, 20, 10], [3, 2, 30, 20], [4, 3, 40, 30]])
    np.testing.assert_array_equal(np.hstack([u_now, y_now]), [[3, 30], [4, 40], [5, 50]])


def test_no_window_reaches_across_a_gap_or_holds_a_masked_sample():
    u, y = (
        [np.arange(10.0 * k, 10 * k + n)[:, None] for k, n in ((0, 8), (1, 2), (2, 5))],
        [np.arange(10.0 * k, 10 * k + n)[:, None] for k, n in ((0, 8), (1, 2), (2, 5))],
    )
    y[0][4] = np.nan
    w, u_now, _ = windows(u, y, 2)
    # of rows 2..7 of the first segment, y at 4 is in the windows of 5 and 6 and is itself the output of 4;
    # the second is too short; of the third rows 2..4 are complete
    np.testing.assert_array_equal(u_now[:, 0], [2, 3, 7, 22, 23, 24])
    np.testing.assert_array_equal(w[:, 0], u_now[:, 0] - 1)
    assert np.isfinite(w).all()


def test_segments_give_the_kernel_of_one_record():
    _, u, y = small_record(SMALL)
    whole = value_iteration(regress(tuples([u], [y], 2)), Q2, R2, 0.9)
    parts = value_iteration(regress(tuples([u[:150], u[150:]], [y[:150], y[150:]], 2)), Q2, R2, 0.9)
    # 1e-6 is where value iteration stops; another path to it through two samples less
    np.testing.assert_allclose(parts.K, whole.K, atol=1e-5)


def test_records_shorter_than_the_window_are_refused():
    with pytest.raises(
        ValueError,
        match="no segment is longer than the window of 3 samples; lower the window, or record a longer "
        "stretch without gaps",
    ):
        windows([np.ones((3, 1))], [np.ones((3, 1))], 3)


def test_the_window_shift_makes_the_next_window(record):
    u, y = record
    w, u_now, y_now = windows([u], [y], 3)
    A, B_u, B_y = window_shift(7, 5, 3)
    np.testing.assert_array_equal((w @ A.T + u_now @ B_u.T + y_now @ B_y.T)[:-1], w[1:])


# ---- whitening


def test_whitening_keeps_the_range_and_makes_the_second_moment_the_identity():
    rng = np.random.default_rng(0)
    s = rng.normal(size=(200, 3)) @ rng.normal(size=(3, 8)) * 10.0 ** np.arange(8)
    s_next = s[rng.permutation(200)]
    W, sv = whitening(s, s_next, tolerance=1e-9)
    assert (W.shape, len(sv)) == ((3, 8), 8)
    v = np.vstack([s, s_next]) @ W.T
    # rounding times the spread of scales, 1e7
    np.testing.assert_allclose(v.T @ v / 400, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(v @ np.linalg.pinv(W).T, np.vstack([s, s_next]), rtol=1e-6)


def test_the_study_s_window_of_six_has_rank_56_of_79(record):
    data = regress(tuples([record[0]], [record[1]], 6))
    # [past u; past y; u]: 7 x 6 + 6 states + 7, no reference
    assert (data.rank, data.unknowns) == (55, 1540)
    assert data.entries == 79 * 80 // 2
    assert data.condition < 1e6  # 6.6e13 without whitening
    reference = tuples_with_reference([record[0]], [record[1]], 6, REFERENCE, I5)
    assert regress(reference).rank == 56  # and the constant reference: 1,596 of 3,570
    assert regress(reference).entries == 3570


# ---- the kernel


def explicit(record, N, samples):
    u, y = (signal[:samples] / 1000 for signal in record)
    return tuples_with_reference([u], [y], N, REFERENCE / 1000, I5)


def differences(data, iterations):
    """Relative difference of H and of the gain between ours and the naive form, both from the fit of the
    stage cost, after the same number of iterations."""
    H, K = naive.value_iteration(
        data.s, data.u, data.e, data.s_next, I5, I7, GAMMA, mu=1e-4, iterations=iterations
    )
    solution = value_iteration(
        regress(data, mu=1e-4), I5, I7, GAMMA, tolerance=0.0, max_iterations=iterations
    )
    assert solution.iterations == iterations
    W, _ = whitening(data.s, data.s_next, tolerance=1e-9)
    scale = np.block(
        [
            [W, np.zeros((len(W), 7))],
            [np.zeros((7, W.shape[1])), np.diag(1 / np.sqrt((data.u**2).mean(axis=0)))],
        ]
    )
    ours = np.column_stack([solution.K, solution.k + solution.K_r @ data.base])
    return np.abs(scale.T @ solution.H @ scale - H).max() / np.abs(H).max(), np.abs(
        ours - K @ data.features
    ).max() / np.abs(K @ data.features).max()


def test_the_kernel_equals_the_naive_form_at_the_published_ridge(record):
    in_kernel, in_gain = differences(explicit(record, 2, 600), 20)
    # the naive Gram matrix has a condition near 1e9 at this ridge: seven digits of sixteen remain
    assert in_kernel <= 1e-7
    assert in_gain <= 1e-7


@pytest.mark.slow
def test_the_kernel_equals_the_naive_form_on_the_study_s_whole_problem():
    u, y = data_sets(np.random.default_rng(7), 15_000, 1)
    in_kernel, in_gain = differences(explicit((u[:, 0], y[:, 0]), 6, 15_000), 20)
    assert in_kernel <= 1e-7
    assert in_gain <= 1e-7


@pytest.mark.parametrize(("N", "samples"), [(2, 502), (6, 1616)])
def test_the_kernel_learned_without_noise_is_the_exact_one(record, N, samples):
    u, y = (signal[:samples] for signal in record)
    solution = value_iteration(regress(tuples([u], [y], N)), I5, I7, GAMMA, tolerance=1e-9)
    best = gains(baam(), I5, I7, GAMMA)
    K, K_r = exact_gains(baam(), best, N)
    w = windows([u], [y], N)[0]
    # gains on redundant windows differ where no window of the plant lies; on every window of the record the
    # input is the same to 1e-6 of its 100 percent
    np.testing.assert_allclose(w @ solution.K.T, w @ K.T, atol=1e-4)
    np.testing.assert_allclose(solution.K_r, K_r, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(solution.k, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("machine", "offset"),
    [(SMALL, False), (SMALL, True), (OFFSET, True)],
    ids=["no offset", "offset 0 learned", "offset"],
)
def test_the_learned_law_is_the_optimal_one_for_any_offset(machine, offset):
    x, u, y = small_record(machine)
    solution = value_iteration(regress(tuples([u], [y], 2, offset=offset)), Q2, R2, 0.9, tolerance=1e-12)
    best = gains(machine, Q2, R2, 0.9)
    w = windows([u], [y], 2)[0]
    # 1e-12 on the gain at stop leaves 1e-11 of a contraction 0.9;
    # whitening multiplies rounding by its condition of 1e3
    np.testing.assert_allclose(w @ solution.K.T + solution.k, x[2:-1] @ best.K_x.T + best.k, atol=1e-8)
    np.testing.assert_allclose(solution.K_r, best.K_r, atol=1e-8)


def test_the_kernel_solves_the_bellman_equation_on_every_sample():
    """v'H v = e'Qe + u'Ru + gamma s+'P s+ with P the Schur complement of H: no noise, so sample by sample."""
    _, u, y = small_record(SMALL)
    data = tuples([u], [y], 2)
    assert len(regress(data).W) == 7, "the window of two holds 2 x 2 inputs and 3 states"
    solution = value_iteration(regress(data), Q2, R2, 0.9, tolerance=1e-14)
    W, _ = whitening(data.s, data.s_next, tolerance=1e-9)
    v, s_next = np.hstack([data.s @ W.T, data.u / np.sqrt((data.u**2).mean(axis=0))]), data.s_next @ W.T
    P = solution.H[:7, :7] - solution.H[:7, 7:] @ np.linalg.solve(solution.H[7:, 7:], solution.H[7:, :7])
    stage = ((data.e @ Q2) * data.e + (data.u @ R2) * data.u).sum(axis=1)
    # rounding times condition
    np.testing.assert_allclose(
        ((v @ solution.H) * v).sum(axis=1),
        stage + 0.9 * ((s_next @ P) * s_next).sum(axis=1),
        rtol=1e-8,
        atol=1e-8,
    )


def test_exactly_so_many_iterations_are_made_as_asked_for():
    _, u, y = small_record(SMALL)
    assert (
        value_iteration(
            regress(tuples([u], [y], 2)), Q2, R2, 0.9, tolerance=0.0, max_iterations=77
        ).iterations
        == 77
    )


def test_a_stored_regression_comes_back_as_it_was():
    _, u, y = small_record(OFFSET, noise=0.1)
    data = regress(tuples([u], [y], 2, offset=True))
    stored = data.stored()
    assert all(unit and meaning for _, unit, meaning in stored.values())
    back = kernels.restored({name: values for name, (values, _, _) in stored.items()})
    for name, before, after in zip(data._fields, data, back, strict=True):
        np.testing.assert_array_equal(after, before, err_msg=name)
        assert type(after) is type(before) or np.isscalar(before), name
    one, other = (value_iteration(r, Q2, R2, 0.9) for r in (data, back))
    np.testing.assert_array_equal(one.K, other.K)


def test_window_law_takes_over_with_the_history_of_the_hold():
    K, K_r, k = np.arange(24.0).reshape(2, 12), np.ones((2, 1)), np.zeros(2)
    law = window_law(K, K_r, k, 4)
    u, y = np.array([3.0, -1.0]), np.array([50.0])
    start = law.start_u @ u + law.start_y @ y + law.start
    np.testing.assert_array_equal(start, [3, -1, 3, -1, 3, -1, 3, -1, 50, 50, 50, 50])
    # a hold goes on as a hold
    np.testing.assert_array_equal(law.A @ start + law.B_u @ u + law.B_y @ y, start)


@pytest.mark.parametrize("N", [2, 3, 6])
def test_the_state_is_reconstructed_from_the_window_to_rounding(N, record):
    u, _ = record
    x, y = simulate(baam(), u[:40], np.linspace(10, 60, 6))
    # rounding at 100 °C times the inverse of C
    np.testing.assert_allclose(windows([u[:40]], [y], N)[0] @ reconstruction(baam(), N).T, x[N:-1], atol=1e-9)


# ---- refusals


def test_too_few_samples_are_refused_with_how_many_more(record):
    u, y = record
    with pytest.raises(
        ValueError,
        match=re.escape(
            "expected at least 378 samples for its 378 unknowns, found 300; record 78 more, "
            "or lower the window below 2"
        ),
    ):
        regress(tuples([u[:302]], [y[:302]], 2))


def test_a_constant_input_is_refused_by_name(record):
    u, y = record[0].copy(), record[1]
    u[:, 3] = 12.0
    with pytest.raises(
        ValueError, match="input 4 of 7 is constant in the record; move every input while recording"
    ):
        regress(tuples([u], [y], 2))


def test_an_input_that_only_feeds_back_is_refused_by_name():
    machine, rng = SMALL, np.random.default_rng(0)
    x, u, y, rows, measured = np.ones(3), np.zeros(2), np.zeros(2), [], []
    for _ in range(400):
        y = machine.C @ x
        last = measured[-1] if measured else y
        u = np.array([3 * rng.normal(), 0.2 * last[0] - 0.1 * last[1]])
        rows.append(u)
        measured.append(y)
        x = machine.A @ x + machine.B @ u
    with pytest.raises(
        ValueError,
        match=r"input 2 of 2 follows from the past of inputs and outputs \(rank \d+ of \d+\), .* add probing "
        r"that no feedback produces",
    ):
        regress(tuples([np.array(rows)], [np.array(measured)], 2))


def test_inputs_of_two_levels_at_one_frequency_do_not_determine_the_kernel():
    """Bits are their own squares: u^2 is constant, so its entry of H cannot be told from a constant; the Gram
    matrix is singular though v has full rank."""
    bits = np.random.default_rng(0).choice([-1.0, 1.0], (400, 1))
    machine = plant([[0.0]], [[1.0]], [[1.0]])
    y = simulate(machine, bits, np.ones(1))[1]
    with pytest.raises(
        ValueError,
        match=r"does not determine the kernel: expected a Gram matrix of condition below 1e\+13 for \d+ "
        r"unknowns, found .* probe with more levels",
    ):
        regress(tuples([bits], [y], 1))


def test_a_kernel_without_a_minimum_in_u_is_refused(record):
    data = regress(tuples([record[0][:502]], [record[1][:502]], 2))
    with pytest.raises(
        ValueError,
        match=r"no minimum in u \(H_uu is not positive definite\): .* lower the window or record longer",
    ):
        value_iteration(data, I5, -1e6 * I7, GAMMA)


def test_value_iteration_that_does_not_settle_is_refused():
    _, u, y = small_record(SMALL)
    with pytest.raises(
        ValueError,
        match=r"value iteration did not settle in 1 iterations \(last relative change of the gain .*\); "
        r"record longer, or lower the window",
    ):
        value_iteration(regress(tuples([u], [y], 2)), Q2, R2, 0.9, max_iterations=1)


# ---- what no test above would notice


def test_a_regression_counts_what_it_stands_on():
    """A window of two holds 2 x 2 inputs and 3 states; the published form has all 8 of it."""
    _, u, y = small_record(SMALL)
    data = regress(tuples([u], [y], 2))
    assert (data.rank, data.unknowns, data.entries) == (9, 9 * 10 // 2, 10 * 11 // 2)
    assert data.samples == 398
    np.testing.assert_allclose(data.u_scale, np.sqrt(np.mean(u[2:] ** 2, axis=0)), rtol=1e-12)


def test_as_many_samples_as_unknowns_are_enough():
    _, u, y = small_record(SMALL, samples=400, noise=1.0)
    unknowns = regress(tuples([u], [y], 2)).unknowns
    least = tuples([u[: unknowns + 2]], [y[: unknowns + 2]], 2)
    assert regress(least).samples == unknowns
    with pytest.raises(ValueError, match=f"expected at least {unknowns} samples"):
        regress(tuples([u[: unknowns + 1]], [y[: unknowns + 1]], 2))


def test_the_innovation_has_unit_variance_and_makes_the_residual():
    rng = np.random.default_rng(0)
    residual = rng.normal(size=(500, 2)) @ np.array([[2.0, 1.0, 0.0], [0.0, 0.5, 3.0]])
    innovation, share = kernels._innovation(residual, np.array([1.0, 5.0, 10.0]), 1e-9)
    np.testing.assert_allclose(innovation.T @ innovation / 500, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(innovation @ share.T, residual, atol=1e-12)


def test_an_innovation_that_is_rounding_beside_the_largest_target_is_none():
    residual = 1e-7 * np.random.default_rng(0).normal(size=(500, 2))
    assert kernels._innovation(residual, np.array([1.0, 1e3]), 1e-9)[0].shape == (500, 0)
    assert kernels._innovation(residual, np.array([1.0, 1.0]), 1e-9)[0].shape == (500, 2)


def test_a_window_law_has_no_integral_action_unless_it_is_asked_for():
    assert window_law(np.zeros((2, 8)), np.zeros((2, 2)), np.zeros(2), 2).integral == 0
