"""Page one: the verdict, the twelve answers, a card a loop, the difference, words, provenance."""

from collections.abc import Sequence
from typing import Any

from pipeline.report.deposition import change as deposition_change
from pipeline.report.deposition import rules as deposition_rules
from pipeline.report.index import cards, workflow
from pipeline.report.setpoint import card as setpoint_card
from pipeline.report.setpoint import change as setpoint_change
from pipeline.report.shared import charts, headline, page, words
from pipeline.report.shared.difference import Difference, Move
from pipeline.report.shared.digits import band, count, decimals, declared, quantity
from pipeline.report.shared.sources import Sources, digest
from pipeline.report.shared.verdict import (
    OPEN,
    PASSED,
    ROLES,
    UNDECIDED,
    Figure,
    Missing,
    Question,
    row_places,
    state,
)
from pipeline.report.temperature import pairs
from pipeline.report.temperature.answers import repetitions
from pipeline.report.temperature.judgement import NAMES, Judgement
from pipeline.report.temperature.verdict import ANSWERS, BRIEF, drift_state


def render(sources: Sources, judged: Judgement) -> str:
    """The text of index.html."""
    loops, accepted = headline.loops(sources, judged), _accepted(sources)
    return page.render(
        "index.html",
        title=headline.decision(loops).rstrip("."),
        decision=headline.decision(loops),
        state=headline.state(loops),
        accepted_on=accepted.get("on", ""),
        accepted_at=accepted.get("commit", ""),
        loops=[
            loop._asdict()
            | {
                "reason": words.explained(sources, loop.reason),
                "remedy": words.explained(sources, loop.remedy),
            }
            for loop in loops
        ],
        claim=f"{headline.claim(sources)} {_drifts(judged)}",
        rules=verdict_parts(judged)["rules"],
        answers=_rows(judged),
        repetitions=repetitions(sources),
        seeds=len(sources.declared.panel.judging.seeds),
        change=_change_sentence(
            judged, sources.accepted, _deposition_moves(sources), setpoint_change.moved_cases(sources)
        ),
        drift=judged.drifted,
        drift_state=drift_state(judged.roles["data_driven"]),
        hashes=hashes(sources),
        cards=[
            cards.temperature(sources, judged),
            cards.deposition(sources),
            setpoint_card.setpoint(sources),
        ],
        paired=pairs.compared(sources)["finding"],
        difference=difference_parts(sources, judged),
        workflow=workflow.figure(sources),
        from_accepted=sources.source("accepted"),
        words=words.chosen(sources, words.INDEX),
        sources=list(sources.read.values()),
        absent=sources.absent,
        code=sources.code,
        here="index",
    )


def _accepted(sources: Sources) -> dict[str, str]:
    """The day on which the run was accepted, and the commit that was checked out; older files do not say."""
    found = sources.accepted if isinstance(sources.accepted, dict) else {}
    said = found.get("accepted")
    return (
        {key: str(said[key])[:40] for key in ("on", "commit") if key in said}
        if isinstance(said, dict)
        else {}
    )


def _drifts(judged: Judgement) -> str:
    """Drift of the three loops in a sentence; only the temperature loop's is measured, by the nightly job."""
    if drift_state(judged.roles["data_driven"]) in (OPEN, UNDECIDED):
        return "Drift is not measured in any loop."
    word = judged.drifted.word
    return f"Drift: temperature {word[:1].lower()}{word[1:].rstrip('.')}, not measured in the others."


# ---- the verdict


def verdict_parts(judged: Judgement) -> dict[str, Any]:
    """Decision, reason and remedy, and the five rules for the two controllers that compete."""
    table = [
        {
            "rule": learned.name[:1].upper() + learned.name[1:],
            "answers": ANSWERS[learned.name],
            "states": [learned.state, designed.state],
            "first": learned.name == judged.verdict.rule,
        }
        for learned, designed, _ in judged.verdict.rules
    ]
    changed = judged.changed.parameters if judged.changed else []
    return {
        "state": judged.verdict.word,
        "decision": judged.verdict.decision,
        "lead": judged.verdict.lead,
        "reason": judged.verdict.reason,
        "remedy": judged.verdict.remedy,
        "rules": table,
        "claim": "",
        "changed": f"{count(len(changed), 'parameter').capitalize()} changed since the accepted run"
        if changed
        else "",
    }


# ---- the answers


def _rows(judged: Judgement) -> list[dict[str, Any]]:
    return [_row(question, judged) for question in judged.asked]


def _row(question: Question, judged: Judgement) -> dict[str, Any]:
    pair = [(role, judged.roles[role][question.key]) for role in ("data_driven", "model_based")]
    places = row_places(question, [figure for _, figure in pair])
    move = next((m for m in judged.moved.get("data_driven", []) if m.question == question), None)
    return {
        "n": question.answer,
        "key": question.key,
        "title": question.title,
        "word": words.explaining(question.key),
        "sub": _sub(question, pair),
        "cells": [_cell(question, role, figure, places) for role, figure in pair],
        # as it was declared: "10.000 %" reads as ten thousand where a point parts thousands
        "limit": f"{'≥' if question.at_least else '≤'} "
        f"{quantity(question.limit, question.unit, declared(question.limit))}",
        "state": state(question, pair[0][1]),
        "strip": charts.strip(question, [(ROLES[role], page.MARKS[role], figure) for role, figure in pair]),
        "change": move.text() if move else "first run",
        "moved": bool(move and move.moved),
        "worse": bool(move and move.moved and move.word == "worse" and state(question, pair[0][1]) != PASSED),
        "quiet": state(question, pair[0][1]) == PASSED
        and state(question, pair[1][1]) == PASSED
        and not (move and move.moved),
    }


def _sub(question: Question, pair: Sequence[tuple[str, Figure | Missing]]) -> str:
    notes = list(dict.fromkeys(figure.note for _, figure in pair if isinstance(figure, Figure)))
    if question.key == "settled_error_degC":
        return ", ".join(
            filter(None, [notes[0] if notes else "", *(n.removeprefix("zone ") for n in notes[1:])])
        )
    return {
        "gap_percent": "",
        "at_limits_percent": "clipped commands",
        "disk": "more is safer",
        "delay_s": "more is safer",
    }.get(question.key, "")


def _cell(question: Question, role: str, figure: Figure | Missing, places: int) -> dict[str, Any]:
    found = state(question, figure)
    cell = {
        "css": page.MARKS[role],
        "name": NAMES[role],
        "state": found,
        "missing": figure if isinstance(figure, Missing) else None,
    }
    if isinstance(figure, Figure):
        cell["value"] = quantity(figure.value, question.unit, places, beyond=question.beyond)
        cell["band"] = (
            figure.note.split(" samples")[0].replace(" of ", " / ")
            if question.key == "data"
            else band(figure.low, figure.high, places, beyond=question.beyond) or _finer(figure, question)
        )
    return cell


def _finer(figure: Figure, question: Question) -> str:
    """A band that the row's decimals do not show, with those that do;
    runs that are all alike are said to be."""
    return (
        band(
            figure.low,
            figure.high,
            decimals(figure.low, figure.high, value=figure.value),
            beyond=question.beyond,
        )
        or "all alike"
    )


def _change_sentence(
    judged: Judgement, accepted: dict | Missing | None, parts: Sequence[Move], seen: tuple[int, int]
) -> dict[str, str]:
    """Answer 3: the figures of the temperature loop that moved, and how many of the other loops'."""
    if isinstance(accepted, Missing):
        return {"strong": "The accepted run cannot be read.", "text": accepted.sentence()}
    if judged.changed is None:
        return {
            "strong": "First run: nothing to compare with.",
            "text": "./run beadline accept marks this one as good.",
        }
    found = [move for move in judged.moved["data_driven"] if move.moved]
    others = sum(move.moved for move in parts), seen[0]
    elsewhere = (
        f"Deposition: {others[0]} of {len(parts)} moved. Setpoint: {others[1]} of {seen[1]}."
        if parts or seen[1]
        else ""
    )
    if not found:
        unchanged = judged.changed.empty and all(
            move.word in ("unchanged", "not measured", "failed") for move in judged.moved["data_driven"]
        )
        if unchanged and not any(others):
            return {"strong": "Nothing changed; no figure moved.", "text": ""}
        loop = "of this loop " if any(others) else ""
        return {
            "strong": f"No figure {loop}moved beyond its noise.",
            "text": f"{_inputs(judged.changed)} {elsewhere if any(others) else ''}".strip(),
        }
    groups = [
        (word, [BRIEF[move.question.key] for move in found if move.word == word])
        for word in ("worse", "better")
    ]
    said = "; ".join(f"{word}: {', '.join(names)}" for word, names in groups if names)
    return {
        "strong": f"{len(found)} of {len(judged.asked)} figures moved beyond their noise.",
        # in its place where the page finds, by script, that nothing but the machine differs
        "alone": f"{len(found)} of {len(judged.asked)} figures moved with the machine alone.",
        "text": " ".join(
            filter(
                None,
                [f"{said[:1].upper()}{said[1:]}.", _inputs(judged.changed), elsewhere if any(others) else ""],
            )
        ),
    }


def _inputs(changed: Difference) -> str:
    """ "Changed: code, 4 parameters." """
    parts = [
        count(len(changed.inputs), "recording") if changed.inputs else "",
        count(len(changed.parameters), "parameter") if changed.parameters else "",
        "code" if changed.code == "changed" else "",
        count(len(changed.artifacts), "artifact") if changed.artifacts else "",
    ]
    return f"Changed: {', '.join(filter(None, parts))}." if any(parts) else "Nothing else changed."


def _deposition_moves(sources: Sources) -> list[Move]:
    found = deposition_rules.structures(sources)
    return [] if isinstance(found, Missing) else deposition_change.moves(sources, found)


def hashes(sources: Sources) -> list[tuple[str, str]]:
    """Short digests by which two pages can be told to be of one run."""
    data, figures = (
        next((s.sha256 for path, s in sources.read.items() if path.endswith(end)), "missing")
        for end in ("ingest/record.parquet", "evaluate_temperature/scorecard.parquet")
    )
    return [
        ("data", data[:8]),
        ("parameters", digest(sources.declared.everything)[:8]),
        ("code", sources.code[:8]),
        ("scorecard", figures[:8]),
    ]


# ---- the difference


def difference_parts(sources: Sources, judged: Judgement) -> dict[str, Any]:
    """What changed, and the figures that moved: of both controllers of the temperature loop, and of the
    composer in use of the deposition loop."""
    accepted, changed = sources.accepted, judged.changed
    parts = _deposition_moves(sources)
    if isinstance(accepted, Missing) or changed is None:
        return {
            "accepted": "",
            "missing": accepted if isinstance(accepted, Missing) else None,
            "moved": [],
            "rest": [],
            "changed": None,
            "empty": False,
        }
    moved = []
    for role, found in (
        *((role, judged.moved[role]) for role in ("data_driven", "model_based")),
        ("deposition", parts),
    ):
        for move in found:
            if move.moved:
                places = row_places(move.question, [move.before, move.now])
                limit = quantity(move.question.limit, move.question.unit, places)
                moved.append(
                    {
                        "title": move.question.title,
                        "role": "data_driven" if role == "deposition" else role,
                        "name": "composer in use" if role == "deposition" else NAMES[role],
                        "word": move.word,
                        "worse": move.word == "worse" and state(move.question, move.now) != PASSED,
                        "before": quantity(
                            move.before.value, move.question.unit, places, beyond=move.question.beyond
                        ),
                        "now": quantity(
                            move.now.value, move.question.unit, places, beyond=move.question.beyond
                        ),
                        "svg": charts.before_and_now(
                            move.question, page.MARKS.get(role, "dd"), move.before, move.now, limit
                        ),
                    }
                )
    rest: dict[str, list[str]] = {}
    for move in judged.moved["data_driven"]:
        if not move.moved:
            rest.setdefault(move.word, []).append(BRIEF[move.question.key])
    still = [f"{word[:1].upper()}{word[1:]}: {', '.join(names)}." for word, names in rest.items()]
    return {
        "accepted": changed.accepted,
        "missing": None,
        "moved": moved,
        "rest": [
            *still,
            "Not measured in either run: drift." if sources.nightly is None else "",
            deposition_change.sentence(parts),
        ],
        "changed": changed,
        "empty": changed.empty and not moved,
    }
