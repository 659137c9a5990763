"""Page one: the verdict, the twelve answers, a card a loop, the difference, words, provenance."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from markupsafe import Markup

from pipeline.report.certificate import exported
from pipeline.report.deposition import change as deposition_change
from pipeline.report.deposition import rules as deposition_rules
from pipeline.report.index import cards, workflow
from pipeline.report.setpoint import card as setpoint_card
from pipeline.report.setpoint import change as setpoint_change
from pipeline.report.shared import charts, headline, page, words
from pipeline.report.shared.difference import Difference, Move
from pipeline.report.shared.digits import count, declared, quantity, with_unit
from pipeline.report.shared.sources import Sources, digest
from pipeline.report.shared.verdict import (
    OPEN,
    PASSED,
    UNDECIDED,
    UNJUDGED,
    Figure,
    Missing,
    Question,
    row_places,
    state,
)
from pipeline.report.temperature.answers import comparison
from pipeline.report.temperature.contestants import heading, in_a_sentence
from pipeline.report.temperature.judgement import Judgement, heads, verdict_parts
from pipeline.report.temperature.scorecard import setting
from pipeline.report.temperature.wording import banded, places_of, worded


def render(sources: Sources, judged: Judgement) -> str:
    """The text of index.html."""
    loops, accepted = headline.loops(sources, judged), _accepted(sources)
    return page.render(
        "index.html",
        title=headline.decision(loops, quick=sources.quick).rstrip("."),
        decision=headline.decision(loops, quick=sources.quick),
        state=headline.state(loops),
        accepted_on=accepted.get("on", ""),
        accepted_at=accepted.get("commit", ""),
        loops=[
            loop._replace(
                reason=words.explained(sources, loop.reason), remedy=words.explained(sources, loop.remedy)
            )
            for loop in loops
        ],
        claim=f"{headline.claim(sources)} {_drifts(judged)}",
        rules=verdict_parts(judged).rules,
        answers=_rows(sources, judged),
        setting=setting(comparison(sources.metrics)),
        heads=heads(judged),
        pair=judged.pair,
        best=judged.best,
        change=ChangeSentence("A quick look is compared with no run.")
        if sources.quick
        else ChangeSentence(ANOTHER)
        if sources.another_machine
        else _change_sentence(
            judged, sources.accepted, _deposition_moves(sources), setpoint_change.moved_cases(sources)
        ),
        drift=judged.drifted,
        drift_state=drift_state(judged),
        hashes=hashes(sources),
        cards=[
            cards.temperature(sources, judged),
            cards.deposition(sources),
            setpoint_card.setpoint(sources),
        ],
        difference=difference_parts(sources, judged),
        workflow=workflow.figure(sources),
        exported=[] if isinstance(leaving := exported.lines(sources), Missing) else leaving,
        from_exported=page.origin(sources.source("export_controllers")),
        from_accepted=sources.source("accepted"),
        words=words.chosen(sources, words.INDEX),
        sources=list(sources.read.values()),
        absent=sources.absent,
        code=sources.code,
        here="index",
    )


def _accepted(sources: Sources) -> dict[str, str]:
    """The day on which the run was accepted, and the commit that was checked out; older files do not say."""
    run = sources.accepted if isinstance(sources.accepted, dict) else {}
    accepted = run.get("accepted")
    if not isinstance(accepted, dict):
        return {}
    return {key: str(accepted[key])[:40] for key in ("on", "commit") if key in accepted}


def _drifts(judged: Judgement) -> str:
    """Drift of the three loops in a sentence; only the temperature loop's is measured, by the nightly job."""
    if drift_state(judged) in (OPEN, UNDECIDED):
        return "Drift is not measured in any loop."
    word = judged.drifted.word
    return f"Drift: temperature {word[:1].lower()}{word[1:].rstrip('.')}, not measured in the others."


def drift_state(judged: Judgement) -> str:
    """Passed where the nightly job measured drift and found none, otherwise its word for it."""
    answer = judged.drifted.answer
    return answer.state if isinstance(answer, Missing) else PASSED


# ---- the answers


class Cell(NamedTuple):
    """The answer of one controller: its figure and band in words, or what is missing."""

    css: str
    name: str
    state: str
    mark: str
    missing: Missing | None = None
    value: str = ""
    band: str = ""


class Answer(NamedTuple):
    """A row of the answers. `moved` and `worse` since the accepted run; `quiet`: both contestants pass, and
    nothing moved."""

    n: int
    key: str
    title: str
    word: str
    sub: str
    cells: list[Cell]
    limit: str
    state: str
    strip: Markup
    change: str
    moved: bool
    worse: bool
    quiet: bool


def _rows(sources: Sources, judged: Judgement) -> list[Answer]:
    unmoved = "other machine" if sources.another_machine else "first run"
    return [_row(question, judged, unmoved) for question in judged.asked]


def _row(question: Question, judged: Judgement, unmoved: str) -> Answer:
    """`unmoved`: why nothing is compared, where nothing is."""
    pair = [(name, judged.answers[name][question.key]) for name in (judged.subject, judged.rival)]
    places = places_of(question, [figure for _, figure in pair])
    move = next((m for m in judged.moved.get(judged.subject, []) if m.question.key == question.key), None)
    moved = move is not None and move.moved
    mine, other = (_state(question, figure) for _, figure in pair)
    # as it was declared: "10.000 %" reads as ten thousand where a point parts thousands
    limit = (
        f"{'≥' if question.at_least else '≤'} "
        f"{with_unit(question.limit, question.unit, declared(question.limit))}"
        if math.isfinite(question.limit)
        else "not resolved"
    )
    return Answer(
        question.answer,
        question.key,
        question.title,
        words.explaining(question.key),
        SUB.get(question.key, ""),
        [_cell(question, name, figure, places) for name, figure in pair],
        limit="none" if question.key == "crossings" else limit,
        state=mine,
        strip=charts.strip(question, [(heading(name), page.MARKS.get(name, "bl"), f) for name, f in pair]),
        change=move.text() if move else unmoved,
        moved=moved,
        worse=moved and move.word == "worse" and mine != PASSED,
        quiet=mine == other == PASSED and not moved,
    )


def _state(question: Question, figure: Figure | Missing) -> str:
    """A contestant that learns nothing needs no data."""
    return PASSED if isinstance(figure, Missing) and figure.state == UNJUDGED else state(question, figure)


SUB = {"at_limits": "clipped commands", "disk": "median plant", "delay_s": "median plant"}


def _cell(question: Question, name: str, figure: Figure | Missing, places: int) -> Cell:
    cell = Cell(page.MARKS.get(name, "bl"), heading(name), _state(question, figure), name)
    if isinstance(figure, Missing):
        return cell._replace(missing=figure)
    return cell._replace(
        value=worded(question, figure.value, places),
        band=figure.note.split(" samples")[0].replace(" of ", " / ")
        if question.key in ("data", "crossings")
        else banded(question, figure, places),
    )


ANOTHER = "The accepted run is of another machine: nothing to compare."


class ChangeSentence(NamedTuple):
    """Answer 3; `alone` stands in the place of `strong` where the page finds, by script, that nothing but the
    machine differs."""

    strong: str
    text: str = ""
    alone: str = ""


def _change_sentence(
    judged: Judgement, accepted: dict | Missing | None, parts: Sequence[Move], cases: tuple[int, int]
) -> ChangeSentence:
    """Answer 3: the figures of the temperature loop that moved, and how many of the other loops'."""
    if isinstance(accepted, Missing):
        return ChangeSentence("The accepted run cannot be read.", accepted.sentence())
    if judged.changed is None:
        return ChangeSentence(
            "First run: nothing to compare with.", "./run beadline accept marks this one as good."
        )
    mine = judged.moved.get(judged.subject, [])
    moved = [move for move in mine if move.moved]
    others = sum(move.moved for move in parts), cases[0]
    elsewhere = (
        f"Deposition: {others[0]} of {len(parts)} moved. Setpoint: {others[1]} of {cases[1]}."
        if parts or cases[1]
        else ""
    )
    theirs = sum(move.moved for move in judged.moved.get(judged.rival, []))
    beside = f"{_inputs(judged.changed)} {elsewhere if any(others) else ''}".strip()
    if not moved and theirs:
        return ChangeSentence(
            f"No figure of {in_a_sentence(judged.subject)} moved beyond its noise.",
            f"{heading(judged.rival)[:1].upper()}{heading(judged.rival)[1:]}: "
            f"{count(theirs, 'figure')} moved. "
            f"{beside}",
        )
    if mine and all(move.word in ("new", OPEN, "failed") for move in mine):
        return ChangeSentence(f"The accepted run has no figures of {in_a_sentence(judged.subject)}.", beside)
    if not moved:
        unchanged = judged.changed.empty and all(
            move.word in ("unchanged", OPEN, "failed", UNJUDGED) for move in mine
        )
        if unchanged and not any(others):
            return ChangeSentence("Nothing changed; no figure moved.")
        loop = "of this loop " if any(others) else ""
        return ChangeSentence(f"No figure {loop}moved beyond its noise.", beside)
    groups = [
        (word, [move.question.rule for move in moved if move.word == word]) for word in ("worse", "better")
    ]
    listed = "; ".join(f"{word}: {', '.join(names)}" for word, names in groups if names)
    sentences = [
        f"{listed[:1].upper()}{listed[1:]}.",
        _inputs(judged.changed),
        elsewhere if any(others) else "",
    ]
    figures = f"{len(moved)} of {len(judged.asked)} figures moved"
    return ChangeSentence(
        f"{figures} beyond their noise.",
        " ".join(filter(None, sentences)),
        alone=f"{figures} with the machine alone.",
    )


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
    parts = deposition_rules.structures(sources)
    return [] if isinstance(parts, Missing) else deposition_change.moves(sources, parts)


def hashes(sources: Sources) -> list[tuple[str, str]]:
    """Short digests by which two pages can be told to be of one run."""
    data, figures = (
        next((s.sha256 for path, s in sources.read.items() if path.endswith(end)), "missing")
        for end in ("ingest/record.parquet", "evaluate_temperature/cases.parquet")
    )
    certificate = next((s.sha256 for s in sources.source("certificate")), "")
    return [
        *([("certificate", certificate[:8])] if certificate else []),
        ("data", data[:8]),
        ("parameters", digest(sources.declared.everything)[:8]),
        ("code", sources.code[:8]),
        ("cases", figures[:8]),
    ]


# ---- the difference


class MovedFigure(NamedTuple):
    """A figure that moved beyond its noise: whose, how, and what it was and is."""

    title: str
    role: str
    name: str
    word: str
    worse: bool
    before: str
    now: str
    svg: Markup


class DifferenceParts(NamedTuple):
    """What changed since the accepted run, the figures that moved, and the rest in sentences."""

    accepted: str = ""
    missing: Missing | None = None
    moved: Sequence[MovedFigure] = ()
    rest: Sequence[str] = ()
    changed: Difference | None = None
    whose: str = ""
    empty: bool = False


def _moved(role: str, move: Move) -> MovedFigure:
    """A move of a controller of the temperature loop, or of the deposition loop's composer in use."""
    question = move.question
    places = row_places(question, [move.before, move.now])
    limit = with_unit(question.limit, question.unit, places)
    return MovedFigure(
        question.title,
        "data_driven" if role == "deposition" else role,
        "composer in use" if role == "deposition" else heading(role),
        move.word,
        worse=move.word == "worse" and state(question, move.now) != PASSED,
        before=quantity(move.before.value, question.unit, places, beyond=question.beyond),
        now=quantity(move.now.value, question.unit, places, beyond=question.beyond),
        svg=charts.before_and_now(question, page.MARKS.get(role, "dd"), move.before, move.now, limit),
    )


def difference_parts(sources: Sources, judged: Judgement) -> DifferenceParts:
    """What changed, and the figures that moved: of both contestants of the temperature loop that are shown,
    and of the composer in use of the deposition loop."""
    accepted, changed = sources.accepted, judged.changed
    if sources.another_machine:
        reason = f"{ANOTHER} Its inputs or outputs have other names than those of plant in params.yaml"
        remedy = "Mark a run of this machine as good with ./run beadline accept"
        return DifferenceParts(missing=Missing("not applicable", reason, remedy))
    parts = _deposition_moves(sources)
    if isinstance(accepted, Missing) or changed is None:
        return DifferenceParts(missing=accepted if isinstance(accepted, Missing) else None)
    by_role = {name: judged.moved.get(name, []) for name in (judged.subject, judged.rival)}
    by_role |= {"deposition": parts}
    moved = [_moved(role, move) for role, moves in by_role.items() for move in moves if move.moved]
    rest: dict[str, list[str]] = {}
    for move in judged.moved.get(judged.subject, []):
        if not move.moved:
            rest.setdefault(move.word, []).append(move.question.rule)
    still = [f"{word[:1].upper()}{word[1:]}: {', '.join(names)}." for word, names in rest.items()]
    drift = "Not measured in either run: drift." if sources.nightly is None else ""
    return DifferenceParts(
        changed.accepted,
        moved=moved,
        rest=[*still, drift, deposition_change.sentence(parts)],
        changed=changed,
        whose=heading(judged.subject),
        empty=changed.empty and not moved and not all(word == "new" for word in rest),
    )
