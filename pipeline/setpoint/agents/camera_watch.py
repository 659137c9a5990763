"""Whether the camera is the one of the table: sequential likelihood ratios of the flows that windows show.

Under each of MODELS a window shows y = log flow_seen = level + N(0, s^2). The level stays, or moves by
N(0, 2 b^2) where another segment begins, or goes anywhere (a clog), and the flow's moves shift it; or the
window is an outlier. s and b are the table's own deviations within and between segments. The other cameras'
are some times as large:

    S <- log(e^S + RESTART) + log p_other(y | past) / p_own(y | past), 0 at the start

Shiryaev and Roberts' sum that begins at once: a table of another camera is wrong from the first window on
(fast initial response: Lucas and Crosier 1982). It takes no belief about the flow, as that would widen with
every surprise. Segments may also be as short as one window, whatever the table's were; then windows vary by
hypot(s, b) and no camera is at fault: `excused` is by how much that explains them better than another camera.

What cannot be told: to find 95 % within some windows at 2 % false alarms takes 0.95 log(0.95 / 0.02) + 0.05
log(0.05 / 0.98) = 3.5 nats of Kullback-Leibler divergence in them, by any test. A camera with a factor on the
flow gives none while the flow rests, and one whose segments alone differ about half a nat a segment.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# the table's own camera; the same where each window is a segment; and others: s and b so many times as large
OTHER = (2.0, 3.0, 0.5, 0.2)
MODELS = 2 + len(OTHER)
LARGER = np.array([factor > 1 for factor in OTHER])
SEGMENT_ENDS, ANYWHERE, OUTLIER = 1 / 15, 0.01, 0.01  # probabilities, a window
WIDE = 0.5  # deviation of log flow, of what goes anywhere
MOVE_DOUBT = 0.5  # of a commanded move, the share that may not come
RESTART, MOST = 1e-5, 2.5  # a window counts at most so many nats
ABOVE = 4.0  # nats beyond its limit that a sum may grow, so that a camera is found to be the table's again
# nats: short segments excuse unless a noisier camera explains the windows better by so many; at most
EXCUSE, EXCUSED = -1.5, 5.0
KNOTS_PERCENT = np.array([30.0, 50.0, 70.0, 85.0, 100.0, 120.0, 150.0, 200.0, 300.0])
KNOT_WIDTH = 0.15  # of log flow


class Errors(NamedTuple):
    """Deviations of log flow_seen of the table's own camera: noise (knots,) of a window about its segment, at
    flows KNOTS_PERCENT; bias () of the segments."""

    noise: jax.Array | np.ndarray
    bias: jax.Array | float


class WatchState(NamedTuple):
    """level and variance (MODELS,) of log flow_seen / 100 %; strength (OTHER,): the sums S; excused
    (LARGER,): log likelihood of short segments less that of each noisier camera."""

    level: jax.Array | np.ndarray
    variance: jax.Array | np.ndarray
    strength: jax.Array | np.ndarray
    excused: jax.Array | np.ndarray


def start() -> WatchState:
    """Before the first window: the level is anywhere."""
    zeros = [np.zeros(n, np.float32) for n in (MODELS, len(OTHER), int(LARGER.sum()))]
    return WatchState(zeros[0], zeros[0] + np.float32(1.0), zeros[1], zeros[2])


CORE, CORE_SQUARE = 2.5, 0.978  # deviations that count as they are, and E min(z^2, CORE^2) of N(0, 1)


def errors(flow: np.ndarray, within: np.ndarray, bias: float) -> Errors:
    """Of windows at flows (n,) in percent whose errors about their segments are `within` (n,): smooth over
    log flow, without their tails, which the models have as outliers."""
    most = CORE * np.median(np.abs(within)) / 0.6745
    square = np.minimum(within**2, most**2) / CORE_SQUARE
    weight = np.exp(-0.5 * ((np.log(KNOTS_PERCENT)[:, None] - np.log(flow)) / KNOT_WIDTH) ** 2) + 1e-3
    return Errors((weight @ square / weight.sum(axis=1)) ** 0.5, bias)


def update(of: Errors, state: WatchState, flow_seen: jax.Array, move: jax.Array) -> WatchState:
    """The state after a move of the flow (percent, as commanded) and the window behind it; flow_seen NaN
    changes the sums not."""
    shifted = jnp.log(jnp.maximum(jnp.exp(state.level) + move / 100.0, 0.15))
    variance = state.variance + (MOVE_DOUBT * (shifted - state.level)) ** 2
    noise, bias, ends = _models(of, shifted[0])
    shown = jnp.log(jnp.nan_to_num(flow_seen, nan=100.0) / 100.0) - shifted
    # the level stays; another segment; anywhere; an outlier, after which the level is what it was
    moves = jnp.stack([0.0 * bias, 2.0 * bias**2, 0.0 * bias + WIDE**2])
    V = jnp.stack([*(variance + moves + noise**2), variance + WIDE**2 + noise**2])
    weight = jnp.stack(
        [1.0 - ends - ANYWHERE - OUTLIER, ends + 1e-9, 0.0 * ends + ANYWHERE, 0.0 * ends + OUTLIER]
    )
    log_p = jnp.log(weight) - 0.5 * jnp.log(2 * jnp.pi * V) - 0.5 * shown**2 / V
    total = jax.nn.logsumexp(log_p, axis=0)
    share = jnp.exp(log_p - total)
    gain = jnp.concatenate([1.0 - noise**2 / V[:3], 0.0 * V[3:]])
    left = jnp.concatenate([noise**2 * gain[:3], variance[None]])
    mean = (share * gain * shown).sum(axis=0)
    spread = (share * (left + (gain * shown - mean) ** 2)).sum(axis=0)
    ratio = jnp.clip(total[2:] - total[0], -MOST, MOST)
    against = jnp.clip(total[1] - total[2:][LARGER], -MOST, MOST)
    after = WatchState(
        shifted + mean,
        spread,
        jnp.logaddexp(state.strength, jnp.log(RESTART)) + ratio,
        jnp.clip(state.excused + against, -EXCUSED, EXCUSED),
    )
    unseen = WatchState(shifted, variance, jnp.asarray(state.strength), jnp.asarray(state.excused))
    return jax.tree.map(lambda new, old: jnp.where(jnp.isfinite(flow_seen), new, old), after, unseen)


def limited(state: WatchState, unlikely: jax.Array | float, likely: jax.Array | float) -> WatchState:
    """The state with its sums cut ABOVE their limits."""
    limit = jnp.where(LARGER, unlikely, likely)
    return state._replace(strength=jnp.minimum(state.strength, limit + ABOVE))


def strange(state: WatchState, unlikely: jax.Array | float, likely: jax.Array | float) -> jax.Array:
    """Whether the windows are of another camera: noisier ones than `unlikely` lets pass, unless their
    segments are short; or steadier ones than `likely` does."""
    noisier, steadier = greatest(state)
    return ((noisier > unlikely) & (jnp.min(state.excused) <= EXCUSE)) | (steadier > likely)


def greatest(state: WatchState) -> jax.Array:
    """(2,): the greatest sum of a noisier camera, and of a steadier one."""
    strength = jnp.asarray(state.strength)
    return jnp.stack([strength[LARGER].max(), strength[~LARGER].max()])


def _models(of: Errors, level: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Noise, bias and the probability that a segment ends, (MODELS,) each, at this level."""
    s = jnp.interp(level + jnp.log(100.0), np.log(KNOTS_PERCENT), jnp.asarray(of.noise))
    b, others = jnp.asarray(of.bias), jnp.asarray(OTHER)
    noise = jnp.concatenate([jnp.stack([s, jnp.hypot(s, b)]), s * others])
    bias = jnp.concatenate([jnp.stack([b, 0.0 * b]), b * jnp.where(LARGER, 1.0, others)])
    return noise, bias, jnp.where(jnp.arange(MODELS) == 1, 0.0, SEGMENT_ENDS)
