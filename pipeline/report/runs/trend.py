"""The page of the history: the figures of the three loops run by run as small multiples, and a table of the
runs."""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report.runs.figures import Cell, cell, parts_questions, setpoint_questions
from pipeline.report.runs.history import Revision
from pipeline.report.shared import charts, page
from pipeline.report.shared.digits import count, decimals, quantity
from pipeline.report.shared.verdict import Figure, Question, ReportRules
from pipeline.report.temperature.verdict import questions

# controller of the artifacts -> class of its line and its name; of the deposition loop only the composer in
# use is drawn
SHOWN = {
    "learned_kernel": ("dd", "data-driven"),
    "subspace_lqg": ("mb", "model-based"),
    "pi": ("bl", "PI, tuned"),
}
# figures of runs before the comparison as deployed: medians on the nominal plant, under names of their own
BEFORE = {
    "window": ("dd", "data-driven"),
    "model_based": ("mb", "model-based"),
    "baseline": ("bl", "baseline"),
}
OLD = (
    Question(0, "gap_percent", "Gap to the optimum", "%", math.inf, False, ""),
    Question(0, "settled_error_degC", "Worst settled zone error", "°C", math.inf, False, ""),
    Question(0, "settling_s", "Settling", "s", math.inf, False, ""),
    Question(0, "overshoot_degC", "Overshoot", "°C", math.inf, False, ""),
    Question(0, "at_limits_percent", "Time at limits", "%", math.inf, False, ""),
    Question(0, "worst_case_gap_percent", "Worst case over plant spread", "%", math.inf, False, ""),
)
# runs that stand in the table; the pictures show all
ROWS = 200


class Panel(NamedTuple):
    head: str
    small: str
    picture: Markup


def render(runs: Sequence[Revision], rules: ReportRules, *, pages: Sequence[tuple[str, str]]) -> str:
    """The text of history.html. `pages` (name, file) are those that lie beside it."""
    asked = [*questions(rules, {}), Question(0, "cost", "Cost as deployed", "", math.inf, False, "")]
    old = [
        question
        for question in OLD
        if any(_figure(run, name, question.key) for run in runs for name in BEFORE)
    ]
    parts, camera = parts_questions(rules), setpoint_questions(rules)
    return page.render(
        "history.html",
        here="history",
        title=f"History: {count(len(runs), 'run')}",
        first=runs[0],
        last=verdict_words(runs[-1].verdict),
        until=runs[-1].date,
        runs=len(runs),
        pages=pages,
        loops=[
            ("Temperature", "now", [_panel(question, runs, SHOWN) for question in asked]),
            *(
                [("Temperature, earlier runs", "before", [_panel(q, runs, BEFORE) for q in old])]
                if old
                else []
            ),
            (
                "Deposition",
                "parts",
                [_panel(question, runs, {"deposition": ("dd", "composer in use")}) for question in parts],
            ),
            (
                "Setpoint",
                "camera",
                [_panel(question, runs, {"setpoint": ("dd", "the default")}) for question in camera],
            ),
        ],
        heads=[question.title for question in (*asked, *old, *parts, *camera)],
        rows=[_row(run, (*asked, *old, *parts, *camera)) for run in reversed(runs[-ROWS:])],
        more=max(len(runs) - ROWS, 0),
    )


def _figure(run: Revision, name: str, key: str) -> Figure | None:
    return run.figures.get(name, {}).get(key)


def _panel(question: Question, runs: Sequence[Revision], lines: dict[str, tuple[str, str]]) -> Panel:
    """Medians by run, the first controller's band, and today's limit. A run without the figure leaves a
    gap."""
    ends = {name: np.array([_ends(_figure(run, name, question.key)) for run in runs]) for name in lines}
    values = np.concatenate([part[np.isfinite(part)] for part in ends.values()] + [_limits(question)])
    frame = charts.Frame(_runs(len(runs)), _scale(values), 368, 150, 40)
    layers: list[Markup] = [
        charts.level(frame, limit, "lim", f"limit {limit:g}") for limit in _limits(question)
    ]
    at = np.arange(1, len(runs) + 1)
    changes = []
    for i, (name, (css, word)) in enumerate(lines.items()):
        middle, low, high = ends[name].T
        if i == 0:
            layers += [
                charts.ribbon(frame, at[a:b], low[a:b], high[a:b], f"ribbon {css}")
                for a, b in charts.stretches(np.isfinite(low + high))
                if b - a > 1
            ]
        layers += [
            charts.line(frame, at, middle, f"line {css}"),
            charts.dots(frame, at, middle, f"dot {css}", 2.2),
        ]
        measured = middle[np.isfinite(middle)]
        if len(measured):
            first, last = _words(question, measured[0]), _words(question, measured[-1])
            changes.append(f"{word} from {first} to {last}")
    unit = question.unit or "1"
    picture = charts.panel(
        frame,
        layers,
        alt=_alternative(question, len(runs), changes),
        css="mb wide",
        title=f"{unit}{', log' if frame.y.log else ''}",
        units=("", question.unit),
    )
    now = _figure(runs[-1], next(iter(lines)), question.key)
    return Panel(question.title, f"now {_words(question, now.value) if now else 'not measured'}", picture)


def _limits(question: Question) -> list[float]:
    """The limit, if the figure has one."""
    return [question.limit] if math.isfinite(question.limit) else []


def _alternative(question: Question, runs: int, changes: Sequence[str]) -> str:
    """The picture in words."""
    lines = "; ".join(changes) or "not measured"
    limit = "".join(f"; limit {_words(question, value)}" for value in _limits(question))
    return f"{question.title} over {count(runs, 'run')}: {lines}{limit}"


def _ends(figure: Figure | None) -> tuple[float, float, float]:
    return (
        (math.nan,) * 3 if figure is None else tuple(v if math.isfinite(v) else math.nan for v in figure[:3])
    )


def _words(question: Question, value: float) -> str:
    return quantity(value, question.unit, min(decimals(0, 0, value=value), 3), beyond=question.beyond)


def _runs(number: int) -> charts.Axis:
    """An axis of runs; the first and the last are named."""
    return charts.Axis(0.5, number + 0.5, tuple((k, f"run {k}") for k in dict.fromkeys((1, number))))


def _scale(values: np.ndarray) -> charts.Axis:
    """Linear from zero, or decades if the figures span more than fifty to one."""
    if not len(values):
        return charts.linear(0, 1)
    positive = values[values > 0]
    if len(positive) and positive.max() > 50 * positive.min():
        return charts.logarithmic(float(positive.min()), float(positive.max()))
    return charts.linear(min(float(values.min()), 0.0), 1.1 * float(values.max()))


class Row(NamedTuple):
    """A run in the table."""

    commit: str
    date: str
    when: str
    subject: str
    verdict: str
    cells: list[Cell]


def _row(run: Revision, asked: Sequence[Question]) -> Row:
    cells = []
    for question in asked:
        # margins of earlier runs have today's keys, but are medians on the nominal plant
        names = ("window",) if question in OLD else (run.winner, "subspace_lqg", "deposition", "setpoint")
        figure = next(filter(None, (_figure(run, name, question.key) for name in names)), None)
        cells.append(cell(figure, question))
    return Row(run.commit[:8], run.date[:10], run.date, run.subject, verdict_words(run.verdict), cells)


def verdict_words(text: str) -> str:
    """The verdict of an earlier version in today's words: it claimed more than simulated machines can
    show."""
    if re.match(r"do not deploy", text, re.IGNORECASE):
        return "Failed the rules of its day."
    who = re.match(r"deploy(?: the (\S+) )?", text, re.IGNORECASE)
    if not who:
        return text
    return f"Passed the rules of its day{f': {who[1]}' if who[1] else ''}."
