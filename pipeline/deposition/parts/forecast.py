"""Forecasts the error of a part as an interval, or says why it cannot. It uses the chains that the trials
cannot tell apart, and the error that they all make on routines left out, transferred to the part by kind of
event and time since it. Also writes the shortest print that shows whether a forecast is right: the runs with
the most uncertain flow, with their gaps and pauses, on one straight track."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from pipeline.deposition.drive import Drive, obeyed
from pipeline.deposition.extruder import Extruder
from pipeline.deposition.learning import ilc
from pipeline.deposition.parts import basis
from pipeline.deposition.parts.chain import Chain, IdentifiedExtruder, simulate
from pipeline.deposition.parts.library import Training
from pipeline.deposition.toolpath.tasks import PrintedLines

# a sample belongs to the last event: to a Start or Stop for this long after it; to a Corner, which is a gap
# of at most this length, until this long after flow is wanted again
NEAR_S = 1.0
# an event begins this long ahead of its middle, as its ramp does; bins of the time since it
AHEAD_S, BIN_S = 0.2, 0.2
EVENTS = START, CORNER, STOP, STEADY, OFF = range(5)
NAMES = ("start", "corner", "stop", "steady", "off")
BINS = 12
# a model that misses more than this on left-out routines, in % of on-off control's error, makes no forecast;
# this is the default limit of the rule "Flow error" in params.yaml. Change and ripple widen the interval, up
# to the second limit
LIMIT_PERCENT, MOVES_PERCENT = 6.0, 10.0
# a forecast is for this many prints, during which a machine that changes continues to change
PRINTS = 10
# a flow ripples if it varies within the first time; a machine is at rest the second time after an event (s)
RIPPLE_S, SETTLED_S = 2.5, 1.0
# a part may exceed the trained range by this factor, and its runs may be this many times as long
BEYOND, LONGER = 1.25, 3.0
# a member carries none, all, or twice of the residual, because a part excites other shares of it than the
# routines
CARRIED = (0.0, 1.0, 2.0)
# ends and middle of the members' errors: the largest, of members that carry twice the residual, order
# composers worse than the ninth decile does
QUANTILES = (0.0, 0.5, 0.9)
# a longer stream is forecast by fewer members
LONG, FEW = 30_000, 16

# the flow is unsure as a whole over this; of each event the hardest, with the runs that hang together with it
SPREAD_S, WINDOW_S = 0.4, 6.0
# pause between two windows; a line longer than twice PLATEAU_S keeps only PLATEAU_S at each end
REST_S, PLATEAU_S = 3.0, 3.0
# the track turns back after this many mm, on a line this far beside the last one
TRACK_MM, BESIDE_MM = 100.0, 5.0
# a pause shorter than this is none
SHORTEST_S = 0.005
# this share of the flow that a print lacked is learned at once, below this frequency
SHARE, CUTOFF_HZ, ORDER = 0.5, 2.0, 2
FILAMENT_MM2 = math.pi * 1.75**2 / 4


class Missed(NamedTuple):
    """Errors of the fits on the routine that each did not see. `by_place` (F, places): simulated less
    measured, in shares of the local flow. Three sizes are in % of the error of the first trials, which are
    on-off control, each without the share of noise: `held_out_percent`, the whole error, most of it at
    `event`; `change_percent`, the change of the level from the mean of the trials to the last of the next
    PRINTS; `ripple_percent`, the ripple that differs from trial to trial. `level_percent` is the change in %
    of the flow. Error and change are NaN if there are fewer than three trials with learned commands, because
    these do not show the noise."""

    by_place: np.ndarray
    held_out_percent: float
    event: str
    change_percent: float
    ripple_percent: float
    level_percent: float

    @property
    def percent(self) -> float:
        """How far a forecast may be wrong in total, in % of on-off control's error."""
        return math.hypot(self.held_out_percent, self.change_percent, self.ripple_percent)


class Covered(NamedTuple):
    """The range that was trained: lowest and highest speed in mm/s, wanted flow per speed (mm^2), steepest
    change of the wanted flow in mm^3/s^2, shortest pause and longest run in s."""

    slowest: float
    fastest: float
    area_mm2: float
    steepest: float
    shortest_s: float
    longest_s: float


class ForecastJudgement(NamedTuple):
    """Whether the forecast may be believed; if not, the reason, and the trial that would make it possible."""

    judged: bool
    reason: str
    trial: str


def places(r: np.ndarray, sample_time_s: float) -> np.ndarray:
    """Returns the place (T,) of each sample of a wanted flow r (T,): event x BINS + bin of the time since it.

    Flow is wanted where r is above half of its maximum within NEAR_S / 2. It starts and stops at the ends of
    these stretches, and a gap of at most NEAR_S is a Corner. More than NEAR_S after an event everything is
    steady or off.
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
    """Returns the mean (..., places) of errors e (..., T) over the observed samples (..., T) of each place
    (T,); 0 for a place without any."""
    one = np.zeros((len(EVENTS) * BINS, e.shape[-1]))
    one[place, np.arange(e.shape[-1])] = 1.0
    count = np.where(seen, 1.0, 0.0) @ one.T
    return (np.where(seen, e, 0.0) @ one.T) / np.maximum(count, 1.0)


def missed(trainings: Sequence[Training], chain: Chain, *, sample_time_s: float, early: int = 3) -> Missed:
    """Returns the error of each fit of chain.left_out on its routine, in the trials after the `early` ones,
    whose commands hardly differ."""
    pairs = zip(trainings, chain.left_out, strict=True) if len(trainings) > 1 else None
    pairs = pairs or [(trainings[0], one) for one in chain.left_out]
    bias, rows = [], []
    for training, extruder in pairs:
        late = slice(min(early, len(training.u) - 1), None)
        y, place = training.y[late], places(training.r, sample_time_s)
        flow = simulate([extruder], training.u[late], sample_time_s=sample_time_s)[0]
        seen = np.isfinite(y)
        e = np.where(seen, flow - y, 0.0) / training.r.max()
        bias.append(mean_by_place(e, seen, place).mean(axis=0))
        first = np.nan_to_num(training.y[0] - training.r) / training.r.max()
        steady = seen & (place // BINS == STEADY)
        rows.append(
            (_repeated(e), place // BINS, _slope(e, steady), _ripple(e, steady, sample_time_s), first)
        )
    each, event, slopes, ripples, first = (list(column) for column in zip(*rows, strict=True))
    unit = 100 / max(math.sqrt(np.mean([one @ one / len(one) for one in first])), 1e-12)
    squares = np.concatenate(each)
    shares = [float(squares[np.concatenate(event) == k].sum()) for k in range(len(EVENTS))]
    slope, doubt = np.mean(slopes, axis=0) / (1, len(slopes))
    ahead = (max(len(trainings[0].u) - early, 1) - 1) / 2 + PRINTS
    moved = math.sqrt(max(slope**2 - doubt, 0.0)) * ahead
    wanted = math.sqrt(np.mean([np.mean((training.r / training.r.max()) ** 2) for training in trainings]))
    return Missed(
        np.array(bias),
        unit * math.sqrt(max(float(np.mean(squares)), 0.0)),
        NAMES[int(np.argmax(shares))],
        unit * wanted * moved,
        unit * wanted * math.sqrt(max(float(np.mean(ripples)), 0.0)),
        100 * moved,
    )


def _repeated(e: np.ndarray) -> np.ndarray:
    """Returns the square (T,) of what the rows of e (J, T) have in common: the mean of the products of
    different rows, to which noise adds nothing. NaN for fewer than three rows."""
    J = len(e)
    return (
        (e.sum(axis=0) ** 2 - np.sum(e**2, axis=0)) / (J * (J - 1)) if J > 2 else np.full(e.shape[1], np.nan)
    )


def _slope(e: np.ndarray, steady: np.ndarray) -> tuple[float, float]:
    """Returns the change of the steady level of e (J, T) from trial to trial, and the square of its standard
    error; NaN for fewer than three trials."""
    level = np.where(steady, e, 0.0).sum(axis=1) / np.maximum(steady.sum(axis=1), 1)
    if len(level) < 3:
        return math.nan, math.nan
    t = np.arange(len(level)) - (len(level) - 1) / 2
    slope = float(t @ level / (t @ t))
    left = level - level.mean() - slope * t
    return slope, float(left @ left / (len(level) - 2) / (t @ t))


def _ripple(e: np.ndarray, steady: np.ndarray, sample_time_s: float) -> float:
    """Returns the variance within RIPPLE_S of the difference between the rows of e (J, T), over the steady
    samples (J, T), less that of white noise; 0 if no sample is steady. White noise is half the mean square of
    successive differences (von Neumann 1941)."""
    width, J = round(RIPPLE_S / sample_time_s), len(e)
    held = scipy.ndimage.minimum_filter1d(steady, 2 * round(SETTLED_S / sample_time_s) + 1, mode="constant")
    if J < 2 or not held.any():
        return 0.0
    d, count = np.where(held, e - e.mean(axis=0), 0.0), held.astype(float)
    local = [scipy.ndimage.uniform_filter1d(part, width, mode="constant") for part in (d, count)]
    d = np.where(held, d - local[0] / np.maximum(local[1], 1 / width), 0.0)
    pairs = held[:, 1:] & held[:, :-1]
    white = np.sum(np.where(pairs, np.diff(d), 0.0) ** 2) / max(2 * pairs.sum(), 1)
    return float((np.sum(d**2) / held.sum() - white) * J / (J - 1))


def covered(trainings: Sequence[Training], *, sample_time_s: float) -> Covered:
    """Returns the range of the routines."""
    speeds = [training.speed for training in trainings]
    areas = [float(training.r.max()) / training.speed for training in trainings]
    steepest = max(float(np.abs(np.diff(training.r)).max()) for training in trainings) / sample_time_s
    runs = [training.routine.pause_s[0] - training.routine.start_s for training in trainings]
    pauses = [training.pause_s for training in trainings]
    return Covered(min(speeds), max(speeds), float(np.mean(areas)), steepest, min(pauses), max(runs))


def judged(missed: Missed, covered: Covered, r: np.ndarray, *, sample_time_s: float) -> ForecastJudgement:
    """Returns whether a forecast of the wanted flow r (T,) may be believed."""
    if not math.isfinite(missed.percent):
        return ForecastJudgement(
            False, "fewer than three trials with learned commands tell no noise", "run more trials"
        )
    sizes = (
        (
            missed.held_out_percent,
            LIMIT_PERCENT,
            f"on routines left out the chain misses, most of it at {missed.event},",
            "print its verification (beadline compose PART --verify) and learn from it",
        ),
        (
            missed.change_percent,
            MOVES_PERCENT,
            "the machine changes from trial to trial: over the next prints that makes",
            "learn again from on-off control once the machine stays as it is",
        ),
        (
            missed.ripple_percent,
            MOVES_PERCENT,
            "the flow ripples otherwise in each trial: that makes",
            "mend what makes it ripple (drive, screw or pump) and learn again",
        ),
    )
    percent, limit, reason, trial = max(sizes, key=lambda size: size[0] / size[1])
    if percent > limit:
        size = f"{percent:.2g} % of on-off control's error ({limit:g} % allowed)"
        return ForecastJudgement(False, f"{reason} {size}", trial)
    return _asked(covered, r, sample_time_s)


def _asked(covered: Covered, r: np.ndarray, sample_time_s: float) -> ForecastJudgement:
    """Returns whether the speeds, changes, pauses and runs of r (T,) lie in the trained range."""
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
    """Returns possible flows (M, T) of the command u (T,) for the wanted flow r (T,): the flow of each member
    of the chain less the error on one routine left out, by place and in proportion to the flow wanted near
    by."""
    return np.stack(list(each_flow(chain, missed, u, r, sample_time_s=sample_time_s)))


def each_flow(
    chain: Chain, missed: Missed, u: np.ndarray, r: np.ndarray, *, sample_time_s: float
) -> Iterator[np.ndarray]:
    """Yields the rows (T,) of `flows` one after the other."""
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


def ends(values: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the least and largest (...) of values (...) that come one after the other."""
    rows = iter(values)
    low = np.array(next(rows))
    high = low.copy()
    for row in rows:
        np.minimum(low, row, out=low)
        np.maximum(high, row, out=high)
    return low, high


def error_percent(
    made: np.ndarray, on_off: np.ndarray, r: np.ndarray, missed: Missed
) -> tuple[float, float, float]:
    """Returns low, median and high of the r.m.s. error of the flows `made` (M, T), in % of that of on-off
    control's flows (M, T), member by member. 90 % of the possible outcomes lie between low and high. Both
    ends are widened by the possible total error (`Missed.percent`)."""
    ratio = np.linalg.norm(made - r, axis=1) / np.maximum(np.linalg.norm(on_off - r, axis=1), 1e-12)
    low, median, high = (float(value) for value in 100 * np.quantile(ratio, QUANTILES))
    doubt = float(np.nan_to_num(missed.percent))
    return math.sqrt(max(low**2 - doubt**2, 0.0)), median, math.hypot(high, doubt)


class PartWindow(NamedTuple):
    """Neighbouring lines (L,) of a part, by their place in PrintedLines; the hardest event there; and the
    standard deviation of the possible flows there, in mm^3/s."""

    lines: np.ndarray
    event: str
    deviation: float


def windows(
    made: np.ndarray, r: np.ndarray, lines: PrintedLines, tool: int, *, sample_time_s: float
) -> tuple[PartWindow, ...]:
    """Returns the hardest Start, Corner and Stop of one tool's share of a part, in the order of the part.
    These are the places where the possible flows (M, T) for the wanted flow r (T,) differ most. Windows that
    overlap are joined. Raises ValueError if the tool prints nothing."""
    mine = np.flatnonzero(lines.tool == tool)
    if not len(mine) or not np.any(r > 0):
        raise ValueError(
            f"verification: expected lines of T{tool} but it prints none; name a part that it prints"
        )
    spread = scipy.ndimage.uniform_filter1d(made.std(axis=0), max(round(SPREAD_S / sample_time_s), 1))
    event = places(r, sample_time_s) // BINS
    found = []
    for kind in (START, CORNER, STOP):
        at = np.flatnonzero(event == kind)
        if len(at):
            worst = at[np.argmax(spread[at])]
            near = _around(lines, mine, worst * sample_time_s)
            found.append(PartWindow(near, NAMES[kind], float(spread[worst])))
    return _apart(found)


def _around(lines: PrintedLines, mine: np.ndarray, time_s: float) -> np.ndarray:
    """Returns the run at time_s, or the one nearest to it, with as many neighbours as fit into WINDOW_S."""
    begin, end = lines.begin_s[mine], lines.end_s[mine]
    first = last = int(np.argmin(np.maximum(begin - time_s, 0) + np.maximum(time_s - end, 0)))
    while first > 0 and lines.run[mine[first - 1]] == lines.run[mine[first]]:
        first -= 1
    while last < len(mine) - 1 and lines.run[mine[last + 1]] == lines.run[mine[last]]:
        last += 1
    while first > 0 and end[last] - begin[first - 1] <= WINDOW_S:
        first -= 1
    while last < len(mine) - 1 and end[last + 1] - begin[first] <= WINDOW_S:
        last += 1
    return mine[first : last + 1]


def _apart(found: Sequence[PartWindow]) -> tuple[PartWindow, ...]:
    """Returns the windows in their order. Windows that share a line are joined and named by the harder
    event."""
    out: list[PartWindow] = []
    for window in sorted(found, key=lambda one: int(one.lines[0])):
        if out and window.lines[0] <= out[-1].lines[-1]:
            harder = max(out[-1], window, key=lambda one: one.deviation)
            out[-1] = harder._replace(lines=np.union1d(out[-1].lines, window.lines))
        else:
            out.append(window)
    return tuple(out)


def verification_program(
    name: str, chosen: Sequence[PartWindow], lines: PrintedLines, tool: int, *, bead_area_mm2: float
) -> tuple[str, float]:
    """Returns the part program of the windows, and its printing time in s. Along x each line is as long and
    as fast as in the part (a line longer than two plateaus keeps only its ends), and each pause and gap as
    long, a gap at most REST_S. The nozzle moves on through a gap."""
    text = [f"; verifies {name}, T{tool}: {', '.join(window.event for window in chosen)}"]
    text += ["; filament_diameter = 1.75", "G21", "G90", "M83", f"T{tool}", "G0 X0 Y0 Z0.3 F600"]
    x = y = duration = 0.0
    for window in chosen:
        for place, k in enumerate(window.lines):
            speed, length = float(lines.speed[k]), _shortened(float(lines.length[k]), float(lines.speed[k]))
            feed, x = f"F{60 * speed:.6g}", x + length
            text.append(f"G1 X{x:.4f} E{length * bead_area_mm2 / FILAMENT_MM2:.5f} {feed}")
            duration += length / speed
            if place == len(window.lines) - 1:
                break
            following = window.lines[place + 1]
            if lines.run[following] == lines.run[k]:
                if lines.corner[k] and lines.pause_s[k] > SHORTEST_S:
                    text.append(f"G4 P{1000 * max(float(lines.pause_s[k]), 0.0):.0f}")
                    duration += float(lines.pause_s[k])
                continue
            gap = max(float(lines.begin_s[following] - lines.end_s[k]), 0.0)
            gap = min(gap, REST_S)
            x, duration = x + gap * speed, duration + gap
            text.append(f"G0 X{x:.4f} {feed}")
        x, y = (0.0, y + BESIDE_MM) if x > TRACK_MM else (x + BESIDE_MM, y)
        text += [f"G0 X{x:.4f} Y{y:.4f} F600", f"G4 P{1000 * REST_S:.0f}"]
        duration += REST_S
    return "\n".join(text) + "\n", duration


def _shortened(length_mm: float, speed: float) -> float:
    """Returns the length of a line in the print, which keeps both its ends."""
    return min(length_mm, 2 * PLATEAU_S * speed)


def next_command(
    extruder: IdentifiedExtruder,
    u: np.ndarray,
    y: np.ndarray,
    r: np.ndarray,
    *,
    drive: Drive,
    sample_time_s: float,
) -> np.ndarray:
    """Returns the command (T,) in mm after a print of the part with u (T,): u + SHARE P^-1 Q (r - y), cut to
    what the drive can do. y (T,) is the measured flow, NaN where it was not observed. P is the chain's gain,
    time constant and delays, and Q a zero-phase low-pass (Bristow 2006, eq. 3)."""
    lacked = np.where(np.isfinite(y), r - y, 0.0)
    smooth = ilc.zero_phase(lacked, order=ORDER, cutoff_hz=CUTOFF_HZ, sample_time_s=sample_time_s)
    late = extruder.delay_s + basis.mean_lag_s(extruder)
    model = Extruder(extruder.gain, extruder.time_constant_s, late)
    more = ilc.inverse(smooth, model, sample_time_s=sample_time_s)
    return obeyed(u + SHARE * more, drive, sample_time_s=sample_time_s)


def measured_percent(y: np.ndarray, on_off: np.ndarray, r: np.ndarray) -> float:
    """Returns the r.m.s. error of a measured flow y (T,), NaN where it was not observed, in % of that of
    on-off control's flow (T,) over the same samples. Raises ValueError if nothing was observed."""
    seen = np.isfinite(y)
    if not seen.any():
        raise ValueError(
            "verification: expected a measured flow but every sample is missing; record it again"
        )
    error, yardstick = np.linalg.norm((y - r)[seen]), np.linalg.norm((on_off - r)[seen])
    return float(100 * error / max(yardstick, 1e-12))
