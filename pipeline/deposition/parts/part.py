"""A part program composed: volumes by E, the gantry's plan, as quick as it can or slower if the drive could
not press the flow of quicker ramps, the commands of all tools, and whether it will print."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pipeline.deposition import reachable
from pipeline.deposition.drive import UNLIMITED
from pipeline.deposition.extruder import Extruder
from pipeline.deposition.parts import basis, composition, conformance, extrusion
from pipeline.deposition.parts.composition import MARGIN_S, Composed, LearnedLibrary, PartSettings
from pipeline.deposition.parts.conformance import Conformance
from pipeline.deposition.parts.extrusion import Extruded
from pipeline.deposition.reachable import LOSS
from pipeline.deposition.toolpath import gcode, motion
from pipeline.deposition.toolpath.gcode import Kind, Moves, PartProgram
from pipeline.deposition.toolpath.motion import Motion

# a part's ramps grow by this factor until the drive follows, from a first one of so many seconds
LONGER, FIRST_S = 1.2, 0.1
# judged on as much of each tool's printing, so that a long job costs no more than a short one
JUDGED_S = 300.0
# ramps longer than this are no ramps of a printed line
LONGEST_RAMP_S = 10.0
# a plan longer than this is a slip of F or of a dwell
LONGEST_H = 72


class ComposedPart(NamedTuple):
    """A part program read, planned, composed, and whether it will print."""

    name: str
    program: PartProgram
    planned: Motion
    composed: Composed
    conformance: Conformance
    extruded: Extruded
    bead_area_mm2: float


def parse(data: bytes, *, extruder: str = "") -> PartProgram:
    """The part program. Raises ValueError if nothing of it prints because what would was refused."""
    program = gcode.parse(data, extruder=extruder)
    if not np.any(program.moves.kind == gcode.Kind.EXTRUDE) and program.refusals:
        first = program.refusals[0]
        raise ValueError(
            f"line {first.line}: {first.why}; it was left out, "
            "and nothing of the program that could be read prints"
        )
    return program


def compose(
    name: str,
    program: PartProgram,
    extruded: Extruded,
    learned: LearnedLibrary,
    settings: PartSettings,
    gantry: Mapping[str, float],
    *,
    longest_ramp_s: float | None,
    materials: dict[int, str],
    shortest_s: float,
    largest_error_percent: float,
) -> ComposedPart:
    """A part program, composed; `materials` are the tools' names. Raises ValueError naming the line if there
    is one."""
    area, moves = settings.bead_area_mm2, program.moves
    planned, _ = plan_part(moves, gantry, settings, learned, materials, longest_ramp_s)
    check_duration(moves, planned)
    # a printed line is as long as the declared bead would be of the volume that E asks for
    beads = extrusion.as_lengths(program, extruded, bead_area_mm2=area)
    composed = composition.compose(learned, beads, planned, settings, materials=materials)
    report = conformance.conform(
        composed, learned, bead_area_mm2=area, ramp_s=settings.ramp_s, drive=settings.drive,
        shortest_s=shortest_s, largest_error_percent=largest_error_percent,
        least_mm3=area * settings.nozzle_mm,
    )  # fmt: skip
    # the lines' own lengths, not those of their beads
    report = report._replace(lines=report.lines._replace(length_mm=moves.length[composed.lines.move]))
    if not all(one.enough for one in report.saturation.values()):
        _, ramp_s = plan_part(moves, gantry, settings, learned, materials, LONGEST_RAMP_S)
        report = report._replace(ramp_that_would_do_s=ramp_s)
    return ComposedPart(name, program, planned, composed, report, extruded, area)


def check_duration(moves: Moves, planned: Motion) -> None:
    """Raises ValueError, naming the line, for a plan longer than any print: an F or a dwell slipped."""
    hours = float(planned.duration_s.sum()) / 3600
    if not hours <= LONGEST_H:
        slow = int(planned.duration_s.argmax())
        raise ValueError(
            f"expected a print of at most {LONGEST_H} h, found {hours:.3g} h, of which line "
            f"{moves.line[slow]} takes {planned.duration_s[slow] / 3600:.3g} h; check its F or its dwell, "
            "or cut the program"
        )


def slowed_to(plan: Motion, moves: Moves) -> float | None:
    """mm/s^2 at which the printed moves change speed where that is less than the program's and the travel's
    own; None if none is slowed down."""
    own = np.fmin(moves.acceleration, plan.acceleration.max(initial=0.0))
    slowed = _prints(moves) & (plan.acceleration < own)
    return float(plan.acceleration[slowed].max()) if slowed.any() else None


def plan_part(
    moves: Moves,
    gantry: Mapping[str, float],
    settings: PartSettings,
    learned: LearnedLibrary,
    materials: dict[int, str],
    longest_s: float | None,
) -> tuple[Motion, float]:
    """The gantry's plan of a part: its printed moves as quick as the machine goes, or slower until the drive
    follows the flow of each material as identified, with ramps of at most longest_s. And the time in s, to a
    fifth, of the shortest ramps that the drive follows: inf if none up to longest_s does. `gantry` are
    keywords of `motion.plan`, `materials` the tools' names. Raises ValueError for a plan longer than any
    print."""
    quick = motion.plan(moves, **gantry)
    check_duration(moves, quick)
    if longest_s is None or settings.drive == UNLIMITED:
        return quick, 0.0
    extruders = _extruders(moves, settings.nozzle_mm, learned, materials)
    if not extruders:
        return quick, 0.0
    speed, Ts = _printing_speed(moves, gantry), learned.library.sample_time_s
    begins = [quick.begin_s[np.argmax(_prints(moves) & (moves.tool == tool))] for tool in extruders]
    excerpt = Moves(*(column[: np.searchsorted(quick.begin_s, max(begins) + JUDGED_S)] for column in moves))
    ramp_s = reachable.ramp_of_all(
        list(extruders.values()), settings.drive, steady_flow=settings.bead_area_mm2 * speed,
        ramp_s=settings.ramp_s, longest_s=longest_s, sample_time_s=Ts,
    )  # fmt: skip
    # short lines and corners ask for more than the single line that the ramp is chosen on
    while True:
        acceleration = speed / ramp_s if ramp_s else math.inf
        slow = {**gantry, "printing_acceleration": acceleration}
        lost = _lost(motion.plan(excerpt, **slow), excerpt, settings, extruders, Ts)
        if lost <= LOSS or ramp_s >= longest_s:
            return motion.plan(moves, **slow), ramp_s if lost <= LOSS else math.inf
        ramp_s = min(max(LONGER * ramp_s, FIRST_S), longest_s)


def _extruders(
    moves: Moves, nozzle_mm: float, learned: LearnedLibrary, materials: dict[int, str]
) -> dict[int, Extruder]:
    """Gain, time constant and yield, as identified, of the material of each tool that prints and has one."""
    chains = {one.material: one.chain.extruder for one in learned.materials if one.nozzle_mm == nozzle_mm}
    tools = np.unique(moves.tool[_prints(moves)]).tolist()
    identified = {tool: chains.get(materials.get(tool, "")) for tool in tools}
    return {
        tool: Extruder(e.gain, e.time_constant_s, yield_=e.yield_)
        for tool, e in identified.items()
        if e is not None
    }


def _prints(moves: Moves) -> np.ndarray:
    return (moves.kind == Kind.EXTRUDE) & (moves.length > 0)


def _printing_speed(moves: Moves, gantry: Mapping[str, float]) -> float:
    """The highest speed in mm/s of a printed move, within the gantry's limit."""
    feeds = np.where(np.isfinite(moves.feed), moves.feed, gantry["unset_feed"])[_prints(moves)]
    return min(float(feeds.max(initial=0.0)), gantry["speed_limit"])


def _lost(
    plan: Motion, moves: Moves, settings: PartSettings, extruders: dict[int, Extruder], Ts: float
) -> float:
    """The most that the drive takes of a tool's flow (`reachable.lost`) in the first JUDGED_S of its
    printing."""
    signal, shares = motion.sampled(plan, moves, sample_time_s=Ts, rates_only=True), []
    for tool, extruder in extruders.items():
        printed = np.where((moves.kind == Kind.EXTRUDE) & (moves.tool == tool), moves.length, 0.0)
        r = settings.bead_area_mm2 * motion.rate(signal, printed, sample_time_s=Ts)
        begin = int(np.argmax(r > 0))
        excerpt = np.pad(r[begin : begin + round(JUDGED_S / Ts)], round(MARGIN_S / Ts))
        r = basis.boxed(excerpt, settings.ramp_s, Ts)
        r[r < 1e-9 * r.max()] = 0.0
        shares.append(reachable.lost(extruder, r, settings.drive, Ts))
    return max(shares)
