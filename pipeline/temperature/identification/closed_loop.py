"""Feedback in a record: whether its inputs respond to past outputs."""

from typing import NamedTuple

import numpy as np
import scipy.stats

from pipeline.temperature.identification.subspace import Segments, complete_runs, lagged, one_step

LEVEL_CLOSED = 0.001  # of the test for feedback: far below 5 %, because records are not as ideal as the test
# rows that the test uses at most, and rows of a stretch: a row takes past (m + p) numbers
MOST, STRETCH = 40_000, 4_000


class ClosedLoop(NamedTuple):
    """Whether the inputs respond to the outputs: p_value (m,) of each input; `closed` if one of them is below
    `LEVEL_CLOSED` divided among the tests of the inputs."""

    p_value: np.ndarray
    closed: bool


def closed_loop(
    u: Segments, y: Segments, past: int, *, offset: bool = True, lags: int = 5, inputs: int | None = None
) -> ClosedLoop:
    """Tests whether inputs follow innovations (Granger 1969). The part of u(t) that the past of u does not
    predict is regressed on one-step errors of VARX models, which are consistent with and without feedback.

    Errors before t show feedback alone. The error at t also correlates with u(t) under feed-through, and then
    as strongly when an input jumps. A jump of a set-point moves u at once, but y only later. For inputs set
    by any plan the statistics are chi-squared, because errors are white. Jumps are clipped: they would hide
    the small responses to noise that show feedback. Only the first `inputs` columns are tested (all if None).
    In a record of more than MOST rows, only stretches that are spread evenly over it are used.
    """
    answers = _answers(u, y, past, offset=offset, lags=lags)
    m = inputs or u[0].shape[1]
    p_value = np.ones(m)
    if answers is None:
        return ClosedLoop(p_value, False)
    unforeseen, errors_before, errors_now = answers
    for j in range(m):
        moved = unforeseen[:, j]
        clipped = _clipped(moved)
        if not np.any(clipped):
            continue
        p_value[j] = _p_value(clipped, errors_before)
        at_once = _p_value(clipped, errors_now)
        if at_once < p_value[j] and not _jumps_with(errors_now, moved - clipped):
            p_value[j] = at_once
    return ClosedLoop(p_value, bool((p_value < LEVEL_CLOSED / (2 * m)).any()))


def _answers(
    u: Segments, y: Segments, past: int, *, offset: bool, lags: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Returns the part of the inputs that their past does not predict (N, m); one-step errors of the outputs
    at lags 1..k (N, k p), of a predictor that knows u(t); and at lag 0 (N, p), of one that does not. Returns
    None if no stretch is long enough."""
    m, runs = u[0].shape[1], [w for w in complete_runs(u, y) if len(w) > past + lags + 1]
    # the predictor that knows u(t) has m unknowns more
    if sum(len(w) - past for w in runs) < (past + 1) * sum(part[0].shape[1] for part in (u, y)) + m + 1:
        return None
    data, untold = (lagged(u, y, past, feedthrough=told, offset=offset) for told in (True, False))
    of_told, of_untold = (one_step(part, past)[0] for part in (data, untold))
    parts = [[], [], [], []]
    for w in _spread(runs, past + lags + 1):
        z = np.hstack([w[past - lag : len(w) - lag] - data.means[lag] for lag in range(1, past + 1)])
        now_u, now_y = w[past:, :m] - data.means[0, :m], w[past:, m:] - data.means[0, m:]
        told = now_y - np.hstack([now_u, z]) @ of_told
        parts[0].append(w[past + lags :, :m])
        # as recorded, so that the change of a constant input is exactly zero
        late = [w[past + lags - lag : len(w) - lag, :m] for lag in range(1, min(past, 20) + 1)]
        parts[1].append(np.stack(late, axis=1))
        parts[2].append(np.hstack([told[lags - k : len(told) - k] for k in range(1, lags + 1)]))
        parts[3].append((now_y - z @ of_untold)[lags:])
    now, history, before, at_once = (np.concatenate(part) for part in parts)
    return _unforeseen(now, history), before, at_once


def _spread(runs: list[np.ndarray], fewest: int) -> list[np.ndarray]:
    """Returns the runs, or stretches of them with about MOST rows in total, each longer than `fewest`."""
    rows = sum(len(w) for w in runs)
    if rows <= MOST:
        return runs
    stretches = [w[start : start + STRETCH] for w in runs for start in range(0, len(w), STRETCH)]
    every = -(-rows // MOST)
    return [w for w in stretches if len(w) > fewest][::every]


def _unforeseen(now: np.ndarray, history: np.ndarray) -> np.ndarray:
    """Returns the part of each input (N, m) that the past of all inputs (N, past, m) does not predict. The
    prediction is by regression, or is the input's last value if that is nearer in the median."""
    centred = history.reshape(len(now), -1) - history.reshape(len(now), -1).mean(axis=0)
    design = np.hstack([np.ones((len(now), 1)), centred])
    by_regression = now - design @ np.linalg.lstsq(design, now, rcond=1e-10)[0]
    by_holding = now - history[:, 0]
    nearer = np.median(np.abs(by_holding), axis=0) < np.median(np.abs(by_regression), axis=0)
    left = np.where(nearer, by_holding, by_regression)
    return np.where(np.abs(left) > 1e-9 * np.maximum(np.ptp(now, axis=0), np.finfo(float).tiny), left, 0.0)


def _clipped(moved: np.ndarray) -> np.ndarray:
    """Clips values at three robust standard deviations, 4.5 times their median size. For an input that is
    mostly constant, the median of its changes is used."""
    size = np.abs(moved)
    scale = np.median(size) or (np.median(size[size > 0]) if size.any() else 0.0)
    return np.clip(moved, -4.5 * scale, 4.5 * scale)


def _p_value(moved: np.ndarray, errors: np.ndarray) -> float:
    """Returns the p-value of no correlation of moved (N,) with any column of errors (N, k)."""
    design = np.hstack([np.ones((len(errors), 1)), errors])
    answered = design @ np.linalg.lstsq(design, moved, rcond=1e-10)[0]
    share = np.var(answered) / max(np.var(moved), np.finfo(float).tiny)
    return float(scipy.stats.chi2.sf(len(errors) * share, errors.shape[1]))


def _jumps_with(errors: np.ndarray, excess: np.ndarray) -> bool:
    """Returns True if outputs respond at once to the large moves of an input, or if it makes too few to tell.
    Feed-through then explains a correlation at lag 0."""
    if np.count_nonzero(excess) < 4:
        return True
    about_mean = excess - excess.mean()
    sizes = np.linalg.norm(about_mean) * np.linalg.norm(errors, axis=0)
    share = about_mean @ errors / np.maximum(sizes, np.finfo(float).tiny)
    return bool((np.abs(share) * np.sqrt(len(excess)) > 4).any())  # far beyond what p outputs show by chance
