"""Flags doubtful samples of a table, with place and count: spikes, frozen sensors, saturated sensors,
constants, quantisation, units. Wrong samples are masked."""

import itertools
from collections.abc import Collection, Mapping

import numpy as np
from scipy.ndimage import median_filter

from pipeline.recordings.formats import Flag, Table

SPIKE_WINDOW = 7
# a spike is beyond eight robust standard deviations of the residual of the local median, and beyond three
# times its neighbours' own changes
SPIKE_SIGMAS, SPIKE_OVER_NEIGHBOURS = 8.0, 3.0
SPIKE_LONGEST = 2
# from this many values on, a part of them is checked first
MANY_VALUES = 10_000
# an input with at most this many levels between its limits follows a plan, and its lower limit does not cut
# it off
PLANNED_LEVELS = 20
# an extruder's barrel, nozzle and bed: a higher number in °C is doubtful; rooms in K and °F for a machine at
# rest
HOTTEST_DEGC = 450.0
ROOM_KELVIN, ROOM_FAHRENHEIT = (283.0, 313.0), (55.0, 100.0)
CELSIUS = {"degc", "°c", "℃", "c", "celsius"}
_PERCENT = {"percent", "%", "pct"}


def flag(
    table: Table,
    *,
    units: Mapping[str, str],
    limits: Mapping[str, tuple[float, float]],
    computed: Collection[str] = (),
) -> Table:
    """Returns the table with flags for doubtful samples. Samples that are no measurement are masked. Values
    are not changed.

    `limits`: {input: (low, high)} in the input's unit. All other signals are outputs, except those `computed`
    from a printed file, which no sensor measured. Spikes and frozen stretches are masked. These are only
    reported: quantised, saturated, outside (an input beyond its limits), constant, unit (looks like kelvin,
    fahrenheit, a duty of 0-1).
    """
    outputs = [name for name in table.values if name not in limits and name not in computed]
    flags, masked = list(table.flags), {name: mask.copy() for name, mask in table.masked.items()}
    for name in outputs:
        for finding, where in [*_spikes(table, name), *frozen(table, name)]:
            flags.append(finding)
            masked[name][where] = True
    checked = table._replace(masked=masked)
    for name in outputs:
        for check in (_constant, _quantisation, rails):
            flags += check(checked, name)
    for name, (low, high) in limits.items():
        if name in table.values:
            flags += _constant(checked, name) + _at_limits(checked, name, low, high)
    flags += _unit_flags(checked, units, limits)
    return checked._replace(flags=flags)


def values_or_nan(table: Table, name: str) -> np.ndarray:
    """Returns the values (T,) of a signal, NaN where it is masked. They are not copied if none is masked."""
    masked = table.masked[name]
    return np.where(masked, np.nan, table.values[name]) if masked.any() else table.values[name]


def _usable(table: Table, name: str) -> np.ndarray:
    """Returns the values that are not masked. They are not copied if none is masked."""
    masked = table.masked[name]
    return table.values[name][~masked] if masked.any() else table.values[name]


def _flag(table: Table, name: str, kind: str, where: np.ndarray, message: str) -> Flag:
    return Flag(
        name, kind, float(table.time_s[where[0]]), float(table.time_s[where[-1]]), len(where), message
    )


def _groups(where: np.ndarray, segment: np.ndarray) -> list[np.ndarray]:
    """Returns the sorted indices as groups, split at every missing index and at the ends of segments."""
    if not len(where):
        return []
    return np.split(where, np.flatnonzero((np.diff(where) > 1) | (np.diff(segment[where]) != 0)) + 1)


def _residual(table: Table, name: str) -> np.ndarray:
    """Returns the difference of each value from the local median in its segment. Inside a masked gap the last
    value before it is used."""
    residual = np.zeros(len(table.time_s))
    values = values_or_nan(table, name)
    starts = [0, *(np.flatnonzero(np.diff(table.segment)) + 1).tolist(), len(values)]
    for start, end in itertools.pairwise(starts):
        inside = values[start:end]
        finite = np.isfinite(inside)
        if finite.any():
            if not finite.all():
                inside = inside[np.flatnonzero(finite)[np.maximum(np.cumsum(finite) - 1, 0)]]
            residual[start:end] = inside - median_filter(inside, SPIKE_WINDOW, mode="nearest")
    return residual


# ---- spikes


def _spikes(table: Table, name: str) -> list[tuple[Flag, np.ndarray]]:
    """Returns flags and indices of isolated samples that leave the local median and come back (Hampel 1974,
    with guards for quantised and for smooth signals)."""
    residual, usable = _residual(table, name), ~table.masked[name]
    size = np.abs(residual)
    sizes = size[usable]
    if len(sizes) < 3 * SPIKE_WINDOW or _none_stands_out(sizes):
        return []
    # the median alone is 0 for a quantised signal: the 90th percentile and the step of the values count too
    sigma = max(
        1.4826 * np.median(sizes),
        np.percentile(sizes, 90) / 1.645,
        quantisation_step(table.values[name][usable]),
    )
    spikes = []
    for group in _groups(np.flatnonzero(usable & (size > SPIKE_SIGMAS * sigma)), table.segment):
        # beside a spike the median of a smooth signal is off by about one sample's change
        group = group[size[group] > size[group].max() / 2]
        if len(group) <= SPIKE_LONGEST and _stands_alone(table, name, group, size[group].min()):
            at, value = float(table.time_s[group[0]]), float(table.values[name][group[0]])
            local = value - float(residual[group[0]])
            message = (
                f"{name} is {value:g} at {at:g} s while its neighbours are at {local:g}: "
                "a spike of the sensor, masked"
            )
            spikes.append((_flag(table, name, "spike", group, message), group))
    return spikes


def _none_stands_out(size: np.ndarray) -> bool:
    """Returns whether no residual can exceed eight deviations, with the deviation estimated from the 90th
    percentile. This holds if more than a tenth of the residuals are at least about a fifth of the largest
    one. Counting them is faster than sorting."""
    limit = size.max() / SPIKE_SIGMAS * 1.645 * (1 + 1e-9)  # beyond what rounding does to the percentile
    return bool(np.count_nonzero(size >= limit) >= len(size) - int(0.9 * (len(size) - 1)))


def _stands_alone(table: Table, name: str, group: np.ndarray, size: float) -> bool:
    """Returns whether the neighbours on both sides continue as if the group were not there."""
    inside = np.flatnonzero(table.segment == table.segment[group[0]])
    window = inside[(inside >= group[0] - SPIKE_WINDOW) & (inside <= group[-1] + SPIKE_WINDOW)]
    neighbours = window[~np.isin(window, group) & ~table.masked[name][window]]
    if not (neighbours < group[0]).any() or not (neighbours > group[-1]).any():
        return False
    changes = np.abs(np.diff(table.values[name][neighbours]))
    return size > SPIKE_OVER_NEIGHBOURS * changes.max(initial=0.0)


def quantisation_step(values: np.ndarray) -> float:
    """Returns the step of a quantised signal, 0 if the levels have no common step.

    The median distance d of neighbouring levels is the step under two conditions. Nine tenths of the
    distances are whole multiples of d (to a tenth: rounded print-outs of 0.0322 differ by 0.032 or 0.033).
    And values come back to their levels, at least three times each on average.
    """
    # a little more than a third of the values is enough to see that an unquantised signal has too many levels
    some = values[: 2 * len(values) // 5] if len(values) >= MANY_VALUES else values
    levels = np.unique(some)
    if len(some) < len(values) and len(levels) <= len(values) / 3:
        levels = np.unique(values)
    if len(levels) < 2 or len(levels) > len(values) / 3:
        return 0.0
    distances = np.diff(levels)
    # levels that differ only by rounding are one
    distances = distances[distances > 1e-9 * max(1.0, float(np.abs(levels).max()))]
    if not len(distances):
        return 0.0
    step = float(np.median(distances))
    ratio = distances / step
    multiple = np.abs(ratio - np.rint(ratio)) <= 0.1 * np.maximum(1.0, np.rint(ratio))
    return step if np.mean(multiple & (ratio > 0.5)) >= 0.9 else 0.0


# ---- constants, limits, quantisation

STILL_DEGC = 2.0  # a heater's own control keeps a held temperature within that
STILL_DEVIATIONS, STILL_STEPS = 6.0, 3.0  # of the noise from sample to sample, and of a coarse sensor


def stands_still(measured: np.ndarray, set_point: np.ndarray | None) -> bool:
    """Returns whether a temperature (T,) in °C never moves: 99 % of its samples lie within STILL_DEGC, and
    its set-point (T,) never changed. If the set-point was not recorded (None), the samples must span no more
    than noise or a few steps of the sensor."""
    if len(measured) < 2:
        return False
    low, high = np.quantile(measured, [0.005, 0.995])
    if high - low > STILL_DEGC:
        return False
    if set_point is not None and np.isfinite(set_point).any():
        return bool(np.ptp(set_point[np.isfinite(set_point)]) == 0)
    noise = STILL_DEVIATIONS * np.diff(measured).std() / np.sqrt(2)
    return bool(high - low <= 1.01 * max(noise, STILL_STEPS * quantisation_step(measured)))


def _constant(table: Table, name: str) -> list[Flag]:
    usable = _usable(table, name)
    if not len(usable) or np.ptp(usable) > 0:
        return []
    message = (
        f"{name} is {usable[0]:g} throughout: the recording says nothing of what it does; "
        "move it, or leave it out"
    )
    return [_flag(table, name, "constant", np.arange(len(table.time_s)), message)]


def _at_limits(table: Table, name: str, low: float, high: float) -> list[Flag]:
    values, usable, flags = table.values[name], ~table.masked[name], []
    tolerance = 1e-6 * (high - low)
    inside = values[usable & (values > low + tolerance) & (values < high - tolerance)]
    # a part of the values is often enough to see that there are more levels
    planned = all(len(np.unique(some)) <= PLANNED_LEVELS for some in (inside[:MANY_VALUES], inside))
    # a controller or a random signal changes in most samples and is cut off; a plan of levels wants the limit
    # itself
    cut_off = not planned and np.mean(np.diff(inside) != 0) > 0.5
    remark = ": there the limit decides, not what commands it" if cut_off else ""
    for limit, at in ((low, np.abs(values - low) <= tolerance), (high, np.abs(values - high) <= tolerance)):
        where = np.flatnonzero(at & usable)
        if len(where) and np.ptp(_usable(table, name)) > 0 and not (planned and limit == low):
            message = f"{name} is at its limit {limit:g} in {len(where)} of {usable.sum()} samples{remark}"
            flags.append(_flag(table, name, "saturated", where, message))
    where = np.flatnonzero(usable & ((values < low - tolerance) | (values > high + tolerance)))
    if len(where):
        message = (
            f"{name} is beyond its limits {low:g} to {high:g} in {len(where)} samples (up to"
            f" {values[where].max():g}); mend the limits or the mapping"
        )
        flags.append(_flag(table, name, "outside", where, message))
    return flags


def _quantisation(table: Table, name: str) -> list[Flag]:
    usable = _usable(table, name)
    step = quantisation_step(usable) if len(usable) else 0.0
    if not step:
        return []
    levels = len(np.unique(usable))
    noise = step / np.sqrt(12)
    message = (
        f"{name} comes in steps of {step:.3g} ({levels} levels): "
        f"that is a noise of {noise:.2g} that no model explains"
    )
    return [_flag(table, name, "quantised", np.flatnonzero(~table.masked[name]), message)]


# ---- units


def _unit_flags(
    table: Table, units: Mapping[str, str], limits: Mapping[str, tuple[float, float]]
) -> list[Flag]:
    resting = _at_rest(table, units, limits)
    flags = []
    for name in table.values:
        usable, unit = _usable(table, name), units.get(name, "").casefold()
        if not len(usable):
            continue
        doubts: list[tuple[object, str]] = []
        if unit in CELSIUS:
            doubts = _celsius_doubts(usable, resting)
        elif unit in _PERCENT:
            doubts = _percent_doubts(usable, limits.get(name, (0.0, 100.0))[1])
        doubt = next((message for holds, message in doubts if holds), "")
        if doubt:
            flags.append(_flag(table, name, "unit", np.flatnonzero(~table.masked[name]), f"{name} {doubt}"))
    return flags


def _at_rest(table: Table, units: Mapping[str, str], limits: Mapping[str, tuple[float, float]]) -> bool:
    """Returns whether the recording begins with the machine at the room's temperature: every input is at 0 or
    at its lowest value, or several temperatures are alike."""
    first = {name: float(_usable(table, name)[0]) for name in table.values if len(_usable(table, name))}
    idle = bool(limits) and all(first.get(name, np.nan) in (0.0, low) for name, (low, _) in limits.items())
    starts = [
        value
        for name, value in first.items()
        if name not in limits and units.get(name, "").casefold() in CELSIUS
    ]
    return idle or (len(starts) > 1 and np.ptp(starts) <= 3.0)


def _celsius_doubts(values: np.ndarray, resting: bool) -> list[tuple[object, str]]:
    """Returns (whether it holds, words) for the units that the values may have instead of °C. The first that
    holds counts."""
    first, median, low, high = values[0], float(np.median(values)), values.min(), values.max()
    return [
        (
            low < -273.15,
            f"falls to {low:g} °C, which no temperature does; mend the mapping's scale and offset",
        ),
        (
            median > HOTTEST_DEGC or (resting and ROOM_KELVIN[0] <= first <= ROOM_KELVIN[1]),
            f"begins at {first:g} and is {median:g} in the middle: it looks like kelvin; "
            "set offset: -273.15 if it is",
        ),
        (
            resting and ROOM_FAHRENHEIT[0] <= first <= ROOM_FAHRENHEIT[1],
            f"begins at {first:g} on a machine at rest: it looks like fahrenheit; "
            "set scale: 0.555556 and offset: -17.7778 if it is",
        ),
        (
            resting and 0.0 <= low and high <= 1.0,
            "lies within 0 to 1: it looks like a share or a voltage; "
            "set the sensor's scale and offset if it is",
        ),
    ]


def _percent_doubts(values: np.ndarray, limit: float) -> list[tuple[object, str]]:
    """Returns (whether it holds, words) for what the values may be instead of percent."""
    low, high = values.min(), values.max()
    converted = low >= 0.0 and max(100.0, limit) < high and bool((values == np.rint(values)).all())
    duty = f"lies within {low:g} to {high:g}: it looks like a duty of 0 to 1; set scale: 100 if it is"
    converters = [
        (
            converted and high <= full,
            f"reaches {high:g} in whole numbers: it looks like a converter's 0 to {full}; "
            f"set scale: {100 / full:.6g} if it is",
        )
        for full in (255, 1023, 4095, 65535)
    ]
    return [(low >= 0.0 and 0.0 < high <= 1.0, duty), *converters]


# ---- sensors that stand still but should not. A process comes to rest slowly; a signal that stops at once
# was stopped by its sensor

FROZEN_SHORTEST, RAIL_SHORTEST, OVER_USUAL = 30, 10, 5.0
# samples before and after a stretch that are checked for noise or movement
BESIDE = 24


def frozen(table: Table, name: str) -> list[tuple[Flag, np.ndarray]]:
    """Returns flags and indices of stretches of one value that begin at once and are far longer than usual
    for the signal.

    Either noise stops at once at an end of the stretch, or a movement stops although the process continued.
    This shows as a jump at the end of the stretch, or as other signals that move during it.
    """
    values = values_or_nan(table, name)
    if not _may_rest(values, FROZEN_SHORTEST):
        return []
    first, last = runs(values, table.segment)
    length = last - first + 1
    rests = np.flatnonzero(length >= FROZEN_SHORTEST)
    rests = rests[length[rests] > OVER_USUAL * _usual_of_others(length, length[rests])]
    rests = rests[~_at_rail(values, table.segment, first[rests])]
    if not len(rests):
        return []
    step, stretches = least_change(values), []
    columns = {other: values_or_nan(table, other) for other in table.values if other != name}
    ranges = {other: _range(column) for other, column in columns.items()}
    for i in rests:
        a, b = int(first[i]), int(last[i])
        earlier, later = _before(values, table.segment, a), _after(values, table.segment, b)
        entry, end = _alive(earlier, step), _alive(-later[::-1], step)
        moving = [other for other, column in columns.items() if _moves(column[a : b + 1], ranges[other])]
        released = len(later) > 0 and abs(later[0]) > 3 * max(
            np.abs(earlier[1:]).max(initial=0.0), np.abs(later[1:]).max(initial=0.0)
        )
        noise_stopped = {entry, end} <= {"noise", "edge"} and "noise" in (entry, end)
        if noise_stopped or (entry == "movement" and (released or moving)):
            where = np.arange(a + 1, b + 1)
            meanwhile = f" while {', '.join(moving[:3])} move" if moving else ""
            message = (
                f"{name} stays at {values[a]:g} for {b - a + 1} samples{meanwhile}: a frozen sensor, masked"
            )
            stretches.append((_flag(table, name, "frozen", where, message), where))
    return stretches


def rails(table: Table, name: str) -> list[Flag]:
    """Returns flags for a largest or smallest value at which the signal stops at once and stays for long."""
    values = values_or_nan(table, name)
    if not _may_rest(values, RAIL_SHORTEST + 1):
        return []
    finite = values[np.isfinite(values)]
    if not len(finite) or np.ptp(finite) == 0:
        return []
    first, last = runs(values, table.segment)
    length = last - first + 1
    limit = max(RAIL_SHORTEST, OVER_USUAL * float(np.percentile(length, 95)))
    flags = []
    for rail, side in ((finite.max(), "largest"), (finite.min(), "smallest")):
        rests = np.flatnonzero((values[first] == rail) & (length > limit))
        rests = rests[_at_rail(values, table.segment, first[rests])]
        long = list(zip(first[rests].tolist(), last[rests].tolist(), strict=True))
        step = least_change(values) if long else 0.0
        if any(_alive(_before(values, table.segment, a), step) in ("noise", "movement") for a, _ in long):
            where = np.concatenate([np.arange(a, b + 1) for a, b in long])
            message = (
                f"{name} stays at {rail:g}, its {side} value, for {len(where)} samples in {len(long)} "
                "stretches: the sensor or its converter is saturated"
            )
            flags.append(_flag(table, name, "saturated", where, message))
    return flags


def _may_rest(values: np.ndarray, least: int) -> bool:
    """Returns whether enough samples equal the previous one for a stretch of `least`. This is a quick test
    that excludes finely resolved signals."""
    return bool(np.count_nonzero(values[1:] == values[:-1]) >= least - 1)


def runs(values: np.ndarray, segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the first and last index (m,) of stretches of equal values within segments. A NaN ends a
    stretch and belongs to none."""
    begins = np.ones(len(values), bool)
    begins[1:] = (values[1:] != values[:-1]) | (segment[1:] != segment[:-1])
    first = np.flatnonzero(begins)
    last = np.r_[first[1:], len(values)] - 1
    finite = np.isfinite(values[first])
    return first[finite], last[finite]


def _usual_of_others(lengths: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Returns, for stretches of length `own` (k,) among `lengths` (m,), the usual length of the m - 1 others:
    stretches up to this length hold nine tenths of the others' samples. It is infinite without others. A
    coarse or slow signal has few, but long, stretches."""
    if len(lengths) < 2:
        return np.full(len(own), np.inf)
    ordered = np.sort(lengths)
    total = np.cumsum(ordered)
    at = np.searchsorted(ordered, own)  # where the stretch itself stands
    wanted = np.ceil(0.9 * (total[-1] - own)).astype(int)
    j = np.searchsorted(total, wanted)
    # at and after the stretch itself, the sum over the others is smaller by its length
    later = np.maximum(np.searchsorted(total, wanted + own), at + 1)
    return ordered[np.where(j < at, j, later)].astype(float)


def _before(values: np.ndarray, segment: np.ndarray, first: int) -> np.ndarray:
    """Returns the changes from sample to sample that lead to `first`, within its segment."""
    start = max(first - BESIDE, int(np.searchsorted(segment, segment[first])))
    return np.diff(values[start : first + 1])


def _after(values: np.ndarray, segment: np.ndarray, last: int) -> np.ndarray:
    """Returns the changes from `last` on, within its segment."""
    end = min(last + BESIDE, int(np.searchsorted(segment, segment[last], side="right")) - 1)
    return np.diff(values[last : end + 1])


def least_change(values: np.ndarray, lag: int = 1) -> float:
    """Returns the first percentile of the nonzero changes over `lag` samples, infinite without changes. For a
    coarse sensor this is one step, for a fine one it is close to 0."""
    changes = np.abs(values[lag:] - values[:-lag])
    changes = changes[changes > 0]
    return float(np.percentile(changes, 1)) if len(changes) else np.inf


def _alive(changes: np.ndarray, step: float) -> str:
    """Returns what the signal did before it stopped. "noise": changes larger than its step; "movement": in
    one direction without slowing down; "": neither (it rests, or comes to rest); "edge": the record has too
    few samples there."""
    changes = changes[np.isfinite(changes)]
    if len(changes) < BESIDE // 2:
        return "edge"
    moved = changes[changes != 0]
    if len(moved) < len(changes) / 3:
        return ""
    turns = np.count_nonzero(np.diff(np.sign(moved)))
    if turns >= len(changes) / 6 and np.count_nonzero(np.abs(moved) > 1.5 * step) >= 3:
        return "noise"
    third = len(changes) // 3
    early, late = changes[:third].sum(), changes[-third:].sum()
    goes_on = early * late > 0 and abs(late) >= 0.5 * abs(early)
    return "movement" if turns <= 1 and goes_on and len(moved) >= 0.75 * len(changes) else ""


def _range(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if len(finite) else 0.0


def _moves(inside: np.ndarray, full_range: float) -> bool:
    """Returns whether a signal changes over a stretch by at least a tenth of its own range."""
    inside = inside[np.isfinite(inside)]
    return len(inside) > 1 and full_range > 0 and bool(np.ptp(inside) >= 0.1 * full_range)


def _at_rail(values: np.ndarray, segment: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Returns a mask (k,) of the stretches at the largest or smallest value of all that the signal reached
    from another value. (A machine at rest begins at its smallest value.)"""
    if not len(first):
        return np.zeros(0, bool)
    came = (first > 0) & (segment[first] == segment[np.maximum(first, 1) - 1])
    return came & ((values[first] == np.nanmax(values)) | (values[first] == np.nanmin(values)))


# ---- two devices under one name: samples jump to and fro between two courses, and intervals alternate

# windows of this many samples, half overlapping: short ones for devices that write alternately, long ones for
# devices that write in batches
WINDOWS = (32, 128)
LEAST_SHARE, LEAST_CROSSINGS, LEAST_WINDOWS = 1 / 8, 4, 3
# no sample lies between the two courses: the gap is more than three times any other, and more than three
# steps of a coarse sensor. No sensor is assumed to be coarser than 2
GAP, COARSEST_STEP = 3.0, 2.0
WINDOWS_AT_ONCE = 1000


def mask_mixed(table: Table, signals: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Table:
    """Returns the table with flags for stretches in which two devices write under one name. They are found in
    the record's own samples {signal: (time_s (n,), values (n,))}. They are masked, because nothing tells
    which device wrote a sample."""
    flags = list(table.flags)
    for name, (time_s, values) in signals.items():
        for first, last, distance in find_mixed(values):
            start, end = float(time_s[first]), float(time_s[last])
            table.masked[name][(table.time_s >= start) & (table.time_s <= end)] = True
            message = (
                f"{name} jumps to and fro between two courses {distance:.3g} apart from {start:g} to {end:g} "
                "s, masked: two devices seem to write under one name; record each under a name of its own"
            )
            flags.append(Flag(name, "mixed", start, end, last - first + 1, message))
    return table._replace(flags=flags)


def find_mixed(values: np.ndarray) -> list[tuple[int, int, float]]:
    """Returns (first, last, distance) of the stretches of values (n,) with samples from two courses at once,
    `distance` apart.

    In each window the best parabola is subtracted and the remainder sorted. Two courses give two groups with
    a gap between them, and the samples change group again and again. (A step changes group once, a spike
    twice.)
    """
    finite = np.flatnonzero(np.isfinite(values))
    y, step = values[finite], 0.0
    suspect, distance = np.zeros(len(y), bool), np.zeros(len(y), np.float32)
    for size in WINDOWS:
        if len(y) < size:
            continue
        starts = np.unique(np.r_[np.arange(0, len(y) - size, size // 2), len(y) - size])
        parabolas = np.linalg.qr(np.vander(np.linspace(-1, 1, size), 3))[0]
        gap = np.concatenate(
            [_gaps(y, part, parabolas) for part in np.array_split(starts, -(-len(starts) // WINDOWS_AT_ONCE))]
        )
        hit = _in_a_row(gap > 0, min(LEAST_WINDOWS, len(gap)))
        if not hit.any():
            continue
        # most records are finished here; the step costs more time than the gaps
        step = step or _coarse_step(y)
        hit = _in_a_row(gap > GAP * step, min(LEAST_WINDOWS, len(gap)))
        for start, width in zip(starts[hit], gap[hit], strict=True):
            suspect[start : start + size] = True
            distance[start : start + size] = width
    edges = np.flatnonzero(np.diff(np.r_[False, suspect, False].astype(np.int8)))
    return [
        (int(finite[a]), int(finite[b - 1]), float(np.median(distance[a:b])))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _coarse_step(y: np.ndarray) -> float:
    """Returns the step that a coarse sensor may explain, more than 0."""
    # over one sample and over more, because with two alternating devices every change between samples is a
    # jump
    step = min(COARSEST_STEP, *(least_change(y, lag) for lag in (1, 2, 3)))
    # a converter may be coarser. Its levels show this if there are more than two (two devices at rest have
    # two)
    return max(step, quantisation_step(y)) if len(np.unique(y)) > 2 else step


def _gaps(y: np.ndarray, starts: np.ndarray, parabolas: np.ndarray) -> np.ndarray:
    """Returns the gap between the two courses in each window, 0 if a window does not have two; the sensor's
    step is not yet considered. `parabolas` (size, 3): orthonormal basis of the parabolas over a window."""
    size = len(parabolas)
    windows = np.lib.stride_tricks.sliding_window_view(y, size)[starts]
    residual = windows - windows @ parabolas @ parabolas.T
    ordered = np.sort(residual, axis=1)
    between = np.diff(ordered, axis=1)
    least, rows = round(LEAST_SHARE * size), np.arange(len(starts))
    at = least - 1 + np.argmax(between[:, least - 1 : size - least], axis=1)
    gap, middle = between[rows, at], (ordered[rows, at] + ordered[rows, at + 1]) / 2
    between[rows, at] = 0
    apart = np.flatnonzero(gap > GAP * between.max(1))
    crossings = np.count_nonzero(np.diff(residual[apart] > middle[apart, None], axis=1), axis=1)
    two = apart[crossings >= LEAST_CROSSINGS]
    gaps = np.zeros(len(starts))
    gaps[two] = gap[two]
    return gaps


def _in_a_row(hit: np.ndarray, least: int) -> np.ndarray:
    """Returns a mask (n,) of the hits that belong to at least `least` hits in a row."""
    edges = np.flatnonzero(np.diff(np.r_[False, hit, False].astype(int)))
    long_enough = np.zeros(len(hit), bool)
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        long_enough[a:b] = b - a >= least
    return long_enough


def alternate(intervals_s: np.ndarray) -> bool:
    """Returns whether a long interval follows each short one, as with two clocks of equal rate, one shifted
    against the other."""
    if len(intervals_s) < 20:
        return False
    deviation = intervals_s - intervals_s.mean()
    power = float(deviation @ deviation)
    return power > 0 and float(deviation[1:] @ deviation[:-1]) < -0.8 * power
