"""Corrects the flow that another camera shows, from recordings at known flows, and estimates how accurate the
corrected flow is.

A few flows are commanded for a minute each. Their windows show other flows than commanded, because the camera
looks from another side or the filament has another colour. The log of the commanded flow is fitted to the log
of the shown flow by a line. If that predicts left-out levels better, it is fitted by straight pieces from
level to level that never fall (isotonic regression; Barlow and others 1972). The residual is the spread: of
windows about their level, and of levels about the curve.
"""

from typing import NamedTuple

import numpy as np

from pipeline.setpoint.simulation.recorded import WindowTable
from pipeline.setpoint.vision.window_flow import class_probabilities

# least number of levels for a curve, and of windows for a level
LEAST_LEVELS, LEAST_WINDOWS = 3, 5
# a camera sees flow if log flow shown rises at least this much per unit of log flow, and if the first and
# last level lie at least this many spreads apart
LEAST_SLOPE, LEAST_APART = 0.2, 3.0
# a level may lie below the one before by this many of its standard errors plus this much log flow
DIPS, DIP = 2.0, 0.02
# assumed deviation of the relative bead width between segments, before any level is known; and the number of
# levels that this assumption weighs
SEGMENT_STD, SEGMENT_LEVELS = 0.05, 3


class Levels(NamedTuple):
    """The correction. `log_seen` (k,): knots of log(flow shown / 100 %), rising; `log_flow` (k,): log(flow /
    100 %) there. Beyond the ends it continues with `slope`, log flow over log flow shown. `spread`: relative
    standard deviation of a window's corrected flow. `straight`: whether it is a line."""

    log_seen: np.ndarray
    log_flow: np.ndarray
    slope: float
    spread: float
    straight: bool


class LevelWindows(NamedTuple):
    """w windows: `seen` (w,) flow shown, `flow` (w,) flow commanded, both in percent of nominal."""

    seen: np.ndarray
    flow: np.ndarray


def fit(windows: LevelWindows) -> Levels:
    """Fits the correction to the windows of a few levels. Raises ValueError, in one sentence, if there are
    fewer than LEAST_LEVELS levels, fewer than LEAST_WINDOWS windows at one of them, or if the camera does not
    see flow."""
    flows, middle, error, within = _summaries(windows)
    x, y = np.log(flows / 100), middle
    dip = np.diff(y) + DIPS * np.hypot(error[1:], error[:-1]) + DIP
    gain = float(np.polyfit(x, y, 1)[0])
    if dip.min() < 0 or gain < LEAST_SLOPE or y[-1] - y[0] < LEAST_APART * within:
        shown = ", ".join(f"{100 * np.exp(m):.0f} at {q:g} %" for q, m in zip(flows, middle, strict=True))
        raise ValueError(
            f"this camera does not see flow: expected windows that show more where more was commanded, found "
            f"{shown}, windows of one level {100 * within:.0f} % apart; look at a frame with "
            "./run beadline calibrate tip IMAGE --tip X,Y, and record again"
        )
    straight = _left_out(x, y, _line) <= _left_out(x, y, _pieces)
    at, value = (_line if straight else _pieces)(y, x)
    slope = float(np.polyfit(y, x, 1)[0])
    levels = Levels(at, value, slope, 0.0, bool(straight))
    # a level's distance from a line is the effect of its segment; pieces go through each level and do not
    # show it
    free = len(x) - 2 if straight else 0
    missed = float((np.log(corrected(levels, 100 * np.exp(y)) / flows) ** 2).sum()) if straight else 0.0
    segment = (missed + SEGMENT_LEVELS * (SEGMENT_STD * slope) ** 2) / (free + SEGMENT_LEVELS)
    # variance of the next segment, and of those that the correction was fitted to
    own = segment * (1 + (2 / len(x) if straight else 1.0))
    return levels._replace(spread=float(np.sqrt((within * slope) ** 2 + own)))


def corrected(levels: Levels, flow_seen: np.ndarray) -> np.ndarray:
    """Returns the corrected flow in percent of nominal for the flow that windows show, in percent, any
    shape."""
    return 100 * np.exp(_along(levels.log_seen, levels.log_flow, levels.slope, np.log(flow_seen / 100)))


def shown(levels: Levels, flow: np.ndarray) -> np.ndarray:
    """Returns the flow that this camera shows at a true flow, both in percent. It gives a class's border as
    this camera shows it."""
    return 100 * np.exp(_along(levels.log_flow, levels.log_seen, 1 / levels.slope, np.log(flow / 100)))


def probabilities(levels: Levels, flow: np.ndarray) -> np.ndarray:
    """Returns the shares of under, good and over (n, 3) of windows with corrected flows (n,) in percent."""
    return class_probabilities(np.log(flow / 100), np.full(len(flow), levels.spread))


def table(levels: Levels, windows: LevelWindows, flow_edges: np.ndarray) -> WindowTable:
    """Returns a table for training controllers, in place of the classifier's own windows. In the middle of
    each bin of flow_edges (bins + 1,) in percent, each window has the error in log flow that it had at its
    own flow. Each level is a segment."""
    error = np.log(corrected(levels, windows.seen) / windows.flow)
    _, segment = np.unique(windows.flow, return_inverse=True)
    middles = np.sqrt(flow_edges[:-1] * flow_edges[1:])
    flow = np.repeat(middles, len(error))
    seen = flow * np.exp(np.tile(error, len(middles)))
    shares = probabilities(levels, seen)
    flow_bin = np.repeat(np.arange(len(middles)), len(error))
    return WindowTable(
        shares,
        shares.argmax(axis=1),
        flow_bin,
        np.tile(segment, len(middles)),
        np.asarray(flow_edges, float),
        seen,
        np.full(len(seen), levels.spread),
        flow,
    )


def _summaries(windows: LevelWindows) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Returns the commanded flows (k,), rising; the median of log(flow shown / 100 %) (k,) and its standard
    error (k,); and the standard deviation of windows about their level, one value for all. Raises ValueError
    if there are too few levels or windows."""
    number = np.isfinite(windows.seen) & (windows.seen > 0)
    flows, count = np.unique(windows.flow, return_counts=True)
    usable = np.array([np.sum(number & (windows.flow == flow)) for flow in flows])
    if len(flows) < LEAST_LEVELS:
        raise ValueError(
            f"expected at least {LEAST_LEVELS} levels of flow, found {len(flows)} "
            f"({', '.join(f'{flow:g} %' for flow in flows) or 'none'}); hold five for a minute each, such as "
            "60, 80, 100, 125 and 160 %"
        )
    if usable.min() < LEAST_WINDOWS:
        k = int(usable.argmin())
        raise ValueError(
            f"expected at least {LEAST_WINDOWS} windows that show a flow at {flows[k]:g} %, found "
            f"{usable[k]} of {count[k]}; hold it longer, or find out with "
            "./run beadline calibrate tip why frames are rejected"
        )
    logs = [np.log(windows.seen[number & (windows.flow == flow)] / 100) for flow in flows]
    middle = np.array([np.median(values) for values in logs])
    # 1.4826: deviation over median distance of a normal law; up to half of a level's windows may be wrong
    deviation = np.array(
        [1.4826 * np.median(np.abs(values - m)) for values, m in zip(logs, middle, strict=True)]
    )
    within = float(np.sqrt(np.mean(deviation**2)))
    return flows, middle, np.maximum(deviation, 1e-9) / np.sqrt(usable), within


def _line(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns two points of the line through (x, y)."""
    ends = np.array([x.min(), x.max()])
    return ends, np.polyval(np.polyfit(x, y, 1), ends)


def _pieces(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the knots of rising straight pieces. Neighbours that fall are pooled (isotonic regression),
    each pool at its mean."""
    order = np.argsort(x, kind="stable")
    pools = [[x[i], y[i], 1.0] for i in order]
    i = 0
    while i + 1 < len(pools):
        if pools[i + 1][1] > pools[i][1] and pools[i + 1][0] > pools[i][0]:
            i += 1
            continue
        (x1, y1, n1), (x2, y2, n2) = pools[i], pools.pop(i + 1)
        pools[i] = [(n1 * x1 + n2 * x2) / (n1 + n2), (n1 * y1 + n2 * y2) / (n1 + n2), n1 + n2]
        i = max(i - 1, 0)
    if len(pools) < 2:
        return _line(x, y)
    knots = np.array(pools)
    return knots[:, 0], knots[:, 1]


def _left_out(x: np.ndarray, y: np.ndarray, kind) -> float:
    """Returns the mean squared error, in log flow, of each level between the ends, predicted from the
    others."""
    misses = []
    for i in range(1, len(x) - 1):
        rest = np.arange(len(x)) != i
        at, value = kind(y[rest], x[rest])
        slope = float(np.polyfit(y[rest], x[rest], 1)[0])
        misses.append(_along(at, value, slope, y[i]) - x[i])
    return float(np.mean(np.square(misses)))


def _along(at: np.ndarray, value: np.ndarray, slope: float, x: np.ndarray) -> np.ndarray:
    """Interpolates linearly between the knots, and continues with `slope` beyond them."""
    x = np.asarray(x, float)
    inside = np.interp(x, at, value)
    return inside + slope * (np.minimum(x - at[0], 0) + np.maximum(x - at[-1], 0))
