"""Page one: the verdict, the twelve answers, a card a loop, the difference, words, provenance."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from pipeline.report import charts, page, words
from pipeline.report.answers import CONTROLLERS, LABELS, all_answers, featured, repetitions
from pipeline.report.difference import Difference, Move, difference, moves
from pipeline.report.digits import THIN, band, count, decimals, number, quantity
from pipeline.report.sources import Sources, Table, digest
from pipeline.report.verdict import ANSWERS, FAILED, OPEN, PASSED, ROLES, UNDECIDED, Figure, Missing, Question, Verdict, decide, outcomes, questions, state

NAMES = {"data_driven": "Data\u2011driven", "model_based": "Model\u2011based", "baseline": "Baseline"}


class Judgement(NamedTuple):
    """What both pages say: questions, answers by controller and by role, the verdict, and the difference."""

    asked: list[Question]
    by_name: Mapping[str, Mapping[str, Figure | Missing]]
    roles: Mapping[str, Mapping[str, Figure | Missing]]
    verdict: Verdict
    changed: Difference | None
    moved: Mapping[str, list[Move]]


def judgement(sources: Sources) -> Judgement:
    asked = questions(sources.declared.rules, band_degC=sources.declared.panel.band_degC)
    by_name = all_answers(sources, asked)
    roles = {role: by_name[name] for role, name in CONTROLLERS.items()}
    changed = difference(sources)
    moved = {role: moves(sources, asked, CONTROLLERS[role], roles[role]) for role in ROLES} if changed else {}
    return Judgement(asked, by_name, roles, decide("temperature", asked, roles), changed, moved)


def shown(judged: Judgement) -> dict[str, dict[str, dict[str, float | None]]]:
    """The figures of the pages as numbers, for the metrics: later runs are held against them."""
    return {
        name: {key: {"median": _plain(f.value), "low": _plain(f.low), "high": _plain(f.high)} for key, f in answers.items() if isinstance(f, Figure)}
        for name, answers in judged.by_name.items()
    }


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None


def render(sources: Sources, judged: Judgement) -> str:
    """reports/index.html."""
    return page.render(
        "index.html", title=_title(judged.verdict), verdict=verdict_parts(judged), answers=_rows(judged), repetitions=repetitions(sources), seeds=len(sources.declared.panel.judging.seeds),
        change=_change_sentence(judged, sources.accepted), hashes=hashes(sources), cards=[_card(sources, judged), *_unbuilt()], difference=difference_parts(sources, judged),
        words=words.chosen(sources, words.INDEX), sources=list(sources.read.values()), code=sources.code, here="index",
    )  # fmt: skip


def _title(verdict: Verdict) -> str:
    return verdict.decision.rstrip(".") + (f": first {'failed' if verdict.state == FAILED else 'open'} rule {verdict.rule}" if verdict.rule else "")


# ---- the verdict


def verdict_parts(judged: Judgement) -> dict[str, Any]:
    """Decision, reason and remedy, and the five rules for the two controllers that compete."""
    found = {role: outcomes(judged.asked, judged.roles[role]) for role in ("data_driven", "model_based")}
    table = [
        {"rule": rule[:1].upper() + rule[1:], "answers": ANSWERS[rule], "states": [found[role][i].state for role in found], "first": rule == judged.verdict.rule}
        for i, rule in enumerate(ANSWERS)
    ]
    changed = judged.changed.parameters if judged.changed else []
    return {
        "state": {FAILED: "failed", OPEN: "open", PASSED: "passed"}[judged.verdict.state], "decision": judged.verdict.decision, "lead": judged.verdict.lead,
        "reason": judged.verdict.reason, "remedy": judged.verdict.remedy, "rules": table,
        "changed": f"{count(len(changed), 'parameter').capitalize()} changed since the accepted run" if changed else "",
    }  # fmt: skip


# ---- the answers


def _rows(judged: Judgement) -> list[dict[str, Any]]:
    return [_row(question, judged) for question in judged.asked]


def _row(question: Question, judged: Judgement) -> dict[str, Any]:
    pair = [(role, judged.roles[role][question.key]) for role in ("data_driven", "model_based")]
    places = row_places(question, [figure for _, figure in pair])
    move = next((m for m in judged.moved.get("data_driven", []) if m.question == question), None)
    return {
        "n": question.answer, "key": question.key, "title": question.title, "sub": _sub(question, pair), "cells": [_cell(question, role, figure, places) for role, figure in pair],
        "limit": f"{'≥' if question.at_least else '≤'} {quantity(question.limit, question.unit, places)}", "state": state(question, pair[0][1]),
        "strip": charts.strip(question, [(ROLES[role], page.MARKS[role], figure) for role, figure in pair]),
        "change": move.text() if move else "first run", "moved": bool(move and move.moved), "worse": bool(move and move.moved and move.word == "worse"),
        "quiet": state(question, pair[0][1]) == PASSED and state(question, pair[1][1]) == PASSED and not (move and move.moved),
    }  # fmt: skip


def row_places(question: Question, figures: Sequence[Figure | Missing]) -> int:
    """One number of decimals for a row: what the widest band supports, but enough to show the smallest value at all."""
    mine = [(f, decimals(f.low, f.high, value=f.value)) for f in figures if isinstance(f, Figure)]
    if question.key == "data":
        return 0 if all(f.value >= 10 for f, _ in mine) else 2
    if not mine:
        return decimals(0, 0, value=question.limit)
    places = min(found for _, found in mine)
    return max([places, *(found for f, found in mine if f.value and round(f.value, places) == 0)])


def _sub(question: Question, pair: Sequence[tuple[str, Figure | Missing]]) -> str:
    notes = list(dict.fromkeys(figure.note for _, figure in pair if isinstance(figure, Figure)))
    if question.key == "settled_error_degC":
        return ", ".join(filter(None, [notes[0] if notes else "", *(n.removeprefix("zone ") for n in notes[1:])]))
    return {"gap_percent": "", "at_limits_percent": "clipped commands", "disk": "more is safer", "delay_s": "more is safer"}.get(question.key, "")


def _cell(question: Question, role: str, figure: Figure | Missing, places: int) -> dict[str, Any]:
    found = state(question, figure)
    cell = {"css": page.MARKS[role], "name": NAMES[role], "state": found, "missing": figure if isinstance(figure, Missing) else None}
    if isinstance(figure, Figure):
        cell["value"] = quantity(figure.value, question.unit, places, beyond=question.beyond)
        cell["band"] = figure.note.split(" samples")[0] if question.key == "data" else band(figure.low, figure.high, places, beyond=question.beyond)
    return cell


def _change_sentence(judged: Judgement, accepted: dict | Missing | None) -> dict[str, str]:
    """Answer 3."""
    if isinstance(accepted, Missing):
        return {"strong": "The accepted run cannot be read.", "text": accepted.sentence()}
    if judged.changed is None:
        return {"strong": "First run: nothing to compare with.", "text": "./run beadline accept marks this one as good."}
    found = [move for move in judged.moved["data_driven"] if move.moved]
    if not found:
        unchanged = judged.changed.empty and all(move.word in ("unchanged", "not measured", "failed") for move in judged.moved["data_driven"])
        return {"strong": "Nothing changed; no figure moved." if unchanged else "No figure moved beyond its noise.", "text": ""}
    said = ", ".join(f"{move.question.title[:1].lower()}{move.question.title[1:]} {move.word}" for move in found)
    return {"strong": f"{len(found)} of {len(judged.asked)} figures moved beyond their noise:", "text": f"{said}."}


def hashes(sources: Sources) -> list[tuple[str, str]]:
    """Short digests by which two pages can be told to be of one run."""
    data, figures = (next((s.sha256 for path, s in sources.read.items() if path.endswith(end)), "missing") for end in ("ingest/record.parquet", "evaluate_temperature/scorecard.parquet"))
    return [("data", data[:8]), ("parameters", digest(sources.declared.everything)[:8]), ("code", sources.code[:8]), ("scorecard", figures[:8])]


# ---- the cards


def _card(sources: Sources, judged: Judgement) -> dict[str, Any]:
    order = ("model_based", "data_driven", "baseline")
    answers, rules = judged.roles, sources.declared.rules
    rows = []
    for key in ("settled_error_degC", "gap_percent", "settling_s"):
        question = next(q for q in judged.asked if q.key == key)
        rows.append({"title": question.title, "cells": _card_cells(question, [answers[role][key] for role in order])})
    kernel = judged.by_name.get("kernel", {}).get("gap_percent")
    return {
        "id": "temperature", "name": "Temperature", "link": "temperature.html", "moves": "Heaters and motor to barrel temperatures",
        "state": f"Run {ROLES[judged.verdict.winner]}" if judged.verdict.winner else "Run none of them", "mark": judged.verdict.winner, "win": _win(judged),
        "caption": f"Worst zone’s true error over {_SPAN} s, log scale {number(_FLOOR, 3)} to {number(_CEILING, 0)}\u00a0°C: {featured(sources)}. Grey: what the rule allows once settled.",
        "panels": [_spark(sources, judged, role, limit=rules.settled_error_degC, named=i == 0) for i, role in enumerate(order)],
        "heads": [{"mark": role, "name": LABELS[CONTROLLERS[role]][0], "method": LABELS[CONTROLLERS[role]][1]} for role in order], "rows": rows,
        "note": _kernel_note(kernel, sources), "missing": None,
    }  # fmt: skip


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
        cells.append({"text": text, "best": text == quantity(best, question.unit, mine) and math.isfinite(best), "bad": state(question, figure) == FAILED})
    return cells


def _win(judged: Judgement) -> tuple[str, str]:
    """The winner in words, with its figure and its price."""
    best = judged.verdict.winner
    settled = next(q for q in judged.asked if q.key == "settled_error_degC")
    if best is None:
        return "None wins.", "No controller passes its rules."
    mine = judged.roles[best]["settled_error_degC"]
    places = row_places(settled, [mine])
    holds = f"It holds every zone within {quantity(mine.high, '°C', places)} of its reference."
    others = []
    for role in ("data_driven", "model_based", "baseline"):
        if role != best:
            failed = [o for o in outcomes(judged.asked, judged.roles[role]) if o.state in (FAILED, UNDECIDED, OPEN) and o.rule != "drift"]
            if failed and failed[0].question:
                others.append(f"{NAMES[role]} {'fails' if failed[0].state == FAILED else 'is open'} on {_on(failed[0].question, judged.roles[role])}.")
            else:
                others.append(f"{NAMES[role]} passes too.")
    return f"{'The b' if best == 'baseline' else NAMES[best][:1]}{'aseline' if best == 'baseline' else NAMES[best][1:]} wins.", " ".join([holds, *others])


def _on(question: Question, answers: Mapping[str, Figure | Missing]) -> str:
    figure = answers[question.key]
    name = {"worst_case_gap_percent": "its worst plant", "gap_percent": "the gap", "data": "data"}.get(question.key, question.title[:1].lower() + question.title[1:])
    if isinstance(figure, Missing):
        return f"{name}, {figure.state}"
    places = min(decimals(figure.low, figure.high, value=figure.value), 2)
    return f"{name}: {quantity(figure.value, question.unit, places, beyond=question.beyond)} of {quantity(question.limit, question.unit, 0 if question.limit >= 10 else places)}"


_SPAN, _FLOOR, _CEILING = 60, 0.01, 300.0


def _spark(sources: Sources, judged: Judgement, role: str, *, limit: float, named: bool) -> Markup:
    table = sources.tables["trajectories"]
    figure = judged.roles[role]["settled_error_degC"]
    error = _worst_error(sources, table, CONTROLLERS[role])
    if isinstance(error, Missing):
        return Markup('<div class="hole">{}</div>').format(page.missing(error))
    time, values = error
    said = "not judged" if isinstance(figure, Missing) else f"settled error {quantity(figure.value, '°C', 3)}"
    alt = f"{ROLES[role].capitalize()}: worst zone {number(float(values[-1]), 2)} °C from its reference after {number(float(time[-1]), 0)} s, {'above' if values[-1] > limit else 'below'} the {limit:g} °C limit; {said}"
    return charts.spark(
        time, values, charts.Axis(_FLOOR, _CEILING, (), True), css=page.MARKS[role], limit=limit, alt=alt, named=named, bad=values[-1] > limit, limit_label=f"limit {limit:g}"
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
    noise = f"Simulated plants on which nothing was fitted." if sources.declared.everything.get("generate_probing", {}).get("source") == "simulated" else "Judged on plants of the identified spread."
    if isinstance(gap, Figure):
        return f"Algorithm 2’s kernel, learned from the same record, costs {quantity(gap.value, '%', decimals(gap.low, gap.high, value=gap.value))} more than the optimum: see the temperature page. {noise}"
    learned = sources.metrics["learn_kernel"]
    refused = learned.get("refused") if isinstance(learned, dict) else None
    return f"Algorithm 2’s kernel failed: {refused}" if refused else f"Algorithm 2’s kernel: not measured. {noise}"


def _unbuilt() -> list[dict[str, Any]]:
    """Loops that no stage measures yet: the same frame, and the sentence in it."""
    heads = {
        "deposition": ("Deposition", "Plunger command to flow at the nozzle", ("library + priority", "basis functions", "on-off control"), "train_ilc, segment_library, compose_parts"),
        "setpoint": ("Setpoint", "Nozzle camera to flow and temperature setpoints", ("Bayes filter", "Q-learning agent", "sequential test"), "train_classifier, train_agent, evaluate_setpoint"),
    }  # fmt: skip
    cards = []
    for key, (name, moved, methods, stages) in heads.items():
        order = ("model_based", "data_driven", "baseline")
        cards.append({
            "id": key, "name": name, "link": "", "moves": moved, "state": "Not measured", "mark": None, "win": ("Not measured.", f"Its stages are not built yet: {stages}."), "caption": "Nothing is shown before it is measured.",
            "panels": [Markup('<div class="hole">{}not measured</div>').format(page.glyph(OPEN)) for _ in order],
            "heads": [{"mark": role, "name": LABELS[CONTROLLERS[role]][0], "method": method} for role, method in zip(order, methods, strict=True)], "rows": [], "note": "No figure, so no claim.", "missing": True,
        })  # fmt: skip
    return cards


# ---- the difference


def difference_parts(sources: Sources, judged: Judgement) -> dict[str, Any]:
    """What changed, and the figures that moved, of both controllers."""
    accepted, changed = sources.accepted, judged.changed
    if isinstance(accepted, Missing) or changed is None:
        return {"accepted": "", "missing": accepted if isinstance(accepted, Missing) else None, "moved": [], "rest": [], "changed": None, "empty": False}
    moved = []
    for role in ("data_driven", "model_based"):
        for move in judged.moved[role]:
            if move.moved:
                places = row_places(move.question, [move.before, move.now])
                limit = quantity(move.question.limit, move.question.unit, places)
                moved.append({
                    "title": move.question.title, "role": role, "name": NAMES[role], "word": move.word, "worse": move.word == "worse",
                    "before": quantity(move.before.value, move.question.unit, places, beyond=move.question.beyond),
                    "now": quantity(move.now.value, move.question.unit, places, beyond=move.question.beyond),
                    "svg": charts.before_and_now(move.question, page.MARKS[role], move.before, move.now, limit),
                })  # fmt: skip
    rest: dict[str, list[str]] = {}
    for move in judged.moved["data_driven"]:
        if not move.moved:
            rest.setdefault(move.word, []).append(move.question.title[:1].lower() + move.question.title[1:])
    still = [f"{word[:1].upper()}{word[1:]}: {', '.join(names)}." for word, names in rest.items()]
    return {"accepted": changed.accepted, "missing": None, "moved": moved, "rest": [*still, "Not measured in either run: drift."], "changed": changed, "empty": changed.empty and not moved}
