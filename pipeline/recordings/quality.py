"""Flags for doubtful samples of a table, with place and count: spikes, frozen sensors, rails, constants,
quantisation, units. Wrong samples are masked."""

import itertools
from collections.abc import Callable, Mapping

import numpy as np
from scipy.ndimage import median_filter

from pipeline.recordings.signals import Flag, Table, measured
from pipeline.recordings.stuck import frozen, rails

SPIKE_WINDOW = 7
# a spike is beyond eight robust standard deviations of the residual of the local median, and beyond three
# times its neighbours' own changes
SPIKE_SIGMAS, SPIKE_OVER_NEIGHBOURS = 8.0, 3.0
SPIKE_LONGEST = 2
# from so many values on, some of them are looked at before all
MANY_VALUES = 10_000
# an input with no more levels than that between its limits follows a plan, and is not held back by the lower
# one
PLANNED_LEVELS = 20
# an extruder's barrel, nozzle and bed: a higher number in °C is doubtful; rooms in K and °F for a machine at
# rest
HOTTEST_DEGC = 450.0
ROOM_KELVIN, ROOM_FAHRENHEIT = (283.0, 313.0), (55.0, 100.0)
CELSIUS = {"degc", "°c", "℃", "c", "celsius"}
_PERCENT = {"percent", "%", "pct"}


def flag(table: Table, *, units: Mapping[str, str], limits: Mapping[str, tuple[float, float]]) -> Table:
    """The table with flags for doubtful samples. Samples that are no measurement are masked; values stay.

    `limits` are {input: (low, high)} in the input's unit; all other signals are outputs. Spikes and frozen
    stretches are masked. These are only reported: quantised, saturated, outside (an input beyond its limits),
    constant, unit (looks like kelvin, fahrenheit, a duty of 0-1).
    """
    outputs = [name for name in table.values if name not in limits]
    flags, masked = list(table.flags), {name: mask.copy() for name, mask in table.masked.items()}
    for name in outputs:
        for doubtful in (_spikes(table, name), frozen(table, name)):
            for finding, where in doubtful:
                flags.append(finding)
                masked[name][where] = True
    checked = table._replace(masked=masked)
    for name in outputs:
        for check in (_constant, _quantised, rails):
            flags += check(checked, name)
    for name, (low, high) in limits.items():
        if name in table.values:
            flags += _constant(checked, name) + _at_limits(checked, name, low, high)
    flags += _unit_flags(checked, units, limits)
    return checked._replace(flags=flags)


def _usable(table: Table, name: str) -> np.ndarray:
    return _chosen(table.values[name], ~table.masked[name])


def _chosen(values: np.ndarray, which: np.ndarray) -> np.ndarray:
    """The values of a mask; no copy where it holds all."""
    return values if which.all() else values[which]


def _flag(table: Table, name: str, kind: str, where: np.ndarray, message: str) -> Flag:
    return Flag(
        name, kind, float(table.time_s[where[0]]), float(table.time_s[where[-1]]), len(where), message
    )


def _groups(where: np.ndarray, segment: np.ndarray) -> list[np.ndarray]:
    """Sorted indices, split at every index that is missing and at the ends of segments."""
    if not len(where):
        return []
    return np.split(where, np.flatnonzero((np.diff(where) > 1) | (np.diff(segment[where]) != 0)) + 1)


def _in_segments(table: Table, name: str, of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The filter `of` on the values of each segment. The last value before a masked gap bridges the gap."""
    filtered = np.zeros(len(table.time_s))
    values = measured(table, name)
    starts = [0, *(np.flatnonzero(np.diff(table.segment)) + 1).tolist(), len(values)]
    for start, end in itertools.pairwise(starts):
        inside = values[start:end]
        known = np.isfinite(inside)
        if known.all():
            filtered[start:end] = of(inside)
        elif known.any():
            finite = np.flatnonzero(known)
            filtered[start:end] = of(inside[finite[np.maximum(np.cumsum(known) - 1, 0)]])
    return filtered


# ---- spikes


def _spikes(table: Table, name: str) -> list[tuple[Flag, np.ndarray]]:
    """Isolated samples that leave the local median and come back (Hampel 1974,
    with guards for quantised and for smooth signals)."""
    residual = _in_segments(table, name, lambda y: y - median_filter(y, SPIKE_WINDOW, mode="nearest"))
    usable = ~table.masked[name]
    size = np.abs(residual)
    known = _chosen(size, usable)
    if len(known) < 3 * SPIKE_WINDOW or _none_stands_out(known):
        return []
    # the median alone is 0 for a quantised signal: the 90th percentile and the step of the values count too
    sigma = max(
        1.4826 * np.median(known),
        np.percentile(known, 90) / 1.645,
        quantisation_step(table.values[name][usable]),
    )
    spikes = []
    for group in _groups(np.flatnonzero(usable & (size > SPIKE_SIGMAS * sigma)), table.segment):
        # beside a spike the median of a smooth signal is off by what it does in a sample
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
    """Whether no residual can be beyond eight of the deviations that the 90th percentile tells: more than a
    tenth are at least an eighth as large as such a one. That is found by counting, in place of sorting."""
    near = size.max() / SPIKE_SIGMAS * 1.645 * (1 + 1e-9)  # beyond what rounding does to the percentile
    return bool(np.count_nonzero(size >= near) >= len(size) - int(0.9 * (len(size) - 1)))


def _stands_alone(table: Table, name: str, group: np.ndarray, size: float) -> bool:
    """Whether the neighbours on both sides go on as if the group were not there."""
    inside = np.flatnonzero(table.segment == table.segment[group[0]])
    near = inside[(inside >= group[0] - SPIKE_WINDOW) & (inside <= group[-1] + SPIKE_WINDOW)]
    others = near[~np.isin(near, group) & ~table.masked[name][near]]
    if not (others < group[0]).any() or not (others > group[-1]).any():
        return False
    changes = np.abs(np.diff(table.values[name][others]))
    return size > SPIKE_OVER_NEIGHBOURS * changes.max(initial=0.0)


def quantisation_step(values: np.ndarray) -> float:
    """The step of a quantised signal, 0 if the levels have no common step.

    The median distance d of neighbouring levels is the step if nine tenths of the distances are whole
    multiples of it (to a tenth: rounded print-outs of 0.0322 differ by 0.032 or 0.033) and if values come
    back to their levels, at least three times each.
    """
    # a signal with all its digits shows in little more than a third of its values that it has too many levels
    some = values[: 2 * len(values) // 5] if len(values) >= MANY_VALUES else values
    levels = np.unique(some)
    if len(some) < len(values) and len(levels) <= len(values) / 3:
        levels = np.unique(values)
    if len(levels) < 2 or len(levels) > len(values) / 3:
        return 0.0
    distances = np.diff(levels)
    # levels that differ by rounding alone are one
    distances = distances[distances > 1e-9 * max(1.0, float(np.abs(levels).max()))]
    if not len(distances):
        return 0.0
    step = float(np.median(distances))
    ratio = distances / step
    multiple = np.abs(ratio - np.rint(ratio)) <= 0.1 * np.maximum(1.0, np.rint(ratio))
    return step if np.mean(multiple & (ratio > 0.5)) >= 0.9 else 0.0


# ---- constants, limits, quantisation


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
    # a few values tell already that there are more
    planned = all(len(np.unique(some)) <= PLANNED_LEVELS for some in (inside[:MANY_VALUES], inside))
    # a controller or a random signal moves in most samples and is cut off; a plan of levels asks for it
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


def _quantised(table: Table, name: str) -> list[Flag]:
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
        doubt = (
            _doubtful_celsius(name, usable, resting)
            if unit in CELSIUS
            else _doubtful_percent(name, usable, limits.get(name, (0.0, 100.0))[1])
            if unit in _PERCENT
            else ""
        )
        if doubt:
            flags.append(_flag(table, name, "unit", np.flatnonzero(~table.masked[name]), doubt))
    return flags


def _at_rest(table: Table, units: Mapping[str, str], limits: Mapping[str, tuple[float, float]]) -> bool:
    """Whether the recording begins on a machine at the room's temperature: every input is at 0 or its lowest,
    or several temperatures are alike."""
    first = {name: float(_usable(table, name)[0]) for name in table.values if len(_usable(table, name))}
    idle = bool(limits) and all(first.get(name, np.nan) in (0.0, low) for name, (low, _) in limits.items())
    starts = [
        value
        for name, value in first.items()
        if name not in limits and units.get(name, "").casefold() in CELSIUS
    ]
    return idle or (len(starts) > 1 and np.ptp(starts) <= 3.0)


def _doubtful_celsius(name: str, values: np.ndarray, resting: bool) -> str:
    first, middle = values[0], float(np.median(values))
    if values.min() < -273.15:
        return (
            f"{name} falls to {values.min():g} °C, which no temperature does; "
            "mend the mapping's scale and offset"
        )
    if middle > HOTTEST_DEGC or (resting and ROOM_KELVIN[0] <= first <= ROOM_KELVIN[1]):
        return (
            f"{name} begins at {first:g} and is {middle:g} in the middle: it looks like kelvin; "
            "set offset: -273.15 if it is"
        )
    if resting and ROOM_FAHRENHEIT[0] <= first <= ROOM_FAHRENHEIT[1]:
        return (
            f"{name} begins at {first:g} on a machine at rest: it looks like fahrenheit; "
            "set scale: 0.555556 and offset: -17.7778 if it is"
        )
    if resting and values.max() <= 1.0 and values.min() >= 0.0:
        return (
            f"{name} lies within 0 to 1: it looks like a share or a voltage; "
            "set the sensor's scale and offset if it is"
        )
    return ""


def _doubtful_percent(name: str, values: np.ndarray, high: float) -> str:
    top = values.max()
    if 0.0 < top <= 1.0 and values.min() >= 0.0:
        return (
            f"{name} lies within {values.min():g} to {top:g}: it looks like a duty of 0 to 1; "
            "set scale: 100 if it is"
        )
    for full in (255, 1023, 4095, 65535):
        if max(100.0, high) < top <= full and values.min() >= 0.0 and (values == np.rint(values)).all():
            return (
                f"{name} reaches {top:g} in whole numbers: it looks like a converter's 0 to {full}; "
                f"set scale: {100 / full:.6g} if it is"
            )
    return ""
