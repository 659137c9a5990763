"""Pieces of which the papers' figures are drawn again: several curves on one frame, and their caption."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts

# of a picture, px: as wide as a phone, so that a text keeps its size there
WIDTH, HEIGHT = 360, 200


class PaperFigure(NamedTuple):
    """A figure of a paper drawn from our data: its place there, what is seen, the panels, how to read them,
    and a table of ours (heads, rows) where the figure is one."""

    at: str
    title: str
    panels: list[Markup]
    caption: str = ""
    table: tuple[list[str], list[list[str]]] | None = None


class PaperCurve(NamedTuple):
    """x, y, class of the line, and its name at the right end."""

    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    css: str = "line"
    name: str = ""


def axis(low: float, high: float, *, ticks: int = 4) -> charts.Axis:
    """A linear axis with a little room on either side."""
    room = 0.04 * (high - low) or 1.0
    return charts.linear(low - room, high + room, ticks=ticks)


def plot(
    curves: Sequence[PaperCurve],
    *,
    title: str,
    alt: str,
    up: charts.Axis | None = None,
    levels: Sequence[tuple[float, str]] = (),
    texts: Sequence[tuple[str, float, float]] = (),
    height: int = HEIGHT,
    left: int = 52,
) -> Markup:
    """Curves on one frame, `title` naming both axes; `levels` are horizontal lines with a name, `texts`
    (text, x, y) stand centred at a place."""
    ends = [float(bound(curve.x)) for curve in curves for bound in (np.min, np.max)]
    values = np.concatenate([np.asarray(curve.y, float) for curve in curves])
    up = up or axis(float(np.nanmin(values)), float(np.nanmax(values)))
    room = 12 + max((7 * len(curve.name) for curve in curves), default=0)
    frame = charts.Frame(
        charts.linear(min(ends), max(ends)), up, WIDTH, height, left=left, below=22, above=24, right=room
    )
    layers = [charts.level(frame, value, "lim", name) for value, name in levels]
    layers += [charts.line(frame, curve.x, curve.y, curve.css) for curve in curves]
    layers += [
        charts.label(frame, curve.x[-1], curve.y[-1], curve.name, dx=5, dy=4)
        for curve in curves
        if curve.name
    ]
    layers += [charts.label(frame, x, y, text, anchor="middle") for text, x, y in texts]
    return charts.panel(frame, layers, alt=alt, title=title)


def plane(
    paths: Sequence[PaperCurve],
    *,
    title: str,
    alt: str,
    across: charts.Axis,
    up: charts.Axis,
    way: PaperCurve | None = None,
) -> Markup:
    """Lines over a plane, and a way over it from a ring to a dot."""
    frame = charts.Frame(across, up, WIDTH, 240, left=52, below=22, above=24, right=14)
    layers = [charts.line(frame, path.x, path.y, path.css) for path in paths]
    if way:
        layers.append(charts.line(frame, way.x, way.y, way.css))
        layers.append(charts.dots(frame, way.x[0], way.y[0], "begin", 4))
        layers.append(charts.dots(frame, way.x[-1], way.y[-1], "dot whole", 4))
    return charts.panel(frame, layers, alt=alt, title=title)
