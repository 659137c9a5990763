"""The nearest reachable flow is nearest, and reachable."""

import numpy as np
import pytest
import scipy.optimize

from pipeline.deposition.reachable import nearest


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
