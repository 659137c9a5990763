"""The page of the temperature loop: verdict, the pair, the scorecard, three pictures, findings, the record,
words."""

from typing import Any

from pipeline.report.shared import charts, headline, page, words
from pipeline.report.shared.difference import accepted_on
from pipeline.report.shared.pictures import Picture, PictureColumn, as_picture
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature import pictures, scorecard
from pipeline.report.temperature.card import deciding
from pipeline.report.temperature.judgement import Judgement, heads, verdict_parts
from pipeline.verdict.controllers import BY_NAME, heading
from pipeline.verdict.digits import THIN, short
from pipeline.verdict.evidence import entry, gap_of, need, need_figure, or_empty, or_none
from pipeline.verdict.identification import flagged_sentence
from pipeline.verdict.temperature import comparison, refused
from pipeline.verdict.temperature import names as names_judged
from pipeline.verdict.verdict import PASSED, UNJUDGED, Figure, Missing, Question, state
from pipeline.verdict.wording import banded, limit_text, places_of, worded

WORDS = (
    "verdict",
    "pair",
    "quantile",
    "settled",
    "peak",
    "settling",
    "heating",
    "overshoot",
    "at_limits",
    "cost",
    "crossings",
    "false_stops",
    "margin_disk",
    "margin_delay",
    "spread",
    "data",
    "step",
    "hash",
)


@as_picture("worst-zone", "The case that decides: error of the worst zone")
def worst_zone(sources: Sources, judged: Judgement) -> Picture:
    """The controllers over one another in the case that decides: the error of the worst zone."""
    found = need(deciding(sources, judged, (566, 230)))
    column = PictureColumn("", "", "", [found.drawn])
    return Picture(found.finding, [column], found.key, found.origin)


def render(sources: Sources, judged: Judgement) -> str:
    """The text of temperature.html."""
    contestants = [
        name for name in (*names_judged(sources.metrics), *refused(sources.metrics)) if name in BY_NAME
    ]
    return page.render(
        "temperature.html",
        here="temperature",
        sources=sources,
        title=f"Temperature: {judged.verdict.decision.rstrip('.')}",
        verdict=verdict_parts(judged, claim=headline.claim(sources, ("temperature",))),
        answers=answer_rows(sources, judged),
        setting=scorecard.setting(comparison(sources.metrics)),
        heads=heads((judged.subject, judged.rival)),
        drift=judged.drifted,
        drift_state=drift_state(judged),
        accepted_on=accepted_on(sources),
        pair=judged.pair,
        best=judged.best,
        deciding=judged.deciding,
        scorecard=scorecard.scorecard(sources, judged, words.ANSWERS_WORDS),
        infeasible=scorecard.infeasible(sources),
        at_work=[worst_zone(sources, judged), pictures.plants(sources), pictures.record_length(sources)],
        findings=findings(sources),
        record=pictures.record(sources),
        flaws=pictures.flaws(sources),
        panel=scorecard.declared_panel(sources),
        weights=scorecard.weights(sources),
        trusted=sources.model,
        words=words.chosen(sources, (*dict.fromkeys(contestants), *WORDS)),
        from_scorecard=sources.source("evaluate_temperature", "cases"),
        from_quality=sources.source("quality"),
        from_weights=sources.source("weights"),
        from_model=sources.source("identify_plant", "plant"),
    )


def findings(sources: Sources) -> list[tuple[str, str]]:
    """What a reader should take away, each with its figure; a figure
    that was not measured is said to be so."""
    claims = [*_still(sources), _flagged(sources), _printer(sources)]
    units = sources.declared.machine.sample_time_s
    if sources.declared.everything.get("generate_probing", {}).get("source") == "simulated":
        claims += [
            (
                "Units are our convention.",
                "The study names no unit of time and none of duty. "
                f"Here a step is {units:g}{THIN}s and inputs are in per cent; read seconds as steps.",
            ),
            (
                "The probing is simulated, the judging is separate.",
                "The record comes from the study’s machine, simulated within limits; every contestant is "
                "judged on plants that nothing was fitted to. Nothing here is a claim about a real printer.",
            ),
        ]
    return [item for item in claims if item]


@or_empty
def _still(sources: Sources) -> list[tuple[str, str]]:
    """The zones that ingest left out of the design, and what would let them be judged."""
    quality = need(sources.tables["quality"])
    messages = quality["message"][quality["kind"] == "still"]
    return [(f"{message.partition(':')[0]} is not judged.", f"{message}.") for message in messages]


def _flagged(sources: Sources) -> tuple[str, str] | None:
    """A word where controllers are designed from a model with gains that physics forbids."""
    gains = entry(sources.metrics["identify_plant"], "forbidden_gains")
    if not gains:
        return None
    certain = any(gain["certain"] for gain in gains)
    return (
        f"The controllers are designed from a model that physics {'forbids' if certain else 'may forbid'}.",
        f"{flagged_sentence(gains)} "
        + (
            "Put none of them to the machine before that is explained."
            if certain
            else "Watch that effect when one of them takes over."
        ),
    )


@or_none
def _printer(sources: Sources) -> tuple[str, str] | None:
    """The printer's own PID, where a recording tells it, and where it stands beside the others."""
    own = need_figure(sources.tables["printer_pid"], "heaters")
    gains = [
        f"{pid['input']} by Kp {short(pid['Kp'])}, Ki {short(pid['Ki'])}, Kd {short(pid['Kd'])}"
        for pid in own
    ]
    holds = f"The printer holds {'; '.join(gains)}, in % of duty, °C and s."
    simc = "The page of the identification sets it beside one by SIMC."
    evaluated = sources.metrics["evaluate_temperature"]
    if entry(evaluated, "contestants", "printer_pid") is None:
        reason = entry(evaluated, "refused", "printer_pid")
        why = f"It was refused: {reason}." if reason else "It was not judged."
        return "The printer’s own PID is not among these contestants.", f"{holds} {why} {simc}"
    return (
        "The printer’s own PID is among these contestants, as it is.",
        f"{holds} It runs once in {sources.declared.machine.sample_time_s:g}{THIN}s here, as often as the "
        f"others, and in Klipper every 0.3{THIN}s. It is told no model and is not tuned. "
        f"{_held_stable(evaluated)}{simc}",
    )


def _held_stable(evaluated: Any) -> str:
    """A sentence where the printer's own PID does not hold every plant stable."""
    plants = entry(evaluated, "contestants", "printer_pid", "stable")
    if not plants or plants["count"] == plants["of"]:
        return ""
    return (
        f"It holds {plants['count']} of {plants['of']} plants stable: look whether the recorded duty swings "
        "between its limits. At Klipper’s own rate a loop near the edge may hold. "
    )


def answer_rows(sources: Sources, judged: Judgement) -> list[dict[str, Any]]:
    unmoved = "other machine" if sources.another_machine else "first run"
    return [_row(question, judged, unmoved) for question in judged.asked]


def _row(question: Question, judged: Judgement, unmoved: str) -> dict[str, Any]:
    """`unmoved`: why nothing is compared, where nothing is."""
    pair = [(name, judged.answers[name][question.key]) for name in (judged.subject, judged.rival)]
    places = places_of(question, [figure for _, figure in pair])
    move = next((m for m in judged.moved.get(judged.subject, []) if m.question.key == question.key), None)
    moved = move is not None and move.moved
    mine, other = (_state(question, figure) for _, figure in pair)
    return {
        "n": question.answer,
        "key": question.key,
        "title": question.title,
        "word": words.explaining(question.key),
        "sub": SUB.get(question.key, ""),
        "cells": [_cell(question, name, figure, places) for name, figure in pair],
        "limit": "none" if question.key in COUNTED else limit_text(question) or "not resolved",
        "state": mine,
        "strip": charts.strip(question, [(heading(name), page.MARKS.get(name, "bl"), f) for name, f in pair]),
        "change": move.text() if move else unmoved,
        "moved": moved,
        "worse": moved and move.word == "worse" and mine != PASSED,
        "quiet": mine == other == PASSED and not moved,
    }


def _state(question: Question, figure: Figure | Missing) -> str:
    """A contestant that learns nothing needs no data."""
    gap = gap_of(figure)
    return PASSED if gap and gap.state == UNJUDGED else state(question, figure)


# cases that are counted: none are allowed
COUNTED = ("crossings", "supervisor")
SUB = {
    "at_limits": "clipped commands",
    "disk": "weakest tenth of plants",
    "delay_s": "weakest tenth of plants",
}


def _cell(question: Question, name: str, figure: Figure | Missing, places: int) -> dict[str, Any]:
    cell = {
        "css": page.MARKS.get(name, "bl"),
        "name": heading(name),
        "state": _state(question, figure),
        "mark": name,
        "missing": None,
        "value": "",
        "band": "",
    }
    if isinstance(figure, Missing):
        return cell | {"missing": figure}
    fraction = figure.note.split(" samples")[0].replace(" of ", " / ")
    return cell | {
        "value": worded(question, figure.value, places),
        "band": fraction if question.key in ("data", *COUNTED) else banded(question, figure, places),
    }


def drift_state(judged: Judgement) -> str:
    """Passed where the nightly job measured drift and found none, otherwise its word for it."""
    answer = judged.drifted.answer
    return gap.state if (gap := gap_of(answer)) else PASSED
