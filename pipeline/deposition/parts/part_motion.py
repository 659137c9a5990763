"""How the gantry runs a part: as quick as it can, or slower where the drive could not press the flow of
quicker ramps."""

import math

import numpy as np

from pipeline.deposition import reachable
from pipeline.deposition.drive import UNLIMITED
from pipeline.deposition.extruder import Extruder
from pipeline.deposition.parts import basis
from pipeline.deposition.parts.composition import MARGIN_S, Learned
from pipeline.deposition.parts.conformance import LONGEST_RAMP_S
from pipeline.deposition.reachable import LOSS
from pipeline.deposition.toolpath import motion
from pipeline.deposition.toolpath.gcode import Kind, Moves
from pipeline.deposition.workflow import part_programs
from pipeline.deposition.workflow.settings import Printer

# a part's ramps grow by this factor until the drive follows, from a first one of so many seconds
LONGER, FIRST_S = 1.2, 0.1
# judged on as much of each tool's printing, so that a long job costs no more than a short one
JUDGED_S = 300.0


def planned(moves: Moves, printer: Printer, learned: Learned) -> motion.Motion:
    """The gantry's plan of a part: its printed moves as quick as the machine goes, or slower until the drive
    follows the flow of each material as identified, with ramps of at most printer.longest_ramp_s."""
    if printer.longest_ramp_s is None:
        return _plan(moves, printer, math.inf)
    return _followed(moves, printer, learned, printer.longest_ramp_s)[0]


def slowed_to(plan: motion.Motion, moves: Moves) -> float | None:
    """mm/s^2 at which the printed moves change speed where that is less than the program's and the travel's
    own; None where none is slowed down."""
    own = np.fmin(moves.acceleration, plan.acceleration.max(initial=0.0))
    slowed = _prints(moves) & (plan.acceleration < own)
    return float(plan.acceleration[slowed].max()) if slowed.any() else None


def ramp_that_would_do(moves: Moves, printer: Printer, learned: Learned) -> float:
    """The time in s, to a fifth, in which the gantry comes to the part's highest printing speed such that the
    drive follows its flow; inf where none up to LONGEST_RAMP_S does."""
    return _followed(moves, printer, learned, LONGEST_RAMP_S)[1]


def _plan(moves: Moves, printer: Printer, printing_acceleration: float) -> motion.Motion:
    return motion.plan(
        moves,
        acceleration=printer.acceleration_mm_per_s2,
        junction_deviation_mm=printer.junction_deviation_mm,
        speed_limit=printer.gantry_speed_limit_mm_per_s,
        unset_feed=printer.speed_mm_per_s,
        tool_change_s=printer.tool_change_s,
        printing_acceleration=printing_acceleration,
    )


def _followed(
    moves: Moves, printer: Printer, learned: Learned, longest_s: float
) -> tuple[motion.Motion, float]:
    """The plan with the shortest ramps up to longest_s that the drive follows, and these in s: inf, beside
    the plan with the longest, where it follows none."""
    extruders, speed = _extruders(moves, printer, learned), _printing_speed(moves, printer)
    quick = _plan(moves, printer, math.inf)
    part_programs.check_duration(moves, quick)
    if printer.limits == UNLIMITED or not extruders:
        return quick, 0.0
    begins = [quick.begin_s[np.argmax(_prints(moves) & (moves.tool == tool))] for tool in extruders]
    excerpt = Moves(*(column[: np.searchsorted(quick.begin_s, max(begins) + JUDGED_S)] for column in moves))
    ramp_s = printer.slow_s(list(extruders.values()), speed, longest_s)
    # short lines and corners ask for more than the single line that the ramp is chosen on
    while True:
        acceleration = speed / ramp_s if ramp_s else math.inf
        follows = _lost(_plan(excerpt, printer, acceleration), excerpt, printer, extruders) <= LOSS
        if follows or ramp_s >= longest_s:
            return _plan(moves, printer, acceleration), ramp_s if follows else math.inf
        ramp_s = min(max(LONGER * ramp_s, FIRST_S), longest_s)


def _extruders(moves: Moves, printer: Printer, learned: Learned) -> dict[int, Extruder]:
    """Gain, time constant and yield, as identified, of the material of each tool that prints and has one."""
    names = {one.tool: one.name for one in printer.materials}
    chains = {
        one.material: one.chain.extruder for one in learned.materials if one.nozzle_mm == printer.nozzle_mm
    }
    tools = np.unique(moves.tool[_prints(moves)]).tolist()
    of_tool = {tool: chains.get(names.get(tool, "")) for tool in tools}
    return {
        tool: Extruder(e.gain, e.time_constant_s, yield_=e.yield_)
        for tool, e in of_tool.items()
        if e is not None
    }


def _prints(moves: Moves) -> np.ndarray:
    return (moves.kind == Kind.EXTRUDE) & (moves.length > 0)


def _printing_speed(moves: Moves, printer: Printer) -> float:
    """The highest speed in mm/s that a printed move asks for, within the gantry's limit."""
    feeds = np.where(np.isfinite(moves.feed), moves.feed, printer.speed_mm_per_s)[_prints(moves)]
    return min(float(feeds.max(initial=0.0)), printer.gantry_speed_limit_mm_per_s)


def _lost(plan: motion.Motion, moves: Moves, printer: Printer, extruders: dict[int, Extruder]) -> float:
    """The most that the drive takes of a tool's flow (`reachable.lost`) in the first JUDGED_S of its
    printing."""
    Ts, shares = printer.sample_time_s, []
    signal = motion.sampled(plan, moves, sample_time_s=Ts)
    for tool, extruder in extruders.items():
        printed = np.where((moves.kind == Kind.EXTRUDE) & (moves.tool == tool), moves.length, 0.0)
        r = printer.bead_area_mm2 * motion.rate(signal, printed, sample_time_s=Ts)
        begin = int(np.argmax(r > 0))
        excerpt = np.pad(r[begin : begin + round(JUDGED_S / Ts)], round(MARGIN_S / Ts))
        r = basis.boxed(excerpt, printer.ramp_s, Ts)
        r[r < 1e-9 * r.max()] = 0.0
        shares.append(reachable.lost(extruder, r, printer.limits, Ts))
    return max(shares)
