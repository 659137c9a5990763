"""The machine of Zavrakli 2023, simulated: its figures as published, what they say, its learners under noise,
and the parity search."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.shared import charts, page
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table
from pipeline.verdict.controllers import in_a_sentence
from pipeline.verdict.digits import THIN, count, number, percent, short
from pipeline.verdict.evidence import Table, gap_of, instead, known, lookup, need, need_figure, or_nothing
from pipeline.verdict.verdict import Missing


def part(results: Mapping[str, Any] | Missing) -> dict[str, Any]:
    """All that the page shows of the study, from the results of the stage reproduce_study; `honest` and
    `weights` are pairs of title and figure."""
    study = lookup(results, "figures")
    return {
        "published": _published(study),
        "honest": _honest(study),
        "findings": [_claim(study), _scaled(study), _algorithm_1(study), _start(study)],
        "pictures": [_noise(results), _parity(results)],
        "weights": _weights(study),
    }


def _table(results: Mapping[str, Any] | Missing, name: str) -> Table:
    """Columns as arrays; None, a number without end or that is none, as NaN."""
    columns = need_figure(results, name)
    gaps = {
        name: [np.nan if value is None else value for value in values] for name, values in columns.items()
    }
    return {name: np.array(values) for name, values in gaps.items()}


# ---- as published

CONVENTIONS = {
    "model_based": (
        "Model-based, Q = R = I",
        (
            "J counts the observer’s temperatures, not the barrel’s, its first stage twice; the observer "
            "starts at 50 °C; “100” is the 100th sample."
        ),
    ),
    "model_based_tuned": (
        "Model-based, tuned",
        "The same, and J weighs with the tuned Q and R: another currency. The fifth q is 0.0514, "
        "not the printed 0.514.",
    ),
    "data_driven": (
        "Data-driven, Q = R = I",
        "Seven start-up steps first drive the barrel to 0 °C, and make 80 % of J; u′Ru is not discounted; "
        "all data are divided by 1000.",
    ),
    "data_driven_tuned": (
        "Data-driven, tuned",
        "The same; J weighs u with R = I although the controller was tuned for another R. Here 15,000 rows "
        "and value iteration to its end: on the 15,084 rows that the script takes, stopped as it stops, "
        "every printed digit comes out (the rows above).",
    ),
}


@as_table(rows=[])
def _published(study: Any) -> dict[str, Any]:
    """The study's four columns, printed and reproduced, with the convention that it takes."""
    printed, reproduced = (need_figure(study, key) for key in ("printed", "as_published"))
    rows = []
    for key, (title, convention) in CONVENTIONS.items():
        if key in printed and key in reproduced:
            rows.append(
                {
                    "title": title,
                    "convention": convention,
                    "cells": [
                        _reproduced(printed[key][name], reproduced[key][name], places)
                        for name, places in (("J100", 1), ("J1000", 1), ("error", 4))
                    ],
                }
            )
    return {"rows": rows}


def _reproduced(theirs: float, ours: float, places: int) -> dict[str, Any]:
    off = abs(ours / theirs - 1)
    return {
        "printed": number(theirs, places),
        "ours": number(ours, places),
        "off": percent(100 * off, 2) if off > 1e-3 else "",
    }


def _honest(study: Any) -> list[tuple[str, str]]:
    """The same machine, counted once: true outputs, Q = R = I, from 20 °C."""
    items = (
        ("optimal.J1000", "Exact optimum, J over 1,000 steps"),
        ("observer.J1000", "Observer started from the first measurement"),
        ("observer.J1000_from_50_degC", "Observer started at 50 °C, as published"),
    )
    gaps = (
        ("kernel.gap", "Kernel, noise-free, 500 samples: gap"),
        ("kernel.gap_window_6", "Kernel, window of 6, 1,610 samples: gap"),
        ("kernel.any_reference_gap", "Kernel, 20 random references from 540 samples: worst gap"),
        ("takeover.zero_history_gap", "Taking over with an empty history: gap"),
    )
    return [(title, _worded(study, key, lambda value: number(value, 1))) for key, title in items] + [
        (title, _worded(study, key, lambda gap: percent(100 * gap, 2))) for key, title in gaps
    ]


@instead(lambda gap: gap.state)
def _worded(study: Any, key: str, words: Callable[[Any], str]) -> str:
    """A figure of the study in words; its state if it is missing."""
    return words(need_figure(study, key))


# ---- what they say


@instead(lambda gap: ("“Better after tuning”.", f"Not measured. {gap.sentence()}"))
def _claim(study: Any) -> tuple[str, str]:
    printed = need_figure(study, "printed")
    model = 100 * (1 - printed["model_based_tuned"]["J100"] / printed["model_based"]["J100"])
    data = 100 * (1 - printed["data_driven_tuned"]["J100"] / printed["data_driven"]["J100"])
    return (
        f"“{number(model, 1)} % and {number(data, 1)} % better after tuning” compares two currencies.",
        (
            "The cost before tuning is counted with Q = R = I, the cost after it with the tuned, smaller "
            "weights. The objective that was tuned is the cost at Q = R = I, whose optimum is Q = R = I: no "
            "weights can be better."
        ),
    )


UNTRIED = "The same controller, “improved”.", "Not measured: reproduce_study did not try Q = R = 0.4 I."


@instead(lambda gap: UNTRIED)
def _scaled(study: Any) -> tuple[str, str]:
    scaled = "parity.scaled_weights"
    change, apart = (need_figure(study, f"{scaled}.{key}") for key in ("change_percent", "gain_difference"))
    return (
        f"Q = R = 0.4 I “improves” the cost by {number(abs(change), 1)} % without changing the controller.",
        f"Its gain differs from that of Q = R = I by {short(apart, 1)}, which is rounding; "
        "every temperature and every input is the same.",
    )


@instead(lambda gap: ("Algorithm 1 from random starts.", "Not measured."))
def _algorithm_1(study: Any) -> tuple[str, str]:
    failed, of = (need_figure(study, f"algorithm_1.{key}") for key in ("failures", "of"))
    return (
        f"Algorithm 1 as published misses the stabilising gain in {failed} of {of} random starts.",
        (
            "It has no guard against a start that does not stabilise. The controllers here take the Riccati "
            "equation’s solution instead, which needs no start."
        ),
    )


@instead(lambda gap: ("Where the observer starts.", "Not measured."))
def _start(study: Any) -> tuple[str, str]:
    best, late = (need_figure(study, key) for key in ("optimal.J1000", "observer.J1000_from_50_degC"))
    return (
        f"Starting the observer at 50 °C costs {percent(100 * (late / best - 1), 2)} for nothing.",
        "Starting it from the first measurement costs next to nothing, "
        "and asks for nothing that is not known.",
    )


# ---- the learners under noise

ROUTES = {
    "window": ("Window + Riccati", "dd"),
    "kernel": ("Kernel, raw window", "dd ring"),
    "kernel_predicted_state": ("Kernel, predicted state", "dd ring"),
}


@as_picture("noise", "What noise costs the learners")
def _noise(results: Mapping[str, Any] | Missing) -> Picture:
    """Gap and error of each route, a dot a data set."""
    table = _table(results, "study")
    shown = [
        PictureColumn(
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
        _ranking(table),
        shown,
        (
            f"Each dot is one of {len(np.unique(table['data_set']))} data sets of 15,000 samples of the "
            "study’s probing; the bar is their median. Learned from noisy data, judged on the true plant "
            "under the same noise."
        ),
        Markup(""),
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


# ---- the parity search


@as_picture("parity", "The search for (37)")
def _parity(results: Mapping[str, Any] | Missing) -> Picture:
    """The best cost so far above the optimum that is known, and what the candidates trade."""
    table, study = _table(results, "parity"), need_figure(results, "figures")
    optimum = lookup(study, "parity.optimum")
    head, trade = "The study’s objective", lookup(study, "parity.trade")
    return Picture(
        _reached(study),
        [
            progress(table, head, "excess over the optimum in %, log", optimum, excess=True),
            draw_search(table, trade, "What its candidates trade", "state known, discounted"),
        ],
        f"{dots_and_line(table)} Beside it: r.m.s. tracking error in °C, up, against r.m.s. "
        "effort in per cent, across; line: the front; filled square: chosen; cross: the optimum, Q = R = I.",
        Markup(""),
    )


def _weights(study: Any) -> list[tuple[str, str]]:
    """The diagonals of Q and R that the search recommends."""

    def listed(values: Any) -> str:
        return ", ".join(short(value, 2) for value in values)

    return [
        (f"Diagonal of {name} that the search recommends", _worded(study, f"parity.{key}", listed))
        for name, key in (("Q", "q"), ("R", "r"))
    ]


@or_nothing
def _reached(study: Any) -> str:
    """How close the search came to the optimum that is known."""
    best, optimum = need_figure(study, "parity.best_cost_perfect_state"), need_figure(study, "parity.optimum")
    return (
        f"On the study’s objective the search ends {percent(100 * (best / optimum - 1), 2)} above the "
        f"optimum, {number(optimum, 0)}, which Q = R = I itself reaches."
    )


def draw_search(rows: Table, trade: Any, head: str, small: str) -> PictureColumn:
    """What one search tried, effort across and error up; in its place that nothing worked. `trade` names
    default weights and optimum, as far as they are known."""
    worked = np.isfinite(rows["tracking_degC"]) & np.isfinite(rows["effort_percent"])
    points = np.column_stack([rows["effort_percent"][worked], rows["tracking_degC"][worked]])
    if not len(points):
        gap = Missing("not measured", "no candidate of the search worked")
        return PictureColumn(head, small, "", [page.hole(gap)])
    marks = _marks(points, rows["chosen"][worked], trade)
    panel = _panel_of_search(points, points[_rows_of_front(points)], marks, head)
    return PictureColumn(head, small, "", [panel])


def _marks(points: np.ndarray, chosen: np.ndarray, trade: Any) -> dict[str, tuple[float, float]]:
    """(effort, error) of the chosen candidate, the default weights and
    the optimum, as far as they are known."""
    named = known(trade, {}).items()
    at = {name: (place["effort_percent"], place["tracking_degC"]) for name, place in named if place}
    return (
        {"chosen": (float(points[chosen][0, 0]), float(points[chosen][0, 1]))} if chosen.any() else {}
    ) | at


def _rows_of_front(points: np.ndarray) -> np.ndarray:
    """Rows of the front, by effort: those that no other beats in one figure without losing in the other."""
    order = np.lexsort((points[:, 1], points[:, 0]))
    least = np.minimum.accumulate(np.append(np.inf, points[order, 1]))[:-1]
    return order[points[order, 1] < least]


def _trade_in_words(name: str, marks: dict[str, tuple[float, float]]) -> str:
    effort, error = marks[name]
    return f"{short(error, 3)}{THIN}°C at {short(effort, 3)}{THIN}%"


def _around(values: np.ndarray) -> charts.Axis:
    room = 0.06 * (float(values.max() - values.min()) or 1.0)
    return charts.linear(float(values.min()) - room, float(values.max()) + room, ticks=3)


def _panel_of_search(
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
        f"{name} {_trade_in_words(name, marks)} of effort" for name in marks
    )
    alt += f"; {count(out, 'candidate')} beyond the picture" if out else ""
    return charts.panel(frame, layers, alt=alt, css="mb", title="°C", units=("%", "°C"))


@instead(lambda gap: [gap.sentence()])
def sentences(results: Mapping[str, Any] | Missing) -> list[str]:
    """How often each controller was the best and won the pair, and which pair a changed prior gives."""
    results = need(results)
    answers = results["answers"]
    told = [
        f"{count(results['relearnings'], 'fresh record')} of the bundled simulated machine, each learned and "
        f"judged from the beginning: the best was {_listed(answers['best'])}. The pair went to "
        f"{_listed(answers['pair_winner'])}."
    ]
    for change, runs in results.get("prior", {}).items():
        told.append(
            f"With the prior of plant uncertainty {change} the pair went to {_listed(runs['pair_winner'])}."
        )
    return [*told, "No verdict, choice or export reads these figures."]


def _listed(counts: Mapping[str, int]) -> str:
    names = {name: "nobody" if name == "None" else in_a_sentence(name) for name in counts}
    return ", ".join(f"{names[name]} in {number(times, 0)}" for name, times in counts.items())


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
    return PictureColumn(
        head,
        small,
        "",
        [
            charts.panel(
                frame,
                layers,
                alt=f"{head}: after {count(len(at), 'evaluation')} "
                + (
                    f"the best is {percent(end, 2)} above the optimum"
                    if excess
                    else f"the best costs {short(end)}, the default weights {short(level)}"
                ),
                css="mb",
            )
        ],
    )
