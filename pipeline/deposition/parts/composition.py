"""Composes the plunger command of a part program without learning again, by pressure advance, the paper's
priority rule, superposition, and basis functions. The composer is chosen whose forecast error has the lowest
upper end."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.deposition.drive import CommandKind, Drive, at_limit, follows, obeyed
from pipeline.deposition.parts import basis, forecast, pressure_advance
from pipeline.deposition.parts.chain import Chain, averaged, identify, simulate
from pipeline.deposition.parts.forecast import Covered, ForecastJudgement, Missed
from pipeline.deposition.parts.library import (
    CORNER,
    START,
    STEADY,
    STOP,
    Check,
    Library,
    Training,
    background,
    build,
    check,
    learned,
    nearest,
    of_task,
)
from pipeline.deposition.parts.pressure_advance import LEADS, TunedAdvance
from pipeline.deposition.toolpath.gcode import Kind, Moves, PartProgram
from pipeline.deposition.toolpath.motion import Motion, rate, sampled
from pipeline.deposition.toolpath.tasks import PrintedLines, Tasks, halting, printed_lines, refuse, sequence

# rest before the first line and after the last: longer than any lead
MARGIN_S = 2.0
# a long job is judged by its first minutes of each material
EXCERPT_S = 600.0


class LearnedMaterial(NamedTuple):
    """The results of learning for one material and nozzle. `chain`: its chain; `on_off_gain` (mm^3/s per mm):
    the gain with which on-off control started in the first trial; `learned_percent`: error of the learned
    trials themselves in % of the steady flow (means over 0.2 s); `missed`: the error, on each routine, of the
    fit without it; `covered`: the range of the routines; `advances`: pressure advance as tuned on the chain,
    by composer; `volume_per_mm`: the volume that came out in the learned trials, in mm^3 per mm of what was
    pushed (per mm s of pressure)."""

    material: str
    nozzle_mm: float
    chain: Chain
    on_off_gain: float
    learned_percent: float
    missed: Missed
    covered: Covered
    advances: dict[str, TunedAdvance]
    volume_per_mm: float


class LearnedLibrary(NamedTuple):
    """The library of all materials, the results of learning for each material, and the assumptions in
    figures."""

    library: Library
    materials: tuple[LearnedMaterial, ...]
    checks: list[Check]


class PartSettings(NamedTuple):
    """How a part is printed. `nozzle_mm`; the wanted flow is `bead_area_mm2` x printing speed, its steps
    shaped by two boxes of `ramp_s`; a junction is a Corner from `corner_deg` on; a halt longer than
    `longest_pause_s` ends a run; `drive`; `command`: the quantity that the machine is commanded in."""

    nozzle_mm: float
    bead_area_mm2: float
    ramp_s: float
    corner_deg: float
    longest_pause_s: float
    drive: Drive
    command: CommandKind = "pressure"


class ComposerForecast(NamedTuple):
    """Forecast r.m.s. error of one composer on one tool's share of a part, in % of that of on-off control. 90
    % of the possible outcomes lie between `low` and `high`. `chosen`: whether this is the composer with the
    lowest `high`."""

    tool: int
    material: str
    composer: str
    low: float
    median: float
    high: float
    chosen: bool


class Stream(NamedTuple):
    """One tool's share of a part, all (T,): wanted flow `r` (mm^3/s), and `unshaped`, the same before its
    steps were shaped; command `u` (mm); predicted flow `y` and that of on-off control. `composer` gave u;
    `learned`: what it knows of the material; `saturated`: the share of the time that u is at a limit of the
    drive; `judged`: whether its forecast may be believed."""

    tool: int
    material: str
    learned: LearnedMaterial
    composer: str
    r: np.ndarray
    unshaped: np.ndarray
    u: np.ndarray
    y: np.ndarray
    on_off: np.ndarray
    saturated: float
    judged: ForecastJudgement


class ToolShare(NamedTuple):
    """One tool's share of a part before it is composed: the tool, its material, the wanted flow r (T,) in
    mm^3/s, and the tasks and lines of the whole part."""

    tool: int
    material: LearnedMaterial
    r: np.ndarray
    tasks: Tasks
    lines: PrintedLines


class Composed(NamedTuple):
    """A composed part: its streams with one clock, and the forecast of each composer. Sample k is at k Ts;
    the gantry starts lead_in_s later, and the times of lines and tasks include this. error_percent (N,) is
    the predicted error of the library's signal for each task, 0 for a trained task. The commands are speeds
    in mm/s if the machine is commanded by speed or place."""

    streams: tuple[Stream, ...]
    tasks: Tasks
    lines: PrintedLines
    error_percent: np.ndarray
    predictions: list[ComposerForecast]
    lead_in_s: float
    sample_time_s: float
    command: CommandKind = "pressure"


def learn(trainings: Sequence[Training], *, sample_time_s: float) -> LearnedLibrary:
    """Returns library, chains, pressure advance and checks from all learned trials, as segment_library stores
    them.

    Each material and nozzle needs at least one routine. With two speeds and two pauses it holds for other
    speeds and pauses too.
    """
    library, materials = build(trainings, sample_time_s=sample_time_s), []
    tune = functools.partial(pressure_advance.tune, sample_time_s=sample_time_s)
    for key in sorted({(t.material, t.nozzle_mm) for t in trainings}):
        mine = [t for t in trainings if (t.material, t.nozzle_mm) == key]
        left = []
        for t in mine:
            y = learned(t)[1]
            left.append(averaged(np.nan_to_num(y - t.r), np.isfinite(y), sample_time_s) / t.r.max())
        gain = float(
            np.median(
                np.concatenate(
                    [t.r[t.r >= t.r.max() / 2] / np.maximum(t.u[0][t.r >= t.r.max() / 2], 1e-9) for t in mine]
                )
            )
        )
        chain = identify(mine, sample_time_s=sample_time_s)
        missed = forecast.missed(mine, chain, sample_time_s=sample_time_s)
        wanted = [t.r for t in mine]
        materials.append(
            LearnedMaterial(
                *key,
                chain,
                gain,
                100 * math.sqrt(np.mean(np.square(left))),
                missed,
                forecast.covered(mine, sample_time_s=sample_time_s),
                {name: tune(chain, missed, wanted, lead=lead) for name, lead in LEADS.items()},
                volume_per_mm(mine),
            )
        )
    return LearnedLibrary(library, tuple(materials), check(trainings, library))


def volume_per_mm(trainings: Sequence[Training]) -> float:
    """Returns the volume that came out in all trials but the first, divided by the sum of the commands, in
    mm^3 per mm: the identified flow ratio times the area of what is pushed. Flow that was not observable
    counts as the wanted flow."""
    pairs = [
        (np.where(np.isfinite(y), y, t.r).sum(), u.sum())
        for t in trainings
        for u, y in zip(t.u[1:], t.y[1:], strict=True)
    ]
    out, sent = np.sum(pairs, axis=0)
    return float(out / sent)


def _of(tasks: Tasks, tool: int, name: str) -> np.ndarray:
    return np.flatnonzero((tasks.task == name) & (tasks.tool == tool))


def _steady(
    library: Library, material: str, nozzle_mm: float, lines: PrintedLines, tool: int, samples: int
) -> np.ndarray:
    """Returns Steady-State (T,) from the begin of each printed line to that of the next one in its run, at
    the level of its speed."""
    mine = np.flatnonzero(lines.tool == tool)
    columns, column, factor, _ = nearest(
        library, STEADY, material, nozzle_mm, lines.speed[mine], np.zeros(len(mine))
    )
    level = np.array([still.signal[0] for still in columns])[column] * factor
    until = np.where(lines.last[mine], lines.end_s[mine], np.append(lines.begin_s[1:], lines.end_s[-1])[mine])
    at = np.round(np.concatenate([lines.begin_s[mine], until]) / library.sample_time_s).astype(int)
    step = np.bincount(
        np.minimum(at, samples), weights=np.concatenate([level, -level]), minlength=samples + 1
    )
    return np.cumsum(step)[:samples]


def _placed(library: Library, name: str, material: str, nozzle_mm: float, tasks: Tasks, tool: int):
    """Yields for each library column of a finite task that is used: the column, the samples (E, K) that its
    signal takes at its E events, and factors (E, 1)."""
    mine = _of(tasks, tool, name)
    columns, column, factor, _ = nearest(
        library, name, material, nozzle_mm, tasks.speed[mine], tasks.pause_s[mine]
    )
    event = np.round(tasks.begin_s[mine] / library.sample_time_s).astype(int)
    for k in np.unique(column):
        chosen, taken = columns[k], column == k
        yield (
            chosen,
            (event[taken] - chosen.lead)[:, None] + np.arange(len(chosen.signal)),
            factor[taken][:, None],
        )


def priority(
    library: Library,
    material: str,
    nozzle_mm: float,
    tasks: Tasks,
    lines: PrintedLines,
    tool: int,
    *,
    samples: int,
) -> np.ndarray:
    """Returns u (T,) by the paper's hierarchy (fig. 7): at each sample the highest active task of Stop,
    Start, Corner, Steady-State, No-Flow. Each signal is sent earlier by its lead."""
    u = np.append(_steady(library, material, nozzle_mm, lines, tool, samples), 0.0)
    for name in (CORNER, START, STOP):
        for chosen, at, factor in _placed(library, name, material, nozzle_mm, tasks, tool):
            u[np.where((at < 0) | (at > samples), samples, at)] = factor * chosen.signal
    return u[:samples]


def superposition(
    library: Library,
    material: str,
    nozzle_mm: float,
    tasks: Tasks,
    lines: PrintedLines,
    tool: int,
    *,
    samples: int,
) -> np.ndarray:
    """Returns u (T,): the steady level plus every task's deviation from the command without it
    (`background`). Tasks that overlap both count, because the extruder is nearly linear."""
    u = _steady(library, material, nozzle_mm, lines, tool, samples)
    levels = {still.speed: float(still.signal[0]) for still in of_task(library, STEADY, material, nozzle_mm)}
    for name in (CORNER, START, STOP):
        for chosen, at, factor in _placed(library, name, material, nozzle_mm, tasks, tool):
            added = factor * (chosen.signal - background(chosen, levels[chosen.speed]))
            inside = (at >= 0) & (at < samples)
            u += np.bincount(at[inside], weights=np.broadcast_to(added, at.shape)[inside], minlength=samples)
    return u


def by_basis_functions(library: Library, share: ToolShare, drive: Drive) -> np.ndarray:
    """Returns u (T,) in mm by the basis functions for one tool's share of a part; the drive can follow it."""
    extruder = share.material.chain.extruder
    return basis.compose(extruder, share.r, sample_time_s=library.sample_time_s, drive=drive)


def by_advance(name: str, library: Library, share: ToolShare, drive: Drive) -> np.ndarray:
    """Returns u (T,) in mm by pressure advance with the numbers tuned for the composer `name`, as the drive
    follows it."""
    numbers = share.material.advances[name].tuned
    u = pressure_advance.command(numbers, share.r, sample_time_s=library.sample_time_s)
    return obeyed(u, drive, sample_time_s=library.sample_time_s)


def by_library(
    rule: Callable[..., np.ndarray], library: Library, share: ToolShare, drive: Drive
) -> np.ndarray:
    """Returns u (T,) in mm by a rule on the library, as the drive can follow it."""
    material, Ts = share.material, library.sample_time_s
    u = rule(
        library, material.material, material.nozzle_mm, share.tasks, share.lines, share.tool,
        samples=len(share.r),
    )  # fmt: skip
    if follows(u, drive, sample_time_s=Ts):
        return u
    return basis.reached(material.chain.extruder, u, _sent_ahead(share, Ts), drive, Ts)


def _sent_ahead(share: ToolShare, Ts: float) -> np.ndarray:
    """Returns the wanted flow (T,) at the time when a command for it is sent: earlier by the delay and lag of
    the chain."""
    extruder, t = share.material.chain.extruder, np.arange(len(share.r)) * Ts
    return np.interp(t + extruder.delay_s + basis.mean_lag_s(extruder), t, share.r, right=0.0)


# composers that know nothing of the part beforehand, in the order of every page:
# library, share of a part, drive -> command (T,) in mm
COMPOSERS: dict[str, Callable[[Library, ToolShare, Drive], np.ndarray]] = {
    "pressure_advance": functools.partial(by_advance, "pressure_advance"),
    "pressure_advance_lead": functools.partial(by_advance, "pressure_advance_lead"),
    "priority": functools.partial(by_library, priority),
    "superposition": functools.partial(by_library, superposition),
    "basis": by_basis_functions,
}


def commands(
    learned: LearnedLibrary, composed: Composed, stream: Stream, *, drive: Drive
) -> dict[str, np.ndarray]:
    """Returns the command (T,) of every composer for one stream of a part, for comparison with the chosen
    one."""
    share = ToolShare(stream.tool, stream.learned, stream.r, composed.tasks, composed.lines)
    return {name: compose(learned.library, share, drive) for name, compose in COMPOSERS.items()}


def _judge(library: Library, share: ToolShare, drive: Drive) -> dict[str, tuple[float, float, float]]:
    """Returns the forecast error of each composer (low, median, high) in % of on-off control's, over the
    excerpt of the share (`_excerpt`). All composers are forecast by the same members and residuals."""
    Ts, material = library.sample_time_s, share.material
    excerpt = _excerpt(share, Ts)

    def flows(u):
        return forecast.flows(material.chain, material.missed, u, excerpt.r, sample_time_s=Ts)

    on_off = flows(_on_off(excerpt, drive, Ts))
    return {
        name: forecast.error_percent(
            flows(compose(library, excerpt, drive)), on_off, excerpt.r, material.missed
        )
        for name, compose in COMPOSERS.items()
    }


def _excerpt(share: ToolShare, Ts: float) -> ToolShare:
    """Returns EXCERPT_S of a share with its own tasks and lines. Its clock starts MARGIN_S before the tool
    begins to print."""
    r, tasks, lines = share.r, share.tasks, share.lines
    begin = max(0, int(np.argmax(r > 0)) - round(MARGIN_S / Ts))
    upto = min(len(r), begin + round(EXCERPT_S / Ts))
    near = (tasks.begin_s < (upto + 1) * Ts) & (tasks.begin_s >= (begin - 1) * Ts)
    tasks = Tasks(*(np.asarray(column)[near] for column in tasks))
    tasks = tasks._replace(begin_s=tasks.begin_s - begin * Ts)
    near = (lines.begin_s < (upto + 1) * Ts) & (lines.begin_s >= (begin - 1) * Ts)
    lines = PrintedLines(*(np.asarray(column)[near] for column in lines))
    lines = lines._replace(begin_s=lines.begin_s - begin * Ts, end_s=lines.end_s - begin * Ts)
    return share._replace(r=r[begin:upto], tasks=tasks, lines=lines)


def _on_off(share: ToolShare, drive: Drive, Ts: float) -> np.ndarray:
    """Returns u (T,) in mm of on-off control, as in the first trial: r divided by the gain known then."""
    return obeyed(share.r / share.material.on_off_gain, drive, sample_time_s=Ts)


def compose(
    learned: LearnedLibrary,
    program: PartProgram,
    motion: Motion,
    settings: PartSettings,
    *,
    materials: dict[int, str],
) -> Composed:
    """Returns the commands for all tools of a part. Each tool's command is made by the composer with the best
    forecast for it.

    `materials` names the material of each tool. Raises ValueError if a tool has no material, if a material or
    nozzle was not learned, if nothing is printed, and, with its line number, if the program would go from
    Steady-State to No-Flow without a Stop.
    """
    library, drive, moves = learned.library, settings.drive, program.moves
    Ts, marks = library.sample_time_s, library.marks
    lines = printed_lines(
        moves, motion, corner_deg=settings.corner_deg, longest_pause_s=settings.longest_pause_s
    )
    refuse(
        lines,
        moves,
        halts=halting(program.other_line, program.other_word),
        switch_s=marks[STOP][1] + marks[START][0],
    )
    ahead = math.ceil(max(0.0, MARGIN_S - lines.begin_s[0]) / Ts)
    wanted = _wanted(moves, motion, settings, ahead, Ts)
    lines = lines._replace(begin_s=lines.begin_s + ahead * Ts, end_s=lines.end_s + ahead * Ts)
    samples = len(next(iter(wanted.values())))
    tasks = sequence(lines, end_s=samples * Ts)
    error, streams, predictions = np.zeros(len(tasks.task)), [], []
    for tool, unshaped in wanted.items():
        material = _material(learned, materials, tool, settings.nozzle_mm, lines)
        r = basis.boxed(unshaped, settings.ramp_s, Ts)
        r[r < 1e-9 * r.max()] = 0.0  # rounding of the sums behind the rate
        share = ToolShare(tool, material, r, tasks, lines)
        percents = _judge(library, share, drive)
        best = min(percents, key=lambda name: percents[name][2])
        predictions += [
            ComposerForecast(tool, material.material, name, *percent, name == best)
            for name, percent in percents.items()
        ]
        streams.append(_stream(library, share, unshaped, best, settings))
        for name in (START, STOP, CORNER, STEADY):
            at = _of(tasks, tool, name)
            error[at] = nearest(
                library, name, material.material, settings.nozzle_mm, tasks.speed[at], tasks.pause_s[at]
            )[3]
    return Composed(tuple(streams), tasks, lines, error, predictions, ahead * Ts, Ts, settings.command)


def _wanted(
    moves: Moves, motion: Motion, settings: PartSettings, ahead: int, Ts: float
) -> dict[int, np.ndarray]:
    """Returns the wanted flow (T,) in mm^3/s of each tool that prints, before its steps are shaped. It has
    `ahead` samples of rest before the gantry starts and MARGIN_S after the end."""
    signal = sampled(motion, moves, sample_time_s=Ts, rates_only=True)
    prints, around = (moves.kind == Kind.EXTRUDE) & (moves.length > 0), (ahead, math.ceil(MARGIN_S / Ts))
    return {
        tool: settings.bead_area_mm2
        * np.pad(
            rate(signal, np.where(prints & (moves.tool == tool), moves.length, 0.0), sample_time_s=Ts), around
        )
        for tool in np.unique(moves.tool[prints]).tolist()
    }


def _material(
    learned: LearnedLibrary, materials: dict[int, str], tool: int, nozzle_mm: float, lines: PrintedLines
) -> LearnedMaterial:
    """Returns the results of learning for the tool's material with this nozzle. Raises ValueError if the tool
    has no material, or this material and nozzle were not learned."""
    first = lines.line[lines.tool == tool][0]
    if tool not in materials:
        raise ValueError(
            f"line {first}: T{tool} prints but has no material; expected one of tools {sorted(materials)}, "
            "or name its material"
        )
    for material in learned.materials:
        if (material.material, material.nozzle_mm) == (materials[tool], nozzle_mm):
            return material
    trained = ", ".join(f"{one.material} with {one.nozzle_mm:g} mm" for one in learned.materials)
    raise ValueError(
        f"line {first}: T{tool} prints {materials[tool]} with a nozzle of {nozzle_mm:g} mm, "
        f"but what was learned is {trained}; train it first"
    )


def _stream(
    library: Library, share: ToolShare, unshaped: np.ndarray, composer: str, settings: PartSettings
) -> Stream:
    """Returns the share by one composer: its command, and the flows that the chain predicts for it and for
    on-off control. If the machine conserves volume, the command is scaled: its sum is the share's volume
    divided by the volume per mm of the learned trials."""
    material, drive, Ts = share.material, settings.drive, library.sample_time_s
    u = COMPOSERS[composer](library, share, drive)
    if settings.command != "pressure":
        u = obeyed(u * (share.r.sum() / (material.volume_per_mm * u.sum())), drive, sample_time_s=Ts)
    y, on_off = (
        simulate([material.chain.extruder], command[None], sample_time_s=Ts)[0, 0]
        for command in (u, _on_off(share, drive, Ts))
    )
    return Stream(
        share.tool,
        material.material,
        material,
        composer,
        share.r,
        unshaped,
        u,
        y,
        on_off,
        float(np.mean(at_limit(u, drive, sample_time_s=Ts))),
        forecast.judged(material.missed, material.covered, share.r, sample_time_s=Ts),
    )
