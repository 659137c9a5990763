"""What both pages say of the temperature loop: questions, answers, verdict, and how the figures moved."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from pipeline.report.answers import CONTROLLERS, all_answers
from pipeline.report.difference import Difference, Move, difference, moves
from pipeline.report.digits import decimals
from pipeline.report.sources import Sources
from pipeline.report.verdict import Figure, Missing, Question, Verdict, decide, questions

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
    found = moves(sources, asked, by_name) if changed else {}
    moved = {role: found[name] for role, name in CONTROLLERS.items()} if changed else {}
    return Judgement(asked, by_name, roles, decide("temperature", asked, roles), changed, moved)


def row_places(question: Question, figures: Sequence[Figure | Missing]) -> int:
    """One number of decimals for a row: what the widest band supports, but enough to show the smallest value at all."""
    mine = [(f, decimals(f.low, f.high, value=f.value)) for f in figures if isinstance(f, Figure)]
    if question.key == "data":
        return 0 if all(f.value >= 10 for f, _ in mine) else 2
    if not mine:
        return decimals(0, 0, value=question.limit)
    places = min(found for _, found in mine)
    return max([places, *(found for f, found in mine if f.value and round(f.value, places) == 0)])


def shown(judged: Judgement) -> dict[str, dict[str, dict[str, float | None]]]:
    """The figures of the pages as numbers, for the metrics: later runs are held against them."""
    return {
        name: {
            key: {"median": _plain(f.value), "low": _plain(f.low), "high": _plain(f.high)}
            for key, f in answers.items()
            if isinstance(f, Figure)
        }
        for name, answers in judged.by_name.items()
    }


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
