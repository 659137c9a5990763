"""The page of the history: the twelve figures run by run as small multiples, and a table of the runs."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report.runs.history import Figure, Run
from pipeline.report.shared import charts, page
from pipeline.report.shared.digits import count, decimals, quantity, short
from pipeline.report.shared.verdict import Question, ReportRules, questions

# controller of the artifacts -> class of its line and its name; the
# deposition loop has the composer in use alone
SHOWN = {
    "window": ("dd", "data-driven"),
    "model_based": ("mb", "model-based"),
    "baseline": ("bl", "baseline"),
}
# runs that stand in the table; the pictures show all
ROWS = 200


class Panel(NamedTuple):
    head: str
    small: str
    picture: Markup


def render(
    found: Sequence[Run], rules: ReportRules, *, band_degC: float, pages: Sequence[tuple[str, str]]
) -> str:
    """The text of history.html; `pages` (name, file) are those that lie beside it."""
    asked = questions(rules, band_degC=band_degC)
    parts = [
        Question(
            0, "flow_error_percent", "Worst flow error of a part", "%", rules.flow_error_percent, False, ""
        ),
        Question(0, "line_volume_percent", "Worst line’s volume", "%", rules.line_volume_percent, False, ""),
        Question(0, "learned_percent", "Left after learning", "%", rules.learned_percent, False, ""),
    ]
    return page.render(
        "history.html",
        here="history",
        title=f"History: {count(len(found), 'run')}",
        first=found[0],
        last=found[-1],
        runs=len(found),
        pages=pages,
        loops=[
            ("Temperature", [_panel(question, found, SHOWN) for question in asked]),
            (
                "Deposition",
                [_panel(question, found, {"deposition": ("dd", "composer in use")}) for question in parts],
            ),
        ],
        heads=[question.title for question in (*asked, *parts)],
        rows=[_row(run, (*asked, *parts)) for run in reversed(found[-ROWS:])],
        more=max(len(found) - ROWS, 0),
    )


def _figure(run: Run, name: str, key: str) -> Figure | None:
    return run.figures.get(name, {}).get(key)


def _panel(question: Question, found: Sequence[Run], lines: dict[str, tuple[str, str]]) -> Panel:
    """Medians by run with the first controller's band; the limit of
    today; a run without the figure leaves a gap."""
    ends = {name: np.array([_ends(_figure(run, name, question.key)) for run in found]) for name in lines}
    values = np.concatenate([part[np.isfinite(part)] for part in ends.values()] + [[question.limit]])
    frame = charts.Frame(_runs(len(found)), _scale(values), 368, 150, 40)
    layers: list[Markup] = [charts.level(frame, question.limit, "lim", f"limit {question.limit:g}")]
    at = np.arange(1, len(found) + 1)
    said = []
    for i, (name, (css, word)) in enumerate(lines.items()):
        middle, low, high = ends[name].T
        if i == 0:
            known = charts.stretches(np.isfinite(low + high))
            layers += [
                charts.ribbon(frame, at[a:b], low[a:b], high[a:b], f"ribbon {css}")
                for a, b in known
                if b - a > 1
            ]
        layers += [
            charts.line(frame, at, middle, f"line {css}"),
            charts.dots(frame, at, middle, f"dot {css}", 2.2),
        ]
        known = middle[np.isfinite(middle)]
        if len(known):
            said.append(f"{word} from {_said(question, known[0])} to {_said(question, known[-1])}")
    alt = f"{question.title} over {count(len(found), 'run')}: {'; '.join(said) or 'not measured'}; limit {_said(question, question.limit)}"
    unit = question.unit or "1"
    picture = charts.panel(
        frame,
        layers,
        alt=alt,
        css="mb wide",
        title=f"{unit}{', log' if frame.y.log else ''}",
        units=("", question.unit),
    )
    now = _figure(found[-1], next(iter(lines)), question.key)
    return Panel(question.title, f"now {_said(question, now.value) if now else 'not measured'}", picture)


def _ends(figure: Figure | None) -> tuple[float, float, float]:
    return (math.nan,) * 3 if figure is None else tuple(v if math.isfinite(v) else math.nan for v in figure)


def _said(question: Question, value: float) -> str:
    return quantity(value, question.unit, min(decimals(0, 0, value=value), 3), beyond=question.beyond)


def _runs(number: int) -> charts.Axis:
    """Whole runs, the first and the last of them named."""
    return charts.Axis(0.5, number + 0.5, tuple((k, f"run {k}") for k in dict.fromkeys((1, number))))


def _scale(values: np.ndarray) -> charts.Axis:
    """Linear from zero, or decades where the figures span more than fifty to one."""
    positive = values[values > 0]
    if len(positive) and positive.max() > 50 * positive.min():
        return charts.logarithmic(float(positive.min()), float(positive.max()))
    return charts.linear(min(float(values.min()), 0.0), 1.1 * float(values.max()))


def _row(run: Run, asked: Sequence[Question]) -> dict[str, Any]:
    cells = []
    for question in asked:
        figure = _figure(run, "window", question.key) or _figure(run, "deposition", question.key)
        if figure is None:
            cells.append({"text": "not measured", "number": "", "bad": False})
            continue
        beyond = figure.value < question.limit if question.at_least else figure.value > question.limit
        text = f"{short(figure.value, 3)}" if math.isfinite(figure.value) else question.beyond
        cells.append(
            {"text": text, "number": figure.value if math.isfinite(figure.value) else "", "bad": beyond}
        )
    return {
        "commit": run.commit[:8],
        "date": run.date[:10],
        "when": run.date,
        "subject": run.subject,
        "verdict": run.verdict,
        "cells": cells,
    }
