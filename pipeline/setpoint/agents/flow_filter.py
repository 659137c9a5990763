"""A Bayes filter of the flow. Its belief is a probability on a grid of flows q, of misreadings z that a
segment keeps, and of gains g with which the extruder follows a command. It takes the move with the least
expected loss.

    b(g, z, q) <- (1 - hazard) b(g, z, q - g move) + hazard mean_g sum_q' b(g, z, q') J(q' -> q)   the move
    b(g, z, q) <- (1 - ends) b(g, z, q) + ends w(z) sum_z' b(g, z', q)                             the segment
    b(g, z, q) <- b(g, z, q) P(window | z, q) / sum                                                the window
    a = argmin_a sum b(g, z, q) loss(q + g a) + move_cost |a| + (move_fixed_cost if a begins a correction)
    loss(q) = |q - 100| + outside_cost P(|q - 100| > 10)

A window that shows a flow has log flow_seen ~ N(shown(q) + z, noise(q)^2); a fraction OUTLIERS of the windows
shows any flow. A window that shows only a class is right with the given accuracy, whatever its shares. The
misreadings z have the tails of Student's t: a segment far from all others is rare, not impossible. At a jump
J the nozzle clogs or clears, and the gain is unknown again, because a clog also changes how the flow follows.
The grid of flows is evenly spaced, so that a move of 5 % is exact.
"""

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.agents.baselines import temperature_move
from pipeline.setpoint.published import BEST_FLOW, FLOW_MOVES
from pipeline.setpoint.simulation.recorded import WindowTable, segment_errors, smooth_mean, with_flows
from pipeline.setpoint.simulation.simulator import (
    CLASSES,
    FLOW_LIMITS,
    Action,
    Observation,
    SetpointController,
    flow_class,
)

SPACING = 2.5  # percent: half the smallest move
GRID = np.arange(FLOW_LIMITS[0], FLOW_LIMITS[1] + SPACING / 2, SPACING)  # (N,)
ANYWHERE = 1 / GRID / np.sum(1 / GRID)  # errors of extrusion are ratios: 50 % is as likely as 200 %
OUTLIERS = 0.01  # share of the windows that may show any flow of the grid
FAR_OFF = 5.0  # deviations from its segment's median above which a window of the table is an outlier
TAIL, FARTHEST = 4.0, 4.0  # Student's degrees of freedom; deviations up to which a segment misreads
CLOGS, SURELY = (0.4, 1.05), 0.9  # factors on the flow at a jump, in this share of the jumps; else anywhere
NOISE_WIDTH = 0.12  # bandwidth in log flow (one deviation) over which a window's noise is smoothed
UNKNOWN_NOISE, UNKNOWN_BIAS = 0.05, 0.07  # if a table shows classes only
LEAST_NOISE = 0.01  # few windows may agree by chance
# corrections that begin with each of the five moves, in percent: a distant flow takes many moves, and the
# fixed cost is charged once for the correction
LARGEST = max(FLOW_MOVES)
FARTHER = (2.0, 4.0, 8.0, 16.0)  # times the largest move
CORRECTIONS = np.array([*FLOW_MOVES, *(-LARGEST * k for k in FARTHER), *(LARGEST * k for k in FARTHER)])
BEGINS = np.array([FLOW_MOVES.index(max(-LARGEST, min(LARGEST, c))) for c in CORRECTIONS])


class FlowFilter(NamedTuple):
    """`shown` (N,): log flow that windows show on average at the grid's flows; `noise` (N,): its standard
    deviation. `bias` (Z,): misreadings that a segment may keep, in log flow; `weight` (Z,): their
    probabilities, sum 1. `gains` (G,): true over commanded move. `jump` (N, N): from row to column. `prior`
    (N,): at the start. `border_std`: uncertainty of the borders of good, in percent. The rest as in the
    equations: probabilities are for one decision, costs in percent of flow error."""

    shown: Any
    noise: Any
    bias: Any
    weight: Any
    gains: Any
    jump: Any
    prior: Any
    accuracy: Any
    ends: Any
    hazard: Any
    move_cost: Any
    move_fixed_cost: Any
    outside_cost: Any
    border_std: Any


@cache  # one pair of functions, so that its compiled program is used again
def flow_filter(gains: int, biases: int) -> SetpointController:
    """Returns the filter with its greedy move, for FlowFilter parameters with this many gains and biases. Its
    memory is the belief (G, Z, N), zeros before the first window."""

    def act(of: FlowFilter, belief: jax.Array, seen: Observation, key: jax.Array) -> tuple[jax.Array, Action]:
        belief = update(of, belief, seen)
        best = jnp.argmin(expected_loss(of, belief, seen.flow_move)).astype(jnp.int32)
        return belief, Action(best, temperature_move(seen))

    return SetpointController(lambda: jnp.zeros((gains, biases, len(GRID)), jnp.float32), act)


def update(of: FlowFilter, belief: jax.Array, seen: Observation) -> jax.Array:
    """Returns the belief (G, Z, N) after the move that led to this window, and after the window."""
    first = of.prior * of.weight[:, None] / len(of.gains)
    belief = jnp.where(belief.sum() > 0, belief, first)
    moved = jax.vmap(shifted)(belief, of.gains * seen.flow_move)
    jumped = belief.mean(axis=0) @ of.jump
    belief = (1.0 - of.hazard) * moved + of.hazard * jumped
    another = of.weight[:, None] * belief.sum(axis=1, keepdims=True)
    belief = ((1.0 - of.ends) * belief + of.ends * another) * evidence(of, seen)
    return belief / belief.sum()


def evidence(of: FlowFilter, seen: Observation) -> jax.Array:
    """Returns P(window | z, q) (Z, N), up to a factor."""
    shown = jnp.log(jnp.nan_to_num(seen.flow_seen, nan=BEST_FLOW) / BEST_FLOW)
    deviation = (shown - of.shown - of.bias[:, None]) / of.noise
    by_flow = jnp.exp(-0.5 * deviation**2) / of.noise / np.sqrt(2 * np.pi)
    by_flow = (1.0 - OUTLIERS) * by_flow + OUTLIERS / np.log(GRID[-1] / GRID[0])
    right = flow_class(jnp.asarray(GRID)) == seen.named
    by_class = jnp.where(right, of.accuracy, (1.0 - of.accuracy) / (CLASSES - 1))
    return jnp.where(jnp.isfinite(seen.flow_seen), by_flow, by_class)


def expected_loss(of: FlowFilter, belief: jax.Array, last_move: jax.Array | float = 0.0) -> jax.Array:
    """Returns the loss of each of the five moves (5,) in percent of flow error. It is the loss of the best
    correction that begins with that move, as if the whole correction were done. A move in the direction of
    `last_move` continues a correction and does not begin one."""
    moves = jnp.asarray(FLOW_MOVES)
    miss = jnp.abs(GRID + of.gains[:, None] * jnp.asarray(CORRECTIONS)[:, None, None] - BEST_FLOW)
    # a miss exactly on the border counts as inside, despite rounding
    outside = jax.scipy.special.ndtr((miss - 10.0 - 1e-3) / of.border_std)
    expected = jnp.einsum("cgn,gn->gc", miss + of.outside_cost * outside, belief.sum(axis=1)).sum(axis=0)
    expected = jax.ops.segment_min(expected, BEGINS, len(FLOW_MOVES))
    begins = (moves != 0) & (moves * last_move <= 0)
    return expected + of.move_cost * jnp.abs(moves) + of.move_fixed_cost * begins


def shifted(belief: jax.Array, move: jax.Array) -> jax.Array:
    """Returns the belief (..., N) moved by `move` percent, linear between grid points. Probability that would
    leave the grid is kept on its last point."""
    steps = jnp.floor(move / SPACING)
    fraction = move / SPACING - steps
    # one slice of the zero-padded belief: looking up each point takes three times as long
    room = len(GRID) + 1
    padded = jnp.pad(belief, [(0, 0)] * (belief.ndim - 1) + [(room + 1, room)])
    first = room - jnp.clip(steps.astype(jnp.int32), -room, room)
    came = jax.lax.dynamic_slice_in_dim(padded, first, len(GRID) + 1, axis=-1)
    moved = (1.0 - fraction) * came[..., 1:] + fraction * came[..., :-1]
    last = jnp.arange(len(GRID)) == jnp.where(move > 0, len(GRID) - 1, 0)
    return moved + last * (belief.sum(axis=-1, keepdims=True) - moved.sum(axis=-1, keepdims=True))


# ---- from a table of recorded windows


def fit(
    table: WindowTable, *, biases: int, known_start_share: float, known_start_std: float, **declared: Any
) -> FlowFilter:
    """Fits the filter to a camera. `shown`, `noise` and `bias` come from the errors of the table's windows
    and segments (maximum likelihood of a one-way layout, outliers left out); the other parameters are as
    declared. At the start the machine prints as commanded with probability known_start_share, then log flow ~
    N(log 100 %, known_start_std^2); otherwise it may have any flow."""
    log_grid = np.log(GRID / BEST_FLOW)
    shown, noise, bias_std = log_grid, np.full(len(GRID), UNKNOWN_NOISE), UNKNOWN_BIAS
    if with_flows(table):
        table = without_outliers(table)
        log_flow, error = np.log(table.flow / BEST_FLOW), np.log(table.flow_seen / table.flow)
        errors, order = segment_errors(table, width_bias_std=UNKNOWN_BIAS), np.argsort(log_flow)
        mean = smooth_mean(log_flow, error)
        # one standard error more than estimated: if segments are assumed too steady, good prints are
        # disturbed
        bias_std = errors.bias_std * (1.0 + 1.0 / np.sqrt(2.0 * len(errors.bias)))
        shown = log_grid + np.interp(log_grid, log_flow[order], mean[order])
        at = np.clip(log_grid, log_flow.min(), log_flow.max())
        near = np.exp(-0.5 * ((at[:, None] - log_flow) / NOISE_WIDTH) ** 2)
        noise = np.sqrt(near @ (errors.within - mean) ** 2 / near.sum(axis=1)).clip(LEAST_NOISE)
    z = np.linspace(-FARTHEST, FARTHEST, biases)
    weight = (1.0 + z**2 / TAIL) ** (-(TAIL + 1.0) / 2.0)
    as_told = np.exp(-0.5 * (log_grid / known_start_std) ** 2) / GRID
    prior = known_start_share * as_told / as_told.sum() + (1.0 - known_start_share) * ANYWHERE
    learned = shown, noise, bias_std * z, weight / weight.sum(), declared.pop("gains"), jumps(), prior
    numbers = dict(zip(FlowFilter._fields, learned, strict=False)) | declared
    return FlowFilter(**{name: jnp.asarray(number, jnp.float32) for name, number in numbers.items()})


def without_outliers(table: WindowTable) -> WindowTable:
    """Returns flow, flow seen and segment of the windows within FAR_OFF robust deviations of their segment's
    median. Otherwise one false window in fifty would make the noise four times as large."""
    error = np.log(table.flow_seen / table.flow)
    error = error - smooth_mean(np.log(table.flow), error)
    _, place = np.unique(table.segment, return_inverse=True)
    about = error - np.array([np.median(error[place == k]) for k in range(place.max() + 1)])[place]
    sound = np.abs(about) <= FAR_OFF * max(np.median(np.abs(about)) / 0.6745, LEAST_NOISE)
    columns = {name: getattr(table, name)[sound] for name in ("flow", "flow_seen", "segment")}
    return table._replace(**columns)


def jumps() -> np.ndarray:
    """Returns the probabilities (N, N) of where the flow jumps: times any of CLOGS, uniform in the logarithm,
    or anywhere."""
    to = np.zeros((len(GRID), len(GRID)))
    for factor in np.exp(np.linspace(*np.log(CLOGS), 81)):
        at = (np.maximum(GRID * factor, GRID[0]) - GRID[0]).clip(0, GRID[-1] - GRID[0]) / SPACING
        low = np.minimum(at.astype(int), len(GRID) - 2)
        np.add.at(to, (np.arange(len(GRID)), low), low + 1 - at)
        np.add.at(to, (np.arange(len(GRID)), low + 1), at - low)
    return SURELY * to / to.sum(axis=1, keepdims=True) + (1.0 - SURELY) * ANYWHERE


def build(
    settings: Mapping[str, Any], agents: Any, windows: WindowTable
) -> tuple[SetpointController, FlowFilter]:
    """Builds the filter for these recorded windows: a row of controllers.CONTROLLERS."""
    of = fit(windows, **settings)
    return flow_filter(len(of.gains), len(of.bias)), of
