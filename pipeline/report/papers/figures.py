"""The papers' figures drawn again from our data, as figures.toml describes them. Data are expressions of
Jinja, words are its templates. Both know the paper's results, the axes and the functions of derived.py.
"""

import itertools
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.papers import derived
from pipeline.report.shared import charts, page

# of what is printed: figure, panel, x, y
Mark = tuple[str, int, float, float]
FILE = Path(__file__).with_name("figures.toml")
# of a picture, px: as wide as a phone, so that a text keeps its size there
WIDTH, HEIGHT = 360, 200


def axis(low: float, high: float) -> charts.Axis:
    """A linear axis with a little room on either side."""
    room = 0.04 * (high - low) or 1.0
    return charts.linear(low - room, high + room)


KNOWN = {"axis": axis, "linear": charts.linear, "logarithmic": charts.logarithmic, **derived.KNOWN}


def pictures(
    paper: str, results: Mapping[str, Any], tables: Mapping[str, Any], marks: Iterable[Mark] = ()
) -> list[dict[str, Any]]:
    """The figures of a paper: place there, title, caption, panels as SVG, and a table (heads, rows). `tables`
    are those of the run, {name: columns or None}; a figure that needs one is left out without it. `marks` are
    the crosses of what is printed.

    Raises ValueError where a mark has no figure or panel.
    """
    described = tomllib.loads(FILE.read_text(encoding="utf-8"))
    every = [one | row for one in described[paper] for row in one.get("each", [{}])]
    context = {**KNOWN, **results, "tables": tables}
    crosses = defaultdict(list)
    for at, panel, x, y in marks:
        crosses[at, panel].append((x, y))
    places = {(one["at"], i) for one in every for i in range(len(one.get("panels", ())))}
    if lost := sorted(crosses.keys() - places):
        raise ValueError(f"{paper}: expected a figure and panel for each mark, found none for {lost[0]}")
    figures = [one for one in every if "needs" not in one or tables[one["needs"]]]
    return [_figure(one, described["panel"], context, crosses) for one in figures]


def _figure(
    figure: Mapping[str, Any],
    panels: Mapping[str, Any],
    context: dict[str, Any],
    crosses: Mapping[tuple[str, int], list[tuple[float, float]]],
) -> dict[str, Any]:
    context = context | {name: _value(text, context) for name, text in figure.get("where", {}).items()}
    named = [panels[one] if isinstance(one, str) else one for one in figure.get("panels", ())]
    return {
        "at": figure["at"],
        "title": _words(figure["title"], context),
        "caption": _words(figure.get("caption", ""), context),
        "panels": [plot(one, context, crosses[figure["at"], i]) for i, one in enumerate(named)],
        "table": _value(figure["table"], context) if "table" in figure else None,
    }


def _value(expression: str, context: Mapping[str, Any]) -> Any:
    return page.environment().compile_expression(expression, undefined_to_none=False)(**context)


def _words(text: str, context: Mapping[str, Any]) -> str:
    return page.environment().from_string(text).render(context)


def _rows(values: Any) -> list[np.ndarray]:
    """Numbers as one row, rows as they are."""
    values = list(values)
    nested = isinstance(values[0], list | np.ndarray)
    return [np.asarray(row, float) for row in (values if nested else [values])]


def plot(
    panel: Mapping[str, Any], context: Mapping[str, Any], crosses: Sequence[tuple[float, float]] = ()
) -> Markup:
    """One frame. `lines` are [x, y, class, name]. y may hold several rows; `per` divides it. `title` names
    both axes. The rest is optional: axes `across` and `up`, which know the highest value as `high`; `levels`
    with names; centred `texts` (text, x, y); `spans` (begin, end, x of the text, text); `way`, a ring and a
    dot at the ends of the last line. `crosses` (x, y) are what the paper prints."""
    curves = []
    for *data, css, name in panel["lines"]:
        xs, ys = (_rows(_value(text, context)) for text in data)
        pairs = zip(itertools.cycle(xs), ys, strict=False)
        curves += [(x, y / panel.get("per", 1), css, name) for x, y in pairs]
    crosses = [(x, y / panel.get("per", 1)) for x, y in crosses]
    ends = [float(end) for x, *_ in curves for end in (np.min(x), np.max(x))] + [
        x for x, _ in crosses if not np.isnan(x)
    ]
    values = np.concatenate([*(y for _, y, *_ in curves), [y for _, y in crosses]])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    across, up = (
        _value(panel[key], {**context, "high": high}) if key in panel else None for key in ("across", "up")
    )
    frame = charts.Frame(
        across or charts.linear(min(ends), max(ends)),
        up or axis(low, high),
        WIDTH,
        panel.get("height", HEIGHT),
        left=panel.get("left", 52),
        below=22,
        above=24,
        right=panel.get("right", 12 + max(7 * len(name) for *_, name in curves)),
    )
    layers = [charts.level(frame, value, "ax", name) for value, name in panel.get("levels", ())]
    for x, y, css, _ in curves:
        layers.append(charts.stems(frame, x, y) if css == "stem" else charts.line(frame, x, y, css))
    layers += [charts.label(frame, x[-1], y[-1], name, dx=5, dy=4) for x, y, _, name in curves if name]
    for text, x, y in _value(panel.get("texts", "[]"), context):
        layers.append(charts.label(frame, x, y, text, anchor="middle"))
    for begin, end, x, text in _value(panel.get("spans", "[]"), context):
        middle = end > begin
        layers.append(charts.interval(frame, begin, end))
        layers.append(
            charts.label(
                frame, x, low, text, anchor="middle" if middle else "start", dx=0 if middle else 4, dy=-2
            )
        )
    if panel.get("way"):
        x, y, *_ = curves[-1]
        layers += [
            charts.dots(frame, x[0], y[0], "begin", 4),
            charts.dots(frame, x[-1], y[-1], "dot whole", 4),
        ]
    layers += [cross(frame, x, y) for x, y in crosses]
    return charts.panel(frame, layers, alt=_words(panel["alt"], context), title=panel["title"])


def cross(frame: charts.Frame, x: float, y: float) -> Markup:
    """The mark of a value that the paper prints; a line if it does not print where."""
    if np.isnan(x):
        return charts.level(frame, y, "printed")
    across, up = (float(at(value)) for at, value in ((frame.px, x), (frame.py, y)))
    return Markup('<path class="printed" d="M{:.1f} {:.1f}h12m-6-6v12"/>').format(across - 6, up)
