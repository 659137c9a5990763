"""Will this part print? By line number: the predicted volume of every printed line, runs shorter than the
Stop lead, the cost of the drive's limit, and what was refused."""

import math
from typing import NamedTuple

import numpy as np

from pipeline.deposition import reachable
from pipeline.deposition.controllers import CONTROLLERS
from pipeline.deposition.drive import Drive, at_limit, demand, obeyed
from pipeline.deposition.extruder import Extruder
from pipeline.deposition.parts import basis, forecast
from pipeline.deposition.parts.chain import IdentifiedExtruder
from pipeline.deposition.parts.chain import forecast as predicted_flow
from pipeline.deposition.parts.composition import EXCERPT_S, MARGIN_S, Composed, LearnedLibrary
from pipeline.deposition.parts.library import STOP, Library
from pipeline.deposition.toolpath.gcode_words import LineRefusal

# flow this long before a line begins and after it ends is its own, unless a neighbour is nearer
REACH_S = 1.0


class LineVolumes(NamedTuple):
    """Every printed line, all (L,): number in the program, tool, begin and duration in s, length in mm,
    planned volume (bead area x length), predicted volume and that of on-off control in mm^3, error in % of
    the plan, whether its whole run is shorter than the Stop lead, and the 90 % interval of its error in % of
    the plan."""

    line: np.ndarray
    tool: np.ndarray
    begin_s: np.ndarray
    duration_s: np.ndarray
    length_mm: np.ndarray
    planned_mm3: np.ndarray
    predicted_mm3: np.ndarray
    on_off_mm3: np.ndarray
    error_percent: np.ndarray
    shorter_than_lead: np.ndarray
    low_percent: np.ndarray
    high_percent: np.ndarray


class Saturation(NamedTuple):
    """The effect of a drive on one flow with one ramp. `amplitude_mm`, `speed_mm_per_s`: its limits (inf
    without a limit); `largest_command_mm`, `largest_speed_mm_per_s`: of the unlimited command;
    `peak_over_steady`: peak of that command over the steady one; `share_percent`: share of the printing time
    at a limit; `rms_percent_of_on_off`: r.m.s. error of the composed command within the limits, in % of that
    of on-off control r / on_off_gain; `least_percent`: the same of the nearest flow that the drive can reach;
    `enough`: whether the drive adds at most `reachable.LOSS` of on-off's error to that of the unlimited
    command."""

    ramp_s: float
    amplitude_mm: float
    speed_mm_per_s: float
    largest_command_mm: float
    largest_speed_mm_per_s: float
    peak_over_steady: float
    share_percent: float
    rms_percent_of_on_off: float
    least_percent: float
    enough: bool


class Conformance(NamedTuple):
    """The report on a part: its lines; the worst error in % among the `judged` lines of at least shortest_s;
    for each tool the saturation with the present ramp; and what was refused. If the drive does not follow,
    also the ramp of the gantry in s with which it would (inf if there is none)."""

    lines: LineVolumes
    worst_line_volume_percent: float
    judged: int
    saturation: dict[int, Saturation]
    refused: list[LineRefusal]
    ramp_that_would_do_s: float | None = None


def conform(
    composed: Composed,
    learned: LearnedLibrary,
    *,
    bead_area_mm2: float,
    ramp_s: float,
    drive: Drive,
    shortest_s: float,
    largest_error_percent: float,
    least_mm3: float = 0.0,
) -> Conformance:
    """Returns whether the part will print: line volumes, saturation, and refusals of tasks whose signal the
    library only guesses (predicted error above largest_error_percent, or unknown), if the library's signals
    are used. Lines of less than least_mm3 get no percent, because it means nothing for a dot."""
    lines = line_volumes(composed, learned.library, bead_area_mm2=bead_area_mm2)
    error = np.where(lines.planned_mm3 >= least_mm3, lines.error_percent, np.nan)
    lines = _intervals(lines, composed)._replace(error_percent=error)
    judged = (lines.duration_s >= shortest_s - 1e-9) & np.isfinite(error)
    Ts = composed.sample_time_s
    saturations = {}
    for stream in composed.streams:
        first = int(np.argmax(stream.unshaped > 0))
        some = stream.unshaped[max(0, first - round(MARGIN_S / Ts)) : first + round(EXCERPT_S / Ts)]
        saturations[stream.tool] = saturation(
            stream.learned.chain.extruder, some, on_off_gain=stream.learned.on_off_gain, ramp_s=ramp_s,
            drive=drive, sample_time_s=Ts,
        )  # fmt: skip
    refused = []
    by_library = np.isin(
        composed.tasks.tool,
        [stream.tool for stream in composed.streams if CONTROLLERS[stream.composer].kind == "data-driven"],
    )
    for k in np.flatnonzero(by_library & ~(composed.error_percent <= largest_error_percent)):
        speed, pause = composed.tasks.speed[k], composed.tasks.pause_s[k]
        missing = f"{composed.tasks.task[k]} at {speed:g} mm/s with a pause of {pause:.2f} s"
        refused.append(
            LineRefusal(
                int(composed.tasks.line[k]),
                f"the library lacks {missing}; the nearest signal has a predicted error of "
                f"{composed.error_percent[k]:.0f} %",
            )
        )
    worst = float(np.abs(error[judged]).max()) if judged.any() else math.nan
    return Conformance(lines, worst, int(judged.sum()), saturations, sorted(refused))


def _intervals(lines: LineVolumes, composed: Composed) -> LineVolumes:
    """Returns the lines with the 90 % interval of each one's volume, from the possible flows of the streams'
    forecasts."""
    low, high = lines.low_percent.copy(), lines.high_percent.copy()
    for stream in composed.streams:
        material = stream.learned
        mine, start, stop = reaches(composed, stream.tool)
        planned = lines.planned_mm3[mine]
        made = forecast.each_flow(
            material.chain, material.missed, stream.u, stream.r, sample_time_s=composed.sample_time_s
        )
        ends = forecast.ends(
            100 * (volume_between(y, start, stop, sample_time_s=composed.sample_time_s) / planned - 1)
            for y in made
        )
        moved = np.nan_to_num(material.missed.level_percent)
        low[mine], high[mine] = ends[0] - moved, ends[1] + moved
    return lines._replace(low_percent=low, high_percent=high)


def reaches(composed: Composed, tool: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the lines of a tool, and the times in s from and until which the flow counts for each: to the
    middles of the gaps to its neighbours, at most REACH_S beyond its ends."""
    mine = np.flatnonzero(composed.lines.tool == tool)
    a, b = composed.lines.begin_s[mine], composed.lines.end_s[mine]
    middle = (b[:-1] + a[1:]) / 2
    start = np.maximum(a - composed.lines.early_s[mine] - REACH_S, np.append(-np.inf, middle))
    stop = np.minimum(b + composed.lines.late_s[mine] + REACH_S, np.append(middle, np.inf))
    return mine, start, stop


def line_volumes(composed: Composed, library: Library, *, bead_area_mm2: float) -> LineVolumes:
    """Returns a row for each printed line, in their order. Its volume is the flow between the middles of the
    gaps to its neighbours of the same tool, at most REACH_S beyond its ends."""
    lines, Ts = composed.lines, composed.sample_time_s
    begin = np.bincount(lines.run, weights=np.where(lines.first, lines.begin_s, 0.0))
    run_s = np.bincount(lines.run, weights=np.where(lines.last, lines.end_s, 0.0)) - begin
    predicted, on_off = np.zeros(len(lines.line)), np.zeros(len(lines.line))
    for stream in composed.streams:
        mine, start, stop = reaches(composed, stream.tool)
        predicted[mine] = volume_between(stream.y, start, stop, sample_time_s=Ts)
        on_off[mine] = volume_between(stream.on_off, start, stop, sample_time_s=Ts)
    planned = bead_area_mm2 * lines.length
    error, short = 100 * (predicted / planned - 1), run_s[lines.run] < library.marks[STOP][0]
    return LineVolumes(
        lines.line,
        lines.tool,
        lines.begin_s,
        lines.end_s - lines.begin_s,
        lines.length,
        planned,
        predicted,
        on_off,
        error,
        short,
        np.full(len(error), np.nan),
        np.full(len(error), np.nan),
    )


def volume_between(
    flow: np.ndarray, start: np.ndarray, stop: np.ndarray, *, sample_time_s: float
) -> np.ndarray:
    """Returns the volume (L,) in mm^3 that a flow (T,), linear between its samples, presses out from start
    (L,) to stop (L,), in s; none before the first sample and after the last."""
    t = np.arange(len(flow)) * sample_time_s
    total = np.append(0.0, np.cumsum((flow[1:] + flow[:-1]) / 2)) * sample_time_s
    return np.interp(stop, t, total) - np.interp(start, t, total)


def saturation(
    extruder: Extruder | IdentifiedExtruder,
    unshaped: np.ndarray,
    *,
    on_off_gain: float,
    ramp_s: float,
    drive: Drive,
    sample_time_s: float,
) -> Saturation:
    """Returns the effect of the drive on the wanted flow (T,) with its steps shaped by two boxes of ramp_s,
    as forecast by the chain."""
    r = basis.boxed(unshaped, ramp_s, sample_time_s)
    r[r < 1e-9 * r.max(initial=0.0)] = 0.0  # rounding of the sums behind the rate
    free = basis.compose(extruder, r, sample_time_s=sample_time_s)
    u = basis.compose(extruder, r, sample_time_s=sample_time_s, drive=drive)
    steady = (r.max() + extruder.yield_) / extruder.gain
    command_mm, speed = demand(free, sample_time_s=sample_time_s)
    first = obeyed(r / on_off_gain, drive, sample_time_s=sample_time_s)
    on_off, limited, unlimited = (
        float(np.linalg.norm(predicted_flow(extruder, command, sample_time_s=sample_time_s) - r))
        for command in (first, u, free)
    )
    least = float(
        np.linalg.norm(
            reachable.flow(
                Extruder(extruder.gain, extruder.time_constant_s, yield_=extruder.yield_),
                r,
                drive,
                sample_time_s,
            )
            - r
        )
    )
    share = np.mean(at_limit(u, drive, sample_time_s=sample_time_s)[r > 0])
    on_off = max(on_off, 1e-300)
    return Saturation(
        ramp_s,
        drive.amplitude_mm,
        drive.speed_mm_per_s,
        command_mm,
        speed,
        command_mm / steady,
        100 * float(share),
        100 * limited / on_off,
        100 * least / on_off,
        limited - unlimited <= reachable.LOSS * on_off,
    )
