"""What the learning rests on: the study's routes under noise, and the orders that identification compared."""

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.digits import number, percent, short
from pipeline.report.shared.pictures import Column, Picture, placeholder
from pipeline.report.shared.sources import Sources, Table
from pipeline.report.shared.verdict import Missing

# ---- the learners under noise

ROUTES = {
    "window": ("Window + Riccati", "dd"),
    "kernel": ("Kernel, raw window", "dd ring"),
    "kernel_predicted_state": ("Kernel, predicted state", "dd ring"),
}


def noise(sources: Sources) -> Picture:
    """Gap and error of each route, a dot a data set."""
    table, title = sources.tables["study"], "What noise costs the learners"
    if isinstance(table, Missing):
        return placeholder("noise", title, table)
    shown = [
        Column(
            f"{level:g} °C of noise",
            "in the data, and under the controller",
            "",
            [
                _cloud(table, level, "gap", 100.0, "gap to the optimum in %, log"),
                _cloud(table, level, "error_degC", 1.0, "r.m.s. error over steps 500–1000 in °C, log"),
            ],
        )
        for level in np.unique(table["noise_degC"])
    ]
    return Picture(
        "noise",
        title,
        _ranking(table),
        shown,
        (
            f"Each dot is one of {len(np.unique(table['data_set']))} data sets of 15,000 samples of the "
            "study’s probing; the bar is their median. Learned from noisy data, judged on the true plant "
            "under the same noise."
        ),
        page.origin(sources.source("study")),
    )


def _cloud(table: Table, level: float, column: str, factor: float, title: str) -> Markup:
    values = factor * np.abs(table[column])
    positive = values[np.isfinite(values) & (values > 0)]
    x = charts.logarithmic(float(positive.min()), float(positive.max()))
    y = charts.Axis(-0.5, len(ROUTES) - 0.5, ())
    frame = charts.Frame(x, y, width=440, height=120, left=128, below=18, above=18, right=10)
    layers, medians = [], []
    for lane, (route, (name, css)) in enumerate(ROUTES.items()):
        at = len(ROUTES) - 1 - lane
        mine = values[(table["route"] == route) & (table["noise_degC"] == level)]
        failed = int((~np.isfinite(mine)).sum())
        mine = mine[np.isfinite(mine)]
        layers.append(charts.label(frame, x.low, at, name, anchor="end", dx=-8, dy=3.5))
        if len(mine):
            spread = at + 0.28 * (np.arange(len(mine)) % 5 - 2) / 2
            middle = float(np.median(mine))
            px, top, bottom = float(frame.px(middle)), float(frame.py(at + 0.36)), float(frame.py(at - 0.36))
            layers += [
                charts.dots(frame, mine, spread, f"dot {css}"),
                Markup('<line class="med" x1="{0:.1f}" x2="{0:.1f}" y1="{1:.1f}" y2="{2:.1f}"/>').format(
                    px, top, bottom
                ),
            ]
            medians.append(f"{name} {short(middle, 2)}" + (f" ({failed} unstable)" if failed else ""))
        elif failed:
            medians.append(f"{name}: unstable in all {failed}")
    return charts.panel(
        frame,
        layers,
        alt=f"At {level:g} °C of noise, median {title.split(',')[0]}: {', '.join(medians)}",
        css="dd",
        title=title,
    )


def _ranking(table: Table) -> str:
    medians = pd.DataFrame(table).groupby(["noise_degC", "route"])["gap"].median().unstack("route")
    ratios = medians.div(medians["window"], axis=0)
    parts = [
        f"at {level:g} °C the kernel on the raw window costs {number(raw, 0)} times the window’s gap, on "
        f"the predicted state {number(predicted, 1)} times"
        for level, raw, predicted in zip(
            ratios.index, ratios["kernel"], ratios["kernel_predicted_state"], strict=True
        )
    ]
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}. All gaps are small; the order of the routes is what stays."


# ---- orders, for the page of the identification


def _holed(head: str, small: str, missing: Missing, mark: str = "") -> Column:
    return Column(head, small, mark, [Markup('<div class="hole">{}</div>').format(page.missing(missing))])


_SMALL = {"width": 270, "height": 160, "left": 44}


def singular(sources: Sources) -> Column:
    head, small = "Singular values", "of the identification, by order; log"
    table = sources.tables["order"]
    if isinstance(table, Missing):
        return _holed(head, small, table, "model_based")
    order, values, edge = table["order"], table["singular_value"], float(table["noise_edge"][0])
    positive = np.append(values[values > 0], edge if edge > 0 else values.max())
    frame = charts.Frame(
        charts.linear(0, float(order[-1]) + 1),
        charts.logarithmic(float(positive.min()), float(positive.max())),
        **_SMALL,
    )
    chosen = table["chosen"]
    last = int(order[chosen][0]) if chosen.any() else 0
    layers = [
        charts.dots(frame, order[order <= last], values[order <= last], "dot", 3),
        charts.dots(frame, order[order > last], values[order > last], "try", 2.4),
    ]
    if edge > 0:
        layers.append(charts.level(frame, edge, "lim", "noise alone"))
    last_value = values[order == last]
    size = short(float(last_value[0])) if len(last_value) else "none"
    alt = f"Order {last} is chosen: its singular value {size}, noise alone reaches {short(edge)}"
    return Column(head, small, "model_based", [charts.panel(frame, layers, alt=alt, css="mb")])


def left_out(sources: Sources) -> Column:
    head, small = "Error of each order", "on blocks left out, share of the outputs’ variation"
    table = sources.tables["order"]
    if isinstance(table, Missing):
        return _holed(head, small, table, "model_based")
    compared = np.isfinite(table["error"])
    if not compared.any():
        return _holed(
            head,
            small,
            Missing("not applicable", "the rank alone decided, or the order was given"),
            "model_based",
        )
    order, error, chosen = (table[name][compared] for name in ("order", "error", "chosen"))
    frame = charts.Frame(
        charts.linear(0, float(order[-1]) + 1), charts.linear(0, 1.1 * float(error.max())), **_SMALL
    )
    layers = [charts.line(frame, order, error), charts.dots(frame, order, error, "dot", 2.4)]
    outcome = "none chosen"
    if chosen.any():
        at, least = float(order[chosen][0]), float(error[chosen][0])
        layers += [
            charts.dots(frame, [at], [least], "dot", 4),
            charts.label(
                frame, frame.x.high, frame.y.high, f"order {at:g}: {number(least, 3)}", anchor="end", dy=10
            ),
        ]
        outcome = f"order {at:g} leaves {percent(100 * least, 2)} of the variation unexplained"
    alt = f"Error on left-out blocks by order: {outcome}"
    return Column(head, small, "model_based", [charts.panel(frame, layers, alt=alt, css="mb")])
