"""The Bayes filter of the flow with numpy alone: each window moves the belief, and the move of least
expected loss follows. Reads filter.safetensors with flow_reader.read_safetensors. Letters as in the project's
bayes.py.

The camera's watch, held windows, waits and limits of what is sent are not in it: where the judged controller
would hold because the camera is not the one of its table, this one moves."""

import math

import numpy as np


def start(f):
    """The state before the first window."""
    return {"belief": np.array(f["prior"], float), "last_code": -1}


def code(f, shares, named, flow_seen):
    """The window as the number of a row of `evidence`: by its flow where it shows one, else by its class."""
    classes, levels, faintest = int(f["class_codes"]), int(f["levels"]), float(f["faintest"])
    if np.isfinite(flow_seen):
        at = math.floor(math.log(flow_seen / f["good_border"]) / f["flow_code_width"]) + f["first_good"]
        return classes + int(np.clip(at, 0, f["evidence"].shape[1] - classes - 1))
    s = math.log((shares[2] + faintest) / (shares[0] + faintest)) / math.log((1 + faintest) / faintest)
    within = (s + 1.0, (s + 0.8) / 1.6, s)[named]
    return named * levels + int(np.clip(math.floor(within * levels), 0, levels - 1))


def shifted(f, belief, move):
    """The belief (N,) moved by `move` percent, linear between grid points; nothing leaves the grid."""
    grid = f["grid"]
    after = np.zeros(len(grid))
    at = np.clip((grid + move - grid[0]) / (grid[1] - grid[0]), 0, len(grid) - 1)
    low = np.minimum(np.floor(at).astype(int), len(grid) - 2)
    np.add.at(after, low, belief * (low + 1 - at))
    np.add.at(after, low + 1, belief * (at - low))
    return after


def update(f, state, shares, named, flow_seen, flow_move):
    """The state after `flow_move` percent and the window that followed it."""
    belief, hazard = state["belief"], float(f["hazard"])
    moved = np.stack(
        [shifted(f, one, gain * flow_move) for one, gain in zip(belief, f["gains"], strict=True)]
    )
    jumped = (f["after_jump"].T @ belief.sum(axis=1))[:, None] * f["grid_prior"]
    predicted = f["transition"].T @ ((1 - hazard) * moved + hazard * jumped)
    shown = code(f, shares, named, flow_seen)
    may_repeat = state["last_code"] >= 0 and flow_move == 0
    repeats = (f["window_repeat_probability"] * may_repeat)[:, None]
    after = predicted * (repeats * (shown == state["last_code"]) + (1 - repeats) * f["evidence"][:, shown])
    return {"belief": after / after.sum(), "last_code": shown}


def move(f, state, flow_move):
    """The move of the flow setpoint in percent with the least expected loss. A correction costs its fixed
    cost where it begins: what goes on in the direction of flow_move, the last one, has paid it."""
    correction, begins = f["corrections"][:, None, None], f["begins"]
    miss = np.abs(f["grid"] + f["gains"][:, None] * correction - 100.0)
    spread = max(float(f["border_std"]), 1e-4)
    outside = np.vectorize(lambda z: 0.5 * math.erfc(-z / math.sqrt(2)))((miss - 10.0 - 1e-3) / spread)
    loss = ((miss + f["outside_cost"] * outside) * state["belief"]).sum(axis=(1, 2))
    moves = f["flow_moves"]
    new = (moves != 0) & (moves * flow_move <= 0)
    best = np.array([loss[begins == i].min() for i in range(len(moves))])
    return float(moves[np.argmin(best + f["move_cost"] * np.abs(moves) + f["move_fixed_cost"] * new)])
