"""Bayes filters for the flow: what the windows say on a grid of flows, under several hypotheses of how the
camera errs, and the move with the least expected loss.

Its moves and the windows it shows tell the flow. The filter carries b(h, q), the belief that the
flow is q, the camera errs in the manner of h, and the extruder follows its commands with the gain g_h:

b(h, q) <- sum_h' T(h', h) [(1 - hazard) b(h', q - g_h' move) + hazard b'(h') prior(q)] the move; a
clog or the like, with a small probability; another segment b(h, q) <- b(h, q) P(window | h, q,
window before) / sum the window a = argmin_a sum b(h, q) loss(q + g_h a) + move_cost |a| loss(q) =
|q - 100| + outside_cost where that is more than 10

Manners of erring (`evidence`): anywhere with one probability, as in the paper's simulator; or as a
trained classifier does by its recorded windows, seen through a segment that makes every bead look
wider or narrower. Which it is, and how the extruder follows, shows by itself. b'(h) is b(h) with all
gains alike: what clogs a nozzle changes how its flow follows, too. Windows of a segment are alike:
where the flow setpoint stood, one shows with window_repeat_probability what the one before did,
whatever the flow, so that ten alike are not ten witnesses.
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from pipeline.setpoint.baselines import temperature_move
from pipeline.setpoint.published import BEST_FLOW, FLOW_MOVES
from pipeline.setpoint.recorded import WindowTable
from pipeline.setpoint.simulator import (
    CLASSES,
    FLOW_LIMITS,
    GOOD,
    UNDER,
    Action,
    Controller,
    Observation,
    flow_class,
    nominal,
    paper_windows,
)

SPACING = 2.5  # percent: half the smallest move
GRID = np.arange(FLOW_LIMITS[0], FLOW_LIMITS[1] + SPACING / 2, SPACING)  # (N,)
PRIOR = 1 / GRID / np.sum(1 / GRID)  # errors of extrusion are ratios: 50 % is as likely as 200 %
LEVELS = 6  # of the shares within each class
FAINTEST = 0.03  # shares below this are told apart no more
CODES = CLASSES * LEVELS


class Filter(NamedTuple):
    """evidence (H, CODES, N) is P(code | h, q). transition and after_jump (H, H) lead from row to column at
    each decision and at each jump of the flow. gains (H,): true by commanded move. window_repeat_probability
    (H,): that a window shows what the one before did where the flow setpoint stood. hazard: probability a
    decision that the flow jumps. move_cost in percent of flow error by percent of move, outside_cost in
    percent of flow error."""

    evidence: jax.Array
    transition: jax.Array
    after_jump: jax.Array
    gains: jax.Array
    window_repeat_probability: jax.Array
    hazard: float
    move_cost: float
    outside_cost: float


class FilterState(NamedTuple):
    """What the filter remembers: belief (H, N), sum 1, and the code of
    the last window, -1 before the first."""

    belief: jax.Array
    last_code: jax.Array


def initial_state(hypotheses: int) -> FilterState:
    """Before the first window."""
    belief = jnp.tile(jnp.asarray(PRIOR, jnp.float32) / hypotheses, (hypotheses, 1))
    return FilterState(belief, jnp.int32(-1))


@cache  # one pair of functions, so that what was compiled for it is found again
def bayes(hypotheses: int) -> Controller:
    """The filter and its greedy move, for Filter parameters of so many hypotheses."""

    def act(
        parameters: Filter, state: FilterState, observation: Observation, key: jax.Array
    ) -> tuple[FilterState, Action]:
        state = filter_update(parameters, state, observation)
        return state, Action(
            jnp.argmin(expected_loss(parameters, state.belief)).astype(jnp.int32),
            temperature_move(observation),
        )

    return Controller(lambda: initial_state(hypotheses), act)


def filter_update(parameters: Filter, state: FilterState, observation: Observation) -> FilterState:
    """The state after the move that led to this window, and the window."""
    moved = jax.vmap(predict_shift)(state.belief, parameters.gains * observation.flow_move)
    jumped = (parameters.after_jump.T @ state.belief.sum(axis=1))[:, None] * jnp.asarray(PRIOR, jnp.float32)
    predicted = parameters.transition.T @ ((1.0 - parameters.hazard) * moved + parameters.hazard * jumped)
    shown = code(observation.shares, observation.named)
    may_repeat = (state.last_code >= 0) & (observation.flow_move == 0)
    repeats = (parameters.window_repeat_probability * may_repeat)[:, None]
    posterior = predicted * (
        repeats * (shown == state.last_code) + (1.0 - repeats) * parameters.evidence[:, shown]
    )
    return FilterState(posterior / posterior.sum(), shown)


def expected_loss(parameters: Filter, belief: jax.Array) -> jax.Array:
    """Of each of the five moves (5), in percent of flow error."""
    moves = jnp.asarray(FLOW_MOVES)
    miss = jnp.abs(GRID + parameters.gains[:, None] * moves[:, None, None] - BEST_FLOW)  # (5, H, N)
    # of a miss on the border itself, as little as rounding is not outside
    return jnp.sum(
        (miss + parameters.outside_cost * (miss > 10.0 + 1e-3)) * belief, axis=(1, 2)
    ) + parameters.move_cost * jnp.abs(moves)


def predict_shift(belief: jax.Array, move: jax.Array) -> jax.Array:
    """The belief (..., N) moved by `move` percent, linear between grid points;
    what would leave the grid stays on its last point."""
    steps = jnp.floor(move / SPACING)
    fraction = move / SPACING - steps
    source = jnp.arange(len(GRID)) - steps.astype(jnp.int32)

    def at(index):
        return jnp.where(
            (index >= 0) & (index < len(GRID)), belief[..., jnp.clip(index, 0, len(GRID) - 1)], 0.0
        )

    moved = (1.0 - fraction) * at(source) + fraction * at(source - 1)
    last = jnp.arange(len(GRID)) == jnp.where(move > 0, len(GRID) - 1, 0)
    return moved + last * (belief.sum(axis=-1, keepdims=True) - moved.sum(axis=-1, keepdims=True))


def code(shares: jax.Array, named: jax.Array) -> jax.Array:
    """The window as one of CODES numbers: its class, and within it one of LEVELS of s = log (p_2 + f) / (p_0
    + f), which says where in the class the flow is."""
    s = jnp.log((shares[..., 2] + FAINTEST) / (shares[..., 0] + FAINTEST)) / np.log((1 + FAINTEST) / FAINTEST)
    within = jnp.where(named == UNDER, s + 1.0, jnp.where(named == GOOD, (s + 0.8) / 1.6, s))
    return (named * LEVELS + jnp.clip(jnp.floor(within * LEVELS), 0, LEVELS - 1)).astype(jnp.int32)


def class_evidence(accuracy: float) -> np.ndarray:
    """(1, CODES, N): the class is right with this probability and one of the others otherwise, wherever the
    flow is; the shares are those of (7) for the class named, which say nothing more of the flow."""
    right = np.arange(CODES)[:, None] // LEVELS == np.asarray(flow_class(GRID))
    return (np.where(right, accuracy, (1.0 - accuracy) / (CLASSES - 1)) * _paper_levels()[:, None])[None]


@cache
def _paper_levels() -> np.ndarray:
    """(CODES,) P(code | class named) under (7), by the midpoints of its two
    uniform numbers, with a floor of 1 % for every level."""
    u = jnp.stack(jnp.meshgrid(*2 * [(jnp.arange(100) + 0.5) / 100], indexing="ij"), axis=-1).reshape(-1, 2)
    frequency = np.zeros(CODES)
    for flow in (50.0, 100.0, 150.0):
        drawn = jax.vmap(
            lambda pair, flow=flow: paper_windows().draw(
                (), nominal(flow, 210.0, accuracy=1.0), flow, 0.0, jnp.concatenate([jnp.zeros(1), pair])
            )
        )(u)
        frequency += np.bincount(np.asarray(code(*drawn)), minlength=CODES) / len(u)
    return 0.99 * frequency + 0.01 / LEVELS


def recorded_evidence(
    table: WindowTable, *, width_bias_std: float, width_bias_levels: int, floor: float, smoothing: float
) -> np.ndarray:
    """(width_bias_levels, CODES, N): frequencies of the codes by flow, under hypothesis j as if the flow were
    q exp(width_bias_std z_j), z_j the middles of width_bias_levels equal parts of N(0, 1).

    width_bias_std: relative width that a segment adds to its beads, one deviation; floor: share of windows
    that may show anything; smoothing over flow in percent, one deviation, at least half a bin.
    """
    edges = np.asarray(table.flow_edges, float)
    centre, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    counts = np.zeros((len(centre), CODES))
    np.add.at(
        counts, (table.flow_bin, np.asarray(code(jnp.asarray(table.shares), jnp.asarray(table.named)))), 1.0
    )
    counts *= (width / counts.sum(axis=1))[:, None]  # as if every percent of flow had been recorded alike
    z = scipy.special.ndtri((np.arange(width_bias_levels) + 0.5) / width_bias_levels)
    biased = GRID * np.exp(width_bias_std * z)[:, None]
    weight = np.exp(-0.5 * ((biased[..., None] - centre) / np.maximum(smoothing, width / 2)) ** 2)
    frequency = weight @ counts
    frequency = (1.0 - floor) * frequency / frequency.sum(axis=2, keepdims=True) + floor / CODES
    return np.swapaxes(frequency, 1, 2)


class CameraErrorModel(NamedTuple):
    """How the camera may err and the extruder follow, and what a miss costs: the settings of `robust_filter`.

    Manners of erring: anywhere with each of `accuracies`; or as recorded, every bead of a segment wider or
    narrower by one of `width_bias_levels` biases, of deviation `width_bias_std` (relative). A segment lasts
    segment_mean_decisions. mode_switch_probability: a decision, of going over from one way of erring (any of
    `accuracies`, or as recorded) to another. window_repeat_probability: that a window shows what the one
    before did, of the manners as recorded. gains: true by commanded move. floor and smoothing as
    `recorded_evidence` says; hazard and costs as `Filter` says.
    """

    accuracies: Sequence[float]
    gains: Sequence[float]
    width_bias_levels: int
    width_bias_std: float
    floor: float
    smoothing: float
    segment_mean_decisions: float
    mode_switch_probability: float
    window_repeat_probability: float
    hazard: float
    move_cost: float
    outside_cost: float


def robust_filter(table: WindowTable, model: CameraErrorModel) -> Filter:
    """The filter for both simulators: for each of the gains the manners of erring are anywhere with each of
    the accuracies, then each width bias as recorded in `table`."""
    recorded = recorded_evidence(
        table,
        width_bias_std=model.width_bias_std,
        width_bias_levels=model.width_bias_levels,
        floor=model.floor,
        smoothing=model.smoothing,
    )
    anywhere, gains = len(model.accuracies), model.gains
    evidence = np.concatenate([*(class_evidence(accuracy) for accuracy in model.accuracies), recorded])
    transition = np.kron(np.eye(len(gains)), _mode_transition(model))
    after_jump = np.kron(np.full((len(gains), len(gains)), 1 / len(gains)), np.eye(len(evidence)))
    repeats = np.repeat([0.0, model.window_repeat_probability], [anywhere, model.width_bias_levels])
    return Filter(
        jnp.asarray(np.tile(evidence, (len(gains), 1, 1)), jnp.float32),
        jnp.asarray(transition, jnp.float32),
        jnp.asarray(after_jump, jnp.float32),
        jnp.repeat(jnp.asarray(gains, jnp.float32), len(evidence)),
        jnp.asarray(np.tile(repeats, len(gains)), jnp.float32),
        model.hazard,
        model.move_cost,
        model.outside_cost,
    )


def _mode_transition(model: CameraErrorModel) -> np.ndarray:
    """(anywhere + levels, anywhere + levels): a way of erring is left with mode_switch_probability for any of
    them alike; a width bias lasts segment_mean_decisions."""
    anywhere, levels = len(model.accuracies), model.width_bias_levels
    segment, switch = model.segment_mean_decisions, model.mode_switch_probability
    ways = anywhere + 1
    transition = np.full((anywhere + levels, anywhere + levels), switch / ways)
    transition[:, anywhere:] /= levels
    transition[:anywhere, :anywhere] += (1.0 - switch) * np.eye(anywhere)
    transition[anywhere:, anywhere:] += (1.0 - switch) * (
        (1.0 - 1.0 / segment) * np.eye(levels) + 1.0 / segment / levels
    )
    return transition


def class_filter(*, accuracy: float, hazard: float, move_cost: float, outside_cost: float) -> Filter:
    """The filter of the paper's simulator: exact with hazard 0, and with a leak otherwise."""
    evidence, one = jnp.asarray(class_evidence(accuracy), jnp.float32), jnp.ones((1, 1))
    return Filter(evidence, one, one, jnp.ones(1), jnp.zeros(1), hazard, move_cost, outside_cost)
