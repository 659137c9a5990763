"""Two runs side by side: figures of the three loops with their bands, parameters that differ, curves."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pipeline.report.about.page import ANOTHER, changes
from pipeline.report.runs.figures import LOOPS, READERS, Curve, RunFigures, asked, curves, measured
from pipeline.report.shared import charts, page
from pipeline.report.shared.difference import accepted_on, changed_parameters, move
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature.judgement import Judgement
from pipeline.verdict.controllers import heading
from pipeline.verdict.digits import MINUS, THIN, band, count, declared, quantity, short, with_unit
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import FAILED, Figure, Question, state
from pipeline.verdict.wording import places_of

# the stages that give the figures
MEASURED_BY = ("evaluate_temperature", "compose_parts", "train_ilc", "evaluate_setpoint", "train_classifier")
# parameters that the page lists
MOST_PARAMETERS = 200


class Run(NamedTuple):
    """A run: its name, {stage: metrics}, the sections of its parameters, its curves."""

    name: str
    metrics: Mapping[str, Any]
    parameters: Mapping[str, Any]
    curves: Mapping[str, Curve] = {}


def render(sources: Sources, judged: Judgement, metrics: Mapping[str, Any]) -> str:
    """The text of runs.html: this run beside the accepted one. `metrics` are those of the report itself."""
    this = Run(
        "This run",
        {**sources.measured, "report": metrics},
        sources.declared.everything,
        curves(sources.tables),
    )
    told = changes(sources, judged)
    day = accepted_on(sources)
    return page.render(
        "runs.html",
        here="runs",
        sources=sources,
        title="This run beside the accepted one",
        heading=f"This run beside the accepted one{f' of {day}' if day else ''}",
        lead=f"{told['strong']} {told['text']}".strip(),
        remedy="",
        tables=page.files(sources.source(*READERS)),
        measured=page.files(sources.source(*MEASURED_BY, "accepted")),
        declared=page.files(sources.source("accepted")),
        **_parts(accepted(sources), this, sources.declared.rules),
    )


def accepted(sources: Sources) -> Run | None:
    """The accepted run; None without one that can be read."""
    run = sources.accepted
    if not isinstance(run, dict):
        return None
    return Run(
        "Accepted run",
        {
            **run["metrics"],
            "report": {
                "figures": run["figures"],
                "verdict": {"winner": run["winner"]},
                "verdicts": run.get("verdicts"),
            },
        },
        run["params"],
        run.get("curves") or {},
    )


def render_two(a: Run, b: Run, rules: ReportRules) -> str:
    """The page of any two runs."""
    parts = _parts(a, b, rules)
    rows = [row for _, rows in parts["loops"] for row in rows]
    moved = sum(row["moved"] for row in rows)
    figures = count(moved, "figure")
    return page.render(
        "runs.html",
        here="",
        title=f"{a.name} beside {b.name}",
        heading=f"{a.name} beside {b.name}",
        lead=f"{figures[:1].upper()}{figures[1:]} of {len(rows)} moved beyond their noise.",
        tables="",
        measured="",
        declared="",
        remedy=f"./run dvc plots diff {a.name.split(' ')[0]} {b.name.split(' ')[0]}",
        **parts,
    )


def _parts(a: Run | None, b: Run, rules: ReportRules) -> dict[str, Any]:
    """What the template shows of two runs."""
    questions = asked(rules, b.metrics)
    before, now = measured(a.metrics) if a else RunFigures({}, {}, {}), measured(b.metrics)
    another = a is not None and _signals(a) != _signals(b)
    loops = []
    for loop in loops_of(b):
        rows = [
            _row(one, before.figures.get(loop, {}).get(one.key), now.figures.get(loop, {}).get(one.key))
            for one in questions[loop]
        ]
        if another and loop == "temperature":
            rows = [row | {"change": "another machine", "moved": False} for row in rows]
        # by run whose figures they are, with the verdict
        names = [run.controllers.get(loop) for run in (before, now)]
        loops.append(
            (
                {
                    "loop": loop,
                    "who": [heading(name) if name else "" for name in names],
                    "verdicts": [run.verdicts.get(loop, "") for run in (before, now)],
                },
                rows,
            )
        )
    differing = list(changed_parameters(a.parameters, b.parameters)) if a else []
    return {
        "names": (a.name if a else "Accepted run", b.name),
        "loops": loops,
        "another": ANOTHER if another else "",
        "compared": a is not None,
        "parameters": differing[:MOST_PARAMETERS],
        "more": max(len(differing) - MOST_PARAMETERS, 0),
        "panels": _panels(*(curves_of(run.curves if run else {}, loops_of(b)) for run in (a, b))),
        "kept": bool(a and a.curves),
    }


def loops_of(run: Run) -> list[str]:
    """The loops that are on."""
    switches = run.parameters.get("loops")
    return [loop for loop in LOOPS if not isinstance(switches, dict) or switches.get(loop) is not False]


def curves_of(drawn: Mapping[str, Curve], loops: Sequence[str]) -> dict[str, Curve]:
    """The curves of these loops: their names begin with the loop."""
    return {name: curve for name, curve in drawn.items() if name.partition(":")[0].lower() in loops}


def _signals(run: Run) -> list[set]:
    """The names of the machine's inputs and of its outputs."""
    plant = run.parameters.get("plant")
    return [
        {signal.get("name") for signal in (plant or {}).get(kind) or [] if isinstance(signal, dict)}
        for kind in ("inputs", "outputs")
    ]


# ---- figures


def _row(question: Question, before: Figure | None, now: Figure | None) -> dict[str, Any]:
    bound = "at least" if question.at_least else "at most"
    limit = with_unit(question.limit, question.unit, declared(question.limit))
    text, moved = _change(question, before, now)
    places = places_of(question, [figure for figure in (before, now) if figure])
    return {
        "title": question.title,
        "limit": f"{bound} {limit}" if np.isfinite(question.limit) else "none",
        "cells": (_cell(question, before, places), _cell(question, now, places)),
        "change": text,
        "moved": moved,
    }


def _cell(question: Question, figure: Figure | None, places: int) -> dict[str, Any]:
    if figure is None:
        return {"text": "not measured", "band": "", "bad": False}
    ends = band(figure.low, figure.high, places, beyond=question.beyond)
    return {
        "text": quantity(figure.value, question.unit, places, beyond=question.beyond),
        "band": ends or "no band",
        "bad": state(question, figure) == FAILED,
    }


def _change(question: Question, before: Figure | None, now: Figure | None) -> tuple[str, bool]:
    """How a figure moved, and whether beyond its noise; only a figure with a band can be better or worse."""
    if before is None or now is None:
        return "nothing to compare", False
    if before[:3] != now[:3] and (before.low == before.high or now.low == now.high):
        size = now.value - before.value
        if not np.isfinite(size):
            return "changed, noise unknown", False
        unit = "points" if question.unit == "%" else question.unit
        by = f"{'+' if size > 0 else MINUS}{short(abs(size))}{THIN + unit if unit else ''}"
        return f"{by}, noise unknown", False
    moved = move(question, before, now)
    return moved.text(), moved.moved


# ---- curves


def _panels(before: Mapping[str, Curve], now: Mapping[str, Curve]) -> list[dict[str, Any]]:
    return [_panel(name, before.get(name), now.get(name)) for name in dict.fromkeys([*now, *before])]


def _panel(name: str, before: Curve | None, now: Curve | None) -> dict[str, Any]:
    """This run's curve is solid, the accepted run's grey and dashed."""
    drawn = [(curve, css) for curve, css in ((before, "line thin dash"), (now, "line")) if curve]
    x, y = (np.concatenate([curve[end] for curve, _ in drawn]) for end in "xy")
    frame = charts.Frame(charts.linear(float(x.min()), float(x.max())), _scale(y), 340, 140, 44, 30, 22)
    shown = drawn[-1][0]
    ends = [f"{'accepted run' if 'dash' in css else 'this run'} {curve['y'][-1]:g}" for curve, css in drawn]
    return {
        "title": name,
        "svg": charts.panel(
            frame,
            [charts.line(frame, curve["x"], curve["y"], css) for curve, css in drawn],
            alt=f"{name}, last value: {', '.join(ends)}",
            css="mb wide",
            title=f"{shown['up']}{', log' if frame.y.log else ''}",
            across=shown["across"],
        ),
    }


def _scale(values: np.ndarray) -> charts.Axis:
    """Decades if the values span more than fifty to one, else linear."""
    low, high = float(values.min()), float(values.max())
    if low > 0 and high > 50 * low:
        return charts.logarithmic(low, high)
    room = 0.06 * (high - low)
    return charts.linear(low - room, high + room)
