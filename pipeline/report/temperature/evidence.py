"""The figures of the temperature page that show what the learning rests on: lengths and orders, the hold-out,
and the optimiser."""

from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.digits import count, number, percent, quantity, short
from pipeline.report.shared.pictures import Column, Picture, placeholder
from pipeline.report.shared.sources import Sources, Table, lookup
from pipeline.report.shared.verdict import Missing

# ---- lengths and orders


def orders(sources: Sources) -> Picture:
    """How long a window, how many states: Akaike's criterion, singular values
    against the noise, the error of each order, the poles."""
    shown = [
        _criterion(sources),
        *_kernel_state(sources),
        singular(sources),
        left_out(sources),
        _poles(sources),
    ]
    learned, model = sources.metrics["learn_kernel"], sources.metrics["identify_plant"]
    window, state, order = lookup(learned, "window"), lookup(learned, "state"), lookup(model, "order")
    parts = [
        "" if isinstance(window, Missing) else f"a window of {window} samples",
        "" if isinstance(order, Missing) else f"a model of order {order}",
        ""
        if isinstance(state, Missing)
        else f"the kernel on the {state}, whose {lookup(learned, 'identifiable')} unknowns the data "
        "determine",
    ]
    text = "; ".join(filter(None, parts)) or "nothing"
    title = "How much memory the data ask for"
    return Picture(
        "orders",
        title,
        f"Chosen from the record alone: {text}.",
        shown,
        "",
        page.origin(sources.source("window", "kernel", "order", "plant")),
    )


def _holed(head: str, small: str, missing: Missing, mark: str = "") -> Column:
    return Column(head, small, mark, [Markup('<div class="hole">{}</div>').format(page.missing(missing))])


def _criterion(sources: Sources) -> Column:
    head, small = "Length of the window", "Akaike’s criterion over its least; log"
    window = sources.tables["window"]
    if isinstance(window, Missing):
        return _holed(head, small, window, "window")
    table = window["table"]
    above = table[:, 2] - table[:, 2].min() + 1
    chosen = float(table[above.argmin(), 0])
    frame = charts.Frame(
        charts.linear(0, float(table[-1, 0])), charts.logarithmic(1, float(above.max())), **_SMALL
    )
    layers = [
        charts.line(frame, table[:, 0], above),
        charts.dots(frame, table[:, 0], above, "dot dd"),
        charts.label(frame, chosen, 1, f"{chosen:g} samples", anchor="end", dx=-6, dy=-6),
    ]
    alt = (
        f"Akaike’s criterion is least at a window of {chosen:g} samples, "
        f"{'the longest tried' if chosen == table[-1, 0] else f'of up to {table[-1, 0]:g} tried'}"
    )
    return Column(head, small, "window", [charts.panel(frame, layers, alt=alt, css="dd")])


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


def _kernel_state(sources: Sources) -> list[Column]:
    """Singular values of the kernel's state; none where it is a
    predicted one, which is made of unit variance."""
    head, small = "State of the kernel", "singular values over the record, r.m.s.; log"
    kernel = sources.tables["kernel"]
    if isinstance(kernel, Missing):
        refused = lookup(sources.metrics["learn_kernel"], "refused")
        return [
            _holed(
                head,
                small,
                kernel if isinstance(refused, Missing) else Missing("failed", str(refused)),
                "kernel",
            )
        ]
    values = kernel["singular_values"]
    values = values[values > 0]
    if len(values) == 0 or values.max() < 1.1 * values.min():
        return []
    directions = int(kernel["rank"]) - len(kernel["u_scale"])
    index = np.arange(1, len(values) + 1)
    frame = charts.Frame(
        charts.linear(0, len(values) + 1),
        charts.logarithmic(float(values.min()), float(values.max())),
        **_SMALL,
    )
    layers = [
        charts.dots(frame, index[:directions], values[:directions], "dot ring", 3),
        charts.dots(frame, index[directions:], values[directions:], "try", 2.4),
    ]
    alt = (
        f"{len(values)} singular values from {short(float(values.max()))} down to "
        f"{short(float(values.min()))}; {directions} directions are kept"
    )
    return [
        Column(
            head, f"{small}; {directions} kept", "kernel", [charts.panel(frame, layers, alt=alt, css="dd")]
        )
    ]


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


def _poles(sources: Sources) -> Column:
    head, small = "Poles of the model", "real, imaginary part; line: unit circle"
    plant = sources.tables["plant"]
    if isinstance(plant, Missing):
        return _holed(head, small, plant, "model_based")
    poles = np.linalg.eigvals(plant["A"][0])
    largest = float(np.abs(poles).max())
    # the poles of a barrel crowd at one: near enough to see them, at equal scales
    left = float(poles.real.min())
    room = max(1 - left, 2 * float(np.abs(poles.imag).max()), 1e-3)
    low, high = left - 0.3 * room, 1 + 0.15 * room
    reach = 0.5 * (high - low) * (160 - 30) / (270 - 46)
    frame = charts.Frame(charts.linear(low, high, ticks=3), charts.linear(-reach, reach, ticks=3), **_SMALL)
    angle = np.linspace(-np.arcsin(min(reach, 1)), np.arcsin(min(reach, 1)), 60)
    layers = [
        charts.line(frame, np.cos(angle), np.sin(angle), "lim line thin"),
        charts.dots(frame, poles.real, poles.imag, "dot", 3),
    ]
    alt = (
        f"{len(poles)} poles, the largest of size {number(largest, 4)}, "
        f"{'inside' if largest < 1 else 'on or outside'} the unit circle"
    )
    return Column(head, small, "model_based", [charts.panel(frame, layers, alt=alt, css="mb")])


# ---- the optimiser


def tuning(sources: Sources) -> Picture:
    """The best cost so far, beside that of the default weights."""
    table, metrics, title = (
        sources.tables["tuning"],
        sources.metrics["tune_weights"],
        "The optimiser’s progress",
    )
    if isinstance(table, Missing):
        return placeholder("tuning", title, table)
    rows = {name: values[table["mode"] == "practical"] for name, values in table.items()}
    cost, default = lookup(metrics, "practical.cost"), default_cost(metrics)
    head, small = "The declared engineering cost", "log; default: Q = R = I"
    sentence = ""
    if not isinstance(cost, Missing) and not isinstance(default, Missing):
        sentence = (
            f"On the engineering cost it ends at {short(cost)}, the default weights at "
            f"{short(default)}, both on the training half of the panel."
        )
    return Picture(
        "tuning",
        title,
        sentence,
        [progress(rows, head, small, default, excess=False)],
        dots_and_line(rows),
        page.origin(sources.source("tuning")),
    )


def dots_and_line(rows: Table) -> str:
    """The caption of a search's progress."""
    failed = int(np.isnan(rows["cost"].astype(float)).sum())
    return "Dots: candidates; line: best so far." + (
        f" Vermillion at the foot: {count(failed, 'candidate')} that failed."
        if failed
        else " No candidate failed."
    )


def default_cost(metrics: Any) -> Any:
    """The engineering cost of the weights that the search started against."""
    cost = lookup(metrics, "practical.cost_default", what="the cost of the default weights")
    return (
        lookup(metrics, "practical.cost_identity", what="the cost of equal weights")
        if isinstance(cost, Missing)
        else cost
    )


def progress(rows: Table, head: str, small: str, level: Any, *, excess: bool) -> Column:
    """The candidates of one search beside a level: of the default weights, or with `excess` of the known
    optimum, above which the costs are then drawn in per cent."""
    if not len(rows["cost"]) or isinstance(level, Missing):
        return _holed(
            head,
            small,
            level if isinstance(level, Missing) else Missing("not measured", "no search was recorded"),
        )
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
    return Column(head, small, "", [charts.panel(frame, layers, alt=alt, css="mb")])


# ---- the hold-out


def holdout(sources: Sources) -> Picture:
    """The part of the record that judged the model, measured against simulated."""
    table, title = sources.tables["holdout"], "The model on the part of the record that it did not see"
    if isinstance(table, Missing):
        return placeholder("holdout", title, table)
    machine, fits = sources.declared.machine, lookup(sources.metrics["identify_plant"], "fit_holdout")
    shown = []
    for output in machine.outputs:
        measured, simulated = (table[f"{output.name}_{kind}"] for kind in ("measured", "simulated"))
        values = np.concatenate([measured, simulated])
        values = values[np.isfinite(values)]
        frame = charts.Frame(
            charts.linear(0, max(len(measured) - 1, 1) * machine.sample_time_s, ticks=3),
            charts.linear(float(values.min()), float(values.max()), ticks=3),
            height=120,
        )
        time = machine.sample_time_s * np.arange(len(measured))
        fit = None if isinstance(fits, Missing) else fits.get(output.name)
        small = "fit not measured" if fit is None else f"fit {quantity(fit, '%', 1)}"
        alt = f"{output.name}: {small} in simulation on the hold-out"
        layers = [
            charts.line(frame, time, measured, "line seen"),
            charts.line(frame, time, simulated, "line thin"),
        ]
        shown.append(
            Column(
                output.name,
                small,
                "",
                [
                    charts.panel(
                        frame, layers, alt=alt, css="mb", title="°C" if not shown else "", units=("s", "°C")
                    )
                ],
            )
        )
    text = (
        "The model runs from the inputs alone; a fit of 100 % would be perfect, 0 % no better than the mean."
    )
    return Picture(
        "holdout",
        title,
        text,
        shown,
        "Grey: measured; ink: simulated from the inputs alone. Time in s.",
        page.origin(sources.source("holdout")),
    )
