"""What the candidates of a search trade: error against effort, and their front."""

from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import PictureColumn
from pipeline.verdict.digits import THIN, count, short
from pipeline.verdict.evidence import Table, known
from pipeline.verdict.verdict import Missing


class Search(NamedTuple):
    """Rows (effort, error) of the candidates that worked and of their front, and the named ones."""

    points: np.ndarray
    edge: np.ndarray
    marks: dict[str, tuple[float, float]]


def search(rows: Table, trade: Any) -> Search:
    """What one search tried; `trade` names default weights and optimum, as far as they are known."""
    worked = np.isfinite(rows["tracking_degC"]) & np.isfinite(rows["effort_percent"])
    points = np.column_stack([rows["effort_percent"][worked], rows["tracking_degC"][worked]])
    return Search(points, points[_best(points)], _marks(points, rows["chosen"][worked], trade))


def searched(tried: Search, head: str, small: str) -> PictureColumn:
    """A search as a picture; in its place that nothing worked."""
    if not len(tried.points):
        gap = Missing("not measured", "no candidate of the search worked")
        return PictureColumn(head, small, "", [page.hole(gap)])
    return PictureColumn(head, small, "", [_searched(*tried, head)])


def _marks(points: np.ndarray, chosen: np.ndarray, trade: Any) -> dict[str, tuple[float, float]]:
    """(effort, error) of the chosen candidate, the default weights and
    the optimum, as far as they are known."""
    named = known(trade, {}).items()
    at = {name: (place["effort_percent"], place["tracking_degC"]) for name, place in named if place}
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


def _around(values: np.ndarray) -> charts.Axis:
    room = 0.06 * (float(values.max() - values.min()) or 1.0)
    return charts.linear(float(values.min()) - room, float(values.max()) + room, ticks=3)


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
