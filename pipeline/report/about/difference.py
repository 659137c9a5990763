"""The page of the difference: what changed since the accepted run, and every figure of the three loops that
moved beyond its noise."""

from collections.abc import Sequence
from typing import NamedTuple

from markupsafe import Markup

from pipeline.report.about import changes
from pipeline.report.deposition import change as deposition_change
from pipeline.report.shared import charts, page
from pipeline.report.shared.difference import Difference, Move, accepted
from pipeline.report.shared.digits import quantity, with_unit
from pipeline.report.shared.sources import Sources
from pipeline.report.shared.verdict import PASSED, Missing, row_places, state
from pipeline.report.temperature.contestants import heading
from pipeline.report.temperature.judgement import Judgement


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
    cases: Sequence[changes.Moved] = ()


def render(sources: Sources, judged: Judgement) -> str:
    """The text of difference.html."""
    told = changes.changes(sources, judged)
    run = accepted(sources)
    return page.render(
        "difference.html",
        here="difference",
        title="Difference against the accepted run",
        change=told,
        difference=parts(sources, judged),
        accepted_on=run.get("on", ""),
        accepted_at=run.get("commit", ""),
        from_accepted=sources.source("accepted"),
    )


def _moved(role: str, move: Move) -> MovedFigure:
    """A move of a controller of the temperature loop, or of the deposition loop's composer in use."""
    question, before, now = move.question, move.before, move.now
    if before is None or isinstance(now, Missing):
        raise ValueError(f"{question.title}: a figure that moved is in both runs")
    places = row_places(question, [before, now])
    limit = with_unit(question.limit, question.unit, places)
    return MovedFigure(
        question.title,
        "data_driven" if role == "deposition" else role,
        "composer in use" if role == "deposition" else heading(role),
        move.word,
        worse=move.word == "worse" and state(question, now) != PASSED,
        before=quantity(before.value, question.unit, places, beyond=question.beyond),
        now=quantity(now.value, question.unit, places, beyond=question.beyond),
        svg=charts.before_and_now(question, page.MARKS.get(role, "dd"), before, now, limit),
    )


def parts(sources: Sources, judged: Judgement) -> DifferenceParts:
    """What changed, and the figures that moved: of both contestants of the temperature loop that are shown,
    of the composer in use of the deposition loop, and of the setpoint loop's default."""
    before, changed = sources.accepted, judged.changed
    if sources.another_machine:
        reason = (
            f"{changes.ANOTHER} Its inputs or outputs have other names than those of plant in params.yaml"
        )
        remedy = "Mark a run of this machine as good with ./run beadline accept"
        return DifferenceParts(missing=Missing("not applicable", reason, remedy))
    if isinstance(before, Missing) or changed is None:
        return DifferenceParts(missing=before if isinstance(before, Missing) else None)
    streams = changes.deposition_moves(sources)
    by_role = {name: judged.moved.get(name, []) for name in (judged.subject, judged.rival)}
    by_role |= {"deposition": streams}
    moved = [_moved(role, move) for role, moves in by_role.items() for move in moves if move.moved]
    camera = changes.of_loops(sources, judged)[-1]
    rest: dict[str, list[str]] = {}
    for move in judged.moved.get(judged.subject, []):
        if not move.moved:
            rest.setdefault(move.word, []).append(move.question.rule)
    still = [f"{word[:1].upper()}{word[1:]}: {', '.join(names)}." for word, names in rest.items()]
    drift = "Not measured in either run: drift." if sources.nightly is None else ""
    return DifferenceParts(
        changed.accepted,
        moved=moved,
        rest=[*still, drift, deposition_change.sentence(streams), f"Setpoint: {camera.sentence()}"],
        changed=changed,
        whose=heading(judged.subject),
        empty=changed.empty and not moved and not camera.moved and not all(word == "new" for word in rest),
        cases=camera.moved,
    )
