"""The Bayes filter of the flow with numpy alone: each window updates the belief, and the move of least
expected loss follows. Reads filter.safetensors with flow_reader.read_safetensors. Letters are as in the
project's flow_filter.py.

Not included: when nothing may be sent, waits, and limits of what is sent.
"""

import math

import numpy as np


def start(f):
    """Returns the belief (G, Z, N) before the first window."""
    prior = f["weight"][:, None] * f["prior"] / len(f["gains"])
    return np.tile(np.asarray(prior, float), (len(f["gains"]), 1, 1))


def shifted(f, belief, move):
    """Returns the belief (Z, N) moved by `move` percent, linear between grid points; nothing leaves the
    grid."""
    grid, after = f["grid"], np.zeros(belief.shape)
    at = np.clip((grid + move - grid[0]) / (grid[1] - grid[0]), 0, len(grid) - 1)
    low = np.minimum(np.floor(at).astype(int), len(grid) - 2)
    for one, kept in zip(after, belief, strict=True):
        np.add.at(one, low, kept * (low + 1 - at))
        np.add.at(one, low + 1, kept * (at - low))
    return after


def update(f, belief, named, flow_seen, flow_move):
    """Returns the belief after a move of `flow_move` percent and the window that followed it."""
    moved = np.stack([shifted(f, b, gain * flow_move) for b, gain in zip(belief, f["gains"], strict=True)])
    jumped = belief.mean(axis=0) @ f["jump"]
    belief = (1 - f["hazard"]) * moved + f["hazard"] * jumped
    another = f["weight"][:, None] * belief.sum(axis=1, keepdims=True)
    belief = ((1 - f["ends"]) * belief + f["ends"] * another) * evidence(f, named, flow_seen)
    return belief / belief.sum()


def evidence(f, named, flow_seen):
    """Returns P(window | misreading, flow) up to a factor: from the flow that the window shows, else from its
    class."""
    if np.isfinite(flow_seen):
        deviation = (math.log(flow_seen / 100) - f["shown"] - f["bias"][:, None]) / f["noise"]
        density = np.exp(-0.5 * deviation**2) / f["noise"] / math.sqrt(2 * math.pi)
        anything = f["outliers"] / math.log(f["grid"][-1] / f["grid"][0])
        return (1 - f["outliers"]) * density + anything
    right = np.where(f["grid"] < f["good"][0], 0, np.where(f["grid"] > f["good"][1], 2, 1)) == named
    return np.where(right, f["accuracy"], (1 - f["accuracy"]) / 2)


def move(f, belief, flow_move):
    """Returns the move of the flow setpoint in percent with the least expected loss. A correction has a fixed
    cost at its start only. A move in the direction of the last one, `flow_move`, continues a correction and
    has no fixed cost."""
    correction, begins = f["corrections"][:, None, None], f["begins"]
    miss = np.abs(f["grid"] + f["gains"][:, None] * correction - 100.0)
    normal = np.vectorize(lambda z: 0.5 * math.erfc(-z / math.sqrt(2)))
    outside = normal((miss - 10.0 - 1e-3) / float(f["border_std"]))
    loss = ((miss + f["outside_cost"] * outside) * belief.sum(axis=1)).sum(axis=(1, 2))
    moves = f["flow_moves"]
    new = (moves != 0) & (moves * flow_move <= 0)
    best = np.array([loss[begins == i].min() for i in range(len(moves))])
    return float(moves[np.argmin(best + f["move_cost"] * np.abs(moves) + f["move_fixed_cost"] * new)])
