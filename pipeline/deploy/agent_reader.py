"""Our agent with numpy alone: the filter's belief -> the moves of both setpoints. Reads agent.safetensors
with flow_reader.read_safetensors; the belief is that of flow_filter.py beside it:

state = flow_filter.update(f, state, shares, named, flow_seen, flow_move)
rests = flow_filter.move(f, state, flow_move) == 0
flow, temperature = agent_reader.moves(a, state["belief"], rests, temperature_degC, target_degC, step)
"""

import numpy as np


def correction(a, head, x):
    """(5,) of each action: a common part, and a part of each with mean zero (Wang et al. 2016)."""
    for i in range(int(a[f"{head}.layers"])):
        x = np.maximum(a[f"{head}.hidden.{i}.weight"] @ x + a[f"{head}.hidden.{i}.bias"], 0)
    common, *part = a[f"{head}.last.weight"] @ x + a[f"{head}.last.bias"]
    return common + part - np.mean(part)


def standing_values(a, u, target, heeded):
    """(5,) of each move of the target were it to stand thereafter: sum over k of gamma^(k-1) r(u_k), with
    u_k - target = (1 - 1/delta)^k (u - target) and r = 2 / (1 + |u - u*| / width) - 1."""
    gamma, last, (low, high) = float(a["slow_gamma"]), int(a["ahead"]), a["temperature_limits"]
    target, k = np.clip(target + heeded * a["temperature_moves"], low, high), np.arange(1, last + 1)[:, None]

    def r(u):
        return 2 / (1 + np.abs(u - a["best_temperature"]) / a["reward_width"]) - 1

    ahead = target + (1 - 1 / a["delta"]) ** k * (u - target)
    return (gamma ** (k - 1) * r(ahead)).sum(axis=0) + gamma**last / (1 - gamma) * r(target)


def values(a, belief, rests, u, target, step):
    """Q (2, 5) of the five moves of the flow and of the temperature. Where the filter `rests`, no move of the
    flow is best; a move of the temperature counts at every `clock`-th step."""
    flow, stand, clock = belief.sum(axis=0), int(a["stand"]), int(a["clock"])
    heeded = step % clock == 0
    Q_flow, Q_temperature = a["values"] @ flow, standing_values(a, u, target, heeded)
    x = np.r_[Q_flow - Q_flow.max(), flow @ a["pooling"], belief.sum(axis=1)]
    Q_flow = Q_flow + correction(a, "flow", x)
    if rests:
        others = np.arange(len(Q_flow)) != stand
        Q_flow = np.where(others, np.minimum(Q_flow, Q_flow[stand] - a["at_rest"]), Q_flow)
    degrees = (np.array([u, target]) - a["best_temperature"]) / a["temperature_scale"]
    added = correction(a, "temperature", np.r_[Q_temperature, degrees, step % clock / clock, heeded])
    return np.stack([Q_flow, Q_temperature + (added if heeded else added[stand])])


def moves(a, belief, rests, u, target, step):
    """The moves of the flow setpoint in percent and of the temperature's target in °C after the window of
    decision `step`, at the temperature u and its target in °C."""
    flow, temperature = values(a, belief, rests, u, target, step).argmax(axis=1)
    heeded = step % int(a["clock"]) == 0
    return float(a["flow_moves"][flow]), float(heeded * a["temperature_moves"][temperature])
