"""The nearest reachable flow is nearest, and reachable."""

import numpy as np
import pytest
import scipy.optimize

from pipeline.deposition.drive import UNLIMITED, Drive
from pipeline.deposition.extruder import Extruder, routine
from pipeline.deposition.reachable import LOSS, lost, nearest, ramp_that_loses_little
from tests.foreign.drive import nearest_response


def pulse(N):
    return np.where((np.arange(N) > N / 3) & (np.arange(N) < 2 * N / 3), 1.0, 0.0)


def rates(x, pole):
    return x - pole * np.concatenate([[0.0], x[:-1]])


def test_a_flow_within_reach_is_its_own_nearest():
    x = np.sin(np.linspace(0, np.pi, 200)) ** 2
    flow = nearest(x, np.zeros(200, bool), pole=0.95, bound=2 * np.abs(rates(x, 0.95)).max())
    np.testing.assert_allclose(flow, x, atol=1e-5)  # the barrier's last weight


def test_the_nearest_flow_is_within_reach_and_as_near_as_a_general_solver_gets():
    N, pole, bound = 120, 0.95, 0.08
    G = np.array([[pole ** (t - s) if t >= s else 0.0 for s in range(N)] for t in range(N)])
    best = scipy.optimize.lsq_linear(G, pulse(N), bounds=(-bound, bound), tol=1e-12)
    flow = nearest(pulse(N), np.zeros(N, bool), pole=pole, bound=bound)
    assert np.abs(rates(flow, pole)).max() <= bound
    # the barrier stops within 2 N 1e-7 bound^2 of the least cost
    assert np.sum((flow - pulse(N)) ** 2) / 2 <= best.cost + 2 * N * 1e-7


@pytest.mark.parametrize(
    ("pole", "bound", "step"), [(0.95, 0.15, 0.03), (0.99, 0.1, 0.01), (0.95, np.inf, 0.02), (0.9, 0.3, 0.2)]
)
def test_with_a_speed_it_is_within_reach_too_and_as_near_as_a_general_solver_gets(pole, bound, step):
    N = 60
    target = pulse(N) + 0.1 * np.random.default_rng(1).standard_normal(N)
    V = np.eye(N) - pole * np.eye(N, k=-1)
    W = V - np.vstack([np.zeros(N), V[:-1]])
    most = np.concatenate([np.full(N, min(bound, 1e3)), np.full(N, step)])
    A, most = np.vstack([V, W, -V, -W]), np.tile(most, 2)
    best = scipy.optimize.minimize(
        lambda x: np.sum((x - target) ** 2) / 2,
        np.zeros(N),
        jac=lambda x: x - target,
        method="SLSQP",
        constraints={"type": "ineq", "fun": lambda x: most - A @ x, "jac": lambda x: -A},
        options={"maxiter": 500, "ftol": 1e-13},
    )
    assert best.success
    x = nearest(target, np.zeros(N, bool), pole=pole, bound=bound, step=step)
    assert np.all(A @ x <= most)
    # the barrier stops within 4 N 1e-7 of the least cost, in its own unit of at most 1
    assert abs(np.sum((x - target) ** 2) / 2 - best.fun) <= 4 * N * 1e-7


@pytest.mark.parametrize("wandering", [False, True])
def test_any_linear_response_is_as_near_as_a_general_solver_gets(wandering):
    """Two modes, as creep or a second lag has; and a pole that changes with time, as up and down apart."""
    N, step = 50, 0.6
    target = pulse(N) + 0.05 * np.random.default_rng(2).standard_normal(N)
    if wandering:
        pole = np.where(np.arange(N) % 20 < 10, 0.9, 0.8)
        command, output = [1 / (1 - pole), -pole / (1 - pole)], [0.7, 0.3]
    else:
        command, output = np.poly([0.9, 0.7]).tolist(), [0.05, 0.02, -0.04]
    A, B = (
        sum(np.diag(np.broadcast_to(tap, N)[k:], -k) for k, tap in enumerate(taps))
        for taps in (command, output)
    )
    bound = 1.5 if wandering else 2.0
    S = A - np.vstack([np.zeros(N), A[:-1]])
    rows, most = np.vstack([A, S, -A, -S]), np.tile(np.repeat([bound, step], N), 2)
    z = nearest_response(target, np.zeros(N, bool), output=output, command=command, bound=bound, step=step)
    assert np.all(rows @ z <= most) and np.isclose(np.abs(A @ z).max(), bound, rtol=1e-3)
    # no direction that the limits leave open comes nearer: a bounded least squares on v = A z, projected
    best = scipy.optimize.minimize(
        lambda v: np.sum((B @ np.linalg.solve(A, v) - target) ** 2) / 2,
        A @ z * 0.9,
        jac=lambda v: np.linalg.solve(A.T, B.T @ (B @ np.linalg.solve(A, v) - target)),
        method="SLSQP",
        bounds=[(-bound, bound)] * N,
        constraints={"type": "ineq", "fun": lambda v: step - np.abs(np.diff(v, prepend=0.0))},
        options={"maxiter": 500, "ftol": 1e-12},
    )
    cost = np.sum((B @ z - target) ** 2) / 2
    assert best.success and abs(cost - best.fun) <= 1e-3 * best.fun


def test_the_ramp_that_loses_little_does_and_a_shorter_one_loses_more():
    extruder, drive = Extruder(0.89, 4.5, yield_=0.1), Drive(10.0, 20.0, 0.05)

    def ramp_s(steady_flow=2.432, drive=drive):
        return ramp_that_loses_little(
            extruder, drive, steady_flow=steady_flow, ramp_s=0.15, longest_s=5.0, sample_time_s=0.02
        )

    longer = ramp_s()
    # a line as the training routine begins it; peak (1 + tau / ramp) x steady is the amplitude at 1.7 s
    lines = [
        routine(
            off_s=9, on_s=6 + x, pause_s=9, tail_s=9, speed=8.0, bead_area_mm2=0.304, ramp_s=0.15,
            gantry_ramp_s=x, sample_time_s=0.02,
        ).r
        for x in (longer, 0.8 * longer)
    ]  # fmt: skip
    assert 1.0 < longer < 1.7
    losses = [lost(extruder, r, drive, 0.02) for r in lines]
    assert losses[0] < 1.2 * LOSS < losses[1]
    assert ramp_s(steady_flow=1.5) < 0.7 * longer  # slower printing needs less
    assert ramp_s(drive=UNLIMITED) == 0.0
    assert ramp_s(drive=Drive(2.5, 20.0, 0.0)) == np.inf  # not even the steady flow


def test_a_speed_that_is_not_met_changes_nothing_that_counts_and_no_limits_nothing_at_all():
    target = pulse(300)
    limited = nearest(target, np.zeros(300, bool), pole=0.95, bound=0.08)
    steps = np.abs(np.diff(rates(limited, 0.95), prepend=0.0)).max()
    same = nearest(target, np.zeros(300, bool), pole=0.95, bound=0.08, step=100 * steps)
    np.testing.assert_allclose(same, limited, atol=1e-5)
    np.testing.assert_array_equal(nearest(target, target == 0, pole=0.95, bound=np.inf), target)


def test_where_no_flow_is_wanted_only_what_lies_above_costs():
    free = pulse(120) == 0
    # a target before the pulse that cannot be followed: tied to it, x lies above it half of the time
    target = np.where(free, 0.2 * np.sin(np.arange(120.0)), 1.0)
    flow, tied = (nearest(target, mask, pole=0.95, bound=0.08) for mask in (free, np.zeros(120, bool)))

    def cost(x):
        return np.sum(np.where(free, np.maximum(x - target, 0.0), x - target) ** 2)

    assert cost(flow) < 0.999 * cost(tied)
    assert np.abs(rates(flow, 0.95)).max() <= 0.08


def test_in_pieces_a_long_signal_comes_as_near_as_solved_at_once():
    """Lines at random, most of which the drive cannot follow, and what no line wants left free."""
    rng, pole, bound, step = np.random.default_rng(3), 0.9934, 0.05, 0.0018
    wanted = np.repeat(rng.choice([0.0, 2.4, 3.2], 50, p=[0.2, 0.4, 0.4]), rng.integers(20, 500, 50))
    free, target = wanted == 0, wanted + 0.08
    low = np.where(free, 0.0, target)
    whole = nearest_response(
        target, free, output=(1.0,), command=(1.0, -pole), bound=bound, step=step, rest=low
    )
    quick = nearest(target, free, pole=pole, bound=bound, step=step, rest=low, piece=2000)

    def cost(x):
        return np.sum(np.where(free, np.maximum(x - target, 0.0), x - target) ** 2)

    v = rates(quick, pole)
    assert np.abs(v).max() <= bound * (1 + 1e-6)  # across the joins too
    assert np.abs(np.diff(v, prepend=0.0)).max() <= step * (1 + 1e-6)
    assert np.mean(np.abs(np.diff(v)) > 0.99 * step) > 0.1
    assert abs(cost(quick) / cost(whole) - 1) <= 1e-5
    np.testing.assert_allclose(quick[~free], whole[~free], atol=5e-3 * bound)


def test_a_margin_too_short_for_what_follows_is_doubled():
    """A flow that the drive must set out for 300 samples ahead, begun just behind a join."""
    pole, bound, N = 0.995, 0.01, 3000
    target = np.where(np.arange(N) >= 1060, 1.5, 0.5)
    none = np.zeros(N, bool)
    whole = nearest(target, none, pole=pole, bound=bound)
    quick = nearest(target, none, pole=pole, bound=bound, piece=1000, margin=20)
    np.testing.assert_allclose(quick, whole, atol=0.03 * bound)


@pytest.mark.parametrize(("bound", "step"), [(0.05, np.inf), (np.inf, 0.002)])
def test_in_pieces_one_limit_is_enough(bound, step):
    target, none = 3 * pulse(9000), np.zeros(9000, bool)
    quick = nearest(target, none, pole=0.99, bound=bound, step=step)
    whole = nearest_response(target, none, output=(1.0,), command=(1.0, -0.99), bound=bound, step=step)
    np.testing.assert_allclose(quick, whole, atol=5e-3 * 0.05)
    np.testing.assert_array_equal(nearest(target, none, pole=0.99, bound=bound, step=step), quick)
