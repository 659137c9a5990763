"""Page one: the verdict, the twelve answers, a card a loop, the difference, words, provenance."""

from collections.abc import Sequence
from typing import NamedTuple

from markupsafe import Markup

from pipeline.report.deposition import change as deposition_change
from pipeline.report.deposition import rules as deposition_rules
from pipeline.report.index import cards, workflow
from pipeline.report.setpoint import card as setpoint_card
from pipeline.report.setpoint import change as setpoint_change
from pipeline.report.shared import charts, headline, page, words
from pipeline.report.shared.difference import Difference, Move
from pipeline.report.shared.digits import band, beyond_meaning, count, decimals, declared, quantity, with_unit
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
from pipeline.report.temperature.judgement import NAMES, Judgement, verdict_parts
from pipeline.report.temperature.verdict import BRIEF, drift_state


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
            loop._replace(
                reason=words.explained(sources, loop.reason), remedy=words.explained(sources, loop.remedy)
            )
            for loop in loops
        ],
        claim=f"{headline.claim(sources)} {_drifts(judged)}",
        rules=verdict_parts(judged).rules,
        answers=_rows(sources, judged),
        repetitions=repetitions(sources),
        seeds=len(sources.declared.panel.judging.seeds),
        change=ChangeSentence(ANOTHER)
        if sources.another_machine
        else _change_sentence(
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
        paired=pairs.compared(sources).finding,
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
    run = sources.accepted if isinstance(sources.accepted, dict) else {}
    accepted = run.get("accepted")
    if not isinstance(accepted, dict):
        return {}
    return {key: str(accepted[key])[:40] for key in ("on", "commit") if key in accepted}


def _drifts(judged: Judgement) -> str:
    """Drift of the three loops in a sentence; only the temperature loop's is measured, by the nightly job."""
    if drift_state(judged.roles["data_driven"]) in (OPEN, UNDECIDED):
        return "Drift is not measured in any loop."
    word = judged.drifted.word
    return f"Drift: temperature {word[:1].lower()}{word[1:].rstrip('.')}, not measured in the others."


# ---- the answers


class Cell(NamedTuple):
    """The answer of one controller: its figure and band in words, or what is missing."""

    css: str
    name: str
    state: str
    missing: Missing | None = None
    value: str = ""
    band: str = ""


class Answer(NamedTuple):
    """A row of the answers. `moved` and `worse` since the accepted run; `quiet`: both controllers pass, and
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
    pair = [(role, judged.roles[role][question.key]) for role in ("data_driven", "model_based")]
    places = row_places(question, [figure for _, figure in pair])
    move = next((m for m in judged.moved.get("data_driven", []) if m.question == question), None)
    moved = move is not None and move.moved
    learned, designed = (state(question, figure) for _, figure in pair)
    # as it was declared: "10.000 %" reads as ten thousand where a point parts thousands
    limit = with_unit(question.limit, question.unit, declared(question.limit))
    return Answer(
        question.answer,
        question.key,
        question.title,
        words.explaining(question.key),
        _sub(question, pair),
        [_cell(question, role, figure, places) for role, figure in pair],
        limit=f"{'≥' if question.at_least else '≤'} {limit}",
        state=learned,
        strip=charts.strip(question, [(ROLES[role], page.MARKS[role], figure) for role, figure in pair]),
        change=move.text() if move else unmoved,
        moved=moved,
        worse=moved and move.word == "worse" and learned != PASSED,
        quiet=learned == designed == PASSED and not moved,
    )


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


def _cell(question: Question, role: str, figure: Figure | Missing, places: int) -> Cell:
    cell = Cell(page.MARKS[role], NAMES[role], state(question, figure))
    if isinstance(figure, Missing):
        return cell._replace(missing=figure)
    return cell._replace(
        value=quantity(figure.value, question.unit, places, beyond=question.beyond),
        band=figure.note.split(" samples")[0].replace(" of ", " / ")
        if question.key == "data"
        else band(figure.low, figure.high, places, unit=question.unit, beyond=question.beyond)
        or _finer(figure, question),
    )


def _finer(figure: Figure, question: Question) -> str:
    """A band that the row's decimals do not show, with those that do;
    runs that are all alike are said to be."""
    return band(
        figure.low,
        figure.high,
        decimals(figure.low, figure.high, value=figure.value),
        unit=question.unit,
        beyond=question.beyond,
    ) or ("" if beyond_meaning(figure.value, question.unit) else "all alike")


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
    moved = [move for move in judged.moved["data_driven"] if move.moved]
    others = sum(move.moved for move in parts), cases[0]
    elsewhere = (
        f"Deposition: {others[0]} of {len(parts)} moved. Setpoint: {others[1]} of {cases[1]}."
        if parts or cases[1]
        else ""
    )
    model_based = sum(move.moved for move in judged.moved["model_based"])
    if not moved and model_based:
        return ChangeSentence(
            "No figure of the data-driven controller moved beyond its noise.",
            f"Model-based: {count(model_based, 'figure')} moved. {_inputs(judged.changed)} "
            f"{elsewhere if any(others) else ''}".strip(),
        )
    if not moved:
        unchanged = judged.changed.empty and all(
            move.word in ("unchanged", "not measured", "failed") for move in judged.moved["data_driven"]
        )
        if unchanged and not any(others):
            return ChangeSentence("Nothing changed; no figure moved.")
        loop = "of this loop " if any(others) else ""
        return ChangeSentence(
            f"No figure {loop}moved beyond its noise.",
            f"{_inputs(judged.changed)} {elsewhere if any(others) else ''}".strip(),
        )
    groups = [
        (word, [BRIEF[move.question.key] for move in moved if move.word == word])
        for word in ("worse", "better")
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
        for end in ("ingest/record.parquet", "evaluate_temperature/scorecard.parquet")
    )
    return [
        ("data", data[:8]),
        ("parameters", digest(sources.declared.everything)[:8]),
        ("code", sources.code[:8]),
        ("scorecard", figures[:8]),
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
    empty: bool = False


def _moved(role: str, move: Move) -> MovedFigure:
    """A move of a controller of the temperature loop, or of the deposition loop's composer in use."""
    question = move.question
    places = row_places(question, [move.before, move.now])
    limit = with_unit(question.limit, question.unit, places)
    return MovedFigure(
        question.title,
        "data_driven" if role == "deposition" else role,
        "composer in use" if role == "deposition" else NAMES[role],
        move.word,
        worse=move.word == "worse" and state(question, move.now) != PASSED,
        before=quantity(move.before.value, question.unit, places, beyond=question.beyond),
        now=quantity(move.now.value, question.unit, places, beyond=question.beyond),
        svg=charts.before_and_now(question, page.MARKS.get(role, "dd"), move.before, move.now, limit),
    )


def difference_parts(sources: Sources, judged: Judgement) -> DifferenceParts:
    """What changed, and the figures that moved: of both controllers of the temperature loop, and of the
    composer in use of the deposition loop."""
    accepted, changed = sources.accepted, judged.changed
    if sources.another_machine:
        reason = f"{ANOTHER} Its inputs or outputs have other names than those of plant in params.yaml"
        remedy = "Mark a run of this machine as good with ./run beadline accept"
        return DifferenceParts(missing=Missing("not applicable", reason, remedy))
    parts = _deposition_moves(sources)
    if isinstance(accepted, Missing) or changed is None:
        return DifferenceParts(missing=accepted if isinstance(accepted, Missing) else None)
    by_role = {role: judged.moved[role] for role in ("data_driven", "model_based")} | {"deposition": parts}
    moved = [_moved(role, move) for role, moves in by_role.items() for move in moves if move.moved]
    rest: dict[str, list[str]] = {}
    for move in judged.moved["data_driven"]:
        if not move.moved:
            rest.setdefault(move.word, []).append(BRIEF[move.question.key])
    still = [f"{word[:1].upper()}{word[1:]}: {', '.join(names)}." for word, names in rest.items()]
    drift = "Not measured in either run: drift." if sources.nightly is None else ""
    return DifferenceParts(
        changed.accepted,
        moved=moved,
        rest=[*still, drift, deposition_change.sentence(parts)],
        changed=changed,
        empty=changed.empty and not moved,
    )
