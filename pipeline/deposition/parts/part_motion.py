"""How the gantry runs a part: as quick as it can, or slower if the drive could not press the flow of quicker
ramps."""

import math
from collections.abc import Mapping

import numpy as np

from pipeline.deposition import reachable
from pipeline.deposition.drive import UNLIMITED
from pipeline.deposition.extruder import Extruder
from pipeline.deposition.parts import basis
from pipeline.deposition.parts.composition import MARGIN_S, LearnedLibrary, PartSettings
from pipeline.deposition.parts.conformance import LONGEST_RAMP_S
from pipeline.deposition.reachable import LOSS
from pipeline.deposition.toolpath import motion
from pipeline.deposition.toolpath.gcode import Kind, Moves

# a part's ramps grow by this factor until the drive follows, from a first one of so many seconds
LONGER, FIRST_S = 1.2, 0.1
# judged on as much of each tool's printing, so that a long job costs no more than a short one
JUDGED_S = 300.0


# a plan longer than this is a slip of F or of a dwell
LONGEST_H = 72


def plan_part(
    moves: Moves,
    gantry: Mapping[str, float],
    settings: PartSettings,
    learned: LearnedLibrary,
    materials: dict[int, str],
    longest_ramp_s: float | None,
) -> motion.Motion:
    """The gantry's plan of a part: its printed moves as quick as the machine goes, or slower until the drive
    follows the flow of each material as identified, with ramps of at most longest_ramp_s. `gantry` are
    keywords of `motion.plan`, `materials` the tools' names. Raises ValueError for a plan longer than any
    print."""
    if longest_ramp_s is None:
        plan = motion.plan(moves, **gantry)
    else:
        plan = _followed(moves, gantry, settings, learned, materials, longest_ramp_s)[0]
    check_duration(moves, plan)
    return plan


def check_duration(moves: Moves, planned: motion.Motion) -> None:
    """Raises ValueError, naming the line, for a plan longer than any print: an F or a dwell slipped."""
    hours = float(planned.duration_s.sum()) / 3600
    if not hours <= LONGEST_H:
        slow = int(planned.duration_s.argmax())
        raise ValueError(
            f"expected a print of at most {LONGEST_H} h, found {hours:.3g} h, of which line "
            f"{moves.line[slow]} takes {planned.duration_s[slow] / 3600:.3g} h; check its F or its dwell, "
            "or cut the program"
        )


def slowed_to(plan: motion.Motion, moves: Moves) -> float | None:
    """mm/s^2 at which the printed moves change speed where that is less than the program's and the travel's
    own; None where none is slowed down."""
    own = np.fmin(moves.acceleration, plan.acceleration.max(initial=0.0))
    slowed = _prints(moves) & (plan.acceleration < own)
    return float(plan.acceleration[slowed].max()) if slowed.any() else None


def sufficient_ramp(
    moves: Moves,
    gantry: Mapping[str, float],
    settings: PartSettings,
    learned: LearnedLibrary,
    materials: dict[int, str],
) -> float:
    """The time in s, to a fifth, in which the gantry comes to the part's highest printing speed such that the
    drive follows its flow; inf if none up to LONGEST_RAMP_S does."""
    return _followed(moves, gantry, settings, learned, materials, LONGEST_RAMP_S)[1]


def _followed(
    moves: Moves,
    gantry: Mapping[str, float],
    settings: PartSettings,
    learned: LearnedLibrary,
    materials: dict[int, str],
    longest_s: float,
) -> tuple[motion.Motion, float]:
    """The plan with the shortest ramps up to longest_s that the drive follows, and these in s: inf, beside
    the plan with the longest, if it follows none."""
    extruders = _extruders(moves, settings.nozzle_mm, learned, materials)
    speed, Ts = _printing_speed(moves, gantry), learned.library.sample_time_s
    quick = motion.plan(moves, **gantry)
    check_duration(moves, quick)
    if settings.drive == UNLIMITED or not extruders:
        return quick, 0.0
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
    plan: motion.Motion, moves: Moves, settings: PartSettings, extruders: dict[int, Extruder], Ts: float
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
