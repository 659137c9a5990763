"""Plunger commands -> G-code with leads, for a machine that cannot play a signal: the plunger's place is
written along the gantry's way, so that the plunger is primed before each line begins and released before it
ends."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from pipeline.deposition import drive
from pipeline.deposition.toolpath.gcode import Kind, Moves
from pipeline.deposition.toolpath.motion import Motion, sampled

# how near the plunger follows its command, as share of the largest one
LEAD_SHARE = 0.005
# how near the gantry is to its planned place at any time, mm: a sixteenth of a nozzle
WAY_MM = 0.05
# a place that goes on is followed as near as by what LEAD_SHARE of the largest speed makes of this time
PLACE_S = 0.1
ROWS = 1 << 15


class Legs(NamedTuple):
    """K legs in their order: the tool in use, the gantry's place at the end (K, 3) in mm, the plunger's place
    there in mm, the duration of the leg in s, and whether it is a change to its tool, which takes the
    machine's own time. `lost_mm`: the largest command of a tool while another one is in use."""

    tool: np.ndarray
    position: np.ndarray
    u: np.ndarray
    duration_s: np.ndarray
    change: np.ndarray
    lost_mm: float


def legs(
    moves: Moves,
    motion: Motion,
    commands: Mapping[int, np.ndarray],
    *,
    lead_in_s: float,
    sample_time_s: float,
    tolerance_mm: float,
    speeds: bool = False,
) -> Legs:
    """Returns legs that follow the commands u (T,) of each tool, linear between samples, within tolerance_mm.
    If the commands are speeds in mm/s, the legs follow the place that all tools have gone together. The
    gantry's path is exact except for arcs, which get a leg per sample. The gantry is within WAY_MM of its
    planned place at any time, so a long ramp becomes several legs of rising feed. The gantry starts lead_in_s
    after the first sample."""
    Ts, n = sample_time_s, max(len(u) for u in commands.values())
    changes = np.flatnonzero(moves.kind == Kind.TOOL)
    begins, ends = lead_in_s + motion.begin_s, lead_in_s + motion.begin_s + motion.duration_s
    bounds = np.concatenate([[0.0], begins[changes], [max(n * Ts, ends[-1])]])
    first = next((int(t) for t, k in zip(moves.tool, moves.kind, strict=True) if k == Kind.EXTRUDE), 0)
    tools = [int(moves.tool[changes[0] - 1]) if len(changes) and changes[0] else first]
    tools += moves.tool[changes].tolist()
    u, lost = np.zeros(n), 0.0
    at = np.searchsorted(bounds, np.arange(n) * Ts, side="right") - 1
    for tool, command in commands.items():
        mine = np.isin(at, [k for k, each in enumerate(tools) if each == tool])
        u[mine[: len(command)].nonzero()[0]] = command[mine[: len(command)]]
        lost = max(lost, float(np.abs(command[~mine[: len(command)]]).max(initial=0.0)))
    if speeds:
        u = drive.place(u, sample_time_s=Ts)
    signal = sampled(motion, moves, sample_time_s=Ts)
    ahead = round(lead_in_s / Ts)
    curved = np.flatnonzero(moves.angle[signal.move] != 0) + ahead
    nodes = np.unique(np.concatenate([bends(u, tolerance_mm), bends(_way(signal.position, ahead, n), WAY_MM),
                                      curved[curved < n]]))  # fmt: skip
    time_s = np.unique(np.concatenate([nodes * Ts, ends, begins, bounds]))
    time_s = time_s[np.append(True, np.diff(time_s) > 1e-9)]
    place = _places(moves, time_s, begins, ends, signal, ahead, Ts)
    value = np.interp(time_s, np.arange(n) * Ts, u)
    tool = np.array(tools)[np.searchsorted(bounds, time_s[:-1] + 1e-9, side="right") - 1]
    in_change = np.searchsorted(begins[changes], time_s[:-1] + 1e-9, side="right") - 1
    change = (in_change >= 0) & (time_s[:-1] + 1e-9 < np.append(ends[changes], -np.inf)[in_change])
    return Legs(tool, place[1:], value[1:], np.diff(time_s), change, lost)


def _way(position: np.ndarray, ahead: int, n: int) -> np.ndarray:
    """Returns the way (n,) in mm that the gantry has gone along its places (P, 3), at the samples of the
    commands."""
    gone = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1)))
    return gone[np.clip(np.arange(n) - ahead, 0, len(gone) - 1)]


def _places(moves: Moves, time_s, begins, ends, signal, ahead: int, Ts: float) -> np.ndarray:
    """Returns the gantry's place (K, 3) at times that are samples of its signal or ends of its moves."""
    k = np.clip(np.rint(time_s / Ts).astype(int) - ahead, 0, len(signal.time_s) - 1)
    place = signal.position[k]
    done = np.searchsorted(ends, time_s + 1e-9, side="right") - 1  # the last move that is over
    at_end = (done >= 0) & (np.abs(ends[done] - time_s) < 1e-9) | (done == len(ends) - 1)
    place[at_end] = moves.end[done[at_end]]
    place[time_s <= begins[0] + 1e-9] = moves.start[0]
    return place


def bends(u: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns the indices (K,) of samples, with the first and the last, between which straight lines are
    within `tolerance` of u (T,). Each line is as long as the cone of slopes from its start allows."""
    kept, start, last, low, high = [0], 0, 0, -np.inf, np.inf
    flat = np.flatnonzero(np.append(True, np.abs(np.diff(u)) > 0))  # runs of equal values have two ends
    inner = np.union1d(flat, np.append(np.maximum(flat - 1, 0), len(u) - 1))
    for k, value in zip(_each(inner), _each(u[inner]), strict=True):
        if k == 0:
            continue
        slope = (value - u[start]) / (k - start)
        if not low <= slope <= high:
            kept.append(last)
            start, low, high = last, -np.inf, np.inf
            slope = (value - u[start]) / (k - start)
        wide = tolerance / (k - start)
        low, high, last = max(low, slope - wide), min(high, slope + wide), k
    return np.unique(np.append(kept, len(u) - 1))


def lines(
    moves: Moves,
    motion: Motion,
    commands: Mapping[int, np.ndarray],
    *,
    letter: str,
    lead_in_s: float,
    sample_time_s: float,
    speeds: bool = False,
) -> Iterator[str]:
    """Yields the part, line by line, as G-code. E, or another letter, is the plunger's place, or the pushed
    amount if the commands are speeds, so that the plunger primes before each line and releases before its
    end. What no program can hold is noted in its head. Parameters as in `legs`."""
    largest = max(float(np.abs(u).max()) for u in commands.values())
    found = legs(
        moves, motion, commands, lead_in_s=lead_in_s, sample_time_s=sample_time_s,
        tolerance_mm=LEAD_SHARE * largest * (PLACE_S if speeds else 1.0), speeds=speeds,
    )  # fmt: skip
    what, unit = ("what is pushed, in mm", "mm/s") if speeds else ("the plunger's place in mm", "mm")
    head = [
        f"; {letter} is {what} (absolute){'' if speeds else ', no filament'}; it moves ahead of the lines.",
        "; Feeds are means over short legs, ramps too: a firmware that accelerates slower comes late.",
    ]
    if found.lost_mm > LEAD_SHARE * largest:
        head.append(
            f"; Left out: {found.lost_mm:.3g} {unit} of a tool's command while another tool was in use."
        )
    yield from head
    yield from program(found, letter=letter, goes_on=speeds)


def program(found: Legs, *, letter: str = "E", goes_on: bool = False) -> Iterator[str]:
    """Yields the legs as lines of G-code in mm, absolute: G1 with the plunger's place after `letter` and the
    feed for which the leg lasts as planned; G4 if nothing moves. If `goes_on`, a tool begins at the place
    where the previous tool ended."""
    held, wait, tool = [0.0] * 4, 0.0, None
    yield from ("G21", "G90", "M82")
    for each, position, u, seconds, change in zip(*map(_each, found[:5]), strict=True):
        if each != tool:
            held[3] = held[3] if goes_on else 0.0
            yield from (*_waited(wait), f"T{each}", f"G92 {letter}{held[3]:.9g}")
            tool, wait = each, 0.0
        if change:
            continue
        to = [*(round(x, 3) for x in position), round(u, 5)]
        step = [b - a for a, b in zip(held, to, strict=True)]
        if not any(step):
            wait += seconds
            continue
        # with X, Y or Z the feed is that of the path, without them that of the plunger
        way = math.hypot(*step[:3]) or abs(step[3])
        words = [f"{c}{x:.9g}" for c, x, d in zip(("X", "Y", "Z", letter), to, step, strict=True) if d]
        yield from (*_waited(wait), f"G1 {' '.join(words)} F{60 * way / seconds:.6g}")
        held, wait = to, 0.0
    yield from _waited(wait)


def _each(column: np.ndarray) -> Iterator[Any]:
    """Yields its rows as Python's numbers, made a part at a time, because they take eight times the
    memory."""
    for at in range(0, len(column), ROWS):
        yield from column[at : at + ROWS].tolist()


def _waited(seconds: float) -> list[str]:
    return [f"G4 P{1000 * seconds:.1f}"] if seconds > 5e-5 else []
