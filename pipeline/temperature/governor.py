"""The governor: what keeps the predicted worst output of a family of plants within the limits of the outputs,
whatever the law asks for."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.temperature.plant import Plant
from pipeline.temperature.tracking import reached_state, robust_observer_gain


class Limits(NamedTuple):
    """low (m,) <= u <= high (m,) in percent, and at most `rate` (m,) percent a step; inf: none."""

    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray


class Governor(NamedTuple):
    """What keeps the predicted worst output of a family of f plants within its limits.

    The command moves as little as it must, so that from the next step on every member could still be stopped
    below `high` by its lowest inputs, and above `low` by its highest. In the terms of a reference governor
    (Garone, Di Cairano, Kolmanovsky 2017): the reference moves to the one for which the law would have asked
    for that command, and back-calculation tells the integrator.

    Each member has an observer x(t+1) = A x + B u + b + L (y - C x - d) of what is measured, started at
    start y(0) + start_0. Its output h instants ahead is x free_x + free_0 + per_u u, above with lowest inputs
    from the next step on and below with highest; rows run over outputs, then instants.

    Shapes with n states, p outputs, h instants: A (f, n, n), B (f, n, m), C (f, p, n), b (f, n), d (f, p),
    L (f, n, p), start (f, n, p), start_0 (f, n), free_x (f, n, p h), above_0, below_0 (f, p h),
    per_u (f, p h, m); low, high (p,) °C, margin taken off. `overshoot` °C: how far a member may be predicted
    beyond its target where that can be avoided.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    b: np.ndarray
    d: np.ndarray
    L: np.ndarray
    start: np.ndarray
    start_0: np.ndarray
    free_x: np.ndarray
    above_0: np.ndarray
    below_0: np.ndarray
    per_u: np.ndarray
    low: np.ndarray
    high: np.ndarray
    overshoot: float


class OutputLimits(NamedTuple):
    """low, high (p,) in °C, -inf and inf where none is declared; `margin` (p,) in °C is kept from both, for the
    sensors' noise; `overshoot` in °C as in Governor."""

    low: np.ndarray
    high: np.ndarray
    margin: np.ndarray
    overshoot: float


AHEAD = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
SWEEPS = 8


def governor(family: Sequence[Plant], limits: Limits, outputs: OutputLimits, *, tau: float = 1.0) -> Governor:
    """The governor of a family of plants of one order (their feed-through made a delay). A rate limit slows
    the stop: inputs go from u to the limit on a straight line that the slowest of them needs."""
    span = limits.high - limits.low
    columns = {name: [] for name in Governor._fields[:12]}
    for plant in family:
        inverse = reached_state(plant)
        free_x, per_u, above, below = [], [], [], []
        power, driven = np.eye(plant.n), np.zeros((plant.n, plant.m))
        left, right_0 = np.zeros((plant.n, plant.m)), np.zeros(plant.n)
        at = 0
        for step in range(AHEAD[-1]):
            share = np.maximum(0.0, 1.0 - step * limits.rate / span) if step else np.ones(plant.m)
            power = plant.A @ power
            driven = plant.A @ driven + plant.B * share
            left = plant.A @ left + plant.B * (1.0 - share)
            right_0 = plant.A @ right_0 + plant.b
            if step + 1 == AHEAD[at]:
                free_x.append(plant.C @ power)
                per_u.append(plant.C @ driven)
                above.append(plant.C @ (left @ limits.low + right_0) + plant.d)
                below.append(plant.C @ (left @ limits.high + right_0) + plant.d)
                at += 1
        rows = plant.p * len(AHEAD)
        parts = (
            plant.A, plant.B, plant.C, plant.b, plant.d, robust_observer_gain(plant, tau),
            inverse, -inverse @ plant.d,
            np.stack(free_x, 1).reshape(rows, plant.n).T, np.stack(above, 1).reshape(rows),
            np.stack(below, 1).reshape(rows), np.stack(per_u, 1).reshape(rows, plant.m),
        )  # fmt: skip
        for name, part in zip(columns, parts, strict=True):
            columns[name].append(part)
    return Governor(
        **{name: np.stack(parts) for name, parts in columns.items()},
        low=outputs.low + outputs.margin,
        high=outputs.high - outputs.margin,
        overshoot=outputs.overshoot,
    )


def governed(
    governor: Governor, x: np.ndarray, u: np.ndarray, y_star: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Commands (s, m) as near to u (s, m) as the rows of the governor allow, within low..high (s, m); x
    (f, s, n) states of the members, y_star (s, p) targets.

    Projections onto the most violated row of each output in turn. Only inputs whose lowering helps are lowered
    for a high limit, and raised for a low one; the high limit has the last word. A limit that cannot be kept
    is kept as far as the inputs go; an overshoot that cannot be avoided is let go.
    """
    cap = np.minimum(governor.high, y_star + governor.overshoot)
    ahead = np.matmul(x, governor.free_x)
    if np.isfinite(governor.low).any():
        floor = np.broadcast_to(-governor.low, cap.shape)
        u = -_projected(governor.per_u, -(ahead + governor.below_0[:, None]), -u, -high, floor, floor)
    if np.isfinite(cap).any():
        hard = np.broadcast_to(governor.high, cap.shape)
        u = _projected(governor.per_u, ahead + governor.above_0[:, None], u, low, hard, cap)
    return u


def _projected(per_u, free, u, low, hard, cap):
    """`governed` for one side, free (f, s, p h) + per_u u <= hard, and <= cap (s, p) where that can be kept."""
    f, s, rows = free.shape
    value = (free + np.matmul(u, per_u.transpose(0, 2, 1))).reshape(f, s, cap.shape[1], -1)
    touched = np.flatnonzero((value > cap[None, :, :, None]).any(axis=(0, 2, 3)))
    if not touched.size:
        return u
    u = u.copy()
    u[touched] = _swept(per_u, free[:, touched], u[touched], low[touched], hard[touched], cap[touched])
    return u


def _swept(per_u, free, u, low, hard, cap):
    """The projections of `governed` for cases that a row touches: free (f, s, p h), u, low (s, m), hard, cap
    (s, p)."""
    f, s, rows = free.shape
    p, m = cap.shape[1], u.shape[1]
    h = rows // p
    helps, hurts = np.maximum(per_u, 0.0), np.minimum(per_u, 0.0)
    least = free + np.matmul(low, helps.transpose(0, 2, 1)) + np.matmul(u, hurts.transpose(0, 2, 1))
    hard, cap = np.repeat(hard, h, axis=1), np.repeat(cap, h, axis=1)
    cap = np.where(least <= cap, cap, np.maximum(hard, least)).reshape(f, s, p, h)
    free, per_u, helps = (array.reshape(f, *shape) for array, shape in (
        (free, (s, p, h)), (per_u, (p, h, m)), (helps, (p, h, m))
    ))  # fmt: skip
    case = np.arange(s)
    for _ in range(SWEEPS):
        for j in range(p):
            excess = free[:, :, j] + np.matmul(u, per_u[:, j].transpose(0, 2, 1)) - cap[:, :, j]
            excess = excess.transpose(1, 0, 2).reshape(s, f * h)
            worst = excess.argmax(axis=1)
            direction = helps[:, j].reshape(f * h, m)[worst] * (u > low)
            size = (direction**2).sum(axis=1)
            step = np.maximum(excess[case, worst], 0.0) / np.where(size > 0, size, np.inf)
            u = np.maximum(u - step[:, None] * direction, low)
    return u


def started(family: Governor, y: np.ndarray) -> np.ndarray:
    """States (f, s, n) of the members at measured outputs y (s, p)."""
    return np.matmul(y, family.start.transpose(0, 2, 1)) + family.start_0[:, None]


def observed(family: Governor, x: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """States (f, s, n) a sample after inputs u (s, m) were applied where y (s, p) was measured."""
    error = y - np.matmul(x, family.C.transpose(0, 2, 1)) - family.d[:, None]
    return (
        np.matmul(x, family.A.transpose(0, 2, 1))
        + np.matmul(u, family.B.transpose(0, 2, 1))
        + family.b[:, None]
        + np.matmul(error, family.L.transpose(0, 2, 1))
    )
