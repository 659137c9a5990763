"""The answers of the temperature loop, a row each: the contestant that the verdict is about beside its rival,
the limit, and how the figure moved since the accepted run."""

from typing import Any

from pipeline.report.shared import charts, page, words
from pipeline.report.shared.sources import Sources
from pipeline.report.temperature.judgement import Judgement
from pipeline.verdict.controllers import heading
from pipeline.verdict.evidence import gap_of
from pipeline.verdict.verdict import PASSED, UNJUDGED, Figure, Missing, Question, state
from pipeline.verdict.wording import banded, limit_text, places_of, worded


def rows(sources: Sources, judged: Judgement) -> list[dict[str, Any]]:
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
