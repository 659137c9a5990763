"""The figures of the temperature page that show what a controller pays for what it gives: error against effort, and the gap plant by plant."""

from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report import charts, page
from pipeline.report.answers import LABELS, noise
from pipeline.report.digits import THIN, number, percent, short
from pipeline.report.pictures import ORDER, Column, Picture, hole
from pipeline.report.sources import Sources, Table
from pipeline.report.verdict import Missing


class Cloud(NamedTuple):
    """One controller's runs on the nominal plant: r.m.s. effort in % and r.m.s. error in °C, and their medians."""

    effort: np.ndarray
    error: np.ndarray

    @property
    def middle(self) -> tuple[float, float]:
        return float(np.median(self.effort)), float(np.median(self.error))


def _names(table: Table) -> list[str]:
    return [name for name in ORDER if (table["controller"] == name).any()]


def front(points: dict[str, tuple[float, float]]) -> list[str]:
    """Pareto's: those that no other beats in one figure without losing in the other, by the first figure."""
    kept = [
        name
        for name, (a, b) in points.items()
        if not any(c <= a and d <= b and (c, d) != (a, b) for other, (c, d) in points.items() if other != name)
    ]
    return sorted(kept, key=lambda name: points[name])


def tradeoff(sources: Sources) -> Picture:
    """Error against effort of every controller, with the front of those that no other one beats in both."""
    table, title = sources.tables["scorecard"], "What each controller trades: error against effort"
    if isinstance(table, Missing):
        return hole("tradeoff", title, table)
    rows = (table["noise_degC"] == noise(sources)) & (table["plant"] == 0)
    clouds = {}
    for name in _names(table):
        mine = rows & (table["controller"] == name)
        finite = np.isfinite(table["effort_percent"][mine]) & np.isfinite(table["tracking_degC"][mine])
        if finite.any():
            clouds[name] = Cloud(table["effort_percent"][mine][finite], table["tracking_degC"][mine][finite])
    if not clouds:
        return hole("tradeoff", title, Missing("not measured", "no run on the nominal plant has both figures"))
    points = {name: cloud.middle for name, cloud in clouds.items()}
    best = front(points)
    x, y = (_around(np.concatenate([getattr(cloud, key) for cloud in clouds.values()])) for key in ("effort", "error"))
    shown = [Column(*LABELS[name], name, [_traded(name, clouds, points, best, x, y, first=i == 0)]) for i, name in enumerate(clouds)]
    said = ", ".join(f"{LABELS[name][0]} {number(points[name][1], 2)}{THIN}°C at {number(points[name][0], 2)}{THIN}%" for name in best)
    return Picture(
        "tradeoff",
        title,
        f"On the front, by effort: {said}. Less error than these costs more effort, whichever controller is taken.",
        shown,
        "R.m.s. tracking error in °C against r.m.s. effort in per cent, a dot for each run on the nominal plant, as deployed; large: the median. "
        "Pale: the medians of the others; dashed: Pareto’s front of the medians.",
        page.origin(sources.source("scorecard")),
    )


def _around(values: np.ndarray) -> charts.Axis:
    room = 0.06 * (float(values.max() - values.min()) or 1.0)
    return charts.linear(float(values.min()) - room, float(values.max()) + room, ticks=3)


def _traded(name: str, clouds: dict[str, Cloud], points: dict, best: list[str], x: charts.Axis, y: charts.Axis, *, first: bool) -> Markup:
    frame = charts.Frame(x, y, height=140)
    others = np.array([points[other] for other in points if other != name]).reshape(-1, 2)
    ends = np.array([points[other] for other in best])
    css = page.MARKS[name]
    layers = [
        charts.line(frame, ends[:, 0], ends[:, 1], "ref") if len(best) > 1 else Markup(""),
        charts.dots(frame, others[:, 0], others[:, 1], "try pale", 3),
        charts.dots(frame, clouds[name].effort, clouds[name].error, f"dot {css}", 2),
        charts.dots(frame, *points[name], f"dot {css} whole", 4),
    ]
    alt = f"{LABELS[name][0]}: error {number(points[name][1], 2)} °C r.m.s. at an effort of {number(points[name][0], 2)} %, " + (
        "on the front" if name in best else f"beaten in both by {', '.join(LABELS[other][0] for other in _beating(points, name))}"
    )
    return charts.panel(frame, layers, alt=alt, css=css, title="°C" if first else "", units=("%", "°C"))


def _beating(points: dict[str, tuple[float, float]], name: str) -> list[str]:
    a, b = points[name]
    return [other for other, (c, d) in points.items() if other != name and c <= a and d <= b]


def plants(sources: Sources) -> Picture:
    """The gap of every controller on every plant of the spread: the worst run of each, from the easiest plant to the hardest."""
    table, title = sources.tables["scorecard"], "The gap, plant by plant"
    if isinstance(table, Missing):
        return hole("plants", title, table)
    limit, rows = sources.declared.rules.worst_case_gap_percent, table["noise_degC"] == noise(sources)
    worst = {name: _worst(table, rows & (table["controller"] == name)) for name in _names(table)}
    worst = {name: found for name, found in worst.items() if len(found)}
    finite = np.concatenate([found[np.isfinite(found)] for found in worst.values()] or [np.zeros(0)])
    finite = finite[finite > 0]
    if not len(finite):
        return hole("plants", title, Missing("not measured", "the scorecard has no gap at this level of noise"))
    y = charts.logarithmic(min(float(finite.min()), limit), max(float(finite.max()), limit))
    shown, said = [], []
    for i, (name, found) in enumerate(worst.items()):
        of = len(found)
        over = int((~(found <= limit)).sum())
        hardest = f"{percent(float(found[-1]), 3)}" if np.isfinite(found[-1]) else "no bound: a run was lost"
        said.append(f"{LABELS[name][0]} {hardest}")
        frame = charts.Frame(charts.Axis(0.5, of + 0.5, ((1.0, "easiest"), (float(of), "hardest"))), y, height=130)
        at, drawn = np.arange(1.0, of + 1), np.where(np.isfinite(found), found, y.high)
        inside = found <= limit
        layers = [
            charts.tint(frame, y.low, limit),
            charts.level(frame, limit, "lim", f"limit {limit:g}" if i == 0 else ""),
            charts.dots(frame, at[inside], drawn[inside], f"dot {page.MARKS[name]}", 2.6),
            charts.dots(frame, at[~inside], drawn[~inside], "gone", 3),
        ]
        alt = f"{LABELS[name][0]}: worst run of the easiest plant {short(float(found[0]), 2)} %, of the hardest {hardest}; {over} of {of} plants beyond {limit:g} %"
        panel = charts.panel(frame, layers, alt=alt, css=page.MARKS[name], title="%, log" if i == 0 else "", units=("", "%"))
        shown.append(Column(*LABELS[name], name, [panel]))
    return Picture(
        "plants",
        title,
        f"On its hardest plant each costs more than that plant’s optimum by: {', '.join(said)}; the rule allows {limit:g}{THIN}%.",
        shown,
        "Largest gap of all starts, references and seeds on a plant, in per cent, log scale; each controller’s plants from its easiest to its hardest. "
        "Grey: what the rule allows. Vermillion: beyond it.",
        page.origin(sources.source("scorecard")),
    )


def _worst(table: Table, rows: np.ndarray) -> np.ndarray:
    """The largest gap in % on each plant, ascending; a run that was lost is infinite."""
    gap = 100.0 * np.where(np.isnan(table["regret"][rows]), np.inf, table["regret"][rows])
    plant = table["plant"][rows]
    return np.sort([gap[plant == k].max() for k in np.unique(plant)])
