"""The scores of the deposition loop against the accepted run's: which moved by more than
two composers may differ and still count as one."""

from collections.abc import Sequence

from pipeline.report.shared.difference import Move
from pipeline.report.shared.sources import Sources
from pipeline.verdict.deposition import NOT_JUDGED, SAME, Structure
from pipeline.verdict.evidence import known, lookup
from pipeline.verdict.verdict import Figure, Missing, Question


def moves(sources: Sources, parts: Sequence[Structure]) -> list[Move]:
    """Of every structure and material the flow error of the composer in use. These errors have no bands: one
    simulated print each, the same at every run; so noise is what the choice between composers calls equal.
    """
    return [_move(sources, part) for part in parts] if known(sources.accepted, None) else []


def _move(sources: Sources, structure: Structure) -> Move:
    question = Question(
        0,
        "flow_error_percent",
        f"Flow error, {structure.part}, {structure.material}",
        "%",
        structure.asked.flow_error_percent,
        False,
        "",
    )
    score, before = structure.known().get(structure.chosen), _accepted(sources, structure)
    if score is None:
        why = NOT_JUDGED if structure.unknown() else "not measured"
        return Move(question, before, Missing("not measured", "nothing to compare"), False, why)
    now = Figure(score.error, score.error, score.error)
    if before is None:
        return Move(question, None, now, False, "new")
    if before.value == now.value:
        return Move(question, before, now, False, "unchanged")
    if abs(now.value - before.value) <= SAME:
        return Move(question, before, now, False, "within noise")
    return Move(question, before, now, True, "better" if now.value < before.value else "worse")


def _accepted(sources: Sources, structure: Structure) -> Figure | None:
    """The error of the composer that was in use then, which may be another one."""
    parts = known(lookup(sources.accepted, "metrics.compose_parts"), {})
    then = parts.get(structure.part, {}).get(structure.material, {})
    score = then.get(then.get("chosen"))
    return Figure(*3 * (float(score["rms_percent_of_on_off"]),)) if score else None


def sentence(moves: Sequence[Move]) -> str:
    """ "Deposition: 1 of 4 flow errors moved." """
    changed = sum(move.moved for move in moves)
    return f"Deposition: {changed} of {len(moves)} flow errors moved." if moves else ""
