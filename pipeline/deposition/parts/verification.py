"""The shortest print that shows whether the forecast of a part holds: the runs where it is least certain,
with their gaps and pauses, on one straight track."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from pipeline.deposition.drive import Drive, obeyed
from pipeline.deposition.extruder import Extruder
from pipeline.deposition.learning import ilc
from pipeline.deposition.parts import basis
from pipeline.deposition.parts.chain import IdentifiedExtruder
from pipeline.deposition.parts.forecast import BINS, CORNER, NAMES, START, STOP, places
from pipeline.deposition.toolpath.tasks import PrintedLines

# the flow is unsure as a whole over this; of each event the hardest, with the runs that hang together with it
SPREAD_S, WINDOW_S = 0.4, 6.0
# off between two windows, and so much of a line longer than twice as long is left away in its middle
REST_S, PLATEAU_S = 3.0, 3.0
# the track is turned after so many mm, on the next line so far beside it
TRACK_MM, BESIDE_MM = 100.0, 5.0
# a pause shorter than this is none
SHORTEST_S = 0.005
# of what a print lacked so much is learned at once, below so many Hz
SHARE, CUTOFF_HZ, ORDER = 0.5, 2.0, 2
FILAMENT_MM2 = math.pi * 1.75**2 / 4


class PartWindow(NamedTuple):
    """Neighbouring lines (L,) of a part, by their place in Lines, the event that is hardest there, and the
    standard deviation of what may come out, in mm^3/s."""

    lines: np.ndarray
    event: str
    deviation: float


def windows(
    made: np.ndarray, r: np.ndarray, lines: PrintedLines, tool: int, *, sample_time_s: float
) -> tuple[PartWindow, ...]:
    """The hardest Start, Corner and Stop of one tool's share of a part, in the order of the part: where what
    may come out (M, T) for the wanted flow r (T,) differs most. Windows that overlap are one. Raises
    ValueError where the tool prints nothing."""
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
    """The run at time_s, or the one nearest to it, and its neighbours while all fits into WINDOW_S."""
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
    """Windows in their order, those that share a line as one, named by the harder event."""
    out: list[PartWindow] = []
    for window in sorted(found, key=lambda one: int(one.lines[0])):
        if out and window.lines[0] <= out[-1].lines[-1]:
            harder = max(out[-1], window, key=lambda one: one.deviation)
            out[-1] = harder._replace(lines=np.union1d(out[-1].lines, window.lines))
        else:
            out.append(window)
    return tuple(out)


def program(
    name: str, chosen: Sequence[PartWindow], lines: PrintedLines, tool: int, *, bead_area_mm2: float
) -> tuple[str, float]:
    """The part program of the windows, and how long it prints in s: each line as long and as fast as in the
    part (of one longer than two plateaus the ends), each pause and gap as long, along x; the nozzle goes on
    through a gap."""
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
    """The length that a line has in the print: both its ends."""
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
    """The command (T,) in mm after a print of the part with u (T,) whose flow was measured as y (T,), NaN
    where it was not seen: u + SHARE P^-1 Q (r - y) with P the chain's gain, time constant and delays, and Q a
    zero-phase low-pass (Bristow 2006, eq. 3); cut to what the drive can do."""
    lacked = np.where(np.isfinite(y), r - y, 0.0)
    smooth = ilc.zero_phase(lacked, order=ORDER, cutoff_hz=CUTOFF_HZ, sample_time_s=sample_time_s)
    late = extruder.delay_s + basis.mean_lag_s(extruder)
    model = Extruder(extruder.gain, extruder.time_constant_s, late)
    more = ilc.inverse(smooth, model, sample_time_s=sample_time_s)
    return obeyed(u + SHARE * more, drive, sample_time_s=sample_time_s)


def measured_percent(y: np.ndarray, on_off: np.ndarray, r: np.ndarray) -> float:
    """R.m.s. error of a measured flow y (T,), NaN where it was not seen, in % of that of on-off control's
    flow (T,) over the same samples. Raises ValueError where nothing was seen."""
    seen = np.isfinite(y)
    if not seen.any():
        raise ValueError(
            "verification: expected a measured flow but every sample is missing; record it again"
        )
    error, yardstick = np.linalg.norm((y - r)[seen]), np.linalg.norm((on_off - r)[seen])
    return float(100 * error / max(yardstick, 1e-12))
