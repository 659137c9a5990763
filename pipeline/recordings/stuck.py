"""Signals that stand still but should not: frozen sensors, and converters on their rail.

A process comes to rest slowly, and a coarse sensor shows that in longer and longer stretches. A signal that
stops at once was stopped by its sensor.
"""

import numpy as np

from pipeline.recordings.signals import Flag, Table, measured

FROZEN_SHORTEST, RAIL_SHORTEST, OVER_USUAL = 30, 10, 5.0
# samples beside a stretch in which the signal must have been alive
BESIDE = 24


def frozen(table: Table, name: str) -> list[tuple[Flag, np.ndarray]]:
    """Stretches of one value that are far longer than usual for the signal and begin at once.

    Noise ends at once at an end of the stretch, or a movement does although it went on: a jump at the end of
    the stretch shows that, or other signals that move meanwhile.
    """
    values = measured(table, name)
    if not _may_rest(values, FROZEN_SHORTEST):
        return []
    first, last = runs(values, table.segment)
    length = last - first + 1
    rests = np.flatnonzero(length >= FROZEN_SHORTEST)
    rests = rests[length[rests] > OVER_USUAL * _usual_of_others(length, length[rests])]
    rests = rests[~_at_rail(values, table.segment, first[rests])]
    if not len(rests):
        return []
    step, stretches = _step(values), []
    others = {other: measured(table, other) for other in table.values if other != name}
    whole = {other: _range(column) for other, column in others.items()}
    for i in rests:
        a, b = int(first[i]), int(last[i])
        before, after = _before(values, table.segment, a), _after(values, table.segment, b)
        entry, end = _alive(before, step), _alive(-after[::-1], step)
        moving = [other for other, column in others.items() if _moves(column[a : b + 1], whole[other])]
        released = len(after) > 0 and abs(after[0]) > 3 * max(
            np.abs(before[1:]).max(initial=0.0), np.abs(after[1:]).max(initial=0.0)
        )
        noise_stopped = {entry, end} <= {"noise", "edge"} and "noise" in (entry, end)
        if noise_stopped or (entry == "movement" and (released or moving)):
            where = np.arange(a + 1, b + 1)
            beside = f" while {', '.join(moving[:3])} move" if moving else ""
            message = (
                f"{name} stays at {values[a]:g} for {b - a + 1} samples{beside}: a frozen sensor, masked"
            )
            stretches.append(
                (
                    Flag(
                        name,
                        "frozen",
                        float(table.time_s[a + 1]),
                        float(table.time_s[b]),
                        len(where),
                        message,
                    ),
                    where,
                )
            )
    return stretches


def rails(table: Table, name: str) -> list[Flag]:
    """Flags for a largest or smallest value at which the signal stops at once and stays for long."""
    values = measured(table, name)
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
        there = np.flatnonzero((values[first] == rail) & (length > limit))
        there = there[_at_rail(values, table.segment, first[there])]
        long = list(zip(first[there].tolist(), last[there].tolist(), strict=True))
        step = _step(values) if long else 0.0
        if any(_alive(_before(values, table.segment, a), step) in ("noise", "movement") for a, _ in long):
            count = sum(b - a + 1 for a, b in long)
            message = (
                f"{name} stays at {rail:g}, its {side} value, for {count} samples in {len(long)} stretches:"
                f" the sensor or its converter is saturated"
            )
            flags.append(
                Flag(
                    name,
                    "saturated",
                    float(table.time_s[long[0][0]]),
                    float(table.time_s[long[-1][1]]),
                    count,
                    message,
                )
            )
    return flags


def _may_rest(values: np.ndarray, least: int) -> bool:
    """Whether enough samples equal the one before for a stretch of `least`: a quick no for a fine signal."""
    return bool(np.count_nonzero(values[1:] == values[:-1]) >= least - 1)


def runs(values: np.ndarray, segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last index (m,) of stretches of equal values within segments. A NaN ends a stretch and is in
    none."""
    begins = np.ones(len(values), bool)
    begins[1:] = (values[1:] != values[:-1]) | (segment[1:] != segment[:-1])
    first = np.flatnonzero(begins)
    last = np.r_[first[1:], len(values)] - 1
    finite = np.isfinite(values[first])
    return first[finite], last[finite]


def _usual_of_others(lengths: np.ndarray, own: np.ndarray) -> np.ndarray:
    """For stretches of length `own` (k,) among `lengths` (m,): the length that holds nine tenths of the
    samples of the m - 1 others, infinite without others. A coarse or slow signal rests long, if not often."""
    if len(lengths) < 2:
        return np.full(len(own), np.inf)
    ordered = np.sort(lengths)
    held = np.cumsum(ordered)
    at = np.searchsorted(ordered, own)  # where the stretch itself stands
    wanted = np.ceil(0.9 * (held[-1] - own)).astype(int)
    j = np.searchsorted(held, wanted)
    # behind itself the others hold less by its length
    behind = np.maximum(np.searchsorted(held, wanted + own), at + 1)
    return ordered[np.where(j < at, j, behind)].astype(float)


def _before(values: np.ndarray, segment: np.ndarray, first: int) -> np.ndarray:
    """Changes from sample to sample that lead to `first`, within its segment."""
    start = max(first - BESIDE, int(np.searchsorted(segment, segment[first])))
    return np.diff(values[start : first + 1])


def _after(values: np.ndarray, segment: np.ndarray, last: int) -> np.ndarray:
    """Changes from `last` on, within its segment."""
    end = min(last + BESIDE, int(np.searchsorted(segment, segment[last], side="right")) - 1)
    return np.diff(values[last : end + 1])


def _step(values: np.ndarray) -> float:
    """The smallest change but for rounding: the step of a coarse signal."""
    changes = np.abs(np.diff(values))
    changes = changes[changes > 0]
    return float(np.percentile(changes, 1)) if len(changes) else 0.0


def _alive(changes: np.ndarray, step: float) -> str:
    """The signal before it stops: "noise" of more than its step, "movement" one way that does not slow down,
    "" for neither (it rests, or comes to rest), "edge" if the record has too little of it."""
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
    return (
        "movement"
        if turns <= 1
        and early * late > 0
        and abs(late) >= 0.5 * abs(early)
        and len(moved) >= 0.75 * len(changes)
        else ""
    )


def _range(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if len(finite) else 0.0


def _moves(inside: np.ndarray, whole: float) -> bool:
    """Whether a signal changes over a stretch by a tenth of its own range, `whole`."""
    inside = inside[np.isfinite(inside)]
    return len(inside) > 1 and whole > 0 and bool(np.ptp(inside) >= 0.1 * whole)


def _at_rail(values: np.ndarray, segment: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Mask (k,) of the stretches that lie on the largest or smallest value of all, and to which the signal
    came from another value. (A machine at rest begins at its smallest.)"""
    if not len(first):
        return np.zeros(0, bool)
    came = (first > 0) & (segment[first] == segment[np.maximum(first, 1) - 1])
    return came & ((values[first] == np.nanmax(values)) | (values[first] == np.nanmin(values)))
