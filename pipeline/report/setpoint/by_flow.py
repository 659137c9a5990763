"""How often the classifier is right, by flow: one chart, one table, the worst bin first."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, placeholder
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import THIN, band, number, quantity
from pipeline.verdict.evidence import Absent, instead, known, lookup, need_figure
from pipeline.verdict.setpoint import CLASS_BORDERS, share_in
from pipeline.verdict.verdict import Figure, Missing

TITLE = "Named rightly, by flow"
# An ideal reader of the width that a rendered bead was drawn with: per cent of 960 new segments of 20 frames,
# flow uniform over 70-150 %, by the lower edge of each bin of 5 %. Each segment carries a width bias of 5 %,
# one draw, and each frame one of 8 % more, which no picture undoes.
WIDTH_BIAS, IDEAL = 5.0, 88.0
IDEAL_BY_BIN = dict(
    zip(
        np.arange(70.0, 150.0, 5.0),
        (100, 99, 92, 65, 68, 89, 86, 62, 67, 87, 96, 99, 100, 100, 100, 100),
        strict=True,
    )
)


class Bin(NamedTuple):
    """A bin of true flow in percent: how often its windows are right, what the ideal reader reaches there
    (NaN where nobody knows), and whether a border of the classes is one of its ends."""

    low: float
    high: float
    windows: int
    right: Figure
    ideal: float
    beside: bool


def bins(metrics: Mapping | Missing) -> list[Bin]:
    """Of train_classifier.json, the bin that is right least often first."""
    found = need_figure(metrics, "by_flow")
    rendered = lookup(metrics, "source") == "simulated"
    rows = [
        Bin(
            row["flow_low"],
            row["flow_high"],
            row["windows"],
            figure,
            IDEAL_BY_BIN.get(row["flow_low"], float("nan")) if rendered else float("nan"),
            any(border in CLASS_BORDERS for border in (row["flow_low"], row["flow_high"])),
        )
        for row in found
        if (figure := share_in(row)) is not None
    ]
    rows.sort(key=lambda row: row.right.value)
    if not rows:
        raise Absent(Missing("not measured", "no bin of flow holds a window"))
    return rows


def place(row: Bin) -> str:
    return f"{row.low:g}–{row.high:g}{THIN}%"


@instead(lambda gap: {"picture": placeholder("by-flow", TITLE, gap), "rows": (), "ideal": False})
def by_flow(sources: Sources) -> dict[str, Any]:
    """The chart, and its bins as a table, the worst first."""
    metrics = sources.metrics["train_classifier"]
    found = bins(metrics)
    ideal = any(row.ideal == row.ideal for row in found)
    rows = [
        {
            "place": place(row),
            "beside": row.beside,
            "right": quantity(row.right.value, "%", 0),
            "band": band(row.right.low, row.right.high, 0),
            "ideal": number(row.ideal, 0) if row.ideal == row.ideal else "not known",
            "windows": f"{row.windows:,}",
        }
        for row in found
    ]
    caption = (
        f"Bars: windows named rightly, by bins of 5{THIN}% of true flow; strokes: their 95{THIN}% intervals, "
        "by segment. Pale: a bin beside a border of the classes. Segments that nothing was learned, "
        "calibrated or chosen on."
    )
    if ideal:
        caption += (
            f" Dashed: an ideal reader of the drawn width, {number(IDEAL, 1)}{THIN}% over all bins: every "
            f"segment carries a width bias of {WIDTH_BIAS:g}{THIN}%, which no picture tells from flow."
        )
    picture = Picture(
        finding(found, known(lookup(metrics, "right_70_150"), None)),
        [PictureColumn("Windows named rightly", "in per cent, by true flow", "", [_chart(found)])],
        caption,
        page.origin(sources.source("train_classifier")),
        "by-flow",
        TITLE,
    )
    return {"picture": picture, "rows": rows, "ideal": ideal}


def finding(rows: Sequence[Bin], every: Any) -> str:
    """The worst bin, the worst away from the borders, and all as if as frequent."""
    text = _worst("Worst bin: ", rows[0])
    away = [row for row in rows if not row.beside]
    if rows[0].beside and away:
        text += " It lies beside a border of the classes. " + _worst("Worst away from the borders: ", away[0])
    if share := share_in(every):
        text += (
            f" Were every flow from 70 to 150{THIN}% as frequent: {quantity(share.value, '%', 1)} "
            f"({band(share.low, share.high, 1)})"
        )
        text += f"; the ideal reader {quantity(IDEAL, '%', 1)}." if rows[0].ideal == rows[0].ideal else "."
    return text


def _worst(head: str, row: Bin) -> str:
    ideal = (
        f"; the ideal reader reaches {quantity(row.ideal, '%', 0)} there" if row.ideal == row.ideal else ""
    )
    return (
        f"{head}{place(row)} of flow, {quantity(row.right.value, '%', 0)} right{_interval(row.right)}, "
        f"{row.windows:,} windows{ideal}."
    )


def _interval(figure: Figure) -> str:
    words = band(figure.low, figure.high, 0)
    return f" ({words})" if words else ""


def _chart(rows: Sequence[Bin]) -> Markup:
    """Bars with intervals, and the ideal reader as steps."""
    rows = sorted(rows)
    x = charts.Axis(rows[0].low, rows[-1].high, tuple((v, f"{v:g}") for v in _ticks(rows)))
    y = charts.Axis(0, 104, tuple((float(v), str(v)) for v in (0, 25, 50, 75, 100)))
    frame = charts.Frame(x, y, 568, 380, 42, 20, 24)
    layers = []
    for row in rows:
        a, b = (float(v) for v in frame.px([row.low, row.high]))
        top, low, high = (float(v) for v in frame.py([row.right.value, row.right.low, row.right.high]))
        base, middle = frame.height - frame.below, (a + b) / 2
        layers.append(
            Markup(
                '<rect class="bin{}" x="{:.1f}" width="{:.1f}" y="{:.1f}" height="{:.1f}"/>'
                '<line class="whisk" x1="{:.1f}" x2="{:.1f}" y1="{:.1f}" y2="{:.1f}"/>'
            ).format(
                " beside" if row.beside else "", a + 1, max(b - a - 2, 1), top, max(base - top, 0),
                middle, middle, high, low,
            )
        )  # fmt: skip
    edges = np.array([edge for row in rows for edge in (row.low, row.high)])
    ideal = np.repeat([row.ideal for row in rows], 2)
    if np.isfinite(ideal).any():
        layers.append(charts.line(frame, edges, ideal, "ref"))
    least = min(rows, key=lambda row: row.right.value)
    alt = (
        f"Windows are named rightly least often between {least.low:g} and {least.high:g} % of flow, "
        f"{number(least.right.value, 0)} %"
    )
    return charts.panel(
        frame, layers, alt=alt, css="dd wide big", title="% of windows, against % of flow", units=("%", "%")
    )


def _ticks(rows: Sequence[Bin]) -> list[float]:
    """Every second edge, so that both borders are among them."""
    edges = [row.low for row in rows] + [rows[-1].high]
    return [edge for edge in edges if edge % 10 == 0]
