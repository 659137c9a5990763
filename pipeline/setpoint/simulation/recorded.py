"""Windows recorded from a trained classifier, as a source for the simulator. Whole windows are drawn again,
so their errors have the size, the persistence and the bias of the classifier's errors.

If the table has classes only, a segment in the bin of the true flow is taken, and any window of that segment.
Conditions persist: within a bin, segments are ranked by how over-extruded they look (mean p_2 - p_0). An
episode keeps its rank for a while, also when the flow moves to another bin, so what looks thin in one bin
looks thin in the next. If the table has flows, an error is drawn as a sum: the error of a segment, which
persists in the same way, and the error about it of any of the NEAREST windows recorded at similar flows.
"""

import collections
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.simulation.simulator import GOOD_BORDERS, EpisodeConditions, WindowSource

UNSEEN = np.array(np.nan)  # value in a table of classes only
DITHER = 1e-3  # added to log flow_seen, so that a window drawn twice does not look like a frozen picture


class WindowTable(NamedTuple):
    """n windows of a classifier: shares p (n, 3) of under, good and over, sum 1; `named` class (n,) 0, 1, 2;
    `flow_bin` (n,) 0 .. bins - 1; `segment` (n,) any integers.

    `flow_edges`: (bins + 1,) in percent, rising; flows outside belong to the outermost bin. Every bin needs a
    window; a segment may occur in one bin or in many. Bins of 2.5 % from 70 to 130 %, and wider ones beyond,
    let a controller find 100 % within the good class. `flow_seen` (n,): flow that a window shows; `spread`
    (n,): standard deviation of its logarithm; `flow` (n,): the true one; both flows in percent of nominal.
    All three are NaN if the classifier gives classes only.
    """

    shares: np.ndarray
    named: np.ndarray
    flow_bin: np.ndarray
    segment: np.ndarray
    flow_edges: np.ndarray
    flow_seen: np.ndarray = UNSEEN
    spread: np.ndarray = UNSEEN
    flow: np.ndarray = UNSEEN


def with_flows(table: WindowTable) -> bool:
    """Returns whether the windows show flows, not only classes."""
    return bool(np.isfinite(table.flow_seen).all())


NEAREST = 40  # windows from which an error is drawn; all if there are fewer


class _Ranked(NamedTuple):
    """Windows sorted by bin, then by the rank of their segment. Bin b has segments first_segment[b] + 0 ..
    segments[b] - 1, and a segment's windows are counted in the same way. If windows show flows, then sorted
    by `log_flow` (n,): their errors about their segments (n,) and `spread` (n,); and the segments' `bias`
    (segments,), ascending. `seen`: number of these windows and of biases; entries behind them are padding and
    are never drawn."""

    shares: jax.Array
    named: jax.Array
    log_flow: jax.Array
    error: jax.Array
    spread: jax.Array
    bias: jax.Array
    first_segment: jax.Array
    segments: jax.Array
    first_window: jax.Array
    windows: jax.Array
    flow_edges: jax.Array
    seen: jax.Array


class SegmentErrors(NamedTuple):
    """Errors log flow_seen / flow of a table's windows, in two parts. `within` (n,): each window about its
    segment, including the camera's mean error at its flow. `bias` (segments,): of the segments, shrunk for
    their number of windows; `bias_std`: its standard deviation."""

    within: np.ndarray
    bias: np.ndarray
    bias_std: float


# number of segments that the declared deviation weighs, besides the table's own
DECLARED_SEGMENTS = 5


def segment_errors(table: WindowTable, *, width_bias_std: float) -> SegmentErrors:
    """Splits the errors of a table that shows flows by a one-way analysis of variance,

        s_b^2 = var(segment means) - s_w^2 mean(1 / n_s),

    pooled with the declared width_bias_std^2. If a segment has one flow only, its bias cannot be told from
    the camera's error at that flow, so errors are taken about the smoothed mean.
    """
    log_flow = np.log(table.flow)
    error = np.log(table.flow_seen) - log_flow
    mean = smooth_mean(log_flow, error)
    _, place, counts = np.unique(table.segment, return_inverse=True, return_counts=True)
    about = error - mean
    segment_mean = np.bincount(place, about) / counts
    within = about - segment_mean[place]
    free = len(error) - len(counts)
    if free <= 0:  # one window for each segment: the two parts cannot be separated
        return SegmentErrors(error, np.zeros(1), width_bias_std)
    variance = (within**2).sum() / free
    between = max(0.0, float((segment_mean**2).mean() - variance * (1 / counts).mean()))
    n = len(counts)
    bias_std = np.sqrt((n * between + DECLARED_SEGMENTS * width_bias_std**2) / (n + DECLARED_SEGMENTS))
    inflate = np.sqrt(variance / max(float((within**2).mean()), 1e-12))
    own = segment_mean * np.sqrt(between / max(between + variance * (1 / counts).mean(), 1e-12))
    return SegmentErrors(mean + within * inflate, own, float(bias_std))


MEAN_BANDWIDTH = 0.08  # bandwidth in log flow (one deviation) over which a camera's mean error is smoothed


def smooth_mean(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the kernel mean (n,) of y over x, evaluated at every x."""
    at = np.linspace(x.min(), x.max(), 200)
    weight = np.exp(-0.5 * ((at[:, None] - x) / MEAN_BANDWIDTH) ** 2)
    return np.interp(x, at, (weight @ y) / np.maximum(weight.sum(axis=1), 1e-12))


def recorded_windows(table: WindowTable) -> WindowSource:
    """Returns the table as a source of windows. With conditions.persistence 1 each window is of a new
    segment; above 1 the segment persists. Raises ValueError if the table is not complete and consistent."""
    _check(table)
    shares, bins = np.asarray(table.shares, np.float32), len(table.flow_edges) - 1
    pairs, place = np.unique(np.stack([table.flow_bin, table.segment], axis=1), axis=0, return_inverse=True)
    place = place.ravel()
    counts = np.bincount(place)
    thickness = np.bincount(place, weights=shares[:, 2] - shares[:, 0]) / counts
    order = np.lexsort([thickness, pairs[:, 0]])  # by bin, then by thickness
    position = np.empty_like(order)
    position[order] = np.arange(len(order))
    rows = np.argsort(position[place], kind="stable")
    windows, segments = counts[order], np.bincount(pairs[:, 0], minlength=bins)
    log_flow, error, spread, bias = _errors(table)
    ranked = _Ranked(
        shares=jnp.asarray(shares[rows]),
        named=jnp.asarray(np.asarray(table.named, np.int32)[rows]),
        log_flow=jnp.asarray(log_flow, jnp.float32),
        error=jnp.asarray(error, jnp.float32),
        spread=jnp.asarray(spread, jnp.float32),
        bias=jnp.asarray(bias, jnp.float32),
        first_segment=jnp.asarray(np.cumsum(segments) - segments),
        segments=jnp.asarray(segments),
        first_window=jnp.asarray(np.cumsum(windows) - windows),
        windows=jnp.asarray(windows),
        flow_edges=jnp.asarray(table.flow_edges, jnp.float32),
        seen=jnp.asarray([len(log_flow), len(bias)], jnp.int32),
    )
    return WindowSource(_recorded_draw, ranked)


def _errors(table: WindowTable) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns log_flow, error, spread and bias as in _Ranked; NaN if the table has classes only."""
    if not with_flows(table):
        none = np.full(1, np.nan)
        return none, none, none, none
    errors = segment_errors(table, width_bias_std=0.0)
    order = np.argsort(table.flow, kind="stable")
    return np.log(table.flow)[order], errors.within[order], table.spread[order], np.sort(errors.bias)


def _recorded_draw(
    ranked: _Ranked, conditions: EpisodeConditions, flow, segment, u
) -> tuple[jax.Array, jax.Array, jax.Array]:
    flow_bin = (flow >= ranked.flow_edges[1:-1]).sum()
    s = ranked.first_segment[flow_bin] + jnp.floor(segment * ranked.segments[flow_bin]).astype(jnp.int32)
    w = ranked.first_window[s] + jnp.floor(u[0] * ranked.windows[s]).astype(jnp.int32)
    q = jnp.clip(flow, ranked.flow_edges[0], ranked.flow_edges[-1])
    n, biases = ranked.seen
    some = jnp.minimum(NEAREST, n)
    first = jnp.clip(jnp.searchsorted(ranked.log_flow, jnp.log(q)) - some // 2, 0, n - some)
    near = first + jnp.floor(u[0] * some).astype(jnp.int32)
    bias = ranked.bias[jnp.floor(segment * biases).astype(jnp.int32)]
    seen = q * jnp.exp(bias + ranked.error[near] + DITHER * u[1])
    by_flow = class_shares(seen, ranked.spread[near])
    known = jnp.isfinite(seen)
    shares = jnp.where(known, by_flow, ranked.shares[w])
    return shares, jnp.where(known, by_flow.argmax().astype(jnp.int32), ranked.named[w]), seen


def class_shares(flow_seen: jax.Array, spread: jax.Array) -> jax.Array:
    """Returns P(flow < 90 %), P(90 to 110 %) and P(> 110 %) (..., 3) if log flow ~ N(log flow_seen,
    spread^2). `flow_seen` in percent; both arguments (...)."""
    low, high = (
        jax.scipy.special.ndtr((jnp.log(border) - jnp.log(flow_seen)) / spread) for border in GOOD_BORDERS
    )
    return jnp.stack([low, high - low, 1.0 - high], axis=-1)


def _check(table: WindowTable) -> None:
    shares, n, bins = np.asarray(table.shares), len(table.shares), len(table.flow_edges) - 1
    if shares.shape != (n, 3) or not all(
        len(column) == n for column in (table.named, table.flow_bin, table.segment)
    ):
        raise ValueError(
            "recorded windows: expected shares (n, 3) and as many classes, flow bins and segments, "
            f"found {shares.shape}, "
            f"{len(table.named)}, {len(table.flow_bin)}, {len(table.segment)}; record them in one go"
        )
    if (
        n == 0
        or not np.isfinite(shares).all()
        or (shares < 0).any()
        or np.abs(shares.sum(axis=1) - 1).max() > 1e-3
    ):
        raise ValueError(
            "recorded windows: expected shares from 0 to 1 with sum 1, found others; "
            "normalise each window's shares over its classes"
        )
    flows = [np.asarray(column, float) for column in (table.flow_seen, table.spread, table.flow)]
    if np.isfinite(flows[0]).any() and not all(
        column.shape == (n,) and (np.isfinite(column) & (column > 0)).all() for column in flows
    ):
        raise ValueError(
            f"recorded windows: expected flow_seen, spread and flow of all {n} windows, positive numbers, or "
            f"of none, found {', '.join(str((column > 0).sum()) for column in flows)}; record them in one go"
        )
    if (np.diff(table.flow_edges) <= 0).any():
        raise ValueError("recorded windows: expected rising flow edges, found some that fall; sort the bins")
    empty = np.setdiff1d(np.arange(bins), table.flow_bin)
    if len(empty):
        low, high = table.flow_edges[empty[0]], table.flow_edges[empty[0] + 1]
        raise ValueError(
            f"recorded windows: no window for flows from {low:g} to {high:g} % ({len(empty)} empty bins); "
            "record them, or widen the bins"
        )
    if np.min(table.flow_bin) < 0 or np.max(table.flow_bin) >= bins:
        raise ValueError(
            f"recorded windows: expected flow bins 0 to {bins - 1}, "
            f"found {np.min(table.flow_bin)} to {np.max(table.flow_bin)}"
        )


# ---- as columns of a table


def window_rows(tables: Mapping[str, WindowTable]) -> dict[str, np.ndarray]:
    """Returns the tables, by part, as columns of schema WINDOWS. Flows are missing (NaN) if the classifier
    gives classes only."""
    columns = collections.defaultdict(list)
    for part, table in tables.items():
        columns["part"] += [part] * len(table.named)
        columns["flow_percent"].append(np.broadcast_to(table.flow, len(table.named)))
        columns["flow_bin"].append(table.flow_bin)
        columns["flow_low_percent"].append(table.flow_edges[table.flow_bin])
        columns["flow_high_percent"].append(table.flow_edges[table.flow_bin + 1])
        columns["segment"].append(table.segment)
        columns["named"].append(table.named)
        columns["flow_seen_percent"].append(np.broadcast_to(table.flow_seen, len(table.named)))
        columns["spread"].append(np.broadcast_to(table.spread, len(table.named)))
        for c, name in enumerate(("under", "good", "over")):
            columns[f"p_{name}"].append(table.shares[:, c])
    return {name: values if name == "part" else np.concatenate(values) for name, values in columns.items()}


def window_tables(columns: Mapping[str, np.ndarray], parts: Sequence[str]) -> dict[str, WindowTable]:
    """Returns the tables of these columns by part, the reverse of `window_rows`. Raises ValueError if a part
    has no window."""
    tables = {}
    for part in parts:
        rows = np.asarray(columns["part"] == part)
        if not rows.any():
            raise ValueError(
                f"recorded windows: expected some of each part, {', '.join(parts)}, but found none of "
                f"{part}; record them again with ./run dvc repro train_classifier"
            )
        bins, first = np.unique(columns["flow_bin"][rows], return_index=True)
        low, high = (columns[f"flow_{end}_percent"][rows][first] for end in ("low", "high"))
        shares = np.stack([columns[f"p_{name}"][rows] for name in ("under", "good", "over")], axis=1)
        tables[part] = WindowTable(
            shares,
            columns["named"][rows],
            np.searchsorted(bins, columns["flow_bin"][rows]),
            columns["segment"][rows],
            np.append(low, high[-1]),
            columns["flow_seen_percent"][rows],
            columns["spread"][rows],
            columns["flow_percent"][rows],
        )
    return tables
