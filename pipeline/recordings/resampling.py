"""Resamples signals on their own clocks to one table with one sample time. Inputs are held, outputs are
interpolated between near neighbours. A new segment begins after a gap."""

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from pipeline.recordings.formats import Flag, Jitter, Raw, Table
from pipeline.recordings.quality import alternate, mask_mixed

# a sample within this share of the sample time from the grid counts as on it, because a temperature changes
# in a hundredth of a sample by far less than any sensor's step
ON_GRID = 0.01
GAP_INTERVALS = 3.0
# commands are periodic if nearly all of their intervals are alike. Otherwise they are events, and a long
# pause is no gap
PERIODIC_SHARE = 0.95
JITTER_SHARE, JITTER_OFTEN = 0.1, 0.01
# a recording is flagged if more than this was left out, % of its rows or samples
MOST_CUT_PERCENT = 5.0


class _Clock(NamedTuple):
    """One clock and the signals on it. A gap is an interval longer than `gap_limit_s` (infinite for commands
    that come as events)."""

    time_s: np.ndarray
    signals: list[str]
    gap_limit_s: float
    jitter: Jitter | None


# the samples of a clock beside each t_k: the indices of the next sample and of the nearest one, and the
# distance of the nearest, each (T,); and the k without a sample on t_k
_Neighbours = tuple[np.ndarray, np.ndarray | slice, np.ndarray, np.ndarray]
# the t_k from which a command of a clock acts, for each of its n samples: k, how late that is, and whether it
# counts (a command between two samples of a segment does)
_Effect = tuple[np.ndarray, np.ndarray, np.ndarray]


def resample(
    raw: Raw,
    *,
    sample_time_s: float,
    inputs: Sequence[str],
    outputs: Sequence[str],
    max_gap_s: float | None = None,
    averaged: Collection[str] = (),
) -> Table:
    """Returns the table of a recording on the grid t_k = t_0 + k T of each segment.

    Inputs: u_k is the last command at or before t_k. Outputs: y_k is the sample at t_k if there is one
    (within T / 100: the record's own number, unaltered), otherwise the straight line between its neighbours.
    Inputs that are `averaged`: u_k is the mean of the held commands from t_k to t_k + T, so that a flow that
    changes faster keeps its volume.

    A gap is an interval longer than `max_gap_s` (default: three sample times or three median intervals,
    whichever is longer) on any clock. Nothing is interpolated or held across a gap, and a new segment begins
    after it. Segments cover only the time that all clocks have in common. A value with missing neighbours is
    NaN and masked. Flags report gap, jitter, interpolated, filled, step_inside, step_lost, missing, mixed,
    trimmed, cut, short and rate.

    Raises ValueError if a signal is not in the recording, if the clocks have no time in common, or if no
    segment has two samples.
    """
    _check(raw, sample_time_s, inputs, outputs, max_gap_s)
    clocks = _clocks(raw, sample_time_s, inputs, outputs, max_gap_s)
    pieces = _pieces(raw, clocks, sample_time_s)
    grids = [
        start + sample_time_s * np.arange(int(np.floor((end - start) / sample_time_s + ON_GRID)) + 1)
        for start, end in pieces
    ]
    segments = [grid for grid in grids if len(grid) > 1]
    if not segments:
        raise ValueError(
            f"{raw.path}: the recording should have two samples {sample_time_s:g} s apart without a gap but "
            f"its longest stretch is {max(end - start for start, end in pieces):g} s; record longer, "
            "or set a smaller sample time or a larger gap limit"
        )
    time = np.concatenate(segments)
    segment = np.repeat(np.arange(len(segments), dtype=np.int32), [len(grid) for grid in segments])
    commands = _once_a_clock(clocks, inputs, lambda own: _last_command(own, time, sample_time_s))
    neighbours = _once_a_clock(clocks, outputs, lambda own: _neighbours(own, time, sample_time_s))
    effects = _once_a_clock(clocks, inputs, lambda own: _effect(own, time, segment, sample_time_s))
    values = {name: raw.signals[name][1][commands[name]] for name in inputs}
    values |= {name: _interpolate(*raw.signals[name], time, neighbours[name]) for name in outputs}
    values |= {name: _means(*raw.signals[name], time, sample_time_s) for name in inputs if name in averaged}
    masked = {name: ~np.isfinite(column) for name, column in values.items()}
    flags = _gap_flags(clocks) + _jitter_flags(clocks) + _trim_flags(clocks, pieces, grids)
    jitter = {name: clock.jitter for clock in clocks for name in clock.signals if clock.jitter}
    for name in outputs:
        flags += _fill_flags(name, neighbours[name], time, sample_time_s, masked[name])
        flags += _rate_flags(name, raw.signals[name][0], jitter[name].interval_s, sample_time_s)
    for name in (name for name in inputs if name not in averaged):
        flags += _step_flags(name, *raw.signals[name], effects[name], sample_time_s)
    for name, mask in masked.items():
        message = f"{mask.sum()} samples of {name} have no measured value and are masked"
        flags += _flag(name, "missing", time[mask], message)
    table = Table(raw.path, segment, time, values, masked, flags, jitter)
    return mask_mixed(table, {name: raw.signals[name] for name in outputs})


def hold(time_s: np.ndarray, values: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Returns the last of the values (n,) at or before each instant (T,); NaN before the first."""
    rows = np.searchsorted(time_s, at_s, side="right")
    return np.r_[np.nan, values][rows]


def _check(
    raw: Raw, sample_time_s: float, inputs: Sequence[str], outputs: Sequence[str], max_gap_s: float | None
) -> None:
    gap_s = sample_time_s if max_gap_s is None else max_gap_s
    counts = {name: len(raw.signals[name][0]) for name in outputs if name in raw.signals}
    faults = [
        *(
            (
                name not in raw.signals,
                f"signal {name} is wanted but the mapping gives {', '.join(raw.signals)}; "
                "map it to a column or topic",
            )
            for name in [*inputs, *outputs]
        ),
        (not outputs, "no output is wanted; name at least one measured signal"),
        (
            not 0 < sample_time_s < np.inf,
            f"the sample time should be more than 0 s but is {sample_time_s:g}; "
            "set it to about the recording's interval",
        ),
        (
            not gap_s >= sample_time_s,
            f"the gap limit {gap_s:g} s should be at least the sample time {sample_time_s:g} s; raise it",
        ),
        *(
            (count < 2, f"output {name} should have at least two samples but has {count}; record longer")
            for name, count in counts.items()
        ),
    ]
    for is_fault, sentence in faults:
        if is_fault:
            raise ValueError(f"{raw.path}: {sentence}")


# ---- clocks, gaps and the time in common


def _clocks(
    raw: Raw, sample_time_s: float, inputs: Sequence[str], outputs: Sequence[str], max_gap_s: float | None
) -> list[_Clock]:
    clocks: list[_Clock] = []
    for name in [*outputs, *inputs]:
        time = raw.signals[name][0]
        equal = [clock for clock in clocks if clock.time_s is time or np.array_equal(clock.time_s, time)]
        if equal:
            equal[0].signals.append(name)
            continue
        median = np.median(np.diff(time)) if len(time) > 1 else np.inf
        limit = max_gap_s if max_gap_s is not None else GAP_INTERVALS * max(sample_time_s, median)
        # outputs come first, so a new clock among the inputs is theirs alone
        events = name in inputs and not (
            np.mean(np.diff(time) < 2 * median) >= PERIODIC_SHARE if len(time) > 2 else False
        )
        limit = np.inf if events else limit
        clocks.append(_Clock(time, [name], limit, intervals(time, limit) if len(time) > 1 else None))
    return clocks


def intervals(time_s: np.ndarray, gap_limit_s: float = np.inf) -> Jitter:
    """Returns the jitter of a clock time_s (n,), n >= 2, from the intervals up to `gap_limit_s`."""
    steps = np.diff(time_s)
    inside, median = steps <= gap_limit_s, np.median(steps)
    if inside.all() or not inside.any():
        deviation = steps - median
    else:
        deviation = steps[inside] - np.median(steps[inside])
    return Jitter(float(median), float(deviation.std()), float(np.abs(deviation).max()))


_Result = TypeVar("_Result")


def _once_a_clock(
    clocks: Sequence[_Clock], names: Sequence[str], calculate: Callable[[np.ndarray], _Result]
) -> dict[str, _Result]:
    """Returns {signal: calculate(its time_s)} for the named signals. Signals on one clock share the
    result."""
    results: dict[str, _Result] = {}
    for clock in clocks:
        if signals := [name for name in clock.signals if name in names]:
            results |= dict.fromkeys(signals, calculate(clock.time_s))
    return results


def _pieces(raw: Raw, clocks: Sequence[_Clock], sample_time_s: float) -> list[tuple[float, float]]:
    """Returns the stretches (start, end) in which every clock runs without a gap and without starting over.
    Raises ValueError if there are none."""
    pieces, breaks = [(-np.inf, np.inf)], np.array(raw.breaks)
    for clock in clocks:
        restarts = np.searchsorted(breaks, clock.time_s, side="right")
        cuts = np.flatnonzero((np.diff(clock.time_s) > clock.gap_limit_s) | (np.diff(restarts) > 0))
        last = np.r_[cuts, len(clock.time_s) - 1]
        starts, ends = clock.time_s[np.r_[0, cuts + 1]], clock.time_s[last].astype(float)
        if np.isinf(clock.gap_limit_s):
            # the last event remains in effect until the clock starts over
            ends = np.nextafter(np.r_[breaks, np.inf], -np.inf)[restarts[last]]
        stretches = list(zip(starts.tolist(), ends.tolist(), strict=True))
        pieces = _common(pieces, stretches, sample_time_s * ON_GRID)
    if not pieces:
        spans = "; ".join(
            f"{', '.join(clock.signals[:3])} from {clock.time_s[0]:g} to {clock.time_s[-1]:g} s"
            for clock in clocks
        )
        raise ValueError(
            f"{raw.path}: the signals have no time in common ({spans}); "
            "map signals that were recorded together, or name their clock"
        )
    return pieces


def _common(
    first: Sequence[tuple[float, float]], second: Sequence[tuple[float, float]], tolerance: float
) -> list[tuple[float, float]]:
    """Returns the intersections of two sorted lists of intervals."""
    common, i, j = [], 0, 0
    while i < len(first) and j < len(second):
        start, end = max(first[i][0], second[j][0]), min(first[i][1], second[j][1])
        if end - start >= -tolerance:
            common.append((start, max(start, end)))
        if first[i][1] < second[j][1]:
            i += 1
        else:
            j += 1
    return common


# ---- values


def _in_one(indices: np.ndarray) -> np.ndarray | slice:
    """Returns consecutive indices as a slice, which copies nothing; other indices unchanged."""
    first = int(indices[0])
    end = first + len(indices)
    return slice(first, end) if np.array_equal(indices, np.arange(first, end)) else indices


def _last_command(time_s: np.ndarray, grid: np.ndarray, sample_time_s: float) -> np.ndarray | slice:
    """Returns the index of the last command at or before t_k. It always exists, because no piece begins
    before the first command."""
    last = np.searchsorted(time_s, grid + ON_GRID * sample_time_s, side="right") - 1
    return _in_one(np.maximum(last, 0))


def _means(time_s: np.ndarray, values: np.ndarray, grid: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Returns (F(t_k + T) - F(t_k)) / T, F the integral of the held commands; NaN if one of them is
    missing."""
    ends = np.r_[time_s, max(time_s[-1], grid[-1]) + sample_time_s]
    missing = ~np.isfinite(values)
    areas = [np.r_[0.0, np.cumsum(v * np.diff(ends))] for v in (np.where(missing, 0.0, values), missing)]
    mean, share = (
        (np.interp(grid + sample_time_s, ends, area) - np.interp(grid, ends, area)) / sample_time_s
        for area in areas
    )
    return np.where(share > ON_GRID, np.nan, mean)


def _neighbours(time_s: np.ndarray, grid: np.ndarray, sample_time_s: float) -> _Neighbours:
    later = np.clip(np.searchsorted(time_s, grid), 1, len(time_s) - 1)
    nearest = later - (grid - time_s[later - 1] <= time_s[later] - grid)
    distance = np.abs(time_s[nearest] - grid)
    off = np.flatnonzero(distance > ON_GRID * sample_time_s)
    return later, nearest if len(off) else _in_one(nearest), distance, off


def _interpolate(
    time_s: np.ndarray, values: np.ndarray, grid: np.ndarray, neighbours: _Neighbours
) -> np.ndarray:
    """Returns y(t_k): the sample at t_k itself, otherwise the straight line between its neighbours. A NaN
    neighbour gives NaN."""
    later, nearest, _, off = neighbours
    y = values[nearest].astype(float, copy=False)
    if len(off):
        later = later[off]
        share = (grid[off] - time_s[later - 1]) / (time_s[later] - time_s[later - 1])
        y[off] = values[later - 1] + np.clip(share, 0.0, 1.0) * (values[later] - values[later - 1])
    return y


def _effect(
    time_s: np.ndarray, grid: np.ndarray, segment: np.ndarray, sample_time_s: float
) -> _Effect | None:
    """Returns when each command takes effect; None if each sample has a t_k of its own, so that no command is
    late or lost."""
    k = np.searchsorted(grid, time_s - ON_GRID * sample_time_s)
    within = np.clip(k, 1, len(grid) - 1)
    late, counts = grid[within] - time_s, (k == within) & (segment[within] == segment[within - 1])
    if (k[1:] > k[:-1]).all() and not (late[counts] > ON_GRID * sample_time_s).any():
        return None
    return k, late, counts


# ---- flags


def _flag(signal: str, kind: str, where_s: np.ndarray, message: str) -> list[Flag]:
    return (
        [Flag(signal, kind, float(where_s[0]), float(where_s[-1]), len(where_s), message)]
        if len(where_s)
        else []
    )


def _gap_flags(clocks: Sequence[_Clock]) -> list[Flag]:
    flags = []
    for clock in clocks:
        median = clock.jitter.interval_s if clock.jitter else 0.0
        for i in np.flatnonzero(np.diff(clock.time_s) > clock.gap_limit_s):
            start, end = float(clock.time_s[i]), float(clock.time_s[i + 1])
            summer = " (an hour and an interval: a clock without a zone does so where summer time begins)"
            message = (
                f"no sample of {', '.join(clock.signals)} for {end - start:g} s (limit "
                f"{clock.gap_limit_s:g} s)"
                f"{summer if abs(end - start - 3600) <= 2 * median else ''}: a new segment begins behind it"
            )
            flags.append(Flag("", "gap", start, end, 1, message))
    return flags


def _jitter_flags(clocks: Sequence[_Clock]) -> list[Flag]:
    """Returns a flag for each clock with at least one interval in a hundred off by more than a tenth, or with
    any off by more than a half. Commands that come as events have no interval."""
    flags = []
    for clock in clocks:
        jitter = clock.jitter
        if jitter is None or not np.isfinite(clock.gap_limit_s) or len(clock.time_s) < 3:
            continue
        steps = np.diff(clock.time_s)
        inside = steps <= clock.gap_limit_s
        off = np.flatnonzero(inside & (np.abs(steps - jitter.interval_s) > JITTER_SHARE * jitter.interval_s))
        count = np.count_nonzero(inside)
        if len(off) < JITTER_OFTEN * count and jitter.max_s <= 0.5 * jitter.interval_s:
            continue
        pattern = (
            ", by turns longer and shorter: two devices may write under one name"
            if alternate(steps[inside])
            else ""
        )
        message = (
            f"the intervals of {', '.join(clock.signals)} differ from {jitter.interval_s:.4g} s by "
            f"{jitter.std_s:.2g} s (standard) and {jitter.max_s:.2g} s (largest), "
            f"{len(off)} of {count} by more than a tenth{pattern}"
        )
        flags.append(
            Flag(
                "", "jitter", float(clock.time_s[off[0]]), float(clock.time_s[off[-1] + 1]), len(off), message
            )
        )
    return flags


def _trim_flags(
    clocks: Sequence[_Clock], pieces: Sequence[tuple[float, float]], grids: Sequence[np.ndarray]
) -> list[Flag]:
    flags = []
    if len(clocks) > 1:
        start, end = pieces[0][0], pieces[-1][1]
        periodic = [clock for clock in clocks if np.isfinite(clock.gap_limit_s)]
        outside = [int(((clock.time_s < start) | (clock.time_s > end)).sum()) for clock in periodic]
        message = (
            f"{len(clocks)} clocks were aligned over their common time {start:g} to {end:g} s; "
            f"{sum(outside)} samples lie outside"
        )
        flags.append(Flag("", "trimmed", start, end, sum(outside), message))
        for clock, count in zip(periodic, outside, strict=True):
            what = f"samples of {', '.join(clock.signals[:3])} lie outside the time in common"
            flags += cut_flags(count, len(clock.time_s), what, start, end)
    for grid in grids:
        if len(grid) < 2:
            message = f"the stretch at {grid[0]:g} s is shorter than two samples and was left out"
            flags += _flag("", "short", grid, message)
    return flags


def cut_flags(left_out: int, count: int, what: str, start_s: float, end_s: float) -> list[Flag]:
    """Returns a flag if more than MOST_CUT_PERCENT of a recording was left out."""
    percent = 100 * left_out / max(count, 1)
    if percent <= MOST_CUT_PERCENT:
        return []
    message = (
        f"{percent:.1f} % of the recording was left out (limit {MOST_CUT_PERCENT:g} %): "
        f"{left_out} of {count} {what}; copy it again, or record it again"
    )
    return [Flag("", "cut", start_s, end_s, left_out, message)]


def _fill_flags(
    name: str, neighbours: _Neighbours, grid: np.ndarray, sample_time_s: float, masked: np.ndarray
) -> list[Flag]:
    """Returns flags for samples between two near measurements, and for samples without a near measurement. A
    masked sample gets neither."""
    _, _, distance_s, off = neighbours
    off = off[~masked[off]]
    is_far = distance_s[off] > (0.5 + ON_GRID) * sample_time_s
    close, far = off[~is_far], off[is_far]
    between = (
        f"{len(close)} of {len(grid)} samples of {name} lie between its own samples and are interpolated"
    )
    invented = (
        f"{len(far)} of {len(grid)} samples of {name} have no measurement within half a sample time: "
        "the straight line to the next ones fills them"
    )
    return _flag(name, "interpolated", grid[close], between) + _flag(name, "filled", grid[far], invented)


def _rate_flags(name: str, time_s: np.ndarray, interval: float, sample_time_s: float) -> list[Flag]:
    if interval < sample_time_s / 2:
        message = (
            f"{name} is sampled every {interval:g} s, the table every {sample_time_s:g} s: "
            "only the samples at its times are used, without averaging"
        )
    elif interval > 1.5 * sample_time_s:
        message = (
            f"{name} is sampled every {interval:g} s but the table every {sample_time_s:g} s: "
            "what lies between is interpolated, no measurement"
        )
    else:
        return []
    return _flag(name, "rate", time_s, message)


def _step_flags(
    name: str, time_s: np.ndarray, values: np.ndarray, effect: _Effect | None, sample_time_s: float
) -> list[Flag]:
    """Returns flags for commands that change between two samples. They act from the next sample on. A command
    is lost if another one replaces it before that sample."""
    if effect is None:
        return []
    k, late, counts = effect
    changes = np.flatnonzero((values[1:] != values[:-1]) & counts[1:]) + 1
    when, late, k = time_s[changes], late[changes], k[changes]
    between = late > ON_GRID * sample_time_s
    mean = f"{late[between].mean():.3g} s later on average" if between.any() else ""
    message = (
        f"{name} changes {between.sum()} times between two samples; "
        f"it is not smeared but acts from the next sample on, {mean}"
    )
    flags = _flag(name, "step_inside", when[between], message)
    overtaken = np.r_[k[1:] == k[:-1], False] if len(k) else np.zeros(0, bool)
    message = (
        f"{overtaken.sum()} commands of {name} were overtaken by another before the next sample and do not"
        f" appear; a smaller sample time shows them"
    )
    return flags + _flag(name, "step_lost", when[overtaken], message)
