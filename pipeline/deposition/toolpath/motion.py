"""Moves -> the gantry's travel in time, as firmware plans it: trapezoids of speed with look-ahead, corners by
junction deviation, arcs by their true length."""

from typing import NamedTuple

import numpy as np

from pipeline.deposition.toolpath.gcode import Kind, Moves

BLOCK = 1 << 17  # samples worked on at once
MOST = 50_000_000  # samples of one signal, 11 days at 50 Hz: beyond it a feed or a dwell is a slip


class Motion(NamedTuple):
    """The plan of N moves: each speeds up from `entry` to `cruise` in ramp_s[0], cruises, and slows down to
    `exit` in ramp_s[1].

    begin_s, duration_s (N,): when a move begins and how long it takes. entry, cruise, exit (N,): mm/s along
    the path, of filament if E moves alone. ramp_s (2, N): seconds of speeding up and of slowing down.
    acceleration (N,): mm/s^2. travel (N,): mm along the path, of filament if E moves alone. turn (N,): angle
    in rad by which the path turns at the begin of the move (0 straight on, pi back), NaN if this move or the
    one before has no travel.
    """

    begin_s: np.ndarray
    duration_s: np.ndarray
    entry: np.ndarray
    cruise: np.ndarray
    exit: np.ndarray
    ramp_s: np.ndarray
    acceleration: np.ndarray
    travel: np.ndarray
    turn: np.ndarray


class MotionSignal(NamedTuple):
    """The plan at t = 0, Ts, 2 Ts, ... to its end: position (T, 3) in mm, speed (T,) in mm/s (0 if E moves
    alone), the move (T,) and the share (T,) of it that is done."""

    time_s: np.ndarray
    position: np.ndarray
    speed: np.ndarray
    move: np.ndarray
    share: np.ndarray


def plan(
    moves: Moves,
    *,
    acceleration: float,
    junction_deviation_mm: float,
    speed_limit: float,
    unset_feed: float,
    tool_change_s: float,
    printing_acceleration: float = np.inf,
) -> Motion:
    """Returns the fastest motion within the limits: each move's feed, speed_limit in mm/s, acceleration in
    mm/s^2 (the program's own if that is lower), and at corners

        v^2 <= a delta s / (1 - s),   v^2 <= a l s / (2 c),   s = sin(theta / 2), c = cos(theta / 2)

    with theta the angle between the legs (pi straight on), delta the junction deviation (Jeon, "Improving
    grbl: cornering algorithm", 2011) and l the shorter leg (Klipper's bound for curves in short legs). Arcs
    keep v^2 <= a r. Dwells, tool changes (tool_change_s) and E alone begin and end at rest; unset_feed (mm/s)
    is for moves before the first F. If a printing_acceleration in mm/s^2 is given, printing moves speed up
    and slow down no faster than that. They then begin and end at rest next to moves that do not print. Raises
    ValueError for limits that are not positive.
    """
    limits = {"acceleration": acceleration, "speed_limit": speed_limit, "unset_feed": unset_feed}
    limits |= {"printing_acceleration": printing_acceleration}
    for name, limit in limits.items():
        if not limit > 0:
            raise ValueError(f"motion: expected {name} > 0, found {limit:g}; set it to the machine's own")
    runs = moves.length > 0
    a = np.fmin(moves.acceleration, acceleration)
    alone = ~runs & np.isin(moves.kind, (Kind.RETRACT, Kind.UNRETRACT, Kind.PRIME))
    travel = np.where(runs, moves.length, np.where(alone, np.abs(moves.e), 0.0))
    feed = np.minimum(np.where(np.isfinite(moves.feed), moves.feed, unset_feed), speed_limit)
    top = np.minimum(feed**2, a * np.nan_to_num(_radius(moves), nan=np.inf))
    turn = _turns(moves, runs)
    cap = np.minimum(
        _corner(turn, moves.length, a, junction_deviation_mm), np.minimum(top, np.append(0.0, top[:-1]))
    )
    prints = runs & (moves.kind == Kind.EXTRUDE)
    rests = ~np.isfinite(turn)
    if np.isfinite(printing_acceleration):
        # the corner speeds are the gantry's own; only the acceleration along the path is limited
        a = np.where(prints, np.minimum(a, printing_acceleration), a)
        rests |= np.append(False, prints[1:] != prints[:-1])
    entry, leave = _look_ahead(np.where(rests, 0.0, cap), 2 * a * travel)
    cruise = np.maximum(np.minimum(top, (entry + leave) / 2 + a * travel), np.maximum(entry, leave))
    entry, leave, cruise = np.sqrt(entry), np.sqrt(leave), np.sqrt(cruise)
    ramp = np.stack([cruise - entry, cruise - leave]) / a
    flat = travel - (ramp[0] * (entry + cruise) + ramp[1] * (leave + cruise)) / 2
    moving = np.where(
        travel > 0, ramp.sum(axis=0) + np.maximum(flat, 0.0) / np.where(travel > 0, cruise, 1.0), 0.0
    )
    ramp = np.where(travel > 0, ramp, 0.0)
    duration = moving + moves.dwell_s + np.where(moves.kind == Kind.TOOL, tool_change_s, 0.0)
    begin = np.append(0.0, np.cumsum(duration))[:-1]
    return Motion(begin, duration, entry, np.where(travel > 0, cruise, 0.0), leave, ramp, a, travel, turn)


def _radius(moves: Moves) -> np.ndarray:
    """Returns the mean radius (N,) of the arcs, NaN for lines."""
    return (
        np.linalg.norm(moves.start[:, :2] - moves.centre, axis=1)
        + np.linalg.norm(moves.end[:, :2] - moves.centre, axis=1)
    ) / 2


def _turns(moves: Moves, runs: np.ndarray) -> np.ndarray:
    """Returns the angle (N,) between the direction in which the previous move ends and the one in which this
    move begins, NaN if either has no travel."""
    step = moves.end - moves.start
    turn = np.full(len(step), np.nan)
    pair = np.flatnonzero(runs[1:] & runs[:-1])

    def direction(at, place):
        d = step[at]
        arc = np.flatnonzero(moves.angle[at])
        if len(arc):
            spoke = place[at[arc], :2] - moves.centre[at[arc]]
            d[arc, :2] = np.column_stack([-spoke[:, 1], spoke[:, 0]]) * moves.angle[at[arc], None]
        return d / np.linalg.norm(d, axis=1)[:, None]

    before, after = direction(pair, moves.end), direction(pair + 1, moves.start)
    # 2 atan2(|a - b|, |a + b|) is exact near 0 and pi, where arccos loses half the digits (Kahan)
    turn[pair + 1] = 2 * np.arctan2(
        np.linalg.norm(after - before, axis=1), np.linalg.norm(after + before, axis=1)
    )
    return turn


def _corner(turn: np.ndarray, length: np.ndarray, a: np.ndarray, deviation: float) -> np.ndarray:
    """Returns v^2 (N,) with which each move may begin: theta = pi - turn."""
    s, c = np.maximum(np.cos(turn / 2), 0.0), np.sin(turn / 2)
    lower = np.minimum(a, np.append(a[:1], a[:-1]))
    leg = np.minimum(length, np.append(length[:1], length[:-1]))
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = np.stack(
            [deviation * s / (2 * np.sin(turn / 4) ** 2), leg * s / (2 * c)]
        )  # 1 - s without cancellation
    return lower * np.where(c > 1e-9, bounds, np.inf).min(axis=0)


def _look_ahead(cap: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns v^2 (N,) at the begin and at the end of each move: min over all places k of cap_k + |sum of the
    gains 2 a l from here to there|, with rest after the last.

    That is the backward pass and the forward pass of a planner in closed form, each as a running minimum.
    """
    cap, way = np.append(cap, 0.0), np.append(0.0, np.cumsum(gain))
    v = np.minimum.accumulate((cap + way)[::-1])[::-1] - way
    v = np.minimum.accumulate(v - way) + way
    v = np.clip(v, 0.0, cap)  # rounding of the sums; a stop stays a stop
    return v[:-1], v[1:]


def sampled(motion: Motion, moves: Moves, *, sample_time_s: float, rates_only: bool = False) -> MotionSignal:
    """Returns the plan at t = 0, Ts, 2 Ts, ..., the last at most one Ts before its end. With `rates_only`
    only the columns that `rate` needs are filled, move and share. Raises ValueError for more than MOST
    samples."""
    end = motion.begin_s + motion.duration_s
    if len(end) and end[-1] > MOST * sample_time_s:
        slow = motion.duration_s.argmax()
        raise ValueError(
            f"motion: expected at most {MOST * sample_time_s / 3600:.0f} h, found {end[-1] / 3600:.3g} h, "
            f"of which line {moves.line[slow]} takes "
            f"{motion.duration_s[slow]:.3g} s; check its F or its dwell"
        )
    count = int(np.ceil(end[-1] / sample_time_s)) if len(end) else 0
    upto = np.minimum(np.ceil(end / sample_time_s).astype(int), count)
    move = np.repeat(np.arange(len(end), dtype=np.int32), np.diff(upto, prepend=0))
    kept = 0 if rates_only else count
    position, speed, share = np.empty((kept, 3)), np.empty(kept), np.empty(count)
    for at in range(0, count, BLOCK):  # the columns between are many: a block of them at a time
        some = slice(at, min(at + BLOCK, count))
        time_s = np.arange(some.start, some.stop) * sample_time_s
        places, speeds, share[some] = _at(motion, moves, move[some], time_s)
        if not rates_only:
            position[some], speed[some] = places, speeds
    time_s = np.arange(kept) * sample_time_s
    return MotionSignal(time_s, position, speed, move, share)


def _at(
    motion: Motion, moves: Moves, move: np.ndarray, time_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns position (T, 3), speed (T,) and done share (T,) of each move (T,) at time_s (T,)."""
    since = time_s - motion.begin_s[move]
    left = motion.duration_s[move] - since
    up, down, cruise, a = (
        motion.ramp_s[0, move],
        motion.ramp_s[1, move],
        motion.cruise[move],
        motion.acceleration[move],
    )
    early, late = np.maximum(up - since, 0.0), np.maximum(down - left, 0.0)
    speed = np.clip(cruise - a * (early + late), 0.0, None)
    # the way that the ramps take off cruise t, counted from the nearer end, so that rounding never leaves the
    # move
    done = cruise * since - a * (up**2 - early**2 + late**2) / 2
    still = cruise * left - a * (down**2 - late**2 + early**2) / 2
    travel = motion.travel[move]
    done = np.where(since < left, done, travel - still)
    share = np.clip(np.divide(done, travel, out=np.zeros(len(move)), where=travel > 0), 0.0, 1.0)
    begin = moves.start[move]
    position = begin + share[:, None] * (moves.end[move] - begin)
    arc = np.flatnonzero(moves.angle[move])
    if len(arc):
        position[arc, :2] = _on_arc(moves, move[arc], share[arc])
    return position, np.where(moves.length[move] > 0, speed, 0.0), share


def _on_arc(moves: Moves, move: np.ndarray, share: np.ndarray) -> np.ndarray:
    centre = moves.centre[move]
    spoke, last = moves.start[move, :2] - centre, moves.end[move, :2] - centre
    radius = (1 - share) * np.linalg.norm(spoke, axis=1) + share * np.linalg.norm(last, axis=1)
    heading = np.arctan2(spoke[:, 1], spoke[:, 0]) + share * moves.angle[move]
    return centre + radius[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])


def rate(signal: MotionSignal, amount: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """Returns the mean rate (T,) from each instant to the next of an amount (N,) that each move spends evenly
    along its way (E, volume, printed length). The sum is exact.

    An amount of a move without travel is spent at its end.
    """
    spent = np.append(0.0, np.cumsum(amount))
    total = spent[signal.move] + amount[signal.move] * signal.share
    return np.diff(total, append=spent[-1]) / sample_time_s
