"""The figures of the temperature page that show what a controller pays for what it gives: error against
effort, of controllers and of the tuning's candidates, and the gap plant by plant."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.digits import LARGEST, THIN, count, number, percent, short
from pipeline.report.shared.pictures import Column, Picture, placeholder
from pipeline.report.shared.sources import Sources, Table, lookup
from pipeline.report.shared.verdict import Missing
from pipeline.report.temperature.answers import LABELS, noise


class Cloud(NamedTuple):
    """One controller's runs on the nominal plant: r.m.s. effort in %
    and r.m.s. error in °C, and their medians."""

    effort: np.ndarray
    error: np.ndarray

    @property
    def middle(self) -> tuple[float, float]:
        return float(np.median(self.effort)), float(np.median(self.error))


def front(points: dict[str, tuple[float, float]]) -> list[str]:
    """Pareto's: those that no other beats in one figure without losing in the other, by the first figure."""
    on_front = [
        name
        for name, (a, b) in points.items()
        if not any(
            c <= a and d <= b and (c, d) != (a, b) for other, (c, d) in points.items() if other != name
        )
    ]
    return sorted(on_front, key=lambda name: points[name])


def tradeoff(sources: Sources) -> Picture:
    """Error against effort of every controller, with the front of those that no other one beats in both."""
    table, title = sources.tables["scorecard"], "What each controller trades: error against effort"
    if isinstance(table, Missing):
        return placeholder("tradeoff", title, table)
    clouds = _clouds(table, noise(sources))
    if not clouds:
        return placeholder(
            "tradeoff", title, Missing("not measured", "no run on the nominal plant has both figures")
        )
    points = {name: cloud.middle for name, cloud in clouds.items()}
    best = front(points)
    x, y = (
        _around(np.concatenate([getattr(cloud, key) for cloud in clouds.values()]))
        for key in ("effort", "error")
    )
    shown = [
        Column(*LABELS[name], name, [_traded(name, clouds, points, best, x, y, first=i == 0)])
        for i, name in enumerate(clouds)
    ]
    places = ", ".join(
        f"{LABELS[name][0]} {number(points[name][1], 2)}{THIN}°C at {number(points[name][0], 2)}{THIN}%"
        for name in best
    )
    return Picture(
        "tradeoff",
        title,
        f"On the front, by effort: {places}. Less error than these costs more effort, "
        "whichever controller is taken.",
        shown,
        "R.m.s. tracking error in °C against r.m.s. effort in per cent, "
        "a dot for each run on the nominal plant, as deployed; large: the median. "
        "Pale: the medians of the others; dashed: Pareto’s front of the medians.",
        page.origin(sources.source("scorecard")),
    )


def _clouds(table: Table, level: float) -> dict[str, Cloud]:
    """Of each controller the runs on the nominal plant that have both figures, in the order of the pages."""
    runs = pd.DataFrame(table)
    finite = np.isfinite(runs[["effort_percent", "tracking_degC"]]).all(axis=1)
    by_controller = runs[finite & (runs["noise_degC"] == level) & (runs["plant"] == 0)].groupby("controller")
    clouds = {
        name: Cloud(rows["effort_percent"].to_numpy(), rows["tracking_degC"].to_numpy())
        for name, rows in by_controller
    }
    return {name: clouds[name] for name in LABELS if name in clouds}


def _around(values: np.ndarray) -> charts.Axis:
    room = 0.06 * (float(values.max() - values.min()) or 1.0)
    return charts.linear(float(values.min()) - room, float(values.max()) + room, ticks=3)


def _traded(
    name: str,
    clouds: dict[str, Cloud],
    points: dict,
    best: list[str],
    x: charts.Axis,
    y: charts.Axis,
    *,
    first: bool,
) -> Markup:
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
    alt = (
        f"{LABELS[name][0]}: error {number(points[name][1], 2)} °C r.m.s. "
        f"at an effort of {number(points[name][0], 2)} %, "
        + (
            "on the front"
            if name in best
            else f"beaten in both by {', '.join(LABELS[other][0] for other in _beating(points, name))}"
        )
    )
    return charts.panel(frame, layers, alt=alt, css=css, title="°C" if first else "", units=("%", "°C"))


def _beating(points: dict[str, tuple[float, float]], name: str) -> list[str]:
    a, b = points[name]
    return [other for other, (c, d) in points.items() if other != name and c <= a and d <= b]


# ---- the candidates of the tuning


class Search(NamedTuple):
    """Rows (effort, error) of the candidates that worked and of their front, and the named ones."""

    points: np.ndarray
    edge: np.ndarray
    marks: dict[str, tuple[float, float]]


def candidates(sources: Sources) -> Picture:
    """Error against effort of everything that the search tried, with the front, the
    chosen one, the default weights and the optimum."""
    table, title = sources.tables["tuning"], "What the tuning’s candidates trade"
    if isinstance(table, Missing):
        return placeholder("candidates", title, table)
    rows = {name: values[table["mode"] == "practical"] for name, values in table.items()}
    tried = search(rows, lookup(sources.metrics["tune_weights"], "practical.trade"))
    head, small = "The declared engineering cost", "mean over the training panel, as deployed"
    sentences = [_bought(tried.marks), _beyond(tried.marks, tried.edge)] if len(tried.points) else []
    return Picture(
        "candidates",
        title,
        " ".join(filter(None, sentences)),
        [searched(tried, head, small)],
        "R.m.s. tracking error in °C, up, against r.m.s. effort in per cent, across. Small: "
        "a candidate that worked; line: the front, candidates that no other beats in both; "
        "filled square: chosen; ring: default weights; cross: the optimum, "
        "a Riccati law that is told the plant and its state, unclipped. "
        "The search minimises a cost, not one of "
        "these two alone, so that the chosen one need not lie on the front.",
        page.origin(sources.source("tuning", "tune_weights")),
    )


def search(rows: Table, trade: Any) -> Search:
    """What one search tried; `trade` names default weights and optimum, as far as they are known."""
    worked = np.isfinite(rows["tracking_degC"]) & np.isfinite(rows["effort_percent"])
    points = np.column_stack([rows["effort_percent"][worked], rows["tracking_degC"][worked]])
    return Search(points, points[_best(points)], _marks(points, rows["chosen"][worked], trade))


def searched(tried: Search, head: str, small: str) -> Column:
    """A search as a picture; in its place that nothing worked."""
    if not len(tried.points):
        gap = page.missing(Missing("not measured", "no candidate of the search worked"))
        return Column(head, small, "", [Markup('<div class="hole">{}</div>').format(gap)])
    return Column(head, small, "", [_searched(*tried, head)])


def _marks(points: np.ndarray, chosen: np.ndarray, trade: Any) -> dict[str, tuple[float, float]]:
    """(effort, error) of the chosen candidate, the default weights and
    the optimum, as far as they are known."""
    named = {} if isinstance(trade, Missing) else {name: place for name, place in trade.items() if place}
    at = {name: (place["effort_percent"], place["tracking_degC"]) for name, place in named.items()}
    return (
        {"chosen": (float(points[chosen][0, 0]), float(points[chosen][0, 1]))} if chosen.any() else {}
    ) | at


def _best(points: np.ndarray) -> np.ndarray:
    """Rows of the front, by effort: those that no other beats in one figure without losing in the other."""
    order = np.lexsort((points[:, 1], points[:, 0]))
    least = np.minimum.accumulate(np.append(np.inf, points[order, 1]))[:-1]
    return order[points[order, 1] < least]


def _place(name: str, marks: dict[str, tuple[float, float]]) -> str:
    effort, error = marks[name]
    return f"{short(error, 3)}{THIN}°C at {short(effort, 3)}{THIN}%"


def _bought(marks: dict[str, tuple[float, float]]) -> str:
    if not {"chosen", "default"} <= marks.keys():
        return f"Chosen: {_place('chosen', marks)}." if "chosen" in marks else ""
    words = [
        "less" if mine < theirs else "more"
        for mine, theirs in zip(marks["chosen"], marks["default"], strict=True)
    ]
    return (
        f"The chosen weights have {words[1]} error for {words[0]} effort than the default ones: "
        f"{_place('chosen', marks)} of effort against {_place('default', marks)}."
    )


def _beyond(marks: dict[str, tuple[float, float]], edge: np.ndarray) -> str:
    """How far the chosen one lies above the front at its own effort."""
    if "chosen" not in marks:
        return ""
    effort, error = marks["chosen"]
    least = float(edge[edge[:, 0] <= effort * (1 + 1e-12), 1].min())
    above = 100 * (error / least - 1)
    return (
        "It lies on the front."
        if above < 0.05
        else f"No candidate of its effort has less than {short(least, 3)}{THIN}°C: it lies "
        f"{percent(above, 2)} above the front."
    )


def _searched(
    points: np.ndarray, edge: np.ndarray, marks: dict[str, tuple[float, float]], head: str
) -> Markup:
    every = np.array([*points, *marks.values()])
    # far candidates would press the front against an axis: what lies
    # beyond nine tenths of them is drawn at the edge
    ends = [
        (min(values.min(), named.min()), max(np.quantile(values, 0.9), named.max()))
        for values, named in zip(points.T, np.array([*marks.values(), edge[0], edge[-1]]).T, strict=True)
    ]
    x, y = (_around(np.array(end)) for end in ends)
    frame = charts.Frame(x, y, width=540, height=230, left=44, above=20, right=12)
    inside = (points[:, 0] <= x.high) & (points[:, 1] <= y.high)
    front_line = edge[(edge[:, 0] <= x.high) & (edge[:, 1] <= y.high)]
    layers = [
        charts.dots(frame, points[inside, 0], points[inside, 1], "try", 1.8),
        charts.line(frame, front_line[:, 0], front_line[:, 1], "line", most=1000),
    ]
    if "default" in marks:
        layers.append(charts.dots(frame, *marks["default"], "ring-end", 4.5))
    if "optimum" in marks:
        layers.append(charts.crosses(frame, [marks["optimum"][0]], [marks["optimum"][1]], size=4.5))
    if "chosen" in marks:
        a, b = float(frame.px(marks["chosen"][0])), float(frame.py(marks["chosen"][1]))
        layers.append(
            Markup('<rect class="picked-mark" x="{:.1f}" y="{:.1f}" width="8" height="8"/>').format(
                a - 4, b - 4
            )
        )
    # apart even where all three lie on one another
    corners = {"chosen": ("end", -8, -7), "default": ("start", 8, -7), "optimum": ("end", -8, 15)}
    for name, place in marks.items():
        anchor, dx, dy = corners[name]
        layers.append(charts.label(frame, *place, name, anchor=anchor, dx=dx, dy=dy))
    out = len(every) - len(marks) - int(inside.sum())
    alt = f"{head}: {len(points)} candidates, {len(edge)} on the front; " + "; ".join(
        f"{name} {_place(name, marks)} of effort" for name in marks
    )
    alt += f"; {count(out, 'candidate')} beyond the picture" if out else ""
    return charts.panel(frame, layers, alt=alt, css="mb", title="°C", units=("%", "°C"))


# ---- the plants


def plants(sources: Sources) -> Picture:
    """The gap of every controller on every plant of the spread: the worst run
    of each, from the easiest plant to the hardest."""
    table, title = sources.tables["scorecard"], "The gap, plant by plant"
    if isinstance(table, Missing):
        return placeholder("plants", title, table)
    limit, worst = sources.declared.rules.worst_case_gap_percent, _worst(table, noise(sources))
    finite = np.concatenate([gaps[np.isfinite(gaps)] for gaps in worst.values()] or [np.zeros(0)])
    finite = finite[finite > 0]
    if not len(finite):
        return placeholder(
            "plants", title, Missing("not measured", "the scorecard has no gap at this level of noise")
        )
    # an unstable plant's gap would press all others against the axis: it is drawn at the edge
    y = charts.logarithmic(
        min(float(finite.min()), limit), max(min(float(finite.max()), LARGEST["%"]), limit)
    )
    shown, costs = [], []
    for i, (name, gaps) in enumerate(worst.items()):
        of = len(gaps)
        over = int((~(gaps <= limit)).sum())
        hardest = f"{percent(float(gaps[-1]), 3)}" if np.isfinite(gaps[-1]) else "no bound: a run was lost"
        costs.append(f"{LABELS[name][0]} {hardest}")
        frame = charts.Frame(
            charts.Axis(0.5, of + 0.5, ((1.0, "easiest"), (float(of), "hardest"))), y, height=130
        )
        at, drawn = np.arange(1.0, of + 1), np.minimum(np.where(np.isfinite(gaps), gaps, y.high), y.high)
        inside = gaps <= limit
        layers = [
            charts.tint(frame, y.low, limit),
            charts.level(frame, limit, "lim", f"limit {limit:g}" if i == 0 else ""),
            charts.dots(frame, at[inside], drawn[inside], f"dot {page.MARKS[name]}", 2.6),
            charts.dots(frame, at[~inside], drawn[~inside], "gone", 3),
        ]
        easiest = percent(float(gaps[0]), 2).replace(THIN, " ")
        alt = (
            f"{LABELS[name][0]}: worst run of the easiest plant {easiest}, of the "
            f"hardest {hardest}; {over} of {of} plants beyond {limit:g} %"
        )
        panel = charts.panel(
            frame, layers, alt=alt, css=page.MARKS[name], title="%, log" if i == 0 else "", units=("", "%")
        )
        shown.append(Column(*LABELS[name], name, [panel]))
    return Picture(
        "plants",
        title,
        f"On its hardest plant each costs more than that plant’s optimum by: {', '.join(costs)}; "
        f"the rule allows {limit:g}{THIN}%.",
        shown,
        "Largest gap of all starts, references and seeds on a plant, in per cent, log scale; "
        "each controller’s plants from its easiest to its hardest. "
        "Grey: what the rule allows. Vermillion: beyond it.",
        page.origin(sources.source("scorecard")),
    )


def _worst(table: Table, level: float) -> dict[str, np.ndarray]:
    """Of each controller the largest gap in % on each plant, ascending; a run that was lost is infinite."""
    runs = pd.DataFrame(table)
    runs = runs[runs["noise_degC"] == level]
    gap = 100.0 * runs["regret"].fillna(np.inf)
    worst = gap.groupby([runs["controller"], runs["plant"]]).max()
    judged = set(runs["controller"])
    return {name: np.sort(worst[name].to_numpy()) for name in LABELS if name in judged}
