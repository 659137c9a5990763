"""What a part will come to, as an interval: chains that the trials cannot tell apart, and what they all
missed on routines left out, carried to the part by kind of event and time since it; or why it is not
judged."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from pipeline.deposition.parts.chain import Chain, simulate
from pipeline.deposition.parts.library import Training

# a sample belongs to the last event: to Start or Stop this long after it, to a Corner, a gap of at most this,
# so long after flow is wanted again
NEAR_S = 1.0
# an event begins this long ahead of its middle, as its ramp does; bins of the time since it
AHEAD_S, BIN_S = 0.2, 0.2
EVENTS = START, CORNER, STOP, STEADY, OFF = range(5)
NAMES = ("start", "corner", "stop", "steady", "off")
BINS = 12
# a residual above so many times what repeated trials of one command scatter is no noise; trials whose levels
# vary so many times as much as their successive differences foretell are of a machine that changes
FACTOR, CHANGED = 5.0, 2.5
# a part may ask for this much more or less than was trained, and for runs so many times as long
BEYOND, LONGER = 1.25, 3.0
# of the residual a member carries none, all, or twice: a part excites other shares of it than the routines
CARRIED = (0.0, 1.0, 2.0)
# the range of 32 members holds 94 % of what they are drawn from; on plants of other kinds it was to hold 85 %
QUANTILES = (0.0, 0.5, 1.0)  # `ends` counts on the first and the last
# a longer stream is forecast by fewer members
LONG, FEW = 30_000, 16


class Missed(NamedTuple):
    """What fits without a routine missed on it, simulated less measured, by_place (F, places) in shares of
    the local flow. `ratio` is its r.m.s. over the scatter of the mean of repeated trials, in the event where
    that is largest, NaN where fewer than three trials tell no scatter; `changed` the variance of the trials'
    levels over what their successive differences foretell (von Neumann 1941), near 1 where nothing
    changes."""

    by_place: np.ndarray
    ratio: float
    event: str
    changed: float


class Covered(NamedTuple):
    """What was trained: lowest and highest speed in mm/s and the wanted flow per speed (mm^2), the steepest
    wanted flow in mm^3/s^2, the shortest pause and the longest run in s."""

    slowest: float
    fastest: float
    area_mm2: float
    steepest: float
    shortest_s: float
    longest_s: float


class ForecastJudgement(NamedTuple):
    """Whether the forecast may be believed; where not, the reason and the trial that would judge it."""

    judged: bool
    reason: str
    trial: str


def places(r: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Place (T,) of each sample of a wanted flow r (T,): event x BINS + bin of the time since it.

    Flow is wanted where r is above half of the most within NEAR_S / 2; it starts and stops there, and a gap
    of at most NEAR_S is a Corner. Later than NEAR_S after it all is steady or off.
    """
    n, near = len(r), round(NEAR_S / sample_time_s)
    on = r > 0.5 * np.maximum(scipy.ndimage.maximum_filter1d(r, near + 1, mode="constant"), 1e-12)
    edges = np.flatnonzero(np.diff(on.astype(int), prepend=0))
    rises, falls = edges[on[edges]], edges[~on[edges]]
    ahead = round(AHEAD_S / sample_time_s)
    follows = np.append(rises, n + 2 * near)[np.searchsorted(rises, falls)]
    short = follows - falls <= near
    event = np.where(on, STEADY, OFF)
    since = np.zeros(n, int)
    ends = {k: (START, k + near) for k in np.setdiff1d(rises, follows[short]).tolist()}
    for k, gap, until in zip(falls.tolist(), short.tolist(), follows.tolist(), strict=True):
        ends[k] = (CORNER, until + near) if gap else (STOP, k + near)
    for k in sorted(ends):
        kind, end = ends[k]
        begin = max(k - ahead, 0)
        event[begin:end] = kind
        since[begin:end] = np.arange(min(end, n) - begin)
    return event * BINS + np.minimum(since // round(BIN_S / sample_time_s), BINS - 1)


def mean_by_place(e: np.ndarray, seen: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Mean (..., places) of errors e (..., T) over the samples of each place (T,) that were seen (..., T); 0
    where none was."""
    one = np.zeros((len(EVENTS) * BINS, e.shape[-1]))
    one[place, np.arange(e.shape[-1])] = 1.0
    count = np.where(seen, 1.0, 0.0) @ one.T
    return (np.where(seen, e, 0.0) @ one.T) / np.maximum(count, 1.0)


def missed(trainings: Sequence[Training], chain: Chain, *, sample_time_s: float, early: int = 3) -> Missed:
    """What each fit of chain.left_out missed on its routine, in the trials after the `early` ones, whose
    commands hardly differ."""
    pairs = zip(trainings, chain.left_out, strict=True) if len(trainings) > 1 else None
    pairs = pairs or [(trainings[0], one) for one in chain.left_out]
    bias, scatter, count, levels = [], [], [], []
    for training, extruder in pairs:
        late = slice(min(early, len(training.u) - 1), None)
        y, place = training.y[late], places(training.r, sample_time_s)
        flow = simulate([extruder], training.u[late], sample_time_s=sample_time_s)[0]
        e, seen = (flow - y) / training.r.max(), np.isfinite(y)
        each = mean_by_place(e, seen, place)
        bias.append(each.mean(axis=0))
        scatter.append(each.std(axis=0, ddof=1 if len(each) > 1 else 0) / math.sqrt(len(each)))
        count.append(np.bincount(place, minlength=each.shape[1]))
        on = training.r > 0.5 * training.r.max()
        levels.append(np.where(seen & on, e, 0.0).sum(axis=1) / np.maximum((seen & on).sum(axis=1), 1))
    event = np.arange(len(EVENTS) * BINS) // BINS
    squares = [np.array(count) * np.array(part) ** 2 for part in (bias, scatter)]
    ratios = [math.nan] * 3
    if len(levels[0]) > 2:
        by_event = [[part[:, event == k].sum() for part in squares] for k in (START, CORNER, STOP)]
        ratios = [math.sqrt(left / max(noise, 1e-30)) for left, noise in by_event]
    worst = int(np.argmax(ratios))
    return Missed(np.array(bias), ratios[worst], NAMES[worst], _changed(levels))


def _changed(levels: Sequence[np.ndarray]) -> float:
    """Variance of each routine's levels over half the mean square of their successive differences, over all
    routines."""
    varied = sum(float(np.sum((level - level.mean()) ** 2)) for level in levels)
    steps = sum(
        0.5 * float(np.mean(np.diff(level) ** 2)) * (len(level) - 1) for level in levels if len(level) > 1
    )
    return varied / steps if steps > 0 else math.nan


def covered(trainings: Sequence[Training], *, sample_time_s: float) -> Covered:
    """What the routines asked for."""
    speeds = [training.speed for training in trainings]
    areas = [float(training.r.max()) / training.speed for training in trainings]
    steepest = max(float(np.abs(np.diff(training.r)).max()) for training in trainings) / sample_time_s
    runs = [training.routine.pause_s[0] - training.routine.start_s for training in trainings]
    pauses = [training.pause_s for training in trainings]
    return Covered(min(speeds), max(speeds), float(np.mean(areas)), steepest, min(pauses), max(runs))


def judged(missed: Missed, covered: Covered, r: np.ndarray, *, sample_time_s: float) -> ForecastJudgement:
    """Whether a forecast of the wanted flow r (T,) may be believed."""
    again = "print its verification (beadline compose PART --verify) and learn from it"
    if not math.isfinite(missed.ratio):
        return ForecastJudgement(
            False, "fewer than three trials with learned commands tell no scatter", "run more trials"
        )
    if missed.changed > CHANGED:
        reason = (
            f"the machine changed while it learned: the trials' levels vary {missed.changed:.1f} times as "
            f"much as from trial to trial ({CHANGED:g} allowed)"
        )
        return ForecastJudgement(False, reason, "learn again from on-off control")
    if missed.ratio > FACTOR:
        reason = (
            f"on routines left out the chain misses {missed.event} by {missed.ratio:.1f} times what repeated "
            f"trials scatter ({FACTOR:g} allowed)"
        )
        return ForecastJudgement(False, reason, again)
    return _asked(covered, r, sample_time_s)


def _asked(covered: Covered, r: np.ndarray, sample_time_s: float) -> ForecastJudgement:
    """Whether what r (T,) asks for was trained."""
    near = round(NEAR_S / sample_time_s)
    on = r > 0.5 * np.maximum(scipy.ndimage.maximum_filter1d(r, near + 1, mode="constant"), 1e-12)
    edges = np.flatnonzero(np.diff(on.astype(int), prepend=0, append=0))
    lengths = (edges[1::2] - edges[::2]) * sample_time_s
    gaps = (edges[2::2] - edges[1:-1:2]) * sample_time_s
    speeds = r[on] / covered.area_mm2
    fast, slow = float(speeds.max()), float(np.quantile(speeds, 0.2))
    steep = float(np.abs(np.diff(r)).max()) / sample_time_s
    shortest, least = float(min(lengths.min(), gaps.min(initial=math.inf))), covered.shortest_s / BEYOND
    trained = f"{covered.slowest:g} to {covered.fastest:g} mm/s"
    add = "add a training routine with {} to printer.routines (params.expert.yaml)"
    if fast > BEYOND * covered.fastest or slow < covered.slowest / BEYOND:
        asked = fast if fast > BEYOND * covered.fastest else slow
        reason = f"the part prints at {asked:.3g} mm/s, trained were {trained}"
        return ForecastJudgement(False, reason, add.format(f"speed_mm_per_s: {asked:.3g}"))
    if steep > BEYOND * covered.steepest:
        times = steep / covered.steepest
        reason = f"the wanted flow changes {times:.1f} times as fast as in any routine"
        return ForecastJudgement(
            False, reason, "lengthen printer.ramp_s, or train with ramps as short as the part's"
        )
    if shortest < least:
        reason = f"a run or gap of {shortest:.2f} s, the shortest trained pause is {covered.shortest_s:g} s"
        return ForecastJudgement(False, reason, add.format(f"pause_s: {shortest:.2f}"))
    if lengths.max() > LONGER * covered.longest_s:
        reason = f"a run of {lengths.max():.0f} s, the longest trained one is {covered.longest_s:.0f} s"
        return ForecastJudgement(False, reason, add.format(f"on_s: {lengths.max() / LONGER:.0f}"))
    return ForecastJudgement(True, "", "")


def flows(chain: Chain, missed: Missed, u: np.ndarray, r: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """What may come out (M, T) of the command u (T,) for the wanted flow r (T,): the flow of each member of
    the chain less what one routine left out missed, by place and in proportion to the flow wanted near by."""
    return np.stack(list(each_flow(chain, missed, u, r, sample_time_s=sample_time_s)))


def each_flow(
    chain: Chain, missed: Missed, u: np.ndarray, r: np.ndarray, *, sample_time_s: float
) -> Iterator[np.ndarray]:
    """`flows`, one row (T,) after the other."""
    members = chain.members if len(r) <= LONG else chain.members[:: len(chain.members) // FEW]
    place, near = places(r, sample_time_s).astype(np.int16), round(NEAR_S / sample_time_s)
    local = scipy.ndimage.maximum_filter1d(r, 2 * near + 1, mode="constant")
    for k, member in enumerate(members):
        flow = simulate([member], u[None], sample_time_s=sample_time_s)[0, 0]
        residual = missed.by_place[k % len(missed.by_place)][place]
        residual *= local
        residual *= CARRIED[k % len(CARRIED)]
        flow -= residual
        del residual
        yield np.maximum(flow, 0.0, out=flow)


def interval(values: np.ndarray) -> np.ndarray:
    """The quantiles (3, ...) of values (M, ...): low, median, high."""
    return np.quantile(values, QUANTILES, axis=0)


def ends(values: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Low and high (...) of `interval`, of values (...) that come one after the other."""
    rows = iter(values)
    low = np.array(next(rows))
    high = low.copy()
    for row in rows:
        np.minimum(low, row, out=low)
        np.maximum(high, row, out=high)
    return low, high


def error_percent(made: np.ndarray, on_off: np.ndarray, r: np.ndarray) -> tuple[float, float, float]:
    """R.m.s. error of the flows `made` (M, T) in % of that of the flows of on-off control (M, T), member by
    member: 90 % of what may come out lies between the first and the last, the middle of it beside them."""
    ratio = np.linalg.norm(made - r, axis=1) / np.maximum(np.linalg.norm(on_off - r, axis=1), 1e-12)
    low, median, high = (float(value) for value in interval(100 * ratio))
    return low, median, high
