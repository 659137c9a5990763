"""The case that decides the setpoint loop as a time series: the flow decision by decision, one run from each
start, of the default, of the strongest other and of doing nothing, and how many of them are inside."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.card import PICTURE
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture
from pipeline.report.shared.sources import Sources
from pipeline.setpoint.agents.criteria import FLOW_BAND, SETTLED_BY, TEMPERATURE_BAND
from pipeline.setpoint.controllers import NO_CONTROL as DOES_NOTHING
from pipeline.setpoint.published import BEST_FLOW, BEST_TEMPERATURE
from pipeline.verdict.digits import THIN, count, number
from pipeline.verdict.evidence import Absent, Table, need, or_gap
from pipeline.verdict.setpoint import Board, Case, case_text, role, worst
from pipeline.verdict.verdict import Missing

TITLE = "Flow, decision by decision"
# percent of flow that the picture shows
FLOW = charts.Axis(45, 160, tuple((float(v), str(v)) for v in (50, 75, 100, 125, 150)))
# percentiles of the runs between which the area lies
MIDDLE = (10, 90)
# float32 sums of moves end a hair outside a border that they are on
ROUNDING = 1e-3
# width, height and the room left, below, above and right of a panel, in px
SIZE = (568, 300, 34, 34, 22, 12)


class Trace(NamedTuple):
    """Runs of one controller, (starts, decisions + 1): flow in percent, and whether flow and temperature are
    inside."""

    flow: np.ndarray
    inside: np.ndarray


class Clog(NamedTuple):
    """From which decision on less gets through, and how many percent of it."""

    step: int
    left: float


# the runs by controller, and what happens to them
Traces = tuple[dict[str, Trace], Clog | None]


def trace(table: Table, case: Case, name: str) -> Trace | None:
    """The runs of a controller in a case, as long as the shortest of them; None where none was kept."""
    mine = (table["case"] == case[1]) & (table["simulator"] == case[0]) & (table["controller"] == name)
    if not mine.any():
        return None
    order = np.lexsort((table["step"][mine], table["start"][mine]))
    cuts = np.flatnonzero(np.diff(table["start"][mine][order])) + 1
    runs = {
        column: np.split(table[column][mine][order], cuts) for column in ("flow_percent", "temperature_degC")
    }
    flow, temperature = (np.stack([run[: min(map(len, each))] for run in each]) for each in runs.values())
    inside = np.abs(flow - BEST_FLOW) <= FLOW_BAND + ROUNDING
    inside &= np.abs(temperature - BEST_TEMPERATURE) <= TEMPERATURE_BAND + ROUNDING
    return Trace(flow, inside)


def clog(table: Table, case: Case) -> Clog | None:
    """What happens in a case, as it shows where the print is left alone; None where nothing does."""
    alone = trace(table, case, DOES_NOTHING)
    if alone is None or (alone.flow <= 0).any():
        return None
    left = alone.flow[:, 1:] / alone.flow[:, :-1]
    moved = np.flatnonzero((np.abs(left - 1) > ROUNDING).any(axis=0))
    if len(moved) != 1 or left[:, moved[0]].max() >= 1:
        return None
    return Clog(int(moved[0]) + 1, 100.0 * float(np.median(left[:, moved[0]])))


@or_gap
def traces(table: Table | Missing, case: Case, names: Sequence[str]) -> Traces | Missing:
    """The runs of these controllers in this case, of the first of them at least; why there are none."""
    table = need(table)
    kept = {name: trace(table, case, name) for name in names}
    found = {name: one for name, one in kept.items() if one is not None}
    if names[0] not in found:
        why = "no run of the case that decides was kept"
        return Missing("not measured", why, "Run ./run dvc repro evaluate_setpoint")
    return found, clog(table, case)


def shown(board: Board) -> list[str]:
    """The default, the strongest of the others that may run, and doing nothing."""
    others = [name for name in board.names if name not in (board.default, DOES_NOTHING, *board.refused)]
    return list(dict.fromkeys((board.default, *others[:1], DOES_NOTHING)))


@as_picture("deciding", TITLE)
def picture(sources: Sources, board: Board | Missing) -> Picture:
    """Flow against decisions in the default's worst case, and the share of the runs that are inside."""
    board = need(board)
    _, case = worst(board, board.default, "lasting")
    if case is None:
        raise Absent(Missing("not measured", "no controller was chosen"))
    found = need(traces(sources.tables["paths"], case, shown(board)))
    runs, told = found[0], finding(found)
    flow = _flow(board, found, charts.Frame(_decisions(runs), FLOW, *SIZE), alt=told)
    share = _inside(board, found, sources.declared.rules.settled_percent)
    starts = count(len(runs[board.default].flow), "start")
    return Picture(
        told,
        [
            PictureColumn("Flow", "per cent, against decisions", "", [flow]),
            PictureColumn("Runs inside", "per cent of them, against decisions", "", [share]),
        ],
        key(board, runs)
        + f". One run from each of {starts}, on the first pool of segments. {reading(runs)} Dashed: "
        f"{BEST_FLOW - FLOW_BAND:g}–{BEST_FLOW + FLOW_BAND:g}{THIN}%. Inside: there, and "
        f"{BEST_TEMPERATURE:g}{THIN}±{THIN}{TEMPERATURE_BAND:g}{THIN}°C; level: "
        f"{sources.declared.rules.settled_percent:g}{THIN}% of the runs are to settle. What lies beyond the "
        "axis is not drawn.",
        page.origin(sources.source("paths"), simulator=case[0], case=case[1], controller=list(runs)),
        title=case_text(case, whole=True),
    )


@or_gap
def panel(sources: Sources, board: Board, case: Case, names: Sequence[str]) -> Markup | Missing:
    """The flow of these controllers in a case, as page one draws it; why there is none."""
    found = need(traces(sources.tables["paths"], case, names))
    frame = charts.Frame(_decisions(found[0]), FLOW, *PICTURE, 34, 34, 16, 14)
    return _flow(board, found, frame, alt=finding(found))


def reading(names: Iterable[str]) -> str:
    """How the lines are read."""
    low, high = MIDDLE
    thin = " Thin: each run that is left alone." if DOES_NOTHING in names else ""
    return f"Line: the median run; area: {high - low}{THIN}% of the runs.{thin}"


def finding(found: Traces) -> str:
    """What happens, and how many runs are inside before it, and how many stay."""
    traced, happens = found
    runs = count(len(next(iter(traced.values())).flow), "run")
    stay = {name: int(one.inside[:, SETTLED_BY:].all(axis=1).sum()) for name, one in traced.items()}
    if happens is None:
        listed = "; ".join(f"{name} {stay[name]}" for name in stay)
        return f"Of {runs} inside from decision {SETTLED_BY} to the end: {listed}."
    before = {name: int(one.inside[:, happens.step - 1].sum()) for name, one in traced.items()}
    listed = "; ".join(f"{name} {before[name]} and {stay[name]}" for name in stay)
    return (
        f"At decision {happens.step} a clog leaves {number(happens.left, 0)}{THIN}% of the flow. Of "
        f"{runs} inside just before it, and from decision {SETTLED_BY} to the end: {listed}."
    )


# ---- drawn


def _decisions(runs: Mapping[str, Trace]) -> charts.Axis:
    return charts.linear(0, max(1, *(one.flow.shape[1] - 1 for one in runs.values())), ticks=5)


def key(board: Board, names: Iterable[str]) -> Markup:
    """Which line is whose in these pictures."""
    return page.line_key(page.line_styles({name: role(board, name) for name in names}).items())


def _flow(board: Board, found: Traces, frame: charts.Frame, *, alt: str) -> Markup:
    """Median and middle of the runs of everybody who acts, and each run that is left alone."""
    (runs, happens), layers = found, []
    styles = page.line_styles({name: role(board, name) for name in runs})
    # what is left alone lies behind, the default in front
    for name in reversed(list(runs)):
        flow = runs[name].flow
        if name == DOES_NOTHING:
            every = [np.where((q >= FLOW.low) & (q <= FLOW.high), q, np.nan) for q in np.unique(flow, axis=0)]
            seen = [run for run in every if np.isfinite(run).any()]
            layers += [charts.line(frame, *corners(run), f"{styles[name]} way") for run in seen]
            continue
        step, *ends = corners(*np.percentile(flow, MIDDLE, axis=0))
        layers.append(charts.ribbon(frame, step, *ends, f"ribbon {page.MARKS[role(board, name)]}"))
        layers.append(charts.line(frame, *corners(np.median(flow, axis=0)), styles[name]))
    layers += [charts.level(frame, BEST_FLOW + border, "ref") for border in (-FLOW_BAND, FLOW_BAND)]
    layers += _event(frame, happens)
    return charts.panel(
        frame, layers, alt=alt, css="mb lead-picture", title="flow, %", across="decisions",
        units=("decisions", "%"),
    )  # fmt: skip


def corners(*lines: np.ndarray) -> tuple[np.ndarray, ...]:
    """Decisions and values of these lines (n,) without the inner points of stretches in which none changes:
    the same picture in fewer letters."""
    same = np.all([np.diff(line) == 0 for line in lines], axis=0)
    kept = np.flatnonzero(~np.concatenate([[False], same[:-1] & same[1:], [False]]))
    return kept, *(line[kept] for line in lines)


def _inside(board: Board, found: Traces, limit: float) -> Markup:
    """The share of the runs that are inside, decision by decision."""
    y = charts.Axis(0, 104, tuple((float(v), str(v)) for v in (0, 25, 50, 75, 100)))
    runs, happens = found
    frame = charts.Frame(_decisions(runs), y, *SIZE)
    layers = [charts.level(frame, limit, "lim")]
    styles, ends = page.line_styles({name: role(board, name) for name in runs}), []
    for name in reversed(list(runs)):
        share = 100 * runs[name].inside.mean(axis=0)
        layers.append(charts.line(frame, *corners(share), styles[name], steps=True))
        ends.append(f"{name} {number(float(share[-1]), 0)} %")
    layers += _event(frame, happens)
    return charts.panel(
        frame,
        layers,
        alt=f"Runs inside at the end: {', '.join(ends[::-1])}; {limit:g} % are to settle",
        css="mb lead-picture",
        title="inside, %",
        across="decisions",
        units=("decisions", "%"),
    )


def _event(frame: charts.Frame, happens: Clog | None) -> list[Markup]:
    """A line across the panel where the nozzle clogs."""
    if happens is None:
        return []
    x = float(frame.px(happens.step))
    bar = Markup('<line class="ax" x1="{0:.1f}" x2="{0:.1f}" y1="{1}" y2="{2}"/>')
    text = f"clog to {number(happens.left, 0)}{THIN}%"
    return [
        bar.format(x, frame.above, frame.height - frame.below),
        charts.label(frame, happens.step, frame.y.high, text, dx=4, dy=10),
    ]
