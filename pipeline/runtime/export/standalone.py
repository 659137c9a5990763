"""What stands in an exported Python file in place of functions that need more than numpy.

`_steady` is tracking._steady with scipy's bounded least squares written out, step by step as
scipy.optimize.lsq_linear(method="bvls") takes them, so that the same target follows bit by bit (a test holds
both against each other). `_triangular` refuses references that move: they need a Schur form.
"""

import numpy as np

from pipeline.temperature.plant import Plant
from pipeline.temperature.tracking import Target


def _steady(plant: Plant, r: np.ndarray, low: np.ndarray, high: np.ndarray, slack: float) -> Target:
    """Bounded least squares over u, the state eliminated: x = (I - A)^-1 (B u + b); a plant that only
    integrates is taken to leak 1e-9 a step."""
    m, light = plant.m, 1e-6
    balance = np.eye(plant.n) - plant.A
    if np.linalg.cond(balance) > 1e13:
        balance = balance + 1e-9 * np.eye(plant.n)
    per_u, at_rest = np.linalg.solve(balance, plant.B), np.linalg.solve(balance, plant.b)
    rows = np.vstack([plant.C @ per_u + plant.D, light * np.eye(m)])
    right = np.concatenate([r - plant.d - plant.C @ at_rest, np.zeros(m)])
    slack = min(slack, 0.49 * (high - low).min())
    u = bounded_least_squares(rows, right, low + slack, high - slack)
    x = per_u @ u + at_rest
    y = plant.C @ x + plant.D @ u + plant.d
    return Target(x, u, y, y - r, slack)


OPTIMAL = 1e-15  # of the gradient, and of the cost's fall, below which the minimum is found


def bounded_least_squares(A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """x (n,) that minimises |A x - b|^2 within low..high (n,); A (rows, n), b (rows,) (Stark and Parker
    1995)."""
    x = np.linalg.lstsq(A, b, rcond=-1)[0]
    if np.all((x >= low) & (x <= high)):
        return x
    at = np.zeros(len(x))
    at[x <= low], at[x >= high] = -1, 1
    x = np.where(at < 0, low, np.where(at > 0, high, x))
    _settle_free(A, b, low, high, x, at)
    miss = A @ x - b
    cost, g = 0.5 * np.dot(miss, miss), A.T @ miss
    for _ in range(len(x)):
        if np.max(np.where(at == 0, np.abs(g), g * at)) < OPTIMAL:
            break
        at[np.argmax(g * at)] = 0
        while _moved_until_bound(A, b, low, high, x, at):
            pass
        miss = A @ x - b
        before, cost, g = cost, 0.5 * np.dot(miss, miss), A.T @ miss
        if before - cost < OPTIMAL * before:
            break
    return x


def _settle_free(
    A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, x: np.ndarray, at: np.ndarray
) -> None:
    """Least squares of what is free; what leaves its limits is put there, until nothing does."""
    while (at == 0).any():
        free = np.flatnonzero(at == 0)
        z = np.linalg.lstsq(A[:, free], b - A.dot(x * (at != 0)), rcond=None)[0]
        below, above = z < low[free], z > high[free]
        x[free] = np.where(below, low[free], np.where(above, high[free], z))
        at[free[below]], at[free[above]] = -1, 1
        if not (below | above).any():
            break


def _moved_until_bound(
    A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, x: np.ndarray, at: np.ndarray
) -> bool:
    """Moves x to the least squares of what is free, or until an input meets a limit; whether one did."""
    free = np.flatnonzero(at == 0)
    z = np.linalg.lstsq(A[:, free], b - A.dot(x * (at != 0)), rcond=None)[0]
    below, above = np.flatnonzero(z < low[free]), np.flatnonzero(z > high[free])
    beyond = np.r_[below, above]
    if not beyond.size:
        x[free] = z
        return False
    wall = np.r_[low[free][below], high[free][above]]
    share = (wall - x[free][beyond]) / (z[beyond] - x[free][beyond])
    first = int(np.argmin(share))
    x_free = x[free].copy()
    x_free *= 1 - share[first]
    x_free += share[first] * z
    x[free] = x_free
    at[free[beyond[first]]] = -1 if first < below.size else 1
    return True


def _triangular(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """S, V with F = V S V* of a constant reference. Raises ValueError for one that moves."""
    if len(F) > 1:
        raise ValueError(
            f"expected a constant reference but found one of {len(F)} states; an exported controller is "
            "given new constant references, sample by sample"
        )
    return F + 0j, np.eye(1) + 0j
