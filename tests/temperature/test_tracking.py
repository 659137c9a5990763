"""Linear-quadratic tracking of a known model: exact against brute force, Algorithm 1 and its safe form, the
observer, and targets within the limits."""

import re

import control
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from pipeline.papers.published import GAMMA, K_DATA, REFERENCE, TAU, algorithm_1, stabilises
from pipeline.temperature.controllers.law import bounded_least_squares, feasible_target
from pipeline.temperature.plant import baam, hold_state, markov_parameters, plant, simulate
from pipeline.temperature.tracking import (
    aimed,
    gains,
    observer_gain,
    observer_law,
    reached_state,
    riccati,
    robust_observer_gain,
    started_reached,
    still_law,
)

I5, I7 = np.eye(5), np.eye(7)
LOW, HIGH = np.zeros(7), np.full(7, 100.0)
SMALL = plant(
    [[0.8, 0.2, 0.0], [-0.1, 0.7, 0.3], [0.0, 0.1, 0.9]],
    [[0.5, -1.0], [1.0, 0.3], [0.2, 0.7]],
    [[1.0, 0.5, -0.3], [0.2, -1.0, 0.8]],
    b=[0.3, -0.2, 0.5],
    d=[1.0, -2.0],
)
Q2, R2 = np.array([[2.0, 0.3], [0.3, 1.0]]), np.diag([0.5, 1.5])
TURN = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])


# ---- Riccati


def test_a_scalar_riccati_equation_by_hand():
    P = riccati(np.eye(1), np.eye(1), np.eye(1), np.eye(1))
    # P = 1 + P - P^2 / (1 + P) is the golden ratio; rounding
    assert P[0, 0] == pytest.approx((1 + np.sqrt(5)) / 2, rel=1e-14)


@pytest.mark.parametrize("seed", range(10))
def test_the_riccati_solution_solves_stabilises_and_is_symmetric(seed):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 9), rng.integers(1, 4)
    A, B, Q, R = (
        0.7 * rng.normal(size=(n, n)),
        rng.normal(size=(n, m)),
        rng.normal(size=(n, n)),
        rng.normal(size=(m, m)),
    )
    Q, R = Q @ Q.T, R @ R.T + np.eye(m)
    P = riccati(A, B, Q, R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    # rounding times the condition of the draw
    np.testing.assert_allclose(Q + A.T @ P @ (A - B @ K), P, atol=1e-10 * np.abs(P).max())
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1
    np.testing.assert_allclose(P, P.T, atol=1e-12 * np.abs(P).max())
    np.testing.assert_allclose(P, scipy.linalg.solve_discrete_are(A, B, Q, R), atol=1e-9 * np.abs(P).max())


def numbers(path):
    """The rows of numbers of a SLICOT example, its title and line of options left out."""
    rows = [re.findall(r"-?\d+\.\d+", line) for line in path.read_text().splitlines()[2:]]
    return np.array([float(value) for row in rows for value in row])


def test_slicot_s_discrete_example_comes_out_to_its_printed_digits(shared):
    data, printed = (
        numbers(shared("data/slicot_reference/SB02ND.dat")),
        numbers(shared("data/slicot_reference/SB02ND.res")),
    )
    A, B, C = data[:4].reshape(2, 2), data[4:6].reshape(2, 1), data[6:12].reshape(3, 2)
    # printed for R = 0, which ours excludes: the limit differs by less than the fourth digit
    R = np.full((1, 1), 1e-7)
    P = riccati(A, B, C.T @ C, R)
    np.testing.assert_allclose(P.ravel(), printed[:4], atol=5e-5)  # printed digits
    np.testing.assert_allclose(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A).ravel(), printed[4:], atol=5e-5)


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_a_mode_that_no_input_moves_is_refused():
    with pytest.raises(
        ValueError,
        match=r"no stabilising solution: .* check the columns of B, or add the input that moves it",
    ):
        riccati(np.diag([1.1, 0.5]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1))
    with pytest.raises(ValueError, match="no stabilising solution"):
        riccati(np.eye(2), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1))


# ---- gains


def best_inputs(machine, Q, R, gamma, x0, r0, steps):
    """u (steps, m) that minimises (3) over a horizon so long that its end does not matter:
    one least-squares problem, no Riccati equation."""
    free = simulate(machine, np.zeros((steps, machine.m)), x0)[1]
    h, m, p = markov_parameters(machine, steps), machine.m, machine.p
    G = np.zeros((steps, p, steps, m))
    for t in range(steps):
        for s in range(t):
            G[t, :, s] = h[t - s - 1]
    root, root_q, root_r = (
        np.sqrt(gamma ** np.arange(steps)),
        np.linalg.cholesky(Q).T,
        np.linalg.cholesky(R).T,
    )
    error = (root[:, None, None, None] * np.einsum("ij,tjsm->tism", root_q, G)).reshape(steps * p, steps * m)
    rows = np.vstack([error, np.kron(np.diag(root), root_r)])
    right = np.concatenate([(root[:, None] * ((r0 - free) @ root_q.T)).ravel(), np.zeros(steps * m)])
    return np.linalg.lstsq(rows, right, rcond=None)[0].reshape(steps, m)


def test_gains_are_optimal_for_a_reference_and_offset():
    optimal, x0, r0 = gains(SMALL, Q2, R2, 0.9), np.array([1.0, -2.0, 3.0]), np.array([20.0, -10.0])
    u = best_inputs(SMALL, Q2, R2, 0.9, x0, r0, 150)[0]
    # the end of the horizon counts 0.9^150 = 1e-7 of it, squared in its
    # effect on the first input through the closed loop
    np.testing.assert_allclose(-optimal.K_x @ x0 - optimal.K_r @ r0 - optimal.k, u, rtol=1e-7)


def test_weights_in_one_proportion_are_one_controller():
    one, other = (gains(baam(), scale * I5, scale * I7, GAMMA) for scale in (1.0, 0.4))
    # rounding: the minimiser of 0.4 J is that of J
    np.testing.assert_allclose(one.K_x, other.K_x, atol=1e-13)
    np.testing.assert_allclose(one.K_r, other.K_r, atol=1e-13)


def test_the_design_refuses_a_plant_that_jumps_with_its_input():
    with pytest.raises(
        ValueError,
        match=r"expects outputs that do not jump with the input \(D = 0\) .* plant.strictly_proper of it",
    ):
        gains(baam()._replace(D=np.ones((5, 7))), I5, I7, GAMMA)


# ---- Algorithm 1


def test_algorithm_1_from_the_probing_gain_takes_five_to_eight_policies():
    iterated = algorithm_1(baam(), I5, I7, GAMMA, np.hstack([K_DATA, np.zeros((7, 5))]), tolerance=0.1)
    assert iterated.settled
    assert 5 <= iterated.iterations <= 8
    assert stabilises(baam(), iterated.K[:, :6])


def test_algorithm_1_says_when_its_iterations_ran_out():
    iterated = algorithm_1(
        baam(), I5, I7, GAMMA, np.hstack([K_DATA, np.zeros((7, 5))]), tolerance=0.0, max_iterations=3
    )
    assert (iterated.iterations, iterated.settled) == (3, False)


def test_algorithm_1_takes_as_many_policies_as_it_is_allowed():
    K0 = np.hstack([K_DATA, np.zeros((7, 5))])

    def after(K: np.ndarray, policies: int) -> np.ndarray:
        return algorithm_1(baam(), I5, I7, GAMMA, K, tolerance=0.0, max_iterations=policies).K

    one = after(K0, 1)
    np.testing.assert_allclose(after(one, 1), after(K0, 2), rtol=1e-9, atol=1e-12)
    assert np.abs(one - K0).max() > 1e-3 and np.abs(after(K0, 2) - one).max() > 1e-3
    assert algorithm_1(baam(), I5, I7, GAMMA, K0, tolerance=0.0).iterations == 100


def test_a_gain_stabilises_only_what_has_no_mode_left_that_grows():
    two = plant(np.diag([0.5, 1.2]), np.eye(2), np.eye(2))
    assert not stabilises(two, np.zeros((2, 2))) and stabilises(two, np.diag([0.0, 0.3]))


@pytest.mark.parametrize("seed", range(40))
def test_bounded_least_squares_are_scipy_s(seed):
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(7, 5)), 3 * rng.normal(size=7)
    low, high = np.full(5, -0.3), np.full(5, 0.2)
    theirs = scipy.optimize.lsq_linear(A, b, (low, high), method="bvls", tol=1e-15).x
    np.testing.assert_allclose(bounded_least_squares(A, b, low, high), theirs, atol=1e-9)


# ---- observer and targets


def test_the_observer_is_started_where_its_first_output_is_the_measured_one():
    machine = SMALL._replace(K=np.zeros((3, 2)))
    law = observer_law(machine, gains(machine, Q2, R2, 0.9), observer_gain(machine, TAU))
    y = np.array([3.0, -4.0])
    # rounding
    np.testing.assert_allclose(machine.C @ (law.start_y @ y + law.start) + machine.d, y, atol=1e-14)


def test_a_law_starts_at_the_same_state_in_any_coordinates_and_shows_the_first_measurement():
    machine, y0 = baam()._replace(d=np.arange(5.0)), np.array([150.0, 120.0, 130.0, 170.0, 180.0])
    T = np.random.default_rng(0).standard_normal((6, 6))
    turned = machine._replace(
        A=T @ machine.A @ np.linalg.inv(T), B=T @ machine.B, C=machine.C @ np.linalg.inv(T), K=T @ machine.K
    )
    starts = []
    for model in (machine, turned):
        law = started_reached(observer_law(model, gains(model, I5, I7, GAMMA), np.zeros((6, 5))), model)
        starts.append(law.start_y @ y0 + law.start)
        np.testing.assert_allclose(model.C @ starts[-1] + model.d, y0, rtol=1e-9)  # rounding
    # the Lyapunov equation loses some digits to a random T
    np.testing.assert_allclose(starts[1], T @ starts[0], rtol=1e-5)


def test_the_observer_follows_the_state_of_a_plant_with_offsets():
    law = observer_law(SMALL, gains(SMALL, Q2, R2, 0.9), observer_gain(SMALL, 0.1))
    u = np.random.default_rng(0).normal(size=(400, 2))
    x, y = simulate(SMALL, u, np.array([5.0, -5.0, 2.0]))
    z = np.zeros(3)
    for t in range(400):
        z = law.A @ z + law.B_u @ u[t] + law.B_y @ y[t] + law.c
    slowest = np.abs(np.linalg.eigvals(law.A)).max()
    # the error decays as the slowest pole of A - L C
    assert np.abs(z - x[400]).max() < 100 * slowest**400 + 1e-12


@pytest.mark.parametrize("tau", [1e-3, 1.0, 1e3])
def test_the_robust_observer_is_stable_and_the_same_in_any_coordinates(tau):
    machine = baam()
    L, V = robust_observer_gain(machine, tau), np.random.default_rng(0).normal(size=(6, 6))
    assert np.abs(np.linalg.eigvals(machine.A - L @ machine.C)).max() < 1
    other = machine._replace(
        A=V @ machine.A @ np.linalg.inv(V), B=V @ machine.B, C=machine.C @ np.linalg.inv(V)
    )
    # rounding times the square of the condition of V, 1e3
    np.testing.assert_allclose(robust_observer_gain(other, tau), V @ L, atol=1e-6)
    P = scipy.linalg.solve_discrete_are(machine.A.T, machine.C.T, machine.B @ machine.B.T, tau * I5)
    # scipy's rounding
    np.testing.assert_allclose(
        L, machine.A @ P @ machine.C.T @ np.linalg.inv(machine.C @ P @ machine.C.T + tau * I5), atol=1e-8
    )


def test_a_feasible_reference_is_hit_exactly_with_every_input_off_its_limits():
    target = feasible_target(baam(), REFERENCE, LOW, HIGH)
    np.testing.assert_allclose(target.y, REFERENCE, atol=1e-3)  # its own tolerance of reach
    assert (target.u >= LOW + target.slack).all()
    assert (target.u <= HIGH - target.slack).all()
    assert target.slack > 0.15  # 0.19 by bisection; 0.06 with the least-norm input of the temperature notes
    held = simulate(baam(), np.tile(target.u, (1000, 1)), target.x)[1]
    np.testing.assert_allclose(held, np.tile(REFERENCE, (1000, 1)), atol=2e-3)


@pytest.mark.parametrize("reference", [[150.0, 100, 170, 175, 180], [300.0, 20, 20, 20, 300]])
def test_an_infeasible_reference_is_missed_by_the_least_that_a_steady_state_allows(reference):
    machine, r = baam(), np.array(reference)
    target = feasible_target(machine, r, LOW, HIGH)
    # no other way to the same optimum shares its weights: eliminate
    # the state, whose gain of 5e5 leaves ten digits
    rest = machine.C @ np.linalg.inv(np.eye(6) - machine.A) @ machine.B
    least = np.linalg.norm(
        rest @ scipy.optimize.lsq_linear(rest, r, (LOW, HIGH), method="bvls", tol=1e-15).x - r
    )
    assert least > 0.5
    # 1e-3 of reach is given up for slack
    assert np.linalg.norm(rest @ target.u - r) == pytest.approx(least, abs=2e-3)
    # the y that it names is the y that u holds
    np.testing.assert_allclose(target.y, rest @ target.u, atol=1e-3)
    np.testing.assert_allclose(machine.A @ target.x + machine.B @ target.u, target.x, atol=1e-7)


def test_a_thousandth_of_a_degree_is_given_up_for_slack():
    """At rest y = 0.01 u: 2 degC are missed by 1, and a tenth of a percent of slack costs 0.001 more."""
    weak = plant([[0.5]], [[0.005]], [[1.0]])
    target = feasible_target(weak, np.array([2.0]), np.zeros(1), np.full(1, 100.0))
    assert 0.098 < target.slack <= 0.1 and target.miss[0] == pytest.approx(-1.001, abs=3e-5)


def test_an_aimed_law_rests_at_its_target():
    machine = baam()._replace(b=np.linspace(-0.5, 0.5, 6), d=np.linspace(3, -3, 5))
    target = feasible_target(machine, REFERENCE, LOW, HIGH)
    law = aimed(
        observer_law(machine, gains(machine, I5, I7, GAMMA), observer_gain(machine, TAU)),
        REFERENCE,
        target.u,
        target.y,
    )
    z = np.linalg.solve(np.eye(6) - law.A, law.B_u @ target.u + law.B_y @ target.y + law.c)
    # the memory at rest is the state at rest: 1e-9 of the target's balance through the slowest observer pole
    np.testing.assert_allclose(z, target.x, atol=1e-4)
    # rounding at 180 °C
    np.testing.assert_allclose(-law.K @ z - law.K_r @ REFERENCE - law.k, target.u, atol=1e-11)


def test_an_aimed_law_takes_over_from_manual_without_a_bump():
    machine, x = baam(), np.full(6, 70.0)
    u, y = hold_state(machine, x), baam().C @ x
    law = aimed(observer_law(machine, gains(machine, I5, I7, GAMMA), observer_gain(machine, TAU)), y, u, y)
    z = np.linalg.pinv(machine.C) @ y
    for _ in range(6000):  # the slowest pole of the observer is 0.9966
        z = law.A @ z + law.B_u @ u + law.B_y @ y + law.c
    # what is left of the start, 0.9966^6000 of some 10 °C
    np.testing.assert_allclose(-law.K @ z - law.K_r @ y - law.k, u, atol=1e-6)


def test_the_gain_is_control_s_dlqr_of_the_discounted_plant():
    machine = baam()
    Q, R, root = np.diag([1.0, 2.0, 0.5, 1.0, 3.0]), np.diag([0.1, 1.0, 2.0, 1.0, 0.3, 1.0, 5.0]), GAMMA**0.5
    K, P, _ = control.dlqr(root * machine.A, root * machine.B, machine.C.T @ Q @ machine.C, R)
    optimal = gains(machine, Q, R, GAMMA)
    # two ways to one solution, through a condition of 1e4
    np.testing.assert_allclose(optimal.K_x, K, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(optimal.P, P, rtol=1e-8, atol=1e-8)


# ---- what no test above would notice


def test_a_riccati_solution_scales_with_its_weights():
    """However small or large the weights are, the tolerance is a share of P."""
    P = riccati(SMALL.A, SMALL.B, I3 := np.eye(3), R2)
    for scale in (1e-12, 1e12):
        np.testing.assert_allclose(riccati(SMALL.A, SMALL.B, scale * I3, scale * R2), scale * P, rtol=1e-10)


def test_one_input_that_jumps_through_is_refused_by_design_and_by_observer():
    jumps = SMALL._replace(D=np.array([[0.0, 0.0], [0.0, 0.5]]))
    for refused in (
        lambda: gains(jumps, Q2, R2, 0.9),
        lambda: observer_law(jumps, gains(SMALL, Q2, R2, 0.9), observer_gain(SMALL, 0.5)),
    ):
        with pytest.raises(ValueError, match="the model has feed-through"):
            refused()


def test_a_law_aims_at_targets_unless_it_says_otherwise():
    assert not observer_law(SMALL, gains(SMALL, Q2, R2, 0.9), observer_gain(SMALL, 0.5)).conditional


def test_the_start_of_a_plant_that_runs_away_sums_what_its_inputs_reach():
    grows = plant([[1.2, 0.1], [0.0, 0.5]], [[1.0], [2.0]], [[1.0, 1.0]])
    A, W = 0.99 / 1.2 * grows.A, np.zeros((2, 2))
    for k in range(3000):  # 0.99^6000 is below rounding
        power = np.linalg.matrix_power(A, k) @ grows.B
        W += power @ power.T
    expected = W @ grows.C.T / (grows.C @ W @ grows.C.T)
    np.testing.assert_allclose(reached_state(grows), expected, rtol=1e-9)


def test_a_target_of_a_plant_with_feed_through_is_what_its_output_holds():
    jumps = plant([[0.5]], [[1.0]], [[1.0]], D=[[3.0]], d=[2.0])
    # at rest x = 2 u and y = x + 3 u + 2
    target = feasible_target(jumps, np.array([52.0]), np.zeros(1), np.full(1, 100.0))
    np.testing.assert_allclose(target.u, 10.0, atol=1e-3)
    np.testing.assert_allclose(target.y, 5 * target.u + 2, atol=1e-9)


def test_a_plant_that_only_integrates_rests_where_its_input_balances_the_loss():
    tank = plant([[1.0]], [[0.1]], [[1.0]], b=[-1.0])
    target = feasible_target(tank, np.array([50.0]), np.zeros(1), np.full(1, 100.0))
    np.testing.assert_allclose(target.u, 10.0, atol=1e-5)  # 0.1 u = 1; a leak of 1e-9 asks for 5e-7 more
    np.testing.assert_allclose(target.y, 50.0, atol=2e-3)
    # beside a zone that is at rest by itself: x = 2 u and u as the tank asks
    beside = plant(np.diag([1.0, 0.5]), [[0.1], [1.0]], [[1.0, 0.0]], b=[-1.0, 0.0])
    target = feasible_target(beside, np.array([50.0]), np.zeros(1), np.full(1, 100.0))
    np.testing.assert_allclose(target.x, [50.0, 20.0], atol=2e-3)


def test_the_observer_gain_by_hand():
    """0.5 x 2 / (2 x 2 + 3)."""
    one = plant([[0.5]], [[1.0]], [[2.0]])
    np.testing.assert_allclose(observer_gain(one, 3.0), [[1 / 7]], rtol=1e-15)


def test_a_still_law_remembers_nothing_and_asks_for_nothing():
    law, u, y = still_law(2, 3), np.ones(2), np.ones(3)
    z = law.start_u @ u + law.start_y @ y + law.start
    assert (law.B_u.shape, law.B_y.shape, law.c.shape) == ((0, 2), (0, 3), (0,))
    assert (law.start_u.shape, law.start_y.shape, law.start.shape) == ((0, 2), (0, 3), (0,))
    z = law.A @ z + law.B_u @ u + law.B_y @ y + law.B_r @ y + law.c
    assert z.shape == (0,)
    np.testing.assert_array_equal(-law.K @ z - law.D @ y - law.K_r @ y - law.k, np.zeros(2))


def test_an_aimed_law_that_answers_the_measurement_at_once_rests_at_its_target():
    law = observer_law(SMALL, gains(SMALL, Q2, R2, 0.9), observer_gain(SMALL, 0.5))
    law = law._replace(D=np.array([[0.3, -0.1], [0.2, 0.4]]))
    r, u, y = np.array([1.0, 2.0]), np.array([5.0, -3.0]), np.array([1.5, 2.5])
    rests = aimed(law, r, u, y)
    z = np.linalg.solve(np.eye(3) - law.A, law.B_u @ u + law.B_y @ y + law.B_r @ r + law.c)
    np.testing.assert_allclose(-rests.K @ z - rests.D @ y - rests.K_r @ r - rests.k, u, atol=1e-12)
