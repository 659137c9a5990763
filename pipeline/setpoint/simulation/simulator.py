"""The printer as a setpoint controller sees it: the paper's simulator (Li and Pattinson 2025, eqs. 5-9), a
clog during an episode, and rollouts.

Each decision is made on one window of frames. At step t the controller gets an `Observation` and answers with
an `Action`; then

    q_bar <- clip(q_bar + a_q, 20, 310)     q = q_bar, clog q_bar from clog_step on
    u_bar <- clip(u_bar + a_u, 180, 240)    if t mod lambda = 0
    u_hat <- u_hat + (u_bar - u_hat) / delta

`actuation` limits what is sent and sets the waits, as in the loop through pixels. The commanded flow acts at
once, and the class depends only on the true flow q of what the picture shows. A `WindowSource` gives the
window for a flow: `paper_windows()` here, or windows recorded from a trained classifier
(`recorded.recorded_windows`). Flow is in percent of nominal, temperature in °C.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.published import (
    ALPHA,
    BEST_FLOW,
    BEST_TEMPERATURE,
    DELTA,
    FLOW_MOVES,
    LAMBDA,
    ROTATION,
    SIGMA,
    TEMPERATURE_MOVES,
)
from pipeline.setpoint.simulation import actuation
from pipeline.setpoint.simulation.actuation import SetpointLimits, Setpoints

STAND = 2  # the index of no move
FLOW_LIMITS, TEMPERATURE_LIMITS = (20.0, 310.0), (180.0, 240.0)
LIMITS = SetpointLimits(  # range, then the largest change in one action, and in 60 s
    *(np.array(pair) for pair in zip(FLOW_LIMITS, TEMPERATURE_LIMITS, strict=True)),
    np.array([10.0, 20.0]),
    np.array([100.0, 60.0]),
)
REMEMBERED = 16  # actions remembered for the 60 s limit: each takes at least 4 s
WINDOW_S = 1.0
HISTORY, CLASSES = 30, 3  # eta and n_c of (8)
UNDER, GOOD, OVER = 0, 1, 2
GOOD_BORDERS = (90.0, 110.0)  # percent
CHANCES = 5  # uniform numbers that a decision takes: three for its window, two for its segment


class Observation(NamedTuple):
    """What the controller knows at a decision. It gets neither the true flow nor a setpoint that would reveal
    it: only changes of the flow setpoint are meaningful.

    `shares` (3,): of under, good and over in the window, sum 1. `named`: the window's class 0, 1, 2.
    `flow_seen`: flow that the window shows, in percent of nominal; NaN if the camera shows classes only.
    `flow_move`: change of the flow setpoint since the controller's last observation, in percent, after
    limits. `temperature`: u_hat; `target`: u_bar, in °C. `step`: t, counts decisions; with a real or rendered
    camera, only those that led to an action.
    """

    shares: jax.Array
    named: jax.Array
    flow_seen: jax.Array
    flow_move: jax.Array
    temperature: jax.Array
    target: jax.Array
    step: jax.Array


class Action(NamedTuple):
    """Indices 0..4 into FLOW_MOVES and TEMPERATURE_MOVES. The temperature's index is applied only if step mod
    LAMBDA = 0."""

    flow: jax.Array
    temperature: jax.Array


class SetpointController(NamedTuple):
    """A pair of pure functions for one episode: start() -> memory; act(parameters, memory, observation, key)
    -> (memory, action). Use vmap over episodes and scan over steps."""

    start: Callable[[], Any]
    act: Callable[[Any, Any, Observation, jax.Array], tuple[Any, Action]]


class EpisodeConditions(NamedTuple):
    """Start and machine of one episode: scalars, or arrays (n,) with one entry for each episode.

    `flow` (percent) and `temperature` (°C): at the start. `accuracy`: rho of the paper's windows.
    `persistence`: mean number of decisions that a recorded segment lasts; 1: a new segment at each decision.
    `clog`: factor on the flow from `clog_step` on; 1: no clog. `wait_s`: after every action. `view_s`: time
    after a move until the picture shows only material laid since; 0: at once.
    """

    flow: jax.Array
    temperature: jax.Array
    accuracy: jax.Array
    persistence: jax.Array
    clog: jax.Array
    clog_step: jax.Array
    wait_s: jax.Array
    view_s: jax.Array


class MachineState(NamedTuple):
    """`sent`: setpoints (q_bar before a clog, u_bar), and the moves of the last minute; `flow`: the true q;
    `segment` in [0, 1): the recorded conditions that persist, as a rank among segments; `step`: decisions so
    far."""

    sent: Setpoints
    flow: jax.Array
    temperature: jax.Array
    segment: jax.Array
    time_s: jax.Array
    step: jax.Array

    @property
    def target(self) -> jax.Array:
        return self.sent.value[..., 1]


class WindowSource(NamedTuple):
    """Draws windows: draw(table, conditions, flow, segment, u) -> shares (3,), named, flow_seen (percent; NaN
    if the camera shows classes only). A window at the true flow follows from uniform numbers u (3,) and the
    arrays of `table`."""

    draw: Callable[
        [Any, EpisodeConditions, jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array, jax.Array]
    ]
    table: Any = ()


class Trajectory(NamedTuple):
    """n episodes of T decisions. `flow` (true), `temperature` and `target` (n, T + 1), with the start first.
    For each decision: `named` (n, T), `shares` (n, T, 3) and `action` (n, T) as requested."""

    flow: jax.Array
    temperature: jax.Array
    target: jax.Array
    named: jax.Array
    shares: jax.Array
    action: Action


def flow_class(flow: jax.Array) -> jax.Array:
    """Returns the class of a flow: 0 under 90 %, 1 from 90 to 110 %, 2 above."""
    return jnp.where(flow < GOOD_BORDERS[0], UNDER, jnp.where(flow > GOOD_BORDERS[1], OVER, GOOD))


def nominal(flow, temperature, *, accuracy: float) -> EpisodeConditions:
    """Returns conditions of a machine without disturbances, that starts at flow (n,) and temperature (n,).
    Add disturbances with `_replace`."""
    flow = jnp.asarray(flow, float)
    one, zero = jnp.ones_like(flow), jnp.zeros_like(flow)
    ones = dict.fromkeys(("persistence", "clog"), one)
    values = dict.fromkeys(EpisodeConditions._fields, zero) | ones
    return EpisodeConditions(
        **values
        | {
            "flow": flow,
            "temperature": jnp.asarray(temperature, float) * one,
            "accuracy": accuracy * one,
            "wait_s": 6.0 * one,
        }
    )


def paper_windows() -> WindowSource:
    """Returns the windows of (7), which show classes only. The class x0 is right with probability rho,
    otherwise one of the two others. The shares are p_i over their sum, with

        p_i = clip(exp(-alpha |i - x0|) + N(0, sigma^2), 0, 1) for i != x0,    p_x0 = 1
    """
    return WindowSource(_paper_draw)


def _paper_draw(
    table, conditions: EpisodeConditions, flow, segment, u
) -> tuple[jax.Array, jax.Array, jax.Array]:
    wrong = u[0] >= conditions.accuracy
    shift = 1 + (u[0] - conditions.accuracy >= (1.0 - conditions.accuracy) / 2)
    x0 = jnp.where(wrong, (flow_class(flow) + shift) % CLASSES, flow_class(flow))
    distance = jnp.abs(jnp.arange(CLASSES) - x0)
    z = _normal(u[1:])
    noise = SIGMA * jnp.stack(
        [z[0], jnp.where(x0 == 0, z[0], z[1]), z[1]]
    )  # two random numbers suffice, since x0 itself needs none
    prob = jnp.where(distance == 0, 1.0, jnp.clip(jnp.exp(-ALPHA * distance) + noise, 0.0, 1.0))
    return prob / prob.sum(), x0, jnp.full_like(u[0], jnp.nan)


def _normal(u: jax.Array) -> jax.Array:
    """Converts numbers uniform in [0, 1) to N(0, 1)."""
    return jnp.sqrt(2.0) * jax.lax.erf_inv(jnp.clip(2.0 * u - 1.0, -1.0 + 1e-6, 1.0 - 1e-6))


def begin(
    windows: WindowSource, conditions: EpisodeConditions, key: jax.Array
) -> tuple[MachineState, Observation]:
    """Returns the state and the first observation of one episode (scalar conditions)."""
    return _begun(windows, conditions, jax.random.uniform(key, (CHANCES,)))


def _begun(
    windows: WindowSource, conditions: EpisodeConditions, u: jax.Array
) -> tuple[MachineState, Observation]:
    flow, temperature = (
        jnp.clip(conditions.flow, *FLOW_LIMITS),
        jnp.clip(conditions.temperature, *TEMPERATURE_LIMITS),
    )
    state = MachineState(
        sent=actuation.at_rest(jnp.stack([flow, temperature]), remembered=REMEMBERED),
        flow=flow,
        temperature=temperature,
        segment=u[4],
        time_s=jnp.zeros_like(flow),
        step=jnp.zeros_like(flow, jnp.int32),
    )
    return state, _observed(windows, conditions, state, flow, jnp.zeros_like(flow), u)


def stepped(
    windows: WindowSource, conditions: EpisodeConditions, state: MachineState, action: Action, u: jax.Array
) -> tuple[MachineState, Observation]:
    """Simulates one decision of one episode: the action, the limits and lags, and the next window. The reward
    is `reward(state.flow, state.temperature, ...)`.

    `u` (CHANCES,): random numbers, uniform in [0, 1), which the caller draws for many episodes at once.
    """
    heeded = state.step % LAMBDA == 0
    target_move = jnp.where(heeded, jnp.asarray(TEMPERATURE_MOVES)[action.temperature], 0.0)
    asked = jnp.stack([jnp.asarray(FLOW_MOVES)[action.flow], target_move])
    sent = actuation.moved(state.sent, asked, state.time_s, LIMITS)
    change, step = sent.value - state.sent.value, state.step + 1
    wait_s = actuation.wait_after(change, actuation.Waits(*3 * (conditions.wait_s,)))
    flow = jnp.where(step >= conditions.clog_step, conditions.clog, 1.0) * sent.value[0]
    # fraction of the material visible in the middle of the window that was laid before the move
    before = jnp.clip(1.0 - (wait_s + WINDOW_S / 2) / jnp.maximum(conditions.view_s, 1e-3), 0.0, 1.0)
    shown = flow + (state.flow - flow) * before
    state = MachineState(
        sent=sent,
        flow=flow,
        temperature=state.temperature + (sent.value[1] - state.temperature) / DELTA,  # (6)
        segment=jnp.where(u[3] * conditions.persistence < 1.0, u[4], state.segment),
        time_s=state.time_s + wait_s + WINDOW_S,
        step=step,
    )
    return state, _observed(windows, conditions, state, shown, change[0], u)


def _observed(
    windows: WindowSource,
    conditions: EpisodeConditions,
    state: MachineState,
    flow: jax.Array,
    flow_move: jax.Array,
    u: jax.Array,
) -> Observation:
    """Returns what the camera shows of this flow, after this move of its setpoint."""
    shown = windows.draw(windows.table, conditions, flow, state.segment, u[:3])
    return Observation(*shown, flow_move, state.temperature, state.target, state.step)


def first_history(length: int = HISTORY) -> jax.Array:
    """Returns the history (8) at the start, oldest first: eta classes as if all had been good, 1 / n_c
    each."""
    return jnp.full(length, 1.0 / CLASSES)


def remembered(history: jax.Array, named: jax.Array) -> jax.Array:
    """Returns the history (eta,) with the newest class x appended as x / n_c (8)."""
    return jnp.append(history[1:], named / CLASSES)


def paper_state(history: jax.Array, observation: Observation) -> jax.Array:
    """Returns the state (35,) of (9): 30 former classes divided by n_c, oldest first; p_hat, scaled to a
    largest value of 1; u_hat and u_bar (°C)."""
    p_hat = observation.shares / observation.shares.max()
    return jnp.concatenate([history, p_hat, jnp.stack([observation.temperature, observation.target])])


def rollout(
    controller: SetpointController,
    parameters: Any,
    windows: WindowSource,
    conditions: EpisodeConditions,
    key: jax.Array,
    *,
    steps: int,
) -> Trajectory:
    """Simulates every episode of `conditions` (n,) for `steps` decisions in one compiled program. The same
    key gives identical results."""
    n = conditions.flow.shape[0]
    own, world = jax.random.split(key)  # separate random numbers for controller and machine
    # random numbers are drawn outside of the program, because their generator takes longer to compile than
    # the rest; so are the first windows, with one program for every controller
    u = jax.random.uniform(world, (steps + 1, n, CHANCES))
    first = _first(windows, conditions, u)
    return _rolled(controller, parameters, windows, conditions, jax.random.split(own, n), first, u)


@eqx.filter_jit
def _first(
    windows: WindowSource, conditions: EpisodeConditions, u: jax.Array
) -> tuple[MachineState, Observation]:
    return jax.vmap(_begun, (None, 0, 0))(windows, conditions, u[0])


@eqx.filter_jit
def _rolled(
    controller: SetpointController,
    parameters: Any,
    windows: WindowSource,
    conditions: EpisodeConditions,
    keys: jax.Array,
    first: tuple[MachineState, Observation],
    u: jax.Array,
) -> Trajectory:
    def decide(carry, chance):
        state, observation, memory = carry
        u, t = chance
        now = jax.vmap(jax.random.fold_in, (0, None))(keys, t)
        act = jax.vmap(controller.act, (None, 0, 0, 0))
        memory, action = act(parameters, memory, observation, now)
        after, next_observation = jax.vmap(stepped, (None, 0, 0, 0, 0))(windows, conditions, state, action, u)
        return (after, next_observation, memory), (
            after.flow,
            after.temperature,
            after.target,
            observation.named,
            observation.shares,
            action,
        )

    state, observation = first
    memory = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (len(keys), *jnp.shape(leaf))), controller.start()
    )
    _, (flow, temperature, target, *per_decision) = jax.lax.scan(
        decide, (state, observation, memory), (u[1:], jnp.arange(len(u) - 1))
    )
    flow, temperature, target = (
        jnp.concatenate([first[None], then])
        for first, then in zip(
            (state.flow, state.temperature, state.target), (flow, temperature, target), strict=True
        )
    )
    return Trajectory(
        *jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), (flow, temperature, target, *per_decision))
    )


def reward(flow: jax.Array, temperature: jax.Array, *, a: float, b: float) -> jax.Array:
    """Returns the paper's elliptical reward (Li and Pattinson 2025, eqs. 14-16), in (-1, 1], 1 at (q*, u*) =
    (100 %, 210 °C). `flow` in percent, `temperature` in °C, of any one shape.

        r = 2 / (1 + sqrt(q_r^2 / a^2 + u_r^2 / b^2)) - 1
        q_r = (q - q*) cos theta - (u - u*) sin theta,   u_r = (q - q*) sin theta + (u - u*) cos theta
    """
    dq, du = flow - BEST_FLOW, temperature - BEST_TEMPERATURE
    q_r = dq * jnp.cos(ROTATION) - du * jnp.sin(ROTATION)
    u_r = dq * jnp.sin(ROTATION) + du * jnp.cos(ROTATION)
    return 2.0 / (1.0 + jnp.sqrt(q_r**2 / a**2 + u_r**2 / b**2)) - 1.0
