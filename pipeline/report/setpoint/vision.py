"""What the classifier is worth: calibration, confusion by temperature, what windows say by flow, its
training, frames with key areas, what was held and foreign."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table, placeholder
from pipeline.report.shared.sources import Sources
from pipeline.verdict.digits import number
from pipeline.verdict.evidence import Absent, Table, entry, gap_of, instead, known, lookup, need, need_figure
from pipeline.verdict.setpoint import CLASS_BORDERS, accuracy, share_in
from pipeline.verdict.verdict import Missing

CLASSES = ("under", "good", "over")
NAMES = {"": "Vision transformer", "svc": "Support vector machine", "width": "Width rule"}
DIAGRAMS = (
    ("image", "raw", "One image, as trained", "softmax of the network", "ece_image_raw"),
    ("image", "calibrated", "One image, calibrated", "logits over one temperature", "ece_image"),
    ("window", "hard_counts", "A window, counted", "shares of classes, as published", "ece_window_counts"),
    ("window", "flow", "A window, calibrated", "normal law of the flow seen, fitted", "ece_window"),
)


@as_picture("reliability", "When it says 80 %, is it right in 80 %?")
def reliability(sources: Sources) -> Picture:
    """Share that is right against the confidence that was stated, before and after calibration."""
    table, metrics = need(sources.tables["reliability"]), sources.metrics["train_classifier"]
    errors = [entry(metrics, key) for *_, key in DIAGRAMS]
    columns = []
    for (of, method, head, small, _), error in zip(DIAGRAMS, errors, strict=True):
        mine = (table["of"] == of) & (table["method"] == method) & (table["count"] > 0)
        if mine.any():
            words = "not measured" if error is None else f"off by {number(error, 3)} on average"
            bins = {name: table[name][mine] for name in ("confidence", "accuracy", "count")}
            panel = _diagram(bins, head, of, words, title="" if columns else "share right")
        else:
            gap = Missing("not measured", f"no diagram of {method}")
            panel = page.hole(gap)
        columns.append(PictureColumn(head, small, "", [panel]))
    text = (
        "Some of the calibration errors were not measured."
        if None in errors
        else f"Calibration takes the error of an image from {number(errors[0], 3)} to "
        f"{number(errors[1], 3)}, and of a window from {number(errors[2], 3)} (counting classes, as "
        f"published) to {number(errors[3], 3)}."
    )
    return Picture(
        text,
        columns,
        "Share of answers that are right, against the confidence stated with them; dashed: as "
        "stated. Below the line it is too sure. Larger dots: more of them.",
        page.origin(sources.source("reliability", "train_classifier")),
    )


def _diagram(bins: Table, head: str, of: str, words: str, *, title: str) -> Markup:
    """Accuracy against confidence of the bins, a larger dot for more answers."""
    frame = charts.Frame(
        charts.Axis(0.3, 1.0, ((0.4, "0.4"), (0.6, "0.6"), (0.8, "0.8"), (1.0, "1"))),
        charts.Axis(0, 1, ((0.0, "0"), (0.5, "0.5"), (1.0, "1"))),
        270,
        220,
        30,
    )
    x, y, n = bins["confidence"], bins["accuracy"], bins["count"]
    layers = [charts.line(frame, [0.3, 1.0], [0.3, 1.0], "ref"), charts.line(frame, x, y)]
    layers += [
        charts.dots(frame, a, b, "dot whole dd", round(1.5 + 4.5 * math.sqrt(k / n.max()), 1))
        for a, b, k in zip(x, y, n, strict=True)
    ]
    layers.append(charts.label(frame, 1.0, 0.04, words, anchor="end"))
    return charts.panel(
        frame,
        layers,
        alt=f"{head}: stated and true share of right answers are {words}, over {int(n.sum())} {of}s",
        css="dd",
        title=title,
        units=("stated", "right"),
    )


# ---- tables and frames


@as_table()
def yardsticks(sources: Sources) -> dict[str, Any]:
    """The transformer beside the simpler ways, an image and a window, [key, head, shares]; whether it may
    judge; how each kind of foreign picture was detected."""
    metrics = need(sources.metrics["train_classifier"])
    rows = [
        (name, head, [accuracy(metrics, f"{name}_{of}".strip("_")) for of in ("image", "window")])
        for name, head in NAMES.items()
    ]
    found = known(lookup(metrics, "out_of_distribution"), {})
    foreign = {kind: one for kind, one in found.items() if isinstance(one, dict) and "auroc" in one}
    return {
        # of few own pictures no other way is learned
        "rows": [row for row in rows if not gap_of(row[2][0])],
        "limit": 100 * sources.declared.rules.image_accuracy,
        "proof": lookup(metrics, "proof.verdict"),
        "foreign": foreign,
        "false_alarms": found.get("false_alarms"),
    }


@as_table()
def data(sources: Sources) -> dict[str, Any]:
    """What was shown to it: frames, rejections by reason, segments; and the network."""
    metrics = sources.metrics["train_classifier"]
    counts = need_figure(metrics, "data")
    return counts | {key: entry(metrics, key) for key in ("source", "size", "parameters")}


# kinds of real frames in the order of the page
GROUPS = {
    "accepted": "Accepted, and classified correctly",
    "wrong": "Accepted, and named wrongly: the surest first",
    "rejected": "Rejected by the front end",
    "foreign": "Foreign to the classifier",
}


@as_table(recorded=False)
def frames(sources: Sources) -> dict[str, Any]:
    """Frames with key area and direction drawn in, of a rejected one the reason; where the classifier learned
    from recordings real ones: accepted, wrong, rejected and foreign, each with its share."""
    table: list[Any] = list(need(sources.tables["nozzle_frames"]))
    groups = [(head, [row for row in table if row.get("group") == kind]) for kind, head in GROUPS.items()]
    recorded = [(head, rows) for head, rows in groups if rows]
    origin = page.origin(sources.source("nozzle_frames"))
    return {"groups": recorded or [("", table)], "recorded": bool(recorded), "origin": origin}


BY_FLOW = "Named rightly, by flow"
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


def bins(metrics: Mapping | Missing) -> list[dict[str, Any]]:
    """Of train_classifier.json the bins of true flow in percent, that which is right least often first: how
    often its windows are right, what the ideal reader reaches there (NaN where nobody knows), and whether a
    border of the classes is one of its ends."""
    found = need_figure(metrics, "by_flow")
    ideal = IDEAL_BY_BIN if lookup(metrics, "source") == "simulated" else {}
    rows = [
        {
            "low": row["flow_low"],
            "high": row["flow_high"],
            "windows": row["windows"],
            "right": figure,
            "ideal": ideal.get(row["flow_low"], math.nan),
            "beside": row["flow_low"] in CLASS_BORDERS or row["flow_high"] in CLASS_BORDERS,
        }
        for row in found
        if (figure := share_in(row)) is not None
    ]
    if not rows:
        raise Absent(Missing("not measured", "no bin of flow holds a window"))
    return sorted(rows, key=lambda row: row["right"].value)


@instead(lambda gap: {"picture": placeholder("by-flow", BY_FLOW, gap), "rows": ()})
def by_flow(sources: Sources) -> dict[str, Any]:
    """The chart, and its bins, the worst first; the share if every flow were as frequent; the ideal reader's,
    and the width bias behind it, None where there is none."""
    metrics = sources.metrics["train_classifier"]
    found = bins(metrics)
    ideal = any(row["ideal"] == row["ideal"] for row in found)
    column = PictureColumn("Windows classified correctly", "in per cent, by true flow", "", [_chart(found)])
    origin = page.origin(sources.source("train_classifier"))
    return {
        "picture": Picture("", [column], "", origin, "by-flow", BY_FLOW),
        "rows": found,
        "every": share_in(known(lookup(metrics, "right_70_150"), None)),
        "ideal": IDEAL if ideal else None,
        "bias": WIDTH_BIAS,
    }


def _chart(worst_first: Sequence[Mapping[str, Any]]) -> Markup:
    """Bars with intervals, and the ideal reader as steps."""
    rows, least = sorted(worst_first, key=lambda row: row["low"]), worst_first[0]
    ends = [row["low"] for row in rows] + [rows[-1]["high"]]
    # every second end, so that both borders are among them
    x = charts.Axis(ends[0], ends[-1], tuple((v, f"{v:g}") for v in ends if v % 10 == 0))
    y = charts.Axis(0, 104, tuple((float(v), str(v)) for v in (0, 25, 50, 75, 100)))
    frame = charts.Frame(x, y, 568, 380, 42, 20, 24)
    layers = []
    for row in rows:
        a, b = (float(v) for v in frame.px([row["low"], row["high"]]))
        top, low, high = (float(v) for v in frame.py(row["right"][:3]))
        base, middle = frame.height - frame.below, (a + b) / 2
        layers.append(
            Markup(
                '<rect class="bin{}" x="{:.1f}" width="{:.1f}" y="{:.1f}" height="{:.1f}"/>'
                '<line class="whisk" x1="{:.1f}" x2="{:.1f}" y1="{:.1f}" y2="{:.1f}"/>'
            ).format(
                " beside" if row["beside"] else "", a + 1, max(b - a - 2, 1), top, max(base - top, 0),
                middle, middle, high, low,
            )
        )  # fmt: skip
    edges = np.array([edge for row in rows for edge in (row["low"], row["high"])])
    ideal = np.repeat([row["ideal"] for row in rows], 2)
    if np.isfinite(ideal).any():
        layers.append(charts.line(frame, edges, ideal, "ref"))
    return charts.panel(
        frame,
        layers,
        alt="Windows are classified correctly least often between "
        f"{least['low']:g} and {least['high']:g} % of flow, {number(least['right'].value, 0)} %",
        css="dd wide big",
        title="% of windows, against % of flow",
        units=("%", "%"),
    )
