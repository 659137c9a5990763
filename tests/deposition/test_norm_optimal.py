"""The banded norm-optimal step equals the dense lifted form and is the minimum that it claims."""

import numpy as np
import pytest

from benchmarks.norm_optimal import Transfer, plan, step, transfer
from pipeline.deposition.extruder import Extruder, pressed

TS = 0.02
PLANTS = [
    Extruder(1.08, 2.7),
    Extruder(1.08, 2.7, 0.1),
    Extruder(0.89, 4.5, 0.113),
    Extruder(2.0, 1.0, 0.05, 3.0),
]


def lifted(extruder, N):
    """G (N, N), the response to a pulse at each sample."""
    return pressed(extruder, np.eye(N), sample_time_s=TS).T


def problem(N, seed=0):
    rng = np.random.default_rng(seed)
    W, R_u, R_d = rng.uniform(0.0, 2.0, N), rng.uniform(0.0, 1e-3, N), rng.uniform(1e-4, 1e-3, N)
    return W, R_u, R_d, *rng.standard_normal((2, N))


@pytest.mark.parametrize("extruder", PLANTS)
def test_the_transfer_is_the_extruder(extruder):
    A, B, delay = transfer(extruder, sample_time_s=TS)
    u = np.random.default_rng(0).standard_normal(200)
    y = pressed(extruder, u, sample_time_s=TS)
    left, right = np.convolve(A, y)[:200], np.concatenate([np.zeros(delay), np.convolve(B, u)])[:200]
    np.testing.assert_allclose(left, right, atol=1e-12)  # A y = B S^d u, to rounding


@pytest.mark.parametrize("extruder", PLANTS)
def test_the_banded_step_equals_the_dense_lifted_form(extruder):
    W, R_u, R_d, u, e = problem(400)
    G = lifted(extruder, 400)
    dense = np.linalg.solve(G.T @ (W[:, None] * G) + np.diag(R_u + R_d), G.T @ (W * e) - R_u * u)
    banded = step(plan(transfer(extruder, sample_time_s=TS), W=W, R_u=R_u, R_d=R_d), u, e)
    np.testing.assert_allclose(
        banded, dense, atol=1e-9 * np.abs(dense).max()
    )  # rounding times a condition of about 1e5; the bar is 1e-6


def test_no_other_step_costs_less():
    W, R_u, R_d, u, e = problem(300, seed=1)
    G = lifted(PLANTS[2], 300)

    def cost(du):
        return W @ (e - G @ du) ** 2 + R_u @ (u + du) ** 2 + R_d @ du**2

    best = step(plan(transfer(PLANTS[2], sample_time_s=TS), W=W, R_u=R_u, R_d=R_d), u, e)
    moves = np.random.default_rng(2).standard_normal((20, 300)) * 1e-3 * np.abs(best).max()
    assert all(cost(best + move) > cost(best) for move in moves)


def test_one_sample_by_hand():
    # G = [0.5], W = 2, R_u = 1, R_d = 0.5, e = 3, u = 1: (2 x 0.25 + 1.5) du = 0.5 x 2 x 3 - 1
    made = plan(Transfer(np.array([1.0]), np.array([0.5]), 0), W=[2.0], R_u=[1.0], R_d=[0.5])
    assert step(made, np.array([1.0]), np.array([3.0]))[0] == pytest.approx(1.0)


def test_memory_grows_with_the_length_and_not_with_its_square():
    made = plan(
        transfer(PLANTS[1], sample_time_s=TS),
        W=np.ones(100_000),
        R_u=np.full(100_000, 1e-4),
        R_d=np.full(100_000, 1e-4),
    )
    assert made.factor.shape == (2, 100_000)


def test_weights_that_leave_the_step_undetermined_are_refused():
    with pytest.raises(
        ValueError, match=r"expected W >= 0 and R_u \+ R_d > 0 but found least values 1 and 0; raise R_d"
    ):
        plan(transfer(PLANTS[1], sample_time_s=TS), W=np.ones(50), R_u=np.zeros(50), R_d=np.zeros(50))
    with pytest.raises(ValueError, match=r"expected weights of one length but found W \(50,\) and R \(49,\)"):
        plan(transfer(PLANTS[1], sample_time_s=TS), W=np.ones(50), R_u=np.zeros(49), R_d=np.ones(49))
