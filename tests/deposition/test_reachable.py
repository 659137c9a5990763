"""The nearest reachable flow is nearest, and reachable."""

import numpy as np
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


def test_where_no_flow_is_wanted_only_what_lies_above_costs():
    free = pulse(120) == 0
    # a target before the pulse that cannot be followed: tied to it, x lies above it half of the time
    target = np.where(free, 0.2 * np.sin(np.arange(120.0)), 1.0)
    flow, tied = (nearest(target, mask, pole=0.95, bound=0.08) for mask in (free, np.zeros(120, bool)))

    def cost(x):
        return np.sum(np.where(free, np.maximum(x - target, 0.0), x - target) ** 2)

    assert cost(flow) < 0.999 * cost(tied)
    assert np.abs(rates(flow, 0.95)).max() <= 0.08
