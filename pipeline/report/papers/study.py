"""The machine of Zavrakli 2023, simulated: its figures as published, what they say, its learners under noise,
and the parity search."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pipeline.report.shared import charts
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture, as_table
from pipeline.report.temperature import evidence, trades
from pipeline.verdict.digits import number, percent, short
from pipeline.verdict.evidence import Table, gap_of, instead, lookup, need_figure, or_nothing
from pipeline.verdict.verdict import Missing


def part(results: Mapping[str, Any] | Missing) -> dict[str, Any]:
    """All that the page shows of the study, from the results of the stage reproduce_study; `honest` and
    `weights` are pairs of title and figure."""
    study = gap_of(results) or results["figures"]
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
            cells = [
                _reproduced(printed[key][name], reproduced[key][name], places)
                for name, places in (("J100", 1), ("J1000", 1), ("error", 4))
            ]
            rows.append({"title": title, "convention": convention, "cells": cells})
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
    head, tried = "The study’s objective", trades.search(table, lookup(study, "parity.trade"))
    return Picture(
        _reached(study),
        [
            evidence.progress(table, head, "excess over the optimum in %, log", optimum, excess=True),
            trades.searched(tried, "What its candidates trade", "state known, discounted"),
        ],
        f"{evidence.dots_and_line(table)} Beside it: r.m.s. tracking error in °C, up, against r.m.s. "
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
