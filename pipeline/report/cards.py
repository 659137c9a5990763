"""A card a loop: the winner in words, three small multiples on one scale, three figures. A loop that is not built yet keeps its frame."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report import charts, page
from pipeline.report.answers import CONTROLLERS, LABELS, featured
from pipeline.report.digits import decimals, number, quantity
from pipeline.report.judgement import NAMES, Judgement
from pipeline.report.model import trust
from pipeline.report.sources import Sources, Table
from pipeline.report.verdict import FAILED, OPEN, ROLES, UNDECIDED, Figure, Missing, Question, outcomes, row_places, state


def temperature(sources: Sources, judged: Judgement) -> dict[str, Any]:
    order = ("model_based", "data_driven", "baseline")
    answers, rules = judged.roles, sources.declared.rules
    rows = []
    for key in ("settled_error_degC", "gap_percent", "settling_s"):
        question = next(q for q in judged.asked if q.key == key)
        rows.append({"title": question.title, "cells": _card_cells(question, [answers[role][key] for role in order])})
    kernel = judged.by_name.get("kernel", {}).get("gap_percent")
    return {
        "id": "temperature",
        "name": "Temperature",
        "link": "temperature.html",
        "moves": "Heaters and motor to barrel temperatures",
        "state": f"Run {ROLES[judged.verdict.winner]}" if judged.verdict.winner else "Run none of them",
        "mark": judged.verdict.winner,
        "win": _win(judged),
        "caption": (
            f"Worst zone’s true error over {_SPAN} s, log scale {_FLOOR:g} to {number(_CEILING, 0)}\u00a0°C: "
            f"{featured(sources)}. Grey: what the rule allows once settled."
        ),
        "panels": [_spark(sources, judged, role, limit=rules.settled_error_degC, named=i == 0) for i, role in enumerate(order)],
        "heads": [{"mark": role, "name": LABELS[CONTROLLERS[role]][0], "method": LABELS[CONTROLLERS[role]][1]} for role in order],
        "rows": rows,
        "note": _kernel_note(kernel, sources),
        "model": trust(sources),
        "missing": None,
    }


def _card_cells(question: Question, figures: Sequence[Figure | Missing]) -> list[dict[str, Any]]:
    places = row_places(question, figures[:2])
    values = [f.value if isinstance(f, Figure) else math.inf for f in figures]
    best = min(values)
    cells = []
    for figure, value in zip(figures, values, strict=True):
        if isinstance(figure, Missing):
            cells.append({"text": figure.state, "best": False, "bad": False})
            continue
        mine = min(places, decimals(0, 0, value=value)) if math.isfinite(value) else places
        text = quantity(value, question.unit, mine, beyond=question.beyond)
        cells.append(
            {
                "text": text,
                "best": text == quantity(best, question.unit, mine) and math.isfinite(best),
                "bad": state(question, figure) == FAILED,
            }
        )
    return cells


def _win(judged: Judgement) -> tuple[str, str]:
    """The winner in words, with its figure and its price."""
    best = judged.verdict.winner
    settled = next(q for q in judged.asked if q.key == "settled_error_degC")
    if best is None:
        return "No controller wins.", "Not one of them passes its rules."
    mine = judged.roles[best]["settled_error_degC"]
    places = row_places(settled, [mine])
    holds = f"It holds every zone within {quantity(mine.high, '°C', places)} of its reference."
    others = []
    for role in ("data_driven", "model_based", "baseline"):
        if role != best:
            failed = [o for o in outcomes(judged.asked, judged.roles[role]) if o.state in (FAILED, UNDECIDED, OPEN) and o.rule != "drift"]
            if failed and failed[0].question:
                others.append(
                    f"{NAMES[role]} {'fails' if failed[0].state == FAILED else 'is open'} on {_on(failed[0].question, judged.roles[role])}."
                )
            else:
                others.append(f"{NAMES[role]} passes too.")
    return f"{'The b' if best == 'baseline' else NAMES[best][:1]}{'aseline' if best == 'baseline' else NAMES[best][1:]} wins.", " ".join(
        [holds, *others]
    )


def _on(question: Question, answers: Mapping[str, Figure | Missing]) -> str:
    figure = answers[question.key]
    name = {"worst_case_gap_percent": "its worst plant", "gap_percent": "the gap", "data": "data"}.get(
        question.key, question.title[:1].lower() + question.title[1:]
    )
    if isinstance(figure, Missing):
        return f"{name}, {figure.state}"
    places = min(decimals(figure.low, figure.high, value=figure.value), 2)
    return (
        f"{name}: {quantity(figure.value, question.unit, places, beyond=question.beyond)} of "
        f"{quantity(question.limit, question.unit, 0 if question.limit >= 10 else places)}"
    )


_SPAN, _FLOOR, _CEILING = 60, 0.01, 300.0


def _spark(sources: Sources, judged: Judgement, role: str, *, limit: float, named: bool) -> Markup:
    table = sources.tables["trajectories"]
    figure = judged.roles[role]["settled_error_degC"]
    error = _worst_error(sources, table, CONTROLLERS[role])
    if isinstance(error, Missing):
        return Markup('<div class="hole">{}</div>').format(page.missing(error))
    time, values = error
    said = "not judged" if isinstance(figure, Missing) else f"settled error {quantity(figure.value, '°C', 3)}"
    alt = (
        f"{ROLES[role].capitalize()}: worst zone {number(float(values[-1]), 2)} °C from its reference "
        f"after {number(float(time[-1]), 0)} s, {'above' if values[-1] > limit else 'below'} the {limit:g} "
        f"°C limit; {said}"
    )
    return charts.spark(
        time,
        values,
        charts.Axis(_FLOOR, _CEILING, (), True),
        css=page.MARKS[role],
        limit=limit,
        alt=alt,
        named=named,
        bad=values[-1] > limit,
        limit_label=f"limit {limit:g}",
    )


def _worst_error(sources: Sources, table: Table | Missing, name: str) -> tuple[np.ndarray, np.ndarray] | Missing:
    if isinstance(table, Missing):
        return table
    rows = (table["controller"] == name) & (table["mode"] == "deployed")
    if not rows.any():
        return Missing("not measured", f"no trajectory of {name}")
    offset = sources.declared.panel.judging.reference_offsets_degC[0]
    errors = np.stack([np.abs(table[o.name][rows] - o.reference - offset) for o in sources.declared.machine.outputs])
    time = table["time_s"][rows]
    return time[time <= _SPAN], errors.max(axis=0)[time <= _SPAN]


def _kernel_note(gap: Figure | Missing | None, sources: Sources) -> str:
    noise = (
        "Simulated plants on which nothing was fitted."
        if sources.declared.everything.get("generate_probing", {}).get("source") == "simulated"
        else "Judged on plants of the identified spread."
    )
    if isinstance(gap, Figure):
        return (
            "Algorithm 2’s kernel, learned from the same record, costs "
            f"{quantity(gap.value, '%', decimals(gap.low, gap.high, value=gap.value))} more than the optimum: "
            f"see the temperature page. {noise}"
        )
    learned = sources.metrics["learn_kernel"]
    refused = learned.get("refused") if isinstance(learned, dict) else None
    return f"Algorithm 2’s kernel failed: {refused}" if refused else f"Algorithm 2’s kernel: not measured. {noise}"


def unbuilt() -> list[dict[str, Any]]:
    """Loops that no stage measures yet: the same frame, and the sentence in it."""
    heads = {
        "deposition": (
            "Deposition",
            "Plunger command to flow at the nozzle",
            ("library + priority", "basis functions", "on-off control"),
            "train_ilc, segment_library, compose_parts",
        ),
        "setpoint": (
            "Setpoint",
            "Nozzle camera to flow and temperature setpoints",
            ("Bayes filter", "Q-learning agent", "sequential test"),
            "train_classifier, train_agent, evaluate_setpoint",
        ),
    }
    cards = []
    for key, (name, moved, methods, stages) in heads.items():
        order = ("model_based", "data_driven", "baseline")
        cards.append(
            {
                "id": key,
                "name": name,
                "link": "",
                "moves": moved,
                "state": "Not measured",
                "mark": None,
                "win": ("Not measured.", f"Its stages are not built yet: {stages}."),
                "caption": "Nothing is shown before it is measured.",
                "panels": [Markup('<div class="hole">{}not measured</div>').format(page.glyph(OPEN)) for _ in order],
                "heads": [
                    {"mark": role, "name": LABELS[CONTROLLERS[role]][0], "method": method}
                    for role, method in zip(order, methods, strict=True)
                ],
                "rows": [],
                "note": "No figure, so no claim.",
                "model": None,
                "missing": True,
            }
        )
    return cards
