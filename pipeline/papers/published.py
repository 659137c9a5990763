"""The published values of the temperature study and its script: constants and weights, its Algorithm 1 with
the script's Lyapunov equation, and the windows with one reference. pipeline/papers/temperature.py computes
the study's figures with them; the fair reference is scorecard.py."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from pipeline.temperature.controllers.kernel import Tuples, tuples
from pipeline.temperature.plant import Plant

GAMMA, TAU = 0.99, 0.002
REFERENCE = np.array([150.0, 160.0, 170.0, 175.0, 180.0])
# (49); the discrete regulator for Q = (8/3) I, R = I
K_DATA = np.array(
    [
        [0.7395, -0.0076, -0.0003, -0.0264, 0.0194, -0.0170],
        [-0.0076, 0.7430, 0.0031, -0.0093, 0.0068, -0.0060],
        [-0.0003, -0.0033, 0.7599, 0.0021, 0.0002, -0.0002],
        [-0.0126, -0.0042, 0.0016, 1.0971, 0.0092, -0.0079],
        [0.0171, 0.0058, 0.0002, 0.0170, 0.8179, 0.0108],
        [-0.0198, -0.0067, -0.0002, -0.0193, 0.0143, 0.6823],
        [-0.1525, -0.0519, -0.0018, -0.1412, 0.1091, -0.0977],
    ]
)
IDENTITY = (np.ones(5), np.ones(7))
# (46), (47) with the fifth q as the script has it: the text prints 0.514
TUNED_MODEL = (
    np.array([0.9434381, 0.7622189, 0.5422118, 0.4198321, 0.05144575]),
    np.array([0.2997687, 0.2696552, 0.2805254, 0.09184189, 0.05358372, 0.2685642, 0.3179601]),
)
# (53), (54) with the fifth q as the script has it: the text prints 0.010
TUNED_DATA = (
    np.array([0.1740472, 0.05596686, 0.01, 0.01, 0.16019648]),
    np.array([0.14503672, 0.38862483, 0.02004028, 0.11571914, 0.09935187, 0.31611002, 0.01]),
)
PRINTED = {
    "model_based": {"J100": 183362.5, "J1000": 183436.2, "error": 0.0376},
    "model_based_tuned": {"J100": 76060.36, "J1000": 76072.6, "error": 0.0274},
    "data_driven": {"J100": 1065077.0, "J1000": 1074985.0, "error": 1.2942},
    "data_driven_tuned": {"J100": 204635.7, "J1000": 206358.8, "error": 0.3154},
}


def augmented(plant: Plant, Q: np.ndarray, F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns T, B_1 of (12) and Q_1 of (14) for the state [x; r]."""
    CQ = plant.C.T @ Q
    T = scipy.linalg.block_diag(plant.A, F)
    return T, np.vstack([plant.B, np.zeros((plant.p, plant.m))]), np.block([[CQ @ plant.C, -CQ], [-CQ.T, Q]])


class Iterated(NamedTuple):
    """K (m, n+p) of u = -K [x; r] (15), and the number of policies evaluated. `settled` is False if the limit
    of iterations ended it."""

    K: np.ndarray
    iterations: int
    settled: bool


def algorithm_1(plant: Plant, Q, R, gamma, K0, *, tolerance: float, max_iterations: int = 100) -> Iterated:
    """Runs Algorithm 1 as the study's script does: its Lyapunov equation has gamma in place of sqrt(gamma),
    and it stops on the one-norm of K's change.

    If the cost is infinite with K0, the P of (ii) is no cost, and the iteration can settle on a gain that
    does not stabilise. This is not detected here.
    """
    T, B_1, Q_1 = augmented(plant, Q, np.eye(plant.p))
    K = K0
    for j in range(1, max_iterations + 1):
        P = scipy.linalg.solve_discrete_lyapunov(gamma * (T - B_1 @ K).T, Q_1 + K.T @ R @ K)
        K, previous = np.linalg.solve(R + gamma * B_1.T @ P @ B_1, gamma * B_1.T @ P @ T), K
        if np.linalg.norm(K - previous, 1) < tolerance:
            return Iterated(K, j, True)
    return Iterated(K, max_iterations, False)


def stabilises(plant: Plant, K_x: np.ndarray) -> bool:
    """Returns whether every eigenvalue of A - B K_x lies inside the unit circle."""
    return bool(np.abs(np.linalg.eigvals(plant.A - plant.B @ K_x)).max() < 1)


def tuples_with_reference(
    u: Sequence[np.ndarray], y: Sequence[np.ndarray], N: int, r: np.ndarray, F: np.ndarray
) -> Tuples:
    """Returns the published form: s = [past u; past y; r] with one reference r (p,), r(t+1) = F r, e = y - r.
    Its kernel is valid for this reference only."""
    plain = tuples(u, y, N)
    rows = (len(plain.s), 1)
    features = np.vstack(
        [plain.features, np.hstack([np.zeros((len(r), plain.features.shape[1] - 1)), r[:, None]])]
    )
    return Tuples(
        np.hstack([plain.s, np.tile(r, rows)]),
        plain.u,
        plain.e - r,
        np.hstack([plain.s_next, np.tile(F @ r, rows)]),
        features,
        N,
        r,
    )
