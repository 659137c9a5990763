"""What learning rests on: the orders that identification compared, and the course of a search."""

from typing import Any

import numpy as np

from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import PictureColumn
from pipeline.verdict.digits import count, number, percent, short
from pipeline.verdict.evidence import Table, gap_of
from pipeline.verdict.verdict import Missing

# ---- orders, for the page of the identification


_SMALL = {"width": 270, "height": 160, "left": 44}


def singular(table: Table) -> PictureColumn:
    """Singular values of the identification, by order."""
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
    small = "of the identification, by order; log"
    return PictureColumn("Singular values", small, "", [charts.panel(frame, layers, alt=alt, css="mb")])


def left_out(table: Table) -> PictureColumn:
    """The error of each order on what was left out."""
    head, small = "Error of each order", "on blocks left out, share of the outputs’ variation"
    compared = np.isfinite(table["error"])
    if not compared.any():
        gap = Missing("not applicable", "the rank alone decided, or the order was given")
        return PictureColumn(head, small, "", [page.hole(gap)])
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
    return PictureColumn(head, small, "", [charts.panel(frame, layers, alt=alt, css="mb")])


# ---- the course of a search


def dots_and_line(rows: Table) -> str:
    """The caption of a search's progress."""
    failed = int(np.isnan(rows["cost"].astype(float)).sum())
    return "Dots: candidates; line: best so far." + (
        f" Vermillion at the foot: {count(failed, 'candidate')} that failed."
        if failed
        else " No candidate failed."
    )


def progress(rows: Table, head: str, small: str, level: Any, *, excess: bool) -> PictureColumn:
    """The candidates of one search beside a level: of the default weights, or with `excess` of the known
    optimum, above which the costs are then drawn in per cent."""
    if not len(rows["cost"]) or gap_of(level):
        none = Missing("not measured", "no search was recorded")
        return PictureColumn(head, small, "", [page.hole(gap_of(level) or none)])
    at, cost, best = (rows[name].astype(float) for name in ("evaluation", "cost", "incumbent"))
    if excess:
        cost, best = (100 * (values / level - 1) for values in (cost, best))
    least = max(float(np.nanmin(best)), 1e-6)
    frame = charts.Frame(
        charts.linear(0, float(at[-1])),
        charts.logarithmic(least, float(np.nanmax(cost))),
        width=540,
        height=190,
        left=44,
        above=20,
    )
    failed = at[np.isnan(cost)]
    layers = [
        charts.dots(frame, at, cost, "try", 1.8),
        charts.line(frame, at, best, "line"),
        charts.dots(frame, failed, np.full(len(failed), frame.y.low), "gone", 2),
    ]
    if not excess:
        layers.append(charts.level(frame, level, "ref", f"default {short(level)}"))
    end = float(best[-1])
    layers.append(
        charts.label(
            frame,
            float(at[-1]),
            frame.y.high,
            f"best {percent(end, 2)} above" if excess else f"best {short(end)}",
            anchor="end",
            dy=-6,
        )
    )
    alt = f"{head}: after {count(len(at), 'evaluation')} " + (
        f"the best is {percent(end, 2)} above the optimum"
        if excess
        else f"the best costs {short(end)}, the default weights {short(level)}"
    )
    return PictureColumn(head, small, "", [charts.panel(frame, layers, alt=alt, css="mb")])
