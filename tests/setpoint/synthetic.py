"""Windows of a classifier that nobody trained, to try the controllers on."""

import numpy as np

from pipeline.setpoint.simulation.recorded import WindowTable, class_shares


def synthetic_table(rng: np.random.Generator, *, segments: int, windows: int) -> WindowTable:
    """A stand-in until a classifier has recorded its own: `segments` segments of `windows` windows in every
    flow bin, with the errors that a real classifier makes.

    A segment shows the flow as if its beads were wider or narrower by 5 %, a window by another
    3 %, and the classes' borders are seen to within 4 %; the border to good lies near 83.5 %
    as it shows, so that from 80 to 90 % of flow some 38 % of the windows are right; errors
    stay within a segment and never swap under and over.
    """
    edges = np.concatenate([np.arange(20, 70, 10.0), np.arange(70, 130, 2.5), np.arange(130, 311, 10.0)])
    flow_bin, segment = (a.ravel() for a in np.indices((len(edges) - 1, segments * windows)))
    segment = segment // windows
    flow = rng.uniform(edges[:-1], edges[1:], (segments * windows, len(edges) - 1)).T.ravel()
    width = rng.normal(0.0, 0.05, (len(edges) - 1, segments))[flow_bin, segment] + rng.normal(
        0.0, 0.03, len(flow)
    )
    shown = flow * np.exp(width)
    logits = np.stack([-(shown - 83.5) / 4, np.zeros(len(flow)), (shown - 114.5) / 4], axis=1) + rng.normal(
        0.0, 0.5, (len(flow), 3)
    )
    shares = np.exp(np.clip(logits - logits.max(axis=1, keepdims=True), -8, 0))
    shares /= shares.sum(axis=1, keepdims=True)
    return WindowTable(shares, shares.argmax(axis=1), flow_bin, segment, edges)


def synthetic_flow_table(
    rng: np.random.Generator,
    *,
    segments: int,
    windows: int,
    segment_std: float = 0.05,
    window_std: float = 0.05,
) -> WindowTable:
    """A camera that shows flows: log flow_seen = log flow + N(0, segment_std^2) of a segment + N(0,
    window_std^2) of a window. Each of the segments stands at one flow, log-uniform from 20 to 310 %, for
    `windows` windows; the segments are spread over the bins."""
    edges = np.concatenate([np.arange(20, 70, 10.0), np.arange(70, 130, 2.5), np.arange(130, 311, 10.0)])
    each = np.exp(rng.permutation(np.linspace(np.log(20.5), np.log(309.5), segments)))
    flow, segment = np.repeat(each, windows), np.repeat(np.arange(segments), windows)
    error = rng.normal(0.0, segment_std, segments)[segment] + rng.normal(0.0, window_std, len(flow))
    spread = np.full(len(flow), np.hypot(segment_std, window_std))
    seen = flow * np.exp(error)
    shares = np.asarray(class_shares(seen, spread))
    flow_bin = np.searchsorted(edges, flow, side="right") - 1
    return WindowTable(shares, shares.argmax(axis=1), flow_bin, segment, edges, seen, spread, flow)
