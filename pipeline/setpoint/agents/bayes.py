"""Bayes filters for the flow: what the windows say on a grid of flows, under several hypotheses of how the
camera errs, and the move with the least expected loss.

Its moves and the windows it shows tell the flow. The filter carries b(h, q), the belief that the
flow is q, the camera errs in the manner of h, and the extruder follows its commands with the gain g_h:

    b(h, q) <- sum_h' T(h', h) [(1 - hazard) b(h', q - g_h' move) + hazard b'(h') prior(q)]    the move
    b(h, q) <- b(h, q) P(window | h, q, window before) / sum                                   the window
    a = argmin_a sum b(h, q) loss(q + g_h a) + move_cost |a|                                   the next move
    loss(q) = |q - 100| + (outside_cost if |q - 100| > 10)

With the probability `hazard` the nozzle clogs or the like at a move; T leads to another segment. A move costs
move_fixed_cost more, so that a print that may well be good is left alone.

Manners of erring (`evidence`): anywhere with one probability, as in the paper's simulator; or as a
trained classifier does by its recorded windows, seen through a segment that makes every bead look
wider or narrower. Which it is, and how the extruder follows, shows by itself. b'(h) is b(h) with all
gains alike: what clogs a nozzle changes how its flow follows, too. Windows of a segment are alike:
where the flow setpoint stood, one shows with window_repeat_probability what the one before did,
whatever the flow, so that ten alike are not ten witnesses.

What holds it below its bars (measured on segments that it was not made from): of clogs by a
quarter 74 % settle, and 90 % were it told when they come: until the segment ends, a clog looks like a segment
whose beads look thin. Where each window is a segment of its own and the nozzle clogs, 85 % settle, 93 without
the watch, to which such a camera is another, and 96 if told as well. Prints in the band leave 15 % in 5.2 %
of the runs, and in 0.8 % with the table of the very segments that they are watched by.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.agents import camera_watch
from pipeline.setpoint.agents.baselines import temperature_move
from pipeline.setpoint.agents.camera_watch import Errors, WatchState
from pipeline.setpoint.published import BEST_FLOW, FLOW_MOVES
from pipeline.setpoint.simulation.recorded import WindowTable, segment_errors, smooth_mean, with_flows
from pipeline.setpoint.simulation.simulator import (
    CLASSES,
    FLOW_LIMITS,
    GOOD,
    GOOD_BORDERS,
    UNDER,
    Action,
    Observation,
    SetpointController,
    flow_class,
    nominal,
    paper_windows,
)

SPACING = 2.5  # percent: half the smallest move
GRID = np.arange(FLOW_LIMITS[0], FLOW_LIMITS[1] + SPACING / 2, SPACING)  # (N,)
PRIOR = 1 / GRID / np.sum(1 / GRID)  # errors of extrusion are ratios: 50 % is as likely as 200 %
LEVELS = 6  # of the shares within each class
FAINTEST = 0.03  # shares below this are told apart no more
CLASS_CODES = CLASSES * LEVELS
# of a flow seen: bins of its logarithm, so many between the borders of good, which they are aligned to
BINS_OF_GOOD = 8
FLOW_CODE_WIDTH = np.log(GOOD_BORDERS[1] / GOOD_BORDERS[0]) / BINS_OF_GOOD
FIRST_GOOD = int(np.ceil(np.log(GOOD_BORDERS[0] / FLOW_LIMITS[0]) / FLOW_CODE_WIDTH))
FLOW_CODES = FIRST_GOOD + int(np.ceil(np.log(FLOW_LIMITS[1] / GOOD_BORDERS[0]) / FLOW_CODE_WIDTH))
CODES = CLASS_CODES + FLOW_CODES


class Filter(NamedTuple):
    """evidence (H, CODES, N) is P(code | h, q). transition and after_jump (H, H) lead from row to column at
    each decision and at each jump of the flow. gains (H,): true by commanded move. window_repeat_probability
    (H,): that a window shows what the one before did where the flow setpoint stood. hazard: probability a
    decision that the flow jumps. Costs in percent of flow error: move_cost by percent of move, outside_cost
    of a miss beyond 10 %, a border that is known to within border_std percent, move_fixed_cost of any
    correction. prior (H, N) is the belief at the start.

    window_noise (knots,), segment_bias, unlikely_limit and likely_limit are of `camera_watch`: the errors of
    the table's own camera, and from where on the camera is another.
    """

    evidence: jax.Array
    transition: jax.Array
    after_jump: jax.Array
    gains: jax.Array
    window_repeat_probability: jax.Array
    hazard: float
    move_cost: float
    outside_cost: float
    move_fixed_cost: float
    prior: jax.Array
    border_std: float = 0.0
    window_noise: jax.Array | np.ndarray = np.full(len(camera_watch.KNOTS_PERCENT), 0.05, np.float32)
    segment_bias: float = 0.05
    unlikely_limit: float = float("inf")
    likely_limit: float = float("inf")


class FilterState(NamedTuple):
    """What the filter remembers: belief (H, N), sum 1; the code of the last window, -1 before the first; how
    many windows it has seen; and what `camera_watch` remembers."""

    belief: jax.Array
    last_code: jax.Array
    windows: jax.Array
    watch: WatchState = camera_watch.start()


def initial_state(hypotheses: int) -> FilterState:
    """Before the first window, when the belief becomes the filter's prior."""
    belief = jnp.tile(jnp.asarray(PRIOR, jnp.float32) / hypotheses, (hypotheses, 1))
    return FilterState(belief, jnp.int32(-1), jnp.int32(0), jax.tree.map(jnp.asarray, camera_watch.start()))


def start_prior(*, known_start_share: float, known_start_std: float) -> np.ndarray:
    """(N,) the belief about the flow before the first window: with known_start_share the machine prints as
    commanded, log flow ~ N(log 100 %, known_start_std^2); else anything, with density 1 / q."""
    log_flow = np.log(GRID / BEST_FLOW) / max(known_start_std, SPACING / BEST_FLOW / 2)
    as_commanded = np.exp(-0.5 * log_flow**2) / GRID
    return known_start_share * as_commanded / as_commanded.sum() + (1.0 - known_start_share) * PRIOR


@cache  # one pair of functions, so that what was compiled for it is found again
def bayes(hypotheses: int) -> SetpointController:
    """The filter and its greedy move, for Filter parameters of so many hypotheses."""

    def act(
        parameters: Filter, state: FilterState, observation: Observation, key: jax.Array
    ) -> tuple[FilterState, Action]:
        state = filter_update(parameters, state, observation)
        return state, Action(
            jnp.argmin(expected_loss(parameters, state.belief, observation.flow_move)).astype(jnp.int32),
            temperature_move(observation),
        )

    return SetpointController(lambda: initial_state(hypotheses), act, strange)


def filter_update(parameters: Filter, state: FilterState, observation: Observation) -> FilterState:
    """The state after the move that led to this window, and the window."""
    belief = jnp.where(state.windows == 0, parameters.prior, state.belief)
    moved = jax.vmap(predict_shift)(belief, parameters.gains * observation.flow_move)
    jumped = (parameters.after_jump.T @ belief.sum(axis=1))[:, None] * jnp.asarray(PRIOR, jnp.float32)
    predicted = led(parameters.transition, (1.0 - parameters.hazard) * moved + parameters.hazard * jumped)
    shown = code(observation.shares, observation.named, observation.flow_seen)
    may_repeat = (state.last_code >= 0) & (observation.flow_move == 0)
    repeats = (parameters.window_repeat_probability * may_repeat)[:, None]
    posterior = predicted * (
        repeats * (shown == state.last_code) + (1.0 - repeats) * parameters.evidence[:, shown]
    )
    own = Errors(parameters.window_noise, parameters.segment_bias)
    watch = camera_watch.update(own, state.watch, observation.flow_seen, observation.flow_move)
    watch = camera_watch.limited(watch, parameters.unlikely_limit, parameters.likely_limit)
    return FilterState(posterior / posterior.sum(), shown, state.windows + 1, watch)


def led(transition: jax.Array, belief: jax.Array) -> jax.Array:
    """transition.T @ belief (H, N), term after term: as one product of many episodes it would be cut where
    the CPU's caches end, and what is left there summed in another order."""
    return sum(to[:, None] * of for to, of in zip(transition, belief, strict=True))


def strange(parameters: Filter, state: FilterState) -> jax.Array:
    """Whether the camera is not the one of the table."""
    return camera_watch.strange(state.watch, parameters.unlikely_limit, parameters.likely_limit)


# corrections that begin with each of the five moves, in percent: a far flow takes many moves, and the fixed
# cost is of the correction, not of each
LARGEST = max(FLOW_MOVES)
FARTHER = (2.0, 4.0, 8.0, 16.0)  # times the largest move
CORRECTIONS = np.array([*FLOW_MOVES, *(-LARGEST * k for k in FARTHER), *(LARGEST * k for k in FARTHER)])
BEGINS = np.array([FLOW_MOVES.index(max(-LARGEST, min(LARGEST, c))) for c in CORRECTIONS])


def expected_loss(parameters: Filter, belief: jax.Array, last_move: jax.Array | float = 0.0) -> jax.Array:
    """Of each of the five moves (5), in percent of flow error: of the best of the corrections that begin with
    it, were the correction done. What goes on in the direction of last_move is no correction of its own."""
    moves = jnp.asarray(FLOW_MOVES)
    miss = jnp.abs(GRID + parameters.gains[:, None] * jnp.asarray(CORRECTIONS)[:, None, None] - BEST_FLOW)
    # of a miss on the border itself, as little as rounding is not outside
    outside = jax.scipy.special.ndtr((miss - 10.0 - 1e-3) / jnp.maximum(parameters.border_std, 1e-4))
    loss = miss + parameters.outside_cost * outside  # (corrections, H, N)
    # of each hypothesis, then of all: a sum of H N terms is cut by the size of the CPU's caches
    expected = sum(jnp.einsum("chn,hn->hc", loss, belief))
    expected = jax.ops.segment_min(expected, BEGINS, len(FLOW_MOVES))
    begins = (moves != 0) & (moves * last_move <= 0)
    return expected + parameters.move_cost * jnp.abs(moves) + parameters.move_fixed_cost * begins


def predict_shift(belief: jax.Array, move: jax.Array) -> jax.Array:
    """The belief (..., N) moved by `move` percent, linear between grid points;
    what would leave the grid stays on its last point."""
    steps = jnp.floor(move / SPACING)
    fraction = move / SPACING - steps
    # one slice of the belief between zeros: looking up each point takes thrice as long
    room = len(GRID) + 1
    padded = jnp.pad(belief, [(0, 0)] * (belief.ndim - 1) + [(room + 1, room)])
    first = room - jnp.clip(steps.astype(jnp.int32), -room, room)
    came = jax.lax.dynamic_slice_in_dim(padded, first, len(GRID) + 1, axis=-1)
    moved = (1.0 - fraction) * came[..., 1:] + fraction * came[..., :-1]
    last = jnp.arange(len(GRID)) == jnp.where(move > 0, len(GRID) - 1, 0)
    return moved + last * (belief.sum(axis=-1, keepdims=True) - moved.sum(axis=-1, keepdims=True))


def code(shares: jax.Array, named: jax.Array, flow_seen: jax.Array) -> jax.Array:
    """The window as one of CODES numbers. Where it shows a flow, CLASS_CODES and the bin of its logarithm;
    else its class, and within it one of LEVELS of s = log (p_2 + f) / (p_0 + f), which says where in the
    class the flow is."""
    seen = jnp.log(jnp.nan_to_num(flow_seen, nan=BEST_FLOW) / GOOD_BORDERS[0]) / FLOW_CODE_WIDTH
    by_flow = CLASS_CODES + jnp.clip(FIRST_GOOD + jnp.floor(seen), 0, FLOW_CODES - 1).astype(jnp.int32)
    s = jnp.log((shares[..., 2] + FAINTEST) / (shares[..., 0] + FAINTEST)) / np.log((1 + FAINTEST) / FAINTEST)
    within = jnp.where(named == UNDER, s + 1.0, jnp.where(named == GOOD, (s + 0.8) / 1.6, s))
    by_class = (named * LEVELS + jnp.clip(jnp.floor(within * LEVELS), 0, LEVELS - 1)).astype(jnp.int32)
    return jnp.where(jnp.isfinite(flow_seen), by_flow, by_class)


_codes = jax.jit(code)

CODE_CLASS = np.r_[  # (CODES,) the class that a code names
    np.arange(CLASS_CODES) // LEVELS,
    np.digitize(np.arange(FLOW_CODES), [FIRST_GOOD, FIRST_GOOD + BINS_OF_GOOD]),
]


def class_evidence(accuracy: float) -> np.ndarray:
    """(1, CODES, N): the class is right with this probability and one of the others otherwise, wherever the
    flow is; the shares are those of (7) for the class named, and a flow seen is any of that class, which say
    nothing more of the flow. Both kinds of code have sum 1 for every flow."""
    right = CODE_CLASS[:, None] == np.asarray(flow_class(GRID))
    flow_codes = CODE_CLASS[CLASS_CODES:]
    within = np.r_[_paper_levels(), (1 / np.bincount(flow_codes))[flow_codes]]
    return (np.where(right, accuracy, (1.0 - accuracy) / (CLASSES - 1)) * within[:, None])[None]


@cache
def _paper_levels() -> np.ndarray:
    """(CLASS_CODES,) P(code | class named) under (7), by the midpoints of its two
    uniform numbers, with a floor of 1 % for every level."""
    u = jnp.stack(jnp.meshgrid(*2 * [(jnp.arange(100) + 0.5) / 100], indexing="ij"), axis=-1).reshape(-1, 2)
    frequency = np.zeros(CLASS_CODES)
    for flow in (50.0, 100.0, 150.0):
        frequency += np.bincount(np.asarray(_paper_codes(flow, u)), minlength=CLASS_CODES) / len(u)
    return 0.99 * frequency + 0.01 / LEVELS


@jax.jit  # as one program: each operation on its own takes longer to compile
def _paper_codes(flow: jax.Array, u: jax.Array) -> jax.Array:
    conditions = nominal(flow, 210.0, accuracy=1.0)
    pairs = jnp.concatenate([jnp.zeros((len(u), 1)), u], axis=1)
    return code(*jax.vmap(lambda pair: paper_windows().draw((), conditions, flow, 0.0, pair))(pairs))


TAIL = 4.0  # degrees of freedom: a segment far from all others is rare, not impossible


def bias_levels(levels: int) -> tuple[np.ndarray, np.ndarray]:
    """z (levels,), the biases that a segment may have, in deviations and evenly over +-3 of them, and their
    weights (levels,), sum 1, of Student's t with TAIL degrees of freedom.

    What no level reaches is taken for another flow, and corrected: of rendered segments one in twenty lies
    beyond two deviations.
    """
    z = np.linspace(-3.0, 3.0, levels) if levels > 1 else np.zeros(1)
    weight = (1.0 + z**2 / TAIL) ** (-(TAIL + 1.0) / 2.0)
    return z, weight / weight.sum()


def recorded_evidence(
    table: WindowTable, *, width_bias_std: float, width_bias_levels: int, floor: float, smoothing: float
) -> np.ndarray:
    """(width_bias_levels, CODES, N): how likely each code is by flow, under hypothesis j as if the flow were
    q exp(width_bias_std z_j), z_j of `bias_levels`. Codes of classes and codes of flows have sum 1 each.

    width_bias_std: relative width that a segment adds to its beads, one deviation, which a table that shows
    flows corrects by its own segments; floor: share of windows that may show anything; smoothing over flow in
    percent, one deviation, at least half a bin.
    """
    z, _ = bias_levels(width_bias_levels)
    by_class = _class_frequencies(table, GRID * np.exp(width_bias_std * z)[:, None], smoothing)
    by_flow = np.full((width_bias_levels, len(GRID), FLOW_CODES), 1 / FLOW_CODES)
    if with_flows(table):
        errors = segment_errors(table, width_bias_std=width_bias_std)
        for j in range(width_bias_levels):
            by_flow[j] = _flow_frequencies(
                table, errors.within, np.log(GRID) + errors.bias_std * z[j], smoothing / BEST_FLOW
            )
    blocks = [(1.0 - floor) * block + floor / block.shape[2] for block in (by_class, by_flow)]
    return np.swapaxes(np.concatenate(blocks, axis=2), 1, 2)


def _class_frequencies(table: WindowTable, biased: np.ndarray, smoothing: float) -> np.ndarray:
    """(levels, N, CLASS_CODES): frequencies of the codes of classes at flows biased (levels, N)."""
    edges = np.asarray(table.flow_edges, float)
    centre, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    counts = np.zeros((len(centre), CLASS_CODES))
    shown = _codes(table.shares, table.named, np.full(len(table.named), np.nan, np.float32))
    np.add.at(counts, (table.flow_bin, np.asarray(shown)), 1.0)
    counts *= (width / np.maximum(counts.sum(axis=1), 1))[
        :, None
    ]  # as if every percent of flow had been recorded alike
    weight = np.exp(-0.5 * ((biased[..., None] - centre) / np.maximum(smoothing, width / 2)) ** 2)
    frequency = weight @ counts
    return frequency / frequency.sum(axis=2, keepdims=True)


def _flow_frequencies(
    table: WindowTable, error: np.ndarray, log_shown: np.ndarray, smoothing: float
) -> np.ndarray:
    """(N, FLOW_CODES): frequencies of the codes of flows at log flows log_shown (N,): a window of the table
    shows its error (n,) there, and counts by how near its own flow is, in units of `smoothing` of log flow
    or as far as the nearest windows are; of windows recorded densely, each counts less."""
    log_flow = np.sort(np.log(table.flow))
    order = np.argsort(np.log(table.flow), kind="stable")
    at = np.clip(log_shown, log_flow[0], log_flow[-1])
    near = np.maximum(smoothing, _reach(log_flow, at))
    kernel = np.exp(-0.5 * ((at[:, None] - log_flow) / near[:, None]) ** 2) * _spacing(log_flow)
    shown = log_shown[:, None] + error[order]
    bins = FIRST_GOOD + np.floor((shown - np.log(GOOD_BORDERS[0])) / FLOW_CODE_WIDTH).astype(int)
    flat = np.clip(bins, 0, FLOW_CODES - 1) + FLOW_CODES * np.arange(len(at))[:, None]
    counts = np.bincount(flat.ravel(), kernel.ravel(), FLOW_CODES * len(at)).reshape(len(at), FLOW_CODES)
    step = np.arange(FLOW_CODES)
    blur = np.exp(-0.5 * (step[:, None] - step) ** 2)  # of one bin: a table has few windows a bin
    counts = counts @ (blur / blur.sum(axis=1, keepdims=True))
    return counts / counts.sum(axis=1, keepdims=True)


NEAREST = 40  # windows that a flow's frequencies rest on at least


def _reach(log_flow: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(N,) half the distance from `at` to the NEAREST-th of the sorted log flows (n,)."""
    distance = np.sort(np.abs(at[:, None] - log_flow), axis=1)
    return distance[:, min(NEAREST, len(log_flow)) - 1] / 2


def _spacing(log_flow: np.ndarray) -> np.ndarray:
    """(n,) how much of the axis each of the sorted log flows stands for, with a floor where they coincide."""
    wide = np.gradient(log_flow) if len(log_flow) > 1 else np.ones(1)
    smooth = np.convolve(np.pad(wide, 10, mode="edge"), np.full(21, 1 / 21), "valid")
    return smooth + 1e-3 * smooth.max()


class CameraErrorModel(NamedTuple):
    """How the camera may err and the extruder follow, and what a miss costs: the settings of `robust_filter`.

    Manners of erring: anywhere with each of `accuracies`; or as recorded, every bead of a segment wider or
    narrower by one of `width_bias_levels` biases, of deviation `width_bias_std` (relative). A segment lasts
    segment_mean_decisions. mode_switch_probability: a decision, of going over from one way of erring (any of
    `accuracies`, or as recorded) to another. window_repeat_probability: that a window shows what the one
    before did, of the manners as recorded. gains: true by commanded move. floor and smoothing as
    `recorded_evidence` says; hazard and costs as `Filter` says; known_start as `start_prior` says.
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
    move_fixed_cost: float = 0.0
    known_start_share: float = 0.0
    known_start_std: float = 0.05
    border_std: float = 0.0


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
    prior = _prior(model.known_start_share, model.known_start_std)
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
        model.move_fixed_cost,
        jnp.asarray(np.tile(_ways(model), len(gains))[:, None] / len(gains) * prior, jnp.float32),
        model.border_std,
    )


# decisions and episodes of the quiet prints that set the limits of the watch, the share of them that may pass
# each of the two, decisions that a segment lasts there, and how often the flow is moved
QUIET, QUIET_PRINTS, FALSE_ALARMS, STRETCH, TRIED = 200, 2000, 0.007, (5, 41), 0.05
QUIET_FLOWS = (70.0, 140.0)  # percent: segments that stood there are drawn


def watching_filter(table: WindowTable, model: CameraErrorModel) -> Filter:
    """`robust_filter` that also tells when the camera is not the table's, where the table shows flows and
    several windows of a segment. The limits come from prints with nothing wrong."""
    own = robust_filter(table, model)
    if not with_flows(table) or len(np.unique(table.segment)) == len(table.segment):
        return own
    flow, within = _window_noise(table)
    bias = segment_errors(table, width_bias_std=model.width_bias_std).bias_std
    errors = camera_watch.errors(flow, within, bias)
    prints = _quiet_prints(table, flow, within, np.random.default_rng(0))
    greatest = _greatest_sums(errors, *map(jnp.asarray, prints))
    limits = np.quantile(np.asarray(greatest), 1.0 - FALSE_ALARMS, axis=0)
    noise = np.asarray(errors.noise, np.float32)
    return own._replace(
        window_noise=noise, segment_bias=float(errors.bias), unlikely_limit=float(limits[0]),
        likely_limit=float(limits[1]),
    )  # fmt: skip


def _window_noise(table: WindowTable) -> tuple[np.ndarray, np.ndarray]:
    """Flows (n,) in percent and how far log flow_seen departs there from one window of a segment to the next,
    over sqrt 2: what drifts over a segment is not noise of its windows."""
    order = np.argsort(table.segment, kind="stable")
    log_flow, error = np.log(table.flow)[order], np.log(table.flow_seen / table.flow)[order]
    error = error - smooth_mean(log_flow, error)
    same = np.diff(np.asarray(table.segment)[order]) == 0
    return np.exp((log_flow[1:] + log_flow[:-1]) / 2)[same], (np.diff(error) / np.sqrt(2.0))[same]


def _quiet_prints(
    table: WindowTable, flow: np.ndarray, within: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Flows seen (prints, decisions) around 100 %, and the moves that led there: stretches of one segment's
    mean error, and noise `within` of any segment at `flow`: a camera's windows do not come back as the few of
    a segment would. Half of the prints are moved now and then, and back, by a gain."""

    def near(flow: np.ndarray) -> np.ndarray:
        some = (flow >= QUIET_FLOWS[0]) & (flow <= QUIET_FLOWS[1])
        return some | ~some.any()

    here = near(table.flow)
    _, place, counts = np.unique(table.segment[here], return_inverse=True, return_counts=True)
    mean = np.bincount(place, np.log(table.flow_seen / table.flow)[here]) / counts
    noise = within[near(flow)]
    seen = rng.choice(np.r_[noise, -noise], (QUIET_PRINTS, QUIET))
    left, bias = np.zeros(QUIET_PRINTS, int), np.zeros(QUIET_PRINTS)
    for t in range(QUIET):
        over = left <= 0
        bias = np.where(over, mean[rng.integers(len(mean), size=QUIET_PRINTS)], bias)
        left = np.where(over, rng.integers(*STRETCH, QUIET_PRINTS), left) - 1
        seen[:, t] += bias
    moves = rng.choice([-10.0, -5.0, 5.0, 10.0], seen.shape) * (rng.random(seen.shape) < TRIED)
    moves[: QUIET_PRINTS // 2] = 0.0
    moves[:, 1:] -= moves[:, :-1]  # there and back
    moves[:, 0] = 0.0
    reached = np.cumsum(moves, axis=1) * rng.uniform(0.5, 1.2, (QUIET_PRINTS, 1))
    return np.maximum(100.0 + reached, 20.0) * np.exp(seen), moves


@jax.jit
def _greatest_sums(errors: Errors, seen: jax.Array, moves: jax.Array) -> jax.Array:
    """(prints, 2): the greatest of both sums over each print's flows seen and moves (prints, decisions)."""

    def window(state, shown):
        state = camera_watch.update(errors, state, *shown)
        return state, camera_watch.greatest(state)

    def one(seen, moves):
        begin = jax.tree.map(jnp.asarray, camera_watch.start())
        return jax.lax.scan(window, begin, (seen, moves))[1].max(axis=0)

    return jax.vmap(one)(seen.astype(jnp.float32), moves.astype(jnp.float32))


def _prior(share: float, std: float) -> np.ndarray:
    return start_prior(known_start_share=share, known_start_std=std).astype(np.float32)


def _mode_transition(model: CameraErrorModel) -> np.ndarray:
    """(anywhere + levels, anywhere + levels): a way of erring is left with mode_switch_probability for any of
    them alike; a width bias lasts segment_mean_decisions."""
    anywhere, levels = len(model.accuracies), model.width_bias_levels
    segment, switch = model.segment_mean_decisions, model.mode_switch_probability
    _, weight = bias_levels(levels)
    to = np.concatenate([np.ones(anywhere), weight]) / (anywhere + 1)
    transition = np.tile(switch * to, (anywhere + levels, 1))
    transition[:anywhere, :anywhere] += (1.0 - switch) * np.eye(anywhere)
    transition[anywhere:, anywhere:] += (1.0 - switch) * (
        (1.0 - 1.0 / segment) * np.eye(levels) + np.tile(weight / segment, (levels, 1))
    )
    return transition


def _ways(model: CameraErrorModel) -> np.ndarray:
    """(anywhere + levels,) how likely each manner of erring is at the start, sum 1."""
    _, weight = bias_levels(model.width_bias_levels)
    ways = np.concatenate([np.ones(len(model.accuracies)), model.width_bias_levels * weight])
    return ways / ways.sum()


def class_filter(
    *,
    accuracy: float,
    hazard: float,
    move_cost: float,
    outside_cost: float,
    move_fixed_cost: float = 0.0,
    known_start_share: float = 0.0,
    known_start_std: float = 0.05,
) -> Filter:
    """The filter of the paper's simulator: exact with hazard 0, and with a leak otherwise."""
    evidence, one = jnp.asarray(class_evidence(accuracy), jnp.float32), jnp.ones((1, 1))
    return Filter(
        evidence,
        one,
        one,
        jnp.ones(1),
        jnp.zeros(1),
        hazard,
        move_cost,
        outside_cost,
        move_fixed_cost,
        jnp.asarray(_prior(known_start_share, known_start_std))[None],
    )


# ---- rows of controllers.CONTROLLERS: settings, agents and recorded windows -> controller and parameters


def build_class_filter(
    settings: Mapping[str, float], agents: Any, windows: WindowTable
) -> tuple[SetpointController, Filter]:
    return bayes(1), class_filter(**settings)


def build_robust_filter(
    settings: Mapping[str, Any], agents: Any, windows: WindowTable
) -> tuple[SetpointController, Filter]:
    model = CameraErrorModel(**settings)
    hypotheses = len(model.gains) * (len(model.accuracies) + model.width_bias_levels)
    return bayes(hypotheses), watching_filter(windows, model)
