"""What is sent to the machine: when nothing may be sent and why, how far setpoints may move, and how long to
wait.

The loop through pixels (`pixels`) and the simulators (`simulator`) call the same functions, so what is tested
is what would run. In the simulators every window may be acted on. Functions for limits and holds take numpy
or jax arrays, with any leading axes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

REASONS = (
    "acts",
    "too few valid frames",
    "out of distribution",
    "tip moved",
    "cannot judge this camera",
    "the picture stands still",
)
ACTS, FEW, FOREIGN, TIP, UNPROVEN, STILL = range(6)
REMEMBERED = 64  # actions remembered for the travel of 60 s: a window takes about a second


# ---- when to hold


def still(flow_seen, last_seen):
    """Returns STILL if a window shows exactly the flow of the one before, to the last bit, which no working
    camera does; else ACTS. NaN, from a camera that shows classes only, is never still."""
    return STILL * (flow_seen == last_seen)


def decide(
    controller: Any, parameters: Any, memory: Any, observation: Any, reason: jax.Array, key: jax.Array
) -> tuple[Any, Any]:
    """Returns memory and action of one episode, from a `simulator.SetpointController` and a
    `simulator.Observation`. Memory is kept as it was unless the reason is ACTS. The action is valid only if
    the reason is ACTS; the caller must check this."""
    after, action = controller.act(parameters, memory, observation, key)
    return jax.tree.map(lambda new, old: jnp.where(reason == ACTS, new, old), after, memory), action


# ---- what may be sent


class SetpointLimits(NamedTuple):
    """Limits of (flow in percent, target temperature in °C), each (2,): the range, the largest change of one
    action, and the total travel allowed in any 60 s."""

    low: np.ndarray
    high: np.ndarray
    per_action: np.ndarray
    per_minute: np.ndarray


class Setpoints(NamedTuple):
    """Setpoints as sent: `value` (..., 2); the last H moves, `times` (..., H) in s and `moves` (..., H, 2),
    oldest first. `clipped` (..., 4) counts how often the size of one action, the travel of a minute or the
    range cut a change, and how often a change was no number."""

    value: Any
    times: Any
    moves: Any
    clipped: Any


def setpoints(start: np.ndarray, limits: SetpointLimits) -> Setpoints:
    """Returns setpoints at rest at start (E, 2). Raises ValueError if a start lies outside the range."""
    start = np.asarray(start, float)
    outside = ~((start >= limits.low) & (start <= limits.high)).all(axis=1)
    if outside.any():
        raise ValueError(
            f"setpoints: expected a start within {np.asarray(limits.low)} to {np.asarray(limits.high)} (flow "
            "in percent, target in °C), "
            f"found {start[outside][0]}; bring the machine there by hand first"
        )
    return at_rest(start, remembered=REMEMBERED)


def at_rest(value, *, remembered: int) -> Setpoints:
    """Returns setpoints `value` (..., 2) that did not move in the last minute, with room for `remembered`
    moves."""
    xp, lead = value.__array_namespace__(), value.shape[:-1]
    return Setpoints(
        value,
        xp.full((*lead, remembered), -xp.inf),
        xp.zeros((*lead, remembered, 2)),
        xp.zeros((*lead, 4), dtype=int),
    )


def moved(state: Setpoints, change, time_s, limits: SetpointLimits) -> Setpoints:
    """Returns the setpoints after the requested change (..., 2) at time_s (...,). The change is limited to
    the size of one action, to the travel left of the last 60 s, and to the range.

    Nothing moves if a change is no number, or if the oldest remembered move still lies within 60 s. Every cut
    is counted.
    """
    xp = state.value.__array_namespace__()
    number = xp.isfinite(change).all(axis=-1)
    wanted = xp.where(number[..., None], change, 0.0)
    recent = (time_s[..., None] - state.times < 60.0)[..., None] * xp.abs(state.moves)
    left = xp.maximum(limits.per_minute - recent.sum(axis=-2), 0.0)
    left = xp.where((recent[..., 0, :] > 0).any(axis=-1)[..., None], 0.0, left)
    small = xp.clip(wanted, -limits.per_action, limits.per_action)
    allowed = xp.clip(small, -left, left)
    value = xp.clip(state.value + allowed, limits.low, limits.high)
    cuts = xp.stack(
        [
            (small != wanted).any(axis=-1),
            (allowed != small).any(axis=-1),
            (value != state.value + allowed).any(axis=-1),
            ~number,
        ],
        axis=-1,
    )
    times = xp.concatenate([state.times[..., 1:], time_s[..., None]], axis=-1)
    moves = xp.concatenate([state.moves[..., 1:, :], (value - state.value)[..., None, :]], axis=-2)
    return Setpoints(value, times, moves, state.clipped + cuts)


class Waits(NamedTuple):
    """Seconds to the next window after an action that moved the flow, that moved the temperature, or that
    moved nothing."""

    flow_s: float | jax.Array
    temperature_s: float | jax.Array
    idle_s: float | jax.Array


def wait_after(change, waits: Waits):
    """Returns the seconds (...,) to wait after the changes (..., 2) that were actually sent: the longest wait
    that applies."""
    xp = change.__array_namespace__()
    moves = change != 0
    asked = xp.maximum(moves[..., 0] * waits.flow_s, moves[..., 1] * waits.temperature_s)
    return xp.maximum(asked, waits.idle_s)
