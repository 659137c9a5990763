"""Controllers of setpoints on one yardstick: what they are asked (21 wrong starts, good starts that shall
stay good, cameras that err), on redrawn segments, and the rule by which one of them runs by default.

Figures are of the segments that a classifier happened to record. Redrawn with replacement, as often as runs
have blocks, these segments say how far the figures would move had others been recorded (cluster bootstrap:
Davison and Hinkley 1997, section 3.8): each block of runs sees a redraw of its own.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from pipeline.setpoint.agents.criteria import CLOG_STEP, NO_CONTROL, STEPS
from pipeline.setpoint.agents.score import Outcomes, outcomes
from pipeline.setpoint.agents.trials import START_FLOWS, START_TEMPERATURES, STARTS, good_starts, starts
from pipeline.setpoint.published import BEST_FLOW
from pipeline.setpoint.simulation.recorded import WindowTable, recorded_windows
from pipeline.setpoint.simulation.simulator import (
    EpisodeConditions,
    SetpointController,
    WindowSource,
    paper_windows,
    rollout,
)
from pipeline.statistics import Mean, Share, effective_runs, redrawn_mean, shared_variance, wilson_interval

GOOD_STARTS = np.linspace(92.5, 107.5, STARTS)  # percent: prints that nothing is wrong with
FAULT_STEP, FAULT_LENGTH = 20, 30  # decision from which, and decisions for which a camera is stuck or blind
OTHER_CAMERA = (
    1.12,
    0.8,
)  # scale and exponent: it shows 12 % more at 100 %, and ratios smaller than they are
MOVED_BORDERS = (0.92, 1.08)  # of those learned


class CameraFault(NamedTuple):
    """It shows 100 scale (q / 100)^exponent percent for the flow q, repeats its last window for stuck_for
    decisions from FAULT_STEP on, and shows none for blind_for."""

    scale: float = 1.0
    exponent: float = 1.0
    stuck_for: int = 0
    blind_for: int = 0


class Case(NamedTuple):
    """Conditions (n,), persistence 0 of the paper's windows; the camera. good: from good starts, where harm
    is what counts."""

    conditions: EpisodeConditions
    camera: CameraFault = CameraFault()
    good: bool = False


class DefaultChoice(NamedTuple):
    """The default. worst is the share of its runs (percent) that settle and stay in its worst case; margin
    the points by which that exceeds the worst of the strongest other, with its 95 % interval (NaN where
    nothing else was judged). refused: who may not run, and why."""

    name: str
    worst: float
    case: str
    margin: float
    margin_low: float
    margin_high: float
    refused: dict[str, str]
    sentence: str


# ---- what is asked


def all_cases(runs: int, *, segment_mean_decisions: float) -> dict[str, Case]:
    """Every case by name, 21 runs each: on the paper's simulator and on recorded windows the 21 starts, with
    the actuator at 0.6 of its gain, and clogged to 0.6 or 0.75 at step 60; then good starts on recorded
    windows whose conditions last segment_mean_decisions, with cameras that are right or wrong.
    """
    fresh = starts(runs, accuracy=1.0)
    one = jnp.ones_like(fresh.flow)
    lasting, none = {"persistence": segment_mean_decisions * one}, {"persistence": 0.0 * one}
    sticky = fresh._replace(**lasting)
    weak = {"gain": 0.6 * one}
    clog, half_clog = ({"clog": left * one, "clog_step": CLOG_STEP * one} for left in (0.6, 0.75))
    paper = {accuracy: starts(runs, accuracy=accuracy)._replace(**none) for accuracy in (1.0, 0.9, 0.8, 0.7)}
    asked = {f"accuracy {accuracy:g}": conditions for accuracy, conditions in paper.items()} | {
        "accuracy 0.7, gain 0.6": paper[0.7]._replace(**weak),
        "accuracy 0.7, clog": paper[0.7]._replace(**clog),
        "recorded, fresh": fresh,
        "recorded, sticky": sticky,
        "recorded, fresh, gain 0.6": fresh._replace(**weak),
        "recorded, sticky, gain 0.6": sticky._replace(**weak),
        "recorded, fresh, clog": fresh._replace(**clog),
        "recorded, sticky, clog": sticky._replace(**clog),
        "recorded, sticky, half clog": sticky._replace(**half_clog),
    }
    perfect, in_band = (
        good_starts(flows, runs)._replace(**lasting) for flows in (np.full(STARTS, BEST_FLOW), GOOD_STARTS)
    )
    harm = {
        f"{name}{camera}": Case(conditions, of, good=True)
        for name, conditions in (("perfect", perfect), ("in band", in_band))
        for camera, of in cameras().items()
    }
    return {name: Case(conditions) for name, conditions in asked.items()} | harm


def alike(case: str) -> str:
    """What the windows of a case have in common with those of others: "" the paper's, which share no segment;
    fresh ones; sticky ones. Cases alike tell together how much runs on one redraw share."""
    if case.startswith("accuracy"):
        return ""
    return "fresh" if case.startswith("recorded, fresh") else "sticky"


def counts(case: str) -> bool:
    """Whether a case is of the wrong starts, by which controllers are ranked; the good ones tell harm."""
    return not case.startswith(("perfect", "in band"))


def cameras() -> dict[str, CameraFault]:
    """The camera right, of another make, at fault, and with borders moved, by what a case's name ends in."""
    scale, exponent = OTHER_CAMERA
    low, high = MOVED_BORDERS
    return {
        "": CameraFault(),
        ", another camera": CameraFault(scale, exponent),
        f", stuck {FAULT_LENGTH}": CameraFault(stuck_for=FAULT_LENGTH),
        f", blind {FAULT_LENGTH}": CameraFault(blind_for=FAULT_LENGTH),
        f", borders {100 * low:g} %": CameraFault(1 / low),
        f", borders {100 * high:g} %": CameraFault(1 / high),
    }


def cases(
    recorded: WindowSource, *, runs: int, segment_mean_decisions: float
) -> dict[str, tuple[WindowSource, EpisodeConditions]]:
    """The cases from wrong starts as sources of windows and conditions. recorded: of `recorded_windows`."""
    return {
        name: (shown_by(recorded, case.camera), case.conditions)
        for name, case in all_cases(runs, segment_mean_decisions=segment_mean_decisions).items()
        if not case.good
    }


class DistortedWindows(NamedTuple):
    """recorded windows and how the camera maps the flow that they show."""

    recorded: WindowSource
    scale: jax.Array
    exponent: jax.Array


def shown_by(recorded: WindowSource, camera: CameraFault) -> WindowSource:
    """The windows of this camera: those of the paper where conditions.persistence is 0, else recorded ones at
    the flow that the camera makes of the true one. One program for all of them."""
    return WindowSource(
        _shown, DistortedWindows(recorded, jnp.float32(camera.scale), jnp.float32(camera.exponent))
    )


def _shown(table: DistortedWindows, conditions: EpisodeConditions, flow, segment, u) -> tuple[jax.Array, ...]:
    seen = BEST_FLOW * table.scale * (flow / BEST_FLOW) ** table.exponent
    paper = paper_windows().draw((), conditions, flow, segment, u)
    recorded = table.recorded.draw(table.recorded.table, conditions, seen, segment, u)
    return tuple(jnp.where(conditions.persistence > 0, *pair) for pair in zip(recorded, paper, strict=True))


# ---- runs on redrawn segments


def redrawn(table: WindowTable, redraws: int, rng: np.random.Generator, *, room: int = 0) -> WindowSource:
    """`redraws` tables of as many segments as the table has, drawn from them with replacement: a source whose
    arrays have a leading axis (redraws,), and room for as many windows and segments at least. Tables with the
    same room are one program.

    A bin of the flow that a redraw leaves without a window keeps its own segments: of prints that stand at
    one flow each there may be no other.
    """
    sources = [recorded_windows(redraw(table, rng)) for _ in range(redraws)]
    fixed = ("first_segment", "segments", "flow_edges", "seen")  # one for each bin

    def stacked(name: str) -> jax.Array:
        arrays = [np.asarray(getattr(source.table, name)) for source in sources]
        longest = max(*map(len, arrays), 0 if name in fixed else room)
        # what is filled up is never drawn: counts say where a segment ends, and no flow lies beyond infinity
        whole = np.full(
            (redraws, longest, *arrays[0].shape[1:]), np.inf if name == "log_flow" else 0, arrays[0].dtype
        )
        for row, a in zip(whole, arrays, strict=True):
            row[: len(a)] = a
        return jnp.asarray(whole)

    ranked = sources[0].table
    return sources[0]._replace(table=ranked._replace(**{name: stacked(name) for name in ranked._fields}))


def room(tables: Sequence[WindowTable]) -> int:
    """The most windows that a redraw of any of the tables may have."""
    counts = [np.unique(table.segment, return_counts=True)[1] for table in tables]
    return max(len(of) * int(of.max()) + len(table.segment) for of, table in zip(counts, tables, strict=True))


def redraw(table: WindowTable, rng: np.random.Generator) -> WindowTable:
    """The table of as many segments, drawn from its own with replacement; each is one of its own there."""
    flow_bin = np.asarray(table.flow_bin)
    names, segment = np.unique(table.segment, return_inverse=True)
    segment = segment.ravel()
    order, counts = np.argsort(segment, kind="stable"), np.bincount(segment)
    first = np.cumsum(counts) - counts
    drawn = rng.integers(0, len(names), len(names))
    rows = np.concatenate([order[first[s] : first[s] + counts[s]] for s in drawn])
    kept = np.flatnonzero(~np.isin(flow_bin, flow_bin[rows]))
    which = np.concatenate([np.repeat(np.arange(len(drawn)), counts[drawn]), len(drawn) + segment[kept]])
    rows = np.concatenate([rows, kept])
    columns = {
        name: np.asarray(column)[rows]
        for name, column in table._asdict().items()
        if name not in ("flow_edges", "segment") and np.shape(column)[:1] == flow_bin.shape
    }
    return table._replace(**columns, segment=which)


class Runs(NamedTuple):
    """Flow and temperature, (B, n, STEPS + 1) of n runs on each of B redraws; the start is the first."""

    flow: np.ndarray
    temperature: np.ndarray


def runs(
    controller: SetpointController, parameters: Any, case: Case, recorded: WindowSource, keys: jax.Array
) -> Runs:
    """The case's runs (n,) on each redraw of `recorded` (of `redrawn`), one key each (B,). The same key, the
    same chance for every controller."""
    camera, one = case.camera, jnp.ones_like(case.conditions.flow)
    conditions = case.conditions._replace(
        stuck_from=FAULT_STEP * one,
        stuck_for=camera.stuck_for * one,
        blind_from=FAULT_STEP * one,
        blind_for=camera.blind_for * one,
    )
    found = _asked(controller, parameters, shown_by(recorded, camera), conditions, keys)
    return Runs(*map(np.asarray, found))


def become(of: Runs) -> Outcomes:
    """What becomes of all runs, block by block (B n,)."""
    return outcomes(*(a.reshape(-1, STEPS + 1) for a in of))


def first_of_each(of: Runs) -> Runs:
    """The first run (21, STEPS + 1) from each of the `starts`, on the first redraw."""
    shape = len(START_FLOWS), -1, len(START_TEMPERATURES), STEPS + 1
    return Runs(*(a[0].reshape(shape)[:, 0].reshape(STARTS, STEPS + 1) for a in of))


def ask(
    controller: SetpointController, parameters: Any, case: Case, recorded: WindowSource, keys: jax.Array
) -> Outcomes:
    """What becomes of the case's `runs`."""
    return become(runs(controller, parameters, case, recorded, keys))


def _asked(
    controller: SetpointController, parameters, windows: WindowSource, conditions: EpisodeConditions, keys
):
    shown: DistortedWindows = windows.table

    def one(table, key):
        of = windows._replace(table=shown._replace(recorded=shown.recorded._replace(table=table)))
        trajectory = rollout(controller, parameters, of, conditions, key, steps=STEPS)
        return trajectory.flow, trajectory.temperature

    return jax.vmap(one)(shown.recorded.table, keys)


# ---- the choice


# points within which two contestants are alike, in the worst case and on average over the cases
ALIKE_POINTS = 2.0


class JudgedRuns(NamedTuple):
    """A contestant's runs by case, each (B, n) on B redraws: kept, settled and stayed (from wrong starts);
    harmed, farther than +-25 % from 100 % (from good starts)."""

    kept: Mapping[str, np.ndarray]
    harmed: Mapping[str, np.ndarray]


def harmless(of: JudgedRuns, bars: Mapping[str, float]) -> str:
    """ "" where the contestant leaves +-25 % in at most bars[case] percent of the runs of each case; else
    where it leaves it most beyond its bar."""
    over = {case: 100.0 * float(of.harmed[case].mean()) - bar for case, bar in bars.items()}
    case = max(over, key=lambda name: over[name], default="")
    if not case or over[case] <= 0:
        return ""
    share = 100.0 * float(of.harmed[case].mean())
    return f"leaves +-25 % in {share:.1f} % of the runs ({case}), of at most {bars[case]:g} %"


def worst_case(of: JudgedRuns) -> tuple[float, str]:
    """The least share (0 to 1) of runs that settle and stay, and where; of two alike the first case."""
    case = min(of.kept, key=lambda name: float(of.kept[name].mean()))
    return float(of.kept[case].mean()), case


def lead(of: JudgedRuns, other: JudgedRuns) -> Mean:
    """By how many points the worst case of `of` exceeds the worst of the other, with its 95 % interval, from
    the redraws that both have: same segments, same chance.

    The other's worst case lies no higher than any of its cases, so the lower end is the highest of those
    against each of them: a case that is surely lost counts, also where another may be worse. The intervals
    hold in all these comparisons at once (`_at_once`).
    """
    first, second = worst_case(of)[1], worst_case(other)[1]
    leads = {case: _lead_in(of, first, other, case) for case in other.kept}
    return Mean(leads[second].value, max(one.low for one in leads.values()), leads[second].high)


def _at_once(of: Mean, redraws: int, comparisons: int) -> Mean:
    """The interval of one comparison widened so that those of so many hold at once in 95 % (Bonferroni, with
    Student's t of redraws - 1): the highest of thirteen lower ends lies too high by chance far more often
    than one does."""
    alone, all_of_them = scipy.special.stdtrit(redraws - 1, 1.0 - 0.025 / np.array([1, comparisons]))
    half = float((of.high - of.low) / 2 * all_of_them / alone)
    return Mean(of.value, of.value - half, of.value + half)


def lead_on_average(of: JudgedRuns, other: JudgedRuns) -> Mean:
    """The same of the mean over the cases: a worst case can be one segment's doing, and then hides who is
    better everywhere else. The redraws that both have are the sample. One comparison, so its interval is of
    itself alone."""
    both = min(min(len(blocks) for blocks in one.kept.values()) for one in (of, other))
    leads = [of.kept[c][:both].mean(axis=1) - other.kept[c][:both].mean(axis=1) for c in of.kept]
    return redrawn_mean(100.0 * np.mean(leads, axis=0)[:, None], 1.0)


def surely_better(judged: Mapping[str, JudgedRuns], best: str, name: str) -> bool:
    """Whether `best` is told from another by more than ALIKE_POINTS: in the worst case, or on average. From
    doing nothing by the worst case alone."""
    if lead(judged[best], judged[name]).low > ALIKE_POINTS:
        return True
    return name != NO_CONTROL and lead_on_average(judged[best], judged[name]).low > ALIKE_POINTS


def _lead_in(of: JudgedRuns, case: str, other: JudgedRuns, against: str) -> Mean:
    """The same of one case of each. Cases alike are compared run by run; of others the variances add."""
    both = min(len(of.kept[case]), len(other.kept[against]))
    ours, theirs = (100.0 * blocks[:both].astype(float) for blocks in (of.kept[case], other.kept[against]))
    group = alike(case)
    if group == alike(against):
        alikes = [
            of.kept[c][:both].astype(float) - other.kept[c][:both] for c in of.kept if alike(c) == group
        ]
        told = redrawn_mean(ours - theirs, shared_variance(alikes) if group else 0.0)
        return _at_once(told, both, len(other.kept))
    ends = [
        redrawn_mean(blocks, _shared(judged, alike(name), both))
        for blocks, judged, name in ((ours, of, case), (theirs, other, against))
    ]
    half = float(np.hypot(ends[0].high - ends[0].low, ends[1].high - ends[1].low)) / 2
    value = ends[0].value - ends[1].value
    return _at_once(Mean(value, value - half, value + half), both, len(other.kept))


def _shared(of: JudgedRuns, group: str, redraws: int) -> float:
    """What a contestant's runs on one redraw share in the cases of a group."""
    return shared_variance([of.kept[c][:redraws] for c in of.kept if alike(c) == group]) if group else 0.0


def still_in(judged: Mapping[str, JudgedRuns], bars: Mapping[str, float]) -> list[str]:
    """Who may still become the default: whom the best harmless one is not surely better than, as `choose`
    tells ties, and whose harm is not beyond its bar by the whole of its interval."""
    sound = [name for name, of in judged.items() if not harmless(of, bars)] or list(judged)
    best = max(sound, key=lambda name: worst_case(judged[name])[0])
    return [
        name
        for name, of in judged.items()
        if (name == best or not surely_better(judged, best, name))
        and all(_interval(of, of.harmed, case).low <= bar for case, bar in bars.items())
    ]


def _interval(of: JudgedRuns, figures: Mapping[str, np.ndarray], case: str) -> Share:
    """Of a case, with what its runs share told by all cases alike."""
    group = [
        blocks for side in (of.kept, of.harmed) for name, blocks in side.items() if alike(name) == alike(case)
    ]
    blocks = figures[case]
    shared = shared_variance(group) if alike(case) else 0.0
    return wilson_interval(float(blocks.mean()), effective_runs(len(blocks), blocks.size, shared))


def choose(
    judged: Mapping[str, JudgedRuns], *, simplest_first: Sequence[str], bars: Mapping[str, float]
) -> DefaultChoice:
    """The default: of the contestants that do no harm the simplest that the one with the best worst case is
    not `surely_better` than.

    simplest_first: names in the order of simplicity. bars: percent of runs that may leave +-25 % from good
    starts, by case. Raises ValueError where contestants were not judged on the same cases, where a name has
    no place in the order, and where all do harm.
    """
    _check(judged, simplest_first, bars)
    refused = {name: why for name, of in judged.items() if (why := harmless(of, bars))}
    candidates = [name for name in simplest_first if name in judged and name not in refused]
    if not candidates:
        raise ValueError(
            f"choose: expected a contestant that does no harm, found none of {', '.join(judged)}; "
            f'add "{NO_CONTROL}"'
        )
    best = max(candidates, key=lambda name: worst_case(judged[name])[0])
    ties = [name for name in candidates if name == best or not surely_better(judged, best, name)]
    name = ties[0]
    worst, case = worst_case(judged[name])
    rest = [other for other in candidates if other != name]
    if not rest:
        margin, why = Mean(*3 * (float("nan"),)), "nothing else may run"
    else:
        rival = max(rest, key=lambda other: worst_case(judged[other])[0])
        margin = lead(judged[name], judged[rival])
        why = _reason(name, rival, judged, margin)
    opening = (
        f"{name} is the default: in its worst case ({case}) {100 * worst:.1f} % of the runs settle and stay"
    )
    beside = "".join(f" Not asked: {other} {why}." for other, why in refused.items())
    return DefaultChoice(name, 100 * worst, case, *margin, refused, f"{opening}; {why}.{beside}")


def _reason(name: str, rival: str, judged: Mapping[str, JudgedRuns], margin: Mean) -> str:
    worst, case = worst_case(judged[rival])
    other = f"{rival} {100 * worst:.1f} % in its own ({case})"
    ends = f"95 % interval over all cases at once {margin.low:+.1f} to {margin.high:+.1f} points"
    if margin.low > ALIKE_POINTS:
        return f"that is {margin.value:.1f} points more than of {other}, {ends}"
    if name == NO_CONTROL:
        return f"no controller does better beyond noise, the best is {other}, {ends}"
    near = f"is within noise ({ends})"
    if margin.high < 0:  # how far it is ahead, and that not enough of it is sure
        near = (
            f"is ahead by {-margin.high:.1f} to {-margin.low:.1f} points (95 % interval over all cases at "
            f"once; alike where less than {ALIKE_POINTS:g} are sure)"
        )
    elif margin.low > 0:
        near = f"is behind by no more than {ALIKE_POINTS:g} points for sure ({ends})"
    mean = lead_on_average(judged[name], judged[rival])
    if mean.low > ALIKE_POINTS:
        return (
            f"{other} {near}, but over the cases on average {name} keeps {mean.value:.1f} "
            f"points more ({mean.low:+.1f} to {mean.high:+.1f})"
        )
    return f"{other} {near}, and of two alike the simpler runs"


def _check(
    judged: Mapping[str, JudgedRuns], simplest_first: Sequence[str], bars: Mapping[str, float]
) -> None:
    asked = {frozenset(of.kept) for of in judged.values()}
    if len(asked) != 1 or any(bars.keys() - of.harmed.keys() for of in judged.values()):
        raise ValueError(
            "choose: expected every controller judged on the same cases, found "
            f"{sorted(sorted({*of.kept, *of.harmed}) for of in judged.values())}; judge all on all"
        )
    if lost := [name for name in judged if name not in simplest_first]:
        raise ValueError(
            f"choose: expected every contestant in the order of simplicity, found {', '.join(lost)} without "
            "a place; add it"
        )
