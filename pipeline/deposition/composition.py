"""Part program -> plunger command without learning again: the paper's priority rule, superposition, and basis
functions; the one that predicts best is taken."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.deposition import basis
from pipeline.deposition.chain import Chain, averaged, forecast, identify, simulate
from pipeline.deposition.gcode import Kind, Program
from pipeline.deposition.library import (
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
from pipeline.deposition.motion import Motion, rate, sampled
from pipeline.deposition.tasks import Lines, Tasks, halting, printed_lines, refuse, sequence

COMPOSERS = PRIORITY, SUPERPOSITION, BASIS = "priority", "superposition", "basis"
# rest before the first line and after the last: longer than any lead
MARGIN_S = 2.0
# a long job is judged by its first minutes of each material
EXCERPT_S = 600.0


class Material(NamedTuple):
    """What was learned of one material and nozzle: its chain, the gain (mm^3/s per mm) by
    which on-off control set out in the first trial, and the error of the learned trials
    themselves in % of the steady flow (means over 0.2 s)."""

    material: str
    nozzle_mm: float
    chain: Chain
    on_off_gain: float
    learned_percent: float


class Learned(NamedTuple):
    """The library of all materials, what the composers know of each, and the assumptions in figures."""

    library: Library
    materials: tuple[Material, ...]
    checks: list[Check]


class Prediction(NamedTuple):
    """Predicted r.m.s. error of one composer on one tool's share of a part: the chain's
    forecast together with the composer's own error on trials it did not see, in % of the
    forecast of on-off control; `chosen` is the least."""

    tool: int
    material: str
    composer: str
    rms_percent_of_on_off: float
    chosen: bool


class Stream(NamedTuple):
    """One tool's share of a part, all (T,): wanted flow r (mm^3/s), the same before its steps were shaped,
    command u (mm), predicted flow y and that of on-off control; the composer that u is from, and the share of
    the time that u is at the limit."""

    tool: int
    material: str
    nozzle_mm: float
    composer: str
    r: np.ndarray
    unshaped: np.ndarray
    u: np.ndarray
    y: np.ndarray
    on_off: np.ndarray
    saturated: float


class Composed(NamedTuple):
    """A part: its streams on one clock (sample k at k Ts; the gantry sets out lead_in_s later, which the
    times of lines and tasks contain), and how each composer would do. error_percent (N,) is the predicted
    error of the library's signal for each task, 0 for what was trained."""

    streams: tuple[Stream, ...]
    tasks: Tasks
    lines: Lines
    error_percent: np.ndarray
    predictions: list[Prediction]
    lead_in_s: float
    sample_time_s: float


def learn(trainings: Sequence[Training], *, sample_time_s: float) -> Learned:
    """Library, chains and checks from all learned trials: what segment_library stores.

    Of each material and nozzle at least one routine; two speeds and two pauses make it hold for others.
    """
    library, materials = build(trainings, sample_time_s=sample_time_s), []
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
        materials.append(
            Material(
                *key,
                identify(mine, sample_time_s=sample_time_s),
                gain,
                100 * math.sqrt(np.mean(np.square(left))),
            )
        )
    return Learned(library, tuple(materials), check(trainings, library))


def _of(tasks: Tasks, tool: int, name: str) -> np.ndarray:
    return np.flatnonzero((tasks.task == name) & (tasks.tool == tool))


def _steady(
    library: Library, material: str, nozzle_mm: float, lines: Lines, tool: int, samples: int
) -> np.ndarray:
    """Steady-State (T,) from each printed line's begin to the next
    one's in its run, at the level of its speed."""
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
    """For each column of a finite task: (signal, samples (E, K) that
    it takes at its E events, factors (E, 1))."""
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
    library: Library, material: str, nozzle_mm: float, tasks: Tasks, lines: Lines, tool: int, *, samples: int
) -> np.ndarray:
    """u (T,) by the paper's hierarchy (fig. 7): at each sample the highest of Stop, Start, Corner,
    Steady-State, No-Flow that is active; each sent ahead by its lead."""
    u = np.append(_steady(library, material, nozzle_mm, lines, tool, samples), 0.0)
    for name in (CORNER, START, STOP):
        for chosen, at, factor in _placed(library, name, material, nozzle_mm, tasks, tool):
            u[np.where((at < 0) | (at > samples), samples, at)] = factor * chosen.signal
    return u[:samples]


def superposition(
    library: Library, material: str, nozzle_mm: float, tasks: Tasks, lines: Lines, tool: int, *, samples: int
) -> np.ndarray:
    """u (T,) as the steady level with every task's deviation from it added, so that tasks which overlap both
    count (the extruder is nearly linear)."""
    u = _steady(library, material, nozzle_mm, lines, tool, samples)
    levels = {still.speed: float(still.signal[0]) for still in of_task(library, STEADY, material, nozzle_mm)}
    for name in (CORNER, START, STOP):
        for chosen, at, factor in _placed(library, name, material, nozzle_mm, tasks, tool):
            added = factor * (chosen.signal - background(chosen, levels[chosen.speed]))
            inside = (at >= 0) & (at < samples)
            u += np.bincount(at[inside], weights=np.broadcast_to(added, at.shape)[inside], minlength=samples)
    return u


def _rms(a: np.ndarray) -> float:
    return math.sqrt(np.mean(np.square(a)))


def _command(
    composer: str,
    learned: Learned,
    known: Material,
    r: np.ndarray,
    tasks: Tasks,
    lines: Lines,
    tool: int,
    limit: float,
) -> np.ndarray:
    if composer == BASIS:
        return basis.compose(
            known.chain.extruder, r, sample_time_s=learned.library.sample_time_s, limit=limit
        )
    by = priority if composer == PRIORITY else superposition
    return np.clip(
        by(learned.library, known.material, known.nozzle_mm, tasks, lines, tool, samples=len(r)),
        -limit,
        limit,
    )


def commands(learned: Learned, composed: Composed, stream: Stream, *, limit: float) -> dict[str, np.ndarray]:
    """The command (T,) of every composer for one stream of a part, to set beside the chosen one."""
    known = next(
        k for k in learned.materials if (k.material, k.nozzle_mm) == (stream.material, stream.nozzle_mm)
    )
    return {
        name: _command(name, learned, known, stream.r, composed.tasks, composed.lines, stream.tool, limit)
        for name in COMPOSERS
    }


def _judge(
    learned: Learned, known: Material, r: np.ndarray, tasks: Tasks, lines: Lines, tool: int, limit: float
) -> dict[str, float]:
    """Predicted error of each composer in % of on-off control's, over the first
    EXCERPT_S from where this tool begins to print."""
    Ts, extruder = learned.library.sample_time_s, known.chain.extruder
    begin = max(0, int(np.argmax(r > 0)) - round(MARGIN_S / Ts))
    upto = min(len(r), begin + round(EXCERPT_S / Ts))
    # the excerpt's own events
    near = (tasks.begin_s < (upto + 1) * Ts) & (tasks.begin_s >= (begin - 1) * Ts)
    few = Tasks(*(np.asarray(column)[near] for column in tasks))
    few = few._replace(begin_s=few.begin_s - begin * Ts)
    near = (lines.begin_s < (upto + 1) * Ts) & (lines.begin_s >= (begin - 1) * Ts)
    row = Lines(*(np.asarray(column)[near] for column in lines))
    row = row._replace(begin_s=row.begin_s - begin * Ts, end_s=row.end_s - begin * Ts)
    wanted = r[begin:upto]
    on_off = _rms(
        forecast(extruder, np.clip(wanted / known.on_off_gain, -limit, limit), sample_time_s=Ts) - wanted
    )
    percent = {}
    for name in COMPOSERS:
        error = _rms(
            forecast(
                extruder, _command(name, learned, known, wanted, few, row, tool, limit), sample_time_s=Ts
            )
            - wanted
        )
        own = known.chain.held_out_percent if name == BASIS else known.learned_percent
        percent[name] = 100 * math.hypot(error, own / 100 * r.max()) / max(on_off, 1e-12)
    return percent


def compose(
    learned: Learned,
    program: Program,
    motion: Motion,
    *,
    materials: dict[int, str],
    nozzle_mm: float,
    bead_area_mm2: float,
    ramp_s: float,
    corner_deg: float,
    longest_pause_s: float,
    limit: float,
) -> Composed:
    """Commands for all tools of a part, each by the composer that is predicted to do best for its material.

    `materials` names the material of each tool; the wanted flow is r = bead area x printing speed, its steps
    shaped by two boxes of ramp_s. |u| <= limit (mm). Raises ValueError for a tool without a material, a
    material or nozzle that was not learned, where nothing is printed, and, with its line number, where the
    program would go from Steady-State to No-Flow without a Stop.
    """
    Ts, marks, moves = learned.library.sample_time_s, learned.library.marks, program.moves
    lines = printed_lines(moves, motion, corner_deg=corner_deg, longest_pause_s=longest_pause_s)
    refuse(
        lines,
        moves,
        halts=halting(program.other_line, program.other_word),
        switch_s=marks[STOP][1] + marks[START][0],
    )
    signal = sampled(motion, moves, sample_time_s=Ts)
    ahead = math.ceil(max(0.0, MARGIN_S - lines.begin_s[0]) / Ts)
    behind = math.ceil(MARGIN_S / Ts)
    lines = lines._replace(begin_s=lines.begin_s + ahead * Ts, end_s=lines.end_s + ahead * Ts)
    samples = ahead + len(signal.time_s) + behind
    tasks = sequence(lines, end_s=samples * Ts)
    error, streams, predictions = np.zeros(len(tasks.task)), [], []
    for tool in np.unique(lines.tool).tolist():
        known = _known(learned, materials, tool, nozzle_mm, lines)
        printed = np.where((moves.kind == Kind.EXTRUDE) & (moves.tool == tool), moves.length, 0.0)
        unshaped = bead_area_mm2 * np.pad(rate(signal, printed, sample_time_s=Ts), (ahead, behind))
        r = basis.boxed(unshaped, ramp_s, Ts)
        r[r < 1e-9 * r.max()] = 0.0  # rounding of the sums behind the rate
        judged = _judge(learned, known, r, tasks, lines, tool, limit)
        best = min(judged, key=judged.__getitem__)
        predictions += [
            Prediction(tool, known.material, name, percent, name == best) for name, percent in judged.items()
        ]
        streams.append(_stream(learned, known, r, unshaped, tasks, lines, tool, limit, best))
        for name in (START, STOP, CORNER, STEADY):
            at = _of(tasks, tool, name)
            error[at] = nearest(
                learned.library, name, known.material, nozzle_mm, tasks.speed[at], tasks.pause_s[at]
            ).error_percent
    return Composed(tuple(streams), tasks, lines, error, predictions, ahead * Ts, Ts)


def _known(
    learned: Learned, materials: dict[int, str], tool: int, nozzle_mm: float, lines: Lines
) -> Material:
    first = lines.line[lines.tool == tool][0]
    if tool not in materials:
        raise ValueError(
            f"line {first}: T{tool} prints but has no material; expected one of tools {sorted(materials)}, "
            "or name its material"
        )
    for known in learned.materials:
        if (known.material, known.nozzle_mm) == (materials[tool], nozzle_mm):
            return known
    held = ", ".join(f"{known.material} with {known.nozzle_mm:g} mm" for known in learned.materials)
    raise ValueError(
        f"line {first}: T{tool} prints {materials[tool]} with a nozzle of {nozzle_mm:g} mm, "
        f"but what was learned is {held}; train it first"
    )


def _stream(
    learned: Learned,
    known: Material,
    r: np.ndarray,
    unshaped: np.ndarray,
    tasks: Tasks,
    lines: Lines,
    tool: int,
    limit: float,
    composer: str,
) -> Stream:
    u = _command(composer, learned, known, r, tasks, lines, tool, limit)
    rows = np.stack([u, np.clip(r / known.on_off_gain, -limit, limit)])
    y, on_off = simulate([known.chain.extruder], rows, sample_time_s=learned.library.sample_time_s)[0]
    return Stream(
        tool,
        known.material,
        known.nozzle_mm,
        composer,
        r,
        unshaped,
        u,
        y,
        on_off,
        float(np.mean(np.abs(u) >= limit)),
    )
