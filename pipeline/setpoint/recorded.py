"""Windows recorded from a trained classifier as a source for the simulator: whole windows are drawn again, so
errors sit, stick and mislead as the classifier's do.

Given a true flow, a segment of its flow bin is taken, and of that segment any window.
Conditions persist: within a bin the segments are ranked by how much they look over-extruded
(mean p_2 - p_0), and an episode keeps its rank for a while, also when the flow moves to another
bin, so that what looks thin here looks thin there.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pipeline.setpoint.simulator import Conditions, Windows


class WindowTable(NamedTuple):
    """n windows of a classifier: shares p (n, 3) of under, good, over, sum 1; named class (n,) 0, 1, 2;
    flow_bin (n,) 0 .. bins - 1; segment (n,) any integers; flow_seen (n,) in percent of nominal, the flow
    that the window shows, with its relative standard deviation spread (n,); flow (n,) the true one, percent.

    flow_edges (bins + 1,) in percent, rising; flows outside take the outermost bin. Every bin needs a window;
    a segment may occur in one bin or in many. Bins of 2.5 % from 70 to 130 % and wider ones beyond let a
    controller find 100 % within the good class.
    """

    shares: np.ndarray
    named: np.ndarray
    flow_bin: np.ndarray
    segment: np.ndarray
    flow_edges: np.ndarray
    flow_seen: np.ndarray
    spread: np.ndarray
    flow: np.ndarray


class _Ranked(NamedTuple):
    """Windows sorted by bin, then by the rank of their segment: segments of bin b are first_segment[b] + 0 ..
    segments[b] - 1, their windows likewise."""

    shares: jax.Array
    named: jax.Array
    first_segment: jax.Array
    segments: jax.Array
    first_window: jax.Array
    windows: jax.Array
    flow_edges: jax.Array


def recorded_windows(table: WindowTable) -> Windows:
    """The table as a source of windows: fresh where conditions.persistence is 1, sticky above."""
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
    ranked = _Ranked(
        shares=jnp.asarray(shares[rows]),
        named=jnp.asarray(np.asarray(table.named, np.int32)[rows]),
        first_segment=jnp.asarray(np.cumsum(segments) - segments),
        segments=jnp.asarray(segments),
        first_window=jnp.asarray(np.cumsum(windows) - windows),
        windows=jnp.asarray(windows),
        flow_edges=jnp.asarray(table.flow_edges, jnp.float32),
    )
    return Windows(_recorded_draw, ranked)


def _recorded_draw(ranked: _Ranked, conditions: Conditions, flow, segment, u) -> tuple[jax.Array, jax.Array]:
    flow_bin = (flow >= ranked.flow_edges[1:-1]).sum()
    s = ranked.first_segment[flow_bin] + jnp.floor(segment * ranked.segments[flow_bin]).astype(jnp.int32)
    w = ranked.first_window[s] + jnp.floor(u[0] * ranked.windows[s]).astype(jnp.int32)
    return ranked.shares[w], ranked.named[w]


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
